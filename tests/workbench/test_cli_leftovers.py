"""Commands that reach FMI, and what a hostile user tries: one line that begins with ``irj:``,
exit code 2, nothing half written.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from identification import compare, fit, load_joint, read
from identification.errors import InputError
from identification.faults.detector import FaultDetector
from identification.online.estimator import OnlineOptions, prepared
from irj_fmu.command_line import counted, progress_bar, replace_files, write_json
from irj_fmu.estimator.healthy import detector_state, online_readings, read_healthy
from workbench.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "workbench" / "demo"
FITTED = """
[fitted]
motor_inertia = { value = 4.44 }
link_inertia = { value = 10.27 }
stiffness = { value = 2.2e4 }
structural_damping = { value = 59.7 }
motor_viscous = { value = 8.8 }
link_viscous = { value = 2.0 }
motor_coulomb = { value = 23.4 }
link_coulomb = { value = 0.4 }
gravity_torque = { value = 105.2 }
"""
Said = Callable[..., str]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose name holds a space, an umlaut and a hash; joint file and records of the
    demo.
    """
    folder = tmp_path_factory.mktemp("left") / "Größe mit Leerzeichen #1"
    folder.mkdir()
    (folder / "joint.toml").write_text((DEMO / "joint.toml").read_text() + FITTED, encoding="utf-8")
    for name in ("train.npz", "held_out.npz"):
        (folder / name).write_bytes((DEMO / name).read_bytes())
    thin = read(DEMO / "train.npz").without("link_torque")
    np.savez(
        folder / "thin.npz",
        time_s=thin.time,
        **{f"{c}_{_UNITS[c]}": v for c, v in thin.channels.items()},
    )
    (folder / "empty.toml").write_bytes(b"")
    return folder


_UNITS = {
    "motor_current": "A",
    "motor_position": "rad",
    "motor_velocity": "rad_s",
    "link_position": "rad",
    "link_velocity": "rad_s",
    "link_torque": "Nm",
}


def whole(folder: Path) -> dict[str, bytes]:
    return {
        str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b""
        for p in folder.rglob("*")
    }


@pytest.fixture
def said(place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Said:
    """Run a command in the folder; its one line. Exit code 2, nothing printed, no file changed
    or left.
    """
    monkeypatch.chdir(place)

    def run(*arguments: str) -> str:
        before = whole(place)
        capsys.readouterr()
        try:
            code: object = main(arguments)
        except SystemExit as stopped:
            code = stopped.code
        out, err = capsys.readouterr()
        assert code == 2, out + err
        assert out == ""
        assert err.count("\n") == 1, err
        assert err.startswith("irj: ")
        assert "build_fmu.py" not in err
        assert whole(place) == before
        return err

    return run


# --- limits of the fault detector -----------------------------------------------------------------


def test_healthy_records_are_taken_at_the_step_of_the_estimator(place: Path) -> None:
    """A record at 2.5 ms serves an estimator at 1 ms and one at 5 ms: the state fits a detector
    of that step.
    """
    joint = load_joint(place / "joint.toml")
    told: list[str] = []
    (record,) = read_healthy([place / "train.npz"], joint)
    for dt in (1e-3, 2.5e-3, 5e-3):
        state = detector_state(joint, OnlineOptions(), [record], dt, told.append)
        assert state is not None
        model, _ = prepared(joint, OnlineOptions())
        expected = FaultDetector(model, dt)
        expected.calibrate(np.array(online_readings(record.resampled(dt), joint)[0]))
        assert state == expected.state()
    assert len(told) == 1
    assert "train.npz: sampled every 2.5 ms, interpolated to the estimator's 1 ms" in told[0]


def test_recordings_that_do_not_follow_each_other_give_the_limits_of_one(place: Path) -> None:
    """The jump between two recordings is no residual; it made the limits thousands of times
    wider.
    """
    joint = load_joint(place / "joint.toml")
    model, _ = prepared(joint, OnlineOptions())
    table = np.array(online_readings(read(place / "train.npz"), joint)[0])
    for pieces in (table, [table[3000:], table[:3000]]):
        detector = FaultDetector(model, 2.5e-3)
        detector.calibrate(pieces)
        healthy = detector.run(table)
        assert [e.verdict.name for e in healthy.events] == ["ARMED"]
        broken = table.copy()
        broken[5000:, 3] += 0.02
        detector.reset()
        assert any(e.is_sensor for e in detector.run(broken).events)


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (
            ("estimator", "--healthy", "coarse.npz"),
            "coarse.npz: sampled every 20 ms (50 per s), too coarse for limits at the "
            "estimator's step of 1 ms; give",
        ),
        (
            ("native", "--sample-time", "0.005", "--healthy", "coarse.npz"),
            "give healthy records with 200 samples per s or more, or a native estimator",
        ),
        (
            ("estimator", "--healthy", "thin.npz"),
            "thin.npz: has no link_torque, which the estimator reads; give records with it, or "
            "--no-torque",
        ),
        (("estimator", "--healthy", "none.npz"), "none.npz: there is no such file"),
        (
            ("native", "--healthy", "train.npz", "--sample-time", "nan"),
            "--sample-time nan: give 0.00001 to 1 s",
        ),
        (("native", "--sample-time", "-1"), "--sample-time -1: give"),
        (
            ("estimator", "--sample-time", "0.01"),
            "--sample-time: goes with native, all, not with estimator",
        ),
        (
            ("plant", "--healthy", "train.npz"),
            "--healthy: goes with estimator, native, ssp, all, not with plant",
        ),
    ],
)
def test_export_with_records_that_cannot_serve(
    said: Said, place: Path, command: tuple[str, ...], expected: str
) -> None:
    coarse = read(DEMO / "train.npz").resampled(0.02)
    np.savez(
        place / "coarse.npz",
        time_s=coarse.time,
        **{f"{c}_{_UNITS[c]}": v for c, v in coarse.channels.items()},
    )
    assert expected in said("export", *command, "--joint", "joint.toml")


