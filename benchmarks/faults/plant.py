"""The simulated joint of the fault campaign, its motions and readings, the detector's model,
the stated fault sizes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from casadi_models import JointModel
from casadi_models.thesis import model_ts
from identification.faults.detector import NOISE, SENSORS, Fault
from identification.planning.follow import Followed

FloatArray = npt.NDArray[np.float64]

DT = 1e-3
ERRORS = {
    "stiffness": 0.01,
    "cubic_stiffness": 0.05,
    "motor_inertia": 0.01,
    "link_inertia": 0.01,
    "gravity_torque": 0.005,
    "motor_added_spring": 0.03,
    "motor_viscous": 0.05,
    "motor_coulomb": 0.05,
    "motor_smooth_stribeck": 0.1,
    "link_viscous": 0.05,
    "structural_damping": 0.3,
}
"""Relative error of the detector's parameters, either sign."""
SIZES = {
    "motor_position": {
        "noise": 0.1,
        "spike": 0.01,
        "bias": 2e-3,
        "gain": 0.05,
        "drift": 2e-3,
        "delay": 0.02,
    },
    "motor_velocity": {
        "noise": 0.1,
        "spike": 0.2,
        "bias": 0.05,
        "gain": 0.2,
        "drift": 0.05,
        "delay": 0.02,
    },
    "link_position": {
        "noise": 0.1,
        "spike": 0.01,
        "bias": 2e-3,
        "gain": 0.05,
        "drift": 2e-3,
        "delay": 0.02,
    },
    "link_velocity": {
        "noise": 0.1,
        "spike": 0.2,
        "bias": 0.05,
        "gain": 0.2,
        "drift": 0.05,
        "delay": 0.02,
    },
    "torque": {"noise": 0.1, "spike": 60.0, "bias": 10.0, "gain": 0.3, "drift": 5.0, "delay": 0.05},
    "current": {
        "noise": 50.0,
        "spike": 300.0,
        "bias": 20.0,
        "gain": 0.4,
        "drift": 10.0,
        "delay": 0.05,
    },
}
"""Stated sizes in rad, rad/s, N.m (per second for drift, share for gain, s for delay)."""
FACTORS = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Parts and multiples of the stated sizes for the detection-size curve."""
START = 5.0
"""Every fault begins here [s]; the campaign looks at it for six seconds."""


def plant() -> JointModel:
    """The simulated joint: TS model of the thesis (tables 4.1, 4.3, 4.6), with structural
    damping.
    """
    return (
        model_ts()
        .add("structural_damping")
        .with_values({"structural_damping": 30.0, "link_smoothing_velocity": 5e-3})
    )


def detector_model(joint: JointModel) -> JointModel:
    """The joint with the errors an identification leaves."""
    rng = np.random.default_rng(7)
    values = dict(joint.values)
    return joint.with_values(
        {n: values[n] * (1 + e * rng.choice([-1.0, 1.0])) for n, e in ERRORS.items() if n in values}
    )


def reference(seed: int, seconds: float) -> FloatArray:
    """Random triangles and sines of 3.8 in turn, 10 s each, smoothed: (n, 3) position,
    velocity, acceleration.
    """
    rng = np.random.default_rng(seed)
    n = round(seconds / DT)
    raw = np.zeros(n)
    for first in range(0, n, round(10 / DT)):
        t = np.arange(min(round(10 / DT), n - first)) * DT
        speed = np.radians(rng.uniform(15, 45))
        if rng.random() < 0.5:
            amplitude = rng.uniform(0.2, 1.0)
            period = 4 * amplitude / speed
            shape = 2 * np.abs(2 * ((t / period + 0.25) % 1.0) - 1) - 1
            raw[first : first + len(t)] = -amplitude * shape
        else:
            period = rng.uniform(0.8, 6.0)
            raw[first : first + len(t)] = rng.uniform(-0.5, 0.5) + speed * period / (
                2 * np.pi
            ) * np.sin(2 * np.pi * t / period)
    from scipy.signal import lfilter

    w = 8.0
    a = np.exp(-w * DT)
    out = raw
    for _ in range(4):
        out = np.asarray(lfilter([1 - a], [1, -a], out), dtype=np.float64)
    velocity: FloatArray = np.gradient(out, DT)
    return np.column_stack([out, velocity, np.gradient(velocity, DT)])


def readings(run: Followed, seed: int) -> FloatArray:
    """Six readings with noise, (n, 6)."""
    clean = clean_readings(run)
    levels = np.array([NOISE[s] for s in SENSORS])
    noisy: FloatArray = clean + np.random.default_rng(seed).normal(size=clean.shape) * levels
    return noisy


def clean_readings(run: Followed) -> FloatArray:
    """Six readings without noise, (n, 6)."""
    return np.column_stack([run.drive, run.states, run.torque])


def pairs() -> list[list[Fault]]:
    """Staggered, simultaneous and temporary faults of the link sensors, and one across the
    joint.
    """

    def noisy(sensor: str, start: float, end: float = float("inf")) -> Fault:
        return Fault(sensor, "noise", start, 0.1, end)

    return [
        [noisy("link_position", START), noisy("link_velocity", START + 2.0)],
        [noisy("link_velocity", START), noisy("link_position", START + 2.0)],
        [noisy("link_position", START), noisy("link_velocity", START)],
        [noisy("link_position", START, START + 2.0)],
        [noisy("link_velocity", START, START + 2.0)],
        [noisy("motor_velocity", START), Fault("link_position", "stuck", START + 2.0)],
    ]
