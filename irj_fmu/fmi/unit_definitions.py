"""Units as FMI 2.0 declares them (FMI 2.0.4, section 2.2.2)."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from xml.etree.ElementTree import Element, SubElement

from casadi_models import quantities
from casadi_models.quantities import BaseUnit
from identification.errors import InputError


def base_unit(text: str) -> BaseUnit | None:
    """Read a unit expression such as ``N.m.s/rad`` or ``kg.m2``; everything after ``/`` divides.

    Returns
    -------
    BaseUnit or None
        None for a unit that is not known. FMI allows such units by name alone.
    """
    try:
        return quantities.base_unit(text, lenient=True)
    except quantities.UnitError:
        return None


@cache
def _quantities() -> dict[tuple[tuple[int, ...], int], str]:
    """Names of quantities by the exponents of their SI unit; those of rotary motion come first."""
    found: dict[tuple[tuple[int, ...], int], str] = {}
    units = [unit for unit in quantities.QUANTITIES.values() if unit != "1"]
    names = [name for name, unit in quantities.QUANTITIES.items() if unit != "1"]
    for unit, name in zip(
        [*units, *map(quantities.linear_unit, units)], [*names, *names], strict=True
    ):
        base = quantities.base_unit(unit)
        found.setdefault((base.exponents, base.unwritten), name)
    return found


def quantity_of(unit: str) -> str | None:
    """The quantity that a unit measures, as ``AngularVelocity`` for ``rad/s``; None where it has no
    name of its own.

    An angle is told from a ratio and a torque from an energy by the radians that the unit stands
    for.
    """
    base = base_unit(unit)
    name = _quantities().get((base.exponents, base.unwritten)) if base is not None else None
    return "".join(word.capitalize() for word in name.split("_")) if name else None


def add_unit_definitions(root: Element, units: Iterable[tuple[str, str | None]]) -> None:
    """Append ``UnitDefinitions`` for the (unit, display unit) pairs; nothing where no unit is
    named.

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
            attributes = {name: str(power) for name, power in base.named_exponents.items()}
            attributes |= {"factor": repr(base.factor)} if base.factor != 1.0 else {}
            attributes |= {"offset": repr(base.offset)} if base.offset else {}
            SubElement(node, "BaseUnit", attributes)
        for display in sorted(table[unit]):
            shown = base_unit(display)
            if (
                base is None
                or shown is None
                or shown.exponents != base.exponents
                or shown.offset
                or base.offset
            ):
                raise InputError(
                    f"display unit {display!r} does not measure what {unit!r} measures; name "
                    "another one"
                )
            SubElement(
                node, "DisplayUnit", {"name": display, "factor": repr(base.factor / shown.factor)}
            )
