"""The generator of the recorded world: its physics, its sensors, what it hides, and the scoring
of answers.
"""

from __future__ import annotations

import ast
import json
import os
import time
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.recorded_world import campaign, causes, hidden, joints, motions, planted, sensors, world
from tests.recorded_world._engine import ROWS_PER_SECOND, STEP, FloatArray, library, simulate
from tests.recorded_world.scoring import score

pytestmark = pytest.mark.skipif(library() is None, reason="no C compiler")
BODY = {"JM": 4.4, "JL": 10.3, "TG": -105.0, "K": 2.15e4, "N": 160.0}


def free(changes: dict[str, float], seconds: float = 2.0) -> FloatArray:
    """A hanging link let go at 0.3 rad, without drive."""
    still = np.zeros((round(seconds * ROWS_PER_SECOND), 2))
    return simulate({**BODY, **changes}, still, np.array([0.31, 0.0, 0.3, 0.0]), settle=0.0)


@pytest.mark.parametrize("law", [{}, {"K3": 3.3e8}, {"KE1": 4e-4, "KE1_O": 2.0}, {"TG_P": 1.2}])
def test_energy_is_kept_without_friction_and_drive(law: dict[str, float]) -> None:
    run = free(law)
    swing = np.ptp(0.5 * 2.15e4 * (run[:, 1] - run[:, 3]) ** 2)
    coarse = np.ptp(run[:, 6])
    fine = np.ptp(free({**law, "STEP": STEP / 2})[:, 6])
    assert coarse < 1e-3 * swing
    assert coarse / fine == pytest.approx(4.0, rel=0.15)  # second order


@pytest.mark.parametrize(
    "law",
    [
        {"M_TC": 3.0},
        {"M_TC": 3.0, "M_V0": 0.005},
        {"M_TC": 3.0, "M_ZS": 2e-3},
        {"M_B": 5.0},
        {"C": 30.0},
        {"M_TC": 3.0, "M_MU": 0.05},
        {"L_TC": 2.0},
        {"HK1": 4e3, "HS1": 1e-3},
        {"M_BUMP": 4.0, "M_BUMP_W": 0.2},
        {"M_O1": 3.0, "M_V1": 0.1},
    ],
)
def test_friction_takes_energy(law: dict[str, float]) -> None:
    energy = free(law)[:, 6]
    # a slip element gives back what it stored, at most its own spring's energy
    stored = sum(0.5 * law.get(f"HK{i}", 0.0) * law.get(f"HS{i}", 0.0) ** 2 for i in (1, 2, 3))
    most = stored + 1e-4 * float(energy[0] - energy.min() + 1.0)
    bristle = 0.5 * law.get("M_TC", 0.0) * law.get("M_ZS", 0.0)
    assert np.max(energy - np.minimum.accumulate(energy)) < most + bristle
    assert energy[-1] < energy[0] - 0.05


def test_dry_friction_holds_and_lets_go_at_its_level() -> None:
    rows = np.column_stack([np.full(2000, 0.3), np.zeros(2000)])
    start = np.zeros(4)
    held = simulate({**BODY, "TG": 0.0, "M_TC": 6.01, "KP": 20.0}, rows, start)
    assert np.all(held[:, 2] == 0.0)
    moved = simulate({**BODY, "TG": 0.0, "M_TC": 5.9, "KP": 20.0}, rows, start)
    assert moved[-1, 1] > 1e-4


def test_torque_and_twist_belong_to_one_moment() -> None:
    run = free({"C": 30.0})
    twist, rate = run[:, 1] - run[:, 3], run[:, 2] - run[:, 4]
    found = np.linalg.lstsq(np.column_stack([twist, rate]), run[:, 5], rcond=None)[0]
    assert found[0] == pytest.approx(BODY["K"], rel=1e-4)
    assert found[1] == pytest.approx(30.0, rel=1e-2)  # half a step of lateness would make it 31.1


