"""Explore: score all variants of a joint's model, fit the best of them, and hold them against
each other.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, final

import numpy as np

from casadi_models import JointModel
from casadi_models.transmission import MODELS
from identification.balance.balances import Balances
from identification.balance.calibration import unknowns_of
from identification.balance.dataset import visible_labels, without
from identification.balance.sensing import adapt, sense
from identification.data.joint_file import Joint
from identification.data.record import Record, listed
from identification.diagnosis.bench import Progress
from identification.diagnosis.candidates import NotTestable
from identification.diagnosis.improvement import Improvement
from identification.diagnosis.learned import with_curves
from identification.diagnosis.session import Session
from identification.errors import InputError
from identification.fitting.engine import Solution, reweighed
from identification.variants.choice import TIE_MARGIN, front_of, judged, tied_with_best
from identification.variants.exploration import (
    Exploration,
    StandIn,
    Variant,
    agreement_of,
    title_of,
)
from identification.variants.ground import Ground, JointGround
from identification.variants.lattice import (
    Node,
    added_to,
    assembled,
    missing_from,
)
from identification.variants.refit import (
    Held,
    Refit,
    Weighting,
    blocks_of,
    held_of,
    physical,
    with_size,
)
from identification.variants.screen import EARNED, LARGEST, Scored, Screen

SHOWN: Final = 40
"""Variants of the screen that are fitted: on simulated joints the best after the fit was among the
first thirty."""
OF_EACH_SIZE: Final = 3
"""Variants of each number of effects among them: the front needs the small ones too."""
SWAPS: Final = 8
"""Exchanges of a part of the best variant among them."""
FIRST: Final = 3
"""Variants that are fitted to find the point about which the screen is made again."""
ROUNDS: Final = 2
"""Expansions about a fitted variant with further parts."""
NAMINGS: Final = 3
"""Variants whose parts are asked for their names, one after the other, at most: where names fall
out of the best one another is the best; a third one never was on the simulated joints."""
FURTHER: Final = 2
"""Parts that are tried at once to find the point of expansion, and beside the best variant."""


def explore(
    records: Sequence[Record] | Record,
    joint: Joint,
    held_out: Sequence[Record] | Record = (),
    *,
    progress: Progress | None = None,
) -> Exploration:
    """Score all variants of a joint's model and fit the best of them.

    Parameters
    ----------
    records : Record or sequence of Record
        Training records.
    joint : Joint
        What is known, and the model about which variants are made.
    held_out : Record or sequence of Record
        Records that no fit sees; without them blocks of the training records are held out.
    progress : callable, optional
        ``progress(text, share)``.

    Raises
    ------
    InputError
        Unusable records or joint, in one line; records that cannot carry the question.
    """
    session = Session.opened(records, joint, held_out, progress=part_of(progress, 0.0, 0.3))
    start = session.start()
    improvement = session.run(start)
    if improvement.ranking is None:
        raise InputError(improvement.reason)
    ground = JointGround(session, listed(records)[0])
    return Search(ground, start, part_of(progress, 0.3, 0.7)).result(improvement)


def part_of(progress: Progress | None, low: float, span: float) -> Progress:
    """A progress that moves over a part of another one's."""
    told: Progress = progress or (lambda text, share: None)
    return lambda text, share: told(text, low + span * share)


