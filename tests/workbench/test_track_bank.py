"""`irj track` with healthy records: the fault bank looks at the sensors that there are."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.faults.plant import plant
from identification.data.joint_file import load_joint
from identification.data.read import read
from identification.faults.bank_levels import Piece
from identification.faults.core import SENSORS
from identification.faults.types import Verdict
from irj_fmu.estimator.bank import bank_for
from workbench.cli.main import main
from workbench.cli.online import _bank_event


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated joint: records without velocities, and its exact joint file."""
    from benchmarks.online_filter import recorded

    here = tmp_path_factory.mktemp("bank")
    ratio, constant = -160.0, 0.05
    for name, seed in (("healthy", 51), ("unseen", 52)):
        found = recorded(seed, 16.0).every(2)
        np.savez(
            here / f"{name}.npz",
            time_s=found.time,
            motor_current_A=found.rows[:, 0] / (ratio * constant),
            motor_position_rad=found.rows[:, 1] * ratio,
            link_position_rad=found.rows[:, 3],
            link_torque_Nm=found.rows[:, 5],
        )
    true = dict(zip(plant().parameter_names, plant().value_vector(), strict=True))
    effects = [t for t in plant().effects if t not in ("transmission_compliance",)]
    lines = [
        "[joint]",
        'name = "bank"',
        f"gear_ratio = {ratio}",
        f"motor_constant = {constant}",
        'model = "hd3"',
        f"effects = {json.dumps(effects)}",
        "[fitted]",
        *(f"{n} = {{value = {v!r}}}" for n, v in true.items()),
    ]
    (here / "joint.toml").write_text("\n".join(lines) + "\n")
    return here


@pytest.mark.parametrize(
    ("fault", "said"),
    [("link_position:bias:10:0.01", 4), (None, None)],
)
def test_the_sensor_is_named(
    folder: Path, fault: str | None, said: int | None, capsys: pytest.CaptureFixture[str]
) -> None:
    out = folder / "out.json"
    tried = ["--inject", fault] if fault else []
    given = ["track", str(folder / "unseen.npz"), "--joint", str(folder / "joint.toml")]
    assert main([*given, "--healthy", str(folder / "healthy.npz"), *tried, "--json", str(out)]) == 0
    result = json.loads(out.read_text())["records"][0]
    assert [e["fault"] for e in result["events"]] == ([] if said is None else [said])
    assert result["detector"]
    assert result["calibrated"]
    # announced for what is measured, and for nothing else
    assert list(result["smallest"]) == ["current", "motor_position", "link_position", "torque"]
    assert all(s["seen"] > 0 for s in result["smallest"].values())
    assert "smallest offset of a sensor" in capsys.readouterr().out


def test_lost_samples_are_no_fault_and_a_fault_is_named_among_them(
    folder: Path, tmp_path: Path
) -> None:
    """A fifth of the samples lost from both files: limits are those of readings as they come, and
    a fault begins at its time."""
    rng = np.random.default_rng(17)
    for name in ("healthy", "unseen"):
        with np.load(folder / f"{name}.npz") as whole:
            kept = rng.random(len(whole["time_s"])) > 0.2
            kept[[0, -1]] = True
            np.savez(tmp_path / f"{name}.npz", **{n: whole[n][kept] for n in whole.files})
    out = tmp_path / "out.json"
    given = ["track", str(tmp_path / "unseen.npz"), "--joint", str(folder / "joint.toml")]
    given += ["--healthy", str(tmp_path / "healthy.npz"), "--json", str(out)]
    assert main(given) == 0
    assert json.loads(out.read_text())["records"][0]["events"] == []
    assert main([*given, "--inject", "link_position:bias:10:0.01"]) == 0
    events = json.loads(out.read_text())["records"][0]["events"]
    assert [e["fault"] for e in events] == [4]
    assert 9.99 <= events[0]["first"] < 10.1


