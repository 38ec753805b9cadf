"""A record replayed through the online estimator, with progress, on request with a sensor that
fails on the way.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast, final

import numpy as np
import numpy.typing as npt

from identification.data.joint_file import Joint, parse_joint
from identification.data.record import Record
from identification.errors import InputError
from irj_fmu.estimator.healthy import online_readings
from workbench.cli.online import fault_text
from workbench.page.analysis import Progress, clean
from workbench.page.live import Live
from workbench.page.session import StepEntry, write_atomic

if TYPE_CHECKING:
    from identification.faults.detector import FaultDetector
    from identification.online.estimator import OnlineEstimator, OnlineOptions

FloatArray = npt.NDArray[np.float64]

MOST_SECONDS: Final = 60.0
"""Length that is replayed unless another one is asked for [s]."""
MOST_SAMPLES: Final = 200_000
HEALTHY_SAMPLES: Final = 20_000
"""Samples of the training records from which the fault detector takes its limits."""
POINTS: Final = 400
READINGS: Final = (
    "motor current",
    "motor position",
    "motor velocity",
    "link position",
    "link velocity",
    "torque",
)
TRIED: Final = ("none", "stuck", "dropout", "bias", "gain", "noise", "drift", "spike")
"""Faults that can be tried; see `identification.faults.injector`."""
SHARE: Final = {"bias": 0.1, "noise": 0.1, "spike": 0.3, "drift": 0.02}
"""Size of a tried fault as a share of the reading's range (of a drift: per second)."""
GAIN: Final = 0.2
FILE: Final = "replay.json"


@final
@dataclass(frozen=True)
class Request:
    """What is to be replayed.

    Attributes
    ----------
    file : str
        Identifier of the record.
    first, seconds : float
        Part of the record [s].
    sensor, kind : str
        One of :data:`READINGS` and of :data:`TRIED`.
    at : float
        Begin of the fault after the begin of the replay [s].
    """

    file: str
    first: float = 0.0
    seconds: float = MOST_SECONDS
    sensor: str = READINGS[3]
    kind: str = "none"
    at: float = math.nan


def request_of(body: Mapping[str, Any]) -> Request:
    """The request in the body of a call.

    Raises
    ------
    InputError
        A value that is no number, or unknown.
    """
    numbers = {}
    for key, least in (("first", 0.0), ("seconds", 1.0), ("at", 0.0)):
        if body.get(key) in (None, ""):
            continue
        try:
            numbers[key] = float(body[key])
        except (TypeError, ValueError):
            raise InputError(f"replay: {key} is {body[key]!r}; give a number of seconds") from None
        if not numbers[key] >= least or not math.isfinite(numbers[key]):
            raise InputError(f"replay: {key} is {numbers[key]:g} s; give at least {least:g} s")
    made = Request(
        str(body.get("file", "")),
        sensor=str(body.get("sensor", READINGS[3])),
        kind=str(body.get("kind", "none")),
        **numbers,
    )
    if made.sensor not in READINGS or made.kind not in TRIED:
        raise InputError(
            f"replay: {made.sensor!r} {made.kind!r} is not known; sensors are "
            f"{', '.join(READINGS)}, faults {', '.join(TRIED)}"
        )
    return made


