"""Order of a subspace model: singular-value gap, held-out simulation and spectral radius
together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from identification.errors import InputError
from identification.linear.hankel_qr import HankelFactor
from identification.linear.records import Source
from identification.linear.response_fit import ResponseFit
from identification.linear.shots import JUDGED, SAMPLES, fit_shots, is_lost, vaf_of_shots
from identification.linear.triangle import FloatArray, single_thread

# singular values below this part of the largest are rounding
_FLOOR = 1e-11
# a response that changes by less over a shot is constant there, beside shares read to a percent
_CHANGE = 0.01
# orders whose simulation is tried where the singular values show a clear gap
_TRIED = 5
# samples the order choice looks at, before and after the split
_BEFORE, _AFTER = 40_000, 20_000
# a lower order is preferred while it leaves at most this much more variance unexplained:
# factor without and with a clear gap, and percent points
_RATIO, _RATIO_CLEAR, _PERCENT = 1.1, 1.5, 0.05
_CLEAR_GAP = 3.0


def integrates(radius: float) -> bool:
    """Whether a spectral radius is 1 as far as shots can tell: over one of them a response changes
    by less than a hundredth.
    """
    return abs(radius - 1.0) < _CHANGE / JUDGED


@final
@dataclass(frozen=True)
class OrderCandidate:
    """One order and what speaks for it.

    Attributes
    ----------
    order : int
    gap : float
        Ratio of the last singular value kept to the first one dropped.
    spectral_radius : float
        Of the model fitted without the held-out samples.
    held_out_vaf_percent : ndarray, shape (outputs,)
        Variance accounted for in simulation of held-out samples; where no order is stable, on short
        pieces of them; NaN where it was not judged.
    """

    order: int
    gap: float
    spectral_radius: float
    held_out_vaf_percent: FloatArray

    @property
    def clear_gap(self) -> bool:
        """Whether the singular values fall by more than a factor of 3 after this order."""
        return self.gap >= _CLEAR_GAP

    @property
    def is_marginal(self) -> bool:
        """Whether the response does not fade within the shots that such a model is judged on:
        it integrates or is unstable.
        """
        return self.spectral_radius >= 1.0 - 1.0 / JUDGED

    @property
    def integrates(self) -> bool:
        """Whether the largest pole is 1 as far as shots can tell."""
        return integrates(self.spectral_radius)

    @property
    def unexplained_percent(self) -> float:
        """Mean over the outputs of the held-out variance left unexplained; infinite where
        unstable.
        """
        left = 100.0 - self.held_out_vaf_percent
        return float(left.mean()) if np.isfinite(left).all() else float("inf")


def shortlist(singular_values: FloatArray, highest: int) -> tuple[int, ...]:
    """Orders up to `highest` followed by the largest gaps, in rising order; all of them where
    no gap is clear.
    """
    kept = np.flatnonzero(singular_values > _FLOOR * singular_values[0]) + 1
    orders = kept[kept <= highest]
    gaps = np.array([_gap(singular_values, int(order)) for order in orders])
    tried = _TRIED if gaps.max() >= _CLEAR_GAP else len(orders)
    return tuple(sorted(int(order) for order in orders[np.argsort(-gaps, kind="stable")[:tried]]))


def judge(
    source: Source,
    early: HankelFactor,
    orders: tuple[int, ...],
    singular_values: FloatArray,
    split: int,
    weights: FloatArray,
) -> tuple[OrderCandidate, ...]:
    """Fit every order before the split and simulate it after the split."""
    left = early.directions()[0]
    before = _spans(source.lengths, max(split - _BEFORE, 0), split)
    after = _spans(source.lengths, split, split + _AFTER)
    candidates = []
    for order in orders:
        a, c = early.realise(left, order)
        with single_thread():
            radius = float(np.abs(np.linalg.eigvals(a)).max())
        vaf = np.full(early.outputs, np.nan)
        if radius < 1.0:
            trained = _fit(source, before, (a, c), weights).solve()
            tested = _fit(source, after, (a, c), weights)
            vaf = tested.vaf_percent(
                trained.b, trained.d, tested.initial_states(trained.b, trained.d)
            )
            if not np.isfinite(vaf).all():
                still = int(np.flatnonzero(~np.isfinite(vaf))[0])
                raise InputError(
                    f"y channel {still} does not move in the held-out samples: give order or "
                    "held_out"
                )
        candidates.append(OrderCandidate(order, _gap(singular_values, order), radius, vaf))
    return tuple(candidates)


def judge_by_shots(
    source: Source,
    early: HankelFactor,
    candidates: tuple[OrderCandidate, ...],
    split: int,
    weights: FloatArray,
) -> tuple[OrderCandidate, ...]:
    """The candidates judged on short pieces of the held-out samples, for plants that integrate
    or are unstable.
    """
    left = early.directions()[0]
    before = _spans(source.lengths, max(split - _BEFORE, 0), split)
    after = _spans(source.lengths, split, split + _AFTER)
    found = []
    for one in candidates:
        a, c = early.realise(left, one.order)
        length = max(JUDGED, SAMPLES * (one.order + early.inputs))
        made = (
            None
            if is_lost(one.spectral_radius, length)
            else fit_shots(source, before, (a, c), weights, length)
        )
        vaf = (
            np.full(early.outputs, np.nan)
            if made is None
            else vaf_of_shots(source, after, (a, made[0], c, made[1]), weights)
        )
        found.append(replace(one, held_out_vaf_percent=vaf))
    return tuple(found)


def choose_marginal(
    stable: int | None, candidates: tuple[OrderCandidate, ...], judged: tuple[OrderCandidate, ...]
) -> tuple[int, tuple[OrderCandidate, ...]]:
    """The stable order, where on short pieces it does about as well as the best one; else the
    lowest order that does.

    Parameters
    ----------
    stable
        What :func:`choose` gave.
    candidates, judged
        Orders judged on the whole of the held-out samples, and on short pieces of them.

    Returns
    -------
    order, and the candidates as they were judged for it
    """
    best = min(one.unexplained_percent for one in judged)
    if not np.isfinite(best):
        return (
            min(candidates, key=lambda one: one.spectral_radius).order if stable is None else stable
        ), candidates
    good = [one for one in judged if one.unexplained_percent <= _RATIO_CLEAR * best + _PERCENT]
    if stable not in [one.order for one in good] or stable is None:
        return good[0].order, judged
    # a higher order may be stable where that of the plant integrates with a pole just beyond 1
    lower = [one.order for one in good if one.order < stable and one.clear_gap and one.integrates]
    return (lower[0], judged) if lower else (stable, candidates)


def choose(candidates: tuple[OrderCandidate, ...], radius: Callable[[int], float]) -> int | None:
    """Lowest stable order that simulates about as well as the best one.

    "About" is wider for an order after which the singular values fall clearly.
    `radius` gives the spectral radius of the final model of an order. None where no
    order is stable in both.
    """
    stable = [
        one
        for one in candidates
        if np.isfinite(one.unexplained_percent) and radius(one.order) < 1.0
    ]
    if not stable:
        return None
    best = min(one.unexplained_percent for one in stable)
    for one in stable:
        ratio = _RATIO_CLEAR if one.clear_gap else _RATIO
        if one.unexplained_percent <= ratio * best + _PERCENT:
            return one.order
    return stable[-1].order


def _gap(singular_values: FloatArray, order: int) -> float:
    below = singular_values[order] if order < len(singular_values) else 0.0
    return float(singular_values[order - 1] / max(below, _FLOOR * singular_values[0]))


def _spans(lengths: tuple[int, ...], start: int, stop: int) -> list[tuple[int, int, int]]:
    """Parts (record, first, last) of the samples `start` to `stop` counted over all records."""
    spans = []
    seen = 0
    for index, length in enumerate(lengths):
        first, last = max(start - seen, 0), min(stop - seen, length)
        if last > first:
            spans.append((index, first, last))
        seen += length
    return spans


def _fit(
    source: Source,
    spans: list[tuple[int, int, int]],
    matrices: tuple[FloatArray, FloatArray],
    weights: FloatArray,
) -> ResponseFit:
    fit = ResponseFit(*matrices, source.channels[0])
    for index, first, last in spans:
        for u, y in source.pieces(index, first, last):
            fit.add(u, y * weights)
        fit.end_record()
    return fit
