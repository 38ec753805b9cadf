"""Studies: what a study file means, what comes out, what happens when a run, a process or a
user ends it.
"""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from casadi_models.simulate import simulate
from identification.data.joint_file import toml_text
from irj_fmu.batch.run import load_study, main, run_study
from irj_fmu.batch.sampling import cases_of
from irj_fmu.batch.store import lock
from irj_fmu.host.run import Fmu, Instance, Wiring, simulate_cs
from irj_fmu.host.signals import Table
from irj_fmu.plant.fmi3 import build_plant_fmi3
from irj_fmu.plant.joint import PlantOptions, plant_spec
from irj_fmu.plant.library import build_plant
from irj_fmu.plant.reference import reference_joint

FloatArray = npt.NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[2]
STUDY = """
[study]
stop = {stop}
step = 0.01
record = ["link_position", "link_torque"]
{more}
[[model]]
fmu = "plant.fmu"
[inputs]
i_m = {{ time = [0.0, 0.1], value = [4.0, -2.0] }}
[grid]
stiffness = {{ low = 1e4, high = 4e4, count = {count} }}
"""


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_plant(
        plant_spec(reference_joint("irj_ts"), PlantOptions(name="plant")),
        tmp_path_factory.mktemp("plant") / "plant.fmu",
    )


@pytest.fixture
def folder(plant: Path, tmp_path: Path) -> Path:
    """A folder with the plant, whose path holds a space, an umlaut and '#'."""
    made = tmp_path / "a b ü #1"
    made.mkdir()
    (made / "plant.fmu").write_bytes(plant.read_bytes())
    return made


def write(
    folder: Path, text: str = STUDY, *, stop: float = 0.2, count: int = 5, more: str = ""
) -> Path:
    path = folder / "study.toml"
    path.write_text(text.format(stop=stop, count=count, more=more), encoding="utf-8")
    return path


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "summary.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def alone(plant: Path, values: dict[str, float], steps: int) -> FloatArray:
    """One run by the plain host."""
    wiring = Wiring(
        inputs={"p.i_m": Table(np.array([0.0, 0.1]), np.array([4.0, -2.0]))},
        parameters={f"p.{k}": v for k, v in values.items()},
        record=("p.link_position", "p.link_torque"),
    )
    with Fmu(plant) as fmu, Instance(fmu, name="p") as instance:
        found = simulate_cs(instance, wiring, step=0.01, stop=0.01 * steps)
    return np.column_stack([found["p.link_position"], found["p.link_torque"]])


# --- what comes out -------------------------------------------------------------------------------


def test_each_run_is_that_of_the_plain_host(folder: Path, plant: Path) -> None:
    """Grid of two parameters; series thinned, figures over all samples, rows in the order of
    the file.
    """
    path = write(folder, STUDY + "link_inertia = [5, 10.0]\n", count=3, more="every = 4")
    found = run_study(path, jobs=2)
    held = np.load(folder / "study-results" / "results.npz")
    expected = [(k, j) for k in (1e4, 2.5e4, 4e4) for j in (5, 10.0)]
    assert [
        (float(r["stiffness"]), float(r["link_inertia"])) for r in rows(folder / "study-results")
    ] == expected
    for i, (stiffness, inertia) in enumerate(expected):
        table = alone(plant, {"stiffness": stiffness, "link_inertia": inertia}, 20)
        np.testing.assert_array_equal(held["link_position"][i], table[::4, 0])
        np.testing.assert_array_equal(held["link_torque"][i], table[::4, 1])
        figures = found.runs[i].figures
        assert figures["link_torque.maximum"] == table[:, 1].max()
        assert figures["link_torque.rms"] == pytest.approx(
            np.sqrt(np.mean(table[:, 1] ** 2)), rel=1e-14
        )
        assert figures["link_position.last"] == table[-1, 0]
    np.testing.assert_allclose(held["time"], 0.04 * np.arange(6), rtol=1e-15)
    np.testing.assert_array_equal(held["parameter.stiffness"], [k for k, _ in expected])


