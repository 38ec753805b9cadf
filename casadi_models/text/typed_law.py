"""A law typed in one line, as an effect like those of the library.

``a*tanh(v/b)`` on the motor, with ``a=1..10 N.m`` and ``b=0.01..1 rad/s``: the text is read by a
small parser of its own (numbers, names, ``+ - * / ** ^``, brackets and :data:`FUNCTIONS`; nothing
is run as Python), its units are checked, and which parameters are amplitudes and which are shapes
follows from how they enter. Names of signals are those of :data:`SIGNALS`.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, Final, cast, final

import casadi as ca
import numpy as np

from ..effect import EFFECTS, PLACE_SIDE, Effect, Family, Place
from ..equations import jointly_linear
from ..parameter import Parameter
from ..quantities import BASE_NAMES, BaseUnit, UnitError, base_unit, factors, linear_unit, named
from ..signals import Expression, LocalSignals
from ..term import HANGING, INERTIAS, smoothing


class LawError(ValueError):
    """A typed law that cannot be used: one line that says what and where."""


# --- what may stand in a law ----------------------------------------------------------------------

SIGNALS: Final[Mapping[str, tuple[str, str]]] = {
    "q": ("position", "rad"),
    "position": ("position", "rad"),
    "v": ("velocity", "rad/s"),
    "velocity": ("velocity", "rad/s"),
    "a": ("acceleration", "rad/s2"),
    "acceleration": ("acceleration", "rad/s2"),
    "direction": ("direction", "1"),
    "twist": ("torsion", "rad"),
    "twist_rate": ("torsion_rate", "rad/s"),
    "T": ("torque", "N.m"),
    "torque": ("torque", "N.m"),
    "load": ("load", "N.m"),
    "reading": ("reading", ""),
    "reading_rate": ("reading_rate", ""),
    "motor_angle": ("motor_angle", "rad"),
    "t": ("time", "s"),
    "time": ("time", "s"),
    "temperature": ("temperature", "K"),
}
"""Name in a law: field of :class:`LocalSignals` and unit; a reading has the unit of its channel."""
SHORT: Final = frozenset(("q", "v", "a", "T", "t"))
"""Short names, which a parameter of the law may take for itself; the long name then remains."""
CONSTANTS: Final[Mapping[str, float]] = {"pi": math.pi}

_SIDE: Final = frozenset(
    (
        "position",
        "velocity",
        "acceleration",
        "direction",
        "torsion",
        "torsion_rate",
        "torque",
        "load",
        "motor_angle",
        "time",
        "temperature",
    )
)
_GEAR: Final = frozenset(
    (
        "position",
        "velocity",
        "torsion",
        "torsion_rate",
        "torque",
        "load",
        "motor_angle",
        "time",
        "temperature",
    )
)
_READING: Final = frozenset(("reading", "reading_rate"))
AT_PLACE: Final[Mapping[str, frozenset[str]]] = {
    "motor": _SIDE,
    "link": _SIDE,
    "transmission": _GEAR,
    "torsion": frozenset(("position", "torsion", "torque", "motor_angle", "temperature")),
    "drive": _READING | {"position", "velocity", "motor_angle", "time", "temperature"},
    "torque_sensor": _READING | {"motor_angle", "time", "temperature"},
    "motor_position_sensor": _READING,
    "link_position_sensor": _READING,
}
"""Signals that exist at a place; rates of a position sensor follow from its reading alone."""
_ANGLES: Final = ("torsion", "motor_position_sensor", "link_position_sensor")

FUNCTIONS: Final[Mapping[str, tuple[int, Callable[..., Expression]]]] = {
    "sin": (1, ca.sin),
    "cos": (1, ca.cos),
    "tan": (1, ca.tan),
    "tanh": (1, ca.tanh),
    "exp": (1, ca.exp),
    "log": (1, ca.log),
    "sqrt": (1, ca.sqrt),
    "abs": (1, ca.fabs),
    "sign": (1, ca.sign),
    "min": (2, ca.fmin),
    "max": (2, ca.fmax),
}
"""Functions of a law: number of arguments and CasADi operation."""

LONGEST: Final = 500
"""Most characters of a law: ten times the longest of the library."""
DEEPEST: Final = 40
"""Most brackets, signs and powers inside each other; the library needs six."""
LARGEST_POWER: Final = 16.0
"""Largest exponent that is a number; laws of friction and stiffness use up to five."""
MOST_PARAMETERS: Final = 12
"""Most parameters of one law: no record carries more at once."""
_REACH: Final[Mapping[str, float]] = {
    "position": 10.0,
    "velocity": 30.0,
    "acceleration": 300.0,
    "torsion": 0.1,
    "torsion_rate": 3.0,
    "torque": 1e3,
    "load": 1e3,
    "reading": 1e3,
    "reading_rate": 1e4,
    "motor_angle": 1e3,
    "time": 1e4,
    "temperature": 100.0,
}
"""Sizes in SI that a large robot joint hardly exceeds: up to there a law must be a number."""
GRID_POINTS: Final = 5
"""Points of the search over a shape's range, as many as the library's shapes have."""


# --- parser ---------------------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class Node:
    """A part of a law: its kind (``number``, ``name``, ``call``, an operator, ``negative``),
    value, parts and place.
    """

    kind: str
    start: int
    end: int
    parts: tuple[Node, ...] = ()
    name: str = ""
    value: float = 0.0


_TOKEN: Final = re.compile(
    r"\s*(?:(?P<number>(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)|(?P<name>"
    r"[A-Za-z][A-Za-z0-9_]*)|(?P<sign>\*\*|[-+*/^(),]))",
    re.ASCII,
)
_BINDING: Final[Mapping[str, int]] = {"+": 1, "-": 1, "*": 2, "/": 2, "**": 4}
_SIGN_BINDING: Final = 3


@final
class _Parser:
    """Operator precedence: each operator takes what binds tighter to its right."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._tokens = _tokens(text)
        self._at = 0

    def whole(self) -> Node:
        """The whole text as one expression."""
        found = self._expression(0, 0)
        kind, word, start, _ = self._tokens[self._at]
        if kind != "end":
            raise LawError(
                f"column {start + 1}: {word!r} is not expected there; an operator is missing "
                "before it, or a bracket is not closed"
            )
        return found

    def _take(self) -> tuple[str, str, int, int]:
        token = self._tokens[self._at]
        self._at += token[0] != "end"
        return token

    def _expression(self, least: int, depth: int) -> Node:
        if depth > DEEPEST:
            raise LawError(
                f"column {self._tokens[self._at][2] + 1}: more than {DEEPEST} brackets, signs or "
                "powers inside each other"
            )
        left = self._operand(depth)
        while True:
            operator = self._tokens[self._at][1] if self._tokens[self._at][0] == "sign" else ""
            binding = _BINDING.get(operator, 0)
            if not binding or binding <= least:
                return left
            self._take()
            right = self._expression(binding - (operator == "**"), depth + 1)
            left = Node(operator, left.start, right.end, (left, right))

    def _operand(self, depth: int) -> Node:
        kind, word, start, end = self._take()
        if kind == "number":
            value = float(word)
            if not math.isfinite(value):
                raise LawError(f"column {start + 1}: the number {_short(word)} is too large")
            return Node("number", start, end, value=value)
        if kind == "name":
            return (
                self._call(word, start, depth)
                if self._tokens[self._at][1] == "("
                else Node("name", start, end, name=word)
            )
        if word in ("-", "+"):
            inner = self._expression(_SIGN_BINDING, depth + 1)
            return Node("negative", start, inner.end, (inner,)) if word == "-" else inner
        if word == "(" and kind == "sign":
            inner = self._expression(0, depth + 1)
            return replace(inner, start=start, end=self._closed())
        raise LawError(
            f"column {start + 1}: "
            + (
                "the law ends where a value is expected"
                if kind == "end"
                else f"{word!r} stands where a value is expected"
            )
        )

    def _call(self, name: str, start: int, depth: int) -> Node:
        if name not in FUNCTIONS:
            raise LawError(
                f"column {start + 1}: no function {_short(name)!r}; there are "
                f"{', '.join(FUNCTIONS)}"
            )
        self._take()
        found = [self._expression(0, depth + 1)]
        while self._tokens[self._at][1] == ",":
            self._take()
            found.append(self._expression(0, depth + 1))
        end = self._closed()
        if len(found) != FUNCTIONS[name][0]:
            raise LawError(
                f"column {start + 1}: {name} takes {FUNCTIONS[name][0]} "
                f"value{'s' * (FUNCTIONS[name][0] > 1)}, not {len(found)}"
            )
        return Node("call", start, end, tuple(found), name=name)

    def _closed(self) -> int:
        kind, word, start, end = self._take()
        if word != ")":
            raise LawError(
                f"column {start + 1}: a bracket is not closed"
                + (f" before {word!r}" if kind != "end" else "")
            )
        return end


