"""Triangular factor of the block-Hankel matrix of subspace identification, from data as it
comes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, final, get_args

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.linear.records import check_finite, check_varies
from identification.linear.triangle import FloatArray, Triangle, single_thread

Method = Literal["ordinary", "past_output", "past_input", "cva"]
# smallest diagonal of a triangle, relative to the largest, that still holds half the digits
_DIGITS = 1e-8


@final
@dataclass(frozen=True)
class HankelFactor:
    """Triangle of the data and what follows from it alone: order, A and C.

    Attributes
    ----------
    triangle : ndarray, shape (columns, columns)
        R of the tall matrix [U | Y] (ordinary) or [Uf | Up | Yp | Yf] (the others).
    inputs, outputs, block_rows : int
        Number of inputs m, of outputs p and of block rows i.
    method : {"ordinary", "past_output", "past_input", "cva"}
    """

    triangle: FloatArray
    inputs: int
    outputs: int
    block_rows: int
    method: Method

    def directions(self) -> tuple[FloatArray, FloatArray]:
        """Left singular vectors, shape (p i, p i), and singular values, shape (p i,).

        They belong to the part of the future outputs that the future inputs do
        not explain (ordinary), that the past explains beyond them (past_output), that the past
        inputs alone do (past_input), or to the canonical correlations of past and future (cva;
        Larimore, Amer. Control Conf. 1983; Van Overschee and De Moor, Subspace Identification for
        Linear Systems, 1996, chapter 4).
        """
        first = self.inputs * self.block_rows
        future = len(self.triangle) - self.outputs * self.block_rows
        last = {"ordinary": len(self.triangle), "past_input": 2 * first}.get(self.method, future)
        explained = self.triangle[first:last, future:].T
        with single_thread():
            if self.method != "cva":
                left, values, _ = np.linalg.svd(explained, full_matrices=True)
            else:
                # the triangle of all that is left of the future outputs is the root of their
                # covariance; left of it stands what the past explains of them
                root = np.asarray(np.linalg.qr(self.triangle[first:, future:])[1]).T
                size = max(float(np.abs(np.diag(root)).max()), 1e-300)
                if float(np.abs(np.diag(root)).min()) < _DIGITS * size:
                    raise InputError(
                        "the future outputs depend on each other to the last digit, which leaves "
                        'no canonical correlations: use method "past_output"'
                    )
                whitened, values, _ = np.linalg.svd(
                    np.linalg.solve(root, explained), full_matrices=True
                )
                left = np.linalg.qr(root @ whitened)[0]
        # fewer past inputs than future outputs leave directions without a singular value
        values = np.concatenate((values, np.zeros(len(left) - len(values))))
        return np.asarray(left, dtype=np.float64), values

    def state_map(self, observability: FloatArray) -> FloatArray | None:
        """Matrix from the past to the state; None where the factor holds no past (ordinary).

        Parameters
        ----------
        observability : ndarray, shape (p i, order)
            C, C A, C A^2 ... of the model, in weighted outputs.

        Returns
        -------
        ndarray, shape (order, (m + p) i)
            For the vector of the i samples before: inputs sample by sample, then weighted outputs.
        """
        if self.method == "ordinary":
            return None
        first = self.inputs * self.block_rows
        future = len(self.triangle) - self.outputs * self.block_rows
        with single_thread():
            known = self.triangle[:future, :future]
            size = np.maximum(np.linalg.norm(known, axis=0), 1e-300)
            solved = np.linalg.lstsq(known / size, self.triangle[:future, future:], rcond=_DIGITS)
            from_past = (solved[0] / size[:, None])[first:]
            return np.asarray(np.linalg.lstsq(observability, from_past.T, rcond=None)[0])

    def realise(self, left: FloatArray, order: int) -> tuple[FloatArray, FloatArray]:
        """State and output matrix of the given order.

        C is the first block row of the extended observability matrix, A solves
        its shift equation by least squares (Verhaegen and Dewilde, 1992).
        """
        observability = left[:, :order]
        upper, lower = observability[: -self.outputs], observability[self.outputs :]
        with single_thread():
            a = np.linalg.lstsq(upper, lower, rcond=None)[0]
        return np.asarray(a, dtype=np.float64), observability[: self.outputs].copy()

    def shift_equation(self, left: FloatArray, order: int) -> tuple[FloatArray, FloatArray]:
        """B and D from the triangle alone (Verhaegen and Dewilde, 1992; thesis eq. 3.46).

        The columns of `left` past the order annihilate the observability matrix,
        which leaves a linear equation in B and D. It divides by the triangle of
        the future inputs and loses its digits when those are smooth.
        """
        m, p, i = self.inputs, self.outputs, self.block_rows
        future = len(self.triangle) - p * i
        annihilator = left[:, order:].T
        r_inputs = self.triangle[: m * i, : m * i]
        r_outputs = self.triangle[: m * i, future:]
        rows = p * i - order
        with single_thread():
            response = annihilator @ np.linalg.lstsq(r_inputs, r_outputs, rcond=None)[0].T
            shifted = np.zeros((i * rows, p * i))
            for k in range(i):
                shifted[k * rows : (k + 1) * rows, : p * (i - k)] = annihilator[:, p * k :]
            matrix = np.hstack((shifted[:, :p], shifted[:, p:] @ left[:-p, :order]))
            target = response.reshape(rows, i, m).transpose(1, 0, 2).reshape(i * rows, m)
            solution = np.asarray(np.linalg.lstsq(matrix, target, rcond=None)[0], dtype=np.float64)
        return solution[p:], solution[:p]


@final
class HankelQR:
    """Streaming QR of the block-Hankel matrix of one or several records.

    Give samples in any portion with `add`, close each record with `end_record`.
    A Hankel row never spans two records. Memory is one buffer of about
    ``13 q * q`` numbers with ``q`` the columns of the Hankel matrix.

    Parameters
    ----------
    inputs, outputs : int
        Channels of u and y.
    block_rows : int
        Block rows i of past and of future; larger than the order of the system.
    method : {"ordinary", "past_output", "past_input", "cva"}
        "past_output" and "cva" use past inputs and outputs as instruments, "past_input" the inputs.
    weights : array_like, shape (outputs,), optional
        Factors on the outputs; 1 where not given.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        block_rows: int = 20,
        method: Method = "ordinary",
        weights: npt.ArrayLike | None = None,
    ) -> None:
        if method not in get_args(Method):
            raise InputError(
                f"method {method!r} is unknown: choose one of {', '.join(get_args(Method))}"
            )
        if block_rows < 2:
            raise InputError(
                f"block_rows is {block_rows}: give at least 2, and more than the order expected"
            )
        self.inputs, self.outputs, self.block_rows = inputs, outputs, block_rows
        self.method: Method = method
        self.window = block_rows if method == "ordinary" else 2 * block_rows
        self.rows = 0
        self.weights = np.ones(outputs) if weights is None else np.array(weights, dtype=np.float64)
        self._triangle = Triangle((inputs + outputs) * self.window)
        self.column_order = self._column_order()
        self._tail: FloatArray = np.empty((0, inputs + outputs), order="F")
        self._samples = self._records = 0
        self._low = np.full(inputs + outputs, np.inf)
        self._high = np.full(inputs + outputs, -np.inf)

    @property
    def columns(self) -> int:
        """Columns of the Hankel matrix; `factor` needs at least as many rows."""
        return self._triangle.columns

    def add(self, u: FloatArray, y: FloatArray) -> None:
        """Take up samples that follow the last ones of the same record.

        Parameters
        ----------
        u, y : ndarray, shape (samples, inputs) and (samples, outputs)

        Raises
        ------
        InputError
            If a value is NaN or infinite, or the shapes do not fit.
        """
        if (
            u.ndim != 2
            or y.ndim != 2
            or u.shape[1] != self.inputs
            or y.shape[1] != self.outputs
            or len(u) != len(y)
        ):
            raise InputError(
                f"u has shape {u.shape} and y {y.shape}: give (samples, {self.inputs}) and "
                f"(samples, {self.outputs})"
            )
        if not len(u):
            return
        check_finite(u, f"record {self._records}: u", self._samples)
        check_finite(y, f"record {self._records}: y", self._samples)
        kept = len(self._tail)
        data: FloatArray = np.empty((kept + len(u), self.inputs + self.outputs), order="F")
        data[:kept] = self._tail
        data[kept:, : self.inputs] = u
        np.multiply(y, self.weights, out=data[kept:, self.inputs :])
        np.minimum(self._low, data[kept:].min(axis=0), out=self._low)
        np.maximum(self._high, data[kept:].max(axis=0), out=self._high)
        self._samples += len(u)
        self._fill(data)
        self._tail = data[max(len(data) - self.window + 1, 0) :].copy(order="F")

    def end_record(self) -> None:
        """Close the record: the next samples belong to another one."""
        self._tail = self._tail[:0]
        self._samples = 0
        self._records += 1

    def merge(self, other: HankelQR) -> None:
        """Take up everything another accumulator has seen; both must have the same settings.

        The other's open record counts as closed.
        """
        theirs = other.state()
        alike = np.array_equal(self.state()["settings"], theirs["settings"])
        if not alike or not np.array_equal(self.weights, other.weights):
            raise InputError(
                "accumulators with other channels, block rows, method or weights cannot be "
                "merged: make them alike"
            )
        self._triangle.add(theirs["triangle"])
        self.rows += other.rows
        np.minimum(self._low, theirs["range"][0], out=self._low)
        np.maximum(self._high, theirs["range"][1], out=self._high)

    def state(self) -> dict[str, FloatArray]:
        """Return everything needed to go on later, as arrays (for `numpy.savez`)."""
        return {
            "settings": np.array(self._settings(), dtype=np.float64),
            "weights": self.weights.copy(),
            "triangle": self._triangle.factor(),
            "tail": self._tail.copy(),
            "counts": np.array([self.rows, self._samples, self._records], dtype=np.float64),
            "range": np.vstack((self._low, self._high)),
        }

    def restore(self, state: Mapping[str, FloatArray]) -> None:
        """Go back to what `state` returned, on an accumulator with the same settings."""
        if tuple(state["settings"]) != self._settings() or not np.array_equal(
            state["weights"], self.weights
        ):
            raise InputError(
                "the state has other channels, block rows, method or weights: make the "
                "accumulator alike"
            )
        self._triangle = Triangle(self.columns)
        self._triangle.add(np.asarray(state["triangle"], dtype=np.float64))
        self._triangle.factor()
        self._tail = np.array(state["tail"], dtype=np.float64, order="F")
        self.rows, self._samples, self._records = (int(count) for count in state["counts"])
        self._low, self._high = np.array(state["range"], dtype=np.float64)

    def factor(self) -> HankelFactor:
        """Return the factor of everything seen so far.

        Raises
        ------
        InputError
            If there are fewer Hankel rows than columns, or a channel never changes.
        """
        if self.rows < self.columns:
            raise InputError(
                f"the records give {self.rows} Hankel rows, {self.columns} are needed: "
                f"record at least {self.columns + self.window - 1} samples in one piece or lower "
                "block_rows"
            )
        check_varies(self._low[: self.inputs], self._high[: self.inputs], "u")
        check_varies(self._low[self.inputs :], self._high[self.inputs :], "y")
        return HankelFactor(
            self._triangle.factor(), self.inputs, self.outputs, self.block_rows, self.method
        )

    def _fill(self, data: FloatArray) -> None:
        total = len(data) - self.window + 1
        done = 0
        while done < total:
            view = self._triangle.room(total - done)
            count = len(view)
            for column, (lag, channel) in enumerate(self.column_order):
                view[:, column] = data[done + lag : done + lag + count, channel]
            done += count
            self._triangle.commit(count)
        self.rows += max(total, 0)

    def _column_order(self) -> list[tuple[int, int]]:
        """(lag, channel) of every column: future inputs, past inputs, past outputs, future
        outputs.
        """
        inputs, outputs = range(self.inputs), range(self.inputs, self.inputs + self.outputs)
        past = range(self.window - self.block_rows)
        future = range(self.window - self.block_rows, self.window)
        groups = ((future, inputs), (past, inputs), (past, outputs), (future, outputs))
        return [(lag, channel) for lags, channels in groups for lag in lags for channel in channels]

    def _settings(self) -> tuple[float, ...]:
        return (
            self.inputs,
            self.outputs,
            self.block_rows,
            float(get_args(Method).index(self.method)),
        )
