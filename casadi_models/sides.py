"""From the motor shaft to the link: the factor of a parameter follows from its unit and its law.

A law of a motor-side value sees the motor's own coordinates, q_M = n q, and gives a torque on the
motor shaft; the link feels n times that torque. The size of the factor follows from the unit
(:func:`casadi_models.quantities.side_power`). Where n is negative the two coordinates also run
against each other: a parameter whose law keeps its sign when the joint is mirrored, such as an
offset, then changes its own.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, Final

import casadi as ca

from .effect import Effect
from .parameter import Parameter
from .quantities import side_power
from .signals import LocalSignals

_POINTS: Final = (
    LocalSignals(
        0.31,
        0.043,
        acceleration=0.9,
        direction=0.6,
        torsion=0.27,
        torsion_rate=0.051,
        torque=8.3,
        load=7.1,
        reading=6.7,
        reading_rate=2.3,
        motor_angle=1.9,
        time=0.4,
        temperature=11.0,
        memory=(),
        gear_ratio=3.0,
        clock=1e-3,
    ),
    LocalSignals(
        0.83,
        0.017,
        acceleration=1.7,
        direction=0.3,
        torsion=0.61,
        torsion_rate=0.023,
        torque=3.9,
        load=5.3,
        reading=2.9,
        reading_rate=4.1,
        motor_angle=0.7,
        time=1.1,
        temperature=17.0,
        memory=(),
        gear_ratio=3.0,
        clock=1e-3,
    ),
)
"""Two motions without symmetry, on which a law is compared with its mirror image."""
_ALIKE: Final = 1e-9
"""Relative difference up to which two values of a law count as equal: rounding, a thousand
times over.
"""


def side_factor(effect: Effect | None, parameter: Parameter, gear_ratio: float) -> float:
    """What a motor-side value is multiplied by to refer it to the link.

    Parameters
    ----------
    effect : Effect or None
        Whose parameter it is; None for inertias and other parameters of the joint itself.
    parameter : Parameter
        As the effect declares it.
    gear_ratio : float
        theta_motor / theta_link, with its sign.
    """
    size = abs(gear_ratio) ** side_power(parameter.unit)
    turned = gear_ratio < 0 and effect is not None and mirrors(effect, parameter.name)
    return -size if turned else size


@lru_cache(maxsize=512)
def mirrors(effect: Effect, name: str) -> bool:
    """True where a parameter changes its sign with the sense in which positions are counted.

    Parameters
    ----------
    effect : Effect
    name : str
        Of one of its parameters, as declared. A shape never changes its sign.
    """
    if any(p.is_shape for p in effect.parameters if p.name == name):
        return False
    values = {p.name: p.start if p.is_shape else 0.0 for p in effect.parameters}
    plus, minus = ({**values, name: size} for size in (0.01, -0.01))
    odd = all(
        _alike(_law(effect, s, plus), -_law(effect, _mirror(s), plus)) for s in _points(effect)
    )
    even = all(
        _alike(_law(effect, s, plus), -_law(effect, _mirror(s), minus)) for s in _points(effect)
    )
    return even and not odd


def _points(effect: Effect) -> list[LocalSignals]:
    states = tuple(0.2 + 0.1 * i for i in range(effect.states))
    return [replace(s, memory=states) for s in _POINTS]


def _mirror(s: LocalSignals) -> LocalSignals:
    """The same motion counted the other way on the link; the motor shaft itself stays what it
    is.
    """
    turned = (
        "position",
        "velocity",
        "acceleration",
        "direction",
        "torsion",
        "torsion_rate",
        "torque",
        "load",
        "reading",
        "reading_rate",
        "gear_ratio",
    )
    return replace(s, memory=tuple(-z for z in s.memory), **{n: -getattr(s, n) for n in turned})


def _law(effect: Effect, s: LocalSignals, values: dict[str, float]) -> float:
    found: Any = effect.law(s, SimpleNamespace(**values))
    return float(ca.DM(found))


def _alike(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=_ALIKE, abs_tol=0.0)
