"""Subspace models of plants that integrate or are unstable: input matrices, simulation, order."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from identification.linear.subspace import SubspaceOutcome, moesp

FloatArray = npt.NDArray[np.float64]

pytestmark = pytest.mark.filterwarnings(
    "ignore::identification.linear.subspace.UnstableModelWarning"
)
A = np.array([[1.05, 0.3], [0.0, 0.8]])
B = np.array([[0.0], [1.0]])
C = np.array([[1.0, 0.0]])
GAIN = np.array([[0.35, 0.75]])
FREQUENCIES = np.linspace(0.02, 3.0, 200)


def stabilised(seed: int, samples: int, noise: float) -> tuple[FloatArray, FloatArray]:
    """An unstable plant held by a controller, driven by white noise; the sensor's noise does
    not reach the controller.
    """
    rng = np.random.default_rng(seed)
    x, u, y = np.zeros(2), np.zeros((samples, 1)), np.zeros((samples, 1))
    for k in range(samples):
        y[k] = C @ x + noise * rng.standard_normal()
        u[k] = -GAIN @ x + rng.standard_normal()
        x = A @ x + B @ u[k]
    return u, y


def integrators(seed: int, samples: int) -> tuple[FloatArray, FloatArray]:
    """Position of a mass that a force drives, both disturbed: a double integrator, as a ball on
    a beam.
    """
    rng = np.random.default_rng(seed)
    u = np.zeros((samples, 1))
    x, y = np.zeros(2), np.zeros((samples, 1))
    for k in range(samples):
        y[k] = x[0] + 0.002 * rng.standard_normal()
        u[k] = -0.5 * x[0] - 1.2 * x[1] + rng.standard_normal()
        x = np.array([x[0] + 0.1 * x[1], x[1] + 0.1 * (u[k, 0] + 0.02 * rng.standard_normal())])
    return u, y


def response(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    eye = np.eye(len(a))
    found: FloatArray = np.array(
        [(c @ np.linalg.solve(np.exp(1j * w) * eye - a, b) + d)[0, 0] for w in FREQUENCIES]
    )
    return found


def error(seed: int, samples: int, noise: float, **options: object) -> tuple[float, float, float]:
    """Error of the frequency response [%], growth over the record as a power of ten, VAF [%]."""
    from identification.linear.subspace import MoespOptions

    u, y = stabilised(seed, samples, noise)
    found = moesp(u, y, 10, order=2, method="past_output", options=MoespOptions(**options))  # type: ignore[arg-type]
    assert found.outcome is SubspaceOutcome.UNSTABLE
    true = response(A, B, C, np.zeros((1, 1)))
    got = response(found.system.A, found.system.B, found.system.C, found.system.D)
    away = 100 * float(np.linalg.norm(got - true) / np.linalg.norm(true))
    return away, samples * float(np.log10(found.spectral_radius)), float(found.vaf_percent[0])


def test_growth_that_fits_into_the_digits_is_simulated() -> None:
    away, growth, vaf = error(0, 300, 1e-3)
    assert 6 < growth < 12
    assert away < 0.1
    assert vaf > 99.9


def test_growth_of_forty_powers_of_ten_leaves_the_input_matrices_right() -> None:
    """From shots; the whole record cannot be simulated and nothing is claimed of it."""
    away, growth, vaf = error(0, 2000, 0.1)
    assert growth > 40
    assert away < 1.0
    assert np.isnan(vaf)
    shots = [error(seed, 600, 0.3)[0] for seed in range(6)]
    shift = [error(seed, 600, 0.3, input_matrices="shift")[0] for seed in range(6)]
    assert np.mean(shots) < np.mean(shift)


def test_order_of_a_double_integrator() -> None:
    """Judged on short pieces of the held-out samples, which no order that fades explains; the
    choice is told.
    """
    right = 0
    for seed in range(6):
        found = moesp(*integrators(seed, 2000), 10, method="past_output")
        assert found.order >= 2
        assert np.isfinite(found.held_out_vaf_percent).all()
        right += found.order == 2
    assert right >= 5
