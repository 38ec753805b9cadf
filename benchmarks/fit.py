"""Fits of one joint with Stribeck friction: weak form and output error against two fits by
simulation.

    python benchmarks/fit.py [--seconds 10] [--evaluations 20000]

The same record (drive and motor position) and the same friction model for all: CMA-ES and least
squares over solve_ivp simulate the whole record for each trial, as tools that identify servos do.
CMA-ES stops as soon as it is within 2 % of our error, when it has converged, or when its
evaluations are spent. Least squares runs from the same start as CMA-ES, and once more from our
weak-form fit, near the solution. Error: RMS of the simulated position over the whole record, from
rest, over the encoder's noise; 1 is perfect. Last column: largest error of inertia, gravity,
viscous and Coulomb friction.
"""

from __future__ import annotations

import os

os.environ.update(
    dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
)

import argparse
import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from casadi_models.simulate import sampled_step, simulate
from identification import Joint, Record
from identification.fitting.fit import fit
from identification.fitting.output_error import refine

FloatArray = npt.NDArray[np.float64]

DT, RATIO, PER_AMPERE = 2e-3, 160.0, 8.848
TRUTH = {
    "inertia": 14.0,
    "motor_viscous": 12.0,
    "motor_coulomb": 15.0,
    "motor_stribeck_extra": 6.0,
    "motor_stribeck_velocity": 0.08,
    "gravity_torque": -100.0,
    "motor_smoothing_velocity": 0.02,
}
START = {
    "inertia": 8.0,
    "motor_viscous": 20.0,
    "motor_coulomb": 10.0,
    "motor_stribeck_extra": 3.0,
    "motor_stribeck_velocity": 0.15,
    "gravity_torque": -60.0,
    "motor_smoothing_velocity": 0.03,
}
NAMES = tuple(TRUTH)
SHOWN = ("inertia", "gravity_torque", "motor_viscous", "motor_coulomb")
SIGNS = np.array([math.copysign(1.0, TRUTH[n]) for n in NAMES])


def torque(seconds: float, seed: int) -> FloatArray:
    """Drive torque of a swing with many reversals [N.m]."""
    t = np.arange(round(seconds / DT)) * DT
    phase = np.random.default_rng(seed).uniform(0, 6, 5)
    parts = zip((60.0, 35.0, 25.0, 15.0, 10.0), (5.3, 1.9, 0.83, 0.31, 0.11), phase, strict=True)
    whole: FloatArray = sum(
        (a * np.sin(2 * np.pi * t / p + f) for a, p, f in parts), np.zeros(len(t))
    )
    return whole * np.clip(t, 0, 1)


def residuals_by_ivp(
    drive: FloatArray, measured: FloatArray, sigma: float
) -> Callable[[FloatArray], FloatArray]:
    """Residuals of a simulation with scipy's solve_ivp; parameters as logarithms."""
    from scipy.integrate import solve_ivp

    stamps = np.arange(len(drive)) * DT
    torques, last = drive.tolist(), len(drive) - 1

    def residuals(logs: FloatArray) -> FloatArray:
        j, b, c, extra, vs, gravity, v0 = (SIGNS * np.exp(logs)).tolist()

        def rates(t: float, x: FloatArray) -> tuple[float, float]:
            q, v = float(x[0]), float(x[1])
            k = min(int(t / DT), last)
            fade = math.exp(-math.sqrt(v * v / (vs * vs) + 1e-12))
            friction = b * v + (c + extra * fade) * math.tanh(v / v0)
            return v, (torques[k] - friction + gravity * math.sin(q)) / j

        run = solve_ivp(
            rates,
            (0.0, stamps[-1]),
            (0.0, 0.0),
            t_eval=stamps,
            method="RK45",
            rtol=1e-6,
            atol=1e-8,
            max_step=5 * DT,
        )
        out: FloatArray = (measured - run.y[0]) / sigma
        return out

    return residuals


