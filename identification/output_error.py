"""Output-error refinement: the simulated outputs of a fitted model against the measured ones, window by window.

Multiple shooting: the record is cut into short windows with free initial states; Runge-Kutta steps of
4th order carry the sensitivities along, and Gauss-Newton steps eliminate the initial states of each
window (Schur complement; Bock's direct multiple shooting without continuity conditions).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification._shooting import MOST_SUBSTEPS, Shooting, Windows, cut_windows, substeps_for, weighted
from identification.assess import assess
from identification.calibration import is_of_run, without_calibration
from identification.dataset import run_name
from identification.engine import row_weights
from identification.errors import InputError
from identification.fit import Fit
from identification.record import Record
from identification.start_values import bounds_of

FloatArray = npt.NDArray[np.float64]

SMOOTHING_SHRINK: Final = 1.5
"""Factor by which a smoothing velocity may fall below its start: the steps were chosen for the start."""
SOFTEST: Final = 12
"""Doublings of the smoothing velocities at most."""
EASY_SUBSTEPS: Final = 4
"""Steps per sample up to which friction counts as smooth enough: sharper, and Gauss-Newton steps stick at reversals."""
FEW_WINDOWS: Final = 40
"""Windows of the first steps; all of them take the last ones."""
SETTLED: Final = 1e-3
"""Relative fall of the cost by initial states alone that is worth another step of the parameters."""
ENOUGH: Final = 1e-5
"""Relative fall of the cost below which the iteration ends."""


@final
@dataclass(frozen=True)
class Refinement:
    """A fit refined by its output error.

    Attributes
    ----------
    fit : Fit
        As from :func:`identification.fit.fit`, with the refined values and their standard errors.
    before, after : mapping of str to float
        RMS of measured less simulated output by channel, initial states free in every window
        [rad or N.m; m or N for a linear axis].
    sigma : mapping of str to float
        What each channel was divided by: its noise level, or the error of the model where that is larger.
    cost_before, cost_after : float
        RMS of the weighted errors of all channels.
    iterations : int
    windows, samples : int
    """

    fit: Fit
    before: Mapping[str, float]
    after: Mapping[str, float]
    sigma: Mapping[str, float]
    cost_before: float
    cost_after: float
    iterations: int
    windows: int
    samples: int

    @property
    def model(self) -> Any:
        """The model with its refined values."""
        return self.fit.model

    @property
    def values(self) -> Mapping[str, float]:
        """Every parameter."""
        return {n: x for n, x in self.fit.solution.values.items() if not is_of_run(n)}

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Parameter table (see :func:`identification.parameters.parameter_table`)."""
        return self.fit.parameters


@dataclass
class _State:
    """Where the iteration stands."""

    values: dict[str, float]
    x0: FloatArray
    products: FloatArray
    damping: float = 1e-8

    def cost(self, sigma: FloatArray) -> float:
        """Sum of squares of the weighted errors."""
        return float(np.sum(self.products[:, :, -1, -1] / sigma[:, None] ** 2))

    def projected(self, sigma: FloatArray, states: int) -> float:
        """The cost that the best initial states would leave, to first order."""
        gram = weighted(self.products, sigma)
        if not np.isfinite(gram).all():
            return math.inf
        part = gram[:, :states, -1:]
        return float(np.sum(gram[:, -1, -1] - (part * np.linalg.solve(_ridged(gram[:, :states, :states]), part)).sum(axis=(1, 2))))


