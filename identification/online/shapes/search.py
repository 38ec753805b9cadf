"""One search for the shape parameters on a stored window (thesis 3.7); it touches nothing but
its arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.errors import InputError
from identification.online.first_window import least_squares, prior_range, told_beside_noise
from identification.online.shapes.rows import SIGNALS, RowWindow, ShapedBalances
from identification.recursive.estimator import RecursiveLeastSquares
from identification.two_step.algorithm import (
    JOINT_CHANNELS,
    OnlineSettings,
    SeparableModel,
    Shape,
    TwoStepFit,
    TwoStepSettings,
    joint_shape,
)
from identification.two_step.varpro_window import linear_fit, search_window, simplex_fit

FloatArray = npt.NDArray[np.float64]
Recursion = Callable[[FloatArray, FloatArray], RecursiveLeastSquares]

_FEWEST = 60
"""Rows that a search needs at least."""
_GAIN = 0.8
_REFINED = 1.5
"""Other shapes are taken up where they leave less than this share of the residual; asked for,
less than so many times the noise.
"""


@final
@dataclass(frozen=True)
class Task:
    """What a search starts from.

    Attributes
    ----------
    window : RowWindow
    weight : (rows - lead, balances) array
        Weights of the rows; 0 leaves a row out.
    eta, theta : arrays
        Shapes and linear parameters now.
    level, least : (balances,) array
        Size of the residuals before, and what counts as noise at least [N.m].
    noise : (balances, parameters) array
        Variance of the noise in the entries of the rows.
    first, forced, local : bool
        First search; asked for by the host; only a local simplex, after several searches that did
        not help.
    """

    window: RowWindow
    weight: FloatArray
    eta: FloatArray
    theta: FloatArray
    level: FloatArray
    least: FloatArray
    noise: FloatArray
    first: bool
    forced: bool
    local: bool


@final
@dataclass(frozen=True)
class Found:
    """What a search found.

    Attributes
    ----------
    eta, deviation : (shapes,) array or None
        None: the shapes stay.
    level : (balances,) array
        Root mean square of the weighted residuals of the window; 0 where nothing was computed.
    estimator : RecursiveLeastSquares or None
        Started from the window; None where it has too few rows with all balances.
    scale : (parameters,) array
        Prior ranges of its parameters.
    good : bool
        The residual is down to its level before.
    text : str
        One sentence.
    """

    eta: FloatArray | None
    deviation: FloatArray
    level: FloatArray
    estimator: RecursiveLeastSquares | None
    scale: FloatArray
    good: bool
    text: str


def search(
    task: Task,
    balances: ShapedBalances,
    model: JointModel,
    settings: OnlineSettings,
    tuning: TwoStepSettings,
    recursion: Recursion,
    tick: Callable[[], None],
) -> Found:
    """Search the shapes on a window.

    Parameters
    ----------
    task : Task
    balances : ShapedBalances
    model : JointModel
        With the present shapes.
    settings : OnlineSettings
        Limits.
    tuning : TwoStepSettings
        Of the search.
    recursion : callable
        (values, scale) -> recursive least squares.
    tick : callable
        Called between portions of the work.
    """
    group = list(balances.balances)
    if int(task.weight[:, group].all(axis=1).sum()) < _FEWEST:
        return nothing(task, "too few rows whose readings were all there", good=True)
    try:
        shapes = boxes(model, balances.shapes, task)
        separable, y, index = balances.model(
            task.window, task.weight, task.eta, task.theta, shapes, tick
        )
        weights, ratio = _before(task, separable, y, index, group, settings)
        if not (task.first or task.forced) and ratio <= settings.confirm_limit:
            return nothing(
                task, f"linear parameters explain it: {ratio:.2f} of the noise", good=True
            )
        fit = _fit(
            task, separable, y=y, index=index, weights=weights, settings=settings, tuning=tuning
        )
    except InputError as error:
        return nothing(task, str(error), good=False)
    after = float(np.sqrt(np.mean((fit.residual_deviation * weights) ** 2)))
    text = (
        f"{fit.evaluations} evaluations: {fit.outcome.value} {ratio:.2f} of the noise before, "
        f"{after:.2f} after"
    )
    good = task.first or after <= settings.confirm_limit
    if not task.first and after > (_REFINED if task.forced else _GAIN * ratio):
        return nothing(task, f"{text}; the shapes stay", good=good)
    eta = np.array([fit.nonlinear[n] for n in balances.shapes])
    tick()
    level, estimator, scale = _restarted(
        task, balances, eta, recursion, tick=tick, period=settings.sample_time
    )
    return Found(
        eta,
        np.array([fit.deviation[n] for n in balances.shapes]),
        level=level,
        estimator=estimator,
        scale=scale,
        good=good,
        text=text,
    )


def nothing(task: Task, text: str, *, good: bool) -> Found:
    """The shapes stay."""
    return Found(
        None,
        np.zeros(len(task.eta)),
        level=np.zeros(len(task.level)),
        estimator=None,
        scale=np.ones(len(task.theta)),
        good=good,
        text=text,
    )


def boxes(model: JointModel, names: Sequence[str], task: Task) -> tuple[Shape, ...]:
    """The shapes with boxes from the motion of the window; what a box does not hold is moved
    inside.
    """
    signals = task.window.signals[:, [SIGNALS.index(c) for c in JOINT_CHANNELS]]
    return tuple(joint_shape(model, n, signals) for n in names)


def _before(
    task: Task,
    model: SeparableModel,
    y: FloatArray,
    index: FloatArray,
    group: list[int],
    settings: OnlineSettings,
) -> tuple[FloatArray, float]:
    """1 / size of each balance's residual before, and how much of it the best linear fit leaves
    now.
    """
    weights = np.ones(len(group))
    if not task.first:
        weights = 1.0 / np.maximum(task.level, task.least)[group]
    for _ in range(2 if task.first else 0):
        theta = linear_fit(model, y, index, task.eta, weights, limit=settings.rank_limit).theta
        left = y - model.remainder(index, task.eta) - model.matrix(index, task.eta) @ theta
        weights = 1.0 / np.maximum(np.sqrt(np.mean(left**2, axis=0)), task.least[group])
    return weights, linear_fit(model, y, index, task.eta, weights, limit=settings.rank_limit).ratio


def _fit(
    task: Task,
    model: SeparableModel,
    y: FloatArray,
    index: FloatArray,
    weights: FloatArray,
    settings: OnlineSettings,
    tuning: TwoStepSettings,
) -> TwoStepFit:
    tuning = replace(tuning, freeze=tuning.freeze and task.first)
    start = dict(zip(model.shape_names, task.eta.tolist(), strict=True))
    if task.local:
        return simplex_fit(
            model,
            y,
            signals=index,
            weights=weights,
            method="variable_projection",
            settings=tuning,
            start=start,
            tick=_quiet,
        )
    given: Mapping[str, float] | None = None if task.first else start
    return search_window(
        model,
        y,
        signals=index,
        weights=weights,
        method="variable_projection",
        settings=tuning,
        start=given,
        limit=settings.confirm_limit,
        tick=_quiet,
    )


def _restarted(
    task: Task,
    balances: ShapedBalances,
    eta: FloatArray,
    recursion: Recursion,
    *,
    tick: Callable[[], None],
    period: float,
) -> tuple[FloatArray, RecursiveLeastSquares | None, FloatArray]:
    """Residuals of the window with the shapes found, a recursion that starts from its rows, and
    its scale.
    """
    y, h = balances.table(task.window, eta, tick)
    whole = task.weight.all(axis=1)
    tick()
    if int(whole.sum()) < _FEWEST:
        return np.zeros(y.shape[1]), None, np.ones(len(task.theta))
    weight = task.weight[whole]
    y, h, entries = told_beside_noise(y[whole], h[whole], task.theta, task.noise, period)
    y, h = y * weight, h * weight[:, :, None]
    first = least_squares(y, h, task.least, balances.like)
    tick()
    scale = prior_range(first, task.theta, h, y, balances.usual, balances.like)
    made = recursion(task.theta, scale)
    made.begin(y, h, task.least, overlap=balances.overlap)
    made.set_entry_noise(task.noise, entries)
    return np.sqrt(np.mean((y - h @ made.theta) ** 2, axis=0)), made, scale


def _quiet() -> None:
    """The ticks come from the model."""
