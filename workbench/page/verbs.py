"""What a click does: every action of the page as a change of the session's state."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

from identification.diagnosis.improve import HOLD_DELAY
from identification.errors import InputError
from workbench.page.desk import tree
from workbench.page.desk.sources import refuse_other
from workbench.page.jobs.place import Change
from workbench.page.live import Live
from workbench.page.session import State
from workbench.show.words import title_of

PREPARED: Final = 6
"""Best candidates that are fitted ahead of the click after a diagnosis."""
_TEXTS: Final = {
    "fit": "fitting the start model",
    "diagnose": "looking for what is missing",
    "add": "",
    "remove": "",
    "undo": "undoing",
    "redo": "redoing",
    "confirm": "fitting every sample",
    "improve": "running the whole loop",
    "law": "trying your law",
    "replay": "replaying a record",
    "follow": "following a file that is being written",
    "plan": "planning a motion",
    "report": "writing the report",
    "plant": "building the FMU of the joint",
    "estimator": "building the FMU of the estimator",
}
_MOVES: Final[Mapping[str, Change]] = {"undo": tree.undone, "redo": tree.redone}
"""What is done in the server: it computes next to nothing."""


def run(live: Live, action: str, body: Mapping[str, Any]) -> None:
    """Start the action on a session.

    Raises
    ------
    InputError
        Unknown action, or another one is running.
    """
    label = str(body.get("label", ""))
    title = title_of(label)
    texts = {**_TEXTS, "add": f"adding: {title}", "remove": f"removing: {title}"}
    if action not in texts:
        raise InputError(f"unknown action {action!r}; known: {', '.join(texts)}")
    if action in ("add", "remove") and not label:
        raise InputError(f"{action}: say which effect")
    if action == "follow":
        refuse_other(live.sources, str(body.get("source", "")))
    move = _MOVES.get(action)
    live.start(
        action,
        texts[action],
        body,
        here=None if move is None else lambda progress: _shift(live, move),
        after=lambda: next_click(live),
    )


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


def _shift(live: Live, move: Change) -> Change:
    made = move(live.state)
    if tree.given(made) == tree.given(live.state) and made.steps:
        live.analysis().restore(made.steps[-1])
    return move


def next_click(live: Live) -> None:
    """Queue what the next click will want: the whole fit of the last step, the best candidates."""
    steps = live.state.steps
    if steps and not steps[-1].settled:
        live.ahead("settle", {})
    diagnosis = live.state.diagnosis or {}
    claim = diagnosis.get("claim")
    ranked = [r["label"] for r in diagnosis.get("ranking", []) if r.get("significant")]
    for label in list(dict.fromkeys([*([claim["label"]] if claim else []), *ranked]))[:PREPARED]:
        live.ahead("prepare", {"label": label})


def wait_settled(live: Live, seconds: float = 30.0) -> None:
    """Wait until the last step is the whole fit: before its values are taken home."""
    end = time.monotonic() + seconds
    while live.state.steps and not live.state.steps[-1].settled and time.monotonic() < end:
        if live.worker.idle and live.job is None:
            live.ahead("settle", {})
        time.sleep(0.02)


def addable(live: Live) -> list[dict[str, Any]]:
    """Effects of the library that can be added by hand, with title, place, whether they are in the
    model, and whether another effect there needs them.
    """
    from casadi_models import EFFECTS

    inside = set(live.state.steps[-1].effects) if live.state.steps else set()
    needed = _needed(live) if inside else set()
    joint = live.joint_or_none()
    linear = joint is not None and joint.kind == "linear"
    rows = []
    for e in EFFECTS.values():
        if e.angular and linear:
            continue
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
                    "needed": label in needed,
                }
            )
    return rows


def _needed(live: Live) -> set[str]:
    """Effects of the model that cannot go: another one in it must have an effect of their kind."""
    terms = live.analysis().current.model.terms
    asked = {key for t in terms for key in t.effect.needs}
    count = Counter(t.effect.key for t in terms)
    return {t.label for t in terms if t.effect.key in asked and count[t.effect.key] == 1}


def current_effects(state: State) -> list[str]:
    """Labels of the effects in the model, without the delay of the drive's hold."""
    return (
        [label for label in state.steps[-1].effects if label != HOLD_DELAY] if state.steps else []
    )
