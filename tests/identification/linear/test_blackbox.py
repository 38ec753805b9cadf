"""Black-box models against systems known in advance, and the linear ceiling."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter

from identification.errors import InputError
from identification.linear.blackbox import BlackBoxOutcome, Structure, blackbox, linear_ceiling
from identification.linear.prediction_error import Orders, _Problem, prediction_error_fit

FloatArray = npt.NDArray[np.float64]
DAISY = Path(__file__).resolve().parents[3].parent / "shared" / "measurements" / "daisy"

POLES = np.array([1.0, -1.5, 0.7])
ZEROS = np.array([0.0, 1.0, 0.5])
COLOUR = np.array([1.0, -0.8, 0.2])
WHITE = np.array([1.0, -0.4, 0.1])


def record(
    structure: str, samples: int, noise: float, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    u, e = rng.standard_normal(samples), noise * rng.standard_normal(samples)
    response = lfilter(ZEROS, POLES, u)
    numerator, denominator = {
        "arx": (np.ones(1), POLES),
        "armax": (COLOUR, POLES),
        "oe": (np.ones(1), np.ones(1)),
        "bj": (COLOUR, WHITE),
    }[structure]
    disturbance = lfilter(numerator, denominator, e)
    return u, response + disturbance


@pytest.mark.parametrize("structure", ["arx", "armax", "oe", "bj"])
def test_noise_free_system_is_recovered(structure: Structure) -> None:
    u, y = record(structure, 400, 0.0)
    model = blackbox(u, y, structure, 2, 0.01)
    numerator, denominator = model.system.num[0][0], model.system.den[0][0]
    assert denominator == pytest.approx(POLES, abs=1e-6)
    assert np.concatenate((np.zeros(3 - len(numerator)), numerator)) == pytest.approx(
        ZEROS, abs=1e-6
    )
    assert model.vaf_percent == pytest.approx([100.0], abs=1e-6)
    assert model.system.dt == 0.01
    assert model.outcome is BlackBoxOutcome.CONVERGED


@pytest.mark.parametrize("structure", ["arx", "armax", "oe", "bj"])
def test_estimates_are_within_their_asymptotic_standard_error(structure: Structure) -> None:
    """Ljung (1999), eq. 9.17: covariance = noise variance times the inverse of J'J."""
    u, y = record(structure, 8000, 0.5, seed=3)
    orders = Orders(structure, 2, 0, 1)
    model, _ = prediction_error_fit([(u[:, None], y)], orders)
    problem = _Problem([(u[:, None], y)], orders)
    x = problem.pack(model)
    jacobian = problem.jacobian(x)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * problem.cost(x) / len(y)
    monic = {"a": POLES, "f": POLES, "c": COLOUR, "d": WHITE}
    truth = np.concatenate((ZEROS, *(monic[name][1:] for name in orders.free)))
    error = x[: len(truth)] - truth
    assert np.all(np.abs(error) < 4.0 * np.sqrt(np.diag(covariance)[: len(truth)]))
    # the prediction error of the right structure has the variance of the noise
    assert problem.cost(x) * (y @ y) / len(y) == pytest.approx(0.25, rel=4 * np.sqrt(2 / len(y)))


@pytest.mark.parametrize("structure", ["armax", "oe", "bj"])
def test_jacobian_is_the_derivative_of_the_residual(structure: Structure) -> None:
    u, y = record(structure, 60, 0.3, seed=4)
    orders = Orders(structure, 2, 1, 1)
    records = [(u[:40, None], y[:40]), (u[40:, None], y[40:])]
    problem = _Problem(records, orders)
    model, _ = prediction_error_fit(records, orders)
    x = problem.pack(model) + 0.01 * np.random.default_rng(5).standard_normal(
        len(problem.pack(model))
    )
    step = 1e-6
    numeric = np.column_stack(
        [
            (problem.residual(x + step * unit) - problem.residual(x - step * unit)) / (2 * step)
            for unit in np.eye(len(x))
        ]
    )
    assert problem.jacobian(x) == pytest.approx(numeric, abs=1e-7)


def test_the_right_noise_model_beats_arx_under_output_noise() -> None:
    u, y = record("oe", 4000, 2.0, seed=6)
    clean = lfilter(ZEROS, POLES, u)
    error = {}
    structures: tuple[Structure, ...] = ("arx", "oe")
    for structure in structures:
        system = blackbox(u, y, structure, 2).system
        numerator = np.concatenate((np.zeros(3 - len(system.num[0][0])), system.num[0][0]))
        simulated = lfilter(numerator, system.den[0][0], u)
        error[structure] = np.linalg.norm(simulated - clean) / np.linalg.norm(clean)
    assert error["oe"] < 0.05
    assert error["arx"] > 5 * error["oe"]


