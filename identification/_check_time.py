"""Checks of the time stamps: finite, increasing, regular, without gaps, in seconds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from identification._finding import Finding, at

if TYPE_CHECKING:
    import numpy.typing as npt

    from identification.record import IntArray, Record

MINIMUM_SAMPLES: Final = 10
_REPEATED_LIMIT: Final = 0.1
_JITTER_WARN: Final = 0.05
_REGULAR: Final = 0.2


def check_size(record: Record) -> list[Finding]:
    """Refuse records without enough samples."""
    count = len(record)
    if count == 0:
        return [Finding("refuse", "empty", f"{record.name}: has no sample: record again")]
    if count == 1:
        return [Finding("refuse", "one_sample", f"{record.name}: has one sample only: record a motion", row=0)]
    if count < MINIMUM_SAMPLES:
        message = f"{record.name}: has {count} samples, at least {MINIMUM_SAMPLES} are needed: record longer"
        return [Finding("refuse", "too_short", message)]
    return []


def check_stamps(record: Record) -> list[Finding]:
    """Find stamps that are not finite, run backwards or are repeated."""
    bad = np.flatnonzero(~np.isfinite(record.time))
    if bad.size:
        message = f"{record.name}: time is not a number in {bad.size} rows, first in row {bad[0] + 1}: rows are dropped"
        if bad.size > _REPEATED_LIMIT * len(record):
            message = f"{record.name}: time is not a number in {bad.size} of {len(record)} rows: export time again"
            return [Finding("refuse", "time_nan", message, "time", int(bad[0]))]
        return [Finding("repair", "time_nan", message, "time", int(bad[0]))]
    inside = np.diff(record.segment) == 0
    steps = np.diff(record.time)
    backwards = np.flatnonzero(inside & (steps < 0.0))
    if backwards.size:
        row = int(backwards[0]) + 1
        message = (
            f"{record.name}: time runs backwards at {at(record, row)}, after {record.time[row - 1]:.6g} s "
            f"({backwards.size} time(s)): give a run column if these are several runs, else sort the file by time"
        )
        return [Finding("refuse", "time_decreases", message, "time", row)]
    repeated = np.flatnonzero(inside & (steps == 0.0))
    if not repeated.size:
        return [Finding("ok", "time_increases", f"{record.name}: time increases in every segment", "time")]
    row = int(repeated[0]) + 1
    share = repeated.size / len(record)
    if share > _REPEATED_LIMIT:
        message = f"{record.name}: {100 * share:.0f} % of the stamps repeat the one before, first at {at(record, row)}: write time with more digits"
        return [Finding("refuse", "time_repeated", message, "time", row)]
    message = f"{record.name}: {repeated.size} repeated stamp(s), first at {at(record, row)}: the later row is dropped"
    return [Finding("repair", "time_repeated", message, "time", row)]


def _positive_steps(record: Record) -> npt.NDArray[np.float64]:
    steps = record.steps()
    result: npt.NDArray[np.float64] = steps[np.isfinite(steps) & (steps > 0.0)]
    return result


def gap_limit(record: Record) -> float:
    """Step [s] beyond which a step is a gap: 1.5 median steps, 5 where the sampling is irregular anyway."""
    steps = _positive_steps(record)
    if not steps.size:
        return float("inf")
    median = float(np.median(steps))
    spread = float(np.percentile(np.abs(steps - median), 90.0)) / median
    return (1.5 if spread < _REGULAR else 5.0) * median


def gaps(record: Record) -> IntArray:
    """Rows that come after a gap within a segment."""
    inside = np.diff(record.segment) == 0
    steps = np.diff(record.time)
    return np.flatnonzero(inside & (steps > gap_limit(record))) + 1


def check_sampling(record: Record) -> list[Finding]:
    """Find gaps, jitter and an implausible sampling step."""
    findings = []
    rows = gaps(record)
    if rows.size:
        row = int(rows[0])
        lost = float(np.sum(record.time[rows] - record.time[rows - 1] - record.dt))
        message = (
            f"{record.name}: {rows.size} gap(s), the first before {at(record, row)}, about "
            f"{lost / record.dt:.0f} samples missing in all: the record is split there"
        )
        findings.append(Finding("repair", "gap", message, "time", row))
    steps = _positive_steps(record)
    if not steps.size:
        return findings
    dt = float(np.median(steps))
    regular = steps[steps <= gap_limit(record)]
    jitter = float(np.percentile(np.abs(regular - dt), 95.0)) / dt
    if jitter > _JITTER_WARN:
        message = (
            f"{record.name}: the sampling is irregular, steps of {regular.min():.4g} to {regular.max():.4g} s around "
            f"{dt:.4g} s: resample before filters and differences"
        )
        findings.append(Finding("warn", "jitter", message, "time"))
    else:
        findings.append(Finding("ok", "jitter", f"{record.name}: step {dt:.6g} s, jitter {100 * jitter:.2g} %", "time"))
    if dt >= 0.5 or dt < 2e-6:
        unit = "ms" if dt >= 0.5 else "s"
        message = f"{record.name}: the sampling step is {dt:.4g} s: is time in {unit}? correct the unit of time"
        findings.append(Finding("refuse" if dt >= 0.5 else "warn", "time_unit", message, "time"))
    return findings
