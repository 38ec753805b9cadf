"""What a clumsy hand does to the page in Debian's Chromium: a session deleted in another tab, a key
pasted into an open tab, fields with nothing, too much or words in them.
"""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.workbench.chromium import context_of, fit_demo, launched, needs_chromium
from tests.workbench.served import serving

pytestmark = needs_chromium


@dataclass
class Opened:
    """A browser on a running server, and what its pages logged as errors."""

    address: str
    key: str
    context: Any
    page: Any
    problems: list[str]


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Opened]:
    """The demo, fitted."""
    from workbench.page.desk import home
    from workbench.page.session import Store

    root = tmp_path_factory.mktemp("sessions")
    with serving(root) as there, launched() as chromium:
        context = context_of(chromium, viewport={"width": 1280, "height": 860})
        problems: list[str] = []
        context.on("weberror", lambda e: problems.append(str(e.error)))
        context.on("console", lambda m: problems.append(m.text) if m.type == "error" else None)
        page = context.new_page()
        fit_demo(page, there.address)
        drawn(page, "compare")
        yield Opened(there.address, home.key_of(Store(root)), context, page, problems)
    assert problems == []


def drawn(page: Any, view: str) -> None:
    page.wait_for_function(
        "v => document.querySelector('#main').dataset.view === v && !busy() && "
        "app.state.steps.every((s) => s.settled)",
        arg=view,
        timeout=120_000,
    )


def test_a_number_that_is_none_is_said_at_its_field_and_changes_nothing(opened: Opened) -> None:
    page = opened.page
    page.click("#nav-parameters")
    drawn(page, "parameters")
    shown, joint = page.inner_text("#slider-error"), page.evaluate("app.state.joint_text")
    for text, said in (
        ("", "motor coulomb is empty"),
        ("junk", "“junk” is not a number"),
        ("-3", "motor coulomb cannot be less than 0"),
    ):
        page.fill("#value-motor_coulomb", text)
        page.click("#hold-motor_coulomb")
        assert said in page.inner_text("#why-motor_coulomb")
        assert page.get_attribute("#value-motor_coulomb", "aria-invalid") == "true"
        assert page.is_hidden("#error")
        assert page.inner_text("#slider-error") == shown
        assert page.evaluate("app.state.joint_text") == joint
    page.fill("#value-motor_coulomb", "15,5")
    page.keyboard.press("Tab")
    page.wait_for_function(
        "was => document.querySelector('#slider-error').textContent !== was", arg=shown
    )
    assert page.is_hidden("#why-motor_coulomb")
    page.click("#hold-motor_coulomb")
    page.wait_for_function("() => app.state.joint_text.includes('[known]')")
    drawn(page, "parameters")
    row = page.locator("main table tr", has_text="motor coulomb").first
    assert "held" in row.inner_text()


@pytest.mark.slow
def test_answers_that_come_late_lose_no_view(opened: Opened) -> None:
    """Every other answer about the state comes after the news that followed it."""
    page = opened.page
    page.click("#nav-parameters")
    drawn(page, "parameters")
    page.evaluate(
        "() => { const fetched = window.fetch; let n = 0; window.fetch = async (path, options) => {"
        " const answer = await fetched(path, options);"
        " if (/session\\/[0-9a-f]+$/.test(path) && n++ % 2 === 0)"
        " await new Promise((go) => setTimeout(go, 700));"
        " return answer; }; }"
    )
    row = page.locator("main table tr", has_text="motor coulomb").first
    for _ in range(4):  # hold, release, hold, release
        joint, held = page.evaluate("app.state.joint_text"), "held" in row.inner_text()
        page.click("#hold-motor_coulomb")
        page.wait_for_function("was => app.state.joint_text !== was", arg=joint)
        drawn(page, "parameters")
        assert ("held" in row.inner_text()) is not held
    page.reload()
    drawn(page, "parameters")


def test_the_server_refuses_a_value_out_of_bounds_too(opened: Opened) -> None:
    page = opened.page
    asked = (
        "async ([path, body]) => { try { await (body ? post(path, body) : get(path)); return ''; }"
        " catch (e) { return e.message; } }"
    )
    path = "/view/what-if?values=" + "%7B%22motor_coulomb%22%3A-3%7D"
    assert "cannot be less than 0" in page.evaluate(asked, [path, None])
    hold = {"hold": {"motor_coulomb": -3}}
    assert "cannot be less than 0" in page.evaluate(asked, ["/joint", hold])
    opened.problems.clear()  # the browser logs an answer of 422


