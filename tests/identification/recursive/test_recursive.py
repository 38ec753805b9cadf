"""Recursive least squares: against closed forms, over many updates, on bad input, through
standstill and steps.
"""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.stats import chi2, norm

from benchmarks import joint_regressor as joint
from identification.errors import InputError
from identification.recursive.compiler import (
    CACHE_VARIABLE,
    COMPILER_VARIABLE,
    MOST_KEPT,
    find_compiler,
    kept,
)
from identification.recursive.engine import _library
from identification.recursive.estimator import (
    METHODS,
    RecursiveLeastSquares,
    RunOutcome,
    Settings,
    StartupOutcome,
    forgetting_curve,
)
from identification.recursive.ud_step import _alarm_limit

ROOT = Path(__file__).resolve().parents[3]
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def _data(
    samples: int, n: int = 4, m: int = 2, noise: float = 0.1, seed: int = 0
) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=n)
    h = rng.normal(size=(samples, m, n))
    return theta, h, h @ theta + noise * rng.standard_normal((samples, m))


# Closed forms


def test_without_forgetting_it_is_the_posterior_of_all_samples() -> None:
    _, h, y = _data(200)
    scale, noise, theta0 = np.array([2.0, 3.0, 1.0, 5.0]), np.array([0.01, 0.04]), np.full(4, 0.3)
    estimator = RecursiveLeastSquares(
        theta0,
        scale,
        "constant",
        R2=noise,
        settings=Settings(freeze=False, forgetting=1.0, huber=0.0),
    )
    estimator.run(y, h)
    weighted = h / noise[:, None]
    information = np.diag(scale**-2) + np.einsum("koi,koj->ij", weighted, h)
    theta = theta0 + np.linalg.solve(information, np.einsum("koi,ko->i", weighted, y - h @ theta0))
    np.testing.assert_allclose(estimator.theta, theta, rtol=1e-11)
    np.testing.assert_allclose(
        estimator.covariance, np.linalg.inv(information), rtol=1e-9, atol=1e-15
    )


def test_constant_forgetting_is_exponentially_weighted_least_squares() -> None:
    _, h, y = _data(300, m=1)
    factor, scale = 0.97, np.array([2.0, 3.0, 1.0, 5.0])
    settings = Settings(freeze=False, forgetting=factor, covariance_limit=1e6, huber=0.0)
    estimator = RecursiveLeastSquares(np.zeros(4), scale, "constant", R2=1e-2, settings=settings)
    estimator.run(y, h)
    weight = factor ** np.arange(299, -1, -1.0)
    information = factor**300 * np.diag(scale**-2) + np.einsum(
        "k,ki,kj->ij", weight / 1e-2, h[:, 0], h[:, 0]
    )
    theta = np.linalg.solve(information, np.einsum("k,ki,k->i", weight / 1e-2, h[:, 0], y[:, 0]))
    np.testing.assert_allclose(estimator.theta, theta, rtol=1e-10)
    np.testing.assert_allclose(
        estimator.covariance, np.linalg.inv(information), rtol=1e-8, atol=1e-12
    )


def test_random_walk_is_the_kalman_filter_with_process_noise() -> None:
    _, h, y = _data(400)
    scale, noise, walk = np.full(4, 2.0), np.array([0.01, 0.02]), np.array([1e-4, 2e-4, 0.0, 1e-5])
    # The shortest window: process noise is then added after every second sample.
    estimator = RecursiveLeastSquares(
        np.zeros(4),
        scale,
        R1=walk,
        R2=noise,
        settings=Settings(freeze=False, alarm_drift=0.0, window_seconds=1e-3, huber=0.0),
    )
    run = estimator.run(y, h)
    theta, p = np.zeros(4), np.diag(scale**2)
    for k in range(400):
        gain = p @ h[k].T @ np.linalg.inv(h[k] @ p @ h[k].T + np.diag(noise))
        theta = theta + gain @ (y[k] - h[k] @ theta)
        p = p - gain @ h[k] @ p
        np.testing.assert_allclose(run.theta[k], theta, rtol=1e-8, atol=1e-10)
        p = p + 2.0 * np.diag(walk) * (k % 2)
    np.testing.assert_allclose(estimator.covariance, p, rtol=1e-8, atol=1e-14)


def test_a_batch_window_and_the_recursion_agree() -> None:
    theta, h, y = _data(2000, noise=1e-3)
    found = RecursiveLeastSquares(np.zeros(4), np.full(4, 5.0)).startup(y, h)
    np.testing.assert_allclose(
        found.theta, np.linalg.lstsq(h.reshape(-1, 4), y.ravel())[0], rtol=1e-4
    )
    np.testing.assert_allclose(found.residual_variance, 1e-6, rtol=0.15)
    assert np.all(np.abs(found.theta - theta) < 5.0 * np.sqrt(np.diag(found.covariance)))


