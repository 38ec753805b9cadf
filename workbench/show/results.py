"""HTML fragments of results: tables and small pictures, for notebooks, the report and the app
alike.

Every function returns text without scripts, styles or ids; every name that comes from a file is
escaped.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from identification.data.formats import (
    chances,
    number,
    percent,
    pretty_unit,
    ratio,
    with_error,
    words,
)
from identification.diagnosis.learned import LEARNED
from workbench.show.pictures import bar, place_picture, staircase_picture
from workbench.show.words import CURVES, filtered, headline
from workbench.show.words import title_of as effect_title

if TYPE_CHECKING:
    from identification.data.record import Record
    from identification.diagnosis.compare import Comparison
    from identification.diagnosis.diagnose import Diagnosis
    from identification.diagnosis.improve import Improvement
    from identification.diagnosis.trials import Trial
    from identification.fitting.fit import Fit

BALANCES: Final = {
    "motor": "drive torque against torque sensor, motor inertia and motor-side friction",
    "link": "torque sensor against link inertia, gravity and link-side friction",
    "transmission": "torque sensor against the twist of the gear",
    "sum": "drive torque against everything that moves (no torque sensor)",
    "deflection": "drive torque against motor side and twist of the gear (no torque sensor)",
    "axis": "drive torque against everything that moves, seen from one side",
    "kinematic": "twist of the gear against what the link's own motion asks for (no torque)",
}
STRONG_CORRELATION: Final = 0.95
SHOWN_PLACES: Final = 4


_UNSEEN: Final = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")
"""Control characters, which HTML has no place for."""


def text(value: object) -> str:
    """Any value as escaped text; control characters as Python writes them."""
    shown = _UNSEEN.sub(lambda found: repr(found[0])[1:-1], str(value))
    return html.escape(shown, quote=True)


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    caption: str,
    *,
    classes: Sequence[str] = (),
    wide: bool = False,
    stacked: bool = False,
) -> str:
    """A table from cells that are HTML already; the first cell of a row is its header.

    Parameters
    ----------
    head : sequence of str
        Column titles, HTML.
    rows : iterable of sequence of str
    caption : str
        HTML.
    classes : sequence of str
        Class of each row; may be shorter than the rows.
    wide : bool
        With long texts: a page scrolls it sideways rather than squeeze it.
    stacked : bool
        With cells as long as a narrow screen is wide: there they stand below each other, each with
        its title.
    """
    top = "".join(f'<th scope="col">{h}</th>' for h in head)
    body = []
    for i, row in enumerate(rows):
        kind = f' class="{classes[i]}"' if i < len(classes) and classes[i] else ""
        cells = "".join(
            f'<td data-title="{head[k]}">{c}</td>' if stacked else f"<td>{c}</td>"
            for k, c in enumerate(row[1:], 1)
        )
        body.append(f'<tr{kind}><th scope="row">{row[0]}</th>{cells}</tr>')
    shape = ' class="stacked"' if stacked else ' class="wide"' if wide else ""
    return (
        f"<table{shape}><caption>{caption}</caption><thead><tr>{top}</tr></thead><tbody>"
        f"{''.join(body)}</tbody></table>"
    )


def spaced(fragment: str) -> str:
    """The fragment for a notebook, whose styles may set no space between the cells of a table."""
    return re.sub(
        r"<(td|th)( [^>]*)?>",
        lambda m: f'<{m[1]}{m[2] or ""} style="padding:0.15em 0.7em;text-align:left">',
        fragment,
    )


def title_of(label: str) -> str:
    """Title of an effect of the library (the key as words where it is not in it), escaped."""
    return text(effect_title(label))


def verdict_html(result: Mapping[str, Any], level: int = 2) -> str:
    """Headline and sentence of an `improve --json` result."""
    reason = text(result.get("reason", "")).replace(" %", "&nbsp;%")
    return f"<h{level}>{text(headline(result))}</h{level}><p>{reason}</p>"


def _ratios(balances: Mapping[str, Mapping[str, Any]], names: Sequence[str]) -> list[str]:
    return [ratio(balances[n]["ratio"]) if n in balances else "–" for n in names]


def floor_percent(error: Mapping[str, Any]) -> float | None:
    """Relative error that measurement noise alone would leave in the balances [%]."""
    floor = math.sqrt(sum(b["floor"] ** 2 for b in error["balances"].values()))
    size = math.sqrt(sum(b["rms"] ** 2 for b in error["balances"].values()))
    return float(error["relative_error_percent"]) * floor / size if size > 0 and floor > 0 else None


def effort_of(error: Mapping[str, Any]) -> str:
    """What the balances are sums of: torques, or forces of a linear axis."""
    return "force" if any(b.get("unit") == "N" for b in error["balances"].values()) else "torque"


def stairs_of(result: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The steps of the falling error: those of names, then that of learned curves, if any."""
    curved = result.get("with_curves")
    return [*result["steps"], *([curved] if curved else [])]


