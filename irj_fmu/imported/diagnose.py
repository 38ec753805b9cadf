"""Which effect of the library a user's FMU lacks: candidates tried on the torque that it leaves
unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, final

from casadi_models import Effect, JointModel
from casadi_models.joint import TWIST
from identification.balance.dataset import with_effect, without
from identification.data.check.gate import gate_warnings, gated
from identification.data.joint_file import Joint, Known
from identification.data.record import Record
from identification.diagnosis.claims import Claim, Ranking
from identification.diagnosis.diagnose import Diagnosis
from identification.diagnosis.improvement import Improvement
from identification.diagnosis.session import Session, with_held_out
from identification.errors import InputError
from identification.fitting.assess import RATIO_LIMIT, Error
from identification.fitting.engine import (
    Dataset,
    Solution,
    load_dataset,
    prepared_model,
)
from irj_fmu.imported.bench import OUTSIDE, FmuBench, Freedom, Whole, freedom, without_steep
from irj_fmu.imported.compare import compare
from irj_fmu.imported.correction import Correction, correction_of
from irj_fmu.imported.fit import UserFit, fit
from irj_fmu.imported.model import UserModel, at_least_one
from irj_fmu.imported.outputs import UserComparison
from irj_fmu.imported.port import port_of
from irj_fmu.imported.restart import Restart
from irj_fmu.imported.sensitivity import scale_of
from irj_fmu.imported.tracking import Following

_STEP: Final = 0.01


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
        Of the balances with nothing added, on held-out rows.
    why_followed : str
        Why the FMU had to follow the measured motion, seen at the drive alone, and was not
        restarted at measured states; empty where it was.
    wholes : tuple of Whole
        The FMU's parameters as the whole fit of each step of the diagnosis has them.
    apart : mapping of str to float
        By how much these differ from the last of it where another name of a set is taken: RMS over
        the names, which count alike.
    """

    model: UserModel
    diagnosis: Diagnosis
    error: Error
    solution: Solution
    records: tuple[Record, ...]
    why_followed: str = ""
    wholes: tuple[Whole, ...] = ()
    apart: Mapping[str, float] = field(default_factory=dict)

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
        why = self.stays(trial.candidate.effect, trial.candidate.place)
        if why:
            raise InputError(f"{self.model.fmu.path.name}: {trial.candidate.label} {why}")
        values = {**self.solution.values, **trial.values}
        return with_outside(self.model, trial.candidate.model, trial.candidate.label, values)

    def stays(self, effect: Effect, place: str) -> str:
        """Why an effect cannot ride outside the FMU; empty where it can."""
        return stays(self.model, effect, place)

    def refit(self, label: str | None = None) -> UserFit:
        """Add the effect and fit FMU and effect together by the error of the outputs."""
        return fit(self.add(label), self.records)


def stays(model: UserModel, effect: Effect, place: str) -> str:
    """Why an effect at a place cannot ride outside an FMU; empty where it can."""
    if effect.family not in OUTSIDE:
        return "acts inside the gear or at a sensor; only a torque at the drive rides outside"
    driven = port_of(model).output
    side = model.outputs[driven].channel.partition("_")[0]
    both = {"motor_position", "link_position"} <= {m.channel for m in model.outputs}
    if both and place not in (side, "drive"):
        return f"acts at the {place}; only a torque at the drive rides outside"
    return ""


def with_outside(
    model: UserModel, joint: JointModel, label: str, values: Mapping[str, float]
) -> UserModel:
    """A model with one more effect outside.

    Parameters
    ----------
    model : UserModel
    joint : JointModel
        Has the effect.
    label : str
        Of the effect in it.
    values : mapping
        Of the parameters of `joint`, as far as they are known.
    """
    term = next(t for t in joint.terms if t.label == label)
    before = model.correction
    labels: tuple[str, ...] = (label,)
    known = {**_starts(joint), **values}
    if before is not None:
        joint = replace(joint, terms=(*before.model.terms, term))
        theirs = dict(zip(before.model.parameter_names, before.model.value_vector(), strict=True))
        known |= {**theirs, **{n: known[n] for n in term.names}}
        labels = (*before.labels, *labels)
    return replace(model, correction=correction_of(joint, labels, known))


