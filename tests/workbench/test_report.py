"""The report: complete, balanced, offline, escaped, decimated, written at once or not at all."""

from __future__ import annotations

import base64
import csv
import hashlib
import html
import io
import json
import os
import re
from collections.abc import Mapping
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from identification.data.formats import interval, number, pretty_unit, ratio, with_error
from identification.data.joint_file import Joint
from identification.data.record import Provenance, Record
from identification.diagnosis.candidates import NotTestable
from identification.diagnosis.claims import Claim
from identification.diagnosis.compare import compare
from identification.diagnosis.diagnose import diagnose
from identification.diagnosis.improve import Improvement, improve
from identification.diagnosis.lines import Line
from identification.diagnosis.locate import Unexplained
from identification.diagnosis.outcome import OUTCOMES
from identification.diagnosis.places import AXIS_TITLES, worst_window
from identification.errors import InputError
from identification.fitting.fit import fit
from workbench.cli.loop import results_beside
from workbench.show import results as fragments_html
from workbench.show.beside import read_result
from workbench.show.chart import ticks
from workbench.show.fragments import pattern_of
from workbench.show.pictures import axis_label, place_chart, staircase_picture
from workbench.show.plots import (
    Overlay,
    decimated,
    explained,
    overlay_json,
    report_plots,
)
from workbench.show.report import json_for_html, render_report, write_report
from workbench.show.results import effort_of, floor_percent
from workbench.show.words import OUTCOME_WORDS, kind_of, title_of

EVIL = "<script>alert('x')</script>&\"</title>"
VOID = {"meta", "br", "wbr", "img", "input", "hr", "link"}


def swing(seed: int, name: str, *, coulomb: float = 1.0) -> Record:
    """An axis seen from one side, with Coulomb friction that the model does not have."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 20, 0.002)
    f = 0.2 + 0.05 * seed
    w1, w2 = 2 * np.pi * f, 2 * np.pi * 2.7 * f
    q = 0.9 * np.sin(w1 * time) + 0.3 * np.sin(w2 * time + seed)
    v = 0.9 * w1 * np.cos(w1 * time) + 0.3 * w2 * np.cos(w2 * time + seed)
    a = -0.9 * w1**2 * np.sin(w1 * time) - 0.3 * w2**2 * np.sin(w2 * time + seed)
    torque = 2.0 * a + 1.5 * v + coulomb * np.tanh(v / 0.01) + 0.05 * rng.standard_normal(len(time))
    channels = {"motor_torque": torque, "motor_position": q + 1e-5 * rng.standard_normal(len(time))}
    seen = Provenance(
        (f"data/{name}.csv",),
        (hashlib.sha256(name.encode()).hexdigest(),),
        "csv",
        (f"time from {name}",),
        ("nothing repaired",),
    )
    return Record.from_channels(time, channels, name=name, provenance=seen)


@pytest.fixture(scope="module")
def records() -> list[Record]:
    return [swing(1, "train"), swing(2, "held out <i>")]


@pytest.fixture(scope="module")
def improvement(records: list[Record]) -> Improvement:
    joint = Joint(name=EVIL, effects=("viscous",), source=f"folder/{EVIL}.toml")
    return improve(records[:1], joint, records[1:])


@pytest.fixture(scope="module")
def page(improvement: Improvement, records: list[Record]) -> str:
    return render_report(
        improvement, records=records, command="irj improve 'a & b.csv' --joint <joint>.toml"
    )


class Outline(HTMLParser):
    """Checks that tags are balanced; collects text, ids and attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> without a beginning"
        assert self.open.pop() == tag, f"</{tag}> out of turn"

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in ("script", "style"):
            self.text.append(data)


def outline(text: str) -> Outline:
    parsed = Outline()
    parsed.feed(text)
    parsed.close()
    assert parsed.open == []
    return parsed


def data_of(text: str) -> dict[str, Any]:
    found = re.search(
        r'<script type="application/json" id="report-data">(.*?)</script>', text, re.DOTALL
    )
    assert found
    return dict(json.loads(found.group(1)))


