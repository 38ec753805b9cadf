"""Bode plots as SVG text: measured response with its coherence, subspace model and physical model.

Colours and classes are those of `workbench.show.pictures`; the three are told apart by shape too:
dots, a dashed line, a full line.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.data.formats import number, pretty_unit
from identification.linear.frequency import PHYSICAL, Bode
from identification.linear.spectra import SHOWN_COHERENCE, TRUSTED_COHERENCE, Curve, Response
from workbench.show.chart import AFTER, BEFORE, GRID, INK, LEFT, RIGHT, WIDTH, svg, ticks
from workbench.show.results import table, text

FloatArray = npt.NDArray[np.float64]

PANELS: Final = ((8, 150), (172, 264), (286, 336))
"""Top and bottom of magnitude, phase and coherence."""
HEIGHT: Final = 376
TABLE_ROWS: Final = 14


@final
@dataclass(frozen=True)
class _Panel:
    """Logarithmic frequency across, a linear quantity up."""

    low: float
    high: float
    bottom_value: float
    top_value: float
    top: int
    bottom: int

    def across(self, frequency: float) -> float:
        share = math.log(frequency / self.low) / math.log(self.high / self.low)
        return LEFT + share * (WIDTH - LEFT - RIGHT)

    def up(self, value: float) -> float:
        share = (value - self.bottom_value) / (self.top_value - self.bottom_value)
        return self.top + (1 - min(max(share, 0.0), 1.0)) * (self.bottom - self.top)

    def line(self, x: FloatArray, y: FloatArray) -> str:
        """Path data through points."""
        return "M" + "L".join(
            f"{self.across(float(a)):.1f} {self.up(float(b)):.1f}"
            for a, b in zip(x, y, strict=True)
        )


def _label(x: float, y: float, said: str, anchor: str = "middle", extra: str = "") -> str:
    return (
        f'<text class="s-ink" fill="{INK}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" '
        f'font-size="11"{extra}>{html.escape(said)}</text>'
    )


def frequency_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten inside a range; only powers of ten where it is wide."""
    steps = (1.0,) if math.log10(high / low) > 2.5 else (1.0, 2.0, 5.0)
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [
        m * 10.0**p for p in powers for m in steps if low * 0.999 <= m * 10.0**p <= high * 1.001
    ]


def _axes(panel: _Panel, values: Sequence[float], said: str, *, numbered: bool) -> str:
    out = [
        f'<path class="s-grid" stroke="{GRID}" fill="none" d="M{LEFT} '
        f'{panel.top}V{panel.bottom}H{WIDTH - RIGHT}"/>'
    ]
    for v in values:
        y = panel.up(v)
        out.append(
            f'<path class="s-grid" stroke="{GRID}" stroke-width="0.6" d="M{LEFT} '
            f'{y:.1f}H{WIDTH - RIGHT}"/>'
        )
        out.append(_label(LEFT - 5, y + 4, number(v, 4), "end"))
    for f in frequency_ticks(panel.low, panel.high):
        x = panel.across(f)
        out.append(
            f'<path class="s-grid" stroke="{GRID}" stroke-width="0.6" d="M{x:.1f} '
            f'{panel.top}V{panel.bottom}"/>'
        )
        if numbered:
            out.append(_label(min(x, WIDTH - 14), panel.bottom + 14, number(f, 3)))
    middle = (panel.top + panel.bottom) / 2
    out.append(_label(11, middle, said, "middle", f' transform="rotate(-90 11 {middle:.1f})"'))
    return "".join(out)


def _curve(panel: _Panel, curve: Curve, y: FloatArray) -> str:
    kind, colour, dash = (
        ("after", AFTER, "")
        if curve.name == PHYSICAL
        else ("before", BEFORE, ' stroke-dasharray="6 3"')
    )
    return (
        f'<path class="s-{kind}" fill="none" stroke="{colour}" stroke-width="1.8"{dash} '
        f'd="{panel.line(curve.frequency, y)}"/>'
    )


