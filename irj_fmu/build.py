"""Build the FMUs of a joint file, check them, and put them where they are wanted."""

from __future__ import annotations

import argparse
import importlib.util
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from identification.data.joint_file import Joint, load_joint
from identification.data.own_effects import files_of
from identification.errors import InputError
from identification.scratch import folder_beside, hold, outer_folder
from irj_fmu.command_line import (
    OneLineParser,
    check_folder,
    check_output,
    checkpoint,
    fail,
    keep_inputs,
    run_alone,
    write_json,
)
from irj_fmu.fmi.compiler import find_compiler

if TYPE_CHECKING:
    from identification.data.record import Record
    from irj_fmu.fmi.related import Related
    from irj_fmu.plant.library import PlantSpec

KINDS: Final = ("estimator", "plant", "native", "ssp", "all")
_TRY: Final = (
    "no C compiler: the estimator still builds (`irj export estimator`), for Python hosts; "
    "plants, native estimators "
    "and systems need one: run `pip install ziglang`, or install gcc and pass --cc gcc"
)
_SMOKE: Final = """
import os, sys, tempfile
from fmpy import extract, instantiate_fmu, read_model_description, simulate_fmu
import numpy as np
path, step, count = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
described = read_model_description(path)
names = [v.name for v in described.modelVariables if v.causality == "output"]
folder = tempfile.mkdtemp(dir=".")
extract(path, folder)
made = instantiate_fmu(os.path.abspath(folder), described, "CoSimulation")
found = simulate_fmu(path, stop_time=step * count, output_interval=step, step_size=step,
                     output=names, fmi_type="CoSimulation", fmu_instance=made,
                     model_description=described)
getattr(made, f"fmi{described.fmiVersion[0]}FreeInstance")(made.component)
# the library of pythonfmu releases its interpreter once more at exit unless this was called
getattr(made.dll, "finalizePythonInterpreter", int)()
made.freeLibrary()
if len(found) != count + 1:
    sys.exit(f"{len(found)} of {count + 1} steps")
for name in names:
    if not np.isfinite(np.asarray(found[name], dtype=float)).all():
        sys.exit(f"output {name} is not finite")
if "health" in names and found["health"].max() > 1:
    sys.exit(f"health is {found['health'].max()}")
"""


