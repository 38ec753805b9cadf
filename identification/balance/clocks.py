"""Channels that are late against the motor encoder: the lateness is taken off the readings before
the balances are made, what is left of it is fitted with the model.

A skew of a sample is no small number: its Taylor series in the model would change the inertias, and
the second order of an acceleration or a torque, which no derivative shows, the skew itself.
Readings are interpolated: their noise changes above a quarter of the sampling rate, which no kernel
passes.
Where a torque is late through a low-pass, as the current of most drives is, its rate in the model
makes it good, and no shift.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from casadi_models.hold import CLOCKS
from identification.balance.beside import (
    DEVIATION,
    any_curve,
    bounded,
    motion_of,
    rest_beside,
    scaled,
)
from identification.balance.colour import LEVEL_ERROR
from identification.balance.memory import MOST, NUMBERS, cache_of
from identification.balance.weak import Filter, WeakRecord

FloatArray = npt.NDArray[np.float64]

SIGNAL: Final[Mapping[str, str]] = {
    "drive": "drive",
    "torque_sensor": "torque",
    "link_position_sensor": "link_position",
}
"""Signal of a sensor's place, by the names of :class:`casadi_models.Signals`."""
MOST_SKEW: Final = 3.5
"""Largest skew between the clocks of one logger [samples]: a reading waits for the sensor's cycle,
for that of the bus and for the logger's, one sample each, and a held value counts from its middle.
What is later is no clock but a delay, to be named.
"""
USUAL_SKEW: Final = 1.0
"""Standard deviation of a skew before the records are asked [samples]: sources are read once in a
cycle. It decides only what the records do not tell.
"""
SHIFTS: Final = 4
"""Rounds in which shifts are looked for: one channel's comes out wrong while another is late."""
NEAR: Final = 0.1
"""Lateness that is left to the model [samples]: half its square, which the series of a torque and
that of an acceleration in the model lack, is under a hundredth.
"""
ENCODERS: Final = frozenset({"link_position_sensor"})
"""Places whose readings are positions."""
TELLING: Final = 0.2
"""Share of the rows that are asked whether a reading waits or is filtered, those in which the two
differ most: calm rows tell nothing, and are so many that what is not known of their noise decides.
"""
HALF_A_CYCLE: Final = 0.5
"""Half the cycle of a drive's filter [samples]: it is read by a logger that is no faster."""
USUAL_HALF: Final = 0.1
"""Half the cycle that drives usually have [samples], the deviation of what is expected before the
rows are asked: from .025 for a logger of 100 Hz to .25 for one of 1 kHz beside a filter at 2 kHz.
"""
PRICE: Final = 2.5
"""Squares, in units of the variance, that rows must lose for each that independent ones would: they
are four to a kernel length, and 0.4 of them count.
"""
HALF_WAY: Final = 0.625
"""Part of a minimum's depth that half the way to it must have: a parabola has three quarters, a
straight slope half."""
SHARE_ERROR: Final = 0.01
"""Error of a share of a lateness [samples]: a hundredth of a usual lateness squared, which is what
second order is then off by, is what :data:`NEAR` leaves.
"""
LOW_PASSED: Final = frozenset({"drive"})
"""Places whose readings may come through a low-pass and not late: drives filter their current."""
BEGUN: Final = (-3.0, -1.0, 1.0, 3.0)
"""Shifts of a torque from which its lateness is looked for beside the motor alone [samples]: none
of up to :data:`MOST_SKEW` is farther than a sample from one of them or from zero."""
SERIES: Final = 0.05
"""Share of the kernel up to which a torque that is late beside the motor alone is left to the fit:
its series is off by 4 % of what that changes at the edge of the kernel. A law that is missing
looks like a lateness of some milliseconds to rows without it."""
BEGINS: Final = 3.5
"""Standard errors by which what is left must fall there: of eight stretches as rare as one in a
hundred. Only where the search begins hangs on it."""
LEAST_SPREAD: Final = 1e-9
"""Of the logarithm of a fall: rounding."""
LEAST_SQUARE: Final = 1e-30
"""Of a record without noise [(N.m)^2]: what rounding leaves of torques of 1 N.m."""
SURE: Final = 4.53
"""Standard errors by which a channel must be late: of an error from eight stretches (Student's t,
seven degrees of freedom) as rare as three of a known one."""
UNLIKE: Final = 2.0
"""Standard errors from which a lateness read through the motor is certainly another: 5 %."""
ONE_WAY: Final = 1e-3
"""Share of a row's kernel in which the joint may move the other way."""
CREEP: Final = 0.05
"""Share of a record's speed below which friction is turning, whatever its law: a Stribeck velocity
and the width of a smooth turn are hundredths of the speed of a useful record.
"""
FAST: Final = 0.99
"""Quantile of the speeds that is the speed of a record."""
FEW: Final = 0.1
"""Share of such rows below which a motion turns all the time: then its turns tell the clocks."""
ANSWERS: Final = 0.5
"""Share of a shift by which the lateness must be less after it. Where less is, more than half of
what the rate of a reading moves is its noise, and what was read is none of a clock.
"""
STRETCHES: Final = 8
"""Stretches of a record whose slopes are compared."""


