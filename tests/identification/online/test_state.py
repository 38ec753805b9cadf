"""The online estimator's state in another estimator, what it takes as noise and as friction, and
what it makes of readings that are missing, no numbers or of wrong scale.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import numpy.typing as npt
import pytest

from benchmarks.native import readings_of
from casadi_models.hold import UNKNOWNS
from identification.online.estimator import OnlineEstimator, OnlineOptions
from irj_fmu.convergence import forgotten
from irj_fmu.cosim import link_referred
from irj_fmu.plant.reference import reference_joint, start_of

FloatArray = npt.NDArray[np.float64]
STEP = 1e-3
QUICK = OnlineOptions(optimise=False, detect=False, warm_up=2.0)


@cache
def readings(key: str) -> list[list[float]]:
    table: FloatArray = readings_of(key, 6.0) * link_referred(reference_joint(key))
    return table.tolist()


def feed(estimator: OnlineEstimator, key: str, first: int, last: int) -> OnlineEstimator:
    for k in range(first, last):
        estimator.update(k * STEP, readings(key)[k], [True] * 6)
    return estimator


def shown(estimator: OnlineEstimator) -> list[list[float]]:
    found = (estimator.theta, estimator.sigma, estimator.residual, estimator.floor, estimator.ratio)
    return [*(x.tolist() for x in found), estimator.readings, [float(estimator.fault)]]


@pytest.mark.parametrize("at", [1000, 3003])
@pytest.mark.parametrize("detect", [False, True])
def test_another_estimator_goes_on_from_the_state_as_the_first_one_did(
    detect: bool, at: int
) -> None:
    """Before the first window is full and after it, in the midst of a row."""
    options = OnlineOptions(optimise=False, detect=detect, warm_up=2.0)
    joint = reference_joint("hd3")
    one = feed(OnlineEstimator(joint, STEP, options), "hd3", 0, at)
    assert (one.detector is not None) == detect
    saved = one.state()
    expected = shown(feed(one, "hd3", at, 4000))
    assert not one.warming_up
    other = feed(OnlineEstimator(joint, STEP, options), "hd3", 0, 500)
    for estimator in (other, one):
        estimator.restore(saved)
        assert shown(feed(estimator, "hd3", at, 4000)) == expected


def test_an_estimator_without_detection_takes_up_the_state_of_one_with_it() -> None:
    joint = reference_joint("hd3")
    watched = OnlineOptions(optimise=False, detect=True, warm_up=2.0)
    saved = feed(OnlineEstimator(joint, STEP, watched), "hd3", 0, 3000).state()
    plain = feed(OnlineEstimator(joint, STEP, QUICK), "hd3", 0, 3000)
    again = OnlineEstimator(joint, STEP, QUICK)
    again.restore(saved)
    assert np.array_equal(again.theta, plain.theta)
    assert np.array_equal(
        feed(again, "hd3", 3000, 3500).theta, feed(plain, "hd3", 3000, 3500).theta
    )
    # and the other way round the detection begins anew
    back = OnlineEstimator(joint, STEP, watched)
    back.restore(plain.state())
    assert np.array_equal(feed(back, "hd3", 3500, 3600).theta, feed(plain, "hd3", 3500, 3600).theta)


def test_a_margin_of_the_detection_divides_its_scores_and_means_nothing_without_it() -> None:
    joint, options = reference_joint("hd3"), OnlineOptions(optimise=False, warm_up=2.0)
    scores = {}
    for margins in ((1.0,), (2.0,), (2.0, 2.0), (4.0, 1.0)):
        one = OnlineEstimator(joint, STEP, options)
        for margin in margins:
            one.set_fault_margin(margin)
        scores[margins] = np.array(feed(one, "hd3", 0, 1500).score)
    assert np.max(scores[1.0,]) > 0.1
    assert scores[2.0,] == pytest.approx(scores[1.0,] / 2, rel=1e-9)
    assert np.array_equal(scores[2.0, 2.0], scores[2.0,])
    assert scores[4.0, 1.0] == pytest.approx(scores[1.0,], rel=1e-9)
    plain = OnlineEstimator(joint, STEP, QUICK)
    plain.set_fault_margin(2.0)
    assert plain.score == OnlineEstimator(joint, STEP, QUICK).score


def test_a_share_of_the_torque_is_noise_at_least() -> None:
    """Of the motor's drive and of the torque into the link, root mean square so far."""
    shares = (1e-3, 0.2)
    found = []
    for share in shares:
        options = OnlineOptions(optimise=False, detect=False, warm_up=2.0, floor_share=share)
        one = OnlineEstimator(start_of(reference_joint("hd3")), STEP, options)
        found.append(feed(one, "hd3", 0, 2600))
    table = np.array(readings("hd3")[:2500])
    drive, torque = (float(np.sqrt(np.mean(table[:, k] ** 2))) for k in (0, 5))
    expected = {"motor": drive, "link": torque, "transmission": torque}
    for k, balance in enumerate(found[1].balances):
        assert found[1].least[k] == pytest.approx(0.2 * expected[balance], rel=0.25)
    assert np.all(found[0].least >= found[0].floor)
    assert np.all(found[0].least < found[1].least / 20)


