"""Line search by safeguarded interpolation with few samples."""

from __future__ import annotations

import math
from bisect import bisect_left
from typing import final

from identification.search.evaluate import Evaluator
from identification.search.numeric import (
    GOLDEN,
    Vector,
    cubic_roots,
    divided_differences,
    newton_to_power,
    slope_and_curvature,
)

_SMALL = 0.1
"""Closest distance to a known sample, as a fraction of the interval around it."""

_FAR = 4.0
"""Times its neighbour's distance from which a best sample is far beyond it: a third of the way is
then still beyond.
"""

_START_SAMPLES = 5
"""Samples taken before the search refines around the best one."""


@final
class LineSearch:
    """Search along ``x + alpha p`` inside the box, from samples that are already known.

    Parameters
    ----------
    evaluate : Evaluator
        The objective with its box.
    x, p : lists, shape (n,)
        Origin and direction; `p` has at least one component that is not zero.
    alphas, values : lists
        Known samples, at least one; `alphas` ascending.

    Notes
    -----
    After `run`, `alphas` and `values` hold all samples, ascending in alpha. The search first
    spreads to five samples (parabolas where they are convex, wider steps where they are not), then
    tries one quartic step, then refines around the best sample until a new point would coincide
    with a known one.
    """

    __slots__ = (
        "_closest",
        "_evaluate",
        "_from_one",
        "_high",
        "_low",
        "_origin",
        "_p",
        "_scale",
        "alphas",
        "values",
    )

    def __init__(
        self, evaluate: Evaluator, x: Vector, p: Vector, alphas: Vector, values: Vector
    ) -> None:
        self._evaluate = evaluate
        self._origin = x
        self._p = p
        self.alphas = alphas
        self.values = values
        self._from_one = len(alphas) == 1
        low, high, scale = -math.inf, math.inf, math.inf
        for c, d, lo, hi in zip(x, p, evaluate.low, evaluate.high, strict=True):
            if d == 0.0:
                continue
            first, second = (lo - c) / d, (hi - c) / d
            low = max(low, min(first, second))
            high = min(high, max(first, second))
            scale = min(scale, abs(c / d) if c != 0.0 else abs(1.0 / d))
        self._low, self._high, self._scale = low, high, scale
        self._closest = 1e-13 * (high - low)

    def run(self, limit: int) -> int:
        """Search until settled or `limit` samples are known; return the index of the best
        sample.
        """
        if self._low < self._high and self._start(limit):
            self._refine(limit)
        return self.best()

    def best(self) -> int:
        """Return the index of the best sample; the first of equals."""
        values = self.values
        return values.index(min(values))

    def _add(self, alpha: float) -> bool:
        """Sample at `alpha`; False where there is a sample already, as near as floating point
        goes.
        """
        if not math.isfinite(alpha):
            return False
        alpha = min(max(alpha, self._low), self._high)
        where = bisect_left(self.alphas, alpha)
        if any(
            abs(alpha - known) <= self._closest
            for known in self.alphas[max(where - 1, 0) : where + 1]
        ):
            return False
        value = self._evaluate([c + alpha * d for c, d in zip(self._origin, self._p, strict=True)])
        self.alphas.insert(where, alpha)
        self.values.insert(where, value)
        return True

    def _guard(self, alpha: float) -> float:
        """Keep a predicted point off the known end samples and within ten widths of them."""
        a = self.alphas
        width = a[-1] - a[0]
        alpha = min(
            max(alpha, a[0] - width / _SMALL, self._low), a[-1] + width / _SMALL, self._high
        )
        first, last = a[1] - a[0], a[-1] - a[-2]
        if abs(alpha - a[0]) < _SMALL * first:
            return a[0] + first / 3.0
        if abs(alpha - a[-1]) < _SMALL * last:
            return a[-1] - last / 3.0
        return alpha

    def _start(self, limit: int) -> bool:
        """Spread to five samples and one quartic step; False where the search is over."""
        a = self.alphas
        if a[-1] - a[0] <= self._scale and len(a) < min(limit, 3):
            up = self._high - a[-1] >= a[0] - self._low
            self._add(a[-1] + self._scale if up else a[0] - self._scale)
        while len(a) < min(limit, _START_SAMPLES):
            if not (self._widen() if len(a) < 3 else self._parabola_or_widen()):
                break
            if len(a) > 3 and self._monotone_to_bound():
                return False
        if len(a) >= limit or len(a) < _START_SAMPLES:
            return False
        if len(self._minima()) == 1:
            if self._convex():
                return not self._descent_check()
            self._quartic()
        return len(a) < limit

    def _monotone_to_bound(self) -> bool:
        best = self.best()
        if best == 0 and self.alphas[0] <= self._low:
            return all(self.values[j] <= self.values[j + 1] for j in range(len(self.values) - 1))
        if best == len(self.values) - 1 and self.alphas[-1] >= self._high:
            return all(self.values[j] >= self.values[j + 1] for j in range(len(self.values) - 1))
        return False

    def _minima(self) -> list[int]:
        f = self.values
        last = len(f) - 1
        found = [
            j
            for j in range(last + 1)
            if (j == 0 or f[j] <= f[j - 1]) and (j == last or f[j] < f[j + 1])
        ]
        return found or [self.best()]

    def _middle(self) -> int:
        """Index of the middle one of the three samples around the best."""
        return min(max(self.best(), 1), len(self.alphas) - 2)

    def _parabola(self) -> float | None:
        """Minimiser of the parabola through the samples around the best; None where it is not
        convex.
        """
        j = self._middle()
        a, f = self.alphas, self.values
        slope, curvature = slope_and_curvature(a[j], f[j], a[j - 1], f[j - 1], a[j + 1], f[j + 1])
        if not 0.0 < curvature < math.inf or not math.isfinite(slope):
            return None
        return a[j] - slope / curvature

    def _parabola_or_widen(self) -> bool:
        place = self._parabola()
        if place is None:
            return self._widen()
        place = self._guard(place)
        j = self._middle()
        a = self.alphas
        if min(abs(place - c) for c in a) < _SMALL * (a[j + 1] - a[j - 1]):
            place = self._bisect_next_to_best()
        return self._add(place)

    def _bisect_next_to_best(self) -> float:
        a, i = self.alphas, self.best()
        left = a[i] - a[i - 1] if i > 0 else 0.0
        right = a[i + 1] - a[i] if i < len(a) - 1 else 0.0
        return a[i] - 0.5 * left if left > right else a[i] + 0.5 * right

    def _widen(self) -> bool:
        """Extrapolate at a promising free end, or split the widest interval near the best
        sample.
        """
        a, f = self.alphas, self.values
        if len(a) == 1:
            return self._add(self._high if self._high - a[0] >= a[0] - self._low else self._low)
        width = a[-1] - a[0]
        median = sorted(f)[len(f) // 2]
        ends = []
        if a[0] > self._low and (self._from_one or f[0] < max(median, f[1])):
            ends.append((f[0], a[0] - (width if self._from_one else a[1] - a[0]) / _SMALL))
        if a[-1] < self._high and (self._from_one or f[-1] < max(median, f[-2])):
            ends.append((f[-1], a[-1] + (width if self._from_one else a[-1] - a[-2]) / _SMALL))
        if ends and self._add(min(ends)[1]):
            return True
        i = self.best()
        ratio, widest = -1.0, 0
        for j in range(len(a) - 1):
            far = max(abs(a[j] - a[i]), abs(a[j + 1] - a[i]))
            length = a[j + 1] - a[j]
            score = length / far + 1e-3 * length / width
            if score > ratio:
                ratio, widest = score, j
        share = 1.0 - GOLDEN if f[widest] <= f[widest + 1] else GOLDEN
        return self._add(a[widest] + share * (a[widest + 1] - a[widest]))

    def _convex(self) -> bool:
        a, f = self.alphas, self.values
        slopes = [(f[j + 1] - f[j]) / (a[j + 1] - a[j]) for j in range(len(a) - 1)]
        return all(slopes[j] <= slopes[j + 1] for j in range(len(slopes) - 1))

    def _quartic(self) -> bool:
        """Sample at a minimiser of the quartic through the five samples."""
        a, f = self.alphas, self.values
        centre, width = a[self.best()], a[-1] - a[0]
        points = [(c - centre) / width for c in a]
        newton = divided_differences(points, f)
        if not 0.0 <= newton[-1] < math.inf or not all(map(math.isfinite, newton)):
            return self._local_step()
        power = newton_to_power(points, newton)
        roots = cubic_roots(power[1], 2.0 * power[2], 3.0 * power[3], 4.0 * power[4])
        minima = roots[::2] if len(roots) == 3 else roots
        if not minima:
            return self._local_step()

        def height(t: float) -> float:
            return power[0] + t * (power[1] + t * (power[2] + t * (power[3] + t * power[4])))

        outside = [t for t in minima if not points[0] <= t <= points[-1] and height(t) < max(f)]
        place = min(outside or minima, key=height)
        return self._add(self._guard(centre + place * width))

    def _descent_check(self) -> bool:
        """Look closer to the origin where the best sample is the origin itself or far beyond
        its neighbour.
        """
        a, f = self.alphas, self.values
        if 0.0 not in a:
            return False
        i = self.best()
        if a[i] == 0.0:
            left = -a[i - 1] if i > 0 else 0.0
            right = a[i + 1] if i < len(a) - 1 else 0.0
            return self._add(-left / 3.0 if left > right else right / 3.0)
        inner = a[i - 1] if a[i] > 0.0 else a[i + 1]
        if inner == 0.0 or (abs(a[i]) >= _FAR * abs(inner) and f[i] < f[a.index(0.0)]):
            return self._add(a[i] / 3.0)
        return False

    def _local_step(self) -> bool:
        """Sample at the minimiser of the local interpolant; False where that is a known place."""
        a = self.alphas
        i = self.best()
        place = self._parabola()
        place = self._bisect_next_to_best() if place is None else self._guard(self._cubic(place))
        reach = a[min(i + 1, len(a) - 1)] - a[max(i - 1, 0)]
        near = min(abs(place - c) for c in a) < _SMALL * reach
        return self._add(place) and not near

    def _cubic(self, place: float) -> float:
        """Improve the parabola's minimiser by the cubic through four neighbouring samples."""
        a, f = self.alphas, self.values
        j = self._middle()
        if len(a) < 4:
            return place
        left = j - 2 >= 0 and (j + 2 >= len(a) or a[j] - a[j - 2] < a[j + 2] - a[j])
        first = j - 2 if left else j - 1
        points = [c - a[j] for c in a[first : first + 4]]
        power = newton_to_power(points, divided_differences(points, f[first : first + 4]))
        lower, upper = a[j - 1] - a[j], a[j + 1] - a[j]
        for t in quadratic_minimum(power):
            if lower < t < upper:
                return a[j] + t
        return place

    def _refine(self, limit: int) -> None:
        """Refine around the best sample until it is settled."""
        while len(self.alphas) < limit:
            before = len(self.alphas)
            self._descent_check()
            if len(self.alphas) >= limit:
                return
            if not self._local_step() and len(self.alphas) >= before:
                return


def quadratic_minimum(power: Vector) -> Vector:
    """Return the place of the local minimum of a cubic, given by power coefficients; empty
    where there is none.
    """
    _, b, c, d = power
    if d == 0.0:
        return [-b / (2.0 * c)] if c > 0.0 else []
    disc = c * c - 3.0 * b * d
    if not 0.0 < disc < math.inf:
        return []
    root = math.sqrt(disc)
    # the root with positive second derivative, written so that nothing cancels
    return [-b / (c + root)] if c >= 0.0 else [(root - c) / (3.0 * d)]
