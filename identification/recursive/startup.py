"""Start values of the recursive least squares from a window of samples (thesis 3.5 and 4.3.3)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]


class StartupOutcome(Enum):
    """What the start-up window could carry; the value is the sentence a user reads."""

    FULL_RANK = "The window determines every parameter."
    RANK_DEFICIENT = (
        "The window does not determine every parameter: some were removed and stay "
        "at their start values."
    )
    NOTHING_DETERMINED = "The window determines no parameter: all stay at their start values."


@final
@dataclass(frozen=True)
class Startup:
    """Result of the start-up window.

    Attributes
    ----------
    theta
        Start values, shape (parameters,), user units; removed parameters keep theta0.
    covariance
        Covariance of the start values, shape (parameters, parameters), user units.
    singular_values
        Of the scaled and weighted regressor (dimensionless), shape (parameters,): each given to the
        parameter that dominates its right singular vector, as in table 4.4 of the thesis.
    removed
        Names of the parameters removed (frozen), in the order of removal.
    removed_index
        Their positions.
    residual_variance
        Variance of the residual of each output, shape (outputs,).
    samples, dropped
        Samples used, and samples left out for NaN or infinity.
    outcome
        A `StartupOutcome`.
    """

    theta: FloatArray
    covariance: FloatArray
    singular_values: FloatArray
    removed: tuple[str, ...]
    removed_index: tuple[int, ...]
    residual_variance: FloatArray
    samples: int
    dropped: int
    outcome: StartupOutcome

    @property
    def alarm(self) -> bool:
        """True when parameters were removed."""
        return bool(self.removed)

    def __str__(self) -> str:
        """One sentence, and the names of the removed parameters."""
        names = f" Removed: {', '.join(self.removed)}." if self.removed else ""
        return f"{self.outcome.value}{names}"


def solve_window(
    y: FloatArray,
    h: FloatArray,
    theta0: FloatArray,
    scale: FloatArray,
    names: tuple[str, ...],
    *,
    limit: float,
    noise: FloatArray | None,
) -> Startup:
    """Least squares of a window by SVD, (3.47) to (3.49), without the parameters it cannot carry.

    Parameters
    ----------
    y, h
        Outputs (samples, outputs) and regressors (samples, outputs, parameters).
    theta0, scale
        Start values and prior ranges of all parameters.
    names
        Names of the parameters.
    limit
        Singular-value limit, relative to the largest singular value.
    noise
        R2 of each output, or None: then from the residuals of a first unweighted pass.
    """
    good = np.isfinite(y).all(axis=1) & np.isfinite(h).all(axis=(1, 2))
    if not good.any():
        raise InputError(
            "startup: the window holds no sample without NaN or infinity; give another window"
        )
    y, h = y[good], h[good]
    free = np.ones(theta0.size, dtype=bool)
    removed: list[int] = []
    known = noise if noise is not None else _first_noise(y, h, theta0, scale, limit)
    weight = 1.0 / np.sqrt(known)
    left = (y - h @ theta0) * weight
    scaled = h * scale * weight[:, None]
    matrix, target = scaled.reshape(-1, theta0.size), left.reshape(-1)
    table = _table(matrix)
    while free.any():
        _, sigma, vt = np.linalg.svd(matrix[:, free], full_matrices=False)
        count = int(free.sum())
        sigma = np.concatenate([sigma, np.zeros(count - sigma.size)])
        if sigma[0] > 0 and sigma[-1] > limit * sigma[0]:
            break
        place = np.flatnonzero(free)
        worst = int(place[np.argmax(np.abs(_weakest(matrix[:, free], vt)))])
        free[worst] = False
        removed.append(worst)
    theta, covariance = theta0.copy(), np.diag(scale**2)
    if free.any():
        u, sigma, vt = np.linalg.svd(matrix[:, free], full_matrices=False)
        step = vt.T @ ((u.T @ target) / sigma)
        theta[free] += scale[free] * step
        place = np.flatnonzero(free)
        part = (vt.T / (1.0 + sigma**2)) @ vt
        covariance[np.ix_(place, place)] = part * np.outer(scale[place], scale[place])
    outcome = (
        StartupOutcome.FULL_RANK
        if not removed
        else StartupOutcome.RANK_DEFICIENT
        if free.any()
        else StartupOutcome.NOTHING_DETERMINED
    )
    return Startup(
        theta,
        covariance,
        singular_values=table,
        removed=tuple(names[i] for i in removed),
        removed_index=tuple(removed),
        residual_variance=_variance(y - h @ theta, y, int(free.sum())),
        samples=int(good.sum()),
        dropped=int((~good).sum()),
        outcome=outcome,
    )


def _weakest(matrix: FloatArray, vt: FloatArray) -> FloatArray:
    """Right singular vector of the smallest singular value, also where there are fewer rows
    than columns.
    """
    if vt.shape[0] == vt.shape[1]:
        found: FloatArray = vt[-1]
        return found
    _, _, full = np.linalg.svd(matrix, full_matrices=True)
    last: FloatArray = full[-1]
    return last


def _table(matrix: FloatArray) -> FloatArray:
    """Singular values in the order of the parameters they belong to."""
    _, sigma, vt = np.linalg.svd(matrix, full_matrices=matrix.shape[0] < matrix.shape[1])
    sigma = np.concatenate([sigma, np.zeros(matrix.shape[1] - sigma.size)])
    table = np.zeros(matrix.shape[1])
    strength = np.abs(vt)
    for _ in range(matrix.shape[1]):
        row, column = np.unravel_index(int(np.argmax(strength)), strength.shape)
        table[column] = sigma[row]
        strength[row, :] = -1.0
        strength[:, column] = -1.0
    return table


def _first_noise(
    y: FloatArray, h: FloatArray, theta0: FloatArray, scale: FloatArray, limit: float
) -> FloatArray:
    """Residual variance of each output after an unweighted pass."""
    matrix = (h * scale).reshape(-1, theta0.size)
    step = np.linalg.lstsq(matrix, (y - h @ theta0).reshape(-1), rcond=max(limit, 1e-12))[0]
    return _variance(y - h @ (theta0 + scale * step), y, theta0.size)


def _variance(residual: FloatArray, y: FloatArray, parameters: int) -> FloatArray:
    """Variance of each output's residual, kept above the rounding of the output."""
    degrees = max(1.0, residual.shape[0] - parameters / residual.shape[1])
    floor = 1e-24 * np.mean(y**2, axis=0) + 1e-30
    variance: FloatArray = np.maximum(np.sum(residual**2, axis=0) / degrees, floor)
    return variance