def refine(fit: Fit, records: Record | Sequence[Record] | None = None, *, window: float = 0.25, iterations: int = 8) -> Refinement:
    """Refine a fitted model by the error of its simulated outputs.

    Parameters
    ----------
    fit : Fit
        Start values: a weak-form fit.
    records : Record or sequence of Record, optional
        Records of the same channels; those of the fit by default.
    window : float
        Length of one window [s]; its initial state is free.
    iterations : int
        Gauss-Newton steps at most.

    Returns
    -------
    Refinement
        Its error is never larger than that of the start values.

    Raises
    ------
    InputError
        A model with internal states; records without a drive channel; records shorter than a window;
        a simulation that diverges.
    """
    given = [records] if isinstance(records, Record) else list(fit.records if records is None else records)
    _refuse(fit, given)
    model, limits = fit.model, bounds_of(fit.model, fit.joint.known, fit.data)
    free = tuple(n for n in fit.solution.free if n not in fit.solution.unidentified)
    start = {n: float(v) for n, v in fit.solution.values.items() if not is_of_run(n)}
    given = [without_calibration(r, model, fit.solution.values, run_name(r)) for r in given]
    start.update(dict.fromkeys(model.calibration, 0.0))
    data = cut_windows(given, fit.joint, fit.data.sensing, window)
    start, substeps = _followable(model, start, data)
    limits = {
        n: (max(low, start[n] / SMOOTHING_SHRINK), max(high, start[n])) if n.endswith("_smoothing_velocity") else (low, high)
        for n, (low, high) in limits.items()
    }
    shooting = Shooting(model, free, data, substeps)
    state = _settled(shooting, start, data.start_states(model.is_elastic))
    first = replace(state)
    before = shooting.rms(state.products)
    sigma, used = np.maximum(data.noise, before), 0
    stride = max(1, data.count // FEW_WINDOWS)
    if stride > 1:
        few = shooting.every(stride)
        part = _State(start, state.x0[::stride], state.products[:, ::stride])
        used = _iterate(few, part, limits, sigma, iterations)
        near = _settled(shooting, part.values, _settled(shooting, part.values, state.x0).x0)
        if near.cost(sigma) < state.cost(sigma):
            state = near
    for _ in range(2):
        # a channel is divided by the error of the model where that is above the noise
        sigma = np.maximum(data.noise, shooting.rms(state.products))
        used += _iterate(shooting, state, limits, sigma, max(iterations - used, 1))
    if state.cost(sigma) > first.cost(sigma):
        state = first
    after, total = shooting.rms(state.products), before.size * data.count * data.length
    names = data.channels
    return Refinement(
        _refined(fit, _with_calibration(fit, state.values), dict(zip(free, _stderr(state, shooting.states, sigma), strict=True)), limits, used),
        dict(zip(names, before.tolist(), strict=True)), dict(zip(names, after.tolist(), strict=True)),
        dict(zip(names, sigma.tolist(), strict=True)), math.sqrt(first.cost(sigma) / total), math.sqrt(state.cost(sigma) / total),
        used, data.count, data.count * data.length,
    )  # fmt: skip


def _with_calibration(fit: Fit, values: Mapping[str, float]) -> dict[str, float]:
    """Refined values with the calibration of the fit, which was taken off the records."""
    kept = {n: x for n, x in fit.solution.values.items() if n in fit.model.calibration or is_of_run(n)}
    return {**values, **kept}


def _followable(model: Any, values: dict[str, float], data: Windows) -> tuple[dict[str, float], int]:
    """Start values with friction smooth enough for the sample time, and the steps per sample."""
    names = [n for n in values if n.endswith("_smoothing_velocity")]
    for _ in range(SOFTEST if names else 0):
        try:
            substeps = substeps_for(model, values, data)
        except InputError:
            substeps = MOST_SUBSTEPS + 1
        if substeps <= EASY_SUBSTEPS:
            return values, substeps
        values = {**values, **{n: 2 * values[n] for n in names}}
    return values, substeps_for(model, values, data)


def _refuse(fit: Fit, records: Sequence[Record]) -> None:
    name = records[0].name if records else fit.joint.name
    if not records:
        raise InputError(f"{name}: the fit keeps no records; give the records to refine on")
    memory = [t.label for t in fit.model.terms if t.effect.memory is not None]
    if memory:
        raise InputError(f"{name}: output-error refinement does not simulate internal states of {', '.join(memory)}; use the weak-form fit")
    if fit.model.lagging_load and fit.solution.values["load_compliance"] > 0:
        raise InputError(f"{name}: output-error refinement needs link_position where the link swings on the gear's compliance; use the weak-form fit")
    if not fit.data.sensing.has_drive or fit.data.sensing.clamped_link:
        raise InputError(f"{name}: output-error refinement simulates the joint from its drive torque; add motor_current, motor_torque or motor_voltage")


def _settled(shooting: Shooting, values: dict[str, float], x0: FloatArray) -> _State:
    """The state of the iteration with initial states fitted and the parameters left alone."""
    n = shooting.states
    products = shooting.evaluate(values, x0)
    if not np.isfinite(products).all():
        raise InputError("output-error refinement: the simulation with the start values diverges; fit the model first or shorten the window")
    gram = weighted(products, shooting.noise)
    trial = x0 + np.linalg.solve(_ridged(gram[:, :n, :n]), gram[:, :n, -1:])[:, :, 0]
    moved = shooting.evaluate(values, trial)
    better = weighted(moved, shooting.noise)[:, -1, -1] < gram[:, -1, -1]
    x0 = np.where(better[:, None], trial, x0)
    products = np.where(better[:, None, None], moved, products)
    return _State(values, x0, products)


def _ridged(matrices: FloatArray) -> FloatArray:
    largest = np.einsum("wii->wi", matrices).max(axis=1)
    out: FloatArray = matrices + np.eye(matrices.shape[1]) * (1e-12 * largest + 1e-300)[:, None, None]
    return out


def _iterate(shooting: Shooting, state: _State, limits: Mapping[str, tuple[float, float]], sigma: FloatArray, iterations: int) -> int:
    """Damped Gauss-Newton steps; a step that raises the cost is shortened."""
    for used in range(1, iterations + 1):
        cost = state.cost(sigma)
        reduced, right, back, _ = schur(weighted(state.products, sigma), shooting.states)
        scale = np.sqrt(np.maximum(np.diag(reduced), 1e-300))
        promised = right / scale @ np.linalg.lstsq(reduced / np.outer(scale, scale), right / scale, rcond=1e-13)[0]
        unsettled = cost - state.projected(sigma, shooting.states)
        if used > 1 and promised + unsettled <= ENOUGH * cost:
            return used - 1
        for _ in range(5):
            values, step = _trial(shooting, state, limits, reduced, right)
            x0 = state.x0 + back[:, :, -1] - back[:, :, :-1] @ step
            trial = _State(values, x0, shooting.evaluate(values, x0))
            if trial.cost(sigma) <= cost:
                break
            state.damping = max(30 * state.damping, 1e-4)
        else:
            # windows whose own start state is off hold up the common step: their states first, one by one
            near = _settled(shooting, state.values, state.x0)
            if near.cost(sigma) >= (1 - SETTLED) * cost:
                return used
            state.x0, state.products, state.damping = near.x0, near.products, 1e-8
            continue
        gained = cost - trial.cost(sigma)
        state.values, state.x0, state.products = trial.values, trial.x0, trial.products
        state.damping = max(state.damping / 10, 1e-10)
        if gained <= ENOUGH * cost:
            return used
    return iterations


def schur(gram: FloatArray, states: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Normal equations of the parameters with the initial states eliminated.

    Parameters
    ----------
    gram : (windows, k, k) array
        Products of the columns (initial states, parameters, error).
    states : int

    Returns
    -------
    reduced : (parameters, parameters) array
    right : (parameters,) array
    back : (windows, states, parameters + 1) array
        Step of the initial states: last column less the others times the parameter step.
    scores : (windows, parameters) array
        What each window adds to `right`.
    """
    back: FloatArray = np.asarray(np.linalg.solve(_ridged(gram[:, :states, :states]), gram[:, :states, states:]), dtype=np.float64)
    rest: FloatArray = gram[:, states:, states:] - gram[:, states:, :states] @ back
    whole: FloatArray = rest.sum(axis=0)
    return whole[:-1, :-1], whole[:-1, -1], back, rest[:, :-1, -1]


def _stderr(state: _State, states: int, sigma: FloatArray) -> list[float]:
    """Standard errors of the free parameters from the scatter of the windows' scores."""
    reduced, _, _, scores = schur(weighted(state.products, sigma), states)
    scale = np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    inverse = np.linalg.pinv(reduced / np.outer(scale, scale), rcond=1e-12)
    scaled = scores / scale
    covariance = inverse @ (scaled.T @ scaled) @ inverse
    out: list[float] = (np.sqrt(np.maximum(np.diag(covariance), 0.0)) / scale).tolist()
    return out


def _trial(
    shooting: Shooting, state: _State, limits: Mapping[str, tuple[float, float]], reduced: FloatArray, right: FloatArray
) -> tuple[dict[str, float], FloatArray]:
    """Parameters after one step inside their bounds, and the step that was taken."""
    scale = np.sqrt(np.maximum(np.diag(reduced), 0.0))
    alive = scale > 1e-12 * scale.max(initial=0.0)
    step = np.zeros(len(scale))
    active = alive.copy()
    for _ in range(len(scale) + 1):
        index = np.flatnonzero(active)
        if not len(index):
            break
        a = reduced[np.ix_(index, index)] / np.outer(scale[index], scale[index]) + state.damping * np.eye(len(index))
        b = (right[index] - reduced[np.ix_(index, np.flatnonzero(~active))] @ step[~active]) / scale[index]
        step[index] = np.linalg.lstsq(a, b, rcond=1e-13)[0] / scale[index]
        outside = []
        for i in index.tolist():
            name = shooting.free[i]
            low, high = limits[name]
            if shooting.positive[i]:
                low, high = max(low, state.values[name] / 3), min(high, state.values[name] * 3)
            target = state.values[name] + step[i]
            if target < low or target > high:
                step[i] = min(max(target, low), high) - state.values[name]
                outside.append(i)
        if not outside:
            break
        active[outside] = False
    return {**state.values, **{n: state.values[n] + float(s) for n, s in zip(shooting.free, step, strict=True)}}, step


def _refined(fit: Fit, values: Mapping[str, float], stderr: Mapping[str, float], limits: Mapping[str, tuple[float, float]], used: int) -> Fit:
    """The fit with other values; errors and weights anew."""
    from identification.balances import Balances

    old = fit.solution
    model = replace(old.model, values={n: x for n, x in values.items() if not is_of_run(n)})
    weights = row_weights(Balances(model, fit.data.sensing, wrt=()), fit.data, values, old.sigma, fit.data.train)
    bound = tuple(
        n for n in old.free
        if not n.endswith("_smoothing_velocity")
        and any(math.isfinite(v) and abs(values[n] - v) <= 1e-9 * max(abs(v), 1e-300) for v in limits[n])
    )  # fmt: skip
    solution = replace(old, model=model, values=dict(values), stderr={**old.stderr, **stderr}, weights=weights, at_bound=bound, iterations=used)
    return replace(
        fit, solution=solution, train=assess(model, fit.data, fit.data.train, values),
        held_out=assess(model, fit.data, fit.data.held_out, values) if fit.data.held_out else None,
    )  # fmt: skip