def test_several_inputs_outputs_records_and_a_delay() -> None:
    rng = np.random.default_rng(7)
    records_u, records_y = [], []
    for samples in (300, 500):
        u = rng.standard_normal((samples, 2))
        late = np.vstack((np.zeros((3, 2)), u[:-3]))
        first = lfilter([1.0, 0.3], POLES, late[:, 0]) + lfilter([0.5], POLES, late[:, 1])
        second = lfilter([0.2], [1.0, -0.9], late[:, 1])
        records_u.append(u)
        records_y.append(
            np.column_stack((first, second)) + 1e-3 * rng.standard_normal((samples, 2))
        )
    model = blackbox(records_u, records_y, "oe", 2, delay=3)
    assert model.system.ninputs == model.system.noutputs == 2
    assert np.all(model.vaf_percent > 99.99)
    assert model.polynomials[0].f == pytest.approx(POLES, abs=1e-3)
    assert np.all(model.polynomials[0].b[:, :3] == 0.0)
    gain = np.real(model.system(1.0))
    assert gain == pytest.approx(np.array([[6.5, 2.5], [0.0, 2.0]]), abs=0.01)


def test_a_record_that_starts_in_motion_is_fitted() -> None:
    u, y = record("oe", 900, 0.0, seed=8)
    model = blackbox(u[500:], y[500:], "oe", 2)
    assert model.polynomials[0].f == pytest.approx(POLES, abs=1e-6)
    assert model.vaf_percent == pytest.approx([100.0], abs=1e-6)


def test_an_unstable_arx_says_so() -> None:
    u = np.random.default_rng(9).standard_normal(200)
    model = blackbox(u, lfilter([0.0, 1.0], [1.0, -1.03], u), "arx", 1)
    assert model.outcome is BlackBoxOutcome.UNSTABLE
    assert np.isnan(model.vaf_percent).all()
    assert model.spectral_radius == pytest.approx(1.03, abs=1e-6)


def test_ceiling_of_a_linear_system_is_set_by_its_noise() -> None:
    u, y = record("oe", 8000, 1.0, seed=10)
    ceiling = linear_ceiling(u, y)
    expected = 100 * (1 - 1.0 / y[6000:].var())
    assert ceiling.vaf_percent == pytest.approx([expected], abs=0.6)
    assert ceiling.tried[0][0] == ceiling.best


def test_ceiling_of_a_nonlinear_system_is_what_its_linear_part_explains() -> None:
    # y = u^3 of a Gaussian u: the best linear predictor 3 u explains 9/15 of the variance
    u = np.random.default_rng(11).standard_normal(200_000)
    ceiling = linear_ceiling(u, u**3, structures=("arx",), orders=(1, 2), fit_samples=100_000)
    assert ceiling.vaf_percent == pytest.approx([60.0], abs=2.5)


def test_ceiling_of_the_robot_arm() -> None:
    if not DAISY.is_dir():
        message = "the measurements folder ../shared/measurements/daisy is missing"
        pytest.fail(message) if os.environ.get("CI") else pytest.skip(message)
    data = np.loadtxt(DAISY / "robot_arm.csv", delimiter=",", skiprows=1)
    ceiling = linear_ceiling(
        data[:, 0], data[:, 1], structures=("arx", "oe", "moesp"), orders=(2, 4)
    )
    assert ceiling.best.endswith(" 4")
    assert ceiling.vaf_percent[0] > 99.0


BAD: list[tuple[str, dict[str, object]]] = [
    ("structure 'tree' is unknown", {"structure": "tree"}),
    ("order is 0", {"order": 0}),
    ("delay is -1", {"delay": -1}),
    ("held_out is 0.8", {"held_out": 0.8}),
    ("dt is 0", {"dt": 0.0}),
    ("y channel 0 holds nan at sample 2", {"y": np.where(np.arange(300) == 2, np.nan, 1.0)}),
    ("u channel 0 is constant at 2", {"u": np.full(300, 2.0)}),
    ("u has 9 samples and y has 300", {"u": np.arange(9.0)}),
    ("samples after holding out", {"u": np.arange(9.0), "y": np.arange(9.0) ** 2}),
]


@pytest.mark.parametrize(("message", "changes"), BAD, ids=[message for message, _ in BAD])
def test_bad_input_is_refused_in_one_line(message: str, changes: dict[str, object]) -> None:
    u, y = record("oe", 300, 0.1)
    with pytest.raises(InputError) as caught:
        blackbox(**{"u": u, "y": y, **changes})  # type: ignore[arg-type]
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_ceiling_refuses_bad_settings() -> None:
    u, y = record("oe", 300, 0.1)
    with pytest.raises(InputError, match="no structure"):
        linear_ceiling(u, y, structures=())
    with pytest.raises(InputError, match="'arma' is unknown"):
        linear_ceiling(u, y, structures=("arma",))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="orders are"):
        linear_ceiling(u, y, orders=(0,))
    with pytest.raises(InputError, match="every linear model tried is unstable"):
        linear_ceiling(u, lfilter([0.0, 1.0], [1.0, -1.05], u), structures=("arx",), orders=(1,))
