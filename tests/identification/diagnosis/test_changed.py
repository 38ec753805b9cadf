"""What moved in a fitted joint: the right parameter with its size, a payload in kg and metres,
nothing where nothing moved.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from casadi_models import JointModel
from identification import Joint, Record, fit, load_joint
from identification.data.joint_file import parse_joint
from identification.data.prepare import STANDARD_GRAVITY
from identification.diagnosis.changed import _prepared, changed, discovery_rates
from identification.errors import InputError
from identification.planning.follow import Controller, Follower
from tests.recorded_world import planted
from workbench.cli.main import main
from workbench.cli.virtual import write_table

RATIO, PER_AMPERE, DT = 160.0, 8.848, 2e-3
EFFECTS = ("viscous", "coulomb", "gravity")
TRUE = {
    "motor_inertia": 4.447,
    "link_inertia": 10.277,
    "stiffness": 2.2e4,
    "structural_damping": 60.0,
    "motor_viscous": 11.0,
    "link_viscous": 2.0,
    "motor_coulomb": 21.5,
    "link_coulomb": 0.8,
    "gravity_torque": 105.18,
    "motor_smoothing_velocity": 0.005,
    "link_smoothing_velocity": 0.005,
}
JOINT = Joint(
    name="arm", gear_ratio=RATIO, torque_per_current=PER_AMPERE, model_name="hd3", effects=EFFECTS
)
MASS, DISTANCE = 3.0, 0.4
LOADED = {
    "link_inertia": TRUE["link_inertia"] + MASS * DISTANCE**2,
    "gravity_torque": TRUE["gravity_torque"] + MASS * STANDARD_GRAVITY * DISTANCE,
}


@cache
def follower() -> Follower:
    model = JointModel.by_name("hd3", RATIO, effects=EFFECTS).with_values(TRUE)
    return Follower(model, DT, controller=Controller(25.0, 0.9), substeps=8)


def record(seed: int, moved: Mapping[str, float] | None = None, gain: float = 1.0) -> Record:
    """24 s along a sum of sines of its own; `gain`: torque per ampere of the drive over the one
    that the joint file says.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(round(24.0 / DT)) * DT
    w = 2 * np.pi * np.array([0.11, 0.29, 0.63, 1.4]) * rng.uniform(0.9, 1.1, 4)
    a = np.array([0.5, 0.22, 0.08, 0.02])
    angle = w[:, None] * t + rng.uniform(0, 2 * np.pi, 4)[:, None]
    path = np.column_stack(
        [a @ np.sin(angle), (a * w) @ np.cos(angle), -(a * w**2) @ np.sin(angle)]
    )
    run = follower().run(path, {n: np.full(len(t), v) for n, v in (moved or {}).items()})
    motor, link = 2 * np.pi / 9000, 2 * np.pi / 100_000
    return Record.from_channels(
        t,
        {
            "motor_current": run.drive / (PER_AMPERE * gain) + rng.normal(0, 0.004, len(t)),
            "motor_position": np.round(run.states[:, 0] * RATIO / motor) * motor,
            "link_position": np.round(run.states[:, 2] / link) * link,
            "link_torque": run.torque + rng.normal(0, 0.05, len(t)),
        },
        name=f"run {seed}",
    )


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("reference") / "healthy.toml"
    path.write_text(fit(JOINT, record(1)).to_joint_file(), encoding="utf-8")
    return path


def test_standard_errors_of_a_fit_come_back_from_its_file(reference: Path) -> None:
    fitted, read_back = fit(JOINT, record(1)).parameters, load_joint(reference)
    for name, p in fitted.items():
        assert read_back.fitted[name] == pytest.approx(p["value"], rel=1e-9)
        assert (name in read_back.errors) == (p["stderr"] is not None)
        if p["stderr"] is not None:
            assert read_back.errors[name] == pytest.approx(p["stderr"], rel=1e-5)


