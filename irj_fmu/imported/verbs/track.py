"""Track: the outputs of a user's FMU watched along records, its parameters fixed.

The FMU is started anew every window, at start values that the window's own readings tell. What is
left of each output, in standard deviations of its noise, goes through the statistics of the fault
bank (:mod:`identification.faults.bank_statistics`). Beside the run that reads every output there is
one for each of them that leaves it out: where the first leaves its limits, the sensor is the one
without which the others agree with the FMU again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.data.formats import words
from identification.data.record import Record
from identification.errors import InputError
from identification.faults.bank import BEFORE, RECOVER, WAITS, told
from identification.faults.bank_statistics import floors, limits, over_windows
from identification.faults.types import Verdict
from identification.fitting.assess import RATIO_LIMIT
from identification.fitting.least_squares import least_squares
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.fit import ENOUGH, Outputs, UserFit, simulator_of
from irj_fmu.imported.model import UserModel, at_least_one, start_values
from irj_fmu.imported.outputs import noise_of
from irj_fmu.imported.port import coupled
from irj_fmu.imported.run import RTOL, Window
from irj_fmu.imported.sensitivity import Simulator

BoolArray = npt.NDArray[np.bool_]

WINDOW: Final = 0.5
"""Length of the windows where the joint file says none and the FMU can be started [s]: as long as
three of them hold the longest mean, and what a drive that runs free drifts off stays small."""
STEPS: Final = 8
"""Gauss-Newton steps of the start values, as `compare` takes."""
UNREAD: Final = 1e6
"""Standard deviations of a channel that counts for nothing, in units of its own spread."""
SPEEDS: Final = ("motor_velocity", "link_velocity")
TURN: Final = 0.05
"""Share of a record's largest start velocity below which a window begins near a turn: slopes of
encoders are a hundredth of it wrong, and one window in thirty begins there."""
POINTS: Final = 400
"""Points of the residuals' course that are kept per record."""

Progress = Callable[[str, float], None]


@final
@dataclass(frozen=True)
class Alarm:
    """What the outputs of a user's FMU say is wrong.

    Attributes
    ----------
    first, decided, last : float
        Stamps at which the readings left the limits, at which the names stood, and from which on
        they agreed again or the record ended [s].
    verdict : Verdict
    sensors : tuple of str
        Channels that may be it: one where the others agree without it.
    """

    first: float
    decided: float
    last: float
    verdict: Verdict
    sensors: tuple[str, ...]

    @property
    def text(self) -> str:
        """One sentence."""
        named = " or ".join(words(n) for n in self.sensors)
        if self.verdict is Verdict.SENSOR:
            return f"{named}: sensor failed"
        if self.verdict is Verdict.ONE_OF:
            return f"{named} failed, or the joint changed; the readings cannot tell which"
        return f"{named} failed or the joint changed: no other reading alone explains it"

    def as_json(self) -> dict[str, Any]:
        """The shape of an event of `track --json`."""
        return {
            "time": self.decided,
            "first": self.first,
            "until": self.last,
            "sensors": list(self.sensors),
            "text": self.text,
        }


