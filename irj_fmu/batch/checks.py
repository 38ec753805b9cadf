"""Small checks of what a study file holds; each refusal is one line that begins with the place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

from identification.data.schema import finite
from identification.errors import InputError

Value: TypeAlias = float | int | bool | str


def table(data: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    """A table, empty where it is missing."""
    found = data.get(key, {})
    if not isinstance(found, Mapping):
        raise InputError(f"{where}: {key} must be a table, as [{key}] on a line of its own")
    return found


def names(entry: Mapping[str, Any], key: str, where: str) -> tuple[str, ...]:
    """A list of texts, empty where it is missing; one text may stand alone."""
    found = entry.get(key, [])
    found = [found] if isinstance(found, str) else found
    if not isinstance(found, list) or not all(isinstance(name, str) and name for name in found):
        raise InputError(f'{where}: {key} must be a list of names, as {key} = ["..."]')
    if len(set(found)) < len(found):
        raise InputError(f"{where}: {key} names something twice")
    return tuple(found)


def value(entry: Any, where: str) -> Value:
    """A finite number, true, false or a text."""
    if isinstance(entry, bool | str):
        return entry
    if isinstance(entry, int):
        return entry
    return finite(entry, where)


def flag(entry: Mapping[str, Any], key: str, where: str, default: bool) -> bool:
    """True or false."""
    found = entry.get(key, default)
    if not isinstance(found, bool):
        raise InputError(f"{where}: {key} = {found!r}; use true or false")
    return found
