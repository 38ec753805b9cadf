"""A CasADi expression as text, LaTeX or sympy code.

The expression graph is walked operation by operation, so whatever a law is made of is written as it
stands: a user's own effect needs nothing beside its law. Brackets are set by precedence and the
order of operations is kept, so the sympy form gives the values of the CasADi function up to
rounding.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, Literal, final

import casadi as ca

from ..signals import Expression

Language = Literal["text", "latex", "sympy"]
LANGUAGES: Final[tuple[Language, ...]] = ("text", "latex", "sympy")

_SUM, _PRODUCT, _SIGN, _POWER, _ATOM = 1, 2, 3, 4, 5
"""Precedence, loosest first."""


@final
@dataclass(frozen=True)
class _Piece:
    """A written part: its text, how tightly it binds, and the text of it as a condition, if it
    is one.
    """

    text: str
    binds: int = _ATOM
    condition: str = ""


@final
@dataclass(frozen=True)
class _Call:
    """How a function is written: its name in text, templates in LaTeX and sympy."""

    text: str
    latex: str
    sympy: str


def _named(text: str, latex: str = "", sympy: str = "") -> _Call:
    head = latex or rf"\operatorname{{{{{text}}}}}"
    return _Call(text, head + r"\left({0}\right)", f"{sympy or text}({{0}})")


_UNARY: Final[Mapping[int, _Call]] = {
    ca.OP_EXP: _named("exp", r"\exp"),
    ca.OP_LOG: _named("log", r"\ln"),
    ca.OP_SQRT: _Call("sqrt", r"\sqrt{{{0}}}", "sqrt({0})"),
    ca.OP_SIN: _named("sin", r"\sin"),
    ca.OP_COS: _named("cos", r"\cos"),
    ca.OP_TAN: _named("tan", r"\tan"),
    ca.OP_ASIN: _named("asin", r"\arcsin"),
    ca.OP_ACOS: _named("acos", r"\arccos"),
    ca.OP_ATAN: _named("atan", r"\arctan"),
    ca.OP_FLOOR: _Call("floor", r"\left\lfloor {0}\right\rfloor ", "floor({0})"),
    ca.OP_CEIL: _Call("ceil", r"\left\lceil {0}\right\rceil ", "ceiling({0})"),
    ca.OP_FABS: _Call("abs", r"\left|{0}\right|", "Abs({0})"),
    ca.OP_SIGN: _named("sign"),
    ca.OP_SINH: _named("sinh", r"\sinh"),
    ca.OP_COSH: _named("cosh", r"\cosh"),
    ca.OP_TANH: _named("tanh", r"\tanh"),
    ca.OP_ASINH: _named("asinh"),
    ca.OP_ACOSH: _named("acosh"),
    ca.OP_ATANH: _named("atanh"),
    ca.OP_ERF: _named("erf"),
    ca.OP_ERFINV: _named("erfinv"),
    ca.OP_LOG1P: _Call("log1p", r"\ln\left(1 + {0}\right)", "log(1 + ({0}))"),
    ca.OP_EXPM1: _Call("expm1", r"\left(\exp\left({0}\right) - 1\right)", "(exp({0}) - 1)"),
}
_BINARY: Final[Mapping[int, _Call]] = {
    ca.OP_FMIN: _Call("min", r"\min\left({0}, {1}\right)", "Min({0}, {1})"),
    ca.OP_FMAX: _Call("max", r"\max\left({0}, {1}\right)", "Max({0}, {1})"),
    ca.OP_ATAN2: _Call("atan2", r"\operatorname{{atan2}}\left({0}, {1}\right)", "atan2({0}, {1})"),
    ca.OP_HYPOT: _Call(
        "hypot",
        r"\sqrt{{\left({0}\right)^{{2}} + \left({1}\right)^{{2}}}}",
        "sqrt(({0})**2 + ({1})**2)",
    ),
    ca.OP_FMOD: _Call(
        "fmod", r"\operatorname{{fmod}}\left({0}, {1}\right)", "(sign({0})*Mod(Abs({0}), Abs({1})))"
    ),
    ca.OP_REMAINDER: _Call(
        "remainder",
        r"\operatorname{{remainder}}\left({0}, {1}\right)",
        "(({0}) - ({1})*floor(({0})/({1}) + Rational(1, 2)))",
    ),
    ca.OP_COPYSIGN: _Call(
        "copysign",
        r"\operatorname{{copysign}}\left({0}, {1}\right)",
        "(Abs({0})*Piecewise((1, ({1}) >= 0), (-1, True)))",
    ),
}
_RELATIONS: Final[Mapping[int, _Call]] = {
    ca.OP_LT: _Call("<", "<", "({0}) < ({1})"),
    ca.OP_LE: _Call("<=", r"\le ", "({0}) <= ({1})"),
    ca.OP_EQ: _Call("==", "=", "Eq({0}, {1})"),
    ca.OP_NE: _Call("!=", r"\ne ", "Ne({0}, {1})"),
    ca.OP_AND: _Call("and", r"\wedge ", "And({0}, {1})"),
    ca.OP_OR: _Call("or", r"\vee ", "Or({0}, {1})"),
}
"""Relations have the value 1 or 0; in LaTeX they stand in square brackets that mean this."""


def written(
    expression: Expression,
    language: Language = "text",
    names: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """A scalar expression in one of :data:`LANGUAGES`.

    Parameters
    ----------
    expression : casadi.SX
        Scalar.
    language : {"text", "latex", "sympy"}
    names : mapping
        What is written for a symbol, by its name; else the name itself, as an identifier.

    Raises
    ------
    ValueError
        An expression that is no scalar, or holds an operation that has no written form.
    """
    whole = ca.densify(ca.SX(expression))
    if whole.numel() != 1:
        raise ValueError(f"an expression of {whole.shape} elements cannot be written as one")
    symbols = ca.symvar(whole)
    writer = _Writer(language, names)
    function = ca.Function("written", symbols, [whole])
    work: dict[int, _Piece] = {}
    found = _Piece("0")
    for k in range(function.n_instructions()):
        op = int(function.instruction_id(k))
        inputs = [int(i) for i in function.instruction_input(k)]
        outputs = [int(i) for i in function.instruction_output(k)]
        if op == ca.OP_OUTPUT:
            found = work[inputs[0]]
        elif op == ca.OP_INPUT:
            work[outputs[0]] = writer.symbol(symbols[inputs[0]].name())
        elif op == ca.OP_CONST:
            work[outputs[0]] = writer.number(float(function.instruction_constant(k)))
        else:
            work[outputs[0]] = writer.operation(op, [work[i] for i in inputs])
    return found.text


def _sum(first: str, minus: bool, second: str) -> _Piece:
    if second.startswith("-"):
        minus, second = not minus, second[1:]
    return _Piece(f"{first} {'-' if minus else '+'} {second}", _SUM)


def identifier(name: str) -> str:
    """A symbol's name as an identifier: ``lugre@motor_0`` becomes ``lugre_motor_0``."""
    found = re.sub(r"\W+", "_", name)
    return f"_{found}" if found[:1].isdigit() else found


