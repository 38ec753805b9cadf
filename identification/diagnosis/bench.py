"""What a session asks of a model and its records: fits, trials and what is left, behind one
interface.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Protocol, final

import numpy as np

from casadi_models import JointModel
from identification.balance.calibration import settled
from identification.balance.dataset import FEWEST_ROWS, without
from identification.balance.sensing import Sensing
from identification.balance.slow_noise import SlowNoise
from identification.balance.stacked import slow_noise_beside
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.diagnosis.candidates import offered
from identification.diagnosis.claims import Claim, Ranking, rank
from identification.diagnosis.curve import Curve
from identification.diagnosis.improvement import Step, visible_keys
from identification.diagnosis.learned import (
    LEARNED,
    Doubt,
    Equivalence,
    LearnedClaim,
    artefacts,
    carried,
    equivalences,
    learned_claims,
    with_curves,
)
from identification.diagnosis.lines import Line, find_lines, orders_of, other_orders
from identification.diagnosis.locate import Unexplained, locate
from identification.diagnosis.trials import Base, Trial, make_base, try_candidate
from identification.errors import InputError
from identification.fitting.assess import (
    RATIO_LIMIT,
    VERDICT_KERNELS,
    BalanceError,
    Error,
    assess,
    verdict_kernel,
)
from identification.fitting.engine import Dataset, Solution, load_dataset, prepared_model, solve
from identification.fitting.first_fit import first_fit
from identification.fitting.left_open import LeftOpen
from identification.naming.contest import DECIDED, FEWEST, Contest, Rival
from identification.naming.odds import Odds, contenders, contest_of, odds_of, unmodelled

Progress = Callable[[str, float], None]
Curved = tuple[tuple[LearnedClaim, ...], Step | None]


class Bench(Protocol):
    """A model with its prepared records; a joint model and a user's FMU are two."""

    joint: Joint
    data: Dataset

    def start(self) -> Solution:
        """The fit of the model that is judged."""

    def fitted(
        self, model: JointModel, start: Mapping[str, float], *, again: bool = False
    ) -> Solution:
        """The whole fit of a model."""

    def step(self, key: str | None, label: str | None, solution: Solution) -> Step:
        """A fitted model with its errors."""

    def added(self, trial: Trial, now: Step) -> Step:
        """The model of a step with a tried candidate, as far as it can be fitted."""

    def listen(self, step: Step) -> None:
        """Take down the orders of the lines in what a step leaves: trials of periodic effects
        start there.
        """

    def base(self, solution: Solution) -> Base:
        """Rows of a fitted model for the trials."""

    def ranking(
        self, base: Base, *, late: bool = False, progress: Progress | None = None
    ) -> Ranking:
        """The library tried on a base."""

    def tried(self, solution: Solution) -> list[str]:
        """Keys of the effects that a ranking of a fitted model tries."""

    def ratios(self, step: Step) -> dict[str, BalanceError]:
        """Residual over floor of every balance on held-out records, as the verdict counts it."""

    def slow_noise(self, step: Step) -> Mapping[str, SlowNoise]:
        """Drift and hum of the torques' readings that the verdict counts in what a step leaves, by
        signal.
        """

    def beside(self, step: Step, slow: Mapping[str, SlowNoise]) -> Error:
        """Errors of a step on held-out records whose readings drift and hum by as much."""

    def left_open(self, step: Step) -> Mapping[str, tuple[str, ...]]:
        """Parameters whose errors explain what a balance leaves on held-out records over the
        noise, by balance.
        """

    def shown(self, step: Step) -> Step:
        """The step with ratios that agree with the verdict, as every door shows them."""

    def lines(self, step: Step) -> list[Line]:
        """Lines in what is left."""

    def places(
        self, step: Step, error: Error, lines: Sequence[Line], limit: float
    ) -> list[Unexplained]:
        """Where what is left sits, for every balance over `limit` times its floor."""

    def learned(self, step: Step, error: Error) -> tuple[LearnedClaim, ...]:
        """Curves over one variable of what is left in the balances over their floor."""

    def ratios_with(
        self, step: Step, learned: Sequence[LearnedClaim]
    ) -> Mapping[str, BalanceError]:
        """As `ratios`, with learned curves in the model of the step."""

    def curved(self, step: Step, learned: Sequence[LearnedClaim]) -> Curved:
        """The curves that a model of the step takes along, and the step that it is with them."""

    def held_against(self, claims: Sequence[Claim], step: Step) -> Mapping[str, Equivalence]:
        """The names of claims against curves over their own variables, by label."""

    def artefacts(self, step: Step, curves: Sequence[Curve], start: Step) -> tuple[Doubt, ...]:
        """Reasons why the parameters of a model cannot be those of its laws."""

    def same_sign(self, trial: Trial, solution: Solution) -> bool:
        """Whether a small effect has the same sign at half and at double kernel."""

    def other_form(self, step: Step) -> Step | None:
        """The step with the virtual work of its kinematic error where it has none, or without it;
        None where the rows do not say that this is nearer.
        """

    def slower(self, factor: float) -> Bench | None:
        """The same records with a longer kernel; None where there is none."""

    def odds(
        self, claim: Claim, near: Mapping[str, float], now: Step, last: Ranking
    ) -> Odds | None:
        """Whole fits of the names of a claim of a step's model, and of those that came near it;
        None where they cannot be fitted.

        `near`: by how much the trial of a name was behind that of the claim [nats]; `last`: the
        ranking on the step's model.
        """


