"""Friction that changes with temperature (the signal counts from the first sample of the first
training record).
"""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import shape, signed
from ..signals import Expression, LocalSignals

NEARLY_WARM = 1e-12
"""Least of the warm-up that is left: its logarithm stays finite."""


@effect(
    "thermal_friction",
    title="friction that changes with temperature",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        signed(
            "thermal_coulomb", "N.m/K", "change of the Coulomb torque with temperature", typical=0.3
        ),
        signed(
            "thermal_viscous", "N.m.s/(rad.K)", "change of the viscous coefficient with temperature"
        ),
        shape(
            "thermal_pace",
            "1",
            "how many times as fast as over a third of the longest run the joint warms up, where "
            "no temperature is recorded",
            (0.25, 0.5, 1.0, 2.0, 4.0),
            "absolute",
            start=1.0,
            low=0.1,
            high=10.0,
            typical=1.0,
            added=True,
            in_place_of="temperature",
        ),
    ),
    absence="the friction residual changes during the run while its shape stays",
    excitation="a long run that repeats its first block at the end, with temperature recorded; "
    "without that channel the time since a cold start stands in",
    source="A. C. Bittencourt, P. Axelsson 2014; L. Simoni et al. 2015",
    needs=("coulomb",),
    separate_by="a long run that repeats its first block when warm",
)
def thermal_friction(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Change of friction with the temperature above the origin."""
    left = 1 - s.temperature
    # what is left at another pace is its power; written so that a pace of 1 is the temperature
    # itself, to the last bit and on either side of 1
    faster = 1 - ca.exp((p.thermal_pace - 1) * ca.log(ca.fmax(ca.fabs(left), NEARLY_WARM)))
    return (p.thermal_coulomb * s.direction + p.thermal_viscous * s.velocity) * (
        s.temperature + left * faster
    )
