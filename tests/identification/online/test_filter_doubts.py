"""Parameters that a filter does not know for sure, samples that are lost, a side that sticks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import brentq

from benchmarks.online_filter import NOISE, Readings, levels_of, plant, recorded
from identification.online.filter import AT_A_TURN, Doubts, JointFilter, Levels

FloatArray = npt.NDArray[np.float64]
POSITIONS = (1.0, 1.0, 0.0, 1.0, 0.0, 1.0)
NAMES = ("motor_viscous", "link_inertia")


@pytest.fixture(scope="module")
def run() -> Readings:
    return recorded(seed=61, seconds=10.0)


def innovations(joint: JointFilter, run: Readings, levels: Levels) -> FloatArray:
    state = joint.start(run.time[0], run.rows[0], POSITIONS, levels=levels)
    used = np.broadcast_to(np.array(POSITIONS), (1, *run.rows.shape))
    course = joint.run([state], run.time, run.rows, used, levels=levels)
    assert np.linalg.eigvalsh(course.last[0].covariance).min() > -1e-12
    return np.asarray(course.innovation[0, 1500:][:, [0, 2, 4]], dtype=np.float64)


def wrong(errors: FloatArray) -> dict[str, float]:
    true = dict(zip(plant().parameter_names, plant().value_vector(), strict=True))
    return {n: true[n] + e for n, e in zip(NAMES, errors, strict=True)}


def test_no_doubt_changes_nothing(run: Readings) -> None:
    levels = levels_of(1e-3)
    plain = innovations(JointFilter(plant(), 1e-3), run, levels)
    sure = JointFilter(plant(), 1e-3, doubts=Doubts(NAMES, np.zeros((2, 2))))
    np.testing.assert_allclose(innovations(sure, run, levels), plain, rtol=0, atol=1e-6)


def test_errors_that_are_stated_are_no_surprise(run: Readings) -> None:
    """Models drawn from a covariance whose errors nearly cancel, as those of a fit at one speed."""
    true = dict(zip(plant().parameter_names, plant().value_vector(), strict=True))
    spread = np.array([0.2 * true[NAMES[0]], 0.1 * true[NAMES[1]]])
    covariance = np.outer(spread, spread) * [[1.0, -0.95], [-0.95, 1.0]]
    rng = np.random.default_rng(5)
    levels = replace(levels_of(1e-3), disturbance=(1e-3, 1e-3, 1e-3))
    surprised, doubted = [], []
    for errors in rng.multivariate_normal(np.zeros(2), covariance, size=6):
        model = plant().with_values(wrong(errors))
        plain = innovations(JointFilter(model, 1e-3), run, levels)
        joint = JointFilter(model, 1e-3, doubts=Doubts(NAMES, covariance))
        with_doubt = innovations(joint, run, levels)
        surprised.append(np.mean(plain**2))
        doubted.append(np.mean(with_doubt**2))
    assert np.mean(surprised) > 10.0
    assert np.mean(doubted) < 1.2
    assert max(doubted) < 2.0


def test_what_is_doubted_is_not_estimated(run: Readings) -> None:
    off = wrong(np.array([0.1, 0.2]))
    doubts = Doubts(NAMES, np.diag([1.0, 0.1]))
    joint = JointFilter(plant().with_values(off), 1e-3, ("motor_coulomb",), doubts=doubts)
    state = joint.start(run.time[0], run.rows[0], POSITIONS, levels=levels_of(1e-3))
    used = np.broadcast_to(np.array(POSITIONS), (1, *run.rows.shape))
    last = joint.run([state], run.time, run.rows, used, levels=levels_of(1e-3)).last[0]
    found = joint.estimate(last)
    for name in NAMES:
        assert found[name][0] == pytest.approx(off[name], rel=1e-12)
    assert found["motor_coulomb"][0] != joint.values["motor_coulomb"]


def test_without_one_of_them_the_others_stay() -> None:
    covariance = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 0.2], [0.5, 0.2, 1.0]])
    left = Doubts(("a", "b", "c"), covariance).without("b")
    assert left.names == ("a", "c")
    np.testing.assert_array_equal(left.covariance, [[4.0, 0.5], [0.5, 1.0]])
    assert Doubts(("a",), np.eye(1)).without(None).names == ("a",)


def test_lost_samples_are_predicted_one_by_one(run: Readings) -> None:
    """A fifth of the samples lost at random, turns among them: what the filter expects afterwards
    is no worse than its noise, and it has an answer for each sample that came."""
    rng = np.random.default_rng(7)
    kept = np.flatnonzero(rng.random(len(run.time)) > 0.2)
    few = Readings(run.time[kept], run.rows[kept], run.states[kept])
    assert np.diff(few.time).max() > 3.5e-3
    whole = innovations(JointFilter(plant(), 1e-3), run, levels_of(1e-3))
    lost = innovations(JointFilter(plant(), 1e-3), few, levels_of(1e-3))
    assert len(lost) == len(kept) - 1500
    assert np.sqrt(np.mean(lost**2)) < 1.1 * np.sqrt(np.mean(whole**2))
    assert np.abs(lost).max() < 1.5 * np.abs(whole).max()


def test_a_long_gap_is_no_straight_line() -> None:
    """Beyond a tenth of a second nothing is put in between: an hour would be millions of steps."""
    joint, time = JointFilter(plant(), 1e-3), np.array([0.0, 3600.0])
    rows = np.zeros((2, 6))
    state = joint.start(0.0, rows[0].tolist())
    course = joint.run([state], time, rows, np.ones((1, 2, 6)))
    assert course.innovation.shape == (1, 2, 5)
    assert course.last[0].time == 3600.0


def at_rest(joint: JointFilter, seconds: float, share: float, seed: int) -> Readings:
    """A joint that stands while its motor is pushed by a share of its dry friction: what holds it
    is not in a friction law that is smooth at zero speed."""
    given = list(joint.values.values())

    def rates(twist: float, drive: float) -> FloatArray:
        x = [0.3, 0.0, 0.3 - twist, 0.0]
        return np.array(
            joint.functions.disturbed(x, [drive, 0.0, 0.0], given, [0.0, 0.0])[0]
        ).ravel()

    twist = brentq(lambda twist: rates(twist, 0.0)[3], -0.02, 0.02, xtol=1e-14)
    motor = rates(twist, 0.0)[1], rates(twist, 1.0)[1]
    drive = -motor[0] / (motor[1] - motor[0]) + share * joint.dry[0] / AT_A_TURN
    x = [0.3, 0.0, 0.3 - twist, 0.0]
    told = joint.functions.disturbed(x, [drive, 0.0, 0.0], given, [0.0, 0.0])[1]
    torque = float(np.ravel(np.array(told))[4])
    clean = np.array([drive, *x, torque])
    count = round(seconds / joint.dt)
    noise = np.random.default_rng(seed).normal(size=(count, 6)) * NOISE
    return Readings(joint.dt * np.arange(count), clean + noise, np.tile(x, (count, 1)))


@pytest.mark.parametrize("share", [0.5, -0.5])
def test_a_side_that_sticks_is_no_steady_surprise(share: float) -> None:
    """At rest the friction that is taken is any up to the dry one, and stays: the filter must hold
    it without being told anew in each sample."""
    joint = JointFilter(plant(), 1e-3)
    levels = replace(
        levels_of(1e-3),
        disturbance=(0.2, 0.2, 0.2),
        lasting=(0.02, 0.02, 0.02),
        holding=(float(joint.dry[0]), float(joint.dry[1])),
    )
    found = innovations(joint, at_rest(joint, 8.0, share, 63), levels)
    assert np.abs(found.mean(axis=0)).max() < 4 / np.sqrt(len(found))
