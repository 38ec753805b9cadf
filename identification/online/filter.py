"""One extended Kalman filter of a joint's state and parameters on raw readings.

With parameters free it estimates them; with parameters fixed and a sensor left out it is one filter
of a fault bank (:mod:`identification.faults.bank`). The physics are the joint model's own CasADi
functions; the step runs interpreted or as generated C (:class:`identification.fitting.window_run`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from casadi_models.functions import JointFunctions
from identification.errors import InputError
from identification.fitting.window_run import WindowRun
from identification.online.filter_step import (
    BALANCES,
    CREEP,
    READINGS,
    Form,
    predict_function,
    update_function,
)

FloatArray = npt.NDArray[np.float64]

LONGEST_STEP: Final = 1e-3
"""Longest step of the integrator [s]: a sample that is longer is made in several. Friction's slope
over inertia is some 1000 1/s at zero velocity."""
SHORTEST: Final = 1e-9
"""Shortest time between two samples [s]: stamps that repeat give no infinite noise."""
BRIDGED: Final = 0.1
"""Longest gap between stamps over which the drive is taken for a straight line [s], sample by
sample; over longer ones the drive is not known at all."""
MOST_DECAY: Final = 2.0
"""Largest rate of the linearised joint times the step: at 2 the implicit midpoint takes a velocity
to zero in one step, above it the velocity would change its sign every step."""
DOUBLINGS: Final = 20
"""Doublings of the smoothing velocities at most until the step can follow them."""
TWIST: Final = 0.1
"""Standard deviation of motor less link position, and of the encoders' zero, before the first
reading [rad]: 6 degrees, more than any gear twists."""
START_SPEED: Final = 1.0
"""Standard deviation of the velocities before the first reading [rad/s]."""
AT_A_TURN: Final = 0.3
"""Share of the dry friction that is unsure while a side stands or turns."""
KNOWN: Final = 1e-3
"""Share of its level to which a disturbance is known at the best: readings have noise."""
SLOW: Final = 3.0
"""Smoothing velocities below which a side counts as standing or turning."""
MOST_DOUBT: Final = 0.5
"""Largest standard deviation of the logarithm of a doubtful parameter: the exponential of twice
that is 2.7, and no straight line."""
MOTOR, TRANSMISSION, LINK = range(3)


@final
@dataclass(frozen=True)
class Levels:
    """Noise of a joint and its readings: what the filter weighs by.

    Attributes
    ----------
    readings : tuple of 5 floats
        Standard deviations of motor position and velocity, link position and velocity, torque,
        link-referred SI.
    drive : float
        White noise of the drive torque [N.m.sqrt(s)].
    disturbance, lasting : tuple of 3 floats
        Standard deviation [N.m] and time constant [s] of the torque that the model lacks in the
        balances of motor, transmission and link: Markov processes of first order.
    unknown_drive, unknown_lasting : float
        The same for the motor torque where the drive is not read.
    shift : float
        Torque between two samples: share of the later reading of the drive. 0 for a command that is
        held, 0.5 for a torque that changes steadily; a late reading has more.
    creeping : tuple of 2 floats
        Standard deviation of what the friction of motor and link is wrong by while that side creeps
        through a turn [N.m].
    holding : tuple of 2 floats
        Standard deviation of the friction that holds a side that stands [N.m]: it lasts as long.
    clip : float
        Innovations beyond this many standard deviations weigh less (Huber).
    """

    readings: tuple[float, float, float, float, float] = (1.7e-5, 1e-3, 6.3e-5, 1e-3, 0.05)
    drive: float = 0.01
    disturbance: tuple[float, float, float] = (1.0, 0.3, 0.5)
    lasting: tuple[float, float, float] = (0.1, 0.1, 0.1)
    unknown_drive: float = 100.0
    unknown_lasting: float = 0.05
    shift: float = 0.0
    creeping: tuple[float, float] = (0.0, 0.0)
    holding: tuple[float, float] = (0.0, 0.0)
    clip: float = 4.0

    def vector(self) -> list[float]:
        """All numbers, in the order in which the step takes them."""
        return [
            *self.readings,
            self.drive,
            *self.disturbance,
            *self.lasting,
            self.unknown_drive,
            self.unknown_lasting,
            self.shift,
            *self.creeping,
            *self.holding,
            self.clip,
        ]


@final
@dataclass(frozen=True)
class Doubts:
    """Parameters that a filter takes as they are, but not for sure.

    Attributes
    ----------
    names : tuple of str
    covariance : (p, p) array
        Of their values, as of a fit.
    """

    names: tuple[str, ...] = ()
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def without(self, name: str | None) -> Doubts:
        """The others, were the one known."""
        kept = [i for i, n in enumerate(self.names) if n != name]
        return Doubts(tuple(self.names[i] for i in kept), self.covariance[np.ix_(kept, kept)])


@final
@dataclass(frozen=True)
class FilterState:
    """All that a filter knows.

    Attributes
    ----------
    mean : (n,) array
        State of the joint, disturbances of motor, transmission and link [N.m], free parameters
        (logarithms where :attr:`JointFilter.logarithmic` says so).
    covariance : (n, n) array
    time : float
        Of the last sample [s].
    drive : float
        Its drive torque [N.m].
    """

    mean: FloatArray
    covariance: FloatArray
    time: float
    drive: float

    def flat(self) -> FloatArray:
        """Mean and covariance in one row."""
        return np.concatenate([self.mean, self.covariance.ravel()])


@final
@dataclass(frozen=True)
class Course:
    """What filters did along a record; one row of the first axis per filter.

    Attributes
    ----------
    innovation : (filters, n, 5) array
        Of motor position and velocity, link position and velocity, torque over their standard
        deviations, one after the other within a sample, so that they are independent; 0 where a
        reading is not used.
    spread : (filters, n, 5) array
        Those standard deviations, link-referred SI; 1 where a reading is not used.
    disturbance, deviation : (filters, n, 3) array
        Disturbances of motor, transmission and link, and their standard deviations [N.m].
    states : (filters, n, states) array
        The joint's state.
    used_drive : bool
        Whether the first filter reads the drive.
    last : tuple of FilterState
    """

    innovation: FloatArray
    spread: FloatArray
    disturbance: FloatArray
    deviation: FloatArray
    states: FloatArray
    used_drive: bool
    last: tuple[FilterState, ...]

    def at(self, rows: npt.NDArray[np.intp]) -> Course:
        """What the filters did in some of the samples."""
        return replace(
            self,
            innovation=self.innovation[:, rows],
            spread=self.spread[:, rows],
            disturbance=self.disturbance[:, rows],
            deviation=self.deviation[:, rows],
            states=self.states[:, rows],
        )


@final
class JointFilter:
    """Extended Kalman filter of one joint.

    Parameters
    ----------
    model : JointModel
        With its values.
    dt : float
        Usual sample time [s]; samples may come unevenly.
    free : sequence of str
        Parameters that are estimated too.
    reciprocal : sequence of str
        Those of them that stand in the state as one over their value: a stiffness that may be far
        off, whose twist is linear in that.
    doubts : Doubts
        Parameters that are not estimated, and whose errors count as what they do to the readings
        (Schmidt's filter): a joint that was fitted at one speed is known less well at another.

    Attributes
    ----------
    names : tuple of str
        The free parameters, then the doubtful ones.
    free : int
        How many are free.
    logarithmic : tuple of bool
        Which of them stand in the state as logarithms: inertias, and what the transmission is made
        of and cannot be negative, where they are positive at the start.
    size : int
        Length of the mean.
    """

    def __init__(
        self,
        model: JointModel,
        dt: float,
        free: Sequence[str] = (),
        reciprocal: Sequence[str] = (),
        doubts: Doubts = Doubts(),  # noqa: B008 - frozen
    ) -> None:
        unknown = sorted({*free, *doubts.names} - set(model.parameter_names))
        if unknown:
            raise InputError(f"filter: the model has no parameter {', '.join(unknown)}")
        if not (np.isfinite(dt) and dt > 0):
            raise InputError(f"filter: the sample time is {dt!r}; give a positive number of s")
        self.model, self.dt, self.names = model, dt, (*free, *doubts.names)
        self.free = len(free)
        self.functions = JointFunctions(model, open_to_disturbances=True)
        self.states = len(self.functions.state_names) + len(self.functions.memory_names)
        self.size = self.states + BALANCES + len(self.names)
        values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
        positive = {
            *model.named("inertia"),
            *(
                p.name
                for t in model.terms
                if t.place == "transmission"
                for p in t.parameters
                if p.low >= 0 and not p.is_shape
            ),
        }
        self.reciprocal = tuple(n in reciprocal and values[n] != 0 for n in self.names)
        self.logarithmic = tuple(
            n in positive and values[n] > 0 and not one_over
            for n, one_over in zip(self.names, self.reciprocal, strict=True)
        )
        self.substeps = max(1, int(np.ceil(dt / LONGEST_STEP - 1e-9)))
        self.values = self._followable(values)
        self.walks = np.zeros(len(self.names))
        self.dry, self.slow = self._dry_friction()
        self.doubtful = self._entries(doubts)

    # --- what the step is made from ---------------------------------------------------------------

    def _followable(self, values: Mapping[str, float]) -> dict[str, float]:
        """Values with friction smooth enough for the step (see :data:`MOST_DECAY`)."""
        found, smooth = dict(values), self.model.named("smoothing")
        step = self.dt / self.substeps
        x, u = np.zeros(self.states), np.zeros(3)
        for _ in range(DOUBLINGS):
            slopes = np.array(self.model.jacobian(x, u, list(found.values()))[0])
            finite = np.isfinite(slopes).all()
            if finite and -np.min(np.linalg.eigvals(slopes).real) * step <= MOST_DECAY:
                break
            found |= {n: 2.0 * found[n] for n in smooth}
        return found

    def _dry_friction(self) -> tuple[FloatArray, FloatArray]:
        """Dry friction of motor and link [N.m] and the speeds below which they are unsure.

        What the resistance keeps when the speed goes to zero: by a straight line through two speeds
        well above the smoothing velocity.
        """
        widths = [self.values[n] for n in self.model.named("smoothing")]
        if not widths:
            return np.zeros(2), np.ones(2)
        width = max(widths)
        dry = []
        for state, push in ((1, (1.0, 0.0)), (self.states_of_motion - 1, (0.0, 1.0))):
            gain = self._rate(state, 0.0, push) - self._rate(state, 0.0)
            jump = [
                (self._rate(state, -k * width) - self._rate(state, k * width)) / (2 * gain)
                for k in (5.0, 10.0)
            ]
            dry.append(max(2 * jump[0] - jump[1], 0.0))
        return AT_A_TURN * np.array(dry), np.full(2, SLOW * width)

    def _entries(self, doubts: Doubts) -> FloatArray:
        """Covariance of the doubtful parameters as they stand in the state."""
        per_value = np.ones(len(doubts.names))
        for k, name in enumerate(doubts.names):
            if self.logarithmic[self.free + k]:
                spread = float(np.sqrt(doubts.covariance[k, k]))
                # where the logarithm is no straight line any more its error is cut
                per_value[k] = 1 / max(self.values[name], spread / MOST_DOUBT)
        return np.asarray(doubts.covariance * np.outer(per_value, per_value), dtype=np.float64)

    def _rate(self, state: int, speed: float, push: tuple[float, float] = (0.0, 0.0)) -> float:
        """Acceleration of a side at a speed, with torques on motor and link."""
        x = np.zeros(self.states)
        x[state] = speed
        p, drive = list(self.values.values()), [push[0], 0.0, 0.0]
        return float(self.functions.disturbed(x, drive, p, [0.0, push[1]])[0][state])

    @property
    def states_of_motion(self) -> int:
        """Positions and velocities in the joint's state."""
        return len(self.functions.state_names)

    @cached_property
    def predict(self) -> Any:
        """See :func:`identification.online.filter_step.predict_function`."""
        return predict_function(self.functions, self.model, self.names, self._forms)

    @cached_property
    def update(self) -> Any:
        """See :func:`identification.online.filter_step.update_function`."""
        return update_function(self.functions, self.model, self.names, self._forms, self.free)

    @property
    def _forms(self) -> tuple[Form, ...]:
        """How each free parameter stands in the state."""
        pairs = zip(self.logarithmic, self.reciprocal, strict=True)
        return tuple(
            Form.LOGARITHM if a else Form.RECIPROCAL if b else Form.VALUE for a, b in pairs
        )

    def sample_function(self, substeps: int | None = None) -> Any:
        """(state, inputs, p) -> (state after the sample, outputs), all columns.

        state: :meth:`FilterState.flat`. inputs: drive of the sample before, six readings (drive,
        motor position, velocity, link position, velocity, torque), six flags (1: used), time since
        the sample before, time, temperature. p: :meth:`parameters`. outputs: whitened innovations
        (5), their standard deviations (5), disturbances (3), their standard deviations (3), the
        joint's state.
        """
        import casadi as ca

        n, steps = self.size, substeps or self.substeps
        state, p = ca.MX.sym("state", n + n * n), ca.MX.sym("p", self.update.size1_in(4))
        inputs = ca.MX.sym("inputs", 1 + 2 * READINGS + 3)
        mean, covariance = state[:n], ca.reshape(state[n:], n, n)
        before, readings, used = inputs[0], inputs[1:7], inputs[7:13]
        h, when = inputs[13] / steps, inputs[14:16]
        for _ in range(steps):
            mean, covariance = self.predict(
                mean, covariance, ca.vertcat(before, readings[0], used[0], inputs[13], h, when), p
            )
        mean, covariance, out = self.update(mean, covariance, readings, ca.vertcat(used, when), p)
        after = ca.vertcat(mean, ca.reshape(covariance, n * n, 1))
        return ca.Function(
            "sample", [state, inputs, p], [after, out], ["state", "inputs", "p"], ["next", "out"]
        )

    def parameters(self, levels: Levels) -> FloatArray:
        """Values of the model, noise, friction at a turn, walks of the free parameters."""
        return np.array(
            [*self.values.values(), *levels.vector(), *self.dry, *self.slow, *self.walks]
        )

    @cached_property
    def _run(self) -> WindowRun:
        return WindowRun(self.sample_function(), 1, 10**6)

    @property
    def is_compiled(self) -> bool:
        """True where the step runs as C."""
        return self._run.is_compiled

    def with_walks(self, per_second: Mapping[str, float]) -> JointFilter:
        """This filter with free parameters that walk: standard deviation after one second, in the
        parameter's unit (a share of it where it stands as its logarithm).
        """
        self.walks = np.array([per_second.get(n, 0.0) for n in self.names])
        return self

    # --- life -------------------------------------------------------------------------------------

    def start(
        self,
        time: float,
        readings: Sequence[float],
        used: Sequence[float] = (1.0,) * 6,
        *,
        levels: Levels | None = None,
        deviations: Mapping[str, float] | None = None,
        values: Mapping[str, float] | None = None,
    ) -> FilterState:
        """A filter before its first sample, at rest where the readings say.

        Parameters
        ----------
        time : float
        readings : sequence of 6 floats
            Drive, motor position and velocity, link position and velocity, torque.
        used : sequence of 6 numbers
            0 for a reading that is not there.
        levels : Levels, optional
        deviations : mapping of str to float
            Standard deviation of each free parameter at the start; :data:`TWIST` for a calibration
            unknown, a tenth of the value where nothing is said. A share of the value where it
            stands as its logarithm.
        values : mapping of str to float
            Free parameters at the start; those of the model where nothing is said.
        """
        known = levels or Levels()
        mean, variance = np.zeros(self.size), np.zeros(self.size)
        place = readings[1] if used[1] else readings[3]
        positions = [0, 2] if self.states_of_motion == len(READINGS_OF_MOTION) else [0]
        for i in positions:
            mean[i], variance[i] = place, TWIST**2
            variance[i + 1] = START_SPEED**2
        variance[0] = known.readings[0] ** 2 if used[1] else TWIST**2
        at = self.states
        variance[at : at + BALANCES] = np.square(known.disturbance)
        given, spread = {**self.values, **(values or {})}, deviations or {}
        for k, (name, log) in enumerate(zip(self.names, self.logarithmic, strict=True)):
            usual = TWIST if name in self.model.calibration else 0.1 * (abs(given[name]) or 1.0)
            usual = 0.1 if log else usual
            mean[at + BALANCES + k] = np.log(given[name]) if log else given[name]
            variance[at + BALANCES + k] = spread.get(name, usual) ** 2
            if self.reciprocal[k]:
                mean[at + BALANCES + k] = 1 / given[name]
                variance[at + BALANCES + k] /= given[name] ** 4
        covariance, doubtful = np.diag(variance), slice(at + BALANCES + self.free, None)
        covariance[doubtful, doubtful] = self.doubtful
        return FilterState(mean, covariance, time - self.dt, float(readings[0]))

    def step(
        self,
        state: FilterState,
        time: float,
        readings: Sequence[float],
        used: Sequence[float] = (1.0,) * 6,
        *,
        levels: Levels | None = None,
    ) -> tuple[FilterState, Course]:
        """Take one sample (see :meth:`run`)."""
        course = self.run(
            [state], np.array([time]), np.array([readings]), np.array([[used]]), levels=levels
        )
        return course.last[0], course

    def run(
        self,
        states: Sequence[FilterState],
        time: FloatArray,
        readings: FloatArray,
        used: FloatArray,
        *,
        levels: Levels | None = None,
    ) -> Course:
        """Several filters along the same readings.

        Parameters
        ----------
        states : sequence of FilterState
            One per filter.
        time : (n,) array
        readings : (n, 6) array
            Drive, motor position and velocity, link position and velocity, torque; what is no
            number counts as missing.
        used : (filters, n, 6) array
            0: the reading is not used by the filter.
        levels : Levels, optional

        Notes
        -----
        Samples that were lost are predicted one by one, with the drive in between: a step over many
        of them would follow no turn of a friction law, and would weigh the drive before and after
        as if they were one sample apart.
        """
        full, kept = _bridged(np.concatenate([[states[0].time], time]), self.dt)
        if len(full) > len(time):
            following = np.searchsorted(kept, np.arange(len(full)))
            knots = [states[0].drive, *_held(readings[:, 0], states[0].drive)]
            table = np.full((len(full), READINGS), np.nan)
            table[:, 0] = np.interp(full, [states[0].time, *time], knots)
            table[kept] = readings
            return self.run(states, full, table, used[:, following], levels=levels).at(kept)
        count, length = len(states), len(time)
        there = np.isfinite(readings)
        clean = np.where(there, readings, 0.0)
        drive = _held(readings[:, 0], states[0].drive)
        inputs = np.zeros((count, length, 1 + 2 * READINGS + 3))
        inputs[:, :, 0] = np.concatenate([[states[0].drive], drive[:-1]])
        inputs[:, :, 1:7] = clean
        inputs[:, :, 1] = drive
        inputs[:, :, 7:13] = used * there
        inputs[:, :, 7] = used[:, :, 0]  # a missing drive is held
        inputs[:, :, 13] = np.maximum(np.diff(time, prepend=states[0].time), SHORTEST)
        inputs[:, :, 14] = time
        start = np.stack([s.flat() for s in states])
        given = (start, inputs.reshape(count * length, -1), self.parameters(levels or Levels()))
        out, end = self._run.run(*given)
        n = self.size
        last = tuple(
            FilterState(row[:n], row[n:].reshape(n, n), float(time[-1]), float(drive[-1]))
            for row in end
        )
        cut = np.split(out, [5, 10, 13, 16], axis=2)
        return Course(
            cut[0], cut[1], cut[2], cut[3], cut[4], used_drive=bool(used[0, 0, 0]), last=last
        )

    def unsure_friction(self, course: Course, which: int, levels: Levels) -> FloatArray:
        """What the friction of motor and link may be wrong by along a filter's course, (n, 3) as
        its disturbances [N.m]: all of the dry friction while a side creeps, and
        :data:`identification.online.filter_step.CREEP` later. What the filter has put down to it by
        then is in its disturbance until the filter has seen that the side turns freely again: that
        fades by the time constant of the disturbance, and faster where readings tell it better.
        """
        speeds = course.states[which][:, [1, self.states_of_motion - 1]]
        near = np.exp(-((speeds / self.slow) ** 2))
        length = max(1, round(CREEP / self.dt))
        before = np.concatenate([np.zeros((length - 1, 2)), near])
        lately = np.lib.stride_tricks.sliding_window_view(before, length, axis=0).max(axis=2)
        now = np.zeros((len(lately), BALANCES))
        now[:, [MOTOR, LINK]] = self.dry / AT_A_TURN * lately
        # a Markov process of variance s2 that is known to P keeps a value that is no longer there
        # by exp(-t (2 s2/P - 1)/lasting): its own fading and the steady filter's gain
        own = np.square(levels.disturbance)
        known = np.maximum(np.square(course.deviation[which]), KNOWN**2 * own)
        rate = np.maximum(2 * own / np.maximum(known, np.finfo(float).tiny) - 1, 1)
        fading = np.cumsum(rate * self.dt / levels.lasting, axis=0)
        put_down = np.minimum(np.abs(course.disturbance[which]), now)
        with np.errstate(divide="ignore"):
            kept = np.maximum.accumulate(np.log(put_down) + fading, axis=0) - fading
        unsure: FloatArray = np.maximum(now, np.exp(kept))
        return unsure

    def expected(self, course: Course, readings: FloatArray) -> FloatArray:
        """Readings (n, 6) as the first filter of a course expects them after each sample.

        The drive is the given one plus the disturbance of the motor, which is all of it where the
        filter does not read the drive and it is given as zero.
        """
        values, last = np.array(list(self.values.values())), self.estimate(course.last[0])
        names = self.model.parameter_names
        for name, (value, _) in last.items():
            values[names.index(name)] = value
        motor = course.disturbance[0, :, 0]
        drive = np.where(course.used_drive, np.nan_to_num(readings[:, 0]), 0.0) + motor
        inputs = np.zeros((3, len(drive)))
        inputs[0] = drive
        run = self.functions.disturbed.map(len(drive))
        found = run(course.states[0].T, inputs, values, course.disturbance[0, :, 1:].T)[1]
        return np.column_stack([drive, np.array(found).T])

    def estimate(self, state: FilterState) -> dict[str, tuple[float, float]]:
        """Value and standard deviation of each free parameter."""
        first = self.states + BALANCES
        out = {}
        for k, (name, log) in enumerate(zip(self.names, self.logarithmic, strict=True)):
            mean = float(state.mean[first + k])
            spread = float(np.sqrt(max(state.covariance[first + k, first + k], 0.0)))
            if self.reciprocal[k]:
                mean, spread = 1 / mean, spread / mean**2
            out[name] = (
                (float(np.exp(mean)), float(np.exp(mean)) * spread) if log else (mean, spread)
            )
        return out


READINGS_OF_MOTION: Final = ("motor position", "motor velocity", "link position", "link velocity")
"""Mechanical state of an elastic joint."""


def _bridged(stamps: FloatArray, dt: float) -> tuple[FloatArray, npt.NDArray[np.intp]]:
    """Stamps after the first one with those of lost samples between them, and where the given ones
    are in them.
    """
    steps = np.diff(stamps)
    # a step of one and a half is uneven, and nothing is lost
    lost = np.where(steps <= BRIDGED, np.ceil(steps / dt - 1.5 - 1e-6), 0)
    lost = np.maximum(lost, 0).astype(np.intp)
    kept = np.arange(len(steps)) + np.cumsum(lost)
    if not lost.any():
        return stamps[1:], kept
    places = np.concatenate([[-1], kept])
    return np.interp(np.arange(kept[-1] + 1), places, stamps), kept


def _held(drive: FloatArray, before: float) -> FloatArray:
    """The drive with missing values replaced by the last one."""
    good = np.isfinite(drive)
    if good.all():
        return drive
    last = np.maximum.accumulate(np.where(good, np.arange(len(drive)), -1))
    return np.where(last >= 0, drive[np.maximum(last, 0)], before)
