"""Time stamps of a logger: late stamps and lost samples, and the record on an even grid.

A logger takes samples evenly and stamps them late, or it takes them when it gets to it and stamps
them right; it loses some. Each stamp gets the number of its slot on the logger's own clock, whose
period comes from the stamps. Which of the two it is, the positions tell: a motion is smooth over
the true times. Holes shorter than half the kernel of the balances are bridged, longer ones cut the
record.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.noise import EVEN, noise_level
from identification.balance.weak import CLAIM_KERNEL, KERNEL_SAMPLES
from identification.data.check.quanta import quantum

if TYPE_CHECKING:
    from identification.data.record import Record

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

CLEAR: Final = 0.3
"""Length of the mean phasor of the stamps from which their slots are told: jitter of a quarter
of a period has 0.29.
"""
CHANCE: Final = 3.0
"""Length of the mean phasor of n stamps without a clock, times the root of n, that chance leaves
one time in eight thousand (exp(-9)).
"""
LOCAL: Final = 129
"""Stamps over which the logger's clock is followed: clocks drift slowly."""
CLEARLY: Final = 0.05
"""Logarithm of how much smoother a motion must be over the stamps: noise levels scatter by half
a per cent.
"""
STANDS_FOR: Final = 0.75
"""Distance to a sample, in periods, up to which it stands for a grid point: beside a lost
sample the nearest is one away.
"""
AROUND: Final = 60
"""Samples on either side whose median tells a repeated stamp from a surplus row: with a fifth of
the stamps repeated it errs once in some million rows."""
ALONE: Final = 1.5
"""Steps, in medians, up to which no sample is missing."""
REGULAR: Final = 0.2
"""Deviation of nine steps in ten from the median, in medians, below which a step of one and a
half is a hole.
"""
MADE_GOOD: Final = -0.2
"""Correlation of neighbouring steps: -0.5 for a clock whose stamps are late by chance, 0 for
steps drawn one by one.
"""
PAUSE: Final = 5.0
"""Periods from which a step is a hole where the slots cannot be told: six deviations of a
jitter of 0.7 periods.
"""
SAMPLES: Final = 6
"""Samples, half on either side, whose cubic bridges a hole: two more than a cubic has unknowns,
so that noise does not swing it.
"""
BESIDE: Final = 3
"""Samples on either side of a lost one that are bridged as it was, to see by how much that errs: as
far as the samples of its own cubic reach."""
TOLD: Final = 3.0
"""Square of such errors over that of noise from which they are more than noise: the mean of five
squares of normal values is so large one time in a hundred."""
_LAGS: Final = (4, 16, 64, 256, 1024)
_SLOW: Final = ("run", "temperature")


@final
@dataclass(frozen=True)
class Slots:
    """Where each sample of a record belongs on its logger's clock.

    Attributes
    ----------
    period : float
        Of the clock [s].
    number : (n,) int array
        Slot of each sample, from 0 in each segment; a step over one means lost samples.
    keep : (n,) bool array
        False for a sample that has no slot of its own: a frame that was written twice.
    time : (n,) array
        When each sample was taken [s]: its slot's time where the samples are even, else its stamp.
    jitter : float
        95 % quantile of the distance between stamps and slots, as a share of the period.
    latest : float
        The largest one.
    in_slots : bool
        True where the samples are even and the stamps are not; else each sample was taken at its
        stamp.
    """

    period: float
    number: IntArray
    keep: BoolArray
    time: FloatArray
    jitter: float
    latest: float
    in_slots: bool

    def holes(self, segment: IntArray) -> tuple[IntArray, IntArray]:
        """Rows after a hole, and how many samples are missing before each."""
        rows = np.flatnonzero(self.keep)
        missing = np.where(np.diff(segment[rows]) == 0, np.diff(self.number[rows]) - 1, 0)
        found = np.flatnonzero(missing > 0)
        return rows[found + 1].astype(np.int64), missing[found].astype(np.int64)


