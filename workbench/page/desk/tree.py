"""The tree of fits: a changed input begins a branch, and what was fitted before is put away whole.

Pure functions from state to state. A branch is a path from the start model to its last step, on
one input; steps carry identifiers, so that paths that begin alike share their beginning.
"""

from __future__ import annotations

import json
import re
import secrets
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from casadi_models.hold import UNKNOWNS
from identification.balance.calibration import is_of_run
from identification.data.joint_schema import JOINT
from identification.data.plain_text import from_toml
from identification.data.typed_laws import LAWS
from identification.errors import InputError
from workbench.page.session import Branch, FileEntry, State, StepEntry
from workbench.show.words import title_of

LONGEST_NAME: Final = 200
LONGEST_NOTE: Final = 5000
"""Characters of a name and of a note that are kept."""


def given(state: State | Branch) -> str:
    """What a fit is made from, as one text: the joint without its name, and every record that can
    be used with its role and its column map.
    """
    files = sorted(
        (
            f.id,
            f.role,
            json.dumps([f.columns, f.left_out] if f.left_out else f.columns, sort_keys=True),
        )
        for f in state.files
        if f.status == "ready"
    )
    return json.dumps([_joint(state.joint_text), files], sort_keys=True, default=str)


def _joint(text: str) -> Any:
    """The tables of a joint file without its name; a key that is left out has its default, and a
    typed law that the start model does not use is none of its input.
    """
    try:
        data = from_toml(text, "joint")
        table = data.get("joint")
        if isinstance(table, Mapping):
            data["joint"] = {**JOINT.read(table, "joint"), "name": None}
            used = {re.split("[@#]", e)[0] for e in data["joint"]["effects"]}
            data[LAWS] = {k: v for k, v in data.get(LAWS, {}).items() if k in used}
    except InputError:
        return text
    return {k: v for k, v in data.items() if v}


def after_input(before: State, after: State) -> State:
    """The state after a change of its input.

    What does not touch the input of the fits keeps them. Else they are put away as a branch; where
    a branch with the new input is there already, it is taken up again.
    """
    now = given(after)
    if fits_stand(before, after):
        return after
    kept = put_away(before, after)
    back = next((b for b in reversed(kept.branches) if b.steps and given(b) == now), None)
    if back is not None:
        files, text, source = after.files, after.joint_text, after.joint_source
        found = _taken(kept, back)
        return replace(found, files=files, joint_text=text, joint_source=source)
    parent = before.branch if before.steps else before.parent
    return replace(kept.without_fit(), branch=secrets.token_hex(4), parent=parent)


def fits_stand(before: State, after: State) -> bool:
    """Whether a fit of the one state is a fit of the other: equal input, and equal laws behind
    the same keys.
    """
    return given(before) == given(after) and not _other_laws(before.joint_text, after.joint_text)


def _other_laws(before: str, after: str) -> bool:
    """Whether a law of a key says something else: steps that have it would not be theirs."""
    old, new = ((_tables(t)).get(LAWS, {}) for t in (before, after))
    return any(old[k] != new[k] for k in old.keys() & new.keys())


def _tables(text: str) -> dict[str, Any]:
    try:
        return from_toml(text, "joint")
    except InputError:
        return {}


def put_away(before: State, after: State | None = None) -> State:
    """`after` (else `before`) with the path of `before` among its branches, where that has steps
    that no other path has.
    """
    after = before if after is None else after
    path = (*before.steps, *before.undone)
    others = tuple(b for b in after.branches if b.id != before.branch)
    covered = any(
        given(b) == given(before) and _stands_in(before, path, (*b.steps, *b.undone))
        for b in others
    )
    if not path or covered:
        return after
    return replace(after, branches=(*others, _branch(before)))


def continued(state: State, steps: tuple[StepEntry, ...]) -> State:
    """The state on another path of the same input: a path that it leaves is kept as a branch."""
    path = (*state.steps, *state.undone)
    for k, (old, new) in enumerate(zip(path, steps, strict=False)):
        if not _same(old, new):
            break  # below here a step that was made before keeps its identifier, and its notes
        steps = (*steps[:k], replace(new, id=old.id), *steps[k + 1 :])
    if _begins(path, steps):
        return on(state, steps, ())
    if _begins(steps, path):
        return on(state, steps, path[len(steps) :])
    kept = put_away(state)
    made = replace(kept, branch=secrets.token_hex(4), parent=state.branch, ahead="")
    return on(made, steps, ())


def on(state: State, steps: tuple[StepEntry, ...], undone: tuple[StepEntry, ...]) -> State:
    """The state at a place of a path, with what was found there."""
    found = state.found.get(steps[-1].id, {}) if steps else {}
    return replace(
        state,
        steps=steps,
        undone=undone,
        diagnosis=found.get("diagnosis"),
        improvement=found.get("improvement"),
    )