@final
@dataclass(frozen=True)
class Request:
    """What is to be built.

    Attributes
    ----------
    joint : Joint
        The joint file.
    source : Path
        Where it lies.
    out : Path
        Folder of the results.
    cc, target : str, optional
        See :func:`irj_fmu.plant.library.build_plant`; targets by the names of their folders as
        well, e.g. ``win64``.
    controller, sensors : bool
        Of the plant.
    healthy : tuple of Path
        Records of the healthy joint, from which the estimator's fault detector takes its limits.
    has_link, has_torque : bool
        Sensors of the joint.
    sample_time : float or None
        Of a native estimator, built in [s]; by default that of the records of the fit, as the joint
        file says, or of the healthy records.
    say : callable
        Called with one sentence per doubt about a record.
    fmi : {2, 3}
        Version of FMI, of plants and native estimators.
    cross_check : bool
        Of a plant: the folder of the FMI Cross-Check, too.
    held_out, report : Path, optional
        Of a plant: a record that the fit did not see, and the report of the fit, that go into it
        with the joint file.
    """

    joint: Joint
    source: Path
    out: Path
    cc: str | None = None
    target: str | None = None
    controller: bool = False
    sensors: bool = False
    healthy: tuple[Path, ...] = ()
    has_link: bool = True
    has_torque: bool = True
    sample_time: float | None = None
    say: Callable[[str], object] = lambda _text: None
    fmi: int = 2
    cross_check: bool = False
    held_out: Path | None = None
    report: Path | None = None

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Files that are read."""
        more = (self.held_out, self.report)
        return (self.source, *self.healthy, *(path for path in more if path is not None))


def build(
    kind: str, request: Request, say: Callable[[str], object] = lambda _text: None
) -> list[Path]:
    """Build, validate, run and only then put into place.

    Parameters
    ----------
    kind : str
        One of :data:`KINDS`.
    request : Request
    say : callable
        Called with one sentence per result.

    Returns
    -------
    list of Path
        The files, in `request.out`.

    Raises
    ------
    InputError
        Where something is missing or a check fails; what was complete before stays, nothing is left
        half-written.
    """
    if kind not in KINDS:
        raise InputError(f"{kind!r} cannot be built; choose one of {', '.join(KINDS)}")
    keep_inputs(
        [request.out / name for name in _names(kind, _base(request))],
        list(request.inputs),
    )
    made_folders = _prepare(request.out)
    hold(request.out)
    done: list[Path] = []
    try:
        with folder_beside(request.out, ".build-") as temporary:
            for maker in _makers(kind):
                for path, note in maker(request, Path(temporary)):
                    ran = (
                        "smoke run passed"
                        if _check(path)
                        else "not run: it holds no library for this machine"
                    )
                    final_path = request.out / path.name
                    path.replace(final_path)
                    done.append(final_path)
                    say(f"{final_path} ({note}; validated, {ran})")
                    if request.cross_check:
                        done += _cross_check(request, final_path, say)
    except OSError as error:
        raise InputError(_no_room(request.out, error)) from None
    finally:
        for folder in made_folders:
            if not any(folder.iterdir()):
                folder.rmdir()
    return done


_Maker = Callable[[Request, Path], list[tuple[Path, str]]]


def _makers(kind: str) -> list[_Maker]:
    table: dict[str, list[_Maker]] = {
        "estimator": [_estimator],
        "plant": [_plant],
        "native": [_native],
        "ssp": [_ssp],
        "all": [_estimator, _plant, _controlled, _ssp, _native],
    }
    return table[kind]


def _no_room(out: Path, error: OSError) -> str:
    """What is said where a file cannot be written: the system does not say on which disk."""
    why, temporary = error.strerror or error, outer_folder()
    place = next(p for p in (out.absolute(), *out.absolute().parents) if p.exists())
    if temporary.exists() and temporary.stat().st_dev != place.stat().st_dev:
        return (
            f"{out}, or {temporary} for temporary files: cannot write there ({why}); make room, or "
            "name other folders with --out and TMPDIR"
        )
    return f"{out}: cannot write there ({why}); choose a writable folder with space on its disk"


def _names(kind: str, base: str) -> list[str]:
    """Files that a kind makes."""
    every = {
        "estimator": ["estimator.fmu"],
        "plant": ["plant.fmu"],
        "native": ["native.fmu"],
        "all": ["estimator.fmu", "plant.fmu", "plant_controlled.fmu", "native.fmu"],
    }
    return [
        *(f"{base}_{end}" for end in every.get(kind, [])),
        *([f"{base}.ssp"] if kind in ("ssp", "all") else []),
    ]


def _prepare(out: Path) -> list[Path]:
    """Make the folder where it is missing; the folders that were made, the innermost first."""
    check_folder(out)
    missing = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(prefix=".write-", dir=out):
            return missing
    except OSError as error:
        for folder in filter(Path.is_dir, missing):
            folder.rmdir()
        raise InputError(
            f"{out}: cannot write there ({error.strerror}); choose a writable folder with --out"
        ) from None


# --- the kinds ------------------------------------------------------------------------------------


def _base(request: Request) -> str:
    from irj_fmu.plant.joint import identifier

    return identifier(request.joint.name)


def _compiler(request: Request) -> tuple[str, ...]:
    """Targets of the request; there is a compiler for them."""
    from irj_fmu.fmi.targets import native_targets

    targets = native_targets(request.target)
    try:
        for target in (None,) if request.target in (None, "all") else targets:
            find_compiler(target, request.cc)
    except InputError as error:
        raise InputError(_TRY if request.cc is None else str(error)) from None
    return targets


def _plant(request: Request, folder: Path) -> list[tuple[Path, str]]:
    return [
        _one_plant(
            request,
            folder,
            f"{_base(request)}_plant",
            controller=request.controller,
            sensors=request.sensors,
        )
    ]


def _controlled(request: Request, folder: Path) -> list[tuple[Path, str]]:
    return [
        _one_plant(
            request, folder, f"{_base(request)}_plant_controlled", controller=True, sensors=True
        )
    ]


def _one_plant(
    request: Request, folder: Path, name: str, *, controller: bool, sensors: bool
) -> tuple[Path, str]:
    from irj_fmu.plant.fmi3 import build_plant_fmi3
    from irj_fmu.plant.joint import PlantOptions, plant_spec
    from irj_fmu.plant.library import build_plant
    from irj_fmu.plant.reference import Motion

    targets = _compiler(request)
    motion = Motion() if controller else None
    spec = plant_spec(
        request.joint,
        PlantOptions(controller=controller, motion=motion, sensors=sensors, name=name),
    )
    if request.held_out is not None or request.report is not None:
        spec = replace(spec, related=_related(request, spec))
    maker = {2: build_plant, 3: build_plant_fmi3}[request.fmi]
    path = maker(spec, folder / f"{name}.fmu", cc=request.cc, target=targets)
    kinds = "co-simulation" if spec.memory else "model exchange and co-simulation"
    return (
        path,
        f"FMI {request.fmi}.0 {kinds}, {len(spec.states) + len(spec.memory)} states, "
        f"{len(spec.parameters)} parameters",
    )


def _related(request: Request, spec: PlantSpec) -> tuple[Related, ...]:
    """The joint file, the report of the fit and a held-out record as files of the plant."""
    from irj_fmu.estimator.healthy import read_healthy
    from irj_fmu.fmi.related import Related, experiment_files
    from irj_fmu.plant.measured import measured_run

    def content(path: Path) -> bytes:
        try:
            return path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from None

    found = [
        Related(
            "joint.toml",
            content(request.source),
            "application/toml",
            "model",
            "Joint file: structure, fitted values with errors, and which records they are from.",
        )
    ]
    if request.report is not None:
        kind = "text/html" if request.report.suffix in (".html", ".htm") else "text/plain"
        found.append(
            Related(
                f"report{request.report.suffix}",
                content(request.report),
                kind,
                "report",
                "Report of the fit.",
            )
        )
    if request.held_out is not None:
        (record,) = read_healthy([request.held_out], request.joint, request.say)
        found += experiment_files(measured_run(record, spec, request.joint.gear_ratio))
    return tuple(found)


def _estimator(request: Request, folder: Path) -> list[tuple[Path, str]]:
    from identification.online.estimator import OnlineOptions, prepared
    from irj_fmu.estimator.healthy import detector_state
    from irj_fmu.estimator.notes import estimator_notes
    from irj_fmu.estimator.packed import options_text
    from irj_fmu.estimator.slave import DETECTOR_FILE, JOINT_FILE, OPTIONS_FILE
    from irj_fmu.fmi.package import SlaveSpec, package_slave

    name = f"{_base(request)}_estimator"
    options = OnlineOptions(has_link=request.has_link, has_torque=request.has_torque)
    prepared(request.joint, options)
    texts = folder / "texts"
    texts.mkdir(exist_ok=True)
    healthy, step = _healthy(request)
    (texts / OPTIONS_FILE).write_text(options_text(options, step), encoding="utf-8")
    files = {JOINT_FILE: request.source, OPTIONS_FILE: texts / OPTIONS_FILE}
    state = detector_state(request.joint, options, healthy, step, request.say)
    if state is not None:
        (texts / DETECTOR_FILE).write_bytes(state)
        files[DETECTOR_FILE] = texts / DETECTOR_FILE
    spec = SlaveSpec(
        name,
        "irj_fmu.estimator.slave",
        "Estimator",
        tuple(_package(p) for p in ("casadi_models", "identification", "irj_fmu")),
        files,
        effects=files_of(request.joint.effects),
        notes=estimator_notes(request.joint, options),
    )
    packaged = package_slave(spec, folder / f"{name}.fmu", cc=request.cc)
    return [(packaged.path, f"FMI 2.0 co-simulation; {packaged.message}")]


def _healthy(request: Request) -> tuple[list[Record], float]:
    """The healthy records, and the step of an estimator [s]: what is asked for, else that of the
    records of the fit, else that of the finest healthy record that serves a fault detector.
    """
    from identification.faults.detector import FaultSettings
    from irj_fmu.estimator.healthy import read_healthy
    from irj_fmu.estimator.packed import STEP

    records = read_healthy(request.healthy, request.joint, request.say)
    told = request.sample_time or request.joint.sample_time
    fine = [float(f"{r.dt:.6g}") for r in records if r.dt <= FaultSettings().lags[0]]
    return records, told or min(fine, default=STEP)


def _native(request: Request, folder: Path) -> list[tuple[Path, str]]:
    from identification.online.estimator import OnlineOptions
    from irj_fmu.estimator.healthy import detector_state
    from irj_fmu.estimator.native import NativeSpec, build_native
    from irj_fmu.estimator.native_fmi3 import build_native_fmi3

    targets = _compiler(request)
    name = f"{_base(request)}_native"
    options = OnlineOptions(has_link=request.has_link, has_torque=request.has_torque)
    healthy, step = _healthy(request)
    state = detector_state(request.joint, options, healthy, step, request.say)
    spec = NativeSpec(request.joint, name, options, state, step)
    maker = {2: build_native, 3: build_native_fmi3}[request.fmi]
    path = maker(spec, folder / f"{name}.fmu", cc=request.cc, target=targets)
    return [(path, f"FMI {request.fmi}.0 co-simulation without Python, sample time {step:g} s")]


def _ssp(request: Request, folder: Path) -> list[tuple[Path, str]]:
    from irj_fmu.fmi.ssp import System, multisine_source, write_ssp
    from irj_fmu.plant.library import build_plant

    _compiler(request)
    base = _base(request)
    plant, _ = _one_plant(
        request, folder, f"{base}_plant", controller=False, sensors=request.sensors
    )
    estimator = _estimator(request, folder)[0][0]
    drive, tones = _drive(request)
    amplitudes, frequencies, phases = zip(*tones, strict=True)
    spec = multisine_source(amplitudes, frequencies, phases, unit="A" if drive == "i_m" else "N.m")
    source = build_plant(spec, folder / "source.fmu", cc=request.cc)
    channels = {
        "q_m": "motor_position",
        "w_m": "motor_velocity",
        "q_l": "link_position",
        "w_l": "link_velocity",
        "tau_l": "link_torque",
    }
    connections = {f"plant.{drive}": "source.signal", f"estimator.{drive}": "source.signal"}
    connections |= {f"estimator.{k}": f"plant.{v}" for k, v in channels.items()}
    system = System(
        {"source": source, "plant": plant, "estimator": estimator},
        connections,
        name=base,
        step=float(_step(estimator)),
        stop=40.0,
    )
    path = write_ssp(system, folder / f"{base}.ssp")
    return [(path, "SSP 1.0: source, plant, estimator")]


def _cross_check(request: Request, fmu: Path, say: Callable[[str], object]) -> list[Path]:
    from irj_fmu.cross_check import write_cross_check

    if not _runs_here(fmu):
        raise InputError(
            f"{fmu}: the reference solution is computed here, and it holds no library for this "
            "machine; give --target all, or leave out --cross-check"
        )
    drive, tones = _drive(request)

    def signal(time: float) -> float:
        return sum(a * math.sin(2 * math.pi * f * time + shift) for a, f, shift in tones)

    made = write_cross_check(fmu, request.out, {drive: signal})
    for place in sorted({path.parent for path in made}):
        say(f"{place} (cross-check: FMU, reference, options)")
    return made


def _drive(request: Request) -> tuple[str, list[tuple[float, float, float]]]:
    """Drive input of a plant, and tones for it: amplitude, frequency [Hz], phase [rad]."""
    by_current = request.joint.torque_per_current is not None
    scale = request.joint.torque_per_current if by_current else request.joint.gear_ratio
    sizes = [size / abs(float(scale or 1.0)) for size in (60.0, 30.0, 10.0)]
    tones = list(zip(sizes, (0.2, 0.7, 2.3), (0.0, 1.0, 2.0), strict=True))
    return ("i_m" if by_current else "tau_m"), tones


def _package(name: str) -> Path:
    found = importlib.util.find_spec(name)
    for place in (found.submodule_search_locations or []) if found else []:
        return Path(place)
    raise InputError(f"package {name} is missing; install the project again")


# --- checks ---------------------------------------------------------------------------------------


def _check(path: Path) -> bool:
    """Validate, and run where this machine can; False where it cannot."""
    if path.suffix == ".ssp":
        _run(path, [sys.executable, "-I", "-c", _SMOKE_SSP, str(path)])
        return True
    from fmpy.validation import validate_fmu

    problems = validate_fmu(str(path))
    if problems:
        raise InputError(f"{path.name}: not a valid FMU: {problems[0]}")
    runs = _runs_here(path)
    if runs:
        _run(path, [sys.executable, "-I", "-c", _SMOKE, str(path), _step(path), "200"])
    return runs


_SMOKE_SSP: Final = """import sys
from fmpy.ssp.ssd import read_ssd
found = read_ssd(sys.argv[1])
if len(found.system.elements) < 2 or not found.system.connections:
    sys.exit("no components or connections")
