"""Measurement noise from the record itself, without a data sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from identification.balance.colour import (
    FEWEST_SPACINGS,
    ChannelNoise,
    coloured,
    spacings_of,
    white,
)
from identification.data.check.quanta import quantum
from identification.data.record import Record

FloatArray = npt.NDArray[np.float64]

EVEN: Final = 0.02
"""Range of the steps, as a share of the period, up to which stamps count as even: the balances'
kernels do not see it. What a motion does between such stamps is noise of the rows.
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
"""Share of the differences of measured, calm samples in which no jump must be: the level of fewer
is no level of all."""
FEWEST_READ: Final = 100
"""Differences from which a level is read: to 7 %."""

CALM: Final = 0.4
"""Share of the samples at which a joint moves, those with the least acceleration, that are calm: of
40 s at 100 Hz some 1000 are left around which nothing else is."""
BEND: Final = 0.02
"""Time on either side over which a position tells the acceleration [s]: an encoder's noise is
smaller than that of most motions then."""
AROUND: Final = 0.1
"""Time over which it is averaged [s]: that of a fourth difference that reaches farthest."""
NOISE_BEND: Final = (1.95, 1.5)
"""Mean size of the second difference of white noise, root of 12 over pi, in units of the noise; and
two standard errors of a mean of such sizes, as a share of it, times the root of their number."""
TIE: Final = 1e-14
"""Share of a position below which differences of it are alike: some roundings of it."""
MOVING: Final = 0.05
"""Share of the usual speed from which a joint moves: at rest a reading may stand on one step."""

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
    measured: npt.NDArray[np.bool_] | None = None,
    calm: npt.NDArray[np.bool_] | None = None,
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
    measured : (n,) bool array, optional
        False where a lost sample is bridged: such a value is in no difference that counts.
    calm : (n,) bool array, optional
        Samples at which the joint is calm: a difference that counts reaches over no other.

    Returns
    -------
    list of float
        Zero from the spacing on over which too few are left.
    """
    elsewhere = np.zeros(len(values)) if calm is None else (~calm).astype(np.float64)
    jumps = elsewhere.copy()
    before = {s.start: _marks_before(elsewhere[s]) for s in segments}
    _mark(jumps, values, segments, 1, JUMP * level)
    out = []
    for spacing in spacings:
        of_use, left = 0, [np.empty(0)]
        for s in segments:
            if s.stop - s.start > 8 * spacing:
                usable = _clear(before[s.start], 4 * spacing)
                if measured is not None:
                    usable = usable & _all_there(measured[s], spacing)
                of_use += int(usable.sum())
                own = usable & _clear(_marks_before(jumps[s]), 4 * spacing)
                left.append(_spaced(values[s], spacing)[own])
        squares = np.concatenate(left) ** 2
        if len(squares) < max(FEWEST_LEFT * of_use, FEWEST_READ):
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


def _mark(
    jumps: FloatArray, values: FloatArray, segments: Sequence[slice], m: int, limit: float
) -> None:
    """Mark the middle of the differences over m samples that stand over a limit."""
    for s in segments:
        if s.stop - s.start > 8 * m:
            over = np.abs(_spaced(values[s], m)) > limit
            jumps[s.start + 2 * m : s.stop - 2 * m][over] = 1.0


def _all_there(measured: npt.NDArray[np.bool_], m: int) -> npt.NDArray[np.bool_]:
    """Which differences over m samples are of five measured ones."""
    count = len(measured) - 4 * m
    return np.asarray(np.all([measured[k * m : k * m + count] for k in range(5)], axis=0))


def _marks_before(jumps: FloatArray) -> FloatArray:
    """Sum of the marks before each sample and at the end."""
    return np.concatenate([[0.0], np.cumsum(jumps)]) if jumps.any() else np.zeros(len(jumps) + 1)


def _clear(before: FloatArray, length: int) -> npt.NDArray[np.bool_]:
    """Which stretches of so many steps hold no mark, from the marks before each sample."""
    return np.asarray(before[length + 1 :] == before[: -length - 1])


_LEVELS: Final[WeakKeyDictionary[Record, dict[tuple[str, float], ChannelNoise]]] = (
    WeakKeyDictionary()
)
_CALM: Final[WeakKeyDictionary[Record, dict[float, npt.NDArray[np.bool_]]]] = WeakKeyDictionary()


def noise_of(
    record: Record,
    signal: str,
    values: FloatArray,
    ratio: float,
    position: FloatArray | None = None,
) -> ChannelNoise:
    """Noise of a signal made from a record, estimated once per record, signal and gear ratio; its
    colour is read where the stamps are even, the step of a position from its values.

    Parameters
    ----------
    record : Record
    signal : str
        Name of the signal.
    values : (n,) array
        The signal, which must follow from record, name and gear ratio.
    ratio : float
        Gear ratio by which it is referred to the link.
    position : (n,) array, optional
        Of a torque: where the joint is. Its noise is read where the joint is calm, if it is.
    """
    known = _LEVELS.setdefault(record, {})
    if (signal, ratio) not in known:
        stretches, time, there = tuple(record.segments()), record.time, record.measured
        steps = np.concatenate([np.diff(time[s]) for s in stretches] or [np.empty(0)])
        even = len(steps) > 0 and np.ptp(steps) <= EVEN * float(np.median(steps))
        level = 0.0
        if even and there is not None and not there.all():
            # a difference across a hole is as long as several: of a motion it holds more
            (level,) = spaced_levels(values, stretches, np.inf, [1], there)
        level = level or noise_level(values, stretches, time)
        known[signal, ratio] = white(level)
        dt = float(np.median(steps)) if even else 0.0
        if even and level > 0:
            further = spaced_levels(values, stretches, level, spacings_of(dt)[1:], there)
            longest = max(stretches, key=lambda s: s.stop - s.start)
            samples = sum(s.stop - s.start for s in stretches)
            known[signal, ratio] = coloured(values, longest, dt, [level, *further], samples)
        if even and position is not None and level > 0:
            known_calm = _CALM.setdefault(record, {})
            if ratio not in known_calm:
                known_calm[ratio] = calm_of(position, stretches, dt)
            found = _where_calm(values, known_calm[ratio], stretches, dt, there)
            known[signal, ratio] = found or known[signal, ratio]
        if signal.endswith("position") and record.has(signal):
            step = quantum(values)
            if signal in record.quanta:
                step = record.quanta[signal] / (abs(ratio) if signal == "motor_position" else 1.0)
            known[signal, ratio] = known[signal, ratio].read_in(step or 0.0)
    return known[signal, ratio]


def _where_calm(
    values: FloatArray,
    calm: npt.NDArray[np.bool_],
    stretches: Sequence[slice],
    dt: float,
    there: npt.NDArray[np.bool_] | None,
) -> ChannelNoise | None:
    """Noise of a channel read where the joint moves evenly; None where that is too short."""
    spacings = spacings_of(dt, calm=True)
    levels = spaced_levels(values, stretches, np.inf, spacings, there, calm)
    if sum(1 for x in levels if x > 0) < min(FEWEST_SPACINGS, len(spacings)):
        return None
    longest = max(stretches, key=lambda s: s.stop - s.start)
    samples = int(np.sum(calm if there is None else calm & there))
    return coloured(values, longest, dt, levels, samples, calm=True)


def calm_of(position: FloatArray, stretches: Sequence[slice], dt: float) -> npt.NDArray[np.bool_]:
    """Samples (n,) at which a joint moves with little acceleration."""
    apart, width = max(1, round(BEND / dt)), max(1, round(AROUND / dt))
    bend, speed = np.full(len(position), np.inf), np.zeros(len(position))
    for s in stretches:
        q = position[s]
        if len(q) <= 2 * apart + width:
            continue
        inner = slice(s.start + apart, s.stop - apart)
        bent = np.abs(q[2 * apart :] - 2 * q[apart:-apart] + q[: -2 * apart])
        bend[inner] = np.convolve(bent, np.full(width, 1 / width), "same")
        speed[inner] = np.abs(q[2 * apart :] - q[: -2 * apart])
    # whole steps of an encoder stand at the very limits: rounding would decide of each alone
    slack = TIE * float(np.abs(position).max(initial=0.0))
    usual = float(np.median(speed[speed > slack])) if np.any(speed > slack) else 0.0
    moving = speed > MOVING * usual + slack
    if not moving.any():
        return moving
    # a bend that the encoder's own noise makes is none, and would cut an even motion to pieces
    mean, spread = NOISE_BEND
    even = mean * (1 + spread / math.sqrt(width)) * noise_level(position, tuple(stretches))
    limit = max(float(np.quantile(bend[moving], CALM)), even)
    return np.asarray(moving & (bend <= limit + slack))


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