def test_errors_of_the_reference_go_together_as_its_file_says(reference: Path) -> None:
    """A change with everything else held: what an error of each reference value makes of it, by
    moving that value, and their correlations give its error.
    """
    joint = load_joint(reference)
    search = _prepared(joint, [record(5, {"motor_coulomb": 26.0})], lambda _text, _share: None)
    place = search.names.index("motor_coulomb")
    moved = (place,)

    def size(at: Any) -> float:
        return float(at.fitted(moved, at.start).sizes(moved)[place])

    pulls = np.zeros(len(search.names))
    for k, name in enumerate(search.names):
        if np.isfinite(search.spread[k]):
            values = {**search.form.values, name: search.start[k] + search.spread[k]}
            other = replace(search, form=replace(search.form, values=values))
            pulls[k] = size(other) - size(search)
    plain = replace(search, tied=np.eye(len(search.names)))
    together, apart = (
        float(s.fitted(moved, s.start).errors(moved)[place]) for s in (search, plain)
    )
    expected = pulls @ search.tied @ pulls - pulls @ pulls
    assert together**2 - apart**2 == pytest.approx(expected, rel=0.05)
    assert abs(together / apart - 1) > 0.02  # it matters


def test_correlations_of_errors_come_back_from_the_file(reference: Path) -> None:
    found, told = fit(JOINT, record(1)).solution, load_joint(reference).correlation
    assert told == found.together
    assert set(told.names) == {n for n, e in load_joint(reference).errors.items() if e is not None}
    # more viscous friction and less dry friction explain a motion about alike
    assert told.matrix(("motor_coulomb", "motor_viscous"))[0, 1] < -0.5


AXIS = Joint(name="axis", model_name="hd1", effects=("viscous", "coulomb"))


def sweep(seed: int, gain: float = 1.0) -> Record:
    """30 s to and fro at nearly one speed, where viscous and dry friction are nearly one column."""
    rng, dt = np.random.default_rng(seed), 4e-3
    t = np.arange(0.0, 30.0, dt)
    rate, phase = 0.5 * np.pi * rng.uniform(0.95, 1.05), rng.uniform(0.0, 6.0)
    slow = 1 + 0.2 * np.sin(0.44 * t + phase)
    velocity = 0.5 * np.tanh(3 * np.sin(rate * t)) * slow
    torque = 8 * np.gradient(velocity, dt) + 60 * velocity + 40 * np.tanh(velocity / 2e-3)
    return Record.from_channels(
        t,
        {
            "motor_torque": torque / gain + 4.0 * rng.standard_normal(len(t)),
            "motor_position": np.cumsum(velocity) * dt + 1e-6 * rng.standard_normal(len(t)),
        },
        name=f"sweep {seed}",
    )


def test_errors_of_a_reference_that_lie_against_each_other_cancel() -> None:
    """Each friction is known to .6 %, their sum to .1 %: so is a gain, which scales both."""
    healthy = parse_joint(tomllib.loads(fit(AXIS, sweep(1)).to_joint_file()))
    off = []
    for seed in range(2, 8):
        found = changed(healthy, sweep(seed, gain=0.97)).changes
        assert [c.parameter for c in found] == ["motor_constant_error"]
        off.append((found[0].after + 0.03) / found[0].stderr)
    # the stated error is that of the scatter about the truth: without correlations .17
    assert 0.4 < float(np.sqrt(np.mean(np.square(off)))) < 1.5


def cycle(seed: int, *, start: float = 0.0, coulomb: float = 40.0, rate: float = 1.1) -> Record:
    """20 s of an axis that repeats a motion, with torques that no law of the model has: cogging, a
    rope that pulls and a jerk at each turn.
    """
    rng, dt = np.random.default_rng(seed), 4e-3
    t = np.arange(0.0, 20.0, dt)
    place = np.mod(t + start, 10.0)  # of the motion, which takes 10 s
    velocity = 0.5 * np.sin(rate * np.pi * place / 5) + 0.3 * np.sin(0.4 * np.pi * place)
    angle = np.cumsum(velocity) * dt
    angle += 0.5 * 5 / (rate * np.pi) * (1 - np.cos(rate * np.pi * place[0] / 5))
    angle += 0.3 / (0.4 * np.pi) * (1 - np.cos(0.4 * np.pi * place[0]))
    strange = 9 * np.sin(23 * angle) + 7 * np.abs(angle) + 9 * np.exp(-((velocity / 0.08) ** 2))
    torque = 8 * np.gradient(velocity, dt) + 30 * velocity + strange
    torque += coulomb * np.tanh(velocity / 2e-3) + 2.0 * rng.standard_normal(len(t))
    position = angle + 1e-6 * rng.standard_normal(len(t))
    channels = {"motor_torque": torque, "motor_position": position}
    return Record.from_channels(t, channels, name=f"cycle {seed}")


