"""Position-periodic torque in the form of the thesis (it is not a friction: it keeps its sign)."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


def _stored(s: LocalSignals, p: SimpleNamespace) -> Expression:
    return p.cyclic_torque_sine * (1 - ca.cos(s.position)) + p.cyclic_torque_cosine * ca.sin(
        s.position
    )


@effect(
    "cyclic_torque",
    title="torque that is periodic in the position",
    family="torque",
    acts_on=("motor", "link"),
    parameters=(
        signed("cyclic_torque_sine", "N.m", "sine part per turn of the link", typical=4.0),
        signed("cyclic_torque_cosine", "N.m", "cosine part per turn of the link", typical=2.0),
    ),
    pairs=(("cyclic_torque", "cyclic_torque_sine", "cyclic_torque_cosine"),),
    absence="the residual follows sine and cosine of the position and does not change sign at a "
    "reversal",
    excitation="a long stroke, better without gravity",
    source="thesis eq. 2.81",
    angular=True,
    potential=_stored,
    confused_with=("motor_constant_error", "added_spring", "gravity"),
    separate_by="a run without payload or with the axis horizontal",
)
def cyclic_torque(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque of the position alone."""
    return p.cyclic_torque_sine * ca.sin(s.position) + p.cyclic_torque_cosine * ca.cos(s.position)
