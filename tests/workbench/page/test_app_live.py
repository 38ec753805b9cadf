"""A file that is being written and a stream, followed on the Replay page, in Debian's Chromium."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.workbench.chromium import context_of, fit_demo, launched, needs_chromium
from tests.workbench.served import serving

AXE = os.environ.get("IRJ_AXE", "")
SHOTS = os.environ.get("IRJ_SHOTS", "")
DEMO = Path(str(files("workbench"))) / "demo"
FAULT = (9.0, 10.5)
"""From when to when the link encoder is off [s]."""

pytestmark = needs_chromium


def idle(page: Any, view: str = "") -> None:
    """Wait until nothing was asked for, nothing runs, and the screen shows the state."""
    page.wait_for_function(
        "v => (!v || document.querySelector('#main').dataset.view === v) && !app.sent && "
        "!app.waiting && !app.asking && !app.then && app.state && !app.state.job && "
        "app.state.steps.every((s) => s.settled) && "
        "document.querySelector('#main').dataset.revision === String(app.state.revision)",
        arg=view,
        timeout=120_000,
    )


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sessions")


@pytest.fixture(scope="module")
def growing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("live") / "live.csv"


@pytest.fixture(scope="module")
def stream() -> str:
    """An address that is free."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        return f"udp://127.0.0.1:{found.getsockname()[1]}"


@pytest.fixture(scope="module")
def page(root: Path, growing: Path, stream: str) -> Iterator[Any]:
    """The demo with what it lacks, fitted."""
    with serving(root, follow=[growing, stream]) as there, launched() as chromium:
        made = context_of(chromium, viewport={"width": 1280, "height": 860}).new_page()
        fit_demo(made, there.address)
        idle(made, "compare")
        made.evaluate("run('add', { label: 'stribeck@motor' }, 'ledger')")
        made.wait_for_function("() => app.state.steps.length === 2", timeout=60_000)
        idle(made, "ledger")
        yield made
        idle(made)


def lines() -> list[str]:
    with np.load(DEMO / "held_out.npz") as archive:
        table = {k: archive[k].astype(float) for k in archive.files}
    keep = table["time_s"] - table["time_s"][0] < 14.0
    table = {k: v[keep] for k, v in table.items()}
    off = (table["time_s"] >= FAULT[0]) & (table["time_s"] < FAULT[1])
    table["link_position_rad"] = table["link_position_rad"] + 0.05 * off
    rows = np.column_stack(list(table.values()))
    return [",".join(table), *(",".join(f"{v:.12g}" for v in row) for row in rows.tolist())]


def shot(page: Any, name: str) -> None:
    if not SHOTS:
        return
    for theme in ("light", "dark"):
        for width in (1280, 375):
            page.set_viewport_size({"width": width, "height": 860})
            page.evaluate("t => theme(t)", theme)
            page.screenshot(path=f"{SHOTS}/{name}-{theme}-{width}.png")
    page.evaluate("theme('light')")
    page.set_viewport_size({"width": 1280, "height": 860})


def test_a_growing_file_is_followed_and_its_verdict_withdrawn_in_the_headline(
    page: Any, growing: Path
) -> None:
    """The logger stands still while the link encoder is off, so that the page must say it then;
    what comes after shows the encoder healthy.
    """
    text = lines()
    times = np.array([float(row.split(",", 1)[0]) for row in text[1:]])
    cut = 1 + int(np.searchsorted(times, FAULT[1] - 0.5))
    growing.write_text("\n".join(text[:cut]) + "\n" + text[cut][:9])
    page.click("#nav-replay")
    idle(page, "replay")
    page.click("#follow")
    page.wait_for_function(
        "() => (document.querySelector('#standing') || {}).textContent"
        "?.startsWith('Link position at 9')",
        timeout=60_000,
    )
    assert page.evaluate("app.state.job.action") == "follow"
    assert "so far" in page.inner_text("#timeline")
    shot(page, "live")

    with growing.open("a") as stream:
        stream.write(text[cut][9:] + "\n" + "\n".join(text[cut + 1 :]) + "\n")
    page.wait_for_function(
        "() => (document.querySelector('#standing') || {}).textContent"
        "?.startsWith('No reading is doubted any more: link position, said at 9')",
        timeout=60_000,
    )
    began = time.monotonic()
    page.click("#follow-stop")
    idle(page, "replay")
    assert time.monotonic() - began < 8, "it was stopped, and did not wait until the file rests"
    assert page.locator("#error").is_hidden()
    page.wait_for_selector("#follow")
    assert "withdrawn at" in page.inner_text("#standing")
    assert "so far" not in page.inner_text("#timeline")
    shot(page, "followed")
    if AXE:
        page.evaluate(Path(AXE).read_text(encoding="utf-8"))
        found = page.evaluate("() => axe.run(document)")
        assert [(v["id"], n["html"][:160]) for v in found["violations"] for n in v["nodes"]] == []


