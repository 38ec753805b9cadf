"""Declaration of a physical effect and the registry of all of them.

An effect is one decorated function. Everything else (torque, regressor, Jacobian, simulation,
diagnosis candidate, FMU variable, row of the documentation) follows from it.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import pkgutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Final, Literal, final

from .parameter import Parameter, Side
from .signals import Expression, LocalSignals

Place = Literal[
    "motor",
    "link",
    "transmission",
    "torsion",
    "drive",
    "torque_sensor",
    "motor_position_sensor",
    "link_position_sensor",
]
Family = Literal["friction", "torque", "transmission", "sensor", "inertia"]
Law = Callable[[LocalSignals, SimpleNamespace], Expression]
Potential = Law
Rate = Callable[[tuple[Expression, ...], LocalSignals, SimpleNamespace], tuple[Expression, ...]]
Update = Callable[[tuple[Expression, ...], Expression, LocalSignals, SimpleNamespace], tuple[Expression, ...]]

# the side the values are referred to, not the place where the effect acts: the name says that
PLACE_SIDE: Final[dict[str, Side]] = {
    "motor": "link",
    "link": "link",
    "transmission": "link",
    "torsion": "link",
    "drive": "link",
    "torque_sensor": "sensor",
    "motor_position_sensor": "sensor",
    "link_position_sensor": "sensor",
}


@final
@dataclass(frozen=True)
class Effect:
    """A physical effect: a law, its parameters, where it acts and how it is recognised.

    What the law returns depends on the place it acts on:
    ``motor``, ``link``: torque that resists the motion of that side (subtracted) [N.m];
    ``transmission``: torque added to what the transmission carries [N.m];
    ``torsion``: angle taken off the torsion [rad];
    ``drive``: torque added to n Km I [N.m];
    ``..._sensor``: true value minus reading, in the unit of the channel.

    Attributes
    ----------
    key, title : str
        Name in files and on the command line; name in a sentence.
    family : {"friction", "torque", "transmission", "sensor", "inertia"}
        Friction effects dissipate; torque effects depend on position only.
    acts_on : tuple of str
        Places where the effect may act; each is a candidate of its own.
    parameters : tuple of Parameter
        Amplitudes and shape parameters, without the place.
    law : callable
        ``law(signals, parameters)`` in CasADi operations.
    memory : callable or None
        ``memory(z, step, signals, parameters)``: the internal states after the driving coordinate
        (position, or torsion) has moved by `step`. Holds for any step, so that simulation,
        identification and the continuous form share it. A memory that also runs with time reads the
        duration of the step from ``signals.clock``.
    rate : callable or None
        ``rate(z, signals, parameters)``: the continuous form dz/dt that belongs to `memory`. Without
        it the step form is differentiated over :data:`casadi_models.joint.MEMORY_STEP`.
    potential : callable or None
        ``potential(signals, parameters)``: energy stored by a law that depends on position or torsion
        only, 0 at zero; its derivative is the law [J]. Without it the law is integrated numerically.
    states : int
        Number of internal states.
    absence, excitation : str
        How a model without the effect fails; what motion shows it.
    confused_with : tuple of str
        Keys of effects that data often cannot tell apart from it.
    needs : tuple of str
        Keys of effects that must be in the model first.
    needs_load : bool
        True where the law uses the load.
    dissipative : bool
        True where the law, with parameters inside their bounds, never gives energy.
    periodic : bool
        True for a line at an order of the motor turn (own claim rule).
    angular : bool
        True for sine and cosine of the position: no law of a linear axis.
    separate_by : str
        The run that separates it from what it is confused with.
    formerly : tuple of str
        Keys of effects of older files that are part of this one.
    candidate : bool
        False for another form of an effect of the library: used when it is named, not proposed by a
        diagnosis.
    source : str
        Equation or paper.
    """

    key: str
    title: str
    family: Family
    acts_on: tuple[Place, ...]
    parameters: tuple[Parameter, ...]
    law: Law
    absence: str
    excitation: str
    source: str
    memory: Update | None = None
    rate: Rate | None = None
    states: int = 0
    potential: Potential | None = None
    confused_with: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()
    needs_load: bool = False
    dissipative: bool = False
    periodic: bool = False
    angular: bool = False
    separate_by: str = ""
    formerly: tuple[str, ...] = ()
    candidate: bool = True

    def __post_init__(self) -> None:
        if (self.memory is None) != (self.states == 0):
            raise ValueError(f"effect {self.key!r}: states need a memory, and a memory needs states")
        if self.rate is not None and self.memory is None:
            raise ValueError(f"effect {self.key!r}: a rate needs its step form, memory")

    @property
    def amplitudes(self) -> tuple[Parameter, ...]:
        """Parameters whose value 0 means that the effect is absent."""
        return tuple(p for p in self.parameters if not p.is_shape)

    @property
    def shapes(self) -> tuple[Parameter, ...]:
        """Parameters that are searched on a grid."""
        return tuple(p for p in self.parameters if p.is_shape)

    def parameter_names(self, place: Place) -> tuple[str, ...]:
        """Names in a model: the place comes first where the effect may act on several."""
        prefix = f"{place}_" if len(self.acts_on) > 1 else ""
        return tuple(prefix + p.name for p in self.parameters)

    def placed(self, place: Place) -> tuple[Parameter, ...]:
        """The parameters as they stand in a model with the effect in `place`."""
        names = self.parameter_names(place)
        return tuple(p.renamed(name, PLACE_SIDE[place]) for p, name in zip(self.parameters, names, strict=True))


class Registry(Mapping[str, Effect]):
    """The effect library by key; filled when :mod:`casadi_models.effects` is imported."""

    def __init__(self) -> None:
        self._effects: dict[str, Effect] = {}
        self._loaded: dict[Path, tuple[str, ...]] = {}
        self._former: dict[str, str] = {}

    def __getitem__(self, key: str) -> Effect:
        try:
            return self._effects[self._former.get(key, key)]
        except KeyError:
            near = difflib.get_close_matches(str(key), self._effects, 1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            raise KeyError(f"unknown effect {key!r}{hint}; known: {', '.join(sorted(self._effects))}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._effects)

    def __len__(self) -> int:
        return len(self._effects)

    def add(self, effect: Effect) -> None:
        """Register an effect; a key that exists already is an error."""
        if effect.key in self._effects:
            raise ValueError(f"effect {effect.key!r} is registered already")
        self._effects[effect.key] = effect
        self._former.update(dict.fromkeys(effect.formerly, effect.key))

    def is_former(self, key: str) -> bool:
        """True for the key of an effect that is part of another one now."""
        return key in self._former

    def load(self, path: Path) -> tuple[str, ...]:
        """Run a user's Python file that declares effects; returns its keys.

        A file that is loaded again replaces what it declared before; one that fails leaves nothing behind.
        """
        where = path.resolve()
        spec = importlib.util.spec_from_file_location(f"irj_user_effects_{path.stem}", path)
        if spec is None or spec.loader is None:
            raise ValueError(f"{path}: not a Python file")
        kept = dict(self._effects)
        for key in self._loaded.get(where, ()):
            self._effects.pop(key, None)
        before = set(self._effects)
        try:
            spec.loader.exec_module(importlib.util.module_from_spec(spec))
        except BaseException:
            self._effects = kept
            raise
        self._loaded[where] = tuple(sorted(set(self._effects) - before))
        return self._loaded[where]


EFFECTS: Final = Registry()


def effect(
    key: str,
    *,
    title: str,
    family: Family,
    acts_on: tuple[Place, ...],
    parameters: tuple[Parameter, ...],
    absence: str,
    excitation: str,
    source: str,
    memory: Update | None = None,
    rate: Rate | None = None,
    states: int = 0,
    potential: Potential | None = None,
    confused_with: tuple[str, ...] = (),
    needs: tuple[str, ...] = (),
    needs_load: bool = False,
    dissipative: bool = False,
    periodic: bool = False,
    angular: bool = False,
    separate_by: str = "",
    formerly: tuple[str, ...] = (),
    candidate: bool = True,
) -> Callable[[Law], Law]:
    """Declare and register the decorated law as an effect (see :class:`Effect` for the arguments)."""

    def register(law: Law) -> Law:
        EFFECTS.add(
            Effect(
                key=key, title=title, family=family, acts_on=acts_on, parameters=parameters, law=law, absence=absence,
                excitation=excitation, source=source, memory=memory, rate=rate, states=states, potential=potential,
                confused_with=confused_with, needs=needs, needs_load=needs_load, dissipative=dissipative,
                periodic=periodic, angular=angular, separate_by=separate_by, formerly=formerly, candidate=candidate,
            )
        )  # fmt: skip
        return law

    return register


def load_library() -> None:
    """Import every module of :mod:`casadi_models.effects`, which registers the effects."""
    from . import effects

    for module in pkgutil.iter_modules(effects.__path__):
        importlib.import_module(f"{effects.__name__}.{module.name}")
