"""Which effect of the library a user's FMU lacks: candidates tried on the torque that it leaves unexplained."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from casadi_models import EFFECTS, JointModel
from identification.assess import Error, assess
from identification.candidates import Candidate, NotTestable, offered
from identification.claims import Claim, Ranking, make_claim, rank
from identification.diagnose import Diagnosis
from identification.engine import Dataset, Solution, load_dataset, prepared_model, solve, weak_record
from identification.errors import InputError
from identification.improve import excitation_warnings, with_held_out
from identification.joint_file import Joint
from identification.record import Record
from identification.trials import Base, make_base

from .signals import FloatArray
from .user_correction import Correction, correction_of
from .user_model import UserModel, listed
from .user_sensitivity import scale_of
from .user_tracking import balanced_records

if TYPE_CHECKING:
    from identification.weak import WeakRecord

    from .user_fit import UserFit

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
        return {**self.diagnosis.as_json(), "fmu": self.model.fmu.path.name, "balance": self.error.as_json()["balances"]}

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
            raise InputError(f"{self.model.fmu.path.name}: nothing significant is missing; name an effect of the ranking to add it all the same")
        wanted = label or self.claims[0].label
        trial = next((t for t in self.ranking.everything if wanted in (t.candidate.label, t.key)), None)
        if trial is None:
            there = ", ".join(t.candidate.label for t in self.ranking.everything)
            raise InputError(f"{wanted!r} is not among the candidates that these records can show: {there}")
        values = {**_starts(trial.candidate.model), **self.solution.values, **trial.values}
        before = self.model.correction
        labels: tuple[str, ...] = (trial.candidate.label,)
        joint = trial.candidate.model
        free = (*trial.candidate.amplitudes, *trial.candidate.shapes)
        if before is not None:
            joint = replace(joint, terms=(*before.model.terms, *(t for t in joint.terms if t.label in labels)))
            values |= {**dict(zip(before.model.parameter_names, before.model.value_vector(), strict=True)), **trial.values}
            labels, free = (*before.labels, *labels), (*before.free, *free)
        return replace(self.model, correction=correction_of(joint, labels, values, free))

    def refit(self, label: str | None = None) -> UserFit:
        """Add the effect and fit FMU and effect together by the error of the outputs."""
        return self.add(label).fit(self.records)


def _starts(model: JointModel) -> dict[str, float]:
    return dict(zip(model.parameter_names, model.value_vector(), strict=True))


def diagnose(
    model: UserModel, records: Record | Sequence[Record], held_out: Record | Sequence[Record] = (), *,
    progress: Callable[[str, float], None] | None = None,
) -> UserDiagnosis:  # fmt: skip
    """Rank the effect library on the correction torque that a user's FMU needs.

    The effects that the joint file names (``effects = [...]``) count as part of the FMU and are not proposed; each fitted
    parameter of the FMU is a nuisance, so that an effect is named only for what no other value of it explains.

    Parameters
    ----------
    model : UserModel
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
    train, held, note = with_held_out(listed(records), listed(held_out) if held_out else [])
    every = [*train, *held]
    say("following the motion", 0.05)
    balanced = balanced_records(model, every)
    joint = _outside_joint(model.joint)
    count = len(train)
    outside = replace(prepared_model(joint, balanced[0]), lagging_load=False)
    data = replace(load_dataset(balanced[:count], balanced[count:], joint, outside), note=note)
    solution = solve(outside, data)
    columns = []
    for i, p in enumerate(model.parameters):
        say(f"sensitivity to {p.name}", 0.1 + 0.6 * i / max(len(model.parameters), 1))
        columns.append(_column(model, every, balanced, p.name, data))
    say("ranking the library", 0.75)
    base = with_nuisance(make_base(solution, data), columns, [p.name for p in model.parameters])
    ranking = _only_outside(rank(base, _extra(outside, data)))
    best = ranking.best()
    claims = (make_claim(best, ranking, base),) if best is not None else ()
    error = assess(solution.model, data, data.held_out, solution.values)
    say("done", 1.0)
    return UserDiagnosis(model, Diagnosis(ranking, claims, data, excitation_warnings(data)), error, solution, tuple(listed(records)))


def _outside_joint(joint: Joint) -> Joint:
    """The joint that is balanced: rigid, with the effects that the file says the FMU has."""
    return Joint(
        name=joint.name, kind=joint.kind, gear_ratio=joint.gear_ratio, model_name="hd1", effects=joint.effects,
        virtual_work=joint.virtual_work, source=joint.source,
    )  # fmt: skip


def _column(model: UserModel, records: Sequence[Record], balanced: Sequence[Record], name: str, data: Dataset) -> FloatArray:
    """Derivative of every row with respect to a parameter of the FMU, training rows first [N.m per unit]."""
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
    left, singular, _ = np.linalg.svd(jacobian, full_matrices=False)
    orthonormal = left[:, singular > 1e-9 * float(singular[0])]
    return replace(
        base, jacobian=jacobian, orthonormal=orthonormal, residual=base.residual - orthonormal @ (orthonormal.T @ base.residual),
        held_jacobian=np.column_stack([base.held_jacobian, *held]), names=(*base.names, *kept),
    )  # fmt: skip


def _extra(model: JointModel, data: Dataset) -> list[Candidate]:
    """Effects that need a parent which the FMU may hold itself, such as the Stribeck part of a Coulomb friction."""
    there = {c.label for c in offered(model, data)[0]}
    found = []
    for effect in EFFECTS.values():
        parents = [n for n in effect.needs if not model.has(n)]
        plain = effect.family in _OUTSIDE and effect.candidate and not effect.needs_load and not effect.periodic
        if not plain or not parents or any(EFFECTS[n].family not in _OUTSIDE for n in parents) or "motor" not in effect.acts_on:
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
        ranking, trials=tuple(t for t in ranking.trials if fits(t.candidate.effect)),
        everything=tuple(t for t in ranking.everything if fits(t.candidate.effect)),
        significant=frozenset(n for n in ranking.significant if n not in {t.candidate.label for t in gone.values()}),
        not_testable=(*ranking.not_testable, *refused),
    )  # fmt: skip


__all__ = ["Correction", "UserDiagnosis", "diagnose", "with_nuisance"]