@final
class Search:
    """The fitted variants of one search, each once.

    Parameters
    ----------
    ground : Ground
    start : Solution
        The fit of the model as it stands.
    progress : callable
        ``progress(text, share)``.
    """

    def __init__(self, ground: Ground, start: Solution, progress: Progress) -> None:
        self.ground, self.session, self.start = ground, ground.session, start
        self.data, self.progress = ground.data_of(start), progress
        self.names: dict[object, str] = {}
        self.found: dict[object, Refit] = {}
        self.apart: dict[str, str] = {}
        self.screened = 0
        self.last: object = None
        self.sets: dict[str, frozenset[str]] = {}
        self.behind: list[tuple[frozenset[str], Mapping[str, str]]] = []
        self.weighting = Weighting.of(start, self.data)

    def result(self, improvement: Improvement) -> Exploration:
        """The whole search."""
        nodes, refused = self.ground.nodes(self.start.model)
        last = improvement.steps[-1].solution
        last = replace(last, model=with_size(last, added_to(self.start.model, last.model)))
        self.last = self._mark(last.model)
        laws: dict[tuple[str, bool | None], Balances] = {}
        first = self._screen(self.start, nodes, {}, 0.0, laws=laws)
        ranked = first.search(FURTHER)
        self._fit(self.start.model, self.start.values)
        self._fit(last.model, last.values)
        for scored in itertools.islice(first.worth(ranked), FIRST):
            self._fit_scored(first, scored, ())
        best = self._best()
        screen = first
        if best.solution.model.structure != self.start.model.structure:
            # once more about the best, on its weights: what was fitted so far is fitted again
            data = self.ground.data_of(best.solution)
            like = reweighed(best.solution, data)
            self.weighting = Weighting.of(like, data)
            self.found.clear()
            screen = self._screen(
                _restricted(self.start, like), nodes, _shapes(like), 0.3, laws=laws
            )
            self._fit(self.start.model, {**like.values, **self.start.values})
            self._fit(last.model, {**like.values, **last.values})
        self._fit_chosen(screen, screen.search(), best.solution.values)
        for _ in range(ROUNDS):
            if not self._grown():
                break
        self._neighbours()
        self._rungs()
        self._named()
        self.screened = max(self.screened, len(self.found))
        return self._told(improvement, refused)

    # --- steps ------------------------------------------------------------------------------------

    def _screen(
        self,
        solution: Solution,
        nodes: Sequence[Node],
        more: Mapping[str, Mapping[str, float]],
        share: float,
        *,
        laws: dict[tuple[str, bool | None], Balances] | None = None,
    ) -> Screen:
        base = self.ground.base(solution)
        return Screen(
            base,
            nodes,
            more,
            laws=laws,
            progress=lambda text, part: self.progress(text, share + 0.2 * part),
        )

    def _fit(
        self,
        model: JointModel,
        *starts: Mapping[str, float],
        name: str = "",
        again: bool = False,
    ) -> None:
        """Fit a variant once; one whose parts are none is passed over. `again`: once more from
        other values, and what leaves less stays.
        """
        mark = self._mark(model)
        there = self.found.get(mark)
        if there is not None and not again:
            return
        refit = self.ground.refitted(model, starts, self.weighting)
        added = added_to(self.start.model, model)
        if not np.all(np.isfinite(refit.held.rms)) or physical(refit, added, self.data):
            return
        if there is not None and not refit.cost < there.cost:
            return
        self.found[mark] = refit
        if name:
            self.names[mark] = name

    def _fit_scored(
        self, screen: Screen, scored: Scored, also: Sequence[Mapping[str, float]]
    ) -> None:
        model = assembled(screen.base.solution.model, screen.parts(scored.options))
        if model is None:
            return
        start = screen.start_of(scored.options)
        amplitudes = {
            n: start[n] for p in screen.parts(scored.options) for n in p.candidate.amplitudes
        } | {n: x for k in scored.options for n, x in screen.options[k].shapes.items()}
        self._fit(model, start, *({**values, **amplitudes} for values in also))

    def _fit_chosen(
        self, screen: Screen, ranked: Sequence[Scored], best: Mapping[str, float]
    ) -> None:
        """Fit the first variants of the screen, the first of each size, and exchanges in the
        best.
        """
        self.screened = max(self.screened, len(ranked))
        chosen = list(itertools.islice(screen.worth(ranked), SHOWN))
        for size in range(1, LARGEST + 1):
            here = (s for s in ranked if len(s.options) == size and screen.real(s.options))
            chosen += itertools.islice(here, OF_EACH_SIZE)
        if chosen[0].options:
            swaps = (s for s in screen.swapped(chosen[0].options) if screen.real(s.options))
            chosen += itertools.islice(swaps, SWAPS)
        for k, scored in enumerate(chosen):
            self.progress("fitting variants", 0.5 + 0.3 * k / len(chosen))
            self._fit_scored(screen, scored, (best,))

    def _grown(self) -> bool:
        """Whether parts beside the best variant make a better one.

        Parts that may lower the error by enough to be told as a tie are fitted beside it, whatever
        their price.
        """
        now = self._best()
        nodes, _ = self.ground.nodes(now.solution.model)
        screen = self._screen(now.solution, nodes, {}, 0.8)
        ranked = screen.search(FURTHER)
        grown = (s for s in ranked if s.options and screen.real(s.options))
        for scored in itertools.islice(grown, FIRST):
            self._fit_scored(screen, scored, ())
        for scored in screen.lowering(ranked, EARNED * TIE_MARGIN):
            model = assembled(now.solution.model, screen.parts(scored.options))
            if model is not None:  # a worse valley would have it fall out
                self._fit(model, *map(screen.start_of, screen.grid_of(scored)), again=True)
        return self._best() is not now

    def _neighbours(self) -> None:
        """The best variant with one part less, from its values: a variant that was fitted from
        other ones may stand in a worse valley, and a part that is none would be what leads out.
        """
        for _ in range(ROUNDS):
            now = self._best()
            for label in self.ground.droppable(now.solution.model):
                self._fit(without(now.solution.model, label), now.solution.values, again=True)
            if self._best() is now:
                break

    def _named(self) -> None:
        """Whole fits of the names that may stand for each part of the best variant, as `improve`
        asks them.

        The price of a parameter asks whether something is missing. Which law it is the records may
        tell for certain where its parameters take less than their price off.
        """
        for _ in range(NAMINGS):
            best = self._best()
            model = best.solution.model
            added = set(added_to(self.start.model, model))
            solution = self.session.bench.fitted(model, best.solution.values)
            self.sets = {}
            for label in self.ground.droppable(model):
                if label not in added:
                    continue
                self.progress(f"names in the place of {label}", 0.95)
                odds = self.session.named(solution, label)
                if odds is None or not odds.alike:
                    continue
                for rival in odds.alike:  # these were looked for in every valley
                    self._fit(rival.solution.model, rival.solution.values, again=True)
                # whether anything is missing there at all the score has told
                left = frozenset(r.label for r in odds.alike)
                fallen = {n: why for n, why in odds.behind.items() if n not in left}
                self.sets[label] = left
                self.behind.append((left, fallen))
            if self._best() is best:
                break

    def _why_behind(self, refit: Refit) -> str:
        """Why a variant is out of the question for one of its names; empty where it is not."""
        labels = set(visible_labels(refit.solution.model))
        for left, behind in self.behind:
            fallen = labels & behind.keys()
            if fallen and not labels & left:
                label = min(fallen)
                return f"{title_of(label)} {behind[label]}"
        return ""

    def _rungs(self) -> None:
        """The models by name, with the joint's own effects, where the channels show the same
        balances.
        """
        joint = self.session.joint
        sensing = self.data.sensing
        own = visible_labels(self.start.model)
        record = self.ground.ladder
        if record is None:
            return
        for name in MODELS:
            model = JointModel.by_name(
                name, joint.gear_ratio, kind=joint.kind, effects=joint.effects
            )
            if set(visible_labels(model)) == set(own):
                continue
            try:
                shows = set(sense(record, model).balances)
            except InputError as error:
                self.apart[name] = str(error)
                continue
            if not shows <= set(sensing.balances):
                self.apart[name] = (
                    "shows other balances of these records: give it as the model of the joint file"
                )
                continue
            if self.start.model.is_elastic and not model.is_elastic:
                # the twist is what these channels show, so a rigid model gets one, as the start did
                model = adapt(model, sensing, joint.known)
            prepared = replace(
                self.start.model,
                terms=(
                    *model.terms,
                    *(t for t in self.start.model.terms if t.label not in own),
                ),
                inertias=self.start.model.inertias,
                values={**self.start.model.values, **model.values},
            )
            prepared = replace(prepared, calibration=unknowns_of(prepared, sensing))
            try:
                self._fit(prepared, {**self.start.values, **model.values}, name=name)
            except (InputError, ValueError, np.linalg.LinAlgError):
                continue

    def _mark(self, model: JointModel) -> object:
        return frozenset(visible_labels(model)), model.inertias

    def _best(self) -> Refit:
        every = list(self.found.values())
        return every[judged(every, [self._open_to(r) for r in every]).best]

    def _open_to(self, refit: Refit) -> bool:
        """Whether a variant may be recommended."""
        return self._whole(refit) and not self._why_behind(refit)

    def _whole(self, refit: Refit) -> bool:
        """Whether a variant has every effect of the joint's own model: what the joint file says is
        there is no question here.
        """
        return not missing_from(self.start.model, refit.solution.model)

    # --- what is told -----------------------------------------------------------------------------

    def _told(self, improvement: Improvement, refused: tuple[NotTestable, ...]) -> Exploration:
        refits, marks = list(self.found.values()), list(self.found)
        own = self.found[self._mark(self.start.model)]
        whole = [self._whole(r) for r in refits]
        open_to = [self._open_to(r) for r in refits]
        scores = judged(refits, open_to, blocks_of(self.data))
        best = scores.best
        parts = [frozenset(visible_labels(r.solution.model)) for r in refits]
        tied = tied_with_best(scores, open_to, parts, self.sets)
        variants = [
            Variant(
                self._name(refit, self.names.get(mark, "")),
                visible_labels(refit.solution.model),
                added=added_to(self.start.model, refit.solution.model),
                dropped=missing_from(self.start.model, refit.solution.model),
                parameters=refit.parameters,
                relative_error_percent=refit.held.relative_error_percent,
                error_percent=_of_start(refit.held, own.held),
                score=float(scores.score[k] - scores.score[best]),
                tied=tied[k],
                chosen_percent=100 * float(scores.chosen[k]),
                solution=refit.solution,
                behind=self._why_behind(refit) if whole[k] else "",
            )
            for k, (mark, refit) in enumerate(zip(marks, refits, strict=True))
        ]
        curve = self._curved(improvement, own)
        shown = [*variants, *([curve] if curve is not None else [])]
        # what lacks an effect that the joint file knows of, or has a name that whole fits rule out,
        # is no answer, and beats none
        asked = [k for k, v in enumerate(shown) if not v.dropped and not v.behind]
        front = front_of(
            [shown[k].parameters for k in asked], [shown[k].error_percent for k in asked]
        )
        order = sorted(
            range(len(variants)), key=lambda k: (not whole[k], not open_to[k], scores.score[k])
        )
        balances = own.held.rms.size
        recommended = variants[best]
        stand_ins = []
        for k in order:
            gone = parts[best] - parts[k]
            came = parts[k] - parts[best]
            if len(gone) == 1 and len(came) == 1 and gone <= set(recommended.added):
                rise = float(scores.error[k] - scores.error[best])
                lost = 100 * (math.exp(rise / balances) - 1)
                (effect,), (by,) = gone, came
                stand_ins.append(StandIn(effect, by, lost, tied[k]))
        improved = next((variants[k] for k, m in enumerate(marks) if m == self.last), None)
        return Exploration(
            self.session.joint,
            self.data,
            variants=(*(variants[k] for k in order), *shown[len(variants) :]),
            screened=self.screened,
            front=tuple(shown[asked[k]] for k in front),
            recommended=recommended,
            ties=tuple(variants[k] for k in order if tied[k]),
            windows=tuple(variants[k].name for k in scores.windows),
            by_record=tuple(
                (name, variants[k].name)
                for name, k in zip(
                    (*self.data.train_names, *self.data.held_out_names),
                    scores.records,
                    strict=True,
                )
            ),
            stand_ins=tuple(stand_ins),
            improvement=improvement,
            improved=improved,
            agreement=agreement_of(improvement, improved, recommended, self.start.model),
            not_testable=refused,
            apart=self.apart,
            spare=tuple(
                v.dropped[0]
                for v in variants
                if v.added == recommended.added and len(v.dropped) == 1 and v.score < 0
            ),
        )

    def _curved(self, improvement: Improvement, own: Refit) -> Variant | None:
        """The last model of `improve` with its learned curves, where they lower the error: what no
        name explains.
        """
        last = improvement.steps[-1].solution
        refit = self.found.get(self.last)
        if not improvement.learned or refit is None:
            return None
        solution = with_curves(last, improvement.learned)
        held = held_of(solution, self.data, self.weighting)
        if not _of_start(held, refit.held) < 100:  # no curve beyond the steady rows it was drawn on
            return None
        freedom = sum(c.curve.freedom for c in improvement.learned)
        added = added_to(self.start.model, solution.model)
        return Variant(
            " ".join(f"+ {label}" for label in added),
            visible_labels(solution.model),
            added=added,
            dropped=(),
            parameters=refit.parameters + math.ceil(freedom),
            relative_error_percent=held.relative_error_percent,
            error_percent=_of_start(held, own.held),
            score=math.nan,
            tied=False,
            chosen_percent=0.0,
            solution=solution,
        )

    def _name(self, refit: Refit, name: str) -> str:
        model = refit.solution.model
        if name:
            return name
        added = added_to(self.start.model, model)
        dropped = missing_from(self.start.model, model)
        told = [f"+ {label}" for label in added] + [f"- {label}" for label in dropped]
        return " ".join(told) or "start model"


def _of_start(held: Held, start: Held) -> float:
    """Held-out error in percent of that of the joint's own model, mean of the balances'
    logarithms.
    """
    return 100 * float(np.exp(np.mean(np.log(held.rms / start.rms))))


def _restricted(start: Solution, like: Solution) -> Solution:
    """The joint's own model at the values, and with the weights, that a bigger one has."""
    values = {n: like.values.get(n, x) for n, x in start.values.items()}
    return replace(
        start,
        values=values,
        weights=like.weights,
        sigma=like.sigma,
        at_bound=tuple(n for n in like.at_bound if n in start.free),
    )


def _shapes(solution: Solution) -> dict[str, dict[str, float]]:
    """By label, the shapes that a fit has found."""
    out = {}
    for term in solution.model.terms:
        pairs = zip(term.names, term.effect.parameters, strict=True)
        shapes = {n: float(solution.values[n]) for n, p in pairs if p.is_shape}
        if shapes:
            out[term.label] = shapes
    return out
