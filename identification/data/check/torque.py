"""Check of the torque channels against each other: unit, sign and scale of drive and link
torque.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from identification.data.check.finding import Finding

if TYPE_CHECKING:
    from identification.data.record import FloatArray, Record

_WINDOW: Final = 0.05
"""Length over which the channels are averaged before they are compared [s]."""
_PARTIAL: Final = 0.8
"""Partial correlation from which the two torques are said to follow each other."""
_LEFT: Final = 0.02
"""Share of the link torque's power that must be left beside a spring for the spring to be among
the terms.
"""
_GIVEN: Final = 0.08
"""Share of the work moved that a passive joint cannot give back over whole cycles."""
_REFUSE: Final = 20.0
"""Slope of the drive on the link torque, or one over it, from which the units are refused: no loss
of a gear is so large.
"""
_WARN: Final = 1.5
"""The same for a word of doubt: that of a gear which loses a third of its torque."""
_NO_SPRING: Final = 1e-3
"""Share of the link torque's power that must be left where the spring is not among the terms."""
_UNIT: Final = (0.75, 1.33)
"""How far a slope may be from a unit's factor for the unit to be named: losses and the motor
constant's tolerance, and far from the next factor.
"""
_STEADY: Final = (0.05, 0.95)
"""Speed, as a share of this quantile of the speeds, above which friction has its direction."""

_FACTORS: Final = (
    (1e3, "a factor 1000: N.mm or mA were taken for N.m or A, or kN.m"),
    (1e2, "a factor 100: N.cm was taken for N.m"),
    (0.1129848, "inch-pounds were taken for N.m"),
)


def check_torque(
    record: Record, gear_ratio: float | None, torque_per_current: float | None
) -> list[Finding]:
    """Compare the link torque with the drive torque, which it must follow with a slope near one.

    Block averages of the drive are regressed on the link torque beside direction, velocity,
    acceleration and a constant of the motor (inertia and friction); the slope of the torque is 1 in
    a joint with right units.

    Parameters
    ----------
    record : Record
    gear_ratio : float, optional
        Refers `motor_torque` to the link.
    torque_per_current : float, optional
        Link-referred torque per current [N.m/A].

    Returns
    -------
    list of Finding
        Empty where the channels or the motion do not allow the comparison.
    """
    position = next((c for c in ("motor_position", "link_position") if record.has(c)), None)
    if position is None or not record.has("link_torque") or record.kind != "rotary":
        return []
    given = _drive(record, gear_ratio, torque_per_current)
    if given is None:
        return []
    drive, name = given
    sign = math.copysign(1.0, gear_ratio or 1.0) if position == "motor_position" else 1.0
    found = _slope(record, drive, record[position] * sign)
    if found is None:
        return []
    slope = found
    said = f"{record.name}: the drive torque from {name} is {slope:.3g} times what link_torque says"
    size = abs(slope)
    if slope < 0:
        advice = (
            "the sign of one is reversed; set sign = -1 for the wrong one in [columns], or "
            "reverse motor_constant"
        )
        return [Finding("refuse", "torque", f"{said}: {advice}", "link_torque")]
    guess = _guess(size)
    if guess and max(size, 1 / size) > _REFUSE:
        advice = (
            "correct the unit or scale of link_torque in [columns], or motor_constant "
            "(torque_per_current) and gear_ratio in [joint]"
        )
        return [Finding("refuse", "torque", f"{said} ({guess}): {advice}", "link_torque")]
    if max(size, 1 / size) > _WARN:
        why = f"{guess or 'a scale is wrong'}, or a strong torque is missing from the model"
        return [
            Finding(
                "warn",
                "torque",
                f"{said} ({why}): check unit and scale of both, and motor_constant",
                "link_torque",
            )
        ]
    return [
        Finding(
            "ok",
            "torque",
            f"{record.name}: link_torque follows the drive torque (factor {slope:.3g})",
            "link_torque",
        )
    ]


def _drive(
    record: Record, gear_ratio: float | None, torque_per_current: float | None
) -> tuple[FloatArray, str] | None:
    """Drive torque referred to the link [N.m] and its channel, None where what refers it is not
    given.
    """
    if record.has("motor_torque") and gear_ratio is not None:
        return record["motor_torque"] * gear_ratio, "motor_torque"
    if record.has("motor_current") and torque_per_current is not None:
        return record["motor_current"] * torque_per_current, "motor_current"
    return None


