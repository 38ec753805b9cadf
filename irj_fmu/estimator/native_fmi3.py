"""The native estimator as FMI 3.0: arrays for the estimates, enumerations for health and fault, a
terminal for the readings.

The estimator in C is that of :mod:`irj_fmu.estimator.native`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final
from xml.etree.ElementTree import Element, SubElement

from identification.online.verdict import (
    CONSTANT,
    CURRENT_OR_FRICTION,
    HELD,
    MISSING,
    NONE,
    PLANT,
    SCALED,
)
from identification.online.watch import READINGS
from irj_fmu.estimator.native import NativeSpec, described, native_sources, native_variables
from irj_fmu.estimator.notes import estimator_notes
from irj_fmu.fmi.archive import write_archive
from irj_fmu.fmi.compiler import compile_library, find_compiler
from irj_fmu.fmi.documentation import beside
from irj_fmu.fmi.model_description import identity, to_bytes
from irj_fmu.fmi.slave_base import Health
from irj_fmu.fmi.targets import binaries, native_targets
from irj_fmu.fmi.unit_definitions import add_unit_definitions, quantity_of
from irj_fmu.fmi.variables import Variable

_C: Final = Path(__file__).parents[1] / "c"
_MAIN: Final = "native_fmi3.c"
_OWN: Final = (_MAIN, "fmi3_common.c", "fmi3_log.c")
_TYPES: Final = {"real": "Float64", "integer": "Int32", "boolean": "Boolean", "string": "String"}
_ELEMENT: Final = re.compile(r"(.*)\[(\d+)\]")
CHANNELS: Final = {
    "i_m": "motor_current",
    "tau_m": "motor_torque",
    "q_m": "motor_position",
    "w_m": "motor_velocity",
    "q_l": "link_position",
    "w_l": "link_velocity",
    "tau_l": "link_torque",
}
"""Inputs of an estimator and the channels that they read, the members of the terminal."""


def fault_names() -> dict[str, int]:
    """Names of the fault codes, as the items of an enumeration have them."""
    found = {"none": NONE}
    found |= {f"{name}_failed": i for i, name in enumerate(READINGS, 1)}
    found |= {
        "current_sensor_or_motor_friction": CURRENT_OR_FRICTION,
        "joint_changed": PLANT,
        "estimate_held": HELD,
    }
    for base, text in ((MISSING, "missing"), (CONSTANT, "constant"), (SCALED, "wrong_scale")):
        found |= {f"{name}_{text}": base + i for i, name in enumerate(READINGS, 1)}
    return found


def _enumerations() -> dict[str, Mapping[str, int]]:
    """Items of each enumeration, by the variable that has it."""
    return {"health": {h.name.lower(): int(h) for h in Health}, "fault": fault_names()}


@final
@dataclass(frozen=True)
class Slot:
    """A variable of FMI 3.0: one position of the estimator's table, or several as an array."""

    name: str
    reference: int
    parts: tuple[Variable, ...]
    is_array: bool


def slots(variables: Sequence[Variable]) -> list[Slot]:
    """Consecutive ``name[1]``, ``name[2]``, ... become the array ``name``."""
    found: list[Slot] = []
    for i, variable in enumerate(variables):
        element = _ELEMENT.fullmatch(variable.name)
        if element is None:
            found.append(Slot(variable.name, i, (variable,), False))
        elif element[2] == "1":
            found.append(Slot(element[1], i, (variable,), True))
        else:
            last = found.pop()
            found.append(Slot(last.name, last.reference, (*last.parts, variable), True))
    return found


def build_native_fmi3(
    spec: NativeSpec, out: Path, *, cc: str | None = None, target: str | Sequence[str] | None = None
) -> Path:
    """Build the FMI 3.0 co-simulation FMU of an estimator.

    Parameters and errors are those of :func:`irj_fmu.estimator.native.build_native`.

    Returns
    -------
    Path
        Absolute path. The same content gives the same bytes.

    Notes
    -----
    ``theta``, ``sigma``, ``fault_score`` and the shapes ``eta`` are arrays. Elements of an array
    share a unit in FMI 3.0; where theirs differ the array has none, and its description names the
    elements with their units.
    """
    targets = native_targets(target)
    for triple in targets:
        find_compiler(triple, cc)
    variables = native_variables(spec)
    found = slots(variables)
    table = _table(found, len(variables))

    def made(token: str) -> bytes:
        return to_bytes(_describe(spec, variables, found, token))

    # the token stands in the configuration, so it is worked out of everything else first
    texts = {name: (_C / name).read_bytes() for name in _OWN} | {"native_fmi3_config.h": table}
    sources = native_sources(spec, {**texts, "description": made("")})[0]
    sources = {
        name: text
        for name, text in {**sources, **texts}.items()
        if name not in ("native_wrapper.c", "fmi2_common.c")
    }
    token = described(sources["native_config.h"])
    content = {f"sources/{name}": text for name, text in sources.items()}
    content["sources/buildDescription.xml"] = to_bytes(_build_description(spec.name))
    content["modelDescription.xml"] = made(token)
    drive = "i_m" if spec.joint.torque_per_current is not None else "tau_m"
    terminal = {CHANNELS[name]: name for name in (drive, *READINGS[1:])}
    content |= beside(
        content["modelDescription.xml"],
        estimator_notes(spec.joint, spec.options),
        terminals={"joint": terminal},
    )
    built = {
        triple: compile_library(sources, _MAIN, triple, cc=cc, libraries=("m",))
        for triple in targets
    }
    return write_archive(out, content | binaries(built, spec.name, version=3))