def latex_name(name: str) -> str:
    """A name set upright, its underscores kept."""
    return rf"\mathrm{{{identifier(name)}}}".replace("_", r"\_")


@final
class _Writer:
    """Writes one operation at a time from the written operands."""

    def __init__(self, language: Language, names: Mapping[str, str]) -> None:
        self._language = language
        self._names = names

    def symbol(self, name: str) -> _Piece:
        own = latex_name(name) if self._language == "latex" else identifier(name)
        return _Piece(self._names.get(name, own))

    def number(self, value: float) -> _Piece:
        size = abs(value)
        if not math.isfinite(size):
            shown = (
                {"text": "inf", "latex": r"\infty", "sympy": "oo"}[self._language]
                if size == math.inf
                else "nan"
            )
        else:
            shown = str(int(size)) if size == int(size) and size < 1e15 else repr(size)
        head, found, power = shown.partition("e")
        if found and self._language == "latex":
            return _Piece(
                rf"{'-' * (value < 0)}{head} \cdot 10^{{{int(power)}}}",
                _SIGN if value < 0 else _PRODUCT,
            )
        return _Piece(f"-{shown}", _SIGN) if value < 0 else _Piece(shown)

    def operation(self, op: int, of: list[_Piece]) -> _Piece:
        """One operation of CasADi's graph."""
        if op in (ca.OP_ASSIGN, ca.OP_LIFT):
            return of[0]
        if op in _ARITHMETIC:
            return self._arithmetic(op, of)
        if op in _RELATIONS:
            return self._relation(op, of)
        if op == ca.OP_NOT:
            return self._truth(
                f"Not({self._condition(of[0])})",
                f"not {self._in(of[0], _ATOM)}",
                rf"\neg {self._in(of[0], _ATOM)}",
            )
        if op == ca.OP_IF_ELSE_ZERO:
            return self._where(of)
        call = (_UNARY if len(of) == 1 else _BINARY).get(op)
        if call is None:
            raise ValueError(f"operation {op} of CasADi has no written form")
        if self._language == "text":
            return _Piece(f"{call.text}({', '.join(p.text for p in of)})")
        return _Piece(
            (call.latex if self._language == "latex" else call.sympy).format(*(p.text for p in of))
        )

    def _in(self, piece: _Piece, least: int) -> str:
        """A piece inside an operation that binds by `least`: in brackets where it binds less."""
        if piece.binds >= least:
            return piece.text
        return rf"\left({piece.text}\right)" if self._language == "latex" else f"({piece.text})"

    def _arithmetic(self, op: int, of: list[_Piece]) -> _Piece:
        if op == ca.OP_SQ:
            return self._power(of[0], _Piece("2"))
        if op == ca.OP_TWICE:
            return self._product(_Piece("2"), of[0])
        if op == ca.OP_INV:
            return self._quotient(_Piece("1"), of[0])
        if op == ca.OP_NEG:
            return _Piece(
                f"-{self._in(of[0], _PRODUCT)}", _SIGN if of[0].binds > _SIGN else _PRODUCT
            )
        first, second = of
        if op in (ca.OP_ADD, ca.OP_SUB):
            return _sum(first.text, op == ca.OP_SUB, self._in(second, _PRODUCT))
        if op == ca.OP_MUL:
            return self._product(first, second)
        return self._quotient(first, second) if op == ca.OP_DIV else self._power(first, second)

    def _product(self, first: _Piece, second: _Piece) -> _Piece:
        times = r" \, " if self._language == "latex" else "*"
        if self._language == "latex" and second.text[:1].isdigit():
            times = r" \cdot "
        return _Piece(f"{self._in(first, _PRODUCT)}{times}{self._in(second, _POWER)}", _PRODUCT)

    def _quotient(self, first: _Piece, second: _Piece) -> _Piece:
        if self._language == "latex":
            return _Piece(rf"\frac{{{first.text}}}{{{second.text}}}", _PRODUCT)
        return _Piece(f"{self._in(first, _PRODUCT)}/{self._in(second, _POWER)}", _PRODUCT)

    def _power(self, base: _Piece, exponent: _Piece) -> _Piece:
        if self._language == "latex":
            return _Piece(f"{{{self._in(base, _ATOM)}}}^{{{exponent.text}}}", _POWER)
        return _Piece(f"{self._in(base, _ATOM)}**{self._in(exponent, _ATOM)}", _POWER)

    # --- relations: 1 where they hold, else 0 -----------------------------------------------------

    def _condition(self, piece: _Piece) -> str:
        return piece.condition or f"Ne({piece.text}, 0)"

    def _truth(self, sympy: str, text: str, latex: str) -> _Piece:
        if self._language == "sympy":
            return _Piece(f"Piecewise((1, {sympy}), (0, True))", condition=sympy)
        return _Piece(f"({text})") if self._language == "text" else _Piece(rf"\left[{latex}\right]")

    def _relation(self, op: int, of: list[_Piece]) -> _Piece:
        call = _RELATIONS[op]
        logical = op in (ca.OP_AND, ca.OP_OR)
        inside = [self._condition(p) if logical else p.text for p in of]
        plain = f"{of[0].text} {call.text} {of[1].text}"
        return self._truth(
            call.sympy.format(*inside), plain, f"{of[0].text} {call.latex} {of[1].text}"
        )

    def _where(self, of: list[_Piece]) -> _Piece:
        condition, value = of
        if self._language == "sympy":
            return _Piece(f"Piecewise(({value.text}, {self._condition(condition)}), (0, True))")
        if self._language == "text":
            return _Piece(f"where({condition.text}, {value.text}, 0)")
        return self._product(condition, value)


_ARITHMETIC: Final[frozenset[Any]] = frozenset(
    (
        ca.OP_NEG,
        ca.OP_SQ,
        ca.OP_TWICE,
        ca.OP_INV,
        ca.OP_ADD,
        ca.OP_SUB,
        ca.OP_MUL,
        ca.OP_DIV,
        ca.OP_POW,
        ca.OP_CONSTPOW,
    )
)
