"""Two positions and no torque: what the twist alone shows, and how large it is."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from casadi_models import JointModel
from identification import fit, improve, load_joint, read
from identification.balance.sensing import sense
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError
from identification.linear.frequency import bode_of
from identification.planning.runs import refuse_clamped
from tests.hidden_effect.generator import generate_case

pytestmark = pytest.mark.skipif(
    shutil.which("gcc") is None, reason="the generator's C integrator needs gcc"
)
KEPT: Final = ("time_s", "motor_position_rad", "link_position_rad")


def positions(
    effect: str | None, seed: int, folder: Path, overrides: dict[str, float] | None = None
) -> Path:
    """A case of the generator of which the two positions alone are left."""
    made = generate_case(effect, seed, folder=folder, overrides=overrides)
    for path in made.glob("*.csv"):
        with path.open(newline="") as file:
            rows = list(csv.reader(file))
        kept = [rows[0].index(n) for n in KEPT]
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([[row[i] for i in kept] for row in rows])
    return made


def truth(folder: Path) -> dict[str, float]:
    found = json.loads((folder / "truth.json").read_text())["link_referred"]
    return {n: float(x) for n, x in found.items()}


@pytest.mark.parametrize(
    ("gap", "seed"), [(1e-3, 31), pytest.param(5e-3, 32, marks=pytest.mark.slow)]
)
def test_a_gap_is_named_with_its_size(gap: float, seed: int, tmp_path: Path) -> None:
    folder = positions("backlash", seed, tmp_path, {"GAP": gap})
    joint = load_joint(folder / "joint.toml")
    found = improve([read(folder / "train.csv")], joint, [read(folder / "test.csv")])
    assert [c.effects[0] for c in found.claims] == ["backlash"]
    assert not found.claims[0].partial
    assert found.verdict == "complete"
    assert found.steps[-1].solution.values["backlash"] == pytest.approx(gap, rel=0.02)


def test_nothing_is_found_where_nothing_is_hidden(tmp_path: Path) -> None:
    folder = positions(None, 33, tmp_path)
    joint, true = load_joint(folder / "joint.toml"), truth(folder)
    found = improve([read(folder / "train.csv")], joint, [read(folder / "test.csv")])
    assert found.claims == ()
    assert found.verdict == "nothing_missing"
    assert any("no torque and no current recorded" in w for w in found.warnings)
    assert bode_of(found.steps[-1].solution.model, found.data, [read(folder / "train.csv")]) is None
    with pytest.raises(InputError, match="record motor_current or motor_torque too"):
        refuse_clamped(found.data.sensing, found.data.train_names[0])
    values, k = found.steps[-1].solution.values, true["stiffness_Nm_per_rad"]
    # the wind-up by the link's own inertia and weight, each over the stiffness
    assert values["link_inertia"] == pytest.approx(true["link_inertia_kg_m2"] / k, rel=0.01)
    assert values["gravity_torque"] == pytest.approx(true["gravity_torque_Nm"] / k, rel=0.01)
    error = found.steps[-1].held_out.balances["kinematic"]
    assert error.unit == "rad"
    assert 0.8 < error.ratio < 1.2


def with_gap(folder: Path, known: str) -> Joint:
    """The joint of a case with backlash in its file, and what is known of it."""
    text = (folder / "joint.toml").read_text().replace('"gravity"]', '"gravity", "backlash"]')
    (folder / "known.toml").write_text(f"{text}\n[known]\n{known}\n")
    return load_joint(folder / "known.toml")


def test_a_known_stiffness_gives_torques_their_size(tmp_path: Path) -> None:
    folder = positions("backlash", 34, tmp_path, {"GAP": 2e-3})
    true = truth(folder)
    joint = with_gap(folder, f"stiffness = {true['stiffness_Nm_per_rad']}")
    found = fit(joint, [read(folder / "train.csv")])
    values = found.solution.values
    assert found.scale == ""
    assert values["link_inertia"] == pytest.approx(true["link_inertia_kg_m2"], rel=0.02)
    assert values["gravity_torque"] == pytest.approx(true["gravity_torque_Nm"], rel=0.02)
    assert values["backlash"] == pytest.approx(2e-3, rel=0.02)
    # drawn noise leaves what it leaves: the floor of a twist that jumps is right too
    assert 0.75 < found.train.balances["kinematic"].ratio < 1.3


def test_a_size_that_the_stiffness_would_need_is_refused(tmp_path: Path) -> None:
    folder = positions(None, 34, tmp_path)
    with pytest.raises(InputError, match="link_inertia without stiffness"):
        fit(with_gap(folder, "link_inertia = 10.0"), [read(folder / "train.csv")])


def test_one_position_alone_is_refused(tmp_path: Path) -> None:
    t = np.arange(0, 4, 0.002)
    record = Record.from_channels(t, {"motor_position": np.sin(t)}, name="one")
    with pytest.raises(InputError, match="or both motor_position and link_position"):
        sense(record, JointModel.by_name("hd1", 100.0))
