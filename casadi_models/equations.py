"""The symbolic joint: laws put in their places on one set of signals.

:func:`build_equations` makes it in two forms that share all symbols: with the corrections of the
sensors, where the signals are readings (regression, residuals), and without them, where the signals
are the true ones (simulation).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any, Final, Protocol, final

import casadi as ca

from .affine import AffineParts
from .parameter import Parameter
from .signals import Expression, LocalSignals, Signals
from .term import Term

MemoryTerm = tuple[Term, Expression, tuple[Expression, ...], LocalSignals, SimpleNamespace]
"""Term with states: (term, driving coordinate, states, what the law sees, its parameters)."""

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
_MOTOR_CHAIN: Final = ("motor_position", "motor_velocity", "motor_acceleration", "motor_jerk")
_LINK_CHAIN: Final = ("link_position", "link_velocity", "link_acceleration", "link_jerk")


class Structure(Protocol):
    """What the equations need to know of a joint model (see `casadi_models.joint.JointModel`)."""

    @property
    def gear_ratio(self) -> float: ...
    @property
    def terms(self) -> tuple[Term, ...]: ...
    @property
    def inertias(self) -> tuple[str, ...]: ...
    @property
    def virtual_work(self) -> bool: ...
    @property
    def load_from(self) -> str: ...
    @property
    def clamped_link(self) -> bool: ...
    @property
    def lagging_load(self) -> bool: ...
    @property
    def is_elastic(self) -> bool: ...
    @property
    def parameters(self) -> tuple[Parameter, ...]: ...
    @property
    def parameter_names(self) -> tuple[str, ...]: ...
    def swinging_inertia(self, values: Mapping[str, Any]) -> Any: ...
    def load_compliance(self, values: Mapping[str, Any]) -> Any: ...
    def load_relaxation(self, values: Mapping[str, Any]) -> Any: ...


@final
@dataclass(frozen=True)
class Equations:
    """Symbolic pieces of the joint on one set of signal symbols.

    Attributes
    ----------
    signals : Signals
        The symbols.
    parameters, memory, clock : expression
        Columns of all parameters and of all internal states; duration of one step of the memory
        [s].
    drive, motor_resistance, link_resistance : expression
        Torque of the motor; torques that resist the motion of either side [N.m].
    motor_acceleration, link_acceleration : expression
        Accelerations, corrected [rad/s2].
    transmitted : expression
        What the transmission laws say [N.m].
    torque, true_motor_position, true_link_position : expression
        What the sensors say, corrected [N.m, rad, rad].
    torsion : expression
        Twist of the transmission, kinematic error taken off [rad].
    beyond : mapping of Term to expression
        Twist that each law of the transmission feels: less what a gap takes up [rad].
    motor_lever, link_lever : expression
        Share of the transmitted torque that motor and link feel (1 without kinematic error).
    inertia : mapping of str to expression
        Inertias of the model by name [kg.m2].
    load_lag : expression
        Where the link hangs on a compliance c and is not recorded: its inertia times c times the
        torque that the motor passes on [N.m.s2]; else zero. Its second derivative enters the
        balance of the axis (link angle eliminated from 2.41 and 2.42).
    memory_terms : tuple
        One :data:`MemoryTerm` per term with states, in the order of `memory`.
    """

    signals: Signals
    parameters: Expression
    memory: Expression
    clock: Expression
    drive: Expression
    motor_acceleration: Expression
    link_acceleration: Expression
    motor_resistance: Expression
    link_resistance: Expression
    transmitted: Expression
    torque: Expression
    torsion: Expression
    beyond: Mapping[Term, Expression]
    true_motor_position: Expression
    true_link_position: Expression
    motor_lever: Expression
    link_lever: Expression
    inertia: Mapping[str, Expression]
    load_lag: Expression
    memory_terms: tuple[MemoryTerm, ...]


class Solvable(Structure, Protocol):
    """A joint model with its equations: what energy and CasADi functions are made from."""

    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def symbols(self) -> Symbols: ...
    @property
    def equations(self) -> Equations: ...
    @property
    def true_equations(self) -> Equations: ...
    @property
    def linear_parameters(self) -> tuple[str, ...]: ...
    def value_vector(self) -> list[float]: ...


@final
@dataclass(frozen=True)
class Symbols:
    """Symbols that all forms of one model's equations share."""

    signals: Signals
    parameters: Mapping[str, Expression]
    memory: Mapping[Term, tuple[Expression, ...]]
    clock: Expression

    @staticmethod
    def of(model: Structure) -> Symbols:
        """Fresh symbols for a model."""
        return Symbols(
            Signals.symbols(),
            {p.name: ca.SX.sym(p.name) for p in model.parameters},
            {
                t: tuple(ca.SX.sym(f"{t.label}_{i}") for i in range(t.effect.states))
                for t in model.terms
                if t.effect.states
            },
            ca.SX.sym("clock"),
        )


