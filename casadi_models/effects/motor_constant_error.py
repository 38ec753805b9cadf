"""Motor constant."""

from types import SimpleNamespace

from ..effect import ANYTHING_KNOWN, SECOND_BALANCE, TORQUE_SENSOR, Requirement, effect
from ..parameter import signed
from ..signals import Expression, LocalSignals


@effect(
    "motor_constant_error",
    title="motor constant",
    family="sensor",
    acts_on=("drive",),
    parameters=(
        signed(
            "motor_constant_error",
            "1",
            "relative error: true torque = (1 + error) times the stated one",
            typical=0.15,
        ),
    ),
    requires=(
        Requirement(
            (SECOND_BALANCE, ANYTHING_KNOWN),
            "one balance alone scales with the motor constant; give a known inertia or a torque "
            "sensor",
        ),
        Requirement(
            (TORQUE_SENSOR, "motor_inertia"),
            "without a torque sensor the whole balance scales with the motor constant; give a "
            "known inertia",
        ),
    ),
    absence="the residual of the motor follows the drive torque, its inertial part too",
    excitation="fast motion and a gravity-free run",
    source="thesis section 4.3.2 (constant 18 % above the catalogue)",
    confused_with=("torque_sensor_gain", "cyclic_torque", "added_spring"),
    separate_by="a run without payload or with the axis horizontal",
    told_by="the catalogue inertia of the motor as a known value, or a known weight on the link",
)
def motor_constant_error(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque missing by the wrong constant."""
    return p.motor_constant_error * s.reading
