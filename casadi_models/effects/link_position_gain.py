"""Scale between the two positions: a wrong gear ratio, or the scale of an encoder."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import WRONG_RATIO, scale_error
from ..signals import Expression, LocalSignals, gain_error


@effect(
    "link_position_gain",
    title="wrong gear ratio or scale of a position",
    family="sensor",
    acts_on=("link_position_sensor",),
    parameters=(
        scale_error(
            "link_position_gain",
            "relative error: link reading = (1 + error) motor reading / gear_ratio, no torsion",
            WRONG_RATIO,
            typical=0.002,
        ),
    ),
    absence="the transmission balance follows the link position",
    excitation="a long stroke, better without gravity",
    source="field knowledge",
    confused_with=("cubic_stiffness", "torque_sensor_gain"),
    separate_by="a slow run over a long stroke without payload: both positions over many turns",
)
def link_position_gain(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """True position minus reading."""
    return gain_error(s.reading, p.link_position_gain)
