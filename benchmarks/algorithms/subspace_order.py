"""How often the order of simulated joints from current to position is found, and what the models
explain of an unseen record, on pieces of it where the joint integrates.

    python -m benchmarks.algorithms.subspace_order                  100 joints, about a minute
    python -m benchmarks.algorithms.subspace_order --joints 20 --seed 1

Each joint is drawn anew: inertias, stiffness with a resonance of 4 to 20 Hz, damping, viscous
friction, with or without gravity about a hanging equilibrium, elastic or rigid. The drive is noise
or a multisine, with torque noise on the motor; positions are read with encoder noise; in every
second joint a weak controller holds the position, and noise goes round. The true order is 4 for an
elastic joint (outputs q_m and q_m - q_l) and 2 for a rigid one (output q_m); without gravity one
pole integrates.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections import Counter
from dataclasses import dataclass
from typing import Final, final, get_args

import numpy as np
import numpy.typing as npt
from scipy.signal import cont2discrete

from identification.linear.hankel_qr import Method
from identification.linear.records import ArraySource
from identification.linear.shots import vaf_of_shots
from identification.linear.subspace import MoespOptions, Subspace, UnstableModelWarning, moesp

FloatArray = npt.NDArray[np.float64]

DT: Final = 5e-3
SAMPLES: Final = 6000
BLOCK_ROWS: Final = 20
WANTED: Final = 0.9
"""Share of joints whose order is to be found."""
POSITION_NOISE, TORQUE_NOISE = 2e-5, 0.02
"""Noise of an encoder reading [rad]; of the torque, as a part of the drive."""


@final
@dataclass(frozen=True)
class Drawn:
    """One joint and its records.

    Attributes
    ----------
    order : int
        True one.
    integrates : bool
    u, y : (samples, 1) and (samples, 1 or 2) array
        Record to fit.
    test : tuple of two arrays
        Unseen record.
    """

    order: int
    integrates: bool
    u: FloatArray
    y: FloatArray
    test: tuple[FloatArray, FloatArray]


def draw(seed: int) -> Drawn:
    """A joint and two records of it."""
    rng = np.random.default_rng(seed)
    elastic, hanging, held = seed % 4 != 3, seed % 3 == 1, seed % 2 == 1
    motor, link = rng.uniform(0.5, 5.0), rng.uniform(1.0, 10.0)
    reduced = motor * link / (motor + link)
    resonance = 2 * np.pi * 4.0 * 5.0 ** rng.uniform()
    k = reduced * resonance**2
    d = 2 * rng.uniform(0.01, 0.05) * reduced * resonance
    viscous = (motor + link) * rng.uniform(0.5, 3.0, 2)
    gravity = (motor + link) * rng.uniform(2.0, 20.0) if hanging else 0.0
    if elastic:
        a = np.array(
            [
                [0, 1, 0, 0],
                [-k / motor, -(d + viscous[0]) / motor, k / motor, d / motor],
                [0, 0, 0, 1],
                [k / link, d / link, -(k + gravity) / link, -(d + viscous[1]) / link],
            ]
        )
        b, c = np.array([[0], [1 / motor], [0], [0]]), np.array([[1.0, 0, 0, 0], [1, 0, -1, 0]])
    else:
        whole = motor + link
        a = np.array([[0, 1], [-gravity / whole, -viscous.sum() / whole]])
        b, c = np.array([[0], [1 / whole]]), np.array([[1.0, 0]])
    discrete = cont2discrete((a, b, c, np.zeros((len(c), 1))), DT)[:2]
    gain = 0.3 * (motor + link) * 10.0 if held else 0.0
    size = (motor + link) * 3.0
    runs = [_run(rng, discrete, c, (size, gain), seed % 5 == 2) for _ in range(2)]
    return Drawn(len(a), not hanging, *runs[0], runs[1])


def _run(
    rng: np.random.Generator,
    discrete: tuple[FloatArray, FloatArray],
    c: FloatArray,
    drive: tuple[float, float],
    lines: bool,
) -> tuple[FloatArray, FloatArray]:
    a, b = discrete
    size, gain = drive
    time = DT * np.arange(SAMPLES)
    if lines:
        frequencies = 0.1 + 30.0 * (np.arange(60) / 60.0) ** 1.5
        phases = rng.uniform(0, 2 * np.pi, 60)
        asked = np.sin(2 * np.pi * np.outer(time, frequencies) + phases).sum(axis=1) / np.sqrt(30.0)
    else:
        asked = np.repeat(rng.standard_normal(SAMPLES // 2), 2)
    torque_noise = TORQUE_NOISE * size * rng.standard_normal(SAMPLES)
    noise = POSITION_NOISE * rng.standard_normal((SAMPLES, len(c)))
    x = np.zeros(len(a))
    u, y = np.empty((SAMPLES, 1)), np.empty((SAMPLES, len(c)))
    for k in range(SAMPLES):
        y[k] = c @ x + noise[k]
        u[k] = size * asked[k] - gain * y[k, 0]
        x = a @ x + b[:, 0] * (u[k, 0] + torque_noise[k])
    return u, y


def identify(drawn: Drawn, method: Method = "past_output") -> Subspace:
    """MOESP with the order left open; outputs weighted to like size."""
    weights = tuple(float(w) for w in 1.0 / drawn.y.std(axis=0))
    options = MoespOptions(output_weights=weights)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnstableModelWarning)
        return moesp(drawn.u, drawn.y, BLOCK_ROWS, None, DT, method, options=options)


def pieces_vaf(drawn: Drawn, model: Subspace) -> float:
    """VAF [%] of the worst output on pieces of the unseen record, each from its own state."""
    u, y = drawn.test
    system = tuple(np.asarray(getattr(model.system, k), dtype=np.float64) for k in "ABCD")
    a, b, c, d = system
    source = ArraySource(u, y)
    return float(vaf_of_shots(source, [(0, 0, len(u))], (a, b, c, d), np.ones(len(c))).min())


def main() -> int:
    """Print the share of right orders."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.algorithms.subspace_order")
    parser.add_argument("--joints", type=int, default=100, help="joints drawn (default 100)")
    parser.add_argument("--seed", type=int, default=0, help="first seed (default 0)")
    parser.add_argument(
        "--method", choices=get_args(Method), default="past_output", help="of moesp"
    )
    asked = parser.parse_args()
    start = time.perf_counter()
    found: Counter[tuple[int, int]] = Counter()
    explained = []
    for seed in range(asked.seed, asked.seed + asked.joints):
        drawn = draw(seed)
        model = identify(drawn, asked.method)
        found[drawn.order, model.order] += 1
        explained.append(pieces_vaf(drawn, model))
    right = sum(n for (true, got), n in found.items() if true == got)
    share = right / asked.joints
    print(f"{asked.joints} joints from seed {asked.seed}, {time.perf_counter() - start:.0f} s")
    for (true, got), n in sorted(found.items()):
        print(f"  order {true}: {got} found {n} times")
    least = np.percentile(explained, [50, 10, 0])
    print(
        f"VAF on pieces of an unseen record, the worst output: median {least[0]:.3f}, "
        f"tenth {least[1]:.3f}, least {least[2]:.3f} %"
    )
    print(f"order right: {100 * share:.1f} % (wanted {100 * WANTED:.0f} %)")
    return 0 if share >= WANTED else 1


if __name__ == "__main__":
    sys.exit(main())
