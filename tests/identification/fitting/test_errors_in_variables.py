"""Noise of the positions takes nothing off an inertia, and the bands of a fit cover."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array

from identification import Joint, Record, fit, load_joint, read
from identification.balance.dataset import load_dataset, prepared_model
from identification.balance.drawn_noise import LONGEST
from identification.balance.excitation import attenuation
from identification.fitting.covariance import (
    BLOCK,
    OVERLAP,
    window_errors,
    windows_over,
)
from identification.fitting.errors_in_variables import (
    MOST_NOISE,
    NoiseProducts,
    whole_without,
)
from tests.recorded_world._engine import library
from tests.recorded_world.world import make_case, write_case

DT, JOINTS = 2e-3, 40
NAMES = ("link_inertia", "link_viscous", "gravity_torque")
JOINT = Joint(name="arm", gear_ratio=1.0, model_name="hd1", effects=("viscous@link", "gravity"))


def run(seed: int, seconds: float = 30.0) -> tuple[Record, dict[str, float]]:
    """A link under a measured torque; the truth is known in closed form."""
    rng = np.random.default_rng(880_000 + seed)
    true = dict(
        zip(NAMES, np.array([3.0, 4.0, 30.0]) * np.exp(rng.uniform(-0.5, 0.5, 3)), strict=True)
    )
    t = np.arange(round(seconds / DT)) * DT
    w = 2 * np.pi * np.array([0.17, 0.45, 1.1, 1.9]) * np.exp(rng.uniform(-0.1, 0.1, 4))
    a, phase = np.array([0.5, 0.2, 0.1, 0.05]), rng.uniform(0, 2 * np.pi, (4, 1))
    angle = w[:, None] * t + phase
    q, v, bend = a @ np.sin(angle), (a * w) @ np.cos(angle), -(a * w**2) @ np.sin(angle)
    torque = (
        true["link_inertia"] * bend + true["link_viscous"] * v - true["gravity_torque"] * np.sin(q)
    )
    channels = {
        "link_position": q + 6e-4 * rng.standard_normal(len(t)),
        "link_torque": torque + 0.2 * rng.standard_normal(len(t)),
    }
    return Record.from_channels(t, channels, name=f"run {seed}"), true


@cache
def errors() -> dict[str, np.ndarray]:
    """Error and standard error of each parameter over many joints, (joints, 2)."""
    out: dict[str, list[tuple[float, float]]] = {n: [] for n in NAMES}
    for seed in range(JOINTS):
        record, true = run(seed)
        solution = fit(JOINT, [record]).solution
        for n in NAMES:
            error = solution.stderr[n]
            assert error is not None
            out[n].append((solution.values[n] / true[n] - 1, error / true[n]))
    return {n: np.array(x) for n, x in out.items()}


def test_an_inertia_has_no_bias_where_noise_would_take_percents_off() -> None:
    record, _ = run(0)
    data = load_dataset([record], [], JOINT, prepared_model(JOINT, record))
    assert attenuation(data)["link inertia"] > 0.02
    off, size = errors()["link_inertia"].T
    assert abs(off.mean()) < 3 * float(np.sqrt(np.mean(size**2) / JOINTS))


def test_noise_of_a_record_that_is_drawn_in_pieces_is_taken_off_too() -> None:
    record, true = run(1, 150.0)
    data = load_dataset([record], [], JOINT, prepared_model(JOINT, record))
    assert data.train[0].rows > LONGEST
    solution = fit(JOINT, [record]).solution
    for n in NAMES:
        error = solution.stderr[n]
        assert error is not None
        assert abs(solution.values[n] - true[n]) < 3 * error, n
    # plain least squares would leave far more off the inertia than its band
    error = solution.stderr["link_inertia"]
    assert error is not None
    assert attenuation(data)["link inertia"] * true["link_inertia"] > 6 * error


@pytest.mark.parametrize("name", NAMES)
def test_twice_the_standard_error_is_a_band_of_95_percent(name: str) -> None:
    """Of 40, a true 95 % leaves 34 or fewer inside once in a hundred times."""
    off, size = errors()[name].T
    assert np.sum(np.abs(off) < 2 * size) > 34


def test_only_certain_noise_is_taken_off_a_normal_matrix() -> None:
    whole = np.array([[1.0, 0.3], [0.3, 1.0]])
    noise = np.diag([0.2, 0.0])
    assert whole_without(whole, noise) == pytest.approx(whole - noise, abs=1e-12)
    left = np.linalg.eigvalsh(np.linalg.solve(whole, whole_without(whole, 5 * whole)))
    assert left == pytest.approx([1 - MOST_NOISE] * 2)


def test_noise_falls_on_the_windows_whose_rows_take_part() -> None:
    products = NoiseProducts({"link": np.eye(2)}, {"link": np.ones(2)})
    windows = csr_array([[1.0, 1.0, 0.4, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0, 0.5]])
    weights = {"link": np.array([1.0, 1.0, 1.0, 50.0, 1.0])}
    gram, score = products.by_window(weights, windows, {"link": np.array([1, 1, 1, 0, 1]) > 0})
    assert gram[:, 0, 0] == pytest.approx([0.5, 0.25])
    assert score[:, 1] == pytest.approx([0.6, 0.375])


def test_noise_without_a_slow_part_is_no_error_of_a_slow_parameter() -> None:
    """Differences of white noise add up to next to nothing against a constant; white noise to what
    white noise adds up to."""
    rng, dt = np.random.default_rng(4), 0.02
    time = np.arange(4000) * dt
    windows = windows_over([time[:2000], time[2000:]])
    np.testing.assert_allclose((windows * windows).sum(axis=0), 1.0)
    assert windows.shape[0] < 1.1 * OVERLAP * 80 / (2 * BLOCK) + 2 * OVERLAP
    columns = np.column_stack([np.ones(4000), np.sin(time)])
    white = rng.standard_normal(4000)
    for noise, known in ((white, 4000**-0.5), (np.diff(white, prepend=0.0), 0.0)):
        left = noise - columns @ np.linalg.lstsq(columns, noise, rcond=None)[0]
        errors = window_errors(columns, left, windows)
        assert errors is not None
        assert abs(errors[0] - known) < 0.35 * 4000**-0.5


@pytest.mark.skipif(library() is None, reason="no C compiler")
def test_a_gap_as_small_as_the_encoders_tell_stays_where_the_fit_put_it(tmp_path: Path) -> None:
    """The correction of first order had led to a stiffness of 2e7 N.m/rad inside a gap of 0."""
    folder = write_case(make_case(8812, without=("zero",)), tmp_path, "all")
    joint = load_joint(folder / "joint.toml")
    found = fit(joint, read(folder / "train.csv", joint=joint))
    assert found.train.relative_error_percent < 1.0
    assert 0 < found.solution.values["backlash_stiffness_loss"] < 300.0
