"""Where a correction torque acts on a user's FMU, and where its position is read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from identification.errors import InputError
from irj_fmu.imported.correction import CorrectionLaw, Port
from irj_fmu.imported.model import DRIVES, UserModel

POSITIONS: Final = ("motor_position", "link_position")


def port_of(model: UserModel) -> Port:
    """The torque input and the position output of a model.

    Raises
    ------
    InputError
        Where no drive channel or no position is mapped, or the motor constant is missing.
    """
    joint, name = model.joint, model.fmu.path.name
    drive = next(
        ((i, m) for c in DRIVES for i, m in enumerate(model.inputs) if m.channel == c), None
    )
    if drive is None:
        raise InputError(
            f"{name}: no drive channel is mapped to an input of the FMU; a correction torque "
            f"needs one of {', '.join(DRIVES)}"
        )
    channel = drive[1].channel
    per = {
        "motor_torque": joint.gear_ratio,
        "motor_current": joint.torque_per_current,
        "motor_voltage": joint.torque_per_voltage or 1.0,
    }[channel]
    if per is None:
        raise InputError(
            f"{joint.source or joint.name}: motor_current needs motor_constant (Nm/A on the "
            "motor shaft) or torque_per_current in [joint]"
        )
    place = next(
        ((i, m) for c in POSITIONS for i, m in enumerate(model.outputs) if m.channel == c), None
    )
    if place is None:
        raise InputError(
            f"{name}: no position is mapped to an output of the FMU; map motor_position or "
            "link_position"
        )
    motor = place[1].channel == "motor_position"
    side = joint.gear_ratio if motor else 1.0
    speed = next(
        (
            (i, m)
            for i, m in enumerate(model.outputs)
            if m.channel == ("motor_velocity" if motor else "link_velocity")
        ),
        None,
    )
    return Port(
        drive[0],
        place[0],
        per / drive[1].scale,
        1.0 / (side * place[1].scale),
        speed[0] if speed else None,
        1.0 / (side * speed[1].scale) if speed else 1.0,
    )


def feedback_of(model: UserModel, values: Mapping[str, float]) -> CorrectionLaw | None:
    """The correction of a model at values, as something that reads outputs and adds to inputs;
    None without one.
    """
    if model.correction is None:
        return None
    return CorrectionLaw(
        model.correction.with_values(values).model, port_of(model), len(model.inputs)
    )


__all__ = ["POSITIONS", "feedback_of", "port_of"]
