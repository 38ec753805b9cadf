"""Co-simulate a plant FMU with its estimator FMU and compare the estimate with the plant's
values.
"""

from __future__ import annotations

import math
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from casadi_models.term import INERTIAS
from identification.data.joint_file import Joint, load_joint, toml_text
from identification.data.own_effects import files_of
from identification.errors import InputError
from identification.online.estimator import OnlineOptions, estimated_parameters, prepared
from identification.online.identifiable import Identifiable, identifiable
from irj_fmu.command_line import (
    OneLineParser,
    check_output,
    counted,
    fail,
    progress_bar,
    write_json,
)
from irj_fmu.estimator.healthy import detector_state, read_healthy
from irj_fmu.estimator.packed import STEP, options_text
from irj_fmu.estimator.slave import DETECTOR_FILE, JOINT_FILE, OPTIONS_FILE
from irj_fmu.fmi.compiler import find_compiler
from irj_fmu.host.run import Fmu, FmuError, Instance, Trajectory, Wiring, simulate_cs
from irj_fmu.host.signals import Fault
from irj_fmu.plant.joint import PlantOptions, identifier, plant_spec
from irj_fmu.plant.library import build_plant
from irj_fmu.plant.reference import NAMES, Motion, published_joint, reference_joint, start_of

FloatArray = npt.NDArray[np.float64]

CHANNELS: Final = {
    "q_m": "motor_position",
    "w_m": "motor_velocity",
    "q_l": "link_position",
    "w_l": "link_velocity",
    "tau_l": "link_torque",
}
"""Inputs of the estimator and the outputs of the plant that feed them."""
TIGHT: Final = 2.0
LOOSE: Final = 10.0
"""Largest errors [%]; the loose one holds for the Stribeck part and the cubic stiffness."""
_LIMITS: Final[Mapping[str, float]] = {
    **dict.fromkeys(
        (
            *INERTIAS,
            "stiffness",
            "gravity_torque",
            "coulomb",
            "viscous",
            "loss_constant",
            "loss_viscous",
        ),
        TIGHT,
    ),
    **dict.fromkeys(
        (
            "stribeck_extra",
            "stribeck_velocity",
            "smooth_stribeck",
            "cubic_stiffness",
            "loss_cubic",
            "structural_damping",
        ),
        LOOSE,
    ),
}
"""Largest error of each parameter of the reference joints, by the name in its declaration."""


@final
@dataclass(frozen=True)
class Row:
    """One parameter: what the plant has, what the estimator says.

    Attributes
    ----------
    plant, estimate, sigma : float
        In `unit`; where the motion shows a parameter in combinations only, the estimate is without
        what it does not show.
    limit : float or None
        Largest error asked for [%].
    """

    joint: str
    name: str
    unit: str
    plant: float
    estimate: float
    sigma: float
    limit: float | None

    @property
    def error(self) -> float:
        """Relative error [%]; NaN where the plant has 0."""
        return 100.0 * (self.estimate / self.plant - 1.0) if self.plant else float("nan")

    @property
    def passed(self) -> bool:
        """True where the limit holds or there is none."""
        return self.limit is None or abs(self.error) <= self.limit


@final
@dataclass(frozen=True)
class Cosimulation:
    """A co-simulation of plant and estimator.

    Attributes
    ----------
    trajectory : Trajectory
        ``estimator.theta[k]``, ``estimator.health``, ``estimator.fault``, the ratios, and what else
        was asked for.
    names : tuple of str
        Estimated parameters.
    rows : tuple of Row
        At the end.
    ratios : mapping of str to float
        Residual over floor of each balance at the end.
    messages : tuple of str
        What the estimator logged.
    """

    trajectory: Trajectory
    names: tuple[str, ...]
    rows: tuple[Row, ...]
    ratios: Mapping[str, float]
    messages: tuple[str, ...]


