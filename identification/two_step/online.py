"""Parts of the on-line two-step algorithm: settings, modes, a search that runs in portions, the
sample window.
"""

from __future__ import annotations

import json
import struct
import threading
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, Generic, Literal, TypeVar, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]
T = TypeVar("T")

_MAGIC: Final = b"TWOSTEP1"
_HEAD: Final = struct.Struct("<8sIII")


class Mode(Enum):
    """What the on-line algorithm does now; the value is the sentence a user reads."""

    COLLECTING = "Collecting the first window of measurements."
    STARTING = "Fitting the first window."
    RECURSIVE = "Linear parameters follow the measurements; nonlinear ones are frozen."
    CONFIRMING = (
        "The error is over its limit; collecting samples to see whether linear "
        "parameters explain it."
    )
    REOPTIMISING = "Searching the nonlinear parameters on the last window."

    def __str__(self) -> str:
        """Return the sentence."""
        return self.value


@final
@dataclass(frozen=True)
class Event:
    """One change of mode.

    Attributes
    ----------
    sample : int
        Samples seen so far.
    mode : Mode
        The mode from here on.
    why : str
        One sentence.
    """

    sample: int
    mode: Mode
    why: str


@final
@dataclass(frozen=True)
class OnlineSettings:
    """Tuning of the on-line algorithm (thesis 3.7); every default is a working one.

    Attributes
    ----------
    sample_time
        Seconds between samples.
    collect_seconds
        Length of the first window; 7 s in the thesis.
    collect_limit_seconds
        The window moves on while the regressor lacks rank, until this time; the parameters that are
        not determined are held then.
    rank_limit
        Singular-value limit of the scaled regressor, relative to the largest.
    error_seconds
        Time constant of the error norm.
    error_limit
        Error norm at which samples are collected for a decision; 1 is the noise of the first fit.
    confirm_seconds
        How many seconds of samples decide whether linear parameters explain the error.
    confirm_limit
        The nonlinear parameters are searched where the best linear fit of these samples leaves more
        than this many times the noise.
    rest_seconds
        No decision for this long after one.
    passes
        Searches in a row that may fail before the fall-back, a local simplex over all shape
        parameters.
    window_samples
        A search uses at most this many samples of the window (every k-th).
    search
        "budget": each step makes `evaluations_per_step` evaluations of the objective, so that runs
        repeat exactly; "background": in a thread, a step never waits; "blocking": the whole search
        in one step.
    evaluations_per_step
        For "budget".
    """

    sample_time: float = 1e-3
    collect_seconds: float = 7.0
    collect_limit_seconds: float = 30.0
    rank_limit: float = 1e-6
    error_seconds: float = 0.1
    error_limit: float = 1.5
    confirm_seconds: float = 3.0
    confirm_limit: float = 1.15
    rest_seconds: float = 1.0
    passes: int = 2
    window_samples: int = 2000
    search: Literal["budget", "background", "blocking"] = "budget"
    evaluations_per_step: int = 1

    def __post_init__(self) -> None:
        positive = (
            "sample_time",
            "collect_seconds",
            "error_seconds",
            "error_limit",
            "confirm_seconds",
            "confirm_limit",
            "passes",
            "window_samples",
            "evaluations_per_step",
        )
        for name in positive:
            if not getattr(self, name) > 0:
                raise InputError(
                    f"on-line settings: {name} must be positive, not {getattr(self, name)!r}"
                )
        if self.search not in ("budget", "background", "blocking"):
            raise InputError(
                f"on-line settings: search {self.search!r}; use 'budget', 'background' or "
                "'blocking'"
            )

    def samples(self, seconds: float) -> int:
        """Number of samples in a time."""
        return max(1, round(seconds / self.sample_time))


class Cancelled(BaseException):
    """Ends the worker of a search that nobody waits for."""