def test_balances_of_both_bodies_hold_on_the_exact_motion() -> None:
    case = world.make_case(8, without=world.TROUBLES, names=(), seconds=8.0)
    e, p = case.exact["train"], case.values
    acceleration = np.gradient(e[:, [2, 4]], 1.0 / ROWS_PER_SECOND, axis=0)
    motor = (
        p["JM"] * acceleration[:, 0]
        + p["M_B"] * e[:, 2]
        + p["M_TC"] * np.sign(e[:, 2])
        + e[:, 5]
        - e[:, 0]
    )
    link = (
        p["JL"] * acceleration[:, 1] + p["L_B"] * e[:, 4] + p["L_TC"] * np.sign(e[:, 4]) - e[:, 5]
    )
    link -= p["TG"] * np.sin(e[:, 3] + p["TG_P"])
    moving = (np.abs(e[:, 2]) > 0.05 * case.joint.make.speed) & (
        np.abs(e[:, 4]) > 0.05 * case.joint.make.speed
    )
    moving &= np.convolve(~moving, np.ones(9), "same") == 0
    for residual in (motor, link):
        # smoothed friction differs from its sign by less than 1e-3 at these speeds
        assert np.sqrt(np.mean(residual[moving] ** 2)) < 0.01 * case.joint.friction


@pytest.mark.parametrize("name", [*hidden.LIBRARY, *hidden.OUTSIDE])
def test_a_law_acts_and_only_its_own_parameters_change(name: str) -> None:
    seed = 0 if name != "backlash" else 1
    plain = world.make_case(seed, without=world.TROUBLES, names=(), seconds=4.0)
    case = world.make_case(seed, without=world.TROUBLES, names=(name,), size=1.0, seconds=4.0)
    changed = {k for k in case.values if case.values[k] != plain.values.get(k)}
    law = case.laws[name]
    assert changed == {k for k, v in law.values.items() if v != plain.values.get(k)}
    difference = case.measured["train"] - plain.measured["train"]
    if name in ("coulomb", "gravity"):  # the joint has them anyway; the joint file lacks them
        assert np.all(difference == 0.0)
        listed = tomllib.loads(world.joint_text(case, "all"))["joint"]["effects"]
        assert name not in listed
        assert name in tomllib.loads(world.joint_text(plain, "all"))["joint"]["effects"]
    else:
        assert np.any(difference != 0.0)


def test_nothing_is_hidden_where_nothing_is_asked_for() -> None:
    case = world.make_case(3, without=world.TROUBLES, names=(), seconds=2.0)
    assert case.values == case.joint.values
    assert not case.laws


def test_strength_is_what_the_law_makes_of_the_signals() -> None:
    assert world.make_case(3, names=(), seconds=2.0).strength == 0.0
    full, third = (
        world.make_case(20, names=("current_offset",), size=s, seconds=6.0) for s in (1.0, 0.3)
    )
    offset = full.laws["current_offset"].truth["current_offset_A"]
    share = 100.0 * abs(offset) / np.std(full.measured["train"][:, 0])
    assert full.strength == pytest.approx(share, rel=1e-3)
    assert third.strength == pytest.approx(0.3 * share, rel=1e-3)


def test_size_scales_a_law_in_proportion() -> None:
    full, third = (
        world.make_case(0, names=("quadratic_drag",), size=s, seconds=2.0) for s in (1.0, 0.3)
    )
    key = next(iter(full.laws["quadratic_drag"].values))
    assert third.values[key] == pytest.approx(0.3 * full.values[key], rel=1e-12)


@pytest.mark.parametrize("kind", sensors.NOISES)
def test_noise_has_unit_deviation_and_its_colour(kind: str) -> None:
    x = sensors.coloured(np.random.default_rng(4), kind, 100_000, 500.0)
    assert np.std(x) == pytest.approx(1.0, rel=0.06)
    neighbour = np.corrcoef(x[1:], x[:-1])[0, 1]
    power = np.abs(np.fft.rfft(x)) ** 2
    if kind in ("white", "heavy"):
        assert abs(neighbour) < 0.02
    if kind == "ar":
        assert neighbour == pytest.approx(0.9, abs=0.01)
    if kind == "hum":
        assert np.sort(power)[-6:].sum() / power.sum() == pytest.approx(0.5, abs=0.06)
    if kind == "heavy":
        assert np.mean(np.abs(x) > 4.0) > 3e-3  # a normal deviate: 6e-5
    if kind == "drift":
        assert power[1:50].sum() / power[1:].sum() > 0.4