def test_the_loop_found_the_friction(improvement: Improvement) -> None:
    assert improvement.added == ("coulomb",)


def test_balanced_with_unique_ids_and_targets_that_exist(page: str) -> None:
    parsed = outline(page)
    ids = [a["id"] for _, a in parsed.tags if "id" in a]
    assert len(ids) == len(set(ids))
    targets = [str(a["href"])[1:] for t, a in parsed.tags if t == "a"] + [
        str(a["aria-labelledby"]) for _, a in parsed.tags if "aria-labelledby" in a
    ]
    assert set(targets) <= set(ids)
    assert ("html", {"lang": "en"}) in parsed.tags
    assert all(a.get("aria-label") for t, a in parsed.tags if t == "svg")
    assert all("aria-label" in a or a.get("data-do") for t, a in parsed.tags if t == "button")


def test_opens_offline(page: str) -> None:
    parsed = outline(page)
    for tag, attributes in parsed.tags:
        assert tag not in ("link", "iframe", "object", "embed", "base", "form")
        assert not {"src", "srcset", "action", "data"} & set(attributes)
        assert str(attributes.get("href", "#")).startswith("#")
    style = "".join(re.findall(r"<style>(.*?)</style>", page, re.DOTALL))
    assert "url(" not in style
    assert "@import" not in style
    assert len(page.encode()) < 1_500_000


def test_policy_allows_only_its_own_script_and_style(page: str) -> None:
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)
    assert policy
    said = html.unescape(policy.group(1))
    assert "default-src 'none'" in said
    assert "unsafe" not in said
    for tag in ("script", "style"):
        bodies = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        assert len(bodies) == 1
        digest = base64.b64encode(hashlib.sha256(bodies[0].encode()).digest()).decode()
        assert f"'sha256-{digest}'" in said
    for _, attributes in outline(page).tags:
        assert "style" not in attributes
        assert not [a for a in attributes if a.startswith("on")]


def test_says_the_verdict_and_every_claim(page: str, improvement: Improvement) -> None:
    text = " ".join("".join(outline(page).text).split())
    assert " ".join(improvement.reason.split()) in text
    assert "Coulomb friction" in text
    for name in (
        "Where the start model fails",
        "Physics or sensor?",
        "What is left unexplained",
        "Before and after each addition",
    ):
        assert name in text
    for step in improvement.steps:
        assert f"{number(step.held_out.relative_error_percent, 3)}\u00a0%".replace(
            "\u00a0", " "
        ) in text.replace("\u00a0", " ")
    for key in improvement.steps[-1].solution.model.parameter_names:
        if key != "drive_delay_0":
            assert key.replace("_", " ") in text


def test_says_where_the_figures_come_from(page: str, records: list[Record]) -> None:
    for record in records:
        assert record.provenance.sha256[0] in page
        assert html.escape(record.name) in page
    assert "irj improve" in page
    assert "numpy" in page
    assert "data/train.csv" not in page, "names of files, not of folders"


def test_names_are_escaped(page: str) -> None:
    assert "<script>alert" not in page
    assert "<i>" not in page
    assert html.escape(EVIL) in page
    assert page.count("<script") == 2
    assert all(c not in json.dumps(data_of(page)).replace("held out <i>", "") for c in "<>")
    raw = re.search(r'id="report-data">(.*?)</script>', page, re.DOTALL)
    assert raw
    assert "<" not in raw.group(1)


def everything(improvement: Improvement) -> Improvement:
    """The same result with all that can occur: a set, minor ones, lines, warnings, a rest."""
    claim = replace(
        improvement.claims[0],
        effects=("coulomb", "stribeck"),
        separate_by=f"slow runs {EVIL}",
        partial=True,
    )
    return replace(
        improvement,
        claims=(claim,),
        minor=(Claim(("stribeck",), "stribeck@motor", "axis", 3.1),),
        lines=(
            Line(3.37, 0.02, 0.4, "axis", 55.0, (), 1.2),
            Line(2.0, 0.02, 0.8, "axis", 90.0, ("kinematic_error",), 2.0),
        ),
        unexplained=(
            Unexplained(
                "axis", 61.0, "link_position", 0.35, 0.75, "rad", rms=1.2, by_direction=True
            ),
            Unexplained("axis", 3.0, order=3.37, rms=0.1),
            Unexplained("axis", 3.0, frequency_hz=11.7, rms=0.1),
            Unexplained("axis", 0.0, rms=0.1),
        ),
        verdict="unexplained",
        warnings=(f"triangle only {EVIL}",),
        not_testable=(NotTestable("thermal_friction", f"too short {EVIL}"),),
    )


