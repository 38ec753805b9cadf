"""What is chosen on the page and changes the input of the fit: what is known of a parameter, and
windows that are left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from casadi_models.term import INERTIAS
from identification.data.formats import words
from identification.data.plain_text import from_toml, tables_text
from identification.errors import InputError
from workbench.page.live import Live

GIVEN: Final = ("joint", "known", "columns", "effects", "laws")
"""Tables of a joint file that say what is given; the others say what a fit made of it."""
MOST_WINDOWS: Final = 50
NUMBERS: Final = ("value", "low", "high")
"""Keys of an entry of [known] that are numbers."""
REMARKS: Final = ("source", "note")
"""Keys of an entry of [known] that the page does not ask for."""
NOT_GIVEN: Final = ("smoothing", "range")
"""Roles of parameters that no catalogue states."""


def held_text(live: Live, held: Any) -> str:
    """The joint file with parameters held at values, or let free again.

    The model as it stands, with all that was added, becomes the start model of the branch that
    begins so.

    Parameters
    ----------
    live : Live
    held : mapping of str to number, mapping or None
        A number is the value, link-referred and in SI; a mapping is an entry of [known] as a joint
        file has it (``value``, ``low``, ``high``, ``unit``, ``side``). None lets a parameter free.

    Raises
    ------
    InputError
        No mapping, or a value that is no number.
    """
    if not isinstance(held, Mapping) or not held:
        raise InputError("hold: say which parameter at which value")
    text = live.analysis().to_joint_file() if live.state.steps else live.state.joint_text
    data = from_toml(text, "joint")
    typed = from_toml(live.state.joint_text, "joint")
    as_typed = typed.get("known", {})
    known = {**data.get("known", {}), **as_typed}  # with the units and sources they were given in
    limits = limits_of(live)
    for name, value in held.items():
        known.pop(name, None)
        if isinstance(value, Mapping):
            if entry := known_entry(name, value, as_typed.get(name)):
                known[name] = entry
        elif value is not None:
            known[name] = within(name, _number(name, value), limits)
    confirmed = {"columns"} - set(typed)  # the map of the records stays with them
    made = {k: v for k, v in data.items() if k in GIVEN and k not in {"known", *confirmed}}
    return tables_text(made | ({"known": known} if known else {}))


def known_entry(name: str, given: Mapping[str, Any], before: Any = None) -> dict[str, Any]:
    """An entry of [known] from the fields of the page; empty where no number was typed.

    Parameters
    ----------
    name : str
    given : mapping
        ``value``, ``low``, ``high``, ``unit``, ``side``, as text or number.
    before : number or mapping, optional
        The entry it replaces: its remarks stay.

    Raises
    ------
    InputError
        A field that is no number.
    """
    out: dict[str, Any] = {}
    for key in NUMBERS:
        text = str(given.get(key, "") if given.get(key) is not None else "").strip()
        if text:
            plain = text.replace("\N{MINUS SIGN}", "-").replace(",", ".", 1)
            out[key] = _number(f"{words(name)}, {key}", plain)
    if not out:
        return {}
    out |= {k: text for k in ("unit", "side") if (text := str(given.get(k) or "").strip())}
    old = before if isinstance(before, Mapping) else {}
    return out | {k: old[k] for k in REMARKS if k in old}


def known_fields(live: Live) -> list[dict[str, Any]]:
    """What the page asks of each parameter of the joint: ``name``, ``meaning``, ``unit``, ``given``
    (the entry of [known] as it was typed, empty without one). Empty without a joint.
    """
    joint = live.joint_or_none()
    if joint is None:
        return []
    model = live.analysis().current.model if live.state.steps else joint.model()
    given = from_toml(live.state.joint_text, "joint").get("known", {})
    inertias = [p.for_kind(model.kind) for p in INERTIAS.values()]
    found = {p.name: p for p in (*inertias, *model.parameters) if p.role not in NOT_GIVEN}
    rows = []
    for name, p in found.items():
        entry = given.get(name, {})
        rows.append(
            {
                "name": name,
                "meaning": p.meaning.strip(),
                "unit": p.unit,
                "given": dict(entry) if isinstance(entry, Mapping) else {"value": entry},
            }
        )
    return rows


def limits_of(live: Live) -> dict[str, tuple[float, float]]:
    """Physical bounds of every parameter of the model as it stands; none before the first fit."""
    if not live.state.steps:
        return {}
    return {p.name: (p.low, p.high) for p in live.analysis().current.model.parameters}


def within(name: str, value: float, limits: Mapping[str, tuple[float, float]]) -> float:
    """The value, which is one that the parameter can have.

    Raises
    ------
    InputError
        It is out of the parameter's bounds.
    """
    low, high = limits.get(name, (-math.inf, math.inf))
    if not low <= value <= high:
        bound = f"less than {low:.4g}" if value < low else f"more than {high:.4g}"
        raise InputError(f"{name} cannot be {bound}; {value:g} was given")
    return value


def _number(name: str, value: Any) -> float:
    try:
        made = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name}: {value!r} is not a number") from None
    if not math.isfinite(made):
        raise InputError(f"{name}: the value must be a finite number")
    return made


def windows_of(given: Any) -> tuple[tuple[float, float], ...]:
    """Windows of a plot [s], in order, those that touch joined.

    Raises
    ------
    InputError
        No list of pairs of numbers.
    """
    if not isinstance(given, Sequence) or isinstance(given, str) or len(given) > MOST_WINDOWS:
        raise InputError(f"windows: a list of at most {MOST_WINDOWS} pairs of times")
    pairs = []
    for one in given:
        if not isinstance(one, Sequence) or isinstance(one, str) or len(one) != 2:
            raise InputError("windows: each is a pair of times")
        low, high = sorted(_number("window", v) for v in one)
        pairs.append((low, high))
    out: list[tuple[float, float]] = []
    for low, high in sorted(pairs):
        if out and low <= out[-1][1]:
            out[-1] = (out[-1][0], max(out[-1][1], high))
        else:
            out.append((low, high))
    return tuple(out)
