"""Quadratic drag."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


@effect(
    "quadratic_drag",
    title="quadratic drag",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        signed(
            "quadratic_drag",
            "N.m.s2/rad2",
            "coefficient of velocity times its magnitude",
            typical=8.0,
        ),
    ),
    absence="the residual bends against velocity, odd in it",
    excitation="at least three speeds, up to the highest",
    source="field knowledge (churning, windage)",
    confused_with=("cubic_viscous",),
    needs=("viscous",),
    separate_by="a run at three or more constant speeds up to the highest",
)
def quadratic_drag(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque with the squared speed against the motion."""
    return p.quadratic_drag * s.velocity * ca.fabs(s.velocity)