def test_the_first_page_tells_all(improvement: Improvement, records: list[Record]) -> None:
    text = render_report(
        improvement, records=records, author=f"A. Smith\x07\x9b {EVIL}", notes="new\0 oil\ncold"
    )
    front = text[text.index('<div class="front">') : text.index('<nav id="details"')]
    said = " ".join("".join(outline(front).text).split())
    assert "Found what was missing" in said
    assert "What to measure next" in said
    assert '<section class="verdict found"' in front
    assert front.count('<svg class="picture"') == 2, "the staircase, and the place that told"
    floor = floor_percent(improvement.as_json()["steps"][-1]["held_out"])
    assert f"noise alone: {number(floor, 2)} %" in said, "the noise floor on the staircase"
    assert "coulomb·tanh(" in said, "the law as a formula"
    parameters = improvement.as_json()["steps"][-1]["parameters"]
    value = next(v for k, v in parameters.items() if "coulomb" in k)
    assert with_error(value["value"], value["stderr"]) in said, "and in numbers"
    assert "s-law" in front, "drawn through the residual"
    assert r"new\x00 oil" in said
    assert not re.search(r"[\0-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]", text), "no control character"
    assert rf"A. Smith\x07\x9b {html.escape(EVIL, quote=True)}" in text


def test_a_set_stays_a_set_in_every_part(improvement: Improvement) -> None:
    shown = replace(everything(improvement), verdict="complete")
    result = shown.as_json()
    assert kind_of(result) == "set"
    both = "Coulomb friction or Stribeck effect"
    assert both in fragments_html.ledger_html(result)
    text = render_report(shown)
    said = " ".join("".join(outline(text).text).split())
    assert "as one of several names" in said
    assert said.count(both) >= 4, "staircase, law, ledger, addition"
    assert '<section class="verdict set"' in text


def test_every_axis_of_every_chart_says_its_side(
    improvement: Improvement, records: list[Record]
) -> None:
    text = render_report(improvement, records=records)
    labels = re.findall(r"<text[^>]*>([^<]*\[[^<]*\])</text>", text)
    assert len(labels) > 10
    sideless = ("[s]", "[Hz]", "[K]", "[dB]", "[°]")
    for label in labels:
        unit = label[label.rindex("[") :]
        assert unit in sideless or re.search(r"\b(motor|gear|link)\b", label), label
    for axis in AXIS_TITLES:
        shown = str(axis_label(axis, AXIS_TITLES[axis], "rad"))
        assert axis in ("time", "temperature") or "at the" in shown or "referred to" in shown


def test_a_chart_and_its_table_hold_the_same_points(improvement: Improvement) -> None:
    plots = report_plots(improvement)
    assert plots is not None
    step = plots.additions[0]
    law = explained(step.before, step.after)
    chart = place_chart(step.before, step.after, law=law)
    rows = list(csv.reader(io.StringIO(chart.csv())))
    assert rows[0][1] == "motor velocity, referred to the link [rad/s]"
    drawn = {name: [float(r[2]) for r in rows[1:] if r[0] == name] for name in ("before", "law")}
    assert np.allclose(drawn["before"], step.before.branches[0].mean, rtol=1e-8)
    assert np.allclose(drawn["law"], drawn["before"] - step.after.branches[0].mean, atol=1e-8)
    frame = chart.frame()
    assert frame is not None
    assert frame.y[0] == -frame.y[1]


