"""What a fit leaves open: how far its parameters may be off, and what that may do on other records.

A motion at one speed tells the sum of viscous and Coulomb friction well and each of the two badly.
On a record at other speeds the right model then stands far over the noise, and nothing is missing.
With noise of unit variance in the rows, and the parameters known as the training rows tell them,
the squared length of a residual r in its covariance I + J P J' is the least of
|r + J d|^2 + |R d|^2 over the steps d of the parameters, R'R = P^-1 (Kalman's update of a value by
what comes later; the innovations of Mehra 1970). Steps stay inside the bounds of the parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import Balances, balances_of
from identification.balance.calibration import bare, names_of_runs
from identification.balance.dataset import Dataset
from identification.balance.stacked import floor_rows, row_weights, stack
from identification.balance.weak import WeakRecord
from identification.fitting.engine import Solution
from identification.fitting.least_squares import least_squares, triangle_of
from identification.fitting.start_values import bounds_of
from identification.fitting.weak_form import ENOUGH, WeakForm

FloatArray = npt.NDArray[np.float64]

LEADING: Final = 0.5
"""Share of the largest change of the residual from which a parameter is named among those open."""
ITERATIONS: Final = 15
"""Steps at most: as many as a fit takes in a pass."""


@final
@dataclass(frozen=True)
class Step:
    """Where the parameters may be, as one balance of other records asks for it.

    Attributes
    ----------
    moved : (rows,) array
        What it adds to the residual.
    price : float
        By how many variances the training rows fall behind.
    names : tuple of str
        The parameters that do most of it.
    """

    moved: FloatArray
    price: float
    names: tuple[str, ...]


@final
@dataclass(frozen=True, eq=False)
class LeftOpen:
    """What the training rows say of the parameters, and no more.

    Attributes
    ----------
    solution : Solution
    asked : frozenset of str
        Balances that are asked for a step.
    names : tuple of str
        Its free parameters that other records share.
    triangle : (p, p) array
        R of their rows: each of unit variance by noise alone, whatever the model leaves of them.
    limits : two (p,) arrays
    logarithmic : (p,) bool array
        Scales, which move by factors.
    """

    solution: Solution
    asked: frozenset[str]
    names: tuple[str, ...]
    triangle: FloatArray
    limits: tuple[FloatArray, FloatArray]
    logarithmic: npt.NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        solution: Solution,
        data: Dataset,
        values: Mapping[str, float],
        asked: frozenset[str],
    ) -> LeftOpen:
        """Of a fit, `values` those of it and of the runs."""
        model, sensing = solution.model, data.sensing
        runs = names_of_runs(model, data.train)
        names = solution.free  # what stands at a bound may leave it on one side
        floor = floor_rows(model, data, values, data.train)
        weights = row_weights(
            balances_of(model, sensing, wrt=()),
            data,
            values,
            {b: np.maximum(x, 1e-12) for b, x in floor.items()},
            data.train,
        )
        every = (*runs, *names)
        problem = WeakForm(
            balances_of(model, sensing, wrt=bare(every)), data, values, every, weights
        )
        rows = problem.jacobian(np.array([values[n] for n in every]))
        # what only the run has is taken out: other records have their own
        triangle = triangle_of(rows)[len(runs) :, len(runs) :]
        limits = bounds_of(model, data.joint.known, data)
        low, high = (np.array([limits[n][i] for n in names]) for i in (0, 1))
        logarithmic = problem.logarithmic[len(runs) :]
        return cls(solution, asked, names, triangle, (low, high), logarithmic)

    def steps(
        self,
        data: Dataset,
        records: Sequence[WeakRecord],
        values: Mapping[str, float],
        weights: Mapping[str, FloatArray],
    ) -> dict[str, Step]:
        """What each balance that is asked wants on other records.

        Parameters
        ----------
        data : Dataset
        records : sequence of WeakRecord
        values : mapping of str to float
        weights : mapping of str to (rows,) array
            1/deviation of each row by noise.
        """
        balances = balances_of(self.solution.model, data.sensing, wrt=self.names)
        out = {}
        for b, weight in ((b, w) for b, w in weights.items() if b in self.asked):
            problem = _Beside(self, balances, records, values, b, weight)
            found = least_squares(
                problem,
                problem.start,
                self.limits,
                logarithmic=self.logarithmic,
                iterations=ITERATIONS,
                tolerance=ENOUGH,
            ).x
            step = found - problem.start
            each = np.linalg.norm(problem.jacobian(found)[: len(weight)] * step, axis=0)
            leading = each > LEADING * each.max(initial=0.0)
            out[b] = Step(
                problem.left(found) - problem.left(problem.start),
                float(np.sum((self.triangle @ step) ** 2)),
                tuple(n for n, x in zip(self.names, leading, strict=True) if x),
            )
        return out


@final
@dataclass(frozen=True, eq=False)
class _Beside:
    """Rows of one balance of other records, and what the training rows lose; a
    :class:`identification.fitting.least_squares.Problem`.
    """

    known: LeftOpen
    balances: Balances
    records: Sequence[WeakRecord]
    values: Mapping[str, float]
    balance: str
    weight: FloatArray

    @cached_property
    def start(self) -> FloatArray:
        """Values of the fit, (p,)."""
        return np.array([self.values[n] for n in self.known.names])

    def _at(self, x: FloatArray) -> Mapping[str, float]:
        return {**self.values, **dict(zip(self.known.names, x.tolist(), strict=True))}

    @cached_property
    def _bare(self) -> Balances:
        return balances_of(self.balances.model, self.balances.sensing, wrt=())

    def left(self, x: FloatArray) -> FloatArray:
        """Residual of the balance, (rows,)."""
        return np.asarray(stack(self._bare, self.records, self._at(x)).residual[self.balance])

    def residual(self, x: FloatArray) -> FloatArray:
        """Weighted rows, and those of the training records, (rows + p,)."""
        lost = self.known.triangle @ (x - self.start)
        return np.concatenate([self.left(x) * self.weight, lost])

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Their derivative, (rows + p, p)."""
        found = stack(self.balances, self.records, self._at(x), self.known.names)
        columns = found.jacobian[self.balance] * self.weight[:, None]
        return np.concatenate([columns, self.known.triangle])


__all__ = ["LeftOpen", "Step"]
