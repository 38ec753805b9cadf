"""Damaged input for every door: ``python -m tests.fuzz --count N --seed S``.

Each input is a good file with some damage: bits, bytes, cuts, copies, absurd numbers and sizes. It
goes through the command line as a user's file would. Printed, with the file kept, is what must not
happen: the process ends, a trace instead of a sentence, an exit code of 3, more than 5 s, more than
500 MB, or a joint file that was written and does not read back.
"""

from __future__ import annotations

import argparse
import contextlib
import gzip
import io
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

SECONDS: Final = 5.0
MEGABYTES: Final = 500.0
BATCH: Final = 2000
"""Inputs of one process, whose decoder starts once; after a death the next process goes on behind
it."""
DEMO: Final = Path(__file__).resolve().parents[1] / "workbench" / "demo"
JOINT: Final = """[joint]
name = "axis"
kind = "rotary"
gear_ratio = -160.0
motor_constant = 0.0553
model = "hd3"
effects = ["viscous", "coulomb", "gravity"]

[known]
orders = [12.0, 36.0]
motor_inertia = { value = 4.4, unit = "kg.m2", side = "link" }
link_inertia = { low = 1.0, high = 20.0 }

[columns]
time = { column = "t", unit = "s" }
motor_current = { column = "i", unit = "mA", scale = 2.0, sign = -1 }

[fitted]
motor_viscous = { value = 12.5, stderr = 0.1, unit = "N.m.s/rad", side = "link" }

[provenance]
records = "a.csv"
date = 2024-01-02T03:04:05Z
"""
COLUMNS: Final = """[joint]
gear_ratio = -160.0
model = "hd3"

[columns]
time = { column = "time", unit = "s" }
CHANNEL
"""
BAGS: Final = {
    ".mcap": 'motor_current = { column = "/drive/motor_current_A", unit = "A" }',
    ".bag": 'motor_position = { column = "/joint_states/position[j]", unit = "rad" }',
}
STUDY: Final = """[study]
stop = 0.2
step = 0.01
record = ["link_position"]

[[model]]
joint = "joint.toml"
kind = "plant"
add = ["stribeck"]

[inputs]
i_m = { time = [0.0, 0.1], value = [4.0, -2.0] }

[grid]
motor_inertia = { low = 2.0, high = 4.0, count = 3 }
"""
EFFECT: Final = """import casadi as ca
from casadi_models import amplitude, effect, shape

@effect("fuzzed", title="t", family="friction", acts_on=("motor", "link"),
        parameters=(
            amplitude("size", "N.m", "m"),
            shape("width", "rad", "w", (0.1, 0.2), "position", start=0.2, low=0.01, high=3.0)),
        absence="a", excitation="e", source="s", needs=("coulomb",))
def law(s, p):
    return p.size * ca.exp(-((s.position / p.width) ** 2)) * s.direction
"""
WORDS: Final = (
    b"1e999",
    b"-1e999",
    b"nan",
    b"inf",
    b"1_000",
    b"9" * 400,
    b"9" * 5000,
    b"1e-400",
    b"[" * 300,
    b"{a=" * 300,
    b"\x00",
    b"\xff\xfe",
    b"\xef\xbb\xbf",
    b"\x1b",
    b"\r",
    b"\n\n",
    b'"',
    b"'''",
    b"\\",
    b"#",
    b",,,,",
    b";",
    b"\t",
    b"0x7f",
    b"true",
    b"None",
    b"@nowhere",
    b"-0.0",
    b"1979-05-27",
    b"^99999999",
    b"\xc3\x28",
    b"sys.exit(0)",
    b"return None",
    b"\xe2\x80\xae",
    b"A" * 3000,
)
SIZES: Final = tuple(
    (value % (1 << 8 * width)).to_bytes(width, order)
    for width in (2, 4, 8)
    for order in ("little", "big")
    for value in (
        0,
        1,
        127,
        1 << 15,
        (1 << 16) - 1,
        1 << 20,
        (1 << 30),
        (1 << 31) - 1,
        1 << 31,
        -1,
        1 << 40,
        1 << 62,
    )
)


