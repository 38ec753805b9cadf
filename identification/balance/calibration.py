"""Calibration unknowns: what the sensors of a record are off by, fitted beside the physics and
never claimed as physics.

Every record has its own values: an encoder is homed anew, a logger started anew. In the values of a
fit they stand as ``name[run]``, next to one common value for a record that is not known.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from casadi_models.hold import CLOCKS, HOLD_DELAY, HOLD_NAME, UNKNOWNS
from identification.balance.balances import Balances, balances_of
from identification.balance.clocks import (
    ENCODERS,
    LOW_PASSED,
    MOST_SKEW,
    NEAR,
    SIGNAL,
    SURE,
    USUAL_SKEW,
    at_stamps,
    lateness,
    one_way,
)
from identification.balance.memory import numbers_of
from identification.balance.noise import effective_share
from identification.balance.sensing import Sensing
from identification.balance.weak import WeakRecord
from identification.data.prepare import shift_channel
from identification.data.record import Record

FloatArray = npt.NDArray[np.float64]

ROUNDS: Final = 8
"""Gauss-Newton steps for the unknowns of one record: the balances are nearly straight lines in
them.
"""
TOLD: Final = 0.3
"""Standard error of a skew from which on it is only bounded [samples]: the lag from which on clocks
count as out of step.
"""
SHIFTED: Final = 0.01
"""Skew below which a record is left as it is [samples]."""
SETTLED: Final = 1e-4
"""Size of a step, as a share of the residual's norm, at which these steps end: far below what
one row tells.
"""


@final
@dataclass(frozen=True)
class Found:
    """One calibration unknown of one run, as found.

    Attributes
    ----------
    what : {"zero", "skew", "offset"}
    sensor : str
        Channel of the record.
    run : int
        Number of the training record.
    value : float
        Reading at the true zero, or the time by which the channel is late [unit].
    stderr : float or None
    unit : str
    bounded : bool
        True for a skew that these records hardly tell: only its band is worth a word.
    waits : float or None
        Part of a skew by which the channel waits, where the rest is that of a filter [unit].
    """

    what: str
    sensor: str
    run: int
    value: float
    stderr: float | None
    unit: str
    bounded: bool = False
    waits: float | None = None

    def as_json(self) -> dict[str, Any]:
        """The shape of `improve --json`."""
        return {
            "what": self.what,
            "sensor": self.sensor,
            "run": self.run,
            "value": self.value,
            "stderr": self.stderr,
            "unit": self.unit,
            "waits": self.waits,
        }


def unknowns_of(model: JointModel, sensing: Sensing) -> tuple[str, ...]:
    """Calibration unknowns that a model on these channels has.

    A zero between the encoders, and a skew of theirs, wherever their difference is a twist; a skew
    of the torque sensor where two balances share its reading; that of the drive where a torque or
    a twist is measured beside it: with the motion alone it would be friction. A channel whose delay
    the model names has no skew.
    """
    twist = model.is_elastic and sensing.both_positions and not sensing.clamped_link
    torque = sensing.has_torque and not sensing.clamped_link
    there = {
        "link_encoder_zero": twist,
        "link_encoder_skew": twist,
        "torque_sensor_skew": torque and (len(sensing.balances) > 1 or sensing.motor_and_torque),
        HOLD_NAME: (torque or twist) and HOLD_DELAY in model.effects,
    }
    return _without_named(model, tuple(n for n, is_there in there.items() if is_there))


def nuisances(model: JointModel) -> frozenset[str]:
    """Parameters that are no figure of the joint: stand-ins for jumps, the hold of the drive, and
    what the sensors were off by.
    """
    return frozenset({*model.named("smoothing"), HOLD_NAME, *model.calibration})


def named_late(model: JointModel) -> JointModel:
    """The model without the skews of channels whose delay it names."""
    return replace(model, calibration=_without_named(model, model.calibration))


def _without_named(model: JointModel, names: tuple[str, ...]) -> tuple[str, ...]:
    named = {t.place for t in model.terms if t.effect.is_delay and t.label != HOLD_DELAY}
    return tuple(n for n in names if n not in CLOCKS or CLOCKS[n].place not in named)


def of_run(name: str, record: WeakRecord) -> str:
    """Name of an unknown in one record."""
    return f"{name}[{record.name}]"


def bare(names: Iterable[str]) -> tuple[str, ...]:
    """Names of the model's parameters, those of single runs without their run; each once."""
    return tuple(dict.fromkeys(n.partition("[")[0] for n in names))


def is_of_run(name: str) -> bool:
    """True for an unknown of one record."""
    return "[" in name


def names_of_runs(model: JointModel, records: Sequence[WeakRecord]) -> tuple[str, ...]:
    """All unknowns of all records."""
    return tuple(of_run(n, w) for w in records for n in model.calibration)


