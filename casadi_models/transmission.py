"""Harmonic-drive models 1 to 4 of the thesis in configurations 1, 2 and IRJ.

Ports: wave generator (wg), flexspline (fs), circular spline (cs), reduction ratio N::

    theta_wg = (N + 1) theta_cs - N theta_fs                     (2.29)
    T_wg = T_cs / (N + 1) = T_fs / N                             (2.31)

Configuration 1: input wg, fs fixed, output cs, theta_in = (N + 1) theta_out (2.15 to 2.22).
Configuration 2: input wg, cs fixed, output fs, theta_in = -N theta_out (2.23 to 2.28).
IRJ: configuration 2 with torque sensor and link (2.64 to 2.68).
"""

from __future__ import annotations

from typing import Final

CONFIGURATIONS: Final = ("1", "2", "IRJ")

MODELS: Final[dict[str, tuple[str, ...]]] = {
    "hd1": (),
    "hd2": ("transmission_losses",),
    "hd3": ("transmission_compliance", "structural_damping"),
    "hd4": (
        "transmission_compliance",
        "structural_damping",
        "kinematic_error",
        "kinematic_error#2",
        "kinematic_error#3",
    ),
    "irj1a": ("gravity_upright",),
    "irj1b": ("gravity_upright", "coulomb@motor"),
    "irj2a": ("transmission_compliance", "cubic_stiffness", "gravity_upright"),
    "irj2b": (
        "transmission_compliance",
        "cubic_stiffness",
        "added_spring_at_zero@motor",
        "viscous@motor",
        "viscous@link",
        "coulomb@motor",
        "coulomb@link",
        "gravity_upright",
    ),
    "irj_ts": (
        "transmission_compliance",
        "cubic_stiffness",
        "added_spring_at_zero@motor",
        "viscous@motor",
        "coulomb@motor",
        "smooth_stribeck@motor",
        "viscous@link",
        "cyclic_torque@link",
        "gravity_upright",
    ),
}
"""Effects of each model by name: the transmission ladder hd1 to hd4 and the identification
ladder of 4.3.2.
"""

STARTS: Final[dict[str, dict[str, float]]] = {
    "hd4": {
        "kinematic_error_order": 1.0,
        "kinematic_error_order_2": 2.0,
        "kinematic_error_order_3": 4.0,
    }
}
"""Values that a model has by its name: the orders of (2.48)."""


def signed_ratio(configuration: str | int, reduction: float) -> float:
    """theta_in / theta_out of a configuration (2.29 with one port held).

    Parameters
    ----------
    configuration : {"1", "2", "IRJ"}
    reduction : float
        N > 0.
    """
    if str(configuration) not in CONFIGURATIONS:
        raise ValueError(f"configuration {configuration!r}: use 1, 2 or IRJ")
    return reduction + 1 if str(configuration) == "1" else -reduction


def port_angles(theta_cs: float, theta_fs: float, reduction: float) -> float:
    """Angle (or velocity) of the wave generator from those of the two splines (2.29, 2.30)."""
    return (reduction + 1) * theta_cs - reduction * theta_fs


def port_torques(torque_wg: float, reduction: float) -> tuple[float, float]:
    """Torques of circular spline and flexspline from that of the wave generator (2.31), without
    losses.
    """
    return (reduction + 1) * torque_wg, reduction * torque_wg