def damaged(data: bytes, rng: random.Random) -> bytes:
    """A copy with one to eight damages."""
    made = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        place = rng.randrange(len(made) + 1)
        if rng.random() < 0.3:  # headers decide more than samples
            place = min(place, rng.randrange(512))
        kind = rng.randrange(8)
        if kind == 0 and place < len(made):
            made[place] ^= 1 << rng.randrange(8)
        elif kind == 1 and place < len(made):
            made[place] = rng.randrange(256)
        elif kind == 2:
            del made[place : place + rng.choice((1, 2, 4, 16, 200, 4000))]
        elif kind == 3:
            made[place:place] = rng.choice(WORDS)
        elif kind == 4:
            size = rng.choice(SIZES)
            made[place : place + len(size)] = size
        elif kind == 5 and rng.random() < 0.3:
            del made[place:]
        elif kind == 6:
            start = rng.randrange(len(made) + 1)
            made[place:place] = made[start : start + rng.choice((4, 64, 1024))]
        else:
            word = rng.choice(WORDS)
            made[place : place + len(word)] = word
        if not made:
            break
    return bytes(made)


def seeds(folder: Path) -> dict[str, bytes]:
    """A good file of every kind, by its name."""
    time_, current, position = (
        np.arange(200) * 0.01,
        np.sin(np.arange(200) * 0.1),
        np.cos(np.arange(200) * 0.1),
    )
    table = {"time_s": time_, "motor_current_A": current, "motor_position_rad": position}
    rows = np.column_stack(list(table.values()))
    text = (
        ",".join(table) + "\n" + "\n".join(",".join(f"{v:.6g}" for v in row) for row in rows) + "\n"
    )
    np.savez_compressed(folder / "r.npz", **table)  # type: ignore[arg-type]
    found = {
        "r.csv": text.encode(),
        "r16.csv": text.encode("utf-16"),
        "semi.csv": text.replace(",", ";").replace(".", ",").encode(),
        "space.txt": text.replace(",", " ").encode(),
        "joint.toml": JOINT.encode(),
        "study.toml": STUDY.encode(),
        "own.py": EFFECT.encode(),
        "r.csv.gz": gzip.compress(text.encode(), mtime=0),
    }
    with contextlib.suppress(ImportError):
        import scipy.io

        scipy.io.savemat(folder / "r.mat", {**table, "s": {"a": current}}, do_compression=True)
        scipy.io.savemat(folder / "plain.mat", {**table, "s": {"a": current}})
    with contextlib.suppress(ImportError):
        import h5py

        with h5py.File(folder / "r.h5", "w") as file:
            for name, values in table.items():
                file.create_dataset(name, data=values, compression="gzip")
    with contextlib.suppress(ImportError):
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(pa.table(table), folder / "r.parquet")
    with contextlib.suppress(ImportError):
        import asammdf

        with asammdf.MDF(version="4.10") as log:
            log.append([asammdf.Signal(v, time_, name=n) for n, v in list(table.items())[1:]])
            log.save(folder / "r.mf4", overwrite=True, compression=1)
    with contextlib.suppress(ImportError):
        from rosbags.rosbag1 import Writer as Bag
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS1_NOETIC)
        state, header, stamp = (
            store.types[f"{n}"]
            for n in (
                "sensor_msgs/msg/JointState",
                "std_msgs/msg/Header",
                "builtin_interfaces/msg/Time",
            )
        )
        with Bag(folder / "r.bag") as bag:
            topic = bag.add_connection("/joint_states", state.__msgtype__, typestore=store)
            for k, (t, q) in enumerate(zip(time_, position, strict=True)):
                at = header(seq=k, stamp=stamp(sec=int(t), nanosec=int(t % 1 * 1e9)), frame_id="")
                message = state(
                    header=at,
                    name=["j"],
                    position=np.array([q]),
                    velocity=np.array([q]),
                    effort=np.array([q]),
                )
                bag.write(topic, int(t * 1e9), store.serialize_ros1(message, state.__msgtype__))
    with contextlib.suppress(ImportError):
        from mcap.writer import Writer

        with (folder / "r.mcap").open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            schema = writer.register_schema("drive", "jsonschema", b"{}")
            channel = writer.register_channel("/drive", "json", schema)
            for t, i in zip(time_, current, strict=True):
                writer.add_message(
                    channel,
                    int(t * 1e9),
                    json.dumps({"motor_current_A": float(i)}).encode(),
                    int(t * 1e9),
                )
            writer.finish()
    found.update({p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()})
    return found


# --- one input ------------------------------------------------------------------------------------


