"""Checks of the time stamps: finite, increasing, regular, without gaps, in seconds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from identification.balance.noise import EVEN
from identification.balance.stamps import Slots, longest_hole, slots_of
from identification.data.check.finding import Finding, at

if TYPE_CHECKING:
    import numpy.typing as npt

    from identification.data.record import Record

MINIMUM_SAMPLES: Final = 10
"""Samples below which nothing can be said of noise: its fourth differences take nine."""
_WITHOUT_TIME: Final = 0.1
"""Share of rows without a time above which the export is at fault, not a row."""
_REPEATED_LIMIT: Final = 1 / 3
"""Share of repeated stamps above which the median step may be no period of the clock any more."""
_REGULAR: Final = 0.2
"""Spread of the steps, as a share of the median one, up to which a gap of one and a half steps is a
lost sample; uneven stamps need five.
"""
_SLOWEST: Final = 0.5
"""Sampling step [s] from which time is refused: no motion of a joint is seen at two samples a
second, and 2 kHz stamped in ms reads so.
"""
_FASTEST: Final = 2e-6
"""Sampling step [s] below which time is doubted: 1 kHz stamped in s and read as ms is at 1e-6, the
fastest drives log at 1e-5.
"""
MOST_SLOTS: Final = 2.0**53
"""Samples that may be missing at one place: numbers that can be counted one by one."""
FASTEST: Final = 1e-9
"""Step that no logger of a joint has [s]: converters of currents take at least some ten ns."""


def check_size(record: Record) -> list[Finding]:
    """Refuse records without enough samples."""
    count = len(record)
    if count == 0:
        return [Finding("refuse", "empty", f"{record.name}: has no sample: record again")]
    if count == 1:
        return [
            Finding(
                "refuse",
                "one_sample",
                f"{record.name}: has one sample only: record a motion",
                row=0,
            )
        ]
    if count < MINIMUM_SAMPLES:
        message = (
            f"{record.name}: has {count} samples, at least {MINIMUM_SAMPLES} are needed: "
            "record longer"
        )
        return [Finding("refuse", "too_short", message)]
    return []


def check_stamps(record: Record) -> list[Finding]:
    """Find stamps that are not finite, run backwards or are repeated."""
    bad = np.flatnonzero(~np.isfinite(record.time))
    if bad.size:
        message = (
            f"{record.name}: time is not a number in {bad.size} rows, first in row "
            f"{bad[0] + 1}: rows are dropped"
        )
        if bad.size > _WITHOUT_TIME * len(record):
            message = (
                f"{record.name}: time is not a number in {bad.size} of {len(record)} rows: "
                "export time again"
            )
            return [Finding("refuse", "time_nan", message, "time", int(bad[0]))]
        return [Finding("repair", "time_nan", message, "time", int(bad[0]))]
    inside = np.diff(record.segment) == 0
    steps = np.diff(record.time)
    backwards = np.flatnonzero(inside & (steps < 0.0))
    if backwards.size:
        row = int(backwards[0]) + 1
        message = (
            f"{record.name}: time runs backwards at {at(record, row)}, after "
            f"{record.time[row - 1]:.6g} s "
            f"({backwards.size} time(s)): give a run column if these are several runs, else sort "
            "the file by time"
        )
        return [Finding("refuse", "time_decreases", message, "time", row)]
    usual = steps[inside & (steps > 0.0)]
    far = np.flatnonzero(inside & (steps > MOST_SLOTS * np.median(usual))) if usual.size else usual
    if far.size:
        row = int(far[0]) + 1
        message = (
            f"{record.name}: time jumps by {steps[row - 1]:.4g} s at {at(record, row)}: no record "
            "pauses so long, export it again"
        )
        return [Finding("refuse", "time_jumps", message, "time", row)]
    repeated = np.flatnonzero(inside & (steps == 0.0))
    if not repeated.size:
        return [
            Finding(
                "ok", "time_increases", f"{record.name}: time increases in every segment", "time"
            )
        ]
    row = int(repeated[0]) + 1
    share = repeated.size / len(record)
    if share > _REPEATED_LIMIT:
        message = (
            f"{record.name}: {100 * share:.0f} % of the stamps repeat the one before, "
            f"first at {at(record, row)}: write time with more digits"
        )
        return [Finding("refuse", "time_repeated", message, "time", row)]
    message = (
        f"{record.name}: {repeated.size} repeated stamp(s), first at {at(record, row)}: "
        "frames written twice are dropped, others get the time of their slot"
    )
    return [Finding("repair", "time_repeated", message, "time", row)]


def _positive_steps(record: Record) -> npt.NDArray[np.float64]:
    steps = record.steps()
    result: npt.NDArray[np.float64] = steps[np.isfinite(steps) & (steps > 0.0)]
    return result


def gap_limit(record: Record) -> float:
    """Step [s] beyond which a step is a gap: 1.5 median steps, 5 where the sampling is
    irregular anyway.
    """
    steps = _positive_steps(record)
    if not steps.size:
        return float("inf")
    median = float(np.median(steps))
    spread = float(np.percentile(np.abs(steps - median), 90.0)) / median
    return (1.5 if spread < _REGULAR else 5.0) * median


def check_sampling(record: Record) -> list[Finding]:
    """Find lost samples, jitter and an implausible sampling step."""
    steps = _positive_steps(record)
    if not steps.size:
        return []
    slots = slots_of(record)
    dt = slots.period if slots is not None else float(np.median(steps))
    findings = _lost(record, slots) if slots is not None else []
    if slots is None or slots.latest <= EVEN:
        jitter = 0.0 if slots is None else slots.jitter
        findings.append(
            Finding(
                "ok",
                "jitter",
                f"{record.name}: step {dt:.6g} s, jitter {100 * jitter:.2g} %",
                "time",
            )
        )
    else:
        how = "the samples are even, the stamps are not: each sample gets the time of its slot"
        how = (
            how
            if slots.in_slots
            else "the samples are uneven: the record is resampled by cubics between its stamps"
        )
        off = (
            f"up to {100 * slots.latest:.2g} % of a step off (95 % of them at most "
            f"{100 * slots.jitter:.2g} %)"
        )
        message = f"{record.name}: the stamps of a clock of {dt:.4g} s are {off}; {how}"
        findings.append(Finding("repair", "jitter", message, "time"))
    if dt < FASTEST:
        message = f"{record.name}: the sampling step is {dt:.4g} s: correct the unit of time"
        findings.append(Finding("refuse", "time_unit", message, "time"))
    elif dt >= _SLOWEST or dt < _FASTEST:
        unit = "ms" if dt >= _SLOWEST else "s"
        counted = (
            "does time number the samples? give the period of the clock as the scale of this "
            "column (0.004 at 250 Hz); "
            if bool(np.all(steps == 1.0))
            else ""
        )
        message = (
            f"{record.name}: the sampling step is {dt:.4g} s: {counted}is time in {unit}? correct "
            "the unit of time"
        )
        findings.append(
            Finding("refuse" if dt >= _SLOWEST else "warn", "time_unit", message, "time")
        )
    return findings


def _lost(record: Record, slots: Slots) -> list[Finding]:
    """What is said about lost samples: holes that are bridged and those at which the record is
    cut.
    """
    rows, missing = slots.holes(record.segment)
    if not rows.size:
        return []
    most = longest_hole(slots.period)
    cut = missing > most
    row, count = int(rows[0]), int(missing.sum())
    share = 100.0 * float(missing[~cut].sum()) / (len(record) + count)
    message = (
        f"{record.name}: {rows.size} gap(s), the first before {at(record, row)}, about "
        f"{count} samples missing in all: "
    )
    if cut.all():
        message += "the record is split there"
    else:
        message += (
            f"{share:.2g} % of the record is bridged by cubics, which does not count as measured"
        )
        message += (
            f"; the record is split at {int(cut.sum())} gap(s) of over {most} samples"
            if cut.any()
            else ""
        )
    return [Finding("repair", "gap", message, "time", row)]