def test_a_joint_that_cannot_be_is_refused_at_its_form(opened: Opened) -> None:
    page = opened.page
    page.click("#nav-model")
    drawn(page, "model")
    joint = page.evaluate("app.state.joint_text")
    for field, text, said in (
        ("gear_ratio", "1e9", "gear ratio is 1e+09, too large for a joint"),
        ("motor_constant", "0.1 kg", "motor constant is '0.1 kg'; give a plain number in N.m/A"),
    ):
        before = page.input_value(f"#{field}")
        page.fill(f"#{field}", text)
        page.click("#save")
        page.wait_for_selector("#error:not([hidden])")
        assert said in page.inner_text("#error-text")
        page.fill(f"#{field}", before)
    assert page.evaluate("app.state.joint_text") == joint
    page.click("#error-close")
    opened.problems.clear()  # the browser logs an answer of 422


def looked_at(page: Any, *, yes: bool) -> None:
    page.evaluate(
        "h => { Object.defineProperty(document, 'hidden', { value: h, configurable: true });"
        "document.dispatchEvent(new Event('visibilitychange')); }",
        not yes,
    )


def test_tabs_that_nobody_looks_at_hold_no_connection_and_miss_nothing(opened: Opened) -> None:
    """Browsers give a host six connections: with seven tabs open the page hung."""
    page = opened.page
    session = page.evaluate("() => app.id")
    others = []
    for _ in range(7):
        tab = opened.context.new_page()
        tab.goto(f"{opened.address}#session={session}&view=compare", timeout=20_000)
        drawn(tab, "compare")
        looked_at(tab, yes=False)
        others.append(tab)
    page.evaluate("() => run('add', { label: 'cubic_viscous@motor' }, 'ledger')")
    page.wait_for_function("() => !busy() && app.state.steps.length === 2", timeout=120_000)
    drawn(page, "ledger")
    assert others[0].evaluate("() => app.state.steps.length") == 1
    looked_at(others[0], yes=True)
    others[0].wait_for_function("() => app.state.steps.length === 2")
    page.click("#undo")
    page.wait_for_function("() => !busy() && app.state.steps.length === 1")
    others[0].wait_for_function("() => app.state.steps.length === 1")
    for tab in others:
        tab.close()
    page.click("#nav-compare")
    drawn(page, "compare")


def test_names_of_one_long_word_make_no_view_wider_than_the_screen(opened: Opened) -> None:
    page = opened.page
    name = "n" * 200
    for body in (
        {"of": page.evaluate("app.state.steps[0].id"), "name": name, "note": "x" * 5000},
        {"session": name},
    ):
        page.evaluate("b => post('/tree', b).then(refresh)", body)
    try:
        for width in (1280, 375):
            page.set_viewport_size({"width": width, "height": 860})
            for view in ("load", "ledger", "parameters"):
                page.click(f"#nav-{view}")
                drawn(page, view)
                page.wait_for_function("() => !document.querySelector('.tree:empty')")
                assert page.evaluate("document.documentElement.scrollWidth") <= width, view
    finally:
        page.set_viewport_size({"width": 1280, "height": 860})
        step = page.evaluate("app.state.steps[0].id")
        page.evaluate("s => post('/tree', { of: s, name: '', note: '' }).then(refresh)", step)
        page.evaluate("() => post('/tree', { session: '' }).then(refresh)")


def test_what_nobody_added_has_no_button_that_takes_it_out(opened: Opened) -> None:
    """The delay of the drive's hold, which is found in each record: its button ended in an internal
    error.
    """
    page = opened.page
    page.click("#nav-ledger")
    drawn(page, "ledger")
    hold = page.evaluate("app.config.hold")
    assert hold in page.evaluate("app.state.steps.at(-1).effects")
    card = page.locator("h2:text-is('In the model now') >> xpath=..")
    assert "viscous friction (motor)" in card.inner_text()
    assert "delay of a channel" not in card.inner_text()
    page.evaluate("l => { run('remove', { label: l }); }", hold)
    page.wait_for_selector("#error:not([hidden])")
    assert "is found in each record, and cannot go" in page.inner_text("#error-text")
    page.click("#error-close")


