"""Candidates tried on a fitted base: best shape by projection, block cross-validation, held-out
drop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS, Effect, JointModel
from identification.balance.balances import Balances, balances_of
from identification.balance.calibration import bare, names_of_runs, settled, within_limits
from identification.balance.colour import LEVEL_ERROR
from identification.balance.dataset import HOLD_NAME
from identification.balance.noise import effective_share
from identification.balance.stacked import (
    drawn_floors,
    noise_believed,
    passed_on,
    rms,
    taking_part,
)
from identification.balance.weak import WeakRecord
from identification.data.formats import words
from identification.diagnosis.candidates import Candidate, NotTestable, shape_grid
from identification.fitting.covariance import wald
from identification.fitting.engine import Dataset, Solution, Stacked, row_weights, stack
from identification.fitting.errors_in_variables.products import (
    MOST_NOISE,
    SURE_STEP,
    DrawnRows,
    certain,
    each_drawn,
    moved_rows,
    shares,
)
from identification.fitting.signed_fit import inverse, projected_gain, signed_fit
from identification.fitting.start_values import bounds_of
from identification.fitting.weak_form import bending

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FOLDS: Final = 4
FEW_BLOCKS: Final = 32
"""Below this many blocks up to ten folds are used, so that no fold takes a whole kind of motion
away.
"""

COLLINEAR: Final = 2e-3
"""Share of a candidate's columns outside the base below which it is not testable."""

ALL_NOISE: Final = "what the readings show of it beside the model is noise"
"""Why a candidate is not tried whose columns outside the base noise makes."""
UNNAMED_LINE: Final = "explains most of a line whose order has no name"
"""Why a periodic effect is no candidate whose own order is none that it may have."""
REFINE_SHARE: Final = 0.1
"""Share of the residual that a candidate must explain on its grid before its shape is refined."""

KERNEL_SHARE: Final = 0.4
"""Share of rows that count as independent under white noise: four rows per kernel length."""


UNSEEN: Final = 1.0
"""Standard deviations, over all rows together, by which a change of a shape by all of its size must
move them to be seen at all."""

LEAST_UNIT: Final = 1e-9
"""Least length that counts as noise: any fall in units of it is none."""
MINOR_DROP: Final = 2.5
"""Cross-validated fall from which a small effect is told [%]: a quarter of what a claim asks."""
DEPENDENT: Final = 1e-9
"""Singular value, as a share of the largest one, below which columns are dependent: far over the
rounding of their sums, far below what records can show.
"""


@final
@dataclass(frozen=True, eq=False)
class Noise:
    """What measurement noise adds to the products of the rows of a base.

    Attributes
    ----------
    moved : mapping of str to (drawn rows, columns + 1) array
        What drawn noise changes in the columns, as far as it is certain, and in the residual of
        each balance.
    score : mapping of str to (columns,) array
        Products of all that it changes in the columns with what it changes in the residual.
    believed : mapping of str to float
        Share of the noise that the rows show.
    residual : (n,) array, weighted
        Where the equations of the base hold without the noise, in `order`.
    """

    moved: Mapping[str, FloatArray]
    score: Mapping[str, FloatArray]
    believed: Mapping[str, float]
    residual: FloatArray

    def products(self, more: Mapping[str, FloatArray] | None = None) -> FloatArray:
        """Of each balance, with further columns before the residual; none of the residual with
        itself: that is the noise which rows are left with.
        """
        out = []
        for b, rows in self.moved.items():
            whole = rows if more is None else np.column_stack([rows[:, :-1], more[b], rows[:, -1]])
            gram, own = whole.T @ whole, len(self.score[b])
            gram[-1, -1] = 0.0
            gram[:own, -1] = gram[-1, :own] = self.score[b]
            out.append(gram)
        return np.array(out)


