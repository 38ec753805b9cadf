"""Stribeck effect."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import amplitude, shape
from ..signals import Expression, LocalSignals


@effect(
    "stribeck",
    title="Stribeck effect",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        amplitude(
            "stribeck_extra",
            "N.m",
            "static friction above the Coulomb torque",
            role="static",
            typical=12.0,
        ),
        shape(
            "stribeck_velocity",
            "rad/s",
            "velocity at which the extra friction has fallen to 1/e",
            (0.01, 0.02, 0.04, 0.08, 0.15, 0.3),
            "velocity",
            start=0.02,
            low=1e-6,
            high=1e3,
            typical=0.07,
        ),
        shape(
            "stribeck_exponent",
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
    several_valleys=True,
    absence="the residual peaks at low speed on both sides of a reversal",
    excitation="slow ramps through zero velocity",
    source="thesis eq. 2.72",
    dissipative=True,
    confused_with=("lugre", "coulomb"),
    needs=("coulomb",),
    separate_by="slow constant-speed runs, and small slow reversals",
)
def stribeck(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Extra friction at low speed."""
    return (
        p.stribeck_extra
        * s.direction
        * ca.exp(-((s.velocity**2 / p.stribeck_velocity**2 + 1e-12) ** (p.stribeck_exponent / 2)))
    )
