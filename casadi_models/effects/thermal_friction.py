"""Friction that changes with temperature (the signal counts from the first sample of the first
training record).
"""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


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
    return (p.thermal_coulomb * s.direction + p.thermal_viscous * s.velocity) * s.temperature
