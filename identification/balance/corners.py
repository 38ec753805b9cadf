"""Velocities with the corners that their kernel takes off.

A velocity inside a law of friction comes from a kernel over a position. Where dry friction changes
its sign, or a drive its torque, the acceleration jumps and the velocity has a corner; the kernel
rounds it off, always to the same side, and the laws of slow motion fit the rounding. The torques
know the corner: what drives a side, less what it passes on and less its friction, is its
acceleration at once. So a velocity has the encoder for all that is slower than its kernel and the
integral of the torques for all that is faster (a complementary filter: Brown, Hwang, Introduction
to Random Signals and Applied Kalman Filtering, 1997). What is slow in the torques, an offset, a
gain, gravity, drops out of it, so the friction needs no law: a free curve over the velocity, with a
step where it changes its sign, beside the torques and the acceleration of the same rows.

The step is set-valued: at a standstill dry friction is any torque between the two, and the joint
sticks as long as it can hold. The velocity follows from the friction through an odd filter, the
friction from the velocity through a monotone law, which has one solution and no simple iteration
that gets there; the extragradient method does (Korpelevich, Matekon 13, 1977).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final, TypeAlias, final

import numpy as np
import numpy.typing as npt

from identification.balance.beside import SURE, independent, slope_beside, weights_beside
from identification.balance.colour import ChannelNoise
from identification.balance.memory import cache_of
from identification.balance.sensing import Sensing
from identification.balance.weak import PAIR, REST_SHARE, WeakRecord, kernel, whole

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_Way: TypeAlias = tuple[tuple[str, ...], tuple[str, ...]]
"""Signals whose sum follows from a motion, and what else that follows from."""
TWIST: Final = "twist"
"""Column of the difference of both positions."""
GRAVITY: Final = "gravity"
"""Columns of a weight that hangs on the side, at any zero."""
STILL: Final = 3.0
"""Pointwise speed of a side at rest, in standard deviations of its noise: 0.3 % of samples at
rest lie above.
"""
ALIKE: Final = 0.1
"""Weight of a row that holds two neighbours in a curve of friction alike: a hundredth of what one
row in its whole would tell, so that it decides only where a motion has none of that speed."""
STRAIGHT: Final = 1.0
"""Weight of a row that holds three of them on a straight line: as much as one row in its whole
tells. Without it the noise of slow rows gave the lowest two nodes opposite signs on some joints;
with three times as much the smooth turn of others became a step."""
SLOWEST: Final = 2
"""Kernels of the rows, in time, that a record must spend below the slowest node: friction below it
is the same."""
TURNS: Final = 8
"""Turns from which records tell the friction of slow motion: each shows it once, and the mean of
eight has a third of the scatter of one. With fewer the guess may hide the law that is missing."""
ROUNDS: Final = 3
"""Rounds: inertia and friction come from the velocities that they correct. After the second little
changes."""
REWEIGHTED: Final = 5
"""Rounds of reweighting in each of them."""
STEPS: Final = 40
"""Steps of the extragradient method: what is left of a standstill moves at a hundredth of the speed
that the kernel gave it."""
SHORTER: Final = 0.9
"""Size of such a step, in units of the largest that converges."""
LOUDER: Final = 0.5
"""Noise of the torques in a velocity, in units of the encoder's own in it, up to which it has their
corners: both together are an eighth more than the encoder's alone.
"""
MOST: Final = 4000
"""Rows that are asked of a longer record, in even steps: they tell an inertia to a thousandth."""
KEPT: Final = 4_000_000
"""Velocities that a thread keeps (32 MB), beside the records that they come from."""
COLLINEAR: Final = 1e-6
"""Share of the largest below which a direction of the columns is none: a sine over a small angle is
a straight line to a millionth."""
FEWEST: Final = 4
"""Moving rows, in units of the columns, from which a record is asked: 0.4 of them are independent
of each other."""


@final
@dataclass(frozen=True)
class Corner:
    """What records say of the corners in the velocity of one side.

    Attributes
    ----------
    reading : tuple of str
        Signals whose sum follows from the motion: what drives the side, or what it passes on.
    against : tuple of str
        What else that follows from but inertia and friction.
    inertia : float
        Reading for an acceleration.
    beside : tuple of float
        Reading for each column of `against`.
    nodes : tuple of float
        Speeds [rad/s].
    friction : pair of tuple of float
        At the nodes, forward and backward, in units of the inertia [rad/s^2]; the first node is at
        zero speed, where anything between the two holds the side.
    """

    reading: tuple[str, ...]
    against: tuple[str, ...]
    inertia: float
    beside: tuple[float, ...]
    nodes: tuple[float, ...]
    friction: tuple[tuple[float, ...], tuple[float, ...]]


def rests_at(record: WeakRecord, side: str, noise: ChannelNoise) -> list[slice]:
    """Points at which a side stands still: its pointwise speed stays within its noise for at least
    one kernel of that speed.
    """
    grid, source = record.grid, f"{side}_position"
    slow = np.abs(record.points[f"{side}_velocity"]) <= STILL * grid.velocity_noise(source, noise)
    shortest = max(1, whole(grid.pointwise[source] / (grid.step * grid.dt)))
    out = []
    for first, last in zip(record.starts[:-1], record.starts[1:], strict=True):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], slow[first:last], [False]])))
        out += [
            slice(int(first + begin), int(first + end))
            for begin, end in edges.reshape(-1, 2)
            if end - begin >= shortest
        ]
    return out


def corners_of(
    records: Sequence[WeakRecord],
    noise: Mapping[str, ChannelNoise],
    sensing: Sensing,
) -> dict[str, Corner]:
    """What these records say together of the corners, by the side; without those sides of which
    they say nothing. The motor alone tells none: behind it the link swings, and what moves is no
    single inertia.

    Parameters
    ----------
    records : sequence of WeakRecord
        With their rests, of one joint with one payload.
    noise : mapping of str to ChannelNoise
        Of each measured signal.
    sensing : Sensing
        What is measured.
    """
    ways: dict[str, _Way] = {}
    if sensing.clamped_link:
        return {}
    coupling = ("coupling_torque",) if sensing.has_coupling else ()
    passed = ("torque", *coupling)
    if sensing.motor_and_torque or (sensing.both_positions and sensing.has_drive):
        ways["motor"] = (("drive",), ("torque" if sensing.has_torque else TWIST,))
    if sensing.has_torque and not sensing.motor_and_torque:
        # of one position both sides have one velocity
        sides = ("link",) if sensing.both_positions else ("motor", "link")
        ways |= dict.fromkeys(sides, (passed, (GRAVITY,)))
    elif sensing.both_positions and sensing.has_drive:
        # a transmission gives way by a share of what it passes on
        ways["link"] = ((TWIST,), (GRAVITY, *coupling))
    found = {side: _corner(records, side, way, noise) for side, way in ways.items()}
    return {side: corner for side, corner in found.items() if corner is not None}


def with_corners(
    record: WeakRecord, corners: Mapping[str, Corner], noise: Mapping[str, ChannelNoise]
) -> WeakRecord:
    """The record with the corners of its velocities, where its torques tell them better than its
    encoders; the same one for the same corners.

    Parameters
    ----------
    record : WeakRecord
        With its rests.
    corners : mapping of str to Corner
        By side.
    noise : mapping of str to ChannelNoise
        Of each measured signal.
    """

    def make() -> tuple[WeakRecord, int]:
        found = {}
        for side, corner in corners.items():
            if side == "link" and record.masked:  # another payload has another inertia
                continue
            run = _run(record, side, (corner.reading, corner.against), noise)
            if run.told(corner):
                motion = run.begun
                for _ in range(ROUNDS):
                    motion = run.sticking(corner, motion)
                found[f"{side}_velocity"] = motion[0]
        points, smooth = {**record.points, **found}, {**record.smooth, **found}
        return replace(record, points=points, smooth=smooth), sum(len(v) for v in found.values())

    if not corners:
        return record
    law = tuple(sorted(corners.items())), tuple(sorted(noise.items(), key=_first))
    cornered: WeakRecord = cache_of("corners").get(record, law, make, KEPT)
    return cornered


def _first(item: tuple[str, ChannelNoise]) -> str:
    return item[0]


@lru_cache(256)
def corner_weights(length: float, dt: float, step: int = 1) -> FloatArray:
    """What a kernel takes off the velocity that an acceleration makes, as weights for correlation
    with the acceleration [s].

    Parameters
    ----------
    length, dt : float
        Of the kernel that the velocity comes from [s].
    step : int
        Samples between two values of the acceleration, which is a straight line between them.

    Returns
    -------
    (k,) array, k odd, not to be written to
        Odd about the middle: nothing is taken off a constant acceleration.
    """
    weights = kernel(length, dt, 1)
    speed, travel = np.zeros((2, len(weights), len(weights)))
    unit = np.eye(len(weights))
    speed[1:] = np.cumsum((unit[1:] + unit[:-1]) / 2 * dt, axis=0)
    travel[1:] = np.cumsum((speed[1:] + speed[:-1]) / 2 * dt, axis=0)
    half = len(weights) // 2
    taken = speed[half] - weights @ travel
    reach = half // step + 1
    apart = np.arange(-half, half + 1)[:, None] / step - np.arange(-reach, reach + 1)
    out = np.asarray(taken @ np.maximum(1.0 - np.abs(apart), 0.0), dtype=np.float64)
    out.setflags(write=False)
    return out


def _corner(
    records: Sequence[WeakRecord],
    side: str,
    way: _Way,
    noise: Mapping[str, ChannelNoise],
) -> Corner | None:
    """None where the records do not tell an inertia and the friction of that side."""
    runs = [_run(w, side, way, noise) for w in records]
    speeds = np.concatenate([np.abs(r.smooth[~r.still & (r.smooth != 0.0)]) for r in runs])
    grid = runs[0].record.grid
    few = whole(SLOWEST * grid.length / (grid.step * grid.dt))
    if len(speeds) <= few or sum(_turns(r) for r in runs) < TURNS:
        return None
    slowest = float(np.partition(speeds, few)[few])
    nodes = _nodes(speeds, max(slowest, *(STILL * r.loud for r in runs)))
    kept = [np.flatnonzero(r.record.rest[side] <= REST_SHARE) for r in runs]
    count, moving = runs[0].beside.shape[1], sum(len(k) for k in kept)
    if moving < FEWEST * (2 * len(nodes) + count):
        return None
    kept = [k[:: -(-moving // MOST)] for k in kept]
    averaging = [r.record.averaging[k] for r, k in zip(runs, kept, strict=True)]

    def chosen(values: Sequence[FloatArray]) -> FloatArray:
        return np.concatenate([x[k] for x, k in zip(values, kept, strict=True)])

    reading, beside = chosen([r.rows for r in runs]), chosen([r.beside for r in runs])
    acceleration = chosen([r.record.averaged[f"{side}_acceleration"] for r in runs])
    alike = _alike(count, len(nodes))
    motions = [r.begun for r in runs]
    corner = None
    for _ in range(ROUNDS):
        curves = [
            (own @ _either_way(*motion, nodes)).toarray()
            for own, motion in zip(averaging, motions, strict=True)
        ]
        columns = np.column_stack([beside, np.vstack(curves)])
        # about a turn rows are far off as long as the corners are missing
        root = np.sqrt(weights_beside(reading, [columns, acceleration], REWEIGHTED))
        columns, moved = columns * root[:, None], acceleration * root
        inertia, error = slope_beside(reading * root, [independent(columns, COLLINEAR)], moved)
        if not inertia > SURE * error:
            return None
        left = np.concatenate([reading * root - inertia * moved, np.zeros(len(alike))])
        columns = np.vstack([columns, alike])
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        values = np.linalg.lstsq(columns / size, left, rcond=COLLINEAR)[0] / size
        friction = values[count:].reshape(2, -1) / inertia
        forward, backward = (tuple(own.tolist()) for own in _turning(friction))
        beside_it, speeds_at = tuple(values[:count].tolist()), (0.0, *nodes.tolist())
        corner = Corner(*way, inertia, beside_it, speeds_at, (forward, backward))
        motions = [
            r.sticking(corner, motion) if r.told(corner) else motion
            for r, motion in zip(runs, motions, strict=True)
        ]
    return corner


@final
@dataclass(frozen=True)
class _Run:
    """What a record knows of the motion of one side.

    Attributes
    ----------
    rows, points : (rows,), (points,) array
        The reading that follows from it: what drives it, or what it passes on.
    beside, at_points : (rows, k), (points, k) array
        What else that reading follows from but inertia and friction.
    smooth : (points,) array
        Velocity by its kernel.
    still : (points,) bool array
    weights : (k,) array
        Of :func:`corner_weights`.
    loud : float
        Noise of that velocity.
    louder : tuple of (int, float)
        Column of `beside` (-1: the reading itself) and the noise that a torque of 1 gives the
        velocity for an inertia of 1.
    """

    record: WeakRecord
    rows: FloatArray
    points: FloatArray
    beside: FloatArray
    at_points: FloatArray
    smooth: FloatArray
    still: npt.NDArray[np.bool_]
    weights: FloatArray
    loud: float
    louder: tuple[tuple[int, float], ...]

    @property
    def begun(self) -> tuple[FloatArray, FloatArray]:
        """Motion before any corner, as :meth:`sticking` gives it."""
        return self.smooth, np.asarray(self.smooth > 0, dtype=np.float64)

    def told(self, corner: Corner) -> bool:
        """Whether the torques are quiet enough to tell corners."""
        parts = (own * (1.0 if i < 0 else corner.beside[i]) for i, own in self.louder)
        return math.hypot(*parts) <= LOUDER * self.loud * corner.inertia

    def sticking(
        self, corner: Corner, motion: tuple[FloatArray, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Velocity (points,) with its corners, and the part of the step that friction has, 1 where
        the side moves forward, 0 backward, in between where it sticks; from both as they were
        before.
        """
        velocity, forward = motion
        still, weights, starts = self.still, self.weights, self.record.starts
        nodes, friction = np.array(corner.nodes), np.array(corner.friction)
        low, high = corner.friction[1][0], corner.friction[0][0]
        net = (self.points - self.at_points @ np.array(corner.beside)) / corner.inertia
        beyond = [np.interp(np.abs(velocity), nodes, own) - own[0] for own in friction]
        free = np.where(still, 0.0, net - np.where(velocity > 0, *beyond))
        moving = self.smooth + _taken_off(starts, free, weights)
        step = np.where(still, 0.0, low + (high - low) * forward)
        if not high > low:
            found = moving - _taken_off(starts, step, weights)
            return found, np.asarray(found > 0, dtype=np.float64)
        # no friction between the two reverses a side that is faster
        reach = (high - low) * float(np.abs(np.cumsum(weights)).max())
        near = ~still & (np.abs(moving - _taken_off(starts, step, weights)) <= reach)
        taken = np.flatnonzero(np.convolve(near, np.ones(len(weights)), "same") > 0.5)
        own, asked, push = step[taken], near[taken], moving[taken]
        pace = SHORTER / _largest(weights)
        parts = np.flatnonzero(np.diff(taken, prepend=-2) > 1)
        parts = np.unique([*parts, *np.searchsorted(taken, starts), len(taken)])
        for _ in range(STEPS):
            tried = push - _taken_off(parts, own, weights)
            tried = np.where(asked, np.clip(own + pace * tried, low, high), own)
            after = push - _taken_off(parts, tried, weights)
            own = np.where(asked, np.clip(own + pace * after, low, high), own)
        step[taken] = own
        found = moving - _taken_off(starts, step, weights)
        return found, np.where(still, 0.5, (step - low) / (high - low))


