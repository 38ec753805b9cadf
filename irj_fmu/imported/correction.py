"""An effect of the library that rides outside a user's FMU as a correction of its torque input."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, final

import numpy as np

from casadi_models import JointModel
from casadi_models.term import TOTAL_INERTIA
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.run import Window

PREFIX: Final = "correction."
"""Before the names of a correction's parameters, so that they never meet those of the FMU."""
SHAPE_RANGE: Final = 3.0


@final
@dataclass(frozen=True)
class Port:
    """Where a torque acts on an FMU, and where its position is read.

    Attributes
    ----------
    input, output : int
        Columns of the model's inputs and outputs.
    torque : float
        Link-referred torque per unit of the input.
    position : float
        Link-referred position per unit of the output.
    velocity : int or None
        Column of a velocity of the same side.
    rate : float
        Link-referred velocity per unit of that column.
    """

    input: int
    output: int
    torque: float
    position: float
    velocity: int | None = None
    rate: float = 1.0


@final
@dataclass(frozen=True)
class Correction:
    """Effects of the library outside an FMU.

    Attributes
    ----------
    model : JointModel
        Rigid, with an inertia of 1; its effects are those that are added.
    free : tuple of str
        Parameters of `model` that a fit may move.
    shapes : mapping of str to float
        Of the free ones, shape parameters and their first values.
    """

    model: JointModel
    free: tuple[str, ...]
    shapes: Mapping[str, float] = field(default_factory=dict)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the effects."""
        return self.model.effects

    def free_values(self) -> dict[str, float]:
        """Values of the free parameters under their outside names."""
        values = dict(zip(self.model.parameter_names, self.model.value_vector(), strict=True))
        return {PREFIX + n: values[n] for n in self.free}

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Bounds of the free parameters under their outside names; a shape stays near the value
        of its trial.
        """
        found = {}
        for p in self.model.parameters:
            if p.name in self.free:
                near = self.shapes.get(p.name)
                low, high = (
                    (p.low, p.high)
                    if near is None
                    else (max(p.low, near / SHAPE_RANGE), min(p.high, near * SHAPE_RANGE))
                )
                found[PREFIX + p.name] = (low, high)
        return found

    def unit(self, name: str) -> str:
        """Unit of a parameter under its outside name."""
        return {PREFIX + p.name: p.unit for p in self.model.parameters}[name]

    def with_values(self, values: Mapping[str, float]) -> Correction:
        """The correction with other values, by outside name; others are passed over."""
        own = {n: float(values[PREFIX + n]) for n in self.free if PREFIX + n in values}
        return replace(self, model=self.model.with_values(own))


def correction_of(
    model: JointModel, labels: tuple[str, ...], values: Mapping[str, float], free: tuple[str, ...]
) -> Correction:
    """A correction from a rigid joint model: the named effects alone, the joint's own inertia
    and laws left to the FMU.
    """
    terms = tuple(t for t in model.terms if t.label in labels)
    bare = JointModel(
        gear_ratio=model.gear_ratio,
        terms=terms,
        inertias=TOTAL_INERTIA,
        kind=model.kind,
        load_from="gravity",
        clamped_link=False,
        name="correction",
    )
    known = set(bare.parameter_names)
    made = bare.with_values(
        {
            **{k: float(v) for k, v in values.items() if k in known},
            **dict.fromkeys(TOTAL_INERTIA, 1.0),
        }
    )
    shapes = {
        p.name: float(values[p.name])
        for p in bare.parameters
        if p.is_shape and p.name in free and float(values[p.name]) > 0
    }
    return Correction(made, free, shapes)