def _tokens(text: str) -> list[tuple[str, str, int, int]]:
    if not text.strip():
        raise LawError("the law is empty; write one, as a*tanh(v/b)")
    if len(text) > LONGEST:
        raise LawError(f"the law has {len(text)} characters; {LONGEST} are the most")
    found, at, end = [], 0, len(text.rstrip())
    while at < end:
        match = _TOKEN.match(text, at)
        if match is None:
            place = at + len(text[at:]) - len(text[at:].lstrip())
            raise LawError(
                f"column {place + 1}: the sign {ascii(text[place])} has no place in a law; it "
                f"has numbers, names, + - * / ** ( ) and {', '.join(FUNCTIONS)}"
            )
        kind = str(match.lastgroup)
        word = match[kind]
        found.append((kind, "**" if word == "^" else word, match.start(kind), match.end()))
        at = match.end()
    return [*found, ("end", "", end, end)]


@lru_cache(maxsize=256)
def parse(text: str) -> Node:
    """Read a law.

    Raises
    ------
    LawError
        One line with the column.
    """
    return _Parser(text).whole()


def _short(text: str, most: int = 40) -> str:
    return text if len(text) <= most else text[: most - 3] + "..."


# --- units ----------------------------------------------------------------------------------------

Dimension = tuple[Fraction, ...]
"""Exponents of the base units; the last counts the radians, also those that SI leaves out."""
_NO_UNIT: Final[Dimension] = (Fraction(0),) * len(BASE_NAMES)
_RADIAN: Final = len(BASE_NAMES) - 1


