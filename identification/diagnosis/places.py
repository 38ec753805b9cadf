"""Places: the mean residual of a balance against one signal, with a band from the scatter between
blocks.

A missing effect shows in the place where it acts: the Stribeck effect against the velocity, a
cyclic torque against the link angle, ripple against the motor angle within a turn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models.quantities import linear_unit
from casadi_models.signals import one_line
from identification.balance.balances import balances_of
from identification.balance.kinematic import residual_unit
from identification.balance.weak import WeakRecord
from identification.diagnosis.locate import AXIS_R2, table_r2
from identification.diagnosis.locate import axes as signals_of_rows
from identification.fitting.engine import Dataset, Solution, stack

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

BINS: Final = 28
FEWEST_ROWS: Final = 10
TELLING_STRENGTH: Final = 2.5
"""Least strength of a place that tells something: the largest of all bins reaches 2 by chance."""
DIRECTION_SHARE: Final = 0.02
"""Share of variance by which a table per direction must beat a plain one to be shown as two
branches.
"""
SLOWEST_TURN: Final = 0.93
"""Turns of the motor within a kernel up to which a position-periodic residual keeps its size
(-3 dB).
"""

AXIS_TITLES: Final = {
    "motor_velocity": "velocity",
    "motor_angle": "motor angle within a turn",
    "motor_position": "position",
    "link_position": "link position",
    "load": "load (torque through the gear)",
    "torsion": "torsion (twist of the gear)",
    "temperature": "warming since the start",
    "time": "time, records end to end",
}


@final
@dataclass(frozen=True)
class Axis:
    """A signal against which residuals are binned.

    Attributes
    ----------
    name, title, unit : str
    values : (rows,) array
    use : (rows,) bool array
        Rows in which the residual can show a dependence on this signal.
    """

    name: str
    title: str
    unit: str
    values: FloatArray
    use: npt.NDArray[np.bool_]


@final
@dataclass(frozen=True)
class Branch:
    """One curve of a place: mean residual in bins, with its 95 % band.

    Attributes
    ----------
    direction : {"both", "forward", "backward"}
    centre : (bins,) array
        Mean of the signal in each bin.
    mean, low, high : (bins,) array
        Mean residual and its band; the band is NaN where fewer than two blocks reach a bin.
    rows : (bins,) int array
    """

    direction: str
    centre: FloatArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray
    rows: IntArray

    def __repr__(self) -> str:
        return one_line(self)


@final
@dataclass(frozen=True)
class Place:
    """Residual of a balance against one signal.

    Attributes
    ----------
    balance, axis, title, unit, residual_unit : str
    edges : (bins + 1,) array
    branches : tuple of Branch
        One, or one per direction of motion where the residual differs between them.
    share_percent : float
        Share of the residual's variance that the curve explains on blocks it was not drawn from; 0
        or less: none.
    strength : float
        Largest |mean| in units of the half width of its band; values up to about 2 are chance.
    """

    balance: str
    axis: str
    title: str
    unit: str
    residual_unit: str
    edges: FloatArray
    branches: tuple[Branch, ...]
    share_percent: float
    strength: float

    def __repr__(self) -> str:
        return one_line(self)

    @property
    def tells(self) -> bool:
        """True where the curve says something: it explains variance of blocks it was not drawn
        from.
        """
        return self.share_percent >= 100 * AXIS_R2 and self.strength >= TELLING_STRENGTH

    def as_json(self) -> dict[str, Any]:
        """The place as data; NaN becomes None."""
        return {
            "balance": self.balance,
            "axis": self.axis,
            "title": self.title,
            "unit": self.unit,
            "residual_unit": self.residual_unit,
            "share_percent": self.share_percent,
            "strength": self.strength,
            "branches": [
                {"direction": b.direction, "rows": b.rows.tolist()}
                | {k: _finite(getattr(b, k)) for k in ("centre", "mean", "low", "high")}
                for b in self.branches
            ],
        }


def _finite(values: FloatArray) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


@final
@dataclass(frozen=True)
class Rows:
    """The rows of some records: axes, blocks and direction of motion, ready for binning.

    Attributes
    ----------
    axes : mapping of str to Axis
    block : (rows,) int array
    forward : (rows,) bool array
    residual_unit : str
    """

    axes: Mapping[str, Axis]
    block: IntArray
    forward: npt.NDArray[np.bool_]
    residual_unit: str


def gather(data: Dataset, records: Sequence[WeakRecord] | None = None) -> Rows:
    """Axes of prepared records (the held-out ones where none are given)."""
    chosen = tuple(records if records is not None else (data.held_out or data.train))
    linear = data.joint.kind == "linear"
    found = signals_of_rows(chosen, data.sensing.has_torque)
    count = sum(w.rows for w in chosen)
    everywhere = np.ones(count, dtype=np.bool_)
    out: dict[str, Axis] = {}

    def put(
        name: str, values: FloatArray, unit: str, use: npt.NDArray[np.bool_] = everywhere
    ) -> None:
        out[name] = Axis(
            name, AXIS_TITLES[name], linear_unit(unit) if linear else unit, values, use
        )

    for name, (values, unit) in found.items():
        if name == "motor_velocity":
            put(name, values, unit)
            _motor_angle(put, data, chosen, values)
        elif name != "time":
            put(name, values, unit)
    if data.sensing.has_temperature:
        put("temperature", np.concatenate([w.averaged["temperature"] for w in chosen]), "K")
    put("time", running_time(chosen), "s")
    velocity = found["motor_velocity"][0]
    block = np.concatenate([w.block for w in chosen])
    unit = residual_unit(data.sensing.balances[0], data.joint.kind)
    return Rows(out, block, velocity > 0, unit)


def _motor_angle(
    put: Any, data: Dataset, records: Sequence[WeakRecord], velocity: FloatArray
) -> None:
    """The motor angle within a turn, where the motor turns often enough and slowly enough to be
    resolved.
    """
    ratio = abs(data.joint.gear_ratio)
    if data.joint.kind == "linear" or data.sensing.clamped_link:
        return
    angle = np.concatenate([w.averaged["motor_position"] for w in records]) * ratio
    slow = np.abs(velocity) * ratio * data.kernel < 2 * np.pi * SLOWEST_TURN
    if float(np.ptp(angle)) < 4 * np.pi or int(slow.sum()) < 20 * FEWEST_ROWS:
        return
    put("motor_angle", np.mod(angle, 2 * np.pi), "rad", slow)


def running_time(records: Sequence[WeakRecord]) -> FloatArray:
    """Time of each row [s], zero where a record begins; records, and runs whose stamps start anew,
    laid end to end.

    A record that is alone keeps its own stamps where they do not go back.
    """
    parts, offset = [], 0.0
    for w in records:
        steps = np.diff(w.time)
        # stamps that go back begin a new run: it goes on one kernel later
        steps = np.where(steps > 0, steps, w.grid.length)
        origin = float(w.time[0]) if len(records) == 1 else 0.0
        t = origin + np.concatenate([[0.0], np.cumsum(steps)])
        parts.append(t + offset)
        offset += float(t[-1]) + w.grid.length
    return np.concatenate(parts)


def bin_edges(values: FloatArray, *, through_zero: bool = False, bins: int = BINS) -> FloatArray:
    """Edges of bins with enough rows each; finer near zero and split at zero for a velocity.

    Parameters
    ----------
    values : (n,) array
    through_zero : bool
        Edges grow with the square of their distance from zero, and zero is an edge.
    bins : int
        At most.
    """
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return np.array([low, low + 1e-12 + abs(low) * 1e-9])
    if through_zero and low < 0 < high:
        u = np.linspace(0, 1, bins // 2 + 1)[1:] ** 2
        below = _merged(np.concatenate([low * u[::-1], [0.0]]), values[values < 0], bins)
        above = _merged(np.concatenate([[0.0], high * u]), values[values >= 0], bins)
        return np.concatenate([below, above[1:]])
    inner = np.quantile(values, [0.003, 0.997])
    wanted = np.concatenate([[low], np.linspace(inner[0], inner[1], bins + 1)[1:-1], [high]])
    return _merged(np.unique(wanted), values, bins)


def _merged(edges: FloatArray, values: FloatArray, bins: int) -> FloatArray:
    """Neighbouring bins joined until each holds enough rows."""
    fewest = max(FEWEST_ROWS, len(values) // (12 * bins))
    count = np.histogram(values, edges)[0]
    kept, held = [float(edges[0])], 0
    for number, edge in zip(count, edges[1:], strict=True):
        held += int(number)
        if held >= fewest:
            kept.append(float(edge))
            held = 0
    if len(kept) == 1:
        kept.append(float(edges[-1]))
    kept[-1] = float(edges[-1])
    return np.array(kept)


def student(freedom: FloatArray) -> FloatArray:
    """97.5 % quantile of Student's t (Cornish-Fisher series in 1/freedom; 1 % off at 3 degrees
    of freedom).
    """
    v = np.maximum(freedom, 1.0)
    return 1.95996 + 2.37227 / v + 2.82250 / v**2 + 2.55585 / v**3 + 1.58954 / v**4


def branch(
    direction: str, residual: FloatArray, values: FloatArray, block: IntArray, edges: FloatArray
) -> Branch:
    """Mean residual per bin with a 95 % band, blocks taken as the independent draws.

    Parameters
    ----------
    direction : str
    residual, values : (n,) array
    block : (n,) int array
        Rows of block -1 do not count.
    edges : (bins + 1,) array
    """
    size = len(edges) - 1
    inside = (block >= 0) & (values >= edges[0]) & (values <= edges[-1])
    index = np.clip(np.searchsorted(edges, values[inside], side="right") - 1, 0, size - 1)
    number, ordered = np.unique(block[inside], return_inverse=True)
    shape = (max(len(number), 1), size)
    key = ordered * size + index
    count = np.bincount(key, minlength=shape[0] * size).reshape(shape)
    total = np.bincount(key, weights=residual[inside], minlength=shape[0] * size).reshape(shape)
    rows = count.sum(axis=0)
    mean = total.sum(axis=0) / np.maximum(rows, 1)
    seen = (count > 0).sum(axis=0)
    scatter = np.sum((total - count * mean) ** 2, axis=0)
    spread = np.sqrt(scatter * seen / np.maximum(seen - 1, 1)) / np.maximum(rows, 1)
    half = np.where(seen > 1, student(seen - 1.0) * spread, np.nan)
    centre = np.bincount(index, weights=values[inside], minlength=size) / np.maximum(rows, 1)
    kept = rows > 0
    return Branch(
        direction,
        centre[kept],
        mean[kept],
        (mean - half)[kept],
        (mean + half)[kept],
        rows[kept].astype(np.int64),
    )


def place(
    rows: Rows, residual: FloatArray, balance: str, axis: str, *, like: Place | None = None
) -> Place:
    """Residual of a balance against one axis.

    Parameters
    ----------
    rows : Rows
    residual : (n,) array
        NaN in rows that take no part.
    balance, axis : str
    like : Place, optional
        Take its bins and branches: for a comparison of two models.
    """
    a = rows.axes[axis]
    use = a.use & np.isfinite(residual)
    r, values, block, forward = residual[use], a.values[use], rows.block[use], rows.forward[use]
    edges = (
        like.edges if like is not None else bin_edges(values, through_zero=axis == "motor_velocity")
    )
    size = len(edges) - 1
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, size - 1).astype(np.int64)
    centred = r - r.mean()
    plain = table_r2(centred, index, block, size)
    both = (
        table_r2(centred, index * 2 + forward, block, 2 * size)
        if axis != "motor_velocity"
        else plain
    )
    split = len(like.branches) > 1 if like is not None else both > max(plain, 0.0) + DIRECTION_SHARE
    parts = (
        (("forward", forward), ("backward", ~forward))
        if split
        else (("both", np.ones(len(r), dtype=np.bool_)),)
    )
    branches = tuple(branch(name, r[m], values[m], block[m], edges) for name, m in parts)
    return Place(
        balance,
        axis,
        title=a.title,
        unit=a.unit,
        residual_unit=rows.residual_unit,
        edges=edges,
        branches=branches,
        share_percent=100 * (max(plain, both) if split else plain),
        strength=max(_strength(b) for b in branches),
    )


def _strength(b: Branch) -> float:
    half = (b.high - b.low) / 2
    known = np.isfinite(half) & (half > 0)
    return float(np.max(np.abs(b.mean[known]) / half[known], initial=0.0))


def residuals(
    solution: Solution, data: Dataset, records: Sequence[WeakRecord] | None = None
) -> dict[str, FloatArray]:
    """Residual of every balance on the rows of records (the held-out ones where none are
    given); NaN where a record takes no part.
    """
    chosen = tuple(records if records is not None else (data.held_out or data.train))
    balances = balances_of(solution.model, data.sensing, wrt=())
    return stack(balances, chosen, solution.values).shown


def places(
    solution: Solution,
    data: Dataset,
    records: Sequence[WeakRecord] | None = None,
    *,
    rows: Rows | None = None,
) -> tuple[Place, ...]:
    """Residual of every balance against every axis, the most telling first.

    Parameters
    ----------
    solution : Solution
        A fitted model.
    data : Dataset
    records : sequence of WeakRecord, optional
        The held-out ones where none are given.
    rows : Rows, optional
        From :func:`gather`, if it was called before on the same records.
    """
    return places_of(
        residuals(solution, data, records), rows if rows is not None else gather(data, records)
    )


def places_of(residual: Mapping[str, FloatArray], rows: Rows) -> tuple[Place, ...]:
    """All places of given residuals, the most telling first."""
    found = [place(rows, r, balance, axis) for balance, r in residual.items() for axis in rows.axes]
    return tuple(sorted(found, key=lambda p: (-max(p.share_percent, 0.0), -p.strength)))


def worst_window(
    time: FloatArray,
    power: FloatArray,
    length: float,
    stretch: npt.NDArray[np.int64] | None = None,
) -> tuple[float, float]:
    """Window of a length in which most of a power stands.

    Parameters
    ----------
    time : (rows,) array
        [s].
    power : (rows,) array
        NaN counts for nothing.
    length : float
        [s].
    stretch : (rows,) array of int, optional
        The window does not reach over a hole or from one run into the next.

    Returns
    -------
    tuple of float
        Its first and last stamp [s].
    """
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    width = max(1, min(len(time), round(length / max(step, 1e-9))))
    total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(power))])
    summed = total[width:] - total[:-width]
    if stretch is not None:
        whole = stretch[: len(stretch) - width + 1] == stretch[width - 1 :]
        summed = np.where(whole, summed, -1.0) if whole.any() else summed
    k = int(np.argmax(summed))
    return float(time[k]), float(time[k + width - 1])
