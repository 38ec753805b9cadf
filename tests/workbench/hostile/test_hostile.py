"""Inputs that mean no good: each ends with its code and one line that says what, and where."""

from __future__ import annotations

import gzip
import io
import json
import shlex
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import EFFECTS, JointModel
from identification.balance.memory import cache_of
from identification.balance.sensing import check_alike, sense
from identification.crash import FOLDER
from identification.data.joint_file import load_joint
from identification.data.own_effects import STORE
from identification.data.plain_text import from_toml
from identification.data.record import Record
from irj_fmu.command_line import LONGEST
from workbench.cli.main import main

Content = str | bytes
JOINT = """[joint]
name = "axis"
gear_ratio = -160.0
motor_constant = 0.0553
model = "hd3"
effects = ["viscous", "coulomb", "gravity"]
"""
LEARNED = JOINT.replace('"gravity"', '"learned_position@motor"')
KNOT = '[known]\nmotor_learned_position_01 = { value = 1.0, unit = "N.m", side = "SIDE" }\n'


def law(text: str, on: str = '"motor"', parameter: str = "c=0..1 N.m") -> str:
    return f'{JOINT}[laws]\nx = {{ law = "{text}", on = [{on}], parameters = ["{parameter}"] }}\n'


def known(entry: str) -> str:
    return f"{JOINT}[known]\n{entry}\n"


def fitted(entry: str) -> str:
    return f"{JOINT}[fitted]\nstiffness = {entry}\n"


def own(name: str, entry: str = '{ sha256 = "0", keys = ["zz"] }') -> str:
    return f'{JOINT}[own_effects]\n"{name}" = {entry}\n'