def replay(
    live: Live, steps: Sequence[StepEntry], asked: Request, folder: Path, progress: Progress
) -> Path:
    """Replay a record of the session with its fitted joint; the result is a file in `folder`.

    Raises
    ------
    InputError
        Nothing is fitted; the record is too short or lacks a channel.
    """
    from identification.online.estimator import OnlineEstimator, OnlineOptions

    if not steps:
        raise InputError("replay: fit first, the estimator starts from the fitted joint")
    joint = parse_joint(tomllib.loads(live.analysis().to_joint_file()), "joint")
    whole = live.record(asked.file)
    part = _part(whole, asked)
    options = OnlineOptions(
        has_link=whole.has("link_position"), has_torque=whole.has("link_torque")
    )
    if part.duration <= options.warm_up:
        raise InputError(
            f"replay: {part.duration:.3g} s are too short for the first window of "
            f"{options.warm_up:g} s; ask for a longer part"
        )
    table, note = _readings(part, joint, asked)
    progress("taking the limits from the records of the fit", 0.02)
    healthy = [f.id for f in live.state.files if f.status == "ready" and f.role == "train"]
    mark = (steps[-1].values, steps[-1].effects, healthy, round(part.dt, 9))
    known = live.kept.get("limits")
    if known is None or known[0] != mark:
        known = live.kept["limits"] = (
            mark,
            _limits(joint, options, [live.record(i) for i in healthy], part.dt),
        )
    state, why = known[1]
    estimator = OnlineEstimator(joint, part.dt, options, state)
    made = _followed(estimator, part, table, progress)
    found = clean(
        {
            **made,
            "record": whole.name,
            "effects": list(steps[-1].effects),
            "start": float(part.time[0]),
            "note": note,
            "no_detector": why,
            "detector": estimator.detector is not None,
            "asked": {"file": asked.file, "sensor": asked.sensor, "kind": asked.kind},
            "unit": "s",
            "readings": [r for r, there in zip(READINGS, estimator.present, strict=True) if there],
        }
    )
    path = folder / FILE
    write_atomic(path, json.dumps(found, allow_nan=False).encode())
    return path


def _part(record: Record, asked: Request) -> Record:
    """The asked part, at even steps."""
    first = float(record.time[0]) + asked.first
    keep = (record.time >= first) & (record.time <= first + asked.seconds)
    if not keep.any():
        raise InputError(
            f"replay: {record.name} ends before {asked.first:g} s; it is {record.duration:.4g} s "
            "long"
        )
    if int(keep.sum()) > MOST_SAMPLES:
        raise InputError(
            f"replay: {int(keep.sum())} samples are too many for the page; ask for "
            f"{MOST_SAMPLES * record.dt:.3g} s at most, or use `irj track`"
        )
    return record.take(keep, "the part that was asked for").resampled()


def _limits(
    joint: Joint, options: OnlineOptions, healthy: Sequence[Record], dt: float
) -> tuple[bytes | None, str]:
    """State of a fault detector with limits from healthy records; the reason where there is
    none.
    """
    from identification.faults.detector import FaultDetector
    from identification.online.estimator import prepared

    model, _ = prepared(joint, options)
    if not model.is_elastic:
        return (
            None,
            "sensor faults are looked for in an elastic joint only: with link position and "
            "torque, and a model such as hd3",
        )
    if not (options.has_link and options.has_torque):
        return None, "without link position and torque there is no second opinion on a sensor"
    tables, left = [], HEALTHY_SAMPLES
    for record in healthy:
        if left <= 0 or abs(record.dt - dt) > 0.01 * dt:
            continue
        even = record.take(
            np.arange(len(record)) < left, "for the limits of the fault detector"
        ).resampled()
        table = np.array(online_readings(even, joint)[0])
        tables += [table[piece] for piece in even.segments()]
        left -= len(even)
    if not tables:
        return (
            None,
            "no record of the fit has the sample time of this one, so the detector's limits are "
            "guesses",
        )
    detector = FaultDetector(model, dt, has_torque=options.has_torque)
    detector.calibrate(tables)
    return detector.state(), ""


def _readings(part: Record, joint: Joint, asked: Request) -> tuple[FloatArray, str]:
    """Readings (n, 6), with the fault that is to be tried; what was done, as a sentence."""
    from identification.faults.detector import SENSORS
    from identification.faults.injector import Fault, Kind

    healthy, _ = online_readings(part, joint)
    table = np.array(healthy, dtype=np.float64)
    if asked.kind == "none":
        return table, ""
    column = READINGS.index(asked.sensor)
    span = float(np.ptp(table[:, column]))
    size = GAIN if asked.kind == "gain" else SHARE.get(asked.kind, 0.0) * span
    at = asked.at if math.isfinite(asked.at) else 0.6 * part.duration
    if at >= part.duration:
        raise InputError(
            f"replay: the fault begins at {at:g} s, after the end at {part.duration:.4g} s"
        )
    table = np.array(
        online_readings(part, joint, [Fault(SENSORS[column], cast("Kind", asked.kind), at, size)])[
            0
        ],
        dtype=np.float64,
    )
    shown = {
        "gain": f" of {100 * GAIN:g} %",
        "drift": f" of {100 * SHARE['drift']:g} % of its range per second",
    }.get(
        asked.kind, f" of {100 * SHARE[asked.kind]:g} % of its range" if asked.kind in SHARE else ""
    )
    return (
        table,
        f"Tried on purpose: {asked.sensor}, {asked.kind}{shown}, from {at:.3g} s on. The record "
        "itself is healthy as far as is known.",
    )


