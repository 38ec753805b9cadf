"""The joint: inertias, a transmission and effects, turned into CasADi functions.

One energy-consistent sign convention holds everywhere (all quantities link-referred)::

    d  = q_m - q_l - err(q)                         torsion
    J_m q_m'' = n K_m I - T (1 - d err/d q_m) - f_motor
    J_l q_l'' = T (1 + d err/d q_l) - f_link
    T  = sum of the transmission laws of d, d'

A rigid model has one degree of freedom, q_m = q_l.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType, SimpleNamespace
from typing import Any, Final, final

import casadi as ca

from .effect import EFFECTS, Effect, Place
from .parameter import Parameter
from .signals import Expression, LocalSignals, Signals

MEMORY_STEP: Final = 1e-6
"""Time over which the step form of a memory is differentiated to its continuous form [s]."""

INERTIAS: Final = {
    "motor_inertia": Parameter(
        "motor_inertia", "kg.m2", 1.0, 1e-12, math.inf, "inertia of rotor and wave generator, times the ratio squared", "motor"
    ),
    "link_inertia": Parameter("link_inertia", "kg.m2", 1.0, 1e-12, math.inf, "inertia of the link with its payload", "link"),
    "inertia": Parameter("inertia", "kg.m2", 1.0, 1e-12, math.inf, "inertia of motor and link together", "link"),
}  # fmt: skip

_RATES: Final = {
    "motor_position": "motor_velocity",
    "motor_velocity": "motor_acceleration",
    "motor_acceleration": "motor_jerk",
    "link_position": "link_velocity",
    "link_velocity": "link_acceleration",
    "link_acceleration": "link_jerk",
    "torque": "torque_rate",
    "drive": "drive_rate",
}


@final
@dataclass(frozen=True)
class Term:
    """One effect in one place."""

    effect: Effect
    place: Place
    instance: int = 1

    @property
    def label(self) -> str:
        """``key``, ``key@place`` where the effect may act on several places, ``#2`` for a second one."""
        label = f"{self.effect.key}@{self.place}" if len(self.effect.acts_on) > 1 else self.effect.key
        return label if self.instance == 1 else f"{label}#{self.instance}"

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names in the model, in the order of the effect's parameters."""
        tail = "" if self.instance == 1 else f"_{self.instance}"
        return tuple(n + tail for n in self.effect.parameter_names(self.place))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters with the names they have in the model."""
        return tuple(p.renamed(n, p.side) for p, n in zip(self.effect.placed(self.place), self.names, strict=True))


@final
@dataclass(frozen=True)
class Equations:
    """Symbolic pieces of the joint on one set of signal symbols.

    Attributes
    ----------
    signals : Signals
        The symbols.
    parameters, memory : expression
        Columns of all parameters and of all internal states.
    drive, motor_resistance, link_resistance : expression
        Torque of the motor; torques that resist the motion of either side [N.m].
    transmitted : expression
        What the transmission laws say [N.m].
    torque, true_motor_position, true_link_position : expression
        What the sensors say, corrected [N.m, rad, rad].
    torsion : expression
        Twist of the transmission, kinematic error taken off [rad].
    motor_lever, link_lever : expression
        Share of the transmitted torque that motor and link feel (1 without kinematic error).
    memory_coordinate : tuple of expression
        Driving coordinate of each term with states, in order.
    """

    signals: Signals
    parameters: Expression
    memory: Expression
    drive: Expression
    motor_acceleration: Expression
    link_acceleration: Expression
    motor_resistance: Expression
    link_resistance: Expression
    transmitted: Expression
    torque: Expression
    torsion: Expression
    true_motor_position: Expression
    true_link_position: Expression
    motor_lever: Expression
    link_lever: Expression
    inertia: Mapping[str, Expression]
    memory_terms: tuple[tuple[Term, Expression, tuple[Expression, ...], LocalSignals, SimpleNamespace], ...]


def smoothing(place: str) -> Parameter:
    """Velocity over which sign(v) is smoothed to tanh(v/v0): a nuisance of every friction law."""
    return Parameter(
        f"{place}_smoothing_velocity", "rad/s", 1e-3, 1e-9, math.inf,
        f"velocity over which {place}-side friction changes its sign (nuisance)", "motor" if place == "motor" else "link",
        grid=(0.0003, 0.001, 0.003, 0.01, 0.03), scale="velocity",
    )  # fmt: skip


@final
@dataclass(frozen=True)
class JointModel:
    """A joint model: immutable; :meth:`add` and :meth:`drop` return a new one.

    Attributes
    ----------
    gear_ratio : float
        theta_motor / theta_link at rest, signed.
    terms : tuple of Term
        Effects in their places.
    inertias : tuple of str
        ``("motor_inertia", "link_inertia")``, or ``("inertia",)`` for an axis measured on one side.
    values : mapping
        Parameter values that differ from the declared starts.
    kind : {"rotary", "linear"}
        Decides the units shown.
    virtual_work : bool
        True (default): the motor also feels -T d(err)/d(q_m) of a kinematic error. False: the
        thesis's approximation (2.58).
    load_from : {"torque", "gravity"}
        What presses the gear's teeth in load-dependent laws.
    """

    gear_ratio: float = 1.0
    terms: tuple[Term, ...] = ()
    inertias: tuple[str, ...] = ("motor_inertia", "link_inertia")
    values: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    kind: str = "rotary"
    virtual_work: bool = True
    load_from: str = "torque"
    name: str = "joint"

    @staticmethod
    def harmonic_drive(number: int, *, gear_ratio: float = -160.0, configuration: str | int = "IRJ") -> JointModel:
        """Harmonic-drive model 1 to 4 of the thesis (see :func:`casadi_models.transmission.harmonic_drive`)."""
        from .transmission import harmonic_drive

        return harmonic_drive(number, gear_ratio=gear_ratio, configuration=configuration)

    # --- composition -------------------------------------------------------------------------------------------------

    def add(self, label: str) -> JointModel:
        """The model with one more effect.

        Parameters
        ----------
        label : str
            Effect key, ``key@place``, or ``key#2`` for a second one with its own parameters. A key alone goes to the effect's first place; viscous and
            Coulomb friction go to motor and link alike.

        Raises
        ------
        KeyError, ValueError
            Unknown key; place where the effect cannot act; effect that is in the model already.
        """
        new = [t for t in self._parse(label) if t not in self.terms]
        if not new:
            raise ValueError(f"effect {label!r} is in the model already")
        return replace(self, terms=(*self.terms, *new))

    def drop(self, label: str) -> JointModel:
        """The model without an effect (``key`` drops it in every place, ``key@place`` in one)."""
        kept = tuple(t for t in self.terms if label not in (t.label, t.effect.key))
        if len(kept) == len(self.terms):
            raise ValueError(f"effect {label!r} is not in the model")
        return replace(self, terms=kept)

    def with_values(self, values: Mapping[str, float]) -> JointModel:
        """The model with other parameter values; unknown names are an error."""
        known = {p.name for p in self.parameters}
        for name in values:
            if name not in known:
                raise ValueError(f"no parameter {name!r} in the model; it has {', '.join(sorted(known))}")
        return replace(self, values=MappingProxyType({**self.values, **values}))

    def _parse(self, label: str) -> list[Term]:
        bare, _, number = label.partition("#")
        key, _, place = bare.partition("@")
        found = EFFECTS[key]
        instance = int(number) if number else 1
        if place:
            if place not in found.acts_on:
                raise ValueError(f"effect {key!r} acts on {', '.join(found.acts_on)}, not on {place!r}")
            return [Term(found, p, instance) for p in found.acts_on if p == place]
        everywhere = key in ("viscous", "coulomb") and self.inertias != ("inertia",)
        return [Term(found, p, instance) for p in (found.acts_on if everywhere else found.acts_on[:1])]

    def has(self, key: str, place: str | None = None) -> bool:
        """True where the effect is in the model (in `place`, if given)."""
        return any(t.effect.key == key and place in (None, t.place) for t in self.terms)

    @property
    def is_elastic(self) -> bool:
        """True where motor and link move separately."""
        return self.has("transmission_compliance")

    @property
    def effects(self) -> tuple[str, ...]:
        """Labels of the effects in the model."""
        return tuple(t.label for t in self.terms)

    # --- parameters --------------------------------------------------------------------------------------------------

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters: inertias, those of the terms, smoothing velocities; each once."""
        found: dict[str, Parameter] = {n: INERTIAS[n] for n in self.inertias}
        for term in self.terms:
            found.update({p.name: p for p in term.parameters})
        for place in ("motor", "link"):
            if any(t.place == place and t.effect.family == "friction" for t in self.terms):
                found[f"{place}_smoothing_velocity"] = smoothing(place)
        return tuple(p.for_kind(self.kind) for p in found.values())

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names in the order of the parameter vector."""
        return tuple(p.name for p in self.parameters)

    def value_vector(self) -> list[float]:
        """Parameter values in the order of :attr:`parameter_names`."""
        return [float(self.values.get(p.name, p.start)) for p in self.parameters]

    # --- equations ---------------------------------------------------------------------------------------------------

    @cached_property
    def equations(self) -> Equations:
        """The symbolic joint (built once per model)."""
        return _build(self)

    @cached_property
    def linear_parameters(self) -> tuple[str, ...]:
        """Largest set of parameters that enter the equations of motion jointly linearly."""
        return _linear_set(self)

    @cached_property
    def functions(self) -> Any:
        """CasADi functions of the joint (see :mod:`casadi_models.functions`)."""
        from .functions import JointFunctions

        return JointFunctions(self)

    @property
    def dynamics(self) -> Any:
        """CasADi function (x, u, p) -> dx/dt."""
        return self.functions.dynamics

    @property
    def regressor(self) -> Any:
        """CasADi function (x, a, u, p) -> (Y, rest) with Y theta_linear + rest = inverse dynamics."""
        return self.functions.regressor

    @property
    def jacobian(self) -> Any:
        """CasADi function (x, u, p) -> (d dx/dx, d dx/du, d dx/dp)."""
        return self.functions.jacobian

    @property
    def energy(self) -> Any:
        """CasADi function (x, p) -> kinetic plus potential energy [J]."""
        return self.functions.energy

    def linearize(self, x: Any = None, u: Any = None) -> Any:
        """State-space model (control.StateSpace) about a working point; rest at zero by default."""
        return self.functions.linearize(x, u)


def time_derivative(expression: Expression, signals: Signals) -> Expression:
    """Rate of an expression of the signals by the chain rule."""
    total: Expression = ca.SX(0)
    for name, rate in _RATES.items():
        total = total + ca.jacobian(expression, getattr(signals, name)) * getattr(signals, rate)
    return total


def _build(model: JointModel) -> Equations:
    raw = Signals.symbols()
    symbols = {p.name: ca.SX.sym(p.name) for p in model.parameters}
    memory: dict[Term, tuple[Expression, ...]] = {
        t: tuple(ca.SX.sym(f"{t.label}_{i}") for i in range(t.effect.states)) for t in model.terms if t.effect.states
    }

    def values(term: Term) -> SimpleNamespace:
        return SimpleNamespace(**{p.name: symbols[n] for p, n in zip(term.effect.parameters, term.names, strict=True)})

    def local(term: Term, s: Signals, d: Expression, load: Expression, reading: tuple[Expression, Expression]) -> LocalSignals:
        link = term.place in ("link", "link_position_sensor")
        gear = term.place == "transmission"
        rate = time_derivative(d, raw)
        velocity = s.link_velocity if link else s.motor_velocity
        smooth = symbols.get(f"{'link' if link else 'motor'}_smoothing_velocity")
        return LocalSignals(
            position=d if gear else (s.link_position if link else s.motor_position),
            velocity=rate if gear else velocity,
            acceleration=s.link_acceleration if link else s.motor_acceleration,
            direction=ca.tanh(velocity / smooth) if smooth is not None else ca.sign(velocity),
            torsion=d, torsion_rate=rate, torque=s.torque, load=load,
            reading=reading[0], reading_rate=reading[1],
            motor_angle=s.motor_position * model.gear_ratio,
            time=s.time, temperature=s.temperature, memory=memory.get(term, ()), gear_ratio=ca.SX(model.gear_ratio),
        )  # fmt: skip

    nothing = ca.SX(0)

    def total(place: str, s: Signals, d: Expression, load: Expression, reading: tuple[Expression, Expression]) -> Expression:
        found: Expression = ca.SX(0)
        for t in model.terms:
            if t.place == place:
                found = found + t.effect.law(local(t, s, d, load, reading), values(t))
        return found

    def corrected(place: str, *channels: str) -> dict[str, Expression]:
        """True channel from its reading; the laws of sensors are affine, so rates follow by linearity."""
        chain = [getattr(raw, c) for c in channels]
        offset = total(place, raw, nothing, nothing, (ca.SX(0), ca.SX(0)))
        out = {}
        for i, c in enumerate(channels[:-1]):
            change = total(place, raw, nothing, nothing, (chain[i], chain[i + 1]))
            out[c] = chain[i] + (change if i == 0 else change - offset)
        return out

    s = raw.with_values(
        **corrected("motor_position_sensor", "motor_position", "motor_velocity", "motor_acceleration", "motor_jerk"),
        **corrected("link_position_sensor", "link_position", "link_velocity", "link_acceleration", "link_jerk"),
        **corrected("torque_sensor", "torque", "torque_rate"),
    )
    drive = s.drive + total("drive", s, nothing, nothing, (s.drive, s.drive_rate))
    twist = s.motor_position - s.link_position
    error = total("torsion", s, twist, s.torque, (nothing, nothing))
    torsion = twist - error
    gravity: Expression = ca.SX(0)
    for t in model.terms:
        if t.place == "link" and t.effect.family == "torque":
            gravity = gravity + t.effect.law(local(t, s, torsion, nothing, (nothing, nothing)), values(t))
    load = s.torque if model.load_from == "torque" else gravity
    none = (nothing, nothing)
    lever = (1.0, 1.0)
    if model.virtual_work and any(t.place == "torsion" for t in model.terms):
        lever = (1 - ca.jacobian(error, raw.motor_position), 1 + ca.jacobian(error, raw.link_position))
    terms = []
    for t in model.terms:
        if t.effect.memory is not None:
            view = local(t, s, torsion, load, none)
            terms.append((t, view.position, memory[t], view, values(t)))
    return Equations(
        signals=raw,
        parameters=ca.vertcat(*symbols.values()),
        memory=ca.vertcat(*(z for zs in memory.values() for z in zs)) if memory else ca.SX(0, 1),
        drive=drive,
        motor_acceleration=s.motor_acceleration,
        link_acceleration=s.link_acceleration,
        motor_resistance=total("motor", s, torsion, load, none),
        link_resistance=total("link", s, torsion, load, none),
        transmitted=total("transmission", s, torsion, load, none),
        torque=s.torque,
        torsion=torsion,
        true_motor_position=s.motor_position,
        true_link_position=s.link_position,
        motor_lever=lever[0],
        link_lever=lever[1],
        inertia={n: symbols[n] for n in model.inertias},
        memory_terms=tuple(terms),
    )


def inverse_dynamics(model: JointModel) -> Expression:
    """Right-hand sides of the equations of motion, (drive, 0): what a regressor reproduces."""
    e = model.equations
    if model.is_elastic:
        motor = e.inertia["motor_inertia"] * e.motor_acceleration + e.motor_resistance + e.transmitted * e.motor_lever
        link = e.inertia["link_inertia"] * e.link_acceleration + e.link_resistance - e.transmitted * e.link_lever
        return ca.vertcat(motor - (e.drive - e.signals.drive), link)
    inertia = sum(e.inertia.values())
    return inertia * e.motor_acceleration + e.motor_resistance + e.link_resistance - (e.drive - e.signals.drive)


def _linear_set(model: JointModel) -> tuple[str, ...]:
    """Greedy largest independent set of the graph whose edges are non-zero mutual Hessian entries."""
    p = model.equations.parameters
    right = inverse_dynamics(model)
    names = model.parameter_names
    edges: dict[int, set[int]] = {i: set() for i in range(len(names))}
    for row in ca.vertsplit(ca.vertcat(right)):
        sparsity = ca.hessian(row, p)[0].sparsity()
        for i, j in zip(*sparsity.get_triplet(), strict=True):
            edges[i].add(j)
    present = set(ca.jacobian(right, p).sparsity().get_triplet()[1])
    chosen = {i for i in edges if i in present and i not in edges[i]}
    while True:
        degree = {i: len(edges[i] & chosen) for i in chosen}
        worst = max(degree, key=lambda i: (degree[i], i), default=None)
        if worst is None or degree[worst] == 0:
            return tuple(names[i] for i in sorted(chosen))
        chosen.discard(worst)
