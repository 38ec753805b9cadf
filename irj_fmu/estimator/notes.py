"""Sections of the documentation of an estimator FMU."""

from __future__ import annotations

from casadi_models.text.shown import shown
from identification.data.joint_file import Joint
from identification.faults.detector import ABSURD
from identification.online.estimator import FAULT_TEXT, OnlineOptions
from irj_fmu.fmi.documentation import Note
from irj_fmu.fmi.slave_base import STANDARD

_HEALTH = next(v.description for v in STANDARD if v.name == "health")


def estimator_notes(joint: Joint, options: OnlineOptions) -> tuple[Note, ...]:
    """The joint's equations, what is told of faults, and what the estimator does not do.

    Parameters
    ----------
    joint : Joint
    options : OnlineOptions
        Sensors that the joint has.
    """
    lacking = [
        text
        for has, text in (
            (options.has_link, "It is built for a joint without a link encoder."),
            (options.has_torque, "It is built for a joint without a torque sensor."),
        )
        if not has
    ]
    return (
        Note(
            "Equations",
            shown(joint.model(), errors=joint.errors, fitted=joint.fitted),
            verbatim=True,
        ),
        Note(
            "Faults and health",
            f"{FAULT_TEXT}.\n\nOutput health: {_HEALTH}.\n\n"
            "A step never fails because of a reading: trouble shows in health and in the log, and "
            "outputs keep their values.",
        ),
        Note(
            "Limits",
            "A sample is taken where the grid of sample_time has come. Smaller steps of the host "
            "hold the outputs.\n\n"
            f"A reading that is not finite or beyond {ABSURD:g} in SI units counts as missing. "
            "Inputs that nobody connects are told by their valid flags.\n\n"
            "Motor quantities are on the motor shaft, link quantities on the link; estimates are "
            "referred to the link." + "".join(f"\n\n{text}" for text in lacking),
        ),
    )


__all__ = ["estimator_notes"]
