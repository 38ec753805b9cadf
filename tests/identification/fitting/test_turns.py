"""Turns of dry friction at instants that nobody knows take nothing off an inertia."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.next_run import record_of
from benchmarks.trust import joint_of
from identification.balance.balances import balances_of
from identification.balance.dataset import load_dataset, prepared_model
from identification.fitting.engine import solve
from identification.fitting.weak_form import WeakForm
from tests.hidden_effect.generator import simulate_case


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
    turns = rows.turns
    left = rows.residual(np.empty(0))
    # nothing is invented: what is left is shorter, and a turn a second is no large share of it
    assert 0.5 * np.linalg.norm(left) < np.linalg.norm(turns.without(left)) < np.linalg.norm(left)
    still = WeakForm(
        rows.balances,
        data,
        {**found.values, "motor_coulomb": 0.0, "link_coulomb": 0.0},
        (),
        found.weights,
    ).turns
    assert still.without(left) is left


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
    assert form.turns.columns is None
