"""A record replayed through the online estimator, with progress, on request with a sensor that
fails on the way.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast, final

import numpy as np

from identification.data.joint_file import Joint, parse_joint
from identification.data.plain_text import from_toml
from identification.data.record import Record
from identification.errors import InputError
from identification.faults.types import Verdict
from irj_fmu.estimator.bank import Watching, bank_for, measured_sensors
from irj_fmu.estimator.healthy import detector_state, online_readings
from workbench.cli.following.growing import follow as growing
from workbench.cli.following.source import source as followed_source
from workbench.cli.online import limits_fit
from workbench.cli.online import replay as followed
from workbench.page.analysis import Progress, clean
from workbench.page.desk.sources import stopped
from workbench.page.jobs.place import Place
from workbench.page.records import without_windows
from workbench.page.session import StepEntry, write_atomic
from workbench.show.replayed import READINGS, Replay, standing

if TYPE_CHECKING:
    from identification.faults.detector import Fault
    from identification.faults.injector import Kind
    from identification.online.estimator import OnlineOptions

MOST_SECONDS: Final = 60.0
"""Length that is replayed unless another one is asked for [s]."""
MOST_SAMPLES: Final = 200_000
HEALTHY_SAMPLES: Final = 20_000
"""Samples of the training records from which the fault detector takes its limits."""
TRIED: Final = ("none", "stuck", "dropout", "bias", "gain", "noise", "drift", "spike")
"""Faults that can be tried; see `identification.faults.injector`."""
SHARE: Final = {"bias": 0.1, "noise": 0.1, "spike": 0.3, "drift": 0.02}
"""Size of a tried fault as a share of the reading's range (of a drift: per second)."""
GAIN: Final = 0.2
WHOLE: Final = {Verdict.PLANT: ["joint"], Verdict.DEAD: ["readings"]}
"""What a verdict is about that names no sensor."""
FILE: Final = "replay.json"
REWRITTEN: Final = 0.5
"""Time between two writings of what a growing file gives [s]: half of that between two looks."""


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
    for key, word, least in (
        ("first", "the begin", 0.0),
        ("seconds", "the length", 1.0),
        ("at", "the begin of the fault", 0.0),
    ):
        if body.get(key) in (None, ""):
            continue
        try:
            numbers[key] = float(body[key])
        except (TypeError, ValueError):
            raise InputError(f"replay: {word} is {body[key]!r}; give a number of seconds") from None
        if not numbers[key] >= least or not math.isfinite(numbers[key]):
            raise InputError(f"replay: {word} is {numbers[key]:g} s; give at least {least:g} s")
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
    live: Place, steps: Sequence[StepEntry], asked: Request, folder: Path, progress: Progress
) -> Path:
    """Replay a record of the session with its fitted joint; the result is a file in `folder`.

    Raises
    ------
    InputError
        Nothing is fitted; the record is too short or lacks a channel.
    """
    from identification.online.estimator import OnlineOptions

    if not steps:
        raise InputError("replay: fit first, the estimator starts from the fitted joint")
    joint = parse_joint(from_toml(live.analysis().to_joint_file(), "joint"), "joint")
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
    tried, note = _tried(part, joint, asked)
    progress("taking the limits from the records of the fit", 0.02)
    watch = _watching(live, steps, joint, asked)
    state, why = None, ""
    if watch is None:
        state, why = _limits_here(live, steps, joint, options, part.resampled().dt)
    made = followed(
        part,
        joint,
        state,
        tried,
        watch,
        progress=lambda text, share: progress(text, 0.05 + 0.9 * share),
    )
    asked_for = {"file": asked.file, "sensor": asked.sensor, "kind": asked.kind}
    return _kept(folder, made, steps, {"note": note, "no_detector": why, "asked": asked_for})


