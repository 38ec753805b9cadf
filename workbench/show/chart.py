"""The frame of every chart: axes whose labels say the side, curves with bands, SVG and CSV of the
same data.
"""

from __future__ import annotations

import csv
import html
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, final

import numpy as np
import numpy.typing as npt

from identification.data.formats import number, pretty_unit

FloatArray = npt.NDArray[np.float64]
Style = Literal["before", "after", "law", "ink"]

WIDTH: Final = 360
HEIGHT: Final = 238
LEFT: Final = 54
RIGHT: Final = 12
TOP: Final = 26
BOTTOM: Final = 40

MOST_LOG_TICKS: Final = 8
"""Marks of a logarithmic axis; with more, only the decades are marked."""

BEFORE: Final = "#d55e00"
AFTER: Final = "#0072b2"
LAW: Final = "#00795c"
LETTER: Final = 5.9
"""Width of a letter of a label, on the safe side."""
INK: Final = "#444444"
GRID: Final = "#cccccc"


@final
@dataclass(frozen=True)
class Frame:
    """Linear map from data to the picture's coordinates."""

    x: tuple[float, float]
    y: tuple[float, float]
    height: int = HEIGHT
    bottom: int = BOTTOM
    width: int = WIDTH

    def across(self, value: float) -> float:
        """Horizontal coordinate of a value."""
        low, high = self.x
        return LEFT + (value - low) / (high - low) * (self.width - LEFT - RIGHT)

    def up(self, value: float) -> float:
        """Vertical coordinate of a value, kept inside the frame."""
        low, high = self.y
        share = min(max((value - low) / (high - low), 0.0), 1.0)
        return TOP + (1 - share) * (self.height - TOP - self.bottom)


def ticks(low: float, high: float, most: int = 5) -> list[float]:
    """Round numbers inside a range, at most `most` + 1 of them."""
    span = high - low
    if not (math.isfinite(span) and span > 0):
        return [low]
    raw = span / most
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(m * unit for m in (1, 2, 2.5, 5, 10, 20) if m * unit >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) + 0.0 for k in range(first, math.floor(high / step + 1e-9) + 1)]


def word(x: float, y: float, text: str, anchor: str = "middle", extra: str = "") -> str:
    """A label at a point of the picture."""
    return (
        f'<text class="s-ink" fill="{INK}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" '
        f'font-size="11"{extra}>{html.escape(text)}</text>'
    )


def log_ticks(low: float, high: float) -> list[float]:
    """Exponents of the round numbers 1, 2 and 5 of each decade inside a range of exponents."""
    first, last = math.floor(low), math.ceil(high)
    every = [k + math.log10(m) for k in range(first, last + 1) for m in (1, 2, 5)]
    inside = [t for t in every if low <= t <= high]
    if len(inside) > MOST_LOG_TICKS:
        return [t for t in inside if t == round(t)]
    return inside if len(inside) > 1 else ticks(low, high, 3)


def whole_ticks(low: float, high: float) -> list[float]:
    """Whole numbers inside a range, at most about ten of them."""
    step = max(1, math.ceil((high - low) / 10))
    return [float(k) for k in range(math.ceil(low), math.floor(high) + 1, step)]


def axes(
    frame: Frame,
    x_label: str,
    y_label: str,
    *,
    x_ticks: bool = True,
    logarithmic: bool = False,
    counted: bool = False,
) -> str:
    """Grid, marks and labels of a frame; the label of the values stands above them, where there is
    room for a side.
    """
    base, right = frame.height - frame.bottom, frame.width - RIGHT
    out = [f'<path class="s-grid" stroke="{GRID}" fill="none" d="M{LEFT} {TOP}V{base}H{right}"/>']
    for t in log_ticks(*frame.y) if logarithmic else ticks(*frame.y, 4):
        y = frame.up(t)
        out.append(
            f'<path class="s-grid" stroke="{GRID}" stroke-width="0.6" d="M{LEFT} {y:.1f}H{right}"/>'
        )
        out.append(word(LEFT - 5, y + 4, number(10**t if logarithmic else t, 3), "end"))
    if x_ticks:
        for t in whole_ticks(*frame.x) if counted else ticks(*frame.x, 5):
            x = frame.across(t)
            out.append(
                f'<path class="s-grid" stroke="{GRID}" d="M{x:.1f} {base}v4"/>'
                + word(min(x, frame.width - 16), base + 16, number(t, 3))
            )
    out.append(
        word((LEFT + right) / 2, frame.height - 6, x_label, "middle", _fitted(x_label, frame))
    )
    out.append(word(4, 13, y_label, "start", _fitted(y_label, frame)))
    return "".join(out)


