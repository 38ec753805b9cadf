"""Figures as small SVG files: panels of curves, and maps over two parameters."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.data.formats import number
from workbench.show.chart import (
    AFTER,
    BEFORE,
    HEIGHT,
    INK,
    LEFT,
    RIGHT,
    WIDTH,
    Frame,
    axes,
    sheet,
    word,
)
from workbench.show.plots import min_max

FloatArray = npt.NDArray[np.float64]

POINTS: Final = 120
"""Points of one curve at most."""
_LEGEND: Final = 22
_LEVELS: Final = 12
"""Shades of a map."""
_SHORTER: Final = (
    (f' class="s-ink" fill="{INK}"', ""),
    (' font-size="11"', ""),
    (' class="s-grid"', ""),
    ("#cccccc", "#ccc"),
    (' stroke-width="0.6"', ""),
)
"""What a file of its own can say once, or leave out."""
COLOURS: Final = {
    "measured": BEFORE,
    "model": AFTER,
    "limit": INK,
    "second": "#009e73",
    "third": "#cc79a7",
}


@final
@dataclass(frozen=True)
class Curve:
    """One line of a panel.

    Attributes
    ----------
    x, y : (n,) array
    kind : str
        Key of :data:`COLOURS`; "limit" is drawn dashed.
    dots : bool
        Marks at the points.
    """

    x: FloatArray
    y: FloatArray
    kind: str = "model"
    dots: bool = False


@final
@dataclass(frozen=True)
class Panel:
    """Curves in one frame.

    Attributes
    ----------
    title, x_label, y_label : str
    curves : tuple of Curve
    y_range : tuple of float, optional
        From the curves by default.
    points : int
        Points of one curve at most.
    """

    title: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    y_range: tuple[float, float] | None = None
    points: int = POINTS


@final
@dataclass(frozen=True)
class Map:
    """Values over a grid: cells in shades of one colour.

    Attributes
    ----------
    title, x_label, y_label : str
    x, y : (n,), (m,) array
    values : (m, n) array
    """

    title: str
    x_label: str
    y_label: str
    x: FloatArray
    y: FloatArray
    values: FloatArray


def picture(
    panels: Sequence[Panel | Map],
    label: str,
    legend: Sequence[tuple[str, str]] = (),
    *,
    columns: int = 2,
) -> str:
    """One SVG file with panels side by side.

    Parameters
    ----------
    panels : sequence of Panel or Map
    label : str
        What the picture shows, for those who do not see it.
    legend : sequence of (kind, words)
    columns : int
    """
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    head = _LEGEND if legend else 4
    wide, high = columns * WIDTH, rows * (HEIGHT + _LEGEND) + head
    body: list[str] = []
    for i, (kind, words) in enumerate(legend):
        x = LEFT + 150 * i
        body.append(_line([(x, 13.0), (x + 22.0, 13.0)], kind) + word(x + 28, 17, words, "start"))
    for i, panel in enumerate(panels):
        x, y = i % columns * WIDTH, i // columns * (HEIGHT + _LEGEND) + head
        inner = _map(panel) if isinstance(panel, Map) else _panel(panel)
        scale = (
            f", {number(float(panel.values.min()), 2)} (white) to "
            f"{number(float(panel.values.max()), 2)}"
            if isinstance(panel, Map)
            else ""
        )
        title = word((LEFT + WIDTH - RIGHT) / 2, 15, panel.title + scale)
        body.append(
            f'<g transform="translate({x} {y})">{title}<g transform="translate(0 '
            f'{_LEGEND - 6})">{inner}</g></g>'
        )
    inside = "".join(body)
    for long, short in _SHORTER:
        inside = inside.replace(long, short)
    said = f'role="img" aria-label="{html.escape(label, quote=True)}"'
    return sheet(inside, wide, high, f' {said} font-size="11" fill="{INK}"')


def _panel(panel: Panel) -> str:
    x = np.concatenate([c.x for c in panel.curves])
    y = np.concatenate([c.y for c in panel.curves])
    y = y[np.isfinite(y)]
    low, high = panel.y_range or (float(y.min()), float(y.max()))
    room = 0.0 if panel.y_range else 0.06 * (high - low) or max(abs(high), 1.0) * 0.1
    frame = Frame((float(x.min()), float(x.max())), (low - room, high + room))
    out = [axes(frame, panel.x_label, panel.y_label)]
    for c in panel.curves:
        kept = min_max(len(c.x), [c.y], panel.points)
        rows = np.arange(len(c.x)) if kept is None else kept[0]
        points = [
            (frame.across(float(c.x[k])), frame.up(float(c.y[k])))
            for k in rows
            if np.isfinite(c.y[k])
        ]
        out.append(_line(points, c.kind))
        if c.dots:
            out.extend(
                f'<circle fill="{COLOURS[c.kind]}" cx="{a:.0f}" cy="{b:.0f}" r="2.5"/>'
                for a, b in points
            )
    return "".join(out)


def _line(points: Sequence[tuple[float, float]], kind: str) -> str:
    """A polyline in whole quarter steps from point to point, short in the file."""
    dash = ' stroke-dasharray="20 16"' if kind == "limit" else ""
    last = (round(4 * points[0][0]), round(4 * points[0][1]))
    path = [f"M{last[0]} {last[1]}l"]
    for a, b in points[1:]:
        now = (round(4 * a), round(4 * b))
        step = f"{now[0] - last[0]} {now[1] - last[1]}"
        path.append(step if step.startswith("-") or len(path) == 1 else f" {step}")
        last = now
    return (
        f'<path fill="none" stroke="{COLOURS[kind]}" stroke-width="5"{dash} '
        f'transform="scale(.25)" d="{"".join(path).replace(" -", "-")}"/>'
    )


def _map(panel: Map) -> str:
    x_edge, y_edge = _edges(panel.x), _edges(panel.y)
    frame = Frame((x_edge[0], x_edge[-1]), (y_edge[0], y_edge[-1]))
    low, high = float(panel.values.min()), float(panel.values.max())
    span = high - low or 1.0
    cells: dict[int, list[str]] = {}
    for j in range(len(panel.y)):
        for i in range(len(panel.x)):
            level = round(_LEVELS * (float(panel.values[j, i]) - low) / span)
            left, right = round(frame.across(x_edge[i])), round(frame.across(x_edge[i + 1]))
            top, bottom = round(frame.up(y_edge[j + 1])), round(frame.up(y_edge[j]))
            cells.setdefault(level, []).append(f"M{left} {top}H{right}V{bottom}H{left}z")
    out = [
        f'<path fill="{AFTER}" fill-opacity="{n / _LEVELS:.2f}" d="{"".join(d)}"/>'
        for n, d in sorted(cells.items())
    ]
    out.append(axes(frame, panel.x_label, panel.y_label))
    return "".join(out)


def _edges(centres: FloatArray) -> list[float]:
    middle = (centres[1:] + centres[:-1]) / 2
    return [
        float(centres[0] - (middle[0] - centres[0])),
        *middle.tolist(),
        float(2 * centres[-1] - middle[-1]),
    ]
