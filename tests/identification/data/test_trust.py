"""A crash is not an answer, what is written reads back, and no file ends the program."""

from __future__ import annotations

import ast
import asyncio
import bz2
import datetime as dt
import gc
import gzip
import hashlib
import lzma
import os
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import h5py
import httpx
import numpy as np
import numpy.typing as npt
import pytest
import scipy.io
from mcap.writer import Writer

from casadi_models import EFFECTS
from identification.crash import FOLDER, KEPT, internal_error
from identification.data.joint_file import load_joint
from identification.data.plain_text import from_json, from_toml, toml_key, toml_value
from identification.data.read import _child, open_table, read
from identification.data.units import base_unit
from identification.errors import InputError
from irj_fmu.command_line import run_alone
from workbench.cli import library
from workbench.cli.main import main
from workbench.page.export import session_code
from workbench.page.server import create_app
from workbench.page.session import State, Store
from workbench.page.views import VIEWS

DEMO = Path(__file__).resolve().parents[3] / "workbench" / "demo"
EFFECT = """
import sys
import casadi as ca
from casadi_models import amplitude, effect

@effect("fault_of_a_file", title="t", family="friction", acts_on=("motor",),
        parameters=(amplitude("size", "N.m", "m"),), absence="", excitation="", source="")
def law(s, p):
    return p.size * s.direction
"""

Said = Callable[..., str]


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Said:
    """Run a command that must end with a code and say exactly one line."""

    def run(*words: str, code: int = 2) -> str:
        capsys.readouterr()
        assert main(list(words)) == code
        out, err = capsys.readouterr()
        assert out == ""
        assert err.startswith("irj: ")
        assert err.count("\n") == 1, err
        return err

    return run


# --- an error of the program itself ---------------------------------------------------------------


def test_an_internal_error_is_no_answer(
    said: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: object) -> int:
        raise ZeroDivisionError("of the\nprogram")

    monkeypatch.setenv(FOLDER, str(tmp_path / "kept"))
    monkeypatch.setattr(library, "run_effects", broken)
    line = said("effects", code=3)
    assert "internal error (ZeroDivisionError: of the program)" in line
    (trace,) = (tmp_path / "kept").iterdir()
    assert str(trace) in line
    assert trace.stat().st_mode & 0o077 == 0
    text = trace.read_text()
    assert text.startswith("irj effects\n")
    assert "Traceback" in text
    assert "raise ZeroDivisionError" in text


def test_a_program_of_its_own_says_the_same(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: object) -> int:
        return {}["nothing"]

    def refused(_: object) -> int:
        raise InputError("give another")

    monkeypatch.setenv(FOLDER, str(tmp_path))
    assert run_alone(broken, []) == 3
    assert run_alone(refused, []) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 2
    assert "KeyError" in err.splitlines()[0]


def test_traces_do_not_fill_a_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER, str(tmp_path))
    for _ in range(KEPT + 5):
        internal_error(ValueError("again"))
    assert len(list(tmp_path.iterdir())) == KEPT
    monkeypatch.setenv(FOLDER, "/proc/no/such/place")
    assert "could not be kept" in internal_error(ValueError("again"))


# --- causes that were tracebacks ------------------------------------------------------------------


@pytest.mark.parametrize(
    "number", ["1" * 400, "1" * 5000, "[" * 5000 + "]" * 5000, "[" * 60 + "]" * 60]
)
@pytest.mark.parametrize("verb", [("add", "stribeck"), ("check", str(DEMO / "train.npz"))])
def test_toml_that_no_number_can_hold(
    number: str, verb: tuple[str, ...], said: Said, tmp_path: Path
) -> None:
    path = tmp_path / "j.toml"
    path.write_text(f"[joint]\ngear_ratio = {number}\n")
    output = ("-o", str(tmp_path / "o.toml")) if verb[0] == "add" else ()
    assert str(path) in said(*verb, "--joint", str(path), *output)


def test_plain_text_takes_what_is_right() -> None:
    assert from_toml(f"a = {2**63 - 1}\nb = [[1], [2.5]]\n", "x") == {
        "a": 2**63 - 1,
        "b": [[1], [2.5]],
    }
    assert from_json('{"a": [1, 2.5, null]}', "x") == {"a": [1, 2.5, None]}
    for text in ("[" * 100_000, "1" * 5000, "1" * 400, "{", b"\xff\xfe{"):
        with pytest.raises(InputError, match="^x: "):
            from_json(text, "x")


