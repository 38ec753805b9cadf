"""The report: one self-contained HTML file that opens offline."""

from __future__ import annotations

import base64
import hashlib
import json
import platform
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib import metadata, resources
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from identification.data.formats import number, percent, ratio
from identification.data.record import Record
from identification.diagnosis.compare import Comparison
from identification.diagnosis.improve import Improvement
from identification.errors import InputError
from identification.fitting.trust import Trust
from irj_fmu.command_line import replace_file
from workbench.show import first_page, fragments
from workbench.show.beside import beside_html
from workbench.show.ceiling import ceiling_html
from workbench.show.pictures import place_picture
from workbench.show.plots import ReportPlots, overlay_json, report_plots
from workbench.show.results import (
    calibration_html,
    claims_html,
    error_html,
    floor_percent,
    ledger_html,
    not_testable_html,
    parameters_html,
    ranking_html,
    stairs_of,
    text,
    verdict_html,
    warnings_html,
)
from workbench.show.trusted import trusted_html
from workbench.show.words import kind_of

if TYPE_CHECKING:
    from identification.variants.exploration import Exploration

RANKED_SHOWN: Final = 8
PACKAGES: Final = ("irj", "casadi", "numpy", "scipy")


def write_report(
    improvement: Improvement,
    to: str | Path,
    *,
    records: Sequence[Record] = (),
    command: str | None = None,
    trust: Trust | None = None,
    exploration: Exploration | None = None,
    author: str = "",
    notes: str = "",
    beside: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> Path:
    """Write the report of an improvement as one HTML file.

    Parameters
    ----------
    improvement : Improvement
        From :func:`identification.diagnosis.improve`.
    to : str or Path
        The file; an existing one is replaced once the new one is complete, what a link points to
        likewise.
    records : sequence of Record
        The records as they were read: their file names and digests go into the provenance.
    command : str, optional
        The command that made it, for the provenance.
    trust : Trust, optional
        Which number of the last step to trust, for a table.
    exploration : Exploration, optional
        All variants of the model on the same records, for a section.
    author, notes : str
        For the first page; lines of the notes are kept.
    beside : mapping of str to mapping
        Results of other sessions, dates or joints, by name
        (:func:`workbench.show.beside.read_result`).

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    InputError
        The folder does not exist or cannot be written, or the disk is full.
    """
    path = Path(to)
    page = render_report(
        improvement,
        records=records,
        command=command,
        trust=trust,
        exploration=exploration,
        author=author,
        notes=notes,
        beside=beside,
    )
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file, as {path / 'report.html'}")
    replace_file(path, lambda stream: stream.write(page.encode("utf-8", "backslashreplace")))
    return path


def render_report(
    improvement: Improvement,
    *,
    records: Sequence[Record] = (),
    command: str | None = None,
    trust: Trust | None = None,
    exploration: Exploration | None = None,
    author: str = "",
    notes: str = "",
    beside: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> str:
    """The report as text (see :func:`write_report`)."""
    result = improvement.as_json()
    plots = report_plots(improvement, records)
    name = improvement.joint.name
    sections = [s for s in _sections(improvement, result, plots, records) if s[2]]
    if beside and result["steps"]:
        sections.append(("beside", "Beside other results", beside_html(result, beside)))
    if exploration is not None:
        from workbench.show.front import exploration_section

        sections.append(("variants", "All variants of the model", exploration_section(exploration)))
    if trust is not None:
        sections.append(("trust", "Which number to trust", trusted_html(trust)))
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    sections.append(
        (
            "provenance",
            "Where the figures come from",
            fragments.provenance_html(improvement, records, versions(), command, made),
        )
    )
    sections.append(("words", "What the words mean", fragments.glossary_html()))
    links = "".join(f'<li><a href="#{key}">{text(title)}</a></li>' for key, title, _ in sections)
    parts = "".join(
        f'<section id="{key}" aria-labelledby="{key}-title"><h2 '
        f'id="{key}-title">{text(title)}</h2>{body}</section>'
        for key, title, body in sections
    )
    pair = first_page.pair_html(improvement, result, plots) if plots else ""
    by = f"{text(author)}, {made}" if author else made
    paragraphs = "".join(f"<p>{text(n)}</p>" for n in notes.splitlines() if n.strip())
    said = f'<section class="notes" aria-label="Notes">{paragraphs}</section>' if notes else ""
    front = (
        f'<section class="verdict {kind_of(result)}" aria-label="Verdict">{verdict_html(result)}'
        f"{warnings_html(result['warnings'])}</section>{_tiles(result)}{said}{pair}"
        f'<section class="law" aria-label="The law">{first_page.law_html(improvement, result)}'
        '</section><section class="next" aria-label="What to measure next">'
        f"{first_page.next_html(improvement, result)}</section>"
    )
    body = (
        '<a class="skip" href="#details">Skip to the details</a><header><p class="eyebrow">Joint '
        f'report · {by}</p><h1>{text(name)}</h1></header><main><div class="front">'
        f'{_scrollable(front)}</div><nav id="details" aria-label="Contents"><ul>{links}</ul></nav>'
        f"{_scrollable(parts, 100)}</main>"
    )
    return _page(
        f"{name}: joint report",
        body,
        overlay_json(plots.overlays) if plots else [],
        len(result["steps"]) > 1,
    )


def render_comparison(comparison: Comparison) -> str:
    """A comparison as a document: errors, every place at which the model may fail, what linear
    models would explain.
    """
    low, high = comparison.worst_window
    pictures = "".join(f"<figure>{place_picture(p)}</figure>" for p in comparison.places)
    errors = error_html(comparison.error.as_json(), text(comparison.name))
    linear = ceiling_html(comparison.linear) if comparison.linear else ""
    body = (
        f'<header><p class="eyebrow">Model against record</p><h1>{text(comparison.name)}</h1>'
        f"</header><main>{warnings_html(comparison.warnings)}{_scrollable(errors)}"
        f"<p>Worst window: {number(low)} s to {number(high)} s.</p>"
        f'<h2>Where the model fails</h2><div class="grid">{pictures}</div>{linear}</main>'
    )
    return _page(f"{comparison.name}: comparison", body, [], added=False)


def _sections(
    improvement: Improvement,
    result: dict[str, Any],
    plots: ReportPlots | None,
    records: Sequence[Record],
) -> list[tuple[str, str, str]]:
    """Key, title and body of each section, in reading order; empty ones are left out by the
    caller.
    """
    trials = improvement.ranking.trials if improvement.ranking else ()
    where = "held-out records" if plots is not None and plots.on_held_out else "training records"
    effort = "force" if improvement.joint.kind == "linear" else "torque"
    ledger = f"{ledger_html(result)}<p class='note'>{_ledger_note(result, effort)}</p>"
    ranked = ""
    if result["ranking"]:
        rest = len(result["ranking"]) - RANKED_SHOWN
        ranked = ranking_html(result, trials, last=RANKED_SHOWN)
        if rest > 0:
            ranked += (
                f"<details><summary>{rest} "
                "more</summary>"
                f"{ranking_html(result, trials, first=RANKED_SHOWN, caption='The others')}"
                "</details>"
            )
        ranked += (
            "<p class='note'>Grey: under the threshold, so not to be told from chance or too "
            "small to matter. Each effect is tried alone "
            "and in a quick way, so falls do not add up; the fall of a claim above is the one "
            "after the whole fit.</p>"
        )
    final = result["steps"][-1]["parameters"] if result["steps"] else {}
    start = result["steps"][0]["parameters"] if len(result["steps"]) > 1 else None
    return [
        ("joint", "The joint and its motion", first_page.joint_html(improvement, records)),
        ("ledger", "How far the model is from the measurements", ledger if result["steps"] else ""),
        (
            "places",
            "Where the start model fails",
            fragments.places_html(improvement, plots) if plots else "",
        ),
        (
            "torque",
            f"Measured and modelled {effort}",
            _overlay(plots, where, effort) if plots else "",
        ),
        ("pattern", "Physics or sensor?", fragments.pattern_html(improvement)),
        (
            "missing",
            "What is missing",
            claims_html(result) + fragments.minor_html(improvement) + ranked,
        ),
        (
            "additions",
            "Before and after each addition",
            fragments.additions_html(improvement, plots) if plots and plots.additions else "",
        ),
        ("lines", "Lines", fragments.lines_html(improvement.lines)),
        (
            "unexplained",
            "What is left unexplained",
            fragments.unexplained_html(improvement) if result["steps"] else "",
        ),
        ("frequency", "Frequency response", fragments.frequency_html(plots) if plots else ""),
        (
            "linear",
            "What a linear model would explain",
            fragments.linear_html(plots) if plots else "",
        ),
        ("untested", "What these records cannot show", not_testable_html(result)),
        ("equations", "The model as formulas", first_page.equations_html(improvement)),
        (
            "parameters",
            "Parameters",
            parameters_html(final, start) + _parameter_note(effort) if final else "",
        ),
        (
            "calibration",
            "Calibration found",
            calibration_html(result, improvement.data.train_names) if result["steps"] else "",
        ),
    ]


def _tiles(result: dict[str, Any]) -> str:
    """Three figures at a glance."""
    if not result["steps"]:
        return ""
    steps = stairs_of(result)
    first, last = steps[0]["held_out"], steps[-1]["held_out"]
    floor = floor_percent(last)
    names = ", ".join(
        f"<span class='nowrap'>{text(b)} {ratio(e['ratio'])}</span>"
        for b, e in last["balances"].items()
    )
    before = f"{percent(first['relative_error_percent'])} → " if len(steps) > 1 else ""
    tiles = [
        (
            "error on records the fit never saw",
            f"{before}{percent(last['relative_error_percent'])}",
        ),
        ("what measurement noise alone would leave", percent(floor, 2)),
        ("what is left, in units of the noise", names or "–"),
    ]
    return (
        "<dl class='tiles'>"
        f"{''.join(f'<div><dt>{k}</dt><dd>{v}</dd></div>' for k, v in tiles)}</dl>"
    )


def _ledger_note(result: dict[str, Any], effort: str) -> str:
    note = text(result["records"].get("note") or "")
    return (
        f"Error: size of the residual {effort} as a share of the measured {effort}, over all "
        "balances. "
        "Fit: 100 % is a perfect model, 0 % no better than a constant. "
        "÷ noise: residual over what measurement noise alone would leave; 1 × cannot be "
        "improved. The dotted line of the staircase is that noise. "
        "The fit never saw the held-out records; they confirm or refuse each addition."
        + (f" Note: {note}." if note else "")
    )


def _parameter_note(effort: str) -> str:
    referred = (
        "" if effort == "force" else "Torques, angles and inertias are referred to the link. "
    )
    return (
        f"<p class='note'>{referred}The standard error comes from the scatter between time "
        "blocks and, for inertias and "
        "stiffness, from what noise of the positions takes off them; a true value more than "
        "three standard errors away is unlikely if the "
        "model is complete. "
        "A value that stands at its bound, is not identifiable, or moves together with another "
        "one should not be read as physics.</p>"
    )


def _overlay(plots: ReportPlots, where: str, effort: str) -> str:
    return (
        f"<p>{effort.capitalize()} of a balance on {where}, as measured and as the models give "
        "it<span class='screen-only'>. It opens on the window in which the start model is worst; "
        "the lowest plot shows the whole record: drag across it to choose another window</span>"
        "<span class='print-only'>, in the window in which the start model is worst</span>."
        f"{fragments.breaks_said(plots.overlays)}</p>{fragments.overlay_html(plots.overlays)}"
    )


def _scrollable(body: str, first: int = 1) -> str:
    """Tables in regions that scroll by themselves on a narrow screen and can be reached by
    keyboard.
    """
    numbers = count(first)

    def wrapped(found: re.Match[str]) -> str:
        return (
            f'<div class="scroll" role="region" aria-label="Table {next(numbers)}" '
            f'tabindex="0">{found.group()}</div>'
        )

    return re.sub(r"<table\b.*?</table>", wrapped, body, flags=re.DOTALL)


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide the figures."""
    out = {"Python": platform.python_version()}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            out[package] = metadata.version(package)
    if "irj" not in out:
        from identification import __version__

        out = {"irj": __version__, **out}
    return out


def asset(name: str) -> str:
    """Text of a file in the package's assets."""
    return (resources.files("workbench") / "assets" / name).read_text(encoding="utf-8")


def _digest(content: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()


def json_for_html(data: Any) -> str:
    """JSON that can stand inside a script element."""
    dumped = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return dumped.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _page(title: str, body: str, overlays: list[dict[str, Any]], added: bool) -> str:
    """The whole document; its policy allows its own script and style by digest and nothing else."""
    style = asset("uPlot.min.css") + asset("report.css")
    script = asset("uPlot.iife.min.js") + asset("report.js")
    policy = (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    data = json_for_html({"added": added, "overlays": overlays})
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><meta '
        'name="color-scheme" content="light dark">'
        f"<title>{text(title)}</title><style>{style}</style></head><body>{body}"
        '<script type="application/json" '
        f'id="report-data">{data}</script><script>{script}</script></body></html>\n'
    )