def _dots(panel: _Panel, x: FloatArray, y: FloatArray, sure: npt.NDArray[np.bool_]) -> str:
    out = []
    for a, b, filled in zip(x, y, sure, strict=True):
        left, level = panel.across(float(a)), panel.up(float(b))
        if filled:
            out.append(
                f'<circle class="s-ink" fill="{INK}" cx="{left:.1f}" cy="{level:.1f}" r="2.3"/>'
            )
        else:
            ring = f"M{left - 2.3:.1f} {level:.1f}a2.3 2.3 0 1 0 4.6 0a2.3 2.3 0 1 0 -4.6 0"
            out.append(
                f'<path class="s-ink" fill="none" stroke="{INK}" stroke-width="0.9" d="{ring}"/>'
            )
    return "".join(out)


def decibels(response: npt.NDArray[np.complex128]) -> FloatArray:
    """Magnitude in dB."""
    size: FloatArray = 20.0 * np.log10(np.maximum(np.abs(response), 1e-300))
    return size


def _phases(one: Response) -> tuple[FloatArray, list[FloatArray]]:
    """Measured phase and those of the curves [degrees], in the same turn, unwrapped along the
    first curve.
    """
    curves = [np.degrees(np.unwrap(np.angle(c.response))) for c in one.curves]
    plain = np.degrees(np.angle(one.response))
    if not curves:
        return np.degrees(np.unwrap(np.angle(one.response))), []
    lead = one.curves[-1].frequency, curves[-1] - 360.0 * round(float(curves[-1][0]) / 360.0)
    aligned = [
        p - 360.0 * np.round((p - np.interp(c.frequency, *lead)) / 360.0)
        for c, p in zip(one.curves, curves, strict=True)
    ]
    return plain - 360.0 * np.round((plain - np.interp(one.frequency, *lead)) / 360.0), aligned


