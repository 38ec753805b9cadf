"""Sensor faults in files: what the fault bank sees and names where no velocity is measured.

    python -m benchmarks.fault_files --cases 140 [--joints 3] [--first 100] [--hours 2]
        [--velocities] [--keep results.json]

Every joint is another one, drawn by the generator of `tests/hidden_effect` (true sticking,
unmodelled bump, snags, kinematic error of an odd order and a stiff link mode in every record).
Files have time, motor current, both positions and the link torque, with `--velocities` both
velocities too. `irj improve` makes the model
from two training files of 24 s; limits come from two other healthy files; faults are put into files
of a motion that nobody has seen. Case numbers decide sensor, kind, sign, and time. `--keep` adds to
what is there, so that a campaign can be run in pieces. Printed: share detected, share in which the
failed sensor is named and nothing else, alarms in healthy time. `--hours` adds healthy records of
motions of their own, so many hours of all joints together.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from identification.data.joint_file import Joint, load_joint
from identification.data.read import read
from identification.data.record import Record
from identification.faults.bank import FaultBank
from identification.faults.bank_levels import Piece
from identification.faults.core import SENSORS as SENSOR_NAMES
from identification.faults.injector import Fault, inject
from identification.faults.types import FaultEvent, Verdict
from irj_fmu.estimator.bank import bank_for, judged
from irj_fmu.estimator.healthy import online_readings
from tests.hidden_effect.generator import COLUMNS, DT, KM, simulate_case
from tests.hidden_effect.motion import multisine, triangle
from workbench.cli.main import main as irj

FloatArray = npt.NDArray[np.float64]

VELOCITIES: Final = (3, 5)
"""Columns of the generator that are not in the files as a rule."""
SENSORS: Final = {
    "current": 1,
    "motor_position": 2,
    "link_position": 4,
    "torque": 6,
    "motor_velocity": 3,
    "link_velocity": 5,
}
"""Columns of the generator; the last two with ``--velocities``."""
HIDDEN: Final = (None, "stribeck", "kinematic_error", "torque_ripple", "cubic_stiffness")
"""What `improve` has to find; joints take turns."""
SIZES: Final[dict[str, tuple[float, float, float]]] = {
    "bias": (15.0, 0.010, 0.05),
    "drift": (5.0, 0.005, 0.05),
    "gain": (0.30, 0.05, 0.2),
    "noise": (50.0, 0.1, 0.1),
    "spike": (60.0, 0.010, 0.2),
    "stuck": (0.0, 0.0, 0.0),
    "dropout": (0.0, 0.0, 0.0),
}
"""Size for the two torques [N.m, N.m/s, share], for the two positions, link-referred [rad, rad/s,
share], and for the two velocities [rad/s, rad/s2, share]."""
SPAN: Final = 120.0
"""Length of the healthy files and of those that faults are put into [s]."""
CHANGES: Final[Mapping[str, Mapping[str, float]]] = {
    "payload +30 %": {"JL": 1.3, "TG": 1.3},
    "motor Coulomb x 1.3": {"M_TC": 1.3},
    "stiffness -20 %": {"K": 0.8},
}
"""Changes of the joint, by the generator's names: no sensor fails there."""
MORE_SPAN: Final = SPAN
"""Length of a healthy record that `--hours` adds [s]."""
CHANGED_SPAN: Final = 40.0
"""Length of a record of a changed joint [s]."""
PIECE: Final = 16.0
"""Length of a file with a fault [s]."""
LOOK: Final = 6.0
"""Seconds after the beginning of a fault in which it has to be seen."""


@final
@dataclass(frozen=True)
class Bench:
    """One joint: its model from `improve`, its bank, and an unseen healthy record."""

    folder: Path
    hidden: str | None
    joint: Joint
    bank: FaultBank
    smallest: Mapping[str, tuple[float, float]]
    table: FloatArray
    more: FloatArray
    changed: Mapping[str, FloatArray]
    ratio: float

    @property
    def sensors(self) -> list[str]:
        """What the files have, that faults are put into."""
        return [n for n in SENSORS if SENSOR_NAMES.index(n) in self.bank.sensors]

    @property
    def velocities(self) -> bool:
        """Whether the files have velocities."""
        return "motor_velocity" in self.sensors


