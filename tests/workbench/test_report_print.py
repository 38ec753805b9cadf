"""The report on paper, in Debian's Chromium: the first page stands alone, nothing is cut."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import pytest

from identification.data.joint_file import load_joint
from identification.data.read import read
from identification.diagnosis.improve import improve
from tests.workbench.chromium import launched, needs_chromium
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
    return write_report(
        improve([train], joint, [held]),
        folder / "report.html",
        records=[train, held],
        author="A. Smith",
        notes="New oil.\nThe gear was taken off before.",
    )


@pytest.fixture(scope="module")
def page(report: Path) -> Iterator[Any]:
    with launched() as chromium:
        made = chromium.new_page()
        made.goto(report.as_uri())
        yield made


def test_the_first_page_is_one_sheet_and_nothing_is_cut(page: Any) -> None:
    page.set_viewport_size({"width": round(PAPER[0]), "height": round(PAPER[1])})
    page.emulate_media(media="print", color_scheme="dark")
    front = page.evaluate("() => document.querySelector('.front').getBoundingClientRect().bottom")
    assert front <= PAPER[1], "the first page is one sheet"
    after = page.evaluate("() => getComputedStyle(document.querySelector('.front')).breakAfter")
    assert after == "page"
    wide = page.evaluate(
        "() => [...document.querySelectorAll('svg, table, figure')]"
        ".filter((e) => e.getBoundingClientRect().right > innerWidth + 1)"
        ".map((e) => e.outerHTML.slice(0, 90))"
    )
    assert wide == [], "nothing is wider than the paper"
    torn = page.evaluate(
        "() => [...document.querySelectorAll('svg.picture, figure, .addition, .tiles div, tr')]"
        ".filter((e) => getComputedStyle(e).breakInside !== 'avoid')"
        ".map((e) => e.outerHTML.slice(0, 90))"
    )
    assert torn == [], "no plot and no card is split"
    paper = page.evaluate(
        "() => getComputedStyle(document.documentElement).getPropertyValue('--paper')"
    )
    assert paper.strip() == "#ffffff", "dark colours stay on the screen"
    assert page.locator(".print-only svg").count() == 2, "time plots as still pictures"
    assert page.locator(".print-only").is_visible()
    assert not page.locator("#overlay").is_visible()
    made = page.pdf(format="A4", prefer_css_page_size=True, print_background=True)
    assert 3 <= len(re.findall(rb"/Type\s*/Page\b", made)) <= 20


def test_on_screens_light_dark_wide_and_narrow(page: Any) -> None:
    page.emulate_media(media="screen")
    for colours in ("light", "dark"):
        page.emulate_media(color_scheme=colours)
        for width in (1280, 375):
            page.set_viewport_size({"width": width, "height": 800})
            page.wait_for_timeout(100)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert not page.locator(".print-only").is_visible()
    assert page.locator("#overlay").is_visible()
