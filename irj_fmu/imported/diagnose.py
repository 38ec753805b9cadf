"""Which effect of the library a user's FMU lacks: candidates tried on the torque that it leaves
unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from casadi_models import EFFECTS, JointModel
from identification.data.check.gate import gate_warnings, gated
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.diagnosis.bench import Progress
from identification.diagnosis.candidates import Candidate, NotTestable, offered
from identification.diagnosis.claims import Claim, Ranking, rank
from identification.diagnosis.curve import Curve
from identification.diagnosis.diagnose import Diagnosis
from identification.diagnosis.improvement import Improvement, Step, visible_keys
from identification.diagnosis.learned import Doubt, Equivalence, LearnedClaim
from identification.diagnosis.lines import Line
from identification.diagnosis.locate import Unexplained, locate
from identification.diagnosis.session import Session, with_held_out
from identification.diagnosis.trials import Base, Trial, make_base, span_of
from identification.errors import InputError
from identification.fitting.assess import RATIO_LIMIT, BalanceError, Error, assess
from identification.fitting.engine import (
    Dataset,
    Solution,
    load_dataset,
    prepared_model,
    solve,
    weak_record,
)
from identification.naming.odds import Odds
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.compare import compare
from irj_fmu.imported.correction import Correction, correction_of
from irj_fmu.imported.fit import UserFit, fit
from irj_fmu.imported.model import UserModel, listed
from irj_fmu.imported.outputs import UserComparison
from irj_fmu.imported.sensitivity import scale_of
from irj_fmu.imported.tracking import balanced_records

if TYPE_CHECKING:
    from identification.balance.weak import WeakRecord

_STEP: Final = 0.01
_OUTSIDE: Final = ("friction", "torque")
"""Families of effects that can ride outside an FMU as a torque."""


@final
@dataclass(frozen=True)
class UserDiagnosis:
    """What a user's FMU lacks, as far as the records can tell.

    Attributes
    ----------
    model : UserModel
    diagnosis : Diagnosis
        Ranking and the first claim, as of a joint model.
    error : Error
        Of the balance with nothing added, on held-out rows.
    """

    model: UserModel
    diagnosis: Diagnosis
    error: Error
    solution: Solution
    records: tuple[Record, ...]

    @property
    def ranking(self) -> Ranking:
        """Candidates, best first."""
        return self.diagnosis.ranking

    @property
    def claims(self) -> tuple[Claim, ...]:
        """The first claim; empty where nothing significant is missing."""
        return self.diagnosis.claims

    @property
    def data(self) -> Dataset:
        """The balance of the FMU along the measured motion."""
        return self.diagnosis.data

    def as_json(self) -> dict[str, Any]:
        """Ranking and claims as data."""
        return {
            **self.diagnosis.as_json(),
            "fmu": self.model.fmu.path.name,
            "balance": self.error.as_json()["balances"],
        }

    def __repr__(self) -> str:
        return f"UserDiagnosis({self.diagnosis!r})"

    def __str__(self) -> str:
        return str(self.diagnosis)

    def add(self, label: str | None = None) -> UserModel:
        """The model with an effect outside it: the first claim's, or the named one of the ranking.

        Raises
        ------
        InputError
            Nothing is claimed, or no candidate has that label or key.
        """
        if label is None and not self.claims:
            said = (
                "nothing significant is missing"
                if self.diagnosis.outcome == "complete"
                else self.diagnosis.reason.rstrip(".")
            )
            raise InputError(
                f"{self.model.fmu.path.name}: {said}; name an effect of the ranking to add it "
                "all the same"
            )
        wanted = label or self.claims[0].label
        trial = next(
            (t for t in self.ranking.everything if wanted in (t.candidate.label, t.key)), None
        )
        if trial is None:
            there = ", ".join(t.candidate.label for t in self.ranking.everything)
            raise InputError(
                f"{wanted!r} is not among the candidates that these records can show: {there}"
            )
        values = {**_starts(trial.candidate.model), **self.solution.values, **trial.values}
        before = self.model.correction
        labels: tuple[str, ...] = (trial.candidate.label,)
        joint = trial.candidate.model
        free = (*trial.candidate.amplitudes, *trial.candidate.shapes)
        if before is not None:
            joint = replace(
                joint, terms=(*before.model.terms, *(t for t in joint.terms if t.label in labels))
            )
            values |= {
                **dict(zip(before.model.parameter_names, before.model.value_vector(), strict=True)),
                **trial.values,
            }
            labels, free = (*before.labels, *labels), (*before.free, *free)
        return replace(self.model, correction=correction_of(joint, labels, values, free))

    def refit(self, label: str | None = None) -> UserFit:
        """Add the effect and fit FMU and effect together by the error of the outputs."""
        return fit(self.add(label), self.records)


def _starts(model: JointModel) -> dict[str, float]:
    return dict(zip(model.parameter_names, model.value_vector(), strict=True))


def diagnose(
    model: UserModel | UserFit,
    records: Record | Sequence[Record],
    held_out: Record | Sequence[Record] = (),
    *,
    progress: Callable[[str, float], None] | None = None,
) -> UserDiagnosis:
    """Rank the effect library on the correction torque that a user's FMU needs.

    The effects that the joint file names (``effects = [...]``) count as part of the FMU and are not
    proposed; each fitted parameter of the FMU is a nuisance, so that an effect is named only for
    what no other value of it explains.

    Parameters
    ----------
    model : UserModel or UserFit
        Fitted, with a drive channel mapped to an input and a position to an output.
    records : Record or sequence of Record
    held_out : Record or sequence of Record
        Records the fit did not see; without them blocks of the records are held out.
    progress : callable, optional
        ``progress(text, share)``.

    Raises
    ------
    InputError
        Unusable records or channels.
    FmuError
        Where the FMU refuses a call.
    """
    say = progress or (lambda _text, _share: None)
    model = model.model if isinstance(model, UserFit) else model
    given = gated(listed(records), model.joint)
    apart = gated(listed(held_out), model.joint) if held_out else []
    train, held, note = with_held_out(given, apart)
    every = [*train, *held]
    say("following the motion", 0.05)
    balanced = balanced_records(model, every)
    joint = _outside_joint(model.joint)
    count = len(train)
    outside = replace(prepared_model(joint, balanced[0]), lagging_load=False)
    data = replace(load_dataset(balanced[:count], balanced[count:], joint, outside), note=note)
    columns = []
    for i, p in enumerate(model.parameters):
        say(f"sensitivity to {p.name}", 0.1 + 0.6 * i / max(len(model.parameters), 1))
        columns.append(_column(model, every, balanced, p.name, data))
    say("ranking the library", 0.75)
    bench = FmuBench(outside, data, columns, [p.name for p in model.parameters])
    session = Session(
        bench, lambda text, share: say(text, 0.75 + 0.25 * share), gate_warnings([*given, *apart])
    )
    decided = session.diagnose(session.start())
    found = Diagnosis(held_to_outputs(decided, compare(model, held)))
    say("done", 1.0)
    start = found.found.steps[0]
    return UserDiagnosis(model, found, start.held_out, start.solution, tuple(listed(records)))


def held_to_outputs(found: Improvement, outputs: UserComparison) -> Improvement:
    """The same result, but no all-clear while an output stands above its noise floor on held-out
    records.

    The balance at the drive does not see everything that an FMU can lack: a kinematic error, for
    one, moves the link alone.
    """
    over = [
        f"{c} {e.ratio:.3g} times" for c, e in outputs.outputs.items() if not e.ratio <= RATIO_LIMIT
    ]
    if not over or found.verdict not in ("complete", "nothing_missing"):
        return found
    named = ", ".join(" or ".join(c.effects) for c in found.claims)
    start = f"Missing: {named}. " if named else ""
    reason = (
        f"{start}The outputs of the FMU still stand above their noise floor on held-out data "
        f"({', '.join(over)}), "
        "and no other effect that can ride outside it explains that."
    )
    return replace(found, verdict="unexplained", reason=reason)


@final
class FmuBench:
    """What an FMU leaves along the measured motion, as the model that a session judges.

    A candidate rides outside as a torque; the FMU's own parameters move along linearly with it.

    Parameters
    ----------
    outside : JointModel
        Balance of what is left.
    data : Dataset
    columns : sequence of (rows,) array
        Derivative of every row with respect to each of the FMU's parameters.
    names : sequence of str
        Of these parameters.
    """

    def __init__(
        self,
        outside: JointModel,
        data: Dataset,
        columns: Sequence[FloatArray],
        names: Sequence[str],
    ) -> None:
        self.joint, self.data = data.joint, data
        self._outside, self._columns, self._names = outside, list(columns), list(names)

    def start(self) -> Solution:
        """The fit of the balance with nothing added."""
        return solve(self._outside, self.data)

    def fitted(
        self, model: JointModel, start: Mapping[str, float], *, again: bool = False
    ) -> Solution:
        """The fit of a balance with more terms."""
        return solve(model, self.data, start=start)

    def step(self, key: str | None, label: str | None, solution: Solution) -> Step:
        """The balance with its errors."""
        train = assess(solution.model, self.data, self.data.train, solution.values)
        held = assess(solution.model, self.data, self.data.held_out, solution.values)
        return Step(key, visible_keys(solution.model), train, held, solution, label)

    def added(self, trial: Trial, now: Step) -> Step:
        """The balance with a candidate as its trial found it, the FMU's parameters moved along.

        Nothing is simulated here: what is left is what was left, less the fall that the trial had.
        """
        held = trial.held_out_drop_percent
        falls = (trial.cv_drop_percent, trial.cv_drop_percent if math.isnan(held) else held)
        train, apart = (
            _fallen(e, trial.balance, f)
            for e, f in zip((now.train, now.held_out), falls, strict=True)
        )
        return Step(
            trial.key, (*now.effects, trial.key), train, apart, now.solution, trial.candidate.label
        )

    def listen(self, step: Step) -> None:
        """Nothing: what a tracked FMU leaves is averaged already, and holds no line."""

    def base(self, solution: Solution) -> Base:
        """Rows of the balance, with the FMU's parameters as nuisance."""
        return with_nuisance(make_base(solution, self.data), self._columns, self._names)

    def ranking(
        self, base: Base, *, late: bool = False, progress: Progress | None = None
    ) -> Ranking:
        """The effects that can ride outside as a torque."""
        return _only_outside(
            rank(base, _extra(self._outside, self.data), late=late, progress=progress)
        )

    def tried(self, solution: Solution) -> list[str]:
        """Keys of the effects that can ride outside as a torque."""
        every = [*offered(solution.model, self.data)[0], *_extra(self._outside, self.data)]
        return [c.effect.key for c in every if c.effect.family in _OUTSIDE]

    def ratios(self, step: Step) -> dict[str, BalanceError]:
        """Of the one balance, at the kernel of the claims."""
        return dict(step.held_out.balances)

    def shown(self, step: Step) -> Step:
        """The step: its one kernel is that of the verdict."""
        return step

    def lines(self, step: Step) -> list[Line]:
        """None are looked for: the FMU has its own periodic parts."""
        return []

    def places(
        self, step: Step, error: Error, lines: Sequence[Line], limit: float
    ) -> list[Unexplained]:
        """Where the balance as it stands is over its floor; with a candidate, only that it
        still is.
        """
        if step.label is None:
            return locate(step.solution, self.data, error, lines, limit)
        return [
            Unexplained(b, 0.0, rms=e.rms)
            for b, e in error.balances.items()
            if not e.ratio <= limit
        ]

    def learned(self, step: Step, error: Error) -> tuple[LearnedClaim, ...]:
        """None: a curve cannot ride outside an FMU yet."""
        return ()

    def held_against(self, claims: Sequence[Claim], step: Step) -> Mapping[str, Equivalence]:
        """None: a curve cannot ride outside an FMU yet."""
        return {}

    def artefacts(self, step: Step, curves: Sequence[Curve], start: Step) -> tuple[Doubt, ...]:
        """None: the FMU has its own parameters."""
        return ()

    def same_sign(self, trial: Trial, solution: Solution) -> bool:
        """No minor effects are looked for."""
        return False

    def odds(
        self, claim: Claim, near: Mapping[str, float], now: Step, last: Ranking
    ) -> Odds | None:
        """None: nothing is fitted whole outside an FMU, and its trials have told what there is."""
        return None


