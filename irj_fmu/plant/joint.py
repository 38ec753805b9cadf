"""A joint model as a plant FMU: dynamics, readings, and on request a controller and faulty sensors.

States are link-referred, as everywhere in :mod:`casadi_models`. Inputs and outputs are those of the
joint: motor quantities on the motor shaft, link quantities on the link, with the names of a
record's channels.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, final

import casadi as ca

from casadi_models import JointModel
from casadi_models.functions import JointFunctions
from casadi_models.parameter import Parameter
from casadi_models.quantities import linear_unit
from casadi_models.text.compensation import RestingLoad, resting_load
from casadi_models.text.shown import shown
from identification.data.channels import channel_unit
from identification.data.joint_file import Joint
from identification.errors import InputError
from irj_fmu.fmi.documentation import Note
from irj_fmu.fmi.variables import Variable
from irj_fmu.plant.library import PlantSpec
from irj_fmu.plant.readings import CHANNELS, Readings
from irj_fmu.plant.reference import Motion

Drive = Literal["current", "torque"]
REFERENCE: Final = ("reference_position", "reference_velocity", "reference_acceleration")
BANDWIDTH: Final = 30.0
"""Bandwidth of the position controller's default gains [rad/s]; its damping ratio is 0.8."""
_DAMPING: Final = 0.8
LONGEST_NAME: Final = 100
"""Characters of an FMU's name that come from the joint's: with what kind, endings and temporary
files put around it a file name stays within the 255 bytes of file systems.
"""
_MOTOR: Final = ("motor_position", "motor_velocity")
_LINK_POSITION, _LINK_VELOCITY = (CHANNELS.index(n) for n in ("link_position", "link_velocity"))


@final
@dataclass(frozen=True)
class PlantOptions:
    """What a plant FMU holds besides the joint.

    Attributes
    ----------
    drive : {"current", "torque"}, optional
        Input of a plant without controller: ``i_m`` [A], or ``tau_m``, the motor's torque on its
        shaft [N.m]. By default current where the joint file has a motor constant.
    controller : bool
        True: inputs are a reference position and its two derivatives on the link; a PD controller
        with feed-forward drives the motor.
    motion : Motion, optional
        A reference of the controller's own, added to its inputs; the parameter ``motion.scale``
        switches it.
    sensors : bool
        True: outputs are readings with noise, quantisation and faults, all of them parameters that
        start at "none".
    name : str, optional
        Name of the FMU; the joint's name by default.
    sample_time : float
        Communication step, and time between two values of the noise [s].
    tolerance : float
        Relative tolerance of the integrator where the host names none.
    payload: bool
        True: inputs ``payload_inertia`` and, where the model has gravity, ``payload_weight`` and
        ``payload_weight_cosine`` (sine and cosine part) add to the link's; a payload that is taken
        up or put down while the plant runs.
    """

    drive: Drive | None = None
    controller: bool = False
    motion: Motion | None = None
    sensors: bool = False
    name: str | None = None
    sample_time: float = 1e-3
    tolerance: float = 1e-9
    payload: bool = False


def identifier(name: str) -> str:
    """Return a C identifier made of a name, at most `LONGEST_NAME` characters of it."""
    made = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")[:LONGEST_NAME] or "joint"
    return f"joint_{made}" if made[0].isdigit() else made


def plant_spec(joint: Joint | JointModel, options: PlantOptions | None = None) -> PlantSpec:
    """Declare the plant of a joint.

    Parameters
    ----------
    joint : Joint or JointModel
        A joint file, fitted or not, with all its effects; or a model, which is driven by torque.
    options : PlantOptions, optional
        Drive, controller, sensors.

    Returns
    -------
    PlantSpec
        Parameters are those of the model with unit, bounds and meaning, link-referred and tunable.
        Effects with internal states add states; where an effect knows its states only as steps of a
        displacement (hysteresis), they are memory and the plant runs in co-simulation only. Where
        the model's drive is late, so is its reading in a plant with a controller; an input of the
        host is read as it comes.

    Raises
    ------
    InputError
        Where the drive is a current and the joint has no motor constant, or the model has no
        inertia.
    """
    options = options or PlantOptions()
    model = joint if isinstance(joint, JointModel) else joint.model()
    per_current = None if isinstance(joint, JointModel) else joint.torque_per_current
    if not model.inertias or model.clamped_link:
        raise InputError(
            f"{model.name}: a joint with a clamped link does not move; choose a model with an "
            "inertia"
        )
    return _Builder(model, per_current, options).spec()


