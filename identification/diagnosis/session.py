"""One session: a model and its records, and every decision about what is missing.

`compare`, `diagnose` and `improve`, the page, the report and a user's FMU ask here; none of them
decides by itself.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Final, final

from casadi_models import EFFECTS
from casadi_models.hold import DRIVE_DELAY, HOLD_NAME
from identification.balance.calibration import of_run, within_limits
from identification.balance.clocks import places_of
from identification.balance.dataset import Dataset, with_effect, without
from identification.balance.excitation import (
    claim_limit,
    excitation_warnings,
    few_reversals,
    not_identifiable,
    readings_notes,
    unlike_units,
)
from identification.balance.kinematic import without_scale
from identification.balance.sensing import Sensing
from identification.data.check.gate import gate_warnings, gated
from identification.data.joint_file import Joint
from identification.data.record import Record, listed
from identification.diagnosis.bench import Bench, JointBench, Progress
from identification.diagnosis.claims import (
    HELD_OUT_DROP,
    LARGEST_SET,
    MAJOR_DROP,
    SET_RMS,
    Claim,
    Ranking,
    confusion_set,
    least_drop,
    make_claim,
    minor_claims,
    nearly,
    outvoted,
    shortened,
    simplest,
    unproved,
)
from identification.diagnosis.improvement import (
    Improvement,
    Step,
    common_rms,
    held_drop,
    judged_drop,
    made_worse,
    spoilt,
)
from identification.diagnosis.learned import Equivalence, LearnedClaim, marked, variable_of
from identification.diagnosis.lines import without_turn
from identification.diagnosis.locate import Unexplained, spectral_peak
from identification.diagnosis.outcome import refusals
from identification.diagnosis.rival_table import is_absorbed
from identification.diagnosis.trials import Base, Trial
from identification.diagnosis.verdict import (
    curves_told,
    hardly_a_model,
    longer_rows,
    open_notes,
    unseen,
    verdict_of,
    without_link,
    without_motor,
)
from identification.errors import InputError
from identification.fitting.assess import RATIO_LIMIT
from identification.fitting.dataset import BETTER, dataset_of, shifts_of
from identification.fitting.engine import Solution, prepared_model
from identification.naming.odds import SCREEN, Odds

MAX_ADDITIONS: Final = 6
SLOWER: Final = (2.0, 4.0)
"""Kernels, in units of that of the claims, at which the library is tried where that one shows
nothing more: the noise of a position in the torque of an inertia falls with the length to the power
of 2.5, and a law of speed or place hardly changes."""
ATTEMPTS: Final = 2 * MAX_ADDITIONS
"""Candidates that are taken up at most, named or refused; the same however few additions are
asked for.
"""
LEAST_ADDED_DROP: Final = 2.0
"""Fall of a balance's held-out RMS that an addition must bring after its whole fit [%]."""
EXPLAINED_SHARE: Final = 0.5
"""Share of what a claim explains and what is left over the floor at the end, taken together, below
which it is one in part: what is left may then be what it stands for."""
LOCATED_SHARE: Final = 50.0
"""Share of what is left that one variable must hold before a table over it is set against the
claims [%].
"""
NO_MODEL: Final = 50.0
"""Held-out error of the start model from which records that move as far apart as degrees and
radians are refused [%].
"""
SAME_WITH_ONE_LESS: Final = 5.0
"""Rise of a balance's RMS up to which one effect does as well as two [%]."""
SWAP_GAIN: Final = 3.0
"""Log-likelihood by which another effect must do better than a claim to take its place [nats]."""
NOT_NEEDED: Final = 10.0
"""Log-likelihood of the best other effect below which a claim that is no longer significant is
dropped [nats].
"""


def refuse_unlike(data: Dataset, relative_error_percent: float) -> None:
    """Refuse records that move as far apart as degrees and radians, where the model fails on the
    held-out ones.

    Raises
    ------
    InputError
        One line that names the record.
    """
    unlike = unlike_units(data)
    # not (x < y): an error that is no number is no reason to go on
    if unlike and not relative_error_percent < NO_MODEL:
        raise InputError(unlike)


def with_held_out(
    train: list[Record], held_out: list[Record]
) -> tuple[list[Record], list[Record], str]:
    """Training and held-out records; without given ones the last 30 % of the time blocks are
    held out.
    """
    if held_out:
        return train, held_out, ""
    pairs = [r.split(0.7) for r in train]
    note = (
        "no held-out records given: the last 30 % of each training record (or of its runs) is "
        "held out"
    )
    return [p[0] for p in pairs], [p[1] for p in pairs], note


RELATIVE_SHARE: Final = 0.3
"""Share of the best trial's log-likelihood from which a relative of its name is fitted too."""
OTHER_SHARE: Final = 1 / SCREEN
"""The same for a name that is not declared as confused with it."""
MOST_RELATIVES: Final = 3
"""Relatives that are fitted at most: each costs a whole fit."""


@final
@dataclass(frozen=True)
class _Standing:
    """Where a run stands: the accepted claims, a step for each after the start model."""

    steps: tuple[Step, ...]
    claims: tuple[Claim, ...] = ()

    @property
    def now(self) -> Step:
        return self.steps[-1]

    def with_claim(self, position: int, claim: Claim) -> tuple[Claim, ...]:
        """The claims with another one in a place."""
        return tuple(claim if i == position else c for i, c in enumerate(self.claims))

    def full(self, limit: int) -> frozenset[str]:
        """Balances that hold as many claims as the motion can tell there."""
        count = Counter(c.balance for c in self.claims)
        return frozenset(b for b, n in count.items() if n >= limit)

    def of_full(self, ranking: Ranking, limit: int) -> frozenset[str]:
        """Labels of what would act in such a balance."""
        full = self.full(limit)
        return frozenset(t.candidate.label for t in ranking.everything if t.balance in full)


@final
@dataclass(frozen=True)
class _Decision:
    """What was decided on a fitted model, before it is judged and told."""

    standing: _Standing
    first: Ranking
    last: tuple[Ranking, Base] | None
    following: str | None
    unnamed: Claim | None
    decided: tuple[Claim, ...]


