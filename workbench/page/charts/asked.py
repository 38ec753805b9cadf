"""What the plots of the page ask for: laws through the residual, curves as such, signals against
signals, the stretches of time behind a piece of a curve, and what a slider does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from identification.balance.dataset import without
from identification.data.channels import DECLARED
from identification.data.plain_text import from_json
from identification.data.record import Record
from identification.diagnosis.places import Place, place, places_of
from identification.errors import InputError
from identification.fitting.assess import relative_error_percent
from identification.fitting.engine import references
from workbench.page.analysis import Analysis
from workbench.page.charts.choices import limits_of, within
from workbench.page.charts.learned import curve_chart, shown_residual
from workbench.page.desk.curves import learned_of, story_of
from workbench.page.desk.shape import nearest
from workbench.page.jobs.place import hint_for
from workbench.page.live import Live
from workbench.page.records import MOST_RUNS, plot_time
from workbench.page.session import StepEntry
from workbench.show.chart import WIDTH, Chart, Curve, Label, Style
from workbench.show.pictures import (
    AT_THE_LINK,
    AT_THE_MOTOR,
    axis_label,
    place_chart,
    staircase_csv,
    staircase_picture,
    torque_label,
)
from workbench.show.plots import decimated, explained, step_place
from workbench.show.results import effort_of, floor_percent
from workbench.show.words import CURVES, GLOSSARY, OUTCOME_WORDS, title_of

Query = Mapping[str, Any]
FloatArray = npt.NDArray[np.float64]

DOTS: Final = 1500
"""Samples of a record in a picture of one signal against another."""
SHADES: Final[tuple[Style, ...]] = ("after", "law", "ink", "before")
"""Quarters of a third signal, the lowest first."""
RUN: Final = "time_in_run"
SPANS: Final = 400
"""Stretches of time that a brushed piece of a curve is marked with at most."""
SEEN: Final = 1e-4
"""Share of the largest change of squares under which a balance has not moved for the eye: 1 % of
its size."""
MOVING_PLACES: Final = 2
"""Balances whose residual is drawn while a parameter moves."""
SIDES: Final[Mapping[str, str]] = {
    "motor": AT_THE_MOTOR,
    "link": AT_THE_LINK,
    "gear": "at the gear",
    "none": "",
}


def _number(query: Query, key: str) -> float:
    try:
        value = float(query.get(key, ""))
    except ValueError:
        raise InputError(f"{key} must be a number") from None
    if not math.isfinite(value):
        raise InputError(f"{key} must be a finite number")
    return value


def width_of(query: Query, key: str = "width") -> int:
    """The width of a picture that a page asks for: as wide as it draws it, so that its letters are
    as large as those of the page.

    Raises
    ------
    InputError
        No number.
    """
    try:
        return min(max(int(float(query.get(key, WIDTH))), 280), 1200)
    except (ValueError, OverflowError):
        raise InputError(f"{key} must be a number") from None


# --- the staircase and the place that told --------------------------------------------------------


def step_title(step: StepEntry) -> str:
    """What a step did; a set of names stays a set."""
    if step.action == "start":
        return "start model"
    names = " or ".join(title_of(n) for n in step.names) if len(step.names) > 1 else ""
    return f"{'−' if step.action == 'remove' else '+'} {names or title_of(step.label or '')}"


def _staircase(live: Live, query: Query) -> dict[str, Any]:
    """The falling staircase with its noise floor, and the place that told of the last addition."""
    steps = live.state.steps
    if not steps:
        raise InputError("no fit yet: press Fit first")
    values = [float(s.held_out["relative_error_percent"]) for s in steps]
    names, floor = [step_title(s) for s in steps], floor_percent(steps[-1].held_out)
    curved = story_of(live.state).get("with_curves")
    if curved:
        values.append(float(curved["held_out"]["relative_error_percent"]))
        names.append(f"+ {CURVES}")
    out: dict[str, Any] = {
        "names": names,
        "floor": floor,
        "stairs": {
            "svg": staircase_picture(
                values, floor, names, width_of(query), effort_of(steps[-1].held_out)
            ),
            "csv": staircase_csv(values, floor, names),
            "frame": None,
        },
        "told": None,
    }
    last = next((k for k in range(len(steps) - 1, 0, -1) if steps[k].action == "add"), None)
    if last is not None:
        analysis = live.analysis()
        told = _told(analysis, steps[last - 1], steps[last], names[last])
        out["told"] = _as_wide(told, query, "whole")
    return out


def _told(analysis: Analysis, before: StepEntry, after: StepEntry, name: str) -> dict[str, Any]:
    one, two = (_shown(analysis, s) for s in (before, after))
    fall = {b: float(np.nansum(one[b] ** 2) - np.nansum(two[b] ** 2)) for b in one if b in two}
    balance = max(fall, key=lambda b: fall[b])
    step = step_place(analysis.rows, name, balance, one, two)
    chart = place_chart(step.before, step.after, law=explained(step.before, step.after))
    return {"name": name, "balance": balance, "chart": chart}


def _shown(analysis: Analysis, step: StepEntry) -> dict[str, FloatArray]:
    made = analysis.solution_of(step)
    return shown_residual(analysis, made.model, made.values)


# --- laws through the residual --------------------------------------------------------------------


def _is_stale(live: Live, query: Query) -> bool:
    """Whether a page asks about a step that it has not heard the end of yet, or that is being
    fitted again: no error, the answer is not wanted any more.
    """
    asked = str(query.get("step", ""))
    if not asked:
        return False
    return asked not in {s.id for s in live.state.steps[-1:]} or live.analysis().solution is None


def _law(live: Live, query: Query) -> dict[str, Any]:
    """A candidate's law, or a learned curve, drawn through the residual of the model as it
    stands.
    """
    if _is_stale(live, query):
        return {"stale": True}
    label, analysis = str(query.get("label", "")), live.analysis()
    mark = (label, len(live.state.steps), live.state.steps[-1].label if live.state.steps else "")
    kept = live.kept.get(f"law {label}")
    if kept is not None and kept[0] == (mark, id(analysis.current)):
        return _as_wide(kept[1], query)
    for story in (live.state.improvement, live.state.diagnosis):
        curve = learned_of(story, label)
        if story is not None and curve is not None:
            chart, drawn = curve_chart(analysis, story, curve)
            found = {"label": label, "title": title_of(label), "balance": curve["balance"]}
            found |= {"chart": chart, "drawn": drawn}
            live.kept[f"law {label}"] = ((mark, id(analysis.current)), found)
            return _as_wide(found, query)
    before = shown_residual(analysis, analysis.current.model, analysis.current.values)
    made = analysis.with_candidate(label, hint_for(live.state, label))
    after = shown_residual(analysis, made.model, made.values)
    row = hint_for(live.state, label)
    balance = str(row["balance"]) if row else max(before, key=lambda b: float(np.nanstd(before[b])))
    step = step_place(analysis.rows, label, balance, before, after)
    law = explained(step.before, step.after)
    chart = place_chart(step.before, law=law)
    found = {"label": label, "title": title_of(label), "balance": balance, "chart": chart}
    live.kept[f"law {label}"] = ((mark, id(analysis.current)), found)
    return _as_wide(found, query)


def _as_wide(found: Mapping[str, Any], query: Query, key: str = "width") -> dict[str, Any]:
    """What was found, with its chart as wide as this page draws it."""
    return {**found, "chart": replace(found["chart"], width=width_of(query, key)).as_json()}


def _shape(live: Live, query: Query) -> dict[str, Any]:
    """A learned curve as a law in one line, for the field in which a law is typed."""
    for story in (live.state.improvement, live.state.diagnosis):
        claim = learned_of(story, str(query.get("label", "")))
        if claim is not None:
            return nearest(claim)
    raise InputError("law: there is no such curve any more; diagnose again")


# --- curves as such -------------------------------------------------------------------------------


def _as_such(live: Live, query: Query) -> list[dict[str, Any]]:
    """Friction over velocity, torque over twist, torque over the motor angle: as measured, and as
    the model has it.
    """
    analysis = live.analysis()
    now, rows = analysis.current, analysis.rows
    residual = shown_residual(analysis, now.model, now.values)
    out: list[dict[str, Any]] = []

    def put(title: str, quantity: str, measured: Place, model: Place) -> None:
        curves = _pairs(measured, model)
        chart = Chart(
            f"{title}: measured and modelled, {measured.balance} balance",
            axis_label(measured.axis, measured.title, measured.unit),
            torque_label(f"{quantity}, {measured.balance} balance", measured.residual_unit),
            tuple(curves),
            width=width_of(query),
        )
        out.append({"title": title, "balance": measured.balance, "chart": chart.as_json()})

    error = live.state.steps[-1].held_out
    effort = effort_of(error)
    floors = {b: float(e["floor"]) for b, e in error["balances"].items()}
    for balance, left in residual.items():
        friction = _own(analysis, lambda t: t.effect.family == "friction", balance)
        if friction is not None and float(np.sqrt(np.nanmean(friction**2))) <= floors[balance]:
            friction = None  # less than the noise: not of this balance
        if friction is not None and "motor_velocity" in rows.axes:
            whole = place(rows, left + friction, balance, "motor_velocity")
            law = place(rows, friction, balance, "motor_velocity", like=whole)
            put("Friction curve", f"friction {effort}", whole, law)
        if balance == "transmission" and "torsion" in rows.axes:
            torque = references(analysis.data, analysis.data.held_out)[balance]
            torque = torque + 0.0 * left  # rows that take no part stay out
            whole = place(rows, torque, balance, "torsion")
            law = place(rows, torque - left, balance, "torsion", like=whole)
            put("Stiffness curve", "torque", whole, law)
        if balance in ("motor", "sum", "axis") and "motor_angle" in rows.axes:
            periodic = _own(analysis, lambda t: t.effect.periodic, balance)
            own = periodic if periodic is not None else np.zeros(len(left))
            whole = place(rows, left + own, balance, "motor_angle")
            law = place(rows, own + 0.0 * left, balance, "motor_angle", like=whole)
            put("Map over the motor angle", effort, whole, law)
    return out


def _pairs(measured: Place, model: Place) -> list[Curve]:
    out = []
    for b, m in zip(measured.branches, model.branches, strict=True):
        way = "" if b.direction == "both" else f", {b.direction}"
        dashed = b.direction == "backward"
        out.append(
            Curve(
                f"measured{way}",
                b.centre,
                b.mean,
                "before",
                low=b.low,
                high=b.high,
                marks="diamond",
                line=False,
            )
        )
        out.append(Curve(f"model{way}", m.centre, m.mean, "law", dashed=dashed))
    return out


def _own(analysis: Analysis, belongs: Callable[[Any], bool], balance: str) -> FloatArray | None:
    """What some of the model's laws add to a balance on the held-out rows; None where it has none
    there.
    """
    now = analysis.current
    labels = [t.label for t in now.model.terms if belongs(t)]
    model = now.model
    for label in labels:
        try:
            model = without(model, label)
        except (KeyError, ValueError):
            continue  # another law needs it
    if model is now.model or len(model.terms) == len(now.model.terms):
        return None
    bare = shown_residual(analysis, model, now.values)[balance]
    own: FloatArray = bare - shown_residual(analysis, now.model, now.values)[balance]
    return own if float(np.nanmax(np.abs(own), initial=0.0)) > 0 else None


# --- a piece of a curve in time -------------------------------------------------------------------


def _spans(live: Live, query: Query) -> list[list[float]]:
    """Stretches of time in which a signal lies between two values."""
    analysis = live.analysis()
    name = str(query.get("axis", ""))
    if name not in analysis.rows.axes:
        raise InputError(f"no signal {name} in these records")
    low, high = sorted((_number(query, "low"), _number(query, "high")))
    axis, time = analysis.rows.axes[name], analysis.rows.axes["time"].values
    inside = axis.use & (axis.values >= low) & (axis.values <= high)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    half = float(np.median(np.diff(time))) / 2 if len(time) > 1 else 0.0
    spans = [
        [float(time[a]) - half, float(time[b - 1]) + half]
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]
    return spans[:SPANS]


# --- any signal against any -----------------------------------------------------------------------


def _against(live: Live, query: Query) -> dict[str, Any]:
    """One signal over another, coloured by a third, or a second record over it; runs as runs."""
    x, y = str(query.get("x", RUN)), str(query.get("y", ""))
    colour, other = str(query.get("colour", "")), str(query.get("other", ""))
    first = live.record(str(query.get("file", "")))
    legend: list[str] = []
    curves: list[Curve] = []
    if x == RUN:
        for k, (name, record) in enumerate(_both(live, first, other)):
            curves += _runs(record, y, name, SHADES[3 * k % 4])
            legend.append(f"{'orange' if k else 'blue'}: {name}, {len(record.segments())} run(s)")
    elif other:
        for k, (name, record) in enumerate(_both(live, first, other)):
            a, b, _ = _thin(record, x, y, None)
            style = SHADES[3 * k % 4]
            curves.append(Curve(name, a, b, style, marks="dot", line=False))
            legend.append(f"{'orange' if k else 'blue'}: {name}")
    else:
        a, b, third = _thin(first, x, y, colour or None)
        if third is None:
            curves.append(Curve(first.name, a, b, "after", marks="dot", line=False))
        else:
            edges = np.nanquantile(third, [0.0, 0.25, 0.5, 0.75, 1.0])
            names = ("blue", "green", "grey", "orange")
            for k, (style, word) in enumerate(zip(SHADES, names, strict=True)):
                use = (third >= edges[k]) & (
                    (third <= edges[k + 1]) if k == 3 else (third < edges[k + 1])
                )
                said = f"{edges[k]:.3g} to {edges[k + 1]:.3g}"
                curves.append(Curve(said, a[use], b[use], style, marks="dot", line=False))
                legend.append(f"{word}: {said}")
            legend[0] = f"{_label(first, colour)}: {legend[0]}"
    across = Label("time since the start of the run", "s") if x == RUN else _label(first, x)
    chart = Chart(
        f"{y.replace('_', ' ')} of {first.name} against {str(across)}",
        across,
        _label(first, y),
        tuple(curves),
        zero=False,
        width=width_of(query),
        height=300,
    )
    return {"chart": chart.as_json(), "legend": legend}


def _both(live: Live, first: Record, other: str) -> list[tuple[str, Record]]:
    return [(first.name, first), *([(r.name, r)] if (r := _other(live, other)) else [])]


def _other(live: Live, other: str) -> Record | None:
    return live.record(other) if other else None


def _label(record: Record, channel: str) -> Label:
    if not record.has(channel):
        raise InputError(f"{record.name} has no channel {channel}")
    return Label(channel.replace("_", " "), record.unit(channel), side_of(channel))


def _thin(
    record: Record, x: str, y: str, third: str | None
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    for name in (x, y, *([third] if third else [])):
        if not record.has(name):
            raise InputError(f"{record.name} has no channel {name}")
    step = max(1, len(record) // DOTS)
    picked = slice(None, None, step)
    return record[x][picked], record[y][picked], record[third][picked] if third else None


def _runs(record: Record, channel: str, name: str, style: Style) -> list[Curve]:
    if not record.has(channel):
        raise InputError(f"{record.name} has no channel {channel}")
    parts = record.segments()
    out = []
    for k, part in enumerate(parts):
        time = record.time[part] - record.time[part.start]
        t, (v,) = decimated(time, [record[channel][part]], max(80, DOTS // len(parts)))
        out.append(Curve(f"{name}, run {k + 1}", t, v, style))
    return out


# --- sliders --------------------------------------------------------------------------------------


def _what_if(live: Live, query: Query) -> dict[str, Any]:
    """Held-out error and residual with other values of the parameters; nothing is changed."""
    if _is_stale(live, query):
        return {"stale": True}
    analysis = live.analysis()
    now = analysis.current
    given = from_json(str(query.get("values", "{}")).encode(), "the values")
    if not isinstance(given, dict):
        raise InputError("values must be a JSON object of numbers")
    unknown = sorted(set(given) - set(now.values))
    if unknown:
        raise InputError(f"the model has no parameter {unknown[0]}")
    try:
        moved = {k: float(v) for k, v in given.items()}
    except (TypeError, ValueError):
        raise InputError("values must be numbers") from None
    if not all(map(math.isfinite, moved.values())):
        raise InputError("values must be finite numbers")
    limits = limits_of(live)
    moved = {k: within(k, v, limits) for k, v in moved.items() if v != now.values[k]}
    values = {**now.values, **moved}
    data = analysis.data
    error = relative_error_percent(now.model, data, data.held_out, values)
    residual = shown_residual(analysis, now.model, values)
    charts = []
    for was, balance in _watched(live, analysis, residual, tuple(sorted(moved))):
        rows = analysis.rows
        here = place(rows, residual[balance], balance, was.axis, like=was)
        charts.append({"balance": balance, "chart": place_chart(here, was).as_json()})
    return {"relative_error_percent": error if math.isfinite(error) else None, "charts": charts}


def _watched(
    live: Live, analysis: Analysis, residual: Mapping[str, FloatArray], moved: tuple[str, ...]
) -> list[tuple[Place, str]]:
    """Where the residual is shown while these parameters move: chosen at their first move, so that
    the picture stays and the next moves are quick.
    """
    mark = (id(analysis.current), moved)
    kept = live.kept.get("what if")
    if kept is not None and kept[0] == mark:
        found: list[tuple[Place, str]] = kept[1]
        return found
    fitted = shown_residual(analysis, analysis.current.model, analysis.current.values)
    found = []
    for balance in _moved(fitted, residual)[:MOVING_PLACES]:
        best = places_of({balance: residual[balance]}, analysis.rows)[0]
        found.append((place(analysis.rows, fitted[balance], balance, best.axis), balance))
    live.kept["what if"] = (mark, found)
    return found


def _moved(before: Mapping[str, FloatArray], after: Mapping[str, FloatArray]) -> list[str]:
    """Balances that a change of values moves, the most moved first."""
    size = {b: float(np.nansum((after[b] - before[b]) ** 2)) for b in after}
    most = max(size.values())
    kept = sorted((b for b in size if size[b] > SEEN * most), key=lambda b: -size[b])
    return kept or list(after)[:1]


# --- words ----------------------------------------------------------------------------------------


def said() -> dict[str, Any]:
    """Outcomes with their next step, and the glossary."""
    return {
        "outcomes": {
            k: {"headline": o.headline, "next": o.next_step} for k, o in OUTCOME_WORDS.items()
        },
        "glossary": dict(GLOSSARY),
    }


def side_of(channel: str) -> str:
    """Where a channel is measured, as an axis says it."""
    return SIDES[DECLARED[channel].side] if channel in DECLARED else ""


def run_starts(record: Record) -> list[float]:
    """Where a new run begins in a plot over the whole record [s]."""
    time, parts = plot_time(record), record.segments()
    return [float(time[p.start]) for p in parts[1:]] if len(parts) <= MOST_RUNS else []


def along(analysis: Analysis, stamps: Sequence[float] | FloatArray) -> dict[str, list[float]]:
    """Every signal at some times, for the cursor that all plots share."""
    time = analysis.rows.axes["time"].values
    where = np.asarray(stamps, dtype=np.float64)
    return {
        n: [float(f"{v:.5g}") for v in np.interp(where, time, a.values)]
        for n, a in analysis.rows.axes.items()
        if n != "time"
    }


CHART_VIEWS: Final[Mapping[str, Callable[[Any, Query], Any]]] = {
    "staircase": _staircase,
    "law": _law,
    "shape": _shape,
    "as-such": _as_such,
    "spans": _spans,
    "against": _against,
    "what-if": _what_if,
}
