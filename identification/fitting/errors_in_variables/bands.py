"""Standard errors of a fit from its rows: what the scatter over windows of time, what is known
beforehand and a neighbour that stands at a bound leave open."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.stacked import taking_part
from identification.fitting.covariance import (
    RANK,
    WindowNoise,
    known_errors,
    window_errors,
    windows_over,
)
from identification.fitting.errors_in_variables.instruments import mixed
from identification.fitting.errors_in_variables.products import (
    Unbiased,
    kept,
    known,
    level_error,
)
from identification.fitting.turns import Turns
from identification.fitting.weak_form import WeakForm

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FAR_BEYOND: Final = 30.0
"""Standard errors beyond a bound from which the parameter stands at it for certain: the normal law
has underflowed."""


@final
@dataclass(frozen=True)
class Part:
    """What the rows say of some of the parameters, in units of 1 over the norm of their columns.

    Attributes
    ----------
    errors : (p,) array or None
        None with too few windows.
    gram, whole : (p, p) array
        Normal matrix, and without what noise adds to it.
    score : (p,) array
        What is left of the normal equations, noise taken off.
    """

    errors: FloatArray | None
    gram: FloatArray
    whole: FloatArray
    score: FloatArray


@final
@dataclass(frozen=True, eq=False)
class Bands:
    """The rows of a problem at its values.

    Parameters
    ----------
    problem : WeakForm
    without : Unbiased
        The fit whose values these are.
    turns : Turns
    share : float
        Share of the rows that count as independent beside what is known beforehand.
    """

    problem: WeakForm
    without: Unbiased
    turns: Turns
    share: float

    @cached_property
    def _x(self) -> FloatArray:
        return np.array([self.problem.values[n] for n in self.problem.free])

    @cached_property
    def _columns(self) -> tuple[FloatArray, FloatArray | None]:
        plain = self.problem.jacobian(self._x)
        told = ~np.outer(~self.problem.one_way, self.problem.clocks)
        instruments = self.without.instruments
        by = None
        if instruments is not None:
            by = self.turns.without(instruments.beside(plain, self.problem)) * told
        return self.turns.without(plain) * told, by

    @cached_property
    def norms(self) -> FloatArray:
        """Sizes of the columns, (free,)."""
        return np.asarray(np.linalg.norm(self._columns[0], axis=0))

    @cached_property
    def _rows(self) -> FloatArray:
        return self.turns.without(self.problem.residual(self._x))

    @cached_property
    def _windows(self) -> tuple[Any, Any]:
        from scipy.sparse import csr_array, hstack

        problem = self.problem
        windows = windows_over([w.time for w in problem.data.train])
        # what is known beforehand belongs to no window of time: it scatters by itself
        empty = csr_array((windows.shape[0], len(problem.prior)))
        return windows, csr_array(hstack([*[windows] * len(problem.balances.balances), empty]))

    def of(self, index: IntArray) -> Part:
        """What is known of the parameters of these columns where the others stay."""
        problem, norms = self.problem, self.norms[index]
        own, by = self._columns
        scaled = own[:, index] / norms
        mix = mixed(own[:, index], None if by is None else by[:, index])
        meeting = (own if by is None else by)[:, index] @ mix / norms
        unit = np.outer(norms, norms)
        noise = self.without.noise.of(index, mix)
        gram = meeting.T @ scaled
        gram = (gram + gram.T) / 2
        added, pulled = noise.whole
        given = (gram, added / unit, level_error(problem.data))
        whole = known(*given)
        windows, tiled = self._windows
        grams, scores = noise.by_window(
            {b: np.asarray(w, dtype=np.float64) for b, w in problem.weights.items()},
            windows,
            {b: taking_part(b, problem.data.train) for b in problem.balances.balances},
        )
        apart = WindowNoise(grams / unit, scores / norms, whole, kept(*given))
        errors = window_errors(scaled, self._rows, tiled, apart, meeting)
        if errors is not None:
            # rows of the prior were made heavier by the share; they scatter as the prior does
            unsure = known_errors(whole, problem.prior[:, index] / norms) / math.sqrt(self.share)
            errors = np.hypot(errors, unsure)
        return Part(errors, gram, whole, meeting.T @ self._rows - pulled / norms)

    def beside(self, index: IntArray, bound: Sequence[int], upper: Sequence[bool]) -> FloatArray:
        """Further error of the parameters of these columns from others that stand at a bound,
        (p,): the truth of such a one lies somewhere inside, and they would lie elsewhere then.

        Its distance from the bound is a normal variable that is cut off there: of its mean square,
        each takes what its slope against that parameter makes.

        Parameters
        ----------
        index : (p,) int array
        bound : sequence of int
            Columns of those.
        upper : sequence of bool
            Whether each stands at its upper bound.
        """
        out = np.zeros(len(index))
        for i, high in zip(bound, upper, strict=True):
            part = self.of(np.append(index, i))
            if part.errors is None or not np.isfinite(part.errors[-1]):
                continue
            error = float(part.errors[-1])
            inverse = np.linalg.pinv(part.whole, rcond=RANK, hermitian=True)
            if inverse[-1, -1] <= 0 or error <= 0:
                continue
            middle = -float(inverse[-1] @ part.score) * (-1.0 if high else 1.0)
            slope = inverse[:-1, -1] / inverse[-1, -1]
            out = np.hypot(out, slope * math.sqrt(cut_square(middle, error)))
        return out


def cut_square(middle: float, error: float) -> float:
    """Mean square of a normal variable that is cut off below zero.

    Parameters
    ----------
    middle, error : float
        Of the variable before it is cut.
    """
    from scipy.special import log_ndtr

    z = middle / error
    if z < -FAR_BEYOND:
        return 2 * (error / z) ** 2
    hazard = math.exp(-0.5 * z * z - 0.5 * math.log(2 * math.pi) - float(log_ndtr(z)))
    return max(error**2 * (1 + z * z + z * hazard), 0.0)


__all__ = ["Bands", "Part", "cut_square"]
