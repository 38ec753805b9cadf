"""Names that tie: each fitted on the records, and how far a run would set them apart."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS
from identification.balance.balances import balances_of
from identification.balance.calibration import names_of_runs
from identification.balance.dataset import Dataset
from identification.balance.stacked import INDEPENDENT_SHARE, row_weights, stack
from identification.balance.weak import REST_SHARE, RESTING_SIDES, WeakRecord
from identification.diagnosis.candidates import offered
from identification.diagnosis.trials import Trial, make_base, try_candidate
from identification.fitting.covariance import RANK
from identification.fitting.engine import Solution, solve
from identification.fitting.information import eliminated, form_of

FloatArray = npt.NDArray[np.float64]

ROUNDS: Final = 3
"""Gauss-Newton steps in which a rival adapts to a run of another: shapes are no straight lines."""
FEWEST: Final = 3.0
"""Log-likelihood from which a name counts as better, as in every comparison of claims [nats]."""
DECIDED: Final = 2.0
"""Normal deviate over blocks of a difference of log-likelihoods from which a name is behind."""
TURN_WIDTHS: Final = 3.0
"""Smoothing velocities up to which friction has not yet reached its level (to 1 %)."""
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


def rivals_of(names: Sequence[str], balance: str, start: Solution, data: Dataset) -> list[Rival]:
    """Every name of a set, fitted from the best point of its grid.

    Parameters
    ----------
    names : sequence of str
        Effect keys.
    balance : str
        Where the set was claimed: of several places of a name, one that helps there.
    start : Solution
        The fit of the model without any of them.
    data : Dataset
    """
    base = make_base(start, data)
    candidates = offered(start.model, data, late=True)[0]
    best: dict[str, Trial] = {}
    for candidate in candidates:
        if candidate.effect.key not in names:
            continue
        trial = try_candidate(candidate, base)
        if not isinstance(trial, Trial):
            continue
        old = best.get(trial.key)
        here = trial.balance == balance
        if old is None or (here, trial.score) > (old.balance == balance, old.score):
            best[trial.key] = trial
    return [
        Rival(
            key,
            best[key].candidate.label,
            solve(best[key].candidate.model, data, start={**start.values, **best[key].values}),
        )
        for key in names
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
        # each row by the largest scatter that one of them allows it, to find who fits best
        common = {
            b: np.minimum.reduce([r.solution.weights[b] for r in self.rivals])
            for b in self.rivals[0].solution.weights
        }
        costs = [self._cost(r, common) for r in self.rivals]
        self.leader = self.rivals[int(np.argmin(costs))]
        self._old = [self._rows(r, data, self.leader.solution.weights) for r in self.rivals]

    def _cost(self, rival: Rival, weights: Mapping[str, FloatArray]) -> float:
        """Log-likelihood of the balances but for its sign, each with a scatter of its own."""
        model = rival.solution.model
        balances = balances_of(model, self.data.sensing, wrt=())
        left = stack(balances, self.data.train, rival.solution.values).residual
        return sum(
            len(r) * math.log(max(float(np.linalg.norm(r * weights[b])), 1e-300))
            for b, r in left.items()
        )

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
        """By how much the leader is ahead of each rival on the old records, and how sure that is
        over blocks, as a normal deviate: by their mean or by their signs.  (rivals, 2)
        """
        first = self.rivals.index(self.leader)
        squares = [_by_block(r, block) for r, _, block in self._old]
        out = np.zeros((len(self.rivals), 2))
        for k, own in enumerate(squares):
            difference = 0.5 * INDEPENDENT_SHARE * (own - squares[first])
            count = len(difference)
            spread = float(np.std(difference, ddof=1)) * math.sqrt(count) if count > 1 else 0.0
            mean = float(difference.sum()) / spread if spread > 0 else 0.0
            # one block may hold most of a difference that all of them show
            signs = float(np.sign(difference).sum()) / math.sqrt(count)
            out[k] = difference.sum(), max(mean, signs)
        return out

    @property
    def alive(self) -> tuple[Rival, ...]:
        """Rivals that the whole fits on the old records leave."""
        return tuple(
            rival
            for rival, (nats, deviate) in zip(self.rivals, self.ahead, strict=True)
            if not (nats > enough() and deviate > DECIDED)
        )

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
        after a run, (rivals, rivals), infinite on the diagonal [nats].

        One clean motion, of the model that all have in common, serves all: only the differences of
        the laws on it count. Name j may adapt as far as the old records let it.
        """
        new = replace(self.data, train=(rows,), held_out=())
        leader = self.leader.solution
        values = {**leader.values, **dict.fromkeys(names_of_runs(leader.model, [rows]), 0.0)}
        balances = balances_of(leader.model, new.sensing, wrt=())
        whole = row_weights(balances, new, values, leader.sigma, [rows])
        calm = {b: w * ~_turning(leader, rows, b) for b, w in whole.items()}
        out = np.full((len(self.rivals), len(self.rivals)), math.inf)
        for weights, at_turns in ((whole, True), (calm, False)):
            pairs = [
                (i, j)
                for i, one in enumerate(self.rivals)
                for j, other in enumerate(self.rivals)
                if i != j and (_about_turns(one) or _about_turns(other)) == at_turns
            ]
            here = {k: self._rest(self.rivals[k], new, weights) for p in pairs for k in p}
            for i, j in pairs:
                known = self.information[j]
                out[i, j] = self._least(self.rivals[j], known, here[i], new, weights)
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


def _about_turns(rival: Rival) -> bool:
    """Whether a law says what happens while the motion turns round."""
    effect = EFFECTS[rival.name]
    return effect.memory is not None or effect.shapes_reversal


def _turning(solution: Solution, rows: WeakRecord, balance: str) -> npt.NDArray[np.bool_]:
    """Rows that touch a turn of a side whose friction acts in the balance: there dry friction is an
    inequality, and the width of its change a stand-in.
    """
    out = np.zeros(rows.rows, dtype=np.bool_)
    for side in RESTING_SIDES.get(balance, ()):
        velocity = rows.points[f"{side}_velocity"]
        widths = [solution.values[n] for n in solution.model.named("smoothing", side)]
        slow = np.abs(velocity) < TURN_WIDTHS * max(widths, default=0.0)
        turns = np.diff(np.sign(velocity), append=velocity[-1]) != 0
        out |= rows.average((slow | turns).astype(np.float64)) > REST_SHARE
    return out


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
