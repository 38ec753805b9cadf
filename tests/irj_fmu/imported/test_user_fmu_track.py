"""`track` with a user's FMU as the model: its outputs followed, its parameters fixed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from identification.data.record import Record
from identification.faults.bank_statistics import over_windows
from identification.faults.types import Verdict
from irj_fmu.imported.file import load_user_joint, user_joint_text
from irj_fmu.imported.verbs.track import Watch, track
from tests.irj_fmu.imported.test_user_fmu import FILE
from tests.irj_fmu.imported.test_user_fmu_hostile import refused
from tests.user_fmus.make import Make, build
from tests.user_fmus.makes import CS, write_record
from tests.user_fmus.plant import OWN, foreign, recorded
from tests.user_fmus.records import TRUTH, axis
from workbench.cli.main import main

BEGIN = 3.0
"""Stamp at which a sensor goes wrong [s]."""


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Co-simulation only, parameters fixed, no FMU state."""
    return build("Elastic", tmp_path_factory.mktemp("t"), Make(2, CS, strict=True))


@pytest.fixture(scope="module")
def watch(path: Path) -> Watch:
    """With limits from a healthy record."""
    return Watch(foreign(path).with_values(OWN), recorded(None, 8.0, 3))


def off(record: Record, channel: str, size: float, begin: float = BEGIN) -> Record:
    """A record one channel of which is off from a time on."""
    return record.with_channel(channel, record[channel] + size * (record.time >= begin))


@pytest.mark.parametrize("seed", [11, 12])
def test_a_healthy_record_is_silent(watch: Watch, seed: int) -> None:
    found = watch.run(recorded(None, 6.0, seed))
    assert found.alarms == ()
    assert found.calibrated and found.scores.max() < 1
    assert found.ratios == pytest.approx(dict.fromkeys(found.channels, 1.0), abs=0.05)


def test_a_window_that_begins_at_a_turn_is_no_fault(watch: Watch) -> None:
    """The slope of the noisy positions has the wrong sign there, dry friction holds the motor, and
    no step led away: a healthy record stood at 46 times its noise.
    """
    found = watch.run(recorded(None, 8.0, 4).window(0, 2))
    assert found.alarms == ()
    assert found.ratios == pytest.approx(dict.fromkeys(found.channels, 1.0), abs=0.1)


@pytest.mark.parametrize(
    ("channel", "size"),
    [("motor_position", 2e-3), ("link_position", 2e-5), ("link_torque", 0.5)],
)
def test_a_sensor_that_goes_wrong_is_named(watch: Watch, channel: str, size: float) -> None:
    """Twenty deviations of the motor's encoder, ten of the others, beside a spring of 2e4 N.m/rad:
    0.4 N.m.
    """
    found = watch.run(off(recorded(None, 6.0, 11), channel, size))
    (alarm,) = found.alarms
    assert (alarm.verdict, alarm.sensors) == (Verdict.SENSOR, (channel,))
    assert alarm.first == pytest.approx(BEGIN, abs=0.5)  # within the window that it begins in
    assert alarm.first <= alarm.decided <= alarm.first + 1.01
    assert alarm.last == pytest.approx(6.0, abs=0.01)
    assert alarm.text == f"{channel.replace('_', ' ')}: sensor failed"


def test_an_input_that_goes_wrong_is_not_a_sensor_of_the_outputs(watch: Watch) -> None:
    found = watch.run(off(recorded(None, 6.0, 11), "motor_torque", 0.02))
    (alarm,) = found.alarms
    assert (alarm.verdict, alarm.sensors) == (Verdict.PLANT, ("motor_torque",))
    assert "the joint changed" in alarm.text


def test_it_agrees_again_when_the_sensor_does(watch: Watch) -> None:
    record = recorded(None, 8.0, 11)
    back = off(off(record, "link_position", 2e-4), "link_position", -2e-4, 4.0)
    (alarm,) = watch.run(back).alarms
    assert alarm.sensors == ("link_position",)
    assert 4.0 <= alarm.last <= 4.0 + 1.5 + 0.5  # the longest mean, and a window