def _sensors(**changes: float | int | str | bool) -> sensors.Sensors:
    plain: dict[str, float | int | str | bool] = {
        "rate": 500.0,
        "zero": 0.0,
        "link_skew": 0.0,
        "torque_skew": 0.0,
        "motor_bits": 19,
        "link_bits": 19,
        "current_bits": 16,
        "filter": 0.0,
        "jitter": 0.0,
        "lost": 0.0,
        "noise": "white",
        "level": 1e-9,
        "velocities": True,
    }
    return sensors.Sensors(**{**plain, **changes})  # type: ignore[arg-type]


def test_zero_skew_steps_and_losses_are_what_was_drawn() -> None:
    case = world.make_case(1, without=world.TROUBLES, names=(), motion="multisine", seconds=10.0)

    def seen(**changes: float | int | str | bool) -> tuple[FloatArray, FloatArray]:
        rng = np.random.default_rng(0)
        return sensors.observe(rng, case.exact["train"], case.joint, _sensors(**changes), {})

    t, plain = seen()
    link, torque = sensors.CHANNELS.index("link_position"), sensors.CHANNELS.index("link_torque")
    step = 2.0 * np.pi / 2**19
    assert np.allclose(seen(zero=3e-3)[1][:, link] - plain[:, link], 3e-3, atol=1.5 * step)
    late = seen(torque_skew=2.0)[1][:, torque]
    assert np.allclose(late[2:], plain[:-2, torque], atol=1e-6 * np.ptp(late))
    coarse = seen(link_bits=12)[1][:, link] / (2.0 * np.pi / 2**12)
    assert np.allclose(coarse, np.round(coarse), atol=1e-6)
    kept = len(seen(lost=0.1)[0]) / len(t)
    assert kept == pytest.approx(0.9, abs=0.015)
    jittered = np.diff(seen(jitter=0.1)[0])
    assert np.std(jittered) == pytest.approx(np.sqrt(2.0) * 0.1 / 500.0, rel=0.05)
    assert np.all(jittered > 0.0)


def test_both_encoders_agree_through_the_gear_but_for_the_twist() -> None:
    case = world.make_case(0, without=world.TROUBLES, names=(), seconds=5.0)
    motor = case.measured["train"][:, 1] / case.joint.gear_ratio
    twist = motor - case.measured["train"][:, 3]
    torque = case.measured["train"][:, 5]
    slope = np.dot(twist - twist.mean(), torque) / np.dot(torque - torque.mean(), torque)
    assert 1.0 / slope == pytest.approx(case.values["K"], rel=0.05)


@pytest.mark.parametrize("motion", motions.MOTIONS)
def test_motions_keep_to_travel_speed_and_their_own_rate(motion: str) -> None:
    for make in joints.MAKES.values():
        joint = joints.draw(np.random.default_rng(1), make)
        path = motions.record(np.random.default_rng(2), joint, motion, 20.0, rests=True)
        assert path.shape == (20 * ROWS_PER_SECOND, 2)
        assert np.all(np.abs(path[:, 0]) < 1.4 * make.stroke)
        assert np.abs(path[:, 1]).max() < 1.001 * make.speed
        there = path[0, 0] + np.cumsum(path[:, 1]) / ROWS_PER_SECOND
        assert np.abs(there - path[:, 0]).max() < 0.01 * make.stroke


def test_every_run_of_thirty_seeds_has_all_makes_and_motions() -> None:
    cases = [world.make_case(s, seconds=2.0) for s in range(30)]
    assert len({(c.joint.make.name, c.motion) for c in cases}) == 30
    assert {c.kind for c in cases} == set(world.KINDS)
    assert 0 < sum(c.dirty for c in cases) < 20