# --- arguments and outputs ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (
            ("export", "plant"),
            "the following arguments are required: --joint; see `irj export --help`",
        ),
        (("export", "c"), "required: --joint; see `irj export c --help`"),
        (("export", "casadi", "--joint"), "--joint: expected one argument"),
        (
            ("export", "--joint", "joint.toml", "plant", "--bogus"),
            "unrecognized arguments: --bogus",
        ),
        (
            ("export", "wrong", "--joint", "joint.toml"),
            "export: 'wrong' cannot be built; choose one of estimator, plant",
        ),
        (
            ("export", "pair"),
            "export pair: goes with a joint file whose model is an FMU; give one with --joint",
        ),
        (
            ("export", "pair", "--joint", "joint.toml"),
            "export pair: goes with a joint file whose model is an FMU",
        ),
        (("export", "--joint", "none.toml", "pair"), "none.toml: cannot be read"),
        (("export", "plant", "--joint", "empty.toml"), "empty.toml: no [joint] table"),
        (
            ("export", "plant", "--joint", "joint.toml", "--target", "amiga"),
            "target 'amiga' is not known",
        ),
        (
            ("export", "plant", "--joint", "joint.toml", "--out", "train.npz"),
            "train.npz: is a file; give the name of a writable folder for --out",
        ),
        (
            ("export", "casadi", "--joint", "joint.toml", "--out", "joint.toml/a/b"),
            "joint.toml/a/b: cannot write there",
        ),
        (
            ("export", "plant", "--joint", "joint.toml", "--json", "joint.toml"),
            "joint.toml: is an input of this command and would be lost",
        ),
        (
            ("export", "c", "--joint", "joint.toml", "--json", "joint.toml"),
            "joint.toml: is an input of this command and would be lost",
        ),
        (
            ("export", "plant", "--joint", "joint.toml", "--json", "none/x.json"),
            "none: no such folder",
        ),
        (("export", "c", "--joint", "joint.toml", "--json", "none/x.json"), "none: no such folder"),
        (
            (
                "export",
                "plant",
                "--joint",
                "joint.toml",
                "--out",
                ".",
                "--json",
                "demo_joint_plant.fmu",
            ),
            "given for two results",
        ),
        (("cosim", "--bogus"), "unrecognized arguments: --bogus; see `irj cosim --help`"),
        (("cosim", "robot"), "reference joint 'robot'"),
        (("cosim", "hd1", "--json", "none/x.json"), "none: no such folder; make it first"),
        (("cosim", "hd1", "--json", "."), ".: is a folder; give the name of a file"),
        (
            ("cosim", "--joint", "joint.toml", "--json", "joint.toml"),
            "joint.toml: is an input of this command and would be lost",
        ),
        (("cosim", "--joint", "none.toml"), "none.toml: cannot be read"),
        (("cosim", "--joint", "empty.toml"), "empty.toml: no [joint] table"),
        (("cosim", "hd1", "--stop", "nan"), "--stop nan: the estimator's first window takes 7 s"),
        (("cosim", "hd1", "--stop", "-5"), "--stop -5: the estimator's first window takes 7 s"),
        (("cosim", "hd1", "--stop", "10.00017"), "is not a whole number of steps of 0.001 s"),
        (("cosim", "hd1", "--cc", "none"), "no C compiler found"),
        (("cosim", "--published", "none.json", "a"), "none.json: cannot be read"),
        (
            ("cosim", "--published", "joint.toml", "a"),
            "joint.toml: not a table of published parameters",
        ),
        (
            ("simulate", "--joint", "joint.toml", "--seed", "-1"),
            "--seed -1: give a whole number from 0 up",
        ),
        (
            ("simulate", "--joint", "joint.toml", "--set", "stiffness=-1"),
            "--set stiffness=-1: stiffness lies between",
        ),
        (
            ("simulate", "--joint", "joint.toml", "--set", "motor_coulomb=nan"),
            "--set motor_coulomb=nan: motor_coulomb lies between",
        ),
        (
            ("simulate", "--joint", "joint.toml", "-o", "record.mat"),
            "record.mat: a record is written as .csv or .npz",
        ),
        (
            ("plan", "--joint", "joint.toml", "--max-speed", "nan"),
            "--max-speed nan: give a limit above 0",
        ),
        (
            ("plan", "--joint", "joint.toml", "--max-position", "-1"),
            "--max-position -1: give a limit above 0",
        ),
        (("check", "train.npz", "--json", ""), "the name of a result file is empty"),
        (
            ("check", "train.npz", "--json", "/proc/x.json"),
            "/proc/x.json: its folder is not writable",
        ),
        (("app", "--port", "70000", "--no-browser"), "takes a port from 0 to 65535"),
        (
            ("fit", "train.npz", "thin.npz", "--joint", "joint.toml"),
            "thin.npz: has no link_torque, which train.npz has; "
            "give records with the same channels",
        ),
        (
            ("compare", "train.npz", "--fit", "thin.npz", "--joint", "joint.toml"),
            "train.npz: has link_torque, which thin.npz has not",
        ),
        (
            ("improve", "train.npz", "--held-out", "thin.npz", "--joint", "joint.toml"),
            "thin.npz: has no link_torque, which train.npz has",
        ),
        (
            ("diagnose", "thin.npz", "--held-out", "train.npz", "--joint", "joint.toml"),
            "train.npz: has link_torque, which thin.npz has not",
        ),
        (
            (
                "track",
                "held_out.npz",
                "--joint",
                "joint.toml",
                "--inject",
                "link_position:stuck:99",
            ),
            "held_out.npz: a fault at 99 s is asked for",
        ),
    ],
)
def test_unusable_input_is_one_line(said: Said, command: tuple[str, ...], expected: str) -> None:
    if "/proc/x.json" in command and not Path("/proc").is_dir():
        pytest.skip("no /proc on this system")
    assert expected in said(*command)


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        ("link_position:bias:nan:1", "start nan s, size 1, end inf s; give finite numbers"),
        ("link_position:bias:9:nan", "size nan"),
        ("link_position:bias:9:inf", "size inf"),
        ("link_position:bias:9:1:nan", "end nan s"),
        ("link_position:bias:-1:1", "it starts at -1 s; give 0 s or later"),
        ("link_position:delay:9:-0.1", "delay of size -0.1; give a size above 0"),
        ("link_position:delay:9:0", "delay of size 0"),
        ("link_position:noise:9:-1", "noise of size -1"),
    ],
)
def test_faults_that_are_no_numbers_or_run_backwards(said: Said, fault: str, expected: str) -> None:
    line = said("track", "held_out.npz", "--joint", "joint.toml", "--inject", fault)
    assert f"--inject '{fault}': fault: " in line
    assert expected in line


