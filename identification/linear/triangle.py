"""Streaming QR: the triangular factor of a tall matrix that never exists as a whole."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any, final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

_ROWS_PER_COLUMN = 4
_LEAST_ROWS = 1024
# columns reduced together by LAPACK: narrow panels suit narrow matrices (measured)
_NARROW, _PANEL_NARROW, _PANEL_WIDE = 150, 8, 16


@cache
def _controller() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def single_thread() -> AbstractContextManager[object]:
    """Context in which the BLAS runs on one thread.

    The factorisations of this package are small and many; a second BLAS thread
    makes them slower, at times by more than ten.
    """
    limited: AbstractContextManager[object] = _controller().limit(limits=1)
    return limited


@final
class Triangle:
    """Triangular factor R of a QR decomposition, built from blocks of rows.

    New rows are gathered in one Fortran buffer; a full buffer is folded into the
    triangle in place by Householder reflections that use its shape (LAPACK
    ``dtpqrt``; about twice as fast as ``dgeqrf`` on the triangle with the rows
    below it). Memory does not grow with the number of rows.

    Parameters
    ----------
    columns : int
        Number of columns.
    chunk_rows : int, optional
        Rows taken up between two factorisations; 4 times the columns, at least
        1024, where not given.
    """

    def __init__(self, columns: int, chunk_rows: int | None = None) -> None:
        from scipy.linalg.lapack import dtpqrt

        self.columns = columns
        self.chunk_rows = (
            max(_LEAST_ROWS, _ROWS_PER_COLUMN * columns) if chunk_rows is None else chunk_rows
        )
        self._triangle: FloatArray = np.zeros((columns, columns), order="F")
        self._buffer: FloatArray = np.zeros((self.chunk_rows, columns), order="F")
        self._pending = 0
        self._dtpqrt = dtpqrt
        self._panel = min(columns, _PANEL_NARROW if columns < _NARROW else _PANEL_WIDE)

    def room(self, rows: int) -> FloatArray:
        """View on the free rows, at most `rows` of them; write there, then `commit`."""
        return self._buffer[self._pending : self._pending + rows]

    def commit(self, rows: int) -> None:
        """Take the first `rows` rows of the last `room` into the factorisation."""
        self._pending += rows
        if self._pending == self.chunk_rows:
            self._fold()

    def add(self, rows: FloatArray) -> None:
        """Take up a block of rows, shape (any, columns)."""
        done = 0
        while done < len(rows):
            view = self.room(len(rows) - done)
            view[:] = rows[done : done + len(view)]
            done += len(view)
            self.commit(len(view))

    def factor(self) -> FloatArray:
        """Return the triangle of everything committed so far, shape (columns, columns)."""
        if self._pending:
            self._fold()
        return self._triangle.copy()

    def _fold(self) -> None:
        full = self._pending == self.chunk_rows
        rows = self._buffer if full else np.asfortranarray(self._buffer[: self._pending])
        with single_thread():
            folded = self._dtpqrt(
                0, self._panel, self._triangle, rows, overwrite_a=1, overwrite_b=1
            )
        self._triangle = folded[0]
        self._pending = 0
