"""Turns of dry friction at instants that nobody knows add nothing to an inertia."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.next_run import record_of
from benchmarks.trust import joint_of
from identification import improve, load_joint, read
from identification.balance.balances import balances_of
from identification.balance.dataset import load_dataset, prepared_model
from identification.fitting.engine import solve
from identification.fitting.turns import turns_of
from identification.fitting.weak_form import WeakForm
from tests.hidden_effect.generator import simulate_case
from tests.recorded_world.world import make_case, write_case


@pytest.mark.parametrize("smoothing", [0.0, 0.002])
def test_a_turn_of_dry_friction_is_no_inertia(smoothing: float) -> None:
    """A triangle accelerates at its turns only: without unknown instants .6 % stay in the motor's
    inertia, and 2.4 % in its viscous friction where the friction turns smoothly."""
    case = simulate_case(
        None,
        50_001,
        overrides={"M_V0": smoothing, "L_V0": smoothing, "CURVE": 1.0},
        records=("train",),
    )
    record = record_of(case.measured["train"], "train", "same")
    joint = joint_of(case)
    model = prepared_model(joint, record)
    data = load_dataset([record], [], joint, model)
    found = solve(model, data)
    assert found.values["motor_inertia"] == pytest.approx(case.parameters["JM"], rel=8e-4)
    assert found.values["motor_viscous"] == pytest.approx(case.parameters["M_B"], rel=8e-4)
    rows = WeakForm(balances_of(model, data.sensing, wrt=()), data, found.values, (), found.weights)
    turns = turns_of(rows)
    left = rows.residual(np.empty(0))
    # nothing is invented: what is left is shorter, a turn a second is no large share of it, and
    # where no turn is in reach it is the same
    assert 0.5 * np.linalg.norm(left) < np.linalg.norm(turns.without(left)) < np.linalg.norm(left)
    touched = np.asarray(abs(turns.columns).sum(axis=1)).ravel() > 0
    assert 0 < touched.mean() < 0.3
    np.testing.assert_array_equal(turns.without(left)[~touched], left[~touched])
    still = turns_of(
        WeakForm(
            rows.balances,
            data,
            {**found.values, "motor_coulomb": 0.0, "link_coulomb": 0.0},
            (),
            found.weights,
        )
    )
    assert still.without(left) is left


def test_motors_under_set_valued_friction_have_no_bias_of_their_inertia() -> None:
    """With the rows at turns in the RMS by which rows are weighed, each told next to nothing of its
    instant, and the mean of these was one and a half standard errors."""
    off = []
    for seed in range(300_000, 300_006):
        case = simulate_case(
            None,
            seed,
            overrides={"M_V0": 0.0, "L_V0": 0.0, "CURVE": 1.0},
            records=("train", "train2"),
        )
        records = [record_of(t, n, "same") for n, t in case.measured.items()]
        joint = joint_of(case)
        model = prepared_model(joint, records[0])
        found = solve(model, load_dataset(records, [], joint, model))
        error = found.stderr["motor_inertia"]
        assert error is not None
        off.append((found.values["motor_inertia"] - case.parameters["JM"]) / error)
    assert abs(np.mean(off)) < 2 / np.sqrt(len(off))


def test_a_record_without_a_turn_is_fitted_as_it_is() -> None:
    time = np.arange(6000) * 2e-3
    speed = 0.6 + 0.4 * np.sin(2 * np.pi * 0.7 * time) * np.sin(0.3 * time)
    angle = np.cumsum(speed) * 2e-3
    case = simulate_case(None, 50_000, span=12.0, references={"train": (angle, speed)})
    record = record_of(case.measured["train"], "train", "same")
    joint = joint_of(case)
    model = prepared_model(joint, record)
    data = load_dataset([record], [], joint, model)
    found = solve(model, data)
    assert found.values["motor_inertia"] == pytest.approx(case.parameters["JM"], rel=5e-3)
    form = WeakForm(balances_of(model, data.sensing, wrt=()), data, found.values, (), found.weights)
    assert turns_of(form).columns is None


@pytest.mark.parametrize(
    ("seed", "sensors", "name"),
    [
        (208010, "encoders", "stribeck"),
        (208010, "all", "stribeck"),
        (208017, "encoders", "gravity"),
    ],
)
def test_joints_that_stand_for_a_few_samples_at_a_turn_have_no_structure_left(
    seed: int, sensors: str, name: str, tmp_path: Path
) -> None:
    """Rows over such stops stood at up to 117 deviations, two to six times the noise of the whole
    balance, and made the rows of the other balances weigh nothing.
    """
    folder = write_case(make_case(seed, kind="single", size=1.0), tmp_path, sensors)
    joint = load_joint(folder / "joint.toml")
    train, test = (read(folder / f"{n}.csv", joint=joint) for n in ("train", "test"))
    found = improve([train], joint, [test])
    assert [c.effects for c in found.claims] == [(name,)]
    assert found.verdict == "complete"
    assert max(e.ratio for e in found.final_ratios.values()) < 1.3
