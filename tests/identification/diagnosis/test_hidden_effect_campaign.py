"""A small cut of the hidden-effect campaign (the whole: python -m tests.hidden_effect.campaign)."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.hidden_effect.campaign import thinned
from tests.hidden_effect.generator import generate_case
from tests.hidden_effect.scoring import score
from workbench.cli.main import improve_json

pytestmark = pytest.mark.skipif(
    shutil.which("gcc") is None, reason="the generator's C integrator needs gcc"
)


def judged(
    folder: Path, effect: str | None, seed: int, **options: Any
) -> tuple[Any, dict[str, Any]]:
    generate_case(effect, seed, folder=folder, **options)
    train, held = ([folder / f"{n}{i}.csv" for i in ("", "2")] for n in ("train", "test"))
    result = improve_json(train, held, folder / "joint.toml")
    return score(json.loads((folder / "truth.json").read_text()), result), result


@pytest.mark.parametrize(
    ("effect", "options"),
    [
        pytest.param("stribeck", {}, marks=pytest.mark.slow),
        pytest.param("cubic_stiffness", {"dirt": True}, marks=pytest.mark.slow),
        pytest.param("load_dependent_friction", {}, marks=pytest.mark.slow),
        pytest.param("hysteresis", {}, marks=pytest.mark.slow),
        pytest.param("torque_sensor_offset", {}, marks=pytest.mark.slow),
        pytest.param("added_spring", {"size": 0.2}, marks=pytest.mark.slow),
        pytest.param("torque_ripple", {}, marks=pytest.mark.slow),
        pytest.param("asymmetric_viscous", {"dirt": True}, marks=pytest.mark.slow),
    ],
)
def test_hidden_effect_is_in_the_set_and_nothing_else_is_claimed(
    tmp_path: Path, effect: str, options: dict[str, Any]
) -> None:
    found, result = judged(tmp_path, effect, 4001, **options)
    assert found.in_set == 1, result["claims"]
    assert found.extra == 0, result["claims"]
    assert result["ranking"][0]["effect"] in {n for c in result["claims"] for n in c["effects"]}


@pytest.mark.parametrize(
    ("effect", "seed"),
    [
        pytest.param("cyclic_torque", 7001, marks=pytest.mark.slow),
        pytest.param("stribeck", 7000, marks=pytest.mark.slow),
        pytest.param("kinematic_error", 7001, marks=pytest.mark.slow),
        pytest.param("asymmetric_coulomb", 7000, marks=pytest.mark.slow),
        pytest.param("current_offset", 7003, marks=pytest.mark.slow),
    ],
)
def test_one_record_with_few_reversals_names_the_effect(
    tmp_path: Path, effect: str, seed: int
) -> None:
    """Friction shows in one or two blocks only: the folds of the cross-validation without them
    know nothing about it.
    """
    generate_case(effect, seed, folder=tmp_path)
    result = improve_json(
        [tmp_path / "train.csv"], [tmp_path / "test.csv"], tmp_path / "joint.toml"
    )
    found = score(json.loads((tmp_path / "truth.json").read_text()), result)
    assert found.in_set == 1, result["claims"]
    assert found.extra == 0, result["claims"]
    assert len(result["claims"]) == 1


@pytest.mark.parametrize(
    ("effect", "verdict"),
    [
        (None, "nothing_missing"),
        pytest.param("stribeck", "complete", marks=pytest.mark.slow),
        pytest.param("piecewise_stiffness", "complete", marks=pytest.mark.slow),
    ],
)
def test_a_joint_that_sticks_at_its_turns_leaves_nothing_at_125_hz(
    tmp_path: Path, effect: str | None, verdict: str
) -> None:
    generate_case(effect, 1000, folder=tmp_path)
    slow = thinned(tmp_path, 4)
    train, held = ([slow / f"{n}{i}.csv" for i in ("", "2")] for n in ("train", "test"))
    result = improve_json(train, held, tmp_path / "joint.toml")
    assert [c["effects"][0] for c in result["claims"]] == ([effect] if effect else [])
    assert result["verdict"] == verdict


@pytest.mark.slow
def test_a_relative_is_not_added_beside_the_wrong_name_of_a_set(tmp_path: Path) -> None:
    """Three stiffnesses: soft wind-up and backlash together imitate them; the one law alone
    does as well.
    """
    generate_case("piecewise_stiffness", 7004, folder=tmp_path)
    result = improve_json(
        [tmp_path / "train.csv"], [tmp_path / "test.csv"], tmp_path / "joint.toml"
    )
    assert [c["effects"] for c in result["claims"]] == [["piecewise_stiffness"]]
    assert result["verdict"] == "complete"


@pytest.mark.parametrize(
    ("seed", "dirt"),
    [
        (4002, False),
        pytest.param(4003, False, marks=pytest.mark.slow),
        pytest.param(4004, True, marks=pytest.mark.slow),
    ],
)
def test_nothing_is_claimed_where_nothing_is_hidden(tmp_path: Path, seed: int, dirt: bool) -> None:
    _, result = judged(tmp_path, None, seed, dirt=dirt)
    assert result["claims"] == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["local_bump", "odd_order"])
def test_what_is_outside_the_library_is_located_and_not_named(tmp_path: Path, kind: str) -> None:
    found, result = judged(tmp_path, kind, 4005)
    assert [c for c in result["claims"] if "curve" not in c] == []  # a curve names no effect
    assert result["verdict"] == "unexplained"
    assert found.balance_right
    assert found.axis_right
