"""The same joint, told otherwise: ``python -m tests.metamorphic --joints stribeck``.

What is missing in a joint cannot depend on the units of its files, on signs that are declared, on
where time or the joint's zero begins, nor on order, format, or names of columns. Each transform
says the same recordings in another way; verdict and named sets must stay, and where nothing but
notation changed the parameters must agree to 1e-9.

Printed is one row per transform and joint: verdict equal, sets equal, and the largest difference of
a parameter, relative to its value (or to its standard error, where that is larger) and in standard
errors. Where the records come out bit for bit the same the loop is not run again.

The recordings stand at ``../shared`` and stay there.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.data.check.gate import passed
from identification.data.columns import recognise
from identification.data.joint_file import Joint, parse_joint
from identification.data.plain_text import from_toml
from identification.data.read import read
from identification.data.record import Record
from identification.diagnosis.improve import improve
from identification.errors import InputError
from tests.recorded_world.planted import FILES, RIGS

FloatArray = npt.NDArray[np.float64]
Table = dict[str, FloatArray]

SHARED: Final = Path(__file__).resolve().parents[1].parent / "shared"
HIDDEN: Final = ("cubic_stiffness", "kinematic_error", "none", "stribeck")
RECORDED: Final = ("emps", "kuka_axis1", "quanser")
NOTATION: Final = 1e-9
"""Relative difference of a parameter that a change of notation may make: rounding of a product
(1e-16) times what a well-posed fit makes of it."""


@final
@dataclass(frozen=True)
class Case:
    """Recordings of one joint as files would hold them.

    Attributes
    ----------
    joint : mapping
        Table ``[joint]`` of the joint file.
    columns : mapping of str to mapping
        Table ``[columns]``, one entry a channel.
    train, held : tuple of tables
        Columns by name.
    form : str
        Format in which they are written.
    """

    name: str
    joint: Mapping[str, Any]
    columns: Mapping[str, Mapping[str, Any]]
    train: tuple[Table, ...]
    held: tuple[Table, ...]
    form: str = "npz"

    @property
    def linear(self) -> bool:
        """Whether the axis is linear."""
        return self.joint.get("kind") == "linear"

    def tables(self, change: Callable[[Table], Table]) -> Case:
        """The case with every table changed."""
        return replace(
            self, train=tuple(map(change, self.train)), held=tuple(map(change, self.held))
        )

    def scaled(self, channels: Sequence[str], factor: float, **entry: Any) -> Case:
        """The columns of some channels times a factor, their entries in the map changed."""
        chosen = {self.columns[c]["column"] for c in channels if c in self.columns}
        columns = {
            c: {**spec, **{k: v for k, v in entry.items() if c in channels}}
            for c, spec in self.columns.items()
        }
        return replace(
            self.tables(lambda t: {k: v * factor if k in chosen else v for k, v in t.items()}),
            columns=columns,
        )


@cache
def hidden_case(name: str) -> Case:
    """One of the joints with a hidden effect."""
    folder = SHARED / "hidden_effect" / name

    def table(file: str) -> Table:
        data = np.genfromtxt(folder / f"{file}.csv", delimiter=",", names=True)
        return {n: np.asarray(data[n], dtype=np.float64) for n in data.dtype.names}

    train, held = tuple(map(table, ("train", "train2"))), tuple(map(table, ("test", "test2")))
    found = {c: recognise(c) for c in train[0]}
    columns = {f.channel: {"column": c, "unit": f.unit} for c, f in found.items() if f is not None}
    joint = from_toml((folder / "joint.toml").read_text(), name)["joint"]
    return Case(name, joint, columns, train, held)


@cache
def recorded_case(name: str) -> Case:
    """One of the recorded axes, with the columns of its joint file only."""
    whole = from_toml((FILES / f"{name}.toml").read_text(), name)
    columns = whole["columns"]
    used = [spec["column"] for spec in columns.values()]
    train, held = (tuple({c: t[c] for c in used} for t in tables) for tables in RIGS[name].load())
    return Case(name, whole["joint"], columns, train, held)


def case_of(name: str) -> Case:
    """A case by its name."""
    return hidden_case(name) if name in HIDDEN else recorded_case(name)


# --- transforms -----------------------------------------------------------------------------------

DRIVES: Final = ("motor_current", "motor_torque", "motor_voltage")
MOTOR: Final = ("motor_position", "motor_velocity", "motor_acceleration")
LINK: Final = ("link_position", "link_velocity", "link_acceleration", "link_torque")
POSITIONS: Final = ("motor_position", "link_position")
SPEEDS: Final = ("motor_velocity", "link_velocity")


def _in_unit(
    case: Case, channels: Sequence[str], units: Mapping[str, tuple[str, float]]
) -> Case | None:
    """The channels in another unit, by the unit that they have."""
    changed: Case | None = None
    for channel in channels:
        spec = (changed or case).columns.get(channel)
        if spec is not None and spec["unit"] in units:
            unit, factor = units[spec["unit"]]
            changed = (changed or case).scaled([channel], factor, unit=unit)
    return changed


def _signed(case: Case, channels: Sequence[str]) -> Case | None:
    """The channels reversed, and their sign declared."""
    chosen = [c for c in channels if c in case.columns]
    return case.scaled(chosen, -1.0, sign=-1) if chosen else None


def _remounted(case: Case) -> Case:
    """The motor mounted the other way round: all that is read on its shaft changes its sign, and
    so does the ratio; what the motor puts into the link stays.
    """
    joint = {**case.joint, "gear_ratio": -case.joint["gear_ratio"]}
    if "torque_per_current" in joint:
        joint["torque_per_current"] = -joint["torque_per_current"]
    return replace(case.scaled([*MOTOR, *DRIVES], -1.0), joint=joint)


def _mirrored(case: Case) -> Case:
    """The whole joint seen in a mirror."""
    return case.scaled([*MOTOR, *DRIVES, *LINK], -1.0)


def _zero_moved(case: Case) -> Case:
    """The joint's zero elsewhere: one radian, or a decimetre, on the link."""
    shift = 0.1 if case.linear else 1.0

    def moved(table: Table) -> Table:
        out = dict(table)
        for channel in POSITIONS:
            if channel in case.columns:
                spec = case.columns[channel]
                own = np.rad2deg(shift) if spec["unit"] == "deg" else shift
                ratio = case.joint["gear_ratio"] if channel == "motor_position" else 1.0
                out[spec["column"]] = table[spec["column"]] + ratio * own
        return out

    return case.tables(moved)


