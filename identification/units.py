"""Unit strings to SI: one small table, products, powers, and a dimension check.

A unit is written like ``N.m/rad``, ``kg.m2``, ``rad/s2``, ``Nm/A`` or ``N*m*s/rad``: names from the table, joined by
``.`` or ``*``, divided by ``/``, each with an optional power (``m2``, ``m^2``, ``s-1``).  A product after a division
is refused as ambiguous unless it is bracketed: ``N.m/(rad.s)``.  The exponents are those of a base unit in FMI 2.0
(specification 2.2.2): ``value in SI = factor * value in unit + offset``.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from identification._unit_table import ALIASES, BASE_NAMES, COUNTS, QUANTITIES, RAD, TABLE, TURN, BaseUnit
from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]

__all__ = ["BASE_NAMES", "QUANTITIES", "BaseUnit", "base_unit", "check_unit", "from_si", "same_dimension", "to_si"]

_TOKEN: Final = re.compile(r"g0(?!\d)|[A-Za-zµμ°%Ω]+|[-+]?\d+|\*\*|[\^.*·⋅/()]|\S")


def _name(token: str, counts_per_turn: float | None) -> BaseUnit:
    token = token.replace("µ", "u").replace("μ", "u").replace("Ω", "Ohm")
    token = ALIASES.get(token, token)
    if token in COUNTS:
        if counts_per_turn is None:
            raise InputError(f"unit {token!r} needs counts_per_turn: give the encoder counts of one turn")
        if not (math.isfinite(counts_per_turn) and counts_per_turn > 0.0):
            raise InputError(f"counts_per_turn is {counts_per_turn!r}: give a positive number")
        return BaseUnit(rad=1, factor=TURN / counts_per_turn)
    if token not in TABLE:
        raise InputError(f"unit {token!r} is not known")
    return TABLE[token]


class _Parser:
    """Recursive descent over ``product := factor (('.'|'*'|'/') factor)*``."""

    def __init__(self, text: str, counts_per_turn: float | None) -> None:
        self.text = text
        self.tokens = _TOKEN.findall(text)
        self.place = 0
        self.counts = counts_per_turn

    def peek(self) -> str:
        return self.tokens[self.place] if self.place < len(self.tokens) else ""

    def take(self) -> str:
        token = self.peek()
        self.place += 1
        return token

    def product(self) -> BaseUnit:
        unit = self.factor()
        divided = False
        while self.peek() in {".", "*", "·", "⋅", "/"}:
            if self.take() == "/":
                divided = True
                unit = unit.times(self.factor().power(-1))
            elif divided:
                raise InputError("a product after '/' is ambiguous: use brackets, as in N.m/(rad.s)")
            else:
                unit = unit.times(self.factor())
        return unit

    def factor(self) -> BaseUnit:
        token = self.take()
        if token == "(":
            unit = self.product()
            if self.take() != ")":
                raise InputError("a bracket is not closed")
        elif token == "":
            raise InputError("it ends where a unit is expected")
        else:
            unit = _name(token, self.counts)
        if self.peek() in {"^", "**"}:
            self.take()
            if not re.fullmatch(r"[-+]?\d+", self.peek()):
                raise InputError("a power must be a whole number")
        if self.peek() and re.fullmatch(r"[-+]?\d+", self.peek()):
            unit = unit.power(int(self.take()))
        return unit


@lru_cache(maxsize=1024)
def base_unit(unit: str, counts_per_turn: float | None = None) -> BaseUnit:
    """Read a unit string.

    Parameters
    ----------
    unit : str
        For example ``"N.m/rad"``.
    counts_per_turn : float, optional
        Encoder counts of one turn; needed where the unit says ``counts``.

    Returns
    -------
    BaseUnit
        Exponents, factor and offset as FMI 2.0 wants them.

    Raises
    ------
    InputError
        If the unit is not known or cannot be read.
    """
    text = unit.strip()
    if not text:
        raise InputError("the unit is empty: write one, '1' for none")
    alone = ALIASES.get(text, text)
    if alone in TABLE:
        return TABLE[alone]
    parser = _Parser(text, counts_per_turn)
    try:
        result = parser.product()
        if parser.peek():
            raise InputError(f"{parser.peek()!r} is not expected there")
    except InputError as error:
        detail = "" if str(error) == f"unit {text!r} is not known" else f" ({error})"
        raise InputError(f"unit {text!r} is not understood{detail}: write it like N.m/rad, rad/s, mA, kg.m2") from None
    return result


def same_dimension(first: BaseUnit, second: BaseUnit) -> bool:
    """Whether two units measure the same kind of quantity.

    For purely kinematic quantities (angle, speed, frequency) the radian counts as a dimension, so that ``1/s`` is not
    taken for an angular velocity.  Where mass or current enters, it does not: stiffness is written both as N.m/rad
    and as N.m.
    """
    a, b = first.exponents, second.exponents
    if a[:RAD] != b[:RAD]:
        return False
    kinematic = not any(a[i] for i in (0, 3, 4, 5, 6))
    return a[RAD] == b[RAD] if kinematic else True


def _where(channel: str | None) -> str:
    return f"channel {channel}: " if channel else ""


def check_unit(unit: str, kind: str, counts_per_turn: float | None = None, channel: str | None = None) -> BaseUnit:
    """Read a unit and refuse it where it does not measure the wanted quantity.

    Parameters
    ----------
    unit : str
        Unit of the values.
    kind : str
        A name in `QUANTITIES` (``"angle"``) or the SI unit wanted (``"rad"``).
    counts_per_turn : float, optional
        Encoder counts of one turn.
    channel : str, optional
        Named in the message.

    Raises
    ------
    InputError
        If the unit is unknown or of another dimension; the message names unit and channel.
    """
    target = QUANTITIES.get(kind, kind)
    wanted = base_unit(target)
    text = unit.strip()
    if target == "K" and text in {"C", "F"}:
        text = f"deg{text}"
    try:
        found = base_unit(text, counts_per_turn)
    except InputError as error:
        raise InputError(f"{_where(channel)}{error}") from None
    if not same_dimension(found, wanted):
        hint = "; standard gravity is written g0" if text == "g" else ""
        raise InputError(f"{_where(channel)}unit {unit!r} does not fit, a unit of the kind {target} is wanted{hint}")
    return found


def to_si(
    values: npt.ArrayLike,
    unit: str,
    kind: str | None = None,
    *,
    counts_per_turn: float | None = None,
    channel: str | None = None,
) -> FloatArray:
    """Convert values to SI.

    Parameters
    ----------
    values : array_like
        Values in `unit`, any shape.
    unit : str
        Their unit.
    kind : str, optional
        Quantity (`QUANTITIES`) or SI unit they must have; without it the dimension is not checked.
    counts_per_turn : float, optional
        Encoder counts of one turn, where the unit is ``counts``.
    channel : str, optional
        Named in error messages.

    Returns
    -------
    ndarray of float
        The same shape, in SI.

    Raises
    ------
    InputError
        If the unit is unknown or of another dimension.
    """
    base = base_unit(unit, counts_per_turn) if kind is None else check_unit(unit, kind, counts_per_turn, channel)
    array = np.asarray(values, dtype=np.float64)
    if base.factor == 1.0 and base.offset == 0.0:
        return array
    scaled: FloatArray = array * base.factor
    if base.offset:
        scaled += base.offset
    return scaled


def from_si(values: npt.ArrayLike, unit: str, counts_per_turn: float | None = None) -> FloatArray:
    """Convert SI values to a unit (the inverse of `to_si`)."""
    base = base_unit(unit, counts_per_turn)
    result: FloatArray = (np.asarray(values, dtype=np.float64) - base.offset) / base.factor
    return result
