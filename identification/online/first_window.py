"""Least squares of the first window, before the recursion starts, and weights of rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from identification.recursive.estimator import RecursiveLeastSquares, Settings

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


ABSENT: Final = 1e-30
"""Size under which a column holds nothing but rounding (a sensor that stands still from the
first sample on).
"""


RANGE: Final = 0.01
"""Share of the torque that a parameter moves at least within its prior range; what moves less is
not seen beside a floor of a thousandth of it, ten times over."""
PASSES: Final = 3
"""Passes in which the weights at reversals follow from the estimate; the third changes them by less
than a hundredth."""
DEVIATION: Final = 1.5
"""Standard deviation over median size of normal residuals (1.48)."""
RIDGE: Final = 1e-5
"""Weight of the rows theta = 0 beside columns of unit length: a direction that is 1000 times weaker
than its columns loses one part in ten thousand, one that rounding alone shows stays at zero."""


def shared(size: FloatArray, like: IntArray) -> FloatArray:
    """The largest of the sizes (parameters,) of those that are of one size: the control value of a
    curve that no row has reached yet is as large as the others.

    Parameters
    ----------
    size : (parameters,) array
    like : (parameters,) int array
        :attr:`identification.online.rows.RowMaker.like`.
    """
    most = np.zeros_like(size)
    np.maximum.at(most, like, size)
    return np.asarray(most[like])


def least_range(h: FloatArray, y: FloatArray, like: IntArray) -> FloatArray:
    """Smallest prior range of each parameter: what moves the balances by a hundredth of their
    torque.

    Parameters
    ----------
    h : (rows, balances, parameters) array
    y : (rows, balances) array
    like
        As in :func:`shared`.
    """
    size = shared(np.sqrt(np.mean(h**2, axis=(0, 1))), like)
    level = float(np.sqrt(np.mean(y**2))) or 1.0
    found: FloatArray = np.where(size > ABSENT, RANGE * level / np.maximum(size, ABSENT), 1.0)
    return found


def prior_range(
    first: FloatArray,
    before: FloatArray,
    h: FloatArray,
    y: FloatArray,
    usual: FloatArray,
    like: IntArray,
) -> FloatArray:
    """Prior range of each parameter, (parameters,): the usual one where there is one, else its size
    in the first estimate or before, and never under :func:`least_range`.

    Parameters
    ----------
    first, before : (parameters,) array
        Estimates of the window, and from before it.
    h, y
        As in :func:`least_range`.
    usual : (parameters,) array
        :attr:`identification.online.rows.RowMaker.usual`.
    like
        As in :func:`shared`.
    """
    size = shared(np.maximum(np.abs(first), np.abs(before)), like)
    found: FloatArray = np.where(usual > 0, usual, np.maximum(size, least_range(h, y, like)))
    return found


def least_squares(y: FloatArray, h: FloatArray, least: FloatArray, like: IntArray) -> FloatArray:
    """Least squares with columns of equal size and balances of equal residual; what no row shows
    stays at zero. Control values of one curve keep their sizes beside each other: one that a row
    touches by a millionth is none to be told.

    Parameters
    ----------
    y, h
        As in :func:`least_range`.
    least : (balances,) array
        Residual of each balance at least [N.m].
    like
        As in :func:`shared`.
    """
    count = h.shape[2]
    weight = 1.0 / np.maximum(np.sqrt(np.mean(y**2, axis=0)), least)
    theta = np.zeros(count)
    for _ in range(2):
        rows = (h * weight[:, None]).reshape(-1, count)
        size = shared(np.linalg.norm(rows, axis=0), like)
        shrink = np.where(size > ABSENT, 1 / np.maximum(size, ABSENT), 0.0)
        target = (y * weight).ravel()
        ridge = np.vstack([rows * shrink, RIDGE * np.eye(count)])
        stacked = np.column_stack([ridge, np.concatenate([target, np.zeros(count)])])
        triangle: FloatArray = np.asarray(np.linalg.qr(stacked, mode="r"))
        theta = np.asarray(
            np.linalg.solve(triangle[:count, :count], triangle[:count, count]) * shrink,
            dtype=np.float64,
        )
        weight = 1.0 / np.maximum(np.sqrt(np.mean((y - h @ theta) ** 2, axis=0)), least)
    return theta


def told_beside_noise(
    y: FloatArray, h: FloatArray, theta: FloatArray, noise: FloatArray, period: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A window without the entries of H that stand in their own noise.

    At steady speed an acceleration is noise of the encoder, and seven seconds of it took an inertia
    to a twentieth with a small error. Such an entry says nothing of its parameter: its part is
    taken off y with the value from before, as the recursion does
    (:meth:`identification.recursive.estimator.RecursiveLeastSquares.set_entry_noise`).

    Parameters
    ----------
    y, h
        As in :func:`least_range`, row after row.
    theta : (parameters,) array
        Values from before the window.
    noise : (balances, parameters) array
        Variance of the noise of the entries.
    period : float
        Time between two rows [s].

    Returns
    -------
    y and h of what counts, and the mean squares at the end, (balances, parameters)
    """
    settings = Settings(sample_time=period)
    hides, rate = settings.shown_over * noise, settings.shown_rate
    told, square = np.empty(h.shape, dtype=np.bool_), h[0] ** 2
    for k, row in enumerate(h):
        square = square + rate * (row**2 - square)
        told[k] = square >= hides
    left: FloatArray = y - np.where(told, 0.0, h) @ theta
    return left, np.where(told, h, 0.0), square


def first_estimate(
    y: FloatArray,
    h: FloatArray,
    least: FloatArray,
    like: IntArray,
    weight_of: Callable[[FloatArray, FloatArray], FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Least squares of the first window with weights that follow from it.

    Parameters
    ----------
    y, h, least, like
        As in :func:`least_squares`.
    weight_of : callable
        (parameters, size of the residuals (balances,)) -> weights (rows, balances).

    Returns
    -------
    parameters and weights
    """
    weight = np.ones_like(y)
    for _ in range(PASSES):
        first = least_squares(y * weight, h * weight[:, :, None], least, like)
        size = DEVIATION * np.median(np.abs(y - h @ first), axis=0)
        weight = weight_of(first, np.maximum(size, least))
    return first, weight


def fast_recursion(
    outputs: int,
    names: tuple[str, ...],
    like: IntArray,
    settings: Settings,
    values: FloatArray,
    scale: FloatArray,
) -> RecursiveLeastSquares:
    """Recursive least squares, its step compiled where there is a compiler; the numbers are the
    same without.
    """
    made = RecursiveLeastSquares(
        values, scale, outputs=outputs, names=names, settings=settings, alike=like.tolist()
    )
    made.compile()
    return made
