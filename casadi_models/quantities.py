"""Units as exponents: one table, one parser, and what follows from the exponents by arithmetic.

A unit is written like ``N.m/rad``, ``kg.m2``, ``rad/s2``, ``Nm/A`` or ``N*m*s/rad``: names from the
table, joined by ``.`` or ``*``, divided by ``/``, each with an optional power (``m2``, ``m^2``,
``s-1``). The exponents are those of a base unit in FMI 2.0 (specification 2.2.2): ``value in SI =
factor * value in unit + offset``.

Two rules follow from the exponents and need no table of their own:

*Side of the gear.* A lossless gear of ratio n keeps energy, time, temperature and current; it
multiplies the angle by n. A value whose unit holds the angle to the power e is therefore multiplied
by n^-e on its way from the motor shaft to the link. SI leaves radians out: a torque is an energy
per angle (N.m = J/rad), an inertia an energy per squared angular velocity (kg.m2 = J.s2/rad2). So
each newton stands for one radian that is not written, below the line, and each kilogram for two. A
torque goes with n, a stiffness and an inertia with n^2, a cubic stiffness with n^4, a compliance
with n^-2.

*Linear twin.* The same parameter of a linear axis has a length where the rotary one has an angle:
rad becomes m, N.m becomes N and kg.m2 becomes kg; each newton loses one metre and each kilogram
two.

The module imports nothing of the project: it is bundled alone into an FMU.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final, final

BASE_NAMES: Final = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
RAD: Final = BASE_NAMES.index("rad")


class UnitError(ValueError):
    """A unit that cannot be read, or that does not belong where it is used; one line."""


@final
@dataclass(frozen=True)
class BaseUnit:
    """A unit as FMI 2.0 writes it: exponents of the SI base units, factor and offset to SI.

    ``value_si = factor * value + offset``.

    Attributes
    ----------
    kg, m, s, A, K, mol, cd, rad : int
        Exponents as written.
    factor, offset : float
        To SI.
    unwritten : int
        Power of the radian that the names used leave out: -1 for each newton, -2 for each kilogram.
        It is no part of the unit itself, so two units are equal without it.
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
    unwritten: int = field(default=0, compare=False)

    @property
    def exponents(self) -> tuple[int, ...]:
        """Exponents in the order of `BASE_NAMES`."""
        return (self.kg, self.m, self.s, self.A, self.K, self.mol, self.cd, self.rad)

    @property
    def named_exponents(self) -> dict[str, int]:
        """Exponents other than 0 by name, as the attributes of FMI's ``BaseUnit``."""
        return {n: e for n, e in zip(BASE_NAMES, self.exponents, strict=True) if e}

    def power(self, exponent: int) -> BaseUnit:
        """Return this unit raised to an integer power."""
        return _unit(
            tuple(e * exponent for e in self.exponents),
            self.factor**exponent,
            self.unwritten * exponent,
        )

    def times(self, other: BaseUnit) -> BaseUnit:
        """Return the product of two units."""
        exponents = tuple(a + b for a, b in zip(self.exponents, other.exponents, strict=True))
        return _unit(exponents, self.factor * other.factor, self.unwritten + other.unwritten)


def _unit(exponents: tuple[int, ...], factor: float = 1.0, unwritten: int = 0) -> BaseUnit:
    names = dict(zip(BASE_NAMES, exponents, strict=True))
    return BaseUnit(**names, factor=factor, unwritten=unwritten)


# --- the table ------------------------------------------------------------------------------------

_GRAVITY: Final = 9.80665  # m/s2, exact by definition
_POUND: Final = 0.45359237  # kg, exact by definition
TURN: Final = 2.0 * math.pi

_PLAIN: Final = BaseUnit()
_ANGLE: Final = BaseUnit(rad=1)
_SPEED: Final = BaseUnit(rad=1, s=-1)
_LENGTH: Final = BaseUnit(m=1)
_TIME: Final = BaseUnit(s=1)
_PER_TIME: Final = BaseUnit(s=-1)
_CURRENT: Final = BaseUnit(A=1)
_MASS: Final = BaseUnit(kg=1, unwritten=-2)
_FORCE: Final = BaseUnit(kg=1, m=1, s=-2, unwritten=-1)
_TORQUE: Final = _FORCE.times(_LENGTH)
_ENERGY: Final = BaseUnit(kg=1, m=2, s=-2)
_POWER: Final = BaseUnit(kg=1, m=2, s=-3)
_VOLT: Final = BaseUnit(kg=1, m=2, s=-3, A=-1)
_OHM: Final = BaseUnit(kg=1, m=2, s=-3, A=-2)
_HENRY: Final = BaseUnit(kg=1, m=2, s=-2, A=-2)
_INERTIA: Final = _MASS.times(_LENGTH.power(2))
_KELVIN: Final = BaseUnit(K=1)


def _scaled(unit: BaseUnit, factor: float, offset: float = 0.0) -> BaseUnit:
    return replace(unit, factor=factor, offset=offset)


