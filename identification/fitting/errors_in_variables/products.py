"""What noise of the measured signals adds to the products of columns and residual of a fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import balances_of
from identification.balance.calibration import bare
from identification.balance.dataset import Dataset
from identification.balance.drawn_noise import draws_of
from identification.balance.stacked import Stacked, noise_believed, stack
from identification.balance.weak import INDEPENDENT_SHARE, WeakRecord
from identification.fitting.covariance import cores
from identification.fitting.errors_in_variables.instruments import Instruments, from_others
from identification.fitting.weak_form import WeakForm

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MOST_NOISE: Final = 0.9
"""Largest share of the information on a direction that may be noise: the draws know it within 3 %,
and what is left must stand clear of that.
"""
KNOWN_NOISE: Final = 0.97
"""The same where an error is told, which is then thirty times that of rows without noise. A step
that divides by what is left has to be safer.
"""
CERTAIN: Final = 1.96
"""Standard errors of the noise within which a direction may be nothing but noise: 95 %."""
SURE_STEP: Final = 0.01
"""Least share that counts: a fit has not ended to better than that of its squares."""


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


def drawn_rows(
    problem: WeakForm, read: Callable[[WeakRecord, WeakRecord], WeakRecord] | None = None
) -> DrawnRows:
    """Rows of a problem as noise is drawn, at its values, and the columns of those parameters that
    do not bend them; `read` makes of a drawn record and its own what is looked at.
    """
    straight = [n for n, bent in zip(problem.free, problem.bent, strict=True) if not bent]
    balances = balances_of(problem.balances.model, problem.data.sensing, wrt=bare(straight))

    def rows(drawn: WeakRecord, record: WeakRecord) -> Stacked:
        seen = drawn if read is None else read(drawn, record)
        return stack(balances, [seen], problem.values, straight)

    return each_drawn(problem.data, rows)


def each_drawn(data: Dataset, rows: Callable[[WeakRecord, WeakRecord], Stacked]) -> DrawnRows:
    """What is made of each training record without and with drawn noise."""
    found: DrawnRows = []
    for record in data.train:
        draws = draws_of(record, data.sources)
        calm, noisy = (rows(w, record) for w in (draws.calm, draws.noisy))
        found.append([(calm, part) for part in noisy.parts(draws.count)])
    return found


def level_error(data: Dataset) -> float:
    """Standard error of the squares that noise adds to a direction, as a share of them: of the
    noise that is in the training rows, and of the one that is drawn.
    """
    draws = [draws_of(record, data.sources) for record in data.train]
    drawn = sum(d.count * len(d.rows) for d in draws)
    rows = min(sum(int(w.taking(b).sum()) for w in data.train) for b in data.sensing.balances)
    return math.sqrt(sum(2 / (INDEPENDENT_SHARE * max(n, 1)) for n in (drawn, rows)))


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
    balances, data, straight = problem.balances, problem.data, np.flatnonzero(~problem.bent)
    believed = believed or noise_believed(balances.model, data, problem.values)
    weights = {b: np.broadcast_to(problem.weights[b], (problem.rows,)) for b in balances.balances}
    found = moved_rows(own or drawn_rows(problem), data, weights, believed)
    theirs = found
    if met:
        others = drawn_rows(problem, lambda w, record: from_others(problem, w, record))
        theirs = moved_rows(others, data, weights, believed)
    size = len(problem.free)
    gram, score = ({b: np.zeros(shape) for b in found} for shape in ((size, size), size))
    for b, rows in found.items():
        moved = rows[:, :-1]
        by = theirs[b][:, :-1] if b in met else moved
        gram[b][np.ix_(straight, straight)] = by.T @ moved
        score[b][straight] = by.T @ rows[:, -1]
    return NoiseProducts(gram, score)


def moved_rows(
    drawn: DrawnRows,
    data: Dataset,
    weights: Mapping[str, FloatArray],
    believed: Mapping[str, float],
) -> dict[str, FloatArray]:
    """What drawn noise changes in the columns and in the residual of each balance, (drawn rows,
    columns + 1), weighted so that its products are what noise adds to those of all rows.

    Parameters
    ----------
    drawn : list
        Of the training records.
    data : Dataset
    weights : mapping of str to (rows,) array
        Of the training rows.
    believed : mapping of str to float
        Of :func:`identification.balance.stacked.noise_believed`.
    """
    out: dict[str, list[FloatArray]] = {b: [] for b in weights}
    first = 0
    for record, pairs in zip(data.train, drawn, strict=True):
        rows = slice(first, first + record.rows)
        first = rows.stop
        drawn_of = draws_of(record, data.sources).rows
        for calm, noisy in pairs:
            for b, given in weights.items():
                squares = given[rows] ** 2 * record.taking(b)
                # pieces of a long record stand for all of it
                whole = np.sum(squares) / max(float(np.sum(squares[drawn_of])), 1e-300)
                weight = given[rows][drawn_of] * (believed[b] * np.sqrt(whole / len(pairs)))
                moved = np.column_stack(
                    [noisy.jacobian[b] - calm.jacobian[b], noisy.residual[b] - calm.residual[b]]
                )
                out[b].append(moved * weight[:, None])
    return {b: np.concatenate(parts) for b, parts in out.items()}


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


def known(whole: FloatArray, noise: FloatArray, unsure: float) -> FloatArray:
    """What a normal matrix holds at least without noise whose squares are known to `unsure`, a
    share: what a small rest of much noise tells may be next to nothing. The others are as for
    :func:`whole_without`.
    """
    share, left = shares(whole, noise)
    return np.asarray(left * _known(share, unsure) @ left.T, dtype=np.float64)


def kept(whole: FloatArray, noise: FloatArray, unsure: float) -> FloatArray:
    """K with K (whole - noise) K' = :func:`known`, (p, p), where the noise leaves more than that:
    what makes the certain part of a part of them."""
    share, left, right = _apart(whole, noise)
    rest = _known(share, unsure)
    return np.asarray(left * np.sqrt(rest / np.maximum(1 - share, rest)) @ right.T)


def _known(share: FloatArray, unsure: float) -> FloatArray:
    return np.asarray(1 - np.clip(share * (1 + unsure), 0.0, KNOWN_NOISE))


def told(whole: FloatArray, noise: FloatArray, unsure: float) -> FloatArray:
    """What a step is multiplied by, (p, p), so that the rows change by it as much as they tell of
    it for certain: nothing where it may be noise as well. The arguments are those of
    :func:`known`.
    """
    share, left, right = _apart(whole, noise)
    share = np.maximum(share, 0.0)
    kept = np.where(share * (1 + CERTAIN * unsure) < 1, 1 - share, 0.0)
    return np.asarray(right * np.sqrt(np.maximum(kept, 0.0)) @ left.T, dtype=np.float64)


def shares(whole: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Share of noise in directions that are independent in both matrices, and the directions:
    columns whose products add up to `whole`."""
    share, left, _ = _apart(whole, noise)
    return share, left