def test_one_seed_is_one_joint_whatever_is_switched_off() -> None:
    case = world.make_case(7, seconds=2.0)
    again = world.make_case(7, seconds=2.0)
    assert np.array_equal(case.measured["test"], again.measured["test"])
    clean = world.make_case(7, seconds=2.0, without=("zero", "noise", "lost"))
    assert clean.names == case.names
    assert {k: v for k, v in clean.values.items() if case.values[k] != v} == {}


def test_a_joint_with_two_records_takes_less_than_a_second(tmp_path: Path) -> None:
    library()
    spent = []
    for seed in range(5):
        began = time.process_time()
        case = world.make_case(seed)
        world.write_case(case, tmp_path / str(seed), "all")
        spent.append(time.process_time() - began)
    assert np.median(spent) < 1.0


def test_files_say_what_each_sensor_set_records(tmp_path: Path) -> None:
    case = world.make_case(2, names=("stribeck",), seconds=2.0)
    for given, channels in sensors.SETS.items():
        folder = world.write_case(case, tmp_path / given, given)
        header = (folder / "train.csv").read_text(encoding="utf-8").split("\n", 1)[0].split(",")
        assert {"link_torque_Nm" in header, "link_torque" in channels} in ({True}, {False})
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        assert truth["hidden"] == ["stribeck"]
        joint = tomllib.loads((folder / "joint.toml").read_text(encoding="utf-8"))["joint"]
        assert joint["model"] == ("hd3" if "link_position" in channels else "hd1")
        assert "stribeck" not in joint["effects"]


def _truth(**changes: object) -> dict[str, Any]:
    plain: dict[str, Any] = {
        "seed": 1,
        "make": "cobot100",
        "motion": "multisine",
        "kind": "single",
        "size": 1.0,
        "hidden": ["stribeck"],
        "neutral": ["gravity_phase"],
        "laws": {"stribeck": {}},
        "orders": {},
        "motor_turns": 100.0,
        "values": {"KE2_O": 3.3},
        "sensor_set": "all",
        "dirty": False,
        "sensors": {"rate": 500.0, "noise": "white", "lost": 0.0},
    }
    return {**plain, **changes}


def _result(*claims: object, verdict: str = "complete", **more: object) -> dict[str, Any]:
    listed = [
        c if isinstance(c, dict) else {"effects": [c] if isinstance(c, str) else c} for c in claims
    ]
    held = {"relative_error_percent": 2.0, "balances": {"motor": {"ratio": 1.1}}}
    return {"claims": listed, "verdict": verdict, "steps": [{"held_out": held}], **more}


def test_right_names_sets_and_neutral_names_are_told_apart() -> None:
    right = score(_truth(), _result("stribeck@motor", "gravity_phase"))
    assert (right.found, right.single, right.right, right.wrong) == (
        ("stribeck",),
        ("stribeck",),
        ("stribeck",),
        (),
    )
    assert right.all_right
    in_set = score(_truth(), _result(["lugre", "stribeck"]))
    assert in_set.found == ("stribeck",)
    assert in_set.single == ()
    beside = score(_truth(), _result("stribeck", "cubic_viscous"))
    assert beside.wrong == ("cubic_viscous",)
    assert not beside.all_right
    partial = score(
        _truth(), _result({"effects": ["lugre"], "partial": True}, verdict="unexplained")
    )
    assert (partial.wrong, partial.marked, partial.found) == ((), ("lugre",), ())
    assert not partial.all_right


def test_nothing_hidden_and_laws_outside_the_library() -> None:
    nothing = {"hidden": [], "kind": "none", "laws": {}}
    assert score(_truth(**nothing), _result(verdict="nothing_missing")).all_right
    assert not score(_truth(**nothing), _result("lugre")).all_right
    assert not score(_truth(**nothing), _result(verdict="unexplained")).all_right
    assert score(_truth(**nothing, dirty=True), _result(verdict="unexplained")).all_right
    outside = {"hidden": ["odd_curve"], "kind": "outside", "laws": {"odd_curve": {}}}
    assert score(_truth(**outside), _result(verdict="unexplained")).all_right
    assert score(_truth(**outside), _result("learned")).all_right
    assert not score(_truth(**outside), _result("stribeck", "quadratic_drag")).all_right


