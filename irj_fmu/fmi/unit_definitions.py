"""Units as FMI 2.0 declares them (FMI 2.0.4, section 2.2.2)."""

from __future__ import annotations

from collections.abc import Iterable
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
