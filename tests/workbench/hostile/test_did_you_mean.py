"""A word that is nearly one that is known: the line says which; and words in an unusual place."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from casadi_models import EFFECTS
from identification.linear.models import MORE_STATES
from workbench.cli import loop
from workbench.cli.main import main
from workbench.page.plan import open_questions

DEMO = Path(str(files("workbench"))) / "demo"
JOINT = str(DEMO / "joint.toml")


def said(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    try:
        code: Any = main(words)
    except SystemExit as left:  # argparse ends by itself
        code = left.code
    assert code == 2
    line = capsys.readouterr().err.strip()
    assert line.startswith("irj: ") and "\n" not in line
    return line


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (("effects", "stribek"), "stribeck"),
        (("diagnose", str(DEMO / "train.npz"), "--joint", JOINT, "--why", "stribek"), "stribeck"),
        (("joints", "shwo"), "show"),
        (("twostep", "a.csv", "--joint", JOINT, "--method", "alternatin"), "alternating"),
        (("export", "estimater", "--joint", JOINT), "estimator"),
        (("export", "correctd", "--joint", JOINT), "corrected"),
        (("check", str(DEMO / "trian.npz")), "train.npz"),
        (("joints", "show", "emp"), "emps"),
    ],
)
def test_the_word_that_may_be_meant_is_said(
    words: tuple[str, ...], meant: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert f"did you mean {meant!r}?" in said(capsys, *words)


def test_so_is_the_model_of_a_joint_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "j.toml"
    path.write_text('[joint]\nmodel = "irj_ta"\n', encoding="utf-8")
    assert "did you mean 'irj_ts'?" in said(capsys, "show", "--joint", str(path))


def test_where_nothing_is_near_it_says_what_the_joint_is(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert "plant is the joint as an FMU" in said(capsys, "export", "fmuu", "--joint", JOINT)


def test_a_joint_file_is_no_study(capsys: pytest.CaptureFixture[str]) -> None:
    assert "this is a joint file; a study has [study]" in said(capsys, "batch", JOINT)


def test_help_lists_every_kind_of_export(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["export", "--help"])
    words = re.findall(r"\w+", capsys.readouterr().out)
    every = {"plant", "estimator", "native", "ssp", "c", "casadi", "corrected", "pair"}
    assert every <= set(words)


def test_names_may_follow_a_library_and_a_folder_may_hold_the_published_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    row = {"kt": 4.5, "armature": 0.34, "friction_base": 4.1, "friction_viscous": 1.3}
    table = {"unit/m1": row, "unit/m2": {**row, "friction_base": 3.0}}
    (tmp_path / "params.json").write_text(json.dumps(table), encoding="utf-8")
    joint = ["--library", str(tmp_path), JOINT, "unit/m1", "unit/m2"]
    assert main(["joints", "compare", *joint]) == 0
    shown = capsys.readouterr().out
    assert "unit/m1" in shown and "unit/m2" in shown
    assert main(["joints", "list", "--library", JOINT, "--library", str(tmp_path)]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert {"unit/m2", "joint"} <= {line.split()[0] for line in listed}


@pytest.mark.parametrize(
    ("law", "why"),
    [
        ("__import__('os')", "column 1: the sign '_' has no place"),
        ("a*(", "column 4: the law ends where a value is expected; the text is no law"),
    ],
)
def test_a_text_that_is_no_law_is_called_so(
    law: str, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["add", "--law", law, "--on", "motor", "--joint", JOINT, "-o", str(tmp_path / "o.toml")]
    assert why in said(capsys, *words)


def test_help_says_which_orders_are_tried(capsys: pytest.CaptureFixture[str]) -> None:
    assert MORE_STATES == 2
    with pytest.raises(SystemExit):
        main(["linear", "--help"])
    assert "moesp, whose states serve all outputs, two more" in " ".join(
        capsys.readouterr().out.split()
    )


def test_what_is_for_the_report_asks_for_one(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["improve", "a.csv", "--joint", JOINT, "--author", "somebody"]
    assert "--author is for the report; give --report, too" in said(capsys, *words)


def test_the_report_of_improve_takes_what_that_of_report_takes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: dict[str, Any] = {}
    monkeypatch.setattr(loop, "improve_files", lambda *_, **__: ({}, None, []))
    monkeypatch.setattr(loop, "print_improvement", lambda *_, **__: None)
    monkeypatch.setattr(loop, "_write_report", lambda *_, **given: told.update(given))
    words = ["--report", "r.html", "--author", "A. Smith", "--notes", "new oil"]
    assert main(["improve", "a.csv", "--joint", JOINT, *words]) == 0
    assert told == {"author": "A. Smith", "notes": "new oil", "beside": {}}


def test_what_is_tried_by_its_parts_is_no_open_question() -> None:
    whole = next(e for e in EFFECTS.values() if e.parts)
    other = next(e for e in EFFECTS.values() if not e.parts)
    entries = [
        {"effect": whole.key, "title": "whole", "why": "its parts (a, b) are tried one by one"},
        {"effect": other.key, "title": "other", "why": "too short"},
    ]
    state: Any = SimpleNamespace(left_open={"not_testable": entries}, diagnosis={}, steps=[])
    assert [o["title"] for o in open_questions(state, "rotary")] == ["other"]
