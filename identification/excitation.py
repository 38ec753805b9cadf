"""Whether records can carry the question at all, and what they are too poor to show."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from identification.dataset import Dataset
from identification.weak import REST_SHARE, WeakRecord, differentiated_kernel

ATTENUATION: Final = 0.02
"""Pull of a parameter towards zero that is worth a word."""

FEWEST_REVERSALS: Final = 4
"""Reversals of the motor below which the training records say little about friction."""

DEGREES_LIKE: Final = 2.0
"""Factor around 180/pi within which two records' motions look like one in degrees and one in radians."""


REST_WORTH: Final = 0.01
"""Share of rows at rest that is worth a word."""


def rest_note(share: float) -> str:
    """What is said about rows at rest; empty where they are too few."""
    return f"{100 * share:.0f} % of the rows are at rest and left out" if share >= REST_WORTH else ""


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
    unlike = unlike_units(data)
    if unlike:
        out.append(unlike)
    still = rest_note(data.at_rest())
    if still:
        out.append(still)
    few = few_reversals(data)
    if few:
        out.append(f"{few}: friction cannot be told from offsets; record more reversals")
    levels = np.histogram(np.abs(speed) / top, bins=10, range=(0, 1))[0] / max(len(speed), 1)
    if float(levels.max()) > 0.75 and int(np.argmax(levels)) > 2:
        out.append("the training records run at one speed nearly all the time (triangle only): add a multisine record before trusting small claims")
    pulled = {name: 100 * min(share, 1.0) for name, share in attenuation(data).items() if share > ATTENUATION}
    if pulled:
        worst = ", ".join(f"{name} by about {share:.2g} %" for name, share in pulled.items())
        out.append(f"noise of the positions lowers the {worst}: `irj fit --refine` takes that off, finer encoders avoid it")
    return tuple(out)


def unlike_units(data: Dataset) -> str:
    """Whether one record moves about 57 times as far and as fast as another: degrees read as radians leave no other trace."""
    moved = []
    for name, record in zip((*data.train_names, *data.held_out_names), (*data.train, *data.held_out), strict=False):
        velocity, position = record.smooth["motor_velocity"], record.smooth.get("motor_position", np.zeros(1))
        moved.append((float(np.ptp(position)), float(np.quantile(np.abs(velocity), 0.99)), name))
    if not moved:
        return ""
    small, large = min(moved), max(moved)
    ways = (large[0] / max(small[0], 1e-300), large[1] / max(small[1], 1e-300))
    if all(1 / DEGREES_LIKE < way * math.radians(1.0) < DEGREES_LIKE for way in ways):
        moves = f"{large[2]} moves {ways[0]:.3g} times as far and {ways[1]:.3g} times as fast as {small[2]}"
        return f"{moves}: are its positions in degrees? Set their unit in [columns]"
    return ""


def few_reversals(data: Dataset) -> str:
    """How often the motor reverses in the training records where that is too seldom to name a friction effect, else empty."""
    speeds = [w.smooth["motor_velocity"] for w in data.train]
    top = float(np.quantile(np.abs(np.concatenate(speeds)), 0.99)) or 1e-12
    turns = sum(int(np.sum(np.diff(np.sign(v[np.abs(v) > 0.02 * top])) != 0)) for v in speeds)
    if turns >= FEWEST_REVERSALS:
        return ""
    return f"the motor reverses {('not once', 'once only', 'twice only')[turns] if turns < 3 else f'{turns} times only'}"


def attenuation(data: Dataset) -> dict[str, float]:
    """Share by which noise of the positions pulls a parameter towards zero.

    Noise power over power of the averaged signal, noise included, that the parameter multiplies (errors in variables).
    """
    grid, out = data.train[0].grid, {}
    if {"motor_position", "link_position"} <= set(data.noise) and data.sensing.both_positions and not data.sensing.clamped_link:
        torsion = np.concatenate([w.averaged["motor_position"] - w.averaged["link_position"] for w in data.train])
        noise = data.noise["motor_position"] ** 2 + data.noise["link_position"] ** 2
        out["stiffness"] = float(np.sum(differentiated_kernel(grid.length, grid.dt, 0) ** 2)) * noise / max(float(np.var(torsion)), 1e-300)
    for side in ("motor", "link"):
        if f"{side}_position" in data.noise:
            noise = float(np.sum(differentiated_kernel(grid.length, grid.dt, 2) ** 2)) * data.noise[f"{side}_position"] ** 2
            power = float(np.var(np.concatenate([_moving(w, side) for w in data.train])))
            out[f"{side} inertia"] = noise / max(power, 1e-300)
    return out


def _moving(record: WeakRecord, side: str) -> npt.NDArray[np.float64]:
    """Averaged acceleration of a side in the rows in which it does not stand still; one zero where it never moves."""
    values = record.averaged[f"{side}_acceleration"]
    moving = values[record.rest[side] <= REST_SHARE] if side in record.rest else values
    return moving if len(moving) else np.zeros(1)
