"""Energy of a joint: kinetic, and what springs and position-dependent torques store."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import casadi as ca
import numpy as np

from .equations import Equations, Solvable
from .signals import Expression, LocalSignals
from .term import Term

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_PANELS: Final = 8


def total_energy(model: Solvable) -> Expression:
    """Energy [J] as an expression of the signals and parameters of ``model.true_equations``.

    Counted: both inertias with what inertia effects without states add, springs of the transmission
    and of the torque sensor, torques of family "torque". Not counted: what internal states store.
    """
    e = model.true_equations
    s = e.signals
    total: Expression = ca.SX(0)
    speeds = (s.motor_velocity, s.link_velocity)
    for inertia, speed in zip(e.inertia.values(), speeds, strict=False):
        total = total + inertia * speed**2 / 2
    for term in model.terms:
        total = total + _stored(model, term, e)
    return total


def _stored(model: Solvable, term: Term, e: Equations) -> Expression:
    """Energy that one term stores."""
    effect, s = term.effect, e.signals
    if effect.states or effect.dissipative:
        return ca.SX(0)
    link = term.place == "link"
    if effect.family == "inertia" and term.place in ("motor", "link"):
        speed = s.link_velocity if link else s.motor_velocity
        return _slope(model, term, "acceleration") * speed**2 / 2
    if term.place == "transmission" and model.is_elastic:
        return _potential(model, term, e.beyond[term])
    if term.place == "torsion" and model.is_elastic:
        return _slope(model, term, "torque") * s.torque**2 / 2
    if effect.family == "torque" and term.place in ("motor", "link"):
        return _potential(model, term, s.link_position if link else s.motor_position)
    return ca.SX(0)


def _values(model: Solvable, term: Term) -> Any:
    symbols = ca.vertsplit(model.true_equations.parameters)
    return term.bound(dict(zip(model.parameter_names, symbols, strict=True)))


def _slope(model: Solvable, term: Term, signal: str) -> Expression:
    """Slope of a law against one signal: the inertia or the compliance that it adds."""
    symbol = ca.SX.sym(signal)
    changed: dict[str, Expression] = {signal: symbol}
    still = replace(_still(model, ca.SX(0)), **changed)
    return ca.jacobian(term.effect.law(still, _values(model, term)), symbol)


def _potential(model: Solvable, term: Term, upto: Expression) -> Expression:
    """Integral of the law of a term along its own coordinate from 0 to `upto`."""
    values = _values(model, term)
    if term.effect.potential is not None:
        return term.effect.potential(_still(model, upto), values)
    total: Expression = ca.SX(0)
    for panel in range(_PANELS):
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            share = (panel + (node + 1) / 2) / _PANELS
            total = total + weight / 2 / _PANELS * term.effect.law(
                _still(model, upto * share), values
            )
    return total * upto


def _still(model: Solvable, at: Expression) -> LocalSignals:
    """A joint at rest in one position (or torsion)."""
    nothing = ca.SX(0)
    return LocalSignals(
        position=at,
        velocity=nothing,
        acceleration=nothing,
        direction=nothing,
        torsion=at,
        torsion_rate=nothing,
        torque=nothing,
        load=nothing,
        reading=nothing,
        reading_rate=nothing,
        motor_angle=at * model.gear_ratio,
        time=nothing,
        temperature=nothing,
        memory=(),
        gear_ratio=ca.SX(model.gear_ratio),
    )
