"""The modelDescription.xml of a co-simulation of FMI 2.0, said in FMI 3.0."""

from __future__ import annotations

from typing import Final
from xml.etree.ElementTree import Element, SubElement, fromstring

from irj_fmu.fmi.model_description import to_bytes

_TYPES: Final = {"Real": "Float64", "Integer": "Int32", "Boolean": "Boolean", "String": "String"}
_INTERFACE: Final = {
    "modelIdentifier": "modelIdentifier",
    "needsExecutionTool": "needsExecutionTool",
    "canBeInstantiatedOnlyOncePerProcess": "canBeInstantiatedOnlyOncePerProcess",
    "canGetAndSetFMUstate": "canGetAndSetFMUState",
    "canSerializeFMUstate": "canSerializeFMUState",
    "canHandleVariableCommunicationStepSize": "canHandleVariableCommunicationStepSize",
}
"""Attributes of the interface by their names of FMI 2.0; the others have none in FMI 3.0."""
_KEPT: Final = ("UnitDefinitions", "LogCategories", "DefaultExperiment")


def said_in_fmi3(description: bytes) -> bytes:
    """The same model in FMI 3.0: value references stay, the time comes behind them.

    Parameters
    ----------
    description : bytes
        Of a co-simulation of FMI 2.0 whose outputs depend on what they like.
    """
    old = fromstring(description)
    named = {k: v for k, v in old.attrib.items() if k not in ("fmiVersion", "guid", "modelName")}
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": "3.0",
            "modelName": old.attrib["modelName"],
            "instantiationToken": old.attrib["guid"],
            **named,
        },
    )
    interface = old.find("CoSimulation")
    assert interface is not None
    found = {new: interface.get(name) for name, new in _INTERFACE.items()}
    SubElement(root, "CoSimulation", {k: v for k, v in found.items() if v is not None})
    root.extend(part for name in _KEPT if (part := old.find(name)) is not None)
    variables = SubElement(root, "ModelVariables")
    scalars = old.findall("ModelVariables/ScalarVariable")
    for scalar in scalars:
        _add_variable(variables, scalar)
    SubElement(
        variables,
        "Float64",
        {
            "name": "time",
            "valueReference": str(time_reference(old)),
            "description": "Time.",
            "causality": "independent",
            "variability": "continuous",
        },
    )
    structure = SubElement(root, "ModelStructure")
    for scalar in scalars:
        if scalar.get("causality") == "output":
            SubElement(structure, "Output", {"valueReference": scalar.attrib["valueReference"]})
    return to_bytes(root)


def time_reference(description: Element) -> int:
    """Value reference of the time: the first that no variable of FMI 2.0 has."""
    return 1 + max(
        (int(v.attrib["valueReference"]) for v in description.iter("ScalarVariable")), default=-1
    )


def _add_variable(node: Element, scalar: Element) -> None:
    own = next(child for child in scalar if child.tag in _TYPES)
    attributes = {**scalar.attrib, **own.attrib}
    if own.tag == "String":
        start = attributes.pop("start", "")
        SubElement(SubElement(node, "String", attributes), "Start", {"value": start})
    else:
        SubElement(node, _TYPES[own.tag], attributes)


__all__ = ["said_in_fmi3", "time_reference"]
