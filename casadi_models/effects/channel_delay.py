"""Delay of a channel."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


@effect(
    "channel_delay",
    title="delay of a channel",
    family="sensor",
    acts_on=("drive", "torque_sensor", "link_position_sensor"),
    parameters=(
        signed(
            "delay",
            "s",
            "time by which the channel is late (negative: early)",
            role="delay",
            typical=0.006,
        ),
    ),
    absence="the residuals with that channel follow its rate",
    excitation="fast motion",
    source="field knowledge",
    confused_with=("viscous", "structural_damping"),
    separate_by="a common clock, or a step that all channels see",
)
def channel_delay(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Late reading: true = reading + delay times its rate."""
    return p.delay * s.reading_rate