def test_units_of_the_parameters_do_not_matter() -> None:
    theta, h, y = _data(500)
    units = 2.0 ** np.array([-40, 30, 0, 17])
    plain = RecursiveLeastSquares(np.zeros(4), np.full(4, 2.0)).run(y, h)
    other = RecursiveLeastSquares(np.zeros(4), 2.0 * units).run(y, h / units)
    np.testing.assert_array_equal(other.theta / units, plain.theta)
    np.testing.assert_allclose(plain.theta[-1], theta, atol=0.05)


@pytest.mark.parametrize("method", METHODS)
def test_units_of_the_outputs_do_not_matter(method: str) -> None:
    """Neither for the first guess of R2 nor for what counts as a large error of an output."""
    theta, h, y = _data(300)
    for unit in (2.0**20, 2.0**-20):
        plain = RecursiveLeastSquares(np.full(4, 0.5), np.full(4, 2.0), method)
        other = RecursiveLeastSquares(np.full(4, 0.5 * unit), np.full(4, 2.0 * unit), method)
        one, two = plain.run(y, h), other.run(unit * y, h)
        np.testing.assert_allclose(two.theta / unit, one.theta, rtol=1e-9)
        np.testing.assert_allclose(other.forgetting, plain.forgetting, rtol=1e-9)
        np.testing.assert_allclose(
            other.measurement_covariance / unit**2, plain.measurement_covariance, rtol=1e-9
        )
        if method != "schedule":
            np.testing.assert_allclose(one.theta[-1], theta, atol=0.2)


@pytest.mark.parametrize("start", [-10.0, 0.3, 10.0, 1e3])
@pytest.mark.parametrize("says", [0.0, 0.1, -2.0, 400.0])
def test_the_first_sample_moves_the_estimate_towards_what_it_says_and_not_beyond(
    start: float, says: float
) -> None:
    """However far off the start is: noise that is not known yet has a variance, too."""
    estimator = RecursiveLeastSquares([start], [1.0])
    (found,) = estimator.update(2.0 * says, [2.0])
    assert 0.0 < (found - start) / (says - start) < 1.0
    assert estimator.measurement_covariance.item() > 0.0


# Thesis forgetting


def test_schedule_follows_equation_3_50() -> None:
    _, h, y = _data(400)
    estimator = RecursiveLeastSquares(np.zeros(4), np.ones(4), "schedule")
    run = estimator.run(y, h)
    np.testing.assert_allclose(run.forgetting, 1.0 - 0.05 * 0.99 ** np.arange(1, 401), rtol=1e-12)


def test_a_random_walk_forgets_by_its_process_noise_and_by_no_factor() -> None:
    """In calm and in the alarm after a step."""
    theta, h, y = _data(400)
    y[200:] += h[200:] @ (10.0 + np.abs(theta))
    estimator = RecursiveLeastSquares(np.zeros(4), np.full(4, 5.0))
    assert estimator.method == "random_walk"
    run = estimator.run(y, h)
    assert np.any(run.alarm)
    assert not np.all(run.alarm)
    np.testing.assert_array_equal(run.forgetting, 1.0)
    assert estimator.forgetting == 1.0


@pytest.mark.parametrize("method", ["bell", "polynomial"])
def test_variable_forgetting_falls_from_one_to_its_bound(method: str) -> None:
    error = np.linspace(0.0, 5.0, 2001)
    factor = forgetting_curve(method, error)
    assert factor[0] == pytest.approx(1.0, abs=1e-5)
    assert factor[-1] == pytest.approx(0.95, abs=1e-5)
    assert np.all(np.diff(factor) < 1e-5)
    assert np.all((factor >= 0.95) & (factor <= 1.0))


def test_polynomial_has_the_shape_of_figure_3_5_and_bell_that_of_equation_3_51() -> None:
    error = np.linspace(0.0, 2.0, 101)
    np.testing.assert_allclose(
        forgetting_curve("polynomial", error), 0.95 + 0.05 * np.exp(-error / 0.2), atol=2e-6
    )
    np.testing.assert_allclose(
        forgetting_curve("bell", error), 0.95 + 0.05 * 2.0 ** -((error / 0.5) ** 2), atol=1e-15
    )


@pytest.mark.parametrize("method", ["bell", "polynomial"])
def test_the_step_uses_the_curve_with_the_floor_of_the_output(method: str) -> None:
    estimator = RecursiveLeastSquares([0.0], [1.0], method, settings=Settings(output_floor=0.5))
    estimator.update(0.2, [1.0])  # |e| / max(|y|, y_min) = 0.2 / 0.5
    assert estimator.forgetting == pytest.approx(float(forgetting_curve(method, 0.4)), rel=1e-12)
    assert 0.95 <= estimator.forgetting <= 1.0


def test_p_is_reset_after_the_factor_stayed_low() -> None:
    rng = np.random.default_rng(1)
    estimator = RecursiveLeastSquares(
        [0.0], [1.0], "bell", settings=Settings(reset_seconds=0.05, output_floor=1.0)
    )
    h = np.ones((600, 1))
    estimator.run(np.full(300, 0.01), h[:300])
    assert estimator.resets == 0
    estimator.run(5.0 * rng.choice([-1.0, 1.0], 300), h[300:])
    # 300 samples of which each 50 give a new start, less those in which the factor was high
    assert 4 <= estimator.resets <= 6


