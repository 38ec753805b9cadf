"""Which variant the records speak for, which they cannot tell from it, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.variants.lattice import PER_EFFECT
from identification.variants.refit import Refit

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

DRAWS: Final = 300
"""Resamplings of the blocks: enough for a 5 % quantile to a percent."""
SEED: Final = 14
"""Of these resamplings: the same records give the same answer."""
TIE_QUANTILE: Final = 0.05
"""A variant ties with the best where it does better in this share of the resamplings."""
TIE_MARGIN: Final = 0.5 * PER_EFFECT
"""Difference of the scores, and of the errors in them, below which variants tie however certain it
is: 5 % of a balance's RMS, below which one effect counts as good as two elsewhere
(:data:`identification.diagnosis.session.SAME_WITH_ONE_LESS`); what no model holds shifts the RMS of
laws that are one column on the records by as much.  Where errors that differ by more are evened out
by the price of parameters, the records tell the laws apart."""
WINDOWS: Final = 4
"""Parts of the records, one after the other, in which the choice is made again."""
FRONT_LEAST: Final = 0.01
"""Fall of the held-out error by which a variant with more parameters is on the front: less is not
seen in a picture."""


@final
@dataclass(frozen=True)
class Judged:
    """Scores of all variants, and what resampled blocks make of them.

    Attributes
    ----------
    best : int
        The variant with the lowest score of those that may be recommended.
    error : (variants,) array
        The score without that price.
    score : (variants,) array
        Sum over balances of ln RMS of blocks that the fit did not see, held-out records among
        them, and the price of its effects.
    behind : (variants,) array
        The 5 % quantile of score less that of the best, over resampled blocks: a tie up to 0.
    chosen : (variants,) array
        Share of the resamplings in which the variant is the best.
    windows, records : tuple of int
        The best variant of each part of the records, and of each record alone.
    most : (variants,) array
        The 95 % quantile of error less that of the best, over resampled blocks: certainly less up
        to 0.
    """

    best: int
    error: FloatArray
    score: FloatArray
    behind: FloatArray
    chosen: FloatArray
    windows: tuple[int, ...]
    most: FloatArray
    records: tuple[int, ...] = ()


def score_of(squares: FloatArray, rows: FloatArray, price: FloatArray) -> FloatArray:
    """Score of variants on some blocks.

    Parameters
    ----------
    squares, rows : (..., balances) arrays
        Sums over the blocks.
    price : (...) array
        What their effects must bring (:func:`identification.variants.lattice.price_of`).
    """
    mean = np.maximum(squares, 1e-300) / np.maximum(rows, 1.0)
    return np.asarray(0.5 * np.where(rows > 0, np.log(mean), 0.0).sum(axis=-1) + price)


def judged(
    refits: Sequence[Refit], open_to: Sequence[bool], records: Sequence[IntArray] = ()
) -> Judged:
    """Hold variants against each other on the same blocks.

    Parameters
    ----------
    refits : sequence of Refit
    open_to : sequence of bool
        Which of them may be recommended: those with every effect of the joint's own model, without
        a name that whole fits tell from another one. One of these is the best.
    records : sequence of (blocks,) int array
        Blocks of each record.
    """
    squares = np.array([r.squares for r in refits])
    rows = np.array([r.rows for r in refits])
    price = np.array([r.price for r in refits])
    error = score_of(squares.sum(axis=1), rows.sum(axis=1), 0 * price)
    score = error + price
    used = np.flatnonzero(rows[0].sum(axis=1) > 0)
    draws = np.random.default_rng(SEED).integers(0, len(used), (DRAWS, len(used)))
    count = np.zeros((DRAWS, squares.shape[1]))
    for k, drawn in enumerate(draws):
        count[k] = np.bincount(used[drawn], minlength=squares.shape[1])
    drawn_errors = score_of(
        np.einsum("dk,vkb->dvb", count, squares), np.einsum("dk,vkb->dvb", count, rows), 0 * price
    )
    drawn_scores = drawn_errors + price
    aside = np.where(open_to, 0.0, np.inf)
    best = int(np.argmin(score + aside))
    behind = np.quantile(drawn_scores - drawn_scores[:, [best]], TIE_QUANTILE, axis=0)
    apart = drawn_errors - drawn_errors[:, [best]]
    most = np.quantile(apart, 1 - TIE_QUANTILE, axis=0)
    chosen = np.bincount((drawn_scores + aside).argmin(axis=1), minlength=len(refits)) / DRAWS
    windows = tuple(
        int(np.argmin(aside + _on(part, squares, rows, price)))
        for part in np.array_split(used, min(WINDOWS, len(used)))
        if len(part)
    )
    alone = tuple(int(np.argmin(aside + _on(part, squares, rows, price))) for part in records)
    return Judged(best, error, score, behind, chosen, windows, most=most, records=alone)


def _on(blocks: IntArray, squares: FloatArray, rows: FloatArray, price: FloatArray) -> FloatArray:
    """Scores on some of the blocks."""
    return score_of(squares[:, blocks].sum(axis=1), rows[:, blocks].sum(axis=1), price)


def tied_with_best(
    scores: Judged,
    open_to: Sequence[bool],
    parts: Sequence[frozenset[str]],
    sets: Mapping[str, frozenset[str]] = MappingProxyType({}),
) -> list[bool]:
    """Which variants the records do not tell from the best one, itself among them.

    One that holds all parts of another tie and more, and is no better, says nothing beside it. But
    where what it has beyond the best one lowers the error for certain, and by more than the margin,
    nothing has decided but the price: it guards against laws that imitate what no model holds, and
    whether it is one of these the records do not tell. Of two such ones that with less error
    and a score that is better by more than the margin leaves nothing to be said for the other.

    Parameters
    ----------
    scores : Judged
    open_to : sequence of bool
        Which variants may be recommended.
    parts : sequence of frozenset of str
        Labels of each.
    sets : mapping of str to frozenset of str
        For a label of the best one, those that whole fits leave for its place, however many
        parameters they have.
    """
    best = scores.best
    behind = scores.score - scores.score[best]
    apart = np.maximum(behind, np.abs(scores.error - scores.error[best]))
    less = scores.error[best] - scores.error
    more = [
        parts[best] < own and bool(most < 0 and fall >= TIE_MARGIN)
        for own, most, fall in zip(parts, scores.most, less, strict=True)
    ]
    more = [
        m
        and not any(
            other and less[j] >= less[k] and behind[j] < behind[k] - TIE_MARGIN
            for j, other in enumerate(more)
        )
        for k, m in enumerate(more)
    ]
    alike = [
        w and bool(q <= 0 or d <= TIE_MARGIN or m or exchanged(parts[best], own, sets))
        for w, q, d, m, own in zip(open_to, scores.behind, apart, more, parts, strict=True)
    ]

    def says_nothing(k: int) -> bool:
        """Whether a tie has all parts of another one and more without being better."""
        return any(
            alike[j]
            and parts[j] < parts[k]
            and behind[j] <= behind[k]
            and not (more[k] and less[k] - less[j] >= TIE_MARGIN)
            for j in range(len(parts))
        )

    return [k == best or (alike[k] and not says_nothing(k)) for k in range(len(parts))]


def exchanged(
    best: frozenset[str], other: frozenset[str], sets: Mapping[str, frozenset[str]]
) -> bool:
    """Whether one variant is another with names in place of names of the same sets."""
    gone, came = best - other, other - best
    return (
        0 < len(gone) == len(came)
        and all(any(c in sets.get(g, ()) for g in gone) for c in came)
        and all(any(c in sets.get(g, ()) for c in came) for g in gone)
    )


def front_of(parameters: Sequence[int], error: Sequence[float]) -> list[int]:
    """Variants on the front of error against parameters, the fewest parameters first.

    Each is better than all with fewer parameters; those that are as good with as many parameters
    stand side by side.
    """
    out: list[int] = []
    lowest = np.inf
    for count in sorted(set(parameters)):
        here = sorted((k for k, p in enumerate(parameters) if p == count), key=lambda k: error[k])
        best = error[here[0]]
        if best < lowest * (1 - FRONT_LEAST):
            out += [k for k in here if error[k] <= best * (1 + FRONT_LEAST)]
            lowest = best
    return out
