"""backlash."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import amplitude, shape
from ..signals import Expression, LocalSignals


@effect(
    "backlash",
    title="backlash",
    family="transmission",
    acts_on=("transmission",),
    parameters=(
        amplitude("backlash_stiffness_loss", "N.m/rad", "stiffness that is missing inside the gap"),
        shape("backlash", "rad", "half the gap", (0.02, 0.05, 0.1, 0.2, 0.4), "torsion", start=1e-4, low=1e-12, high=10.0),
    ),
    absence="the transmission carries nothing near zero torque; knocks when it is crossed",
    excitation="torque reversals at low load",
    source="R. Bittencourt; FloBaRoID (backlash catalogue figures)",
    confused_with=("soft_windup", "piecewise_stiffness"),
    needs=("transmission_compliance",),
    separate_by="slow crossings of zero torque",
)
def backlash(s: LocalSignals, p: SimpleNamespace) -> Expression:
    return -p.backlash_stiffness_loss * ca.fmin(ca.fmax(s.torsion, -p.backlash), p.backlash)
