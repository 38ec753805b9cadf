"""Names that tie: each fitted whole on the records, and what the records say about each."""

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
from identification.balance.calibration import usual
from identification.balance.colour import LEVEL_ERROR
from identification.balance.dataset import Dataset
from identification.balance.stacked import (
    LEAST_DEVIATION,
    TURN_WIDTHS,
    apart_from_drift,
    beginnings,
    drawn_floors,
    drift_memory,
    innovations,
    noise_believed,
    noise_rows,
    rms,
    stack,
    support_of,
    taking_part,
    unsure,
)
from identification.balance.weak import INDEPENDENT_SHARE, REST_SHARE, RESTING_SIDES, WeakRecord
from identification.diagnosis.candidates import offered, shape_grid
from identification.diagnosis.trials import Trial, make_base, try_candidate
from identification.fitting.engine import Solution, reweighed, solved_once, stepped
from identification.fitting.information import eliminated, form_of

FloatArray = npt.NDArray[np.float64]

FEWEST: Final = 3.0
"""Log-likelihood from which a name counts as better: odds of twenty to one [nats]."""
VALLEY_STEPS: Final = 5
"""Gauss-Newton steps from each point of a grid, to see which valley is the deepest."""
CONTRADICTED: Final = 0.9
"""Share of what the surest rival leaves of its level of noise under which what another one leaves
contradicts its own: rows and noise are the same for all, so that levels that read too high do so
alike, but for the tenth to which they hold."""
DECIDED: Final = 2.0
"""Normal deviate over blocks of a difference of log-likelihoods from which a name is behind."""


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
            solved_once(best[key].candidate.model, data, {**start.values, **best[key].values}),
        )
        for key in names
        if key in best
    ]


def from_every_valley(rivals: Sequence[Rival], start: Solution, data: Dataset) -> list[Rival]:
    """Rivals of which those behind the best were fitted again from every point of the grid of their
    shapes.

    A name must not fall out because its fit ended in another valley: a law with one knot more than
    the best one can do all that this does.

    Parameters
    ----------
    rivals : sequence of Rival
    start : Solution
        The fit of the model without any of them.
    data : Dataset
    """
    contest = Contest(rivals, data)
    known = {c.label: c for c in offered(start.model, data, late=True)[0]}
    out = []
    for rival, (nats, _) in zip(contest.rivals, contest.ahead, strict=True):
        candidate = known.get(rival.label)
        if nats <= FEWEST or candidate is None or not candidate.shapes:
            out.append(rival)
            continue
        like = contest.leader.solution
        tried = []
        for shapes in shape_grid(candidate, data):
            begun = {**start.values, **_common(like, start), **shapes}
            found, cost = stepped(candidate.model, data, begun, like, iterations=VALLEY_STEPS)
            if math.isfinite(cost):
                tried.append((cost, found))
        if tried:
            best = min(tried, key=lambda t: t[0])[1]
            whole = solved_once(candidate.model, data, best.values)
            again = [replace(rival, solution=x) for x in (reweighed(best, data), whole)]
            rival = Contest([rival, *again], data).leader
        out.append(rival)
    return out


