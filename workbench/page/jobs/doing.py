"""The long actions of the page, as they run in the process of a session: each works on a place and
gives the change of the state, which can be sent.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final

from casadi_models import EFFECTS
from identification.diagnosis.improve import Improvement
from identification.diagnosis.improve import improve as whole_loop
from identification.errors import InputError
from workbench.page import export as app_export
from workbench.page.analysis import Progress, clean
from workbench.page.desk import law as app_law
from workbench.page.desk import tree
from workbench.page.desk.curves import kept_curves
from workbench.page.jobs.place import Change, Place, folder_of, hint_for
from workbench.page.session import State, StepEntry
from workbench.show.words import headline, left_behind, printed

Body = Mapping[str, Any]


def fit(place: Place, body: Body, progress: Progress) -> Change:
    """Fit the start model."""
    progress("preparing the records", 0.1)
    analysis = place.analysis()
    step = analysis.fit_start(
        lambda text, share: progress(f"fitting the start model, {text}", 0.4 + 0.6 * share)
    )
    return partial(_on, (step,), analysis.note)


def diagnose(place: Place, body: Body, progress: Progress) -> Change:
    """What is missing from the current model."""
    progress("preparing the records", 0.05)
    analysis = place.analysis()
    steps = _settled(place, progress) or (analysis.fit_start(),)
    found = analysis.diagnose(progress)
    return partial(_found, steps, analysis.note, found)


def add(place: Place, body: Body, progress: Progress) -> Change:
    """Add an effect."""
    label = str(body.get("label", ""))
    steps = _settled(place, progress)
    step = place.analysis().add(label, hint_for(place.state, label))
    claim = (place.state.diagnosis or {}).get("claim")
    if claim and claim["label"] == label:
        step = replace(step, names=tuple(claim["effects"]), separate_by=claim["separate_by"])
    return partial(_longer, steps, step)


def law(place: Place, body: Body, progress: Progress) -> Change:
    """Try a law of the user's own."""
    steps = _settled(place, progress)
    return partial(_then, steps, app_law.tried(place, body, progress))


def remove(place: Place, body: Body, progress: Progress) -> Change:
    """Take an effect out of the model."""
    steps = _settled(place, progress)
    step = place.analysis().remove(str(body.get("label", "")))
    return partial(_longer, steps, step)


def confirm(place: Place, body: Body, progress: Progress) -> Change:
    """Fit every sample."""
    if not place.state.steps:
        raise InputError("nothing to confirm: fit first")
    steps = _settled(place, progress)
    step = place.analysis().confirm(steps[-1], progress)
    return partial(_with_steps, (*steps[:-1], step))


def improve(place: Place, body: Body, progress: Progress) -> Change:
    """The whole loop."""
    progress("preparing the records", 0.02)
    analysis = place.analysis()
    train, held = analysis.quick
    result = whole_loop(train, analysis.joint, held, progress=progress)
    result = replace(
        result, data=replace(result.data, note=analysis.note)
    )  # the loop was given both
    steps = ledger(result, exact=analysis.whole)
    analysis.restore(steps[-1])
    story = clean(result.as_json())
    story |= {
        "headline": headline(story),
        "printed": printed(result),
        "joint_text": result.to_joint_file(),
        "without": left_behind(result),
        "exact": analysis.whole,
        **clean(kept_curves(result)),
    }
    return partial(_improved, steps, analysis.note, story)


def export(place: Place, kind: str, body: Body, progress: Progress) -> Change:
    """The report, with its ``author`` and ``notes``, or an FMU, as a file to take home."""
    steps = _settled(place, progress)
    if not steps:
        raise InputError("nothing to take home yet: fit first")
    if kind == "report":
        author, notes = (str(body.get(k, "")).strip() for k in ("author", "notes"))
        app_export.report(place, steps, progress, author=author, notes=notes)
    else:
        app_export.fmu(place, folder_of(place), progress, kind)
    return partial(_with_steps, steps)


def replay(place: Place, body: Body, progress: Progress) -> Change:
    """A record through the online estimator."""
    from workbench.page import replay as app_replay

    asked = app_replay.request_of(body)
    steps = _settled(place, progress)
    app_replay.replay(place, steps, asked, folder_of(place), progress)
    return partial(_with_steps, steps)


