"""A gear ratio or an encoder's scale that is a part in a thousand wrong: named, with its value,
on records the fit never saw.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from identification import Improvement, Record, improve, load_joint, read
from identification.diagnosis.bench import JointBench
from identification.diagnosis.session import Session
from identification.fitting.engine import load_dataset, prepared_model
from tests.hidden_effect.generator import generate_case


def scaled(record: Record, factor: float) -> Record:
    """The record as a motor encoder with a scale that is wrong by that factor would have read
    it.
    """
    for channel in ("motor_position", "motor_velocity"):
        record = record.with_channel(channel, factor * record[channel])
    return record


@pytest.mark.parametrize(
    ("effect", "factor"),
    [
        (None, 1.001),
        pytest.param(None, 0.998, marks=pytest.mark.slow),
        pytest.param("stribeck", 1.002, marks=pytest.mark.slow),
    ],
)
def test_a_scale_that_is_wrong_is_named_with_its_value(
    tmp_path: Path, effect: str | None, factor: float
) -> None:
    folder = generate_case(effect, 3, folder=tmp_path / "case")
    train, held = (
        [scaled(read(folder / f"{n}{i}.csv"), factor) for i in ("", "2")] for n in ("train", "test")
    )
    found = improve(train, load_joint(folder / "joint.toml"), held)
    names = [c.effects for c in found.claims]
    assert ("link_position_gain",) in names
    assert len(names) == (2 if effect else 1)
    assert found.verdict == "complete"
    assert found.steps[-1].solution.values["link_position_gain"] == pytest.approx(
        1 / factor - 1, rel=0.05
    )
    assert found.final_ratios["transmission"].ratio < 1.15
    assert (
        found.steps[-1].held_out.relative_error_percent
        < 0.5 * found.steps[0].held_out.relative_error_percent
    )


@pytest.mark.slow
def test_a_scale_that_leaves_no_stiffness_is_said(tmp_path: Path) -> None:
    folder = generate_case(None, 3, folder=tmp_path / "case")
    train, held = (
        [scaled(read(folder / f"{n}{i}.csv"), 1.01) for i in ("", "2")] for n in ("train", "test")
    )
    joint = load_joint(folder / "joint.toml")

    def begun(factor: float) -> Improvement:
        """What is said of the start model, on clocks as each record alone has them."""
        runs, apart = ([scaled(r, factor) for r in part] for part in (train, held))
        data = load_dataset(runs, apart, joint, prepared_model(joint, runs[0]))
        session = Session(JointBench(joint, data, runs, apart))
        return session.run(session.start(), 0)

    found, right = begun(1.0), begun(1 / 1.01)
    assert "stiffness" in found.steps[0].solution.at_bound
    assert any(
        "the stiffness went to zero" in w and "check gear_ratio" in w for w in found.warnings
    )
    assert not any("the stiffness went to zero" in w for w in right.warnings)


@pytest.mark.slow
def test_no_scale_is_named_where_none_is_wrong(tmp_path: Path) -> None:
    folder = generate_case("cubic_stiffness", 3, folder=tmp_path / "case")
    train, held = ([read(folder / f"{n}{i}.csv") for i in ("", "2")] for n in ("train", "test"))
    found = improve(train, load_joint(folder / "joint.toml"), held)
    assert not any("link_position_gain" in c.effects for c in found.claims)
