"""Viscous friction."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import amplitude
from ..signals import Expression, LocalSignals


@effect(
    "viscous",
    title="viscous friction",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        amplitude(
            "viscous",
            "N.m.s/rad",
            "viscous friction coefficient",
            typical={"motor": 11.0, "link": 2.0},
        ),
    ),
    common=True,
    everywhere=True,
    absence="the residual has a slope against velocity",
    excitation="at least two speeds",
    source="thesis eq. 2.71",
    dissipative=True,
    confused_with=("structural_damping", "channel_delay"),
)
def viscous(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque in proportion to the velocity."""
    return p.viscous * s.velocity
