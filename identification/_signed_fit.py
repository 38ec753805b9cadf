"""Least squares whose amplitudes may have a sign, from normal equations."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def signed_fit(gram: FloatArray, right: FloatArray, lows: FloatArray, first: int) -> FloatArray:
    """Least squares from normal equations; amplitudes with a lower bound of zero that come out negative are left out."""
    active = np.ones(len(right), dtype=bool)
    out = np.zeros(len(right))
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    g = gram / np.outer(scale, scale)
    b = right / scale
    for _ in range(len(lows) + 1):
        index = np.flatnonzero(active)
        part = np.linalg.lstsq(g[np.ix_(index, index)] + 1e-12 * np.eye(len(index)), b[index], rcond=1e-12)[0]
        out[:] = 0.0
        out[index] = part / scale[index]
        wrong = [first + i for i, low in enumerate(lows) if low == 0.0 and active[first + i] and out[first + i] < 0]
        if not wrong:
            break
        active[wrong] = False
    return out


def projected_gain(outside: FloatArray, residual: FloatArray, lows: FloatArray) -> float:
    """Fall of the weighted sum of squares when the projected columns are added (residual = base + J delta)."""
    gram, right = outside.T @ outside, -(outside.T @ residual)
    delta = signed_fit(gram, right, lows, 0)
    return float(2 * right @ delta - delta @ gram @ delta)