JOINTS: dict[str, tuple[Content, str]] = {
    "empty": ("", "no [joint] table"),
    "list of tables": ("[[joint]]\ngear_ratio = 1\n", "joint must be a table"),
    "no text": (b"\xff\xfe\x00\xd8" * 20, "not a text file"),
    "zeros": (bytes(500), "not valid TOML"),
    "surrogate": (JOINT.replace("axis", "\\ud800"), "not valid TOML"),
    "key twice": (JOINT + 'model = "hd1"\n', "not valid TOML"),
    "unknown table": (JOINT + "[x]\n", "unknown table [x]"),
    "unknown key": (JOINT + "provenance = [1]\n", "unknown key 'provenance'"),
    "ratio of text": (JOINT.replace("-160.0", '"160"'), "gear_ratio = '160'"),
    "ratio is a date": (JOINT.replace("-160.0", "2024-01-02"), "gear_ratio"),
    "ratio true": (JOINT.replace("-160.0", "true"), "gear_ratio = True"),
    "ratio infinite": (JOINT.replace("-160.0", "-inf"), "gear_ratio = -inf"),
    "ratio tiny": (JOINT.replace("-160.0", "1e-320"), "out of what can be computed"),
    "ratio huge": (JOINT.replace("-160.0", "1e300"), "out of what can be computed"),
    "constant nan": (JOINT.replace("0.0553", "nan"), "motor_constant = nan"),
    "volts of nothing": (JOINT + "torque_per_voltage = 0\n", "torque_per_voltage is 0"),
    "model is a list": (JOINT.replace('"hd3"', '["hd3"]'), "is not known"),
    "kind unknown": (JOINT + 'kind = "helical"\n', "kind = 'helical'"),
    "kind a table": (JOINT + "kind = { a = 1 }\n", "use one of rotary, linear"),
    "name a list": (JOINT.replace('"axis"', '["a"]'), "name must be a text"),
    "effects of numbers": (JOINT.replace('"coulomb"', "3"), "list of names"),
    "effect with a path": (JOINT.replace("coulomb", "../../etc/passwd"), "unknown effect"),
    "effect with a zero byte": (JOINT.replace("coulomb", "cou\\u0000lomb"), "cou\\x00lomb"),
    "effect at no place": (JOINT.replace("coulomb", "coulomb@"), "'coulomb@' is not understood"),
    "effect at two places": (JOINT.replace("coulomb", "coulomb@motor@link"), "not on 'motor@link'"),
    "effect of no number": (JOINT.replace("coulomb", "coulomb#"), "'coulomb#' is not understood"),
    "effect of number 0": (JOINT.replace("coulomb", "coulomb#0"), "is not understood"),
    "effect below zero": (JOINT.replace("coulomb", "coulomb#-1"), "is not understood"),
    "effect of a long number": (JOINT.replace("coulomb", "coulomb#" + "9" * 5000), "understood"),
    "effect of no name": (JOINT.replace("coulomb", ""), "unknown effect ''"),
    "effect of a long name": (JOINT.replace("coulomb", "c" * 100_000), "unknown effect 'ccc"),
    "virtual work of text": (JOINT + 'virtual_work = "yes"\n', "use true or false"),
    "known is a list": (JOINT + "[[known]]\nstiffness = 1\n", "known must be a table"),
    "known of text": (known('stiffness = "stiff"'), "[known] stiffness must be a number"),
    "known true": (known("stiffness = true"), "value = True is not a finite number"),
    "known nan": (known("stiffness = nan"), "value = nan is not a finite number"),
    "known empty": (known("stiffness = {}"), "neither value nor low nor high"),
    "known dotted": (known("stiffness.value.deep = 1"), "is not a finite number"),
    "unit a number": (known("stiffness = { value = 1, unit = 3 }"), "j.toml: [known] stiffness"),
    "unit empty": (known('stiffness = { value = 1, unit = "" }'), "[known] stiffness: the unit"),
    "side a list": (known("stiffness = { value = 1, side = [1] }"), "side = [1] is not known"),
    "orders nan": (known("orders = [nan]"), "[known] orders"),
    "pitch of a rotary joint": (known("pitch = 1"), "[known] pitch"),
    "a knot on the motor side": (LEARNED + KNOT.replace("SIDE", "motor"), "on the link side"),
    "fitted list": (fitted("[]"), "[fitted] stiffness must be a table"),
    "fitted nan": (fitted("{ value = nan }"), "value = nan is not a finite number"),
    "error below zero": (fitted("{ value = 1e4, stderr = -1 }"), "stderr = -1 is below zero"),
    "error infinite": (fitted("{ value = 1e4, stderr = inf }"), "stderr = inf is not a finite"),
    "law that calls": (law("__import__('os')"), "[laws] x: column 1"),
    "law without end": (law("(" * 3000), "500 are the most"),
    "law of powers": (law("c*v^9^9^9^9"), "is larger than 16"),
    "law empty": (law(""), "the law is empty"),
    "law on nothing": (law("c*v", on=""), "needs a place"),
    "law on mars": (law("c*v", on='"mars"'), "place 'mars'"),
    "law that falls": (law("c*v", parameter="c=5..1 N.m"), "must rise and be finite"),
    "law of nothing": (law("c*v/0"), "[laws] x: the law"),
    "law of code": (law("c*v").replace("x =", '"x();import os" ='), "small letters"),
    "laws of numbers": (JOINT + "[laws]\nx = 3\n", "[laws] x must be a table"),
    "own effects of numbers": (own("a.py", "3"), "must be a table"),
    "own effects of a device": (own("/dev/zero"), "is not there"),
    "own effects of a folder": (own("/tmp"), "is not there"),
    "own effects of a zero byte": (own("a\\u0000b"), "a\\x00b is not there"),
    "own effects of a long name": (own("a" * 5000), "is not there"),
}
EFFECT = """
import casadi as ca
from casadi_models import amplitude, effect

@effect("hostile", title="t", family="friction", acts_on=("motor",),
        parameters=(amplitude("size", "N.m", "m"),), absence="", excitation="", source="")
def law(s, p):
    return p.size * s.direction
"""
RETURN = "return p.size * s.direction"
SIZE = 'amplitude("size", "N.m", "m"),'


