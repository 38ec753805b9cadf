"""Does the estimator FMU find each reference plant's values, sensor failures included? ``python -m
irj_fmu.convergence``.

A plant FMU follows its motion in closed loop and its readings are recorded; the estimator FMU gets
them sample by sample, with a failure put into them. The readings do not depend on the estimator, so
this equals the co-simulation.

``start``    nothing is known of what the estimator estimates; a failure lasts from 22 s to 27 s
``fitted``   the joint file of an elastic joint holds fitted values, the fault detector runs; a
failure lasts from 25 s
             to the end
"""

from __future__ import annotations

import ctypes
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.data.joint_file import Joint
from identification.errors import InputError
from identification.faults.detector import KINDS, SENSORS, Fault, inject
from identification.online.estimator import estimated_parameters, searched_parameters
from identification.online.identifiable import identifiable
from irj_fmu.command_line import OneLineParser, check_output, fail, run_alone, write_json
from irj_fmu.cosim import (
    CHANNELS,
    LOOSE,
    Row,
    _rows,
    limit_of,
    link_referred,
    make_pair,
    start_state,
)
from irj_fmu.host.run import Fmu, Instance, Trajectory
from irj_fmu.plant.reference import (
    NAMES,
    Motion,
    published_joint,
    reference_joint,
    selected_motion,
    start_of,
)

FloatArray = npt.NDArray[np.float64]

STEP: Final = 1e-3
STOP: Final = 40.0
NOISE: Final = (0.01, 3e-4, 0.1, 2e-6, 1e-3, 0.05)
"""Sensor noise: current [A], motor position, velocity (motor shaft), link position, velocity
[rad, rad/s], torque [N.m].
"""
SIZES: Final[Mapping[str, tuple[float, ...]]] = {
    "noise": (20.0, 0.1, 0.1, 0.1, 0.1, 20.0),
    "bias": (15.0, 0.01, 0.1, 0.01, 0.1, 15.0),
    "drift": (5.0, 0.005, 0.05, 0.005, 0.05, 5.0),
    "spike": (100.0, 0.05, 1.0, 0.05, 1.0, 100.0),
    "gain": (-0.3,) * 6,
    "delay": (0.02,) * 6,
}
"""Size of each kind of failure, by sensor, link-referred: current as its drive torque [N.m],
rad, rad/s, N.m.
"""


@final
@dataclass(frozen=True)
class Run:
    """One plant with one failure.

    Attributes
    ----------
    joint, start, sensor, kind : str
        Empty sensor and kind: no failure.
    rows : tuple of Row
        Parameters at the end.
    faults : tuple of int
        Fault codes that the estimator gave.
    searches : int
        Searches for the nonlinear parameters.
    """

    joint: str
    start: str
    sensor: str
    kind: str
    rows: tuple[Row, ...]
    faults: tuple[int, ...]
    searches: int

    def worst(self, *, loose: bool) -> float:
        """Largest error of the parameters with the tight or the loose limit [%]; NaN without
        one.
        """
        found = [
            abs(r.error) for r in self.rows if r.limit is not None and (r.limit == LOOSE) == loose
        ]
        return max(found, default=float("nan"))

    @property
    def passed(self) -> bool:
        """True where every limit holds."""
        return all(r.passed for r in self.rows)


def forgotten(joint: Joint) -> Joint:
    """The joint before any fit: no value of what the estimator estimates or searches."""
    start = start_of(joint)
    lost = set(searched_parameters(joint))
    return replace(start, fitted={k: v for k, v in start.fitted.items() if k not in lost})


def failure(kind: str, sensor: str, start: str, scale: float) -> Fault:
    """The failure of a kind; `scale` fits torques to the size of the joint."""
    size = SIZES[kind][SENSORS.index(sensor)] if kind in SIZES else 0.0
    size *= scale if sensor in ("current", "torque") and kind not in ("gain", "delay") else 1.0
    first, last = (25.0, float("inf")) if start == "fitted" else (22.0, 27.0)
    return Fault(sensor, kind, first, size, last)  # type: ignore[arg-type]