TABLE: Final[Mapping[str, BaseUnit]] = {
    "1": _PLAIN,
    "%": _scaled(_PLAIN, 0.01),
    # angle
    "rad": _ANGLE,
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
    "nm": _scaled(_LENGTH, 1e-9),
    "in": _scaled(_LENGTH, 0.0254),
    "ft": _scaled(_LENGTH, 0.3048),
    # time and frequency
    "s": _TIME,
    "ns": _scaled(_TIME, 1e-9),
    "min": _scaled(_TIME, 60.0),
    "h": _scaled(_TIME, 3600.0),
    "Hz": _PER_TIME,
    # electrical
    "A": _CURRENT,
    "V": _VOLT,
    "Ohm": _OHM,
    "H": _HENRY,
    "Wb": BaseUnit(kg=1, m=2, s=-2, A=-1),
    # mass, inertia
    "kg": _MASS,
    "g": _scaled(_MASS, 1e-3),
    "lb": _scaled(_MASS, _POUND),
    "kgm2": _INERTIA,
    "kgcm2": _scaled(_INERTIA, 1e-4),
    "gcm2": _scaled(_INERTIA, 1e-7),
    "g0": _scaled(BaseUnit(m=1, s=-2), _GRAVITY),
    # force, torque, energy
    "N": _FORCE,
    "lbf": _scaled(_FORCE, _POUND * _GRAVITY),
    "ozf": _scaled(_FORCE, _POUND * _GRAVITY / 16.0),
    "kip": _scaled(_FORCE, _POUND * _GRAVITY * 1e3),
    "kgf": _scaled(_FORCE, _GRAVITY),
    "Pa": BaseUnit(kg=1, m=-1, s=-2),
    "Nm": _TORQUE,
    "Ncm": _scaled(_TORQUE, 1e-2),
    "Nmm": _scaled(_TORQUE, 1e-3),
    "Nms": _TORQUE.times(_TIME),
    "J": _ENERGY,
    "W": _POWER,
    # temperature
    "K": _KELVIN,
    "degC": _scaled(_KELVIN, 1.0, 273.15),
    "degF": _scaled(_KELVIN, 5.0 / 9.0, 273.15 - 32.0 * 5.0 / 9.0),
    "mol": BaseUnit(mol=1),
    "cd": BaseUnit(cd=1),
}

PREFIXES: Final = {"u": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}
"""Prefixes of SI that a joint meets; nano is written out above for metre and second."""
PREFIXED: Final = frozenset(
    ["rad", "m", "s", "Hz", "A", "V", "Ohm", "H", "Wb", "g", "N", "Nm", "J", "W", "Pa", "K", "mol"]
)
"""Names that take a prefix."""

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
COUNTS: Final = frozenset(
    ["count", "counts", "cnt", "cts", "inc", "incs", "increment", "increments", "tick", "ticks"]
)

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


def named(name: str, counts_per_turn: float | None = None) -> BaseUnit:
    """The unit of one name, without powers.

    Raises
    ------
    UnitError
        A name that is not known; counts without counts_per_turn.
    """
    name = name.replace("µ", "u").replace("μ", "u").replace("Ω", "Ohm")
    name = ALIASES.get(name, name)
    if name in COUNTS:
        if counts_per_turn is None:
            raise UnitError(
                f"unit {name!r} needs counts_per_turn: give the encoder counts of one turn"
            )
        if not (math.isfinite(counts_per_turn) and counts_per_turn > 0.0):
            raise UnitError(f"counts_per_turn is {counts_per_turn!r}: give a positive number")
        return _scaled(_ANGLE, TURN / counts_per_turn)
    if name in TABLE:
        return TABLE[name]
    if name[:1] in PREFIXES and name[1:] in PREFIXED:
        unit = TABLE[name[1:]]
        return _scaled(unit, PREFIXES[name[0]] * unit.factor)
    raise UnitError(f"unit {name!r} is not known")


# --- the parser -----------------------------------------------------------------------------------

_TOKEN: Final = re.compile(r"g0(?!\d)|[A-Za-zµμ°%Ω]+|[-+]?\d+|\*\*|[\^.*·⋅/()]|\S")
_WHOLE: Final = re.compile(r"[-+]?\d+")
Factors = tuple[tuple[str, int], ...]
_LONGEST: Final = 64
"""Characters of a unit at most; the longest in use, ``N.m.s2/(rad.A)`` and its like, have 20."""
_HIGHEST: Final = 12
"""Largest power that is read; the highest that occurs in a law is 5 (rad5)."""