def test_on_the_same_motion_the_errors_of_the_model_are_no_veil() -> None:
    """Dry friction 8 % higher, beside a model that leaves thirteen times the noise: alone it is not
    seen, and what the model lacks is taken for an offset where the record begins elsewhere.
    """
    healthy = cycle(1, rate=1.0)
    reference = parse_joint(tomllib.loads(fit(AXIS, healthy).to_joint_file()))
    now = cycle(2, start=3.7, coulomb=43.2, rate=1.0)
    alone = changed(reference, now)
    assert [c.parameter for c in alone.changes] == ["current_offset"]
    assert alone.least["motor_coulomb"] > 3.2
    beside = changed(reference, now, healthy=healthy)
    assert beside.alike == ("cycle 1",)
    (change,) = beside.changes
    assert change.parameter == "motor_coulomb"
    assert change.after - change.before == pytest.approx(3.2, abs=3 * change.stderr)
    assert change.stderr < 0.4
    still = changed(reference, cycle(3, start=5.1, rate=1.0), healthy=healthy)
    assert still.changes == ()
    assert still.least["motor_coulomb"] < alone.least["motor_coulomb"]


def test_another_motion_has_other_errors() -> None:
    """Healthy records that move otherwise change nothing of the answer."""
    reference = parse_joint(tomllib.loads(fit(AXIS, cycle(1, rate=1.0)).to_joint_file()))
    other, now = sweep(4), cycle(2, coulomb=60.0, rate=1.0)
    alone, beside = changed(reference, now), changed(reference, now, healthy=other)
    assert beside.alike == ()
    assert beside.as_json() == alone.as_json()


@pytest.mark.parametrize("seed", range(2, 7))
def test_nothing_changed_on_new_motion(reference: Path, seed: int) -> None:
    found = changed(load_joint(reference), record(seed))
    assert found.changes == ()
    assert found.payload is None
    assert set(found.unchanged) >= {"motor_coulomb", "stiffness", "gravity_torque", "link_inertia"}


@pytest.mark.parametrize(
    ("name", "factor", "seed"),
    [
        ("motor_coulomb", 1.25, 7),
        ("stiffness", 0.8, 8),
        ("motor_inertia", 1.1, 9),
        ("motor_viscous", 1.3, 10),
    ],
)
def test_the_parameter_that_moved_is_named_alone(
    reference: Path, name: str, factor: float, seed: int
) -> None:
    found = changed(load_joint(reference), record(seed, {name: factor * TRUE[name]}))
    assert [c.parameter for c in found.changes] == [name]
    change = found.changes[0]
    assert change.tied == ()
    assert change.after / change.before == pytest.approx(factor, rel=0.03)
    assert abs(change.after - change.before - (factor - 1) * TRUE[name]) < 4 * change.stderr
    assert change.q < 1e-4
    assert found.after.relative_error_percent < found.before.relative_error_percent


def test_what_could_not_be_seen_is_said_with_its_size(reference: Path) -> None:
    """Twice the smallest change that could be seen is named, and half of it is not."""
    still = changed(load_joint(reference), record(14))
    least, coulomb = still.least["motor_coulomb"], TRUE["motor_coulomb"]
    assert set(still.unchanged) <= set(still.least)
    assert 0.0 < least < 0.1 * coulomb
    more, less = (
        changed(load_joint(reference), record(14, {"motor_coulomb": coulomb + by}))
        for by in (2.0 * least, 0.5 * least)
    )
    assert [c.parameter for c in more.changes] == ["motor_coulomb"]
    assert "motor_coulomb" not in more.least
    assert less.changes == ()


def test_an_offset_of_the_drive_is_no_error_of_the_model(reference: Path) -> None:
    """What the refit leaves for want of an offset of the current is not held against naming it."""
    given = record(15)
    drive = given["motor_current"]
    found = changed(load_joint(reference), given.with_channel("motor_current", drive + 0.3))
    assert [c.parameter for c in found.changes] == ["current_offset"]
    assert found.changes[0].after == pytest.approx(-0.3 * PER_AMPERE, rel=0.05)


def test_the_gain_of_the_drive_is_one_change_and_not_many(reference: Path) -> None:
    found = changed(load_joint(reference), record(11, gain=0.85))
    assert [c.parameter for c in found.changes] == ["motor_constant_error"]
    assert found.changes[0].after == pytest.approx(-0.15, abs=0.005)


