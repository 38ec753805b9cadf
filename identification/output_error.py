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

from identification._shooting import Shooting, Windows, cut_windows, substeps_for
from identification.assess import assess
from identification.engine import bounds_of, row_weights
from identification.errors import InputError
from identification.fit import Fit
from identification.record import Record

FloatArray = npt.NDArray[np.float64]

SMOOTHING_SHRINK: Final = 1.5
"""Factor by which a smoothing velocity may fall below its start: the steps were chosen for the start."""
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
        return self.fit.solution.values

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Parameter table (see :func:`identification.parameters.parameter_table`)."""
        return self.fit.parameters


@dataclass
class _State:
    """Where the iteration stands."""

    values: dict[str, float]
    x0: FloatArray
    sigma: FloatArray
    cost: float = math.inf
    damping: float = 1e-8


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
    start = {n: float(v) for n, v in fit.solution.values.items()}
    for n in free:
        low, high = limits[n]
        limits[n] = (max(low, start[n] / SMOOTHING_SHRINK), high) if n.endswith("_smoothing_velocity") else (low, high)
    data = cut_windows(given, fit.joint, fit.data.sensing, window)
    shooting = Shooting(model, free, data, substeps_for(model, start, data))
    state = _State(start, data.start_states(model.is_elastic), data.noise.copy())
    _settle(shooting, state)
    before, sigma = shooting.channel_rms(state.values, state.x0), data.noise
    cost_before = math.inf
    used = 0
    for _ in range(2):
        # the second round divides a channel by the error of the model where that is above the noise
        sigma = np.maximum(data.noise, shooting.channel_rms(state.values, state.x0))
        first = float(np.sqrt(np.mean((before / sigma) ** 2)))
        state.sigma, state.cost = sigma, math.inf
        used += _iterate(shooting, state, limits, iterations - used)
        cost_before = first
    after = shooting.channel_rms(state.values, state.x0)
    cost_after = float(np.sqrt(np.mean((after / sigma) ** 2)))
    if cost_after > cost_before:
        state.values, after, cost_after = start, before, cost_before
    stderr = shooting.standard_errors(state.values, state.x0, state.sigma)
    names = data.channels
    return Refinement(
        _refined(fit, state.values, stderr, limits, used),
        dict(zip(names, before.tolist(), strict=True)), dict(zip(names, after.tolist(), strict=True)),
        dict(zip(names, sigma.tolist(), strict=True)), cost_before, cost_after, used, data.count, data.count * data.length,
    )  # fmt: skip


def _refuse(fit: Fit, records: Sequence[Record]) -> None:
    name = records[0].name if records else fit.joint.name
    if not records:
        raise InputError(f"{name}: the fit keeps no records; give the records to refine on")
    memory = [t.label for t in fit.model.terms if t.effect.memory is not None]
    if memory:
        raise InputError(f"{name}: output-error refinement does not simulate internal states of {', '.join(memory)}; use the weak-form fit")
    if not fit.data.sensing.has_drive or fit.data.sensing.clamped_link:
        raise InputError(f"{name}: output-error refinement simulates the joint from its drive torque; add motor_current, motor_torque or motor_voltage")


def _settle(shooting: Shooting, state: _State) -> None:
    """Initial states alone, with the start values of the parameters."""
    for _ in range(3):
        gram = shooting.gram(state.values, state.x0, state.sigma)
        if not np.isfinite(gram).all():
            raise InputError("output-error refinement: the simulation with the start values diverges; fit the model first or shorten the window")
        n = shooting.states
        state.x0 = state.x0 + np.linalg.solve(_ridged(gram[:, :n, :n]), gram[:, :n, -1:])[:, :, 0]


def _ridged(matrices: FloatArray) -> FloatArray:
    diagonal = np.einsum("wii->wi", matrices)
    return matrices + np.eye(matrices.shape[1]) * (1e-12 * diagonal.max(axis=1)[:, None] + 1e-300)[:, :, None]


def _iterate(shooting: Shooting, state: _State, limits: Mapping[str, tuple[float, float]], iterations: int) -> int:
    """Damped Gauss-Newton steps; a step that raises the cost is shortened."""
    gram = shooting.gram(state.values, state.x0, state.sigma)
    state.cost = float(gram[:, -1, -1].sum())
    for used in range(1, iterations + 1):
        reduced, right, back = schur(gram, shooting.states)
        for _ in range(5):
            trial, moved = _trial(shooting, state, limits, reduced, right)
            x0 = state.x0 + back[0] - np.einsum("wij,j->wi", back[1], moved)
            after = shooting.gram(trial, x0, state.sigma)
            cost = float(after[:, -1, -1].sum())
            if math.isfinite(cost) and cost <= state.cost:
                break
            state.damping = max(30 * state.damping, 1e-4)
        else:
            return used
        gained = state.cost - cost
        state.values, state.x0, state.cost, gram = trial, x0, cost, after
        state.damping = max(state.damping / 10, 1e-10)
        if gained <= ENOUGH * cost:
            return used
    return iterations


def schur(gram: FloatArray, states: int) -> tuple[FloatArray, FloatArray, tuple[FloatArray, FloatArray]]:
    """Normal equations of the parameters with the initial states eliminated.

    Parameters
    ----------
    gram : (windows, k, k) array
        Products of the columns (initial states, parameters, residual).
    states : int

    Returns
    -------
    reduced : (parameters, parameters) array
    right : (parameters,) array
    back : (windows, states) and (windows, states, parameters) array
        Initial states: their own step, and what a parameter step takes off it.
    """
    block = np.linalg.solve(_ridged(gram[:, :states, :states]), gram[:, :states, states:])
    rest = gram[:, states:, states:] - gram[:, states:, :states] @ block
    whole = rest.sum(axis=0)
    return whole[:-1, :-1], whole[:-1, -1], (block[:, :, -1], block[:, :, :-1])


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


def _refined(
    fit: Fit, values: Mapping[str, float], stderr: Mapping[str, float], limits: Mapping[str, tuple[float, float]], used: int
) -> Fit:
    """The fit with other values; errors and weights anew."""
    from identification.balances import Balances

    old = fit.solution
    model = replace(old.model, values=dict(values))
    weights = row_weights(Balances(model, fit.data.sensing, wrt=()), fit.data, values, old.sigma, fit.data.train)
    bound = tuple(
        n for n in old.free
        if not n.endswith("_smoothing_velocity")
        and any(math.isfinite(v) and abs(values[n] - v) <= 1e-9 * max(abs(v), 1e-300) for v in limits[n])
    )  # fmt: skip
    solution = replace(
        old, model=model, values=dict(values), stderr={**old.stderr, **stderr}, weights=weights, at_bound=bound, iterations=used
    )
    return replace(
        fit, solution=solution, train=assess(model, fit.data, fit.data.train, values),
        held_out=assess(model, fit.data, fit.data.held_out, values) if fit.data.held_out else None,
    )  # fmt: skip


__all__ = ["Refinement", "Windows", "refine"]