def main() -> None:
    """Run all fits and print the table."""
    import cma
    from scipy.optimize import least_squares

    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--evaluations", type=int, default=20000)
    parser.add_argument("--ours", action="store_true", help="leave the peers out")
    options = parser.parse_args()
    joint = Joint(
        name="servo",
        gear_ratio=RATIO,
        torque_per_current=PER_AMPERE,
        effects=("viscous@motor", "coulomb@motor", "stribeck@motor", "gravity"),
    )
    model = replace(joint.model(), inertias=("inertia",))
    exponent = {"motor_stribeck_exponent": 1.0}
    grain = math.radians(0.16) / RATIO
    sigma = grain / math.sqrt(12)
    drive = torque(options.seconds, 1)
    true = simulate(model.with_values({**TRUTH, **exponent}), drive, DT, substeps=10).readings[:, 0]
    measured = np.round(true / grain) * grain
    logged = drive + np.random.default_rng(2).normal(0, 0.035, len(drive))
    record = Record.from_channels(
        np.arange(len(drive)) * DT,
        {"motor_current": logged / PER_AMPERE, "motor_position": measured * RATIO},
        name="swing",
    )

    loop = sampled_step(model, DT, 2).mapaccum("loop", len(drive))
    inputs = np.stack([logged, np.zeros(len(drive)), np.arange(len(drive)) * DT])

    def error(values: dict[str, float]) -> float:
        p = [{**exponent, **values}[n] for n in model.parameter_names]
        q = loop(np.zeros(2), inputs, p).full()[0, :-1]
        size = float(np.sqrt(np.mean((measured[1:] - q) ** 2))) / sigma
        return size if math.isfinite(size) else 1e12

    def named(logs: FloatArray) -> dict[str, float]:
        return dict(zip(NAMES, (SIGNS * np.exp(logs)).tolist(), strict=True))

    start = np.log(np.abs(np.array([START[n] for n in NAMES])))
    rows: list[tuple[str, float, dict[str, float], int]] = []
    known = replace(joint, known={"motor_stribeck_exponent": _fixed(1.0)})
    begin = time.perf_counter()
    first = fit(known, record)
    weak = time.perf_counter() - begin
    rows.append(("weak form", weak, dict(first.solution.values), 1))
    begin = time.perf_counter()
    refined = refine(first)
    own = time.perf_counter() - begin + weak
    rows.append(("weak form + output error", own, dict(refined.values), refined.iterations))
    begin = time.perf_counter()
    whole = refine(refined.fit, window=options.seconds - 2 * DT)
    own += time.perf_counter() - begin
    rows.append(
        (
            "... then one whole window",
            own,
            dict(whole.values),
            refined.iterations + whole.iterations,
        )
    )
    if options.ours:
        return table(rows, own, error, len(drive))
    ivp = residuals_by_ivp(logged, measured, sigma)
    near = np.log(np.abs(np.array([first.solution.values[n] for n in NAMES])))
    for label, at in (("least_squares, solve_ivp", start), ("... from the weak form", near)):
        begin = time.perf_counter()
        found = least_squares(ivp, at, x_scale=0.3, ftol=1e-6, xtol=1e-8)
        rows.append((label, time.perf_counter() - begin, named(found.x), int(found.nfev)))
    settings = {
        "maxfevals": options.evaluations,
        "verbose": -9,
        "seed": 1,
        "tolfun": 1e-6,
        "ftarget": 1.02 * error(dict(whole.values)),
    }
    begin = time.perf_counter()
    best, search = cma.fmin2(lambda x: error(named(x)), start, 0.3, settings)
    rows.append(
        (
            "CMA-ES",
            time.perf_counter() - begin,
            named(np.asarray(best)),
            int(search.result.evaluations),
        )
    )
    return table(rows, own, error, len(drive))


def table(
    rows: list[tuple[str, float, dict[str, float], int]],
    own: float,
    error: Callable[[dict[str, float]], float],
    samples: int,
) -> None:
    """Print the rows; the ratio is to the last of our own times."""
    print(
        f"{samples} samples at {1 / DT:.0f} Hz, {len(NAMES)} parameters, load "
        f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    )
    print(f"{'fit':26s} {'seconds':>9s} {'/ ours':>8s} {'error':>9s} {'off by %':>9s} {'runs':>6s}")
    for name, seconds, values, count in rows:
        off = max(abs(values[n] / TRUTH[n] - 1) for n in SHOWN) * 100
        print(
            f"{name:26s} {seconds:9.2f} {seconds / own:8.1f} {error(values):9.3f} {off:9.3f} "
            f"{count:6d}"
        )
    print(f"{'true values':26s} {'':9s} {'':8s} {error(TRUTH):9.3f}")


def _fixed(value: float) -> object:
    from identification.data.joint_file import Known

    return Known(value=value)


if __name__ == "__main__":
    main()
