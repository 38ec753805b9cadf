"""The one covariance behind every "+-": from windows of time, honest with few, too; and from the
information alone where there is no residual yet or its noise is known to be white.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FEWEST_BLOCKS: Final = 4
"""Blocks, or independent windows, below which their scatter says nothing."""
BLOCK: Final = 1.5
"""Length of a block [s]: some periods of the slowest modes of a joint, after which errors of a
model count as independent."""
RANK: Final = 1e-12
"""Share of the largest information, columns scaled alike, below which a direction is rounding."""
OVERLAP: Final = 4
"""Windows that hold each row.  A window of Hann's form of two blocks' length has as many degrees of
freedom as a block; four over each row add to the same everywhere, and so do their squares.
"""
LEAST: Final = 1e-3
"""Share of the information on a direction that must be left without a window: less, and it
alone tells of it (friction at the one reversal of a record).  Its scatter can say nothing there,
and the other parameters do not hang on it."""
HALF: Final = 0.5
"""Share of a parameter's variance in such a direction from which on the parameter is the one that
a single window tells of."""
MOST_TIED: Final = 0.999
"""Largest correlation of neighbouring samples that a short record can tell from 1."""
NORMAL: Final = 1.959964
"""The normal distribution's bound of 95 %."""
BLIND: Final = 1e-9
"""Singular value, columns scaled alike and as a share of the largest one, below which the rows do
not see a direction: rounding of their sums."""
SEEN: Final = 1e-3
"""Share of a parameter in directions that the rows do not see from which its error is infinite."""
TESTED: Final = 1e-10
"""Share of the largest information on what is tested below which a direction is not."""


def inverse(gram: FloatArray) -> FloatArray:
    """Inverse of a normal matrix (p, p), columns scaled alike; directions of which the rows know
    nothing (:data:`RANK`) add nothing.
    """
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    return np.asarray(
        np.linalg.pinv(gram / np.outer(size, size), rcond=RANK, hermitian=True)
        / np.outer(size, size),
        dtype=np.float64,
    )


