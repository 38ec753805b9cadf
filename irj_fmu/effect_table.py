"""Does the estimator find every effect of the library? ``python -m irj_fmu.effect_table``.

For each effect and each place of it: a plant FMU of a harmonic-drive joint with that effect at
typical size follows its motion for 40 s; the estimator, which knows the shapes of the laws and
nothing that it estimates, gets the readings. Once as the Python estimator runs it, and once as the
native FMU.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, final

import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS, load_library
from identification.data.joint_file import Joint
from identification.data.typical import true_values
from identification.errors import InputError
from identification.online.estimator import (
    OnlineEstimator,
    OnlineOptions,
    estimated_parameters,
    prepared,
)
from identification.online.identifiable import identifiable
from irj_fmu.command_line import OneLineParser, check_output, fail, run_alone, write_json
from irj_fmu.convergence import NOISE, STEP, STOP
from irj_fmu.cosim import CHANNELS, link_referred, start_state
from irj_fmu.estimator.native import NativeSpec, build_native
from irj_fmu.host.run import Fmu, Instance
from irj_fmu.plant.joint import PlantOptions, plant_spec
from irj_fmu.plant.library import build_plant
from irj_fmu.plant.reference import Motion, reference_joint, start_of

FloatArray = npt.NDArray[np.float64]
Side = Literal["python", "native"]

LIMIT: Final = 5.0
"""Largest error of a parameter [%] ..."""
SIGMAS: Final = 2.0
"""... or so many of the estimator's own standard deviations, whichever is more."""
HONEST: Final = 3.0
"""An error over so many of its own standard deviations counts against the estimator's honesty."""
_PLAIN: Final = OnlineOptions(optimise=False)


@final
@dataclass(frozen=True)
class EffectRow:
    """One parameter of one plant.

    Attributes
    ----------
    effect, side, name, unit : str
    seed : int or None
        Of the sensor noise; None: no noise.
    plant, estimate, sigma : float
        `estimate` without the part of the error that the motion does not show.
    size : float
        What an error is a share of: the plant's value, or the prior range where that is 0.
    combined : bool
        True where the motion shows the parameter in combinations only.
    """

    effect: str
    side: Side
    seed: int | None
    name: str
    unit: str
    plant: float
    estimate: float
    sigma: float
    size: float
    combined: bool

    @property
    def error(self) -> float:
        """Relative error [%]."""
        return 100.0 * abs(self.estimate - self.plant) / self.size

    @property
    def sigmas(self) -> float:
        """Error over the standard deviation."""
        return abs(self.estimate - self.plant) / self.sigma if self.sigma > 0 else float("inf")

    @property
    def passed(self) -> bool:
        """True within the limit or the standard deviation."""
        return self.error <= LIMIT or self.sigmas <= SIGMAS

    @property
    def honest(self) -> bool:
        """True where the standard deviation is not far too small."""
        return self.sigmas <= HONEST


def labels() -> tuple[str, ...]:
    """Every effect of the library at every place, in the order of the library."""
    load_library()
    return tuple(f"{key}@{place}" for key in EFFECTS for place in EFFECTS[key].acts_on)


def joint_with(label: str) -> Joint:
    """A harmonic-drive joint with viscous and Coulomb friction and gravity, and this effect at
    typical size.
    """
    base = reference_joint("hd3")
    common = tuple(e for e in base.effects if EFFECTS[e.partition("@")[0]].common)
    base = replace(base, effects=common)
    base = replace(
        base, fitted={n: v for n, v in base.fitted.items() if n in base.model().parameter_names}
    )
    try:
        model = base.model().add(label)
    except (KeyError, ValueError):
        model = base.model()  # it has the effect already
    grown = replace(base, name=label, effects=model.effects)
    values = true_values(grown.model(), replace(grown, fitted={}))
    return replace(grown, fitted={**values, **base.fitted})


def readings_of(joint: Joint, motion: Motion | None = None, stop: float = STOP) -> FloatArray:
    """Drive, positions, velocities and torque that the plant FMU reads in closed loop,
    link-referred, without noise, (samples, 6).
    """
    motion = motion or Motion()
    count = round(stop / STEP) + 1
    table = np.empty((count, 6))
    drive = "motor_current" if joint.torque_per_current is not None else "motor_torque"
    with tempfile.TemporaryDirectory(prefix="irj-effects-") as folder:
        spec = plant_spec(
            joint, PlantOptions(controller=True, motion=motion, sensors=True, name="plant")
        )
        path = build_plant(spec, Path(folder) / "plant.fmu")
        with Fmu(path) as fmu, Instance(fmu, name="plant") as instance:
            instance.begin(
                0.0, {k.removeprefix("plant."): v for k, v in start_state(joint, motion).items()}
            )
            instance.ready()
            references = [fmu.variables[c].valueReference for c in (drive, *CHANNELS.values())]
            for k in range(count):
                table[k] = instance.call("getReal", references)
                instance.call("doStep", k * STEP, STEP)
    return table * link_referred(joint)


