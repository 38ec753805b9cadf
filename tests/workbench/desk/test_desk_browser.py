"""Nothing is lost: the tree of fits, undo by key, back and forward, in Debian's Chromium."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.workbench.chromium import context_of, launched, needs_chromium
from tests.workbench.served import serving

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sessions")


@pytest.fixture(scope="module")
def address(root: Path) -> Iterator[str]:
    with serving(root) as there:
        yield there.address


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with launched() as chromium:
        context = context_of(chromium, viewport={"width": 1280, "height": 860})
        problems: list[str] = []
        context.on("weberror", lambda e: problems.append(str(e.error)))
        made = context.new_page()
        made.set_default_timeout(15_000)
        yield made
    assert problems == []


def shot(page: Any, name: str) -> None:
    folder = os.environ.get("IRJ_SCREENSHOTS")
    if folder:
        page.wait_for_timeout(250)
        page.screenshot(path=str(Path(folder) / f"{name}.png"), full_page=True)


def idle(page: Any, view: str) -> None:
    page.wait_for_function(
        "v => document.querySelector('#main').dataset.view === v && !busy() && "
        "app.state.steps.every((s) => s.settled) && "
        "document.querySelector('#main').dataset.revision === String(app.state.revision)",
        arg=view,
        timeout=120_000,
    )


def fits(page: Any) -> list[str]:
    page.wait_for_selector("#tree .input")
    names: list[str] = page.eval_on_selector_all(
        "#tree .fit-name", "nodes => nodes.map((n) => n.textContent)"
    )
    return names


def test_no_move_loses_a_fit(address: str, page: Any, tmp_path: Path) -> None:
    page.goto(address)
    page.click("#demo")
    page.click("#fit")
    idle(page, "compare")
    page.click("#nav-ledger")
    idle(page, "ledger")
    page.select_option("#add-label", "stribeck@motor")
    page.click("#add-by-hand")
    page.wait_for_function("() => app.state.steps.length === 2")
    idle(page, "ledger")
    first = page.inner_text("#headline strong")

    page.keyboard.press("Control+z")
    page.wait_for_function("() => app.state.steps.length === 1")
    idle(page, "ledger")
    page.select_option("#add-label", "backlash")
    page.click("#add-by-hand")
    page.wait_for_function("() => app.state.steps.length === 2 && app.state.fits === 1")
    idle(page, "ledger")
    assert len(fits(page)) == 3  # the start once, and both second steps

    # a refused upload, another name of the joint: the ledger stands
    bad = tmp_path / "noise.csv"
    bad.write_bytes(bytes(range(256)) * 20)
    page.click("#nav-load")
    page.set_input_files("#files", str(bad))
    page.wait_for_selector("#error:not([hidden])")
    assert page.evaluate("app.state.files.length") == 2
    page.click("#nav-model")
    page.fill("#name", "shoulder")
    page.click("#save")
    page.wait_for_function("() => app.state.joint_text.includes('shoulder')")
    assert page.evaluate("app.state.steps.length") == 2

    # another role: a branch; what was fitted stays in the tree and comes back by one key
    page.click("#nav-load")
    held = page.evaluate("app.state.files.find((f) => f.role === 'held_out').id")
    page.select_option(f"#role-{held}", "train")
    page.wait_for_function("() => app.state.steps.length === 0")
    idle(page, "load")
    assert len(fits(page)) == 3
    page.locator("h1").click()
    page.keyboard.press("Control+z")
    page.wait_for_function("() => app.state.steps.length === 2")
    idle(page, "load")

    # name, note, compare, open: on the step that was left first
    page.click("#nav-ledger")
    idle(page, "ledger")
    fits(page)
    row = page.locator("#tree .fit", has_text="Stribeck")
    row.get_by_role("button", name=re.compile("Name, note")).click()
    page.get_by_placeholder("Name").fill("with Stribeck")
    page.get_by_placeholder("Note").fill("looks right at low speed")
    page.get_by_role("button", name="Keep").click()
    page.wait_for_selector("#tree .note-text")
    row = page.locator("#tree .fit", has_text="with Stribeck")
    row.get_by_role("checkbox").check()
    page.locator("#tree .fit", has_text="Start").get_by_role("checkbox").check()
    page.click("#compare-fits")
    page.wait_for_selector("#held-against table")
    shot(page, "tree")
    row.get_by_role("button", name=re.compile("^Open")).click()
    page.wait_for_function(
        "f => document.querySelector('#headline strong').textContent === f", arg=first
    )

    # back and forward go between the views
    idle(page, "ledger")
    page.click("#nav-parameters")
    idle(page, "parameters")
    page.go_back()
    idle(page, "ledger")
    page.go_forward()
    idle(page, "parameters")
    page.reload()
    idle(page, "parameters")
    assert page.inner_text("#headline strong") == first


def write_two_joints(path: Path) -> None:
    """Two joints side by side, degrees in a column that says nothing of its unit, a supply."""
    t = np.arange(4000) * 0.002
    columns = {"t": t, "vbus_V": np.full_like(t, 48.0) + 0.1 * np.sin(50.0 * t)}
    for k, turns in ((1, 80.0), (2, 35.0)):
        columns[f"q{k}"] = turns * np.sin((1.0 + k) * t)
        columns[f"iq{k}_A"] = np.cos((1.0 + k) * t)
        columns[f"defl{k}"] = 0.5 * np.cos((1.0 + k) * t)
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")


def test_the_import_shows_what_would_be_odd_before_it_is_used(
    address: str, page: Any, tmp_path: Path
) -> None:
    page.goto(address)
    page.click("#fresh")
    page.wait_for_selector("#demo")
    write_two_joints(tmp_path / "rig.csv")
    page.set_input_files("#files", str(tmp_path / "rig.csv"))
    page.wait_for_selector(".import .odd")
    said = " ".join(page.locator(".import .odd").all_inner_texts())
    assert "columns of 2 joints, 1 to 2: this is joint 1" in said.replace("Columns", "columns")
    assert "a supply voltage?" in said
    assert "turns: degrees" in said
    assert page.locator(".import svg.spark polyline").count() == 8
    shot(page, "import")

    page.select_option("select[aria-label='Joint']", "2")
    page.wait_for_function(
        "() => document.querySelector('select[aria-label=\"Channel of column q2\"]').value"
        " === 'motor_position'"
    )
    page.fill("input[aria-label='Unit of column q2']", "deg")
    page.press("input[aria-label='Unit of column q2']", "Tab")
    page.wait_for_function("() => !document.querySelector('.import').innerText.includes('swing')")
    page.select_option("select[aria-label='Channel of column vbus_V']", "")
    page.wait_for_function("() => !document.querySelector('.import').innerText.includes('supply')")
    page.fill("input[aria-label^='Formula']", "q2 - defl2")
    page.fill("input[aria-label='Unit of the formula']", "deg")
    page.select_option("select[aria-label='Channel of the formula']", "link_position")
    page.wait_for_function(
        "() => document.querySelector('.import').innerText.includes('formula')"
        " && document.querySelectorAll('.import .si').length === 4"
    )
    page.click("button.primary:has-text('Use these columns')")
    page.wait_for_function("() => app.state.files[0].status === 'ready'")
    columns = page.evaluate("app.state.files[0].columns")
    assert columns["link_position"] == {"formula": "q2 - defl2", "unit": "deg"}
    assert columns["motor_position"] == {"column": "q2", "unit": "deg"}

    # the map can be changed later
    page.click("button[aria-label='Columns of rig.csv']")
    page.wait_for_selector("select[aria-label='Sign of column iq2_A']")
    page.select_option("select[aria-label='Sign of column iq2_A']", "-1")
    page.wait_for_function(
        "() => document.querySelector('select[aria-label=\"Sign of column iq2_A\"]').value === '-1'"
    )
    shot(page, "import-later")
    page.click("button.primary:has-text('Use these columns')")
    page.wait_for_function("() => app.state.files[0].columns.motor_current.sign === -1")


def test_sessions_are_found_named_and_deleted(address: str, page: Any, root: Path) -> None:
    from workbench.page.desk import home
    from workbench.page.session import Store

    page.goto(address)
    page.click("#fresh")
    page.wait_for_selector("#demo")
    page.click("#demo")
    idle(page, "load")
    page.click("#fresh")
    page.wait_for_selector("#demo")
    write_two_joints(root / "rig.csv")
    page.set_input_files("#files", str(root / "rig.csv"))
    page.wait_for_selector(".import svg")
    page.click("#home")
    page.wait_for_selector("#need-key")
    assert "irj app printed" in page.inner_text("#need-key")
    assert page.locator(".session").count() == 0  # no list without the key
    key = home.key_of(Store(root))
    page.goto(f"{address}#home={key}")  # in the open tab
    page.wait_for_selector(".session")
    before = page.locator(".session").count()
    page.get_by_label("Name of rig").first.fill("left bench")
    page.keyboard.press("Tab")
    page.wait_for_selector("h2:has-text('left bench')")
    page.fill("#search", "bench")
    assert page.locator(".session").count() == 1
    page.fill("#search", "")
    shot(page, "home")
    page.get_by_label("Delete left bench", exact=True).click()
    page.get_by_label("Delete left bench for good").click()
    page.wait_for_function(
        "n => document.querySelectorAll('.session').length === n", arg=before - 1
    )
    assert "left bench" not in page.inner_text("#main")


def test_a_law_of_ones_own_is_tried_at_once_and_saved(address: str, page: Any) -> None:
    page.goto(address)
    page.click("#fresh")
    page.wait_for_selector("#demo")
    page.click("#demo")
    page.click("#fit")
    idle(page, "compare")
    page.click("#nav-ledger")
    idle(page, "ledger")
    start = float(page.inner_text("#headline strong").split()[0])
    page.fill("#law-law", "a*tanh(v/b")
    page.fill("#law-parameters", "a=0..100 N.m, b=0.001..1 rad/s")
    page.click("#try-law")
    page.wait_for_selector("#error:not([hidden])")
    assert "law: " in page.inner_text("#error-text")
    idle(page, "ledger")
    page.fill("#law-law", "a*exp(-abs(v)/b)*sign(v)")
    page.click("#try-law")
    page.wait_for_selector("#tried-laws")
    idle(page, "ledger")
    tried = page.evaluate("app.state.laws[0]")
    assert tried["after"] < 0.5 * tried["before"]
    assert tried["before"] == pytest.approx(start, rel=0.01)
    shot(page, "law")
    page.click("#tried-laws button")
    page.wait_for_function("() => app.state.steps.length === 2")
    idle(page, "ledger")
    assert float(page.inner_text("#headline strong").split()[0]) == pytest.approx(
        tried["after"], rel=0.01
    )
    assert "law_" in page.evaluate("app.state.joint_text")
    taken = page.evaluate("fetch(base() + '/view/joint.toml').then((r) => r.text())")
    assert 'law = "a*exp(-abs(v)/b)*sign(v)"' in taken
    assert page.evaluate("app.state.fits") == 0  # no branch by a law that is only there
