"""Hysteresis of the transmission."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import amplitude, shape
from ..signals import Expression, LocalSignals


def _stops(
    z: tuple[Expression, ...], step: Expression, s: LocalSignals, p: SimpleNamespace
) -> tuple[Expression, ...]:
    """Stop operators: each follows the torsion until it slips; the widths of three in a geometric
    series follow a loop of any bend closely.
    """
    return tuple(
        ca.fmin(ca.fmax(state + step / (p.hysteresis_spread**k * p.hysteresis_width), -1), 1)
        for k, state in enumerate(z)
    )


@effect(
    "hysteresis",
    title="hysteresis of the transmission",
    family="transmission",
    acts_on=("transmission",),
    parameters=(
        amplitude(
            "hysteresis_torque_1", "N.m", "half width of the loop, short element", typical=2.0
        ),
        amplitude(
            "hysteresis_torque_2", "N.m", "half width of the loop, middle element", typical=3.0
        ),
        amplitude(
            "hysteresis_torque_3", "N.m", "half width of the loop, long element", typical=3.0
        ),
        shape(
            "hysteresis_width",
            "rad",
            "torsion over which the short element turns round",
            (0.005, 0.015, 0.04, 0.09),
            "torsion",
            start=1e-4,
            low=1e-12,
            high=10.0,
            typical=1e-4,
        ),
        shape(
            "hysteresis_spread",
            "1",
            "over how many times the torsion of one element the next one turns round",
            (3.0,),
            "absolute",
            start=3.0,
            # nearer ones are one element to a record; with 5 the long one is 25 times as wide as
            # the short one: a spring over all of the motion in which that shows
            low=1.5,
            high=5.0,
            typical=3.0,
            added=True,
        ),
    ),
    contains=("coulomb",),
    of_displacement=True,
    absence="the residual of the transmission is a closed loop against the torsion, at any speed",
    excitation="slow load cycles",
    source="H. Taghirad, P. Belanger 1996; Maxwell-slip elements (F. Al-Bender, V. Lampaert, J. "
    "Swevers 2005)",
    memory=_stops,
    states=3,
    dissipative=True,
    needs=("transmission_compliance",),
    confused_with=("structural_damping", "lugre", "backlash"),
    separate_by="slow load cycles at two speeds",
)
def hysteresis(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Sum of three elements that stick and slip."""
    return (
        p.hysteresis_torque_1 * s.memory[0]
        + p.hysteresis_torque_2 * s.memory[1]
        + p.hysteresis_torque_3 * s.memory[2]
    )
