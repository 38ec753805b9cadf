"""What comes into a session: records, the joint, the demo."""

from __future__ import annotations

import json
import math
import secrets
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from casadi_models.transmission import MODELS
from identification.data.channels import KINDS
from identification.data.joint_file import parse_joint
from identification.data.joint_schema import JOINT
from identification.data.plain_text import from_toml, tables_text
from identification.errors import InputError
from workbench.page.charts.choices import held_text, known_entry, windows_of
from workbench.page.desk.tree import LONGEST_NAME, given, opened, remarked, used_files
from workbench.page.live import SOON, Live
from workbench.page.records import guessed_role, surveyed
from workbench.page.session import FileEntry, State, stored_as

LARGEST_JOINT: Final = 1 << 20
NUMBERS: Final = {key.name: key for key in JOINT.keys if key.kind == "number"}
MOST: Final[Mapping[str, float]] = {
    "gear_ratio": 1e6,
    "motor_constant": 1e4,
    "torque_per_current": 1e7,
    "torque_per_voltage": 1e7,
}
"""Largest size of a number of the form. Gear ratio: compound gears end at some 1e4, a spindle of a
linear axis of 0.1 mm per turn has 6e4 rad/m, a decade is left. Motor constant: the torque motors
of wind turbines and telescopes give some 1e3 N.m/A, a decade is left; on the link side a gear of
1e3 multiplies it.
"""
DRIVE_TRAIN: Final = {k.name: k.default for k in JOINT.keys if k.name in ("kind", *NUMBERS)}
"""What fitted values are referred through, with its defaults."""


def add_upload(live: Live, name: str, stored: str, size: int) -> dict[str, Any]:
    """Take a file that is in the session folder: a joint file by its ending, else a record.

    Raises
    ------
    InputError
        A joint file that is wrong, or a file that cannot be read at all: nothing of it is kept. A
        record that the check gate refuses stays, since another joint or column map may cure it.
    """
    path = live.session.files / stored
    if name.lower().endswith(".toml"):
        if size > LARGEST_JOINT:
            raise InputError(
                f"{name}: is too long for a joint file; give records as CSV, MAT or NPZ"
            )
        try:
            text = path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError:
            raise InputError(f"{name}: not a text file; a joint file is TOML") from None
        path.unlink()
        return set_joint(live, {"text": text, "source": name})
    role, reason = guessed_role(name)
    entry = live.examine(
        FileEntry(secrets.token_hex(6), name, stored, role, reason, size), longest=SOON
    )
    if entry.status == "refused" and not entry.summary:
        raise InputError(entry.message)
    live.change_input(lambda s: replace(s, files=(*s.files, entry)))
    live.check_soon(entry)
    return {"id": entry.id, "status": entry.status, "message": entry.message}


def put_upload(live: Live, identifier: str, body: Mapping[str, Any]) -> dict[str, Any]:
    """Change the role or the column map of a record.

    Raises
    ------
    InputError
        Unknown record, role or map.
    """
    entry = _entry(live.state, identifier)
    if "role" in body:
        if body["role"] not in ("train", "held_out"):
            raise InputError("role is 'train' or 'held_out'")
        entry = replace(entry, role=body["role"], role_reason="chosen by hand")
    if "left_out" in body:
        entry = replace(entry, left_out=windows_of(body["left_out"]))
    if "columns" in body:
        columns = _columns(body["columns"])
        everywhere = [
            f
            for f in live.state.files
            if f.id == identifier
            or (body.get("all") and f.status == "columns" and _used(columns) <= set(f.names))
        ]
        kind = str(body.get("kind") or entry.kind)
        if kind not in ("", *KINDS):
            raise InputError(f"kind is {kind!r}; give one of {', '.join(KINDS)}")
        made = {
            f.id: live.examine(
                replace(entry if f.id == identifier else f, columns=columns, kind=kind)
            )
            for f in everywhere
        }
        live.change_input(lambda s: replace(s, files=tuple(made.get(f.id, f) for f in s.files)))
        entry = made[identifier]
    else:
        live.change_input(
            lambda s: replace(s, files=tuple(entry if f.id == identifier else f for f in s.files))
        )
    return {"id": entry.id, "status": entry.status, "message": entry.message}


def drop_upload(live: Live, identifier: str) -> None:
    """Take a record out of the session; off the disk where no fit that is kept was made from it."""
    entry = _entry(live.state, identifier)
    now = live.change_input(
        lambda s: replace(s, files=tuple(f for f in s.files if f.id != identifier))
    )
    if entry.stored not in used_files(now):
        live.session.path_of(entry).unlink(missing_ok=True)


