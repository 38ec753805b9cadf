"""Entries of a row that are noise of their own say nothing of their parameter."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from identification.data.joint_file import parse_joint
from identification.data.plain_text import from_toml
from identification.data.read import read
from identification.errors import InputError
from identification.online.estimator import OnlineEstimator
from identification.online.first_window import told_beside_noise
from identification.recursive.estimator import RecursiveLeastSquares, Settings
from irj_fmu.estimator.healthy import online_readings

SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "hidden_effect"
TRUE = np.array([4.0, 25.0])
NOISE = 0.02
"""Standard deviation of the first entry's noise."""
RATE = 60.0
"""Rows in a second."""


def rows(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of an inertia and a friction: half a second of acceleration, then steady speed, where
    the acceleration is noise.
    """
    rng = np.random.default_rng(7)
    count = round(RATE * seconds)
    moved = np.where(np.arange(count) < 30, 1.0, 0.0)
    exact = np.column_stack([moved, np.ones(count)])
    y = exact @ TRUE + 0.01 * rng.standard_normal(count)
    seen = exact.copy()
    seen[:, 0] += NOISE * rng.standard_normal(count)
    return y, seen


def recursion() -> RecursiveLeastSquares:
    settings = Settings(sample_time=1 / RATE)
    return RecursiveLeastSquares(TRUE, np.abs(TRUE), outputs=1, settings=settings)


def test_steady_speed_takes_no_inertia_away() -> None:
    y, h = rows(60.0)
    plain, told = recursion(), recursion()
    told.set_entry_noise([[NOISE**2, 0.0]])
    for k in range(len(y)):
        plain.update(y[k], h[k])
        told.update(y[k], h[k])
    assert abs(plain.theta[0] - TRUE[0]) > 5 * plain.deviation[0]
    assert told.theta == pytest.approx(TRUE, rel=0.05)
    assert (np.abs(told.theta - TRUE) < 3 * told.deviation).all()


def test_exact_entries_are_as_they_were() -> None:
    y, h = rows(5.0)
    one, other = recursion(), recursion()
    other.set_entry_noise(np.zeros((1, 2)))
    for k in range(len(y)):
        assert one.update(y[k], h[k]).tolist() == other.update(y[k], h[k]).tolist()


@pytest.mark.parametrize("given", [[1.0, 1.0], [[np.nan, 0.0]], [[-1.0, 0.0]]])
def test_what_is_no_variance_is_refused(given: object) -> None:
    with pytest.raises(InputError, match="set_entry_noise"):
        recursion().set_entry_noise(given)  # type: ignore[arg-type]


def test_a_window_keeps_what_stands_out_of_its_noise() -> None:
    y, h = rows(7.0)
    left, shown, square = told_beside_noise(
        y[:, None], h[:, None, :], TRUE, np.array([[NOISE**2, 0.0]]), 1 / RATE
    )
    assert (shown[:30, 0, 0] == h[:30, 0]).all()
    assert (shown[-60:, 0, 0] == 0).all()
    assert (shown[:, 0, 1] == h[:, 1]).all()
    # nothing is lost: what is not told is taken off with the value from before
    assert left[:, 0] - shown[:, 0] @ TRUE == pytest.approx(y - h @ TRUE)
    assert square[0, 0] == pytest.approx(NOISE**2, rel=0.7)


def test_slow_motion_leaves_a_right_joint_as_it_is() -> None:
    """A joint with nothing hidden and its true values, on a record that hardly accelerates: the
    link's inertia fell by a third, and the drive was called wrong of scale.
    """
    folder = SHARED / "none"
    table = json.loads((folder / "truth.json").read_text())["link_referred"]
    true = {
        n: next(v for k, v in table.items() if k.startswith(n))
        for n in (
            "motor_inertia",
            "link_inertia",
            "stiffness",
            "structural_damping",
            "motor_viscous",
            "link_viscous",
            "motor_coulomb",
            "link_coulomb",
            "gravity_torque",
        )
    }
    fitted = "".join(f"{n} = {{ value = {v!r} }}\n" for n, v in true.items())
    fitted += "gravity_cosine = { value = 0.0 }\n"
    plain = (folder / "joint.toml").read_text()
    joint = parse_joint(from_toml(f"{plain}\n[fitted]\n{fitted}", "joint"), "joint")
    record = read(folder / "test2.csv")
    readings, there = online_readings(record, joint)
    estimator = OnlineEstimator(joint, record.dt)
    for time, row in zip(record.time.tolist(), readings, strict=True):
        estimator.update(time, list(row), there)
    assert estimator.fault == 0
    assert not any("fault" in text for text in estimator.events)
    for name, value, sigma in zip(estimator.names, estimator.theta, estimator.sigma, strict=True):
        if name in true:
            assert abs(value - true[name]) < 3 * sigma, name
    found = dict(zip(estimator.names, estimator.theta.tolist(), strict=True))
    assert found["link_inertia"] == pytest.approx(true["link_inertia"], rel=0.02)
    assert found["motor_inertia"] == pytest.approx(true["motor_inertia"], rel=0.02)
