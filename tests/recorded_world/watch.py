"""Is a healthy joint left alone, and is a sensor that fails named? On recordings as people bring
them.

``python -m tests.recorded_world.watch --joints 20 --start 346100`` fits the joint file to the first
record of a joint with nothing hidden, takes the limits of the fault bank from the same record, and
judges the second one: as it is, and with faults (``--faults`` of them for each joint, one at a
time). It prints what was said about healthy records, the share of faults that were seen, and the
share in which the failed sensor was named and nothing else. ``--rule detector`` asks the detector
of the estimator FMUs, which takes milliseconds and not a second, about the joints whose velocities
are measured; ``--velocities`` leaves out the others. ``--keep FOLDER`` keeps the files and the
fits.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

import numpy as np

from tests.recorded_world.sensors import SETS
from tests.recorded_world.world import make_case, stream, write_case

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from identification.data.joint_file import Joint
    from identification.data.record import Record
    from identification.faults.detector import Fault

KINDS: Final = ("bias", "drift", "gain", "noise", "spike", "stuck", "dropout")
TORQUES: Final = ("current", "torque")
SHARES: Final = {"bias": (0.5, 0.1), "drift": (0.25, 0.05), "gain": (0.3, 0.1)}
"""Size of a fault as a share of the reading's spread (gain: of the reading): torques, others.
Noise and spikes are as large as the spread."""
EARLIEST, LATEST = 8.0, 25.0
"""When a fault begins [s]."""
LOOK: Final = 6.0
"""Seconds after the beginning of a fault in which it has to be seen."""


@final
@dataclass(frozen=True)
class Watched:
    """What was said about one record."""

    seed: int
    fault: Fault | None
    said: tuple[str, ...]
    seen: bool = False
    right: bool = False


Said = tuple[float, float, tuple[str, ...], bool]
"""When something was said and when it began [s], about which sensors, whether it names one."""


def watched(
    seed: int, folder: Path, given: str = "all", faults: int = 2, rule: str = "bank"
) -> list[Watched] | str:
    """A joint's second record, healthy and with faults; why not, where nothing can watch it."""
    from benchmarks.fault_files.__main__ import opened

    case = make_case(seed, kind="none")
    here = write_case(case, folder / str(seed), given)
    joint = _fitted(here)
    train, test = (opened(here / f"{n}.csv", joint) for n in ("train", "test"))
    judge = (_bank if rule == "bank" else _detector)(joint, train, test)
    if judge is None:
        return "nothing can watch it: rigid, not fitted, or a sensor is missing"
    out = [Watched(seed, None, tuple(map(_words, judge([]))))]
    for number in range(faults):
        fault = drawn(seed, number, test, joint)
        out.append(scored(seed, fault, test, judge([fault])))
    return out


def _bank(
    joint: Joint, train: Record, test: Record
) -> Callable[[Sequence[Fault]], list[Said]] | None:
    """What the fault bank says."""
    from benchmarks.fault_files.__main__ import names_sensor
    from identification.faults.types import Verdict
    from irj_fmu.estimator.bank import bank_for, judged

    bank = bank_for(joint, test, [train])
    if bank is None:
        return None

    def judge(faults: Sequence[Fault]) -> list[Said]:
        track, since = judged(bank, test, joint, faults), test.time - test.time[0]
        return [
            (float(since[e.sample]), float(since[e.first]), e.sensors, names_sensor(e))
            for e in track.events
            if e.verdict is not Verdict.RECOVERED
        ]

    return judge


def _detector(
    joint: Joint, train: Record, test: Record
) -> Callable[[Sequence[Fault]], list[Said]] | None:
    """What the detector of the estimator says."""
    from identification.data.check.checks import repair
    from identification.faults.core import SENSORS
    from identification.online.verdict import CURRENT_OR_FRICTION, MISSING
    from workbench.cli.online import limits, replay

    if not test.has("motor_velocity", "link_velocity", "link_torque"):
        return None
    healthy, whole = repair(train), repair(test)
    state = limits(joint, whole, [healthy])

    def judge(faults: Sequence[Fault]) -> list[Said]:
        out: list[Said] = []
        for event in replay(whole, joint, state, faults, progress=lambda *_: None).events:
            code, when = event["fault"], float(event["time"] - test.time[0])
            at = code % MISSING if code < 2 * MISSING else 0
            at = 1 if code == CURRENT_OR_FRICTION else at
            one = 1 <= at <= len(SENSORS)
            out.append((when, when, (SENSORS[at - 1],) if one else (event["text"],), one))
        return out

    return judge


