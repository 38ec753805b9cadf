"""Velocities with their corners: where dry friction or a drive jumps, an encoder's kernel rounds
off what the torques know.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

import identification.balance.dataset as prepared
from benchmarks.next_run import record_of
from benchmarks.trust import joint_of, one_way
from identification.balance.corners import corner_weights, with_corners
from identification.balance.dataset import Dataset, load_dataset, prepared_model
from identification.balance.weak import WeakRecord, kernel
from identification.fitting.engine import solve
from tests.hidden_effect.generator import Case, simulate_case

FloatArray = npt.NDArray[np.float64]


def case_of(seed: int, effect: str | None = "stribeck") -> Case:
    return simulate_case(effect, seed, overrides={"CURVE": 1.0}, records=("train", "train2"))


def rows_of(case: Case, *effects: str, without: tuple[str, ...] = ()) -> Dataset:
    joint = joint_of(case, effects)
    records = [record_of(table, name, "same") for name, table in case.measured.items()]
    kept = [r.without(*(c for c in without if r.has(c))) for r in records]
    return load_dataset(kept, [], joint, prepared_model(joint, kept[0]))


def rounded_off(case: Case, row: WeakRecord, name: str) -> FloatArray:
    """What the kernel of the motor's velocity takes off the true one, at the points."""
    exact, grid = case.exact[name], row.grid
    true = np.interp(row.points["time"], exact[:, 0], exact[:, 3] / case.gear_ratio)
    weights = kernel(grid.pointwise["motor_position"], grid.dt, 1)
    way = np.concatenate([[0.0], np.cumsum((true[1:] + true[:-1]) / 2 * grid.dt)])
    out, half = np.zeros(len(true)), len(weights) // 2
    out[half:-half] = true[half:-half] - np.correlate(way, weights, "valid")
    return out


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("step", [1, 2, 3])
def test_weights_are_what_a_kernel_takes_off_a_velocity(step: int) -> None:
    """An acceleration that jumps, its velocity, the position, and the kernel over that."""
    dt, length, count = 1e-3, 0.02, 241
    weights = corner_weights(length, dt, step)
    assert weights == pytest.approx(-weights[::-1], abs=1e-15)  # nothing off a constant one
    at = np.arange(0, count, step)
    acceleration = np.where(at < 120, -3.0, 2.0) + 0.01 * at
    every = np.interp(np.arange(count), at, acceleration)
    speed = np.concatenate([[0.0], np.cumsum((every[1:] + every[:-1]) / 2 * dt)])
    way = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * dt)])
    own = kernel(length, dt, 1)
    half, reach = len(own) // 2, len(weights) // 2
    off = speed[half:-half] - np.correlate(way, own, "valid")
    inner = at[(at >= half + reach * step) & (at < count - half - reach * step)]
    told = np.correlate(acceleration, weights, "valid")[inner // step - reach]
    assert told == pytest.approx(off[inner - half], abs=1e-12)
    assert np.abs(told).max() > 1e-3


@pytest.mark.parametrize("seed", [73001, 73005, 73010])
def test_what_a_kernel_rounds_off_comes_back(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Joints that stick at each turn, for less time than a kernel has."""
    case = case_of(seed)
    found = rows_of(case, "stribeck@motor")
    monkeypatch.setattr(prepared, "corners_of", lambda *_, **__: {})
    plain = rows_of(case, "stribeck@motor")
    assert found.corners["motor"].inertia == pytest.approx(case.parameters["JM"], rel=0.01)
    for before, after, name in zip(plain.train, found.train, case.exact, strict=True):
        off = rounded_off(case, before, name)
        told = after.points["motor_velocity"] - before.points["motor_velocity"]
        assert rms(told - off) < 0.85 * rms(off)
        assert np.corrcoef(told, off)[0, 1] > 0.6
        assert after.smooth["motor_velocity"] is after.points["motor_velocity"]


def test_laws_of_slow_motion_lose_their_bias(monkeypatch: pytest.MonkeyPatch) -> None:
    """Means over five joints, in standard errors: 1.3 off without the corners."""
    cases = [case_of(seed) for seed in range(73000, 73005)]

    def off(name: str, key: str) -> float:
        out = []
        for case in cases:
            data = rows_of(case, "stribeck@motor")
            joint = joint_of(case, ("stribeck@motor",))
            record = record_of(case.measured["train"], "train", "same")
            solution = solve(prepared_model(joint, record), data)
            error = solution.stderr[name]
            assert error is not None
            out.append((solution.values[name] - case.parameters[key]) / error)
        return float(np.mean(out))

    with_them = off("motor_stribeck_velocity", "M_VS")
    monkeypatch.setattr(prepared, "corners_of", lambda *_, **__: {})
    without = off("motor_stribeck_velocity", "M_VS")
    assert abs(with_them) < 0.7
    assert without < -1.0


def test_motion_without_a_turn_has_none() -> None:
    case = simulate_case(
        None,
        73000,
        overrides={"CURVE": 1.0},
        records=("train", "train2"),
        references=one_way(73000),
    )
    data = rows_of(case)
    for row in data.train:
        noise = row.grid.velocity_noise("motor_position", data.sources["motor_position"])
        plain = replace(row, points=dict(row.points))
        raw = np.gradient(row.smooth["motor_position"], row.points["time"])
        moved = row.points["motor_velocity"] - raw
        inner = slice(100, -100)
        assert rms(moved[inner]) < 3 * noise
        assert with_corners(plain, {}, data.sources).points == plain.points


def test_behind_a_gear_the_motor_alone_tells_none() -> None:
    """The link swings, and all that moves is no single inertia."""
    case = case_of(73000, None)
    joint = replace(joint_of(case), model_name="hd2")
    records = [
        record_of(table, name, "same").without("link_position", "link_torque")
        for name, table in case.measured.items()
    ]
    data = load_dataset(records, [], joint, prepared_model(joint, records[0]))
    assert data.sensing.balances == ("axis",)
    assert not data.corners


@pytest.mark.parametrize("without", [(), ("link_torque",)])
def test_a_torque_louder_than_the_encoder_tells_none(without: tuple[str, ...]) -> None:
    case = case_of(73000, None)
    joint = joint_of(case)
    rng = np.random.default_rng(1)
    quiet, loud = [], []
    for name, table in case.measured.items():
        record = record_of(table, name, "same")
        record = record.without(*(c for c in without if record.has(c)))
        quiet.append(record)
        size = 5 * float(np.std(record["motor_current"]))
        noisy = record["motor_current"] + rng.normal(0.0, size, len(record))
        loud.append(record.with_channel("motor_current", noisy))
    model = prepared_model(joint, quiet[0])
    assert "motor" in load_dataset(quiet, [], joint, model).corners
    data = load_dataset(loud, [], joint, model)
    for row in data.train:
        plain = with_corners(row, {}, data.sources)
        again = with_corners(row, data.corners, data.sources)
        motor = "motor_velocity"
        assert again.points[motor] == pytest.approx(plain.points[motor], abs=0.0)


def test_another_kernel_has_the_same_corners() -> None:
    case = case_of(73000)
    joint = joint_of(case, ("stribeck@motor",))
    records = [record_of(table, name, "same") for name, table in case.measured.items()]
    model = prepared_model(joint, records[0])
    data = load_dataset(records, [], joint, model)
    longer = load_dataset(records, [], joint, model, kernel=0.12, told=data)
    assert longer.corners is data.corners
    again = load_dataset(records, [], joint, model)
    for one, other in zip(data.train, again.train, strict=True):
        assert one is other  # what is kept of a record by its identity stays
