"""The friction of a joint alone, as a function of the motion: what a controller adds to
compensate it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

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


__all__ = ["INPUTS", "SETTLED", "friction_compensation"]
