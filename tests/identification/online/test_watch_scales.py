"""Two positions of a healthy joint differ by play, torque and clocks; a wrong scale is more."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import JointModel
from identification.online.watch import Q_L, Q_M, Twist, Watch

STIFFNESS = 300.0
GAP = 0.004
STEP = 0.01
ALL = (True,) * 6


def joint(gap: float = 0.0) -> Twist:
    """A soft gear, with or without play."""
    model = JointModel.by_name("hd3", 50.0, effects=("backlash",) if gap else ())
    values = {"stiffness": STIFFNESS}
    if gap:
        values |= {"backlash": gap, "backlash_stiffness_loss": STIFFNESS}
    return Twist.of(model.with_values(values))


def motion(amplitude: float, late: float = 0.0) -> npt.NDArray[np.float64]:
    """Ten seconds of both positions, the link's by so many samples late, (n, 6)."""
    t = np.arange(1000) * STEP
    rows = np.zeros((len(t), 6))
    rows[:, Q_M] = amplitude * np.sin(6.0 * t)
    rows[:, Q_L] = amplitude * np.sin(6.0 * (t - late * STEP))
    rows[:, 5] = 3.0 * np.cos(6.0 * t)
    return rows


def said(rows: npt.NDArray[np.float64], twist: Twist) -> bool:
    """Whether a position was called wrong of scale at any time."""
    watch, found = Watch(STEP, ALL, twist), False
    for row in rows.tolist():
        watch.add(row, [True] * 6)
        found = found or watch.scaled[Q_M] or watch.scaled[Q_L]
    return found


def test_the_play_of_a_gap_is_its_half_width_and_a_spring_has_none() -> None:
    assert joint().play == 0.0
    assert joint().compliance == pytest.approx(2.0 / STIFFNESS)
    assert joint(GAP).play == pytest.approx(GAP, abs=5e-4)


@pytest.mark.parametrize("late", [0.0, 1.0, 3.5])
def test_a_late_link_is_no_wrong_scale(late: float) -> None:
    assert not said(motion(0.05, late), Twist())


def test_a_twist_of_the_size_of_the_motion_is_no_wrong_scale_where_the_torque_makes_it() -> None:
    rows = motion(0.02)
    rows[:, Q_L] -= rows[:, 5] / STIFFNESS  # ten milliradians, to both sides
    rows[:, Q_L] -= 0.4 * rows[:, Q_M]
    assert said(rows, Twist())
    assert not said(rows, joint())


def test_a_lost_motion_is_no_wrong_scale() -> None:
    rows = motion(0.011)
    rows[:, Q_L] = np.sign(rows[:, Q_M]) * np.maximum(np.abs(rows[:, Q_M]) - GAP, 0.0)
    rows[:, 5] = 0.0
    assert said(rows, Twist())
    assert not said(rows, joint(GAP))


@pytest.mark.parametrize("factor", [0.6, 1.6, -1.0, 57.3])
@pytest.mark.parametrize("gap", [0.0, GAP])
def test_a_wrong_scale_is_told_where_the_joint_moves(factor: float, gap: float) -> None:
    rows = motion(0.3)
    rows[:, Q_L] *= factor
    assert said(rows, joint(gap))
