"""A joint file says how its standard errors go together, and what reads it believes it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from identification import Fit, fit, load_joint, read
from identification.data.joint_file import Correlation, parse_joint, toml_text
from identification.data.plain_text import from_toml
from identification.errors import InputError
from identification.fitting.trust import trust, trusted_file
from workbench.cli.main import main

DEMO = Path(str(files("workbench"))) / "demo"


@cache
def fitted() -> Fit:
    return fit(load_joint(DEMO / "joint.toml"), read(DEMO / "train.npz"))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("correlation") / "fitted.toml"
    path.write_text(fitted().to_joint_file(), encoding="utf-8")
    return path


def without_table(text: str) -> str:
    """As a file of an earlier version."""
    return re.sub(r"\[correlation\]\n.*?\n\]\n", "", text, flags=re.DOTALL)


def test_what_is_written_reads_back_bit_for_bit(written: Path) -> None:
    own = fitted().solution.together
    back = load_joint(written).correlation
    assert back == own
    assert len(own.names) >= 6
    assert {n for n, e in fitted().parameters.items() if e["stderr"]} >= set(own.names)
    joint = load_joint(written)
    values = {n: {"value": v, "stderr": joint.errors.get(n)} for n, v in joint.fitted.items()}
    text = toml_text(joint, values, correlation=back)
    assert parse_joint(from_toml(text, "again")).correlation == own
    matrix = back.matrix(back.names)
    assert np.array_equal(matrix, matrix.T) and np.all(np.diag(matrix) == 1.0)
    assert np.linalg.eigvalsh(matrix).min() > 0


def test_a_pair_of_the_file_is_that_of_the_fit(written: Path) -> None:
    correlation = load_joint(written).correlation
    for name, (partner, rho) in fitted().solution.correlation.items():
        if name in correlation.names and partner in correlation.names:
            assert correlation.matrix([name, partner])[0, 1] == pytest.approx(rho, abs=1e-9)


def test_trust_says_of_the_file_what_it_says_of_the_records(written: Path) -> None:
    """But for windows, profiles and the prediction, which need them."""
    whole = trust(fitted().solution, fitted().data, profiles=False)
    by_records = {p.name: p for p in whole.parameters}
    by_file = {p.name: p for p in trusted_file(load_joint(written)).parameters}
    assert by_file.keys() == by_records.keys()
    for name, p in by_file.items():
        other = by_records[name]
        assert (p.verdict, p.partner) == (other.verdict, other.partner), name
        assert (p.stderr, p.low, p.high) == pytest.approx(
            (other.stderr, other.low, other.high), rel=1e-5
        )
        assert p.trade == other.trade
        assert p.prediction_percent is None and p.windows == ()
    assert sum(bool(p.trade) for p in by_file.values()) >= 2


def test_trust_and_show_read_it_from_the_command_line(
    written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "t.json"
    assert main(["trust", "--joint", str(written), "--json", str(data)]) == 0
    said = capsys.readouterr()
    assert said.err == "" and "goes up" in said.out
    found = json.loads(data.read_text())
    assert found["records"] == []
    traded = {p["name"]: p["trades_with"] for p in found["trust"] if p["trade"]}
    assert main(["show", "--joint", str(written), "--json", str(data)]) == 0
    shown = capsys.readouterr().out
    assert "values +- standard error" in shown
    pairs = {frozenset(p) for p in traded.items()}
    lines = shown.split("errors that go together\n")[1].splitlines()
    assert len(lines) == len(pairs) and all("goes up" in line for line in lines)
    assert {t["name"]: t["with"] for t in json.loads(data.read_text())["trades"]} == traded


def test_a_file_of_an_earlier_version_loads_and_says_what_it_lacks(
    written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = tmp_path / "old.toml"
    old.write_text(without_table(written.read_text()))
    joint = load_joint(old)
    assert joint.correlation == Correlation()
    assert replace(joint, correlation=load_joint(written).correlation, source="") == replace(
        load_joint(written), source=""
    )
    assert main(["trust", "--joint", str(old)]) == 0
    said = capsys.readouterr()
    assert "does not say how its standard errors go together" in said.err
    assert "goes up" not in said.out
    assert main(["show", "--joint", str(old)]) == 0
    assert "go together" not in capsys.readouterr().out


def test_an_effect_that_is_added_leaves_it_as_it_is(written: Path, tmp_path: Path) -> None:
    larger = tmp_path / "larger.toml"
    added = ["add", "current_offset", "--joint", str(written), "-o", str(larger)]
    assert main(added) == 0
    assert load_joint(larger).correlation == load_joint(written).correlation


def test_the_loop_writes_it_too(tmp_path: Path) -> None:
    better = tmp_path / "better.toml"
    given = [str(DEMO / "train.npz"), "--held-out", str(DEMO / "held_out.npz")]
    joint = ["--joint", str(DEMO / "joint.toml"), "-o", str(better)]
    assert main(["improve", *given, *joint]) == 0
    found = load_joint(better).correlation
    assert "motor_stribeck_extra" in found.names


@pytest.mark.parametrize("verb", ["trust", "show"])
def test_a_joint_without_a_fit_has_start_values(
    verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main([verb, "--joint", str(DEMO / "joint.toml")])
    said = capsys.readouterr()
    if verb == "show":
        assert code == 0
        assert "start values: nothing is fitted yet" in said.out
        assert "standard error" not in said.out
    else:
        assert code == 2
        assert len(said.err.splitlines()) == 1 and "fit it first" in said.err


@pytest.mark.parametrize("language", ["latex", "sympy"])
def test_every_language_says_that_they_are_start_values(
    language: str, written: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["show", "--joint", str(DEMO / "joint.toml"), "--format", language]) == 0
    assert "start values" in capsys.readouterr().out
    assert main(["show", "--joint", str(written), "--format", language]) == 0
    assert "start values" not in capsys.readouterr().out


def test_a_start_value_among_fitted_ones_is_said_to_be_one(
    written: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    larger = tmp_path / "larger.toml"
    main(["add", "current_offset", "--joint", str(written), "-o", str(larger)])
    capsys.readouterr()
    assert main(["show", "--joint", str(larger)]) == 0
    marked = [x for x in capsys.readouterr().out.splitlines() if "(start value)" in x]
    assert len(marked) == 1 and "current_offset" in marked[0]


BAD: dict[str, tuple[Any, str]] = {
    "no table": (3, "correlation must be a table"),
    "unknown": ({"parameters": ["d"], "triangle": []}, "d has no value in [fitted]"),
    "twice": ({"parameters": ["link_inertia"] * 2, "triangle": [[0.1]]}, "is there twice"),
    "no triangle": ({"parameters": ["link_inertia"]}, "triangle must have 0 rows"),
    "shape": (
        {"parameters": ["link_inertia", "link_viscous"], "triangle": [[0.1], [0.2]]},
        "triangle must have 1 rows",
    ),
    "flat": (
        {"parameters": ["link_inertia", "link_viscous"], "triangle": [0.1]},
        "triangle must have 1 rows",
    ),
    "text": (
        {"parameters": ["link_inertia", "link_viscous"], "triangle": [["much"]]},
        "is not a finite number",
    ),
    "beyond": (
        {"parameters": ["link_inertia", "link_viscous"], "triangle": [[1.5]]},
        "1.5 is no correlation",
    ),
    "key": ({"parameter": []}, "did you mean 'parameters'?"),
    "errors": (
        {"parameters": ["link_inertia", "link_viscous"], "triangle": [[0.1]], "errors": [1.0]},
        "errors must be 2 numbers",
    ),
    "no error": (
        {"parameters": ["link_inertia", "link_viscous"], "triangle": [[0.1]], "errors": [1.0, 0]},
        "0 is no standard error",
    ),
    "not finite": (
        {"parameters": ["link_inertia", "link_viscous"], "triangle": [[float("nan")]]},
        "is not a finite number",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_table_that_cannot_be_believed_is_refused_in_a_line(case: str) -> None:
    table, said = BAD[case]
    one = {"value": 1.0, "stderr": 0.1}
    fitted_ = {"link_inertia": one, "link_viscous": one}
    tables = {
        "joint": {"model": "hd1", "effects": ["viscous"]},
        "fitted": fitted_,
        "correlation": table,
    }
    with pytest.raises(InputError) as caught:
        parse_joint(tables, "j.toml")
    assert said in str(caught.value)
    assert str(caught.value).startswith("j.toml: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"motor": 2.0}, "motor must be a table with ratio"),
        ({"motor": {"ratio": -1.0}}, "is below zero"),
        ({"motor": {"ratio": 1.0, "parameter": []}}, "did you mean 'parameters'?"),
    ],
)
def test_balances_that_cannot_be_believed_are_refused_in_a_line(
    table: dict[str, Any], said: str
) -> None:
    with pytest.raises(InputError) as caught:
        parse_joint({"joint": {"model": "hd1"}, "balances": table}, "j.toml")
    assert said in str(caught.value) and str(caught.value).startswith("j.toml: [balances] motor")


def test_a_fit_by_the_outputs_writes_none(tmp_path: Path) -> None:
    """Its errors are those of other rows: a table of the balances would stand beside them."""
    record = tmp_path / "short.npz"
    with np.load(DEMO / "train.npz") as archive:
        np.savez(record, **{n: archive[n][:2500] for n in archive.files})
    out = tmp_path / "refined.toml"
    given = ["fit", str(record), "--joint", str(DEMO / "joint.toml"), "-o", str(out)]
    assert main([*given, "--refine"]) == 0
    assert load_joint(out).correlation == Correlation()
    assert load_joint(out).errors