def test_a_file_of_wide_characters_is_followed_too(page: Any, growing: Path) -> None:
    """UTF-16 with its mark, as programs under Windows save text."""
    whole = ("\n".join(lines()) + "\n").encode("utf-16")
    cut = len(whole) // 2 | 1
    growing.write_bytes(whole[:cut])
    page.click("#nav-replay")
    idle(page, "replay")
    page.select_option("#follow-file", str(growing))
    page.click("#follow")
    seen = "s => app.state.job && app.state.job.text.endsWith(`, ${s} s`)"
    page.wait_for_function(seen, arg=6, timeout=60_000)
    with growing.open("ab") as stream:
        stream.write(whole[cut:])
    page.wait_for_function(seen, arg=12, timeout=60_000)
    page.click("#follow-stop")
    idle(page, "replay")
    assert page.locator("#error").is_hidden()


def test_a_stream_is_followed_as_a_file_is(page: Any, stream: str) -> None:
    host, _, port = stream.removeprefix("udp://").rpartition(":")
    head, *rows = lines()
    page.click("#nav-replay")
    idle(page, "replay")
    page.select_option("#follow-file", stream)
    page.click("#follow")
    page.wait_for_function(
        "() => app.state.job && app.state.job.text.startsWith('waiting for')", timeout=60_000
    )
    page.wait_for_function("() => !document.querySelector('#standing')", timeout=60_000)
    ended = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for k in range(0, len(rows), 40):
                sender.sendto("\n".join([head, *rows[k : k + 40]]).encode(), (host, int(port)))
                if ended.wait(0.02):
                    return

    sending = threading.Thread(target=send, daemon=True)
    sending.start()
    try:
        page.wait_for_function(
            "() => (document.querySelector('#standing') || {}).textContent"
            "?.startsWith('No reading is doubted any more: link position, said at 9')",
            timeout=60_000,
        )
    finally:
        ended.set()
        sending.join(10)
    page.click("#follow-stop")
    idle(page, "replay")
    assert page.locator("#error").is_hidden()
    assert "withdrawn at" in page.inner_text("#standing")


def test_no_other_file_can_be_followed(page: Any, growing: Path) -> None:
    idle(page)
    secret = growing.with_name("secret.csv")
    secret.write_text("\n".join(lines()))
    page.evaluate("path => run('follow', { source: path })", str(secret))
    page.wait_for_selector("#error:not([hidden])", timeout=60_000)
    idle(page)
    assert "was not named when the page was started" in page.inner_text("#error-text")


@pytest.mark.parametrize("view", ["model", "compare", "ledger", "replay", "plan"])
def test_what_is_chosen_stands_when_the_view_is_drawn_anew(page: Any, view: str) -> None:
    """A view is drawn anew whenever work ends; who then clicks means what was chosen before."""
    page.click(f"#nav-{view}")
    idle(page, view)
    ids = page.evaluate(
        "() => [...document.querySelectorAll('#main select')]"
        ".filter((s) => s.options.length > 1 && s.offsetParent && !s.id.startsWith('role-'))"
        ".map((s) => s.id)"
    )
    assert ids
    for name in ids:
        last = page.evaluate("id => [...document.getElementById(id).options].pop().value", name)
        page.select_option(f"#{name}", last)
        idle(page, view)
        page.evaluate("() => { document.querySelector('#main').dataset.view = ''; render(false); }")
        idle(page, view)
        assert page.input_value(f"#{name}") == last, name


def test_a_server_that_was_started_anew_is_heard(page: Any) -> None:
    """Its numbers begin anew, and are not taken for older news."""
    idle(page)
    page.evaluate("() => { app.state.said = 1e15; app.state.teller = 'before the restart'; }")
    page.evaluate("run('diagnose', {}, 'diagnose')")
    page.wait_for_function("() => app.state.teller !== 'before the restart'", timeout=20_000)
    idle(page, "diagnose")
    assert page.evaluate("() => app.state.diagnosis !== null && app.state.said < 1e15")
