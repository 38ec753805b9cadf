"""What torque a user's FMU leaves for acceleration along a measured motion.

The FMU is driven by the measured input and by a position controller that makes it follow the
measured position. What the controller adds is the correction torque that is missing, or too much,
in the FMU. Along its own motion q the FMU obeys J q'' = u + w - f(q), with the measured input u,
the correction w and everything f that the FMU resists with. So u - f = J q'' - w: the controller's
own noise and lag cancel in the difference, and a balance of the joint is left in which only the
physics that the FMU lacks is still to be explained.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final, final

import numpy as np

from identification.balance.weak import kernel
from identification.data.record import Record
from identification.errors import InputError
from identification.planning.follow import Controller
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.correction import CorrectionLaw, Port
from irj_fmu.imported.port import feedback_of, inertia_of, port_of
from irj_fmu.imported.run import HOLD, Runner, Window

if TYPE_CHECKING:
    from irj_fmu.imported.model import UserModel

BANDWIDTH: Final = 60.0
"""Of the controller [rad/s], or a quarter of the sample rate where that is lower; its damping
ratio is 1.
"""
_SETTLE: Final = 10.0
"""Time constants of the controller that are left out at the start of each stretch."""


@final
class Tracker:
    """The position controller (see :class:`irj_fmu.imported.run.Feedback`); keeps what it added.

    Parameters
    ----------
    port : Port
    inputs : int
        Number of inputs.
    inertia : float
        Input per acceleration of the output, in the units of the FMU.
    law : CorrectionLaw, optional
        A correction that rides along.
    """

    def __init__(
        self, port: Port, inputs: int, inertia: float, law: CorrectionLaw | None = None
    ) -> None:
        self.port, self.inertia, self.law = port, inertia, law
        self.hold = HOLD if law is None else law.hold
        self._extra = np.zeros(inputs)
        self.added: FloatArray = np.empty(0)

    def begin(self, window: Window) -> None:
        """Before the first sample of a window."""
        q = window.outputs[:, self.port.output]
        self._dt = float(np.median(np.diff(window.time)))
        self._q, self._v = q, smooth_slope(q, self._dt)
        bandwidth = min(BANDWIDTH, 0.25 / self._dt)
        self._stiff, self._damp = Controller(bandwidth, damping=1.0).gains(self.inertia)
        self.added = np.zeros(len(q))
        self._last = -1
        self._before = float(q[0]) - self._dt * float(self._v[0])
        if self.law is not None:
            self.law.begin(window)

    def __call__(
        self, sample: int, time: float, inputs: FloatArray, outputs: FloatArray
    ) -> FloatArray:
        """What is added to the inputs from a time on; the controller moves at samples only."""
        if sample != self._last:
            position = float(outputs[self.port.output])
            speed = (position - self._before) / self._dt
            self._before, self._last = position, sample
            self.added[sample] = self._stiff * (self._q[sample] - position) + self._damp * (
                self._v[sample] - speed
            )
        self._extra[:] = 0.0 if self.law is None else self.law(sample, time, inputs, outputs)
        self._extra[self.port.input] += self.added[sample]
        return self._extra


def smooth_slope(values: FloatArray, dt: float, length: float = 0.03) -> FloatArray:
    """Derivative of a measured signal, of the same length."""
    weights = kernel(max(length, 8 * dt), dt, 1)
    half = min(len(weights) // 2, len(values) - 1)
    middle = len(weights) // 2
    padded = np.pad(values, half, mode="reflect", reflect_type="odd")
    found: FloatArray = np.correlate(padded, weights[middle - half : middle + half + 1], "valid")
    return found


@final
class Following:
    """An FMU that follows measured motions.

    Parameters
    ----------
    model : UserModel
        With a window of None.
    first : Window
        Of the first record: the inertia is taken from its start.

    Attributes
    ----------
    inertia : float
        Link-referred torque per link-referred acceleration of the position [kg.m2].

    Raises
    ------
    InputError
        Where no drive or no position is mapped, or the drive moves nothing.
    """

    def __init__(self, model: UserModel, first: Window) -> None:
        self.model, self.port = model, port_of(model)
        self.values = {p.name: p.value for p in model.parameters}
        self.runner = model.runner()
        self.runner.choose_substeps(first, self.values)
        self._inertia = inertia_of(self.runner, first, self.values, self.port)
        self.inertia = self._inertia * self.port.torque / self.port.position

    def record(self, record: Record, values: Mapping[str, float] | None = None) -> Record:
        """A record with the position as measured, and as torque on the motor shaft what the FMU
        leaves for acceleration.

        Parameters
        ----------
        record : Record
        values : mapping, optional
            Parameters of the FMU and of what rides outside it, in place of the model's.

        Raises
        ------
        InputError
            Where the record is too short.
        """
        model, given = self.model, values or {}
        own = {**self.values, **{k: v for k, v in given.items() if k in self.values}}
        law = feedback_of(model, {**model.values, **given})
        tracker = Tracker(self.port, len(model.inputs), self._inertia, law)
        parts = [(w, *_left(self.runner, w, own, tracker)) for w in model.windows([record])]
        return _joined(record, model, self.port, parts)


def _left(
    runner: Runner, window: Window, values: Mapping[str, float], tracker: Tracker
) -> tuple[FloatArray, slice]:
    """u - f at the samples of a slice, in the units of the FMU's input."""
    path = runner.run(window, values, feedback=tracker)[:, tracker.port.output]
    dt = float(np.median(np.diff(window.time)))
    skip = 1 + round(_SETTLE / min(BANDWIDTH, 0.25 / dt) / dt)
    curve = (path[2:] - 2 * path[1:-1] + path[:-2]) / dt**2
    held = (tracker.added[1:-1] + tracker.added[:-2]) / 2
    left = tracker.inertia * curve - held
    return left[skip - 1 :], slice(skip, len(path) - 1)


def _joined(
    record: Record, model: UserModel, port: Port, parts: Sequence[tuple[Window, FloatArray, slice]]
) -> Record:
    place = model.outputs[port.output]
    parts = [p for p in parts if len(p[1]) > 8]
    if not parts:
        raise InputError(f"{record.name}: too short to follow; give a longer record")
    torque = np.concatenate([left for _, left, _ in parts]) * port.torque / model.joint.gear_ratio
    position = np.concatenate([w.outputs[rows, port.output] for w, _, rows in parts]) / place.scale
    time = np.concatenate([w.time[rows] for w, _, rows in parts])
    run = np.concatenate([np.full(len(left), float(i)) for i, (_, left, _) in enumerate(parts)])
    made = Record.from_channels(
        time,
        {"motor_torque": torque, place.channel: position, "run": run},
        name=record.name,
        kind=record.kind,
    )
    return made.without("run")


__all__ = ["BANDWIDTH", "Following", "Tracker", "smooth_slope"]
