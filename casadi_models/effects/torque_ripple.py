"""Torque ripple (cogging) of the motor."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import shape, signed
from ..signals import Expression, LocalSignals


def _stored(s: LocalSignals, p: SimpleNamespace) -> Expression:
    angle = p.ripple_order * s.motor_angle
    energy = p.ripple_sine * (1 - ca.cos(angle)) + p.ripple_cosine * ca.sin(angle)
    return energy / (p.ripple_order * s.gear_ratio)


@effect(
    "torque_ripple",
    title="torque ripple (cogging) of the motor",
    family="torque",
    acts_on=("motor",),
    parameters=(
        signed("ripple_sine", "N.m", "sine part", typical=1.5),
        signed("ripple_cosine", "N.m", "cosine part", typical=1.0),
        shape(
            "ripple_order",
            "1",
            "order per turn of the motor",
            (1.0, 2.0, 4.0, 6.0),
            "absolute",
            start=2.0,
            low=0.05,
            high=1e5,
            role="order",
        ),
    ),
    pairs=(("ripple", "ripple_sine", "ripple_cosine"),),
    absence="a line in the motor residual only, at a fixed order of the motor turn",
    excitation="slow constant speed",
    source="field knowledge",
    potential=_stored,
    periodic=True,
    confused_with=("kinematic_error",),
    separate_by="a slow constant-speed run",
)
def torque_ripple(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque of one order of the motor turn."""
    return p.ripple_sine * ca.sin(p.ripple_order * s.motor_angle) + p.ripple_cosine * ca.cos(
        p.ripple_order * s.motor_angle
    )
