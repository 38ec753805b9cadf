"""Check for single jumps: an encoder that slips, one sample far off."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from identification.data.check.channels import span
from identification.data.check.finding import Finding, at
from identification.data.check.quanta import quantum

if TYPE_CHECKING:
    from identification.data.record import FloatArray, Record

_POSITIONS: Final = ("motor_position", "link_position")
_OTHERS: Final = (
    "motor_velocity",
    "link_velocity",
    "motor_current",
    "motor_voltage",
    "motor_torque",
    "link_torque",
)
_SLIP: Final = 10.0
"""Excess of a step over its neighbours', in units of the excess that one step in a thousand
reaches.
"""
_SLIP_SHARE: Final = 2e-3
"""The same as a share of the channel's range."""
_SPIKE: Final = 3.0
"""Distance of a sample from its neighbours in units of the range that 998 of 1000 samples keep
to.
"""


def check_jumps(record: Record) -> list[Finding]:
    """Warn where a position steps against its neighbours, or one sample of another channel
    stands far off.
    """
    findings = []
    for channel in (*_POSITIONS, *_OTHERS):
        if not record.has(channel) or span(record[channel]) == 0.0 or len(record) < 50:
            continue
        found = _slip(record, channel) if channel in _POSITIONS else _spike(record, channel)
        if found is None:
            continue
        row, size, count = found
        what = "jumps" if channel in _POSITIONS else "stands off by"
        advice = (
            "an encoder that slips or a lost sample? cut the record there"
            if channel in _POSITIONS
            else "a lost sample? cut the row out"
        )
        times = f", {count} such rows in all" if count > 1 else ""
        message = (
            f"{record.name}: {channel} {what} {size:.4g} {record.unit(channel)} at "
            f"{at(record, row)} against its neighbours{times}: {advice}"
        )
        findings.append(Finding("warn", "jump", message, channel, row))
    return findings


def _off(values: FloatArray) -> FloatArray:
    """Distance of each value from the median of itself and its two neighbours on either side;
    zero at the ends.
    """
    out = np.zeros(values.size)
    if values.size >= 5:
        a, b, middle, c, d = (values[i : values.size - 4 + i] for i in range(5))
        # the median of five by what the smaller and the larger of two pairs leave: six times as
        # quick as sorting each window, and the same number
        low = np.maximum(np.minimum(a, b), np.minimum(c, d))
        high = np.minimum(np.maximum(a, b), np.maximum(c, d))
        median = np.maximum(np.minimum(low, high), np.minimum(np.maximum(low, high), middle))
        out[2:-2] = np.abs(middle - median)
    return out


def _slip(record: Record, channel: str) -> tuple[int, float, int] | None:
    excess, values = np.zeros(len(record)), _numbers(record[channel])
    for part in record.segments():
        excess[part.start + 1 : part.stop] = _off(np.diff(values[part]))
    excess = np.nan_to_num(excess)
    usual = float(np.quantile(excess, 0.999))
    limit = max(
        _SLIP * usual, _SLIP_SHARE * span(record[channel]), 5.0 * (quantum(record[channel]) or 0.0)
    )
    return _worst(excess, limit)


def _spike(record: Record, channel: str) -> tuple[int, float, int] | None:
    values = _numbers(record[channel])
    off = np.zeros(len(record))
    for part in record.segments():
        off[part] = _off(values[part])
    low, high = np.nanquantile(values, [0.001, 0.999])
    return _worst(np.nan_to_num(off), max(_SPIKE * float(high - low), 1e-300))


def _numbers(values: FloatArray) -> FloatArray:
    """Values with what is no number as a hole, which other checks speak of."""
    return np.where(np.isfinite(values), values, np.nan)


def _worst(size: FloatArray, limit: float) -> tuple[int, float, int] | None:
    rows = np.flatnonzero(size > limit)
    if not rows.size:
        return None
    row = int(rows[np.argmax(size[rows])])
    return row, float(size[row]), int(rows.size)
