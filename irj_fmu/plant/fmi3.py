"""Plants as FMI 3.0 model exchange and co-simulation; the model and the integrator are those of
the FMI 2.0 FMUs of :mod:`irj_fmu.plant.library`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement

from irj_fmu.fmi.archive import content_guid, write_archive
from irj_fmu.fmi.compiler import compile_library, find_compiler
from irj_fmu.fmi.documentation import beside
from irj_fmu.fmi.model_description import identity, to_bytes
from irj_fmu.fmi.related import layered
from irj_fmu.fmi.targets import binaries, native_targets
from irj_fmu.fmi.unit_definitions import add_unit_definitions, quantity_of
from irj_fmu.fmi.variables import Variable
from irj_fmu.plant.library import (
    Known,
    PlantSpec,
    _check,
    _config,
    _generate,
    _parameter,
    dependencies,
    slopes_of,
)

_SOURCE: Final = "plant_fmi3.c"


def build_plant_fmi3(
    spec: PlantSpec, out: Path, *, cc: str | None = None, target: str | Sequence[str] | None = None
) -> Path:
    """Build the FMI 3.0 FMU of a plant, with directional and adjoint derivatives and FMU state.

    Parameters
    ----------
    spec : PlantSpec
        With displacement memory it runs in co-simulation only.
    out, cc, target
        As in :func:`irj_fmu.plant.library.build_plant`.

    Returns
    -------
    Path
        Absolute path of the FMU. The same content gives the same bytes.

    Raises
    ------
    InputError
        Functions and declarations that do not fit; no compiler; a folder that cannot be written.

    Notes
    -----
    The ``dependencies`` of outputs and derivatives are those of the expressions and name parameters
    too. A list as the standard has it leaves parameters out, and importers then give wrong
    derivatives with respect to them.
    """
    _check(spec)
    targets = native_targets(target)
    for triple in targets:
        find_compiler(triple, cc)
    code, limits = _generate(spec)
    folder = Path(__file__).parents[1] / "c"
    sources = {"plant_model.c": code} | {
        name: (folder / name).read_bytes()
        for name in (_SOURCE, "fmi3_common.c", "living.c", "plant_integrator.c")
    }
    token = content_guid(
        {
            **sources,
            "description": to_bytes(_describe(spec, "")),
            "config": _config(spec, limits, ""),
        }
    )
    sources["plant_config.h"] = _config(spec, limits, token)
    content = {f"sources/{name}": text for name, text in sources.items()}
    content["sources/buildDescription.xml"] = to_bytes(_build_description(spec.name))
    content["modelDescription.xml"] = to_bytes(_describe(spec, token))
    content |= beside(
        content["modelDescription.xml"],
        spec.notes,
        terminals={"joint": {v.name: v.name for v in spec.outputs}},
    )
    content |= layered(spec.related)
    built = {
        triple: compile_library(sources, _SOURCE, triple, cc=cc, libraries=("m",))
        for triple in targets
    }
    return write_archive(out, content | binaries(built, spec.name, version=3))


def _build_description(name: str) -> Element:
    root = Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    configuration = SubElement(root, "BuildConfiguration", {"modelIdentifier": name})
    files = SubElement(configuration, "SourceFileSet", {"language": "C99"})
    SubElement(files, "SourceFile", {"name": _SOURCE})
    return root


def _describe(spec: PlantSpec, token: str) -> Element:
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": "3.0",
            "modelName": spec.name,
            "instantiationToken": token,
            **({"description": spec.description} if spec.description else {}),
            **identity(),
            "variableNamingConvention": "structured",
        },
    )
    able = {
        "modelIdentifier": spec.name,
        "canGetAndSetFMUState": "true",
        "canSerializeFMUState": "true",
        "providesDirectionalDerivatives": "true",
        "providesAdjointDerivatives": "true",
    }
    if not spec.memory:
        SubElement(root, "ModelExchange", able)
    SubElement(root, "CoSimulation", {**able, "canHandleVariableCommunicationStepSize": "true"})
    slopes = slopes_of(spec)
    groups = (spec.states, slopes, spec.inputs, spec.parameters, spec.outputs, spec.memory)
    add_unit_definitions(
        root, [(v.unit, v.display_unit) for group in groups for v in group] + [("s", None)]
    )
    categories = SubElement(root, "LogCategories")
    SubElement(categories, "Category", {"name": "logStatusError", "description": "Errors."})
    SubElement(
        root,
        "DefaultExperiment",
        {
            "startTime": "0.0",
            "stopTime": "1.0",
            "tolerance": repr(spec.tolerance),
            "stepSize": repr(spec.default_step),
        },
    )
    node = SubElement(root, "ModelVariables")
    n = len(spec.states)
    rows: list[tuple[Variable, dict[str, str]]] = []
    rows += [
        (
            v,
            {
                "causality": "local",
                "variability": "continuous",
                "initial": "exact",
                "start": repr(float(v.start)),
            },
        )
        for v in spec.states
    ]
    slope = {"causality": "local", "variability": "continuous", "initial": "calculated"}
    rows += [(v, {**slope, "derivative": str(i)}) for i, v in enumerate(slopes)]
    rows += [
        (v, {"causality": "input", "variability": "continuous", "start": repr(float(v.start))})
        for v in spec.inputs
    ]
    rows += [
        (
            v,
            {
                "causality": "parameter",
                "variability": _parameter(v),
                "initial": "exact",
                "start": repr(float(v.start)),
            },
        )
        for v in spec.parameters
    ]
    rows += [
        (v, {"causality": "output", "variability": "continuous", "initial": "calculated"})
        for v in spec.outputs
    ]
    held = {"causality": "local", "variability": "continuous", "initial": "exact"}
    rows += [(v, {**held, "start": repr(float(v.start))}) for v in spec.memory]
    for reference, (variable, more) in enumerate(rows):
        SubElement(node, "Float64", {**_attributes(variable, reference), **more})
    time = Variable("time", "s", description="Time.")
    SubElement(
        node,
        "Float64",
        {**_attributes(time, len(rows)), "causality": "independent", "variability": "continuous"},
    )
    structure = SubElement(root, "ModelStructure")
    first = len(rows) - len(spec.outputs) - len(spec.memory)
    rates, readings = dependencies(spec)
    unknowns = [("Output", first + i, known) for i, known in enumerate(readings)]
    unknowns += [("ContinuousStateDerivative", n + i, known) for i, known in enumerate(rates)]
    about = [
        (title, {"valueReference": str(reference), "dependencies": _references(known, 2 * n)})
        for title, reference, known in unknowns
    ]
    for title, attributes in about:
        SubElement(structure, title, attributes)
    for _, attributes in about:
        SubElement(structure, "InitialUnknown", attributes)
    return root


def _references(known: Known, first: int) -> str:
    """Value references of states, and of inputs and parameters from `first` on."""
    states, others = known
    return " ".join(map(str, (*states, *(i + first for i in others))))


def _attributes(variable: Variable, reference: int) -> dict[str, str]:
    found: dict[str, str] = {"name": variable.name, "valueReference": str(reference)}
    optional: Mapping[str, Any] = {
        "description": variable.description or None,
        "quantity": quantity_of(variable.unit) if variable.unit else None,
        "unit": variable.unit or None,
        "displayUnit": variable.display_unit if variable.unit else None,
        "min": variable.minimum,
        "max": variable.maximum,
        "nominal": variable.nominal,
    }
    return found | {
        k: repr(float(v)) if isinstance(v, int | float) else str(v)
        for k, v in optional.items()
        if v is not None
    }


__all__ = ["build_plant_fmi3"]
