"""Zeros of the encoders: found per run, taken off before claims are made, and no physics."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from identification import Improvement, Record, fit, improve, load_joint, read
from identification.balance.calibration import bare, settled
from identification.balance.sensing import sense
from identification.data.joint_file import parse_joint
from identification.fitting.engine import load_dataset, prepared_model
from tests.identification.diagnosis.test_other_payload import FAST, JOINT, record

DEMO = Path(__file__).resolve().parents[3] / "workbench" / "demo"
SCHEMA = Path(__file__).parents[2] / "data" / "improve.schema.json"


def moved(run: Record, zero: float) -> Record:
    """The run with the link encoder's zero elsewhere."""
    return replace(run, channels={**run.channels, "link_position": run["link_position"] + zero})


@cache
def demo(zero: float) -> Improvement:
    joint = load_joint(DEMO / "joint.toml")
    return improve(
        [moved(read(DEMO / "train.npz"), zero)],
        joint,
        [moved(read(DEMO / "held_out.npz"), -2 * zero)],
    )


@pytest.mark.parametrize("zero", [pytest.param(1e-4, marks=pytest.mark.slow), 5e-3])
def test_claims_do_not_hang_on_where_the_encoder_has_its_zero(zero: float) -> None:
    plain, found = demo(0.0), demo(zero)
    assert [c.effects for c in found.claims] == [c.effects for c in plain.claims] == [("stribeck",)]
    assert found.verdict == plain.verdict == "complete"
    before, after = (f.steps[-1].solution.values for f in (plain, found))
    for name in (
        "stiffness",
        "motor_inertia",
        "link_inertia",
        "motor_coulomb",
        "stribeck_extra",
        "gravity_torque",
    ):
        for full in (n for n in before if n.endswith(name)):
            assert after[full] == pytest.approx(before[full], rel=2e-3), full
    for balance, error in plain.final_ratios.items():
        assert found.final_ratios[balance].ratio == pytest.approx(error.ratio, rel=0.02)


def test_the_zero_is_said_with_its_band_and_is_no_parameter_and_no_effect() -> None:
    found = demo(5e-3)
    (zero,) = (c for c in found.calibration if c.what == "zero")
    assert (zero.what, zero.sensor, zero.run, zero.unit) == ("zero", "link_position", 0, "rad")
    assert zero.stderr is not None
    assert abs(zero.value - 5e-3) < 4 * zero.stderr + 1e-7
    result = json.loads(json.dumps(found.as_json()))
    jsonschema.validate(result, json.loads(SCHEMA.read_text()))
    assert zero.as_json() in result["calibration"]
    assert not any("zero" in n for n in result["steps"][-1]["parameters"])
    text = found.to_joint_file()
    table = tomllib.loads(text)["calibration"]["zero of link_position in train"]
    assert table["value"] == pytest.approx(5e-3, abs=1e-5)
    again = parse_joint(tomllib.loads(text))
    assert "Calibration found" in found._repr_html_()
    assert set(again.effects) <= set(found.model.effects)


@pytest.mark.parametrize("torque_sensor", [True, False])
def test_how_far_the_gear_twists_does_not_hang_on_where_the_encoders_have_their_zero(
    torque_sensor: bool,
) -> None:
    """Knots of a stiffness are looked for along it: up to the zero there would be no twist."""
    plain = [record(f"run {i}", 3 + i, False, *FAST) for i in range(2)]
    if not torque_sensor:
        plain = [r.without("link_torque") for r in plain]
    model = prepared_model(JOINT, plain[0])
    off = [moved(r, z) for r, z in zip(plain, (5e-2, -2e-2), strict=True)]
    before, after = (load_dataset(runs, [], JOINT, model).ranges for runs in (plain, off))
    assert after == pytest.approx(before, rel=1e-6)


@pytest.mark.parametrize("torque_sensor", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_every_run_has_its_own_zero(torque_sensor: bool) -> None:
    zeros = (1e-3, -3e-3)
    plain = [record(f"run {i}", 3 + i, False, *FAST) for i in range(2)]
    if not torque_sensor:
        plain = [
            replace(r, channels={c: x for c, x in r.channels.items() if c != "link_torque"})
            for r in plain
        ]
    first = fit(JOINT, plain)
    found = fit(JOINT, [moved(r, z) for r, z in zip(plain, zeros, strict=True)])
    before, after = (
        [c["value"] for c in f.as_json()["calibration"] if c["what"] == "zero"]
        for f in (first, found)
    )
    assert np.subtract(after, before) == pytest.approx(zeros, abs=2e-7)
    assert found.solution.values["stiffness"] == pytest.approx(
        first.solution.values["stiffness"], rel=1e-4
    )


def test_a_run_that_no_fit_has_seen_gets_its_zero_from_itself() -> None:
    train, other = (record(n, seed, False, *FAST) for n, seed in (("train", 3), ("other", 7)))
    solution = fit(JOINT, [train]).solution
    model = prepared_model(JOINT, train)
    data = load_dataset([train], [moved(other, 4e-3)], JOINT, model)
    (held,) = data.held_out
    values = settled(solution.model, data.sensing, [held], solution.values)
    own = [
        x
        for n, x in values.items()
        if bare([n]) == ("link_encoder_zero",) and n.endswith(f"[{held.name}]")
    ]
    assert own == pytest.approx([4e-3], abs=1e-5)


def test_a_joint_without_twist_has_no_zero() -> None:
    train = record("train", 3, False, *FAST)
    rigid = replace(JOINT, model_name="hd2")
    assert not sense(train, rigid.model()).clamped_link
    assert "link_encoder_zero" not in prepared_model(rigid, train).calibration