@pytest.mark.parametrize("seed", [12, 13])
def test_a_payload_in_kilograms_and_metres(reference: Path, seed: int) -> None:
    found = changed(load_joint(reference), record(seed, LOADED))
    assert {c.parameter for c in found.changes} == set(LOADED)
    assert (
        found.payload is not None
        and found.payload.distance is not None
        and found.payload.distance_stderr is not None
    )
    assert found.payload.mass == pytest.approx(MASS, rel=0.15)
    assert abs(found.payload.mass - MASS) < 4 * found.payload.stderr < MASS
    assert abs(found.payload.distance - DISTANCE) < 4 * found.payload.distance_stderr < DISTANCE


def test_a_payload_on_a_link_that_is_level_at_zero() -> None:
    """Its weight stands in the cosine part of gravity, and was no weight there."""
    level = {"gravity_torque": 0.0, "gravity_cosine": TRUE["gravity_torque"]}
    heavier = {**LOADED, "gravity_torque": 0.0, "gravity_cosine": LOADED["gravity_torque"]}
    fitted = parse_joint(tomllib.loads(fit(JOINT, record(1, level)).to_joint_file()))
    found = changed(fitted, record(12, heavier)).payload
    assert found is not None
    assert found.distance is not None
    assert found.mass == pytest.approx(MASS, rel=0.15)
    assert found.distance == pytest.approx(DISTANCE, rel=0.1)


def test_two_changes_at_once(reference: Path) -> None:
    found = changed(load_joint(reference), record(14, {"motor_coulomb": 26.0, "stiffness": 1.8e4}))
    assert {c.parameter for c in found.changes} == {"motor_coulomb", "stiffness"}


