"""Piecewise linear stiffness."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import shape, signed
from ..signals import Expression, LocalSignals


def _beyond(s: LocalSignals, knot: Expression) -> Expression:
    return s.torsion - ca.fmin(ca.fmax(s.torsion, -knot), knot)


def _stored(s: LocalSignals, p: SimpleNamespace) -> Expression:
    first, second = _beyond(s, p.stiffness_knot_1), _beyond(s, p.stiffness_knot_2)
    return (p.stiffness_step_1 * first**2 + p.stiffness_step_2 * second**2) / 2


@effect(
    "piecewise_stiffness",
    title="piecewise linear stiffness",
    family="transmission",
    acts_on=("transmission",),
    parameters=(
        signed(
            "stiffness_step_1",
            "N.m/rad",
            "change of the stiffness beyond the first knot",
            typical=6e3,
        ),
        signed(
            "stiffness_step_2",
            "N.m/rad",
            "change of the stiffness beyond the second knot",
            typical=8e3,
        ),
        shape(
            "stiffness_knot_1",
            "rad",
            "torsion of the first knot",
            (0.1, 0.2, 0.35),
            "torsion",
            start=1e-4,
            low=0.0,
            high=10.0,
            typical=7e-4,
        ),
        shape(
            "stiffness_knot_2",
            "rad",
            "torsion of the second knot",
            (0.5, 0.7),
            "torsion",
            start=5e-4,
            low=0.0,
            high=10.0,
            typical=2e-3,
        ),
    ),
    absence="the residual of the transmission has kinks at two torques",
    excitation="a torque sweep to the rated torque",
    source="thesis table 2.3 (catalogue K1, K2, K3)",
    potential=_stored,
    confused_with=("cubic_stiffness", "soft_windup", "backlash"),
    needs=("transmission_compliance",),
    separate_by="a slow torque sweep to the rated torque",
)
def piecewise_stiffness(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque of the stiffness steps beyond the knots."""
    return p.stiffness_step_1 * _beyond(s, p.stiffness_knot_1) + p.stiffness_step_2 * _beyond(
        s, p.stiffness_knot_2
    )