def carrier(model: JointModel, place: str) -> str | None:
    """Parameter that says how late the channel of a place is; None where the model has none."""
    skews = (n for n in model.calibration if n in CLOCKS and CLOCKS[n].place == place)
    return next(iter((*skews, *model.named("delay", place))), None)


def places_of(model: JointModel) -> tuple[str, ...]:
    """Places whose channels may be shifted: those of which the model says how late they are beyond
    the hold of a command.
    """
    calibrated = any(n in CLOCKS for n in model.calibration)
    return tuple(p for p in SIGNAL if calibrated and carrier(model, p) is not None)


def at_stamps(
    model: JointModel, record: WeakRecord, values: Mapping[str, float]
) -> Mapping[str, float]:
    """Values with the skews as they are left in the rows of a record that was shifted already."""
    left = {}
    for place, shift in record.shifts.items():
        name = carrier(model, place)
        if name is not None:
            left[name] = values[name] - shift
    return {**values, **left} if left else values


def shifted(
    signals: Mapping[str, FloatArray], segments: tuple[slice, ...], late: Mapping[str, float]
) -> tuple[dict[str, FloatArray], tuple[slice, ...]]:
    """Signals of late sensors at their true time, and the stretches in which all are there.

    Parameters
    ----------
    signals : mapping of str to (n,) array
    segments : tuple of slice
    late : mapping of str to float
        Samples by which the sensor of a place is late; a part of a sample by the cubic through four
        readings.

    Notes
    -----
    The stretches are those of the largest skew whatever the shifts are: rows stay where they are
    while shifts are looked for, and what no shift changes is not made again.
    """
    if not late:
        return dict(signals), segments
    out = {**signals, **{SIGNAL[p]: _moved(signals[SIGNAL[p]], k) for p, k in late.items()}}
    most = max(MOST_SKEW, *(abs(k) for k in late.values()))
    first, last = math.ceil(1 + most), math.ceil(2 + most)
    return out, tuple(slice(s.start + first, max(s.stop - last, s.start + first)) for s in segments)


def _moved(x: FloatArray, late: float) -> FloatArray:
    whole = math.floor(late)
    f = late - whole
    if f == 0:
        return np.roll(x, -whole)
    parts = (w * np.roll(x, 1 - whole - i) for i, w in enumerate(cubic(f)))
    return np.asarray(sum(parts), dtype=np.float64)


def cubic(f: float) -> tuple[float, float, float, float]:
    """Weights of four readings, of a point `f` of a sample behind the second one."""
    return (
        -f * (f - 1) * (f - 2) / 6,
        (f + 1) * (f - 1) * (f - 2) / 2,
        -(f + 1) * f * (f - 2) / 2,
        (f + 1) * f * (f - 1) / 6,
    )


