"""Velocities with the corners that their kernel takes off.

A velocity inside a law of friction comes from a kernel over a position. Where dry friction changes
its sign, or a drive its torque, the acceleration jumps and the velocity has a corner; the kernel
rounds it off, always to the same side, and the laws of slow motion fit the rounding. A model knows
the corner: what drives a side, less what it passes on and less its dry friction, over its inertia
is its acceleration at once. So a velocity has the encoder for all that is slower than its kernel
and the integral of the torques for all that is faster (a complementary filter: Brown, Hwang,
Introduction to Random Signals and Applied Kalman Filtering, 1997). What is slow in the torques, an
offset, a gain, gravity, drops out of it. Inertia and friction are those of the model whose rows
these are, at its values: the same model has the same corners on the same record, whoever asks.

Dry friction is set-valued: at a standstill it is any torque between the two, and the joint sticks
as long as it can hold; where it stands for a kernel, nothing accelerates it. The velocity follows
from the friction through an odd filter, the friction from the velocity through a monotone law,
which has one solution and no simple iteration that gets there; the extragradient method does
(Korpelevich, Matekon 13, 1977).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from casadi_models import JointModel, Signals
from casadi_models.vectorised import Vectorised
from identification.balance.memory import Law, cache_of
from identification.balance.sensing import Sensing
from identification.balance.weak import PAIR, Grid, WeakRecord, kernel

FloatArray = npt.NDArray[np.float64]
NAMES: Final = Signals.names()
IntArray = npt.NDArray[np.int64]

TWIST: Final = "twist"
"""Difference of both positions, which passes a torque on where none is measured."""
SIDES: Final = ("motor", "link")
"""In the order of their resistances."""
ROUNDS: Final = 3
"""Rounds of what friction is beside its step, a Stribeck curve, at the velocities that it makes."""
STEPS: Final = 40
"""Steps of the extragradient method at most: what is left of a standstill moves at a hundredth of
the speed that the kernel gave it."""
SETTLED: Final = 1e-3
"""Share of its dry friction that a step changes it by, at which it is there."""
SHORTER: Final = 0.9
"""Size of such a step, in units of the largest that converges."""
BENT: Final = 1 / 6
"""Variance of an acceleration over the square of its second difference where it is all noise; of a
jump at an instant that is anywhere between two points it is half of that."""
FEWEST: Final = 5
"""Points that a kernel must span: in a shorter one no point lies beside the corner."""
APART: Final = 2
"""Kernels of the velocity from a change of its sign at which a slow motion has no corner."""
KEPT: Final = 4_000_000
"""Values at points that a thread keeps (32 MB), beside the records that they come from."""


def with_corners(
    record: WeakRecord, friction: Friction, sensing: Sensing, values: Mapping[str, float]
) -> WeakRecord:
    """The record with the corners that a model gives its velocities where dry friction acts on
    them; the same one for the same values of what makes them.

    A law with memory says itself what happens at a turn. Behind a motor alone the link swings, and
    what moves is no single inertia.

    Parameters
    ----------
    record : WeakRecord
    friction : Friction
        Of the model, adapted to the channels.
    sensing : Sensing
        What is measured.
    values : mapping of str to float
        Of every parameter.
    """
    model = friction.model
    sides = (_corner(record, model, sensing, values, side) for side in SIDES)
    corners = tuple(corner for corner in sides if corner is not None)
    if not corners:
        return record

    keys = tuple((c, friction.structure, friction.held_by(c.sides, values)) for c in corners)

    def make() -> tuple[WeakRecord, int]:
        found = {}
        for corner, key in zip(corners, keys, strict=True):

            def cornered(corner: Corner = corner) -> tuple[FloatArray, int]:
                own = _cornered(record, corner, friction, values)
                return own, len(own)

            velocity = cache_of("cornered").get(record, key, cornered, KEPT)
            found[f"{corner.side}_velocity"] = velocity
        made = replace(record, points={**record.points, **found})
        return made, sum(map(len, found.values()))

    made: WeakRecord = cache_of("corners").get(record, keys, make, KEPT)
    return made


@final
class Friction:
    """What holds each side of a joint against its motion.

    Parameters
    ----------
    model : JointModel

    Attributes
    ----------
    model : JointModel
    structure : Law
        Of the model.
    """

    def __init__(self, model: JointModel) -> None:
        e = model.equations
        both = ca.densify(ca.vertcat(e.motor_resistance, e.link_resistance))
        held = zip(*ca.jacobian_sparsity(both, e.parameters).get_triplet(), strict=True)
        self.model, self.structure = model, Law(model.structure)
        self._held = sorted({(SIDES[i], model.parameter_names[k]) for i, k in held})
        self._law = Vectorised(
            ca.Function("resistance", [e.signals.vector(), e.memory, e.parameters], [both])
        )
        self._states = int(e.memory.shape[0])

    def held_by(self, sides: Collection[str], values: Mapping[str, float]) -> tuple[float, ...]:
        """Values on which the torques against the motion of these sides depend."""
        return tuple(float(values[n]) for side, n in self._held if side in sides)

    def along(self, signals: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Torque against the motion of motor and link, (2, points) [N.m], laws with memory at rest.

        Parameters
        ----------
        signals : (signals, points) array
            In the order of :data:`casadi_models.Signals`.
        values : mapping of str to float
        """
        count = signals.shape[1]
        p = [float(values[n]) for n in self.model.parameter_names]
        return self._law(count, signals, np.zeros((self._states, count)), p)