def _dimension(unit: BaseUnit, kind: str) -> Dimension:
    exponents = [Fraction(e) for e in unit.exponents]
    if kind == "rotary":
        exponents[_RADIAN] += unit.unwritten
    return tuple(exponents)


def _scaled(one: Dimension, power: Fraction) -> Dimension:
    return tuple(e * power for e in one)


def _times(one: Dimension, other: Dimension, sign: int = 1) -> Dimension:
    return tuple(a + sign * b for a, b in zip(one, other, strict=True))


def _unit_text(found: Dimension, kind: str) -> str:
    """A dimension in the units of a joint: newton metres (newtons on a linear axis), seconds,
    radians...
    """
    mass = found[0]
    torque = _dimension(base_unit("N.m" if kind == "rotary" else "N"), kind)
    rest = _times(found, _scaled(torque, mass), -1)
    powers = [
        *([("N", mass), ("m", mass)] if kind == "rotary" else [("N", mass)]),
        *zip(BASE_NAMES[1:], rest[1:], strict=True),
    ]
    above = [f"{n}{p if p != 1 else ''}" for n, p in powers if p > 0]
    below = [f"{n}{-p if p != -1 else ''}" for n, p in powers if p < 0]
    divisor = f"({'.'.join(below)})" if len(below) > 1 else "".join(below)
    return (".".join(above) or "1") + (f"/{divisor}" if divisor else "")