def _zero() -> Expression:
    return ca.SX(0)


@final
@dataclass(frozen=True)
class _View:
    """What all laws of one place are evaluated on."""

    signals: Signals
    torsion: Expression
    load: Expression
    reading: Expression
    reading_rate: Expression
    taken: Expression = field(default_factory=lambda: ca.SX(0))


@final
@dataclass(frozen=True)
class _Builder:
    """Laws of one model on its symbols."""

    model: Structure
    symbols: Symbols

    def torsion_rate(self, view: _View) -> Expression:
        """Rate of what twists the gear's damping; made once for all views that see the same."""
        s = view.signals
        seen = (s.motor_position, s.link_position, view.torsion, view.taken)
        key = tuple(x.element_hash() for x in seen)
        if key not in self._rates:
            # a hash is an address: what it names must stay
            self._rates[key] = seen, time_derivative(self.turned(view), self.symbols.signals)
        return self._rates[key][1]

    @cached_property
    def _rates(self) -> dict[tuple[int, ...], tuple[tuple[Expression, ...], Expression]]:
        return {}

    def turned(self, view: _View) -> Expression:
        """Twist whose rate the gear's damping feels."""
        # the approximation (2.58) lets the kinematic error wind up the stiffness only, not the
        # damping
        if self.model.virtual_work:
            return view.torsion
        return bare_twist(self.model, view.signals) - view.taken

    def beyond(self, view: _View) -> _View:
        """What the laws of the transmission see that act beyond those that take up twist."""
        taken = _zero()
        for t in self.model.terms:
            if t.effect.takes_up is not None:
                local = self.local(t, view, rate=_zero())
                taken = taken + t.effect.takes_up(local, t.bound(self.symbols.parameters))
        if taken.is_zero():
            return view
        return replace(view, torsion=view.torsion - taken, taken=taken)

    def seen(self, term: Term, view: _View, beyond: _View) -> _View:
        """The view of a term: beyond what others take up, if it is a law of the transmission.

        Friction between the two sides (a law with memory) acts whether they touch or not.
        """
        effect = term.effect
        spring = any(p.role == "stiffness" for p in effect.parameters)
        whole = spring or effect.takes_up is not None or effect.memory is not None
        return view if whole or term.place != "transmission" else beyond

    def local(self, term: Term, view: _View, rate: Expression | None = None) -> LocalSignals:
        """What the law of a term sees; `rate` from :meth:`torsion_rate` where it is at hand."""
        s = view.signals
        link = term.place in ("link", "link_position_sensor")
        gear = term.place == "transmission"
        rate = self.torsion_rate(view) if rate is None else rate
        velocity = s.link_velocity if link else s.motor_velocity
        smooth = self.symbols.parameters.get(f"{'link' if link else 'motor'}_smoothing_velocity")
        return LocalSignals(
            position=view.torsion if gear else (s.link_position if link else s.motor_position),
            velocity=rate if gear else velocity,
            acceleration=s.link_acceleration if link else s.motor_acceleration,
            direction=ca.tanh(velocity / smooth) if smooth is not None else ca.sign(velocity),
            torsion=view.torsion,
            torsion_rate=rate,
            torque=s.torque,
            load=view.load,
            reading=view.reading,
            reading_rate=view.reading_rate,
            motor_angle=s.motor_position * self.model.gear_ratio,
            time=s.time,
            temperature=s.temperature,
            memory=self.symbols.memory.get(term, ()),
            gear_ratio=ca.SX(self.model.gear_ratio),
            clock=self.symbols.clock,
        )

    def total(self, place: str, view: _View, rate: Expression | None = None) -> Expression:
        """Sum of the laws of one place; `rate` of the torsion where that is a symbol of its own."""
        found = _zero()
        terms = [t for t in self.model.terms if t.place == place]
        beyond = self.beyond(view) if place == "transmission" else view
        if rate is not None:
            further = rate * ca.jacobian(beyond.torsion, view.torsion)
        else:
            rate = self.torsion_rate(view) if terms else None
            further = rate if beyond is view else self.torsion_rate(beyond)
        for t in terms:
            own = self.seen(t, view, beyond)
            found = found + t.effect.law(
                self.local(t, own, rate if own is view else further),
                t.bound(self.symbols.parameters),
            )
        return found

    def corrected(self, place: str, *channels: str) -> dict[str, Expression]:
        """True channels from their readings; the laws of sensors are affine, so rates follow by
        linearity.
        """
        raw = self.symbols.signals
        chain = [getattr(raw, c) for c in channels]
        if not any(t.place == place for t in self.model.terms):
            return dict(zip(channels[:-1], chain[:-1], strict=True))
        offset = self.total(place, _View(raw, _zero(), _zero(), _zero(), _zero()))
        out = {}
        for i, c in enumerate(channels[:-1]):
            change = self.total(place, _View(raw, _zero(), _zero(), chain[i], chain[i + 1]))
            out[c] = chain[i] + (change if i == 0 else change - offset)
        return out

    def true_signals(self) -> Signals:
        """Signals with what the sensors add taken off."""
        s = self.symbols.signals.with_values(
            **self.corrected("motor_position_sensor", *_MOTOR_CHAIN),
            **self.corrected("link_position_sensor", *_LINK_CHAIN),
            **self.corrected("torque_sensor", "torque", "torque_rate"),
        )
        zero = self.symbols.parameters.get("link_encoder_zero")
        if zero is not None:
            s = s.with_values(link_position=s.link_position - zero)
        return in_time(s, self.symbols.parameters)

    def gravity(self, view: _View) -> Expression:
        """Torques on the link that depend on its position only."""
        found = _zero()
        for t in self.model.terms:
            if t.place == "link" and t.effect.family == "torque":
                found = found + t.effect.law(self.local(t, view), t.bound(self.symbols.parameters))
        return found

    def load(self, view: _View) -> Expression:
        """What presses the gear's teeth: the torque where one is known, else what the link's own
        gravity and motion ask for.
        """
        signals = view.signals
        if self.model.load_from == "torque":
            return signals.torque
        asked = self.gravity(view)
        if self.model.load_from == "motion":
            # its own motion and friction: over a compliant gear it does not move as the motor does
            inertia = self.model.swinging_inertia(self.symbols.parameters)
            asked = asked + inertia * signals.link_acceleration
            for t in self.model.terms:
                law = t.effect
                if t.place == "link" and law.family == "friction" and not law.needs_load:
                    asked = asked + law.law(self.local(t, view), t.bound(self.symbols.parameters))
        return asked

    def levers(self, error: Expression) -> tuple[Expression, Expression]:
        """Shares of the transmitted torque from the virtual work of the kinematic error."""
        raw = self.symbols.signals
        if not self.model.virtual_work or not any(t.place == "torsion" for t in self.model.terms):
            return ca.SX(1), ca.SX(1)
        return 1 - ca.jacobian(error, raw.motor_position), 1 + ca.jacobian(error, raw.link_position)


