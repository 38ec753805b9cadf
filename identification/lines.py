"""Lines: residual that repeats with the motor angle or with the position, at an order nobody has to name beforehand.

A stage of its own beside the fit: the residual of the fitted model is taken at every sample, torque and drive as they were
recorded, and tracked along the angle (:mod:`identification.order_tracking`). The kernel of the balances, which would hide
lines above 15 Hz, has no part in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from casadi_models import EFFECTS, JointModel, Signals
from casadi_models.vectorised import Vectorised
from identification.balances import Memory, residual_expressions
from identification.candidates import observable
from identification.dataset import Dataset
from identification.engine import Solution
from identification.joint_file import Joint
from identification.order_tracking import (
    BLOCK,
    Peak,
    Samples,
    background,
    clipped,
    confirmed,
    detrended,
    peaks,
    phase_fit,
    spectrum,
    trend,
    velocity_knots,
)
from identification.record import Record
from identification.sensing import Sensing, signals_of
from identification.weak import POSITION_CHAINS, Grid, WeakRecord, kernel

__all__ = ["Line", "find_lines", "highest_order", "named_orders"]

FloatArray = npt.NDArray[np.float64]

MOTOR_ORDERS: Final = (1.0, 2.0, 4.0)
"""Orders per motor turn that have a name: shaft, wave generator and its second harmonic (T. Tuttle, W. Seering 1996)."""
LOWEST_ORDER: Final = 0.25
"""Periods per motor turn (or pitch) from which on an order is looked for that nobody named: what is slower belongs to the link."""
SPANS: Final = (7, 11, 15, 31)
"""Samples over which velocity and acceleration are smoothed; the span that leaves the least is taken."""
NAME_GAIN: Final = 0.85
"""Share of the best name's power over the balances that a name of the same set explains: a name that loses more is another one."""
MEMORY_KERNEL: Final = 0.03
"""Kernel of the positions that drive internal states [s]: quantisation wipes out a memory."""
NORMAL_95: Final = 1.96


@final
@dataclass(frozen=True)
class Line:
    """A line in the residual of a balance.

    Attributes
    ----------
    order : float
        Periods per turn of the motor (or per metre).
    tolerance : float
        2 pi / stroke: orders that are nearer to each other are one line.
    amplitude : float
        Of the residual [N.m, N].
    balance : str
    prominence : float
        Power over that of its surroundings.
    effects : tuple of str
        Names where the balances and the order tell; empty for a function of the position that the library has no name for.
    held_out_drop_percent : float
        Fall of the RMS on held-out records.
    order_error : float
        Standard error of the order.
    amplitude_low, amplitude_high : float
        95 % band of the amplitude.
    """

    order: float
    tolerance: float
    amplitude: float
    balance: str
    prominence: float
    effects: tuple[str, ...]
    held_out_drop_percent: float
    per: str = "motor turn"
    unit: str = "N.m"
    order_error: float | None = None
    amplitude_low: float | None = None
    amplitude_high: float | None = None

    def as_json(self) -> dict[str, Any]:
        """The shape of `improve --json`."""
        return {
            "order": self.order, "per": self.per, "tolerance": self.tolerance, "amplitude": self.amplitude,
            "unit": self.unit, "effects": list(self.effects), "balance": self.balance, "order_error": self.order_error,
            "amplitude_low": self.amplitude_low, "amplitude_high": self.amplitude_high, "prominence": self.prominence,
            "held_out_drop_percent": self.held_out_drop_percent,
        }  # fmt: skip


def named_orders(joint: Joint) -> tuple[float, ...]:
    """Orders that have a name: of the motor turn, of the pitch of a linear axis, and those the joint file gives."""
    turn = turns_per_unit(joint)
    return (*(h * turn for h in MOTOR_ORDERS if turn), *joint.orders)


