"""A fault bank for records: which sensors a record has, healthy records for the limits, verdicts
on a file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError
from identification.online.options import OnlineOptions, prepared
from irj_fmu.estimator.healthy import online_readings

if TYPE_CHECKING:
    from identification.faults.bank import BankTrack, FaultBank
    from identification.faults.detector import Fault

FloatArray = npt.NDArray[np.float64]


def measured_sensors(record: Record) -> tuple[bool, ...]:
    """Which of :data:`identification.faults.core.SENSORS` a record has; a velocity that would be
    derived is none.
    """
    return (
        True,
        record.has("motor_position"),
        record.has("motor_velocity"),
        record.has("link_position"),
        record.has("link_velocity"),
        record.has("link_torque"),
    )


def bank_for(joint: Joint, record: Record, healthy: Sequence[Record]) -> FaultBank | None:
    """A bank for a record's sensors with levels and limits from healthy records.

    None where a bank cannot work: a rigid joint, one without fitted values, one encoder only, no
    healthy records.

    Raises
    ------
    InputError
        A healthy record lacks a reading that the record has.
    """
    from identification.faults.bank import FaultBank
    from identification.faults.bank_levels import Piece

    options = OnlineOptions(
        has_link=record.has("link_position"), has_torque=record.has("link_torque")
    )
    there = measured_sensors(record)
    if not (healthy and joint.fitted and there[1] and there[3]):
        return None
    model, _ = prepared(joint, options)
    if not model.is_elastic:
        return None
    pieces = []
    for other in healthy:
        if any(a and not b for a, b in zip(there, measured_sensors(other), strict=True)):
            raise InputError(
                f"{other.name}: has not all readings that {record.name} has; --healthy takes "
                "records with the same channels"
            )
        table = np.array(online_readings(other, joint)[0])
        pieces += [Piece(other.time[part], table[part]) for part in other.segments()]
    bank = FaultBank(model, record.dt, there)
    bank.calibrate(pieces)
    return bank


def judged(
    bank: FaultBank, record: Record, joint: Joint, faults: Sequence[Fault] = ()
) -> BankTrack:
    """What a bank says about a record, stamps and missing readings as they are."""
    return bank.run(record.time, np.array(online_readings(record, joint, faults)[0]))
