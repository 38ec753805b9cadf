"""Single samples far off their neighbours: lost bits, not physics; put right before anything is
averaged.

Some that look wild are the joint's: where a gap closes, a torque rests at zero for a sample or two
and goes on, and what is alone among its neighbours is no lost bit. Which it is, the motion tells: a
torque without motion is none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from identification.balance.beside import DEVIATION
from identification.balance.slow_noise import rests_of
from identification.balance.stamps import bridged
from identification.balance.weak import WeakRecord, differentiated_kernel

FloatArray = npt.NDArray[np.float64]

NEIGHBOURS: Final = 3
"""Samples on either side that a sample is held against."""
FAR: Final = 7.0
"""Noise levels that it must be off: normal noise gets there once in some 1e10 samples."""
ALONE: Final = 2.0
"""Times the range of its neighbours, about their own straight line, that it must be off: at a step
or a peak of the motion they are as far apart themselves.
"""
STEPS: Final = 4.0
"""Smallest steps of the channel that it must be off: a coarse converter toggles by one."""
TIE: Final = 1 / 24
"""Smallest steps of the channel by which it must be off farther: middles and slopes of values in
whole steps are whole twelfths of one, and rounding would decide which of two equal ones is larger.
"""
MOST: Final = 0.02
"""Share of the samples above which they are no single faults; four times the worst of usual
links."""
TOLD_BY: Final[Mapping[str, tuple[str, ...]]] = {"drive": ("both", "drive"), "torque": ("torque",)}
"""By signal, what is left of it beside what it follows from: the best first."""
SURE: Final = 3.0
"""Standard errors by which the motion must tell that a sample is the joint's."""
ROUNDS: Final = 3
"""Rounds: what is left of the drive beside a torque holds the wild samples of that torque, and a
sample's rows those of the next."""


def without_spikes(values: FloatArray, segments: Sequence[slice], level: float) -> FloatArray:
    """A channel with its single wild samples bridged by cubics.

    Parameters
    ----------
    values : (n,) array
        At even steps.
    segments : sequence of slice
        Contiguous stretches.
    level : float
        Noise level of the channel.

    Returns
    -------
    (n,) array
        The same array where there are none.
    """
    if level <= 0:
        return values
    found = [np.empty(0, dtype=np.int64)]
    smallest: float | None = None
    for s in segments:
        x = values[s]
        if len(x) <= 2 * NEIGHBOURS:
            continue
        ends = len(x) - NEIGHBOURS
        own = x[NEIGHBOURS:ends]
        near = np.flatnonzero(np.abs(own - (x[2:-4] + x[4:-2]) / 2) > FAR / 2 * level)
        if not len(near):
            continue
        if smallest is None:
            changes = np.abs(np.diff(values))
            smallest = float(np.min(changes[changes > 0], initial=np.inf))
        alone = _alone(x, near + NEIGHBOURS, FAR * level, smallest)
        found.append(s.start + NEIGHBOURS + near[alone])
    rows = np.concatenate(found)
    if not 0 < len(rows) <= MOST * len(values):
        return values
    out = values.copy()
    for s in segments:
        here = rows[(rows >= s.start) & (rows < s.stop)] - s.start
        if not len(here):
            continue
        good = np.ones(s.stop - s.start, dtype=np.bool_)
        good[here] = False
        kept = np.flatnonzero(good).astype(np.float64)
        out[s.start + here] = bridged(
            kept, values[s][good][:, None], here.astype(np.float64), np.full(len(here), -1)
        )[:, 0]
    return out


def _alone(
    x: FloatArray, rows: npt.NDArray[np.int64], limit: float, smallest: float
) -> npt.NDArray[np.bool_]:
    """Which of these samples are off by more than a limit and some smallest steps, and alone in
    that."""
    apart = np.arange(1, NEIGHBOURS + 1)
    after, before = x[rows[:, None] + apart], x[rows[:, None] - apart]
    off = np.abs(x[rows] - np.median((after + before) / 2, axis=1))
    slope = np.median((after - before) / (2 * apart), axis=1)[:, None]
    level = np.sort(np.hstack([after - slope * apart, before + slope * apart]), axis=1)
    # another wild sample may be among the neighbours
    spread = np.minimum(level[:, -1] - level[:, 1], level[:, -2] - level[:, 0])
    least = np.maximum(max(limit, STEPS * smallest), ALONE * spread)
    return np.asarray(off > least + TIE * smallest)


def restored(
    made: WeakRecord,
    mended: Mapping[str, FloatArray],
    read: Mapping[str, FloatArray],
    late: Mapping[str, float],
    remade: Callable[[Mapping[str, FloatArray]], WeakRecord],
) -> WeakRecord:
    """The record with those samples of its torques as they were read that its motion asks for.

    Parameters
    ----------
    made : WeakRecord
        Made of the mended signals.
    mended, read : mapping of str to (n,) array
        Torques at even steps without their wild samples, and with them; by signal.
    late : mapping of str to float
        Samples that a signal was shifted by in the record.
    remade : callable
        Makes the record with such torques in place of the mended ones.
    """
    signals = dict(mended)
    for _ in range(ROUNDS):
        rests = rests_of(made)
        before = dict(signals)
        for signal, values in before.items():
            key = next((k for k in TOLD_BY.get(signal, ()) if k in rests), None)
            wild = np.flatnonzero(values != read[signal])
            if key is None or not len(wild):
                continue
            size = read[signal][wild] - values[wild]
            at = wild.astype(np.float64) - late.get(signal, 0.0)
            asked = _asked_for(made, rests[key], at, size, len(values))
            if asked.any():
                signals[signal] = values.copy()
                signals[signal][wild[asked]] = read[signal][wild[asked]]
        if all(signals[s] is before[s] for s in signals):
            break
        made = remade(signals)
    return made


def _asked_for(
    made: WeakRecord, rest: FloatArray, at: FloatArray, size: FloatArray, samples: int
) -> npt.NDArray[np.bool_]:
    """Which changes of single samples (`at`, of that size) certainly take some of the rest away:
    sums of squares over their rows, in units of what is left in these.
    """
    scale = DEVIATION * float(np.median(np.abs(rest)))
    weights = differentiated_kernel(made.grid.length, made.grid.dt, 0)
    centres = made.grid.pick(np.arange(samples, dtype=np.float64))
    order = np.argsort(centres)
    reach = len(weights) // 2
    first = np.searchsorted(centres[order], at - reach)
    number = np.searchsorted(centres[order], at + reach, side="right") - first
    out = np.zeros(len(at), dtype=np.bool_)
    if not scale or not number.any():
        return out
    rows = np.minimum(first[:, None] + np.arange(int(number.max())), len(order) - 1)
    near = np.arange(rows.shape[1]) < number[:, None]
    rows = order[rows]
    offset = at[:, None] - centres[rows]
    change = size[:, None] * np.interp(offset, np.arange(-reach, reach + 1), weights) * near
    now, then = (np.sum((x / scale) ** 2 * near, axis=1) for x in (rest[rows], rest[rows] + change))
    # what else is wrong where a gap closes is as large in these rows as what is left of them
    left = 1.0 + np.minimum(now, then) / np.maximum(number, 1)
    return np.asarray(now - then > SURE**2 * left)


__all__ = ["TOLD_BY", "restored", "without_spikes"]