@final
@dataclass(frozen=True)
class Setting:
    """How a co-simulation runs.

    Attributes
    ----------
    stop, step : float
        Length and communication step [s].
    parameters : mapping
        Start values by ``plant.name`` or ``estimator.name``, e.g. noise and faults of the plant's
        sensors.
    faults : mapping
        By input of the estimator, e.g. ``{"q_l": bias(20.0, 0.01)}``.
    record : sequence of str
        Further variables.
    """

    stop: float = 40.0
    step: float = STEP
    parameters: Mapping[str, float | str | bool] = field(default_factory=dict)
    faults: Mapping[str, Fault] = field(default_factory=dict)
    record: Sequence[str] = ()


def make_pair(
    plant: Joint,
    model: Joint,
    folder: Path,
    *,
    cc: str | None = None,
    healthy: Sequence[Path] = (),
    shim: bool = False,
    motion: Motion | None = None,
) -> tuple[Path, Path]:
    """Build a plant FMU with controller and sensors, and an estimator FMU of a joint file.

    Parameters
    ----------
    plant : Joint
        What the plant is.
    model : Joint
        What the estimator believes.
    folder : Path
    cc : str, optional
        C compiler.
    healthy : sequence of Path
        Records for the estimator's fault detector.
    shim : bool
        Give the estimator the shim for C hosts.
    motion : Motion, optional
        What the plant's controller follows.

    Returns
    -------
    tuple of Path
        Plant and estimator.
    """
    from irj_fmu.build import _package
    from irj_fmu.fmi.package import SlaveSpec, package_slave

    folder.mkdir(parents=True, exist_ok=True)
    name = identifier(plant.name)
    spec = plant_spec(
        plant,
        PlantOptions(
            controller=True, motion=motion or Motion(), sensors=True, name=f"{name}_plant"
        ),
    )
    built = build_plant(spec, folder / f"{name}_plant.fmu", cc=cc)
    options = OnlineOptions()
    texts = folder / f"{name}_texts"
    texts.mkdir(exist_ok=True)
    values = {k: {"value": v, "unit": "", "side": ""} for k, v in model.fitted.items()}
    (texts / JOINT_FILE).write_text(toml_text(model, values), encoding="utf-8")
    (texts / OPTIONS_FILE).write_text(options_text(options), encoding="utf-8")
    files = {n: texts / n for n in (JOINT_FILE, OPTIONS_FILE)}
    state = detector_state(model, options, read_healthy(healthy, model), STEP)
    if state is not None:
        (texts / DETECTOR_FILE).write_bytes(state)
        files[DETECTOR_FILE] = texts / DETECTOR_FILE
    packages = tuple(_package(p) for p in ("casadi_models", "identification", "irj_fmu"))
    made = package_slave(
        SlaveSpec(
            f"{name}_estimator",
            "irj_fmu.estimator.slave",
            "Estimator",
            packages,
            files,
            effects=files_of(model.effects),
        ),
        folder / f"{name}_estimator.fmu",
        cc=cc,
        shim=shim,
    )
    return built, made.path


