"""Torque against twist with the link clamped: a mode of its own, whatever the model is called."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from identification import Joint, Record, fit, improve
from identification.errors import InputError

STIFFNESS, SLIP, WIDTH = 1.5e4, 2.5, 6e-4


@cache
def record(seed: int, loop: float, ratio: float, runs: int = 3) -> Record:
    """Runs of 9 s at irregular stamps: spring, and a bristle (Dahl 1968) that slips at `loop`
    N.m.
    """
    rng = np.random.default_rng(seed)
    tables = []
    for run in range(runs):
        t = np.cumsum(rng.uniform(0.003, 0.005, 2200))
        twist = (
            rng.uniform(3e-3, 5e-3)
            * np.sin(2 * np.pi * (0.2 + 0.05 * run) * t)
            * np.clip(t / 2, 0, 1)
        )
        z = np.zeros(len(t))
        for i in range(1, len(t)):
            step = twist[i] - twist[i - 1]
            z[i] = z[i - 1] + step / WIDTH * (1 - np.sign(step) * z[i - 1])
        torque = STIFFNESS * twist + loop * z + rng.normal(0, 0.02, len(t))
        tables.append(
            np.column_stack(
                [t, (twist + rng.normal(0, 2e-6, len(t))) * ratio, torque, np.full(len(t), run)]
            )
        )
    t, q, torque, run = np.vstack(tables).T
    return Record.from_channels(
        t, {"motor_position": q, "link_torque": torque, "run": run}, name=f"test {seed}"
    )


@pytest.mark.parametrize(("name", "ratio"), [("hd1", 1.0), ("hd1", 100.0), ("hd3", 100.0)])
def test_the_spring_is_fitted_under_every_model_name(name: str, ratio: float) -> None:
    fitted = fit(Joint(name="test", gear_ratio=ratio, model_name=name), record(1, 0.0, ratio))
    assert fitted.parameters["stiffness"]["value"] == pytest.approx(STIFFNESS, rel=2e-3)
    assert fitted.model.inertias == ()


def test_hysteresis_is_found_first_behind_a_gear_too() -> None:
    joint = Joint(name="test", gear_ratio=100.0, model_name="hd1")
    found = improve(record(2, SLIP, 100.0), joint, [record(3, SLIP, 100.0)])
    assert found.added[0] == "hysteresis"
    assert found.claims[0].effects[0] == "hysteresis"
    first, last = found.steps[0].held_out, found.steps[-1].held_out
    assert last.relative_error_percent < 0.3 * first.relative_error_percent


def moving(seed: int) -> Record:
    """A pendulum behind a gear that moves: motor position and torque of the link, no drive."""
    rng = np.random.default_rng(seed)
    t = np.arange(4000) * 0.005
    w = 1.3 + 0.1 * rng.random()
    q = 0.6 * np.sin(w * t) + 0.2 * np.sin(2.9 * t + 1.0)
    v = 0.6 * w * np.cos(w * t) + 0.58 * np.cos(2.9 * t + 1.0)
    a = -0.6 * w**2 * np.sin(w * t) - 1.682 * np.sin(2.9 * t + 1.0)
    torque = 3.0 * a + 0.8 * v + 25.0 * np.sin(q) + rng.normal(0, 0.05, len(t))
    motor = 100.0 * (q + rng.normal(0, 2e-6, len(t)))
    return Record.from_channels(
        t, {"motor_position": motor, "link_torque": torque}, name=f"moving {seed}"
    )


def test_a_joint_that_moves_is_no_clamped_one() -> None:
    joint = Joint(name="test", gear_ratio=100.0, model_name="hd1", effects=("viscous", "gravity"))
    fitted = fit(joint, moving(4))
    assert fitted.data.sensing.balances == ("link",)
    found = {n: p["value"] for n, p in fitted.parameters.items()}
    assert found["link_inertia"] == pytest.approx(3.0, rel=0.01)
    assert abs(found["gravity_torque"]) == pytest.approx(25.0, rel=0.01)
    assert found["link_viscous"] == pytest.approx(0.8, rel=0.05)


def test_an_elastic_model_of_a_moving_joint_needs_both_positions() -> None:
    joint = Joint(name="test", gear_ratio=100.0, model_name="hd3")
    with pytest.raises(InputError, match="the joint moves, and link_position is missing"):
        fit(joint, moving(4))


def test_nothing_hidden_stands_at_its_floor_although_stamps_are_uneven() -> None:
    # cubics between the stamps smooth the noise: its level is not that of neighbouring samples
    joint = Joint(name="test", gear_ratio=100.0, model_name="hd1")
    found = improve(record(50, 0.0, 100.0), joint, [record(60, 0.0, 100.0)])
    assert found.verdict == "nothing_missing"
    assert 0.85 < found.final_ratios["transmission"].ratio < 1.2