@final
class _Builder:
    """Symbols and expressions of one plant."""

    def __init__(self, model: JointModel, per_current: float | None, options: PlantOptions) -> None:
        self.model, self.options = model, options
        self.functions = model.functions
        kind = options.drive or ("torque" if per_current is None else "current")
        if kind == "current" and per_current is None and not options.controller:
            raise InputError(
                f"{model.name}: a plant driven by current needs motor_constant or "
                "torque_per_current in [joint]; or choose drive = 'torque'"
            )
        self.per_current = per_current
        self.by_current = kind == "current" and per_current is not None
        terms = model.true_equations.memory_terms
        self.stepped = any(term.effect.rate is None for term, *_ in terms)
        needs = _used_inputs(self.functions)
        self.heated = needs[1]
        self.clocked = (
            needs[2]
            or self.stepped
            or options.sensors
            or (options.controller and options.motion is not None)
        )
        self.own_parameters = model.parameters
        self.extra: list[tuple[Variable, Any]] = []

    # --- declarations -----------------------------------------------------------------------------

    def _unit(self, rotary: str) -> str:
        return rotary if self.model.kind == "rotary" else linear_unit(rotary)

    def _channel(self, name: str) -> str:
        return channel_unit(name, self.model.kind)

    def _states(self) -> list[Variable]:
        display = "deg" if self.model.kind == "rotary" else None
        out = []
        for name in self.functions.state_names:
            is_rate = name.endswith("velocity")
            out.append(
                Variable(
                    f"state.{name}",
                    self._channel("link_velocity" if is_rate else "link_position"),
                    description=f"{name.replace('_', ' ').capitalize()}, link-referred.",
                    display_unit=None if is_rate else display,
                )
            )
        return out

    def _memory(self) -> list[Variable]:
        return [
            Variable(
                f"state.{identifier(name)}",
                description=f"Internal state of {name.rpartition('_')[0]}.",
            )
            for name in self.functions.memory_names
        ]

    def _inputs(self) -> list[Variable]:
        if self.options.controller:
            units = (
                self._channel("link_position"),
                self._channel("link_velocity"),
                self._channel("link_acceleration"),
            )
            pairs = zip(REFERENCE, units, strict=True)
            found = [
                Variable(n, u, description=f"{n.replace('_', ' ').capitalize()} of the link.")
                for n, u in pairs
            ]
        elif self.by_current:
            found = [Variable("i_m", "A", description="Motor current.")]
        else:
            found = [
                Variable(
                    "tau_m",
                    self._channel("motor_torque"),
                    description="Motor torque on the motor shaft.",
                )
            ]
        if self.heated:
            found.append(
                Variable(
                    "temperature",
                    "K",
                    description="Temperature above that from which the values of thermal "
                    "friction count.",
                )
            )
        return found

    def _payload(self) -> dict[str, Variable]:
        """Inputs of a payload, by the parameter that they add to."""
        if not self.options.payload:
            return {}
        added = {self.model.inertias[-1]: ("payload_inertia", "Inertia of the payload.")}
        upright = self.model.named("weight")
        level = tuple(n for n in self.model.weights if n not in upright)
        for part, names in (("", upright), ("_cosine", level)):
            text = f"Gravity torque of the payload, its {part[1:] or 'sine'} part."
            added |= dict.fromkeys(names[:1], (f"payload_weight{part}", text))
        units = {p.name: p.unit for p in self.own_parameters}
        return {
            name: Variable(title, units[name], description=text)
            for name, (title, text) in added.items()
        }

    def _parameter(
        self, name: str, unit: str, start: float, description: str, low: float | None = None
    ) -> Any:
        symbol = ca.SX.sym(name)
        variable = Variable(name, unit, start, low, description=description, variability="tunable")
        self.extra.append((variable, symbol))
        return symbol

    # --- expressions ------------------------------------------------------------------------------

    def spec(self) -> PlantSpec:
        """Put everything together."""
        f, options = self.functions, self.options
        mechanical, memory = self._states(), self._memory()
        size, held = len(mechanical), len(memory)
        inputs, payload = self._inputs(), self._payload()
        x = ca.SX.sym("x", size + (0 if self.stepped else held) + self.clocked)
        z = ca.SX.sym("z", held) if self.stepped else ca.SX(0, 1)
        every_input = ca.SX.sym("u", len(inputs) + len(payload))
        u, own = every_input[: len(inputs)], ca.SX.sym("p", len(self.own_parameters))
        p = ca.SX(own)
        for i, name in enumerate(payload, len(inputs)):
            p[self.model.parameter_names.index(name)] += every_input[i]
        clock = x[-1] if self.clocked else ca.SX(0)
        full = ca.vertcat(x[:size], z) if self.stepped else x[: size + held]
        drive = self._drive(x, u, clock)
        model_input = ca.vertcat(drive, u[-1] if self.heated else 0, clock)
        rates = f.dynamics(full, model_input, p)
        rates = ca.vertcat(
            rates[: size if self.stepped else size + held], *([1] if self.clocked else [])
        )
        outputs = f.outputs(full, model_input, p)
        for name in self.model.named("delay", "link_position_sensor"):
            at = self.model.parameter_names.index(name)
            timely = ca.vertcat(p[:at], 0, p[at + 1 :])
            bend = ca.jtimes(f.outputs(full, model_input, timely)[_LINK_VELOCITY], x, rates)
            # stiffness makes a torque of what the first order of a late encoder leaves
            outputs[_LINK_POSITION] += p[at] ** 2 / 2 * bend
        channels = self._readings(outputs, drive - f.drive_lag(p) * ca.jtimes(drive, x, rates))
        if options.sensors:
            readings = Readings(self._parameter, clock, options.sample_time)
            channels = [readings.read(*pair) for pair in channels]
        every = ca.vertcat(own, *(symbol for _, symbol in self.extra))
        arguments = [x, every_input, every, *([z] if self.stepped else [])]
        states = [*mechanical, *([] if self.stepped else memory)]
        if self.clocked:
            states.append(Variable("state.clock", "s", description="Time since the start."))
        return PlantSpec(
            name=identifier(options.name or self.model.name),
            dynamics=ca.Function("f", arguments, [ca.densify(rates)]),
            output=ca.Function(
                "y", arguments, [ca.densify(ca.vertcat(*(value for _, value in channels)))]
            ),
            states=tuple(states),
            inputs=(*inputs, *payload.values()),
            parameters=(
                *(
                    _variable(q, v)
                    for q, v in zip(self.own_parameters, self.model.value_vector(), strict=True)
                ),
                *(variable for variable, _ in self.extra),
            ),
            outputs=tuple(variable for variable, _ in channels),
            description=self._description(),
            update=self._update(arguments, model_input, p) if self.stepped else None,
            memory=tuple(memory) if self.stepped else (),
            default_step=options.sample_time,
            tolerance=options.tolerance,
            notes=self._notes(),
        )

    def _reference(self, u: Any, clock: Any) -> tuple[Any, Any, Any]:
        """Position, velocity and acceleration that the controller follows."""
        motion = self.options.motion
        if motion is None:
            return u[0], u[1], u[2]
        scale = self._parameter(
            "motion.scale", "", 1.0, "Factor on the built-in motion, 0 for none."
        )
        q, v, a = motion.expressions(clock)
        return u[0] + scale * q, u[1] + scale * v, u[2] + scale * a

    def _drive(self, x: Any, u: Any, clock: Any) -> Any:
        """n Km I, link-referred."""
        if self.options.controller:
            start = dict(zip(self.model.parameter_names, self.model.value_vector(), strict=True))
            inertia = sum(start[n] for n in self.model.inertias)
            damping = 2 * _DAMPING * inertia * BANDWIDTH
            load = resting_load(self.model)
            unit = self._unit
            stiff = self._parameter(
                "controller.stiffness",
                unit("N.m/rad"),
                inertia * BANDWIDTH**2,
                "Gain on the position error, link-referred.",
                0.0,
            )
            damp = self._parameter(
                "controller.damping",
                unit("N.m.s/rad"),
                damping,
                "Gain on the velocity error, link-referred.",
                0.0,
            )
            feed = self._parameter(
                "controller.inertia",
                unit("kg.m2"),
                inertia,
                "Feed-forward of the reference acceleration.",
                0.0,
            )
            sine = self._parameter(
                "controller.gravity",
                unit("N.m"),
                load.sine,
                "Feed-forward of gravity, its sine part; positive is upright at zero.",
            )
            cosine = self._parameter(
                "controller.gravity_cosine",
                unit("N.m"),
                load.cosine,
                "Feed-forward of gravity, its cosine part: all of it where the link is level at "
                "zero.",
            )
            constant = self._parameter(
                "controller.constant",
                unit("N.m"),
                load.constant,
                "Feed-forward of a load that is always the same: the weight of a linear axis, an "
                "offset of the drive.",
            )
            limit = self._parameter(
                "controller.limit", unit("N.m"), 1e9, "Largest drive torque, link-referred.", 0.0
            )
            q, v, a = self._reference(u, clock)
            held = RestingLoad(sine, cosine, constant).drive(q)
            wish = stiff * (q - x[0]) + damp * (v - x[1]) + feed * a + held
            return ca.fmin(limit, ca.fmax(-limit, wish))
        if self.by_current:
            constant = self._parameter(
                "torque_per_current",
                f"{self._unit('N.m')}/A",
                float(self.per_current or 0.0),
                "Drive torque per ampere, link-referred.",
            )
            return u[0] * constant
        return u[0] * self.model.gear_ratio

    def _readings(self, outputs: Any, drive: Any) -> list[tuple[Variable, Any]]:
        """Record channels as readings: motor side on the motor shaft; `drive` as it is read,
        late where the model says so.
        """
        ratio = self.model.gear_ratio
        found: list[tuple[Variable, Any]] = []
        for i, name in enumerate(CHANNELS[:5]):
            variable = Variable(
                name,
                self._channel(name),
                description=f"{name.replace('_', ' ').capitalize()} as read.",
            )
            found.append((variable, outputs[i] * (ratio if name in _MOTOR else 1.0)))
        if self.per_current is not None:
            constant = next(
                (s for v, s in self.extra if v.name == "torque_per_current"), self.per_current
            )
            found.append(
                (
                    Variable("motor_current", "A", description="Motor current as read."),
                    drive / constant,
                )
            )
        else:
            unit = self._channel("motor_torque")
            found.append(
                (
                    Variable("motor_torque", unit, description="Motor torque on its shaft."),
                    drive / ratio,
                )
            )
        return found

    def _update(self, arguments: list[Any], model_input: Any, p: Any) -> Any:
        """Step form of the displacement memory between two states."""
        f, size = self.functions, len(self.functions.state_names)
        x, u, every, z = arguments
        before = ca.SX.sym("x_prev", x.shape[0])
        duration = x[-1] - before[-1]
        moved = f.memory_step(x[:size], before[:size], z, model_input, p, duration)
        kept = ca.if_else(duration > 0, moved, z)
        return ca.Function("z", [x, z, u, every, before], [ca.densify(kept)])

    def _notes(self) -> tuple[Note, ...]:
        """Equations, faults and limits, for a reader."""
        limits = [
            "Motor quantities are on the motor shaft, link quantities on the link; parameters and "
            "states are referred to the link.",
            "Signs of friction are smooth in the width that the smoothing velocity names.",
        ]
        if self.stepped:
            limits.append(
                "Displacement memory knows its states only as steps: co-simulation only, and inner "
                f"steps up to {self.options.sample_time:g} s."
            )
        notes = [Note("Equations", shown(self.model), verbatim=True)]
        if self.options.sensors:
            notes.append(
                Note(
                    "Sensor faults",
                    "Every reading has parameters for noise, quantisation and faults, named after "
                    "it. All of them start at none and may be changed while the FMU runs.",
                )
            )
        return (*notes, Note("Limits", "\n\n".join(limits)))

    def _description(self) -> str:
        parts = [f"Joint {self.model.name}", f"gear ratio {self.model.gear_ratio:g}"]
        if self.model.effects:
            parts.append(f"effects {', '.join(self.model.effects)}")
        if self.options.controller:
            parts.append("position controller")
        if self.options.sensors:
            parts.append("sensors")
        return "; ".join(parts) + "."


