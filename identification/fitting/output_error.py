"""Output-error refinement: the simulated outputs of a fitted model against the measured ones,
window by window.

Multiple shooting: the record is cut into short windows with free initial states; Runge-Kutta steps
of 4th order carry the sensitivities along, and the least-squares solver eliminates the initial
states of each window (Bock's direct multiple shooting without continuity conditions).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.calibration import is_of_run, without_calibration
from identification.balance.dataset import HOLD_NAME, run_name
from identification.data.record import Record, listed
from identification.errors import InputError
from identification.fitting.assess import assess
from identification.fitting.covariance import (
    cores,
    errors_of_windows,
    independent,
    windows_over,
)
from identification.fitting.engine import row_weights
from identification.fitting.fit import Fit
from identification.fitting.least_squares import common_rows, least_squares, triangles_of_products
from identification.fitting.shooting import (
    MOST_SUBSTEPS,
    Shooting,
    Windows,
    cut_windows,
    substeps_for,
)
from identification.fitting.start_values import bounds_of

FloatArray = npt.NDArray[np.float64]

SMOOTHING_SHRINK: Final = 1.5
"""Factor by which a smoothing velocity may fall below its start: the steps were chosen for the
start.
"""
SOFTEST: Final = 12
"""Doublings of the smoothing velocities at most."""
EASY_SUBSTEPS: Final = 4
"""Steps per sample up to which friction counts as smooth enough: sharper, and Gauss-Newton
steps stick at reversals.
"""
FEW_WINDOWS: Final = 40
"""Windows of the first steps; all of them take the last ones."""
ENOUGH: Final = 1e-5
"""Relative fall of the cost below which the iteration ends."""


@final
@dataclass(frozen=True)
class Refinement:
    """A fit refined by its output error.

    Attributes
    ----------
    fit : Fit
        As from :func:`identification.fitting.fit.fit`, with the refined values and their standard
        errors.
    before, after : mapping of str to float
        RMS of measured less simulated output by channel, initial states free in every window
        [rad or N.m; m or N for a linear axis].
    sigma : mapping of str to float
        What each channel was divided by: its noise level, or the error of the model where that is
        larger.
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
        """Parameter table (see :func:`identification.fitting.parameters.parameter_table`)."""
        return self.fit.parameters


@final
@dataclass(frozen=True)
class OutputError:
    """Errors of the simulated outputs, window by window; a
    :class:`identification.fitting.least_squares.LocalProblem`.

    Attributes
    ----------
    shooting : Shooting
    values : mapping of str to float
        Of every parameter; those not free stay.
    sigma : (channels,) array
        What the errors of each channel are divided by.
    free : bool
        False: the initial states alone move.
    """

    shooting: Shooting
    values: Mapping[str, float]
    sigma: FloatArray
    free: bool = True

    def at(self, x: FloatArray) -> dict[str, float]:
        """Values of every parameter."""
        return {**self.values, **dict(zip(self.shooting.free, map(float, x), strict=False))}

    def costs(self, x: FloatArray, local: FloatArray) -> FloatArray:
        """Sum of squares of each window."""
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.sum(self.shooting.errors(self.at(x), local) ** 2, axis=2) / self.sigma**2
            return np.asarray(squares.sum(axis=1), dtype=np.float64)

    def triangles(self, x: FloatArray, local: FloatArray) -> FloatArray:
        """Triangle of each window: initial states, free parameters, error."""
        columns = self.shooting.columns(self.at(x), local) / self.sigma[:, None]
        if not self.free:
            columns = np.concatenate([columns[:, : self.shooting.states], columns[:, -1:]], axis=1)
        flat = columns.reshape(*columns.shape[:2], -1)
        return triangles_of_products(flat @ flat.transpose(0, 2, 1))

    def settled(self, local: FloatArray) -> FloatArray:
        """Initial states after one step of their own, in the windows where that lowers the
        error.
        """
        alone = replace(self, free=False)
        return least_squares(alone, [], local=local, iterations=1).local

    def errors(self, x: FloatArray, local: FloatArray) -> list[float]:
        """Standard errors of the free parameters, the initial states of each window of the
        simulation eliminated; infinite where the record is too short for them.
        """
        data, unknowns = self.shooting.data, self.shooting.states
        rest = common_rows(self.triangles(x, local), unknowns)
        products = rest.transpose(0, 2, 1) @ rest
        columns, scores = products[:, :-1, :-1], products[:, :-1, -1]
        windows = windows_over([data.inputs[5, :: data.length]])
        found = errors_of_windows(
            np.tensordot(cores(windows).toarray(), columns, axes=1),
            windows @ scores,
            columns.sum(axis=0),
            independent(windows),
        )
        return [math.inf] * len(self.shooting.free) if found is None else found.tolist()


