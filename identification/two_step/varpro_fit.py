"""The two-step fit of one record: result, Cramer-Rao bound, freezing of what cannot be
identified.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.fitting.covariance import white_errors
from identification.two_step.varpro import Projection
from identification.two_step.varpro_model import SeparableModel
from identification.two_step.varpro_search import (
    Method,
    TwoStepSettings,
    alternating_search,
    global_search,
    repeat_non_negative,
    warm_search,
)

FloatArray = npt.NDArray[np.float64]

_UNBOUNDED: Final = 10**9
NOT_WORSE: Final = 10.0
"""A shape stays frozen only where that raises the sum of squares by less than this many noise
variances.
"""


class TwoStepOutcome(Enum):
    """How a fit ended; the value is the sentence a user reads."""

    FITTED = "Every parameter was fitted."
    NON_NEGATIVE = (
        "A coefficient that must not be negative came out negative; the fit was "
        "repeated with it >= 0."
    )
    FROZEN = (
        "The data cannot identify every shape parameter: some were frozen at their nominal values."
    )
    RANK_DEFICIENT = (
        "The record does not determine every coefficient; those it cannot carry are not reliable."
    )

    def __str__(self) -> str:
        """Return the sentence."""
        return self.value


@final
@dataclass(frozen=True)
class TwoStepFit:
    """Result of a two-step fit.

    Attributes
    ----------
    linear, nonlinear : mapping
        Coefficients and shape parameters by name, user units.
    deviation : mapping
        Cramer-Rao standard deviation of each parameter, user units; infinite where the data say
        nothing, 0 for a frozen shape.
    sum_of_squares : float
        Of the weighted residual.
    residual_deviation : (outputs,) array
        Standard deviation of each output's residual, units of y.
    evaluations : int
        Evaluations of phi.
    unidentifiable : tuple of str
        Shape parameters whose deviation passes the limit (the frozen ones included).
    frozen : tuple of str
        Shape parameters held at their nominal value.
    negative : tuple of str
        Coefficients that came out negative without the sign condition.
    at_bound : tuple of str
        Shape parameters that ended at an end of their box.
    samples, dropped : int
        Samples used, and left out for NaN.
    outcome : TwoStepOutcome
    """

    linear: Mapping[str, float]
    nonlinear: Mapping[str, float]
    deviation: Mapping[str, float]
    sum_of_squares: float
    residual_deviation: FloatArray
    evaluations: int
    unidentifiable: tuple[str, ...]
    frozen: tuple[str, ...]
    negative: tuple[str, ...]
    at_bound: tuple[str, ...]
    samples: int
    dropped: int
    outcome: TwoStepOutcome

    @property
    def theta(self) -> FloatArray:
        """Coefficients, in the model's order."""
        return np.array(list(self.linear.values()))

    @property
    def values(self) -> dict[str, float]:
        """All parameters by name."""
        return {**self.linear, **self.nonlinear}

    def __str__(self) -> str:
        rows = [f"{n} = {v:.6g} +- {self.deviation[n]:.2g}" for n, v in self.values.items()]
        return "\n".join([self.outcome.value, *rows, f"{self.evaluations} evaluations"])


def fit(
    model: SeparableModel,
    y: FloatArray,
    signals: FloatArray,
    weights: FloatArray,
    *,
    method: Method,
    settings: TwoStepSettings,
    start: Mapping[str, float] | None = None,
    tick: Callable[[], None] | None = None,
) -> TwoStepFit:
    """Fit one record (see :meth:`identification.two_step.algorithm.TwoStep.fit`)."""
    if method not in ("variable_projection", "alternating"):
        raise InputError(
            f"two-step: unknown method {method!r}; use 'variable_projection' or 'alternating'"
        )
    frozen: dict[str, float] = {}
    flagged_names: list[str] = []
    evaluations = 0
    accepted: _Solution | None = None
    while True:
        budget = settings.max_evaluations if method == "variable_projection" else _UNBOUNDED
        problem = Projection(
            model.frozen(frozen) if frozen else model,
            y,
            signals,
            weights,
            max(budget - evaluations, 60),
        )
        problem.tick = tick
        solution = _solve(problem, method, settings, start, frozen)
        evaluations += problem.evaluations
        if (
            accepted is not None
            and solution.square - accepted.square > NOT_WORSE * accepted.square / problem.samples
        ):
            solution = accepted
            break
        accepted = solution
        flagged = _flagged(
            problem.model, solution.deviations[len(solution.theta) :], settings.unidentifiable
        )
        flagged_names.extend(n for n in flagged if n not in flagged_names)
        if not (flagged and settings.freeze and method == "variable_projection"):
            break
        frozen = {
            **frozen,
            flagged[0]: next(s.nominal for s in model.shapes if s.name == flagged[0]),
        }
    return _result(model, solution, evaluations, tuple(flagged_names))


@final
@dataclass(frozen=True)
class _Solution:
    """One search: where it ended and what it knows about the parameters."""

    problem: Projection
    z: FloatArray
    theta: FloatArray
    square: float
    negative: tuple[str, ...]
    deviations: FloatArray
    rank_lost: bool
    frozen: Mapping[str, float]