def values_on(
    model: JointModel, record: WeakRecord, values: Mapping[str, float]
) -> Mapping[str, float]:
    """Values with those of this record in the place of the common ones, skews less the whole
    samples that were taken off it.
    """
    own = {n: values[of_run(n, record)] for n in model.calibration if of_run(n, record) in values}
    return at_stamps(model, record, {**values, **own} if own else values)


def limits_of_runs(
    model: JointModel, records: Sequence[WeakRecord]
) -> dict[str, tuple[float, float]]:
    """Bounds of all unknowns of all records: a skew is a few samples."""
    out = dict.fromkeys(names_of_runs(model, records), (-np.inf, np.inf))
    for w in records:
        most = MOST_SKEW * w.grid.dt
        out.update({of_run(n, w): (-most, most) for n in model.calibration if n in CLOCKS})
    return out


def within_limits(
    model: JointModel, records: Sequence[WeakRecord], values: Mapping[str, float]
) -> tuple[str, ...]:
    """Unknowns of all records that do not stand at a bound: those that still move."""
    limits = limits_of_runs(model, records)
    return tuple(n for n, (low, high) in limits.items() if low < values[n] < high)


def usual(
    model: JointModel, records: Sequence[WeakRecord], *, torque: bool
) -> dict[str, tuple[float, float]]:
    """Middle and standard deviation of the unknowns before the balances are asked [s, rad].

    Where nothing tells a skew from friction (two encoders without torque sensor), it stays as near
    to what friction cannot explain as the friction, which is never negative, allows.
    """
    out, begin = {}, start_values(model, records, torque=torque)
    for w in records:
        for n in model.calibration:
            if n not in CLOCKS:
                # the twist passes its zero somewhere, or as far from it as it moves
                a = w.averaged
                late = begin.get(of_run("link_encoder_skew", w), 0.0) - w.shifts.get(
                    "link_position_sensor", 0.0
                )
                twist = a["motor_position"] - a["link_position"] - late * a["link_velocity"]
                out[of_run(n, w)] = begin[of_run(n, w)], max(float(np.ptp(twist)), 1e-12)
                continue
            middle, place = 0.0, CLOCKS[n].place
            if place in ENCODERS and not torque:
                late, error, _ = lateness(w, place, torque=torque)
                whole = w.shifts.get(place, 0.0) + late  # what was taken off, and what is left
                if abs(whole) > SURE * error:
                    most = MOST_SKEW * w.grid.dt
                    middle = min(max(whole, -most), most)
            out[of_run(n, w)] = middle, USUAL_SKEW * w.grid.dt
    return out


def start_values(
    model: JointModel, records: Sequence[WeakRecord], *, torque: bool
) -> dict[str, float]:
    """Where the unknowns of each record begin: the twist regressed on what it may follow from.

    The balances are bilinear in stiffness and zero, and from zero a fit may end without any
    stiffness; the regression of the twist on a constant, the torque, velocity, acceleration and its
    direction is a straight line.
    """
    out = {}
    for w in records:
        late = {p: w.shifts.get(p, 0.0) for p in SIGNAL}
        out.update({of_run(n, w): late[CLOCKS[n].place] for n in model.calibration if n in CLOCKS})
        if "link_encoder_zero" not in model.calibration:
            continue
        a = w.averaged
        twist = a["motor_position"] - a["link_position"]
        v = a["link_velocity"]
        effort = a.get("torque" if torque else "drive")
        columns = [
            np.ones(w.rows),
            *([] if effort is None else [effort]),
            v,
            a["link_acceleration"],
            np.sign(v),
        ]
        matrix = np.column_stack(columns)
        norms = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        found = np.linalg.lstsq(matrix / norms, twist, rcond=1e-9)[0] / norms
        out[of_run("link_encoder_zero", w)] = -float(found[0])
        # without any torque nothing tells friction of the link from lateness
        if "link_encoder_skew" in model.calibration and effort is not None:
            most = MOST_SKEW * w.grid.dt
            start = late["link_position_sensor"] + float(found[len(columns) - 3])
            out[of_run("link_encoder_skew", w)] = min(max(start, -most), most)
    return out


def without_calibration(
    record: Record, model: JointModel, values: Mapping[str, float], run: str
) -> Record:
    """The record with what the calibration of this run, or the common one, says taken off its
    readings; the hold of the drive stays.
    """
    off = {n: values.get(f"{n}[{run}]", values[n]) for n in model.calibration if n != HOLD_NAME}
    for name, value in off.items():
        sensor = UNKNOWNS[name].sensor
        if UNKNOWNS[name].what == "zero":
            channels = {**record.channels, sensor: record[sensor] - value}
            record = replace(record, channels=channels)
        elif abs(value) > SHIFTED * record.dt:
            record = shift_channel(record, sensor, value)
    return record


