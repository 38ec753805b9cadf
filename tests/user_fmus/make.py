"""Test FMUs of other people's making: C sources of this folder, compiled and packed with their
model description.
"""

from __future__ import annotations

import subprocess
import sys
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, final

import fmpy

HERE: Final = Path(__file__).parent
HEADERS: Final = Path(fmpy.__file__).parent / "c-code"


@final
@dataclass(frozen=True)
class Shape:
    """Names of a model's variables, in the order of the C code."""

    macro: str
    states: tuple[str, ...]
    parameters: tuple[str, ...]
    outputs: tuple[str, ...]
    inputs: tuple[str, ...] = ()
    hidden: bool = False
    """Its states are no variables of the description."""


MODELS: Final = {
    "VanDerPol": Shape("VAN_DER_POL", ("x0", "x1"), ("mu",), ("y0", "y1")),
    "Dahlquist": Shape("DAHLQUIST", ("x",), ("k",), ("y",)),
    "Axis": Shape(
        "AXIS",
        ("q", "w"),
        ("inertia", "viscous", "coulomb", "gravity", "idle"),
        ("angle", "speed"),
        ("torque",),
    ),
    "Elastic": Shape(
        "ELASTIC",
        ("qm", "wm", "ql", "wl"),
        ("motor_inertia", "link_inertia", "stiffness", "damping", "viscous", "coulomb", "gravity"),
        ("motor_angle", "motor_speed", "link_angle", "link_speed", "gear_torque"),
        ("torque",),
    ),
    "BouncingBall": Shape("BOUNCING_BALL", ("h", "v"), ("g", "e"), ("height", "speed")),
    "Servo": Shape(
        "SERVO",
        ("q", "w"),
        ("inertia", "viscous", "coulomb", "gravity", "angle_0", "speed_0"),
        ("angle", "speed"),
        ("torque",),
        hidden=True,
    ),
}
START: Final = {
    "x0": 2.0,
    "x1": 0.0,
    "mu": 1.0,
    "x": 1.0,
    "k": 1.0,
    "q": 0.0,
    "w": 0.0,
    "inertia": 2.0,
    "viscous": 1.0,
    "coulomb": 1.0,
    "gravity": 5.0,
    "idle": 1.0,
    **dict.fromkeys(("qm", "wm", "ql", "wl"), 0.0),
    "motor_inertia": 4.0e-4,
    "link_inertia": 11.0,
    "stiffness": 2.0e4,
    "damping": 25.0,
    "h": 1.0,
    "v": 0.0,
    "g": 9.81,
    "e": 0.7,
    "angle_0": 0.0,
    "speed_0": 0.0,
}
OWN_START: Final = {"Elastic": {"viscous": 2.0e-3, "coulomb": 0.15, "gravity": 55.0}}
"""Start values that a model has otherwise."""
OFFSET: Final = {"states": 1, "derivatives": 11, "inputs": 21, "parameters": 31, "outputs": 41}


@final
@dataclass(frozen=True)
class Make:
    """What is built.

    Attributes
    ----------
    kinds : tuple of str
        Of "ModelExchange", "CoSimulation".
    strict : bool
        Parameters are fixed and refused after initialization.
    derivatives : bool
        The description promises directional derivatives.
    dependencies : bool
        FMI 3: state the dependencies on states and inputs, as the standard has it, parameters left
        out.
    says : str, optional
        Variability of the parameters in the description, whatever the library does.
    wrong : bool
        The library's directional derivatives are 1 % off.
    units : tuple of (variable, unit)
    events : int
        Event indicators in the description.
    fails : int
        Status of the steps from a tenth of a second on (FMI 2); 0 for none that fails.
    step : float
        The only step that it takes [s] (FMI 2); 0 for any.
    once : bool
        A second instance beside a living one is refused (FMI 2).
    breaks : float
        Time from which on its states are no numbers [s] (FMI 2); 0 for never.
    """

    version: int = 2
    kinds: tuple[str, ...] = ("ModelExchange", "CoSimulation")
    strict: bool = False
    derivatives: bool = True
    dependencies: bool = True
    says: str | None = None
    wrong: bool = False
    units: tuple[tuple[str, str], ...] = ()
    events: int = 0
    fails: int = 0
    step: float = 0.0
    once: bool = False
    breaks: float = 0.0


def build(name: str, folder: Path, make: Make | None = None) -> Path:
    """Compile and pack one test FMU, once per folder."""
    make = make or Make()
    shape = MODELS[name]
    if shape.hidden:
        make = replace(make, kinds=("CoSimulation",))
    tag = f"{name}{make.version}_{zlib.crc32(repr(make).encode()):08x}"
    out = folder / f"{tag}.fmu"
    if out.exists():
        return out
    library = folder / f"{tag}.so"
    flags = ["-shared", "-fPIC", "-O2", "-w", f"-DMODEL_{shape.macro}", f'-DGUID="{tag}"']
    flags += [f"-DFAILS={make.fails}"] if make.fails else []
    flags += [f"-DSTEP={make.step!r}"] if make.step else []
    flags += ["-DONCE"] if make.once else []
    flags += [f"-DNOT_A_NUMBER={make.breaks!r}"] if make.breaks else []
    flags += [*(["-DSTRICT"] if make.strict else []), *(["-DWRONG"] if make.wrong else [])]
    _compile(HERE / f"fmi{make.version}.c", library, flags)
    place = "linux64" if make.version == 2 else "x86_64-linux"
    text = (_two if make.version == 2 else _three)(name, tag, shape, make)
    return _packed(out, text, library, f"binaries/{place}/{name}.so")