def follow(place: Place, body: Body, progress: Progress) -> Change:
    """A file that is being written, through the online estimator."""
    from workbench.page import replay as app_replay

    steps = _settled(place, progress)
    app_replay.follow(place, steps, str(body.get("source", "")), folder_of(place), progress)
    return partial(_with_steps, steps)


def plan(place: Place, body: Body, progress: Progress) -> Change:
    """The next experiment."""
    from workbench.page import plan as app_plan

    asked = app_plan.request_of(body)
    steps = _settled(place, progress)
    app_plan.plan(place, asked, folder_of(place), progress)
    return partial(_with_steps, steps)


def settle(place: Place, body: Body, progress: Progress) -> Change:
    """The whole fit of the last step in place of the first look."""
    steps = place.state.steps
    if not steps or steps[-1].settled:
        return partial(_with_steps, steps)
    return partial(_settled_here, steps, place.analysis().settle(steps[-1], progress))


def prepare(place: Place, body: Body, progress: Progress) -> Change:
    """Fit a candidate ahead of the click."""
    label = str(body.get("label", ""))
    place.analysis().prepare(label, hint_for(place.state, label), progress)
    return unchanged


ACTIONS: Final[Mapping[str, Callable[[Place, Body, Progress], Change]]] = {
    "fit": fit,
    "diagnose": diagnose,
    "add": add,
    "remove": remove,
    "confirm": confirm,
    "improve": improve,
    "law": law,
    "replay": replay,
    "follow": follow,
    "plan": plan,
    "report": lambda place, body, progress: export(place, "report", body, progress),
    "plant": lambda place, body, progress: export(place, "plant", body, progress),
    "estimator": lambda place, body, progress: export(place, "estimator", body, progress),
    "settle": settle,
    "prepare": prepare,
}
"""What a process can be asked for."""


def ledger(result: Improvement, *, exact: bool = True) -> tuple[StepEntry, ...]:
    """The steps of the whole loop as entries of the ledger; not `exact` where it took windows
    of the records. A set stays a set.
    """
    claims = {c.label: c for c in result.claims}
    return tuple(
        StepEntry(
            "add" if s.added else "start",
            tuple(s.solution.model.effects),
            values={k: float(v) for k, v in s.solution.values.items()},
            train=clean(s.train.as_json()),
            held_out=clean(s.held_out.as_json()),
            key=s.added,
            label=s.label,
            title=EFFECTS[s.added].title if s.added else None,
            names=tuple(claims[s.label].effects) if s.label in claims else (),
            separate_by=claims[s.label].separate_by if s.label in claims else None,
            virtual_work=s.solution.model.virtual_work,
            exact=exact,
            id=secrets.token_hex(4),
        )
        for s in result.steps
    )


def _settled(place: Place, progress: Progress) -> tuple[StepEntry, ...]:
    """The ledger, its last step fitted wholly."""
    steps = place.state.steps
    if not steps or steps[-1].settled:
        return steps
    progress("finishing the fit", 0.05)
    return (*steps[:-1], place.analysis().settle(steps[-1]))


# --- changes of the state -------------------------------------------------------------------------


def unchanged(s: State) -> State:
    """The state as it is."""
    return s


def _on(steps: tuple[StepEntry, ...], note: str, s: State) -> State:
    return replace(tree.continued(s, steps), note=note)


def _found(steps: tuple[StepEntry, ...], note: str, found: Mapping[str, Any], s: State) -> State:
    left = {key: found[key] for key in ("warnings", "not_testable")}
    made = replace(s, steps=steps, note=note, left_open=left)
    return tree.with_found(made, diagnosis=found)


def _longer(steps: tuple[StepEntry, ...], step: StepEntry, s: State) -> State:
    return tree.continued(replace(s, steps=steps), (*steps, step))


def _then(steps: tuple[StepEntry, ...], change: Change, s: State) -> State:
    return change(replace(s, steps=steps))


def _with_steps(steps: tuple[StepEntry, ...], s: State) -> State:
    return replace(s, steps=steps)


def _improved(steps: tuple[StepEntry, ...], note: str, story: Mapping[str, Any], s: State) -> State:
    return tree.with_found(_on(steps, note, s), improvement=story)


def _settled_here(steps: tuple[StepEntry, ...], made: StepEntry, s: State) -> State:
    return replace(s, steps=(*s.steps[:-1], made)) if s.steps == steps else s


__all__ = ["ACTIONS", "Body", "ledger", "unchanged"]