def longest_hole(period: float) -> int:
    """Samples that may be missing in a row and still be bridged: half the kernel of the
    balances.
    """
    return int(max(CLAIM_KERNEL, KERNEL_SAMPLES * period) / 2.0 / period + 1e-9)


def slots_of(record: Record) -> Slots | None:
    """Slots of a record's samples; None where its stamps are even, or nothing can be said.

    Parameters
    ----------
    record : Record
        With finite stamps that do not decrease within a segment.
    """
    parts = record.segments()
    steps = record.steps()
    positive = steps[np.isfinite(steps) & (steps > 0.0)]
    if (
        positive.size < SAMPLES
        or positive.size < steps.size / 2
        or not np.isfinite(steps).all()
        or (steps < 0.0).any()
    ):
        return None
    usual = float(np.median(positive))
    if float(np.ptp(steps)) <= EVEN * usual:
        return None
    longest = record.time[max(parts, key=lambda s: s.stop - s.start)]
    # stamps in whole milliseconds of a clock of 2.5 ms step by 2 and 3: their median is no period,
    # their mean is
    guesses = (usual, float(np.mean(positive[positive <= ALONE * usual])))
    period = max(
        (_period(longest, guess) for guess in guesses), key=lambda guess: _coherence(longest, guess)
    )
    again = _same_as_before(record)
    found = [
        None if _wanders(longest, period) else _in_stretches(record.time[part], period, again[part])
        for part in parts
    ]
    told = all(f is not None for f in found)
    if not told:
        period = usual
        found = [_from_stamps(record.time[part], period) for part in parts]
    number, off = (np.concatenate([f[i] for f in found if f is not None]) for i in range(2))
    number = number.astype(np.int64)
    keep = np.ones(len(record), dtype=np.bool_)
    keep[1:] = (np.diff(number) > 0) | (np.diff(record.segment) != 0)
    off = np.abs(off[keep])
    slots = Slots(
        period,
        number,
        keep,
        record.time,
        float(np.quantile(off, 0.95)),
        float(off.max()),
        in_slots=False,
    )
    even = np.concatenate(
        [
            period * number[part] + np.median(record.time[part] - period * number[part])
            for part in parts
        ]
    )
    return (
        replace(slots, time=even, in_slots=True)
        if told and _smoother(record, slots, even)
        else slots
    )


def _period(time: FloatArray, period: float) -> float:
    """Period of a clock from the phases of long differences: lost samples are whole periods and
    do not count [s].
    """
    for lag in _LAGS:
        if lag > len(time) // 4:
            break
        apart = time[lag:] - time[:-lag]
        phasor = complex(np.mean(np.exp(2j * np.pi * apart / period)))
        if abs(phasor) < CHANCE / np.sqrt(len(apart)):
            break
        period *= 1.0 + float(np.angle(phasor)) / (2.0 * np.pi * float(np.median(apart)) / period)
    return period


def _local_phasor(time: FloatArray, period: float) -> npt.NDArray[np.complex128]:
    """Mean phasor of the stamps around each one: its angle is the phase of the clock, its
    length 1 without jitter.
    """
    window = np.ones(min(LOCAL, len(time)))
    around = np.convolve(np.ones(len(time)), window, "same")
    return np.asarray(
        np.convolve(np.exp(2j * np.pi * (time - time[0]) / period), window, "same") / around
    )


def _wanders(time: FloatArray, period: float) -> bool:
    """True where the steps are drawn one by one, as by a loop that waits: a late step is not
    made good by an early one.
    """
    off = np.diff(time) / period - 1.0
    both = (np.abs(off[1:]) < 0.5) & (np.abs(off[:-1]) < 0.5)
    first, second = off[:-1][both], off[1:][both]
    if first.size < LOCAL or float(np.std(first)) <= EVEN / 2:
        return False
    return float(np.corrcoef(first, second)[0, 1]) > MADE_GOOD