def cosimulate(
    plant: Joint,
    model: Joint,
    files: tuple[Path, Path],
    setting: Setting | None = None,
    motion: Motion | None = None,
) -> Cosimulation:
    """Run plant and estimator together along the plant's built-in motion; `files` are those of
    :func:`make_pair`.

    Raises
    ------
    InputError
        Unknown names in the setting.
    FmuError
        An FMU refused a call.
    """
    setting, motion = setting or Setting(), motion or Motion()
    sensing = prepared(model, OnlineOptions())[1]
    names = estimated_parameters(model)
    drive = (
        ("i_m", "motor_current")
        if model.torque_per_current is not None
        else ("tau_m", "motor_torque")
    )
    connections = {
        f"estimator.{k}": f"plant.{v}" for k, v in {**CHANNELS, drive[0]: drive[1]}.items()
    }
    outputs = [f"theta[{i}]" for i in range(1, len(names) + 1)] + [
        f"sigma[{i}]" for i in range(1, len(names) + 1)
    ]
    outputs += ["health", "fault", *(f"ratio.{b}" for b in sensing.balances)]
    channels = [f"plant.{v}" for v in (drive[1], *CHANNELS.values())]
    wiring = Wiring(
        connections=connections,
        faults={f"estimator.{k}": f for k, f in setting.faults.items()},
        parameters={**start_state(plant, motion), **setting.parameters},
        record=[
            *(f"estimator.{n}" for n in outputs),
            *(c for c in channels if c not in setting.record),
            *setting.record,
        ],
    )
    with (
        Fmu(files[0]) as first,
        Fmu(files[1]) as second,
        Instance(first, name="plant") as a,
        Instance(second, name="estimator") as b,
    ):
        found = simulate_cs(
            {"plant": a, "estimator": b}, wiring, step=setting.step, stop=setting.stop
        )
        messages = tuple(b.messages)
    ratios = {key: float(found[f"estimator.ratio.{key}"][-1]) for key in sensing.balances}
    readings = np.column_stack([found[c] for c in channels]) * link_referred(plant)
    shown = identifiable(believed(plant, model), readings, np.zeros(6), setting.step, names)
    return Cosimulation(found, names, tuple(_rows(plant, shown, found)), ratios, messages)


def start_state(plant: Joint, motion: Motion) -> dict[str, float]:
    """Start values that put the plant on the motion."""
    q, v = motion.start()
    sides = ("motor_", "link_") if plant.model().is_elastic else ("",)
    return {
        f"plant.state.{side}{n}": x for side in sides for n, x in (("position", q), ("velocity", v))
    }


def believed(plant: Joint, model: Joint) -> Joint:
    """The joint that the estimator believes in, with the plant's values of what both have."""
    true = dict(zip(plant.model().parameter_names, plant.model().value_vector(), strict=True))
    return replace(
        model,
        fitted={**model.fitted, **{n: true[n] for n in model.model().parameter_names if n in true}},
    )


def link_referred(joint: Joint) -> FloatArray:
    """From readings at the sensors, in the order drive and :data:`CHANNELS`, to link-referred
    ones, (6,).
    """
    ratio = joint.gear_ratio
    return np.array([joint.torque_per_current or ratio, 1 / ratio, 1 / ratio, 1.0, 1.0, 1.0])


def _rows(plant: Joint, shown: Identifiable, found: Trajectory) -> list[Row]:
    """The estimates at the end, without the part of their errors that the motion does not show."""
    model, names = plant.model(), shown.names
    units = {p.name: p.unit for p in model.parameters}
    true = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    at = np.array([true.get(n, 0.0) for n in names])
    last, spread = (
        np.array([float(found[f"estimator.{s}[{i}]"][-1]) for i in range(1, len(names) + 1)])
        for s in ("theta", "sigma")
    )
    seen = at + shown.seen(last - at)
    rows = []
    for i, n in enumerate(names):
        if n not in true:
            continue  # the plant has no such thing
        limit = limit_of(model, n) if true[n] else None
        name = n if shown.alone(i) else f"{n} (in combination)"
        rows.append(
            Row(
                plant.name,
                name,
                unit=units[n],
                plant=true[n],
                estimate=float(seen[i]),
                sigma=float(spread[i]),
                limit=limit,
            )
        )
    return rows


def limit_of(model: JointModel, name: str) -> float | None:
    """Largest error of a parameter of a reference joint [%], None where none is set."""
    declared = {
        n: p.name for t in model.terms for p, n in zip(t.effect.parameters, t.names, strict=True)
    }
    return _LIMITS.get(declared.get(name, name))


