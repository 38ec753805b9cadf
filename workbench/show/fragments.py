"""Sections of the report and of the app: HTML text from an improvement and its plots."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from casadi_models import EFFECTS
from casadi_models.quantities import linear_unit
from identification.data.formats import interval, number, percent, pretty_unit, ratio, words
from identification.data.record import Record
from identification.diagnosis.improve import RATIO_LIMIT, Improvement
from identification.diagnosis.learned import LearnedClaim
from identification.diagnosis.lines import Line
from identification.diagnosis.locate import Unexplained
from identification.diagnosis.places import AXIS_TITLES, Place
from identification.fitting.assess import verdict_kernel
from workbench.show.bode import bode_html
from workbench.show.ceiling import ceiling_html
from workbench.show.chart import Chart, Curve, FloatArray, Label, Style
from workbench.show.pictures import place_picture, torque_label
from workbench.show.plots import Overlay, ReportPlots, StepPlace, decimated, explained
from workbench.show.results import BALANCES, table, text, title_of
from workbench.show.words import GLOSSARY

SHOWN_PER_BALANCE: Final = 3
STILL_POINTS: Final = 700
"""Points of a curve of a still picture."""

PATTERNS: Final[Mapping[frozenset[str], str]] = {
    frozenset(
        ("motor",)
    ): "a physical effect on the motor side (friction, ripple, inertia), or the current: its "
    "offset, its ripple, the motor constant",
    frozenset(
        ("link",)
    ): "a physical effect on the link side (friction, gravity, payload, a spring)",
    frozenset(
        ("transmission",)
    ): "the transmission itself: stiffness, damping, hysteresis, lost motion, kinematic error",
    frozenset(
        ("motor", "link", "transmission")
    ): "the torque sensor (gain, offset, delay): the one reading that all three balances share",
    frozenset(
        ("link", "transmission")
    ): "the link position sensor: the one reading that these two balances share and the motor "
    "balance does not",
    frozenset(
        ("motor", "transmission")
    ): "the motor position sensor: the one reading that these two share and the link balance "
    "does not",
    frozenset(("motor", "link")): "two physical effects, one on each side",
    frozenset(("sum",)): "a physical effect on the link side",
    frozenset(("deflection",)): "the transmission",
    frozenset(
        ("sum", "deflection")
    ): "a physical effect on the motor side, the current, or a position sensor, which look alike "
    "without a torque sensor",
    frozenset(("kinematic",)): "the transmission (backlash, lost motion, kinematic error), a load "
    "on the link, or a position sensor",
    frozenset(("axis",)): "physics or sensor alike: a single balance cannot tell the two apart",
}


WITHOUT_TRANSMISSION: Final[Mapping[frozenset[str], str]] = {
    **PATTERNS,
    frozenset(
        ("motor", "link")
    ): "the torque sensor, which both share, or two physical effects, one on each side",
}
"""The same for joints without a transmission balance, which would tell a torque sensor from two
effects.
"""


def pattern_of(
    ratios: Mapping[str, float], limit: float = RATIO_LIMIT
) -> tuple[frozenset[str], str]:
    """Balances over the noise, and what their pattern points to.

    Parameters
    ----------
    ratios : mapping of str to float
        Residual over noise of each balance.
    limit : float

    Returns
    -------
    hit : frozenset of str
    meaning : str
        A sentence without its full stop; physics hits one balance, a sensor those that share its
        reading.
    """
    hit = frozenset(b for b, r in ratios.items() if r > limit)
    if not hit:
        return hit, "No balance stands over the noise"
    names = " and ".join(sorted(hit))
    noun = "balance stands" if len(hit) == 1 else "balances stand"
    meaning = (PATTERNS if "transmission" in ratios else WITHOUT_TRANSMISSION).get(
        hit, "several effects at once"
    )
    return hit, f"The {names} {noun} over the noise. This pattern points to {meaning}"


def pattern_html(improvement: Improvement) -> str:
    """The pattern over the balances at the start and at the end."""
    if not improvement.steps:
        return ""
    first, last = improvement.steps[0].held_out.balances, improvement.steps[-1].held_out.balances
    _, meaning = pattern_of({b: e.ratio for b, e in first.items()})
    rows = [
        [
            f"{text(b)} balance",
            text(BALANCES.get(b, "")),
            ratio(e.ratio),
            ratio(last[b].ratio),
            _state(e.ratio, last[b].ratio),
        ]
        for b, e in first.items()
    ]
    kinds = ["flagged" if last[b].ratio > RATIO_LIMIT else "" for b in first]
    head = ["balance", "what it compares", "start model", "after the additions", "state"]
    clean = ", ".join(
        f"{text(b)} {number(1e3 * verdict_kernel(b, improvement.data))} ms" for b in first
    )
    note = (
        f"1 × means: only measurement noise is left. Above {number(RATIO_LIMIT)} × counts as "
        "over the noise. A balance at its noise is averaged over the time at which complete models "
        f"read 1 × ({clean}); one with structure left over the time that shows it best, at least "
        f"{number(1e3 * improvement.data.kernel)} ms."
    )
    return (
        f"<p>{text(meaning)}.</p>"
        f"{table(head, rows, 'Residual ÷ noise, held-out records', classes=kinds, wide=True)}"
        f"<p class='note'>{note}</p>"
    )


def _state(start: float, end: float) -> str:
    if end > RATIO_LIMIT:
        return "over the noise"
    return "was over the noise, now at it" if start > RATIO_LIMIT else "at the noise"


def place_figure(before: Place, after: Place | None, law: Place | None = None) -> str:
    """A figure of one place with its caption; `law`: what an addition explains of it."""
    unit = pretty_unit(before.residual_unit)
    share = max(before.share_percent, 0.0)
    said = (
        f"explains {share:.0f} % of this residual"
        if before.tells
        else "no dependence beyond chance"
    )
    fall = f"{number(_largest(before), 2)} {unit} at most"
    if after is not None:
        fall += f" before, {number(_largest(after), 2)} {unit} after"
    caption = (
        f"<strong>{text(before.balance)} balance, {text(before.title)}</strong>: {said}; {fall}."
    )
    if len(before.branches) > 1:
        caption += " Forward motion: full line; backward: dashed."
    picture = place_picture(before, after, law=law)
    return f"<figure>{picture}<figcaption>{caption}</figcaption></figure>"


def _largest(p: Place) -> float:
    return max((float(abs(b.mean).max()) for b in p.branches if len(b.mean)), default=math.nan)


def _legend(two: bool) -> str:
    before = '<span class="key before">◆ start model</span>'
    after = '<span class="key after">■ with the additions</span>'
    return (
        f"<p class='legend'>{before}{' ' + after if two else ''} <span class='key'>band: 95 "
        "%, from the scatter between time blocks</span></p>"
    )


def places_html(improvement: Improvement, plots: ReportPlots) -> str:
    """Where the start model fails: the telling places of the balances over the noise, the
    others folded away.
    """
    over = [b for b, e in improvement.steps[0].held_out.balances.items() if e.ratio > RATIO_LIMIT]
    shown: list[str] = []
    rest: list[str] = []
    count = dict.fromkeys(over, 0)
    first: Place | None = None
    for before, after in plots.places:
        if before.balance in count and count[before.balance] < SHOWN_PER_BALANCE:
            count[before.balance] += 1
            first = first or (before if before.tells else None)
            shown.append(place_figure(before, after))
        else:
            rest.append(place_figure(before, after))
    if first is not None:
        sentence = (
            f"The start model fails most visibly in the <strong>{text(first.balance)} "
            "balance</strong> against the "
            f"<strong>{text(first.title)}</strong>: this curve alone explains "
            f"{first.share_percent:.0f} % of what that balance leaves over."
        )
    elif over:
        sentence = (
            "The start model leaves something over, but it depends on none of the "
            "measured signals in a repeatable way."
        )
    else:
        sentence = (
            "Nowhere: no balance stands over its noise, so the curves below show scatter only."
        )
    body = (
        f"<p>{sentence} A flat curve at zero is a model that fits "
        f"there.</p>{_legend(len(improvement.steps) > 1)}"
    )
    if shown:
        body += f"<div class='grid'>{''.join(shown)}</div>"
    if not rest:
        return body
    return (
        body + f"<details><summary>All other balances and signals ({len(rest)})</summary><div "
        f"class='grid'>{''.join(rest)}</div></details>"
    )


def addition_html(step: StepPlace, claim: Mapping[str, Any], before: float, after: float) -> str:
    """Before and after one addition: the picture, the error, how the absence of the effect
    looks.
    """
    known = EFFECTS.get(step.effect)
    absence = f"<p>How its absence looks: {text(known.absence)}.</p>" if known else ""
    drop = percent(claim["held_out_drop_percent"])
    names = " or ".join(title_of(k) for k in claim["effects"])
    return (
        f"<article class='addition'><h3>+ {names}</h3><p>Error on held-out "
        f"records: {percent(before)} before, "
        f"{percent(after)} after. Residual of the {text(claim['balance'])} balance: {drop} "
        f"smaller.</p>{absence}"
        "<p class='legend'><span class='key before'>◆ before this addition</span> <span "
        "class='key after'>■ after it</span> <span class='key law'>━ what it explains</span></p>"
        f"{place_figure(step.before, step.after, explained(step.before, step.after))}</article>"
    )


def additions_html(improvement: Improvement, plots: ReportPlots) -> str:
    """Every addition with its residual before and after."""
    errors = [s.held_out.relative_error_percent for s in improvement.steps]
    claims = [c.as_json() for c in improvement.claims]
    parts = [
        addition_html(p, c, a, b)
        for p, c, a, b in zip(plots.additions, claims, errors[:-1], errors[1:], strict=False)
    ]
    return f"<div class='grid'>{''.join(parts)}</div>" if parts else "<p>Nothing was added.</p>"


def lines_html(lines: Sequence[Line]) -> str:
    """Lines: residual periodic in the motor angle or the position."""
    if not lines:
        return "<p>None: nothing that is left repeats with the motor angle or the position.</p>"
    rows = [
        [
            f"{number(x.order)} ± {number(x.tolerance, 2)} per {text(x.per)}",
            f"{text(x.balance)} balance",
            f"{number(x.amplitude, 3)} {pretty_unit(x.unit)}",
            f"{number(x.prominence, 2)} ×",
            " or ".join(title_of(k) for k in x.effects)
            or "function of position, no name in the library",
        ]
        for x in lines
    ]
    return table(
        ["order", "seen in", "amplitude", "over its surroundings", "name"],
        rows,
        "Residual that repeats with the motor angle",
    )


def unexplained_sentence(u: Unexplained, linear: bool) -> str:
    """Where structure is left, in a sentence (escaped)."""
    out = (
        f"<strong>{text(u.balance)} balance</strong>: {number(u.rms, 2)} "
        f"{'N' if linear else 'N·m'} (RMS) are left"
    )
    if u.axis:
        unit = pretty_unit(linear_unit(u.unit or "") if linear else u.unit or "")
        by = ", differently in the two directions of motion" if u.by_direction else ""
        out += (
            f"; {number(u.share_percent, 2)} % of it depend on the "
            f"{text(AXIS_TITLES.get(u.axis, words(u.axis)))}{by}"
        )
        if u.low is not None and u.high is not None:
            out += f", mostly at {interval(u.low, u.high)} {unit}"
    if u.order is not None:
        out += (
            f"; it repeats {number(u.order)} times per {'metre' if linear else 'turn of the motor'}"
        )
    if u.frequency_hz is not None:
        out += f"; its spectrum peaks at {number(u.frequency_hz, 3)} Hz"
    if u.axis is None and u.order is None and u.frequency_hz is None:
        out += "; it depends on no measured signal in a repeatable way"
    return out + "."


def unexplained_html(improvement: Improvement) -> str:
    """What no effect of the library explains, and where it sits."""
    if not improvement.unexplained:
        return "<p>Nothing: every balance is at its noise.</p>"
    linear = improvement.joint.kind == "linear"
    items = "".join(f"<li>{unexplained_sentence(u, linear)}</li>" for u in improvement.unexplained)
    curves = "".join(
        f"<figure>{place_picture(c.place, None, 'torque')}"
        f"<figcaption>{text(_plain(c))}</figcaption></figure>"
        for c in improvement.learned
    )
    if curves:
        curves = f"<h3>The curve in the place of a name</h3><div class='grid'>{curves}</div>"
    return (
        f"<ul>{items}</ul>{curves}<p class='note'>This is not in the library. Look at the place "
        "named above; an effect of your own takes about ten lines of Python.</p>"
    )


def _plain(claim: LearnedClaim) -> str:
    """The sentence of a learned curve without the label that a model knows it by."""
    return claim.sentence.replace(f" ({claim.curve.label})", "")


def minor_html(improvement: Improvement) -> str:
    """Small but certain effects, worded as such."""
    items = "".join(
        f"<li>{' or '.join(title_of(k) for k in c.effects)} ({text(c.balance)} balance): "
        f"{percent(c.held_out_drop_percent, 2)}</li>"
        for c in improvement.minor
    )
    return (
        "<h3>Small but certain</h3><p>Seen in every check, but too small to be "
        f"added:</p><ul>{items}</ul>"
        if items
        else ""
    )


def overlay_html(shown: Sequence[Overlay]) -> str:
    """Controls and empty plots of the overlay; the script fills them."""
    options = "".join(
        f'<option value="{i}">{text(o.balance)} balance, {text(o.record)}</option>'
        for i, o in enumerate(shown)
    )
    buttons = "".join(
        f'<button type="button" data-do="{do}" aria-label="{label}">{sign}</button>'
        for do, sign, label in (
            ("worst", "Worst window", "Show the worst window"),
            ("all", "Whole record", "Show the whole record"),
            ("left", "←", "Earlier"),
            ("right", "→", "Later"),
            ("in", "+", "Zoom in"),
            ("out", "−", "Zoom out"),
        )
    )
    still = ""
    if shown:
        figures = "".join(f"<figure>{c.svg()}</figure>" for c in window_charts(shown[0]))
        models = (
            '<span class="key before">╌ start model</span> '
            '<span class="key after">─ with the additions</span>'
            if shown[0].added
            else '<span class="key after">─ model</span>'
        )
        still = (
            f"<p class='legend print-only'>{text(shown[0].balance)} balance, "
            f"{text(shown[0].record)}: <span class='key'>━ measured</span> {models}</p>"
            f'<div class="print-only grid">{figures}</div>'
        )
    return (
        f"{still}"
        f'<div class="controls"><label>Show <select id="overlay-choice">{options}</select></label> '
        f'<span role="group" aria-label="Time window">{buttons}</span></div>'
        '<p id="overlay-status" class="note" aria-live="polite"></p>'
        '<div id="overlay" tabindex="0" role="group" aria-label="Measured and modelled torque '
        'over time; arrow keys move, plus and minus zoom">'
        '<div id="overlay-torque" class="chart"></div><div id="overlay-residual" '
        'class="chart"></div>'
        '<p class="note">The whole record; drag to choose a window.</p><div id="overlay-whole" '
        'class="chart"></div></div>'
        "<noscript><p>These three plots need scripts; every other part of this page does "
        "without.</p></noscript>"
    )


def breaks_said(shown: Sequence[Overlay]) -> str:
    """Why curves over time break; empty where none does."""
    most = max((o.broken_percent for o in shown), default=0.0)
    if most == 0.0:
        return ""
    return (
        " The curves break where rows take no part in the balance, nor in any error: a side whose "
        "friction acts in it stands still, samples are missing, or a new stretch begins (up to "
        f"{number(most, 2)} % of the rows of a record)."
    )


def window_charts(o: Overlay) -> tuple[Chart, Chart]:
    """The worst window of an overlay as still pictures: torque, and the residual in a frame of its
    own.
    """
    inside = (o.time >= o.window[0]) & (o.time <= o.window[1])
    whole = [o.measured[inside], o.start[inside], o.final[inside]]
    time, (measured, start, final) = decimated(o.time[inside], whole, STILL_POINTS)
    x = Label("time, records end to end", "s")
    kinds: list[tuple[str, FloatArray, Style]] = [("with the additions", final, "after")]
    kinds = [("start model", start, "before"), *kinds] if o.added else [("model", final, "after")]
    said = f"{o.balance} balance on {o.record}, {number(o.window[0])} to {number(o.window[1])} s"
    return (
        Chart(
            f"Measured and modelled {o.quantity}, {said}",
            x,
            torque_label(f"{o.quantity}, {o.balance} balance", o.unit),
            (
                Curve("measured", time, measured, "ink"),
                *(Curve(n, time, v, s, dashed=s == "before") for n, v, s in kinds),
            ),
            zero=False,
        ),
        Chart(
            f"Residual, {said}",
            x,
            torque_label(f"residual, {o.balance} balance", o.unit),
            tuple(Curve(n, time, measured - v, s, dashed=s == "before") for n, v, s in kinds),
        ),
    )


def glossary_html() -> str:
    """Every term, by the word that stands on the page."""
    items = "".join(f"<dt>{text(k)}</dt><dd>{text(v)}</dd>" for k, v in GLOSSARY.items())
    return f"<dl class='words'>{items}</dl>"


def linear_html(plots: ReportPlots) -> str:
    """What linear models without physics explain, beside the final model; empty where the
    records are too short.
    """
    if plots.ceiling is None:
        return ""
    note = (
        "Black boxes from the motion to the measured torque of each balance: static, ARX, output "
        "error and MOESP, of order 1 and 2. "
        "They know no physics, but any linear law is within their reach."
    )
    return f"{ceiling_html(plots.ceiling)}<p class='note'>{note}</p>"


def frequency_html(plots: ReportPlots) -> str:
    """Frequency responses; empty where the records excite too little."""
    if plots.bode is None:
        return ""
    said = (
        "Measured on all the records. Neither model was fitted to these curves: the physical one "
        "was fitted to torque balances, "
        "the subspace one to the signals in time. A peak is a resonance; the phase falls through "
        "it."
    )
    return f"<p>{said}</p>{bode_html(plots.bode)}"


def provenance_html(
    improvement: Improvement,
    records: Sequence[Record],
    versions: Mapping[str, str],
    command: str | None,
    made: str,
) -> str:
    """Where the figures come from: files with digests, joint, versions, command."""
    held = set(improvement.data.held_out_names) - set(improvement.data.train_names)
    rows = []
    for r in records:
        p = r.provenance
        files = (
            "<br>".join(
                f"{text(Path(f).name)}: <code>{text(h)}</code>"
                for f, h in zip(p.paths, p.sha256, strict=False)
            )
            or "in memory"
        )
        notes = "".join(f"<li>{text(n)}</li>" for n in (*p.columns, *p.notes))
        folded = (
            "<details><summary>columns and repairs "
            f"({len(p.columns) + len(p.notes)})</summary><ul>{notes}</ul></details>"
            if notes
            else "–"
        )
        rows.append(
            [
                text(r.name),
                "held out" if r.name in held else "training",
                f"{len(r)} samples, {number(r.duration)} s",
                files,
                folded,
            ]
        )
    listed = table(
        ["record", "used for", "size", "file: SHA-256", "how it was read"],
        rows,
        "Records",
        wide=True,
    )
    # what is folded on a screen stands below the table on paper
    read = "".join(
        f"<p class='note print-only'>{text(r.name)} was read as: "
        f"{text('; '.join((*r.provenance.columns, *r.provenance.notes)))}.</p>"
        for r in records
        if r.provenance.columns or r.provenance.notes
    )
    shown = f"<div class='records'>{listed}{read}</div>" if rows else ""
    if not rows:
        names = ", ".join(
            text(n) for n in (*improvement.data.train_names, *improvement.data.held_out_names)
        )
        shown = f"<p>Records: {names} (their digests were not handed to this report).</p>"
    facts = [
        [
            "joint file",
            text(Path(improvement.joint.source).name) if improvement.joint.source else "in memory",
        ],
        [
            "joint",
            f"{text(improvement.joint.name)}, {text(improvement.joint.kind)}, gear ratio "
            f"{number(improvement.joint.gear_ratio)}, "
            f"model {text(improvement.joint.model_name)}",
        ],
        ["kernel of the balances", f"{number(1e3 * improvement.data.kernel)} ms"],
        ["versions", ", ".join(f"{text(k)} {text(v)}" for k, v in versions.items())],
        ["made", text(made)],
    ]
    if command:
        facts.append(["command", f"<code>{text(command)}</code>"])
    return shown + table(["what", "value"], facts, "How this report was made")
