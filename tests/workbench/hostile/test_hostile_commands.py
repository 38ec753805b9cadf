"""Every verb with something that it cannot work with: one line that says what, where and what to
do, exit code 2, nothing printed and no file changed or left.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from casadi_models import EFFECTS
from identification.crash import FOLDER
from identification.data.own_effects import STORE
from identification.data.read import read
from identification.errors import InputError
from tests.workbench.hostile.test_hostile import EFFECT, JOINT, RETURN, refused
from tests.workbench.test_bad_input import good
from workbench.cli.main import main

ROOT = Path(__file__).resolve().parents[3]
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
MOTION = "time_s,reference_position_rad,reference_velocity_rad/s,reference_acceleration_rad/s2\n"
STUDY = '[study]\nstop = 0.01\n[[model]]\njoint = "fitted.toml"\n'
RIGID = JOINT.replace("hd3", "hd1")


def motion(rows: int = 20) -> str:
    t = np.arange(rows) * 0.01
    table = np.column_stack([t, np.sin(t), np.cos(t), -np.sin(t)]).tolist()
    return MOTION + "".join(",".join(f"{v:.9g}" for v in row) + "\n" for row in table)


TEXTS = {
    "joint.toml": JOINT,
    "fitted.toml": JOINT + FITTED,
    "huge.toml": JOINT + FITTED.replace("23.4", "1e300"),
    "below.toml": JOINT + FITTED.replace("23.4", "-23.4"),
    "known.toml": JOINT + "[known]\nstiffness = 1e200\n",
    "heavy.toml": JOINT + "[known]\nlink_inertia = 10.27\n",
    "own.toml": RIGID.replace('"gravity"', '"gravity", "hostile"'),
    "root.py": EFFECT.replace(RETURN, "return p.size * ca.sqrt(s.velocity)"),
    "power.py": EFFECT.replace(RETURN, "return p.size ** s.velocity"),
    "nothing.py": EFFECT.replace(RETURN, "return None"),
    "pair.py": EFFECT.replace(RETURN, "return ca.vertcat(p.size, p.size)"),
    "mars.py": EFFECT.replace('("motor",)', '("mars",)'),
    "furlong.py": EFFECT.replace('"N.m"', '"furlong"'),
    "quits.py": EFFECT.replace(RETURN, "import sys; sys.exit(0)"),
    "greedy.py": "x = bytearray(10**15)\n",
    "motion.csv": motion(),
    "motion_nan.csv": motion().replace("\n0.05,", "\nnan,"),
    "motion_short.csv": motion(3),
    "motion_none.csv": MOTION,
    "motion_text.csv": motion().replace("\n0.05,", "\nhello,"),
    "motion_ragged.csv": motion().replace("\n0.05,", "\n0.05,1,"),
    "motion_huge.csv": motion().replace("\n0.05,", "\n0.05,1e200,0,0\n0.05,"),
    "motion_back.csv": MOTION + "".join(f"{-0.01 * k},0,0,0\n" for k in range(20)),
    "motion_uneven.csv": motion().replace("\n0.05,", "\n0.055,"),
    "deep.json": "[" * 100_000,
    "list.json": "[]",
    "none.json": "{}",
    "study.toml": STUDY,
    "study_nan.toml": STUDY.replace("0.01", "nan"),
    "study_back.toml": STUDY.replace("[[", "step = -1\n[["),
    "study_many.toml": STUDY + "[grid]\nstiffness = { low = 1, high = 2, count = 1000000000000 }\n",
    "study_down.toml": STUDY + "[grid]\nstiffness = { low = 5, high = 2, count = 3 }\n",
    "study_lost.toml": STUDY.replace("fitted", "lost"),
    "study_self.toml": STUDY.replace("fitted", "study_self"),
    "study_dir.toml": STUDY + '[records]\nfiles = ["folder"]\n',
    "study_input.toml": STUDY + "[inputs]\ni_m = { time = [1, 0], value = [1, 2] }\n",
    "study_kind.toml": STUDY + 'kind = "zebra"\n',
    "study_fmu.toml": STUDY.replace('joint = "fitted.toml"', 'fmu = "text.fmu"'),
    "text.fmu": "no archive",
    "empty": "",
}
COMMANDS: dict[str, tuple[str, str]] = {
    # records
    "a loop of links": ("check loop", "there is no such file"),
    "a folder named as a record": ("check folder.npz", "is a folder"),
    "a folder as joint": ("check run.npz --joint folder", "give the path of a joint file"),
    "a record as joint": ("check run.npz --joint run.npz", "a joint file is TOML"),
    "no number at all": ("fit nan.npz --joint joint.toml", "is not a number in 3000 rows"),
    "half of a channel": ("fit half.npz --joint joint.toml", "motor_current is not a number in"),
    "nothing but zeros": ("fit zeros.npz --joint joint.toml", "motor_current is constant"),
    "a stuck encoder": ("fit stuck.npz --joint joint.toml", "do not move together"),
    "kilos of torque": ("fit kilo.npz --joint joint.toml", "a factor 1000"),
    "the wrong sign": ("fit minus.npz --joint joint.toml", "the sign of one is reversed"),
    "two encoders exchanged": ("fit swapped.npz --joint joint.toml", "other side of the gear"),
    "time reversed": ("fit back.npz --joint joint.toml", "time runs backwards"),
    "time shuffled": ("resample shuffled.npz -o x.csv", "time runs backwards"),
    "nothing to resample": ("resample nan.npz -o x.csv", "no row is left"),
    "a record over itself": ("resample run.npz -o run.npz", "would be lost"),
    "one run twice": ("fit run.npz copy.npz --joint joint.toml", "holds the same samples"),
    "an input and an output at once": (
        "linear run.npz --from motor_current --to motor_current",
        "is input and output",
    ),
    "orders without end": ("linear run.npz --max-order 100000", "give 1 to 12"),
    "no accelerometer": (
        "accelerometer --up run.npz --down run.npz --column zebra",
        "no column 'zebra'",
    ),
    # models
    "a value to compute nothing with": (
        "compare run.npz --joint huge.toml",
        "[fitted] motor_coulomb: 1e+300 is out of what can be computed with",
    ),
    "a known value like it": ("fit run.npz --joint known.toml", "[known] stiffness: 1e+200 is out"),
    "friction that drives": ("compare run.npz --joint below.toml", "outside its physical bounds"),
    "nothing to compare with": ("changed joint.toml run.npz", "has no [fitted] values"),
    "a record as reference": ("changed run.npz fitted.toml", "a joint file is TOML"),
    "why of nothing": ("diagnose run.npz --joint joint.toml --why zebra", "unknown effect 'zebra'"),
    "steps by thousands": ("improve run.npz --joint joint.toml --max-steps 1e3", "whole number"),
    "a report on the record": (
        "improve run.npz --joint joint.toml --report run.npz",
        "would be lost",
    ),
    "a filter of nothing": ("twostep run.npz --joint heavy.toml --cutoff nan", "cut-off nan Hz"),
    "variants into a file": (
        "explore run.npz --joint joint.toml --held-out half.npz --out empty",
        "is a file",
    ),
    "slower than can be computed": (
        "show --joint fitted.toml --compensation --max-speed 1e-320",
        "must be positive",
    ),
    "one sample": ("simulate --joint fitted.toml -o x.csv --rate 1 --seconds 1", "make 1 samples"),
    "a thousand million samples": (
        "simulate --joint fitted.toml -o x.csv --rate 1e5 --seconds 1e4",
        "make 1000000000 samples",
    ),
    "an inertia of nothing": (
        "simulate --joint fitted.toml -o x.csv --set motor_inertia=0",
        "irj: --set motor_inertia=0: motor_inertia lies between",
    ),
    "an effect hidden twice": (
        "simulate --joint fitted.toml -o x.csv --hide stribeck --hide stribeck",
        "is in the model already",
    ),
    "a unit that is none": (
        'add --law c*v --on motor --parameter "c=0..1 furlong" --joint joint.toml -o x.toml',
        "'furlong' is not understood",
    ),
    "no place for an effect": ("add stribeck@mars --joint joint.toml -o x.toml", "not on 'mars'"),
    # own effects
    "a root of a negative speed": (
        "--effects root.py fit run.npz --joint own.toml",
        "hostile gives no number somewhere along a record",
    ),
    "a power without end": (
        "--effects power.py fit run.npz --joint own.toml",
        "hostile gives no number somewhere along a record",
    ),
    "a law that returns nothing": ("--effects nothing.py effects", "its law returns None"),
    "a law of two values": ("--effects pair.py effects", "it must return one"),
    "a law on mars": ("--effects mars.py effects", "no place 'mars'"),
    "a law in furlongs": ("--effects furlong.py effects", "'furlong' is not understood"),
    "a law that ends the program": ("--effects quits.py effects", "SystemExit"),
    "a law that takes all memory": ("--effects greedy.py effects", "MemoryError"),
    "an effect file as result": (
        "--effects furlong.py add hostile --joint joint.toml -o furlong.py",
        "would be lost",
    ),
    # motions
    "a record as motion": ("next --joint fitted.toml --motion run.npz", "is not a text file"),
    "a folder as motion": ("next --joint fitted.toml --motion folder", "give a trajectory file"),
    "no motion there": ("next --joint fitted.toml --motion lost.csv", "give a trajectory file"),
    "a motion over itself": (
        "next --joint fitted.toml --motion motion.csv -o motion.csv",
        "would be lost",
    ),
    "a motion without rows": ("next --joint fitted.toml --motion motion_none.csv", "has 0 rows"),
    "a motion of three rows": ("next --joint fitted.toml --motion motion_short.csv", "has 3 rows"),
    "a motion of words": ("next --joint fitted.toml --motion motion_text.csv", "'hello'"),
    "a motion of ragged rows": (
        "next --joint fitted.toml --motion motion_ragged.csv",
        "give a number in each of the 4 columns",
    ),
    "a motion at no time": ("next --joint fitted.toml --motion motion_nan.csv", "time_s is nan"),
    "a motion out of sight": (
        "next --joint fitted.toml --motion motion_huge.csv",
        "reference_position_rad is 1e+200 in row 6",
    ),
    "a motion back in time": (
        "next --joint fitted.toml --motion motion_back.csv",
        "in even steps, first at row 2",
    ),
    "a motion of uneven steps": (
        "next --joint fitted.toml --motion motion_uneven.csv",
        "in even steps, first at row 6",
    ),
    "no speed": ("next --joint fitted.toml --max-speed nan", "give a limit above 0"),
    # libraries
    "a deep library": ("joints list --library deep.json", "not a table of published parameters"),
    "a library of nothing": ("joints list --library folder", "no joint file (.toml)"),
    "a deep table": ("cosim --published deep.json key", "nested deeper than 40 levels"),
    "an empty table": ("cosim --published none.json key", "it holds none at all"),
    "a list for a table": ("cosim --published list.json key", "not a table of published"),
    "a text for an FMU": ("joint new text.fmu --record run.npz", "not a readable FMU"),
    # FMUs and studies
    "FMUs into a file": ("export plant --joint fitted.toml --out empty", "empty: is a file; give"),
    "a compiler that is none": (
        "export plant --joint fitted.toml --cc false",
        "compiler 'false' failed for",
    ),
    "a plant without values": ("cosim --joint joint.toml", "has no fitted values"),
    "a study into a file": ("batch study.toml -o empty", "empty: is a file; give"),
    "a deep scheduler": ("batch study.toml --dask deep.json", "is not a scheduler file"),
    "no process": ("batch study.toml --jobs 0", "give at least 1"),
    "a study without end": ("batch study_nan.toml", "stop = nan is not a finite number"),
    "a study back in time": ("batch study_back.toml", "step = -1 is not positive"),
    "a study of a lost joint": ("batch study_lost.toml -o a/b", "lost.toml: cannot be read"),
    "a study of itself": ("batch study_self.toml", "unknown table [study]"),
    "a study of a text": ("batch study_fmu.toml", "text.fmu: not a readable FMU"),
    "a study of a folder": ("batch study_dir.toml", "there is no 'folder'"),
    "a study of inputs back in time": ("batch study_input.toml", "the times must increase"),
    "a study of a zebra": ("batch study_kind.toml", "use one of plant, estimator"),
    "a study that falls": ("batch study_down.toml", "is not below high = 2"),
    "a study of a million millions": ("batch study_many.toml", "count = 1000000000000"),
    # online and page
    "a stream without end": ("track udp://127.0.0.1:5 --joint fitted.toml", "add --follow"),
    "a stream from nowhere": ("track udp:// --joint fitted.toml --follow", "udp://HOST:PORT"),
    "a folder that grows": ("track folder --joint fitted.toml --follow", "give a CSV file that is"),
    "a fault of nothing": (
        "track run.npz --joint fitted.toml --inject zebra:stuck:1",
        "unknown sensor 'zebra'",
    ),
    "a page of a folder": ("app folder --no-browser", "folder: is a folder; name the files in it"),
    "a page that follows a folder": ("app --follow folder --no-browser", "is being written"),
    "a page that follows nothing": ("app --follow udp://x --no-browser", "udp://HOST:PORT"),
}


def _tables() -> dict[str, dict[str, np.ndarray]]:
    whole = good()
    time, current, motor, link, torque = (
        whole[n]
        for n in (
            "time_s",
            "motor_current_A",
            "motor_position_rad",
            "link_position_rad",
            "link_torque_Nm",
        )
    )
    rows = np.arange(len(time))
    rng = np.random.default_rng(0)
    return {
        "run": whole,
        "copy": whole,
        "nan": {n: x if n == "time_s" else x * np.nan for n, x in whole.items()},
        "half": {**whole, "motor_current_A": np.where(rows % 2, current, np.nan)},
        "zeros": {n: x if n == "time_s" else 0 * x for n, x in whole.items()},
        "stuck": {**whole, "motor_position_rad": np.where(rows < 700, motor, motor[700])},
        "kilo": {**whole, "link_torque_Nm": torque * 1e3},
        "minus": {**whole, "link_torque_Nm": -torque},
        "swapped": {**whole, "motor_position_rad": link, "link_position_rad": motor},
        "back": {n: x[::-1] for n, x in whole.items()},
        "shuffled": {**whole, "time_s": rng.permutation(time)},
        "tiny": {**whole, "link_torque_Nm": torque * 1e-200},
        "parted": {n: (x + rows // 8 if n == "time_s" else x)[:800] for n, x in whole.items()},
        "unequal": {**whole, "link_torque_Nm": torque[:-7]},
        "complex": {**whole, "link_torque_Nm": torque + 1j},
        "spare": {**whole, "spare": torque + 1j},
    }


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder, whose name holds a space and an umlaut, of everything that the commands name."""
    folder = tmp_path_factory.mktemp("hostile") / "Prüfstand 1"
    folder.mkdir()
    for name, table in _tables().items():
        np.savez(folder / f"{name}.npz", **table)
    for name, text in TEXTS.items():
        (folder / name).write_text(text)
    (folder / "folder").mkdir()
    (folder / "folder.npz").mkdir()
    (folder / "loop").symlink_to("loop")
    return folder