def drawn(seed: int, number: int, record: Record, joint: Joint) -> Fault:
    """The fault of a number: sensors and kinds take turns over the seeds."""
    from identification.faults.core import SENSORS
    from identification.faults.detector import Fault
    from irj_fmu.estimator.bank import measured_sensors
    from irj_fmu.estimator.healthy import online_readings

    rng = stream(seed, "fault", number)
    there = np.flatnonzero(measured_sensors(record)).tolist()
    sensor = there[(seed + number) % len(there)]
    kind = KINDS[(seed + 3 * number) % len(KINDS)]
    spread = float(np.nanstd(np.array(online_readings(record, joint)[0])[:, sensor]))
    name = SENSORS[sensor]
    share = SHARES.get(kind, (1.0, 1.0))[0 if name in TORQUES else 1]
    size = share if kind == "gain" else share * spread
    sign = float(rng.choice([-1.0, 1.0])) if kind in SHARES else 1.0
    return Fault(name, kind, float(rng.uniform(EARLIEST, LATEST)), sign * size)  # type: ignore[arg-type]


def scored(seed: int, fault: Fault, record: Record, said: Sequence[Said]) -> Watched:
    """Whether a fault was seen, and named with nothing else; what is said before it is wrong."""
    early = [e for e in said if e[0] < fault.start - record.dt]
    late = [e for e in said if e not in early and e[1] <= fault.start + LOOK]
    right = bool(late) and not early
    right = right and all(one and sensors == (fault.sensor,) for _, _, sensors, one in late)
    return Watched(seed, fault, tuple(map(_words, [*early, *late])), bool(late), right)


def _fitted(folder: Path) -> Joint:
    """The joint fitted to train.csv, once."""
    from identification.data.joint_file import load_joint
    from workbench.cli.main import main as irj

    found = folder / "fitted.toml"
    if not found.is_file():
        words = ["fit", str(folder / "train.csv"), "--joint", str(folder / "joint.toml")]
        with contextlib.redirect_stdout(io.StringIO()):
            code = irj([*words, "-o", str(found)])
        if code:
            raise SystemExit(f"{folder}: irj fit ended with {code}")
    return load_joint(found)


def _words(said: Said) -> str:
    when, _, sensors, _ = said
    return f"{when:.2f} s {' or '.join(sensors) or 'the joint changed'}"


def main(argv: Sequence[str] | None = None) -> int:
    """Print what was said, and the shares."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.recorded_world.watch",
        description=(__doc__ or "").partition("\n\n")[0],
    )
    parser.add_argument("--joints", type=int, default=20)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--faults", type=int, default=2, help="faults for each joint")
    parser.add_argument("--sensors", choices=SETS, default="all")
    parser.add_argument("--rule", choices=("bank", "detector"), default="bank")
    parser.add_argument("--velocities", action="store_true", help="joints that measure them")
    parser.add_argument("--keep", type=Path, help="folder of the files and fits")
    options = parser.parse_args(argv)
    found: list[Watched] = []
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as top:
        for seed in range(options.start, options.start + options.joints):
            if options.velocities and not make_case(seed, kind="none").sensors.velocities:
                continue
            folder = options.keep or Path(top)
            own = watched(seed, folder, options.sensors, options.faults, options.rule)
            if isinstance(own, str):
                sys.stdout.write(f"{seed}: {own}\n")
                continue
            found += own
            for w in own:
                what = "healthy" if w.fault is None else f"{w.fault.sensor} {w.fault.kind}"
                if w.said if w.fault is None else not w.right:
                    when = "" if w.fault is None else f" from {w.fault.start:.2f} s"
                    sys.stdout.write(f"{seed}, {what}{when}: {'; '.join(w.said) or 'nothing'}\n")
            sys.stdout.flush()
    healthy = [w for w in found if w.fault is None]
    wrong = sum(bool(w.said) for w in healthy)
    sys.stdout.write(f"healthy records: {len(healthy)}, something said about {wrong}\n")
    faulty = [w for w in found if w.fault is not None]
    if faulty:
        seen, right = sum(w.seen for w in faulty), sum(w.right for w in faulty)
        sys.stdout.write(
            f"faults: {len(faulty)}, seen {100 * seen / len(faulty):.0f} %, the sensor named and "
            f"nothing else {100 * right / len(faulty):.0f} %\n"
        )
        for text, key in (("sensor", "sensor"), ("kind", "kind")):
            total = Counter(getattr(w.fault, key) for w in faulty)
            good = Counter(getattr(w.fault, key) for w in faulty if w.right)
            sys.stdout.write(f"  {text}: " + ", ".join(f"{n} {good[n]}/{total[n]}" for n in total))
            sys.stdout.write("\n")
    sys.stdout.write(f"{time.monotonic() - begin:.0f} s\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