def refine(
    fit: Fit,
    records: Record | Sequence[Record] | None = None,
    *,
    window: float = 0.25,
    iterations: int = 8,
) -> Refinement:
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
        A model with internal states; records without a drive channel; records shorter than a
        window; a simulation that diverges.
    """
    given = listed(fit.records if records is None else records)
    _refuse(fit, given)
    model, limits = fit.model, bounds_of(fit.model, fit.joint.known, fit.data)
    free = tuple(n for n in fit.solution.free if n not in fit.solution.unidentified)
    start = {n: float(v) for n, v in fit.solution.values.items() if not is_of_run(n)}
    given = [without_calibration(r, model, fit.solution.values, run_name(r)) for r in given]
    start.update({n: 0.0 for n in model.calibration if n != HOLD_NAME})
    data = cut_windows(given, fit.joint, fit.data.sensing, window)
    start, substeps = _followable(model, start, data)
    smoothing = model.named("smoothing")
    limits = {
        n: (max(low, start[n] / SMOOTHING_SHRINK), max(high, start[n]))
        if n in smoothing
        else (low, high)
        for n, (low, high) in limits.items()
    }
    shooting = Shooting(model, free, data, substeps)
    begin = OutputError(shooting, start, data.noise)
    local = begin.settled(data.start_states(model.is_elastic))
    before = _rms(begin.shooting, start, local)
    if not np.isfinite(before).all():
        raise InputError(
            "output-error refinement: the simulation with the start values diverges; fit the "
            "model first or shorten the window"
        )
    x = np.array([start[n] for n in free])
    box = [limits[n][0] for n in free], [limits[n][1] for n in free]
    problem, used = replace(begin, sigma=np.maximum(data.noise, before)), 0
    first = x, local
    stride = max(1, data.count // FEW_WINDOWS)
    if stride > 1:
        few = replace(problem, shooting=shooting.every(stride))
        part = least_squares(
            few,
            x,
            box,
            logarithmic=shooting.logarithmic,
            local=local[::stride],
            iterations=iterations,
            tolerance=ENOUGH,
        )
        used = part.iterations
        near = replace(problem, values=problem.at(part.x))
        own = near.settled(near.settled(local))
        if float(near.costs(part.x, own).sum()) < float(problem.costs(x, local).sum()):
            x, local = part.x, own
    for _ in range(2):
        # a channel is divided by the error of the model where that is above the noise
        problem = replace(
            problem, sigma=np.maximum(data.noise, _rms(shooting, problem.at(x), local))
        )
        left = max(iterations - used, 1)
        found = least_squares(
            problem,
            x,
            box,
            logarithmic=shooting.logarithmic,
            local=local,
            iterations=left,
            tolerance=ENOUGH,
        )
        x, local, used = found.x, found.local, used + found.iterations
    costs = [float(problem.costs(*point).sum()) for point in (first, (x, local))]
    if costs[1] > costs[0]:
        (x, local), costs = first, [costs[0], costs[0]]
    values, sigma = problem.at(x), problem.sigma
    after, total = _rms(shooting, values, local), before.size * data.count * data.length
    names = data.channels
    return Refinement(
        _refined(
            fit,
            _with_calibration(fit, values),
            dict(zip(free, problem.errors(x, local), strict=True)),
            limits,
            used,
        ),
        dict(zip(names, before.tolist(), strict=True)),
        after=dict(zip(names, after.tolist(), strict=True)),
        sigma=dict(zip(names, sigma.tolist(), strict=True)),
        cost_before=math.sqrt(costs[0] / total),
        cost_after=math.sqrt(costs[1] / total),
        iterations=used,
        windows=data.count,
        samples=data.count * data.length,
    )


def _rms(shooting: Shooting, values: Mapping[str, float], local: FloatArray) -> FloatArray:
    """RMS error of each channel."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(
            np.sqrt(np.mean(shooting.errors(values, local) ** 2, axis=(0, 2))), dtype=np.float64
        )


def _with_calibration(fit: Fit, values: Mapping[str, float]) -> dict[str, float]:
    """Refined values with the calibration of the fit, which was taken off the records."""
    kept = {
        n: x for n, x in fit.solution.values.items() if n in fit.model.calibration or is_of_run(n)
    }
    return {**values, **kept}


def _followable(
    model: Any, values: dict[str, float], data: Windows
) -> tuple[dict[str, float], int]:
    """Start values with friction smooth enough for the sample time, and the steps per sample."""
    names = list(model.named("smoothing"))
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
        raise InputError(
            f"{name}: output-error refinement does not simulate internal states of "
            f"{', '.join(memory)}; use the weak-form fit"
        )
    if fit.model.load_compliance(fit.solution.values) > 0:
        raise InputError(
            f"{name}: output-error refinement needs link_position where the link swings on the "
            "gear's compliance; use the weak-form fit"
        )
    if not fit.data.sensing.has_drive or fit.data.sensing.clamped_link:
        raise InputError(
            f"{name}: output-error refinement simulates the joint from its drive torque; add "
            "motor_current, motor_torque or motor_voltage"
        )


def _refined(
    fit: Fit,
    values: Mapping[str, float],
    stderr: Mapping[str, float],
    limits: Mapping[str, tuple[float, float]],
    used: int,
) -> Fit:
    """The fit with other values; errors and weights anew."""
    from identification.balance.balances import Balances

    old = fit.solution
    model = replace(old.model, values={n: x for n, x in values.items() if not is_of_run(n)})
    weights = row_weights(
        Balances(model, fit.data.sensing, wrt=()), fit.data, values, old.sigma, fit.data.train
    )
    bound = tuple(
        n
        for n in old.free
        if n not in model.named("smoothing")
        and any(
            math.isfinite(v) and abs(values[n] - v) <= 1e-9 * max(abs(v), 1e-300) for v in limits[n]
        )
    )
    solution = replace(
        old,
        model=model,
        values=dict(values),
        stderr={**old.stderr, **stderr},
        tied={},  # of other errors
        weights=weights,
        at_bound=bound,
        iterations=used,
    )
    return replace(
        fit,
        solution=solution,
        train=assess(model, fit.data, fit.data.train, values),
        held_out=assess(model, fit.data, fit.data.held_out, values) if fit.data.held_out else None,
    )