def certain(whole: FloatArray, noise: FloatArray) -> FloatArray:
    """What drawn columns are multiplied by, (p, p), so that of no direction of `whole` they hold
    more than is certain (:data:`MOST_NOISE`); `noise` is what they add to it.
    """
    share, left, right = _apart(whole, noise)
    less = np.sqrt(np.clip(share, 0.0, MOST_NOISE) / np.maximum(share, 1e-300))
    return np.asarray(right * less @ left.T, dtype=np.float64)


def _apart(whole: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """As :func:`shares`, and the combinations of the columns that the directions are."""
    value, vector = np.linalg.eigh(whole)
    kept = value > 1e-12 * value[-1]
    root = vector[:, kept] * np.sqrt(value[kept])
    white = vector[:, kept] / np.sqrt(value[kept])
    share, direction = np.linalg.eigh(white.T @ noise @ white)
    return share, root @ direction, white @ direction


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
    left : (free,) array
        How far noise that is not taken off may have moved each parameter.
    """

    values: Mapping[str, float]
    noise: NoiseProducts
    instruments: Instruments | None
    left: FloatArray


__all__ = [
    "KNOWN_NOISE",
    "MOST_NOISE",
    "DrawnRows",
    "NoiseProducts",
    "Unbiased",
    "certain",
    "drawn_rows",
    "each_drawn",
    "kept",
    "known",
    "level_error",
    "moved_rows",
    "no_noise",
    "noise_products",
    "shares",
    "told",
    "whole_without",
]