@final
@dataclass(frozen=True)
class Base:
    """The fitted base with its weighted rows, projected once for all candidates.

    Attributes
    ----------
    rows : mapping of str to (rows,) slice of the stacked vector
    residual : (n,) array, weighted
    jacobian : (n, p) array, weighted and scaled to unit columns
    orthonormal : (n, r) array
    inward : (n, m) array
        Like `jacobian`, for amplitudes that stand at a bound: a candidate may let them return from
        it.
    held_own : (rows, r) array
        Orthonormal: what the calibration of the held-out records themselves takes up, each fitted
        on itself.
    block : (n,) int array
    balance : (n,) int array
    effective : mapping of str to float
        Independent rows per balance, from the autocorrelation of the residual.
    names : tuple of str
        Parameters of the columns of `jacobian`.
    norms : (p,) array
        What these columns were divided by.
    inward_names : tuple of str
        Parameters of the columns of `inward`.
    inward_norms : (m,) array
        What these columns were divided by; negative where inward is downward.
    noise : Noise, optional
        Where the fit has taken noise off: a step of the base explains nothing by it.
    """

    solution: Solution
    data: Dataset
    residual: FloatArray
    jacobian: FloatArray
    inward: FloatArray
    orthonormal: FloatArray
    block: IntArray
    balance: IntArray
    weight: FloatArray
    share: FloatArray
    held_residual: FloatArray
    held_jacobian: FloatArray
    held_inward: FloatArray
    held_own: FloatArray
    held_balance: IntArray
    held_weight: FloatArray
    names: tuple[str, ...]
    norms: FloatArray
    inward_names: tuple[str, ...] = ()
    inward_norms: FloatArray = field(default_factory=lambda: np.empty(0))
    noise: Noise | None = None

    @property
    def parts(self) -> tuple[int, int]:
        """Where a candidate's solution passes from free parameters to those at a bound, and
        from these to its own amplitudes.
        """
        return self.jacobian.shape[1], self.jacobian.shape[1] + self.inward.shape[1]

    @property
    def balances(self) -> tuple[str, ...]:
        """Balances in the order of their numbers."""
        return self.data.sensing.balances

    @cached_property
    def blocks(self) -> int:
        """Number of blocks."""
        return int(self.block.max()) + 1

    @cached_property
    def order(self) -> IntArray:
        """Rows that belong to a block, block after block and balance after balance."""
        used = np.flatnonzero(self.block >= 0)
        return np.asarray(used[np.lexsort((self.balance[used], self.block[used]))], dtype=np.int64)

    @cached_property
    def firsts(self) -> IntArray:
        """Where each group of one block and balance begins in `order`."""
        group = self.block[self.order] * len(self.balances) + self.balance[self.order]
        return np.concatenate([[0], np.flatnonzero(np.diff(group)) + 1]).astype(np.int64)

    @cached_property
    def numbers(self) -> IntArray:
        """Rows of each block and balance."""
        count = len(self.balances)
        where = self.block[self.order] * count + self.balance[self.order]
        return np.bincount(where, minlength=self.blocks * count).reshape(self.blocks, count)

    def grouped(self, left: FloatArray, right: FloatArray) -> FloatArray:
        """Products of columns of `order` within each block and balance, (blocks, balances,
        left, right).
        """
        out = np.zeros((self.blocks, len(self.balances), left.shape[1], right.shape[1]))
        ends = np.append(self.firsts[1:], len(self.order))
        at = self.order[self.firsts]
        for first, end, b, k in zip(
            self.firsts.tolist(),
            ends.tolist(),
            self.block[at].tolist(),
            self.balance[at].tolist(),
            strict=True,
        ):
            np.matmul(left[first:end].T, right[first:end], out=out[b, k])
        return out

    @cached_property
    def noise_alone(self) -> dict[str, float]:
        """RMS that noise alone leaves of each balance under the base."""
        return _noise_alone(self.solution.model, self.data, self.solution.values)

    @cached_property
    def torques_alone(self) -> dict[str, float]:
        """RMS that a standard deviation of the torques leaves of each balance under the base."""
        return _torques_alone(self.solution.model, self.data, self.solution.values)

    @cached_property
    def plain(self) -> FloatArray:
        """Columns of the base and its residual, in `order`."""
        return np.column_stack([self.jacobian, self.inward, self.residual])[self.order]

    @cached_property
    def tried(self) -> FloatArray:
        """The same with the residual that a trial starts from."""
        if self.noise is None:
            return self.plain
        return np.column_stack([self.plain[:, :-1], self.noise.residual])

    @cached_property
    def products(self) -> FloatArray:
        """Products of these within each block and balance."""
        return self.grouped(self.tried, self.tried)

    @cached_property
    def noise_share(self) -> FloatArray:
        """Part of what noise adds to a balance that falls to each block, (blocks, balances)."""
        count = len(self.balances)
        squares = np.bincount(
            self.block[self.order] * count + self.balance[self.order],
            weights=self.weight[self.order] ** 2,
            minlength=self.blocks * count,
        ).reshape(self.blocks, count)
        return np.asarray(squares / np.maximum(squares.sum(axis=0), 1e-300))

    def moved(self, drawn: DrawnRows, believed: Mapping[str, float]) -> dict[str, FloatArray]:
        """What drawn noise changes in the rows of the products, with the weights of these."""
        weights = np.split(np.where(self.block >= 0, self.weight, 0.0), len(self.balances))
        return moved_rows(drawn, self.data, dict(zip(self.balances, weights)), believed)

    def less_noise(self, grams: FloatArray, noise: FloatArray) -> FloatArray:
        """Products of each block and balance without what noise adds to each balance."""
        return np.asarray(grams - self.noise_share[:, :, None, None] * noise)

    @cached_property
    def folds(self) -> int:
        """Parts of the cross-validation."""
        return FOLDS if self.blocks >= FEW_BLOCKS else max(1, min(self.blocks, 10))

    @cached_property
    def crossed(self) -> FloatArray:
        """Sum of squares that the base leaves of each block and balance, fitted without that
        fold; (blocks, balances).
        """
        p, own = self.parts
        grams = self.products
        if self.noise is not None:
            grams = self.less_noise(grams, self.noise.products())
        total = grams.sum(axis=(0, 1))
        out = np.zeros(grams.shape[:2])
        for test in self.held_out_folds():
            train = total - grams[test].sum(axis=(0, 1)) if self.folds > 1 else total
            found = signed_fit(
                train[:own, :own], -train[:own, -1], np.zeros(own - p), p, total[:own, :own]
            )
            out[test] = _quadratic(grams[test], np.append(found, 1.0))
        return out

    def held_out_folds(self) -> list[npt.NDArray[np.bool_]]:
        """Which blocks each fold holds out."""
        fold = np.arange(self.blocks) % self.folds
        return [fold == k for k in range(self.folds)]


