"""Noise models of subspace identification, its weights, and the order of simulated joints."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import get_args

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter

from benchmarks.algorithms.subspace_order import draw, identify
from identification.data.record import Record
from identification.errors import InputError
from identification.linear.hankel_qr import Method
from identification.linear.models import linear_models
from identification.linear.subspace import (
    MoespOptions,
    SubspaceOutcome,
    UnstableModelWarning,
    moesp,
)

FloatArray = npt.NDArray[np.float64]
DAISY = Path(__file__).resolve().parents[3].parent / "shared" / "measurements" / "daisy"

A = np.array([[0.9, 0.3, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.0, 0.7]])
B = np.array([[1.0, 0.0], [0.5, 1.0], [0.0, -1.0]])
C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]])
GAIN = np.array([[0.3, 0.1], [-0.2, 0.3], [0.1, 0.2]])
INNOVATION = np.array([[0.5, 0.1], [0.1, 0.3]])


def disturbed(seed: int, samples: int = 4000) -> tuple[FloatArray, FloatArray]:
    """A system in innovations form: its gain is known by construction."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((samples, 2))
    e = rng.multivariate_normal([0, 0], INNOVATION, samples)
    x, y = np.zeros(3), np.empty((samples, 2))
    for k in range(samples):
        y[k] = C @ x + e[k]
        x = A @ x + B @ u[k] + GAIN @ e[k]
    return u, y


def markov(a: FloatArray, b: FloatArray, c: FloatArray, count: int = 8) -> FloatArray:
    return np.array([c @ np.linalg.matrix_power(a, k) @ b for k in range(count)])


@pytest.mark.parametrize("method", [m for m in get_args(Method) if m != "ordinary"])
def test_gain_and_innovations_of_a_known_system(method: Method) -> None:
    """C A^k K does not hang on the coordinates of the state; its error is that of 4000 samples."""
    u, y = disturbed(0)
    found = moesp(u, y, 10, 3, method=method, options=MoespOptions(noise=True))
    assert found.noise is not None
    a, c = np.asarray(found.system.A), np.asarray(found.system.C)
    assert markov(a, found.noise.gain, c) == pytest.approx(markov(A, GAIN, C), abs=0.06)
    assert found.noise.innovation == pytest.approx(INNOVATION, abs=0.05)
    unseen_u, unseen_y = disturbed(1)
    error = unseen_y - found.predict(unseen_u, unseen_y)
    assert np.cov(error.T) == pytest.approx(INNOVATION, abs=0.05)
    # an observer that lags is no predictor: what is left is white
    assert abs(np.corrcoef(error[1:, 0], error[:-1, 0])[0, 1]) < 4 / np.sqrt(len(error))
    joint = np.block(
        [[found.noise.process, found.noise.cross], [found.noise.cross.T, found.noise.measurement]]
    )
    assert np.linalg.eigvalsh(joint).min() > -1e-12


def test_the_noise_is_in_the_units_of_the_outputs() -> None:
    """An output in other units, weighted back, is the same problem."""
    u, y = disturbed(2)
    scale = np.array([1.0, 1e3])
    plain = moesp(u, y, 10, 3, method="past_output", options=MoespOptions(noise=True))
    options = MoespOptions(noise=True, output_weights=(1.0, 1e-3))
    other = moesp(u, y * scale, 10, 3, method="past_output", options=options)
    assert plain.noise is not None and other.noise is not None
    assert other.noise.innovation / np.outer(scale, scale) == pytest.approx(
        plain.noise.innovation, rel=1e-8
    )
    assert other.predict(u, y * scale) / scale == pytest.approx(plain.predict(u, y), abs=1e-8)


def test_canonical_correlations_find_the_order_where_noise_is_of_the_size_of_the_output() -> None:
    orders = {
        method: [moesp(*disturbed(seed), 10, method=method).order for seed in range(4)]
        for method in ("past_output", "cva")  # type: tuple[Method, ...]
    }
    assert orders["cva"] == [3, 3, 3, 3]
    assert sum(n == 3 for n in orders["past_output"]) < 4


def test_past_inputs_alone_are_unbiased_under_noise_that_remembers() -> None:
    """Noise on the output that is coloured biases the ordinary method, not this one."""
    away = {}
    for method in ("ordinary", "past_input"):  # type: tuple[Method, ...]
        errors = []
        for seed in range(6):
            rng = np.random.default_rng(seed)
            u = rng.standard_normal(4000)
            noise = lfilter([1.0], [1.0, -0.95], rng.standard_normal(4000))
            y = lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.7], u) + noise
            poles = np.linalg.eigvals(moesp(u, y, 10, 2, method=method).system.A)
            errors.append(poles[np.argmax(poles.imag)] - complex(0.75, np.sqrt(0.7 - 0.75**2)))
        away[method] = abs(np.mean(errors))
    assert away["past_input"] < 0.01
    assert away["ordinary"] > 5 * away["past_input"]


