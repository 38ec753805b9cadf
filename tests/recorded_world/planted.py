"""Effects planted on recordings of real axes, and how many are named.

The motion stays as it was recorded; the drive is given the torque that the planted law would have
asked for. Laws that the plain joint file lacks are to be named by ``improve``; parameters that
moved are to be named by ``changed``, against a joint file fitted on the plain recordings, which
are given as healthy ones.

``python -m tests.recorded_world.planted --rigs emps --sizes 1 0.3``

The recordings stand at ``../shared/measurements`` and stay there.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np
import numpy.typing as npt
from scipy.signal import savgol_filter

from identification.balance.weak import CLAIM_KERNEL, differentiated_kernel
from tests.recorded_world.campaign import ENTRY, load_entry, time_limit

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

FloatArray = npt.NDArray[np.float64]
Table = dict[str, FloatArray]

SHARED: Final = Path(__file__).resolve().parents[2].parent / "shared" / "measurements"
FILES: Final = Path(__file__).resolve().parent / "rigs"
SMOOTHING: Final = 0.02
"""Window of the cubic that gives velocity and acceleration of a recorded motion [s]: the mass of
emps then comes out within 2 % of the published one; 0.06 s blunts its ramps by 8 %."""


@final
@dataclass(frozen=True)
class Rig:
    """One recorded axis.

    Attributes
    ----------
    load
        Gives the tables to fit and the held-out tables, columns by name.
    drive, per_unit
        Column of the drive, and the axis' torque per unit of it.
    position, to_si
        Column of the position and its factor to rad (m).
    step
        Sampling interval [s].
    friction, inertia, speed
        Scales of what is planted: two fifths of the drive's rms, the inertia of a plain fit, a
        usual speed.
    pitch
        Travel of one period of the planted ripple [rad, m].
    """

    name: str
    load: Callable[[], tuple[list[Table], list[Table]]]
    drive: str
    per_unit: float
    position: str
    to_si: float
    step: float
    friction: float
    inertia: float
    speed: float
    pitch: float


def _csv(path: Path) -> Table:
    data = np.genfromtxt(path, delimiter=",", names=True)
    return {str(n): np.asarray(data[n], dtype=np.float64) for n in data.dtype.names or ()}


def _emps() -> tuple[list[Table], list[Table]]:
    folder = SHARED / "emps"
    return [_csv(folder / "train.csv")], [_csv(folder / "test_pulses.csv")]


def _kuka() -> tuple[list[Table], list[Table]]:
    a, b, c = (_csv(SHARED / "kuka_kr300" / f"{n}.csv") for n in "ABC")
    return [a, b], [c]


def _quanser() -> tuple[list[Table], list[Table]]:
    table = _csv(SHARED / "quanser_2dsfl" / "ctu_lqr.csv")
    # the gauge counts the link ahead of the joint as positive: joint minus link, the twist that
    # speeds the link up, goes with its acceleration (r = 0.76 with this sign, -0.48 with the other)
    table["link1_deg"] = table["q1_deg"] + table["defl1_deg"]
    half = len(table["t_s"]) // 2
    parts = [{k: v[s] for k, v in table.items()} for s in (slice(0, half), slice(half, None))]
    return parts[:1], parts[1:]


def _bam() -> tuple[list[Table], list[Table]]:
    rows = np.genfromtxt(
        SHARED / "bam_xl330" / "xl330.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    rows = rows[np.array([str(v) == "True" for v in rows["torque_enable"]])]
    gain = (4096 / 2 / np.pi) / (128 * 885)  # duty per count of error, as the firmware has it
    duty = np.clip(gain * rows["kp"] * (rows["q_ref_rad"] - rows["q_rad"]), -1, 1)
    table = {
        "t_s": rows["t_s"],
        "q_rad": rows["q_rad"],
        "volts": duty * rows["vin_V"],
        "kp": rows["kp"],
        "run": np.unique(rows["run"], return_inverse=True)[1],
    }

    def part(*gains: int) -> Table:
        keep = np.isin(rows["kp"], gains)
        return {k: np.asarray(v[keep], dtype=np.float64) for k, v in table.items()}

    return [part(100, 400)], [part(200, 800)]


RIGS: Final[Mapping[str, Rig]] = {
    r.name: r
    for r in (
        Rig(
            name="emps",
            load=_emps,
            drive="u_V",
            per_unit=35.15065188,
            position="q_m",
            to_si=1.0,
            step=1e-3,
            friction=20.4,
            inertia=95.1,
            speed=0.12,
            pitch=0.01,
        ),
        # friction and inertia of a plain fit; the ripple is the second order of the motor turn
        Rig(
            name="kuka_axis1",
            load=_kuka,
            drive="axis1_motor_torque_Nm",
            per_unit=256.857142857,
            position="axis1_motor_position_link_referred_deg",
            to_si=np.pi / 180.0,
            step=4e-3,
            friction=390.0,
            inertia=1560.0,
            speed=0.4,
            pitch=np.pi / 256.857142857,
        ),
        Rig(
            name="quanser",
            load=_quanser,
            drive="i1_A",
            per_unit=8.925,
            position="q1_deg",
            to_si=np.pi / 180.0,
            step=2e-3,
            friction=0.9,
            inertia=0.35,
            speed=1.0,
            pitch=np.pi / 100.0,
        ),
        # the drive counts volts: sizes are volts per unit
        Rig(
            name="bam_xl330",
            load=_bam,
            drive="volts",
            per_unit=1.0,
            position="q_rad",
            to_si=1.0,
            step=1.0 / 240.0,
            friction=1.8,
            inertia=0.05,
            speed=5.0,
            pitch=2.0 * np.pi / 12.0,
        ),
    )
}


@final
@dataclass(frozen=True)
class Motion:
    """A recorded motion, smoothed: position, velocity, acceleration, drive torque, each of
    shape (rows,).
    """

    q: FloatArray
    v: FloatArray
    a: FloatArray
    torque: FloatArray
    step: float


Planted = tuple["Callable[[Rig, Motion, float], FloatArray]", frozenset[str]]


def _ripple(rig: Rig, m: Motion, size: float) -> FloatArray:
    return 0.15 * size * rig.friction * np.sin(2.0 * np.pi * m.q / rig.pitch + 0.7)


@cache
def travel(rig: Rig) -> tuple[float, float]:
    """Lowest and highest position of all records: a law is one law for each of them."""
    positions = [t[rig.position] * rig.to_si for tables in rig.load() for t in tables]
    return min(float(q.min()) for q in positions), max(float(q.max()) for q in positions)


def _spring(rig: Rig, m: Motion, size: float) -> FloatArray:
    low, high = travel(rig)
    return np.asarray(size * rig.friction / (high - low) * (m.q - 0.5 * (low + high)))


def _offset(rig: Rig, m: Motion, size: float) -> FloatArray:
    return np.full_like(m.q, -0.25 * size * rig.friction)


def _delay(_: Rig, m: Motion, size: float) -> FloatArray:
    rows = np.arange(len(m.q))
    late = np.interp(rows - 8e-3 * size / m.step, rows, m.torque)
    return np.asarray(late - m.torque)


def _stribeck(rig: Rig, m: Motion, size: float) -> FloatArray:
    near = np.tanh(m.v / (0.01 * rig.speed))
    return 0.5 * size * rig.friction * near * np.exp(-np.abs(m.v) / (0.08 * rig.speed))


def _dahl(rig: Rig, m: Motion, size: float) -> FloatArray:
    """Part of the dry friction builds up over a distance: bristle minus sign."""
    low, high = travel(rig)
    distance = 0.01 * (high - low)
    z = np.zeros_like(m.q)
    for i in range(1, len(z)):
        z[i] = np.clip(z[i - 1] + (m.q[i] - m.q[i - 1]) / distance, -1.0, 1.0)
    return 0.5 * size * rig.friction * (z - np.tanh(m.v / (0.01 * rig.speed)))


def _coulomb(rig: Rig, m: Motion, size: float) -> FloatArray:
    return 0.25 * size * rig.friction * np.tanh(m.v / (0.01 * rig.speed))


def _mass(rig: Rig, m: Motion, size: float) -> FloatArray:
    return 0.1 * size * rig.inertia * m.a


def _gain(_: Rig, m: Motion, size: float) -> FloatArray:
    return m.torque * (1.0 / (1.0 - 0.15 * size) - 1.0)


NEW: Final[Mapping[str, Planted]] = {
    "ripple": (_ripple, frozenset({"torque_ripple"})),
    "delay": (_delay, frozenset({"channel_delay"})),
    "spring": (_spring, frozenset({"added_spring"})),
    "offset": (_offset, frozenset({"current_offset", "asymmetric_coulomb"})),
    "stribeck": (_stribeck, frozenset({"stribeck", "smooth_stribeck"})),
    "dahl": (_dahl, frozenset({"lugre"})),
}
"""Laws that a joint file lacks, and the names that are right for them."""
CHANGED: Final[Mapping[str, Planted]] = {
    "coulomb": (_coulomb, frozenset({"coulomb", "motor_coulomb"})),
    "mass": (_mass, frozenset({"inertia", "motor_inertia", "extra_inertia"})),
    "offset": (
        _offset,
        frozenset({"current_offset", "asymmetric_coulomb", "motor_asymmetric_coulomb"}),
    ),
    "gain": (
        _gain,
        frozenset({"motor_constant_error", "torque_per_current", "motor_constant", "gain"}),
    ),
}
"""Parameters that move, and the names that are right for them."""


def _moved(rig: Rig, effect: str, size: float) -> float:
    """By how much a planted change moves its parameter, in its unit."""
    share = {"coulomb": 0.25 * rig.friction, "mass": 0.1 * rig.inertia, "gain": 0.15}
    return size * share.get(effect, 0.25 * rig.friction)


def motion(rig: Rig, table: Table) -> Motion:
    """Smoothed motion of one table; runs are smoothed on their own."""
    q, torque = table[rig.position] * rig.to_si, table[rig.drive] * rig.per_unit
    window = max(round(SMOOTHING / rig.step) // 2 * 2 + 1, 5)
    v, a = np.empty_like(q), np.empty_like(q)
    runs = table.get("run", np.zeros(len(q)))
    for run in np.unique(runs):
        rows = runs == run
        v[rows], a[rows] = (
            savgol_filter(q[rows], window, 3, deriv=d, delta=rig.step) for d in (1, 2)
        )
    return Motion(q, v, a, torque, rig.step)


def plant(
    rig: Rig, table: Table, law: Callable[[Rig, Motion, float], FloatArray], size: float
) -> Table:
    """The table with the law's torque on its drive."""
    added = law(rig, motion(rig, table), size) / rig.per_unit
    return {**table, rig.drive: table[rig.drive] + added}


