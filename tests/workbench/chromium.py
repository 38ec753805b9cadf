"""Debian's Chromium, driven without a window, for tests of the page and of the report."""

from __future__ import annotations

import os
import threading
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


@contextmanager
def served(root: Path) -> Iterator[str]:
    """The page's server on sessions under `root`; gives its address."""
    import uvicorn

    from workbench.page.server import _listen, create_app

    listening = _listen(0)
    port = int(listening.getsockname()[1])
    server = uvicorn.Server(
        uvicorn.Config(
            create_app(root, port=port), log_level="error", ws="none", timeout_graceful_shutdown=1
        )
    )
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{port}/"
    finally:
        server.should_exit = True
        thread.join(10)
        listening.close()
