"""Two-step identification: friction of table 4.6, and the time-variant test of section 4.3.4.2.

python benchmarks/two_step.py table [--seeds 20]
python benchmarks/two_step.py variant [--seeds 5]
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import casadi as ca

from casadi_models import JointModel
from identification.planning.follow import Follower
from identification.two_step.algorithm import (
    JOINT_CHANNELS,
    Coefficient,
    Mode,
    OnlineSettings,
    SeparableModel,
    Shape,
    TwoStep,
    TwoStepSettings,
    from_casadi,
    smooth_friction,
)
from identification.two_step.varpro import BudgetSpent, Projection
from identification.two_step.varpro_search import hypercube, polish

FloatArray = npt.NDArray[np.float64]

B, C1, C2, W1, WS = 9.0, 29.0, 480.0, 0.0595, 0.0251
BOXES = {"w1": (0.005, 0.5), "wS": (0.002, 0.2)}
NOISE = 0.05
"""Noise of the torques in the time-variant test: the torque sensor of table B.1 [N.m]."""


def friction(w: FloatArray, linear: float = 1.0, shape: float = 1.0) -> FloatArray:
    """Friction of table 4.6 (4.18), with the linear and the shape parameters multiplied [N.m]."""
    decay = np.exp(-np.abs(w) / (shape * WS))
    return linear * (B * w + C1 * np.tanh(w / (shape * W1)) + C2 * w * decay)


def trajectories() -> dict[str, FloatArray]:
    """Velocities over 20 s at 100 Hz [rad/s]."""
    t = np.arange(2000) * 0.01
    rich = 0.24 * np.sin(2 * np.pi * t / 10) + 0.06 * np.sin(2 * np.pi * t / 1.7)
    return {"sine": 0.262 * np.sin(2 * np.pi * t / 1.9), "rich": rich}


def best_known(model: SeparableModel, y: FloatArray, w: FloatArray, seed: int) -> float:
    """Sum of squares of the best of 30 least-squares starts, coefficients >= 0."""
    problem = Projection(model, y[:, None], w[:, None], np.ones(1), 100000)
    problem.sign = problem.signed
    for start in hypercube(30, problem.low, problem.high, 1000 + seed):
        try:
            polish(problem, start, 1e-12)
        except BudgetSpent:
            break
    return problem.best().solve(problem.sign)[1]


def table(seeds: int) -> None:
    """20 seeds, two trajectories, two and three nonlinear parameters: how often the best known
    fit is reached.
    """
    for exponent in (False, True):
        print(f"\n{'three' if exponent else 'two'} nonlinear parameters, 1 % noise, {seeds} seeds")
        print(
            "trajectory  method               equal   strict  evaluations (median, max)  seconds "
            " negative coefficient"
        )
        for name, w in trajectories().items():
            rows: dict[str, list[tuple[float, int, float, bool]]] = {}
            for seed in range(seeds):
                rng = np.random.default_rng(seed)
                clean = friction(w)
                y = clean + 0.01 * np.abs(clean).max() * rng.standard_normal(len(w))
                model = smooth_friction(w, exponent=exponent).with_boxes(BOXES)
                reference = best_known(model, y, w, seed)
                settings = TwoStepSettings(freeze=False, seed=seed)
                found = []
                for method in ("variable_projection", "alternating"):
                    start = time.perf_counter()
                    fit = TwoStep(model, method, settings=settings).fit(y, w)
                    found.append((method, fit, time.perf_counter() - start))
                reference = min(
                    reference,
                    *(f.sum_of_squares for _, f, _ in found if min(f.linear.values()) >= 0),
                )
                for method, fit, took in found:
                    excess = fit.sum_of_squares / reference - 1
                    rows.setdefault(method, []).append(
                        (excess, fit.evaluations, took, bool(fit.negative))
                    )
            for method, results in rows.items():
                over, evaluations, spent, repeated = (
                    np.array(v) for v in zip(*results, strict=True)
                )
                print(
                    f"{name:11} {method:20} {np.sum(over < 1 / len(w)):3d}/{seeds}  "
                    f"{np.sum(over < 1e-5):3d}/{seeds} "
                    f"{np.median(evaluations):8.0f} {np.max(evaluations):6.0f} {'':10} "
                    f"{np.mean(spent):8.2f}"
                    f" {np.sum(repeated):8d}",
                    flush=True,
                )


def joint_model(
    velocity: FloatArray, inertia: tuple[float, float], gravity: float
) -> SeparableModel:
    """The TS model (4.20) with two outputs: drive less Jm am, and Jl al less gravity; inertias
    and gravity known.
    """
    s, eta = ca.SX.sym("s", len(JOINT_CHANNELS)), ca.SX.sym("eta", 2)
    qm, v, am, ql, vl, al = (s[i] for i in range(6))
    d = qm - ql
    rows = ca.vertcat(
        ca.horzcat(d, d**3, qm, v, ca.tanh(v / eta[0]), v * ca.exp(-ca.fabs(v) / eta[1]), 0, 0, 0),
        ca.horzcat(d, d**3, 0, 0, 0, 0, -vl, -ca.sin(ql), -ca.cos(ql)),
    )
    known = ca.vertcat(inertia[0] * am, gravity * ca.sin(ql) - inertia[1] * al)
    names = ("k1", "k2", "ka", "b_in", "C1", "C2", "b_out", "A1", "A2")
    positive = {"k1", "ka", "b_in", "C1", "C2", "b_out"}
    low, high = 0.01 * float(np.abs(velocity).max()), float(np.abs(velocity).max())
    shapes = [Shape(n, low, high, math.sqrt(low * high), "rad/s") for n in ("w1", "wS")]
    return from_casadi(
        ca.Function("ts", [s, eta], [rows, known]),
        [Coefficient(n, "", n in positive) for n in names],
        shapes,
        JOINT_CHANNELS,
    )


TRUE = {
    "k1": 4.278e4,
    "k2": 1.174e9,
    "ka": 86.2313,
    "b_in": B,
    "C1": C1,
    "C2": C2,
    "b_out": 9.7285,
    "A1": 2.0,
    "A2": 1.5,
}


def variant_record(
    seed: int, dt: float, seconds: float
) -> tuple[SeparableModel, FloatArray, FloatArray]:
    """Motion of a simulated joint; torques of the TS model: linear +30 % from 16 s, nonlinear
    +20 % from 27 s.
    """
    plant = JointModel.by_name("irj2b", -160.0, effects=("structural_damping",)).with_values(
        {
            "motor_inertia": 4.447,
            "link_inertia": 10.277,
            "gravity_torque": 105.18,
            "stiffness": TRUE["k1"],
            "cubic_stiffness": TRUE["k2"],
            "motor_added_spring": TRUE["ka"],
            "motor_coulomb": 21.5,
            "motor_viscous": 23.6,
            "link_coulomb": 0.41,
            "link_viscous": 9.73,
            "structural_damping": 30.0,
            "motor_smoothing_velocity": 5e-3,
            "link_smoothing_velocity": 5e-3,
        }
    )
    t = np.arange(round(seconds / dt)) * dt
    rng = np.random.default_rng(seed)
    a, w, phase = (
        np.array([0.15, 0.02]),
        2 * np.pi / np.array([3.1, 0.83]),
        rng.uniform(0, 2 * np.pi, 2),
    )
    arg = np.outer(t, w) + phase
    reference = np.stack(
        [np.sin(arg) @ a, np.cos(arg) @ (a * w), -np.sin(arg) @ (a * w * w)], axis=1
    )
    run = Follower(plant, dt).run(reference)
    signals = np.column_stack(
        [run.states[:, :2], run.accelerations[:, 0], run.states[:, 2:], run.accelerations[:, 1]]
    )
    model = joint_model(run.states[:, 1], (4.447, 10.277), 105.18)
    shapes = np.array([W1, WS])
    y = np.zeros((len(t), 2))
    for part, linear, shape in (
        ((0, 16), 1.0, 1.0),
        ((16, 27), 1.3, 1.0),
        ((27, seconds), 1.3, 1.2),
    ):
        rows = slice(round(part[0] / dt), round(part[1] / dt))
        theta = linear * np.array([TRUE[n] for n in model.names])
        y[rows] = model.matrix(signals[rows], shape * shapes) @ theta + model.remainder(
            signals[rows], shape * shapes
        )
    return model, y + rng.normal(0, NOISE, y.shape), signals


def variant(seeds: int) -> None:
    """Time-variant test of 4.3.4.2 on line at 1 kHz."""
    dt, seconds = 1e-3, 40.0
    print(
        "seed  5 % recovery after the linear step [s]: k1     ka     C1   | searches before 27 "
        "s, after |"
        "  w1, wS error [%] | nonlinear re-identified at [s] | us/sample"
    )
    for seed in range(seeds):
        model, y, signals = variant_record(seed, dt, seconds)
        two = TwoStep(model, online=OnlineSettings(sample_time=dt))
        path = np.zeros((len(y), len(model.names)))
        cost = []
        for k in range(len(y)):
            t0 = time.perf_counter()
            path[k] = two.update(y[k], signals[k])
            cost.append(time.perf_counter() - t0)
        names = list(model.names)
        recovery = []
        for name in ("k1", "ka", "C1"):
            error = np.abs(
                path[round(16 / dt) : round(26.9 / dt), names.index(name)] / (1.3 * TRUE[name]) - 1
            )
            outside = np.flatnonzero(error > 0.05)
            recovery.append((outside[-1] + 1) * dt if outside.size else 0.0)
        before = sum(e.mode is Mode.REOPTIMISING for e in two.events if e.sample * dt < 27)
        after = sum(e.mode is Mode.REOPTIMISING for e in two.events if e.sample * dt >= 27)
        done = [
            e.sample * dt for e in two.events if e.sample * dt > 27 and e.mode is Mode.RECURSIVE
        ]
        shapes = (two.nonlinear / (1.2 * np.array([W1, WS])) - 1) * 100
        print(
            f"{seed:4d} {'':40} {recovery[0]:6.3f} {recovery[1]:6.3f} {recovery[2]:6.3f} | "
            f"{before:10d} {after:10d} |"
            f" {shapes[0]:8.2f} {shapes[1]:8.2f} | {done[0] if done else math.nan:8.2f} | "
            f"{np.median(cost) * 1e6:6.0f}",
            flush=True,
        )
        if "-v" in sys.argv:
            for e in two.events:
                print("     ", round(e.sample * dt, 3), e.mode.name, e.why)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("table", "variant"))
    parser.add_argument("--seeds", type=int, default=0)
    parser.add_argument("-v", action="store_true")
    asked = parser.parse_args()
    if asked.what == "table":
        table(asked.seeds or 20)
    else:
        variant(asked.seeds or 5)


if __name__ == "__main__":
    main()