class _Parser:
    """Recursive descent over ``product := factor (('.'|'*'|'/') factor)*``; gives names with
    their powers.
    """

    def __init__(self, text: str, *, lenient: bool) -> None:
        self.tokens = _TOKEN.findall(text)
        self.place = 0
        self.lenient = lenient

    def peek(self) -> str:
        return self.tokens[self.place] if self.place < len(self.tokens) else ""

    def take(self) -> str:
        token = self.peek()
        self.place += 1
        return token

    def product(self) -> Factors:
        found = self.factor()
        divided = False
        while self.peek() in {".", "*", "·", "⋅", "/"}:
            if self.take() == "/":
                divided = True
            elif divided and not self.lenient:
                raise UnitError("a product after '/' is ambiguous: use brackets, as in N.m/(rad.s)")
            sign = -1 if divided else 1
            found += tuple((name, sign * power) for name, power in self.factor())
        return found

    def factor(self) -> Factors:
        token = self.take()
        if token == "(":
            inner = self.product()
            if self.take() != ")":
                raise UnitError("a bracket is not closed")
        elif token == "":
            raise UnitError("it ends where a unit is expected")
        else:
            inner = ((token, 1),)
        power = 1
        if self.peek() in {"^", "**"}:
            self.take()
            if not _WHOLE.fullmatch(self.peek()):
                raise UnitError("a power must be a whole number")
        if self.peek() and _WHOLE.fullmatch(self.peek()):
            power = int(self.take())
        found = tuple((name, power * own) for name, own in inner)
        if any(abs(own) > _HIGHEST for _, own in found):
            raise UnitError(f"no power may be over {_HIGHEST}")
        return found


@lru_cache(maxsize=1024)
def factors(unit: str, *, lenient: bool = False) -> Factors:
    """Names of a unit with their powers, in the order written.

    Parameters
    ----------
    unit : str
        For example ``"N.m/rad"``, which gives N, m and rad to the powers 1, 1 and -1.
    lenient : bool
        True: everything after a stroke divides, as in the units of other people's FMUs.

    Raises
    ------
    UnitError
        A text that is no unit.
    """
    if len(unit) > _LONGEST:
        raise UnitError(f"longer than {_LONGEST} characters")
    parser = _Parser(unit, lenient=lenient)
    found = parser.product()
    if parser.peek():
        raise UnitError(f"{parser.peek()!r} is not expected there")
    return found


@lru_cache(maxsize=1024)
def base_unit(
    unit: str, counts_per_turn: float | None = None, *, lenient: bool = False
) -> BaseUnit:
    """Read a unit string.

    Parameters
    ----------
    unit : str
        For example ``"N.m/rad"``.
    counts_per_turn : float, optional
        Encoder counts of one turn; needed where the unit says ``counts``.
    lenient : bool
        True: everything after a stroke divides.

    Returns
    -------
    BaseUnit
        Exponents, factor and offset as FMI 2.0 wants them.

    Raises
    ------
    UnitError
        If the unit is not known or cannot be read.
    """
    text = unit.strip()
    if not text:
        raise UnitError("the unit is empty: write one, '1' for none")
    alone = ALIASES.get(text, text)
    if alone in TABLE:
        return TABLE[alone]
    try:
        result = _PLAIN
        for name, power in factors(text, lenient=lenient):
            result = result.times(named(name, counts_per_turn).power(power))
        if not 0.0 < abs(result.factor) < math.inf:
            raise UnitError("its factor to SI is no number that a computer can hold")
    except UnitError as error:
        text = text if len(text) <= _LONGEST else text[:_LONGEST] + "..."
        detail = "" if str(error) == f"unit {text!r} is not known" else f" ({error})"
        raise UnitError(
            f"unit {text!r} is not understood{detail}: write it like N.m/rad, rad/s, mA, kg.m2"
        ) from None
    return result


# --- what follows from the exponents --------------------------------------------------------------


def side_power(unit: str) -> int:
    """Power of the gear ratio by which a motor-side value is multiplied to refer it to the link.

    Parameters
    ----------
    unit : str
        SI unit of a parameter of a rotary joint, or of a linear axis.

    Raises
    ------
    UnitError
        If the unit is not known, or is none of a rotary joint or a linear axis.

    Examples
    --------
    >>> [side_power(u) for u in ("N.m", "N.m/rad", "N.m/rad3", "rad", "kg.m2", "N/m", "s")]
    [1, 2, 4, -1, 2, 2, 0]
    """
    found = base_unit(unit)
    lengths = (
        found.m - 2 * found.kg
    )  # metres beyond those of an energy: a coordinate that is a length
    if lengths and found.rad:
        raise UnitError(
            f"unit {unit!r} has both a length and an angle: it belongs to no side of the gear"
        )
    return -lengths if lengths else -(found.rad + found.unwritten)


@lru_cache(maxsize=256)
def linear_unit(unit: str) -> str:
    """Unit of the same parameter of a linear axis: ``N.m.s/rad`` becomes ``N.s/m``.

    Units that are not known, and those without an angle, a newton or a kilogram, stay as they are.
    """
    try:
        written = factors(unit)
        found = base_unit(unit)
    except UnitError:
        return unit
    if found.m != 2 * found.kg:  # a length already
        return unit
    total: dict[str, int] = {}
    for name, power in written:
        key = "m" if name == "rad" else name
        total[key] = total.get(key, 0) + power
    total["m"] = total.get("m", 0) + found.unwritten
    above = [_powered(n, p) for n, p in total.items() if p > 0 and n != "1"]
    below = [_powered(n, -p) for n, p in total.items() if p < 0]
    divisor = f"({'.'.join(below)})" if len(below) > 1 else "".join(below)
    return (".".join(above) or "1") + (f"/{divisor}" if divisor else "")


def _powered(name: str, power: int) -> str:
    return name if power == 1 else f"{name}{power}"
