"""Friction that changes with temperature, in records without a temperature channel."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from identification import Record, improve, load_joint, read
from identification.sensing import warm_up
from tests.hidden_effect.generator import generate_case


def test_warm_up_starts_anew_with_each_run_and_not_at_a_gap() -> None:
    time = np.concatenate([np.arange(0, 10, 0.1), np.arange(12, 20, 0.1), np.arange(0, 5, 0.1)])
    record = Record.from_channels(time, {"motor_position": time})
    warm = warm_up(record)
    assert warm[0] == 0.0
    assert warm[180] == 0.0
    assert np.all(np.diff(warm[:180]) > 0)
    assert warm[179] == np.float64(1 - np.exp(-3.0))


def test_named_from_the_time_since_the_start_and_said_so(tmp_path: Path) -> None:
    folder = generate_case("thermal_friction", 0, folder=tmp_path / "case")
    train, held = ([read(folder / f"{n}{i}.csv") for i in ("", "2")] for n in ("train", "test"))
    found = improve(train, load_joint(folder / "joint.toml"), held)
    assert [c.effects for c in found.claims] == [("thermal_friction",)]
    assert any("no temperature was recorded" in w for w in found.warnings)
    assert found.final_ratios["motor"].ratio < 1.15


def test_a_short_run_cannot_show_it(tmp_path: Path) -> None:
    folder = generate_case(None, 0, folder=tmp_path / "case")
    record = read(folder / "train.csv")
    found = improve(record.take(slice(0, round(12 / record.dt))), load_joint(folder / "joint.toml"), [read(folder / "test.csv")])
    why = {n.effect: n.why for n in found.not_testable}
    assert "shorter than 15 s" in why["thermal_friction"]