def _entry(state: State, identifier: str) -> FileEntry:
    entry = next((f for f in state.files if f.id == identifier), None)
    if entry is None:
        raise InputError("no such record in this session")
    return entry


def _columns(given: Any) -> dict[str, Any]:
    if not isinstance(given, Mapping) or not given:
        raise InputError("columns: choose a column for time and for at least one channel")
    out: dict[str, Any] = {}
    for channel, spec in given.items():
        if not isinstance(spec, Mapping):
            raise InputError(f"columns: {channel} must be a table")
        entry = {k: spec[k] for k in ("column", "formula", "unit") if spec.get(k)}
        for key in ("scale", "counts_per_turn", "step"):
            if spec.get(key) not in (None, "", *((1, 1.0) if key != "step" else ())):
                entry[key] = _number(spec[key], f"{channel}: {key}")
        if spec.get("sign") == -1:
            entry["sign"] = -1
        out[str(channel)] = entry
    return out


def _used(columns: Mapping[str, Any]) -> set[str]:
    return {str(c["column"]) for c in columns.values() if "column" in c}


def look(live: Live, identifier: str, body: Mapping[str, Any]) -> dict[str, Any]:
    """What a record's file holds (see `identification.data.survey`): with the map in the body, the
    map in use (``now``), or the guess for one of several joints (``number``).

    Raises
    ------
    InputError
        Unknown record; a map that does not fit.
    """
    entry = _entry(live.state, identifier)
    given_map: Mapping[str, Any] | None = None
    if body.get("columns"):
        given_map = _columns(body["columns"])
    number = body.get("number")
    if number is not None and (isinstance(number, bool) or not isinstance(number, int)):
        raise InputError(f"number is {number!r}; give a whole number")
    kind = str(body.get("kind") or "") or (live.kind_of(entry) if live.has_joint else entry.kind)
    if body.get("now") and given_map is None and number is None:
        given_map = live.columns_of(entry) or {}
    path = live.session.path_of(entry)
    found = surveyed(entry, path, kind or None, given_map, number)
    others = [
        f.id for f in live.state.files if f.status == "columns" and set(entry.names) <= set(f.names)
    ]
    return {**found, "same": len(others) if entry.status == "columns" else 0}


def _number(value: Any, what: str) -> float:
    try:
        found = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{what} is {value!r}; give a number") from None
    if not math.isfinite(found):
        raise InputError(f"{what} is {value!r}; give a finite number")
    return found


def _plausible(value: Any, key: str) -> float:
    """A number of the form, in the unit that its field names and of a size that a joint can have.

    Raises
    ------
    InputError
    """
    unit, text = NUMBERS[key].unit, str(value).strip().replace("−", "-")
    title = key.replace("_", " ")
    try:
        found = float(text.replace(",", ".", 1))
    except ValueError:
        want = "a plain number" if unit in ("1", "", None) else f"a plain number in {unit}"
        raise InputError(f"{title} is {text!r}; give {want}, without words or a unit") from None
    if not math.isfinite(found):
        raise InputError(f"{title} is {text!r}; give a finite number")
    if found and not 1.0 / MOST[key] <= abs(found) <= MOST[key]:
        size = "large" if abs(found) > 1.0 else "small"
        raise InputError(
            f"{title} is {found:g}, too {size} for a joint: {NUMBERS[key].meaning}; correct the "
            "number or its unit"
        )
    return found


def set_joint(live: Live, body: Mapping[str, Any]) -> dict[str, Any]:
    """Set the joint from a joint file's text, or from the fields of the form.

    Where the body holds ``was``, the text that was edited, the joint is set only if it is still
    that one.

    Returns
    -------
    mapping
        ``text`` of the joint and the status of each of the ``files``.

    Raises
    ------
    InputError
        What is wrong with it; the joint before it is kept.
    """
    source = str(body.get("source", "joint"))
    if "hold" in body:
        text = held_text(live, body["hold"])
    elif "text" in body:
        text = str(body["text"])
    else:
        text = tables_text(_from_form(body, _previous(live.state.joint_text)))
    parse_joint(from_toml(text, source), source)
    before = given(live.state)

    def put(s: State) -> State:
        if body.get("was", s.joint_text) != s.joint_text:
            raise InputError(
                "the joint was changed elsewhere while it was edited here; say on the Model page "
                "which of the two counts"
            )
        return replace(s, joint_text=text, joint_source=source)

    changed = live.change_input(put)
    if given(changed) != before:
        made = {f.id: live.examine(f) for f in changed.files}
        live.change_input(lambda s: replace(s, files=tuple(made.get(f.id, f) for f in s.files)))
    files = [{"id": f.id, "status": f.status} for f in live.state.files]
    return {"ok": True, "text": text, "files": files}


