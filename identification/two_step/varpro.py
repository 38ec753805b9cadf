"""Variable projection: the linear coefficients are eliminated inside the objective (Golub and
Pereyra, 1973).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.two_step.varpro_model import SeparableModel

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

RANK_LIMIT = 1e-10


class BudgetSpent(Exception):
    """The allowed number of evaluations is used up."""


@final
@dataclass(frozen=True)
class Reduced:
    """The linear problem at one nonlinear point after QR: a small triangle instead of all samples.

    Attributes
    ----------
    z : (shapes,) array
        The point, on the search scale.
    triangle : (coefficients, coefficients) array
        R of the scaled columns.
    target : (coefficients,) array
        Q'y.
    scale : (coefficients,) array
        Norms of the columns; 1 for a zero column.
    outside : float
        Square of the part of y that no coefficient can reach.
    """

    z: FloatArray
    triangle: FloatArray
    target: FloatArray
    scale: FloatArray
    outside: float

    def solve(self, sign: BoolArray | None) -> tuple[FloatArray, float]:
        """Coefficients and sum of squares; `sign` marks coefficients that must not be negative."""
        if sign is None:
            found = np.linalg.lstsq(self.triangle, self.target, rcond=RANK_LIMIT)[0]
        else:
            found = _non_negative(self.triangle, self.target, sign)
        left = self.triangle @ found - self.target
        return found / self.scale, self.outside + float(left @ left)


def _non_negative(triangle: FloatArray, target: FloatArray, sign: BoolArray) -> FloatArray:
    """Least squares with some coefficients >= 0: a free one is the difference of two
    non-negative ones.
    """
    from scipy.optimize import nnls

    plain = np.linalg.lstsq(triangle, target, rcond=RANK_LIMIT)[0]
    if not np.any(plain[sign] < 0):
        return np.asarray(plain, dtype=np.float64)
    free = np.flatnonzero(~sign)
    found = nnls(np.hstack([triangle, -triangle[:, free]]), target)[0]
    values = np.asarray(found[: len(sign)], dtype=np.float64)
    values[free] -= found[len(sign) :]
    return values


@final
class Projection:
    """Objective 1/2 ||y - phi(eta) theta*(eta)||^2 of a record, on the search scale of the shapes.

    Every evaluation of phi (or of its derivative) counts as one.

    Parameters
    ----------
    model : SeparableModel
    y : (n, outputs) array
    signals : (n, channels) array
    weights : (outputs,) array
        1 / standard deviation of each output's noise, or any relative weights.
    budget : int
        Evaluations allowed; :class:`BudgetSpent` is raised beyond.
    """

    def __init__(
        self,
        model: SeparableModel,
        y: FloatArray,
        signals: FloatArray,
        weights: FloatArray,
        budget: int,
    ) -> None:
        good = np.isfinite(y).all(axis=1) & np.isfinite(signals).all(axis=1)
        if int(good.sum()) * model.outputs <= len(model.coefficients) + len(model.shapes):
            raise InputError(
                f"two-step: {int(good.sum())} usable samples for "
                f"{len(model.coefficients) + len(model.shapes)} parameters; give a "
                "longer record without NaN"
            )
        self.model = model
        self.y, self.signals, self.weights = y[good], signals[good], weights
        self.dropped = int((~good).sum())
        self.low = np.array([s.inner(s.low) for s in model.shapes])
        self.high = np.array([s.inner(s.high) for s in model.shapes])
        self.signed = np.array([c.non_negative for c in model.coefficients])
        self.sign: BoolArray | None = None
        self.budget, self.evaluations = budget, 0
        self.seen: list[Reduced] = []
        self.tick: Callable[[], None] | None = None
        self._last: tuple[bytes, Reduced, FloatArray, FloatArray] | None = None

    @property
    def samples(self) -> int:
        """Number of scalar equations."""
        return int(self.y.size)

    def outer(self, z: FloatArray) -> FloatArray:
        """Shape parameters in user units."""
        return np.array([s.outer(float(v)) for s, v in zip(self.model.shapes, z, strict=True)])

    def inner(self, nonlinear: FloatArray) -> FloatArray:
        """Shape parameters on the search scale."""
        return np.array(
            [s.inner(float(v)) for s, v in zip(self.model.shapes, nonlinear, strict=True)]
        )

    def _count(self) -> None:
        if self.evaluations >= self.budget:
            raise BudgetSpent
        self.evaluations += 1
        if self.tick is not None:
            self.tick()

    def reduce(self, z: FloatArray) -> tuple[Reduced, FloatArray, FloatArray]:
        """The small problem at z, with the weighted phi (rows, coefficients) and y (rows,)."""
        key = z.tobytes()
        if self._last is not None and self._last[0] == key:
            return self._last[1:]
        self._count()
        eta = self.outer(z)
        phi = self.model.matrix(self.signals, eta) * self.weights[:, None]
        matrix = phi.reshape(-1, phi.shape[-1])
        target = ((self.y - self.model.remainder(self.signals, eta)) * self.weights).reshape(-1)
        if not np.isfinite(matrix).all():
            raise InputError(
                "two-step: phi is not finite at "
                f"{dict(zip(self.model.shape_names, eta, strict=True))}"
            )
        scale = np.linalg.norm(matrix, axis=0)
        scale[scale == 0] = 1.0
        r: FloatArray = np.asarray(
            np.linalg.qr(np.column_stack([matrix / scale, target]), mode="r")
        )
        p = len(scale)
        found = Reduced(
            z.copy(), r[:p, :p], r[:p, p], scale, float(r[p, p] ** 2) if len(r) > p else 0.0
        )
        self.seen.append(found)
        self._last = (key, found, matrix, target)
        return found, matrix, target

    def objective(self, z: FloatArray) -> float:
        """1/2 of the sum of squares."""
        return 0.5 * self.reduce(np.asarray(z, dtype=np.float64))[0].solve(self.sign)[1]

    def residual(self, z: FloatArray) -> FloatArray:
        """phi theta - y, weighted, shape (rows,)."""
        reduced, matrix, target = self.reduce(np.asarray(z, dtype=np.float64))
        theta, _ = reduced.solve(self.sign)
        out: FloatArray = matrix @ theta - target
        return out

    def slopes(self, z: FloatArray) -> FloatArray:
        """d(phi theta + rest)/dz at fixed theta, weighted, shape (rows, shapes)."""
        reduced, _, _ = self.reduce(np.asarray(z, dtype=np.float64))
        theta, _ = reduced.solve(self.sign)
        self._count()
        eta = self.outer(z)
        raw = self.model.gradient(self.signals, eta, theta) * self.weights[:, None]
        factor = np.array(
            [e if s.logarithmic else 1.0 for s, e in zip(self.model.shapes, eta, strict=True)]
        )
        out: FloatArray = raw.reshape(-1, len(eta)) * factor
        return out

    def jacobian(self, z: FloatArray) -> FloatArray:
        """Derivative of :meth:`residual` in Kaufman's form (1975): the slopes outside the range
        of phi.
        """
        slopes = self.slopes(z)
        reduced, matrix, _ = self.reduce(np.asarray(z, dtype=np.float64))
        theta, _ = reduced.solve(self.sign)
        active = np.ones(len(theta), dtype=bool) if self.sign is None else ~self.sign | (theta > 0)
        if not active.any():
            return slopes
        q = np.linalg.qr(matrix[:, active] / reduced.scale[active])[0]
        out: FloatArray = slopes - q @ (q.T @ slopes)
        return out

    def best(self) -> Reduced:
        """The best point seen so far, under the present sign condition; no new evaluation."""
        return min(self.seen, key=lambda r: r.solve(self.sign)[1])