def write(tables: list[Table], folder: Path, name: str) -> list[Path]:
    """Write tables as name1.csv, name2.csv, ..."""
    paths = []
    folder.mkdir(parents=True, exist_ok=True)
    for i, table in enumerate(tables, 1):
        path = folder / f"{name}{i}.csv"
        rows = np.column_stack(list(table.values()))
        np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(table), comments="")
        paths.append(path)
    return paths


@final
@dataclass(frozen=True)
class Outcome:
    """What was said of one planted effect: claims by set, wrong unmarked names, whether the
    right one is among them, and whether the answer says itself that it could not have seen it.
    """

    rig: str
    effect: str
    size: float
    task: str
    right: bool
    alone: bool
    wrong: tuple[str, ...]
    said: str
    unseen: bool = False


def _sets(result: Mapping[str, Any]) -> list[tuple[frozenset[str], bool]]:
    claims = [
        (frozenset(str(e).partition("@")[0] for e in c["effects"]), bool(c.get("partial")))
        for c in result["claims"]
        if "curve" not in c
    ]
    lines = [frozenset(map(str, x["effects"])) for x in result.get("lines", [])]
    # a line without a name names nothing
    return claims + [(names, False) for names in lines if names]


def _calibrated(result: Mapping[str, Any]) -> bool:
    return any(
        c["what"] == "skew" and abs(float(c["value"])) > 1e-3 for c in result.get("calibration", [])
    )