@final
class Session:
    """Decides what is missing from a model that a bench can fit.

    Parameters
    ----------
    bench : Bench
    progress : callable, optional
        ``progress(text, share)``.
    warnings : sequence of str
        What the check gate said about the records.
    refused : mapping of str to str
        Labels that are not taken up, with the reason.
    longer : bool
        The rows are longer than those that the answer is judged on: no error as a whole is shown
        of them, and what one balance leaves of its noise there decides on no other.
    """

    def __init__(
        self,
        bench: Bench,
        progress: Progress | None = None,
        warnings: Sequence[str] = (),
        refused: Mapping[str, str] = MappingProxyType({}),
        *,
        longer: bool = False,
    ) -> None:
        self.bench, self.joint = bench, bench.joint
        self._worse = spoilt if longer else made_worse
        self.progress: Progress = progress or (lambda text, share: None)
        self._warnings = tuple(warnings)
        self._refused = dict(refused)
        self._doubted: dict[str, str] = {}
        self._located: dict[str, str] = {}
        self._near: dict[str, Mapping[str, float]] = {}
        self._asked: set[tuple[object, ...]] = set()
        self._odds: dict[tuple[object, ...], Odds | None] = {}
        self._crowd: Claim | None = None
        self._longer: dict[tuple[object, ...], dict[str, tuple[float, float]]] = {}

    @property
    def data(self) -> Dataset:
        """The prepared records."""
        return self.bench.data

    @classmethod
    def opened(
        cls,
        records: Sequence[Record] | Record,
        joint: Joint,
        held_out: Sequence[Record] | Record = (),
        *,
        progress: Progress | None = None,
    ) -> Session:
        """A session on a joint model: records through the gate, a part held out where none are
        given.

        Raises
        ------
        InputError
            Unusable records or joint, in one line.
        """
        given = listed(records)
        apart = listed(held_out)
        if not given:
            raise InputError("no training record; give at least one")
        given, apart = gated(given, joint), gated(apart, joint)
        train, held, note = with_held_out(given, apart)
        bench = timed_bench(joint, train, held)
        bench.data = replace(bench.data, note=note)
        return cls(bench, progress, gate_warnings([*given, *apart]))

    def start(self) -> Solution:
        """The fit of the joint's own model."""
        self.progress("fitting the start model", 0.05)
        return self.bench.start()

    def diagnose(self, solution: Solution) -> Improvement:
        """The first decision on a fitted model: what `run` would add first, and what is left
        then.
        """
        return self._run(solution, 1, lean=True)

    def run(self, solution: Solution, max_additions: int = MAX_ADDITIONS) -> Improvement:
        """Add what is missing from a fitted model, at most `max_additions` effects."""
        return self._run(solution, max_additions, lean=False)

    def first_addition(self, solution: Solution) -> Step | None:
        """The step that the first decision on a fitted model ends with; None where it adds
        nothing, or the records cannot carry the question.

        Raises
        ------
        InputError
            Records in unlike units, with a model that fails on them.
        """
        start = self.bench.step(None, None, solution)
        if self._unanswerable(start):
            return None
        standing = self._decide(start, 1, lean=True).standing
        return standing.now if standing.claims else None

    def _run(self, solution: Solution, most: int, *, lean: bool) -> Improvement:
        start = self.bench.step(None, None, solution)
        self.progress("ranking the library", 0.15)
        why = self._unanswerable(start)
        if why:
            return self._without_answer((start,), why)
        told = self._decide(start, most, lean=lean)
        found = self.finish(
            told.first,
            told.last,
            told.standing.steps,
            told.standing.claims,
            following=told.following,
            unnamed=told.unnamed,
        )
        return replace(found, decided=told.decided)

    def _decide(self, start: Step, most: int, *, lean: bool) -> _Decision:
        """What to add to the model of a step, at most so many effects, and of each balance no more
        than the motion can tell: the others are equations of their own.
        """
        limit = claim_limit(self.data)
        standing, solution = _Standing((start,)), start.solution
        self.bench.listen(start)
        base = self.bench.base(solution)
        first = ranking = self.bench.ranking(
            base, progress=self._within(0.15, 0.05 if not lean else 0.45)
        )
        late, unnamed, aside = False, None, set[str]()
        decided: list[Claim] = []
        stale = False
        for _ in range(ATTEMPTS):
            if len(standing.claims) >= most:
                break
            ranking = self._confirmed(ranking, base, standing.now)
            out = self._out(ranking, aside) | standing.of_full(ranking, limit)
            best = ranking.best(out)
            may_move = not late and not self.data.sensing.one_sided
            over = max(e.ratio for e in standing.now.held_out.balances.values()) > RATIO_LIMIT
            if best is None:
                slower = self._at_slower(standing, limit)
                if slower is not None:
                    standing = slower
                    decided.append(slower.claims[-1])
                    base = self.bench.base(standing.now.solution)
                    ranking = self.bench.ranking(base)
                    continue
            if best is None and may_move and over:
                late = True
                ranking = self.bench.ranking(base, late=True)
                out = self._out(ranking, aside) | standing.of_full(ranking, limit)
                best = ranking.best(out)
            if best is None:
                cleared = self._without_wrong(standing, decided=lean)
                if cleared is None:
                    break
                standing = cleared
                base = self.bench.base(standing.now.solution)
                ranking = self.bench.ranking(base)
                continue
            names = confusion_set(best, ranking.everything, base)
            best = simplest(best, names, ranking, out)
            best, names = self._by_whole_fit(best, names, ranking, standing.now, out)
            claim = make_claim(best, ranking, base, shortened(names, ranking))
            label = best.candidate.label
            self._near[label] = _behind(best, ranking)
            if len(claim.effects) > LARGEST_SET:
                best, claim = self._fewer(best, claim, ranking, base, standing.now)
                label = best.candidate.label
            if len(claim.effects) > LARGEST_SET:
                unnamed = unnamed or claim
                for t in ranking.everything:
                    if t.key in claim.effects:
                        aside.add(t.candidate.label)
                        self._doubted[t.candidate.label] = _too_many(claim.effects)
                continue
            share = len(standing.claims) / most
            self.progress(f"adding {best.key}", 0.2 + 0.6 * share if not lean else 0.65)
            told = self._told_apart(claim, best, standing)
            if told is not None:
                standing = told
                base = self.bench.base(standing.now.solution)
                ranking = self.bench.ranking(base)
                continue
            after = self.bench.added(best, standing.now)
            drop = held_drop(standing.now.held_out, after.held_out, claim.balance)
            fall = self._fall(standing.now, after, claim.balance)
            asked = f"on held-out records after the whole fit ({LEAST_ADDED_DROP:g} % asked)"
            little = (
                f"lowers the {claim.balance} balance by {fall:.2g} % {asked}"
                if fall < LEAST_ADDED_DROP
                else ""
            )
            worse = little or self._worse(standing.now.held_out, after.held_out)
            if worse:
                self._refused[label] = worse
                continue
            accepted = replace(claim, held_out_drop_percent=drop)
            decided.append(accepted)
            standing = self._instead(claim, after, standing) or _Standing(
                (*standing.steps, after), (*standing.claims, accepted)
            )
            if len(standing.claims) > 1:
                standing = self._in_nearer_form(self._revise(standing))
            # what comes after the last addition of a diagnosis matters only where something is left
            stale = lean and unnamed is None and not self._over(standing.now)
            if not stale:
                base = self.bench.base(standing.now.solution)
                share = len(standing.claims) / most
                ranking = self.bench.ranking(base, progress=self._within(0.2 + 0.6 * share, 0.0))
        if len(standing.claims) >= most:
            standing = self._without_wrong(standing, decided=lean) or standing
        left = None
        if len(standing.claims) >= most and not stale:
            left = ranking.best(frozenset(self._refused))
        elif standing.full(limit) and not stale:
            left = ranking.best(self._out(ranking, aside))
        stopped = None
        if left is not None:
            title = left.candidate.effect.title
            stopped = (
                f"One effect is added at a time: {title} would be the next (irj improve goes on)."
                if lean  # nobody has set a limit
                else f"Stopped at the limit of additions ({len(standing.claims)}): {title} "
                "would be the next."
            )
        if standing.claims:
            standing, ranking, base = self._by_whole_fits(
                standing, ranking, base, stale=stale, crowded=stopped is None
            )
        if standing.claims and stopped is None and not lean:
            by_curves = self._by_curves(standing, decided)
            if by_curves is not None:
                standing = by_curves
                base = self.bench.base(standing.now.solution)
                ranking = self.bench.ranking(base)
            if by_curves is not None and standing.claims:
                standing, ranking, base = self._by_whole_fits(
                    standing, ranking, base, stale=False, crowded=True
                )
        unnamed = unnamed or self._crowd
        if unnamed is not None and not any(
            t.key in unnamed.effects and t.candidate.label in ranking.significant
            for t in ranking.everything
        ):
            unnamed = None  # an addition has taken it along
        last = None if lean else (ranking, base)
        return _Decision(standing, first, last, stopped, unnamed, tuple(decided))

    def named(self, solution: Solution, label: str) -> Odds | None:
        """Whole fits of the names that may stand for one part of a fitted model, however it came
        into it; None where the library tells of none there.

        Parameters
        ----------
        solution : Solution
        label : str
            Of a part that no other one needs.
        """
        mark = (solution.model.structure, label)
        if mark not in self._odds:
            less = without(solution.model, label)
            base = self.bench.base(self.bench.fitted(less, solution.values, again=True))
            ranking = self.bench.ranking(base)
            trial = next((t for t in ranking.everything if t.candidate.label == label), None)
            if trial is None:
                self._odds[mark] = None
            else:
                names = shortened(confusion_set(trial, ranking.everything, base), ranking)
                claim = make_claim(trial, ranking, base, names)
                self._odds[mark] = self.bench.odds(
                    claim,
                    _behind(trial, ranking),
                    self.bench.step(None, None, solution),
                    self.bench.ranking(self.bench.base(solution)),
                )
        return self._odds[mark]

    def finish(
        self,
        first: Ranking,
        last: tuple[Ranking, Base] | None,
        steps: Sequence[Step],
        claims: Sequence[Claim],
        *,
        following: str | None = None,
        unnamed: Claim | None = None,
    ) -> Improvement:
        """The result for these steps and claims: lines, minor effects, where it still fails,
        verdict.

        Parameters
        ----------
        first : Ranking
            The one of the start model.
        last : (Ranking, Base), optional
            Those of the last step; without them no minor effect is looked for.
        steps, claims
            A step for the start model and one for each claim.
        following : str, optional
            What would be added next, and why it was not.
        unnamed : Claim, optional
            A set too large to be a name.

        Raises
        ------
        InputError
            Records in unlike units, with a start model that fails on them.
        """
        why = self._unanswerable(steps[0])
        if why:
            return self._without_answer(steps, why)
        self.progress("looking at what is left", 0.85)
        end = steps[-1]
        solution = end.solution
        ratios = self.bench.ratios(end)
        over = any(not e.ratio <= RATIO_LIMIT for e in ratios.values())
        lines = self.bench.lines(end) if over or last is not None else []
        minor: tuple[Claim, ...] = ()
        if last is not None:
            told = {n for c in claims for n in c.effects}
            small = [
                t
                for t in minor_claims(*last)
                if t.key not in told and self.bench.same_sign(t, solution)
            ]
            minor = tuple(
                Claim((t.key,), t.candidate.label, t.balance, t.held_out_drop_percent)
                for t in small
            )
        error = replace(end.held_out, balances=ratios)
        where = self.bench.places(end, error, lines, RATIO_LIMIT) if over else []
        # a curve stands for what no name explains: not while a name would be the next
        learned = self.bench.learned(end, error) if over and following is None else ()
        judged = [
            self._partial(c, before, after, end, where)
            for c, (before, after) in zip(claims, itertools.pairwise(steps), strict=True)
        ]
        held = self._held_against(_Standing(tuple(steps), tuple(claims)))
        curves = [e.curve for e in held.values() if e.curve is not None]
        doubts = self.bench.artefacts(end, [*curves, *(c.curve for c in learned)], steps[0])
        judged = [marked(c, solution, held.get(c.label), doubts) for c in judged]
        where = self._with_frequency(where, judged, steps)
        verdict, reason = verdict_of(
            judged, where, ratios, steps, following, few=few_reversals(self.data), unnamed=unnamed
        )
        if doubts and verdict in ("complete", "nothing_missing"):
            why = "; ".join(d.sentence for d in doubts)
            verdict, reason = "unexplained", f"{reason} But {why}."
        kept, curved = self.bench.curved(end, learned)
        if curved is not None:
            reason = f"{reason} {curves_told(end, curved, len(kept))}"
        named = {c for x in judged for c in x.effects}
        shown = tuple(self.bench.shown(s) for s in steps)
        return Improvement(
            self.joint,
            self.data,
            steps=shown,
            claims=tuple(judged),
            minor=minor,
            ranking=first,
            lines=tuple(lines),
            unexplained=tuple(where),
            verdict=verdict,
            reason=reason,
            final_ratios=ratios,
            not_testable=tuple(n for n in first.not_testable if n.effect not in named),
            warnings=(
                *hardly_a_model(steps[0]),
                *excitation_warnings(self.data),
                *readings_notes(self.data, self.bench.slow_noise(end)),
                *open_notes(self.bench.left_open(end)),
                *self._about_temperature(judged),
                *([scale] if (scale := self._scale(solution)) else []),
                *without_turn(lines, self.joint),
                *unseen(solution),
                *without_link(solution),
                *without_motor(self.data),
                *longer_rows(self._longer.get(solution.model.structure, {})),
                *self._warnings,
            ),
            refused=refusals(
                first,
                {**self._doubted, **self._refused},
                judged,
                self.bench.tried(steps[0].solution),
                self.joint.kind,
            ),
            learned=learned,
            carried=kept,
            curved=curved,
        )

    # --- inside -----------------------------------------------------------------------------------

    def _scale(self, solution: Solution) -> str:
        """What torques are worth where none was recorded."""
        return without_scale(solution.model, self.data.sensing, self.joint.known)

    def _within(self, low: float, span: float) -> Progress:
        """Progress of a part of the run."""
        return lambda text, share: self.progress(text, low + span * share)

    def _over(self, step: Step) -> bool:
        """Whether a step leaves structure over the floor."""
        return any(not e.ratio <= RATIO_LIMIT for e in self.bench.ratios(step).values())

    def _unanswerable(self, start: Step) -> str:
        """Why these records cannot carry the question; empty where they can.

        Raises
        ------
        InputError
            Records in unlike units, with a start model that fails on them.
        """
        refuse_unlike(self.data, start.held_out.relative_error_percent)
        return not_identifiable(self.data)

    def _without_answer(self, steps: Sequence[Step], why: str) -> Improvement:
        """The records cannot carry the question: the steps that were made, and the reason."""
        shown = tuple(self.bench.shown(s) for s in steps)
        return Improvement(
            self.joint,
            self.data,
            steps=shown,
            claims=(),
            minor=(),
            ranking=None,
            lines=(),
            unexplained=(),
            verdict="not_identifiable",
            reason=why,
            final_ratios=self.bench.ratios(steps[-1]),
            not_testable=(),
            warnings=(*excitation_warnings(self.data), *self._warnings),
            refused=(),
        )

    def _fall(self, now: Step, after: Step, balance: str) -> float:
        """Fall of the held-out RMS by which a whole fit is judged [%]: beside a slow noise that
        explains what was left, too.
        """
        fall = judged_drop(now.held_out, after.held_out, balance)
        if slow := self.bench.slow_noise(now):
            pair = [self.bench.beside(step, slow) for step in (now, after)]
            fall = min(fall, judged_drop(pair[0], pair[1], balance))
        return fall

    def _confirmed(self, ranking: Ranking, base: Base, now: Step) -> Ranking:
        """Candidates that fail on held-out records in their linear form only are judged by whole
        fits, one after the other up to the first that passes.
        """
        for trial in nearly(ranking, base, frozenset(self._refused)):
            label = trial.candidate.label
            drop = held_drop(now.held_out, self.bench.added(trial, now).held_out, trial.balance)
            if drop >= HELD_OUT_DROP:
                break
            lowered = (
                f"lowers the {trial.balance} balance by {drop:.2g} % on held-out records "
                "after the whole fit"
            )
            self._doubted[label] = f"{lowered} ({HELD_OUT_DROP:g} % asked)"
        else:
            return ranking if ranking.significant else self._shown_elsewhere(ranking, base, now)
        passed = replace(trial, held_out_drop_percent=drop)
        # what the linear form says of the others on held-out records is no more worth than what it
        # said of this one
        others = {
            t.candidate.label
            for t in ranking.everything
            if t.balance == trial.balance and t.held_out_drop_percent < 0
        }
        renewed = tuple(
            passed
            if t.candidate.label == label
            else replace(t, held_out_drop_percent=math.nan)
            if t.candidate.label in others
            else t
            for t in ranking.everything
        )
        return replace(ranking, everything=renewed, significant=ranking.significant | {label})

    def _shown_elsewhere(self, ranking: Ranking, base: Base, now: Step) -> Ranking:
        """The ranking with the names that the training records hardly need, and that held-out ones
        fall by once they are fitted whole, and with those that another balance is against and that
        lower the residual over the noise. Asked only where nothing else is left to claim and the
        model stands over its floor.
        """
        if not self._over(now):
            return ranking
        proved: dict[str, float] = {}
        refused = frozenset(self._refused)
        for t in unproved(ranking, base, refused):
            drop = held_drop(now.held_out, self.bench.added(t, now).held_out, t.balance)
            if drop >= least_drop(t, base):
                proved[t.candidate.label] = drop
        for t in outvoted(ranking, base, refused):
            after = self.bench.added(t, now).held_out
            drop = 100 * (
                1 - after.balances[t.balance].ratio / now.held_out.balances[t.balance].ratio
            )
            if drop >= least_drop(t, base) and not self._worse(now.held_out, after):
                proved[t.candidate.label] = drop
        return replace(
            ranking,
            everything=tuple(
                replace(t, held_out_drop_percent=proved[t.candidate.label])
                if t.candidate.label in proved
                else t
                for t in ranking.everything
            ),
            significant=ranking.significant | frozenset(proved),
        )

    def _by_whole_fit(
        self,
        best: Trial,
        names: tuple[str, ...],
        ranking: Ranking,
        now: Step,
        refused: Collection[str],
    ) -> tuple[Trial, tuple[str, ...]]:
        """The best of a name and its relatives that come near it, each fitted with all that is in
        the model, and the names that this leaves.

        A trial holds the shapes of the model where they are. A gap that had to do the work of the
        missing law stands wrong; a law that corrects the gap then does better than the true one.
        """
        relatives = [
            t
            for t in ranking.trials
            if t.key != best.key
            and t.balance == best.balance
            and t.candidate.label in ranking.significant
            and t.candidate.label not in refused
            # a trial's columns say little of a law that is read backwards
            and (t.key not in names or self.data.sensing.kinematic)
            and t.score
            >= best.score
            * (
                RELATIVE_SHARE
                if t.key in best.effect.confused_with or best.key in t.effect.confused_with
                else OTHER_SHARE
            )
        ][:MOST_RELATIVES]
        if not relatives:
            return best, names
        fitted = {t.key: self.bench.added(t, now).train for t in (best, *relatives)}
        left = {k: common_rms(fitted[best.key], e, best.balance)[1] for k, e in fitted.items()}
        near = (1 + SAME_WITH_ONE_LESS / 100) * min(left.values())
        alike = [t for t in (best, *relatives) if left[t.key] <= near]
        found = min(alike, key=lambda t: (not t.effect.common, len(t.values), left[t.key]))
        if best in alike:  # the trials have told these two apart already
            found = best
        for t in (best, *relatives):
            if left[t.key] > SET_RMS * left[found.key]:
                more = 100 * (left[t.key] / left[found.key] - 1)
                self._doubted[t.candidate.label] = (
                    f"leaves {more:.3g} % more than {found.effect.title} once both are fitted with "
                    "the rest"
                )
        kept = {k for k, rms in left.items() if rms <= SET_RMS * left[found.key]}
        others = names if found.key in names else tuple(t.key for t in alike)
        # a trial holds what stands at its bound: names of one column are told apart by that
        others += tuple(t.key for t in alike if t.key in found.effect.confused_with)
        kept |= set(others) - set(left)
        kept_others = (k for k in dict.fromkeys(others) if k in kept and k != found.key)
        return found, (found.key, *kept_others)

    def _at_slower(self, standing: _Standing, limit: int) -> _Standing | None:
        """The steps with a name that only rows of a longer kernel show; None where there is none,
        or its balance holds as many as the limit.

        Asked once of a model, where nothing else is left to claim, and of the balances that stand
        over their floor there alone: what short rows show their noise does not hide. A set is asked
        on still longer rows, too: noise that makes names alike is less there.
        """
        now = standing.now.solution
        if now.model.structure in self._asked:
            return None
        self._asked.add(now.model.structure)
        shown = _standing_over(standing.now)
        longer: _Standing | None = None
        for factor in SLOWER:
            bench = self.bench.slower(factor)
            if bench is None:
                break
            if not _standing_over(bench.step(None, None, now)) - shown:  # its own fit leaves less
                continue
            slow = bench.fitted(now.model, now.values, again=True)
            there = bench.step(None, None, slow)
            over = _standing_over(there) - shown
            if not over:
                continue
            left = {b: e.ratio for b, e in there.held_out.balances.items() if b in over}
            self._longer.setdefault(now.model.structure, {}).update(
                (b, (bench.data.kernel, ratio)) for b, ratio in left.items()
            )
            found = Session(bench, refused=self._refused, longer=True).diagnose(slow)
            if (
                not found.claims
                or found.claims[0].balance not in over - standing.full(limit)
                or len(found.claims[0].effects) > LARGEST_SET
                # a whole fit has no linear form to allow for, and these are further looks
                or found.claims[0].held_out_drop_percent < MAJOR_DROP
                or (longer and not set(found.claims[0].effects) < set(longer.claims[-1].effects))
            ):
                continue
            claim = found.claims[0]
            # in part or not is said of the rows that show it: short ones have noise in its place
            claim = replace(
                claim,
                kernel=bench.data.kernel,
                partial=_hardly(claim.balance, there, found.steps[-1], found.steps[-1]),
            )
            model = with_effect(now.model, claim.label)
            start = {**now.values, **found.steps[-1].solution.values}
            after = self.bench.step(
                claim.effects[0], claim.label, self.bench.fitted(model, start, again=True)
            )
            # by how much the short rows fall or rise is their noise
            if spoilt(standing.now.held_out, after.held_out):
                continue
            if _is_nothing(claim.label, after.solution):
                self._refused[claim.label] = (
                    f"is zero in the rows of the fit; rows of {bench.data.kernel:.2g} s show it"
                )
                continue
            longer = _Standing((*standing.steps, after), (*standing.claims, claim))
            if len(claim.effects) == 1:
                break
        return longer

    def _fewer(
        self, best: Trial, claim: Claim, ranking: Ranking, base: Base, now: Step
    ) -> tuple[Trial, Claim]:
        """The same claim with the names that whole fits leave, where the trials leave too many for
        an answer: one block that no law meets makes trials alike that are hundreds of nats apart.
        """
        after = self.bench.added(best, now)
        last = self.bench.ranking(self.bench.base(after.solution))
        odds = self.bench.odds(claim, _behind(best, ranking), after, last)
        if odds is None or odds.empty or not 0 < len(odds.rivals) <= LARGEST_SET:
            return best, claim
        first = odds.rivals[0].label
        trial = next(
            (
                t
                for t in ranking.everything
                if t.candidate.label == first and first in ranking.significant
            ),
            None,
        )
        if trial is None:
            return best, claim
        self._doubted.update(odds.behind)
        return trial, make_claim(trial, ranking, base, odds.names)

    def _by_whole_fits(
        self, standing: _Standing, ranking: Ranking, base: Base, *, stale: bool, crowded: bool
    ) -> tuple[_Standing, Ranking, Base]:
        """The claims with the names that whole fits leave and how sure each is, and the ranking on
        the model that this ends with.

        A name of the model that falls out, or is much less probable than another one, gives its
        place to the one that fits best; one that is less probable than nothing at all goes.
        `stale`: the ranking is that of an earlier model; `crowded`: too many names are no answer,
        as they are where no other name is next, whose work all of them do.
        """
        self.progress("fitting the names of each claim", 0.8)
        swapped, spoiling = set[str](), set[str]()
        position = -1
        while position + 1 < len(standing.claims):
            position += 1
            claim = standing.claims[position]
            if claim.kernel is not None:
                continue
            if stale:
                base = self.bench.base(standing.now.solution)
                ranking, stale = self.bench.ranking(base), False
            odds = self.bench.odds(claim, self._near.get(claim.label, {}), standing.now, ranking)
            odds = None if odds is None else odds.without(spoiling)
            self._odds[standing.now.solution.model.structure, claim.label] = odds
            if odds is None or not odds.rivals:
                continue
            self._doubted.update(odds.behind)
            others = tuple(c for c in standing.claims if c is not claim)
            needed = any(claim.effects[0] in c.effect.needs for c in others)
            if crowded and len(odds.rivals) > LARGEST_SET and not needed:
                self._crowd = self._crowd or replace(claim, effects=odds.names)
                self._refused.update((r.label, _too_many(odds.names)) for r in odds.rivals)
                standing, stale = self._replay(others, standing), True
                position -= 1
                continue
            if odds.empty and not needed:
                self._refused[claim.label] = (
                    f"gains no more than laws that are not missing: nothing is {odds.nothing:.0%} "
                    "probable"
                )
                standing, stale = self._replay(others, standing), True
                position -= 1
                continue
            best = odds.rivals[0]
            told = replace(claim, confidence=odds.probability)
            taken = best.label in swapped or any(c.label == best.label for c in standing.claims)
            if odds.holds(claim.effects[0]) or (taken and claim.effects[0] in odds.names):
                more = [n for n in odds.names if n != claim.effects[0]]
                told = replace(told, effects=(claim.effects[0], *more))
                standing = _Standing(standing.steps, standing.with_claim(position, told))
                continue
            if taken:
                continue
            swapped.add(best.label)
            told = replace(told, effects=odds.names, label=best.label)
            made = self._replay(standing.with_claim(position, told), standing, best.solution.values)
            there = made.steps[position : position + 2]
            worse = self._worse(there[0].held_out, there[-1].held_out)
            if worse:  # as of any addition: it has learned the noise of the training records
                spoiling.add(best.label)
                self._refused[best.label] = worse
                position -= 1
                continue
            if len(made.claims) == len(standing.claims):
                if claim.label in odds.behind:
                    self._refused[claim.label] = odds.behind[claim.label]
                standing, stale = self._still_needed(made, position), True
        if stale:
            base = self.bench.base(standing.now.solution)
            ranking = self.bench.ranking(base)
        return _with_hints(standing), ranking, base

    def _still_needed(self, standing: _Standing, position: int) -> _Standing:
        """The steps without the claims behind this one that were made beside another name in its
        place, and that the trials do not show beside this one.
        """
        title = standing.claims[position].effect.title
        for claim in standing.claims[position + 1 :]:
            others = tuple(c for c in standing.claims if c.label != claim.label)
            if (
                claim.kernel is not None
                or claim.effect.stage == "structure"
                or any(claim.effects[0] in c.effect.needs for c in others)
            ):
                continue
            base, ranking = self._lacking(claim, standing)
            ranking = self._confirmed(ranking, base, self.bench.step(None, None, base.solution))
            if claim.label not in ranking.significant:
                self._refused[claim.label] = f"is not needed with {title} in the model"
                standing = self._replay(others, standing)
        return standing

    def _told_apart(self, new: Claim, trial: Trial, standing: _Standing) -> _Standing | None:
        """A name of an earlier set that asks to be added beside it: where it alone does better,
        it takes the set's place, unless both together do better still: then both are missing.
        """
        for position, claim in enumerate(standing.claims):
            if new.effects[0] not in claim.effects[1:]:
                continue
            base, ranking = self._lacking(claim, standing)
            alone = next((t for t in ranking.everything if t.candidate.label == new.label), None)
            told = (
                self._in_place(
                    position, alone, make_claim(alone, ranking, base, (alone.key,)), standing
                )
                if alone
                else None
            )
            if (
                told is not None
                and held_drop(standing.now.held_out, told.now.held_out, claim.balance)
                >= LEAST_ADDED_DROP
            ):
                both = self.bench.added(trial, standing.now).held_out
                if judged_drop(told.now.held_out, both, claim.balance) >= MAJOR_DROP:
                    continue
                self._refused[claim.label] = (
                    f"explains less than {EFFECTS[new.effects[0]].title} alone"
                )
                self._stands_for(new, claim)
                return told
        return None

    def _stands_for(self, new: Claim, old: Claim) -> None:
        """Names that gave their place are fitted whole beside the name that took it: rows in which
        this one does better may do so by chance.
        """
        near = self._near.get(new.label, {})
        self._near[new.label] = {**near, **{n: 0.0 for n in old.effects if n not in new.effects}}

    def _instead(self, new: Claim, after: Step, standing: _Standing) -> _Standing | None:
        """Another name of an earlier set that alone leaves no more than that set's first name
        with a relative of it beside it.
        """
        for position, claim in enumerate(standing.claims):
            if (
                len(claim.effects) == 1
                or new.balance != claim.balance
                or not set(EFFECTS[new.effects[0]].confused_with) & set(claim.effects)
            ):
                continue
            base, ranking = self._lacking(claim, standing)
            for name in claim.effects[1:]:
                alone = next(
                    (t for t in ranking.everything if t.key == name and t.balance == claim.balance),
                    None,
                )
                told = (
                    self._in_place(
                        position, alone, make_claim(alone, ranking, base, (name,)), standing
                    )
                    if alone
                    else None
                )
                if (
                    told is not None
                    and held_drop(after.held_out, told.now.held_out, claim.balance)
                    >= -SAME_WITH_ONE_LESS
                ):
                    self._refused[claim.label] = (
                        f"needs {EFFECTS[new.effects[0]].title} beside it to explain what "
                        f"{EFFECTS[name].title} does alone"
                    )
                    self._stands_for(told.claims[position], claim)
                    return told
        return None

    def _lacking(self, claim: Claim, standing: _Standing) -> tuple[Base, Ranking]:
        """The last model without a claim, and the library tried on it."""
        last = standing.now.solution
        base = self.bench.base(
            self.bench.fitted(without(last.model, claim.label), last.values, again=True)
        )
        return base, self.bench.ranking(base)

    def _in_place(
        self, position: int, alone: Trial, new: Claim, standing: _Standing
    ) -> _Standing | None:
        """Another effect in the place of a claim; None where an earlier one does not go with it."""
        claims = [new if i == position else c for i, c in enumerate(standing.claims)]
        made = self._replay(claims, standing, alone.values)
        return made if len(made.claims) == len(claims) else None

    def _out(self, ranking: Ranking, aside: Collection[str]) -> frozenset[str]:
        """Labels that are not taken up: refused ones, those set aside, and in a balance whose
        missing torque was seen to be a curve over one variable the laws of others.
        """
        elsewhere = {
            t.candidate.label
            for t in ranking.everything
            if t.balance in self._located and variable_of(t.effect) != self._located[t.balance]
        }
        return frozenset(self._refused) | frozenset(aside) | elsewhere

    def _without_wrong(self, standing: _Standing, *, decided: bool) -> _Standing | None:
        """The steps without the names that a curve over their own variable shows to be wrong; None
        where there are none.

        `decided`: one effect was looked for; while others are missing its curve shows them too.
        """
        if not standing.claims or (decided and self._over(standing.now)):
            return None
        held = self._held_against(standing)
        wrong = {c.label: held[c.label] for c in standing.claims if c.label in held}
        needed = {n for c in standing.claims for n in c.effect.needs}
        wrong = {label: e for label, e in wrong.items() if e.is_wrong}
        # what another claim needs shares the work of its variable with it
        wrong = {
            c.label: wrong[c.label]
            for c in standing.claims
            if c.label in wrong and c.effects[0] not in needed
        }
        if not wrong:
            return None
        for c in standing.claims:
            if c.label in wrong:
                self._refused[c.label] = f"is held against a curve: {wrong[c.label].sentence}"
                self._located[c.balance] = variable_of(c.effect)
        return self._replay([c for c in standing.claims if c.label not in wrong], standing)

    def _held_against(self, standing: _Standing) -> dict[str, Equivalence]:
        """Names against curves over their own variables, each on the rows that show it."""
        now, claims = standing.now, standing.claims
        held = dict(self.bench.held_against(claims, now))
        for kernel in {c.kernel for c in claims if c.kernel is not None}:
            slower = (self.bench.slower(factor) for factor in SLOWER)
            bench = next(b for b in slower if b is not None and b.data.kernel == kernel)
            slow = bench.fitted(now.solution.model, now.solution.values)
            there = bench.held_against(claims, bench.step(None, None, slow))
            shown = {c.label for c in claims if c.kernel == kernel}
            held = {k: e for k, e in held.items() if k not in shown}
            held.update((k, e) for k, e in there.items() if k in shown)
        return held

    def _by_curves(self, standing: _Standing, decided: Sequence[Claim]) -> _Standing | None:
        """The steps without the names of a balance that they cannot explain, where a curve over a
        variable explains it in their place; None where it is not so.

        `decided`: the claims as they were first made. What stays has that set again: it became
        smaller beside names that are gone.

        A sum of laws that each imitate a part of another one stays over the floor, and a curve
        beside them has to undo what they do. What stays: a name that is as good as the curve of its
        own variable, what hardly a joint is without, and what is no law.
        """
        over = {b for b, e in self.bench.ratios(standing.now).items() if e.ratio > RATIO_LIMIT}
        held = self._held_against(standing) if over else {}
        kept, gone = list[Claim](), list[Claim]()
        for c in standing.claims:
            is_name = len(c.effects) == 1 and c.label in held and held[c.label].is_name
            stays = is_name or c.effect.common or c.effect.stage != "law" or c.balance not in over
            stays = stays or c.kernel is not None  # these rows say little of it
            (kept if stays else gone).append(c)
        needed = {n for c in kept for n in c.effect.needs}
        if not gone or needed & {c.effects[0] for c in gone}:
            return None
        if not self._learned(standing.steps[0]):
            return None
        balances = {c.balance for c in gone}
        first = {c.label: c for c in decided}
        fewer = self._replay([first.get(c.label, c) for c in kept], standing)
        with_names, with_curves = (self._left_by_curves(s.now) for s in (standing, fewer))
        if balances <= with_names or not (balances | with_names) <= with_curves:
            return None
        for c in gone:
            self._refused[c.label] = "leaves what a curve over one variable explains without it"
        return fewer

    def _learned(self, step: Step) -> tuple[LearnedClaim, ...]:
        """Curves of what a step leaves over the floor."""
        return self.bench.learned(step, replace(step.held_out, balances=self.bench.ratios(step)))

    def _left_by_curves(self, step: Step) -> set[str]:
        """Balances that learned curves in the model of a step explain."""
        left = self.bench.ratios_with(step, self._learned(step))
        return {b for b, e in left.items() if e.ratio <= RATIO_LIMIT}

    def _revise(self, standing: _Standing) -> _Standing:
        """Judge every earlier claim given all the others: drop it, swap it, or renew its set."""
        current = list(standing.claims)
        last = standing.now.solution
        for claim in standing.claims[:-1]:
            needed = {n for c in current if c is not claim for n in c.effect.needs}
            if claim.kernel is not None:  # these rows say little of it
                continue
            if claim.effect.stage == "structure" or claim.effects[0] in needed:
                continue
            if without(last.model, claim.label).terms == last.model.terms:
                continue
            base, ranking = self._lacking(claim, standing)
            # the model that lacks the claim may fit held-out records badly for reasons of its own,
            # as a law that took over its work beyond the path: no linear form shows a fall there
            ranking = self._confirmed(ranking, base, self.bench.step(None, None, base.solution))
            same = next((t for t in ranking.everything if t.candidate.label == claim.label), None)
            best = ranking.best(frozenset(self._refused))
            position = current.index(claim)
            gone = same is None or claim.label not in ranking.significant
            if gone and (best is None or best.score < NOT_NEEDED):
                current.pop(position)
                self._refused[claim.label] = (
                    "is not needed any more once the later effects are in the model"
                )
                self._stands_for(standing.claims[-1], claim)
                return self._replay(current, standing)
            if (
                best is not None
                and best.candidate.label != claim.label
                and (same is None or best.score > same.score + SWAP_GAIN)
            ):
                names = confusion_set(best, ranking.everything, base)
                if claim.effects[0] in names:
                    continue
                renewed = make_claim(best, ranking, base, names)
                self._near[renewed.label] = _behind(best, ranking)
                self._refused[claim.label] = (
                    f"explains less than {best.candidate.effect.title} once the later effects "
                    "are in the model"
                )
                if len(renewed.effects) <= LARGEST_SET and all(
                    c.label != renewed.label for c in current
                ):
                    self._stands_for(renewed, claim)
                    current[position] = renewed
                    return self._replay(current, standing)
            if same is not None:
                self._near[claim.label] = _behind(same, ranking)
                names = confusion_set(same, ranking.everything, base)
                names = (claim.effects[0], *(n for n in names if n != claim.effects[0]))
                current[position] = replace(
                    claim, effects=names, separate_by=claim.separate_by if len(names) > 1 else None
                )
        return _Standing(standing.steps, tuple(current))

    def _in_nearer_form(self, standing: _Standing) -> _Standing:
        """The steps with the virtual work of a kinematic error, or without it, as the rows say
        beside all that is in the model. Which it is was read where the rest was missing: what is
        then left of it in the motor's balance are lines at its order that swell and fall with the
        torque, and those would be named as ripple.
        """
        started = standing.steps[0].solution.model
        if any(t.place == "torsion" for t in started.terms):
            return standing
        other = self.bench.other_form(standing.now)
        if other is None:
            return standing
        return self._replay(
            standing.claims, _Standing((*standing.steps[:-1], other), standing.claims)
        )

    def _replay(
        self,
        claims: Sequence[Claim],
        standing: _Standing,
        new: Mapping[str, float] = MappingProxyType({}),
    ) -> _Standing:
        """Steps again from the start model with the revised claims (`new`: start values of a
        label that was not in them).
        """
        steps = standing.steps
        out = [steps[0]]
        kept = []
        for claim in claims:
            before = out[-1]
            try:
                model = with_effect(before.solution.model, claim.label)
            except ValueError:
                continue
            variant = next(
                (
                    s.solution.model.virtual_work
                    for s in reversed(steps)
                    if claim.label in s.solution.model.effects
                ),
                None,
            )
            if variant is not None:
                model = replace(model, virtual_work=variant)
            known = {k: v for s in steps for k, v in s.solution.values.items()}
            solution = self.bench.fitted(
                model, {**known, **new, **before.solution.values}, again=True
            )
            after = self.bench.step(claim.effects[0], claim.label, solution)
            # what a name does to longer rows, these do not say
            fall = (
                held_drop(before.held_out, after.held_out, claim.balance)
                if claim.kernel is None
                else claim.held_out_drop_percent
            )
            kept.append(replace(claim, held_out_drop_percent=fall))
            out.append(after)
        return _Standing(tuple(out), tuple(kept))

    def _about_temperature(self, claims: Sequence[Claim]) -> tuple[str, ...]:
        if not any(EFFECTS[n].warms for c in claims for n in c.effects):
            return ()
        if self.data.sensing.has_temperature:
            return (
                "the values of thermal friction count from "
                f"{self.data.sensing.temperature_origin:.4g} K, the first sample of the "
                "first record",
            )
        return (
            "no temperature was recorded: thermal friction is judged by the time since each run "
            "started, taken as a cold start; "
            "its values are the change from cold to warm, not per kelvin",
        )

    def _partial(
        self, claim: Claim, before: Step, after: Step, last: Step, where: Sequence[Unexplained]
    ) -> Claim:
        """A claim is partial where its balance stays over the floor and it explains less than is
        left there at the end, or no more than a table over one variable.
        """
        left = next((u for u in where if u.balance == claim.balance), None)
        if left is None or claim.partial:
            return claim
        partial = _hardly(claim.balance, before, after, last) or claim.effect.stage == "late"
        if not partial and left.share_percent >= LOCATED_SHARE and not claim.effect.common:
            partial = is_absorbed(claim, left, last.solution, self.data)
        return replace(claim, partial=partial)

    def _with_frequency(
        self, where: Sequence[Unexplained], claims: Sequence[Claim], steps: Sequence[Step]
    ) -> list[Unexplained]:
        """What is left around a mode that is named in part only sits at the frequency that
        stood out before the mode was added.
        """
        out = list(where)
        for claim in claims:
            before = next((a for a, b in itertools.pairwise(steps) if b.label == claim.label), None)
            for k, u in enumerate(out):
                nowhere = u.axis is None and u.order is None and u.frequency_hz is None
                if (
                    claim.partial
                    and claim.effect.stage == "late"
                    and u.balance == claim.balance
                    and nowhere
                    and before is not None
                ):
                    out[k] = replace(
                        u, frequency_hz=spectral_peak(before.solution, self.data, u.balance)
                    )
        return out


