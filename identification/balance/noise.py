"""Measurement noise from the record itself, without a data sheet."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from identification.balance.colour import ChannelNoise, coloured, spacings_of, white
from identification.data.record import Record

FloatArray = npt.NDArray[np.float64]

EVEN: Final = 1e-3
"""Spread of the steps, as a share of the median one, below which stamps count as even: that of
stamps written with few digits.
"""


KEPT: Final = 0.95
"""Share of the fourth differences that counts: the rest may be jumps of the motion and spikes."""
FOURTH_GAIN: Final = 70.0
"""Variance of a fourth difference of unit noise: 1 + 16 + 36 + 16 + 1."""
CUT_DEVIATION: Final = 0.87
"""Standard deviation of a unit normal variable that is cut at that quantile of its size (0.871)."""

JUMP: Final = 5.0
"""Noise levels over which a fourth difference is a jump: one in two million by chance."""
FEWEST_LEFT: Final = 0.2
"""Share of the samples around which no jump must be: from fewer their level is no level of all."""

LONGEST_LAG: Final = 60
"""Rows up to which correlation is followed: fifteen kernel lengths, longer than any block holds
together.
"""
UNCORRELATED: Final = 0.05
"""Autocorrelation below which rows count as independent: twice its own scatter over 1600 rows, the
rows of 40 s.
"""


def noise_level(
    values: FloatArray, segments: tuple[slice, ...], time: FloatArray | None = None
) -> float:
    """Standard deviation of the white noise of a channel from its fourth differences.

    The RMS of the smallest 95 % of the fourth differences, divided by 0.87 sqrt(70); holds for
    quantised channels, where the median absolute deviation reads too much.

    Parameters
    ----------
    values : (n,) array
    segments : tuple of slice
        Contiguous stretches; differences do not cross them.
    time : (n,) array, optional
        Stamps [s]. Where they are uneven the differences are divided ones: the motion between
        uneven stamps is no noise.

    Returns
    -------
    float
        In the unit of the channel; 0.0 for a channel that does not change.
    """
    parts = [
        _fourth(values[s], None if time is None else time[s])
        for s in segments
        if s.stop - s.start > 8
    ]
    if not parts:
        return 0.0
    magnitude = np.sort(np.abs(np.concatenate(parts)))
    # by number and not by value: those of a quantised channel are whole steps, and rounding would
    # decide which of the equal ones lie over a limit
    smallest = magnitude[: int(KEPT * (len(magnitude) - 1)) + 1]
    return float(np.sqrt(np.mean(smallest**2)) / CUT_DEVIATION)


def spaced_levels(
    values: FloatArray,
    segments: Sequence[slice],
    level: float,
    spacings: Sequence[int],
    there: npt.NDArray[np.bool_] | None = None,
) -> list[float]:
    """`noise_level` of even samples from fourth differences over several spacings.

    The longer they are, the more of them hold a jump of the motion: what stands far out over one
    spacing is left out over all longer ones.

    Parameters
    ----------
    values : (n,) array
    segments : sequence of slice
    level : float
        Over one sample.
    spacings : sequence of int
        Increasing.
    there : (n,) bool array, optional
        Samples that were measured: a difference that holds another one does not count.

    Returns
    -------
    list of float
        Zero from the spacing on over which too few are left.
    """
    jumps = np.zeros(len(values))
    there = np.ones(len(values), dtype=bool) if there is None else there
    _mark(jumps, values, segments, 1, JUMP * level)
    out = []
    for spacing in spacings:
        long = [s for s in segments if s.stop - s.start > 8 * spacing]
        left = [
            _spaced(values[s], spacing)[_clear(jumps[s], 4 * spacing) & _five(there[s], spacing)]
            for s in long
        ]
        squares = np.concatenate([*left, np.empty(0)]) ** 2
        share = _share_of_five(there, long, spacing)
        if not len(squares) or len(squares) < FEWEST_LEFT * share * len(values):
            break
        count = int(KEPT * (len(squares) - 1)) + 1
        smallest = np.partition(squares, count - 1)[:count]
        out.append(float(np.sqrt(np.mean(smallest)) / CUT_DEVIATION))
        _mark(jumps, values, segments, spacing, JUMP * out[-1])
    return out + [0.0] * (len(spacings) - len(out))


def _spaced(x: FloatArray, m: int) -> FloatArray:
    """Fourth differences over m samples, scaled to unit noise gain."""
    second = x[: -2 * m] - 2 * x[m:-m] + x[2 * m :]
    return np.asarray(
        (second[: -2 * m] - 2 * second[m:-m] + second[2 * m :]) / np.sqrt(FOURTH_GAIN),
        dtype=np.float64,
    )


def _five(there: npt.NDArray[np.bool_], m: int) -> npt.NDArray[np.bool_]:
    """Where all five samples of a fourth difference over m samples were measured."""
    count = len(there) - 4 * m
    found = np.all([there[k * m : k * m + count] for k in range(5)], axis=0)
    return np.asarray(found, dtype=np.bool_)


def _share_of_five(there: npt.NDArray[np.bool_], segments: Sequence[slice], m: int) -> float:
    """Share of the fourth differences over m samples whose five samples were measured."""
    found = [_five(there[s], m) for s in segments if s.stop - s.start > 4 * m]
    return float(np.mean(np.concatenate(found))) if found else 0.0


def _mark(
    jumps: FloatArray, values: FloatArray, segments: Sequence[slice], m: int, limit: float
) -> None:
    """Mark the middle of the differences over m samples that stand over a limit."""
    for s in segments:
        if s.stop - s.start > 8 * m:
            over = np.abs(_spaced(values[s], m)) > limit
            jumps[s.start + 2 * m : s.stop - 2 * m][over] = 1.0


def _clear(jumps: FloatArray, length: int) -> npt.NDArray[np.bool_]:
    """Which stretches of so many steps hold no mark."""
    total = np.concatenate([[0.0], np.cumsum(jumps)])
    return np.asarray(total[length + 1 :] == total[: -length - 1])


_LEVELS: Final[WeakKeyDictionary[Record, dict[tuple[str, float], ChannelNoise]]] = (
    WeakKeyDictionary()
)


def noise_of(record: Record, signal: str, values: FloatArray, ratio: float) -> ChannelNoise:
    """Noise of a signal made from a record, estimated once per record, signal and gear ratio; its
    colour is read where the stamps are even.

    Parameters
    ----------
    record : Record
    signal : str
        Name of the signal.
    values : (n,) array
        The signal, which must follow from record, name and gear ratio.
    ratio : float
        Gear ratio by which it is referred to the link.
    """
    known = _LEVELS.setdefault(record, {})
    if (signal, ratio) not in known:
        known[signal, ratio] = _estimated(record, values)
    return known[signal, ratio]


def _estimated(record: Record, values: FloatArray) -> ChannelNoise:
    """Noise of a signal, from differences that hold no bridged sample: a bridge is smoother than a
    reading.
    """
    segments, there = tuple(record.segments()), record.measured
    if there is None:
        there = np.ones(len(values), dtype=bool)
    edges = np.concatenate([[0], np.cumsum([int(there[s].sum()) for s in segments])]).tolist()
    dense = tuple(slice(a, b) for a, b in pairwise(edges))
    level = noise_level(values[there], dense, record.time[there])
    steps = np.concatenate([np.diff(record.time[s]) for s in segments] or [np.empty(0)])
    even = len(steps) > 0 and np.ptp(steps) <= EVEN * float(np.median(steps))
    if not even or level <= 0:
        return white(level)
    dt, longest = float(np.median(steps)), max(segments, key=lambda s: s.stop - s.start)
    share = _share_of_five(there, segments, 1)
    if share < 1:
        # differences across a gap reach further, and those of noise with a memory are larger there
        level = spaced_levels(values, segments, level, [1], there)[0] or level
    further = spaced_levels(values, segments, level, spacings_of(dt)[1:], there)
    return coloured(values, longest, dt, [level, *further], share)


def _fourth(x: FloatArray, time: FloatArray | None) -> FloatArray:
    """Fourth differences, scaled to unit noise gain: zero for a cubic course over the stamps."""
    steps = np.ones(1) if time is None else np.diff(time)
    if time is None or np.ptp(steps) <= EVEN * float(np.median(steps)) or steps.min() <= 0:
        return np.asarray(np.diff(x, 4) / np.sqrt(FOURTH_GAIN), dtype=np.float64)
    count = len(x) - 4
    stamps = [time[i : i + count] for i in range(5)]
    total, power = np.zeros(count), np.zeros(count)
    for i in range(5):
        weight = np.ones(count)
        for k in range(5):
            if k != i:
                weight *= (stamps[i] - stamps[k]) / float(np.median(steps))
        total += x[i : i + count] / weight
        power += weight**-2
    return np.asarray(total / np.sqrt(power), dtype=np.float64)


def effective_share(residual: FloatArray) -> float:
    """Share of rows that count as independent (initial positive sequence of the
    autocorrelation).
    """
    x = residual - residual.mean()
    power = float(x @ x)
    if power <= 0:
        return 1.0
    total = 1.0
    for lag in range(1, min(LONGEST_LAG, len(x) - 1)):
        rho = float(x[:-lag] @ x[lag:]) / power
        if rho < UNCORRELATED:
            break
        total += 2 * rho
    return 1.0 / total
