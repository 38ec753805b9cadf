"""Signals a host feeds to an FMU: tables of samples, and faults laid over a signal."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]
Signal = Callable[[float], float]
Fault = Callable[[float, float], float]


@final
@dataclass(frozen=True)
class Table:
    """Samples as a function of time; the first and last value hold outside.

    Parameters
    ----------
    time : array, shape (n,)
        Increasing times in s.
    values : array, shape (n,)
        Samples in the unit of the variable.
    hold : bool
        True holds each value until the next sample, False joins them by straight lines.

    Raises
    ------
    InputError
        Where the lengths differ or the times do not increase.
    """

    time: FloatArray
    values: FloatArray
    hold: bool = True

    def __post_init__(self) -> None:
        time, values = np.asarray(self.time, dtype=float), np.asarray(self.values, dtype=float)
        if (
            time.ndim != 1
            or time.shape != values.shape
            or time.size == 0
            or not np.all(np.diff(time) > 0)
        ):
            raise InputError(
                "input table: time and values must be equally long, and the times must increase"
            )
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "values", values)

    def __call__(self, time: float) -> float:
        """Return the value at a time; at a sample the new one (the times carry rounding of up
        to 1e-9 of a step).
        """
        return float(self.sampled(np.array([time]))[0])

    def sampled(self, times: FloatArray) -> FloatArray:
        """Return the values at many times, shape (n,)."""
        if not self.hold:
            return np.interp(times, self.time, self.values)
        slack = 1e-9 * np.maximum(1.0, np.abs(times))
        places = np.searchsorted(self.time, times + slack, side="right") - 1
        found: FloatArray = self.values[np.maximum(places, 0)]
        return found


def constant(value: float) -> Signal:
    """Return a signal that stays at `value`."""
    return lambda _time: value


def bias(start: float, size: float, stop: float = math.inf) -> Fault:
    """Add `size` between `start` and `stop`."""
    return lambda time, value: value + size if start <= time < stop else value


def drift(start: float, rate: float) -> Fault:
    """Add a ramp of `rate` per second from `start` on."""
    return lambda time, value: value + rate * max(0.0, time - start)


def gain(start: float, factor: float) -> Fault:
    """Multiply by `factor` from `start` on."""
    return lambda time, value: value * factor if time >= start else value


def dropout(start: float, stop: float = math.inf) -> Fault:
    """Deliver NaN between `start` and `stop`."""
    return lambda time, value: math.nan if start <= time < stop else value


@final
@dataclass
class Stuck:
    """Hold the last value before `start` from then on."""

    start: float
    _last: float = field(default=math.nan, init=False)

    def __call__(self, time: float, value: float) -> float:
        """Return the value as it is, or the held one."""
        if time < self.start or math.isnan(self._last):
            self._last = value
        return self._last