def _coherence(time: FloatArray, period: float) -> float:
    """How well stamps keep to a clock: 1 without jitter, near 0 where they have nothing to do
    with it.
    """
    return float(np.median(np.abs(_local_phasor(time, period))))


def _same_as_before(record: Record) -> BoolArray:
    """Samples that repeat the one before in every channel and in the stamp: a frame that was
    written twice.
    """
    out = np.zeros(len(record), dtype=np.bool_)
    out[1:] = np.diff(record.time) == 0.0
    for values in record.channels.values():
        out[1:] &= values[1:] == values[:-1]
    return out


def _in_stretches(
    time: FloatArray, period: float, again: BoolArray
) -> tuple[IntArray, FloatArray] | None:
    """As `_followed`, stretch by stretch between pauses after which the clock may have another
    phase.
    """
    pauses = np.flatnonzero(np.diff(time) > (longest_hole(period) + ALONE) * period) + 1
    edges = [0, *pauses.tolist(), len(time)]
    numbers, off = [], []
    last = -1
    for first, stop in zip(edges[:-1], edges[1:], strict=True):
        found = _followed(time[first:stop], period, again[first:stop])
        if found is None:
            return None
        gap = round((time[first] - time[first - 1]) / period) if first else 1
        numbers.append(found[0] + last + gap)
        off.append(found[1])
        last = int(numbers[-1][-1])
    return np.concatenate(numbers), np.concatenate(off)


def _followed(
    time: FloatArray, period: float, again: BoolArray
) -> tuple[IntArray, FloatArray] | None:
    """Slot numbers, and how far each stamp is off its slot [periods], of one segment; None
    where the stamps scatter too much.
    """
    from scipy.optimize import isotonic_regression

    count = len(time)
    place = (time - time[0]) / period
    phasor = _local_phasor(time, period)
    if float(np.median(np.abs(phasor))) < CLEAR:
        return None
    offset = np.unwrap(np.angle(phasor)) / (2.0 * np.pi)
    on_clock = place - offset
    rows = np.arange(count)
    rows = rows - np.cumsum(again)
    rows = rows - np.cumsum(_surplus(time, on_clock - rows) & ~again)
    # a late stamp is followed by early steps: slots never go back, and the least change that keeps
    # this tells late from lost
    number = (rows + np.round(isotonic_regression(on_clock - rows).x)).astype(np.int64)
    number -= number[0]
    off = on_clock - number
    return number, off - np.round(np.median(off))


def _surplus(time: FloatArray, ahead: FloatArray) -> BoolArray:
    """Rows whose stamp repeats the one before and after which there is a row more than the
    clock has slots.
    """
    out = np.zeros(len(time), dtype=np.bool_)
    for row in np.flatnonzero(np.diff(time) == 0.0) + 1:
        before, after = ahead[max(row - AROUND, 0) : row], ahead[row + 1 : row + 1 + AROUND]
        out[row] = len(after) > 0 and float(np.median(after)) < float(np.median(before)) - 0.5
    return out


def _from_stamps(time: FloatArray, period: float) -> tuple[IntArray, FloatArray]:
    """Slot numbers where stamps scatter, a sample each with holes only at steps that no jitter
    makes; and how far steps are off.
    """
    steps = np.diff(time) / period
    positive = steps[steps > 0.0]
    spread = float(np.quantile(np.abs(positive - 1.0), 0.9)) if positive.size else 1.0
    limit = ALONE if spread < REGULAR else PAUSE
    missing = np.where(steps > limit, np.round(steps) - 1.0, 0.0)
    number = np.concatenate([[0.0], np.cumsum((steps > 0.0) + missing)]).astype(np.int64)
    return number, np.concatenate([[0.0], np.where(steps > limit, 0.0, np.abs(steps - 1.0))])