def returns(text: str) -> str:
    return EFFECT.replace(RETURN, f"return {text}")


EFFECT_FILES: dict[str, tuple[Content, str]] = {
    "empty": ("", "declares no effect"),
    "bytes": (bytes(range(256)), "SyntaxError"),
    "no syntax": ("def (", "SyntaxError"),
    "deep": ("(" * 5000, "SyntaxError"),
    "ends the program": ("import sys\nsys.exit('bye')", "SystemExit"),
    "ends a generator": ("raise GeneratorExit", "GeneratorExit"),
    "raises what nobody catches": ("raise BaseException('x')", "BaseException"),
    "no end": ("def f(): f()\nf()", "RecursionError"),
    "key of the library": (EFFECT.replace("hostile", "coulomb"), "is registered already"),
    "key of two words": (EFFECT.replace("hostile", "a b"), "letters, digits and underscores"),
    "key a number": (EFFECT.replace('"hostile"', "3"), "letters, digits and underscores"),
    "nan": (returns("p.size * float('nan')"), "no finite number"),
    "infinite": (returns("p.size * 1e999"), "no finite number"),
    "a constant": (returns("ca.SX(1)"), "none of its parameters"),
    "a symbol of its own": (returns("p.size * ca.SX.sym('q')"), "symbol 'q' of its own"),
    "a text": (returns("'x'"), "not an expression"),
    "a law in a law": (returns("law(s, p)"), "RecursionError"),
    "a branch": (returns("p.size if s.velocity > 0 else -p.size"), "truth value"),
    "lines": (EFFECT.replace(RETURN, "raise ValueError('a\\nb\\x1b[31mc')"), "a b\\x1b[31mc"),
    "unit a number": (EFFECT.replace('"N.m"', "3"), "cannot be used as effects"),
    "one name twice": (EFFECT.replace(SIZE, SIZE * 2), "two parameters are called 'size'"),
    "needs itself": (EFFECT.replace('source=""', 'source="", needs=("hostile",)'), "needs itself"),
    "needs a stranger": (EFFECT.replace('source=""', 'source="", needs=("zz",)'), "'zz'"),
}
T = np.arange(60) * 0.01
TABLE = {"time_s": T, "motor_current_A": np.sin(T), "motor_position_rad": np.cos(T)}


def csv(table: Mapping[str, npt.NDArray[np.float64]] = TABLE) -> str:
    rows = np.column_stack(list(table.values())).tolist()
    return "\n".join([",".join(table), *(",".join(map(repr, row)) for row in rows)]) + "\n"


def npz(**arrays: npt.NDArray[np.generic]) -> bytes:
    out = io.BytesIO()
    np.savez(out, **arrays)  # type: ignore[arg-type]
    return out.getvalue()


