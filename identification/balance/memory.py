"""What was made of a record, kept for those that asked last: prepared rows, internal states of
memory laws, residuals.
"""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Mapping
from typing import Any, Final, Generic, TypeVar, final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
T = TypeVar("T")

MOST: Final = 4_000_000
"""Values of each kind that a thread keeps (32 MB)."""

NUMBERS: Final = 2000
"""Single numbers that a thread keeps."""

SOLUTIONS: Final = 100
"""Fits that a thread keeps."""

_kept = threading.local()


def states_of(record: Any, law: Hashable, make: Callable[[], FloatArray]) -> FloatArray:
    """States along a record, from memory where the same law with the same values was followed there
    before.

    One fit or assessment follows a memory law along every record several times: for the residual,
    its Jacobian, the weights and the noise floor. Amplitudes and friction change between them, the
    law's own values often do not.

    Parameters
    ----------
    record : object
        The record; held weakly, known by identity.
    law : hashable
        What the states depend on beside the record: structure of the model, values of its
        parameters.
    make : callable
        Gives the states, (states, points).

    Returns
    -------
    (states, points) array, read-only
    """
    return _array("states", record, law, make)


def residuals_of(record: Any, law: Hashable, make: Callable[[], FloatArray]) -> FloatArray:
    """Residuals of a record's rows, from memory where the same balances were evaluated there with
    the same values.

    An assessment asks for them under several heads: the error itself, what noise may leave of it,
    and how the rows are weighted; and it follows a fit that ended at the same values.

    Parameters
    ----------
    record : object
        The record; held weakly, known by identity.
    law : hashable
        The balances, and the values of all parameters.
    make : callable
        Gives the residuals, (rows, balances).

    Returns
    -------
    (rows, balances) array, read-only
    """
    return _array("residuals", record, law, make)


def numbers_of(
    record: Any, law: Hashable, make: Callable[[], Mapping[str, float]]
) -> Mapping[str, float]:
    """Numbers fitted on one record alone, from memory where the same ones were asked for there.

    Parameters
    ----------
    record : object
        The record; held weakly, known by identity.
    law : hashable
        What they depend on beside the record.
    make : callable
        Gives them by name.
    """

    def made() -> tuple[Mapping[str, float], int]:
        numbers = make()
        return numbers, len(numbers)

    found: Mapping[str, float] = cache_of("numbers").get(record, law, made, NUMBERS)
    return found


def solution_of(data: Any, law: Hashable, make: Callable[[], T]) -> T:
    """A fit to a dataset, from memory where the same one was asked for there.

    Parameters
    ----------
    data : object
        The dataset; held weakly, known by identity.
    law : hashable
        The model, and all that the fit starts from.
    make : callable
        Gives the fit.
    """
    found: T = cache_of("solutions").get(data, law, lambda: (make(), 1), SOLUTIONS)
    return found


@final
class Law:
    """What an array depends on beside the record, hashed once: structures of a model are long."""

    __slots__ = ("_hash", "_parts")

    def __init__(self, *parts: Hashable) -> None:
        self._parts = parts
        self._hash = hash(parts)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (
            isinstance(other, Law) and self._hash == hash(other) and self.parts == other.parts
        )

    @property
    def parts(self) -> tuple[Hashable, ...]:
        """What it was made from."""
        return self._parts


@final
class Cache(Generic[T]):
    """Values by record and law, those of records that are gone dropped, and the oldest where they
    take too much room.
    """

    def __init__(self) -> None:
        self.kept: OrderedDict[Hashable, tuple[weakref.ref[Any], T, int]] = OrderedDict()
        self.size = 0
        self._gone: deque[Hashable] = deque()
        """Keys of records that are gone; noted by whichever thread let go of them."""

    def get(self, record: Any, law: Hashable, make: Callable[[], tuple[T, int]], most: int) -> T:
        """The value kept for this very record, or a new one; `make` gives it and its size."""
        while self._gone:
            old = self.kept.get(key := self._gone.popleft())
            if old is not None and old[0]() is None:  # else another record has its place by now
                self.size -= self.kept.pop(key)[2]
        key = (id(record), law)
        found = self.kept.get(key)
        if found is not None and found[0]() is record:
            self.kept.move_to_end(key)
            return found[1]
        made, size = make()
        old = self.kept.pop(key, None)
        self.size += size - (old[2] if old is not None else 0)
        gone = self._gone
        self.kept[key] = (weakref.ref(record, lambda _: gone.append(key)), made, size)
        while self.size > most and self.kept:
            self.size -= self.kept.popitem(last=False)[1][2]
        return made


def cache_of(kind: str) -> Cache[Any]:
    """What this thread keeps of one kind."""
    found: Cache[Any] = _kept.__dict__.setdefault(kind, Cache())
    return found


def _array(kind: str, record: Any, law: Hashable, make: Callable[[], FloatArray]) -> FloatArray:
    def made() -> tuple[FloatArray, int]:
        values = make()
        values.flags.writeable = False
        return values, values.size

    found: FloatArray = cache_of(kind).get(record, law, made, MOST)
    return found


__all__ = ["Cache", "Law", "cache_of", "numbers_of", "residuals_of", "solution_of", "states_of"]