def step_names(result: Mapping[str, Any]) -> list[str]:
    """What each of these steps added: a set where its claim is one."""
    sets = {k: c["effects"] for c in result["claims"] if "curve" not in c for k in c["effects"]}
    return [
        "start model"
        if s["added"] is None
        else CURVES
        if s["added"] == LEARNED
        else " or ".join(effect_title(k) for k in sets.get(s["added"], [s["added"]]))
        for s in stairs_of(result)
    ]


def ledger_html(result: Mapping[str, Any]) -> str:
    """The ledger: error of every step on training and held-out records, ratio to the noise
    floor per balance.
    """
    steps = stairs_of(result)
    if not steps:
        return "<p>No model was fitted.</p>"
    names = list(steps[0]["held_out"]["balances"])
    head = [
        "step",
        "error, held-out",
        "error, training",
        "fit, held-out",
        *(f"{text(n)} ÷ noise" for n in names),
    ]
    rows = [
        [
            text(f"{i}. + {name}" if i else name),
            percent(s["held_out"]["relative_error_percent"]),
            percent(s["train"]["relative_error_percent"]),
            percent(s["held_out"]["fit_percent"]),
            *_ratios(s["held_out"]["balances"], names),
        ]
        for i, (s, name) in enumerate(zip(steps, step_names(result), strict=True))
    ]
    return table(head, rows, "Error of each step")


def staircase_html(result: Mapping[str, Any]) -> str:
    """The held-out error as a falling staircase."""
    steps = stairs_of(result)
    if not steps:
        return ""
    values = [float(s["held_out"]["relative_error_percent"]) for s in steps]
    names = [f"+ {n}" if i else n for i, n in enumerate(step_names(result))]
    last = steps[-1]["held_out"]
    return staircase_picture(values, floor_percent(last), names, effort=effort_of(last))


def claims_html(result: Mapping[str, Any]) -> str:
    """The claims as a list: names, balance, fall of the error, what would separate a set."""
    items = []
    for claim in result["claims"]:
        names = " or ".join(f"<strong>{title_of(k)}</strong>" for k in claim["effects"])
        line = (
            f"{names}: lowers the error of the {text(claim['balance'])} balance by "
            f"{percent(claim['held_out_drop_percent'])} on held-out records"
        )
        if claim.get("kernel_s"):
            line += f", in rows of {number(claim['kernel_s'], 2)} s, whose noise is lower"
        line += "."
        if "curve" in claim:
            plain = claim["sentence"].replace(f" ({claim['label']})", "")
            line = f"<strong>free curve</strong>: {text(plain)}"
        if claim.get("confidence"):
            by_title = {title_of(k): p for k, p in claim["confidence"].items()}
            line += f" By the likelihoods of whole fits: {chances(by_title)}."
        if len(claim["effects"]) > 1:
            how = text(claim["separate_by"] or "a run that moves differently")
            line += f" These records cannot tell these names apart; what would: {how}."
        if claim.get("like"):
            line += f" Held against a free curve over its own variable it is {text(claim['like'])}."
        if claim.get("partial"):
            line += (
                " It explains only part of what is missing: structure is left in this "
                "balance that is not in the library."
            )
        items.append(f"<li>{line}</li>")
    return f"<ul>{''.join(items)}</ul>" if items else "<p>No effect is claimed.</p>"


