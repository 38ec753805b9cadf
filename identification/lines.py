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
    refined,
    spectrum,
    trend,
    velocity_knots,
)
from identification.record import Record
from identification.sensing import Sensing, signals_of
from identification.weak import POSITION_CHAINS, Grid, WeakRecord, kernel

__all__ = ["Line", "find_lines", "highest_order", "named_orders", "orders_of"]

FloatArray = npt.NDArray[np.float64]

MOTOR_ORDERS: Final = (1.0, 2.0, 4.0)
"""Orders per motor turn that have a name: shaft, wave generator and its second harmonic (T. Tuttle, W. Seering 1996)."""
LOWEST_ORDER: Final = 0.25
"""Periods per motor turn (or pitch) from which on an order is looked for that nobody named: what is slower belongs to the link."""
SPANS: Final = ((7, 6), (7, 4), (11, 4), (15, 4), (31, 4))
"""Samples, and degree of the polynomial through them, from which velocity and acceleration are taken; the pair that leaves the least
of a balance is used: short ones keep the band, long ones the noise of a coarse encoder down (A. Savitzky, M. Golay 1964)."""
NAME_GAIN: Final = 0.85
"""Share of the best name's power that a name of the same set explains: one that loses more belongs to another side."""
NAME_SHARE: Final = 0.5
"""Share of the line's power over all balances that a name explains: with less, most of the line has another cause."""
AROUND: Final = tuple(np.linspace(-0.4, 0.4, 5))
"""Orders about a peak, in units of 2 pi / stroke, at which the law of an effect is tried."""
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


def orders_of(lines: Sequence[Line], joint: Joint) -> dict[str, tuple[float, ...]]:
    """By effect, the orders of the lines that carry its name, as the shape of its law counts them (periods per radian of the motor)."""
    turn = _angle_factor(joint) / abs(joint.gear_ratio)
    keys = dict.fromkeys(k for line in lines for k in line.effects)
    return {k: tuple(line.order * turn for line in lines if k in line.effects) for k in keys}


Span = tuple[int, int]


def at_every_sample(record: Record, joint: Joint, sensing: Sensing, span: Span) -> WeakRecord:
    """Signals of a record at every sample: torque, drive and positions as recorded, derivatives from polynomials.

    Parameters
    ----------
    record : Record
    joint, sensing : Joint, Sensing
    span : (samples, degree)
        Of the polynomials.
    """
    steps, inside = np.diff(record.time), np.diff(record.segment) == 0
    if inside.any() and np.ptp(steps[inside]) > 0.02 * float(np.median(steps[inside])):
        record = record.resampled()
    signals, dt = signals_of(record, joint, sensing), record.dt
    long = max(span[0], 2 * round(MEMORY_KERNEL / dt / 2) + 1)
    segments = tuple(s for s in record.segments() if s.stop - s.start > 2 * long)
    points: dict[str, FloatArray] = {}
    smooth: dict[str, FloatArray] = {}
    for source, chain in POSITION_CHAINS.items():
        if source not in signals:
            continue
        for order, name in enumerate(chain):
            if order == 0:
                smooth[name] = _filtered(signals[source], segments, kernel(long * dt, dt))
                points[name] = np.concatenate([signals[source][s] for s in segments] or [np.empty(0)])
            else:
                points[name] = smooth[name] = _filtered(signals[source], segments, _polynomial(span, order) / dt**order)
    for name, values in (("temperature", signals.get("temperature")), ("time", record.time)):
        if values is not None:
            points[name] = smooth[name] = np.concatenate([values[s] for s in segments] or [np.empty(0)])
    grid = Grid(span[0] * dt, dt, 1, 1, segments, 0, dict.fromkeys(POSITION_CHAINS, span[0] * dt))
    starts = np.concatenate([[0], np.cumsum([s.stop - s.start for s in segments])]).astype(np.int64)
    block = _seconds(points["time"], starts)
    return WeakRecord(grid, {}, points, smooth, points["time"], block, starts)


def _polynomial(span: Span, order: int) -> FloatArray:
    """Weights of the samples for a derivative per sample, from the polynomial of least squares."""
    half = span[0] // 2
    basis = np.vander(np.arange(-half, half + 1), span[1] + 1, increasing=True).astype(np.float64)
    return np.asarray(np.linalg.pinv(basis)[order] * math.factorial(order), dtype=np.float64)


def _filtered(values: FloatArray, segments: Sequence[slice], weights: FloatArray) -> FloatArray:
    """Correlation with weights at every sample; the ends of a segment by the nearest full window."""
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
    span: Span
    dt: float


def _tracked(
    solution: Solution, data: Dataset, train: Sequence[Record], held_out: Sequence[Record],
) -> tuple[list[_Tracked], dict[Span, tuple[list[WeakRecord], list[WeakRecord]]]]:  # fmt: skip
    """Every balance at the span that leaves the least of it."""
    law = _Pointwise(solution.model, data.sensing)
    runs: dict[Span, tuple[list[WeakRecord], list[WeakRecord]]] = {}
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
    balance: str, data: Dataset, span: Span, runs: tuple[list[WeakRecord], list[WeakRecord]], residuals: Sequence[FloatArray],
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
    named = named_orders(data.joint)
    seen: list[tuple[_Tracked, Peak]] = []
    for one in tracked:
        found = peaks(one.train, highest_order([one.train], one.dt), named, 2 * most, LOWEST_ORDER * turns_per_unit(data.joint))
        seen += [(one, p) for p in found if one.held is None or confirmed(p, one.held, len(found))]
    seen.sort(key=lambda x: -x[1].prominence)
    out: list[Line] = []
    for one, peak in seen:
        apart = 2 * math.pi / one.train.stroke
        if len(out) == most or any(abs(line.order - peak.order) < 2 * apart for line in out):
            continue
        near = min(named, key=lambda h: abs(h - peak.order), default=math.inf)
        names, order = _names(peak, near, _Scan(solution, data, tracked, runs)) if abs(near - peak.order) <= apart / 2 else ((), peak.order)
        out.append(_line(peak, order, one, names, data.joint))
    return out


