"""Compliance of the torque sensor."""

from types import SimpleNamespace

from ..effect import Requirement, effect
from ..parameter import amplitude
from ..signals import Expression, LocalSignals


@effect(
    "torque_sensor_compliance",
    title="compliance of the torque sensor",
    family="transmission",
    acts_on=("torsion",),
    parameters=(
        amplitude("sensor_compliance", "rad/(N.m)", "twist of the sensor per torque", typical=1e-5),
    ),
    requires=(
        Requirement(
            ("stiffness",),
            "cannot be told from the stiffness itself; give the catalogue stiffness in [known]",
        ),
    ),
    absence="the transmission seems softer than its catalogue stiffness",
    excitation="torque against torsion, with the catalogue stiffness known",
    source="thesis section 2.5.3",
    needs=("transmission_compliance",),
    confused_with=("transmission_compliance",),
    separate_by="the catalogue stiffness of the gear, or a position measured before the sensor",
    told_by="the catalogue stiffness of the gear as a known value",
)
def torque_sensor_compliance(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Twist of the sensor."""
    return p.sensor_compliance * s.torque
