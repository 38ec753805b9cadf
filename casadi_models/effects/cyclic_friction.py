"""Friction that changes with position."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


@effect(
    "cyclic_friction",
    title="friction that changes with position",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        signed(
            "cyclic_friction_sine",
            "N.m",
            "sine part of the change of friction per turn of the link",
            typical=3.0,
        ),
        signed(
            "cyclic_friction_cosine",
            "N.m",
            "cosine part of the change of friction per turn of the link",
            typical=2.0,
        ),
    ),
    pairs=(("cyclic_friction", "cyclic_friction_sine", "cyclic_friction_cosine"),),
    absence="the friction band breathes with the position",
    excitation="long strokes in both directions",
    source="dissipative form of thesis eq. 2.80",
    angular=True,
    needs=("coulomb",),
    confused_with=("load_dependent_friction",),
    separate_by="a run with another payload",
)
def cyclic_friction(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Friction whose size follows the position; it changes sign with the velocity."""
    return (
        p.cyclic_friction_sine * ca.sin(s.position) + p.cyclic_friction_cosine * ca.cos(s.position)
    ) * s.direction
