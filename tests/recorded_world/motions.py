"""Motions as people record them.

Each gives position and velocity on the fine grid, shape (rows, 2).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from tests.recorded_world._engine import ROWS_PER_SECOND, FloatArray

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.random import Generator

    from tests.recorded_world.joints import Plain

REST: Final = (0.5, 3.0)
"""Seconds at rest at the beginning and at the end, where a record has them."""

SHARE_OF_REST: Final = 0.15
"""Most of a record that each of them takes."""


def _move(start: float, end: float, speed: float, acceleration: float) -> FloatArray:
    """A trapezoid of velocity from rest to rest, rows of the fine grid."""
    way = abs(end - start)
    speed = min(speed, float(np.sqrt(way * acceleration)))
    ramp, flat = speed / acceleration, max(way / speed - speed / acceleration, 0.0)
    t = np.arange(1, int((2.0 * ramp + flat) * ROWS_PER_SECOND) + 2) / ROWS_PER_SECOND
    corner, level = [0.0, ramp, ramp + flat, 2.0 * ramp + flat], [0.0, speed, speed, 0.0]
    v = np.interp(t, corner, level)
    left = np.clip(t, 0.0, ramp)
    right = np.clip(t - ramp - flat, 0.0, ramp)
    s = 0.5 * acceleration * left**2 + speed * np.clip(t - ramp, 0.0, flat)
    s += speed * right - 0.5 * acceleration * right**2
    sign = float(np.sign(end - start))
    return np.column_stack([start + sign * np.minimum(s, way), sign * v])


def _wait(at: float, seconds: float) -> FloatArray:
    rows = round(seconds * ROWS_PER_SECOND)
    return np.column_stack([np.full(rows, at), np.zeros(rows)])


def _fill(parts: Callable[[float], list[FloatArray]], start: float, rows: int) -> FloatArray:
    pieces = [_wait(start, 1.0 / ROWS_PER_SECOND)]
    have = 1
    while have < rows:
        for piece in parts(float(pieces[-1][-1, 0])):
            if len(piece):
                pieces.append(piece)
                have += len(piece)
    return np.concatenate(pieces)[:rows]


def pick_and_place(rng: Generator, joint: Plain, rows: int) -> FloatArray:
    """Between two to four places at one speed, with a dwell at each."""
    stroke, count = joint.make.stroke, int(rng.integers(2, 5))
    places = np.linspace(-1.0, 1.0, count) * stroke + rng.uniform(-0.12, 0.12, count) * stroke
    speed, dwell = rng.uniform(0.6, 1.0) * joint.make.speed, rng.uniform(0.3, 1.2)
    turn = [0]

    def parts(at: float) -> list[FloatArray]:
        turn[0] = (turn[0] + int(rng.integers(1, count))) % count
        end = float(places[turn[0]])
        return [
            _move(at, end, speed, joint.acceleration),
            _wait(end, dwell * rng.uniform(0.7, 1.3)),
        ]

    return _fill(parts, float(places[0]), rows)


def trapezoids(rng: Generator, joint: Plain, rows: int) -> FloatArray:
    """One move after another, to random places at random speeds."""
    make = joint.make

    def parts(at: float) -> list[FloatArray]:
        end = float(rng.uniform(-1.0, 1.0)) * make.stroke
        if abs(end - at) < 0.2 * make.stroke:
            end = -np.sign(at if at else 1.0) * 0.8 * make.stroke
        return [_move(at, end, rng.uniform(0.1, 1.0) * make.speed, joint.acceleration)]

    return _fill(parts, 0.0, rows)


def sweeps(rng: Generator, joint: Plain, rows: int) -> FloatArray:
    """Constant speeds over the whole travel, both directions, short stops between."""
    make = joint.make
    speeds = np.exp(rng.uniform(np.log(0.08), np.log(1.0), 6)) * make.speed
    turn = [0]

    def parts(at: float) -> list[FloatArray]:
        speed = float(speeds[(turn[0] // 2) % len(speeds)])
        turn[0] += 1
        end = -make.stroke if at > 0 else make.stroke
        return [_move(at, end, speed, joint.acceleration), _wait(end, 0.2)]

    return _fill(parts, -make.stroke, rows)


def steps(rng: Generator, joint: Plain, rows: int) -> FloatArray:
    """Steps of the set point as drives shape them: three times the usual acceleration, then a
    wait.
    """
    make = joint.make

    def parts(at: float) -> list[FloatArray]:
        jump = rng.uniform(0.05, 0.3) * make.stroke * rng.choice([-1.0, 1.0])
        end = float(at + jump if abs(at + jump) < make.stroke else at - jump)
        return [
            _move(at, end, make.speed, 3.0 * joint.acceleration),
            _wait(end, rng.uniform(0.4, 1.5)),
        ]

    return _fill(parts, 0.0, rows)


def multisine(rng: Generator, joint: Plain, rows: int) -> FloatArray:
    """Twelve sines of 0.05 to 2 Hz."""
    t = np.arange(rows) / ROWS_PER_SECOND
    omega = (
        2.0
        * np.pi
        * np.exp(np.linspace(np.log(0.05), np.log(2.0), 12) + rng.uniform(-0.1, 0.1, 12))
    )
    weight, phase = rng.uniform(0.6, 1.4, 12) / omega, rng.uniform(0.0, 2.0 * np.pi, 12)
    angle = omega[:, None] * t + phase[:, None]
    x = (weight[:, None] * np.cos(angle)).sum(axis=0)
    v = -((omega * weight)[:, None] * np.sin(angle)).sum(axis=0)
    middle = 0.5 * (x.max() + x.min())
    by_speed = joint.make.speed / float(np.abs(v).max())
    scale = min(0.9 * joint.make.stroke / (0.5 * float(np.ptp(x))), by_speed)
    return scale * np.column_stack([x - middle, v])


def triangle(rng: Generator, joint: Plain, rows: int) -> FloatArray:
    """A slow triangle: a twelfth to a quarter of full speed, its corners rounded by the ramps."""
    make = joint.make
    speed, top = rng.uniform(0.08, 0.25) * make.speed, rng.uniform(0.3, 0.6) * make.stroke

    def parts(at: float) -> list[FloatArray]:
        return [_move(at, -top if at > 0 else top, speed, joint.acceleration)]

    return _fill(parts, 0.0, rows)


MOTIONS: Final[Mapping[str, Callable[[Generator, Plain, int], FloatArray]]] = {
    f.__name__: f for f in (pick_and_place, trapezoids, sweeps, steps, multisine, triangle)
}


def record(rng: Generator, joint: Plain, motion: str, seconds: float, *, rests: bool) -> FloatArray:
    """One recorded motion; ``rests`` puts a standstill before and after in three of four
    records.
    """
    rows = round(seconds * ROWS_PER_SECOND)
    most = SHARE_OF_REST * seconds
    before, after = (
        min(rng.uniform(*REST), most) if rng.random() < 0.75 else 0.0 for _ in range(2)
    )
    if not rests:
        before = after = 0.0
    inner = rows - round((before + after) * ROWS_PER_SECOND)
    path = MOTIONS[motion](rng, joint, inner)
    if before or after or motion == "multisine":  # a drive is ramped into and out of a moving start
        path = _faded(path)
    parts = [_wait(float(path[0, 0]), before), path, _wait(float(path[-1, 0]), after)]
    full = np.concatenate(parts)[:rows]
    return np.concatenate([full, np.repeat(full[-1:], rows - len(full), axis=0)])


def _faded(path: FloatArray) -> FloatArray:
    """Velocity ramped in over 0.4 s and out over 0.4 s, position integrated from it."""
    ramp = round(0.4 * ROWS_PER_SECOND)
    window = np.ones(len(path))
    window[:ramp] = 0.5 - 0.5 * np.cos(np.pi * np.arange(ramp) / ramp)
    window[-ramp:] = window[:ramp][::-1]
    v = window * path[:, 1]
    x = path[0, 0] + np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]))]) / ROWS_PER_SECOND
    return np.column_stack([x, v])
