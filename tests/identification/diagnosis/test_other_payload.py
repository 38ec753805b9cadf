"""A motor constant 18 % wrong on a gravity-loaded joint: a set on loaded records, one name
after an unloaded run.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from casadi_models import JointModel
from identification import Joint, Record, fit, improve, read
from identification.data.joint_file import Known, load_joint
from identification.errors import InputError
from identification.fitting.assess import assess
from identification.fitting.engine import solve
from identification.planning.follow import Controller, Follower
from tests.hidden_effect.generator import generate_case

RATIO, PER_AMPERE, ERROR, DT = 160.0, 8.848, -0.18, 2e-3
TRUE = {
    "motor_inertia": 4.447,
    "link_inertia": 10.277,
    "stiffness": 2.2e4,
    "structural_damping": 60.0,
    "motor_viscous": 11.0,
    "link_viscous": 2.0,
    "motor_coulomb": 21.5,
    "link_coulomb": 0.4,
    "gravity_torque": 105.18,
    "motor_smoothing_velocity": 0.005,
    "link_smoothing_velocity": 0.005,
}
JOINT = Joint(
    name="loaded arm",
    gear_ratio=RATIO,
    torque_per_current=PER_AMPERE,
    model_name="hd3",
    effects=("viscous", "coulomb", "gravity"),
    known={"motor_inertia": Known(TRUE["motor_inertia"])},
)


@cache
def follower(loaded: bool) -> Follower:
    """The joint under its position controller; without payload no gravity torque and a third of
    the inertia.
    """
    values = TRUE if loaded else {**TRUE, "gravity_torque": 0.0, "link_inertia": 3.0}
    model = JointModel.by_name("hd3", RATIO, effects=("viscous", "coulomb", "gravity")).with_values(
        values
    )
    return Follower(model, DT, controller=Controller(25.0, 0.9), substeps=8)


@cache
def record(
    name: str,
    seed: int,
    loaded: bool,
    frequencies: tuple[float, ...],
    sizes: tuple[float, ...],
    middle: float,
    noise: float = 1.0,
) -> Record:
    """40 s along a sum of sines, logged through a drive whose motor constant is 18 % lower than
    the joint file says.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(round(40.0 / DT)) * DT
    w, a = 2 * np.pi * np.array(frequencies), np.array(sizes)
    angle = w[:, None] * t + rng.uniform(0, 2 * np.pi, len(w))[:, None]
    run = follower(loaded).run(
        np.column_stack(
            [middle + a @ np.sin(angle), (a * w) @ np.cos(angle), -(a * w**2) @ np.sin(angle)]
        )
    )
    motor, link = 2 * np.pi / 9000, 2 * np.pi / 100_000
    return Record.from_channels(
        t,
        {
            "motor_current": run.drive / (PER_AMPERE * (1 + ERROR))
            + rng.normal(0, noise * 0.004, len(t)),
            "motor_position": np.round(run.states[:, 0] * RATIO / motor) * motor,
            "link_position": np.round(run.states[:, 2] / link) * link,
            "link_torque": run.torque + rng.normal(0, noise * 0.05, len(t)),
        },
        name=name,
    )


NOISY = 40.0
"""Torque sensor of 2 N.m and current of 0.16 A noise: with finer ones the loaded records alone
tell the gain from a torque of the position.
"""


GAINS = {"motor_constant_error", "torque_sensor_gain"}
"""Either scales one torque against the other; friction and inertia alone tell which."""
OF_POSITION = {"cyclic_torque", "added_spring"}
"""What slow motions about one place hardly tell from a gain: a torque that goes with the sine of
the position, or over a quarter of a radian with the position itself and an offset.
"""
FAST = ((0.11, 0.29, 0.63), (0.5, 0.22, 0.08), 0.0)