def turns_per_unit(joint: Joint) -> float:
    """Motor turns per unit of an order: one per turn; one over the pitch per metre; 0 where no pitch is known."""
    if joint.kind != "linear":
        return 1.0
    if joint.pitch is not None:
        return 1.0 / joint.pitch
    return abs(joint.gear_ratio) / (2 * math.pi) if abs(joint.gear_ratio) != 1.0 else 0.0


def _angle_factor(joint: Joint) -> float:
    """Link-referred position to the angle of the orders."""
    return 2 * math.pi if joint.kind == "linear" else abs(joint.gear_ratio)


@final
@dataclass(frozen=True)
class _Run:
    """One record at every sample: what the laws see, and the second that each sample belongs to."""

    rows: WeakRecord
    block: npt.NDArray[np.int64]
    masked: frozenset[str]


def at_every_sample(record: Record, joint: Joint, sensing: Sensing, span: int) -> WeakRecord:
    """Signals of a record at every sample: torque, drive and positions as recorded, derivatives over `span` samples.

    Parameters
    ----------
    record : Record
    joint, sensing : Joint, Sensing
    span : int
        Samples of the derivatives' kernel.
    """
    steps, inside = np.diff(record.time), np.diff(record.segment) == 0
    if inside.any() and np.ptp(steps[inside]) > 0.02 * float(np.median(steps[inside])):
        record = record.resampled()
    signals, dt = signals_of(record, joint, sensing), record.dt
    long = max(span, 2 * round(MEMORY_KERNEL / dt / 2) + 1)
    segments = tuple(s for s in record.segments() if s.stop - s.start > 2 * long)
    points: dict[str, FloatArray] = {}
    smooth: dict[str, FloatArray] = {}
    for source, chain in POSITION_CHAINS.items():
        if source not in signals:
            continue
        for order, name in enumerate(chain):
            points[name] = smooth[name] = _derivative(signals[source], segments, span * dt, dt, order)
            if order == 0:
                smooth[name] = _derivative(signals[source], segments, long * dt, dt, 0)
                points[name] = np.concatenate([signals[source][s] for s in segments] or [np.empty(0)])
    for name, values in (("temperature", signals.get("temperature")), ("time", record.time)):
        if values is not None:
            points[name] = smooth[name] = np.concatenate([values[s] for s in segments] or [np.empty(0)])
    grid = Grid(span * dt, dt, 1, 1, segments, 0, dict.fromkeys(POSITION_CHAINS, span * dt))
    starts = np.concatenate([[0], np.cumsum([s.stop - s.start for s in segments])]).astype(np.int64)
    block = _seconds(points["time"], starts)
    return WeakRecord(grid, {}, points, smooth, points["time"], block, starts)


def _derivative(values: FloatArray, segments: Sequence[slice], length: float, dt: float, order: int) -> FloatArray:
    """Derivative at every sample; the ends of a segment by the nearest full window."""
    weights = kernel(length, dt, order)
    half = len(weights) // 2
    parts = []
    for segment in segments:
        x = values[segment]
        inner = sliding_window_view(x, len(weights)) @ weights
        parts.append(inner[np.clip(np.arange(len(x)) - half, 0, len(inner) - 1)])
    return np.concatenate(parts or [np.empty(0)])


