"""Which balances the channels of a record allow, and its signals link-referred."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from casadi_models.joint import TWIST
from casadi_models.term import SIDE_INERTIAS, TOTAL_INERTIA
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]

BALANCE_TITLES: Final = {
    "motor": "motor balance (drive, torque sensor, motor)",
    "link": "link balance (torque sensor, link)",
    "transmission": "transmission balance (torque sensor, torsion)",
    "sum": "sum of motor and link balance (no torque sensor)",
    "deflection": "motor balance with the torsion in place of a torque sensor",
    "axis": "balance of the axis",
    "kinematic": "twist against what the link's own motion asks for (no torque, no drive)",
}


@final
@dataclass(frozen=True)
class Sensing:
    """What a set of channels lets one see.

    Attributes
    ----------
    balances : tuple of str
        Keys of :data:`BALANCE_TITLES`.
    both_positions : bool
        False: the side that is not measured is taken to move with the other.
    has_torque, has_drive, has_temperature : bool
    clamped_link : bool
        A torque-against-torsion test: the one position is the torsion.
    temperature_origin : float
        What the temperature of every record is counted from: the first sample of the first one.
    longest_run : float
        Of all records [s]: scale of the warm-up that stands in for a temperature.
    has_coupling : bool
        A torque on the link from elsewhere is known.
    """

    balances: tuple[str, ...]
    both_positions: bool
    has_torque: bool
    has_drive: bool
    has_temperature: bool
    clamped_link: bool = False
    moving: str = "motor_position"
    temperature_origin: float = 0.0
    longest_run: float = 0.0
    has_coupling: bool = False

    @property
    def one_sided(self) -> bool:
        """True where one balance of one side carries everything."""
        return self.balances == ("axis",) or self.clamped_link

    @property
    def recorded(self) -> frozenset[str]:
        """Signals that are recorded, of those for which something else can stand in."""
        return frozenset({"temperature"} if self.has_temperature else ())

    @property
    def motor_and_torque(self) -> bool:
        """True where drive, motor and torque are recorded, and the link is not."""
        return self.has_torque and self.balances == ("motor",)

    @property
    def kinematic(self) -> bool:
        """True where both positions are recorded and no torque at all."""
        return self.balances == ("kinematic",)


TEMPERATURE_CHANGE: Final = 2.0
"""Change of the temperature over the records that is worth the name [K]."""
CLAMPED_TRAVEL: Final = math.radians(5.0)
"""Motion of one side, link-referred, that a clamped other side allows: some twenty times what a
strain-wave gear twists at its rated torque, twice what a soft belt or spring behind a gear does
[rad]."""
DRIVES: Final = ("motor_torque", "motor_current", "motor_voltage")


_SENSED: Final[WeakKeyDictionary[Record, dict[tuple[bool, float], Sensing]]] = WeakKeyDictionary()
"""What each record lets one see, by whether the model is elastic and its gear ratio: all that is
asked of the model.
"""


def sense(record: Record, model: JointModel) -> Sensing:
    """Balances that the record's channels and the model allow; looked up once per record.

    Raises
    ------
    InputError
        No position; nothing to balance; an elastic model on one-sided data (says what is missing).
    """
    known = _SENSED.setdefault(record, {})
    asked = (model.is_elastic, abs(model.gear_ratio))
    if asked not in known:
        known[asked] = _sensed(record, *asked)
    return known[asked]


def _sensed(record: Record, elastic: bool, gear_ratio: float) -> Sensing:
    drive = any(record.has(c) for c in DRIVES)
    torque = record.has("link_torque")
    motor, link = record.has("motor_position"), record.has("link_position")
    temperature = (
        record.has("temperature") and float(np.ptp(record["temperature"])) > TEMPERATURE_CHANGE
    )
    if not (motor or link):
        raise InputError(
            f"{record.name}: no motor_position and no link_position; add one of them or map it "
            "in [columns]"
        )
    if not (drive or torque or (motor and link)):
        raise InputError(
            f"{record.name}: no motor_current, motor_torque, motor_voltage or link_torque; a "
            "balance needs one of them, or both motor_position and link_position"
        )
    common = {
        "has_torque": torque,
        "has_drive": drive,
        "has_temperature": temperature,
        "both_positions": motor and link,
        "has_coupling": record.has("coupling_torque"),
    }
    moving = "motor_position" if motor else "link_position"
    if not (drive or torque):
        return Sensing(("kinematic",), moving=moving, **common)
    if not drive and not (motor and link):
        if not elastic and (link or _travels(record, gear_ratio)):
            return Sensing(("link",), moving=moving, **common)
        if gear_ratio != 1.0 and _travels(record, gear_ratio):
            raise InputError(
                f"{record.name}: model is elastic, the joint moves, and "
                f"{'motor' if link else 'link'}_position is missing; add it or use model = "
                '"hd1"'
            )
        return Sensing(("transmission",), clamped_link=True, moving=moving, **common)
    if torque:
        found: list[str] = []
        if drive and motor:
            found.append("motor")
        if link:
            found.append("link")
        if motor and link and (elastic or _twists(record)):
            found.append("transmission")
        if drive and not motor:
            found.insert(0, "axis")
        if elastic and "transmission" not in found:
            raise InputError(
                f"{record.name}: model is elastic but {'link' if motor else 'motor'}_position is "
                'missing; add it or use model = "hd1"'
            )
        return Sensing(tuple(found), moving=moving, **common)
    if elastic:
        if not (motor and link):
            missing = "link_position" if motor else "motor_position"
            raise InputError(
                f"{record.name}: model is elastic but channel {missing} is missing; add it, or "
                "use a rigid model (hd1, hd2)"
            )
        return Sensing(("sum", "deflection"), moving=moving, **common)
    return Sensing(("axis",), moving=moving, **common)


def check_alike(
    records: Sequence[Record], model: JointModel, labels: Sequence[str] = (), *, once: bool = True
) -> Sensing:
    """What all records let one see, where their channels let one see the same.

    Parameters
    ----------
    records : sequence of Record
    model : JointModel
    labels : sequence of str
        What the records are called in a message, such as their paths; their names by default.
    once : bool
        Refuse a run that is given twice; False where records are compared with a fit that may have
        seen them.

    Raises
    ------
    InputError
        A record that misses a channel which the model needs, or has other channels than the first;
        two that are the same.
    """
    called = list(labels) or [r.name for r in records]
    for k, record in enumerate(records if once else ()):
        twin = next(
            (
                label
                for other, label in zip(records[:k], called, strict=False)
                if _same_samples(record, other)
            ),
            None,
        )
        if twin is not None:
            raise InputError(
                f"{called[k]}: holds the same samples as {twin}; a run counts once, leave one of "
                "the two out"
            )
    found: list[Sensing] = []
    for record, label in zip(records, called, strict=True):
        try:
            found.append(sense(record, model))
        except InputError as error:
            raise InputError(f"{label}: {str(error).removeprefix(record.name + ': ')}") from None
        if _fixed(found[-1]) != _fixed(found[0]) or found[-1].has_coupling != found[0].has_coupling:
            raise InputError(
                f"{label}: {_difference(record, records[0], called[0])}; give records with the "
                "same channels"
            )
    seen = tuple(b for b in found[0].balances if all(b in one.balances for one in found))
    return replace(found[0], balances=seen, **_warmth(records))


def _fixed(sensing: Sensing) -> tuple[str, ...]:
    """The balances that the channels alone decide. Whether a rigid model's records show a twist
    beside their torque depends on the motion of each (:func:`_twists`), even on that of two parts
    of one record: where one does not, the others are judged without that balance.
    """
    if sensing.clamped_link or not sensing.has_torque:
        return sensing.balances
    return tuple(b for b in sensing.balances if b != "transmission")


def _warmth(records: Sequence[Record]) -> dict[str, Any]:
    """What all records have in common about temperature: whether it is recorded and changes,
    its origin, the longest run.
    """
    recorded = all(r.has("temperature") for r in records)
    values = np.concatenate([r["temperature"] for r in records]) if recorded else np.zeros(1)
    return {
        "has_temperature": recorded and float(np.ptp(values)) > TEMPERATURE_CHANGE,
        "temperature_origin": float(values[0]),
        "longest_run": max(float(r.run_age().max(initial=0.0)) for r in records),
    }


def _same_samples(one: Record, other: Record) -> bool:
    """True where every channel of two records is the same: one run given twice, perhaps under
    two names.
    """
    if len(one) != len(other) or set(one.channels) != set(other.channels):
        return False
    return all(
        np.array_equal(values, other[channel], equal_nan=True)
        for channel, values in one.channels.items()
    )


def _difference(record: Record, first: Record, label: str) -> str:
    """Which channel one of two records lacks."""
    here, there = (any(r.has(c) for c in DRIVES) for r in (record, first))
    if here != there:
        what = f"drive channel ({', '.join(DRIVES)})"
        return (
            f"has a {what}, which {label} has not" if here else f"has no {what}, which {label} has"
        )
    for channel in ("link_torque", "motor_position", "link_position", "coupling_torque"):
        if record.has(channel) != first.has(channel):
            return (
                f"has {channel}, which {label} has not"
                if record.has(channel)
                else f"has no {channel}, which {label} has"
            )
    return f"shows another torsion under its link_torque than {label}"


def _travels(record: Record, gear_ratio: float) -> bool:
    """True where the one position of a geared joint moves further than a gear twists: the link is
    not clamped. Without gear the position may be a displacement of any size.
    """
    if gear_ratio == 1.0 or record.kind != "rotary":
        return False
    motor = record.has("motor_position")
    position = record["motor_position"] / gear_ratio if motor else record["link_position"]
    return bool(np.ptp(position[np.isfinite(position)]) > CLAMPED_TRAVEL)


def _twists(record: Record) -> bool:
    """True where torsion can be told from rigid motion at all."""
    q, link = record["motor_position"], record["link_position"]
    slope = float(
        np.dot(q - q.mean(), link - link.mean())
        / max(np.dot(link - link.mean(), link - link.mean()), 1e-300)
    )
    if slope == 0:
        return False
    twist = q / slope - link
    return abs(float(np.corrcoef(twist, record["link_torque"])[0, 1])) > 0.5


def adapt(
    model: JointModel, sensing: Sensing, known: Mapping[str, object] | None = None
) -> JointModel:
    """The model in the form these channels can carry: one inertia for one balance, load from
    gravity and motion without a torque sensor.
    """
    if sensing.clamped_link:
        # torque against twist shows the transmission, whatever else the model has or has not
        model = replace(model if model.is_elastic else model.add(TWIST), inertias=())
    elif sensing.kinematic:
        # the twist is all that is seen of the joint; what is of the motor keeps its values
        model = model if model.is_elastic else model.add(TWIST)
    elif sensing.balances == ("axis",) and not set(SIDE_INERTIAS) & set(known or ()):
        model = replace(model, inertias=TOTAL_INERTIA)
    if sensing.one_sided:
        terms = tuple(
            t for t in model.terms if not (t.place == "link" and model.has(t.effect.key, "motor"))
        )
        model = replace(model, terms=terms)
    # without gear and second encoder the axis is its own spring: displacement laws act on its
    # position
    direct = (
        sensing.balances == ("axis",)
        and not sensing.both_positions
        and abs(model.gear_ratio) == 1.0
    )
    return replace(
        model,
        load_from="torque" if sensing.has_torque and not sensing.clamped_link else "gravity",
        clamped_link=sensing.clamped_link or direct,
    )


def idle_shapes(model: JointModel, sensing: Sensing) -> dict[str, float]:
    """Parameters that shape what stands in for a signal, where that signal is recorded: they have
    nothing to shape and keep their start.
    """
    return {p.name: p.start for p in model.parameters if p.in_place_of in sensing.recorded}


def drive_torque(record: Record, joint: Joint) -> FloatArray:
    """n Km I, link-referred [N.m].

    Raises
    ------
    InputError
        No drive channel; current without a motor constant.
    """
    if not any(record.has(channel) for channel in DRIVES):
        raise InputError(
            f"{record.name}: no {', '.join(DRIVES[:-1])} or {DRIVES[-1]} says what drives the "
            "joint; record one of them or map it in [columns]"
        )
    if record.has("motor_torque"):
        return np.asarray(record["motor_torque"] * joint.gear_ratio, dtype=np.float64)
    if record.has("motor_current"):
        if joint.torque_per_current is None:
            raise InputError(
                f"{joint.source or joint.name}: motor_current needs motor_constant (Nm/A on the "
                "motor shaft) or torque_per_current in [joint]"
            )
        return np.asarray(record["motor_current"] * joint.torque_per_current, dtype=np.float64)
    return np.asarray(record["motor_voltage"] * (joint.torque_per_voltage or 1.0), dtype=np.float64)


def signals_of(record: Record, joint: Joint, sensing: Sensing) -> dict[str, FloatArray]:
    """Measured signals by the names of :class:`casadi_models.Signals`, link-referred, full rate."""
    out: dict[str, FloatArray] = {}
    ratio = joint.gear_ratio
    if sensing.has_drive:
        out["drive"] = drive_torque(record, joint)
    motor = record["motor_position"] / ratio if record.has("motor_position") else None
    link = np.asarray(record["link_position"]) if record.has("link_position") else None
    one = motor if motor is not None else link
    if one is not None:
        out["motor_position"] = np.asarray(motor if motor is not None else one)
        out["link_position"] = np.asarray(link if link is not None else one)
    if sensing.has_torque:
        out["torque"] = np.asarray(record["link_torque"])
    if sensing.has_coupling:
        out["coupling_torque"] = np.asarray(record["coupling_torque"])
    out["temperature"] = (
        record["temperature"] - sensing.temperature_origin
        if sensing.has_temperature
        else warm_up(record, sensing.longest_run)
    )
    return out


def warm_up(record: Record, longest: float = 0.0) -> FloatArray:
    """Stand-in for a temperature that was not recorded: 0 where a run starts, towards 1 at the end
    of the longest run.

    Time counts anew where the stamps go back; the course is that of a first-order warm-up with a
    time constant of a third of the longest run.

    Parameters
    ----------
    record : Record
    longest : float
        Longest run of all records that are judged together [s]; that of this record where it is
        longer.
    """
    age = record.run_age()
    return np.asarray(
        1.0 - np.exp(-3.0 * age / max(float(age.max(initial=0.0)), longest, 1e-9)), dtype=np.float64
    )
