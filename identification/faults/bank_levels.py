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
STRETCH: Final = 4.0
"""Shortest stretch of a record for the search [s]: most of it counts after :data:`SETTLE`."""
ROUGHLY: Final = 2
"""Every so-manieth stretch tells which start is best."""
STEPS: Final = (4.0, 2.0, 1.4, 1.15)
"""Factors by which a level is tried up and down, one after the other."""
SWEEPS: Final = 3
"""Sweeps over all levels for each factor at most."""
ALONE: Final = 0.03
"""Share that the other balances' disturbances begin with where one balance is tried as the one that
lacks most."""
GAIN: Final = 2.0
"""Rise of the log-likelihood worth a change: two standard deviations of one parameter."""
HOPELESS: Final = 300.0
"""Levels are not tried to the last stretch where they are worse than the best by this much in the
first ones [log-likelihood]: stretches differ by less in what they say of a level."""
SHIFTS: Final = (-1.0, 3.0)
"""Bounds of the share of the later drive reading: from half a sample early to three late."""
VALLEYS: Final = (2.0, -2.0)
"""A disturbance's size and time constant are tried together, too, the constant as this power of the
size: the first keeps how far it goes from sample to sample, the second what it is over long times.
Likelihoods have such valleys, and steps of one level alone end on their walls."""
BOUNDS: Final = {"disturbance": (1e-4, 1e4), "creeping": (1e-4, 1e4), "lasting": (3e-3, 10.0)}
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

    def one(levels: Levels, piece: Piece, flags: FloatArray) -> float:
        table = np.broadcast_to(flags, (1, len(piece.time), 6))
        state = joint.start(
            float(piece.time[0]), piece.rows[0].tolist(), flags.tolist(), levels=levels
        )
        course = joint.run([state], piece.time, piece.rows, table, levels=levels)
        late = piece.time - piece.time[0] > SETTLE
        e, s = course.innovation[0, late], course.spread[0, late]
        if not np.isfinite(e).all():
            return math.inf
        return float(np.sum((DEGREES + 1) / 2 * np.log1p(e**2 / DEGREES) + np.log(s)))

    def cost(
        levels: Levels, flags: FloatArray = used, every: int = 1, best: FloatArray | None = None
    ) -> FloatArray:
        """Minus the log-likelihood of each stretch; those after the first few are left at infinity
        where levels are clearly worse than the best ones.
        """
        out = np.full(len(few[::every]), math.inf)
        for k, piece in enumerate(few[::every]):
            out[k] = one(levels, piece, flags)
            if best is not None and not out[: k + 1].sum() < best[: k + 1].sum() + HOPELESS:
                break
        return out

    moves = _moves(measured)

    def climbed(best: Levels, factors: Sequence[float], every: int) -> tuple[float, Levels]:
        least = cost(best, every=every)
        for factor in factors:
            for _ in range(SWEEPS):
                before = least.sum()
                for move in moves:
                    for step in (factor, 1 / factor):
                        start = best
                        while (tried := move(best, step)) != best:
                            found = cost(tried, every=every, best=least)
                            if not found.sum() < least.sum() - GAIN:
                                break
                            best, least = tried, found
                        if best != start:
                            break  # the other direction leads back
                if before - least.sum() < GAIN * len(moves):
                    break
        return float(least.sum()), best

    dry = (float(joint.dry[0]), float(joint.dry[1]))
    turns = replace(first, creeping=dry, holding=dry)
    roughly = [climbed(start, STEPS[:1], ROUGHLY) for start in _starts(turns)]
    _, rough = min(roughly, key=lambda found: found[0])
    _, best = climbed(rough, STEPS, 1)
    without = used.copy()
    without[0] = 0.0
    least = cost(best, without)
    for factor in STEPS[1:]:
        for name in ("unknown_drive", "unknown_lasting"):
            for step in (factor, 1 / factor):
                change: dict[str, Any] = {name: getattr(best, name) * step}
                tried = replace(best, **change)
                found = cost(tried, without, best=least)
                if found.sum() < least.sum() - GAIN:
                    best, least = tried, found
    return best


def _few(pieces: Sequence[Piece]) -> list[Piece]:
    """Stretches from all of the pieces that together have :data:`ENOUGH` samples: what a joint
    lacks at a turn or at one place is not in the first seconds of a motion.
    """
    total = sum(len(p.time) for p in pieces)
    out = []
    for p in pieces:
        span = float(p.time[-1] - p.time[0])
        share = min(ENOUGH / max(total, 1), 1.0)
        count = max(round(share * span / STRETCH), 1)
        each = max(round(share * len(p.time) / count), 1)
        slack = len(p.time) - each
        begins = np.linspace(0, slack, count).astype(int) if count > 1 else np.array([slack // 2])
        out += [Piece(p.time[k : k + each], p.rows[k : k + each]) for k in begins.tolist()]
    return out


def _starts(first: Levels) -> list[Levels]:
    """Levels to search from: what the model lacks may act on one balance or on all; between these
    likelihoods have hollows that no step crosses.
    """
    out = [first]
    for lacks in range(3):
        a, b, c = (
            size * (1.0 if i == lacks else ALONE) for i, size in enumerate(first.disturbance)
        )
        out.append(replace(first, disturbance=(a, b, c)))
    return out


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

    def one_of(name: str, i: int) -> Move:
        def moved(levels: Levels, factor: float) -> Levels:
            a = list(getattr(levels, name))
            a[i] = float(np.clip(a[i] * factor, *BOUNDS[name]))
            changed: dict[str, Any] = {name: tuple(a)}
            return replace(levels, **changed)

        return moved

    def paired(i: int, power: float) -> Move:
        size, lasting = one_of("disturbance", i), one_of("lasting", i)
        return lambda levels, factor: lasting(size(levels, factor), factor**power)

    return [
        shift,
        drive,
        *(one_of(name, i) for i in range(3) for name in ("disturbance", "lasting")),
        *(one_of("creeping", i) for i in range(2)),
        *(paired(i, power) for i in range(3) for power in VALLEYS),
        *(reading(i) for i in range(5) if measured[i + 1]),
    ]
