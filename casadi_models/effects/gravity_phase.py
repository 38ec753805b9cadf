"""Centre of mass off the zero line."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


def _stored(s: LocalSignals, p: SimpleNamespace) -> Expression:
    return -p.gravity_cosine * ca.sin(s.position)


@effect(
    "gravity_phase",
    title="centre of mass off the zero line",
    family="torque",
    acts_on=("link",),
    parameters=(signed("gravity_cosine", "N.m", "part of the gravity torque that follows the cosine of the link angle", typical=5.0),),
    absence="the residual of the link follows the cosine of its angle",
    excitation="a long slow swing",
    source="field knowledge (unbalance phase)",
    angular=True,
    potential=_stored,
    needs=("gravity",),
    confused_with=("torque_sensor_offset", "asymmetric_coulomb", "cyclic_torque"),
    separate_by="a swing over more than a quarter turn to either side",
)
def gravity_phase(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque against a positive motion of the link."""
    return -p.gravity_cosine * ca.cos(s.position)
