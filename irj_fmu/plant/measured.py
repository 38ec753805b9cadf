"""A measured run as an experiment of a plant FMU: its drive, its readings and where it began."""

from __future__ import annotations

from typing import Final

import numpy as np

from identification.balance.weak import kernel
from identification.data.record import Record
from identification.errors import InputError
from irj_fmu.fmi.related import Experiment
from irj_fmu.plant.library import PlantSpec

NAME: Final = "held_out"
DRIVES: Final = {"i_m": "motor_current", "tau_m": "motor_torque"}
"""Channel of a record by the input of a plant."""
START: Final = 0.03
"""Stretch that a start velocity is taken from [s]: the longest kernel of a velocity in the balances
of the fit."""
ABOUT: Final = (
    "Measured, and not seen by the fit. A plant that is driven by the measured torque alone drifts "
    "off, as friction and gravity leave no restoring torque: compare over a second, or hold it to "
    "the measured position."
)


def measured_run(record: Record, spec: PlantSpec, gear_ratio: float) -> Experiment:
    """The experiment of a record.

    Parameters
    ----------
    record : Record
    spec : PlantSpec
        A plant that is driven by torque or current.
    gear_ratio : float

    Raises
    ------
    InputError
        The record lacks the drive or every reading of the plant, or is too short.
    """
    drive = next((v.name for v in spec.inputs if v.name in DRIVES), None)
    if drive is None:
        raise InputError(
            f"plant {spec.name}: its drive is no input; leave out --controller, or --held-out"
        )
    if not record.has(DRIVES[drive]):
        raise InputError(f"{record.name}: has no {DRIVES[drive]}, which drives the plant")
    given = {
        v.name: record[v.name]
        for v in spec.outputs
        if record.has(v.name) and v.name not in DRIVES.values()
    }
    if not given:
        names = ", ".join(v.name for v in spec.outputs)
        raise InputError(f"{record.name}: has none of the readings of the plant: {names}")
    weights = kernel(START, record.dt, 1)
    if len(record) < len(weights):
        raise InputError(f"{record.name}: is too short for an experiment; give a longer record")
    starts: dict[str, float] = {}
    for side in ("motor", "link"):
        for other in (side, "motor", "link"):  # where one side is not read it moves with the other
            channel = f"{other}_position"
            if record.has(channel):
                unit = gear_ratio if other == "motor" else 1.0
                first = record[channel][: len(weights)] / unit
                speed = float(weights @ first)
                middle = len(weights) // 2
                level = float(np.mean(first)) - speed * record.dt * middle
                starts |= {f"state.{side}_position": level, f"state.{side}_velocity": speed}
                break
    there = {v.name for v in spec.states}
    return Experiment(
        NAME,
        ABOUT,
        np.asarray(record.time - record.time[0], dtype=np.float64),
        {drive: np.asarray(record[DRIVES[drive]], dtype=np.float64)},
        given,
        {n: x for n, x in starts.items() if n in there},
    )


__all__ = ["measured_run"]