def check_work(
    record: Record, gear_ratio: float | None, torque_per_current: float | None
) -> list[Finding]:
    """Refuse a drive that takes energy out of a joint that comes back to where it was: its sign is
    reversed.

    The work is that between the first and the last passage of one position in one direction, where
    what gravity and springs store is the same again; friction can only use up energy. With a torque
    sensor the sign is `check_torque`'s: who turns the joint from outside is measured then.
    """
    motor = record.has("motor_position")
    if record.has("link_torque") or (not motor and not record.has("link_position")):
        return []
    ratio = gear_ratio or 1.0  # work is the same on either side of the gear
    given = _drive(record, ratio, torque_per_current)
    if given is None:
        return []
    position = record["motor_position"] / ratio if motor else record["link_position"]
    drive, name = given
    net = whole = 0.0
    for part in record.segments():
        q, tau = position[part], drive[part]
        power = 0.5 * (tau[1:] + tau[:-1]) * np.diff(q)
        between = _cycles(q)
        net += float(power[between].sum())
        whole += float(np.abs(power[between]).sum())
    if whole == 0.0 or net >= -_GIVEN * whole:
        return []
    advice = (
        "set sign = -1 for it in [columns] or reverse motor_constant; a joint driven from "
        "outside needs a torque sensor"
    )
    message = (
        f"{record.name}: {name} takes energy out of the joint over whole cycles ({net:.3g} "
        f"of {whole:.3g} J moved): is its sign reversed? {advice}"
    )
    return [Finding("refuse", "work", message, name)]


CYCLE_SHARE: Final = 0.25
"""Share of a stretch's range that a cycle covers at least: passages that noise makes as one
level is crossed slowly cover none.
"""


def _cycles(q: FloatArray) -> slice:
    """Longest stretch between two passages of one position in one direction; empty without."""
    best = slice(0, 0)
    for level in np.quantile(q, (0.25, 0.5, 0.75)):
        over = q >= level
        for passing in (
            np.flatnonzero(~over[:-1] & over[1:]),
            np.flatnonzero(over[:-1] & ~over[1:]),
        ):
            if len(passing) > 1 and passing[-1] - passing[0] > best.stop - best.start:
                best = slice(int(passing[0]), int(passing[-1]))
    return (
        best
        if best.stop > best.start and np.ptp(q[best]) >= CYCLE_SHARE * np.ptp(q)
        else slice(0, 0)
    )


def _guess(size: float) -> str:
    """The unit that was probably mistaken; empty where the factor is none of the known ones."""
    for value, sentence in _FACTORS:
        if any(_UNIT[0] < size / f < _UNIT[1] for f in (value, 1 / value)):
            return sentence
    return ""


def _slope(record: Record, drive: FloatArray, position: FloatArray) -> float | None:
    """Slope of the drive on the link torque beside the motor's own terms; None without a clear
    relation.
    """
    parts = [
        _averages(record.time[s], drive[s], record["link_torque"][s], position[s])
        for s in record.segments()
    ]
    rows = np.concatenate([p for p in parts if p is not None] or [np.empty((0, 9))])
    if len(rows) < 30:
        return None
    sizes = np.maximum(np.linalg.norm(rows[:, :2], axis=0), 1e-300)
    both = rows[:, :2] / sizes
    others = rows[:, 2:] / np.maximum(np.linalg.norm(rows[:, 2:], axis=0), 1e-300)
    for spring in (True, False):
        used = others if spring else others[:, :-1]
        left = both - used @ np.linalg.lstsq(used, both, rcond=1e-9)[0]
        (dd, td), (_, tt) = (left.T @ left).tolist()
        if tt <= (_LEFT if spring else _NO_SPRING) * float(both[:, 1] @ both[:, 1]) or dd <= 0.0:
            continue
        partial = td / math.sqrt(tt * dd)
        if abs(partial) >= _PARTIAL:
            # geometric mean of both regressions: noise in either channel does not pull it to zero
            return math.copysign(math.sqrt(dd / tt) * sizes[0] / sizes[1], partial)
    return None


def _averages(
    time: FloatArray, drive: FloatArray, torque: FloatArray, position: FloatArray
) -> FloatArray | None:
    """Rows of block means away from standstill: drive, torque, direction, powers of the
    velocity, acceleration, 1, position.
    """
    if len(time) < 16:
        return None
    size = max(1, round(_WINDOW / float(np.median(np.diff(time)))))
    count = len(time) // size
    if count < 5:
        return None
    mean = [
        x[: count * size].reshape(count, size).mean(axis=1) for x in (time, drive, torque, position)
    ]
    t, q = mean[0], mean[3]
    velocity = (q[2:] - q[:-2]) / (t[2:] - t[:-2])
    acceleration = (
        2
        * ((q[2:] - q[1:-1]) / (t[2:] - t[1:-1]) - (q[1:-1] - q[:-2]) / (t[1:-1] - t[:-2]))
        / (t[2:] - t[:-2])
    )
    moving = np.abs(velocity) > _STEADY[0] * float(np.quantile(np.abs(velocity), _STEADY[1]))
    steady = (
        moving
        & np.roll(moving, 1)
        & np.roll(moving, -1)
        & (np.sign(velocity) == np.sign(np.roll(velocity, 1)))
    )
    away = np.sign(velocity)
    table = [
        mean[1][1:-1],
        mean[2][1:-1],
        away,
        velocity,
        velocity * np.abs(velocity),
        velocity**3,
        acceleration,
        np.ones(count - 2),
        q[1:-1],
    ]
    return np.asarray(np.column_stack(table)[steady], dtype=np.float64)
