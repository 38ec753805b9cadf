"""Small pictures as SVG text: the residual in its place, the falling staircase, the bar of a row.

No scripts, no style attributes: colours are presentation attributes that a page's classes override
(``s-before``, ``s-after``, ``s-ink``, ``s-grid``). Text is escaped.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

import numpy as np

from identification.data.formats import number, pretty_unit

if TYPE_CHECKING:
    from identification.diagnosis.places import Branch, Place
    from identification.linear.poles import Pole

WIDTH: Final = 360
HEIGHT: Final = 224
LEFT: Final = 54
RIGHT: Final = 12
TOP: Final = 12
BOTTOM: Final = 40

MOST_LOG_TICKS: Final = 8
"""Marks of a logarithmic axis; with more, only the decades are marked."""

BEFORE: Final = "#d55e00"
AFTER: Final = "#0072b2"
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

    def across(self, value: float) -> float:
        """Horizontal coordinate of a value."""
        low, high = self.x
        return LEFT + (value - low) / (high - low) * (WIDTH - LEFT - RIGHT)

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


def _text(x: float, y: float, text: str, anchor: str = "middle", extra: str = "") -> str:
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


def _axes(
    frame: Frame,
    x_label: str,
    y_label: str,
    *,
    x_ticks: bool = True,
    logarithmic: bool = False,
    counted: bool = False,
) -> str:
    base = frame.height - frame.bottom
    out = [
        f'<path class="s-grid" stroke="{GRID}" fill="none" d="M{LEFT} '
        f'{TOP}V{base}H{WIDTH - RIGHT}"/>'
    ]
    for t in log_ticks(*frame.y) if logarithmic else ticks(*frame.y, 4):
        y = frame.up(t)
        out.append(
            f'<path class="s-grid" stroke="{GRID}" stroke-width="0.6" d="M{LEFT} '
            f'{y:.1f}H{WIDTH - RIGHT}"/>'
        )
        out.append(_text(LEFT - 5, y + 4, number(10**t if logarithmic else t, 3), "end"))
    if x_ticks:
        for t in whole_ticks(*frame.x) if counted else ticks(*frame.x, 5):
            x = frame.across(t)
            out.append(
                f'<path class="s-grid" stroke="{GRID}" d="M{x:.1f} {base}v4"/>'
                + _text(min(x, WIDTH - 16), base + 16, number(t, 3))
            )
    out.append(_text((LEFT + WIDTH - RIGHT) / 2, frame.height - 6, x_label))
    middle = (TOP + base) / 2
    out.append(_text(11, middle, y_label, "middle", f' transform="rotate(-90 11 {middle:.1f})"'))
    return "".join(out)


def _svg(label: str, body: str, height: int = HEIGHT) -> str:
    return (
        f'<svg class="picture" role="img" aria-label="{html.escape(label, quote=True)}" '
        f'viewBox="0 0 {WIDTH} {height}" '
        f'width="{WIDTH}" height="{height}" font-family="system-ui, sans-serif">{body}</svg>'
    )


def _curve(b: Branch, frame: Frame, kind: str, colour: str) -> str:
    if not len(b.centre):
        return ""
    x = [frame.across(float(v)) for v in b.centre]
    known = np.isfinite(b.low) & np.isfinite(b.high)
    out = []
    for run in np.split(np.arange(len(known)), np.flatnonzero(~known)):
        run = run[known[run]]  # a band ends where a bin has none
        if len(run) < 2:
            continue
        upper = [f"{x[i]:.1f} {frame.up(float(b.high[i])):.1f}" for i in run]
        lower = [f"{x[i]:.1f} {frame.up(float(b.low[i])):.1f}" for i in run[::-1]]
        points = "M" + "L".join(upper + lower) + "Z"
        out.append(
            f'<path class="s-{kind} band" fill="{colour}" fill-opacity="0.22" stroke="none" '
            f'd="{points}"/>'
        )
    line = "M" + "L".join(
        f"{p:.1f} {frame.up(float(m)):.1f}" for p, m in zip(x, b.mean, strict=True)
    )
    dash = ' stroke-dasharray="5 3"' if b.direction == "backward" else ""
    out.append(
        f'<path class="s-{kind}" fill="none" stroke="{colour}" stroke-width="1.6"{dash} '
        f'd="{line}"/>'
    )
    for p, m in zip(x, b.mean, strict=True):
        y = frame.up(float(m))
        shape = (
            f"M{p - 2:.1f} {y - 2:.1f}h4v4h-4z"
            if kind == "after"
            else f"M{p:.1f} {y - 2.8:.1f}l2.8 2.8l-2.8 2.8l-2.8 -2.8z"
        )
        out.append(f'<path class="s-{kind} dot" fill="{colour}" d="{shape}"/>')
    return "".join(out)


def place_picture(before: Place, after: Place | None = None, quantity: str = "residual") -> str:
    """Mean residual against one signal before (diamonds) and after (squares) an addition, with 95 %
    bands.

    Parameters
    ----------
    before : Place
    after : Place, optional
        With the same bins.
    quantity : str
        What is drawn, where it is no residual.

    Returns
    -------
    str
        An ``svg`` element.
    """
    shown = [before, *([after] if after is not None else [])]
    centres = np.concatenate([b.centre for p in shown for b in p.branches])
    values = np.concatenate(
        [v for p in shown for b in p.branches for v in (b.mean, *_kept_bands(b))]
    )
    values = values[np.isfinite(values)]
    if not len(centres) or not len(values):
        return _svg(f"{before.title}: no rows", _text(WIDTH / 2, HEIGHT / 2, "no rows"))
    size = max(float(np.max(np.abs(values))), 1e-12) * 1.06
    low, high = float(centres.min()), float(centres.max())
    frame = Frame((low, high if high > low else low + 1.0), (-size, size))
    body = _axes(
        frame,
        f"{before.title} [{pretty_unit(before.unit)}]",
        f"{quantity} [{pretty_unit(before.residual_unit)}]",
    )
    zero = frame.up(0.0)
    body += (
        f'<path class="s-ink" stroke="{INK}" stroke-width="0.8" d="M{LEFT} '
        f'{zero:.1f}H{WIDTH - RIGHT}"/>'
    )
    body += "".join(_curve(b, frame, "before", BEFORE) for b in before.branches)
    if after is not None:
        body += "".join(_curve(b, frame, "after", AFTER) for b in after.branches)
    return _svg(_place_label(before, after, quantity), body)


def _kept_bands(b: Branch) -> tuple[np.ndarray[tuple[int], np.dtype[np.float64]], ...]:
    """Bands that decide the scale: one wild bin must not flatten the curve."""
    limit = 3 * float(np.max(np.abs(b.mean), initial=0.0))
    return tuple(v[np.isfinite(v) & (np.abs(v) <= limit)] for v in (b.low, b.high))


def _largest(place: Place) -> float:
    return max((float(np.max(np.abs(b.mean), initial=0.0)) for b in place.branches), default=0.0)


def _place_label(before: Place, after: Place | None, quantity: str) -> str:
    unit = before.residual_unit
    text = (
        f"Mean {quantity} of the {before.balance} balance against {before.title}: largest "
        f"{number(_largest(before), 3)} {unit}"
    )
    return text + (
        f" before, {number(_largest(after), 3)} {unit} after" if after is not None else ""
    )


def staircase_picture(
    values: Sequence[float], floor: float | None, labels: Sequence[str] = ()
) -> str:
    """Held-out error after each step as a falling staircase.

    Parameters
    ----------
    values : sequence of float
        Relative error [%], the start model first.
    floor : float or None
        Error that measurement noise alone would leave [%].
    labels : sequence of str
        Under each tread; "start", "1", "2" ... by default.
    """
    names = list(labels) or ["start", *(str(i) for i in range(1, len(values)))]
    top = max([*values, floor or 0.0, 1e-9]) * 1.18
    frame = Frame((0.0, float(len(values))), (0.0, top))
    body = _axes(frame, "step of the ledger", "held-out error [%]", x_ticks=False)
    base = HEIGHT - BOTTOM
    treads = [
        (frame.across(i + 0.06), frame.across(i + 1), frame.up(v)) for i, v in enumerate(values)
    ]
    area = (
        f"M{treads[0][0]:.1f} {base}"
        + "".join(f"V{y:.1f}H{b:.1f}" for _, b, y in treads)
        + f"V{base}Z"
    )
    line = f"M{treads[0][0]:.1f} {treads[0][2]:.1f}" + "".join(
        f"V{y:.1f}H{b:.1f}" for _, b, y in treads
    )
    body += (
        f'<path class="s-after band" fill="{AFTER}" fill-opacity="0.22" stroke="none" d="{area}"/>'
    )
    body += f'<path class="s-after" fill="none" stroke="{AFTER}" stroke-width="2.4" d="{line}"/>'
    for (a, b, y), v, name in zip(treads, values, names, strict=True):
        body += _text((a + b) / 2, y - 5, f"{number(v, 3)} %") + _text((a + b) / 2, base + 15, name)
    if floor is not None:
        y = frame.up(floor)
        body += (
            f'<path class="s-ink" stroke="{INK}" stroke-dasharray="2 3" d="M{LEFT} '
            f'{y:.1f}H{WIDTH - RIGHT}"/>'
        )
    fall = " to ".join(f"{number(v, 3)} %" for v in values)
    noise = f"; measurement noise alone leaves {number(floor, 3)} %" if floor is not None else ""
    return _svg(f"Held-out error, step by step: {fall}{noise}", body)


@final
@dataclass(frozen=True)
class Dot:
    """A variant in the picture of error against parameters.

    Attributes
    ----------
    parameters : int
    error : float
        On held-out records, in percent of that of the start model.
    number : int
        Of its row beside the picture; 0 for none.
    best, tied, ours : bool
        Recommended; not to be told from it; the choice of `improve`.
    """

    parameters: int
    error: float
    number: int = 0
    best: bool = False
    tied: bool = False
    ours: bool = False


def front_picture(dots: Sequence[Dot], front: Sequence[int], height: int = HEIGHT) -> str:
    """Held-out error against parameters: every variant a dot, the front as a staircase, the
    recommended filled, ties ringed, the choice of `improve` a square around it.

    Parameters
    ----------
    dots : sequence of Dot
    front : sequence of int
        Those on the front, the fewest parameters first.
    height : int
    """
    errors = [math.log10(max(d.error, 1e-12)) for d in dots]
    few, many = min(d.parameters for d in dots), max(d.parameters for d in dots)
    room = 0.06 * max(max(errors) - min(errors), 0.1)
    frame = Frame(
        (few - 0.6, many + 0.6), (min(errors) - 2 * room, max(errors) + room), height=height
    )
    body = _axes(
        frame, "free parameters", "held-out error [% of start]", logarithmic=True, counted=True
    )
    treads = {dots[k].parameters: errors[k] for k in reversed(front)}  # the best of each column
    stairs = [(frame.across(n), frame.up(treads[n])) for n in sorted(treads)]
    if stairs:
        line = f"M{stairs[0][0]:.1f} {stairs[0][1]:.1f}" + "".join(
            f"H{x:.1f}V{y:.1f}" for x, y in stairs[1:]
        )
        end = frame.across(many + 0.6)
        body += (
            f'<path class="s-after" fill="none" stroke="{AFTER}" stroke-width="1.4" '
            f'd="{line}H{end:.1f}"/>'
        )
    for k in sorted(range(len(dots)), key=lambda i: (dots[i].best, dots[i].number > 0)):
        body += _dot(dots[k], frame.across(dots[k].parameters), frame.up(errors[k]))
    lowest: dict[int, float] = {}  # of each column: numbers stand under each other
    for k in sorted(range(len(dots)), key=lambda i: frame.up(errors[i])):
        if dots[k].number:
            column = dots[k].parameters
            y = max(frame.up(errors[k]) - 5, lowest.get(column, -math.inf) + 11)
            lowest[column] = y
            body += _text(frame.across(column) + 9, y, str(dots[k].number), "start")
    least = min(d.error for d in dots)
    return _svg(
        f"Held-out error against free parameters: {len(dots)} variants with {few} to {many} "
        f"parameters, the lowest error {number(least, 3)} % of that of the start model",
        body,
        height,
    )


def _dot(dot: Dot, x: float, y: float) -> str:
    """One variant."""
    out = ""
    if dot.ours:
        out += (
            f'<rect class="s-before" fill="none" stroke="{BEFORE}" stroke-width="1.6" '
            f'x="{x - 8:.1f}" y="{y - 8:.1f}" width="16" height="16"/>'
        )
    marked = dot.best or dot.tied
    colour, kind = (AFTER, "after") if marked or dot.number else (INK, "ink")
    fill = "#ffffff" if dot.tied and not dot.best else colour
    opacity = 1 if marked or dot.number else 0.35
    size = 5 if marked else 3.4 if dot.number else 2.4
    out += (
        f'<circle class="s-{kind}" fill="{fill}" stroke="{colour}" stroke-width="1.6" '
        f'opacity="{opacity}" cx="{x:.1f}" cy="{y:.1f}" r="{size}"/>'
    )
    return out


def pole_picture(poles: Sequence[Pole], title: str) -> str:
    """Poles in the upper half of the plane of z: a cross each, an ellipse of two standard
    deviations where they are known, and the circle that stable poles stay inside.

    Parameters
    ----------
    poles : sequence of Pole
    title : str
        Whose poles they are.
    """
    # one length is one length either way, so that the circle is round
    wide, high = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM
    frame = Frame((-1.05, 1.05), (-0.06, 2.1 * high / wide - 0.06))
    body = _axes(frame, "real part", "imaginary part")
    turn = np.linspace(0.0, math.pi, 91)
    circle = "L".join(
        f"{frame.across(float(a)):.1f} {frame.up(float(b)):.1f}"
        for a, b in zip(np.cos(turn), np.sin(turn), strict=True)
    )
    body += f'<path class="s-ink" fill="none" stroke="{INK}" d="M{circle}"/>'
    for one in poles:
        x, y = frame.across(max(min(one.value.real, 1.05), -1.05)), frame.up(one.value.imag)
        body += _ellipse(one, frame)
        body += (
            f'<path class="s-after" fill="none" stroke="{AFTER}" stroke-width="1.8" '
            f'd="M{x - 4:.1f} {y - 4:.1f}l8 8m0 -8l-8 8"/>'
        )
    said = ", ".join(f"{number(p.value.real, 4)} {number(p.value.imag, 4)}i" for p in poles)
    return _svg(f"Poles of {title}, upper half: {said or 'none'}", body)


def _ellipse(one: Pole, frame: Frame) -> str:
    if not np.isfinite(one.covariance).all():
        return ""
    size, axes = np.linalg.eigh(one.covariance)
    turn = np.linspace(0.0, 2.0 * math.pi, 37)
    round_ = 2.0 * np.sqrt(np.maximum(size, 0.0))[:, None] * np.array([np.cos(turn), np.sin(turn)])
    path = "L".join(
        f"{frame.across(one.value.real + float(a)):.1f} {frame.up(one.value.imag + float(b)):.1f}"
        for a, b in (axes @ round_).T
    )
    return (
        f'<path class="s-after band" fill="{AFTER}" fill-opacity="0.22" stroke="none" '
        f'd="M{path}z"/>'
    )


def bar(share: float, label: str) -> str:
    """A bar from 0 to 100 %; a share below 0 is drawn as 0."""
    width = 80 * min(max(share / 100, 0.0), 1.0) if math.isfinite(share) else 0.0
    return (
        f'<svg class="bar" role="img" aria-label="{html.escape(label, quote=True)}" viewBox="0 0 '
        '80 10" width="80" height="10">'
        f'<rect class="s-rest" fill="{GRID}" fill-opacity="0.5" width="80" height="10"/>'
        f'<rect class="s-after" fill="{AFTER}" width="{width:.1f}" height="10"/></svg>'
    )
