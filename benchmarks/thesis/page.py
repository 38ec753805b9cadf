"""What an experiment hands to the page: text, tables of printed beside found values, pictures."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final


@final
@dataclass(frozen=True)
class Row:
    """One number of the thesis and what came out here.

    Attributes
    ----------
    what : str
    printed : float or None
        None where the thesis prints none.
    found : float or tuple of float
        One per column of the table.
    """

    what: str
    printed: float | None
    found: tuple[float, ...]


@final
@dataclass(frozen=True)
class Table:
    """Rows under a heading; `columns` names those of :attr:`Row.found`."""

    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    first: str = "parameter"
    printed: str = "printed"

    def __str__(self) -> str:
        """Markdown."""
        heads = [self.first, *([self.printed] if self._has_printed else []), *self.columns]
        out = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
        for r in self.rows:
            cells = [
                r.what,
                *([shown(r.printed)] if self._has_printed else []),
                *(self._cell(v, c) for v, c in zip(r.found, self.columns, strict=True)),
            ]
            out.append("| " + " | ".join(cells) + " |")
        return "\n".join(out)

    @staticmethod
    def _cell(value: float, column: str) -> str:
        return (
            f"{value:.2f}"
            if math.isfinite(value) and column.endswith(("[%]", "[s]"))
            else shown(value)
        )

    @property
    def _has_printed(self) -> bool:
        return any(r.printed is not None for r in self.rows)


@final
@dataclass(frozen=True)
class Figure:
    """One picture file.

    Attributes
    ----------
    stem : str
        Name of the file without its ending.
    thesis : str
        Figures of the thesis that it re-enacts.
    caption : str
        What it shows, with its number.
    svg : str
    """

    stem: str
    thesis: str
    caption: str
    svg: str


@final
@dataclass
class Section:
    """One experiment: a heading and what stands under it, in order."""

    title: str
    parts: list[str | Table | Figure] = field(default_factory=list)
    brief: list[tuple[str, str]] = field(default_factory=list)
    """Lines for the overview: what of the thesis, and what came out."""

    def add(self, *parts: str | Table | Figure) -> None:
        """Append text, tables or figures."""
        self.parts.extend(parts)

    @property
    def tables(self) -> list[Table]:
        """The tables, in order."""
        return [p for p in self.parts if isinstance(p, Table)]

    @property
    def figures(self) -> list[Figure]:
        """The pictures, in order."""
        return [p for p in self.parts if isinstance(p, Figure)]

    def markdown(self, folder: str) -> str:
        """The section as text; pictures lie in `folder`."""
        out = [f"## {self.title}"]
        for p in self.parts:
            if isinstance(p, Figure):
                out.append(
                    f"![{p.thesis}]({folder}/{p.stem}.svg)\n\n"
                    f"{wrapped(f'*{p.thesis}.* {p.caption}')}"
                )
            else:
                out.append(str(p) if isinstance(p, Table) else wrapped(p))
        return "\n\n".join(out) + "\n"


def wrapped(text: str) -> str:
    """A paragraph in lines of a page's width."""
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def shown(value: float | None) -> str:
    """A number as a table prints it."""
    if value is None or not math.isfinite(value):
        return "-"
    if 99 <= abs(value) < 100:
        return f"{value:.3f}"
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"
    mantissa, exponent = f"{value:.3e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"


def percent(found: float, true: float) -> float:
    """Deviation [%]."""
    return 100.0 * (found / true - 1.0)


def listed(words: Sequence[str]) -> str:
    """a, b and c."""
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]
