"""Which names the whole fits leave of a claim, and how sure the first one is."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, final

from casadi_models import EFFECTS
from identification.balance.dataset import Dataset
from identification.diagnosis.claims import Ranking, rank
from identification.diagnosis.trials import make_base
from identification.fitting.engine import Solution
from identification.naming.contest import FEWEST, Contest, Rival, from_every_valley, rivals_of

NOTHING: Final = ""
"""Name of the rival without any effect in the place of the claim."""
SCREEN: Final = 2.0
"""Factor by which a linear trial may make a name worse than its whole fit: shapes and smoothing of
the model stand still in a trial."""
MOST_FITTED: Final = 8
"""Names that are fitted whole at most: those of the largest set that is an answer, and as many
more."""


@final
@dataclass(frozen=True)
class Odds:
    """Names of one claim after whole fits.

    Attributes
    ----------
    rivals : tuple of Rival
        Those that the records leave, the most probable first.
    probability : mapping of str to float
        Chance of each of these names that it is the one that is missing; the rest of 1 is with
        names that fell out and with nothing of the library at all.
    behind : mapping of str to str
        Why a name fell out.
    nothing : float
        Chance that no name of the library is missing.
    alike : tuple of Rival
        Names that the records do not tell from the best of them, also where nothing at all does as
        well as one of these.
    """

    rivals: tuple[Rival, ...]
    probability: Mapping[str, float]
    behind: Mapping[str, str]
    nothing: float = 0.0
    alike: tuple[Rival, ...] = ()

    @property
    def empty(self) -> bool:
        """Whether nothing at all is more probable than all names together: what the first one
        gains is no more than laws that are not missing gain on the same records.
        """
        return self.nothing > sum(self.probability.values())

    @property
    def names(self) -> tuple[str, ...]:
        """Keys of the rivals."""
        return tuple(r.name for r in self.rivals)

    def without(self, labels: Collection[str]) -> Odds:
        """The same where the rivals of these labels cannot be: the others have their chance."""
        rivals = tuple(r for r in self.rivals if r.label not in labels)
        left = 1.0 - sum(self.probability[r.name] for r in self.rivals if r not in rivals)
        kept = {r.name: self.probability[r.name] / left for r in rivals if left > 0.0}
        nothing = self.nothing / left if left > 0.0 else 0.0
        alike = tuple(r for r in self.alike if r.label not in labels)
        left_over = rivals if kept else ()
        return Odds(left_over, MappingProxyType(kept), self.behind, nothing, alike)

    def holds(self, name: str) -> bool:
        """Whether a name may stand for its set: none is more probable by so much as to count as
        better (:data:`~identification.naming.contest.FEWEST`).
        """
        most = max(self.probability.values(), default=0.0)
        return name in self.names and self.probability[name] > most * math.exp(-FEWEST)


def unmodelled(ranking: Ranking, balance: str) -> float:
    """Log-likelihood that a law of the library still gains in what a model leaves of a balance.

    No name is missing there any more, so whatever gains does so by imitating what is not modelled:
    what two names differ by has to be held against it.

    Parameters
    ----------
    ranking : Ranking
        Made on the model with all that was named.
    balance : str
    """
    return max((t.score for t in ranking.everything if t.balance == balance), default=0.0)


def unmodelled_by(contest: Contest, balance: str) -> float:
    """The same for the leader of a contest."""
    return unmodelled(rank(make_base(contest.leader.solution, contest.data)), balance)


def contenders(
    claimed: Sequence[str], near: Mapping[str, float], allowance: float
) -> tuple[str, ...]:
    """Names that are worth a whole fit: those of the set, those whose trial is no more behind
    than what is not modelled, and those whose trial is that of another name of the set: where an
    offset of the current may stand for the name, one of the torque sensor may as well if both are
    one column there.

    Parameters
    ----------
    claimed : sequence of str
        Names of the set, that of the model first.
    near : mapping of str to float
        Log-likelihood by which the trial of a name is behind [nats].
    allowance : float
        What is not modelled [nats].
    """
    limit = SCREEN * max(allowance, FEWEST)
    others = [near[n] for n in claimed[1:] if n in near]
    more = [
        n
        for n, lost in sorted(near.items(), key=lambda item: item[1])
        if n not in claimed
        and (lost <= limit or any(abs(lost - other) <= FEWEST for other in others))
        and claimed[0] not in EFFECTS[n].contains
    ]
    return (*claimed, *more[: max(0, MOST_FITTED - len(claimed))])


def contest_of(
    names: Sequence[str], balance: str, first: Rival, bare: Solution, data: Dataset
) -> Contest:
    """Whole fits of names, and of none of them, held against each other.

    Parameters
    ----------
    names : sequence of str
        Keys, that of `first` among them.
    balance : str
        Where the effect was claimed.
    first : Rival
        The name that is in the model, as fitted.
    bare : Solution
        The fit of the model without it.
    data : Dataset
    """
    others = [n for n in names if n != first.name]
    fitted = [first]
    if others:
        fitted = from_every_valley([first, *rivals_of(others, balance, bare, data)], bare, data)
    return Contest([*fitted, Rival(NOTHING, NOTHING, bare)], data)


def odds_of(contest: Contest, allowance: float) -> Odds:
    """What a contest says of its names.

    Parameters
    ----------
    contest : Contest
        See :func:`contest_of`.
    allowance : float
        What the leader leaves unmodelled [nats].
    """
    alike = tuple(r for r in contest.alive(allowance) if r.name)
    alive = {r.name for r in alike}
    shares = contest.probability(allowance)
    chance = {r.name: float(p) for r, p in zip(contest.rivals, shares, strict=True)}
    title = EFFECTS[contest.leader.name].title if contest.leader.name else "nothing"
    least = max(allowance, FEWEST)
    behind = {
        r.label: f"is {nats:.3g} nats behind {title} once both are fitted with the rest; no more "
        f"than {least:.3g} would be a tie"
        for r, (nats, _) in zip(contest.rivals, contest.ahead, strict=True)
        if r.name and r.name not in alive
    }
    gains = _gains(contest)
    if any(gains.get(name, 0.0) > least for name in alive):
        # blocks may not tell a law from one that does nothing: that is no second explanation
        for r in contest.rivals:
            if r.name in alive and gains[r.name] <= least:
                alive.remove(r.name)
                behind[r.label] = (
                    f"gains {max(gains[r.name], 0.0):.3g} nats over nothing once fitted with the "
                    f"rest: no more than laws that are not missing gain ({least:.3g})"
                )
    left = [r for r in contest.rivals if r.name in alive]
    return Odds(
        tuple(sorted(left, key=lambda r: -chance[r.name])),
        MappingProxyType({r.name: chance[r.name] for r in left}),
        MappingProxyType(behind),
        chance.get(NOTHING, 0.0),
        alike,
    )


def _gains(contest: Contest) -> dict[str, float]:
    """By how much each name is ahead of nothing at all [nats]; none where that was not fitted."""
    nats = {r.name: float(x) for r, (x, _) in zip(contest.rivals, contest.ahead, strict=True)}
    empty = nats.pop(NOTHING, None)
    return {} if empty is None else {name: empty - x for name, x in nats.items()}
