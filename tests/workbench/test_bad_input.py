"""What a user reads when a file cannot be used: one line that says what, where and what to do;
exit code 2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from workbench.cli.main import main

FloatArray = npt.NDArray[np.float64]
Table = dict[str, FloatArray]
JOINT = """[joint]
name = "axis"
gear_ratio = -160.0
motor_constant = 0.0553
model = "hd3"
effects = ["viscous", "coulomb", "gravity"]
"""
ROWS = 3000


def good() -> Table:
    """7.5 s of the demo's training record, as a table that is right."""
    with (
        (files("workbench") / "demo" / "train.npz").open("rb") as stream,
        np.load(stream) as archive,
    ):
        return {name: archive[name][:ROWS].astype(np.float64) for name in archive.files}


def write_csv(path: Path, table: Mapping[str, FloatArray]) -> Path:
    rows = np.column_stack(list(table.values()))
    body = "\n".join(",".join(f"{v:.9g}" for v in row) for row in rows)
    path.write_text(",".join(table) + "\n" + body + "\n", encoding="utf-8")
    return path


Say = Callable[..., str]


@pytest.fixture
def said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Say:
    """Run a command and return its one line on standard error; the code must be 2 and nothing
    may be printed or left.
    """

    def run(*arguments: str, joint: str = JOINT) -> str:
        (tmp_path / "j.toml").write_text(joint, encoding="utf-8")
        before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}
        capsys.readouterr()
        code = main([a.replace("J.toml", str(tmp_path / "j.toml")) for a in arguments])
        out, err = capsys.readouterr()
        assert code == 2
        assert out == ""
        lines = err.strip().splitlines()
        assert len(lines) == 1, err
        assert lines[0].startswith("irj: ")
        assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")} == before
        return lines[0]

    return run


def improve_message(
    said: Say, tmp_path: Path, table: Mapping[str, FloatArray], joint: str = JOINT
) -> str:
    path = write_csv(tmp_path / "run.csv", table)
    return said("improve", str(path), "--joint", "J.toml", joint=joint)


def renamed(old: str, new: str) -> Table:
    return {new if k == old else k: v for k, v in good().items()}


def without(*names: str) -> Table:
    return {k: v for k, v in good().items() if k not in names}


def changed(name: str, values: FloatArray) -> Table:
    return {**good(), name: values}


# --- units ----------------------------------------------------------------------------------------


def test_degrees_taken_for_radians(said: Say, tmp_path: Path) -> None:
    line = improve_message(
        said, tmp_path, changed("link_position_rad", np.rad2deg(good()["link_position_rad"]))
    )
    assert "run.csv" in line
    assert "link_position changes 57.3 times as fast as link_velocity says" in line
    assert "degrees were taken for radians" in line
    assert "[columns]" in line


def test_degrees_in_the_header_of_radians(said: Say, tmp_path: Path) -> None:
    line = improve_message(said, tmp_path, renamed("motor_position_rad", "motor_position_deg"))
    assert "motor_position changes 0.01745 times as fast as motor_velocity says" in line


def test_rpm_taken_for_radians_per_second(said: Say, tmp_path: Path) -> None:
    line = improve_message(
        said, tmp_path, changed("motor_velocity_rad_s", good()["motor_velocity_rad_s"] * 30 / np.pi)
    )
    assert "the velocity is in rpm and was taken for rad/s" in line


def test_milliseconds_taken_for_seconds(said: Say, tmp_path: Path) -> None:
    line = improve_message(said, tmp_path, changed("time_s", good()["time_s"] * 1000))
    assert "the sampling step is 2.5 s: is time in ms? correct the unit of time" in line


def test_unit_of_another_dimension(said: Say, tmp_path: Path) -> None:
    line = improve_message(said, tmp_path, renamed("link_position_rad", "link_position_Nm"))
    assert "'Nm' is not a unit of link_position (rad)" in line


# --- channels -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gone", "expected"),
    [
        (("time_s",), "no column is recognised as time"),
        (
            ("motor_current_A", "link_torque_Nm", "link_position_rad", "link_velocity_rad_s"),
            "channel motor_current is missing: measure it or name its column in [columns]",
        ),
        (("motor_position_rad", "motor_velocity_rad_s"), "motor_position is missing"),
        (("link_position_rad", "link_velocity_rad_s"), "link_position is missing"),
    ],
)
def test_missing_channel(said: Say, tmp_path: Path, gone: tuple[str, ...], expected: str) -> None:
    assert expected in improve_message(said, tmp_path, without(*gone))


def test_elastic_model_on_one_sided_data(said: Say, tmp_path: Path) -> None:
    table = {k: good()[k] for k in ("time_s", "motor_current_A", "motor_position_rad")}
    line = improve_message(said, tmp_path, table)
    assert "elastic" in line
    assert "link_position" in line
    assert "hd1" in line


