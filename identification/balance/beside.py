"""What is left of a measured torque beside all that it may follow from, whatever the laws are.

Clocks and slow noise are read from a record before any model: what a torque follows from is then a
linear combination of the motion, and of free curves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from identification.balance.weak import WeakRecord

FloatArray = npt.NDArray[np.float64]

DEVIATION: Final = 1.4826
"""Standard deviation of a normal value over the median of its size."""
BIWEIGHT: Final = 4.685
"""Deviations from which a row says nothing: 95 % of the efficiency of least squares on normal noise
(Holland, Welsch 1977).
"""
REWEIGHTED: Final = 15
"""Rounds of reweighting: the columns are fixed to a thousandth after ten."""
NODES: Final = 24
"""Nodes of a free curve, each with the same share of the samples: twelve in each direction follow a
Stribeck curve."""


def any_curve(record: WeakRecord, signal: str, kept: npt.NDArray[np.bool_]) -> FloatArray:
    """Columns of a free curve over a signal, shape (rows, nodes): whatever law of it there is."""
    points = record.points[signal]
    moving = points[points != 0.0] if np.any(points) else points
    nodes = np.unique(np.quantile(moving, np.linspace(0.0, 1.0, NODES)))
    hats = [np.interp(points, nodes, unit) for unit in np.eye(len(nodes))]
    return np.column_stack([record.average(hat)[kept] for hat in hats])


def motion_of(a: Mapping[str, FloatArray], side: str) -> list[FloatArray]:
    """What the torques of a side follow from, (rows,) each, from its averaged signals."""
    q, v = a[f"{side}_position"], a[f"{side}_velocity"]
    return [np.ones(len(v)), v, np.sign(v), a[f"{side}_acceleration"], np.sin(q), np.cos(q)]


def rest_beside(
    values: FloatArray, columns: Sequence[FloatArray], rounds: int = REWEIGHTED
) -> FloatArray:
    """What is left of the values (rows,) beside all columns, (rows,) or (rows, k) each, those that
    most rows agree on, after so many rounds of reweighting.
    """
    matrix = scaled(np.column_stack(columns))
    weight = np.ones(len(values))
    rest = values
    for _ in range(rounds):
        root = np.sqrt(weight)
        solution, *_ = np.linalg.lstsq(matrix * root[:, None], values * root, rcond=None)
        rest = values - matrix @ solution
        scale = DEVIATION * float(np.median(np.abs(rest)))
        if not scale:
            break
        weight = np.maximum(1.0 - (rest / (BIWEIGHT * scale)) ** 2, 0.0) ** 2
    return np.asarray(rest)


def bounded(x: FloatArray) -> FloatArray:
    """Tukey's bounded square: x^2 near zero, a third of `BIWEIGHT`^2 far away."""
    inside = np.minimum((x / BIWEIGHT) ** 2, 1.0)
    return np.asarray(BIWEIGHT**2 / 3.0 * (1.0 - (1.0 - inside) ** 3))


def scaled(matrix: FloatArray) -> FloatArray:
    """The columns of a matrix (rows, k) at unit length."""
    return np.asarray(matrix / np.maximum(np.linalg.norm(matrix, axis=0), 1e-300))


__all__ = ["BIWEIGHT", "DEVIATION", "any_curve", "bounded", "motion_of", "rest_beside", "scaled"]
