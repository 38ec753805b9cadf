"""The native twin of the estimator FMU: the same numbers from C code, without Python in the host.

FMI 2.0 co-simulation for hardware-in-the-loop rigs and other platforms. Shapes of friction and
stiffness laws stay at the values of the joint file; instead of a search the output ``reoptimise``
says that they want one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, final

from identification.data.joint_file import Joint
from identification.errors import InputError
from identification.online.estimator import OnlineEstimator, OnlineOptions
from irj_fmu.estimator.native_tables import MAX_WARM_UP, Code, generate
from irj_fmu.estimator.notes import estimator_notes
from irj_fmu.estimator.packed import STEP
from irj_fmu.estimator.slave import estimator_variables, two_step_variables
from irj_fmu.fmi.archive import content_guid, write_archive
from irj_fmu.fmi.compiler import (
    compile_library,
    find_compiler,
    header_folder,
)
from irj_fmu.fmi.documentation import beside
from irj_fmu.fmi.model_description import Description, Entry, model_description, to_bytes
from irj_fmu.fmi.slave_base import STANDARD
from irj_fmu.fmi.targets import binaries, native_targets
from irj_fmu.fmi.variables import Variable

_C: Final = Path(__file__).parents[1] / "c"
_MAIN: Final = "native_wrapper.c"
_SOURCES: Final = (
    _MAIN,
    "fmi2_common.c",
    "living.c",
    "native_shared.c",
    "native_state.h",
    "native_rows.c",
    "native_watch.c",
    "native_algebra.c",
    "native_calibration.c",
    "native_guard.c",
    "native_window.c",
    "native_residuals.c",
    "native_fault.c",
    "native_estimator.c",
)
_TELLS: Final = (
    "Online estimation of the parameters of a geared joint, with residuals of its "
    "balances and fault detection; in C."
)


@final
@dataclass(frozen=True)
class NativeSpec:
    """A native estimator to be built.

    Attributes
    ----------
    joint : Joint
        The joint file.
    name : str
        A C identifier; names the model and its library.
    options : OnlineOptions
        Sensors, and start values of the tunable parameters.
    detector_state : bytes, optional
        State of a calibrated fault detector, see :func:`irj_fmu.build.detector_state`.
    sample_time : float
        Time between two samples [s]; it is built in.
    """

    joint: Joint
    name: str
    options: OnlineOptions = OnlineOptions()
    detector_state: bytes | None = None
    sample_time: float = STEP


def build_native(
    spec: NativeSpec, out: Path, *, cc: str | None = None, target: str | Sequence[str] | None = None
) -> Path:
    """Build the FMU.

    Parameters
    ----------
    spec : NativeSpec
        What to build.
    out : Path
        File to write, ending in ``.fmu``; renamed into place when it is complete.
    cc : str, optional
        Compiler: a command such as ``gcc``, or ``zig`` for the ziglang package. By default what is
        found.
    target : str or sequence of str, optional
        Keys of `irj_fmu.fmi.compiler.TARGETS` or of :data:`irj_fmu.fmi.targets.SHORT_TARGETS`, or
        ``"all"``; by default this machine.

    Returns
    -------
    Path
        Absolute path. The same content gives the same bytes.

    Raises
    ------
    InputError
        Where the joint does not carry an estimator, there is no compiler, or the folder cannot be
        written.

    Notes
    -----
    Value references, names, units and causalities are those of the Python estimator FMU of the same
    joint file. ``sample_time`` and ``joint_file`` are built in: another value sets ``health`` to 4
    and is named in the log. ``warm_up`` may go up to 20 s. ``optimise``, ``portions`` and
    ``reoptimise_request`` have no effect.
    """
    if not re.fullmatch(r"[A-Za-z_]\w*", spec.name, re.ASCII):
        raise InputError(
            f"FMU identifier {spec.name!r} is not a C identifier; use letters, digits and '_'"
        )
    if not 1e-5 <= spec.sample_time <= 1.0:
        raise InputError(
            f"native estimator: a sample time of {spec.sample_time!r} s; give 0.00001 to 1 s"
        )
    targets = native_targets(target)
    for triple in targets:
        find_compiler(triple, cc)
    header_folder()
    sources, description = native_sources(spec)
    content = {f"sources/{name}": text for name, text in sources.items()}
    content["modelDescription.xml"] = description
    content |= beside(description, estimator_notes(spec.joint, spec.options))
    built = {
        triple: compile_library(sources, _MAIN, triple, cc=cc, libraries=("m",))
        for triple in targets
    }
    return write_archive(out, content | binaries(built, spec.name))


def described(config: bytes) -> str:
    """The GUID that a generated native_config.h holds."""
    found = re.search(rb'NATIVE_GUID "([^"]+)"', config)
    if found is None:
        raise ValueError("native_config.h holds no GUID")
    return found[1].decode()


def native_sources(
    spec: NativeSpec, more: Mapping[str, bytes] | None = None
) -> tuple[dict[str, bytes], bytes]:
    """C sources of the library and modelDescription.xml; nothing is compiled.

    `more` holds what else the GUID stands for, by name, where the wrapper is another one.
    """
    made = OnlineEstimator(
        spec.joint,
        spec.sample_time,
        replace(spec.options, detect=True, optimise=False),
        spec.detector_state,
    )
    variables = native_variables(spec)
    texts = {name: (_C / name).read_bytes() for name in _SOURCES}

    def written(guid: str) -> tuple[Code, bytes]:
        return generate(spec.joint, made, variables, guid), _describe(spec, variables, guid)

    code, description = written("")
    guid = content_guid(
        {
            **texts,
            "config": code.config,
            "model": code.model,
            "description": description,
            **(more or {}),
        }
    )
    code, description = written(guid)
    return texts | {"native_model.c": code.model, "native_config.h": code.config}, description


def native_variables(spec: NativeSpec) -> tuple[Variable, ...]:
    """The variables of the Python estimator in their order; bounds say what is built in."""
    held = replace(
        STANDARD[0], start=spec.sample_time, minimum=spec.sample_time, maximum=spec.sample_time
    )
    most = max(MAX_WARM_UP, spec.options.warm_up)
    options = replace(spec.options, optimise=False)
    own = (*estimator_variables(spec.joint, options), *two_step_variables(spec.joint, options))
    return (
        held,
        *STANDARD[1:],
        *(replace(v, maximum=most) if v.name == "warm_up" else v for v in own),
    )


def _describe(spec: NativeSpec, variables: Sequence[Variable], guid: str) -> bytes:
    what = Description(
        name=spec.name,
        identifier=spec.name,
        guid=guid,
        interfaces=("CoSimulation",),
        description=_TELLS,
        step=spec.sample_time,
        stop=1000 * spec.sample_time,
        options={"canInterpolateInputs": "false"},
        sources=(_MAIN,),
    )
    return to_bytes(model_description(what, [Entry(v) for v in variables]))


__all__ = ["NativeSpec", "build_native", "described", "native_sources", "native_variables"]