def test_another_result_stands_beside_with_what_moved(
    improvement: Improvement, records: list[Record], tmp_path: Path
) -> None:
    joint = replace(improvement.joint, name="next week")
    later = improve([swing(3, "later", coulomb=1.4)], joint, [swing(4, "held later", coulomb=1.4)])
    file = tmp_path / "later.json"
    file.write_text(json.dumps(later.as_json()), encoding="utf-8")
    (tmp_path / "before").mkdir()
    (tmp_path / "before" / file.name).write_text(file.read_text(encoding="utf-8"), encoding="utf-8")
    both = results_beside([str(file), str(tmp_path / "before" / file.name)])
    assert len(both) == 2, "two files of one name"
    assert list(results_beside([str(file)])) == [file.name]
    page = render_report(improvement, beside={EVIL: read_result(file)})
    outline(page)
    assert "<script>alert" not in page
    rows = re.search(r'<section id="beside".*?</section>', page, re.DOTALL)
    assert rows
    marked = re.findall(r'<tr class="flagged"><th scope="row">([^<]*)</th>', rows[0])
    assert [m for m in marked if "coulomb" in m], "the friction that changed"
    assert not [m for m in marked if "inertia" in m], "what did not change is not marked"
    other = tmp_path / "other.json"
    other.write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match="no result of"):
        read_result(other)


def test_no_internal_name_is_shown() -> None:
    assert title_of("stribeck@motor") == "Stribeck effect (motor)"
    assert title_of("sinusoidal#2") == title_of("sinusoidal")
    assert "#" not in title_of("drive#0")
    assert set(OUTCOMES) <= set(OUTCOME_WORDS)


def test_sets_lines_rest_and_warnings_are_shown(improvement: Improvement) -> None:
    text = render_report(everything(improvement))
    parsed = outline(text)
    said = " ".join("".join(parsed.text).split())
    assert "<script>alert" not in text
    assert "cannot tell these names apart" in said
    assert "Next run: slow runs" in said
    assert "only part of what is missing" in said
    assert "3.37 ± 0.02 per motor turn" in said
    assert (
        "61 % of it depend on the link position, differently in the two directions of motion, "
        "mostly at 0.35 to 0.75 rad" in said
    )
    assert "peaks at 11.7 Hz" in said
    assert "depends on no measured signal" in said
    assert "triangle only" in said
    assert "too short" in said
    assert "Small but certain" in said
    assert "digests were not handed" in said


def test_without_additions(records: list[Record], improvement: Improvement) -> None:
    bare = replace(
        improvement,
        steps=improvement.steps[:1],
        claims=(),
        verdict="nothing_missing",
        reason="Nothing.",
    )
    text = render_report(bare)
    said = " ".join("".join(outline(text).text).split())
    assert "Nothing is missing" in said
    assert "Before and after" not in said
    assert data_of(text)["added"] is False


def test_without_a_fit(improvement: Improvement) -> None:
    none = replace(
        improvement,
        steps=(),
        claims=(),
        ranking=None,
        final_ratios={},
        verdict="not_identifiable",
        reason="The motor never reverses.",
    )
    text = render_report(none)
    said = " ".join("".join(outline(text).text).split())
    assert "The motor never reverses." in said
    assert "These records cannot answer the question" in said


def test_greyed_are_exactly_those_under_the_threshold(improvement: Improvement) -> None:
    result = improvement.as_json()
    table = fragments_html.ranking_html(result)
    rows = re.findall(r"<tr( class=\"under\")?><th scope=\"row\">(\d+)\. ", table)
    expected = [
        not r["significant"] and r["effect"] not in improvement.added for r in result["ranking"]
    ]
    assert [bool(c) for c, _ in rows] == expected
    assert any(expected)
    assert not all(expected)


def test_before_and_after_of_the_addition(improvement: Improvement) -> None:
    plots = report_plots(improvement)
    assert plots is not None
    step = plots.additions[0]
    assert (step.effect, step.before.axis) == ("coulomb", "motor_velocity")
    before = max(float(np.abs(b.mean).max()) for b in step.before.branches)
    after = max(float(np.abs(b.mean).max()) for b in step.after.branches)
    assert after < 0.2 * before
    assert plots.places[0][0].axis == "motor_velocity"
    assert plots.on_held_out


