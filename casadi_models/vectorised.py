"""Evaluate a CasADi SX function on many points at once by running its instructions on numpy arrays.

The same expression graph, another interpreter: one numpy operation per instruction in place of one
virtual-machine step per instruction and point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Operation = Callable[..., Any]

_UNARY: Final[dict[int, Operation]] = {
    ca.OP_ASSIGN: lambda x: x,
    ca.OP_NEG: np.negative,
    ca.OP_EXP: np.exp,
    ca.OP_LOG: np.log,
    ca.OP_SQRT: np.sqrt,
    ca.OP_SQ: np.square,
    ca.OP_TWICE: lambda x: x + x,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_TAN: np.tan,
    ca.OP_ASIN: np.arcsin,
    ca.OP_ACOS: np.arccos,
    ca.OP_ATAN: np.arctan,
    ca.OP_FLOOR: np.floor,
    ca.OP_CEIL: np.ceil,
    ca.OP_FABS: np.abs,
    ca.OP_SIGN: np.sign,
    ca.OP_INV: np.reciprocal,
    ca.OP_SINH: np.sinh,
    ca.OP_COSH: np.cosh,
    ca.OP_TANH: np.tanh,
    ca.OP_ASINH: np.arcsinh,
    ca.OP_ACOSH: np.arccosh,
    ca.OP_ATANH: np.arctanh,
    ca.OP_LOG1P: np.log1p,
    ca.OP_EXPM1: np.expm1,
    ca.OP_NOT: lambda x: np.where(np.equal(x, 0), 1.0, 0.0),
}
_BINARY: Final[dict[int, Operation]] = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_POW: np.power,
    ca.OP_CONSTPOW: np.power,
    ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax,
    ca.OP_ATAN2: np.arctan2,
    ca.OP_HYPOT: np.hypot,
    ca.OP_FMOD: np.fmod,
    ca.OP_COPYSIGN: np.copysign,
    ca.OP_LT: lambda a, b: np.less(a, b) * 1.0,
    ca.OP_LE: lambda a, b: np.less_equal(a, b) * 1.0,
    ca.OP_EQ: lambda a, b: np.equal(a, b) * 1.0,
    ca.OP_NE: lambda a, b: np.not_equal(a, b) * 1.0,
    ca.OP_AND: lambda a, b: np.logical_and(a, b) * 1.0,
    ca.OP_OR: lambda a, b: np.logical_or(a, b) * 1.0,
    ca.OP_IF_ELSE_ZERO: lambda c, x: np.where(np.equal(c, 0), 0.0, x),
}
CHUNK: Final = 16384
"""Points evaluated at a time, so that the intermediate arrays stay in the cache."""


def _is_rows(argument: Any) -> bool:
    """Whether an argument is given as its rows."""
    return isinstance(argument, tuple) and any(np.ndim(row) for row in argument)


def _of_part(argument: Any, part: slice) -> Any:
    """An argument at some of the points."""
    if isinstance(argument, tuple):
        return [row[part] for row in argument]
    return argument if argument.ndim == 1 else argument[:, part]


@final
class Vectorised:
    """A CasADi SX function with vector inputs, evaluated on arrays of points.

    Parameters
    ----------
    function : casadi.Function
        Expanded (SX) function whose inputs are column vectors and whose one output is a column.
    """

    def __init__(self, function: Any) -> None:
        self.size_out = int(function.size1_out(0))
        self._function = function
        self._work = int(function.sz_w())
        self._program: list[tuple[int, Any, tuple[int, ...], tuple[int, ...]]] = []
        self._supported = True
        for k in range(function.n_instructions()):
            op = int(function.instruction_id(k))
            inputs = tuple(int(i) for i in function.instruction_input(k))
            outputs = tuple(int(i) for i in function.instruction_output(k))
            if op == ca.OP_CONST:
                self._program.append((0, float(function.instruction_constant(k)), inputs, outputs))
            elif op == ca.OP_INPUT:
                self._program.append((1, None, inputs, outputs))
            elif op == ca.OP_OUTPUT:
                self._program.append((2, None, inputs, outputs))
            elif op in _UNARY:
                self._program.append((3, _UNARY[op], inputs, outputs))
            elif op in _BINARY:
                self._program.append((4, _BINARY[op], inputs, outputs))
            else:
                self._supported = False

    def __call__(self, points: int, *arguments: Any) -> FloatArray:
        """Evaluate at `points` points.

        Parameters
        ----------
        points : int
        *arguments : (size,) or (size, points) array per input
            Or a tuple of such rows (points,), each where it is.

        Returns
        -------
        (size_out, points) array
        """
        out = np.zeros((self.size_out, points))
        self._fill(out, arguments)
        return out

    def by_point(self, points: int, *arguments: Any) -> FloatArray:
        """As a call, the outputs of each point beside each other: shape (points, size_out)."""
        out = np.zeros((points, self.size_out))
        self._fill(out.T, arguments)
        return out

    def _fill(self, out: FloatArray, arguments: Sequence[Any]) -> None:
        """Write the outputs, (size_out, points)."""
        if not self.size_out:
            return
        given = [a if _is_rows(a) else np.asarray(a, dtype=np.float64) for a in arguments]
        if not self._supported:
            whole = [np.stack(a) if isinstance(a, tuple) else a for a in given]
            out[:] = np.array(self._function(*whole)).reshape(out.shape)
            return
        points = out.shape[1]
        with np.errstate(all="ignore"):
            for first in range(0, points, CHUNK):
                part = slice(first, min(first + CHUNK, points))
                self._run([_of_part(a, part) for a in given], out[:, part])

    def _run(self, given: list[Any], out: FloatArray) -> None:
        work: list[Any] = [0.0] * (self._work + 1)
        for kind, what, inputs, outputs in self._program:
            if kind == 4:
                work[outputs[0]] = what(work[inputs[0]], work[inputs[1]])
            elif kind == 3:
                work[outputs[0]] = what(work[inputs[0]])
            elif kind == 1:
                work[outputs[0]] = given[inputs[0]][inputs[1]]
            elif kind == 0:
                work[outputs[0]] = what
            else:
                out[outputs[1]] = work[inputs[0]]
