"""FIR, ARMA, ARARX and ARARMAX against systems known in advance, and what their poles are said to
be.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter

from identification.linear.blackbox import Structure, blackbox
from identification.linear.jackknife import pole_covariances
from identification.linear.poles import pole, poles_of
from identification.linear.prediction_error import Orders, _Problem, prediction_error_fit
from identification.linear.subspace import moesp

FloatArray = npt.NDArray[np.float64]

A = np.array([1.0, -1.5, 0.7])
B = np.array([0.0, 1.0, 0.5])
C = np.array([1.0, -0.8, 0.2])
D = np.array([1.0, -0.4, 0.1])
ONE = np.ones(1)
TRUE_POLE = complex(0.75, np.sqrt(0.7 - 0.75**2))
SYSTEMS: dict[Structure, tuple[FloatArray, FloatArray, FloatArray, FloatArray]] = {
    # B and F, then numerator and denominator of the noise
    "fir": (B, ONE, ONE, ONE),
    "arx": (B, A, ONE, A),
    "arma": (np.zeros(1), ONE, C, A),
    "armax": (B, A, C, A),
    "ararx": (B, A, ONE, np.convolve(A, D)),
    "ararmax": (B, A, C, np.convolve(A, D)),
    "oe": (B, A, ONE, ONE),
    "bj": (B, A, C, D),
}


def record(
    structure: Structure, samples: int, noise: float, seed: int
) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    u, e = rng.standard_normal(samples), noise * rng.standard_normal(samples)
    b, f, numerator, denominator = SYSTEMS[structure]
    return u, lfilter(b, f, u) + lfilter(numerator, denominator, e)


@pytest.mark.parametrize("structure", ["fir", "arma", "ararx", "ararmax"])
def test_coefficients_are_within_their_asymptotic_standard_error(structure: Structure) -> None:
    """Ljung (1999), eq. 9.17."""
    u, y = record(structure, 8000, 0.5, 3)
    inputs = u[:, None][:, : 0 if structure == "arma" else 1]
    orders = Orders(structure, 2, 0, inputs.shape[1])
    model, settled = prediction_error_fit([(inputs, y)], orders)
    assert settled
    problem = _Problem([(inputs, y)], orders)
    x = problem.settled(model)
    jacobian = problem.jacobian(x)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * problem.cost(x) / len(y)
    monic = {"a": A, "c": C, "d": D}
    truth = np.concatenate((B if len(inputs.T) else [], *(monic[n][1:] for n in orders.free)))
    error = x[: len(truth)] - truth
    assert np.all(np.abs(error) < 4.0 * np.sqrt(np.diag(covariance)[: len(truth)]))
    assert problem.cost(x) * (y @ y) / len(y) == pytest.approx(0.25, rel=4 * np.sqrt(2 / len(y)))


@pytest.mark.parametrize("structure", ["arma", "ararx", "ararmax"])
def test_jacobian_is_the_derivative_of_the_residual(structure: Structure) -> None:
    u, y = record(structure, 80, 0.3, 4)
    inputs = u[:, None][:, : 0 if structure == "arma" else 1]
    orders = Orders(structure, 2, 0, inputs.shape[1])
    problem = _Problem([(inputs, y)], orders)
    x = problem.pack(prediction_error_fit([(inputs, y)], orders)[0])
    x = x + 0.01 * np.random.default_rng(5).standard_normal(len(x))
    step = 1e-6
    numeric = np.column_stack(
        [
            (problem.residual(x + step * unit) - problem.residual(x - step * unit)) / (2 * step)
            for unit in np.eye(len(x))
        ]
    )
    assert problem.jacobian(x) == pytest.approx(numeric, abs=1e-7)


@pytest.mark.parametrize("structure", [s for s in SYSTEMS if s != "fir"])
def test_poles_are_as_far_off_as_their_covariance_says(structure: Structure) -> None:
    """Over 25 records the squared distance in its own covariance is that of two normal numbers:
    mean 2, deviation 2 / sqrt(25).
    """
    distances = []
    for seed in range(25):
        model = blackbox(*record(structure, 1500, 0.5, seed), structure, 2, 0.01, held_out=0.0)
        found = model.poles[0][0]
        away = np.array([found.value.real - TRUE_POLE.real, found.value.imag - TRUE_POLE.imag])
        distances.append(float(away @ np.linalg.solve(found.covariance, away)))
    assert 2.0 - 4 * 0.4 < np.mean(distances) < 2.0 + 4 * 0.4


def test_poles_of_a_subspace_model_are_as_far_off_as_the_blocks_say() -> None:
    """With twelve blocks the mean is that of an F distribution: 2 * 11 / 9."""
    distances = []
    for seed in range(25):
        u, y = record("oe", 3000, 1.0, seed)
        a = np.asarray(moesp(u, y, 10, 2, 0.01).system.A)
        known = pole_covariances([(u[:, None], y[:, None])], 10, a, "ordinary", (1.0,))
        assert known is not None
        values = np.linalg.eigvals(a)
        k = int(np.argmax(values.imag))
        away = np.array([values[k].real - TRUE_POLE.real, values[k].imag - TRUE_POLE.imag])
        distances.append(float(away @ np.linalg.solve(known[k], away)))
    assert 1.0 < np.mean(distances) < 2.45 + 4 * 0.6


def test_frequency_and_damping_of_a_pole_and_their_deviations() -> None:
    """Against differences of the same figures."""
    dt, z = 0.01, 0.9 * np.exp(0.3j)
    known = np.diag([1e-6, 4e-6])
    found = pole(z, dt, known)
    s = np.log(z) / dt
    assert found.frequency == pytest.approx(abs(s) / 2 / np.pi)
    assert found.damping == pytest.approx(-s.real / abs(s))
    h = 1e-7
    for name in ("frequency", "damping"):
        slope = [
            (getattr(pole(z + step, dt), name) - getattr(pole(z - step, dt), name)) / (2 * h)
            for step in (h, 1j * h)
        ]
        expected = np.sqrt(np.array(slope) ** 2 @ np.diag(known))
        assert getattr(found, f"{name}_deviation") == pytest.approx(expected, rel=1e-5)
    assert [round(p.value.real, 6) for p in poles_of([1.0, -1.3, 0.4], dt)] == [0.8, 0.5]


def test_a_time_series_is_predicted_and_not_simulated() -> None:
    """The best prediction of ``A y = C e`` leaves e: its share of the variance of y."""
    u, y = record("arma", 6000, 1.0, 7)
    model = blackbox(u, y, "arma", 2)
    expected = 100.0 * (1.0 - 1.0 / y[4500:].var())
    assert model.prediction_vaf_percent == pytest.approx([expected], abs=2.0)
    assert model.vaf_percent[0] < 5.0
    assert float(np.abs(model.system(1.0))) == 0.0
