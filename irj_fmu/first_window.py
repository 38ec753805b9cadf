"""Least squares of the first window, before the recursion starts."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def least_range(h: FloatArray, y: FloatArray) -> FloatArray:
    """Smallest prior range of each parameter: what moves the balances by a hundredth of their torque.

    Parameters
    ----------
    h : (rows, balances, parameters) array
    y : (rows, balances) array
    """
    size = np.sqrt(np.mean(h**2, axis=(0, 1)))
    level = float(np.sqrt(np.mean(y**2))) or 1.0
    found: FloatArray = np.where(size > 0, 0.01 * level / np.maximum(size, 1e-300), 1.0)
    return found


def least_squares(y: FloatArray, h: FloatArray) -> FloatArray:
    """Least squares with columns of equal size and balances of equal residual; smallest solution without full rank."""
    count = h.shape[2]
    weight = np.ones(y.shape[1])
    theta = np.zeros(count)
    for _ in range(2):
        rows = (h * weight[:, None]).reshape(-1, count)
        size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        theta = np.linalg.lstsq(rows / size, (y * weight).ravel(), rcond=1e-9)[0] / size
        left = np.sqrt(np.mean((y - h @ theta) ** 2, axis=0))
        weight = 1.0 / np.maximum(left, 1e-12 + 1e-9 * float(np.max(np.abs(y))))
    return theta
