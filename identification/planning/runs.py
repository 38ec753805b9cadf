"""Runs that a joint can play: a motion and a load, and the recording that a model predicts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from casadi_models.term import LINK_INERTIA
from identification.balance.dataset import (
    LINK_BALANCES,
    Dataset,
    run_name,
    usual_kernel,
    weak_record,
)
from identification.balance.sensing import Sensing
from identification.balance.stacked import floors
from identification.balance.weak import WeakRecord
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError
from identification.fitting.engine import Solution
from identification.planning.follow import Followed, Follower
from identification.planning.motion import Motion
from identification.planning.trajectories import Limits

FloatArray = npt.NDArray[np.float64]

SIMULATED: Final = 10.0
"""Length of the clean motion that is simulated for each run [s]: some periods of every kind."""
FINEST_STEP: Final = 2e-4
"""Longest Runge-Kutta step: the one with which `irj simulate` makes its records [s]."""
SOFTEST_TURN: Final = 2e-3
"""Least smoothing velocity of the simulation [rad/s or m/s]: a sharper turn takes smaller steps
and changes no row away from it."""
LOADS: Final = MappingProxyType(
    {
        1.0: "as recorded",
        0.5: "half the payload",
        0.0: "no gravity torque (payload off or balanced, or the axis vertical)",
    }
)
"""Loads that are tried: share of gravity torque and of link inertia.  Without gravity the inertia
is left at its half, since the link itself stays."""
ROUNDING: Final = 0.3
"""Width of the window that rounds the corners of every motion [s]: several kernels, and slow enough
for a drive."""
SLOW: Final = 0.2
"""Speed of the slow motions as a share of the fastest: Stribeck velocities lie below it."""


@final
@dataclass(frozen=True)
class Workspace:
    """Where the link may move.

    Attributes
    ----------
    centre, half : float
        Middle and half of the range of positions [rad or m].
    limits : Limits
        Of position (from the centre), speed and torque.
    source : str
        Where they come from, for a reader.
    """

    centre: float
    half: float
    limits: Limits
    source: str

    def broken(self, run: Followed) -> tuple[str, ...]:
        """Names of the limits that a run breaks."""
        states = run.states - self.centre * np.array([1.0, 0.0, 1.0, 0.0])
        return self.limits.broken(replace(run, states=states))


@final
@dataclass(frozen=True)
class Run:
    """A run that could be recorded.

    Attributes
    ----------
    family : str
        Kind of motion: a key of `FAMILIES`.
    centre, half, speed : float
        Middle and half of the travel, fastest speed [rad, rad/s or m, m/s].
    load : float
        A key of `LOADS`.
    """

    family: str
    centre: float
    half: float
    speed: float
    load: float = 1.0

    @property
    def payload(self) -> str:
        """The load in words."""
        return LOADS[self.load]

    def motion(self, seconds: float, dt: float) -> Motion:
        """The reference to follow, at rest at its first sample."""
        time = np.arange(max(2, round(seconds / dt)), dtype=np.float64) * dt
        shape = FAMILIES[self.family](time, self.half, self.speed)
        path = _rounded(_begun(time) * shape, round(ROUNDING / dt))
        velocity = np.gradient(path, dt)
        top, fast = float(np.abs(path).max()), float(np.abs(velocity).max())
        share = min(1.0, self.half / max(top, 1e-300), self.speed / max(fast, 1e-300))
        path, velocity = share * path, share * velocity
        return Motion(
            time,
            self.centre + path,
            velocity,
            np.gradient(velocity, dt),
            self.family,
            MappingProxyType(
                {"centre": self.centre, "half_travel": share * top, "speed": share * fast}
            ),
        )


def _begun(time: FloatArray) -> FloatArray:
    """From 0 to 1 over the first second: every motion begins at rest at its middle."""
    s = np.clip(time, 0.0, 1.0)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s**2))


def _rounded(path: FloatArray, width: int) -> FloatArray:
    """Corners rounded."""
    window = np.hanning(2 * (width // 2) + 3)[1:-1]
    half = len(window) // 2
    padded = np.concatenate([np.full(half, path[0]), path, np.full(half, path[-1])])
    return np.asarray(np.convolve(padded, window / window.sum(), "valid"))


def _multisine(time: FloatArray, half: float, speed: float) -> FloatArray:
    """Eight sines from one period of the run to 2 Hz, amplitude falling with frequency."""
    count, dt = len(time), float(time[1] - time[0])
    frequency = np.geomspace(1.3 / max(count * dt, 1.0), 2.0, 8)
    phase = 2.399963 * np.arange(8) ** 2  # the golden angle: no two phases alike
    # twice as long, to begin where it crosses the middle of its range
    longer = np.arange(2 * count) * dt
    path = np.sin(2 * np.pi * frequency[:, None] * longer + phase[:, None]).T @ (1 / frequency)
    path = path - (float(path.max()) + float(path.min())) / 2
    crossings = np.flatnonzero(np.diff(np.sign(path[: count + 1])))
    begin = int(crossings[0]) if len(crossings) else 0
    path = path[begin : begin + count]
    rate = float(np.abs(np.diff(path)).max()) / dt
    return np.asarray(path * min(half / float(np.abs(path).max()), speed / rate))


def _sweep(time: FloatArray, half: float, speed: float) -> FloatArray:
    """One sine from 0.1 to 3 Hz, as wide as the speed allows."""
    low, high = 0.1, 3.0
    span = float(time[-1])
    frequency = low * (high / low) ** (time / span)
    phase = 2 * np.pi * span * (frequency - low) / math.log(high / low)
    return np.asarray(np.minimum(half, speed / (2 * np.pi * frequency)) * np.sin(phase))


def _pick(time: FloatArray, half: float, speed: float) -> FloatArray:
    """Point to point between places of the whole travel, with short stops."""
    return _moves(time, half * np.array([-1.0, 0.7, -0.4, 1.0, 0.1, -0.8, 0.5]), speed, 0.3)


def _steps(time: FloatArray, half: float, speed: float) -> FloatArray:
    """Small slow moves to and fro that wander over the travel."""
    wave = np.concatenate([np.arange(0, 7), np.arange(5, -7, -1), np.arange(-5, 0)]) / 7
    middles = np.repeat(wave, 2)
    to_and_fro = np.where(np.arange(len(middles)) % 2 == 0, 0.06, -0.06)
    return _moves(time, half * (middles + to_and_fro), SLOW * speed, 0.2)


def _moves(time: FloatArray, places: FloatArray, speed: float, stop: float) -> FloatArray:
    """Fifth-order moves between places, one after the other and from the first again."""
    path = np.empty_like(time)
    at, begun, k = 0.0, 0.0, 0
    while begun <= time[-1]:
        goal = float(places[k % len(places)])
        length = max(1.875 * abs(goal - at) / speed, 0.1)  # 15/8: peak over mean speed
        here = (time >= begun) & (time <= begun + length + stop)
        s = np.clip((time[here] - begun) / length, 0.0, 1.0)
        path[here] = at + (goal - at) * s**3 * (10 - 15 * s + 6 * s**2)
        at, begun, k = goal, begun + length + stop, k + 1
    return path


def _speeds(time: FloatArray, half: float, speed: float) -> FloatArray:
    """Constant speeds, one quarter of the time each, to and fro over the travel."""
    levels = np.array([1.0, 0.5, 0.2, 0.05])
    number = np.minimum((4 * time / max(float(time[-1]), 1e-9)).astype(np.int64), 3)
    way = np.cumsum(speed * levels[number]) * float(time[1] - time[0])
    return np.asarray(half * (np.abs((way / half + 3) % 4 - 2) - 1))


def _crawl(time: FloatArray, half: float, speed: float) -> FloatArray:
    """Slow triangles."""
    way = SLOW * speed * time
    narrow = half / 4
    return np.asarray(narrow * (np.abs((way / narrow + 3) % 4 - 2) - 1))


FAMILIES: Final[Mapping[str, Callable[[FloatArray, float, float], FloatArray]]] = MappingProxyType(
    {
        "multisine": _multisine,
        "sweep": _sweep,
        "pick and place": _pick,
        "small steps": _steps,
        "constant speeds": _speeds,
        "slow triangles": _crawl,
    }
)
"""Kinds of motion: ``(time, half travel, speed)`` to a path about zero."""


def workspace_of(data: Dataset, limits: Limits | None = None) -> Workspace:
    """Where the link may move: the limits given, and for the rest what the records did.

    Parameters
    ----------
    data : Dataset
        Records that the joint has made: what they reached, it can do again.
    limits : Limits, optional
        Position is counted from the zero of the joint.
    """
    records = (*data.train, *data.held_out)
    position = np.concatenate([w.smooth["link_position"] for w in records])
    speed = np.concatenate([w.smooth["motor_velocity"] for w in records])
    given = limits or Limits()
    low, high = float(position.min()), float(position.max())
    taken = [
        name for name in ("position", "speed", "torque") if not math.isfinite(getattr(given, name))
    ]
    if math.isfinite(given.position):
        low, high = -given.position, given.position
    torque = given.torque
    if data.sensing.has_drive and not math.isfinite(torque):
        # feed-forward of a new motion peaks elsewhere: some room over what the records reached
        torque = 1.2 * max(float(np.abs(w.averaged["drive"]).max()) for w in records)
    fast = given.speed if math.isfinite(given.speed) else float(np.quantile(np.abs(speed), 0.999))
    half = (high - low) / 2
    return Workspace(
        (high + low) / 2,
        half,
        # the simulated joint overshoots its reference a little, as the real one does
        Limits(1.05 * half, 1.15 * fast, torque),
        f"{', '.join(taken)} as in the records" if taken else "as given",
    )


def candidate_runs(space: Workspace, loads: Sequence[float]) -> list[Run]:
    """Every kind of motion over the whole travel and over either half, with every load."""
    fast = space.limits.speed / 1.15
    places = [
        (0.0, 1.0, 1.0, tuple(FAMILIES)),
        (0.5, 0.45, 1.0, ("multisine", "slow triangles")),
        (-0.5, 0.45, 1.0, ("multisine", "slow triangles")),
        (0.0, 1.0, SLOW, ("multisine",)),
    ]
    return [
        Run(
            family,
            space.centre + offset * space.half,
            0.95 * width * space.half,
            0.95 * share * fast,
            load,
        )
        for load in loads
        for offset, width, share, families in places
        for family in families
    ]


def possible_loads(model: JointModel, data: Dataset) -> tuple[float, ...]:
    """Loads that records beside the old ones may have: another payload needs a balance without
    the link."""
    free = set(data.sensing.balances) - LINK_BALANCES
    return tuple(LOADS) if free and model.weights else (1.0,)


@final
class Plant:
    """A fitted model as a joint that follows references without noise; built once.

    Parameters
    ----------
    model : JointModel
        With its values.
    dt : float
        Sample time [s].
    """

    def __init__(self, model: JointModel, dt: float) -> None:
        soft = {n: max(float(model.values.get(n, 0.0)), SOFTEST_TURN) for n in _smoothing(model)}
        # the hold of a logger and the zero of an encoder are no part of the joint
        plain = replace(model, lagging_load=False, calibration=())
        self.model = replace(
            plain, values={k: v for k, v in model.values.items() if k in plain.parameter_names}
        ).with_values(soft)
        self.dt = dt
        steps = max(2, math.ceil(dt / FINEST_STEP))
        self._follower = Follower(self.model, dt, substeps=steps) if self.model.is_elastic else None

    def run(self, run: Run, seconds: float = SIMULATED) -> Followed | None:
        """What the joint does along a run; None where the simulation diverges."""
        return self.follow(run.motion(seconds, self.dt), run.load)

    def follow(self, motion: Motion, load: float = 1.0) -> Followed | None:
        """What the joint does along a motion; None where the simulation diverges.

        Parameters
        ----------
        motion : Motion
        load : float
            Share of the gravity torque (see `LOADS`).
        """
        count = len(motion.time)
        values = dict(zip(self.model.parameter_names, self.model.value_vector(), strict=True))
        less = {n: load * values[n] for n in self.model.weights}
        if LINK_INERTIA in values:
            less[LINK_INERTIA] = max(load, 0.5) * values[LINK_INERTIA]
        if load == 1:
            less = {}
        if self._follower is not None:
            found = self._follower.run(
                motion.table, {n: np.full(count, v) for n, v in less.items()}
            )
        else:
            found = self._driven(motion, {**values, **less})
        finite = np.isfinite(found.states).all() and np.isfinite(found.drive).all()
        return found if finite else None

    def _driven(self, motion: Motion, values: Mapping[str, float]) -> Followed:
        """A rigid joint exactly on its reference: the drive that this takes."""
        functions = self.model.functions
        count = len(motion.time)
        size = len(functions.state_names) + len(functions.memory_names)
        x = np.zeros((size, count))
        x[0], x[1] = motion.position, motion.velocity
        p = [values[n] for n in self.model.parameter_names]
        still = np.zeros((3, count))
        unit = still.copy()
        unit[0] = 1.0
        moved = functions.dynamics.map(count)
        free = np.asarray(moved(x, still, p))[1]
        gain = np.asarray(moved(x, unit, p))[1] - free
        drive = (motion.acceleration - free) / gain
        inputs = still.copy()
        inputs[0] = drive
        reading = np.asarray(functions.outputs.map(count)(x, inputs, p))
        return Followed(
            motion.time,
            drive,
            np.column_stack([motion.position, motion.velocity] * 2),
            np.column_stack([motion.acceleration] * 2),
            reading[4],
        )


def _smoothing(model: JointModel) -> tuple[str, ...]:
    return model.named("smoothing")


def predicted(followed: Followed, run: Run, data: Dataset) -> WeakRecord:
    """The rows that a recording of this run would give, with the noise of the old records: of the
    usual length where noise made theirs longer, as quicker motion has them.
    """
    sensing, old = data.sensing, data.train[0]
    record = recorded(followed, data.joint, data.noise, like=sensing)
    length = min(data.kernel, usual_kernel(sensing, data.joint))
    made = weak_record(record, data.joint, sensing, length, curved=bool(old.curved))
    masked = frozenset(sensing.balances) & LINK_BALANCES if run.load != 1 else frozenset()
    return replace(made, name=run_name(record), masked=masked)


def sigma_on(
    rows: WeakRecord, solution: Solution, data: Dataset, values: Mapping[str, float]
) -> dict[str, float]:
    """What a model is expected to leave of each balance on a planned run: what it leaves of the
    old records over their noise, and the noise of the run's own rows.

    Parameters
    ----------
    rows : WeakRecord
    solution : Solution
        Of the fit to the old records.
    data : Dataset
        The old records.
    values : mapping of str to float
        Of the run.
    """
    new = replace(data, train=(rows,), held_out=())
    old, then = floors(solution.model, data, solution.values), floors(solution.model, new, values)
    return {
        b: math.sqrt(max(s**2 - old[b] ** 2, 0.0) + max(then[b], 1e-12) ** 2)
        for b, s in solution.sigma.items()
    }


def recorded(
    followed: Followed,
    joint: Joint,
    noise: Mapping[str, float],
    *,
    like: Sensing | None = None,
    elastic: bool = True,
) -> Record:
    """What a logger would have kept of a simulated run.

    Parameters
    ----------
    followed : Followed
    joint : Joint
    noise : mapping of str to float
        Standard deviation of each measured signal, link-referred.
    like : Sensing, optional
        Channels; by default all sensors of an elastic joint, the motor's alone of a rigid one.
    elastic : bool
        Where `like` is not given.
    """
    rng = np.random.default_rng(0)
    count = len(followed.time)

    def read(values: FloatArray, signal: str) -> FloatArray:
        return values + noise.get(signal, 0.0) * rng.standard_normal(count)

    both = like.both_positions if like is not None else elastic
    moving = like.moving if like is not None else "motor_position"
    channels = {}
    if both or moving == "motor_position":
        channels["motor_position"] = (
            read(followed.states[:, 0], "motor_position") * joint.gear_ratio
        )
    if both or moving == "link_position":
        channels["link_position"] = read(followed.states[:, 2], "link_position")
    if like is None or like.has_drive:
        channels["motor_torque"] = read(followed.drive, "drive") / joint.gear_ratio
    if like.has_torque if like is not None else elastic:
        channels["link_torque"] = read(followed.torque, "torque")
    if like is not None and like.has_temperature:
        channels["temperature"] = np.full(count, like.temperature_origin)
    if like is not None and like.has_coupling:
        channels["coupling_torque"] = np.zeros(count)
    return Record.from_channels(followed.time, channels, name="planned run", kind=joint.kind)


def refuse_clamped(sensing: Sensing, name: str) -> None:
    """Refuse records of a torque-against-torsion test, and positions without any torque; `name`
    is that of the first record.

    Raises
    ------
    InputError
        The link is clamped, or no torque has a size: no motion can be planned.
    """
    if sensing.kinematic:
        raise InputError(
            f"{name}: two positions without any torque do not say what drives the "
            "joint, and no motion can be planned; record motor_current or motor_torque too"
        )
    if sensing.clamped_link:
        raise InputError(
            f"{name}: a torque-against-torsion test has no motion to plan; give "
            "records of the moving joint"
        )
