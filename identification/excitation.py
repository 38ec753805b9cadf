"""Whether records can carry the question at all, and what they are too poor to show."""

from __future__ import annotations

import numpy as np

from identification.dataset import Dataset


def not_identifiable(data: Dataset) -> str:
    """Why the training records cannot show what is missing; empty where they can."""
    speed = np.concatenate([w.smooth["motor_velocity"] for w in data.train])
    top = float(np.quantile(np.abs(speed), 0.99))
    grid = data.train[0].grid
    still = 5 * data.noise.get("motor_position", 0.0) * grid.velocity_gain("motor_position")
    if top <= still:
        return "The joint does not move in the training records: record a motion with reversals at several speeds."
    moving = np.sign(speed[np.abs(speed) > 0.02 * top])
    if not np.any(moving > 0) or not np.any(moving < 0):
        return "The motor never reverses in the training records: friction cannot be told from offsets; record reversals."
    return ""


def excitation_warnings(data: Dataset) -> tuple[str, ...]:
    """What the training records are too poor to show, said before the diagnosis."""
    out = []
    speed = np.concatenate([w.smooth["motor_velocity"] for w in data.train])
    top = float(np.quantile(np.abs(speed), 0.99)) or 1e-12
    reversals = int(np.sum(np.diff(np.sign(speed[np.abs(speed) > 0.02 * top])) != 0))
    if reversals < 4:
        out.append(f"the motor reverses {reversals} times only: friction cannot be told from offsets; record more reversals")
    levels = np.histogram(np.abs(speed) / top, bins=10, range=(0, 1))[0] / max(len(speed), 1)
    if float(levels.max()) > 0.75 and int(np.argmax(levels)) > 2:
        out.append("the training records run at one speed nearly all the time (triangle only): add a multisine record before trusting small claims")
    return tuple(out)
