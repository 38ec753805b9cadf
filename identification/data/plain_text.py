"""Text of a user's TOML or JSON file as plain data, and back: whatever is wrong with it is one
line.
"""

from __future__ import annotations

import datetime as dt
import json
import math
import re
import tomllib
from collections.abc import Callable, Mapping
from typing import Any, Final

from identification.errors import InputError

DEEPEST: Final = 40
"""Deepest nesting of tables and lists; a joint file needs 3, a study 4."""
_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")
_LARGEST: Final = 2**63
"""Whole numbers of a TOML file have 64 bits (TOML 1.0, section Integer)."""


def from_toml(text: str, source: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises
    ------
    InputError
        No valid TOML; nested too deep; a whole number of more than 64 bits.
    """
    data: dict[str, Any] = _parsed(tomllib.loads, text, source, "TOML")
    return data


def from_json(text: str | bytes, source: str) -> Any:
    """The data of a JSON text.

    Raises
    ------
    InputError
        No valid JSON; nested too deep; a whole number of more than 64 bits.
    """
    return _parsed(json.loads, text, source, "JSON")


def toml_string(text: str) -> str:
    """A text as a basic string of TOML: what cannot stand in one line is escaped; half of a
    surrogate pair becomes ``?``.
    """
    plain = text.encode("utf-8", "replace").decode("utf-8")
    return '"' + "".join(_character(c) for c in plain) + '"'


def toml_key(text: str) -> str:
    """A key of TOML, in quotes where it must be."""
    return text if _BARE.fullmatch(text) else toml_string(text)


def tables_text(data: Mapping[str, Any]) -> str:
    """Plain data as the text of a TOML file: one table after another, each key on a line.

    Parameters
    ----------
    data : mapping of str to mapping
        The tables, as `from_toml` reads them.
    """
    parts = []
    for name, table in data.items():
        lines = [f"{toml_key(str(k))} = {toml_value(v)}" for k, v in table.items()]
        parts.append("\n".join([f"[{toml_key(str(name))}]", *lines]))
    return "\n\n".join(parts) + "\n"


def toml_value(value: Any) -> str:
    """A value of plain data as TOML: texts, numbers, dates, lists and (inline) tables.

    Raises
    ------
    TypeError
        Anything else, which TOML does not know.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return toml_string(value)
    if isinstance(value, int | float):
        return repr(
            int(value) if isinstance(value, int) else float(value)
        )  # numpy's numbers name their type
    if isinstance(value, dt.datetime | dt.date | dt.time):
        return value.isoformat()
    if isinstance(value, Mapping):
        inside = ", ".join(f"{toml_key(str(k))} = {toml_value(v)}" for k, v in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    raise TypeError(f"{type(value).__name__} has no form in TOML")


def _character(c: str) -> str:
    if c in '"\\':
        return "\\" + c
    return c if c.isprintable() or c == "\u00a0" else f"\\U{ord(c):08x}"


def _parsed(parse: Callable[[Any], Any], text: str | bytes, source: str, language: str) -> Any:
    try:
        data = parse(text)
    except RecursionError:
        raise _too_deep(source) from None
    except ValueError as error:  # both decoders' errors, no UTF-8, and Python's limit on digits
        detail = " ".join(str(error).split())[:160]
        if "int_max_str_digits" in detail:  # advice for a programmer
            detail = "a whole number of thousands of digits"
        raise InputError(f"{source}: not valid {language} ({detail})") from None
    _check(data, source, 0)
    return data


def _check(data: Any, source: str, depth: int) -> None:
    if depth > DEEPEST:
        raise _too_deep(source)
    if isinstance(data, dict):
        for value in data.values():
            _check(value, source, depth + 1)
    elif isinstance(data, list):
        for value in data:
            _check(value, source, depth + 1)
    elif isinstance(data, int) and not -_LARGEST <= data < _LARGEST:
        digits = int(math.log10(abs(data))) + 1
        raise InputError(
            f"{source}: a whole number of {digits} digits; numbers here have 64 bits, write it "
            f"as 1e{digits - 1}"
        )


def _too_deep(source: str) -> InputError:
    return InputError(f"{source}: nested deeper than {DEEPEST} levels; no file of irj needs that")


__all__ = [
    "DEEPEST",
    "from_json",
    "from_toml",
    "tables_text",
    "toml_key",
    "toml_string",
    "toml_value",
]