def _solve(
    problem: Projection,
    method: Method,
    settings: TwoStepSettings,
    start: Mapping[str, float] | None,
    frozen: Mapping[str, float],
) -> _Solution:
    if method == "alternating":
        z, theta = alternating_search(problem, settings)
        square = 2.0 * _square(problem, z, theta)
        signs = zip(problem.model.coefficients, theta, strict=True)
        negative = tuple(c.name for c, v in signs if c.non_negative and v < 0)
    else:
        z, theta, square, negative = _project(problem, settings, start)
    deviations, rank_lost = cramer_rao(problem, z, theta, square)
    return _Solution(
        problem,
        z,
        theta=theta,
        square=square,
        negative=negative,
        deviations=deviations,
        rank_lost=rank_lost,
        frozen=frozen,
    )


def _square(problem: Projection, z: FloatArray, theta: FloatArray) -> float:
    _, matrix, target = problem.reduce(z)
    left = matrix @ theta - target
    return 0.5 * float(left @ left)


def _project(
    problem: Projection, settings: TwoStepSettings, start: Mapping[str, float] | None
) -> tuple[FloatArray, FloatArray, float, tuple[str, ...]]:
    """Variable projection, repeated with non-negative coefficients where the sign demands it."""
    total = problem.budget
    repeat = settings.non_negative and bool(problem.signed.any())
    problem.budget = int(0.7 * total) if repeat else total
    if start is None:
        z = global_search(problem, settings)
    else:
        given = np.array([start.get(s.name, s.nominal) for s in problem.model.shapes])
        clipped = np.array(
            [min(max(v, s.low), s.high) for v, s in zip(given, problem.model.shapes, strict=True)]
        )
        z = warm_search(problem, problem.inner(clipped), settings)
    theta, square = problem.best().solve(None)
    negative = tuple(
        c.name
        for c, v in zip(problem.model.coefficients, theta, strict=True)
        if c.non_negative and v < 0
    )
    if repeat and negative:
        z = repeat_non_negative(problem, settings, total - problem.evaluations)
        theta, square = problem.best().solve(problem.sign)
    return z, theta, square, negative


def cramer_rao(
    problem: Projection, z: FloatArray, theta: FloatArray, square: float
) -> tuple[FloatArray, bool]:
    """Cramer-Rao deviations of (theta, shapes on the search scale), and True where phi lost rank.

    From the full Jacobian [phi, d(phi theta)/dz] and the residual's variance; infinite for a
    direction that the data do not see.
    """
    problem.budget = max(problem.budget, problem.evaluations + 4)
    sign = problem.sign
    _, matrix, _ = problem.reduce(z)
    slopes = problem.slopes(z) if len(z) else np.zeros((len(matrix), 0))
    active = np.ones(len(theta), dtype=bool) if sign is None else ~sign | (theta > 0)
    full = np.hstack([matrix[:, active], slopes])
    degrees = max(1, problem.samples - full.shape[1])
    deviation, lost = white_errors(full, math.sqrt(square / degrees))
    out = np.zeros(len(theta) + len(z))
    out[: len(theta)][active] = deviation[: int(active.sum())]
    out[len(theta) :] = deviation[int(active.sum()) :]
    return out, bool(lost[: int(active.sum())].any())


def _flagged(model: SeparableModel, deviations: FloatArray, limit: float) -> list[str]:
    """Shape parameters the data cannot identify, the worst first."""
    shares = []
    for shape, deviation in zip(model.shapes, deviations, strict=True):
        share = deviation if shape.logarithmic else deviation / (shape.high - shape.low)
        if not share <= limit:
            shares.append((-share if math.isfinite(share) else -math.inf, shape.name))
    return [name for _, name in sorted(shares, key=lambda pair: pair[0])]


def _result(
    model: SeparableModel, solution: _Solution, evaluations: int, flagged: tuple[str, ...]
) -> TwoStepFit:
    problem, z, theta, frozen = solution.problem, solution.z, solution.theta, solution.frozen
    deviations, negative = solution.deviations, solution.negative
    eta = problem.outer(z)
    found = dict(zip(problem.model.shape_names, eta.tolist(), strict=True))
    spread = {n: float(v) for n, v in zip(model.names, deviations, strict=False)}
    for i, shape in enumerate(problem.model.shapes):
        d = float(deviations[len(theta) + i])
        spread[shape.name] = d * float(eta[i]) if shape.logarithmic else d
    spread.update(dict.fromkeys(frozen, 0.0))
    _, matrix, target = problem.reduce(z)
    residual = (matrix @ theta - target).reshape(-1, model.outputs) / problem.weights
    edge = 1e-6 * (problem.high - problem.low)
    at_bound = (z <= problem.low + edge) | (z >= problem.high - edge)
    outcome = TwoStepOutcome.FITTED
    if solution.rank_lost:
        outcome = TwoStepOutcome.RANK_DEFICIENT
    elif frozen:
        outcome = TwoStepOutcome.FROZEN
    elif negative and problem.sign is not None:
        outcome = TwoStepOutcome.NON_NEGATIVE
    values = {n: frozen[n] if n in frozen else found[n] for n in model.shape_names}
    return TwoStepFit(
        linear=dict(zip(model.names, theta.tolist(), strict=True)),
        nonlinear=values,
        deviation=spread,
        sum_of_squares=solution.square,
        residual_deviation=np.sqrt(np.mean(residual**2, axis=0)),
        evaluations=evaluations,
        unidentifiable=flagged,
        frozen=tuple(frozen),
        negative=negative,
        at_bound=tuple(s.name for s, b in zip(problem.model.shapes, at_bound, strict=True) if b),
        samples=len(problem.y),
        dropped=problem.dropped,
        outcome=outcome,
    )