@pytest.mark.parametrize(
    "name", ["motor_current_A", "motor_position_rad", "link_position_rad", "link_torque_Nm"]
)
def test_constant_channel(said: Say, tmp_path: Path, name: str) -> None:
    line = improve_message(said, tmp_path, changed(name, np.full(ROWS, 1.5)))
    assert (
        f"{name.rpartition('_')[0]} is constant (1.5 in every row): check its sensor or column"
        in line
    )


def test_channel_of_nan_only(said: Say, tmp_path: Path) -> None:
    line = improve_message(said, tmp_path, changed("motor_position_rad", np.full(ROWS, np.nan)))
    assert "motor_position is not a number in 3000 rows, the first row 1" in line


# --- what is repaired says so ---------------------------------------------------------------------


def warned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], table: Table, verb: str = "fit"
) -> str:
    (tmp_path / "j.toml").write_text(JOINT)
    path = write_csv(tmp_path / "run.csv", table)
    assert main([verb, str(path), "--joint", str(tmp_path / "j.toml")]) == 0
    return capsys.readouterr().err


def test_nan_rows_are_dropped_and_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = good()["motor_position_rad"].copy()
    values[100:105] = np.nan
    err = warned(tmp_path, capsys, changed("motor_position_rad", values))
    assert (
        "run.csv: motor_position is not a number in 5 rows, the first row 101 (t = 0.25 s): the "
        "rows are dropped, the record is split there" in err
    )


def test_gap_splits_the_record_and_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    err = warned(tmp_path, capsys, {k: np.delete(v, slice(1000, 1400)) for k, v in good().items()})
    assert (
        "1 gap(s), the first before row 1001 (t = 3.5 s), about 400 samples missing in all: the "
        "record is split there" in err
    )


def test_repeated_stamp_gets_its_slot_and_that_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stamps = good()["time_s"].copy()
    stamps[500] = stamps[499]
    err = warned(tmp_path, capsys, changed("time_s", stamps))
    assert (
        "1 repeated stamp(s), first at row 501 (t = 1.2475 s): frames written twice are dropped, "
        "others get the time of their slot" in err
    )


def one_way() -> Table:
    rng = np.random.default_rng(0)
    table = good()
    time = table["time_s"]
    link = 0.01 * time**2
    table["link_position_rad"] = link + 1e-6 * rng.standard_normal(ROWS)
    table["motor_position_rad"] = -160 * (link + 1e-7 * rng.standard_normal(ROWS))
    table["link_velocity_rad_s"] = 0.02 * time + 1e-4 * rng.standard_normal(ROWS)
    table["motor_velocity_rad_s"] = -160 * 0.02 * time + 1e-2 * rng.standard_normal(ROWS)
    return table


def test_motor_that_never_reverses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "j.toml").write_text(JOINT)
    path = write_csv(tmp_path / "run.csv", one_way())
    assert main(["check", str(path), "--joint", str(tmp_path / "j.toml")]) in (0, 1)
    assert (
        "the motor never reverses: friction cannot be told from gravity and offset; record a "
        "motion in both directions" in capsys.readouterr().out
    )


# --- time -----------------------------------------------------------------------------------------


def test_time_that_runs_backwards(said: Say, tmp_path: Path) -> None:
    stamps = good()["time_s"].copy()
    stamps[500:] -= 2.0
    line = improve_message(said, tmp_path, changed("time_s", stamps))
    assert "time runs backwards at row 501" in line
    assert "run column" in line


@pytest.mark.parametrize(
    ("rows", "expected"),
    [(0, "no row of numbers"), (1, "one sample only"), (2, "2 samples, at least 10")],
)
def test_too_few_samples(said: Say, tmp_path: Path, rows: int, expected: str) -> None:
    assert expected in improve_message(said, tmp_path, {k: v[:rows] for k, v in good().items()})


# --- gear -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", ["160.0", "-100.0", "-16.0"])
def test_wrong_gear_ratio_says_what_the_data_show(said: Say, tmp_path: Path, given: str) -> None:
    line = improve_message(said, tmp_path, good(), JOINT.replace("-160.0", given))
    shown = float(line.partition("gear ratio of ")[2].partition(",")[0])
    assert shown == pytest.approx(-160.0, rel=0.01)
    assert f"{float(given):g} is given" in line
    assert ("the sign is reversed" in line) == (given == "160.0")


# --- files ----------------------------------------------------------------------------------------


def test_empty_file(said: Say, tmp_path: Path) -> None:
    path = tmp_path / "empty.csv"
    path.write_bytes(b"")
    assert "empty.csv: is empty (0 bytes)" in said("improve", str(path), "--joint", "J.toml")


