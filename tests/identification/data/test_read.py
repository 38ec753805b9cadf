"""Reading: every format really written and read back, column maps, recognised headers, unusable
files.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from identification.data.columns import recognise
from identification.data.guess import guess_columns
from identification.data.read import read
from identification.data.record import Record
from identification.errors import InputError

N = 200
T = 0.002 * np.arange(N)
CURRENT = 2.0 * np.sin(3.0 * T)
ANGLE = np.cos(2.0 * T)
HEADER = "time_s,motor_current_A,link_position_deg"
TABLE = np.column_stack([T, CURRENT, np.rad2deg(ANGLE)])
COLUMNS = {
    "time": {"column": "t", "unit": "s"},
    "motor_current": {"column": "iq", "unit": "mA", "sign": -1},
    "link_position": {"column": "phi", "unit": "deg"},
}


def text(header: str = HEADER, table: np.ndarray = TABLE, delimiter: str = ",") -> str:
    rows = [delimiter.join(f"{value:.12g}" for value in row) for row in table]
    return "\n".join([header, *rows]) + "\n"


def write(path: Path, content: str, encoding: str = "utf-8") -> Path:
    path.write_bytes(content.encode(encoding))
    return path


def same(record: Record) -> None:
    np.testing.assert_allclose(record.time, T, atol=1e-9)
    np.testing.assert_allclose(record["motor_current"], CURRENT, atol=1e-9)
    np.testing.assert_allclose(record["link_position"], ANGLE, atol=1e-9)


# ---- text

LAYOUTS = {
    "plain": text(),
    "windows": text().replace("\n", "\r\n"),
    "no newline at the end": text().rstrip("\n"),
    "blank lines at the end": text() + "\n\n",
    "semicolon": text().replace(",", ";"),
    "decimal comma": text().replace(",", ";").replace(".", ","),
    "tab": text().replace(",", "\t"),
    "tab and decimal comma": text().replace(",", "\t").replace(".", ","),
    "spaces": text().replace(",", "   "),
    "bar": text().replace(",", " | "),
    "comments": "# bench 3\n% second\n" + text(),
    "comment inside": text().replace("\n", "\n# note\n", 40),
    "preamble": "Logger 5\nOperator: N. N.\n\n" + text(),
    "brackets": text("time [s],motor_current (A),link_position [deg]"),
    "units row": text("time,motor_current,link_position\ns,A,deg"),
    "units row in brackets": text("time,motor_current,link_position\n[s],[A],[deg]"),
    "quoted": text('"time_s","motor_current_A","link_position_deg"'),
    "delimiter at the end of lines": text().replace("\n", ",\n"),
    "byte order mark": "\ufeff" + text(),
    "other columns": "note," + text().replace("\n", "\nx,").rsplit("\n", 1)[0] + "\n",
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_text_layouts(tmp_path: Path, name: str) -> None:
    record = read(write(tmp_path / "run.csv", LAYOUTS[name]))
    same(record)
    assert record.provenance.reader == "text"


@pytest.mark.parametrize(
    ("encoding", "unit"), [("utf-16", "deg"), ("latin-1", "°"), ("utf-8", "°")]
)
def test_encodings(tmp_path: Path, encoding: str, unit: str) -> None:
    same(
        read(
            write(
                tmp_path / "run.txt",
                text(f"time_s,motor_current_A,link_position [{unit}]"),
                encoding,
            )
        )
    )


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-8-sig"])
def test_encodings_of_a_file_longer_than_its_head(tmp_path: Path, encoding: str, ends: str) -> None:
    """What is looked at ends in the middle of a line, or of a letter: what Excel calls "Unicode
    text" was no table.
    """
    t = 0.002 * np.arange(20_000)
    table = np.column_stack([t, np.sin(t), np.rad2deg(np.cos(t))])
    content = text("time_s,motor_current_A,link_position [deg]", table).replace("\n", ends)
    record = read(write(tmp_path / "run.txt", content, encoding))
    assert record.time == pytest.approx(t, abs=1e-9)
    assert record.channels["link_position"] == pytest.approx(np.cos(t), abs=1e-9)


def test_a_table_that_lies_on_its_side(tmp_path: Path) -> None:
    """Its samples would be columns without end; it took hours to say so."""
    path = write(tmp_path / "run.csv", "1," * 200_000)
    with pytest.raises(InputError, match="exchange rows and columns"):
        read(path)


def test_many_columns_are_guessed_at_once(tmp_path: Path) -> None:
    """Ten thousand names that count on: as many steps as names, not the square of that."""
    path = write(tmp_path / "run.csv", "1," * 9_999 + "1\n")
    begin = time.perf_counter()
    with pytest.raises(InputError, match=r"\(10000 in all\)"):
        read(path)
    assert time.perf_counter() - begin < 10.0


def test_path_with_spaces_and_umlauts(tmp_path: Path) -> None:
    folder = tmp_path / "Gelenk Prüfstand 3"
    folder.mkdir()
    record = read(write(folder / "größte Fahrt.csv", text()))
    same(record)
    assert record.name == "größte Fahrt"


def test_provenance_names_file_digest_and_columns(tmp_path: Path) -> None:
    import hashlib

    path = write(tmp_path / "run.csv", text())
    provenance = read(path, name="axis").provenance
    assert provenance.paths == (str(path),)
    assert provenance.sha256 == (hashlib.sha256(path.read_bytes()).hexdigest(),)
    assert provenance.columns[2] == "link_position = 'link_position_deg' [deg]"


def test_empty_cells_become_nan_only_there(tmp_path: Path) -> None:
    lines = text().splitlines()
    lines[5] = lines[5].split(",")[0] + ",,1.5"
    record = read(write(tmp_path / "run.csv", "\n".join(lines)))
    assert np.flatnonzero(np.isnan(record["motor_current"])).tolist() == [4]
    assert record["link_position"][4] == pytest.approx(np.deg2rad(1.5))
    assert np.isfinite(record["link_position"]).all()


def test_run_column_of_text_makes_segments(tmp_path: Path) -> None:
    body = "run,ok,time_s,motor_current_A\n" + "".join(
        f"{'slow' if k < 5 else 'fast one'},True,{0.1 * (k % 5)},{k}\n" for k in range(10)
    )
    record = read(write(tmp_path / "run.csv", body))
    assert record.segments() == [slice(0, 5), slice(5, 10)]
    np.testing.assert_array_equal(record["motor_current"], np.arange(10.0))
    assert "2 run(s): slow, fast one" in record.provenance.notes


def test_a_million_samples_are_read_whole(tmp_path: Path) -> None:
    n = 1_000_000
    header = (
        "time_s,motor_current_A,motor_position_rad,motor_velocity_rad_s,link_position_rad,"
        "link_velocity_rad_s,"
    )
    rng = np.random.default_rng(0)
    block = "\n".join(",".join(f"{v:.9g}" for v in row) for row in rng.normal(size=(10_000, 7)))
    path = write(
        tmp_path / "big.csv", header + "link_torque_Nm\n" + "\n".join([block] * 100) + "\n"
    )
    record = read(path)
    assert len(record) == n
    assert len(record.channels) == 6
    np.testing.assert_array_equal(record["link_torque"][-10_000:], record["link_torque"][:10_000])
    assert record["link_torque"][0] == float(block.split("\n")[0].split(",")[-1])


# ---- column maps and headers


def test_column_map_scales_and_signs(tmp_path: Path) -> None:
    table = np.column_stack([T, -1000.0 * CURRENT, np.rad2deg(ANGLE)])
    path = write(tmp_path / "run.csv", text("t,iq,phi", table))
    same(read(path, columns=COLUMNS))
    joint = tmp_path / "joint.toml"
    joint.write_text(
        '[joint]\nname = "a"\nkind = "rotary"\n[columns]\ntime = { column = "t", unit = "s" }\n'
        'motor_current = { column = "iq", unit = "mA", sign = -1 }\nlink_position = { column = '
        '"phi", unit = "deg" }\n'
    )
    same(read(path, columns=joint))
    same(read(str(path), columns=str(joint)))


def test_scaled_raw_is_in_the_unit_and_counts_are_turns(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "t,u,enc\n0,2,0\n1,-1,1024\n")
    record = read(
        path,
        kind="rotary",
        columns={
            "time": {"column": "t", "unit": "ms"},
            "motor_torque": {"column": "u", "scale": 35.0, "unit": "mNm"},
            "motor_position": {
                "column": "enc",
                "unit": "counts",
                "counts_per_turn": 4096,
                "sign": -1,
            },
        },
    )
    np.testing.assert_allclose(record.time, [0.0, 1e-3])
    np.testing.assert_allclose(record["motor_torque"], [0.07, -0.035])
    np.testing.assert_allclose(record["motor_position"], [0.0, -np.pi / 2])


def test_joint_file_says_that_the_axis_is_linear(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "time_s,motor_position_mm,motor_torque_kN\n0,1,2\n1,2,3\n")
    joint = tmp_path / "joint.toml"
    joint.write_text('[joint]\nkind = "linear"\n')
    record = read(path, columns=joint)
    assert record.kind == "linear"
    np.testing.assert_allclose(record["motor_position"], [1e-3, 2e-3])
    np.testing.assert_allclose(record["motor_torque"], [2e3, 3e3])
    with pytest.raises(InputError, match="kind = 'linear'"):
        read(path)


def test_time_from_a_step(tmp_path: Path) -> None:
    path = write(tmp_path / "arm.csv", "u,y\n" + "1,2\n" * 5)
    columns = {"time": {"step": 2.0, "unit": "ms"}, "motor_torque": {"column": "u", "unit": "Nm"}}
    np.testing.assert_allclose(read(path, columns=columns).time, 2e-3 * np.arange(5))


def test_file_without_header_has_numbered_columns(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", "0,1\n1,2\n2,4\n")
    columns = {
        "time": {"column": "column1", "unit": "s"},
        "motor_current": {"column": "column2", "unit": "A"},
    }
    np.testing.assert_array_equal(read(path, columns=columns)["motor_current"], [1.0, 2.0, 4.0])


@pytest.mark.parametrize(
    ("name", "channel", "unit"),
    [
        ("time_s", "time", "s"),
        ("time_ms", "time", "ms"),
        ("motor_current_A", "motor_current", "A"),
        ("motor_velocity_rad_s", "motor_velocity", "rad/s"),
        ("motor_velocity_rpm", "motor_velocity", "rpm"),
        ("link_acceleration_rad_s2", "link_acceleration", "rad/s2"),
        ("link_velocity_deg_s", "link_velocity", "deg/s"),
        ("link_torque_Nm", "link_torque", "Nm"),
        ("link_torque_N_m", "link_torque", "N.m"),
        ("temperature_degC", "temperature", "degC"),
        ("temperature_C", "temperature", "degC"),
        ("reference_position_rad", "reference_position", "rad"),
    ],
)
def test_headers_are_recognised(name: str, channel: str, unit: str) -> None:
    column = recognise(name)
    assert column is not None
    assert (column.channel, column.unit) == (channel, unit)


def test_unknown_columns_are_refused_with_a_guess_that_works(tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", text("t_s,iq_A,load_angle_deg"))
    with pytest.raises(InputError) as caught:
        read(path)
    message = str(caught.value)
    assert "\n" not in message
    fragment = message[message.index("columns = {") :]
    proposed = tomllib.loads(fragment)["columns"]
    assert proposed["link_position"] == {"column": "load_angle_deg", "unit": "deg"}
    same(read(path, columns=proposed))


def test_guess_gives_reasons_and_prefers_named_sides() -> None:
    guesses = {
        g.column.column: g for g in guess_columns(["t_s", "q_rad", "motor_pos_rad", "bus_flag"])
    }
    assert guesses["motor_pos_rad"].column.channel == "motor_position"
    assert guesses["q_rad"].column.channel == "link_position"
    assert "no side in the name" in guesses["q_rad"].reason
    assert "bus_flag" not in guesses


@pytest.mark.parametrize(
    ("header", "said"),
    [
        (
            "time_s,motor_current_Nm,link_position_deg",
            r"motor_current_Nm.*not a unit of motor_current",
        ),
        ("time_s,motor_current_furlong,link_position_deg", "furlong"),
        ("time_s,motor_current,link_position_deg", "does not say its unit"),
        ("time_s,motor_current_A,motor_current_mA", "both motor_current"),
        ("time_s,motor_current_A,motor_current_A", "more than once"),
        ("stamp,motor_current_A,link_position_deg", "no column is recognised as time"),
    ],
)
def test_doubtful_headers_are_refused(tmp_path: Path, header: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read(write(tmp_path / "run.csv", text(header)))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"motor_current": {"column": "nope", "unit": "A"}},
            r"motor_current: no column 'nope'.*t, iq, phi",
        ),
        (
            {"motor_current": {"column": "iq", "unit": "Nm"}},
            r"motor_current: unit 'Nm' does not fit",
        ),
        ({"motor_current": {"column": "iq"}}, "no unit"),
        ({"motor_current": {"column": "iq", "unit": "A", "sign": 2}}, "1 or -1"),
        ({"motor_current": {"column": "iq", "unit": "A", "scale": 0}}, "not zero"),
        (
            {"motor_current": {"column": "iq", "unit": "A", "scale": "2"}},
            "scale = '2' is not a finite number",
        ),
        (
            {"motor_current": {"column": "iq", "unit": "A", "factor": 2}},
            "unknown key 'factor'; known: column",
        ),
        ({"motor_current": 3}, "not a table"),
        ({"motor_amps": {"column": "iq", "unit": "A"}}, "motor_amps"),
        ({"link_position": {"column": "phi", "unit": "counts"}}, "counts_per_turn"),
        ({"motor_current": {"column": "iq", "unit": "A", "step": 1.0}}, "time only"),
    ],
)
def test_wrong_column_maps_are_refused(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    path = write(tmp_path / "run.csv", text("t,iq,phi"))
    with pytest.raises(InputError, match=said):
        read(path, columns={**COLUMNS, **change})


@pytest.mark.parametrize("content", ["[columns", "columns = 3", b"\xff\xfe\x00"])
def test_wrong_joint_file_is_refused(tmp_path: Path, content: str | bytes) -> None:
    joint = tmp_path / "joint.toml"
    joint.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match="column map"):
        read(write(tmp_path / "run.csv", text()), columns=joint)
    with pytest.raises(InputError, match="cannot be read"):
        read(write(tmp_path / "run.csv", text()), columns=tmp_path / "none.toml")


# ---- unusable files


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.csv", b"", "empty"),
        ("a.csv", b"  \n\n", "empty"),
        ("a.csv", (HEADER + "\n").encode(), "no row of numbers"),
        ("a.csv", b"just some words\nand more\n", "no row of numbers"),
        ("a.csv", bytes(range(256)) * 40, "not a text file"),
        ("a.csv", b"\x00" * 4000, "not a text file"),
        ("a.mat", text().encode(), "not a MAT file"),
        ("a.npz", text().encode(), "not a NPZ file"),
        ("a.h5", text().encode(), "not a HDF5 file"),
        ("a.parquet", b"\x01\x02garbage", "not a Parquet file"),
        ("a.mat", b"MATLAB 5.0 MAT-file" + bytes(range(256)) * 4, "not a readable MAT"),
        ("a.npz", b"PK\x03\x04" + b"\x07" * 500, "not a readable NPZ"),
        ("a.h5", b"\x89HDF\r\n\x1a\n" + b"\x07" * 500, "not a readable HDF5"),
        ("a.parquet", b"PAR1" + b"\x07" * 500, "not a readable Parquet"),
        ("a.mf4", b"MDF     " + b"\x07" * 500, "not a readable MDF"),
        ("a.bag", b"#ROSBAG V2.0\n" + b"\x07" * 500, "not a readable ROS bag"),
        ("a.mcap", b"\x89MCAP0\r\n" + b"\x07" * 500, "not a readable MCAP"),
    ],
)
def test_unusable_files_are_refused_in_one_line(
    tmp_path: Path, name: str, content: bytes, said: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as caught:
        read(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_folder_and_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder"):
        read(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        read(tmp_path / "none.csv")


def test_bad_cell_is_named_by_line_and_column(tmp_path: Path) -> None:
    lines = text().splitlines()
    lines[17] = "0.032,oops,1"
    with pytest.raises(
        InputError, match=r"line 18, column 'motor_current_A': 'oops' is not a number"
    ):
        read(write(tmp_path / "run.csv", "\n".join(lines)))


@pytest.mark.parametrize("row", ["0.032,1", "0.032,1,2,3"])
def test_row_of_another_length_is_named(tmp_path: Path, row: str) -> None:
    lines = text().splitlines()
    lines[17] = row
    with pytest.raises(InputError, match=r"line 18: \d cells where the header has 3"):
        read(write(tmp_path / "run.csv", "\n".join(lines)))


def test_two_rows_shifted_against_each_other_do_not_slip_through(tmp_path: Path) -> None:
    lines = [line + ",9" for line in text().splitlines()]
    lines[0] = HEADER + ",other"
    lines[17], lines[18] = "0.032,1,2", "0.034,1,2,3,4"
    with pytest.raises(InputError, match="line 18"):
        read(write(tmp_path / "run.csv", "\n".join(lines)))


# ---- other formats


def channels() -> dict[str, np.ndarray]:
    return {"time_s": T, "motor_current_A": CURRENT, "link_position_deg": np.rad2deg(ANGLE)}


def test_npz(tmp_path: Path) -> None:
    arrays: dict[str, Any] = {**channels(), "gain": np.float64(3.0), "other": np.zeros(7)}
    np.savez(tmp_path / "run.npz", **arrays)
    record = read(tmp_path / "run.npz")
    same(record)
    assert any("other" in note for note in record.provenance.notes)
    np.savez(tmp_path / "objects.npz", time_s=np.array([{}, {}]))
    with pytest.raises(InputError, match="not a readable NPZ"):
        read(tmp_path / "objects.npz")


def test_mat_v5_with_vectors_structs_and_matrices(tmp_path: Path) -> None:
    from scipy.io import savemat

    savemat(tmp_path / "run.mat", {**channels(), "note": "bench"})
    same(read(tmp_path / "run.mat"))
    savemat(
        tmp_path / "deep.mat",
        {"log": {"t": T, "iq": -1000.0 * CURRENT}, "X": np.rad2deg(np.outer(ANGLE, [1, 2]))},
    )
    columns = {
        "time": {"column": "log.t", "unit": "s"},
        "motor_current": {"column": "log.iq", "unit": "mA", "sign": -1},
        "link_position": {"column": "X[0]", "unit": "deg"},
    }
    same(read(tmp_path / "deep.mat", columns=columns))
    with pytest.raises(InputError, match=r"log\.t, log\.iq, X\[0\], X\[1\]"):
        read(tmp_path / "deep.mat", columns={"time": {"column": "nope", "unit": "s"}})


def test_hdf5_with_units_as_attributes(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "run.h5", "w") as file:
        columns = [
            ("time", T, "s"),
            ("motor_current", CURRENT * 1e3, "mA"),
            ("link_position", ANGLE, "rad"),
        ]
        for name, values, unit in columns:
            file[name] = values
            file[name].attrs["unit"] = unit
        file["info/title"] = "bench"
    same(read(tmp_path / "run.h5"))


def test_mat_7_3_is_read_as_hdf5(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "run.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in channels().items():
            file[name] = values.reshape(1, -1)
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(128))
    same(read(path))


def test_parquet(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    run = pa.array(["a"] * 120 + ["b"] * 80)
    pq.write_table(pa.table({**channels(), "run": run}), tmp_path / "run.parquet")
    record = read(tmp_path / "run.parquet")
    same(record)
    assert record.segments() == [slice(0, 120), slice(120, 200)]


def test_mdf_with_two_rates(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    slow = T[::2]
    with asammdf.MDF(version="4.10") as file:
        file.append(
            [
                asammdf.Signal(CURRENT, T, name="motor_current", unit="A"),
                asammdf.Signal(np.rad2deg(ANGLE), T, name="link_position", unit="deg"),
            ]
        )
        file.append([asammdf.Signal(20.0 + slow, slow, name="temperature", unit="degC")])
        file.save(tmp_path / "run.mf4")
    record = read(tmp_path / "run.mf4")
    np.testing.assert_allclose(record["motor_current"], CURRENT[:-1], atol=1e-9)
    np.testing.assert_allclose(record["link_position"], ANGLE[:-1], atol=1e-9)
    np.testing.assert_allclose(record["temperature"], 293.15 + record.time, atol=1e-9)
    assert any("interpolated" in note for note in record.provenance.notes)


@pytest.mark.parametrize("cut", [0, 2000], ids=["whole", "damaged"])
def test_an_mdf_that_was_not_finished_leaves_no_copy_behind(cut: int, tmp_path: Path) -> None:
    """Of a logger that lost its power; a copy of a damaged one, of any size, stayed for ever."""
    asammdf = pytest.importorskip("asammdf")
    path, temporary = tmp_path / "run.mf4", tmp_path / "temporary"
    temporary.mkdir()
    with asammdf.MDF(version="4.10") as file:
        signals = {"motor_current": CURRENT, "link_position": ANGLE}
        file.append([asammdf.Signal(x, T, name=name, unit="A") for name, x in signals.items()])
        file.save(path)
    data = bytearray(path.read_bytes())
    data[60] |= 1  # the first of the flags of what is to be finished
    path.write_bytes(data[: len(data) - cut])
    program = "import sys; from identification.data.survey import survey; survey(sys.argv[1])"
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)],
        env={**os.environ, "TMPDIR": str(temporary)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ("is not a readable MDF file" in done.stderr) is (cut > 0), done.stderr
    assert (done.returncode == 0) is (cut == 0)
    assert list(temporary.iterdir()) == []


ROS_COLUMNS = {
    "motor_current": {"column": "/joints/effort[elbow]", "unit": "A"},
    "link_position": {"column": "/joints/position[elbow]", "unit": "rad"},
}


def joint_state(store: Any, k: int) -> Any:
    types = store.types
    seconds = 100.0 + T[k]
    stamp = types["builtin_interfaces/msg/Time"](
        sec=int(seconds), nanosec=round((seconds % 1.0) * 1e9)
    )
    arguments: dict[str, Any] = {"stamp": stamp, "frame_id": ""}
    if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__:
        arguments["seq"] = k
    return types["sensor_msgs/msg/JointState"](
        header=types["std_msgs/msg/Header"](**arguments),
        name=["shoulder", "elbow"],
        position=np.array([0.0, ANGLE[k]]),
        velocity=np.array([0.0, 0.0]),
        effort=np.array([0.0, CURRENT[k]]),
    )


def same_ros(record: Record) -> None:
    same(record)
    assert record.provenance.notes[0].startswith("time counts from the first stamp")


def test_ros_1_bag(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(tmp_path / "run.bag") as bag:
        connection = bag.add_connection("/joints", "sensor_msgs/msg/JointState", typestore=store)
        for k in range(N):
            raw = store.serialize_ros1(joint_state(store, k), "sensor_msgs/msg/JointState")
            bag.write(connection, int((100.5 + T[k]) * 1e9), raw)
    same_ros(read(tmp_path / "run.bag", columns=ROS_COLUMNS))


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_ros_2_bag(tmp_path: Path, storage: str) -> None:
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin[storage]) as bag:
        connection = bag.add_connection("/joints", "sensor_msgs/msg/JointState", typestore=store)
        for k in range(N):
            raw = store.serialize_cdr(joint_state(store, k), "sensor_msgs/msg/JointState")
            bag.write(connection, int((100.5 + T[k]) * 1e9), raw)
    same_ros(read(tmp_path / "bag", columns=ROS_COLUMNS))
    inside = next(p for p in (tmp_path / "bag").iterdir() if p.suffix in {".db3", ".mcap"})
    same_ros(read(inside, columns=ROS_COLUMNS))


def test_mcap_with_json_messages(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from mcap.writer import Writer

    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("joint", "jsonschema", b"{}")
        channel = writer.register_channel("/axis", "json", schema)
        other = writer.register_channel("/blob", "protobuf", schema)
        for k in range(N):
            body = {
                "iq": -1000.0 * CURRENT[k],
                "enc": {"deg": np.rad2deg(ANGLE[k])},
                "state": "run",
            }
            stamp = 10**18 + 2_000_000 * k
            writer.add_message(channel, stamp, json.dumps(body).encode(), stamp)
        writer.add_message(other, 10**18, b"\x00", 10**18)
        writer.finish()  # type: ignore[no-untyped-call]
    columns = {
        "motor_current": {"column": "/axis/iq", "unit": "mA", "sign": -1},
        "link_position": {"column": "/axis/enc/deg", "unit": "deg"},
    }
    record = read(path, columns=columns)
    np.testing.assert_allclose(record.time, T, atol=1e-6)
    np.testing.assert_allclose(record["motor_current"], CURRENT, atol=1e-9)
    np.testing.assert_allclose(record["link_position"], ANGLE, atol=1e-9)
    assert any("/blob (protobuf)" in note for note in record.provenance.notes)


@pytest.mark.parametrize(
    ("name", "magic", "module", "extra"),
    [
        ("a.h5", b"\x89HDF\r\n\x1a\n", "h5py", "hdf5"),
        ("a.parquet", b"PAR1", "pyarrow", "parquet"),
        ("a.mf4", b"MDF     ", "asammdf", "mdf"),
        ("a.bag", b"#ROSBAG V2.0\n", "rosbags.highlevel", "ros"),
        ("a.mcap", b"\x89MCAP0\r\n", "mcap.reader", "ros"),
    ],
)
def test_missing_package_says_what_to_install(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    magic: bytes,
    module: str,
    extra: str,
) -> None:
    (tmp_path / name).write_bytes(magic + b"\x00" * 100)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"pip install irj\[{extra}\]"):
        read(tmp_path / name)


@pytest.mark.parametrize("form", ["npz", "mat", "h5", "parquet"])
@pytest.mark.parametrize("part", [0.1, 0.5, 0.9, 0.99])
def test_truncated_files_are_refused(tmp_path: Path, form: str, part: float) -> None:
    whole = tmp_path / f"whole.{form}"
    if form == "npz":
        arrays: dict[str, Any] = channels()
        np.savez(whole, **arrays)
    elif form == "mat":
        from scipy.io import savemat

        savemat(whole, channels())
    elif form == "h5":
        h5py = pytest.importorskip("h5py")
        with h5py.File(whole, "w") as file:
            file.update(channels())
    else:
        pa = pytest.importorskip("pyarrow")
        import pyarrow.parquet as pq

        pq.write_table(pa.table(channels()), whole)
    same(read(whole))
    cut = tmp_path / f"cut.{form}"
    cut.write_bytes(whole.read_bytes()[: int(part * whole.stat().st_size)])
    with pytest.raises(InputError, match=r"cut\."):
        read(cut)
