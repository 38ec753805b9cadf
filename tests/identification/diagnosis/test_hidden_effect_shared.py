"""The whole loop on joints with a hidden effect that another simulator made
(../shared/hidden_effect).
"""

from __future__ import annotations

import json
import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from identification import Improvement, improve, load_joint, read
from identification.diagnosis.session import timed_bench
from identification.fitting.fit import fit

SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "hidden_effect"
CASES = ("cubic_stiffness", "kinematic_error", "stribeck")

if not SHARED.exists() and not os.environ.get("CI"):
    pytest.skip("../shared/hidden_effect is not there", allow_module_level=True)


@cache
def improved(case: str) -> Improvement:
    folder = SHARED / case
    joint = load_joint(folder / "joint.toml")
    return improve(
        [read(folder / "train.csv"), read(folder / "train2.csv")],
        joint,
        [read(folder / "test.csv"), read(folder / "test2.csv")],
    )


@cache
def truth(case: str) -> dict[str, float]:
    values: dict[str, float] = json.loads((SHARED / case / "truth.json").read_text())[
        "link_referred"
    ]
    return values


@pytest.mark.parametrize("case", CASES)
def test_hidden_effect_is_named_alone(case: str) -> None:
    found = improved(case)
    assert [(c.effects, c.like) for c in found.claims] == [((case,), "")]
    assert found.verdict == "complete"
    assert found.ranking is not None
    assert found.ranking.trials[0].key == case


def test_nothing_is_claimed_where_nothing_is_hidden() -> None:
    found = improved("none")
    assert found.claims == ()
    assert found.minor == ()
    assert found.lines == ()
    assert found.verdict == "nothing_missing"


@pytest.mark.parametrize("case", [*CASES, "none"])
def test_stiffness_and_inertias_are_within_two_percent_of_truth(case: str) -> None:
    values = improved(case).steps[-1].solution.values
    known = truth(case)
    for name, key in (
        ("stiffness", "stiffness_Nm_per_rad"),
        ("motor_inertia", "motor_inertia_kg_m2"),
        ("link_inertia", "link_inertia_kg_m2"),
    ):
        assert values[name] == pytest.approx(known[key], rel=0.02), name


@pytest.mark.parametrize(
    ("case", "name", "key"),
    [
        ("cubic_stiffness", "cubic_stiffness", "cubic_stiffness_Nm_per_rad3"),
        ("kinematic_error", "kinematic_error_amplitude", "kinematic_error_amplitude_rad"),
        ("stribeck", "motor_stribeck_extra", "stribeck_extra_Nm"),
        ("stribeck", "motor_stribeck_velocity", "stribeck_velocity_rad_s"),
    ],
)
def test_hidden_parameters_are_within_fifteen_percent(case: str, name: str, key: str) -> None:
    found: Any = improved(case)
    table = found.as_json()["steps"][-1]["parameters"]
    assert table[name]["value"] == pytest.approx(truth(case)[key], rel=0.15)


@pytest.mark.parametrize("case", CASES)
def test_held_out_error_falls_as_far_as_with_the_true_effect(case: str) -> None:
    found = improved(case)
    claim = found.claims[0]
    before = found.steps[0].held_out.balances[claim.balance].rms
    after = found.steps[-1].held_out.balances[claim.balance].rms
    folder = SHARED / case
    model = found.steps[0].solution.model
    true = model.add(found.claims[0].label)
    true = replace(true, virtual_work=found.model.virtual_work)
    train, held = ([read(folder / f"{n}{i}.csv") for i in ("", "2")] for n in ("train", "test"))
    oracle = fit(true, train, joint=load_joint(folder / "joint.toml"), held_out=held)
    assert oracle.held_out is not None
    best = oracle.held_out.balances[claim.balance].rms
    assert before - after >= 0.8 * (before - best)
    assert after < 0.35 * before


@pytest.mark.parametrize("case", [*CASES, "none"])
def test_what_is_left_reads_as_noise_in_every_balance(case: str) -> None:
    for balance, error in improved(case).final_ratios.items():
        assert 0.8 < error.ratio < 1.5, balance


def test_the_form_of_a_kinematic_error_is_that_of_the_rows() -> None:
    """Its virtual work in or out is told by whole fits, from either side; a model without it has
    one form.
    """
    folder = SHARED / "kinematic_error"
    joint = load_joint(folder / "joint.toml")
    records = [read(folder / name, joint=joint) for name in ("train.csv", "test.csv")]
    bench = timed_bench(joint, records[:1], records[1:])
    values = improved("kinematic_error").steps[-1].solution.values
    forms = []
    for form in (True, False):
        model = replace(bench.start().model.add("kinematic_error"), virtual_work=form)
        step = bench.step("kinematic_error", "kinematic_error", bench.fitted(model, values))
        other = bench.other_form(step)
        forms.append((other or step).solution.model.virtual_work)
        assert other is None or other.train.relative_error_percent < 0.5 * (
            step.train.relative_error_percent
        )
    assert forms == [False, False], "the other simulator lets it wind up the spring only"
    assert bench.other_form(bench.step(None, None, bench.start())) is None
