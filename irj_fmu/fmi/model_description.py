"""modelDescription.xml of FMI 2.0, for plants and slaves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from identification.version import VERSION
from irj_fmu.fmi.unit_definitions import add_unit_definitions, quantity_of
from irj_fmu.fmi.variables import Value, Variable, check_unique

GENERATOR = f"irj {VERSION}"
AUTHOR = "the irj authors"
COPYRIGHT = f"Copyright (c) 2026 {AUTHOR}"
LICENSE = "MIT; see documentation/licenses"
_TYPES = {"real": "Real", "integer": "Integer", "boolean": "Boolean", "string": "String"}
_LOG = {
    "logStatusWarning": "Something the run survives.",
    "logStatusDiscard": "A step was discarded.",
    "logStatusError": "A call failed.",
    "logStatusFatal": "The instance is unusable.",
    "logAll": "Everything.",
}


@final
@dataclass(frozen=True)
class Entry:
    """One ScalarVariable: its declaration and how the FMU treats its start value.

    `derivative_of` is the 1-based index of the state this is the derivative of. `depends` holds the
    1-based indices of the states, inputs and parameters that an output or a derivative depends on;
    None: it depends on everything.
    """

    variable: Variable
    initial: str | None = "exact"
    derivative_of: int | None = None
    depends: tuple[int, ...] | None = None


@final
@dataclass(frozen=True)
class Description:
    """Everything modelDescription.xml holds besides the variables."""

    name: str
    identifier: str
    guid: str
    interfaces: tuple[str, ...]
    description: str = ""
    step: float = 1e-3
    stop: float = 1.0
    tolerance: float | None = None
    options: Mapping[str, str] = field(default_factory=dict)
    sources: tuple[str, ...] = ()


def _number(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return value if isinstance(value, str) else repr(value)


def _start(variable: Variable) -> str:
    kind = variable.kind
    if kind == "real":
        return repr(float(variable.start))
    return _number({"integer": int, "boolean": bool, "string": str}[kind](variable.start))


def _type_attributes(entry: Entry) -> dict[str, str]:
    variable = entry.variable
    attributes: dict[str, str] = {}
    if variable.kind == "real" and variable.unit:
        quantity = quantity_of(variable.unit)
        attributes |= {"quantity": quantity} if quantity else {}
        attributes["unit"] = variable.unit
        if variable.display_unit:
            attributes["displayUnit"] = variable.display_unit
    if variable.kind in ("real", "integer"):
        cast = float if variable.kind == "real" else int
        bounds = {"min": variable.minimum, "max": variable.maximum}
        attributes |= {key: repr(cast(value)) for key, value in bounds.items() if value is not None}
    if variable.kind == "real" and variable.nominal is not None:
        attributes["nominal"] = repr(float(variable.nominal))
    if entry.initial == "exact":
        attributes["start"] = _start(variable)
    if entry.derivative_of is not None:
        attributes["derivative"] = str(entry.derivative_of)
    return attributes


def _add_variables(root: Element, entries: Sequence[Entry]) -> None:
    node = SubElement(root, "ModelVariables")
    for reference, entry in enumerate(entries):
        variable = entry.variable
        attributes = {"name": variable.name, "valueReference": str(reference)}
        if variable.description:
            attributes["description"] = variable.description
        attributes |= {"causality": variable.causality, "variability": variable.stated_variability}
        if entry.initial is not None and variable.causality != "input":
            attributes["initial"] = entry.initial
        scalar = SubElement(node, "ScalarVariable", attributes)
        SubElement(scalar, _TYPES[variable.kind], _type_attributes(entry))


def _add_structure(root: Element, entries: Sequence[Entry]) -> None:
    structure = SubElement(root, "ModelStructure")
    outputs = [i for i, entry in enumerate(entries, 1) if entry.variable.causality == "output"]
    derivatives = [i for i, entry in enumerate(entries, 1) if entry.derivative_of is not None]
    calculated = sorted(i for i in (*outputs, *derivatives) if entries[i - 1].initial != "exact")
    for title, indices in (
        ("Outputs", outputs),
        ("Derivatives", derivatives),
        ("InitialUnknowns", calculated),
    ):
        if indices:
            node = SubElement(structure, title)
            for index in indices:
                depends = entries[index - 1].depends
                known = {} if depends is None else {"dependencies": " ".join(map(str, depends))}
                SubElement(node, "Unknown", {"index": str(index), **known})


def identity() -> dict[str, str]:
    """Who made the FMU, with what, and under which licence, as both versions of FMI name it.

    They are those of the code inside; a model's values belong to whoever had them fitted.
    """
    return {
        "author": AUTHOR,
        "version": VERSION,
        "copyright": COPYRIGHT,
        "license": LICENSE,
        "generationTool": GENERATOR,
    }


def model_description(what: Description, entries: Sequence[Entry]) -> Element:
    """Build the XML tree; value references are the positions in `entries`.

    Raises
    ------
    InputError
        Where two variables share a name or a display unit does not fit.
    """
    check_unique(tuple(entry.variable for entry in entries))
    attributes = {"fmiVersion": "2.0", "modelName": what.name, "guid": what.guid}
    attributes |= {"description": what.description} if what.description else {}
    attributes |= identity() | {"variableNamingConvention": "structured"}
    if "ModelExchange" in what.interfaces:
        attributes["numberOfEventIndicators"] = "0"
    root = Element("fmiModelDescription", attributes)
    for interface in what.interfaces:
        node = SubElement(
            root,
            interface,
            {"modelIdentifier": what.identifier, **_interface_options(what, interface)},
        )
        if what.sources:
            files = SubElement(node, "SourceFiles")
            for name in what.sources:
                SubElement(files, "File", {"name": name})
    reals = [entry.variable for entry in entries if entry.variable.kind == "real"]
    add_unit_definitions(root, [(variable.unit, variable.display_unit) for variable in reals])
    categories = SubElement(root, "LogCategories")
    for name, meaning in _LOG.items():
        SubElement(categories, "Category", {"name": name, "description": meaning})
    experiment = {"startTime": "0.0", "stopTime": repr(float(what.stop))}
    experiment |= {"tolerance": repr(float(what.tolerance))} if what.tolerance is not None else {}
    SubElement(root, "DefaultExperiment", experiment | {"stepSize": repr(float(what.step))})
    _add_variables(root, entries)
    _add_structure(root, entries)
    return root


def _interface_options(what: Description, interface: str) -> dict[str, str]:
    options = {
        "canBeInstantiatedOnlyOncePerProcess": "false",
        "canNotUseMemoryManagementFunctions": "true",
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
    }
    if interface == "CoSimulation":
        options["canHandleVariableCommunicationStepSize"] = "true"
    skip = (
        () if interface == "CoSimulation" else ("canInterpolateInputs", "maxOutputDerivativeOrder")
    )
    return options | {key: value for key, value in what.options.items() if key not in skip}


def to_bytes(root: Element) -> bytes:
    """Return the indented UTF-8 text of the tree, the same bytes each time."""
    indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + bytes(tostring(root, "utf-8")) + b"\n"