@pytest.fixture(autouse=True)
def _apart(place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(place)
    monkeypatch.setenv(FOLDER, str(tmp_path / "crashes"))
    monkeypatch.setenv(STORE, str(tmp_path / "allowed"))
    monkeypatch.setenv("IRJ_SESSIONS", str(tmp_path / "home"))
    monkeypatch.setattr(EFFECTS, "_effects", dict(EFFECTS._effects))
    with EFFECTS.scoped():
        yield


def _there(folder: Path) -> dict[str, tuple[int, int]]:
    found = {str(p.relative_to(folder)): p.lstat() for p in folder.rglob("*")}
    return {name: (s.st_mtime_ns, s.st_size) for name, s in found.items() if name != "folder"}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_that_cannot_work(
    name: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, expected = COMMANDS[name]
    before = _there(place)
    line = refused(capsys, *shlex.split(words))
    assert expected in line
    assert "Traceback" not in line
    assert _there(place) == before


@pytest.mark.parametrize(
    ("record", "expected"),
    [
        ("nan.npz", "refuse: nan: motor_current is not a number"),
        ("zeros.npz", "refuse: zeros: motor_current is constant"),
        ("kilo.npz", "refuse: kilo: the drive torque from motor_current is 0.00"),
        ("shuffled.npz", "refuse: shuffled: time runs backwards"),
        ("parted.npz", "in 100 stretches are too few for a kernel"),
    ],
)
def test_a_check_that_fails_is_an_answer(
    record: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", record, "--joint", "joint.toml"]) == 1
    out, err = capsys.readouterr()
    assert expected in out
    assert err == ""


def test_a_torque_that_is_next_to_nothing_is_doubted(capsys: pytest.CaptureFixture[str]) -> None:
    """Its square is no number any more; the doubt is that of any other scale."""
    assert main(["check", "tiny.npz", "--joint", "joint.toml"]) == 0
    assert "warn: tiny: the drive torque from motor_current is" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("record", "why"),
    [
        ("unequal", "has {} values where the rest has {}"),
        ("complex", "holds complex numbers"),
    ],
)
def test_a_channel_that_is_lost_is_a_warning_with_its_cause(
    record: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    count = len(good()["time_s"])
    assert main(["check", f"{record}.npz"]) == 0
    out = capsys.readouterr().out
    why = why.format(count - 7, count)
    said = f"column 'link_torque_Nm' {why}: save it as plain numbers, one for each sample"
    assert f"  warn: {record}: link_torque is lost, {said}\n" in out
    with pytest.raises(InputError, match=re.escape(f"[columns] link_torque: {said}")):
        read(f"{record}.npz", columns={"link_torque": "link_torque_Nm"})


def test_what_is_no_column_of_a_known_name_is_a_note(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "spare.npz"]) == 0
    out = capsys.readouterr().out
    assert "  note: left out: spare holds complex numbers\n" in out
    assert "is lost" not in out


STREAMS = {
    "no standard output": ("check run.npz >&-", 0),
    "no standard error": ("check lost.npz 2>&-", 2),
    "no standard error, and a check that fails": ("check zeros.npz --joint joint.toml 2>&-", 1),
    "standard error is full": ("check lost.npz 2>/dev/full", 2),
    "no stream at all": ("check run.npz --json x.json <&- >&- 2>&-", 0),
}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
@pytest.mark.parametrize("name", STREAMS)
def test_streams_that_are_closed_do_not_change_the_answer(name: str, place: Path) -> None:
    """Standard error that nobody can read turned "unusable input" into "a check failed"."""
    words, code = STREAMS[name]
    done = subprocess.run(
        ["bash", "-c", f'"{sys.executable}" -m workbench {words}'],
        cwd=place,
        check=False,
        capture_output=True,
        timeout=60,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == code, done.stderr
    written = place / "x.json"
    assert written.exists() == ("x.json" in words)
    if written.exists():
        assert written.read_text().startswith("{")
        written.unlink()