def in_time(
    make: Callable[[Mapping[str, float]], WeakRecord],
    places: Iterable[str],
    noise: Callable[[WeakRecord, float, str, float], float],
    *,
    torque: bool,
    motor_alone: bool = False,
    both_encoders: bool = False,
) -> WeakRecord:
    """A record whose late channels are shifted.

    Parameters
    ----------
    make : callable
        Makes the rows with the channels of some places shifted by so many samples.
    places : iterable of str
        Whose channels may be shifted.
    noise : callable
        Variance that the noise of a place's channel, as a record tells it, gives the rows of a
        kernel of some length [s], its rate times a lateness [s] added.
    torque : bool
        Whether the torque of the link is measured.
    motor_alone : bool
        Whether the torque is measured beside the motor, and the link is not.
    both_encoders : bool
        Whether motor and link have an encoder each.
    """
    filters: dict[str, Filter] = {}
    made, wanted = make({}), tuple(places)
    by_motor = "torque_sensor" in wanted and (motor_alone or (both_encoders and link_hidden(made)))
    shifts = _begun(make, made, noise) if by_motor else {}
    begun = bool(shifts)
    made = make(shifts) if begun else made
    # a drive that is filtered and not late would take the torque along: its rate says more of it
    first = tuple(p for p in wanted if by_motor and p == "torque_sensor")
    for together in (first, tuple(p for p in wanted if p not in first)):
        for _ in range(SHIFTS if together else 0):
            moved = dict(shifts)
            for place in together:
                late = _late(made, place, torque=torque, by_motor=by_motor) / made.grid.dt
                step = late if abs(late) > NEAR else 0.0
                moved[place] = moved.get(place, 0.0) + step
            if moved == shifts:
                break
            shifts = {p: k for p, k in moved.items() if k}
            made = make(shifts)
    for place in sorted(shifts):
        # a shift of zero keeps the rows: what is compared are the same instants
        unshifted = {**shifts, place: 0.0}
        other, late = make(unshifted), shifts[place] * made.grid.dt
        found = [lateness(x, place, torque=torque, by_motor=by_motor)[0] for x in (other, made)]
        taken = (found[0] - found[1]) / late > ANSWERS
        if by_motor and place == "torque_sensor":
            # from where the search did not begin the rows answer to nothing
            in_reach = SERIES * made.grid.length / made.grid.dt < abs(shifts[place]) <= MOST_SKEW
            taken = (taken or begun) and in_reach
        # what is later than that is no filter of a drive
        if taken and place in LOW_PASSED and abs(shifts[place]) <= MOST_SKEW:
            # noise is one whatever the kernel
            louder = partial(noise, make(shifts))
            filters[place] = told = _filter(make, shifts, place, louder, torque=torque)
            shifts = {**shifts, place: as_told([told], told) / made.grid.dt}
            made = make(shifts)
        elif not taken:
            shifts, made = unshifted, other
    return replace(made, filters=filters) if filters else made


def as_told(filters: Sequence[Filter], of: Filter) -> float:
    """Shift of a reading [s] by what several records say: its filter is that of the drive, and the
    records that tell more decide for those that tell less.
    """
    if sum(f.better for f in filters) < 0.0:
        return of.late
    return float(max(filters, key=lambda f: f.gain).behind)