@final
class _Units:
    """Unit of every part of a law."""

    def __init__(self, text: str, kind: str, units: Mapping[str, Dimension]) -> None:
        self._text, self._kind, self._units = text, kind, units

    def of(self, node: Node) -> Dimension | None:
        """Unit of a part; None for the number 0, which has any."""
        if node.kind == "number":
            return _NO_UNIT if node.value else None
        if node.kind == "name":
            return self._units[node.name]
        found = [self.of(part) for part in node.parts]
        if node.kind == "negative":
            return found[0]
        if node.kind in ("+", "-"):
            return self._alike(node, found)
        if node.kind == "**":
            return self._power(node, found)
        if node.kind == "call":
            return self._call(node, found)
        one, other = found
        if one is None or other is None:
            return one if node.kind == "/" else None
        return _times(one, other, 1 if node.kind == "*" else -1)

    def said(self, node: Node, unit: Dimension | None) -> str:
        """A part with its unit, for a message."""
        return (
            f"{_short(self._text[node.start : node.end])!r} "
            f"[{_unit_text(unit or _NO_UNIT, self._kind)}]"
        )

    def _alike(self, node: Node, found: Sequence[Dimension | None]) -> Dimension | None:
        one, other = found
        if one is not None and other is not None and one != other:
            first, second = (self.said(p, u) for p, u in zip(node.parts, found, strict=True))
            joined = f"{node.name} of" if node.kind == "call" else "a sum or difference of"
            raise LawError(f"{joined} {first} and {second}: both must have one unit")
        return other if one is None else one

    def _power(self, node: Node, found: Sequence[Dimension | None]) -> Dimension | None:
        base, exponent = found
        if exponent not in (None, _NO_UNIT):
            raise LawError(f"the exponent {self.said(node.parts[1], exponent)} must have no unit")
        number = constant(node.parts[1])
        if number is not None and abs(number) > LARGEST_POWER:
            raise LawError(
                f"the exponent {_short(self._text[node.parts[1].start : node.parts[1].end])!r} "
                f"is larger than {LARGEST_POWER:g}"
            )
        if base is None or base == _NO_UNIT:
            return _NO_UNIT
        if number is None:
            raise LawError(
                f"the base {self.said(node.parts[0], base)} of a power that is no number must "
                "have no unit; divide it by a parameter of that unit"
            )
        return _scaled(base, Fraction(number).limit_denominator(1000))

    def _call(self, node: Node, found: Sequence[Dimension | None]) -> Dimension | None:
        unit = found[0]
        if node.name in ("min", "max"):
            return self._alike(node, found)
        if node.name == "abs":
            return unit
        if node.name == "sqrt":
            return None if unit is None else _scaled(unit, Fraction(1, 2))
        if node.name == "sign" or unit in (None, _NO_UNIT):
            return _NO_UNIT
        angle = all(e == (i == _RADIAN) for i, e in enumerate(unit or _NO_UNIT))
        if node.name in ("sin", "cos", "tan") and angle:
            return _NO_UNIT
        wanted = "an angle or no unit" if node.name in ("sin", "cos", "tan") else "no unit"
        unit_text = _unit_text(unit or _NO_UNIT, self._kind)
        raise LawError(
            f"the argument {self.said(node.parts[0], unit)} of {node.name} must have {wanted}; "
            f"divide it by a parameter in {unit_text}"
        )


def constant(node: Node) -> float | None:
    """Value of a part without names; None where it has some, infinite where it is too large."""
    if node.kind == "number":
        return node.value
    if node.kind == "name":
        return CONSTANTS.get(node.name)
    parts = [constant(p) for p in node.parts]
    if any(p is None for p in parts):
        return None
    return float(ca.DM(_applied(node, [ca.DM(p) for p in parts])))


def _applied(node: Node, parts: Sequence[Expression]) -> Expression:
    """One operation on the values of its parts."""
    if node.kind == "call":
        return FUNCTIONS[node.name][1](*parts)
    if node.kind == "negative":
        return -parts[0]
    one, other = parts
    return {
        "+": lambda: one + other,
        "-": lambda: one - other,
        "*": lambda: one * other,
        "/": lambda: one / other,
        "**": lambda: one**other,
    }[node.kind]()


# --- the law --------------------------------------------------------------------------------------

