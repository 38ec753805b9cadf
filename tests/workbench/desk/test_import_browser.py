"""What would be odd about the joint stands on the import screen before the columns are used, in
Debian's Chromium: wrong units, a supply voltage, several joints, runs with restarting time, a
linear axis.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.identification.data.test_survey import CASES, NAMED, written
from tests.workbench.chromium import context_of, launched, needs_chromium
from tests.workbench.served import serving

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    problems: list[str] = []
    with (
        serving(tmp_path_factory.mktemp("sessions")) as there,
        launched() as chromium,
    ):
        context = context_of(chromium, viewport={"width": 1280, "height": 860})
        context.on("weberror", lambda e: problems.append(str(e.error)))
        made = context.new_page()
        made.set_default_timeout(15_000)
        made.goto(there.address)
        yield made
    assert problems == []


def test_there_are_twelve_of_them() -> None:
    assert len(CASES) == 12


@pytest.mark.parametrize("case", CASES)
def test_what_is_odd_stands_there_before_it_is_confirmed(
    page: Any, case: str, tmp_path: Path
) -> None:
    columns, expected = CASES[case]
    page.click("#fresh")
    page.wait_for_selector("#demo")
    page.set_input_files("#files", [written(tmp_path, **columns)])
    use = page.locator("section:has(.map-table) button.primary:has-text('Use these columns')")
    use.wait_for()
    said = " ".join(page.locator(".import .odd, .import .import-problem").all_inner_texts())
    assert expected.lower() in said.lower()
    assert page.locator(".import .odd").first.is_visible()
    assert page.evaluate("app.state.files.map((f) => f.status)") == ["columns"], "nothing is used"


@pytest.mark.parametrize("case", ["a supply", "joints side by side"])
def test_headers_that_say_everything_are_doubted_on_the_card_of_the_record(
    page: Any, case: str, tmp_path: Path
) -> None:
    """No map is asked for, so the card says it before a fit; the map can be changed."""
    columns, expected = NAMED[case]
    assert expected is not None
    expected = expected.replace("motor_voltage", "motor voltage")  # the page has it in words
    page.click("#fresh")
    page.wait_for_selector("#demo")
    page.set_input_files("#files", [written(tmp_path, **columns)])
    page.wait_for_function("() => app.state.files.length === 1 && !busy()")
    assert expected in page.inner_text("section[aria-label='rig.csv'] .findings >> nth=0")
    page.click("button[aria-label='Columns of rig.csv']")
    page.wait_for_selector(".import .odd")
    said = " ".join(page.locator(".import .odd").all_inner_texts()).lower()
    assert expected in said
    if case == "joints side by side":
        assert page.input_value("select[aria-label='Joint']") == "1"


@pytest.mark.parametrize("name", ["Prüfstand (2) – Lauf №1, 50 % #a&b.csv", "关节 1号 it's.csv"])
def test_a_name_stands_on_the_page_as_it_is(page: Any, name: str, tmp_path: Path) -> None:
    """On its card and in the list of records; and it can be taken out by it."""
    columns, _ = NAMED["a supply"]
    path = written(tmp_path, **columns).rename(tmp_path / name)
    page.click("#fresh")
    page.wait_for_selector("#demo")
    page.set_input_files("#files", [path])
    page.wait_for_function("() => app.state && app.state.files.length === 1 && !busy()")
    assert page.locator("main h2", has_text=name).count() == 1
    assert page.inner_text("#series-file option") == name
    page.get_by_role("button", name=f"Remove {name}", exact=True).click()
    page.wait_for_function("() => app.state && app.state.files.length === 0 && !busy()")


def test_files_are_not_for_a_session_that_is_opened_while_they_are_sent(
    page: Any, tmp_path: Path
) -> None:
    """The second of two files went into the new session, or left the page busy for ever."""
    columns, _ = NAMED["a supply"]
    first = written(tmp_path, **columns).rename(tmp_path / "first.csv")
    second = tmp_path / "second.csv"
    second.write_bytes(first.read_bytes())
    page.click("#fresh")
    page.wait_for_function("() => app.state && !busy()")
    old, held = page.evaluate("app.id"), []
    page.route("**/files/first.csv*", lambda route: held.append(route))
    page.set_input_files("#files", [first, second])
    while not held:
        page.wait_for_timeout(20)
    page.click("#fresh")
    page.wait_for_function("id => app.id !== id && app.state", arg=old)
    held[0].continue_()
    page.wait_for_function("() => !busy()")
    page.unroute("**/files/first.csv*")
    assert page.evaluate("get('').then((s) => s.files.length)") == 0
    there = page.evaluate("id => call('GET', `/api/session/${id}`)", old)
    assert [f["name"] for f in there["files"]] == ["first.csv"]


FORMULA = "[aria-label='Formula of columns, or the step of the time']"
ADD = "tr:has(strong:text-is('add a formula')) >> "


def test_half_a_formula_stands_when_the_map_is_drawn_anew(page: Any, tmp_path: Path) -> None:
    """Another column is given a channel, another tab changes the session: what is typed stays,
    with the focus and the place in it, and is asked about once it is whole.
    """
    columns, _ = CASES["degrees without a unit"]
    page.click("#fresh")
    page.wait_for_selector("#demo")
    page.set_input_files("#files", [written(tmp_path, **columns)])
    page.wait_for_selector(".map-table")
    page.fill(f"{ADD}{FORMULA}", "link_pos * ")
    page.fill(f"{ADD}[aria-label='Unit of the formula']", "deg")
    with page.expect_response("**/look/*"):
        page.select_option("select[aria-label='Sign of column iq_A']", "-1")
    page.wait_for_timeout(200)
    assert page.input_value(f"{ADD}{FORMULA}") == "link_pos * "
    assert page.input_value(f"{ADD}[aria-label='Unit of the formula']") == "deg"

    page.focus(f"{ADD}{FORMULA}")
    page.keyboard.press("End")
    page.keyboard.type("2 ")
    with page.expect_response("**/look/*"):
        page.evaluate("() => post('/tree', { session: 'another name' })")
    page.wait_for_function("() => !busy() && !app.asking && document.querySelector('.map-table')")
    page.wait_for_timeout(200)
    page.keyboard.type("+ 1")
    assert page.input_value(f"{ADD}{FORMULA}") == "link_pos * 2 + 1"
    assert page.input_value("select[aria-label='Sign of column iq_A']") == "-1"

    page.select_option(f"{ADD}[aria-label='Channel of the formula']", "link_velocity")
    page.wait_for_selector(".import-problem:has-text('a unit of the kind rad/s is wanted')")
    assert page.input_value(f"{ADD}{FORMULA}") == "link_pos * 2 + 1", "what was refused, too"
    with page.expect_response("**/look/*") as asked:
        page.select_option(f"{ADD}[aria-label='Channel of the formula']", "reference_position")
    sent = asked.value.request.post_data_json["columns"]["reference_position"]
    assert sent == {"formula": "link_pos * 2 + 1", "unit": "deg"}
    page.wait_for_selector("tr:has(strong:text-is('formula'))")
    assert page.input_value(f"{ADD}{FORMULA}") == "", "what was taken is no half of a formula"