@pytest.mark.parametrize(
    "unit",
    [
        "s^99999999999",
        "s99999999",
        "A" + "9" * 400,
        "(" * 5000,
        "Gm12" * 16,
        "mm-12." * 10 + "m",
        "s2^2" * 8,
    ],
)
def test_units_with_absurd_exponents(unit: str, said: Said, tmp_path: Path) -> None:
    with pytest.raises(InputError):
        base_unit(unit)
    path = tmp_path / "r.csv"
    path.write_text(f"time [{unit}],motor_current [A]\n" + "".join(f"{i},1\n" for i in range(20)))
    said("check", str(path))


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("return p.size * s.direction", "pass", "returns None"),
        ("return p.size * s.direction", "return ca.vertcat(p.size, p.size)", "2 x 1"),
        ("return p.size * s.direction", "return 'x'", "not an expression"),
        ("return p.size * s.direction", "return p.sise", "sise"),
        ("return p.size * s.direction", "sys.exit(0)", "SystemExit"),
        ('acts_on=("motor",)', 'acts_on=("mars",)', "no place 'mars'"),
        ('acts_on=("motor",)', "acts_on=()", "tuple of places"),
        ('"N.m"', '"N.foo"', "unit 'N.foo'"),
        ('"friction"', '"fiction"', "no family 'fiction'"),
        ("import sys", "import sys; sys.exit(0)", "SystemExit"),
        ('source="")', 'source="", states=1, memory=lambda z, h, s, p: z[0])', "tuple of 1"),
    ],
)
def test_an_effect_that_cannot_work_is_refused_where_it_is_loaded(
    old: str, new: str, expected: str, said: Said, tmp_path: Path
) -> None:
    path = tmp_path / "own.py"
    path.write_text(EFFECT.replace(old, new))
    before = set(EFFECTS)
    assert expected in said("--effects", str(path), "effects")
    assert set(EFFECTS) == before


def test_every_effect_of_the_library_passes_that_trial() -> None:
    for effect in EFFECTS.values():
        effect.check()


