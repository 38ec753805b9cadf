"""Names for what stands more than once in a long expression, so that a person can read it.

A learned curve is a sum over some twenty knots in which the same argument is written two hundred
times: 20 000 letters, of which 3000 say anything.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import casadi as ca

from ..signals import Expression
from .written import written

READABLE: Final = 240
"""Letters of an expression that is read as it stands: three lines of a terminal."""
WORTH: Final = 30
"""Letters of a piece from which a name is read faster than the piece itself: that of a name with
its operators is about as long as a shorter one."""

Abbreviation = tuple[Expression, Expression]
"""A symbol, and what it stands for."""


def abbreviated(
    expression: Expression, numbers: Iterator[int]
) -> tuple[Expression, tuple[Abbreviation, ...]]:
    """An expression with symbols for its long pieces that stand in it more than once.

    Parameters
    ----------
    expression : casadi.SX
        Scalar.
    numbers : iterator of int
        The next is that of the next symbol: ``s1``, ``s2``.

    Returns
    -------
    expression : casadi.SX
        As given where it is read as it stands.
    abbreviations : tuple of (symbol, definition)
        Each uses only those before it. Put in from the last to the first they give the expression
        back, operation by operation.
    """
    if len(written(expression)) <= READABLE:
        return expression, ()
    (short,), symbols, definitions = ca.shared([ca.cse(ca.SX(expression))], "shared_", "")
    pieces = {s.name(): (s, d) for s, d in zip(symbols, definitions, strict=True)}
    inside: list[Abbreviation] = []  # by what each shared piece is written
    named: list[Abbreviation] = []

    def put(piece: Expression) -> Expression:
        """With the pieces in it written as they will stand; those are settled first."""
        for x in ca.symvar(piece):
            if x.name() in pieces:
                symbol, definition = pieces.pop(x.name())
                body = put(definition)
                if len(written(body)) >= WORTH:
                    name = ca.SX.sym(f"s{next(numbers)}")
                    named.append((name, body))
                    body = name
                inside.append((symbol, body))
        if not inside:
            return piece
        old, new = zip(*inside, strict=True)
        return ca.substitute([piece], list(old), list(new))[0]

    return put(short), tuple(named)


__all__ = ["READABLE", "Abbreviation", "abbreviated"]