def in_time(s: Signals, parameters: Mapping[str, Expression]) -> Signals:
    """Signals of late readings at their true time, by their Taylor series about the stamps: to the
    second order where the derivatives are there.
    """
    late = parameters.get("link_encoder_skew")
    if late is not None:
        q, v, a, j = (getattr(s, n) for n in _LINK_CHAIN)
        s = s.with_values(
            link_position=q + late * (v + late / 2 * a),
            link_velocity=v + late * (a + late / 2 * j),
            link_acceleration=a + late * j,
        )
    late = parameters.get("torque_sensor_skew")
    return s if late is None else s.with_values(torque=s.torque + late * s.torque_rate)


def bare_twist(model: Structure, s: Signals) -> Expression:
    """Motor side minus link side; the position itself where the link is clamped."""
    return s.motor_position if model.clamped_link else s.motor_position - s.link_position


def time_derivative(expression: Expression, signals: Signals) -> Expression:
    """Rate of an expression of the signals by the chain rule."""
    names = list(_RATES)
    slopes = ca.jacobian(expression, ca.vertcat(*(getattr(signals, n) for n in names)))
    total = _zero()
    # what does not appear adds nothing, not even a node of the graph
    for i in sorted(set(slopes.sparsity().get_triplet()[1])):
        total = total + slopes[0, i] * getattr(signals, _RATES[names[i]])
    return total