def _followed(
    estimator: OnlineEstimator, part: Record, table: FloatArray, progress: Progress
) -> dict[str, Any]:
    """The estimator along the record: histories, and when which reading was doubted."""
    count, every = len(part), max(1, len(part) // POINTS)
    rows, valid = (
        np.nan_to_num(table).tolist(),
        (np.isfinite(table) & np.array(estimator.present)).tolist(),
    )
    origin = float(part.time[0])
    stamps = (part.time - origin).tolist()
    drawn: list[tuple[float, list[float], list[float], list[float], list[str]]] = []
    events: list[dict[str, Any]] = []
    fault, worst = 0, [0.0] * 6
    for stretch in part.segments():
        estimator.reset()
        for k in range(stretch.start, stretch.stop):
            estimator.update(stamps[k], rows[k], valid[k])
            if estimator.fault != fault:
                fault = estimator.fault
                events.append(
                    {
                        "time": stamps[k],
                        "fault": fault,
                        "text": fault_text(fault) if fault else "nothing is doubted any more",
                    }
                )
            worst = [max(a, b) for a, b in zip(worst, estimator.score, strict=True)]
            if (k + 1) % every == 0:
                failed = _failed(estimator.detector)
                warm = estimator.warming_up
                theta = [math.nan] * len(estimator.names) if warm else estimator.theta.tolist()
                drawn.append(
                    (
                        stamps[k],
                        theta,
                        [math.nan] * len(estimator.balances) if warm else estimator.ratio.tolist(),
                        worst,
                        failed,
                    )
                )
                worst = [0.0] * 6
                progress(
                    f"replaying, {stamps[k]:.0f} of {stamps[-1]:.0f} s", 0.05 + 0.9 * k / count
                )
    if estimator.warming_up:
        raise InputError(
            f"replay: {part.duration:.3g} s are too short for the first window of "
            f"{estimator.options.warm_up:g} s; ask for a longer part"
        )
    return _result(estimator, drawn, events, stamps[-1])


def _failed(detector: FaultDetector | None) -> list[str]:
    from identification.faults.detector import SENSORS

    return [] if detector is None else [READINGS[SENSORS.index(name)] for name in detector.failed]


def _result(
    estimator: OnlineEstimator,
    drawn: Sequence[tuple[Any, ...]],
    events: list[dict[str, Any]],
    end: float,
) -> dict[str, Any]:
    units = {p.name: p for p in estimator.model.parameters}
    theta, ratio, score = (np.array([row[i] for row in drawn]) for i in (1, 2, 3))
    fitted, told = estimator.joint.fitted, estimator.detector.events if estimator.detector else ()
    return {
        "time": [row[0] for row in drawn],
        "end": end,
        "events": events,
        "warm": next((row[0] for row in drawn if math.isfinite(row[1][0])), end),
        "ratio": {b: ratio[:, i] for i, b in enumerate(estimator.balances)},
        "score": {READINGS[i]: score[:, i] for i in range(6) if estimator.present[i]},
        "failed": [row[4] for row in drawn],
        "verdicts": [
            {"time": e.sample * estimator.dt, "text": str(e.verdict), "about": list(e.sensors)}
            for e in told
        ],
        "parameters": {
            name: {
                "value": float(estimator.theta[i]),
                "sigma": float(estimator.sigma[i]),
                "fitted": fitted.get(name),
                "unit": units[name].unit,
                "side": units[name].side,
                "history": theta[:, i],
            }
            for i, name in enumerate(estimator.names)
        },
    }


def stored(folder: Path) -> dict[str, Any]:
    """The last replay, or ``{}``."""
    try:
        found: dict[str, Any] = json.loads((folder / FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found


__all__ = ["READINGS", "TRIED", "Request", "replay", "request_of", "stored"]
