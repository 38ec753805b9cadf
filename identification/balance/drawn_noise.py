"""Noise drawn for the channels of a record: what a fitted model makes of it is the floor of
each balance.
"""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d

from identification.balance.colour import ChannelNoise
from identification.balance.stamps import bridged_over
from identification.balance.weak import PAIR, POSITION_CHAINS, Grid, WeakRecord, filtered, paired

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

SEED: Final = 20260
"""One seed for all draws: the same records and values give the same floor, and it moves
smoothly with the values.
"""
ROWS: Final = 8000
"""Rows drawn for each floor; four rows to a kernel make some 3200 independent ones, so the floor
is known within 1.3 %. With a quarter of them, which is 3 %, names that are near a tie and values
that the noise of the columns decides hung on the draw.
"""
LONGEST: Final = 8000
"""Rows of a record up to which noise is drawn for all of them; of a longer one for so many, in even
pieces: the floor is known within 1.3 % then, and a million samples cost no more than 100 s.
"""
SLOW: Final = 0.5
"""Over how long the twist of the gear is read from both encoders to say where the coarse one is
[s]: half of a second holds hundreds of its samples, and a weight that turns hardly moves. From .06
to 2 s the floor of a joint with gravity differs by 10 %; without any twist it was 40 % too high.
"""
CROSSED: Final = 4.0
"""Steps that a motion must cross in that time for their rounding to have a mean of zero: what is
left of it is an eighth of a step at most."""
PIECE: Final = 200
"""Rows of such a piece: fifty kernel lengths, so that its ends do not count."""
MOST: Final = 24
"""Records whose draws a thread keeps."""
CALM: Final = 0.02
"""Kernel of the torsion to which noise is added to see what it does to a law with memory [s]: at
1 kHz a quarter of the noise is left in it. With 12 and with 30 ms the damping beside a hysteresis
differs by .5 %, less than its error."""

_kept = threading.local()


@final
@dataclass(frozen=True)
class Draws:
    """A record with smoothed signals, and with drawn noise on top of them.

    Attributes
    ----------
    record : WeakRecord
        The record itself, or pieces of it where it is long.
    rows : (n,) int array
        Rows of the whole record that these are.
    calm : WeakRecord
        With smoothed signals.
    noisy : WeakRecord
        `count` copies of that one after the other, each with other noise.
    count : int
    """

    record: WeakRecord
    rows: IntArray
    calm: WeakRecord
    noisy: WeakRecord
    count: int


