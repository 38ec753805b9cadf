"""Names that tie: each fitted on the records, and how far a run would set them apart."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import balances_of
from identification.balance.calibration import names_of_runs
from identification.balance.dataset import Dataset, without
from identification.balance.stacked import INDEPENDENT_SHARE, row_weights
from identification.balance.weak import WeakRecord
from identification.diagnosis.candidates import offered
from identification.diagnosis.claims import Claim
from identification.diagnosis.trials import Trial, make_base, try_candidate
from identification.fitting.covariance import RANK
from identification.fitting.engine import Solution, solve
from identification.fitting.information import eliminated, form_of

FloatArray = npt.NDArray[np.float64]

ROUNDS: Final = 3
"""Gauss-Newton steps in which a rival adapts to a run of another: shapes are no straight lines."""
FEWEST: Final = 3.0
"""Log-likelihood from which a name counts as better, as in every comparison of claims [nats]."""
SURE: Final = 1.6449
"""Normal quantile of 95 %: a run is long enough where so many of them come out above `FEWEST`."""


@final
@dataclass(frozen=True)
class Rival:
    """One name of a set, fitted.

    Attributes
    ----------
    name, label : str
        Effect key; label in the model.
    solution : Solution
        The whole fit of the model that has this name in the place of the set.
    """

    name: str
    label: str
    solution: Solution


def rivals_of(claim: Claim, last: Solution, data: Dataset) -> tuple[Solution, list[Rival]]:
    """The model without a claim, and with every name of its set in the claim's place, each fitted
    from the best point of its grid.
    """
    start = solve(without(last.model, claim.label), data, start=last.values)
    base = make_base(start, data)
    found = offered(start.model, data)[0] + offered(start.model, data, late=True)[0]
    best: dict[str, Trial] = {}
    for candidate in found:
        if candidate.effect.key not in claim.effects:
            continue
        trial = try_candidate(candidate, base)
        if not isinstance(trial, Trial):
            continue
        old = best.get(trial.key)
        here = trial.balance == claim.balance
        if old is None or (here, trial.score) > (old.balance == claim.balance, old.score):
            best[trial.key] = trial
    return start, [
        Rival(
            key,
            best[key].candidate.label,
            solve(best[key].candidate.model, data, start={**start.values, **best[key].values}),
        )
        for key in claim.effects
        if key in best
    ]


@final
class Contest:
    """Rivals on one weighting of the rows, and what the old records say about each.

    Parameters
    ----------
    rivals : sequence of Rival
        At least one.
    data : Dataset
    """

    def __init__(self, rivals: Sequence[Rival], data: Dataset) -> None:
        self.rivals, self.data = tuple(rivals), data
        leader = min(self.rivals, key=lambda r: self._cost(r.solution))
        self.leader = leader
        self._old = [self._rows(r, data, leader.solution.weights) for r in self.rivals]

    def _cost(self, solution: Solution) -> float:
        rows = {b: len(w) for b, w in solution.weights.items()}
        return sum(n * math.log(max(solution.sigma[b], 1e-300)) for b, n in rows.items())

    def _rows(
        self, rival: Rival, data: Dataset, weights: Mapping[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64]]:
        """Weighted residual, Jacobian over free parameters and unknowns of the runs, block of each
        row."""
        form = form_of(rival.solution, data, self.free(rival), weights)
        x = np.array([form.values[n] for n in form.free])
        stacked = form.stacked(x)
        names = form.balances.balances
        r = np.concatenate([stacked.residual[b] * weights[b] for b in names])
        j = np.concatenate([stacked.jacobian[b] * weights[b][:, None] for b in names])
        block = np.concatenate([np.where(stacked.taking[b], stacked.block, -1) for b in names])
        return r, j, block

    def free(self, rival: Rival) -> tuple[str, ...]:
        """Parameters of a rival that may adapt: none that a bound holds."""
        held = set(rival.solution.at_bound)
        return tuple(n for n in rival.solution.free if n not in held)

    @cached_property
    def likelihood(self) -> FloatArray:
        """Log-likelihood of each rival on the old records, (rivals,) [nats]."""
        return np.array([-0.5 * INDEPENDENT_SHARE * float(r @ r) for r, _, _ in self._old])

    @cached_property
    def ahead(self) -> FloatArray:
        """By how much the leader is ahead of each rival on the old records, and its t over
        blocks: (rivals, 2).
        """
        first = self.rivals.index(self.leader)
        squares = [_by_block(r, block) for r, _, block in self._old]
        out = np.zeros((len(self.rivals), 2))
        for k, own in enumerate(squares):
            difference = 0.5 * INDEPENDENT_SHARE * (own - squares[first])
            spread = float(np.std(difference, ddof=1)) * math.sqrt(len(difference))
            out[k] = difference.sum(), float(difference.sum()) / spread if spread > 0 else 0.0
        return out

    @cached_property
    def information(self) -> list[FloatArray]:
        """What the old records say about the free parameters of each rival, unknowns of the runs
        eliminated: (free, free) each.
        """
        return [
            eliminated(j.T @ j, len(self.free(rival)))
            for rival, (_, j, _) in zip(self.rivals, self._old, strict=True)
        ]

    def distances(self, rows: WeakRecord) -> FloatArray:
        """Expected log-likelihood by which name i, where it is true, comes out ahead of name j
        after a run, (rivals, rivals) [nats].

        One clean motion, of the model that all have in common, serves all: only the differences of
        the laws on it count. Name j may adapt as far as the old records let it.
        """
        new = replace(self.data, train=(rows,), held_out=())
        leader = self.leader.solution
        values = {**leader.values, **dict.fromkeys(names_of_runs(leader.model, [rows]), 0.0)}
        balances = balances_of(leader.model, new.sensing, wrt=())
        weights = {
            b: w * rows.taking(b)
            for b, w in row_weights(balances, new, values, leader.sigma, [rows]).items()
        }
        here = [self._rest(rival, new, weights) for rival in self.rivals]
        out = np.zeros((len(self.rivals), len(self.rivals)))
        for j, rival in enumerate(self.rivals):
            for i in range(len(self.rivals)):
                if i != j:
                    out[i, j] = self._least(rival, self.information[j], here[i], new, weights)
        return out

    def _rest(self, rival: Rival, new: Dataset, weights: Mapping[str, FloatArray]) -> FloatArray:
        """What a rival leaves on a clean motion at its own values, without any zero of an
        encoder."""
        model = rival.solution.model
        zero = dict.fromkeys(names_of_runs(model, new.train), 0.0)
        form = form_of(rival.solution, new, self.free(rival), weights, zero)
        return form.residual(np.array([form.values[n] for n in form.free]))

    def _least(
        self,
        rival: Rival,
        information: FloatArray,
        true: FloatArray,
        new: Dataset,
        weights: Mapping[str, FloatArray],
    ) -> float:
        """What is left of the difference where the rival adapts: Gauss-Newton from its values."""
        model = rival.solution.model
        runs = names_of_runs(model, new.train)
        form = form_of(rival.solution, new, self.free(rival), weights, dict.fromkeys(runs, 0.0))
        count = len(form.free) - len(runs)
        start = np.array([form.values[n] for n in form.free])
        held = np.zeros((len(start), len(start)))
        held[:count, :count] = information
        limits = {p.name: (p.low, p.high) for p in model.parameters}
        bounds = np.array([limits.get(n, (-math.inf, math.inf)) for n in form.free])

        def cost(x: FloatArray, left: FloatArray) -> float:
            d = x - start
            return 0.5 * INDEPENDENT_SHARE * float(left @ left + d @ held @ d)

        x, left = start, form.residual(start) - true
        best = cost(x, left)
        for _ in range(ROUNDS):
            j = form.jacobian(x)
            total = j.T @ j + held
            size = np.sqrt(np.maximum(np.diag(total), 1e-300))
            push = j.T @ left + held @ (x - start)
            step = (
                np.linalg.pinv(total / np.outer(size, size), rcond=RANK, hermitian=True)
                @ (push / size)
                / size
            )
            moved = np.clip(x - step, bounds[:, 0], bounds[:, 1])
            after = form.residual(moved) - true
            reached = cost(moved, after)
            if not reached < best * (1 - 1e-3):
                best = min(best, reached) if math.isfinite(reached) else best
                break
            x, left, best = moved, after, reached
        return best


def _by_block(residual: FloatArray, block: npt.NDArray[np.int64]) -> FloatArray:
    used = block >= 0
    return np.bincount(block[used], weights=residual[used] ** 2).astype(np.float64)


def power(nats: float) -> float:
    """Chance that a run comes out above `FEWEST` where so many nats are expected: the difference
    of two log-likelihoods scatters by the root of twice its mean.
    """
    if nats <= 0:
        return 0.0
    z = (nats - FEWEST) / math.sqrt(2 * nats)
    return 0.5 * (1 + math.erf(z / math.sqrt(2)))


def enough() -> float:
    """Nats at which `power` is 95 %."""
    root = SURE * math.sqrt(2.0)
    return ((root + math.sqrt(root**2 + 4 * FEWEST)) / 2) ** 2