def test_one_output_alone_cannot_name_itself(tmp_path: Path) -> None:
    build("Axis", tmp_path, Make(2, CS)).replace(tmp_path / "axis.fmu")
    (tmp_path / "user.toml").write_text(FILE.format(fmu="axis.fmu"))
    model = load_user_joint(tmp_path / "user.toml").with_values(TRUTH)
    healthy = axis(seconds=8.0)
    (found,) = track(model, off(axis(seconds=6.0, seed=5), "motor_position", 1e-3), healthy)
    (alarm,) = found.alarms
    assert (alarm.verdict, alarm.sensors) == (Verdict.ONE_OF, ("motor_position", "motor_torque"))
    # the next window starts where the encoder then is, and gravity is nearly the same there
    assert BEGIN - 0.5 <= alarm.first <= BEGIN + 0.01
    (found,) = track(model, axis(seconds=6.0, seed=6), healthy)
    assert found.alarms == ()


def test_energies_and_means_over_windows_are_those_of_their_definition() -> None:
    rng = np.random.default_rng(1)
    e, dt = rng.standard_normal((400, 2)), 0.01
    found = over_windows(e, dt)
    assert found.shape == (400, 16)
    for k, length in enumerate((1, 3, 20, 150)):
        part = e[300 - length + 1 : 301]
        assert found[300, 2 * k : 2 * k + 2] == pytest.approx(np.sqrt(np.mean(part**2, axis=0)))
        assert found[300, 8 + 2 * k : 10 + 2 * k] == pytest.approx(np.abs(part.mean(axis=0)))


# --- from the command line ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def place(path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tracked")
    model = foreign(path).with_values(OWN)
    (folder / "fitted.toml").write_text(user_joint_text(model))
    record = recorded(None, 4.0, 11)
    write_record(recorded(None, 5.0, 3), folder / "healthy.npz")
    write_record(record, folder / "run.npz")
    write_record(off(record, "link_torque", 2.0, 2.0), folder / "wrong.npz")
    return folder


def test_the_command_line_says_what_is_wrong(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    healthy, run, wrong, joint, data = (
        str(place / n) for n in ("healthy.npz", "run.npz", "wrong.npz", "fitted.toml", "track.json")
    )
    given = ["--joint", joint, "--healthy", healthy, "--fail-on-fault"]
    assert main(["track", run, *given]) == 0
    assert "nothing is wrong" in capsys.readouterr().out
    assert main(["track", run, wrong, *given, "--json", data]) == 1
    assert "link torque: sensor failed" in capsys.readouterr().out
    fine, off_ = json.loads(Path(data).read_text())["records"]
    assert fine["events"] == [] and fine["calibrated"]
    (event,) = off_["events"]
    assert event["sensors"] == ["link_torque"]
    assert event["first"] == pytest.approx(2.0, abs=0.5)
    assert len(off_["residuals"]["link_torque"]) == len(off_["time"]) == len(off_["score"])
    assert main(["track", run, "--joint", joint]) == 0
    assert "limits are guesses" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--inject", "link_position:stuck:2"), "--inject"),
        (("--report", "t.html"), "--report"),
        (("--follow",), "--follow"),
    ],
)
def test_what_goes_with_a_joint_model_only_is_refused(
    place: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], said: str
) -> None:
    line = refused(
        place,
        capsys,
        "track",
        str(place / "run.npz"),
        "--joint",
        str(place / "fitted.toml"),
        *words,
    )
    assert said in line and "leave it out" in line
    assert not Path("t.html").exists()


def test_records_that_do_not_go_together_are_refused(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = recorded(None, 3.0, 2, 2e-3)
    write_record(record, place / "slow.npz")
    write_record(record.without("link_torque"), place / "lame.npz")
    given = ["--joint", str(place / "fitted.toml"), "--healthy", str(place / "healthy.npz")]
    line = refused(place, capsys, "track", str(place / "slow.npz"), *given)
    assert "sampled every 0.002 s" in line and "resample" in line
    line = refused(place, capsys, "track", str(place / "lame.npz"), *given)
    assert "has no link_torque" in line
