"""Checks of single channels: NaN, constant, stuck, saturated, quantised."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from identification.data.check.finding import Finding, at
from identification.data.check.quanta import quantum
from identification.data.check.stamps import gap_limit

if TYPE_CHECKING:
    import numpy.typing as npt

    from identification.data.record import FloatArray, IntArray, Record

_NAN_LIMIT: Final = 0.2
"""Share of the rows without a number above which a channel is refused: where every fifth row is
lost, no stretch is left that a kernel fits into.
"""
LARGEST: Final = 1e150
"""Values whose square is no floating-point number any more (1e308)."""
_BRIDGED: Final = 2
"""Rows of a hole that is bridged, at most."""
_EFFORT: Final = ("motor_current", "motor_voltage", "motor_torque", "link_torque")
_SIDE: Final = ("run", "temperature", "reference_position")
_FEW_LEVELS: Final = 50
"""Levels of a quantised channel below which it is said to be coarse: one step is then 2 % of the
motion, the size of the effects looked for.
"""
_SATURATED_RUN: Final = 5
"""Equal extreme values in a row from which a channel rests at a limit: the extreme of a free
channel lasts one sample or two.
"""
_STUCK_RUN: Final = 20
"""Equal values in a row from which a channel may be stuck."""
_STUCK_MOTION: Final = 0.1
"""Share of another position's range covered meanwhile that makes it so: quantised channels stand
still for 20 rows in slow motion, but not over a tenth of the path.
"""
GUESSED_RATIO: Final = 200.0
"""Gear ratio where none is given: above the usual ones (30 to 160) of harmonic drives, so that no
motion of the link is made too large.
"""
_LOCKED: Final = 5.0
"""Motion of the motor against a locked link [deg], link-referred: harmonic drives wind up by less
than one, and compliant transmissions are let pass.
"""
# a channel's values count as multiples of one step ...
_MANY_LEVELS: Final = 1e6
"""Levels from which quantisation is not worth a word: twenty bits, below the noise of a drive."""


def check_lost(record: Record) -> list[Finding]:
    """Tell of channels that the file names and does not give."""
    return [
        Finding("warn", "lost_channel", f"{record.name}: {channel} is lost, {why}", channel)
        for channel, why in record.provenance.lost
        if not record.has(channel)
    ]


def check_nan(record: Record) -> list[Finding]:
    """Find channels with values that are not finite."""
    findings = []
    bridged = bridged_rows(record)
    for channel, values in record.channels.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if not bad.size:
            continue
        row = int(bad[0])
        where = (
            f"{record.name}: {channel} is not a number in {bad.size} rows, the first "
            f"{at(record, row)}"
        )
        if channel == "temperature" and bad.size < len(record):
            findings.append(Finding("repair", "nan", f"{where}: it is interpolated", channel, row))
        elif bad.size > _NAN_LIMIT * len(record):
            advice = "leave the channel out or export it again"
            findings.append(Finding("refuse", "nan", f"{where}: {advice}", channel, row))
        else:
            left = ~np.isfinite(values) & ~bridged
            dropped = "the rows are dropped, the record is split there"
            advice = (
                dropped
                if left.sum() == bad.size
                else "the holes of one or two rows are bridged by interpolation"
            )
            advice += (
                f", in the other {int(left.sum())} {dropped}" if 0 < left.sum() < bad.size else ""
            )
            findings.append(Finding("repair", "nan", f"{where}: {advice}", channel, row))
    return findings


def check_absurd(record: Record) -> list[Finding]:
    """Refuse finite values with which nothing can be computed."""
    findings = []
    for channel, values in (("time", record.time), *record.channels.items()):
        bad = np.flatnonzero(np.isfinite(values) & (np.abs(values) > LARGEST))
        if bad.size:
            row = int(bad[0])
            message = (
                f"{record.name}: {channel} is {values[row]:.4g} in row {row + 1}: no sensor reads "
                "that, export it again"
            )
            findings.append(Finding("refuse", "absurd", message, channel, row))
    return findings


def bridged_rows(record: Record) -> npt.NDArray[np.bool_]:
    """Rows of holes that are short enough to be bridged: one or two rows, over all channels,
    inside a segment and beside no gap.
    """
    missing = np.zeros(len(record), dtype=np.bool_)
    for values in record.channels.values():
        missing |= ~np.isfinite(values)
    out = np.zeros(missing.size, dtype=np.bool_)
    if not missing.any():
        return out
    limit, segment = gap_limit(record), record.segment
    padded = np.concatenate([[False], missing, [False]])
    edges = np.flatnonzero(np.diff(padded.astype(np.int8)))
    for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        inside = (
            start > 0
            and stop < missing.size
            and segment[start - 1] == segment[stop]
            and stop - start <= _BRIDGED
        )
        out[start:stop] = (
            inside and float(np.diff(record.time[start - 1 : stop + 1]).max()) <= limit
        )
    return out


def runs_of_equal(values: FloatArray) -> tuple[IntArray, IntArray]:
    """Starts and lengths of the stretches in which a value does not change."""
    edges = np.flatnonzero(np.diff(values) != 0.0) + 1
    starts = np.concatenate([[0], edges]).astype(np.int64)
    lengths = np.diff(np.concatenate([starts, [values.size]])).astype(np.int64)
    return starts, lengths


def span(values: FloatArray) -> float:
    """Largest minus smallest finite value."""
    finite = values[np.isfinite(values)]
    return float(finite.max() - finite.min()) if finite.size else 0.0


def check_constant(record: Record, gear_ratio: float | None) -> list[Finding]:
    """Find channels that never change; a locked link is allowed while the motor moves no more
    than a wind-up.
    """
    findings = []
    for channel, values in record.channels.items():
        if channel == "run" or span(values) > 0.0:
            continue
        where = f"{record.name}: {channel} is constant ({values[0]:.6g} in every row)"
        if channel in _SIDE:
            findings.append(Finding("warn", "constant", f"{where}: it tells nothing", channel, 0))
        elif channel.startswith("link_") and record.has("motor_position"):
            moved = span(record["motor_position"]) / abs(gear_ratio or GUESSED_RATIO)
            small = record.kind == "rotary" and moved < np.deg2rad(_LOCKED)
            advice = (
                "fine if the link is locked, else check its sensor"
                if small
                else "check its sensor or column"
            )
            findings.append(
                Finding("warn" if small else "refuse", "constant", f"{where}: {advice}", channel, 0)
            )
        else:
            findings.append(
                Finding("refuse", "constant", f"{where}: check its sensor or column", channel, 0)
            )
    return findings


def check_stuck(record: Record) -> list[Finding]:
    """Find stretches in which a channel stands still while another one of the same joint moves."""
    findings = []
    movers = [
        c
        for c in ("motor_position", "link_position", "motor_velocity", "link_velocity")
        if record.has(c)
    ]
    whole = {m: span(record[m]) or 1.0 for m in movers}
    for channel in (*_EFFORT, *movers):
        if not record.has(channel) or span(record[channel]) == 0.0:
            continue
        kindred = [m for m in movers if m != channel and m.endswith("_position")]
        if not kindred:
            continue
        starts, lengths = runs_of_equal(record[channel])
        worst: tuple[float, int, int] | None = None
        for k in np.flatnonzero(lengths >= _STUCK_RUN):
            piece = slice(int(starts[k]), int(starts[k] + lengths[k]))
            if record.segment[piece.start] != record.segment[piece.stop - 1]:
                continue
            moved = max(span(record[m][piece]) / whole[m] for m in kindred)
            if moved > _STUCK_MOTION and (worst is None or moved > worst[0]):
                worst = (moved, piece.start, piece.stop)
        if worst is not None:
            _, start, stop = worst
            message = (
                f"{record.name}: {channel} is stuck from {at(record, start)} to row {stop} "
                "while the joint moves: cut this time out or check the sensor"
            )
            findings.append(Finding("warn", "stuck", message, channel, start))
    return findings


def check_saturation(record: Record) -> list[Finding]:
    """Find effort channels that rest at their largest value for several rows."""
    findings = []
    for channel in _EFFORT:
        if not record.has(channel) or span(record[channel]) == 0.0:
            continue
        values = record[channel]
        if np.unique(values[: 10 * _FEW_LEVELS * 100]).size < _FEW_LEVELS:
            continue
        starts, lengths = runs_of_equal(values)
        long = lengths >= _SATURATED_RUN
        for limit, word in ((np.nanmax(values), "largest"), (np.nanmin(values), "smallest")):
            hit = long & (values[starts] == limit)
            rows = int(lengths[hit].sum())
            if rows == 0:
                continue
            row = int(starts[hit][0])
            message = (
                f"{record.name}: {channel} rests at its {word} value {limit:.6g} "
                f"{record.unit(channel)} "
                f"for {rows} rows, first {at(record, row)}: saturated? lower the amplitude or "
                "cut these rows out"
            )
            findings.append(Finding("warn", "saturation", message, channel, row))
    return findings


def check_quantisation(record: Record) -> list[Finding]:
    """Report the quantisation step of every measured channel; warn where there are few levels."""
    findings = []
    for channel, values in record.channels.items():
        if channel in _SIDE or span(values) == 0.0:
            continue
        step = quantum(values)
        if step is None:
            continue
        levels = span(values) / step
        size = f"step {step:.4g} {record.unit(channel)}, {levels:.0f} levels in use"
        said = f"{record.name}: {channel} is quantised, {size}"
        if levels < _FEW_LEVELS:
            advice = "too coarse: widen the motion or use a finer sensor"
            findings.append(Finding("warn", "quantisation", f"{said}: {advice}", channel))
        elif levels < _MANY_LEVELS:
            findings.append(Finding("ok", "quantisation", said, channel))
    return findings
