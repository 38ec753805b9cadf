"""Lines: residual that repeats with the motor angle or with the position, at an order nobody has to
name beforehand.

A stage of its own beside the fit: the residual of the fitted model is taken at every sample, torque
and drive as they were recorded, and tracked along the angle
(:mod:`identification.diagnosis.order_tracking`). The kernel of the balances, which would hide lines
above 15 Hz, has no part in it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS, JointModel, Signals
from casadi_models.vectorised import Vectorised
from identification.balance.balances import Memory, residual_expressions
from identification.balance.calibration import settled, values_on
from identification.balance.clocks import shifted
from identification.balance.dataset import Dataset, run_name
from identification.balance.kinematic import residual_unit
from identification.balance.noise import EVEN
from identification.balance.sensing import Sensing, signals_of
from identification.balance.weak import POSITION_CHAINS, Grid, WeakRecord, kernel, whole
from identification.data.check.quanta import quantum
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.diagnosis.candidates import observable
from identification.diagnosis.order_tracking import (
    ALPHA,
    BLOCK,
    Peak,
    Samples,
    apart_from_slow,
    background,
    beside,
    clipped,
    confirmed,
    everywhere,
    peaks,
    phase_fit,
    refined,
    spectrum,
    trend,
    velocity_knots,
)
from identification.fitting.engine import Solution

__all__ = [
    "Line",
    "find_lines",
    "held_out_drop",
    "highest_order",
    "named_orders",
    "orders_of",
    "other_orders",
    "without_turn",
]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MOTOR_ORDERS: Final = (1.0, 2.0, 4.0)
"""Orders per motor turn that have a name: shaft, wave generator and its second harmonic (T.
Tuttle, W. Seering 1996).
"""
LOWEST_ORDER: Final = 0.25
"""Periods per motor turn (or pitch) from which on an order is looked for that nobody named:
what is slower belongs to the link.
"""
SMOOTHED: Final = (1, 9, 15, 31)
"""Samples over which the residual is smoothed, one after the other: what hangs on an acceleration
is noise above a frequency that the encoder sets, and samples whose line lies above it only disturb.
Smoothing the whole residual keeps its terms in balance; smoothing the acceleration alone would
leave a line that is none."""
DERIVATIVE: Final = {1: (7, 4), 2: (7, 6), 3: (7, 6)}
"""Samples and degree of the polynomial from which a derivative is taken (A.

Savitzky, M. Golay 1964): flat to half of the band.
"""
NAME_GAIN: Final = 0.85
"""Share of the best name's power that a name of the same set explains: one that loses more
belongs to another side.
"""
NAME_SHARE: Final = 0.5
"""Share of the line's power over all balances that a name explains: with less, most of the line
has another cause.
"""
AROUND: Final = tuple(np.linspace(-0.4, 0.4, 5))
"""Orders about a peak, in units of 2 pi / stroke, at which the law of an effect is tried."""
SLOW_KERNEL: Final = 0.03
"""Kernel of the positions that drive internal states, and of the velocity over which the trend
is drawn [s]: quantisation wipes out both.
"""
NORMAL_95: Final = 1.96
PIECES: Final = 4
"""Parts of a block of which each has a speed: of a quarter of a second."""
SAME_SPEED: Final = 0.1
"""Change of the speed, as a share, from which on a hum of 10 Hz is out of step with the angle after
a second.
"""
MOVING: Final = 0.05
"""Weight, as a share of the largest, above which a sample belongs to the motion."""


STEP_ORDERS: Final = (1, 2, 3)
"""Multiples of its steps at which an encoder is heard: those of a saw tooth fall with the
multiple."""
WINDING_PARTS: Final = 100
"""Parts of a record, and of its stroke, over which the winding of the transmission is told."""


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
        Names where the balances and the order tell; empty for a function of the position that the
        library has no name for.
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
            "order": self.order,
            "per": self.per,
            "tolerance": self.tolerance,
            "amplitude": self.amplitude,
            "unit": self.unit,
            "effects": list(self.effects),
            "balance": self.balance,
            "order_error": self.order_error,
            "amplitude_low": self.amplitude_low,
            "amplitude_high": self.amplitude_high,
            "prominence": self.prominence,
            "held_out_drop_percent": self.held_out_drop_percent,
        }


def named_orders(joint: Joint) -> tuple[float, ...]:
    """Orders that have a name: of the motor turn, of the pitch of a linear axis, and those the
    joint file gives.
    """
    turn = joint.turns_per_unit
    return (*(h * turn for h in MOTOR_ORDERS if turn), *joint.orders)


def without_turn(lines: Sequence[Line], joint: Joint) -> tuple[str, ...]:
    """What would name the lines of a linear axis of whose motor nobody knows the turn."""
    if joint.turns_per_unit or all(line.effects for line in lines):
        return ()
    nameless = [line for line in lines if not line.effects]
    periods = " and ".join(f"{1e3 / line.order:.3g} mm" for line in nameless)
    return (
        f"something repeats every {periods}, and nothing says how far the axis moves per turn of "
        "its motor: with [known] pitch (the lead of a screw) in the joint file it gets a name "
        "where the two agree",
    )


def _angle_factor(joint: Joint) -> float:
    """Link-referred position to the angle of the orders."""
    return 2 * math.pi if joint.kind == "linear" else abs(joint.gear_ratio)


def _per_motor_angle(joint: Joint) -> float:
    """Order of a line to the order of a law: periods per radian of the motor."""
    return _angle_factor(joint) / abs(joint.gear_ratio)


def orders_of(lines: Sequence[Line], joint: Joint) -> dict[str, tuple[float, ...]]:
    """By effect, the orders of the lines that carry its name, as the shape of its law counts
    them (periods per radian of the motor).
    """
    turn = _per_motor_angle(joint)
    keys = dict.fromkeys(k for line in lines for k in line.effects)
    return {k: tuple(line.order * turn for line in lines if k in line.effects) for k in keys}


def other_orders(lines: Sequence[Line], joint: Joint) -> tuple[float, ...]:
    """The orders of the lines that carry no name, counted in the same way.

    A periodic effect that is tried at the named orders alone takes a part of such a line with it
    and ends in the valley next to one of them.
    """
    return tuple(line.order * _per_motor_angle(joint) for line in lines if not line.effects)


def at_every_sample(
    record: Record, joint: Joint, sensing: Sensing, like: WeakRecord | None = None
) -> WeakRecord:
    """Signals of a record at every sample: torque, drive and positions as recorded, derivatives
    over seven samples; late channels shifted as in the rows `like`.
    """
    steps, inside = np.diff(record.time), np.diff(record.segment) == 0
    if inside.any() and np.ptp(steps[inside]) > EVEN * float(np.median(steps[inside])):
        record = record.resampled()
    signals, dt = signals_of(record, joint, sensing), record.dt
    long = max(7, 2 * whole(SLOW_KERNEL / dt / 2) + 1)
    late = {} if like is None else {p: x / dt for p, x in like.shifts.items()}
    signals, parts = shifted(signals, tuple(record.segments()), late)
    segments = tuple(s for s in parts if s.stop - s.start > 2 * max(long, SMOOTHED[-1]))
    starts = np.concatenate([[0], np.cumsum([s.stop - s.start for s in segments])]).astype(np.int64)
    points: dict[str, FloatArray] = {}
    smooth: dict[str, FloatArray] = {}
    for source, chain in POSITION_CHAINS.items():
        if source not in signals:
            continue
        raw = np.concatenate([signals[source][s] for s in segments] or [np.empty(0)])
        for order, name in enumerate(chain):
            smooth[name] = _filtered(raw, starts, kernel(long * dt, dt, order))
            points[name] = _filtered(raw, starts, _polynomial(order) / dt**order) if order else raw
    for name, values in (("temperature", signals.get("temperature")), ("time", record.time)):
        if values is not None:
            points[name] = smooth[name] = np.concatenate(
                [values[s] for s in segments] or [np.empty(0)]
            )
    grid = Grid(
        7 * dt,
        dt,
        stride=1,
        step=1,
        segments=segments,
        half=0,
        pointwise=dict.fromkeys(POSITION_CHAINS, 7 * dt),
    )
    return WeakRecord(
        grid,
        {},
        points=points,
        smooth=smooth,
        time=points["time"],
        block=_in_step(points["time"], points["motor_position"], starts),
        starts=starts,
        name="" if like is None else like.name,
        shifts={p: k * dt for p, k in late.items()},
    )


def _polynomial(order: int) -> FloatArray:
    """Weights of the samples for a derivative per sample, from the polynomial of least squares."""
    count, degree = DERIVATIVE[order]
    basis = np.vander(np.arange(count) - count // 2, degree + 1, increasing=True).astype(np.float64)
    return np.asarray(np.linalg.pinv(basis)[order] * math.factorial(order), dtype=np.float64)


def _filtered(values: FloatArray, starts: IntArray, weights: FloatArray) -> FloatArray:
    """Correlation with weights at every sample; the ends of a segment by the nearest full
    window.
    """
    if len(weights) == 1:
        return np.asarray(values * weights[0], dtype=np.float64)
    half = len(weights) // 2
    out = np.empty(len(values))
    for first, last in itertools.pairwise(starts.tolist()):
        inner = np.correlate(values[first:last], weights, "valid")
        out[first:last] = np.pad(inner, half, "edge")
    return out


def _in_step(time: FloatArray, position: FloatArray, starts: IntArray) -> IntArray:
    """Number of the block of each sample: a second, or as long as the joint runs at one speed in
    one direction; segments share none.

    At one speed a hum keeps its phase to the angle from one end to the other: such a stretch tells
    once, and not once a second, whether what is left follows the angle.
    """
    out = np.zeros(len(time), dtype=np.int64)
    number = -1
    for a, b in itertools.pairwise(starts.tolist()):
        piece = ((time[a:b] - time[a : a + 1]) * (PIECES / BLOCK)).astype(np.int64)
        edges = [a, *(a + 1 + np.flatnonzero(np.diff(piece))).tolist(), b]
        speeds: list[float] = []
        for first, last in itertools.pairwise(edges):
            apart = time[last - 1] - time[first]
            speed = float(position[last - 1] - position[first]) / apart if apart > 0 else 0.0
            if not speeds or (len(speeds) >= PIECES and not _one_speed([*speeds, speed])):
                number, speeds = number + 1, []
            speeds.append(speed)
            out[first:last] = number
    return out


def _one_speed(speeds: Sequence[float]) -> bool:
    """True where no speed is more than a part :data:`SAME_SPEED` under the highest, all in one
    direction.
    """
    low, high = sorted((min(speeds), max(speeds)), key=abs)
    return low * high > 0 and low / high > 1 - SAME_SPEED


@final
class _Pointwise:
    """Residuals of the balances at single instants, and what one unit of given parameters
    changes in them.
    """

    def __init__(self, model: JointModel, sensing: Sensing, wrt: Sequence[str] = ()) -> None:
        e = model.equations
        expressions = residual_expressions(model, sensing)
        self.balances = tuple(expressions)
        moved = ca.vertcat(e.signals.motor_acceleration, e.signals.link_acceleration)
        self.names = model.parameter_names
        # a clock brings an acceleration into every balance, but no more of it than it is late
        clocks: Any = ca.vertcat(
            *(e.parameters[i] for i, n in enumerate(self.names) if n in model.calibration)
        )
        self.at_rest_too = frozenset(
            b
            for b, r in expressions.items()
            if not ca.depends_on(ca.substitute(r, clocks, ca.DM.zeros(clocks.shape)), moved)
        )
        self.wrt = tuple(wrt)
        columns = [self.names.index(n) for n in wrt]
        out: list[Any] = []
        for r in expressions.values():
            out += ca.vertsplit(ca.jacobian(r, e.parameters)[:, columns].T) if columns else [r]
        signals: Any = e.signals.vector()
        self._f = Vectorised(
            ca.Function(
                "instants", [signals, e.memory, e.parameters], [ca.densify(ca.vertcat(*out))]
            )
        )
        self._memory = Memory(model) if e.memory_terms else None
        self._states = int(e.memory.shape[0])

    def at(self, rows: WeakRecord, values: Mapping[str, float]) -> dict[str, FloatArray]:
        """Residual (n,), or columns (n, wrt), of every balance at the samples."""
        p = np.array([float(values[n]) for n in self.names])
        count = len(rows.time)
        memory = (
            self._memory.along(rows, p)
            if self._memory is not None
            else np.zeros((self._states, count))
        )
        full = self._f(count, rows.table(Signals.names()), memory, p)
        width = max(len(self.wrt), 1)
        return {
            b: full[i] if not self.wrt else full[i * width : (i + 1) * width].T
            for i, b in enumerate(self.balances)
        }


def highest_order(samples: Samples, dt: float) -> float:
    """Order that is at half the sampling rate at the median speed."""
    moving = samples.weight[samples.weight > MOVING * float(samples.weight.max(initial=0.0))]
    return math.pi / (dt * float(np.median(moving))) if len(moving) else 0.0


@final
@dataclass(frozen=True)
class _Tracked:
    """A balance at one smoothing, ready for the scan: samples of training records with the trend
    taken out, and what makes those of the held-out ones, where there are any.

    `direct` where no acceleration enters.
    """

    balance: str
    smoothed: int
    train: Samples
    unseen: Callable[[], Samples | None]
    dt: float
    direct: bool

    @cached_property
    def held(self) -> Samples | None:
        """Samples of the held-out records: only a peak asks for them, and they may be many."""
        return self.unseen()


@final
@dataclass(frozen=True)
class _Joined:
    """Runs one after the other, with the residual of every balance."""

    runs: tuple[WeakRecord, ...]
    residual: FloatArray
    factor: float

    @property
    def weight(self) -> FloatArray:
        """Angle that each sample covers, per second."""
        return self.factor * np.abs(self.signal("motor_velocity", smooth=True))

    @property
    def starts(self) -> IntArray:
        """First sample of each stretch."""
        parts, first = [np.zeros(1, dtype=np.int64)], 0
        for w in self.runs:
            parts.append(w.starts[1:] + first)
            first += int(w.starts[-1])
        return np.concatenate(parts)

    def signal(self, name: str, *, smooth: bool = False) -> FloatArray:
        """A signal over all runs."""
        return np.concatenate([(w.smooth if smooth else w.points)[name] for w in self.runs])

    def samples(self, smoothed: int) -> Samples:
        """Samples with the residual smoothed."""
        block, first = [], 0
        for w in self.runs:
            block.append(w.block + first)
            first = int(block[-1].max(initial=first)) + 1
        starts = self.starts
        weights = (
            kernel(smoothed * self.runs[0].grid.dt, self.runs[0].grid.dt)
            if smoothed > 1
            else np.ones(1)
        )

        def seen(values: FloatArray) -> FloatArray:
            return _filtered(values, starts, weights)

        return Samples(
            self.factor * self.signal("motor_position"),
            seen(self.residual),
            self.weight,
            np.concatenate(block),
            seen,
        )


def _tracked(
    solution: Solution, data: Dataset, train: Sequence[Record], held_out: Sequence[Record]
) -> tuple[list[_Tracked], tuple[WeakRecord, ...]]:
    """Every balance at every smoothing; the training runs."""
    law = _Pointwise(solution.model, data.sensing)
    known = {w.name: w for w in (*data.train, *data.held_out)}
    found = settled(solution.model, data.sensing, list(known.values()), solution.values)

    def part(
        records: Sequence[Record], prepared: Sequence[WeakRecord]
    ) -> tuple[tuple[WeakRecord, ...], dict[str, _Joined]]:
        """Runs, and those of them that take part in each balance."""
        runs = tuple(
            at_every_sample(r, data.joint, data.sensing, known.get(run_name(r))) for r in records
        )
        residuals = [law.at(w, values_on(solution.model, w, found)) for w in runs]
        joined = {}
        for b in law.balances:
            kept = _taking(b, runs, prepared)
            if any(kept):
                each = [r[b] for r in itertools.compress(residuals, kept)]
                joined[b] = _Joined(
                    tuple(itertools.compress(runs, kept)),
                    np.concatenate(each),
                    _angle_factor(data.joint),
                )
        return runs, joined

    runs, joined = part(train, data.train)

    @cache
    def apart() -> dict[str, _Joined]:
        return part(held_out, data.held_out)[1]

    def unseen(balance: str) -> _Joined | None:
        return apart().get(balance)

    out: list[_Tracked] = []
    for b in joined:
        direct = b in law.at_rest_too
        out += _without_trend(b, joined[b], partial(unseen, b), direct=direct)
    return out, runs


def _taking(balance: str, runs: Sequence[WeakRecord], prepared: Sequence[WeakRecord]) -> list[bool]:
    """Which runs take part in a balance."""
    return [
        balance not in w.masked and len(r.time) > 0 for r, w in zip(runs, prepared, strict=True)
    ]


def _without_trend(
    balance: str, train: _Joined, unseen: Callable[[], _Joined | None], *, direct: bool
) -> list[_Tracked]:
    """Samples of a balance without what depends on velocity, acceleration and slowly on the
    position.
    """
    angle, velocity = (
        train.factor * train.signal("motor_position"),
        train.signal("motor_velocity", smooth=True),
    )
    if not float(np.ptp(angle)) or not np.any(velocity):
        return []
    knots, ends = velocity_knots(velocity), (float(angle.min()), float(angle.max()))

    def without(of: _Joined) -> Callable[[FloatArray], FloatArray]:
        slow = [of.signal(n, smooth=True) for n in ("motor_velocity", "motor_acceleration")]
        place = of.factor * of.signal("motor_position")
        return beside(trend(place, slow[0], slow[1], knots, ends), of.weight)

    taken = without(train)

    @cache
    def held() -> tuple[_Joined, Callable[[FloatArray], FloatArray]] | None:
        of = unseen()
        return None if of is None else (of, without(of))

    def apart(smoothed: int) -> Samples | None:
        of = held()
        return None if of is None else _beside(of[0].samples(smoothed), of[1])

    return [
        _Tracked(
            balance,
            n,
            _beside(train.samples(n), taken),
            partial(apart, n),
            dt=train.runs[0].grid.dt,
            direct=direct,
        )
        for n in SMOOTHED
    ]


def _beside(samples: Samples, taken: Callable[[FloatArray], FloatArray]) -> Samples:
    """The samples without a trend, their outliers cut."""

    def seen(values: FloatArray) -> FloatArray:
        return taken(samples.seen(values))

    return clipped(replace(samples, residual=taken(samples.residual), seen=seen))


def find_lines(
    solution: Solution,
    data: Dataset,
    train: Sequence[Record],
    held_out: Sequence[Record],
    most: int = 4,
) -> list[Line]:
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
    of_steps = [
        band for r, w in zip(train, runs, strict=True) for band in _encoder_orders(r, w, data)
    ]
    seen: list[tuple[_Tracked, Peak]] = []
    for one in tracked:
        lowest = LOWEST_ORDER * data.joint.turns_per_unit
        found = peaks(
            one.train,
            highest_order(one.train, one.dt),
            named,
            2 * most,
            lowest,
            ALPHA / len(SMOOTHED),
        )
        seen += [
            (one, p)
            for p in found
            if not _within(p.order, math.pi / one.train.stroke, of_steps)
            and (one.held is None or confirmed(p, one.held, len(found)))
            and everywhere(p, [x for x in found if x is not p], one.train, named)
            and apart_from_slow(p, one.train, one.dt, named=any(p.at(h) for h in named))
        ]
    # what a position reads wrong stands in every balance of its acceleration, larger: where a
    # balance without shows it, it is there
    seen.sort(key=lambda x: (not x[0].direct, -x[1].prominence))
    out: list[Line] = []
    for one, peak in seen:
        apart = 2 * math.pi / one.train.stroke
        if any(abs(line.order - peak.order) < 2 * apart for line in out):
            continue
        near = min(named, key=lambda h: abs(h - peak.order), default=math.inf)
        names, order = (
            _names(peak, near, _Scan(solution, data, tracked, runs))
            if abs(near - peak.order) <= apart / 2
            else ((), peak.order)
        )
        out.append(_line(peak, order, one, names, data.joint))
    return sorted(out, key=lambda line: -line.prominence)[:most]


def _encoder_orders(record: Record, run: WeakRecord, data: Dataset) -> list[tuple[float, float]]:
    """Orders at which the steps of an encoder stand in every balance of its position, lowest and
    highest: they are those of its own angle, which is not the motor's where the transmission winds
    up with the position, as under gravity.
    """
    ratio, factor = abs(data.joint.gear_ratio), _angle_factor(data.joint)
    out = []
    for channel, per_link in (("link_position", 1.0), ("motor_position", ratio)):
        if not record.has(channel):
            continue
        step = record.quanta.get(channel) or quantum(np.asarray(record[channel]))
        if step is None:
            continue
        order = 2 * math.pi * per_link / (step * factor)
        winding = _winding(run) if channel == "link_position" else 0.0
        out += [(k * order * (1 - winding), k * order * (1 + winding)) for k in STEP_ORDERS]
    return out


def _winding(run: WeakRecord) -> float:
    """Largest share of a motion of the motor that winds the transmission up."""
    if not {"motor_position", "link_position"} <= set(run.points):
        return 0.0
    motor, link = (run.smooth[f"{side}_position"] for side in ("motor", "link"))
    part = max(1, len(motor) // WINDING_PARTS)
    moved = motor[part:] - motor[:-part]
    far = np.abs(moved) > np.ptp(motor) / WINDING_PARTS
    twisted = moved - (link[part:] - link[:-part])
    return float(np.quantile(np.abs(twisted[far] / moved[far]), 0.95)) if far.any() else 0.0


def _within(order: float, near: float, bands: Sequence[tuple[float, float]]) -> bool:
    return any(low - near <= order <= high + near for low, high in bands)


def _line(peak: Peak, order: float, one: _Tracked, names: tuple[str, ...], joint: Joint) -> Line:
    linear = joint.kind == "linear"
    band = NORMAL_95 * peak.amplitude_error
    return Line(
        order,
        2 * math.pi / one.train.stroke,
        amplitude=peak.amplitude,
        balance=one.balance,
        prominence=peak.prominence,
        effects=names,
        held_out_drop_percent=held_out_drop(peak, one.held),
        per="metre" if linear else "motor turn",
        unit=residual_unit(one.balance, "linear" if linear else "rotary"),
        order_error=peak.error,
        amplitude_low=max(peak.amplitude - band, 0.0),
        amplitude_high=peak.amplitude + band,
    )


def held_out_drop(peak: Peak, held: Samples | None) -> float:
    """Fall of the RMS on held-out samples by the line with its phase from training, in percent."""
    if held is None:
        return 0.0
    before = float(np.sum(held.weight * held.residual**2))
    after = float(np.sum(held.weight * (held.residual - peak.wave(held)) ** 2))
    return 100 * (1 - math.sqrt(after / max(before, 1e-300)))


def line_models(model: JointModel, sensing: Sensing) -> list[tuple[str, str, JointModel]]:
    """Key, label and model of every effect that is a line and that these channels can show; a
    further one of its kind where there is one.

    The first kinematic error of a model comes with and without its virtual work, which not every
    joint shows.
    """
    out = []
    for effect in EFFECTS.values():
        missing = any(not model.has(n) for n in effect.needs)
        if not effect.periodic or missing or not observable(effect.acts_on[0], sensing):
            continue
        there = sum(t.effect.key == effect.key for t in model.terms)
        label = effect.key if there == 0 else f"{effect.key}#{1 + there}"
        first = effect.acts_on[0] == "torsion" and not any(
            t.place == "torsion" for t in model.terms
        )
        out += [
            (effect.key, label, replace(model, virtual_work=w).add(label))
            for w in ((True, False) if first else (model.virtual_work,))
        ]
    return out


@final
@dataclass(frozen=True)
class _Scan:
    """What the naming of a line needs."""

    solution: Solution
    data: Dataset
    tracked: Sequence[_Tracked]
    runs: Sequence[WeakRecord]

    def clearest(self, peak: Peak) -> list[tuple[_Tracked, float]]:
        """Every balance at the smoothing that tells most at an order, with the standard error
        of a sine there.
        """
        out: dict[str, tuple[_Tracked, float]] = {}
        for one in self.tracked:
            noise = _noise(peak, one)
            if one.balance not in out or noise < out[one.balance][1]:
                out[one.balance] = one, noise
        return list(out.values())


def _names(peak: Peak, near: float, scan: _Scan) -> tuple[tuple[str, ...], float]:
    """Effects that put such a line into the balances that show it, and none into those that do not;
    the order of the first one.

    Each effect is fitted with its own law, at orders about the peak: the virtual work of a
    kinematic error under gravity shifts the peak of a plain sine by more than noise. Its own order
    has to lie at the named one.
    """
    chosen = scan.clearest(peak)
    tried: list[tuple[str, float, float]] = []
    orders = np.array([peak.order + peak.apart * x for x in AROUND])
    for key, label, model in line_models(scan.solution.model, scan.data.sensing):
        gains = _gains(label, model, orders, chosen, scan)
        k = int(np.argmax(gains))
        tried.append((key, float(gains[k]), refined(orders, gains, k)))
    best = max((gain for _, gain, _ in tried), default=0.0)
    if best < NAME_SHARE * _shown(peak, chosen):
        return (), peak.order
    # without a torque sensor an acceleration that is too smooth looks like a torque of the motor:
    # the order tells, the balances do not
    least = NAME_GAIN * best if scan.data.sensing.has_torque else 0.0
    held = sorted(
        (-gain, key, order)
        for key, gain, order in tried
        if gain >= least and replace(peak, order=order).at(near)
    )
    if not held:
        return (), peak.order
    kept = list(dict.fromkeys(key for _, key, _ in held))
    if not scan.data.sensing.has_torque:
        # nothing tells the sides apart: what is declared as confused belongs to the set
        kept += [
            c
            for k in tuple(kept)
            for c in EFFECTS[k].confused_with
            if EFFECTS[c].periodic and c not in kept
        ]
    return tuple(kept), held[0][2]


def _shown(peak: Peak, chosen: Sequence[tuple[_Tracked, float]]) -> float:
    """Squared standard deviations of the line over all balances, each with a phase of its own."""
    return sum(
        (math.hypot(*phase_fit(peak.order, one.train)) / noise) ** 2 for one, noise in chosen
    )


def _gains(
    label: str,
    model: JointModel,
    orders: FloatArray,
    chosen: Sequence[tuple[_Tracked, float]],
    scan: _Scan,
) -> FloatArray:
    """Squared standard deviations that an effect explains in all balances together, at several
    orders.
    """
    data = scan.data
    term = next(t for t in model.terms if t.label == label)
    pairs = list(zip(term.names, term.effect.parameters, strict=True))
    amplitudes = [n for n, p in pairs if not p.is_shape]
    shape = next(n for n, p in pairs if p.is_shape)
    values = (
        {p.name: p.start for p in model.parameters}
        | dict(scan.solution.values)
        | dict.fromkeys(amplitudes, 0.0)
    )
    law = _Pointwise(model, data.sensing, amplitudes)
    turn = _per_motor_angle(data.joint)
    out = []
    for order in orders:
        normal, right = np.zeros((len(amplitudes), len(amplitudes))), np.zeros(len(amplitudes))
        at = [
            law.at(w, values_on(model, w, {**values, shape: float(order) * turn}))
            for w in scan.runs
        ]
        for one, noise in chosen:
            raw = np.concatenate(
                [
                    c[one.balance]
                    for c in itertools.compress(at, _taking(one.balance, scan.runs, data.train))
                ]
            )
            columns = np.column_stack([one.train.seen(c) for c in raw.T])
            # a part of unit size takes its information off the squares, and stands 1/noise
            # deviations over nothing
            weighted = (
                columns * (one.train.weight / (_information(float(order), one) * noise**2))[:, None]
            )
            normal += weighted.T @ columns
            right += weighted.T @ one.train.residual
        out.append(float(right @ np.linalg.lstsq(normal, right, rcond=None)[0]))
    return np.array(out)


def _information(order: float, one: _Tracked) -> float:
    """Weighted squares of a sine of unit amplitude as the smoothing leaves it."""
    return float(np.sum(one.train.weight * one.train.seen(np.sin(order * one.train.angle)) ** 2))


def _noise(peak: Peak, one: _Tracked) -> float:
    """Standard error of the sine or cosine of a line at that order in a balance."""
    stroke = one.train.stroke
    top = max(highest_order(one.train, one.dt), 1.2 * peak.order + 64 * math.pi / stroke)
    orders, power = spectrum(one.train, top)
    level = float(
        np.interp(peak.order, orders, background(orders, power, stroke, 4 * math.pi / stroke))
    )
    # the power is that of the sum of weight times residual times exp: one of its two parts holds
    # half the noise
    return math.sqrt(max(level, 1e-300) / 2) / max(_information(peak.order, one), 1e-300)