def build_equations(model: Structure, symbols: Symbols, *, sensors: bool) -> Equations:
    """Equations of a joint on given symbols.

    Parameters
    ----------
    model : Structure
    symbols : Symbols
    sensors : bool
        True: the signals are readings, corrected by the sensor effects of the model. False: the
        signals are the true ones.
    """
    builder = _Builder(model, symbols)
    raw = symbols.signals
    s = builder.true_signals() if sensors else raw
    drive_view = _View(s, _zero(), _zero(), s.drive, s.drive_rate)
    twist = bare_twist(model, s)
    error = builder.total("torsion", _View(s, twist, s.torque, _zero(), _zero()))
    torsion = twist - error
    unloaded = _View(s, torsion, _zero(), _zero(), _zero())
    load = builder.load(unloaded)
    view = _View(s, torsion, load, _zero(), _zero())
    motor_lever, link_lever = builder.levers(error)
    beyond_gap = builder.beyond(view)
    terms: list[MemoryTerm] = []
    for t in model.terms:
        if t.effect.memory is not None:
            local = builder.local(t, builder.seen(t, view, beyond_gap))
            terms.append((t, local.position, symbols.memory[t], local, t.bound(symbols.parameters)))
    states = [z for zs in symbols.memory.values() for z in zs]
    drive = s.drive + builder.total("drive", drive_view)
    motor_resistance = builder.total("motor", view)
    inertia = {n: symbols.parameters[n] for n in model.inertias}
    lag, beyond = ca.SX(0), view
    if model.lagging_load and sensors:
        swinging = model.swinging_inertia(symbols.parameters)
        passed_on = (
            drive - (sum(inertia.values()) - swinging) * s.motor_acceleration - motor_resistance
        )
        twisted = model.load_compliance(symbols.parameters) * passed_on
        lag = swinging * twisted
        beyond = replace(view, signals=s.with_values(link_position=s.link_position - twisted))
    return Equations(
        signals=raw,
        parameters=ca.vertcat(*symbols.parameters.values()),
        memory=ca.vertcat(*states) if states else ca.SX(0, 1),
        clock=symbols.clock,
        drive=drive,
        motor_acceleration=s.motor_acceleration,
        link_acceleration=s.link_acceleration,
        motor_resistance=motor_resistance,
        link_resistance=builder.total("link", beyond),
        transmitted=builder.total("transmission", view),
        torque=s.torque,
        torsion=torsion,
        beyond={
            t: builder.seen(t, view, beyond_gap).torsion
            for t in model.terms
            if t.place == "transmission"
        },
        true_motor_position=s.motor_position,
        true_link_position=s.link_position,
        motor_lever=motor_lever,
        link_lever=link_lever,
        inertia=inertia,
        load_lag=lag,
        memory_terms=tuple(terms),
    )


