"""Soft wind-up (lost motion)."""

import math
from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import amplitude, shape
from ..signals import Expression, LocalSignals


def _stored(s: LocalSignals, p: SimpleNamespace) -> Expression:
    share = ca.fabs(s.torsion / p.soft_windup_width)
    return (
        -p.soft_windup_torque
        * p.soft_windup_width
        * (share + ca.log1p(ca.exp(-2 * share)) - math.log(2))
    )


@effect(
    "soft_windup",
    title="soft wind-up (lost motion)",
    family="transmission",
    acts_on=("transmission",),
    parameters=(
        amplitude("soft_windup_torque", "N.m", "torque lost to the soft zone", typical=6.0),
        shape(
            "soft_windup_width",
            "rad",
            "torsion over which the soft zone is wound up",
            (0.02, 0.05, 0.1, 0.2, 0.4),
            "torsion",
            start=1e-4,
            low=1e-12,
            high=10.0,
            typical=4e-4,
        ),
    ),
    of_displacement=True,
    absence="the transmission is softer near zero torque",
    excitation="many slow crossings of zero torque",
    source="field knowledge (lost motion below one minute of arc)",
    potential=_stored,
    confused_with=("backlash", "piecewise_stiffness"),
    needs=("transmission_compliance",),
    separate_by="slow crossings of zero torque",
)
def soft_windup(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """What the stiffness carries too much in the soft zone."""
    return -p.soft_windup_torque * ca.tanh(s.torsion / p.soft_windup_width)
