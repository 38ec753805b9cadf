"""Additional spring to ground that rests at zero: the form of the thesis."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


def _stored(s: LocalSignals, p: SimpleNamespace) -> Expression:
    return p.added_spring * s.position**2 / 2


@effect(
    "added_spring_at_zero",
    title="additional spring to ground that rests at zero",
    family="torque",
    acts_on=("motor", "link"),
    parameters=(
        signed(
            "added_spring",
            "N.m/rad",
            "stiffness of cables or seals that pull the joint to its zero",
            typical=60.0,
        ),
    ),
    absence="the residual grows with the position, at any speed",
    excitation="full travel, better without gravity",
    source="thesis eq. 4.17",
    potential=_stored,
    confused_with=("cyclic_torque", "motor_constant_error", "gravity"),
    separate_by="a run without payload or with the axis horizontal, over the full travel",
    candidate=False,
)
def added_spring_at_zero(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque of the spring."""
    return p.added_spring * s.position
