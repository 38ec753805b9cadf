"""Least squares whose amplitudes may have a sign, from normal equations."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

_NO_ROWS: Final = 1e-24
"""Share of the largest column's information below which a column counts as empty."""
_COLLINEAR: Final = 1e-12
"""Share of the largest information, columns scaled alike, below which a direction counts as
empty.
"""
_LEAST: Final = 1e-3
"""Share of the whole information on a direction that a part of the rows must hold to say
anything about it.
"""


def signed_fit(
    gram: FloatArray,
    right: FloatArray,
    lows: FloatArray,
    first: int,
    whole: FloatArray | None = None,
) -> FloatArray:
    """Solve normal equations; amplitudes with a lower bound of zero that come out negative are left
    out.

    Parameters
    ----------
    gram, right : (n, n) and (n,) arrays
        Normal equations, of all rows or of a part of them.
    lows : (k,) array
        Lower bounds of the unknowns from `first` on.
    first : int
        Number of unknowns of either sign.
    whole : (n, n) array, optional
        Normal matrix of all rows, where `gram` is of a part.  Directions on which that part holds
        next to nothing (friction at the one reversal of the block left out) stay at zero: the part
        cannot speak of them.
    """
    known = np.diag(gram if whole is None else whole)
    active = known > _NO_ROWS * max(float(known.max(initial=0.0)), 1e-300)
    out = np.zeros(len(right))
    for _ in range(len(lows) + 1):
        index = np.flatnonzero(active)
        part = np.ix_(index, index)
        if whole is None:
            white = _whitened(gram[part])
            solved = white @ (white.T @ right[index])
        else:
            solved = part_inverse(gram[part], whole[part]) @ right[index]
        out[:] = 0.0
        out[index] = solved
        wrong = [
            first + i
            for i, low in enumerate(lows)
            if low == 0.0 and active[first + i] and out[first + i] < 0
        ]
        if not wrong:
            break
        active[wrong] = False
    return out


def part_inverse(part: FloatArray, whole: FloatArray) -> FloatArray:
    """Inverse of the normal matrix of a part of the rows, on the directions of which that part
    holds a fair share of what all rows know; zero on the others.

    Parameters
    ----------
    part, whole : (n, n) arrays
        Normal matrices of the part and of all rows.
    """
    white = _whitened(whole)
    value, vector = np.linalg.eigh(white.T @ part @ white)
    kept = white @ vector[:, value > _LEAST]
    return np.asarray((kept / value[value > _LEAST]) @ kept.T, dtype=np.float64)


def inverse(gram: FloatArray) -> FloatArray:
    """Inverse of a normal matrix, zero on the directions of which the rows know nothing."""
    white = _whitened(gram)
    return np.asarray(white @ white.T, dtype=np.float64)


def _whitened(gram: FloatArray) -> FloatArray:
    """Columns W with W' gram W = 1, without the directions of which the rows know nothing."""
    scale = 1 / np.sqrt(np.diag(gram))
    value, vector = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = value > _COLLINEAR * float(value[-1]) if len(value) else np.zeros(0, dtype=bool)
    return np.asarray(scale[:, None] * vector[:, kept] / np.sqrt(value[kept]), dtype=np.float64)


def projected_gain(outside: FloatArray, residual: FloatArray, lows: FloatArray) -> float:
    """Fall of the weighted sum of squares when the projected columns are added (residual = base
    + J delta).
    """
    gram, right = outside.T @ outside, -(outside.T @ residual)
    delta = signed_fit(gram, right, lows, 0)
    return float(2 * right @ delta - delta @ gram @ delta)