def test_an_address_with_a_view_that_is_none_shows_the_records(opened: Opened) -> None:
    page = opened.page
    for view in ("__proto__", "constructor", "nonsense"):
        page.evaluate("v => { location.hash = `#session=${app.id}&view=${v}`; }", view)
        drawn(page, "load")
        page.click("#nav-compare")
        drawn(page, "compare")


def test_a_second_click_on_a_step_keeps_what_was_opened_in_it(opened: Opened) -> None:
    page = opened.page
    page.click("#nav-compare")
    drawn(page, "compare")
    page.evaluate("document.querySelector('#as-such details.save').open = true")
    page.click("#nav-compare")
    assert page.evaluate("document.querySelector('#as-such details.save').open")


def test_the_sessions_say_what_to_do_without_their_key_and_take_it_in_an_open_tab(
    opened: Opened,
) -> None:
    page = opened.page
    page.click("#home")
    page.wait_for_selector("#need-key")
    assert "#home=" in page.inner_text("#need-key")
    assert opened.problems == [], "the list is not asked for without a key"
    page.evaluate("key => { location.hash = `#home=${key}`; }", opened.key)
    page.wait_for_selector("#quota")


def test_a_session_deleted_in_another_tab_says_so_and_leads_home(opened: Opened) -> None:
    page = opened.page
    page.click("#nav-compare")
    drawn(page, "compare")
    other = opened.context.new_page()
    other.goto(opened.address + "#view=home")
    other.wait_for_selector("#quota")
    other.get_by_role("button", name="Delete ", exact=False).first.click()
    other.get_by_role("button", name="for good").click()
    page.wait_for_function("() => document.querySelector('#main').dataset.view === 'gone'")
    assert "This session was deleted" in page.inner_text("main")
    assert page.is_hidden("nav.steps")
    page.click("#gone-home")
    page.wait_for_selector("#quota")
    page.click("#fresh")
    page.wait_for_selector("#demo")
    assert page.is_visible("nav.steps")
    assert opened.problems == []
    other.close()


class Other(BaseHTTPRequestHandler):
    """Answers everything in the same way, as pages of some programs do."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("content-type", "text/html")
        self.end_headers()
        self.wfile.write(b"<p>something else</p>")

    def log_message(self, *said: Any) -> None:
        pass


@contextmanager
def another_program(port: int) -> Iterator[None]:
    """Something else that answers on a port."""
    server = ThreadingHTTPServer(("127.0.0.1", port), Other)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.mark.slow
def test_what_took_the_place_of_the_server_is_said_and_the_session_comes_back(
    opened: Opened, tmp_path: Path
) -> None:
    """Nothing was deleted: the page says what answers at its address now, also where nobody clicks
    in it, and goes on where its server is back.
    """
    first, second = tmp_path / "first", tmp_path / "second"
    page = context_of(opened.context.browser).new_page()
    with serving(first) as there:
        port = there.port
        fit_demo(page, there.address)
        drawn(page, "compare")
    with another_program(port):
        page.wait_for_selector("#gone-again", timeout=30_000)
        assert "This is no server of the workbench" in page.inner_text("main")
    with serving(second, port):
        page.click("#gone-again")
        page.wait_for_selector("#error:not([hidden])")
        assert "the server here has no such session" in page.inner_text("#error-text")
    with serving(first, port):
        page.click("#gone-again")
        drawn(page, "ledger")
        assert page.evaluate("app.state.steps.length") == 1
    with serving(second, port):
        page.wait_for_selector("#gone-again", timeout=30_000)
        said = page.inner_text("main")
        assert "Another server answers here" in said
        assert "Nothing of the session is lost" in said
        assert "deleted" not in said
        page.click("#gone-fresh")
        page.wait_for_selector("#demo")
        shutil.rmtree(second / page.evaluate("app.id"))
    with serving(second, port):
        page.wait_for_selector("#gone-home", timeout=30_000)
        assert "This session is not there any more" in page.inner_text("main")
    page.context.close()