@final
@dataclass(frozen=True)
class Corner:
    """What makes the corners in the velocity of a side.

    Attributes
    ----------
    side : str
    sides : tuple of str
        Those that have its velocity.
    inertia : float
        Of these.
    friction : float
        Their dry friction over the inertia [1/s^2].
    turn : float
        Velocity within which it changes its sign [1/s].
    pushes : tuple of (str, float)
        Torques that move the side, each with what it counts over the inertia.
    """

    side: str
    sides: tuple[str, ...]
    inertia: float
    friction: float
    turn: float
    pushes: tuple[tuple[str, float], ...]


def _corner(
    record: WeakRecord,
    model: JointModel,
    sensing: Sensing,
    values: Mapping[str, float],
    side: str,
) -> Corner | None:
    """None where the model gives the velocity of a side none."""
    velocity, torque = f"{side}_velocity", {"torque": 1.0}
    if sensing.clamped_link or sensing.kinematic or model.lagging_load:
        return None
    if velocity not in record.points or side not in record.still:
        return None
    grid = record.grid
    if grid.pointwise[f"{side}_position"] < (FEWEST - 0.5) * grid.step * grid.dt:
        return None
    if any(t.effect.memory is not None and t.place == side for t in model.terms):
        return None
    if model.is_elastic and not sensing.has_torque:
        if set(PAIR) - set(record.points) or model.stiffness_name is None:
            return None
        torque = {TWIST: values[model.stiffness_name]}
    sides: tuple[str, ...] = (side,)
    friction = sticking_torque(model, values, side)
    if model.is_elastic or sensing.has_torque:
        inertia = values.get(f"{side}_inertia", 0.0)
        passed = {name: -x for name, x in torque.items()}
        moving = {"drive": 1.0, **passed} if side == "motor" else torque
        alone = side == "link"
    else:  # both sides have one velocity
        if velocity != sensing.moving.replace("position", "velocity"):
            return None
        sides, friction = SIDES, sum(sticking_torque(model, values, s) for s in SIDES)
        inertia, moving, alone = sum(values[n] for n in model.inertias), {"drive": 1.0}, True
    if alone and sensing.has_coupling:
        moving["coupling_torque"] = 1.0
    told = set(moving) <= {TWIST, *record.points}
    if not (told and friction > 0 and inertia > 0) or (side == "link" and record.masked):
        return None
    turn = [values[n] for n in model.named("smoothing", side)]
    pushes = tuple((name, x / inertia) for name, x in moving.items())
    width = max(turn, default=0.0)
    return Corner(side, sides, inertia, friction / inertia, width, pushes)


def sticking_torque(model: JointModel, values: Mapping[str, float], place: str) -> float:
    """Torque that dry friction of a side may hold at a standstill, in either direction [N.m]."""
    return float(sum(abs(values[n]) for n in model.named("static", place)))


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


