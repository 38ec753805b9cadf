"""Start of the recursion with the prior as further rows; what a motion shows; effects that the
estimator finds.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from identification.errors import InputError
from identification.online.first_window import least_squares, prior_range
from identification.online.identifiable import Identifiable
from identification.recursive.estimator import RecursiveLeastSquares, Settings
from identification.recursive.prior_start import UNDETERMINED, solve_with_prior
from irj_fmu.effect_table import EffectRow, joint_with, labels, run
from irj_fmu.plant.joint import PlantOptions, plant_spec

TRUE = np.array([4.0, 20.0, 12.0, 2e4])
SCALE = np.array([5.0, 20.0, 20.0, 2e4])
LEAST = np.array([0.1, 1e-3, 1e-3])


def window(noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Rows of three balances: the first has all friction, the others share two parameters with
    it.
    """
    rng = np.random.default_rng(2)
    h = np.zeros((400, 3, 4))
    h[:, 0, :3] = rng.normal(size=(400, 3))
    h[:, 0, 2] = np.exp(-np.abs(h[:, 0, 1])) * np.sign(h[:, 0, 1])
    h[:, 1, 0] = rng.normal(size=400)
    h[:, 2, 3] = 1e-3 * rng.normal(size=400)
    return h @ TRUE + noise * LEAST * rng.normal(size=(400, 3)), h


def test_balances_without_noise_do_not_hide_the_others() -> None:
    """Residuals of 0.1, 1e-9 and 1e-16 N.m: every parameter is found to the floor of its own
    balance.
    """
    y, h = window()
    y[:, 0] += 0.1 * np.random.default_rng(3).normal(size=400)
    y[:, 1] += 1e-9 * np.random.default_rng(4).normal(size=400)
    found = solve_with_prior(y, h, np.zeros(4), SCALE, LEAST, 1.0)
    sigma = np.sqrt(np.diag(found.covariance))
    assert not found.undetermined
    assert np.all(np.abs(found.theta - TRUE) < 4 * sigma)
    assert np.all(sigma < 0.01 * TRUE)
    assert found.noise[0] == pytest.approx(0.01, rel=0.2)
    np.testing.assert_allclose(found.noise[1:], LEAST[1:] ** 2)


def test_equals_the_normal_equations_with_a_prior() -> None:
    y, h = window(1.0)
    theta0 = np.array([1.0, 2.0, 3.0, 4.0])
    found = solve_with_prior(y, h, theta0, SCALE, LEAST, 2.0)
    rows = (h / np.sqrt(2.0 * found.noise)[:, None]).reshape(-1, 4)
    target = ((y - h @ theta0) / np.sqrt(2.0 * found.noise)).ravel()
    information = rows.T @ rows + np.diag(SCALE**-2)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(information), rtol=1e-2, atol=1e-12)
    np.testing.assert_allclose(
        found.theta - theta0, np.linalg.solve(information, rows.T @ target), rtol=1e-3
    )


def test_what_no_row_shows_keeps_its_prior() -> None:
    """Twins: their sum is known, their difference has the prior's variance, and both are told."""
    rng = np.random.default_rng(5)
    column = rng.normal(size=300)
    h = np.zeros((300, 1, 3))
    h[:, 0, 0] = h[:, 0, 1] = column
    h[:, 0, 2] = rng.normal(size=300)
    y = h @ np.array([3.0, 1.0, 7.0]) + 0.01 * rng.normal(size=(300, 1))
    found = solve_with_prior(y, h, np.zeros(3), np.full(3, 10.0), np.array([0.01]), 1.0)
    assert found.undetermined == (0, 1)
    assert found.theta[0] + found.theta[1] == pytest.approx(4.0, abs=0.01)
    assert found.theta[2] == pytest.approx(7.0, abs=0.01)
    across, along = np.array([1.0, -1.0, 0.0]), np.array([1.0, 1.0, 0.0])
    assert across @ found.covariance @ across / 2 == pytest.approx(100.0, rel=1e-6)
    assert along @ found.covariance @ along / 2 < 1e-5
    assert found.share[2] < 1e-6 < UNDETERMINED < found.share[0]


def test_recursion_goes_on_from_the_start() -> None:
    y, h = window(1.0)
    estimator = RecursiveLeastSquares(
        np.zeros(4), SCALE, outputs=3, settings=Settings(sample_time=0.016)
    )
    started = estimator.begin(y[:200], h[:200], LEAST, overlap=1.0)
    np.testing.assert_allclose(estimator.theta, started.theta)
    np.testing.assert_allclose(estimator.covariance, started.covariance, rtol=1e-9, atol=1e-12)
    estimator.run(y[200:], h[200:])
    assert np.all(np.abs(estimator.theta / TRUE - 1) < 0.02)


