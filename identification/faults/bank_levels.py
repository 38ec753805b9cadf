"""Noise of a joint's readings and the torques its model lacks, by maximum likelihood on healthy
records.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.noise import noise_level
from identification.online.filter import JointFilter, Levels

FloatArray = npt.NDArray[np.float64]

SETTLE: Final = 1.5
"""Seconds after which a filter has forgotten how it was started: some periods of the slowest
dynamics of a joint with its link."""
DEGREES: Final = 5.0
"""Degrees of freedom of Student's t, whose tails keep single events from setting the levels."""
ENOUGH: Final = 16_000
"""Samples for the search of the levels: the error of a level is then under a percent."""
STEPS: Final = (4.0, 2.0, 1.4, 1.15)
"""Factors by which a level is tried up and down, one after the other."""
SWEEPS: Final = 3
"""Sweeps over all levels for each factor at most."""
GAIN: Final = 2.0
"""Rise of the log-likelihood worth a change: two standard deviations of one parameter."""
SHIFTS: Final = (-1.0, 3.0)
"""Bounds of the share of the later drive reading: from half a sample early to three late."""
BOUNDS: Final = {"disturbance": (1e-4, 1e4), "lasting": (3e-3, 10.0)}
"""Bounds of the disturbances' sizes [N.m] and time constants [s]: slower than ten seconds is a
parameter, faster than some samples is noise."""


@final
@dataclass(frozen=True)
class Piece:
    """A stretch of healthy readings: stamps (n,), rows (n, 6) as in
    :data:`identification.faults.core.SENSORS`.
    """

    time: FloatArray
    rows: FloatArray


def first_levels(pieces: Sequence[Piece], dt: float, measured: Sequence[bool]) -> Levels:
    """Levels to begin with: white noise of the readings, a hundredth of the torque as disturbance.

    The drive that is not known varies as it does in the records.
    """
    noise = [
        max((noise_level(p.rows[:, i], (slice(0, len(p.rows)),)) for p in pieces), default=0.0)
        for i in range(6)
    ]
    rows = np.concatenate([p.rows for p in pieces])
    size = float(np.sqrt(np.mean(rows[:, 0] ** 2)))
    lag = max(1, round(0.01 / dt))
    change = np.concatenate([p.rows[lag:, 0] - p.rows[:-lag, 0] for p in pieces])
    share = min(float(np.mean(change**2)) / (2 * max(size, 1e-9) ** 2), 0.9)
    resolution = [max(n, 1e-9) if on else 1.0 for n, on in zip(noise, measured, strict=True)]
    return Levels(
        readings=(resolution[1], resolution[2], resolution[3], resolution[4], resolution[5]),
        drive=max(noise[0], 1e-3 * size) * math.sqrt(dt),
        disturbance=(0.01 * size, 0.01 * size, 0.01 * size),
        unknown_drive=2.0 * size,
        unknown_lasting=min(max(-0.01 / math.log(1 - share), 3e-3), 1.0),
    )


def likeliest(
    joint: JointFilter, pieces: Sequence[Piece], measured: Sequence[bool], first: Levels
) -> Levels:
    """The levels under which healthy readings are likeliest: coordinates in turn.

    Parameters
    ----------
    joint : JointFilter
    pieces : sequence of Piece
    measured : sequence of 6 bools
    first : Levels
    """
    few = _few(pieces)
    used = np.array(measured, dtype=np.float64)

    def cost(levels: Levels, flags: FloatArray = used) -> float:
        total = 0.0
        for piece in few:
            table = np.broadcast_to(flags, (1, len(piece.time), 6))
            state = joint.start(
                float(piece.time[0]), piece.rows[0].tolist(), flags.tolist(), levels=levels
            )
            course = joint.run([state], piece.time, piece.rows, table, levels=levels)
            late = piece.time - piece.time[0] > SETTLE
            e, s = course.innovation[0, late], course.spread[0, late]
            if not np.isfinite(e).all():
                return math.inf
            total += float(np.sum((DEGREES + 1) / 2 * np.log1p(e**2 / DEGREES) + np.log(s)))
        return total

    moves = _moves(measured)
    best, least = first, cost(first)
    for factor in STEPS:
        for _ in range(SWEEPS):
            before = least
            for move in moves:
                for step in (factor, 1 / factor):
                    while True:
                        tried = move(best, step)
                        found = cost(tried) if tried != best else math.inf
                        if not found < least - GAIN:
                            break
                        best, least = tried, found
            if before - least < GAIN * len(moves):
                break
    without = used.copy()
    without[0] = 0.0
    least = cost(best, without)
    for factor in STEPS[1:]:
        for name in ("unknown_drive", "unknown_lasting"):
            for step in (factor, 1 / factor):
                change: dict[str, Any] = {name: getattr(best, name) * step}
                tried = replace(best, **change)
                found = cost(tried, without)
                if found < least - GAIN:
                    best, least = tried, found
    return best


def _few(pieces: Sequence[Piece]) -> list[Piece]:
    """Stretches from all pieces that together have :data:`ENOUGH` samples."""
    each = max(ENOUGH // max(len(pieces), 1), 1)
    return [Piece(p.time[:each], p.rows[:each]) for p in pieces]


Move = Callable[[Levels, float], Levels]


def _moves(measured: Sequence[bool]) -> list[Move]:
    """What changes one level by a factor."""

    def reading(i: int) -> Move:
        def moved(levels: Levels, factor: float) -> Levels:
            a = list(levels.readings)
            a[i] *= factor
            return replace(levels, readings=(a[0], a[1], a[2], a[3], a[4]))

        return moved

    def drive(levels: Levels, factor: float) -> Levels:
        return replace(levels, drive=levels.drive * factor)

    def shift(levels: Levels, factor: float) -> Levels:
        # the share is a time: it moves by as much as the factor is over or under one
        step = factor - 1 if factor > 1 else 1 - 1 / factor
        return replace(levels, shift=float(np.clip(levels.shift + 0.25 * step, *SHIFTS)))

    def triple(name: str, i: int) -> Move:
        def moved(levels: Levels, factor: float) -> Levels:
            a = list(getattr(levels, name))
            a[i] = float(np.clip(a[i] * factor, *BOUNDS[name]))
            changed: dict[str, Any] = {name: (a[0], a[1], a[2])}
            return replace(levels, **changed)

        return moved

    return [
        shift,
        drive,
        *(triple(name, i) for i in range(3) for name in ("disturbance", "lasting")),
        *(reading(i) for i in range(5) if measured[i + 1]),
    ]
