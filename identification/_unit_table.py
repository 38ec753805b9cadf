"""The units that are understood, each with its FMI 2.0 base-unit exponents, factor and offset."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, final

if TYPE_CHECKING:
    from collections.abc import Mapping

BASE_NAMES: Final = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
RAD: Final = BASE_NAMES.index("rad")


@final
@dataclass(frozen=True)
class BaseUnit:
    """A unit as FMI 2.0 writes it: exponents of the SI base units, factor and offset to SI.

    ``value_si = factor * value + offset``.
    """

    kg: int = 0
    m: int = 0
    s: int = 0
    A: int = 0
    K: int = 0
    mol: int = 0
    cd: int = 0
    rad: int = 0
    factor: float = 1.0
    offset: float = 0.0

    @property
    def exponents(self) -> tuple[int, ...]:
        """Exponents in the order of `BASE_NAMES`."""
        return (self.kg, self.m, self.s, self.A, self.K, self.mol, self.cd, self.rad)

    def power(self, exponent: int) -> BaseUnit:
        """Return this unit raised to an integer power."""
        return _unit(tuple(e * exponent for e in self.exponents), self.factor**exponent)

    def times(self, other: BaseUnit) -> BaseUnit:
        """Return the product of two units."""
        exponents = tuple(a + b for a, b in zip(self.exponents, other.exponents, strict=True))
        return _unit(exponents, self.factor * other.factor)


def _unit(exponents: tuple[int, ...], factor: float = 1.0, offset: float = 0.0) -> BaseUnit:
    kg, m, s, ampere, kelvin, mol, cd, rad = exponents
    return BaseUnit(kg, m, s, ampere, kelvin, mol, cd, rad, factor, offset)


_GRAVITY: Final = 9.80665  # m/s2, exact by definition
_POUND: Final = 0.45359237  # kg, exact by definition
TURN: Final = 2.0 * math.pi

_LENGTH: Final = BaseUnit(m=1)
_FORCE: Final = BaseUnit(kg=1, m=1, s=-2)
_TORQUE: Final = BaseUnit(kg=1, m=2, s=-2)
_VOLT: Final = BaseUnit(kg=1, m=2, s=-3, A=-1)
_ANGLE: Final = BaseUnit(rad=1)
_TIME: Final = BaseUnit(s=1)
_CURRENT: Final = BaseUnit(A=1)
_MASS: Final = BaseUnit(kg=1)
_SPEED: Final = BaseUnit(rad=1, s=-1)


def _scaled(unit: BaseUnit, factor: float, offset: float = 0.0) -> BaseUnit:
    return replace(unit, factor=factor, offset=offset)


TABLE: Final[Mapping[str, BaseUnit]] = {
    "1": BaseUnit(),
    "%": _scaled(BaseUnit(), 0.01),
    # angle
    "rad": _ANGLE,
    "mrad": _scaled(_ANGLE, 1e-3),
    "urad": _scaled(_ANGLE, 1e-6),
    "deg": _scaled(_ANGLE, math.pi / 180.0),
    "mdeg": _scaled(_ANGLE, math.pi / 180e3),
    "arcmin": _scaled(_ANGLE, math.pi / 10800.0),
    "arcsec": _scaled(_ANGLE, math.pi / 648000.0),
    "rev": _scaled(_ANGLE, TURN),
    "rpm": _scaled(_SPEED, TURN / 60.0),
    "rps": _scaled(_SPEED, TURN),
    # length
    "m": _LENGTH,
    "cm": _scaled(_LENGTH, 1e-2),
    "mm": _scaled(_LENGTH, 1e-3),
    "um": _scaled(_LENGTH, 1e-6),
    "nm": _scaled(_LENGTH, 1e-9),
    "in": _scaled(_LENGTH, 0.0254),
    "ft": _scaled(_LENGTH, 0.3048),
    # time and frequency
    "s": _TIME,
    "ms": _scaled(_TIME, 1e-3),
    "us": _scaled(_TIME, 1e-6),
    "ns": _scaled(_TIME, 1e-9),
    "min": _scaled(_TIME, 60.0),
    "h": _scaled(_TIME, 3600.0),
    "Hz": BaseUnit(s=-1),
    "kHz": _scaled(BaseUnit(s=-1), 1e3),
    # electrical
    "A": _CURRENT,
    "mA": _scaled(_CURRENT, 1e-3),
    "uA": _scaled(_CURRENT, 1e-6),
    "V": _VOLT,
    "mV": _scaled(_VOLT, 1e-3),
    "kV": _scaled(_VOLT, 1e3),
    "Ohm": BaseUnit(kg=1, m=2, s=-3, A=-2),
    "mOhm": _scaled(BaseUnit(kg=1, m=2, s=-3, A=-2), 1e-3),
    "H": BaseUnit(kg=1, m=2, s=-2, A=-2),
    "mH": _scaled(BaseUnit(kg=1, m=2, s=-2, A=-2), 1e-3),
    # mass, inertia
    "kg": _MASS,
    "g": _scaled(_MASS, 1e-3),
    "lb": _scaled(_MASS, _POUND),
    "kgm2": BaseUnit(kg=1, m=2),
    "kgcm2": _scaled(BaseUnit(kg=1, m=2), 1e-4),
    "gcm2": _scaled(BaseUnit(kg=1, m=2), 1e-7),
    "g0": _scaled(BaseUnit(m=1, s=-2), _GRAVITY),
    # force, torque, energy
    "N": _FORCE,
    "mN": _scaled(_FORCE, 1e-3),
    "kN": _scaled(_FORCE, 1e3),
    "lbf": _scaled(_FORCE, _POUND * _GRAVITY),
    "ozf": _scaled(_FORCE, _POUND * _GRAVITY / 16.0),
    "kip": _scaled(_FORCE, _POUND * _GRAVITY * 1e3),
    "kgf": _scaled(_FORCE, _GRAVITY),
    "Nm": _TORQUE,
    "mNm": _scaled(_TORQUE, 1e-3),
    "kNm": _scaled(_TORQUE, 1e3),
    "Ncm": _scaled(_TORQUE, 1e-2),
    "Nmm": _scaled(_TORQUE, 1e-3),
    "Nms": BaseUnit(kg=1, m=2, s=-1),
    "J": _TORQUE,
    "W": BaseUnit(kg=1, m=2, s=-3),
    # temperature
    "K": BaseUnit(K=1),
    "degC": _scaled(BaseUnit(K=1), 1.0, 273.15),
    "degF": _scaled(BaseUnit(K=1), 5.0 / 9.0, 273.15 - 32.0 * 5.0 / 9.0),
    "mol": BaseUnit(mol=1),
    "cd": BaseUnit(cd=1),
}

ALIASES: Final[Mapping[str, str]] = {
    "°": "deg",
    "degree": "deg",
    "degrees": "deg",
    "radian": "rad",
    "radians": "rad",
    "turn": "rev",
    "turns": "rev",
    "revs": "rev",
    "RPM": "rpm",
    "Upm": "rpm",
    "U": "rev",
    "1/min": "rpm",
    "min^-1": "rpm",
    "min-1": "rpm",
    "inch": "in",
    "sec": "s",
    "msec": "ms",
    "usec": "us",
    "°C": "degC",
    "°F": "degF",
    "celsius": "degC",
    "kelvin": "K",
    "ohm": "Ohm",
    "amp": "A",
    "amps": "A",
    "volt": "V",
    "volts": "V",
}
COUNTS: Final = frozenset({"count", "counts", "cnt", "cts", "inc", "incs", "increment", "increments", "tick", "ticks"})

QUANTITIES: Final[Mapping[str, str]] = {
    "time": "s",
    "angle": "rad",
    "angular_velocity": "rad/s",
    "angular_acceleration": "rad/s2",
    "torque": "N.m",
    "inertia": "kg.m2",
    "length": "m",
    "velocity": "m/s",
    "acceleration": "m/s2",
    "force": "N",
    "mass": "kg",
    "current": "A",
    "voltage": "V",
    "temperature": "K",
    "stiffness": "N.m/rad",
    "cubic_stiffness": "N.m/rad3",
    "damping": "N.m.s/rad",
    "torque_constant": "N.m/A",
    "dimensionless": "1",
}
