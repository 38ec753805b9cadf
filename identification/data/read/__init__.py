"""Reading measurement files: one function, `read`, and one module a format."""

from __future__ import annotations

import hashlib
import shutil
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.data.check.gate import passed
from identification.data.column import Column
from identification.data.columns import choose, load_map, recognise_quietly
from identification.data.read._formats import open_table
from identification.data.read._source import from_pipe, is_pipe, renamed
from identification.data.record import Provenance, Record, channel_unit
from identification.data.units import to_si
from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from identification.data.joint_file import Joint
    from identification.data.read._table import Table

__all__ = ["open_table", "read"]

_SHOWN: Final = 20
"""What is left out of a file is named up to so many times."""
_PLAINLY: Final = "save it as plain numbers, one for each sample"

HASHED_BESIDE: Final = 4 << 20
"""Files longer than this are hashed in a thread of their own while they are read [bytes]."""


def read(
    path: str | Path,
    columns: Mapping[str, Any] | str | Path | None = None,
    kind: str | None = None,
    name: str | None = None,
    joint: Joint | None = None,
) -> Record:
    """Read one measurement file.

    Parameters
    ----------
    path : str or Path
        CSV/TSV text, MAT (v5, 7.3), NPZ, HDF5, Parquet, MDF4, ROS bag or MCAP; told apart by
        content.
    columns : mapping, str, Path or None
        Column map ``{channel: {column, unit, scale, sign, counts_per_turn}}``, or the TOML file
        that holds it (a ``[columns]`` table, a joint file).  Headers like ``motor_current_A`` need
        none.
    kind : {"rotary", "linear"}, optional
        Kind of the axis; without it what the joint file says, or ``"rotary"``.
    name : str, optional
        Name of the record; the file's stem where it is left out.
    joint : Joint, optional
        Gives columns and kind where they are left out, and has the record go through the check
        gate: it comes back repaired, with what was found in its provenance.

    Returns
    -------
    Record
        In SI units.  A ``run`` column cuts it into segments.  Without `joint` nothing is checked or
        repaired here: the verbs do that (see `identification.data.check.gate`).

    Raises
    ------
    InputError
        If the file cannot be used, or with `joint` the record; where columns are not recognised the
        message shows a guess as TOML.
    """
    file = Path(path)
    if joint is not None:
        columns, kind = (joint.columns if columns is None else columns), kind or joint.kind
    raw, said = load_map(columns)
    axis = kind or said or "rotary"
    channel_unit("time", axis)
    name = name or file.stem
    if not is_pipe(file):
        record = _read(file, file, raw, axis, name)
    else:
        copy = from_pipe(file)
        try:
            record = renamed(lambda: _read(file, copy, raw, axis, name), copy, file)
        finally:
            shutil.rmtree(copy.parent, ignore_errors=True)
    return record if joint is None else passed(record, joint)[0]


def _read(file: Path, place: Path, raw: Mapping[str, Any], axis: str, name: str) -> Record:
    """Read the file that lies at a place."""
    with _Digest(place) as digest:
        table = open_table(place)
        _named(raw, table.left, file)
        chosen, notes = choose(raw, table.names, table.units, axis, str(file))
        time, channels, run_notes = _load(table, chosen, axis, file)
    lost = _lost(table, axis, channels)
    rest = [f"{name} {why}" for name, why in table.left.items() if name not in lost]
    left = (f"left out: {', '.join(rest[:_SHOWN])}",) if rest else ()
    provenance = Provenance(
        paths=(str(file),),
        sha256=(digest.value(),),
        reader=table.reader,
        columns=tuple(entry.describe() for entry in chosen),
        notes=table.notes + left + notes + run_notes,
        lost=tuple((channel, f"column {name!r} {why}") for name, (channel, why) in lost.items()),
    )
    return Record.from_channels(time, channels, name=name, kind=axis, provenance=provenance)


def _named(raw: Mapping[str, Any], left: Mapping[str, str], file: Path) -> None:
    """Refuse a map that names what is no column of the file, with the reason."""
    for channel, entry in raw.items():
        name = entry.get("column") if isinstance(entry, dict) else entry
        if isinstance(name, str) and name in left:
            raise InputError(
                f"{file}: [columns] {channel}: column {name!r} {left[name]}: {_PLAINLY}"
            )


