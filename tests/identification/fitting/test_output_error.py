"""Output-error refinement: parameters of simulated joints, the error it lowers, what it refuses."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import JointModel
from casadi_models.simulate import simulate
from identification import InputError, Joint, Record, load_joint, read
from identification.fitting.fit import Fit, fit
from identification.fitting.output_error import Refinement, refine

FloatArray = npt.NDArray[np.float64]
SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "hidden_effect"
RATIO = 160.0
TURN = 2 * np.pi / 360

ELASTIC = {
    "motor_inertia": 4.6,
    "link_inertia": 10.0,
    "stiffness": 1.5e4,
    "structural_damping": 32.0,
    "gravity_torque": -100.0,
    "motor_viscous": 12.0,
    "link_viscous": 4.0,
    "motor_coulomb": 15.0,
    "link_coulomb": 2.0,
    "motor_smoothing_velocity": 0.02,
    "link_smoothing_velocity": 0.02,
}
RIGID = {
    "inertia": 14.0,
    "gravity_torque": -100.0,
    "motor_viscous": 12.0,
    "motor_coulomb": 15.0,
    "motor_smoothing_velocity": 0.02,
}


def drive_torque(seconds: float, dt: float) -> FloatArray:
    """Sum of sines that swings the joint over some 60 degrees and lets it turn round often
    [N.m].
    """
    t = np.arange(round(seconds / dt)) * dt
    parts = [(60.0, 5.3), (35.0, 1.9), (25.0, 0.83), (15.0, 0.31), (10.0, 0.11)]
    out: FloatArray = sum(
        (a * np.sin(2 * np.pi * t / p + i) for i, (a, p) in enumerate(parts)), np.zeros(len(t))
    )
    return out * np.clip(t, 0, 1)


def measured(model: JointModel, seed: int, *, elastic: bool) -> Record:
    """A record with the sensors of the thesis's table B.1: encoders 0.16 deg (motor) and 0.0036
    deg (link), torque 50 mN.m.
    """
    dt = 2e-3
    drive = drive_torque(16.0, dt)
    run = simulate(model, drive, dt, substeps=8)
    rng = np.random.default_rng(seed)
    grain_motor, grain_link = 0.16 * TURN / RATIO, 0.0036 * TURN
    channels = {
        "motor_current": (drive + rng.normal(0, 0.035, len(drive))) / 8.848,
        "motor_position": np.round(run.readings[:, 0] / grain_motor) * grain_motor * RATIO,
    }
    if elastic:
        channels["link_position"] = np.round(run.readings[:, 2] / grain_link) * grain_link
        channels["link_torque"] = run.readings[:, 4] + rng.normal(0, 0.05, len(drive))
    return Record.from_channels(run.time, channels, name=f"seed {seed}")


@cache
def case(kind: str) -> tuple[Fit, Refinement, dict[str, float]]:
    elastic = kind == "elastic"
    joint = Joint(
        name=kind,
        gear_ratio=RATIO,
        torque_per_current=8.848,
        model_name="hd3" if elastic else "hd1",
        effects=("viscous", "coulomb", "gravity")
        if elastic
        else ("viscous@motor", "coulomb@motor", "gravity"),
    )
    truth = ELASTIC if elastic else RIGID
    model = joint.model() if elastic else replace(joint.model(), inertias=("inertia",))
    first = fit(joint, measured(model.with_values(truth), 3, elastic=elastic))
    return first, refine(first), truth


@pytest.mark.parametrize("kind", ["elastic", "rigid"])
def test_parameters_are_within_half_a_percent_of_truth(kind: str) -> None:
    _, refined, truth = case(kind)
    for name, value in truth.items():
        if not name.endswith("_smoothing_velocity"):
            assert refined.values[name] == pytest.approx(value, rel=5e-3), name


@pytest.mark.parametrize("kind", ["elastic", "rigid"])
def test_output_error_falls_to_the_noise_of_the_channels(kind: str) -> None:
    _, refined, _ = case(kind)
    assert refined.cost_after <= refined.cost_before
    assert refined.cost_after == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("kind", ["elastic", "rigid"])
def test_refined_values_are_those_of_the_fit_it_returns(kind: str) -> None:
    first, refined, _ = case(kind)
    assert refined.model.values == pytest.approx(dict(refined.values))
    assert refined.fit.joint is first.joint
    assert refined.parameters["gravity_torque"]["value"] == refined.values["gravity_torque"]


def test_start_values_off_by_a_tenth_are_pulled_back() -> None:
    first, _, truth = case("elastic")
    solution = first.solution
    off = {
        n: v * (1.1 if n in ("motor_inertia", "stiffness", "motor_coulomb") else 1.0)
        for n, v in solution.values.items()
    }
    spoiled = replace(
        first, solution=replace(solution, values=off, model=solution.model.with_values(off))
    )
    refined = refine(spoiled, iterations=15)
    assert refined.cost_before > 2 * refined.cost_after
    for name in ("motor_inertia", "stiffness", "motor_coulomb"):
        assert refined.values[name] == pytest.approx(truth[name], rel=5e-3), name


def test_internal_states_are_refused() -> None:
    first, _, _ = case("rigid")
    solution = first.solution
    with_memory = replace(
        first, solution=replace(solution, model=solution.model.add("lugre@motor"))
    )
    with pytest.raises(InputError, match="internal states of lugre@motor"):
        refine(with_memory)


def test_record_shorter_than_a_window_is_refused() -> None:
    first, _, _ = case("rigid")
    with pytest.raises(InputError, match="shorter window"):
        refine(first, window=100.0)


def test_hidden_effect_none_stays_within_two_percent_of_truth() -> None:
    folder = SHARED / "none"
    if not folder.exists() and not os.environ.get("CI"):
        pytest.skip("../shared/hidden_effect is not there")
    truth = json.loads((folder / "truth.json").read_text())["link_referred"]
    whole = read(folder / "train.csv")
    cut = Record.from_channels(
        whole.time[:5000], {c: v[:5000] for c, v in whole.channels.items()}, name="10 s"
    )
    refined = refine(fit(load_joint(folder / "joint.toml"), cut))
    assert refined.cost_after <= refined.cost_before
    names = {
        "motor_inertia": "kg_m2",
        "link_inertia": "kg_m2",
        "stiffness": "Nm_per_rad",
        "gravity_torque": "Nm",
        "motor_coulomb": "Nm",
        "structural_damping": "Nms_per_rad",
        "motor_viscous": "Nms_per_rad",
    }
    for name, unit in names.items():
        assert refined.values[name] == pytest.approx(truth[f"{name}_{unit}"], rel=0.02), name