@pytest.mark.parametrize("method", ["bell", "polynomial"])
def test_a_sample_after_which_p_was_reset_is_the_first_of_a_new_start(method: str) -> None:
    """The first P and this one sample are all that P knows, whatever was told before."""
    _, h, y = _data(2000)
    scale, noise = np.array([2.0, 3.0, 1.0, 5.0]), np.array([0.01, 0.04])
    settings = Settings(reset_seconds=0.05, output_floor=0.1, freeze=False)
    estimator = RecursiveLeastSquares(np.zeros(4), scale, method, R2=noise, settings=settings)
    y += 5.0 * np.sign(np.sin(3.0 * np.arange(2000)))[:, None]
    k = 0
    while not estimator.resets:
        known = np.linalg.inv(estimator.covariance)
        estimator.update(y[k], h[k])
        k += 1
    one = (h[k - 1].T / noise) @ h[k - 1]
    np.testing.assert_allclose(
        np.linalg.inv(estimator.covariance), np.diag(1 / scale**2) + one, rtol=1e-9
    )
    assert np.trace(known) > 10 * np.trace(one), "much was told before"


# Many updates


@needs_compiler
@pytest.mark.parametrize("method", METHODS)
def test_a_million_updates_do_not_diverge(method: str) -> None:
    n = 10
    rng = np.random.default_rng(3)
    scale = 10.0 ** np.linspace(-4.0, 5.0, n)
    theta = 0.5 * scale * rng.uniform(-1.0, 1.0, n)
    h = rng.normal(size=(100_000, 2, n)) / scale
    h[20_000:40_000] = 0.0  # standstill
    h[40_000:60_000, :, 1:] = 0.0  # one direction only
    h[60_000:80_000, :, 3] = 2.0 * h[60_000:80_000, :, 2]  # two that move together
    y = h @ theta + 1e-2 * rng.standard_normal((100_000, 2))
    estimator = RecursiveLeastSquares(np.zeros(n), scale, method)
    for _ in range(10):
        run = estimator.run(y, h, stride=100)
        assert np.isfinite(run.theta).all()
        assert np.all(np.abs(run.theta - theta) < 2.0 * scale)
    assert estimator.samples == 1_000_000
    assert np.all(np.abs(estimator.theta - theta) < 0.03 * scale)
    p = estimator.covariance / np.outer(scale, scale)
    assert np.all(np.linalg.eigvalsh(p) > 0.0)
    assert np.all(np.diag(p) <= 1.0 + 1e-12)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("freeze", [True, False])
def test_p_stays_under_its_bound_without_excitation(method: str, freeze: bool) -> None:
    h = np.zeros((3000, 2, 3))
    h[:, :, 0] = 1.0
    estimator = RecursiveLeastSquares(
        np.zeros(3),
        [1.0, 2.0, 3.0],
        method,
        settings=Settings(freeze=freeze, covariance_limit=0.25, forgetting=0.95),
    )
    estimator.run(np.ones((3000, 2)), h)
    assert np.all(np.diag(estimator.covariance) <= 0.25 * np.array([1.0, 4.0, 9.0]) * (1.0 + 1e-12))


@pytest.mark.parametrize("method", METHODS)
def test_no_input_makes_the_state_nan(method: str) -> None:
    rng = np.random.default_rng(5)
    bad = np.array(
        [np.nan, np.inf, -np.inf, 1e308, -1e308, 1e200, 1e31, 1e29, -1e29, 1e-308, 5e-324, 0.0]
    )
    estimator = RecursiveLeastSquares(np.zeros(3), [1.0, 1e6, 1e-6], method, outputs=2)
    for k in range(4000):
        y, h = rng.normal(size=2), rng.normal(size=(2, 3))
        if k % 3:
            y[rng.integers(2)] = rng.choice(bad)
            h[rng.integers(2), rng.integers(3)] = rng.choice(bad)
        estimator.update(y, h)
        assert np.isfinite(np.frombuffer(estimator.state()[32:])).all()
    assert 1000 < estimator.skipped < 4000


# Interpreted and compiled