def test_at_a_reversal_a_row_is_unsure_by_the_dry_friction_of_its_side() -> None:
    one = OnlineEstimator(start_of(reference_joint("irj2b")), STEP, QUICK)
    at = {n: k for k, n in enumerate(one.names)}
    theta = np.full(len(one.names), 7.0)
    theta[at["motor_coulomb"]], theta[at["link_coulomb"]] = 3.0, -4.0
    size = np.array([2.0, 0.5, 1.0])
    shares = np.array([[0.0, 0.0], [1.0, 0.0], [0.25, 0.5]])
    motor, link = 3.0 * shares[:, 0] / 2.0, 4.0 * shares[:, 1] / 0.5
    expected = 1 / np.sqrt(1 + np.column_stack([motor, link, 0 * motor]) ** 2)
    assert one.balances == ("motor", "link", "transmission")
    assert one._weight_of(shares, theta, size) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("free", [(), ("motor_viscous",)])
def test_what_is_known_is_no_less_sure_than_what_is_followed(free: tuple[str, ...]) -> None:
    """Where friction was known its turns counted in full: a healthy joint stood at three times its
    floor. With one parameter left, or none, the first row was an internal error.
    """
    plain = reference_joint("irj2b")
    joint = replace(plain, fitted={**plain.fitted, "gravity_torque": -105.0})  # as in the readings
    held = joint.held()
    some = replace(held, known={n: k for n, k in held.known.items() if n not in free})
    every, few = (feed(OnlineEstimator(j, STEP, QUICK), "irj2b", 0, 5000) for j in (joint, some))
    assert set(few.names) - set(UNKNOWNS) == set(free)
    assert few.balances == every.balances == ("motor", "link", "transmission")
    size, theta = np.array([2.0, 0.5, 1.0]), np.zeros(len(few.names))
    dry = [joint.fitted[f"{side}_coulomb"] for side in ("motor", "link")]
    expected = 1 / np.sqrt(1 + (np.array([*dry, 0.0]) / size) ** 2)
    assert few._weight_of(np.ones((1, 2)), theta, size)[0] == pytest.approx(expected, rel=1e-12)
    assert np.all(few.ratio < 1.0)
    assert few.level == pytest.approx(every.level, rel=0.3)


def test_what_the_first_window_leaves_is_told_over_its_noise_at_once() -> None:
    """Before another row is made; a joint that is as the model says is not strained."""
    one, at = OnlineEstimator(start_of(reference_joint("hd3")), STEP, QUICK), 0
    while one.warming_up:
        feed(one, "hd3", at, at + 1)
        at += 1
    assert one.ratio == pytest.approx(one.level / one.least, rel=1e-12)
    assert np.all((one.ratio > 0.1) & (one.ratio < 1.5))
    for _ in range(4):
        feed(one, "hd3", at, at + 500)
        at += 500
        assert not one.wanted


def test_a_reading_that_is_missing_is_told_once_each_time() -> None:
    one = OnlineEstimator(start_of(reference_joint("hd3")), STEP, QUICK)
    for k in range(4500):
        missing = 3000 <= k < 3400 or 3900 <= k < 4200
        one.update(k * STEP, readings("hd3")[k], [not missing, *[True] * 5])
        if k == 3700:
            assert one.fault == 0
            first = one.events
    assert len(first) == 1 and first[0].startswith("fault ")
    assert one.events == 2 * first


def test_the_rows_go_on_with_the_shapes_that_a_search_has_found() -> None:
    options = OnlineOptions(detect=False, warm_up=2.0, portions=50)
    one = OnlineEstimator(forgotten(reference_joint("hd3")), STEP, options)
    assert one.two_step is not None
    start = one.two_step.eta.copy()
    feed(one, "hd3", 0, 2500)
    assert not one.two_step.searching
    assert one.two_step.searches == 1
    assert not np.array_equal(one.two_step.eta, start)
    assert np.array_equal(one.rows.shape_values, one.two_step.eta)
    feed(one, "hd3", 2500, 3500)
    assert np.all(one.ratio < 1.5), "what they leave is noise"


