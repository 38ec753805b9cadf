"""The weak form as a least-squares problem: rows of the balances against the parameters that
move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from casadi_models.hold import CLOCKS
from identification.balance.balances import Balances, balances_of
from identification.balance.calibration import bare
from identification.balance.clocks import one_way
from identification.balance.dataset import Dataset
from identification.balance.stacked import Stacked, stack
from identification.fitting.least_squares import least_squares
from identification.fitting.turns import Turns, turns_of

FloatArray = npt.NDArray[np.float64]

NUMERIC_STEP: Final = 1e-2
"""Relative step of the shapes that act through internal states: their law has kinks, which smaller
steps would resolve."""
ENOUGH: Final = 1e-6
"""Relative fall of the sum of squares that ends a fit: a thousandth of a standard error over a few
hundred rows."""


def memory_shapes_of(model: JointModel, free: Sequence[str]) -> tuple[str, ...]:
    """Shape parameters that act through internal states only: differentiated numerically."""
    out = []
    for t in model.terms:
        if t.effect.memory is not None:
            out += [
                n
                for n, p in zip(t.names, t.effect.parameters, strict=True)
                if p.is_shape and n in free
            ]
    return tuple(out)


def bending(model: JointModel) -> frozenset[str]:
    """Parameters that bend the rows, where first order does not hold: shapes and smoothing
    velocities.
    """
    return frozenset(
        {p.name for p in model.parameters if p.is_shape} | set(model.named("smoothing"))
    )


@final
@dataclass(frozen=True)
class WeakForm:
    """Rows of the balances on the training records, weighted; a
    :class:`identification.fitting.least_squares.Problem`.

    Attributes
    ----------
    balances : Balances
        With a Jacobian column for every one of `free`.
    data : Dataset
    values : mapping of str to float
        Of every parameter; those not free stay.
    free : tuple of str
        The parameters that move, in the order of the problem's vector.
    weights : mapping of str to float or (rows,) array
        1/sigma of each balance, or of each of its rows.
    usual : mapping of str to (float, float)
        Middle and standard deviation of parameters that are known beforehand: a row each.
    left : mapping of str to (rows,) array
        What is taken off the residual of each balance, because it is there without a cause in the
        parameters; nothing where it is empty.
    """

    balances: Balances
    data: Dataset
    values: Mapping[str, float]
    free: tuple[str, ...]
    weights: Mapping[str, float | FloatArray]
    usual: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    left: Mapping[str, FloatArray] = field(default_factory=dict)

    @cached_property
    def prior(self) -> FloatArray:
        """Rows of what is known of single parameters, (known, free): 1/sigma in their column."""
        known = [i for i, n in enumerate(self.free) if n in self.usual]
        out = np.zeros((len(known), len(self.free)))
        for row, i in enumerate(known):
            out[row, i] = 1 / self.usual[self.free[i]][1]
        return out

    def surprise(self, x: FloatArray) -> FloatArray:
        """How far parameters are from what is known of them, in standard deviations, (known,)."""
        middle = np.array([self.usual.get(n, (0.0, 1.0))[0] for n in self.free])
        return np.asarray(self.prior @ (x - middle), dtype=np.float64)

    @cached_property
    def _bare(self) -> Balances:
        return balances_of(self.balances.model, self.data.sensing, wrt=())

    @cached_property
    def logarithmic(self) -> npt.NDArray[np.bool_]:
        """Which of the free parameters are scales: positive, of unknown size."""
        known = {p.name: p for p in self.balances.model.parameters}
        return np.array(
            [
                n in known
                and known[n].is_shape
                and known[n].scale != "absolute"
                and self.values[n] > 0
                for n in self.free
            ],
            dtype=bool,
        )

    @cached_property
    def clocks(self) -> npt.NDArray[np.bool_]:
        """Which of the free parameters are skews of clocks."""
        return np.array([bare([n])[0] in CLOCKS for n in self.free], dtype=bool)

    @cached_property
    def turns(self) -> Turns:
        """What unknown instants of the turns may add to the rows, at the values of the problem."""
        weights = {
            b: np.broadcast_to(np.asarray(w, dtype=np.float64), (self.rows,))
            for b, w in self.weights.items()
        }
        return turns_of(self.balances, self.data.train, self.values, weights, len(self.prior))

    @cached_property
    def bent(self) -> npt.NDArray[np.bool_]:
        """Which of the free parameters bend the rows."""
        names = bending(self.balances.model)
        return np.array([n in names for n in self.free], dtype=bool)

    @cached_property
    def one_way(self) -> npt.NDArray[np.bool_]:
        """Rows within which the joint does not turn, all balances and the prior, (rows,)."""
        told = np.concatenate([one_way(w) for w in self.data.train])
        parts = [told] * len(self.balances.balances)
        return np.concatenate([*parts, np.ones(len(self.prior), dtype=bool)])

    @property
    def rows(self) -> int:
        """Rows of each balance."""
        return sum(w.rows for w in self.data.train)

    def moved(self, x: FloatArray) -> WeakForm:
        """The same problem with other values of the free parameters."""
        return replace(self, values=self.at(x))

    def at(self, x: FloatArray) -> dict[str, float]:
        """Values of every parameter."""
        return {**self.values, **dict(zip(self.free, map(float, x), strict=True))}

    def stacked(self, x: FloatArray) -> Stacked:
        """Residual and Jacobian of every balance, unweighted, columns of `free`."""
        values = self.at(x)
        found = stack(self.balances, self.data.train, values, self.free)
        jacobian = found.jacobian
        for n in memory_shapes_of(self.balances.model, self.free):
            step = NUMERIC_STEP * values[n]
            moved = stack(self._bare, self.data.train, {**values, n: values[n] + step}).residual
            for b in jacobian:
                jacobian[b][:, self.free.index(n)] = (moved[b] - found.residual[b]) / step
        return Stacked(self._beside(found.residual), jacobian, found.block, found.taking)

    def _beside(self, residual: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        return {b: r - self.left[b] if b in self.left else r for b, r in residual.items()}

    def residual(self, x: FloatArray) -> FloatArray:
        """Weighted rows, one balance after the other, then those of the prior."""
        rows = self._beside(stack(self._bare, self.data.train, self.at(x)).residual)
        return np.concatenate(
            [*(rows[b] * self.weights[b] for b in self.balances.balances), self.surprise(x)]
        )

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Their derivative, (rows, free)."""
        found = self.stacked(x).jacobian
        return np.concatenate(
            [
                *(
                    found[b] * np.atleast_1d(self.weights[b])[:, None]
                    for b in self.balances.balances
                ),
                self.prior,
            ]
        )

    def fitted(
        self, limits: Mapping[str, tuple[float, float]], iterations: int
    ) -> tuple[dict[str, float], int]:
        """Values at the minimum inside the limits, and the steps it took.

        Parameters
        ----------
        limits : mapping of str to (low, high)
        iterations : int
            At most so many.
        """
        start = [self.values[n] for n in self.free]
        low, high = [limits[n][0] for n in self.free], [limits[n][1] for n in self.free]
        found = least_squares(
            self,
            start,
            (low, high),
            logarithmic=self.logarithmic,
            iterations=iterations,
            tolerance=ENOUGH,
        )
        return self.at(found.x), found.iterations
