"""Name what a user's FMU lacks, add it outside, fit again, until nothing is left to name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np

from identification.balance.excitation import few_reversals
from identification.data.check.gate import gated
from identification.data.record import Record
from identification.diagnosis.claims import Claim
from identification.diagnosis.improvement import Improvement, Step, held_drop
from identification.diagnosis.session import LEAST_ADDED_DROP, MAX_ADDITIONS, with_held_out
from identification.diagnosis.verdict import verdict_of
from irj_fmu.imported.bench import Whole
from irj_fmu.imported.compare import compare
from irj_fmu.imported.correction import PREFIX
from irj_fmu.imported.diagnose import UserDiagnosis, diagnose, held_to_outputs, with_outside
from irj_fmu.imported.fit import fit, parameter_table
from irj_fmu.imported.model import UserModel, at_least_one
from irj_fmu.imported.outputs import UserComparison, noise_of
from irj_fmu.imported.port import coupled


@final
@dataclass(frozen=True)
class UserImprovement:
    """Result of the loop on a user's FMU.

    Attributes
    ----------
    found : Improvement
        Steps, claims and verdict as of a joint model; its errors are those of the balance at the
        drive.
    diagnoses : tuple of UserDiagnosis
        Of the start model and of the model after each addition.
    outputs : tuple of UserComparison
        The same models against the held-out records.
    stderr : mapping of str to float or None
        Standard errors of the last model's values, in their units; None where the records do not
        show a parameter.
    """

    found: Improvement
    diagnoses: tuple[UserDiagnosis, ...]
    outputs: tuple[UserComparison, ...]
    stderr: Mapping[str, float | None] = field(default_factory=dict)

    @property
    def model(self) -> UserModel:
        """The FMU with all that was added outside, fitted: by its outputs, or, where an effect is
        named that cannot ride outside, by what the restarts leave beside that effect.
        """
        return self.diagnoses[-1].model

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Value, standard error, unit and flags of each parameter of the last model."""
        return parameter_table(self.model, self.stderr)

    @property
    def outcome(self) -> str:
        """One of :data:`identification.diagnosis.outcome.OUTCOMES`."""
        return self.found.outcome

    def as_json(self) -> dict[str, Any]:
        """The data of `improve --json`, with the outputs at each step and the values of the FMU."""
        steps = [s.as_json(d.data) for s, d in zip(self.found.steps, self.diagnoses, strict=True)]
        return {
            **self.found.as_json(),
            "steps": steps,
            "fmu": self.model.fmu.path.name,
            "outputs": [o.as_json()["outputs"] for o in self.outputs],
            "values": self.model.values,
            "stderr": dict(self.stderr),
        }

    def __repr__(self) -> str:
        return f"UserImprovement({self.found!r})"

    def __str__(self) -> str:
        return str(self.found)


