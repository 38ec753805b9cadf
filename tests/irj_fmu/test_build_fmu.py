"""The builder: what it makes, and that bad input is one line, exit 2 and no file."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from irj_fmu.build import main
from irj_fmu.fmi import package

ROOT = Path(__file__).resolve().parents[2]
JOINT = """
[joint]
name = "axis 3"
gear_ratio = -160.0
torque_per_current = -8.84
model = "hd3"
effects = ["viscous", "coulomb@motor", "gravity"]
[fitted]
motor_inertia = { value = 4.447, unit = "kg.m2" }
link_inertia = { value = 10.277, unit = "kg.m2" }
stiffness = { value = 2.15e4, unit = "N.m/rad" }
"""


@pytest.fixture
def joint(tmp_path: Path) -> Path:
    path = tmp_path / "joint.toml"
    path.write_text(JOINT)
    return path


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr("irj_fmu.fmi.compiler.has_zig", lambda: False)


def refused(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """Run the builder, expect exit 2 and one line."""
    assert main(argv) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert "Traceback" not in said.err
    return said.err


def test_script_builds_a_plant_from_another_folder(joint: Path, tmp_path: Path) -> None:
    """The shipped script, in a fresh process; the result is validated and reported."""
    report = tmp_path / "report.json"
    done = subprocess.run(
        [
            sys.executable,
            str(ROOT / "build_fmu.py"),
            "plant",
            "--joint",
            str(joint),
            "--out",
            "dist",
            "--controller",
            "--sensors",
            "--json",
            str(report),
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "smoke run passed" in done.stdout
    assert [p.name for p in (tmp_path / "dist").iterdir()] == ["axis_3_plant.fmu"]
    assert json.loads(report.read_text())["built"] == ["dist/axis_3_plant.fmu"]


def test_system_opens_and_its_estimator_learns(joint: Path, tmp_path: Path) -> None:
    """The SSP holds source, plant and estimator; fmpy simulates it."""
    from fmpy.ssp.simulation import simulate_ssp

    assert main(["ssp", "--joint", str(joint), "--out", str(tmp_path / "dist")]) == 0
    found = simulate_ssp(str(tmp_path / "dist" / "axis_3.ssp"), stop_time=0.5, step_size=1e-3)
    assert found["estimator.n_samples"][-1] > 400
    assert abs(found["plant.link_position"]).max() > 1e-3


def test_plant_as_fmi_3(joint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "dist"
    assert main(["plant", "--joint", str(joint), "--out", str(out), "--fmi", "3"]) == 0
    assert "FMI 3.0 model exchange and co-simulation" in capsys.readouterr().out
    from fmpy import read_model_description

    found = read_model_description(str(out / "axis_3_plant.fmu"))
    assert found.fmiVersion == "3.0"
    assert found.coSimulation is not None
    said = refused(capsys, "ssp", "--joint", str(joint), "--out", str(out), "--fmi", "3")
    assert "--fmi" in said


@pytest.mark.parametrize("kind", ["plant", pytest.param("estimator", marks=pytest.mark.slow)])
def test_same_content_same_bytes(kind: str, joint: Path, tmp_path: Path) -> None:
    made = []
    for folder in ("a", "b"):
        package._described.clear()  # written anew, by another process
        assert main([kind, "--joint", str(joint), "--out", str(tmp_path / folder)]) == 0
        made.append((tmp_path / folder / f"axis_3_{kind}.fmu").read_bytes())
    assert made[0] == made[1]


def test_without_compiler(
    joint: Path, tmp_path: Path, no_compiler: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """A plant is refused with a way out; the estimator still builds and runs."""
    out = tmp_path / "dist"
    said = refused(capsys, "plant", "--joint", str(joint), "--out", str(out))
    assert "estimator still builds" in said
    assert "pip install ziglang" in said
    assert not out.exists()
    assert main(["estimator", "--joint", str(joint), "--out", str(out)]) == 0
    assert "runs in Python hosts" in capsys.readouterr().out


@pytest.mark.parametrize(
    "text",
    [
        "[joint",
        "[other]\n",
        "[joint]\nmodel = 'hd9'\n",
        "[joint]\neffects = ['nonsense']\n",
        "[joint]\ngear_ratio = 0\n",
    ],
)
def test_broken_joint_file(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "broken.toml"
    path.write_text(text)
    for kind in ("plant", "estimator"):
        assert "broken.toml" in refused(
            capsys, kind, "--joint", str(path), "--out", str(tmp_path / "dist")
        )
    assert not (tmp_path / "dist").exists()


def test_missing_joint_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "none.toml" in refused(
        capsys, "plant", "--joint", str(tmp_path / "none.toml"), "--out", str(tmp_path / "dist")
    )


def test_folder_that_cannot_be_written(
    joint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file stands where the folder should be."""
    (tmp_path / "taken").write_text("")
    for place in ("taken", "taken/dist"):
        said = refused(capsys, "plant", "--joint", str(joint), "--out", str(tmp_path / place))
        assert "writable folder" in said
    assert (tmp_path / "taken").read_text() == ""


def test_a_failing_compiler_leaves_nothing(
    joint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(
        capsys, "plant", "--joint", str(joint), "--out", str(tmp_path / "dist"), "--cc", "false"
    )
    assert "false" in said
    assert not (tmp_path / "dist").exists()


def test_elastic_joint_without_link_encoder(
    joint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(
        capsys, "estimator", "--joint", str(joint), "--out", str(tmp_path / "dist"), "--no-link"
    )
    assert "link position" in said
