"""The part of an expression that is a straight line in some inputs, read from its graph and not
from its derivative.

A derivative cannot tell: that of a dead band, a saturation or a sign is constant, or zero, on
either side of a kink, and looks like that of a straight line.
"""

from __future__ import annotations

from typing import Any, Final, final

import casadi as ca

from .signals import Expression

_THROUGH: Final = {ca.OP_ASSIGN: 1.0, ca.OP_NEG: -1.0, ca.OP_TWICE: 2.0}
Line = dict[int, Expression]
"""Slope of each input, by its number."""


@final
class AffineParts:
    """Splits expressions into slopes times inputs and a rest that holds all that is not a straight
    line.

    Parameters
    ----------
    inputs : (n, 1) SX
        Symbols that vary along a record and may enter on a straight line.
    others : (k, 1) SX
        Symbols that vary too but stay in the rest (internal states).
    """

    def __init__(self, inputs: Expression, others: Expression) -> None:
        self._inputs = {inputs[i].element_hash(): i for i in range(inputs.shape[0])}
        self._others = {others[i].element_hash() for i in range(others.shape[0])}
        self._varies: dict[int, bool] = {}
        self._alive: list[Any] = []

    def split(self, expression: Expression) -> tuple[Line, Expression]:
        """Slopes (free of inputs and others) and rest of a scalar: expression = sum of slopes
        times inputs + rest.
        """
        mark = expression.element_hash()
        if mark in self._inputs:
            return {self._inputs[mark]: ca.SX(1)}, ca.SX(0)
        if not self._varying(expression) or expression.n_dep() == 0:
            return {}, expression
        op, first = expression.op(), expression.dep(0)
        if op in _THROUGH:
            return _scaled(self.split(first), lambda x: _THROUGH[op] * x)
        if op in (ca.OP_ADD, ca.OP_SUB):
            sign = 1.0 if op == ca.OP_ADD else -1.0
            line, rest = self.split(first)
            more, left = self.split(expression.dep(1))
            return {
                i: line.get(i, ca.SX(0)) + sign * more.get(i, ca.SX(0)) for i in {**line, **more}
            }, rest + sign * left
        if op == ca.OP_MUL:
            for factor, other in ((first, expression.dep(1)), (expression.dep(1), first)):
                if not self._varying(factor):
                    return _scaled(self.split(other), lambda x, by=factor: x * by)
        if op == ca.OP_DIV and not self._varying(expression.dep(1)):
            return _scaled(self.split(first), lambda x: x / expression.dep(1))
        return {}, expression

    def _varying(self, expression: Expression) -> bool:
        """Whether an input or one of the others is anywhere in the expression."""
        mark = expression.element_hash()
        if mark not in self._varies:
            self._alive.append(expression)  # a hash is an address: it must not be used again
            leaf = expression.n_dep() == 0
            known = mark in self._inputs or mark in self._others
            self._varies[mark] = (
                known
                if leaf
                else any(self._varying(expression.dep(i)) for i in range(expression.n_dep()))
            )
        return self._varies[mark]


def _scaled(parts: tuple[Line, Expression], by: Any) -> tuple[Line, Expression]:
    line, rest = parts
    return {i: by(slope) for i, slope in line.items()}, rest if rest.is_zero() else by(rest)