def judged(
    result: Mapping[str, Any], right: frozenset[str], usual: frozenset[str]
) -> tuple[bool, bool, tuple[str, ...]]:
    """Whether a right name is in a set, stands alone, and which unmarked claims hold neither it
    nor a usual name.
    """
    sets = _sets(result)
    found = any(names & right for names, _ in sets) or (
        "channel_delay" in right and _calibrated(result)
    )
    alone = any(names <= right for names, _ in sets)
    wrong = tuple(
        "|".join(sorted(n)) for n, marked in sets if not marked and not n & (right | usual)
    )
    return found, alone, wrong


def _refused(rig: Rig, effect: str, size: float, task: str, why: str) -> Outcome:
    return Outcome(
        rig=rig.name,
        effect=effect or "nothing",
        size=size,
        task=task,
        right=False,
        alone=False,
        wrong=(),
        said=f"REFUSED {why}",
    )


def _new(
    rig: Rig, effects: list[str], sizes: list[float], limit: int, folder: Path
) -> list[Outcome]:
    improve, joint = load_entry(ENTRY), FILES / f"{rig.name}.toml"
    train, held = rig.load()
    listed = set(tomllib.loads(joint.read_text(encoding="utf-8"))["joint"]["effects"])
    # what the joint file has already cannot be found missing in it: then it is a change
    effects = [e for e in effects if not NEW[e][1] & listed]
    outcomes: list[Outcome] = []
    usual: frozenset[str] = frozenset()
    for effect, size in [("", 0.0), *((e, s) for e in effects for s in sizes)]:
        law, right = NEW[effect] if effect else (None, frozenset[str]())
        here = folder / f"{rig.name}-{effect or 'plain'}-{size:g}"
        files = [
            write([plant(rig, t, law, size) for t in tables] if law else tables, here, name)
            for name, tables in (("train", train), ("held", held))
        ]
        began = time.process_time()
        try:
            with time_limit(limit):
                result = improve(files[0], files[1], joint)
        except Exception as error:  # the refusal of one case is its result
            outcomes.append(_refused(rig, effect, size, "new", str(error)))
            continue
        if not effect:
            usual = frozenset().union(*(names for names, _ in _sets(result)))
        found, alone, wrong = judged(result, right, usual)
        left = result["steps"][-1]["held_out"]["relative_error_percent"]
        sets = (
            "; ".join(("in part " if m else "") + "|".join(sorted(n)) for n, m in _sets(result))
            or "no claim"
        )
        said = f"{sets}. {result['verdict']}, {left:.1f} %, {time.process_time() - began:.0f} s"
        told = [x["least"] for x in result["refused"] if x["effect"] in right and "least" in x]
        unseen = bool(law and told and not found) and min(told) > _size(rig, train, law, size)
        said += ", too small to be seen" if unseen else ""
        outcomes.append(
            Outcome(
                rig=rig.name,
                effect=effect or "nothing",
                size=size,
                task="new",
                right=found,
                alone=alone,
                wrong=wrong,
                said=said,
                unseen=unseen,
            )
        )
    return outcomes


