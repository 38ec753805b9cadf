"""Plant FMUs: CasADi functions as FMI 2.0 model exchange and co-simulation in one C library."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from identification.errors import InputError
from irj_fmu.fmi.archive import content_guid, write_archive
from irj_fmu.fmi.compiler import (
    compile_library,
    find_compiler,
    header_folder,
    model_code,
)
from irj_fmu.fmi.documentation import Note, beside
from irj_fmu.fmi.model_description import Description, Entry, model_description, to_bytes
from irj_fmu.fmi.related import Related, layered
from irj_fmu.fmi.targets import binaries, native_targets
from irj_fmu.fmi.variables import Variability, Variable, check_unique

if TYPE_CHECKING:
    import casadi as ca

DEFAULT_TOLERANCE = 1e-9
_C = Path(__file__).parents[1] / "c"
_SOURCES = ("plant_wrapper.c", "fmi2_common.c", "living.c", "plant_integrator.c")
_GROUPS = ("states", "inputs", "parameters", "outputs", "memory")


@final
@dataclass(frozen=True)
class PlantSpec:
    """A plant to be exported.

    Parameters
    ----------
    name : str
        A C identifier; names the model and its library.
    dynamics, output : casadi.Function
        ``(x, u, p) -> dx`` and ``(x, u, p) -> y``, columns of the lengths of the declarations; with
        `update` ``(x, u, p, z)``.
    states, inputs, parameters, outputs : tuple of Variable
        Declarations in the order of the vectors. A parameter is fixed unless its variability is
        "tunable".
    description : str
        One sentence.
    update : casadi.Function, optional
        Displacement memory, co-simulation only: ``(x, z, u, p, x_prev) -> z``. `x_prev` is the
        state at the last accepted integrator step, `z` the memory there. It must leave `z` as it is
        where ``x == x_prev``. Each stage of the integrator sees the memory that belongs to its own
        state.
    memory : tuple of Variable
        Declarations of `z`.
    default_step : float
        Communication step in s; also the largest integrator step where there is memory.
    tolerance : float
        Relative tolerance inside ``doStep`` where the host names none.
    notes : tuple of Note
        Sections of its documentation: equations, faults, limits.
    related : tuple of Related
        Files that belong to it, inside the FMU.
    """

    name: str
    dynamics: ca.Function
    output: ca.Function
    states: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    description: str = ""
    update: ca.Function | None = None
    memory: tuple[Variable, ...] = ()
    default_step: float = 1e-3
    tolerance: float = DEFAULT_TOLERANCE
    notes: tuple[Note, ...] = ()
    related: tuple[Related, ...] = ()


def build_plant(
    spec: PlantSpec, out: Path, *, cc: str | None = None, target: str | Sequence[str] | None = None
) -> Path:
    """Build the FMU.

    Parameters
    ----------
    spec : PlantSpec
        The plant.
    out : Path
        File to write, ending in ``.fmu``. It is renamed into place when it is complete.
    cc : str, optional
        Compiler: a command such as ``gcc``, or ``zig`` for the ziglang package. By default what is
        found.
    target : str or sequence of str, optional
        See :func:`irj_fmu.fmi.targets.native_targets`; by default this machine. Both macOS
        targets together make one library for both processors.

    Returns
    -------
    Path
        Absolute path of the FMU. The same content gives the same bytes.

    Raises
    ------
    InputError
        Where functions and declarations do not fit, there is no compiler, or the folder cannot be
        written.

    Notes
    -----
    The library holds the CasADi functions and their forward directional derivatives with respect to
    states, inputs and parameters. The ``dependencies`` of outputs and derivatives are those of the
    expressions. They name parameters too: importers that ask for derivatives with respect to
    parameters need that.
    """
    _check(spec)
    targets = native_targets(target)
    for triple in targets:
        find_compiler(triple, cc)
    header_folder()
    code, limits = _generate(spec)
    sources = {"plant_model.c": code} | {name: (_C / name).read_bytes() for name in _SOURCES}
    guid = content_guid(
        {**sources, "description": _describe(spec, ""), "config": _config(spec, limits, "")}
    )
    sources["plant_config.h"] = _config(spec, limits, guid)
    content = {f"sources/{name}": code for name, code in sources.items()}
    content["modelDescription.xml"] = _describe(spec, guid)
    content |= beside(content["modelDescription.xml"], spec.notes) | layered(spec.related)
    built = {
        triple: compile_library(sources, "plant_wrapper.c", triple, cc=cc, libraries=("m",))
        for triple in targets
    }
    return write_archive(out, content | binaries(built, spec.name))


def _check(spec: PlantSpec) -> None:
    if not re.fullmatch(r"[A-Za-z_]\w*", spec.name, re.ASCII):
        raise InputError(
            f"plant name {spec.name!r} is not a C identifier; use letters, digits and '_'"
        )
    if (spec.update is None) != (not spec.memory):
        raise InputError(
            f"plant {spec.name}: `update` and `memory` go together; give both or neither"
        )
    if not spec.default_step > 0 or not 0 < spec.tolerance < 1:
        raise InputError(
            f"plant {spec.name}: default_step must be above 0 and tolerance between 0 and 1"
        )
    for group in _GROUPS:
        for variable in getattr(spec, group):
            if variable.kind != "real":
                raise InputError(
                    f"plant {spec.name}: {variable.name} is {variable.kind}; plants hold reals only"
                )
    check_unique(tuple(variable for group in _GROUPS for variable in getattr(spec, group)))
    sizes = {
        "x": len(spec.states),
        "u": len(spec.inputs),
        "p": len(spec.parameters),
        "z": len(spec.memory),
    }
    arguments = ("x", "u", "p", "z") if spec.memory else ("x", "u", "p")
    _check_function(spec, "dynamics", [sizes[key] for key in arguments], len(spec.states))
    _check_function(spec, "output", [sizes[key] for key in arguments], len(spec.outputs))
    if spec.update is not None:
        _check_function(
            spec, "update", [sizes[key] for key in ("x", "z", "u", "p", "x")], len(spec.memory)
        )


def _check_function(spec: PlantSpec, role: str, expected: list[int], result: int) -> None:
    function: ca.Function = getattr(spec, role)
    found = [function.numel_in(i) for i in range(function.n_in())]
    if found != expected:
        raise InputError(
            f"plant {spec.name}: {role} takes vectors of length {found}, the declarations say "
            f"{expected}"
        )
    if function.n_out() != 1 or function.numel_out(0) != result:
        raise InputError(f"plant {spec.name}: {role} must return one vector of length {result}")


def _generate(spec: PlantSpec) -> tuple[bytes, dict[str, int]]:
    """Return the C code of the model functions and their forward derivatives, and the work
    array sizes.
    """
    import casadi as ca

    nx, nu, np_, nz = len(spec.states), len(spec.inputs), len(spec.parameters), len(spec.memory)
    sizes = (("x", nx), ("u", nu), ("p", np_), ("z", nz))
    functions: list[ca.Function] = []
    for letter, model in (("f", spec.dynamics), ("y", spec.output)):
        function, symbol = _expanded(model)
        args = [symbol.sym(name, size) for name, size in sizes]
        seeds = [symbol.sym(f"s{name}", size) for name, size in sizes[:3]]
        value = ca.densify(function(*args[: model.n_in()]))
        slope = ca.jtimes(value, ca.vertcat(*args[:3]), ca.vertcat(*seeds))
        functions.append(ca.Function(f"model_{letter}", args, [value]))
        functions.append(ca.Function(f"model_d{letter}", [*args, *seeds], [ca.densify(slope)]))
    if spec.update is not None:
        function, symbol = _expanded(spec.update)
        args = [
            symbol.sym(name, size)
            for name, size in (("x", nx), ("z", nz), ("u", nu), ("p", np_), ("x_prev", nx))
        ]
        functions.append(ca.Function("model_z", args, [ca.densify(function(*args))]))
    limits = {
        "SZ_ARG": max(8, *(f.sz_arg() for f in functions)),
        "SZ_RES": max(2, *(f.sz_res() for f in functions)),
        "SZ_IW": max(f.sz_iw() for f in functions),
        "SZ_W": max(f.sz_w() for f in functions),
    }
    return model_code("plant_model", functions), limits


def _expanded(function: ca.Function) -> tuple[ca.Function, Any]:
    """Return a scalar-expression form where there is one (faster code), else the function
    itself.
    """
    import casadi as ca

    if function.is_a("SXFunction"):
        return function, ca.SX
    try:
        return function.expand(), ca.SX
    except RuntimeError:
        return function, ca.MX


def _config(spec: PlantSpec, limits: Mapping[str, int], guid: str) -> bytes:
    def table(name: str, values: Iterable[float], kind: str = "double") -> str:
        text = ", ".join(repr(value) for value in values) or "0"
        return f"static const {kind} {name}[] = {{{text}}};"

    lines = ["/* Sizes and start values of this plant. */", f'#define PLANT_GUID "{guid}"']
    counts = {
        "NX": spec.states,
        "NU": spec.inputs,
        "NP": spec.parameters,
        "NY": spec.outputs,
        "NZ": spec.memory,
    }
    lines += [f"#define {key} {len(group)}" for key, group in counts.items()]
    lines += [f"#define {key} {value}" for key, value in limits.items()]
    lines += [
        f"#define DEFAULT_TOLERANCE {spec.tolerance!r}",
        f"#define MEMORY_STEP {spec.default_step!r}",
    ]
    lines += [
        table(f"start_{letter}", (float(v.start) for v in group))
        for letter, group in (
            ("x", spec.states),
            ("u", spec.inputs),
            ("p", spec.parameters),
            ("z", spec.memory),
        )
    ]
    lines.append(table("nominal_x", (float(v.nominal or 1.0) for v in spec.states)))
    lines.append(
        table(
            "tunable_p", (int(v.variability == "tunable") for v in spec.parameters), "unsigned char"
        )
    )
    return ("\n".join(lines) + "\n").encode()


def _describe(spec: PlantSpec, guid: str) -> bytes:
    states = [Entry(replace(v, causality="local", variability="continuous")) for v in spec.states]
    rates, readings = dependencies(spec)
    first = 2 * len(spec.states) + 1
    slopes = [
        Entry(variable, "calculated", index, _indices(known, first))
        for index, (variable, known) in enumerate(zip(slopes_of(spec), rates, strict=True), 1)
    ]
    inputs = [Entry(replace(v, causality="input", variability="continuous")) for v in spec.inputs]
    parameters = [
        Entry(replace(v, causality="parameter", variability=_parameter(v))) for v in spec.parameters
    ]
    outputs = [
        Entry(
            replace(v, causality="output", variability="continuous"),
            "calculated",
            depends=_indices(known, first),
        )
        for v, known in zip(spec.outputs, readings, strict=True)
    ]
    memory = [Entry(replace(v, causality="local", variability="continuous")) for v in spec.memory]
    what = Description(
        name=spec.name,
        identifier=spec.name,
        guid=guid,
        interfaces=("CoSimulation",) if spec.memory else ("ModelExchange", "CoSimulation"),
        description=spec.description,
        step=spec.default_step,
        tolerance=spec.tolerance,
        options={
            "providesDirectionalDerivative": "true",
            "canInterpolateInputs": "true",
            "maxOutputDerivativeOrder": "0",
        },
        sources=("plant_wrapper.c",),
    )
    return to_bytes(
        model_description(what, [*states, *slopes, *inputs, *parameters, *outputs, *memory])
    )


Known = tuple[tuple[int, ...], tuple[int, ...]]
"""Positions among the states, and among inputs and parameters one after the other."""


def dependencies(spec: PlantSpec) -> tuple[list[Known], list[Known]]:
    """What each derivative and each output depends on, by the structure of the expressions.

    What has memory depends on the past of its inputs through it, which is no dependency of a moment
    and is not counted.
    """
    import casadi as ca

    found = []
    for model in (spec.dynamics, spec.output):
        function, symbol = _expanded(model)
        arguments = [symbol.sym("a", function.size1_in(i)) for i in range(function.n_in())]
        rows = [(set[int](), set[int]()) for _ in range(function.numel_out(0))]
        value = function(*arguments)
        at = 0
        for i, argument in enumerate(arguments[:3]):
            sparsity = ca.jacobian_sparsity(value, argument)
            for row, column in zip(*sparsity.get_triplet(), strict=True):
                rows[row][i > 0].add(column + at)
            at = at + argument.numel() if i else 0
        found.append([(tuple(sorted(x)), tuple(sorted(other))) for x, other in rows])
    return found[0], found[1]


def _indices(known: Known, first: int) -> tuple[int, ...]:
    """1-based indices in a description where states come first and inputs from `first` on."""
    states, others = known
    return (*(i + 1 for i in states), *(i + first for i in others))


def slopes_of(spec: PlantSpec) -> list[Variable]:
    """Derivatives of the states, as variables."""
    return [
        Variable(f"der({v.name})", _per_second(v.unit), description=f"Derivative of {v.name}.")
        for v in spec.states
    ]


def _parameter(variable: Variable) -> Variability:
    return "tunable" if variable.variability == "tunable" else "fixed"


def _per_second(unit: str) -> str:
    if not unit:
        return "1/s"
    return f"{unit}2" if unit.endswith("/s") else f"{unit}/s"