def trial_values(trial: Trial) -> str:
    """Estimates of a candidate's amplitudes and shapes with their units."""
    parameters = {p.name: p for p in trial.candidate.model.parameters}
    shown = [n for n in (*trial.candidate.amplitudes, *trial.candidate.shapes) if n in trial.values]
    return ", ".join(
        f"{text(words(n))} {number(trial.values[n], 3)} {pretty_unit(parameters[n].unit)}".rstrip()
        for n in shown
    )


def ranking_html(
    result: Mapping[str, Any],
    trials: Sequence[Trial] = (),
    *,
    first: int = 0,
    last: int | None = None,
    caption: str = "",
) -> str:
    """The ranked effects: what adding one alone would lower, its estimate, and what it is
    mistaken for.
    """
    values = {t.key: trial_values(t) for t in trials}
    claimed = {k: c for c in result["claims"] for k in c["effects"]}
    head = [
        "effect",
        "held-out error falls by",
        "state",
        "acts on",
        "seen in",
        "estimate",
        "easily mistaken for",
    ]
    rows, classes = [], []
    for i, r in list(enumerate(result["ranking"], 1))[first:last]:
        drop = r["held_out_drop_percent"]
        state = "over the threshold" if r["significant"] else "under the threshold"
        if r["effect"] in claimed:
            state = "claimed" if r["significant"] else "claimed in a later step"
        rows.append(
            [
                f"{i}. {text(r['title'])}",
                f'<span class="nowrap">{bar(drop, f"{drop:.0f} percent")} '
                f"{percent(drop, 2) if drop > 0 else 'no fall'}</span>",
                state,
                text(words(r.get("place", ""))),
                f"{text(r['balance'])} balance",
                values.get(r["effect"], ""),
                ", ".join(title_of(k) for k in r["confusable_with"]) or "–",
            ]
        )
        classes.append("" if r["significant"] or r["effect"] in claimed else "under")
    return table(
        head,
        rows,
        caption or "Effects of the library, each tried alone on the start model",
        classes=classes,
        wide=True,
    )


def not_testable_html(result: Mapping[str, Any]) -> str:
    """Effects that the records cannot show, with the reason."""
    rows = [[title_of(n["effect"]), text(n["why"])] for n in result["not_testable"]]
    return (
        table(["effect", "why these records cannot show it"], rows, "Not testable") if rows else ""
    )


def calibration_html(result: Mapping[str, Any], names: Sequence[str]) -> str:
    """What the sensors of each training record are off by, with a band of 95 % (`names`: of the
    training records).
    """
    rows = []
    for c in result.get("calibration", ()):
        band = "–" if c["stderr"] is None else f"± {2 * c['stderr']:.2g}"
        rows.append(
            [
                f"{text(c['what'])} of the {text(words(c['sensor']))}",
                text(names[c["run"]]),
                f"{c['value']:.5g} {band} {text(c['unit'])}{text(filtered(c))}",
            ]
        )
    return (
        table(
            ["what", "record", "value"],
            rows,
            "Calibration found: what the sensors are off by; no physics of the joint",
        )
        if rows
        else ""
    )


def parameter_flags(p: Mapping[str, Any]) -> list[str]:
    """What to beware of in a fitted value, as phrases (escaped)."""
    out = []
    if p.get("nuisance"):
        return ["help value of the fit, not physics"]
    if p.get("at_bound"):
        out.append("stands at its bound")
    if not p.get("identifiable", True):
        out.append("not identifiable from these records")
    partner = p.get("correlation")
    if partner and abs(partner["value"]) >= STRONG_CORRELATION:
        out.append(
            f"moves together with {text(words(partner['with']))} ({number(partner['value'], 2)})"
        )
    return out


def parameters_html(
    parameters: Mapping[str, Mapping[str, Any]],
    start: Mapping[str, Mapping[str, Any]] | None = None,
) -> str:
    """Fitted parameters: value with standard error, unit, side, what to beware of.

    Parameters
    ----------
    parameters : mapping
        From :func:`identification.fitting.parameters.parameter_table`.
    start : mapping, optional
        The same of the start model, for a column beside.
    """
    head = [
        "parameter",
        "value ± standard error",
        *(["in the start model"] if start is not None else []),
        "unit",
        "side",
        "beware",
        "meaning",
    ]
    rows, classes = [], []
    for name, p in parameters.items():
        before = [] if start is None else [number(start[name]["value"]) if name in start else "–"]
        flags = parameter_flags(p)
        rows.append(
            [
                text(words(name)),
                with_error(p["value"], p["stderr"]),
                *before,
                pretty_unit(p["unit"]) or "–",
                text(p["side"]),
                "; ".join(flags) or "–",
                text(p["meaning"]),
            ]
        )
        classes.append("under" if p.get("nuisance") else "flagged" if flags else "")
    return table(head, rows, "Parameters, link-referred", classes=classes, wide=True)


