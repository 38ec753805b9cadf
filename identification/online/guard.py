"""Holds the estimate through sensor failures that nothing else has told: a recursion on probation.

Residuals are those of an estimate from a second before or more, which no failure since has moved. A
newer one takes its place when it has explained the readings of a second as well: an estimate of a
moment in which the recursion swings is none to go back to. A residual is judged by what was to be
expected of it: the noise, and how unsure that estimate was of the row. Where it was unsure the
innovations of the recursion are judged in its place, and what is gone back to is a quarter of a
second old: what an old estimate did not know the rows since may have told.
Where they leave their level at once, the recursion goes on, but the estimate shown is that one; on
the way there, for a second at most, it is the last one. It is taken up again as it was when the
residuals come back (the failure was temporary). The new one is accepted when it explains the
readings, the change shows in one balance, and no failed sensor explains it as well: neither a gain
and an offset of the torque of that balance nor those of its motion. These are fitted to the
residuals since, beside the new parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple, final

import numpy as np
import numpy.typing as npt

from identification.recursive.estimator import RecursiveLeastSquares

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_LIMIT: Final = 5.0
"""Residual over its level at which a probation begins."""
_CAP: Final = 3.0
_MEMORY: Final = 0.25
_AGE: Final = 1.0
_BACK: Final = 1.0
_ACCEPT: Final = 3.0
"""Time constant of the residuals; age of what is gone back to; time in which residuals must be
back, or explained [s].
"""
_EXPLAINED: Final = 0.5
"""Share of the limit under which a new estimate explains the readings: a half, so that residuals
that hover at the limit do not pass for explained. A failed sensor explains them by the same
measure, and the estimate shown waits from there."""
_SINGULAR: Final = 1e-9
"""Share of a signal's mean square that varies at least, for its gain to be told from its offset; a
thousand times the rounding of the sums."""
_LONG_AGO: Final = -1_000_000
_PLAIN: Final = (
    "on_probation",
    "_back",
    "_explained",
    "_next",
    "_doubt",
    "held_for",
    "_fast",
    "_trial",
    "_own",
    "_until",
    "_new",
    "_over",
    "_on",
    "_sums",
    "_limits",
)


_SUMS: Final = 10
"""Sums of each balance: rows, squares of residual and weight, and of torque and motion their
squares and their products with weight and residual."""


class _Kept(NamedTuple):
    """A recursion to go back to, and its memory to judge residuals with."""

    state: bytes
    fast: FloatArray

    @classmethod
    def of(cls, estimator: RecursiveLeastSquares) -> _Kept:
        return cls(estimator.state(), estimator.engine_for("guard").fast.copy())


def sensor_explains(sums: Sequence[float], limit: float) -> bool:
    """True where gain and offset of the torque or of the motion leave less of the residuals than
    the limit.

    Parameters
    ----------
    sums : (10,) sequence of float
        Rows, then sums of e e, w e, w w, x x, x w, x e, m m, m w and m e, where e is the residual,
        w the weight of the row, x the torque and m what the motion makes of it, both weighted.
    limit : float
        Root mean square [N.m].
    """
    rows, ee, we, ww = sums[:4]
    if not ww > 0.0:
        return True
    least = ee - we * we / ww
    for square, mean, product in (sums[4:7], sums[7:10]):
        own = square - mean * mean / ww
        if own > _SINGULAR * square:
            shared = product - mean * we / ww
            least = min(least, ee - we * we / ww - shared * shared / own)
    return least <= limit * limit * rows


@final
class Guard:
    """Watches the rows of an online estimator.

    Parameters
    ----------
    names, balances : sequence of str
        Parameters and balances.
    period : float
        Time between rows [s].

    Attributes
    ----------
    theta : (parameters,) array
        The estimate to show.
    scale : (parameters,) array
        That of the recursion.
    on_probation : bool
    held_for : int
        Rows since the probation began.
    """

    def __init__(self, names: Sequence[str], balances: Sequence[str], period: float) -> None:
        self._count, self._size = len(balances), len(names)
        self._rate = min(1.0, period / _MEMORY)
        self._age, self._wait_back, self._wait_accept, self._often = (
            max(1, round(t / period)) for t in (_AGE, _BACK, _ACCEPT, _MEMORY)
        )
        self._forget = 1.0 - 1.0 / self._wait_accept
        self.reset()

    def reset(self) -> None:
        """Before the recursion starts."""
        self.on_probation = False
        self._back = self._explained = self._next = self._doubt = self._until = self.held_for = 0
        self._fast, self._new = [0.0] * self._count, [0.0] * self._count
        self._trial, self._own = [0.0] * self._count, [0.0] * self._count
        self._over, self._on = [_LONG_AGO] * self._count, [True] * self._count
        self._sums = [[0.0] * _SUMS for _ in range(self._count)]
        self._limits = [0.0] * self._count
        self.theta, self.scale = np.zeros(self._size), np.ones(self._size)
        self._kept: list[_Kept] = []

    def start(self, estimator: RecursiveLeastSquares) -> None:
        """A new recursion, trusted."""
        self.reset()
        self.theta = estimator.theta
        self.scale = estimator.engine_for("guard").part("config", "scale").copy()
        self._kept = [_Kept.of(estimator)] * 3

    @property
    def fast(self) -> list[FloatArray]:
        """Memory of the recursion whose estimate residuals are judged with, a second old or more,
        so that a recursion that follows a failed sensor within less does not hide it; and of the
        one that is to follow it (:class:`identification.recursive.settings.Layout`).
        """
        return [kept.fast for kept in self._kept[:2]]

    @property
    def before(self) -> FloatArray:
        """The estimates of :attr:`fast`, (2, parameters)."""
        return np.array([fast[: self._size] * self.scale for fast in self.fast])

    def step(
        self,
        estimator: RecursiveLeastSquares,
        theta: FloatArray,
        error: FloatArray,
        level: FloatArray,
        on: BoolArray,
        signals: FloatArray,
    ) -> str:
        """Judge the recursion after a row.

        Parameters
        ----------
        estimator : RecursiveLeastSquares
            After its update; it may be put back.
        theta : (parameters,) array
            Its estimate.
        error : (3, balances) array
            Residuals of the row with :attr:`before`, in the weights of
            :attr:`identification.online.row_check.RowCheck.weighted_error`.
        level : (balances,) array
            Size the residuals have when all is well.
        on : (balances,) bool array
            Balances whose readings were all there.
        signals : (3, balances) array
            :attr:`identification.online.row_check.RowCheck.signals` of the row.

        Returns
        -------
        str
            What happened: "", "held", "back" or "accepted".
        """
        flags, limits = on.tolist(), [_LIMIT * v for v in level.tolist()]
        self._limits = limits
        lost = any(was and not now for was, now in zip(self._on, flags, strict=True))
        self._on = flags
        errors, newer, own = error.tolist()
        over = self._follow(self._fast, errors, limits)
        if not self.on_probation:
            self._follow(self._trial, newer, limits)
            follows = self._follow(self._own, own, limits)
            if True in follows and True not in over:
                over, self._fast, self._kept = follows, list(self._own), [self._kept[2]] * 3
            return self._calm(estimator, theta, over, limits, lost=lost)
        self.held_for += 1
        self._over = [
            self.held_for if now else then for now, then in zip(over, self._over, strict=True)
        ]
        self._back = 0 if True in over else self._back + 1
        self._remember(errors, signals.tolist())
        unexplained = self._follow(self._new, estimator.error.tolist(), limits, share=_EXPLAINED)
        self._explained = 0 if True in unexplained else self._explained + 1
        if self._back >= self._wait_back:
            self._restore(estimator)
            self.on_probation = False
            return "back"
        if self._explained >= self._wait_accept and self.plausible:
            self.start(estimator)
            return "accepted"
        return ""

    def _follow(
        self, squares: list[float], errors: list[float], limits: list[float], share: float = 1.0
    ) -> list[bool]:
        """Mean squares of errors, in place; what is far over the limit is cut, not to be
        remembered for long.
        """
        over = []
        for b, (error, limit, use) in enumerate(zip(errors, limits, self._on, strict=True)):
            most = _CAP * limit
            cut = min(max(error, -most), most) if use else 0.0
            squares[b] += self._rate * (cut * cut - squares[b])
            over.append(squares[b] > (share * limit) ** 2)
        return over

    def blind(self, estimator: RecursiveLeastSquares) -> FloatArray:
        """No balance has its readings: the estimate to show."""
        if True in self._on and not self.on_probation:
            self._restore(estimator)
        self._on = [False] * self._count
        return self.theta

    def _doubtful(self, limits: list[float]) -> bool:
        """True where the residuals are no longer those of an estimate that explains them."""
        return any(
            max(square, own) > (_EXPLAINED * limit) ** 2
            for square, own, limit in zip(self._fast, self._own, limits, strict=True)
        )

    def _proven(self, limits: list[float]) -> bool:
        """True where the newer estimate explains the readings, or as well as the older one."""
        return all(
            new <= max(old, (_EXPLAINED * limit) ** 2)
            for new, old, limit in zip(self._trial, self._fast, limits, strict=True)
        )

    def _calm(
        self,
        estimator: RecursiveLeastSquares,
        theta: FloatArray,
        over: list[bool],
        limits: list[float],
        *,
        lost: bool,
    ) -> str:
        if True in over:
            self.on_probation = True
            self._over = [0 if now else _LONG_AGO for now in over]
            self._new = list(self._fast)
            self._back = self._explained = self.held_for = 0
            self._sums = [[0.0] * _SUMS for _ in range(self._count)]
            self.theta = self.before[0]
            return "held"
        if lost:  # rows before a failure was noticed may hold it
            self._restore(estimator)
            return ""
        self._doubt = self._doubt + 1 if self._doubtful(limits) else 0
        if 0 < self._doubt <= self._age:  # what is no failure by then is told by no more rows
            return ""
        self.theta = theta
        self._until += 1
        if self._until >= self._often:
            self._until = 0
            self._kept[2] = _Kept.of(estimator)
        self._next += 1
        if self._next >= self._age:
            self._next = 0
            if self._proven(limits):
                self._kept[0] = self._kept[1]
            self._kept[1] = _Kept.of(estimator)
        return ""

    def _restore(self, estimator: RecursiveLeastSquares) -> None:
        estimator.restore(self._kept[0].state)
        self.theta = estimator.theta
        self._kept = [self._kept[0]] * 3
        self._own = [0.0] * self._count
        self._next = self._until = 0

    @property
    def several(self) -> bool:
        """True on probation where more than one balance is over its limit, or was just now: a
        sensor rather than the joint.
        """
        return (
            self.on_probation
            and sum(self.held_for - then < self._wait_accept for then in self._over) > 1
        )

    @property
    def plausible(self) -> bool:
        """True where the joint itself may have changed: one balance only, and no failed sensor
        explains its residuals.
        """
        if self.several:
            return False
        return not any(
            sensor_explains(sums, _EXPLAINED * limit)
            for sums, limit, then in zip(self._sums, self._limits, self._over, strict=True)
            if self.held_for - then < self._wait_accept
        )

    def _remember(self, errors: list[float], signals: list[list[float]]) -> None:
        """Sums of products of the residual, the signals of its balance and one, in place."""
        torques, motions, weights = signals
        for b, use in enumerate(self._on):
            if use:
                e, x, m, w = errors[b], torques[b], motions[b], weights[b]
                new = (1.0, e * e, w * e, w * w, x * x, x * w, x * e, m * m, m * w, m * e)
                self._sums[b] = [
                    self._forget * old + more for old, more in zip(self._sums[b], new, strict=True)
                ]

    def figures(self) -> dict[str, float]:
        """Limits and times [rows], for the native twin."""
        return {
            "LIMIT": _LIMIT,
            "CAP": _CAP,
            "RATE": self._rate,
            "AGE": self._age,
            "BACK": self._wait_back,
            "ACCEPT": self._wait_accept,
            "OFTEN": self._often,
            "FORGET": self._forget,
            "SINGULAR": _SINGULAR,
            "SUMS": _SUMS,
            "EXPLAINED": _EXPLAINED,
            "LONG_AGO": _LONG_AGO,
        }

    # --- state ------------------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, Any], dict[str, FloatArray], dict[str, bytes]]:
        """Everything that changes."""
        parts = {f"guard{i}": kept.state for i, kept in enumerate(self._kept)}
        return {n: getattr(self, n) for n in _PLAIN}, self._arrays(), parts

    def _arrays(self) -> dict[str, FloatArray]:
        return {
            "theta": self.theta,
            "scale": self.scale,
            "fast": np.array([k.fast for k in self._kept]),
        }

    def restore(
        self, plain: Mapping[str, Any], arrays: Mapping[str, FloatArray], parts: Mapping[str, bytes]
    ) -> None:
        """Take up what :meth:`state` gave."""
        for name in _PLAIN:
            setattr(self, name, plain[name])
        self.theta, self.scale = arrays["theta"], arrays["scale"]
        self._kept = [_Kept(parts[f"guard{i}"], fast) for i, fast in enumerate(arrays["fast"])]