_RANGE: Final = re.compile(
    r"\s*(?P<name>[A-Za-z][A-Za-z0-9_]*)\s*=\s*(?P<low>"
    r"[-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?)\s*\.\.\s*"
    r"(?P<high>[-+]?(?:\d+(?:\.\d+)?|\.\d+)(?:[eE][-+]?\d+)?)\s*(?P<unit>\S.*)?",
    re.ASCII,
)
_KEY: Final = re.compile(r"[a-z][a-z0-9_]{0,39}", re.ASCII)


@final
@dataclass(frozen=True)
class Ranged:
    """A parameter as it is typed: name, range in SI, SI unit."""

    name: str
    low: float
    high: float
    unit: str


def ranged(text: str) -> Ranged:
    """Read ``b=0.01..1 rad/s``.

    Raises
    ------
    LawError
        One line.
    """
    match = _RANGE.fullmatch(text)
    if match is None or len(text) > LONGEST:
        raise LawError(
            f"parameter {ascii(_short(text))} is not understood; write it like a=1..10 N.m"
        )
    low, high = float(match["low"]), float(match["high"])
    if not -math.inf < low < high < math.inf:
        raise LawError(
            f"parameter {match['name']}: its range {match['low']}..{match['high']} must rise and "
            "be finite"
        )
    try:
        unit = base_unit((match["unit"] or "1").strip())
        si = _si((match["unit"] or "1").strip(), unit)
    except UnitError as error:
        raise LawError(f"parameter {match['name']}: {error}") from None
    return Ranged(match["name"], low * unit.factor, high * unit.factor, si)


def _si(text: str, unit: BaseUnit) -> str:
    """The unit in SI: names with a factor are exchanged for those without."""
    if unit.factor == 1.0 and not unit.offset:
        return text
    plain = ("rad", "m", "s", "A", "V", "kg", "N", "N.m", "J", "W", "K", "rad/s", "kg.m2", "1")
    above = []
    for name, power in factors(text):
        one = named(name)
        found = next(
            (n for n in plain if _dimension(base_unit(n), "rotary") == _dimension(one, "rotary")),
            None,
        )
        if found is None or one.offset:
            raise UnitError(f"unit {text!r} must be written in SI")
        above += [
            f"{n}{p * power if p * power != 1 else ''}" for n, p in factors(found) if n != "1"
        ]
    return ".".join(above) or "1"


def value_of(text: str, values: Mapping[str, Any]) -> Expression:
    """A law where its names have these values, expressions or numbers.

    Raises
    ------
    LawError
        The text is no law.
    """
    return _value(parse(text), {**CONSTANTS, **values}, lambda node: None)


def _value(
    node: Node, values: Mapping[str, Any], known: Callable[[Node], Expression | None]
) -> Expression:
    """A part of a law; `known`: what stands for it whatever its parts are."""
    if node.kind in ("number", "name"):
        found = node.value if node.kind == "number" else values[node.name]
        return ca.DM(found) if isinstance(found, float | int) else found  # 1/0 is inf there
    own = known(node)
    if own is not None:
        return own
    return _applied(node, [_value(part, values, known) for part in node.parts])


@final
@dataclass(frozen=True)
class TypedLaw:
    """A law as it stands in a joint file.

    Attributes
    ----------
    key : str
        Key of the effect.
    text : str
        The law.
    places : tuple of str
        Where it acts.
    parameters : tuple of str
        As typed, ``b=0.01..1 rad/s``.
    kind : {"rotary", "linear"}
        Of the joint; decides the units of the signals.
    """

    key: str
    text: str
    places: tuple[str, ...]
    parameters: tuple[str, ...]
    kind: str = "rotary"

    @property
    def code(self) -> bytes:
        """Python source that declares the same effect where the file cannot be read, such as in
        an FMU.
        """
        head = "from casadi_models.text.typed_law import TypedLaw, register"
        return f"{head}\n\nregister({self!r})\n".encode()


def derived_key(text: str, places: Sequence[str], parameters: Sequence[str]) -> str:
    """Key of a law without a name of its own: equal laws have equal keys."""
    whole = "\n".join(("".join(text.split()), *places, *("".join(p.split()) for p in parameters)))
    return f"law_{hashlib.sha256(whole.encode()).hexdigest()[:6]}"


