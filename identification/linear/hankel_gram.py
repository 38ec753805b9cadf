"""Triangular factor of the block-Hankel matrix by way of its correlations: faster than QR, at half
the digits.

The product H'H of a block-Hankel matrix follows from its first block row by a recursion along the
diagonals (G[k+1, l+1] = G[k, l] + newest - oldest sample pair), so that it costs as much as
`block_rows` correlations of the signals. Its Cholesky factor is the triangle that a QR gives.
Forming the product squares the condition: where that leaves too few digits the factor is refused,
and QR is due.

Source: Sima, Sima and Van Huffel, High-performance numerical algorithms and software for
subspace-based linear multivariable system identification, J. Comput. Appl. Math. 170 (2004), whose
Cholesky algorithm is of this kind.
"""

from __future__ import annotations

from typing import Final, final

import numpy as np

from identification.errors import InputError
from identification.linear.hankel_qr import HankelFactor, HankelQR
from identification.linear.records import check_finite, check_varies
from identification.linear.triangle import FloatArray, single_thread

LEAST_RCOND: Final = 1e-9
"""Reciprocal condition of the product, columns scaled to length 1, under which the factor is
refused.
"""


@final
class TooFewDigits(ArithmeticError):
    """The correlations do not hold enough digits for a factor."""


@final
class HankelGram:
    """Correlations of one or several records, for the same factor as :class:`HankelQR`.

    Parameters
    ----------
    like : HankelQR
        Channels, block rows, method and weights are those of this accumulator; it is not changed.
    """

    def __init__(self, like: HankelQR) -> None:
        self.window, self.columns = like.window, like.columns
        self._like = like
        channels = like.inputs + like.outputs
        self._closed: FloatArray = np.zeros((self.columns, self.columns))
        self._lags: FloatArray = np.zeros((self.window, channels, channels))
        self._head: FloatArray = np.empty((0, channels))
        self._tail: FloatArray = np.empty((0, channels))
        self.rows = self._open_rows = 0
        self._samples = self._records = 0
        self._low, self._high = np.full(channels, np.inf), np.full(channels, -np.inf)

    def add(self, u: FloatArray, y: FloatArray) -> None:
        """Take up samples that follow the last ones of the same record (see
        :meth:`HankelQR.add`).
        """
        like = self._like
        if (
            u.ndim != 2
            or y.ndim != 2
            or u.shape[1] != like.inputs
            or y.shape[1] != like.outputs
            or len(u) != len(y)
        ):
            raise InputError(
                f"u has shape {u.shape} and y {y.shape}: give (samples, {like.inputs}) and "
                f"(samples, {like.outputs})"
            )
        if not len(u):
            return
        check_finite(u, f"record {self._records}: u", self._samples)
        check_finite(y, f"record {self._records}: y", self._samples)
        kept = len(self._tail)
        data = np.empty((kept + len(u), u.shape[1] + y.shape[1]))
        data[:kept] = self._tail
        data[kept:, : like.inputs] = u
        np.multiply(y, like.weights, out=data[kept:, like.inputs :])
        np.minimum(self._low, data[kept:].min(axis=0), out=self._low)
        np.maximum(self._high, data[kept:].max(axis=0), out=self._high)
        self._samples += len(u)
        if len(self._head) < self.window - 1:
            self._head = np.concatenate(
                [self._head, data[kept : kept + self.window - 1 - len(self._head)]]
            )
        count = len(data) - self.window + 1
        if count > 0:
            self._correlate(data, count)
            self._open_rows += count
        self._tail = data[max(len(data) - self.window + 1, 0) :].copy()

    def end_record(self) -> None:
        """Close the record: the next samples belong to another one."""
        self._closed += self._open()
        self.rows += self._open_rows
        self._lags[:] = 0.0
        self._head, self._tail = self._head[:0], self._tail[:0]
        self._open_rows = self._samples = 0
        self._records += 1

    def factor(self) -> HankelFactor:
        """The factor of everything seen so far.

        Raises
        ------
        TooFewDigits
            Where QR is due.
        InputError
            As :meth:`HankelQR.factor`.
        """
        from scipy.linalg.lapack import dpocon, dpotrf

        like, rows = self._like, self.rows + self._open_rows
        if rows < self.columns:
            raise InputError(
                f"the records give {rows} Hankel rows, {self.columns} are needed: "
                f"record at least {self.columns + self.window - 1} samples in one piece or lower "
                "block_rows"
            )
        check_varies(self._low[: like.inputs], self._high[: like.inputs], "u")
        check_varies(self._low[like.inputs :], self._high[like.inputs :], "y")
        channels = like.inputs + like.outputs
        order = [lag * channels + channel for lag, channel in like.column_order]
        product = (self._closed + self._open())[np.ix_(order, order)]
        size = np.sqrt(np.diag(product))
        scaled = np.asfortranarray(product / np.outer(size, size))
        with single_thread():
            triangle, failed = dpotrf(scaled, lower=0, clean=1)
            rcond = (
                0.0
                if failed
                else float(dpocon(triangle, float(np.abs(scaled).sum(axis=0).max()), uplo="U")[0])
            )
        if rcond < LEAST_RCOND:
            raise TooFewDigits(f"reciprocal condition {rcond:.1e}")
        return HankelFactor(
            np.asarray(triangle * size), like.inputs, like.outputs, like.block_rows, like.method
        )

    def _correlate(self, data: FloatArray, count: int) -> None:
        """Add products of every sample with the `window` samples from it on: the first block
        row.
        """
        columns = np.asfortranarray(data)
        first = columns[:count].T
        with single_thread():
            for lag in range(self.window):
                self._lags[lag] += first @ columns[lag : lag + count]

    def _open(self) -> FloatArray:
        """The product H'H of the open record, columns ordered by lag, then channel."""
        window, channels = self.window, self._lags.shape[1]
        product = np.zeros((window, channels, window, channels))
        if not self._open_rows:
            return product.reshape(self.columns, self.columns)
        product[0] = self._lags.transpose(1, 0, 2)
        new = np.einsum("ka,lb->kalb", self._tail, self._tail) - np.einsum(
            "ka,lb->kalb", self._head, self._head
        )
        for k in range(window - 1):
            product[k + 1, :, k + 1 :] = product[k, :, k : window - 1] + new[k, :, k:]
        square = product.reshape(self.columns, self.columns)
        upper = np.triu(square)
        whole: FloatArray = upper + np.triu(square, 1).T
        return whole
