"""What a new row says before the recursion takes it: residuals, weights, their mean squares; one
CasADi call, of which the native estimator has the C.

A row at a reversal counts less: there friction may take any value between its limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from identification.recursive.settings import Layout
from identification.recursive.ud_factor import Factor, Parts, total

FloatArray = npt.NDArray[np.float64]

LEAST: Final = 1e-12
"""Nothing counts as smaller than this [N.m]."""
_TORQUE: Final = 0.2
"""Share of the rate of the residuals' mean square at which that of the torques moves: torque swings
with the motion, over some seconds, and a floor should not."""
_INTO: Final = (
    "y",
    "h",
    "theta",
    "older",
    "newer",
    "running",
    "scale",
    "share",
    "on",
    "floor",
    "level",
    "reference",
    "square",
    "torque",
    "floor_share",
)
_OUT: Final = (
    "error",
    "weighted_error",
    "square",
    "torque",
    "least",
    "ratio",
    "over",
    "y",
    "h",
    "signals",
)


@final
class RowCheck:
    """Bound to fixed memory.

    Parameters
    ----------
    balances, parameters : int
    friction : (2) sequence of sequence of int
        Parameters that are friction torques, of motor and link.
    known : (2) sequence of float
        Sum of the friction torques of motor and link that are known and no parameters [N.m].
    feels : (balances, 2) bool array
        Balances that the friction of motor and link enters.
    rate, limit : float
        Share by which a row moves the mean squares; residual over its level that is too large.

    Attributes
    ----------
    error : (balances,) array
        Residuals of the last row with the estimate.
    weighted_error : (3, balances) array
        Residuals with two estimates from before, and of the recursion itself, times their weights
        and what noise alone is of what is expected of them (noise and :func:`_unsure`). That of
        the recursion counts as far as the older estimate was unsure of the row.
    square, torque, least, ratio, over : (balances,) array
        Mean squares of the weighted residuals and of the torques; what counts as noise at least
        [N.m]; residual over that; 1 where the residual is over its limit.
    y, h : (balances,) and (balances, parameters) array
        The row times its weights.
    signals : (3, balances) array
        Torque, what the motion makes of it (all but friction torques), and one, times the weights
        and that of the older estimate: what a gain or an offset of a reading adds to its residual.
    function, weight : casadi.Function
        The whole check, and (shares, parameters, size of the residuals) -> weights.
    """

    def __init__(
        self,
        balances: int,
        parameters: int,
        friction: Sequence[Sequence[int]],
        known: Sequence[float],
        feels: npt.NDArray[np.bool_],
        rate: float,
        limit: float,
    ) -> None:
        layout = Layout(parameters, balances).fast
        sizes = {
            "h": (parameters, balances),
            "theta": (parameters, 1),
            "older": (layout.size, 1),
            "newer": (layout.size, 1),
            "running": (layout.size, 1),
            "scale": (parameters, 1),
            "share": (2, 1),
            "floor_share": (1, 1),
        }
        v = {name: ca.SX.sym(name, *sizes.get(name, (balances, 1))) for name in _INTO}
        size = ca.fmax(ca.fmax(v["floor"], ca.sqrt(v["square"])), LEAST)
        self.weight = _weight_function(balances, parameters, friction, known, feels)
        weight = self.weight(v["share"], v["theta"], size)
        error = v["y"] - v["h"].T @ v["theta"]
        moves = ca.DM.ones(parameters)
        for j in (j for side in friction for j in side):
            moves[j] = 0.0
        motion = v["h"].T @ (moves * v["theta"])
        left, use = weight * error, v["on"]
        square = ca.if_else(use, v["square"] + rate * (left * left - v["square"]), v["square"])
        torque = ca.if_else(
            use,
            v["torque"] + _TORQUE * rate * (v["reference"] * v["reference"] - v["torque"]),
            v["torque"],
        )
        least = ca.fmax(ca.fmax(v["floor"], v["floor_share"] * ca.sqrt(torque)), LEAST)
        root = ca.sqrt(square)
        level = ca.fmax(least, v["level"])
        over = ca.logic_and(use, root > limit * level)
        kept = [Parts(v[name], layout) for name in ("older", "newer", "running")]
        unsure = [_unsure(part, v["scale"], v["h"], weight / level) for part in kept]
        trusted = [weight / ca.sqrt(1 + share) for share in unsure]
        before = [v["scale"] * ca.vertcat(*part["theta"]) for part in kept]
        judged = [
            share * (v["y"] - v["h"].T @ values)
            for share, values in zip(trusted, before, strict=True)
        ]
        judged[2] *= ca.sqrt(unsure[0] / (1 + unsure[0]))
        out = (
            error,
            ca.horzcat(*judged),
            square,
            torque,
            least,
            root / least,
            over,
            weight * v["y"],
            v["h"] * ca.repmat(weight.T, parameters, 1),
            ca.horzcat(trusted[0] * v["reference"], trusted[0] * motion, trusted[0]),
        )
        self.function = ca.Function("row_check", list(v.values()), [ca.densify(e) for e in out])
        self._into = [
            np.zeros((balances, parameters) if name == "h" else v[name].numel()) for name in _INTO
        ]
        shapes = {
            "h": (balances, parameters),
            "signals": (3, balances),
            "weighted_error": (3, balances),
        }
        found = [np.zeros(shapes.get(name, (balances,))) for name in _OUT]
        self._buffer, self._trigger = self.function.buffer()
        for i, item in enumerate(self._into):
            self._buffer.set_arg(i, item.data)
        for i, item in enumerate(found):
            self._buffer.set_res(i, item.data)
        (
            self.error,
            self.weighted_error,
            self.square,
            self.torque,
            self.least,
            self.ratio,
            self.over,
            self.y,
            self.h,
            self.signals,
        ) = found

    def __call__(self, *given: Any) -> None:
        """Take y, h, theta, the recursions from before and now, their scale, the shares of
        standstill, flags, floor, level, torques, mean squares and the floor's share of the torque.
        """
        for target, value in zip(self._into, given, strict=True):
            target[:] = value
        self._trigger()

    def weights(self, shares: FloatArray, theta: FloatArray, size: FloatArray) -> FloatArray:
        """Weights (rows, balances) of rows with shares of standstill (rows, 2), for residuals of
        size (balances,).
        """
        return np.array(self.weight(shares.T, theta, size)).T


def _unsure(kept: Parts, scale: Any, h: Any, weight: Any) -> Any:
    """Variance that the covariance P of an estimate adds to a residual, over that of the noise:
    w^2 h P h', (balances,).

    Parameters
    ----------
    kept : Parts
        Of the recursion whose estimate the residuals are of.
    scale : (parameters,)
    h : (parameters, balances)
    weight : (balances,)
        Weights of the rows over the standard deviations of their noise.
    """
    factor = Factor(kept["d"], kept["u"])
    found = []
    for b in range(h.size2()):
        row = factor.transposed_times(ca.vertsplit(scale * h[:, b]))
        own = total([d * item * item for d, item in zip(factor.d, row, strict=True)])
        found.append(weight[b] * weight[b] * own)
    return ca.vertcat(*found)


def _weight_function(
    balances: int,
    parameters: int,
    friction: Sequence[Sequence[int]],
    known: Sequence[float],
    feels: npt.NDArray[np.bool_],
) -> Any:
    """Weights of the balances' rows at a reversal, where friction may take any value between its
    limits.
    """
    share, theta, size = (
        ca.SX.sym("share", 2),
        ca.SX.sym("theta", parameters),
        ca.SX.sym("size", balances),
    )
    force = [
        share[i] * sum((ca.fabs(theta[j]) for j in friction[i]), ca.SX(known[i])) for i in range(2)
    ]
    weights = []
    for b in range(balances):
        doubt = sum((force[i] * force[i] for i in range(2) if feels[b, i]), ca.SX(0))
        weights.append(1 / ca.sqrt(1 + doubt / (size[b] * size[b])))
    return ca.Function("row_weight", [share, theta, size], [ca.densify(ca.vertcat(*weights))])


__all__ = ["LEAST", "RowCheck"]
