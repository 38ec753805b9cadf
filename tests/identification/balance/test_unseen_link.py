"""A geared joint of which only the drive side is recorded: the link hangs on a compliance
nobody measures.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from casadi_models.hold import HOLD_NAME
from identification import compare, improve
from identification.balance.balances import Balances
from identification.balance.dataset import load_dataset, prepared_model
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError
from identification.fitting.engine import solve
from identification.fitting.fit import fit
from identification.fitting.output_error import refine
from tests.hidden_effect.generator import generate_case
from workbench.cli.main import improve_json

MOTOR, LINK, STIFFNESS, RATIO = 4.2, 10.8, 2.2e4, 160.0
SWING = math.sqrt(STIFFNESS / LINK) / (2 * math.pi)


def swinging(stiffness: float, damping: float = 0.0) -> Record:
    """Drive torque and motor position of two inertias on a spring and a damper, in closed form,
    without friction or noise.
    """
    t = np.arange(0.0, 20.0, 1e-3)
    motor, drive = np.zeros_like(t), np.zeros_like(t)
    for i, f in enumerate((0.21, 0.53, 0.97, 1.7, 2.9)):
        w = 2 * math.pi * f
        link = 0.3 / (1 + i) ** 2 * np.exp(1j * (w * t + i))
        torque = -LINK * w**2 * link
        own = link + torque / (stiffness + 1j * w * damping)
        motor += own.imag
        drive += (torque - MOTOR * w**2 * own).imag
    return Record.from_channels(
        t, {"motor_torque": drive / RATIO, "motor_position": motor * RATIO}, name="swing"
    )


def bare_joint() -> Joint:
    return Joint(name="bare", gear_ratio=RATIO, model_name="hd1", effects=())


def test_the_link_is_eliminated_exactly() -> None:
    record, joint = swinging(STIFFNESS), bare_joint()
    model = prepared_model(joint, record)
    data = load_dataset([record], [], joint, model)
    values = {
        **dict.fromkeys(model.parameter_names, 0.0),
        "inertia": MOTOR + LINK,
        "swinging_share": LINK / (MOTOR + LINK),
    }
    balances = Balances(model, data.sensing, wrt=())
    torque = float(np.std(data.train[0].averaged["drive"]))
    rigid = float(
        np.std(balances.evaluate(data.train[0], {**values, "load_compliance": 0.0})["axis"][0])
    )
    elastic = float(
        np.std(
            balances.evaluate(data.train[0], {**values, "load_compliance": 1 / STIFFNESS})["axis"][
                0
            ]
        )
    )
    assert rigid > 0.02 * torque
    assert elastic < 1e-3 * rigid


def test_a_damped_twist_is_eliminated_exactly_and_its_damping_found() -> None:
    damping = 60.0
    record, joint = swinging(STIFFNESS, damping), bare_joint()
    model = prepared_model(joint, record)
    data = load_dataset([record], [], joint, model)
    values = {
        **dict.fromkeys(model.parameter_names, 0.0),
        "inertia": MOTOR + LINK,
        "swinging_share": LINK / (MOTOR + LINK),
        "load_compliance": 1 / STIFFNESS,
    }
    balances = Balances(model, data.sensing, wrt=())
    undamped, damped = (
        float(np.std(balances.evaluate(data.train[0], {**values, "load_damping": d})["axis"][0]))
        for d in (0.0, damping)
    )
    assert damped < 1e-2 * undamped
    found = solve(model, data).values
    assert found["swinging_share"] == pytest.approx(LINK / (MOTOR + LINK), rel=5e-3)
    assert found["load_compliance"] == pytest.approx(1 / STIFFNESS, rel=5e-3)
    assert found["load_damping"] == pytest.approx(damping, rel=0.01)


def test_inertias_and_compliance_are_found_from_the_motor_side() -> None:
    record, joint = swinging(STIFFNESS), bare_joint()
    model = prepared_model(joint, record)
    found = solve(model, load_dataset([record], [], joint, model)).values
    assert found["inertia"] == pytest.approx(MOTOR + LINK, rel=1e-3)
    assert found["swinging_share"] == pytest.approx(LINK / (MOTOR + LINK), rel=0.02)
    assert found["load_compliance"] == pytest.approx(1 / STIFFNESS, rel=0.02)


@pytest.mark.parametrize(("kind", "seen"), [("linear", True), ("rotary", False)])
def test_a_linear_axis_has_a_transmission_whatever_its_ratio_says(kind: str, seen: bool) -> None:
    """A carriage behind its screw swings as a link behind its gear; a direct drive has nothing
    between."""
    geared = swinging(STIFFNESS)
    record = Record.from_channels(
        geared.time,
        {
            "motor_torque": geared["motor_torque"] * RATIO,
            "motor_position": geared["motor_position"] / RATIO,
        },
        name="carriage",
    )
    joint = Joint(name="carriage", kind=kind, gear_ratio=1.0, model_name="hd1", effects=())
    model = prepared_model(joint, record)
    assert model.lagging_load == seen
    found = solve(model, load_dataset([record], [], joint, model)).values
    if seen:
        assert found["inertia"] == pytest.approx(MOTOR + LINK, rel=1e-3)
        assert found["swinging_share"] == pytest.approx(LINK / (MOTOR + LINK), rel=0.02)
        assert found["load_compliance"] == pytest.approx(1 / STIFFNESS, rel=0.02)


def test_a_linear_axis_that_was_fitted_as_rigid_is_rigid() -> None:
    record = swinging(STIFFNESS)
    bare = Joint(name="carriage", kind="linear", gear_ratio=1.0, model_name="hd1", effects=())
    rigid = replace(bare, fitted={"inertia": MOTOR + LINK})
    swings = replace(bare, fitted={"inertia": MOTOR + LINK, "load_compliance": 0.0})
    assert [prepared_model(j, record).lagging_load for j in (bare, rigid, swings)] == [1, 0, 1]


def test_what_a_drive_holds_is_no_fit() -> None:
    """Values that stand were said to be fitted to the record that they are judged on."""
    geared = swinging(STIFFNESS)
    record = Record.from_channels(
        geared.time,
        {
            "motor_current": geared["motor_torque"],
            "motor_position": geared["motor_position"],
        },
        name="run",
    )
    joint = replace(bare_joint(), torque_per_current=RATIO)
    found = fit(joint, [record])
    assert compare(found, [record], linear=False).fitted_to == ("run",)
    written = {n: v for n, v in found.solution.values.items() if n != HOLD_NAME}
    standing = fit(replace(joint, fitted=written).held(), [record])
    assert standing.solution.free == (HOLD_NAME,)
    assert compare(standing, [record], linear=False).fitted_to == ()


def test_a_rigid_joint_has_no_compliance_to_find() -> None:
    record, joint = swinging(1e12), bare_joint()
    model = prepared_model(joint, record)
    found = solve(model, load_dataset([record], [], joint, model)).values
    assert found["inertia"] == pytest.approx(MOTOR + LINK, rel=1e-6)
    assert found["load_compliance"] == 0.0


def test_the_share_of_the_inertia_that_loads_the_gear_is_found_with_its_friction() -> None:
    """Gravity alone is not the load, and a stiff joint shows no swing to tell the share from."""
    t = np.arange(0.0, 40.0, 1e-3)
    q, v, a = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
    for i, f in enumerate((0.13, 0.37, 0.71, 1.3)):
        w, size = 2 * math.pi * f, 0.5 / (1 + i)
        q += size * np.sin(w * t + i)
        v += size * w * np.cos(w * t + i)
        a -= size * w**2 * np.sin(w * t + i)
    motor, link, gravity, share = 0.6, 1.4, 9.0, 0.08
    load = link * a - gravity * np.sin(q + 0.4)
    friction = (2.0 + share * np.abs(load)) * np.tanh(v / 1e-3) + 0.5 * v
    noise = np.random.default_rng(3).normal(0, 0.02, len(t))
    drive = motor * a + load + friction + noise
    record = Record.from_channels(
        t, {"motor_torque": drive / RATIO, "motor_position": q * RATIO}, name="loaded"
    )
    joint = Joint(
        name="loaded", gear_ratio=RATIO, model_name="hd1", effects=("viscous", "coulomb", "gravity")
    )
    found = improve([record], joint)
    assert [c.effects for c in found.claims] == [("load_dependent_friction",)]
    values = found.steps[-1].solution.values
    assert values["motor_load_friction"] == pytest.approx(share, rel=0.02)
    assert values["swinging_share"] == pytest.approx(link / (motor + link), rel=0.02)
    assert values["load_compliance"] == 0.0


def test_refinement_says_that_it_cannot_simulate_an_unseen_link() -> None:
    found = fit(bare_joint(), swinging(STIFFNESS))
    with pytest.raises(InputError, match="needs link_position where the link swings"):
        refine(found)


@pytest.mark.parametrize(
    ("effect", "seed"),
    [
        ("stribeck", 1000),
        (None, 1003),
        pytest.param("quadratic_drag", 1000, marks=pytest.mark.slow),
    ],
)
def test_friction_is_named_from_the_motor_side_alone(
    effect: str | None, seed: int, tmp_path: Path
) -> None:
    generate_case(effect, seed, one_sided=True, torque_sensor=False, folder=tmp_path)
    truth = json.loads((tmp_path / "truth.json").read_text())["link_referred"]
    result = improve_json(
        [tmp_path / "train.csv", tmp_path / "train2.csv"],
        [tmp_path / "test.csv", tmp_path / "test2.csv"],
        tmp_path / "joint.toml",
    )
    assert [c["effects"][0] for c in result["claims"]] == ([effect] if effect else [])
    if effect is not None:
        assert result["claims"][0]["held_out_drop_percent"] > 70
    swing = math.sqrt(truth["stiffness_Nm_per_rad"] / truth["link_inertia_kg_m2"]) / (2 * math.pi)
    said = next(w for w in result["warnings"] if "the link would swing at" in w)
    assert float(said.split("swing at ")[1].split(" Hz")[0]) == pytest.approx(swing, rel=0.05)
