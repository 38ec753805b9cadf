"""Formulas of columns: a channel that a file holds in parts, such as ``q1 - deflection``.

The text is parsed, never run: numbers, columns, ``+ - * / **``, brackets, ``pi`` and a few
functions are all there is.
"""

from __future__ import annotations

import ast
import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]

LONGEST: Final = 1000
"""Characters of a formula at most: a longer one belongs into the program that writes the file."""
DEEPEST: Final = 50
"""Brackets and operations inside one another at most, so that no text can exhaust the parser."""

FUNCTIONS: Final[Mapping[str, Callable[[Any], Any]]] = {
    "sqrt": np.sqrt,
    "abs": np.abs,
    "sin": np.sin,
    "cos": np.cos,
}
CONSTANTS: Final[Mapping[str, float]] = {"pi": math.pi}
_BINARY: Final[Mapping[type[ast.operator], Callable[[Any, Any], Any]]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
}
_SIGNS: Final[Mapping[type[ast.unaryop], Callable[[Any], Any]]] = {
    ast.UAdd: np.positive,
    ast.USub: np.negative,
}
_ALLOWED: Final = (
    f"it may hold columns, numbers, pi, + - * / **, brackets and {', '.join(FUNCTIONS)}"
)


@final
@dataclass(frozen=True)
class Formula:
    """A parsed formula.

    Attributes
    ----------
    text : str
        As it was written.
    columns : tuple of str
        The columns it uses, in the order in which they appear, each once.
    """

    text: str
    columns: tuple[str, ...]

    def values(self, columns: Mapping[str, npt.ArrayLike]) -> FloatArray:
        """The formula sample by sample.

        Parameters
        ----------
        columns : mapping of str to (n,) array
            Raw values, in the units of the file.

        Returns
        -------
        (n,) array

        Raises
        ------
        InputError
            A column that is not numeric; a sample where the formula gives no number though its
            columns do.
        """
        given = {}
        for name in self.columns:
            try:
                given[name] = np.asarray(columns[name], dtype=np.float64)
            except (ValueError, TypeError):
                raise InputError(
                    f"formula {self.text!r}: column {name!r} is not numeric: use another"
                ) from None
        with np.errstate(all="ignore"):
            out = np.asarray(
                _value(ast.parse(self.text.strip(), mode="eval").body, given), dtype=np.float64
            )
        whole = np.all([np.isfinite(v) for v in given.values()], axis=0)
        bad = np.flatnonzero(whole & ~np.isfinite(out))
        if bad.size:
            raise InputError(
                f"formula {self.text!r}: gives no number in row {bad[0] + 1} ({bad.size} in "
                "all): correct it"
            )
        return out


def parse_formula(text: str, names: tuple[str, ...]) -> Formula:
    """Read a formula of the columns `names`.

    Parameters
    ----------
    text : str
        For example ``"q1 - deflection"``; a name that is no plain word stands in quotes: ``"'motor
        angle' / 160"``.
    names : tuple of str
        Columns of the file.

    Raises
    ------
    InputError
        One line: what is not understood, or which column the file has not.
    """
    where = f"formula {text!r}"
    if len(text) > LONGEST:
        raise InputError(f"formula {text[:40]!r}...: longer than {LONGEST} characters: shorten it")
    try:
        body = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise InputError(
            f"{where}: not understood: {_ALLOWED}; put names with spaces in quotes"
        ) from None
    found: dict[str, None] = {}
    _check(body, where, names, found, 0)
    if not found:
        raise InputError(f"{where}: uses no column of the file: {_ALLOWED}")
    return Formula(text, tuple(found))


def _check(
    node: ast.AST, where: str, names: tuple[str, ...], found: dict[str, None], depth: int
) -> None:
    """Refuse what is not allowed, and note the columns."""
    if depth > DEEPEST:
        raise InputError(f"{where}: more than {DEEPEST} operations inside one another: simplify it")
    name = _column(node)
    if name is not None and (name in names or name not in CONSTANTS):
        if name not in names:
            near = difflib.get_close_matches(name, names, 1)
            hint = f", perhaps {near[0]!r}" if near else ""
            raise InputError(
                f"{where}: the file has no column {name!r}{hint}; it has "
                f"{', '.join(map(repr, names[:20]))}"
            )
        found[name] = None
    elif isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        _check(node.left, where, names, found, depth + 1)
        _check(node.right, where, names, found, depth + 1)
    elif isinstance(node, ast.UnaryOp) and type(node.op) in _SIGNS:
        _check(node.operand, where, names, found, depth + 1)
    elif (
        isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in FUNCTIONS
    ):
        if len(node.args) != 1 or node.keywords:
            raise InputError(f"{where}: {node.func.id} takes one value in brackets")
        _check(node.args[0], where, names, found, depth + 1)
    elif name is None and not _is_number(node):
        raise InputError(
            f"{where}: {ast.unparse(node)} is not allowed: {_ALLOWED}; put names with dots or "
            "spaces in quotes"
        )


def _column(node: ast.AST) -> str | None:
    """The name that a node stands for: a plain word, or a text in quotes."""
    if isinstance(node, ast.Name):
        return node.id
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None


def _is_number(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Constant)
        and isinstance(node.value, int | float)
        and not isinstance(node.value, bool)
    )


def _value(node: ast.expr, columns: Mapping[str, FloatArray]) -> Any:
    """Value of a checked node; numbers count as floating-point ones, so that no power grows
    without end.
    """
    name = _column(node)
    if name is not None:
        return columns[name] if name in columns else CONSTANTS[name]
    if isinstance(node, ast.BinOp):
        return _BINARY[type(node.op)](_value(node.left, columns), _value(node.right, columns))
    if isinstance(node, ast.UnaryOp):
        return _SIGNS[type(node.op)](_value(node.operand, columns))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return FUNCTIONS[node.func.id](_value(node.args[0], columns))
    return np.float64(node.value) if isinstance(node, ast.Constant) else np.nan  # type: ignore[arg-type]
