"""track, plan: the online estimator replayed on records, and the motion that makes the parameters identifiable."""

from __future__ import annotations

import math
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from identification.errors import InputError
from workbench.commands.files import open_joint, open_records, progress_bar, write_bytes, write_json

if TYPE_CHECKING:
    from identification.excite import Excitation, Selection
    from identification.joint_file import Joint
    from identification.record import Record
    from irj_fmu.online import OnlineEstimator

ROWS: Final = 12
"""Rows of the table printed per record; the JSON holds a hundred."""


def run_track(arguments: Namespace) -> int:
    """`irj track`: 1 where ``--fail-on-fault`` was given and a fault was found."""
    joint = open_joint(arguments.joint)
    records, warnings = open_records(arguments.records, joint)
    state = _healthy_state(arguments, joint, records[0])
    found = [track(record, joint, state) for record in records]
    for result in found:
        _print_track(result)
    write_json(arguments.json, {"records": found, "warnings": warnings})
    return 1 if arguments.fail_on_fault and any(r["events"] for r in found) else 0


def _healthy_state(arguments: Namespace, joint: Joint, record: Record) -> bytes | None:
    from irj_fmu.build import detector_state
    from irj_fmu.online import OnlineOptions

    options = OnlineOptions(has_link=record.has("link_position"), has_torque=record.has("link_torque"))
    return detector_state(joint, options, [Path(p) for p in arguments.healthy])