@final
class Bench:
    """A plant's readings and its estimator FMU."""

    def __init__(self, joint: Joint, start: str, folder: Path, *, cc: str | None = None) -> None:
        self.joint, self.start, motion = joint, start, selected_motion(joint)
        model = joint if start == "fitted" else forgotten(joint)
        plant, self.file = make_pair(joint, model, folder, cc=cc, motion=motion)
        self.drive = "motor_current" if joint.torque_per_current is not None else "motor_torque"
        self.table = self._record(plant, motion)
        self.shapes = searched_parameters(model)
        self.shown = identifiable(
            joint,
            self.table * link_referred(joint),
            np.array(NOISE) * np.abs(link_referred(joint)),
            STEP,
            estimated_parameters(model),
        )
        self.scale = float(np.quantile(np.abs(self.table[:, 5]), 0.99)) / 170.0

    def _record(self, plant: Path, motion: Motion) -> FloatArray:
        count = round(STOP / STEP) + 1
        table = np.empty((count, 6))
        channels = [self.drive, *CHANNELS.values()]
        with Fmu(plant) as fmu, Instance(fmu, name="plant") as instance:
            instance.begin(
                0.0,
                {k.removeprefix("plant."): v for k, v in start_state(self.joint, motion).items()},
            )
            instance.ready()
            references = [fmu.variables[c].valueReference for c in channels]
            for k in range(count):
                table[k] = instance.call("getReal", references)
                instance.call("doStep", k * STEP, STEP)
        noise = np.random.default_rng(0).normal(size=table.shape) * NOISE
        if abs(self.joint.gear_ratio) < 2:
            noise[:, :3] /= 160.0
        return table + noise

    def run(self, fault: Fault | None) -> Run:
        """Feed the estimator; see :class:`Run`."""
        joint = self.joint
        gains = link_referred(joint)
        table = self.table if fault is None else inject(self.table * gains, STEP, [fault]) / gains
        signals: dict[str, FloatArray] = {}
        codes: set[int] = set()
        with Fmu(self.file) as fmu, Instance(fmu, name="estimator") as instance:
            instance.begin(0.0)
            instance.ready()
            at = {n: v.valueReference for n, v in fmu.variables.items()}
            raw, write = (
                instance.raw,
                instance.blocks(["i_m" if self.drive == "motor_current" else "tau_m", *CHANNELS])[
                    0
                ],
            )
            step = ctypes.c_double(STEP)
            for k, row in enumerate(table.tolist()):
                write.values[:] = row
                raw.fmi2SetReal(raw.component, write.references, 6, write.values)
                raw.fmi2DoStep(raw.component, k * STEP, step, 1)
                if k % 50 == 0:
                    codes.add(int(instance.call("getInteger", [at["fault"]])[0]))
            for name in fmu.variables:
                if name.startswith(("theta[", "sigma[", "eta[", "sigma_eta[")):
                    signals[f"estimator.{name}"] = np.array(instance.call("getReal", [at[name]]))
            searches = int(instance.call("getInteger", [at["n_searches"]])[0])
        rows = [
            *_rows(joint, self.shown, Trajectory(np.array([STOP]), signals)),
            *self._shape_rows(signals),
        ]
        sensor, kind = (fault.sensor, fault.kind) if fault is not None else ("", "")
        return Run(
            joint.name,
            self.start,
            sensor=sensor,
            kind=kind,
            rows=tuple(rows),
            faults=tuple(sorted(codes - {0})),
            searches=searches,
        )

    def _shape_rows(self, signals: Mapping[str, FloatArray]) -> list[Row]:
        model = self.joint.model()
        true = dict(zip(model.parameter_names, model.value_vector(), strict=True))
        unit = {p.name: p.unit for p in model.parameters}
        found = []
        for i, name in enumerate(self.shapes, 1):
            limit = limit_of(model, name)
            value, spread = (
                float(signals[f"estimator.{s}[{i}]"][-1]) for s in ("eta", "sigma_eta")
            )
            found.append(
                Row(
                    self.joint.name,
                    name,
                    unit=unit[name],
                    plant=true[name],
                    estimate=value,
                    sigma=spread,
                    limit=limit,
                )
            )
        return found


