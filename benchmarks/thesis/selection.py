"""Trajectory selection (section 3.8): figures 3.12 to 3.16."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Final, final

import numpy as np

from benchmarks.thesis.draw import Curve, Map, Panel, picture
from benchmarks.thesis.page import Figure, Row, Section, Table, shown
from benchmarks.thesis.record import DT, FloatArray
from casadi_models import JointModel, thesis
from identification.planning.trajectories import (
    PERIODS,
    SPEEDS,
    Experiment,
    Motion,
    sinusoidal_grid,
    triangular_grid,
)

START: Final = math.radians(20.0)
"""First position of the sinusoidal motions, as in figures 3.10 and 3.11 [rad]."""
HOLD: Final = 0.5
"""Length of the parts of constant velocity [s]."""


@cache
def joint() -> JointModel:
    """Catalogue stiffness (table 4.1), friction of table 4.3, the columns of (3.54)."""
    model = JointModel.by_name(
        "irj2b",
        thesis.GEAR_RATIO,
        effects=(
            "structural_damping",
            "cubic_viscous@motor",
            "cubic_viscous@link",
            "cyclic_torque@link",
        ),
    )
    known = {
        n: v
        for n, v in thesis.numbers(thesis.TABLE_4_3, thesis.TABLE_4_1).items()
        if n in model.parameter_names
    }
    values = {
        **known,
        "motor_added_spring": 0.0,
        "structural_damping": 20.0,
        "motor_smoothing_velocity": 5e-3,
        "link_smoothing_velocity": 5e-3,
    }
    return model.with_values(values)


@cache
def experiments() -> tuple[Experiment, Experiment]:
    """Full and reduced model; the added spring is no part of (3.54)."""
    names = [
        n
        for n in joint().linear_parameters
        if n not in ("motor_inertia", "link_inertia", "gravity_torque", "motor_added_spring")
    ]
    return Experiment(joint(), parameters=names, dt=DT), Experiment(
        joint(), parameters=names, dt=DT, reduced=True
    )


@final
@dataclass(frozen=True)
class Excited:
    """Singular values over a grid: smallest and largest, full, reduced, and full normalised."""

    full: FloatArray
    reduced: FloatArray
    normalised: FloatArray


def excited(motions: list[Motion]) -> Excited:
    """One simulation for each motion; rows (smallest, largest)."""
    full, reduced = experiments()
    rows: list[list[tuple[float, float]]] = [[], [], []]
    for motion in motions:
        run = full.run(motion)
        for place, found in enumerate(
            (
                full.judge(motion, run),
                reduced.judge(motion, run),
                full.judge(motion, run, normalised=True),
            )
        ):
            rows[place].append((found.smallest, found.largest))
    return Excited(*(np.array(r) for r in rows))


@cache
def triangles(count: int = 13) -> tuple[FloatArray, Excited]:
    """Speeds [deg/s] and what the triangles of 10 s excite."""
    speeds = np.linspace(*SPEEDS, count)
    return np.degrees(speeds), excited(triangular_grid(speeds.tolist(), duration=10.0, dt=DT))


@cache
def sines(speeds: int = 9, periods: int = 10) -> tuple[FloatArray, FloatArray, Excited]:
    """Speeds [deg/s], periods [s] and what the sines of 15 s excite; rows of the grid: periods."""
    v, t = np.linspace(*SPEEDS, speeds), np.linspace(*PERIODS, periods)
    found = excited(
        sinusoidal_grid(v.tolist(), t.tolist(), duration=15.0, dt=DT, start=START, hold=HOLD)
    )
    return np.degrees(v), t, found


def _grid(values: FloatArray, speeds: int) -> FloatArray:
    return values[:, 0].reshape(speeds, -1).T


def triangular_section() -> Section:
    """Figures 3.12 and 3.13."""
    speeds, found = triangles()
    page = Section("Figures 3.12 to 3.16: trajectory selection (section 3.8)")
    page.add(
        "Singular values of the measurement matrix (3.54) over the thesis's grids: triangles of "
        "15 to 45 deg/s for 10 s between ±80 deg, sines of "
        "15 to 45 deg/s and periods of 0.5 to 6 s for 15 s with a rendezvous start from 20 deg "
        f"and {HOLD:g} s of constant velocity between. The joint "
        "has the catalogue stiffness and the friction of table 4.3; the reduced model leaves the "
        "column of the cubic stiffness out. All by "
        "`identification.planning.trajectories`.",
        _summary(found, "triangles"),
    )
    panels = []
    for number, name, values in (
        ("3.12", "full model", found.full),
        ("3.13", "reduced model", found.reduced),
    ):
        panels.append(
            Panel(
                f"{number}: {name}",
                "speed [deg/s]",
                "log10 of smallest",
                (Curve(speeds, np.log10(values[:, 0]), dots=True),),
            )
        )
    sizes = " and ".join(shown(float(np.median(v[:, 0]))) for v in (found.full, found.reduced))
    page.brief.append(
        (
            "figures 3.12, 3.13",
            f"smallest singular value of triangles, full and reduced model, median: {sizes} "
            "(printed sizes 1e-7 and 1e-1)",
        )
    )
    words = []
    for number, name, values in (
        ("3.12", "full model", found.full),
        ("3.13", "reduced model", found.reduced),
    ):
        low, high = shown(float(values[:, 0].min())), shown(float(values[:, 0].max()))
        words.append(
            f"{number}, {name}: between {low} and {high}, best at "
            f"{speeds[int(np.argmax(values[:, 0]))]:.3g} deg/s"
        )
    page.add(
        Figure(
            "triangles",
            "Figures 3.12, 3.13",
            f"Smallest singular value of triangles. {'; '.join(words)}.",
            picture(panels, "Smallest singular value of triangular motions"),
        )
    )
    return page


def _condition(values: FloatArray) -> float:
    return float(np.median(values[:, 1] / values[:, 0]))


def _summary(found: Excited, family: str) -> Table:
    rows = [
        Row(
            f"{family}: {name}, {what}",
            printed,
            (float(np.median(v[:, i])), float(v[:, i].min()), float(v[:, i].max())),
        )
        for name, v, smallest in (
            ("full", found.full, 1e-7),
            ("reduced", found.reduced, 0.1),
            ("full, normalised", found.normalised, None),
        )
        for i, (what, printed) in enumerate((("smallest", smallest), ("largest", None)))
    ]
    return Table(("median", "least", "most"), tuple(rows), "singular value", "printed (size)")


def sinusoidal_section() -> Section:
    """Figures 3.14 to 3.16."""
    speeds, periods, found = sines()
    page = Section("Sines (figures 3.14 to 3.16)")
    panels, words = [], []
    for number, name, values in (
        ("3.14", "full", found.full),
        ("3.15", "reduced", found.reduced),
        ("3.16", "full, normalised", found.normalised),
    ):
        grid = _grid(values, len(speeds))
        panels.append(
            Map(
                f"{number}: {name}, log10",
                "speed [deg/s]",
                "period [s]",
                speeds,
                periods,
                np.log10(grid),
            )
        )
        row, column = np.unravel_index(int(np.argmax(grid)), grid.shape)
        words.append(
            f"{number} ({name}): best at {speeds[column]:.3g} deg/s and {periods[row]:.3g} s, "
            f"{grid[row, column]:.3g}"
        )
    rise = float(np.median(found.reduced[:, 0] / found.full[:, 0]))
    change = 100 * float(np.max(np.abs(found.reduced[:, 1] / found.full[:, 1] - 1)))
    conditions = [shown(_condition(v)) for v in (found.full, found.reduced, found.normalised)]
    page.brief.append(
        (
            "figures 3.14 to 3.16",
            "condition number of sines, full, reduced, full normalised, median: "
            f"{', '.join(conditions)}",
        )
    )
    page.add(
        _summary(found, "sines"),
        f"Without the cubic column the smallest singular value rises {shown(rise)} times "
        f"(median), the largest changes by {change:.2f} % at most, as "
        f"the thesis found. Condition number, median over the grid: full {conditions[0]}, "
        f"reduced {conditions[1]}, full normalised {conditions[2]}: "
        "most of it is a matter of units.",
        Figure(
            "sines",
            "Figures 3.14, 3.15, 3.16",
            "Smallest singular value of sines over speed and period. " + "; ".join(words) + ".",
            picture(panels, "Smallest singular value of sinusoidal motions", columns=3),
        ),
        "Not redrawn: the straight lines in the thesis's contours, where a motion does not "
        "complete a cycle in the simulated time. Here the motion "
        "always begins with the rendezvous and every pair of the grid completes a cycle in 15 s.",
    )
    return page
