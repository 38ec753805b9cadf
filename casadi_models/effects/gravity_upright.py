"""Gravity of a link that stands upright at zero: the form of the thesis."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


def _stored(s: LocalSignals, p: SimpleNamespace) -> Expression:
    return -p.gravity_torque * (1 - ca.cos(s.position))


@effect(
    "gravity_upright",
    title="gravity of a link that is upright at zero",
    family="torque",
    acts_on=("link",),
    parameters=(
        signed(
            "gravity_torque",
            "N.m",
            "gravity torque at 90 degrees; positive: upright at zero",
            role="weight",
            typical=105.18,
        ),
    ),
    absence="the residual of the link follows the sine of its angle",
    excitation="a long slow swing",
    source="thesis eq. 2.82",
    angular=True,
    potential=_stored,
    confused_with=("cyclic_torque", "added_spring", "torque_sensor_gain"),
    separate_by="a run without payload or with the axis horizontal",
    candidate=False,
)
def gravity_upright(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque against a positive motion of the link."""
    return -p.gravity_torque * ca.sin(s.position)
