"""Ripple of the torque sensor: strain gauges on a flexspline read the wave generator too."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import shape, signed
from ..signals import Expression, LocalSignals


@effect(
    "torque_sensor_ripple",
    title="ripple of the torque sensor",
    family="sensor",
    acts_on=("torque_sensor",),
    parameters=(
        signed(
            "torque_sensor_ripple_sine",
            "N.m",
            "sine part of what the sensor reads too much",
            typical=1.0,
        ),
        signed(
            "torque_sensor_ripple_cosine",
            "N.m",
            "cosine part of what the sensor reads too much",
            typical=0.7,
        ),
        shape(
            "torque_sensor_ripple_order",
            "1",
            "order per turn of the motor",
            (1.0, 2.0, 4.0),
            "absolute",
            start=2.0,
            low=0.05,
            high=1e5,
            role="order",
        ),
    ),
    pairs=(("torque_sensor_ripple", "torque_sensor_ripple_sine", "torque_sensor_ripple_cosine"),),
    absence="the same line in the balances of the motor, the link and the transmission, at an "
    "order of the motor turn",
    excitation="slow motion over at least one turn of the motor",
    source="M. Hashimoto, Y. Kiyosawa, R. Paul 1993",
    periodic=True,
    confused_with=("torque_ripple", "kinematic_error"),
    separate_by="motor current and both positions recorded",
    candidate=False,
)
def torque_sensor_ripple(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """True torque minus reading; a line at the motor's angle."""
    angle = p.torque_sensor_ripple_order * s.motor_angle
    return -p.torque_sensor_ripple_sine * ca.sin(angle) - p.torque_sensor_ripple_cosine * ca.cos(
        angle
    )
