"""`irj joint new`: a first joint file for somebody else's FMU, its guesses right and shown."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError
from irj_fmu.first_joint import _ratio, first_joint
from irj_fmu.imported.compare import compare
from irj_fmu.imported.file import load_user_joint
from irj_fmu.imported.fit import fit
from tests.irj_fmu.imported.test_user_fmu import START
from tests.user_fmus.make import Make, build
from tests.user_fmus.makes import write_record
from tests.user_fmus.plant import foreign, recorded
from tests.user_fmus.records import TRUTH, axis
from workbench.cli.main import main


def test_a_file_from_the_command_line_fits_as_it_stands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = build("Axis", tmp_path, Make(2, ("CoSimulation",)))
    record = axis(seconds=4.0, h=4e-3)
    header = "time_s,motor_position_rad,motor_torque_N.m"
    rows = np.column_stack([record.time, record["motor_position"], record["motor_torque"]])
    np.savetxt(tmp_path / "run.csv", rows, fmt="%.12g", delimiter=",", header=header, comments="")
    out = tmp_path / "first.toml"
    assert (
        main(["joint", "new", str(fmu), "--record", str(tmp_path / "run.csv"), "-o", str(out)]) == 0
    )
    said = capsys.readouterr().out
    assert "motor_torque = " in said
    assert "no side in the name, motor side assumed" in said
    assert "CHECK: one side is recorded" in said
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for path in (fmu, out):  # the file names an FMU beside it without its path
        path.rename(moved / path.name)
    model = load_user_joint(moved / out.name)
    assert {m.variable: m.channel for m in model.starts} == START
    assert model.joint.effects == ("coulomb", "gravity", "viscous")
    found = fit(model, record)
    for name, value in TRUTH.items():
        assert found.values[name] == pytest.approx(value, rel=5e-3), name


def test_a_joint_file_of_an_fmu_gives_gear_ratio_and_motor_constant(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = build("Axis", tmp_path, Make(2, ("CoSimulation",)))
    write_record(axis(seconds=1.0), tmp_path / "run.npz")
    known = Joint(name="geared", gear_ratio=-50.0, torque_per_current=-4.0)
    like = tmp_path / "like.toml"
    like.write_text(first_joint(fmu, axis(seconds=1.0), known))
    words = ["joint", "new", str(fmu), "--record", str(tmp_path / "run.npz"), "--like", str(like)]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "gear_ratio = -50.0  # as given\ntorque_per_current = -4.0\n" in said


def test_both_sides_are_mapped_and_the_gear_ratio_is_read_off(tmp_path: Path) -> None:
    fmu = build("Elastic", tmp_path, Make(2, ("CoSimulation",), strict=True))
    record = recorded(None, 2.0, 1)
    (tmp_path / "first.toml").write_text(first_joint(fmu, record))
    model, wanted = load_user_joint(tmp_path / "first.toml"), foreign(fmu)
    assert model.joint.gear_ratio == wanted.joint.gear_ratio
    for kind in ("inputs", "outputs", "starts"):
        found = {(m.channel, m.variable, m.scale) for m in getattr(model, kind)}
        assert found == {(m.channel, m.variable, m.scale) for m in getattr(wanted, kind)}, kind
    assert set(model.values) == set(wanted.values)


def test_the_torsion_of_a_soft_gear_is_taken_off_the_gear_ratio() -> None:
    """It moves the slope of the positions by half a percent, from -160 to a ratio of no teeth."""
    time = np.arange(2000) / 500
    link = 0.6 * np.sin(2 * time) + 0.2 * np.sin(5 * time)
    torque = 300.0 * np.sin(link) - 8.0 * (np.gradient(np.gradient(link, time), time))
    record = Record.from_channels(
        time,
        {
            "link_position": link,
            "link_torque": torque,
            "motor_position": -160.0 * (link - torque / 6e4),
        },
        name="soft",
    )
    rough = float(np.polyfit(link, record["motor_position"], 1)[0])
    assert abs(rough + 160.0) > 0.5
    ratio, why = _ratio(record, None)
    assert ratio == -160.0 and "torsion taken off" in why


def test_degrees_and_a_current(tmp_path: Path) -> None:
    """An FMU whose angle is declared in degrees, driven by a torque; the record has a current."""
    units = (("angle", "deg"), ("torque", "N.m"))
    fmu = build("Axis", tmp_path, Make(2, ("CoSimulation",), units=units))
    plain, ratio, constant = axis(seconds=2.0), -50.0, 0.08
    record = Record.from_channels(
        plain.time,
        {
            "motor_position": plain["motor_position"],
            "motor_current": plain["motor_torque"] / constant,
        },
        name="motor",
    )
    joint = Joint(name="geared", gear_ratio=ratio, torque_per_current=constant * ratio)
    (tmp_path / "first.toml").write_text(first_joint(fmu, record, joint))
    model = load_user_joint(tmp_path / "first.toml")
    (drive,), (angle,) = model.inputs, model.outputs
    assert (drive.channel, angle.channel) == ("motor_current", "motor_position")
    assert drive.scale == pytest.approx(constant)
    assert angle.scale == pytest.approx(180 / math.pi)
    assert {m.variable for m in model.starts} == {"q", "w"}
    assert compare(model, record).outputs["motor_position"].variable == "angle"


def test_an_fmu_without_a_recorded_output_is_refused(tmp_path: Path) -> None:
    fmu = build("Dahlquist", tmp_path, Make(2))
    with pytest.raises(InputError, match="no output goes with a channel of axis"):
        first_joint(fmu, axis(seconds=1.0))


def test_how_far_it_is_is_told_for_each_variable_that_is_moved(tmp_path: Path) -> None:
    fmu = build("Axis", tmp_path, Make(2, ("CoSimulation",)))
    told: list[tuple[str, float]] = []
    text = first_joint(
        fmu, axis(seconds=1.0), progress=lambda text, share: told.append((text, share))
    )
    assert text == first_joint(fmu, axis(seconds=1.0))
    assert told[-1] == ("done", 1.0)
    assert len(told) > 3
    assert all(line.startswith("what ") for line, _ in told[:-1])
    assert [share for _, share in told] == sorted(share for _, share in told)
