"""Every command that writes, on a disk that takes no more: one line that says what and where, exit
code 2, and every file as it was.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.workbench.hostile.test_hostile import JOINT
from tests.workbench.hostile.test_hostile_commands import FITTED

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits what a process writes")
ROOT = Path(__file__).resolve().parents[3]
NO_ROOM = "check the folder, its permissions and the space on the disk"
COMMANDS = {
    "fit": ("fit run.npz --joint joint.toml -o old.toml", NO_ROOM),
    "check": ("check run.npz --joint joint.toml --json old.json", NO_ROOM),
    "resample": ("resample run.npz -o old.csv", NO_ROOM),
    "simulate": ("simulate --joint fitted.toml -o old.csv --seconds 2", NO_ROOM),
    "add": ("add stribeck --joint fitted.toml -o old.toml", NO_ROOM),
    "track": ("track run.npz --joint fitted.toml --report old.html", NO_ROOM),
    "plant": ("export plant --joint fitted.toml --out dist", "room for its files in"),
}


def run(
    place: Path, words: str, bytes_left: int, code: str | None = None
) -> subprocess.CompletedProcess[str]:
    """A command, or Python code, as its own process, none of whose files can be longer than this;
    Python itself, which keeps a part of a compiled module then, writes none.
    """

    def limit() -> None:
        import resource

        resource.setrlimit(resource.RLIMIT_FSIZE, (bytes_left, bytes_left))

    return subprocess.run(
        [sys.executable, *(["-c", code] if code else ["-m", "workbench", *words.split()])],
        cwd=place,
        env={
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "PYTHONDONTWRITEBYTECODE": "1",
            "IDENTIFICATION_CACHE": str(place / "cache"),
        },
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=limit,  # noqa: PLW1509 - the child has one thread
        timeout=120,
    )


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Records, joint files and results of an earlier run."""
    folder = tmp_path / "Prüfstand 1"
    folder.mkdir()
    shutil.copyfile(ROOT / "workbench" / "demo" / "train.npz", folder / "run.npz")
    texts = {"joint.toml": JOINT, "fitted.toml": JOINT + FITTED}
    texts |= {f"old.{ending}": "as it was" for ending in ("toml", "json", "csv", "html")}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def there(place: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(place)): p.read_bytes()
        for p in place.rglob("*")
        if p.is_file() and "cache" not in p.parts
    }


@pytest.mark.parametrize("bytes_left", [0, 200])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_full_disk_is_one_line_and_nothing_is_lost(
    name: str, bytes_left: int, place: Path
) -> None:
    """With nothing left there is not even a folder for temporary files."""
    words, said = COMMANDS[name]
    before = there(place)
    done = run(place, words, bytes_left)
    assert done.stderr.startswith("irj: "), done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert done.returncode == 2
    assert said in done.stderr
    assert "old." in done.stderr or name == "plant"
    assert there(place) == before


def test_a_compiler_without_room_is_no_broken_compiler(place: Path) -> None:
    """Room enough for the sources, none for what it makes of them."""
    done = run(place, "export plant --joint fitted.toml --out dist", 60_000)
    assert done.returncode == 2
    assert "has no room for its files in" in done.stderr
    assert "free some space there, or name another folder with TMPDIR" in done.stderr
    assert not (place / "dist").exists()


def test_a_batch_without_room_leaves_no_half_of_a_result(place: Path) -> None:
    """Room enough for the FMU, none for the result of a run; with room it goes on."""
    study = '[study]\nstop = 10\n[[model]]\njoint = "fitted.toml"\n'
    (place / "study.toml").write_text(study)
    done = run(place, "batch study.toml --out res", 300_000)
    assert done.returncode == 2
    assert "res/chunks: cannot keep results there (File too large)" in done.stderr
    assert list(place.rglob("*.part")) == []
    assert run(place, "batch study.toml --out res", 1 << 30).returncode == 0


def test_a_full_disk_for_temporary_files_is_not_that_of_the_results(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where they are two, both are named: the system does not say which one it was."""
    other = Path("/dev/shm")
    if not other.is_dir() or other.stat().st_dev == place.stat().st_dev:
        pytest.skip("one file system here")
    monkeypatch.setenv("TMPDIR", str(other))
    done = run(place, "export estimator --joint fitted.toml --out dist", 3_000)
    assert done.returncode == 2
    assert done.stderr.startswith("irj: dist, or /dev/shm for temporary files: cannot write there")
    assert not (place / "dist").exists()


def test_what_a_compiler_only_speeds_up_does_without_its_cache(place: Path) -> None:
    code = (
        "from identification.recursive.compiler import NoCompilerError, build\n"
        "try:\n    build('int one(void) { return 1; }' + ' ' * 100000, 'one')\n"
        "except NoCompilerError as error:\n    print(error)\n"
    )
    done = run(place, "", 200, code=code)
    assert done.stdout == "the compiled library cannot be written (File too large)\n", done.stderr
    done = run(place, "", 1 << 30, code=code)
    assert (done.stdout, done.stderr) == ("", "")
