"""Recursive least squares on five scenarios beside plain filters: `python
benchmarks/recursive_scenarios.py`.

Four parameters of scale 1, regressors with correlations of 0.9, 40 s at 1 kHz, sensor noise 0.1:
constant parameters; slow sines of half a scale; a step of 0.3 scales at 20 s; constant with 1 %
outliers of 100 standard deviations; a standstill from 10 s to 30 s. Printed is the root mean square
error over the parameters in % of scale: over the second half, for the step over the five seconds
after it, for the standstill at its end.

Beside it: a Kalman filter with the true R2 and the same random walk (`UD`), the same with Huber's
update (`Huber`), and padasip's filter with forgetting 0.999 where it is installed (extra `bench`).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

sys.path.append(str(Path(__file__).resolve().parents[1]))

from identification.recursive.estimator import METHODS, RecursiveLeastSquares, Settings  # noqa: E402

FloatArray = npt.NDArray[np.float64]
COUNT, PARAMETERS, DT, NOISE = 40_000, 4, 1e-3, 0.1
SCENARIOS = ("constant", "drift", "step", "outliers", "standstill")


def scenario(name: str, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """y (samples,), H (samples, parameters), true parameters (samples, parameters)."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(COUNT)
    h = rng.normal(size=(COUNT, PARAMETERS))
    h[:, 1:] = 0.9 * h[:, :1] + 0.3 * h[:, 1:]  # regressors of a joint are correlated
    theta = np.tile(np.array([0.7, -0.4, 0.2, 0.9]), (COUNT, 1))
    if name == "drift":
        theta += 0.5 * np.sin(2 * np.pi * time[:, None] / 20 + np.arange(PARAMETERS))
    if name == "step":
        theta[COUNT // 2 :] += 0.3
    if name == "standstill":
        h[10_000:30_000] *= 1e-4
    noise = NOISE * rng.standard_normal(COUNT)
    if name == "outliers":
        noise += (rng.random(COUNT) < 0.01) * 100 * NOISE * rng.choice([-1.0, 1.0], COUNT)
    if name == "standstill":
        noise[10_000:30_000] += 0.5  # what H cannot explain: sticking
    return np.sum(h * theta, axis=1) + noise, h, theta


def figure(name: str, found: FloatArray, theta: FloatArray) -> float:
    """The error of a trajectory, % of scale."""
    part = {"step": slice(20_000, 25_000), "standstill": slice(29_900, 30_000)}.get(
        name, slice(COUNT // 2, COUNT)
    )
    return 100 * float(np.sqrt(np.mean((found[part] - theta[part]) ** 2)))


def own(y: FloatArray, h: FloatArray, method: str, *, known: bool = False) -> FloatArray:
    """Trajectory of this library."""
    settings = (
        Settings(sample_time=DT, drift=0.1) if method == "random_walk" else Settings(sample_time=DT)
    )
    estimator = RecursiveLeastSquares(
        np.zeros(PARAMETERS),
        np.ones(PARAMETERS),
        method,
        settings=settings,
        R2=NOISE**2 if known else None,
    )
    return estimator.run(y[:, None], h[:, None, :]).theta


def kalman(y: FloatArray, h: FloatArray, huber: float = np.inf) -> FloatArray:
    """A Kalman filter with the true R2, and Huber's update where a limit is given."""
    theta, p = np.zeros(PARAMETERS), np.eye(PARAMETERS)
    out = np.empty((COUNT, PARAMETERS))
    for k in range(COUNT):
        p += np.eye(PARAMETERS) * 0.1**2 * DT
        gain = p @ h[k]
        expected = h[k] @ gain + NOISE**2
        error = y[k] - h[k] @ theta
        error = np.clip(error, -huber * np.sqrt(expected), huber * np.sqrt(expected))
        theta = theta + gain * error / expected
        p -= np.outer(gain, gain) / expected
        out[k] = theta
    return out


def forgetting(y: FloatArray, h: FloatArray) -> FloatArray:
    """padasip's recursive least squares."""
    import padasip

    made = padasip.filters.FilterRLS(n=PARAMETERS, mu=0.999)
    out = np.empty((COUNT, PARAMETERS))
    for k in range(COUNT):
        made.adapt(y[k], h[k])
        out[k] = made.w
    return out


def main() -> None:
    """Print the table."""
    columns: dict[str, Callable[[FloatArray, FloatArray], FloatArray]] = {
        m: lambda y, h, m=m: own(y, h, m)
        for m in METHODS  # type: ignore[misc]
    }
    columns["R2 known"] = lambda y, h: own(y, h, "random_walk", known=True)
    columns["UD"] = kalman
    columns["Huber"] = lambda y, h: kalman(y, h, 2.5)
    try:
        import padasip  # noqa: F401

        columns["padasip"] = forgetting
    except ImportError:
        print("padasip is not installed: no column for it")
    print(f"{'error, % of scale':18s}" + "".join(f"{c:>12s}" for c in columns))
    for name in SCENARIOS:
        cells = []
        for run in columns.values():
            errors = [
                figure(name, run(y, h), theta)
                for y, h, theta in (scenario(name, seed) for seed in range(2))
            ]
            cells.append(float(np.mean(errors)))
        print(f"{name:18s}" + "".join(f"{c:12.3g}" for c in cells))


if __name__ == "__main__":
    main()
