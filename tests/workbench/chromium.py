"""Debian's Chromium, driven without a window, for tests of the page and of the report."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = Path(os.environ.get("IRJ_CHROMIUM", "/usr/bin/chromium"))
CI = bool(os.environ.get("CI"))

playwright_sync = (
    pytest.importorskip("playwright.sync_api")
    if not CI
    else __import__("playwright.sync_api", fromlist=["x"])
)
LATE = int(os.environ.get("IRJ_LATE", "0"))
"""Every answer of the server reaches the page later, by a time between nothing and this many
milliseconds: what passes on a quick machine only by chance fails here."""

HOLD_BACK = (
    "{ const fetched = window.fetch; window.fetch = async (...asked) => {"
    " const answer = await fetched(...asked);"
    " await new Promise((go) => setTimeout(go, Math.random() * LATE));"
    " return answer; }; }"
)

needs_chromium = pytest.mark.skipif(
    not CI and not CHROMIUM.exists(), reason="no chromium here (with CI set this fails)"
)


@contextmanager
def launched() -> Iterator[Any]:
    """A browser, closed at the end."""
    assert CHROMIUM.exists(), f"{CHROMIUM} is missing"
    with playwright_sync.sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        yield chromium
        chromium.close()


def context_of(chromium: Any, **options: Any) -> Any:
    """A context of the browser; options as its own."""
    context = chromium.new_context(**options)
    if LATE:
        context.add_init_script(HOLD_BACK.replace("LATE", str(LATE)))
    return context


def fit_demo(page: Any, address: str) -> None:
    """The page with the embedded demo, its fit asked for."""
    page.goto(address)
    page.click("#demo")
    page.wait_for_selector("#fit", timeout=60_000)
    page.click("#fit")