def white_errors(
    jacobian: FloatArray, deviation: float = 1.0
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Cramer-Rao bound of each parameter under white noise: what a motion can tell at best.

    Parameters
    ----------
    jacobian : (n, p) array
        Weighted, in any scale of its columns.
    deviation : float
        Standard deviation of the weighted noise.

    Returns
    -------
    errors : (p,) array
        Infinite for a parameter that the rows do not see.
    lost : (p,) bool array
        Which these are.
    """
    norm = np.linalg.norm(jacobian, axis=0)
    safe = np.where(norm > 0, norm, 1.0)
    _, sigma, vt = np.linalg.svd(np.linalg.qr(jacobian / safe, mode="r"))
    weak = sigma <= BLIND * max(float(sigma.max(initial=0.0)), 1e-300)
    weak = np.concatenate([weak, np.ones(len(vt) - len(sigma), dtype=bool)])
    sigma = np.concatenate([sigma, np.ones(len(vt) - len(sigma))])
    spread = np.where(weak[:, None], 0.0, vt / np.where(weak, 1.0, sigma)[:, None])
    errors = deviation * np.linalg.norm(spread, axis=0) / safe
    lost = (norm == 0) | (np.linalg.norm(np.where(weak[:, None], vt, 0.0), axis=0) > SEEN)
    return np.where(lost, math.inf, errors), lost


def wald(gram: FloatArray, scores: FloatArray, amplitudes: FloatArray) -> float:
    """p-value of amplitudes that are all zero in truth: Wald's test on the sandwich over blocks.

    Parameters
    ----------
    gram : (p, p) array
        Normal matrix of their columns, those of the other parameters projected out.
    scores : (blocks, p) array
        Products of these columns with the residual within each block.
    amplitudes : (p,) array
    """
    from scipy.special import fdtrc

    count, blocks = len(amplitudes), len(scores)
    bread = np.linalg.pinv(gram, rcond=TESTED)
    covariance = bread @ (scores.T @ scores) @ bread * blocks / (blocks - 1)
    statistic = float(amplitudes @ np.linalg.pinv(covariance, rcond=RANK) @ amplitudes) / count
    return float(fdtrc(count, blocks - count, statistic))


def windows_over(times: Sequence[FloatArray]) -> Any:
    """Weight of each row in each of the windows over which its noise is summed up.

    Noise of an acceleration has no slow part: over a block of time with sharp ends it adds up to
    what stands at the ends, which the next block takes back.  So windows are tapered and overlap
    (Welch's estimate of the spectrum of the scores at zero frequency).

    Parameters
    ----------
    times : sequence of (rows,) array
        Centres of the rows of each record [s].

    Returns
    -------
    (windows, rows) sparse array
        Squares add up to 1 for each row.
    """
    from scipy.sparse import block_diag, csr_array

    width = 2 * BLOCK
    step = width / OVERLAP
    parts = []
    for time in times:
        # a run begins again at an earlier time: none of its rows shares a window with the last one
        apart = np.diff(time)
        since = np.concatenate([[0.0], np.cumsum(np.where(apart < 0, 2 * width, apart))]) / step
        newest = np.floor(since).astype(np.int64)
        number = newest[:, None] + np.arange(OVERLAP)
        into = since[:, None] - number + (OVERLAP - 1)  # of a window, in its steps
        weight = np.sin(np.pi * into / OVERLAP) ** 2
        weight /= np.linalg.norm(weight, axis=1)[:, None]
        rows = np.repeat(np.arange(len(time)), OVERLAP)
        shape = (int(number.max()) + 1, len(time))
        parts.append(csr_array((weight.ravel(), (number.ravel(), rows)), shape=shape))
    return csr_array(block_diag(parts))


@final
@dataclass(frozen=True)
class WindowNoise:
    """What noise of the columns adds to what windows hold of the normal equations, taken off.

    Attributes
    ----------
    grams : (windows, p, p) array
        To the products of the columns in the core of each window.
    scores : (windows, p) array
        To those with the residual over the window.
    whole : (p, p) array
        Normal matrix of all rows, as much of it as is certain without the noise.
    kept : (p, p) array
        What makes this of the whole less the noise: K with K (gram - noise) K' = whole.  Of each
        window no more is certain; without it one that holds a tenth of what is left there would
        hold all of what is certain, and the error of a fit that leaves it out would be anything.
    """

    grams: FloatArray
    scores: FloatArray
    whole: FloatArray
    kept: FloatArray


def window_errors(
    jacobian: FloatArray,
    residual: FloatArray,
    windows: Any,
    noise: WindowNoise | None = None,
    met_by: FloatArray | None = None,
) -> FloatArray | None:
    """Standard error of each parameter of a least-squares fit whose rows depend on each other
    within windows of time.

    Parameters
    ----------
    jacobian : (n, p) array
        Weighted, in any scale of its columns.
    residual : (n,) array
        Weighted, at the fit.
    windows : (windows, n) sparse array
        Of :func:`windows_over`; rows of zeros take part in the fit only.
    noise : WindowNoise, optional
    met_by : (n, p) array, optional
        Columns of the equations where these are not those of the rows themselves: what instruments
        say of them, so that their squares are their products with the rows' own
        (:func:`identification.fitting.errors_in_variables.instruments.mixed`).

    Returns
    -------
    (p,) array, or None with fewer than `FEWEST_BLOCKS` independent windows.
    """
    by = jacobian if met_by is None else met_by
    scores = windows @ (by * residual[:, None])
    core = cores(windows)
    parts = np.split(core.indices, core.indptr[1:-1])
    grams = np.array([by[rows].T @ by[rows] for rows in parts])
    total = by.T @ by
    if noise is not None:
        grams = noise.kept @ (grams - noise.grams) @ noise.kept.T
        scores, total = scores - noise.scores, noise.whole
    return errors_of_windows(grams, scores, total, independent(windows))


def independent(windows: Any) -> float:
    """Number of independent windows that these, which overlap, count as."""
    alike = windows @ windows.T
    return float(alike.trace()) ** 2 / max(float(np.sum(alike.data**2)), 1e-300)


def cores(windows: Any) -> Any:
    """Rows that are left out with each window, (windows, rows) sparse, 1 or nothing: those in its
    middle half, which hold as much of the information as the whole window by its weights.
    """
    from scipy.sparse import csr_array

    return csr_array(windows > 0.5 * windows.max()).astype(np.float64)


def errors_of_windows(
    grams: FloatArray, scores: FloatArray, whole: FloatArray, count: float
) -> FloatArray | None:
    """The same from what each window holds of the normal equations.

    The form of the sandwich that leaves out one window after the other (Bell and McCaffrey 2002,
    Survey Methodology 28:169), widened by the ratio of Student's t over count - 1 degrees of
    freedom to the normal at 95 %: twice the error is a 95 % band.

    Parameters
    ----------
    grams : (windows, p, p) array
        Products of the columns within the core of each window (:func:`cores`); unknowns of that
        time alone eliminated.
    scores : (windows, p) array
        Products of the columns with the residual over the window.
    whole : (p, p) array
        Normal matrix of all rows.
    count : float
        Independent windows (:func:`independent`).

    Returns
    -------
    (p,) array, or None with fewer than `FEWEST_BLOCKS` independent windows.
    """
    if count < FEWEST_BLOCKS:
        return None
    size = np.sqrt(np.maximum(np.diag(whole), 0.0))
    size = np.where(size > 0, size, 1.0)
    scaled, pushed = whole / np.outer(size, size), scores / size
    left = np.linalg.pinv(scaled - grams / np.outer(size, size), rcond=RANK, hermitian=True)
    shifts = np.einsum("bij,bj->bi", left, pushed)
    value, vector = np.linalg.eigh(scaled)
    white = vector[:, value > RANK * value[-1]] / np.sqrt(value[value > RANK * value[-1]])
    spread = np.maximum(np.sum(white**2, axis=1), 1e-300)
    for b in np.flatnonzero(
        np.einsum("bii->b", grams / np.outer(size, size) @ (white @ white.T)) > 1 - LEAST
    ):
        kept, direction = np.linalg.eigh(
            np.eye(white.shape[1]) - white.T @ (grams[b] / np.outer(size, size)) @ white
        )
        alone = kept < LEAST
        if not alone.any():
            continue
        rest = direction[:, ~alone]
        shift = white @ (rest @ ((rest.T @ (white.T @ pushed[b])) / kept[~alone]))
        own = np.sum((white @ direction[:, alone]) ** 2, axis=1) / spread
        shifts[b] = np.where(own > HALF, shifts[b], shift)
    covariance = shifts.T @ shifts * (count - 1) / count
    wider = errors_above(count, 0.025) / NORMAL
    return np.asarray(
        np.sqrt(np.maximum(np.diag(covariance), 0.0)) * wider / size, dtype=np.float64
    )


def known_errors(whole: FloatArray, prior: FloatArray) -> FloatArray:
    """Standard error that what is known beforehand leaves in each parameter: blocks of time do not
    tell of it.

    Parameters
    ----------
    whole : (p, p) array
        Normal matrix, rows of the prior among those that it is made of.
    prior : (k, p) array
        Those of the prior.
    """
    if not len(prior):
        return np.zeros(len(whole))
    inverse = np.linalg.pinv(whole, rcond=RANK, hermitian=True)
    return np.asarray(np.linalg.norm(prior @ inverse, axis=0), dtype=np.float64)


def errors_above(count: float, chance: float) -> float:
    """Standard errors, told by so many blocks, that a value exceeds with this chance by noise alone
    (Student's t).
    """
    from scipy.special import stdtrit

    return float(stdtrit(count - 1, 1 - chance))


def follows(scores: FloatArray, sizes: FloatArray, alpha: float) -> bool:
    """True where the slope over one column is positive in most blocks: one-sided t over blocks.

    Parameters
    ----------
    scores, sizes : (blocks,) arrays
        Weighted products of the column with what it has to follow, and with itself.
    alpha : float
        Probability of a yes where the slope is zero.

    Returns
    -------
    bool
        False with fewer than three blocks, or where the column is zero.
    """
    count, total = len(sizes), float(sizes.sum())
    if count < 3 or total <= 0:
        return False
    slope = float(scores.sum()) / total
    spread = math.sqrt(float(np.sum((scores - slope * sizes) ** 2)) * count / (count - 1)) / total
    if spread == 0:
        return slope > 0
    return slope / spread > errors_above(count, alpha)


def process_errors(
    jacobian: FloatArray, residual: FloatArray, series: Sequence[FloatArray]
) -> FloatArray:
    """Standard errors where a record is too short for blocks: the residual counts as a process of
    first order.

    Parameters
    ----------
    jacobian, residual : (n, p) and (n,) arrays
        Weighted.
    series : sequence of (samples, outputs) arrays
        The residual in the order of time, each without a gap: their correlation from one sample to
        the next says how many rows count as one (sum of the geometric series).
    """
    top = sum(float(np.sum(r[1:] * r[:-1])) for r in series)
    bottom = sum(float(np.sum(r**2)) for r in series)
    rho = min(max(top / bottom if bottom > 0 else 0.0, 0.0), MOST_TIED)
    gram = jacobian.T @ jacobian
    variance = (
        float(residual @ residual) / max(len(residual) - len(gram), 1) * (1 + rho) / (1 - rho)
    )
    return np.asarray(np.sqrt(np.maximum(np.diag(inverse(gram)), 0.0) * variance), dtype=np.float64)


def correlations(gram: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far each parameter is tied to the others.

    Parameters
    ----------
    gram : (p, p) array
        Normal matrix.

    Returns
    -------
    spread : (p,) array
        Standard deviation in units of the one that the column alone would have: 1 where it is
        orthogonal to all others.
    together : (p, p) array
        Correlations, zero on the diagonal.
    """
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    scaled = inverse(gram) * np.outer(size, size)
    spread = np.sqrt(np.maximum(np.diag(scaled), 1e-300))
    together = np.asarray(scaled / np.outer(spread, spread), dtype=np.float64)
    np.fill_diagonal(together, 0.0)
    return np.asarray(spread, dtype=np.float64), together
