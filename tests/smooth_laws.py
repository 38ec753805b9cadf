"""An axis with smooth laws that are in no library, by inverse dynamics: for the tests of curves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.integrate import cumulative_trapezoid

from identification.balance.dataset import Dataset
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.diagnosis.curve import Located, find_curves
from identification.diagnosis.trials import make_base
from identification.fitting.engine import Solution, load_dataset, prepared_model, solve

FloatArray = npt.NDArray[np.float64]
Law = Callable[[FloatArray, FloatArray], FloatArray]
INERTIA, VISCOUS, COULOMB = 12.0, 25.0, 20.0

LAWS: dict[str, tuple[str, Law]] = {
    "tanh": ("learned_velocity", lambda q, v: 6 * np.tanh(v / 0.15)),
    "root": ("learned_velocity", lambda q, v: 8 * np.sign(v) * np.sqrt(np.abs(v))),
    "bump": ("learned_position", lambda q, v: 5 * np.exp(-(((q - 0.3) / 0.15) ** 2))),
    "snag": (
        "learned_position_friction",
        lambda q, v: 6 * np.exp(-(((q + 0.2) / 0.1) ** 2)) * np.sign(v),
    ),
    "fan": ("learned_velocity_even", lambda q, v: 4 * np.exp(-np.abs(v) / 0.2)),
}
"""Smooth laws that are in no library, and the variable of each."""


def nothing(q: FloatArray, v: FloatArray) -> FloatArray:
    return 0 * q


def record(rng: np.random.Generator, seconds: float, law: Law) -> Record:
    """An axis that follows seven sines, its torque by inverse dynamics, 1 N.m of noise, an
    encoder of 5 urad.
    """
    t = np.arange(int(seconds * 1000)) * 1e-3
    q, v, a = np.zeros((3, len(t)))
    for f in rng.uniform(0.07, 0.9, 7):
        w, size, phase = (
            2 * np.pi * f,
            rng.uniform(0.25, 0.5) / (2 * np.pi * f) ** 0.7,
            rng.uniform(0, 6.28),
        )
        q, v, a = (
            q + size * np.sin(w * t + phase),
            v + size * w * np.cos(w * t + phase),
            a - size * w**2 * np.sin(w * t + phase),
        )
    torque = (
        INERTIA * a
        + VISCOUS * v
        + COULOMB * np.tanh(v / 2e-3)
        + law(q, v)
        + rng.standard_normal(len(t))
    )
    return Record.from_channels(
        t, {"motor_position": np.round(q / 5e-6) * 5e-6, "motor_torque": torque}
    )


def at_one_speed(rng: np.random.Generator, law: Law) -> Record:
    """Back and forth at 0.8 rad/s for 20 s, torque by inverse dynamics, 1 N.m of noise."""
    t = np.arange(20_000) * 1e-3
    beat = 2 * np.pi * 0.25
    v = 0.8 * np.tanh(8 * np.sin(beat * t))
    a = np.gradient(v, t)
    q = cumulative_trapezoid(v, t, initial=0.0)
    torque = INERTIA * a + VISCOUS * v + COULOMB * np.tanh(v / 2e-3) + law(q, v)
    return Record.from_channels(
        t, {"motor_position": q, "motor_torque": torque + rng.standard_normal(len(t))}
    ).renamed("one speed")


@dataclass(frozen=True)
class Run:
    solution: Solution
    data: Dataset
    found: Located
    records: tuple[Record, ...]


def run(seed: int, law: Law, effects: tuple[str, ...] = ("viscous", "coulomb")) -> Run:
    rng = np.random.default_rng(seed)
    records = [record(rng, 40, law), record(rng, 20, law)]
    joint = Joint("axis", gear_ratio=1.0, model_name="hd1", effects=effects)
    model = prepared_model(joint, records[0])
    data = load_dataset(records[:1], records[1:], joint, model)
    solution = solve(model, data)
    return Run(solution, data, find_curves(make_base(solution, data), "axis"), tuple(records))


def settling(rng: np.random.Generator, law: Law) -> Record:
    """Back and forth at 0.8 rad/s, then creeping at 4 mrad/s for 3 s, as a joint does that settles:
    under the speed over which its dry friction turns. Torque by inverse dynamics, 1 N.m of noise.
    """
    t = np.arange(20_000) * 1e-3
    going = 0.5 * (1 - np.tanh((t - 17.0) / 0.05))
    creeps = 4e-3 * np.sin(2 * np.pi * 0.4 * t)
    v = 0.8 * np.tanh(8 * np.sin(2 * np.pi * 0.25 * t)) * going + (1 - going) * creeps
    a = np.gradient(v, t)
    q = cumulative_trapezoid(v, t, initial=0.0)
    torque = INERTIA * a + VISCOUS * v + COULOMB * np.tanh(v / 0.016) + law(q, v)
    channels = {
        "motor_position": q + 2e-6 * rng.standard_normal(len(t)),
        "motor_torque": torque + rng.standard_normal(len(t)),
    }
    return Record.from_channels(t, channels).renamed("settling")
