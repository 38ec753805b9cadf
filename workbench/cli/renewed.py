"""A joint that changed while it was tracked is identified again on what was recorded since."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError
from identification.online.verdict import CURRENT_OR_FRICTION, PLANT
from workbench.show.replayed import Replay

ABOUT_THE_JOINT: Final = (CURRENT_OR_FRICTION, PLANT)
"""Fault codes after which the joint may be another one. A current sensor that failed is told from
changed friction here: its scale and offset are among what may have moved."""
_SCALED: Final = {
    "motor_position": (1, True),
    "motor_velocity": (2, True),
    "link_position": (3, False),
    "link_velocity": (4, False),
    "link_torque": (5, False),
}
"""Channels of a record, their place among the readings, and whether they are motor-referred."""


def renewed(replay: Replay, joint: Joint) -> tuple[dict[str, Any], ...]:
    """Events of the identifications that follow from a replay's verdicts about the joint, each at
    the end of the data that it used.

    Data last from a verdict about the joint to the next one or to the end. Samples in which a
    sensor is held as failed are left out, faults tried on purpose are in.

    Parameters
    ----------
    replay : Replay
    joint : Joint
        The joint before the change.

    Returns
    -------
    tuple of dict
        ``time``, ``first`` [s] (end and begin of the data), ``fault`` 0, ``text``, and
        ``changed`` as `irj changed --json` has it, None where the data were not enough.
    """
    times = [float(e["time"]) for e in replay.events if e["fault"] in ABOUT_THE_JOINT]
    if not times:
        return ()
    record = _as_tried(replay, joint)
    usable = ~replay.failed.any(axis=1) & np.isfinite(replay.readings).all(axis=1)
    # the estimator's own hold is about all readings at once
    out = []
    for start, stop in zip(times, [*times[1:], float(record.time[-1])], strict=True):
        rows = (record.time >= start) & (record.time <= stop) & usable
        out.append(_identified(record, rows, joint, start, stop))
    return tuple(out)


def _identified(
    record: Record, rows: npt.NDArray[np.bool_], joint: Joint, start: float, stop: float
) -> dict[str, Any]:
    from identification.diagnosis.changed import changed

    event: dict[str, Any] = {"time": stop, "first": start, "fault": 0, "changed": None}
    span = f"from {start:.3f} s on"
    if not rows.any():
        text = f"not identified again {span}: a sensor counts as failed in every sample"
        return {**event, "text": text}
    try:
        found = changed(joint, record.take(rows, f"{span}, after the joint changed"))
    except InputError as error:
        return {**event, "text": f"not identified again {span}: {error}"}
    moved = [
        f"{c.parameter} {c.before:.6g} -> {c.after:.6g} +- {c.stderr:.2g} {c.unit}"
        + (f" (or {' or '.join(c.tied)})" if c.tied else "")
        for c in found.changes
    ]
    if found.payload is not None:
        moved.append(f"payload {found.payload.mass:.3g} +- {found.payload.stderr:.2g} kg")
    told = ", ".join(moved) or "no parameter moved"
    return {**event, "text": f"identified again {span}: {told}", "changed": found.as_json()}


def _as_tried(replay: Replay, joint: Joint) -> Record:
    """The record with the faults tried on purpose in its channels."""
    record = replay.record
    if not replay.tried:
        return record
    more = np.nan_to_num(replay.readings - replay.healthy)
    per_drive = joint.torque_per_current if record.has("motor_current") else joint.gear_ratio
    per = {"motor_current" if record.has("motor_current") else "motor_torque": per_drive or 1.0}
    channels = dict(record.channels)
    for channel, scale in per.items():
        if channel in channels:
            channels[channel] = channels[channel] + more[:, 0] / scale
    for channel, (at, geared) in _SCALED.items():
        if channel in channels:
            factor = joint.gear_ratio if geared else 1.0
            channels[channel] = channels[channel] + more[:, at] * factor
    return replace(record, channels=channels)


__all__ = ["ABOUT_THE_JOINT", "renewed"]