def follow(
    live: Place, steps: Sequence[StepEntry], path: str, folder: Path, progress: Progress
) -> Path:
    """Follow a file that is being written, or a stream, with the fitted joint; the result in
    `folder` is written anew as it grows. The server has asked whether it may be followed.

    Raises
    ------
    InputError
        Nothing is fitted; the file cannot be used.
    """
    if not steps:
        raise InputError("follow: fit first, the estimator starts from the fitted joint")
    short = Path(path).name
    joint = parse_joint(from_toml(live.analysis().to_joint_file(), "joint"), "joint")
    why, made, written, shown = "", None, 0.0, -math.inf

    def state_of(first: Record) -> bytes | None:
        from identification.online.estimator import OnlineOptions

        nonlocal why
        progress("taking the limits from the records of the fit", 0.0)
        options = OnlineOptions(
            has_link=first.has("link_position"), has_torque=first.has("link_torque")
        )
        state, why = _limits_here(live, steps, joint, options, first.dt)
        return state

    stopped(folder)  # what was asked of an earlier one
    (folder / FILE).unlink(missing_ok=True)
    with followed_source(path, joint) as source:
        progress(f"waiting for {short}", 0.0)  # from here on nothing of a stream is lost
        try:
            for made in growing(source, joint, state_of, stop=lambda: stopped(folder)):
                now = float(made.record.time[-1])
                progress(f"following {short}, {now:.0f} s", 0.0)
                fresh = now > shown and time.monotonic() - written > REWRITTEN
                if len(made.time) and fresh:
                    written, shown = time.monotonic(), now
                    _kept(folder, made, steps, {"no_detector": why, "live": True})
        except InputError:  # what came before a line that cannot be used stays
            if made is not None:
                _kept(folder, made, steps, {"no_detector": why})
            raise
    if made is None:
        raise InputError(f"follow: nothing came into {short}; start the recording first")
    return _kept(folder, made, steps, {"no_detector": why})


def _kept(folder: Path, made: Replay, steps: Sequence[StepEntry], more: Mapping[str, Any]) -> Path:
    estimator = made.estimator
    found = clean(
        {
            **_result(made),
            "record": made.record.name,
            "effects": list(steps[-1].effects),
            "start": float(made.record.time[0]),
            "note": "",
            "detector": made.watched,
            "unit": "s",
            "readings": [r for r, there in zip(READINGS, estimator.present, strict=True) if there],
            **more,
            "no_detector": made.not_watched or more.get("no_detector", ""),
        }
    )
    path = folder / FILE
    write_atomic(path, json.dumps(found, allow_nan=False).encode())
    return path


def _watching(
    live: Place, steps: Sequence[StepEntry], joint: Joint, asked: Request
) -> Watching | None:
    """The fault bank that `irj track` would take, with the records of the fit as healthy ones, and
    kept for the next replay of the same model; None where none can be made.
    """
    files = [f for f in live.state.files if f.status == "ready" and f.role == "train"]
    record = _part(live.as_read(asked.file), asked)
    healthy = [without_windows(live.as_read(f.id), f.left_out) for f in files]
    mark = (
        *(steps[-1].values, steps[-1].effects, [(f.id, f.left_out) for f in files]),
        *(measured_sensors(record), round(record.dt, 9), bool((np.diff(record.time) >= 0).all())),
    )
    known = live.kept.get("bank")
    if known is None or known[0] != mark:
        try:
            limits_fit(record, healthy)
            made = bank_for(joint, record, healthy)
        except InputError:  # the detector says what it needs
            made = None
        known = live.kept["bank"] = (mark, made)
    return None if known[1] is None else Watching(known[1], record)


def _limits_here(
    live: Place, steps: Sequence[StepEntry], joint: Joint, options: OnlineOptions, dt: float
) -> tuple[bytes | None, str]:
    """As `_limits`, from the records of the fit, and kept for the next replay of the same model."""
    healthy = [f.id for f in live.state.files if f.status == "ready" and f.role == "train"]
    sensors = (options.has_link, options.has_torque)
    mark = (steps[-1].values, steps[-1].effects, healthy, round(dt, 9), sensors)
    known = live.kept.get("limits")
    if known is None or known[0] != mark:
        found = _limits(joint, options, [live.record(i) for i in healthy], dt)
        known = live.kept["limits"] = (mark, found)
    state, why = known[1]
    return state, why


def _part(record: Record, asked: Request) -> Record:
    """The asked part."""
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
    return record.take(keep, "the part that was asked for")