@final
class JointBench:
    """A joint model and its records.

    Parameters
    ----------
    joint : Joint
    data : Dataset
        Made from `train` and `held`.
    train, held : sequence of Record
    like : Sensing, optional
        Of the fit that is judged on these records: temperature counts as there.
    slow : bool
        The rows of `data` are slow ones already (:meth:`slower`).
    kernels : mapping of float to Dataset
        The same records at other kernels, as far as they are prepared.
    """

    def __init__(
        self,
        joint: Joint,
        data: Dataset,
        train: Sequence[Record],
        held: Sequence[Record],
        *,
        like: Sensing | None = None,
        slow: bool = False,
        kernels: Mapping[float, Dataset] = MappingProxyType({}),
    ) -> None:
        self.joint, self.data, self._like, self._slow = joint, data, like, slow
        self._slower: dict[float, JointBench] = {}
        self._train, self._held = list(train), list(held)
        self._solved: dict[tuple[object, ...], Solution] = {}
        self._stepped: dict[tuple[object, ...], Solution] = {}
        self._ratios: dict[tuple[int, bool], tuple[Solution, dict[str, BalanceError]]] = {}
        self._equal: dict[tuple[object, ...], tuple[Solution, dict[str, Equivalence]]] = {}
        self._curves: dict[tuple[object, ...], tuple[Solution, tuple[LearnedClaim, ...]]] = {}
        self._readings: dict[tuple[int, bool], Mapping[str, SlowNoise]] = {}
        self._kernels = {**kernels, round(data.kernel, 9): data}
        self._start: Solution | None = None
        self._started = data.train
        self._base: Base | None = None
        self._rankings: dict[bool, Ranking] = {}
        self._lines: dict[int, tuple[Solution, list[Line]]] = {}

    def start(self) -> Solution:
        """The fit of the joint's own model; made once of the same rows."""
        if self._start is None or self._started is not self.data.train:
            self._start = first_fit(prepared_model(self.joint, self._train[0]), self.data)
            self._started, self._base, self._rankings = self.data.train, None, {}
        return self._start

    def fitted(
        self, model: JointModel, start: Mapping[str, float], *, again: bool = False
    ) -> Solution:
        """A fit made once per model, unless `again`: a confirmed candidate is not fitted anew
        when it is added.
        """
        if again:
            return solve(model, self.data, start=start)
        if model.structure not in self._solved:
            self._solved[model.structure] = solve(model, self.data, start=start)
        return self._solved[model.structure]

    def step(self, key: str | None, label: str | None, solution: Solution) -> Step:
        """A fitted model with its errors on training and held-out records."""
        self._stepped[solution.model.structure] = solution
        train = assess(solution.model, self.data, self.data.train, solution.values)
        held = assess(solution.model, self.data, self.data.held_out, solution.values)
        return Step(key, visible_keys(solution.model), train, held, solution, label)

    def added(self, trial: Trial, now: Step) -> Step:
        """The whole fit of the model with a candidate."""
        solution = self.fitted(trial.candidate.model, {**now.solution.values, **trial.values})
        return self.step(trial.key, trial.candidate.label, solution)

    def listen(self, step: Step) -> None:
        """Take down the orders of the lines in what a step leaves: trials of periodic effects
        start there.
        """
        lines = self.lines(step)
        heard = orders_of(lines, self.joint), other_orders(lines, self.joint)
        if heard != (self.data.orders, self.data.other_orders):
            self.data = replace(self.data, orders=heard[0], other_orders=heard[1])
            self._base, self._rankings = None, {}

    def base(self, solution: Solution) -> Base:
        """See :func:`identification.diagnosis.trials.make_base`; that of the start model is made
        once.
        """
        if solution is not self._start:
            return make_base(solution, self.data)
        if self._base is None:
            self._base = make_base(solution, self.data)
        return self._base

    def ranking(
        self, base: Base, *, late: bool = False, progress: Progress | None = None
    ) -> Ranking:
        """See :func:`identification.diagnosis.claims.rank`; that of the start model, which the
        clocks are set by as well, is made once.
        """
        if base is not self._base:
            return rank(base, late=late, progress=progress)
        if late not in self._rankings:
            self._rankings[late] = rank(base, late=late, progress=progress)
        return self._rankings[late]

    def tried(self, solution: Solution) -> list[str]:
        """Keys of the effects that the records can show beside the model."""
        return [c.effect.key for c in offered(solution.model, self.data)[0]]

    def ratios(self, step: Step) -> dict[str, BalanceError]:
        """Residual over floor, each balance at its own kernel, on held-out records."""
        return self._judged(step.solution, held_out=True)

    def shown(self, step: Step) -> Step:
        """The step with its ratios as `judged` gives them; RMS and floor stay those of the
        claims' kernel.
        """
        return replace(
            step,
            train=self.judged(step.solution, step.train, held_out=False),
            held_out=self.judged(step.solution, step.held_out),
        )

    def judged(self, solution: Solution, error: Error, *, held_out: bool = True) -> Error:
        """An error of a fitted model on these records, its ratios in agreement with the verdict.

        A balance that the verdict counts as clean reads as the verdict reads it: dirt of the
        sensors that only a slow kernel sees must not stand in a table beside "nothing is missing".
        One with structure left reads at the kernel that shows it best.
        """
        verdict = self._judged(solution, held_out=held_out)
        ratios = {b: e.ratio for b, e in verdict.items()}
        slow = self._readings[id(solution), held_out]
        if slow:
            louder = self._beside_slow(solution, slow, held_out=held_out).balances
            error = replace(
                error,
                balances={
                    b: replace(e, rms=louder[b].rms, floor=louder[b].floor)
                    if ratios[b] <= RATIO_LIMIT < e.ratio
                    else e
                    for b, e in error.balances.items()
                },
            )
        shown = {
            b: r if r <= RATIO_LIMIT else max(r, error.balances[b].ratio) for b, r in ratios.items()
        }
        # the floor beside a ratio that counts what the fit leaves open counts it, too
        floor = {
            b: e.rms / max(shown[b], 1e-300) if verdict[b].left_open else e.floor
            for b, e in error.balances.items()
        }
        return replace(
            error,
            balances={
                b: replace(e, ratio=shown[b], floor=floor[b]) for b, e in error.balances.items()
            },
        )

    def _judged(self, solution: Solution, *, held_out: bool) -> dict[str, BalanceError]:
        mark = (id(solution), held_out)
        if mark not in self._ratios:
            out: dict[str, BalanceError] = {}
            values = self._settled(solution)
            for length in self._lengths(self.data.sensing.balances):
                out |= self._errors_at(length, solution.model, values, held_out=held_out)
            slow, believed = {}, frozenset[str]()
            if any(e.ratio > RATIO_LIMIT for e in out.values()):
                slow = slow_noise_beside(solution.model, self.data, values)
            for length in self._lengths(out) if slow else ():
                told = self._errors_at(length, solution.model, values, held_out=held_out, slow=slow)
                # what a slow noise does not explain whole is left as it is
                whole = {b: e for b, e in told.items() if e.ratio <= RATIO_LIMIT < out[b].ratio}
                out |= whole
                believed |= frozenset(whole)
            self._readings[mark] = slow if believed else {}
            over = frozenset(b for b, e in out.items() if e.ratio > RATIO_LIMIT)
            if over and held_out:
                out |= self._beside_open(LeftOpen.of(solution, self.data, values, over), solution)
            # the solution is kept with its ratios: an identity is not given to another while it
            # lives
            self._ratios[mark] = solution, {b: out[b] for b in self.data.sensing.balances}
        return dict(self._ratios[mark][1])

    def _beside_open(self, left_open: LeftOpen, solution: Solution) -> dict[str, BalanceError]:
        """Errors of the balances that are explained by what a fit leaves open, each whole: as with
        a slow noise, others are left as they are.
        """
        out: dict[str, BalanceError] = {}
        values = self._settled(solution)

        def ask(given: LeftOpen) -> None:
            for length in self._lengths(given.asked):
                told = self._errors_at(
                    length, solution.model, values, held_out=True, left_open=given
                )
                out.update(
                    {b: e for b, e in told.items() if b in given.asked and e.ratio <= RATIO_LIMIT}
                )

        ask(left_open)
        rest = left_open.asked - set(out)
        model, free = solution.model, set(solution.free)
        valleys = {n for t in model.terms if t.effect.several_valleys for n in t.names}
        untold = [
            n for n in valleys & free if (solution.stderr[n] or math.inf) >= abs(solution.values[n])
        ]
        if rest and untold:
            # steps do not lead out of a valley: all records together may know another
            every = (*self.data.train, *self.data.held_out)
            whole = solve(model, replace(self.data, train=every, held_out=()))
            ask(replace(left_open, asked=rest, elsewhere=whole.values))
        return out

    def _settled(self, solution: Solution) -> Mapping[str, float]:
        """Values of a solution; zero and clocks of a record, too, are its own and found at the
        kernel of the claims.
        """
        records = [*self.data.train, *self.data.held_out]
        return settled(solution.model, self.data.sensing, records, solution.values)

    def _errors_at(
        self,
        length: float,
        model: JointModel,
        values: Mapping[str, float],
        *,
        held_out: bool,
        slow: Mapping[str, SlowNoise] = MappingProxyType({}),
        left_open: LeftOpen | None = None,
    ) -> dict[str, BalanceError]:
        """Errors of the balances whose verdict falls at this kernel."""
        data = self._at_kernel(length).with_slow_noise(slow)
        records = data.held_out if held_out else data.train
        error = assess(model, data, records, values, left_open)
        return {b: e for b, e in error.balances.items() if self._length(b) == length}

    def _length(self, balance: str) -> float:
        """Kernel of the verdict of a balance; of slow rows as of those that they were made from."""
        return VERDICT_KERNELS[balance] if self._slow else verdict_kernel(balance, self.data)

    def _lengths(self, balances: Collection[str]) -> list[float]:
        return sorted({self._length(b) for b in balances})

    def slow_noise(self, step: Step) -> Mapping[str, SlowNoise]:
        """Drift and hum that a fitted model shows and that explain a ratio, by signal."""
        self._judged(step.solution, held_out=True)
        return self._readings[id(step.solution), True]

    def beside(self, step: Step, slow: Mapping[str, SlowNoise]) -> Error:
        """Errors on held-out records where the readings are as slow."""
        return self._beside_slow(step.solution, slow, held_out=True)

    def _beside_slow(
        self, solution: Solution, slow: Mapping[str, SlowNoise], *, held_out: bool
    ) -> Error:
        data = self.data.with_slow_noise(slow)
        records = data.held_out if held_out else data.train
        return assess(solution.model, data, records, self._settled(solution))

    def left_open(self, step: Step) -> Mapping[str, tuple[str, ...]]:
        """Parameters whose errors explain what a balance leaves on held-out records."""
        judged = self._judged(step.solution, held_out=True)
        return {b: e.left_open for b, e in judged.items() if e.left_open}

    def lines(self, step: Step) -> list[Line]:
        """See :func:`identification.diagnosis.lines.find_lines`; worked out once a model."""
        mark = id(step.solution)
        if mark not in self._lines:
            found = find_lines(step.solution, self.data, self._train, self._held)
            self._lines[mark] = step.solution, found
        return self._lines[mark][1]

    def places(
        self, step: Step, error: Error, lines: Sequence[Line], limit: float
    ) -> list[Unexplained]:
        """See :func:`identification.diagnosis.locate.locate`."""
        return locate(step.solution, self.data, error, lines, limit)

    def learned(self, step: Step, error: Error) -> tuple[LearnedClaim, ...]:
        """See :func:`identification.diagnosis.learned.learned_claims`; worked out once a model."""
        over = (b for b, e in error.balances.items() if e.ratio > RATIO_LIMIT)
        mark = (id(step.solution), *over)
        if mark not in self._curves:
            found = learned_claims(step.solution, self.data, error, RATIO_LIMIT)
            self._curves[mark] = step.solution, found
        return self._curves[mark][1]

    def ratios_with(
        self, step: Step, learned: Sequence[LearnedClaim]
    ) -> Mapping[str, BalanceError]:
        """Residual over floor with curves in the model, at the values of their fit."""
        return self._judged(with_curves(step.solution, learned), held_out=True)

    def curved(self, step: Step, learned: Sequence[LearnedClaim]) -> Curved:
        """See :func:`identification.diagnosis.learned.carried`."""
        kept = carried(step.solution, learned, self.data)
        if not kept:
            return (), None
        return kept, self.shown(self.step(LEARNED, None, with_curves(step.solution, kept)))

    def held_against(self, claims: Sequence[Claim], step: Step) -> Mapping[str, Equivalence]:
        """See :func:`identification.diagnosis.learned.equivalences`; worked out once a model."""
        mark = (id(step.solution), tuple(c.label for c in claims))
        if mark not in self._equal:
            # the solution is kept with its answer: its identity is not given to another one
            self._equal[mark] = step.solution, equivalences(claims, step.solution, self.data)
        return self._equal[mark][1]

    def artefacts(self, step: Step, curves: Sequence[Curve], start: Step) -> tuple[Doubt, ...]:
        """See :func:`identification.diagnosis.learned.artefacts`."""
        return artefacts(step.solution, self.data, curves, start.solution)

    def same_sign(self, trial: Trial, solution: Solution) -> bool:
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

    def odds(
        self, claim: Claim, near: Mapping[str, float], now: Step, last: Ranking
    ) -> Odds | None:
        """See :mod:`identification.naming.odds`."""
        whole = now.solution
        less = without(whole.model, claim.label)
        if less.terms == whole.model.terms or claim.effect.stage == "structure":
            return None
        names = contenders(claim.effects, near, unmodelled(last, claim.balance))
        first = Rival(claim.effects[0], claim.label, whole)
        before = self._stepped.get(less.structure)
        bare = before or self.fitted(less, whole.values, again=True)
        contest = contest_of(names, claim.balance, first, bare, self.data)
        if contest.ahead[0, 0] > FEWEST:  # what a wrong name leaves is not what is unmodelled
            last = self.ranking(self.base(contest.leader.solution))
        return odds_of(contest, unmodelled(last, claim.balance))

    def other_form(self, step: Step) -> Step | None:
        """See :class:`Bench`; two forms of a model are held against each other as two names are."""
        model = step.solution.model
        if not any(t.place == "torsion" for t in model.terms):
            return None
        turned = replace(model, virtual_work=not model.virtual_work)
        # another form may have its minimum elsewhere, but as near as the one that is left
        other = self.fitted(turned, step.solution.values, again=True)
        contest = Contest(
            [Rival("", form, s) for form, s in (("", step.solution), ("other", other))], self.data
        )
        nats, deviate = contest.ahead[0]
        if nats <= FEWEST or deviate <= DECIDED:
            return None
        return self.step(step.added, step.label, other)

    def slower(self, factor: float) -> JointBench | None:
        """See :class:`Bench`; made once. A motor alone is seen at a long kernel from the start."""
        if self._slow or self.data.sensing.one_sided:
            return None
        try:
            slow = self._at_kernel(self.data.kernel * factor)
        except InputError:  # a record is too short for it, or stands still at its ends
            return None
        for part in (slow.train, slow.held_out):
            for b in self.data.sensing.balances:
                if sum(np.count_nonzero(w.taking(b)) for w in part) < FEWEST_ROWS:
                    return None
        if factor not in self._slower:
            data = replace(slow, orders=self.data.orders, other_orders=self.data.other_orders)
            self._slower[factor] = JointBench(
                self.joint,
                data,
                self._train,
                self._held,
                like=self._like,
                slow=True,
                kernels=self._kernels,
            )
        return self._slower[factor]

    def _at_kernel(self, length: float) -> Dataset:
        """The same records with another kernel, prepared once."""
        mark = round(length, 9)
        if mark not in self._kernels:
            model = prepared_model(self.joint, self._train[0])
            # clocks and noise are the records' own: neither hangs on the kernel
            self._kernels[mark] = load_dataset(
                self._train,
                self._held,
                self.joint,
                model,
                kernel=length,
                like=self._like,
                told=self.data,
            )
        return self._kernels[mark]
