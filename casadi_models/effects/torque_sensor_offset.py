"""Offset of the torque sensor."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


@effect(
    "torque_sensor_offset",
    title="offset of the torque sensor",
    family="sensor",
    acts_on=("torque_sensor",),
    parameters=(signed("torque_sensor_offset", "N.m", "reading at zero torque", typical=3.0),),
    absence="all balances with the torque sensor are shifted by one constant",
    excitation="rest periods",
    source="field knowledge",
    confused_with=("current_offset", "gravity"),
    separate_by="a reading without load",
)
def torque_sensor_offset(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """True torque minus reading."""
    return -p.torque_sensor_offset
