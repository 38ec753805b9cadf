"""Restarts of a coordinate search by covariance matrix adaptation: for valleys that lie across the
coordinates.

Splitting boxes along coordinates sees little of a function whose valleys run obliquely in four
coordinates or more. Samples of a normal distribution whose covariance learns the shape of the
valleys do not care for the coordinates. The random numbers come from a fixed seed, so that the same
call gives the same result.

Source: Hansen, The CMA evolution strategy: a tutorial, arXiv:1604.00772 (2016), with its default
settings; restarts with growing populations: Auger and Hansen, IEEE CEC 2005, 1769-1776.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, final

import numpy as np

from identification.search.evaluate import Evaluator
from identification.search.types import FloatArray

SEED: Final = 20_231
"""Of the random numbers."""
SPREAD: Final = 0.3
"""Standard deviation at the start, in widths of the box, as the tutorial advises: the optimum lies
within three of them.
"""
SMALLEST: Final = 1e-9
"""Standard deviation, in widths of the box, at which a run has settled; a local search follows."""
FLATTEST: Final = 1e-12
"""Range of the best values of the last generations, relative to what the run gained, that ends it.
"""
WORST_CONDITION: Final = 1e14
"""Condition of the covariance beyond which its axes are rounding."""
STALLED: Final = 1.4
"""Length of the path, in that of a random one, above which the covariance does not follow it: the
tutorial's figure, which keeps the axes from growing while the step size does.
"""


@final
@dataclass(frozen=True)
class Shape:
    """Constants of the strategy for a number of coordinates and a population."""

    coordinates: int
    population: int

    @property
    def weights(self) -> FloatArray:
        """Of the better half, best first, of sum 1."""
        half = self.population // 2
        raw = math.log(half + 0.5) - np.log(np.arange(1, half + 1))
        weights: FloatArray = raw / raw.sum()
        return weights

    @property
    def effective(self) -> float:
        """Number of samples that the weights are worth."""
        return 1.0 / float(np.sum(self.weights**2))


def population(coordinates: int, run: int) -> int:
    """Samples of a generation: the tutorial's, doubled with each run."""
    return (4 + int(3 * math.log(coordinates))) << run


def evolve(evaluate: Evaluator, run: int, start: FloatArray | None) -> tuple[float, FloatArray]:
    """One run; returns the best value and point of its own.

    Parameters
    ----------
    evaluate : Evaluator
        The objective with its box; it stops the search at the target or the limit.
    run : int
        Number of the run: its population is doubled with each, its random numbers are its own.
    start : (n,) array, optional
        Mean of the first generation; drawn from the box where not given.
    """
    low, high = np.array(evaluate.low), np.array(evaluate.high)
    n, width = len(low), high - low
    rng = np.random.default_rng([SEED, run])
    shape = Shape(n, population(n, run))
    weights, mu = shape.weights, shape.effective
    # the tutorial's table 1
    to_mean = (mu + 2) / (n + mu + 5)
    damping = 1 + 2 * max(0.0, math.sqrt((mu - 1) / (n + 1)) - 1) + to_mean
    to_path = (4 + mu / n) / (n + 4 + 2 * mu / n)
    one = 2 / ((n + 1.3) ** 2 + mu)
    many = min(1 - one, 2 * (mu - 2 + 1 / mu) / ((n + 2) ** 2 + mu))
    length = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n))
    # in widths of the box, so that its coordinates are of one scale
    mean = rng.uniform(0.0, 1.0, n) if start is None else (np.asarray(start) - low) / width
    step, covariance = SPREAD, np.eye(n)
    path, path_step = np.zeros(n), np.zeros(n)
    best, best_x, first = math.inf, mean, math.inf
    lately: list[float] = []
    kept = 10 + math.ceil(30 * n / shape.population)
    generation = 0
    while True:
        generation += 1
        values, axes = np.linalg.eigh(covariance)
        if values[0] <= 0 or values[-1] > WORST_CONDITION * values[0]:
            break
        root = axes * np.sqrt(values)
        drawn = rng.standard_normal((shape.population, n))
        offsets = drawn @ root.T
        points = _mirrored(mean + step * offsets)
        found = np.array([evaluate((low + width * x).tolist()) for x in points])
        order = np.argsort(found, kind="stable")
        if found[order[0]] < best:
            best, best_x = float(found[order[0]]), points[order[0]]
        first = min(first, float(np.median(found))) if generation == 1 else first
        lately = [*lately[1 - kept :], float(found[order[0]])]
        chosen = offsets[order[: len(weights)]]
        moved = weights @ chosen
        mean = np.clip(mean + step * moved, 0.0, 1.0)
        white = axes @ ((axes.T @ moved) / np.sqrt(values))
        path_step = (1 - to_mean) * path_step + math.sqrt(to_mean * (2 - to_mean) * mu) * white
        size = float(np.linalg.norm(path_step))
        grown = 1 - (1 - to_mean) ** (2 * generation)
        slow = size / math.sqrt(grown) < (STALLED + 2 / (n + 1)) * length
        path = (1 - to_path) * path + slow * math.sqrt(to_path * (2 - to_path) * mu) * moved
        lost = (1 - slow) * to_path * (2 - to_path)
        covariance = (
            (1 - one - many + one * lost) * covariance
            + one * np.outer(path, path)
            + many * (chosen.T * weights) @ chosen
        )
        covariance = 0.5 * (covariance + covariance.T)
        step *= math.exp((to_mean / damping) * (size / length - 1))
        if step * math.sqrt(float(values[-1])) < SMALLEST:
            break
        span = max(abs(first - best), 1e-300)
        if len(lately) == kept and max(lately) - min(lately) < FLATTEST * span:
            break
        step = min(step, 1.0 / math.sqrt(float(values[-1])))
    return best, low + width * best_x


def _mirrored(points: FloatArray) -> FloatArray:
    """Points of the unit box: those outside are reflected at its walls."""
    turned: FloatArray = np.abs((points + 1.0) % 2.0 - 1.0)
    return turned
