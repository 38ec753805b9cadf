"""What can be hidden in a joint of the recorded world, sized by the joint's own friction, load and
speed.

``size`` scales the strength of a law, never its shape. Library laws bear the key that an answer
must name; laws outside the library have no key, and the right answer is "not in the library", or
the curve itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.random import Generator

    from tests.recorded_world.joints import Plain


@final
@dataclass(frozen=True)
class Law:
    """One hidden law.

    Attributes
    ----------
    values
        Parameters of the integrator.
    truth
        Name and value, with the unit in the name.
    place
        motor, link, transmission or sensor.
    sensor
        Gains, offsets and delays of channels: ``current_offset`` [A], ``torque_gain``,
        ``torque_offset`` [N.m], ``delay_<channel>`` [s].
    pushes
        Rows of length [s], torque [N.m], side; the moments are drawn per record.
    order
        Order of a line, per motor turn (or None).
    absent
        Parameters of the joint without the law, where the plain joint has it (None: the plain
        joint).
    """

    values: Mapping[str, float]
    truth: Mapping[str, float]
    place: str
    sensor: Mapping[str, float] = field(default_factory=dict)
    pushes: tuple[tuple[float, float, float], ...] = ()
    order: float | None = None
    absent: Mapping[str, float] | None = None


@final
@dataclass(frozen=True)
class Setting:
    """What a draw may look at."""

    rng: Generator
    size: float
    joint: Plain
    side: str

    def some(self, low: float, high: float, scale: float = 1.0, *, signed: bool = False) -> float:
        """Uniform draw times scale and size."""
        value = float(self.rng.uniform(low, high)) * scale * self.size
        return -value if signed and self.rng.random() < 0.5 else value

    def shape(self, low: float, high: float, scale: float = 1.0) -> float:
        """Uniform draw that the size does not touch."""
        return float(self.rng.uniform(low, high)) * scale

    @property
    def twist(self) -> float:
        """Twist of the transmission under the highest load."""
        return self.joint.load / self.joint.values["K"]

    def on_side(self, **values: float) -> Law:
        """A law of one side's friction or position torque."""
        named = {f"{self.side}_{k}": v for k, v in values.items()}
        return Law(named, dict(values), "motor" if self.side == "M" else "link")


def cubic_viscous(s: Setting) -> Law:
    return s.on_side(B3=s.some(0.3, 0.5, s.joint.friction / s.joint.make.speed**3))


def quadratic_drag(s: Setting) -> Law:
    return s.on_side(B2=s.some(0.3, 0.5, s.joint.friction / s.joint.make.speed**2))


def asymmetric_coulomb(s: Setting) -> Law:
    return s.on_side(TCA=s.some(0.08, 0.2, s.joint.friction, signed=True))


def asymmetric_viscous(s: Setting) -> Law:
    return s.on_side(BA=s.some(0.15, 0.3, s.joint.friction / s.joint.make.speed, signed=True))


def stribeck(s: Setting) -> Law:
    exponent = float(s.rng.choice([1.0, 2.0]))
    extra = s.some(0.35, 0.6, s.joint.friction)
    return s.on_side(TS=extra, VS=s.shape(0.05, 0.12, s.joint.make.speed), DS=exponent)


def load_dependent_friction(s: Setting) -> Law:
    return s.on_side(MU=s.some(0.05, 0.12))


def lugre(s: Setting) -> Law:
    return s.on_side(ZS=s.some(1.5e-3, 4e-3, s.joint.make.stroke))


def thermal_friction(s: Setting) -> Law:
    fall, constant = s.some(0.2, 0.32), s.shape(5.0, 12.0)
    return Law(
        {"HEAT": fall, "HEAT_T": constant}, {"fall": fall, "time_constant_s": constant}, "motor"
    )


def cyclic_friction(s: Setting) -> Law:
    """At most the side's own Coulomb friction: a band that closes is another law."""
    most = s.joint.values[f"{s.side}_TC"]
    amplitude = min(s.some(0.12, 0.25, s.joint.friction), most)
    return s.on_side(CYC=amplitude, CYC_P=s.shape(0.0, 2.0 * np.pi))


def cyclic_torque(s: Setting) -> Law:
    amplitude, phase = s.some(0.2, 0.4, s.joint.friction), s.shape(0.0, 2.0 * np.pi)
    return s.on_side(SIN=amplitude * np.cos(phase), COS=amplitude * np.sin(phase))


