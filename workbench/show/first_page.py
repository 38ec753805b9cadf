"""The report's first page: verdict, falling error, the place that told, the law, the next run."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from casadi_models import EFFECTS, JointModel
from casadi_models.signals import Expression
from casadi_models.text.shown import readable, shown_equations
from casadi_models.text.written import written
from identification.data.channels import channel_unit
from identification.data.formats import number, pretty_unit, with_error
from identification.data.record import Record
from identification.diagnosis.candidates import shown_by_parts
from identification.diagnosis.improve import Improvement
from workbench.show.chart import Chart, Curve, Label, svg
from workbench.show.pictures import AT_THE_LINK, AT_THE_MOTOR, place_picture
from workbench.show.plots import ReportPlots, decimated, explained
from workbench.show.results import staircase_html, step_names, table, text
from workbench.show.words import (
    OUTCOME_WORDS,
    kind_of,
    name_in_formula,
    plain_name,
    run_that_shows,
    title_of,
)

MOST_LAWS: Final = 4
MOST_RUNS: Final = 3
"""Motions asked for on the first page; the others stand in the details."""
MOTIONS: Final = 4
"""Records whose motion is drawn."""
MOTION_POINTS: Final = 500
_GUARD: Final = re.compile(r" \+ 1e-(?:06|12)\b|max\(([^,]*), 1e-12\)")
"""Numbers of the laws that are there for the arithmetic alone."""
_NAME: Final = re.compile(r"(?<![\w.])[A-Za-z_]\w*\b(?!\()")
"""A symbol in a written expression: no function, no exponent of a number."""


# --- the first page -------------------------------------------------------------------------------


def pair_html(improvement: Improvement, result: Mapping[str, Any], plots: ReportPlots) -> str:
    """The falling staircase beside the one place that told, before and after."""
    stairs = (
        f"<figure>{staircase_html(result)}<figcaption>Error on records the fit never saw, step by "
        "step. Dotted: what measurement noise alone would leave.</figcaption></figure>"
    )
    return f"<div class='pair'>{stairs}{_telling(improvement, result, plots)}</div>"


def _telling(improvement: Improvement, result: Mapping[str, Any], plots: ReportPlots) -> str:
    """The place of the first addition with the law through it, else the most telling place."""
    if plots.additions:
        step = plots.additions[0]
        name = step_names(result)[1]
        before, law = step.before, explained(step.before, step.after)
        picture = place_picture(before, step.after, law=law)
        said = (
            f"The place that told, before (◆) and after (■) “{text(name)}”. Line: what the "
            "addition explains."
        )
    elif plots.places:
        before, after = plots.places[0]
        picture = place_picture(before, after)
        said = "The most telling place of the model."
    else:
        return ""
    if len(before.branches) > 1:
        said += " Forward motion: full; backward: dashed."
    return f"<figure>{picture}<figcaption>{said}</figcaption></figure>"


def law_html(improvement: Improvement, result: Mapping[str, Any]) -> str:
    """Every law that was added, as a formula and in numbers."""
    if not improvement.steps:
        return ""
    model = improvement.steps[-1].solution.model
    values = result["steps"][-1]["parameters"]
    parts = _parts(model)
    balances = {k: c["balance"] for c in result["claims"] for k in c["effects"]}
    rows = []
    named = step_names(result)[: len(improvement.steps)]
    for step, name in zip(improvement.steps[1:], named[1:], strict=True):
        label = step.label or step.added or ""
        formula = parts.get(label, "")
        where = balances.get(step.added or "", "")
        term = next((t for t in model.terms if t.label == label), None)
        names = [n for n in (term.names if term else ()) if n in values]
        numbers = "<br>".join(
            f"<span class='nowrap'>{text(plain_name(n))} = "
            f"{with_error(values[n]['value'], values[n]['stderr'])} "
            f"{pretty_unit(values[n]['unit'])} <span class='side'>({text(values[n]['side'])})"
            "</span></span>"
            for n in names
        )
        shown = formula or "–"
        side = f" <span class='side'>in the {text(where)} balance</span>" if where else ""
        rows.append([f"+ {text(name)}{side}", shown, numbers or "–"])
    curves = _curves_left(result)
    if not rows:
        return f"<h2>The law</h2>{curves}" if curves else ""
    head = ["added", "law", "values, ± standard error"]
    word = "laws" if len(rows) > 1 else "law"
    effort = "Forces" if improvement.joint.kind == "linear" else "Torques"
    more = f"; {len(rows) - MOST_LAWS} more in the details" if len(rows) > MOST_LAWS else ""
    caption = f"{effort} referred to the link, SI units{more}"
    shown = table(head, rows[:MOST_LAWS], caption, stacked=True)
    return f"<h2>The {word} in numbers</h2>{shown}{curves}"


def _curves_left(result: Mapping[str, Any]) -> str:
    """What is left without a name, by the signals of the learned curves: one sentence."""
    curves = [c for c in result["claims"] if "curve" in c]
    if not curves:
        return ""
    over: dict[str, list[str]] = {}
    for c in curves:
        signal = plain_name(c["curve"]["axis"])
        signal += " with the direction of motion" if c["curve"]["by_direction"] else ""
        over.setdefault(c["balance"], []).append(signal)
    said = "; ".join(f"in the {b} balance a function of {', of '.join(v)}" for b, v in over.items())
    return f"<p>Left without a name: {text(said)}. The details draw it.</p>"


def _parts(model: Any) -> dict[str, str]:
    """Of each effect its law; empty for a model whose equations are not known."""
    if not isinstance(model, JointModel):
        return {}
    return {
        source: "<br>".join([_formula(part), *(_with(*pair) for pair in where)])
        for r in readable(shown_equations(model))
        for (source, part), where in zip(r.equation.parts, r.of_part, strict=True)
    }


def _with(symbol: Expression, definition: Expression) -> str:
    return f"with {_formula(symbol)} = {_formula(definition)}"


def _formula(part: Expression, sign: str = "") -> str:
    """A formula for the eye, as HTML: names as words, powers as ^, products as a raised dot; what
    only keeps a root or a logarithm from zero is left out. Lines end before a product or a
    quotient, never inside a name or a number.
    """
    plain = re.sub(_GUARD, lambda m: m[1] or "", written(part))
    plain = re.sub(_NAME, lambda m: name_in_formula(m[0]).replace(" ", "\u00a0"), plain)
    plain = plain.replace("**", "^").replace("*", "\u00b7").replace("-", "\u2212")
    said = re.sub("[\u00b7/]", r"<wbr>\g<0>", text(plain))
    return f"<code class='formula'>{sign}{said}</code>"


def equations_html(improvement: Improvement) -> str:
    """The whole model as formulas."""
    if not improvement.steps or not isinstance(improvement.steps[-1].solution.model, JointModel):
        return ""
    out = []
    for r in readable(shown_equations(improvement.steps[-1].solution.model)):
        e = r.equation
        rows = [
            [_formula(part, "+ " if k else ""), text(_source(source))]
            for k, (source, part) in enumerate(e.parts)
        ]
        rows += [[_with(*pair), "short for what stands more than once"] for pair in r.where]
        caption = f"{text(e.title)} [{pretty_unit(e.unit)}]: {_formula(e.left)} ="
        out.append(table(["part", "what it is"], rows, caption))
    return (
        "".join(out) + "<p class='note'>All quantities are referred to the link, in SI units.</p>"
    )


def _source(source: str) -> str:
    return title_of(source) if source.partition("@")[0] in EFFECTS else source.replace("_", " ")


def next_html(improvement: Improvement, result: Mapping[str, Any]) -> str:
    """What to measure next, the most useful first."""
    sentence = OUTCOME_WORDS[kind_of(result)].next_step
    crowded = (len(result["steps"]) > 2) + any("curve" in c for c in result["claims"])
    runs = []
    for c in result["claims"]:
        if len(c["effects"]) > 1 and c["separate_by"]:
            names = " from ".join(title_of(k) for k in c["effects"])
            runs.append(
                f"Next run: <strong>{text(c['separate_by'])}</strong>; it tells {text(names)}"
            )
    seen: dict[str, list[str]] = {}
    for n in result["not_testable"]:
        key = n["effect"]
        if shown_by_parts(n["why"]):
            continue
        if motion := run_that_shows(key, improvement.joint.kind):
            seen.setdefault(motion, []).append(EFFECTS[key].title)
    for motion, titles in sorted(seen.items(), key=lambda p: -len(p[1])):
        if len(runs) < MOST_RUNS - crowded:
            runs.append(f"<strong>{text(motion)}</strong>: would show {text(', '.join(titles))}")
    items = "".join(f"<li>{r}.</li>" for r in runs)
    return (
        f"<h2>What to measure next</h2><p>{text(sentence)}</p>"
        f"{f'<ul>{items}</ul>' if items else ''}"
    )


# --- joint and motion -----------------------------------------------------------------------------


def joint_picture(improvement: Improvement) -> str:
    """The joint as a chain from drive to link, with what is measured where."""
    joint, sensing = improvement.joint, improvement.data.sensing
    linear = joint.kind == "linear"
    ratio = number(joint.gear_ratio)
    boxes = [
        ("drive", "current or torque" if sensing.has_drive else "not recorded", sensing.has_drive),
        (
            "motor",
            "position" if sensing.both_positions or sensing.moving == "motor_position" else "–",
            sensing.both_positions or sensing.moving == "motor_position",
        ),
        ("transmission" if linear else "gear", f"ratio {ratio}", False),
        ("torque sensor", "torque", True) if sensing.has_torque else ("", "", False),
        (
            "link" if not sensing.clamped_link else "link, clamped",
            "position" if sensing.both_positions else "not measured",
            sensing.both_positions,
        ),
    ]
    boxes = [b for b in boxes if b[0]]
    width, step = 640, 640 // len(boxes)
    out = []
    for k, (name, below, measured) in enumerate(boxes):
        left = k * step + 8
        if k:
            out.append(f'<path class="s-ink" d="M{left - 16} 30H{left}" stroke="#444444"/>')
        kind = "s-after" if measured else "s-grid"
        colour = "#0072b2" if measured else "#cccccc"
        out.append(
            f'<rect class="{kind} box" x="{left}" y="8" width="{step - 16}" height="44" rx="6" '
            f'fill="none" stroke="{colour}" stroke-width="{2 if measured else 1}"/>'
        )
        middle = left + (step - 16) / 2
        for y, said, weight in ((27, name, "600"), (44, below, "400")):
            out.append(
                f'<text class="s-ink" fill="#444444" x="{middle:.0f}" y="{y}" text-anchor="middle" '
                f'font-size="12" font-weight="{weight}">{text(said)}</text>'
            )
    measured_names = ", ".join(f"{b[1]} at the {b[0]}" for b in boxes if b[2])
    label = f"The joint from drive to link; measured: {measured_names}"
    return svg(label, "".join(out), 60, width, "picture chain")


def motion_charts(improvement: Improvement, records: Sequence[Record]) -> list[tuple[str, Chart]]:
    """Position over time of the first records, each run a curve of its own."""
    kind = improvement.joint.kind
    out = []
    for r in records[:MOTIONS]:
        channel = next((c for c in ("link_position", "motor_position") if r.has(c)), None)
        if channel is None:
            continue
        side = AT_THE_LINK if channel == "link_position" else AT_THE_MOTOR
        runs = r.segments()
        curves = []
        for k, part in enumerate(runs):
            time = r.time[part] - r.time[part.start]
            t, (y,) = decimated(time, [r[channel][part]], max(60, MOTION_POINTS // len(runs)))
            curves.append(Curve(f"run {k + 1}", t, np.asarray(y), "after"))
        many = f", {len(runs)} runs laid over each other" if len(runs) > 1 else ""
        chart = Chart(
            f"Motion of {r.name}: {channel.replace('_', ' ')} over time{many}",
            Label("time since the start of the run", "s"),
            Label(channel.replace("_", " "), channel_unit(channel, kind), side),
            tuple(curves),
            zero=False,
            height=190,
        )
        out.append((f"{r.name}{many}", chart))
    return out


def joint_html(improvement: Improvement, records: Sequence[Record]) -> str:
    """The joint and its motion in pictures."""
    held = set(improvement.data.held_out_names) - set(improvement.data.train_names)
    by_name = {r.name: r for r in records}
    figures = "".join(
        f"<figure>{chart.svg()}<figcaption>{text(said)}"
        f"{' (held out)' if said.split(', ')[0] in held else ''}</figcaption></figure>"
        for said, chart in motion_charts(improvement, records)
    )
    more = len(by_name) - MOTIONS
    rest = f"<p class='note'>{more} more records are not drawn.</p>" if more > 0 else ""
    return (
        f"{joint_picture(improvement)}<p class='note'>Blue frame: measured.</p>"
        f"<div class='grid'>{figures}</div>{rest}"
    )