def _common(like: Solution, start: Solution) -> dict[str, float]:
    """What a fit says of the parameters of a smaller model."""
    return {n: v for n, v in like.values.items() if n in start.values}


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
        names = self.data.sensing.balances
        entitled = _entitled(self.rivals, data)
        self._taking = {b: taking_part(b, data.train) for b in names}
        self._drift = _drift(self.rivals, data)
        left = [
            {b: self._apart(b, r, entitled[k][b]) for b, r in _left(rival, data).items()}
            for k, rival in enumerate(self.rivals)
        ]
        unlikely = [_unlikely(rival, data) for rival in self.rivals]
        known = [x / INDEPENDENT_SHARE for x in unlikely]
        costs = [_cost(r, self._taking) + x for r, x in zip(left, known, strict=True)]
        best = int(np.argmin(costs))
        for k, rival in enumerate(self.rivals):  # none may be ahead where the two are compared
            counted = dict(zip(names, self._calm(self.rivals[best], rival), strict=True))
            if _cost(left[k], counted) + known[k] < _cost(left[best], counted) + known[best]:
                best = k
        self.leader = self.rivals[best]
        self._unlikely = np.array(unlikely)
        own = entitled[best]
        self._old = [
            self._rows(
                rival,
                data,
                {b: w * weight[b] / own[b] for b, w in self.leader.solution.weights.items()},
            )
            for rival, weight in zip(self.rivals, entitled, strict=True)
        ]

    def _calm(self, best: Rival, other: Rival) -> list[npt.NDArray[np.bool_]]:
        """Rows by which two rivals are compared, one array per balance: those that take part, and
        at a turn only where one of the two laws says what happens there.
        """
        if about_turns(best) or about_turns(other):
            return list(self._taking.values())
        return [
            taking & ~turning(best.solution, self.data.train, b)
            for b, taking in self._taking.items()
        ]

    def _apart(self, balance: str, rows: FloatArray, weight: FloatArray) -> FloatArray:
        """Rows of a balance, (rows,) or (rows, p), of a rival over their scatter: where a measured
        torque drifts, each beside what those before it say of that. A slow law takes a part of one
        course of a drift, and that would count as often as it has rows.
        """
        drift = self._drift.get(balance)
        if drift is None:
            return rows * (weight if rows.ndim == 1 else weight[:, None])
        scatter = np.divide(1.0, weight, out=np.full(len(weight), np.inf), where=weight > 0)
        scatter = np.where(self._taking[balance], apart_from_drift(scatter, drift), np.inf)
        memory, records = drift_memory(self.data), self.data.train
        return innovations(rows, scatter, drift, memory=memory, records=records)

    def _rows(
        self, rival: Rival, data: Dataset, weights: Mapping[str, FloatArray]
    ) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64]]:
        """Weighted residual, Jacobian over free parameters and unknowns of the runs, block of each
        row."""
        form = form_of(rival.solution, data, self.free(rival), weights)
        x = np.array([form.values[n] for n in form.free])
        stacked = form.stacked(x)
        names = form.balances.balances
        r = np.concatenate([self._apart(b, stacked.residual[b], weights[b]) for b in names])
        j = np.concatenate([self._apart(b, stacked.jacobian[b], weights[b]) for b in names])
        block = np.concatenate([np.where(stacked.taking[b], stacked.block, -1) for b in names])
        return r, j, block

    def free(self, rival: Rival) -> tuple[str, ...]:
        """Parameters of a rival that may adapt: none that a bound holds."""
        held = set(rival.solution.at_bound)
        return tuple(n for n in rival.solution.free if n not in held)

    @cached_property
    def likelihood(self) -> FloatArray:
        """Log-likelihood of each rival on the old records, beside what its clocks and zeros are
        worth beforehand, (rivals,) [nats]."""
        rows = np.array([-0.5 * INDEPENDENT_SHARE * float(r @ r) for r, _, _ in self._old])
        return np.asarray(rows - self._unlikely)

    @cached_property
    def ahead(self) -> FloatArray:
        """By how much the leader is ahead of each rival on the old records, and how sure that is
        over blocks, as a normal deviate: by their mean, signs or signed ranks.  (rivals, 2)

        Rows at a turn count only where one of the two laws says what happens there.
        """
        leader = self.rivals.index(self.leader)
        best, _, block = self._old[leader]
        out = np.zeros((len(self.rivals), 2))
        for k, (rival, (own, _, _)) in enumerate(zip(self.rivals, self._old, strict=True)):
            counted = np.concatenate(self._calm(self.leader, rival))
            apart = _by_block(own * counted, block) - _by_block(best * counted, block)
            difference = 0.5 * INDEPENDENT_SHARE * apart
            count = len(difference)
            spread = float(np.std(difference, ddof=1)) * math.sqrt(count) if count > 1 else 0.0
            mean = float(difference.sum()) / spread if spread > 0 else 0.0
            # one block may hold most of a difference that all of them, or all large ones, show
            signs = float(np.sign(difference).sum()) / math.sqrt(count)
            ranked = _signed_ranks(difference)
            beforehand = float(self._unlikely[k] - self._unlikely[leader])
            out[k] = difference.sum() + beforehand, max(mean, signs, ranked)
        return out

    def alive(self, unmodelled: float = 0.0) -> tuple[Rival, ...]:
        """Rivals that the whole fits on the old records leave.

        Parameters
        ----------
        unmodelled : float
            Log-likelihood that laws which are not missing still gain in what the leader leaves
            (:func:`identification.naming.odds.unmodelled`): names that differ by no more may differ
            by such a gain [nats].
        """
        limit = max(FEWEST, unmodelled)
        return tuple(
            rival
            for rival, (nats, deviate) in zip(self.rivals, self.ahead, strict=True)
            if not (nats > limit and deviate > DECIDED)
        )

    def probability(self, unmodelled: float = 0.0) -> FloatArray:
        """Chance of each rival that it is the true one of them, (rivals,).

        Odds of the likelihoods with the price of each free parameter as in Bayes' criterion; before
        the records all are equally likely. Likelihoods are tempered so that what is `unmodelled`
        [nats] is no more than `FEWEST`, and each by its own scatter over blocks: a normal value
        that is z deviates from zero has a likelihood of 2 z^2 [nats] over the same with the other
        sign, and one block of a record that no law meets is no certainty.
        """
        tempering = max(1.0, unmodelled / FEWEST)
        rows = np.count_nonzero(self._old[0][2] >= 0) / len(self.data.sensing.balances)
        price = 0.5 * math.log(max(INDEPENDENT_SHARE * rows / tempering, 1.0))
        count = np.array([len(r.solution.free) for r in self.rivals])
        nats, deviate = self.ahead.T
        log = -np.minimum(nats / tempering, 2 * np.maximum(deviate, 0.0) ** 2) - price * count
        odds = np.exp(log - log.max())
        return np.asarray(odds / odds.sum())

    @cached_property
    def information(self) -> list[FloatArray]:
        """What the old records say about the free parameters of each rival, unknowns of the runs
        eliminated: (free, free) each.
        """
        return [
            eliminated(j.T @ j, len(self.free(rival)))
            for rival, (_, j, _) in zip(self.rivals, self._old, strict=True)
        ]