def test_command_line_writes_the_agreed_shape(
    reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = record(15, {"motor_coulomb": 26.9})
    units = {
        "motor_current": "A",
        "motor_position": "rad",
        "link_position": "rad",
        "link_torque": "Nm",
    }
    table = {
        "time_s": np.asarray(run.time),
        **{f"{c}_{u}": np.asarray(run[c]) for c, u in units.items()},
    }
    write_table(tmp_path / "now.csv", table)
    out = tmp_path / "out.json"
    assert main(["changed", str(reference), str(tmp_path / "now.csv"), "--json", str(out)]) == 0
    assert "changed: motor_coulomb" in capsys.readouterr().out
    data = json.loads(out.read_text(encoding="utf-8"))
    assert {"parameter", "from", "to", "stderr", "unit", "q"} <= set(data["changed"][0])
    assert data["changed"][0]["parameter"] == "motor_coulomb"
    assert data["changed"][0]["unit"] == "N.m"
    assert data["payload"] is None
    assert "stiffness" in data["unchanged"]
    assert (
        main(["changed", str(reference), str(tmp_path / "now.csv"), "--json", str(reference)]) == 2
    )
    bare = tmp_path / "bare.toml"
    bare.write_text(
        reference.read_text(encoding="utf-8").partition("[fitted]")[0], encoding="utf-8"
    )
    assert main(["changed", str(bare), str(tmp_path / "now.csv")]) == 2
    said = capsys.readouterr().err.splitlines()
    assert "[fitted]" in said[-1]


@pytest.mark.parametrize(
    ("seen", "model", "spring"),
    [
        (("motor_current", "motor_position"), "hd1", "load_compliance"),
        (("motor_current", "motor_position", "link_position"), "hd3", "stiffness"),
    ],
)
def test_changes_are_told_with_fewer_sensors(
    seen: tuple[str, ...], model: str, spring: str
) -> None:
    """Without torque sensor, and from the motor side alone, where a softer spring is a larger
    compliance of the load.
    """

    def part(whole: Record) -> Record:
        return Record.from_channels(whole.time, {c: whole[c] for c in seen}, name=whole.name)

    healthy = fit(replace(JOINT, model_name=model), part(record(1)))
    reference = parse_joint(tomllib.loads(healthy.to_joint_file()))
    assert changed(reference, part(record(31))).changes == ()
    soft = changed(reference, part(record(32, {"stiffness": 0.8 * TRUE["stiffness"]})))
    assert [c.parameter for c in soft.changes] == [spring]
    loaded = changed(reference, part(record(33, LOADED))).payload
    assert loaded is not None
    assert abs(loaded.mass - MASS) < 4 * loaded.stderr < MASS


def test_improve_says_first_what_changed_and_names_nothing_new(
    reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the healthy Coulomb torque in [known] a refit cannot take the change, and would call
    it something else.
    """
    for name, seed in (("train", 17), ("held", 18)):
        run = record(seed, {"motor_coulomb": 26.9})
        columns = [
            run.time,
            *(run[c] for c in ("motor_current", "motor_position", "link_position", "link_torque")),
        ]
        header = "time_s,motor_current_A,motor_position_rad,link_position_rad,link_torque_Nm"
        np.savetxt(
            tmp_path / f"{name}.csv",
            np.column_stack(columns),
            delimiter=",",
            header=header,
            comments="",
            fmt="%.12g",
        )
    joint = tmp_path / "joint.toml"
    joint.write_text(
        '[joint]\nname = "arm"\ngear_ratio = 160.0\ntorque_per_current = 8.848\nmodel = '
        '"hd3"\neffects = ["viscous", "coulomb", "gravity"]\n'
        "[known]\nmotor_coulomb = 21.5\n",
        encoding="utf-8",
    )
    out = tmp_path / "out.json"
    words = [
        "improve",
        str(tmp_path / "train.csv"),
        "--held-out",
        str(tmp_path / "held.csv"),
        "--joint",
        str(joint),
    ]
    assert main([*words, "--reference", str(reference), "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    assert printed.index("changed: motor_coulomb") < printed.index("start model")
    data = json.loads(out.read_text(encoding="utf-8"))
    assert [c["parameter"] for c in data["changed"]["changed"]] == ["motor_coulomb"]
    assert data["claims"] == []
    assert data["steps"][-1]["parameters"]["motor_coulomb"]["value"] == pytest.approx(
        26.9, rel=0.02
    )


def test_a_reference_of_other_channels_is_refused(reference: Path) -> None:
    whole = record(16)
    bare = Record.from_channels(
        whole.time, {c: whole[c] for c in ("motor_current", "motor_position")}, name="motor only"
    )
    joint = replace(
        load_joint(reference),
        model_name="hd1",
        effects=("viscous@motor", "coulomb@motor", "gravity"),
    )
    with pytest.raises(InputError, match="no fitted value of"):
        changed(joint, bare)


def test_rates_of_false_discovery_are_those_of_benjamini_and_hochberg() -> None:
    # the example of their paper (1995): 15 p-values, the first four are discoveries at 5 %
    p = [
        0.0001,
        0.0004,
        0.0019,
        0.0095,
        0.0201,
        0.0278,
        0.0298,
        0.0344,
        0.0459,
        0.3240,
        0.4262,
        0.5719,
        0.6528,
        0.7590,
        1.0,
    ]
    q = discovery_rates(p)
    assert [x <= 0.05 for x in q] == [True] * 4 + [False] * 11
    assert discovery_rates(p[::-1]) == q[::-1]


@pytest.mark.skipif(not planted.SHARED.exists(), reason="recordings are not here")
@pytest.mark.parametrize(
    ("law", "right"),
    [("", ""), ("coulomb", "motor_coulomb"), ("mass", "inertia"), ("gain", "motor_constant_error")],
)
def test_changes_planted_on_a_recorded_axis(law: str, right: str, tmp_path: Path) -> None:
    rig = planted.RIGS["emps"]
    train, held = rig.load()
    joint = str(planted.FILES / "emps.toml")
    healthy = [str(p) for p in planted.write(train, tmp_path, "healthy")]
    reference = tmp_path / "reference.toml"
    assert main(["fit", *healthy, "--joint", joint, "-o", str(reference)]) == 0
    tables = [planted.plant(rig, t, planted.CHANGED[law][0], 1.0) for t in held] if law else held
    now = [str(p) for p in planted.write(tables, tmp_path, "now")]
    out = tmp_path / "out.json"
    assert main(["changed", str(reference), *now, "--json", str(out)]) == 0
    data = json.loads(out.read_text(encoding="utf-8"))
    assert [c["parameter"] for c in data["changed"]] == ([right] if right else [])
    if law == "mass":
        assert data["payload"]["mass"] == pytest.approx(0.1 * rig.inertia, abs=2.0)
        assert data["payload"]["distance"] is None
