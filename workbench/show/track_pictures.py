"""Pictures of a replay: faults along time, a reading as it came and as it was reconstructed, a
parameter with its band.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.data.formats import number, pretty_unit
from identification.faults.detector import SENSORS
from workbench.show.chart import AFTER, BEFORE, GRID, INK, svg, ticks
from workbench.show.plots import decimated
from workbench.show.replayed import READINGS, Replay
from workbench.show.results import text

FloatArray = npt.NDArray[np.float64]

WIDTH: Final = 860
NARROW: Final = 420
LEFT: Final = 118
RIGHT: Final = 14
TOP: Final = 10
BOTTOM: Final = 38
LANE: Final = 24
CURVE_POINTS: Final = 1200
SIGMAS: Final = 2.0


@final
@dataclass(frozen=True)
class Axes:
    """A picture's linear map from time and value to its coordinates."""

    x: tuple[float, float]
    y: tuple[float, float]
    width: int
    height: int
    left: int = 70

    def across(self, value: float) -> float:
        """Horizontal coordinate of a time, kept inside the frame."""
        low, high = self.x
        return self.left + min(max((value - low) / (high - low), 0.0), 1.0) * (
            self.width - self.left - RIGHT
        )

    def up(self, value: float) -> float:
        """Vertical coordinate of a value, kept inside the frame."""
        low, high = self.y
        return TOP + (1 - min(max((value - low) / (high - low), 0.0), 1.0)) * (
            self.height - TOP - BOTTOM
        )

    def time_axis(self) -> str:
        """Ticks and title of the time axis."""
        base = self.height - BOTTOM
        out = [
            f'<path class="s-grid" stroke="{GRID}" fill="none" d="M{self.left} '
            f'{base}H{self.width - RIGHT}"/>'
        ]
        for t in ticks(*self.x, 8 if self.width > NARROW else 5):
            x = self.across(t)
            out.append(
                f'<path class="s-grid" stroke="{GRID}" d="M{x:.1f} {base}v4"/>'
                + _word(min(x, self.width - RIGHT - 6), base + 16, number(t, 5))
            )
        out.append(_word((self.left + self.width - RIGHT) / 2, self.height - 5, "time [s]"))
        return "".join(out)

    def value_axis(self, title: str) -> str:
        """Ticks and title of the value axis."""
        out = []
        for t in ticks(*self.y, 4):
            y = self.up(t)
            out.append(
                f'<path class="s-grid" stroke="{GRID}" stroke-width="0.6" d="M{self.left} '
                f'{y:.1f}H{self.width - RIGHT}"/>'
            )
            out.append(_word(self.left - 5, y + 4, number(t, 4), "end"))
        middle = (TOP + self.height - BOTTOM) / 2
        out.append(_word(11, middle, title, "middle", f' transform="rotate(-90 11 {middle:.1f})"'))
        return "".join(out)

    def line(
        self, time: FloatArray, value: FloatArray, kind: str, colour: str, extra: str = ""
    ) -> str:
        """A curve; NaN interrupts it."""
        parts, pen = [], "M"
        for t, v in zip(time.tolist(), value.tolist(), strict=True):
            if math.isfinite(v):
                parts.append(f"{pen}{self.across(t):.1f} {self.up(v):.1f}")
                pen = "L"
            else:
                pen = "M"
        return (
            f'<path class="s-{kind}" fill="none" stroke="{colour}"{extra} d="{"".join(parts)}"/>'
            if parts
            else ""
        )

    def shade(self, spans: Iterable[tuple[float, float]]) -> str:
        """Times in which a reading is replaced."""
        return "".join(
            f'<rect class="s-shade" fill="{BEFORE}" fill-opacity="0.1" x="{self.across(a):.1f}" '
            f'y="{TOP}" '
            f'width="{max(self.across(b) - self.across(a), 1.0):.1f}" '
            f'height="{self.height - TOP - BOTTOM}"/>'
            for a, b in spans
            if b > self.x[0] and a < self.x[1]
        )


def _word(x: float, y: float, content: str, anchor: str = "middle", extra: str = "") -> str:
    return (
        f'<text class="s-ink" fill="{INK}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" '
        f'font-size="11"{extra}>{text(content)}</text>'
    )