def bode_picture(one: Response) -> str:
    """Magnitude, phase and coherence over the frequency, an ``svg`` element.

    Parameters
    ----------
    one : Response
        With its curves.
    """
    shown = one.coherence >= SHOWN_COHERENCE
    f, sure = one.frequency[shown], one.trusted[shown]
    size, (phase, phases) = decibels(one.response)[shown], _phases(one)
    phase = phase[shown]
    sizes = [decibels(c.response) for c in one.curves]
    low, high = float(f.min()) / 1.06, float(f.max()) * 1.06
    every, turns = np.concatenate([size, *sizes]), np.concatenate([phase, *phases])
    upper = _Panel(low, high, float(every.min()) - 2.0, float(every.max()) + 2.0, *PANELS[0])
    middle = _Panel(low, high, float(turns.min()) - 10.0, float(turns.max()) + 10.0, *PANELS[1])
    lower = _Panel(low, high, 0.0, 1.0, *PANELS[2])
    body = _axes(
        upper, ticks(upper.bottom_value, upper.top_value, 5), "magnitude [dB]", numbered=False
    )
    body += _axes(middle, _turn_ticks(middle), "phase [°]", numbered=False)
    body += _axes(lower, [0.0, 0.5, 1.0], "coherence", numbered=True)
    # full line below, dashed line above: both stay visible where they agree
    order = sorted(range(len(one.curves)), key=lambda k: one.curves[k].name != PHYSICAL)
    body += "".join(_curve(upper, one.curves[k], sizes[k]) for k in order)
    body += "".join(_curve(middle, one.curves[k], phases[k]) for k in order)
    body += _bars(upper, one, shown) + _dots(upper, f, size, sure) + _dots(middle, f, phase, sure)
    inside = (one.frequency >= low) & (one.frequency <= high)
    body += (
        f'<path class="s-ink" fill="none" stroke="{INK}" '
        f'd="{lower.line(one.frequency[inside], one.coherence[inside])}"/>'
    )
    body += (
        f'<path class="s-ink" stroke="{INK}" stroke-dasharray="2 3" d="M{LEFT} '
        f'{lower.up(TRUSTED_COHERENCE):.1f}H{WIDTH - RIGHT}"/>'
    )
    body += _label((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 6, "frequency [Hz]")
    said = (
        f"Bode plot from {one.title}, {number(low, 2)} to {number(high, 2)} Hz. "
        f"{' '.join(sentences(one))}"
    )
    return svg(said, body, HEIGHT)


def _bars(panel: _Panel, one: Response, shown: npt.NDArray[np.bool_]) -> str:
    """Two standard deviations either way."""
    out = []
    for f, size, spread in zip(
        one.frequency[shown], np.abs(one.response)[shown], one.deviation[shown], strict=True
    ):
        x = panel.across(float(f))
        top, bottom = (
            panel.up(20.0 * math.log10(max(float(size * (1 + s * 2 * spread)), 1e-300)))
            for s in (1, -1)
        )
        out.append(f"M{x:.1f} {top:.1f}V{bottom:.1f}")
    return f'<path class="s-ink" fill="none" stroke="{INK}" stroke-width="0.9" d="{"".join(out)}"/>'


def _turn_ticks(panel: _Panel) -> list[float]:
    span = panel.top_value - panel.bottom_value
    step = next((s for s in (10.0, 30.0, 45.0, 90.0, 180.0) if span / s <= 5), 360.0)
    return [
        step * k
        for k in range(math.ceil(panel.bottom_value / step), math.floor(panel.top_value / step) + 1)
    ]


def sentences(one: Response) -> list[str]:
    """How far the models are from the measurement and where they resonate."""
    out = []
    for c in one.curves:
        if math.isfinite(c.gap_db):
            out.append(
                f"The {c.name} is {number(c.gap_db, 2)} dB and {number(c.gap_degrees, 2)}° from "
                "the measurement (median, trusted bands)."
            )
        if c.resonances:
            peaks = ", ".join(
                f"{number(r.frequency, 3)} Hz (damping {number(r.damping, 2)})"
                for r in c.resonances
            )
            out.append(
                f"It resonates at {peaks}."
                if math.isfinite(c.gap_db)
                else f"The {c.name} resonates at {peaks}."
            )
    return out


def _values(one: Response) -> str:
    """The same as a table, for readers who do not see the picture."""
    rows = np.flatnonzero(one.coherence >= SHOWN_COHERENCE)
    rows = rows[
        np.unique(np.linspace(0, len(rows) - 1, min(TABLE_ROWS, len(rows))).round().astype(int))
    ]
    measured, phases = _phases(one)
    head = ["frequency", "coherence", "measured", *(text(c.name) for c in one.curves)]
    body = []
    for k in rows:
        f = float(one.frequency[k])
        cells = [
            f"{number(f, 3)} Hz",
            number(float(one.coherence[k]), 2),
            _pair(float(decibels(one.response)[k]), float(measured[k])),
        ]
        for c, p in zip(one.curves, phases, strict=True):
            size = float(np.interp(f, c.frequency, decibels(c.response)))
            cells.append(
                _pair(size, float(np.interp(f, c.frequency, p)))
                if f <= c.frequency[-1] * 1.001
                else "–"
            )
        body.append(cells)
    return (
        "<details><summary>Values</summary>"
        f"{table(head, body, f'{text(one.title)}: magnitude and phase')}</details>"
    )


def _pair(size: float, phase: float) -> str:
    return f"{number(round(size, 1))} dB, {number(round(phase))}°"


def bode_html(found: Bode) -> str:
    """Pictures with legend, captions, values and notes."""
    kinds = {c.name for one in found.responses for c in one.curves}
    physical = (
        '<span class="key after">— physical model, linearised along the motion</span> '
        if PHYSICAL in kinds
        else ""
    )
    subspace = (
        '<span class="key before">- - subspace model (MOESP), no physics</span> '
        if kinds - {PHYSICAL}
        else ""
    )
    legend = (
        '<p class="legend"><span class="key">● measured (bar: two standard deviations; ○ '
        f"coherence under {TRUSTED_COHERENCE:g})</span> "
        f"{physical}{subspace}</p>"
    )
    figures = []
    for one in found.responses:
        how = (
            "with the reference position as instrument"
            if one.instrument
            else "cross spectrum over input spectrum"
        )
        said = " ".join(text(s) for s in sentences(one))
        zero = "" if one.unit == "1" else f" 0 dB is 1 {pretty_unit(one.unit)}."
        figures.append(
            f"<figure>{bode_picture(one)}<figcaption><strong>"
            f"{text(one.title[0].upper() + one.title[1:])}</strong>: {how}, "
            f"{one.windows} windows of "
            f"{number(one.window, 2)} s.{zero} {said}</figcaption>{_values(one)}</figure>"
        )
    notes = "".join(f"<p class='note'>{text(n)}</p>" for n in found.notes)
    return f"<div>{legend}<div class='grid'>{''.join(figures)}</div>{notes}</div>"