def draws_of(record: WeakRecord, noise: Mapping[str, ChannelNoise]) -> Draws:
    """Draws of the noise on the channels of a record, kept for the records that asked last; as many
    as give :data:`ROWS` rows.

    Parameters
    ----------
    record : WeakRecord
        Held weakly, known by identity.
    noise : mapping of str to ChannelNoise
        Of each measured signal.
    """
    cache: OrderedDict[Hashable, tuple[weakref.ref[WeakRecord], Draws]] = _kept.__dict__.setdefault(
        "draws", OrderedDict()
    )
    key = (id(record), tuple(sorted(noise.items(), key=lambda item: item[0])))
    found = cache.get(key)
    if found is not None and found[0]() is record:
        cache.move_to_end(key)
        return found[1]
    seen, rows = excerpt(record)
    calm = replace(seen, points={**seen.points, **seen.smooth})
    count = max(1, -(-ROWS // max(seen.rows, 1)))
    made = Draws(seen, rows, calm, _with_noise(calm, noise, count), count)
    cache[key] = (weakref.ref(record), made)
    while len(cache) > MOST:
        cache.popitem(last=False)
    return made


def doubts_of(
    grid: Grid,
    signals: Mapping[str, FloatArray],
    noise: Mapping[str, ChannelNoise],
) -> tuple[Mapping[str, FloatArray], ...]:
    """Tracks of both positions that tell what their noise does to a law with memory of the torsion:
    smooth ones, and these with noise added and with the same noise taken off, so that only what
    does not change its sign with the noise is left of it. None where a position is read in steps,
    whose roundings are no noise beside the motion.

    A law with memory turns round wherever its input does. Noise makes it turn a little after every
    slip, the more the slower the motion is: the loop is smaller than that of the motion, and grows
    with speed, which a damper then takes off again.
    """
    if grid.torsion <= 0 or any(c not in noise or noise[c].step > 0 for c in PAIR):
        return ()
    calm = paired(replace(grid, torsion=CALM), signals)
    rng, count = np.random.default_rng(SEED), max((s.stop for s in grid.segments), default=0)
    drawn = paired(grid, {c: noise[c].draw(rng, count, grid.dt) for c in PAIR})
    return calm, *({c: calm[c] + sign * drawn[c] for c in PAIR} for sign in (1, -1))


def excerpt(record: WeakRecord) -> tuple[WeakRecord, IntArray]:
    """The record, or about :data:`LONGEST` rows of it in pieces spread evenly where it has more;
    and which of its rows these are.
    """
    if record.rows <= LONGEST:
        return record, np.arange(record.rows)
    grid = record.grid
    period = round(PIECE * record.rows / LONGEST)
    found_rows: list[IntArray] = []
    points: list[IntArray] = []
    segments: list[slice] = []
    samples_of: list[IntArray] = []
    first_row = first_point = 0
    for s in grid.segments:
        count = len(range(grid.half, s.stop - s.start - grid.half, grid.stride))
        for row in range(0, count, period):
            taken = min(PIECE, count - row)
            begin = segments[-1].stop if segments else 0
            samples = 2 * grid.half + (taken - 1) * grid.stride + 1
            segments.append(slice(begin, begin + samples))
            samples_of.append(s.start + row * grid.stride + np.arange(samples))
            found_rows.append(first_row + row + np.arange(taken))
            at = first_point + row * grid.stride // grid.step
            points.append(at + np.arange(len(range(0, samples, grid.step))))
        first_row += count
        first_point += len(range(0, s.stop - s.start, grid.step))
    which, where = np.concatenate(found_rows), np.concatenate(points)

    def of(signals: Mapping[str, FloatArray], index: IntArray) -> dict[str, FloatArray]:
        return {n: x[index] for n, x in signals.items()}

    pieces = replace(
        record,
        grid=replace(grid, segments=tuple(segments)),
        averaged=of(record.averaged, which),
        points=of(record.points, where),
        smooth=of(record.smooth, where),
        paired=of(record.paired, where),
        doubts=tuple(of(d, where) for d in record.doubts),
        time=record.time[which],
        block=record.block[which],
        starts=np.concatenate([[0], np.cumsum([len(p) for p in points])]).astype(np.int64),
        curved=of(record.curved, which),
        rest=of(record.rest, which),
        between=of(record.between, which),
        support=None if record.support is None else record.support[which],
        bridging=of(record.bridging, np.concatenate(samples_of)),
        lost=None if record.lost is None else record.lost[np.concatenate(samples_of)],
    )
    return pieces, which


def _with_noise(record: WeakRecord, noise: Mapping[str, ChannelNoise], copies: int) -> WeakRecord:
    """Copies of a record, its points smoothed already, with drawn noise on top of it."""
    grid, rng = record.grid, np.random.default_rng(SEED)
    count = max((s.stop for s in grid.segments), default=0)
    present = [
        c for c in POSITION_CHAINS if c in noise and noise[c].level > 0 and c in record.points
    ]
    courses = {c: _course(record, c, noise, count) for c in present if noise[c].step > 0}
    drawn = {c: np.empty((copies, count)) for c in present}
    for copy in range(copies):
        for c in present:
            drawn[c][copy] = (
                noise[c].rounding(rng, courses[c])
                if c in courses
                else noise[c].draw(rng, count, grid.dt)
            )
        for c in present:
            own = drawn[c][copy]
            if record.lost is not None:
                own[:] = bridged_over(own, record.lost[:count], grid.segments)
            if c in record.bridging:  # what bridges are off by, after the noise: its draws stay
                own += record.bridging[c][:count] * rng.standard_normal(count)
    averaged, points, smooth, curved = filtered(grid, drawn, curved=bool(record.curved))
    zero = np.zeros((copies, count))
    also = paired(grid, {c: drawn.get(c, zero) for c in record.paired})
    first = record.starts[-1] * np.arange(copies)[:, None] + record.starts[:-1]
    return replace(
        record,
        averaged=_plus(record.averaged, averaged, copies),
        points=_plus(record.points, points, copies),
        smooth=_plus(record.smooth, smooth, copies),
        paired=_plus(record.paired, also, copies),
        curved=_plus(record.curved, curved, copies),
        doubts=tuple(_plus(d, {}, copies) for d in record.doubts),
        rest=_plus(record.rest, {}, copies),
        between=_plus(record.between, {}, copies),
        time=np.tile(record.time, copies),
        block=np.tile(record.block, copies),
        starts=np.append(first.ravel(), copies * record.starts[-1]),
        support=None if record.support is None else np.tile(record.support, copies),
        copies=copies,
    )


def _course(
    record: WeakRecord, channel: str, noise: Mapping[str, ChannelNoise], count: int
) -> FloatArray:
    """Where a position is at each sample, (count,), as the finer of the two encoders tells, with
    what the twist of the gear adds over :data:`SLOW` seconds. A slow motion through a coarse
    encoder is a staircase itself; and at a steady speed its steps beat with the samples, at a
    frequency that hangs on the speed of this side to a thousandth.
    """
    finest = min(
        (c for c in PAIR if c in noise and c in record.smooth),
        key=lambda c: (noise[c].level, c != channel),
    )
    grid, soft = record.grid, record.smooth[finest]
    course, first = np.zeros(count), 0
    for s in grid.segments:
        at = np.arange(0, s.stop - s.start, grid.step)
        own = soft[first : first + len(at)]
        if finest != channel:
            apart = record.smooth[channel][first : first + len(at)] - own
            own = own + _slow(apart, own, noise[channel].step, grid.step * grid.dt)
        course[s] = np.interp(np.arange(s.stop - s.start), at, own)
        first += len(at)
    return course


def _slow(apart: FloatArray, course: FloatArray, step: float, dt: float) -> FloatArray:
    """What two encoders are apart, (n,), over :data:`SLOW` seconds, where the course crosses
    :data:`CROSSED` steps in that time; in between it goes from one such time to the next.
    """
    reach = max(1, round(SLOW / dt))
    if len(course) <= reach:
        return np.zeros(len(course))
    fast = np.abs(np.gradient(course)) * reach > CROSSED * step
    share = uniform_filter1d(fast.astype(np.float64), reach, mode="constant")
    known = share > 0.5
    if not known.any():
        return np.zeros(len(course))
    slow = (
        uniform_filter1d(np.where(fast, apart, 0.0), reach, mode="constant")[known] / share[known]
    )
    slow = slow - slow[0]  # the zero of the encoder is drawn
    at = np.arange(len(course))
    return np.asarray(np.interp(at, at[known], slow))


def _plus(
    signals: Mapping[str, FloatArray], noise: Mapping[str, FloatArray], copies: int
) -> dict[str, FloatArray]:
    """Copies of signals (n,) one after the other, each with its own noise (copies, n)."""
    return {
        n: (x + noise[n]).ravel() if n in noise else np.tile(x, copies) for n, x in signals.items()
    }


__all__ = ["Draws", "draws_of", "excerpt"]
