"""Standard errors from blocks of time, honest with few blocks too."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FEWEST_BLOCKS: Final = 4
"""Blocks below which their scatter says nothing."""


def block_errors(jacobian: FloatArray, residual: FloatArray, block: IntArray) -> FloatArray | None:
    """Standard error of each parameter of a least-squares fit whose rows depend on each other within blocks.

    The leave-one-block-out form of the sandwich (Bell and McCaffrey 2002, Survey Methodology 28:169), widened by the
    ratio of Student's t over blocks - 1 degrees of freedom to the normal at 95 %: twice the error is a 95 % band.

    Parameters
    ----------
    jacobian : (n, p) array
        Weighted, in any scale of its columns.
    residual : (n,) array
        Weighted, at the fit.
    block : (n,) int array
        Block of each row, -1 for none: such rows take part in the fit only.

    Returns
    -------
    (p,) array, or None with fewer than `FEWEST_BLOCKS` blocks.
    """
    from scipy.special import stdtrit

    numbers = np.unique(block[block >= 0])
    if len(numbers) < FEWEST_BLOCKS:
        return None
    gram = jacobian.T @ jacobian
    order = np.argsort(block, kind="stable")
    leave = []
    for rows in np.split(order, np.searchsorted(block[order], numbers))[1:]:
        part = jacobian[rows]
        left = np.linalg.pinv(gram - part.T @ part, rcond=1e-12, hermitian=True)
        leave.append(left @ (part.T @ residual[rows]))
    shifts = np.array(leave)
    count = len(numbers)
    covariance = shifts.T @ shifts * (count - 1) / count
    wider = float(stdtrit(count - 1, 0.975)) / 1.959964
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)) * wider, dtype=np.float64)
