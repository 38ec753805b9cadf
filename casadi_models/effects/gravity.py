"""Gravity of the link, wherever the joint has its zero."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


def _stored(s: LocalSignals, p: SimpleNamespace) -> Expression:
    return -p.gravity_torque * (1 - ca.cos(s.position)) - p.gravity_cosine * ca.sin(s.position)


@effect(
    "gravity",
    title="gravity of the link",
    family="torque",
    acts_on=("link",),
    parameters=(
        signed(
            "gravity_torque",
            "N.m",
            "sine part of the gravity torque: all of it where the link stands or hangs at zero; "
            "positive: upright",
            role="weight",
            typical=105.18,
        ),
        signed(
            "gravity_cosine",
            "N.m",
            "cosine part of the gravity torque: all of it where the link is level at zero",
            typical=5.0,
            added=True,
        ),
    ),
    common=True,
    absence="the residual of the link follows sine and cosine of its angle",
    excitation="a long slow swing",
    source="thesis eq. 2.82, for any zero of the joint",
    angular=True,
    potential=_stored,
    formerly=("gravity_phase",),
    confused_with=("cyclic_torque", "added_spring", "torque_sensor_gain", "torque_sensor_offset"),
    separate_by="a run without payload or with the axis horizontal",
)
def gravity(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque against a positive motion of the link."""
    return -p.gravity_torque * ca.sin(s.position) - p.gravity_cosine * ca.cos(s.position)
