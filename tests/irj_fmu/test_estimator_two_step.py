"""Two-step algorithm and guard inside the estimator: shapes found, failures sat out, state
bit-exact during a search.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from identification.online.estimator import (
    OnlineEstimator,
    OnlineOptions,
    estimated_parameters,
    searched_parameters,
)
from identification.online.guard import Guard
from identification.online.rows import RowMaker
from identification.online.shapes.rows import RowWindow
from identification.recursive.estimator import RecursiveLeastSquares, Settings
from identification.two_step.algorithm import Shape
from irj_fmu.convergence import Bench, failure, forgotten
from irj_fmu.host.run import Fmu, Instance
from irj_fmu.plant.reference import NAMES, reference_joint

FloatArray = npt.NDArray[np.float64]
STEP = 1e-3
GOOD = [True] * 6


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """Readings of hd3 on its motion, and an estimator FMU that knows no value."""
    return Bench(reference_joint("hd3"), "start", tmp_path_factory.mktemp("bench"))


@pytest.fixture(scope="module")
def readings(bench: Bench) -> list[list[float]]:
    """The same, link-referred."""
    ratio, gain = bench.joint.gear_ratio, bench.joint.torque_per_current or 1.0
    found: list[list[float]] = (bench.table * [gain, 1 / ratio, 1 / ratio, 1.0, 1.0, 1.0]).tolist()
    return found


def feed(estimator: OnlineEstimator, table: list[list[float]], first: int, last: int) -> None:
    for k in range(first, last):
        estimator.update(k * STEP, table[k], GOOD)


def seen(estimator: OnlineEstimator) -> tuple[bytes, ...]:
    two = estimator.two_step
    assert two is not None
    return (
        estimator.theta.tobytes(),
        two.eta.tobytes(),
        estimator.ratio.tobytes(),
        bytes([two.searching, two.searches]),
    )


def test_what_is_searched() -> None:
    """Velocities and exponents of Stribeck laws; the thesis's smooth law with its width; no
    jump's smoothing.
    """
    found = {n: searched_parameters(reference_joint(n)) for n in NAMES}
    stribeck = ("motor_stribeck_velocity", "motor_stribeck_exponent")
    assert found["hd3"] == found["hd4"] == stribeck
    assert found["irj_ts"] == (
        "motor_smooth_stribeck_velocity",
        "motor_smooth_stribeck_exponent",
        "motor_smoothing_velocity",
    )
    assert all(found[n] == () for n in ("hd1", "hd2", "irj1a", "irj1b", "irj2a", "irj2b"))
    assert not set(found["hd3"]) & set(estimated_parameters(reference_joint("hd3")))


def test_rows_of_a_window_equal_the_rows_made(readings: list[list[float]]) -> None:
    """The separable model at the present shapes gives the rows of the row maker; at other
    shapes, those of a maker built for them.
    """
    joint = reference_joint("hd3")
    held = OnlineEstimator(joint, STEP)
    assert held.two_step is not None
    maker, balances = held.rows, held.two_step.balances
    made, signals, points = [], [], []
    window = np.array([[row[1], row[3], row[5], row[0]] for row in readings])
    size, stride = maker.timing.window, maker.timing.stride
    for end in range(size, size + 40 * stride, stride):
        row = maker.make(window[end - size : end], end * STEP)
        made.append(row)
        signals.append(maker.signals.copy())
        points.append(maker.new_points[:, list(balances.used)].copy())
    kept = RowWindow(
        np.array(signals), np.zeros((40, 2)), np.ones((40, 3), dtype=bool), np.array(points)
    )
    eta = np.array([joint.fitted[n] for n in balances.shapes])
    y, h = balances.table(kept, eta, lambda: None)
    expected = [row for row in made if row is not None][-len(y) :]
    np.testing.assert_allclose(y, [row[0] for row in expected], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(h, [row[1] for row in expected], rtol=1e-11, atol=1e-11)
    theta = held.theta
    separable, free, index = balances.model(
        kept, np.ones((len(y), 3)), eta, theta, (), lambda: None
    )
    assert balances.balances == (0,)
    np.testing.assert_allclose(
        separable.matrix(index, eta)[:, 0], h[:, 0, list(balances.coefficients)], rtol=1e-12
    )
    other = 1.7 * eta
    moved = RowMaker(
        held.model.with_values(dict(zip(balances.shapes, other.tolist(), strict=True))),
        held.sensing,
        STEP,
    )
    shaped = RowMaker(held.model, held.sensing, STEP, (), balances.shapes)
    shaped.set_shapes(other)
    for end in range(size, size + 20 * stride, stride):
        first, second = (m.make(window[end - size : end], end * STEP) for m in (moved, shaped))
        if first is not None and second is not None:
            np.testing.assert_allclose(second[1], first[1], rtol=1e-9, atol=1e-12)


def test_slopes_of_the_shapes(readings: list[list[float]]) -> None:
    """Analytic derivative with respect to the shapes against central differences."""
    held = OnlineEstimator(reference_joint("hd3"), STEP)
    feed(held, readings, 0, 3000)
    assert held.two_step is not None
    kept, balances = held.two_step.window(), held.two_step.balances
    eta = np.array([0.04, 1.2])
    shapes = [Shape(n, 0.01, 2.0, 1.0) for n in balances.shapes]
    separable, _, index = balances.model(
        kept, np.ones((len(kept.signals) - balances.lead, 3)), eta, held.theta, shapes, lambda: None
    )
    theta = np.arange(1.0, 1.0 + len(balances.coefficients))
    found = separable.gradient(index, eta, theta)
    for i in range(2):
        step = np.zeros(2)
        step[i] = 1e-6 * eta[i]
        high, low = (separable.matrix(index, eta + sign * step) @ theta for sign in (1.0, -1.0))
        np.testing.assert_allclose(
            found[:, :, i],
            (high - low) / (2 * step[i]),
            rtol=1e-5,
            atol=1e-6 * float(np.abs(found).max()),
        )


def test_finds_every_parameter(bench: Bench) -> None:
    """As an FMU, no value known: linear ones within 2 %, the Stribeck law's size and velocity
    within 10 %, after 40 s.
    """
    found = bench.run(None)
    assert [r.name for r in found.rows if r.name.startswith("motor_stribeck")] == [
        "motor_stribeck_extra",
        "motor_stribeck_velocity",
        "motor_stribeck_exponent",
    ]
    assert [(r.name, r.error) for r in found.rows if not r.passed] == []
    assert (
        found.searches == 3
    )  # the first window, and the refinements on half of the full one and all of it


def test_sits_out_a_failed_sensor(bench: Bench) -> None:
    """A biased torque sensor for five seconds, with nobody to tell: the same limits."""
    found = bench.run(failure("bias", "torque", "start", 1.0))
    assert [(r.name, r.error) for r in found.rows if not r.passed] == []


def test_state_during_a_search_is_bit_exact(bench: Bench, readings: list[list[float]]) -> None:
    """Roll-back in the same instance, and a new instance from the bytes, go on as the straight
    run did.
    """
    joint = forgotten(bench.joint)
    straight = OnlineEstimator(joint, STEP)
    feed(straight, readings, 0, 7600)
    assert straight.two_step is not None
    assert straight.two_step.searching
    state = straight.state()
    feed(straight, readings, 7600, 10500)
    expected = seen(straight)
    assert not straight.two_step.searching
    assert not np.array_equal(straight.two_step.eta, OnlineEstimator(joint, STEP).rows.shape_values)
    after = straight.state()
    feed(straight, readings, 10500, 11000)
    later = seen(straight)
    for saved, first, last, wanted in (
        (state, 7600, 10500, expected),
        (after, 10500, 11000, later),
    ):
        for estimator in (straight, OnlineEstimator(joint, STEP)):
            estimator.restore(saved)
            feed(estimator, readings, first, last)
            assert seen(estimator) == wanted


def test_fmu_state_during_a_search(bench: Bench) -> None:
    """The same through FMI: roll-back and serialised bytes."""
    with Fmu(bench.file) as fmu:
        at = {n: v.valueReference for n, v in fmu.variables.items()}
        inputs = [at[n] for n in ("i_m", "q_m", "w_m", "q_l", "w_l", "tau_l")]
        outputs = [at[n] for n in at if n.startswith(("theta[", "eta[", "ratio."))]

        def run(instance: Instance, first: int, last: int) -> list[float]:
            for k in range(first, last):
                instance.call("setReal", inputs, bench.table[k].tolist())
                instance.call("doStep", k * STEP, STEP)
            return list(instance.call("getReal", outputs))

        with Instance(fmu, name="one") as one, Instance(fmu, name="two") as two:
            for instance in (one, two):
                instance.begin(0.0, {"portions": 5})
                instance.ready()
            run(one, 0, 7200)
            assert one.call("getBoolean", [at["searching"]]) == [True]
            state = one.call("getFMUstate")
            bytes_ = one.call("serializeFMUstate", state)
            straight = run(one, 7200, 8200)
            assert one.call("getBoolean", [at["searching"]]) == [False]
            assert one.call("getInteger", [at["n_searches"]]) == [1]
            one.call("setFMUstate", state)
            assert run(one, 7200, 8200) == straight
            two.call("setFMUstate", two.call("deSerializeFMUstate", bytes_))
            assert run(two, 7200, 8200) == straight
            one.call("freeFMUstate", state)


def test_the_budget_is_kept(bench: Bench, readings: list[list[float]]) -> None:
    """Twice the portions per sample: half the samples, the same result to the last bit."""
    lengths, found = [], []
    for portions in (4, 8):
        made = OnlineEstimator(forgotten(bench.joint), STEP, OnlineOptions(portions=portions))
        feed(made, readings, 0, 7072)
        assert made.two_step is not None
        k = 7072
        while made.two_step.searching:
            made.update(k * STEP, readings[k], GOOD)
            k += 1
        lengths.append(k - 7072)
        found.append(made.two_step.eta)
    assert lengths[1] == pytest.approx(lengths[0] / 2, abs=2)
    assert np.array_equal(*found)


def test_on_request_and_off(bench: Bench, readings: list[list[float]]) -> None:
    """A fitted joint searches when asked; with the optimiser off there is none."""
    made = OnlineEstimator(bench.joint, STEP, OnlineOptions(detect=False, portions=20))
    feed(made, readings, 0, 7500)
    assert made.two_step is not None
    assert made.two_step.searches == 0
    assert made.reoptimise()
    feed(made, readings, 7500, 8600)
    assert made.two_step.searches == 1
    assert made.two_step.eta[0] == pytest.approx(0.05, rel=0.1)
    off = OnlineEstimator(bench.joint, STEP, OnlineOptions(optimise=False))
    assert off.two_step is None
    assert not off.reoptimise()


def test_a_changed_law_asks_for_a_search(
    readings: list[list[float]], bench: Bench, tmp_path: Path
) -> None:
    """Friction with another Stribeck law from 12 s on: the flag rises, the search finds it."""
    joint = bench.joint
    other = replace(
        joint,
        name="worn",
        fitted={**joint.fitted, "motor_stribeck_velocity": 0.15, "motor_stribeck_extra": 16.0},
    )
    ratio, gain = joint.gear_ratio, joint.torque_per_current or 1.0
    worn = (
        Bench(other, "fitted", tmp_path).table * [gain, 1 / ratio, 1 / ratio, 1.0, 1.0, 1.0]
    ).tolist()
    made = OnlineEstimator(joint, STEP, OnlineOptions(detect=False, portions=10))
    feed(made, readings, 0, 12000)
    assert not made.wanted
    assert made.two_step is not None
    wanted = False
    for k in range(12000, 36000):
        made.update(k * STEP, worn[k], GOOD)
        wanted = wanted or made.wanted
    assert wanted
    assert made.two_step.searches >= 1
    found = dict(
        zip(
            (*made.names, *made.two_step.rows.shapes),
            (*made.theta, *made.two_step.eta),
            strict=True,
        )
    )
    assert found["motor_stribeck_velocity"] == pytest.approx(0.15, rel=0.1)
    assert found["motor_stribeck_extra"] == pytest.approx(16.0, rel=0.1)
    assert found["motor_inertia"] == pytest.approx(joint.fitted["motor_inertia"], rel=0.02)


def guard_run(
    changes: dict[int, tuple[FloatArray, float]], stop: int
) -> tuple[list[str], FloatArray, FloatArray]:
    """Two balances with two parameters each, one an inertia; what the guard says of changed
    parameters and offsets.
    """
    rng = np.random.default_rng(2)
    names = ("motor_inertia", "motor_viscous", "link_inertia", "link_viscous")
    theta, offset = np.array([4.0, 20.0, 10.0, 9.0]), 0.0
    settings = Settings(sample_time=0.016, drift=3e-3, alarm_drift=1.0)
    est = RecursiveLeastSquares(theta, np.abs(theta), outputs=2, names=names, settings=settings)
    guard = Guard(names, ("motor", "link"), 0.016)
    est.update(np.zeros(2), np.zeros((2, 4)))
    guard.start(est)
    told, level, before = [], np.full(2, 0.05), theta
    for k in range(stop):
        if k in changes:
            before = guard.theta
            theta, offset = changes[k]
        h = np.zeros((2, 4))
        h[0, :2], h[1, 2:] = rng.normal(size=2), rng.normal(size=2)
        y = h @ theta + offset + 0.05 * rng.normal(size=2)
        error = np.vstack([y - guard.before @ h.T, np.zeros(2)])
        est.update(y, h)
        signals = np.array([y, h @ guard.theta, np.ones(2)])
        told.append(guard.step(est, est.theta, error, level, np.ones(2, dtype=bool), signals))
    return [t for t in told if t], guard.theta, before


def test_guard_accepts_what_a_joint_can_do() -> None:
    """Friction that rises and a payload are followed; a disturbance of both balances, or the gain
    of one torque, is held off, and gone back from bit by bit.
    """
    healthy = np.array([4.0, 20.0, 10.0, 9.0])
    told, theta, _ = guard_run({300: (np.array([4.0, 30.0, 10.0, 9.0]), 0.0)}, 900)
    assert told == ["held", "accepted"]
    assert theta == pytest.approx([4.0, 30.0, 10.0, 9.0], rel=0.02)
    told, theta, _ = guard_run({300: (np.array([4.0, 20.0, 14.0, 9.0]), 0.0)}, 900)
    assert told == ["held", "accepted"]  # a payload
    assert theta == pytest.approx([4.0, 20.0, 14.0, 9.0], rel=0.02)
    told, theta, before = guard_run({300: (healthy, 5.0), 600: (healthy, 0.0)}, 700)
    assert told == ["held", "back"]
    assert theta == pytest.approx(before, rel=0.01)
    told, theta, before = guard_run({300: (0.7 * healthy, 0.0)}, 900)
    assert told == ["held"]
    assert theta == pytest.approx(before, rel=0.01)
    told, theta, before = guard_run({300: (healthy * [0.7, 0.7, 1.0, 1.0], 0.0)}, 900)
    assert told == ["held"]
    assert theta == pytest.approx(before, rel=0.01)
