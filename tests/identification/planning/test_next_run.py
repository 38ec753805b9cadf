"""The run that separates: motions that can be played, expected differences that come true."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.next_run import one_joint
from casadi_models import JointModel
from identification import Joint, Record, improve
from identification.fitting.fit import fit
from identification.naming.contest import FEWEST
from identification.planning.blind import blind_spots
from identification.planning.motion import Motion
from identification.planning.next_run import KNOWN, next_run
from identification.planning.rivals import enough, power
from identification.planning.runs import FAMILIES, LOADS, Plant, Run
from identification.planning.trajectories import Limits
from tests.hidden_effect.generator import generate_case
from tests.identification.fitting.test_errors_in_variables import JOINT as ARM
from tests.identification.fitting.test_errors_in_variables import run as slow_run
from workbench.cli.main import main

DT = 2e-3
SPEED, HALF, CENTRE = 0.8, 0.9, 0.3


@pytest.mark.parametrize("family", list(FAMILIES))
def test_every_motion_keeps_its_limits_and_starts_at_rest(family: str) -> None:
    motion = Run(family, CENTRE, HALF, SPEED).motion(12.0, DT)
    assert len(motion.time) == 6000
    assert np.abs(motion.position - CENTRE).max() <= HALF * (1 + 1e-9)
    assert np.abs(motion.velocity).max() <= SPEED * (1 + 1e-9)
    assert abs(motion.velocity[0]) < 0.01 * SPEED
    np.testing.assert_allclose(np.gradient(motion.position, DT), motion.velocity, atol=1e-9)
    assert np.ptp(motion.position) > 0.05 * HALF
    turns = np.count_nonzero(np.diff(np.sign(motion.velocity[np.abs(motion.velocity) > 1e-6])))
    assert turns >= 2


def test_a_motion_is_a_file_that_a_robot_can_play(tmp_path: Path) -> None:
    motion = Run("sweep", 0.0, HALF, SPEED).motion(3.0, DT)
    motion.save(tmp_path / "motion.csv")
    again = Motion.load(tmp_path / "motion.csv")
    np.testing.assert_allclose(again.table, motion.table, rtol=1e-8, atol=1e-9)


def test_power_is_the_chance_that_drawn_differences_are_over_the_limit() -> None:
    drawn = np.random.default_rng(0).normal(20.0, np.sqrt(2 * 20.0), 200_000)
    assert power(20.0) == pytest.approx(np.mean(drawn > FEWEST), abs=0.003)
    assert power(enough()) == pytest.approx(0.95, abs=1e-3)
    assert power(0.0) == 0.0


def test_a_rigid_joint_is_driven_along_its_reference() -> None:
    model = JointModel.by_name("hd1", 100.0, effects=("viscous@motor", "gravity"))
    values = {
        "motor_inertia": 2.0,
        "link_inertia": 3.0,
        "motor_viscous": 4.0,
        "gravity_torque": 9.0,
    }
    run = Run("multisine", 0.2, 0.6, 0.7)
    followed = Plant(model.with_values(values), DT).run(run, 6.0)
    assert followed is not None
    motion = run.motion(6.0, DT)
    # the equation of motion itself; upright positive
    expected = 5.0 * motion.acceleration + 4.0 * motion.velocity - 9.0 * np.sin(motion.position)
    np.testing.assert_allclose(followed.drive, expected, atol=1e-6)


def test_without_gravity_the_drive_holds_nothing() -> None:
    model = JointModel.by_name("hd3", 100.0, effects=("viscous", "gravity"))
    model = model.with_values(
        {
            "motor_inertia": 2.0,
            "link_inertia": 3.0,
            "stiffness": 2e4,
            "structural_damping": 20.0,
            "motor_viscous": 4.0,
            "gravity_torque": 50.0,
        }
    )
    plant, run = Plant(model, DT), Run("slow triangles", 0.8, 0.3, 0.5)
    torque = {}
    for load in LOADS:
        followed = plant.run(Run(run.family, run.centre, run.half, run.speed, load), 4.0)
        assert followed is not None
        torque[load] = float(np.mean(followed.torque))
    assert torque[0.0] == pytest.approx(0.0, abs=0.5)
    assert torque[0.5] == pytest.approx(torque[1.0] / 2, rel=0.05)


def test_the_proposed_run_tells_the_names_apart_as_expected() -> None:
    before, proposed, _ = one_joint("gain", "added_spring", 8002)
    assert not before[1].one
    assert proposed[1].one
    assert 0.5 < proposed[1].found / proposed[1].expected < 2.0


@pytest.mark.parametrize("seed", [5, 7, 9])
def test_an_inertia_that_noise_hides_is_planned_for_and_then_known(seed: int) -> None:
    """Slow motion tells nothing of it, however many noisy accelerations its rows hold."""
    train, true = slow_run(seed, noise=2.0, pace=0.1)
    held = slow_run(seed, noise=2.0)[0].renamed("held")
    planned = next_run(improve([train], ARM, [held]), limits=Limits(0.85, 3.0))
    assert planned.sharpened is not None
    assert planned.motion is not None
    now, after = planned.sharpened.errors["link_inertia"]
    assert now > 1
    assert after < KNOWN
    assert "rad/s" in str(planned)
    q, v, a = planned.motion.position, planned.motion.velocity, planned.motion.acceleration
    torque = true["link_inertia"] * a + true["link_viscous"] * v
    torque -= true["gravity_torque"] * np.sin(q)
    rng = np.random.default_rng(seed)
    channels = {
        "link_position": q + 1.2e-3 * rng.standard_normal(len(q)),
        "link_torque": torque + 0.4 * rng.standard_normal(len(q)),
    }
    played = Record.from_channels(planned.motion.time, channels, name="played")
    solution = fit(ARM, [train, played]).solution
    error = solution.stderr["link_inertia"]
    assert error is not None
    assert 1 / 3 < error / solution.values["link_inertia"] / after < 3
    assert abs(solution.values["link_inertia"] - true["link_inertia"]) < 3 * error


@pytest.mark.slow
def test_no_motion_tells_an_offset_from_direction_dependent_friction(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = generate_case("asymmetric_coulomb", 7001, folder=tmp_path / "case")
    out, motion = tmp_path / "next.json", tmp_path / "motion.csv"
    words = [str(folder / "train.csv"), "--held-out", str(folder / "test.csv")]
    joint = ["--joint", str(folder / "joint.toml"), "--json", str(out), "-o", str(motion)]
    assert main(["next", *words, *joint]) == 0
    found = json.loads(out.read_text())
    assert found["runs"] == []
    assert len(found["cannot"]) == 1
    assert "brake closed" in found["cannot"][0]
    assert not motion.exists()
    assert "no run is proposed" in capsys.readouterr().out


def test_before_any_record_it_says_what_a_run_cannot_show(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = Joint(name="arm", gear_ratio=160.0, model_name="hd3", effects=("viscous", "coulomb"))
    run = Run("multisine", 0.0, 0.8, 0.8)
    found = blind_spots(joint, run.motion(12.0, DT))
    assert ("asymmetric_coulomb", "current_offset") in found.ties
    assert {"stribeck", "added_spring", "kinematic_error"} <= set(found.seen)
    still = blind_spots(joint, Run("multisine", 0.0, 0.02, 0.02).motion(12.0, DT))
    # a motion that hardly moves shows less of everything that goes with speed or travel
    for key in ("quadratic_drag", "cubic_viscous", "added_spring"):
        assert still.seen.get(key, 0.0) < 0.1 * found.seen[key]
    rigid = tmp_path / "rigid.toml"
    rigid.write_text('[joint]\ngear_ratio = 100.0\neffects = ["viscous", "coulomb"]\n')
    out = tmp_path / "blind.json"
    assert main(["next", "--joint", str(rigid), "--json", str(out)]) == 0
    hidden = {e["effect"] for e in json.loads(out.read_text())["not_visible"]}
    assert {"load_dependent_friction", "backlash", "torque_sensor_gain"} <= hidden
    assert "load-dependent friction will not be visible" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words", [["--max-speed", "-3"], ["--max-position", "0"], ["--motion", "nothing.csv"]]
)
def test_wrong_options_are_one_line(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rigid = tmp_path / "rigid.toml"
    rigid.write_text('[joint]\ngear_ratio = 100.0\neffects = ["viscous", "coulomb"]\n')
    assert main(["next", "--joint", str(rigid), *words]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