def _filter(
    make: Callable[[Mapping[str, float]], WeakRecord],
    shifts: Mapping[str, float],
    place: str,
    noise: Callable[[float, str, float], float],
    *,
    torque: bool,
) -> Filter:
    """What rows say of a late reading, by how well they are met with all of its lateness shifted,
    with its rate in the place of that, or with a part shifted the other way and its rate.

    All are late by the same time in first order. A reading that waits is the true value of
    an earlier instant: all of it is to be shifted. One through a low-pass is made good by its rate,
    and nothing is left of higher order. A low-pass of a computer weighs its last reading and the
    one before: its rate is that of half its cycle ago, and so much is to be shifted the other way.
    No filter makes a reading early, as a command is that is held for a sample: that is a shift.

    Rows in which the first two hardly differ say nothing, nor do those that neither meets, as those
    of slow motion whose friction is not the law's: the sum of squares that is compared is Tukey's,
    bounded. So those in which the joint creeps may stay: what changes fast there tells best. Of the
    first two neither is the rule: the likelier is
    taken. Of the third the rows say as much as the squares that it takes off, whether the noise
    that a rate makes louder is taken off too, which is not known so well, or not; what drives
    usually have says the rest. The squares fall along a parabola: where rows fall in and out of
    what is bounded there are other minima.
    """
    from scipy.optimize import minimize_scalar

    whole, alone, waiting = shifts[place], make({**shifts, place: 0.0}), make(shifts)
    dt, kept = alone.grid.dt, one_way(alone)
    if whole < 0:
        return Filter(whole * dt, -1.0)
    friction = any_curve(alone, "motor_velocity", kept)

    def rest(made: WeakRecord, *, without_far: bool = False) -> FloatArray:
        values, others, column = _parts(made, place, kept, torque=torque)
        return rest_beside(values, [*others, friction, column], without_far=without_far)

    left = [rest(waiting), rest(alone)]
    scale = min(DEVIATION * float(np.median(np.abs(x))) for x in left)
    if not scale:
        return Filter(whole * dt, -1.0)

    (shifted, _, _), (read, _, column) = (
        _parts(made, place, kept, torque=torque) for made in (waiting, alone)
    )
    apart = np.abs(shifted - read + whole * dt * column)
    telling = apart >= np.quantile(apart, 1 - TELLING)

    def louder(shift: float) -> float:
        """Squares of the telling rows, in units of the variance, by which noise is louder."""
        of_a_row = noise(waiting.grid.length, place, (whole - shift) * dt) / scale**2
        return int(telling.sum()) * of_a_row

    @cache
    def unmet(shift: float) -> float:
        """Their squares where a part is shifted; candidates are near one another here, and rows
        that none of them meets would hide what is between them."""
        made = make({**shifts, place: shift}) if shift else alone
        return float(np.sum(bounded(rest(made, without_far=True)[telling] / scale)))

    met = [float(np.sum(bounded(x[telling] / scale))) for x in left]
    better = met[0] - louder(whole) - met[1] + louder(0.0)
    if whole > NEAR:
        found = minimize_scalar(
            unmet,
            bounds=(-HALF_A_CYCLE, 0.0),
            method="bounded",
            options={"xatol": SHARE_ERROR},
        )
        at, gain = float(found.x), unmet(0.0) - float(found.fun)
        told = min(gain, gain + louder(at) - louder(0.0))
        if told > 0 and unmet(0.0) - unmet(at / 2) > HALF_WAY * gain:
            # a parabola that falls by `told` has an error of at * sqrt(PRICE / told)
            at *= told / (told + PRICE * (at / USUAL_HALF) ** 2)
            return Filter(whole * dt, better, at * dt, told)
    return Filter(whole * dt, better)


def link_hidden(made: WeakRecord) -> bool:
    """Whether noise of the link's encoder leaves open how late the torque is by more than is left
    to the model, and the motor's rows tell it better; of a record with an encoder on either side.
    """
    if not {"drive", "torque"} <= set(made.averaged):
        return False
    _, error, _ = lateness(made, "torque_sensor", torque=True)
    if error < NEAR * made.grid.dt:
        return False
    _, other, _ = lateness(made, "torque_sensor", torque=True, by_motor=True)
    return other < error


def _begun(
    make: Callable[[Mapping[str, float]], WeakRecord],
    alone: WeakRecord,
    noise: Callable[[WeakRecord, float, str, float], float],
) -> dict[str, float]:
    """Where the search for the lateness of a torque begins beside the motor alone: its rate is that
    of the drive but for an inertia, and a straight line reaches no farther than a sample.

    Where less is taken of the two rates their noise is less, too: what is sure of that is no reason
    to begin there.
    """

    def asked(made: WeakRecord) -> tuple[FloatArray, float]:
        squares, lateness = _unexplained(made)
        return squares, sum(noise(made, made.grid.length, p, x) for p, x in lateness.items())

    before, loud = asked(alone)
    left = {}
    for shift in BEGUN:
        squares, own = asked(make({"torque_sensor": shift}))
        fall = np.log(before / (squares + (1 - LEVEL_ERROR) * max(loud - own, 0.0)))
        spread = max(float(fall.std(ddof=1)), LEAST_SPREAD)
        if math.sqrt(STRETCHES) * float(fall.mean()) / spread > BEGINS:
            left[shift] = float(squares.mean())
    return {"torque_sensor": min(left, key=lambda k: left[k])} if left else {}


