"""Name what a user's FMU lacks, add it outside, fit again, until nothing is left to name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from identification.balance.excitation import few_reversals
from identification.data.check.gate import gated
from identification.data.record import Record
from identification.diagnosis.claims import Claim
from identification.diagnosis.improvement import Improvement, held_drop
from identification.diagnosis.session import LEAST_ADDED_DROP, MAX_ADDITIONS, with_held_out
from identification.diagnosis.verdict import verdict_of
from irj_fmu.imported.compare import compare
from irj_fmu.imported.diagnose import UserDiagnosis, diagnose, held_to_outputs, with_outside
from irj_fmu.imported.fit import fit
from irj_fmu.imported.model import UserModel, at_least_one
from irj_fmu.imported.outputs import UserComparison


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
    """

    found: Improvement
    diagnoses: tuple[UserDiagnosis, ...]
    outputs: tuple[UserComparison, ...]

    @property
    def model(self) -> UserModel:
        """The FMU with all that was added outside, fitted."""
        return self.diagnoses[-1].model

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

    def looked_at(now: UserModel, number: int) -> tuple[UserModel, UserComparison]:
        share = number / (max_additions + 1)
        fitted = (
            fit(now, train, progress=lambda text, _: say(text, share)).model if now.values else now
        )
        return fitted, compare(fitted, held)

    start, outputs = looked_at(model, 0)
    begun = diagnose(start, train, held)
    if not begun.why_followed:
        if begun.claims and max_additions > 1:
            begun = diagnose(start, train, held, most=max_additions)
        steps = begun.diagnosis.found.steps
        models, compared = [start], [outputs]
        aside: list[str] = []
        for number, (claim, step) in enumerate(
            zip(begun.diagnosis.found.claims, steps[1:], strict=True), 1
        ):
            joint = step.solution.model
            place = next(t.place for t in joint.terms if t.label == claim.label)
            now, after = models[-1], compared[-1]
            if begun.stays(claim.effect, place):
                aside.append(claim.effect.title)
            else:
                say(f"adding {claim.label}", number / (max_additions + 1))
                larger = with_outside(now, joint, claim.label, step.solution.values)
                now, after = looked_at(larger, number)
            models.append(now)
            compared.append(after)
        say("done", 1.0)
        found = replace(begun.diagnosis.found, data=replace(begun.data, note=note))
        return UserImprovement(
            _with_aside(found, compared[-1], aside),
            tuple(replace(begun, model=m) for m in models),
            tuple(compared),
        )
    diagnoses, compared = [begun], [outputs]
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
        larger, after = looked_at(diagnoses[-1].add(), len(claims) + 1)
        fall = 100 * (1 - _size(after) / _size(compared[-1]))
        if fall < LEAST_ADDED_DROP:
            following = (
                f"{claim.effect.title} would be the next, but lowers the held-out error "
                f"of the outputs by {fall:.2g} % only."
            )
            break
        diagnoses.append(diagnose(larger, train, held))
        compared.append(after)
        claims.append(claim)
    say("done", 1.0)
    return UserImprovement(
        _result(diagnoses, compared, claims, following, note), tuple(diagnoses), tuple(compared)
    )


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
