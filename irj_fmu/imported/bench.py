"""What a user's FMU leaves along the measured motion, as a model that a session judges.

The parameters of the FMU stay unknown beside those of a candidate: in a trial as columns that the
candidate must stand out from, in a whole fit as values that move along.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, final

import numpy as np

from casadi_models import EFFECTS, Effect, JointModel
from casadi_models.term import SIDE_INERTIAS
from identification.balance.balances import balances_of
from identification.balance.calibration import settled
from identification.balance.sensing import signals_of
from identification.balance.slow_noise import SlowNoise
from identification.balance.stamps import evened
from identification.balance.weak import WeakRecord, differentiated_kernel, filtered
from identification.data.joint_file import Known
from identification.data.record import Record
from identification.diagnosis.bench import Curved, Progress
from identification.diagnosis.candidates import Candidate, NotTestable, offered
from identification.diagnosis.claims import Claim, Ranking, rank
from identification.diagnosis.curve import Curve
from identification.diagnosis.improvement import Step, visible_keys
from identification.diagnosis.learned import Doubt, Equivalence, LearnedClaim
from identification.diagnosis.lines import Line
from identification.diagnosis.locate import Unexplained, locate
from identification.diagnosis.session import MOST_RELATIVES, RELATIVE_SHARE
from identification.diagnosis.trials import (
    COLLINEAR,
    Base,
    Trial,
    by_whole_fit,
    flatten,
    make_base,
)
from identification.errors import InputError
from identification.fitting.assess import BalanceError, Error, assess
from identification.fitting.covariance import correlations, window_errors, windows_over
from identification.fitting.engine import COLLINEAR as NOT_IDENTIFIED
from identification.fitting.engine import Dataset, Solution, solve, stack, stepped
from identification.fitting.least_squares import bounded_step
from identification.naming.odds import Odds
from irj_fmu.host.signals import FloatArray

if TYPE_CHECKING:
    from casadi_models.term import Term

MOST_ROUNDS: Final = 12
"""Steps of a whole fit in which the parameters of the FMU follow, at most: a fit by the outputs
that lacked a loop of the gear had the damping at three times its value, and six took it back."""
FOLLOWING: Final = 2
"""Steps of the FMU's parameters beside those of a variant: about the point where the whole fit of
the best names ended the first one is nearly all of it, and the second brings the error of the
variants to that of their whole fits (`tests/irj_fmu/imported/test_user_fmu_explore.py`)."""
NUISANCE: Final = "fmu."
"""Before the name of a parameter of the FMU beside those of the joint that is left: both have a
stiffness."""
OUTSIDE: Final = ("friction", "torque")
"""Families of effects that can ride outside an FMU as a torque."""


TORQUES: Final = {
    "motor_torque": "drive",
    "coupling_torque": "coupling_torque",
    "link_torque": "torque",
}
"""Channels that follow from the FMU and its parameters, and their signals."""


@final
@dataclass(frozen=True)
class Freedom:
    """A parameter of the FMU: what one unit of it changes in every record.

    Attributes
    ----------
    name : str
    low, high : float
        How far it can move from its value.
    step : float
        Step with which the changes were taken: a scale of the parameter.
    changes : tuple of mapping of str to (n,) array
        By record, training ones first: signals at full rate, link-referred, of the joint whose
        constants follow the parameter.
    constants : mapping of str to float
        What it changes in these constants.
    """

    name: str
    low: float
    high: float
    step: float
    changes: tuple[Mapping[str, FloatArray], ...]
    constants: Mapping[str, float]


@final
@dataclass(frozen=True)
class Whole:
    """A whole fit of balances and FMU together.

    Attributes
    ----------
    changes : mapping of str to float
        By how much each parameter of the FMU moved.
    stderr : mapping of str to float or None
        Standard errors of these and of the parameters of the effects; None where the rows do not
        tell the parameter, or where it stands at a bound.
    """

    changes: Mapping[str, float]
    stderr: Mapping[str, float | None]


def freedom(
    name: str,
    limits: tuple[float, float],
    step: float,
    pairs: Sequence[tuple[Record, Record]],
    data: Dataset,
    constants: Mapping[str, float],
) -> Freedom:
    """A parameter's changes, from records (before, after) a step of it, training ones first, and
    from what the step changes in the constants of the joint.
    """
    out = []
    for before, after in pairs:
        changed = before
        for channel in TORQUES:
            if before.has(channel):
                changed = changed.with_channel(channel, (after[channel] - before[channel]) / step)
        signals = signals_of(evened(changed), data.joint, data.sensing)
        out.append({n: x for n, x in signals.items() if n in TORQUES.values()})
    return Freedom(name, *limits, step, tuple(out), {n: x / step for n, x in constants.items()})


def _sum(table: Mapping[str, FloatArray], more: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    return {**table, **{n: table[n] + x for n, x in more.items()}}


def _shifted(
    records: Sequence[WeakRecord], changes: Sequence[Mapping[str, FloatArray]]
) -> tuple[WeakRecord, ...]:
    """Prepared records with torques added at full rate."""
    out = []
    for w, change in zip(records, changes, strict=True):
        averaged, points, smooth, _ = filtered(w.grid, change)
        out.append(
            replace(
                w,
                averaged=_sum(w.averaged, averaged),
                points=_sum(w.points, points),
                smooth=_sum(w.smooth, smooth),
            )
        )
    return tuple(out)


def without_steep(
    data: Dataset, records: Sequence[Record], steep: Sequence[Mapping[str, FloatArray]]
) -> Dataset:
    """The records without the rows in which a side's friction is not known: as rows in which that
    side stands still.

    Parameters
    ----------
    data : Dataset
    records : sequence of Record
        What it was made of, training ones first.
    steep : sequence of mapping of side to (n,) array
        Flags of the samples of each record; empty where there are none.
    """
    if not steep:
        return data
    out = []
    for w, record, flags in zip((*data.train, *data.held_out), records, steep, strict=True):
        weights = differentiated_kernel(w.grid.length, w.grid.dt, 0)
        rest = dict(w.rest)
        for side, flag in flags.items():
            even = np.interp(evened(record).time, record.time, flag)
            found = w.grid.correlate(even, weights)
            rest[side] = np.maximum(rest[side], found) if side in rest else found
        out.append(replace(w, rest=rest))
    count = len(data.train)
    return replace(data, train=tuple(out[:count]), held_out=tuple(out[count:]))


@final
class FmuBench:
    """What an FMU leaves along the measured motion, as the model that a session judges.

    Parameters
    ----------
    outside : JointModel
        Balances of what is left: inertias, and a spring where both sides are seen.
    data : Dataset
    free : sequence of Freedom
        The FMU's parameters.
    remade : callable
        The records prepared anew, by what is added to each of these parameters.
    inside : sequence of Term
        Effects that the FMU holds already: they are not proposed.
    own_inertias : collection of str
        Sides whose inertia is a parameter of the FMU: no other one is proposed there.
    only_torque : bool
        What is left was seen at the drive alone: only effects that act there as a torque are tried.
    """

    def __init__(
        self,
        outside: JointModel,
        data: Dataset,
        free: Sequence[Freedom],
        remade: Callable[[Mapping[str, float]], Dataset],
        *,
        inside: Sequence[Term] = (),
        own_inertias: Collection[str] = (),
        only_torque: bool = True,
    ) -> None:
        self.joint, self.data = data.joint, data
        self._outside, self._free, self._only = outside, list(free), only_torque
        self._remade = remade
        self._own = frozenset(own_inertias)
        self._inside = {(t.effect.key, t.place) for t in inside}
        self._known: dict[int, tuple[Solution, Dataset, FloatArray]] = {}
        self._fits: dict[tuple[object, ...], Solution] = {}

    def start(self) -> Solution:
        """The fit of the balances with nothing added."""
        return self.fitted(self._outside, {})

    def fitted(
        self, model: JointModel, start: Mapping[str, float], *, again: bool = False
    ) -> Solution:
        """The whole fit of balances with more terms, the FMU's parameters moved along."""
        if not again and model.structure in self._fits:
            return self._fits[model.structure]
        sizes, data, exact = np.zeros(len(self._free)), self.data, True
        solution = solve(model, data, start=start)
        found = solution, data, sizes
        names = [f.name for f in self._free]
        for number in range(MOST_ROUNDS if self._free else 0):
            sizes, certain = self._moved(solution, data, sizes)
            if exact and not certain:
                break
            # the first step is a large one, which the change of one unit tells well enough
            exact = number > 0
            try:
                data = (
                    self._remade(dict(zip(names, sizes.tolist(), strict=True)))
                    if exact
                    else self._at(sizes)
                )
                solution = solve(model, data, start=solution.values)
            except InputError:  # along a direction that hardly shows, to where the FMU is no joint
                break
            if exact:
                if not self._nearer(solution, data, found[0], found[1]):
                    break
                found = solution, data, sizes
        solution = found[0]
        self._known[id(solution)] = found
        self._fits[model.structure] = solution
        return solution

    def _nearer(
        self, solution: Solution, data: Dataset, best: Solution, best_data: Dataset
    ) -> bool:
        """Whether a fit leaves less than the best one of the same model, on the weights of that."""

        def left(one: Solution, given: Dataset) -> float:
            balances = balances_of(one.model, given.sensing, wrt=())
            rows = stack(balances, given.train, one.values)
            return float(
                sum(
                    np.mean((r * np.median(best.weights[b]))[rows.taking[b]] ** 2)
                    for b, r in rows.residual.items()
                )
            )

        return left(solution, data) < left(best, best_data)

    def stepped(
        self, model: JointModel, start: Mapping[str, float], like: Solution, *, iterations: int
    ) -> tuple[Solution, float]:
        """A few steps of a fit on the weighting of another one, the FMU's parameters moved along as
        far as that is linear: what is held against many others needs no run of the FMU.

        Parameters
        ----------
        model : JointModel
        start : mapping of str to float
            Values to start from; under :data:`NUISANCE` and the name of a parameter of the FMU its
            change.
        like : Solution
            Whose weights count.
        iterations : int

        Returns
        -------
        (Solution, float)
            As :func:`identification.fitting.engine.stepped`.
        """
        changes = [start.get(NUISANCE + f.name, 0.0) for f in self._free]
        sizes = np.array(
            [min(max(x, f.low), f.high) for x, f in zip(changes, self._free, strict=True)]
        )
        data = self._at(sizes)
        solution, cost = stepped(model, data, start, like, iterations=iterations)
        for _ in range(FOLLOWING if self._free else 0):
            moved, certain = self._moved(solution, data, sizes)
            after = self._at(moved)
            found, less = stepped(model, after, solution.values, like, iterations=iterations)
            if less < cost:
                solution, cost, data, sizes = found, less, after, moved
            if not certain or not less < cost:
                break
        self._known[id(solution)] = solution, data, sizes
        return solution, cost

    def data_of(self, solution: Solution) -> Dataset:
        """The records with the FMU's parameters where a fit of this bench has moved them."""
        known = self._known.get(id(solution))
        return known[1] if known else self.data

    def changes(self, solution: Solution) -> dict[str, float]:
        """By how much the whole fit of a solution of this bench moved each of the FMU's
        parameters.
        """
        sizes = self._known[id(solution)][2]
        return {f.name: float(x) for f, x in zip(self._free, sizes, strict=True)}

    def whole(self, solution: Solution) -> Whole:
        """What the whole fit of a solution of this bench says of the FMU's parameters and of the
        effects beside them.

        The errors are those of all of them together: an effect is known no better than the
        parameters of the FMU that could stand in for it allow.
        """
        from scipy.sparse import csr_array, hstack

        _, data, sizes = self._known[id(solution)]
        base = make_base(solution, data)
        columns = [c[: len(base.weight)] * base.weight for c in self._columns(solution, data)]
        own = [f.name for f in self._free]
        norms = np.array([np.linalg.norm(c) for c in columns])
        size = np.where(norms > 0, norms, 1.0)
        jacobian = np.column_stack([base.jacobian, *(c / s for c, s in zip(columns, size))])
        names, scale = (*base.names, *own), np.append(base.norms, size)
        at_edge = (x <= f.low or x >= f.high for f, x in zip(self._free, sizes, strict=True))
        held = {n for n, e, s in zip(own, at_edge, norms, strict=True) if e or not s > 0}
        stderr: dict[str, float | None] = dict.fromkeys(names)
        free = np.array([i for i, n in enumerate(names) if n not in held], dtype=np.int64)
        windows = windows_over([w.time for w in data.train])
        tiled = csr_array(hstack([windows] * len(base.balances)))
        found = window_errors(jacobian[:, free], base.residual, tiled)
        spread, _ = correlations(jacobian[:, free].T @ jacobian[:, free])
        for k, i in enumerate(free.tolist()):
            if found is not None and spread[k] < NOT_IDENTIFIED:
                stderr[names[i]] = float(found[k] / scale[i])
        return Whole(self.changes(solution), stderr)

    def step(self, key: str | None, label: str | None, solution: Solution) -> Step:
        """The balances with their errors."""
        data = self.data_of(solution)
        train = assess(solution.model, data, data.train, solution.values)
        held = assess(solution.model, data, data.held_out, solution.values)
        return Step(key, visible_keys(solution.model), train, held, solution, label)

    def added(self, trial: Trial, now: Step) -> Step:
        """The whole fit of the balances with a candidate."""
        values = {**now.solution.values, **trial.values}
        solution = self.fitted(trial.candidate.model, values)
        return self.step(trial.key, trial.candidate.label, solution)

    def listen(self, step: Step) -> None:
        """Nothing: what an FMU leaves is averaged already, and holds no line."""

    def base(self, solution: Solution) -> Base:
        """Rows of the balances, with the FMU's parameters as nuisance."""
        return self.based(solution, self.data_of(solution))

    def based(self, solution: Solution, data: Dataset) -> Base:
        """The same of a model with values on records that this bench has moved."""
        columns = self._columns(solution, data)
        names = [NUISANCE + f.name for f in self._free]
        return with_nuisance(make_base(solution, data), columns, names)

    def ranking(
        self, base: Base, *, late: bool = False, progress: Progress | None = None
    ) -> Ranking:
        """The effects that the FMU can lack."""
        extra = _extra(base.solution.model, self.data)
        found = self._proposed(rank(base, extra, late=late, progress=progress))
        return found if self._only else self._by_whole_fits(found, base)

    def tried(self, solution: Solution) -> list[str]:
        """Keys of the effects that the FMU can lack."""
        return [c.effect.key for c in self.offered(solution.model)[0]]

    def offered(self, model: JointModel) -> tuple[list[Candidate], list[NotTestable]]:
        """The effects that the FMU can lack beside those of a model of what is left, and the
        others with the reason.
        """
        there, refused = offered(model, self.data)
        every = [*there, *_extra(model, self.data)]
        reasons = [self._why_not(c) for c in every]
        kept = [c for c, why in zip(every, reasons, strict=True) if why is None]
        told = {c.effect.key: why for c, why in zip(every, reasons, strict=True) if why}
        known = {c.effect.key for c in kept}
        gone = [NotTestable(key, why) for key, why in told.items() if key not in known]
        return kept, [*refused, *gone]

    def ratios(self, step: Step) -> dict[str, BalanceError]:
        """Of every balance, at the kernel of the claims."""
        return dict(step.held_out.balances)

    def slow_noise(self, step: Step) -> Mapping[str, SlowNoise]:
        """None: what an FMU leaves holds the errors of its solver."""
        return {}

    def other_form(self, step: Step) -> Step | None:
        """None: how a kinematic error acts on the torques is the FMU's."""
        return None

    def beside(self, step: Step, slow: Mapping[str, SlowNoise]) -> Error:
        """As the step has them: no slow noise is asked for."""
        return step.held_out

    def left_open(self, step: Step) -> Mapping[str, tuple[str, ...]]:
        """None: what is left is judged on the outputs."""
        return {}

    def shown(self, step: Step) -> Step:
        """The step: its one kernel is that of the verdict."""
        return step

    def lines(self, step: Step) -> list[Line]:
        """None are looked for: the FMU has its own periodic parts."""
        return []

    def places(
        self, step: Step, error: Error, lines: Sequence[Line], limit: float
    ) -> list[Unexplained]:
        """Where the balances are over their floor."""
        return locate(step.solution, self.data_of(step.solution), error, lines, limit)

    def learned(self, step: Step, error: Error) -> tuple[LearnedClaim, ...]:
        """None: a curve cannot ride outside an FMU yet."""
        return ()

    def ratios_with(
        self, step: Step, learned: Sequence[LearnedClaim]
    ) -> Mapping[str, BalanceError]:
        """Those without curves: a curve cannot ride outside an FMU yet."""
        return self.ratios(step)

    def curved(self, step: Step, learned: Sequence[LearnedClaim]) -> Curved:
        """None: a curve cannot ride outside an FMU yet."""
        return (), None

    def held_against(self, claims: Sequence[Claim], step: Step) -> Mapping[str, Equivalence]:
        """None: a curve cannot ride outside an FMU yet."""
        return {}

    def artefacts(self, step: Step, curves: Sequence[Curve], start: Step) -> tuple[Doubt, ...]:
        """None: the FMU has its own parameters."""
        return ()

    def same_sign(self, trial: Trial, solution: Solution) -> bool:
        """No minor effects are looked for."""
        return False

    def slower(self, factor: float) -> None:
        """The FMU's rows have one kernel: its noise is that of the torque that it asks for."""

    def odds(
        self, claim: Claim, near: Mapping[str, float], now: Step, last: Ranking
    ) -> Odds | None:
        """None: its trials have told what there is, beside the FMU's own parameters."""
        return None

    # --- inside -----------------------------------------------------------------------------------

    def _at(self, sizes: FloatArray) -> Dataset:
        """The records with the FMU's parameters moved, as far as that is linear."""
        moved = self._with(self.data, sizes)
        known = dict(moved.joint.known)
        for f, size in zip(self._free, sizes.tolist(), strict=True):
            for n, x in f.constants.items():
                known[n] = Known(value=(known[n].value or 0.0) + size * x)
        return replace(moved, joint=replace(moved.joint, known=known))

    def _with(self, data: Dataset, sizes: FloatArray) -> Dataset:
        changes = [
            {
                n: sum(s * f.changes[i][n] for f, s in zip(self._free, sizes, strict=True))
                for n in self._free[0].changes[i]
            }
            for i in range(len(data.train) + len(data.held_out))
        ]
        count = len(data.train)
        return replace(
            data,
            train=_shifted(data.train, changes[:count]),
            held_out=_shifted(data.held_out, changes[count:]),
        )

    def _columns(self, solution: Solution, data: Dataset) -> list[FloatArray]:
        """Change of every row with each of the FMU's parameters, training rows first [N.m per
        unit].

        The constants of the joint follow the parameter, and the laws of the model turn them into
        torques where these stand now: a spring and a damper of the gear pull at what an error of
        its angle leaves of the torsion, and an inertia takes the acceleration that was measured,
        not the one that the FMU had without the missing effect.
        """
        balances = balances_of(solution.model, data.sensing, wrt=())

        def rows(given: Dataset, values: Mapping[str, float]) -> FloatArray:
            both = [
                flatten(stack(balances, records, values), balances.balances)[0]
                for records in (given.train, given.held_out)
                if records
            ]
            return np.concatenate(both)

        at = solution.values
        before, out = rows(data, at), []
        for i, f in enumerate(self._free):
            sizes = np.zeros(len(self._free))
            sizes[i] = f.step
            moved = {**at, **{n: at[n] + x * f.step for n, x in f.constants.items()}}
            out.append((rows(self._with(data, sizes), moved) - before) / f.step)
        return out

    def _moved(
        self, solution: Solution, data: Dataset, sizes: FloatArray
    ) -> tuple[FloatArray, bool]:
        """The FMU's parameters after a Gauss-Newton step of all that is free, within their
        bounds, and whether it takes more squares than noise would give it.
        """
        base = make_base(solution, data)
        q, found = base.orthonormal, []
        for column in self._columns(solution, data):
            found.append(column[: len(base.weight)] * base.weight)
        columns = np.column_stack(found)
        norms = np.linalg.norm(columns, axis=0)
        norms = np.where(norms > 0, norms, 1.0)
        columns = columns / norms
        apart = columns - q @ (q.T @ columns)
        left, singular, right = np.linalg.svd(apart, full_matrices=False)
        kept = singular > COLLINEAR
        triangle = singular[kept, None] * right[kept]
        target = left[:, kept].T @ base.residual
        low, high = (np.array([getattr(f, n) for f in self._free]) for n in ("low", "high"))
        room = ((low - sizes) * norms, (high - sizes) * norms)
        change = bounded_step(triangle, target, room, 0.0)
        fall = float(target @ target - np.sum((triangle @ change + target) ** 2))
        squares = float(base.residual @ base.residual)
        chance = squares * int(kept.sum()) / float(np.sum(base.share[base.balance]))
        return np.clip(sizes + change / norms, low, high), fall > chance

    def _why_not(self, candidate: Candidate) -> str | None:
        """Why a candidate is not proposed; None where it is."""
        if (candidate.effect.key, candidate.place) in self._inside:
            return "the joint file says that the FMU holds it"
        known = {n for r in candidate.effect.requires for n in r.any_of}
        if candidate.place in self._own and known & set(SIDE_INERTIAS):
            return "the inertia of that side is a parameter of the FMU and not known"
        if self._only and candidate.effect.family not in OUTSIDE:
            return "it cannot ride outside the FMU as a torque"
        return None

    def _by_whole_fits(self, ranking: Ranking, base: Base) -> Ranking:
        """The ranking with its best trials as their whole fits have them.

        Without the missing effect the FMU's parameters are off by as much as it takes, a tenth
        under a sensor whose gain is a tenth off, and the balance that is left out of that counts
        little. From there the right name may look like half of one that needs no other parameter
        moved.
        """
        first = next(
            (t for t in ranking.everything if t.candidate.label in ranking.significant), None
        )
        if first is None or not self._free:
            return ranking
        near = [t for t in ranking.everything if t.score >= RELATIVE_SHARE * first.score]
        again = {t.candidate.label: self._whole(t, base) for t in near[: 1 + MOST_RELATIVES]}
        every = [again.get(t.candidate.label, t) for t in ranking.everything]
        every.sort(key=lambda t: -t.score)
        shown = [again.get(t.candidate.label, t) for t in ranking.trials]
        shown.sort(key=lambda t: (t.candidate.label not in ranking.significant, -t.score))
        return replace(ranking, trials=tuple(shown), everything=tuple(every))

    def _whole(self, trial: Trial, base: Base) -> Trial:
        """A trial by its whole fit, where that is the better one."""
        solution = self.fitted(trial.candidate.model, {**base.solution.values, **trial.values})
        data = self.data_of(solution)
        balances = balances_of(solution.model, data.sensing, wrt=())
        values = settled(
            solution.model, data.sensing, [*data.train, *data.held_out], solution.values
        )
        left, held = (
            flatten(stack(balances, records, values), balances.balances)[0]
            if records
            else np.empty(0)
            for records in (data.train, data.held_out)
        )
        if len(left) != len(base.weight) or len(held) != len(base.held_weight):
            return trial
        whole = by_whole_fit(trial, base, values, left=left, held_left=held)
        return whole if whole.score > trial.score else trial

    def _proposed(self, ranking: Ranking) -> Ranking:
        """The ranking without what is not proposed."""
        reasons = {t.candidate.label: self._why_not(t.candidate) for t in ranking.everything}
        kept = tuple(t for t in ranking.everything if reasons[t.candidate.label] is None)
        first: dict[str, Trial] = {}
        for t in sorted(
            kept, key=lambda t: (t.candidate.label not in ranking.significant, -t.score)
        ):
            first.setdefault(t.key, t)
        gone = {
            t.key: str(reasons[t.candidate.label]) for t in ranking.everything if t.key not in first
        }
        return replace(
            ranking,
            trials=tuple(first.values()),
            everything=kept,
            significant=frozenset(n for n in ranking.significant if reasons.get(n) is None),
            not_testable=(
                *ranking.not_testable,
                *(NotTestable(key, why) for key, why in gone.items()),
            ),
        )


