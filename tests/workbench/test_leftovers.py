"""What a run leaves on the disk: nothing half written, nothing of killed runs, results held."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from identification import scratch
from identification.crash import internal_error
from identification.data.joint_file import load_joint
from identification.errors import InputError
from tests import kills
from workbench.cli.main import main
from workbench.page.session import Store

ROOT = Path(__file__).resolve().parents[2]
HOLDER = """
import sys
from pathlib import Path
from identification import scratch
WHAT
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def _own_temporary_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    yield
    scratch.release()


def other(what: str) -> subprocess.Popen[str]:
    """Another process at work, until it is ended."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER.replace("WHAT", what)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.communicate()


def test_two_runs_do_not_write_the_same_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "e.json"
    words = ["effects", "coulomb", "--json", str(target)]
    process = other(f"scratch.hold(Path({str(target)!r}))")
    try:
        assert main(words) == 2
        line = capsys.readouterr().err
        assert (
            line
            == f"irj: {target}: another irj is writing it; wait for it or write somewhere else\n"
        )
        assert not target.exists()
        assert main(["effects", "coulomb", "--json", str(tmp_path / "other.json")]) == 0
    finally:
        end(process)
    assert main(words) == 0, "the lock goes with its process"
    assert main(words) == 0, "and with the end of the work"
    assert json.loads(target.read_text())[0]["key"] == "coulomb"


def test_a_link_is_the_result_that_it_points_to(tmp_path: Path) -> None:
    (tmp_path / "link.json").symlink_to(tmp_path / "e.json")
    process = other(f"scratch.hold(Path({str(tmp_path / 'e.json')!r}))")
    try:
        assert main(["effects", "--json", str(tmp_path / "link.json")]) == 2
    finally:
        end(process)


def test_what_a_killed_run_left_half_written_goes(tmp_path: Path) -> None:
    stale = [".e.json.0123abcd.part"]
    stays = [".other.json.0123abcd.part", "e.json.part", ".e.json.part", ".e.json.0123abcd.txt"]
    for name in (*stale, *stays):
        (tmp_path / name).write_text("x")
    assert main(["effects", "--json", str(tmp_path / "e.json")]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*stays, "e.json", "tmp"])


def test_a_folder_of_results_is_swept_whole(tmp_path: Path) -> None:
    folder = tmp_path / "dist"
    (folder / ".build-abcd1234").mkdir(parents=True)
    (folder / ".build-abcd1234" / "plant.c").write_text("x")
    for name in (".axis.fmu.0123abcd.part", ".axis-abcd1234.part", "axis.fmu", ".build-notes"):
        (folder / name).write_text("x")
    scratch.hold(folder)
    assert sorted(p.name for p in folder.iterdir()) == [".build-notes", "axis.fmu"]
    process = None
    scratch.release()
    process = other(f"scratch.hold(Path({str(folder)!r}))")
    try:
        with pytest.raises(InputError, match="another irj"):
            scratch.hold(folder)
    finally:
        end(process)


def test_temporary_files_of_a_run_end_with_it(tmp_path: Path) -> None:
    outer = Path(tempfile.gettempdir())
    with scratch.own_folder():
        inner = Path(tempfile.gettempdir())
        assert inner.parent == outer == scratch.outer_folder()
        assert os.environ["TMPDIR"] == str(inner)
        made = Path(tempfile.mkdtemp())
        assert made.parent == inner
    assert not inner.exists()
    assert Path(tempfile.gettempdir()) == outer
    assert os.environ["TMPDIR"] == str(outer)


def test_temporary_files_of_a_killed_run_go_at_the_next_start(tmp_path: Path) -> None:
    outer = Path(tempfile.gettempdir())
    enter = "folder = scratch.own_folder(); folder.__enter__()"
    dead, alive = other(enter), other(enter)
    try:
        folders = set(outer.glob("irj-run-*"))
        assert len(folders) == 2
        dead.send_signal(signal.SIGKILL)
        dead.communicate()
        with scratch.own_folder():
            left = set(outer.glob("irj-run-*")) - {Path(tempfile.gettempdir())}
            assert len(left & folders) == 1, "that of the other run that works"
    finally:
        end(alive)


def test_the_trace_of_a_crash_outlives_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("IRJ_CRASHES", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", "/proc/no/such/place")
    with scratch.own_folder():
        said = internal_error(ValueError("x"))
    place = said.partition("kept in ")[2].partition(":")[0]
    assert "Traceback" in Path(place).read_text() or "ValueError" in Path(place).read_text()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_a_report_that_fails_loses_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kills.prepared(tmp_path / "run")
    run = tmp_path / "run"
    words = ["improve", str(run / "r.npz"), "--joint", str(run / "j.toml"), "--max-steps", "0"]
    outputs = ["--json", str(run / "i.json"), "-o", str(run / "o.toml"), "--report", "/dev/full"]
    assert main([*words, *outputs]) == 2
    assert "/dev/full: cannot be written (No space left on device)" in capsys.readouterr().err
    assert json.loads((run / "i.json").read_text())["steps"]
    assert load_joint(run / "o.toml").fitted


def test_sessions_are_swept_where_no_other_server_works(tmp_path: Path) -> None:
    root = tmp_path / "sessions"
    session = Store(root).create()
    scratch.release()
    built = session.folder / "exports" / "estimator"
    (built / ".build-abcd1234").mkdir(parents=True)
    for place in (
        session.folder / ".state.json.0123abcd.part",
        session.files / ".r.csv.0123abcd.part",
        built / ".build-abcd1234" / "plant.c",
    ):
        place.write_text("x")
    process = other(f"scratch.hold(Path({str(root)!r}))")
    try:
        Store(root)
        assert len(list(root.rglob("*.part"))) == 2
    finally:
        end(process)
    assert Store(root).open(session.id).load() is not None
    assert list(root.rglob("*.part")) == []
    assert list(built.iterdir()) == []


def test_a_killed_export(tmp_path: Path) -> None:
    assert kills.campaign(1, 1, tmp_path, ("export",)) == 0


def test_a_lock_that_is_given_back_leaves_nothing(tmp_path: Path) -> None:
    outer = Path(tempfile.gettempdir())
    for name in ("a", "b"):
        scratch.hold(tmp_path / name)
    assert len(list(outer.rglob("*"))) == 3
    scratch.release()
    assert list(outer.rglob("*")) == []
    process = other(f"scratch.hold(Path({str(tmp_path / 'a')!r}))")
    end(process)
    assert len(list(outer.rglob("*"))) == 2, "killed"
    with scratch.own_folder():
        assert list(outer.glob("irj-locks-*")) == []


def test_a_folder_is_held_whatever_folder_has_the_temporary_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two servers on the same sessions, started from desktop and service, each had its own."""
    held, mine, theirs = (tmp_path / name for name in ("session", "mine", "theirs"))
    for folder in (held, mine, theirs):
        folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(theirs))
    process = other(f"scratch.hold(Path({str(held)!r}))")
    monkeypatch.setattr(tempfile, "tempdir", str(mine))
    try:
        with pytest.raises(InputError, match="another irj is writing it"):
            scratch.hold(held)
        assert list(mine.rglob("irj-locks-*/*")) == [], "what was refused holds nothing"
    finally:
        end(process)
    scratch.hold(held)
    assert list(held.iterdir()) == []
