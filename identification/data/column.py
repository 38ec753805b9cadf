"""One column of a file as one channel: unit, scale, sign; and a guess of it with its reason."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, final

from identification.data.formula import Formula
from identification.data.joint_schema import COLUMN
from identification.data.units import base_unit, same_dimension
from identification.errors import InputError

_BRACKET: Final = re.compile(r"^(.*?)\s*[\[(]([^\])]*)[\])]\s*$")


@final
@dataclass(frozen=True)
class Column:
    """How one channel is made from a column: ``SI = to_si(sign * scale * raw, unit)``.

    Attributes
    ----------
    channel : str
        Channel name, or ``"time"``.
    column : str
        Name of the column in the file; empty for a time made from `step`.
    unit : str
        Unit of ``raw * scale``.
    scale, sign : float
        Factors; the sign is +1 or -1.
    counts_per_turn : float, optional
        Encoder counts of one turn, where the unit is ``counts``.
    step : float, optional
        For time only: the files has no time column, the samples are `step` apart.
    formula : Formula, optional
        In place of a column: what is made of several.
    """

    channel: str
    column: str
    unit: str
    scale: float = 1.0
    sign: int = 1
    counts_per_turn: float | None = None
    step: float | None = None
    formula: Formula | None = None

    @property
    def sources(self) -> tuple[str, ...]:
        """Columns of the file that the channel is made of."""
        if self.formula is not None:
            return self.formula.columns
        return () if self.step is not None else (self.column,)

    def describe(self) -> str:
        """Return one line for the provenance: where the channel comes from."""
        if self.step is not None:
            return f"{self.channel} = row number x {self.step:g} {self.unit}"
        text = (
            f"{self.channel} = {self.column!r}"
            if self.formula is None
            else f"{self.channel} = {self.formula.text}"
        )
        if self.channel == "run":
            return text
        text += f" [{self.unit}]"
        if self.scale != 1.0:
            text += f" x {self.scale:.10g}"
        if self.sign == -1:
            text += ", sign reversed"
        if self.counts_per_turn is not None:
            text += f", {self.counts_per_turn:g} counts per turn"
        return text

    def entry(self) -> dict[str, Any]:
        """Return the keys of the column in a column map, without those that say nothing."""
        plain = self.formula is None and self.step is None
        values = {
            "column": self.column if plain else None,
            "formula": self.formula.text if self.formula is not None else None,
            "step": self.step,
            "unit": self.unit if self.channel != "run" else None,
            "scale": self.scale if self.scale != 1.0 else None,
            "sign": self.sign if self.sign != 1 else None,
            "counts_per_turn": self.counts_per_turn,
        }
        return {k: v for k, v in values.items() if v is not None}

    def toml(self) -> str:
        """Return ``channel = { column = ..., unit = ... }``."""
        return f"{self.channel} = {COLUMN.inline(self.entry())}"


@final
@dataclass(frozen=True)
class Guess:
    """A proposed column and why."""

    column: Column
    reason: str


def split_unit(name: str) -> tuple[str, str | None]:
    """Split ``"speed [rpm]"`` or ``"speed (rpm)"`` into name and unit."""
    match = _BRACKET.match(name.strip())
    if match and match.group(1):
        return match.group(1).strip(), match.group(2).strip() or None
    return name.strip(), None


def header_unit(text: str, wanted: str) -> str | None:
    """Find the unit in the tail of a header: underscores stand for ``/`` or ``.``.

    Parameters
    ----------
    text : str
        For example ``"rad_s2"``.
    wanted : str
        The SI unit the channel has.

    Returns
    -------
    str or None
        The unit spelled out (``"rad/s2"``), or None where no reading has the wanted dimension.
    """
    parts = text.split("_")
    if not all(parts) or len(parts) > 4:
        return None
    target = base_unit(wanted)
    if wanted == "K" and parts[0] in {"C", "F"}:
        parts[0] = f"deg{parts[0]}"
    for marks in itertools.product("/.", repeat=len(parts) - 1):
        unit = "".join(
            itertools.chain.from_iterable(itertools.zip_longest(parts, marks, fillvalue=""))
        )
        try:
            if same_dimension(base_unit(unit, 1.0), target):
                return unit
        except InputError:
            continue
    return None


def shown(names: Iterable[str], limit: int = 20) -> str:
    """Return names for a message, the first `limit` of them."""
    every = list(names)
    more = f", ... ({len(every)} in all)" if len(every) > limit else ""
    return ", ".join(every[:limit]) + more if every else "none"
