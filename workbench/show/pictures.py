"""Small pictures as SVG text: the residual in its place, the falling staircase, the bar of a row.

No scripts, no style attributes: colours are presentation attributes that a page's classes override
(``s-before``, ``s-after``, ``s-ink``, ``s-grid``). Text is escaped.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, final

import numpy as np

from identification.data.formats import number
from workbench.show.chart import (
    AFTER,
    BEFORE,
    BOTTOM,
    GRID,
    HEIGHT,
    INK,
    LEFT,
    LETTER,
    RIGHT,
    TOP,
    WIDTH,
    Chart,
    Curve,
    Frame,
    Label,
    Style,
    axes,
    svg,
    word,
)

if TYPE_CHECKING:
    from identification.diagnosis.places import Place
    from identification.linear.poles import Pole

REFERRED: Final = "referred to the link"
AT_THE_LINK: Final = "at the link"
AT_THE_MOTOR: Final = "at the motor"
SIDES: Final = {
    "motor_velocity": ("motor velocity", REFERRED),
    "motor_angle": ("motor angle within a turn", AT_THE_MOTOR),
    "motor_position": ("motor position", REFERRED),
    "motor_acceleration": ("motor acceleration", REFERRED),
    "link_position": ("link position", AT_THE_LINK),
    "link_velocity": ("link velocity", AT_THE_LINK),
    "link_acceleration": ("link acceleration", AT_THE_LINK),
    "load": ("load through the gear", AT_THE_LINK),
    "torsion": ("twist of the gear", AT_THE_LINK),
    "temperature": ("warming since the start", ""),
    "time": ("time, records end to end", ""),
}
"""Each signal in the field's words, with its side."""
LABEL_LINES: Final = 3
LINE: Final = 13


def axis_label(axis: str, title: str, unit: str) -> Label:
    """What an axis of residuals shows, with its side."""
    what, side = SIDES.get(axis, (title, ""))
    return Label(what, unit, side)


def torque_label(what: str, unit: str) -> Label:
    """Torque or force of a balance: balances are written on the link's side of the gear."""
    return Label(what, unit, REFERRED)


def place_chart(
    before: Place,
    after: Place | None = None,
    quantity: str = "residual",
    law: Place | None = None,
) -> Chart:
    """Mean residual against one signal before (diamonds) and after (squares) an addition, with 95 %
    bands, and what a law explains of it (line).

    Parameters
    ----------
    before : Place
    after, law : Place, optional
        With the same bins.
    quantity : str
        What is drawn, where it is no residual.
    """
    curves = [replace(c, line=law is None) for c in _curves(before, "before", "diamond", "before")]
    curves += _curves(after, "after", "square", "after") if after is not None else []
    for c in _curves(law, "law", "", "law") if law is not None else []:
        curves.append(replace(c, low=None, high=None))
    return Chart(
        _place_label(before, after, quantity),
        axis_label(before.axis, before.title, before.unit),
        torque_label(f"{quantity}, {before.balance} balance", before.residual_unit),
        tuple(curves),
    )


def _curves(p: Place, style: Style, marks: str, name: str) -> list[Curve]:
    return [
        Curve(
            name if b.direction == "both" else f"{name}, {b.direction}",
            b.centre,
            b.mean,
            style,
            low=b.low,
            high=b.high,
            marks=marks,
            dashed=b.direction == "backward",
        )
        for b in p.branches
    ]


