"""What the sensors of a run are off by: found with the parameters and, where it is more than a
little, taken off the readings before the recursion starts.

A zero between the encoders and skews between the clocks have columns of their own in the rows, the
derivatives at the values of the joint file. That is a straight line, good for a small skew only:
of two samples, half its square is no small part. So what the first window says is
taken off its readings and its rows are made again until no more comes out, as
:mod:`identification.balance.clocks` shifts the channels of a record; a zero is taken off where a
law of the twist is bent. The drive stays as it is: most are late through a low-pass, which the rate
of the reading makes good and no shift.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from casadi_models.hold import CLOCKS, UNKNOWNS
from identification.balance.clocks import LOW_PASSED, MOST_SKEW, NEAR, SIGNAL, SURE

FloatArray = npt.NDArray[np.float64]

ROUNDS: Final = 8
"""Times that the rows are made again at most, at the values of the joint file and then with all
free, as many as :mod:`identification.balance.calibration` takes: under a straight spring two, under
a cubic one three samples, which are more than its whole twist, take six."""

FURTHER: Final = 0.1
"""Share of what is too little to make rows again at which it ends once they are."""

PARTS: Final = 256.0
"""Parts of a sample to which a skew is rounded before it is taken off; a zero is to the power of
two under a tenth of what is too little. The columns follow what is left, and another order of the
same sums, as in C, gives the same readings."""


@final
class Calibration:
    """What has been taken off the readings of a run.

    Parameters
    ----------
    model : JointModel
    names : sequence of str
        Estimated parameters.
    dt : float
        Sample time [s].

    Attributes
    ----------
    off : (parameters,) array
        Value of each parameter that the readings are freed of [rad, s]; 0 for the others.
    unknowns : tuple of int
        Numbers of the parameters that are the sensors' and not the joint's.
    skews, zeros : mapping of int to str
        Signal by the number of the parameter: of what may be taken off.
    most, near : float
        Largest skew, and the change of one that is too small to make the rows again [s].
    part : float
        To which a skew is rounded [s].
    """

    def __init__(self, model: JointModel, names: Sequence[str], dt: float) -> None:
        self._dt, self.most, self.near, self.part = dt, MOST_SKEW * dt, NEAR * dt, dt / PARTS
        own = {i: CLOCKS[n] for i, n in enumerate(names) if n in CLOCKS}
        bent = _bent_zeros(model)
        self.skews = {i: SIGNAL[u.place] for i, u in own.items() if u.place not in LOW_PASSED}
        self.zeros = {i: SIGNAL[UNKNOWNS[n].place] for i, n in enumerate(names) if n in bent}
        self.unknowns = tuple(i for i, n in enumerate(names) if n in UNKNOWNS)
        self.off: FloatArray = np.zeros(len(names))

    def __bool__(self) -> bool:
        """True where anything may be taken off."""
        return bool(self.skews or self.zeros)

    @property
    def late(self) -> Mapping[str, float]:
        """Samples by which signals are shifted."""
        return {signal: float(self.off[i]) / self._dt for i, signal in self.skews.items()}

    @property
    def zero(self) -> float:
        """What is taken off the link position [rad]."""
        return float(sum(self.off[i] for i in self.zeros))

    def reset(self) -> None:
        """Before the first sample."""
        self.off = np.zeros_like(self.off)

    def held(
        self,
        y: FloatArray,
        h: FloatArray,
        known: FloatArray,
        noise: FloatArray,
        usual: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """All parameters with the unknowns of the sensors as they are where the joint is as in its
        file, and standard deviations, (parameters,) each.

        How a law of the twist bends and where its middle is are hard to tell together, and its
        derivative at a wrong middle misleads.

        Parameters
        ----------
        y, h : (rows, balances) and (rows, balances, parameters) array
            Weighted rows.
        known : (parameters,) array
            Values of the joint file.
        noise : (balances,) array
            Variance of the mean of the weighted rows over their number.
        usual : (parameters,) array
            :attr:`identification.online.rows.RowMaker.usual`.
        """
        beside = known.copy()
        beside[list(self.unknowns)] = 0.0
        left = y - h @ beside
        own = [i for i in self.unknowns if h[:, :, i].any()]
        columns = h[:, :, own]
        matrix = np.einsum("kbi,kbj,b->ij", columns, columns, 1.0 / noise)
        matrix += np.diag([1.0 / usual[i] ** 2 if usual[i] > 0.0 else 0.0 for i in own])
        target = np.einsum("kbi,kb,b->i", columns, left, 1.0 / noise)
        size = np.sqrt(np.diag(matrix))
        inverse = np.linalg.inv(matrix / np.outer(size, size))
        theta, sigma = known.copy(), np.zeros(len(known))
        theta[own] = inverse @ (target / size) / size
        sigma[own] = np.sqrt(np.diag(inverse)) / size
        return theta, sigma

    def small(self, h: FloatArray, least: FloatArray) -> FloatArray:
        """What is too little of each unknown to make the rows again, (parameters,): a tenth of a
        sample, and a zero whose whole torque is less than what counts as noise.

        Parameters
        ----------
        h : (rows, balances, parameters) array
            Weighted rows.
        least : (balances,) array
            What counts as noise of each balance at least [N.m].
        """
        found = np.full(len(self.off), self.near)
        for i in self.zeros:
            size = float(np.max(np.sqrt(np.mean(h[:, :, i] ** 2, axis=0)) / least))
            found[i] = 1.0 / size if size > 0.0 else np.inf
        return found

    def take(self, theta: FloatArray, sigma: FloatArray, small: FloatArray) -> bool:
        """Take off what rows have told; False where that is too little.

        Parameters
        ----------
        theta, sigma, small : (parameters,) array
            Estimate and standard deviations, and :meth:`small`.
        """
        share = FURTHER if self.off.any() else 1.0
        found, limit = self.off.copy(), np.maximum(share * small, SURE * sigma)
        for i in self.skews:
            value = min(max(float(theta[i]), -self.most), self.most)
            if abs(value - found[i]) > limit[i]:
                found[i] = round(value / self.part) * self.part
        moved = any(abs(theta[i] - found[i]) > limit[i] for i in self.zeros)
        if np.array_equal(found, self.off) and not moved:
            return False
        for i in self.zeros:
            step = 2.0 ** math.floor(math.log2(FURTHER * small[i])) if small[i] < np.inf else 1.0
            found[i] = round(float(theta[i]) / step) * step
        self.off = found
        return True


def _bent_zeros(model: JointModel) -> frozenset[str]:
    """Zeros that laws of the twist see by more than a straight line; to gravity, which is bent
    over a radian, they are small.
    """
    p, names = model.equations.parameters, model.parameter_names
    found = set()
    for name in model.calibration:
        if UNKNOWNS[name].what == "zero":
            own = p[names.index(name)]
            if ca.depends_on(ca.jacobian(model.equations.transmitted, own), own):
                found.add(name)
    return frozenset(found)


__all__ = ["Calibration"]