def _limits(
    joint: Joint, options: OnlineOptions, healthy: Sequence[Record], dt: float
) -> tuple[bytes | None, str]:
    """State of a fault detector with limits from healthy records; the reason where there is
    none.
    """
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
    usable, left = [], HEALTHY_SAMPLES
    for record in healthy:
        if left <= 0 or abs(record.dt - dt) > 0.01 * dt:
            continue
        usable.append(
            record.take(np.arange(len(record)) < left, "for the limits of the fault detector")
        )
        left -= len(usable[-1])
    if not usable:
        return (
            None,
            "no record of the fit has the sample time of this one, so the detector's limits are "
            "guesses",
        )
    return detector_state(joint, options, usable, dt), ""


def _tried(part: Record, joint: Joint, asked: Request) -> tuple[list[Fault], str]:
    """The fault that is to be tried, sized by the range of its reading; what is done, as a
    sentence.
    """
    from identification.faults.detector import SENSORS, Fault

    if asked.kind == "none":
        return [], ""
    column = READINGS.index(asked.sensor)
    span = float(np.ptp(np.array(online_readings(part, joint)[0])[:, column]))
    size = GAIN if asked.kind == "gain" else SHARE.get(asked.kind, 0.0) * span
    at = asked.at if math.isfinite(asked.at) else 0.6 * part.duration
    if at >= part.duration:
        raise InputError(
            f"replay: the fault begins at {at:g} s, after the end at {part.duration:.4g} s"
        )
    shown = {
        "gain": f" of {100 * GAIN:g} %",
        "drift": f" of {100 * SHARE['drift']:g} % of its range per second",
    }.get(
        asked.kind, f" of {100 * SHARE[asked.kind]:g} % of its range" if asked.kind in SHARE else ""
    )
    return (
        [Fault(SENSORS[column], cast("Kind", asked.kind), at, size)],
        f"Tried on purpose: {asked.sensor}, {asked.kind}{shown}, from {at:.3g} s on. The record "
        "itself is healthy as far as is known.",
    )


def _result(made: Replay) -> dict[str, Any]:
    """A replay as the page draws it: time counts from its begin, NaN while the estimator warms
    up.
    """
    if not len(made.time):
        raise InputError(
            f"replay: {made.record.duration:.3g} s are too short for the first window of "
            f"{made.estimator.options.warm_up:g} s; ask for a longer part"
        )
    estimator, whole = made.estimator, made.record.time
    first = {float(e["time"]): float(e.get("first", e["time"])) for e in made.events}
    units = {p.name: p for p in estimator.model.parameters}
    at = np.searchsorted(whole[made.looks], made.time)
    theta, ratio = (
        np.full((len(made.looks), found.shape[1]), math.nan) for found in (made.values, made.ratios)
    )
    theta[at], ratio[at] = made.values, made.ratios
    fitted, origin = estimator.joint.fitted, float(whole[0])
    return {
        "time": whole[made.looks] - origin,
        "end": float(whole[-1]) - origin,
        "warm": float(made.time[0]) - origin,
        "ratio": {b: ratio[:, i] for i, b in enumerate(estimator.balances)},
        "score": {READINGS[i]: made.scores[:, i] for i in range(6) if estimator.present[i]},
        "failed": [
            [name for name, failed in zip(READINGS, row, strict=True) if failed]
            for row in made.failed[made.looks].tolist()
        ],
        "verdicts": [
            {
                "time": time - origin,
                "first": first.get(time, time) - origin,
                "text": str(e.verdict),
                "about": list(e.sensors) or WHOLE.get(e.verdict, []),
            }
            for time, e in made.verdicts
        ],
        "standing": standing([(t - origin, e) for t, e in made.verdicts], watched=made.watched),
        "parameters": {
            name: {
                "value": float(made.values[-1, i]),
                "sigma": float(made.sigmas[-1, i]),
                "fitted": fitted.get(name),
                "unit": units[name].unit,
                "side": units[name].side,
                "history": theta[:, i],
            }
            for i, name in enumerate(estimator.names)
        },
    }


def shown(folder: Path, *, following: bool) -> dict[str, Any]:
    """The last replay, or ``{}``. While a file or a stream is followed, only what came of it: the
    verdict on an earlier record would stand there as one on this. What was cancelled is no longer
    live.
    """
    try:
        found: dict[str, Any] = json.loads((folder / FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    of_it = bool(found.get("live", False))
    return {} if following and not of_it else {**found, "live": following}


__all__ = ["READINGS", "TRIED", "Request", "follow", "replay", "request_of", "shown"]
