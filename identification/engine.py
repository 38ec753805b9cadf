"""Weighted least squares over the balances of several records: the numbers behind fit, compare and diagnose."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.balances import Balances, balances_of
from identification.calibration import bare, is_of_run, names_of_runs
from identification.dataset import Dataset, load_dataset, prepared_model, weak_record
from identification.errors import InputError
from identification.excitation import attenuation
from identification.stacked import Stacked, floor_rows, floors, references, rms, row_weights, stack, taking_part
from identification.standard_errors import block_errors
from identification.start_values import bounds_of, starts

__all__ = [
    "Dataset", "Solution", "Stacked", "floor_rows", "floors", "gauss_newton", "load_dataset", "memory_shapes_of", "prepared_model", "references",
    "rms", "row_weights", "solve", "stack", "taking_part", "weak_record",
]  # fmt: skip

FloatArray = npt.NDArray[np.float64]


@final
@dataclass(frozen=True)
class Solution:
    """A fitted model in the terms of the balances.

    Attributes
    ----------
    model : JointModel
        With the fitted values.
    values, stderr : mapping
        Every parameter; standard errors from blocks (None for fixed, nuisance or unidentifiable ones).
    free : tuple of str
    weights : mapping of str to (rows,) array
        1/sigma of each training row.
    sigma : mapping of str to float
    at_bound, unidentified : tuple of str
    correlation : mapping
        Largest correlation of each parameter with another one: (name, value).
    """

    model: JointModel
    values: Mapping[str, float]
    stderr: Mapping[str, float | None]
    free: tuple[str, ...]
    weights: Mapping[str, FloatArray]
    sigma: Mapping[str, float]
    at_bound: tuple[str, ...] = ()
    unidentified: tuple[str, ...] = ()
    correlation: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    iterations: int = 0


LEAST_SWING: Final = 0.05
"""Fall of the RMS by which a link that swings unseen must show itself; else the joint is taken as rigid."""
HIGHEST_SWING: Final = 4.0
"""Highest frequency of such a link in units of 1/kernel (the kernel's -3 dB point is 0.93): faster ones are rigid to these rows."""


def solve(
    model: JointModel, data: Dataset, *, iterations: int = 15, start: Mapping[str, float] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Solution:  # fmt: skip
    """Fit a model to the training rows by Levenberg-Marquardt steps on the weak form.

    Parameters
    ----------
    model : JointModel
    data : Dataset
    iterations : int
        At most so many in each of the two passes.
    start : mapping of str to float, optional
        Values to start from.
    progress : callable, optional
        ``progress(text, share)`` before each stage.

    Raises
    ------
    InputError
        A free parameter that moves no output.
    """
    if not model.lagging_load or "load_compliance" in data.joint.known:
        return _fitted(model, data, iterations, start or {}, progress)
    tied = {**(start or {}), "load_compliance": 0.0}
    rigid = _fitted(model, data, iterations, tied, progress, frozenset({"load_compliance", "swinging_share"}))
    swinging = _swings(rigid, data)
    if swinging is None:
        return rigid
    found = _fitted(model, data, iterations, start or {}, progress)
    # a start far from the scale of the torques can end in no fit at all: then the rigid fit is where to begin
    left = [_left(model, s.values, data) for s in (found, rigid)]
    return found if left[0] < left[1] else _fitted(model, data, iterations, swinging, progress)


def _left(model: JointModel, values: Mapping[str, float], data: Dataset) -> float:
    """RMS of what these values leave on the training rows of the one balance of an axis."""
    return rms(stack(balances_of(model, data.sensing, wrt=()), data.train, values).residual["axis"])


def _swings(rigid: Solution, data: Dataset) -> dict[str, float] | None:
    """Values with a link that swings unseen, where it shows itself in the rows of a model that was fitted as rigid; else None."""
    model = rigid.model
    free = [*rigid.free, "load_compliance", "swinging_share"]
    free = [n for n in model.parameter_names if n in free]
    balances = balances_of(model, data.sensing, wrt=free)
    limits = bounds_of(model, data.joint.known, data)
    values, _ = gauss_newton(balances, data, rigid.values, free, limits, rigid.sigma, rigid.weights, 6, memory_shapes_of(model, free))
    sizes = [_left(model, v, data) for v in (rigid.values, values)]
    lag = model.swinging_inertia(values) * values["load_compliance"]
    slow = lag * (2 * math.pi * HIGHEST_SWING / data.kernel) ** 2 > 1
    return values if slow and sizes[1] < (1 - LEAST_SWING) * sizes[0] else None


def _fitted(
    model: JointModel, data: Dataset, iterations: int, start: Mapping[str, float], progress: Callable[[str, float], None] | None,
    held: frozenset[str] = frozenset(),
) -> Solution:  # fmt: skip
    """The fit itself; the parameters `held` keep their start values."""
    known = data.joint.known
    values = starts(model, data)
    values.update({k: v for k, v in start.items() if k in values})
    fixed = {n: k.value for n, k in known.items() if k.value is not None and n in values}
    values.update({n: v for n, v in fixed.items() if v is not None})
    limits = bounds_of(model, known, data)
    shapes = {p.name for p in model.parameters if p.is_shape}
    runs = names_of_runs(model, data.train)
    free = [*(n for n in model.parameter_names if n not in fixed and n not in held and n not in model.calibration), *runs]
    balances = balances_of(model, data.sensing, wrt=bare(free))
    memory_shapes = memory_shapes_of(model, free)
    for n in free:
        low, high = limits[n]
        values[n] = min(max(values[n], low), high)
    tell = progress or (lambda text, share: None)
    tell("start values", 0.0)
    # first pass without shapes: linear amplitudes from any start
    sigma = dict.fromkeys(balances.balances, 1.0)
    linear_only = [n for n in free if n not in shapes and not is_of_run(n)]
    _check_moves(balances, data, values, linear_only)
    values, _ = gauss_newton(balances, data, values, linear_only, limits, sigma, {}, 3, memory_shapes)
    values = _best_start(balances, data, values, free, limits, memory_shapes)
    for number in range(2):
        tell(("first pass", "second pass")[number], 0.2 + 0.35 * number)
        sigma = _sigmas(model, data, values)
        weights = row_weights(balances, data, values, sigma, data.train)
        values, used = gauss_newton(balances, data, values, free, limits, sigma, weights, iterations, memory_shapes)
    sigma = _sigmas(model, data, values)
    weights = row_weights(balances, data, values, sigma, data.train)
    tell("standard errors", 0.9)
    return _with_errors(model, balances, data, values, free, limits, weights, sigma, memory_shapes, used)


def _sigmas(model: JointModel, data: Dataset, values: Mapping[str, float]) -> dict[str, float]:
    """RMS of each balance on the training rows, at least its floor."""
    residual = stack(balances_of(model, data.sensing, wrt=()), data.train, values).residual
    floor = floors(model, data, values)
    return {b: max(rms(r[taking_part(b, data.train)]), floor[b], 1e-12) for b, r in residual.items()}


def _best_start(
    balances: Balances, data: Dataset, values: dict[str, float], free: Sequence[str],
    limits: Mapping[str, tuple[float, float]], memory_shapes: Sequence[str],
) -> dict[str, float]:  # fmt: skip
    """Friction laws with a shape near zero velocity have several valleys: the best of a few smoothing velocities and exponents."""
    shaped = [t for t in balances.model.terms if t.effect.key in ("stribeck", "lugre", "load_dependent_presliding")]
    if not shaped:
        return values
    smooth = [f"{t.place}_smoothing_velocity" for t in shaped]
    exponents = [n for t in shaped for n in t.names if n.endswith("exponent") and n in free]
    trials = [dict(values)]
    for share in (0.003, 0.01):
        for power in (1.0, 2.0) if exponents else (1.0,):
            moved = {n: min(max(share * data.ranges["velocity"], limits[n][0]), limits[n][1]) for n in smooth if n in free}
            trials.append({**values, **moved, **dict.fromkeys(exponents, power)})
    floor = floors(balances.model, data, values)
    sigma = {b: max(floor[b], 1e-12) for b in floor}
    reference = trials[-1]
    weights = row_weights(balances, data, reference, sigma, data.train)
    bare = balances_of(balances.model, data.sensing, wrt=())
    best: tuple[float, dict[str, float]] | None = None
    for trial in trials:
        fitted, _ = gauss_newton(balances, data, trial, free, limits, sigma, weights, 6, memory_shapes)
        residual = stack(bare, data.train, fitted).residual
        cost = sum(float(np.sum((residual[b] * weights[b]) ** 2)) for b in residual)
        if best is None or cost < best[0]:
            best = (cost, fitted)
    return best[1] if best is not None else values


def memory_shapes_of(model: JointModel, free: Sequence[str]) -> tuple[str, ...]:
    """Shape parameters that act through internal states only: differentiated numerically."""
    out = []
    for t in model.terms:
        if t.effect.memory is not None:
            out += [n for n, p in zip(t.names, t.effect.parameters, strict=True) if p.is_shape and n in free]
    return tuple(out)


def _jacobian(balances: Balances, data: Dataset, values: Mapping[str, float], free: Sequence[str], memory_shapes: Sequence[str]) -> Stacked:
    """Stacked residual and Jacobian with the columns of `free`."""
    stacked = stack(balances, data.train, values, free)
    jacobian = {b: np.array(j) for b, j in stacked.jacobian.items()}
    numeric = [n for n in memory_shapes if n in free]
    if numeric:
        bare = balances_of(balances.model, data.sensing, wrt=())
        for n in numeric:
            step = 1e-2 * values[n]
            moved = stack(bare, data.train, {**values, n: values[n] + step}).residual
            for b in jacobian:
                jacobian[b][:, list(free).index(n)] = (moved[b] - stacked.residual[b]) / step
    return Stacked(stacked.residual, jacobian, stacked.block, stacked.taking)


def _check_moves(balances: Balances, data: Dataset, values: Mapping[str, float], free: Sequence[str]) -> None:
    stacked = _jacobian(balances, data, values, free, ())
    dead = [
        n for i, n in enumerate(free)
        if max(float(np.abs(j[:, i]).max(initial=0.0)) for j in stacked.jacobian.values()) == 0.0 and values[n] != 0.0
    ]  # fmt: skip
    truly = [n for n in dead if n in ("motor_inertia", "link_inertia", "inertia", "stiffness")]
    if truly:
        raise InputError(f"parameter {', '.join(truly)} moves no output of these records; give it a known value or add the channel that shows it")


def gauss_newton(
    balances: Balances, data: Dataset, values: Mapping[str, float], free: Sequence[str],
    limits: Mapping[str, tuple[float, float]], sigma: Mapping[str, float], weights: Mapping[str, FloatArray],
    iterations: int, memory_shapes: Sequence[str],
) -> tuple[dict[str, float], int]:  # fmt: skip
    """Damped Gauss-Newton with bounds; shape parameters move on a log scale.

    Parameters
    ----------
    balances : Balances
        With a Jacobian column for every one of `free`.
    data : Dataset
        Its training records are fitted.
    values, free, limits
        Start values of every parameter, the names that move, their bounds.
    sigma, weights
        Scale of each balance, and 1/sigma of each row where it is known.
    iterations : int
        At most so many.
    memory_shapes : sequence of str
        Those of `memory_shapes_of`: differentiated numerically.

    Returns
    -------
    values, iterations used
    """
    now = dict(values)
    parameters = {p.name: p for p in balances.model.parameters}
    logs = np.array([n in parameters and parameters[n].is_shape and parameters[n].scale != "absolute" for n in free])
    bare = balances_of(balances.model, data.sensing, wrt=())

    def scaled(residual: Mapping[str, FloatArray]) -> FloatArray:
        return np.concatenate([residual[b] * (weights[b] if b in weights else 1 / sigma[b]) for b in balances.balances])

    damping = 1e-9
    cost = math.inf
    for used in range(1, iterations + 1):
        stacked = _jacobian(balances, data, now, free, memory_shapes)
        r = scaled(stacked.residual)
        j = np.concatenate([stacked.jacobian[b] * (weights[b][:, None] if b in weights else 1 / sigma[b]) for b in balances.balances])
        j = j * np.where(logs, [now[n] for n in free], 1.0)
        cost = float(r @ r)
        norms = np.linalg.norm(j, axis=0)
        alive = norms > 1e-12 * max(float(norms.max(initial=0.0)), 1e-300)
        better = False
        for _ in range(6):
            step = _bounded_step(j / np.where(alive, norms, 1.0), -r, alive, norms, damping, now, free, limits, logs)
            trial = dict(now)
            for n, s, log in zip(free, step, logs, strict=True):
                low, high = limits[n]
                trial[n] = min(max(now[n] * math.exp(min(max(s, -1.0), 1.0)) if log else now[n] + s, low), high)
            after = scaled(stack(bare, data.train, trial).residual)
            if float(after @ after) <= cost * (1 + 1e-12):
                better = True
                break
            damping = max(damping * 30, 1e-4)
        if not better:
            return now, used
        gained = cost - float(after @ after)
        now = trial
        damping = max(damping / 10, 1e-12)
        if gained <= 1e-6 * cost:
            return now, used
    return now, iterations


def _bounded_step(
    j: FloatArray, r: FloatArray, alive: npt.NDArray[np.bool_], norms: FloatArray, damping: float,
    now: Mapping[str, float], free: Sequence[str], limits: Mapping[str, tuple[float, float]], logs: npt.NDArray[np.bool_],
) -> FloatArray:  # fmt: skip
    """Least-squares step; a parameter that would leave its bound goes to the bound and the others are solved again."""
    active = alive.copy()
    fixed = np.zeros(len(free))
    step = np.zeros(len(free))
    gram, right = j.T @ j, j.T @ r
    for _ in range(len(free) + 1):
        index = np.flatnonzero(active)
        if not len(index):
            break
        a = gram[np.ix_(index, index)] + damping * np.eye(len(index))
        b = right[index] - gram[np.ix_(index, np.flatnonzero(~active))] @ fixed[~active]
        part = np.linalg.lstsq(a, b, rcond=1e-13)[0]
        step[:] = fixed
        step[index] = part
        outside = []
        for i in index.tolist():
            if logs[i]:
                continue
            low, high = limits[free[i]]
            target = now[free[i]] + step[i] / norms[i]
            if target < low - 1e-12 * abs(low) or target > high + 1e-12 * abs(high):
                fixed[i] = (min(max(target, low), high) - now[free[i]]) * norms[i]
                outside.append(i)
        if not outside:
            break
        active[outside] = False
    step[~active] = fixed[~active]
    return np.where(alive, step / np.where(alive, norms, 1.0), 0.0)


def _with_errors(
    model: JointModel, balances: Balances, data: Dataset, values: Mapping[str, float], free: Sequence[str],
    limits: Mapping[str, tuple[float, float]], weights: Mapping[str, FloatArray], sigma: Mapping[str, float],
    memory_shapes: Sequence[str], used: int,
) -> Solution:  # fmt: skip
    """Standard errors from blocks of time and from what noise of the positions takes off; what cannot be identified is said."""
    stacked = _jacobian(balances, data, values, free, memory_shapes)
    j = np.concatenate([stacked.jacobian[b] * weights[b][:, None] for b in balances.balances])
    r = np.concatenate([stacked.residual[b] * weights[b] for b in balances.balances])
    block = np.tile(stacked.block, len(balances.balances))
    norms = np.linalg.norm(j, axis=0)
    at_bound = [
        n for n in free
        if any(math.isfinite(limit) and abs(values[n] - limit) <= 1e-9 * max(abs(limit), 1e-300) for limit in limits[n])
        and not n.endswith("_smoothing_velocity")
    ]  # fmt: skip
    usable = np.array([norm > 1e-12 * norms.max() and n not in at_bound for n, norm in zip(free, norms, strict=True)])
    stderr: dict[str, float | None] = dict.fromkeys(values)
    correlation: dict[str, tuple[str, float]] = {}
    unidentified = [n for n, norm in zip(free, norms, strict=True) if norm <= 1e-12 * norms.max() and not n.endswith("_smoothing_velocity")]
    index = np.flatnonzero(usable)
    if len(index):
        scaled = j[:, index] / norms[index]
        inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12)
        errors = block_errors(scaled, r, block)
        pulled = {name.replace(" ", "_"): share for name, share in attenuation(data).items()}
        biases = np.array([pulled.get(free[i], 0.0) * values[free[i]] for i in index.tolist()])
        size = None if errors is None else np.hypot(errors / norms[index], biases)
        spread = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
        corr = inverse / np.outer(spread, spread)
        np.fill_diagonal(corr, 0.0)
        corr[:, [is_of_run(free[i]) for i in index.tolist()]] = 0.0
        for k, i in enumerate(index.tolist()):
            stderr[free[i]] = None if size is None else float(size[k])
            other = int(np.argmax(np.abs(corr[k])))
            correlation[free[i]] = (free[int(index[other])], float(corr[k, other]))
            weak = size is not None and values[free[i]] != 0 and size[k] > abs(values[free[i]])
            if (spread[k] > 1e4 or weak) and not free[i].endswith("_smoothing_velocity") and not is_of_run(free[i]):
                unidentified.append(free[i])
    kept = dict(values)
    for n in model.calibration:
        kept[n] = float(np.mean([kept[k] for k in free if is_of_run(k) and k.startswith(f"{n}[")]))
    own = {n: x for n, x in kept.items() if not is_of_run(n)}
    return Solution(
        replace(model, values=own), kept, stderr, tuple(n for n in free if not is_of_run(n)), weights, sigma, tuple(at_bound), tuple(unidentified),
        correlation, used,
    )  # fmt: skip