def _previous(text: str) -> dict[str, Any]:
    try:
        return from_toml(text, "joint")
    except InputError:
        return {}


def _from_form(body: Mapping[str, Any], previous: Mapping[str, Any]) -> dict[str, Any]:
    """The tables of the joint before, with the form's fields in them.

    What the form does not show is kept. Two things cannot be: [known] of a parameter that the new
    model does not have, and values that were fitted to another drive train.
    """
    model = body.get("model", "hd1")
    effects = body.get("effects", [])
    if model not in MODELS:
        raise InputError(f"model = {model!r} is not known; use one of {', '.join(MODELS)}")
    if not isinstance(effects, list):
        raise InputError("effects must be a list of names")
    old = previous.get("joint")
    before: dict[str, Any] = dict(old) if isinstance(old, Mapping) else {}
    asked = [str(e) for e in effects]
    was = before.get("effects")
    # as they stood: another order would be another input of the fits
    stay = [e for e in was if e in asked] if isinstance(was, list) else []
    table: dict[str, Any] = {
        **before,
        "name": str(body.get("name") or "joint"),
        "kind": body.get("kind") or "rotary",
        "model": model,
        "effects": [*stay, *(e for e in asked if e not in stay)],
    }
    for key in NUMBERS:
        if key in body:
            table.pop(key, None)
            if body[key] not in (None, ""):
                table[key] = _plausible(body[key], key)
    if table.get("gear_ratio") is None:
        raise InputError(
            "gear_ratio is empty; give theta_motor / theta_link with its sign (1 where "
            "everything is measured on one side)"
        )
    typed = body.get("known", {})
    if not isinstance(typed, Mapping) or not all(isinstance(e, Mapping) for e in typed.values()):
        raise InputError("known must be a table of parameters, each with its fields")
    given_before: Mapping[str, Any] = previous.get("known", {})
    entries = {n: known_entry(n, e, given_before.get(n)) for n, e in typed.items()}
    changed = {n: e for n, e in entries.items() if e and e != _as_entry(given_before.get(n))}
    gone = {n for n, e in entries.items() if not e}
    stays = {n: e for n, e in given_before.items() if n not in gone and n not in changed}
    whole = {**previous, "joint": table, "known": stays}
    if any(before.get(k, v) != table.get(k, v) for k, v in DRIVE_TRAIN.items()):
        for part in ("fitted", "calibration", "provenance"):
            whole.pop(part, None)
    try:
        parse_joint(whole, "joint")
    except InputError as error:
        if "[known]" not in str(error):
            raise
        whole["known"] = {k: v for k, v in stays.items() if _fits(whole, k, v)}
    whole["known"] = {**whole["known"], **changed}  # what is typed now is refused, not left out
    return {k: v for k, v in whole.items() if k != "known" or v}


def _as_entry(given: Any) -> Any:
    return given if isinstance(given, Mapping) else {"value": given}


def _fits(whole: Mapping[str, Any], name: str, entry: Any) -> bool:
    try:
        parse_joint({**whole, "known": {name: entry}}, "joint")
    except InputError as error:
        return "[known]" not in str(error)
    return True


def joint_form(text: str) -> dict[str, Any]:
    """The fields of the form for a joint file."""
    data = _previous(text)
    table = dict(data.get("joint", {}))
    table["known"] = data.get("known", {})
    table["columns"] = data.get("columns", {})
    return dict(json.loads(json.dumps(table, default=str)))


def change_tree(live: Live, body: Mapping[str, Any]) -> dict[str, Any]:
    """Open a branch, or a step of one (``open``, ``step``); name a step or write a note on it
    (``of``, ``name``, ``note``); name the session (``session``).

    Raises
    ------
    InputError
        No such branch or step; other work runs.
    """
    texts = {k: str(v) for k, v in body.items() if v is not None}
    if "open" in texts:
        live.move(lambda s: opened(s, texts["open"], texts.get("step", "")))
    elif "session" in texts:
        live.change(lambda s: replace(s, name=texts["session"].strip()[:LONGEST_NAME]))
    else:
        name, note = texts.get("name"), texts.get("note")
        live.change(lambda s: remarked(s, texts.get("of", ""), name, note))
    return {"ok": True}


def start_demo(live: Live) -> dict[str, Any]:
    """Put the demo into the session: simulated records of a joint with a hidden effect.

    Raises
    ------
    InputError
        The session is not empty.
    """
    from workbench.page.demo import demo_files

    if live.state.files:
        raise InputError("the session has records already; start a new one for the demo")
    for name, content in demo_files().items():
        stored = stored_as(name)
        (live.session.files / stored).write_bytes(content)
        add_upload(live, name, stored, len(content))
    return {"ok": True}
