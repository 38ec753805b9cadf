"""What a click does: every action of the page as a change of the session's state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from identification.errors import InputError
from identification.improve import HOLD_DELAY, Improvement, improve
from workbench import app_export
from workbench.app_analysis import Analysis, Progress, clean
from workbench.app_input import folder_of
from workbench.app_live import PREPARED, Change, Live, hint_for, with_step
from workbench.session import State, StepEntry


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
        "add": (f"adding {label}", lambda p: _add(live, label)),
        "remove": (f"removing {label}", lambda p: _remove(live, label)),
        "undo": ("undoing", lambda p: _undo(live)),
        "redo": ("redoing", lambda p: _redo(live)),
        "confirm": ("fitting every sample", lambda p: _confirm(live, p)),
        "improve": ("running the whole loop", lambda p: _improve(live, p)),
        "report": ("writing the report", lambda p: _export(live, "report", p)),
        "plant": ("building the FMU of the joint", lambda p: _export(live, "plant", p)),
        "estimator": ("building the FMU of the estimator", lambda p: _export(live, "estimator", p)),
    }
    if action not in verbs:
        raise InputError(f"unknown action {action!r}; known: {', '.join(verbs)}")
    if action in ("add", "remove") and not label:
        raise InputError(f"{action}: say which effect")
    text, work = verbs[action]
    live.start(action, text, work, after=(lambda wanted: prefit(live, wanted)) if action == "diagnose" else None)


def _fit(live: Live, progress: Progress) -> Change:
    progress("preparing the records", 0.1)
    analysis = live.analysis()
    progress("fitting the start model", 0.5)
    step = analysis.fit_start()
    return lambda s: replace(s.without_fit(), steps=(step,), note=analysis.note)


def _diagnose(live: Live, progress: Progress) -> Change:
    progress("preparing the records", 0.05)
    analysis = live.analysis()
    begin: list[StepEntry] = []
    if not live.state.steps:
        begin.append(analysis.fit_start())
    found = analysis.diagnose(progress)
    return lambda s: replace(s, steps=(*s.steps, *begin), diagnosis=found, note=analysis.note)


def _add(live: Live, label: str) -> Change:
    analysis = live.analysis()
    step = analysis.add(label, hint_for(live.state, label))
    claim = (live.state.diagnosis or {}).get("claim")
    if claim and claim["label"] == label:
        step = replace(step, names=tuple(claim["effects"]), separate_by=claim["separate_by"])
    return lambda s: with_step(s, step)


def _remove(live: Live, label: str) -> Change:
    step = live.analysis().remove(label)
    return lambda s: with_step(s, step)


def _undo(live: Live) -> Change:
    steps = live.state.steps
    if len(steps) < 2:
        raise InputError("nothing to undo: the ledger has the start model only")
    live.analysis().restore(steps[-2])
    return lambda s: replace(s, steps=s.steps[:-1], undone=(s.steps[-1], *s.undone), diagnosis=None, improvement=None)


def _redo(live: Live) -> Change:
    undone = live.state.undone
    if not undone:
        raise InputError("nothing to redo")
    live.analysis().restore(undone[0])
    return lambda s: replace(s, steps=(*s.steps, s.undone[0]), undone=s.undone[1:], diagnosis=None)


def _confirm(live: Live, progress: Progress) -> Change:
    if not live.state.steps:
        raise InputError("nothing to confirm: fit first")
    last = live.state.steps[-1]
    step = live.analysis().confirm(last, progress)
    return lambda s: replace(s, steps=(*s.steps[:-1], step))


def _improve(live: Live, progress: Progress) -> Change:
    ready = [f for f in live.state.files if f.status == "ready"]
    train = [live.record(f.id) for f in ready if f.role == "train"]
    held = [live.record(f.id) for f in ready if f.role == "held_out"]
    result = improve(train, live.joint(), held, progress=progress)
    steps = ledger(result)
    live.analysis().restore(steps[-1])
    story = clean(result.as_json())
    return lambda s: replace(s, steps=steps, undone=(), diagnosis=None, improvement=story, note=result.data.note)


def _export(live: Live, kind: str, progress: Progress) -> Change:
    if not live.state.steps:
        raise InputError("nothing to take home yet: fit first")
    if kind == "report":
        app_export.report(live, folder_of(live), progress)
    else:
        app_export.fmu(live, folder_of(live), progress, kind)
    return lambda s: s


def ledger(result: Improvement) -> tuple[StepEntry, ...]:
    """The steps of the whole loop as entries of the ledger."""
    from casadi_models import EFFECTS

    return tuple(
        StepEntry(
            "add" if s.added else "start", tuple(s.solution.model.effects), {k: float(v) for k, v in s.solution.values.items()},
            clean(s.train.as_json()), clean(s.held_out.as_json()), s.added, s.label, EFFECTS[s.added].title if s.added else None,
            s.solution.model.virtual_work, True,
        )
        for s in result.steps
    )  # fmt: skip


def prefit(live: Live, wanted: Callable[[], bool]) -> None:
    """Fit the best candidates ahead of the click, while nothing else is asked for."""
    analysis: Analysis = live.analysis()
    ranking = (live.state.diagnosis or {}).get("ranking", [])
    labels = [r["label"] for r in ranking if r.get("significant")]
    claim = (live.state.diagnosis or {}).get("claim")
    if claim:
        labels = list(dict.fromkeys([claim["label"], *labels]))
    for label in labels[:PREPARED]:
        if not wanted():
            return
        analysis.prepare(label, wanted)


def addable(live: Live) -> list[dict[str, Any]]:
    """Effects of the library that can be added by hand, with title, place and whether they are in the model."""
    from casadi_models import EFFECTS

    inside = set(live.state.steps[-1].effects) if live.state.steps else set()
    rows = []
    for e in EFFECTS.values():
        for place in e.acts_on:
            label = f"{e.key}@{place}" if len(e.acts_on) > 1 else e.key
            rows.append({
                "label": label, "key": e.key, "title": e.title, "place": place, "family": e.family,
                "absence": e.absence, "excitation": e.excitation, "inside": label in inside,
            })  # fmt: skip
    return rows


def current_effects(state: State) -> list[str]:
    """Labels of the effects in the model, without the delay of the drive's hold."""
    return [label for label in state.steps[-1].effects if label != HOLD_DELAY] if state.steps else []