def test_pieces_too_short_for_the_estimator_are_judged_all_the_same(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with np.load(folder / "unseen.npz") as whole:
        t = whole["time_s"] - whole["time_s"][0]
        kept = (t < 5.0) | ((t > 6.0) & (t < 11.0))
        np.savez(tmp_path / "pieces.npz", **{n: whole[n][kept] for n in whole.files})
    given = ["track", str(tmp_path / "pieces.npz"), "--joint", str(folder / "joint.toml")]
    given += ["--healthy", str(folder / "healthy.npz")]
    assert main(given) == 0
    said = capsys.readouterr().out
    assert "the parameters were not estimated" in said
    assert "no sensor fault" in said
    assert main([*given, "--inject", "link_position:bias:8:0.01"]) == 0
    assert "link position: sensor failed" in capsys.readouterr().out


def test_a_healthy_record_that_is_too_short_is_named(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with np.load(folder / "healthy.npz") as whole:
        np.savez(tmp_path / "short.npz", **{n: whole[n][:500] for n in whole.files})
    given = ["track", str(folder / "unseen.npz"), "--joint", str(folder / "joint.toml")]
    assert main([*given, "--healthy", str(tmp_path / "short.npz")]) == 2
    assert "short.npz: fault bank: give healthy records longer than 3 s" in capsys.readouterr().err


def test_without_healthy_records_no_derived_velocity_is_judged(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = folder / "plain.json"
    given = ["track", str(folder / "unseen.npz"), "--joint", str(folder / "joint.toml")]
    assert main([*given, "--json", str(out)]) == 0
    result = json.loads(out.read_text())["records"][0]
    assert result["events"] == []
    assert not result["detector"]
    assert "--healthy" in result["not_watched"]
    assert result["not_watched"] in capsys.readouterr().out


@pytest.mark.parametrize("velocities", [True, False])
def test_limits_are_of_the_rate_and_the_readings_of_the_record(
    folder: Path, velocities: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A healthy record that is finer is thinned; a velocity that it lacks is not judged."""
    taken: list[Sequence[Piece]] = []
    kept = "identification.faults.bank_kept.calibrated"
    monkeypatch.setattr(kept, lambda _bank, pieces: taken.append(pieces))
    joint = load_joint(folder / "joint.toml")
    healthy = read(folder / "healthy.npz")
    coarse = healthy.take(slice(None, None, 3))
    coarse = replace(coarse, segment=np.zeros(len(coarse), dtype=np.int64))
    named = ("motor_velocity", "link_velocity") if velocities else ()
    speeds = {n: np.gradient(coarse[n.replace("velocity", "position")], coarse.time) for n in named}
    record = replace(coarse, channels={**coarse.channels, **speeds})
    bank = bank_for(joint, record, [healthy])
    assert bank is not None
    assert [SENSORS[i] for i in bank.sensors] == [
        *("current", "motor_position", "link_position", "torque")
    ]
    steps = np.concatenate([np.diff(p.time) for p in taken[0]])
    assert np.median(steps) == pytest.approx(coarse.dt)


@pytest.mark.parametrize(
    ("tried", "said"),
    [
        ("link_position:odd:9", "unknown kind 'odd'"),
        ("link_velocity:bias:9:0.1", "no reading of its own for link_velocity"),
    ],
)
def test_a_fault_of_nothing_is_refused_before_limits_are_worked_out(
    folder: Path,
    tried: str,
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("irj_fmu.estimator.bank.bank_for", None)  # would be a crash: exit 3
    given = ["track", str(folder / "unseen.npz"), "--joint", str(folder / "joint.toml")]
    assert main([*given, "--healthy", str(folder / "healthy.npz"), "--inject", tried]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("verdict", "about", "said"),
    [
        (Verdict.PLANT, (), "each other"),
        (Verdict.PLANT, ("stiffness",), "its stiffness explains the readings"),
        (
            Verdict.ONE_OF,
            ("torque", "link_position"),
            "torque or link position failed; the readings cannot tell which",
        ),
        (
            Verdict.ONE_OF,
            ("link_position", "stiffness"),
            "link position failed, or the stiffness changed; the readings cannot tell which",
        ),
    ],
)
def test_an_event_says_what_it_may_be(verdict: Verdict, about: tuple[str, ...], said: str) -> None:
    code = 8 if verdict is Verdict.PLANT else 9
    event = {"verdict": verdict, "sensors": list(about), "fault": code, "time": 2.0, "first": 1.0}
    assert _bank_event(event)["text"].endswith(said)