"""


def _step(path: Path) -> str:
    """Step size that the FMU asks for."""
    from fmpy import read_model_description

    return str(read_model_description(str(path)).defaultExperiment.stepSize)


def _runs_here(path: Path) -> bool:
    from fmpy import platform, platform_tuple, supported_platforms

    return not {platform, platform_tuple}.isdisjoint(supported_platforms(str(path)))


def _run(path: Path, command: Sequence[str]) -> None:
    """A fresh process in another folder."""
    checkpoint()
    with tempfile.TemporaryDirectory(prefix="irj-smoke-") as elsewhere:
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        done = subprocess.run(
            command, cwd=elsewhere, capture_output=True, text=True, check=False, env=environment
        )
    if done.returncode != 0:
        last = (
            done.stderr.strip() or done.stdout.strip() or f"exit {done.returncode}"
        ).splitlines()[-1]
        raise InputError(f"{path.name}: the smoke run failed: {last}")


# --- command line ---------------------------------------------------------------------------------


def parser(prog: str = "build_fmu.py") -> OneLineParser:
    """Arguments of ``build_fmu.py`` and ``irj export``."""
    made = OneLineParser(prog=prog, description="Build, validate and try the FMUs of a joint file.")
    made.add_argument("kind", choices=KINDS, help="what is built (irj export: default plant)")
    made.add_argument("--joint", required=True, type=Path, help="joint file (TOML), fitted or not")
    made.add_argument(
        "--out", default=Path("dist"), type=Path, help="folder of the results (default: dist)"
    )
    made.add_argument(
        "--cc", help="C compiler: a command such as gcc, or zig for the ziglang package"
    )
    made.add_argument(
        "--target",
        help="platform of plants and native estimators: linux64, win64, darwin64, "
        "x86_64-linux-gnu, ..., or all",
    )
    made.add_argument(
        "--sample-time",
        type=float,
        metavar="S",
        help="native: time between two samples, built in (default: that of the records of the fit)",
    )
    made.add_argument(
        "--fmi", type=int, choices=(2, 3), help="plant, native: version of FMI (default: 2)"
    )
    made.add_argument(
        "--controller", action="store_true", help="plant: drive it by a position controller"
    )
    made.add_argument(
        "--sensors",
        action="store_true",
        help="plant: readings with noise, quantisation and faults as parameters",
    )
    made.add_argument(
        "--healthy",
        nargs="+",
        action="extend",
        default=[],
        type=Path,
        metavar="RECORD",
        help="estimators: records of the healthy joint, for the limits of its fault detector; "
        "resampled to the estimator's step",
    )
    made.add_argument(
        "--no-link", action="store_true", help="estimators: the joint has no link encoder"
    )
    made.add_argument(
        "--no-torque", action="store_true", help="estimators: the joint has no torque sensor"
    )
    made.add_argument(
        "--held-out",
        type=Path,
        metavar="RECORD",
        help="plant: a record that the fit did not see; inside the FMU it is an experiment with "
        "stimuli and reference (FMI-LS-REF)",
    )
    made.add_argument(
        "--report",
        type=Path,
        metavar="FILE",
        help="plant: the report of the fit, which goes into the FMU (FMI-LS-REF)",
    )
    made.add_argument(
        "--cross-check",
        action="store_true",
        help="plant, FMI 2.0: also a folder with inputs, reference solution and options, by the "
        "rules of the FMI Cross-Check",
    )
    made.add_argument("--json", type=Path, metavar="FILE", help="write what was built as JSON")
    return made


_OF: Final = {  # options that only some kinds heed
    "sample_time": ("native", "all"),
    "fmi": ("plant", "native"),
    "cross_check": ("plant",),
    "held_out": ("plant",),
    "report": ("plant",),
    "controller": ("plant", "all"),
    "sensors": ("plant", "ssp", "all"),
    "healthy": ("estimator", "native", "ssp", "all"),
    "target": ("plant", "native", "ssp", "all"),
}


def _request(given: argparse.Namespace) -> Request:
    """The request of checked arguments.

    Raises
    ------
    InputError
        An option that this kind does not heed; a result that would replace an input; an unusable
        joint file.
    """
    for option, kinds in _OF.items():
        if getattr(given, option) not in (None, False, []) and given.kind not in kinds:
            raise InputError(
                f"--{option.replace('_', '-')}: goes with {', '.join(kinds)}, not with "
                f"{given.kind}; leave it out"
            )
    if given.sample_time is not None and not 1e-5 <= given.sample_time <= 1.0:
        raise InputError(f"--sample-time {given.sample_time:g}: give 0.00001 to 1 s")
    if given.cross_check and given.fmi == 3:
        raise InputError("--cross-check: its rules are for FMI 2.0; leave out --fmi 3")
    joint = load_joint(given.joint)
    request = Request(
        joint=joint,
        source=given.joint,
        out=given.out,
        cc=given.cc,
        target=given.target,
        controller=given.controller,
        sensors=given.sensors,
        healthy=tuple(given.healthy),
        has_link=not given.no_link,
        has_torque=not given.no_torque,
        sample_time=given.sample_time,
        say=lambda text: sys.stderr.write(f"irj: {text}\n"),
        fmi=given.fmi or 2,
        cross_check=given.cross_check,
        held_out=given.held_out,
        report=given.report,
    )
    if given.json is not None:
        made = [request.out / name for name in _names(given.kind, _base(request))]
        check_output(given.json, list(request.inputs))
        if given.json.absolute() in [path.absolute() for path in made]:
            raise InputError(f"{given.json}: given for two results; give each a file of its own")
    return request


def main(argv: Sequence[str], prog: str = "build_fmu.py") -> int:
    """Build; 0 where everything was built, 2 with one line on unusable input."""
    given = parser(prog).parse_args(argv)
    try:
        done = build(given.kind, _request(given), lambda text: sys.stdout.write(f"{text}\n"))
        write_json(given.json, {"built": [str(p) for p in done]})
    except InputError as error:
        return fail(str(error))
    return 0


def script(argv: Sequence[str]) -> int:
    """``build_fmu.py``: as :func:`main`; Ctrl-C and what the system refuses are one line, too."""
    return run_alone(main, argv)
