"""Recordings by clicks say what the command line says of them (`python -m
tests.workbench.page.sets` takes every set).
"""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.workbench.chromium import CI, context_of, launched, needs_chromium
from tests.workbench.page.sets import SETS, SHARED, answers, state_of
from tests.workbench.served import serving

pytestmark = needs_chromium
KINDS = ("before", "law")


def a_learned_curve_is_drawn_where_it_is_pointed_at(page: Any, *, drawn: bool) -> None:
    page.click("#nav-ledger")
    page.wait_for_selector("#found")
    item = page.locator("#found li.points").first
    label = item.get_attribute("data-label")
    item.hover()
    page.wait_for_function(
        "l => document.querySelector('#law-panel').dataset.label === l", arg=label, timeout=60_000
    )
    if not drawn:  # curves that undo one another off the rows they were learned on
        assert page.locator("#law-panel path.s-law").count() == 0
        assert "No line" in page.inner_text("#no-line")
        return
    assert page.locator("#law-panel path.s-law").count() >= 1
    made = page.evaluate("l => get(`/view/law?label=${encodeURIComponent(l)}`)", label)
    _, *rows = csv.reader(io.StringIO(made["chart"]["csv"]))
    size = {kind: np.array([float(r[2]) for r in rows if r[0].startswith(kind)]) for kind in KINDS}
    learned = state_of(page, "improvement")["learned"]
    claim = next(c for c in learned if c["label"] == label)
    left = np.sum((size["before"] - size["law"]) ** 2)
    assert left < np.sum(size["before"] ** 2), "it takes off what it is drawn through"
    if sum(c["balance"] == claim["balance"] for c in learned) > 1:
        return  # curves share the work: the line is their sum, and no curve of this variable
    where = np.array([float(r[1]) for r in rows if r[0].startswith("law")])
    curve = np.interp(where, claim["curve"]["x"], claim["curve"]["learned"])
    assert np.corrcoef(curve, size["law"])[0, 1] > 0.8, "the line is the curve"
    assert left < 0.5 * np.sum(size["before"] ** 2), "the curve runs through the residual"


def a_law_is_picked_from_a_learned_curve(page: Any) -> None:
    """Its nearest law in one line is tried as one that was typed."""
    page.click("#nav-ledger")
    page.wait_for_selector("#found li.points")
    page.locator("#found li.points button").first.click()
    page.wait_for_selector("#law-said")
    law = page.input_value("#law-law")
    assert law
    assert page.input_value("#law-parameters").startswith("c=-")
    page.wait_for_function("() => !busy()")
    page.click("#try-law")
    page.wait_for_selector("#tried-laws", timeout=60_000)
    assert state_of(page, "laws")[0]["law"] == law


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("kuka_axis1", 12),
        pytest.param("emps", 8, marks=pytest.mark.slow),
        *(pytest.param(n, 12, marks=pytest.mark.slow) for n in ("quanser", "hebi")),
    ],
)
def test_the_page_says_what_the_terminal_says(tmp_path: Path, name: str, most: int) -> None:
    """Files whose guess of the columns must be corrected: the same verdict, set, numbers, sentences
    and joint file; the falling error stands there within the clicks of a new user.
    """
    folder = SHARED / SETS[name].folder
    if not folder.is_dir() and not CI:
        pytest.skip(f"{folder} is not beside the checkout")
    shots = os.environ.get("IRJ_SCREENSHOTS")
    with serving(tmp_path / "sessions") as there, launched() as chromium:
        context = context_of(chromium, viewport={"width": 1280, "height": 860})
        problems: list[str] = []
        context.on("weberror", lambda e: problems.append(str(e.error)))
        context.on("console", lambda m: problems.append(m.text) if m.type == "error" else None)
        page = context.new_page()
        made = answers(page, there.address, SETS[name], tmp_path)
        if shots:
            for colours in ("light", "dark"):
                page.emulate_media(color_scheme=colours)
                page.evaluate("theme => document.documentElement.dataset.theme = theme", colours)
                for width in (1280, 375):
                    page.set_viewport_size({"width": width, "height": 860})
                    page.click("#nav-ledger")
                    page.wait_for_selector("#found")
                    page.wait_for_timeout(400)
                    page.locator("#found summary").click()
                    page.screenshot(path=f"{shots}/{name}-{colours}-{width}.png", full_page=True)
                    assert page.evaluate("document.documentElement.scrollWidth") <= width
                    page.click("#nav-export")
        story = state_of(page, "improvement")
        left = sum(c["label"] not in story["joint_text"] for c in story["learned"])
        stairs = page.evaluate("get('/view/staircase')")["names"]
        assert (stairs[-1] == "+ learned curves") == bool(story["with_curves"])
        sets = [c["effects"] for c in made.improved["claims"] if len(c.get("effects", ())) > 1]
        page.click("#nav-ledger")
        page.wait_for_selector("#found")
        steps = page.locator("main table tbody tr").all_inner_texts()
        assert sum(" or " in step for step in steps) == len(sets), "a set stays a set"
        page.click("#nav-export")
        page.wait_for_selector("#get-joint-toml")
        said = f"It is without {left} of the learned curves"
        assert (said in page.inner_text("main")) == (left > 0)
        if any("curve" in c for c in made.improved["claims"]):
            a_learned_curve_is_drawn_where_it_is_pointed_at(page, drawn=name != "emps")
            a_law_is_picked_from_a_learned_curve(page)
    assert made.differences() == []
    assert made.page == made.terminal
    assert made.clicks <= most
    assert problems == []