def test_every_executor_gives_the_same_bytes(folder: Path) -> None:
    path = write(folder, count=7, more="chunk = 2")
    run_study(path, out=folder / "processes", jobs=2)
    with ThreadPoolExecutor(2) as executor:
        run_study(path, out=folder / "threads", executor=executor)
    for name in ("summary.csv", "results.npz"):
        assert (folder / "processes" / name).read_bytes() == (
            folder / "threads" / name
        ).read_bytes()


def test_text_holds_what_the_arrays_hold(folder: Path) -> None:
    run_study(write(folder, count=3), out=folder / "a")
    run_study(write(folder, count=3, more='format = "csv"'), out=folder / "b")
    held = np.load(folder / "a" / "results.npz")
    table = np.loadtxt(folder / "b" / "results.csv", delimiter=",", skiprows=1).reshape(3, 21, 4)
    np.testing.assert_array_equal(table[:, :, 0], np.repeat([[1], [2], [3]], 21, axis=1))
    np.testing.assert_array_equal(table[:, :, 1], np.tile(held["time"], (3, 1)))
    np.testing.assert_array_equal(table[:, :, 2], held["link_position"])
    np.testing.assert_array_equal(table[:, :, 3], held["link_torque"])


@pytest.fixture(scope="module")
def swing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A joint file and a record of it, simulated without FMI, with its readings from a start
    that is not zero.
    """
    made = tmp_path_factory.mktemp("record")
    joint = reference_joint("irj_ts")
    values = {k: {"value": v, "unit": "", "side": ""} for k, v in joint.fitted.items()}
    (made / "joint.toml").write_text(toml_text(joint, values), encoding="utf-8")
    t = 2e-3 * np.arange(501)
    drive = 150 * np.sin(2 * np.pi * 0.8 * t)
    found = simulate(joint.model(), drive, 2e-3, x0=np.array([0.1, 0.0, 0.1, 0.0])).readings
    table = np.column_stack([t, drive / (joint.torque_per_current or 1.0), found])
    table[:, 2:4] *= joint.gear_ratio
    names = (
        "time_s,motor_current_A,motor_position_rad,motor_velocity_rad/s,link_position_rad,"
        "link_velocity_rad/s,link_torque_Nm"
    )
    np.savetxt(made / "swing.csv", table, "%.17g", ",", header=names, comments="")
    return made


RECORDS = """
[records]
files = ["*.csv"]
[[model]]
joint = "joint.toml"
name = "as it is"
[[model]]
joint = "joint.toml"
name = "without the cubic spring"
set = { cubic_stiffness = 0.0 }
[grid]
link_inertia = [{inertia}, 40.0]
"""


def test_records_are_followed_by_the_right_model(swing: Path, tmp_path: Path) -> None:
    """The drive comes from the record, and so do start, step and length; the plant with the
    true values fits best.
    """
    path = swing / "fit.toml"
    true = reference_joint("irj_ts").fitted["link_inertia"]
    path.write_text(RECORDS.replace("{inertia}", repr(true)))
    with ThreadPoolExecutor(1) as executor:
        found = run_study(path, out=tmp_path / "out", executor=executor)
    assert [(run.model, run.record, run.parameters["link_inertia"]) for run in found.runs] == [
        (model, "swing", inertia)
        for model in ("as it is", "without the cubic spring")
        for inertia in (true, 40.0)
    ]
    fits = [run.figures["link_position.fit_percent"] for run in found.runs]
    assert fits[0] > 99.9
    assert fits[0] > max(fits[1:])
    assert found.runs[0].figures["motor_position.fit_percent"] > 99.9
    assert found.runs[1].figures["link_position.fit_percent"] < 90
    assert found.runs[0].parameters["state.link_position"] == pytest.approx(0.1)
    assert np.load(tmp_path / "out" / "results.npz")["link_position"].shape == (4, 501)


def test_models_of_different_length_share_a_file(folder: Path, swing: Path) -> None:
    """Two records of different length: times per run, shorter runs filled with NaN."""
    lines = (swing / "swing.csv").read_text().splitlines()
    (folder / "long.csv").write_text("\n".join(lines[:300]) + "\n")
    (folder / "short.csv").write_text("\n".join(lines[:120]) + "\n")
    path = folder / "two.toml"
    path.write_text(
        '[[model]]\nfmu = "plant.fmu"\n[records]\nfiles = ["long.csv", '
        '"short.csv"]\n[study]\nrecord = "link_position"\n'
    )
    found = run_study(path, jobs=1)
    held = np.load(folder / "two-results" / "results.npz")
    assert held["samples"].tolist() == [299, 119]
    assert held["time"].shape == held["link_position"].shape == (2, 299)
    assert np.isnan(held["link_position"][1, 119:]).all()
    assert np.isfinite(held["link_position"][1, :119]).all()
    assert [run.record for run in found.runs] == ["long", "short"]


def test_a_run_that_fails_is_a_row_with_its_reason(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(folder, STUDY + "link_inertia = [10.0, 0.0]\n", count=2)
    report = folder / "report.json"
    assert main([str(path), "--jobs", "1", "--json", str(report)]) == 0
    said = capsys.readouterr()
    assert "2 failed" in said.out
    assert said.err == ""
    found = rows(folder / "study-results")
    assert [r["outcome"] for r in found] == ["done", "failed", "done", "failed"]
    assert all(("finite" in r["reason"]) == (r["outcome"] == "failed") for r in found)
    assert found[1]["link_position.last"] == ""
    held = np.load(folder / "study-results" / "results.npz")
    assert np.isnan(held["link_position"][1]).all()
    assert np.isfinite(held["link_position"][[0, 2]]).all()
    data = json.loads(report.read_text())
    assert data["failed"] == 2
    assert data["rows"][1]["figures"]["link_position.last"] is None
    assert main([str(path), "--fail-on-error"]) == 1


# --- parameters -----------------------------------------------------------------------------------


def cases(text: str) -> list[dict[str, Any]]:
    import tomllib

    return cases_of(tomllib.loads(text), "study.toml")


def test_grid_list_and_draws_combine() -> None:
    found = cases(
        "[[case]]\na = 1\n[[case]]\na = 2\nb = 7\n[grid]\nc = { low = 1, high = 100, count = 3, "
        'spacing = "log" }\n'
        "[random]\ncount = 2\n[random.parameters]\nd = { low = 0, high = 1 }\n"
    )
    assert len(found) == 12
    assert [case["c"] for case in found[:6]] == pytest.approx([1, 1, 10, 10, 100, 100])
    assert [case.get("b") for case in found] == [None] * 6 + [7] * 6
    assert len({case["d"] for case in found}) == 2
    assert cases("") == [{}]


def test_draws_follow_their_law() -> None:
    head = "[random]\nseed = 3\n"
    laws = (
        "[random.parameters]\nu = { low = 2, high = 4 }\nl = { low = 1, high = 1e4, spacing = "
        '"log" }\n'
        "n = { mean = 5, deviation = 2 }\nc = { choose = [1, 2, 4] }\n"
    )
    few, many = (cases(f"{head}count = {count}\n{laws}") for count in (50, 4000))
    assert many[:50] == few
    table = {name: np.array([case[name] for case in many]) for name in "ulnc"}
    assert table["u"].min() >= 2
    assert table["u"].max() <= 4
    assert table["u"].mean() == pytest.approx(3, abs=0.05)
    assert np.median(table["l"]) == pytest.approx(100, rel=0.3)
    assert (table["n"].mean(), table["n"].std()) == pytest.approx((5, 2), rel=0.05)
    assert [np.mean(table["c"] == v) for v in (1, 2, 4)] == pytest.approx([1 / 3] * 3, abs=0.03)
    latin = cases(f'{head}count = 40\nmethod = "latin"\n{laws}')
    assert sorted(int((case["u"] - 2) / 2 * 40) for case in latin) == list(range(40))
    assert cases(f"[random]\nseed = 4\ncount = 50\n{laws}") != few


# --- being ended, and going on --------------------------------------------------------------------


def start(path: Path, out: Path, *more: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "workbench.cli.main",
            "batch",
            str(path),
            "--jobs",
            "2",
            "-o",
            str(out),
            *more,
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    )


def wait_for(condition: Any, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.01)


def finished(out: Path) -> dict[str, tuple[int, int]]:
    """Chunks on disk, with what changes when one is written again."""
    return {
        p.name: (p.stat().st_ino, p.stat().st_mtime_ns)
        for p in (out / "chunks").glob("chunk-*.npz")
    }


def members(group: int) -> list[int]:
    """Living processes of a process group (a process that has ended and waits for its parent
    does not count).
    """
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[2]) == group and fields[0] != "Z":
                found.append(int(entry.name))
    return found


LONG_STUDY = {"stop": 6.0, "count": 120, "more": "chunk = 3\nevery = 50"}


@pytest.fixture(scope="module")
def in_one_go(plant: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("whole")
    (made / "plant.fmu").write_bytes(plant.read_bytes())
    with ThreadPoolExecutor(1) as executor:
        run_study(write(made, **LONG_STUDY), executor=executor)  # type: ignore[arg-type]
    return made / "study-results"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes in /proc")
@pytest.mark.parametrize(
    "how", [signal.SIGKILL, signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_goes_on_after_the_end(
    how: signal.Signals, folder: Path, in_one_go: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is lost, nothing that is there runs again, no process stays, and the result is
    that of one go.
    """
    path, out = write(folder, **LONG_STUDY), folder / "out"  # type: ignore[arg-type]
    process = start(path, out)
    try:
        wait_for(lambda: len(finished(out)) >= 4)
        if how == signal.SIGINT:
            os.killpg(process.pid, how)  # as a terminal does
        else:
            process.send_signal(how)
        _, said = process.communicate(timeout=30)
        wait_for(lambda: not members(process.pid), 20)
    finally:
        if members(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}[how]
    if how != signal.SIGKILL:
        assert said.strip() == ("irj: interrupted" if how == signal.SIGINT else "")
        assert not list((out / "chunks").glob(".fmu-*"))
    before = finished(out)
    assert 4 <= len(before) < 40
    assert not (out / "summary.csv").exists()
    assert main([str(path), "-o", str(out), "--jobs", "2"]) == 0
    assert (
        f"120 runs ({3 * len(before)} were there), {120 - 3 * len(before)} run now"
        in capsys.readouterr().out
    )
    after = finished(out)
    assert {name: after[name] for name in before} == before
    assert len(after) == 40
    assert not list((out / "chunks").glob(".fmu-*"))
    for name in ("summary.csv", "results.npz"):
        assert (out / name).read_bytes() == (in_one_go / name).read_bytes()


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes in /proc")
@pytest.mark.parametrize("after", [0.0, 0.1, 0.3])
def test_an_interrupt_while_the_workers_load_is_one_line(after: float, folder: Path) -> None:
    """A terminal sends it to them as well, and one that still loads its modules printed a trace."""
    path, out = write(folder, **LONG_STUDY), folder / "out"  # type: ignore[arg-type]
    process = start(path, out)
    try:
        wait_for(lambda: len(members(process.pid)) >= 3)  # one keeps track, one starts the others
        time.sleep(after)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=30)
    finally:
        if members(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
    assert (process.returncode, said) == (130, "irj: interrupted\n")


def test_a_torn_chunk_is_run_again(folder: Path) -> None:
    path = write(folder, count=6, more="chunk = 2")
    run_study(path, jobs=1)
    out = folder / "study-results"
    expected = (out / "results.npz").read_bytes()
    torn = out / "chunks" / "chunk-000001.npz"
    torn.write_bytes(torn.read_bytes()[:200])
    (out / "chunks" / "chunk-000002.npz").write_bytes(b"")
    assert run_study(path, jobs=1).there == 2
    assert (out / "results.npz").read_bytes() == expected


def test_a_changed_study_does_not_mix(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(write(folder, count=2))]) == 0
    assert main([str(write(folder, count=3))]) == 2
    assert "--fresh" in capsys.readouterr().err
    assert len(rows(folder / "study-results")) == 2
    assert main([str(write(folder, count=3)), "--fresh"]) == 0
    assert len(rows(folder / "study-results")) == 3


