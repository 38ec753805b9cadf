"""The gate before every fit: what is wrong with a record, and repairs by named rules only."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from identification.balance.stamps import cut_at_holes, evened
from identification.data.check.channels import (
    bridged_rows,
    check_absurd,
    check_constant,
    check_lost,
    check_nan,
    check_quantisation,
    check_saturation,
    check_stuck,
)
from identification.data.check.finding import SEVERITIES, Finding, rank
from identification.data.check.jumps import check_jumps
from identification.data.check.relations import (
    check_delay,
    check_motion,
    check_ratio,
    check_velocity,
    check_wrapped,
    measured_ratio,
    shown_ratio,
)
from identification.data.check.stamps import check_sampling, check_size, check_stamps
from identification.data.check.torque import check_torque, check_work
from identification.data.check.turns import check_turns
from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from identification.data.record import Record

__all__ = [
    "SEVERITIES",
    "Finding",
    "check",
    "gate",
    "measured_ratio",
    "repair",
    "require",
    "shown_ratio",
]

SHORTEST_PIECE: Final = 8


@np.errstate(invalid="ignore", over="ignore")  # what is not finite is found and said
def check(
    record: Record,
    gear_ratio: float | None = None,
    needs: Sequence[str] = (),
    torque_per_current: float | None = None,
) -> tuple[Finding, ...]:
    """Check a record before it is used.

    Time (finite, increasing, repeated stamps, gaps, jitter, unit), channels (NaN, constant, stuck,
    saturated, quantised) and their relations (motion, reversal, velocity against position, gear
    ratio, delay, link torque against drive).

    Parameters
    ----------
    record : Record
        The record as read.
    gear_ratio : float, optional
        theta_motor / theta_link, signed; compared with what the positions show.
    needs : sequence of str
        Channels the model cannot do without.
    torque_per_current : float, optional
        Link-referred torque per current [N.m/A]; with it the link torque is compared with the
        drive.

    Returns
    -------
    tuple of Finding
        Worst first.  Nothing is changed: `repair` applies the rules.

    Raises
    ------
    InputError
        If the gear ratio is zero or not finite.
    """
    if gear_ratio is not None and (gear_ratio == 0.0 or not math.isfinite(gear_ratio)):
        raise InputError(
            f"gear_ratio is {gear_ratio!r}: give theta_motor / theta_link, signed and not zero"
        )
    findings = check_size(record) or check_absurd(record)
    if findings:
        return tuple(findings)
    for channel in needs:
        if not record.has(channel):
            message = (
                f"{record.name}: channel {channel} is missing: measure it or name its "
                "column in [columns]"
            )
            findings.append(Finding("refuse", "missing_channel", message, channel))
    stamps = check_stamps(record)
    findings += stamps
    findings += check_lost(record)
    findings += check_nan(record)
    if any(finding.severity == "refuse" for finding in stamps):
        return rank(findings)
    findings += check_sampling(record)
    findings += check_constant(record, gear_ratio)
    pieces = cut_at_holes(record)
    for gate_check in (check_wrapped, check_motion):
        found = gate_check(pieces)
        findings += found
        if any(finding.severity == "refuse" for finding in found):
            return rank(findings)
    usable = repair(record) if any(finding.severity == "repair" for finding in findings) else record
    if len(usable) >= 2:
        findings += check_stuck(record)
        findings += check_saturation(record)
        findings += check_quantisation(record)
        findings += check_turns(record, gear_ratio)
        jumps = check_jumps(cut_at_holes(record, most=0))
        findings += jumps
        findings += check_velocity(usable, gear_ratio)
        findings += [
            f for f in check_ratio(usable, gear_ratio) if f.severity != "warn" or not jumps
        ]
        findings += check_delay(usable, gear_ratio)
        if not any(finding.severity == "refuse" for finding in findings):
            findings += check_torque(usable, gear_ratio, torque_per_current)
            findings += check_work(usable, gear_ratio, torque_per_current)
    return rank(findings)


def require(findings: Sequence[Finding]) -> None:
    """Raise on the first finding that refuses the record.

    Raises
    ------
    InputError
        With the finding's message, and how many more there are.
    """
    refused = [finding for finding in findings if finding.severity == "refuse"]
    if refused:
        more = f" (and {len(refused) - 1} more)" if len(refused) > 1 else ""
        raise InputError(refused[0].message + more)


def gate(
    record: Record,
    gear_ratio: float | None = None,
    needs: Sequence[str] = (),
    torque_per_current: float | None = None,
) -> tuple[Record, tuple[Finding, ...]]:
    """Check a record, refuse what cannot be used, repair the rest.

    Parameters
    ----------
    record, gear_ratio, needs, torque_per_current
        As in `check`.

    Returns
    -------
    record, findings
        The repaired record and what was found.

    Raises
    ------
    InputError
        If a finding refuses the record.
    """
    findings = check(record, gear_ratio, needs, torque_per_current)
    require(findings)
    repaired = (
        repair(record) if any(finding.severity == "repair" for finding in findings) else record
    )
    return repaired, findings


def repair(record: Record) -> Record:
    """Repair a record by named rules, each noted in the provenance with its count and first row.

    ``drop_rows_without_time``, ``interpolate_temperature``, ``bridge_nan_rows`` (holes of one or
    two rows, by interpolation), ``drop_nan_rows`` (and split there); then what
    `identification.balance.stamps.evened` does: ``drop_repeated_stamps`` (a frame written twice),
    ``bridge_lost_samples`` (holes shorter than half a kernel), ``split_at_gaps`` (longer ones),
    ``resample_jitter``; at last ``drop_short_pieces`` (under 8 samples).  Time that runs backwards
    is not repaired.

    Parameters
    ----------
    record : Record
        As read.

    Returns
    -------
    Record
        The same record where no rule applies.

    Raises
    ------
    InputError
        If nothing would be left.
    """
    if len(record) == 0:
        return record
    record = _drop(record, np.isfinite(record.time), "drop_rows_without_time")
    record = _bridge(_fill_temperature(record))
    finite = np.ones(len(record), dtype=np.bool_)
    for values in record.channels.values():
        finite &= np.isfinite(values)
    record = _drop(record, finite, "drop_nan_rows", "split there")
    return _drop_short(_drop_repeated(evened(record)))


def _drop(record: Record, keep: np.typing.NDArray[np.bool_], rule: str, also: str = "") -> Record:
    count = int(keep.size - keep.sum())
    if count == 0:
        return record
    if count == keep.size:
        raise InputError(
            f"{record.name}: no row is left ({rule.replace('_', ' ')}): export the channels again"
        )
    first = int(np.argmin(keep)) + 1
    return record.take(
        keep, f"{rule}: {count} row(s), first row {first}" + (f"; {also}" if also else "")
    )


def _drop_repeated(record: Record) -> Record:
    repeated = np.concatenate(
        [[False], (np.diff(record.time) == 0.0) & (np.diff(record.segment) == 0)]
    )
    if not repeated.any():
        return record
    note = (
        f"drop_repeated_stamps: {int(repeated.sum())} row(s), first row "
        f"{int(np.argmax(repeated)) + 1}"
    )
    keep = ~repeated
    return replace(
        record,
        time=record.time[keep],
        channels={key: values[keep] for key, values in record.channels.items()},
        segment=record.segment[keep],
        age=None if record.age is None else record.age[keep],
        provenance=record.provenance.noted(note),
    )


def _fill_temperature(record: Record) -> Record:
    if not record.has("temperature"):
        return record
    values = record["temperature"]
    good = np.isfinite(values)
    if good.all() or not good.any():
        return record
    index = np.arange(values.size)
    note = (
        f"interpolate_temperature: {int((~good).sum())} row(s), first row "
        f"{int(np.argmin(good)) + 1}"
    )
    return record.with_channel("temperature", np.interp(index, index[good], values[good]), note)


def _bridge(record: Record) -> Record:
    short = bridged_rows(record)
    if not short.any():
        return record
    clock = np.concatenate([[0.0], np.cumsum(np.maximum(np.diff(record.time), 0.0))])
    channels = dict(record.channels)
    for key, values in record.channels.items():
        good = np.isfinite(values)
        if not good.all():
            channels[key] = np.where(
                short & ~good, np.interp(clock, clock[good], values[good]), values
            )
    note = f"bridge_nan_rows: {int(short.sum())} row(s), first row {int(np.argmax(short)) + 1}"
    return replace(record, channels=channels, provenance=record.provenance.noted(note))


def _drop_short(record: Record) -> Record:
    parts = record.segments()
    short = [part for part in parts if part.stop - part.start < SHORTEST_PIECE]
    if not short or len(short) == len(parts):
        return record
    keep = np.ones(len(record), dtype=np.bool_)
    for part in short:
        keep[part] = False
    return _drop(
        record, keep, "drop_short_pieces", f"{len(short)} piece(s) under {SHORTEST_PIECE} samples"
    )
