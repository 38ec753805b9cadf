"""The balance of two positions without any torque: the twist against what the link asks for.

What loads the transmission is then the link itself, by its own motion: its inertia, gravity and
friction. In the twist each of them stands divided by the stiffness, so that no torque has a size of
its own: one of them is the unit, the stiffness where nothing else is known.

The law of the transmission is read backwards, from the load to the twist that it needs. Forwards,
as a torque of the twist, a gap as wide as the whole twist explains everything: nothing is carried,
nothing is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

import casadi as ca

from casadi_models import JointModel
from casadi_models.equations import carried
from casadi_models.quantities import linear_unit
from identification.balance.sensing import Sensing
from identification.errors import InputError

Expression = Any

STEPS: Final = 6
"""Newton steps from the load to the twist. A gap takes one, a soft zone that is read from outside
four to rounding, a spring that its own cube outweighs five to 1e-6."""
OUTSIDE: Final = 3.0
"""Widths of a law's soft zone from which its torque is read: there 0.5 % of a hyperbolic tangent is
left of it, and nothing of a gap."""
LEAST_SLOPE: Final = 1e-3
"""Share of the stiffness that a slope counts as at least: a step out of a flat part is long, but no
division by zero."""
BOUNCE: Final = 0.1
"""Share of a gap beyond its sides within which the link still may fly: it bounces where it meets
them, and the gap itself is not known better while it is fitted."""
UNIT_STIFFNESS: Final = 1.0
"""Stiffness where no torque has a size: torques are then in radians of twist [N.m/rad]."""


def held_scale(
    model: JointModel, sensing: Sensing, known: Mapping[str, object]
) -> dict[str, float]:
    """What these channels give no size, and is held: the stiffness, at what is known of it, at the
    model's own value or at one; and what is missing of it in a gap, all of it: the twist jumps by
    the gap alone, whatever its sides carry.

    Parameters
    ----------
    model : JointModel
    sensing : Sensing
    known : mapping
        By parameter, what is known of the joint.

    Raises
    ------
    InputError
        A torque or an inertia is known, the stiffness is not: one of them would have to give way.
    """
    name = model.stiffness_name
    if not sensing.kinematic or name is None:
        return {}
    fixed = {n for n, k in known.items() if getattr(k, "value", None) is not None}
    if name not in fixed and (sized := sorted(fixed & set(_sized(model)))):
        raise InputError(
            f"[known]: {', '.join(sized)} without {name}: two positions without any torque show "
            f"torques as a share of the stiffness only; give {name} in [known] too, or take "
            f"{', '.join(sized)} out"
        )
    value = getattr(known.get(name), "value", None) or model.values.get(name) or UNIT_STIFFNESS
    return dict.fromkeys((name, *model.named("softening")), float(value))


def _sized(model: JointModel) -> tuple[str, ...]:
    """Torques and inertias that stand in the balance, the stiffness aside."""
    held = (str(model.stiffness_name), *model.named("softening"))
    own = {n for t in model.terms if t.place in ("link", "transmission") for n in t.names}
    own |= set(model.inertias)
    return tuple(
        p.name
        for p in model.parameters
        if p.name in own - set(held) and not p.is_shape and p.unit.startswith(("N", "kg"))
    )


def without_scale(model: JointModel, sensing: Sensing, known: Mapping[str, object]) -> str:
    """The sentence that says what torques are worth where none was recorded; else empty."""
    held = held_scale(model, sensing, known).get(str(model.stiffness_name))
    torque, twist = ("N.m", "rad") if model.kind == "rotary" else ("N", "m")
    return (
        f"no torque and no current recorded: the stiffness is held at {held:g} {torque}/{twist}, "
        "and torques and inertias are as far off as it is; angles are what they are. Give the "
        "stiffness in [known] for their size"
        if held is not None and str(model.stiffness_name) not in known
        else ""
    )


def residual_unit(balance: str, kind: str) -> str:
    """Unit of what a balance leaves."""
    unit = "rad" if balance == "kinematic" else "N.m"
    return linear_unit(unit) if kind == "linear" else unit


@final
@dataclass(frozen=True)
class KinematicLaw:
    """The transmission of a model read backwards, on its symbols.

    Attributes
    ----------
    residual : SX
        Twist over what the link's motion needs [rad].
    free : SX
        1 where the twist, as measured, lies where nothing is carried: the link flies free, and may
        be anywhere in the gap.
    gap : SX
        Half the width of that zone [rad].
    """

    residual: Expression
    free: Expression
    gap: Expression


def kinematic_law(model: JointModel) -> KinematicLaw:
    """The balance of the twist against the motion of the link."""
    e = model.equations
    by_name = dict(zip(model.parameter_names, ca.vertsplit(e.parameters), strict=True))
    stiffness = by_name[str(model.stiffness_name)]
    twist, rate = ca.SX.sym("twist"), ca.SX.sym("rate")
    torque, measured_rate = carried(model, model.symbols, twist, rate)
    # what is missing of a stiffness is no more than there is
    for name in model.named("softening"):
        torque = ca.substitute(torque, by_name[name], ca.fmin(by_name[name], stiffness))
    still = ca.substitute(torque, rate, ca.SX(0))
    # damping acts where the two sides touch, as measured
    damping = ca.substitute(
        ca.vertcat(torque - still), ca.vertcat(twist, rate), ca.vertcat(e.torsion, measured_rate)
    )
    load = (
        e.inertia.get("link_inertia", ca.SX(0)) * e.link_acceleration
        + e.link_resistance
        - e.signals.coupling_torque
    ) / e.link_lever - damping
    slope = ca.jacobian(still, twist)
    if not ca.depends_on(slope, twist):
        asked = load - ca.substitute(still, twist, ca.SX(0))
        return KinematicLaw(e.torsion - asked / stiffness, ca.SX(0), ca.SX(0))
    widths = [
        by_name[n]
        for t in model.terms
        if t.place == "transmission"
        for n, p in zip(t.names, t.effect.parameters, strict=True)
        if p.is_shape and p.scale == "torsion" and t.effect.memory is None
    ]
    reach = OUTSIDE * sum(widths, ca.SX(0))
    law = ca.vertcat(still, ca.fmax(slope, LEAST_SLOPE * stiffness))

    def under(torque: Expression, side: Expression) -> Expression:
        found = torque / stiffness + side * reach
        for _ in range(STEPS):
            at = ca.substitute(law, twist, found)
            found = found - (at[0] - torque) / at[1]
        return found

    free = ca.substitute(slope, twist, e.torsion / (1 + BOUNCE)) < LEAST_SLOPE * stiffness
    # the straight part apart: rows take its derivatives on their kernel
    bent = under(load, ca.if_else(load >= 0, 1, -1)) - load / stiffness
    return KinematicLaw(
        e.torsion - load / stiffness - bent, free, ca.fabs(under(ca.SX(0), ca.SX(1)))
    )
