"""The sentence of the verdict: sets too large to be a name, claims in part; what a pattern of
balances points to; linear axes.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from casadi_models import EFFECTS
from casadi_models.quantities import linear_unit
from identification import Record, fit, improve, load_joint, read
from identification.data.joint_file import Joint
from identification.diagnosis.bench import JointBench
from identification.diagnosis.candidates import offered
from identification.diagnosis.claims import LARGEST_SET, rank, shortened
from identification.diagnosis.locate import Unexplained
from identification.diagnosis.places import gather, places
from identification.diagnosis.session import Session, with_held_out
from identification.diagnosis.trials import make_base
from identification.diagnosis.verdict import verdict_of
from identification.errors import InputError
from identification.fitting.engine import load_dataset, prepared_model
from tests.identification.diagnosis.test_other_payload import FAST, JOINT, record
from workbench.show.first_page import next_html
from workbench.show.fragments import pattern_of
from workbench.show.plots import report_plots

DEMO = Path(str(files("workbench"))) / "demo"
SLOW = ((0.07, 0.11), (0.15, 0.10), 0.8)


@pytest.mark.slow
def test_a_set_of_more_than_four_names_is_a_remainder_with_its_size() -> None:
    small = ((0.07, 0.11), (0.05, 0.03), 0.9)
    found = improve(record("loaded", 1, True, *small), JOINT, [record("held out", 2, True, *small)])
    assert found.claims == ()
    assert found.verdict == "unexplained"
    said, _, names = found.reason.partition("N.m remain that cannot be named: any of ")
    assert said
    # a gain of the drive and one of the sensor are one column here: either may lead
    assert set(names.split(", ")[:2]) == {"motor constant", "gain of the torque sensor"}
    assert "would help" in found.reason
    assert "nothing is missing" not in found.reason


def test_names_that_are_not_significant_leave_a_set_that_is_too_large() -> None:
    runs, held = ([record(n, k, True, *SLOW)] for k, n in ((1, "loaded"), (2, "held out")))
    start = fit(JOINT, runs, held_out=held)
    ranking = rank(make_base(start.solution, start.data))
    significant = [t.key for t in ranking.trials if t.candidate.label in ranking.significant]
    others = [t.key for t in ranking.trials if t.key not in significant]
    names = (significant[0], *others[:LARGEST_SET], significant[1])
    kept = shortened(names, ranking)
    assert len(kept) == LARGEST_SET
    assert {significant[0], significant[1]} <= set(kept)
    assert shortened(tuple(significant), ranking) == tuple(significant)


def test_a_claim_in_part_is_not_said_to_be_what_is_missing() -> None:
    train, held = (read(DEMO / n) for n in ("train.npz", "held_out.npz"))
    found = improve(train, load_joint(DEMO / "joint.toml"), [held])
    assert found.claims
    left = (Unexplained("motor", 40.0, axis="motor_velocity"),)
    args = (left, found.final_ratios, found.steps, None, "")
    whole = verdict_of(found.claims, *args)[1]
    part = verdict_of([replace(c, partial=True) for c in found.claims], *args)[1]
    assert whole.startswith("Missing: ")
    assert part.startswith("The error on held-out data falls from ")
    assert "Only part of the structure is explained by: " in part
    names = ("current_offset", "added_spring")
    either = verdict_of([replace(found.claims[0], effects=names, partial=True)], *args)[1]
    assert "by: one of (offset of the current, additional spring to ground). " in either


@pytest.mark.parametrize(
    ("ratios", "said"),
    [
        (
            {"motor": 9.0, "link": 9.0},
            "the torque sensor, which both share, or two physical effects",
        ),
        (
            {"motor": 9.0, "link": 9.0, "transmission": 1.0},
            "two physical effects, one on each side",
        ),
        ({"sum": 9.0, "deflection": 9.0}, "a position sensor"),
    ],
)
def test_a_pattern_is_read_in_the_light_of_the_balances_there_are(
    ratios: dict[str, float], said: str
) -> None:
    assert said in pattern_of(ratios)[1]


def test_a_linear_axis_has_no_laws_of_an_angle_and_units_of_its_own() -> None:
    time = np.arange(0, 24, 0.002)
    position = 0.1 * np.sin(2 * np.pi * 0.23 * time) + 0.03 * np.sin(2 * np.pi * 0.71 * time + 0.4)
    force = (
        95 * np.gradient(np.gradient(position, time), time) + 60 * np.gradient(position, time) + 6.0
    )
    noise = np.random.default_rng(5).standard_normal(len(time))
    axis = Record.from_channels(
        time,
        {"motor_torque": force + 0.1 * noise, "motor_position": position},
        name="axis",
        kind="linear",
    )
    joint = Joint(kind="linear", gear_ratio=1.0, effects=("viscous",))
    model = prepared_model(joint, axis)
    candidates, refused = offered(model, load_dataset([axis], [], joint, model))
    angular = {e.key for e in EFFECTS.values() if e.angular}
    assert angular == {"gravity", "gravity_upright", "cyclic_torque", "cyclic_friction"}
    assert not angular & {c.effect.key for c in candidates}
    assert {n.effect: n.why for n in refused}[
        "gravity"
    ] == "is a law of an angle; this axis is linear"
    found = improve(axis, joint)
    assert found.claims[0].effects[0] == "current_offset"
    assert not any(angular & set(c.effects) for c in found.claims)
    result = found.as_json()
    assert angular & {n["effect"] for n in result["not_testable"]}
    assert EFFECTS["cyclic_torque"].title not in next_html(found, result), "no run shows it"
    units = {p.unit for e in EFFECTS.values() for p in e.parameters}
    assert not [u for u in units if "rad" in linear_unit(u) or "N.m" in linear_unit(u)]


def test_rows_of_another_payload_stand_in_no_picture_of_the_link() -> None:
    loaded, held = record("loaded", 1, True, *SLOW), record("held out", 2, True, *SLOW)
    unloaded = replace(record("unloaded", 3, False, *FAST), payload="none")
    found = fit(JOINT, [loaded, unloaded], held_out=[held])
    with_both = {
        (p.balance, p.axis): p for p in places(found.solution, found.data, found.data.train)
    }
    rows = sum(b.rows.sum() for b in with_both["link", "time"].branches)
    assert rows <= found.data.train[0].rows
    assert sum(b.rows.sum() for b in with_both["motor", "time"].branches) > found.data.train[0].rows
    assert len(gather(found.data, found.data.train).block) == sum(w.rows for w in found.data.train)
    train, apart, _ = with_held_out([loaded, unloaded], [])
    data = load_dataset(train, apart, JOINT, prepared_model(JOINT, loaded))
    session = Session(JointBench(JOINT, data, train, apart))
    split = session.run(session.start(), 0)
    drawn = {(o.balance, o.record) for o in report_plots(split, [loaded, unloaded]).overlays}
    assert ("link", "loaded") in drawn
    assert ("link", "unloaded") not in drawn
    with pytest.raises(
        InputError, match="unloaded: every held-out record has another payload than loaded"
    ):
        improve([loaded], JOINT, [unloaded])
