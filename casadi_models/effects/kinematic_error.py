"""Kinematic error of the wave generator (step from model 3 to model 4), and one line of any
order.
"""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import shape, signed
from ..signals import Expression, LocalSignals


@effect(
    "kinematic_error",
    title="kinematic error of the gear",
    family="transmission",
    acts_on=("torsion",),
    parameters=(
        signed(
            "kinematic_error_sine", "rad", "sine part of the error, link-referred", typical=4.0e-4
        ),
        signed(
            "kinematic_error_cosine",
            "rad",
            "cosine part of the error, link-referred",
            typical=3.0e-4,
        ),
        shape(
            "kinematic_error_order",
            "1",
            "order per turn of the wave generator",
            (1.0, 2.0, 4.0),
            "absolute",
            start=2.0,
            low=0.05,
            high=64.0,
            role="order",
        ),
    ),
    pairs=(("kinematic_error", "kinematic_error_sine", "kinematic_error_cosine"),),
    absence="a line in the residual of the transmission at an order of the motor turn",
    excitation="slow motion over at least one turn of the motor",
    source="thesis eq. 2.48; F. Ghorbel, P. Gandhi, F. Alpeter 2001",
    periodic=True,
    needs=("transmission_compliance",),
    confused_with=("torque_ripple",),
    separate_by="a slow constant-speed run with the torque sensor recorded",
)
def kinematic_error(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Angle taken off the torsion: one order; orders 1, 2 and 4 are three terms."""
    angle = p.kinematic_error_order * s.motor_angle
    return p.kinematic_error_sine * ca.sin(angle) + p.kinematic_error_cosine * ca.cos(angle)