def _run(
    record: WeakRecord,
    side: str,
    way: _Way,
    noise: Mapping[str, ChannelNoise],
) -> _Run:
    source, grid = f"{side}_position", record.grid
    readings, beside = (
        [column for name in names for column in _columns(record, side, name)] for names in way
    )
    smooth = record.points[f"{side}_velocity"]
    still = np.zeros(len(smooth), dtype=np.bool_)
    for rows in rests_at(record, side, noise[source]):
        still[rows] = True
    length, dt, step = grid.pointwise[source], grid.dt, grid.step
    weights = corner_weights(length, dt, step)
    positions = np.convolve(kernel(length, dt, 0), corner_weights(length, dt))
    louder = tuple(
        (i, noise[s].after(*((positions, dt) if s in PAIR else (weights, dt * step))))
        for i, column in [*enumerate(beside), *((-1, column) for column in readings)]
        for s in column.signals
    )
    return _Run(
        record,
        rows=np.sum([column.rows for column in readings], axis=0),
        points=np.sum([column.points for column in readings], axis=0),
        beside=np.column_stack([column.rows for column in beside]),
        at_points=np.column_stack([column.points for column in beside]),
        smooth=smooth,
        still=still,
        weights=weights,
        loud=grid.velocity_noise(source, noise[source]),
        louder=louder,
    )


