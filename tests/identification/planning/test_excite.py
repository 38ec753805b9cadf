"""Trajectory selection: motions of 3.8, measurement matrix, selection under limits."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from casadi_models import JointModel
from casadi_models.thesis import model_2b
from identification.data.joint_file import parse_joint
from identification.data.typical import true_values
from identification.errors import InputError
from identification.planning.trajectories import (
    WORKSPACE,
    Experiment,
    Limits,
    Motion,
    select,
    sinusoidal,
    sinusoidal_grid,
    triangular,
    triangular_grid,
)


@pytest.fixture(scope="module")
def model() -> JointModel:
    return model_2b().add("structural_damping").with_values({"structural_damping": 20.0})


@pytest.fixture(scope="module")
def full(model: JointModel) -> Experiment:
    return Experiment(model)


def test_no_part_of_gravity_chooses_the_motion() -> None:
    """The cosine part of a link that hangs is zero: every motion leaves it at the same thousands of
    percent, and the first of them would be the best.
    """
    table = {"gear_ratio": -160.0, "motor_constant": 0.05, "model": "hd3"}
    joint = parse_joint({"joint": {**table, "effects": ["viscous", "coulomb", "gravity"]}}, "j")
    model = joint.model().with_values({**true_values(joint.model(), joint), "gravity_cosine": 1e-3})
    assert [n for n in Experiment(model).parameters if "gravity" in n] == []
    assert "gravity_cosine" in model.linear_parameters


def consistent(motion: Motion, jump: float) -> None:
    """Velocity is the derivative of position, acceleration that of velocity, but for `jump`
    samples.
    """
    dt = motion.dt
    slope = np.diff(motion.position) / dt
    middle = 0.5 * (motion.velocity[1:] + motion.velocity[:-1])
    assert np.quantile(np.abs(slope - middle), 1 - jump) < 1e-4
    slope = np.diff(motion.velocity) / dt
    middle = 0.5 * (motion.acceleration[1:] + motion.acceleration[:-1])
    assert np.quantile(np.abs(slope - middle), 1 - jump) < 1e-2


@pytest.mark.parametrize("reversal", [0.0, 0.2])
def test_triangular_keeps_its_speed_and_the_workspace(reversal: float) -> None:
    speed = math.radians(45)
    motion = triangular(speed, reversal=reversal, duration=20.0, start=0.1)
    assert motion.position[0] == pytest.approx(0.1)
    assert np.max(np.abs(motion.position)) == pytest.approx(WORKSPACE, abs=2e-3)
    assert np.max(np.abs(motion.velocity)) == pytest.approx(speed)
    assert np.mean(np.abs(np.abs(motion.velocity) - speed) < 1e-9) > 0.9
    consistent(motion, 0.01)
    if reversal:
        assert np.max(np.abs(motion.acceleration)) == pytest.approx(2 * speed / reversal)


@pytest.mark.parametrize("hold", [0.0, 0.5])
def test_sinusoidal_starts_with_a_rendezvous(hold: float) -> None:
    """The case of figure 3.10: T = 0.9 s, x(0) = 20 deg, v = 15 deg/s."""
    speed, start = math.radians(15), math.radians(20)
    motion = sinusoidal(speed, 0.9, hold=hold, start=start, duration=40.0)
    lead, amplitude = motion.parameters["rendezvous"], motion.parameters["amplitude"]
    assert motion.position[0] == pytest.approx(start)
    assert abs(motion.velocity[0]) == pytest.approx(speed)
    at = round(lead / motion.dt)
    assert motion.position[at] == pytest.approx(-amplitude, abs=1e-4)
    assert abs(motion.velocity[at]) < 3e-3
    before = np.abs(motion.velocity[:at])
    assert np.all(np.diff(before) <= 0)
    after = motion.position[at:]
    assert np.max(after) == pytest.approx(amplitude, rel=1e-3)
    assert np.min(after) == pytest.approx(-amplitude, rel=1e-3)
    assert amplitude == pytest.approx(speed * 0.9 / (2 * math.pi) + speed * hold / 2)
    consistent(motion, 0.001)
    period = round((0.9 + 2 * hold) / motion.dt)
    assert motion.position[at + 500 + period] == pytest.approx(motion.position[at + 500], abs=1e-6)


def test_a_motion_is_saved_and_read(tmp_path: Path) -> None:
    motion = sinusoidal(0.3, 2.0, duration=2.0)
    path = tmp_path / "motion.csv"
    motion.save(path)
    assert path.read_text().splitlines()[0].startswith("time_s,reference_position_rad,")
    back = Motion.load(path)
    assert back.table == pytest.approx(motion.table, abs=1e-8)
    path.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="header"):
        Motion.load(path)


def test_the_cubic_stiffness_rules_the_smallest_singular_value(
    model: JointModel, full: Experiment
) -> None:
    """Section 3.8.4: it jumps from 1e-7 to 1e-1 without the cubic column, the largest stays."""
    motion = triangular(math.radians(30), reversal=0.1)
    whole, reduced = full.evaluate(motion), Experiment(model, reduced=True).evaluate(motion)
    assert "cubic_stiffness" in whole.parameters
    assert "cubic_stiffness" not in reduced.parameters
    assert 1e-8 < whole.smallest < 1e-5
    assert 1e-2 < reduced.smallest < 1.0
    assert reduced.largest == pytest.approx(whole.largest, rel=1e-3)
    normalised = full.evaluate(motion, normalised=True)
    assert normalised.condition < 1e-4 * whole.condition
    assert normalised.largest <= math.sqrt(len(whole.parameters))


def test_the_matrix_times_the_parameters_is_the_torque(model: JointModel) -> None:
    """phi of all linear parameters times their values is the drive, and zero for the link."""
    experiment = Experiment(model, parameters=model.linear_parameters)
    run = experiment.run(sinusoidal(0.5, 2.0, duration=4.0))
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    found = experiment.matrix(run) @ np.array([values[n] for n in experiment.parameters])
    assert found[:, 0] == pytest.approx(run.drive[::10], abs=1e-6)
    assert found[:, 1] == pytest.approx(np.zeros(len(found)), abs=1e-6)


def test_the_stated_deviation_is_that_of_least_squares(full: Experiment) -> None:
    motion = sinusoidal(0.6, 2.0, duration=6.0)
    run = full.run(motion)
    phi = full.matrix(run).reshape(-1, len(full.parameters))
    scale = np.linalg.norm(phi, axis=0)
    rng = np.random.default_rng(0)
    errors = (
        np.linalg.lstsq(phi / scale, 0.5 * rng.standard_normal((len(phi), 400)), rcond=None)[0]
        / scale[:, None]
    )
    spread = dict(zip(full.parameters, np.std(errors, axis=1).tolist(), strict=True))
    values = dict(zip(full.model.parameter_names, full.model.value_vector(), strict=True))
    found = full.evaluate(motion).relative_deviation
    for name in full.parameters:
        assert found[name] * abs(values[name]) == pytest.approx(spread[name], rel=0.15), name


def test_a_motion_that_does_not_move_identifies_nothing_of_friction(
    model: JointModel, full: Experiment
) -> None:
    still = Motion(
        np.arange(2000) * 1e-3, *(np.zeros(2000) for _ in range(3)), family="rest", parameters={}
    )
    found = full.evaluate(still)
    assert not any(found.identifiable().values())
    assert not found.by_effect(model)["viscous@motor"]


def test_selection_keeps_the_limits_and_names_the_best(full: Experiment, model: JointModel) -> None:
    motions = sinusoidal_grid([0.3, 0.7], [0.6, 3.0], duration=3.0)
    free = select(full, motions, criterion="fisher")
    worst = [max(e.relative_deviation.values()) for e in free.tried]
    assert max(free.best.relative_deviation.values()) == min(worst)
    assert set(free.best.by_effect(model)) == set(model.effects) - {"gravity_upright"}
    slow = select(full, motions, criterion="fisher", limits=Limits(speed=0.5))
    assert slow.best.motion.parameters["speed"] == pytest.approx(0.3)
    assert all(e.broken == ("speed",) for e in slow.tried if e.motion.parameters["speed"] > 0.6)
    with pytest.raises(InputError, match="no motion keeps the limits"):
        select(full, motions, limits=Limits(torque=1.0))


def test_the_thesis_criterion_takes_the_largest_smallest_singular_value(full: Experiment) -> None:
    found = select(full, triangular_grid([0.3, 0.5, 0.7], duration=5.0), criterion="singular_value")
    assert found.best.smallest == max(e.smallest for e in found.tried)


def test_refinement_is_not_worse_than_the_grid(full: Experiment) -> None:
    motions = sinusoidal_grid([0.3, 0.7], [0.8, 4.0], duration=3.0)
    grid = select(full, motions)
    fine = select(full, motions, refine=8)
    assert len(fine.tried) > len(grid.tried)
    assert max(fine.best.relative_deviation.values()) <= max(grid.best.relative_deviation.values())


def test_the_grids_span_the_ranges_of_the_thesis() -> None:
    speeds = [m.parameters["speed"] for m in triangular_grid()]
    assert [math.degrees(speeds[0]), math.degrees(speeds[-1])] == pytest.approx([15, 45])
    grid = sinusoidal_grid(duration=1.0)
    assert {round(m.parameters["period"], 6) for m in grid} >= {0.5, 6.0}


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (lambda: triangular(-1.0), "speed"),
        (lambda: triangular(1.0, start=9.0), "start"),
        (lambda: sinusoidal(0.5, 0.0), "period"),
        (lambda: sinusoidal(0.5, 1.0, hold=-1.0), "hold"),
        (lambda: Experiment(model_2b(), parameters=["colour"]), "no linear parameter"),
        (lambda: Experiment(model_2b(), noise=0.0), "noise"),
        (lambda: Experiment(model_2b().add("hysteresis")), "internal states"),
        (lambda: select(Experiment(model_2b()), [], criterion="best"), "criterion"),  # type: ignore[arg-type]
        (lambda: select(Experiment(model_2b()), []), "no motion"),
        (lambda: Experiment(model_2b()).evaluate(sinusoidal(0.5, 1.0, dt=0.01)), "sample time"),
    ],
)
def test_bad_input_is_one_line(action: Callable[[], object], words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        action()
    assert "\n" not in str(caught.value)