def test_the_gain_is_that_which_slicot_prints() -> None:
    """IB01BD, example of its manual: C A^k K and the covariance of the output within 2 and 10 %;
    SLICOT takes the states from N4SID's step, these here from the past of each sample.
    """
    if not DAISY.is_dir():
        message = "the measurements folder ../shared/measurements/daisy is missing"
        pytest.fail(message) if os.environ.get("CI") else pytest.skip(message)
    text = (DAISY / "slicot_IB01BD.res").read_text()

    def printed(name: str) -> FloatArray:
        return np.array(text.split(name)[1].split(" The ")[0].split(), dtype=np.float64)

    lines = (DAISY / "slicot_IB01BD.dat").read_text().splitlines()
    start = next(k for k, line in enumerate(lines) if k > 1 and len(line.split()) == 1)
    values = np.array(" ".join(lines[start:]).split(), dtype=np.float64)
    u, y = values[:1000], values[1000:]
    found = moesp(u, y, 15, 4, method="past_output", options=MoespOptions(noise=True))
    assert found.noise is not None
    theirs = markov(
        printed("matrix A is").reshape(4, 4),
        printed("gain matrix K is")[:, None],
        printed("output matrix C is")[None],
    )
    ours = markov(np.asarray(found.system.A), found.noise.gain, np.asarray(found.system.C))
    assert ours == pytest.approx(theirs, rel=0.02)
    assert found.noise.measurement[0, 0] == pytest.approx(0.0012, rel=0.1)


def test_orders_of_simulated_joints_from_current_to_position() -> None:
    """Elastic and rigid, integrating and hanging, open and closed loop; figures of a hundred are
    printed by ``python -m benchmarks.algorithms.subspace_order``.
    """
    joints = [draw(seed) for seed in range(2000, 2010)]
    right = sum(identify(one).order == one.order for one in joints)
    assert right >= 9


def test_an_integrator_beyond_one_is_called_so() -> None:
    for seed in range(2000, 2040):
        one = draw(seed)
        if not one.integrates:
            continue
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = moesp(one.u, one.y, 20, one.order, 5e-3, "past_output")
        if found.spectral_radius < 1.0:
            continue
        assert found.outcome is SubspaceOutcome.INTEGRATES
        assert any(issubclass(w.category, UnstableModelWarning) for w in caught)
        assert np.isfinite(found.vaf_percent).all()
        return
    pytest.fail("no integrating joint came out beyond 1: the test does not test")


def test_an_unstable_plant_has_initial_states() -> None:
    rng = np.random.default_rng(0)
    a, b, x = np.array([[1.05, 0.3], [0.0, 0.8]]), np.array([0.0, 1.0]), np.array([0.5, -1.0])
    u, y = np.empty(2000), np.empty(2000)
    for k in range(2000):
        y[k] = x[0] + 1e-3 * rng.standard_normal()
        u[k] = -0.35 * x[0] - 0.75 * x[1] + rng.standard_normal()
        x = a @ x + b * u[k]
    with pytest.warns(UnstableModelWarning):
        found = moesp(u, y, 10, 2, method="past_output")
    assert found.outcome is SubspaceOutcome.UNSTABLE
    assert found.simulate(u[:20], found.x0[0])[:, 0] == pytest.approx(y[:20], abs=0.01)


def test_the_ordinary_method_has_no_gain_and_says_so() -> None:
    u, y = disturbed(3, 500)
    with pytest.raises(InputError, match="keeps no past"):
        moesp(u, y, 10, 3, options=MoespOptions(noise=True))
    with pytest.raises(InputError, match="no Kalman gain"):
        moesp(u, y, 10, 3).predict(u, y)


def test_a_reference_in_the_record_takes_the_bias_of_the_loop_away() -> None:
    """Coloured noise goes round the loop; the reference position serves as instrument."""
    pole = complex(0.75, np.sqrt(0.7 - 0.75**2))
    away = {True: [], False: []}  # type: dict[bool, list[float]]
    for seed in range(3):
        rng = np.random.default_rng(seed)
        asked = lfilter([0.3], [1.0, -0.7], rng.standard_normal(4000))
        noise = lfilter([1.0], [1.0, -0.9], rng.standard_normal(4000))
        x, u, y = np.zeros(4000), np.zeros(4000), np.zeros(4000)
        for k in range(4000):
            if k > 1:
                x[k] = 1.5 * x[k - 1] - 0.7 * x[k - 2] + u[k - 1] + 0.5 * u[k - 2]
            y[k] = x[k] + noise[k]
            u[k] = asked[k] - 0.25 * y[k]
        channels = {"motor_torque": u, "motor_velocity": y, "reference_position": asked}
        for known in (True, False):
            kept = channels if known else {k: channels[k] for k in list(channels)[:2]}
            record = Record.from_channels(0.01 * np.arange(4000), kept)
            found = linear_models([record], families=["oe"], max_order=2, every=1)
            assert found.instrument is known
            assert found.closed_loop is True or not known
            poles = [p.value for p in found.best.poles[0] if p.is_pair]
            away[known].append(min((abs(p - pole) for p in poles), default=1.0))
    assert np.mean(away[True]) < 0.5 * np.mean(away[False])