def _lost(
    table: Table, kind: str, channels: Mapping[str, npt.NDArray[np.float64]]
) -> dict[str, tuple[str, str]]:
    """What is no column of the file, but has the name of a channel that no other column gives:
    its channel, and why.
    """
    found = {}
    for name, why in table.left.items():
        column = recognise_quietly(name, kind, table.units.get(name))
        if column is not None and column.channel not in channels and column.channel != "time":
            found[name] = (column.channel, f"{why}: {_PLAINLY}")
    return found


def _load(
    table: Table, chosen: tuple[Column, ...], kind: str, file: Path
) -> tuple[npt.NDArray[np.float64], dict[str, npt.NDArray[np.float64]], tuple[str, ...]]:
    numeric = [name for entry in chosen if entry.channel != "run" for name in entry.sources]
    text = [entry.column for entry in chosen if entry.channel == "run"]
    loaded = table.load(list(dict.fromkeys(numeric)), text)
    channels: dict[str, npt.NDArray[np.float64]] = {}
    notes: tuple[str, ...] = ()
    for entry in chosen:
        if entry.step is not None:
            count = len(next(iter(loaded.values())))
            channels[entry.channel] = to_si(entry.step * np.arange(count), entry.unit, "time")
        elif entry.channel == "run":
            channels["run"], notes = _runs(loaded[entry.column])
        elif entry.formula is not None:
            try:
                made = entry.formula.values(loaded)
            except InputError as error:
                raise InputError(f"{file}: {error}") from None
            channels[entry.channel] = _si(made, entry, kind, file)
        else:
            channels[entry.channel] = _si(loaded[entry.column], entry, kind, file)
    time = channels.pop("time")
    if time.size == 0:
        raise InputError(f"{file}: has no sample: record again or give another file")
    return time, channels, notes


def _si(values: npt.NDArray[Any], entry: Column, kind: str, file: Path) -> npt.NDArray[np.float64]:
    try:
        raw = np.asarray(values, dtype=np.float64)
    except (ValueError, TypeError):
        raise InputError(
            f"{file}: column {entry.column!r} is not numeric: give {entry.channel} another"
        ) from None
    factor = entry.scale * entry.sign
    wanted = channel_unit(entry.channel, kind)
    scaled = raw if factor == 1.0 else raw * factor
    return to_si(
        scaled, entry.unit, wanted, counts_per_turn=entry.counts_per_turn, channel=entry.channel
    )


def _runs(values: npt.NDArray[Any]) -> tuple[npt.NDArray[np.float64], tuple[str, ...]]:
    """Number the runs in the order in which they come, and name them in a note."""
    changes = (
        np.concatenate([[True], values[1:] != values[:-1]])
        if values.size
        else np.zeros(0, dtype=np.bool_)
    )
    labels = [str(value).strip() for value in values[changes]]
    shown = ", ".join(labels[:20]) + (", ..." if len(labels) > 20 else "")
    return (np.cumsum(changes) - 1).astype(np.float64), (f"{len(labels)} run(s): {shown}",)


@final
class _Digest:
    """SHA-256 of a file, or of the files of a folder; a long one is hashed beside the reading."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._found: str | None = None
        self._given_up = False
        self._thread: threading.Thread | None = None

    def __enter__(self) -> _Digest:
        try:
            long = self._path.is_file() and self._path.stat().st_size > HASHED_BESIDE
        except OSError:
            long = False  # `open_table` says what is wrong
        if long:
            self._thread = threading.Thread(target=self._hash, daemon=True, name="hash")
            self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._given_up = error[0] is not None
        if self._thread is not None:
            self._thread.join()

    def value(self) -> str:
        """The digest; hashed here where it is not known yet.

        Raises
        ------
        OSError
            A file that cannot be read.
        """
        if self._thread is not None:
            self._thread.join()
        if self._found is None:
            self._found = self._made()
        return self._found

    def _hash(self) -> None:
        try:
            self._found = self._made()
        except OSError:
            self._found = None  # raised by `value`, where somebody listens

    def _made(self) -> str:
        files = (
            sorted(p for p in self._path.rglob("*") if p.is_file())
            if self._path.is_dir()
            else [self._path]
        )
        digest = hashlib.sha256()
        for file in files:
            with file.open("rb") as stream:
                while not self._given_up and (block := stream.read(1 << 20)):
                    digest.update(block)
        return digest.hexdigest()