def _file(path: Path, table: FloatArray, velocities: bool) -> Path:
    columns: dict[str, Any] = {
        name: table[:, i] for i, name in enumerate(COLUMNS) if velocities or i not in VELOCITIES
    }
    np.savez(path, **columns)
    return path


def opened(path: Path, joint: Joint) -> Record:
    """A file as `irj track` reads it, holes and all."""
    return read(path, columns=joint.columns, kind=joint.kind)


@cache
def bench(seed: int, folder: Path, velocities: bool = False) -> Bench:
    """The joint of a seed, its files with velocities or without."""
    hidden = HIDDEN[seed % len(HIDDEN)]
    here = folder / str(seed)
    here.mkdir(parents=True, exist_ok=True)
    short = simulate_case(hidden, seed, dirt=True)
    train = [_file(here / f"{n}.npz", short.measured[n], velocities) for n in ("train", "train2")]
    held = [_file(here / f"{n}.npz", short.measured[n], velocities) for n in ("test", "test2")]
    (here / "joint.toml").write_text(
        f'[joint]\nname = "joint {seed}"\ngear_ratio = {short.gear_ratio}\n'
        f"motor_constant = {KM}   # Nm/A on the motor shaft\n"
        'model = "hd3"\neffects = ["viscous", "coulomb", "gravity"]\n',
        encoding="utf-8",
    )
    better = here / "better.toml"
    if not better.is_file():
        given = ["improve", *map(str, train), "--held-out", *map(str, held)]
        irj([*given, "--joint", str(here / "joint.toml"), "-o", str(better)])
    long = simulate_case(hidden, seed, dirt=True, span=SPAN)
    healthy = [
        _file(here / f"healthy_{n}.npz", long.measured[n], velocities) for n in ("train", "test")
    ]
    joint = load_joint(better)
    records = [opened(p, joint) for p in healthy]
    bank = bank_for(joint, records[0], records)
    if bank is None:
        raise SystemExit(f"{better}: no bank: the joint is rigid or not fitted")
    changed = {
        text: simulate_case(
            hidden,
            seed,
            dirt=True,
            span=CHANGED_SPAN,
            records=("test2",),
            overrides={name: factor * long.parameters[name] for name, factor in change.items()},
        ).measured["test2"]
        for text, change in CHANGES.items()
    }
    rows = np.array(online_readings(records[1], joint)[0])
    return Bench(
        here,
        hidden,
        joint,
        bank,
        smallest=bank.smallest(Piece(records[1].time, rows)),
        table=long.measured["test2"],
        more=long.measured["train2"],
        changed=changed,
        ratio=short.gear_ratio,
    )


