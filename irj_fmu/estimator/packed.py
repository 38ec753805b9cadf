"""What an estimator FMU carries beside its joint file: its options and its sample time."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from identification.data.plain_text import from_toml
from identification.data.schema import Key, Schema
from identification.errors import InputError
from identification.online.options import OnlineOptions

STEP: Final = 1e-3
"""Time between two samples where nothing tells it [s]: the usual cycle of a drive's bus."""

_DEFAULTS: Final = asdict(OnlineOptions())
OPTIONS: Final = Schema(
    "options",
    "Start values of an estimator's parameters.",
    (
        *(
            Key(name, "flag" if isinstance(value, bool) else "number", "", default=value)
            for name, value in _DEFAULTS.items()
        ),
        Key("sample_time", "number", "time between two samples", unit="s", default=STEP),
    ),
)
"""Keys of the options file: those of :class:`OnlineOptions`, and the step."""


def load_options(path: Path) -> tuple[OnlineOptions, float]:
    """Options that an estimator was built with, and its sample time [s].

    Raises
    ------
    InputError
        Where the file is not one that :func:`options_text` wrote.
    """
    try:
        given = OPTIONS.read(from_toml(path.read_text(encoding="utf-8"), str(path)), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: not the options of an estimator ({error}); build the FMU again"
        ) from error
    values: dict[str, Any] = {n: type(v)(given[n]) for n, v in _DEFAULTS.items()}
    return OnlineOptions(**values), given["sample_time"]


def options_text(options: OnlineOptions, sample_time: float = STEP) -> str:
    """The options as TOML."""
    lines = OPTIONS.lines({**asdict(options), "sample_time": sample_time})
    return "".join(f"{line}\n" for line in lines)


__all__ = ["OPTIONS", "STEP", "load_options", "options_text"]
