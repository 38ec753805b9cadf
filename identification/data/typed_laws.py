"""Typed laws in a joint file: the table [laws] read into effects of the library, and written
back.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from casadi_models.text.typed_law import LawError, TypedLaw, register
from identification.data.joint_schema import LAW
from identification.errors import InputError

LAWS: Final = "laws"
"""Name of the table in a joint file."""
_ENTRY: Final = (
    'like { law = "a*tanh(v/b)", on = ["motor"], parameters = ["a=1..10 N.m", "b=0.01..1 rad/s"] }'
)


def read_laws(table: Any, kind: str, source: str) -> dict[str, TypedLaw]:
    """The typed laws of a joint file, by key, put into the library.

    Parameters
    ----------
    table : mapping
        ``{key: {"law": ..., "on": [...], "parameters": [...]}}``.
    kind : {"rotary", "linear"}
    source : str
        Path of the joint file.

    Raises
    ------
    InputError
        A law that cannot be used: one line.
    """
    found = {}
    for key, entry in table.items():
        where = f"{source}: [{LAWS}] {key}"
        if not isinstance(entry, Mapping) or set(entry) != set(LAW.names):
            raise InputError(f"{where} must be a table {_ENTRY}")
        places, parameters = entry["on"], entry["parameters"]
        lists = all(
            isinstance(x, list) and all(isinstance(y, str) for y in x) for x in (places, parameters)
        )
        if not isinstance(entry["law"], str) or not lists:
            raise InputError(f"{where} must be a table {_ENTRY}")
        found[key] = TypedLaw(key, entry["law"], tuple(places), tuple(parameters), kind)
    hold_laws(found, source)
    return found


def hold_laws(laws: Mapping[str, TypedLaw], source: str) -> None:
    """Put typed laws into the library, in place of others of their keys.

    Raises
    ------
    InputError
        A law that cannot be used: one line.
    """
    for key, law in laws.items():
        try:
            register(law)
        except LawError as error:
            raise InputError(f"{source}: [{LAWS}] {key}: {error}") from None


def law_lines(laws: Mapping[str, TypedLaw]) -> list[str]:
    """The lines of a joint file that hold these laws."""
    lines = [
        f"{key} = {LAW.inline({'law': w.text, 'on': w.places, 'parameters': w.parameters})}"
        for key, w in laws.items()
    ]
    return ["", f"[{LAWS}]", *lines] if lines else []


__all__ = ["LAWS", "hold_laws", "law_lines", "read_laws"]