def improve(
    model: UserModel,
    records: Record | Sequence[Record],
    held_out: Record | Sequence[Record] = (),
    *,
    max_additions: int = MAX_ADDITIONS,
    progress: Callable[[str, float], None] | None = None,
) -> UserImprovement:
    """Find the effects that a user's FMU lacks, add them outside it and measure the error on
    held-out records.

    Each addition is decided by a diagnosis of the model as it then stands, fitted together with the
    FMU by the error of the outputs, and kept where the held-out error of the outputs falls.

    Parameters
    ----------
    model : UserModel
    records, held_out : Record or sequence of Record
        Without held-out records the last blocks of the training records are held out.
    max_additions : int
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
    given = gated(at_least_one(records), model.joint)
    apart = gated(at_least_one(held_out), model.joint) if held_out else []
    train, held, note = with_held_out(given, apart)

    def looked_at(now: UserModel, number: int) -> _Looked:
        share = number / (max_additions + 1)
        if not now.values:
            return _Looked(now, compare(now, held), {})
        fitted = fit(now, train, progress=lambda text, _: say(text, share))
        return _Looked(fitted.model, compare(fitted, held), fitted.stderr)

    first = looked_at(model, 0)
    begun = diagnose(first.model, train, held)
    if not begun.why_followed:
        if begun.claims and max_additions > 1:
            begun = diagnose(first.model, train, held, most=max_additions)
        steps = begun.diagnosis.found.steps
        looked = [first]
        aside: list[str] = []
        for number, (claim, step, whole) in enumerate(
            zip(begun.diagnosis.found.claims, steps[1:], begun.wholes[1:], strict=True), 1
        ):
            joint, now = step.solution.model, looked[-1].model
            place = next(t.place for t in joint.terms if t.label == claim.label)
            if begun.stays(claim.effect, place):
                aside.append(claim.effect.title)
            else:
                say(f"adding {claim.label}", number / (max_additions + 1))
                now = with_outside(now, joint, claim.label, step.solution.values)
            now, errors = _as_whole(now, begun, step, whole)
            if aside:
                now = coupled(now, now.windows(train), noise_of(now, train))
                looked.append(_Looked(now, compare(now, held), errors))
            else:  # from there: the fit before made up for what was missing
                looked.append(looked_at(now, number))
        say("done", 1.0)
        found = replace(begun.diagnosis.found, data=replace(begun.data, note=note))
        return UserImprovement(
            _with_aside(found, looked[-1].outputs, aside),
            tuple(replace(begun, model=n.model) for n in looked),
            tuple(n.outputs for n in looked),
            _with_names(looked[-1].stderr, begun.apart),
        )
    diagnoses, compared, stderr = [begun], [first.outputs], first.stderr
    claims: list[Claim] = []
    following = None
    while diagnoses[-1].claims:
        claim = diagnoses[-1].claims[0]
        if len(claims) >= max_additions:
            following = (
                f"Stopped at the limit of additions ({len(claims)}): "
                f"{claim.effect.title} would be the next."
            )
            break
        before = diagnoses[-1].model.correction
        if before is not None and claim.label in before.labels:
            following = (
                f"{claim.effect.title} is outside already and is asked for again: its "
                "law does not fit."
            )
            break
        say(f"adding {claim.label}", len(claims) / (max_additions + 1))
        after = looked_at(diagnoses[-1].add(), len(claims) + 1)
        fall = 100 * (1 - _size(after.outputs) / _size(compared[-1]))
        if fall < LEAST_ADDED_DROP:
            following = (
                f"{claim.effect.title} would be the next, but lowers the held-out error "
                f"of the outputs by {fall:.2g} % only."
            )
            break
        diagnoses.append(diagnose(after.model, train, held))
        compared.append(after.outputs)
        stderr = after.stderr
        claims.append(claim)
    say("done", 1.0)
    return UserImprovement(
        _result(diagnoses, compared, claims, following, note),
        tuple(diagnoses),
        tuple(compared),
        stderr,
    )


@final
@dataclass(frozen=True)
class _Looked:
    """A fitted model, its outputs against the held-out records, standard errors of its values."""

    model: UserModel
    outputs: UserComparison
    stderr: Mapping[str, float | None]


def _as_whole(
    model: UserModel, begun: UserDiagnosis, step: Step, whole: Whole
) -> tuple[UserModel, dict[str, float | None]]:
    """The model at the values of the whole fit of a step, and their errors.

    The outputs of an FMU without an effect that cannot ride outside it are met best by parameters
    that make up for that effect.
    """
    values = {n: begun.model.values[n] + change for n, change in whole.changes.items()}
    values |= {PREFIX + n: x for n, x in step.solution.values.items() if PREFIX + n in model.values}
    stderr = {n: whole.stderr.get(n, whole.stderr.get(n.removeprefix(PREFIX))) for n in values}
    return model.with_values(values), stderr


def _with_names(
    stderr: Mapping[str, float | None], apart: Mapping[str, float]
) -> dict[str, float | None]:
    """Standard errors with what the other names of sets would make of the values."""
    return {n: e and math.hypot(e, apart.get(n, 0.0)) for n, e in stderr.items()}


def _with_aside(found: Improvement, outputs: UserComparison, aside: Sequence[str]) -> Improvement:
    """The result of restarts: held to the outputs where all that is named rides outside."""
    if not aside:
        return held_to_outputs(found, outputs)
    reason = (
        f"{found.reason} The outputs are those without {' and '.join(aside)}, which cannot ride "
        "outside the FMU as a torque at its drive."
    )
    return replace(found, reason=reason)


def _size(outputs: UserComparison) -> float:
    """Error of all outputs, each over its noise floor."""
    return float(np.sqrt(np.mean([e.ratio**2 for e in outputs.outputs.values()])))


def _result(
    diagnoses: Sequence[UserDiagnosis],
    outputs: Sequence[UserComparison],
    claims: Sequence[Claim],
    following: str | None,
    note: str,
) -> Improvement:
    first, last = diagnoses[0].diagnosis.found, diagnoses[-1].diagnosis.found
    starts = [d.diagnosis.found.steps[0] for d in diagnoses]
    named = [
        replace(s, added=c.effects[0], label=c.label)
        for s, c in zip(starts[1:], claims, strict=True)
    ]
    steps = (starts[0], *named)
    judged = tuple(
        replace(c, held_out_drop_percent=held_drop(a.held_out, b.held_out, c.balance))
        for c, a, b in zip(claims, steps[:-1], steps[1:], strict=True)
    )
    data = replace(last.data, note=note)
    whole = replace(
        last,
        data=data,
        steps=steps,
        claims=judged,
        minor=(),
        ranking=first.ranking,
        warnings=tuple(dict.fromkeys((*first.warnings, *last.warnings))),
        decided=judged,
    )
    if first.verdict == "not_identifiable" and not claims:
        return whole
    ratios = dict(steps[-1].held_out.balances)
    where = last.unexplained if not last.claims or following else ()
    verdict, reason = verdict_of(
        judged, where, {**ratios, **last.final_ratios}, steps, following, few=few_reversals(data)
    )
    if following is not None and verdict != "unexplained":
        verdict, reason = "unexplained", f"{reason} {following}" if judged else following
    return held_to_outputs(replace(whole, verdict=verdict, reason=reason), outputs[-1])


__all__ = ["UserImprovement", "improve"]
