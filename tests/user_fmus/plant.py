"""The joint whose foreign model is the test FMU "Elastic": the same equations in the library's own
terms, with an effect that the FMU lacks, under a controller and read by noisy sensors.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from casadi_models import JointModel
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.planning.follow import Follower
from irj_fmu.imported.model import UserModel, load_user_model

GEAR: Final = 100.0
TRUTH: Final = {
    "motor_inertia": 4.0,
    "link_inertia": 11.0,
    "stiffness": 2e4,
    "structural_damping": 25.0,
    "motor_viscous": 20.0,
    "motor_coulomb": 15.0,
    "gravity_torque": -55.0,
    "motor_smoothing_velocity": 2e-3,
}
"""Link-referred; those of the FMU are on the motor shaft."""
OWN: Final = {
    "motor_inertia": 4.0e-4,
    "link_inertia": 11.0,
    "stiffness": 2.0e4,
    "damping": 25.0,
    "viscous": 2.0e-3,
    "coulomb": 0.15,
    "gravity": 55.0,
}
"""The same in the FMU."""
HIDDEN: Final[Mapping[str, tuple[str, Mapping[str, float]]]] = {
    "stribeck": (
        "stribeck@motor",
        {
            "motor_stribeck_extra": 8.0,
            "motor_stribeck_velocity": 0.07,
            "motor_stribeck_exponent": 1.0,
        },
    ),
    "quadratic_drag": ("quadratic_drag@motor", {"motor_quadratic_drag": 8.0}),
    "torque_ripple": (
        "torque_ripple",
        {"ripple_sine": 1.5, "ripple_cosine": 1.0, "ripple_order": 2.0},
    ),
    "kinematic_error": (
        "kinematic_error",
        {
            "kinematic_error_sine": 4e-4,
            "kinematic_error_cosine": 3e-4,
            "kinematic_error_order": 2.0,
        },
    ),
    "hysteresis": (
        "hysteresis",
        {
            "hysteresis_torque_1": 2.0,
            "hysteresis_torque_2": 3.0,
            "hysteresis_torque_3": 3.0,
            "hysteresis_width": 1e-4,
        },
    ),
    "backlash": ("backlash", {"backlash_stiffness_loss": 15000.0, "backlash": 3e-4}),
    "torque_sensor_gain": ("torque_sensor_gain", {"torque_sensor_gain": 0.1}),
    "added_spring": ("added_spring@link", {"link_added_spring": 30.0}),
}
"""Label and values of what is hidden, by key: the typical sizes of the library where it has one."""
PERIODS: Final = (9.0, 4.1, 2.3, 1.1, 0.55)
SIZES: Final = (0.75, 0.3, 0.12, 0.035, 0.01)
NOISE: Final = {"motor_position": 1e-4, "link_position": 2e-6, "link_torque": 0.05}
"""Of the encoders on their shafts [rad] and of the torque sensor [N.m]."""


def recorded(
    hidden: str | None,
    seconds: float,
    seed: int,
    dt: float = 1e-3,
    *,
    noise: Mapping[str, float] = NOISE,
) -> Record:
    """A record of the joint with an effect that its foreign model lacks."""
    label, values = HIDDEN[hidden] if hidden else ("", {})
    effects = ("viscous@motor", "coulomb@motor", "gravity", *([label] if label else []))
    model = JointModel.by_name("hd3", GEAR, effects=effects).with_values({**TRUTH, **values})
    rng = np.random.default_rng(seed)
    time = np.arange(0, seconds, dt)
    rates = 2 * np.pi / (np.array(PERIODS) * rng.uniform(0.9, 1.1, len(PERIODS)))
    angle = np.outer(time, rates) + rng.uniform(0, 2 * np.pi, len(PERIODS))
    reference = np.column_stack(
        [
            np.sin(angle) @ SIZES,
            np.cos(angle) @ (np.array(SIZES) * rates),
            -np.sin(angle) @ (np.array(SIZES) * rates**2),
        ]
    )
    run = Follower(model, dt).run(reference)
    channels = {
        "motor_position": run.states[:, 0] * GEAR,
        "link_position": run.states[:, 2],
        "link_torque": run.torque,
    }
    noise = {**NOISE, **noise}
    read = {n: x + noise[n] * rng.standard_normal(len(x)) for n, x in channels.items()}
    return Record.from_channels(
        time, {"motor_torque": run.drive / GEAR, **read}, name=hidden or "nothing"
    )


def foreign(path: Path, **options: object) -> UserModel:
    """The FMU as the model of that joint: every parameter free, within a factor of some three."""
    given: dict[str, object] = {
        "start": {
            "qm": "motor_position",
            "wm": "motor_velocity",
            "ql": "link_position",
            "wl": "link_velocity",
        },
        "joint": Joint(
            name="elastic",
            gear_ratio=GEAR,
            effects=("viscous@motor", "coulomb@motor", "gravity", "structural_damping"),
        ),
        "window": 0.5,
    }
    return load_user_model(
        path,
        {
            "motor_torque": "torque",
            "motor_position": "motor_angle",
            "link_position": "link_angle",
            "link_torque": "gear_torque",
        },
        {n: (v / 3, 3 * v) for n, v in OWN.items()},
        **(given | options),  # type: ignore[arg-type]
    )
