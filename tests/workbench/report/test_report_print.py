"""The report on paper, in Debian's Chromium: the first sheet stands alone, nothing is cut."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.resources import as_file, files
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from identification.data.joint_file import load_joint
from identification.data.read import read
from identification.diagnosis.improve import improve
from identification.fitting.trust import trust
from tests.workbench.chromium import launched, needs_chromium
from tests.workbench.report.paper import Part, parts_on_paper
from workbench.show.report import write_report

pytestmark = needs_chromium

PIXELS = 96 / 25.4
PAPER = (182 * PIXELS, 267 * PIXELS)
"""A4 without the margins of the report's style."""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    with as_file(files("workbench") / "demo") as demo:
        joint = load_joint(demo / "joint.toml")
        train, held = (read(demo / f, joint=joint) for f in ("train.npz", "held_out.npz"))
    better = improve([train], joint, [held])
    return write_report(
        better,
        folder / "report.html",
        records=[train, held],
        trust=trust(better.steps[-1].solution, better.data, profiles=False),
        beside={"a year ago": better.as_json()},
        author="A. Smith",
        notes="New oil.\nThe gear was taken off before.",
    )


@pytest.fixture(scope="module")
def page(report: Path) -> Iterator[Any]:
    with launched() as chromium:
        made = chromium.new_page()
        made.goto(report.as_uri())
        yield made


PARTS = (
    ".verdict, .tiles > div, h2, h3, p, li, figure, .addition, caption, thead tr, tbody tr, dt, dd"
)
LEADS = ("h2", "h3", "p.legend", "caption", "dt")
"""What stands before something and means nothing without it."""
TRAILS = ("p.note", "figcaption", "dd")
"""What is said of the part before it."""
SHIFTS = (0, 40, 80, 120, 160)
"""The details begin so much lower [mm], so that their parts come to stand at a sheet's end."""
MARGIN = 14
"""Of the report's style [mm]; below 16."""


@pytest.fixture(scope="module")
def sheets_of(page: Any) -> dict[int, list[Part]]:
    """Of each shift where the parts of the report stand."""
    page.emulate_media(media="print", color_scheme="dark")
    out = {}
    for shift in SHIFTS:
        page.evaluate("s => document.querySelector('#joint').style.paddingTop = `${s}mm`", shift)
        out[shift] = parts_on_paper(page, PARTS, prefer_css_page_size=True)
    return out


def test_the_first_sheet_stands_alone(sheets_of: dict[int, list[Part]], page: Any) -> None:
    parts = sheets_of[0]
    front = [p for p in parts if p.first == 1]
    assert max(f[4] for p in front for f in p.frames) <= 297 - 16
    assert front[-1].last == 1, "nothing of it runs on"
    kinds = [p.kind for p in front]
    assert kinds[1].startswith("section.verdict"), "after author and date"
    assert kinds.count("figure") == 2, "staircase, and the place before and after"
    said = " ".join(p.said for p in front)
    law = "motor stribeck extra\u00b7tanh".replace(" ", "\u00a0")
    for needed in ("1.52 %", "0.438 %", "Stribeck effect", law):
        assert needed in said
    assert "What to measure next" in [p.said for p in front if p.kind == "h2"]
    assert front == parts[: len(front)]
    assert parts[len(front)].said == "The joint and its motion"
    assert parts[len(front)].first == 2


@pytest.mark.parametrize("shift", SHIFTS)
def test_nothing_is_cut_split_or_torn_from_what_it_belongs_to(
    sheets_of: dict[int, list[Part]], shift: int
) -> None:
    parts = sheets_of[shift]
    assert len(parts) > 100
    cut = [
        p
        for p in parts
        if (len(p.frames) != 1 and p.kind != "thead")  # it stands again where its table runs on
        or p.frames[0][1] < MARGIN - 0.5
        or p.frames[0][2] < MARGIN - 0.5
        or p.frames[0][3] > 210 - MARGIN + 0.5
        or p.frames[0][4] > 297 - 16 + 0.5
    ]
    assert cut == [], "every part stands on one sheet, within its margins"
    alone = [(a, b) for a, b in pairwise(parts) if a.kind in LEADS and b.first > a.last]
    alone += [(a, b) for a, b in pairwise(parts) if b.kind in TRAILS and b.first > a.last]
    led = zip(parts, parts[1:], parts[2:], strict=False)
    alone += [(b, c) for a, b, c in led if (a.kind, b.kind) == ("h2", "p") and c.first > b.last]
    assert alone == [], "no heading, legend or note without what it belongs to"
    heads = [(a, b) for a, b in pairwise(parts) if a.kind == "thead" and b.first > a.first]
    assert heads == [], "no head of a table without rows"
    sheets = {f[0] for p in parts for f in p.frames}
    assert sheets == set(range(1, max(sheets) + 1)), "no sheet is empty"
    assert len(sheets) <= 20


def test_no_label_and_no_cell_is_cut(page: Any) -> None:
    page.emulate_media(media="print", color_scheme="dark")
    page.set_viewport_size({"width": round(PAPER[0]), "height": round(PAPER[1])})
    labels = page.evaluate(
        """() => [...document.querySelectorAll('svg text')].filter((t) => {
          const a = t.getBoundingClientRect(), b = t.ownerSVGElement.getBoundingClientRect();
          return a.width && (a.left < b.left - 1 || a.right > b.right + 1 || a.top < b.top - 1
            || a.bottom > b.bottom + 1);
        }).map((t) => t.textContent)"""
    )
    assert labels == []
    cells = page.evaluate(
        """() => [...document.querySelectorAll('td, tbody th')].filter((c) => {
          const all = document.createRange();
          all.selectNodeContents(c);
          return all.getBoundingClientRect().right > c.getBoundingClientRect().right + 0.5;
        }).map((c) => c.textContent)"""
    )
    assert cells == [], "no cell runs into the next one"
    paper = page.evaluate(
        "() => getComputedStyle(document.documentElement).getPropertyValue('--paper')"
    )
    assert paper.strip() == "#ffffff", "dark colours stay on the screen"
    assert page.locator(".print-only svg").count() == 2, "time plots as still pictures"
    assert page.locator(".print-only.grid").is_visible()
    assert not page.locator("#overlay").is_visible()
    assert not page.locator(".screen-only").is_visible()


def test_on_screens_light_dark_wide_and_narrow(page: Any) -> None:
    page.emulate_media(media="screen")
    for colours in ("light", "dark"):
        page.emulate_media(color_scheme=colours)
        for width in (1280, 375):
            page.set_viewport_size({"width": width, "height": 800})
            page.wait_for_timeout(100)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert not any(p.is_visible() for p in page.locator(".print-only").all())
    assert page.locator("#overlay").is_visible()
