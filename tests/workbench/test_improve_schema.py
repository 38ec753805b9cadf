"""`irj improve --json` keeps the shape that other people's scripts rely on."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from workbench.cli.main import improve_json, main

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
CASE = SHARED / "hidden_effect" / "stribeck"
SCHEMA = Path(__file__).parents[1] / "data" / "improve.schema.json"

if not CASE.exists() and not os.environ.get("CI"):
    pytest.skip("../shared/hidden_effect is not there", allow_module_level=True)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], list[Path]]:
    """Training and held-out records: the first half of each."""
    folder = tmp_path_factory.mktemp("halves")
    for name in ("train", "train2", "test", "test2"):
        lines = (CASE / f"{name}.csv").read_text().splitlines(keepends=True)
        (folder / f"{name}.csv").write_text("".join(lines[: len(lines) // 2]))
    train, held = ([folder / f"{n}{i}.csv" for i in ("", "2")] for n in ("train", "test"))
    return train, held


@pytest.fixture(scope="module")
def result(files: tuple[list[Path], list[Path]]) -> dict[str, Any]:
    return improve_json(*files, CASE / "joint.toml")


@pytest.mark.parametrize(
    "schema", [SCHEMA, SHARED / "spec" / "improve.schema.json"], ids=["own", "shared"]
)
def test_result_validates(result: dict[str, Any], schema: Path) -> None:
    described = json.loads(schema.read_text())
    jsonschema.Draft202012Validator.check_schema(described)
    jsonschema.validate(json.loads(json.dumps(result)), described)


def test_schema_refuses_what_is_not_a_result(result: dict[str, Any]) -> None:
    described = json.loads(SCHEMA.read_text())
    for spoil in (
        {"verdict": "perhaps"},
        {"steps": []},
        {"claims": [{"effects": []}]},
        {"records": {}},
    ):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**json.loads(json.dumps(result)), **spoil}, described)


def test_parts_of_the_result_agree_with_each_other(result: dict[str, Any]) -> None:
    found = result
    assert found["records"]["train"] == ["train", "train2"]
    assert found["records"]["held_out"] == ["test", "test2"]
    assert [s["added"] for s in found["steps"]] == [None, *found["added"]]
    assert found["added"] == [c["effects"][0] for c in found["claims"]] == ["stribeck"]
    first, last = found["steps"][0], found["steps"][-1]
    assert set(last["effects"]) - set(first["effects"]) == {"stribeck"}
    assert (
        last["held_out"]["relative_error_percent"]
        < 0.5 * first["held_out"]["relative_error_percent"]
    )
    before, after = (s["held_out"]["balances"]["motor"]["rms"] for s in (first, last))
    assert found["claims"][0]["held_out_drop_percent"] == pytest.approx(
        100 * (1 - after / before), abs=0.1
    )
    assert found["ranking"][0]["effect"] == "stribeck"
    assert found["ranking"][0]["significant"]
    assert not {r["effect"] for r in found["ranking"]} & {
        n["effect"] for n in found["not_testable"]
    }
    assert found["verdict"] == "complete"
    assert found["unexplained"] == []


def test_file_holds_the_same_data_as_the_python_call(
    files: tuple[list[Path], list[Path]],
    result: dict[str, Any],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    target = tmp_path / "result.json"
    records, held_out = ([str(path) for path in part] for part in files)
    assert (
        main(
            [
                "improve",
                *records,
                "--held-out",
                *held_out,
                "--joint",
                str(CASE / "joint.toml"),
                "--json",
                str(target),
            ]
        )
        == 0
    )
    written = json.loads(
        target.read_text(), parse_constant=lambda text: pytest.fail(f"{text} is not JSON")
    )
    jsonschema.validate(written, json.loads(SCHEMA.read_text()))
    assert written["added"] == result["added"]
    for name, parameter in written["steps"][-1]["parameters"].items():
        assert math.isclose(
            parameter["value"],
            result["steps"][-1]["parameters"][name]["value"],
            rel_tol=1e-6,
            abs_tol=1e-12,
        ), name
    assert "+ stribeck" in capsys.readouterr().out