def _cornered(
    record: WeakRecord, corner: Corner, friction: Friction, values: Mapping[str, float]
) -> FloatArray:
    """Velocity (points,) of a side with its corners, where it turns; elsewhere it has none."""
    level, weights = corner.friction, _weights(record.grid, corner.side)
    plain = record.points[f"{corner.side}_velocity"]
    moving = plain + sum(x * _taken_off(record, corner.side, name) for name, x in corner.pushes)
    at = _about_turns(record, corner.side)
    if not len(at):
        return plain
    parts = _Parts(at, record.starts, len(weights) // 2)
    push, awake = parts.spread(moving[at]), parts.spread(1.0 - record.still[corner.side][at])
    # no dry friction reverses a side that is faster
    most = 2 * level * float(np.abs(np.cumsum(weights)).max())
    asked = np.flatnonzero((np.abs(push) <= most) & (awake > 0))
    signals = np.array([values[at] for values in record.table(NAMES)])
    own = [NAMES.index(f"{side}_velocity") for side in corner.sides]
    held = [SIDES.index(side) for side in corner.sides]
    pace = SHORTER / _largest(weights)
    stiffer = 1.0 + pace * corner.turn / level  # within its width the turn is a straight line
    found, step = moving[at], level * np.sign(push) * awake
    for _ in range(ROUNDS):
        signals[own] = found
        beyond = friction.along(signals, values)[held].sum(axis=0) / corner.inertia
        beyond -= level * np.clip(found / max(corner.turn, 1e-300), -1.0, 1.0)
        free = push - np.correlate(awake * parts.spread(beyond), weights, "same")
        for _ in range(STEPS):
            before, tried = step[asked], step.copy()
            for _ in range(2):  # extragradient: the second step from where the first one leads
                to = before + pace * (free - np.correlate(tried, weights, "same"))[asked]
                tried[asked] = np.clip(to / stiffer, -level, level)
            step = tried
            if np.abs(step[asked] - before).max(initial=0.0) <= SETTLED * level:
                break
        found = parts.gather(free - np.correlate(step, weights, "same"))
    net = sum(x * _torque(record, name)[at] for name, x in corner.pushes)
    acceleration = awake * (parts.spread(net - beyond) - step)
    bent = parts.inner * np.diff(acceleration, n=2, prepend=0.0, append=0.0)
    noise = BENT * float(parts.gather(np.correlate(bent**2, weights**2, "same")).sum())
    told = found - plain[at]
    out = plain.copy()
    power = float(told @ told)
    # as much of them as is no noise (Wiener's filter)
    out[at] += max(0.0, 1.0 - noise / power) * told if power > 0 else 0.0
    return out


@final
class _Parts:
    """Stretches of points, one after the other with room between them, so that a filter over all of
    them takes none of one into the next; outside, each goes on as it ends.

    Parameters
    ----------
    at : (points,) int array
        The points, in order.
    starts : (segments + 1,) int array
        First point of each segment of the record.
    half : int
        Points that the filter reaches to each side.

    Attributes
    ----------
    inner : (places,) array
        1 at points with two neighbours, 0 elsewhere.
    """

    def __init__(self, at: IntArray, starts: IntArray, half: int) -> None:
        segment = np.searchsorted(starts, at, side="right")
        new = (np.diff(at, prepend=-2) > 1) | (np.diff(segment, prepend=-1) > 0)
        begins = np.flatnonzero(new)
        self._places = np.arange(len(at)) + half * (2 * np.cumsum(new) - 1)
        ends = np.append(begins[1:], len(at)) - 1
        low, high = self._places[begins], self._places[ends]
        every = np.arange(int(high[-1]) + half + 1)
        self.inner = np.zeros(len(every))
        self.inner[self._places] = 1.0
        self.inner[low] = self.inner[high] = 0.0
        part = np.searchsorted(high + half, every)
        self._filled_by = begins[part] + np.clip(every, low[part], high[part]) - low[part]

    def spread(self, values: FloatArray) -> FloatArray:
        """Values (points,) at all places, (places,)."""
        return np.asarray(values[self._filled_by])

    def gather(self, values: FloatArray) -> FloatArray:
        """Values (places,) at the points, (points,)."""
        return np.asarray(values[self._places])


def _about_turns(record: WeakRecord, side: str) -> IntArray:
    """Points about the instants at which a side turns."""

    def make() -> tuple[IntArray, int]:
        way = np.sign(record.points[f"{side}_velocity"])
        wide = APART * len(_weights(record.grid, side))
        turns = np.diff(way, prepend=way[:1]) != 0
        found = np.flatnonzero(np.convolve(turns, np.ones(2 * wide + 1), "same") > 0.5)
        return found, len(found)

    found: IntArray = cache_of("turns").get(record, side, make, KEPT)
    return found


def _largest(weights: FloatArray) -> float:
    """Largest gain of a filter with these weights, at any frequency."""
    return float(np.abs(np.fft.rfft(weights, 16 * len(weights))).max())


def _weights(grid: Grid, side: str) -> FloatArray:
    return corner_weights(grid.pointwise[f"{side}_position"], grid.dt, grid.step)


def _taken_off(record: WeakRecord, side: str, name: str) -> FloatArray:
    """What the kernel of a side's velocity has taken off what a torque makes, (points,), at an
    inertia of 1: nothing at the ends of a stretch, where the kernel has no middle.
    """

    def make() -> tuple[FloatArray, int]:
        # what holds a standing side is no acceleration
        values = (1.0 - record.still[side]) * _torque(record, name)
        weights = _weights(record.grid, side)
        half = len(weights) // 2
        out = np.zeros(len(values))
        for first, last in zip(record.starts[:-1], record.starts[1:], strict=True):
            if last - first >= len(weights):
                inner = slice(first + half, last - half)
                out[inner] = np.correlate(values[first:last], weights, "valid")
        out.setflags(write=False)
        return out, len(out)

    found: FloatArray = cache_of("taken off").get(record, (side, name), make, KEPT)
    return found


def _torque(record: WeakRecord, name: str) -> FloatArray:
    if name != TWIST:
        return record.points[name]
    motor, link = (record.paired.get(c, record.smooth[c]) for c in PAIR)
    return motor - link


__all__ = ["Friction", "corner_weights", "sticking_torque", "with_corners"]