def _unexplained(made: WeakRecord) -> tuple[FloatArray, dict[str, float]]:
    """Mean square of what the drive leaves beside the motion, the torque and their rates, in each
    of a few stretches; and the lateness that each rate is taken for [s].
    """
    kept = steady(made)
    values, others, column = _parts(made, "torque_sensor", kept, torque=True, by_motor=True)
    curve = any_curve(made, "motor_velocity", kept)
    matrix = np.column_stack([*others, column, curve])
    size = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    solution, *_ = np.linalg.lstsq(matrix / size, values, rcond=None)
    rest = values - matrix @ (solution / size)
    squares = [float(np.mean(x**2)) for x in np.array_split(rest, STRETCHES)]
    drive, torque = (solution / size)[len(others) - 1 : len(others) + 1]
    rates = {"drive": float(drive), "torque_sensor": float(torque)}
    return np.maximum(squares, LEAST_SQUARE), rates


def _parts(
    made: WeakRecord,
    place: str,
    kept: npt.NDArray[np.bool_],
    *,
    torque: bool,
    through_motor: bool = False,
    by_motor: bool = False,
) -> tuple[FloatArray, list[FloatArray], FloatArray]:
    """Reading of a torque, what it follows from, and the column of its lateness, in the rows
    `kept`; `through_motor`: as far as the motion of the motor tells that of the link;
    `by_motor`: the torque is read beside what drives the motor, and not against the link.
    """
    a = {n: x[kept] for n, x in made.averaged.items()}
    if place == "torque_sensor":
        if by_motor:
            # a soft joint's torque is no law of the motor's motion: it is part of what drives it
            drives = [*motion_of(a, "motor"), a["torque"], -a["drive_rate"]]
            return a["drive"], drives, a["torque_rate"]
        motion, column = motion_of(a, "link"), -a["torque_rate"]
        if through_motor:
            through = scaled(np.column_stack([*motion_of(a, "motor"), column]))
            motion = [through @ np.linalg.lstsq(through, x, rcond=None)[0] for x in motion]
        return a["torque"], motion, column
    # unlike the motor's by the wind-up of the transmission, whose rates look like a lateness
    load = [a["torque"]] if torque else [x for n, x in a.items() if n == "link_acceleration"]
    return a["drive"], [*motion_of(a, "motor"), *load], -a["drive_rate"]


def one_way(record: WeakRecord) -> npt.NDArray[np.bool_]:
    """Rows within which the joint does not turn, shape (rows,): where dry friction turns it has a
    rate that no lateness explains. All rows where hardly any is such a row.
    """
    return _within(record, np.sign(record.points["motor_velocity"]))


def steady(record: WeakRecord) -> npt.NDArray[np.bool_]:
    """Rows within which the joint neither turns nor creeps, shape (rows,): what is no law of the
    model yet has its rates in a Stribeck curve, too. All rows where hardly any is such a row.
    """

    def make() -> tuple[npt.NDArray[np.bool_], int]:
        v = record.points["motor_velocity"]
        creeps = np.abs(v) < CREEP * np.quantile(np.abs(v), FAST)
        found = _within(record, np.where(creeps, 0.0, np.sign(v)))
        found.flags.writeable = False
        return found, record.rows

    found: npt.NDArray[np.bool_] = cache_of("steady").get(record, None, make, MOST)
    return found


def _within(record: WeakRecord, way: FloatArray) -> npt.NDArray[np.bool_]:
    same = np.abs(record.average(way)) > 1 - ONE_WAY
    return np.asarray(same if np.mean(same) > FEW else np.ones(record.rows, dtype=np.bool_))


