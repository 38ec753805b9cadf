"""track, plan: the online estimator replayed on records, and the motion that makes the
parameters identifiable.
"""

from __future__ import annotations

import math
import sys
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from identification.data.formats import words
from identification.errors import InputError
from identification.faults.bank_levels import SETTLE
from irj_fmu.command_line import counted
from irj_fmu.estimator.bank import Watching, bank_for, judgement, measured_sensors, smallest_offsets
from irj_fmu.estimator.healthy import may_watch, online_readings
from workbench.cli.files import (
    named,
    needed,
    open_joint,
    open_records,
    progress_bar,
    write_bytes,
    write_json,
)
from workbench.cli.following.growing import follow
from workbench.cli.following.source import is_stream
from workbench.cli.following.source import source as followed_source
from workbench.cli.following.stepper import Stepper, arrays_of, fault_text
from workbench.cli.renewed import renewed
from workbench.show.replayed import READINGS, UNESTIMATED, Replay, standing

if TYPE_CHECKING:
    from identification.data.joint_file import Joint
    from identification.data.record import Record
    from identification.faults.bank import FaultBank
    from identification.faults.detector import Fault
    from identification.planning.trajectories import Selection

FloatArray = npt.NDArray[np.float64]

LIMITS: Final = "limits from the healthy records"
"""What is worked on for half a minute the first time."""
POINTS: Final = 400
"""Points of the parameters' course kept per record."""


def run_track(arguments: Namespace) -> int:
    """`irj track`: 1 where ``--fail-on-fault`` was given and a fault was found."""
    joint = open_joint(arguments.joint)
    if getattr(arguments, "follow", None) is not None:
        return _run_follow(arguments, joint)
    stream = next((r for r in arguments.records if is_stream(r)), None)
    if stream is not None:
        raise InputError(f"{stream}: a stream has no end; add --follow to track it as it comes")
    tried = [parse_fault(text) for text in getattr(arguments, "inject", None) or []]
    records, raw, warnings = _open_doubtful(arguments.records, joint)
    for path, record in zip(arguments.records, records, strict=True):
        try:
            online_readings(record, joint, tried)  # no limit is worked out for a fault of nothing
        except InputError as error:
            raise named(error, path, record) from None
    healthy, more = open_records(arguments.healthy, joint)
    healthy = [r.renamed(path) for r, path in zip(healthy, arguments.healthy, strict=True)]
    as_read = _as_read(arguments.healthy, joint)
    banks = _banks(joint, raw, as_read)
    plain = [r for r, bank in zip(records, banks, strict=True) if bank is None]
    state = limits(joint, plain[0], healthy) if plain else None
    found = []
    for path, record, doubtful, bank in zip(arguments.records, records, raw, banks, strict=True):
        try:
            if bank is None:
                found.append(replay(record, joint, state, tried))
            else:
                watch = Watching(bank, doubtful, _announced(path, bank, as_read[0], joint))
                found.append(replay(record, joint, None, tried, watch))
        except InputError as error:
            raise named(error, path, record) from None
    found = [replace(r, events=(*r.events, *renewed(r, joint))) for r in found]
    results = [made.as_json() for made in found]
    for result in results:
        _print_track(result)
    write_json(arguments.json, {"records": results, "warnings": [*warnings, *more]})
    page = getattr(arguments, "report", None)
    if page:
        from workbench.show.track_report import track_page

        write_bytes(
            page,
            track_page(
                found, joint, command=getattr(arguments, "command", None), notes=[*warnings, *more]
            ).encode(),
        )
        print(f"{page}: report written")
    return 1 if arguments.fail_on_fault and any(r["events"] for r in results) else 0