@final
@dataclass(frozen=True)
class _Law:
    """The callable of the declaration: the text on signals and parameters."""

    text: str
    own: tuple[tuple[str, str], ...]
    smooth_sign: bool

    def __call__(self, s: LocalSignals, p: SimpleNamespace) -> Expression:
        values = {n: getattr(s, f) for n, (f, _) in SIGNALS.items()} | dict(CONSTANTS)
        values |= {short: getattr(p, full) for short, full in self.own}
        # smoothed, as in the friction laws of the library
        known = lambda node: s.direction if self._is_way(node) else None  # noqa: E731
        return _value(parse(self.text), values, known)

    def _is_way(self, node: Node) -> bool:
        call = node.kind == "call" and node.name == "sign"
        return self.smooth_sign and call and self._is_velocity(node.parts[0])

    def _is_velocity(self, node: Node) -> bool:
        own = {short for short, _ in self.own}
        return (
            node.kind == "name"
            and node.name not in own
            and SIGNALS.get(node.name, ("", ""))[0] == "velocity"
        )


def effect_of(law: TypedLaw) -> Effect:
    """The declaration that a typed law stands for.

    Raises
    ------
    LawError
        One line: what is wrong, and which part of the law.
    """
    return _effect_of(law)


@lru_cache(maxsize=256)
def _effect_of(law: TypedLaw) -> Effect:
    if _KEY.fullmatch(law.key) is None:
        raise LawError(
            f"key {ascii(_short(law.key))} must be small letters, digits and underscores, at "
            "most 40"
        )
    places = _places(law.places)
    try:
        tree = parse(law.text)
    except LawError as error:
        raise LawError(f"{error}; the text is no law") from None
    parameters = _declared(law.parameters)
    _known_names(tree, places, parameters)
    _checked_units(tree, law, places, parameters)
    own = tuple((n, f"{law.key}_{n}") for n in parameters)
    smooth = all(p in ("motor", "link") for p in places)
    call = _Law(law.text, own, smooth)
    symbols = {f.name: ca.SX.sym(f.name) for f in fields(LocalSignals) if f.name != "memory"}
    given = {full: ca.SX.sym(full) for _, full in own}
    found = ca.SX(call(LocalSignals(memory=(), **symbols), SimpleNamespace(**given)))
    amplitudes = _amplitudes(found, given, parameters)
    _affine(found, symbols, places)
    made = tuple(_parameter(full, parameters[n], n in amplitudes) for n, full in own)
    _finite(found, symbols, given, made, tuple(parameters))
    reads = {n for n, x in symbols.items() if ca.depends_on(found, x)}
    return Effect(
        key=law.key,
        title=f"typed law {law.text}",
        family=_family(places, reads),
        acts_on=places,
        parameters=made,
        law=call,
        absence="the residual follows the typed law",
        excitation="motion over the whole range of what the law reads",
        source="typed by the user",
        needs_load="load" in reads,
        everywhere=len(places) > 1,
    )


def register(law: TypedLaw) -> Effect:
    """Put a typed law into the library; one of the same key that was typed before is replaced.

    Raises
    ------
    LawError
        A law that cannot be used; the key of an effect that was not typed.
    """
    found = effect_of(law)
    _own_names(found)
    try:
        EFFECTS.hold(found, law.code)
    except ValueError as error:
        raise LawError(str(error)) from None
    return found


def _own_names(found: Effect) -> None:
    """A parameter of a typed law must not have the name of another one in a model."""
    taken = dict.fromkeys((*INERTIAS, *HANGING), "the joint")
    taken |= {smoothing(p).name: "the joint" for p in found.acts_on}
    for other in EFFECTS.values():
        if other.key != found.key:
            taken |= {n: other.key for p in other.acts_on for n in other.parameter_names(p)}
    for place in found.acts_on:
        for name in found.parameter_names(place):
            if name in taken:
                raise LawError(
                    f"its parameter would be {name!r} in the model, as one of {taken[name]}; "
                    "choose another key"
                )


