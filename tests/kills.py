"""Runs that are killed at a random moment: ``python -m tests.kills --count 40 --seed 0``.

Each of improve, report, batch, export and app is run once to its end, then killed (SIGKILL) at
random moments and run again. A result must be the old one, the whole new one or absent at any time;
after the next run results are the same as without a kill, and no half-written file and no temporary
folder is left.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

ROOT: Final = Path(__file__).resolve().parents[1]
DEMO: Final = ROOT / "workbench" / "demo"
ROWS: Final = 2500
JOINT: Final = """[joint]
name = "axis"
gear_ratio = -160.0
motor_constant = 0.0553
model = "hd3"
effects = ["viscous", "coulomb", "gravity"]
"""
STUDY: Final = """[study]
stop = 0.2
step = 0.01
record = ["link_position"]
chunk = 2

[[model]]
joint = "j.toml"
kind = "plant"

[inputs]
i_m = { time = [0.0, 0.1], value = [4.0, -2.0] }

[grid]
motor_inertia = { low = 2.0, high = 4.0, count = 12 }
"""
IMPROVE: Final = ("r.npz", "--joint", "j.toml", "--json", "i.json")
VERBS: Final[Mapping[str, tuple[str, ...]]] = {
    "improve": ("improve", *IMPROVE, "-o", "o.toml", "--picture", "p.svg"),
    "report": ("report", *IMPROVE, "-o", "r.html"),
    "batch": ("batch", "study.toml", "--jobs", "1", "--out", "runs"),
    "export": ("export", "plant", "--joint", "j.toml", "--out", "dist"),
    "app": ("app", "r.npz", "j.toml", "--no-browser"),
}
LEFT: Final = re.compile(r"\.part$|^\.build-|^\.write-|^\.fmu-|^irj-(?!locks-)")
"""Names that must not be there once a run has ended."""
PATIENCE: Final = 60.0
"""What a run may take to end when it is asked to [s]."""
NOTES: Final = (".lock", "batch.sha256")


def prepared(folder: Path) -> None:
    """The inputs of every verb."""
    folder.mkdir()
    (folder / "tmp").mkdir()
    with (DEMO / "train.npz").open("rb") as stream, np.load(stream) as archive:
        table = {name: archive[name][:ROWS] for name in archive.files}
    np.savez(folder / "r.npz", **table)
    (folder / "j.toml").write_text(JOINT)
    (folder / "study.toml").write_text(STUDY)


def started(verb: str, folder: Path) -> subprocess.Popen[str]:
    """A run in a process group of its own, with its own places for temporary files and state."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "TMPDIR": str(folder / "tmp"),
        "XDG_DATA_HOME": str(folder / "data"),
        "XDG_STATE_HOME": str(folder / "state"),
        "XDG_CACHE_HOME": str(folder / "cache"),
    }
    return subprocess.Popen(
        [sys.executable, "-m", "workbench", *VERBS[verb]],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def killed(process: subprocess.Popen[str], number: int = signal.SIGKILL) -> bool:
    """End a run that this campaign started, with its children; False where only SIGKILL ends it."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
    try:
        process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return False
    return True


def finished(verb: str, folder: Path) -> str:
    """Run to the end; what is wrong, or nothing."""
    process = started(verb, folder)
    if verb == "app":
        assert process.stdout is not None
        line = process.stdout.readline()
        ended = killed(process, signal.SIGINT)
        if "http://" not in line:
            return f"no address: {line!r}"
        return "" if ended else "does not end on SIGINT"
    _, err = process.communicate(timeout=300)
    return "" if process.returncode == 0 else f"exit {process.returncode}: {err.strip()[-300:]}"


def results(folder: Path) -> dict[str, bytes]:
    """What the runs have written, whole files only in comparable form."""
    out = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if (
            path.is_file()
            and name.partition("/")[0] not in ("tmp", "data", "state", "cache")
            and name not in ("r.npz", "j.toml", "study.toml")
            and path.name not in NOTES
            and not LEFT.search(path.name)
            and not any(LEFT.search(part) for part in name.split("/")[:-1])
        ):
            out[name] = comparable(path)
    return out


def comparable(path: Path) -> bytes:
    """The content without the moment at which it was made."""
    content = path.read_bytes()
    if path.suffix == ".npz":
        with zipfile.ZipFile(path) as archive:
            return b"".join(archive.read(name) for name in sorted(archive.namelist()))
    if path.suffix == ".html" or path.name == "summary.json":
        text = re.sub(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d)?", "", content.decode())
        return re.sub(r'"(seconds|per_second|started|ended)": [\d.e-]+', "", text).encode()
    return content


def leftovers(folder: Path) -> list[str]:
    """Half-written files and temporary folders."""
    return [p.relative_to(folder).as_posix() for p in folder.rglob("*") if LEFT.search(p.name)]


def tried(verb: str, folder: Path, want: Mapping[str, bytes], moment: float) -> list[str]:
    """Kill a run at a moment and run it again; what is wrong."""
    process = started(verb, folder)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=moment)
    killed(process)
    wrong = [
        f"{name} is neither absent nor whole"
        for name, content in results(folder).items()
        if name in want and content != want[name] and not name.startswith("runs/")
    ]
    for state in folder.glob("data/irj/sessions/*/state.json"):
        json.loads(state.read_text())
    if said := finished(verb, folder):
        wrong.append(f"the next run: {said}")
    found = results(folder)
    wrong += [
        f"{name} differs after the next run" for name in want if found.get(name) != want[name]
    ]
    wrong += [f"{name} is left after the next run" for name in leftovers(folder)]
    return wrong


def campaign(count: int, seed: int, place: Path, verbs: tuple[str, ...] = tuple(VERBS)) -> int:
    """Kill `count` runs in turn; the number of those after which something was wrong."""
    rng = random.Random(seed)
    want: dict[str, dict[str, bytes]] = {}
    length: dict[str, float] = {}
    for verb in verbs:
        prepared(place / verb)
        start = time.perf_counter()
        said = finished(verb, place / verb)
        length[verb] = time.perf_counter() - start
        want[verb] = results(place / verb)
        left = leftovers(place / verb)
        print(
            f"{verb}: {length[verb]:.1f} s, {len(want[verb])} results {said} {left or ''}",
            flush=True,
        )
        if said or left:
            return 1
    bad = 0
    for number in range(count):
        verb = verbs[number % len(verbs)]
        folder = place / verb
        fresh = rng.random() < 0.5
        if fresh:  # half of the runs find no results of an earlier one
            shutil.rmtree(folder)
            prepared(folder)
        moment = rng.uniform(0.2, 1.05 * length[verb])
        wrong = tried(verb, folder, want[verb], moment)
        bad += bool(wrong)
        print(
            f"{number + 1:3d} {verb:<8} killed after {moment:5.2f} s {'; '.join(wrong) or 'well'}",
            flush=True,
        )
    return bad


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.kills", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbs", nargs="+", choices=tuple(VERBS), default=list(VERBS))
    arguments = parser.parse_args()
    # a shell starts what runs in its background with SIGINT ignored, and runs would inherit that
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with tempfile.TemporaryDirectory(prefix="irj-kills-") as place:
        bad = campaign(arguments.count, arguments.seed, Path(place), tuple(arguments.verbs))
    print(f"{arguments.count} kills: {bad} wrong")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
