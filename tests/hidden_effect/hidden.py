"""What can be hidden in a joint: parameter changes, their sizes and what the truth file says about
them.

All values are link-referred. Each function draws one effect; ``size`` scales its strength, never
its shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from tests.hidden_effect._engine import STEP

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


@final
@dataclass(frozen=True)
class Draw:
    """One drawn effect.

    Attributes
    ----------
    changes
        Parameters of the integrator that replace those of the plain joint.
    truth
        Values for the truth file, name with unit.
    balance
        Where it shows: motor, link, transmission or sensor.
    sensor
        Gains and offsets of the measured channels.
    """

    changes: Mapping[str, float]
    truth: Mapping[str, float | str]
    balance: str
    sensor: Mapping[str, float] | None = None


@final
@dataclass(frozen=True)
class Setting:
    """What a draw may look at: random stream, strength, the plain joint, side (M or L)."""

    rng: np.random.Generator
    size: float
    base: Mapping[str, float]
    side: str

    @property
    def place(self) -> str:
        """Side in words."""
        return "motor" if self.side == "M" else "link"

    def between(self, low: float, high: float, *, signed: bool = False) -> float:
        """Uniform draw times the size, with a random sign if asked."""
        value = self.rng.uniform(low, high) * self.size
        return float(-value if signed and self.rng.random() < 0.5 else value)

    def shape(self, low: float, high: float) -> float:
        """Uniform draw that the size does not touch."""
        return float(self.rng.uniform(low, high))


def _on_side(s: Setting, changes: dict[str, float], truth: dict[str, float | str]) -> Draw:
    return Draw(
        {f"{s.side}_{k}": v for k, v in changes.items()}, {**truth, "place": s.place}, s.place
    )


def cubic_viscous(s: Setting) -> Draw:
    b3 = s.between(8.0, 13.0, signed=True)
    return _on_side(s, {"B3": b3}, {"cubic_viscous_Nms3_per_rad3": b3})


def quadratic_drag(s: Setting) -> Draw:
    b2 = s.between(7.0, 11.0, signed=True)
    return _on_side(s, {"B2": b2}, {"quadratic_drag_Nms2_per_rad2": b2})


def asymmetric_coulomb(s: Setting) -> Draw:
    half = s.between(1.5, 4.0, signed=True)
    return _on_side(s, {"TCA": half}, {"coulomb_half_difference_Nm": half})


def asymmetric_viscous(s: Setting) -> Draw:
    half = s.between(3.0, 5.5, signed=True)
    return _on_side(s, {"BA": half}, {"viscous_half_difference_Nms_per_rad": half})


def stribeck(s: Setting) -> Draw:
    extra, velocity = s.between(8.0, 14.0), s.shape(0.04, 0.09)
    exponent = float(s.rng.choice([1.0, 2.0]))
    truth: dict[str, float | str] = {
        "stribeck_extra_Nm": extra,
        "stribeck_velocity_rad_s": velocity,
        "stribeck_exponent": exponent,
    }
    return _on_side(s, {"TS": extra, "VS": velocity, "DS": exponent}, truth)


def load_dependent_friction(s: Setting) -> Draw:
    factor = s.between(0.05, 0.12)
    return _on_side(s, {"MU": factor}, {"load_factor": factor})


def lugre(s: Setting) -> Draw:
    distance = s.between(1.5e-3, 4e-3)
    return _on_side(s, {"ZS": distance}, {"presliding_distance_rad": distance})


def thermal_friction(s: Setting) -> Draw:
    fall, constant = s.between(0.20, 0.32), s.shape(5.0, 10.0)
    return Draw(
        {"HEAT": fall, "HEAT_TAU": constant},
        {"friction_fall": fall, "thermal_time_constant_s": constant},
        "motor",
    )


def cyclic_friction(s: Setting) -> Draw:
    amplitude, phase = s.between(2.5, 5.0), s.shape(0.0, 2.0 * np.pi)
    return _on_side(
        s,
        {"CYC": amplitude, "CYC_P": phase},
        {"cyclic_friction_Nm": amplitude, "cyclic_friction_phase_rad": phase},
    )


def cyclic_torque(s: Setting) -> Draw:
    amplitude, phase = s.between(4.0, 9.0), s.shape(0.0, 2.0 * np.pi)
    sine, cosine = amplitude * np.cos(phase), amplitude * np.sin(phase)
    return _on_side(
        s, {"SIN": sine, "COS": cosine}, {"cyclic_sine_Nm": sine, "cyclic_cosine_Nm": cosine}
    )


def added_spring(s: Setting) -> Draw:
    rate = s.between(40.0, 90.0)
    return _on_side(s, {"KA": rate}, {"added_spring_Nm_per_rad": rate})


def motor_constant_error(s: Setting) -> Draw:
    factor = 1.0 + s.between(0.10, 0.20, signed=True)
    return Draw({"KM": factor}, {"motor_constant_factor": factor}, "motor")


def current_offset(s: Setting) -> Draw:
    offset = s.between(0.2, 0.5, signed=True)
    return Draw({}, {"current_offset_A": offset}, "motor", {"current_offset": offset})


def torque_ripple(s: Setting) -> Draw:
    amplitude, order, phase = (
        s.between(1.5, 3.5),
        float(s.rng.choice([1, 2, 4, 6])),
        s.shape(0.0, 2.0 * np.pi),
    )
    return Draw(
        {"COG": amplitude, "COG_O": order, "COG_P": phase},
        {"ripple_Nm": amplitude, "ripple_order_per_motor_turn": order, "ripple_phase_rad": phase},
        "motor",
    )


def cubic_stiffness(s: Setting) -> Draw:
    k3 = s.between(2.2e8, 4.2e8)
    return Draw({"K3": k3}, {"cubic_stiffness_Nm_per_rad3": k3}, "transmission")


def piecewise_stiffness(s: Setting) -> Draw:
    k = s.base["K"]
    low, high = s.shape(11.0, 17.0), s.shape(42.0, 54.0)
    second, third = s.between(0.4, 0.65) * k, s.between(0.2, 0.4) * k
    first_knot = low / k
    second_knot = first_knot + (high - low) / (k + second)
    truth: dict[str, float | str] = {
        "knot1_rad": first_knot,
        "knot2_rad": second_knot,
        "stiffness2_Nm_per_rad": k + second,
        "stiffness3_Nm_per_rad": k + second + third,
    }
    changes = {"PW_X1": first_knot, "PW_X2": second_knot, "PW_D1": second, "PW_D2": third}
    return Draw(changes, truth, "transmission")


def hysteresis(s: Setting) -> Draw:
    width = s.between(3.5, 7.0)
    slip = s.shape(0.8, 1.3) * np.array([3e-4, 7e-4, 1.4e-3])
    share = np.array([0.45, 0.35, 0.20])
    changes = {f"HK{i + 1}": float(width * share[i] / slip[i]) for i in range(3)}
    changes |= {f"HS{i + 1}": float(slip[i]) for i in range(3)}
    return Draw(
        changes,
        {"hysteresis_half_width_Nm": width, "longest_slip_rad": float(slip[2])},
        "transmission",
    )


def backlash(s: Setting) -> Draw:
    half = s.between(1.8e-4, 4e-4)
    return Draw({"GAP": half}, {"half_gap_rad": half}, "transmission")


def soft_windup(s: Setting) -> Draw:
    width, share = s.shape(3.5e-4, 6e-4), s.between(0.55, 0.8)
    truth: dict[str, float | str] = {"windup_rad": share * width, "windup_width_rad": width}
    return Draw({"WIND": share * width, "WIND_X": width}, truth, "transmission")


def kinematic_error(s: Setting) -> Draw:
    amplitude, phase = s.between(2.5e-4, 6.5e-4), s.shape(0.0, 2.0 * np.pi)
    order = float(s.rng.choice([1.0, 2.0, 2.0, 4.0]))
    truth: dict[str, float | str] = {
        "kinematic_error_amplitude_rad": amplitude,
        "kinematic_error_order": order,
        "kinematic_error_phase_rad": phase,
    }
    return Draw({"KE1": amplitude, "KE1_O": order, "KE1_P": phase}, truth, "transmission")


def torque_sensor_gain(s: Setting) -> Draw:
    gain = 1.0 + s.between(0.06, 0.12, signed=True)
    return Draw({}, {"torque_sensor_gain": gain}, "sensor", {"torque_gain": gain})


def torque_sensor_offset(s: Setting) -> Draw:
    offset = s.between(2.0, 5.0, signed=True)
    return Draw({}, {"torque_sensor_offset_Nm": offset}, "sensor", {"torque_offset": offset})


def channel_delay(s: Setting) -> Draw:
    drawn = str(s.rng.choice(["motor_current", "link_torque"]))
    channel = drawn if s.base.get("torque_sensor", 1.0) else "motor_current"
    delay = round(s.between(5e-3, 1e-2) / STEP) * STEP
    name = "LAG_I" if channel == "motor_current" else "LAG_T"
    balance = "motor" if channel == "motor_current" else "sensor"
    return Draw(
        {name: float(round(delay / STEP))}, {"delay_s": delay, "delayed_channel": channel}, balance
    )


def _local_bump(s: Setting) -> Draw:
    torque, place, half = s.between(6.0, 10.0), s.shape(-0.6, 0.6), s.shape(0.10, 0.20)
    truth: dict[str, float | str] = {
        "bump_Nm": torque,
        "bump_low_rad": place - half,
        "bump_high_rad": place + half,
    }
    return Draw({"BUMP": torque, "BUMP_X": place, "BUMP_W": half}, truth, "motor")


def _snags(s: Setting) -> Draw:
    torque = s.between(8.0, 14.0)
    return Draw({}, {"snag_Nm": torque}, "motor")


def _odd_order(s: Setting) -> Draw:
    amplitude, order = (
        s.between(3e-4, 6e-4),
        float(np.round(s.rng.choice([2.63, 3.37, 3.71, 5.43]), 2)),
    )
    changes = {"KE1": amplitude, "KE1_O": order, "KE1_P": s.shape(0.0, 2.0 * np.pi)}
    return Draw(
        changes, {"error_amplitude_rad": amplitude, "order_per_motor_turn": order}, "transmission"
    )


def _link_mode(s: Setting) -> Draw:
    share, frequency = min(0.45, s.between(0.18, 0.28)), s.shape(10.0, 12.5)
    changes = {"FLEX": share, "FLEX_F": frequency, "FLEX_Z": 0.015}
    free = frequency / np.sqrt(1.0 - share)
    return Draw(
        changes,
        {
            "mode_inertia_share": share,
            "mode_frequency_hz": frequency,
            "mode_frequency_free_hz": float(free),
        },
        "link",
    )


def _soft_stop(s: Setting) -> Draw:
    rate, start = s.between(60.0, 120.0), s.shape(0.45, 0.65)
    return Draw(
        {"STOP": rate, "STOP_X": start}, {"stop_Nm_per_rad": rate, "stop_begins_rad": start}, "link"
    )


LIBRARY: dict[str, Callable[[Setting], Draw]] = {
    f.__name__: f
    for f in (
        cubic_viscous,
        quadratic_drag,
        asymmetric_coulomb,
        asymmetric_viscous,
        stribeck,
        load_dependent_friction,
        lugre,
        thermal_friction,
        cyclic_friction,
        cyclic_torque,
        added_spring,
        motor_constant_error,
        current_offset,
        torque_ripple,
        cubic_stiffness,
        piecewise_stiffness,
        hysteresis,
        backlash,
        soft_windup,
        kinematic_error,
        torque_sensor_gain,
        torque_sensor_offset,
        channel_delay,
    )
}
"""Effects that have a key in the project's library."""

OUTSIDE: dict[str, Callable[[Setting], Draw]] = {
    "local_bump": _local_bump,
    "snags": _snags,
    "odd_order": _odd_order,
    "link_mode": _link_mode,
    "soft_stop": _soft_stop,
}
"""Kinds that no key names: rubbing in a sector, random snags, gear error of odd order, flexible
link, soft stop.
"""

NEEDS_TORQUE_SENSOR = frozenset({"torque_sensor_gain", "torque_sensor_offset"})
ONE_SIDED_HIDDEN = frozenset(
    {
        "cubic_stiffness",
        "piecewise_stiffness",
        "hysteresis",
        "backlash",
        "soft_windup",
        "kinematic_error",
        "torque_sensor_gain",
        "torque_sensor_offset",
    }
)
"""Effects that a record of the motor side alone is not asked to show (transmission and torque
sensor).
"""
SIDED = frozenset(
    {
        "cubic_viscous",
        "quadratic_drag",
        "asymmetric_coulomb",
        "asymmetric_viscous",
        "stribeck",
        "lugre",
        "load_dependent_friction",
        "cyclic_friction",
        "cyclic_torque",
        "added_spring",
    }
)
"""Effects that can sit on either side."""