def _places(given: Sequence[str]) -> tuple[Place, ...]:
    if not given:
        raise LawError(f"the law needs a place; use one of {', '.join(PLACE_SIDE)}")
    for place in given:
        if place not in PLACE_SIDE:
            raise LawError(
                f"place {ascii(_short(place))} is not known; use one of {', '.join(PLACE_SIDE)}"
            )
    return cast(tuple[Place, ...], tuple(dict.fromkeys(given)))


def _declared(texts: Sequence[str]) -> dict[str, Ranged]:
    found: dict[str, Ranged] = {}
    for text in texts:
        one = ranged(text)
        if one.name in found:
            raise LawError(f"parameter {one.name} is given twice")
        if (
            one.name in FUNCTIONS
            or one.name in CONSTANTS
            or (one.name in SIGNALS and one.name not in SHORT)
        ):
            raise LawError(
                f"parameter {one.name} has the name of a signal or function; choose another"
            )
        found[one.name] = one
    if not found:
        raise LawError(
            "the law has no parameter; give each with its range and unit, as a=1..10 N.m"
        )
    if len(found) > MOST_PARAMETERS:
        raise LawError(f"the law has {len(found)} parameters; {MOST_PARAMETERS} are the most")
    return found


def _names(node: Node) -> dict[str, int]:
    found = {node.name: node.start} if node.kind == "name" else {}
    for part in node.parts:
        for name, start in _names(part).items():
            found.setdefault(name, start)
    return found


def _known_names(tree: Node, places: Sequence[str], parameters: Mapping[str, Ranged]) -> None:
    used = _names(tree)
    for name, start in used.items():
        if name in parameters or name in CONSTANTS:
            continue
        if name not in SIGNALS:
            raise LawError(
                f"column {start + 1}: {_short(name)!r} is no signal and no parameter; signals "
                f"are {', '.join(SIGNALS)}; give a parameter with its range"
            )
        for place in places:
            if SIGNALS[name][0] not in AT_PLACE[place]:
                there = ", ".join(n for n, (f, _) in SIGNALS.items() if f in AT_PLACE[place])
                raise LawError(
                    f"column {start + 1}: {name!r} is not there on {place}; a law there may use "
                    f"{there}"
                )
    for name in parameters:
        if name not in used:
            raise LawError(f"parameter {name} does not stand in the law; leave it out")


def _checked_units(
    tree: Node, law: TypedLaw, places: Sequence[str], parameters: Mapping[str, Ranged]
) -> None:
    def read(unit: str, name: str = "") -> Dimension:
        shown = unit if law.kind == "rotary" or name == "motor_angle" else linear_unit(unit)
        return _dimension(base_unit(shown), law.kind)

    for place in places:
        own = "rad" if place in _ANGLES else "N.m"
        readings = {"reading": own, "reading_rate": f"{own}.s-1"}
        units = {n: read(readings.get(n) or u, n) for n, (_, u) in SIGNALS.items()}
        units |= dict.fromkeys(CONSTANTS, _NO_UNIT) | {
            n: read(p.unit) for n, p in parameters.items()
        }
        checker = _Units(law.text, law.kind, units)
        found, wanted = checker.of(tree), read(own)
        if found is None:
            raise LawError("the law is 0 everywhere; multiply what it reads by an amplitude")
        if found != wanted:
            raise LawError(
                f"the law {checker.said(tree, found)} must be in {_unit_text(wanted, law.kind)} "
                f"on {place}"
            )


def _amplitudes(
    found: Expression, given: Mapping[str, Expression], parameters: Mapping[str, Ranged]
) -> set[str]:
    """Parameters that enter jointly linearly; a law without any may vanish with one that is 0
    inside its range.
    """
    symbols, names = list(given.values()), list(parameters)
    chosen = set(jointly_linear(found, ca.vertcat(*symbols)))
    if not chosen:
        ranges = list(parameters.values())
        chosen = {
            i
            for i in range(len(names))
            if ranges[i].low <= 0 <= ranges[i].high and _vanishes(found, [symbols[i]])
        }
    if not chosen:
        raise LawError(
            "no parameter of the law is an amplitude, 0 for absent; multiply the law by one"
        )
    if not _vanishes(found, [symbols[i] for i in chosen]):
        raise LawError(
            f"the law is not 0 where {', '.join(names[i] for i in sorted(chosen))} are 0; "
            "multiply every part by an amplitude"
        )
    return {names[i] for i in chosen}


