"""Offset of the current."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


@effect(
    "current_offset",
    title="offset of the current",
    family="sensor",
    acts_on=("drive",),
    parameters=(
        signed(
            "current_offset",
            "N.m",
            "constant torque by an offset of the measured current",
            typical=3.0,
        ),
    ),
    absence="the residual of the motor is shifted by a constant",
    excitation="both directions, constant speed; standstill",
    source="field knowledge",
    confused_with=("asymmetric_coulomb", "cyclic_torque"),
    separate_by="a standstill with the brake closed: an offset stays, friction does not",
    told_by="the current read with the drive off and the brake closed: an offset stays",
)
def current_offset(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Constant torque."""
    return p.current_offset