def test_remarks_of_python_on_an_effect_file_are_not_printed(said: Said, tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text(EFFECT.replace('amplitude("size"', '1("size"'))
    assert "TypeError" in said("--effects", str(path), "effects")


# --- decoders in a child process ------------------------------------------------------------------

TIME = np.arange(200) * 0.01
TABLE = {"time_s": TIME, "motor_current_A": np.sin(TIME), "motor_position_rad": np.cos(TIME)}


def mat(path: Path, factor: float = 1.0) -> Path:
    scipy.io.savemat(path, {name: factor * values for name, values in TABLE.items()})
    return path


def test_what_the_child_hands_back_is_what_was_written(tmp_path: Path) -> None:
    record = read(mat(tmp_path / "r.mat"))
    assert np.array_equal(record["motor_current"], TABLE["motor_current_A"])
    again = read(mat(tmp_path / "r.mat", factor=2.0))  # the same name, the same size
    assert np.array_equal(again["motor_current"], 2 * TABLE["motor_current_A"])


def test_a_mat_file_that_kills_its_decoder_is_one_line(said: Said, tmp_path: Path) -> None:
    path = mat(tmp_path / "r.mat")
    content = bytearray(path.read_bytes())
    content[184:188] = (15).to_bytes(4, "little")  # the element of the samples says it is packed
    path.write_bytes(content)
    assert re.search(
        r"r\.mat: is damaged, its decoder fails on it \(SIG\w+\): save it again",
        said("check", str(path)),
    )
    assert read(mat(tmp_path / "good.mat")).dt == pytest.approx(0.01)


def test_a_decoder_without_end_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with h5py.File(tmp_path / "r.h5", "w") as file:
        for name, values in TABLE.items():
            # packed: the clock of a process counts in ticks of some milliseconds
            file.create_dataset(name, data=np.tile(values, 5000), compression="gzip")
    table = open_table(tmp_path / "r.h5")
    assert set(table.names) == set(TABLE)
    monkeypatch.setattr(_child, "SECONDS", 1e-5)
    monkeypatch.setattr(_child, "BYTES_PER_SECOND", 1e15)
    with pytest.raises(InputError, match="takes more than 0 s to decode"):
        read(tmp_path / "r.h5")
    assert table.load(["motor_current_A"], [])["motor_current_A"].shape == (
        1_000_000,
    )  # opened before, with its own limit


def test_bombs_take_no_memory(said: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """10 GB in a few kB of HDF5, 16 million numbers in MCAP, against 32 MB: refused; an
    archive's good columns are read without its bomb.
    """
    monkeypatch.setattr(_child, "MEMORY", 32 << 20)
    with h5py.File(tmp_path / "r.h5", "w") as file:
        for name in TABLE:
            file.create_dataset(name, (400_000_000,), "f8", chunks=(1 << 20,), compression="gzip")
    assert "too much for its size" in said("check", str(tmp_path / "r.h5"))
    with (tmp_path / "r.mcap").open("wb") as stream:
        writer = Writer(stream, chunk_size=1 << 10)
        writer.start()
        channel = writer.register_channel(
            "/drive", "json", writer.register_schema("drive", "jsonschema", b"{}")
        )
        for k in range(4):
            writer.add_message(channel, k, b'{"a": [' + b"1," * (1 << 21) + b"1]}", k)
        writer.finish()
    assert (tmp_path / "r.mcap").stat().st_size < 1 << 20
    assert "r.mcap" in said("check", str(tmp_path / "r.mcap"))
    np.savez_compressed(tmp_path / "r.npz", **TABLE, bomb=np.zeros(5_000_000))
    assert read(tmp_path / "r.npz").dt == pytest.approx(0.01)
    np.savez_compressed(
        tmp_path / "all.npz", time_s=np.zeros(3_000_000), motor_current_A=np.zeros(3_000_000)
    )
    assert "too much for its size" in said("check", str(tmp_path / "all.npz"))


# --- what is written reads back -------------------------------------------------------------------


def test_any_plain_data_reads_back_from_toml() -> None:
    data = {
        "text": 'a"b\\c\x00\x1b\n\t\u2028\x7f\xa0é\U0001f600\'\'\'"""',
        "a key \n": 1,
        "": "",
        "number": -(2**63),
        "small": 5e-324,
        "large": 1.7e308,
        "date": dt.date(2024, 2, 29),
        "moment": dt.datetime(2024, 1, 2, 3, 4, 5, 6, tzinfo=dt.UTC),
        "hour": dt.time(1, 2, 3),
        "nested": {"a.b": {"c": [1, [2.5, True], {"d": []}]}, "empty": {}},
    }
    text = "\n".join(f"{toml_key(k)} = {toml_value(v)}" for k, v in data.items())
    assert from_toml(text, "x") == data


def test_a_joint_file_with_odd_content_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "j.toml"
    path.write_text(
        '[joint]\nname = "a\\u0000\\u001b\\n\\"b\\""\ngear_ratio = -160\nmodel = '
        '"hd3"\nmotor_constant = 0.05\n'
        '[columns]\ntime = { column = "t\\u0007", unit = "s", "odd key" = 2024-01-02, nested = { '
        'a = [{ b = 1 }] } }\n"x y" = "z"\n'
        '[known]\nmotor_inertia = { value = 4.4, note = "n" }\n'
    )
    before = load_joint(path)
    assert main(["add", "stribeck", "--joint", str(path), "-o", str(path)]) == 0
    after = load_joint(path)
    assert replace(after, effects=()) == replace(before, effects=())
    assert after.effects == ("stribeck",)
    assert before.name == 'a\x00\x1b\n"b"'


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("motor_constant = 1e308", "gear_ratio times motor_constant"),
        ("motor_constant = 1e-323\n[known]\n", "gear_ratio times motor_constant"),
        (
            '[known]\nmotor_inertia = { high = 1e308, unit = "kg.m2", side = "motor" }',
            "no finite number",
        ),
    ],
)
def test_an_overflow_is_refused_where_it_is_read(
    line: str, expected: str, said: Said, tmp_path: Path
) -> None:
    path = tmp_path / "j.toml"
    path.write_text(
        f'[joint]\ngear_ratio = {-160 if "e308" in line else -0.01}\nmodel = "hd3"\n{line}\n'
    )
    content = path.read_bytes()
    assert expected in said("add", "stribeck", "--joint", str(path), "-o", str(path))
    assert path.read_bytes() == content


def csv(
    values: Mapping[str, npt.NDArray[np.float64]] = TABLE, delimiter: str = ",", comma: bool = False
) -> str:
    lines = [delimiter.join(values)]
    for row in zip(*values.values(), strict=True):
        cells = [f"{v:.9g}".replace(".", "," if comma else ".") for v in row]
        lines.append(delimiter.join(cells))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize(
    ("delimiter", "comma"),
    [(",", False), (";", True), (" ", False), (" ", True), ("   ", True), ("\t", True)],
)
def test_text_of_any_land_reads_the_same(
    encoding: str, delimiter: str, comma: bool, tmp_path: Path
) -> None:
    """The first row is of whole numbers: it does not say what parts the decimals."""
    path = tmp_path / "r.csv"
    path.write_bytes(csv(delimiter=delimiter, comma=comma).encode(encoding))
    record = read(path)
    for name, values in (
        ("motor_current", "motor_current_A"),
        ("motor_position", "motor_position_rad"),
    ):
        assert record[name] == pytest.approx(TABLE[values], abs=1e-8)
    some = read(
        path,
        {
            "time": {"column": "time_s", "unit": "s"},
            "motor_position": {"column": "motor_position_rad", "unit": "rad"},
        },
    )
    assert some["motor_position"] == pytest.approx(TABLE["motor_position_rad"], abs=1e-8)