@final
@dataclass(frozen=True)
class _Column:
    """A signal at the rows and at the points, and the measured signals whose noise it has."""

    rows: FloatArray
    points: FloatArray
    signals: tuple[str, ...] = ()


def _columns(record: WeakRecord, side: str, name: str) -> list[_Column]:
    a, p, smooth = record.averaged, record.points, record.smooth
    if name == GRAVITY:
        q = f"{side}_position"
        return [_Column(f(a[q]), f(p[q])) for f in (np.sin, np.cos)]
    if name == TWIST:
        motor, link = PAIR
        return [_Column(a[motor] - a[link], smooth[motor] - smooth[link], PAIR)]
    return [_Column(a[name], p[name], (name,))]


def _nodes(speeds: FloatArray, least: float) -> FloatArray:
    """Nodes (nodes,) of the friction over the speed, at powers of two: a noise that is read a
    little higher moves none of them.
    """
    first, last = (math.ceil(math.log2(speed)) for speed in (least, float(np.max(speeds))))
    return np.asarray(2.0 ** np.arange(first, max(last, first + 1)), dtype=np.float64)


def _turning(friction: FloatArray) -> FloatArray:
    """Friction (2, nodes + 1) of either direction from zero speed on: where it rises from the first
    node to the second, at twice its speed, the turn is as wide as that, and the step at zero is
    what a straight line leaves of it; else all of it.
    """
    middle, half = friction.mean(axis=0)[0], (friction[0] - friction[1]) / 2
    line = 2 * half[0] - half[1] if friction.shape[1] > 1 else half[0]
    step = max(0.0, min(half[0], line))
    return np.column_stack([[middle + step, middle - step], friction])


