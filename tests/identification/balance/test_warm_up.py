"""Friction that changes with temperature, in records without a temperature channel."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from identification import Record, improve, load_joint, read
from identification.balance.sensing import check_alike, signals_of, warm_up
from identification.data.check.checks import repair
from identification.data.prepare import decimated
from tests.hidden_effect.generator import generate_case


def test_warm_up_starts_anew_with_each_run_and_not_at_a_gap() -> None:
    time = np.concatenate([np.arange(0, 10, 0.1), np.arange(12, 20, 0.1), np.arange(0, 5, 0.1)])
    record = Record.from_channels(time, {"motor_position": time})
    warm = warm_up(record)
    assert warm[0] == 0.0
    assert warm[180] == 0.0
    assert np.all(np.diff(warm[:180]) > 0)
    assert warm[179] == np.float64(1 - np.exp(-3.0))


def test_a_part_of_a_run_is_as_warm_as_it_was_in_the_run() -> None:
    time = np.arange(0, 40, 0.1)
    whole = Record.from_channels(time, {"motor_position": time})
    first, second = whole.split(0.7)
    together = np.concatenate([warm_up(part, 39.9) for part in (first, second)])
    np.testing.assert_allclose(together, warm_up(whole))
    thinned = repair(decimated(second, 4))
    np.testing.assert_allclose(warm_up(thinned, 39.9), warm_up(whole)[280::4])
    assert warm_up(first, 80.0)[-1] < warm_up(first)[-1]


def test_temperature_counts_from_one_sample_for_all_records(tmp_path: Path) -> None:
    folder = generate_case("thermal_friction", 0, folder=tmp_path / "case")
    cold, hot = (read(folder / f"{n}.csv") for n in ("train", "train2"))
    model = load_joint(folder / "joint.toml").model()
    runs = [
        r.with_channel("temperature", np.full(len(r), level))
        for r, level in ((cold, 293.0), (hot, 318.0))
    ]
    sensing = check_alike(runs, model)
    assert sensing.has_temperature
    joint = load_joint(folder / "joint.toml")
    assert [float(signals_of(r, joint, sensing)["temperature"][0]) for r in runs] == [0.0, 25.0]
    swapped = check_alike(runs[::-1], model)
    assert [float(signals_of(r, joint, swapped)["temperature"][0]) for r in runs] == [-25.0, 0.0]
    assert not check_alike([runs[0], hot], model).has_temperature


def test_named_without_a_held_out_record(tmp_path: Path) -> None:
    folder = generate_case("thermal_friction", 0, folder=tmp_path / "case")
    found = improve(
        [read(folder / "train.csv"), read(folder / "train2.csv")], load_joint(folder / "joint.toml")
    )
    assert [c.effects for c in found.claims] == [("thermal_friction",)]
    assert found.final_ratios["motor"].ratio < 1.15


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
    found = improve(
        record.take(slice(0, round(12 / record.dt))),
        load_joint(folder / "joint.toml"),
        [read(folder / "test.csv")],
    )
    why = {n.effect: n.why for n in found.not_testable}
    assert "shorter than 15 s" in why["thermal_friction"]
