"""Noise of a subspace model: covariances of process and measurement, and the Kalman gain.

The state at a sample is a linear function of the samples before it, which the compressed data give.
What the state and output equations leave over, sample by sample, has the noise covariances; the
Riccati equation then gives the gain of the one-step predictor.

Source: Van Overschee and De Moor, Subspace Identification for Linear Systems (1996), section 4.4;
Verhaegen and Verdult, Filtering and System Identification (2007), section 9.6.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from identification.errors import InputError
from identification.linear.hankel_qr import HankelFactor
from identification.linear.records import Source
from identification.linear.triangle import FloatArray, single_thread


@final
@dataclass(frozen=True)
class NoiseModel:
    """Noise of a state-space model: x(k+1) = A x + B u + w, y = C x + D u + v.

    Attributes
    ----------
    process, measurement : ndarray, shape (order, order) and (outputs, outputs)
        Covariances of w and of v.
    cross : ndarray, shape (order, outputs)
        Covariance of w with v.
    gain : ndarray, shape (order, outputs)
        Kalman gain of the predictor x(k+1) = A x + B u + K (y - C x - D u).
    innovation : ndarray, shape (outputs, outputs)
        Covariance of the error of that prediction.
    """

    process: FloatArray
    measurement: FloatArray
    cross: FloatArray
    gain: FloatArray
    innovation: FloatArray


def noise_model(
    source: Source,
    factor: HankelFactor,
    system: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    weights: FloatArray,
) -> NoiseModel:
    """Covariances and gain for a model identified with past samples as instruments.

    Parameters
    ----------
    source : Source
        The records.
    factor : HankelFactor
        Of these records.
    system : tuple of ndarray
        A, B, C and D, in weighted outputs.
    weights : ndarray, shape (outputs,)

    Raises
    ------
    InputError
        The ordinary method, which keeps no past; noise without a stabilising gain.
    """
    from scipy.linalg import solve_discrete_are

    a, b, c, d = system
    order, outputs = len(a), len(c)
    rows = [c]
    for _ in range(factor.block_rows - 1):
        rows.append(rows[-1] @ a)
    state = factor.state_map(np.vstack(rows))
    if state is None:
        raise InputError(
            "the ordinary method keeps no past, from which the noise would follow: take "
            '"past_output"'
        )
    products, count = np.zeros((order + outputs, order + outputs)), 0
    back = factor.block_rows
    for index, length in enumerate(source.lengths):
        kept_u, kept_y = np.empty((0, factor.inputs)), np.empty((0, outputs))
        for u, y in source.pieces(index, 0, length):
            kept_u, kept_y = np.vstack((kept_u, u)), np.vstack((kept_y, y * weights))
            if len(kept_u) < back + 2:
                continue
            x = _pasts(kept_u, kept_y, back) @ state.T  # before samples back .. end
            here_u, here_y = kept_u[back:], kept_y[back:]
            left = np.hstack(
                (
                    x[1:] - x[:-1] @ a.T - here_u[:-1] @ b.T,
                    here_y[:-1] - x[:-1] @ c.T - here_u[:-1] @ d.T,
                )
            )
            products += left.T @ left
            count += len(left)
            kept_u, kept_y = kept_u[-back - 1 :], kept_y[-back - 1 :]
    if not count:
        raise InputError("no record is long enough for the noise covariances: record longer")
    products /= count
    process, cross, measurement = (
        products[:order, :order],
        products[:order, order:],
        products[order:, order:],
    )
    with single_thread():
        try:
            spread = solve_discrete_are(a.T, c.T, process, measurement, s=cross)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise InputError(
                "the noise covariances have no stabilising Kalman gain: record longer, or take "
                "another order"
            ) from error
    innovation = c @ spread @ c.T + measurement
    gain = np.linalg.solve(innovation.T, (a @ spread @ c.T + cross).T).T
    scale = 1.0 / weights
    return NoiseModel(
        process=process,
        measurement=measurement * np.outer(scale, scale),
        cross=cross * scale,
        gain=gain * weights,
        innovation=innovation * np.outer(scale, scale),
    )


def predictions(
    system: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    noise: NoiseModel,
    u: FloatArray,
    y: FloatArray,
) -> FloatArray:
    """One-step predictions (samples, outputs) of a record, from the initial state that fits best.

    Parameters
    ----------
    system : tuple of ndarray
        A, B, C and D.
    noise : NoiseModel
    u, y : ndarray, shape (samples, channels)
    """
    from identification.linear.response_fit import simulate

    a, b, c, d = system
    gain = noise.gain
    closed = a - gain @ c
    driven = np.hstack((u, y))
    forced = simulate(
        closed,
        np.hstack((b - gain @ d, gain)),
        c,
        np.hstack((d, np.zeros((len(c), len(c))))),
        driven,
    )
    free = [c]
    for _ in range(len(u) - 1):
        free.append(free[-1] @ closed)
    columns = np.array(free)
    # innovations of unit covariance count alike, whatever the units of the outputs
    white = np.linalg.inv(np.linalg.cholesky(noise.innovation))
    rows = (white @ columns).reshape(-1, len(a))
    start = np.linalg.lstsq(rows, ((y - forced) @ white.T).ravel(), rcond=None)[0]
    found: FloatArray = forced + columns @ start
    return found


def _pasts(u: FloatArray, y: FloatArray, back: int) -> FloatArray:
    """Rows of the `back` samples before each sample from `back` on, and after the last one:
    inputs sample by sample, then outputs.
    """
    count = len(u) - back
    blocks = [u[k : k + count] for k in range(back)] + [y[k : k + count] for k in range(back)]
    return np.hstack(blocks)
