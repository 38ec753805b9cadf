"""The instants at which dry friction changes its sign, as unknowns of their own.

A velocity comes from a kernel, and around a turn the acceleration jumps by what dry friction does:
the instant of the turn is some milliseconds wrong, always to the same side.  Such an error is even
in time about the turn, as an acceleration is and the laws of friction are not, so least squares
made an inertia of it.  An unknown instant for each turn takes it: rows and columns lose what
friction that changes its sign some milliseconds sooner or later would give them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import Balances
from identification.balance.stacked import TURN_SHARE, friction_rows, sticking_torque
from identification.balance.weak import RESTING_SIDES, WeakRecord, whole

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

ONE_TURN: Final = 0.5
"""Share of a kernel within which changes of sign are one turn: noise about a slow one makes
several, and rows do not tell them apart.
"""


@final
@dataclass(frozen=True)
class Turns:
    """What unknown instants of the turns may add to the weighted rows of a problem.

    Attributes
    ----------
    columns : (rows, turns) sparse array or None
        In units of what the error of an instant usually adds; None where nothing turns under dry
        friction.
    factors : object or None
        Their normal matrix with that of the usual errors, factorised.
    """

    columns: Any = None
    factors: Any = None

    def without(self, rows: FloatArray) -> FloatArray:
        """Weighted rows (rows,) or columns (rows, p) less what these instants explain."""
        if self.columns is None:
            return rows
        explained = self.columns @ self.factors.solve(np.asarray(self.columns.T @ rows))
        return np.asarray(rows - explained, dtype=np.float64)


def turns_of(
    balances: Balances,
    records: Sequence[WeakRecord],
    values: Mapping[str, float],
    weights: Mapping[str, FloatArray],
    more: int = 0,
) -> Turns:
    """The turns of records under the dry friction of a model's values.

    A law with memory says itself what happens at a turn; inside a gap nothing is told of it.

    Parameters
    ----------
    balances : Balances
    records : sequence of WeakRecord
    values : mapping of str to float
    weights : mapping of str to (rows,) array
        1/deviation of each row, by balance.
    more : int
        Rows that follow those of the balances and know nothing of a turn.
    """
    model = balances.model
    remembers = {t.place for t in model.terms if t.effect.memory is not None}
    levels = {
        side: level
        for side in ("motor", "link")
        if side not in remembers and (level := sticking_torque(model, values, side))
    }
    if not levels or balances.has_gap:
        return Turns()
    ends = np.cumsum([0, *(w.rows for w in records)])
    each = int(ends[-1])
    parts = [
        (balance, first, record, side)
        for balance in range(len(balances.balances))
        for first, record in zip(ends.tolist(), records, strict=False)
        for side in RESTING_SIDES.get(balances.balances[balance], ())
        if side in levels and f"{side}_velocity" in record.points
    ]
    rows, columns, values_, count = [], [], [], 0
    for balance, first, record, side in parts:
        name = balances.balances[balance]
        passed_on = sum(friction_rows(model, values, record, side))
        found = (passed_on @ (levels[side] * _at_turns(record, side))).tocoo()
        row, column = found.coords
        weight = weights[name][first : first + record.rows] * record.taking(name)
        rows.append(balance * each + first + row)
        columns.append(count + column)
        values_.append(found.data * weight[row])
        count += found.shape[1]
    if not count:
        return Turns()
    total = len(balances.balances) * each + more
    return _factorised(
        np.concatenate(rows), np.concatenate(columns), np.concatenate(values_), (total, count)
    )


def _at_turns(record: WeakRecord, side: str) -> Any:
    """Sparse (points, turns): what one standard error of its instant adds to a friction of 1 at the
    points of a turn; over a slow one the friction may have acted either way.
    """
    from scipy.sparse import csc_array

    speed = record.points[f"{side}_velocity"]
    grid = record.grid
    spacing = grid.step * grid.dt
    apart = max(1, whole(ONE_TURN * grid.length / spacing))
    at = np.flatnonzero(np.diff(np.sign(speed)) != 0)
    turns = np.split(at, np.flatnonzero(np.diff(at) > apart) + 1) if len(at) else []
    points = [np.arange(t[0], t[-1] + 2) for t in turns]
    count = np.array([len(p) for p in points], dtype=np.int64)
    where = np.concatenate([*points, np.empty(0, dtype=np.int64)])
    which = np.repeat(np.arange(len(points)), count)
    late = TURN_SHARE * grid.pointwise[f"{side}_position"] / spacing
    size = 1 + 2 * late / np.maximum(count, 1)
    return csc_array((size[which], (where, which)), shape=(len(speed), len(points)))


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


__all__ = ["Turns", "turns_of"]
