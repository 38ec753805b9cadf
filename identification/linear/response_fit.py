"""Least squares on the simulated response: B, D and the initial state of every record."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from identification.linear.triangle import FloatArray, Triangle, single_thread

_BLOCK = 32
_ROWS = 2048


@final
@dataclass(frozen=True)
class InputMatrices:
    """B, D, the initial states and how well they reproduce the records.

    Attributes
    ----------
    b, d : ndarray, shape (order, inputs) and (outputs, inputs)
    x0 : tuple of ndarray, shape (order,)
        One per record.
    """

    b: FloatArray
    d: FloatArray
    x0: tuple[FloatArray, ...]


@final
class ResponseFit:
    """Streaming least squares of the simulated response of a known A and C.

    With A and C given the output is linear in x0, B and D. The regressors are
    computed block by block with matrix products, and reduced by QR for each record
    and output, so memory does not grow with the samples. A must not grow over a
    record: check its spectral radius first.

    Parameters
    ----------
    a, c : ndarray, shape (order, order) and (outputs, order)
    inputs : int
        Number of inputs.
    """

    def __init__(self, a: FloatArray, c: FloatArray, inputs: int) -> None:
        self._outputs, self._order = c.shape
        self._inputs = inputs
        powers = [np.eye(self._order)]
        for _ in range(_BLOCK):
            powers.append(a @ powers[-1])
        self._powers = np.array(powers)
        markov = np.array([c @ power for power in powers[:_BLOCK]])
        # free response of output o: state (., order) @ (order, block)
        self._free = np.ascontiguousarray(markov.transpose(1, 2, 0))
        # forced response of output o to B = e_q: inputs (., block) @ (block, block), upper
        # triangular
        self._forced = np.zeros((self._outputs, self._order, _BLOCK, _BLOCK))
        for start in range(_BLOCK - 1):
            self._forced[:, :, start, start + 1 :] = self._free[:, :, : _BLOCK - 1 - start]
        self._columns = 1 + self._order * (inputs + 1) + inputs + 1
        self._done: list[list[FloatArray]] = []
        self._begin()

    def add(self, u: FloatArray, y: FloatArray) -> None:
        """Take up samples that follow the last ones of the same record."""
        with single_thread():
            for start in range(0, len(u), _ROWS):
                self._add_piece(u[start : start + _ROWS], y[start : start + _ROWS])

    def end_record(self) -> None:
        """Close the record; the next one has its own initial state."""
        self._done.append([triangle.factor() for triangle in self._triangles])
        self._begin()

    def solve(self) -> InputMatrices:
        """B, D and every x0 in one least-squares problem over all closed records."""
        n, m, p = self._order, self._inputs, self._outputs
        shared = Triangle(n * m + p * m + 1)
        for record in self._done:
            shared.add(self._record_triangle(record)[n:, n:])
        with single_thread():
            system = shared.factor()
            solution = np.linalg.lstsq(*_scaled(system[:, :-1], system[:, -1]), rcond=None)[0]
        solution = solution / _scales(system[:, :-1])
        b, d = solution[: n * m].reshape(m, n).T, solution[n * m :].reshape(p, m)
        return InputMatrices(b, d, self.initial_states(b, d))

    def initial_states(self, b: FloatArray, d: FloatArray) -> tuple[FloatArray, ...]:
        """Initial state of every closed record for the given B and D."""
        n = self._order
        theta = np.concatenate((b.T.ravel(), d.ravel()))
        states: list[FloatArray] = []
        for record in self._done:
            top = self._record_triangle(record)[:n]
            rest = top[:, -1] - top[:, n:-1] @ theta
            states.append(
                np.asarray(np.linalg.lstsq(top[:, :n], rest, rcond=None)[0], dtype=np.float64)
            )
        return tuple(states)

    def vaf_percent(self, b: FloatArray, d: FloatArray, x0: tuple[FloatArray, ...]) -> FloatArray:
        """Variance accounted for by the simulated response, per output, in percent.

        ``100 (1 - var(y - y_simulated) / var(y))`` with the means taken per record.
        It is below zero where the simulation is worse than the mean.
        """
        error, total = np.zeros(self._outputs), np.zeros(self._outputs)
        for record, state in zip(self._done, x0, strict=True):
            for output, triangle in enumerate(record):
                theta = np.concatenate((state, b.T.ravel(), d[output]))
                residual = triangle[1:, -1] - triangle[1:, 1:-1] @ theta
                error[output] += residual @ residual
                total[output] += triangle[1:, -1] @ triangle[1:, -1]
        with np.errstate(divide="ignore", invalid="ignore"):
            vaf: FloatArray = 100.0 * (1.0 - error / total)
        return vaf

    def _begin(self) -> None:
        self._triangles = [Triangle(self._columns, _ROWS) for _ in range(self._outputs)]
        self._state = np.zeros((self._inputs + 1, self._order, self._order))
        self._state[0] = np.eye(self._order)

    def _record_triangle(self, record: list[FloatArray]) -> FloatArray:
        """Triangle of one record over all outputs: columns x0, B, D (output by output), y."""
        n, m, p = self._order, self._inputs, self._outputs
        width = n + n * m
        joint = Triangle(width + p * m + 1)
        for output, triangle in enumerate(record):
            rows = np.zeros((len(triangle), joint.columns))
            rows[:, :width] = triangle[:, 1 : 1 + width]
            rows[:, width + output * m : width + (output + 1) * m] = triangle[:, 1 + width : -1]
            rows[:, -1] = triangle[:, -1]
            joint.add(rows)
        return joint.factor()

    def _add_piece(self, u: FloatArray, y: FloatArray) -> None:
        n, m, count = self._order, self._inputs, len(u)
        blocks = -(-count // _BLOCK)
        padded = np.zeros((m, blocks * _BLOCK))
        padded[:, :count] = u.T
        inputs = padded.reshape(m, 1, blocks, _BLOCK)
        states = self._block_states(inputs[:, 0], count)
        for output in range(self._outputs):
            regressors = states.reshape(-1, n) @ self._free[output]
            regressors = regressors.reshape(m + 1, n, blocks, _BLOCK)
            regressors[1:] += inputs @ self._forced[output]
            columns = regressors.reshape((m + 1) * n, -1)
            done = 0
            while done < count:
                view = self._triangles[output].room(count - done)
                last = done + len(view)
                view[:, 0] = 1.0
                view[:, 1 : 1 + n * (m + 1)] = columns[:, done:last].T
                view[:, 1 + n * (m + 1) : -1] = u[done:last]
                view[:, -1] = y[done:last, output]
                self._triangles[output].commit(len(view))
                done = last

    def _block_states(self, inputs: FloatArray, count: int) -> FloatArray:
        """State at the start of every block for x0 = e_q and for B = e_q of every input.

        Result (inputs + 1, order q, blocks, order); `self._state` moves to the end of the piece.
        """
        n, m, blocks = self._order, self._inputs, inputs.shape[1]
        ends = np.zeros((blocks, m + 1, n, n))
        flow = self._powers[:_BLOCK][::-1].transpose(0, 2, 1).reshape(_BLOCK, n * n)
        ends[:, 1:] = (inputs @ flow).reshape(m, blocks, n, n).transpose(1, 0, 2, 3)
        states = np.empty((blocks, m + 1, n, n))
        step = np.ascontiguousarray(self._powers[_BLOCK].T)
        state = self._state
        for block in range(blocks - 1):
            states[block] = state
            state = (state.reshape(-1, n) @ step).reshape(m + 1, n, n) + ends[block]
        states[blocks - 1] = state
        left = count - (blocks - 1) * _BLOCK
        state = state @ self._powers[left].T
        tail = self._powers[:left][::-1].transpose(0, 2, 1).reshape(left, n * n)
        state[1:] += (inputs[:, -1, :left] @ tail).reshape(m, n, n)
        self._state = state
        return np.ascontiguousarray(states.transpose(1, 2, 0, 3))


def simulate(
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    d: FloatArray,
    u: FloatArray,
    x0: FloatArray | None = None,
) -> FloatArray:
    """Response of a discrete state-space model, block by block.

    Parameters
    ----------
    a, b, c, d : ndarray
        State-space matrices.
    u : ndarray, shape (samples, inputs)
    x0 : ndarray, shape (order,), optional
        Initial state; zero where not given.

    Returns
    -------
    ndarray, shape (samples, outputs)
    """
    n, m, count = len(a), b.shape[1], len(u)
    blocks = -(-count // _BLOCK)
    padded = np.zeros((blocks * _BLOCK, m))
    padded[:count] = u
    power = np.eye(n)
    flow, rows = np.empty((_BLOCK, n, m)), np.empty((_BLOCK, len(c), n))
    for step in range(_BLOCK):
        flow[_BLOCK - 1 - step] = power @ b
        rows[step] = c @ power
        power = a @ power
    ends = padded.reshape(blocks, _BLOCK * m) @ flow.transpose(0, 2, 1).reshape(_BLOCK * m, n)
    states = np.empty((blocks, n))
    state = np.zeros(n) if x0 is None else np.asarray(x0, dtype=np.float64)
    for block in range(blocks):
        states[block] = state
        state = power @ state + ends[block]
    forced = np.zeros((_BLOCK, m, _BLOCK, len(c)))
    for start in range(_BLOCK):
        forced[start, :, start] = d.T
        for step in range(start + 1, _BLOCK):
            forced[start, :, step] = (rows[step - 1 - start] @ b).T
    output = padded.reshape(blocks, -1) @ forced.reshape(_BLOCK * m, -1)
    output += states @ rows.transpose(2, 0, 1).reshape(n, -1)
    return output.reshape(-1, len(c))[:count]


def _scales(matrix: FloatArray) -> FloatArray:
    norms: FloatArray = np.linalg.norm(matrix, axis=0)
    return np.where(norms > 0, norms, 1.0)


def _scaled(matrix: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    return matrix / _scales(matrix), target