def test_lines_count_by_their_order_in_any_unit() -> None:
    ripple = {
        "hidden": ["torque_ripple"],
        "laws": {"torque_ripple": {}},
        "orders": {"torque_ripple": 2.0},
    }
    for order, per in ((2.0, "motor turn"), (200.0, "link turn")):
        line = {"order": order, "per": per, "tolerance": 0.02, "effects": ["torque_ripple"]}
        assert score(_truth(**ripple), _result(lines=[line])).found == ("torque_ripple",)
    off = {"order": 2.6, "per": "motor turn", "tolerance": 0.02, "effects": ["torque_ripple"]}
    missed = score(_truth(**ripple), _result("torque_ripple", lines=[off]))
    assert missed.found == ()
    assert missed.wrong
    dirt = {**off, "order": 3.3}
    assert score(_truth(**ripple), _result(lines=[dirt])).wrong == ()
    pitch = {"order": 100.0, "per": "metre", "tolerance": 0.1, "effects": ["torque_ripple"]}
    screw = {**ripple, "orders": {"torque_ripple": 1.0}, "motor_turns": 2.0 * np.pi / 0.01}
    assert score(_truth(**screw), _result(lines=[pitch])).found == ("torque_ripple",)


def test_a_delay_may_be_told_as_skew() -> None:
    late = {"hidden": ["channel_delay"], "laws": {"channel_delay": {"current_delay_s": 8e-3}}}
    skew = {"what": "skew", "sensor": "motor_current", "run": 0, "value": -7.6e-3}
    assert score(_truth(**late), _result(calibration=[skew])).all_right
    assert not score(_truth(**late), _result(calibration=[{**skew, "value": 1e-3}])).all_right
    filtered = {**skew, "value": 14e-3, "waits": 7.6e-3}
    assert score(_truth(**late), _result(calibration=[filtered])).all_right
    assert not score(_truth(**late), _result(calibration=[{**filtered, "waits": 1e-3}])).all_right


def test_campaign_names_what_is_hidden_and_goes_on_where_it_stopped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "answers.jsonl"
    words = [
        "--seeds",
        "20",
        "--sensors",
        "all",
        "motor",
        "--without",
        "everything",
        "--names",
        "cubic_stiffness",
    ]
    words += ["--size", "1", "--seconds", "12", "--json", str(out)]
    assert campaign.main(words) == 0
    first = capsys.readouterr()
    # the motor side alone is not asked to show a law of the transmission
    assert [json.loads(x)["sensors"] for x in out.read_text(encoding="utf-8").splitlines()] == [
        "all",
        "motor",
    ]
    assert [a.found for a in campaign.load(out)] == [("cubic_stiffness",)]
    assert campaign.main(words) == 0
    again = capsys.readouterr()
    assert again.err == ""
    assert again.out == first.out
    assert "Seeds to tune on" in again.out
    assert "Held-back" not in again.out


def test_a_command_line_makes_the_same_case_again() -> None:
    job = campaign.Job(
        7,
        "all",
        without=("zero", "skew"),
        size=0.3,
        names=("stribeck",),
        kind="single",
        seconds=2.0,
    )
    words = job.command.partition("campaign ")[2].split()
    assert campaign.plan(campaign.parser().parse_args(words)) == [replace(job, limit=180.0)]
    lone = replace(job, without=tuple(t for t in world.TROUBLES if t != "zero"))
    assert "--only zero" in lone.command
    words = lone.command.partition("campaign ")[2].split()
    assert campaign.plan(campaign.parser().parse_args(words)) == [replace(lone, limit=180.0)]


needs_recordings = pytest.mark.skipif(
    not planted.SHARED.exists() and not os.environ.get("CI"),
    reason="../shared/measurements is not there",
)