@pytest.mark.parametrize("seed", [1, *(pytest.param(s, marks=pytest.mark.slow) for s in (10, 13))])
def test_a_set_on_loaded_records_and_the_gain_after_an_unloaded_run(seed: int) -> None:
    slow = ((0.07, 0.11), (0.15, 0.10), 0.8)
    loaded, held = (
        record("loaded", seed, True, *slow, NOISY),
        record("held out", seed + 1, True, *slow, NOISY),
    )
    alone = improve(loaded, JOINT, [held])
    assert set(alone.claims[0].effects) >= GAINS
    assert set(alone.claims[0].effects) <= GAINS | OF_POSITION
    assert alone.claims[0].confidence["motor_constant_error"] > 0.1
    assert "without payload" in (alone.claims[0].separate_by or "")
    unloaded = replace(record("unloaded", seed + 2, False, *FAST, NOISY), payload="none")
    both = improve([loaded, unloaded], JOINT, [held])
    assert len(both.claims) == 1
    assert "motor_constant_error" in both.claims[0].effects
    assert set(both.claims[0].effects) <= GAINS
    assert (
        both.steps[-1].held_out.relative_error_percent
        < 0.1 * both.steps[0].held_out.relative_error_percent
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", [10, 13])
def test_a_law_that_passes_less_noise_on_is_not_the_more_probable_one(seed: int) -> None:
    """A gain scales the noise of what it stands at: its residual is longer and no worse."""
    slow = ((0.07, 0.11), (0.15, 0.10), 0.8)
    found = improve(
        record("loaded", seed, True, *slow, NOISY),
        JOINT,
        [record("held out", seed + 100, True, *slow, NOISY)],
    )
    told = found.claims[0]
    assert "motor_constant_error" in told.effects
    assert sum(told.confidence.get(n, 0.0) for n in GAINS) > 0.95


@pytest.mark.slow
def test_the_motor_constant_after_an_unloaded_run() -> None:
    slow = ((0.07, 0.11), (0.15, 0.10), 0.8)
    loaded, held = record("loaded", 1, True, *slow), record("held out", 2, True, *slow)
    unloaded = replace(record("unloaded", 3, False, *FAST), payload="none")
    both = improve([loaded, unloaded], JOINT, [held])
    assert [c.effects for c in both.claims] == [("motor_constant_error",)]
    assert both.steps[-1].solution.values["motor_constant_error"] == pytest.approx(ERROR, abs=0.01)
    assert (
        both.steps[-1].held_out.relative_error_percent
        < 0.1 * both.steps[0].held_out.relative_error_percent
    )


@pytest.mark.slow
def test_the_names_left_out_of_the_set_fit_worse_on_held_out_records() -> None:
    slow = ((0.07, 0.11), (0.15, 0.10), 0.8)
    loaded, held = record("loaded", 1, True, *slow), record("held out", 2, True, *slow)
    found = improve(loaded, JOINT, [held])
    start = found.steps[0].solution
    assert "motor_viscous" in start.at_bound
    errors = {}
    for label in (
        "motor_constant_error",
        "torque_sensor_gain",
        "cyclic_torque@motor",
        "added_spring@motor",
    ):
        whole = solve(start.model.add(label), found.data, start=start.values)
        errors[label.partition("@")[0]] = (
            assess(whole.model, found.data, found.data.held_out, whole.values)
            .balances["motor"]
            .ratio
        )
    assert min(errors, key=errors.__getitem__) == "motor_constant_error"
    assert found.claims[0].effects[0] == "motor_constant_error"
    assert all(
        errors[name] > 1.5 * errors["motor_constant_error"]
        for name in errors
        if name not in found.claims[0].effects
    )
    assert set(errors) - set(found.claims[0].effects)


@pytest.mark.slow
def test_the_same_on_the_independent_simulator(tmp_path: Path) -> None:
    parts = {}
    for loaded in (True, False):
        folder = generate_case(
            "motor_constant_error",
            1,
            dirt=True,
            unloaded=not loaded,
            overrides={"KM": 0.82},
            folder=tmp_path / f"loaded{loaded}",
        )
        parts[loaded] = [
            replace(read(folder / f"{n}.csv"), payload="own" if loaded else "none")
            for n in ("train", "train2", "test", "test2")
        ]
    truth = json.loads((tmp_path / "loadedTrue" / "truth.json").read_text())["link_referred"]
    joint = replace(
        load_joint(tmp_path / "loadedTrue" / "joint.toml"),
        known={"motor_inertia": Known(truth["motor_inertia_kg_m2"])},
    )
    found = improve([*parts[True][:2], *parts[False][:2]], joint, parts[True][2:])
    assert [c.effects for c in found.claims] == [("motor_constant_error",)]
    assert found.verdict == "complete"


def test_the_links_parameters_are_those_of_the_first_payload() -> None:
    slow = ((0.07, 0.11), (0.15, 0.10), 0.8)
    loaded = record("loaded", 1, True, *slow)
    unloaded = replace(
        record("unloaded", 3, False, (0.11, 0.29, 0.63), (0.5, 0.22, 0.08), 0.0), payload="none"
    )
    alone, both = (fit(JOINT, runs).solution for runs in ([loaded], [loaded, unloaded]))
    # the skew of the loaded run is what both share: it moves them within their bands
    for name in ("link_inertia", "gravity_torque"):
        errors = [found.stderr[name] or 0.0 for found in (alone, both)]
        assert min(errors) > 0.0
        assert both.values[name] == pytest.approx(TRUE[name], rel=0.02)
        assert both.values[name] == pytest.approx(alone.values[name], abs=math.hypot(*errors))


def test_another_payload_needs_a_balance_without_the_link() -> None:
    slow = ((0.07, 0.11), (0.15, 0.10), 0.8)
    made = [
        record(name, seed, True, *slow)
        for name, seed in (("loaded", 1), ("unloaded", 3), ("held out", 5))
    ]
    bare = [
        replace(r, channels={c: x for c, x in r.channels.items() if not c.startswith("link")})
        for r in made
    ]
    with pytest.raises(
        InputError,
        match="unloaded: a record with another payload needs link_torque or both positions",
    ):
        improve(
            [bare[0], replace(bare[1], payload="none")], replace(JOINT, model_name="hd1"), [bare[2]]
        )