def with_nuisance(base: Base, columns: Sequence[FloatArray], names: Sequence[str]) -> Base:
    """The base with further columns that a candidate must stand out from.

    A column that lies in the span of those before it, but for a part that no candidate could be
    tried on, is left out: it has nothing of its own to explain, and its value would be noise.

    Parameters
    ----------
    base : Base
    columns : sequence of (training rows + held-out rows,) array
        Unweighted.
    names : sequence of str
    """
    count = len(base.weight)
    q, kept, extra, held, norms = base.orthonormal, [], [], [], []
    for name, column in zip(names, columns, strict=True):
        weighted = column[:count] * base.weight
        size = float(np.linalg.norm(weighted))
        if not size > 1e-12 * np.sqrt(count):
            continue
        weighted = weighted / size
        apart = weighted - q @ (q.T @ weighted)
        own = float(np.linalg.norm(apart))
        if own < COLLINEAR:
            continue
        q = np.column_stack([q, apart / own])
        kept.append(name)
        extra.append(weighted)
        norms.append(size)
        held.append(column[count:] * base.held_weight / size)
    if not kept:
        return base
    return replace(
        base,
        jacobian=np.column_stack([base.jacobian, *extra]),
        orthonormal=q,
        residual=base.residual - q @ (q.T @ base.residual),
        held_jacobian=np.column_stack([base.held_jacobian, *held]),
        names=(*base.names, *kept),
        norms=np.append(base.norms, norms),
        noise=None,
    )


