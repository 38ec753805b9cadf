"""The joint: inertias, a transmission and effects, turned into CasADi functions.

One energy-consistent sign convention holds everywhere (all quantities link-referred)::

    d  = q_m - q_l - err(q)                         torsion
    J_m q_m'' = n K_m I - T (1 - d err/d q_m) - f_motor
    J_l q_l'' = T (1 + d err/d q_l) - f_link
    T  = sum of the transmission laws of d, d'

A rigid model has one degree of freedom, q_m = q_l.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, Final, final

from .effect import EFFECTS
from .equations import (
    Equations,
    Symbols,
    build_equations,
    inverse_dynamics,
    linear_set,
    time_derivative,
)
from .functions import MEMORY_STEP, JointFunctions
from .parameter import Parameter, Role
from .sides import side_factor
from .term import (
    CALIBRATION,
    INERTIAS,
    LOAD_COMPLIANCE,
    LOAD_DAMPING,
    SIDE_INERTIAS,
    SWINGING_SHARE,
    TOTAL_INERTIA,
    Term,
    smoothing,
)
from .text.shown import shown
from .transmission import MODELS, STARTS, signed_ratio

__all__ = ["MEMORY_STEP", "Equations", "JointModel", "Term", "inverse_dynamics", "time_derivative"]

_FRICTION_SIDES: Final = ("motor", "link")
TWIST: Final = "transmission_compliance"
"""Effect by which the transmission twists at all."""
_NUMBER: Final = re.compile(r"0|[1-9][0-9]{0,2}", re.ASCII)
"""Which of several effects of one kind; 0 belongs to a record, not to the joint."""
SHOWN: Final = 22
"""Parameters that `print` shows: the whole text stays within 25 lines."""


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
    load_from : {"torque", "motion", "gravity"}
        What presses the gear's teeth in load-dependent laws: the torque, what gravity and the
        link's inertia ask for, or gravity alone where that inertia has no name of its own.
    clamped_link : bool
        True for a torque-against-displacement test: the torsion is the position itself.
    lagging_load : bool
        True for a geared joint seen from the motor side: the link hangs on a compliance and its
        position is not recorded.
    calibration : tuple of str
        Calibration unknowns of the sensors (keys of :data:`casadi_models.hold.UNKNOWNS`): in the
        readings only, no physics.
    name : str
        Name in reports.
    """

    gear_ratio: float = 1.0
    terms: tuple[Term, ...] = ()
    inertias: tuple[str, ...] = SIDE_INERTIAS
    values: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    kind: str = "rotary"
    virtual_work: bool = True
    load_from: str = "torque"
    clamped_link: bool = False
    lagging_load: bool = False
    calibration: tuple[str, ...] = ()
    name: str = "joint"

    def __repr__(self) -> str:
        set_values = f", {len(self.values)} values set" if self.values else ""
        return (
            f"JointModel({self.name!r}, {self.kind}, gear ratio {self.gear_ratio:g}, effects: "
            f"{', '.join(self.effects) or 'none'}{set_values})"
        )

    def __str__(self) -> str:
        values = dict(zip(self.parameter_names, self.value_vector(), strict=True))
        units = {p.name: p.unit for p in self.parameters}
        lines = [repr(self)]
        lines += [
            f"  {name:<28} {value:.6g} {units[name]}"
            for name, value in list(values.items())[:SHOWN]
        ]
        if len(values) > SHOWN:
            lines.append(f"  and {len(values) - SHOWN} more parameters")
        return "\n".join(lines)

    @staticmethod
    def by_name(
        name: str, gear_ratio: float, *, kind: str = "rotary", effects: tuple[str, ...] = ()
    ) -> JointModel:
        """A model by name (:data:`casadi_models.transmission.MODELS`), with further effects.

        Parameters
        ----------
        name : str
            ``hd1`` to ``hd4``, ``irj1a``, ``irj1b``, ``irj2a``, ``irj2b``, ``irj_ts``.
        gear_ratio : float
            theta_motor / theta_link, signed.
        kind : {"rotary", "linear"}
        effects : tuple of str
            Labels as in :meth:`add`; one that the model has already is passed over.

        Raises
        ------
        KeyError
            Unknown model.
        """
        model = JointModel(gear_ratio=gear_ratio, kind=kind)
        if name not in MODELS:
            raise KeyError(f"unknown model {name!r}; known: {', '.join(MODELS)}")
        for label in (*MODELS[name], *effects):
            there = "#" not in label and model.has_form_of(label)
            if there or label in model.effects or (label in EFFECTS and model.has(label)):
                continue
            model = model.add(label)
        known = set(model.parameter_names)
        return model.with_values({n: v for n, v in STARTS.get(name, {}).items() if n in known})

    @staticmethod
    def harmonic_drive(
        number: int | str, *, gear_ratio: float = -160.0, configuration: str | int = "IRJ"
    ) -> JointModel:
        """Harmonic-drive model 1 to 4 of the thesis (section 2.4 to 2.6).

        Model 1 is ideal; 2 adds losses; 3 adds stiffness and structural damping; 4 adds the
        kinematic error at 1, 2 and 4 per turn of the wave generator. Friction beyond model 2 is
        added by name.

        Parameters
        ----------
        number : int or str
            1 to 4, or ``"hd1"`` to ``"hd4"`` as the joint files call them.
        gear_ratio : float
            The reduction; with configuration IRJ its sign is kept.
        configuration : {"1", "2", "IRJ"}
            Gives the sense of rotation.
        """
        name = number if isinstance(number, str) else f"hd{number}"
        if name not in ("hd1", "hd2", "hd3", "hd4"):
            raise ValueError(f"harmonic-drive model {number}: use 1, 2, 3 or 4")
        if str(configuration) != "IRJ":
            gear_ratio = signed_ratio(configuration, abs(gear_ratio))
        return JointModel.by_name(name, gear_ratio)

    # --- composition ------------------------------------------------------------------------------

    def add(self, label: str) -> JointModel:
        """The model with one more effect.

        Parameters
        ----------
        label : str
            Effect key, ``key@place``, or ``key#2`` for a second one with its own parameters. A key
            alone goes to the effect's first place, or to all where its declaration says so (viscous
            and Coulomb friction).

        Raises
        ------
        KeyError, ValueError
            Unknown key; place where the effect cannot act; effect that is in the model already.
        """
        new = [t for t in self._parse(label) if t not in self.terms]
        if not new and EFFECTS.is_former(label):
            return self
        if not new:
            raise ValueError(f"effect {label!r} is in the model already")
        if self.has_form_of(label.partition("#")[0]):
            raise ValueError(f"effect {label!r} is in the model already, in another form")
        return replace(self, terms=(*self.terms, *new))

    def drop(self, label: str) -> JointModel:
        """The model without an effect (``key`` drops it in every place, ``key@place`` in one)."""
        kept = tuple(t for t in self.terms if label not in (t.label, t.effect.key))
        if len(kept) == len(self.terms):
            raise ValueError(f"effect {label!r} is not in the model")
        return replace(self, terms=kept)

    def with_values(self, values: Mapping[str, float]) -> JointModel:
        """The model with other parameter values; unknown names are an error.

        Calibration unknowns of single records (``name[run]``, as they stand beside the parameters
        in a fit) are left out.
        """
        known = {p.name for p in self.parameters}
        values = {
            n: x
            for n, x in values.items()
            if n in known or n.partition("[")[0] not in self.calibration
        }
        for name in values:
            if name not in known:
                raise ValueError(
                    f"no parameter {name!r} in the model; it has {', '.join(sorted(known))}"
                )
        return replace(self, values=MappingProxyType({**self.values, **values}))

    def _parse(self, label: str) -> list[Term]:
        bare, _, number = label.partition("#")
        key, _, place = bare.partition("@")
        found = EFFECTS[key]
        instance = int(number) if _NUMBER.fullmatch(number) else 1
        if ("#" in label and not _NUMBER.fullmatch(number)) or ("@" in bare and not place):
            raise ValueError(
                f"effect {label!r} is not understood; write {key}, {key}@{found.acts_on[0]}, or "
                f"{key}#2 for a second one"
            )
        if place:
            if place not in found.acts_on:
                raise ValueError(
                    f"effect {key!r} acts on {', '.join(found.acts_on)}, not on {place!r}"
                )
            return [Term(found, p, instance) for p in found.acts_on if p == place]
        everywhere = found.everywhere and self.inertias != TOTAL_INERTIA
        return [
            Term(found, p, instance) for p in (found.acts_on if everywhere else found.acts_on[:1])
        ]

    def has(self, key: str, place: str | None = None) -> bool:
        """True where the effect is in the model (in `place`, if given)."""
        return any(t.effect.key == key and place in (None, t.place) for t in self.terms)

    def has_form_of(self, label: str) -> bool:
        """True where another form of the effect, with parameters of the same names, is in the
        model: in its place, or in any where the label names none.
        """
        key, _, place = label.partition("@")
        first = EFFECTS[key]
        names = {n for p in first.acts_on if p == (place or p) for n in first.parameter_names(p)}
        return any(t.effect is not first and names & set(t.names) for t in self.terms)

    @property
    def is_elastic(self) -> bool:
        """True where motor and link move separately."""
        return self.has(TWIST)

    @property
    def knows_load(self) -> bool:
        """True where the model says what presses the gear's teeth without a torque sensor: a
        torque of the link's position, or the motion of a link that is measured.
        """
        moved = self.load_from == "motion" and not self.lagging_load
        return moved or any(t.place == "link" and t.effect.family == "torque" for t in self.terms)

    @property
    def structure(self) -> tuple[object, ...]:
        """All that shapes the equations, without the values: equal for models that differ in
        values only.
        """
        forms = (
            self.virtual_work,
            self.load_from,
            self.clamped_link,
            self.lagging_load,
            self.calibration,
        )
        return (self.gear_ratio, self.terms, self.inertias, self.kind, *forms)

    def swinging_inertia(self, values: Mapping[str, Any]) -> Any:
        """What hangs on the compliance of a lagging load [kg.m2], from numbers or symbols."""
        return (
            values["link_inertia"]
            if "link_inertia" in self.inertias
            else values["swinging_share"] * values["inertia"]
        )

    def load_compliance(self, values: Mapping[str, Any]) -> Any:
        """Compliance on which a link that is not recorded hangs [rad/(N.m)], 0 where there is
        none.
        """
        return values[LOAD_COMPLIANCE.name] if self.lagging_load else 0.0

    def load_relaxation(self, values: Mapping[str, Any]) -> Any:
        """Time in which the damping beside that compliance lets its twist follow the torque [s],
        from numbers or symbols; 0 where there is none.
        """
        if not self.lagging_load:
            return 0.0
        return values[LOAD_COMPLIANCE.name] * values[LOAD_DAMPING.name]

    @cached_property
    def _places(self) -> Mapping[str, str]:
        """Place of each parameter; that of a smoothing velocity is its side, the joint's own
        have none.
        """
        sides = {smoothing(side).name: side for side in _FRICTION_SIDES}
        return {
            **dict.fromkeys(self.parameter_names, ""),
            **sides,
            **{n: t.place for t in self.terms for n in t.names},
        }

    def named(self, role: Role, place: str | None = None) -> tuple[str, ...]:
        """Names of the parameters with a role, of all places or of one (see :class:`Parameter`)."""
        return tuple(
            p.name
            for p in self.parameters
            if p.role == role and place in (None, self._places[p.name])
        )

    @property
    def weights(self) -> tuple[str, ...]:
        """Names of the torques of the link's weight: the part that is all of it in a link upright
        at zero, and that of one level there.
        """
        return tuple(
            name
            for term in self.terms
            if any(p.role == "weight" for p in term.parameters)
            for name, p in zip(term.names, term.parameters, strict=True)
            if not p.is_shape
        )

    @property
    def stiffness_name(self) -> str | None:
        """Name of the linear stiffness of the transmission, None for a rigid model."""
        return next(iter(self.named("stiffness")), None)

    def usual_values(self) -> dict[str, float]:
        """A value of every parameter: that of the model, else the typical size, else the start."""
        out = {}
        for p in self.parameters:
            usual = p.usual(self._places[p.name])
            out[p.name] = float(self.values.get(p.name, p.start if usual is None else usual))
        return out

    @property
    def effects(self) -> tuple[str, ...]:
        """Labels of the effects in the model."""
        return tuple(t.label for t in self.terms)

    # --- parameters -------------------------------------------------------------------------------

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters: inertias, those of the terms, smoothing velocities; each once."""
        found: dict[str, Parameter] = {n: INERTIAS[n] for n in self.inertias}
        if self.lagging_load:
            found[LOAD_COMPLIANCE.name] = LOAD_COMPLIANCE
            if "link_inertia" not in self.inertias:
                found[SWINGING_SHARE.name] = SWINGING_SHARE
            found[LOAD_DAMPING.name] = LOAD_DAMPING
        found.update({n: CALIBRATION[n].parameter for n in self.calibration if n in CALIBRATION})
        for term in self.terms:
            found.update({p.name: p for p in term.parameters})
        for place in _FRICTION_SIDES:
            if any(t.place == place and t.effect.family == "friction" for t in self.terms):
                found[smoothing(place).name] = smoothing(place)
        return tuple(p.for_kind(self.kind) for p in found.values())

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names in the order of the parameter vector."""
        return tuple(p.name for p in self.parameters)

    def side_factor(self, name: str) -> float:
        """What a motor-side value of a parameter is multiplied by to refer it to the link.

        Raises
        ------
        KeyError
            No such parameter in the model.
        """
        for term in self.terms:
            for own, there in zip(term.effect.parameters, term.names, strict=True):
                if there == name:
                    return side_factor(term.effect, own, self.gear_ratio)
        found = next((p for p in self.parameters if p.name == name), None) or INERTIAS[name]
        return side_factor(None, found, self.gear_ratio)

    def value_vector(self) -> list[float]:
        """Parameter values in the order of :attr:`parameter_names`."""
        return [float(self.values.get(p.name, p.start)) for p in self.parameters]

    # --- equations --------------------------------------------------------------------------------

    @cached_property
    def equations(self) -> Equations:
        """The symbolic joint on readings: what the sensors add is taken off (built once per
        model).
        """
        return build_equations(self, self.symbols, sensors=True)

    @cached_property
    def true_equations(self) -> Equations:
        """The symbolic joint on true signals, on the same symbols: what a simulation integrates."""
        return build_equations(self, self.symbols, sensors=False)

    @cached_property
    def symbols(self) -> Symbols:
        """The symbols that all forms of the equations share."""
        return Symbols.of(self)

    def _repr_latex_(self) -> str:
        """The equations and values in a notebook (see :mod:`casadi_models.text.shown`)."""
        return shown(self, "latex")

    @cached_property
    def linear_parameters(self) -> tuple[str, ...]:
        """Largest set of parameters that enter the equations of motion jointly linearly."""
        return linear_set(self)

    @cached_property
    def functions(self) -> Any:
        """CasADi functions of the joint (see :mod:`casadi_models.functions`).

        An elastic joint that moves by its own equations knows the torque of its gear, which is the
        load of it whatever a record of its motion may show.
        """
        blind = self.is_elastic and self.load_from == "motion"
        return JointFunctions(replace(self, load_from="torque") if blind else self)

    @property
    def dynamics(self) -> Any:
        """CasADi function (x, u, p) -> dx/dt."""
        return self.functions.dynamics

    @property
    def regressor(self) -> Any:
        """CasADi function (x, a, u, p) -> (Y, rest) with Y theta_linear + rest = inverse
        dynamics.
        """
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
