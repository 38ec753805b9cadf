"""Declaration of a physical effect and the registry of all of them.

An effect is one decorated function. Everything else (torque, regressor, Jacobian, simulation,
diagnosis candidate, FMU variable, row of the documentation) follows from it.
"""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import importlib
import math
import pkgutil
import re
import signal
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from types import CodeType, FrameType, ModuleType, SimpleNamespace
from typing import Any, Final, Literal, final, get_args

import casadi as ca

from .parameter import Parameter, Side
from .quantities import UnitError, side_power
from .signals import Expression, LocalSignals
from .table import Table

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
Update = Callable[
    [tuple[Expression, ...], Expression, LocalSignals, SimpleNamespace], tuple[Expression, ...]
]

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


Stage = Literal["structure", "plain", "law", "late"]
_KEY: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
"""What stands in joint files and on the command line, and begins names of parameters."""
TORQUE_SENSOR: Final = "torque sensor"
SECOND_BALANCE: Final = "second balance"
ANYTHING_KNOWN: Final = "anything known"
"""Conditions of a :class:`Requirement` beside names of known parameters."""


@final
@dataclass(frozen=True)
class Requirement:
    """What must be there so that an effect can be told from the rest of the model.

    Attributes
    ----------
    any_of : tuple of str
        Names of parameters, one of which must stand in [known]; or one of `TORQUE_SENSOR`,
        `SECOND_BALANCE` and `ANYTHING_KNOWN`.
    why : str
        What is said where nothing of it is there: why it cannot be told, and what to give.
    """

    any_of: tuple[str, ...]
    why: str

    def met(self, there: Collection[str]) -> bool:
        """True where one of the conditions is among those that hold."""
        return any(c in there for c in self.any_of)


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
        ``rate(z, signals, parameters)``: the continuous form dz/dt that belongs to `memory`.
        Without it the step form is differentiated over :data:`casadi_models.joint.MEMORY_STEP`.
    potential : callable or None
        ``potential(signals, parameters)``: energy stored by a law that depends on position or
        torsion only, 0 at zero; its derivative is the law [J]. Without it the law is integrated
        numerically.
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
    requires : tuple of Requirement
        What must be known or recorded so that it can be told from the rest of the model.
    contains : tuple of str
        Keys of simpler effects that this law holds as a special case: they explain nothing beside
        it.
    parts : tuple of str
        Keys of effects that this one sums up: proposed on a rigid model without any of them only.
    stage : {"structure", "plain", "law", "late"}
        Order in which significant candidates are taken: a change of the joint's structure that the
        positions themselves show; a plain law, before richer ones that gain less than twice as
        much; any other law; one with free dynamics of its own, which fits a little of anything,
        when nothing else is left.
    common : bool
        True for an effect that hardly a joint is without: named first in a set, and at a smaller
        fall.
    several_valleys : bool
        True where a fit of its shapes has several minima: it starts from several points.
    takes_up : callable or None
        ``takes_up(signals, parameters)``: twist that a law of the transmission takes up before its
        other laws feel any, the linear stiffness and laws with memory apart; 0 where the law is
        absent.
    of_displacement : bool
        True for a law of the torsion that also makes sense on the position of an axis without gear.
    shapes_reversal : bool
        True where the smoothing velocity is part of the law and not a stand-in for a jump.
    everywhere : bool
        True where the key alone means all places.
    pairs : tuple of (str, str, str)
        Name, sine and cosine parameter of each pair that is also told as amplitude and phase.
    periodic : bool
        True for a line at an order of the motor turn (own claim rule).
    angular : bool
        True for sine and cosine of the position: no law of a linear axis.
    separate_by : str
        The run that separates it from what it is confused with.
    told_by : str
        What tells it from them where no motion does.
    formerly : tuple of str
        Keys of effects of older files that are part of this one.
    candidate : bool
        False for another form of an effect of the library: used when it is named, not proposed by a
        diagnosis.
    table : Table or None
        Variable and parameters of a law that is a table and no formula.
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
    told_by: str = ""
    formerly: tuple[str, ...] = ()
    candidate: bool = True
    requires: tuple[Requirement, ...] = ()
    contains: tuple[str, ...] = ()
    parts: tuple[str, ...] = ()
    stage: Stage = "law"
    common: bool = False
    several_valleys: bool = False
    takes_up: Law | None = None
    of_displacement: bool = False
    shapes_reversal: bool = False
    everywhere: bool = False
    pairs: tuple[tuple[str, str, str], ...] = ()
    table: Table | None = None

    def __post_init__(self) -> None:
        if (self.memory is None) != (self.states == 0):
            raise ValueError(
                f"effect {self.key!r}: states need a memory, and a memory needs states"
            )
        if self.rate is not None and self.memory is None:
            raise ValueError(f"effect {self.key!r}: a rate needs its step form, memory")

    @property
    def related(self) -> tuple[str, ...]:
        """Keys of all effects that the declaration refers to."""
        return (*self.confused_with, *self.needs, *self.contains, *self.parts)

    @property
    def is_delay(self) -> bool:
        """True for a channel that is late: its amplitude is the time."""
        return any(p.role == "delay" for p in self.parameters)

    @cached_property
    def reads(self) -> frozenset[str]:
        """Names of the signals (of :class:`LocalSignals`) that the law uses."""
        local, values = self._symbols()
        found = ca.SX(self.law(local, values))
        names = (f.name for f in fields(LocalSignals) if f.name != "memory")
        return frozenset(n for n in names if ca.depends_on(found, getattr(local, n)))

    @property
    def warms(self) -> bool:
        """True for a law of the temperature."""
        return "temperature" in self.reads

    def check(self) -> None:
        """Try the declaration symbolically: what is only found out in the middle of a fit is said
        here.

        Raises
        ------
        ValueError
            A place, family or stage that does not exist; a unit that is not known; a law, memory or
            rate that returns anything but scalar expressions.
        """
        where = f"effect {self.key!r}"
        if not isinstance(self.key, str) or _KEY.fullmatch(self.key) is None:
            raise ValueError(f"{where}: a key has letters, digits and underscores, as my_friction")
        if self.key in self.needs:
            raise ValueError(f"{where}: needs itself, so it could never be added")
        for word, found, known in (
            *(("place", place, get_args(Place)) for place in self.acts_on),
            ("family", self.family, get_args(Family)),
            ("stage", self.stage, get_args(Stage)),
        ):
            if found not in known:
                raise ValueError(f"{where}: no {word} {found!r}; use one of {', '.join(known)}")
        if not isinstance(self.acts_on, tuple) or not self.acts_on:
            raise ValueError(f"{where}: acts_on must be a tuple of places, as ('motor',)")
        names = [p.name for p in self.parameters]
        for p in self.parameters:
            if names.count(p.name) > 1:
                raise ValueError(f"{where}: two parameters are called {p.name!r}; rename one")
            try:
                side_power(p.unit)
            except UnitError as error:
                raise ValueError(f"{where}: parameter {p.name!r}: {error}") from None
        local, values = self._symbols()
        law = self.law(local, values)
        _scalar(law, f"{where}: its law")
        _known_only(ca.SX(law), local, values, f"{where}: its law")
        if self.potential is not None:
            _scalar(self.potential(local, values), f"{where}: its potential")
        if self.memory is not None:
            self._check_states(
                "memory", self.memory(local.memory, ca.SX.sym("step"), local, values)
            )
        if self.rate is not None:
            self._check_states("rate", self.rate(local.memory, local, values))

    def _check_states(self, name: str, found: object) -> None:
        where = f"effect {self.key!r}: its {name}"
        if not isinstance(found, tuple | list) or len(found) != self.states:
            raise ValueError(
                f"{where} must return a tuple of {self.states} expression(s), one a state"
            )
        for entry in found:
            _scalar(entry, where)

    def _symbols(self) -> tuple[LocalSignals, SimpleNamespace]:
        """Free symbols for all that a law may use."""
        symbols = {f.name: ca.SX.sym(f.name) for f in fields(LocalSignals) if f.name != "memory"}
        states = tuple(ca.SX.sym(f"z{i}") for i in range(self.states))
        values = SimpleNamespace(**{p.name: ca.SX.sym(p.name) for p in self.parameters})
        return LocalSignals(memory=states, **symbols), values

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
        return tuple(
            p.renamed(name, PLACE_SIDE[place])
            for p, name in zip(self.parameters, names, strict=True)
        )


