"""Inertia that is not in the model (payload)."""

from types import SimpleNamespace

from ..effect import Requirement, effect
from ..parameter import signed
from ..signals import Expression, LocalSignals
from ..term import SIDE_INERTIAS


@effect(
    "extra_inertia",
    title="inertia that is not in the model (payload)",
    family="inertia",
    acts_on=("motor", "link"),
    parameters=(signed("extra_inertia", "kg.m2", "inertia beyond the known one", typical=1.0),),
    requires=(
        Requirement(
            SIDE_INERTIAS,
            "cannot be told from the inertia itself; give motor_inertia or link_inertia in [known]",
        ),
    ),
    absence="the residual follows the acceleration",
    excitation="fast motion, with the inertia of one side known",
    source="thesis table 4.2 (design against identified inertia)",
    confused_with=("motor_constant_error",),
    separate_by="the catalogue inertia as a known value, or a run without payload",
    told_by="the catalogue inertia as a known value",
)
def extra_inertia(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque that accelerates the extra inertia."""
    return p.extra_inertia * s.acceleration