def added_spring(s: Setting) -> Law:
    """A spring or a cable that rests anywhere in the middle half of the travel."""
    stiffness = s.some(0.25, 0.5, s.joint.friction / s.joint.make.stroke)
    return s.on_side(KA=stiffness, KA_Q=s.shape(-0.5, 0.5, s.joint.make.stroke))


def coulomb(s: Setting) -> Law:
    """The plain joint's own Coulomb friction, which the joint file then lacks."""
    value = s.joint.values["M_TC"] * s.size
    return Law({"M_TC": value}, {"motor_coulomb_Nm": value}, "motor", absent={"M_TC": 0.0})


def gravity(s: Setting) -> Law:
    """The plain joint's own gravity, which the joint file then lacks."""
    value = s.joint.values["TG"] * s.size
    return Law({"TG": value}, {"gravity_Nm": value}, "link", absent={"TG": 0.0})


def motor_constant_error(s: Setting) -> Law:
    factor = 1.0 + s.some(0.1, 0.2, signed=True)
    return Law({"KM": factor}, {"motor_constant_factor": factor}, "motor")


def current_offset(s: Setting) -> Law:
    offset = s.some(0.08, 0.2, s.joint.friction / s.joint.make.per_current, signed=True)
    return Law({}, {"current_offset_A": offset}, "motor", {"current_offset": offset})


def torque_ripple(s: Setting) -> Law:
    order = float(s.rng.choice([1, 2, 4]))
    amplitude, phase = s.some(0.08, 0.16, s.joint.friction), s.shape(0.0, 2.0 * np.pi)
    truth = {"ripple_Nm": amplitude, "order_per_motor_turn": order}
    return Law({"COG": amplitude, "COG_O": order, "COG_P": phase}, truth, "motor", order=order)


def cubic_stiffness(s: Setting) -> Law:
    k3 = s.some(0.2, 0.4, s.joint.load / s.twist**3)
    return Law({"K3": k3}, {"cubic_stiffness_Nm_per_rad3": k3}, "transmission")


def piecewise_stiffness(s: Setting) -> Law:
    k, d = s.joint.values["K"], s.twist
    values = {
        "X1": s.shape(0.12, 0.18, d),
        "X2": s.shape(0.36, 0.46, d),
        "D1": s.some(0.4, 0.65, k),
        "D2": s.some(0.2, 0.4, k),
    }
    return Law(values, values, "transmission")


def hysteresis(s: Setting) -> Law:
    width, slip = s.some(0.04, 0.07, s.joint.load), s.shape(0.05, 0.08, s.twist)
    share, reach = (0.45, 0.35, 0.2), (1.0, 2.3, 4.7)
    values = {f"HK{i + 1}": width * share[i] / (slip * reach[i]) for i in range(3)}
    values |= {f"HS{i + 1}": slip * reach[i] for i in range(3)}
    return Law(values, {"half_width_Nm": width}, "transmission")


def backlash(s: Setting) -> Law:
    half = s.some(0.04, 0.09, s.twist)
    return Law({"GAP": half}, {"half_gap_rad": half}, "transmission")


def soft_windup(s: Setting) -> Law:
    width, share = s.shape(0.08, 0.13, s.twist), s.some(0.55, 0.8)
    return Law(
        {"WIND": share * width, "WIND_X": width}, {"windup_rad": share * width}, "transmission"
    )


def kinematic_error(s: Setting) -> Law:
    order = float(s.rng.choice([1.0, 2.0, 4.0]))
    # the error's slope stays under a fifth: more would be a broken gear
    amplitude = min(s.some(0.05, 0.13, s.twist), 0.2 / (order * s.joint.make.ratio))
    values = {"KE1": amplitude, "KE1_O": order, "KE1_P": s.shape(0.0, 2.0 * np.pi)}
    return Law(
        values, {"error_rad": amplitude, "order_per_motor_turn": order}, "transmission", order=order
    )


def torque_sensor_gain(s: Setting) -> Law:
    gain = 1.0 + s.some(0.06, 0.12, signed=True)
    return Law({}, {"torque_gain": gain}, "sensor", {"torque_gain": gain})


def torque_sensor_offset(s: Setting) -> Law:
    offset = s.some(0.03, 0.06, s.joint.load, signed=True)
    return Law({}, {"torque_offset_Nm": offset}, "sensor", {"torque_offset": offset})