def _svg(label: str, body: str, width: int, height: int) -> str:
    return svg(label, body, height, width, "track" if width > NARROW else "track narrow")


def _reach(values: Sequence[FloatArray]) -> tuple[float, float]:
    """Range of the finite values with some room; wild single values do not flatten the rest."""
    whole = np.concatenate([v[np.isfinite(v)] for v in values])
    if not len(whole):
        return -1.0, 1.0
    low, high = float(whole.min()), float(whole.max())
    room = 0.06 * (high - low) or max(abs(high), 1.0) * 0.05
    return low - room, high + room


def timeline_picture(replay: Replay) -> str:
    """One lane per reading: where a fault was put in, where the reading is replaced, and every
    report as a mark.
    """
    time = replay.record.time
    lanes = [i for i, there in enumerate(replay.estimator.present) if there]
    height = TOP + LANE * (len(lanes) + 1) + BOTTOM
    axes = Axes((float(time[0]), float(time[-1])), (0.0, 1.0), WIDTH, height, LEFT)
    body = axes.time_axis()
    first = float(time[0])
    said = []
    for row, i in enumerate([*lanes, -1]):
        y = TOP + LANE * row
        name = "the joint itself" if i < 0 else READINGS[i]
        body += (
            _word(LEFT - 8, y + 16, name, "end")
            + f'<path class="s-grid" stroke="{GRID}" stroke-width="0.6" d="M{LEFT} '
            f'{y + LANE}H{WIDTH - RIGHT}"/>'
        )
        for a, b in replay.spans(i) if i >= 0 else []:
            body += _bar(
                axes,
                y + 4,
                a=a,
                b=b,
                kind="bad",
                colour=BEFORE,
                title=f"{name}: replaced from {a:.3f} s to {b:.3f} s",
                height=LANE - 12,
            )
            said.append(f"{name} replaced from {a:.2f} s to {b:.2f} s")
        for fault in replay.tried:
            if i >= 0 and fault.sensor == SENSORS[i]:
                end = min(first + fault.end, float(time[-1]))
                body += _bar(
                    axes,
                    y + LANE - 7,
                    a=first + fault.start,
                    b=end,
                    kind="ink",
                    colour=INK,
                    title=f"put in: {fault.kind} from {first + fault.start:.3f} s",
                    height=3,
                )
        for event in replay.events:
            if _lane_of(int(event["fault"])) == i:
                x, title = (
                    axes.across(event["time"]),
                    f"<title>{text(event['text'])}, {event['time']:.3f} s</title>",
                )
                body += (
                    f'<path class="s-before dot" fill="{BEFORE}" d="M{x:.1f} {y + 3}l5 '
                    f'-3h-10z">{title}</path>'
                    f'<path class="s-before" stroke="{BEFORE}" d="M{x:.1f} {y}v{LANE}"/>'
                )
    return _svg("Faults along time: " + ("; ".join(said) or "none"), body, WIDTH, height)


def _bar(
    axes: Axes, y: float, a: float, b: float, kind: str, colour: str, title: str, height: float
) -> str:
    x = axes.across(a)
    return (
        f'<rect class="s-{kind}" fill="{colour}" x="{x:.1f}" y="{y:.1f}" '
        f'width="{max(axes.across(b) - x, 1.5):.1f}" height="{height}">'
        f"<title>{text(title)}</title></rect>"
    )


def _lane_of(code: int) -> int:
    """Reading that a fault code is about; -1 for the joint itself, the current for the pair it
    cannot be told from.
    """
    if code in (8, 9):
        return -1
    return 0 if code == 7 else code % 10 - 1


