"""Single samples far off their neighbours: lost bits, not physics; put right before anything is
averaged.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from identification.balance.stamps import bridged

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


__all__ = ["without_spikes"]
