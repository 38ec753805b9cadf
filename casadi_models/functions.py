"""CasADi functions that follow from a joint model: dynamics, regressor, Jacobian, energy, one
step.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from .energy import total_energy
from .equations import Equations, Solvable, inverse_dynamics
from .signals import Expression
from .solve import affine_solution, carried_rate, carried_torque, rigid_solution, runge_kutta

MEMORY_STEP: Final = 1e-6
"""Time over which a memory without a rate of its own is differentiated to its continuous form
[s].
"""

INPUTS: Final = ("drive", "temperature", "time")
"""Inputs of the dynamics: n Km I [N.m], temperature [K], time [s]."""

FloatArray = npt.NDArray[np.float64]
_GONE: Final = ("drive_rate", "torque_rate", "motor_jerk", "link_jerk", "coupling_torque")
"""Signals that are no input: rates, and the torque on the link from elsewhere, which a
simulated joint does not feel.
"""


@final
class JointFunctions:
    """Functions of one joint model; each is built when it is first used.

    States x: (q_m, v_m, q_l, v_l, memory...) for an elastic joint, (q, v, memory...) for a rigid
    one; all link-referred. Inputs u: :data:`INPUTS`. Parameters p in the order of
    ``model.parameter_names``. States are true values; what the sensors add appears in
    :attr:`outputs` only.

    Parameters
    ----------
    model : Solvable
    open_to_disturbances : bool
        True: :attr:`disturbed` has torques beyond the model's laws as inputs; elsewhere these are
        zero and cost nothing.
    """

    def __init__(self, model: Solvable, *, open_to_disturbances: bool = False) -> None:
        self._model = model
        self._equations: Equations = model.true_equations
        self._beyond = ca.SX.sym("d", 2) if open_to_disturbances else ca.SX.zeros(2, 1)
        if open_to_disturbances:
            passed_on = self._equations.transmitted + self._beyond[0]
            self._equations = replace(self._equations, transmitted=passed_on)
        mechanical = ("motor_position", "motor_velocity", "link_position", "link_velocity")
        self.state_names: tuple[str, ...] = (
            mechanical if model.is_elastic else ("position", "velocity")
        )
        self.memory_names: tuple[str, ...] = tuple(
            str(z) for z in ca.vertsplit(self._equations.memory)
        )

    # --- accelerations and torque -----------------------------------------------------------------

    @cached_property
    def _symbols(self) -> tuple[Expression, Expression, Expression, Expression]:
        e = self._equations
        x = ca.SX.sym("x", len(self.state_names))
        u = ca.SX.sym("u", len(INPUTS))
        return x, e.memory, u, e.parameters

    def _substituted(self, *expressions: Expression) -> list[Expression]:
        """Expressions of the signals as expressions of (x, memory, u, p), accelerations and
        torque left.
        """
        x, _, u, _ = self._symbols
        s = self._equations.signals
        link = (x[2], x[3]) if self._model.is_elastic else (x[0], x[1])
        old = [
            s.motor_position,
            s.motor_velocity,
            s.link_position,
            s.link_velocity,
            s.drive,
            s.temperature,
            s.time,
        ]
        new = [x[0], x[1], *link, u[0], u[1], u[2]]
        old += [getattr(s, name) for name in _GONE]
        new += [ca.SX(0)] * len(_GONE)
        return list(ca.substitute(list(expressions), old, new))

    @cached_property
    def _solution(self) -> tuple[tuple[Expression, ...], Expression]:
        """Accelerations (motor and link, or the one of a rigid joint) and the torque into the
        link.
        """
        e = self._equations
        s = e.signals
        if self._model.is_elastic:
            torque = carried_torque(e)
            motor = e.drive - e.motor_resistance - torque * e.motor_lever
            link = torque * e.link_lever - e.link_resistance + self._beyond[1]
            motor, link = ca.substitute([motor, link], [s.torque], [torque])
            motor, link, torque = self._substituted(motor, link, torque)
            motor = affine_solution(motor, s.motor_acceleration, e.inertia["motor_inertia"])
            link = affine_solution(link, s.link_acceleration, e.inertia["link_inertia"])
            return (motor, link), torque
        one = [s.link_acceleration], [s.motor_acceleration]
        share = e.inertia.get("link_inertia", ca.SX(0))
        right, carried = ca.substitute(
            [
                e.drive - e.motor_resistance - e.link_resistance + self._beyond[1],
                share * s.link_acceleration + e.link_resistance - self._beyond[1],
            ],
            *one,
        )
        right, carried = self._substituted(right, carried)
        inertia: Expression = sum(e.inertia.values())
        acceleration, torque = rigid_solution(
            right, carried, inertia, s.motor_acceleration, s.torque
        )
        return (acceleration,), torque

    def _resolved(self, *expressions: Expression) -> list[Expression]:
        """Expressions of the signals as expressions of (x, memory, u, p) alone."""
        s = self._equations.signals
        accelerations, torque = self._solution
        old = [s.motor_acceleration, s.link_acceleration, s.torque]
        return list(
            ca.substitute(
                self._substituted(*expressions), old, [*self._both(accelerations), torque]
            )
        )

    @staticmethod
    def _both(pair: tuple[Expression, ...]) -> tuple[Expression, Expression]:
        return pair[0], pair[-1]

    def _mechanical_rates(self) -> Expression:
        x = self._symbols[0]
        a = self._solution[0]
        return (
            ca.vertcat(x[1], a[0], x[3], a[1]) if self._model.is_elastic else ca.vertcat(x[1], a[0])
        )

    # --- internal states --------------------------------------------------------------------------

    @cached_property
    def _memory_coordinates(self) -> list[Expression]:
        return self._resolved(*(t[1] for t in self._equations.memory_terms))

    def _moved_memory(self, steps: list[Expression], duration: Expression) -> Expression:
        """All internal states after their coordinates have moved by `steps` in the time
        `duration`.
        """
        out: list[Expression] = []
        for (term, _, z, view, values), step in zip(
            self._equations.memory_terms, steps, strict=True
        ):
            if term.effect.memory is not None:
                out.extend(term.effect.memory(z, step, view, values))
        return self._stacked(out, duration)

    def _memory_rates(self, mechanical: Expression) -> Expression:
        """Continuous form of the memory: the declared rate, or the step form over a very short
        time.
        """
        x = self._symbols[0]
        out: list[Expression] = []
        terms = zip(self._equations.memory_terms, self._memory_coordinates, strict=True)
        for (term, _, z, view, values), coordinate in terms:
            if term.effect.rate is not None:
                out.extend(term.effect.rate(z, view, values))
            elif term.effect.memory is not None:
                step = ca.jtimes(coordinate, x, mechanical) * MEMORY_STEP
                moved = term.effect.memory(z, step, view, values)
                out.extend(
                    (after - before) / MEMORY_STEP for after, before in zip(moved, z, strict=True)
                )
        return self._stacked(out, ca.SX(MEMORY_STEP))

    def _stacked(self, states: list[Expression], duration: Expression) -> Expression:
        if not states:
            return ca.SX(0, 1)
        return ca.vertcat(
            *ca.substitute(self._resolved(*states), [self._equations.clock], [duration])
        )

    # --- functions --------------------------------------------------------------------------------

    @cached_property
    def rates(self) -> Expression:
        """Symbolic dx/dt, memory included."""
        mechanical = self._mechanical_rates()
        return ca.vertcat(mechanical, self._memory_rates(mechanical))

    @cached_property
    def dynamics(self) -> Any:
        """(x, u, p) -> dx/dt."""
        x, z, u, p = self._symbols
        return ca.Function(
            "dynamics", [ca.vertcat(x, z), u, p], [self.rates], ["x", "u", "p"], ["dx"]
        )

    @cached_property
    def jacobian(self) -> Any:
        """(x, u, p) -> Jacobians of dx/dt with respect to x, u and p."""
        x, z, u, p = self._symbols
        full = ca.vertcat(x, z)
        out = [ca.jacobian(self.rates, v) for v in (full, u, p)]
        return ca.Function("jacobian", [full, u, p], out, ["x", "u", "p"], ["dx_x", "dx_u", "dx_p"])

    @cached_property
    def step(self) -> Any:
        """(x, u, p, h) -> x after one Runge-Kutta step of 4th order; memory moves with its
        coordinate.

        Without internal states the step is of 4th order. With them it is of the order of their step
        form: 1 for bristles, 2 for an oscillator.
        """
        x, z, u, p = self._symbols
        h = ca.SX.sym("h")
        rate = ca.Function("rate", [x, z, u, p], [self._mechanical_rates()])
        where = ca.Function("where", [x, z, u, p], [ca.vertcat(*self._memory_coordinates)])
        has_memory = bool(self._equations.memory_terms)

        def moved(at: Expression, duration: Expression) -> Expression:
            steps = ca.vertsplit(where(at, z, u, p) - where(x, z, u, p))
            return self._moved_memory(steps, duration)

        def slope(share: float, at: Expression) -> Expression:
            return rate(at, moved(at, share * h) if has_memory and share else z, u, p)

        new = runge_kutta(slope, x, h)
        if has_memory:
            new = ca.vertcat(new, moved(new, h))
        return ca.Function(
            "step", [ca.vertcat(x, z), u, p, h], [new], ["x", "u", "p", "h"], ["x_next"]
        )

    @cached_property
    def memory_step(self) -> Any:
        """(x, x_before, z, u, p, h) -> internal states z after their coordinates have moved from
        x_before to x in the time h.

        x without the internal states; the step form of the declared memory.
        """
        x, z, u, p = self._symbols
        where = ca.Function("where", [x, z, u, p], [ca.vertcat(*self._memory_coordinates)])
        before, h = ca.SX.sym("before", x.shape[0]), ca.SX.sym("h")
        steps = ca.vertsplit(where(x, z, u, p) - where(before, z, u, p))
        moved = self._moved_memory(steps, h)
        return ca.Function(
            "memory_step",
            [x, before, z, u, p, h],
            [moved],
            ["x", "x_before", "z", "u", "p", "h"],
            ["z_next"],
        )

    @cached_property
    def outputs(self) -> Any:
        """(x, u, p) -> readings (motor position, velocity, link position, velocity, torque), sensor
        errors included.

        A delay is turned round to first order: the reading is the true value less the delay times
        its rate.
        """
        x, z, u, p = self._symbols
        return ca.Function(
            "outputs", [ca.vertcat(x, z), u, p], [self._readings], ["x", "u", "p"], ["y"]
        )

    @cached_property
    def disturbed(self) -> Any:
        """(x, u, p, d) -> dx/dt, readings as in :attr:`outputs`.

        d: torque of the transmission beyond its law, and torque on the link from elsewhere [N.m]
        (none on a rigid joint's transmission). One on the motor is a part of the drive.
        """
        x, z, u, p = self._symbols
        d = self._beyond if self._beyond.is_symbolic() else ca.SX.sym("none", 2)
        given = [ca.vertcat(x, z), u, p, d]
        return ca.Function(
            "disturbed", given, [self.rates, self._readings], ["x", "u", "p", "d"], ["dx", "y"]
        )

    @cached_property
    def _readings(self) -> Expression:
        """The five readings of :attr:`outputs`."""
        x = self._symbols[0]
        accelerations, true_torque = self._both(self._solution[0]), self._solution[1]
        motor = (x[0], x[1])
        link = (x[2], x[3]) if self._model.is_elastic else motor
        torque_rate = ca.jtimes(true_torque, x, self._mechanical_rates())
        rows = [
            self._reading("motor_position_sensor", motor[0], motor[1]),
            self._reading("motor_position_sensor", motor[1], accelerations[0], offset=False),
            self._reading("link_position_sensor", link[0], link[1]),
            self._reading("link_position_sensor", link[1], accelerations[1], offset=False),
            self._reading("torque_sensor", true_torque, torque_rate),
        ]
        return ca.vertcat(*self._substituted(*rows))  # a sensor may read the angle too

    @cached_property
    def drive_lag(self) -> Any:
        """(p) -> time by which the reading of the drive is late [s]; to first order it is the
        true drive less this times its rate.
        """
        e, p = self._model.equations, self._symbols[3]
        return ca.Function(
            "drive_lag",
            [p],
            [ca.densify(ca.jacobian(e.drive, e.signals.drive_rate))],
            ["p"],
            ["lag"],
        )

    def _reading(
        self, place: str, true: Expression, rate: Expression, *, offset: bool = True
    ) -> Expression:
        """Reading from the true value: the affine law of the sensor turned round."""
        e = self._model.equations
        s = e.signals
        found, channel, channel_rate = {
            "motor_position_sensor": (e.true_motor_position, s.motor_position, s.motor_velocity),
            "link_position_sensor": (e.true_link_position, s.link_position, s.link_velocity),
            "torque_sensor": (e.torque, s.torque, s.torque_rate),
        }[place]
        # what is of second order in a delay stands in the rates beyond
        beyond = [s.motor_acceleration, s.link_acceleration, s.motor_jerk, s.link_jerk]
        (found,) = ca.substitute([found], beyond, [ca.SX(0)] * len(beyond))
        gain, lag = ca.jacobian(found, channel), ca.jacobian(found, channel_rate)
        (zero,) = ca.substitute([found], [channel, channel_rate], [ca.SX(0), ca.SX(0)])
        return (true - (zero if offset else 0) - lag * rate / gain) / gain

    @cached_property
    def regressor(self) -> Any:
        """(x, a, u, p) -> (Y, rest): Y theta_linear + rest = inverse dynamics (drive, 0).

        x as in :attr:`dynamics` (memory included), a the accelerations, one per degree of freedom;
        with sensor effects in the model, x and a are readings. The load of load-dependent laws is
        the one that the model carries with p.
        """
        x, z, u, p = self._symbols
        e = self._model.equations
        s = e.signals
        elastic = self._model.is_elastic
        a = ca.SX.sym("a", 2 if elastic else 1)
        right = ca.vertcat(inverse_dynamics(self._model))
        names = self._model.parameter_names
        linear = [names.index(n) for n in self._model.linear_parameters]
        matrix: Expression = ca.jacobian(right, p)[:, linear]
        rest: Expression
        (rest,) = ca.substitute(
            [right], [ca.vertcat(*(p[i] for i in linear))], [ca.SX.zeros(len(linear), 1)]
        )
        load = carried_torque(e) if elastic else self._carried_rigidly(e)
        rate = carried_rate(e)
        reading = self._reading("torque_sensor", load, rate)
        matrix, rest = ca.substitute([matrix, rest], [s.torque_rate], [rate])
        matrix, rest = ca.substitute([matrix, rest], [s.torque], [reading])
        matrix, rest = ca.substitute(
            self._substituted(matrix, rest),
            [s.motor_acceleration, s.link_acceleration],
            [a[0], a[elastic]],
        )
        full = ca.vertcat(x, z)
        out = [ca.densify(matrix), ca.densify(rest)]
        return ca.Function("regressor", [full, a, u, p], out, ["x", "a", "u", "p"], ["Y", "rest"])

    @staticmethod
    def _carried_rigidly(e: Equations) -> Expression:
        """Torque into the link of a rigid joint whose acceleration is known."""
        share = e.inertia.get("link_inertia", ca.SX(0))
        return carried_torque(e, share * e.link_acceleration + e.link_resistance)

    @cached_property
    def energy(self) -> Any:
        """(x, p) -> kinetic energy plus the potential of springs and position-dependent torques
        [J].
        """
        x, z, _, p = self._symbols
        (total,) = self._resolved(total_energy(self._model))
        return ca.Function("energy", [ca.vertcat(x, z), p], [total], ["x", "p"], ["E"])

    def linearize(self, x: FloatArray | None = None, u: FloatArray | None = None) -> Any:
        """control.StateSpace of the joint about (x, u): input drive [N.m], outputs the
        mechanical states.
        """
        import control

        size = len(self.state_names) + len(self.memory_names)
        at = np.zeros(size) if x is None else np.asarray(x, dtype=float)
        inputs = np.zeros(len(INPUTS)) if u is None else np.asarray(u, dtype=float)
        a, b, _ = (np.array(m) for m in self.jacobian(at, inputs, self._model.value_vector()))
        outputs = len(self.state_names)
        return control.ss(
            a,
            b[:, :1],
            np.eye(outputs, size),
            np.zeros((outputs, 1)),
            name=self._model.name or "joint",
            states=[*self.state_names, *self.memory_names],
            inputs=["drive"],
            outputs=[f"{n}_y" for n in self.state_names],
        )