def with_found(state: State, **found: Any) -> State:
    """Note a diagnosis, or the result of the loop, with the last step: undo and another branch do
    not lose it.
    """
    if not state.steps:
        return state
    key = state.steps[-1].id
    return replace(
        state, **found, found={**state.found, key: {**state.found.get(key, {}), **found}}
    )


def opened(state: State, branch: str, step: str = "") -> State:
    """Another branch, up to a step of it; what was current is kept.

    Parameters
    ----------
    state : State
    branch : str
        Identifier of a branch, or of the current one.
    step : str
        Identifier of the step; the last one where it is left out.

    Raises
    ------
    InputError
        No such branch or step.
    """
    if branch == state.branch:
        made = state
    else:
        found = next((b for b in state.branches if b.id == branch), None)
        if found is None:
            raise InputError("no such branch in this session")
        kept = state
        if given(state) != given(found) or state.steps:
            others = tuple(b for b in state.branches if b.id != state.branch)
            kept = replace(state, branches=(*others, _branch(state)))
        made = _taken(kept, found)
    path = (*made.steps, *made.undone)
    if not step:
        return on(made, path, ()) if path else made
    at = next((k for k, s in enumerate(path) if s.id == step), None)
    if at is None:
        raise InputError("no such step in this branch")
    return on(made, path[: at + 1], path[at + 1 :])


def undone(state: State) -> State:
    """One step back; from the start of a branch to the branch that it came from.

    Raises
    ------
    InputError
        Nothing to undo.
    """
    if len(state.steps) > 1:
        return on(state, state.steps[:-1], (state.steps[-1], *state.undone))
    if not any(b.id == state.parent for b in state.branches):
        raise InputError("nothing to undo: the ledger has the start model only")
    back = opened(state, state.parent)
    return replace(back, ahead=state.branch)


def redone(state: State) -> State:
    """What undo took back.

    Raises
    ------
    InputError
        Nothing to redo.
    """
    if state.undone:
        return on(state, (*state.steps, state.undone[0]), state.undone[1:])
    if state.ahead and any(b.id == state.ahead for b in state.branches):
        return _first(opened(state, state.ahead))
    raise InputError("nothing to redo")


def _first(state: State) -> State:
    """At the first step: where undo left the branch."""
    path = (*state.steps, *state.undone)
    return on(state, path[:1], path[1:])


def remarked(state: State, key: str, name: str | None, note: str | None) -> State:
    """Name a step or a branch, or write a note on it.

    Raises
    ------
    InputError
        No such step or branch.
    """
    every: tuple[State | Branch, ...] = (state, *state.branches)
    steps = {s.id for b in every for s in (*b.steps, *b.undone)}
    if key not in steps | {b.branch if isinstance(b, State) else b.id for b in every}:
        raise InputError("no such step in this session")
    old = dict(state.remarks.get(key, {}))
    if name is not None:
        old["name"] = name.strip()[:LONGEST_NAME]
    if note is not None:
        old["note"] = note.strip()[:LONGEST_NOTE]
    return replace(state, remarks={**state.remarks, key: {k: v for k, v in old.items() if v}})


def used_files(state: State) -> set[str]:
    """Names on the disk of every record that the state or one of its branches has."""
    every: tuple[State | Branch, ...] = (state, *state.branches)
    return {f.stored for b in every for f in b.files}


def shown(state: State) -> list[dict[str, Any]]:
    """The branches for the page, the current one first: each with its input in words, its steps and
    whether they stand.
    """
    current = _branch(state)
    every = {b.id: b for b in (*state.branches, current)}
    order = [current, *reversed([b for b in state.branches if b.id != current.id])]
    out = []
    for b in order:
        up = every.get(b.parent)
        out.append(
            {
                "id": b.id,
                "parent": b.parent,
                "current": b is current,
                "created": b.created,
                "input": _input_words(b),
                "change": _difference(up, b) if up is not None else "",
                "remark": dict(state.remarks.get(b.id, {})),
                "steps": [
                    _step(s, state, undone=k >= len(b.steps))
                    for k, s in enumerate((*b.steps, *b.undone))
                ],
            }
        )
    return out


def compared(state: State, first: str, second: str) -> dict[str, Any]:
    """Two fits side by side: effects, errors and values.

    Raises
    ------
    InputError
        No such step.
    """
    paths: tuple[State | Branch, ...] = (state, *state.branches)
    every = {s.id: s for b in paths for s in (*b.steps, *b.undone)}
    if first not in every or second not in every:
        raise InputError("no such step in this session")
    a, b = every[first], every[second]
    every_name = dict.fromkeys([*a.values, *b.values])
    names = [n for n in every_name if n not in UNKNOWNS and not is_of_run(n)]
    return {
        "steps": [_step(s, state, undone=False) for s in (a, b)],
        "only": [
            [e for e in a.effects if e not in b.effects],
            [e for e in b.effects if e not in a.effects],
        ],
        "values": [{"name": n, "first": a.values.get(n), "second": b.values.get(n)} for n in names],
    }


