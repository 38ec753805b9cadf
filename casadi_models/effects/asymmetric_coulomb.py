"""Direction-dependent Coulomb friction."""

from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


@effect(
    "asymmetric_coulomb",
    title="direction-dependent Coulomb friction",
    family="friction",
    acts_on=("motor", "link"),
    parameters=(
        signed(
            "asymmetric_coulomb",
            "N.m",
            "half the difference of the Coulomb torques of the two directions",
            typical=3.0,
        ),
    ),
    absence="the residual is shifted by a constant",
    excitation="both directions, constant speed",
    source="offset of the EMPS model (A. Janot, M. Gautier, M. Brunot 2019)",
    confused_with=("current_offset", "cyclic_torque"),
    needs=("coulomb",),
    separate_by="a standstill with the brake closed: an offset stays, friction does not",
    told_by="the current read with the drive off and the brake closed: an offset stays",
)
def asymmetric_coulomb(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Same torque in both directions while moving."""
    return p.asymmetric_coulomb * ca.fabs(s.direction)
