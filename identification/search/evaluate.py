"""The objective as the search sees it: clipped, counted, remembered, always finite."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, final

import numpy as np

from identification.errors import InputError
from identification.search.numeric import Vector
from identification.search.types import FloatArray, MCSOutcome

NOT_FINITE = 1e300
"""Stands in for a value that is not finite while no finite value is known."""


@final
class SearchStopped(Exception):  # noqa: N818 - a signal, not an error
    """Leaves the search from any depth; never seen by the caller of `mcs`."""

    def __init__(self, outcome: MCSOutcome) -> None:
        self.outcome = outcome


@final
class Evaluator:
    """Counts the calls, keeps the best point and stops the search at the target or the limit.

    A point asked for twice is answered from memory. A value that is not finite is replaced by one
    that is worse than every finite value so far, so that interpolation stays usable.
    """

    def __init__(
        self,
        fun: Callable[[FloatArray], Any],
        low: Vector,
        high: Vector,
        target: float,
        max_evaluations: int,
    ) -> None:
        self._fun = fun
        self.low = low
        self.high = high
        self._target = target
        self._limit = max_evaluations
        self.known: dict[tuple[float, ...], float] = {}
        """Value of every point asked for so far."""
        self._failed: set[tuple[float, ...]] = set()
        self._worst = -math.inf
        self.count = 0
        self.best = math.inf
        self.best_x: Vector = []
        self.sweep = 0
        self.best_sweep = 0

    def __call__(self, x: Vector) -> float:
        """Return the objective at `x`, clipped to the box."""
        return self.inside(
            tuple(
                [
                    lo if c < lo else hi if c > hi else c
                    for c, lo, hi in zip(x, self.low, self.high, strict=True)
                ]
            )
        )

    def inside(self, key: tuple[float, ...]) -> float:
        """Return the objective at a point that is known to lie in the box."""
        known = self.known.get(key)
        if known is not None:
            return known
        value = self._call(key)
        self.count += 1
        if not self.best_x:
            self.best_x = list(key)
        if not math.isfinite(value):
            self._failed.add(key)
            value = self._substitute()
        else:
            self._worst = max(self._worst, value)
            if value < self.best:
                self.best = value
                self.best_x = list(key)
                self.best_sweep = self.sweep
        self.known[key] = value
        if self.best <= self._target:
            raise SearchStopped(MCSOutcome.TARGET)
        if self.count >= self._limit:
            raise SearchStopped(MCSOutcome.EVALUATIONS)
        return value

    @property
    def not_finite(self) -> int:
        """Number of calls that gave no finite value."""
        return len(self._failed)

    def failed(self, x: tuple[float, ...]) -> bool:
        """Return whether the objective was tried at `x` and was not finite."""
        return x in self._failed

    def _substitute(self) -> float:
        if self._worst == -math.inf:
            return NOT_FINITE
        return min(
            self._worst + max(self._worst - self.best, 1e-3 * abs(self._worst), 1e-300), NOT_FINITE
        )

    def _call(self, key: tuple[float, ...]) -> float:
        point = np.array(key)
        try:
            value = self._fun(point)
        except Exception as error:
            error.add_note(
                f"mcs: raised by the objective at evaluation {self.count + 1}, x = {list(key)}"
            )
            raise
        if type(value) is float:
            return value
        try:
            return float(value.item()) if isinstance(value, np.ndarray) else float(value)
        except (TypeError, ValueError):
            kind = (
                f"an array of shape {value.shape}"
                if isinstance(value, np.ndarray)
                else f"{value!r}"
            )
            raise InputError(
                f"mcs: the objective returned {kind} at x = {list(key)}; it must return one real "
                "number"
            ) from None
