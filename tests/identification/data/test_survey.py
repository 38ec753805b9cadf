"""What a file holds, before it is used: wrong units, several joints, a supply, a linear axis."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from identification.data.check.gate import inspected
from identification.data.guess import guess_columns, numbered, of_joint
from identification.data.read import read
from identification.data.survey import BUCKETS, Survey, questions_of, survey
from identification.errors import InputError
from workbench.cli.main import main

T = 0.002 * np.arange(3000)
SWING = np.sin(3.0 * T)
SPEED = 3.0 * np.cos(3.0 * T)


def written(path: Path, **columns: np.ndarray) -> Path:
    table = np.column_stack(list(columns.values()))
    file = path / "rig.csv"
    np.savetxt(file, table, delimiter=",", header=",".join(columns), comments="", fmt="%.10g")
    return file


def said(made: Survey) -> str:
    return "; ".join([*(t for _, t in made.questions), *(f.message for f in made.findings)])


CASES = {
    "degrees without a unit": ({"t": T, "link_pos": 70 * SWING, "iq_A": SPEED}, "turns: degrees?"),
    "encoder counts": (
        {"t": T, "link_pos": np.round(40000 * SWING), "iq_A": SPEED},
        "turns: encoder counts?",
    ),
    "the angle of the motor": (
        {"t": T, "q": 160 * SWING, "iq_A": SPEED},
        "or the motor's angle before a gear?",
    ),
    "velocity in rpm": (
        {"t": T, "q_rad": SWING, "qd": SPEED * 30 / np.pi, "iq_A": SPEED},
        "the velocity is in rpm and was taken for rad/s",
    ),
    "velocity in degrees": (
        {"t": T, "q_rad": SWING, "qd": np.rad2deg(SPEED), "iq_A": SPEED},
        "degrees were taken for radians",
    ),
    "time in milliseconds": (
        {"t": 1000 * T, "q_rad": SWING, "iq_A": SPEED},
        "is time in ms?",
    ),
    "a supply": (
        {"t": T, "q_rad": SWING, "vbus_V": 48 + 0.2 * SPEED},
        "never changes sign while the joint turns back: a supply voltage?",
    ),
    "a magnitude": (
        {"t": T, "q_rad": SWING, "iq_A": np.abs(SPEED)},
        "comes to zero and never changes sign: a magnitude without its sign?",
    ),
    "joints side by side": (
        {"t": T, "q1_rad": SWING, "q2_rad": SPEED, "i1_A": SPEED, "i2_A": SWING},
        "columns of 2 joints, 1 to 2: this is joint 1",
    ),
    "time that starts again": (
        {"t": np.concatenate([T[:1000]] * 3), "q_rad": SWING, "iq_A": SPEED},
        "the time starts again 2 times: 3 runs",
    ),
    "a linear axis": ({"t": T, "pos_mm": 100 * SWING, "u_V": SPEED}, "a length: a linear axis"),
    "an angle that wraps": (
        {"t": T, "link_pos_deg": np.rad2deg(np.mod(6 * SWING, 2 * np.pi)), "iq_A": SPEED},
        "wraps",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_odd_is_said_before_the_file_is_used(case: str, tmp_path: Path) -> None:
    columns, expected = CASES[case]
    assert expected in said(survey(written(tmp_path, **columns)))


NAMED = {
    "degrees in a column of radians": (
        {"time_s": T, "link_position_rad": 70 * SWING, "motor_current_A": SPEED},
        "the link would swing 22 turns: degrees?",
    ),
    "a supply": (
        {"time_s": T, "link_position_rad": SWING, "motor_voltage_V": 48 + 0.2 * SPEED},
        "motor_voltage never changes sign while the joint turns back: a supply voltage?",
    ),
    "a magnitude": (
        {"time_s": T, "link_position_rad": SWING, "motor_current_A": np.abs(SPEED)},
        "motor_current comes to zero and never changes sign: a magnitude without its sign?",
    ),
    "time that starts again": (
        {
            "time_s": np.concatenate([T[:1000]] * 3),
            "link_position_rad": SWING,
            "motor_current_A": SPEED,
        },
        "the time starts again 2 times: 3 runs",
    ),
    "joints side by side": (
        {
            "time_s": T,
            "motor_position_1_rad": SWING,
            "motor_position_2_rad": SPEED,
            "motor_current_1_A": SPEED,
            "motor_current_2_A": SWING,
        },
        "columns of 2 joints, 1 to 2: this is joint 1",
    ),
    "the angle of a motor": (
        {"time_s": T, "motor_position_rad": 160 * SWING, "motor_current_A": SPEED},
        None,
    ),
}
"""Files whose headers say everything, so that no map is asked for."""


@pytest.mark.parametrize("case", NAMED)
def test_headers_that_say_everything_are_doubted_too(case: str, tmp_path: Path) -> None:
    columns, expected = NAMED[case]
    file = written(tmp_path, **columns)
    record = read(file)
    found = questions_of(record, file, inspected(record, None))
    assert found == (() if expected is None else (expected,))


@pytest.mark.parametrize("seed", range(5))
def test_a_sound_record_raises_no_question(seed: int, tmp_path: Path) -> None:
    draw = np.random.default_rng(seed)
    wave = sum(a * np.sin(w * T + p) for a, w, p in draw.uniform(0.3, 6.0, (4, 3)))
    current = np.gradient(wave, T) + 0.3 * np.sign(np.gradient(wave, T))
    file = written(tmp_path, t_s=T, link_pos_deg=np.rad2deg(wave), iq_A=current)
    made = survey(file)
    assert made.questions == ()
    assert made.problem == ""
    record = read(file, columns=made.map, kind=made.kind)
    for channel in ("link_position", "motor_current"):
        low, high, _ = made.spans[channel]
        assert (low, high) == (record[channel].min(), record[channel].max())
    seen = next(c for c in made.columns if c.name == "link_pos_deg")
    assert seen.high == pytest.approx(np.rad2deg(made.spans["link_position"][1]))
    assert len(seen.spark) == BUCKETS
    assert max(high for _, high in seen.spark) == seen.high


def test_a_name_may_hold_a_number_of_any_length() -> None:
    """Python reads no number of more than 4300 digits."""
    assert numbered(["q1", "q2", "q" + "7" * 5000]) == {1: ("q1",), 2: ("q2",)}
    assert numbered(["q000", "q" + "0" * 5000 + "1"]).keys() == {0, 1}


def test_joints_are_told_by_numbers_that_count_on() -> None:
    names = ["time", *(f"axis{k}_{q}_Nm" for k in range(1, 7) for q in ("drive", "link"))]
    assert list(numbered(names)) == [1, 2, 3, 4, 5, 6]
    assert of_joint(names, 4) == ("time", "axis4_drive_Nm", "axis4_link_Nm")
    assert of_joint(names, -1) == tuple(names)
    found = {g.column.column for g in guess_columns([*names, "t_s"], number=3)}
    assert found == {"time", "axis3_drive_Nm", "axis3_link_Nm"}
    assert numbered(["time_s", "temp_20", "temp_40", "qdd_rad_s2", "qd_rad_s"]) == {}
    assert list(numbered(["q[0]", "q[1]", "t"])) == [0, 1]


def test_the_terminal_writes_a_joint_file_that_reads_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns, _ = CASES["joints side by side"]
    file, out = written(tmp_path, **columns), tmp_path / "joint.toml"
    given = ("--joint-number", "2", "--gear-ratio", "-50", "--motor-constant", "0.1")
    assert main(["import", str(file), *given, "-o", str(out)]) == 0
    text = capsys.readouterr().out
    assert "this is joint 2" in text
    assert "q1_rad" in text
    assert "not used" in text
    made = tomllib.loads(out.read_text(encoding="utf-8"))
    assert made["joint"]["gear_ratio"] == -50
    assert made["columns"]["motor_position"] == {"column": "q2_rad", "unit": "rad"}
    record = read(file, columns=out)
    np.testing.assert_allclose(record["motor_position"], SPEED, rtol=1e-9)


def test_a_file_without_time_is_said_and_not_written(tmp_path: Path) -> None:
    file = written(tmp_path, torque=SWING, accel=SPEED)
    assert "no column is recognised as time" in survey(file).problem
    assert main(["import", str(file), "-o", str(tmp_path / "j.toml")]) == 2
    assert not (tmp_path / "j.toml").exists()
    with pytest.raises(InputError, match="no column 'nothing'"):
        survey(file, columns={"time": {"column": "nothing", "unit": "s"}})


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (("--joint-number", "9"), "no joint 9; its columns are those of 1 to 2"),
        (("--gear-ratio", "0"), "--gear-ratio is 0"),
        (("--gear-ratio", "nan"), "--gear-ratio is nan"),
    ],
)
def test_what_the_terminal_cannot_take_is_one_line(
    given: tuple[str, ...], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = written(tmp_path, **CASES["joints side by side"][0])
    assert main(["import", str(file), *given]) == 2
    err = capsys.readouterr().err
    assert says in err
    assert err.count("\n") == 1
