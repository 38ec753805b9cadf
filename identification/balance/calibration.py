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
from casadi_models.term import CALIBRATION
from identification.balance.balances import Balances, balances_of
from identification.balance.memory import numbers_of
from identification.balance.sensing import Sensing
from identification.balance.weak import WeakRecord
from identification.data.record import Record

FloatArray = npt.NDArray[np.float64]

ROUNDS: Final = 8
"""Gauss-Newton steps for the unknowns of one record: the balances are nearly straight lines in
them.
"""
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
    """

    what: str
    sensor: str
    run: int
    value: float
    stderr: float | None
    unit: str

    def as_json(self) -> dict[str, Any]:
        """The shape of `improve --json`."""
        return {
            "what": self.what,
            "sensor": self.sensor,
            "run": self.run,
            "value": self.value,
            "stderr": self.stderr,
            "unit": self.unit,
        }


def unknowns_of(model: JointModel, sensing: Sensing) -> tuple[str, ...]:
    """Calibration unknowns that a model on these channels has: a zero between the encoders
    wherever their difference is a twist.
    """
    return (
        ("link_encoder_zero",)
        if model.is_elastic and sensing.both_positions and not sensing.clamped_link
        else ()
    )


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
    """Values with those of this record in the place of the common ones."""
    own = {n: values[of_run(n, record)] for n in model.calibration if of_run(n, record) in values}
    return {**values, **own} if own else values


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
        if not model.calibration:
            continue
        a = w.averaged
        twist = a["motor_position"] - a["link_position"]
        v = a["link_velocity"]
        columns = [
            np.ones(w.rows),
            a["torque" if torque else "drive"],
            v,
            a["link_acceleration"],
            np.sign(v),
        ]
        matrix = np.column_stack(columns)
        found = np.linalg.lstsq(
            matrix / np.maximum(np.linalg.norm(matrix, axis=0), 1e-300), twist, rcond=1e-9
        )[0]
        out[of_run("link_encoder_zero", w)] = -float(found[0]) / np.sqrt(w.rows)
    return out


def without_calibration(
    record: Record, model: JointModel, values: Mapping[str, float], run: str
) -> Record:
    """The record with what the calibration of this run, or the common one, says taken off its
    readings.
    """
    zero = "link_encoder_zero"
    if zero not in model.calibration:
        return record
    off = values.get(f"{zero}[{run}]", values[zero])
    return replace(
        record, channels={**record.channels, "link_position": record["link_position"] - off}
    )


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
    step.
    """
    now = {n: float(values[n]) for n in names}
    seen = [b for b in balances.balances if b not in record.masked]
    for _ in range(ROUNDS):
        found = balances.evaluate(record, {**values, **now})
        scale = {b: max(float(np.sqrt(np.mean(found[b][0] ** 2))), 1e-300) for b in seen}
        r = np.concatenate([found[b][0] / scale[b] for b in seen])
        j = np.concatenate([found[b][1] / scale[b] for b in seen])
        norms = np.linalg.norm(j, axis=0)
        if not np.any(norms) or not np.all(np.isfinite(j)):
            break
        scaled = j / np.where(norms > 0, norms, 1.0)
        step = np.linalg.lstsq(scaled, -r, rcond=1e-9)[0]
        now = {
            n: now[n] + float(s) / (norm or 1.0)
            for n, s, norm in zip(names, step, norms, strict=True)
        }
        if float(np.linalg.norm(scaled @ step)) < SETTLED * float(np.linalg.norm(r)):
            break
    return {of_run(n, record): x for n, x in now.items()}


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
            what, sensor = CALIBRATION[name].what, CALIBRATION[name].sensor
            own = of_run(name, w)
            out.append(
                Found(
                    what,
                    sensor,
                    run,
                    float(values.get(own, values[name])),
                    stderr.get(own),
                    units[name],
                )
            )
    return tuple(out)


__all__ = [
    "Found",
    "bare",
    "calibration_found",
    "is_of_run",
    "names_of_runs",
    "of_run",
    "settled",
    "start_values",
    "unknowns_of",
    "values_on",
    "without_calibration",
]
