"""What is chosen in a plot and changes the input of the fit: a parameter that is held, windows that
are left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from identification.data.plain_text import from_toml, tables_text
from identification.errors import InputError
from workbench.page.live import Live

GIVEN: Final = ("joint", "known", "columns", "effects", "laws")
"""Tables of a joint file that say what is given; the others say what a fit made of it."""
MOST_WINDOWS: Final = 50


def held_text(live: Live, held: Any) -> str:
    """The joint file with parameters held at values, or let free again.

    The model as it stands, with all that was added, becomes the start model of the branch that
    begins so.

    Parameters
    ----------
    live : Live
    held : mapping of str to number or None
        None lets a parameter free.

    Raises
    ------
    InputError
        No mapping, or a value that is no number.
    """
    if not isinstance(held, Mapping) or not held:
        raise InputError("hold: say which parameter at which value")
    text = live.analysis().to_joint_file() if live.state.steps else live.state.joint_text
    data = from_toml(text, "joint")
    known = dict(data.get("known", {}))
    limits = limits_of(live)
    for name, value in held.items():
        known.pop(name, None)
        if value is not None:
            known[name] = within(name, _number(name, value), limits)
    made = {k: v for k, v in data.items() if k in GIVEN and k != "known"}
    return tables_text(made | ({"known": known} if known else {}))


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
