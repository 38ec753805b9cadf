"""Recursive least squares beside filters that know the noise: constant, drift, step, outliers,
standstill.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from benchmarks.recursive_scenarios import (
    DT,
    NOISE,
    PARAMETERS,
    SCENARIOS,
    figure,
    kalman,
    own,
    scenario,
)
from identification.errors import InputError
from identification.recursive.estimator import METHODS, RecursiveLeastSquares, Settings

FloatArray = npt.NDArray[np.float64]


@cache
def data(name: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    return scenario(name, 3)


@cache
def best(name: str) -> float:
    """The better one of a plain Kalman filter and Huber's, which both know R2."""
    y, h, theta = data(name)
    return min(figure(name, kalman(y, h), theta), figure(name, kalman(y, h, 2.5), theta))


@pytest.mark.parametrize("name", ["constant", "drift", "outliers"])
def test_as_good_as_filters_that_know_the_noise(name: str) -> None:
    y, h, theta = data(name)
    assert figure(name, own(y, h, "random_walk"), theta) <= 1.3 * best(name)


def test_a_step_is_followed_and_not_taken_for_outliers() -> None:
    y, h, theta = data("step")
    assert figure("step", own(y, h, "random_walk"), theta) <= 1.3 * best("step")


@pytest.mark.parametrize("method", METHODS)
def test_no_mode_diverges(method: str) -> None:
    for name in SCENARIOS:
        y, h, theta = data(name)
        found = own(y, h, method)
        assert np.isfinite(found).all()
        assert (
            figure(name, found, theta) < 60.0
        )  # % of scale; the schedule keeps the past, which moves by 50 %


@pytest.mark.parametrize("name", ["constant", "outliers"])
def test_schedule_ends_as_least_squares_of_a_constant_plant(name: str) -> None:
    """All of P forgets or nothing: single rows would turn the directions that the samples have
    told.
    """
    y, h, theta = data(name)
    clean = data("constant")
    batch = np.linalg.lstsq(clean[1], clean[0])[0]
    ideal = 100 * float(np.sqrt(np.mean((batch - theta[0]) ** 2)))
    assert (
        100 * float(np.sqrt(np.mean((own(y, h, "schedule")[-1] - theta[-1]) ** 2)))
        < 3 * ideal + 0.1
    )


def test_slow_drift_is_no_noise() -> None:
    """With a walk that is too slow, the lag behind the drift does not raise R2, which would
    slow it further.
    """
    y, h, theta = data("drift")
    found = []
    for known in (None, NOISE**2):
        estimator = RecursiveLeastSquares(
            np.zeros(PARAMETERS),
            np.ones(PARAMETERS),
            R2=known,
            settings=Settings(sample_time=DT, drift=0.02),
        )
        found.append(figure("drift", estimator.run(y[:, None], h[:, None, :]).theta, theta))
    assert found[0] < 1.1 * found[1]
    assert found[1] > 3.0  # the case is one of lag


def test_single_outliers_do_not_move_the_estimate_where_r2_is_known() -> None:
    y, h, theta = data("outliers")
    assert figure("outliers", own(y, h, "random_walk", known=True), theta) < 0.2 * figure(
        "outliers", kalman(y, h), theta
    )


def test_a_sample_that_is_hardly_believed_tells_hardly_anything() -> None:
    """A column that is seen once, 100 of its standard deviations off: the estimate moves by 2.5 of
    them, and stays as unsure as what it leaves.
    """
    estimator = RecursiveLeastSquares(
        [0.0], [1.0], settings=Settings(drift=0.0, alarm_drift=0.0, freeze=False), R2=[1e-4]
    )
    estimator.update([100.0], [[1.0]])
    assert estimator.theta[0] == pytest.approx(2.5, rel=1e-3)
    assert estimator.deviation[0] == pytest.approx((1 - 2.5 / 100) ** 0.5, rel=1e-3)


def test_a_declared_inflation_is_used_as_it_is() -> None:
    """Rows that share their samples: the standard deviation is larger by the root of the
    inflation.
    """
    y, h, _ = data("constant")
    deviations = []
    for inflation in (1.0, 4.0):
        settings = Settings(sample_time=DT, drift=0.0, alarm_drift=0.0, inflation=inflation)
        estimator = RecursiveLeastSquares(
            np.zeros(PARAMETERS), np.ones(PARAMETERS), settings=settings
        )
        estimator.run(y[:5000, None], h[:5000, None, :])
        deviations.append(estimator.deviation)
    np.testing.assert_allclose(deviations[1] / deviations[0], 2.0, rtol=0.05)
    with pytest.raises(InputError, match="inflation"):
        Settings(inflation=0.5)
