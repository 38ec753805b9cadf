"""Limits of an estimator's fault detector from records of the healthy joint, at the estimator's
own step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError
from identification.online.options import OnlineOptions, prepared

if TYPE_CHECKING:
    from identification.faults.detector import Fault

Say = Callable[[str], object]


def read_healthy(
    paths: Sequence[Path], joint: Joint, say: Say = lambda _text: None
) -> list[Record]:
    """Records of the healthy joint through the check gate, named by their paths.

    Parameters
    ----------
    paths : sequence of Path
    joint : Joint
        Column map, kind of the axis, gear ratio.
    say : callable
        Called with one sentence per doubt or repair.

    Raises
    ------
    InputError
        A record that cannot be used: one line that starts with its path.
    """
    from identification.data.check.checks import gate
    from identification.data.read import read

    found = []
    for path in paths:
        record = read(path, columns=joint.columns, kind=joint.kind)
        try:
            checked, findings = gate(record, joint.gear_ratio, (), joint.torque_per_current)
        except InputError as error:
            raise InputError(f"{path}: {str(error).removeprefix(record.name + ': ')}") from None
        for finding in findings:
            if finding.severity in ("warn", "repair"):
                say(f"{path}: {finding.message.removeprefix(record.name + ': ')}")
        found.append(checked.renamed(str(path)))
    return found


def may_watch(record: Record, state: bytes | None) -> bool:
    """Whether the estimator's detector may judge the sensors of a record: a velocity that is
    derived has noise of its own, which limits that are guessed call a failure.

    Parameters
    ----------
    record : Record
    state : bytes or None
        Of a detector with limits from healthy records.
    """
    return state is not None or record.has("motor_velocity", "link_velocity")


def detector_state(
    joint: Joint,
    options: OnlineOptions,
    healthy: Sequence[Record],
    dt: float,
    say: Say = lambda _text: None,
) -> bytes | None:
    """State of a fault detector with limits from healthy records; None without records.

    Parameters
    ----------
    joint : Joint
    options : OnlineOptions
        Sensors.
    healthy : sequence of Record
        Resampled to `dt` by linear interpolation. Where a record is coarser, up to the shortest
        time over which the detector compares readings, the limits come out wider than with records
        at `dt`.
    dt : float
        Step of the estimator [s].
    say : callable
        Called with one sentence per record that is coarser than `dt`.

    Raises
    ------
    InputError
        The joint is rigid or not fitted; a record lacks a channel or is too coarse.
    """
    if not healthy:
        return None
    from identification.faults.detector import FaultDetector, FaultSettings

    model, _ = prepared(joint, options)
    if not joint.fitted or not model.is_elastic:
        raise InputError(
            f"{joint.source or joint.name}: the fault detector needs an elastic joint with "
            "fitted values; make one with `irj fit -o`"
        )
    longest = max(dt, FaultSettings().lags[0])
    pieces = []
    for record in healthy:
        for channel, has, option in (
            ("link_position", options.has_link, "--no-link"),
            ("link_torque", options.has_torque, "--no-torque"),
        ):
            if has and not record.has(channel):
                raise InputError(
                    f"{record.name}: has no {channel}, which the estimator reads; give records "
                    f"with it, or {option} where the joint has none"
                )
        if record.dt > 1.01 * longest:
            raise InputError(
                f"{record.name}: sampled every {_ms(record.dt)} ({1 / record.dt:.4g} per s), too "
                f"coarse for limits at the estimator's step of {_ms(dt)}; "
                f"give healthy records with {1 / longest:.4g} samples per s or more, or a native "
                f"estimator with --sample-time {record.dt:.3g}"
            )
        if record.dt > 1.01 * dt:
            say(
                f"{record.name}: sampled every {_ms(record.dt)}, interpolated to the estimator's "
                f"{_ms(dt)}; a record at that step gives closer limits"
            )
        even = record.resampled(dt)
        table = np.array(online_readings(even, joint)[0])
        pieces += [table[part] for part in even.segments()]
    detector = FaultDetector(model, dt, has_torque=options.has_torque)
    try:
        detector.calibrate(pieces)
    except InputError as error:
        raise InputError(f"{', '.join(r.name for r in healthy)}: {error}") from None
    return detector.state()


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms"


def online_readings(
    record: Record, joint: Joint, faults: Sequence[Fault] = ()
) -> tuple[list[list[float]], list[bool]]:
    """Drive, motor position and velocity, link position and velocity, torque (link-referred SI),
    and which are there.

    Parameters
    ----------
    record : Record
        Evenly sampled.
    joint : Joint
    faults : sequence of Fault
        Put into the sensors before velocities are derived: a derived velocity follows its faulty
        position.

    Raises
    ------
    InputError
        A fault of a sensor that the record does not have.
    """
    from identification.balance.sensing import drive_torque
    from identification.faults.detector import SENSORS, inject

    count, ratio = len(record), joint.gear_ratio
    motor = (
        record["motor_position"] / ratio
        if record.has("motor_position")
        else record["link_position"]
    )
    link = record["link_position"] if record.has("link_position") else motor
    torque = record["link_torque"] if record.has("link_torque") else np.zeros(count)
    measured = {2: ("motor_velocity", 1, ratio), 4: ("link_velocity", 3, 1.0)}
    columns = [drive_torque(record, joint), motor, np.zeros(count), link, np.zeros(count), torque]
    for at, (channel, _, scale) in measured.items():
        if record.has(channel):
            columns[at] = record[channel] / scale
    table = np.column_stack(columns)
    has_link, has_torque = record.has("link_position"), record.has("link_torque")
    there = [
        True,
        True,
        record.has("motor_velocity"),
        has_link,
        record.has("link_velocity"),
        has_torque,
    ]
    for fault in faults:
        if not there[SENSORS.index(fault.sensor)]:
            raise InputError(
                f"{record.name}: has no reading of its own for {fault.sensor}; a fault needs a "
                "sensor that is there"
            )
    if faults:
        table = inject(table, record.dt, faults, time=record.time)
    for at, (channel, position, _) in measured.items():
        if not record.has(channel):
            table[:, at] = np.gradient(table[:, position], record.time)
    return table.tolist(), [True, True, True, has_link, has_link, has_torque]


__all__ = ["detector_state", "online_readings", "read_healthy"]
