"""Failures of all readings at once, or of the current: ``python -m benchmarks.faults.common_mode
[JOINT...] [--json FILE]``.

Twelve failures from 11 s to 13.5 s of a run of 19 s, on five reference joints of which nothing is
known, in the Python estimator and in the native FMU. A run passes where every parameter stays
within 3 % of its value before (or two of its standard deviations) during the failure and at the
end, ``health`` is 2 at some time during it and 0 at the end, and none leaves its bounds. Where a
failure is over within the row that it hits (a gap of 50 ms), ``health`` need not be told.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, final

import numpy as np
import numpy.typing as npt

from benchmarks.native import JOINTS, STEP, readings_of
from identification.data.joint_file import toml_text
from identification.online.estimator import OnlineEstimator, OnlineOptions
from irj_fmu.cosim import CHANNELS, link_referred
from irj_fmu.estimator.native import NativeSpec, build_native, native_variables
from irj_fmu.estimator.packed import options_text
from irj_fmu.estimator.slave import JOINT_FILE, OPTIONS_FILE, Estimator
from irj_fmu.host.run import Fmu, Instance
from irj_fmu.plant.reference import reference_joint, start_of

FloatArray = npt.NDArray[np.float64]
Change = Callable[[FloatArray], None]

FIRST, LAST, COUNT = 11_000, 13_500, 19_000
SETTLED: Final = 500
"""Samples at the end in which the failure must be forgotten."""
ROOM, SIGMAS = 0.03, 2.0
"""Change of a parameter that counts as none: share of its value, or standard deviations."""
GAP: Final = 50
EVERY: Final = 16
"""Samples between two looks at the estimate: one row."""
OPTIONS: Final = OnlineOptions(optimise=False, warm_up=5.0)
_DRIVE, _POSITIONS, _TORQUES = 0, [1, 3], [0, 5]


def frozen(t: FloatArray) -> None:
    """The bus repeats its last frame."""
    t[FIRST:LAST] = t[FIRST]


def all_zero(t: FloatArray) -> None:
    """Every reading is zero."""
    t[FIRST:LAST] = 0.0


def lost(t: FloatArray) -> None:
    """Every reading is no number."""
    t[FIRST:LAST] = np.nan


def halved(t: FloatArray) -> None:
    """Every frame comes twice."""
    t[FIRST + 1 : LAST : 2] = t[FIRST : LAST - 1 : 2]


def gap(t: FloatArray) -> None:
    """50 ms of the motion are missing, and no time stamp says so."""
    t[FIRST:COUNT] = t[FIRST + GAP : COUNT + GAP].copy()


def positions(t: FloatArray) -> None:
    """Both encoders stick."""
    t[FIRST:LAST, _POSITIONS] = t[FIRST, _POSITIONS]


def no_positions(t: FloatArray) -> None:
    """Both encoders read zero."""
    t[FIRST:LAST, _POSITIONS] = 0.0


def torques(t: FloatArray) -> None:
    """Current and torque sensor stick."""
    t[FIRST:LAST, _TORQUES] = t[FIRST, _TORQUES]


def stuck(t: FloatArray) -> None:
    """The current sticks."""
    t[FIRST:LAST, _DRIVE] = t[FIRST, _DRIVE]


def no_current(t: FloatArray) -> None:
    """The current reads zero."""
    t[FIRST:LAST, _DRIVE] = 0.0


def scaled(t: FloatArray) -> None:
    """The current reads 1.3 times its value."""
    t[FIRST:LAST, _DRIVE] *= 1.3


def biased(t: FloatArray) -> None:
    """The current is off by 15 N.m of drive torque."""
    t[FIRST:LAST, _DRIVE] += 15.0


FAILURES: Final[tuple[Change, ...]] = (
    frozen,
    all_zero,
    lost,
    halved,
    gap,
    positions,
    no_positions,
    torques,
    stuck,
    no_current,
    scaled,
    biased,
)


@final
@dataclass(frozen=True)
class Outcome:
    """One failure on one joint in one estimator.

    Attributes
    ----------
    joint, failure, side : str
    during, after : float
        Largest change of a parameter during the failure and at the end, as a share of the room it
        has (1: at the limit).
    parameter : str
        Which one that is.
    told : float or None
        Time from the first wrong sample until ``health`` is not 0 [ms]; None where it never is.
    back : bool
        ``health`` is 0 at the end.
    inside : bool
        No parameter left its bounds.
    """

    joint: str
    failure: str
    side: str
    during: float
    after: float
    parameter: str
    told: float | None
    back: bool
    inside: bool

    @property
    def passed(self) -> bool:
        """True where the estimate was held and health said so."""
        told = self.told is not None or self.failure == gap.__name__
        return max(self.during, self.after) <= 1.0 and told and self.back and self.inside


def by_python(
    spec: NativeSpec, table: FloatArray, names: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Named outputs at every look, and health at every sample, of the Python estimator."""
    with tempfile.TemporaryDirectory(prefix="irj-common-") as folder:
        values = {k: {"value": v, "unit": "", "side": ""} for k, v in spec.joint.fitted.items()}
        at = Path(folder)
        (at / JOINT_FILE).write_text(toml_text(spec.joint, values), encoding="utf-8")
        (at / OPTIONS_FILE).write_text(options_text(spec.options), encoding="utf-8")
        slave = Estimator(instance_name="python", resources=folder)
        slave.log = lambda *_: None
        slave.setup_experiment(0.0)
        slave.exit_initialization_mode()
    reference = {v.name: i for i, v in enumerate(native_variables(spec))}  # of both FMUs
    inputs = [reference[n] for n in _inputs(spec)]
    outputs, health = [reference[n] for n in names], reference["health"]
    found, told = [], []
    for k, row in enumerate(table.tolist()):
        slave.set_real(inputs, row)
        slave.do_step(k * STEP, STEP)
        told.append(slave.get_integer([health])[0])
        if k % EVERY == 0:
            found.append(slave.get_real(outputs))
    return np.array(found), np.array(told)


