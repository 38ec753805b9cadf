"""Sensor faults on the sensors that there are: a bank of filters, each without one of them.

All filters have the joint's parameters fixed and a torque that the model lacks in each balance. One
reads everything; the others leave out one sensor each. Where the first one's statistics leave what
healthy records showed, the filter whose statistics stay tells the sensor
(:mod:`identification.faults.bank_statistics`, :mod:`identification.faults.bank_levels`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.errors import InputError
from identification.faults.bank_clocks import aligned, inside
from identification.faults.bank_levels import SETTLE, Piece, first_levels, likeliest
from identification.faults.bank_spring import OPENED, STIFFNESS, SpringFilters, opened
from identification.faults.bank_statistics import WINDOWS, by_reading, limits, statistics
from identification.faults.core import (
    ABSURD,
    CURRENT,
    LINK_POSITION,
    MOTOR_POSITION,
    SENSORS,
    TORQUE,
)
from identification.faults.types import FaultEvent, Verdict
from identification.online.filter import Doubts, FilterState, JointFilter, Levels
from identification.online.filter_step import BALANCES
from identification.online.pulse import Pulse

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

BEFORE: Final = 0.1
"""A filter that is innocent stays under its limits from this long before the alarm [s]."""
WAITS: Final = (1.0, 2.0, 4.0)
"""Until these times after the alarm [s]; later ones where the earlier leave several sensors."""
NEXT: Final = (0.5, 0.6)
"""Or it stays under this share of the next one's largest value, that being over the second."""
RECOVER: Final = 1.1
"""A failed sensor must agree with the others for this long to be read again [s]."""
PLANT_REST: Final = 5.0
"""A joint that changed stays changed: it is told again where the readings agreed with the model for
this long in between [s]."""
HEAD: Final = 1.0
"""Seconds at the beginning in which every reading is believed."""
FIRST: Final = 0.5
"""Seconds after which velocities are known and the calibration is found anew."""
CHUNK: Final = 60.0
"""Stretches in which a record is worked on, so that hours of it need no more memory [s]."""
GAP: Final = 0.05
"""A gap between stamps beyond this starts the filters anew [s]."""
LOST: Final = 0.03
"""A reading that is missing for longer fails, one that is missing for a shorter time is bridged
[s]."""
BISECTIONS: Final = 8
"""Halvings of the logarithm of a size: to a few percent."""
ANNOUNCED: Final = 1.5
"""Offsets that are announced over those that a record shows to be just seen: other places of the
motion need more."""
NAMED_AT: Final = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Multiples of the offset that is seen at which it is tried whether it is named."""
AT_THE_SPRING: Final = (SENSORS[MOTOR_POSITION], SENSORS[LINK_POSITION], SENSORS[TORQUE])
"""Sensors that a change of the stiffness may be taken for: what its law is about."""
ONE: Final = (Verdict.SENSOR, Verdict.CURRENT_OR_FRICTION)
"""Verdicts that name one sensor."""
CALIBRATION: Final = ("link_encoder_zero",)
"""What is off anew in each record: the filters find it on their way."""


@final
@dataclass(frozen=True)
class Tuning:
    """What healthy records gave: levels of noise, and limits (filters, statistics)."""

    levels: Levels
    limits: FloatArray


@final
@dataclass(frozen=True)
class BankTrack:
    """What a bank said about a record.

    Attributes
    ----------
    events : tuple of FaultEvent
        ``residuals`` names the statistics' filters that were over their limits.
    failed : (n, 6) bool array
        Where a sensor counts as failed.
    readings : (n, 6) array
        Readings with failed ones replaced by what the others say.
    scores : (n, filters) array
        Largest statistic of each filter over its limit; the first one reads all sensors.
    residuals : (n, 6) array
        Largest statistic of each reading over its limit (see
        :func:`identification.faults.bank_statistics.by_reading`) in that first filter; while a
        sensor counts as failed, in the one without it. 0 where no filter ran.
    """

    events: tuple[FaultEvent, ...]
    failed: BoolArray
    readings: FloatArray
    scores: FloatArray
    residuals: FloatArray


@final
class FaultBank:
    """Filters of an elastic joint for the sensors that it has.

    Parameters
    ----------
    model : JointModel
        The identified joint, elastic.
    dt : float
        Usual sample time [s].
    measured : sequence of 6 bools
        Which of :data:`identification.faults.core.SENSORS` there are; a velocity that is derived
        from its position is none.
    tuning : Tuning, optional
        From another bank of this joint; :meth:`calibrate` makes it.
    doubts : Doubts, optional
        Errors of the model's parameters, as its fit states them.
    late : sequence of 6 floats, optional
        Time by which each reading is late against the motor position [s].

    Attributes
    ----------
    sensors : tuple of int
        Numbers of the sensors there are; filter k + 1 leaves out the k-th.
    """

    def __init__(
        self,
        model: JointModel,
        dt: float,
        measured: Sequence[bool],
        tuning: Tuning | None = None,
        *,
        doubts: Doubts = Doubts(),  # noqa: B008 - frozen
        late: Sequence[float] = (0.0,) * len(SENSORS),
    ) -> None:
        if not model.is_elastic:
            raise InputError(
                "fault bank: the model is rigid; it needs motor and link apart "
                "(transmission_compliance)"
            )
        values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
        stiffness = model.stiffness_name
        if stiffness is not None and not values[stiffness] > 0.0:
            raise InputError(
                f"fault bank: {stiffness} is {values[stiffness]:g} in the joint file, so that "
                "nothing ties motor and link; fit it to records that show it, or use a rigid model "
                "(hd1, hd2)"
            )
        if not measured[CURRENT] or not (measured[1] and measured[3]):
            raise InputError(
                "fault bank: it needs the drive and the positions of motor and link; "
                f"there are {', '.join(n for n, m in zip(SENSORS, measured, strict=True) if m)}"
            )
        self.measured = tuple(bool(m) for m in measured)
        self.sensors = tuple(i for i in range(len(SENSORS)) if self.measured[i])
        self.dt = dt
        free = replace(model, calibration=CALIBRATION)
        self.joint = JointFilter(free, dt, CALIBRATION, doubts=doubts)
        self.known = JointFilter(free, dt, CALIBRATION)
        self.springs = SpringFilters(free, dt, CALIBRATION, doubts)
        self.late = tuple(float(x) for x in late)
        self.tuning = tuning

    # --- before the run ---------------------------------------------------------------------------

    def calibrate(self, healthy: Sequence[Piece]) -> Tuning:
        """Levels and limits from records of the healthy joint, some motions that the work has.

        Raises
        ------
        InputError
            The records are too short.
        """
        size = max(round(CHUNK / self.dt), 1)
        cut = [
            Piece(p.time[k : k + size], p.rows[k : k + size])
            for p in map(self.in_time, self.usable(healthy))
            for k in range(0, len(p.time), size)
        ]
        long = [p for p in cut if p.time[-1] - p.time[0] > 2 * SETTLE]
        if not long:
            raise InputError(f"fault bank: give healthy records longer than {2 * SETTLE:g} s")
        first = first_levels(long, self.dt, self.measured)
        levels = likeliest(self.known, long, self.measured, first)
        flags = self.flags(1)[:, 0]
        found = []
        for k in range(len(flags)):
            parts = []
            for piece in long:
                table = np.broadcast_to(flags[k], (1, len(piece.time), 6))
                states, at = self.begun(piece.time, piece.rows, levels)
                course = self.joint.run(
                    states[k : k + 1],
                    piece.time[at:],
                    piece.rows[at:],
                    table[:, at:],
                    levels=levels,
                )
                late = piece.time[at:] - piece.time[0] > SETTLE
                parts.append(statistics(course, 0, self.joint, levels)[late])
            motor, *others = levels.disturbance
            motor = motor if flags[k, CURRENT] else levels.unknown_drive
            found.append(limits(parts, self.dt, (motor, *others)))
        self.tuning = Tuning(levels, np.array(found))
        return self.tuning

    # --- the run ----------------------------------------------------------------------------------

    def run(self, time: FloatArray, rows: FloatArray) -> BankTrack:
        """A record with readings that may be faulty; only its first seconds must be sane.

        Parameters
        ----------
        time : (n,) array
            Stamps [s].
        rows : (n, 6) array
            In the order of :data:`identification.faults.core.SENSORS`; NaN is a missing reading.
        """
        tuning = self.tuned
        clean = np.where(np.abs(rows) < ABSURD, rows, np.nan)
        dead = self.dead(time, np.nan_to_num(clean))
        given = np.where(dead[:, None], np.nan, clean)
        work = _Work(self, tuning, time, given, dead)
        work.go()
        return BankTrack(
            tuple(sorted(work.events, key=lambda e: e.sample)),
            work.failed,
            np.where(work.failed, work.readings, given),
            work.scores,
            work.residuals,
        )

    def usable(self, pieces: Sequence[Piece]) -> list[Piece]:
        """Healthy stretches between the gaps, which start the filters anew. A sample of which a
        reading is missing or absurd counts as lost: limits are of whole samples.
        """
        own, out = list(self.sensors), []
        for p in pieces:
            whole = (np.abs(np.nan_to_num(p.rows[:, own], nan=np.inf)) < ABSURD).all(axis=1)
            time, rows = p.time[whole], p.rows[whole]
            edges = [0, *(np.flatnonzero(np.diff(time) > GAP) + 1).tolist(), len(time)]
            out += [Piece(time[a:b], rows[a:b]) for a, b in pairwise(edges) if b > a]
        return out

    def in_time(self, piece: Piece) -> Piece:
        """A stretch without gaps, its late readings at their own time."""
        rows, part = aligned(piece.time, piece.rows, self.late), inside(piece.time, self.late)
        return Piece(piece.time[part], rows[part])

    def smallest(self, healthy: Piece) -> dict[str, tuple[float, float]]:
        """The smallest offset of each sensor that is seen, and the smallest that is named, in the
        unit of the reading; infinite where none is.

        Bisected on a healthy record, at some times of its motion, and times :data:`ANNOUNCED`.
        """
        piece = self.in_time(max(self.usable([healthy]), key=lambda p: len(p.time)))
        time, rows = piece.time, piece.rows
        places = [
            int(np.searchsorted(time, time[0] + share * (time[-1] - time[0])))
            for share in (0.35, 0.65, 0.9)
        ]
        probes = [_Probe(self, time, rows, place) for place in places]
        spread = np.nanstd(rows, axis=0)
        out = {}
        for k, sensor in enumerate(self.sensors):
            low, high = 0.0, max(4.0 * float(spread[sensor]), 1e-9)
            for _ in range(BISECTIONS):
                middle = high * 0.03 if low == 0.0 else (low * high) ** 0.5
                if all(p.sees(sensor, middle) for p in probes):
                    high = middle
                else:
                    low = middle
            seen, named = ANNOUNCED * high, np.inf
            for factor in NAMED_AT:
                if all(p.names(k, factor * seen) for p in probes):
                    named = factor * seen
                    break
            out[SENSORS[sensor]] = (seen, named)
        return out

    def dead(self, time: FloatArray, rows: FloatArray) -> BoolArray:
        """Samples that tell nothing: no reading has changed a bit for some samples although the
        joint moved, or time has not gone on, (n,).
        """
        pulse = Pulse(self.dt, 4 * GAP, self.measured)
        out = np.zeros(len(time), dtype=np.bool_)
        for k, (now, row) in enumerate(zip(time.tolist(), rows.tolist(), strict=True)):
            pulse.add(now, row)
            out[k] = pulse.failed
        own = rows[:, list(self.sensors)]
        for first, _ in _stretches(out):
            begin = first  # it takes some samples to be sure
            while begin > 0 and np.array_equal(own[begin], own[begin - 1]):
                begin -= 1
            out[begin:first] = True
        return out

    @property
    def tuned(self) -> Tuning:
        """The tuning.

        Raises
        ------
        InputError
            There is none yet.
        """
        if self.tuning is None:
            raise InputError("fault bank: calibrate it with healthy records first")
        return self.tuning

    def flags(self, count: int) -> FloatArray:
        """Which reading each filter uses, (filters, count, 6)."""
        table = np.tile(np.array(self.measured, dtype=np.float64), (1 + len(self.sensors), 1))
        for k, sensor in enumerate(self.sensors):
            table[k + 1, sensor] = 0.0
        return np.repeat(table[:, None, :], count, axis=1)

    def begun(
        self, time: FloatArray, rows: FloatArray, levels: Levels
    ) -> tuple[list[FilterState], int]:
        """All filters after the first :data:`HEAD` seconds of a stretch, and how many samples that
        took.

        They go their own ways from there: up to there all readings are believed, so that each knows
        the encoders' zero and where the motor stands. Velocities are not known at the first sample,
        and a filter that is linearised at wrong ones is too sure of what it found: disturbances and
        calibration are opened again after :data:`FIRST` seconds.
        """
        flags, at = self.flags(1)[0, 0], 0
        state = self.joint.start(
            float(time[0]), np.nan_to_num(rows[0]).tolist(), flags.tolist(), levels=levels
        )
        for seconds in (FIRST, HEAD):
            end = min(round(seconds / self.dt), len(time))
            if end > at:
                table = np.broadcast_to(flags, (1, end - at, 6))
                run = self.joint.run([state], time[at:end], rows[at:end], table, levels=levels)
                state = run.last[0]
                if at == 0:
                    state = opened(self.joint, state, levels, OPENED)
                at = end
        return [state] * (1 + len(self.sensors)), at

    def explained(
        self, state: FilterState, time: FloatArray, rows: FloatArray
    ) -> tuple[bool, bool]:
        """Whether an offset of the positions explains readings after a state of the filter that
        reads all sensors, and whether the stiffness does.
        """
        tuning = self.tuned
        return self.springs.explain(
            state,
            time,
            rows,
            measured=self.measured,
            levels=tuning.levels,
            limits=tuning.limits[0],
        )


def told(worst: FloatArray) -> int | None:
    """The sensor whose filter alone is innocent, by the largest scores of the filters without one
    sensor each; None where several are, or none.
    """
    order = np.argsort(worst)
    best, second = worst[order[0]], worst[order[1]]
    alone = int(np.sum(worst < 1)) == 1
    clearly = best < min(NEXT[0] * second, 1.0) and second > NEXT[1]
    return int(order[0]) if alone or clearly else None


class _Probe:
    """Filters just before a fault that is tried at one place of a record."""

    def __init__(self, bank: FaultBank, time: FloatArray, rows: FloatArray, place: int) -> None:
        self.bank = bank
        back, ahead = round(WINDOWS[-1] / bank.dt), round(WAITS[0] / bank.dt)
        first = max(place - back, 0)
        levels = bank.tuned.levels
        states, at = bank.begun(time, rows, levels)
        first = max(first, at)
        if first > at:
            part, flags = slice(at, first), bank.flags(first - at)
            run = bank.joint.run(states, time[part], rows[part], flags, levels=levels)
            states = list(run.last)
        self.states, self.begin = states, place - first
        self.time, self.rows = time[first : place + ahead], rows[first : place + ahead]

    def names(self, k: int, offset: float) -> bool:
        """Whether an offset of the k-th sensor is named as that, and as nothing else."""
        bank, sensor = self.bank, self.bank.sensors[k]
        if told(self.scores(sensor, offset)[1:]) != k:
            return False
        if SENSORS[sensor] not in AT_THE_SPRING:
            return True
        time, rows, state = self.time, self.rows.copy(), self.states[0]
        begin, levels = self.begin, bank.tuned.levels
        rows[begin:, sensor] += offset
        if begin:
            flags = bank.flags(begin)[:1]
            state = bank.joint.run([state], time[:begin], rows[:begin], flags, levels=levels).last[
                0
            ]
        return not bank.explained(state, time[begin:], rows[begin:])[1]

    def sees(self, sensor: int, offset: float) -> bool:
        """Whether an offset of a sensor brings the filter that reads all of them to its limits."""
        return bool(self.scores(sensor, offset, 1)[0] > 1)

    def scores(self, sensor: int, offset: float, filters: int | None = None) -> FloatArray:
        """Largest score of each filter, or of the first few, after an offset of a sensor."""
        bank, rows, states = self.bank, self.rows.copy(), self.states[:filters]
        rows[self.begin :, sensor] += offset
        flags, levels = bank.flags(len(rows))[: len(states)], bank.tuned.levels
        course = bank.joint.run(states, self.time, rows, flags, levels=levels)
        return np.array(
            [
                (statistics(course, k, bank.joint, levels) / bank.tuned.limits[k])[
                    self.begin :
                ].max()
                for k in range(len(states))
            ]
        )


class _Work:
    """One run of a bank over a record."""

    def __init__(
        self, bank: FaultBank, tuning: Tuning, time: FloatArray, rows: FloatArray, dead: BoolArray
    ) -> None:
        self.bank, self.tuning, self.time, self.rows, self.dead = bank, tuning, time, rows, dead
        self.events: list[FaultEvent] = []
        self.failed = np.zeros(rows.shape, dtype=np.bool_)
        self.scores = np.zeros((len(time), 1 + len(bank.sensors)))
        self.residuals = np.zeros(rows.shape)
        self.readings = rows.copy()
        self.quiet = -np.inf

    def go(self) -> None:
        """From stretch to stretch between gaps and dead samples."""
        self._missing()
        for first, _ in _stretches(self.dead):
            self._say(first, first, Verdict.DEAD, ())
        gaps = np.diff(self.time, prepend=self.time[0]) > GAP
        cut = np.flatnonzero(gaps | (np.diff(self.dead.astype(np.int8), prepend=0) != 0))
        edges = [0, *cut.tolist(), len(self.time)]
        for first, last in zip(edges[:-1], edges[1:], strict=True):
            if last > first and not self.dead[first]:
                time, late = self.time[first:last], self.bank.late
                there = aligned(time, self.rows[first:last], late)
                missing = np.isnan(self.rows[first:last])
                self.rows[first:last] = self.readings[first:last] = np.where(missing, np.nan, there)
                part = inside(time, late)
                if part.stop > part.start:
                    self._stretch(first + part.start, first + part.stop)

    def _missing(self) -> None:
        """Readings that are not there are said at once."""
        for sensor in self.bank.sensors:
            gone = ~np.isfinite(self.rows[:, sensor]) & ~self.dead
            self.failed[:, sensor] |= gone
            recent = -np.inf
            for first, last in _stretches(gone):
                if self.time[first] - recent > RECOVER:
                    self._say(first, first, Verdict.DROPOUT, (SENSORS[sensor],))
                recent = self.time[last - 1]

    def _stretch(self, first: int, last: int) -> None:
        """Filters from a fresh start up to a gap."""
        bank, levels = self.bank, self.tuning.levels
        part = slice(first, last)
        armed = self.time[first] + SETTLE
        states, taken = bank.begun(self.time[part], self.rows[part], levels)
        at, skip, history = first + taken, 0, round(WINDOWS[-1] / bank.dt)
        length = chunk = round(CHUNK / bank.dt)
        while at < last:
            end = min(at + length, last)
            scores = self._scored(states, slice(at, end), skip)
            over = (scores[:, 0] > 1) & (self.time[at:end] > armed)
            over[:skip] = False
            alarm = at + int(np.argmax(over)) if over.any() else end
            gone, missing = self._lost(at + skip, end)
            if min(alarm, gone) >= end:
                if end == last:
                    return
                back = max(end - history, at)
                states = self._moved(states, at, back)
                skip, at, length = end - back, back, chunk
                continue
            if alarm < gone and end < last and self.time[end - 1] - self.time[alarm] < WAITS[-1]:
                length += chunk  # a verdict may need what comes
                continue
            length, skip = chunk, 0
            if gone <= alarm:
                decided, sensor = gone, missing
            else:
                decided, verdict, sensors = self._decide(alarm, end, states, at)
                self._report(alarm, decided, verdict, sensors)
                sensor = SENSORS.index(sensors[0]) if verdict in ONE else -1
            if sensor >= 0:
                calm = int(np.searchsorted(self.time, self.time[min(alarm, gone)] - BEFORE))
                kept = self.readings[:decided].copy()  # a verdict does not change what was read
                healthy = self._with_calibration(
                    self._advanced(states, at, decided, 1 + bank.sensors.index(sensor)),
                    self._advanced(states, at, max(calm, at), 0),
                )
                self.readings[:decided] = kept
                at, state = self._await(healthy, decided, last, sensor)
                if at >= last:
                    return
                self._say(at, at, Verdict.RECOVERED, (SENSORS[sensor],))
                states, armed = [state] * (1 + len(bank.sensors)), self.time[at]
            else:
                at = min(decided + 1, last)
                if at < last:
                    rest = slice(at, last)
                    armed = self.time[at] + SETTLE
                    states, taken = bank.begun(self.time[rest], self.rows[rest], levels)
                    at += taken

    def _moved(self, states: Sequence[FilterState], first: int, last: int) -> list[FilterState]:
        """All filters after the samples of a stretch."""
        if last <= first:
            return list(states)
        bank, part = self.bank, slice(first, last)
        flags = bank.flags(last - first)
        levels = self.tuning.levels
        run = bank.joint.run(states, self.time[part], self.rows[part], flags, levels=levels)
        return list(run.last)

    def _lost(self, first: int, last: int) -> tuple[int, int]:
        """First sample of a stretch from which a reading is missing for long, and its sensor."""
        found = (last, -1)
        for sensor in self.bank.sensors:
            for a, b in _stretches(~np.isfinite(self.rows[first:last, sensor])):
                if self.time[first + b - 1] - self.time[first + a] > LOST:
                    found = min(found, (first + a, sensor))
                    break
        return found

    def _scored(
        self, states: Sequence[FilterState], part: slice, skip: int = 0, shown: int = 0
    ) -> FloatArray:
        """Scores of all filters over a stretch, whose first so many samples only fill the windows;
        the residuals of one of them are those of the readings.
        """
        bank, tuning = self.bank, self.tuning
        time, rows = self.time[part], self.rows[part]
        course = bank.joint.run(states, time, rows, bank.flags(len(time)), levels=tuning.levels)
        out = np.zeros((len(time), len(states)))
        for k in range(len(states)):
            shares = statistics(course, k, bank.joint, tuning.levels) / tuning.limits[k]
            out[:, k] = np.nan_to_num(shares.max(axis=1), nan=np.inf)
            if k == shown:
                own = np.nan_to_num(by_reading(shares), nan=np.inf)
                self.residuals[part.start + skip : part.stop] = own[skip:]
        self.scores[part.start + skip : part.stop] = out[skip:]
        return out

    def _advanced(
        self, states: Sequence[FilterState], first: int, last: int, which: int
    ) -> FilterState:
        """State of one filter after the samples of a stretch."""
        bank, part = self.bank, slice(first, last)
        if last <= first:
            return states[which]
        flags = bank.flags(last - first)[which : which + 1]
        run = bank.joint.run(
            [states[which]], self.time[part], self.rows[part], flags, levels=self.tuning.levels
        )
        if which:
            sensor = bank.sensors[which - 1]
            self.readings[part, sensor] = bank.joint.expected(run, self.rows[part])[:, sensor]
        return run.last[0]

    def _with_calibration(self, state: FilterState, known: FilterState) -> FilterState:
        """A filter with the calibration that another one has found: without a position nothing
        tells its encoder's zero, and a bias would pass for one.
        """
        first = self.bank.joint.states + BALANCES
        own = slice(first, first + self.bank.joint.free)
        mean, covariance = state.mean.copy(), state.covariance.copy()
        mean[own] = known.mean[own]
        covariance[own, :] = covariance[:, own] = 0.0
        covariance[own, own] = known.covariance[own, own]
        return replace(state, mean=mean, covariance=covariance)

    def _decide(
        self, alarm: int, last: int, states: Sequence[FilterState], at: int
    ) -> tuple[int, Verdict, tuple[str, ...]]:
        """Sample of the decision, verdict, sensors; with the filters at some sample before."""
        begin = int(np.searchsorted(self.time, self.time[alarm] - BEFORE))
        changed = self._with_calibration(
            self._advanced(states, at, alarm, 0),
            self._advanced(states, at, max(begin, at), 0),
        )
        names = [SENSORS[i] for i in self.bank.sensors]
        end, innocent, spring = alarm + 1, list(names), False
        for wait in WAITS:
            end = min(int(np.searchsorted(self.time, self.time[alarm] + wait)), last)
            worst = self.scores[begin:end, 1:].max(axis=0)
            innocent = [names[i] for i in np.argsort(worst) if worst[i] < 1]
            one = told(worst)
            suspects, spring = innocent if one is None else [names[one]], False
            if not suspects or not set(suspects).isdisjoint(AT_THE_SPRING):
                part = slice(alarm, end)
                offset, spring = self.bank.explained(changed, self.time[part], self.rows[part])
                if spring and not offset:
                    return end - 1, Verdict.PLANT, (STIFFNESS,)
                innocent = suspects
            if one is not None and not spring:
                pair = SENSORS.index(names[one]) == CURRENT
                verdict = Verdict.CURRENT_OR_FRICTION if pair else Verdict.SENSOR
                return end - 1, verdict, (names[one],)
            if not innocent:
                return end - 1, Verdict.PLANT, ()
            if end == last:
                break
        return end - 1, Verdict.ONE_OF, (*innocent, *([STIFFNESS] if spring else []))

    def _await(
        self, healthy: FilterState, first: int, last: int, sensor: int
    ) -> tuple[int, FilterState]:
        """Sample from which a failed sensor agrees with the others again, and the filter there."""
        bank, at, state = self.bank, first, healthy
        without = 1 + bank.sensors.index(sensor)
        begin = first
        while at < last:
            end = min(int(np.searchsorted(self.time, self.time[at] + RECOVER)), last)
            part = slice(at, max(end, at + 1))
            scores = self._scored([state] * (1 + len(bank.sensors)), part, shown=without)
            there = np.isfinite(self.rows[part, sensor]).all()
            if there and scores[:, 0].max() < 1 and end < last:
                self.failed[begin:end, sensor] = True
                self._advanced([state] * (1 + len(bank.sensors)), at, end, without)
                run = [state] * (1 + len(bank.sensors))
                return end, self._advanced(run, at, end, 0)
            over = np.flatnonzero(scores[:, 0] >= 1)
            after = min(at + (int(over[-1]) if len(over) else len(scores) - 1) + 1, last)
            state = self._advanced([state] * (1 + len(bank.sensors)), at, after, without)
            at = after
        self.failed[begin:last, sensor] = True
        return last, state

    def _report(self, alarm: int, decided: int, verdict: Verdict, sensors: tuple[str, ...]) -> None:
        about_joint = verdict in (Verdict.PLANT, Verdict.ONE_OF)
        known = self.time[alarm] < self.quiet
        if about_joint:
            self.quiet = self.time[decided] + PLANT_REST
        if not (about_joint and known):
            self._say(alarm, decided, verdict, sensors)

    def _say(self, first: int, sample: int, verdict: Verdict, sensors: tuple[str, ...]) -> None:
        over = np.flatnonzero(self.scores[sample] > 1)
        names = ("all", *(f"without {SENSORS[i]}" for i in self.bank.sensors))
        self.events.append(
            FaultEvent(sample, first, verdict, sensors, tuple(names[i] for i in over))
        )


def _stretches(flags: BoolArray) -> list[tuple[int, int]]:
    """First and one past the last of each run of true values."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
