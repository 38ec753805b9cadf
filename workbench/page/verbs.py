"""What a click does: every action of the page as a change of the session's state."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final

from identification.diagnosis.improve import HOLD_DELAY, Improvement, improve
from identification.errors import InputError
from workbench.page import export as app_export
from workbench.page.analysis import Progress, clean
from workbench.page.desk import law, tree
from workbench.page.input import folder_of
from workbench.page.live import Change, Live, hint_for
from workbench.page.session import State, StepEntry
from workbench.show.words import headline

PREPARED: Final = 6
"""Best candidates that are fitted ahead of the click after a diagnosis."""


def run(live: Live, action: str, body: Mapping[str, Any]) -> None:
    """Start the action on a session.

    Raises
    ------
    InputError
        Unknown action, or another one is running.
    """
    label = str(body.get("label", ""))
    verbs: dict[str, tuple[str, Callable[[Progress], Change]]] = {
        "fit": ("fitting the start model", lambda p: _fit(live, p)),
        "diagnose": ("looking for what is missing", lambda p: _diagnose(live, p)),
        "add": (f"adding {label}", lambda p: _add(live, label, p)),
        "remove": (f"removing {label}", lambda p: _remove(live, label, p)),
        "undo": ("undoing", lambda p: _undo(live)),
        "redo": ("redoing", lambda p: _redo(live)),
        "confirm": ("fitting every sample", lambda p: _confirm(live, p)),
        "improve": ("running the whole loop", lambda p: _improve(live, p)),
        "law": ("trying your law", lambda p: _law(live, body, p)),
        "replay": ("replaying a record", lambda p: _replay(live, body, p)),
        "plan": ("planning a motion", lambda p: _plan(live, body, p)),
        "report": ("writing the report", lambda p: _export(live, "report", p)),
        "plant": ("building the FMU of the joint", lambda p: _export(live, "plant", p)),
        "estimator": ("building the FMU of the estimator", lambda p: _export(live, "estimator", p)),
    }
    if action not in verbs:
        raise InputError(f"unknown action {action!r}; known: {', '.join(verbs)}")
    if action in ("add", "remove") and not label:
        raise InputError(f"{action}: say which effect")
    text, work = verbs[action]
    live.start(action, text, work, after=lambda: next_click(live), asked=dict(body))


def resume(live: Live) -> None:
    """Take up the job that was at work when the server ended; one that was taken up before, and
    ended the server again, is only named.
    """
    asked = live.session.running()
    if asked is None:
        return
    action = str(asked.get("action", ""))
    live.session.end()
    if asked.get("again"):
        live.say(
            f"{action}: the server ended twice while it ran, so it was not started again; what was "
            "done before is kept"
        )
        return
    try:
        run(live, action, {**asked, "again": True})
    except InputError as error:
        live.say(f"{action}: was running when the server ended, and cannot go on: {error}")


def _fit(live: Live, progress: Progress) -> Change:
    progress("preparing the records", 0.1)
    analysis = live.analysis()
    step = analysis.fit_start(
        lambda text, share: progress(f"fitting the start model, {text}", 0.4 + 0.6 * share)
    )
    return lambda s: replace(tree.continued(s, (step,)), note=analysis.note)


def _settled(live: Live, progress: Progress) -> tuple[StepEntry, ...]:
    """The ledger, its last step fitted wholly."""
    steps = live.state.steps
    if not steps or steps[-1].settled:
        return steps
    progress("finishing the fit", 0.05)
    return (*steps[:-1], live.analysis().settle(steps[-1]))


def _diagnose(live: Live, progress: Progress) -> Change:
    progress("preparing the records", 0.05)
    analysis = live.analysis()
    steps = _settled(live, progress) or (analysis.fit_start(),)
    found = analysis.diagnose(progress)
    left = {key: found[key] for key in ("warnings", "not_testable")}

    def change(s: State) -> State:
        made = replace(s, steps=steps, note=analysis.note, left_open=left)
        return tree.with_found(made, diagnosis=found)

    return change


def _add(live: Live, label: str, progress: Progress) -> Change:
    steps = _settled(live, progress)
    step = live.analysis().add(label, hint_for(live.state, label))
    claim = (live.state.diagnosis or {}).get("claim")
    if claim and claim["label"] == label:
        step = replace(step, names=tuple(claim["effects"]), separate_by=claim["separate_by"])
    return lambda s: tree.continued(replace(s, steps=steps), (*steps, step))


def _law(live: Live, body: Mapping[str, Any], progress: Progress) -> Change:
    steps = _settled(live, progress)
    change = law.tried(live, body, progress)
    return lambda s: change(replace(s, steps=steps))


def _remove(live: Live, label: str, progress: Progress) -> Change:
    steps = _settled(live, progress)
    step = live.analysis().remove(label)
    return lambda s: tree.continued(replace(s, steps=steps), (*steps, step))


def _undo(live: Live) -> Change:
    return _shift(live, tree.undone)


def _redo(live: Live) -> Change:
    return _shift(live, tree.redone)


def _shift(live: Live, move: Change) -> Change:
    made = move(live.state)
    if tree.given(made) == tree.given(live.state) and made.steps:
        live.analysis().restore(made.steps[-1])
    return move


def _confirm(live: Live, progress: Progress) -> Change:
    if not live.state.steps:
        raise InputError("nothing to confirm: fit first")
    steps = _settled(live, progress)
    step = live.analysis().confirm(steps[-1], progress)
    return lambda s: replace(s, steps=(*steps[:-1], step))


def _improve(live: Live, progress: Progress) -> Change:
    progress("preparing the records", 0.02)
    analysis = live.analysis()
    train, held = analysis.quick
    result = improve(train, analysis.joint, held, progress=progress)
    steps = ledger(result, exact=analysis.whole)
    live.analysis().restore(steps[-1])
    story = clean(result.as_json())
    story["headline"] = headline(story)

    def change(s: State) -> State:
        made = replace(tree.continued(s, steps), note=analysis.note)
        return tree.with_found(made, improvement=story)

    return change


def _export(live: Live, kind: str, progress: Progress) -> Change:
    steps = _settled(live, progress)
    if not steps:
        raise InputError("nothing to take home yet: fit first")
    if kind == "report":
        app_export.report(live, steps, folder_of(live), progress)
    else:
        app_export.fmu(live, folder_of(live), progress, kind)
    return lambda s: replace(s, steps=steps)


def _replay(live: Live, body: Mapping[str, Any], progress: Progress) -> Change:
    from workbench.page import replay as app_replay

    asked = app_replay.request_of(body)
    steps = _settled(live, progress)
    app_replay.replay(live, steps, asked, folder_of(live), progress)
    return lambda s: replace(s, steps=steps)


def _plan(live: Live, body: Mapping[str, Any], progress: Progress) -> Change:
    from workbench.page import plan as app_plan

    asked = app_plan.request_of(body)
    steps = _settled(live, progress)
    app_plan.plan(live, asked, folder_of(live), progress)
    return lambda s: replace(s, steps=steps)


def ledger(result: Improvement, *, exact: bool = True) -> tuple[StepEntry, ...]:
    """The steps of the whole loop as entries of the ledger; not `exact` where it took windows
    of the records.
    """
    from casadi_models import EFFECTS

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
            virtual_work=s.solution.model.virtual_work,
            exact=exact,
            id=secrets.token_hex(4),
        )
        for s in result.steps
    )


def next_click(live: Live) -> None:
    """Queue what the next click will want: the whole fit of the last step, the best candidates."""
    steps = live.state.steps
    if steps and not steps[-1].settled:
        live.ahead(lambda: settle(live))
    diagnosis = live.state.diagnosis or {}
    claim = diagnosis.get("claim")
    ranked = [r["label"] for r in diagnosis.get("ranking", []) if r.get("significant")]
    for label in list(dict.fromkeys([*([claim["label"]] if claim else []), *ranked]))[:PREPARED]:
        live.ahead(partial(prepare, live, label))


def prepare(live: Live, label: str) -> None:
    """Fit a candidate ahead of the click."""
    live.analysis().prepare(label, hint_for(live.state, label))


def settle(live: Live) -> None:
    """Put the whole fit of the last step in place of the first look."""
    steps = live.state.steps
    if steps and not steps[-1].settled:
        made = live.analysis().settle(steps[-1])
        live.change(lambda s: replace(s, steps=(*s.steps[:-1], made)) if s.steps == steps else s)


def wait_settled(live: Live, seconds: float = 30.0) -> None:
    """Wait until the last step is the whole fit: before its values are taken home."""
    end = time.monotonic() + seconds
    while live.state.steps and not live.state.steps[-1].settled and time.monotonic() < end:
        if live.worker.idle and live.job is None:
            live.ahead(lambda: settle(live))
        time.sleep(0.02)


def addable(live: Live) -> list[dict[str, Any]]:
    """Effects of the library that can be added by hand, with title, place and whether they are
    in the model.
    """
    from casadi_models import EFFECTS

    inside = set(live.state.steps[-1].effects) if live.state.steps else set()
    rows = []
    for e in EFFECTS.values():
        for place in e.acts_on:
            label = f"{e.key}@{place}" if len(e.acts_on) > 1 else e.key
            rows.append(
                {
                    "label": label,
                    "key": e.key,
                    "title": e.title,
                    "place": place,
                    "family": e.family,
                    "absence": e.absence,
                    "excitation": e.excitation,
                    "inside": label in inside,
                }
            )
    return rows


def current_effects(state: State) -> list[str]:
    """Labels of the effects in the model, without the delay of the drive's hold."""
    return (
        [label for label in state.steps[-1].effects if label != HOLD_DELAY] if state.steps else []
    )
