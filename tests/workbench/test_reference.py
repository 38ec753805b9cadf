"""The reference page is what the declarations say, and the declarations are what is read and
written.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from casadi_models import JointModel
from casadi_models.quantities import TABLE, base_unit
from casadi_models.transmission import MODELS
from identification import load_joint
from identification.data import joint_schema
from identification.data.channels import DECLARED, KINDS, TIME, channel_unit
from identification.data.column import Column
from identification.data.columns import parse_map
from identification.data.formula import parse_formula
from identification.data.joint_file import Correlation, Known, parse_joint, toml_text
from identification.data.plain_text import from_toml
from identification.data.schema import Key, Schema
from identification.errors import InputError
from irj_fmu.batch import study_schema
from irj_fmu.batch.study import load_study
from irj_fmu.imported import file_schema
from workbench.reference import main, page, parsers

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference.md"
DEMO = Path(str(files("workbench") / "demo"))
SCHEMAS = (*joint_schema.PAGES, *file_schema.PAGES, *study_schema.PAGES)


def test_the_page_is_what_the_declarations_say(tmp_path: Path) -> None:
    """Its worked example is run for it, so what the page prints is what the functions give."""
    assert main(["--out", str(tmp_path / "reference.md")]) == 0
    made = (tmp_path / "reference.md").read_text(encoding="utf-8")
    shown = PAGE.read_text(encoding="utf-8")
    assert made == shown, "run python -m workbench.reference --out docs/reference.md"


def test_every_declared_name_is_on_the_page() -> None:
    text = page()
    names = [TIME.name, *DECLARED, *TABLE, *MODELS]
    names += [key.name for found in SCHEMAS for key in found.keys]
    for title, parser in parsers():
        assert f"### `{title}`" in text
        names += [o for action in parser.arguments for o in action.option_strings]
    names = [n for n in names if n not in ("-h", "--help", "--json")]
    assert [n for n in names if f"`{n}" not in text and f", {n}`" not in text] == []


def test_every_option_says_what_it_is() -> None:
    silent = [(t, a.dest) for t, p in parsers() for a in p.arguments if not a.help]
    assert silent == []
    assert {t.split()[1] for t, _ in parsers()} >= {"demo", "improve", "export", "batch", "app"}


def test_every_unit_of_a_declaration_is_one_that_is_read() -> None:
    for channel in (TIME, *DECLARED.values()):
        assert [channel_unit(channel.name, kind) for kind in KINDS] == [
            channel.rotary,
            channel.linear,
        ]
        base_unit(channel.rotary)
    for key in joint_schema.JOINT.keys:
        if key.kind == "number":
            base_unit(key.unit)


@pytest.mark.parametrize("name", MODELS)
def test_the_orders_on_the_page_are_those_of_the_functions(name: str) -> None:
    """Y theta + rest is the drive on the motor and 0 on the link, for values and a motion drawn
    at random, with the columns and parameters in the order that the page names.
    """
    model = JointModel.by_name(name, -160.0)
    rng = np.random.default_rng(3)
    p = rng.uniform(0.5, 2.0, len(model.parameter_names))
    x = rng.uniform(-0.5, 0.5, len(model.functions.state_names))
    u = [rng.uniform(5.0, 20.0), 0.0, 0.0]
    rates = np.array(model.dynamics(x, u, p)).ravel()
    a = rates[[1, 3]] if model.is_elastic else rates[[1]]
    y, rest = (np.array(m) for m in model.regressor(x, a, u, p))
    theta = [p[model.parameter_names.index(n)] for n in model.linear_parameters]
    expected = [u[0], 0.0] if model.is_elastic else [u[0]]
    np.testing.assert_allclose(y @ theta + rest.ravel(), expected, atol=1e-9)
    sizes = [np.array(m).shape for m in model.jacobian(x, u, p)]
    assert sizes == [(len(x), len(x)), (len(x), 3), (len(x), len(p))]


def test_harmonic_drives_have_the_names_of_the_files() -> None:
    for number in (1, 2, 3, 4):
        named = JointModel.harmonic_drive(f"hd{number}")
        assert named == JointModel.harmonic_drive(number)
        assert named.structure == JointModel.by_name(f"hd{number}", -160.0).structure


# --- one declaration for reading, writing and refusing --------------------------------------------


def test_what_is_written_is_what_is_read() -> None:
    joint = replace(
        load_joint(DEMO / "joint.toml"),
        known={"stiffness": Known(low=1e4, high=3e4), "motor_inertia": Known(value=4.5)},
        orders=(12.0, 36.0),
        virtual_work=False,
        torque_per_voltage=3.5,
        sample_time=2.5e-3,
        columns={"motor_current": {"column": "iq", "unit": "mA", "sign": -1}},
    )
    fitted = {
        "motor_viscous": {"value": 3.0, "stderr": 0.1, "unit": "N.m.s/rad", "side": "link"},
        "motor_coulomb": {"value": 2.0, "stderr": 0.2, "unit": "N.m", "side": "link"},
    }
    found = {"zero": {"value": 1e-3, "stderr": None, "unit": "rad", "what": "zero"}}
    tied = Correlation(("motor_viscous", "motor_coulomb"), ((-0.8,),))
    origin = {"records": "a, b", "version": "1"}
    text = toml_text(joint, fitted, origin, found, correlation=tied)
    tables = from_toml(text, "text")
    again = parse_joint(tables, joint.source)
    assert replace(again, fitted={}, errors={}, correlation=Correlation()) == replace(
        joint, fitted={}, errors={}
    )
    assert again.fitted["motor_viscous"] == 3.0
    assert again.errors == {"motor_viscous": 0.1, "motor_coulomb": 0.2}
    assert again.correlation == tied
    assert set(tables["calibration"]["zero"]) == {"value", "unit"}
    assert tables["provenance"] == {"records": "a, b", "sample_time": 2.5e-3, "version": "1"}


def test_a_column_is_written_as_it_is_read() -> None:
    names = ("iq", "q 1", "defl")
    columns = (
        Column("motor_current", "iq", "mA", 0.5, -1),
        Column("motor_position", "q 1", "counts", counts_per_turn=4096.0),
        Column("link_position", "", "deg", formula=parse_formula("'q 1' - defl", names)),
    )
    raw = from_toml("\n".join(c.toml() for c in columns), "text")
    assert parse_map(raw, names, {}, "rotary") == columns


ERRORS: dict[str, tuple[dict[str, Any], str]] = {
    "key": ({"joint": {"gear_ration": 3.0}}, "[joint] has an unknown key 'gear_ration'; known: "),
    "meant": ({"joint": {"gear_ration": 3.0}}, "; did you mean 'gear_ratio'?"),
    "table": ({"joint": {}, "colums": {}}, "; did you mean 'columns'?"),
    "text": (
        {"joint": {"model": "hd3"}, "known": {"stiffness": {"value": 1.0, "unit": 3}}},
        "[known] stiffness: unit = 3 is not a text; write it in quotes",
    ),
    "choice": ({"joint": {"kind": "round"}}, "kind = 'round' is not known; use one of rotary,"),
    "number": ({"joint": {"gear_ratio": True}}, "gear_ratio = True is not a finite number"),
    "fitted": (
        {"joint": {}, "fitted": {"link_inertia": {"value": 1.0, "stder": 1.0}}},
        "[fitted] link_inertia has an unknown key 'stder'; known: side, stderr, unit, value; did "
        "you mean 'stderr'?",
    ),
    "known": (
        {"joint": {"model": "hd3"}, "known": {"stifness": 1e4}},
        "; did you mean 'stiffness'?",
    ),
}


@pytest.mark.parametrize("case", ERRORS)
def test_what_does_not_belong_is_refused_with_what_does(case: str) -> None:
    tables, said = ERRORS[case]
    with pytest.raises(InputError) as caught:
        parse_joint(tables, "j.toml")
    assert said in str(caught.value)
    assert str(caught.value).startswith("j.toml: ")
    assert "\n" not in str(caught.value)


def test_a_table_without_any_key_has_every_default() -> None:
    read = joint_schema.JOINT.read({}, "text")
    assert read["gear_ratio"] == 1.0
    assert read["model"] == "hd1"
    assert read["virtual_work"] is True
    assert read["motor_constant"] is None


def test_nothing_is_written_that_is_not_declared() -> None:
    declared = Schema("[t]", "", (Key("a", "number", "", digits=3), Key("b", "text", "")))
    assert declared.inline({"b": 'x"', "a": 1.23456}) == '{ a = 1.23, b = "x\\"" }'
    assert declared.lines({"a": None, "b": "y"}) == ['b = "y"']
    with pytest.raises(KeyError, match="has no key c"):
        declared.lines({"c": 1})


def test_a_study_is_read_by_its_declaration(tmp_path: Path) -> None:
    path = tmp_path / "study.toml"
    path.write_text('[study]\nstop = 1.0\n[[model]]\nfmu = "a.fmu"\nset = { k = 2.0 }\n')
    study = load_study(path)
    assert (study.name, study.format, study.every, study.start_state) == ("study", "npz", 1, True)
    path.write_text('[study]\nstopp = 1.0\n[[model]]\nfmu = "a.fmu"\n')
    with pytest.raises(InputError, match=r"\[study\] has an unknown key 'stopp'.*mean 'stop'\?"):
        load_study(path)