def about_turns(rival: Rival) -> bool:
    """Whether a law says what happens while the motion turns round."""
    effect = EFFECTS.get(rival.name)
    return effect is not None and (effect.memory is not None or effect.shapes_reversal)


def turning(
    solution: Solution, records: Sequence[WeakRecord], balance: str
) -> npt.NDArray[np.bool_]:
    """Rows that touch a turn of a side whose friction acts in the balance: there dry friction is an
    inequality, and the width of its change a stand-in.
    """
    parts = []
    for rows in records:
        out = np.zeros(rows.rows, dtype=np.bool_)
        for side in RESTING_SIDES.get(balance, ()):
            if f"{side}_velocity" not in rows.points:
                continue
            velocity = rows.points[f"{side}_velocity"]
            widths = [solution.values[n] for n in solution.model.named("smoothing", side)]
            slow = np.abs(velocity) < TURN_WIDTHS * max(widths, default=0.0)
            turns = np.diff(np.sign(velocity), append=np.sign(velocity[-1:])) != 0
            out |= rows.average((slow | turns).astype(np.float64)) > REST_SHARE
        parts.append(out)
    return np.concatenate(parts)


def _entitled(rivals: Sequence[Rival], data: Dataset) -> list[dict[str, FloatArray]]:
    """One over the scatter that each row of a rival may have, per balance.

    A law that scales a measured torque passes its noise on with that scale: the residuals of two
    rivals are no lengths in one unit, and the one with the smaller unit is not the better one. What
    even the best of them leaves beside noise is the same torque for all: what is more than noise
    may be, whose squares are known to :data:`~identification.balance.colour.LEVEL_ERROR`. Rows that
    may go either way by a law say little against it, and as much as others against one that says
    which way. What was before a record began is known to no law: rows that hang on it by one count
    less for all.
    """
    levels = _believable(rivals, data)
    laws = [
        (balances_of(r.solution.model, data.sensing, wrt=()), r.solution.values) for r in rivals
    ]
    either = [unsure(law, data, values, data.train) for law, values in laws]
    begun = [beginnings(law, data, values, data.train) for law, values in laws]
    support = support_of(data.train)
    out: list[dict[str, FloatArray]] = [{} for _ in rivals]
    for b in data.sensing.balances:
        rows = taking_part(b, data.train)
        beside = min(
            max(0.0, r.solution.sigma[b] ** 2 - (1 + LEVEL_ERROR) * rms(level[b][rows]) ** 2)
            for r, level in zip(rivals, levels, strict=True)
        )
        beside = beside + np.max([one[b] for one in begun], axis=0) ** 2
        for weight, level, way in zip(out, levels, either, strict=True):
            variance = level[b] ** 2 + beside + way[b] ** 2
            weight[b] = support / np.sqrt(np.maximum(variance, LEAST_DEVIATION**2))
    return out