def _run_follow(arguments: Namespace, joint: Joint) -> int:
    """`irj track --follow`: what is said is printed as it is said, and what stands at the end."""
    if len(arguments.records) != 1 or arguments.inject or arguments.report:
        raise InputError(
            "--follow: give one record, without --inject and --report; track it again with them "
            "when it is complete"
        )
    if not arguments.follow > 0:
        raise InputError(f"--follow {arguments.follow:g}: give seconds above 0")
    healthy, warnings = open_records(arguments.healthy, joint)
    said, made, broken = 0, None, None
    with followed_source(arguments.records[0], joint) as source:
        try:
            for made in follow(
                source, joint, lambda first: limits(joint, first, healthy), quiet=arguments.follow
            ):
                for time, event in made.verdicts[said:]:
                    names = ", ".join(words(n) for n in event.sensors)
                    print(f"{time:.6g} s: {names + ': ' if names else ''}{event.verdict}")
                    sys.stdout.flush()
                said = len(made.verdicts)
        except KeyboardInterrupt:
            sys.stderr.write("irj: stopped; this is what came until then\n")
        except InputError as error:  # hours may have come before a line that cannot be used
            broken = error
    if made is None:
        if broken is not None:
            raise broken
        return 130
    result = made.as_json()
    _print_track(result)
    print(f"  {standing(made.verdicts, watched=made.watched)}")
    write_json(arguments.json, {"records": [result], "warnings": warnings})
    if broken is not None:
        raise broken
    return 1 if arguments.fail_on_fault and result["events"] else 0


def _as_read(paths: Sequence[str], joint: Joint) -> list[Record]:
    """Healthy records with their holes and stamps: a bank judges readings as they come, and its
    limits must be of such readings.
    """
    from identification.data.read import read

    return [read(path, columns=joint.columns, kind=joint.kind).renamed(path) for path in paths]


def _banks(
    joint: Joint, records: Sequence[Record], healthy: Sequence[Record]
) -> list[FaultBank | None]:
    """A fault bank for each record; None where none can be made (see
    :func:`irj_fmu.estimator.bank.bank_for`). Records with the same sensors and step share one.
    """
    made: dict[tuple[object, ...], FaultBank | None] = {}
    out: list[FaultBank | None] = []
    for record in records:
        limits_fit(record, healthy)
        one_run = bool((np.diff(record.time) >= 0).all())
        key = (one_run, *measured_sensors(record), float(f"{record.dt:.3g}"))
        if key not in made:
            if healthy:
                progress_bar(LIMITS, 0.0)
            made[key] = bank_for(joint, record, healthy)
            if healthy:
                progress_bar(LIMITS, 1.0)
        out.append(made[key])
    return out


def _announced(
    path: str, bank: FaultBank, healthy: Record, joint: Joint
) -> dict[str, tuple[float, float]]:
    """Print, and give, the smallest offsets that a bank sees on this joint."""
    from identification.faults.detector import SENSORS

    found = smallest_offsets(bank, healthy, joint)
    print(
        f"{path}: smallest offset of a sensor that is seen, and that is named (referred to the "
        "link)"
    )
    for name, (seen, told) in found.items():
        at = SENSORS.index(name)
        unit = "rad" if at in (1, 3) else "rad/s" if at in (2, 4) else "N.m"
        last = f"{told:.2g} {unit}" if math.isfinite(told) else "never"
        print(f"  {READINGS[at]:<16} {seen:.2g} {unit}, {last}")
    return found


def _open_doubtful(
    paths: Sequence[str], joint: Joint
) -> tuple[list[Record], list[Record], list[str]]:
    """Records in SI of which only the head must be sane: what a sensor does later is for the
    estimator to find. The same as read; sentences about doubts.

    Raises
    ------
    InputError
        The first seconds cannot be used, or the record cannot be sampled evenly; the line starts
        with the path.
    """
    from identification.data.check.checks import check, gate, repair
    from identification.data.read import read
    from identification.online.estimator import OnlineOptions

    records, raw, warnings = [], [], []
    for path in paths:
        record = read(path, columns=joint.columns, kind=joint.kind)
        raw.append(record)
        given = (joint.gear_ratio, needed(record, joint), joint.torque_per_current)
        try:
            head = record.time - record.time[0] <= OnlineOptions().warm_up
            gate(
                record if head.all() else record.take(head, "the first window of the estimator"),
                *given,
            )
            findings = check(record, *given)
            record = repair(record)
            record.resampled()
        except InputError as error:
            raise named(error, path, record) from None
        warnings += [
            f"{path}: {f.message.removeprefix(record.name + ': ')}"
            for f in findings
            if f.severity != "ok"
        ]
        records.append(record)
    for text in warnings:
        sys.stderr.write(f"irj: {text}\n")
    return records, raw, warnings


