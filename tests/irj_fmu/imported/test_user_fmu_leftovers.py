"""A user's FMU as the model: joint files that are wrong in small ways, files that must not be
lost, progress.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from irj_fmu.imported.file import load_user_joint
from irj_fmu.imported.fit import fit
from tests.irj_fmu.imported.test_user_fmu import FILE
from tests.user_fmus.make import Make, build
from tests.user_fmus.records import axis
from workbench.cli.main import main


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Joint file, FMU and records in one folder."""
    folder = tmp_path_factory.mktemp("user")
    build("Axis", folder, Make(2, ("CoSimulation",))).replace(folder / "axis.fmu")
    record = axis(seconds=3.0, h=4e-3)
    columns = {"time_s": record.time, "motor_position_rad": record["motor_position"]}
    np.savez(folder / "bare.npz", **columns)
    np.savez(folder / "run.npz", **{**columns, "motor_torque_N.m": record["motor_torque"]})
    (folder / "user.toml").write_text(FILE.format(fmu="axis.fmu"))
    return folder


def line(place: Path, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line of a command that must refuse; no file is changed or left."""
    before = {p: p.read_bytes() for p in place.iterdir() if p.is_file()}
    capsys.readouterr()
    assert main(list(arguments)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("irj: ")
    assert {p: p.read_bytes() for p in place.iterdir() if p.is_file()} == before
    return err


WRONG = {
    "fmu = 3": (
        'fmu = "axis.fmu"',
        "fmu = 3",
        "[model] fmu = 3 is not the name of an FMU; write fmu =",
    ),
    "no name": ('fmu = "axis.fmu"', 'fmu = ""', '[model] fmu = "" is not the name of an FMU'),
    "no such file": ("axis.fmu", "none.fmu", "none.fmu: there is no such FMU; give its path"),
    "a record": (
        "axis.fmu",
        "run.npz",
        "run.npz: not a readable FMU (it holds no modelDescription.xml; give an .fmu file)",
    ),
    "no archive": (
        "axis.fmu",
        "user.toml",
        "user.toml: not a readable FMU (File is not a zip file)",
    ),
    "scale 0": (
        '"torque"',
        '{ variable = "torque", scale = 0 }',
        "[model.channels] motor_torque scale = 0 would leave nothing of it",
    ),
    "scale of a start": (
        'w = "motor_velocity"',
        'w = { channel = "motor_velocity", scale = 0.0 }',
        "[model.start] w scale = 0 would leave nothing",
    ),
    "no number": (
        'w = "motor_velocity"',
        "w = nan",
        "[model.start] w = nan is not a finite number",
    ),
    "far name": (
        '"torque"',
        '"zzz"',
        "axis.fmu: there is no variable 'zzz'; it has q, w, torque, inertia",
    ),
    "near name": ('"torque"', '"torqu"', "there is no variable 'torqu'; did you mean: torque"),
    "no table": (
        '[joint]\nname = "user axis"',
        "joint = 3",
        "joint must be a table, as [joint] on a line of its own",
    ),
    "no pair": ('"torque"', "3", "[model.channels] motor_torque = 3; give the name of a variable"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_joint_file_is_named_once(
    place: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    old, new, expected = WRONG[case]
    path, right = place / "wrong.toml", FILE.format(fmu="axis.fmu")
    assert old in right
    path.write_text(right.replace(old, new))
    said = line(place, capsys, "fit", str(place / "run.npz"), "--joint", str(path))
    path.unlink()
    assert expected in said
    assert said.startswith(f"irj: {path}: ")
    assert said.count(str(path)) == 1


def test_the_fmu_is_never_written_over(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fmu, joint, run = str(place / "axis.fmu"), str(place / "user.toml"), str(place / "run.npz")
    for command in (
        ("add", "stribeck@motor", "--joint", joint, "-o", fmu),
        ("fit", run, "--joint", joint, "-o", fmu),
        ("fit", run, "--joint", joint, "--json", fmu),
        ("export", "pair", "--joint", joint, "--out", str(place / "out"), "--json", fmu),
    ):
        assert "axis.fmu: is an input of this command and would be lost" in line(
            place, capsys, *command
        )
    (place / "axis.fmu").rename(place / "user_axis_pair.fmu")
    (place / "user.toml").write_text(FILE.format(fmu="user_axis_pair.fmu"))
    assert "user_axis_pair.fmu: is an input of this command" in line(
        place, capsys, "export", "pair", "--joint", joint, "--out", str(place)
    )
    assert not (place / "out").exists()
    (place / "user_axis_pair.fmu").rename(place / "axis.fmu")
    (place / "user.toml").write_text(FILE.format(fmu="axis.fmu"))


def test_other_commands_say_what_goes(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    joint, run, bare = str(place / "user.toml"), str(place / "run.npz"), str(place / "bare.npz")
    assert "export plant: the model of" in line(place, capsys, "export", "plant", "--joint", joint)
    assert "unrecognized arguments" not in line(place, capsys, "export", "--joint", joint, "ssp")
    said = line(place, capsys, "fit", bare, "--joint", joint)
    assert (
        f"{bare}: has no motor_torque, which [model.channels] maps to torque (it has "
        "motor_position)" in said
    )
    assert "given as training and as held out record" in line(
        place, capsys, "diagnose", run, "--held-out", run, "--joint", joint
    )


def test_an_input_that_nothing_drives_and_a_value_of_nobody_are_said(place: Path) -> None:
    path = place / "idle.toml"
    path.write_text(
        FILE.format(fmu="axis.fmu").replace('motor_torque = "torque"\n', "")
        + "[fitted]\nmass = 3.0\n"
    )
    notes = " ".join(load_user_joint(path).notes)
    assert "axis.fmu: no channel drives its input torque, which stays at 0" in notes
    assert "[fitted] mass: [model.parameters] has no such name; the value is left out" in notes
    path.write_text(
        FILE.format(fmu="axis.fmu").replace('motor_torque = "torque"\n', "") + "torque = 1.5\n"
    )
    assert load_user_joint(path).notes == ()
    path.unlink()
    assert load_user_joint(place / "user.toml").notes == ()


def test_a_fit_shows_how_far_it_is(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from identification.data.read import read

    told: list[tuple[str, float]] = []
    fit(
        load_user_joint(place / "user.toml"),
        read(place / "run.npz"),
        progress=lambda text, share: told.append((text, share)),
    )
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert any(text.startswith("fitting, step 2") for text, _ in told)
    command = ["fit", str(place / "run.npz"), "--joint", str(place / "user.toml")]
    assert main(command) == 0
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    assert main(command) == 0
    assert "fitting, step 1" in capsys.readouterr().err


def test_check_knows_the_channels_that_the_fmu_wants(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = str(place / "user.toml")
    assert main(["check", str(place / "run.npz"), "--joint", joint]) == 0
    assert "refuse" not in capsys.readouterr().out
    assert main(["check", str(place / "bare.npz"), "--joint", joint]) == 1
    assert (
        "refuse: bare: has no motor_torque, which [model.channels] maps to torque"
        in capsys.readouterr().out
    )