def carried(
    model: Structure, symbols: Symbols, twist: Expression, rate: Expression
) -> tuple[Expression, Expression]:
    """Torque of the transmission at a twist and a rate that are symbols, everything else as read;
    and the rate as read.

    Parameters
    ----------
    model : Structure
    symbols : Symbols
    twist, rate : SX
        Symbols that stand for the torsion and its rate.
    """
    builder = _Builder(model, symbols)
    s = builder.true_signals()
    bare = bare_twist(model, s)
    error = builder.total("torsion", _View(s, bare, s.torque, _zero(), _zero()))
    view = _View(s, bare - error, _zero(), _zero(), _zero())
    torque = builder.total("transmission", replace(view, torsion=twist), rate)
    return torque, builder.torsion_rate(view)


def swept(model: Structure, symbols: Symbols) -> tuple[Expression, Expression]:
    """Torque of the transmission in two parts, the second to be differentiated in time.

    The second is the damping times the part of its twist that is no straight line in the signals (a
    gap, a kinematic error): an average of its rate over a kernel needs no velocity, and a velocity
    smoothed over 30 ms knows nothing of a knock in a gap.

    Parameters
    ----------
    model : Structure
    symbols : Symbols

    Returns
    -------
    still [N.m] and swept [N.m.s], with ``transmitted = still + d(swept)/dt``
    """
    builder, raw = _Builder(model, symbols), symbols.signals
    s = builder.true_signals()
    twist = bare_twist(model, s)
    torsion = twist - builder.total("torsion", _View(s, twist, s.torque, _zero(), _zero()))
    view = _View(s, torsion, _zero(), _zero(), _zero())
    load = builder.load(view)
    view = replace(view, load=load)
    beyond, rate = builder.beyond(view), ca.SX.sym("rate")
    states = ca.vertcat(*(z for zs in symbols.memory.values() for z in zs))
    varying = ca.vertcat(raw.vector(), states, rate)
    affine, names = AffineParts(raw.vector(), states), Signals.names()
    still, moved = _zero(), _zero()
    for t in model.terms:
        if t.place != "transmission":
            continue
        own, values = builder.seen(t, view, beyond), t.bound(symbols.parameters)
        now = builder.torsion_rate(own)
        slope = ca.jacobian(t.effect.law(builder.local(t, own, rate), values), rate)
        straight, bent = affine.split(builder.turned(own))
        if not (slope.is_zero() or bent.is_zero() or ca.depends_on(slope, varying)):
            rates = ((by, _RATES.get(names[i])) for i, by in straight.items())
            # the rate of a rate times a skew is of second order, as in `torsion_rate`
            now = sum((by * getattr(raw, rate) for by, rate in rates if rate), _zero())
            moved = moved + slope * bent
        still = still + t.effect.law(builder.local(t, own, now), values)
    return still, moved


@final
@dataclass(frozen=True)
class PlacedLaw:
    """One term's law on the model's symbols, with the torsion and its rate left as symbols.

    Attributes
    ----------
    term : Term
    law : expression
    states : tuple of expression
        Its internal states.
    moved : tuple of expression
        The states after the driving coordinate has moved by `step` in the time `clock`.
    step : expression
        Symbol of that step.
    """

    term: Term
    law: Expression
    states: tuple[Expression, ...]
    moved: tuple[Expression, ...]
    step: Expression


