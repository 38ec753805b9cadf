"""Records of a session: read with a map, checked, described; series of them for a plot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from identification.data.check.gate import inspected, stamped
from identification.data.guess import guess_columns
from identification.data.joint_file import Joint
from identification.data.read import open_table, read
from identification.data.record import Record
from identification.data.survey import questions_of, survey
from identification.errors import InputError
from workbench.page.session import FileEntry
from workbench.page.uploads import check_unpacked

FloatArray = npt.NDArray[np.float64]

HELD_OUT_WORDS: Final = ("test", "held", "valid", "check")
NO_COLUMN: Final = frozenset(("step", "formula"))
"""Keys of a map's entry that stand in place of a column."""
WINDOW: Final = 6.0
"""Length of the windows of a thinned record [s]."""
MOST_RUNS: Final = 200
"""Runs that a plot marks, and a list of them has; more would hide the rest."""


def guessed_role(name: str) -> tuple[str, str]:
    """Role of a record from its name, and the sentence that says so."""
    lower = name.lower()
    word = next((w for w in HELD_OUT_WORDS if w in lower), None)
    if word:
        return (
            "held_out",
            f"held out, because its name has {word!r} in it; change it if that is wrong",
        )
    return "train", "used for the fit"


def opened(
    entry: FileEntry, path: Path, kind: str, columns: Mapping[str, Any] | None
) -> tuple[FileEntry, Record | None]:
    """Read a file; what is wrong is in the entry, not raised. A record has the status ``checking``
    until `checked`.

    Parameters
    ----------
    entry : FileEntry
    path : Path
    kind : {"rotary", "linear"}
    columns : mapping or None
        Column map: of the entry, else of the joint file.
    """
    try:
        check_unpacked(path, entry.name)
    except InputError as error:
        return replace(entry, status="refused", message=str(error), findings=()), None
    except (OSError, ValueError, LookupError) as error:
        return replace(
            entry,
            status="refused",
            message=f"{entry.name}: is not readable ({error}); export it again",
            findings=(),
        ), None
    try:
        record = _record(path, entry, kind, columns)
    except InputError as error:
        return _unread(entry, path, kind, str(error)), None
    except (OSError, MemoryError, ValueError, ArithmeticError, LookupError) as error:
        return replace(
            entry,
            status="refused",
            message=f"{entry.name}: cannot be read ({error}); export it again",
            findings=(),
        ), None
    return replace(
        entry,
        findings=(),
        summary=_summary(record),
        message="",
        status="checking",
        names=(),
        guess=(),
    ), record


def checked(
    entry: FileEntry, record: Record, path: Path, joint: Joint | None, *, mapped: bool = False
) -> tuple[FileEntry, Record | None]:
    """Run the check gate on a record that `opened` gave; None where it is refused. Where nobody was
    asked for the columns, what would be odd about the joint stands among the findings.

    Parameters
    ----------
    entry : FileEntry
    record : Record
    path : Path
    joint : Joint or None
        Where it is known already.
    mapped : bool
        It was read with a column map.
    """
    findings = inspected(record, joint)
    shown: tuple[dict[str, Any], ...] = tuple(
        {
            "severity": f.severity,
            "code": f.code,
            "message": _plain(f.message, path, entry.name),
            "channel": f.channel,
        }
        for f in findings
    )
    if not mapped:
        asked = questions_of(record, path, findings, joint.gear_ratio if joint else None)
        shown = (*map(_odd, asked), *shown)
    bad = next((f for f in findings if f.severity == "refuse"), None)
    entry = replace(entry, findings=shown, message="", status="ready")
    if bad is not None:
        return replace(entry, status="refused", message=_plain(bad.message, path, entry.name)), None
    return entry, stamped(record, joint, findings)


def _odd(text: str) -> dict[str, Any]:
    """A question about the joint, as a finding of the page."""
    return {"severity": "warn", "code": "odd", "message": text, "channel": ""}


def _record(path: Path, entry: FileEntry, kind: str, columns: Mapping[str, Any] | None) -> Record:
    made = _read(path, entry, kind, columns)
    return replace(made, provenance=replace(made.provenance, paths=(entry.name,)))


def _read(path: Path, entry: FileEntry, kind: str, columns: Mapping[str, Any] | None) -> Record:
    name = Path(entry.name).stem
    if columns:
        names = open_table(path).names
        used = {
            k: v
            for k, v in columns.items()
            if not isinstance(v, Mapping) or v.get("column") in names or v.keys() & NO_COLUMN
        }
        return read(path, columns=used, kind=kind, name=name)
    return read(path, kind=kind, name=name)


def _unread(entry: FileEntry, path: Path, kind: str, message: str) -> FileEntry:
    """Where only the columns are in doubt, the guess is shown; it is applied when the user
    confirms it.
    """
    message = _plain(message, path, entry.name)
    try:
        table = open_table(path)
        guesses = guess_columns(table.names, table.units, kind)
    except (InputError, OSError, ValueError):
        return replace(entry, status="refused", message=message, findings=())
    if not table.names:
        return replace(entry, status="refused", message=message, findings=())
    rows = tuple(
        {
            "channel": g.column.channel,
            "column": g.column.column,
            "unit": g.column.unit,
            "sign": g.column.sign,
            "scale": g.column.scale,
            "reason": g.reason,
        }
        for g in guesses
    )
    short = message.partition("; check this guess")[0]
    return replace(
        entry, status="columns", message=short, names=tuple(table.names), guess=rows, findings=()
    )


