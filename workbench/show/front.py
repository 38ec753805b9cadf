"""An exploration in one picture: held-out error against parameters, and what its dots are."""

from __future__ import annotations

import html
import textwrap
from typing import Final

from identification.data.formats import number
from identification.variants.exploration import Exploration, Variant
from workbench.show.chart import AFTER, BEFORE, INK, WIDTH, sheet
from workbench.show.pictures import Dot, front_picture
from workbench.show.results import spaced, table, text

ROWS: Final = 11
"""Variants that are named beside the picture."""
LINE: Final = 15
LETTERS: Final = 84
"""Letters of a line beside the picture."""
BESIDE: Final = 560
WORST: Final = 1.15
"""Error, in units of that of the start model, up to which a variant is drawn."""


def exploration_picture(found: Exploration) -> str:
    """A self-contained SVG: every variant's held-out error against its parameters, with the names
    of those that matter.
    """
    drawn, front = _drawn(found)
    numbers = {id(v): k for k, v in enumerate(_numbered(found), 1)}
    dots = [
        Dot(
            v.parameters,
            v.error_percent,
            number=numbers.get(id(v), 0),
            best=v is found.recommended,
            tied=v.tied,
            ours=v is found.improved,
        )
        for v in drawn
    ]
    rows = [
        f"{numbers[id(v)]}  {_short(v)}: {number(v.relative_error_percent, 3)} %, "
        f"{v.parameters} parameters{_said(found, v)}"
        for v in _numbered(found)
    ]
    named = [
        (r, AFTER if v is found.recommended else INK)
        for r, v in zip(rows, _numbered(found), strict=True)
    ]
    sentences = [found.reason, found.agreement]
    lines = [w for s in sentences for w in (*textwrap.wrap(s, LETTERS), "")][:-1]
    height = max(LINE * (len(named) + len(lines) + 2), 300)
    picture = front_picture(dots, front, height - 34)
    legend = (
        _word(54, 18, AFTER, "\u25cf recommended")
        + _word(150, 18, AFTER, "\u25cb tied")
        + _word(196, 18, BEFORE, "\u25a1 improve")
        + _word(262, 18, AFTER, "\u2500 front")
    )
    y = 18
    beside = ""
    for line, colour in [*named, ("", INK), *((w, INK) for w in lines)]:
        beside += _word(WIDTH + 16, y, colour, line)
        y += LINE
    body = f'{legend}<g transform="translate(0 30)">{picture}</g>{beside}'
    return sheet(body, WIDTH + BESIDE, height)


def exploration_html(found: Exploration) -> str:
    """The picture with the table of its variants, for a notebook."""
    rows = [
        [
            text(v.name),
            str(v.parameters),
            f"{number(v.relative_error_percent, 3)} %",
            number(v.score, 2),
            f"{v.chosen_percent:.0f} %",
        ]
        for v in found.variants[:ROWS]
    ]
    head = ("variant", "parameters", "held-out error", "score behind", "best in")
    return spaced(f"<div>{exploration_picture(found)}{table(head, rows, found.agreement)}</div>")


def _numbered(found: Exploration) -> list[Variant]:
    """The variants that are named: recommended and tied, start model, choice of `improve`, then
    the front.
    """
    out: list[Variant] = []
    ours = [found.improved] if found.improved is not None else []
    for v in (found.start, found.recommended, *found.ties, *ours, *found.front[::-1]):
        inside = v.error_percent <= WORST * 100 or v.tied
        if v not in out and len(out) < ROWS and inside:
            out.append(v)
    return sorted(out, key=lambda v: (v.parameters, -v.error_percent))


def _drawn(found: Exploration) -> tuple[list[Variant], list[int]]:
    """Variants inside the picture, and the front among them: a model without gravity would flatten
    all others.
    """
    named = _numbered(found)
    drawn = [v for v in found.variants if v in named or v.error_percent <= WORST * 100]
    front = [k for v in found.front for k, d in enumerate(drawn) if d is v]
    return drawn, front


def _short(v: Variant) -> str:
    """Name of a variant in one line."""
    return textwrap.shorten(v.name, 58, placeholder=" ...")


def _said(found: Exploration, v: Variant) -> str:
    words = []
    if v is found.recommended:
        words.append("recommended")
    elif v.tied:
        words.append("tied")
    if v is found.improved:
        words.append("improve")
    return f" ({', '.join(words)})" if words else ""


def _word(x: float, y: float, colour: str, said: str) -> str:
    return f'<text x="{x:g}" y="{y:g}" font-size="11" fill="{colour}">{html.escape(said)}</text>'