def _size(
    rig: Rig, tables: list[Table], law: Callable[[Rig, Motion, float], FloatArray], size: float
) -> float:
    """RMS of what a law adds to the drive's torque, averaged as the rows of a balance are."""
    row = differentiated_kernel(CLAIM_KERNEL, rig.step, 0)
    added = [np.convolve(law(rig, motion(rig, t), size), row, "same") for t in tables]
    return float(np.sqrt(np.mean(np.concatenate(added) ** 2)))


def _verb(*words: str) -> tuple[int, str]:
    """Run one verb of the command line; exit code and what it printed."""
    from workbench.entry import main as entry

    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        try:
            code = int(entry(list(words)) or 0)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 2
    return code, text.getvalue()


def _changed(rig: Rig, effects: list[str], sizes: list[float], folder: Path) -> list[Outcome]:
    train, held = rig.load()
    healthy, reference = (
        write(train, folder / f"{rig.name}-healthy", "train"),
        folder / f"{rig.name}.toml",
    )
    code, text = _verb(
        "fit", *map(str, healthy), "--joint", str(FILES / f"{rig.name}.toml"), "-o", str(reference)
    )
    if code:
        why = f"no reference: {text.splitlines()[-1]}"
        return [_refused(rig, "", 0.0, "changed", why)]
    outcomes = []
    usual: frozenset[str] = frozenset()
    for effect, size in [("", 0.0), *((e, s) for e in effects for s in sizes)]:
        law, right = CHANGED[effect] if effect else (None, frozenset[str]())
        # the records that were not fitted: a change is found on new motion
        given = [plant(rig, t, law, size) for t in held] if law else held
        files = write(given, folder / f"{rig.name}-changed-{effect}-{size:g}", "now")
        out = folder / "changed.json"
        before = ("--healthy", *map(str, healthy))
        code, text = _verb("changed", str(reference), *map(str, files), *before, "--json", str(out))
        if code == 2:
            last = next((x for x in reversed(text.splitlines()) if x.strip()), "no answer")
            why = last.partition(" (choose")[0]
            outcomes.append(_refused(rig, effect, size, "changed", why))
            continue
        answer = json.loads(out.read_text(encoding="utf-8"))
        moved, least = answer["changed"], answer["least"]
        sets = [(str(c["parameter"]), *map(str, c.get("tied_with", ()))) for c in moved]
        # what differs between the recordings without any hand is no wrong name
        if not effect:
            usual = frozenset(str(c["parameter"]) for c in moved)
        wrong = tuple("|".join(n) for n in sets if effect and not set(n) & (right | usual))
        good = any(set(names) & right for names in sets)
        said = ", ".join("|".join(names) for names in sets) or "nothing changed"
        told = [least[n] for n in right if n in least]
        unseen = not good and bool(told) and min(told) > _moved(rig, effect, size)
        said += ", too small to be seen" if unseen else ""
        outcomes.append(
            Outcome(
                rig=rig.name,
                effect=effect or "nothing",
                size=size,
                task="changed",
                right=good,
                alone=good and all(set(names) <= right for names in sets),
                wrong=wrong,
                said=said,
                unseen=unseen,
            )
        )
    return outcomes