def _smoother(record: Record, slots: Slots, even: FloatArray) -> bool:
    """True unless the positions are clearly smoother over the stamps than over the slots'
    times: samples were even, stamps late.
    """
    if slots.latest <= EVEN:
        return True
    channels = [c for c in ("motor_position", "link_position") if c in record.channels]
    channels = channels or [c for c in record.channels if c not in _SLOW]
    edges = np.flatnonzero(np.diff(record.segment[slots.keep])) + 1
    bounds = [0, *edges.tolist(), int(slots.keep.sum())]
    parts = [slice(a, b) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    total = 0.0
    for channel in channels:
        values = record[channel][slots.keep]
        if not np.isfinite(values).all():
            continue
        over_slots = noise_level(values, tuple(parts), even[slots.keep])
        over_stamps = noise_level(values, tuple(parts), record.time[slots.keep])
        if over_slots > 0.0 and over_stamps > 0.0:
            total += np.log(over_slots / over_stamps)
    return total <= CLEARLY


def evened(record: Record) -> Record:
    """The record on an even grid: late stamps put right, short holes bridged, cut at the longer
    ones.

    Values between samples come from a cubic through the three samples on either side, by least
    squares; ``run`` is kept and ``temperature`` joined by straight lines. Samples of the result
    that no sample of the record stands for are told by `Record.measured`.

    Returns
    -------
    Record
        The same one where its stamps are even.
    """
    slots = slots_of(record)
    if slots is None:
        return record
    most = longest_hole(slots.period)
    after, missing = slots.holes(record.segment)
    segment = _cut(record, slots, most)
    long, lost = int(np.sum(missing > most)), int(np.sum(missing[missing <= most]))
    notes = (
        []
        if not long
        else [
            f"split_at_gaps: {long} hole(s) of over {most} samples, first before row "
            f"{int(after[missing > most][0]) + 1}"
        ]
    )
    if not slots.keep.all():
        notes.append(
            f"drop_repeated_stamps: {int((~slots.keep).sum())} row(s), first row "
            f"{int(np.argmin(slots.keep)) + 1}"
        )
    kept = _Kept(record, slots, segment)
    if lost == 0 and slots.latest <= EVEN:
        return replace(
            record.take(slots.keep),
            segment=segment[slots.keep],
            provenance=record.provenance.noted(*notes),
        )
    if lost:
        notes.append(
            f"bridge_lost_samples: {lost} sample(s) in {int(np.sum(missing <= most))} hole(s), "
            "by cubics"
        )
    if slots.latest > EVEN:
        how = "each sample in its own slot" if slots.in_slots else "by cubics between the stamps"
        notes.append(
            f"resample_jitter: step {slots.period:.6g} s, {how}; jitter {100 * slots.jitter:.2g} "
            f"%, at most {100 * slots.latest:.2g} %"
        )
    return kept.on_grid(notes)


def cut_at_holes(record: Record, most: int | None = None) -> Record:
    """The record as it is, with a new segment after every hole of more than `most` samples
    (half a kernel by default).
    """
    slots = slots_of(record)
    if slots is None:
        return record
    return replace(
        record, segment=_cut(record, slots, longest_hole(slots.period) if most is None else most)
    )


def _cut(record: Record, slots: Slots, most: int) -> IntArray:
    after, missing = slots.holes(record.segment)
    cut = np.zeros(len(record), dtype=np.int64)
    cut[after[missing > most]] = 1
    return np.asarray(record.segment + np.cumsum(cut))


@final
@dataclass(frozen=True)
class _Kept:
    """A record with its slots, cut at long holes."""

    record: Record
    slots: Slots
    segment: IntArray

    def on_grid(self, notes: list[str]) -> Record:
        rows = np.flatnonzero(self.slots.keep)
        segment = self.segment[rows]
        edges = np.concatenate([[0], np.flatnonzero(np.diff(segment)) + 1, [len(rows)]])
        fast = [c for c in self.record.channels if c not in _SLOW]
        table = (
            np.column_stack([self.record[c] for c in fast])
            if fast
            else np.zeros((len(self.record), 0))
        )
        times, numbers, measured, values = [], [], [], []
        slow: dict[str, list[FloatArray]] = {c: [] for c in self.record.channels if c in _SLOW}
        ages: list[FloatArray] = []
        for k, (first, last) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
            own = rows[first:last]
            grid, there = self._grid(own)
            times.append(grid)
            numbers.append(np.full(len(grid), k, dtype=np.int64))
            measured.append(there >= 0)
            values.append(
                bridged(
                    self.slots.time[own],
                    table[own],
                    grid,
                    there,
                    moved=not self.slots.in_slots,
                )
            )
            for c, parts in slow.items():
                near = np.clip(
                    np.searchsorted(self.slots.time[own], grid + 1e-9, side="right") - 1,
                    0,
                    len(own) - 1,
                )
                line = np.interp(grid, self.slots.time[own], self.record[c][own])
                parts.append(self.record[c][own][near] if c == "run" else line)
            if self.record.age is not None:
                ages.append(np.interp(grid, self.slots.time[own], self.record.age[own]))
        joined = np.concatenate(values)
        channels = {c: joined[:, i] for i, c in enumerate(fast)} | {
            c: np.concatenate(parts) for c, parts in slow.items()
        }
        return replace(
            self.record,
            time=np.concatenate(times),
            channels={c: channels[c] for c in self.record.channels},
            segment=np.concatenate(numbers),
            age=np.concatenate(ages) if ages else None,
            measured=np.concatenate(measured),
            quanta={
                c: step
                for c in fast
                if c.endswith("position") and (step := quantum(self.record[c])) is not None
            },
            provenance=self.record.provenance.noted(*notes),
        )

    def _grid(self, own: IntArray) -> tuple[FloatArray, IntArray]:
        """Even times of one stretch and, for each, its sample (its place in `own`); -1 where it
        was lost.
        """
        time, period = self.slots.time[own], self.slots.period
        if self.slots.in_slots:
            number = self.slots.number[own] - self.slots.number[own[0]]
            grid = time[0] + period * np.arange(int(number[-1]) + 1)
            there = np.full(len(grid), -1, dtype=np.int64)
            there[number] = np.arange(len(own))
            return grid, there
        grid = time[0] + period * np.arange(
            int((time[-1] - time[0]) / period * (1.0 + 1e-12) + 1e-9) + 1
        )
        after = (
            np.clip(np.searchsorted(time, grid), 1, max(len(time) - 1, 1))
            if len(time) > 1
            else np.zeros(len(grid), dtype=np.int64)
        )
        nearest = (
            after - (np.abs(grid - time[after - 1]) < np.abs(time[after] - grid))
            if len(time) > 1
            else after
        )
        return grid, np.where(
            np.abs(time[nearest] - grid) <= STANDS_FOR * period, nearest, -1
        ).astype(np.int64)


def bridged(
    time: FloatArray,
    table: FloatArray,
    grid: FloatArray,
    there: IntArray,
    *,
    moved: bool = False,
) -> FloatArray:
    """Values on a grid: those of the samples that are there, cubics through their neighbours for
    the others.

    A sample beside its grid point is taken along the cubic from where it is to that point: its
    noise stays what it is, which the cubic itself would smooth.

    Parameters
    ----------
    time : (n,) array
    table : (n, channels) array
    grid : (m,) array
    there : (m,) int array
        Row of the sample that stands for a grid point; -1 for none.
    moved
        Whether such samples are beside their points, by less than a step.

    Returns
    -------
    (m, channels) array
    """
    out = np.empty((len(grid), table.shape[1]))
    out[there >= 0] = table[there[there >= 0]]
    open_ = np.flatnonzero(there < 0)
    if moved:
        beside = np.flatnonzero(there >= 0)
        own = there[beside]
        out[beside] += _cubic(time, table, grid[beside]) - _cubic(
            time, table, time[own], grid[beside]
        )
    if open_.size:
        out[open_] = _cubic(time, table, grid[open_])
    return out


def bridged_over(values: FloatArray, lost: BoolArray, segments: tuple[slice, ...]) -> FloatArray:
    """Values on an even grid (n,) with cubics through their neighbours in the place of those that
    are `lost`, as the readings were bridged.
    """
    out = values.copy()
    for part in segments:
        there, open_ = np.flatnonzero(~lost[part]), np.flatnonzero(lost[part])
        if open_.size and len(there) >= SAMPLES:
            known = values[part][there, None]
            at = open_.astype(np.float64)
            out[part][open_] = _cubic(there.astype(np.float64), known, at)[:, 0]
    return out


def bridge_errors(
    values: FloatArray, measured: BoolArray, segments: tuple[slice, ...], level: float
) -> FloatArray:
    """Standard deviation by which bridged samples may be off beside the noise of a reading, (n,);
    0 for measured ones.

    A cubic rounds a corner off. Samples beside a lost one that are there are bridged as it was,
    from samples as far away, and what that is off by is held against their noise.

    Parameters
    ----------
    values : (n,) array
        A signal on an even grid, lost samples bridged.
    measured : (n,) bool array
        False for those.
    segments : tuple of slice
        Contiguous stretches.
    level : float
        Noise of a reading.
    """
    out = np.zeros(len(values))
    for part in segments:
        x, there = values[part], np.flatnonzero(measured[part])
        lost = np.flatnonzero(~measured[part])
        if not lost.size or len(there) < SAMPLES:
            continue
        first = np.clip(np.searchsorted(there, lost) - SAMPLES // 2, 0, len(there) - SAMPLES)
        apart = there[first[:, None] + np.arange(SAMPLES)] - lost[:, None]
        width = np.abs(apart).max(axis=1, keepdims=True)
        basis = (apart / width)[:, :, None] ** np.arange(4)
        weights = np.linalg.pinv(basis)[:, 0]  # of the samples in the cubic at the lost one
        power, count = np.zeros(len(lost)), np.zeros(len(lost))
        for step in (k for k in range(-BESIDE, BESIDE + 1) if k):
            at = lost + step
            far = at[:, None] + apart
            good = (far.min(axis=1) >= 0) & (far.max(axis=1) < len(x)) & (at >= 0) & (at < len(x))
            good[good] &= measured[part][at[good]]
            error = x[at[good]] - np.sum(weights[good] * x[far[good]], axis=1)
            power[good] += error**2
            count[good] += 1
        noise = level**2 * (1 + np.sum(weights**2, axis=1))
        mean = power / np.maximum(count, 1)
        out[part][lost] = np.sqrt(np.where(mean > TOLD * noise, mean - noise, 0.0))
    return out


def _cubic(
    time: FloatArray, table: FloatArray, at: FloatArray, around: FloatArray | None = None
) -> FloatArray:
    """Values at times (m,) of the cubics through the samples around them (or `around` others),
    (m, channels).
    """
    middle = at if around is None else around
    count = min(SAMPLES, len(time))
    degree = min(3, count - 1)
    first = np.clip(np.searchsorted(time, middle) - count // 2, 0, len(time) - count)
    near = first[:, None] + np.arange(count)
    apart = time[near] - at[:, None]
    basis = (apart / np.maximum(np.abs(apart).max(axis=1), 1e-300)[:, None])[
        :, :, None
    ] ** np.arange(degree + 1)
    gram = np.swapaxes(basis, 1, 2) @ basis
    unit = np.zeros((len(at), degree + 1, 1))
    unit[:, 0] = 1.0
    weights = (basis @ np.linalg.solve(gram, unit))[:, :, 0]
    return np.asarray(np.einsum("gk,gkc->gc", weights, table[near]))
