"""The loop: fit, see where it fails, name what is missing, add it, fit again, until nothing is left to name."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Final, final

from casadi_models import EFFECTS, JointModel
from identification.assess import VERDICT_KERNELS, BalanceError, assess
from identification.candidates import LATE
from identification.claims import (
    COMMON,
    HELD_OUT_DROP,
    LADDER_STEP,
    LARGEST_SET,
    Claim,
    Ranking,
    confusion_set,
    make_claim,
    minor_claims,
    nearly,
    rank,
    shortened,
    simplest,
)
from identification.dataset import HOLD_DELAY, with_effect, without
from identification.engine import Dataset, Solution, load_dataset, prepared_model, solve
from identification.errors import InputError
from identification.excitation import excitation_warnings, few_reversals, not_identifiable, unlike_units
from identification.improvement import Improvement, Step, held_drop, judged_drop, made_worse, ranked_json, visible_keys, visible_labels
from identification.joint_file import Joint
from identification.lines import find_lines
from identification.locate import Unexplained, locate, spectral_peak
from identification.record import Record
from identification.rival_table import is_absorbed
from identification.trials import Base, Trial, make_base, try_candidate
from identification.verdict import hardly_a_model, verdict_of, without_link

__all__ = [
    "HOLD_DELAY", "RATIO_LIMIT", "Improvement", "Step", "excitation_warnings", "held_drop", "improve", "ranked_json",
    "visible_keys", "visible_labels", "with_held_out",
]  # fmt: skip

MAX_ADDITIONS: Final = 6
RATIO_LIMIT: Final = 1.5

EXPLAINED_SHARE: Final = 0.5
LOCATED_SHARE: Final = 50.0
"""Share of what is left that one variable must hold before a table over it is set against the claims [%]."""
NO_MODEL: Final = 50.0
"""Held-out error of the start model from which records that move as far apart as degrees and radians are refused [%]."""
SAME_WITH_ONE_LESS: Final = 5.0
"""Rise of a balance's RMS up to which one effect does as well as two [%]."""
SWAP_GAIN: Final = 3.0

Progress = Callable[[str, float], None]


def improve(
    records: Sequence[Record] | Record, joint: Joint, held_out: Sequence[Record] = (), *,
    max_additions: int = MAX_ADDITIONS, progress: Progress | None = None,
) -> Improvement:  # fmt: skip
    """Find the missing effects of a joint model, add them and measure the error on held-out records.

    Parameters
    ----------
    records : Record or sequence of Record
        Training records.
    joint : Joint
        What is known, and the start model (see :func:`identification.joint_file.load_joint`).
    held_out : sequence of Record
        Records that the fit never sees; without them blocks of the training records are held out.
    max_additions : int
    progress : callable, optional
        ``progress(text, share)``.

    Raises
    ------
    InputError
        Unusable records or joint, in one line.
    """
    train = [records] if isinstance(records, Record) else list(records)
    if not train:
        raise InputError("no training record; give at least one")
    train, held, note = with_held_out(train, list(held_out))
    model = prepared_model(joint, train[0])
    data = replace(load_dataset(train, held, joint, model), note=note)
    return Loop(joint, data, train, held, progress or (lambda text, share: None)).run(model, max_additions)


def with_held_out(train: list[Record], held_out: list[Record]) -> tuple[list[Record], list[Record], str]:
    """Training and held-out records; without given ones the last 30 % of the time blocks are held out."""
    if held_out:
        return train, held_out, ""
    pairs = [r.split(0.7) for r in train]
    note = "no held-out records given: the last 30 % of each training record (or of its runs) is held out"
    return [p[0] for p in pairs], [p[1] for p in pairs], note