def _fallen(error: Error, balance: str, percent: float) -> Error:
    """An error after a fall of the RMS of one balance."""
    share = 1 - percent / 100
    before = error.balances[balance]
    after = replace(
        before,
        rms=before.rms * share,
        ratio=before.ratio * share,
        residual=before.residual * share,
    )
    power = sum(e.rms**2 for e in error.balances.values())
    left = math.sqrt(max(power - before.rms**2 + after.rms**2, 0.0) / power) if power > 0 else 1.0
    return replace(
        error,
        relative_error_percent=error.relative_error_percent * left,
        fit_percent=100 - (100 - error.fit_percent) * left,
        vaf_percent=100 - (100 - error.vaf_percent) * left**2,
        balances={**error.balances, balance: after},
    )


def _outside_joint(joint: Joint) -> Joint:
    """The joint that is balanced: rigid, with the effects that the file says the FMU has."""
    return Joint(
        name=joint.name,
        kind=joint.kind,
        gear_ratio=joint.gear_ratio,
        model_name="hd1",
        effects=joint.effects,
        virtual_work=joint.virtual_work,
        source=joint.source,
    )


def _column(
    model: UserModel,
    records: Sequence[Record],
    balanced: Sequence[Record],
    name: str,
    data: Dataset,
) -> FloatArray:
    """Derivative of every row with respect to a parameter of the FMU, training rows first [N.m
    per unit].
    """
    value = model.values[name]
    step = _STEP * scale_of(value, model.bounds()[name])
    if value + step > model.bounds()[name][1]:
        step = -step
    moved = balanced_records(model, records, {name: value + step})
    rows: list[WeakRecord] = []
    for a, b in zip(moved, balanced, strict=True):
        change = b.with_channel("motor_torque", (a["motor_torque"] - b["motor_torque"]) / step)
        rows.append(weak_record(change, data.joint, data.sensing, data.kernel))
    return np.concatenate([w.averaged["drive"] for w in rows])