def _seconds(time: FloatArray, starts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Number of the second of each sample; segments share none."""
    out = np.zeros(len(time), dtype=np.int64)
    first = 0
    for a, b in zip(starts[:-1], starts[1:], strict=True):
        if b > a:
            out[a:b] = first + ((time[a:b] - time[a]) / BLOCK).astype(np.int64)
            first = int(out[b - 1]) + 1
    return out


@final
class _Pointwise:
    """Residuals of the balances at single instants, and what one unit of given parameters changes in them."""

    def __init__(self, model: JointModel, sensing: Sensing, wrt: Sequence[str] = ()) -> None:
        e = model.equations
        expressions = residual_expressions(model, sensing)
        self.balances = tuple(expressions)
        self.names = model.parameter_names
        self.wrt = tuple(wrt)
        columns = [self.names.index(n) for n in wrt]
        out: list[Any] = []
        for r in expressions.values():
            out += ca.vertsplit(ca.jacobian(r, e.parameters)[:, columns].T) if columns else [r]
        signals: Any = e.signals.vector()
        self._f = Vectorised(ca.Function("instants", [signals, e.memory, e.parameters], [ca.densify(ca.vertcat(*out))]))
        self._memory = Memory(model) if e.memory_terms else None
        self._states = int(e.memory.shape[0])

    def at(self, rows: WeakRecord, values: dict[str, float]) -> dict[str, FloatArray]:
        """Residual (n,), or columns (n, wrt), of every balance at the samples."""
        p = np.array([float(values[n]) for n in self.names])
        count = len(rows.time)
        matrix = np.zeros((len(Signals.names()), count))
        for i, name in enumerate(Signals.names()):
            if name in rows.points:
                matrix[i] = rows.points[name]
        memory = self._memory.along(rows, p) if self._memory is not None else np.zeros((self._states, count))
        full = self._f(count, matrix, memory, p)
        width = max(len(self.wrt), 1)
        return {b: full[i] if not self.wrt else full[i * width : (i + 1) * width].T for i, b in enumerate(self.balances)}


def highest_order(samples: Sequence[Samples], dt: float) -> float:
    """Order that is at half the sampling rate at the median speed."""
    speed = np.concatenate([s.weight for s in samples])
    moving = speed[speed > 0.05 * float(speed.max(initial=0.0))]
    return math.pi / (dt * float(np.median(moving))) if len(moving) else 0.0


@final
@dataclass(frozen=True)
class _Tracked:
    """A balance ready for the scan: samples of training and held-out records with the trend taken out."""

    balance: str
    train: Samples
    held: Samples | None
    span: int
    dt: float


def _tracked(
    solution: Solution, data: Dataset, train: Sequence[Record], held_out: Sequence[Record],
) -> tuple[list[_Tracked], dict[int, tuple[list[WeakRecord], list[WeakRecord]]]]:  # fmt: skip
    """Every balance at the span that leaves the least of it."""
    law = _Pointwise(solution.model, data.sensing)
    runs: dict[int, tuple[list[WeakRecord], list[WeakRecord]]] = {}
    best: dict[str, tuple[float, _Tracked]] = {}
    for span in SPANS:
        first = [at_every_sample(r, data.joint, data.sensing, span) for r in train]
        second = [at_every_sample(r, data.joint, data.sensing, span) for r in held_out]
        runs[span] = (first, second)
        residuals = [law.at(w, dict(solution.values)) for w in (*first, *second)]
        for balance in law.balances:
            made = _without_trend(balance, data, span, (first, second), [r[balance] for r in residuals])
            if made is None:
                continue
            size = float(np.sqrt(np.average(made.train.residual**2, weights=made.train.weight)))
            if balance not in best or size < best[balance][0]:
                best[balance] = (size, made)
    return [made for _, made in best.values()], runs


def _without_trend(
    balance: str, data: Dataset, span: int, runs: tuple[list[WeakRecord], list[WeakRecord]], residuals: Sequence[FloatArray],
) -> _Tracked | None:  # fmt: skip
    """Samples of a balance without what depends on velocity, acceleration and slowly on the position."""
    factor = _angle_factor(data.joint)
    count = len(runs[0])
    train = [i for i, w in enumerate(data.train) if balance not in w.masked and len(runs[0][i].time)]
    held = [i for i, w in enumerate(data.held_out) if balance not in w.masked and len(runs[1][i].time)]
    if not train:
        return None

    def joined(side: int, which: Sequence[int]) -> tuple[Samples, FloatArray, FloatArray]:
        chosen = [runs[side][i] for i in which]
        velocity = np.concatenate([w.points["motor_velocity"] for w in chosen])
        acceleration = np.concatenate([w.points["motor_acceleration"] for w in chosen])
        block, first = [], 0
        for w in chosen:
            block.append(w.block + first)
            first = int(block[-1].max()) + 1
        samples = Samples(
            factor * np.concatenate([w.points["motor_position"] for w in chosen]),
            np.concatenate([residuals[i + side * count] for i in which]), factor * np.abs(velocity), np.concatenate(block),
        )  # fmt: skip
        return samples, velocity, acceleration

    samples, velocity, acceleration = joined(0, train)
    if samples.stroke <= 0 or float(samples.weight.sum()) <= 0:
        return None
    knots, span_of = velocity_knots(velocity), (float(samples.angle.min()), float(samples.angle.max()))
    columns = trend(samples.angle, velocity, acceleration, knots, span_of)
    coefficients = detrended(columns, samples)
    left = clipped(replace(samples, residual=samples.residual - columns @ coefficients))
    beyond = None
    if held:
        unseen, velocity, acceleration = joined(1, held)
        columns = trend(unseen.angle, velocity, acceleration, knots, span_of)
        beyond = clipped(replace(unseen, residual=unseen.residual - columns @ coefficients))
    return _Tracked(balance, left, beyond, span, float(runs[0][train[0]].grid.dt))


def find_lines(solution: Solution, data: Dataset, train: Sequence[Record], held_out: Sequence[Record], most: int = 4) -> list[Line]:
    """Lines in the residual of every balance, confirmed on held-out records.

    Parameters
    ----------
    solution : Solution
        The fitted model.
    data : Dataset
        Prepared from these records.
    train, held_out : sequence of Record
    most : int
        Lines at most.

    Returns
    -------
    list of Line
        The most prominent first; a line that several balances show once.
    """
    if data.sensing.clamped_link:
        return []
    tracked, runs = _tracked(solution, data, train, held_out)
    named, turn = named_orders(data.joint), turns_per_unit(data.joint)
    seen: list[tuple[_Tracked, Peak]] = []
    for one in tracked:
        found = peaks(one.train, highest_order([one.train], one.dt), named, 2 * most, LOWEST_ORDER * turn)
        seen += [(one, p) for p in found if one.held is None or confirmed(p, one.held, len(found))]
    seen.sort(key=lambda x: -x[1].prominence)
    out: list[Line] = []
    for one, peak in seen:
        apart = 2 * math.pi / one.train.stroke
        if len(out) == most or any(abs(line.order - peak.order) < 2 * apart for line in out):
            continue
        near = min((h for h in named if peak.at(h)), key=lambda h: abs(h - peak.order), default=None)
        names = _names(peak, one, tracked, runs, solution, data) if near is not None else ()
        out.append(_line(peak, one, names, data.joint))
    return out


def _line(peak: Peak, one: _Tracked, names: tuple[str, ...], joint: Joint) -> Line:
    linear = joint.kind == "linear"
    band = NORMAL_95 * peak.amplitude_error
    return Line(
        peak.order, 2 * math.pi / one.train.stroke, peak.amplitude, one.balance, peak.prominence, names, _held_out_drop(peak, one.held),
        "metre" if linear else "motor turn", "N" if linear else "N.m", peak.error, max(peak.amplitude - band, 0.0), peak.amplitude + band,
    )  # fmt: skip


def _held_out_drop(peak: Peak, held: Samples | None) -> float:
    """Fall of the RMS on held-out samples by the line with its phase from training, in percent."""
    if held is None:
        return 0.0
    before = float(np.sum(held.weight * held.residual**2))
    after = float(np.sum(held.weight * (held.residual - peak.wave(held.angle)) ** 2))
    return 100 * (1 - math.sqrt(after / max(before, 1e-300)))


def line_labels(model: JointModel, sensing: Sensing) -> dict[str, str]:
    """Key and label of the effects that are lines and that these channels can show; a further one of its kind where there is one."""
    out = {}
    for effect in EFFECTS.values():
        missing = any(not model.has(n) for n in effect.needs)
        if not effect.periodic or missing or not observable(effect.acts_on[0], sensing):
            continue
        there = sum(t.effect.key == effect.key for t in model.terms)
        out[effect.key] = effect.key if there == 0 else f"{effect.key}#{1 + there}"
    return out


def _names(
    peak: Peak, one: _Tracked, tracked: Sequence[_Tracked], runs: dict[int, tuple[list[WeakRecord], list[WeakRecord]]],
    solution: Solution, data: Dataset,
) -> tuple[str, ...]:  # fmt: skip
    """Effects that put such a line into the balances that show it, and none into those that do not."""
    gains: dict[str, float] = {}
    for key, label in line_labels(solution.model, data.sensing).items():
        model = solution.model.add(label)
        term = next(t for t in model.terms if t.label == label)
        pairs = list(zip(term.names, term.effect.parameters, strict=True))
        amplitudes = [n for n, p in pairs if not p.is_shape]
        shape = next(n for n, p in pairs if p.is_shape)
        values = {p.name: p.start for p in model.parameters} | dict(solution.values)
        turn = turns_per_unit(data.joint)
        scale = 2 * math.pi / abs(data.joint.gear_ratio) if data.joint.kind == "linear" else 1.0
        values |= dict.fromkeys(amplitudes, 0.0) | {shape: peak.order * scale}
        law = _Pointwise(model, data.sensing, amplitudes)
        gains[key] = _gain(peak, tracked, runs, law, values, data) if turn or data.joint.orders else 0.0
    best = max(gains.values(), default=0.0)
    if best <= 0:
        return ()
    ordered = sorted((k for k in gains if gains[k] >= NAME_GAIN * best), key=lambda k: -gains[k])
    if not data.sensing.has_torque:
        # nothing tells the sides apart: what is declared as confused belongs to the set
        ordered += [c for k in tuple(ordered) for c in EFFECTS[k].confused_with if EFFECTS[c].periodic and c not in ordered]
    return tuple(ordered)


def _gain(
    peak: Peak, tracked: Sequence[_Tracked], runs: dict[int, tuple[list[WeakRecord], list[WeakRecord]]], law: _Pointwise,
    values: dict[str, float], data: Dataset,
) -> float:  # fmt: skip
    """Power of the line over the noise that one pair of amplitudes explains in all balances together."""
    rows: list[FloatArray] = []
    target: list[float] = []
    for one in tracked:
        which = [w for w, d in zip(runs[one.span][0], data.train, strict=True) if one.balance not in d.masked and len(w.time)]
        columns = np.concatenate([law.at(w, values)[one.balance] for w in which])
        measured = _amplitude(peak.order, one.train)
        noise = _noise(peak, one)
        modelled = [_amplitude(peak.order, replace(one.train, residual=-column)) for column in columns.T]
        rows += [np.array([m[part] for m in modelled]) / noise for part in (0, 1)]
        target += [measured[part] / noise for part in (0, 1)]
    a, y = np.array(rows), np.array(target)
    found = np.linalg.lstsq(a, y, rcond=None)[0]
    return float(y @ y - np.sum((y - a @ found) ** 2))


def _amplitude(order: float, samples: Samples) -> tuple[float, float]:
    return phase_fit(order, samples)


def _noise(peak: Peak, one: _Tracked) -> float:
    """Standard error of the sine or cosine of a line at that order in a balance."""
    stroke = one.train.stroke
    top = max(highest_order([one.train], one.dt), 1.2 * peak.order + 64 * math.pi / stroke)
    orders, power = spectrum(one.train, top)
    level = float(np.interp(peak.order, orders, background(orders, power, stroke, 4 * math.pi / stroke)))
    weight = float(one.train.weight.sum())
    # a line of amplitude A has the power (A weight / 2)^2; one of its two parts holds half the noise
    return math.sqrt(2 * max(level, 1e-300)) / weight
