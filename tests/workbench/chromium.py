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