def _turns(run: _Run) -> int:
    """How often a side changes its direction, noise and rests apart, in the stretches of a run."""
    count = 0
    for first, last in zip(run.record.starts[:-1], run.record.starts[1:], strict=True):
        velocity = run.smooth[first:last]
        way = np.sign(velocity[np.abs(velocity) > STILL * run.loud])
        count += int(np.count_nonzero(np.diff(way)))
    return count


def _alike(count: int, nodes: int) -> FloatArray:
    """Rows that hold neighbours in a curve alike, and what is between three of them straight."""
    steps = np.diff(np.eye(nodes), axis=0)
    bends = np.diff(np.eye(nodes), n=2, axis=0) if nodes > 2 else np.zeros((0, nodes))
    one = np.vstack([ALIKE * steps, STRAIGHT * bends])
    none, apart = np.zeros((len(one), count)), np.zeros_like(one)
    return np.asarray(np.block([[none, one, apart], [none, apart, one]]), dtype=np.float64)


def _either_way(velocity: FloatArray, forward: FloatArray, nodes: FloatArray) -> Any:
    """Sparse columns (points, 2 nodes) of a free curve over the speed of each direction."""
    from scipy.sparse import csr_array

    speed, count = np.clip(np.abs(velocity), nodes[0], nodes[-1]), len(nodes)
    below = np.clip(np.searchsorted(nodes, speed, side="right") - 1, 0, max(count - 2, 0))
    above = np.minimum(below + 1, count - 1)
    apart = np.maximum(nodes[above] - nodes[below], 1e-300)
    upper = (speed - nodes[below]) / apart
    lower, back = 1.0 - upper, 1.0 - forward
    values = np.column_stack([lower * forward, upper * forward, lower * back, upper * back])
    where = np.column_stack([below, above, count + below, count + above])
    pointers = 4 * np.arange(len(speed) + 1)
    return csr_array((values.ravel(), where.ravel(), pointers), shape=(len(speed), 2 * count))


def _largest(weights: FloatArray) -> float:
    """Largest gain of a filter with these weights, at any frequency."""
    return float(np.abs(np.fft.rfft(weights, 16 * len(weights))).max())


def _taken_off(parts: IntArray, acceleration: FloatArray, weights: FloatArray) -> FloatArray:
    """What the kernel of a velocity has taken off it, (points,), by stretches that begin and end
    at `parts`: nothing at their ends, where the kernel has no middle.
    """
    out, half = np.zeros(len(acceleration)), len(weights) // 2
    for first, last in zip(parts[:-1], parts[1:], strict=True):
        if last - first >= len(weights):
            inner = slice(first + half, last - half)
            out[inner] = np.correlate(acceleration[first:last], weights, "valid")
    return out


__all__ = ["STILL", "Corner", "corner_weights", "corners_of", "rests_at", "with_corners"]
