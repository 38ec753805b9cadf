"""Tables of a user's TOML files, each declared once: key, kind of value, unit, meaning, default.

From a declaration come the reading of a table, the line that refuses what does not belong there,
the text that is written back, and the reference page.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, final

from identification.data.plain_text import toml_key, toml_value
from identification.errors import InputError

Kind = Literal["number", "text", "label", "flag", "names", "any"]
KINDS: Final[Mapping[Kind, str]] = {
    "number": "number",
    "text": "text",
    "label": "text",
    "flag": "true or false",
    "names": "list of texts",
    "any": "",
}
"""Kinds of a value, as the reference page calls them. A label may be written as a number, too;
``any`` is read by whoever asks for it, and its form stands in the meaning.
"""


@final
@dataclass(frozen=True)
class Key:
    """One key of a table.

    Attributes
    ----------
    name : str
    kind : str
        One of `KINDS`.
    meaning : str
        A clause for the reader of the reference page.
    unit : str
        SI unit of a number, or what its unit is taken from; empty where it has none.
    default : object
        What holds where the key is left out; None: nothing, or what `absent` says.
    absent : str
        What being left out means, where the default does not say it.
    choices : tuple of str
        The only texts that are read; empty for any.
    example : str
        How a list is written, for the line that refuses something else.
    form : str
        What ``any`` may be, as the reference page says it.
    digits : int
        Significant digits that are written; 0 for all.
    required : bool
    """

    name: str
    kind: Kind
    meaning: str
    unit: str = ""
    default: Any = None
    absent: str = ""
    choices: tuple[str, ...] = ()
    example: str = ""
    form: str = ""
    digits: int = 0
    required: bool = False

    def read(self, table: Mapping[str, Any], where: str) -> Any:
        """The checked value of this key, its default where it is left out.

        Parameters
        ----------
        table : mapping
        where : str
            File and table, for the message.

        Raises
        ------
        InputError
            A value of another kind, or none of the choices.
        """
        value = table.get(self.name)
        if value is None:
            return self.default
        if not self.choices:
            return _READ[self.kind](value, self, where)
        if value not in self.choices:
            raise InputError(
                f"{where}: {self.name} = {value!r} is not known; use one of "
                f"{', '.join(self.choices)}{meant(str(value), self.choices)}"
            )
        return str(value)

    def text(self, value: Any) -> str:
        """``name = value`` as TOML."""
        shown = f"{value:.{self.digits}g}" if self.digits else toml_value(value)
        return f"{toml_key(self.name)} = {shown}"


@final
@dataclass(frozen=True)
class Schema:
    """One kind of table in a file.

    Attributes
    ----------
    place : str
        The table as messages and the page name it: ``[joint]``, ``[known] NAME``.
    meaning : str
        A sentence or two for the page.
    keys : tuple of Key
        In the order in which they are written.
    """

    place: str
    meaning: str
    keys: tuple[Key, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the keys."""
        return tuple(key.name for key in self.keys)

    def __getitem__(self, name: str) -> Key:
        return next(key for key in self.keys if key.name == name)

    def check(self, table: Mapping[str, Any], where: str) -> None:
        """Refuse a key that the table does not have, with the names that it has."""
        refuse_unknown(table, self.names, where)

    def read(self, table: Mapping[str, Any], where: str) -> dict[str, Any]:
        """Every key's checked value or default, by name.

        Raises
        ------
        InputError
            An unknown key; a value that cannot be used.
        """
        self.check(table, where)
        return {key.name: key.read(table, where) for key in self.keys}

    def lines(self, values: Mapping[str, Any]) -> list[str]:
        """The table as lines of TOML, keys in the declared order; None is left out."""
        return [self[name].text(value) for name, value in self._given(values)]

    def inline(self, values: Mapping[str, Any]) -> str:
        """The table as one value, ``{ key = value, ... }``; None is left out."""
        return f"{{ {', '.join(self.lines(values))} }}"

    def _given(self, values: Mapping[str, Any]) -> Iterable[tuple[str, Any]]:
        strangers = set(values) - set(self.names)
        if strangers:
            raise KeyError(f"{self.place} has no key {', '.join(sorted(strangers))}")
        return [(n, values[n]) for n in self.names if values.get(n) is not None]


def refuse_unknown(table: Iterable[str], known: Collection[str], where: str) -> None:
    """Refuse a name that is not among those that are known, with the one that may be meant.

    Raises
    ------
    InputError
    """
    for name in table:
        if name not in known:
            raise InputError(
                f"{where} has an unknown key {name!r}; known: {', '.join(sorted(known))}"
                f"{meant(name, known)}"
            )


def meant(name: str, known: Iterable[str]) -> str:
    """``; did you mean 'x'?`` where a known name is close, else nothing."""
    close = difflib.get_close_matches(name, list(known), 1)
    return f"; did you mean {close[0]!r}?" if close else ""


# --- one reader for each kind ---------------------------------------------------------------------


def finite(value: Any, what: str) -> float:
    """A finite number; `what` says whose, such as ``joint.toml: [known] stiffness: value``.

    Raises
    ------
    InputError
        Anything else, true and false included.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{what} = {value!r} is not a finite number")
    return float(value)


def _number(value: Any, key: Key, where: str) -> float:
    return finite(value, f"{where}: {key.name}")


def _text(value: Any, key: Key, where: str) -> str:
    if not isinstance(value, str):
        raise InputError(f"{where}: {key.name} = {value!r} is not a text; write it in quotes")
    return value


def _label(value: Any, key: Key, where: str) -> str:
    if isinstance(value, Mapping | list):
        raise InputError(f'{where}: {key.name} must be a text, as {key.name} = "axis 3"')
    return str(value)


def _flag(value: Any, key: Key, where: str) -> bool:
    if not isinstance(value, bool):
        raise InputError(f"{where}: {key.name} = {value!r}; use true or false")
    return value


def _names(value: Any, key: Key, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(e, str) for e in value):
        raise InputError(f"{where}: {key.name} must be a list of names, as {key.example}")
    return tuple(value)


def _any(value: Any, key: Key, where: str) -> Any:
    return value


_READ: Final[Mapping[Kind, Callable[[Any, Key, str], Any]]] = {
    "number": _number,
    "text": _text,
    "label": _label,
    "flag": _flag,
    "names": _names,
    "any": _any,
}

__all__ = ["KINDS", "Key", "Kind", "Schema", "finite", "meant", "refuse_unknown"]
