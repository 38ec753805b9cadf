"""Input and output records as the linear identification reads them: checked, and piece by piece."""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Protocol, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]
Chunk = tuple[npt.ArrayLike, npt.ArrayLike]

PIECE = 8192
# pieces of a mapped file read before its pages are given back
_PIECES_KEPT = 64


class Source(Protocol):
    """Records that can be read several times, a piece at a time."""

    @property
    def lengths(self) -> tuple[int, ...]:
        """Samples in each record."""

    @property
    def channels(self) -> tuple[int, int]:
        """Number of inputs and of outputs."""

    def pieces(self, record: int, start: int, stop: int) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Inputs and outputs of the samples `start` to `stop` of one record, in order."""


@final
class ArraySource:
    """Records held in arrays or in memory-mapped files."""

    def __init__(self, u: object, y: object) -> None:
        inputs, outputs = _as_records(u, "u"), _as_records(y, "y")
        if len(inputs) != len(outputs):
            raise InputError(
                f"u has {len(inputs)} records and y has {len(outputs)}: give as many of each"
            )
        for index, (one, other) in enumerate(zip(inputs, outputs, strict=True)):
            if len(one) != len(other):
                raise InputError(
                    f"record {index}: u has {len(one)} samples and y has {len(other)}: cut both "
                    "to the same time span"
                )
            if one.shape[1] != inputs[0].shape[1] or other.shape[1] != outputs[0].shape[1]:
                raise InputError(
                    f"record {index}: its channels differ from record 0: give all the same channels"
                )
        self._inputs = inputs
        self._outputs = outputs
        self.lengths = tuple(len(one) for one in inputs)
        self.channels = (inputs[0].shape[1], outputs[0].shape[1])

    def pieces(self, record: int, start: int, stop: int) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Inputs and outputs of the samples `start` to `stop` of one record, in order."""
        u, y = self._inputs[record], self._outputs[record]
        for index, first in enumerate(range(start, stop, PIECE), start=1):
            last = min(first + PIECE, stop)
            yield _numbers(u[first:last]), _numbers(y[first:last])
            if index % _PIECES_KEPT == 0:
                _release(u)
                _release(y)


@final
class ChunkSource:
    """Records read as chunks, each from a function that starts the reading anew.

    Parameters
    ----------
    openers : sequence of callables
        One per record. Each call returns a fresh iterable of ``(u, y)`` chunks,
        arrays of shape (samples, channels) in the order of time.
    """

    def __init__(self, openers: Sequence[Callable[[], Iterable[Chunk]]]) -> None:
        if not openers:
            raise InputError(
                "no record: give at least one function that returns the chunks of a record"
            )
        self._openers = tuple(openers)
        shapes: set[tuple[int, int]] = set()
        lengths = []
        for index in range(len(self._openers)):
            length = 0
            for u, y in self._chunks(index):
                shapes.add((u.shape[1], y.shape[1]))
                length += len(u)
            lengths.append(length)
        if not shapes:
            raise InputError(
                "the records hold no chunk: return at least one (u, y) pair per record"
            )
        if len(shapes) != 1:
            raise InputError(
                f"the chunks have {len(shapes)} different channel counts: give all the same "
                "channels"
            )
        self.lengths = tuple(lengths)
        self.channels = shapes.pop()

    def pieces(self, record: int, start: int, stop: int) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Inputs and outputs of the samples `start` to `stop` of one record, in order."""
        first = 0
        for u, y in self._chunks(record):
            low, high = max(start - first, 0), min(stop - first, len(u))
            for begin in range(low, high, PIECE):
                end = min(begin + PIECE, high)
                yield u[begin:end], y[begin:end]
            first += len(u)
            if first >= stop:
                return
        if first < stop:
            raise InputError(
                f"record {record} gave {first} samples when read again, {self.lengths[record]} "
                "before: let its function start the reading anew at every call"
            )

    def _chunks(self, record: int) -> Iterator[tuple[FloatArray, FloatArray]]:
        for raw_u, raw_y in self._openers[record]():
            u, y = (
                _two_dimensional(np.asarray(raw_u), "u"),
                _two_dimensional(np.asarray(raw_y), "y"),
            )
            if len(u) != len(y):
                raise InputError(
                    f"record {record}: a chunk has {len(u)} samples of u, {len(y)} of y: cut "
                    "both alike"
                )
            yield _numbers(u), _numbers(y)


def check_finite(values: FloatArray, name: str, first_sample: int) -> None:
    """Raise InputError at the first value that is NaN or infinite."""
    if not np.isfinite(values).all():
        row, channel = np.argwhere(~np.isfinite(values))[0]
        raise InputError(
            f"{name} channel {channel} holds {values[row, channel]} at sample "
            f"{first_sample + row}: repair or cut this part of the record"
        )


def check_varies(low: FloatArray, high: FloatArray, name: str) -> None:
    """Raise InputError for the first channel whose lowest and highest values agree."""
    for channel, (least, most) in enumerate(zip(low, high, strict=True)):
        if least == most:
            raise InputError(
                f"{name} channel {channel} is constant at {least:g}: leave this channel out"
            )


def whole_records(source: Source) -> list[tuple[FloatArray, FloatArray]]:
    """Every record in memory, checked for NaN and for constant channels."""
    records = []
    for index, length in enumerate(source.lengths):
        parts = list(source.pieces(index, 0, length))
        if not parts:
            raise InputError(f"record {index} is empty: leave it out")
        u, y = (
            np.concatenate([part[0] for part in parts]),
            np.concatenate([part[1] for part in parts]),
        )
        check_finite(u, f"record {index}: u", 0)
        check_finite(y, f"record {index}: y", 0)
        records.append((u, y))
    for name, side in (("u", 0), ("y", 1)):
        low = np.min([record[side].min(axis=0) for record in records], axis=0)
        high = np.max([record[side].max(axis=0) for record in records], axis=0)
        check_varies(low, high, name)
    return records


def _as_records(values: object, name: str) -> list[npt.NDArray[np.generic]]:
    if isinstance(values, (list, tuple)):
        if not values:
            raise InputError(f"{name} holds no record: give an array or a list of arrays")
        if all(isinstance(item, np.ndarray) and item.ndim > 0 for item in values):
            return [_two_dimensional(item, name) for item in values]
    try:
        array = np.asanyarray(values)
    except ValueError as error:
        raise InputError(
            f"{name} cannot be read as an array: give shape (samples, channels)"
        ) from error
    return [_two_dimensional(array, name)]


def _release(array: npt.NDArray[np.generic]) -> None:
    """Give back the memory pages of a file mapped for reading; they can be read again."""
    if not isinstance(array, np.memmap) or array.mode not in ("r", "r+"):
        return
    base: object = array
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


def _two_dimensional(array: npt.NDArray[np.generic], name: str) -> npt.NDArray[np.generic]:
    if array.dtype.kind not in "fiub":
        raise InputError(f"{name} has values of type {array.dtype}: give real numbers")
    if array.ndim == 1:
        return array.reshape(-1, 1)
    if array.ndim != 2 or array.shape[1] == 0:
        raise InputError(f"{name} has shape {array.shape}: give shape (samples, channels)")
    return array


def _numbers(array: npt.NDArray[np.generic]) -> FloatArray:
    return np.asarray(array, dtype=np.float64)