def parse_fault(text: str) -> Fault:
    """A fault to try, as ``SENSOR:KIND:START[:SIZE[:END]]``; size referred to the link, SI, times
    in s.

    Raises
    ------
    InputError
        One line that says how to write it.
    """
    from identification.faults.detector import KINDS, SENSORS, Fault

    parts = text.split(":")
    how = (
        f"write SENSOR:KIND:START[:SIZE[:END]], SENSOR one of {', '.join(SENSORS)}, KIND one "
        f"of {', '.join(KINDS)}, as link_position:stuck:9"
    )
    try:
        sensor, kind, *numbers = parts
        start, size, end = (*map(float, numbers), *(0.0, math.inf)[max(len(numbers) - 1, 0) :])
    except ValueError:
        raise InputError(f"--inject {text!r}: {how}") from None
    if kind not in KINDS:
        raise InputError(f"--inject {text!r}: unknown kind {kind!r}; {how}")
    if len(numbers) < 2 and kind not in ("stuck", "zero", "dropout"):
        raise InputError(f"--inject {text!r}: {kind} needs a size; {how}")
    try:
        return Fault(sensor, kind, start, size, end)
    except InputError as error:
        raise InputError(f"--inject {text!r}: {error}") from None


def limits(joint: Joint, record: Record, healthy: Sequence[Record]) -> bytes | None:
    """State of a fault detector with limits from healthy records; None without records.

    Raises
    ------
    InputError
        The joint is rigid or not fitted; a record has another sample time or lacks a channel.
    """
    if not healthy:
        return None
    from identification.online.estimator import OnlineOptions
    from irj_fmu.estimator.healthy import detector_state

    options = OnlineOptions(
        has_link=record.has("link_position"), has_torque=record.has("link_torque")
    )
    limits_fit(record, healthy)
    return detector_state(joint, options, healthy, record.resampled().dt)


def limits_fit(record: Record, healthy: Sequence[Record]) -> None:
    """Check that healthy records can give limits for a record.

    Raises
    ------
    InputError
        A record has another sample time or lacks a channel.
    """
    for other in healthy:
        if other.dt > 1.01 * record.dt:
            raise InputError(
                f"{other.name}: sampled every {other.dt:.4g} s, {record.name} every "
                f"{record.dt:.4g} s; --healthy takes that rate or finer"
            )
        for channel in ("link_position", "link_torque"):
            if record.has(channel) and not other.has(channel):
                raise InputError(
                    f"{other.name}: no {channel}, which {record.name} has; --healthy takes "
                    "records with the same channels"
                )


def track(record: Record, joint: Joint, detector_state: bytes | None = None) -> dict[str, Any]:
    """Replay a record through the online estimator, sample by sample (see :func:`replay`).

    Returns
    -------
    dict
        ``record``, ``time``, ``parameters`` (name to value, sigma, unit, side, history), ``ratio``
        (balance to residual over floor), ``events``, ``detector`` (whether faults were looked for).
    """
    return replay(record, joint, detector_state).as_json()


