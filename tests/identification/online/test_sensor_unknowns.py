"""A zero between the encoders and skews of the clocks in the online estimator: found, taken off,
and nothing begun anew where there is none.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import CubicSpline

from benchmarks.native import PLAIN, STEP
from casadi_models.hold import CLOCKS, HOLD_NAME, UNKNOWNS
from casadi_models.simulate import simulate
from identification.balance.clocks import MOST_SKEW
from identification.data.joint_file import Joint
from identification.online.estimator import OnlineEstimator
from irj_fmu.plant.reference import reference_joint, start_of

FloatArray = npt.NDArray[np.float64]
ZERO, LINK, TORQUE = "link_encoder_zero", "link_encoder_skew", "torque_sensor_skew"
NOISE = np.array([0.1, 1e-6, 1e-4, 1e-6, 1e-3, 0.05])
UNWATCHED = replace(PLAIN, detect=False)
"""A fault detector without limits of a healthy record takes a clock for a fault."""
EVERY = 4
DT = EVERY * STEP
SECONDS = 18.0


def with_gap() -> Joint:
    joint = reference_joint("hd3")
    return replace(
        joint,
        effects=(*joint.effects, "backlash"),
        fitted={**joint.fitted, "backlash_stiffness_loss": 21000.0, "backlash": 5e-4},
    )


JOINTS = {
    "straight": lambda: reference_joint("hd3"),
    "cubic": lambda: reference_joint("irj_ts"),
    "gap": with_gap,
}


@cache
def exact(kind: str) -> tuple[FloatArray, FloatArray]:
    """Times and readings without noise every :data:`STEP`, link-referred."""
    time = STEP * np.arange(round(SECONDS / STEP) + 1)
    drive = 250 * np.sin(2 * np.pi * 0.4 * time) + 60 * np.sin(2 * np.pi * 1.7 * time)
    return time, np.column_stack([drive, simulate(JOINTS[kind]().model(), drive, STEP).readings])


def recorded(kind: str, zero: float, link: float, torque: float) -> tuple[FloatArray, FloatArray]:
    """A log with noise: the link encoder off by `zero` and late by `link` samples, the torque
    sensor by `torque`.
    """
    time, table = exact(kind)
    at = time[40:-40:EVERY]
    late = np.array([0.0, 0.0, 0.0, link, link, torque]) * DT
    columns = [CubicSpline(time, x)(at - s) for x, s in zip(table.T, late, strict=True)]
    out = np.column_stack(columns)
    out[:, 3] += zero
    return at, out + np.random.default_rng(7).normal(size=out.shape) * NOISE


def followed(joint: Joint, time: FloatArray, table: FloatArray) -> OnlineEstimator:
    made = OnlineEstimator(joint, DT, UNWATCHED)
    for at, row in zip(time.tolist(), table.tolist(), strict=True):
        made.update(at, row, [True] * 6)
    return made


def values(made: OnlineEstimator) -> dict[str, float]:
    return dict(zip(made.names, made.theta.tolist(), strict=True))


@pytest.mark.parametrize("kind", list(JOINTS))
@pytest.mark.parametrize(
    ("zero", "link", "torque"), [(2e-3, 0.0, 0.0), (-1e-3, 1.6, -0.7), (5e-4, -2.8, 2.1)]
)
def test_zero_and_skews_are_found_and_leave_the_joint_alone(
    kind: str, zero: float, link: float, torque: float
) -> None:
    joint = JOINTS[kind]()
    made = followed(joint, *recorded(kind, zero, link, torque))
    found, sigma = values(made), dict(zip(made.names, made.sigma.tolist(), strict=True))
    assert not made.warming_up
    assert found[ZERO] == pytest.approx(zero, abs=max(2e-5, 4 * sigma[ZERO]))
    assert found[LINK] == pytest.approx(link * DT, abs=max(0.02 * DT, 4 * sigma[LINK]))
    assert found[TORQUE] == pytest.approx(torque * DT, abs=max(0.1 * DT, 4 * sigma[TORQUE]))
    model = joint.model()
    true = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    near = ("stiffness", "motor_inertia", "link_inertia")
    assert {n: found[n] for n in near} == {n: pytest.approx(true[n], rel=0.02) for n in near}
    assert made.ratio.max() < 2.0


@pytest.mark.parametrize("kind", list(JOINTS))
def test_without_any_nothing_is_begun_anew(kind: str) -> None:
    made = followed(JOINTS[kind](), *recorded(kind, 0.0, 0.0, 0.0))
    assert not made.calibration.off.any()
    assert not any("anew" in text for text in made.events)
    found = values(made)
    assert abs(found[ZERO]) < 1e-5
    assert abs(found[LINK]) < 0.01 * DT


def test_a_joint_without_values_is_followed_past_a_zero() -> None:
    """Its clocks are not looked for: derivatives at values that are none say nothing of them."""
    made = followed(start_of(reference_joint("hd3")), *recorded("straight", 2e-3, 0.0, 0.0))
    assert ZERO in made.names
    assert not {LINK, TORQUE} & set(made.names)
    assert values(made)["stiffness"] == pytest.approx(
        reference_joint("hd3").fitted["stiffness"], rel=0.01
    )


def test_unknowns_stand_behind_the_parameters() -> None:
    """The places of the parameters of the joint are those of a joint without a link encoder's
    zero.
    """
    made = OnlineEstimator(reference_joint("hd3"), DT, PLAIN)
    own = [n for n in made.names if n in UNKNOWNS]
    assert made.names[-len(own) :] == (ZERO, LINK, TORQUE, HOLD_NAME)
    rigid = OnlineEstimator(reference_joint("hd1"), DT, replace(UNWATCHED, has_torque=False))
    assert not (set(UNKNOWNS) - {HOLD_NAME}) & set(rigid.names)


def test_no_clock_is_taken_off_further_than_any_may_be() -> None:
    """What is later is a delay, to be named; the estimate goes on with what is left."""
    made = followed(reference_joint("hd3"), *recorded("straight", 0.0, 6.0, 0.0))
    at = [made.names.index(n) for n in made.names if n in CLOCKS]
    assert np.all(np.abs(made.calibration.off[at]) <= MOST_SKEW * DT)
    assert np.all(np.abs(made.theta[at]) <= MOST_SKEW * DT)


def test_a_state_saved_between_two_windows_goes_on_as_if_never_saved() -> None:
    joint, (time, table) = with_gap(), recorded("gap", -1e-3, 1.6, -0.7)
    options = replace(UNWATCHED, warm_up=3.0)
    one, other = (OnlineEstimator(joint, DT, options) for _ in range(2))
    stop = 1600
    for at, row in zip(time[:stop].tolist(), table[:stop].tolist(), strict=True):
        one.update(at, row, [True] * 6)
    assert one.calibration.off.any()
    other.restore(one.state())
    for at, row in zip(time[stop:].tolist(), table[stop:].tolist(), strict=True):
        one.update(at, row, [True] * 6)
        other.update(at, row, [True] * 6)
    assert not one.warming_up
    np.testing.assert_array_equal(other.theta, one.theta)
    one.reset()
    assert not one.calibration.off.any()
    assert one.samples.lag == 0.0


def test_a_reset_forgets_which_readings_were_lost() -> None:
    """As the native estimator does: the next run is not shorter for the end of the last."""
    time, table = recorded("straight", 0.0, 0.0, 0.0)
    one = OnlineEstimator(reference_joint("hd3"), DT, UNWATCHED)
    for at, row in zip(time[:200].tolist(), table[:200].tolist(), strict=True):
        one.update(at, row, [True, True, True, False, True, True])
    assert one.samples.lost.any()
    one.reset()
    assert not one.samples.lost.any()
