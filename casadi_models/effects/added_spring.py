"""Additional spring to ground, wherever it rests."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


def _stored(s: LocalSignals, p: SimpleNamespace) -> Expression:
    return p.added_spring * s.position**2 / 2 + p.added_spring_preload * s.position


@effect(
    "added_spring",
    title="additional spring to ground",
    family="torque",
    acts_on=("motor", "link"),
    parameters=(
        signed(
            "added_spring",
            "N.m/rad",
            "stiffness of springs, cables or seals between the joint and the ground",
            typical=60.0,
        ),
        signed(
            "added_spring_preload",
            "N.m",
            "torque of the spring where the joint's position reads zero: it rests at minus this "
            "over its stiffness",
            typical=5.0,
            added=True,
        ),
    ),
    absence="the residual grows with the position, at any speed",
    excitation="full travel, better without gravity",
    source="thesis eq. 4.17, for any position of rest",
    potential=_stored,
    confused_with=("cyclic_torque", "motor_constant_error", "gravity"),
    separate_by="a run without payload or with the axis horizontal, over the full travel",
)
def added_spring(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque of the spring."""
    return p.added_spring * s.position + p.added_spring_preload