def with_nuisance(base: Base, columns: Sequence[FloatArray], names: Sequence[str]) -> Base:
    """The base with further columns that a candidate must stand out from.

    Parameters
    ----------
    base : Base
        Of one balance.
    columns : sequence of (training rows + held-out rows,) array
        Unweighted.
    names : sequence of str
    """
    count = len(base.weight)
    kept, extra, held = [], [], []
    for name, column in zip(names, columns, strict=True):
        weighted = column[:count] * base.weight
        size = float(np.linalg.norm(weighted))
        if size > 1e-12 * math.sqrt(count):
            kept.append(name)
            extra.append(weighted / size)
            held.append(column[count:] * base.held_weight / size)
    if not kept:
        return base
    jacobian = np.column_stack([base.jacobian, *extra])
    orthonormal = span_of(jacobian)
    return replace(
        base,
        jacobian=jacobian,
        orthonormal=orthonormal,
        residual=base.residual - orthonormal @ (orthonormal.T @ base.residual),
        held_jacobian=np.column_stack([base.held_jacobian, *held]),
        names=(*base.names, *kept),
    )


def _extra(model: JointModel, data: Dataset) -> list[Candidate]:
    """Effects that need a parent which the FMU may hold itself, such as the Stribeck part of a
    Coulomb friction.
    """
    there = {c.label for c in offered(model, data)[0]}
    found = []
    for effect in EFFECTS.values():
        parents = [n for n in effect.needs if not model.has(n)]
        plain = (
            effect.family in _OUTSIDE
            and effect.candidate
            and not effect.needs_load
            and not effect.periodic
        )
        if (
            not plain
            or not parents
            or any(EFFECTS[n].family not in _OUTSIDE for n in parents)
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


def _only_outside(ranking: Ranking) -> Ranking:
    """The ranking without effects that cannot ride outside as a torque."""

    def fits(effect: Any) -> bool:
        return effect.family in _OUTSIDE

    gone = {t.key: t for t in ranking.everything if not fits(t.candidate.effect)}
    refused = tuple(NotTestable(key, "it cannot ride outside the FMU as a torque") for key in gone)
    return replace(
        ranking,
        trials=tuple(t for t in ranking.trials if fits(t.candidate.effect)),
        everything=tuple(t for t in ranking.everything if fits(t.candidate.effect)),
        significant=frozenset(
            n for n in ranking.significant if n not in {t.candidate.label for t in gone.values()}
        ),
        not_testable=(*ranking.not_testable, *refused),
    )


__all__ = ["Correction", "UserDiagnosis", "diagnose", "held_to_outputs", "with_nuisance"]
