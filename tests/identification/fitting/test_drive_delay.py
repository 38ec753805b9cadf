"""A late current has one delay, whatever part of it the hold of a command could be."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from identification import fit, improve, load_joint, read
from identification.balance.dataset import HOLD_DELAY, with_effect, without
from identification.data.joint_file import Joint
from identification.data.record import Record
from tests.hidden_effect.generator import generate_case

pytestmark = pytest.mark.skipif(
    shutil.which("gcc") is None, reason="the generator's C integrator needs gcc"
)

SEED = 1000


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate_case("channel_delay", SEED, folder=tmp_path_factory.mktemp("late"))


@pytest.fixture(scope="module")
def true_delay(case: Path) -> float:
    hidden: dict[str, Any] = json.loads((case / "truth.json").read_text())["hidden"][
        "channel_delay"
    ]
    assert hidden["delayed_channel"] == "motor_current"
    return float(hidden["delay_s"])


@pytest.fixture(scope="module")
def records(case: Path) -> list[Record]:
    return [read(case / f"{name}.csv") for name in ("train", "train2", "test")]


@pytest.fixture(scope="module")
def better(case: Path, records: list[Record], tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = improve(records[:2], load_joint(case / "joint.toml"), records[2:])
    assert [c.effects for c in found.claims] == [("channel_delay",)]
    path = tmp_path_factory.mktemp("better") / "better.toml"
    path.write_text(found.to_joint_file(), encoding="utf-8")
    return path


def test_the_whole_delay_is_in_the_joint_file(better: Path, true_delay: float) -> None:
    joint = load_joint(better)
    assert "channel_delay@drive" in joint.effects
    assert HOLD_DELAY not in joint.effects
    assert joint.fitted["drive_delay"] == pytest.approx(true_delay, rel=0.02)


def test_the_joint_file_gives_the_same_model_again(better: Path, records: list[Record]) -> None:
    joint = load_joint(better)
    again = fit(joint, records[:2], held_out=records[2:])
    assert again.parameters["drive_delay"]["value"] == pytest.approx(
        joint.fitted["drive_delay"], rel=1e-3
    )
    assert again.held_out is not None
    assert again.held_out.fit_percent > 98.5


def test_a_delay_that_the_user_declares_is_shown_and_may_be_long(
    case: Path, records: list[Record], true_delay: float
) -> None:
    joint = load_joint(case / "joint.toml")
    declared = Joint(**{**joint.__dict__, "effects": (*joint.effects, "channel_delay@drive")})
    found = fit(declared, records[:2]).parameters["drive_delay"]
    assert found["value"] == pytest.approx(true_delay, rel=0.02)
    assert not found["at_bound"]


def test_the_hold_goes_and_comes_with_the_delay(case: Path, records: list[Record]) -> None:
    model = fit(load_joint(case / "joint.toml"), records[:1]).solution.model
    assert HOLD_DELAY in model.effects
    late = with_effect(model, "channel_delay@drive")
    assert HOLD_DELAY not in late.effects
    assert set(without(late, "channel_delay@drive").effects) == set(model.effects)
    other = with_effect(model, "channel_delay@torque_sensor")
    assert HOLD_DELAY in other.effects
    assert len(other.effects) == len(model.effects) + 1
