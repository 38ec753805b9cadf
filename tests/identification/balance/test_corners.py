"""Velocities with their corners: where dry friction or a drive jumps, an encoder's kernel rounds
off what the model and the torques know.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from benchmarks.next_run import record_of
from benchmarks.trust import joint_of, one_way
from casadi_models import JointModel
from identification import Record
from identification.balance.balances import balances_of
from identification.balance.corners import Friction, corner_weights, with_corners
from identification.balance.dataset import Dataset, load_dataset, prepared_model
from identification.balance.weak import WeakRecord, kernel
from identification.fitting.engine import Solution, solve
from tests.hidden_effect.generator import Case, simulate_case

FloatArray = npt.NDArray[np.float64]

MOTOR = "motor_velocity"


def case_of(seed: int, effect: str | None = "stribeck") -> Case:
    return simulate_case(effect, seed, overrides={"CURVE": 1.0}, records=("train", "train2"))


def records_of(case: Case, *, every: int = 1, without: tuple[str, ...] = ()) -> list[Record]:
    """Records of a case, or every so many-th sample of them."""
    out = []
    for name, table in case.measured.items():
        record = record_of(table, name, "same")
        channels = {c: x[::every] for c, x in record.channels.items() if c not in without}
        out.append(Record.from_channels(record.time[::every], channels, name=name))
    return out


def fitted(
    case: Case, *effects: str, every: int = 1, without: tuple[str, ...] = ()
) -> tuple[Dataset, Solution]:
    joint, records = joint_of(case, effects), records_of(case, every=every, without=without)
    model = prepared_model(joint, records[0])
    data = load_dataset(records, [], joint, model)
    return data, solve(model, data)


def cornered(data: Dataset, solution: Solution, row: WeakRecord) -> WeakRecord:
    return with_corners(row, Friction(solution.model), data.sensing, solution.values)


def wrong(case: Case, row: WeakRecord, name: str) -> FloatArray:
    """By how much the motor's velocity is off in slow motion, ends of the record apart."""
    exact = case.exact[name]
    true = np.interp(row.points["time"], exact[:, 0], exact[:, 3] / case.gear_ratio)
    slow = np.abs(true) < 0.05
    slow[:100] = slow[-100:] = False
    return (row.points[MOTOR] - true)[slow]


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
def test_what_a_kernel_rounds_off_comes_back(seed: int) -> None:
    """Joints that stick at each turn, for less time than a kernel has."""
    case = case_of(seed)
    data, solution = fitted(case, "stribeck@motor")
    for row, name in zip(data.train, case.exact, strict=True):
        before, after = (wrong(case, w, name) for w in (row, cornered(data, solution, row)))
        assert rms(after) < 0.9 * rms(before)


@pytest.mark.parametrize("every", [1, 2])
def test_the_laws_of_slow_motion_lose_their_bias(
    every: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 500 and 250 Hz, three joints: their mean error is less than half of that without."""
    cases = [case_of(seed) for seed in (73005, 73020, 73035)]

    def off() -> float:
        errors = []
        for case in cases:
            _, solution = fitted(case, "stribeck@motor", every=every)
            true = case.parameters["M_VS"]
            errors.append(abs(solution.values["motor_stribeck_velocity"] / true - 1))
        return float(np.mean(errors))

    with_them = off()
    monkeypatch.setattr("identification.balance.balances.with_corners", lambda record, *_: record)
    assert with_them < 0.5 * off()


def test_motion_without_a_turn_has_none() -> None:
    references = one_way(73000)
    records = ("train", "train2")
    case = simulate_case(
        None, 73000, overrides={"CURVE": 1.0}, records=records, references=references
    )
    data, solution = fitted(case)
    for row in data.train:
        assert cornered(data, solution, row).points[MOTOR] is row.points[MOTOR]


def test_behind_a_gear_the_motor_alone_tells_none() -> None:
    """The link swings, and all that moves is no single inertia."""
    case = case_of(73000, None)
    joint = replace(joint_of(case), model_name="hd2")
    records = records_of(case, without=("link_position", "link_torque"))
    model = prepared_model(joint, records[0])
    data = load_dataset(records, [], joint, model)
    assert data.sensing.balances == ("axis",)
    solution = solve(model, data)
    assert all(cornered(data, solution, row) is row for row in data.train)


def test_a_model_without_dry_friction_gives_none() -> None:
    data, solution = fitted(case_of(73000, None))
    off = {"motor_coulomb": 0.0, "link_coulomb": 0.0}
    friction, values = Friction(solution.model), {**solution.values, **off}
    assert all(with_corners(row, friction, data.sensing, values) is row for row in data.train)


def test_a_torque_that_is_louder_than_a_corner_tells_none() -> None:
    """Most of its noise stays out of the velocity, which is twice that of the encoder."""
    case = case_of(73000, None)
    joint, records = joint_of(case), records_of(case)
    rng = np.random.default_rng(1)
    loud = []
    for record in records:
        size = 5 * float(np.std(record["motor_current"]))
        noisy = record["motor_current"] + rng.normal(0.0, size, len(record))
        loud.append(record.with_channel("motor_current", noisy))
    model = prepared_model(joint, records[0])
    solution = solve(model, load_dataset(records, [], joint, model))
    data = load_dataset(loud, [], joint, model)
    for row, name in zip(data.train, case.exact, strict=True):
        found = cornered(data, solution, row)
        assert rms(wrong(case, found, name)) < 1.5 * rms(wrong(case, row, name))


def test_the_same_values_give_the_same_corners() -> None:
    """What is kept of a record goes by its identity; a stiffness moves no velocity."""
    data, solution = fitted(case_of(73000), "stribeck@motor")
    row, friction = data.train[0], Friction(solution.model)
    found = cornered(data, solution, row)
    assert cornered(data, solution, row) is found
    softer = {**solution.values, "stiffness": 0.9 * solution.values["stiffness"]}
    again = with_corners(row, friction, data.sensing, softer)
    assert again.points[MOTOR] == pytest.approx(found.points[MOTOR], abs=0.0)
    dry = {**solution.values, "motor_coulomb": 0.9 * solution.values["motor_coulomb"]}
    moved = with_corners(row, friction, data.sensing, dry)
    assert rms(moved.points[MOTOR] - found.points[MOTOR]) > 1e-5


def test_held_corners_do_not_move_with_the_parameters() -> None:
    """The Jacobian of a fit takes them as given; those of a model's own rows are its own."""
    data, solution = fitted(case_of(73000), "stribeck@motor")
    model, row = solution.model, data.train[0]
    names = ("motor_coulomb", "motor_inertia", "motor_stribeck_extra")
    balances = balances_of(model, data.sensing, wrt=names)
    here = balances.evaluate(row, solution.values, about=solution.values)["motor"]
    for k, name in enumerate(names):
        step = 1e-4 * solution.values[name]
        values = {**solution.values, name: solution.values[name] + step}
        held = balances.evaluate(row, values, about=solution.values)["motor"][0]
        assert (held - here[0]) / step == pytest.approx(here[1][:, k], abs=1e-6)
    assert isinstance(model, JointModel)
    own = balances.evaluate(row, values)["motor"][0]
    assert rms(own - held) > 0