@final
class Loop:
    """State of one run of the loop."""

    def __init__(self, joint: Joint, data: Dataset, train: list[Record], held: list[Record], progress: Progress) -> None:
        self.joint, self.data, self.progress = joint, data, progress
        self._train, self._held = train, held
        self.refused: set[str] = set()
        self.refusals: dict[str, str] = {}
        self._solved: dict[tuple[object, ...], Solution] = {}

    def _solve(self, model: JointModel, start: Mapping[str, float]) -> Solution:
        """A fit made once per model: a candidate that was confirmed is not fitted again when it is added."""
        if model.structure not in self._solved:
            self._solved[model.structure] = solve(model, self.data, start=start)
        return self._solved[model.structure]

    def _within(self, low: float, span: float) -> Progress:
        """Progress of a part of the loop."""
        return lambda text, share: self.progress(text, low + span * share)

    def run(self, model: JointModel, max_additions: int) -> Improvement:
        """Fit `model`, then add what is missing, at most `max_additions` effects."""
        self.progress("fitting the start model", 0.05)
        steps = [self._step(None, None, solve(model, self.data))]
        claims: list[Claim] = []
        self.progress("ranking the library", 0.15)
        why = not_identifiable(self.data)
        unlike = unlike_units(self.data)
        if unlike and steps[0].held_out.relative_error_percent >= NO_MODEL:
            raise InputError(unlike)
        if why:
            return self._without_answer(steps, why)
        base = make_base(steps[-1].solution, self.data)
        first = ranking = rank(base, progress=self._within(0.15, 0.05))
        late, unnamed, aside = False, None, set[str]()
        for _ in range(2 * max_additions):
            if len(claims) >= max_additions:
                break
            ranking = self._confirmed(ranking, base, steps[-1])
            best = ranking.best(frozenset(self.refused | aside))
            may_move = not late and not self.data.sensing.one_sided
            if best is None and may_move and max(e.ratio for e in steps[-1].held_out.balances.values()) > RATIO_LIMIT:
                late = True
                ranking = rank(base, late=True)
                best = ranking.best(frozenset(self.refused | aside))
            if best is None:
                break
            names = confusion_set(best, ranking.everything, base)
            best = simplest(best, names, ranking, frozenset(self.refused | aside))
            claim = make_claim(best, ranking, base, shortened(names, ranking))
            if len(claim.effects) > LARGEST_SET:
                unnamed = unnamed or claim
                aside |= {t.candidate.label for t in ranking.everything if t.key in claim.effects}
                continue
            self.progress(f"adding {best.key}", 0.2 + 0.6 * len(claims) / max_additions)
            told = self._told_apart(claim, claims, steps)
            if told is not None:
                claims, steps = told
                base = make_base(steps[-1].solution, self.data)
                ranking = rank(base)
                continue
            before = steps[-1]
            solution = self._solve(best.candidate.model, {**before.solution.values, **best.values})
            after = self._step(best.key, best.candidate.label, solution)
            drop = held_drop(before.held_out, after.held_out, claim.balance)
            fall = judged_drop(before.held_out, after.held_out, claim.balance)
            why = f"the {claim.balance} balance falls by {fall:.2g} % after the whole fit (2 % asked)" if fall < 2.0 else ""
            why = why or made_worse(before.held_out, after.held_out)
            if why:
                self.refused.add(best.candidate.label)
                self.refusals[best.candidate.label] = why
                continue
            told = self._instead(claim, after, claims, steps)
            if told is None:
                claims.append(replace(claim, held_out_drop_percent=drop))
                steps.append(after)
            else:
                claims, steps = told
            if len(claims) > 1:
                claims, steps = self._revise(claims, steps)
            base = make_base(steps[-1].solution, self.data)
            ranking = rank(base, progress=self._within(0.2 + 0.6 * len(claims) / max_additions, 0.0))
        if unnamed is not None and not any(t.key in unnamed.effects and t.candidate.label in ranking.significant for t in ranking.everything):
            unnamed = None  # an addition has taken it along
        left = ranking.best(frozenset(self.refused)) if len(claims) >= max_additions else None
        return self.finish(first, ranking, base, claims, steps, left, unnamed)

    def _without_answer(self, steps: list[Step], why: str) -> Improvement:
        """The records cannot carry the question: the start model and the reason."""
        ratios = dict(steps[0].held_out.balances)
        return Improvement(
            self.joint, self.data, tuple(steps), (), (), None, (), (), "not_identifiable", why, ratios, (),
            excitation_warnings(self.data), (),
        )  # fmt: skip

    def _confirmed(self, ranking: Ranking, base: Base, now: Step) -> Ranking:
        """A candidate that fails on held-out records in its linear form only is judged by a whole fit."""
        trial = nearly(ranking, base, frozenset(self.refused))
        if trial is None:
            return ranking
        solution = self._solve(trial.candidate.model, {**now.solution.values, **trial.values})
        after = assess(solution.model, self.data, self.data.held_out, solution.values)
        drop = held_drop(now.held_out, after, trial.balance)
        if drop < HELD_OUT_DROP:
            return ranking
        passed = replace(trial, held_out_drop_percent=drop)
        label = trial.candidate.label
        # what the linear form says of the others on held-out records is no more worth than what it said of this one
        others = {t.candidate.label for t in ranking.everything if t.balance == trial.balance and t.held_out_drop_percent < 0}
        renewed = tuple(
            passed if t.candidate.label == label else replace(t, held_out_drop_percent=math.nan) if t.candidate.label in others else t
            for t in ranking.everything
        )
        return replace(ranking, everything=renewed, significant=ranking.significant | {label})

    def _step(self, key: str | None, label: str | None, solution: Solution) -> Step:
        train = assess(solution.model, self.data, self.data.train, solution.values)
        held = assess(solution.model, self.data, self.data.held_out, solution.values)
        return Step(key, visible_keys(solution.model), train, held, solution, label)

    def _told_apart(self, new: Claim, claims: list[Claim], steps: list[Step]) -> tuple[list[Claim], list[Step]] | None:
        """A name of an earlier set that asks to be added beside it: where it alone does better, it takes the set's place."""
        for position, claim in enumerate(claims):
            if new.effects[0] not in claim.effects[1:]:
                continue
            base, ranking = self._lacking(claim, steps)
            alone = next((t for t in ranking.everything if t.candidate.label == new.label), None)
            told = self._in_place(position, alone, make_claim(alone, ranking, base, (alone.key,)), claims, steps) if alone else None
            if told is not None and held_drop(steps[-1].held_out, told[1][-1].held_out, claim.balance) >= 2.0:
                self.refused.add(claim.label)
                return told
        return None

    def _instead(self, new: Claim, after: Step, claims: list[Claim], steps: list[Step]) -> tuple[list[Claim], list[Step]] | None:
        """Another name of an earlier set that alone leaves no more than that set's first name with a relative of it beside it."""
        for position, claim in enumerate(claims):
            if len(claim.effects) == 1 or new.balance != claim.balance or not set(EFFECTS[new.effects[0]].confused_with) & set(claim.effects):
                continue
            base, ranking = self._lacking(claim, steps)
            for name in claim.effects[1:]:
                alone = next((t for t in ranking.everything if t.key == name and t.balance == claim.balance), None)
                told = self._in_place(position, alone, make_claim(alone, ranking, base, (name,)), claims, steps) if alone else None
                if told is not None and held_drop(after.held_out, told[1][-1].held_out, claim.balance) >= -SAME_WITH_ONE_LESS:
                    self.refused.add(claim.label)
                    return told
        return None

    def _lacking(self, claim: Claim, steps: list[Step]) -> tuple[Base, Ranking]:
        """The last model without a claim, and the library tried on it."""
        last = steps[-1].solution
        base = make_base(solve(without(last.model, claim.label), self.data, start=last.values), self.data)
        return base, rank(base)

    def _in_place(self, position: int, alone: Trial, new: Claim, claims: list[Claim], steps: list[Step]) -> tuple[list[Claim], list[Step]] | None:
        """Claims and steps with another effect in the place of a claim; None where an earlier one does not go with it."""
        kept, out = self._replay([new if i == position else c for i, c in enumerate(claims)], steps, alone.values)
        return (kept, out) if len(kept) == len(claims) else None

    def _revise(self, claims: list[Claim], steps: list[Step]) -> tuple[list[Claim], list[Step]]:
        """Judge every earlier claim given all the others: drop it, swap it, or renew its set."""
        current = list(claims)
        for claim in claims[:-1]:
            needed = {n for c in current if c is not claim for n in EFFECTS[c.effects[0]].needs}
            if claim.effects[0] == LADDER_STEP or claim.effects[0] in needed:
                continue
            model = without(steps[-1].solution.model, claim.label)
            if model.terms == steps[-1].solution.model.terms:
                continue
            base, ranking = self._lacking(claim, steps)
            same = next((t for t in ranking.everything if t.candidate.label == claim.label), None)
            best = ranking.best(frozenset(self.refused))
            position = current.index(claim)
            gone = same is None or claim.label not in ranking.significant
            if gone and (best is None or best.score < 10):
                current.pop(position)
                self.refused.add(claim.label)
                self.refusals[claim.label] = "what was claimed after it leaves nothing for it to explain"
                return self._replay(current, steps)
            if best is not None and best.candidate.label != claim.label and (same is None or best.score > same.score + SWAP_GAIN):
                names = confusion_set(best, ranking.everything, base)
                if claim.effects[0] in names:
                    continue
                renewed = make_claim(best, ranking, base, names)
                self.refused.add(claim.label)
                self.refusals[claim.label] = f"given the other claims, {best.key} explains more in its place"
                if len(renewed.effects) <= LARGEST_SET and all(c.label != renewed.label for c in current):
                    current[position] = renewed
                    return self._replay(current, steps)
            if same is not None:
                names = confusion_set(same, ranking.everything, base)
                names = (claim.effects[0], *(n for n in names if n != claim.effects[0]))
                current[position] = replace(claim, effects=names, separate_by=claim.separate_by if len(names) > 1 else None)
        return current, steps

    def _replay(self, claims: list[Claim], steps: list[Step], new: Mapping[str, float] = MappingProxyType({})) -> tuple[list[Claim], list[Step]]:
        """Steps again from the start model with the revised claims (`new`: start values of a label that was not in them)."""
        out = [steps[0]]
        kept = []
        for claim in claims:
            before = out[-1]
            try:
                model = with_effect(before.solution.model, claim.label)
            except ValueError:
                continue
            variant = next((s.solution.model.virtual_work for s in reversed(steps) if claim.label in s.solution.model.effects), None)
            if variant is not None:
                model = replace(model, virtual_work=variant)
            known = {k: v for s in steps for k, v in s.solution.values.items()}
            solution = solve(model, self.data, start={**known, **new, **before.solution.values})
            after = self._step(claim.effects[0], claim.label, solution)
            kept.append(replace(claim, held_out_drop_percent=held_drop(before.held_out, after.held_out, claim.balance)))
            out.append(after)
        return kept, out

    def finish(
        self, first: Ranking, last: Ranking, base: Base, claims: list[Claim], steps: list[Step], left: Trial | None = None,
        unnamed: Claim | None = None,
    ) -> Improvement:  # fmt: skip
        """The result for these steps and claims: lines, minor effects, where it still fails, verdict."""
        self.progress("looking at what is left", 0.85)
        solution = steps[-1].solution
        ratios = self._ratios(solution)
        lines = find_lines(solution, [self._at_kernel(k) for k in self._line_kernels()] + [self.data])
        minor = tuple(self._minor(t, solution) for t in minor_claims(last, base) if self._same_sign(t, solution))
        error = replace(steps[-1].held_out, balances=ratios)
        where = locate(solution, self.data, error, lines, RATIO_LIMIT)
        claims = [self._partial(c, steps[0], steps[-1], where) for c in claims]
        where = self._with_frequency(where, claims, steps)
        verdict, reason = verdict_of(claims, where, ratios, steps, left, few_reversals(self.data), unnamed)
        return Improvement(
            self.joint, self.data, tuple(steps), tuple(claims), minor, first, tuple(lines), tuple(where), verdict, reason, ratios,
            tuple(n for n in first.not_testable if n.effect not in {c for x in claims for c in x.effects}),
            (*hardly_a_model(steps[0]), *excitation_warnings(self.data), *self._about_temperature(claims), *without_link(solution)),
            tuple(sorted(self.refused)), dict(self.refusals),
        )  # fmt: skip

    def _about_temperature(self, claims: Sequence[Claim]) -> tuple[str, ...]:
        if not any("thermal_friction" in c.effects for c in claims):
            return ()
        if self.data.sensing.has_temperature:
            return (f"the values of thermal friction count from {self.data.sensing.temperature_origin:.4g} K, the first sample of the first record",)
        return (
            "no temperature was recorded: thermal friction is judged by the time since each run started, taken as a cold start; "
            "its values are the change over one run, not per kelvin",
        )

    def _line_kernels(self) -> list[float]:
        """The shortest kernel and one between it and that of the claims."""
        shortest = max(8 * self.data.train[0].grid.dt, 0.012)
        return [k for k in (shortest, 0.03) if k < 0.7 * self.data.kernel]

    def _at_kernel(self, length: float) -> Dataset:
        """The same records with another kernel."""
        return load_dataset(self._train, self._held, self.joint, prepared_model(self.joint, self._train[0]), kernel=length)

    def _ratios(self, solution: Solution) -> dict[str, BalanceError]:
        """Residual over floor, each balance at its own kernel, on held-out records."""
        out: dict[str, BalanceError] = {}
        for length in sorted({VERDICT_KERNELS[b] for b in self.data.sensing.balances}):
            near = abs(length - self.data.kernel) < 1e-9
            data = self.data if near else self._at_kernel(length)
            error = assess(solution.model, data, data.held_out, solution.values)
            out.update({b: e for b, e in error.balances.items() if VERDICT_KERNELS[b] == length})
        return {b: out[b] for b in self.data.sensing.balances}

    def _partial(self, claim: Claim, first: Step, last: Step, where: Sequence[Unexplained]) -> Claim:
        """A claim is partial where its balance stays over the floor and it explains less than half, or no more than a table over one variable."""
        left = next((u for u in where if u.balance == claim.balance), None)
        if left is None:
            return claim
        before, after = first.held_out.balances[claim.balance], last.held_out.balances[claim.balance]
        over = before.rms**2 - before.floor**2
        share = (before.rms**2 - after.rms**2) / over if over > 0 else 1.0
        partial = share < EXPLAINED_SHARE or claim.effects[0] in LATE
        if not partial and left.share_percent >= LOCATED_SHARE and claim.effects[0] not in COMMON:
            partial = is_absorbed(claim, left, last.solution, self.data)
        return replace(claim, partial=partial)

    def _with_frequency(self, where: Sequence[Unexplained], claims: Sequence[Claim], steps: Sequence[Step]) -> list[Unexplained]:
        """What is left around a mode that is named in part only sits at the frequency that stood out before the mode was added."""
        out = list(where)
        for claim in claims:
            before = next((a for a, b in itertools.pairwise(steps) if b.label == claim.label), None)
            for k, u in enumerate(out):
                nowhere = u.axis is None and u.order is None and u.frequency_hz is None
                if claim.partial and claim.effects[0] in LATE and u.balance == claim.balance and nowhere and before is not None:
                    out[k] = replace(u, frequency_hz=spectral_peak(before.solution, self.data, u.balance))
        return out

    def _minor(self, trial: Trial, solution: Solution) -> Claim:
        return Claim((trial.key,), trial.candidate.label, trial.balance, trial.held_out_drop_percent)

    def _same_sign(self, trial: Trial, solution: Solution) -> bool:
        """A minor effect must have the same sign at half and at double kernel."""
        for factor in (0.5, 2.0):
            data = self._at_kernel(self.data.kernel * factor)
            other = solve(solution.model, data, start=solution.values)
            found = try_candidate(trial.candidate, make_base(other, data))
            if not isinstance(found, Trial):
                return False
            name = max(trial.candidate.amplitudes, key=lambda n: abs(trial.values[n]))
            if trial.values[name] * found.values[name] <= 0:
                return False
        return True
