"""How well the poles of a subspace model are known: the blocks of the records left out in turn.

Every block is compressed once; the triangles of all blocks but one are then folded together, so
that a second look at the samples is not needed. What noise, start values and unmodelled friction
change from block to block shows in the poles.

Source: the jackknife over blocks of a dependent series, Kunsch, Ann. Stat. 17 (1989) 1217-1241.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from identification.linear.hankel_qr import HankelQR, Method

FloatArray = npt.NDArray[np.float64]

BLOCKS: Final = 12
"""Blocks at most: the relative error of a deviation from twelve is about 1/sqrt(2 * 11), a fifth.
"""
FEWEST: Final = 4
"""Blocks under which a deviation would be little more than a guess."""


def pole_covariances(
    records: Sequence[tuple[FloatArray, FloatArray]],
    block_rows: int,
    a: FloatArray,
    method: Method,
    weights: Sequence[float],
) -> FloatArray | None:
    """Covariances of the eigenvalues of a MOESP model's state matrix.

    Parameters
    ----------
    records : sequence of (u, y)
        Arrays (samples, channels), as they were given to `moesp`.
    block_rows : int
    a : (n, n) array
        The model's state matrix.
    method : {"ordinary", "past_output"}
    weights : sequence of float
        Factors on the outputs.

    Returns
    -------
    (n, 2, 2) array or None
        Covariance of real and imaginary part, in the order of `numpy.linalg.eigvals(a)`; None
        where the records give fewer than four blocks.
    """
    from scipy.optimize import linear_sum_assignment

    order = len(a)
    blocks = _blocks(records, block_rows, method, weights)
    if len(blocks) < FEWEST:
        return None
    whole = np.linalg.eigvals(a)
    found = []
    for left_out in range(len(blocks)):
        rest = _empty(records, block_rows, method, weights)
        for k, one in enumerate(blocks):
            if k != left_out:
                rest.merge(one)
        if rest.rows < rest.columns:
            return None
        factor = rest.factor()
        poles = np.linalg.eigvals(factor.realise(factor.directions()[0], order)[0])
        near = linear_sum_assignment(np.abs(whole[:, None] - poles[None, :]))[1]
        found.append(poles[near])
    moved = np.array(found) - np.mean(found, axis=0)
    both = np.stack([moved.real, moved.imag], axis=-1)
    share = (len(blocks) - 1) / len(blocks)
    return np.asarray(share * np.einsum("bni,bnj->nij", both, both), dtype=np.float64)


def _empty(
    records: Sequence[tuple[FloatArray, FloatArray]],
    block_rows: int,
    method: Method,
    weights: Sequence[float],
) -> HankelQR:
    u, y = records[0]
    return HankelQR(u.shape[1], y.shape[1], block_rows, method, np.array(weights))


def _blocks(
    records: Sequence[tuple[FloatArray, FloatArray]],
    block_rows: int,
    method: Method,
    weights: Sequence[float],
) -> list[HankelQR]:
    """Blocks of about equal length, none across two records, each with several windows."""
    total = sum(len(u) for u, _ in records)
    window = _empty(records, block_rows, method, weights).window
    length = max(-(-total // BLOCKS), 4 * window)
    found = []
    for u, y in records:
        for first in range(0, len(u), length):
            if len(u) - first < 2 * window:
                continue
            one = _empty(records, block_rows, method, weights)
            one.add(u[first : first + length], y[first : first + length])
            one.end_record()
            found.append(one)
    return found