@final
@dataclass(frozen=True)
class UserTrack:
    """A record followed by a user's FMU.

    Attributes
    ----------
    record : Record
    time : (n,) array
        Stamps [s].
    residuals : (n, outputs) array
        Measured less simulated, in the units of the FMU.
    scores : (n,) array
        Largest statistic over its limit; above 1 something is wrong.
    ratios : mapping of str to float
        RMS of each output's residual over its noise.
    alarms : tuple of Alarm
    calibrated : bool
        The limits come from healthy records.
    """

    record: Record
    channels: tuple[str, ...]
    time: FloatArray
    residuals: FloatArray
    scores: FloatArray
    ratios: dict[str, float]
    alarms: tuple[Alarm, ...]
    calibrated: bool

    def as_json(self) -> dict[str, Any]:
        """The shape of `track --json` for an FMU: events, ratios and the course of the residuals;
        parameters are those of the joint file and do not move.
        """
        every = max(1, len(self.time) // POINTS)
        return {
            "record": self.record.name,
            "time": self.time[::every].tolist(),
            "detector": True,
            "calibrated": self.calibrated,
            "events": [a.as_json() for a in self.alarms],
            "ratio": self.ratios,
            "residuals": {
                c: self.residuals[::every, i].tolist() for i, c in enumerate(self.channels)
            },
            "score": self.scores[::every].tolist(),
            "parameters": {},
        }


@final
class Watch:
    """The outputs of a user's FMU, and what they are held to.

    Parameters
    ----------
    model : UserModel or UserFit
        With fitted values; they stay.
    healthy : Record or sequence of Record
        Records of the healthy joint: limits come from them. Without them they come from the noise
        of the outputs, for an FMU that leaves as much as counts as the noise floor.
    progress : callable, optional
        ``progress(text, share)``.

    Raises
    ------
    InputError
        An FMU without an output that is recorded, unusable records.
    FmuError
        Where the FMU refuses a call.
    """

    def __init__(
        self,
        model: UserModel | UserFit,
        healthy: Record | Sequence[Record] = (),
        *,
        progress: Progress | None = None,
    ) -> None:
        now = model.model if isinstance(model, UserFit) else model
        self._say: Progress = progress or (lambda _text, _share: None)
        given = at_least_one(healthy) if healthy else []
        self.model = _cut(now)
        self.channels = tuple(m.channel for m in self.model.outputs)
        self._noise: FloatArray | None = noise_of(self.model, given) if given else None
        self._limits: dict[int | None, FloatArray] = {}
        if not given:
            return
        courses = [self._courses(r, f"healthy record {r.name}") for r in given]
        for key, course in courses[0].items():
            parts = [over_windows(c[key], r.dt) for c, r in zip(courses, given, strict=True)]
            self._limits[key] = limits(parts, given[0].dt, (), course.shape[1])
        self._dt = given[0].dt

    def run(self, record: Record) -> UserTrack:
        """Follow a record.

        Raises
        ------
        InputError
            Its sample time is not that of the healthy records; it is too short.
        """
        if self._limits and not math.isclose(self._dt, record.dt, rel_tol=0.01):
            raise InputError(
                f"{record.name}: sampled every {record.dt:.4g} s, the healthy records every "
                f"{self._dt:.4g} s; give records with one sample time, or irj resample them"
            )
        courses = self._courses(record, record.name)
        scores = {k: self._score(k, c, record.dt) for k, c in courses.items()}
        whole = courses[None]
        windows = self.model.windows([record])
        time = np.concatenate([w.time for w in windows])
        noise = self._levels(record)
        ratios = np.sqrt(np.mean(whole**2, axis=0))
        self._say("done", 1.0)
        return UserTrack(
            record,
            self.channels,
            time,
            residuals=whole * noise,
            scores=scores[None],
            ratios=dict(zip(self.channels, ratios.tolist(), strict=True)),
            alarms=tuple(self._alarms(time, scores, record.dt)),
            calibrated=bool(self._limits),
        )

    # --- inside -----------------------------------------------------------------------------------

    def _levels(self, record: Record) -> FloatArray:
        """Standard deviations of the outputs; of a channel without noise what runs of the FMU
        differ by.
        """
        known = self._noise if self._noise is not None else noise_of(self.model, [record])
        spans = [abs(m.scale) * float(np.ptp(record[m.channel])) for m in self.model.outputs]
        return np.maximum(np.maximum(known, RTOL * np.array(spans)), 1e-300)

    def _score(self, key: int | None, course: FloatArray, dt: float) -> FloatArray:
        """Largest statistic over its limit, (n,)."""
        found, known = over_windows(course, dt), self._limits.get(key)
        if known is None:
            known = RATIO_LIMIT * floors(dt, (), course.shape[1])
        return np.asarray((found / known).max(axis=1), dtype=np.float64)

    def _courses(self, record: Record, name: str) -> dict[int | None, FloatArray]:
        """Residuals in standard deviations, (n, outputs read): of the run that reads every output,
        and of those that leave out one.
        """
        windows = self.model.windows([record])
        noise = self._levels(record)
        model = self.model
        if model.coupling is None:
            model = coupled(model, windows, noise)
        simulator, _ = simulator_of(model, windows, noise)
        measured = np.concatenate([w.outputs for w in windows])
        count = len(self.channels)
        keys: list[int | None] = [None, *(range(count) if count > 1 else ())]
        out: dict[int | None, FloatArray] = {}
        for number, key in enumerate(keys):
            self._say(f"following {name}", number / len(keys))
            sigma = noise.copy()
            if key is not None:
                sigma[key] = UNREAD * max(float(np.std(measured[:, key])), float(noise[key]))
            read = [i for i in range(count) if i != key]
            left = measured - self._followed(simulator, windows, sigma)
            out[key] = (left / noise)[:, read]
        return out

    def _followed(
        self, simulator: Simulator, windows: Sequence[Window], sigma: FloatArray
    ) -> FloatArray:
        """Outputs along the windows from the start values that their readings tell."""
        values, starts = self.model.values, start_values(windows)
        if self.model.starts:
            problem = Outputs(windows, simulator, values, (), sigma)
            starts, cost = _settled(problem, starts)
            rows = np.array([w.outputs.size for w in windows])
            turns, others = other_starts(self.model, windows)
            for other in others:
                # windows that their own readings do not settle; a fault leaves all of them so
                left = (cost > RATIO_LIMIT**2 * rows) & turns
                if not left.any():
                    break
                begun = np.where(left[:, None], other, starts)
                found, less = _settled(problem, begun)
                starts = np.where((less < cost)[:, None], found, starts)
                cost = np.minimum(less, cost)
        return np.concatenate(simulator.simulate(values, starts))

    def _alarms(
        self, time: FloatArray, scores: dict[int | None, FloatArray], dt: float
    ) -> list[Alarm]:
        found = []
        apart = max(1, round(RECOVER / dt))
        over = np.flatnonzero(scores[None] > 1)
        for part in np.split(over, np.flatnonzero(np.diff(over) > apart) + 1) if len(over) else []:
            first, last = int(part[0]), int(part[-1])
            end, verdict, sensors = self._named(first, time, scores, dt)
            found.append(
                Alarm(float(time[first]), float(time[end]), float(time[last]), verdict, sensors)
            )
        return found

    def _named(
        self, first: int, time: FloatArray, scores: dict[int | None, FloatArray], dt: float
    ) -> tuple[int, Verdict, tuple[str, ...]]:
        """Sample of the decision, verdict and channels, by the scores without one output each."""
        drive = tuple(m.channel for m in self.model.inputs)
        begin, end = max(0, first - round(BEFORE / dt)), first
        if len(self.channels) == 1:
            return first, Verdict.ONE_OF, (*self.channels, *drive)
        innocent: list[str] = []
        for wait in WAITS:
            end = min(first + max(1, round(wait / dt)), len(time) - 1)
            worst = np.array([scores[i][begin : end + 1].max() for i in range(len(self.channels))])
            one = told(worst)
            if one is not None:
                return end, Verdict.SENSOR, (self.channels[one],)
            innocent = [self.channels[i] for i in np.argsort(worst) if worst[i] < 1]
            if not innocent:
                return end, Verdict.PLANT, drive
        return end, Verdict.ONE_OF, tuple(innocent)


def _settled(problem: Outputs, starts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Start values of the windows by their own readings, and the sum of squares of each."""
    none = np.empty(0)
    found = least_squares(
        problem,
        none,
        (none, none),
        local=starts,
        iterations=STEPS,
        tolerance=ENOUGH / sum(w.outputs.size for w in problem.windows),
    ).local
    return found, problem.costs(none, found)


def other_starts(model: UserModel, windows: Sequence[Window]) -> tuple[BoolArray, list[FloatArray]]:
    """Windows that begin near a turn, (windows,), and start values with other velocities, (windows,
    starts) each.

    There the slope of noisy positions may have the other sign: dry friction then holds the motor,
    and no step of its velocity moves an output. The velocity of the other side, or none and its
    opposite where there is no other side, begin on the right side of the turn.
    """
    own = start_values(windows)
    speeds = [k for k, m in enumerate(model.starts) if m.channel in SPEEDS]
    if not speeds:
        return np.zeros(len(windows), dtype=bool), []
    size = np.abs(own[:, speeds])
    turns = (size < TURN * size.max(axis=0, initial=0.0)).any(axis=1)
    out = []
    if len(speeds) == 2:
        side = {model.starts[k].channel: k for k in speeds}
        motor, link = (side[c] for c in SPEEDS)
        factor = model.joint.gear_ratio * model.starts[motor].scale / model.starts[link].scale
        for to, of, by in ((motor, link, factor), (link, motor, 1 / factor)):
            moved = own.copy()
            moved[:, to] = by * own[:, of]
            out.append(moved)
        return turns, out
    for share in (0.0, -1.0):
        moved = own.copy()
        moved[:, speeds] *= share
        out.append(moved)
    return turns, out


def _cut(model: UserModel) -> UserModel:
    """The model with windows, where it can be started in the middle of a record."""
    return replace(model, window=WINDOW) if model.window is None and model.starts else model


def track(
    model: UserModel | UserFit,
    records: Record | Sequence[Record],
    healthy: Record | Sequence[Record] = (),
    *,
    progress: Progress | None = None,
) -> list[UserTrack]:
    """Follow records with a user's FMU and look for readings that it cannot give.

    Parameters
    ----------
    model : UserModel or UserFit
    records, healthy : Record or sequence of Record
        See :class:`Watch`.
    progress : callable, optional
        ``progress(text, share)``.

    Raises
    ------
    InputError
        Unusable records.
    FmuError
        Where the FMU refuses a call.
    """
    watch = Watch(model, healthy, progress=progress)
    return [watch.run(r) for r in at_least_one(records)]


__all__ = ["Alarm", "UserTrack", "Watch", "track"]
