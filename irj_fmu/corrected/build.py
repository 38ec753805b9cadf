"""A user's FMU and the effect that rides outside it as one FMU that needs no Python.

The FMU lies in it as it came, unpacked; a library in C passes every call on and corrects the drive
by the same law as the fit (:func:`irj_fmu.imported.correction.law_function`), at the same times.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

from identification.errors import InputError
from irj_fmu.corrected.description import corrected_description, interface
from irj_fmu.fmi.archive import content_guid, write_archive
from irj_fmu.fmi.compiler import (
    TARGETS,
    compile_library,
    find_compiler,
    header_folder,
    model_code,
    native_target,
)
from irj_fmu.fmi.targets import FMI3_FOLDERS, binaries, native_targets
from irj_fmu.fmi.variables import Variable
from irj_fmu.host.run import Number
from irj_fmu.imported.correction import PREFIX, Correction, law_function
from irj_fmu.imported.model import UserModel
from irj_fmu.imported.port import hold_of, port_of
from irj_fmu.imported.slave import correction_variables
from irj_fmu.plant.joint import identifier

_C: Final = Path(__file__).parents[1] / "c"
_SHARED: Final = ("corrected_inner.c", "corrected_state.h", "living.c")
_SOURCES: Final = {
    2: ("corrected_wrapper.c", "fmi2_common.c", *_SHARED),
    3: ("corrected_fmi3.c", "fmi3_common.c", *_SHARED),
}
"""C sources by version of FMI, that of the library first."""
_LARGEST: Final = 2**32 - 1


@final
@dataclass(frozen=True)
class _Kind:
    """Variables of one kind in the C code: the types of their descriptions, and the type of a start
    value in C where start values are set.
    """

    types: tuple[str, ...]
    c: str = ""


_WHOLE: Final = ("Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "UInt64")
_KINDS: Final[Mapping[int, Mapping[str, _Kind]]] = {
    2: {
        "real": _Kind(("Real",), "double"),
        "integer": _Kind(("Integer", "Enumeration"), "int"),
        "boolean": _Kind(("Boolean",), "int"),
        "string": _Kind(("String",)),
    },
    3: {
        "real": _Kind(("Float64",), "double"),
        "float32": _Kind(("Float32",), "float"),
        **{n.lower(): _Kind((n,), f"fmi3{n}") for n in _WHOLE},
        "int64": _Kind(("Int64", "Enumeration"), "fmi3Int64"),
        "boolean": _Kind(("Boolean",), "fmi3Boolean"),
        "string": _Kind(("String",)),
        "binary": _Kind(("Binary",)),
    },
}
"""By version of FMI."""
_REAL: Final = ("Real", "Float64", "Float32")


def export_corrected(
    model: UserModel, out: Path, *, cc: str | None = None, target: str | Sequence[str] | None = None
) -> Path:
    """Write FMU and correction as one co-simulation FMU in C, of the version of the user's FMU.

    It has the variables of the user's FMU, with fitted values as start values, and the parameters
    of the correction behind them.

    Parameters
    ----------
    model : UserModel
        Its FMU has co-simulation and a library for each target. What FMI 3.0 adds and no call here
        passes on, clocks and structural parameters, is refused.
    out : Path
        File to write, ending in ``.fmu``.
    cc : str, optional
        Compiler, see :func:`irj_fmu.fmi.compiler.find_compiler`.
    target : str or sequence of str, optional
        See :func:`irj_fmu.fmi.targets.native_targets`; by default this machine. ``"all"`` are those
        that the user's FMU has.

    Returns
    -------
    Path
        Absolute path of the FMU. The same content gives the same bytes.

    Raises
    ------
    InputError
        No correction; an FMU of another kind or without a library for a target; no compiler; a
        folder that cannot be written.
    """
    name, correction = model.fmu.path.name, model.correction
    if correction is None:
        raise InputError(f"{name}: no effect rides outside it; diagnose and add one first")
    if model.fmu.description.coSimulation is None:
        raise InputError(
            f"{name}: a corrected FMU in C needs it as co-simulation; export the pair, which runs "
            "where Python runs"
        )
    _only_what_is_passed_on(model)
    version = model.fmu.version
    targets = _present(model) if target == "all" else native_targets(target)
    libraries = {triple: _library(model, triple) for triple in targets}
    for triple in targets:
        find_compiler(triple, cc)
    header_folder()
    plan = _plan(model)
    code, limits = _law(correction, has_velocity=port_of(model).velocity is not None)
    called = identifier(Path(out).stem)
    inner = {
        f"resources/inner/{path.relative_to(model.fmu.folder).as_posix()}": path.read_bytes()
        for path in sorted(model.fmu.folder.rglob("*"))
        if path.is_file()
    }
    sources = {"corrected_law.c": code} | {n: (_C / n).read_bytes() for n in _SOURCES[version]}
    about = (
        f"{model.fmu.description.modelName} with {', '.join(correction.labels)} outside it, "
        "as a correction of its drive."
    )

    def described(guid: str) -> bytes:
        return corrected_description(
            model.fmu.folder,
            name=called,
            guid=guid,
            about=about,
            starts=plan.starts,
            added=plan.added,
            first=plan.first,
        )

    def configured(guid: str, library: str) -> bytes:
        return _config(model, correction, plan, {**limits, **_texts(model, guid, library)})

    guid = content_guid(
        {**inner, **sources, "description": described(""), "config": configured("", "")}
    )
    content = {**inner, "modelDescription.xml": described(guid)}
    built = {
        triple: compile_library(
            {**sources, "corrected_config.h": configured(guid, library)},
            _SOURCES[version][0],
            triple,
            cc=cc,
            libraries=("dl", "m"),
        )
        for triple, library in libraries.items()
    }
    return write_archive(out, content | binaries(built, called, version=version))


def _only_what_is_passed_on(model: UserModel) -> None:
    for what, found in (
        ("a clock", [v.name for v in model.fmu.description.modelVariables if v.type == "Clock"]),
        (
            "a structural parameter",
            [
                v.name
                for v in model.fmu.description.modelVariables
                if v.causality == "structuralParameter"
            ],
        ),
    ):
        if found:
            raise InputError(
                f"{model.fmu.path.name}: {found[0]} is {what}, which a corrected FMU in C does "
                "not pass on; export the pair, which runs where Python runs"
            )


def _folder_of(model: UserModel, triple: str) -> str:
    """Folder below ``binaries/`` in which the inner FMU has its library for a target."""
    return FMI3_FOLDERS[triple] if model.fmu.version == 3 else TARGETS[triple].folder


def _present(model: UserModel) -> tuple[str, ...]:
    """Targets for which the inner FMU has a library."""
    folder, own = model.fmu.folder / "binaries", model.fmu.description.coSimulation.modelIdentifier
    found = [
        t
        for t, p in TARGETS.items()
        if (folder / _folder_of(model, t) / f"{own}{p.suffix}").is_file()
    ]
    return tuple(found) or (native_target(),)


def _library(model: UserModel, triple: str) -> str:
    """The library of the inner FMU for a target, below its folder."""
    place, folder = _folder_of(model, triple), model.fmu.folder / "binaries"
    own = model.fmu.description.coSimulation.modelIdentifier
    path = folder / place / f"{own}{TARGETS[triple].suffix}"
    if not path.is_file():
        there = ", ".join(sorted(p.name for p in folder.iterdir())) if folder.is_dir() else "none"
        raise InputError(
            f"{model.fmu.path.name}: holds no library for {place}, so nothing corrected can "
            f"run there; it has {there or 'none'}"
        )
    return path.relative_to(model.fmu.folder).as_posix()


@final
@dataclass(frozen=True)
class _Plan:
    """Variables of a corrected FMU.

    Attributes
    ----------
    starts : mapping
        New start values of the inner FMU's variables.
    added : tuple of Variable
        Parameters of the correction, the time between two readings, what is added to the drive.
    first : int
        Value reference of the first of them.
    """

    starts: Mapping[str, Number]
    added: tuple[Variable, ...]
    first: int


def _plan(model: UserModel) -> _Plan:
    drive = model.fmu.variable(model.inputs[port_of(model).input].variable)
    parameters = correction_variables(model)
    hold = Variable(
        f"{PREFIX}sample_time",
        "s",
        hold_of(model),
        causality="parameter",
        description="Longest time for which the correction holds.",
    )
    what = Variable(f"{PREFIX}added", description=f"What the correction adds to {drive.name}.")
    added = (*parameters, hold, what)
    first = 1 + max(int(v.valueReference) for v in model.fmu.description.modelVariables)
    if first + len(added) > _LARGEST:
        raise InputError(
            f"{model.fmu.path.name}: its value references go up to {first - 1}; there is no room "
            "for those of the correction"
        )
    starts = {**model.constants, **{p.name: p.value for p in model.parameters}}
    return _Plan(starts, added, first)


def _law(correction: Correction, *, has_velocity: bool) -> tuple[bytes, dict[str, int]]:
    """C code of the law and the sizes of its arrays."""
    law = law_function(correction.model, has_velocity=has_velocity)
    return model_code("corrected_law", [law]), {
        "NS": law.numel_in(0),
        "NP": law.numel_in(2),
        "SZ_ARG": law.sz_arg(),
        "SZ_RES": law.sz_res(),
        "SZ_IW": law.sz_iw(),
        "SZ_W": law.sz_w(),
    }


def _guid(model: UserModel) -> str:
    about = model.fmu.description
    return str(about.instantiationToken if model.fmu.version == 3 else about.guid)


def _texts(model: UserModel, guid: str, library: str) -> dict[str, str]:
    """Texts of the configuration, as C has them."""
    return {
        "CORRECTED_GUID": json.dumps(guid),
        "INNER_GUID": json.dumps(_guid(model)),
        "INNER_LIBRARY": json.dumps(library, ensure_ascii=False),
    }


def _config(model: UserModel, correction: Correction, plan: _Plan, own: Mapping[str, Any]) -> bytes:
    port, law = port_of(model), correction.model
    # "...FMUstate" in FMI 2.0, "...FMUState" in FMI 3.0
    can = {k[:-5]: v in ("true", "1") for k, v in interface(model.fmu.folder).attrib.items()}
    variables = model.fmu.description.modelVariables
    names = law.parameter_names
    read = [model.outputs[port.output].variable]
    read += [model.outputs[port.velocity].variable] if port.velocity is not None else []
    drive = model.inputs[port.input].variable

    def reference(name: str) -> int:
        return int(model.fmu.variable(name).valueReference)

    defined: dict[str, Any] = {
        **own,
        "INNER_STATES": int(can.get("canGetAndSetFMU", False)),
        "INNER_BYTES": int(can.get("canSerializeFMU", False)),
        "NF": len(correction.free),
        "VR_LAW": f"{plan.first}u",
        "VR_DRIVE": f"{reference(drive)}u",
        "VR_READ": "{" + ", ".join(f"{reference(n)}u" for n in read) + "}",
        "PER_DRIVE": repr(float(port.torque)),
        "PER_POSITION": repr(float(port.position)),
        "PER_RATE": repr(float(port.rate)),
        "DRIVE_START": repr(model.fmu.start(drive)),
        "HOLD": repr(hold_of(model)),
    }
    lines = ["/* Places, start values and value references of this FMU. */"]
    lines += [f"#define {key} {value}" for key, value in defined.items()]
    values = [float(v) for v in law.value_vector()]
    lines.append(_table("start_p", "double", values))
    lines.append(_table("free_p", "int", [names.index(n) for n in correction.free]))
    version = model.fmu.version
    for name, kind in _KINDS[version].items():
        own = {v.name: int(v.valueReference) for v in variables if v.type in kind.types}
        known = sorted(set(own.values()))
        lines.append(_table(f"known_{name}", f"fmi{version}ValueReference", known))
        lines.append(f"#define N_KNOWN_{name.upper()} {len(known)}")
        if kind.c:
            starts = {own[n]: v for n, v in plan.starts.items() if n in own}
            lines.append(_table(f"start_{name}", f"fmi{version}ValueReference", starts))
            cast = float if kind.types[0] in _REAL else int
            lines.append(_table(f"start_{name}_to", kind.c, [cast(v) for v in starts.values()]))
            lines.append(f"#define N_START_{name.upper()} {len(starts)}")
    if version == 3:
        lengths = {
            int(v.valueReference): math.prod(v.shape or ())
            for v in variables
            if v.type in _KINDS[3]["real"].types
        }
        lines.append(_table("length_real", "size_t", [lengths[vr] for vr in sorted(lengths)]))
    return ("\n".join(lines) + "\n").encode()


def _table(name: str, kind: str, values: Iterable[Number]) -> str:
    text = ", ".join(repr(v) for v in values) or "0"
    return f"static const {kind} {name}[] = {{{text}}};"


__all__ = ["export_corrected"]
