"""Direction-dependent viscous friction."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


@effect(
    "asymmetric_viscous",
    title="direction-dependent viscous friction",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        signed(
            "asymmetric_viscous",
            "N.m.s/rad",
            "half the difference of the viscous coefficients of the two directions",
            typical=3.0,
        ),
    ),
    absence="the slope of the residual against velocity differs between the directions",
    excitation="both directions at several speeds",
    source="field knowledge",
    needs=("viscous",),
)
def asymmetric_viscous(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque in proportion to the speed, same sign in both directions."""
    return p.asymmetric_viscous * ca.fabs(s.velocity)