def _shifted(case: Case, seconds: float) -> Case:
    spec = case.columns["time"]
    return case.tables(
        lambda t: {**t, spec["column"]: t[spec["column"]] + seconds / spec.get("scale", 1.0)}
    )


def _in_runs(case: Case) -> Case:
    """Every record cut in two runs of one file, in its middle."""

    def cut(table: Table) -> Table:
        rows = len(next(iter(table.values())))
        return {**table, "run": (np.arange(rows) >= rows // 2).astype(np.float64)}

    return replace(case.tables(cut), columns={**case.columns, "run": {"column": "run"}})


def _halves(tables: Sequence[Table]) -> tuple[Table, ...]:
    parts = []
    for table in tables:
        middle = len(next(iter(table.values()))) // 2
        parts += [{k: v[s] for k, v in table.items()} for s in (slice(middle), slice(middle, None))]
    return tuple(parts)


def _written_twice(table: Table) -> Table:
    rows = np.arange(len(next(iter(table.values()))))
    index = np.sort(np.concatenate([rows, rows[25::50]]))
    return {k: v[index] for k, v in table.items()}


def _with_constants(case: Case) -> Case:
    def more(table: Table) -> Table:
        ones = np.ones(len(next(iter(table.values()))))
        return {"mode": 3 * ones, **table, "bus_V": 48 * ones, "state": 0 * ones}

    return case.tables(more)


def _renamed(case: Case) -> Case:
    names = {spec["column"]: f"Kanal {k} ({c})" for k, (c, spec) in enumerate(case.columns.items())}
    return replace(
        case.tables(lambda t: {names.get(k, k): v for k, v in t.items()}),
        columns={c: {**s, "column": names[s["column"]]} for c, s in case.columns.items()},
    )


DEGREES: Final = {"rad": ("deg", 180 / np.pi), "deg": ("rad", np.pi / 180), "m": ("mm", 1e3)}
TURNS: Final = {"rad": ("rev", 0.5 / np.pi), "deg": ("rev", 1 / 360), "m": ("um", 1e6)}
RPM: Final = {"rad/s": ("rpm", 30 / np.pi)}
DRIVE: Final = {
    "A": ("mA", 1e3),
    "N.m": ("mN.m", 1e3),
    "Nm": ("mN.m", 1e3),
    "N": ("kN", 1e-3),
    "V": ("mV", 1e3),
}

Transform = Callable[[Case], "Case | None"]
TRANSFORMS: Final[Mapping[str, tuple[bool, Transform]]] = {
    # name: (notation only, what it does; None where the joint has no such channel)
    "time in ms": (True, lambda c: c.scaled(["time"], 1e3, unit="ms")),
    "positions in deg": (True, lambda c: _in_unit(c, POSITIONS, DEGREES)),
    "positions in rev": (True, lambda c: _in_unit(c, POSITIONS, TURNS)),
    "velocities in rpm": (True, lambda c: _in_unit(c, SPEEDS, RPM)),
    "drive in mA": (True, lambda c: _in_unit(c, DRIVES, DRIVE)),
    "link torque in mN.m": (True, lambda c: _in_unit(c, ["link_torque"], DRIVE)),
    "drive reversed": (True, lambda c: _signed(c, DRIVES)),
    "motor reversed": (True, lambda c: _signed(c, MOTOR)),
    "link reversed": (True, lambda c: _signed(c, LINK)),
    "motor remounted": (True, _remounted),
    "columns reversed": (True, lambda c: c.tables(lambda t: dict(reversed(t.items())))),
    "constant columns": (True, _with_constants),
    "other names": (True, _renamed),
    "csv": (True, lambda c: replace(c, form="csv")),
    "csv, decimal comma": (True, lambda c: replace(c, form="semi.csv")),
    "parquet": (True, lambda c: replace(c, form="parquet")),
    "mat": (True, lambda c: replace(c, form="mat")),
    "hdf5": (True, lambda c: replace(c, form="h5")),
    "rows written twice": (True, lambda c: c.tables(_written_twice)),
    "float32": (False, lambda c: replace(c, form="float32.npz")),
    "time shifted": (False, lambda c: _shifted(c, 1234.5)),
    "records reversed": (False, lambda c: replace(c, train=c.train[::-1], held=c.held[::-1])),
    "two runs each": (False, _in_runs),
    "two files each": (False, lambda c: replace(c, train=_halves(c.train), held=_halves(c.held))),
    "half the rate": (False, lambda c: c.tables(lambda t: {k: v[::2] for k, v in t.items()})),
    "zero moved": (False, _zero_moved),
    "mirrored": (False, _mirrored),  # noise drawn with one seed is not mirrored
}
TURNED: Final = ("motor remounted", "mirrored")
"""Here an angle is counted the other way, and parameters agree up to their signs."""
TWICE: Final = "a record twice"
"""Refused in one line: a run counts once."""


# --- files and results ----------------------------------------------------------------------------


def written(table: Table, path: Path, form: str) -> Path:
    """A table as a file of a format."""
    if form == "npz":
        np.savez(path, **table)  # type: ignore[arg-type]
    elif form == "float32.npz":
        np.savez(path, **{k: v.astype(np.float32) for k, v in table.items()})  # type: ignore[arg-type]
    elif form in ("csv", "semi.csv"):
        rows = np.column_stack(list(table.values())).tolist()
        text = "\n".join([";".join(table), *(";".join(map(repr, row)) for row in rows)]) + "\n"
        text = text.replace(".", ",") if form == "semi.csv" else text.replace(";", ",")
        path.write_text(text, encoding="utf-8")
    elif form == "parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(pa.table(table), path)
    elif form == "mat":
        import scipy.io

        scipy.io.savemat(path, table)
    else:
        import h5py

        with h5py.File(path, "w") as file:
            for name, values in table.items():
                file[name] = values
    return path


@final
@dataclass(frozen=True)
class Told:
    """A case after reading and the check gate."""

    joint: Joint
    train: tuple[Record, ...]
    held: tuple[Record, ...]

    def same(self, other: Told) -> bool:
        """Whether joint and records are bit for bit the same."""
        return (
            replace(self.joint, columns=None) == replace(other.joint, columns=None)
            and len(self.train) == len(other.train)
            and len(self.held) == len(other.held)
            and all(
                _same(a, b)
                for a, b in zip((*self.train, *self.held), (*other.train, *other.held), strict=True)
            )
        )


def _same(one: Record, other: Record) -> bool:
    return (
        np.array_equal(one.time, other.time)
        and np.array_equal(one.segment, other.segment)
        and np.array_equal(one.run_age(), other.run_age())
        and np.array_equal(_measured(one), _measured(other))
        and set(one.channels) == set(other.channels)
        and all(np.array_equal(one[c], other[c], equal_nan=True) for c in one.channels)
    )


def _measured(record: Record) -> npt.NDArray[np.bool_]:
    return np.ones(len(record), np.bool_) if record.measured is None else record.measured


def told(case: Case, folder: Path) -> Told:
    """Write the files of a case and read them as a user's."""
    joint = parse_joint({"joint": case.joint, "columns": case.columns}, source=case.name)

    def records(tables: Sequence[Table], what: str) -> tuple[Record, ...]:
        out = []
        for k, table in enumerate(tables):
            path = written(table, folder / f"{what}{k}.{case.form}", case.form)
            out.append(passed(read(path, joint.columns, joint.kind, f"{what}{k}"), joint)[0])
        return tuple(out)

    return Told(joint, records(case.train, "train"), records(case.held, "held"))


@final
@dataclass(frozen=True)
class Result:
    """What the loop says: verdict, named sets, parameters with standard errors."""

    verdict: str
    sets: tuple[tuple[str, ...], ...]
    parameters: Mapping[str, tuple[float, float]]

    def differences(self, other: Result, signs: bool = True) -> tuple[float, float, str]:
        """Largest difference of a parameter: relative, in standard errors (where it has one), and
        whose the first is; infinite where the parameters are not the same.

        Without `signs` sizes are compared: seen from the other end, an odd law of an angle changes
        the sign of its parameter.
        """
        if odd := set(self.parameters) ^ set(other.parameters):
            return np.inf, np.inf, ", ".join(sorted(odd))
        relative = sigmas = 0.0
        whose = ""
        for name, (a, error) in self.parameters.items():
            b = other.parameters[name][0]
            gap = abs(a - b) if signs else abs(abs(a) - abs(b))
            own = gap / max(abs(a), error) if gap else 0.0
            relative, whose = max((relative, whose), (own, name))
            sigmas = max(sigmas, gap / error if error else 0.0)
        return relative, sigmas, whose


def result_of(given: Told) -> Result:
    """Run the loop."""
    found = improve(given.train, given.joint, given.held)
    table = found.as_json()["steps"][-1]["parameters"]
    return Result(
        found.verdict,
        tuple(sorted(tuple(sorted(c.effects)) for c in found.claims)),
        {  # a phase follows from its two parts
            n: (p["value"], p["stderr"] or 0.0) for n, p in table.items() if p["meaning"] != "phase"
        },
    )


def row(name: str, transform: str, folder: Path, base: Told, result: Result) -> dict[str, Any]:
    """One row of the table."""
    out: dict[str, Any] = {"joint": name, "transform": transform}
    case = case_of(name)
    if transform == TWICE:
        try:
            improve([*base.train, base.train[0]], base.joint, base.held)
        except InputError as error:
            return {**out, "ok": "holds the same samples" in str(error), "said": "refused"}
        return {**out, "ok": False, "said": "taken"}
    notation, change = TRANSFORMS[transform]
    other = change(case)
    if other is None:
        return {**out, "ok": True, "said": "no such channel"}
    given = told(other, folder)
    if given.same(base):
        return {**out, "ok": True, "said": "same records"}
    found = result_of(given)
    relative, sigmas, whose = result.differences(found, signs=transform not in TURNED)
    agree = found.verdict == result.verdict and found.sets == result.sets
    return {
        **out,
        "ok": agree and (relative <= NOTATION or not notation),
        "verdict": found.verdict == result.verdict,
        "sets": found.sets == result.sets,
        "relative": relative,
        "sigmas": sigmas,
        "said": whose if agree else f"{found.verdict} {found.sets}",
    }


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.metamorphic", description=(__doc__ or "").partition("\n")[0]
    )
    every = [*TRANSFORMS, TWICE]
    parser.add_argument("--joints", nargs="+", default=[*HIDDEN, *RECORDED])
    parser.add_argument("--transforms", nargs="+", default=every, help="parts of their names")
    parser.add_argument("--json", type=Path, help="append the rows to this file, one a line")
    arguments = parser.parse_args()
    chosen = [t for t in every if any(part in t for part in arguments.transforms)]
    wrong = 0
    print(f"{'joint':<16} {'transform':<22} verdict sets   relative   sigmas      s")
    for name in arguments.joints:
        with tempfile.TemporaryDirectory() as place:
            base = told(case_of(name), Path(place))
            result = result_of(base)
            print(f"{name:<16} {'as it is':<22} {result.verdict} {result.sets}", flush=True)
            for transform in chosen:
                start = time.perf_counter()
                found = row(name, transform, Path(place), base, result)
                took = time.perf_counter() - start
                wrong += not found["ok"]
                mark = {True: "=", False: "other", None: ""}
                print(
                    f"{name:<16} {transform:<22} {mark[found.get('verdict')]:<7} "
                    f"{mark[found.get('sets')]:<6} {found.get('relative', 0.0):<10.1e} "
                    f"{found.get('sigmas', 0.0):<8.2g} {took:5.1f} "
                    f"{'' if found['ok'] else 'WRONG '}{found['said']}",
                    flush=True,
                )
                if arguments.json:
                    with arguments.json.open("a") as stream:
                        stream.write(json.dumps(found) + "\n")
    print(f"{wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
