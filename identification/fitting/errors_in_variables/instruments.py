"""What motor encoder and torque sensor say of the link: columns that noise of the link's own
encoder does not enter.

Noise of an encoder stands in a column and in the residual at once, and least squares make a
parameter of it. What it does may be drawn and taken off, but on slow motion it is most of an
acceleration, and then a level that is off by percents makes an inertia a third or thrice what it
is. The motor's motion, less the wind-up that the torque tells, is the link's motion with other
noise: products with it hold the true parameters whatever the level (instrumental variables, Fuller
1987, Measurement Error Models, section 1.4).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.calibration import values_on
from identification.balance.weak import POSITION_CHAINS, WeakRecord
from identification.fitting.weak_form import WeakForm

FloatArray = npt.NDArray[np.float64]

MET: Final = ("link", "transmission")
"""Balances whose columns hold readings of the link's encoder."""
SENSORS: Final = ("motor_position", "link_position", "torque")


@final
@dataclass(frozen=True)
class Instruments:
    """Weighted columns of some balances as the other sensors see them.

    Attributes
    ----------
    met : frozenset of str
        The balances; every other keeps its own columns.
    columns : (rows, free) array
        Of all balances one after the other, then of the prior, as
        :meth:`identification.fitting.weak_form.WeakForm.jacobian`.
    """

    met: frozenset[str]
    columns: FloatArray

    def beside(self, own: FloatArray, problem: WeakForm) -> FloatArray:
        """Own columns (rows, free) of a problem, those of these balances in their place.

        Shapes and smoothing velocities keep their own: they hang on the very instants of the turns.
        """
        count = problem.rows
        out, straight = own.copy(), ~problem.bent
        for k, b in enumerate(problem.balances.balances):
            if b in self.met:
                rows = slice(k * count, (k + 1) * count)
                out[rows, :] = np.where(straight, self.columns[rows], own[rows])
        return out


def mixed(own: FloatArray, by: FloatArray | None) -> FloatArray:
    """How columns `by` (rows, p) combine to what they can say of the own ones (rows, p): the first
    of two stages of least squares, (p, p). Their products with the own ones are symmetric then.
    """
    if by is None:  # each meets itself
        return np.eye(own.shape[1])
    size = np.maximum(np.linalg.norm(by, axis=0), 1e-300)
    found, *_ = np.linalg.lstsq(by / size, own, rcond=1e-10)
    return np.asarray(found / size[:, None], dtype=np.float64)


def instruments_of(problem: WeakForm, met: frozenset[str]) -> Instruments:
    """Columns of these balances at the values of a problem, from the other sensors."""
    data = problem.data
    train = tuple(from_others(problem, w, w) for w in data.train)
    others = replace(problem, data=replace(data, train=train))
    return Instruments(met, others.jacobian(np.array([problem.values[n] for n in problem.free])))


def can_be_met(problem: WeakForm) -> frozenset[str]:
    """Balances of a problem for whose link the other sensors can speak."""
    data, model = problem.data, problem.balances.model
    there = all(set(SENSORS) <= set(w.averaged) for w in data.train)
    if not there or data.sensing.clamped_link or not _compliance(problem):
        return frozenset()
    return frozenset(MET) & set(problem.balances.balances) if model.is_elastic else frozenset()


def _compliance(problem: WeakForm) -> float:
    """Twist for each unit of torque at the values of a problem [rad/(N.m)]."""
    name = problem.balances.model.stiffness_name
    stiffness = problem.values.get(name, 0.0) if name else 0.0
    return 1 / stiffness if stiffness > 0 else 0.0


def from_others(problem: WeakForm, record: WeakRecord, run: WeakRecord) -> WeakRecord:
    """A record whose link is that of motor encoder and torque sensor, as the link's own encoder
    would read it: with its zero, and as late as it is.

    Parameters
    ----------
    problem : WeakForm
        Whose values say how far the transmission winds up.
    record : WeakRecord
    run : WeakRecord
        The training record that it is, or is drawn from.
    """
    values = values_on(problem.balances.model, run, problem.values)
    return replace(
        record,
        averaged=_link_of_others(record.averaged, values, _compliance(problem)),
        points=_link_of_others(record.points, values, _compliance(problem)),
        smooth=_link_of_others(record.smooth, values, _compliance(problem)),
        paired=_paired(record, values, _compliance(problem)),
    )


def _paired(
    record: WeakRecord, values: Mapping[str, float], compliance: float
) -> dict[str, FloatArray]:
    """Both positions for laws that follow the torsion, with the torque that winds it up."""
    beside = {n: record.smooth[n] for n in POSITION_CHAINS["torque"] if n in record.smooth}
    moved = _link_of_others({**record.paired, **beside}, values, compliance)
    return {n: moved[n] for n in record.paired}


def _link_of_others(
    signals: Mapping[str, FloatArray], values: Mapping[str, float], compliance: float
) -> dict[str, FloatArray]:
    """Signals with the motion of the link in terms of the others. Of an acceleration the wind-up's
    part is left out: it would be a second derivative of the torque."""
    if not set(POSITION_CHAINS["motor_position"][:1]) <= set(signals):
        return dict(signals)
    zero, late = (values.get(n, 0.0) for n in ("link_encoder_zero", "link_encoder_skew"))
    torque_late = values.get("torque_sensor_skew", 0.0)
    nothing = np.zeros(len(signals["motor_position"]))
    torque, rate = signals.get("torque", nothing), signals.get("torque_rate", nothing)
    twists = (compliance * (torque + torque_late * rate), compliance * rate, nothing, nothing)
    true = [
        signals.get(m, nothing) - twist
        for m, twist in zip(POSITION_CHAINS["motor_position"], twists, strict=True)
    ]
    read = [
        x - late * (true[k + 1] - late / 2 * (true[k + 2] if k + 2 < len(true) else nothing))
        if k + 1 < len(true)
        else x
        for k, x in enumerate(true)
    ]
    read[0] = read[0] + zero
    return {
        **signals,
        **{
            n: x
            for n, x in zip(POSITION_CHAINS["link_position"], read, strict=True)
            if n in signals
        },
    }


__all__ = ["MET", "Instruments", "can_be_met", "from_others", "instruments_of", "mixed"]
