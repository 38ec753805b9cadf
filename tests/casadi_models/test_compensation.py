"""The friction alone is what the joint needs to be driven at a constant speed, without what
else it carries.
"""

from __future__ import annotations

import csv
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from casadi_models import EFFECTS, JointModel
from casadi_models.text.compensation import friction_compensation, resting_load
from casadi_models.text.typed_law import TypedLaw, register
from workbench.cli.main import main

FRICTION = sorted(k for k, e in EFFECTS.items() if e.family == "friction" and not e.states)


def loaded(model: JointModel) -> JointModel:
    rng = np.random.default_rng(2)
    return model.with_values({n: float(rng.uniform(0.2, 0.8)) for n in model.parameter_names})


@pytest.mark.parametrize("key", FRICTION)
def test_it_is_the_drive_at_constant_speed(key: str) -> None:
    """Rigid joint, gravity taken off: the regressor at zero acceleration is an independent way
    to the same torque.
    """
    model = loaded(JointModel(gear_ratio=50.0).add("gravity").add(key))
    p, f = model.value_vector(), friction_compensation(model)
    theta = np.array([p[model.parameter_names.index(n)] for n in model.linear_parameters])
    sine, cosine = (p[model.parameter_names.index(n)] for n in ("gravity_torque", "gravity_cosine"))
    for q, v, temperature in ((0.4, 0.7, 3.0), (-1.1, -0.2, 0.0), (2.0, 0.05, -4.0)):
        y, rest = (np.array(x) for x in model.regressor([q, v], [0.0], [0.0, temperature, 0.0], p))
        torque = (y @ theta + rest.ravel()).item()
        load = -sine * np.sin(q) - cosine * np.cos(q)
        assert float(f(q, v, load, temperature, p)) == pytest.approx(torque - load, rel=1e-9)


def test_presliding_has_settled() -> None:
    """The bristles stand still: their declared rate is zero, z = sign(v)."""
    model = loaded(JointModel(gear_ratio=50.0).add("coulomb@motor").add("lugre@motor"))
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    smooth = np.tanh(0.1 / values["motor_smoothing_velocity"])
    expected = values["motor_coulomb"] * smooth + values["motor_presliding_torque"] * (1.0 - smooth)
    found = float(friction_compensation(model)(0.0, 0.1, 0.0, 0.0, model.value_vector()))
    assert found == pytest.approx(expected, rel=1e-5)


def test_gravity_and_springs_are_no_part_of_it() -> None:
    model = loaded(
        JointModel.harmonic_drive(3).add("gravity").add("added_spring@motor").add("viscous@motor")
    )
    viscous = model.values["motor_viscous"]
    assert float(
        friction_compensation(model)(0.8, 0.5, 3.0, 0.0, model.value_vector())
    ) == pytest.approx(0.5 * viscous)


def joint_file(tmp_path: Path, effects: str, fitted: str) -> Path:
    path = tmp_path / "joint.toml"
    path.write_text(
        f'[joint]\ngear_ratio = 50.0\nmodel = "hd1"\neffects = [{effects}]\n[fitted]\n{fitted}\n'
    )
    return path


def test_the_table_is_the_function(tmp_path: Path) -> None:
    fitted = (
        "motor_coulomb = { value = 4.0 }\nmotor_cyclic_friction_sine = { value = 1.0 "
        "}\nmotor_smoothing_velocity = { value = 0.001 }"
    )
    path = joint_file(tmp_path, '"coulomb@motor", "cyclic_friction@motor"', fitted)
    table = tmp_path / "table.csv"
    assert (
        main(
            ["show", "--joint", str(path), "--compensation", "-o", str(table), "--max-speed", "90"]
        )
        == 0
    )
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert set(rows[0]) == {"link_velocity_rad_s", "link_position_rad", "friction_torque_Nm"}
    assert max(float(r["link_velocity_rad_s"]) for r in rows) == pytest.approx(np.pi / 2)
    for r in rows[:: len(rows) // 50]:
        v, q = float(r["link_velocity_rad_s"]), float(r["link_position_rad"])
        expected = (4.0 + np.sin(q)) * np.tanh(v / 0.001)
        assert float(r["friction_torque_Nm"]) == pytest.approx(expected, abs=1e-6)


def test_the_position_is_left_out_where_friction_does_not_follow_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = joint_file(tmp_path, '"viscous@motor"', "motor_viscous = { value = 2.0 }")
    assert main(["show", "--joint", str(path), "--compensation"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "link_velocity_rad_s,friction_torque_Nm"
    assert len(lines) == 82


@pytest.mark.parametrize(
    ("effects", "said"), [("", "no friction"), ('"viscous@motor"', "fit it to records first")]
)
def test_nothing_to_compensate_is_said(
    effects: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = joint_file(tmp_path, effects, "")
    assert main(["show", "--joint", str(path), "--compensation"]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_c_and_casadi_have_the_function(tmp_path: Path) -> None:
    path = joint_file(tmp_path, '"viscous@motor"', "motor_viscous = { value = 2.0 }")
    assert main(["export", "c", "--joint", str(path), "--out", str(tmp_path / "c")]) == 0
    assert "friction_compensation(" in (tmp_path / "c" / "joint.h").read_text()
    assert main(["export", "casadi", "--joint", str(path), "--out", str(tmp_path / "f")]) == 0
    loaded_function = ca.Function.load(str(tmp_path / "f" / "friction_compensation.casadi"))
    model = JointModel(gear_ratio=50.0).add("viscous@motor").with_values({"motor_viscous": 2.0})
    assert float(loaded_function(0.0, 3.0, 0.0, 0.0, model.value_vector())) == pytest.approx(6.0)


@pytest.mark.parametrize("kind", ["rotary", "linear"])
def test_the_load_at_rest_keeps_a_joint_where_it_stands(kind: str) -> None:
    """With it as the drive nothing accelerates, wherever the joint stands: both parts of gravity,
    an offset of the drive and a constant of the user's own.
    """
    with EFFECTS.scoped():
        unit = "N.m" if kind == "rotary" else "N"
        constant = register(TypedLaw("pull", "c", ("link",), (f"c=-9..9 {unit}",), kind))
        model = loaded(
            JointModel(gear_ratio=50.0, kind=kind)
            .add("coulomb")
            .add("gravity")
            .add("current_offset")
            .add(constant.key)
        )
        load, p = resting_load(model), model.value_vector()
        for q in (0.0, 0.7, -2.1):
            rates = model.functions.dynamics([q, 0.0], [load.drive(q), 0.0, 0.0], p)
            assert float(rates[1]) == pytest.approx(0.0, abs=1e-12)
        assert load.sine and load.cosine and load.constant


def test_springs_are_no_constant_load() -> None:
    model = loaded(JointModel(gear_ratio=50.0).add("added_spring@motor").add("cyclic_torque"))
    load = resting_load(model)
    assert (load.sine, load.cosine, load.constant) == (0.0, 0.0, 0.0)
