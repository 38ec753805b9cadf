"""The tables of a joint file whose model is a user's FMU, declared."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from identification.data.plain_text import from_toml
from identification.data.schema import Key, Schema

MODEL: Final = Schema(
    "[model]",
    "A user's FMU as the model ([user-fmu.md](user-fmu.md)). It takes the place of `model` in "
    "[joint].",
    (
        Key("fmu", "text", "the FMU, beside the joint file, or a whole path", required=True),
        Key("kind", "text", "`me` or `cs`", absent="what the FMU has; `me` where it has both"),
        Key(
            "hold",
            "flag",
            "whether inputs hold between two samples; false: their mean stands between them",
            default=True,
        ),
        Key(
            "window",
            "number",
            "length of stretches that are simulated, each from a start of its own",
            unit="s",
            absent="whole records",
        ),
        Key(
            "outside",
            "any",
            "effects that ride outside the FMU, off its drive",
            form="list of texts",
        ),
        Key(
            "coupling",
            "number",
            "longest time for which the slope of their torque lets it hold; a fit writes it",
            unit="s",
            absent="found by the fit",
        ),
        Key("channels", "any", "see below", form="table"),
        Key("parameters", "any", "see below", form="table"),
        Key("start", "any", "see below", form="table"),
    ),
)

CHANNEL: Final = Schema(
    "[model.channels] CHANNEL",
    "The FMU's variable for a channel of the record: its name, or a table. The variable is "
    "`scale` times the channel in SI units.",
    (
        Key("variable", "text", "variable of the FMU", required=True),
        Key("scale", "number", "variable / channel", absent="from the unit that the FMU declares"),
    ),
)

BOUNDS: Final = Schema(
    "[model.parameters] VARIABLE",
    "A parameter that a fit may move.",
    (
        Key("low", "number", "lower bound", unit="the FMU's", absent="the FMU's own"),
        Key("high", "number", "upper bound", unit="the FMU's", absent="the FMU's own"),
    ),
)

START: Final = Schema(
    "[model.start] VARIABLE",
    "Where a state of the FMU starts: a channel's name, a number, or a table.",
    (
        Key("channel", "text", "channel of the record", required=True),
        Key("scale", "number", "variable / channel", absent="from the unit that the FMU declares"),
    ),
)

PAGES: Final = (MODEL, CHANNEL, BOUNDS, START)
"""The tables in the order of the reference page."""


def fmu_of(path: str | Path) -> Path | None:
    """The FMU that a joint file names as its model; None for a joint model, and for a file that
    cannot be read, which is left to others to refuse.
    """
    path = Path(path)
    try:
        table = from_toml(path.read_text(encoding="utf-8-sig"), str(path))
        return path.parent / str(table["model"]["fmu"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


__all__ = ["BOUNDS", "CHANNEL", "MODEL", "PAGES", "START"]
