"""The report of a replay: faults along time, reconstructed readings, parameters with their
bands, in one HTML file.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from identification.data.formats import number, pretty_unit, with_error, words
from identification.faults.detector import SENSORS
from workbench.show.replayed import READINGS, UNESTIMATED, Replay
from workbench.show.report import asset, versions
from workbench.show.results import BALANCES, table, text
from workbench.show.track_pictures import (
    SIGMAS,
    WIDTH,
    parameter_picture,
    signal_picture,
    timeline_picture,
    unit_of,
)

if TYPE_CHECKING:
    from identification.data.joint_file import Joint

AROUND: Final = (0.25, 0.75)
"""Seconds before and after a failure that the close view shows."""

_STYLE: Final = """
svg.track { display: block; width: 100%; height: auto; }
svg.track.narrow { max-width: 34rem; }
.along { overflow-x: auto; }
.along svg.track { min-width: 42rem; }
.s-true { stroke: var(--soft); }
.s-bad { fill: var(--before); stroke: none; }
.s-shade { fill: var(--before); stroke: none; }
.s-known { stroke: var(--ink); }
.key.truth { color: var(--soft); }
.verdict ul { margin: 0.3rem 0; padding-left: 1.2rem; }
"""


def _headline(replays: Sequence[Replay]) -> tuple[str, str]:
    """Class and sentence of the verdict."""
    events = [e for r in replays for e in r.events]
    if events:
        return "unexplained", "Something was wrong with the readings or the joint"
    if any(r.watched for r in replays):
        return "nothing_missing", "No sensor fault and no change of the joint"
    return "not_identifiable", "The parameters were followed; sensor faults were not looked for"


def _verdict(replays: Sequence[Replay], notes: Sequence[str]) -> str:
    kind, sentence = _headline(replays)
    items = [
        f"{e['time']:.3f} s: {text(e['text'])} <span class='note'>({text(r.record.name)})</span>"
        for r in replays
        for e in r.events[:12]
    ]
    items += [
        f"{text(r.record.name)}: {len(r.events) - 12} more below"
        for r in replays
        if len(r.events) > 12
    ]
    blind = dict.fromkeys(r.not_watched for r in replays if not r.watched)
    hints = [f"{text(why[:1].upper() + why[1:])}." for why in blind]
    if not blind and not all(r.calibrated for r in replays):
        hints.append(
            "The limits of the fault detector are guesses: give records of the healthy joint "
            "with <code>--healthy</code>."
        )
    hints += [
        f"{text(doubt[:1].upper() + doubt[1:])}."
        for doubt in dict.fromkeys(r.doubt for r in replays if r.doubt)
    ]
    if any(r.tried for r in replays):
        hints.append("The faults shown were put into healthy readings on purpose.")
    hints += [text(n) for n in notes]
    listed = f"<ul>{''.join(f'<li>{i}</li>' for i in items)}</ul>" if items else ""
    return (
        f'<section class="verdict {kind}" '
        f'aria-label="Verdict"><h2>{sentence}</h2>{listed}{"".join(f"<p>{h}</p>" for h in hints)}'
        "</section>"
    )


def _tiles(replays: Sequence[Replay]) -> str:
    seconds = sum(len(r.record) * r.record.dt for r in replays)
    replaced = sum(float(r.failed.any(axis=1).sum()) * r.record.dt for r in replays)
    worst = max((at for r in replays for at in _at_end(r)), default=None)
    tiles = [
        ("followed", f"{number(seconds, 4)} s, every {number(1e3 * replays[0].record.dt, 3)} ms"),
        ("a reading was replaced for", f"{number(replaced, 3)} s" if replaced else "no time"),
        (
            "largest residual at the end, in units of the noise",
            f"{number(worst[0], 3)} ({text(worst[1])} balance)" if worst else "–",
        ),
    ]
    return (
        "<dl class='tiles'>"
        f"{''.join(f'<div><dt>{k}</dt><dd>{v}</dd></div>' for k, v in tiles)}</dl>"
    )


def _wide(picture: str) -> str:
    """A picture that keeps its size on a narrow screen and scrolls there."""
    return (
        '<div class="along" role="region" aria-label="Picture along time" '
        f'tabindex="0"><figure>{picture}</figure></div>'
    )


def _at_end(replay: Replay) -> list[tuple[float, str]]:
    """Residual over the noise at the end, and its balance."""
    return (
        [(float(v), b) for b, v in zip(replay.estimator.balances, replay.ratios[-1], strict=True)]
        if len(replay.time)
        else []
    )


def _timeline_html(replay: Replay) -> str:
    key = (
        '<p class="legend"><span class="key before">■ reading replaced by its estimate, ▼ '
        "report</span>"
    )
    if replay.tried:
        key += '<span class="key">▬ fault put in</span>'
    rows = [[f"{e['time']:.3f} s", text(e["text"]), _delay(replay, e)] for e in replay.events]
    listed = (
        table(["time", "report", "after the fault was put in"], rows, "Reports in their order")
        if rows
        else "<p>No report.</p>"
    )
    return f"{key}</p>{_wide(timeline_picture(replay))}{listed}"


def _delay(replay: Replay, event: dict[str, object]) -> str:
    """Time since the last fault put in before a report."""
    now = float(str(event["time"])) - float(replay.record.time[0])
    before = [f.start for f in replay.tried if f.start <= now + 1e-9]
    return f"{1e3 * abs(now - max(before)):.0f} ms" if before else "–"


def _signals_html(replay: Replay) -> str:
    time = replay.record.time
    whole = (float(time[0]), float(time[-1]))
    out = []
    for i in range(len(READINGS)):
        spans = replay.spans(i)
        if not spans:
            continue
        first = spans[0][0]
        close = (max(first - AROUND[0], whole[0]), min(first + AROUND[1], whole[1]))
        tried = any(f.sensor == SENSORS[i] for f in replay.tried)
        truth = '<span class="key truth">▬ before the fault was put in</span>' if tried else ""
        out.append(
            f"<h3>{text(READINGS[i].capitalize())}</h3><p class='legend'><span class='key "
            "before'>— as it came</span>"
            f"<span class='key after'>— as the estimator went on with it</span>{truth}</p>"
            f"{_wide(signal_picture(replay, i, whole, WIDTH))}"
            f"{_wide(signal_picture(replay, i, close, WIDTH))}"
            f"<figure><figcaption>{_said(replay, i, spans, tried=tried)}</figcaption></figure>"
        )
    return "".join(out)


def _said(
    replay: Replay, reading: int, spans: Sequence[tuple[float, float]], *, tried: bool
) -> str:
    unit = unit_of(replay, reading)
    total = sum(b - a for a, b in spans)
    said = (
        f"Above: the whole record; shaded where the reading is replaced ({len(spans)} "
        f"time(s), {number(total, 4)} s). Below: the first failure from near."
    )
    if tried:
        rows = replay.failed[:, reading]
        error = float(np.max(np.abs(replay.used[rows, reading] - replay.healthy[rows, reading])))
        said += (
            " Largest difference of the estimate from the reading before the fault was put "
            f"in: <strong>{number(error, 3)} {unit}</strong>."
        )
    return said


def _parameters_html(replay: Replay, joint: Joint) -> str:
    if not len(replay.time):
        return f"<p>{UNESTIMATED[0].upper()}{text(UNESTIMATED[1:])}.</p>"
    figures, rows = [], []
    declared = {p.name: p for p in replay.estimator.model.parameters}
    for i, name in enumerate(replay.estimator.names):
        known = joint.fitted.get(name)
        p, first, last, sigma = (
            declared[name],
            replay.values[0, i],
            replay.values[-1, i],
            replay.sigmas[-1, i],
        )
        caption = (
            f"<figcaption><strong>{text(words(name))}</strong>, {text(p.side)} side</figcaption>"
        )
        figures.append(f"<figure>{parameter_picture(replay, i, known)}{caption}</figure>")
        change = f"{100 * (last / known - 1):+.2f} %" if known else "–"
        rows.append(
            [
                text(words(name)),
                with_error(float(last), float(sigma)),
                pretty_unit(p.unit),
                text(p.side),
                number(float(first), 5),
                number(known, 5) if known is not None else "–",
                change,
            ]
        )
    head = [
        "parameter",
        "last value ± standard deviation",
        "unit",
        "side",
        "first",
        "joint file",
        "last against joint file",
    ]
    ratios = ", ".join(
        f"{text(b)} {number(v, 3)} ({text(BALANCES.get(b, ''))})" for v, b in _at_end(replay)
    )
    listed = table(head, rows, "At the end of the record", wide=True)
    return (
        f"<p class='legend'><span class='key after'>— estimate, band of {SIGMAS:g} standard "
        "deviations</span><span class='key'>┄ joint file</span>"
        "<span class='key before'>░ a reading is replaced</span></p><div "
        f"class='grid'>{''.join(figures)}</div>"
        "<div class='scroll' role='region' aria-label='Parameters of "
        f"{text(replay.record.name)}' tabindex='0'>{listed}</div>"
        f"<p class='note'>Residual over the noise at the end: {ratios}. The band holds the noise "
        "of the readings; what the model lacks is not in it.</p>"
    )


def _provenance_html(replays: Sequence[Replay], joint: Joint, command: str | None) -> str:
    rows = []
    for r in replays:
        p = r.record.provenance
        files = (
            "<br>".join(
                f"{text(Path(f).name)}: <code>{text(h)}</code>"
                for f, h in zip(p.paths, p.sha256, strict=False)
            )
            or "in memory"
        )
        rows.append(
            [text(r.record.name), f"{len(r.record)} samples, {number(r.record.duration)} s", files]
        )
    facts = [
        ["joint file", text(Path(joint.source).name) if joint.source else "in memory"],
        [
            "joint",
            f"{text(joint.name)}, {text(joint.kind)}, gear ratio {number(joint.gear_ratio)}, "
            f"model {text(joint.model_name)}",
        ],
        ["versions", ", ".join(f"{text(k)} {text(v)}" for k, v in versions().items())],
        ["made", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")],
    ]
    if command:
        facts.append(["command", f"<code>{text(command)}</code>"])
    return table(["record", "size", "file: SHA-256"], rows, "Records", wide=True) + table(
        ["what", "value"], facts, "How this report was made"
    )


def track_page(
    replays: Sequence[Replay],
    joint: Joint,
    *,
    command: str | None = None,
    notes: Sequence[str] = (),
) -> str:
    """The report as one self-contained HTML document without scripts.

    Parameters
    ----------
    replays : sequence of Replay
        From :func:`workbench.cli.online.replay`; at least one.
    joint : Joint
    command : str, optional
        For the provenance.
    notes : sequence of str
        Warnings about the records.
    """
    sections = []
    for k, r in enumerate(replays):
        where = f" – {r.record.name}" if len(replays) > 1 else ""
        sections.append((f"faults{k}", f"Faults along time{where}", _timeline_html(r)))
        sections.append((f"signals{k}", f"Reconstructed readings{where}", _signals_html(r)))
        sections.append((f"parameters{k}", f"Parameters{where}", _parameters_html(r, joint)))
    sections.append(
        ("provenance", "Where the figures come from", _provenance_html(replays, joint, command))
    )
    shown = [s for s in sections if s[2]]
    links = "".join(f'<li><a href="#{key}">{text(title)}</a></li>' for key, title, _ in shown)
    parts = "".join(
        f'<section id="{k}" aria-labelledby="{k}-title"><h2 '
        f'id="{k}-title">{text(t)}</h2>{body}</section>'
        for k, t, body in shown
    )
    style = asset("report.css") + _STYLE
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; style-src '
        f"'sha256-{digest}'; base-uri 'none'; form-action 'none'\">"
        '<meta name="viewport" content="width=device-width, initial-scale=1"><meta '
        'name="color-scheme" content="light dark">'
        f"<title>{text(joint.name)}: online replay</title><style>{style}</style></head><body>"
        '<a class="skip" href="#faults0">Skip to the figures</a><header><p '
        f'class="eyebrow">Online replay</p><h1>{text(joint.name)}</h1></header>'
        f"<main>{_verdict(replays, notes)}{_tiles(replays)}<nav "
        f'aria-label="Contents"><ul>{links}</ul></nav>{parts}</main></body></html>\n'
    )