def campaign(
    joints: Sequence[Joint],
    start: str,
    *,
    every: bool = False,
    only: Sequence[str] | None = None,
    cc: str | None = None,
) -> Iterator[Run]:
    """Each joint without a failure and with every kind of it, the sensors in turn.

    Parameters
    ----------
    joints : sequence of Joint
        Plants.
    start : {"start", "fitted"}
    every : bool
        Every sensor with every kind.
    only : sequence of str, optional
        Kinds; all by default.
    cc : str, optional
        C compiler.
    """
    for joint in joints:
        if start == "fitted" and not joint.model().is_elastic:
            continue  # no fault detector
        i = NAMES.index(joint.name) if joint.name in NAMES else sum(map(ord, joint.name))
        with tempfile.TemporaryDirectory(prefix="irj-convergence-") as folder:
            bench = Bench(joint, start, Path(folder), cc=cc)
            yield bench.run(None)
            for k, kind in enumerate(KINDS):
                if only is not None and kind not in only:
                    continue
                for sensor in SENSORS if every else (SENSORS[(i + k) % len(SENSORS)],):
                    yield bench.run(failure(kind, sensor, start, bench.scale))


HEAD: Final = (
    "| plant | start | failed sensor | failure | largest error, limit 2 % | largest error, limit "
    "10 % | fault codes | searches | |\n"
    "|---|---|---|---|---|---|---|---|---|\n"
)


def line(run: Run) -> str:
    """A run as a line of a Markdown table."""
    tight, loose = (
        f"{v:.2f}" if v == v else "-" for v in (run.worst(loose=False), run.worst(loose=True))
    )
    codes = ", ".join(map(str, run.faults)) or "-"
    mark = "" if run.passed else "over"
    return (
        f"| {run.joint} | {run.start} | {run.sensor or '-'} | {run.kind or '-'} | {tight} | "
        f"{loose} | {codes} | {run.searches} | {mark} |\n"
    )


def main(argv: Sequence[str]) -> int:
    """Print the table; 0 where every limit holds, 1 where not, 2 on unusable input."""
    parser = OneLineParser(
        prog="python -m irj_fmu.convergence",
        description="Estimator FMU against reference plants, with sensor failures.",
    )
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help=f"reference joints: {', '.join(NAMES)} (default: all)",
    )
    parser.add_argument(
        "--published",
        nargs="+",
        default=[],
        metavar=("FILE", "KEY"),
        help="rows of a table of published friction parameters",
    )
    parser.add_argument(
        "--start",
        choices=("start", "fitted", "both"),
        default="both",
        help="what the estimator knows",
    )
    parser.add_argument("--kinds", nargs="*", choices=KINDS, help="kinds of failure (default: all)")
    parser.add_argument("--every", action="store_true", help="every sensor with every kind")
    parser.add_argument("--cc", help="C compiler")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write every parameter of every run as JSON"
    )
    arguments = parser.parse_args(argv)
    try:
        if arguments.json is not None:
            check_output(arguments.json, arguments.published[:1])
        if len(arguments.published) == 1:
            raise InputError(
                f"{arguments.published[0]}: --published wants rows of the table, too, such as "
                "erob80_50/m1"
            )
        joints = [published_joint(Path(arguments.published[0]), k) for k in arguments.published[1:]]
        names = arguments.names or (() if joints else NAMES)
        joints = [*(reference_joint(n) for n in names), *joints]
        starts = ("start", "fitted") if arguments.start == "both" else (arguments.start,)
        runs: list[Run] = []
        sys.stdout.write(HEAD)
        for start in starts:
            for run in campaign(
                joints, start, every=arguments.every, only=arguments.kinds, cc=arguments.cc
            ):
                runs.append(run)
                sys.stdout.write(line(run))
                sys.stdout.flush()
        sys.stdout.write(
            f"\n{sum(r.passed for r in runs)} of {len(runs)} runs within all limits.\n"
        )
        if arguments.json is not None:
            write_json(arguments.json, {"runs": [_plain(r) for r in runs]})
    except InputError as error:
        return fail(str(error))
    return 0 if all(r.passed for r in runs) else 1


def _plain(run: Run) -> dict[str, Any]:
    rows = [{**row.__dict__, "error_percent": row.error, "passed": row.passed} for row in run.rows]
    return {**run.__dict__, "rows": rows}


if __name__ == "__main__":
    raise SystemExit(run_alone(main, sys.argv[1:]))
