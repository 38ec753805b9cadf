"""What a filter's innovations and disturbances say, over windows, as shares of limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from identification.online.filter import Course, JointFilter, Levels
from identification.online.filter_step import BALANCES

FloatArray = npt.NDArray[np.float64]

WINDOWS: Final = (0.004, 0.03, 0.2, 1.5)
"""Lengths over which innovations are averaged [s]: from single wrong samples to slow drifts."""
BLOCK: Final = 2.0
"""Length of the blocks whose largest values tell the tail [s]: longer than every window."""
ALARMS: Final = 0.05
"""False alarms per hour for which a limit is extrapolated."""
MARGIN: Final = 1.25
"""Limits over what healthy records say: on other motions the model errs more."""
LARGEST: Final = 1.3
"""The same over the largest healthy value, which some minutes see once."""
SIGMAS: Final = 5.5
"""No limit lies below this many standard deviations of white noise (as in
:data:`identification.faults.calibrate.SIGMAS`)."""
UNSURE: Final = 3.0
"""Standard deviations by which a disturbance may be off: while an encoder's zero is not known yet,
a disturbance of the transmission is not either."""
SURE: Final = 1.645
"""Standard errors of that quantile by which it may be larger than the blocks say, one in twenty:
forty seconds have twenty blocks, whose spread is known to a fifth."""
MOMENTS: Final = (1.1589, 0.1919, 1.1)
"""Variance of a Gumbel quantile from the mean and the deviation of n blocks, by powers of its
reduced variate, in squares of the scale over n (Kite, Frequency and Risk Analyses in Hydrology,
1977)."""
EULER: Final = 0.5772156649
"""Mean of the standard Gumbel distribution."""


def statistics(course: Course, which: int, joint: JointFilter, levels: Levels) -> FloatArray:
    """Energies and means of the innovations over all windows, and the disturbances, (n, count).

    Parameters
    ----------
    course : Course
    which : int
        Number of the filter.
    joint : JointFilter
    levels : Levels
        That the course was run with.

    Returns
    -------
    array
        Root mean square (5 readings x 4 windows), size of the mean (the same), size of the three
        disturbances beyond what they and the friction of a side that creeps, or has just crept, are
        unsure by [N.m].
        Before a window is full, what is missing counts as expected.
    """
    windows = over_windows(course.innovation[which], joint.dt)
    unsure = UNSURE * course.deviation[which] + joint.unsure_friction(course, which, levels)
    known = np.maximum(np.abs(course.disturbance[which]) - unsure, 0.0)
    return np.concatenate([windows, known], axis=1)


def by_reading(shares: FloatArray, readings: int = 5) -> FloatArray:
    """The largest statistic of each reading, all as shares of their limits, (n, 1 + readings).

    Parameters
    ----------
    shares : (n, count) array
        Of :func:`statistics`, of one filter.
    readings : int

    Returns
    -------
    array
        In the order of :data:`identification.faults.core.SENSORS`; the drive's is that of the
        torque which the motor's balance lacks.
    """
    rows = len(shares)
    own = shares[:, :-BALANCES].reshape(rows, -1, readings).max(axis=1)
    return np.column_stack([shares[:, -BALANCES], own])


def over_windows(innovations: FloatArray, dt: float) -> FloatArray:
    """Root mean square and size of the mean of innovations over all windows.

    Parameters
    ----------
    innovations : (n, readings) array
        In standard deviations.
    dt : float
        Sample time [s].

    Returns
    -------
    (n, 2 x windows x readings) array
        Before a window is full, what is missing counts as expected.
    """
    e = np.clip(innovations, -1e6, 1e6)
    rows, readings = e.shape
    squares = np.concatenate([np.zeros((1, readings)), np.cumsum(e**2, axis=0)])
    sums = np.concatenate([np.zeros((1, readings)), np.cumsum(e, axis=0)])
    energy, mean = [], []
    for length in lengths(dt):
        at = np.arange(1, rows + 1)
        before = np.maximum(at - length, 0)
        missing = np.maximum(length - at, 0)[:, None]
        energy.append(np.sqrt(np.maximum(squares[at] - squares[before] + missing, 0.0) / length))
        mean.append(np.abs(sums[at] - sums[before]) / length)
    return np.concatenate([*energy, *mean], axis=1)


def lengths(dt: float) -> list[int]:
    """Windows in samples."""
    return [max(1, round(w / dt)) for w in WINDOWS]


def floors(dt: float, disturbance: Sequence[float], readings: int = 5) -> FloatArray:
    """Limits that noise alone would need, one per statistic; levels of the disturbances [N.m]."""
    out: list[float] = []
    for n in lengths(dt):
        out += [math.sqrt(1 + SIGMAS * math.sqrt(2 / n) + SIGMAS**2 / n)] * readings
    for n in lengths(dt):
        out += [SIGMAS / math.sqrt(n)] * readings
    return np.array([*out, *((SIGMAS - UNSURE) * d for d in disturbance)])


def limits(
    healthy: Sequence[FloatArray], dt: float, disturbance: Sequence[float], readings: int = 5
) -> FloatArray:
    """Limits of all statistics from those of healthy stretches, each (n, count), and from the
    levels of the disturbances [N.m].

    The larger of :data:`LARGEST` times the largest value and of the Gumbel quantile of the largest
    values of blocks, as large as it may be by so many blocks, times :data:`MARGIN`.
    """
    size = max(1, round(BLOCK / dt))
    blocks = np.array(
        [
            part[k : k + size].max(axis=0)
            for part in healthy
            for k in range(0, max(len(part) - size + 1, 1), size)
        ]
    )
    scale = np.std(blocks, axis=0) * math.sqrt(6) / math.pi
    rare = -math.log(-math.log1p(-ALARMS * BLOCK / 3600.0))
    unsure = math.sqrt(sum(c * rare**k for k, c in enumerate(MOMENTS)) / len(blocks))
    quantile = np.mean(blocks, axis=0) + (rare - EULER + SURE * unsure) * scale
    found = MARGIN * np.maximum(LARGEST * blocks.max(axis=0), quantile)
    kept: FloatArray = np.maximum(found, floors(dt, disturbance, readings))
    return kept
