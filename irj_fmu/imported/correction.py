"""An effect of the library that rides outside a user's FMU as a correction of its torque input."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, final

import numpy as np

from casadi_models import JointModel
from casadi_models.term import TOTAL_INERTIA
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.run import HOLD, Window

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
        of its trial; a smoothing velocity, which no trial has looked for, as far from its first
        value as its grid reaches from its start.
        """
        found = {}
        for p in self.model.parameters:
            if p.name in self.free:
                low, high = p.low, p.high
                near = self.shapes.get(p.name)
                if near is not None:
                    reach = (1 / SHAPE_RANGE, SHAPE_RANGE)
                    if p.role == "smoothing":
                        reach = min(p.grid) / p.start, max(p.grid) / p.start
                    low, high = max(low, near * reach[0]), min(high, near * reach[1])
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
    model: JointModel, labels: tuple[str, ...], values: Mapping[str, float]
) -> Correction:
    """A correction from a rigid joint model: the named effects alone, the joint's own inertia
    and laws left to the FMU.

    Free are the parameters of the effects, and the smoothing velocity of a side where one of them
    changes its sign there: every other parameter would make up for a wrong one.
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
    turning = {t.place for t in terms if "direction" in t.effect.reads}
    smooth = [n for place in sorted(turning) for n in bare.named("smoothing", place)]
    free = (*(n for t in terms for n in t.names), *smooth)
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


_SEEN, _NOW, _PLACE, _RATE, _STEP, _BEFORE, _SPEED, _GIVEN, _MEMORY = range(9)
"""What a law keeps between two calls: whether there was one, its time, position, velocity and step,
the predicted middle it was read at, the torque it gave; then the memory of its effects.
"""


def law_function(model: JointModel, *, has_velocity: bool) -> Any:
    """The torque of a correction as a CasADi function, for Python and for generated C.

    The effect resists: its torque is taken off the drive. It is read and held from one call to the
    next, at the position and velocity that are predicted for the middle of that time: read at its
    beginning, it would be late by half of it. Without a velocity the difference of positions is
    taken.

    Parameters
    ----------
    model : JointModel
        As in :class:`Correction`.
    has_velocity : bool

    Returns
    -------
    casadi.Function
        ``(state, reading, parameters) -> (torque, state)`` as one column: the torque to be added to
        the drive [N.m] and the next state. The reading is time [s], torque of the drive [N.m],
        position [rad] and velocity [rad/s], link-referred. The state begins with zeros.
    """
    import casadi as ca

    functions = model.functions
    held = len(functions.memory_names)
    s, reading = ca.SX.sym("s", _MEMORY + held), ca.SX.sym("reading", 4)
    p = ca.SX.sym("p", len(model.parameters))
    time, drive, position, velocity = ca.vertsplit(reading)
    seen, z, u = s[_SEEN], s[_MEMORY:], ca.vertcat(drive, 0, time)

    def resist(x: Any) -> Any:
        return drive - functions.dynamics(x, u, p)[1]

    step = ca.if_else(seen, time - s[_NOW], 0)
    moved = step > 0
    length = ca.if_else(moved, step, 1)
    lead, owed = step / 2, 0
    if not has_velocity:  # the difference is the velocity half a step ago
        velocity = ca.if_else(moved, (position - s[_PLACE]) / length, 0)
        lead = step
        if not held:
            # at the first sample no velocity was known: what that step lacked follows now
            half = ca.vertcat((position + s[_PLACE]) / 2, velocity)
            owed = ca.if_else(ca.logic_and(moved, s[_STEP] == 0), -resist(half) - s[_GIVEN], 0)
    bend = ca.if_else(ca.logic_and(moved, s[_STEP] > 0), (velocity - s[_RATE]) / length, 0)
    ahead = velocity + bend * lead
    middle = position + step / 2 * (velocity + bend * (lead - step / 4))
    if held:
        before = ca.vertcat(s[_BEFORE], s[_SPEED])
        after = functions.memory_step(ca.vertcat(middle, ahead), before, z, u, p, step)
        z = ca.if_else(moved, after, z)
    given = -resist(ca.vertcat(middle, ahead, z))
    new = ca.vertcat(*(1, time, position, velocity, step, middle, ahead, given), z)
    return ca.Function("law", [s, reading, p], [ca.densify(ca.vertcat(given + owed, new))])


def steepest(
    model: JointModel, drive: FloatArray, position: FloatArray, velocity: FloatArray
) -> float:
    """Largest slope of a correction's torque over velocity, in size [N.m.s/rad].

    Parameters
    ----------
    model : JointModel
        As in :class:`Correction`.
    drive, position, velocity : (n,) arrays
        Where it is looked for, link-referred [N.m, rad, rad/s].
    """
    import casadi as ca

    functions = model.functions
    held = len(functions.memory_names)
    x, drives = ca.SX.sym("x", 2 + held), ca.SX.sym("drive")
    p = ca.DM(model.value_vector())
    torque = drives - functions.dynamics(x, ca.vertcat(drives, 0, 0), p)[1]
    slope = ca.Function("slope", [x, drives], [ca.densify(ca.jacobian(torque, x)[:, 1])])
    states = np.vstack([position, velocity, np.zeros((held, len(velocity)))])
    found = np.asarray(slope.map(len(velocity))(states, drive[None, :]))
    return float(np.max(np.abs(found), initial=0.0, where=np.isfinite(found)))


@final
class CorrectionLaw:
    """The torque of a correction along a run (see :class:`irj_fmu.imported.run.Feedback`), as
    :func:`law_function` has it, read a millisecond at a time.

    Parameters
    ----------
    model : JointModel
        As in :class:`Correction`.
    port : Port
    inputs : int
        Number of inputs.
    hold : float
        Longest time for which the torque may hold [s].
    """

    def __init__(self, model: JointModel, port: Port, inputs: int, hold: float = HOLD) -> None:
        self._model, self.port, self.hold = model, port, hold
        self._laws: dict[bool, Evaluator] = {}
        self._extra = np.zeros(inputs)
        self._state = np.zeros(_MEMORY + len(model.functions.memory_names))

    def _law(self, has_velocity: bool) -> Evaluator:
        found = self._laws.get(has_velocity)
        if found is None:
            import casadi as ca

            law = law_function(self._model, has_velocity=has_velocity)
            s, reading = ca.SX.sym("s", law.numel_in(0)), ca.SX.sym("reading", 4)
            valued = law(s, reading, self._model.value_vector())
            found = self._laws[has_velocity] = Evaluator(ca.Function("law", [s, reading], [valued]))
        return found

    def begin(self, window: Window) -> None:
        """Before the first sample of a window."""
        self.restart()

    def restart(self) -> None:
        """From rest, with empty memory."""
        self._state[:] = 0.0

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
        law = self._law(velocity is not None)
        found = law(self._state, (time, drive, position, velocity or 0.0))
        self._state[:] = found[1:]
        return float(found[0])


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


__all__ = [
    "PREFIX",
    "Correction",
    "CorrectionLaw",
    "Port",
    "correction_of",
    "law_function",
    "steepest",
]