def build_state_space(folder: Path, kinds: tuple[str, ...]) -> Path:
    """An FMU of FMI 3.0 whose inputs, parameters, states and outputs are arrays."""
    tag = f"StateSpace3_{zlib.crc32(repr(kinds).encode()):08x}"
    out, library = folder / f"{tag}.fmu", folder / f"{tag}.so"
    if not out.exists():
        _compile(
            HERE / "statespace.c", library, ["-shared", "-fPIC", "-O2", "-w", f'-DGUID="{tag}"']
        )
        _packed(out, _arrays(tag, kinds), library, "binaries/x86_64-linux/StateSpace.so")
    return out


def _arrays(tag: str, kinds: tuple[str, ...]) -> str:
    """Its description: the sizes are structural parameters."""
    sizes = {1: ("m", 1), 2: ("n", 2), 3: ("r", 2)}
    rows = [
        ("x", 4, "local", "continuous", "calculated", "2", None, ""),
        ("der(x)", 5, "local", "continuous", "calculated", "2", None, ' derivative="4"'),
        ("u", 6, "input", "continuous", "", "1", "0", ""),
        ("A", 7, "parameter", "fixed", "exact", "22", "0 1 -4 -0.5", ""),
        ("B", 8, "parameter", "fixed", "exact", "21", "0 1", ""),
        ("C", 9, "parameter", "fixed", "exact", "32", "1 0 0 1", ""),
        ("y", 10, "output", "continuous", "calculated", "3", None, ""),
        ("x0", 11, "parameter", "fixed", "exact", "2", "0 0", ""),
    ]
    text = [
        f'<fmiModelDescription fmiVersion="3.0" modelName="StateSpace" instantiationToken="{tag}">',
        *(f'<{k} modelIdentifier="StateSpace"/>' for k in kinds),
        '<ModelVariables><Float64 name="time" valueReference="0" causality="independent" '
        'variability="continuous"/>',
        *(
            f'<UInt64 name="{n}" valueReference="{vr}" causality="structuralParameter" '
            f'variability="fixed" start="{size}"/>'
            for vr, (n, size) in sizes.items()
        ),
    ]
    for name, vr, causality, variability, initial, sides, start, more in rows:
        about = _attributes(
            {
                "name": name,
                "valueReference": str(vr),
                "causality": causality,
                "variability": variability,
                "initial": initial or None,
                "start": start,
            }
        )
        spans = "".join(f'<Dimension valueReference="{k}"/>' for k in sides)
        text.append(f"<Float64 {about}{more}>{spans}</Float64>")
    text.append(
        '</ModelVariables><ModelStructure><Output valueReference="10"/>'
        '<ContinuousStateDerivative valueReference="5"/><InitialUnknown valueReference="4"/>'
        '<InitialUnknown valueReference="5"/><InitialUnknown valueReference="10"/>'
        "</ModelStructure></fmiModelDescription>"
    )
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + "\n".join(text)


def _compile(source: Path, library: Path, flags: list[str]) -> None:
    command = ["gcc", *flags, f"-I{HEADERS}", f"-I{HERE}", str(source), "-o", str(library), "-lm"]
    subprocess.run(command, check=True, capture_output=True)


def _packed(out: Path, description: str, library: Path, place: str) -> Path:
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        archive.write(library, place)
    library.unlink()
    return out


def _rows(
    name: str, shape: Shape, make: Make
) -> list[tuple[str, int, str, str, str, float | None, int | None]]:
    """(name, value reference, causality, variability, initial, start, state of a derivative)."""
    o = OFFSET
    first = START | OWN_START.get(name, {})
    rows: list[tuple[str, int, str, str, str, float | None, int | None]] = []
    rows += [
        (n, o["states"] + i, "local", "continuous", "exact", first[n], None)
        for i, n in enumerate(shape.states)
    ]
    rows += [
        (f"der({n})", o["derivatives"] + i, "local", "continuous", "calculated", None, i)
        for i, n in enumerate(shape.states)
    ]
    rows = [] if shape.hidden else rows
    rows += [
        (n, o["inputs"] + i, "input", "continuous", "", 0.0, None)
        for i, n in enumerate(shape.inputs)
    ]
    kind = make.says or ("fixed" if make.strict else "tunable")
    rows += [
        (n, o["parameters"] + i, "parameter", kind, "exact", first[n], None)
        for i, n in enumerate(shape.parameters)
    ]
    rows += [
        (n, o["outputs"] + i, "output", "continuous", "calculated", None, None)
        for i, n in enumerate(shape.outputs)
    ]
    return rows


