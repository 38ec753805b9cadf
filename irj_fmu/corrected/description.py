"""modelDescription.xml of a corrected FMU: that of the inner one, with fitted values as start
values and the parameters of the correction at its end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, SubElement, parse

from identification.errors import InputError
from irj_fmu.fmi.model_description import GENERATOR, to_bytes
from irj_fmu.fmi.unit_definitions import add_unit_definitions
from irj_fmu.fmi.variables import Variable
from irj_fmu.host.run import Number

_GONE: Final = ("numberOfEventIndicators", "generationDateAndTime")
_KEPT: Final = (
    "needsExecutionTool",
    "canHandleVariableCommunicationStepSize",
    "canBeInstantiatedOnlyOncePerProcess",
    "canGetAndSetFMUstate",
    "canSerializeFMUstate",
    "canGetAndSetFMUState",
    "canSerializeFMUState",
    "fixedInternalStepSize",
)
"""What a corrected FMU can do as far as the inner one can; nothing else is promised."""
_OTHERS: Final = ("ModelExchange", "ScheduledExecution")
_EVENTS: Final = ("EventIndicator", "ClockedState")
"""Parts of a structure that belong to these."""
_BEFORE_LOG: Final = ("ModelExchange", "CoSimulation", "UnitDefinitions", "TypeDefinitions")
_ERRORS: Final = "logStatusError"


def interface(folder: Path) -> Element:
    """The co-simulation interface in the description of an extracted FMU."""
    found = _root(folder).find("CoSimulation")
    if found is None:
        raise InputError(f"{folder}: modelDescription.xml has no CoSimulation")
    return found


def _root(folder: Path) -> Element:
    return parse(folder / "modelDescription.xml").getroot()


def corrected_description(
    folder: Path,
    *,
    name: str,
    guid: str,
    about: str,
    starts: Mapping[str, Number],
    added: Sequence[Variable],
    first: int,
) -> bytes:
    """The text of modelDescription.xml.

    Parameters
    ----------
    folder : Path
        Of the extracted inner FMU.
    name : str
        Model name and identifier.
    guid : str
    about : str
        One sentence.
    starts : mapping
        Variable of the inner FMU to its new start value.
    added : sequence of Variable
        Declared last, as reals; a local one has no start value.
    first : int
        Value reference of the first of them.

    Raises
    ------
    InputError
        A name that the inner FMU has already.
    """
    root = _root(folder)
    for key in _GONE:
        root.attrib.pop(key, None)
    token = "guid" if "guid" in root.attrib else "instantiationToken"
    root.attrib |= {"modelName": name, token: guid, "description": about}
    root.set("generationTool", GENERATOR)
    for other in [found for tag in _OTHERS for found in root.findall(tag)]:
        root.remove(other)
    _without_events(root)
    _interface(root, name)
    variables = root.find("ModelVariables")
    if variables is None:
        raise InputError(f"{folder}: modelDescription.xml has no ModelVariables")
    for scalar in variables:
        value = starts.get(scalar.get("name", ""))
        if value is not None:
            typed = scalar[0] if scalar.tag == "ScalarVariable" else scalar
            typed.set("start", _start(typed.tag, value))
    taken = {scalar.get("name") for scalar in variables}
    for reference, variable in enumerate(added, first):
        if variable.name in taken:
            raise InputError(
                f"{folder}: the FMU has a variable {variable.name!r} of its own, the name that the "
                "correction needs"
            )
        _declare(variables, variable, reference)
    _units(root, added)
    _errors(root)
    return to_bytes(root)


def _start(kind: str, value: Number) -> str:
    if kind == "Boolean":
        return str(bool(value)).lower()
    return repr(float(value) if kind in ("Real", "Float64", "Float32") else int(value))


def _without_events(root: Element) -> None:
    """FMI 3.0: a structure without what only other interfaces have."""
    structure = root.find("ModelStructure")
    if structure is None:
        return
    gone = {
        found.get("valueReference")
        for tag in _EVENTS
        for found in structure.findall(tag)
        if found.get("valueReference") is not None
    }
    for found in list(structure):
        initial = found.tag == "InitialUnknown" and found.get("valueReference") in gone
        if found.tag in _EVENTS or initial:
            structure.remove(found)


def _interface(root: Element, name: str) -> None:
    simulation = root.find("CoSimulation")
    if simulation is None:
        raise InputError("modelDescription.xml has no CoSimulation")
    kept: dict[str, str] = {
        key: simulation.attrib[key] for key in _KEPT if key in simulation.attrib
    }
    simulation.attrib.clear()
    simulation.set("modelIdentifier", name)
    simulation.attrib.update(kept)
    for sources in simulation.findall("SourceFiles"):
        simulation.remove(sources)


def _declare(variables: Element, variable: Variable, reference: int) -> None:
    local = variable.causality == "local"
    about = {
        "name": variable.name,
        "valueReference": str(reference),
        "description": variable.description,
        "causality": variable.causality,
        "variability": variable.stated_variability,
        "initial": "calculated" if local else "exact",
    }
    unit = {"unit": variable.unit} if variable.unit else {}
    value = unit if local else {**unit, "start": repr(float(variable.start))}
    if variables.find("ScalarVariable") is None:  # FMI 3.0
        SubElement(variables, "Float64", {**about, **value})
    else:
        SubElement(SubElement(variables, "ScalarVariable", about), "Real", value)


def _place(root: Element, tag: str, after: Sequence[str]) -> Element:
    """The element, put behind those that come before it where it is missing."""
    found = root.find(tag)
    if found is None:
        at = max(i for i, child in enumerate(root, 1) if child.tag in after)
        found = Element(tag)
        root.insert(at, found)
    return found


def _units(root: Element, added: Sequence[Variable]) -> None:
    wanted = Element("wanted")
    add_unit_definitions(wanted, [(v.unit, v.display_unit) for v in added])
    there = {unit.get("name") for unit in root.iterfind("UnitDefinitions/Unit")}
    missing = [unit for unit in wanted.iter("Unit") if unit.get("name") not in there]
    if missing:
        _place(root, "UnitDefinitions", _BEFORE_LOG[:2]).extend(missing)


def _errors(root: Element) -> None:
    log = _place(root, "LogCategories", _BEFORE_LOG)
    if all(category.get("name") != _ERRORS for category in log):
        SubElement(log, "Category", {"name": _ERRORS, "description": "A call failed."})


__all__ = ["corrected_description", "interface"]
