"""The model description of an FMU, with what its variables take from their declared types; one line
where it cannot be read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from identification.errors import InputError

INHERITED: Final = ("quantity", "unit", "displayUnit", "min", "max", "nominal")
"""Attributes of a declared type that hold for a variable that does not state them itself (FMI
2.0.4, section 2.2.3, and FMI 3.0, section 2.4.4)."""
LONGEST: Final = 400
"""Most characters of a reason: a validator lists every variable, and names may have any length."""
_SLIPS: Final = (AttributeError, IndexError, KeyError, TypeError)
"""How fmpy fails on a description that refers to what it does not hold."""


def described(folder: Path) -> Any:
    """Return fmpy's description of an extracted FMU.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    Exception
        Of many kinds; :func:`unreadable` makes one line of it.
    """
    from fmpy import read_model_description

    if not (folder / "modelDescription.xml").is_file():
        raise InputError("it holds no modelDescription.xml; give an .fmu file")
    found: Any = read_model_description(str(folder))
    for variable in found.modelVariables:
        kind = variable.declaredType
        for name in INHERITED if kind is not None else ():
            if getattr(variable, name) is None:
                setattr(variable, name, getattr(kind, name))
    return found


def has_state_events(description: Any) -> bool:
    """True where its model exchange jumps at events, which runs here do not look for."""
    return bool(description.numberOfEventIndicators or len(description.eventIndicators))


def unreadable(path: Path, error: Exception) -> InputError:
    """The one line on an FMU that cannot be read.

    Parameters
    ----------
    path : Path
    error : Exception
        Of the archive, the XML or fmpy.
    """
    why = " ".join(str(error).split())
    if isinstance(error, _SLIPS):
        why = (
            "its modelDescription.xml lacks something, or refers to what is not there: "
            f"{type(error).__name__}, {why}; export it again"
        )
    if len(why) > LONGEST:
        why = f"{why[:LONGEST]} ..."
    return InputError(f"{path}: not a readable FMU ({why})")


__all__ = ["INHERITED", "described", "has_state_events", "unreadable"]
