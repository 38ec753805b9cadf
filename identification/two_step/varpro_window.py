"""Decisions and searches of the on-line two-step algorithm on one window of samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.two_step.varpro import BudgetSpent, Projection
from identification.two_step.varpro_fit import TwoStepFit, fit
from identification.two_step.varpro_model import SeparableModel
from identification.two_step.varpro_search import Method, TwoStepSettings

FloatArray = npt.NDArray[np.float64]

OF_THE_LOST: Final = 0.1
"""Part of a coefficient in the directions that a window does not determine, from which on it counts
as not determined: a hundredth of its variance.
"""


@final
@dataclass(frozen=True)
class LinearFit:
    """Least squares of a window with the shape parameters held.

    Attributes
    ----------
    theta : (coefficients,) array
    ratio : float
        Residual deviation over the noise, all outputs together.
    lost : tuple of str
        Coefficients that the window does not determine.
    """

    theta: FloatArray
    ratio: float
    lost: tuple[str, ...]


def linear_fit(
    model: SeparableModel,
    y: FloatArray,
    signals: FloatArray,
    nonlinear: FloatArray,
    weights: FloatArray,
    *,
    limit: float,
) -> LinearFit:
    """Steps 4 and 5 of 3.7: rank by SVD, linear parameters by least squares."""
    phi = model.matrix(signals, nonlinear) * weights[:, None]
    matrix = phi.reshape(-1, phi.shape[-1])
    target = ((y - model.remainder(signals, nonlinear)) * weights).reshape(-1)
    norm = np.linalg.norm(matrix, axis=0)
    scale = np.where(norm > 0, norm, 1.0)
    u, sigma, vt = np.linalg.svd(matrix / scale, full_matrices=False)
    weak = sigma <= limit * max(float(sigma[0]), 1e-300)
    theta = vt.T @ np.where(weak, 0.0, (u.T @ target) / np.where(weak, 1.0, sigma)) / scale
    left = target - matrix @ theta
    ratio = float(np.sqrt(left @ left / max(1, len(left) - len(theta))))
    share = np.linalg.norm(np.where(weak[:, None], vt, 0.0), axis=0)
    lost = tuple(
        n
        for n, s, size in zip(model.names, share, norm, strict=True)
        if s > OF_THE_LOST or size == 0
    )
    return LinearFit(theta, ratio, lost)


def search_window(
    model: SeparableModel,
    y: FloatArray,
    signals: FloatArray,
    weights: FloatArray,
    method: Method,
    settings: TwoStepSettings,
    start: Mapping[str, float] | None,
    limit: float,
    tick: Callable[[], None],
) -> TwoStepFit:
    """A warm local search first; the global one where it leaves more than `limit` times the
    noise.
    """
    if start is not None and method == "variable_projection":
        warm = fit(
            model, y, signals, weights, method=method, settings=settings, start=start, tick=tick
        )
        if _ratio(warm, weights) <= limit:
            return warm
        whole = fit(model, y, signals, weights, method=method, settings=settings, tick=tick)
        best = min(warm, whole, key=lambda f: f.sum_of_squares)
        return replace(best, evaluations=warm.evaluations + whole.evaluations)
    return fit(model, y, signals, weights, method=method, settings=settings, tick=tick)


def reweighted(
    model: SeparableModel,
    y: FloatArray,
    signals: FloatArray,
    found: TwoStepFit,
    *,
    method: Method,
    settings: TwoStepSettings,
    tick: Callable[[], None] | None = None,
) -> TwoStepFit:
    """The fit again from where it ended, each output weighted by its own residual (maximum
    likelihood).
    """
    floor = 1e-9 * np.maximum(np.nanstd(y, axis=0), 1e-300)
    weights = 1.0 / np.maximum(found.residual_deviation, floor)
    if method == "alternating":
        return fit(model, y, signals, weights, method=method, settings=settings, tick=tick)
    again = fit(
        model,
        y,
        signals,
        weights,
        method=method,
        settings=settings,
        start=found.nonlinear,
        tick=tick,
    )
    return replace(again, evaluations=again.evaluations + found.evaluations)


def simplex_fit(
    model: SeparableModel,
    y: FloatArray,
    signals: FloatArray,
    weights: FloatArray,
    method: Method,
    settings: TwoStepSettings,
    start: Mapping[str, float],
    tick: Callable[[], None],
) -> TwoStepFit:
    """The fall-back of 3.7: a local simplex over the shape parameters (Nelder and Mead, 1965),
    then the usual end.
    """
    from scipy.optimize import minimize

    problem = Projection(model, y, signals, weights, settings.max_evaluations)
    problem.tick = tick
    given = np.array([min(max(start.get(s.name, s.nominal), s.low), s.high) for s in model.shapes])
    with suppress(BudgetSpent):
        minimize(
            problem.objective,
            problem.inner(given),
            method="Nelder-Mead",
            bounds=np.column_stack([problem.low, problem.high]),
            options={"maxfev": settings.max_evaluations, "xatol": 1e-6, "fatol": 1e-12},
        )
    found = dict(zip(model.shape_names, problem.outer(problem.best().z).tolist(), strict=True))
    end = fit(
        model,
        y,
        signals,
        weights,
        method="variable_projection",
        settings=settings,
        start=found,
        tick=tick,
    )
    return replace(end, evaluations=end.evaluations + problem.evaluations)


def _ratio(found: TwoStepFit, weights: FloatArray) -> float:
    return float(np.sqrt(np.mean((found.residual_deviation * weights) ** 2)))
