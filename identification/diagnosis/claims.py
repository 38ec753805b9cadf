"""From tried candidates to claims: who is significant, who cannot be told apart, what is minor."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, final

import numpy as np

from casadi_models import EFFECTS, Effect
from identification.balance.clocks import MOST_SKEW, carrier
from identification.data.formats import chances
from identification.diagnosis.candidates import Candidate, NotTestable, offered
from identification.diagnosis.trials import MINOR_DROP, Base, Trial, try_candidate
from identification.fitting.covariance import errors_above

MAJOR_DROP: Final = 10.0
"""Cross-validated fall of a balance's RMS that a claim must bring [%]. Chosen on simulated joints
with dirt and nothing hidden: at 2 % there is a false claim on 42 % of them, at 5 % on 15 %, at 10 %
on 5 %, at 20 % on none, where effects of half size begin to be missed.
"""
HELD_OUT_DROP: Final = 5.0
"""The same on held-out records, in the linear form: half of it, as the shapes of the trial are
those of the training records [%].
"""
GAIN: Final = 3.0
"""Cross-validated log-likelihood that a claim must gain [nats]: what each further parameter costs
in Bayes' criterion at some 400 independent rows, log(400) / 2.
"""
FALSE_DISCOVERY: Final = 0.05
"""Share of false names among those that the tests pass (Benjamini and Hochberg); the usual one. It
is not enough by itself: the search over shapes makes the p-values too small by a factor of three.
"""
MINOR_HELD_OUT: Final = 2.0
"""The same on held-out records [%]."""
MINOR_GAIN: Final = 100.0
"""Log-likelihood that a small effect must gain [nats]: far beyond what dirt of the sensors brings,
as such an effect has no fall to speak for it.
"""
MINOR_P: Final = 0.01
"""p-value up to which a small effect is certain; stricter than a claim's, for the same reason."""
SET_T: Final = 2.0
"""Blocks tell two names apart from this t on: five in a hundred by chance."""
SCREEN_LOST: Final = 0.15
"""Share of the best trial's gain up to which the name of another is worth a whole fit, whatever the
blocks say of the trials: names off by the grid of their shapes lose as much.
"""
SET_RMS: Final = 1.5
"""Factor by which a name of the set may leave more than the best one in any balance."""
LARGEST_SET: Final = 4
"""Names of a set that are still an answer; more say only that something is there."""
STILL_HELPS: Final = 0.5
"""Share of the best name's fall that every name of its set must bring."""
LATE_DROP: Final = 30.0
"""Fall of the RMS for effects with free dynamics of their own, which fit a little of anything."""
UNSEEN_DROP: Final = 20.0
"""Fall of the RMS where the link is not recorded: its motion leaves structure of 10 times the
floor in the balance.
"""
HALF_SAMPLE: Final = 0.5
"""Delay from which on a channel whose clock is not calibrated is late [samples]."""
COMMON_DROP: Final = 4.0
"""Fall of the RMS that is enough for an effect declared as common: hardly a joint is without it."""
PLAIN_FIRST: Final = 0.5
"""A plain law (Coulomb friction) goes before one that gains less than twice as much."""


@final
@dataclass(frozen=True)
class Claim:
    """A set of names for one missing effect.

    Attributes
    ----------
    effects : tuple of str
        Keys that the data cannot tell apart, the most likely first.
    label : str
        Label that was added to the model.
    balance : str
    held_out_drop_percent : float
    separate_by : str or None
        The run that would separate the names.
    partial : bool
        True where structure is left that the names do not explain.
    contribution : float
        RMS of what the effect adds to its balance [N.m].
    like : str
        "like NAME, which explains 97 %", where the law is not shown to be as good as a curve.
    confidence : mapping of str to float
        Chance of each name that it is the one that is missing, from the likelihoods of whole fits;
        empty where none were made.
    kernel : float or None
        Length of the rows that show it [s], where those of the claims' own kernel are too noisy.
    """

    effects: tuple[str, ...]
    label: str
    balance: str
    held_out_drop_percent: float
    separate_by: str | None = None
    partial: bool = False
    contribution: float = 0.0
    like: str = ""
    confidence: Mapping[str, float] = field(default_factory=dict)
    kernel: float | None = None

    @property
    def effect(self) -> Effect:
        """The effect of the first name."""
        return EFFECTS[self.effects[0]]

    @property
    def surety(self) -> str:
        """How sure each name is, in words; empty where no whole fits were made."""
        return chances(self.confidence)

    def with_hint(self) -> Claim:
        """The claim with what would separate its names; without a hint where there is one name."""
        hints = [EFFECTS[n].separate_by for n in self.effects if EFFECTS[n].separate_by]
        return replace(self, separate_by=hints[0] if len(self.effects) > 1 and hints else None)

    def as_json(self) -> dict[str, Any]:
        """The shape of `improve --json`."""
        out: dict[str, Any] = {
            "effects": list(self.effects),
            "balance": self.balance,
            "held_out_drop_percent": self.held_out_drop_percent,
            "separate_by": self.separate_by,
        }
        if self.partial:
            out["partial"] = True
        if self.like:
            out["like"] = self.like
        if self.kernel is not None:
            out["kernel_s"] = self.kernel
        if self.confidence:
            out["confidence"] = dict(self.confidence)
        return out