def _variable(parameter: Parameter, value: float) -> Variable:
    """An FMU parameter of a parameter of the model."""
    side = "" if parameter.side == "none" else f" ({parameter.side} side)"
    text = f"{parameter.meaning[:1].upper()}{parameter.meaning[1:]}{side}."
    return Variable(
        parameter.name,
        "" if parameter.unit == "1" else parameter.unit,
        value,
        _bound(parameter.low, value, min),
        _bound(parameter.high, value, max),
        abs(value) or None,
        description=text,
        variability="tunable",
    )


def _bound(limit: float, value: float, widest: Callable[[float, float], float]) -> float | None:
    """A finite bound that holds the value, which a fit may have put beyond it."""
    return widest(limit, value) if math.isfinite(limit) else None


def _used_inputs(functions: JointFunctions) -> tuple[bool, bool, bool]:
    """Which of drive, temperature and time enter the dynamics or the readings."""
    size = len(functions.state_names) + len(functions.memory_names)
    x, u = ca.SX.sym("x", size), ca.SX.sym("u", 3)
    p = ca.SX.sym("p", functions.dynamics.size1_in(2))
    both = ca.vertcat(functions.dynamics(x, u, p), functions.outputs(x, u, p))
    used = set(ca.jacobian_sparsity(both, u).get_triplet()[1])
    return 0 in used, 1 in used, 2 in used