def test_damaged_archive(said: Say, tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    path.write_bytes((files("workbench") / "demo" / "train.npz").read_bytes()[:5000])
    assert "run.npz: is not a readable NPZ archive" in said(
        "improve", str(path), "--joint", "J.toml"
    )


def test_noise_in_place_of_text(said: Say, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(np.random.default_rng(0).bytes(3000))
    assert "is not a text file nor a known binary format" in said(
        "check", str(path), "--joint", "J.toml"
    )


def test_missing_file_and_folder(said: Say, tmp_path: Path) -> None:
    assert "there is no such file" in said("check", str(tmp_path / "nothing.csv"))
    assert "is a folder" in said("check", str(tmp_path))


def test_path_with_spaces_and_umlauts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "Größe mit Leerzeichen"
    folder.mkdir()
    (folder / "Gelenk Ä.toml").write_text(JOINT, encoding="utf-8")
    path = write_csv(folder / "Lauf ü 1.csv", good())
    target = folder / "Erg ß.json"
    assert (
        main(["fit", str(path), "--joint", str(folder / "Gelenk Ä.toml"), "--json", str(target)])
        == 0
    )
    assert target.stat().st_size > 0
    capsys.readouterr()
    assert main(["fit", str(folder / "fehlt ö.csv"), "--joint", str(folder / "Gelenk Ä.toml")]) == 2
    assert "fehlt ö.csv: there is no such file" in capsys.readouterr().err


# --- outputs --------------------------------------------------------------------------------------


def test_output_in_a_folder_that_is_not_there(said: Say, tmp_path: Path) -> None:
    path = write_csv(tmp_path / "run.csv", good())
    for option in ("--json", "--report", "-o"):
        line = said("improve", str(path), "--joint", "J.toml", option, str(tmp_path / "none" / "x"))
        assert f"{tmp_path / 'none'}: no such folder" in line


@pytest.mark.parametrize("letters", [83, 84])
def test_output_with_a_name_as_long_as_a_file_system_takes(
    letters: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """254 bytes; what it is written to first has a longer name only where that is cut. 257 bytes
    are refused before the work.
    """
    path, out = write_csv(tmp_path / "run.csv", good()), tmp_path / f"{letters * '关'}.json"
    before = sorted(tmp_path.iterdir())
    assert main(["check", str(path), "--json", str(out)]) == (0 if letters == 83 else 2)
    said = capsys.readouterr()
    if letters == 83:
        assert out.stat().st_size > 0
    else:
        assert "File name too long" in said.err
        assert said.out == ""
    assert sorted({*tmp_path.iterdir()} - {out}) == before


def test_output_that_is_a_folder(said: Say, tmp_path: Path) -> None:
    path = write_csv(tmp_path / "run.csv", good())
    assert "is a folder; give the name of a file" in said(
        "fit", str(path), "--joint", "J.toml", "--json", str(tmp_path)
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_full_disk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_csv(tmp_path / "run.csv", good())
    assert main(["check", str(path), "--json", "/dev/full"]) == 2
    assert "/dev/full: cannot be written (No space left on device)" in capsys.readouterr().err


def test_record_is_never_overwritten(said: Say, tmp_path: Path) -> None:
    path = write_csv(tmp_path / "run.csv", good())
    assert "would be lost" in said("fit", str(path), "--joint", "J.toml", "-o", str(path))
    assert "would be lost" in said("fit", str(path), "--joint", "J.toml", "--json", "J.toml")
    assert "given for two results" in said(
        "fit",
        str(path),
        "--joint",
        "J.toml",
        "--json",
        str(tmp_path / "x"),
        "-o",
        str(tmp_path / "x"),
    )


# --- joint file -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "gear_ratio",
            "gear_ration",
            "[joint] has an unknown key 'gear_ration'; known: effects, gear_ratio",
        ),
        ('"hd3"', '"hd5"', "model = 'hd5' is not known; use one of hd1, hd2, hd3, hd4"),
        ("[joint]", "[joints]", "unknown table [joints]"),
        ('model = "hd3"', "model = hd3", "not valid TOML"),
        ('"coulomb"', '"coulom"', "unknown effect 'coulom'"),
        ('"gravity"', '"gravity@moon"', "effect 'gravity' acts on link, not on 'moon'"),
        ("-160.0", '"-160"', "gear_ratio = '-160' is not a finite number"),
        ("-160.0", "0", "gear_ratio is 0; give theta_motor / theta_link with its sign"),
        ("0.0553", "nan", "motor_constant = nan is not a finite number"),
        ("0.0553", "0", "motor_constant is 0; give the torque per ampere"),
        ("motor_constant = 0.0553", "", "motor_current needs motor_constant"),
        (
            "motor_constant",
            "torque_per_current = 2.0\nmotor_constant",
            "both given; keep one of them",
        ),
        ('["viscous", "coulomb", "gravity"]', '"viscous"', "effects must be a list of names"),
        ("name", "virtual_work = 3\nname", "virtual_work = 3; use true or false"),
    ],
)
def test_typo_in_the_joint_table(
    said: Say, tmp_path: Path, old: str, new: str, expected: str
) -> None:
    line = improve_message(said, tmp_path, good(), JOINT.replace(old, new, 1))
    assert expected in line
    assert "j.toml" in line


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (
            "[known]\nstifness = 3.0",
            "[known] stifness: the model has no such parameter; it has "
            "gravity_cosine, gravity_torque",
        ),
        (
            '[known]\nstiffness = { value = 3.0, unit = "kg" }',
            "[known] stiffness has unit 'kg'; it must be one like N.m/rad",
        ),
        (
            '[known]\nstiffness = { value = "x" }',
            "[known] stiffness: value = 'x' is not a finite number",
        ),
        ("[known]\nstiffness = { valu = 3 }", "[known] stiffness has an unknown key 'valu'"),
        ("[known]\nstiffness = { low = 5, high = 1 }", "[known] stiffness has low above high"),
        (
            "[known]\nstiffness = { value = 1e4, low = 2e4, high = 3e4 }",
            "[known] stiffness has a value outside its own low and high",
        ),
        (
            "[fitted]\nmotor_inertia = { value = -3.0 }",
            "[fitted] motor_inertia = -3 lies outside its physical bounds",
        ),
        ("[known]\nstiffness = -3.0", "[known] stiffness = -3 lies outside its physical bounds"),
        (
            '[known]\nstiffness = { value = 3.0, side = "moon" }',
            "[known] stiffness: side = 'moon' is not known; use one of motor, link",
        ),
        (
            "[knwon]\nstiffness = 3",
            "unknown table [knwon]; a joint file has [joint], [known], [columns]",
        ),
        ("[fitted]\nstiffness = 3", "[fitted] stiffness must be a table with value"),
        ('[columns]\nmotor_curent = "x"', "channel 'motor_curent' is not known"),
        ('[columns]\nmotor_current = { column = "nope" }', "no column 'nope' in the file"),
        (
            '[columns]\nmotor_current = { column = "motor_current_A", unit = "V" }',
            "unit 'V' does not fit, a unit of the kind A is wanted",
        ),
    ],
)
def test_typo_in_another_table(said: Say, tmp_path: Path, more: str, expected: str) -> None:
    assert expected in improve_message(said, tmp_path, good(), f"{JOINT}{more}\n")