def test_a_reading_that_is_no_number_is_told_alone_and_harms_nothing() -> None:
    """As if that one were missing: the others count, whatever they are, and what is shown is a
    number.
    """
    one, other = (OnlineEstimator(reference_joint("hd3"), STEP, QUICK) for _ in range(2))
    for value, wrong in product((1e300, -1e300, math.nan, math.inf, -math.inf), range(6)):
        one.reset()
        other.reset()
        for k in range(4):
            row = list(readings("hd3")[k])
            other.update(k * STEP, row, [not (k == 2 and i == wrong) for i in range(6)])
            assert other.unusable == ()
            if k == 2:
                row[wrong] = value
            one.update(k * STEP, row, [True] * 6)
            assert one.unusable == ((wrong,) if k == 2 else ())
            assert one.readings == other.readings
            assert np.all(np.isfinite(one.readings))


@pytest.mark.parametrize("key", ["hd1", "hd3"])
def test_a_link_that_is_not_read_is_shown_as_far_from_the_motor_as_the_torque_twists(
    key: str,
) -> None:
    """A rigid joint does not twist."""
    one = feed(OnlineEstimator(reference_joint(key), STEP, QUICK), key, 0, 40)
    twists = []
    for k in range(40, 400):
        row = readings(key)[k]
        one.update(k * STEP, [*row[:3], 0.0, 0.0, row[5]], [True, True, True, False, False, True])
        twists.append((row[3] - row[1], one.readings[3] - row[1]))
        assert one.readings[4] == row[2]
    read, shown = np.array(twists).T
    if key == "hd1":
        assert np.all(shown == 0.0)
    else:
        assert np.ptp(read) > 1e-3
        assert np.abs(shown - read).max() < 0.05 * np.ptp(read)


@pytest.mark.parametrize(("reading", "code"), [(0, 31), (5, 36)])
def test_a_torque_of_wrong_scale_is_told_when_the_first_window_is_full(
    reading: int, code: int
) -> None:
    """An inertia that is five times that of the joint file; before that nothing is told."""
    one = OnlineEstimator(reference_joint("hd3"), STEP, QUICK)
    said = set()
    for k in range(2600):
        row = list(readings("hd3")[k])
        row[reading] *= 5.0
        one.update(k * STEP, row, [True] * 6)
        if one.warming_up:
            assert one.fault == 0
        elif one.made > 140:
            said.add(one.fault)
    assert said == {code}


def test_the_estimate_goes_on_from_what_a_search_has_found() -> None:
    """What the new shapes leave is told over its noise at once, and where nothing is read after
    that, the estimate shown stays: it does not go back to that of the old shapes.
    """
    options = OnlineOptions(detect=False, warm_up=2.0, portions=50)
    one, at = OnlineEstimator(forgotten(reference_joint("hd3")), STEP, options), 0
    assert one.two_step is not None
    before = one.theta
    while one.two_step.searches == 0 or one.two_step.searching:
        before = one.theta
        feed(one, "hd3", at, at + 1)
        at += 1
    assert one.ratio == pytest.approx(one.level / one.least, rel=1e-9)
    found = one.theta
    assert np.max(np.abs(found - before) / one.sigma) > 1.0
    for k in range(at, at + 200):
        one.update(k * STEP, readings("hd3")[k], [False] * 6)
        assert np.array_equal(one.theta, found)


def test_the_recursion_takes_no_reading_for_better_than_the_share_of_its_torque() -> None:
    """What it holds for the noise of each balance, and so how sure it says that it is."""
    found = []
    for share in (1e-3, 0.05, 0.5):
        options = OnlineOptions(optimise=False, detect=False, warm_up=2.0, floor_share=share)
        one = OnlineEstimator(reference_joint("hd3"), STEP, options)
        feed(one, "hd3", 0, 3000)
        assert one.estimator is not None
        noise = np.sqrt(one.estimator.engine_for("test").part("fast", "noise"))
        assert np.all(noise > 0.9 * one.least)
        if share > 1e-3:
            assert noise == pytest.approx(one.least, rel=0.1), "the readings are better than that"
        found.append(one.sigma)
    assert np.all(found[2] > found[1])
    assert np.all(found[1] > found[0])
