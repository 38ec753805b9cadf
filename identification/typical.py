"""Typical sizes of parameters and effects, for joints that no fit has seen."""

from __future__ import annotations

from typing import Final

from casadi_models import JointModel
from identification.joint_file import Joint

TYPICAL: Final = {
    "motor_inertia": 4.447, "link_inertia": 10.277, "inertia": 14.7, "stiffness": 2.2e4, "structural_damping": 60.0,
    "motor_viscous": 11.0, "link_viscous": 2.0, "motor_coulomb": 21.5, "link_coulomb": 0.4, "gravity_torque": 105.18,
    "motor_smoothing_velocity": 0.005, "link_smoothing_velocity": 0.005,
}  # fmt: skip
"""Thesis tables 4.1 and 4.3, rounded; link-referred. Used where the joint file gives no fitted value."""

HIDDEN: Final = {
    "cubic_stiffness": 3.0e8, "stribeck_extra": 12.0, "stribeck_velocity": 0.07, "kinematic_error_sine": 4.0e-4,
    "kinematic_error_cosine": 3.0e-4, "kinematic_error_order": 2.0, "cubic_viscous": 8.0, "quadratic_drag": 8.0,
    "asymmetric_coulomb": 3.0, "asymmetric_viscous": 3.0, "load_friction": 0.08, "presliding_torque": 18.0, "presliding_distance": 3e-3,
    "cyclic_friction_sine": 3.0, "cyclic_friction_cosine": 2.0, "cyclic_torque_sine": 4.0, "cyclic_torque_cosine": 2.0,
    "added_spring": 60.0, "motor_constant_error": 0.15, "current_offset": 3.0, "ripple_sine": 1.5, "ripple_cosine": 1.0,
    "ripple_order": 2.0, "stiffness_step_1": 6e3, "stiffness_step_2": 8e3, "stiffness_knot_1": 7e-4, "stiffness_knot_2": 2e-3,
    "hysteresis_torque_1": 2.0, "hysteresis_torque_2": 3.0, "hysteresis_torque_3": 3.0, "hysteresis_width": 1e-4,
    "backlash_stiffness_loss": 1.5e4, "backlash": 3e-4, "soft_windup_torque": 6.0, "soft_windup_width": 4e-4,
    "torque_sensor_gain": 0.1, "link_position_gain": 0.002, "torque_sensor_offset": 3.0, "delay": 0.006, "gravity_cosine": 5.0, "extra_inertia": 1.0,
    "sensor_compliance": 1e-5, "thermal_coulomb": 0.3, "thermal_viscous": 0.0,
    "flexible_inertia": 1.5, "flexible_stiffness": 1.2e3, "load_friction_mean": 0.08, "load_friction_difference": 0.03,
    "smooth_stribeck": 300.0, "loss_constant": 12.0, "loss_viscous": 8.0, "loss_cubic": 2.0, "loss_sine": 1.0, "loss_cosine": 0.5,
}  # fmt: skip
"""Sizes of hidden effects, of the order of the thesis and of catalogues."""


def true_values(model: JointModel, joint: Joint) -> dict[str, float]:
    """Parameter values: those of the joint file, else typical ones."""
    out = {}
    for p in model.parameters:
        bare = p.name
        for place in ("motor_", "link_", "drive_", "torque_sensor_", "link_position_sensor_"):
            if bare not in TYPICAL and bare not in HIDDEN and bare.startswith(place):
                bare = bare.removeprefix(place)
        known = joint.known.get(p.name)
        if p.name in model.values:
            out[p.name] = float(model.values[p.name])
        elif known is not None and known.value is not None:
            out[p.name] = known.value
        else:
            out[p.name] = TYPICAL.get(p.name, HIDDEN.get(bare, p.start))
    return out
