"""The library of joints: the values that were printed, the friction that was published."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from casadi_models import JointModel, thesis
from casadi_models.text.compensation import friction_compensation
from identification.data.joint_file import load_joint
from identification.data.joint_library import (
    Entry,
    chosen,
    entries,
    packaged,
    published,
    side_by_side,
)
from identification.errors import InputError
from workbench.cli.main import main

TABLE = Path(__file__).parents[3].parent / "shared/measurements/bam_published_params/params.json"
ROWS = {
    "module_50/m1": {
        "kt": 4.5,
        "R": 2.5,
        "armature": 0.34,
        "friction_base": 4.1,
        "friction_viscous": 1.3,
        "model": "m1",
        "actuator": "module_50",
    },
    "module_50/m2": {
        "kt": 4.6,
        "armature": 0.33,
        "friction_base": 3.0,
        "friction_stribeck": 1.2,
        "dtheta_stribeck": 0.9,
        "alpha": 1.4,
        "friction_viscous": 1.31,
    },
    "small/m5": {"kt": 0.36, "armature": 2e-3, "friction_base": 0.01, "load_friction_motor": 0.3},
}


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "params.json"
    path.write_text(json.dumps(ROWS), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("irj_1a", thesis.model_1a()),
        ("irj_1b", thesis.model_1b()),
        ("irj_2a", thesis.model_2a()),
        ("irj_2b", thesis.model_2b()),
        ("irj_ts", thesis.model_ts()),
    ],
)
def test_the_joints_of_the_thesis_hold_its_tables(name: str, model: JointModel) -> None:
    (entry,) = chosen([name], packaged())
    assert entry.joint.model().values == pytest.approx(dict(model.values), rel=1e-9)
    assert entry.joint.gear_ratio == thesis.GEAR_RATIO
    assert "INPE-8981" in entry.provenance["source"]


def test_emps_in_two_forms_gives_the_published_forces() -> None:
    plain, asymmetric = chosen(["EMPS"], packaged())
    # published: sign and size of offset and of friction forth and back
    assert plain.values["inertia"] == 95.1089
    for v, force in ((0.1, 0.1 * 203.5034 + 20.3935), (-0.1, -0.1 * 203.5034 - 20.3935)):
        assert _friction(plain, v) == pytest.approx(force, rel=1e-9)
    for v, force in ((0.1, 0.1 * 166.7061 + 20.1440), (-0.1, -0.1 * 240.4236 - 20.6277)):
        assert _friction(asymmetric, v) == pytest.approx(force, rel=1e-9)
    assert plain.values["current_offset"] == 3.1648


def _friction(entry: Entry, velocity: float) -> float:
    joint = entry.joint
    model = joint.model().with_values(
        {n: v for n, v in entry.values.items() if n in joint.model().parameter_names}
    )
    sharp = dict.fromkeys(model.named("smoothing"), 1e-9)
    model = model.with_values(sharp)
    return float(friction_compensation(model)(0.0, velocity, 0.0, 0.0, model.value_vector()))


@pytest.mark.parametrize("velocity", [-2.0, -0.3, 0.2, 1.5])
def test_published_rows_give_the_published_friction(table: Path, velocity: float) -> None:
    one, two, _ = published(table)
    size, sign = abs(velocity), np.sign(velocity)
    assert _friction(one, velocity) == pytest.approx(sign * (1.3 * size + 4.1), rel=1e-9)
    stribeck = 1.2 * np.exp(-((size / 0.9) ** 1.4))
    assert _friction(two, velocity) == pytest.approx(
        sign * (1.31 * size + 3.0 + stribeck), rel=1e-9
    )


def test_what_no_law_takes_is_said(table: Path) -> None:
    last = published(table)[2]
    assert last.left_out == ("load_friction_motor",)
    assert last.joint.gear_ratio == 1.0
    assert published(table)[0].joint.gear_ratio == 50.0


def test_units_of_one_type_stand_side_by_side(table: Path) -> None:
    rows = {r["parameter"]: r for r in side_by_side(chosen(["module_50"], published(table)))}
    assert rows["motor_viscous"]["values"] == [1.3, 1.31]
    deviation = np.std([1.3, 1.31], ddof=1)
    assert rows["motor_viscous"]["spread_percent"] == pytest.approx(100 * deviation / 1.305)
    assert rows["motor_stribeck_extra"]["values"][0] is None
    assert rows["motor_stribeck_extra"]["spread_percent"] is None


@pytest.mark.skipif(not TABLE.exists(), reason="the measurements are not beside the checkout")
def test_the_whole_published_table_is_read() -> None:
    found = published(TABLE)
    assert len(found) == len(json.loads(TABLE.read_text()))
    assert {"erob80_50", "erob80_100", "xl330"} <= {e.type for e in found}
    for entry in found:
        known = {p.name: p for p in entry.joint.model().parameters}
        assert all(known[n].low <= v <= known[n].high for n, v in entry.values.items())


def test_a_joint_file_goes_in_and_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (
        '[joint]\ngear_ratio = 100.0\nmodel = "hd3"\neffects = ["viscous"]\n[fitted]\n'
        'stiffness = { value = 2e4, stderr = 50.0, unit = "N.m/rad", side = "link" }\n'
        '[provenance]\ntype = "axis 3"\n'
    )
    for name in ("one", "two"):
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
    found = entries([tmp_path])
    assert [e.name for e in found] == ["one", "two"]
    assert found[0].joint.model().values == load_joint(tmp_path / "one.toml").model().values
    out = tmp_path / "out.json"
    arguments = ["compare", "axis 3", "--library", str(tmp_path), "--json", str(out)]
    assert main(["joints", *arguments]) == 0
    assert "stiffness [N.m/rad]" in capsys.readouterr().out
    assert json.loads(out.read_text())["rows"][0]["spread_percent"] == 0.0


@pytest.mark.parametrize(
    "words", [["show", "nothing"], ["compare", "irj_1a"], ["compare", "irj_1a", "emps"], ["show"]]
)
def test_wrong_names_are_one_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["joints", *words]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_file_that_is_no_table_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "params.json"
    for text in ("[1, 2", '{"a": 3}', '{"a/m1": {"kt": 1.0}}', '{"a/m1": {"kt": "x"}}'):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(InputError):
            published(path)
