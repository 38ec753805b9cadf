"""Is a healthy joint left alone, and is a sensor that fails named? On recordings as people bring
them.

``python -m tests.recorded_world.watch --joints 20 --start 346100`` fits the joint file to the first
record of a joint with nothing hidden, takes the limits of the fault bank from the same record, and
judges the second one: as it is, and with faults (``--faults`` of them for each joint, one at a
time). It prints what was said about healthy records, the share of faults that were seen, and the
share in which the failed sensor was named and nothing else. The bank judges every joint here; `irj
track` leaves those whose velocities are measured to the detector, which takes milliseconds and not
a second. ``--keep FOLDER`` keeps the files and the fits.
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
    from collections.abc import Sequence

    from identification.data.joint_file import Joint
    from identification.data.record import Record
    from identification.faults.bank import FaultBank
    from identification.faults.detector import Fault
    from identification.faults.types import FaultEvent

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


def watched(seed: int, folder: Path, given: str = "all", faults: int = 2) -> list[Watched] | str:
    """A joint's second record, healthy and with faults; why not, where no bank can watch it."""
    from benchmarks.fault_files.__main__ import opened
    from irj_fmu.estimator.bank import bank_for, judged

    case = make_case(seed, kind="none")
    here = write_case(case, folder / str(seed), given)
    joint = _fitted(here)
    train, test = (opened(here / f"{n}.csv", joint) for n in ("train", "test"))
    bank = bank_for(joint, test, [train])
    if bank is None:
        return "no bank: rigid, not fitted, or one encoder"
    events = judged(bank, test, joint).events
    out = [Watched(seed, None, tuple(_words(test, e) for e in events))]
    for number in range(faults):
        fault = drawn(seed, number, test, joint, bank)
        events = judged(bank, test, joint, [fault]).events
        out.append(scored(seed, fault, test, events))
    return out


def drawn(seed: int, number: int, record: Record, joint: Joint, bank: FaultBank) -> Fault:
    """The fault of a number: sensors and kinds take turns over the seeds."""
    from identification.faults.core import SENSORS
    from identification.faults.detector import Fault
    from irj_fmu.estimator.healthy import online_readings

    rng = stream(seed, "fault", number)
    sensor = bank.sensors[(seed + number) % len(bank.sensors)]
    kind = KINDS[(seed + 3 * number) % len(KINDS)]
    spread = float(np.nanstd(np.array(online_readings(record, joint)[0])[:, sensor]))
    name = SENSORS[sensor]
    share = SHARES.get(kind, (1.0, 1.0))[0 if name in TORQUES else 1]
    size = share if kind == "gain" else share * spread
    sign = float(rng.choice([-1.0, 1.0])) if kind in SHARES else 1.0
    return Fault(name, kind, float(rng.uniform(EARLIEST, LATEST)), sign * size)  # type: ignore[arg-type]


def scored(seed: int, fault: Fault, record: Record, events: Sequence[FaultEvent]) -> Watched:
    """Whether a fault was seen, and named with nothing else; what is said before it is wrong."""
    from benchmarks.fault_files.__main__ import names_sensor
    from identification.faults.types import Verdict

    since = record.time - record.time[0]
    real = [e for e in events if e.verdict is not Verdict.RECOVERED]
    early = [e for e in real if since[e.sample] < fault.start - record.dt]
    late = [e for e in real if e not in early and since[e.first] <= fault.start + LOOK]
    right = bool(late) and not early
    right = right and all(names_sensor(e) and e.sensors == (fault.sensor,) for e in late)
    said = tuple(_words(record, e) for e in [*early, *late])
    return Watched(seed, fault, said, bool(late), right)


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


def _words(record: Record, event: FaultEvent) -> str:
    names = " or ".join(event.sensors)
    when = record.time[event.sample] - record.time[0]
    return f"{when:.2f} s {event.verdict.name} {names}".strip()


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
    parser.add_argument("--keep", type=Path, help="folder of the files and fits")
    options = parser.parse_args(argv)
    found: list[Watched] = []
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as top:
        for seed in range(options.start, options.start + options.joints):
            own = watched(seed, options.keep or Path(top), options.sensors, options.faults)
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
