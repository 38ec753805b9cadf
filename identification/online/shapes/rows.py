"""Balances of a stored window as functions of the shape parameters: a separable model of
averaged rows.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from casadi_models import JointModel, Signals
from identification.balance.balances import residual_expressions
from identification.balance.sensing import Sensing
from identification.online.rows import SHARP, RowMaker
from identification.two_step.algorithm import Coefficient, SeparableModel, Shape, from_casadi

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_BLOCK: Final = 512
"""Points evaluated between two ticks."""


def shape_parameters(
    model: JointModel, sensing: Sensing, linear: Container[str], held: Container[str]
) -> tuple[str, ...]:
    """Parameters that enter the balances nonlinearly and that a search can find.

    A smoothing velocity that only stands for a jump is none, except beside the smooth Stribeck law,
    where it is the width of the thesis's friction curve. Joints whose laws have internal states
    have none.
    """
    if model.equations.memory.shape[0]:
        return ()
    stacked = ca.vertcat(*residual_expressions(model, sensing).values())
    columns = set(ca.jacobian(stacked, model.equations.parameters).sparsity().get_triplet()[1])
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    shaping = {
        n
        for t in model.terms
        if t.effect.shapes_reversal
        for n in model.named("smoothing", t.place)
    }
    found = []
    for i, p in enumerate(model.parameters):
        if i not in columns or p.name in linear or p.name in held or not p.is_shape:
            continue
        if p.role == "smoothing" and values[p.name] <= SHARP and p.name not in shaping:
            continue
        found.append(p.name)
    return tuple(found)


@final
@dataclass(frozen=True)
class RowWindow:
    """Rows as they were made, oldest first, without a gap.

    Attributes
    ----------
    signals : (rows, signals) array
        Averaged signals of each row.
    shares : (rows, 2) array
        Share of the kernel in which motor and link stand still.
    on : (rows, balances) bool array
        Balances whose readings were all there.
    points : (rows, points per row, used) array
        Signals at the points that each row has added, columns :attr:`ShapedBalances.used`.
    """

    signals: FloatArray
    shares: FloatArray
    on: BoolArray
    points: FloatArray

    def last(self, count: int) -> RowWindow:
        """The last rows only."""
        return RowWindow(
            self.signals[-count:], self.shares[-count:], self.on[-count:], self.points[-count:]
        )


@final
class ShapedBalances:
    """Rows y = H theta of a window at any value of the shapes.

    Parameters
    ----------
    rows : RowMaker
        With shapes.

    Attributes
    ----------
    used : tuple of int
        Signals that the laws need at the points.
    balances, coefficients : tuple of int
        The balances that the shapes enter, with those that share a parameter with them, and their
        parameters; what the sensors are off by, which all share, is held in a search.
    usual, like : (parameters,) array
        See :class:`identification.online.rows.RowMaker`.
    lead : int
        Rows at the beginning of a window that only fill the kernel.
    overlap : float
        See :attr:`identification.online.timing.Timing.overlap`.
    """

    def __init__(self, rows: RowMaker) -> None:
        self._model, self.shapes, self.names = rows.model, rows.shapes, rows.names
        self.usual, self.like, self._off = rows.usual, rows.like, rows.off
        self._beside = [i for i, n in enumerate(rows.names) if n in rows.model.calibration]
        self._linear_of, self._linear = rows.linear_of, rows.linear.copy()
        self._linear_moves = bool(rows.linear_of.jac_sparsity(0, 0).nnz())
        self._width, self._count = rows.width, len(rows.balances)
        self._weights, self._rate_weights = rows.weights.copy(), rows.rate_weights.copy()
        self._sweeps = rows.averaged < len(rows.needed)
        self._new = rows.timing.stride // rows.timing.step
        self.lead, self.overlap = rows.rows_before_ready, rows.timing.overlap
        signals = rows.model.equations.signals.vector()
        columns = ca.jacobian_sparsity(rows.laws, signals).get_triplet()[1] if rows.needed else []
        self.used = tuple(sorted(set(columns)))
        laws = self._dense(rows)
        self.balances, self.coefficients = self._group(rows, laws)
        self._whole = self._point_model(
            laws, signals, rows.eta, range(self._count), range(len(self.names))
        )
        self._part = self._point_model(laws, signals, rows.eta, self.balances, self.coefficients)

    def _dense(self, rows: RowMaker) -> Any:
        """All entries, (balances, 1 + parameters), with zero where a law is linear in the
        signals; below them, where there are any, those whose rate is averaged.
        """
        laws = ca.SX.zeros(self._count * (1 + self._sweeps), self._width)
        for i, place in enumerate(rows.needed):
            swept = self._count if i >= rows.averaged else 0
            laws[swept + place // self._width, place % self._width] = rows.laws[i]
        return laws

    def _group(self, rows: RowMaker, laws: Any) -> tuple[tuple[int, ...], tuple[int, ...]]:
        linear = np.any(self._linear != 0, axis=1).reshape(self._count, self._width)
        there = linear | self._filled(rows)
        there[:, [1 + i for i in self._beside]] = False
        moved = {
            int(r) % laws.shape[0] % self._count
            for r in ca.jacobian_sparsity(ca.vec(laws), rows.eta).get_triplet()[0]
        }
        if self._linear_moves:
            moved = set(range(self._count))
        while True:
            shared = there[sorted(moved)][:, 1:].any(axis=0)
            more = {b for b in range(self._count) if (there[b, 1:] & shared).any()}
            if more <= moved:
                return tuple(sorted(moved)), tuple(int(c) for c in np.flatnonzero(shared))
            moved |= more

    def _filled(self, rows: RowMaker) -> BoolArray:
        found = np.zeros(self._count * self._width, dtype=bool)
        found[rows.needed] = True
        return found.reshape(self._count, self._width)

    def _point_model(
        self,
        laws: Any,
        signals: Any,
        eta: Any,
        balances: Sequence[int],
        coefficients: Sequence[int],
    ) -> SeparableModel:
        swept = [self._count + b for b in balances] if self._sweeps else []
        part = laws[[*balances, *swept], :]
        taken = [signals[i] for i in self.used]
        gone = [signals[i] for i in range(signals.shape[0]) if i not in self.used]
        (part,) = ca.substitute([part], gone, [ca.SX(0)] * len(gone)) if gone else [part]
        point = ca.SX.sym("point", len(self.used))
        (part,) = ca.substitute([part], [ca.vertcat(*taken)], [point]) if taken else [part]
        phi = part[:, [1 + c for c in coefficients]]
        function = ca.Function("laws", [point, eta], [ca.densify(phi), ca.densify(part[:, 0])])
        declared = [Coefficient(self.names[c]) for c in coefficients]
        return from_casadi(function, declared, [Shape(n, 0.0, 1.0, 0.5) for n in self.shapes])

    # --- rows -------------------------------------------------------------------------------------

    def _averaged(self, values: FloatArray) -> FloatArray:
        """Kernel averages (rows, balances, ...) of what was computed at the points (points,
        balances, ...), with those of the rates that follow it there.
        """
        taps = len(self._weights)
        windows = sliding_window_view(values, taps, axis=0)[
            self.lead * self._new - taps :: self._new
        ]
        if self._sweeps:
            count = windows.shape[1] // 2
            swept: FloatArray = windows[:, count:] @ self._rate_weights
            return windows[:, :count] @ self._weights + swept
        found: FloatArray = windows @ self._weights
        return found

    def table(
        self, window: RowWindow, eta: FloatArray, tick: Callable[[], None]
    ) -> tuple[FloatArray, FloatArray]:
        """All rows after the first :attr:`lead`: y (rows, balances) and H (rows, balances,
        parameters).
        """
        at = self._points(window)
        laws = _blocks(lambda part: self._whole.matrix(part, eta), at, tick)
        known = _blocks(lambda part: self._whole.remainder(part, eta), at, tick)
        linear = self._linear_table(window, eta)
        h = -(linear[:, :, 1:] + self._averaged(laws))
        return linear[:, :, 0] + self._averaged(known) + h @ self._off, h

    def _points(self, window: RowWindow) -> FloatArray:
        return np.ascontiguousarray(window.points[1:].reshape(-1, len(self.used)))

    def _linear_table(self, window: RowWindow, eta: FloatArray) -> FloatArray:
        linear = np.array(self._linear_of(eta)) if self._linear_moves else self._linear
        return (window.signals[self.lead :] @ linear.T).reshape(-1, self._count, self._width)

    def _sensors(
        self, window: RowWindow, eta: FloatArray, theta: FloatArray, tick: Callable[[], None]
    ) -> FloatArray:
        """Part of y that is left to what the sensors are off by, (rows, balances)."""
        if not self._beside:
            return np.zeros((len(window.signals) - self.lead, self._count))
        _, h = self.table(window, eta, tick)
        left = (theta - self._off)[self._beside]
        found: FloatArray = h[:, :, self._beside] @ left
        return found

    def model(
        self,
        window: RowWindow,
        weight: FloatArray,
        eta: FloatArray,
        theta: FloatArray,
        shapes: Sequence[Shape],
        tick: Callable[[], None],
    ) -> tuple[SeparableModel, FloatArray, FloatArray]:
        """A window as a separable model of its row numbers, for
        :class:`identification.two_step.algorithm.TwoStep`.

        Parameters
        ----------
        window : RowWindow
        weight : (rows - lead, balances) array
            Weight of each row; 0 leaves it out.
        eta : (shapes,) array
            Shapes now.
        theta : (parameters,) array
            Estimate now: what the sensors are off by stays.
        shapes : sequence of Shape
            With their boxes.
        tick : callable
            Called between portions of the work.

        Returns
        -------
        model, y (rows, outputs) and row numbers (rows, 1)
        """
        balances, coefficients = list(self.balances), list(self.coefficients)
        rows = np.flatnonzero(weight[:, balances].all(axis=1))
        scale = weight[rows][:, balances]
        points = self._points(window)
        columns = [0, *(1 + c for c in coefficients)]

        def linear(nonlinear: FloatArray) -> FloatArray:
            return self._linear_table(window, nonlinear)[rows][:, balances][:, :, columns]

        fixed = linear(eta)
        moves, part = self._linear_moves, self._part
        held = self._sensors(window, eta, theta, tick)[rows][:, balances] * scale

        def phi(index: FloatArray, nonlinear: FloatArray) -> FloatArray:
            laws = _blocks(lambda p: part.matrix(p, nonlinear), points, tick)
            tick()
            straight = linear(nonlinear) if moves else fixed
            found: FloatArray = (
                -(straight[:, :, 1:] + self._averaged(laws)[rows]) * scale[:, :, None]
            )
            return found[index[:, 0].astype(np.intp)]

        def free(nonlinear: FloatArray) -> FloatArray:
            known = (
                self._averaged(_blocks(lambda p: part.remainder(p, nonlinear), points, tick))
                if part.rest is not None
                else 0.0
            )
            straight = linear(nonlinear) if moves else fixed
            found: FloatArray = (
                straight[:, :, 0] + (known[rows] if isinstance(known, np.ndarray) else 0.0)
            ) * scale
            return found - held

        y = free(eta)

        def rest(index: FloatArray, nonlinear: FloatArray) -> FloatArray:
            return (y - free(nonlinear))[index[:, 0].astype(np.intp)]

        def slopes(index: FloatArray, nonlinear: FloatArray, theta: FloatArray) -> FloatArray:
            found = _blocks(lambda p: part.gradient(p, nonlinear, theta), points, tick)
            out: FloatArray = -self._averaged(found)[rows] * scale[:, :, None]
            return out[index[:, 0].astype(np.intp)]

        at = {p.name: p for p in self._model.parameters}
        made = SeparableModel(
            phi,
            tuple(
                Coefficient(self.names[c], at[self.names[c]].unit, at[self.names[c]].low >= 0)
                for c in coefficients
            ),
            shapes=tuple(shapes),
            channels=("row",),
            outputs=len(balances),
            rest=rest if moves or part.rest is not None else None,
            sensitivity=None if moves else slopes,
        )
        return made, y, np.arange(float(len(rows)))[:, None]


def _blocks(
    function: Callable[[FloatArray], FloatArray], points: FloatArray, tick: Callable[[], None]
) -> FloatArray:
    """A function of points, in blocks with a tick before each."""
    parts = []
    for at in range(0, len(points), _BLOCK):
        tick()
        parts.append(function(points[at : at + _BLOCK]))
    return np.concatenate(parts)


SIGNALS: Final = Signals.names()
