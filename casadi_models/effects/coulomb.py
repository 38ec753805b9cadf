"""Coulomb friction."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import amplitude
from ..signals import Expression, LocalSignals


@effect(
    "coulomb",
    title="Coulomb friction",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        amplitude(
            "coulomb",
            "N.m",
            "Coulomb friction torque",
            role="static",
            typical={"motor": 21.5, "link": 0.4},
        ),
    ),
    common=True,
    everywhere=True,
    stage="plain",
    absence="the residual steps at every reversal and is flat in between",
    excitation="reversals, at least two speeds",
    source="thesis eq. 2.72",
    dissipative=True,
    confused_with=("stribeck", "lugre"),
)
def coulomb(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Constant torque against the motion."""
    return p.coulomb * s.direction