def surveyed(
    entry: FileEntry,
    path: Path,
    kind: str | None,
    columns: Mapping[str, Any] | None,
    number: int | None = None,
) -> dict[str, Any]:
    """What the file holds, with a map: the one given, or the guess.

    Raises
    ------
    InputError
        A map that does not fit the file.
    """
    try:
        made = survey(path, kind=kind, columns=columns, number=number, name=entry.name)
    except InputError as error:
        raise InputError(_plain(str(error), path, entry.name)) from None
    found = made.as_json()
    for finding in found["findings"]:
        finding["message"] = _plain(finding["message"], path, entry.name)
    return found


def _plain(message: str, path: Path, name: str) -> str:
    """A message with the name of the upload in place of a path on this machine."""
    return message.replace(str(path), name).replace(path.stem, Path(name).stem)


def _summary(record: Record) -> dict[str, Any]:
    spans = {c: _span(v) for c, v in record.channels.items() if c != "run"}
    step, parts, time = record.dt, record.segments(), plot_time(record)
    runs = [[float(time[p][0]), float(time[p][-1])] for p in parts[:MOST_RUNS] if len(time[p])]
    return {
        "samples": len(record),
        "duration": round(record.duration, 6),
        "segments": len(parts),
        "runs": runs if len(parts) > 1 else [],
        "dt": step if math.isfinite(step) else None,
        "channels": [
            {"name": c, "unit": record.unit(c), "low": span[0], "high": span[1]}
            for c, span in spans.items()
            if span
        ],
        "columns": list(record.provenance.columns),
        "notes": list(record.provenance.notes),
        "reader": record.provenance.reader,
    }


def _span(values: FloatArray) -> tuple[float, float] | None:
    """Smallest and largest finite value; None where there is none."""
    if not len(values):
        return None
    low, high = float(values.min()), float(values.max())
    return (low, high) if math.isfinite(low + high) else _span(values[np.isfinite(values)])


def plot_time(record: Record) -> FloatArray:
    """Time that grows over the whole record: stretches that start again are laid end to end [s]."""
    if len(record) < 2 or bool(np.all(np.diff(record.time) > 0)):
        return record.time
    out = np.empty(len(record))
    offset = 0.0
    for part in record.segments():
        out[part] = record.time[part] - record.time[part.start] + offset
        offset = float(out[part.stop - 1]) + record.dt
    return out


def without_windows(record: Record, windows: Sequence[Sequence[float]]) -> Record:
    """The record without some windows of its plot; the stretches between them stay apart.

    Raises
    ------
    InputError
        Nothing is left.
    """
    if not windows:
        return record
    time = plot_time(record)
    keep = np.ones(len(record), dtype=np.bool_)
    for low, high in windows:
        keep &= (time < low) | (time > high)
    if not keep.any():
        raise InputError(f"{record.name}: every sample is left out; take a window back")
    return record.take(keep, f"{len(windows)} window(s) left out by hand")


def decimated(
    time: FloatArray,
    columns: Sequence[FloatArray],
    points: int,
    window: tuple[float, float] | None = None,
) -> tuple[FloatArray, list[FloatArray], bool]:
    """Smallest and largest value of each bucket, in their order, so that no spike is lost; every
    sample where they are few.

    Parameters
    ----------
    time : (n,) array, increasing
    columns : sequence of (n,) array
    points : int
        Buckets.
    window : (low, high), optional
        Part of the time; one more sample on either side is kept, so that lines reach the edge.

    Returns
    -------
    time, columns, full
        At most 2 `points` values; `full` is True where they are all the samples of the window.
    """
    first, last = 0, len(time)
    if window is not None:
        first = max(0, int(np.searchsorted(time, window[0])) - 1)
        last = min(len(time), int(np.searchsorted(time, window[1], side="right")) + 1)
    count = last - first
    if count <= 2 * points:
        return time[first:last], [c[first:last] for c in columns], True
    edges = np.linspace(first, last, points + 1).astype(np.int64)[:-1]
    stamps = np.repeat(time[edges], 2)
    width = np.diff(np.append(edges, last)) // 2
    stamps[1::2] = time[np.minimum(edges + np.maximum(width, 1), last - 1)]
    out = []
    for c in columns:
        part = c[:last]
        low, high = np.minimum.reduceat(part, edges), np.maximum.reduceat(part, edges)
        falls = part[edges] > part[np.append(edges[1:], last) - 1]
        both = np.empty(2 * points)
        both[0::2], both[1::2] = np.where(falls, high, low), np.where(falls, low, high)
        out.append(both)
    return stamps, out, False


def thinned(record: Record, seconds: float) -> Record:
    """Windows spread evenly over a long record, about `seconds` in all; the record itself where
    it is short.
    """
    if record.duration <= 1.5 * seconds:
        return record
    keep = np.zeros(len(record), dtype=np.bool_)
    total = record.duration
    for part in record.segments():
        stamps = record.time[part]
        span = float(stamps[-1] - stamps[0])
        share = seconds * span / total
        count = max(1, round(share / WINDOW))
        width = min(share / count, span)
        for k in range(count):
            start = stamps[0] + (k + 0.5) * span / count - width / 2
            a, b = np.searchsorted(stamps, (start, start + width))
            keep[part.start + int(a) : part.start + int(b)] = True
    return record.take(
        keep, f"{int(keep.sum())} of {len(record)} samples, in windows spread over the record"
    )