def track(record: Record, joint: Joint, detector_state: bytes | None = None) -> dict[str, Any]:
    """Replay a record through the online estimator, sample by sample.

    Parameters
    ----------
    record : Record
        Resampled to its median step; every stretch starts the estimator anew.
    joint : Joint
        With fitted values the sensor-fault detector runs too.
    detector_state : bytes, optional
        Of a detector calibrated with healthy records.

    Returns
    -------
    dict
        ``record``, ``time``, ``parameters`` (name to value, sigma, unit, side, history), ``ratio`` (balance to residual
        over floor), ``events``, ``detector`` (whether faults were looked for).
    """
    from irj_fmu.online import OnlineEstimator, OnlineOptions

    even = record.resampled()
    options = OnlineOptions(has_link=record.has("link_position"), has_torque=record.has("link_torque"))
    if not options.has_torque or not options.has_link:
        detector_state = None
    estimator = OnlineEstimator(joint, even.dt, options, detector_state)
    readings, valid = online_readings(even, joint)
    every = max(1, len(even) // 100)
    times: list[float] = []
    history: list[list[float]] = []
    events: list[dict[str, Any]] = []
    fault = 0
    for part in even.segments():
        estimator.reset()
        for k in range(part.start, part.stop):
            now = float(even.time[k])
            estimator.update(now, readings[k], valid)
            if estimator.fault != fault:
                fault = estimator.fault
                if fault:
                    events.append({"time": now, "fault": fault, "text": fault_text(fault)})
            if (k + 1) % every == 0 and not estimator.warming_up:
                times.append(now)
                history.append(estimator.theta.tolist())
        progress_bar(f"tracking {record.name}", part.stop / len(even))
    if estimator.warming_up:
        raise InputError(f"{record.name}: {even.duration:.3g} s are too short for the first window of {options.warm_up:g} s; give a longer record")
    return _result(even, estimator, times, history, events)


def online_readings(record: Record, joint: Joint) -> tuple[list[list[float]], list[bool]]:
    """Drive, motor position and velocity, link position and velocity, torque (link-referred SI), and which are there."""
    from identification.sensing import drive_torque

    count, ratio = len(record), joint.gear_ratio
    motor = record["motor_position"] / ratio if record.has("motor_position") else record["link_position"]
    link = record["link_position"] if record.has("link_position") else motor

    def velocity(channel: str, scale: float, position: Any) -> Any:
        return record[channel] / scale if record.has(channel) else np.gradient(position, record.time)

    torque = record["link_torque"] if record.has("link_torque") else np.zeros(count)
    table = np.column_stack([
        drive_torque(record, joint), motor, velocity("motor_velocity", ratio, motor), link, velocity("link_velocity", 1.0, link), torque,
    ])  # fmt: skip
    has_link = record.has("link_position")
    return table.tolist(), [True, True, True, has_link, has_link, record.has("link_torque")]


def fault_text(code: int) -> str:
    """What a fault code means, in words."""
    names = ("motor current", "motor position", "motor velocity", "link position", "link velocity", "torque")
    if code == 7:
        return "motor current sensor failed or motor friction changed"
    if code == 8:
        return "the joint changed, the sensors agree with each other"
    kind, sensor = divmod(code, 10)
    what = ("sensor failed", "reading missing", "reading constant while the joint moves", "reading of wrong scale")[kind]
    return f"{names[sensor - 1]}: {what}"


def _result(
    record: Record, estimator: OnlineEstimator, times: list[float], history: list[list[float]], events: list[dict[str, Any]]
) -> dict[str, Any]:
    units = {p.name: p for p in estimator.model.parameters}
    table = np.array(history)
    return {
        "record": record.name, "time": times, "detector": estimator.detector is not None, "events": events,
        "ratio": dict(zip(estimator.balances, estimator.ratio.tolist(), strict=True)),
        "parameters": {
            name: {"value": float(estimator.theta[i]), "sigma": float(estimator.sigma[i]), "unit": units[name].unit,
                   "side": units[name].side, "history": table[:, i].tolist()}
            for i, name in enumerate(estimator.names)
        },
    }  # fmt: skip


def _print_track(result: dict[str, Any]) -> None:
    print(f"{result['record']}: {len(result['parameters'])} parameters followed")
    print("  last value +- standard deviation, in brackets the side it is referred to, and the first value")
    for name, p in result["parameters"].items():
        print(f"  {name:<28} {p['value']:.6g} +- {p['sigma']:.2g} {p['unit']} ({p['side']} side), first {p['history'][0]:.6g}")
    print("  residual over floor: " + ", ".join(f"{b} {r:.3g}" for b, r in result["ratio"].items()))
    if not result["detector"]:
        print("  sensor faults were not looked for: that needs an elastic joint file with fitted values (`irj fit -o`)")
    for event in result["events"]:
        print(f"  {event['time']:.3f} s: {event['text']}")
    if result["detector"] and not result["events"]:
        print("  no sensor fault")


def run_plan(arguments: Namespace) -> int:
    """`irj plan`."""
    from identification.excite import Experiment, Limits, select, sinusoidal_grid, triangular_grid
    from workbench.commands.virtual import true_values

    joint = open_joint(arguments.joint)
    model = joint.model()
    if not model.is_elastic:
        raise InputError(f"{arguments.joint}: plan simulates an elastic joint; set model = \"hd3\" (a rigid model is excited by any motion that reverses)")
    model = model.with_values(true_values(model, joint))
    limits = Limits(math.radians(arguments.max_position), math.radians(arguments.max_speed), arguments.max_torque)
    motions = [*triangular_grid(limit=min(math.radians(arguments.max_position) * 0.95, math.radians(80))), *sinusoidal_grid()]
    experiment = Experiment(model, stride=20)
    tried = []
    for k, motion in enumerate(motions):
        progress_bar(f"trying {motion.family}", k / len(motions))
        tried.append(experiment.evaluate(motion, limits=limits))
    progress_bar("done", 1.0)
    allowed = [t for t in tried if not t.broken]
    if not allowed:
        broken = ", ".join(sorted({b for t in tried for b in t.broken}))
        raise InputError(f"{arguments.joint}: no motion keeps the limits ({broken}); widen --max-position, --max-speed or --max-torque")
    chosen = select(experiment, [t.motion for t in allowed], limits=limits)
    _write_motion(arguments.output, chosen.best)
    _print_plan(arguments.output, chosen, len(tried) - len(allowed), bool(joint.fitted))
    best = chosen.best
    data = {
        "family": best.motion.family, "parameters": dict(best.motion.parameters), "relative_deviation": dict(best.relative_deviation),
        "condition": best.condition, "tried": len(tried), "file": arguments.output, "by_effect": best.by_effect(model),
    }  # fmt: skip
    write_json(arguments.json, data)
    return 0


def _write_motion(path: str, best: Excitation) -> None:
    import io

    from identification.excite import COLUMNS

    text = io.StringIO()
    rows = np.column_stack([best.motion.time, best.motion.table])
    np.savetxt(text, rows, delimiter=",", header=",".join(COLUMNS), comments="", fmt="%.9g")
    write_bytes(path, text.getvalue().encode())


def _print_plan(path: str, chosen: Selection, refused: int, fitted: bool) -> None:
    best = chosen.best
    values = ", ".join(_shown(k, v) for k, v in best.motion.parameters.items())
    print(f"{path}: {best.motion.family} motion, {values}; best of {len(chosen.tried)}" + (f", {refused} break the limits" if refused else ""))
    if not fitted:
        print("  the joint file has no fitted values: typical ones were taken, so read the figures as orders of magnitude")
    print("  standard deviation to expect, in percent of the value:")
    for name, deviation in best.relative_deviation.items():
        shown = f"{100 * deviation:.3g} %" if math.isfinite(deviation) else "cannot be identified by this motion"
        print(f"    {name:<28} {shown}")


def _shown(name: str, value: float) -> str:
    if name in ("hold", "period", "rendezvous", "reversal"):
        return f"{name} {value:.3g} s"
    return f"{name} {math.degrees(value):.3g} deg" + ("/s" if name == "speed" else "")
