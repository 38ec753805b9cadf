"""ASAM MDF 3 and 4 measurement files, by asammdf."""

from __future__ import annotations

import contextlib
import tempfile
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from identification.data.read._table import RATES, Signal, Table, merged, missing_package
from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path


def open_mdf(path: Path) -> Table:
    """Open an MDF file: channels by name (``name@group`` where a name is used twice), time [s] as
    ``time``.

    Channel groups of other rates are interpolated linearly onto the stamps of the first channel
    used.

    Raises
    ------
    InputError
        If asammdf is missing, the file is damaged or holds no channel.
    """
    try:
        import asammdf
    except ImportError:
        raise missing_package("asammdf", "mdf", "MDF files", str(path)) from None
    try:
        with _opened(asammdf, path) as file:
            places, units = _channels(file)
    except MemoryError:
        raise
    except Exception as error:  # asammdf raises whatever its parser meets in a damaged file
        raise InputError(
            f"{path}: is not a readable MDF file ({type(error).__name__}): save it again"
        ) from None
    if not places:
        raise InputError(f"{path}: holds no channel: record again or give another file")

    def load(numeric: Sequence[str], text: Sequence[str]) -> Mapping[str, npt.NDArray[Any]]:
        wanted = [name for name in (*numeric, *text) if name != "time"] or [next(iter(places))]
        signals: dict[str, Signal] = {}
        for name, (stamps, values) in _signals(
            asammdf, path, {name: places[name] for name in wanted}
        ).items():
            if values.dtype.kind not in "fiub" or values.ndim != 1:
                raise InputError(
                    f"{path}: channel {name!r} is not a numeric signal: choose another"
                )
            signals[name] = Signal(stamps, values.astype(np.float64), str(places[name][0]))
        return merged(signals, [*numeric, *text], "time", str(path))

    groups = {group for group, _ in places.values()}
    return Table(
        "MDF", ("time", *places), load, {"time": "s", **units}, (RATES,) if len(groups) > 1 else ()
    )


@contextlib.contextmanager
def _opened(asammdf: Any, path: Path) -> Iterator[Any]:
    """The file as asammdf has it. Of one that its logger did not finish it makes a copy, which it
    leaves where the file cannot be read: that lies in a folder that goes.
    """
    with (
        tempfile.TemporaryDirectory(prefix="irj-", ignore_cleanup_errors=True) as folder,
        asammdf.MDF(path, temporary_folder=folder) as file,
    ):
        yield file


def _signals(
    asammdf: Any, path: Path, places: Mapping[str, tuple[int, int]]
) -> dict[str, tuple[npt.NDArray[np.float64], npt.NDArray[Any]]]:
    found = {}
    try:
        with _opened(asammdf, path) as file:
            for name, (group, index) in places.items():
                signal = file.get(group=group, index=index)
                found[name] = (
                    np.asarray(signal.timestamps, dtype=np.float64),
                    np.asarray(signal.samples),
                )
    except MemoryError:
        raise
    except Exception as error:  # asammdf raises whatever its parser meets in a damaged file
        raise InputError(f"{path}: is damaged ({type(error).__name__}): save it again") from None
    return found


def _channels(file: Any) -> tuple[dict[str, tuple[int, int]], dict[str, str]]:
    places: dict[str, tuple[int, int]] = {}
    units: dict[str, str] = {}
    for number, group in enumerate(file.groups):
        master = file.masters_db.get(number)
        for index, channel in enumerate(group.channels):
            if index == master:
                continue
            name = channel.name if channel.name not in places else f"{channel.name}@{number}"
            places[name] = (number, index)
            unit = (
                getattr(channel, "unit", "")
                or getattr(getattr(channel, "conversion", None), "unit", "")
                or ""
            )
            if unit:
                units[name] = str(unit)
    return places, units