@final
@dataclass(frozen=True)
class Ranking:
    """All candidates tried on one base, best first; one entry per effect.

    `least`: by key, about the smallest contribution that would be named (:func:`least_seen`).
    """

    trials: tuple[Trial, ...]
    significant: frozenset[str]
    not_testable: tuple[NotTestable, ...]
    everything: tuple[Trial, ...] = field(default=())
    least: Mapping[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        return (
            f"Ranking({[t.key for t in self.trials[:5]]}, {len(self.trials)} effects tried, "
            f"{len(self.significant)} significant)"
        )

    def best(self, refused: frozenset[str] = frozenset()) -> Trial | None:
        """Best significant trial whose label was not refused before; a visible torsion comes
        first.
        """
        for t in self.everything:
            if (
                t.effect.stage == "structure"
                and t.candidate.label in self.significant
                and t.candidate.label not in refused
            ):
                return t
        left = [
            t
            for t in self.everything
            if t.candidate.label in self.significant and t.candidate.label not in refused
        ]
        plain = next((t for t in left if t.effect.stage == "plain"), None)
        if plain is not None and plain.score >= PLAIN_FIRST * left[0].score:
            return plain
        return left[0] if left else None


def rank(
    base: Base,
    extra: Sequence[Candidate] = (),
    *,
    late: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> Ranking:
    """Try every candidate that the records can show on the fitted base.

    Parameters
    ----------
    base : Base
    extra : sequence of Candidate
        Beside those of the library.
    late : bool
        The costly ones too.
    progress : callable, optional
        ``progress(text, share)`` before each candidate.
    """
    candidates, refused = offered(base.solution.model, base.data, late=late)
    trials: list[Trial] = []
    untestable = {n.effect: n for n in refused}
    every = (*candidates, *extra)
    for number, candidate in enumerate(every):
        if progress is not None:
            progress(
                f"trying {candidate.effect.title.lower()} ({number + 1} of {len(every)})",
                number / len(every),
            )
        found = try_candidate(candidate, base)
        if isinstance(found, Trial):
            trials.append(found)
        elif isinstance(found, NotTestable):
            untestable.setdefault(found.effect, found)
    trials.sort(key=lambda t: -t.score)
    seen: dict[str, Trial] = {}
    for t in trials:
        seen.setdefault(t.key, t)
        untestable.pop(t.key, None)
    kept: dict[str, Trial] = {}
    for t in trials:
        kept.setdefault(t.candidate.label, t)
    unique = sorted(kept.values(), key=lambda t: -t.score)
    passed = _discoveries(unique)
    significant = frozenset(
        t.candidate.label for t in unique if t.candidate.label in passed and _major(t, base)
    )
    order = sorted(seen.values(), key=lambda t: (t.candidate.label not in significant, -t.score))
    least = {t.key: least_seen(t, base, len(unique)) for t in order}
    return Ranking(
        tuple(order),
        significant,
        tuple(untestable.values()),
        tuple(unique),
        least={key: size for key, size in least.items() if math.isfinite(size)},
    )


def nearly(ranking: Ranking, base: Base, refused: frozenset[str]) -> list[Trial]:
    """The best trials that the training blocks support and that only their linearised held-out
    drops keep from being significant, up to the first that is.
    """
    sure = FALSE_DISCOVERY / max(len(ranking.everything), 1)
    better = itertools.takewhile(
        lambda t: t.candidate.label not in ranking.significant, ranking.everything
    )
    return [
        t
        for t in better
        if t.candidate.label not in refused
        and t.p_value <= sure
        and not math.isnan(t.held_out_drop_percent)
        and _major(replace(t, held_out_drop_percent=math.nan), base)
    ][:LARGEST_SET]


def unproved(ranking: Ranking, base: Base, refused: frozenset[str]) -> list[Trial]:
    """The best trials that are certain on the training blocks and lower what they leave by too
    little for a claim: a motion at one speed hardly shows a law of the speed, and yet another
    motion falls by most of it.
    """
    sure = FALSE_DISCOVERY / max(len(ranking.everything), 1)
    return [
        t
        for t in ranking.everything
        if t.candidate.label not in refused
        and t.p_value <= sure
        and t.gain > GAIN
        and t.effect.stage != "late"
        and not t.effect.is_delay
        and not math.isnan(t.held_out_drop_percent)
        and t.beyond_noise(t.cv_drop_percent) < least_drop(t, base)
    ][:LARGEST_SET]


def outvoted(ranking: Ranking, base: Base, refused: frozenset[str]) -> list[Trial]:
    """The best trials that are certain and lower what they leave of their balance by enough, and
    that another balance is against.

    Where the encoders are coarse, inertias without the missing law stand where they pass little
    noise on. A trial counts what leaves this place as a loss; the whole fit with the law, noise
    taken off, may find more noise there and no more of anything else.
    """
    sure = FALSE_DISCOVERY / max(len(ranking.everything), 1)
    return [
        t
        for t in ranking.everything
        if t.candidate.label not in refused
        and t.p_value <= sure
        and t.gain <= GAIN < t.own_gain
        and t.effect.stage != "late"
        and not t.effect.is_delay
        and t.beyond_noise(t.cv_drop_percent) >= least_drop(t, base)
        and t.beyond_noise(t.held_out_drop_percent) >= HELD_OUT_DROP
    ][:LARGEST_SET]


def least_drop(trial: Trial, base: Base) -> float:
    """Fall of the RMS that a claim of this name must bring [%]."""
    unseen = base.solution.model.load_compliance(base.solution.values) > 0
    return UNSEEN_DROP if unseen and not trial.effect.common else usual_drop(trial)


def usual_drop(trial: Trial) -> float:
    """The same where the link is recorded [%]."""
    return COMMON_DROP if trial.effect.common else MAJOR_DROP


def least_seen(trial: Trial, base: Base, tried: int) -> float:
    """About the smallest RMS of an effect's torque in its balance that these records would name
    [N.m], of the shape of its trial: the tests that a name must pass are turned round. It must
    be certain among all that are tried, and lower what is left by enough. Infinite where the
    trial says nothing of it.
    """
    blocks = int(np.count_nonzero(base.numbers.sum(axis=1)))
    if trial.alone <= 0 or blocks < 2 or trial.effect.is_delay or trial.effect.stage == "late":
        return math.inf
    kept = trial.unit * (1 - least_drop(trial, base) / 100)
    left = float(trial.rms[base.balances.index(trial.balance)])
    falls = left * math.sqrt(kept**-2 - 1) / trial.alone
    sure = trial.error * errors_above(blocks, FALSE_DISCOVERY / (2 * max(tried, 1)))
    return max(falls, sure)


def _discoveries(trials: Sequence[Trial]) -> set[str]:
    """Benjamini-Hochberg at 5 %."""
    ordered = sorted(trials, key=lambda t: t.p_value)
    last = -1
    for i, t in enumerate(ordered):
        if t.p_value <= FALSE_DISCOVERY * (i + 1) / len(ordered):
            last = i
    return {t.candidate.label for t in ordered[: last + 1]}


def _major(trial: Trial, base: Base) -> bool:
    common = trial.effect.common
    drop = trial.beyond_noise(trial.cv_drop_percent)
    if trial.gain <= GAIN or drop < least_drop(trial, base):
        return False
    held = trial.beyond_noise(trial.held_out_drop_percent)
    if not math.isnan(held) and held < (COMMON_DROP / 2 if common else HELD_OUT_DROP):
        return False
    if trial.effect.stage == "late":
        return drop >= LATE_DROP and (math.isnan(held) or held >= LATE_DROP)
    if trial.effect.is_delay:
        model, place = base.solution.model, trial.candidate.place
        name = carrier(model, place)
        late = base.solution.values[name] if name is not None else 0.0
        least = MOST_SKEW if name in model.calibration else HALF_SAMPLE
        found = max(abs(trial.values[n] + late) for n in trial.candidate.amplitudes)
        return found > least * base.data.train[0].grid.dt
    return True


def confusion_set(best: Trial, trials: Sequence[Trial], base: Base) -> tuple[str, ...]:
    """Names that the trials cannot tell from the best one, the best first: whole fits decide
    between them (:mod:`identification.naming.odds`).
    """
    names = [best.key]
    if best.effect.stage == "structure" and base.data.sensing.both_positions:
        return (best.key,)
    blocks = np.unique(base.block[base.block >= 0])
    for other in trials:
        if other.key in names or other.score <= 0 or best.key in other.effect.contains:
            continue
        lost = (best.score - other.score) / best.score
        difference = best.block_score[blocks] - other.block_score[blocks]
        spread = (
            float(np.std(difference, ddof=1)) / math.sqrt(len(blocks))
            if len(blocks) > 1
            else math.inf
        )
        t = float(np.mean(difference)) / spread if spread > 0 else 0.0
        alike = abs(t) < SET_T or lost < SCREEN_LOST
        involved = [i for i in range(len(best.rms)) if best.rms[i] > 0]
        ratio = max(float(other.rms[i] / best.rms[i]) for i in involved)
        if alike and ratio <= SET_RMS and _still_helps(other, best):
            names.append(other.key)
    return tuple(names)


def shortened(names: Sequence[str], ranking: Ranking) -> tuple[str, ...]:
    """A set of names with those that are not significant themselves left out where there are
    too many.
    """
    significant = {t.key for t in ranking.everything if t.candidate.label in ranking.significant}
    kept = [n for n in names if n in significant]
    for name in names:
        if name not in kept and len(kept) < LARGEST_SET:
            kept.append(name)
    return tuple(n for n in names if n in kept)


def _still_helps(other: Trial, best: Trial) -> bool:
    """A name stays in the set only if it does a fair part of the work itself."""
    return other.cv_drop_percent >= STILL_HELPS * best.cv_drop_percent and (
        math.isnan(other.held_out_drop_percent)
        or other.held_out_drop_percent >= STILL_HELPS * best.held_out_drop_percent
    )


def simplest(
    best: Trial, names: Sequence[str], ranking: Ranking, refused: frozenset[str] = frozenset()
) -> Trial:
    """Of the names that cannot be told apart, one that hardly a joint is without; then the one
    with the fewest parameters.
    """
    usable = ranking.significant - refused
    alike = [t for t in ranking.trials if t.key in names and t.candidate.label in usable]
    return min(alike or [best], key=lambda t: (not t.effect.common, len(t.values), -t.score))


def make_claim(
    best: Trial, ranking: Ranking, base: Base, names: tuple[str, ...] | None = None
) -> Claim:
    """The claim that follows from the best trial."""
    names = names or confusion_set(best, ranking.everything, base)
    names = (best.key, *(n for n in names if n != best.key))
    held = best.held_out_drop_percent
    return Claim(
        names,
        best.candidate.label,
        best.balance,
        best.cv_drop_percent if math.isnan(held) else held,
        contribution=best.contribution,
    ).with_hint()


def minor_claims(ranking: Ranking, base: Base) -> list[Trial]:
    """Small but certain candidates (to be confirmed at other kernels by the caller)."""
    out = []
    for t in ranking.trials:
        if (
            t.candidate.label in ranking.significant
            or t.score < MINOR_GAIN
            or t.beyond_noise(t.cv_drop_percent) < MINOR_DROP
        ):
            continue
        if (
            math.isnan(t.held_out_drop_percent)
            or t.beyond_noise(t.held_out_drop_percent) < MINOR_HELD_OUT
            or t.p_value > MINOR_P
        ):
            continue
        if t.effect.is_delay or t.effect.stage == "late":
            continue
        out.append(t)
    return out[:2]
