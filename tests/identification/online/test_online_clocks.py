"""Late channels in the online estimator: a held current, and delays that the joint file knows."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from benchmarks.native import PLAIN, STEP
from casadi_models.hold import HOLD_NAME
from casadi_models.simulate import simulate
from identification.balance.clocks import MOST_SKEW
from identification.data.joint_file import Joint
from identification.online.estimator import OnlineEstimator, OnlineOptions
from identification.online.rows import SOURCES
from identification.online.timing import Alignment
from irj_fmu.plant.reference import reference_joint, start_of

FloatArray = npt.NDArray[np.float64]
NOISE = np.array([0.1, 1e-6, 1e-4, 1e-6, 1e-3, 0.05])
NEAR = {"stiffness": 0.01, "motor_inertia": 0.01, "link_inertia": 0.01, "motor_viscous": 0.03}


def drive(time: FloatArray) -> FloatArray:
    return 250 * np.sin(2 * np.pi * 0.4 * time) + 60 * np.sin(2 * np.pi * 1.7 * time)


@cache
def readings(seconds: float = 16.0) -> tuple[FloatArray, FloatArray]:
    """Times, and readings without noise, link-referred; the simulation holds the drive for a step,
    so that its reading is early by half of one.
    """
    time = STEP * np.arange(round(seconds / STEP) + 1)
    found = simulate(reference_joint("hd3").model(), drive(time), STEP).readings
    return time, np.column_stack([drive(time), found])


def followed(joint: Joint, time: FloatArray, table: FloatArray, dt: float) -> OnlineEstimator:
    made = OnlineEstimator(joint, dt, PLAIN)
    for at, row in zip(time.tolist(), table.tolist(), strict=True):
        made.update(at, row, [True] * 6)
    return made


def near_the_truth(made: OnlineEstimator) -> None:
    model = reference_joint("hd3").model()
    true = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    found = dict(zip(made.names, made.theta.tolist(), strict=True))
    assert {n: found[n] for n in NEAR} == {
        n: pytest.approx(true[n], rel=most) for n, most in NEAR.items()
    }


@pytest.mark.parametrize("late", [-0.5, 0.0, 1.5])
def test_the_hold_of_a_current_is_found_and_taken_off(late: float) -> None:
    """At 2 ms, noise of real sensors, no value known: the residual is noise."""
    every, dt = 2, 2 * STEP
    time, table = (x[::every] for x in readings())
    rng = np.random.default_rng(5)
    table = (
        np.column_stack([drive(time - late * dt), table[:, 1:]])
        + rng.normal(size=table.shape) * NOISE
    )
    made = followed(start_of(reference_joint("hd3")), time, table, dt)
    at = made.names.index(HOLD_NAME)
    true = late * dt - STEP / 2
    assert made.theta[at] == pytest.approx(true, abs=min(0.1 * dt, 4 * made.sigma[at]))
    assert made.ratio.max() < 1.3
    near_the_truth(made)


@pytest.mark.parametrize("way", [-1, 1])
def test_no_clock_is_shown_further_off_than_any_may_be(way: int) -> None:
    dt = 2 * STEP
    time, table = (x[::2] for x in readings())
    time, table = time[:1500], table[:1500]
    noise = np.random.default_rng(5).normal(size=table.shape) * NOISE
    table = np.column_stack([drive(time - way * 6 * dt), table[:, 1:]]) + noise
    made = OnlineEstimator(
        start_of(reference_joint("hd3")), dt, OnlineOptions(optimise=False, warm_up=2.0)
    )
    for at, row in zip(time.tolist(), table.tolist(), strict=True):
        made.update(at, row, [True] * 6)
    assert not made.warming_up
    assert made.theta[made.names.index(HOLD_NAME)] == pytest.approx(way * MOST_SKEW * dt)


def test_a_joint_whose_torque_is_known_has_no_hold() -> None:
    known = replace(reference_joint("hd3"), torque_per_current=None)
    assert HOLD_NAME not in OnlineEstimator(known, STEP, PLAIN).names


LATE = {"drive": 6, "torque_sensor": 4, "link_position_sensor": 3}


def test_known_delays_of_whole_samples_change_nothing_but_the_time() -> None:
    """The rows of late channels are those of the same readings in time, `lead` samples later."""
    joint = reference_joint("hd3")
    known = replace(
        joint,
        effects=(*joint.effects, *(f"channel_delay@{place}" for place in LATE)),
        fitted={**joint.fitted, **{f"{place}_delay": k * STEP for place, k in LATE.items()}},
    )
    time, table = readings()
    lead = max(LATE.values())
    shifts = np.array([6, 0, 0, 3, 0, 4])
    held = np.arange(len(table))[:, None] - shifts
    late = np.take_along_axis(table, np.maximum(held, 0), axis=0)
    plain = replace(known, fitted={**known.fitted, **{f"{p}_delay": 0.0 for p in LATE}})
    stop = 9000
    now = followed(plain, time[:stop], table[:stop], STEP)
    then = followed(known, time[: stop + lead], late[: stop + lead], STEP)
    assert then.samples.lag == pytest.approx(lead * STEP)
    assert then.samples.window == pytest.approx(now.samples.window, rel=1e-12, abs=1e-12)
    near_the_truth(then)


@pytest.mark.parametrize("late", [-1.3, 0.4, 2.0, 5.75])
def test_a_part_of_a_sample_is_exact_for_cubics(late: float) -> None:
    joint = reference_joint("hd3")
    known = replace(
        joint,
        effects=(*joint.effects, "channel_delay@drive"),
        fitted={**joint.fitted, "drive_delay": late * STEP},
    )
    found = Alignment.of(known.model(), SOURCES, STEP)
    times = np.arange(1.0 - found.taps.shape[1], 1.0)
    for at, source in enumerate(SOURCES):
        own = late if source == "drive" else 0.0
        for power in range(4):
            read = (times - own) ** power
            assert found.taps[at] @ read == pytest.approx((-found.lead) ** power, abs=1e-9)
    assert found.left == {"drive_delay": pytest.approx(0.0, abs=1e-12)}
