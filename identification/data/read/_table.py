"""What every format's reader hands over: named columns, loaded when asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]
RATES: Final = (
    "signals of other rates interpolated linearly onto the stamps of the first channel used"
)

Loader = Callable[[Sequence[str], Sequence[str]], Mapping[str, npt.NDArray[Any]]]
"""Takes the numeric columns and the text columns wanted; the first wanted one gives the time
base.
"""


@final
@dataclass(frozen=True)
class Table:
    """A file opened: its columns by name, loaded on demand.

    Attributes
    ----------
    reader : str
        Name of the format.
    names : tuple of str
        Columns of the file.
    units : mapping of str to str
        Units the file gives, by column, where it does.
    load : callable
        ``load(numeric, text)`` returns the columns, all of one length.
    notes : tuple of str
        What the reader did that a user should know.
    first_row : int
        Line or row number of the first sample, as a user counts it.
    left : mapping of str to str
        What of the file is no column, and why: ``"holds complex numbers"``.
    """

    reader: str
    names: tuple[str, ...]
    load: Loader
    units: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    first_row: int = 1
    left: Mapping[str, str] = field(default_factory=dict)


def missing_package(module: str, extra: str, what: str, where: str) -> InputError:
    """Return the error for a format whose package is not installed."""
    return InputError(
        f"{where}: reading {what} needs the package {module}: pip install irj[{extra}]"
    )


def vectors(arrays: Mapping[str, Any], where: str) -> dict[str, npt.NDArray[Any]]:
    """Make named vectors of one length from named arrays; a matrix gives one column each,
    ``name[0]``, ``name[1]``...

    Arrays of another length and scalars are left out, unless no two agree.

    Raises
    ------
    InputError
        If there is no numeric vector.
    """
    found: dict[str, npt.NDArray[Any]] = {}
    for name, value in arrays.items():
        array = np.asarray(value)
        if array.dtype.kind not in "fiubUS" or array.size == 0:
            continue
        if array.ndim == 2 and 1 in array.shape:
            array = array.reshape(-1)
        if array.ndim == 1:
            found[name] = array
        elif array.ndim == 2:
            long = array if array.shape[0] >= array.shape[1] else array.T
            found.update({f"{name}[{k}]": long[:, k] for k in range(long.shape[1])})
    if not found:
        raise InputError(
            f"{where}: holds no numeric vector: export time and channels as vectors of one length"
        )
    lengths = [array.size for array in found.values()]
    common = max(set(lengths), key=lambda n: (lengths.count(n), n))
    return {name: array for name, array in found.items() if array.size == common}


def from_arrays(
    reader: str, arrays: Mapping[str, Any], where: str, units: Mapping[str, str] | None = None
) -> Table:
    """Make a table of arrays that are in memory; what is no vector of numbers or texts, or of
    another length than the rest, is left out, with the reason.

    Raises
    ------
    InputError
        If there is no numeric vector.
    """
    columns = vectors(arrays, where)
    used = columns.keys() | {name.removesuffix("[0]") for name in columns}
    common = next(iter(columns.values())).size
    left = {
        name: _no_column(np.asarray(array), common)
        for name, array in arrays.items()
        if name not in used and np.size(array) > 1
    }

    def load(numeric: Sequence[str], text: Sequence[str]) -> Mapping[str, npt.NDArray[Any]]:
        return {name: columns[name] for name in (*numeric, *text)}

    return Table(reader, tuple(columns), load, units or {}, left=left)


def _no_column(array: npt.NDArray[Any], common: int) -> str:
    """Why an array is no column beside others of a length."""
    if array.dtype.kind == "c":
        return "holds complex numbers"
    if array.dtype.kind not in "fiubUS":
        return "holds neither numbers nor texts"
    if array.ndim > 2:
        return f"has {array.ndim} dimensions"
    return f"has {max(array.shape, default=1)} values where the rest has {common}"


Layout = tuple[tuple[int, ...], np.dtype[Any]]
"""Shape and type of an array that is still in its file."""


def on_demand(
    reader: str,
    layouts: Mapping[str, Layout],
    fetch: Callable[[Sequence[str]], Mapping[str, npt.NDArray[Any]]],
    where: str,
    units: Mapping[str, str] | None = None,
) -> Table:
    """Make a table of arrays that stay in their file until a column of them is asked for.

    Parameters
    ----------
    reader, where : str
        Name of the format; the file, for messages.
    layouts : mapping of str to (shape, dtype)
        The arrays of the file.
    fetch : callable
        Takes names of arrays and reads them; what it gives must have the layouts said.
    units : mapping of str to str, optional

    Raises
    ------
    InputError
        If there is no numeric vector.
    """
    stand_ins = {
        name: np.broadcast_to(np.zeros((), kind), shape) for name, (shape, kind) in layouts.items()
    }
    outline = from_arrays(reader, stand_ins, where, units)

    def load(numeric: Sequence[str], text: Sequence[str]) -> Mapping[str, npt.NDArray[Any]]:
        wanted = list(dict.fromkeys((*numeric, *text)))
        arrays = list(dict.fromkeys(n if n in layouts else n.rpartition("[")[0] for n in wanted))
        columns = vectors(fetch(arrays), where)
        return {name: columns[name] for name in wanted}

    return replace(outline, load=load)


@final
@dataclass(frozen=True)
class Signal:
    """One signal with its own time stamps, as loggers of several rates write it.

    Attributes
    ----------
    time, values : (m,) ndarray
        Stamps [s] and values.
    group : str
        What shares one time base: a channel group, a topic.
    """

    time: FloatArray
    values: FloatArray
    group: str


def merged(
    signals: Mapping[str, Signal], numeric: Sequence[str], base: str, where: str
) -> dict[str, npt.NDArray[Any]]:
    """Bring signals of several rates to one time base by linear interpolation.

    Parameters
    ----------
    signals : mapping of str to Signal
        The signals of the file.
    numeric : sequence of str
        Those wanted; ``base`` gives the stamps, from the group of the first wanted signal.
    base : str
        Name of the time column.
    where : str
        The file, for messages.

    Returns
    -------
    dict
        The wanted columns, limited to the time all of them cover.
    """
    wanted = [name for name in numeric if name != base]
    chosen = [signals[name] for name in wanted] or [next(iter(signals.values()))]
    stamps = chosen[0].time
    if len({signal.group for signal in chosen}) > 1:
        low = max(float(signal.time[0]) for signal in chosen)
        high = min(float(signal.time[-1]) for signal in chosen)
        stamps = stamps[(stamps >= low) & (stamps <= high)]
        if stamps.size == 0:
            raise InputError(
                f"{where}: the signals {', '.join(wanted)} have no time in common: choose others"
            )
    result: dict[str, npt.NDArray[Any]] = {base: stamps}
    for name in wanted:
        signal = signals[name]
        if signal.time.shape != stamps.shape and not (np.diff(signal.time) >= 0.0).all():
            raise InputError(f"{where}: the stamps of {name!r} run backwards: repair the log")
        same = signal.time.shape == stamps.shape and bool(np.array_equal(signal.time, stamps))
        result[name] = signal.values if same else np.interp(stamps, signal.time, signal.values)
    return result