def test_refuses_in_one_line() -> None:
    estimator = RecursiveLeastSquares(np.zeros(4), SCALE, outputs=3)
    with pytest.raises(InputError, match="overlap"):
        estimator.begin(*window(), LEAST, overlap=0.5)
    with pytest.raises(InputError, match="without NaN"):
        estimator.begin(np.full((9, 3), np.nan), np.ones((9, 3, 4)), LEAST)


def test_errors_are_judged_in_what_the_motion_shows() -> None:
    blind = np.array([[1.0], [-1.0], [0.0]]) / np.sqrt(2)
    shown = Identifiable(("a", "b", "c"), np.array([1.0, 2.0, 1.0]), blind)
    np.testing.assert_allclose(shown.seen(np.array([0.3, -0.6, 0.2])), [0.0, 0.0, 0.2], atol=1e-15)
    np.testing.assert_allclose(shown.seen(np.array([0.3, 0.6, 0.2])), [0.3, 0.6, 0.2])
    assert [shown.alone(i) for i in range(3)] == [False, False, True]


def test_every_effect_of_the_library_has_its_place_in_the_table() -> None:
    known = labels()
    assert len(known) == len(set(known)) > 40
    for label in known:
        joint = joint_with(label)
        assert set(joint.fitted) == set(joint.model().parameter_names)


def test_stribeck_is_found_without_noise() -> None:
    """The case that the rank test lost: three balances whose residuals differ by many powers of
    ten.
    """
    rows: list[EffectRow] = list(run("stribeck@motor", (None,), ("python",)))
    assert {"motor_stribeck_extra", "motor_viscous", "motor_coulomb", "stiffness"} <= {
        r.name for r in rows
    }
    assert max(r.error for r in rows if r.plant) < 0.5
    assert max(r.sigmas for r in rows) < 2.0
    level = {r.name: r for r in rows}
    assert level["gravity_cosine"].plant == 0.0
    assert abs(level["gravity_cosine"].estimate) < 0.005 * level["gravity_torque"].plant


def test_a_control_value_that_rows_hardly_touch_is_not_told() -> None:
    """A curve of three control values of 4 N.m: one well seen, one touched by a ten-millionth of
    that, one not reached. Alone the second would be what rounding and noise make of it.
    """
    rng = np.random.default_rng(7)
    h = np.zeros((300, 1, 4))
    h[:, 0, 0], h[:, 0, 1], h[:, 0, 3] = rng.normal(size=(3, 300)) * [[1.0], [1e-7], [1e-3]]
    y = h @ np.array([4.0, 4.0, 4.0, 900.0]) + 1e-3 * rng.normal(size=(300, 1))
    like, apart = np.array([0, 0, 0, 3]), np.arange(4)
    least, usual = np.array([1e-3]), np.zeros(4)
    found = least_squares(y, h, least, like)
    assert found[[0, 3]] == pytest.approx([4.0, 900.0], rel=1e-2)
    assert np.all(np.abs(found[1:3]) < 4.0)
    assert abs(least_squares(y, h, least, apart)[1]) > 40.0
    ranges = prior_range(found, np.zeros(4), h, y, usual, like)
    assert ranges[:3] == pytest.approx([4.0] * 3, rel=1e-2)


@pytest.mark.slow
def test_a_learned_curve_is_found() -> None:
    """What the motion does not reach is said to be unsure."""
    rows: list[EffectRow] = list(run("learned_position_friction@link", (None,), ("python",)))
    assert all(r.passed for r in rows)


def test_plant_reads_its_drive_late_where_the_model_says_so() -> None:
    """To first order the reading is the drive at the time less the delay."""
    late = joint_with("channel_delay@drive")
    plain = replace(late, effects=tuple(e for e in late.effects if "channel_delay" not in e))
    plain = replace(
        plain, fitted={n: v for n, v in late.fitted.items() if n in plain.model().parameter_names}
    )
    found = []
    for joint in (plain, late):
        spec = plant_spec(joint, PlantOptions(controller=True))
        x, u = np.array([0.3, 0.2, 0.29, 0.1, 0.0])[: len(spec.states)], np.array([0.5, 0.4, 1.0])
        p = np.array([v.start for v in spec.parameters], dtype=float)
        rates = np.array(spec.dynamics(x, u, p)).ravel()
        read = ca.Function("read", spec.output.sx_in(), [spec.output(*spec.output.sx_in())[5]])
        step = 1e-6
        found.append([float(read(x + s * rates, u, p)) for s in (-step, 0.0, step)])
    (before, now, after), delay = found[0], late.fitted["drive_delay"]
    assert found[1][1] == pytest.approx(now - delay * (after - before) / (2 * step), rel=1e-6)
    assert abs(found[1][1] - now) > 1e-3 * abs(now)
