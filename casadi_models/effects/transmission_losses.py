"""Losses of the transmission."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


@effect(
    "transmission_losses",
    title="losses of the transmission",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        signed("loss_constant", "N.m", "constant part", typical=12.0),
        signed("loss_viscous", "N.m.s/rad", "part in proportion to velocity", typical=8.0),
        signed(
            "loss_cubic", "N.m.s3/rad3", "part in proportion to the cubed velocity", typical=2.0
        ),
        signed("loss_sine", "N.m", "sine part per turn", typical=1.0),
        signed("loss_cosine", "N.m", "cosine part per turn", typical=0.5),
    ),
    parts=("coulomb", "viscous", "cubic_viscous", "cyclic_friction"),
    absence="the ideal transmission fails whenever the joint moves",
    excitation="several speeds in both directions",
    source="thesis eq. 2.36 to 2.39 (step from model 1 to model 2)",
    confused_with=("coulomb", "viscous", "cubic_viscous", "cyclic_friction"),
)
def transmission_losses(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Constant, viscous, cubic and cyclic loss."""
    return (
        (p.loss_constant + p.loss_sine * ca.sin(s.position) + p.loss_cosine * ca.cos(s.position))
        * s.direction
        + p.loss_viscous * s.velocity
        + p.loss_cubic * s.velocity**3
    )