def tried(path: Path) -> str:
    """Put a file through its door; what is wrong with the answer, or nothing."""
    from identification.errors import InputError
    from workbench.cli.main import main

    out, err = io.StringIO(), io.StringIO()
    target = path.with_name("out.toml")
    if path.suffix == ".py":
        words = ["--effects", str(path), "effects"]
    elif path.name == "joint.toml":
        words = ["add", "stribeck", "--joint", str(path), "-o", str(target)]
    elif path.name == "study.toml":
        target.with_name("joint.toml").write_text(JOINT)
        words = ["batch", str(path), "--dry-run"]
    else:
        columns = path.with_name("columns.toml")
        columns.write_text(COLUMNS.replace("CHANNEL", BAGS.get(path.suffix, "")))
        words = ["check", str(path), *(("--joint", str(columns)) if path.suffix in BAGS else ())]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as error:
            code = int(error.code or 0)
    said = err.getvalue()
    if code not in (0, 1, 2) or "Traceback" in said:
        return f"exit {code}: {said.strip()[-300:]}"
    if code == 2 and said.count("\n") != 1:
        return f"not one line: {said[:300]!r}"
    if path.name == "joint.toml" and code == 0:
        from identification.data.joint_file import load_joint

        try:
            load_joint(target)
        except InputError as error:
            return f"does not read back: {error}"
    return ""


def _peak(process: str) -> float:
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), 0.0)


def _family() -> list[str]:
    me = os.getpid()
    try:
        return ["self", *Path(f"/proc/self/task/{me}/children").read_text().split()]
    except OSError:
        return ["self"]


def work(
    folder: Path, inputs: list[tuple[int, str]], make: Callable[[int, str], bytes], say: int
) -> None:
    """Try inputs one after the other; a line before and after each."""
    for number, name in inputs:
        place = folder / str(number)
        place.mkdir()
        (place / name).write_bytes(make(number, name))
        os.write(say, f"{number}\tbegins\t{name}\n".encode())
        for process in _family():
            with contextlib.suppress(OSError):
                Path(f"/proc/{process}/clear_refs").write_text("5")  # the peak counts from here
        start = time.perf_counter()
        signal.alarm(60)
        wrong = tried(place / name)
        signal.alarm(0)
        took = time.perf_counter() - start
        room = max(map(_peak, _family()))
        if took > SECONDS:
            wrong = wrong or f"{took:.1f} s"
        if room > MEGABYTES:
            wrong = wrong or f"{room:.0f} MB"
        if not wrong:
            shutil.rmtree(place)
        os.write(say, f"{number}\tends\t{' '.join(wrong.split())}\n".encode())


def campaign(count: int, seed: int, folder: Path, only: str = "") -> tuple[Counter[str], list[str]]:
    """Try `count` inputs; how many of each kind there were, and what went wrong."""
    os.environ["IRJ_CRASHES"] = str(folder / "crashes")
    os.environ["IRJ_ALLOWED_EFFECTS"] = str(folder / "allowed.txt")
    for name in ("good", "crashes"):
        (folder / name).mkdir()
    good = {k: v for k, v in seeds(folder / "good").items() if only in k}
    names = sorted(good)
    import workbench.cli.main  # noqa: F401  (loaded once, for all forks)

    def make(number: int, name: str) -> bytes:
        return damaged(good[name], random.Random(f"{seed} {number}"))

    inputs = [(n, names[n % len(names)]) for n in range(count)]
    found: list[str] = []
    done = 0
    while done < count:
        taken = inputs[done : done + BATCH]
        ear, mouth = os.pipe()
        process = os.fork()
        if not process:
            os.close(ear)
            silent = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silent, 1)
            os.dup2(silent, 2)
            work(folder, taken, make, mouth)
            from identification.data.read._child import CHILD

            CHILD.end()
            os._exit(0)
        os.close(mouth)
        now = ""
        with os.fdopen(ear, encoding="utf-8") as lines:
            for line in lines:
                number, event, text = line.rstrip("\n").split("\t", 2)
                if event == "begins":
                    now = f"{folder / number / text}"
                else:
                    done += 1
                    if text:
                        found.append(f"{now}: {text}")
                        print(found[-1], flush=True)
                    now = ""
        status = os.waitpid(process, 0)[1]
        if status or now:
            done += 1
            found.append(f"{now}: the process ended (status {status})")
            print(found[-1], flush=True)
    return Counter(name for _, name in inputs), found


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="kinds whose name holds this, as mat or joint")
    arguments = parser.parse_args()
    start = time.perf_counter()
    folder = Path(tempfile.mkdtemp(prefix="irj-fuzz-"))
    counted, found = campaign(arguments.count, arguments.seed, folder, arguments.only)
    kinds = ", ".join(f"{name} {number}" for name, number in sorted(counted.items()))
    print(
        f"{arguments.count} inputs in {time.perf_counter() - start:.0f} s ({kinds}): "
        f"{len(found)} wrong" + (f", kept in {folder}" if found else "")
    )
    if not found:
        shutil.rmtree(folder)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