def _believable(rivals: Sequence[Rival], data: Dataset) -> list[dict[str, FloatArray]]:
    """Level of noise of each row that each rival passes on, per balance.

    A law whose rows leave far less than the noise it is said to pass on does not pass it on: a
    slope that runs away where hardly a row is makes a level of thousands of N.m of some draws.  It
    may leave what it does leave, as far as others may: no less than the calmest of them, which may
    pass on little as it stands for an inertia, and no more than the loudest.
    """
    drawn, believed = [], []
    for rival in rivals:
        model, values = rival.solution.model, rival.solution.values
        known = [drawn_floors(model, data, values, w) for w in data.train]
        drawn.append(known)
        believed.append(noise_believed(model, data, values, known))
    levels: list[dict[str, FloatArray]] = [{} for _ in rivals]
    for b in data.sensing.balances:
        least = CONTRADICTED * max(x[b] for x in believed)
        sure = [k for k, x in enumerate(believed) if x[b] >= least]
        for k, level in enumerate(levels):
            own = np.array([at[b] for at in drawn[k]])
            if k not in sure:
                others = np.array([[at[b] for at in drawn[i]] for i in sure])
                own = np.clip(believed[k][b] * own, others.min(axis=0), others.max(axis=0))
            level[b] = np.repeat(own, [w.rows for w in data.train])
    return levels


def _drift(rivals: Sequence[Rival], data: Dataset) -> dict[str, FloatArray]:
    """What the drift of the measured torques gives each row of a balance, by balance; none where
    none drifts. The readings are the same for all rivals: what the one leaves that leaves the least
    holds a drift for all others, which cannot have lost to it what they lack.
    """
    if not drift_memory(data):
        return {}
    every = [noise_rows(r.solution.model, data, r.solution.values, data.train)[1] for r in rivals]
    return {b: min((x[b] for x in every), key=rms) for b in every[0]}


def _left(rival: Rival, data: Dataset) -> Mapping[str, FloatArray]:
    """Residual of each balance on the old records."""
    balances = balances_of(rival.solution.model, data.sensing, wrt=())
    return stack(balances, data.train, rival.solution.values).residual


def _unlikely(rival: Rival, data: Dataset) -> float:
    """What the clocks and zeros of a rival cost by what is known of them before the rows are asked
    [nats]: a name that needs a skew of three samples is not ahead by what the skew takes off.
    """
    values = rival.solution.values
    known = usual(rival.solution.model, data.train, torque=data.sensing.has_torque)
    return 0.5 * sum(((values[n] - m) / s) ** 2 for n, (m, s) in known.items() if n in values)


def _cost(
    weighted: Mapping[str, FloatArray], counted: Mapping[str, npt.NDArray[np.bool_]]
) -> float:
    """Log-likelihood of the counted rows of the balances but for its sign, each balance with a
    scatter of its own."""
    return sum(
        np.count_nonzero(counted[b]) * math.log(max(float(np.linalg.norm(r[counted[b]])), 1e-300))
        for b, r in weighted.items()
    )


def _signed_ranks(values: FloatArray) -> float:
    """Normal deviate of Wilcoxon's signed ranks: large values of one sign beside small ones of both
    speak for it, however much the largest of them scatter.
    """
    count = len(values)
    ranks = np.empty(count)
    ranks[np.argsort(np.abs(values))] = np.arange(1.0, count + 1.0)
    spread = math.sqrt(count * (count + 1) * (2 * count + 1) / 6)
    return float(np.sign(values) @ ranks) / max(spread, 1.0)


def _by_block(residual: FloatArray, block: npt.NDArray[np.int64]) -> FloatArray:
    used = block >= 0
    return np.bincount(block[used], weights=residual[used] ** 2).astype(np.float64)
