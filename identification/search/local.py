"""Local search with a quadratic model built coordinate by coordinate."""

from __future__ import annotations

from typing import final

from identification.search.evaluate import Evaluator
from identification.search.line import LineSearch
from identification.search.numeric import (
    EPS,
    Matrix,
    Vector,
    minimise_quadratic,
    slope_and_curvature,
)

_COORDINATE_SAMPLES = 6
"""Samples of a line search along one coordinate, the known ones included."""

_STEP_SAMPLES = 15
"""Samples of a line search along a model step, the two known ones included."""

_TRUSTED = 0.1
"""Relative error of the predicted decrease up to which a model step is taken without a line
search.
"""

_POOR = 0.25
"""Part of the predicted decrease that is missing, or left, where the model is poor: the usual
quarter and three quarters of a trust region.
"""

_DIFFERENCE = EPS ** (1.0 / 3.0)
"""Relative spacing of the samples of a central difference."""


@final
class LocalModel:
    """Quadratic model ``f + g h + h G h / 2`` around the best point `x` of one local search.

    `x` and `f` always belong together: when a better sample is found the model is expanded around
    it anew.
    """

    __slots__ = ("_best", "_evaluate", "_pattern", "_shifts", "_where", "f", "g", "hessian", "x")

    def __init__(self, evaluate: Evaluator, pattern: list[list[bool]], x: Vector, f: float) -> None:
        n = len(x)
        self._evaluate = evaluate
        self._pattern = pattern
        self.x = list(x)
        self.f = f
        self.g: Vector = [0.0] * n
        self.hessian: Matrix = [[0.0] * n for _ in range(n)]
        # offsets from x of the two other samples of each coordinate
        self._shifts: list[tuple[float, float]] = [(0.0, 0.0)] * n
        self._best = f
        self._where = self.x

    def spacing(self, i: int) -> float:
        """Return the distance of difference samples in coordinate `i`."""
        width = self._evaluate.high[i] - self._evaluate.low[i]
        size = abs(self.x[i])
        return float(
            min(max(_DIFFERENCE * min(max(size, 0.01 * width), width), 1e-7 * size), 0.05 * width)
        )

    def on_bound(self, i: int) -> bool:
        """Return whether coordinate `i` sits exactly on a bound."""
        return self.x[i] <= self._evaluate.low[i] or self.x[i] >= self._evaluate.high[i]

    def coordinate_search(self) -> None:
        """Build the first model: a line search per coordinate, then the mixed derivatives."""
        for i in range(len(self.x)):
            self._best, self._where = self.f, self.x
            first, second = self._line_triple(i)
            self._use_triple(i, first, second)
            self._mixed(i, range(i))
            self._move(range(i + 1))

    def triple_search(self, full: bool) -> None:
        """Renew the model at the interior coordinates by differences; off-diagonals only if
        `full`.
        """
        inside = [i for i in range(len(self.x)) if not self.on_bound(i)]
        for i in range(len(self.x)):
            if i not in inside:
                self.g[i] = 0.0
                for k in range(len(self.x)):
                    self.hessian[i][k] = self.hessian[k][i] = 0.0
        for count, i in enumerate(inside):
            self._best, self._where = self.f, self.x
            delta, c = self.spacing(i), self.x[i]
            if c - delta < self._evaluate.low[i]:
                shifts = (delta, 2.0 * delta)
            elif c + delta > self._evaluate.high[i]:
                shifts = (-delta, -2.0 * delta)
            else:
                shifts = (-delta, delta)
            self._use_triple(i, *[(s, self._sample(i, s)) for s in shifts])
            if full:
                self._mixed(i, inside[:count])
            self._move(inside[: count + 1])

    def step(self, low: Vector, high: Vector) -> tuple[bool, float]:
        """Minimise the model over a box of steps and search along the way there.

        Returns
        -------
        moved : bool
            False where the model's minimiser is the present point.
        ratio : float
            Actual over predicted decrease; 0 without a decrease.
        """
        p = minimise_quadratic(self.g, self.hessian, low, high)
        goal = [
            min(max(c + s, lo), hi)
            for c, s, lo, hi in zip(self.x, p, self._evaluate.low, self._evaluate.high, strict=True)
        ]
        p = [b - a for a, b in zip(self.x, goal, strict=True)]
        if not any(p):
            return False, 0.0
        before = self.f
        predicted = sum(a * s for a, s in zip(self.g, p, strict=True)) + 0.5 * sum(
            s * sum(a * t for a, t in zip(row, p, strict=True))
            for s, row in zip(p, self.hessian, strict=True)
        )
        first = self._evaluate(goal)
        if abs(before - first + predicted) <= _TRUSTED * abs(predicted) and first < before:
            self.x, self.f = goal, first
        else:
            self._search(p, [0.0, 1.0], [self.f, first], _STEP_SAMPLES)
        gained = before - self.f
        if gained <= 0.0:
            return True, 0.0
        return True, gained / -predicted if predicted != 0.0 else 0.5

    def leave_bound(self, i: int) -> bool:
        """Try to move coordinate `i` off its bound; return whether that gave a better point."""
        delta = self.spacing(i) if self.x[i] <= self._evaluate.low[i] else -self.spacing(i)
        value = self._sample(i, delta)
        if value >= self.f:
            return False
        p = [0.0] * len(self.x)
        p[i] = 1.0
        alphas, values = (
            ([0.0, delta], [self.f, value]) if delta > 0.0 else ([delta, 0.0], [value, self.f])
        )
        self._search(p, alphas, values, _COORDINATE_SAMPLES)
        return True

    def _search(self, p: Vector, alphas: Vector, values: Vector, limit: int) -> None:
        line = LineSearch(self._evaluate, self.x, p, alphas, values)
        best = line.run(limit)
        if line.values[best] < self.f:
            alpha = line.alphas[best]
            self.f = line.values[best]
            self.x = [
                min(max(c + alpha * d, lo), hi)
                for c, d, lo, hi in zip(
                    self.x, p, self._evaluate.low, self._evaluate.high, strict=True
                )
            ]

    def _sample(self, i: int, shift: float, k: int = -1, shift_k: float = 0.0) -> float:
        """Evaluate with one or two coordinates replaced and remember the best point seen."""
        x = list(self.x)
        x[i] += shift
        if k >= 0:
            x[k] += shift_k
        value = self._evaluate(x)
        if value < self._best:
            self._best, self._where = value, x
        return value

    def _line_triple(self, i: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Search along coordinate `i`; return offset and value of the two samples for the
        parabola at x.
        """
        delta = self.spacing(i)
        alphas, values = [0.0], [self.f]
        if self.on_bound(i):
            inward = delta if self.x[i] <= self._evaluate.low[i] else -delta
            near = self._sample(i, inward)
            if near >= self.f:
                return (inward, near), (2.0 * inward, self._sample(i, 2.0 * inward))
            alphas, values = (
                ([0.0, inward], [self.f, near]) if inward > 0.0 else ([inward, 0.0], [near, self.f])
            )
        p = [0.0] * len(self.x)
        p[i] = 1.0
        line = LineSearch(self._evaluate, self.x, p, alphas, values)
        best = line.run(_COORDINATE_SAMPLES)
        first, second = self._choose(i, line.alphas, line.values, best)
        for shift, value in (first, second):
            if value < self._best:
                self._best, self._where = value, list(self.x)
                self._where[i] += shift
        return first, second

    def _choose(
        self, i: int, alphas: Vector, values: Vector, best: int
    ) -> tuple[tuple[float, float], ...]:
        """Pick the two samples of a line in coordinate `i` that give the parabola at x; add one
        where too few.
        """
        delta = self.spacing(i)
        top = alphas[best]
        if 0.0 < abs(top) < delta:
            # too close for a difference quotient: make it the point of expansion
            self.x = list(self.x)
            self.x[i] += top
            self.f = values[best]
            self._best, self._where = self.f, self.x
            alphas = [a - top for a in alphas]
            top = 0.0
        known = [
            (a, v)
            for a, v in zip(alphas, values, strict=True)
            if abs(a) >= delta and abs(a - top) >= delta
        ]
        chosen: list[tuple[float, float]] = []
        if top != 0.0:
            chosen.append((top, values[best]))
            known = [s for s in known if (s[0] - top) * top > 0.0] or known
        for sample in sorted(known, key=lambda s: abs(s[0] - top)):
            if len(chosen) < 2 and all(abs(sample[0] - s[0]) >= delta for s in chosen):
                chosen.append(sample)
        while len(chosen) < 2:
            up = self._evaluate.high[i] - self.x[i] >= self.x[i] - self._evaluate.low[i]
            extra = 0.5 * chosen[0][0] if chosen else (delta if up else -delta)
            chosen.append((extra, self._sample(i, extra)))
        return tuple(chosen)

    def _use_triple(self, i: int, first: tuple[float, float], second: tuple[float, float]) -> None:
        (a, fa), (b, fb) = first, second
        self.g[i], self.hessian[i][i] = slope_and_curvature(0.0, self.f, a, fa, b, fb)
        # the better one first: it is used for the mixed derivatives
        self._shifts[i] = (a, b) if fa <= fb else (b, a)

    def _mixed(self, i: int, earlier: range | list[int]) -> None:
        """Sample the mixed derivatives of coordinate `i` with the earlier ones."""
        di = self._shifts[i][0]
        base = self.f + self.g[i] * di + 0.5 * self.hessian[i][i] * di * di
        for k in earlier:
            if not self._pattern[i][k]:
                continue
            gain = [s * (self.g[k] + 0.5 * self.hessian[k][k] * s) for s in self._shifts[k]]
            better = 0 if gain[0] <= gain[1] else 1
            dk = self._shifts[k][better]
            value = self._sample(i, di, k, dk)
            self.hessian[i][k] = self.hessian[k][i] = (value - base - gain[better]) / (di * dk)

    def _move(self, processed: range | list[int]) -> None:
        """Expand the model around the best point seen."""
        if self._where is self.x:
            return
        new = [
            min(max(c, lo), hi)
            for c, lo, hi in zip(self._where, self._evaluate.low, self._evaluate.high, strict=True)
        ]
        shift = [b - a for a, b in zip(self.x, new, strict=True)]
        for k in processed:
            row = self.hessian[k]
            self.g[k] += sum(row[j] * shift[j] for j in processed)
            if shift[k] != 0.0:
                a, b = self._shifts[k]
                near_a = abs(a - shift[k]) <= abs(b - shift[k])
                kept = b if near_a else a
                self._shifts[k] = (-shift[k], kept - shift[k])
        self.x, self.f = new, self._best


@final
class LocalSearch:
    """Trust-region search on `LocalModel` from any point of the box.

    Parameters
    ----------
    evaluate : Evaluator
        The objective with its box.
    pattern : lists of bool, shape (n, n)
        Mixed second derivatives to sample.
    steps : int
        Largest number of model steps.
    precision : float
        Predicted relative gain below which a point counts as stationary.
    """

    __slots__ = ("_evaluate", "_pattern", "_precision", "_steps", "reference")

    def __init__(
        self, evaluate: Evaluator, pattern: list[list[bool]], steps: int, precision: float
    ) -> None:
        self._evaluate = evaluate
        self._pattern = pattern
        self._steps = steps
        self._precision = precision
        self.reference = 0.0
        """Best value of the initial evaluations: gains are measured from it."""

    def run(self, start: Vector, f_start: float) -> tuple[Vector, float, bool]:
        """Return point, value and whether the search settled before its steps ran out."""
        low, high = self._evaluate.low, self._evaluate.high
        n = len(start)
        # the point of the box with the smallest absolute values sets the scale of the first radius
        radius = [
            min(hi - lo, 0.25 * (1.0 + abs(c - min(max(0.0, lo), hi))))
            for c, lo, hi in zip(start, low, high, strict=True)
        ]
        model = LocalModel(self._evaluate, self._pattern, start, f_start)
        model.coordinate_search()
        x_old = model.x
        _, ratio = model.step(*self._reach(model, radius))
        gain, full = f_start - model.f, False
        for _ in range(self._steps):
            decrease = sum(
                abs(g) * max(abs(c), abs(old))
                for g, c, old in zip(model.g, model.x, x_old, strict=True)
            )
            noise = self._precision * max(self.reference - model.f, 0.0)
            small = decrease < noise
            settled = small or gain <= noise
            bound = [i for i in range(n) if model.on_bound(i)]
            if settled and full and not bound:
                return model.x, model.f, True
            if settled and bound:
                left = [model.leave_bound(i) for i in bound]
                if (full or len(bound) == n) and not any(left):
                    return model.x, model.f, True
            before = model.f
            full = abs(ratio - 1.0) > _POOR or settled
            x_old = model.x
            model.triple_search(full)
            if ratio < _POOR:
                radius = [0.5 * d for d in radius]
            elif ratio > 1.0 - _POOR:
                radius = [
                    min(2.0 * d, hi - lo) for d, lo, hi in zip(radius, low, high, strict=True)
                ]
            moved, ratio = model.step(*self._reach(model, radius))
            gain = before - model.f
            if not moved and full and not any(model.on_bound(i) for i in range(n)):
                return model.x, model.f, True
        return model.x, model.f, False

    def _reach(self, model: LocalModel, radius: Vector) -> tuple[Vector, Vector]:
        """Return the box of steps: the trust region cut by the bounds."""
        low, high = self._evaluate.low, self._evaluate.high
        return (
            [max(-d, lo - c) for d, lo, c in zip(radius, low, model.x, strict=True)],
            [min(d, hi - c) for d, hi, c in zip(radius, high, model.x, strict=True)],
        )