def channel_delay(s: Setting) -> Law:
    delay = s.some(5e-3, 1e-2)
    return Law({}, {"current_delay_s": delay}, "motor", {"delay_motor_current": delay})


def odd_curve(s: Setting) -> Law:
    """A smooth odd curve of velocity: three tanh of random width and sign."""
    f, top = s.joint.friction, s.joint.make.speed
    values: dict[str, float] = {}
    for i, reach in enumerate(np.sort(np.exp(s.rng.uniform(np.log(0.05), np.log(0.8), 3))), 1):
        values |= {f"O{i}": s.some(0.15, 0.45, f, signed=True), f"V{i}": float(reach) * top}
    return s.on_side(**values)


def position_bump(s: Setting) -> Law:
    """Rubbing in a sector, in both directions."""
    place, width = s.shape(-0.4, 0.4, s.joint.make.stroke), s.shape(0.08, 0.16, s.joint.make.stroke)
    return s.on_side(BUMP=s.some(0.3, 0.5, s.joint.friction), BUMP_X=place, BUMP_W=width)


def one_sided_snag(s: Setting) -> Law:
    """A narrow catch that is felt in one direction only."""
    place, width = s.shape(-0.4, 0.4, s.joint.make.stroke), s.shape(0.02, 0.05, s.joint.make.stroke)
    way = float(s.rng.choice([-1.0, 1.0]))
    return s.on_side(BUMP=s.some(0.5, 0.9, s.joint.friction), BUMP_X=place, BUMP_W=width, ONE=way)


def warm_up(s: Setting) -> Law:
    """Friction that falls within the first seconds, over and done before the record's half."""
    fall, constant = s.some(0.3, 0.5), s.shape(1.5, 3.0)
    return Law(
        {"HEAT": fall, "HEAT_T": constant}, {"fall": fall, "time_constant_s": constant}, "motor"
    )


def saturation(s: Setting) -> Law:
    """Torque that falls behind the current: iron in saturation."""
    level = (s.joint.load + s.joint.friction) * s.shape(1.1, 1.6) / s.size
    return Law({"SAT": level}, {"saturation_Nm": level}, "motor")


def touch(s: Setting) -> Law:
    """Something leans on the link for about a second, twice in a record."""
    torque = s.some(0.4, 0.9, s.joint.friction, signed=True)
    rows = tuple((s.shape(0.7, 1.4), torque, 1.0) for _ in range(2))
    return Law({}, {"touch_Nm": torque}, "link", pushes=rows)


LIBRARY: Final[Mapping[str, Callable[[Setting], Law]]] = {
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
        coulomb,
        gravity,
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
OUTSIDE: Final[Mapping[str, Callable[[Setting], Law]]] = {
    f.__name__: f for f in (odd_curve, position_bump, one_sided_snag, warm_up, saturation, touch)
}
SIDED: Final = frozenset(
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
TRANSMISSION: Final = frozenset(
    {
        "cubic_stiffness",
        "piecewise_stiffness",
        "hysteresis",
        "backlash",
        "soft_windup",
        "kinematic_error",
    }
)
OF_TORQUE_SENSOR: Final = frozenset({"torque_sensor_gain", "torque_sensor_offset"})
OF_MOTOR: Final = tuple(
    n for n in LIBRARY if n not in TRANSMISSION | OF_TORQUE_SENSOR | {"gravity"}
)


def fits(name: str, joint: Plain) -> bool:
    """Whether a law makes sense in a joint: no second gap, no angle laws on a linear axis,
    gravity only where it is.
    """
    if name in ("gravity", "load_dependent_friction"):
        return joint.values["TG"] > 0.25 * joint.friction
    if name == "backlash":
        return joint.values["GAP"] == 0.0
    if joint.make.linear:
        return name not in ("cyclic_torque", "cyclic_friction")
    return True


def visible(name: str, sensors: str) -> bool:
    """Whether these sensors are asked to show a law."""
    if name in OF_TORQUE_SENSOR:
        return sensors in ("all", "motor_torque")
    if name in TRANSMISSION:
        return sensors in ("all", "encoders")
    if name == "motor_constant_error":  # without a torque the constant is a matter of scale
        return sensors in ("all", "motor_torque")
    return True
