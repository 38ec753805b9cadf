"""The part of an expression that is a straight line in some inputs, read from its graph and not
from its derivative.

A derivative cannot tell: that of a dead band, a saturation or a sign is constant, or zero, on
either side of a kink, and looks like that of a straight line.
"""

from __future__ import annotations

from operator import neg
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
            line, rest = self.split(first)
            more, left = self.split(expression.dep(1))
            if op == ca.OP_SUB:
                more, left = _scaled((more, left), neg)
            both = {**line, **more}
            both.update({i: line[i] + more[i] for i in line.keys() & more.keys()})
            return both, rest + left
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


_COMPARISONS: Final = (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE)


def settled(expression: Expression, p: Expression, values: Expression) -> Expression:
    """An expression with every comparison of parameters alone decided as it is at given values.

    A law may ask whether an amplitude is above zero. It is linear in that amplitude all the same,
    but only as long as the answer stays: an expression taken apart at zero would give the other.

    Parameters
    ----------
    expression : (n, 1) SX
    p : (k, 1) SX
        Symbols of the parameters.
    values : (k,) array
        Where the comparisons are decided.
    """
    given = ca.symvar(expression)
    walk = ca.Function("walk", given, [expression])
    known = {p[i].element_hash() for i in range(p.shape[0])}
    own = [s.element_hash() in known for s in given]
    work: dict[int, tuple[Any, bool]] = {}
    out = ca.SX.zeros(expression.shape[0])
    rows = walk.sparsity_out(0).row()
    for k in range(walk.n_instructions()):
        op, into = walk.instruction_id(k), walk.instruction_output(k)
        source = walk.instruction_input(k)
        if op == ca.OP_INPUT:
            work[into[0]] = given[source[0]], own[source[0]]
        elif op == ca.OP_CONST:
            work[into[0]] = ca.SX(walk.instruction_constant(k)), True
        elif op == ca.OP_OUTPUT:
            out[rows[into[1]]] = work[source[0]][0]
        else:
            taken = [work[i] for i in source]
            alone = all(free for _, free in taken)
            operands = [node for node, _ in taken]
            node = ca.SX.binary(op, *operands) if len(operands) == 2 else ca.SX.unary(op, *operands)
            if op in _COMPARISONS and alone:
                (node,) = ca.substitute([node], [p], [ca.SX(values)])
            work[into[0]] = node, alone
    return out
