"""Cubic viscous friction."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


@effect(
    "cubic_viscous",
    title="cubic viscous friction",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        signed(
            "cubic_viscous",
            "N.m.s3/rad3",
            "coefficient of the cubed velocity (negative: shear thinning)",
            typical=8.0,
        ),
    ),
    contains=("viscous",),
    absence="the residual bends against velocity, odd in it",
    excitation="at least three speeds, up to the highest",
    source="thesis eq. 2.71",
    confused_with=("quadratic_drag",),
    needs=("viscous",),
    separate_by="a run at three or more constant speeds up to the highest",
)
def cubic_viscous(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque of the cubic part."""
    return p.cubic_viscous * s.velocity**3