def convergence(
    joints: Sequence[Joint],
    setting: Setting | None = None,
    *,
    cc: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """The table of convergence: each joint as a plant, its estimator started without values.

    Returns
    -------
    list of Row
        One per joint and parameter.
    """
    rows: list[Row] = []
    for i, joint in enumerate(joints):
        model = start_of(joint)
        with tempfile.TemporaryDirectory(prefix="irj-cosim-") as folder:
            rows += cosimulate(
                joint, model, make_pair(joint, model, Path(folder), cc=cc), setting
            ).rows
        if progress is not None:
            progress(i + 1, len(joints))
    return rows


def table(rows: Sequence[Row]) -> str:
    """The rows as text."""
    lines = [
        f"{'joint':12s} {'parameter':40s} {'unit':12s} {'plant':>12s} {'estimate':>12s} "
        f"{'error %':>9s} {'limit %':>8s}"
    ]
    for r in rows:
        limit = f"{r.limit:8.0f}" if r.limit is not None else "       -"
        mark = "" if r.passed else "  over"
        lines.append(
            f"{r.joint:12s} {r.name:40s} {r.unit:12s} {r.plant:12.6g} {r.estimate:12.6g} "
            f"{r.error:9.3f} {limit}{mark}"
        )
    return "\n".join(lines)


def parser() -> OneLineParser:
    """Arguments of ``irj cosim``."""
    made = OneLineParser(
        prog="irj cosim", description="Co-simulate plants and estimators and compare."
    )
    made.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help=f"reference joints: {', '.join(NAMES)} (default: all)",
    )
    made.add_argument(
        "--joint", action="append", default=[], type=Path, help="a fitted joint file as a plant"
    )
    made.add_argument(
        "--published",
        nargs=2,
        action="append",
        default=[],
        metavar=("FILE", "KEY"),
        help="a row of a table of published friction parameters",
    )
    made.add_argument("--stop", type=float, default=40.0, help="length in s (default: 40)")
    made.add_argument("--cc", help="C compiler")
    made.add_argument("--json", type=Path, metavar="FILE", help="write the table as JSON")
    return made


def main(argv: Sequence[str]) -> int:
    """``irj cosim``: print the table of convergence; 0 where every limit holds, 1 where not, 2
    on unusable input.
    """
    arguments = parser().parse_args(argv)
    try:
        if arguments.json is not None:
            check_output(
                arguments.json, [*arguments.joint, *(file for file, _ in arguments.published)]
            )
        setting = _setting(arguments.stop)
        joints = [load_joint(p) for p in arguments.joint] + [
            published_joint(Path(f), k) for f, k in arguments.published
        ]
        names = arguments.names or (() if joints else NAMES)
        joints = [*(reference_joint(n) for n in names), *joints]
        for joint in joints:
            if not joint.fitted:
                raise InputError(
                    f"{joint.source}: has no fitted values; a plant needs them (run `irj fit` "
                    "first)"
                )
        find_compiler(None, arguments.cc)
        progress_bar(f"0 of {counted(len(joints), 'joint')}", 0.0)
        rows = convergence(
            joints,
            setting,
            cc=arguments.cc,
            progress=lambda done, total: progress_bar(
                f"{done} of {counted(total, 'joint')}", done / total
            ),
        )
        sys.stdout.write(table(rows) + "\n")
        content: list[dict[str, Any]] = [
            {**r.__dict__, "error_percent": r.error, "passed": r.passed} for r in rows
        ]
        write_json(arguments.json, {"rows": content})
    except (InputError, FmuError) as error:
        return fail(str(error))
    return 0 if all(r.passed for r in rows) else 1


def _setting(stop: float) -> Setting:
    """A run of this length."""
    setting, first = Setting(stop=stop), OnlineOptions().warm_up
    if not (math.isfinite(stop) and first < stop <= 1e5):
        raise InputError(
            f"--stop {stop:g}: the estimator's first window takes {first:g} s; give a longer "
            "time in s, as 40"
        )
    if abs(round(stop / setting.step) * setting.step - stop) > 1e-6 * setting.step:
        raise InputError(
            f"--stop {stop!r}: is not a whole number of steps of {setting.step:g} s; give as many"
        )
    return setting


__all__ = [
    "Cosimulation",
    "Row",
    "Setting",
    "convergence",
    "cosimulate",
    "main",
    "make_pair",
    "table",
]
