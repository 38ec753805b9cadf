"""System Structure and Parameterization (SSP 1.0): several FMUs and their connections in one
archive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final
from xml.etree.ElementTree import Element, SubElement

from identification.errors import InputError
from irj_fmu.fmi.archive import write_archive
from irj_fmu.fmi.model_description import to_bytes
from irj_fmu.fmi.parameter_set import SSC, SSV, add_parameters, parameter_set
from irj_fmu.fmi.variables import Variable
from irj_fmu.host.run import Fmu
from irj_fmu.plant.library import PlantSpec

_SSD = "http://ssp-standard.org/SSP1/SystemStructureDescription"
PARAMETERS = "resources/parameters.ssv"
_OMS = "https://raw.githubusercontent.com/OpenModelica/OMSimulator/master/schema/oms.xsd"


@final
@dataclass(frozen=True)
class System:
    """What an SSP holds.

    Parameters
    ----------
    components : mapping
        Name to FMU file, in the order in which hosts step them.
    connections : mapping
        ``component.input`` to the ``component.output`` that feeds it.
    parameters : mapping
        Start value by ``component.variable``.
    name : str
        Name of the system.
    step, stop : float
        Communication step and length of the default experiment in s.
    """

    components: Mapping[str, Path]
    connections: Mapping[str, str]
    parameters: Mapping[str, float] = field(default_factory=dict)
    name: str = "joint"
    step: float = 1e-3
    stop: float = 1.0


def write_ssp(system: System, out: Path) -> Path:
    """Write an ``.ssp`` file.

    Connectors are all outputs, the inputs that are connected and the variables that
    `System.parameters` names. An input without a connector keeps its start value in every host;
    some set the others to zero. The step stands in an annotation that one host needs; all others
    take it from their own option.

    Parameters are bound to their components in a set with the system's name, and stand once more in
    `PARAMETERS`. Hosts differ in what they apply: ecos takes the set with ``--parameterSet``, fmpy
    what ``read_ssv(file, PARAMETERS)`` returns as its ``parameter_set``.

    Raises
    ------
    InputError
        Where an FMU or a variable is missing, an input is fed by something that is not an output,
        or the folder cannot be written.
    """
    content: dict[str, bytes] = {}
    root = Element(
        "ssd:SystemStructureDescription",
        {
            "xmlns:ssd": _SSD,
            "xmlns:ssc": SSC,
            "xmlns:ssv": SSV,
            "name": system.name,
            "version": "1.0",
        },
    )
    top = SubElement(root, "ssd:System", {"name": "root"})
    elements = SubElement(top, "ssd:Elements")
    variables: dict[str, Any] = {}
    for name, path in system.components.items():
        with Fmu(path, (2,)) as fmu:  # connectors of SSP 1.0 have no types of FMI 3.0
            own = {f"{name}.{key}": v for key, v in fmu.variables.items()}
            variables |= own
            content[f"resources/{name}.fmu"] = Path(path).read_bytes()
        _component(elements, name, own, system)
    _check(system, variables)
    connections = SubElement(top, "ssd:Connections")
    for target, source in system.connections.items():
        ends = (*source.split(".", 1), *target.split(".", 1))
        keys = ("startElement", "startConnector", "endElement", "endConnector")
        SubElement(connections, "ssd:Connection", dict(zip(keys, ends, strict=True)))
    if system.parameters:
        content[PARAMETERS] = parameter_set(
            system.name,
            {key: (variables[key].type, value) for key, value in system.parameters.items()},
        )
    _annotate(top, system)
    SubElement(root, "ssd:DefaultExperiment", {"startTime": "0.0", "stopTime": repr(system.stop)})
    content["SystemStructure.ssd"] = to_bytes(root)
    return write_archive(out, content, ".ssp")


def _check(system: System, variables: Mapping[str, Any]) -> None:
    for name in (*system.connections, *system.connections.values(), *system.parameters):
        if name not in variables:
            raise InputError(
                f"SSP {system.name}: there is no {name!r}; write component.variable as the FMU "
                "names it"
            )
    for target, source in system.connections.items():
        if variables[target].causality != "input" or variables[source].causality != "output":
            raise InputError(
                f"SSP {system.name}: {source!r} to {target!r} does not connect an output to an "
                "input"
            )


def _component(elements: Element, name: str, variables: Mapping[str, Any], system: System) -> None:
    component = SubElement(
        elements,
        "ssd:Component",
        {
            "name": name,
            "type": "application/x-fmu-sharedlibrary",
            "source": f"resources/{name}.fmu",
            "implementation": "CoSimulation",
        },
    )
    connectors = SubElement(component, "ssd:Connectors")
    values = {key: value for key, value in system.parameters.items() if key in variables}
    for key, variable in variables.items():
        kind = variable.causality if variable.causality in ("input", "output") else "parameter"
        if (kind == "parameter" and key not in values) or (
            kind == "input" and key not in system.connections
        ):
            continue
        connector = SubElement(connectors, "ssd:Connector", {"name": variable.name, "kind": kind})
        SubElement(connector, f"ssc:{variable.type}")
    if not values:
        return
    binding = SubElement(SubElement(component, "ssd:ParameterBindings"), "ssd:ParameterBinding")
    owner = SubElement(
        SubElement(binding, "ssd:ParameterValues"), "ssv:ParameterSet", _set_attributes(system)
    )
    add_parameters(
        owner, {variables[key].name: (variables[key].type, value) for key, value in values.items()}
    )


def _set_attributes(system: System) -> dict[str, str]:
    return {"name": system.name, "version": "1.0"}


def _annotate(top: Element, system: System) -> None:
    annotation = SubElement(
        SubElement(top, "ssd:Annotations"), "ssc:Annotation", {"type": "org.openmodelica"}
    )
    inner = SubElement(annotation, "oms:Annotations", {"xmlns:oms": _OMS})
    SubElement(
        SubElement(inner, "oms:SimulationInformation"),
        "oms:FixedStepMaster",
        {
            "description": "oms-ma",
            "stepSize": repr(system.step),
            "absoluteTolerance": "1e-09",
            "relativeTolerance": "1e-09",
        },
    )


def multisine_source(
    amplitudes: Sequence[float],
    frequencies: Sequence[float],
    phases: Sequence[float],
    *,
    unit: str = "A",
    name: str = "source",
) -> PlantSpec:
    """Return a source as a plant: output ``signal`` = sum of ``a sin(2 pi f t + phase)``.

    Parameters
    ----------
    amplitudes, frequencies, phases : sequence of float
        In `unit`, Hz and rad; equally long.
    unit : str
        Unit of the output.
    name : str
        Name of the model.

    Raises
    ------
    InputError
        Where the lengths differ.
    """
    import casadi as ca

    if not len(amplitudes) == len(frequencies) == len(phases) > 0:
        raise InputError("multisine: give equally many amplitudes, frequencies and phases")
    count = len(amplitudes)
    clock, u, p = ca.SX.sym("t"), ca.SX.sym("u", 0), ca.SX.sym("p", count)
    tones = enumerate(zip(frequencies, phases, strict=True))
    waves = [p[i] * ca.sin(2 * ca.pi * f * clock + phase) for i, (f, phase) in tones]
    return PlantSpec(
        name=name,
        dynamics=ca.Function("f", [clock, u, p], [ca.SX(1)]),
        output=ca.Function("y", [clock, u, p], [sum(waves[1:], waves[0])]),
        states=(Variable("clock", "s", description="Time since the start."),),
        inputs=(),
        parameters=tuple(
            Variable(f"amplitude[{i}]", unit, a, description=f"At {f:g} Hz.", variability="tunable")
            for i, (a, f) in enumerate(zip(amplitudes, frequencies, strict=True), 1)
        ),
        outputs=(Variable("signal", unit),),
        description="Sum of sines.",
    )
