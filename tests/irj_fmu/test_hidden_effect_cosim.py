"""A plant with an effect that its estimator's model lacks: the right ratio rises, the loop
names it, and the ratio falls.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from identification.data.channels import channel_unit
from identification.data.joint_file import Joint, load_joint, toml_text
from irj_fmu.cosim import CHANNELS, Setting, cosimulate, make_pair
from irj_fmu.plant.reference import reference_joint, start_of
from workbench.cli.main import improve_json, main

READINGS = ("motor_current", *CHANNELS.values())
NOISE = {
    "motor_current": 2e-3,
    "motor_position": 3e-4,
    "motor_velocity": 1e-2,
    "link_position": 2e-6,
    "link_velocity": 1e-4,
    "link_torque": 0.05,
}
SENSORS = {f"plant.{channel}.noise": level for channel, level in NOISE.items()}
LIMIT = 2.0
"""Residual over floor below which a balance counts as explained."""
RAISED = 5.0
SECONDS = 16.0


@dataclass(frozen=True)
class Case:
    """An effect, its values in the plant, and the one balance in which it shows."""

    key: str
    label: str
    values: Mapping[str, float]
    balance: str


STRIBECK = Case(
    "stribeck",
    "stribeck@motor",
    {"motor_stribeck_extra": 8.0, "motor_stribeck_velocity": 0.05},
    "motor",
)
SPRING = Case("added_spring", "added_spring@link", {"link_added_spring": 25.0}, "link")


def joints(case: Case) -> tuple[Joint, Joint]:
    """The plant with the effect, and the joint file that lacks it and has no values."""
    base = reference_joint("hd3")
    base = replace(
        base,
        effects=tuple(e for e in base.effects if e != "stribeck@motor"),
        fitted={k: v for k, v in base.fitted.items() if "stribeck" not in k},
    )
    plant = replace(base, name="hidden", effects=(*base.effects, case.label))
    own = dict(zip(plant.model().parameter_names, plant.model().value_vector(), strict=True))
    return replace(plant, fitted={**own, **base.fitted, **case.values}), replace(
        start_of(base), name="known"
    )


@pytest.mark.parametrize(
    "case", [STRIBECK, pytest.param(SPRING, marks=pytest.mark.slow)], ids=lambda c: c.key
)
def test_hidden_effect_raises_its_ratio_until_the_improved_joint_is_exported(
    case: Case, tmp_path: Path
) -> None:
    plant, known = joints(case)
    files = make_pair(plant, known, tmp_path / "first", shim=True)
    setting = Setting(
        stop=SECONDS, parameters=SENSORS, record=[f"plant.{channel}" for channel in READINGS]
    )
    before = cosimulate(plant, known, files, setting)
    assert before.ratios[case.balance] > RAISED
    assert all(ratio < LIMIT for balance, ratio in before.ratios.items() if balance != case.balance)

    # what the host recorded, and the joint file, are all that the loop gets
    found = before.trajectory
    table = np.column_stack([found.time, *(found[f"plant.{channel}"] for channel in READINGS)])
    header = ",".join(["time_s", *(f"{channel}_{channel_unit(channel)}" for channel in READINGS)])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header=header, comments="", fmt="%.12g")
    (tmp_path / "known.toml").write_text(toml_text(known), encoding="utf-8")
    improved, joint = tmp_path / "improved.toml", tmp_path / "known.toml"
    assert (
        main(
            [
                "improve",
                str(tmp_path / "run.csv"),
                "--joint",
                str(joint),
                "-o",
                str(improved),
                "--json",
                str(tmp_path / "i.json"),
            ]
        )
        == 0
    )
    better = load_joint(improved)
    assert case.label in better.effects
    assert not any(
        effect in better.effects for effect in {STRIBECK.label, SPRING.label} - {case.label}
    )
    for name, value in case.values.items():
        assert better.fitted[name] == pytest.approx(value, rel=0.05)

    # export again, and the same plant
    assert (
        main(["export", "estimator", "--joint", str(improved), "--out", str(tmp_path / "second")])
        == 0
    )
    (estimator,) = (tmp_path / "second").glob("*.fmu")
    after = cosimulate(plant, better, (files[0], estimator), setting)
    assert all(ratio < LIMIT for ratio in after.ratios.values()), after.ratios
    assert after.ratios[case.balance] < before.ratios[case.balance] / 5


@pytest.mark.slow
def test_the_python_door_says_the_same(tmp_path: Path) -> None:
    plant, known = joints(STRIBECK)
    files = make_pair(plant, known, tmp_path / "pair", shim=True)
    setting = Setting(
        stop=SECONDS, parameters=SENSORS, record=[f"plant.{channel}" for channel in READINGS]
    )
    found = cosimulate(plant, known, files, setting).trajectory
    arrays = {
        f"{channel}_{channel_unit(channel)}": found[f"plant.{channel}"] for channel in READINGS
    }
    np.savez(tmp_path / "run.npz", **{"time_s": found.time, **arrays})
    (tmp_path / "known.toml").write_text(toml_text(known), encoding="utf-8")
    data = improve_json([tmp_path / "run.npz"], [], tmp_path / "known.toml")
    assert data["added"] == ["stribeck"]
    assert data["steps"][-1]["held_out"]["balances"]["motor"]["ratio"] < LIMIT
