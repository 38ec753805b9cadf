"""Quantities that a law may use, all link-referred and in SI units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Final, final

import casadi as ca

Expression = Any
"""A CasADi expression (SX or MX) or a number; CasADi carries no type hints."""

SIGNAL_UNITS: Final = {
    "time": "s",
    "drive": "N.m",
    "drive_rate": "N.m/s",
    "motor_position": "rad",
    "motor_velocity": "rad/s",
    "motor_acceleration": "rad/s2",
    "motor_jerk": "rad/s3",
    "link_position": "rad",
    "link_velocity": "rad/s",
    "link_acceleration": "rad/s2",
    "link_jerk": "rad/s3",
    "torque": "N.m",
    "torque_rate": "N.m/s",
    "temperature": "K",
    "coupling_torque": "N.m",
}


@final
@dataclass(frozen=True)
class Signals:
    """Signals of the joint at one instant (symbols, numbers or arrays alike).

    Motor quantities are divided by the gear ratio (link-referred); `drive` is the motor torque
    times the gear ratio, n Km I; `torque` is what the gear puts into the link; `coupling_torque` is
    what acts on the link from elsewhere (other axes, a rigid-body model of the arm), positive where
    it drives the link.
    """

    time: Expression
    drive: Expression
    drive_rate: Expression
    motor_position: Expression
    motor_velocity: Expression
    motor_acceleration: Expression
    motor_jerk: Expression
    link_position: Expression
    link_velocity: Expression
    link_acceleration: Expression
    link_jerk: Expression
    torque: Expression
    torque_rate: Expression
    temperature: Expression
    coupling_torque: Expression

    @staticmethod
    def names() -> tuple[str, ...]:
        """Names of the signals in the order of :meth:`vector`."""
        return tuple(f.name for f in fields(Signals))

    @staticmethod
    def symbols() -> Signals:
        """Fresh CasADi SX symbols for every signal."""
        return Signals(**{name: ca.SX.sym(name) for name in Signals.names()})

    def vector(self) -> Expression:
        """All signals stacked to one column."""
        return ca.vertcat(*(getattr(self, name) for name in Signals.names()))

    def with_values(self, **values: Expression) -> Signals:
        """A copy with some signals replaced."""
        return replace(self, **values)

    def __repr__(self) -> str:
        return one_line(self)


@final
@dataclass(frozen=True)
class LocalSignals:
    """What a law sees: the signals at the place where the effect acts.

    Attributes
    ----------
    position, velocity, acceleration : expression
        Of the side on which the effect acts [rad, rad/s, rad/s2]; of the torsion where the effect
        acts on the transmission.
    direction : expression
        Smoothed sign of the velocity, tanh(velocity / smoothing).
    torsion, torsion_rate : expression
        Twist of the transmission, motor side minus link side, kinematic error taken off.
    torque, load : expression
        Torque that the gear puts into the link; load that presses the gear's teeth (the same where
        it is measured or simulated, the gravity law where it is not).
    reading, reading_rate : expression
        The channel itself, for effects that act on a sensor or on the drive.
    motor_angle : expression
        Angle of the motor shaft itself (gear ratio times motor position) [rad].
    time, temperature, memory : expression
        Time [s], temperature [K], internal states of the effect.
    gear_ratio : expression
        Signed ratio theta_motor/theta_link.
    clock : expression
        Duration h > 0 of the step that a memory makes [s]; only a memory that runs with time uses
        it.
    """

    position: Expression
    velocity: Expression
    acceleration: Expression
    direction: Expression
    torsion: Expression
    torsion_rate: Expression
    torque: Expression
    load: Expression
    reading: Expression
    reading_rate: Expression
    motor_angle: Expression
    time: Expression
    temperature: Expression
    memory: tuple[Expression, ...]
    gear_ratio: Expression
    clock: Expression = math.nan

    def __repr__(self) -> str:
        return one_line(self)


def one_line(thing: Any) -> str:
    """A dataclass in one line: arrays by their shape, mappings by their keys, the rest as it is."""
    parts = (f"{f.name}={_shortly(getattr(thing, f.name))}" for f in fields(thing) if f.repr)
    return f"{type(thing).__name__}({', '.join(parts)})"


def _shortly(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(map(str, value)) + "}"
    size = getattr(value, "shape", None)
    if size is None:
        return repr(value)
    return f"{size} array" if max(size, default=0) > 1 else str(value)


def gain_error(reading: Expression, error: Expression) -> Expression:
    """True value minus reading of a sensor that reads (1 + error) times the true value."""
    return -reading * error / (1 + error)