def replay(
    record: Record,
    joint: Joint,
    detector_state: bytes | None = None,
    tried: Sequence[Fault] = (),
    watch: Watching | None = None,
    *,
    progress: Callable[[str, float], None] = progress_bar,
) -> Replay:
    """Replay a record through the online estimator, sample by sample.

    Parameters
    ----------
    record : Record
        Resampled to its median step; every stretch starts the estimator anew.
    joint : Joint
        With fitted values the sensor-fault detector runs too.
    detector_state : bytes, optional
        Of a detector calibrated with healthy records.
    tried : sequence of Fault
        Faults put into the readings; their times count from the first sample.
    progress : callable
        ``progress(text, share)``, some hundred times.
    watch : Watching, optional
        A fault bank that looks for faults in place of the estimator's detector.

    Raises
    ------
    InputError
        The record is too short for the first window, or a fault begins after its end.
    """
    from identification.online.estimator import OnlineEstimator, OnlineOptions

    even = record.resampled()
    for asked in tried:
        if not 0 <= asked.start < even.duration:
            raise InputError(
                f"{record.name}: a fault at {asked.start:g} s is asked for, the record is "
                f"{even.duration:.4g} s long"
            )
    options = OnlineOptions(
        has_link=record.has("link_position"),
        has_torque=record.has("link_torque"),
        detect=watch is None and may_watch(record, detector_state),
    )
    estimator = OnlineEstimator(joint, even.dt, options, detector_state)
    table, there = online_readings(even, joint)
    healthy = np.array(table)
    readings = np.array(online_readings(even, joint, tried)[0]) if tried else healthy
    valid = (np.isfinite(readings) & np.array(there)).tolist()
    used, failed = readings.copy(), np.zeros(readings.shape, dtype=bool)
    judged = None
    if watch is not None:
        judged = judgement(watch, even, joint, tried)
        failed = judged.failed
        used = np.where(failed, judged.readings, used)
        valid = (np.array(valid) & ~failed).tolist()
    rows = np.nan_to_num(readings).tolist()
    every = max(1, len(even) // POINTS)
    stepper = Stepper(estimator, every, told=judged is None)
    detector = estimator.detector
    for part in even.segments():
        stepper.restart()
        for k in range(part.start, part.stop):
            looked = stepper.feed(float(even.time[k]), rows[k], valid[k])
            if detector is not None:
                used[k], failed[k] = estimator.readings, detector.replaced
            if looked:
                progress(f"tracking {record.name}", (k + 1) / len(even))
        progress(f"tracking {record.name}", part.stop / len(even))
    course, looks, verdicts = stepper.course, stepper.looks, stepper.verdicts
    events = stepper.events
    scores = np.array([row for _, row in looks]).reshape(-1, len(READINGS))
    if judged is not None:
        events = [_bank_event(e) for e in judged.events]
        verdicts = list(judged.verdicts)
        begins = np.array([0, *(k + 1 for k, _ in looks[:-1])], dtype=np.int64)
        scores = np.maximum.reduceat(judged.scores, begins)[: len(looks)] if looks else scores
    longest = max(part.stop - part.start for part in even.segments()) * even.dt
    if not course and not events and (judged is None or longest < 2 * SETTLE):
        where = (
            "are too short"
            if len(even.segments()) == 1
            else f"in {len(even.segments())} pieces, the longest of {longest:.3g} s, are too short"
        )
        raise InputError(
            f"{record.name}: {even.duration:.3g} s {where} for the first window of "
            f"{options.warm_up:g} s; give a longer record"
        )
    time, values, sigmas, ratios = arrays_of(course, estimator)
    return Replay(
        even,
        estimator,
        time=time,
        values=values,
        sigmas=sigmas,
        ratios=ratios,
        looks=np.array([k for k, _ in looks], dtype=np.int64),
        scores=scores,
        events=tuple(events),
        verdicts=tuple(verdicts),
        healthy=healthy,
        readings=readings,
        used=used,
        failed=failed,
        tried=tuple(tried),
        calibrated=watch is not None
        or (estimator.detector is not None and detector_state is not None),
        banked=watch is not None,
        smallest={} if watch is None else watch.smallest,
    )


def _bank_event(event: dict[str, Any]) -> dict[str, Any]:
    """An event of a bank with the words of its code."""
    from identification.faults.bank_spring import STIFFNESS
    from identification.faults.detector import SENSORS
    from identification.faults.types import Verdict

    text, sensors = fault_text(event["fault"]), event["sensors"]
    if event["verdict"] is Verdict.ONE_OF:
        names = [READINGS[SENSORS.index(n)] for n in sensors if n in SENSORS]
        spring = ", or the stiffness changed" if STIFFNESS in sensors else ""
        text = f"{' or '.join(names)} failed{spring}; the readings cannot tell which"
    elif STIFFNESS in sensors:
        text += "; its stiffness explains the readings"
    return {"time": event["time"], "fault": event["fault"], "text": text, "first": event["first"]}


def _print_track(result: dict[str, Any]) -> None:
    if result["parameters"]:
        print(f"{result['record']}: {counted(len(result['parameters']), 'parameter')} followed")
        print(
            "  last value +- standard deviation, in brackets the side it is referred to, and the "
            "first value"
        )
    else:
        print(f"{result['record']}: {UNESTIMATED}")
    for name, p in result["parameters"].items():
        print(
            f"  {name:<28} {p['value']:.6g} +- {p['sigma']:.2g} {p['unit']} ({p['side']} side), "
            f"first {p['history'][0]:.6g}"
        )
    if result["ratio"]:
        print(
            "  residual over floor: "
            + ", ".join(f"{b} {r:.3g}" for b, r in result["ratio"].items())
        )
    if not result["detector"]:
        print(f"  {result['not_watched']}")
    for event in result["events"]:
        print(f"  {event['time']:.3f} s: {event['text']}")
    if result.get("doubt"):
        print(f"  {result['doubt']}")
    for span in result["replaced"]:
        print(f"  {span['reading']} replaced from {span['from']:.3f} s to {span['to']:.3f} s")
    if result["detector"] and not result["calibrated"]:
        print(
            "  limits of the fault detector are guesses: give records of the healthy joint with "
            "--healthy"
        )
    if result["detector"] and not result["events"]:
        print("  no sensor fault")


def run_plan(arguments: Namespace) -> int:
    """`irj plan`."""
    from identification.data.typical import true_values
    from identification.planning.trajectories import (
        Experiment,
        Limits,
        select,
        sinusoidal_grid,
        triangular_grid,
    )

    joint = open_joint(arguments.joint)
    model = joint.model()
    if not model.is_elastic:
        raise InputError(
            f'{arguments.joint}: plan simulates an elastic joint; set model = "hd3" (a rigid '
            "model is excited by any motion that reverses)"
        )
    for option in ("max_position", "max_speed", "max_torque"):
        if not getattr(arguments, option) > 0:
            raise InputError(
                f"--{option.replace('_', '-')} {getattr(arguments, option):g}: give a limit above 0"
            )
    model = model.with_values(true_values(model, joint))
    limits = Limits(
        math.radians(arguments.max_position),
        math.radians(arguments.max_speed),
        arguments.max_torque,
    )
    motions = [
        *triangular_grid(limit=min(math.radians(arguments.max_position) * 0.95, math.radians(80))),
        *sinusoidal_grid(),
    ]
    experiment = Experiment(model, stride=20)
    tried = []
    for k, motion in enumerate(motions):
        progress_bar(f"trying {motion.family}", k / len(motions))
        tried.append(experiment.evaluate(motion, limits=limits))
    progress_bar("done", 1.0)
    allowed = [t for t in tried if not t.broken]
    if not allowed:
        broken = ", ".join(sorted({b for t in tried for b in t.broken}))
        raise InputError(
            f"{arguments.joint}: no motion keeps the limits ({broken}); widen --max-position, "
            "--max-speed or --max-torque"
        )
    chosen = select(experiment, [t.motion for t in allowed], limits=limits)
    write_bytes(arguments.output, chosen.best.motion.text.encode())
    _print_plan(arguments.output, chosen, len(tried) - len(allowed), bool(joint.fitted))
    best = chosen.best
    data = {
        "family": best.motion.family,
        "parameters": dict(best.motion.parameters),
        "relative_deviation": dict(best.relative_deviation),
        "condition": best.condition,
        "tried": len(tried),
        "file": arguments.output,
        "by_effect": best.by_effect(model),
    }
    write_json(arguments.json, data)
    return 0


def _print_plan(path: str, chosen: Selection, refused: int, fitted: bool) -> None:
    best = chosen.best
    values = ", ".join(_shown(k, v) for k, v in best.motion.parameters.items())
    print(
        f"{path}: {best.motion.family} motion, {values}; best of {len(chosen.tried)}"
        + (f", {refused} break the limits" if refused else "")
    )
    if not fitted:
        print(
            "  the joint file has no fitted values: typical ones were taken, so read the figures "
            "as orders of magnitude"
        )
    print("  standard deviation to expect, in percent of the value:")
    for name, deviation in best.relative_deviation.items():
        shown = (
            f"{100 * deviation:.3g} %"
            if math.isfinite(deviation)
            else "cannot be identified by this motion"
        )
        print(f"    {name:<28} {shown}")


def _shown(name: str, value: float) -> str:
    if name in ("hold", "period", "rendezvous", "reversal"):
        return f"{name} {value:.3g} s"
    return f"{name} {math.degrees(value):.3g} deg" + ("/s" if name == "speed" else "")