def test_overlay_is_measured_minus_residual(improvement: Improvement) -> None:
    plots = report_plots(improvement)
    assert plots is not None
    shown = plots.overlays[0]
    w = improvement.data.held_out[0]
    drawn = np.isfinite(shown.measured)
    assert np.array_equal(drawn, w.taking(shown.balance))
    assert np.allclose(shown.measured[drawn], w.averaged["drive"][drawn])
    assert np.nanstd(shown.measured - shown.final) < 0.3 * np.nanstd(shown.measured - shown.start)
    assert shown.window[1] - shown.window[0] == pytest.approx(40 * improvement.data.kernel, rel=0.1)


def long_overlay(rows: int = 50_000) -> Overlay:
    time = np.arange(rows) * 0.01
    rng = np.random.default_rng(2)
    measured = np.sin(time) + 0.01 * rng.standard_normal(rows)
    start = measured.copy()
    start[31_234] -= 7.0
    return Overlay(
        "motor",
        "long",
        "N.m",
        time,
        measured,
        start,
        measured,
        worst_window(time, (measured - start) ** 2, 2.0),
    )


def test_plots_are_decimated_with_their_extremes_kept() -> None:
    overlay = long_overlay()
    data = overlay.as_json(2000)
    assert all(len(c) <= 2000 for c in data["data"])
    assert (data["rows"], data["shown"]) == (50_000, 2000)
    assert max(data["data"][4]) == pytest.approx(7.0, rel=1e-3), "a single row of 50 000 is seen"
    assert data["window"][0] - 1e-6 <= overlay.time[31_234] <= data["window"][1] + 1e-6
    assert max(data["detail"][4]) == pytest.approx(7.0, rel=1e-3)
    assert np.all(np.diff(data["data"][0]) > 0)
    many = json.dumps(overlay_json([overlay] * 30))
    assert len(many) < 1_300_000


def test_short_curves_are_left_alone() -> None:
    time, y = np.arange(100.0), np.sin(np.arange(100.0))
    t, (kept,) = decimated(time, [y], 200)
    assert t is time
    assert kept is y


def test_worst_window_is_the_largest() -> None:
    time = np.arange(0, 10, 0.1)
    residual = np.where((time > 6.0) & (time < 6.95), 1.0, 0.1)
    low, high = worst_window(time, residual**2, 1.0)
    assert low == pytest.approx(6.0, abs=0.15)
    assert high == pytest.approx(6.9, abs=0.15)
    # the same samples as two runs: no window reaches from one into the other
    parted = worst_window(time, residual**2, 1.0, (time > 6.45).astype(np.int64))
    assert parted[1] <= 6.45 or parted[0] > 6.4
    assert worst_window(time, np.where(time < 5, np.nan, residual**2), 1.0) == (low, high)


@pytest.mark.parametrize(
    ("over", "points_to"),
    [
        ((), "No balance"),
        (("motor",), "motor side"),
        (("link",), "link side"),
        (("transmission",), "transmission itself"),
        (("motor", "link", "transmission"), "torque sensor"),
        (("link", "transmission"), "link position sensor"),
        (("motor", "transmission"), "motor position sensor"),
        (("motor", "link"), "one on each side"),
    ],
)
def test_pattern_of_the_balances(over: tuple[str, ...], points_to: str) -> None:
    ratios = {b: 20.0 if b in over else 1.0 for b in ("motor", "link", "transmission")}
    hit, meaning = pattern_of(ratios)
    assert hit == frozenset(over)
    assert points_to in meaning


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (0.0, "0"),
        (1.5376, "1.538"),
        (-0.00028, "−0.00028"),
        (21513.0, "21513"),
        (1.174e9, "1.174 × 10⁹"),
        (2.8e-5, "2.8 × 10⁻⁵"),
        (float("nan"), "–"),
        (float("inf"), "∞"),
        (None, "–"),
        (100.0, "100"),
    ],
)
def test_numbers(value: float | None, expected: str) -> None:
    assert number(value) == expected