@final
class CorrectionLaw:
    """The torque of a correction along a run (see :class:`irj_fmu.imported.run.Feedback`).

    The effect resists: its torque is taken off the drive. It is read and held for a millisecond at
    a time, at the position and velocity that are predicted for the middle of that time: read at its
    beginning, it would be late by half of it.

    Parameters
    ----------
    model : JointModel
        As in :class:`Correction`.
    port : Port
    inputs : int
        Number of inputs.
    """

    def __init__(self, model: JointModel, port: Port, inputs: int) -> None:
        import casadi as ca

        functions = model.functions
        self._held = len(functions.memory_names)
        p = model.value_vector()
        x, u = ca.SX.sym("x", 2 + self._held), ca.SX.sym("u", 3)
        self._resist = Evaluator(
            ca.Function("resist", [x, u], [ca.densify(u[0] - functions.dynamics(x, u, p)[1])])
        )
        self._move: Evaluator | None = None
        if self._held:
            before, z, h = ca.SX.sym("before", 2), ca.SX.sym("z", self._held), ca.SX.sym("h")
            moved = functions.memory_step(x[:2], before, z, u, p, h)
            self._move = Evaluator(
                ca.Function("move", [x[:2], before, z, u, h], [ca.densify(moved)])
            )
        self.port = port
        self._extra = np.zeros(inputs)
        self.restart()

    def begin(self, window: Window) -> None:
        """Before the first sample of a window."""
        self.restart()

    def restart(self) -> None:
        """From rest, with empty memory."""
        self._z = np.zeros(self._held)
        self._place = self._now = math.nan
        self._rate = self._step = self._given = 0.0
        self._before = self._speed = math.nan

    def __call__(
        self, sample: int, time: float, inputs: FloatArray, outputs: FloatArray
    ) -> FloatArray:
        """What is added to the inputs from a time on."""
        port = self.port
        speed = None if port.velocity is None else float(outputs[port.velocity]) * port.rate
        drive = float(inputs[port.input]) * port.torque
        self._extra[port.input] = (
            self.torque(time, drive, float(outputs[port.output]) * port.position, speed)
            / port.torque
        )
        return self._extra

    def torque(
        self, time: float, drive: float, position: float, velocity: float | None = None
    ) -> float:
        """Torque to be added to the drive, link-referred [N.m].

        Parameters
        ----------
        time : float
            [s]
        drive : float
            Torque of the drive, link-referred [N.m].
        position, velocity : float
            Link-referred [rad, rad/s]; without a velocity the difference of positions is taken.
        """
        first = math.isnan(self._now)
        step = 0.0 if first else time - self._now
        lead = step / 2
        owed = 0.0
        if velocity is None:  # the difference is the velocity half a step ago
            velocity = 0.0 if step <= 0 else (position - self._place) / step
            lead = step
            if step > 0 and self._step == 0 and self._move is None:
                # at the first sample no velocity was known: what that step lacked follows now
                half = ((position + self._place) / 2, velocity)
                owed = -float(self._resist(half, (drive, 0.0, time))[0]) - self._given
        known = step > 0 and self._step > 0
        bend = (velocity - self._rate) / step if known else 0.0
        ahead = velocity + bend * lead
        middle = position + step / 2 * (velocity + bend * (lead - step / 4))
        u = (drive, 0.0, time)
        if self._move is not None and not math.isnan(self._before) and step > 0:
            self._z = self._move(
                (middle, ahead), (self._before, self._speed), self._z, u, (step,)
            ).copy()
        self._place, self._rate, self._now, self._step = position, velocity, time, step
        self._before, self._speed = middle, ahead
        self._given = -float(self._resist((middle, ahead, *self._z), u)[0])
        return self._given + owed


@final
class Evaluator:
    """A CasADi function of small dense vectors without conversions: about 2 microseconds a call."""

    def __init__(self, function: Any) -> None:
        self._function = function  # keeps the buffer alive
        self._arguments = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        self._result = np.zeros(function.numel_out(0))
        self._buffer, self._trigger = function.buffer()
        for i, argument in enumerate(self._arguments):
            self._buffer.set_arg(i, argument.data)
        self._buffer.set_res(0, self._result.data)

    def __call__(self, *values: Any) -> FloatArray:
        """The result; its array is reused."""
        for argument, value in zip(self._arguments, values, strict=True):
            argument[:] = value
        self._trigger()
        return self._result


__all__ = ["PREFIX", "Correction", "CorrectionLaw", "Port", "correction_of"]
