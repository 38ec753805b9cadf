"""Searches for the nonlinear parameters: MCS with polish, a warm start, the thesis's
alternating form.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, Literal, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.fitting.least_squares import least_squares
from identification.search.mcs import mcs
from identification.two_step.varpro import BudgetSpent, Projection

FloatArray = npt.NDArray[np.float64]

POLISHED: Final = 0.01
"""Distance from the end of a polish, as a share of the bounds, from which another one would end
there too: a polish moves by less between two grids of starts.
"""
APART: Final = 0.1
"""Distance between starts, as a share of the bounds: ten of them fit on each axis."""
STEPS = 40
"""Steps of one polish at most: a start that needs more lies far from the minimum that a
neighbouring start ends in.
"""

Method = Literal["variable_projection", "alternating"]


@final
@dataclass(frozen=True)
class TwoStepSettings:
    """Tuning of the two-step fit; every default is a working one.

    Attributes
    ----------
    max_evaluations
        Evaluations of phi per fit, the repeat with non-negative coefficients included.
    mcs_share
        Share of them that the coordinate search may use.
    starts
        Further least-squares starts, a Latin hypercube in the box.
    seed
        Of the hypercube; the same seed gives the same fit.
    rough, fine
        Tolerance of the polish from each start, and of the last one from the best.
    unidentifiable
        A shape parameter is flagged where its Cramer-Rao deviation passes this share of its value
        (of its box where the box is not positive).
    freeze
        Freeze flagged shape parameters at their nominal value, the worst first, and fit again.
    non_negative
        Repeat with non-negative coefficients where one that must be >= 0 comes out negative.
    passes, threshold, change
        Alternating form: number of passes, error norm (3.53) and change of the parameters
        (relative) at which it ends (steps 2 to 8 of 3.7).
    """

    max_evaluations: int = 600
    mcs_share: float = 0.4
    starts: int = 8
    seed: int = 0
    rough: float = 1e-5
    fine: float = 1e-12
    unidentifiable: float = 1.0
    freeze: bool = True
    non_negative: bool = True
    passes: int = 30
    threshold: float = 0.0
    change: float = 1e-6

    def __post_init__(self) -> None:
        if (
            self.max_evaluations < 10
            or not 0 < self.mcs_share < 1
            or self.starts < 0
            or self.passes < 1
        ):
            raise InputError(
                "two-step settings: give max_evaluations >= 10, 0 < mcs_share < 1, starts >= 0, "
                "passes >= 1"
            )


def polish(problem: Projection, z: FloatArray, tolerance: float) -> FloatArray:
    """Least squares from z inside the box; the end point, also where the budget ends on the way."""
    found = least_squares(
        problem, z, (problem.low, problem.high), iterations=STEPS, tolerance=tolerance
    )
    return found.x


def hypercube(count: int, low: FloatArray, high: FloatArray, seed: int) -> FloatArray:
    """Latin hypercube in the box, (count, shapes)."""
    rng = np.random.default_rng(seed)
    cells = (
        np.stack([rng.permutation(count) for _ in low], axis=1)
        if len(low)
        else np.zeros((count, 0))
    )
    share: FloatArray = (cells + rng.random(cells.shape)) / max(count, 1)
    return low + share * (high - low)


def global_search(problem: Projection, settings: TwoStepSettings) -> FloatArray:
    """MCS, then a polish from every basket point and from the hypercube, then a fine polish of
    the best.
    """
    if not problem.low.size:
        problem.objective(problem.low)
        return problem.low
    share = int(settings.mcs_share * (problem.budget - problem.evaluations))
    ends: list[FloatArray] = []
    reserve = problem.budget
    problem.budget = max(problem.evaluations + 1, int(0.93 * reserve))
    with suppress(BudgetSpent):
        found = mcs(
            problem.objective,
            np.column_stack([problem.low, problem.high]),
            max_evaluations=max(share, 3),
        )
        for point in (found.x, *(minimum.x for minimum in found.basket)):
            _polish_new(problem, point, ends, settings)
        for start in hypercube(settings.starts, problem.low, problem.high, settings.seed):
            _polish_new(problem, start, ends, settings)
    return finish(problem, settings, reserve)


def finish(problem: Projection, settings: TwoStepSettings, budget: int) -> FloatArray:
    """Fine polish of the best point seen, within the evaluations that are left."""
    problem.budget = budget
    if problem.low.size:
        with suppress(BudgetSpent):
            polish(problem, problem.best().z, settings.fine)
    return problem.best().z


def _polish_new(
    problem: Projection, start: FloatArray, ends: list[FloatArray], settings: TwoStepSettings
) -> None:
    """Polish unless the start lies where an earlier polish ended."""
    width = problem.high - problem.low
    if any(np.max(np.abs(start - e) / width) < POLISHED for e in ends):
        return
    ends.append(polish(problem, start, settings.rough))


def warm_search(problem: Projection, start: FloatArray, settings: TwoStepSettings) -> FloatArray:
    """Least squares from the present shape parameters only."""
    reserve = problem.budget
    with suppress(BudgetSpent):
        polish(problem, start, 1e-8)
    return finish(problem, settings, reserve)


def repeat_non_negative(problem: Projection, settings: TwoStepSettings, budget: int) -> FloatArray:
    """Search again with non-negative coefficients.

    The triangles of all points seen so far are solved again, which takes no evaluation of phi; the
    best of them, far from each other, are the new starts.
    """
    problem.sign = problem.signed
    ranked = sorted(problem.seen, key=lambda r: r.solve(problem.sign)[1])
    problem.budget = problem.evaluations + budget
    reserve = problem.budget
    problem.budget = max(problem.evaluations + 1, reserve - int(0.15 * budget))
    ends: list[FloatArray] = []
    width = np.maximum(problem.high - problem.low, 1e-300)
    tried: list[FloatArray] = []
    with suppress(BudgetSpent):
        for reduced in ranked:
            if all(np.max(np.abs(reduced.z - t) / width) > APART for t in tried):
                tried.append(reduced.z)
                _polish_new(problem, reduced.z, ends, settings)
            if len(tried) >= settings.starts + 4:
                break
    return finish(problem, settings, reserve)


def alternating_search(
    problem: Projection,
    settings: TwoStepSettings,
    report: Callable[[int, float], object] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """The thesis's form (3.7): linear least squares and MCS in turn; gives (z, theta)."""
    z = problem.inner(problem.model.nominal)
    theta = np.zeros(len(problem.model.coefficients))
    box = np.column_stack([problem.low, problem.high])
    for number in range(settings.passes):
        before = np.concatenate([z, theta])
        reduced, matrix, target = problem.reduce(z)
        theta, square = reduced.solve(None)
        fixed = theta

        def value(at: FloatArray, fixed: FloatArray = fixed) -> float:
            _, columns, aim = problem.reduce(np.asarray(at, dtype=np.float64))
            left = columns @ fixed - aim
            return 0.5 * float(left @ left)

        if len(z):
            z = np.asarray(mcs(value, box).x, dtype=np.float64)
        problem.seen.clear()
        if report is not None:
            report(number, square)
        change = np.linalg.norm(np.concatenate([z, theta]) - before) / max(
            float(np.linalg.norm(before)), 1e-300
        )
        if number and change < settings.change and np.sqrt(square) <= max(settings.threshold, 0.0):
            break
    theta, _ = problem.reduce(z)[0].solve(None)
    return z, theta
