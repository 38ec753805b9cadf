"""Gain of the torque sensor."""

from types import SimpleNamespace

from ..effect import effect
from ..parameter import signed
from ..signals import Expression, LocalSignals, gain_error


@effect(
    "torque_sensor_gain",
    title="gain of the torque sensor",
    family="sensor",
    acts_on=("torque_sensor",),
    parameters=(
        signed(
            "torque_sensor_gain",
            "1",
            "relative error of the sensor: reading = (1 + error) times the true torque",
            typical=0.1,
        ),
    ),
    absence="all balances with the torque sensor fail in proportion to the torque",
    excitation="a gravity-free run and known payload",
    source="field knowledge",
    confused_with=("motor_constant_error", "gravity"),
    separate_by="a known payload, or a run without payload",
    told_by="a known weight on the link",
)
def torque_sensor_gain(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """True torque minus reading."""
    return gain_error(s.reading, p.torque_sensor_gain)