@final
class PortionedTask(Generic[T]):
    """A function that runs in a thread, a given number of evaluations at a time.

    Parameters
    ----------
    function : callable
        Gets `tick`, which it calls before each evaluation; returns the result.
    free : bool
        True: run without waiting for :meth:`advance`.
    """

    def __init__(self, function: Callable[[Callable[[], None]], T], *, free: bool) -> None:
        self.granted = 0
        self._allowance, self._free, self._cancelled = 0, free, False
        self._done, self._waiting = False, False
        self._result: T | None = None
        self._error: Exception | None = None
        self._turn = threading.Condition()
        self._thread = threading.Thread(target=self._work, args=(function,), daemon=True)
        self._thread.start()

    def _work(self, function: Callable[[Callable[[], None]], T]) -> None:
        try:
            self._result = function(self._tick)
        except Cancelled:
            pass
        except Exception as error:  # handed to the caller by result()
            self._error = error
        with self._turn:
            self._done = True
            self._turn.notify_all()

    def _tick(self) -> None:
        with self._turn:
            if self._cancelled:
                raise Cancelled
            if self._free:
                return
            while self._allowance <= 0:
                self._waiting = True
                self._turn.notify_all()
                self._turn.wait()
                if self._cancelled:
                    raise Cancelled
            self._waiting = False
            self._allowance -= 1

    def advance(self, evaluations: int) -> bool:
        """Let the function make more evaluations and wait for them; True when it has ended."""
        with self._turn:
            if self._free or self._done:
                return self._done
            self.granted += evaluations
            self._allowance += evaluations
            self._waiting = False
            self._turn.notify_all()
            self._turn.wait_for(lambda: self._done or (self._waiting and self._allowance <= 0))
            return self._done

    def finished(self) -> bool:
        """True when the function has ended; does not wait."""
        with self._turn:
            return self._done

    def result(self) -> T:
        """What the function returned; its error is raised here."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        if self._result is None:
            raise RuntimeError("the search was cancelled")
        return self._result

    def cancel(self) -> None:
        """End the worker at its next evaluation."""
        with self._turn:
            self._cancelled = True
            self._turn.notify_all()
        self._thread.join()


@final
class Window:
    """The last samples, in order: outputs and signals."""

    def __init__(self, length: int, outputs: int, channels: int) -> None:
        self.length = length
        self.rows = np.zeros((2 * length, outputs + channels))
        self.outputs = outputs
        self.end = 0
        self.count = 0

    def add(self, y: FloatArray, signals: FloatArray) -> None:
        """Append one sample; the oldest falls out."""
        if self.end == len(self.rows):
            self.rows[: self.length] = self.rows[self.length :].copy()
            self.end = self.length
        row = self.rows[self.end]
        row[: self.outputs] = y
        row[self.outputs :] = signals
        self.end += 1
        self.count = min(self.count + 1, self.length)

    def last(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Copies of the last samples: (y, signals)."""
        rows = self.rows[self.end - min(count, self.count) : self.end].copy()
        return rows[:, : self.outputs], rows[:, self.outputs :]

    def all_rows(self) -> FloatArray:
        """The samples held, (count, outputs + channels)."""
        return self.rows[self.end - self.count : self.end].copy()

    def load(self, rows: FloatArray) -> None:
        """Hold these samples instead."""
        self.count = self.end = len(rows)
        self.rows[: self.end] = rows


def pack(
    numbers: Mapping[str, Any], arrays: Mapping[str, FloatArray], parts: Mapping[str, bytes]
) -> bytes:
    """Bytes of a state: JSON (floats as hexadecimal text keep every bit), arrays and byte
    strings.
    """
    described = {k: list(v.shape) for k, v in arrays.items()}
    text = json.dumps(
        {"numbers": numbers, "arrays": described, "parts": {k: len(v) for k, v in parts.items()}}
    )
    body = b"".join(
        np.ascontiguousarray(v, dtype="<f8").tobytes() for v in arrays.values()
    ) + b"".join(parts.values())
    head = text.encode()
    return _HEAD.pack(_MAGIC, len(head), len(body), zlib.crc32(head + body)) + head + body


def unpack(state: bytes) -> tuple[dict[str, Any], dict[str, FloatArray], dict[str, bytes]]:
    """What :func:`pack` packed.

    Raises
    ------
    InputError
        The bytes are damaged or no state of this kind.
    """
    if len(state) < _HEAD.size or state[:8] != _MAGIC:
        raise InputError(
            "restore: these bytes are no state of a two-step estimator; give what state() returned"
        )
    _, head, body, crc = _HEAD.unpack_from(state)
    rest = bytes(state[_HEAD.size :])
    if len(rest) != head + body or zlib.crc32(rest) != crc:
        raise InputError("restore: the state is damaged; give the bytes that state() returned")
    described = json.loads(rest[:head])
    at = head
    arrays, parts = {}, {}
    for name, shape in described["arrays"].items():
        size = 8 * int(np.prod(shape))
        arrays[name] = np.frombuffer(rest[at : at + size], dtype="<f8").reshape(shape).copy()
        at += size
    for name, size in described["parts"].items():
        parts[name] = rest[at : at + size]
        at += size
    return described["numbers"], arrays, parts