@needs_compiler
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shape", [(10, 2), (1, 1), (3, 3)])
def test_update_interpreted_and_compiled_run_agree_bit_by_bit(
    method: str, shape: tuple[int, int]
) -> None:
    n, m = shape
    _, h, y = _data(2500, n=n, m=m, seed=7)
    y[1000:1400], h[1000:1400] = 0.0, 0.0
    y[2000, 0] = np.nan
    h[1500:] *= 2.0  # a step of the plant
    make = [RecursiveLeastSquares(np.zeros(n), np.ones(n), method) for _ in range(3)]
    each = np.array([make[0].update(a, b) for a, b in zip(y, h, strict=True)])
    interpreted, compiled = make[1].run(y, h, compiled=False), make[2].run(y, h, compiled=True)
    assert interpreted.outcome is RunOutcome.INTERPRETED
    assert compiled.outcome is RunOutcome.COMPILED
    np.testing.assert_array_equal(each, interpreted.theta)
    for name in ("theta", "error", "forgetting", "skipped", "alarm", "frozen"):
        np.testing.assert_array_equal(getattr(compiled, name), getattr(interpreted, name))
    np.testing.assert_array_equal(
        make[2].update(y[0], h[0]), make[0].update(y[0], h[0])
    )  # compiled step
    assert compiled.skipped[2000]
    assert compiled.skipped.sum() == 1


@needs_compiler
def test_stride_keeps_every_so_many_samples() -> None:
    _, h, y = _data(1003)
    whole = RecursiveLeastSquares(np.zeros(4), np.ones(4)).run(y, h)
    for compiled in (True, False):
        some = RecursiveLeastSquares(np.zeros(4), np.ones(4)).run(
            y, h, stride=10, compiled=compiled
        )
        np.testing.assert_array_equal(some.theta, whole.theta[9::10])


def test_without_a_compiler_the_run_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    _, h, y = _data(300)
    expected = RecursiveLeastSquares(np.zeros(4), np.ones(4)).run(y, h, compiled=False)
    monkeypatch.setenv(COMPILER_VARIABLE, "none")
    _library.cache_clear()
    estimator = RecursiveLeastSquares(np.zeros(4), np.ones(4), outputs=2)
    assert estimator.compile() is RunOutcome.NO_COMPILER
    run = estimator.run(y, h, compiled=True)
    _library.cache_clear()
    assert run.outcome is RunOutcome.NO_COMPILER
    assert "compiler" in run.note
    np.testing.assert_array_equal(run.theta, expected.theta)


@needs_compiler
def test_a_compiler_that_fails_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(COMPILER_VARIABLE, sys.executable)  # runs, but is no C compiler
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    _library.cache_clear()
    _, h, y = _data(50)
    run = RecursiveLeastSquares(np.zeros(4), np.ones(4)).run(y, h, compiled=True)
    _library.cache_clear()
    assert run.outcome is RunOutcome.NO_COMPILER
    assert "failed" in run.note