def _table(found: Sequence[Slot], count: int) -> bytes:
    sizes, listed = [0] * count, [0] * count
    for slot in found:
        sizes[slot.reference] = len(slot.parts)
        listed[slot.reference] = int(slot.name in _enumerations())
    rows = (
        f"static const unsigned char {name}[] = {{{', '.join(map(str, values))}}};"
        for name, values in (("elements", sizes), ("is_enumeration", listed))
    )
    return ("\n".join(rows) + "\n").encode()


def _build_description(name: str) -> Element:
    root = Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    configuration = SubElement(root, "BuildConfiguration", {"modelIdentifier": name})
    files = SubElement(configuration, "SourceFileSet", {"language": "C99"})
    SubElement(files, "SourceFile", {"name": _MAIN})
    return root


def _describe(
    spec: NativeSpec, variables: Sequence[Variable], found: Sequence[Slot], token: str
) -> Element:
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": "3.0",
            "modelName": spec.name,
            "instantiationToken": token,
            "description": "Online estimation of the parameters of a geared joint, with residuals "
            "of its balances and fault detection; in C.",
            **identity(),
            "variableNamingConvention": "structured",
        },
    )
    SubElement(
        root,
        "CoSimulation",
        {
            "modelIdentifier": spec.name,
            "canGetAndSetFMUState": "true",
            "canSerializeFMUState": "true",
            "canHandleVariableCommunicationStepSize": "true",
        },
    )
    reals = [v for v in variables if v.kind == "real"]
    add_unit_definitions(root, [(v.unit, v.display_unit) for v in reals] + [("s", None)])
    types = SubElement(root, "TypeDefinitions")
    for name, items in _enumerations().items():
        kind = SubElement(types, "EnumerationType", {"name": name.capitalize()})
        for item, value in sorted(items.items(), key=lambda pair: pair[1]):
            SubElement(kind, "Item", {"name": item, "value": str(value)})
    categories = SubElement(root, "LogCategories")
    for name, text in (("logStatusWarning", "Warnings."), ("logStatusError", "Errors.")):
        SubElement(categories, "Category", {"name": name, "description": text})
    step = spec.sample_time
    SubElement(
        root,
        "DefaultExperiment",
        {"startTime": "0.0", "stopTime": repr(1000 * step), "stepSize": repr(step)},
    )
    node = SubElement(root, "ModelVariables")
    for slot in found:
        _add_variable(node, slot)
    SubElement(
        node,
        "Float64",
        {
            "name": "time",
            "valueReference": str(len(variables)),
            "description": "Time of the newest sample.",
            "causality": "independent",
            "variability": "continuous",
            "unit": "s",
        },
    )
    structure = SubElement(root, "ModelStructure")
    for slot in found:
        if slot.parts[0].causality == "output":
            SubElement(structure, "Output", {"valueReference": str(slot.reference)})
    return root


def _add_variable(node: Element, slot: Slot) -> None:
    first = slot.parts[0]
    attributes = {"name": slot.name, "valueReference": str(slot.reference)}
    attributes["description"] = _meaning(slot)
    attributes |= {"causality": first.causality, "variability": first.stated_variability}
    if first.causality != "input":
        attributes["initial"] = "exact"
    start = " ".join(_text(v) for v in slot.parts)
    if first.kind == "string":
        SubElement(SubElement(node, "String", attributes), "Start", {"value": start})
        return
    kind = _TYPES[first.kind]
    if slot.name in _enumerations():
        kind, attributes["declaredType"] = "Enumeration", slot.name.capitalize()
    elif first.kind in ("real", "integer"):
        attributes |= _limits(slot)
    attributes["start"] = start
    element = SubElement(node, kind, attributes)
    if slot.is_array:
        SubElement(element, "Dimension", {"start": str(len(slot.parts))})


def _limits(slot: Slot) -> dict[str, str]:
    """Unit and bounds that all elements share."""
    cast = float if slot.parts[0].kind == "real" else int
    found: dict[str, str] = {}
    units = {v.unit for v in slot.parts}
    if len(units) == 1 and (unit := units.pop()):
        quantity = quantity_of(unit)
        found |= {"quantity": quantity} if quantity else {}
        found["unit"] = unit
    for key, values in (
        ("min", {v.minimum for v in slot.parts}),
        ("max", {v.maximum for v in slot.parts}),
        ("nominal", {v.nominal for v in slot.parts}),
    ):
        value = next(iter(values))
        if len(values) == 1 and value is not None:
            found[key] = repr(cast(value))
    return found


def _meaning(slot: Slot) -> str:
    if not slot.is_array:
        return slot.parts[0].description
    parts = (
        f"{i} {v.description.rstrip('.')}" + (f" [{v.unit}]" if v.unit else "")
        for i, v in enumerate(slot.parts, 1)
    )
    return "; ".join(parts) + "."


def _text(variable: Variable) -> str:
    value = variable.start
    if variable.kind == "real":
        return repr(float(value))
    if variable.kind == "boolean":
        return str(bool(value)).lower()
    return str(int(value)) if variable.kind == "integer" else str(value)


__all__ = ["CHANNELS", "Slot", "build_native_fmi3", "fault_names", "slots"]