def _starts(model: JointModel) -> dict[str, float]:
    return dict(zip(model.parameter_names, model.value_vector(), strict=True))


@final
@dataclass(frozen=True)
class LaidOpen:
    """What a user's FMU leaves in records, ready to be judged.

    Attributes
    ----------
    model : UserModel
    bench : FmuBench
    session : Session
        On that bench.
    train, held_out : tuple of Record
        Through the gate; a part of the records where none were held out.
    why_followed : str
        See :class:`UserDiagnosis`.
    """

    model: UserModel
    bench: FmuBench
    session: Session
    train: tuple[Record, ...]
    held_out: tuple[Record, ...]
    why_followed: str = ""


def laid_open(
    model: UserModel,
    records: Record | Sequence[Record],
    held_out: Record | Sequence[Record] = (),
    *,
    progress: Callable[[str, float], None] | None = None,
) -> LaidOpen:
    """Run an FMU along records, once as it is and once for each of its parameters.

    Parameters
    ----------
    model : UserModel
    records, held_out : Record or sequence of Record
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
    every = [*train, *held]
    count = len(train)
    say("what the FMU leaves", 0.05)
    left, why = _left_of(model, every)
    before = [left.record(r) for r in every]
    joint = _outside_joint(model.joint, left)
    outside = replace(prepared_model(joint, before[0]), lagging_load=False)
    steep = [left.steep(r) for r in every] if isinstance(left, Restart) else []

    def prepared(given: Sequence[Record], now: Joint = joint) -> Dataset:
        made = load_dataset(given[:count], given[count:], now, outside)
        return without_steep(replace(made, note=note), given, steep)

    data = prepared(before)
    free: list[Freedom] = []
    own: frozenset[str] = frozenset()
    values, bounds = model.values, model.bounds()
    for i, (name, value) in enumerate(values.items()):
        say(f"sensitivity to {name}", 0.1 + 0.6 * i / len(values))
        low, high = bounds[name]
        step = _STEP * scale_of(value, (low, high))
        step = -step if value + step > high else step
        constants: dict[str, float] = {}
        if isinstance(left, Restart):
            follow = left.inertias_at({name: value + step})
            own |= left.moved_inertias(name, step)
            constants = {n: x - left.sizes[n] for n, x in left.sizes_of(follow).items()}
            after = [left.record(r, {name: value + step}, follow) for r in every]
        else:
            after = [left.record(r, {name: value + step}) for r in every]
        pairs = list(zip(before, after, strict=True))
        free.append(freedom(name, (low - value, high - value), step, pairs, data, constants))
    say("ranking the library", 0.75)
    inside = model.joint.model().terms
    if model.correction is not None:
        inside = (*inside, *model.correction.model.terms)

    def remade(added: Mapping[str, float]) -> Dataset:
        at = {n: values[n] + x for n, x in added.items()}
        if not isinstance(left, Restart):
            return prepared([left.record(r, at) for r in every])
        inertias = left.inertias_at(at)
        known = {n: Known(value=size) for n, size in left.sizes_of(inertias).items()}
        return prepared(
            [left.record(r, at, inertias) for r in every],
            replace(joint, known={**joint.known, **known}),
        )

    bench = FmuBench(
        outside, data, free, remade, inside=inside, own_inertias=own, only_torque=bool(why)
    )
    session = Session(
        bench, lambda text, share: say(text, 0.75 + 0.25 * share), gate_warnings([*given, *apart])
    )
    return LaidOpen(model, bench, session, tuple(train), tuple(held), why_followed=why)


def diagnose(
    model: UserModel | UserFit,
    records: Record | Sequence[Record],
    held_out: Record | Sequence[Record] = (),
    *,
    most: int | None = None,
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
    most : int, optional
        Look for so many effects, each beside those before it; by default for the first one.
    progress : callable, optional
        ``progress(text, share)``.

    Raises
    ------
    InputError
        Unusable records or channels.
    FmuError
        Where the FMU refuses a call.
    """
    model = model.model if isinstance(model, UserFit) else model
    opened = laid_open(model, records, held_out, progress=progress)
    bench, session, why = opened.bench, opened.session, opened.why_followed
    solution = session.start()
    decided = session.diagnose(solution) if most is None else session.run(solution, most)
    # a claim that the restarts of both sides bear out is judged there: the outputs lack it still
    seen = not why and bool(decided.claims)
    between = {} if why else _apart(bench, decided)
    wholes = tuple(bench.whole(s.solution) for s in decided.steps)
    decided = _with_errors(decided, wholes)
    found = Diagnosis(
        decided if seen else held_to_outputs(decided, compare(model, opened.held_out))
    )
    if progress is not None:
        progress("done", 1.0)
    start = found.found.steps[0]
    return UserDiagnosis(
        model,
        found,
        start.held_out,
        start.solution,
        tuple(at_least_one(records)),
        why_followed=why,
        wholes=wholes,
        apart=between,
    )


