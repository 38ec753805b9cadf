"""Start of a recursion from a window of rows and the prior of its parameters; no parameter is
removed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]

UNDETERMINED: Final = 0.1
"""Posterior over prior variance above which a window does not determine a parameter: its standard
deviation is then still a third of its prior range, so that not even its order of magnitude is
known."""
PRIOR_PASSES: Final = 3
"""Passes in which the weights of the outputs follow from their residuals; the third changes
them by rounding only.
"""


@final
@dataclass(frozen=True)
class PriorStart:
    """Parameters of a window, with their prior as further rows.

    Attributes
    ----------
    theta : (parameters,) array
    covariance : (parameters, parameters) array
        Posterior, user units; equal to the prior in directions that the window does not show.
    share : (parameters,) array
        Posterior over prior variance, 0 to 1.
    noise : (outputs,) array
        Variance of each output's residual, never under its floor.
    rows : int
        Rows without NaN and infinity.
    """

    theta: FloatArray
    covariance: FloatArray
    share: FloatArray
    noise: FloatArray
    rows: int

    @property
    def undetermined(self) -> tuple[int, ...]:
        """Positions of the parameters that the window does not determine by themselves."""
        return tuple(int(i) for i in np.flatnonzero(self.share > UNDETERMINED))


def solve_with_prior(
    y: FloatArray,
    h: FloatArray,
    theta0: FloatArray,
    scale: FloatArray,
    least: FloatArray,
    overlap: float,
) -> PriorStart:
    """Least squares of a window and of theta = theta0 +- scale, by QR of [H scale / sqrt(R2); I].

    Parameters
    ----------
    y, h : (rows, outputs) and (rows, outputs, parameters) array
    theta0, scale : (parameters,) array
        Prior mean and standard deviation.
    least : (outputs,) array
        Standard deviation of each output's noise at least. An output without noise would otherwise
        weigh so much more than the others that rounding hides what those say.
    overlap : float
        Variance of a mean of rows over that of as many independent ones
        (:attr:`identification.online.timing.Timing.overlap`).

    Raises
    ------
    InputError
        No row is free of NaN and infinity.
    """
    good = np.isfinite(y).all(axis=1) & np.isfinite(h).all(axis=(1, 2))
    if not good.any():
        raise InputError(
            "startup: the window holds no sample without NaN or infinity; give another window"
        )
    y, h = y[good], h[good]
    n = theta0.size
    left, scaled = y - h @ theta0, h * scale
    floor = np.maximum(least**2, np.finfo(float).tiny)
    noise = np.maximum(np.mean(left**2, axis=0), floor)
    for _ in range(PRIOR_PASSES + 1):
        weight = 1.0 / np.sqrt(overlap * noise)
        rows = np.vstack([(scaled * weight[:, None]).reshape(-1, n), np.eye(n)])
        target = np.concatenate([(left * weight).ravel(), np.zeros(n)])
        triangle: FloatArray = np.asarray(np.linalg.qr(np.column_stack([rows, target]), mode="r"))
        step = np.linalg.solve(triangle[:n, :n], triangle[:n, n])
        degrees = max(1.0, len(y) - n / y.shape[1])
        noise = np.maximum(np.sum((left - scaled @ step) ** 2, axis=0) / degrees, floor)
    inverse = np.linalg.inv(triangle[:n, :n])
    posterior = inverse @ inverse.T
    covariance = posterior * np.outer(scale, scale)
    return PriorStart(theta0 + scale * step, covariance, np.diag(posterior).copy(), noise, len(y))
