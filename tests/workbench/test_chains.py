"""Every command on the output of the one before, as a user works, and with an effect of the user's
own; and a new effect of the library is one file.

Each command is a process of its own, as at a terminal: nothing is remembered but files.
"""

from __future__ import annotations

import http.client
import json
import os
import re
import shutil
import subprocess
import sys
from importlib.resources import files
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

from casadi_models import EFFECTS
from tests.identification.data.test_own_effects import KEY, OWN
from tests.irj_fmu.imported.test_user_fmu import FILE
from tests.user_fmus.make import Make, build
from tests.user_fmus.records import axis

pytest.importorskip("starlette")

ROOT = Path(__file__).resolve().parents[2]
DEMO = Path(str(files("workbench"))) / "demo"
TORQUE, WIDTH = 9.0, 0.15
"""Typical sizes that the own effect declares, so what `simulate --hide` takes."""
STUDY = """
[study]
every = 10
[[model]]
joint = "better.toml"
[records]
files = ["held_out.npz"]
[grid]
motor_seal_torque = [0.0, 9.0]
"""


class Folder:
    """A user's folder: commands run in it, each in a process of its own."""

    def __init__(self, path: Path, packages: Path = ROOT) -> None:
        self.path = path
        self.environment = {
            **os.environ,
            "PYTHONPATH": str(packages),
            "IRJ_ALLOWED_EFFECTS": str(path / "allowed.txt"),
            "IRJ_SESSIONS": str(path / "sessions"),
        }

    def run(self, *words: str, code: int = 0) -> str:
        """What a command prints; it must end as expected."""
        done = subprocess.run(
            [sys.executable, "-m", "workbench", *words],
            cwd=self.path,
            env=self.environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == code, f"irj {' '.join(words)}\n{done.stdout}{done.stderr}"
        return done.stdout

    def json(self, *words: str) -> dict[str, object]:
        """What a command writes with ``--json``."""
        self.run(*words, "--json", "said.json")
        found: dict[str, object] = json.loads((self.path / "said.json").read_text())
        return found

    def asked(self, path: str, *words: str) -> dict[str, object]:
        """What the page of ``irj app`` answers to one request."""
        with subprocess.Popen(
            [sys.executable, "-m", "workbench", "app", *words, "--no-browser"],
            cwd=self.path,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as server:
            try:
                assert server.stdout is not None
                first = server.stdout.readline()
                address = re.search(r"127\.0\.0\.1:(\d+)", first)
                assert address, first
                asking = http.client.HTTPConnection("127.0.0.1", int(address[1]), timeout=60)
                asking.request("GET", path, headers={"X-IRJ": "1"})
                found: dict[str, object] = json.loads(asking.getresponse().read())
                asking.close()
                return found
            finally:
                server.kill()


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    """demo -> add what it names -> fit."""
    folder = Folder(tmp_path_factory.mktemp("demo"))
    for name in ("train.npz", "held_out.npz", "joint.toml"):
        shutil.copy(DEMO / name, folder.path / name)
    named = folder.json("demo", "--report", "demo.html")["added"]
    assert isinstance(named, list)
    folder.run("add", named[0], "--joint", "joint.toml", "-o", "larger.toml")
    folder.run("fit", "train.npz", "--joint", "larger.toml", "-o", "better.toml")
    return folder


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    """simulate with an own effect hidden -> improve, which adds it."""
    folder = Folder(tmp_path_factory.mktemp("own"))
    (folder.path / "seal.py").write_text(OWN)
    shutil.copy(DEMO / "joint.toml", folder.path / "joint.toml")
    hide = ("simulate", "--joint", "joint.toml", "--hide", f"{KEY}@motor", "--effects", "seal.py")
    for seed, name in enumerate(("train.npz", "held_out.npz"), 1):
        folder.run(*hide, "--seconds", "10", "--rate", "250", "--seed", str(seed), "-o", name)
    said = folder.json(
        *("improve", "train.npz", "--held-out", "held_out.npz", "--joint", "joint.toml"),
        *("--max-steps", "1", "--effects", "seal.py", "-o", "better.toml"),
    )
    claims = said["claims"]
    assert isinstance(claims, list)
    assert claims[0]["effects"][0] == KEY
    return folder


# --- the demo's joint -----------------------------------------------------------------------------


def test_the_improved_joint_reaches_the_floor_when_it_is_compared(demo: Folder) -> None:
    before = demo.run("compare", "held_out.npz", "--fit", "train.npz", "--joint", "joint.toml")
    after = demo.run("compare", "held_out.npz", "--joint", "better.toml", "--no-linear")
    motor = [float(re.findall(r"motor (\S+) times its floor", t)[0]) for t in (before, after)]
    assert motor[0] > 10
    assert motor[1] < 1.5
    assert "fails most against motor velocity" in before
    assert "fails most" not in after  # what is left depends on nothing
    assert "explains 0 %" not in before + after


def test_the_improved_joint_is_tracked_without_a_fault(demo: Folder) -> None:
    words = ("track", "held_out.npz", "--joint", "better.toml", "--healthy", "train.npz")
    demo.run(*words, "--fail-on-fault", "--report", "track.html")
    assert "<svg" in (demo.path / "track.html").read_text(encoding="utf-8")
    demo.run(*words, "--fail-on-fault", "--inject", "link_position:bias:6:0.05", code=1)


def test_a_motion_is_planned_for_the_improved_joint(demo: Folder) -> None:
    """The command of docs/guide.md."""
    demo.run("plan", "--joint", "better.toml", "-o", "next.csv")
    motion = np.genfromtxt(demo.path / "next.csv", delimiter=",", names=True)
    position = motion["reference_position_rad"]
    speed = np.gradient(position, motion["time_s"])
    assert 0.0 < np.max(np.abs(position)) <= np.deg2rad(85.0) + 1e-9
    assert np.deg2rad(3.0) < np.max(np.abs(speed)) <= np.deg2rad(60.0) + 1e-9


# --- an own effect through every command ----------------------------------------------------------


def test_an_own_effect_is_fitted_compared_tracked_and_shown(own: Folder) -> None:
    """After `improve` no command needs ``--effects``: the joint file remembers the file."""
    text = (own.path / "better.toml").read_text()
    assert "seal.py" in text
    fitted = {
        name: float(value)
        for name, value in re.findall(r"^(motor_seal_\w+) = { value = (\S+),", text, re.MULTILINE)
    }
    assert fitted["motor_seal_torque"] == pytest.approx(TORQUE, rel=0.1)
    assert fitted["motor_seal_width"] == pytest.approx(WIDTH, rel=0.1)
    compared = own.run("compare", "held_out.npz", "--joint", "better.toml", "--no-linear")
    assert float(re.findall(r"motor (\S+) times its floor", compared)[0]) < 1.5
    own.run("track", "held_out.npz", "--joint", "better.toml", "--healthy", "train.npz")
    assert "motor_seal_torque" in own.run("show", "--joint", "better.toml")
    assert "rubbing shaft seal" in own.run("effects", KEY, "--effects", "seal.py")
    changed = own.run("changed", "better.toml", "held_out.npz")
    assert "nothing changed" in changed or "changed: " in changed
    assert "changed: motor_seal_torque" not in changed


def test_an_own_effect_is_in_the_report(own: Folder) -> None:
    own.run(
        *("report", "train.npz", "--held-out", "held_out.npz", "--joint", "better.toml"),
        *("-o", "report.html"),
    )
    assert "motor seal torque" in (own.path / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("kind", [pytest.param("all", marks=pytest.mark.slow), "c", "casadi"])
def test_an_own_effect_is_exported_in_every_kind(own: Folder, kind: str) -> None:
    """``all`` is plant, plant with controller, estimator, native estimator and system."""
    said = own.run("export", kind, "--joint", "better.toml", "--out", f"dist-{kind}")
    made = {p.name: p for p in (own.path / f"dist-{kind}").iterdir()}
    if kind != "all":
        names = [p["name"] for p in json.loads(made["parameters.json"].read_text())]
        assert {"motor_seal_torque", "motor_seal_width"} <= set(names)
        return
    assert said.count("smoke run passed") >= 3, said
    described = {}
    for name, path in made.items():
        with ZipFile(path) as archive:
            if "modelDescription.xml" in archive.namelist():
                described[name] = archive.read("modelDescription.xml").decode()
            if name.endswith("_estimator.fmu"):
                bundled = archive.read("resources/bundle/casadi_models/effects/own_1.py").decode()
                assert bundled == OWN
    assert len(described) >= 4
    assert [name for name, text in described.items() if "motor_seal_torque" not in text] == []


def test_plant_and_estimator_with_an_own_effect_run_together(own: Folder) -> None:
    said = own.run("cosim", "--joint", "better.toml", "--stop", "10")
    plant, estimate = map(float, re.findall(r"motor_seal_torque +N\.m +(\S+) +(\S+)", said)[0])
    assert estimate == pytest.approx(plant, rel=0.02)


def test_a_study_varies_a_parameter_of_an_own_effect(own: Folder) -> None:
    (own.path / "study.toml").write_text(STUDY)
    own.run("batch", "study.toml", "--jobs", "1", "--fail-on-error")
    table = (own.path / "study-results" / "summary.csv").read_text().splitlines()
    assert len(table) == 3
    assert "motor_seal_torque" in table[0]


def test_the_page_opens_a_joint_with_an_own_effect(own: Folder) -> None:
    config = own.asked("/api/config", "better.toml", "held_out.npz")
    keys = [e["key"] for e in config["effects"]]  # type: ignore[attr-defined]
    assert KEY in keys


def test_an_own_effect_rides_outside_a_foreign_fmu(tmp_path: Path) -> None:
    """add -> compare: the file of the FMU's joint remembers the effect's file, too."""
    folder = Folder(tmp_path)
    (tmp_path / "seal.py").write_text(OWN)
    build("Axis", tmp_path, Make(2, ("CoSimulation",))).replace(tmp_path / "axis.fmu")
    (tmp_path / "user.toml").write_text(FILE.format(fmu="axis.fmu"))
    record = axis(seconds=3.0, h=5e-3)
    np.savez(
        tmp_path / "run.npz",
        time_s=record.time,
        motor_position_rad=record["motor_position"],
        motor_torque_Nm=record["motor_torque"],
    )
    folder.run(
        *("add", f"{KEY}@motor", "--joint", "user.toml", "--effects", "seal.py"),
        *("-o", "larger.toml"),
    )
    said = [
        folder.run("compare", "run.npz", "--joint", name) for name in ("user.toml", "larger.toml")
    ]
    assert "motor_position" in said[1]
    assert said[0] == said[1], "an effect of size 0 changes nothing"


# --- a new effect of the library is one file ------------------------------------------------------

NEW = '''
"""Friction of a lip seal."""

import casadi as ca

from ..effect import effect
from ..parameter import amplitude, shape


@effect(
    "lip_seal",
    title="lip seal",
    family="friction",
    acts_on=("motor",),
    parameters=(
        amplitude("lip_torque", "N.m", "torque where it rubs most", typical=9.0),
        shape("lip_width", "rad", "half the angle over which it rubs", (0.1, 0.2, 0.4), "position",
              start=0.2, low=0.01, high=3.0, typical=0.15),
    ),
    absence="friction in one sector", excitation="a slow turn in both directions",
    source="this test", dissipative=True, needs=("coulomb",),
)
def lip_seal(s, p):
    """Friction that grows towards zero position."""
    return p.lip_torque * ca.exp(-((s.position / p.lip_width) ** 2)) * s.direction
'''


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    """A copy of the packages with one file more."""
    place = tmp_path_factory.mktemp("packages")
    skip = shutil.ignore_patterns("__pycache__")
    for name in ("casadi_models", "identification", "irj_fmu", "workbench"):
        shutil.copytree(ROOT / name, place / name, ignore=skip)
    (place / "casadi_models" / "effects" / "lip_seal.py").write_text(NEW)
    folder = Folder(tmp_path_factory.mktemp("new"), place)
    shutil.copy(DEMO / "joint.toml", folder.path / "joint.toml")
    return folder


@pytest.mark.slow
def test_a_new_effect_is_one_file(library: Folder) -> None:
    """Listed, on both pages, hidden, diagnosed, added, exported and offered in the browser."""
    assert "lip_seal" not in EFFECTS
    assert "lip_seal" in library.run("effects")
    hide = ("simulate", "--joint", "joint.toml", "--hide", "lip_seal", "--rate", "250")
    for seed, name in enumerate(("train.npz", "held_out.npz"), 1):
        library.run(*hide, "--seconds", "10", "--seed", str(seed), "-o", name)
    library.run(
        *("diagnose", "train.npz", "--held-out", "held_out.npz", "--joint", "joint.toml"),
        *("-o", "larger.toml"),
    )
    assert '"lip_seal"' in (library.path / "larger.toml").read_text()
    library.run("fit", "train.npz", "--joint", "larger.toml", "-o", "better.toml")
    said = library.run("export", "estimator", "--joint", "better.toml", "--out", "dist")
    assert "smoke run passed" in said
    with ZipFile(next((library.path / "dist").glob("*_estimator.fmu"))) as archive:
        described = archive.read("modelDescription.xml").decode()
        assert "resources/bundle/casadi_models/effects/lip_seal.py" in archive.namelist()
    assert "motor_lip_torque" in described or "lip_torque" in described
    config = library.asked("/api/config", "better.toml")
    assert "lip_seal" in [e["key"] for e in config["effects"]]  # type: ignore[attr-defined]
    page = subprocess.run(
        [sys.executable, "-m", "casadi_models.text.effects_doc"],
        env=library.environment,
        capture_output=True,
        text=True,
        check=True,
        cwd=library.path,
    ).stdout
    assert "| `lip_seal` | lip seal | motor |" in page