def make_base(solution: Solution, data: Dataset) -> Base:
    """Evaluate and project the base model on training and held-out rows."""
    model = solution.model
    solution = replace(
        solution,
        values=settled(model, data.sensing, [*data.train, *data.held_out], solution.values),
    )
    smoothing = model.named("smoothing")
    free = [n for n in solution.free if n not in solution.at_bound or n in smoothing]
    free += [n for n in names_of_runs(model, data.train) if n not in solution.at_bound]
    signs = _inward_signs(solution, data)
    names = [*free, *signs]
    balances = balances_of(model, data.sensing, wrt=bare(names))
    train = stack(balances, data.train, solution.values, names)
    r, j, block, balance = flatten(train, balances.balances)
    weight = np.concatenate([solution.weights[b] for b in balances.balances])
    towards = np.concatenate([np.ones(len(free)), list(signs.values())])
    jw = j * towards * weight[:, None]
    norms = np.linalg.norm(jw, axis=0)
    # sizes of columns in unlike units say nothing of each other
    alive = (norms > 0) & ~_unseen_sizes(solution, names, norms)
    back = alive & (np.arange(len(norms)) >= len(free))
    alive[len(free) :] = False
    inward = jw[:, back] / norms[back]
    jw = jw[:, alive] / norms[alive]
    orthonormal = span_of(jw)
    left = r * weight
    rw = left - orthonormal @ (orthonormal.T @ left)
    shares = np.array(
        [
            effective_share(rw[balance == k][train.taking[b]])
            for k, b in enumerate(balances.balances)
        ]
    )
    if data.held_out:
        held = stack(balances, data.held_out, solution.values, names)
        own = within_limits(model, data.held_out, solution.values)
        apart = flatten(
            stack(
                balances_of(model, data.sensing, wrt=bare(own)), data.held_out, solution.values, own
            ),
            balances.balances,
        )[1]
        hr, hj, _, hb = flatten(held, balances.balances)
        rows = row_weights(balances, data, solution.values, solution.sigma, data.held_out)
        held_weights = np.concatenate([rows[b] for b in balances.balances])
        hj = hj * towards * held_weights[:, None]
        hj, hi = hj[:, alive] / norms[alive], hj[:, back] / norms[back]
        hr = hr * held_weights
        ho = span_of(apart * held_weights[:, None])
    else:
        ho = np.empty((0, 0))
        hr, hj, hi = np.empty(0), np.empty((0, int(alive.sum()))), np.empty((0, int(back.sum())))
        hb, held_weights = np.empty(0, dtype=np.int64), np.empty(0)
    base = Base(
        solution,
        data,
        residual=rw,
        jacobian=jw,
        inward=inward,
        orthonormal=orthonormal,
        block=block,
        balance=balance,
        weight=weight,
        share=shares,
        held_residual=hr,
        held_jacobian=hj,
        held_inward=hi,
        held_own=ho,
        held_balance=hb,
        held_weight=held_weights,
        names=tuple(n for n, a in zip(free, alive, strict=False) if a),
        norms=norms[alive],
        inward_names=tuple(n for n, b in zip(names, back, strict=True) if b),
        inward_norms=(norms * towards)[back],
    )
    return replace(base, noise=_noise_of(base, left)) if solution.noise_off else base


