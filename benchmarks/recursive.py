"""Figures of the recursive least squares: cost per sample, a million updates, standstill, recovery
after a step.

Run from the project folder: `python benchmarks/recursive.py` (needs padasip for the comparison:
extra `bench`). `--quick` leaves out the recovery over several seeds.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import joint_regressor as joint  # noqa: E402

from identification.recursive.estimator import METHODS, RecursiveLeastSquares, RunOutcome, Settings  # noqa: E402

FloatArray = npt.NDArray[np.float64]


def best(action: Callable[[], object], repeats: int) -> float:
    """Shortest time of one call, s."""
    shortest = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        shortest = min(shortest, time.perf_counter() - start)
    return shortest


def cost() -> None:
    """Cost per sample of 10 parameters and 2 outputs, beside padasip on the same samples."""
    rng = np.random.default_rng(0)
    n, m, samples = 10, 2, 20_000
    h = rng.normal(size=(samples, m, n))
    y = h @ np.ones(n) + 0.1 * rng.standard_normal((samples, m))
    print(f"Cost per sample, {n} parameters, {m} outputs (best of several runs)")
    update_us = np.inf
    for method in METHODS:
        estimator = RecursiveLeastSquares(np.zeros(n), np.ones(n), method, outputs=m)

        def each(use: RecursiveLeastSquares = estimator) -> None:
            for k in range(500):
                use.update(y[k], h[k])

        interpreted = best(each, 40) / 500
        outcome = estimator.compile()
        compiled = best(each, 20) / 500
        replay = best(lambda use=estimator: use.run(y, h), 20) / samples  # type: ignore[misc]
        if method == "random_walk":
            update_us = interpreted * 1e6
        print(
            f"  {method:12s} update {interpreted * 1e6:5.2f} us (FunctionBuffer), "
            f"{compiled * 1e6:5.2f} us (compiled); "
            f"run {replay * 1e9:5.0f} ns = {1e-6 / replay:.2f} million samples/s  [{outcome.value}]"
        )
    try:
        import padasip
    except ImportError:
        print("  padasip is not installed: no comparison")
        return
    other = padasip.filters.FilterRLS(n=n, mu=0.999)

    def others() -> None:
        for k in range(500):
            for o in range(m):
                other.adapt(y[k, o], h[k, o])

    theirs = best(others, 20) / 500 * 1e6
    estimator = RecursiveLeastSquares(np.zeros(n), np.ones(n), outputs=m)
    ours = best(lambda: estimator.run(y, h, compiled=True), 20) / samples * 1e6
    print(
        f"  padasip RLS  {theirs:5.1f} us per sample (two scalar updates): run is "
        f"{theirs / ours:.0f} times faster, update {theirs / update_us:.1f} times"
    )


def agreement() -> None:
    """Interpreted and compiled, bit by bit."""
    record = joint.simulate(seconds=20.0, standstill=(8.0, 10.0), step_at=15.0)
    for method in METHODS:
        pair = [
            RecursiveLeastSquares(0.7 * joint.THETA, joint.SCALE, method).run(
                record.y, record.h, compiled=compiled
            )
            for compiled in (False, True)
        ]
        same = np.array_equal(pair[0].theta, pair[1].theta)
        print(f"  {method:12s} interpreted and compiled trajectories equal bit by bit: {same}")


def endurance() -> None:
    """A million updates on the joint's regressor, a fifth of them standstill."""
    record = joint.simulate(seconds=50.0, standstill=(20.0, 30.0), step_at=np.inf)
    print(
        "A million updates (joint regressor, unscaled columns differ by 1e8; a fifth is standstill)"
    )
    for method in METHODS:
        estimator = RecursiveLeastSquares(0.7 * joint.THETA, joint.SCALE, method)
        worst = 0.0
        for _ in range(20):
            run = estimator.run(record.y, record.h)
            worst = max(worst, float(np.abs((run.theta - joint.THETA) / joint.SCALE).max()))
        low = float(
            np.linalg.eigvalsh(estimator.covariance / np.outer(joint.SCALE, joint.SCALE)).min()
        )
        print(
            f"  {method:12s} finite {np.isfinite(run.theta).all()}, largest error on the way "
            f"{worst:.2f} scales, "
            f"at the end {np.abs(estimator.theta / joint.THETA - 1).max():.4f} relative, "
            f"smallest eigenvalue of P {low:.1e}"
        )


def standstill_and_step() -> None:
    """80 s at 1 kHz, standstill from 30 to 50 s, all parameters +30 % at 60 s."""
    print(
        "Standstill of 20 s and +30 % at 60 s (worst over the parameters; 5 % recovery of k1, "
        "ka, motor Coulomb)"
    )
    record = joint.simulate(stiction=5.0)
    for method in METHODS:
        for freeze in (True, False):
            estimator = RecursiveLeastSquares(
                0.7 * joint.THETA, joint.SCALE, method, settings=Settings(freeze=freeze)
            )
            print(
                f"  {method:12s} freeze {'on ' if freeze else 'off'} "
                f"{outcome_line(record, estimator, 60_000)}"
            )


def seeds() -> None:
    """The default method over several seeds, step times and trajectories."""
    for quick in (0.05, 0.0):
        print(f"Default method, six seeds and step times, part with 0.5 s period {quick} rad")
        for seed in range(6):
            at = 60_000 + 370 * seed
            record = joint.simulate(seed=seed, step_at=at * 1e-3, quick=quick)
            estimator = RecursiveLeastSquares(0.7 * joint.THETA, joint.SCALE)
            print(
                f"  seed {seed} {outcome_line(record, estimator, at)}; batch LS of the 0.43 s "
                f"after the step: ka {batch_error(record, at):+.1%}"
            )


def outcome_line(record: joint.JointRecord, estimator: RecursiveLeastSquares, at: int) -> str:
    """Drift in standstill and recovery times."""
    run = estimator.run(record.y, record.h, compiled=True)
    note = "" if run.outcome is RunOutcome.COMPILED else " (interpreted)"
    still = slice(30_000, 50_000)
    drift = np.abs(run.theta[still] / run.theta[30_000] - 1.0).max()
    relative = np.abs(run.theta[still] / record.truth[still] - 1.0).max()
    inside = np.abs(run.theta[at : at + 5000] / record.truth[at : at + 5000] - 1.0) < 0.05
    times = []
    for name in ("k1", "ka", "coulomb_motor"):
        outside = np.flatnonzero(~inside[:, joint.NAMES.index(name)])
        times.append("> 5 s" if outside[-1] == 4999 else f"{(outside[-1] + 1) * 1e-3:.2f} s")
    return (
        f"drift {drift:8.2%}, error {relative:8.2%}, inside 5 % for good after "
        f"{', '.join(times)}; alarms {estimator.alarms}, resets {estimator.resets}{note}"
    )


def batch_error(record: joint.JointRecord, at: int) -> float:
    """Relative error of ka by batch least squares of the samples from 0.07 s to 0.5 s after the
    step.
    """
    window = slice(at + 70, at + 500)
    matrix = (record.h[window] * joint.SCALE).reshape(-1, joint.THETA.size)
    found = np.linalg.lstsq(matrix, record.y[window].ravel())[0] * joint.SCALE
    return float(found[2] / record.truth[at + 100, 2] - 1.0)


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="leave out the six seeds")
    quick = parser.parse_args().quick
    cost()
    agreement()
    endurance()
    standstill_and_step()
    if not quick:
        seeds()


if __name__ == "__main__":
    main()
