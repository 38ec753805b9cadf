"""Stiffening spring (cubic)."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


def _stored(s: LocalSignals, p: SimpleNamespace) -> Expression:
    return p.cubic_stiffness * s.torsion**4 / 4


@effect(
    "cubic_stiffness",
    title="stiffening spring (cubic)",
    family="transmission",
    acts_on=("transmission",),
    parameters=(
        signed(
            "cubic_stiffness",
            "N.m/rad3",
            "coefficient of the cubed torsion",
            role="stiffening",
            typical=3.0e8,
        ),
    ),
    absence="the residual of the transmission grows with the cube of the torsion",
    excitation="high torque in both directions",
    source="thesis eq. 2.41",
    potential=_stored,
    confused_with=("piecewise_stiffness", "soft_windup"),
    needs=("transmission_compliance",),
    separate_by="a torque sweep to the rated torque",
)
def cubic_stiffness(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque of the cubic part."""
    return p.cubic_stiffness * s.torsion**3