def _vanishes(found: Expression, symbols: list[Expression]) -> bool:
    (left,) = ca.substitute([found], symbols, [ca.SX(0)] * len(symbols))
    return bool(ca.simplify(left).is_zero())


def _affine(found: Expression, symbols: Mapping[str, Expression], places: Sequence[str]) -> None:
    """Accelerations are solved for, and sensors turned round, as affine laws."""
    solved = [
        "acceleration",
        *(
            []
            if all(p in ("motor", "link", "transmission", "torsion") for p in places)
            else sorted(_READING)
        ),
    ]
    column = ca.vertcat(*(symbols[n] for n in solved))
    if ca.hessian(found, column)[0].nnz():
        raise LawError(
            "the law must be linear in "
            f"{' and '.join(n for n in solved if ca.depends_on(found, symbols[n]))}"
        )


def _parameter(name: str, given: Ranged, amplitude: bool) -> Parameter:
    meaning = f"parameter {given.name} of the typed law"
    middle = (
        math.sqrt(given.low * given.high)
        if given.low > 0
        else (given.low + given.high) / 2 or given.high / 2
    )
    if amplitude:
        return Parameter(
            name,
            given.unit,
            0.0,
            min(0.0, given.low),
            max(0.0, given.high),
            meaning,
            typical=middle,
        )
    spaced = np.geomspace if given.low > 0 else np.linspace
    grid = tuple(float(x) for x in spaced(given.low, given.high, GRID_POINTS))
    start = min(max(middle, given.low), given.high)
    return Parameter(
        name, given.unit, start, given.low, given.high, meaning, grid=grid, typical=start
    )


def _finite(
    found: Expression,
    symbols: Mapping[str, Expression],
    given: Mapping[str, Expression],
    made: Sequence[Parameter],
    names: Sequence[str],
) -> None:
    """A law and its slopes must be numbers at rest and in motion, all over the range of its
    parameters.
    """
    inputs = [*symbols.values(), *given.values()]
    used = [x for x in inputs if ca.depends_on(found, x)]
    slopes = ca.jacobian(found, ca.vertcat(*used))
    function = ca.Function("law", inputs, [found, slopes])
    reach = np.array([_REACH.get(n, 1.0) for n in symbols])
    mixed = np.random.default_rng(0).choice((-1.0, 1.0), (4, len(symbols)))
    signs = [np.ones(len(symbols)), -np.ones(len(symbols)), *mixed]
    motions = [("at rest", 0 * reach)]
    motions += [("near rest", s * 1e-4 * reach) for s in signs] + [
        ("in motion", s * reach) for s in signs
    ]
    ranges = [p.grid or (p.low, p.high, 0.0, p.usual() or 0.0, p.low) for p in made]
    for values in zip(*ranges, strict=True):
        for where, at in motions:
            numbers = [np.array(x) for x in function(*at, *values)]
            for what, number in zip(("value", "slope"), numbers, strict=True):
                if not np.isfinite(number).all():
                    point = ", ".join(f"{n} = {v:g}" for n, v in zip(names, values, strict=True))
                    raise LawError(
                        f"the law has no finite {what} {where} with {point}; narrow the ranges, "
                        "or keep "
                        "roots and divisors from 0 as in sqrt(x**2 + 1e-12)"
                    )


def _family(places: Sequence[Place], reads: set[str]) -> Family:
    """What kind of effect it is, from where it acts and what it reads."""
    if any(
        p in ("drive", "torque_sensor", "motor_position_sensor", "link_position_sensor")
        for p in places
    ):
        return "sensor"
    if any(p in ("transmission", "torsion") for p in places):
        return "transmission"
    if "acceleration" in reads:
        return "inertia"
    return "friction" if reads & {"velocity", "direction"} else "torque"