def _noise_of(base: Base, left: FloatArray) -> Noise | None:
    """What noise adds to the products of a base all of whose rows the fit has left at `left`; None
    where of no direction it is a share that counts.
    """
    solution, data = base.solution, base.data
    names = [*base.names, *base.inward_names]
    balances = balances_of(solution.model, data.sensing, wrt=bare(names))
    drawn = each_drawn(data, lambda w, _: stack(balances, [w], solution.values, names))
    believed = noise_believed(solution.model, data, solution.values)
    bent = bending(solution.model)
    norms = np.concatenate([base.norms, base.inward_norms])
    scale = np.append(np.where([n in bent for n in names], 0.0, 1 / norms), 1.0)
    moved = {b: x * scale for b, x in base.moved(drawn, believed).items()}
    p, own = base.parts
    both, left = base.plain[:, :-1], left[base.order]
    whole = both.T @ both
    noise = np.asarray(sum(x[:, :-1].T @ x[:, :-1] for x in moved.values()))
    if not own or float(shares(whole, noise)[0].max()) < SURE_STEP:
        return None
    score = {b: x[:, :-1].T @ x[:, -1] for b, x in moved.items()}
    onto = certain(whole, noise)
    for x in moved.values():
        x[:, :own] = x[:, :own] @ onto
    kept = {b: x[:, :own].T @ x[:, :p] for b, x in moved.items()}
    pulled = both[:, :p].T @ left - sum(x[:p] for x in score.values())
    told = whole[:p, :p] - sum(x[:p] for x in kept.values())
    step = -inverse(told) @ pulled
    for b, x in moved.items():
        x[:, -1] += x[:, :p] @ step
        score[b] += kept[b] @ step
    return Noise(moved, score, believed, left + both[:, :p] @ step)


def _unseen_sizes(
    solution: Solution, names: Sequence[str], norms: FloatArray
) -> npt.NDArray[np.bool_]:
    """Shapes and smoothing velocities that these rows do not show: a change by all of their size
    moves them less than one deviation.

    A step along such a column is of any length, and other records may show it.
    """
    sizes = bending(solution.model)
    return np.array(
        [
            n in sizes and abs(solution.values[n]) * norm < UNSEEN
            for n, norm in zip(names, norms, strict=True)
        ],
        dtype=bool,
    )


def span_of(columns: FloatArray) -> FloatArray:
    """Orthonormal columns that span the same space."""
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(
        left[:, singular > DEPENDENT * max(float(singular[0]) if len(singular) else 0.0, 1e-300)],
        dtype=np.float64,
    )


def _inward_signs(solution: Solution, data: Dataset) -> dict[str, float]:
    """Amplitudes at a bound, with the sign of the step back from it; the hold of a logged
    command is none of them.
    """
    limits = bounds_of(solution.model, data.joint.known, data)
    shapes = {p.name for p in solution.model.parameters if p.is_shape}
    held = [
        n for n in solution.at_bound if n in solution.free and n not in shapes and n != HOLD_NAME
    ]
    return {
        n: 1.0 if solution.values[n] - limits[n][0] < limits[n][1] - solution.values[n] else -1.0
        for n in held
    }


