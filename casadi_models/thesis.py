"""Parameter sets of the thesis (A. R. da Silva, INPE-8981-TDI/812/B), each with its source, and
ready models.

The thesis sets N = 1 after eq. 4.12, so its tables are referred to the link. :func:`to_link` and
:func:`to_motor` convert between the sides: a motor angle is |N| times a link angle, a link torque
|N| times a motor torque, so that a stiffness changes by N^2, a cubic stiffness by N^4, a viscous
coefficient by N^2 and a Coulomb torque by N.

The raw measurements of the thesis are not public. Models built here simulate with its numbers; they
do not repeat its experiments.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal, final

from .joint import JointModel
from .parameter import Side
from .quantities import UnitError, side_power

Variant = Literal["coupled", "y1", "y2"]


@final
@dataclass(frozen=True)
class Value:
    """One number of the thesis.

    Attributes
    ----------
    value : float
    unit : str
    side : {"motor", "gear", "link", "sensor", "none"}
        Part of the joint that it belongs to.
    source : str
        Table, equation or section.
    referred_to : {"link", "motor"}
        Side to which the number itself is referred.
    """

    value: float
    unit: str
    side: Side
    source: str
    referred_to: Literal["link", "motor"] = "link"


def _set(source: str, **rows: tuple[float, str, Side]) -> Mapping[str, Value]:
    return MappingProxyType({name: Value(*row, source) for name, row in rows.items()})


def _rigid(
    row: str, inertia: float, gravity: float, coulomb: float | None = None
) -> Mapping[str, Value]:
    source = f"table 4.2, {row}"
    found = {"link_inertia": Value(inertia, "kg.m2", "link", source)}
    found["gravity_torque"] = Value(gravity, "N.m", "link", source)
    if coulomb is not None:
        found["motor_coulomb"] = Value(coulomb, "N.m", "motor", source)
    return MappingProxyType(found)


REDUCTION: Final = 160.0
"""N (table 4.1)."""
GEAR_RATIO: Final = -REDUCTION
"""theta_in / theta_out of the IRJ: circular spline fixed, flexspline out (eq. 2.66, 2.67)."""

TABLE_2_3: Final = _set(
    "table 2.3 (catalogue; T1, T2 as printed)",
    k1=(3.1e4, "N.m/rad", "gear"),
    k2=(5.0e4, "N.m/rad", "gear"),
    k3=(5.7e4, "N.m/rad", "gear"),
    knot_1=(7.0, "N.m", "gear"),
    knot_2=(25.0, "N.m", "gear"),
    range=(150.0, "N.m", "gear"),
    relative_position=(math.radians(0.15), "rad", "gear"),
)
"""Piecewise stiffness of the gear, and the ranges of torque and of relative position."""

TABLE_4_1: Final = _set(
    "table 4.1",
    torque_per_count=(0.00746, "N.m", "motor"),
    motor_inertia=(4.447, "kg.m2", "motor"),
    link_inertia=(10.277, "kg.m2", "link"),
    gravity_torque=(105.18, "N.m", "link"),
    stiffness=(4.278e4, "N.m/rad", "gear"),
    cubic_stiffness=(1.174e9, "N.m/rad3", "gear"),
)
"""Catalogue, curve fit and design values; `torque_per_count` is N Km per current increment."""

TORQUE_PER_COUNT: Final = Value(
    0.00884, "N.m", "motor", "section 4.3.2, identified, per current increment"
)
STIFFNESS_2A: Final = Value(5.2815e4, "N.m/rad", "gear", "section 4.3.2, model 2a")

TABLE_4_2: Final[Mapping[str, Mapping[str, Value]]] = MappingProxyType(
    {
        "1a_y1": _rigid("1a, y1", 8.7143, 108.570),
        "1a_y2": _rigid("1a, y2", 9.9550, 112.672),
        "1a_coupled": _rigid("1a, coupled", 9.3346, 110.621),
        "1b_y1": _rigid("1b, y1", 8.4032, 111.277, 28.1358),
        "1b_y2": _rigid("1b, y2", 9.9550, 112.672),
        "1b_coupled": _rigid("1b, coupled", 9.1791, 111.975, 28.1442),
    }
)
"""Rigid models; `y1`, `y2`: decoupled, identified from that output alone."""

TABLE_4_3: Final = _set(
    "table 4.3",
    stiffness=(2.1513e4, "N.m/rad", "gear"),
    cubic_stiffness=(3.3543e8, "N.m/rad3", "gear"),
    motor_added_spring=(86.2313, "N.m/rad", "motor"),
    motor_coulomb=(21.5057, "N.m", "motor"),
    motor_viscous=(23.6303, "N.m.s/rad", "motor"),
    link_coulomb=(0.4124, "N.m", "link"),
    link_viscous=(9.7285, "N.m.s/rad", "link"),
)
"""Model 2b (eq. 4.17). The thesis prints ka theta_in in both rows; here it acts on the motor."""

TABLE_4_4: Final = _set(
    "table 4.4",
    stiffness=(0.0338, "1", "none"),
    cubic_stiffness=(1.33e-7, "1", "none"),
    motor_added_spring=(18.0883, "1", "none"),
    motor_coulomb=(36.0278, "1", "none"),
    motor_viscous=(15.6012, "1", "none"),
    link_viscous=(15.6400, "1", "none"),
    link_coulomb=(36.0278, "1", "none"),
)
"""Singular values of the measurement matrix of model 2b."""

TABLE_4_5: Final = _set(
    "table 4.5",
    stiffness=(0.0338, "1", "none"),
    cubic_stiffness=(1.33e-7, "1", "none"),
    motor_added_spring=(18.0883, "1", "none"),
    motor_coulomb=(35.8555, "1", "none"),
    motor_smooth_stribeck=(0.0272, "1", "none"),
    motor_viscous=(15.5951, "1", "none"),
    link_viscous=(15.6339, "1", "none"),
    link_cyclic_torque_sine=(12.3118, "1", "none"),
    link_cyclic_torque_cosine=(33.8440, "1", "none"),
)
"""Singular values of the measurement matrix of the TS model."""

TABLE_4_6: Final = _set(
    "table 4.6; exponent: section 4.3.4.2",
    motor_viscous=(9.0, "N.m.s/rad", "motor"),
    motor_coulomb=(29.0, "N.m", "motor"),
    motor_smooth_stribeck=(480.0, "N.m.s/rad", "motor"),
    motor_smoothing_velocity=(0.0595, "rad/s", "motor"),
    motor_smooth_stribeck_velocity=(0.0251, "rad/s", "motor"),
    motor_smooth_stribeck_exponent=(1.0, "1", "motor"),
)
"""Friction of the time-variant test, eq. 4.18: b, C1, C2, w1, wS, dS."""

CYCLIC: Final = MappingProxyType(
    {
        "link_cyclic_torque_sine": Value(
            3.7 * math.cos(math.radians(0.05)), "N.m", "link", "section 4.3.4.1"
        ),
        "link_cyclic_torque_cosine": Value(
            3.7 * math.sin(math.radians(0.05)), "N.m", "link", "section 4.3.4.1"
        ),
    }
)
"""Cyclic torque of 3.7 N.m at a phase of 0.05 degrees."""

TIME_VARIANT: Final = MappingProxyType({"linear": (16.0, 1.3), "nonlinear": (27.0, 1.2)})
"""Section 4.3.4.2: time [s] at which linear and nonlinear friction parameters change, and the
factor.
"""

TABLE_B_1: Final = MappingProxyType(
    {
        "torque": Value(0.05, "N.m", "sensor", "table B.1"),
        "link_position": Value(math.radians(0.0036), "rad", "link", "table B.1, encoder"),
        "motor_position": Value(
            math.radians(0.0010), "rad", "motor", "table B.1, Hall sensor", "motor"
        ),
        "current_bits": Value(15.0, "1", "motor", "table B.1", "motor"),
        "acceleration": Value(9.6e-3, "m/s2", "link", "table B.1 (0.00098 g)"),
    }
)
"""Accuracy or resolution of the sensors."""


def to_link(value: float, unit: str, reduction: float = REDUCTION) -> float:
    """A motor-side value referred to the link: times |N| to the power that its unit says.

    Parameters
    ----------
    value : float
        In `unit`, referred to the motor shaft.
    unit : str
        Unit of the value; it decides the power: k N^2, k2 N^4, b N^2, Coulomb N, inertia N^2, angle
        1/N.
    reduction : float
        N; its sign is of no account (a torque amplitude has none).

    Raises
    ------
    ValueError
        Unit without a known power; reduction 0.
    """
    return value * _factor(unit, reduction)


def to_motor(value: float, unit: str, reduction: float = REDUCTION) -> float:
    """A link-referred value on the motor shaft: k/N^2, k2/N^4, b/N^2, Coulomb/N, inertia/N^2,
    angle times N.
    """
    return value / _factor(unit, reduction)


def _factor(unit: str, reduction: float) -> float:
    if reduction == 0:
        raise ValueError("reduction 0: give N, the motor turns per link turn")
    try:
        return float(abs(reduction) ** side_power(unit))
    except UnitError as error:
        raise ValueError(f"unit {unit!r}: no rule to change its side ({error})") from None


def numbers(*tables: Mapping[str, Value]) -> dict[str, float]:
    """Values of one or several tables by parameter name; a later table replaces an earlier one."""
    return {name: v.value for table in tables for name, v in table.items()}


def _model(name: str, *tables: Mapping[str, Value]) -> JointModel:
    model = JointModel.by_name(name, GEAR_RATIO)
    known = set(model.parameter_names)
    return model.with_values({n: v for n, v in numbers(TABLE_4_1, *tables).items() if n in known})


def model_1a(variant: Variant = "coupled") -> JointModel:
    """Model 1a: rigid, inertias and gravity (tables 4.1, 4.2).

    Parameters
    ----------
    variant : {"coupled", "y1", "y2"}
        Row of table 4.2: identified together, or from one output alone.
    """
    return _model("irj1a", TABLE_4_2[f"1a_{variant}"])


def model_1b(variant: Variant = "coupled") -> JointModel:
    """Model 1b: model 1a with Coulomb friction on the motor side (table 4.2).

    The output y2 has no motor friction: its row leaves the Coulomb torque at 0.
    """
    return _model("irj1b", TABLE_4_2[f"1b_{variant}"])


def model_2a() -> JointModel:
    """Model 2a: stiffness only, k1 of section 4.3.2, without the cubic part that did not
    improve it.
    """
    return _model(
        "irj2a",
        {"stiffness": STIFFNESS_2A, "cubic_stiffness": Value(0.0, "N.m/rad3", "gear", "4.3.2")},
    )


def model_2b() -> JointModel:
    """Model 2b: stiffness, added spring, viscous and Coulomb friction on both sides (eq.

    4.17, table 4.3).
    """
    return _model("irj2b", TABLE_4_3)


def model_ts() -> JointModel:
    """TS model (eq. 4.18 to 4.21): springs and link side of table 4.3, motor friction of table
    4.6, cyclic torque.
    """
    return _model("irj_ts", TABLE_4_3, TABLE_4_6, CYCLIC)


def catalogue_stiffness(knots: tuple[float, float] | None = None) -> JointModel:
    """Model 3 with the piecewise stiffness of the catalogue (tables 2.3 and 4.1).

    Parameters
    ----------
    knots : (T1, T2), optional
        Torques of the knots [N.m]; 7 and 25 as printed by default. Gears of size 25 have 14 and 48,
        and the curve fit of eq. 2.69 lies closer to those.
    """
    t = numbers(TABLE_2_3)
    low, high = knots or (t["knot_1"], t["knot_2"])
    first = low / t["k1"]
    model = JointModel.harmonic_drive(3, gear_ratio=GEAR_RATIO).add("piecewise_stiffness")
    known = numbers(TABLE_4_1)
    return model.with_values(
        {
            "motor_inertia": known["motor_inertia"],
            "link_inertia": known["link_inertia"],
            "stiffness": t["k1"],
            "stiffness_step_1": t["k2"] - t["k1"],
            "stiffness_step_2": t["k3"] - t["k2"],
            "stiffness_knot_1": first,
            "stiffness_knot_2": first + (high - low) / t["k2"],
        }
    )
