"""A fault bank for records: which sensors a record has, healthy records for the limits, verdicts
on a file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError
from identification.online.options import OnlineOptions, prepared
from identification.online.verdict import CURRENT_OR_FRICTION, HELD, MISSING, PLANT
from irj_fmu.estimator.healthy import online_readings

if TYPE_CHECKING:
    from casadi_models import JointModel
    from identification.faults.bank import BankTrack, FaultBank
    from identification.faults.detector import Fault
    from identification.faults.types import FaultEvent
    from identification.online.filter import Doubts

FloatArray = npt.NDArray[np.float64]

DERIVED: Final = {2: 1, 4: 3}
"""Velocities and the positions that they are derived from where they are not measured."""


FOLLOWS: Final = {
    "link_position": ("link_position", "link_velocity"),
    "link_torque": ("torque",),
}
"""Readings that have the clock of a channel: a velocity is made by the encoder of its position."""


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
    """A bank for a record's sensors with levels and limits from healthy records. A velocity that
    one of these lacks is not judged.

    None where a bank cannot work: a rigid joint, one without fitted values, one encoder only,
    several runs in the record, no healthy records.

    Raises
    ------
    InputError
        A healthy record lacks a reading that the record has.
    """
    from identification.faults.bank import FaultBank
    from identification.faults.bank_kept import calibrated
    from identification.faults.bank_levels import Piece

    options = OnlineOptions(
        has_link=record.has("link_position"), has_torque=record.has("link_torque")
    )
    there = measured_sensors(record)
    for other in healthy:
        both = zip(there, measured_sensors(other), strict=True)
        there = tuple(a and (b or i not in DERIVED) for i, (a, b) in enumerate(both))
    if not (healthy and joint.fitted and there[1] and there[3]):
        return None
    if not (np.diff(record.time) >= 0).all():
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
        every = max(1, round(record.dt / other.dt))  # windows of the statistics count samples
        pieces += [
            Piece(other.time[part][::every], table[part][::every]) for part in other.segments()
        ]
    bank = FaultBank(
        model, record.dt, there, doubts=doubts_of(joint, model), late=lateness(joint, healthy)
    )
    try:
        calibrated(bank, pieces)
    except InputError as error:
        raise InputError(f"{', '.join(r.name for r in healthy)}: {error}") from None
    return bank


def doubts_of(joint: Joint, model: JointModel) -> Doubts:
    """What the fit of a joint file leaves open: errors of its values, as they go together.

    A shape bends the readings, which no error of first order follows; what is known has none.
    """
    from identification.online.filter import Doubts

    own = {p.name for p in model.parameters if not p.is_shape} - set(joint.known)
    names = tuple(n for n in model.parameter_names if n in own and joint.errors.get(n, 0.0) > 0.0)
    errors = np.array([joint.errors[n] for n in names])
    return Doubts(names, joint.correlation.matrix(names) * np.outer(errors, errors))


def lateness(joint: Joint, healthy: Sequence[Record]) -> tuple[float, ...]:
    """Time by which each reading is late [s], by a fit of nothing but that to healthy records,
    their mean: a clock belongs to the rig and not to the run. The drive stays as it is read: a
    filter weighs its readings before and after.
    """
    from identification.balance.clocks import NEAR
    from identification.faults.core import SENSORS
    from identification.fitting.fit import fit
    from identification.fitting.joint_text import calibration_of

    found = fit(joint.held(), healthy)
    own = [c for c in calibration_of(found.solution, found.data) if c.what == "skew"]
    out = dict.fromkeys(SENSORS, 0.0)
    for channel, places in FOLLOWS.items():
        values = [c.value for c in own if c.sensor == channel and not c.bounded]
        late = float(np.mean(values)) if values else 0.0
        if abs(late) > NEAR * min(r.dt for r in healthy):
            out |= dict.fromkeys(places, late)
    return tuple(out[n] for n in SENSORS)


@final
@dataclass(frozen=True)
class Watching:
    """A fault bank and what it looks at.

    Attributes
    ----------
    bank : FaultBank
    record : Record
        As read, missing readings and uneven stamps as they are.
    smallest : mapping of str to pair of float
        Smallest offset of each sensor that is seen, and that is named; empty where it was not asked
        for.
    """

    bank: FaultBank
    record: Record
    smallest: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def smallest_offsets(
    bank: FaultBank, healthy: Record, joint: Joint
) -> dict[str, tuple[float, float]]:
    """Smallest offset of each sensor that a bank sees, and that it names, on the longest stretch of
    a healthy record (see :meth:`identification.faults.bank.FaultBank.smallest`).
    """
    from identification.faults.bank_kept import smallest
    from identification.faults.bank_levels import Piece

    longest = max(healthy.segments(), key=lambda s: s.stop - s.start)
    rows = np.array(online_readings(healthy, joint)[0])[longest]
    return smallest(bank, Piece(healthy.time[longest], rows))


def judged(
    bank: FaultBank, record: Record, joint: Joint, faults: Sequence[Fault] = ()
) -> BankTrack:
    """What a bank says about a record, stamps and missing readings as they are."""
    return bank.run(record.time, np.array(online_readings(record, joint, faults)[0]))


@final
@dataclass(frozen=True)
class Judgement:
    """A bank's verdicts on the samples of an evenly sampled record.

    Attributes
    ----------
    events : tuple of dict
        ``time`` [s], ``first`` [s], ``fault`` (code as the estimator's), ``sensors``, ``verdict``.
    verdicts : tuple of (time [s], FaultEvent)
        All that the bank said, also that a sensor agrees again.
    failed : (n, 6) bool array
        Where a reading is not to be used.
    readings : (n, 6) array
        Readings with failed ones replaced.
    scores : (n, 6) array
        Largest statistic of each reading over its limit; 0 where a velocity is derived.
    """

    events: tuple[dict[str, Any], ...]
    verdicts: tuple[tuple[float, FaultEvent], ...]
    failed: npt.NDArray[np.bool_]
    readings: FloatArray
    scores: FloatArray


def judgement(
    watching: Watching, even: Record, joint: Joint, faults: Sequence[Fault] = ()
) -> Judgement:
    """What a bank says about a record, brought to the samples of its even form.

    Parameters
    ----------
    watching : Watching
    even : Record
        What the estimator replays.
    joint : Joint
    faults : sequence of Fault
        Tried on purpose.
    """
    from identification.faults.core import SENSORS
    from identification.faults.types import Verdict

    bank, record = watching.bank, watching.record
    track = judged(bank, record, joint, faults)
    at = np.clip(np.searchsorted(record.time, even.time + 1e-9) - 1, 0, len(record) - 1)
    failed, readings = track.failed[at], track.readings[at]
    for velocity, position in DERIVED.items():
        if velocity not in bank.sensors:
            failed[:, velocity] = failed[:, position]
            change = np.gradient(readings[:, position], even.time)
            readings[:, velocity] = change
    events = []
    for event in track.events:
        about = [n for n in event.sensors if n in SENSORS]
        first = SENSORS.index(about[0]) + 1 if about else 0
        code = {
            Verdict.SENSOR: first,
            Verdict.DROPOUT: MISSING + first,
            Verdict.CURRENT_OR_FRICTION: CURRENT_OR_FRICTION,
            Verdict.PLANT: PLANT,
        }.get(event.verdict, HELD)
        if event.verdict is not Verdict.RECOVERED:
            events.append(
                {
                    "time": float(record.time[event.sample]),
                    "first": float(record.time[event.first]),
                    "fault": code,
                    "sensors": list(event.sensors),
                    "verdict": event.verdict,
                }
            )
    verdicts = tuple((float(record.time[e.sample]), e) for e in track.events)
    return Judgement(tuple(events), verdicts, failed, readings, track.residuals[at])
