"""Unit expressions to FMI 2.0 base-unit exponents (FMI 2.0.4, section 2.2.2)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import final
from xml.etree.ElementTree import Element, SubElement

from identification.errors import InputError

BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
_Entry = tuple[float, dict[str, int]]
_NAMED: dict[str, _Entry] = {
    **{base: (1.0, {base: 1}) for base in BASE},
    "1": (1.0, {}),
    "%": (0.01, {}),
    "N": (1.0, {"kg": 1, "m": 1, "s": -2}),
    "J": (1.0, {"kg": 1, "m": 2, "s": -2}),
    "W": (1.0, {"kg": 1, "m": 2, "s": -3}),
    "V": (1.0, {"kg": 1, "m": 2, "s": -3, "A": -1}),
    "Ohm": (1.0, {"kg": 1, "m": 2, "s": -3, "A": -2}),
    "H": (1.0, {"kg": 1, "m": 2, "s": -2, "A": -2}),
    "Wb": (1.0, {"kg": 1, "m": 2, "s": -2, "A": -1}),
    "Hz": (1.0, {"s": -1}),
    "Pa": (1.0, {"kg": 1, "m": -1, "s": -2}),
    "g": (1e-3, {"kg": 1}),
    "min": (60.0, {"s": 1}),
    "h": (3600.0, {"s": 1}),
    "deg": (math.pi / 180.0, {"rad": 1}),
    "arcmin": (math.pi / 10800.0, {"rad": 1}),
    "rev": (2.0 * math.pi, {"rad": 1}),
    "rpm": (2.0 * math.pi / 60.0, {"rad": 1, "s": -1}),
}
_PREFIX = {"u": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}
_FACTOR = re.compile(r"(?P<name>[A-Za-z%]+|1)\^?(?P<power>-?\d+)?")


@final
@dataclass(frozen=True)
class BaseUnit:
    """``value_in_SI = factor * value + offset`` with the exponents of the SI base units (and rad)."""

    factor: float
    exponents: tuple[tuple[str, int], ...]
    offset: float = 0.0


def _single(name: str) -> _Entry | None:
    if name in _NAMED:
        return _NAMED[name]
    if len(name) > 1 and name[0] in _PREFIX and name[1:] in _NAMED:
        factor, exponents = _NAMED[name[1:]]
        return _PREFIX[name[0]] * factor, exponents
    return None


def base_unit(text: str) -> BaseUnit | None:
    """Read a unit expression such as ``N.m.s/rad`` or ``kg.m2``; everything after ``/`` divides.

    Parameters
    ----------
    text : str
        Factors joined by ``.`` or ``*``, divided by ``/``; powers as ``m2`` or ``m^2``; brackets after the stroke
        may be left out.

    Returns
    -------
    BaseUnit or None
        None for a unit this table does not know. FMI allows such units by name alone.
    """
    if text == "degC":
        return BaseUnit(1.0, (("K", 1),), 273.15)
    factor, totals = 1.0, dict.fromkeys(BASE, 0)
    for place, part in enumerate(text.replace("(", "").replace(")", "").replace(" ", "").split("/")):
        for item in re.split(r"[.*]", part):
            found = _FACTOR.fullmatch(item)
            entry = _single(found["name"]) if found else None
            if found is None or entry is None:
                return None
            power = int(found["power"] or 1) * (1 if place == 0 else -1)
            factor *= entry[0] ** power
            for base, exponent in entry[1].items():
                totals[base] += power * exponent
    return BaseUnit(factor, tuple((base, power) for base, power in totals.items() if power))


def add_unit_definitions(root: Element, units: Iterable[tuple[str, str | None]]) -> None:
    """Append ``UnitDefinitions`` for the (unit, display unit) pairs; nothing where no unit is named.

    Raises
    ------
    InputError
        Where a display unit does not measure the same quantity as its unit.
    """
    table: dict[str, set[str]] = {}
    for unit, display in units:
        if unit:
            table.setdefault(unit, set()).update({display} if display else set())
    if not table:
        return
    definitions = SubElement(root, "UnitDefinitions")
    for unit in sorted(table):
        node = SubElement(definitions, "Unit", {"name": unit})
        base = base_unit(unit)
        if base is not None:
            attributes = {name: str(power) for name, power in base.exponents}
            attributes |= {"factor": repr(base.factor)} if base.factor != 1.0 else {}
            attributes |= {"offset": repr(base.offset)} if base.offset else {}
            SubElement(node, "BaseUnit", attributes)
        for display in sorted(table[unit]):
            shown = base_unit(display)
            if base is None or shown is None or shown.exponents != base.exponents or shown.offset or base.offset:
                raise InputError(f"display unit {display!r} does not measure what {unit!r} measures; name another one")
            SubElement(node, "DisplayUnit", {"name": display, "factor": repr(base.factor / shown.factor)})