def timed_bench(
    joint: Joint,
    train: Sequence[Record],
    held: Sequence[Record],
    *,
    kernel: float | None = None,
    like: Sensing | None = None,
) -> JointBench:
    """A joint model with its records, their clocks set beside what is missing first.

    A fit that lacks a law leans to whatever stands in for it, and a clock does: a drive that comes
    through a low-pass was read as one that waits because of a ripple, and what that left was given
    a second name. So where the first decision names something and structure is left, the clocks
    are asked again with that name in the model. And where a scale is missing, no filter fits and
    half of one does, beside which nothing is named: where structure is left the first decision is
    made with the clocks of the records alone, too, whose coefficients are free, and the clocks stay
    with which it leaves less. A drive that is later than a clock may be waits for a part of it and
    is filtered for the rest as any other: the delay that is named for it is asked for its parts.

    Parameters
    ----------
    joint : Joint
    train, held : sequence of Record
        Checked (:func:`identification.data.check.gate.gated`).
    kernel, like
        See :func:`identification.balance.dataset.load_dataset`.

    Raises
    ------
    InputError
        Unusable records.
    """
    model = prepared_model(joint, train[0])
    data = dataset_of(train, held, joint, model, kernel=kernel, like=like)
    ask = partial(dataset_of, train, held, joint, model, kernel=data.kernel, like=like)
    bench = JointBench(joint, data, train, held, like=like)
    if not held:  # nothing is decided without held-out records
        return bench
    try:
        start = bench.start()
        if not places_of(model) or _cleared(bench, bench.step(None, None, start)):
            return bench
        added = Session(bench).first_addition(start)
        if not _cleared(bench, added):
            apart = ask(alone=True)
            if shifts_of(apart) != shifts_of(bench.data):
                rival = JointBench(joint, apart, train, held, like=like)
                other = Session(rival).first_addition(rival.start())
                if _left(rival, other) < (1 - BETTER) * _left(bench, added):
                    bench, added = rival, other
    except InputError:  # refused by the verb that asks
        return bench
    if added is None or _cleared(bench, added):
        return bench
    was = shifts_of(bench.data)
    data = ask(beside=(_with_late_drive(bench, added.solution), was))
    return bench if shifts_of(data) == was else JointBench(joint, data, train, held, like=like)