def faulty(at: Bench, number: int) -> tuple[FloatArray, Fault]:
    """A piece of the unseen record with a fault; the number of the case decides which."""
    rng = np.random.default_rng([7, number])
    names, kinds = at.sensors, list(SIZES)
    sensor, kind = names[number % len(names)], kinds[(number // len(names)) % len(kinds)]
    size = SIZES[kind][
        1 if sensor.endswith("position") else 2 if sensor.endswith("velocity") else 0
    ]
    return piece(at, rng, sensor, kind, size)


def piece(
    at: Bench, rng: np.random.Generator, sensor: str, kind: str, size: float
) -> tuple[FloatArray, Fault]:
    """A piece of the unseen record with a fault of either sign at some time."""
    count = round(PIECE / DT)
    first = int(rng.integers(0, len(at.table) - count))
    table = at.table[first : first + count].copy()
    table[:, 0] -= table[0, 0]
    size *= float(rng.choice([-1.0, 1.0])) if kind in ("bias", "drift", "gain") else 1.0
    begin = DT * round(rng.uniform(5.0, 8.0) / DT)
    fault = Fault(sensor, kind, begin, size)  # type: ignore[arg-type]
    column = SENSORS[sensor]
    motor = {"current": at.ratio * KM} | dict.fromkeys(SENSOR_NAMES[1:3], 1.0 / at.ratio)
    referred = motor.get(sensor, 1.0)
    rows = np.zeros((count, 6))
    place = SENSOR_NAMES.index(sensor)
    rows[:, place] = referred * table[:, column]
    table[:, column] = (
        inject(rows, DT, [fault], seed=int(rng.integers(1 << 30)))[:, place] / referred
    )
    return table, fault


def judge(at: Bench, number: int) -> dict[str, Any]:
    """One case."""
    table, fault = faulty(at, number)
    path = _file(at.folder / "case.npz", table, at.velocities)
    record = opened(path, at.joint)
    track = judged(at.bank, record, at.joint)
    late = [e for e in track.events if record.time[e.sample] >= fault.start - DT / 2]
    late = [
        e
        for e in late
        if record.time[e.first] <= fault.start + LOOK and e.verdict is not Verdict.RECOVERED
    ]
    said = {n for e in late if names_sensor(e) for n in e.sensors}
    return {
        "seed": int(at.folder.name),
        "case": number,
        "sensor": fault.sensor,
        "kind": fault.kind,
        "early": sum(bool(record.time[e.sample] < fault.start - DT / 2) for e in track.events),
        "detected": bool(late),
        "right": said == {fault.sensor} and all(names_sensor(e) for e in late),
        "delay": min((float(record.time[e.first]) for e in late), default=np.nan) - fault.start,
        "said": [
            [round(float(record.time[e.sample]) - fault.start, 3), e.verdict.name, *e.sensors]
            for e in late
        ][:4],
    }


def names_sensor(event: FaultEvent) -> bool:
    """True where an event names one sensor (the pair current or friction counts as the current)."""
    return event.verdict in (Verdict.SENSOR, Verdict.DROPOUT, Verdict.CURRENT_OR_FRICTION)


def said_about(at: Bench, table: FloatArray) -> tuple[float, list[str]]:
    """Hours of a record, and what was said about it."""
    record = opened(_file(at.folder / "healthy.npz", table, at.velocities), at.joint)
    track = judged(at.bank, record, at.joint)
    return record.duration / 3600.0, [
        f"{record.time[e.sample]:.2f} s {e.verdict.name} {' '.join(e.sensors)}".strip()
        for e in track.events
    ]


def more_healthy(at: Bench, hours: float) -> Iterator[FloatArray]:
    """Healthy records of a joint, each of a motion of its own."""
    seed, rows = int(at.folder.name), round(MORE_SPAN / DT)
    rng = np.random.default_rng([9, seed])
    for number in range(math.ceil(3600.0 * hours / MORE_SPAN)):
        motion = triangle(rng, rows, DT, 8.5, 44.0) if number % 2 == 0 else multisine(rng, rows, DT)
        name = f"healthy {number}"
        case = simulate_case(at.hidden, seed, dirt=True, references={name: motion})
        yield case.measured[name]


def aside(at: Bench, hours_more: float) -> dict[str, Any]:
    """Healthy time, changes of the joint, and offsets of the announced sizes, of one joint."""
    hours = 0.0
    said: list[str] = []
    for table in (at.table, at.more, *more_healthy(at, hours_more)):
        more, texts = said_about(at, table)
        hours, said = hours + more, said + texts
    changes = {text: said_about(at, table)[1] for text, table in at.changed.items()}
    sizes = []
    rng = np.random.default_rng([8, int(at.folder.name)])
    for sensor, (seen, named) in at.smallest.items():
        for what, size in (("seen", seen), ("quarter", seen / 4), ("named", named)):
            for _ in range(3 if np.isfinite(size) else 0):
                table, fault = piece(at, rng, sensor, "bias", size)
                record = opened(_file(at.folder / "size.npz", table, at.velocities), at.joint)
                events = [
                    e
                    for e in judged(at.bank, record, at.joint).events
                    if record.time[e.sample] >= fault.start - DT / 2
                ]
                first = events[0] if events else None
                right = first is not None and names_sensor(first) and first.sensors == (sensor,)
                sizes.append([sensor, what, bool(events), right])
    return {"hours": hours, "said": said, "changes": changes, "sizes": sizes}


def report(results: dict[str, Any]) -> None:
    """Print the figures of all cases so far."""
    cases = results["cases"]
    if cases:
        count = len(cases)
        print(
            f"{count} cases on {len({c['seed'] for c in cases})} joints: detected "
            f"{100 * sum(c['detected'] for c in cases) / count:.1f} %, the sensor named and "
            f"nothing else {100 * sum(c['right'] for c in cases) / count:.1f} %"
        )
        for key in ("sensor", "kind"):
            total = Counter(c[key] for c in cases)
            right = Counter(c[key] for c in cases if c["right"])
            print(f"  {key}: " + ", ".join(f"{n} {right[n]}/{total[n]}" for n in total))
        early = sum(c["early"] for c in cases)
        print(f"  said before the fault: {early}")
    joints = results["healthy"]
    hours = sum(j["hours"] for j in joints.values())
    said = [f"{seed}: {text}" for seed, j in joints.items() for text in j["said"]]
    print(f"healthy: {len(said)} reports in {hours:.2f} h" + "".join(f"\n  {t}" for t in said))
    for text in CHANGES:
        told = Counter(
            " or ".join(sorted({t.split(" s ")[1] for t in j["changes"][text]})) or "nothing"
            for j in joints.values()
        )
        print(f"{text}: " + ", ".join(f"{n} {t}" for t, n in told.items()))
    sizes = [entry for j in joints.values() for entry in j["sizes"]]
    for what, text, place in (
        ("seen", "offset announced as seen: seen", 2),
        ("quarter", "a quarter of it: seen", 2),
        ("named", "offset announced as named: named", 3),
    ):
        of = [entry[place] for entry in sizes if entry[1] == what]
        if of:
            print(f"{text} in {sum(of)} of {len(of)}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=140)
    parser.add_argument("--joints", type=int, default=3)
    parser.add_argument("--first", type=int, default=100, help="seed of the first joint")
    parser.add_argument("--start", type=int, default=0, help="number of the first case")
    parser.add_argument(
        "--hours", type=float, default=0.0, help="healthy time of more motions, all joints together"
    )
    parser.add_argument("--seconds", type=float, default=330.0, help="stop after so many seconds")
    parser.add_argument("--folder", type=Path, help="keep joints and files here")
    parser.add_argument("--velocities", action="store_true", help="files have velocities too")
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args(arguments)
    folder = options.folder or Path(tempfile.mkdtemp(prefix="fault-files-"))
    results: dict[str, Any] = {"cases": [], "healthy": {}}
    if options.keep and options.keep.is_file():
        results = json.loads(options.keep.read_text(encoding="utf-8"))
    done = {(c["seed"], c["case"]) for c in results["cases"]}
    begin = time.monotonic()
    for number in range(options.start, options.start + options.cases):
        seed = options.first + number % options.joints
        if (seed, number) in done:
            continue
        if time.monotonic() - begin > options.seconds:
            print("time is up; run again with --keep to go on")
            break
        at = bench(seed, folder, options.velocities)
        if str(seed) not in results["healthy"]:
            results["healthy"][str(seed)] = aside(at, options.hours / options.joints)
        found = judge(at, number)
        results["cases"].append(found)
        if not found["right"]:
            print({k: v for k, v in found.items() if k != "delay"}, flush=True)
    if options.keep:
        options.keep.write_text(json.dumps(results), encoding="utf-8")
    report(results)


if __name__ == "__main__":
    main()