def test_kind_may_stand_behind_the_options(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (
        ["--joint", str(place / "joint.toml"), "c", "--out", str(tmp_path)],
        ["--out", str(tmp_path), "--joint", str(place / "joint.toml"), "c"],
    ):
        assert main(["export", *words]) == 0
        assert "joint.c" in capsys.readouterr().out


def test_an_fmu_that_refuses_ends_a_cosimulation_with_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from irj_fmu.host.run import FmuError

    def refuses(*_: object, **__: object) -> None:
        raise FmuError("plant: doStep failed, status 3")

    monkeypatch.setattr("irj_fmu.cosim.convergence", refuses)
    assert main(["cosim", "hd1"]) == 2
    assert capsys.readouterr().err == "irj: plant: doStep failed, status 3\n"


def test_json_of_a_cosimulation_holds_no_nan(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from irj_fmu.cosim import Row

    monkeypatch.setattr(
        "irj_fmu.cosim.convergence",
        lambda *_a, **_k: [Row("hd1", "loss_sine", "N.m", 0.0, 0.1, float("inf"), None)],
    )
    assert main(["cosim", "hd1", "--json", str(tmp_path / "r.json")]) == 0
    text = (tmp_path / "r.json").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    (row,) = json.loads(text)["rows"]
    assert row["error_percent"] is None
    assert row["sigma"] is None
    write_json(tmp_path / "r.json", {"a": np.float64("nan"), "b": (np.int64(3),)})
    assert json.loads((tmp_path / "r.json").read_text()) == {"a": None, "b": [3]}


# --- studies --------------------------------------------------------------------------------------


STUDY = '[study]\nstop = 0.01\n[[model]]\njoint = "joint.toml"\n'


def test_a_study_never_replaces_what_it_reads(said: Said, place: Path) -> None:
    (place / "study.toml").write_text(STUDY)
    for target in (
        "study.toml",
        "joint.toml",
        str(place / "study.toml"),
        "../" + place.name + "/joint.toml",
    ):
        assert "is an input of this command and would be lost" in said(
            "batch", "study.toml", "--json", target
        )
    (place / "study.toml").write_text(STUDY + '[records]\nfiles = ["results.npz"]\n')
    (place / "results.npz").write_bytes((place / "train.npz").read_bytes())
    assert "results.npz: is an input of this command" in said("batch", "study.toml", "-o", ".")
    (place / "results.npz").unlink()
    (place / "study.toml").write_text(STUDY)
    assert "given for two results" in said(
        "batch", "study.toml", "-o", "out", "--json", "out/summary.csv"
    )
    (place / "study.toml").unlink()


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        (
            "none.json",
            "no scheduler answers there (no such file, and no address as tcp://host:8786)",
        ),
        ("pigeon://x", "no scheduler answers there"),
        (
            "empty.toml",
            "is not a scheduler file; give what `dask scheduler --scheduler-file` writes",
        ),
        ("bare.json", "bare.json: no scheduler answers there (that file holds no address"),
    ],
)
def test_no_dask_cluster_is_one_line_and_no_traceback_afterwards(
    place: Path, address: str, expected: str
) -> None:
    """In a process of its own: what is left behind would speak when Python ends."""
    (place / "study.toml").write_text(STUDY)
    (place / "bare.json").write_text('{"address": "here"}')
    command = [sys.executable, "-m", "workbench", "batch", "study.toml", "--dask", address]
    done = subprocess.run(
        command,
        cwd=place,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    for name in ("study.toml", "bare.json"):
        (place / name).unlink()
    assert done.returncode == 2
    assert expected in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr


# --- manners --------------------------------------------------------------------------------------


def test_a_reader_that_leaves_does_not_end_the_work(place: Path, tmp_path: Path) -> None:
    """`irj fit ... -o f.toml | true` writes its file."""
    target = tmp_path / "f.toml"
    script = (
        f'"{sys.executable}" -u -m workbench fit train.npz --joint joint.toml -o "{target}" | true'
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {script}"],
        cwd=place,
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert done.returncode == 0
    assert done.stderr == ""
    assert load_joint(target).fitted


@pytest.mark.skipif(sys.platform == "win32", reason="signals of a POSIX system")
@pytest.mark.parametrize(
    ("number", "codes"), [(signal.SIGINT, (130, -signal.SIGINT)), (signal.SIGTERM, (143,))]
)
def test_a_build_that_is_ended_leaves_nothing(
    place: Path, tmp_path: Path, number: signal.Signals, codes: tuple[int, ...]
) -> None:
    """Ended as soon as the folder is there, with a compiler that takes its time."""
    slow, scratch = tmp_path / "slow-cc", tmp_path / "scratch"
    slow.write_text("#!/bin/sh\nexec sleep 60\n")
    slow.chmod(0o755)
    scratch.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(scratch)}
    command = [
        sys.executable,
        "-m",
        "workbench",
        "export",
        "plant",
        "--joint",
        str(place / "joint.toml"),
        "--out",
        "a/b",
        "--cc",
        str(slow),
    ]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=tmp_path,
    ) as process:
        end = time.monotonic() + 60
        while (
            not list((tmp_path / "a").rglob(".build-*"))
            and process.poll() is None
            and time.monotonic() < end
        ):
            time.sleep(0.02)
        process.send_signal(number)
        out, err = process.communicate(timeout=30)
    assert process.returncode in codes, err
    assert out == ""
    assert err == ("irj: interrupted\n" if number == signal.SIGINT else "")
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["scratch", "slow-cc"]


