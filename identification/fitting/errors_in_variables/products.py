"""What noise of the measured signals adds to the products of columns and residual of a fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.drawn_noise import draws_of
from identification.balance.stacked import Stacked, noise_believed, stack
from identification.balance.weak import WeakRecord
from identification.fitting.covariance import cores
from identification.fitting.errors_in_variables.instruments import Instruments, from_others
from identification.fitting.weak_form import WeakForm

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MOST_NOISE: Final = 0.9
"""Largest share of the information on a direction that may be noise: the draws know it within 3 %,
and what is left must stand clear of that.
"""


@final
@dataclass(frozen=True)
class NoiseProducts:
    """What noise adds to the normal equations of each balance.

    Attributes
    ----------
    gram : mapping of str to (p, p) array
        To the products of the weighted columns with those that meet them.
    score : mapping of str to (p,) array
        To their products with the weighted residual.
    """

    gram: Mapping[str, FloatArray]
    score: Mapping[str, FloatArray]

    @property
    def whole(self) -> tuple[FloatArray, FloatArray]:
        """Both over all balances."""
        grams, scores = np.array(list(self.gram.values())), np.array(list(self.score.values()))
        return np.asarray(grams.sum(axis=0)), np.asarray(scores.sum(axis=0))

    def of(self, index: IntArray, mix: FloatArray) -> NoiseProducts:
        """Those of some of the columns, met by combinations of theirs (columns, columns)."""
        grams = {b: mix.T @ g[np.ix_(index, index)] for b, g in self.gram.items()}
        return NoiseProducts(
            {b: (g + g.T) / 2 for b, g in grams.items()},
            {b: mix.T @ x[index] for b, x in self.score.items()},
        )

    def by_window(
        self,
        weights: Mapping[str, FloatArray],
        windows: Any,
        taking: Mapping[str, npt.NDArray[np.bool_]],
    ) -> tuple[FloatArray, FloatArray]:
        """What falls to the core of each window of the first, (windows, p, p), and to the window of
        the second, (windows, p): by the squares of the weights of their rows that take part.

        Parameters
        ----------
        weights : mapping of str to (rows,) array
        windows : (windows, rows) sparse array
            Of :func:`identification.fitting.covariance.windows_over`.
        taking : mapping of str to (rows,) bool array
        """
        squares = {b: w**2 * taking[b] for b, w in weights.items()}
        share = {b: w / max(float(w.sum()), 1e-300) for b, w in squares.items()}
        core = cores(windows)
        return (
            np.asarray(sum((core @ share[b])[:, None, None] * g for b, g in self.gram.items())),
            np.asarray(sum((windows @ share[b])[:, None] * x for b, x in self.score.items())),
        )


DrawnRows = list[list[tuple[Stacked, Stacked]]]
"""For each training record and draw: rows without and with the drawn noise."""


def drawn_rows(problem: WeakForm) -> DrawnRows:
    """Rows and columns of a problem as noise is drawn, at its values."""
    balances, data = problem.balances, problem.data

    def rows(record: WeakRecord) -> Stacked:
        return stack(balances, [record], problem.values, problem.free)

    return [
        [(rows(draw.calm), rows(draw.noisy)) for draw in draws_of(record, data.sources)]
        for record in data.train
    ]


def noise_products(
    problem: WeakForm,
    met: frozenset[str] = frozenset(),
    own: DrawnRows | None = None,
    believed: Mapping[str, float] | None = None,
) -> NoiseProducts:
    """What noise adds to the normal equations at the values of a problem.

    Shapes and smoothing velocities bend the columns, where first order does not hold: they are left
    as they are.

    Parameters
    ----------
    problem : WeakForm
    met : frozenset of str
        Balances whose columns are met by those of the other sensors
        (:mod:`identification.fitting.errors_in_variables.instruments`): what noise makes of one,
        times what it makes of the other.
    own : list, optional
        Of :func:`drawn_rows`, where they are known.
    believed : mapping of str to float, optional
        Of :func:`identification.balance.stacked.noise_believed`, where it is known.
    """
    balances, data, free = problem.balances, problem.data, problem.free
    model, count = balances.model, len(free)
    straight = ~problem.bent
    gram = {b: np.zeros((count, count)) for b in balances.balances}
    score = {b: np.zeros(count) for b in balances.balances}
    believed = believed or noise_believed(model, data, problem.values)
    first, own = 0, own or drawn_rows(problem)
    for record, pairs in zip(data.train, own, strict=True):
        rows = slice(first, first + record.rows)
        first = rows.stop
        drawn = draws_of(record, data.sources)
        for draw, (calm, noisy) in zip(drawn, pairs, strict=True):
            theirs = (
                [
                    stack(balances, [from_others(problem, w, record)], problem.values, free)
                    for w in (draw.calm, draw.noisy)
                ]
                if met
                else [calm, noisy]
            )
            for b in balances.balances:
                weight = np.broadcast_to(problem.weights[b], (problem.rows,))[rows]
                squares = weight**2 * record.taking(b)
                # pieces of a long record stand for all of it
                whole = np.sum(squares) / max(float(np.sum(squares[draw.rows])), 1e-300)
                weight = weight[draw.rows] * (believed[b] * np.sqrt(whole / len(drawn)))
                moved = (noisy.jacobian[b] - calm.jacobian[b]) * weight[:, None] * straight
                by = moved
                if b in met:
                    by = (theirs[1].jacobian[b] - theirs[0].jacobian[b]) * weight[:, None]
                    by = by * straight
                gram[b] += by.T @ moved
                score[b] += by.T @ ((noisy.residual[b] - calm.residual[b]) * weight)
    return NoiseProducts(gram, score)


def no_noise(problem: WeakForm) -> NoiseProducts:
    """Products of a problem from whose rows nothing is taken off."""
    size, names = len(problem.free), problem.balances.balances
    return NoiseProducts(
        {b: np.zeros((size, size)) for b in names}, {b: np.zeros(size) for b in names}
    )


def whole_without(whole: FloatArray, noise: FloatArray) -> FloatArray:
    """A normal matrix without what noise adds to it, as far as that is certain.

    Parameters
    ----------
    whole, noise : (p, p) array
        Columns scaled alike; `whole` positive definite but for rounding.
    """
    share, left = shares(whole, noise)
    return np.asarray(left * (1 - np.clip(share, 0.0, MOST_NOISE)) @ left.T, dtype=np.float64)


def shares(whole: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Share of noise in directions that are independent in both matrices, and the directions:
    columns whose products add up to `whole`."""
    value, vector = np.linalg.eigh(whole)
    kept = value > 1e-12 * value[-1]
    root = vector[:, kept] * np.sqrt(value[kept])
    white = vector[:, kept] / np.sqrt(value[kept])
    share, direction = np.linalg.eigh(white.T @ noise @ white)
    return share, np.asarray(root @ direction, dtype=np.float64)


@final
@dataclass(frozen=True)
class Unbiased:
    """A fit without what noise of the signals does to it.

    Attributes
    ----------
    values : mapping of str to float
    noise : NoiseProducts
        What noise adds to the normal equations there.
    instruments : Instruments or None
        The columns that meet those of some balances; None where each meets itself.
    """

    values: Mapping[str, float]
    noise: NoiseProducts
    instruments: Instruments | None = None


__all__ = [
    "DrawnRows",
    "NoiseProducts",
    "Unbiased",
    "drawn_rows",
    "no_noise",
    "noise_products",
    "shares",
    "whole_without",
]
