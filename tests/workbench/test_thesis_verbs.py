"""`irj twostep`, `irj prefilter`, `irj accelerometer`: the steps of the thesis, each behind a
command.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from identification import load_joint, read
from identification.data.prepare import butterworth
from workbench.cli.main import main

FloatArray = npt.NDArray[np.float64]

JOINT = """
[joint]
name = "rigid"
gear_ratio = -160.0
motor_constant = 0.0553
model = "hd1"
effects = ["viscous@motor", "coulomb@motor"]
"""
ELASTIC = JOINT.replace('"hd1"', '"hd3"').replace("@motor", "")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("thesis")
    (folder / "joint.toml").write_text(JOINT)
    (folder / "elastic.toml").write_text(ELASTIC)
    arguments = ["--seconds", "8", "--rate", "250", "--seed", "5", "-o", str(folder / "run.npz")]
    truth = ["--truth", str(folder / "truth.json")]
    assert main(["simulate", "--joint", str(folder / "joint.toml"), *arguments, *truth]) == 0
    rng = np.random.default_rng(0)
    for name, volts in (("up", 2.11), ("down", -2.69), ("flat", -0.31)):
        time = 1e-3 * np.arange(400)
        table = np.column_stack([time, volts + 1e-3 * rng.standard_normal(400)])
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header="time_s,out", comments="")
    return folder


@pytest.mark.parametrize("method", ["variable_projection", "alternating"])
def test_two_steps_give_back_the_friction_of_a_joint(method: str, place: Path) -> None:
    """Shapes may trade with each other; the friction torque they make is what the record holds."""
    out = place / f"{method}.json"
    arguments = [str(place / "run.npz"), "--joint", str(place / "joint.toml"), "--json", str(out)]
    assert main(["twostep", *arguments, "--method", method]) == 0
    found = {k: v["value"] for k, v in json.loads(out.read_text())["parameters"].items()}
    true = json.loads((place / "truth.json").read_text())["parameters"]
    v = np.linspace(0.05, 0.5, 50)

    def torque(p: dict[str, float]) -> FloatArray:
        smooth = p.get("motor_smoothing_velocity", 1e-3)
        made: FloatArray = p["motor_viscous"] * v + p["motor_coulomb"] * np.tanh(v / smooth)
        return made

    assert torque(found) == pytest.approx(torque(true), rel=0.02)
    whole = [sum(v for n, v in p.items() if n.endswith("inertia")) for p in (found, true)]
    assert whole[0] == pytest.approx(whole[1], rel=0.02)


def test_a_two_step_fit_becomes_a_joint_file(place: Path) -> None:
    fitted, told = place / "fitted.toml", place / "told.json"
    arguments = [str(place / "run.npz"), "--joint", str(place / "joint.toml"), "--json", str(told)]
    assert main(["twostep", *arguments, "-o", str(fitted)]) == 0
    found = json.loads(told.read_text())["parameters"]
    joint = load_joint(fitted)
    assert joint.fitted == pytest.approx({n: p["value"] for n, p in found.items()}, rel=1e-9)
    assert joint.errors["motor_viscous"] == pytest.approx(found["motor_viscous"]["deviation"])
    assert joint.sample_time == pytest.approx(4e-3)
    assert main(["compare", str(place / "run.npz"), "--joint", str(fitted), "--no-linear"]) == 0


def test_an_elastic_joint_needs_its_link_inertia(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = str(place / "elastic.toml")
    assert main(["twostep", str(place / "run.npz"), "--joint", joint]) == 2
    assert "give link_inertia in [known]" in capsys.readouterr().err


def test_the_prefilter_is_the_one_of_the_library(place: Path) -> None:
    out = place / "smooth.csv"  # nine digits
    arguments = [str(place / "run.npz"), "-o", str(out), "--derivatives", "--trim", "20"]
    assert main(["prefilter", *arguments]) == 0
    raw, smooth = read(place / "run.npz"), read(out)
    expected = butterworth(raw["motor_position"], raw.dt)[20:-20]
    assert smooth["motor_position"] == pytest.approx(expected, abs=1e-6)
    assert smooth.has("motor_acceleration", "motor_velocity")
    middle = slice(100, -100)
    slope = np.gradient(smooth["motor_velocity"], smooth.dt)[middle]
    assert smooth["motor_acceleration"][middle] == pytest.approx(slope, abs=1e-3)


def test_a_cutoff_over_half_the_rate_is_refused(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(place / "run.npz"), "-o", str(place / "no.npz"), "--cutoff", "200"]
    assert main(["prefilter", *arguments]) == 2
    assert "under half the sampling rate" in capsys.readouterr().err
    assert not (place / "no.npz").exists()


def test_an_accelerometer_is_calibrated_at_rest(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Annex A: offset -0.29 V from up and down, -0.31 V from the level positions, 2.4 V per g."""
    files = ["--up", str(place / "up.csv"), "--down", str(place / "down.csv")]
    out = place / "sensor.json"
    assert main(["accelerometer", *files, "--json", str(out)]) == 0
    found = json.loads(out.read_text())
    assert found["offset_v"] == pytest.approx(-0.29, abs=2e-4)
    assert found["volts_per_g"] == pytest.approx(2.4, abs=2e-4)
    level = ["--horizontal", str(place / "flat.csv")]
    assert main(["accelerometer", *files, *level, "--json", str(out)]) == 0
    assert json.loads(out.read_text())["offset_v"] == pytest.approx(-0.31, abs=2e-4)
    capsys.readouterr()
    assert main(["accelerometer", *files[:3], files[1]]) == 2
    assert "give the same output" in capsys.readouterr().err
    assert main(["accelerometer", *files, "--column", "none"]) == 2
    assert "give --column with one of out" in capsys.readouterr().err