def place_picture(
    before: Place,
    after: Place | None = None,
    quantity: str = "residual",
    law: Place | None = None,
) -> str:
    """`place_chart` as an ``svg`` element."""
    return place_chart(before, after, quantity, law).svg()


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
    values: Sequence[float],
    floor: float | None,
    labels: Sequence[str] = (),
    width: int = WIDTH,
    effort: str = "torque",
) -> str:
    """Held-out error after each step as a falling staircase, with the noise floor on it.

    Parameters
    ----------
    values : sequence of float
        Relative error [%], the start model first.
    floor : float or None
        Error that measurement noise alone would leave [%].
    labels : sequence of str
        Under each tread, in up to `LABEL_LINES` lines; "start", "1", "2" ... by default.
    width : int
    effort : str
        What was measured: "force" of a linear axis.
    """
    names = list(labels) or ["start", *(str(i) for i in range(1, len(values)))]
    top = max([*values, floor or 0.0, 1e-9]) * 1.18
    room = max(4, int((width - LEFT - RIGHT) / len(values) / LETTER))
    wrapped = [_wrapped(n, room) for n in names]
    height = HEIGHT + LINE * (max(map(len, wrapped)) - 1)
    frame = Frame(
        (0.0, float(len(values))),
        (0.0, top),
        height=height,
        bottom=height - HEIGHT + BOTTOM,
        width=width,
    )
    body = axes(
        frame,
        "step",
        f"error on held-out records [% of the measured {effort}, referred to the link]"
        if width > WIDTH
        else "held-out error [%], referred to the link",
        x_ticks=False,
    )
    base = height - frame.bottom
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
    line_at = frame.up(floor) if floor is not None else None
    under = [  # the line of the noise would run through these figures: they stand below their tread
        line_at is not None and y - 18 < line_at < y - 1 and y + 14 <= base - 2
        for _, _, y in treads
    ]
    for (a, b, y), v, lines, low in zip(treads, values, wrapped, under, strict=True):
        body += word((a + b) / 2, y + 13 if low else y - 5, f"{number(v, 3)} %")
        body += "".join(
            word((a + b) / 2, base + 15 + LINE * k, said) for k, said in enumerate(lines)
        )
    if floor is not None:
        y = frame.up(floor)
        body += (
            f'<path class="s-ink" stroke="{INK}" stroke-dasharray="2 3" d="M{LEFT} '
            f'{y:.1f}H{width - RIGHT}"/>'
        )
        below = y + 12 <= base - 2 and not under[0]  # else they would stand in other words
        at = y + 12 if below else y - 4
        body += word(LEFT + 4, at, f"noise alone: {number(floor, 2)} %", "start")
    fall = " to ".join(f"{number(v, 3)} %" for v in values)
    noise = f"; measurement noise alone leaves {number(floor, 3)} %" if floor is not None else ""
    return svg(f"Held-out error, step by step: {fall}{noise}", body, height, width)


def staircase_csv(values: Sequence[float], floor: float | None, labels: Sequence[str]) -> str:
    """The staircase as a table."""
    rows = [f'"{n}",{v:.9g}' for n, v in zip(labels, values, strict=True)]
    rows += [f'"noise alone",{floor:.9g}'] if floor is not None else []
    return "\n".join(["step,held-out error [%]", *rows]) + "\n"


def _wrapped(text: str, room: int) -> list[str]:
    lines = textwrap.wrap(text, room, break_long_words=True) or [""]
    if len(lines) > LABEL_LINES:
        lines = [*lines[: LABEL_LINES - 1], lines[LABEL_LINES - 1][: room - 1] + "…"]
    return lines


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
    body = axes(
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
            body += word(frame.across(column) + 9, y, str(dots[k].number), "start")
    least = min(d.error for d in dots)
    return svg(
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
    body = axes(frame, "real part", "imaginary part")
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
    return svg(f"Poles of {title}, upper half: {said or 'none'}", body)


def _ellipse(one: Pole, frame: Frame) -> str:
    if not np.isfinite(one.covariance).all():
        return ""
    size, main = np.linalg.eigh(one.covariance)
    turn = np.linspace(0.0, 2.0 * math.pi, 37)
    round_ = 2.0 * np.sqrt(np.maximum(size, 0.0))[:, None] * np.array([np.cos(turn), np.sin(turn)])
    path = "L".join(
        f"{frame.across(one.value.real + float(a)):.1f} {frame.up(one.value.imag + float(b)):.1f}"
        for a, b in (main @ round_).T
    )
    return (
        f'<path class="s-after band" fill="{AFTER}" fill-opacity="0.22" stroke="none" '
        f'd="M{path}z"/>'
    )


def bar(share: float, label: str) -> str:
    """A bar from 0 to 100 %; a share below 0 is drawn as 0."""
    width = 80 * min(max(share / 100, 0.0), 1.0) if math.isfinite(share) else 0.0
    body = (
        f'<rect class="s-rest" fill="{GRID}" fill-opacity="0.5" width="80" height="10"/>'
        f'<rect class="s-after" fill="{AFTER}" width="{width:.1f}" height="10"/>'
    )
    return svg(label, body, 10, 80, "bar")
