"""Cheaper forms of a CasADi function: common subexpressions once, harmonics of one angle from one
sine and cosine.

The values stay the same up to rounding: sin 2a = 2 sin a cos a, cos 2a = 1 - 2 sin^2 a, and a
division by a number is a multiplication by its inverse.
"""

from __future__ import annotations

from typing import Any, Final, final

import casadi as ca

_MOST: Final = 4
"""Doublings of an angle: each adds about two units in the last place."""


def cheaper(function: Any, name: str) -> Any:
    """The function with common subexpressions, harmonics and divisions by numbers written cheaply.

    Parameters
    ----------
    function : casadi.Function
        Of scalar expressions (SX).
    name : str
        Of the new function.
    """
    arguments = function.sx_in()
    flat = ca.Function("flat", arguments, [ca.densify(e) for e in function.call(arguments)])
    found = _Rewriter(flat).outputs(arguments)
    shaped = [ca.reshape(e, *flat.size_out(i)) for i, e in enumerate(found)]
    return ca.Function(name, arguments, ca.cse(shaped))


@final
class _Rewriter:
    """Builds the outputs anew, instruction by instruction, with a number for each different
    value.
    """

    def __init__(self, function: Any) -> None:
        self.function = function
        self.values: list[Any] = []
        self.numbers: dict[tuple[Any, ...], int] = {}
        self.constant: dict[int, float] = {}
        self.multiple: dict[int, tuple[int, float]] = {}
        self.angles: dict[int, set[float]] = {}

    def outputs(self, arguments: list[Any]) -> list[Any]:
        """Expressions of the outputs, in the arguments."""
        out = [ca.SX.zeros(self.function.nnz_out(i)) for i in range(self.function.n_out())]
        for final_pass in (False, True):  # the first pass only collects the angles
            self.values, self.numbers, self.constant, self.multiple = [], {}, {}, {}
            work: dict[int, int] = {}
            for k in range(self.function.n_instructions()):
                self._instruction(k, arguments, work, out if final_pass else None)
        return out

    def _number(self, key: tuple[Any, ...], make: Any) -> int:
        if key not in self.numbers:
            self.numbers[key] = len(self.values)
            self.values.append(make())
        return self.numbers[key]

    def _instruction(
        self, k: int, arguments: list[Any], work: dict[int, int], out: list[Any] | None
    ) -> None:
        f = self.function
        op, into, of = f.instruction_id(k), f.instruction_output(k), f.instruction_input(k)
        if op == ca.OP_OUTPUT:
            if out is not None:
                out[into[0]][into[1]] = self.values[work[of[0]]]
        elif op == ca.OP_INPUT:
            work[into[0]] = self._number(("input", *of), lambda: arguments[of[0]].nz[of[1]])
        elif op == ca.OP_CONST:
            work[into[0]] = self._constant(f.instruction_constant(k))
        elif len(of) == 1:
            work[into[0]] = self._unary(op, work[of[0]])
        else:
            work[into[0]] = self._binary(op, work[of[0]], work[of[1]])

    def _constant(self, value: float) -> int:
        number = self._number(("constant", value), lambda: ca.SX(value))
        self.constant[number] = value
        return number

    def _unary(self, op: int, a: int) -> int:
        if op == ca.OP_NEG and a in self.multiple:
            inner, factor = self.multiple[a]
            return self._product(inner, -factor)
        if op in (ca.OP_SIN, ca.OP_COS):
            inner, factor = self.multiple.get(a, (a, 1.0))
            self.angles.setdefault(inner, set()).add(abs(factor))
            size = self._turned(op, inner, abs(factor))
            return (
                size
                if op == ca.OP_COS or factor >= 0
                else self._number((ca.OP_NEG, size), lambda: -self.values[size])
            )
        return self._number((op, a), lambda: ca.SX.unary(op, self.values[a]))

    def _turned(self, op: int, inner: int, factor: float) -> int:
        """Sine or cosine of factor times a value, through half the angle where that is needed
        anyway.
        """
        base = min(
            (f for f in self.angles[inner] for m in range(1, _MOST + 1) if f * 2**m == factor),
            default=factor,
        )
        if base == factor:
            angle = self._product(inner, factor)
            return self._number((op, angle), lambda: ca.SX.unary(op, self.values[angle]))
        s, c = (self._turned(o, inner, factor / 2) for o in (ca.OP_SIN, ca.OP_COS))
        if op == ca.OP_SIN:
            return self._number(("double", op, s, c), lambda: 2 * (self.values[s] * self.values[c]))
        return self._number(("double", op, s), lambda: 1 - 2 * (self.values[s] * self.values[s]))

    def _product(self, inner: int, factor: float) -> int:
        if factor == 1.0:
            return inner
        number = self._number(("times", inner, factor), lambda: factor * self.values[inner])
        self.multiple[number] = (inner, factor)
        return number

    def _binary(self, op: int, a: int, b: int) -> int:
        if op == ca.OP_MUL and (a in self.constant) != (b in self.constant):
            a, b = (b, a) if a in self.constant else (a, b)
            inner, factor = self.multiple.get(a, (a, 1.0))
            return self._product(inner, factor * self.constant[b])
        if (
            op == ca.OP_DIV
            and b in self.constant
            and a not in self.constant
            and 1e-100 < abs(self.constant[b]) < 1e100
        ):
            inner, factor = self.multiple.get(a, (a, 1.0))
            return self._product(inner, factor * (1.0 / self.constant[b]))
        return self._number((op, a, b), lambda: ca.SX.binary(op, self.values[a], self.values[b]))


__all__ = ["cheaper"]