def signal_picture(replay: Replay, reading: int, window: tuple[float, float], width: int) -> str:
    """A reading as it came, as the estimator went on with it, and as it was before a fault was
    put in.
    """
    time = replay.record.time
    inside = (time >= window[0]) & (time <= window[1])
    came, went, was = (t[inside, reading] for t in (replay.readings, replay.used, replay.healthy))
    stamps, (came, went, was) = decimated(
        time[inside], [came, went, was], CURVE_POINTS if width > NARROW else CURVE_POINTS // 2
    )
    tried = any(f.sensor == SENSORS[reading] for f in replay.tried)
    height = 240 if width > NARROW else 220
    axes = Axes((window[0], window[1]), _scale(came, went), width, height)
    unit = unit_of(replay, reading)
    body = (
        axes.shade(replay.spans(reading))
        + axes.time_axis()
        + axes.value_axis(f"{READINGS[reading]} [{unit}]")
    )
    if tried:
        body += axes.line(stamps, was, "true", INK, ' stroke-width="4" stroke-opacity="0.35"')
    body += axes.line(stamps, came, "before", BEFORE, ' stroke-width="1"')
    body += axes.line(stamps, went, "after", AFTER, ' stroke-width="1.6"')
    return _svg(
        f"{READINGS[reading]} as measured and as reconstructed, {window[0]:.2f} s to "
        f"{window[1]:.2f} s",
        body,
        width,
        height,
    )


def _scale(came: FloatArray, went: FloatArray) -> tuple[float, float]:
    """The reconstructed reading fills the picture; a faulty one may leave it."""
    low, high = _reach([went])
    room = 0.5 * (high - low)
    finite = came[np.isfinite(came)]
    if not len(finite):
        return low, high
    return max(min(low, float(finite.min())), low - room), min(
        max(high, float(finite.max())), high + room
    )


def unit_of(replay: Replay, reading: int) -> str:
    """Unit of a reading, link-referred, as it is shown."""
    linear = replay.record.kind == "linear"
    return pretty_unit(
        (
            ("N", "m", "m/s", "m", "m/s", "N")
            if linear
            else ("N.m", "rad", "rad/s", "rad", "rad/s", "N.m")
        )[reading]
    )


def parameter_picture(replay: Replay, index: int, known: float | None) -> str:
    """Course of one parameter with two standard deviations to either side, and the value of the
    joint file.
    """
    parameter = {p.name: p for p in replay.estimator.model.parameters}[
        replay.estimator.names[index]
    ]
    time, value, sigma = replay.time, replay.values[:, index], replay.sigmas[:, index]
    low, high = value - SIGMAS * sigma, value + SIGMAS * sigma
    shown = [value, *_quantiles(low, high), *([np.array([known])] if known is not None else [])]
    span = _reach(shown)
    axes = Axes((float(time[0]), float(replay.record.time[-1])), span, NARROW, 200)
    body = (
        axes.shade(replay.spans())
        + axes.time_axis()
        + axes.value_axis(f"[{pretty_unit(parameter.unit)}]")
    )
    for part in _stretches(replay):
        t, a, b = time[part], low[part], high[part]
        if len(t) > 1:
            there = [
                f"{axes.across(x):.1f} {axes.up(y):.1f}"
                for x, y in zip(t.tolist(), b.tolist(), strict=True)
            ]
            back = [
                f"{axes.across(x):.1f} {axes.up(y):.1f}"
                for x, y in zip(t.tolist()[::-1], a.tolist()[::-1], strict=True)
            ]
            body += (
                f'<path class="s-after band" fill="{AFTER}" fill-opacity="0.22" '
                f'stroke="none" d="M{"L".join(there + back)}Z"/>'
            )
        body += axes.line(t, value[part], "after", AFTER, ' stroke-width="1.6"')
    if known is not None:
        y = axes.up(known)
        body += (
            f'<path class="s-known" stroke="{INK}" stroke-dasharray="2 3" d="M{axes.left} '
            f'{y:.1f}H{NARROW - RIGHT}"/>'
        )
    return _svg(
        f"{parameter.name}: from {number(value[0], 4)} to {number(value[-1], 4)} {parameter.unit}",
        body,
        NARROW,
        200,
    )


def _quantiles(low: FloatArray, high: FloatArray) -> list[FloatArray]:
    """Where the band lies most of the time: its begin and the moment after a fault may be wide."""
    return [np.quantile(low, [0.02, 0.1]), np.quantile(high, [0.9, 0.98])]


def _stretches(replay: Replay) -> list[slice]:
    """Parts of the course between gaps of the record: the estimator starts anew after each."""
    stamps = replay.record.time
    breaks = [float(stamps[p.start]) for p in replay.record.segments()] + [math.inf]
    return [
        slice(int(np.searchsorted(replay.time, a)), int(np.searchsorted(replay.time, b)))
        for a, b in pairwise(breaks)
    ]