def test_values_with_errors_ratios_and_units() -> None:
    assert with_error(94.9559, 0.1894) == "94.96 ± 0.19"
    assert with_error(-39.371, 0.845) == "−39.37 ± 0.84"
    assert with_error(3.3543e8, 2.1e6) == "(3.354 ± 0.021) × 10⁸"
    assert with_error(3.0, None) == "3"
    assert ratio(0.996) == "1.00\u00a0×"
    assert ratio(132.4) == "132\u00a0×"
    assert pretty_unit("N.m.s2/rad2") == "N·m·s²/rad²"
    assert pretty_unit("1") == ""
    assert interval(6.4e-6, 0.157) == "0.000 to 0.157"
    assert interval(-1e-9, 0.5) == "0.00 to 0.50"
    assert interval(-0.5, 0.75) == "−0.50 to 0.75"


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-6.3, 6.1), (1e-5, 3e-5), (0.0, 4321.0)])
def test_ticks_are_round_and_few(low: float, high: float) -> None:
    found = ticks(low, high)
    assert 2 <= len(found) <= 6
    assert all(low - 1e-9 <= t <= high + 1e-9 for t in found)
    assert np.allclose(np.diff(found), found[1] - found[0])


def test_json_cannot_end_its_element() -> None:
    text = json_for_html({"name": "</script><!--", "x": [1.5]})
    assert "<" not in text
    assert json.loads(text) == {"name": "</script><!--", "x": [1.5]}


def test_written_whole_in_a_folder_with_spaces_and_umlauts(
    tmp_path: Path, improvement: Improvement, records: list[Record]
) -> None:
    folder = tmp_path / "Größe und Maß"
    folder.mkdir()
    path = write_report(improvement, folder / "Gelenk 3 – Bericht.html", records=records)
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    write_report(improvement, path)
    assert [p.name for p in folder.iterdir()] == [path.name]


def test_a_failed_write_leaves_the_old_file(
    tmp_path: Path, improvement: Improvement, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "report.html"
    path.write_text("old", encoding="utf-8")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match="No space left"):
        write_report(improvement, path)
    assert path.read_text(encoding="utf-8") == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_unusable_places_are_said_in_one_line(tmp_path: Path, improvement: Improvement) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    for target in (tmp_path / "missing" / "r.html", tmp_path / "file" / "r.html", tmp_path):
        with pytest.raises(InputError) as caught:
            write_report(improvement, target)
        assert "\n" not in str(caught.value)
        assert str(target) in str(caught.value)


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere"
)
def test_a_folder_without_permission(tmp_path: Path, improvement: Improvement) -> None:
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(InputError, match="cannot be written"):
            write_report(improvement, tmp_path / "r.html")
    finally:
        tmp_path.chmod(0o700)


def test_notebook_fragments(records: list[Record], improvement: Improvement) -> None:
    joint = Joint(name=EVIL, effects=("viscous",))
    first = fit(joint, records[0], held_out=records[1:])
    shown: Mapping[str, str] = {
        "record": fragments_html.record_html(records[1]),
        "fit": fragments_html.fit_html(first),
        "comparison": fragments_html.comparison_html(compare(first, records[1])),
        "diagnosis": fragments_html.diagnosis_html(diagnose(first, records[1])),
        "improvement": fragments_html.improvement_html(improvement),
    }
    for name, fragment in shown.items():
        tags = {t for t, _ in outline(fragment).tags}
        assert "table" in tags, name
        assert not tags & {"script", "style", "i"}, name
    assert "Coulomb friction" in shown["diagnosis"]
    assert "svg" in shown["comparison"]
    assert "held out &lt;i&gt;" in shown["record"]


def test_the_staircase_of_a_linear_axis_is_one_of_forces() -> None:
    error = {"balances": {"axis": {"unit": "N"}}}
    assert effort_of(error) == "force"
    assert effort_of({"balances": {"motor": {"unit": "N.m"}}}) == "torque"
    said = staircase_picture([5.0, 1.0], 0.5, (), 640, effort_of(error))
    assert "[% of the measured force, referred to the link]" in said