def table(outcomes: list[Outcome]) -> str:
    """Markdown of all outcomes, with the figures that count below."""
    text = [
        "| rig | planted | size | asked | right name | alone | wrong unmarked | said |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for o in outcomes:
        marks = ["-" if o.effect == "nothing" else "yes" if b else "no" for b in (o.right, o.alone)]
        said = o.said.replace("|", " or ")
        wrong = ", ".join(o.wrong).replace("|", " or ") or "-"
        text.append(
            f"| {o.rig} | {o.effect} | {o.size:g} | {o.task} | {marks[0]} | {marks[1]} | {wrong} "
            f"| {said} |"
        )
    text.append("")
    for task in ("new", "changed"):
        asked = [o for o in outcomes if o.task == task and o.effect != "nothing"]
        if asked:
            good, bad = sum(o.right for o in asked), sum(bool(o.wrong) for o in asked)
            text.append(
                f"{task}: named alone or in its set {good} of {len(asked)}; "
                f"with a wrong unmarked name {bad} of {len(asked)}"
            )
            if unseen := sum(o.unseen for o in asked):
                seen = sum(o.right and not o.unseen for o in asked)
                text[-1] += (
                    f"; said to be too small to be seen {unseen}, of the others named {seen}"
                )
    return "\n".join(text) + "\n"


def main(argv: list[str] | None = None) -> int:
    """Plant, ask, print."""
    p = argparse.ArgumentParser(prog="python -m tests.recorded_world.planted", description=__doc__)
    p.add_argument(
        "--rigs", nargs="+", choices=list(RIGS), default=["emps", "kuka_axis1", "quanser"]
    )
    p.add_argument("--effects", nargs="*", choices=[*NEW, *CHANGED], default=[*NEW, *CHANGED])
    p.add_argument("--sizes", nargs="+", type=float, default=[1.0])
    p.add_argument("--limit", type=float, default=180.0, help="processor seconds for one answer")
    p.add_argument("--keep", type=Path, help="folder that keeps the planted records")
    options = p.parse_args(argv)
    if not SHARED.exists():
        sys.stderr.write(f"{SHARED}: the recordings are not there\n")
        return 2
    outcomes: list[Outcome] = []
    with contextlib.ExitStack() as stack:
        folder = options.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for name in options.rigs:
            chosen = list(dict.fromkeys(options.effects))
            new = [e for e in chosen if e in NEW]
            moved = [e for e in chosen if e in CHANGED]
            outcomes += _new(RIGS[name], new, options.sizes, options.limit, folder) if new else []
            outcomes += _changed(RIGS[name], moved, options.sizes, folder) if moved else []
            sys.stderr.write(f"{name} done\n")
    sys.stdout.write(table(outcomes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