def by_native(
    path: Path, spec: NativeSpec, table: FloatArray, names: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """The same of the native FMU."""
    found, told = [], []
    with Fmu(path) as fmu, Instance(fmu, name="native") as instance:
        reference = {n: v.valueReference for n, v in fmu.variables.items()}
        instance.begin(0.0)
        instance.ready()
        inputs = [reference[n] for n in _inputs(spec)]
        outputs, health = [reference[n] for n in names], [reference["health"]]
        for k, row in enumerate(table.tolist()):
            instance.call("setReal", inputs, row)
            instance.call("doStep", k * STEP, STEP)
            told.append(instance.call("getInteger", health)[0])
            if k % EVERY == 0:
                found.append(instance.call("getReal", outputs))
    return np.array(found), np.array(told)


def _inputs(spec: NativeSpec) -> list[str]:
    return ["i_m" if spec.joint.torque_per_current is not None else "tau_m", *CHANNELS]


def run(key: str) -> Iterator[Outcome]:
    """Every failure on one joint, in both estimators."""
    joint = start_of(reference_joint(key))
    spec = NativeSpec(joint, "native", OPTIONS)
    whole = OnlineEstimator(joint, STEP, OPTIONS)
    count = len(whole.names)
    names = [f"{n}[{i}]" for n in ("theta", "sigma") for i in range(1, count + 1)]
    clean = readings_of(key, (COUNT + GAP) * STEP) * link_referred(joint)
    with tempfile.TemporaryDirectory(prefix="irj-common-") as folder:
        path = build_native(spec, Path(folder) / "native.fmu")
        for change in FAILURES:
            table = clean.copy()
            change(table)
            table = table[:COUNT] / link_referred(joint)
            for side in ("python", "native"):
                found, health = (
                    by_python(spec, table, names)
                    if side == "python"
                    else by_native(path, spec, table, names)
                )
                yield _outcome(key, change.__name__, side, whole, found, health)


def _outcome(
    key: str,
    failure: str,
    side: str,
    whole: OnlineEstimator,
    found: FloatArray,
    health: FloatArray,
) -> Outcome:
    count = len(whole.names)
    theta, sigma = found[:, :count], found[:, count:]
    first, last, end = FIRST // EVERY, LAST // EVERY, -SETTLED // EVERY
    before = theta[first - 1]
    room = np.maximum(ROOM * np.abs(before), SIGMAS * sigma[first - 1])
    share = np.abs(theta - before) / room
    during, after = share[first:last].max(axis=0), share[end:].max(axis=0)
    told = np.flatnonzero(health[FIRST:LAST])
    low, high = whole.low - 1e-12, whole.high + 1e-12
    return Outcome(
        key,
        failure,
        side,
        during=float(during.max()),
        after=float(after.max()),
        parameter=whole.names[int(np.argmax(np.maximum(during, after)))],
        told=float(told[0]) if len(told) else None,
        back=not health[-SETTLED:].any(),
        inside=bool(np.all((theta[first:] >= low) & (theta[first:] <= high))),
    )


def main(argv: Sequence[str]) -> int:
    """Print the table; 0 where every run passes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("joints", nargs="*", default=list(JOINTS), metavar="JOINT")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args(argv)
    every: list[Outcome] = []
    print("| joint | failure | estimator | during | after | parameter | told after ms | |")
    print("|---|---|---|---|---|---|---|---|")
    for key in arguments.joints:
        for o in run(key):
            every.append(o)
            told = "-" if o.told is None else f"{o.told:.0f}"
            words = [w for w, yes in (("not back", not o.back), ("bounds", not o.inside)) if yes]
            mark = ", ".join(["over", *words]) if not o.passed else ""
            print(
                f"| {key} | {o.failure} | {o.side} | {o.during:.2f} | {o.after:.2f} | "
                f"{o.parameter} | {told} | {mark} |",
                flush=True,
            )
    print(f"\n{sum(o.passed for o in every)} of {len(every)} runs held and told.")
    if arguments.json is not None:
        text = json.dumps([{**asdict(o), "passed": o.passed} for o in every], indent=1)
        arguments.json.write_text(text + "\n", encoding="utf-8")
    return 0 if all(o.passed for o in every) else 1


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
