"""A command that takes too long ends with everything it has started."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from identification.recursive.compiler import run_whole

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no groups of processes there")


def _driver(late: Path) -> list[str]:
    """A driver that waits for a child, which leaves a file after half a second."""
    return ["sh", "-c", f"(sleep 0.5; touch '{late}') & wait; echo done; echo why >&2; exit 3"]


def test_what_a_command_says_is_kept(tmp_path: Path) -> None:
    done = run_whole(_driver(tmp_path / "late"), 60.0)
    assert (done.returncode, done.stdout, done.stderr) == (3, "done\n", "why\n")
    assert (tmp_path / "late").exists()


def test_a_child_ends_with_the_time_of_its_driver(tmp_path: Path) -> None:
    with pytest.raises(subprocess.TimeoutExpired):
        run_whole(_driver(tmp_path / "late"), 0.1)
    time.sleep(1.0)
    assert not (tmp_path / "late").exists()
