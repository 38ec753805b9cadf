"""Torque against twist with the link clamped: a mode of its own, whatever the model is called."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from identification import Joint, Record, fit, improve

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


def test_nothing_hidden_stands_at_its_floor_although_stamps_are_uneven() -> None:
    # cubics between the stamps smooth the noise: its level is not that of neighbouring samples
    joint = Joint(name="test", gear_ratio=100.0, model_name="hd1")
    found = improve(record(50, 0.0, 100.0), joint, [record(60, 0.0, 100.0)])
    assert found.verdict == "nothing_missing"
    assert 0.85 < found.final_ratios["transmission"].ratio < 1.2