def flatten(
    stacked: Stacked, balances: Sequence[str]
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """Residual, Jacobian, block (-1 for rows that take no part) and balance number of all rows,
    one balance after the other.
    """
    r = np.concatenate([stacked.residual[b] for b in balances])
    j = np.concatenate([stacked.jacobian[b] for b in balances])
    size = len(stacked.block)
    block = np.concatenate([np.where(stacked.taking[b], stacked.block, -1) for b in balances])
    return r, j, block, np.repeat(np.arange(len(balances)), size)


def columns(
    candidate: Candidate,
    base: Base,
    shapes: Mapping[str, float],
    records: Sequence[WeakRecord],
    balances: Balances,
) -> FloatArray:
    """Unweighted columns of the candidate's amplitudes at amplitude zero."""
    stacked = stack(balances, records, _without_it(candidate, base, shapes))
    return np.concatenate([stacked.jacobian[b] for b in balances.balances])


def _without_it(candidate: Candidate, base: Base, shapes: Mapping[str, float]) -> dict[str, float]:
    """Values of a candidate's model with its amplitudes zero."""
    values = {p.name: p.start for p in candidate.model.parameters}
    values.update(base.solution.values)
    values.update(dict.fromkeys(candidate.amplitudes, 0.0))
    values.update(shapes)
    return values


@final
@dataclass(frozen=True)
class Trial:
    """A candidate at its best shape, tried on blocks and on held-out records.

    Attributes
    ----------
    values : mapping
        Shapes and amplitude estimates.
    balance : str
        Balance where it helps most.
    gain : float
        Cross-validated log-likelihood gain [nats], in units of what noise alone leaves.
    cv_drop_percent, held_out_drop_percent : float
        Fall of the RMS in the affected balance.
    p_value : float
        Cluster-robust Wald test over blocks.
    block_score : (blocks,) array
        Cross-validated log-likelihood of each block against the base [nats].
    rms : (balances,) array
        Cross-validated RMS of each balance, in sigmas of the base.
    outside : float
        Largest share of a column outside the base.
    contribution : float
        RMS of what the effect adds to its balance [N.m].
    score : float
        Log-likelihood gain if only the kernel's overlap tied the rows together: order of the
        ranking [nats].
    unit : float
        What noise alone leaves of its balance, over what it leaves under the base; at most 1.
    alone : float
        What an RMS of 1 N.m of it leaves in its balance beside all that the base may follow it
        with, RMS in sigmas of the base [1/N.m].
    error : float
        Standard error of that contribution, over blocks [N.m].
    own_gain : float
        The part of `gain` that is of the affected balance [nats].
    """

    candidate: Candidate
    values: Mapping[str, float]
    balance: str
    gain: float
    cv_drop_percent: float
    held_out_drop_percent: float
    p_value: float
    block_score: FloatArray
    rms: FloatArray
    outside: float
    contribution: float
    score: float
    unit: float = 1.0
    alone: float = 0.0
    error: float = math.inf
    own_gain: float = 0.0

    def beyond_noise(self, drop_percent: float) -> float:
        """A fall of the RMS [%] in units of what noise alone leaves."""
        return 100.0 - (100.0 - drop_percent) / self.unit

    def __repr__(self) -> str:
        return (
            f"Trial({self.candidate.label!r}, {self.balance} balance, "
            f"-{self.cv_drop_percent:.3g} % on blocks, p = {self.p_value:.2g})"
        )

    @property
    def effect(self) -> Effect:
        """The effect tried."""
        return self.candidate.effect

    @property
    def key(self) -> str:
        """Key of the effect."""
        return self.candidate.effect.key


def try_candidate(candidate: Candidate, base: Base) -> Trial | NotTestable | None:
    """Best shape by projection, then block cross-validation and held-out drop.

    Returns
    -------
    Trial, NotTestable (columns inside the base), or None (no column at all, or an unphysical sign).
    """
    data = base.data
    balances = balances_of(
        candidate.model, data.sensing, wrt=candidate.amplitudes, columns_only=True
    )
    best: tuple[float, dict[str, float], FloatArray] | None = None
    inside = 0.0
    lows = np.array(
        [{p.name: p for p in candidate.model.parameters}[n].low for n in candidate.amplitudes]
    )
    q = base.orthonormal
    returning = base.inward.shape[1]
    least = np.concatenate([np.zeros(returning), lows])

    def projected(shapes: dict[str, float]) -> tuple[float, FloatArray, float] | None:
        raw = columns(candidate, base, shapes, data.train, balances)
        c = raw * base.weight[:, None]
        size = np.linalg.norm(c, axis=0)
        if not np.all(np.isfinite(c)) or size.max(initial=0.0) <= 0:
            return None
        c = np.column_stack([base.inward, c / np.where(size > 0, size, 1.0)])
        outside = c - q @ (q.T @ c)
        return (
            projected_gain(outside, base.residual, least),
            raw,
            float(np.linalg.norm(outside[:, returning:], axis=0).max()),
        )

    for shapes in shape_grid(candidate, data):
        found = projected(shapes)
        if found is None:
            continue
        inside = max(inside, found[2])
        if best is None or found[0] > best[0]:
            best = (found[0], shapes, found[1])
    if best is None:
        return None
    parameters = {p.name: p for p in candidate.model.parameters}
    periods = [n for n in candidate.shapes if parameters[n].role == "order"]
    for order in data.other_orders if periods else ():
        found = projected({**best[1], **dict.fromkeys(periods, order)})
        if found is not None and found[0] > best[0]:
            return NotTestable(candidate.effect.key, UNNAMED_LINE)
    if inside < COLLINEAR:
        return NotTestable(candidate.effect.key, _collinear_reason(candidate))
    if best[0] <= 0:
        return None
    limits = {
        n: (
            parameters[n].grid[0] * data.ranges[parameters[n].scale] / 2,
            parameters[n].grid[-1] * data.ranges[parameters[n].scale] * 1.25,
        )
        for n in candidate.shapes
        if not parameters[n].stays_on_grid
    }
    if limits and best[0] > REFINE_SHARE * float(base.residual @ base.residual):
        best = _refined(projected, best, limits)
    return _score(
        candidate, base, balances=balances, shapes=best[1], raw=best[2], lows=least, inside=inside
    )


def _refined(
    projected: Callable[[dict[str, float]], tuple[float, FloatArray, float] | None],
    best: tuple[float, dict[str, float], FloatArray],
    limits: Mapping[str, tuple[float, float]],
) -> tuple[float, dict[str, float], FloatArray]:
    """Shape between the grid points: pattern search on a log scale."""
    step = 0.5
    for _ in range(5):
        better = False
        for name, (low, high) in limits.items():
            for sign in (1.0, -1.0):
                value = best[1][name] * math.exp(sign * step)
                shapes = {**best[1], name: min(max(value, low), high)}
                found = projected(shapes)
                if found is not None and found[0] > best[0]:
                    best, better = (found[0], shapes, found[1]), True
                    break
        if not better:
            step /= 2.5
    return best


def _collinear_reason(candidate: Candidate) -> str:
    if candidate.effect.is_delay:
        return "what is late up to 3.5 samples is in the calibration already"
    alike = candidate.effect.confused_with
    titles = ", ".join(EFFECTS[n].title if n in EFFECTS else words(n) for n in alike)
    names = titles or "what the model has already"
    separate = (
        f"; {candidate.effect.separate_by} would separate them"
        if candidate.effect.separate_by
        else ""
    )
    return f"on these records it cannot be told from {names}{separate}"


def _score(
    candidate: Candidate,
    base: Base,
    balances: Balances,
    shapes: Mapping[str, float],
    raw: FloatArray,
    lows: FloatArray,
    inside: float,
) -> Trial | NotTestable | None:
    p, own = base.parts
    size = np.linalg.norm(raw * base.weight[:, None], axis=0)
    size = np.where(size > 0, size, 1.0)
    added = raw * base.weight[:, None] / size
    grams, noise = _bordered(base, added[base.order]), None
    if base.noise is not None:
        noise = noise_beside(candidate, base, base.noise, shapes, size)
        if _all_noise(grams.sum(axis=(0, 1)), noise.sum(axis=0), own):
            return NotTestable(candidate.effect.key, ALL_NOISE)
        grams = base.less_noise(grams, noise)
    total = grams.sum(axis=(0, 1))
    sse1 = np.zeros(base.crossed.shape)
    for test in base.held_out_folds():
        train = total - grams[test].sum(axis=(0, 1)) if base.folds > 1 else total
        more = signed_fit(train[:-1, :-1], -train[:-1, -1], lows, p, total[:-1, :-1])
        sse1[test] = _quadratic(grams[test], np.concatenate([more, [1.0]]))
    delta = signed_fit(total[:-1, :-1], -total[:-1, -1], lows, p)
    there, amplitude = np.append(delta, 1.0), delta[own:] / size
    if not np.any(amplitude):
        return None
    if noise is not None:  # its squares are known to so much: no less can be said to be left
        least = LEVEL_ERROR * np.einsum("bij,i,j->b", noise, there, there)
        sse1 += base.noise_share * np.maximum(least - sse1.sum(axis=0), 0.0)
    told = _told(base, sse1)
    values = {**shapes, **dict(zip(candidate.amplitudes, map(float, amplitude), strict=True))}
    unit = np.ones(len(base.balances))
    where = base.balances.index(told["balance"])
    if told["cv_drop_percent"] >= MINOR_DROP:
        # where it does not help, it need not be paid for
        unit[where] = _unit(candidate, base, values, delta)[where]
    held = _held_out_drop(
        candidate,
        base,
        balances=balances,
        shapes=shapes,
        delta=delta,
        size=size,
        where=where,
        noise=0.0 if noise is None else float(there @ noise[where] @ there),
    )
    contribution = float(np.sqrt(np.mean((raw[base.balance == where] @ amplitude) ** 2)))
    gains = _gains(base, sse1 / unit**2)
    beside = _beside_base(added, base, delta, total, noise)
    alone, error = _visible(beside, delta[own:], base.balance == where, contribution)
    return Trial(
        candidate,
        values,
        held_out_drop_percent=held,
        p_value=_wald(beside, delta[own:]),
        outside=inside,
        contribution=contribution,
        unit=float(unit[where]),
        alone=alone,
        error=error,
        own_gain=float(gains[where]),
        **{**told, "gain": float(gains.sum())},
    )


def noise_beside(
    candidate: Candidate,
    base: Base,
    noise: Noise,
    shapes: Mapping[str, float],
    size: FloatArray,
) -> FloatArray:
    """What noise adds to the products of each balance with the columns of a candidate between those
    of the base and the residual, (balances, columns, columns).
    """
    names = candidate.amplitudes
    balances = balances_of(candidate.model, base.data.sensing, wrt=names, columns_only=True)
    values = _without_it(candidate, base, shapes)
    drawn = each_drawn(base.data, lambda w, _: stack(balances, [w], values))
    moved = base.moved(drawn, noise.believed)
    return noise.products({b: x[:, :-1] / size for b, x in moved.items()})


def _all_noise(total: FloatArray, noise: FloatArray, own: int) -> bool:
    """Whether of the columns of a candidate noise makes more of what is outside the base than is
    certain of what is left (:data:`MOST_NOISE`).
    """
    inside, whole = slice(0, own), slice(own, -1)

    def outside(gram: FloatArray) -> FloatArray:
        across = gram[inside, whole]
        known = inverse(gram[inside, inside])
        return np.asarray(gram[whole, whole] - across.T @ known @ across)

    plain, less = outside(total), outside(total - noise)
    return bool(np.all(shares(plain, plain - less)[0] > MOST_NOISE))


def _unit(
    candidate: Candidate, base: Base, values: Mapping[str, float], delta: FloatArray
) -> FloatArray:
    """Length that noise alone leaves of each balance under a candidate where it is 1 under the
    base, (balances,), and never more: a gain of a torque that follows from the motion, or a mode
    that stands for the inertia, only takes the noise of a sensor away.

    The noise of a torque is the least known of all, as it often has a memory: what a candidate
    leaves of the torques counts by itself, too.
    """
    model = candidate.model
    own = {p.name: p.start for p in model.parameters} | dict(base.solution.values)
    moves = delta[: len(base.names)] / base.norms  # further columns are no parameters
    # parameters of a foreign FMU are columns of the base and none of the joint's
    moved = zip(base.names, moves, strict=True)
    own |= {n: own[n] + float(d) for n, d in moved if n in own} | dict(values)
    pairs = [(_torques_alone(model, base.data, own), base.torques_alone)]
    if base.noise is None:  # else it is off the squares
        pairs.append((_noise_alone(model, base.data, own), base.noise_alone))
    unit = [
        min([1.0, *(after[b] / before[b] for after, before in pairs if before[b] > 0)])
        for b in base.balances
    ]
    # a candidate that takes a torque out of its balance wholly has no noise of it to be counted in
    return np.maximum(unit, LEAST_UNIT)


def _torques_alone(
    model: JointModel, data: Dataset, values: Mapping[str, float]
) -> dict[str, float]:
    """RMS that a standard deviation of the torques leaves in each balance of the training rows."""
    found = passed_on(model, data, values)
    return {b: rms(x[: len(taking_part(b, data.train))]) for b, x in found.items()}


def _noise_alone(model: JointModel, data: Dataset, values: Mapping[str, float]) -> dict[str, float]:
    """RMS that drawn noise leaves in each balance of the training rows."""
    found = [drawn_floors(model, data, values, w) for w in data.train]
    rows = np.array([w.rows for w in data.train])
    return {
        b: math.sqrt(float(np.average([f[b] ** 2 for f in found], weights=rows)))
        for b in data.sensing.balances
    }


def _gains(base: Base, sse1: FloatArray) -> FloatArray:
    """Log-likelihood that each balance gains, (balances,) [nats]."""
    before, after = (np.maximum(x.sum(axis=0), 1e-300) for x in (base.crossed, sse1))
    effective = np.maximum(base.numbers.sum(axis=0), 1) * base.share
    return np.asarray(effective / 2 * np.log(before / after))


def _told(base: Base, sse1: FloatArray) -> dict[str, Any]:
    """What a trial says by the sum of squares that it leaves of each block and balance."""
    sse0, numbers = base.crossed, base.numbers
    per_balance0, per_balance1 = sse0.sum(axis=0), sse1.sum(axis=0)
    rows_in = np.maximum(numbers.sum(axis=0), 1)
    where = int(
        np.argmax(
            rows_in * np.log(np.maximum(per_balance0, 1e-300) / np.maximum(per_balance1, 1e-300))
        )
    )
    variance = np.maximum(per_balance1 / rows_in, 1e-300)
    drop = 100 * (1 - math.sqrt(per_balance1[where] / max(per_balance0[where], 1e-300)))
    return {
        "balance": base.balances[where],
        "gain": float(_gains(base, sse1).sum()),
        "cv_drop_percent": drop,
        "block_score": ((sse0 - sse1) / (2 * variance) * base.share).sum(axis=1),
        "rms": np.sqrt(per_balance1 / rows_in),
        "score": float(
            np.sum(
                KERNEL_SHARE
                * rows_in
                / 2
                * np.log(np.maximum(per_balance0, 1e-300) / np.maximum(per_balance1, 1e-300))
            )
        ),
    }


def by_whole_fit(
    trial: Trial,
    base: Base,
    values: Mapping[str, float],
    *,
    left: FloatArray,
    held_left: FloatArray,
) -> Trial:
    """A trial as its whole fit has it, in place of the linear one.

    Parameters
    ----------
    trial : Trial
    base : Base
        What it was tried on.
    values : mapping
        Of the whole fit.
    left, held_left : (rows,) array
        What the whole fit leaves of the rows of the base, unweighted.
    """
    rows, used = left * base.weight, base.block >= 0
    sse = np.zeros(base.crossed.shape)
    np.add.at(sse, (base.block[used], base.balance[used]), rows[used] ** 2)
    told = _told(base, sse)
    held = math.nan
    if len(held_left):
        here = base.held_balance == base.balances.index(told["balance"])
        before, after = (
            (x - base.held_own @ (base.held_own.T @ x))[here]
            for x in (base.held_residual, held_left * base.held_weight)
        )
        held = 100 * (1 - math.sqrt(float(after @ after) / max(float(before @ before), 1e-300)))
    own = {n: float(values[n]) for n in trial.values}
    return replace(trial, values=own, held_out_drop_percent=held, **told)


def _bordered(base: Base, added: FloatArray) -> FloatArray:
    """Products within each block and balance with a candidate's columns between those of the
    base and the residual.
    """
    own, more = base.parts[1], added.shape[1]
    plain = base.products
    across = base.grouped(added, np.column_stack([base.tried, added]))
    out = np.empty((*plain.shape[:2], own + more + 1, own + more + 1))
    kept = [*range(own), own + more]
    out[:, :, np.array(kept)[:, None], kept] = plain
    out[:, :, own:-1, kept] = across[:, :, :, : own + 1]
    out[:, :, kept, own:-1] = across[:, :, :, : own + 1].transpose(0, 1, 3, 2)
    out[:, :, own:-1, own:-1] = across[:, :, :, own + 1 :]
    return out


def _quadratic(grams: FloatArray, vector: FloatArray) -> FloatArray:
    return np.asarray(np.maximum(np.einsum("kbij,i,j->kb", grams, vector, vector), 0.0))


def _held_out_drop(
    candidate: Candidate,
    base: Base,
    balances: Balances,
    shapes: Mapping[str, float],
    delta: FloatArray,
    size: FloatArray,
    where: int,
    noise: float,
) -> float:
    """Fall of the RMS of a balance on records that the fit never saw, in percent; `noise`: what it
    adds through the columns to the squares of the training rows.
    """
    if not len(base.held_residual):
        return math.nan
    p, own = base.parts
    raw = (
        columns(candidate, base, shapes, base.data.held_out, balances)
        * base.held_weight[:, None]
        / size
    )
    here = base.held_balance == where
    before = base.held_residual
    after = (
        before
        + base.held_jacobian @ delta[:p]
        + base.held_inward @ delta[p:own]
        + raw @ delta[own:]
    )
    before, after = (x - base.held_own @ (base.held_own.T @ x) for x in (before, after))
    before, after = before[here], after[here]
    theirs, ours = base.held_weight[here], base.weight[base.balance == where]
    noise *= float(theirs @ theirs) / max(float(ours @ ours), 1e-300)
    left = max(float(after @ after) - noise, 0.0)
    return 100 * (1 - math.sqrt(left / max(float(before @ before), 1e-300)))


@final
@dataclass(frozen=True)
class _Outside:
    """Columns of amplitudes that are not zero, less what the base may follow them with.

    Attributes
    ----------
    columns : (n, active) array
    gram : (active, active) array
        What the rows tell of them.
    scores : (blocks, active) array
        Their products with the residual within each block.
    """

    columns: FloatArray
    gram: FloatArray
    scores: FloatArray


def enough_blocks(blocks: int, amplitudes: int) -> bool:
    """Whether the scatter over blocks tells amplitudes from chance: it has a degree of freedom."""
    return blocks > amplitudes + 1


def _beside_base(
    added: FloatArray,
    base: Base,
    delta: FloatArray,
    total: FloatArray,
    noise: FloatArray | None,
) -> _Outside | None:
    """The amplitudes that are not zero; None where the blocks are too few for them.

    `total`: products of all columns and the residual, without what noise adds to each balance.
    """
    p, own = base.parts
    active = np.flatnonzero(delta[own:])
    blocks = int(np.count_nonzero(base.numbers.sum(axis=1)))
    if not len(active) or not enough_blocks(blocks, len(active)):
        return None
    followers = np.concatenate([np.arange(p), p + np.flatnonzero(delta[p:own] > 0)])
    across = total[np.ix_(followers, own + active)]
    within = inverse(total[np.ix_(followers, followers)])
    mix = np.zeros((len(delta), len(active)))
    mix[followers] = -within @ across
    mix[own + active, np.arange(len(active))] = 1.0
    rows = np.column_stack([base.tried[:, :own], added[base.order]])
    c, residual = rows @ mix, base.tried[:, -1] + rows @ delta
    begins = np.flatnonzero(np.diff(base.block[base.order], prepend=-1))
    scores = np.add.reduceat(c * residual[:, None], begins, axis=0)
    if noise is not None:
        pulled = mix.T @ noise[:, :-1] @ np.append(delta, 1.0)  # by balance
        share = base.noise_share[base.numbers.sum(axis=1) > 0]
        scores = scores - share @ pulled
    columns_ = np.zeros((len(base.block), len(active)))
    columns_[base.order] = c
    return _Outside(columns_, mix.T @ total[:-1, :-1] @ mix, scores)


def _wald(beside: _Outside | None, amplitudes: FloatArray) -> float:
    """p-value of the amplitudes, scores clustered by block."""
    if beside is None:
        return 1.0
    return wald(beside.gram, beside.scores, amplitudes[amplitudes != 0])


def _visible(
    beside: _Outside | None,
    amplitudes: FloatArray,
    here: npt.NDArray[np.bool_],
    contribution: float,
) -> tuple[float, float]:
    """`alone` and `error` of a trial: of all its amplitudes together, in their proportions.

    `here`: rows of its balance.
    """
    if beside is None or not contribution > 0:
        return 0.0, math.inf
    size = amplitudes[amplitudes != 0] / contribution  # for 1 N.m
    column, score, blocks = beside.columns @ size, beside.scores @ size, len(beside.scores)
    gram = float(size @ beside.gram @ size)
    if not gram > 0:
        return 0.0, math.inf
    error = math.sqrt(float(score @ score) * blocks / (blocks - 1)) / gram
    return float(np.sqrt(np.mean(column[here] ** 2))), error
