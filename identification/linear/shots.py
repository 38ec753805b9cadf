"""Models whose response does not fade over a record: fitted and judged on short pieces, each
with its own initial state.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from identification.linear.records import Source
from identification.linear.response_fit import ResponseFit, simulate
from identification.linear.triangle import FloatArray, single_thread

GROWTH: Final = 1e2
"""Growth of a response over a shot of the fit: the initial state is then as well known as the
end.
"""
SAMPLES: Final = 10
"""Fewest samples of a shot of the fit for each unknown of its response."""
FARTHEST: Final = 1e12
"""Growth over such a shot beyond which nothing of a model's digits is left."""
MOST: Final = 1000
"""Most shots that are looked at."""
JUDGED: Final = 200
"""Samples of a shot on which a model is judged: the initial state from the first half, the
error of the second.
"""
Spans = list[tuple[int, int, int]]


def is_lost(radius: float, samples: int) -> bool:
    """True where a response grows so far over a shot that none of its digits are left."""
    return samples * math.log(max(radius, 1.0)) > math.log(FARTHEST)


def shot_length(radius: float, unknowns: int) -> int:
    """Samples of a shot of the fit, for a spectral radius above 1."""
    return max(round(math.log(GROWTH) / math.log(radius)), SAMPLES * unknowns)


def shots(source: Source, spans: Spans, length: int) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Inputs and outputs of whole shots, one after the other; what is left at the end of a span
    is left out.
    """
    made = 0
    for index, first, last in spans:
        kept_u: list[FloatArray] = []
        kept_y: list[FloatArray] = []
        held = 0
        for u, y in source.pieces(index, first, last):
            done = 0
            while done < len(u):
                end = min(len(u), done + length - held)
                kept_u.append(u[done:end])
                kept_y.append(y[done:end])
                held, done = held + end - done, end
                if held == length:
                    yield np.concatenate(kept_u), np.concatenate(kept_y)
                    made += 1
                    if made == MOST:
                        return
                    kept_u, kept_y, held = [], [], 0


def fit_shots(
    source: Source,
    spans: Spans,
    matrices: tuple[FloatArray, FloatArray],
    weights: FloatArray,
    length: int,
) -> tuple[FloatArray, FloatArray] | None:
    """B and D for given A and C; None where no span holds a shot."""
    fit, made = ResponseFit(*matrices, source.channels[0]), 0
    for u, y in shots(source, spans, length):
        fit.add(u, y * weights)
        fit.end_record()
        made += 1
    if not made:
        return None
    solved = fit.solve()
    return solved.b, solved.d


def vaf_of_shots(
    source: Source,
    spans: Spans,
    system: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    weights: FloatArray,
) -> FloatArray:
    """Variance accounted for in the second halves of the shots, per output [%]; NaN where no
    span holds a shot.
    """
    a, b, c, d = system
    half = JUDGED // 2
    free = [c]
    for _ in range(JUDGED - 1):
        free.append(free[-1] @ a)
    observed = np.array(free)
    error, total = np.zeros(len(c)), np.zeros(len(c))
    with single_thread():
        for u, y in shots(source, spans, JUDGED):
            left = y * weights - simulate(a, b, c, d, u)
            state = np.linalg.lstsq(
                observed[:half].reshape(-1, len(a)), left[:half].ravel(), rcond=None
            )[0]
            rest = left[half:] - observed[half:] @ state
            scaled = y[half:] * weights
            error += np.sum(rest**2, axis=0)
            total += np.sum((scaled - scaled.mean(axis=0)) ** 2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        found: FloatArray = 100.0 * (1.0 - error / total)
    return found