def _emps_fit(table: planted.Table) -> FloatArray:
    m = planted.motion(planted.RIGS["emps"], table)
    columns = [m.a, m.v, np.tanh(m.v / 1e-3), np.ones_like(m.v), m.q - m.q.mean()]
    return np.linalg.lstsq(np.column_stack(columns), m.torque, rcond=None)[0]


@needs_recordings
def test_what_is_planted_moves_the_parameter_by_its_size() -> None:
    rig = planted.RIGS["emps"]
    table = rig.load()[0][0]
    plain = _emps_fit(table)
    assert plain[0] == pytest.approx(95.1, rel=0.03)
    assert plain[2] == pytest.approx(20.4, rel=0.05)
    for name, row, change in (("mass", 0, 9.51), ("coulomb", 2, 5.1), ("offset", 3, -5.1)):
        law = {**planted.NEW, **planted.CHANGED}[name][0]
        moved = _emps_fit(planted.plant(rig, table, law, 1.0)) - plain
        assert moved[row] == pytest.approx(change, rel=0.03)
    gained = _emps_fit(planted.plant(rig, table, planted.CHANGED["gain"][0], 1.0))
    assert gained[:3] == pytest.approx(plain[:3] / 0.85, rel=1e-6)


@needs_recordings
@pytest.mark.parametrize("name", planted.RIGS)
def test_every_rig_has_a_joint_file_of_its_columns_and_each_law_acts(name: str) -> None:
    rig = planted.RIGS[name]
    train, held = rig.load()
    joint = tomllib.loads((planted.FILES / f"{name}.toml").read_text(encoding="utf-8"))
    assert {c["column"] for c in joint["columns"].values()} <= set(train[0]) & set(held[0])
    for law, _ in (*planted.NEW.values(), *planted.CHANGED.values()):
        added = law(rig, planted.motion(rig, train[0]), 1.0)
        assert np.all(np.isfinite(added))
        assert np.std(added) > 0.0 or np.all(added != 0.0)


def test_a_planted_name_is_judged_against_what_the_plain_records_give() -> None:
    usual, right = frozenset({"coulomb"}), frozenset({"stribeck"})
    assert planted.judged(_result("coulomb", "stribeck"), right, usual) == (True, True, ())
    assert planted.judged(_result("coulomb", ["lugre", "stribeck"]), right, usual) == (
        True,
        False,
        (),
    )
    assert planted.judged(_result("lugre"), right, usual) == (False, False, ("lugre",))


def test_only_troubles_that_change_the_records_are_tried_as_causes() -> None:
    job = campaign.Job(20, "all", seconds=2.0, without=world.TROUBLES)
    case = world.make_case(20, seconds=2.0)
    for trouble, there in (
        ("zero", True),
        ("lost", case.sensors.lost > 0.0),
        ("jitter", case.sensors.jitter > 0.0),
        ("filter", case.sensors.filter > 0.0),
        ("dirt", case.dirty),
    ):
        alone = replace(job, without=tuple(t for t in world.TROUBLES if t != trouble))
        assert causes.acts(alone, job) == there


def test_causes_are_counted_with_a_command_for_each() -> None:
    rows: list[dict[str, object]] = [
        {
            "case": f"{i} all",
            "hidden": "nothing",
            "cause": cause,
            "command": f"run {i}",
            "said": "x",
        }
        for i, cause in enumerate(("zero", "noise", "zero"))
    ]
    text = causes.markdown(rows)
    assert "| zero | 2 | `run 0` |" in text
    assert text.index("| zero | 2") < text.index("| noise | 1")


def test_generator_and_scoring_import_nothing_of_the_project() -> None:
    own = {"casadi_models", "identification", "irj_fmu", "workbench"}
    folder = Path(world.__file__).parent
    for name in ("_engine", "joints", "motions", "hidden", "sensors", "world", "scoring"):
        tree = ast.parse((folder / f"{name}.py").read_text(encoding="utf-8"))
        nodes = list(ast.walk(tree))
        taken = {a.name for n in nodes if isinstance(n, ast.Import) for a in n.names}
        taken |= {str(n.module) for n in nodes if isinstance(n, ast.ImportFrom)}
        assert not own & {t.partition(".")[0] for t in taken}