def _line(peak: Peak, order: float, one: _Tracked, names: tuple[str, ...], joint: Joint) -> Line:
    linear = joint.kind == "linear"
    band = NORMAL_95 * peak.amplitude_error
    return Line(
        order, 2 * math.pi / one.train.stroke, peak.amplitude, one.balance, peak.prominence, names, _held_out_drop(peak, one.held),
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


@final
@dataclass(frozen=True)
class _Scan:
    """What the naming of a line needs."""

    solution: Solution
    data: Dataset
    tracked: Sequence[_Tracked]
    runs: dict[Span, tuple[list[WeakRecord], list[WeakRecord]]]


def _names(peak: Peak, near: float, scan: _Scan) -> tuple[tuple[str, ...], float]:
    """Effects that put such a line into the balances that show it, and none into those that do not; the order of the first one.

    Each effect is fitted with its own law, at orders about the peak: the virtual work of a kinematic error under gravity shifts
    the peak of a plain sine by more than noise. Its own order has to lie at the named one.
    """
    noise = [_noise(peak, one) for one in scan.tracked]
    tried: dict[str, tuple[float, float]] = {}
    for key, label in line_labels(scan.solution.model, scan.data.sensing).items():
        orders = np.array([peak.order + peak.apart * x for x in AROUND])
        gains = _gains(label, orders, noise, scan)
        k = int(np.argmax(gains))
        tried[key] = (float(gains[k]), refined(orders, gains, k))
    best = max((g for g, _ in tried.values()), default=0.0)
    if best < NAME_SHARE * _shown(peak, noise, scan):
        return (), peak.order
    # without a torque sensor an acceleration that is too smooth looks like a torque of the motor: the order tells, the balances do not
    least = NAME_GAIN * best if scan.data.sensing.has_torque else 0.0
    kept = [k for k, (g, h) in tried.items() if g >= least and replace(peak, order=h).at(near)]
    kept.sort(key=lambda k: -tried[k][0])
    if not kept:
        return (), peak.order
    if not scan.data.sensing.has_torque:
        # nothing tells the sides apart: what is declared as confused belongs to the set
        kept += [c for k in tuple(kept) for c in EFFECTS[k].confused_with if EFFECTS[c].periodic and c not in kept]
    return tuple(kept), tried[kept[0]][1]


def _shown(peak: Peak, noise: Sequence[float], scan: _Scan) -> float:
    """Squared standard deviations of the line over all balances, each with a phase of its own."""
    sizes = [math.hypot(*phase_fit(peak.order, one.train)) / level for one, level in zip(scan.tracked, noise, strict=True)]
    return sum(size**2 for size in sizes)


def _gains(label: str, orders: FloatArray, noise: Sequence[float], scan: _Scan) -> FloatArray:
    """Squared standard deviations that an effect explains in all balances together, at several orders."""
    model, data = scan.solution.model.add(label), scan.data
    term = next(t for t in model.terms if t.label == label)
    pairs = list(zip(term.names, term.effect.parameters, strict=True))
    amplitudes = [n for n, p in pairs if not p.is_shape]
    shape = next(n for n, p in pairs if p.is_shape)
    values = {p.name: p.start for p in model.parameters} | dict(scan.solution.values) | dict.fromkeys(amplitudes, 0.0)
    law = _Pointwise(model, data.sensing, amplitudes)
    turn = _angle_factor(data.joint) / abs(data.joint.gear_ratio)
    out = []
    for order in orders:
        normal, right = np.zeros((len(amplitudes), len(amplitudes))), np.zeros(len(amplitudes))
        at = {s: [law.at(w, {**values, shape: float(order) * turn}) for w in scan.runs[s][0]] for s in {one.span for one in scan.tracked}}
        for one, level in zip(scan.tracked, noise, strict=True):
            columns = np.concatenate([c[one.balance] for c, d in zip(at[one.span], data.train, strict=True) if one.balance not in d.masked])
            # a sine of amplitude A takes A^2 / 2 of the weight off the squares
            scale = 2 / (float(one.train.weight.sum()) * level**2)
            weighted = columns * (scale * one.train.weight)[:, None]
            normal += weighted.T @ columns
            right += weighted.T @ one.train.residual
        out.append(float(right @ np.linalg.lstsq(normal, right, rcond=None)[0]))
    return np.array(out)


def _noise(peak: Peak, one: _Tracked) -> float:
    """Standard error of the sine or cosine of a line at that order in a balance."""
    stroke = one.train.stroke
    top = max(highest_order([one.train], one.dt), 1.2 * peak.order + 64 * math.pi / stroke)
    orders, power = spectrum(one.train, top)
    level = float(np.interp(peak.order, orders, background(orders, power, stroke, 4 * math.pi / stroke)))
    # a line of amplitude A has the power (A weight / 2)^2; one of its two parts holds half the noise
    return math.sqrt(2 * max(level, 1e-300)) / float(one.train.weight.sum())