@pytest.mark.parametrize("cell", ["1_000", "１２", "1e", "0x10", "1,5"])
def test_what_python_would_take_for_a_number_is_none(cell: str, said: Said, tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text(csv(delimiter=";").replace(";0.0998334166;", f";{cell};"), encoding="utf-8")
    assert cell in path.read_text(encoding="utf-8")
    line = said("check", str(path))
    assert "r.csv" in line
    assert cell in line


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress])
def test_a_packed_record_is_the_record(
    pack: Callable[[bytes], bytes], said: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "t"))
    (tmp_path / "t").mkdir()
    plain = mat(tmp_path / "r.mat")
    for content, name in ((csv().encode(), "r.csv.gz"), (plain.read_bytes(), "r.mat.gz")):
        path = tmp_path / name
        path.write_bytes(pack(content))
        record = read(path)
        assert record["motor_current"] == pytest.approx(TABLE["motor_current_A"], abs=1e-8)
        path.write_bytes(pack(content)[:-40])
        assert f"{path}: " in said("check", str(path))
        path.write_bytes(pack(content)[:60] + bytes(range(40)) + pack(content)[100:])
        assert f"{path}: " in said("check", str(path))
    path = tmp_path / "r.csv.gz"
    path.write_bytes(pack(b"time_s,motor_current_A\n1,1\n" + b"2,x\n" * 30))
    assert f"{path}, line 3, column 'motor_current_A'" in said("check", str(path))
    monkeypatch.setattr(_child, "MEMORY", 1 << 20)
    path.write_bytes(pack(bytes(1 << 24)))
    assert "too much for its size" in said("check", str(path))
    gc.collect()
    assert list((tmp_path / "t").iterdir()) == []


@pytest.mark.parametrize("name", ["r.csv", "r.mat", "r.npz"])
def test_a_pipe_is_read_once(name: str, tmp_path: Path) -> None:
    {"r.csv": lambda p: p.write_text(csv()), "r.mat": mat, "r.npz": lambda p: np.savez(p, **TABLE)}[
        name
    ](tmp_path / name)
    content, pipe = (tmp_path / name).read_bytes(), tmp_path / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=pipe.write_bytes, args=(content,))
    writer.start()
    record = read(pipe)
    writer.join()
    assert record["motor_current"] == pytest.approx(TABLE["motor_current_A"], abs=1e-8)
    assert record.provenance.paths == (str(pipe),)
    assert record.provenance.sha256 == (hashlib.sha256(content).hexdigest(),)


# --- the fuzz command -----------------------------------------------------------------------------


def test_a_few_damaged_files_through_every_door() -> None:
    command = [sys.executable, "-m", "tests.fuzz", "--count", "28", "--seed", "3"]
    done = subprocess.run(command, cwd=DEMO.parents[1], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "28 inputs" in done.stdout


# --- the page -------------------------------------------------------------------------------------


def test_the_page_says_an_internal_error_with_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("of the program")

    monkeypatch.setenv(FOLDER, str(tmp_path / "kept"))
    monkeypatch.setitem(VIEWS, "broken", broken)
    store = Store(tmp_path / "sessions")
    where = f"/api/session/{store.create().id}"
    transport = httpx.ASGITransport(
        app=create_app(tmp_path / "sessions", hosts=frozenset({"page"}))
    )

    async def asked() -> tuple[httpx.Response, httpx.Response]:
        async with httpx.AsyncClient(
            transport=transport, base_url="http://page", headers={"x-irj": "1"}
        ) as client:
            return await client.get(f"{where}/view/broken"), await client.post(
                f"{where}/joint", content=b"[" * 100_000
            )

    crashed, deep = asyncio.run(asked())
    assert crashed.status_code == 500
    (trace,) = (tmp_path / "kept").iterdir()
    assert str(trace) in crashed.text
    assert "ZeroDivisionError" in trace.read_text()
    assert deep.status_code == 422
    assert "nested deeper" in deep.text


def test_a_joint_file_does_not_write_code_into_the_script_of_a_session() -> None:
    text = (
        '[joint]\nname = """\nx"""\ngear_ratio = 2.0\nmodel = "hd1"\n# """); raise '
        'SystemExit("ran") #\n'
    )
    lines = [
        line
        for line in session_code(State(joint_text=text)).splitlines()
        if line.startswith("joint = ")
    ]
    assert len(lines) == 1
    (call,) = (n for n in ast.walk(ast.parse(lines[0])) if isinstance(n, ast.Constant))
    assert call.value == text.strip()