@final
@dataclass(frozen=True)
class EffectFile:
    """A user's file that declares effects: where it lies, its SHA-256, what it declares, and
    the code that was run.
    """

    path: Path
    sha256: str
    keys: tuple[str, ...]
    code: bytes = field(repr=False)


@final
@dataclass
class _Typed:
    """Effects that were typed as text, by key, each with a file that declares it."""

    effects: dict[str, Effect] = field(default_factory=dict)
    files: dict[str, EffectFile] = field(default_factory=dict)


class Registry(Mapping[str, Effect]):
    """The effect library by key; filled when :mod:`casadi_models.effects` is imported."""

    def __init__(self) -> None:
        self._effects: dict[str, Effect] = {}
        self._loaded: dict[Path, EffectFile] = {}
        self._former: dict[str, str] = {}
        self._everywhere = _Typed()
        self._scope: ContextVar[_Typed] = ContextVar("typed effects", default=self._everywhere)

    def __getitem__(self, key: str) -> Effect:
        name = self._former.get(key, key)
        found = self._effects.get(name) or self._scope.get().effects.get(name)
        if found is None:
            near = difflib.get_close_matches(str(key), list(self), 1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            raise KeyError(f"unknown effect {key!r}{hint}; known: {', '.join(sorted(self))}")
        return found

    def __iter__(self) -> Iterator[str]:
        return iter((*self._effects, *tuple(self._scope.get().effects)))

    def __len__(self) -> int:
        return len(self._effects) + len(self._scope.get().effects)

    @contextlib.contextmanager
    def scoped(self) -> Iterator[None]:
        """A part of the program with typed effects of its own.

        Inside, in this thread or task and in what is started with a copy of its context, the
        library is what was declared in Python and nothing that was typed as text elsewhere;
        what is typed inside is not seen outside, and is gone at the end.
        """
        before = self._scope.set(_Typed())
        try:
            yield
        finally:
            self._scope.reset(before)

    def add(self, effect: Effect) -> None:
        """Register an effect; a key that exists already is an error."""
        if effect.key in self:
            raise ValueError(f"effect {effect.key!r} is registered already")
        self._effects[effect.key] = effect
        self._former.update(dict.fromkeys(effect.formerly, effect.key))

    def is_former(self, key: str) -> bool:
        """True for the key of an effect that is part of another one now."""
        return key in self._former

    def hold(self, effect: Effect, code: bytes) -> None:
        """Register an effect that was typed as text; it takes the place of one typed before under
        the same key.

        Parameters
        ----------
        effect : Effect
        code : bytes
            Python source that declares it, for where the text is not at hand.
        """
        if effect.key in self._effects:
            raise ValueError(f"effect {effect.key!r} is in the library already; choose another key")
        digest = hashlib.sha256(code).hexdigest()
        typed = self._scope.get()
        typed.files[effect.key] = EffectFile(Path(f"{effect.key}.py"), digest, (effect.key,), code)
        typed.effects[effect.key] = effect

    @property
    def typed(self) -> tuple[EffectFile, ...]:
        """The effects that were typed as text, each as a file that declares it."""
        return tuple(self._scope.get().files.values())

    def forget(self, key: str) -> None:
        """Take an effect that was typed as text out of the library; any other key is an error."""
        typed = self._scope.get()
        if key not in typed.effects:
            raise ValueError(f"effect {key!r} was not typed as text")
        del typed.files[key], typed.effects[key]

    @property
    def files(self) -> tuple[EffectFile, ...]:
        """The users' files that were loaded, with those of their effects that are registered
        still.
        """
        kept = (
            replace(f, keys=tuple(k for k in f.keys if k in self)) for f in self._loaded.values()
        )
        return tuple(f for f in kept if f.keys)

    def load(self, path: Path) -> tuple[str, ...]:
        """Run a user's Python file that declares effects; returns its keys.

        A file that is loaded again replaces what it declared before; one that fails leaves nothing
        behind.
        """
        _only_python(path)
        return self.load_code(path, path.read_bytes()).keys

    def load_code(self, path: Path, code: bytes, *, tried: bool = False) -> EffectFile:
        """Run the content of a user's Python file, as it was read (see :meth:`load`).

        Parameters
        ----------
        path : Path
        code : bytes
        tried : bool
            It was run before, elsewhere, and did not end its process: it is run here at once.

        Raises
        ------
        EffectFileError
            The file ends the process that runs it, or takes too much time or memory.
        """
        from .child.trial import ends_it, try_file

        where = path.resolve()
        _only_python(path)
        if not tried:
            others = (f for f in self._loaded.values() if f.path != where)
            try_file(path, code, ((f.path, f.code) for f in others))
        kept = dict(self._effects)
        typed = self._scope.get()
        kept_typed = replace(typed, effects=dict(typed.effects), files=dict(typed.files))
        for key in self._loaded[where].keys if where in self._loaded else ():
            for held in (self._effects, typed.effects, typed.files):
                held.pop(key, None)
        before = set(self)
        module = ModuleType(f"irj_user_effects_{path.stem}")
        module.__file__ = str(path)
        with _pressed() as pressed:
            try:
                exec(_compiled(code, path), module.__dict__)
                self._check_references(set(self) - before, path)
                for key in sorted(set(self) - before):
                    self[key].check()
            except BaseException as error:
                self._effects = kept
                typed.effects, typed.files = kept_typed.effects, kept_typed.files
                if isinstance(error, Exception) or pressed:
                    raise
                said = f": {error}" if str(error) else ""
                raise ends_it(path, f"{type(error).__name__}{said}") from None
        keys = tuple(sorted(set(self) - before))
        self._loaded[where] = EffectFile(where, hashlib.sha256(code).hexdigest(), keys, code)
        return self._loaded[where]

    def periodic_in(self, place: Place) -> tuple[str, ...]:
        """Keys of the candidates that make a line at an order of the motor turn in a place."""
        return tuple(
            e.key for e in self.values() if e.candidate and e.periodic and place in e.acts_on
        )

    def _check_references(self, keys: set[str], path: Path) -> None:
        """Every effect that a new one names must be in the library."""
        for key in sorted(keys):
            for other in self[key].related:
                if other not in self:
                    raise ValueError(
                        f"{path}: effect {key!r} names {other!r}, which is not in the library"
                    )


def _known_only(law: ca.SX, local: LocalSignals, values: SimpleNamespace, where: str) -> None:
    """Refuse symbols that nobody gives a value, numbers that are none, and what no parameter
    changes.
    """
    own = list(vars(values).values())
    given = ca.vertcat(
        *own, *local.memory, *(getattr(local, f.name) for f in fields(local) if f.name != "memory")
    )
    names = {e.name() for e in ca.vertsplit(given)}
    used = ca.symvar(law)
    for symbol in used:
        if symbol.name() not in names:
            raise ValueError(f"{where} has a symbol {symbol.name()!r} of its own; use s and p")
    steps = ca.Function("law", used, [law])
    for k in range(steps.n_instructions()):
        if steps.instruction_id(k) == ca.OP_CONST and not math.isfinite(
            steps.instruction_constant(k)
        ):
            raise ValueError(f"{where} holds {steps.instruction_constant(k):g}, no finite number")
    if own and not ca.depends_on(law, ca.vertcat(*own)):
        raise ValueError(f"{where} depends on none of its parameters")


def _scalar(found: Any, what: str) -> None:
    """Refuse anything but one expression or number."""
    if found is None:
        raise ValueError(
            f"{what} returns None; it must return an expression (is a `return` missing?)"
        )
    try:
        shape = ca.SX(found).shape
    except Exception:  # CasADi raises several kinds for what is no expression
        raise ValueError(
            f"{what} returns {type(found).__name__}, not an expression of CasADi"
        ) from None
    if shape != (1, 1):
        raise ValueError(f"{what} returns {shape[0]} x {shape[1]} values; it must return one")


def _only_python(path: Path) -> None:
    if path.suffix != ".py":
        raise ValueError(f"{path}: not a Python file")


EFFECTS: Final = Registry()


@contextlib.contextmanager
def _pressed() -> Iterator[list[int]]:
    """Interrupts from the keyboard, to tell them from those that a file raises itself."""
    pressed: list[int] = []
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield pressed  # none reaches this thread
        return

    def note(number: int, frame: FrameType | None) -> None:
        pressed.append(number)
        handler(number, frame)

    signal.signal(signal.SIGINT, note)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, handler)