def _attributes(pairs: dict[str, str | None]) -> str:
    return " ".join(f'{k}="{v}"' for k, v in pairs.items() if v is not None)


def _two(name: str, guid: str, shape: Shape, make: Make) -> str:
    promise = str(make.derivatives).lower()
    lines = [
        f'<fmiModelDescription fmiVersion="2.0" modelName="{name}" guid="{guid}" '
        f'numberOfEventIndicators="{make.events}">'
    ]
    lines += [
        f'<{k} modelIdentifier="{name}" providesDirectionalDerivative="{promise}" '
        f'canHandleVariableCommunicationStepSize="{str(not make.step).lower()}" '
        f'canBeInstantiatedOnlyOncePerProcess="{str(make.once).lower()}"/>'
        if k == "CoSimulation"
        else f'<{k} modelIdentifier="{name}" providesDirectionalDerivative="{promise}"/>'
        for k in reversed(make.kinds)
    ][::-1]
    units = dict(make.units)
    if units:
        named = [f'<Unit name="{unit}"/>' for unit in sorted(set(units.values()))]
        lines.append(f"<UnitDefinitions>{''.join(named)}</UnitDefinitions>")
    if make.step:
        lines.append(f'<DefaultExperiment stepSize="{make.step!r}"/>')
    lines.append("<ModelVariables>")
    rows = _rows(name, shape, make)
    for n, vr, causality, variability, initial, start, state in rows:
        about = _attributes(
            {
                "name": n,
                "valueReference": str(vr),
                "causality": causality,
                "variability": variability,
                "initial": initial or None,
            }
        )
        inner = _attributes(
            {
                "start": None if start is None else repr(start),
                "derivative": None if state is None else str(state + 1),
                "unit": units.get(n),
            }
        )
        lines.append(f"<ScalarVariable {about}><Real {inner}/></ScalarVariable>")
    index = {row[0]: i for i, row in enumerate(rows, 1)}
    outputs = "".join(f'<Unknown index="{index[n]}"/>' for n in shape.outputs)
    derivatives = [f"der({n})" for n in shape.states if not shape.hidden]
    slopes = "".join(f'<Unknown index="{index[n]}"/>' for n in derivatives)
    unknowns = "".join(
        f'<Unknown index="{i}"/>' for i in sorted(index[n] for n in (*shape.outputs, *derivatives))
    )
    if slopes:
        slopes = f"<Derivatives>{slopes}</Derivatives>"
    lines.append(f"</ModelVariables><ModelStructure><Outputs>{outputs}</Outputs>{slopes}")
    lines.append(
        f"<InitialUnknowns>{unknowns}</InitialUnknowns></ModelStructure></fmiModelDescription>"
    )
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + "\n".join(lines)


def _three(name: str, token: str, shape: Shape, make: Make) -> str:
    promise = str(make.derivatives).lower()
    lines = [
        f'<fmiModelDescription fmiVersion="3.0" modelName="{name}" instantiationToken="{token}">'
    ]
    lines += [
        f'<{k} modelIdentifier="{name}" providesDirectionalDerivatives="{promise}"/>'
        for k in ("ModelExchange", "CoSimulation")
        if k in make.kinds
    ]
    lines.append(
        '<ModelVariables><Float64 name="time" valueReference="0" causality="independent" '
        'variability="continuous"/>'
    )
    for n, vr, causality, variability, initial, start, state in _rows(name, shape, make):
        about = _attributes(
            {
                "name": n,
                "valueReference": str(vr),
                "causality": causality,
                "variability": variability,
                "initial": initial or None,
                "start": None if start is None else repr(start),
                "derivative": None if state is None else str(OFFSET["states"] + state),
            }
        )
        lines.append(f"<Float64 {about}/>")
    own = [OFFSET["states"] + i for i in range(0 if shape.hidden else len(shape.states))]
    own += [OFFSET["inputs"] + i for i in range(len(shape.inputs))]
    depends = f' dependencies="{" ".join(map(str, own))}"' if make.dependencies else ""
    outputs = [OFFSET["outputs"] + i for i in range(len(shape.outputs))]
    slopes = [OFFSET["derivatives"] + i for i in range(0 if shape.hidden else len(shape.states))]
    structure = "".join(f'<Output valueReference="{v}"{depends}/>' for v in outputs)
    structure += "".join(
        f'<ContinuousStateDerivative valueReference="{v}"{depends}/>' for v in slopes
    )
    structure += "".join(
        f'<InitialUnknown valueReference="{v}"{depends}/>' for v in (*outputs, *slopes)
    )
    structure += "".join(
        f'<EventIndicator valueReference="{OFFSET["states"] + i}"/>' for i in range(make.events)
    )
    lines.append(
        f"</ModelVariables><ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + "\n".join(lines)


def check(path: Path) -> list[str]:
    """Problems that a validator finds."""
    from fmpy.validation import validate_fmu

    return list(validate_fmu(str(path)))


if __name__ == "__main__":
    for key in MODELS:
        for number in (2, 3):
            made = build(key, Path(sys.argv[1]), Make(version=number))
            sys.stdout.write(f"{made} {check(made)}\n")
