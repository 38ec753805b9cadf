"""On-line identification of model 2b by recursive least squares: figures 4.23 and 4.24."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from benchmarks.thesis.draw import Curve, Panel, picture
from benchmarks.thesis.offline import SYMBOLS
from benchmarks.thesis.page import Figure, Row, Section, Table, percent
from benchmarks.thesis.record import (
    DT,
    MODEL_2B,
    FloatArray,
    Sides,
    as_printed,
    joint_2b,
    measured,
    regression,
    times,
)
from casadi_models import thesis
from identification.planning.trajectories import triangular
from identification.recursive.estimator import METHODS, RecursiveLeastSquares, Settings

WINDOW: Final = 7.0
"""Start-up window [s] (3.5)."""
BAND: Final = 5.0
"""A parameter has converged when it stays this close to the off-line value [%]."""


def causal(values: FloatArray) -> FloatArray:
    """The thesis's filter as it can run on line: Butterworth, order 8, 15 Hz, forward only."""
    from scipy.signal import butter, sosfilt

    found: FloatArray = sosfilt(butter(8, 2 * 15.0 * DT, output="sos"), values, axis=0)
    return found


def settled(path: FloatArray, goal: float, first: float, band: float = BAND) -> float:
    """Time after which a course stays within `band` percent of its goal [s]; infinite where it
    does not.
    """
    outside = np.flatnonzero(np.abs(path / goal - 1) > band / 100)
    if not outside.size:
        return first
    return math.inf if outside[-1] == len(path) - 1 else first + float(outside[-1] + 1) * DT


def tracked(sides: Sides, method: str) -> FloatArray:
    """Courses of the parameters after the start-up window, (n, parameters)."""
    true = thesis.numbers(thesis.TABLE_4_3)
    estimator = RecursiveLeastSquares(
        np.zeros(len(MODEL_2B)),
        [true[n] for n in MODEL_2B],
        method,
        outputs=2,
        names=MODEL_2B,
        settings=Settings(sample_time=DT, window_seconds=2.0, drift=1e-4, alarm_drift=1e-4),
    )
    first = round(WINDOW / DT)
    start = estimator.startup(sides.y[:first], sides.phi[:first])
    estimator.set_measurement_covariance(start.residual_variance)
    return estimator.run(sides.y[first:], sides.phi[first:]).theta


def _methods(sides: Sides, off: dict[str, float]) -> Table:
    """The worst of springs and motor friction over the last 10 s, by method of forgetting."""
    rows = []
    goal = np.array([off[n] for n in MODEL_2B])
    judged = [i for i, n in enumerate(MODEL_2B) if n != "link_coulomb"]
    for method in METHODS:
        late = 100 * np.abs(tracked(sides, method)[-round(10 / DT) :] / goal - 1)[:, judged]
        worst = int(np.argmax(late.max(axis=0)))
        found = (float(late.max()), float(late[-1].max()))
        rows.append(
            Row(
                f"{method} (worst: {SYMBOLS[MODEL_2B[judged[worst]]].partition(' [')[0]})",
                None,
                found,
            )
        )
    return Table(("worst of the last 10 s [%]", "at the end [%]"), tuple(rows), "forgetting")


def recursive() -> Section:
    """Figures 4.23 and 4.24."""
    experiment = joint_2b()
    run = experiment.run(
        triangular(math.radians(25), limit=math.radians(35), reversal=0.15, duration=41.0)
    )
    seen = measured(as_printed(run, experiment.model), experiment.model, 1)
    sides = regression(experiment, seen, both_rows=True, smooth=causal)
    true, off = thesis.numbers(thesis.TABLE_4_3), sides.solve()
    path = tracked(sides, "random_walk")
    time = times(len(path), WINDOW)
    final = dict(zip(MODEL_2B, path[-1].tolist(), strict=True))
    rows = [
        Row(
            SYMBOLS[n],
            true[n],
            (off[n], final[n], percent(final[n], off[n]), settled(path[:, i], off[n], WINDOW)),
        )
        for i, n in enumerate(MODEL_2B)
    ]
    vaf = sides.vaf(final)
    page = Section("Figures 4.23 and 4.24: model 2b on line")
    page.add(
        "The triangle of 25 deg/s between ±35 deg for 40 s, the filter forward only. The first 7 "
        "s give the start values by SVD, then "
        "recursive least squares (U-D form, random walk). Converged: from then on within 5 % of "
        "the off-line value; a dash: not in 40 s.",
        Table(
            ("off line, whole record", "after 40 s", "against off line [%]", "converged at [s]"),
            tuple(rows),
            printed="table 4.3",
        ),
        f"VAF after 40 s: y1 {vaf[0]:.3f} %, y2 {vaf[1]:.3f} % (printed 99.5026 and 99.3924 %). "
        "At one constant speed a Coulomb torque and a "
        "viscous one look alike; they are told apart on the reversals only, hence their errors. "
        "Coulomb friction on the link is negligible, "
        "as the thesis found: it leaves it out from here on.",
    )
    panels = []
    for number, names in (
        ("4.23", ("stiffness", "cubic_stiffness", "motor_added_spring", "link_coulomb")),
        ("4.24", ("motor_viscous", "link_viscous", "motor_coulomb")),
    ):
        for n in names:
            course, goal = path[:, MODEL_2B.index(n)], off[n]
            flat = Curve(time[[0, -1]], np.full(2, goal), "limit")
            panels.append(
                Panel(f"{number}: {SYMBOLS[n]}", "time [s]", "", (flat, Curve(time, course)))
            )
    page.add(
        "Deviation from the off-line value, link Coulomb friction left out, by method of "
        "forgetting; all but the first are the thesis's:"
    )
    page.add(_methods(sides, off))
    held = max(abs(r.found[2]) for r in rows if r.what != SYMBOLS["link_coulomb"])
    page.brief.append(
        (
            "figures 4.23, 4.24",
            f"model 2b on line: after 40 s within {held:.1f} % of the off-line values (link "
            "Coulomb friction left out)",
        )
    )
    worst = max((abs(r.found[2]), r.what) for r in rows[:4])
    page.add(
        Figure(
            "online",
            "Figures 4.23, 4.24",
            "Courses after the start-up window; dashed: off-line value. 4.23: k1, k2, ka, "
            "Coulomb friction of the link; 4.24: damping. Of the "
            "springs and the motor's Coulomb friction the furthest from its off-line value "
            f"after 40 s is {worst[1]}, {worst[0]:.2f} %.",
            picture(
                panels,
                "Parameters of model 2b on line",
                (("model", "on line"), ("limit", "off line")),
                columns=4,
            ),
        )
    )
    return page
