"""Recordings as people bring them, of joints that nobody tuned to, with their truth.

One seed is one joint: make, parameters, motion, sensors, troubles and what is hidden in it are
drawn from the seed alone, so that the four sensor sets see the same joint. Nothing of the project
is imported.

``python -m tests.recorded_world.world FOLDER --seeds 3 --start 7 --sensors all`` writes cases.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

import numpy as np

from tests.recorded_world import joints, motions, sensors
from tests.recorded_world._engine import INDEX, pack, simulate, write_csv
from tests.recorded_world.hidden import (
    LIBRARY,
    OF_MOTOR,
    OUTSIDE,
    SIDED,
    TRANSMISSION,
    Law,
    Setting,
    fits,
    visible,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from tests.recorded_world._engine import FloatArray
    from tests.recorded_world.joints import Plain
    from tests.recorded_world.sensors import Sensors

SECONDS: Final = 40.0
RECORDS: Final = ("train", "test")
SIZES: Final = (1.0, 0.3, 0.1)
HELD_BACK: Final = 100_000
"""Seeds from here on are never looked at while something is tuned."""
KINDS: Final = ("none", "single", "pair", "triple", "outside")
KIND_SHARE: Final = (0.25, 0.4, 0.1, 0.05, 0.2)
TROUBLES: Final = ("joint_zero", "rest", "stick", "dirt", *sensors.IDEAL)
"""What can be switched off, to find the cause of a failure."""
DIRT: Final = 0.02
"""Torque of the small unmodelled disturbances, as a share of the friction torque."""
DIRTY: Final = 0.33
"""Share of the joints that have them: there an answer may say that something is left
unexplained.
"""
UNITS: Final[Mapping[str, tuple[str, str]]] = {
    "motor_current": ("A", "A"),
    "motor_position": ("rad", "m"),
    "motor_velocity": ("rad_s", "m_s"),
    "link_position": ("rad", "m"),
    "link_velocity": ("rad_s", "m_s"),
    "link_torque": ("Nm", "N"),
}


@final
@dataclass(frozen=True)
class Case:
    """One joint with its recordings.

    Attributes
    ----------
    seed, kind, size, motion, names, laws
        What was drawn; ``names`` are the hidden ones.
    joint, sensors
        Before anything was hidden; how it was recorded.
    values
        Parameters of the integrator, the hidden ones among them.
    exact
        Per record the fine rows of `_engine.COLUMNS`.
    time, measured
        Per record the time [s] and the channels (`sensors.CHANNELS`).
    strength
        Largest share of the rms of current, torque or twist that the hidden laws make on the first
        record, same motion and same noise [%].
    dirty
        Whether small disturbances outside the library act beside what is hidden.
    """

    seed: int
    kind: str
    size: float
    motion: str
    names: tuple[str, ...]
    laws: Mapping[str, Law]
    joint: Plain
    sensors: Sensors
    values: Mapping[str, float]
    exact: Mapping[str, FloatArray]
    time: Mapping[str, FloatArray]
    measured: Mapping[str, FloatArray]
    strength: float
    dirty: bool


def stream(seed: int, *labels: object) -> np.random.Generator:
    """A random stream of its own for every part of a case."""
    text = "/".join(str(x) for x in (seed, *labels))
    digest = hashlib.sha256(text.encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "little"))


def held_back(seed: int) -> bool:
    """Whether a seed belongs to the part that is only measured."""
    return seed >= HELD_BACK


def _one(rng: np.random.Generator, among: Collection[str], joint: Plain) -> str:
    return str(rng.choice([n for n in among if fits(n, joint)]))


def draw_names(rng: np.random.Generator, kind: str, joint: Plain) -> tuple[str, ...]:
    """Names to hide: a pair or a triple has one in the motor, one in the transmission, one in
    the link's balance.
    """
    if kind == "none":
        return ()
    if kind == "single":
        return (_one(rng, LIBRARY, joint),)
    if kind == "outside":
        return (str(rng.choice(list(OUTSIDE))),)
    pair = (_one(rng, OF_MOTOR, joint), _one(rng, sorted(TRANSMISSION), joint))
    if kind == "pair":
        return pair
    link = [
        n
        for n in ("stribeck", "quadratic_drag", "asymmetric_viscous", "added_spring")
        if n not in pair
    ]
    return (*pair, str(rng.choice(link)))


def _laws(seed: int, names: tuple[str, ...], size: float, joint: Plain) -> dict[str, Law]:
    makers = {**LIBRARY, **OUTSIDE}
    laws: dict[str, Law] = {}
    for i, name in enumerate(names):
        rng = stream(seed, "law", name)
        on_link = i == 2 or (len(names) == 1 and name in SIDED and rng.random() < 0.25)
        laws[name] = makers[name](Setting(rng, size, joint, "L" if on_link else "M"))
    return laws


def _dirt(seed: int, joint: Plain) -> dict[str, float]:
    rng = stream(seed, "dirt")
    stroke = joint.make.stroke
    return {
        "L_BUMP": DIRT * joint.friction,
        "L_BUMP_X": rng.uniform(-0.5, 0.5) * stroke,
        "L_BUMP_W": 0.08 * stroke,
        "KE2": 0.002 * joint.load / joint.values["K"],
        "KE2_O": float(np.round(rng.uniform(2.3, 5.7), 2)),
        "KE2_P": float(rng.uniform(0.0, 6.28)),
    }


def neutral_value(joint: Plain, key: str) -> float:
    """What a parameter is where nothing is hidden."""
    return float(joint.values.get(key, pack({})[INDEX[key]]))


def _strength(joint: Plain, seen: FloatArray, plain: FloatArray) -> float:
    """Largest share [%] of the rms of current, torque or twist that the hidden laws make."""
    at = {n: i for i, n in enumerate(sensors.CHANNELS)}

    def channels(table: FloatArray) -> FloatArray:
        twist = table[:, at["motor_position"]] / joint.gear_ratio - table[:, at["link_position"]]
        return np.column_stack([table[:, at["motor_current"]], table[:, at["link_torque"]], twist])

    one, other = channels(seen), channels(plain)
    share = np.sqrt(np.mean((one - other) ** 2, axis=0) / np.var(one, axis=0))
    return float(100.0 * share.max())


def make_case(
    seed: int,
    *,
    without: Collection[str] = (),
    seconds: float = SECONDS,
    kind: str | None = None,
    names: tuple[str, ...] | None = None,
    size: float | None = None,
    make: str | None = None,
    motion: str | None = None,
) -> Case:
    """Draw a joint, hide something in it, move it, record it.

    Parameters
    ----------
    seed
        Everything is drawn from it.
    without
        Troubles to switch off (`TROUBLES`); the rest of the case stays as it is.
    seconds
        Length of each record.
    kind, names, size, make, motion
        Set by hand instead of drawn.
    """
    unknown = set(without) - set(TROUBLES)
    if unknown:
        raise ValueError(
            f"no such trouble: {', '.join(sorted(unknown))}; known: {', '.join(TROUBLES)}"
        )
    rng = stream(seed, "case")
    # makes and motions take turns, so that every run of seeds has all of them
    order = list(joints.MAKES)
    made = joints.MAKES[make or order[seed % len(order)]]
    drawn_motion = list(motions.MOTIONS)[(seed // len(order)) % len(motions.MOTIONS)]
    drawn_kind = str(rng.choice(KINDS, p=KIND_SHARE))
    drawn_size = float(rng.choice(SIZES))
    joint = joints.draw(
        stream(seed, "joint", made.name),
        made,
        any_zero="joint_zero" not in without,
        sticks="stick" not in without,
    )
    kind = kind or drawn_kind
    if names is None:
        names = draw_names(stream(seed, "names"), kind, joint)
    size, motion = (drawn_size if size is None else size), motion or drawn_motion
    logger = sensors.draw(stream(seed, "sensors"), joint)
    for trouble, ideal in sensors.IDEAL.items():
        if trouble in without:
            logger = replace(logger, **ideal)  # type: ignore[arg-type]
    laws = _laws(seed, names, size, joint)
    dirty = "dirt" not in without and stream(seed, "dirty").random() < DIRTY
    values = {**joint.values, **(_dirt(seed, joint) if dirty else {})}
    faults: dict[str, float] = {}
    pushes: list[tuple[float, float, float]] = []
    for law in laws.values():
        values |= law.values
        faults |= law.sensor
        pushes += law.pushes
    plain = {**values, **{k: neutral_value(joint, k) for law in laws.values() for k in law.values}}
    for law in laws.values():
        plain |= law.absent or {}
    exact, time, measured = {}, {}, {}
    strength = 0.0
    for name in RECORDS:
        fading = "rest" not in without
        path = motions.record(stream(seed, "motion", name), joint, motion, seconds, rests=fading)
        begin = path[0, 0]
        hang = values["TG"] * np.sin(begin + values["TG_P"])
        start = np.array([begin, 0.0, begin + hang / values["K"], 0.0])
        moments = stream(seed, "pushes", name).uniform(0.1, 0.85, len(pushes)) * seconds
        outside = np.array([(t, *push) for t, push in zip(moments, pushes, strict=True)])
        exact[name] = simulate(values, path, start, outside.reshape(-1, 4))
        noise = stream(seed, "noise", name)
        time[name], measured[name] = sensors.observe(noise, exact[name], joint, logger, faults)
        if names and name == RECORDS[0]:
            without_it = simulate(plain, path, start)
            again = stream(seed, "noise", name)
            strength = _strength(
                joint, measured[name], sensors.observe(again, without_it, joint, logger, {})[1]
            )
    return Case(
        seed=seed,
        kind=kind,
        size=size,
        motion=motion,
        names=names,
        laws=laws,
        joint=joint,
        sensors=logger,
        values=values,
        exact=exact,
        time=time,
        measured=measured,
        strength=strength,
        dirty=dirty,
    )


def joint_text(case: Case, given: str) -> str:
    """The joint file: what the engineer knows."""
    make, both = case.joint.make, given in ("all", "encoders")
    effects = ["viscous"] if "coulomb" in case.names else ["viscous", "coulomb"]
    if case.joint.values["TG"] > 0.0 and "gravity" not in case.names:
        effects.append("gravity")
    gap = case.joint.values["GAP"]
    if gap and both:
        effects.append("backlash")
    listed = ", ".join(f'"{e}"' for e in effects)
    constant = case.joint.make.per_current * (1.0 if make.linear else case.joint.sign)
    lines = [
        "[joint]",
        f'name = "{make.name} {case.seed}"',
        f'kind = "{"linear" if make.linear else "rotary"}"',
        f"gear_ratio = {case.joint.gear_ratio!r}",
        f"torque_per_current = {constant!r}",
        f'model = "{"hd3" if both else "hd1"}"',
        f"effects = [{listed}]",
    ]
    if gap and both:  # a catalogue value, wrong by a factor of three
        lines += ["", "[fitted]", f"backlash = {{ value = {3.0 * gap!r} }}"]
    return "\n".join(lines) + "\n"


def neutral(case: Case, given: str) -> tuple[str, ...]:
    """Names that are true of the joint without being hidden: not counted for or against."""
    found = []
    if case.joint.values["TG"] > 0.0 and case.joint.values["TG_P"] != 0.0:
        found.append("gravity_phase")
    if case.dirty:  # the disturbances hold a small error of the gear, of an odd order
        found.append("kinematic_error")
    if given in ("motor", "motor_torque"):
        found.append("transmission_compliance")
        if case.joint.values["GAP"]:
            found.append("backlash")
    late = max(case.sensors.link_skew, case.sensors.torque_skew)
    if late > 0.3 or case.sensors.filter:
        found.append("channel_delay")
    return tuple(found)


def truth(case: Case, given: str) -> dict[str, object]:
    """What the truth file says."""
    return {
        "seed": case.seed,
        "held_back": held_back(case.seed),
        "make": case.joint.make.name,
        "linear": case.joint.make.linear,
        "motion": case.motion,
        "kind": case.kind,
        "size": case.size if case.names else 0.0,
        "hidden": list(case.names),
        "neutral": neutral(case, given),
        "laws": {n: dict(law.truth) for n, law in case.laws.items()},
        "places": {n: law.place for n, law in case.laws.items()},
        "orders": {n: law.order for n, law in case.laws.items() if law.order is not None},
        "motor_turns": case.joint.make.ratio,
        "sensor_set": given,
        "dirty": case.dirty,
        "strength_percent": case.strength,
        "sensors": sensors.described(case.sensors),
        "values": dict(case.values),
    }


def write_case(case: Case, folder: Path, given: str) -> Path:
    """Write train.csv, test.csv, joint.toml and truth.json as seen by one sensor set; returns
    the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = [
        n for n in sensors.SETS[given] if case.sensors.velocities or not n.endswith("_velocity")
    ]
    pick = [sensors.CHANNELS.index(n) for n in names]
    unit = 1 if case.joint.make.linear else 0
    header = ",".join(["time_s", *(f"{n}_{UNITS[n][unit]}" for n in names)])
    for record in RECORDS:
        table = np.column_stack([case.time[record], case.measured[record][:, pick]])
        write_csv(folder / f"{record}.csv", header, table)
    (folder / "joint.toml").write_text(joint_text(case, given), encoding="utf-8")
    text = json.dumps(truth(case, given), indent=1)
    (folder / "truth.json").write_text(text + "\n", encoding="utf-8")
    return folder


def asked(case: Case, given: str) -> bool:
    """Whether these sensors are asked to show all that is hidden.

    A torque sensor beside the motor alone measures what the link asks for, whatever its laws: they
    stand in no balance of these readings.
    """
    behind = given == "motor_torque"
    return all(
        (name in OUTSIDE or visible(name, given)) and not (behind and law.place == "link")
        for name, law in case.laws.items()
    )


def main(argv: list[str] | None = None) -> int:
    """Write cases."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--sensors", choices=list(sensors.SETS), default="all")
    parser.add_argument(
        "--without", default="", help=f"troubles to switch off: {', '.join(TROUBLES)}"
    )
    parser.add_argument("--seconds", type=float, default=SECONDS)
    options = parser.parse_args(argv)
    without = [w for w in options.without.split(",") if w]
    for seed in range(options.start, options.start + options.seeds):
        case = make_case(seed, without=without, seconds=options.seconds)
        folder = write_case(case, options.folder / f"{seed}-{options.sensors}", options.sensors)
        sys.stdout.write(
            f"{folder}: {case.joint.make.name}, {case.motion}, "
            f"{'+'.join(case.names) or 'nothing'}\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