def test_two_at_once_do_not_mix(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(folder, count=2)
    (folder / "study-results").mkdir()
    held = lock(folder / "study-results")
    assert main([str(path)]) == 2
    assert "another batch is at work there" in capsys.readouterr().err
    held.close()
    assert main([str(path), "--jobs", "1"]) == 0


# --- bad input ------------------------------------------------------------------------------------

HEAD = '[study]\nstop = 0.1\nstep = 0.01\nrecord = ["link_position"]\n'
MODEL = '[[model]]\nfmu = "plant.fmu"\n'
BAD = {
    "": "no model",
    "[study\n": "not valid TOML",
    HEAD + "[[model]]\n": "give either fmu or joint",
    HEAD + '[[model]]\nfmu = "none.fmu"\n': "none.fmu",
    HEAD + '[[model]]\nfmu = "study.toml"\n': "not a readable FMU",
    HEAD + '[[model]]\njoint = "none.toml"\n': "none.toml",
    HEAD + '[[model]]\nfmu = "plant.fmu"\nadd = ["stribeck"]\n': "taken as it is",
    HEAD + MODEL + MODEL: "two models are called 'plant'",
    HEAD + MODEL + "[grid]\nstifness = [1.0]\n": "did you mean: stiffness",
    HEAD + MODEL + "[grid]\nstiffness = [1.0, nan]\n": "not a finite number",
    HEAD + MODEL + '[grid]\nstiffness = ["soft"]\n': "does not fit a variable of type Real",
    HEAD + MODEL + "[grid]\nlink_torque = [1.0]\n": "cannot be set",
    HEAD + MODEL + "[grid]\nstiffness = [true]\n": "does not fit a variable of type Real",
    "[study]\nstop = 1e12\nstep = 1e-3\n" + MODEL: "do not fit into memory",
    "[study]\nstop = 0.0155\n" + MODEL: "whole number of steps of 0.001 s",
    HEAD + MODEL + "[grid]\nstiffness = []\n": "the list is empty",
    HEAD + MODEL + "[grid]\nstiffness = { low = 2, high = 1, count = 3 }\n": "is not below",
    HEAD + MODEL + "[grid]\nstiffness = { low = 1, high = 2 }\n": "count",
    HEAD
    + MODEL
    + "[grid]\nstiffness = { low = 1, high = 2, count = 3000 }\nlink_inertia = { low = 1, high = "
    "2, count = 3000 }\n": "9000000 cases",
    HEAD + MODEL + "[grid]\nstiffness = [1.0]\n[[case]]\nstiffness = 2.0\n": "varied in two places",
    HEAD + MODEL + "[random]\ncount = 5\n": "[random.parameters]",
    HEAD
    + MODEL
    + "[random]\ncount = -5\n"
    + "[random.parameters]\nstiffness = { low = 1, high = 2 }\n": "not a whole number",
    HEAD
    + MODEL
    + "[random]\ncount = 5\n"
    + "[random.parameters]\nstiffness = { low = 1, mean = 2 }\n": "give one of",
    HEAD + MODEL + '[inputs]\ni_m = "motor_current"\n': "no [records]",
    HEAD + MODEL + "[inputs]\nnothing = 1.0\n": "no model has such an input",
    HEAD + MODEL + "[inputs]\ni_m = { time = [1, 0], value = [1, 2] }\n": "must increase",
    HEAD + MODEL + '[records]\nfiles = ["none.csv"]\n': "none.csv",
    HEAD + MODEL + '[records]\nfiles = ["*.csv"]\n': "nothing fits",
    HEAD + MODEL + '[recrods]\nfiles = ["a.csv"]\n': "did you mean 'records'",
    '[study]\nrecord = ["link_position"]\n' + MODEL: "no stop",
    "[study]\nstop = -1\n" + MODEL: "not positive",
    "[study]\nstop = 0.015\nstep = 0.01\n" + MODEL: "not a whole number of steps",
    "[study]\nstop = 0.1\nevery = 0\n" + MODEL: "at least 1",
    '[study]\nstop = 0.1\nrecord = ["link_positoin"]\n' + MODEL: "did you mean: link_position",
    '[study]\nstop = 0.1\nformat = "xlsx"\n' + MODEL: "npz, csv, none",
    '[study]\nstop = "long"\n' + MODEL: "not a finite number",
}


@pytest.mark.parametrize("text", BAD)
def test_bad_study_is_one_line(text: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "study.toml"
    path.write_text(text)
    assert main([str(path)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert BAD[text] in said
    assert not (folder / "study-results" / "summary.csv").exists()


def test_bad_arguments_are_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(folder)
    (folder / "taken").write_text("")
    for argv, text in (
        (["none.toml"], "none.toml"),
        ([str(folder)], "directory"),
        ([str(folder / "plant.fmu")], "text file"),
        ([str(path), "--jobs", "0"], "at least 1"),
        (
            [str(path), "-o", str(folder / "taken")],
            "taken: is a file; give the name of a writable folder",
        ),
        (
            [str(path), "-o", str(folder / "taken" / "deeper")],
            "taken: is a file; give the name of a writable folder",
        ),
        ([str(path), "--json", str(folder / "no" / "a.json")], "no such folder"),
    ):
        assert main(argv) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert text in said


def test_the_study_in_the_docs_is_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The example of docs/batch.md, its number of runs, and its tables of parameters."""
    text = (ROOT / "docs" / "batch.md").read_text(encoding="utf-8")
    found = re.findall(r"^```toml\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    example = next(block for block in found if block.startswith("[study]"))
    (tmp_path / "study.toml").write_text(example)
    assert main([str(tmp_path / "study.toml"), "--dry-run"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "there is no file" in said
    assert "axis3.toml" in said
    shutil.copy(ROOT / "workbench" / "demo" / "joint.toml", tmp_path / "axis3.toml")
    assert main([str(tmp_path / "study.toml"), "--dry-run"]) == 0
    said = capsys.readouterr().out
    count = int(said.rsplit(",", 1)[1].split()[0])
    assert f"This study has 2 x 20 x 3 = {count} runs" in text
    assert (
        len(cases(next(block for block in found if block.startswith("[grid]")))) == 2 * 10 * 2 * 500
    )


def test_dry_run_counts(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(write(folder, count=12)), "--dry-run"]) == 0
    assert "1 model x 0 records x 12 cases, 12 runs" in capsys.readouterr().out
    assert not (folder / "study-results").exists()


def test_paths_are_relative_to_the_study(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write(folder, count=2)
    found = run_study(Path(folder.name) / "study.toml", jobs=1)
    assert found.summary == Path(folder.name) / "study-results" / "summary.csv"
    assert found.summary.is_file()
    assert load_study(folder / "study.toml").models[0].path == folder / "plant.fmu"


def test_a_library_that_cannot_be_loaded_is_a_reason(folder: Path) -> None:
    """An FMU for another system: every run is a row that says so."""
    import zipfile

    with zipfile.ZipFile(folder / "plant.fmu") as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(folder / "plant.fmu", "w") as archive:
        for name, content in parts.items():
            archive.writestr(
                name, b"not a library" if name.startswith("binaries/linux64") else content
            )
    found = run_study(write(folder, count=2), jobs=1)
    assert len(found.failed) == 2
    assert "cannot be loaded" in found.failed[0].reason


def test_a_plant_of_fmi_3_gives_what_that_of_fmi_2_gives(plant: Path, folder: Path) -> None:
    spec = plant_spec(reference_joint("irj_ts"), PlantOptions(name="plant"))
    build_plant_fmi3(spec, folder / "three.fmu")
    study = write(folder, count=2)
    (folder / "three.toml").write_text(study.read_text().replace("plant.fmu", "three.fmu"))
    with ThreadPoolExecutor(1) as executor:
        run_study(study, out=folder / "two", executor=executor)
        run_study(folder / "three.toml", out=folder / "three", executor=executor)
    two, three = rows(folder / "two"), rows(folder / "three")
    assert len(two) == 2 and {r["outcome"] for r in three} == {"done"}
    figures = [k for k in two[0] if k.startswith("link_")]
    values = [[[float(r[k] or "nan") for k in figures] for r in found] for found in (two, three)]
    assert np.nanmax(np.abs(values[0])) > 1e-3
    np.testing.assert_allclose(values[1], values[0], rtol=1e-12, atol=0)