# --- other verbs ----------------------------------------------------------------------------------


def test_unknown_effect(said: Say, tmp_path: Path) -> None:
    assert "unknown effect 'strbeck'" in said(
        "add", "strbeck", "--joint", "J.toml", "-o", str(tmp_path / "x.toml")
    )
    assert "no effect 'strbeck' in the library; `irj effects` lists it" in said(
        "effects", "strbeck"
    )
    assert "--hide strbeck: unknown effect" in said(
        "simulate", "--joint", "J.toml", "--hide", "strbeck", "-o", str(tmp_path / "x.csv")
    )


def test_effects_file_that_cannot_be_used(said: Say, tmp_path: Path) -> None:
    assert "no such file; --effects takes a Python file" in said(
        "--effects", str(tmp_path / "no.py"), "effects"
    )
    broken = tmp_path / "broken.py"
    broken.write_text("from casadi_models import effct\n")
    line = said("effects", "--effects", str(broken))
    assert "broken.py: cannot be used as effects (ImportError" in line


def test_plan_needs_an_elastic_joint(said: Say, tmp_path: Path) -> None:
    assert "plan simulates an elastic joint" in said(
        "plan",
        "--joint",
        "J.toml",
        "-o",
        str(tmp_path / "t.csv"),
        joint=JOINT.replace("hd3", "hd1"),
    )


def test_simulate_refuses_senseless_numbers(said: Say, tmp_path: Path) -> None:
    target = str(tmp_path / "x.csv")
    assert "--rate takes 1 to 100000" in said(
        "simulate", "--joint", "J.toml", "--rate", "0", "-o", target
    )
    assert "give NAME=VALUE with a number" in said(
        "simulate", "--joint", "J.toml", "--set", "stiffness", "-o", target
    )
    assert "no parameter 'stifness' in the model" in said(
        "simulate", "--joint", "J.toml", "--set", "stifness=3", "-o", target
    )


def test_wrong_arguments_are_one_line_too(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, expected in (
        (["fit"], "the following arguments are required: REC, --joint"),
        (["fitt"], "invalid choice: 'fitt'"),
        (["check", "x.csv", "--jsn", "y"], "unrecognized arguments: --jsn"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(arguments)
        assert stopped.value.code == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1
        assert expected in lines[0]