def _compiled(code: bytes, path: Path) -> CodeType:
    """The code of a user's file; a null byte in it is a SyntaxError on every Python (a ValueError
    on some).
    """
    try:
        return compile(code, str(path), "exec")
    except ValueError as error:
        raise SyntaxError(str(error)) from None


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
    told_by: str = "",
    formerly: tuple[str, ...] = (),
    candidate: bool = True,
    requires: tuple[Requirement, ...] = (),
    contains: tuple[str, ...] = (),
    parts: tuple[str, ...] = (),
    stage: Stage = "law",
    common: bool = False,
    several_valleys: bool = False,
    takes_up: Law | None = None,
    of_displacement: bool = False,
    shapes_reversal: bool = False,
    everywhere: bool = False,
    pairs: tuple[tuple[str, str, str], ...] = (),
    table: Table | None = None,
) -> Callable[[Law], Law]:
    """Declare and register the decorated law as an effect (see :class:`Effect` for the
    arguments).
    """

    def register(law: Law) -> Law:
        EFFECTS.add(
            Effect(
                key=key,
                title=title,
                family=family,
                acts_on=acts_on,
                parameters=parameters,
                law=law,
                absence=absence,
                excitation=excitation,
                source=source,
                memory=memory,
                rate=rate,
                states=states,
                potential=potential,
                confused_with=confused_with,
                needs=needs,
                needs_load=needs_load,
                dissipative=dissipative,
                periodic=periodic,
                angular=angular,
                separate_by=separate_by,
                told_by=told_by,
                candidate=candidate,
                requires=requires,
                contains=contains,
                parts=parts,
                stage=stage,
                common=common,
                several_valleys=several_valleys,
                takes_up=takes_up,
                of_displacement=of_displacement,
                shapes_reversal=shapes_reversal,
                everywhere=everywhere,
                pairs=pairs,
                formerly=formerly,
                table=table,
            )
        )
        return law

    return register


def load_library() -> None:
    """Import every module of :mod:`casadi_models.effects`, which registers the effects."""
    from . import effects

    for module in pkgutil.iter_modules(effects.__path__):
        importlib.import_module(f"{effects.__name__}.{module.name}")