def _with_late_drive(bench: Bench, solution: Solution) -> Solution:
    """A fit whose drive is as late as the rows have it: a clock that stands at its bound is in its
    place a delay, which has none.

    What is later than a logger can be is to be named, but that it waits for a part of it and is
    filtered for the rest is known before its name.
    """
    model, train = solution.model, bench.data.train
    moving = within_limits(model, train, solution.values)
    if HOLD_NAME not in model.calibration or all(of_run(HOLD_NAME, w) in moving for w in train):
        return solution
    late = solution.values[HOLD_NAME]
    named = with_effect(model, DRIVE_DELAY)
    begin = dict.fromkeys(named.named("delay", "drive"), late)
    return bench.fitted(named, {**solution.values, **begin}, again=True)


def _cleared(bench: Bench, step: Step | None) -> bool:
    """Whether nothing is left of any balance after a step."""
    return step is not None and all(e.ratio <= RATIO_LIMIT for e in bench.ratios(step).values())


def _left(bench: Bench, step: Step | None) -> float:
    """What is left over noise on held-out records, in all balances, after a step or, where that
    added nothing, with the start model.
    """
    step = step or bench.step(None, None, bench.start())
    return math.prod(max(e.ratio, 1.0) for e in bench.ratios(step).values())


def _hardly(balance: str, before: Step, after: Step, last: Step) -> bool:
    """Whether a step explains less of a balance than is left there over the floor at the end."""
    old, new, end = (s.held_out.balances[balance] for s in (before, after, last))
    own = max(old.rms**2 - new.rms**2, 0.0)
    over = max(end.rms**2 - end.floor**2, 0.0)
    return own < EXPLAINED_SHARE * (own + over)


def _is_nothing(label: str, solution: Solution) -> bool:
    """Whether all amplitudes of an effect of a fitted model are zero."""
    term = next(t for t in solution.model.terms if t.label == label)
    pairs = zip(term.names, term.effect.parameters, strict=True)
    return not any(solution.values[n] for n, p in pairs if not p.is_shape)


def _standing_over(step: Step) -> set[str]:
    """Balances of a step that stand over their floor on held-out records, as its rows read them."""
    return {b for b, e in step.held_out.balances.items() if e.ratio > RATIO_LIMIT}


def _behind(best: Trial, ranking: Ranking) -> dict[str, float]:
    """By how much the trial of each other name in the same balance is behind [nats]."""
    return {
        t.key: best.score - t.score
        for t in reversed(ranking.everything)
        if t.balance == best.balance and t.key != best.key and t.score > 0
    }


def _too_many(names: Sequence[str]) -> str:
    """Why a name of a set is not claimed."""
    return f"is one of {len(names)} names that explain the same: too many to be an answer"


def _with_hints(standing: _Standing) -> _Standing:
    """The claims with the hint that belongs to the names that are left of each."""
    return _Standing(standing.steps, tuple(c.with_hint() for c in standing.claims))