def _step(s: StepEntry, state: State, *, undone: bool) -> dict[str, Any]:
    return {
        "id": s.id,
        "action": s.action,
        "label": s.label,
        "title": s.title,
        "names": list(s.names),
        "effects": list(s.effects),
        "error": s.held_out.get("relative_error_percent"),
        "undone": undone,
        "diagnosed": "diagnosis" in state.found.get(s.id, {}),
        "remark": dict(state.remarks.get(s.id, {})),
    }


def _input_words(b: Branch) -> str:
    roles = [
        (word, [f.name for f in b.files if f.status == "ready" and f.role == role])
        for role, word in (("train", "fit"), ("held_out", "held out"))
    ]
    return "; ".join(f"{word}: {', '.join(names)}" for word, names in roles if names)


def _difference(before: Branch, after: Branch) -> str:
    """What is another input in a branch, in words."""
    old, new = ({f.id: f for f in b.files if f.status == "ready"} for b in (before, after))
    words = [f"{new[i].name} added" for i in new if i not in old]
    words += [f"{old[i].name} taken out" for i in old if i not in new]
    for i in old.keys() & new.keys():
        words += _changes(old[i], new[i])
    a, b = _joint(before.joint_text), _joint(after.joint_text)
    if a != b:
        words.append("joint: " + _joint_words(a, b))
    return ", ".join(words)


def _changes(old: FileEntry, new: FileEntry) -> list[str]:
    role = {"train": "fit", "held_out": "held out"}
    out = [] if old.role == new.role else [f"{new.name}: {role[old.role]} → {role[new.role]}"]
    return out if old.columns == new.columns else [*out, f"{new.name}: other columns"]


def _joint_words(a: Any, b: Any) -> str:
    if not (isinstance(a, Mapping) and isinstance(b, Mapping)):
        return "another file"
    head = [d.get("joint", {}) if isinstance(d.get("joint"), Mapping) else {} for d in (a, b)]
    keys = [k for k in dict.fromkeys([*head[0], *head[1]]) if head[0].get(k) != head[1].get(k)]
    words = [_key_words(k, head[0].get(k), head[1].get(k)) for k in keys]
    tables = [t for t in dict.fromkeys([*a, *b]) if t != "joint" and a.get(t) != b.get(t)]
    words += ["what is known" if t == "known" else f"[{t}]" for t in tables]
    return ", ".join(words) or "another file"


def _key_words(key: str, old: Any, new: Any) -> str:
    """How a key of [joint] changed; of the effects those that came and went, by their titles."""
    if key != "effects":
        return f"{key.replace('_', ' ')} {_short(old)} → {_short(new)}"
    was, now = old or [], new or []
    came = [f"+ {title_of(str(e))}" for e in now if e not in was]
    went = [f"− {title_of(str(e))}" for e in was if e not in now]
    return ", ".join([*came, *went]) or "effects in another order"


def _short(value: Any) -> str:
    text = "none" if value in (None, []) else json.dumps(value, default=str).strip('"')
    return text if len(text) < 60 else f"{text[:57]}..."


def _branch(state: State) -> Branch:
    shared = {k: getattr(state, k) for k in Branch.WORKING}
    return Branch(id=state.branch, parent=state.parent, created=time.time(), **shared)


def _taken(state: State, branch: Branch) -> State:
    """A branch in place of the current one; it is no longer among those put away."""
    others = tuple(b for b in state.branches if b.id != branch.id)
    shared = {k: getattr(branch, k) for k in Branch.WORKING}
    return replace(
        state, branches=others, branch=branch.id, parent=branch.parent, ahead="", **shared
    )


def _stands_in(state: State, path: tuple[StepEntry, ...], longer: tuple[StepEntry, ...]) -> bool:
    """Whether another path begins with all of this one: an equal fit that was made twice counts
    once, but not where something was noted or found at the one that would go.
    """
    kept = {*state.remarks, *state.found}
    same_id = {a.id for a, b in zip(path, longer, strict=False) if a.id == b.id}
    return _begins(path, longer) and not any(a.id in kept - same_id for a in path)


def _begins(path: tuple[StepEntry, ...], longer: tuple[StepEntry, ...]) -> bool:
    return len(path) <= len(longer) and all(_same(a, b) for a, b in zip(path, longer, strict=False))


def _same(a: StepEntry, b: StepEntry) -> bool:
    return bool(a.id and a.id == b.id) or (a.effects == b.effects and a.values == b.values)


__all__ = [
    "LONGEST_NAME",
    "after_input",
    "compared",
    "continued",
    "fits_stand",
    "given",
    "on",
    "opened",
    "put_away",
    "redone",
    "remarked",
    "shown",
    "undone",
    "used_files",
    "with_found",
]