def _extra(model: JointModel, data: Dataset) -> list[Candidate]:
    """Effects that need a parent which the FMU may hold itself, such as the Stribeck part of a
    Coulomb friction.
    """
    there = {c.label for c in offered(model, data)[0]}
    found = []
    for effect in EFFECTS.values():
        parents = [n for n in effect.needs if not model.has(n)]
        if (
            not _plain(effect)
            or not parents
            or any(EFFECTS[n].family not in OUTSIDE for n in parents)
            or "motor" not in effect.acts_on
        ):
            continue
        label = f"{effect.key}@motor" if len(effect.acts_on) > 1 else effect.key
        if label in there or model.has(effect.key, "motor") or effect.warms:
            continue
        bigger = model.add(label)
        term = next(t for t in bigger.terms if t.label == label)
        pairs = list(zip(term.names, effect.parameters, strict=True))
        names = [tuple(n for n, p in pairs if p.is_shape is shape) for shape in (False, True)]
        found.append(Candidate(label, effect, "motor", bigger, *names))
    return found


def _plain(effect: Effect) -> bool:
    return (
        effect.family in OUTSIDE
        and effect.candidate
        and not effect.needs_load
        and not effect.periodic
    )


__all__ = ["OUTSIDE", "FmuBench", "Freedom", "Whole", "freedom", "with_nuisance", "without_steep"]