def _late(made: WeakRecord, place: str, *, torque: bool, by_motor: bool) -> float:
    """Time by which a channel is certainly late [s]."""
    late, error, _ = lateness(made, place, torque=torque, by_motor=by_motor)
    return late if abs(late) > SURE * error else 0.0


def lateness(
    made: WeakRecord, place: str, *, torque: bool, by_motor: bool = False
) -> tuple[float, float, float]:
    """Time by which a channel is late, its standard error, and the part of it that viscous friction
    may be [s]: reading = what it follows from, less the time times its rate.

    The rate of a torque explains some of the noise of the link's acceleration, and is found too
    large for it. Read through the motion of the motor (two-stage least squares) it is not, but
    known less well; so that is taken where the two are certainly unlike (Hausman 1978).
    """

    def make() -> tuple[tuple[float, float, float], int]:
        return _lateness(made, place, torque=torque, by_motor=by_motor), 1

    law = (place, torque, by_motor)
    found: tuple[float, float, float] = cache_of("lateness").get(made, law, make, NUMBERS)
    return found


def _lateness(
    made: WeakRecord, place: str, *, torque: bool, by_motor: bool
) -> tuple[float, float, float]:
    kept = steady(made)
    a = {n: x[kept] for n, x in made.averaged.items()}
    if place not in ENCODERS:
        late, error = _slope(*_parts(made, place, kept, torque=torque, by_motor=by_motor))
        if place == "torque_sensor" and not by_motor:
            sure = _slope(*_parts(made, place, kept, torque=torque, through_motor=True))
            if abs(late - sure[0]) > UNLIKE * sure[1]:
                late, error = sure
            # read against the link's encoder, which may itself be late by less than it is shifted
            own, own_error, _ = lateness(made, "link_position_sensor", torque=torque)
            late, error = late + own, math.hypot(error, own_error)
        return late, error, 0.0
    effort, twist = a.get("torque" if torque else "drive"), a["motor_position"] - a["link_position"]
    if effort is None:  # nothing tells friction of the link from lateness
        return 0.0, math.inf, 0.0
    one, v, _, bend, *_ = motion_of(a, "link")
    if torque:
        # a damped transmission gives way late, too
        return *_slope(twist, [one, effort, a["torque_rate"], np.sign(v)], v), 0.0
    late, error = _slope(twist, [one, effort, a["drive_rate"], bend, np.sign(v)], v)
    # the twist under viscous friction is such a lateness too
    friction, _ = _slope(effort, [one, np.sign(v), bend], v)
    soft, _ = _slope(twist, [one, v, bend], effort)
    apart = min(abs(friction * soft), abs(late))
    return math.copysign(abs(late) - apart, late), error, apart


def _slope(values: FloatArray, others: list[FloatArray], column: FloatArray) -> tuple[float, float]:
    """Slope over a column beside others, with its standard error: rows depend on each other, so it
    is that of leaving one of a few stretches out.
    """
    basis, _ = np.linalg.qr(scaled(np.column_stack(others)))
    own = column - basis @ (basis.T @ column)
    rest = values - basis @ (basis.T @ values)
    powers = np.array([float(x @ x) for x in np.array_split(own, STRETCHES)])
    products = np.array(
        [
            float(x @ y)
            for x, y in zip(
                np.array_split(own, STRETCHES), np.array_split(rest, STRETCHES), strict=True
            )
        ]
    )
    power = float(powers.sum())
    if power - powers.max() <= 1e-18 * float(column @ column):
        return 0.0, math.inf
    slope = float(products.sum()) / power
    without = (products.sum() - products) / (power - powers)
    error = math.sqrt((STRETCHES - 1) / STRETCHES * float(np.sum((without - without.mean()) ** 2)))
    return slope, error


__all__ = [
    "MOST_SKEW",
    "SIGNAL",
    "USUAL_SKEW",
    "at_stamps",
    "carrier",
    "cubic",
    "in_time",
    "lateness",
    "link_hidden",
    "one_way",
    "places_of",
    "shifted",
    "steady",
]
