"""What a fit leaves open: how far its parameters may be off, and what that may do on other records.

A motion at one speed tells the sum of viscous and Coulomb friction well and each of the two badly.
On a record at other speeds the right model then stands far over the noise, and nothing is missing.
With noise of unit variance in the rows, and the parameters known as the training rows tell them,
the squared length of a residual r in its covariance I + J P J' is the least of
|r + J d|^2 + |R d|^2 over the steps d of the parameters, R'R = P^-1 (Kalman's update of a value by
what comes later; the innovations of Mehra 1970). Steps stay inside the bounds of the parameters.

Zeros and clocks of the other records are their own and were fitted to them at the values of the
fit; they move along: a gap that no training row crosses is open by as much as the zero of an
encoder that its flank stands for. What the other balances of these records lose by it is paid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import Balances, balances_of
from identification.balance.calibration import bare, limits_of_runs, names_of_runs
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
        model = self.solution.model
        runs = names_of_runs(model, records)
        every = (*runs, *self.names)
        balances = balances_of(model, data.sensing, wrt=bare(every))
        of_runs = limits_of_runs(model, records)
        limits = tuple(
            np.concatenate([[of_runs[n][i] for n in runs], side])
            for i, side in enumerate(self.limits)
        )
        logarithmic = np.concatenate([np.zeros(len(runs), dtype=bool), self.logarithmic])
        start = np.array([values[n] for n in every])
        columns = stack(balances, records, values, every).jacobian
        out = {}
        for b, weight in ((b, w) for b, w in weights.items() if b in self.asked):
            others = [columns[o] * w[:, None] for o, w in weights.items() if o != b]
            lost = self._lost(len(runs), np.concatenate(others) if others else None)
            problem = _Beside(
                every,
                start,
                lost,
                balances,
                records,
                values=values,
                balance=b,
                weight=weight,
            )
            found = least_squares(
                problem,
                start,
                (limits[0], limits[1]),
                logarithmic=logarithmic,
                iterations=ITERATIONS,
                tolerance=ENOUGH,
            ).x
            step = found - start
            moved = problem.jacobian(found)[: len(weight)] * step
            each = np.linalg.norm(moved[:, len(runs) :], axis=0)
            leading = each > LEADING * each.max(initial=0.0)
            out[b] = Step(
                problem.left(found) - problem.left(start),
                float(np.sum((lost @ step) ** 2)),
                tuple(n for n, x in zip(self.names, leading, strict=True) if x),
            )
        return out

    def _lost(self, runs: int, others: FloatArray | None) -> FloatArray:
        """What a step loses elsewhere: that of the runs in the other balances of their records,
        that of the rest in the training rows.
        """
        count = len(self.names)
        own = np.zeros((runs, runs)) if others is None else triangle_of(others[:, :runs])
        return np.block(
            [
                [own, np.zeros((len(own), count))],
                [np.zeros((len(self.triangle), runs)), self.triangle],
            ]
        )


@final
@dataclass(frozen=True, eq=False)
class _Beside:
    """Rows of one balance of other records, and what is lost elsewhere; a
    :class:`identification.fitting.least_squares.Problem`.
    """

    names: tuple[str, ...]
    start: FloatArray
    lost: FloatArray
    balances: Balances
    records: Sequence[WeakRecord]
    values: Mapping[str, float]
    balance: str
    weight: FloatArray

    def _at(self, x: FloatArray) -> Mapping[str, float]:
        return {**self.values, **dict(zip(self.names, x.tolist(), strict=True))}

    @cached_property
    def _bare(self) -> Balances:
        return balances_of(self.balances.model, self.balances.sensing, wrt=())

    def left(self, x: FloatArray) -> FloatArray:
        """Residual of the balance, (rows,)."""
        return np.asarray(stack(self._bare, self.records, self._at(x)).residual[self.balance])

    def residual(self, x: FloatArray) -> FloatArray:
        """Weighted rows, and what is lost elsewhere, (rows + p,)."""
        return np.concatenate([self.left(x) * self.weight, self.lost @ (x - self.start)])

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Their derivative, (rows + p, p)."""
        found = stack(self.balances, self.records, self._at(x), self.names)
        columns = found.jacobian[self.balance] * self.weight[:, None]
        return np.concatenate([columns, self.lost])


__all__ = ["LeftOpen", "Step"]
