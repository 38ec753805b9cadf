"""How far a run that is not recorded yet would set names apart."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import balances_of
from identification.balance.calibration import names_of_runs
from identification.balance.dataset import Dataset
from identification.balance.stacked import row_weights
from identification.balance.weak import INDEPENDENT_SHARE, WeakRecord
from identification.fitting.covariance import RANK
from identification.fitting.information import form_of
from identification.naming.contest import FEWEST, Contest, Rival, about_turns, turning
from identification.planning.runs import sigma_on

FloatArray = npt.NDArray[np.float64]

ROUNDS: Final = 3
"""Gauss-Newton steps in which a rival adapts to a run of another: shapes are no straight lines."""
SETTLED: Final = 1e-3
"""Relative fall of the misfit from which another step is taken: a thousandth changes no plan."""
SURE: Final = 1.6449
"""Normal quantile of 95 %: a run is long enough where so many of them come out above `FEWEST`."""


@final
class Foreseen:
    """Runs that are not recorded yet, for names that were fitted on the old records.

    Parameters
    ----------
    contest : Contest
    """

    def __init__(self, contest: Contest) -> None:
        self._contest = contest

    def distances(self, rows: WeakRecord) -> FloatArray:
        """Expected log-likelihood by which name i, where it is true, comes out ahead of name j
        after a run, (rivals, rivals), infinite on the diagonal [nats].

        One clean motion, of the model that all have in common, serves all: only the differences of
        the laws on it count. Name j may adapt as far as the old records let it.
        """
        new = replace(self._contest.data, train=(rows,), held_out=())
        leader = self._contest.leader.solution
        values = {**leader.values, **dict.fromkeys(names_of_runs(leader.model, [rows]), 0.0)}
        balances = balances_of(leader.model, new.sensing, wrt=())
        sigma = sigma_on(rows, leader, self._contest.data, values)
        whole = row_weights(balances, new, values, sigma, [rows])
        calm = {b: w * ~turning(leader, [rows], b) for b, w in whole.items()}
        out = np.full((len(self._contest.rivals), len(self._contest.rivals)), math.inf)
        for weights, at_turns in ((whole, True), (calm, False)):
            pairs = [
                (i, j)
                for i, one in enumerate(self._contest.rivals)
                for j, other in enumerate(self._contest.rivals)
                if i != j and (about_turns(one) or about_turns(other)) == at_turns
            ]
            here = {k: self._rest(self._contest.rivals[k], new, weights) for p in pairs for k in p}
            for i, j in pairs:
                known = self._contest.information[j]
                out[i, j] = self._least(self._contest.rivals[j], known, here[i], new, weights)
        return out

    def _rest(self, rival: Rival, new: Dataset, weights: Mapping[str, FloatArray]) -> FloatArray:
        """What a rival leaves on a clean motion at its own values, without any zero of an
        encoder."""
        model = rival.solution.model
        zero = dict.fromkeys(names_of_runs(model, new.train), 0.0)
        form = form_of(rival.solution, new, self._contest.free(rival), weights, zero)
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
        form = form_of(
            rival.solution, new, self._contest.free(rival), weights, dict.fromkeys(runs, 0.0)
        )
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
            if not reached < best * (1 - SETTLED):
                best = min(best, reached) if math.isfinite(reached) else best
                break
            x, left, best = moved, after, reached
        return best


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
