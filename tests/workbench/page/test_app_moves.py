"""A killed server, a full disk, a second tab and other moves lose no fit (`python -m
tests.workbench.page.moves` makes sixty).
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.workbench.chromium import needs_chromium

if sys.platform != "linux":
    pytest.skip("limits of another process are Linux's", allow_module_level=True)

from tests.workbench.page import moves

pytestmark = needs_chromium

WORST = (
    moves.refused_upload,
    moves.second_tab_adds,
    moves.held_and_released,
    moves.renamed_joint,
    moves.another_fit_opened,
    moves.other_role_and_back,
    moves.noted,
    moves.undone_and_another,
    moves.full_disk,
    moves.reloaded_at_work,
    moves.back_and_forward,
    moves.input_changed_at_work,
    moves.dead_server,
    moves.worker_killed,
    moves.killed_at_a_diagnosis,
)


HARDEST = (
    moves.full_disk,
    moves.refused_joint,  # says what is refused, and not how the work before ended
    moves.worker_killed,
    moves.killed_at_a_diagnosis,
    moves.undone_over_a_branch_by_keys,
    moves.folder_moved_away_and_back,
)
"""What an engineer's machine does by itself, in every run of the tests."""


@pytest.mark.slow
def test_no_kill_and_no_full_disk_loses_a_fit(tmp_path: Path) -> None:
    """The process of the work is killed and its end is one sentence; the server is killed and what
    ran is taken up again.
    """
    assert moves.made(tmp_path, list(HARDEST), print) >= 2


@pytest.mark.slow
def test_no_move_loses_a_fit(tmp_path: Path) -> None:
    assert moves.made(tmp_path, list(WORST), print) >= 5