def test_files_that_belong_together_appear_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "a" / "b"
    write = Path.write_bytes

    def full(self: Path, content: bytes) -> int:
        if ".two." in self.name:
            raise OSError(28, "No space left on device")
        return write(self, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match="No space left on device"):
        replace_files(folder, {"one": b"1", "two": b"2"})
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    assert replace_files(folder, {"one": b"1", "two": b"2"}) == [folder / "one", folder / "two"]
    assert sorted(p.name for p in folder.iterdir()) == ["one", "two"]


def test_an_error_stands_on_a_line_of_its_own_below_the_bar(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def breaks(*_: object, **__: object) -> None:
        progress_bar("half way", 0.5)
        raise InputError("no")

    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("irj_fmu.cosim.convergence", breaks)
    assert main(["cosim", "hd1"]) == 2
    assert capsys.readouterr().err.endswith("\nirj: no\n")


# --- words ----------------------------------------------------------------------------------------


def test_numbers_and_their_nouns() -> None:
    assert [counted(n, "run") for n in (0, 1, 2)] == ["0 runs", "1 run", "2 runs"]


def test_a_track_without_an_estimate_does_not_count_to_zero(
    capsys: pytest.CaptureFixture[str],
) -> None:
    from workbench.cli.online import _print_track
    from workbench.show.replayed import UNESTIMATED

    result = {
        "record": "run",
        "parameters": {},
        "ratio": {},
        "detector": True,
        "calibrated": True,
        "events": [],
        "replaced": [],
    }
    _print_track(result)
    assert capsys.readouterr().out.splitlines()[0] == f"run: {UNESTIMATED}"
    one = {"value": 1.0, "sigma": 0.1, "unit": "N.m", "side": "motor", "history": [1.0]}
    _print_track({**result, "parameters": {"motor_coulomb": one}})
    assert capsys.readouterr().out.splitlines()[0] == "run: 1 parameter followed"


@pytest.fixture(scope="module")
def shown() -> dict[str, Any]:
    """A record, a fit and a comparison of the demo, short."""
    record = read(DEMO / "train.npz").take(slice(0, 2500)).renamed("a record")
    first = fit(load_joint(DEMO / "joint.toml"), record)
    return {"record": record, "fit": first, "comparison": compare(first, record)}


def test_the_linear_ceiling_says_that_it_is_of_the_variance(shown: dict[str, Any]) -> None:
    found = shown["comparison"]
    assert "% of the torque's variance unexplained" in str(found)
    assert "shares of variance, the square of a relative error" in str(found)
    assert (
        "Share of the variance of the measured torque left unexplained (the square of a relative "
        "error)" in found._repr_html_()
    )


def test_tables_of_a_notebook_have_space_between_their_cells_and_units_as_in_the_report(
    shown: dict[str, Any],
) -> None:
    assert "N·m" in shown["record"]._repr_html_()
    assert "N.m" not in shown["record"]._repr_html_()
    for result in shown.values():
        cells = re.findall(r"<t[dh][ >][^>]*", result._repr_html_())
        assert cells
        assert all("padding" in cell for cell in cells)


DROPS = """
import signal
from irj_fmu.command_line import STOPPED
from workbench.cli import main as cli

class Drops:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

class Fails:
    def __del__(self):
        raise ValueError("said")

with cli._watched_interrupt():
    Drops()
    assert STOPPED == [signal.SIGINT]
    Fails()
"""


def test_an_interrupt_that_a_library_drops_is_noted_and_no_trace_is_printed() -> None:
    """It came within compiled code that goes on after any exception; what reports it is the
    interpreter, beside the one line of ours.
    """
    done = subprocess.run(
        [sys.executable, "-c", DROPS],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=True,
    )
    assert "KeyboardInterrupt" not in done.stderr
    assert "ValueError: said" in done.stderr
