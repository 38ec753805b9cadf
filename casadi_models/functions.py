"""CasADi functions that follow from a joint model: dynamics, regressor, Jacobian, energy, one step."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from .joint import MEMORY_STEP, Equations, JointModel, Term, inverse_dynamics
from .signals import Expression, Signals

INPUTS: Final = ("drive", "temperature", "time")
"""Inputs of the dynamics: n Km I [N.m], temperature [K], time [s]."""

FloatArray = npt.NDArray[np.float64]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_PANELS: Final = 8


@final
class JointFunctions:
    """Functions of one joint model; each is built when it is first used.

    States x: (q_m, v_m, q_l, v_l, memory...) for an elastic joint, (q, v, memory...) for a rigid
    one; all link-referred. Inputs u: :data:`INPUTS`. Parameters p in the order of
    ``model.parameter_names``.
    """

    def __init__(self, model: JointModel) -> None:
        self._model = model
        self._equations: Equations = model.equations
        mechanical = ("motor_position", "motor_velocity", "link_position", "link_velocity")
        self.state_names: tuple[str, ...] = mechanical if model.is_elastic else ("position", "velocity")
        self.memory_names: tuple[str, ...] = tuple(str(z) for z in ca.vertsplit(self._equations.memory))

    @cached_property
    def _symbols(self) -> tuple[Expression, Expression, Expression, Expression]:
        e = self._equations
        x = ca.SX.sym("x", len(self.state_names))
        u = ca.SX.sym("u", len(INPUTS))
        return x, e.memory, u, e.parameters

    def _substituted(self, *expressions: Expression) -> list[Expression]:
        """Expressions of the signals as expressions of (x, memory, u, p), without accelerations."""
        x, _, u, _ = self._symbols
        s = self._equations.signals
        link = (x[2], x[3]) if self._model.is_elastic else (x[0], x[1])
        old = [
            s.motor_position, s.motor_velocity, s.link_position, s.link_velocity, s.drive, s.temperature, s.time,
            s.drive_rate, s.torque_rate, s.motor_jerk, s.link_jerk,
        ]  # fmt: skip
        new = [x[0], x[1], *link, u[0], u[1], u[2], *[ca.SX(0)] * 4]
        return list(ca.substitute(list(expressions), old, new))

    @cached_property
    def _accelerations(self) -> tuple[Expression, ...]:
        """(motor, link) accelerations of an elastic joint or the one acceleration of a rigid one."""
        e, model = self._equations, self._model
        s = e.signals
        if model.is_elastic:
            transmitted = e.transmitted
            motor = e.drive - e.motor_resistance - transmitted * e.motor_lever
            link = transmitted * e.link_lever - e.link_resistance
            if model.load_from == "torque":
                motor, link = ca.substitute([motor, link], [s.torque], [transmitted])
            motor, link = self._substituted(motor, link)
            motor = self._solve(motor, s.motor_acceleration, e.inertia["motor_inertia"])
            link = self._solve(link, s.link_acceleration, e.inertia["link_inertia"])
            return motor, link
        resist = e.motor_resistance + e.link_resistance
        inertia: Expression = sum(e.inertia.values())
        (right,) = ca.substitute([e.drive - resist], [s.link_acceleration], [s.motor_acceleration])
        (right,) = self._substituted(right)
        (right,) = ca.substitute([right], [s.torque], [ca.SX(0)])
        return (self._solve(right, s.motor_acceleration, inertia),)

    @staticmethod
    def _solve(right: Expression, acceleration: Expression, inertia: Expression) -> Expression:
        """Acceleration from inertia * a = right(a), where right is affine in a."""
        slope = ca.jacobian(right, acceleration)
        (free,) = ca.substitute([right], [acceleration], [ca.SX(0)])
        return free / (inertia - slope)

    def _mechanical_rates(self) -> Expression:
        x = self._symbols[0]
        a = self._accelerations
        return ca.vertcat(x[1], a[0], x[3], a[1]) if self._model.is_elastic else ca.vertcat(x[1], a[0])

    @cached_property
    def _memory_coordinates(self) -> list[Expression]:
        found = self._substituted(*(t[1] for t in self._equations.memory_terms))
        return list(found)

    def _moved_memory(self, steps: list[Expression]) -> Expression:
        """All internal states after their coordinates have moved by `steps`."""
        out: list[Expression] = []
        for (term, _, z, view, values), step in zip(self._equations.memory_terms, steps, strict=True):
            if term.effect.memory is not None:
                out.extend(term.effect.memory(z, step, view, values))
        if not out:
            return ca.SX(0, 1)
        return ca.vertcat(*self._substituted(*out))

    @cached_property
    def rates(self) -> Expression:
        """Symbolic dx/dt, memory included."""
        x, z, _, _ = self._symbols
        mechanical = self._mechanical_rates()
        if not self._equations.memory_terms:
            return mechanical
        speeds = [ca.jtimes(c, x, mechanical) * MEMORY_STEP for c in self._memory_coordinates]
        return ca.vertcat(mechanical, (self._moved_memory(speeds) - z) / MEMORY_STEP)

    @cached_property
    def dynamics(self) -> Any:
        """(x, u, p) -> dx/dt."""
        x, z, u, p = self._symbols
        return ca.Function("dynamics", [ca.vertcat(x, z), u, p], [self.rates], ["x", "u", "p"], ["dx"])

    @cached_property
    def jacobian(self) -> Any:
        """(x, u, p) -> Jacobians of dx/dt with respect to x, u and p."""
        x, z, u, p = self._symbols
        full = ca.vertcat(x, z)
        out = [ca.jacobian(self.rates, v) for v in (full, u, p)]
        return ca.Function("jacobian", [full, u, p], out, ["x", "u", "p"], ["dx_x", "dx_u", "dx_p"])

    @cached_property
    def step(self) -> Any:
        """(x, u, p, h) -> x after one Runge-Kutta step of 4th order; memory moves with its coordinate."""
        x, z, u, p = self._symbols
        h = ca.SX.sym("h")
        rate = ca.Function("rate", [x, z, u, p], [self._mechanical_rates()])
        where = ca.Function("where", [x, p], self._memory_coordinates or [ca.SX(0)])

        def coordinates(at: Expression) -> list[Expression]:
            found = where(at, p)
            return list(found) if isinstance(found, tuple | list) else [found]

        def stage(at: Expression) -> Expression:
            if not self._equations.memory_terms:
                return rate(at, z, u, p)
            moved = [b - a for a, b in zip(coordinates(x), coordinates(at), strict=True)]
            return rate(at, self._moved_memory(moved), u, p)

        k1 = stage(x)
        k2 = stage(x + h / 2 * k1)
        k3 = stage(x + h / 2 * k2)
        k4 = stage(x + h * k3)
        new = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if self._equations.memory_terms:
            moved = [b - a for a, b in zip(coordinates(x), coordinates(new), strict=True)]
            new = ca.vertcat(new, self._moved_memory(moved))
        return ca.Function("step", [ca.vertcat(x, z), u, p, h], [new], ["x", "u", "p", "h"], ["x_next"])

    @cached_property
    def outputs(self) -> Any:
        """(x, u, p) -> readings (motor position, velocity, link position, velocity, torque), sensor errors included."""
        x, z, u, p = self._symbols
        e, s = self._equations, self._equations.signals
        torque = e.transmitted if self._model.is_elastic else e.link_resistance
        (true_torque,) = self._substituted(torque)
        motor = (x[0], x[1])
        link = (x[2], x[3]) if self._model.is_elastic else motor
        accelerations = self._accelerations
        accelerations = accelerations if len(accelerations) == 2 else (accelerations[0],) * 2
        if not self._model.is_elastic:
            inertia = e.inertia.get("link_inertia", ca.SX(0))
            true_torque = true_torque + inertia * accelerations[0]
        torque_rate = ca.jtimes(true_torque, x, self._mechanical_rates())
        rows = [
            self._reading("motor_position_sensor", motor[0], motor[1]),
            self._reading("motor_position_sensor", motor[1], accelerations[0], offset=False),
            self._reading("link_position_sensor", link[0], link[1]),
            self._reading("link_position_sensor", link[1], accelerations[1], offset=False),
            self._reading("torque_sensor", true_torque, torque_rate),
        ]
        out = ca.vertcat(*rows)
        (out,) = ca.substitute([out], [s.motor_acceleration, s.link_acceleration], [ca.SX(0), ca.SX(0)])
        return ca.Function("outputs", [ca.vertcat(x, z), u, p], [out], ["x", "u", "p"], ["y"])

    def _reading(self, place: str, true: Expression, rate: Expression, *, offset: bool = True) -> Expression:
        """Reading from the true value: the affine law of the sensor turned round."""
        s = self._equations.signals
        corrected = {
            "motor_position_sensor": (s.motor_position, s.motor_velocity),
            "link_position_sensor": (s.link_position, s.link_velocity),
            "torque_sensor": (s.torque, s.torque_rate),
        }[place]
        found = self._corrected(place)
        gain, lag = ca.jacobian(found, corrected[0]), ca.jacobian(found, corrected[1])
        (zero,) = ca.substitute([found], list(corrected), [ca.SX(0), ca.SX(0)])
        return (true - (zero if offset else 0) - lag * rate / gain) / gain

    def _corrected(self, place: str) -> Expression:
        e, s = self._equations, self._equations.signals
        if place == "torque_sensor":
            return e.torque
        return e.true_motor_position if place == "motor_position_sensor" else e.true_link_position

    @cached_property
    def regressor(self) -> Any:
        """(x, a, u, p) -> (Y, rest): Y theta_linear + rest = inverse dynamics (drive, 0).

        x as in :attr:`dynamics` (memory included), a the accelerations, one per degree of freedom.
        """
        x, z, u, p = self._symbols
        s = self._equations.signals
        degrees = 2 if self._model.is_elastic else 1
        a = ca.SX.sym("a", degrees)
        right = inverse_dynamics(self._model)
        if self._model.is_elastic and self._model.load_from == "torque":
            (right,) = ca.substitute([right], [s.torque], [self._equations.transmitted])
        (right,) = ca.substitute([right], [s.motor_acceleration, s.link_acceleration], [a[0], a[degrees - 1]])
        (right,) = self._substituted(right)
        names = self._model.parameter_names
        linear = [names.index(n) for n in self._model.linear_parameters]
        matrix = ca.jacobian(right, p)[:, linear]
        (rest,) = ca.substitute([right], [ca.vertcat(*(p[i] for i in linear))], [ca.SX.zeros(len(linear), 1)])
        full = ca.vertcat(x, z)
        return ca.Function("regressor", [full, a, u, p], [ca.densify(matrix), ca.densify(rest)], ["x", "a", "u", "p"], ["Y", "rest"])

    @cached_property
    def energy(self) -> Any:
        """(x, p) -> kinetic energy plus the potential of springs and position-dependent torques [J]."""
        x, z, _, p = self._symbols
        e, model = self._equations, self._model
        link = x[2] if model.is_elastic else x[0]
        torques = self._part(tuple(t for t in model.terms if t.effect.family == "torque"))
        total = self._work(torques, torques.motor_resistance, x[0], "motor_position")
        total = total + self._work(torques, torques.link_resistance, link, "link_position")
        speeds = [x[1], x[3]] if model.is_elastic else [x[1]] * 2
        if model.is_elastic:
            springs = self._part(tuple(t for t in model.terms if t.place == "transmission" and not t.effect.dissipative))
            (angle,) = self._substituted(e.torsion)
            total = total + self._work(springs, springs.transmitted, angle, "motor_position")
        shares = list(e.inertia.values())
        for inertia, speed in zip(shares, speeds, strict=False):
            total = total + inertia * speed**2 / 2
        return ca.Function("energy", [ca.vertcat(x, z), p], [total], ["x", "p"], ["E"])

    def _part(self, terms: tuple[Term, ...]) -> Equations:
        """Equations of the same joint with some of its terms only."""
        return replace(self._model, terms=terms, values={}).equations

    def _work(self, part: Equations, torque: Expression, upto: Expression, coordinate: str) -> Expression:
        """Integral of a torque along its coordinate from 0 (Gauss-Legendre panels), all other signals zero."""
        names = [str(v) for v in ca.vertsplit(part.parameters)]
        here = ca.vertcat(*(self._equations.parameters[self._model.parameter_names.index(n)] for n in names))
        others = [getattr(part.signals, n) for n in Signals.names() if n != coordinate]
        law = ca.substitute([torque], [part.parameters, *others], [here, *[ca.SX(0)] * len(others)])[0]
        total: Expression = ca.SX(0)
        for panel in range(_PANELS):
            for node, weight in zip(_NODES, _WEIGHTS, strict=True):
                share = (panel + (node + 1) / 2) / _PANELS
                value = ca.substitute([law], [getattr(part.signals, coordinate)], [upto * share])[0]
                total = total + weight / 2 / _PANELS * value
        return total * upto

    def linearize(self, x: FloatArray | None = None, u: FloatArray | None = None) -> Any:
        """control.StateSpace of the joint about (x, u): input drive [N.m], outputs the mechanical states."""
        import control

        size = len(self.state_names) + len(self.memory_names)
        at = np.zeros(size) if x is None else np.asarray(x, dtype=float)
        inputs = np.zeros(len(INPUTS)) if u is None else np.asarray(u, dtype=float)
        a, b, _ = (np.array(m) for m in self.jacobian(at, inputs, self._model.value_vector()))
        outputs = len(self.state_names)
        return control.ss(
            a, b[:, :1], np.eye(outputs, size), np.zeros((outputs, 1)), name=self._model.name or "joint",
            states=[*self.state_names, *self.memory_names], inputs=["drive"],
            outputs=[f"{n}_y" for n in self.state_names],
        )  # fmt: skip
