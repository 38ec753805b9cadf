"""Fault campaign: healthy hours, fault cases, plant changes, replacement, identification under
failure, sizes.

    python -m benchmarks.fault_campaign --out docs/faults.md [--jobs 2]
    python -m benchmarks.fault_campaign faults sizes --keep results.json

Without names, everything: about ten minutes of processor time. Simulated IRJ-like joints with the
noise of table B.1; the detector's model differs from the plant (`ERRORS`), and the trajectories of
the test are none of those of the calibration. `--keep` stores what was found and adds to what is
there, so that parts can be run one by one.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.faults.identify import (
    MODEL_NAMES,
    NAMES,
    SCALE,
    identify,
    least_squares,
    regression,
)
from benchmarks.faults.page import printed, write_page
from benchmarks.faults.plant import (
    DT,
    FACTORS,
    SIZES,
    START,
    detector_model,
    pairs,
    plant,
    readings,
    reference,
)
from identification.faults.detector import (
    KINDS,
    SENSORS,
    Fault,
    FaultDetector,
    FaultEvent,
    Verdict,
    inject,
)
from identification.planning.follow import Follower

__all__ = [
    "MODEL_NAMES",
    "NAMES",
    "SCALE",
    "Campaign",
    "detector_model",
    "least_squares",
    "plant",
    "readings",
    "reference",
    "regression",
]
FloatArray = npt.NDArray[np.float64]

CHANGES: dict[str, dict[str, float]] = {
    "stiffness -20 %": {"stiffness": 0.8, "cubic_stiffness": 0.8},
    "motor Coulomb +50 %": {"motor_coulomb": 1.5},
    "payload +20 %": {"link_inertia": 1.2, "gravity_torque": 1.2},
    "link viscous x 3": {"link_viscous": 3.0},
}
REPLACED = ("noise", "stuck", "zero", "dropout", "bias", "gain")


class Campaign:
    """Plant and the two detectors, calibrated on two minutes."""

    def __init__(self) -> None:
        self.joint = plant()
        self.follower = Follower(self.joint, DT)
        self.record = readings(self.follower.run(reference(1, 120.0)), 1)
        model = detector_model(self.joint)
        self.detector, self.thesis = FaultDetector(model, DT), FaultDetector(model, DT, "thesis")
        self.detector.calibrate(self.record)
        self.thesis.calibrate(self.record)

    def unseen(self, seed: int, seconds: float) -> FloatArray:
        """Healthy readings along a trajectory of their own."""
        return readings(self.follower.run(reference(seed, seconds)), seed)

    def prepared(self, detector: FaultDetector, record: FloatArray) -> bytes:
        """State of a detector just before the fault."""
        detector.reset()
        detector.run(record[: round(START / DT)])
        return detector.state()

    def after(
        self,
        detector: FaultDetector,
        record: FloatArray,
        faults: list[Fault],
        state: bytes,
        seed: int,
        seconds: float = 6.0,
    ) -> list[FaultEvent]:
        """Events after the fault, from the state just before it."""
        first = round(START / DT)
        faulty = inject(record, DT, faults, seed=seed)[first : first + round(seconds / DT)]
        detector.restore(state)
        return [e for e in detector.run(faulty).events if e.verdict is not Verdict.ARMED]

    def case(
        self,
        detector: FaultDetector,
        record: FloatArray,
        faults: list[Fault],
        state: bytes,
        seed: int,
        seconds: float = 6.0,
    ) -> dict[str, Any]:
        """One fault case, judged: every sensor that failed and no other has to be named."""
        sensors = {f.sensor for f in faults}
        events = self.after(detector, record, faults, state, seed, seconds)
        naming = [e for e in events if e.is_sensor or e.verdict is Verdict.CURRENT_OR_FRICTION]
        named = {n for e in naming for n in (e.sensors if e.is_sensor else ("current",))}
        found: dict[str, Any] = {
            "seed": seed,
            "sensors": sorted(sensors),
            "kind": faults[0].kind if len(faults) == 1 else "pair",
            "detected": bool(naming) or any(e.verdict is Verdict.PLANT for e in events),
            "right": named == sensors,
        }
        if found["right"]:
            first = naming[0]
            found |= {
                "delay": first.sample * DT - START,
                "first": max(first.first * DT - START, 0.0),
                "residuals": list(first.residuals),
            }
        else:
            found["said"] = [
                [round(e.sample * DT - START, 3), e.verdict.name, *e.sensors] for e in events
            ][:4]
        return found


@cache
def campaign() -> Campaign:
    """One per process."""
    return Campaign()


def healthy_case(seed: int) -> dict[str, Any]:
    """Three minutes of healthy data on an unseen trajectory."""
    c = campaign()
    record = c.unseen(seed, 182.0)
    c.detector.reset()
    start = time.process_time()
    track = c.detector.run(record)
    spent = time.process_time() - start
    c.thesis.reset()
    events = [
        [e.sample * DT, e.verdict.name, *e.sensors]
        for e in track.events
        if e.verdict is not Verdict.ARMED
    ]
    alarms = sum(e.is_sensor for e in track.events)
    return {
        "seed": seed,
        "samples": len(record),
        "spent": spent,
        "events": events,
        "alarms": alarms,
        "thesis": sum(e.is_sensor for e in c.thesis.run(record).events),
    }


def fault_cases(seed: int) -> list[dict[str, Any]]:
    """Every sensor with every kind at the stated size, then pairs, on one trajectory."""
    c = campaign()
    record = c.unseen(seed, 14.0)
    state, thesis_state = (c.prepared(d, record) for d in (c.detector, c.thesis))
    out = []
    for sensor in SENSORS:
        for kind in KINDS:
            faults = [Fault(sensor, kind, START, SIZES[sensor].get(kind, 0.0))]
            found = c.case(c.detector, record, faults, state, seed)
            if sensor.startswith("link"):
                found["thesis"] = c.case(c.thesis, record, faults, thesis_state, seed)
            out.append(found)
    return out + [c.case(c.detector, record, faults, state, seed, 8.0) for faults in pairs()]


def plant_case(asked: tuple[str, int]) -> dict[str, Any]:
    """A change of the plant; what the detector says."""
    name, seed = asked
    c = campaign()
    path = reference(seed, 15.0)
    after = np.arange(len(path)) * DT >= START
    courses = {n: np.where(after, f, 1.0) * c.joint.values[n] for n, f in CHANGES[name].items()}
    c.detector.reset()
    events = [
        e
        for e in c.detector.run(readings(c.follower.run(path, courses), seed)).events
        if e.verdict is not Verdict.ARMED
    ]
    said = (
        "; ".join(sorted({f"{e.verdict.name} {'+'.join(e.sensors)}" for e in events})) or "nothing"
    )
    return {"change": name, "seed": seed, "said": said, "sensor": any(e.is_sensor for e in events)}


def replace_case(i: int) -> list[dict[str, Any]]:
    """Error of the replaced link position over 40 s, alone and with a failed link velocity."""
    c = campaign()
    kind = REPLACED[i]
    run = c.follower.run(reference(400 + i, START + 41.0))
    record = readings(run, 400 + i)
    out = []
    for both in (False, True):
        faults = [Fault("link_position", kind, START, SIZES["link_position"].get(kind, 0.0))]  # type: ignore[arg-type]
        faults += [Fault("link_velocity", "noise", START + 2.0, 0.1)] if both else []
        c.detector.reset()
        track = c.detector.run(inject(record, DT, faults, seed=i))
        rows = track.failed[:, 3]
        error = float(np.max(np.abs(track.reconstructed[rows, 3] - run.states[rows, 2])))
        out.append({"kind": kind, "both": both, "error": error, "seconds": float(rows.sum()) * DT})
    return out


def size_cases(seed: int) -> list[dict[str, Any]]:
    """Every sensor and kind that has a size, at parts and multiples of the stated one."""
    c = campaign()
    record = c.unseen(seed, 14.0)
    state = c.prepared(c.detector, record)
    out = []
    for sensor in SENSORS:
        for kind, size in SIZES[sensor].items():
            for factor in FACTORS:
                fault = Fault(sensor, kind, START, size * factor)  # type: ignore[arg-type]
                found = c.case(c.detector, record, [fault], state, seed)
                out.append(
                    {
                        "sensor": sensor,
                        "kind": kind,
                        "factor": factor,
                        "detected": found["detected"],
                        "right": found["right"],
                    }
                )
    return out


def identify_cases(_: int) -> list[dict[str, object]]:
    """Section 4.4."""
    c = campaign()
    return identify(c.joint, c.follower, c.record)


PARTS: dict[str, tuple[Callable[[Any], Any], list[Any]]] = {
    "healthy": (healthy_case, list(range(100, 120))),
    "faults": (fault_cases, list(range(200, 209))),
    "plant": (plant_case, [(name, seed) for name in CHANGES for seed in range(300, 312)]),
    "replace": (replace_case, list(range(len(REPLACED)))),
    "identify": (identify_cases, [0]),
    "sizes": (size_cases, list(range(600, 606))),
}
"""Function and its arguments; a list it returns is joined."""


def run_part(name: str, jobs: int) -> list[Any]:
    """All cases of one part."""
    function, asked = PARTS[name]
    if jobs > 1 and len(asked) > 1:
        with ProcessPoolExecutor(jobs) as pool:
            return _joined(pool.map(function, asked))
    return _joined(map(function, asked))


def _joined(found: Iterable[Any]) -> list[Any]:
    out: list[Any] = []
    for item in found:
        out += item if isinstance(item, list) else [item]
    return out


def main() -> None:
    """Run the named parts, or all; print, keep and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "parts",
        nargs="*",
        metavar="PART",
        help="parts to run (default: all of " + ", ".join(PARTS) + ")",
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument(
        "--keep", metavar="FILE.json", help="read earlier results from here and add the new ones"
    )
    parser.add_argument("--out", metavar="FILE.md", help="write the page and its picture")
    parser.add_argument(
        "--no-run", action="store_true", help="only print and write what --keep holds"
    )
    asked = parser.parse_args()
    if unknown := set(asked.parts) - set(PARTS):
        parser.error(f"unknown part {', '.join(sorted(unknown))}; use {', '.join(PARTS)}")
    results: dict[str, Any] = {}
    if asked.keep and Path(asked.keep).exists():
        results = json.loads(Path(asked.keep).read_text(encoding="utf-8"))
    for part in [] if asked.no_run else asked.parts or list(PARTS):
        start = time.perf_counter()
        results[part] = run_part(part, asked.jobs)
        print(f"[{part}: {time.perf_counter() - start:.0f} s]", flush=True)
        if asked.keep:
            Path(asked.keep).write_text(json.dumps(results), encoding="utf-8")
    print(printed(results))
    if asked.out:
        write_page(results, Path(asked.out))


if __name__ == "__main__":
    main()
