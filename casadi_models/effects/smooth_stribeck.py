"""Stribeck effect in the smooth form of the thesis (F3): with Coulomb friction it is eq. 4.18."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import amplitude, shape
from ..signals import Expression, LocalSignals


@effect(
    "smooth_stribeck",
    title="Stribeck effect, smooth form",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        amplitude(
            "smooth_stribeck",
            "N.m.s/rad",
            "slope of the extra friction at zero velocity (C2)",
            typical=300.0,
        ),
        shape(
            "smooth_stribeck_velocity",
            "rad/s",
            "velocity near which the extra friction peaks",
            (0.01, 0.02, 0.04, 0.08, 0.15, 0.3),
            "velocity",
            start=0.02,
            low=1e-6,
            high=1e3,
        ),
        shape(
            "smooth_stribeck_exponent",
            "1",
            "exponent of the decay",
            (1.0, 2.0),
            "absolute",
            start=1.0,
            low=0.5,
            high=2.0,
            role="exponent",
        ),
    ),
    shapes_reversal=True,
    absence="the residual peaks at low speed on both sides of a reversal",
    excitation="slow ramps through zero velocity",
    source="thesis eq. 2.77, 4.18",
    dissipative=True,
    candidate=False,
    confused_with=("stribeck", "lugre", "viscous"),
    needs=("coulomb",),
    separate_by="slow constant-speed runs, and small slow reversals",
)
def smooth_stribeck(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Extra friction that rises from zero with the velocity and decays."""
    relative = s.velocity**2 / p.smooth_stribeck_velocity**2 + 1e-12
    return p.smooth_stribeck * s.velocity * ca.exp(-(relative ** (p.smooth_stribeck_exponent / 2)))
