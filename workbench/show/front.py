"""An exploration in one picture: held-out error against parameters, and what its dots are."""

from __future__ import annotations

import html
import math
import textwrap
from typing import Final

from identification.data.formats import number
from identification.variants.exploration import Exploration, Variant
from workbench.show.chart import AFTER, BEFORE, INK, WIDTH, sheet
from workbench.show.pictures import Dot, front_picture
from workbench.show.results import spaced, table, text

ROWS: Final = 11
"""Variants that are named beside the picture."""
LAST: Final = ("score behind", "best in", "note")
LINE: Final = 15
LETTERS: Final = 84
"""Letters of a line beside the picture."""
BESIDE: Final = 560
FIGURE: Final = 300
"""Height of the picture in a report."""
GREY: Final = "#8a8d91"
"""As dots look that are drawn faint."""
BELOW: Final = (
    "Grey below the line: a variant that lacks an effect of the joint file, or that whole fits of "
    "its names rule out; it is no answer."
)
WORST: Final = 1.15
"""Error, in units of that of the start model, up to which a variant is drawn."""


def exploration_picture(found: Exploration) -> str:
    """A self-contained SVG: every variant's held-out error against its parameters, with the names
    of those that matter.
    """
    dots, front = _dots(found)
    numbers = _numbers(found)
    rows = [
        f"{numbers[id(v)]}  {_short(v)}: {number(v.error_percent, 3)} % of start, "
        f"{v.parameters} parameters{_said(found, v)}"
        for v in _numbered(found)
    ]
    named = [
        (r, AFTER if v is found.recommended else INK)
        for r, v in zip(rows, _numbered(found), strict=True)
    ]
    sentences = [*filter(None, (found.reason, found.agreement, _below(found)))]
    lines = [w for s in sentences for w in (*textwrap.wrap(s, LETTERS), "")][:-1]
    height = max(LINE * (len(named) + len(lines) + 2), 300)
    picture = front_picture(dots, front, height - 34)
    legend = (
        _word(54, 18, AFTER, "\u25cf recommended")
        + _word(150, 18, AFTER, "\u25cb tied")
        + _word(196, 18, BEFORE, "\u25a1 improve")
        + _word(262, 18, AFTER, "\u2500 front")
        + _word(308, 18, GREY, "\u25cf others")
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


def exploration_section(found: Exploration) -> str:
    """The section of a report: the front, the variants that are named on it, and what follows."""
    dots, front = _dots(found)
    rows = [
        [
            str(k),
            text(v.name),
            str(v.parameters),
            f"{number(v.relative_error_percent, 3)} %",
            f"{number(v.error_percent, 3)} %",
            number(v.score, 2),
            f"{v.chosen_percent:.0f} %",
            text(_said(found, v).strip(" ()")),
        ]
        for k, v in enumerate(_numbered(found), 1)
    ]
    head = ("dot", "variant", "parameters", "held-out error", "of start", *LAST)
    tied = text(found.alike)
    said = [found.reason, found.agreement]
    said += [
        f"{s.by} stands in for {s.effect}: the records do not tell them apart."
        for s in found.stand_ins
        if s.tied
    ]
    paragraphs = "".join(f"<p>{text(x)}</p>" for x in said)
    return (
        f"<p>{found.screened} variants of the model were scored and {len(found.variants)} fitted. "
        "A dot is a variant: its error on records that no fit saw, against its free parameters. "
        "The line joins those that no other answer beats with as few; the filled dot is "
        "recommended, open ones tie with it, and the square is what the improve loop ends with. "
        f"{_below(found)}</p>"
        f"<figure>{front_picture(dots, front, FIGURE)}</figure>{paragraphs}"
        f"{table(head, rows, f'Tied: {tied}' if tied else 'Nothing ties with the recommended one')}"
        "<p class='note'>Score behind: sum over the balances of the logarithm of the error on "
        "unseen blocks, .10 for each effect and .05 for each of its parameters beyond the first, "
        "less that of the recommended variant. Best in: share of resampled records in which the "
        "variant has the lowest score.</p>"
    )


def _below(found: Exploration) -> str:
    """Why dots lie below the front; empty where none does."""
    drawn, front = _drawn(found)
    beaten = any(
        v.error_percent
        < min(
            (f.error_percent for f in found.front if f.parameters <= v.parameters), default=math.inf
        )
        for k, v in enumerate(drawn)
        if k not in front and (v.dropped or v.behind)
    )
    return BELOW if beaten else ""


def _numbers(found: Exploration) -> dict[int, int]:
    """Number of each variant that is named, by its identity."""
    return {id(v): k for k, v in enumerate(_numbered(found), 1)}


def _dots(found: Exploration) -> tuple[list[Dot], list[int]]:
    """Dots of the picture, and which of them are on the front."""
    drawn, front = _drawn(found)
    numbers = _numbers(found)
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
    return dots, front


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
