"""The demo: simulated records of a joint whose start model lacks one effect."""

from __future__ import annotations

import io
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from casadi_models.transmission import build

FloatArray = npt.NDArray[np.float64]

DT: Final = 0.002
DURATION: Final = 16.0
MOTOR_CONSTANT: Final = 0.0553
GEAR_RATIO: Final = -160.0
HIDDEN: Final = "stribeck@motor"
VALUES: Final = {
    "motor_inertia": 4.6, "link_inertia": 10.5, "stiffness": 21000.0, "structural_damping": 60.0, "motor_viscous": 10.0,
    "link_viscous": 2.0, "motor_coulomb": 19.0, "link_coulomb": 0.5, "gravity_torque": 95.0, "motor_stribeck_extra": 11.0,
    "motor_stribeck_velocity": 0.06,
}  # fmt: skip
"""Of the size of the joint in the thesis's table 4.1; link-referred SI."""

JOINT: Final = f"""[joint]
name = "demo"
gear_ratio = {GEAR_RATIO}
motor_constant = {MOTOR_CONSTANT}
model = "hd3"
effects = ["viscous", "coulomb", "gravity"]
"""


def _triangle(time: FloatArray, seed: int) -> FloatArray:
    """Slow and fast ramps through zero velocity, rounded: position, velocity, acceleration."""
    rng = np.random.default_rng(seed)
    f = np.array([0.11, 0.29, 0.63]) * rng.uniform(0.9, 1.1, 3)
    a = np.array([0.5, 0.22, 0.08])
    phase = rng.uniform(0, 2 * np.pi, 3)
    w = 2 * np.pi * f
    angle = w[:, None] * time + phase[:, None]
    rest = np.minimum(time / 1.0, 1.0)
    ramp = rest**3 * (10 - 15 * rest + 6 * rest**2)
    q = ramp * (a @ np.sin(angle) - a @ np.sin(phase))
    qd = np.gradient(q, time)
    return np.column_stack([q, qd, np.gradient(qd, time)])


def _record(seed: int) -> bytes:
    from identification._excite_follow import Controller, Follower

    labels = ("viscous", "coulomb", "gravity", HIDDEN)
    model = build("hd3", GEAR_RATIO, effects=labels)
    names = set(model.parameter_names)
    model = model.with_values({k: v for k, v in VALUES.items() if k in names})
    time: npt.NDArray[np.float64] = np.arange(round(DURATION / DT)).astype(np.float64) * DT
    run = Follower(model, DT, controller=Controller(25.0, 0.9)).run(_triangle(time, seed))
    rng = np.random.default_rng(seed + 100)
    step_motor, step_link = 2 * np.pi / 9000, 2 * np.pi / 100_000
    motor = np.round(run.states[:, 0] * GEAR_RATIO / step_motor) * step_motor
    link = np.round(run.states[:, 2] / step_link) * step_link
    current = run.drive / (GEAR_RATIO * MOTOR_CONSTANT) + rng.normal(0, 0.002, len(time))
    torque = run.torque + rng.normal(0, 0.08, len(time))
    out = io.StringIO()
    np.savetxt(
        out, np.column_stack([time, current, motor, link, torque]), fmt="%.9g", delimiter=",", comments="",
        header="time_s,motor_current_A,motor_position_rad,link_position_rad,link_torque_Nm",
    )  # fmt: skip
    return out.getvalue().encode()


@lru_cache(maxsize=1)
def demo_files() -> dict[str, bytes]:
    """Joint file, two records for the fit and one held out, by file name."""
    return {"demo.toml": JOINT.encode(), "demo_train1.csv": _record(1), "demo_train2.csv": _record(2), "demo_test.csv": _record(3)}
