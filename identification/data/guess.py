"""A guess which column is which channel, by name and unit; it is shown to the user and never
applied silently.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from identification.data.channels import CHANNELS, channel_unit
from identification.data.column import Column, Guess, header_unit, shown, split_unit
from identification.data.units import base_unit, same_dimension
from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


def _set(text: str) -> frozenset[str]:
    return frozenset(text.split())


_SIDES: Final[Mapping[str, frozenset[str]]] = {
    "motor": _set("motor mot m in input wg rotor drive antrieb"),
    "link": _set("link load out output joint arm l lnk abtrieb"),
    "reference": _set("ref reference cmd command set setpoint des desired target soll"),
}
_WORDS: Final[Mapping[str, frozenset[str]]] = {
    "time": _set("t time zeit timestamp stamp clock"),
    "run": _set("run trial experiment"),
    "position": _set("q pos position angle theta th phi enc encoder x winkel"),
    "velocity": _set("qd dq vel velocity speed omega w v qdot thetadot rpm"),
    "acceleration": _set("qdd ddq acc accel acceleration alpha"),
    "current": _set("i iq cur curr current amps strom"),
    "torque": _set("tau torque effort moment tq drehmoment force f"),
    "voltage": _set("u volt voltage vin ubus"),
    "temperature": _set("temp temperature tmp"),
}
_SIDE_STEMS: Final = {
    "motor": ("motor", "antrieb", "rotor"),
    "link": ("gelenk", "abtrieb", "last", "arm", "joint", "link"),
}
_QUANTITY_STEMS: Final[Mapping[str, tuple[str, ...]]] = {
    "velocity": ("geschwindigkeit", "drehzahl", "velocity", "speed"),
    "acceleration": ("beschleunigung", "acceleration"),
    "position": ("position", "winkel", "lage", "angle"),
    "current": ("strom", "current"),
    "voltage": ("spannung", "voltage"),
    "temperature": ("temperatur", "temperature"),
    "torque": ("moment", "torque"),
    "time": ("zeit",),
}
"""Compound words, as of German: the side at the front, the quantity at the end."""
_FLAGS: Final = _set("enable enabled flag status state mode error fault deflection defl")
_BY_UNIT: Final = (
    "position",
    "velocity",
    "acceleration",
    "current",
    "torque",
    "voltage",
    "temperature",
    "time",
)


def _tokens(name: str) -> list[str]:
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return [
        re.sub(r"\d+$", "", token).lower() for token in re.split(r"[^A-Za-z0-9]+", spaced) if token
    ]


def _channel(quantity: str, side: str) -> str:
    if quantity in {"time", "run", "temperature"}:
        return quantity
    if side == "reference":
        return "reference_position" if quantity == "position" else ""
    return f"{side}_{quantity}"


def _quantity_unit(quantity: str, kind: str) -> str:
    return channel_unit(
        quantity if quantity in {"time", "temperature"} else f"motor_{quantity}", kind
    )


def _kinds(kind: str) -> tuple[str, str]:
    return (kind, "linear" if kind == "rotary" else "rotary")


def _unit_in_name(name: str, kind: str) -> tuple[str, str, str]:
    """Split off a unit at the end of a name: (rest, quantity, unit), empty where there is none."""
    parts = name.split("_")
    for start in range(1, len(parts)):
        tail = "_".join(parts[start:])
        for axis in _kinds(kind):
            for quantity in _BY_UNIT:
                unit = header_unit(tail, _quantity_unit(quantity, axis))
                if unit is not None:
                    return "_".join(parts[:start]), quantity, unit
    return name, "", ""


def _quantity_of_unit(unit: str, kind: str, strict: bool = False) -> str:
    try:
        found = base_unit(unit, 1.0)
    except InputError:
        return ""
    for axis in _kinds(kind)[: 1 if strict else 2]:
        for quantity in _BY_UNIT:
            if same_dimension(found, base_unit(_quantity_unit(quantity, axis))):
                return quantity
    return ""


def _assumed_unit(channel: str, kind: str) -> str:
    return "degC" if channel == "temperature" else channel_unit(channel, kind)


def _side(tokens: list[str]) -> str:
    words = next(
        (side for side in ("reference", "motor", "link") if _SIDES[side] & set(tokens)), ""
    )
    return words or next(
        (side for side, stems in _SIDE_STEMS.items() if any(t.startswith(stems) for t in tokens)),
        "",
    )


def _quantity(tokens: list[str]) -> str:
    words = next(
        (quantity for quantity, words in _WORDS.items() for token in tokens if token in words), ""
    )
    return words or next(
        (
            quantity
            for quantity, stems in _QUANTITY_STEMS.items()
            if any(t.endswith(stems) for t in tokens)
        ),
        "",
    )


def _guess_one(name: str, file_unit: str | None, kind: str) -> tuple[str, str, str, str]:
    """Return quantity, side, unit and reason; empty strings where nothing is said."""
    plain, bracket = split_unit(name)
    unit = bracket or file_unit or ""
    by_unit = _quantity_of_unit(unit, kind) if unit else ""
    rest = plain
    if not by_unit:
        rest, by_unit, unit = _unit_in_name(plain, kind)
    tokens = _tokens(rest)
    if _FLAGS & set(tokens):
        return "", "", "", ""
    own = _tokens(re.split(r"[/.](?=[^\W\d])", rest)[-1])
    quantity = by_unit or _quantity(own) or _quantity(tokens)
    return (
        quantity,
        _side(own) or _side(tokens),
        unit,
        f"{quantity} by " + ("its unit" if by_unit else "its name, unit assumed"),
    )


def numbered(names: Sequence[str]) -> dict[int, tuple[str, ...]]:
    """Columns of several joints side by side, told by a number in their names: ``q1 .. q6``,
    ``axis1_torque .. axis6_torque``.

    Parameters
    ----------
    names : sequence of str

    Returns
    -------
    dict of int to tuple of str
        By number, the columns of that joint; columns of every joint (the time) are in none. Empty
        where the names do not count on from 0 or 1.
    """
    families: dict[tuple[str, str], dict[int, str]] = {}
    for name in names:
        for found in re.finditer(r"\d+", name):
            digits = found.group().lstrip("0")
            if len(digits) > len(str(len(names))):
                continue  # numbers that count on have no more digits than their count
            ends = name[: found.start()], name[found.end() :]
            families.setdefault(ends, {})[int(digits or "0")] = name
    real = [f for f in families.values() if len(f) > 1 and min(f) <= 1 and max(f) - min(f) < len(f)]
    if not real:
        return {}
    most = max(real, key=len)
    columns: dict[int, set[str]] = {k: set() for k in sorted(most)}
    for family in real:
        for k, name in family.items():
            if k in columns:
                columns[k].add(name)
    place = {name: i for i, name in enumerate(names)}
    return {k: tuple(sorted(own, key=place.__getitem__)) for k, own in columns.items()}


def of_joint(names: Sequence[str], number: int | None) -> tuple[str, ...]:
    """The columns of one of several joints, with those that belong to all of them.

    Parameters
    ----------
    names : sequence of str
    number : int or None
        Number in the names; None: the first. Any number that they do not have: every column, as of
        one joint.
    """
    joints = numbered(names)
    if number is None and joints:
        number = min(joints)
    if number not in joints:
        return tuple(names)
    others = {n for k, own in joints.items() if k != number for n in own}
    return tuple(n for n in names if n not in others or n in joints[number])


def guess_columns(
    names: Sequence[str],
    units: Mapping[str, str] | None = None,
    kind: str = "rotary",
    number: int | None = None,
) -> tuple[Guess, ...]:
    """Propose a column map from names and units.

    Parameters
    ----------
    names : sequence of str
        Columns of the file.
    units : mapping of str to str, optional
        Units the file gives, by column.
    kind : {"rotary", "linear"}
        Kind of the axis.
    number : int, optional
        Where the columns are those of several joints: which of them (see `of_joint`).

    Returns
    -------
    tuple of Guess
        At most one a channel, in the order of the columns, each with its reason.
    """
    own = of_joint(names, number)
    found = [(name, *_guess_one(name, (units or {}).get(name), kind)) for name in own]
    taken: dict[str, Guess] = {}
    for named in (True, False):
        for name, quantity, side, unit, reason in found:
            sideless = quantity in {"time", "run", "temperature"}
            if not quantity or (bool(side) or sideless) != named:
                continue
            if side or sideless:
                channel = _channel(quantity, side)
                why = f"{reason}; its name says {side or quantity}"
            else:
                channel = next(
                    (c for c in _by_default(quantity) if c in CHANNELS and c not in taken), ""
                )
                why = f"{reason}; no side in the name, {channel.partition('_')[0]} side assumed"
            if channel in {"time", *CHANNELS} and channel not in taken:
                taken[channel] = Guess(
                    Column(channel, name, unit or _assumed_unit(channel, kind)), why
                )
    order = {name: place for place, name in enumerate(names)}
    return tuple(sorted(taken.values(), key=lambda guess: order[guess.column.column]))


def _by_default(quantity: str) -> tuple[str, ...]:
    sides = ("link", "motor") if quantity == "torque" else ("motor", "link")
    return tuple(f"{side}_{quantity}" for side in sides)


def fragment(guesses: Sequence[Guess], names: Sequence[str], kind: str = "rotary") -> str:
    """Return the sentence that shows a guess as TOML in one line (an inline table is the same
    as ``[columns]``).
    """
    if not guesses:
        return (
            f"the file has {shown(names)}: name each in [columns], channel = {{ column = ..., "
            f"unit = ... }}"
        )
    body = ", ".join(guess.column.toml() for guess in guesses)
    other = "linear" if kind == "rotary" else "rotary"
    doubt = any(
        _quantity_of_unit(g.column.unit, kind, strict=True) == ""
        for g in guesses
        if g.column.channel != "run"
    )
    hint = f" (with kind = {other!r})" if doubt else ""
    joints = numbered(names)
    if len(joints) > 1:
        hint += f" (it is of joint {min(joints)} of {min(joints)} to {max(joints)})"
    return f"check this guess and put it into the joint file{hint}: columns = {{ {body} }}"