def settled(
    model: JointModel, sensing: Sensing, records: Sequence[WeakRecord], values: Mapping[str, float]
) -> dict[str, float]:
    """Values with the unknowns of every record: a record that has none yet gets its own, fitted on
    itself at these values.

    Parameters
    ----------
    model : JointModel
    sensing : Sensing
    records : sequence of WeakRecord
    values : mapping of str to float
        Of every parameter; unknowns of the records that are known already keep their values.
    """
    out = dict(values)
    for w in records:
        missing = [n for n in model.calibration if of_run(n, w) not in out]
        if missing:
            balances = balances_of(model, sensing, wrt=missing)
            law = (balances.law, tuple(missing), tuple(float(out[n]) for n in balances.names))
            fitted = partial(_fitted_on_itself, balances, w, out, missing)
            out.update(numbers_of(w, law, fitted))
    return out


def _fitted_on_itself(
    balances: Balances, record: WeakRecord, values: Mapping[str, float], names: Sequence[str]
) -> dict[str, float]:
    """Unknowns of one record by least squares, each balance in units of what it leaves at that
    step; a skew that the record does not tell stays as in the values.
    """
    now = {n: float(values[n]) for n in names}
    turning = ~one_way(record) if any(n in CLOCKS for n in names) else np.False_
    # inside a gap the twist says nothing of its zero
    touching = balances.flight(record, values) == 0
    rows = {b: record.taking(b) & ~turning & touching for b in balances.balances}
    size = USUAL_SKEW * record.grid.dt
    usually, limits = dict(now), limits_of_runs(balances.model, [record])
    seen = [b for b in balances.balances if rows[b].any()]
    for _ in range(ROUNDS if seen else 0):
        found = balances.evaluate(record, at_stamps(balances.model, record, {**values, **now}))
        scale = {b: max(float(np.sqrt(np.mean(found[b][0][rows[b]] ** 2))), 1e-300) for b in seen}
        share = min(effective_share(found[b][0][rows[b]]) for b in seen)
        known = np.diag([1 / (size * share**0.5) if n in CLOCKS else 0.0 for n in names])
        moved = np.array([now[n] - usually[n] for n in names])
        r = np.concatenate([*(found[b][0][rows[b]] / scale[b] for b in seen), known @ moved])
        j = np.concatenate([*(found[b][1][rows[b]] / scale[b] for b in seen), known])
        norms = np.linalg.norm(j, axis=0)
        if not np.any(norms) or not np.all(np.isfinite(j)):
            break
        scaled = j / np.where(norms > 0, norms, 1.0)
        step = np.linalg.lstsq(scaled, -r, rcond=1e-9)[0]
        now = {
            n: float(np.clip(now[n] + float(s) / (norm or 1.0), *limits[of_run(n, record)]))
            for n, s, norm in zip(names, step, norms, strict=True)
        }
        if float(np.linalg.norm(scaled @ step)) < SETTLED * float(np.linalg.norm(r)):
            break
    return {of_run(n, record): x for n, x in now.items()}


def _waits(name: str, record: WeakRecord, late: float) -> float | None:
    """The part of a lateness by which a reading waits, as it was shifted, where it may come through
    a filter as well; None where there is no other part [s].
    """
    place = CLOCKS[name].place if name in CLOCKS else ""
    shift = max(record.shifts.get(place, 0.0), 0.0)
    filtered = place in LOW_PASSED and late - shift > NEAR * record.grid.dt
    return shift if filtered else None


def calibration_found(
    model: JointModel,
    records: Sequence[WeakRecord],
    values: Mapping[str, float],
    stderr: Mapping[str, float | None],
) -> tuple[Found, ...]:
    """The unknowns of the training records as found."""
    units = {p.name: p.unit for p in model.parameters}
    out = []
    for run, w in enumerate(records):
        for name in model.calibration:
            what, sensor = UNKNOWNS[name].what, UNKNOWNS[name].sensor
            own = of_run(name, w)
            error = stderr.get(own)
            value = float(values.get(own, values[name]))
            out.append(
                Found(
                    what,
                    sensor,
                    run,
                    value=value,
                    stderr=error,
                    unit=units[name],
                    bounded=name in CLOCKS and error is not None and error > TOLD * w.grid.dt,
                    waits=_waits(name, w, value),
                )
            )
    return tuple(out)


__all__ = [
    "Found",
    "bare",
    "calibration_found",
    "is_of_run",
    "limits_of_runs",
    "named_late",
    "names_of_runs",
    "of_run",
    "settled",
    "start_values",
    "unknowns_of",
    "usual",
    "within_limits",
    "values_on",
    "without_calibration",
]