def placed_laws(
    model: Structure, symbols: Symbols, torsion: Expression, torsion_rate: Expression
) -> tuple[PlacedLaw, ...]:
    """Every law of a model in its place, on true signals.

    Parameters
    ----------
    model : Structure
    symbols : Symbols
    torsion, torsion_rate : expression
        Stand for the twist of the transmission and its rate in the laws outside ``torsion``.
    """
    builder, s = _Builder(model, symbols), symbols.signals
    zero = _zero()
    outside = _View(s, torsion, zero, zero, zero)
    load = builder.load(outside)
    views = {
        "drive": _View(s, zero, zero, s.drive, s.drive_rate),
        "torsion": _View(s, bare_twist(model, s), s.torque, zero, zero),
        "motor_position_sensor": _View(s, zero, zero, s.motor_position, s.motor_velocity),
        "link_position_sensor": _View(s, zero, zero, s.link_position, s.link_velocity),
        "torque_sensor": _View(s, zero, zero, s.torque, s.torque_rate),
    }
    found = []
    gap = builder.beyond(outside)
    twist = ca.SX.sym("twist")  # where the laws are asked at a number, a derivative needs a symbol
    taken = builder.beyond(replace(outside, torsion=twist)).taken
    slope = ca.substitute(1 - ca.jacobian(taken, twist), twist, torsion)
    for term in model.terms:
        view = views.get(term.place, replace(outside, load=load))
        behind = builder.seen(term, view, gap) is gap and gap is not outside
        if behind:
            view = replace(gap, load=load)
        local = builder.local(term, view)
        rate = torsion_rate * slope if behind else torsion_rate
        if term.place not in views:
            local = replace(local, torsion_rate=rate)
        if term.place == "transmission":
            local = replace(local, velocity=rate)
        values, step = term.bound(symbols.parameters), ca.SX.sym("step")
        memory = term.effect.memory
        moved = () if memory is None else memory(local.memory, step, local, values)
        found.append(PlacedLaw(term, term.effect.law(local, values), local.memory, moved, step))
    return tuple(found)


def inverse_dynamics(model: Solvable) -> Expression:
    """Right-hand sides of the equations of motion, (drive, 0): what a regressor reproduces."""
    e = model.equations
    if model.is_elastic:
        motor = (
            e.inertia["motor_inertia"] * e.motor_acceleration
            + e.motor_resistance
            + e.transmitted * e.motor_lever
        )
        link = (
            e.inertia["link_inertia"] * e.link_acceleration
            + e.link_resistance
            - e.transmitted * e.link_lever
        )
        link = link - e.signals.coupling_torque
        return ca.vertcat(motor - (e.drive - e.signals.drive), link)
    inertia = sum(e.inertia.values())
    resistance = e.motor_resistance + e.link_resistance
    return (
        inertia * e.motor_acceleration
        + resistance
        - (e.drive - e.signals.drive)
        - e.signals.coupling_torque
    )


def linear_set(model: Solvable) -> tuple[str, ...]:
    """Largest set of parameters that enter the equations of motion jointly linearly."""
    chosen = jointly_linear(ca.vertcat(inverse_dynamics(model)), model.equations.parameters)
    return tuple(model.parameter_names[i] for i in chosen)


def jointly_linear(rows: Expression, p: Expression) -> tuple[int, ...]:
    """Greedy largest independent set of the graph whose edges are non-zero mutual Hessian entries.

    Parameters
    ----------
    rows : column of expressions
    p : column of symbols

    Returns
    -------
    tuple of int
        Places in `p`, rising; parameters that no row depends on are not among them.
    """
    edges: dict[int, set[int]] = {i: set() for i in range(p.numel())}
    for row in ca.vertsplit(rows):
        # a comparison has a derivative that is zero everywhere: no edge
        sparsity = ca.sparsify(ca.hessian(row, p)[0]).sparsity()
        for i, j in zip(*sparsity.get_triplet(), strict=True):
            edges[i].add(j)
    present = set(ca.jacobian(rows, p).sparsity().get_triplet()[1])
    chosen = {i for i in edges if i in present and i not in edges[i]}
    while True:
        degree = {i: len(edges[i] & chosen) for i in chosen}
        worst = max(degree, key=lambda i: (degree[i], i), default=None)
        if worst is None or degree[worst] == 0:
            return tuple(sorted(chosen))
        chosen.discard(worst)