def _with_errors(found: Improvement, wholes: Sequence[Whole]) -> Improvement:
    """The same result, the errors of its effects those of the whole fits: a step of a session has
    the FMU's parameters as known.
    """
    steps = []
    for step, whole in zip(found.steps, wholes, strict=True):
        own = {n: whole.stderr.get(n, e) for n, e in step.solution.stderr.items()}
        steps.append(replace(step, solution=replace(step.solution, stderr=own)))
    return replace(found, steps=tuple(steps))


def _apart(bench: FmuBench, found: Improvement) -> dict[str, float]:
    """RMS over the names of sets by which the FMU's parameters differ from those of the first
    names, each set by itself.
    """
    last = found.steps[-1].solution
    first = bench.changes(last)
    squares = dict.fromkeys(first, 0.0)
    ranked = found.ranking.everything if found.ranking is not None else ()
    tried = {t.key: t for t in reversed(ranked)}
    for claim in found.claims:
        others = [tried[key] for key in claim.effects[1:] if key in tried]
        for t in others:
            other = with_effect(without(last.model, claim.label), t.candidate.label)
            solution = bench.fitted(other, {**last.values, **t.values})
            for n, x in bench.changes(solution).items():
                squares[n] += (x - first[n]) ** 2 / (1 + len(others))
    return {n: math.sqrt(x) for n, x in squares.items()}


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


def _left_of(model: UserModel, records: Sequence[Record]) -> tuple[Restart | Following, str]:
    """How what an FMU leaves is found, and why not by restarts where it cannot be restarted."""
    whole = replace(model, window=None)
    first = whole.windows(records[:1])[0]
    try:
        return Restart(whole, first, records[0]), ""
    except InputError as error:
        return Following(whole, first), str(error)


def _outside_joint(joint: Joint, left: Restart | Following) -> Joint:
    """The joint that is balanced: inertias, and a spring where both sides are seen.

    They are known, as the scale of what is left: a fit that could move them along with the
    parameters of the FMU would make every balance, and its noise with it, as small as it likes.
    """
    sizes = {"inertia": left.inertia} if isinstance(left, Following) else left.sizes
    terms = {TWIST: "stiffness", "structural_damping": "structural_damping"}
    return Joint(
        name=joint.name,
        kind=joint.kind,
        gear_ratio=joint.gear_ratio,
        model_name="hd1",
        effects=tuple(label for label, name in terms.items() if name in sizes),
        known={name: Known(value=size) for name, size in sizes.items()},
        virtual_work=joint.virtual_work,
        source=joint.source,
    )


__all__ = [
    "Correction",
    "LaidOpen",
    "UserDiagnosis",
    "diagnose",
    "held_to_outputs",
    "laid_open",
    "stays",
    "with_outside",
]