def record_html(record: Record) -> str:
    """A record: size, channels with unit and range, source and repairs."""
    import numpy as np

    rows = []
    for key, values in record.channels.items():
        finite = values[np.isfinite(values)]
        span = (
            f"{number(float(finite.min()))} to {number(float(finite.max()))}"
            if finite.size
            else "no finite value"
        )
        rows.append([text(words(key)), pretty_unit(record.unit(key)) or "–", span])
    size = (
        f"{len(record)} samples, {number(record.duration)} s, {len(record.segments())} "
        f"segment(s), every {number(1e3 * record.dt)} ms"
    )
    notes = "".join(f"<li>{text(n)}</li>" for n in record.provenance.notes)
    shown = table(["channel", "unit", "range"], rows, f"{text(record.name)}: {size}")
    return shown + (f"<ul>{notes}</ul>" if notes else "")


def error_html(error: Mapping[str, Any], caption: str) -> str:
    """An error: relative, fit, and each balance with its noise floor."""
    rows = [
        [
            f"{text(n)} balance",
            f"{number(b['rms'], 3)} {pretty_unit(b['unit'])}",
            f"{number(b['floor'], 3)} {pretty_unit(b['unit'])}",
            ratio(b["ratio"]),
        ]
        for n, b in error["balances"].items()
    ]
    whole = (
        f"{caption}: relative error {percent(error['relative_error_percent'])}, fit "
        f"{percent(error['fit_percent'])}"
    )
    return table(["balance", "residual (RMS)", "noise alone", "residual ÷ noise"], rows, whole)


def fit_html(fit: Fit) -> str:
    """A fit: errors and parameters."""
    out = error_html(fit.train.as_json(), f"{text(fit.joint.name)}, training records")
    if fit.held_out is not None:
        out += error_html(fit.held_out.as_json(), "held-out records")
    return spaced(
        f"<div>{out}{parameters_html(fit.parameters)}"
        f"{calibration_html(fit.as_json(), fit.data.train_names)}</div>"
    )


def comparison_html(comparison: Comparison) -> str:
    """A comparison: errors, the most telling places as pictures, the worst window."""
    pictures = [place_picture(p) for p in comparison.places[:SHOWN_PLACES]]
    low, high = comparison.worst_window
    window = f"<p>Worst window: {number(low)} s to {number(high)} s.</p>"
    return spaced(
        f"<div>{error_html(comparison.error.as_json(), text(comparison.name))}{''.join(pictures)}"
        f"{window}</div>"
    )


def warnings_html(warnings: Sequence[str]) -> str:
    """Warnings as a list; nothing where there are none."""
    return f"<ul>{''.join(f'<li>{text(w)}</li>' for w in warnings)}</ul>" if warnings else ""


def diagnosis_html(diagnosis: Diagnosis) -> str:
    """A diagnosis: warnings, claim, ranking, not testable."""
    result = diagnosis.as_json()
    return spaced(
        f"<div>{warnings_html(result['warnings'])}{claims_html(result)}"
        f"{ranking_html(result, diagnosis.ranking.trials, last=10)}"
        f"{not_testable_html(result)}</div>"
    )


def improvement_html(improvement: Improvement) -> str:
    """The loop: verdict, warnings, staircase, ledger, claims, parameters of the last step."""
    result = improvement.as_json()
    parameters = parameters_html(result["steps"][-1]["parameters"]) if result["steps"] else ""
    return spaced(
        f"<div>{verdict_html(result, 3)}{warnings_html(result['warnings'])}"
        f"{staircase_html(result)}{ledger_html(result)}{claims_html(result)}{parameters}"
        f"{calibration_html(result, improvement.data.train_names)}</div>"
    )
