"""Friction about the instants at which it changes its sign, as unknowns of their own.

A velocity comes from a kernel, and around a turn the acceleration jumps by what dry friction does:
the instant of the turn is some milliseconds wrong, always to the same side.  Such an error is even
in time about the turn, as an acceleration is and the laws of friction are not, so least squares
made an inertia of it.  At each point about a turn the friction may be that of either direction: an
unknown of its own takes it.  One for each turn would not do: what is wrong stands some milliseconds
beside the turn, and where the kernel is steep that is another column.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import balances_of
from identification.balance.stacked import TURN_SHARE, rms, stack, sticking_torque, taking_part
from identification.balance.weak import RESTING_SIDES, WeakRecord, whole
from identification.fitting.weak_form import WeakForm

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

ONE_TURN: Final = 0.5
"""Share of a kernel within which changes of sign are one turn: noise about a slow one makes
several, and rows do not tell them apart.
"""
FEWEST_QUIET: Final = 100
"""Rows that no turn touches from which their RMS is known to a tenth: four rows to a kernel, of
which two fifths are independent."""


@final
@dataclass(frozen=True)
class Turns:
    """What unknown friction about the turns may add to the weighted rows of a problem.

    Attributes
    ----------
    columns : (rows, points) sparse array or None
        What the friction at one point is usually off by, in the noise of its balance; None where
        nothing turns under dry friction.
    factors : object or None
        Their normal matrix with that of the usual errors, factorised.
    """

    columns: Any = None
    factors: Any = None

    def without(self, rows: FloatArray) -> FloatArray:
        """Weighted rows (rows,) or columns (rows, p) less what this friction explains."""
        if self.columns is None:
            return rows
        explained = self.columns @ self.factors.solve(np.asarray(self.columns.T @ rows))
        return np.asarray(rows - explained, dtype=np.float64)


@final
@dataclass(frozen=True)
class WithoutTurns:
    """The rows of a problem less what friction about its turns explains; a
    :class:`identification.fitting.least_squares.Problem`."""

    problem: WeakForm
    turns: Turns

    def residual(self, x: FloatArray) -> FloatArray:
        """Weighted rows, (rows,)."""
        return self.turns.without(self.problem.residual(x))

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Their derivative, (rows, free)."""
        return self.turns.without(self.problem.jacobian(x))


def turns_of(problem: WeakForm) -> Turns:
    """The turns of a problem's training records under the dry friction of its values.

    A law with memory says itself what happens at a turn; inside a gap nothing is told of it.
    """
    model = problem.balances.model
    remembers = {t.place for t in model.terms if t.effect.memory is not None}
    levels = {
        side: level
        for side in ("motor", "link")
        if side not in remembers and (level := sticking_torque(model, problem.values, side))
    }
    if not levels or problem.balances.has_gap:
        return Turns()
    parts = [
        (balance, first, record, side)
        for balance in range(len(problem.balances.balances))
        for first, record in zip(_first_rows(problem), problem.data.train, strict=True)
        for side in RESTING_SIDES.get(problem.balances.balances[balance], ())
        if side in levels and f"{side}_velocity" in record.points
    ]
    rows, columns, values, count = [], [], [], 0
    for balance, first, record, side in parts:
        name = problem.balances.balances[balance]
        found = (record.averaging @ (levels[side] * _at_turns(record, side))).tocoo()
        row, column = found.coords
        own = slice(first, first + record.rows)
        weight = np.broadcast_to(problem.weights[name], (problem.rows,))[own] * record.taking(name)
        rows.append(balance * problem.rows + first + row)
        columns.append(count + column)
        values.append(found.data * weight[row])
        count += found.shape[1]
    if not count:
        return Turns()
    row, value = np.concatenate(rows), np.concatenate(values)
    noise = _noise_beside(problem, row[value != 0])
    total = len(problem.balances.balances) * problem.rows + len(problem.prior)
    return _factorised(
        row, np.concatenate(columns), value / noise[row // problem.rows], (total, count)
    )


def _noise_beside(problem: WeakForm, touched: IntArray) -> FloatArray:
    """RMS of the weighted rows of each balance that no turn touches, (balances,).

    The turns themselves are most of what a balance leaves where it turns, so that the weights take
    noise for several times what it is: by them each row would tell next to nothing of a turn.
    """
    bare_ones = balances_of(problem.balances.model, problem.data.sensing, wrt=())
    left = stack(bare_ones, problem.data.train, problem.values).residual
    apart = np.ones(len(problem.balances.balances) * problem.rows, dtype=np.bool_)
    apart[touched] = False
    out = np.ones(len(problem.balances.balances))
    for k, b in enumerate(problem.balances.balances):
        own = apart[k * problem.rows : (k + 1) * problem.rows]
        own = own & taking_part(b, problem.data.train)
        level = rms((left[b] * problem.weights[b])[own])
        if own.sum() >= FEWEST_QUIET and level > 0:
            out[k] = level
    return out


def _first_rows(problem: WeakForm) -> list[int]:
    """First row of each training record."""
    counts = [w.rows for w in problem.data.train]
    return [sum(counts[:k]) for k in range(len(counts))]


def _at_turns(record: WeakRecord, side: str) -> Any:
    """Sparse (points, unknowns): RMS of what the friction at each point about a turn is off by, in
    its level: twice the level where the instant of the turn lies beyond the point.

    The velocity is that of a kernel, so that its change of sign is no farther from the true one
    than half of that.
    """
    from scipy.sparse import csc_array
    from scipy.special import ndtr

    speed = record.points[f"{side}_velocity"]
    grid = record.grid
    spacing = grid.step * grid.dt
    kernel = grid.pointwise[f"{side}_position"] / spacing
    apart = max(1, whole(ONE_TURN * grid.length / spacing))
    at = np.flatnonzero(np.diff(np.sign(speed)) != 0)
    crossing = at + np.abs(speed[at]) / np.abs(speed[at + 1] - speed[at])
    ends = np.flatnonzero(np.diff(at) > apart) + 1
    off = np.zeros(len(speed))
    for x in np.split(crossing, ends) if len(at) else ():
        first = max(math.ceil(x[0] - kernel / 2), 0)
        points = np.arange(first, min(math.floor(x[-1] + kernel / 2), len(speed) - 1) + 1)
        away = np.maximum(np.maximum(x[0] - points, points - x[-1]), 0.0)
        off[points] = np.maximum(off[points], 2 * np.sqrt(ndtr(-away / (TURN_SHARE * kernel))))
    where = np.flatnonzero(off)
    placed = (off[where], (where, np.arange(len(where))))
    return csc_array(placed, shape=(len(speed), len(where)))


def _factorised(
    row: IntArray, column: IntArray, value: FloatArray, shape: tuple[int, int]
) -> Turns:
    """Columns that any row sees, with the factors of their normal matrix."""
    from scipy.sparse import csc_array, csc_matrix, identity
    from scipy.sparse.linalg import splu

    seen = np.flatnonzero(np.bincount(column, value**2, shape[1]) > 0)
    if not len(seen):
        return Turns()
    columns = csc_array((value, (row, column)), shape=shape)[:, seen]
    normal = csc_matrix(columns.T @ columns) + identity(len(seen), format="csc")
    return Turns(columns, splu(csc_matrix(normal)))


__all__ = ["Turns", "WithoutTurns", "turns_of"]