def zipped(content: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name in ("time_s.npy", "motor_current_A.npy"):
            archive.writestr(name, content)
    return out.getvalue()


def pickled() -> bytes:
    out = io.BytesIO()
    np.save(out, np.array([{"a": 1}, print], dtype=object), allow_pickle=True)
    return zipped(out.getvalue())


def header(text: str) -> bytes:
    head = text.encode().ljust(117) + b"\n"
    return zipped(b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head)


def shaped(shape: str, kind: str = "<f8") -> bytes:
    return header(f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}")


ROWS = csv()
RECORDS: dict[str, tuple[str, Content, str]] = {
    "one byte": ("r.csv", b"\x00", "is not a text file"),
    "one letter": ("r.csv", "a", "no row of numbers"),
    "lines of nothing": ("r.csv", "\n" * 1000, "is empty"),
    "no header": ("r.csv", ROWS.partition("\n")[2], "no column is recognised as time"),
    "a cell too many": ("r.csv", ROWS.replace("\n0.1,", "\n0.1,7,", 1), "line 12: 4 cells"),
    "one long line": ("r.csv", "time_s," + "x" * 1_000_000, "no table of numbers"),
    "a page": ("r.csv", "<html><body>Not found</body></html>\n", "no row of numbers"),
    "an open quote": ("r.csv", ROWS.replace("\n0.1,", '\n"0.1,', 1), "line 12"),
    "dates": ("r.csv", "time_s,motor_current_A\n" + "2024-01-02 03:04,1\n" * 30, "a date"),
    "units in cells": ("r.csv", "time_s,motor_current_A\n" + "1,2 A\n" * 30, "'2 A'"),
    "unit unknown": ("r.csv", ROWS.replace("current_A", "current_furlong"), "'furlong'"),
    "a name twice": ("r.csv", ROWS.replace("position_rad", "current_A"), "more than once"),
    "half a character": ("r.csv", ROWS.encode("utf-16")[:-1], "is not a number"),
    "half surrogates": ("r.csv", b"\xff\xfe" + b"\x00\xd8" * 400, "no row of numbers"),
    "packed nothing": ("r.csv.gz", gzip.compress(b""), "is empty"),
    "packed, cut": ("r.csv.gz", gzip.compress(ROWS.encode())[:-9], "not a readable packed file"),
    "packed, not": ("r.csv.gz", b"\x1f\x8b" + b"a" * 100, "not a readable packed file"),
    "an empty archive": ("r.npz", b"PK\x05\x06" + bytes(18), "is not a NPZ file"),
    "pickled": ("r.npz", pickled(), "holds Python objects"),
    "a huge shape": ("r.npz", shaped("(99999999999999,)"), "is cut off"),
    "a shape below zero": ("r.npz", shaped("(-5,)"), "not a readable NPZ"),
    "a huge item": ("r.npz", shaped("(50,)", "<U999999999"), "not a readable NPZ"),
    "a header of code": ("r.npz", header("__import__('os').getcwd()"), "not a readable NPZ"),
    "complex": ("r.npz", npz(time_s=T, motor_current_A=T * 1j), "as a channel"),
    "texts": ("r.npz", npz(time_s=T, motor_current_A=np.array(["a"] * 60)), "is not numeric"),
    "boxes": ("r.npz", npz(time_s=np.zeros((3, 3, 3))), "no numeric vector"),
    "unequal": ("r.npz", npz(time_s=T, a=T[1:], b=T[1:]), "no column is recognised as time"),
    "no MAT": ("r.mat", "not a mat", "is not a MAT file"),
    "no HDF5": ("r.h5", b"\x89HDF\r\n\x1a\n" + b"\xff" * 600, "is not a readable HDF5 file"),
    "no Parquet": ("r.parquet", b"PAR1" + b"\xff" * 600 + b"PAR1", "not a readable Parquet"),
    "no MCAP": ("r.mcap", b"\x89MCAP0\r\n" + b"\xff" * 600, "is not a readable MCAP file"),
    "no bag": ("r.db3", b"SQLite format 3\x00" + b"\xff" * 600, "metadata.yaml is missing"),
}
REFUSED: dict[str, tuple[Mapping[str, npt.NDArray[np.float64]], str]] = {
    "time of nan": ({**TABLE, "time_s": T * np.nan}, "time is not a number in 60 of 60 rows"),
    "endless time": ({**TABLE, "time_s": T + np.inf}, "time is not a number in 60 of 60 rows"),
    "time that stands": ({**TABLE, "time_s": T * 0}, "repeat the one before"),
    "time backwards": ({**TABLE, "time_s": -T}, "time runs backwards"),
    "time of no clock": ({**TABLE, "time_s": T * 1e-300}, "correct the unit of time"),
    "a stamp far away": ({**TABLE, "time_s": np.where(T > 0.4, T + 4e149, T)}, "time jumps by"),
    "huge time": ({**TABLE, "time_s": T * 1e308}, "no sensor reads that"),
    "huge current": ({**TABLE, "motor_current_A": 1.7e308 * np.sin(9 * T)}, "no sensor reads that"),
    "endless current": ({**TABLE, "motor_current_A": T + np.inf}, "leave"),
}
ARGUMENTS: dict[str, tuple[str, str]] = {
    "no name": ("check ''", "is a folder"),
    "a long name": (f"check {'x' * 5000}", "File name too long"),
    "a device": ("check /dev/null", "is empty"),
    "a joint file as record": ("check J", "no column is recognised as time"),
    "seed of many digits": (f"simulate --joint J -o O --seed {'9' * 5000}", "invalid int value"),
    "seed below zero": ("simulate --joint J -o O --seed -1", "--seed -1"),
    "rate nan": ("simulate --joint J -o O --rate nan", "--rate takes 1 to 100000"),
    "seconds without end": ("simulate --joint J -o O --seconds inf", "--seconds 0.5 to 10000"),
    "value nan": ("simulate --joint J -o O --set stiffness=nan", "stiffness lies between"),
    "value of nothing": ("simulate --joint J -o O --set =3", "no parameter ''"),
    "hidden nothing": ("simulate --joint J -o O --hide ''", "unknown effect ''"),
    "hidden without number": ("simulate --joint J -o O --hide stribeck#x", "not understood"),
    "hidden without place": ("simulate --joint J -o O --hide stribeck@", "not understood"),
    "no output": ("simulate --joint J -o ''", "the name of a result file is empty"),
    "no record's name": ("simulate --joint J -o O.xlsx", "written as .csv or .npz"),
    "steps below zero": ("improve J --joint J --max-steps -1", "a whole number from 0 up"),
    "no port": ("app --port 99999", "a port from 0 to 65535"),
    "no system file": ("add stribeck --joint J -o /proc/x", "not writable"),
    "effect of no name": ("add '' --joint J -o O", "unknown effect ''"),
    "effect again": ("add coulomb --joint J -o O", "is in the model already"),
    "key with a path": (
        "add --law c*v --on motor --parameter 'c=1..2 N.m.s/rad' --key ../x --joint J -o O",
        "small letters",
    ),
    "law of no parameter": ("add --law 0/0 --on motor --joint J -o O", "has no parameter"),
    "effects of no name": ("effects ''", "no effect ''"),
    "speed nan": ("show --joint J --compensation --max-speed nan", "must be positive"),
    "limit of nothing": ("plan --joint J -o O --max-position 0", "give a limit above 0"),
    "a study that is a joint": ("batch J --dry-run", "unknown key 'joint'"),
    "a root as report": ("report J --joint J -o /", "is a folder"),
    "an input as result": ("check J --json J", "would be lost"),
    "a device as code": ("--effects /dev/zero effects", "no such file"),
    "a ratio to compute nothing with": ("import J --gear-ratio 1e300 -o O", "gear_ratio = 1e+300"),
    "a calibration on its record": ("accelerometer --up J --down x --json J", "would be lost"),
    "a joint on the one it follows": ("joint new x.fmu --record x --like J -o J", "would be lost"),
    "a picture in a format it is not": (
        "linear x --picture O.png",
        "is written as SVG; name it o.svg",
    ),
    "variants in no folder": (
        "explore x --joint J --held-out y --out /proc/x",
        "cannot write there",
    ),
    "a report on a result it reads": ("report x --joint x --beside J -o J", "would be lost"),
}


@pytest.fixture(autouse=True)
def library(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Laws and effects of these files do not stay in the library of the other tests."""
    monkeypatch.setattr(EFFECTS, "_effects", dict(EFFECTS._effects))
    with EFFECTS.scoped():
        yield


@pytest.fixture(autouse=True)
def _kept_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER, str(tmp_path / "crashes"))
    monkeypatch.setenv(STORE, str(tmp_path / "allowed"))


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one line of a command that must end with 2 and print nothing."""
    capsys.readouterr()
    try:
        code: object = main(list(words))
    except SystemExit as stopped:
        code = stopped.code
    out, err = capsys.readouterr()
    assert code == 2, err
    assert out == ""
    assert err.startswith("irj: ")
    assert err.endswith("\n")
    assert err[:-1].isprintable()
    assert len(err) <= LONGEST + 100
    return err


@pytest.mark.parametrize("name", JOINTS)
def test_joint_file(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, expected = JOINTS[name]
    path = tmp_path / "j.toml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    before = path.read_bytes()
    line = refused(capsys, "add", "stribeck", "--joint", str(path), "-o", str(path))
    assert expected in line
    assert "j.toml" in line
    assert path.read_bytes() == before


@pytest.mark.parametrize("name", EFFECT_FILES)
def test_effect_file(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, expected = EFFECT_FILES[name]
    path = tmp_path / "own.py"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    keys = set(EFFECTS)
    assert expected in refused(capsys, "--effects", str(path), "effects")
    assert set(EFFECTS) == keys


@pytest.mark.parametrize("name", RECORDS)
def test_record(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, content, expected = RECORDS[name]
    path = tmp_path / file
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    line = refused(capsys, "check", str(path))
    assert expected in line
    assert file in line


@pytest.mark.parametrize("name", REFUSED)
def test_record_that_can_be_read(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A check that fails is an answer (1); work on such a record is refused (2)."""
    table, expected = REFUSED[name]
    path = tmp_path / "r.csv"
    path.write_text(csv(table))
    capsys.readouterr()
    assert main(["check", str(path)]) == 1
    out, err = capsys.readouterr()
    assert err == ""
    assert any(line.startswith("  refuse: ") and expected in line for line in out.splitlines())
    (tmp_path / "j.toml").write_text(JOINT.replace("hd3", "hd1"))
    assert expected in refused(capsys, "fit", str(path), "--joint", str(tmp_path / "j.toml"))


@pytest.mark.parametrize("name", ARGUMENTS)
def test_arguments(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words, expected = ARGUMENTS[name]
    (tmp_path / "j.toml").write_text(JOINT)
    places = {"J": str(tmp_path / "j.toml"), "O": str(tmp_path / "o.csv"), "''": ""}
    given = [places.get(w, w.replace("O.", f"{tmp_path}/o.")) for w in shlex.split(words)]
    assert expected in refused(capsys, *given)
    assert [p.name for p in tmp_path.iterdir()] == ["j.toml"]


RUN_T = np.arange(400) * 0.01
RUN = {
    "time_s": RUN_T,
    "motor_current_A": np.sin(9 * RUN_T) + np.sin(2 * RUN_T),
    "motor_position_rad": np.cos(9 * RUN_T) - np.cos(2 * RUN_T),
}
ON_A_RUN = {
    "a filter of no band": ("prefilter R --cutoff 1e-9 -o O", "raise the cut-off"),
    "a filter below zero": ("prefilter R --cutoff -1 -o O", "must be above 0"),
    "a filter of a high order": ("prefilter R --order 1000 -o O", "more than 3003 are needed"),
    "no sample kept": ("prefilter R --every 0 -o O", "must be at least 1"),
    "one sample kept": (f"prefilter R --every 1{'0' * 30} -o O", "a second one"),
    "all but nine samples trimmed": ("prefilter R --trim 196 -o O", "8 samples are left"),
    "a sample of a hundred kept": (
        "prefilter R --every 100 -o O",
        "give a smaller --trim or --every",
    ),
    "one sample for a linear model": ("linear R --every 100000", "give a smaller --every"),
    "volts without end": (
        "accelerometer --up B --down R --column motor_current_A",
        "no sensor reads that",
    ),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ON_A_RUN)
def test_absurd_numbers_on_a_run(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, expected = ON_A_RUN[name]
    (tmp_path / "r.csv").write_text(csv(RUN))
    (tmp_path / "b.csv").write_text(csv({**RUN, "motor_current_A": RUN_T + 1e308}))
    places = {k: str(tmp_path / f"{k.lower()}.csv") for k in "RBO"}
    assert expected in refused(capsys, *(places.get(w, w) for w in words.split()))
    assert not (tmp_path / "o.csv").exists()


def test_the_next_command_of_an_import_can_be_pasted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, joint = tmp_path / "läuf 1.csv", tmp_path / "axis 1.toml"
    path.write_text(csv(RUN))
    assert main(["import", str(path), "-o", str(joint)]) == 0
    line = next(x for x in capsys.readouterr().out.splitlines() if "next: " in x)
    said = shlex.split(line.partition("next: ")[2])
    assert said == ["irj", "check", str(path), "--joint", str(joint)]


TWO_POSITIONS = {
    "time_s": RUN_T,
    "motor_position_rad": -160 * (np.sin(2 * RUN_T) + 1e-3 * np.sin(9 * RUN_T)),
    "link_position_rad": np.sin(2 * RUN_T),
}


def test_no_drive_is_said_by_what_could_be_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, joint = tmp_path / "r.csv", tmp_path / "j.toml"
    path.write_text(csv(TWO_POSITIONS))
    joint.write_text(JOINT)
    line = refused(capsys, "track", str(path), "--joint", str(joint))
    assert "no motor_torque, motor_current or motor_voltage says what drives the joint" in line
    prepared = set(cache_of("prepared").kept)
    assert "do not say what drives" in refused(capsys, "next", str(path), "--joint", str(joint))
    assert set(cache_of("prepared").kept) == prepared, "it is said before anything is fitted"


RESULT = {"steps": [{}], "verdict": "complete", "records": [], "claims": []}
HELD = {"held_out": {"relative_error_percent": 1.0, "balances": {}}}
RESULTS: dict[str, object] = {
    "steps a number": {**RESULT, "steps": 3},
    "steps a text": {**RESULT, "steps": "all"},
    "steps of numbers": {**RESULT, "steps": [3]},
    "a step of nothing": RESULT,
    "an error of text": {
        **RESULT,
        "steps": [{**HELD, "held_out": {"relative_error_percent": "x", "balances": {}}}],
    },
    "balances a list": {
        **RESULT,
        "steps": [{**HELD, "held_out": {"relative_error_percent": 1.0, "balances": [1]}}],
    },
    "parameters a list": {**RESULT, "steps": [{**HELD, "parameters": [1]}]},
    "a parameter of nothing": {**RESULT, "steps": [{**HELD, "parameters": {"a": {}}}]},
}


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_that_is_none(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, joint = tmp_path / "other.json", tmp_path / "j.toml"
    path.write_text(json.dumps(RESULTS[name]))
    joint.write_text(JOINT)
    words = ["--joint", str(joint), "--beside", str(path), "-o", str(tmp_path / "o.html")]
    line = refused(capsys, "report", "x.csv", "--held-out", "y.csv", *words)
    assert f"{path}: is no whole result" in line


def test_parts_of_a_record_of_a_rigid_joint_are_alike() -> None:
    """Whether a part shows a twist beside its torque is no matter of its channels."""
    twist = 1e-3 * np.sin(9 * RUN_T)
    channels = {
        "motor_position": -160 * (np.sin(2 * RUN_T) + twist),
        "link_position": np.sin(2 * RUN_T),
    }
    model = JointModel.by_name("hd1", -160.0)
    loud = Record.from_channels(RUN_T, {**channels, "link_torque": 1e4 * twist}, name="a")
    other = Record.from_channels(RUN_T, {**channels, "link_torque": np.cos(31 * RUN_T)}, name="b")
    assert "transmission" in sense(loud, model).balances
    assert check_alike([loud, other], model).balances == ("link",)
    assert check_alike([other, loud], model).balances == ("link",)


def test_a_joint_file_is_no_record_to_import(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "j.toml", tmp_path / "o.toml"
    path.write_text(JOINT)
    assert main(["import", str(path), "-o", str(out)]) == 2
    assert capsys.readouterr().err.startswith(f"irj: {path}: no column is recognised as time")
    assert not out.exists()


def test_a_zero_byte_in_an_argument(capsys: pytest.CaptureFixture[str]) -> None:
    assert "zero byte" in refused(capsys, "check", "a\0b")


# --- what is right stays --------------------------------------------------------------------------


def test_a_knot_of_a_curve_on_its_own_side(tmp_path: Path) -> None:
    """On the link, or where the motor turns the same way, the curve does not run backwards."""
    path = tmp_path / "j.toml"
    for text in (
        LEARNED + KNOT.replace("SIDE", "link"),
        LEARNED.replace("-160", "160") + KNOT.replace("SIDE", "motor"),
    ):
        path.write_text(text)
        value = load_joint(path).known["motor_learned_position_01"].value
        assert value == pytest.approx(160.0 if "motor" in text.partition("side")[2] else 1.0)


WHOLE = """# axis 3 of the second cell
[joint]
name = "effects = [1] ]"  # a trap
gear_ratio = -160.0
motor_constant = 0.0553
model = "hd3"
effects = ["viscous", "coulomb@motor",
  "coulomb@link"]  # as fitted

[known]
motor_inertia = { value = 4.4, unit = "kg.m2", side = "link", source = "catalogue", note = "p. 3" }

[columns]
time = { column = "t", unit = "s" }

[fitted]
motor_viscous = { value = 12.5, stderr = 0.1, unit = "N.m.s/rad", side = "link" }

[calibration]
"zero of link_position in a" = { value = 1e-3, stderr = 1e-5, unit = "rad" }

[provenance]
records = "a.csv"
date = 2024-01-02T03:04:05Z
"""


@pytest.mark.parametrize("text", [WHOLE, WHOLE.replace('effects = ["', 'effects=[\n"')])
@pytest.mark.parametrize("in_place", [True, False])
def test_an_effect_is_added_and_nothing_is_lost(text: str, in_place: bool, tmp_path: Path) -> None:
    path = tmp_path / "j.toml"
    target = path if in_place else tmp_path / "o.toml"
    path.write_text(text)
    assert main(["add", "stribeck", "--joint", str(path), "-o", str(target)]) == 0
    before, after = from_toml(text, "a"), from_toml(target.read_text(), "b")
    assert after["joint"].pop("effects") == [*before["joint"].pop("effects"), "stribeck"]
    assert after == before
    assert "# axis 3 of the second cell" in target.read_text()
    assert load_joint(target).fitted == {"motor_viscous": 12.5}
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted({path.name, target.name})


def test_laws_are_added_one_after_the_other(tmp_path: Path) -> None:
    path = tmp_path / "j.toml"
    path.write_text('joint = { gear_ratio = 2.0, model = "hd1" }\nfitted.inertia.value = 2.0\n')
    for key in ("first_law", "second_law"):
        words = ["--law", "c*tanh(v/b)", "--on", "motor", "--key", key, "--joint", str(path)]
        given = [f"{p}={r}" for p, r in (("c", "0..1 N.m"), ("b", "0.1..1 rad/s"))]
        words += [w for p in given for w in ("--parameter", p)]
        assert main(["add", *words, "-o", str(path)]) == 0
    joint = load_joint(path)
    assert joint.effects == ("first_law", "second_law")
    assert set(joint.laws) == {"first_law", "second_law"}
    assert joint.fitted == {"inertia": 2.0}
