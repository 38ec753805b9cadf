"""What the verbs are given: one record or several, a joint; anything else is one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from identification import fit, improve, load_joint, read
from identification.errors import InputError

DEMO = Path(__file__).resolve().parents[3] / "workbench" / "demo"


def test_one_held_out_record_is_a_list_of_one() -> None:
    joint = load_joint(DEMO / "joint.toml")
    train, unseen = (read(DEMO / f"{n}.npz", joint=joint) for n in ("train", "held_out"))
    alone, several = fit(joint, train, held_out=unseen), fit(joint, [train], held_out=[unseen])
    assert alone.held_out is not None
    assert alone.held_out.as_json() == several.held_out.as_json()  # type: ignore[union-attr]
    assert fit(joint, train).held_out is None


@pytest.mark.parametrize("given", ["train.npz", [Path("train.npz")], 3, {"train": 1}])
def test_what_is_no_record_is_said_in_one_line(given: Any) -> None:
    joint = load_joint(DEMO / "joint.toml")
    for verb in (
        lambda: fit(joint, given),
        lambda: fit(joint, read(DEMO / "train.npz", joint=joint), held_out=given),
        lambda: improve(given, joint),
    ):
        with pytest.raises(InputError, match=r"a record, or a list of them.*read\(FILE\)") as said:
            verb()
        assert "\n" not in str(said.value)


def test_what_is_no_joint_is_said_in_one_line() -> None:
    train: Any = read(DEMO / "train.npz")
    with pytest.raises(InputError, match="a joint or a model is needed, and not Record"):
        fit(train, load_joint(DEMO / "joint.toml"))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="a record, or a list of them"):
        improve("train.npz", load_joint(DEMO / "joint.toml"))  # type: ignore[arg-type]