@needs_compiler
def test_two_processes_build_into_one_cache_at_once(tmp_path: Path) -> None:
    code = (
        "import numpy as np; from identification.recursive.estimator import "
        "RecursiveLeastSquares as R;"
        "e = R(np.zeros(2), np.ones(2)); r = e.run(np.ones((9, 1)), np.ones((9, 1, 2)), "
        "compiled=True);"
        "print(r.outcome.name, r.theta[-1].tobytes().hex())"
    )
    environment = {
        **os.environ,
        CACHE_VARIABLE: str(tmp_path / "cache"),
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    }
    started = [
        subprocess.Popen(
            [sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    printed = [process.communicate(timeout=120)[0] for process in started]
    assert printed[0] == printed[1]
    assert printed[0].startswith("COMPILED")
    assert len(list((tmp_path / "cache").iterdir())) == 1  # one library, no leftovers


@needs_compiler
def test_a_damaged_library_is_built_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    tmp_path.chmod(0o700)
    _, h, y = _data(50, n=2)
    _library.cache_clear()
    from identification.recursive import compiler as _compiler

    built: list[Path] = []
    compile_source = _compiler._compile
    monkeypatch.setattr(
        _compiler,
        "_compile",
        lambda s, c, f, target: (
            (built.append(target), target.write_bytes(b"x"))
            if not built
            else compile_source(s, c, f, target)
        ),
    )
    assert (
        RecursiveLeastSquares([0.0, 0.0], 1.0).run(y, h, compiled=True).outcome
        is RunOutcome.NO_COMPILER
    )
    _library.cache_clear()
    assert (
        RecursiveLeastSquares([0.0, 0.0], 1.0).run(y, h, compiled=True).outcome
        is RunOutcome.COMPILED
    )
    _library.cache_clear()


# State


@pytest.mark.parametrize("method", METHODS)
def test_restore_brings_back_every_bit(method: str) -> None:
    _, h, y = _data(1200)
    first = RecursiveLeastSquares(np.zeros(4), np.ones(4), method, R1=[1e-6] * 4)
    first.run(y[:517], h[:517])
    first.hold([2])
    saved = first.state()
    other = RecursiveLeastSquares(np.ones(4), np.full(4, 3.0), method, R1=[1.0] * 4)
    other.restore(saved)
    assert other.state() == saved
    np.testing.assert_array_equal(other.theta, first.theta)
    np.testing.assert_array_equal(other.covariance, first.covariance)
    twins = [pickle.loads(pickle.dumps(first)), copy.deepcopy(first)]
    expected = first.run(y[517:], h[517:]).theta
    for twin in [other, *twins]:
        np.testing.assert_array_equal(twin.run(y[517:], h[517:]).theta, expected)
    first.restore(saved)
    np.testing.assert_array_equal(first.run(y[517:], h[517:]).theta, expected)
    other.reset()
    np.testing.assert_array_equal(other.theta, np.zeros(4))


def test_foreign_or_damaged_states_are_refused() -> None:
    estimator = RecursiveLeastSquares(np.zeros(3), np.ones(3), outputs=2)
    saved = estimator.state()
    damaged = bytearray(saved)
    damaged[100] ^= 1
    foreign = [
        RecursiveLeastSquares(np.zeros(4), np.ones(4), outputs=2),
        RecursiveLeastSquares([0.0] * 3, 1.0, "bell", outputs=2),
        RecursiveLeastSquares([0.0] * 3, 1.0, outputs=1),
    ]
    for state in [
        b"",
        b"x" * 100,
        saved[:-8],
        bytes(damaged),
        *(other.state() for other in foreign),
    ]:
        with pytest.raises(InputError, match="restore"):
            estimator.restore(state)
    assert estimator.state() == saved


# Skipping, switching


def test_a_sample_with_nan_changes_nothing_but_the_counters() -> None:
    _, h, y = _data(300)
    estimator = RecursiveLeastSquares(np.zeros(4), np.ones(4))
    estimator.run(y, h)
    theta, p = estimator.theta, estimator.covariance
    for k, value in enumerate([np.nan, np.inf, -np.inf]):
        estimator.update([value, y[k, 1]], h[k])
        spoiled = h[k].copy()
        spoiled[1, 2] = value
        estimator.update(y[k], spoiled)
    assert estimator.skipped == 6
    assert estimator.samples == 306
    np.testing.assert_array_equal(estimator.theta, theta)
    np.testing.assert_array_equal(estimator.covariance, p)


def test_an_output_left_out_is_not_looked_at() -> None:
    theta, h, y = _data(600)
    alone = RecursiveLeastSquares(np.zeros(4), np.full(4, 3.0))
    alone.run(y[:, :1], h[:, :1])
    both = RecursiveLeastSquares(np.zeros(4), np.full(4, 3.0), outputs=2)
    both.enable(1, False)
    y[:, 1] = np.nan
    both.run(y, h)
    assert both.skipped == 0
    np.testing.assert_array_equal(both.theta, alone.theta)
    np.testing.assert_allclose(both.theta, theta, atol=0.1)
    both.enable(1)
    both.update(y[0], h[0])
    assert both.skipped == 1


def test_held_parameters_stay_and_others_move() -> None:
    theta, h, y = _data(800)
    start = theta + np.array([0.0, 1.0, 1.0, 1.0])
    estimator = RecursiveLeastSquares(
        start, np.full(4, 3.0), names=("k1", "k2", "ka", "b"), outputs=2
    )
    estimator.hold(["k1"])
    estimator.run(y, h)
    assert estimator.theta[0] == start[0]
    assert list(estimator.excited) == [False, True, True, True]
    np.testing.assert_allclose(estimator.theta[1:], theta[1:], atol=0.05)
    estimator.release()
    estimator.run(y + h[:, :, 0], h)
    assert estimator.theta[0] == pytest.approx(theta[0] + 1.0, abs=0.1)


def test_a_raised_r2_slows_the_estimate() -> None:
    _, h, y = _data(200, m=1)
    steps = []
    for noise in (1e-2, 1e2):
        estimator = RecursiveLeastSquares(np.zeros(4), np.ones(4), R2=1e-2)
        estimator.run(y[:100], h[:100])
        estimator.set_measurement_covariance(noise)
        before = estimator.theta
        estimator.run(y[100:110] + 1.0, h[100:110])
        steps.append(float(np.linalg.norm(estimator.theta - before)))
    assert steps[1] < 0.01 * steps[0]


def test_r2_is_found_from_the_innovations() -> None:
    _, h, _ = _data(40_000)
    rng = np.random.default_rng(2)
    y = h @ np.ones(4) + np.array([0.5, 0.002]) * rng.standard_normal((40_000, 2))
    estimator = RecursiveLeastSquares(np.zeros(4), np.full(4, 2.0))
    estimator.run(y, h)
    np.testing.assert_allclose(np.sqrt(estimator.measurement_covariance), [0.5, 0.002], rtol=0.1)
    estimator.reset()
    assert estimator.samples == 0
    np.testing.assert_array_equal(estimator.theta, np.zeros(4))


# Alarm


@pytest.mark.parametrize("freedom", [20.0, 80.0])
@pytest.mark.parametrize("probability", [1e-2, 1e-4])
@pytest.mark.parametrize("inflation", [1.0, 2.0])
def test_the_limit_of_the_alarm_is_that_of_chi_square(
    freedom: float, probability: float, inflation: float
) -> None:
    normal = float(norm.isf(probability))
    config = {"alarm_freedom": [freedom], "alarm_normal": [normal]}
    limit = float(ca.DM(_alarm_limit(config, inflation)))  # type: ignore[arg-type]
    left = freedom / (2 * inflation - 1)
    assert limit == pytest.approx(float(chi2.isf(probability, left)) / left, rel=0.02)


def test_the_alarm_keeps_quiet_on_noise_and_fires_on_a_step_but_not_on_one_outlier() -> None:
    theta, h, y = _data(30_000, noise=0.05, seed=11)
    estimator = RecursiveLeastSquares(theta, np.full(4, 1.0), R2=[0.0025, 0.0025])
    y[15_000] += 2.0  # 40 standard deviations
    run = estimator.run(y, h)
    assert not run.alarm.any()
    assert estimator.alarms == 0
    stepped = estimator.run(h[:2000] @ (theta + 0.3), h[:2000])
    assert np.flatnonzero(stepped.alarm)[0] < 20
    assert not stepped.alarm[1000:].any()
    np.testing.assert_allclose(stepped.theta[400], theta + 0.3, atol=0.02)


@pytest.mark.parametrize(("far_off", "fires"), [(1, []), (2, []), (3, [2]), (30, [2])])
def test_the_alarm_fires_at_the_third_sample_far_off_and_at_no_two(
    far_off: int, fires: list[int]
) -> None:
    """In a row, by 40 standard deviations each."""
    begin, deviation = 2000, 0.05
    y = deviation * np.random.default_rng(1).standard_normal(3000)
    y[begin : begin + far_off] += 40 * deviation
    estimator = RecursiveLeastSquares([0.0], [1.0], R2=[deviation**2])
    alarm = estimator.run(y, np.ones((3000, 1))).alarm
    assert (np.flatnonzero(alarm)[:1] - begin).tolist() == fires


# Excitation


def test_an_unexcited_window_freezes_bit_by_bit_and_motion_releases() -> None:
    theta, h, y = _data(4000)
    estimator = RecursiveLeastSquares(np.zeros(4), np.full(4, 3.0))
    estimator.run(y[:2000], h[:2000])
    assert estimator.excited.all()
    assert estimator.live.all()
    rng = np.random.default_rng(9)
    still = 1e-4 * rng.normal(size=(20_000, 2, 4))
    run = estimator.run(
        1.0 + 0.1 * rng.standard_normal((20_000, 2)), still
    )  # y holds what H cannot explain
    assert not estimator.live.any()
    assert run.frozen[400:].all()
    np.testing.assert_array_equal(
        run.theta[400:], np.broadcast_to(run.theta[400], run.theta[400:].shape)
    )
    estimator.run(y[2000:], h[2000:])
    assert estimator.live.all()
    np.testing.assert_allclose(estimator.theta, theta, atol=0.02)


def test_parameters_that_move_together_are_frozen_one_by_one() -> None:
    theta, h, y = _data(12_000)
    estimator = RecursiveLeastSquares(np.zeros(4), np.full(4, 3.0))
    estimator.run(y[:2000], h[:2000])
    h[2000:, :, 3] = h[2000:, :, 2]
    y[2000:] = h[2000:] @ theta + 0.1 * np.random.default_rng(1).standard_normal((10_000, 2))
    estimator.run(y[2000:], h[2000:])
    assert estimator.excited.sum() == 3
    assert estimator.excited[:2].all()
    np.testing.assert_allclose(estimator.theta, theta, atol=0.05)


def test_joint_standstill_and_step() -> None:
    record = joint.simulate(stiction=5.0)
    estimator = RecursiveLeastSquares(0.7 * joint.THETA, joint.SCALE, names=joint.NAMES)
    run = estimator.run(record.y, record.h)
    still = slice(30_000, 50_000)
    drift = np.abs(run.theta[still] / run.theta[30_000] - 1.0).max(axis=0)
    assert drift.max() <= 0.01
    assert np.abs(run.theta[still] / record.truth[still] - 1.0).max() <= 0.05
    inside = np.abs(run.theta[60_000:70_000] / record.truth[60_000:70_000] - 1.0) < 0.05
    for name in ("k1", "ka", "coulomb_motor"):
        last_outside = np.flatnonzero(~inside[:, joint.NAMES.index(name)])[-1]
        assert last_outside < 500, name
    starts = np.flatnonzero(np.diff(run.alarm.astype(int)) == 1) * 1e-3
    assert starts.size == 1  # the step alone, not the standstill
    assert 60.0 <= starts[0] < 60.05


# Start-up


def test_startup_names_and_freezes_what_the_window_cannot_carry() -> None:
    theta, h, _ = _data(500, n=5)
    h[:, :, 1] = 0.0
    h[:, :, 4] = -2.0 * h[:, :, 3]
    start = np.array([0.0, 7.0, 0.0, 0.0, 0.0])
    y = h @ np.where(np.arange(5) == 4, 0.0, theta)
    estimator = RecursiveLeastSquares(start, np.full(5, 3.0), names=("a", "b", "c", "d", "e"))
    found = estimator.startup(y, h)
    assert found.outcome is StartupOutcome.RANK_DEFICIENT
    assert found.alarm
    assert set(found.removed) in ({"b", "d"}, {"b", "e"})
    assert "b" in str(found)
    assert found.theta[1] == 7.0
    np.testing.assert_allclose(h @ found.theta, y, atol=1e-6)
    assert found.singular_values[1] < 1e-12 * found.singular_values.max()
    estimator.run(y, h)
    assert estimator.theta[1] == 7.0
    assert not estimator.excited[1]


def test_startup_solves_equations_3_47_to_3_49() -> None:
    theta, h, y = _data(300, noise=0.0)
    h[5], y[7] = np.nan, np.inf
    estimator = RecursiveLeastSquares(np.zeros(4), np.full(4, 3.0))
    found = estimator.startup(y, h)
    assert found.outcome is StartupOutcome.FULL_RANK
    assert (found.samples, found.dropped) == (298, 2)
    np.testing.assert_allclose(found.theta, theta, rtol=1e-9)
    np.testing.assert_array_equal(estimator.theta, estimator.theta)
    np.testing.assert_allclose(estimator.theta, theta, rtol=1e-9)
    nothing = RecursiveLeastSquares([1.0, 2.0], 1.0).startup(np.zeros((9, 1)), np.zeros((9, 1, 2)))
    assert nothing.outcome is StartupOutcome.NOTHING_DETERMINED
    np.testing.assert_array_equal(nothing.theta, [1.0, 2.0])


def test_startup_singular_values_are_those_of_the_scaled_regressor() -> None:
    h = np.zeros((4, 1, 2))
    h[0, 0, 0], h[1, 0, 1] = 3.0, 0.25
    found = RecursiveLeastSquares([0.0, 0.0], [2.0, 8.0], R2=4.0).startup(np.zeros(4), h[:, 0])
    np.testing.assert_allclose(found.singular_values, [3.0, 1.0])
    limited = RecursiveLeastSquares([0.0, 0.0], [2.0, 8.0], R2=4.0).startup(
        np.zeros(4), h[:, 0], limit=0.5
    )
    assert limited.removed == ("theta[1]",)


# Bad input


@pytest.mark.parametrize(
    ("arguments", "keywords"),
    [
        (([], 1.0), {}),
        (([[1.0]], 1.0), {}),
        (([np.nan], 1.0), {}),
        ((["a"], 1.0), {}),
        (([1.0, 2.0], [1.0, 0.0]), {}),
        (([1.0, 2.0], [1.0, -1.0]), {}),
        (([1.0, 2.0], [1.0, 1.0, 1.0]), {}),
        (([1.0], np.inf), {}),
        (([1.0], 1.0, "magic"), {}),
        (([1.0], 1.0), {"outputs": 0}),
        (([1.0], 1.0), {"names": ("a", "b")}),
        (([1.0], 1.0), {"R1": [-1.0]}),
        (([1.0], 1.0), {"R2": [0.0]}),
        (([1.0, 1.0], 1.0), {"R1": [[1.0, 0.5], [0.5, 1.0]]}),
        (([1.0], 1.0), {"outputs": 2, "R2": [1.0, 1.0, 1.0]}),
        ((np.zeros(65), 1.0), {}),
    ],
)
def test_bad_arguments_are_refused_in_one_line(
    arguments: tuple[object, ...], keywords: dict[str, object]
) -> None:
    with pytest.raises(InputError, match=r"^RecursiveLeastSquares: [^\n]+$"):
        RecursiveLeastSquares(*arguments, **keywords)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "values",
    [
        {"forgetting": 0.9},
        {"forgetting": 1.1},
        {"forgetting_low": 0.5},
        {"drift": -1.0},
        {"sample_time": 0.0},
        {"alarm_probability": 0.7},
        {"output_floor": -1.0},
        {"drift": float("nan")},
        {"window_seconds": "long"},
    ],
)
def test_bad_settings_are_refused_in_one_line(values: dict[str, float]) -> None:
    with pytest.raises(InputError, match=r"^RecursiveLeastSquares: [^\n]+$"):
        Settings(**values)  # type: ignore[arg-type]


def test_wrong_shapes_are_refused_in_one_line() -> None:
    estimator = RecursiveLeastSquares(np.zeros(3), np.ones(3), outputs=2)
    for y, h in [
        (1.0, np.ones(3)),
        (np.ones(2), np.ones((3, 2))),
        (np.ones(3), np.ones((2, 3))),
        (np.ones((2, 1)), np.ones((2, 3))),
        (["a", "b"], np.ones((2, 3))),
        (np.ones(2), 1.0),
        (np.ones(2, dtype=complex), np.ones((2, 3))),
    ]:
        with pytest.raises(InputError, match=r"^update: [^\n]+$"):
            estimator.update(y, h)
    for y, h in [
        (np.ones((5, 2)), np.ones((4, 2, 3))),
        (np.ones((5, 1)), np.ones((5, 1, 3))),
        (1.0, 1.0),
        (np.ones((5, 2)), np.ones((5, 6))),
    ]:
        with pytest.raises(InputError, match=r"^run: [^\n]+$"):
            estimator.run(y, h)
    with pytest.raises(InputError, match="stride"):
        estimator.run(np.ones((5, 2)), np.ones((5, 2, 3)), stride=0)
    with pytest.raises(InputError, match="startup"):
        estimator.startup(np.full((5, 2), np.nan), np.ones((5, 2, 3)))
    with pytest.raises(InputError, match="no output"):
        estimator.enable(2)
    with pytest.raises(InputError, match="no parameter"):
        estimator.hold(["k1"])
    with pytest.raises(InputError, match="outputs="):
        RecursiveLeastSquares([0.0], 1.0).state()


def test_integers_and_lists_are_accepted() -> None:
    estimator = RecursiveLeastSquares([0, 0], 10)
    for k in range(200):
        estimator.update(2 + 3 * (k % 5), [1, k % 5])
    np.testing.assert_allclose(estimator.theta, [2.0, 3.0], rtol=1e-3)


@pytest.mark.parametrize("known", [True, False])
def test_excitation_is_counted_by_output_in_units_of_its_noise(known: bool) -> None:
    """Sums of products of the scaled regressors, from which the check tells what is excited; as
    they are where the noise is not known.
    """
    _, h, y = _data(5, n=3, m=2)
    scale, noise = np.array([2.0, 3.0, 1.0]), np.array([0.01, 0.04])
    given = noise if known else None
    estimator = RecursiveLeastSquares(np.full(3, 0.3), scale, "constant", outputs=2, R2=given)
    estimator.run(y, h)
    engine = estimator.engine_for("excitation")
    products = np.einsum("koi,koj->oij", h * scale, h * scale)
    products = products / noise[:, None, None] if known else products
    energy = engine.part("fast", "energy").reshape(2, 3)
    np.testing.assert_allclose(energy, [np.diag(p) for p in products], rtol=1e-12)
    mean = engine.part("fast", "mean").reshape(2, 3)
    np.testing.assert_allclose(mean, (h * scale).sum(axis=0), rtol=1e-12)
    pairs = [products.sum(axis=0)[i, j] for j in range(3) for i in range(j)]
    np.testing.assert_allclose(engine.part("fast", "info"), pairs, rtol=1e-12)


def test_a_curve_of_which_a_motion_shows_a_few_values_at_a_time() -> None:
    """Twenty control values, two in each row, beside two lines; each swing goes a little further
    than the one before, so that it meets values that a row has touched once, long ago. No error is
    over four of its standard deviations at any time, and all are found.
    """
    n, rows = 20, 4000
    time = 0.016 * np.arange(rows)
    at = 9.5 + (2.0 + time / 9.0) * np.sin(2 * np.pi * time / 6.0)
    near = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(n)))
    h = np.column_stack([near, np.sin(7 * time), np.cos(7 * time)])[:, None, :]
    truth = np.append(3.0 * np.sin(np.arange(n)), [4.0, 2.0])
    y = h @ truth + 0.05 * np.random.default_rng(5).standard_normal((rows, 1))
    estimator = RecursiveLeastSquares(
        np.zeros(n + 2),
        np.full(n + 2, 4.0),
        R2=0.05**2,
        settings=Settings(sample_time=0.016, window_seconds=2.0, rank_seconds=8.0),
        alike=[0] * n + [1, 2],
    )
    for k in range(rows):
        estimator.update(y[k], h[k])
        if k % 4 == 0 and k > 200:
            assert estimator.live.all(), k
            assert np.all(np.abs(estimator.theta - truth) < 4 * estimator.deviation), k
    np.testing.assert_allclose(estimator.theta, truth, atol=0.1)


def test_what_is_kept_is_made_once_and_what_is_damaged_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    made: list[bytes] = []

    def make() -> bytes:
        made.append(b"library")
        return made[-1]

    assert [kept("a", ["x", "yz"], make) for _ in range(2)] == [b"library"] * 2
    assert len(made) == 1
    assert kept("a", ["xy", "z"], make) and len(made) == 2, "the same letters, other parts"
    for damaged in (b"", b"\0" * 40, next((tmp_path / "cache").glob("a-*")).read_bytes()[:-1]):
        for file in (tmp_path / "cache").glob("a-*"):
            file.write_bytes(damaged)
        before = len(made)
        assert kept("a", ["x", "yz"], make) == b"library"
        assert len(made) == before + 1
    for k in range(MOST_KEPT + 5):
        kept("b", [str(k)], make)
    assert len(list((tmp_path / "cache").glob("b-*"))) == MOST_KEPT
    assert len(list((tmp_path / "cache").glob("a-*"))) == 2
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "file"))
    assert kept("a", ["x", "yz"], make) == b"library", "a cache that is no folder keeps nothing"