def _fitted(said: str, frame: Frame) -> str:
    """A label that is longer than the picture is squeezed into it: its side must not be cut."""
    room = frame.width - 8
    if len(said) * LETTER <= room:
        return ""
    return f' textLength="{room}" lengthAdjust="spacingAndGlyphs"'


def svg(
    label: str, body: str, height: int = HEIGHT, width: int = WIDTH, kind: str = "picture"
) -> str:
    """An ``svg`` element; `label` says in words what it shows, `kind` is its class."""
    return (
        f'<svg class="{kind}" role="img" aria-label="{html.escape(label, quote=True)}" '
        f'viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" font-family="system-ui, sans-serif">{body}</svg>'
    )


def sheet(body: str, width: int, height: int, more: str = "") -> str:
    """A picture that is a file of its own: on white, with the attributes of `more`."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" font-family="system-ui, sans-serif"{more}>'
        f'<rect width="100%" height="100%" fill="#ffffff"/>{body}</svg>\n'
    )


# --- labels and curves ----------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class Label:
    """What an axis shows.

    Attributes
    ----------
    what, unit : str
    side : str
        Where it is measured or to which side it is referred; empty for what has no side, as time.
    """

    what: str
    unit: str = ""
    side: str = ""

    def __str__(self) -> str:
        shown = pretty_unit(self.unit)
        return (
            self.what + (f", {self.side}" if self.side else "") + (f" [{shown}]" if shown else "")
        )


@final
@dataclass(frozen=True)
class Curve:
    """Points of a chart that belong together.

    Attributes
    ----------
    name : str
        In the table of its values.
    x, y : (n,) array
        NaN in `y` interrupts the line.
    style : {"before", "after", "law", "ink"}
    low, high : (n,) array, optional
        A band; NaN where there is none.
    marks : {"", "diamond", "square", "dot"}
        At every point.
    dashed, line : bool
    """

    name: str
    x: FloatArray
    y: FloatArray
    style: Style
    low: FloatArray | None = None
    high: FloatArray | None = None
    marks: str = ""
    dashed: bool = False
    line: bool = True


_COLOURS: Final = {"before": BEFORE, "after": AFTER, "law": LAW, "ink": INK}
_WILD: Final = 3.0
"""Widest band that decides the scale, in units of the largest value: one wild bin must not flatten
the curve."""
_ROOM: Final = 1.06


@final
@dataclass(frozen=True)
class Chart:
    """Curves over one axis.

    Attributes
    ----------
    said : str
        What it shows, in words.
    x, y : Label
    curves : tuple of Curve
    zero : bool
        Values reach as far below zero as above it, and zero is drawn.
    """

    said: str
    x: Label
    y: Label
    curves: tuple[Curve, ...]
    zero: bool = True
    width: int = WIDTH
    height: int = HEIGHT

    def frame(self) -> Frame | None:
        """The map from data to coordinates; None where there is nothing to draw."""
        across = _finite([c.x for c in self.curves])
        values = _finite([v for c in self.curves for v in (c.y, *_kept_bands(c))])
        if not len(across) or not len(values):
            return None
        low, high = float(values.min()), float(values.max())
        if self.zero:
            high = max(abs(low), abs(high), 1e-12) * _ROOM
            low = -high
        else:
            room = (_ROOM - 1) * (high - low) or max(abs(high), 1e-12) * (_ROOM - 1)
            low, high = low - room, high + room
        first, last = float(across.min()), float(across.max())
        return Frame(
            (first, last if last > first else first + 1.0),
            (low, high),
            height=self.height,
            width=self.width,
        )

    def svg(self) -> str:
        """An ``svg`` element."""
        frame = self.frame()
        if frame is None:
            body = word(self.width / 2, self.height / 2, "no rows")
            return svg(self.said, body, self.height, self.width)
        body = axes(frame, str(self.x), str(self.y))
        if self.zero:
            body += (
                f'<path class="s-ink" stroke="{INK}" stroke-width="0.8" d="M{LEFT} '
                f'{frame.up(0.0):.1f}H{self.width - RIGHT}"/>'
            )
        body += "".join(_band(c, frame) for c in self.curves)
        body += "".join(_line(c, frame) + _marks(c, frame) for c in self.curves)
        return svg(self.said, body, self.height, self.width)

    def csv(self) -> str:
        """The same points as a table, one row a point, in the units of the labels."""
        out = io.StringIO()
        write = csv.writer(out, lineterminator="\n").writerow
        write(["curve", str(self.x), str(self.y), "low", "high"])
        for c in self.curves:
            nothing = np.full(len(c.x), np.nan)
            bands = (
                (c.low if c.low is not None else nothing),
                (c.high if c.high is not None else nothing),
            )
            for point in zip(c.x, c.y, *bands, strict=True):
                write([c.name, *(f"{v:.9g}" if math.isfinite(v) else "" for v in point)])
        return out.getvalue()

    def as_json(self) -> dict[str, Any]:
        """For a page: the picture, the table, and the frame with which a cursor finds its value."""
        frame = self.frame()
        return {
            "svg": self.svg(),
            "csv": self.csv(),
            "x": str(self.x),
            "y": str(self.y),
            "dashed": any(c.dashed for c in self.curves),
            "frame": None
            if frame is None
            else {
                "x": list(frame.x),
                "y": list(frame.y),
                "left": LEFT,
                "right": self.width - RIGHT,
                "top": TOP,
                "bottom": self.height - BOTTOM,
                "width": self.width,
                "height": self.height,
            },
        }


def _finite(values: Sequence[FloatArray]) -> FloatArray:
    whole = np.concatenate([np.asarray(v, dtype=np.float64) for v in values] or [np.zeros(0)])
    kept: FloatArray = whole[np.isfinite(whole)]
    return kept


def _kept_bands(c: Curve) -> list[FloatArray]:
    finite = np.abs(c.y[np.isfinite(c.y)])
    limit = _WILD * float(np.max(finite, initial=0.0))
    return [v[np.isfinite(v) & (np.abs(v) <= limit)] for v in (c.low, c.high) if v is not None]


def _band(c: Curve, frame: Frame) -> str:
    if c.low is None or c.high is None:
        return ""
    known = np.isfinite(c.low) & np.isfinite(c.high)
    out = []
    for run in np.split(np.arange(len(known)), np.flatnonzero(~known)):
        run = run[known[run]]  # a band ends where a bin has none
        if len(run) < 2:
            continue
        x = [frame.across(float(c.x[i])) for i in run]
        upper = [f"{a:.1f} {frame.up(float(c.high[i])):.1f}" for a, i in zip(x, run, strict=True)]
        lower = [f"{a:.1f} {frame.up(float(c.low[i])):.1f}" for a, i in zip(x, run, strict=True)]
        points = "M" + "L".join([*upper, *lower[::-1]]) + "Z"
        out.append(
            f'<path class="s-{c.style} band" fill="{_COLOURS[c.style]}" fill-opacity="0.22" '
            f'stroke="none" d="{points}"/>'
        )
    return "".join(out)


def _line(c: Curve, frame: Frame) -> str:
    if not c.line:
        return ""
    known = np.isfinite(c.y)
    parts = []
    for run in np.split(np.arange(len(known)), np.flatnonzero(~known)):
        run = run[known[run]]
        if len(run):
            parts.append(
                "M"
                + "L".join(
                    f"{frame.across(float(c.x[i])):.1f} {frame.up(float(c.y[i])):.1f}" for i in run
                )
            )
    if not parts:
        return ""
    dash = ' stroke-dasharray="5 3"' if c.dashed else ""
    width = 2.4 if c.style == "law" else 1.6
    return (
        f'<path class="s-{c.style}" fill="none" stroke="{_COLOURS[c.style]}" '
        f'stroke-width="{width}"{dash} d="{"".join(parts)}"/>'
    )


_SHAPES: Final = {
    "diamond": "M{x:.1f} {t:.1f}l2.8 2.8l-2.8 2.8l-2.8 -2.8z",
    "square": "M{l:.1f} {u:.1f}h4v4h-4z",
    "dot": "M{l:.1f} {y:.1f}a2 2 0 1 0 4 0a2 2 0 1 0 -4 0z",
}


def _marks(c: Curve, frame: Frame) -> str:
    if not c.marks:
        return ""
    shape, out = _SHAPES[c.marks], []
    for a, b in zip(c.x, c.y, strict=True):
        if math.isfinite(a) and math.isfinite(b):
            x, y = frame.across(float(a)), frame.up(float(b))
            out.append(shape.format(x=x, y=y, t=y - 2.8, l=x - 2, u=y - 2))
    return (
        f'<path class="s-{c.style} dot" fill="{_COLOURS[c.style]}" stroke="none" '
        f'd="{"".join(out)}"/>'
    )
