"""What is left of a measured torque beside all that it may follow from, whatever the laws are.

Clocks and slow noise are read from a record before any model: what a torque follows from is then a
linear combination of the motion, and of free curves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.weak import WeakRecord

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

DEVIATION: Final = 1.4826
"""Standard deviation of a normal value over the median of its size."""
LINEAR: Final = 1.345
"""Deviations from which a row counts by its size and no more by its square: 95 % of the efficiency
of least squares on normal noise (Huber 1981). Sizes have one minimum; a sum that leaves far rows
out has several, and lets go of the very rows that tell two candidates apart.
"""
BIWEIGHT: Final = 4.685
"""Deviations from which a row says nothing where candidates are compared: the same efficiency
(Holland, Welsch 1977).
"""
REWEIGHTED: Final = 15
"""Rounds of reweighting: the columns are fixed to a thousandth after ten."""
NODES: Final = 24
"""Nodes of a free curve, each with the same share of the samples: twelve in each direction follow a
law of fast motion."""
ROUNDING: Final = 1e-10
"""Share of the largest direction of the columns that rounding over thousands of rows can make."""
AT_A_TIME: Final = 2048
"""Rows multiplied or turned at a time: with a hundred columns they stay in the cache."""
TOLD_BY_PRODUCTS: Final = 1e-8
"""Share of the largest of the powers of directions from which products of columns tell one: to half
of their digits."""
HALVINGS: Final = 6
"""Further nodes over a velocity on either side of zero, each at half of the one before: what
friction does in slow motion, a Stribeck curve or its turn over a few mrad/s, is over before a share
of the samples is.
"""


def curve_nodes(records: Sequence[WeakRecord], signal: str) -> FloatArray:
    """Nodes (nodes,) of a free curve over a signal of these records."""
    points = np.concatenate([w.points[signal] for w in records])
    moving = points[points != 0.0] if np.any(points) else points
    nodes = np.quantile(moving, np.linspace(0.0, 1.0, NODES))
    if signal.endswith("velocity"):
        slow = 2 * float(np.quantile(np.abs(moving), 1 / NODES)) * 0.5 ** np.arange(HALVINGS)
        nodes = np.clip([*nodes, *slow, *-slow], nodes[0], nodes[-1])
    return np.unique(nodes)


def any_curve(
    record: WeakRecord,
    signal: str,
    kept: npt.NDArray[np.bool_],
    nodes: FloatArray | None = None,
    turning: str | None = None,
) -> FloatArray:
    """Columns of a free curve over a signal, shape (rows, nodes): whatever law of it there is.

    `nodes`: those of a curve that other records have, too; else the record's own. `turning`: the
    signal with whose sign the curve turns its own, as friction does.
    """
    from scipy.sparse import csr_array

    points = record.points[signal]
    nodes = curve_nodes([record], signal) if nodes is None else nodes
    left, share = between(points, nodes)
    shares = np.column_stack([1.0 - share, share])
    if turning is not None:
        shares *= np.sign(record.points[turning])[:, None]
    # two values to a point: with its zeros the matrix is ten times as many
    curve = csr_array(
        (shares.ravel(), (left[:, None] + (0, 1)).ravel(), 2 * np.arange(len(points) + 1)),
        shape=(len(points), len(nodes) + 1),
    )
    averaged = (record.averaging @ curve).toarray()
    return np.asarray(averaged[:, : len(nodes)][kept], dtype=np.float64)


def between(points: FloatArray, nodes: FloatArray) -> tuple[IntArray, FloatArray]:
    """The node (n,) to the left of each point (n,), and how much of the way to the next one it is
    beyond it, 0 to 1; outside the nodes as at the first or the last.
    """
    left = np.clip(np.searchsorted(nodes, points, side="right") - 1, 0, max(len(nodes) - 2, 0))
    if len(nodes) < 2:
        return left, np.zeros(len(points))
    share = (points - nodes[left]) / np.diff(nodes)[left]
    return left, np.clip(share, 0.0, 1.0, out=share)


def motion_of(a: Mapping[str, FloatArray], side: str) -> list[FloatArray]:
    """What the torques of a side follow from, (rows,) each, from its averaged signals."""
    q, v = a[f"{side}_position"], a[f"{side}_velocity"]
    return [np.ones(len(v)), v, np.sign(v), a[f"{side}_acceleration"], np.sin(q), np.cos(q)]


def rest_beside(
    values: FloatArray,
    columns: Sequence[FloatArray],
    rounds: int = REWEIGHTED,
    *,
    without_far: bool = False,
) -> FloatArray:
    """What is left of the values (rows,) beside all columns, (rows,) or (rows, k) each, as most
    rows have it, after so many rounds of reweighting.

    `without_far`: from there on, and for as many rounds, rows that are far off say nothing (Yohai
    1987). It finds what is small beside them, but only near where it begins.
    """
    return Basis.of(columns).rest(values, rounds, without_far=without_far)


@final
@dataclass(frozen=True)
class Basis:
    """What values are laid beside, made once for all of them.

    Attributes
    ----------
    columns : (rows, k) array
        Orthonormal.
    products : (k, k) array
        Of the columns.
    """

    columns: FloatArray
    products: FloatArray

    @classmethod
    def of(cls, columns: Sequence[FloatArray]) -> Basis:
        """Of columns, (rows,) or (rows, k) each."""
        basis = orthonormal(columns)
        return cls(basis, _products([basis]))

    def rest(
        self,
        values: FloatArray,
        rounds: int = REWEIGHTED,
        *,
        without_far: bool = False,
        counting: npt.NDArray[np.bool_] | None = None,
    ) -> FloatArray:
        """See :func:`rest_beside`; `counting`: the rows (rows,) that take part, if not all do."""

        def beside(weight: FloatArray) -> FloatArray:
            # most rows count whole: what the others lack is taken off
            less = np.flatnonzero(weight != 1.0)
            lacking = _products([self.columns], less, 1.0 - weight[less])
            seen = (weight * values) @ self.columns
            solution, *_ = np.linalg.lstsq(self.products - lacking, seen, rcond=None)
            return np.asarray(values - self.columns @ solution)

        taken = np.ones(len(values), dtype=np.bool_) if counting is None else counting
        weight, scale, rest = taken.astype(np.float64), 0.0, values
        for _ in range(rounds):
            rest = beside(weight)
            scale = DEVIATION * float(np.median(np.abs(rest[taken])))
            if not scale:
                return rest
            size = np.maximum(np.abs(rest), max(LINEAR * scale, 1e-300))
            weight = np.where(taken, LINEAR * scale / size, 0.0)
        for _ in range(rounds if without_far else 0):
            near = np.maximum(1.0 - (rest / (BIWEIGHT * scale)) ** 2, 0.0) ** 2
            rest = beside(np.where(taken, near, 0.0))
        return rest


def orthonormal(columns: Sequence[FloatArray], weight: FloatArray | None = None) -> FloatArray:
    """Columns (rows, any) that span the same as those given, (rows,) or (rows, k) each, but for
    directions that rounding makes; orthonormal where each row counts by its weight (rows,).

    By the products of the columns as far as these tell: their digits are half of those of the
    columns. What is left of the smaller directions beside the others is taken apart itself.
    """
    products = _products(columns, weight=weight)
    size = np.sqrt(np.diag(products))
    size = np.where(size > 0, size, 1.0)
    powers, turn = np.linalg.eigh(products / size / size[:, None])
    sure = powers > TOLD_BY_PRODUCTS * powers[-1]
    turn /= size[:, None]
    first, rest = turn[:, sure] / np.sqrt(powers[sure]), turn[:, ~sure]
    if rest.shape[1]:
        for _ in range(2):  # twice: the first time leaves what rounding makes of the others
            rest = rest - first @ (first.T @ products @ rest)
        small = _turned(columns, rest)
        left = small if weight is None else small * np.sqrt(weight)[:, None]
        _, sizes, directions = np.linalg.svd(np.linalg.qr(left, mode="r"), full_matrices=False)
        kept = sizes > ROUNDING * math.sqrt(powers[-1])
        rest = rest @ (directions[kept].T / sizes[kept])
    return _turned(columns, np.column_stack([first, rest]))


def _turned(columns: Sequence[FloatArray], turn: FloatArray) -> FloatArray:
    """Columns times a matrix (k, any)."""
    out = np.empty((len(columns[0]), turn.shape[1]))
    for rows in _in_turn(len(out)):
        np.matmul(np.column_stack([x[rows] for x in columns]), turn, out=out[rows])
    return out


def _in_turn(count: int) -> list[slice]:
    """So many rows, :data:`AT_A_TIME` of them at a time."""
    return [slice(first, first + AT_A_TIME) for first in range(0, count, AT_A_TIME)]


def _products(
    columns: Sequence[FloatArray],
    rows: IntArray | None = None,
    weight: FloatArray | None = None,
) -> FloatArray:
    """Products (k, k) of columns, (rows,) or (rows, k) each: of all rows, or of some that count by
    a weight.
    """
    out: FloatArray | float = 0.0
    for part in _in_turn(len(columns[0]) if rows is None else len(rows)):
        seen = np.column_stack([x[part if rows is None else rows[part]] for x in columns])
        seen = seen if weight is None else seen * np.sqrt(weight[part])[:, None]
        out = out + seen.T @ seen
    return np.asarray(out)


def bounded(x: FloatArray) -> FloatArray:
    """Tukey's bounded square: x^2 near zero, a third of `BIWEIGHT`^2 far away."""
    inside = np.minimum((x / BIWEIGHT) ** 2, 1.0)
    return np.asarray(BIWEIGHT**2 / 3.0 * (1.0 - (1.0 - inside) ** 3))


def scaled(matrix: FloatArray) -> FloatArray:
    """The columns of a matrix (rows, k) at unit length."""
    return np.asarray(matrix / np.maximum(np.linalg.norm(matrix, axis=0), 1e-300))


__all__ = [
    "BIWEIGHT",
    "Basis",
    "DEVIATION",
    "any_curve",
    "between",
    "bounded",
    "curve_nodes",
    "orthonormal",
    "motion_of",
    "rest_beside",
    "scaled",
]
