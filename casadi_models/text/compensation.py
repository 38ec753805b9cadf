"""What a controller adds to compensate a joint: its friction as a function of the motion, and the
load that it carries at rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, final

import casadi as ca

from ..equations import PlacedLaw, placed_laws
from ..signals import Expression, Signals

if TYPE_CHECKING:
    from ..joint import JointModel

SETTLED: Final = 1e6
"""Way over which a joint has slid, so that laws with memory have settled [rad]: far beyond any
presliding distance.
"""
INPUTS: Final = ("position", "velocity", "load", "temperature")
"""Inputs before the parameters: [rad, rad/s, N.m, K], link-referred."""
_SIDES: Final = ("motor", "link")


@final
@dataclass(frozen=True)
class RestingLoad:
    """What the drive holds at rest, link-referred [N.m], N on a linear axis.

    The drive that holds the joint at a position q is
    ``constant - sine * sin(q) - cosine * cos(q)``.

    Attributes
    ----------
    sine, cosine : float
        Parts of the link's weight, with the signs of the parameters of gravity: the sine part is
        positive upright at zero.
    constant : float
        Sum of the laws that depend on nothing: the weight of a linear axis, an offset of the drive.
    """

    sine: float
    cosine: float
    constant: float

    def drive(self, position: Any) -> Any:
        """The drive that holds it, from a number or an expression of the position."""
        return self.constant - self.sine * ca.sin(position) - self.cosine * ca.cos(position)


def resting_load(model: JointModel) -> RestingLoad:
    """The load of a model at rest, with the model's values.

    What changes with the position by a law other than gravity (a spring, a torque per turn) is no
    part of it, nor is friction, which holds by itself.
    """
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    upright = model.named("weight")
    return RestingLoad(
        sine=sum(values[n] for n in upright),
        cosine=sum(values[n] for n in model.weights if n not in upright),
        constant=_constant_load(model),
    )


def _constant_load(model: JointModel) -> float:
    """What the laws on motor and link that depend on nothing resist with, less what such laws of
    the drive add.
    """
    symbols = model.symbols
    s, zero = symbols.signals, ca.SX(0)
    # at rest everything else is zero; what still hangs on one of these is no constant
    staying = ("motor_position", "link_position", "torque", "drive")
    moving = [getattr(s, n) for n in Signals.names() if n not in staying]
    where = ca.vertcat(*(getattr(s, n) for n in staying))
    p = ca.vertcat(*(symbols.parameters[n] for n in model.parameter_names))
    total = 0.0
    for x in placed_laws(model, symbols, zero, zero):
        held = x.term.place in (*_SIDES, "drive") and x.term.effect.family != "friction"
        if not held or x.states:
            continue
        (law,) = ca.substitute([x.law], moving, [zero] * len(moving))
        if ca.depends_on(law, where):
            continue
        found = float(ca.Function("law", [p], [law])(model.value_vector()))
        # a typed law may have no value at rest
        total += (-found if x.term.place == "drive" else found) if math.isfinite(found) else 0.0
    return total


def friction_compensation(model: JointModel) -> Any:
    """CasADi function (position, velocity, load, temperature, p) -> friction torque [N.m].

    The sum of the friction laws on motor and link at a steady velocity, both sides alike,
    link-referred; a controller adds it to the drive. Laws with memory have settled; `load` is the
    torque that the gear puts into the link.

    Parameters
    ----------
    model : JointModel

    Raises
    ------
    ValueError
        A model without friction on motor or link.
    """
    symbols = model.symbols
    zero = ca.SX(0)
    laws = [
        x
        for x in placed_laws(model, symbols, zero, zero)
        if x.term.place in _SIDES and x.term.effect.family == "friction"
    ]
    if not laws:
        raise ValueError("the model has no friction on motor or link")
    given = {n: ca.SX.sym(n) for n in INPUTS}
    s = symbols.signals
    known = {
        "motor_position": "position",
        "link_position": "position",
        "motor_velocity": "velocity",
        "link_velocity": "velocity",
        "torque": "load",
        "temperature": "temperature",
    }
    old = [getattr(s, n) for n in Signals.names()]
    new = [given[known[n]] if n in known else zero for n in Signals.names()]
    way = ca.sign(given["velocity"]) * SETTLED
    (total,) = ca.substitute([_total(laws, way)], old, new)
    p = model.true_equations.parameters
    inputs = [*given.values(), p]
    return ca.Function("friction_compensation", inputs, [total], [*INPUTS, "p"], ["torque"])


def _total(laws: list[PlacedLaw], way: Expression) -> Expression:
    """Sum of the laws with the states that they have after a long way."""
    total: Expression = ca.SX(0)
    for x in laws:
        law = x.law
        if x.states:
            start = [ca.SX(0)] * len(x.states)
            settled = ca.substitute(list(x.moved), [*x.states, x.step], [*start, way])
            (law,) = ca.substitute([law], list(x.states), settled)
        total = total + law
    return total


__all__ = ["INPUTS", "SETTLED", "RestingLoad", "friction_compensation", "resting_load"]
