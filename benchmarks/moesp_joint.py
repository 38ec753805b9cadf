"""MOESP on simulated joints: variance accounted for on trajectories that had no part in the
identification.

    python benchmarks/moesp_joint.py            every joint
    python benchmarks/moesp_joint.py table_4_3  one joint

Closed-loop simulations with the thesis's parameters and the sensor noise of table B.1. Inputs are
motor position, velocity and acceleration (thesis 4.1.1), all link-referred. Outputs are link
velocity and the relative position of motor and link, weighted to like size: as outputs, positions
alone hide the torsion, which is a thousandth of them. The order is chosen without the unseen
trajectories.

The acceleration is a reading of its own ("sensor"), the filtered derivative of the velocity
("derived"), or left out ("none"). A derived one leaves the Hankel matrix of the inputs without full
rank: the models are as good, but the third digit of their relative position moves with the order of
the records.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from casadi_models import JointModel
from casadi_models.thesis import catalogue_stiffness, model_2b, model_ts
from identification.data.prepare import butterworth, central_difference
from identification.faults.detector import NOISE, SENSORS
from identification.linear.subspace import MoespOptions, Subspace, UnstableModelWarning, moesp
from identification.planning.follow import Follower
from identification.planning.trajectories import Motion, sinusoidal, triangular

FloatArray = npt.NDArray[np.float64]

DT = 1e-3
BLOCK_ROWS = 20
HIGHEST = 8
WEIGHTS = (0.1, 100.0)
"""Factors on link velocity [rad/s] and relative position [rad]."""
START = 1.0
"""Part of an unseen record that its initial state is estimated from [s]; it does not count in
the VAF.
"""
LIMITS = {"position": 99.99, "velocity": 99.4, "relative position": 96.0}
"""What must be reached on unseen trajectories [%]."""
SPEEDS = {"seen": (15.0, 20.0, 27.0, 33.0, 39.0, 45.0), "unseen": (18.0, 30.0, 42.0)}
PERIODS = {"seen": (0.8, 1.5, 2.5, 3.5, 4.5, 6.0), "unseen": (1.1, 3.0, 5.0)}
ACCELEROMETER = 9.6e-3
"""Noise of the acceleration reading [rad/s2], link-referred: table B.1, at 1 m from the axis."""
Method = Literal["ordinary", "past_output"]
Acceleration = Literal["sensor", "derived", "none"]


@dataclass(frozen=True)
class Run:
    """Noisy readings along one trajectory: inputs (n, 2 or 3), link position and velocity (n,
    2).
    """

    inputs: FloatArray
    link: FloatArray

    @property
    def outputs(self) -> FloatArray:
        """Link velocity and relative position, (n, 2)."""
        return np.column_stack([self.link[:, 1], self.inputs[:, 0] - self.link[:, 0]])


def joints() -> dict[str, Callable[[], JointModel]]:
    """Joints of the ladder hd3, hd4 with parameters of the thesis; damping and kinematic error
    are assumed.
    """

    def damped(model: JointModel) -> JointModel:
        added = model if model.has("structural_damping") else model.add("structural_damping")
        return added.with_values({"structural_damping": 30.0})

    def table_4_6() -> JointModel:
        return damped(model_ts()).with_values({"link_smoothing_velocity": 5e-3})

    def piecewise() -> JointModel:
        model = damped(catalogue_stiffness((14.0, 48.0)))
        for label in ("viscous@motor", "viscous@link", "coulomb@motor", "coulomb@link", "gravity"):
            model = model.add(label)
        names = ("motor_viscous", "link_viscous", "motor_coulomb", "link_coulomb", "gravity_torque")
        known = dict(model_2b().values)
        return model.with_values({n: known[n] for n in names})

    def kinematic() -> JointModel:
        model = damped(model_2b()).add("kinematic_error")
        return model.with_values({"kinematic_error_order": 2.0, "kinematic_error_sine": 1.0e-4})

    return {
        "table_4_3": lambda: damped(model_2b()),
        "table_4_6": table_4_6,
        "table_2_3": piecewise,
        "hd4": kinematic,
    }


def motions(kind: Literal["seen", "unseen"], seconds: float = 15.0) -> list[Motion]:
    """Triangular and sinusoidal trajectories of 3.8, in turn."""
    deg = np.pi / 180
    found: list[Motion] = []
    for speed, period in zip(SPEEDS[kind], PERIODS[kind], strict=True):
        found.append(triangular(speed * deg, reversal=0.1, duration=seconds, dt=DT))
        found.append(sinusoidal(speed * deg, period, duration=seconds, dt=DT))
    return found


def run(
    follower: Follower, motion: Motion, seed: int, acceleration: Acceleration = "sensor"
) -> Run:
    """The joint along a trajectory under its controller, as its sensors show it."""
    followed = follower.run(motion.table)
    noise = np.random.default_rng(seed).standard_normal((len(followed.time), 5))
    seen = followed.states + noise[:, :4] * [NOISE[s] for s in SENSORS[1:5]]
    columns = [seen[:, 0], seen[:, 1]]
    if acceleration == "sensor":
        columns.append(followed.accelerations[:, 0] + ACCELEROMETER * noise[:, 4])
    elif acceleration == "derived":
        columns.append(butterworth(central_difference(seen[:, 1], DT), DT))
    return Run(np.column_stack(columns), seen[:, 2:])


def identify(runs: Sequence[Run], method: Method, order: int | None = None) -> Subspace:
    """MOESP on several runs."""
    names = ("motor_position", "motor_velocity", "motor_acceleration")[: runs[0].inputs.shape[1]]
    options = MoespOptions(
        names, ("link_velocity", "relative_position"), WEIGHTS, max_order=HIGHEST
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnstableModelWarning)
        return moesp(
            [r.inputs for r in runs],
            [r.outputs for r in runs],
            BLOCK_ROWS,
            order,
            DT,
            method,
            options=options,
        )


def best_stable(runs: Sequence[Run], method: Method) -> Subspace:
    """The stable model whose order simulates the held-out quarter of the seen runs best."""
    first = identify(runs, method)
    stable = [c for c in first.candidates if np.isfinite(c.unexplained_percent)]
    for candidate in sorted(stable, key=lambda c: c.unexplained_percent):
        found = identify(runs, method, candidate.order)
        if found.spectral_radius < 1.0:
            return found
    return first


def initial_state(model: Subspace, inputs: FloatArray, outputs: FloatArray) -> FloatArray:
    """State at the first of some samples, by least squares on the free response."""
    forced = model.simulate(inputs)
    free = []
    row = np.asarray(model.system.C, dtype=np.float64)
    for _ in range(len(inputs)):
        free.append(row)
        row = row @ model.system.A
    weights = np.array(WEIGHTS)
    matrix = (np.array(free) * weights[:, None]).reshape(-1, model.order)
    return np.asarray(
        np.linalg.lstsq(matrix, ((outputs - forced) * weights).ravel(), rcond=None)[0],
        dtype=np.float64,
    )


def unseen_vaf(model: Subspace, runs: Sequence[Run]) -> dict[str, float]:
    """VAF [%] of free simulations; the initial state comes from the first second, which is left
    out.
    """
    first = round(START / DT)
    measured: list[FloatArray] = []
    error: list[FloatArray] = []
    for r in runs:
        simulated = model.simulate(
            r.inputs, initial_state(model, r.inputs[:first], r.outputs[:first])
        )
        y = np.column_stack([r.link, r.outputs[:, 1]])
        e = np.column_stack(
            [
                simulated[:, 1] - r.outputs[:, 1],
                r.link[:, 1] - simulated[:, 0],
                r.outputs[:, 1] - simulated[:, 1],
            ]
        )
        measured.append(y[first:])
        error.append(e[first:])
    vaf = 100.0 * (
        1.0 - np.var(np.concatenate(error), axis=0) / np.var(np.concatenate(measured), axis=0)
    )
    return dict(zip(LIMITS, vaf.tolist(), strict=True))


def line(head: str, model: Subspace, unseen: Sequence[Run], *, judged: bool) -> str:
    """One row of the table."""
    head = f"{head} {model.order:>5} {model.spectral_radius:8.5f}"
    if model.spectral_radius >= 1.0:
        return f"{head}   unstable"
    vaf = unseen_vaf(model, unseen)
    passed = "all reached" if all(vaf[k] >= v for k, v in LIMITS.items()) else "NOT reached"
    return (
        f"{head} {vaf['position']:9.4f} {vaf['velocity']:9.4f} "
        f"{vaf['relative position']:9.3f}   {passed if judged else ''}"
    )


def report(name: str, follower: Follower) -> None:
    """Print every order, the automatic choice and the best stable one, for each kind of
    acceleration.
    """
    print(
        f"\n{name}, block rows {BLOCK_ROWS}: unseen VAF % (limits "
        f"{', '.join(f'{k} {v}' for k, v in LIMITS.items())})"
    )
    print(
        f"{'acceleration':<12} {'method':<12} {'choice':<10} {'order':>5} {'radius':>8} "
        f"{'position':>9} {'velocity':>9} {'relative':>9}"
    )
    kinds: tuple[Acceleration, ...] = ("sensor", "derived", "none")
    methods: tuple[Method, ...] = ("ordinary", "past_output")
    for kind in kinds:
        seen = [run(follower, m, k, kind) for k, m in enumerate(motions("seen"))]
        unseen = [run(follower, m, 100 + k, kind) for k, m in enumerate(motions("unseen"))]
        for method in methods:
            head = f"{kind:<12} {method:<12}"
            for order in range(1, HIGHEST + 1):
                print(
                    line(
                        f"{head} {'given':<10}", identify(seen, method, order), unseen, judged=False
                    )
                )
            print(line(f"{head} {'automatic':<10}", identify(seen, method), unseen, judged=False))
            print(line(f"{head} {'best':<10}", best_stable(seen, method), unseen, judged=True))


def main() -> None:
    """Run the joints named on the command line, or all."""
    known = joints()
    for name in sys.argv[1:] or list(known):
        if name not in known:
            sys.exit(f"unknown joint {name}: choose among {', '.join(known)}")
        start = time.perf_counter()
        report(name, Follower(known[name](), DT))
        print(f"{time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main()
