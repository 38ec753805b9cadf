"""Which candidates deserve a local search, and which of its results are new minima."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

from identification.search.evaluate import Evaluator
from identification.search.local import LocalSearch
from identification.search.numeric import Vector

_SAME = 1e-6
"""Distance, in widths of the box, below which two minima are taken as one."""


_CLEAR = 1e-6
"""Gain, relative to what the search gained so far, above which a local search was not at a
minimum.
"""


@final
@dataclass(slots=True)
class Minimum:
    """A point of the basket; `final` is False while another search from nearby may still
    improve it.
    """

    f: float
    x: Vector
    converged: bool
    final: bool


def _between(x: Vector, w: Vector, share: float) -> Vector:
    return [a + share * (b - a) for a, b in zip(x, w, strict=True)]


@final
class Basket:
    """The local minima found so far.

    Parameters
    ----------
    evaluate : Evaluator
        The objective with its box.
    local : LocalSearch or None
        None collects the candidates as they are.
    """

    def __init__(self, evaluate: Evaluator, local: LocalSearch | None) -> None:
        self._evaluate = evaluate
        self._local = local
        self._tried: set[tuple[float, ...]] = set()
        self.minima: list[Minimum] = []
        self.searches = 0
        self.calls = 0

    def offer(self, f: float, x: tuple[float, ...]) -> bool:
        """Take a candidate; return whether a local search was made from it."""
        if x in self._tried or self._evaluate.failed(x):
            return False
        self._tried.add(x)
        if self._local is None:
            self.minima.append(Minimum(f, list(x), False, False))
            return False
        before = self._evaluate.count
        searched = False
        try:
            start = self._survivor(f, list(x))
            while start is not None:
                searched = True
                self.searches += 1
                found, value, converged = self._local.run(start[1], start[0])
                start = self._keep(value, found, converged)
        finally:
            self.calls += self._evaluate.count - before
        return searched

    def close(self) -> list[Minimum]:
        """Return the minima, the lowest first, with the best point of the whole search at the
        head.
        """
        found = sorted(self.minima, key=lambda w: w.f)
        best, x = self._evaluate.best, self._evaluate.best_x
        if not math.isfinite(best) or (found and found[0].x == x):
            return found
        twin = next((w for w in found if self._distance(w.x, x) <= _SAME), None)
        head = Minimum(best, x, twin is not None and twin.converged, False)
        return [head, *(w for w in found if w is not twin)]

    def _by_distance(self, x: Vector) -> list[Minimum]:
        return sorted(self.minima, key=lambda w: self._distance(w.x, x))

    def _distance(self, x: Vector, w: Vector) -> float:
        """Distance with the widths of the box as units."""
        box = zip(x, w, self._evaluate.low, self._evaluate.high, strict=True)
        return math.hypot(*((a - b) / (hi - lo) for a, b, lo, hi in box))

    def _survivor(self, f: float, x: Vector) -> tuple[float, Vector] | None:
        """Return the candidate, or a better point met on the way; None where it slopes down to
        a known minimum.
        """
        for w in self._by_distance(x):
            if w.f > f or not w.final:
                continue
            if self._distance(w.x, x) <= _SAME:
                return None
            near = _between(x, w.x, 1.0 / 3.0)
            f_near = self._evaluate(near)
            if f_near > f:
                continue
            far = _between(x, w.x, 2.0 / 3.0)
            f_far = self._evaluate(far)
            if f_far > max(f_near, w.f):
                if f_near < f:
                    f, x = f_near, near
            elif min(f_near, f_far) < w.f:
                f, x = (f_near, near) if f_near < f_far else (f_far, far)
            else:
                return None
        return f, x

    def _keep(self, f: float, x: Vector, converged: bool) -> tuple[float, Vector] | None:
        """Add a minimum, or merge it with the known one of the same valley.

        Return a point between the two where that is clearly better than both: neither was a
        minimum, and the search goes on from there.
        """
        for w in self._by_distance(x):
            better = (f, x, converged) if f < w.f else (w.f, w.x, w.converged or converged)
            if self._distance(w.x, x) > _SAME:
                near = _between(x, w.x, 1.0 / 3.0)
                f_near = self._evaluate(near)
                if f_near > max(w.f, f):
                    continue
                far = _between(x, w.x, 2.0 / 3.0)
                f_far = self._evaluate(far)
                if f_far > max(f_near, w.f):
                    continue
                between = (f_near, near) if f_near <= f_far else (f_far, far)
                if between[0] < better[0]:
                    if self._clearly(better[0] - between[0]):
                        self.minima.remove(w)
                        return between
                    better = (*between, better[2])
            w.f, w.x, w.converged = better
            w.final = True
            return None
        self.minima.append(Minimum(f, x, converged, converged))
        return None

    def _clearly(self, gain: float) -> bool:
        """Return whether a gain matters beside what the search gained so far."""
        return self._local is not None and gain > _CLEAR * max(
            self._local.reference - self._evaluate.best, 0.0
        )
