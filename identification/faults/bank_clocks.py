"""Readings of one sample at one time: channels whose clocks are known to be late.

Filters take the readings of a sample for those of one instant. A channel that is late by some
milliseconds moves with the joint's speed, so what a healthy record shows is large wherever the
joint is fast, and small faults hide in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

POINTS: Final = 4
"""Readings through which the polynomial between two of them goes: cubic, as where rows are
shifted (:func:`identification.balance.clocks.cubic`)."""


def aligned(time: FloatArray, rows: FloatArray, late: Sequence[float]) -> FloatArray:
    """Readings as they were at their stamps.

    Parameters
    ----------
    time : (n,) array
        Stamps without a gap [s].
    rows : (n, channels) array
    late : sequence of float
        Time by which each channel is late [s]; negative where it is early.

    Returns
    -------
    (n, channels) array
        What has no reading on one side goes on in a straight line; :func:`inside` tells where that
        is not needed. A reading that is missing is missing wherever it would be needed.
    """
    out = rows.copy()
    if len(time) < POINTS:
        return out
    for i, delay in enumerate(late):
        if delay:
            out[:, i] = _at(time + delay, time, rows[:, i])
    return out


def inside(time: FloatArray, late: Sequence[float]) -> slice:
    """Samples of a stretch at which every channel has readings on both sides."""
    if len(time) < POINTS:
        return slice(0, len(time))
    first = int(np.searchsorted(time, time[0] + max(0.0, -min(late)), side="left"))
    last = int(np.searchsorted(time, time[-1] - max(0.0, *late), side="right"))
    return slice(first, max(last, first))


def _at(wanted: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    """Cubic through the two readings before and the two after, at uneven stamps."""
    middle = np.clip(np.searchsorted(time, wanted, side="right"), 2, len(time) - 2)
    points = middle[:, None] + np.arange(-2, POINTS - 2)
    stamps, found = time[points], np.zeros(len(wanted))
    for i in range(POINTS):
        weight = np.ones(len(wanted))
        for j in range(POINTS):
            if j != i:
                apart = stamps[:, i] - stamps[:, j]
                weight *= (wanted - stamps[:, j]) / np.where(apart == 0.0, np.inf, apart)
        found += weight * values[points[:, i]]
    beyond = (wanted < time[0]) | (wanted > time[-1])
    if beyond.any():
        ends = np.where(wanted[beyond] < time[0], 0, len(time) - 2)
        slope = (values[ends + 1] - values[ends]) / np.maximum(time[ends + 1] - time[ends], 1e-12)
        found[beyond] = values[ends] + slope * (wanted[beyond] - time[ends])
    return found