def by_python(joint: Joint, readings: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Values and standard deviations at the end, by the estimator that the Python FMU runs."""
    estimator = OnlineEstimator(joint, STEP, _PLAIN)
    every = [True] * 6
    for k, row in enumerate(readings.tolist()):
        estimator.update(k * STEP, row, every)
    return estimator.theta, estimator.sigma


def by_native(joint: Joint, readings: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same by the native FMU."""
    count = len(estimated_parameters(joint))
    table = readings / link_referred(joint)
    with tempfile.TemporaryDirectory(prefix="irj-effects-") as folder:
        path = build_native(NativeSpec(joint, "native", _PLAIN), Path(folder) / "native.fmu")
        with Fmu(path) as fmu, Instance(fmu, name="native") as instance:
            instance.begin(0.0)
            instance.ready()
            drive = "i_m" if joint.torque_per_current is not None else "tau_m"
            write = instance.blocks([drive, *CHANNELS])[0]
            for k, row in enumerate(table.tolist()):
                write.values[:] = row
                instance.write(write)
                instance.step(k * STEP, STEP)
            found = []
            for name in ("theta", "sigma"):
                block = instance.blocks([f"{name}[{i}]" for i in range(1, count + 1)])[0]
                found.append(np.array(instance.read(block)))
    return found[0], found[1]


def run(label: str, seeds: Sequence[int | None], sides: Sequence[Side]) -> Iterator[EffectRow]:
    """Rows of an effect: each seed of the noise, each estimator."""
    joint = joint_with(label)
    clean = readings_of(joint)
    known = start_of(joint)
    names = estimated_parameters(known)
    model = joint.model()
    true = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    units = {p.name: p.unit for p in prepared(known, _PLAIN)[0].parameters}
    plant = np.array([true.get(n, 0.0) for n in names])  # no skew of a clock
    for seed in seeds:
        noise = np.abs(np.array(NOISE) * link_referred(joint)) * (seed is not None)
        readings = (
            clean
            if seed is None
            else clean + np.random.default_rng(seed).normal(size=clean.shape) * noise
        )
        shown = identifiable(joint, clean, noise, STEP, names)
        for side in sides:
            theta, sigma = (by_python if side == "python" else by_native)(known, readings)
            seen = plant + shown.seen(theta - plant)
            for i, name in enumerate(names):
                yield EffectRow(
                    label,
                    side,
                    seed=seed,
                    name=name,
                    unit=units[name],
                    plant=plant[i],
                    estimate=float(seen[i]),
                    sigma=float(sigma[i]),
                    size=float(abs(plant[i]) or shown.scale[i]),
                    combined=not shown.alone(i),
                )


HEAD: Final = (
    "| effect | noise | estimator | farthest parameter | error % | sigmas | not determined alone "
    "| |\n"
    "|---|---|---|---|---|---|---|---|\n"
)


def line(rows: Sequence[EffectRow]) -> str:
    """The rows of one run as a line of a Markdown table: the parameter that is farthest beyond
    its limit.
    """
    far = max(rows, key=lambda r: min(r.error / LIMIT, r.sigmas / SIGMAS))
    alone = ", ".join(r.name for r in rows if r.combined) or "-"
    mark = "" if all(r.passed for r in rows) else "over"
    noise = "-" if far.seed is None else f"seed {far.seed}"
    return (
        f"| {far.effect} | {noise} | {far.side} | {far.name} | {far.error:.2f} | "
        f"{far.sigmas:.1f} | {alone} | {mark} |\n"
    )


def main(argv: Sequence[str]) -> int:
    """Print the table; 0 where every parameter is found, 1 where not, 2 on unusable input."""
    parser = OneLineParser(
        prog="python -m irj_fmu.effect_table",
        description="Estimators against plants with every effect of the library.",
    )
    parser.add_argument(
        "labels",
        nargs="*",
        metavar="EFFECT@PLACE",
        help="effects (default: every effect at every place)",
    )
    parser.add_argument(
        "--seeds", nargs="*", type=int, default=[1], help="seeds of the sensor noise (default: 1)"
    )
    parser.add_argument("--native", action="store_true", help="the native FMU, too")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write every parameter of every run as JSON"
    )
    arguments = parser.parse_args(argv)
    try:
        if arguments.json is not None:
            check_output(arguments.json, [])
        known = labels()
        for label in arguments.labels:
            if label not in known:
                raise InputError(f"{label}: no such effect and place; give one as {known[0]}")
        sides: tuple[Side, ...] = ("python", "native") if arguments.native else ("python",)
        every: list[EffectRow] = []
        runs: list[bool] = []
        sys.stdout.write(HEAD)
        for label in arguments.labels or known:
            found = list(run(label, (None, *arguments.seeds), sides))
            every += found
            for key in dict.fromkeys((r.seed, r.side) for r in found):
                part = [r for r in found if (r.seed, r.side) == key]
                runs.append(all(r.passed for r in part))
                sys.stdout.write(line(part))
                sys.stdout.flush()
        honest = sum(r.honest or r.error <= 1e-2 for r in every)
        sys.stdout.write(
            f"\n{sum(runs)} of {len(runs)} runs with every parameter found; {honest} of "
            f"{len(every)} errors under three sigmas.\n"
        )
        if arguments.json is not None:
            content: list[dict[str, Any]] = [
                {**r.__dict__, "error_percent": r.error, "sigmas": r.sigmas, "passed": r.passed}
                for r in every
            ]
            write_json(arguments.json, {"rows": content})
    except InputError as error:
        return fail(str(error))
    return 0 if all(runs) else 1


if __name__ == "__main__":
    raise SystemExit(run_alone(main, sys.argv[1:]))
