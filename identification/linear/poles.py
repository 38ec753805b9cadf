"""Poles of discrete linear models as frequency and damping, with what noise leaves open.

Deviations come from those of the coefficients to first order: for a single root z of
``z^n + a_1 z^(n-1) + ...``, dz/da_k = -z^(n-k) / p'(z).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

REAL: Final = 1e-9
"""Imaginary part of a pole, relative to its modulus, up to which it is rounding of a real one."""


@final
@dataclass(frozen=True)
class Pole:
    """One pole of a discrete model; of a conjugate pair the upper one.

    Attributes
    ----------
    value : complex
        In the plane of z.
    covariance : ndarray, shape (2, 2)
        Of real and imaginary part; NaN where the method gives none.
    frequency, damping : float
        |s| / 2 pi [Hz] and -Re s / |s| of s = log(z) / dt; the frequency is infinite for z = 0.
    frequency_deviation, damping_deviation : float
        Standard deviations; NaN where there is no covariance.
    """

    value: complex
    covariance: FloatArray
    frequency: float
    damping: float
    frequency_deviation: float
    damping_deviation: float

    @property
    def deviation(self) -> float:
        """Standard deviation in the plane of z: root of the summed variances."""
        return math.sqrt(max(float(np.trace(self.covariance)), 0.0))

    @property
    def is_pair(self) -> bool:
        """True where the pole stands for a conjugate pair."""
        return self.value.imag > REAL * abs(self.value)

    def as_json(self) -> dict[str, Any]:
        """As data."""
        return {
            "real": self.value.real,
            "imaginary": self.value.imag,
            "covariance": self.covariance.tolist(),
            "frequency_hz": self.frequency,
            "frequency_deviation_hz": self.frequency_deviation,
            "damping": self.damping,
            "damping_deviation": self.damping_deviation,
        }


def pole(value: complex, dt: float, covariance: npt.ArrayLike | None = None) -> Pole:
    """A pole with frequency and damping.

    Parameters
    ----------
    value : complex
        In the plane of z.
    dt : float
        Sampling time [s].
    covariance : (2, 2) array_like, optional
        Of real and imaginary part.
    """
    known = np.full((2, 2), np.nan) if covariance is None else np.asarray(covariance, dtype=float)
    z = complex(value)
    if abs(z.imag) <= REAL * abs(z):
        z = complex(z.real, 0.0)
    if z == 0.0:
        return Pole(z, known, math.inf, 1.0, math.nan, math.nan)
    s = np.log(z) / dt
    size = abs(s)
    if size == 0.0:  # an integrator has no damping ratio
        slope = 1.0 / (dt * abs(z) * 2.0 * math.pi)
        return Pole(
            z, known, 0.0, math.nan, slope * math.sqrt(max(float(known[0, 0]), 0.0)), math.nan
        )
    # ds/dz is complex analytic: as a real matrix it turns and stretches
    turn = 1.0 / (z * dt)
    inner = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    frequency = np.array([s.real, s.imag]) / (2.0 * math.pi * size)
    damping = np.array([-(s.imag**2), s.real * s.imag]) / size**3
    outer = np.vstack([frequency, damping]) @ inner
    both = np.sqrt(np.maximum(np.diag(outer @ known @ outer.T), 0.0))
    return Pole(
        z,
        known,
        frequency=float(size) / (2.0 * math.pi),
        damping=-float(s.real) / float(size),
        frequency_deviation=float(both[0]),
        damping_deviation=float(both[1]),
    )


def poles_of(
    polynomial: npt.ArrayLike, dt: float, covariance: npt.ArrayLike | None = None
) -> tuple[Pole, ...]:
    """Roots of a monic polynomial in the backward shift, the slowest first.

    Parameters
    ----------
    polynomial : (n + 1,) array_like
        1, a_1, ..., a_n.
    dt : float
        Sampling time [s].
    covariance : (n, n) array_like, optional
        Of a_1, ..., a_n.

    Returns
    -------
    tuple of Pole
        Of conjugate pairs the upper one.
    """
    coefficients = np.asarray(polynomial, dtype=np.float64)
    n = len(coefficients) - 1
    found = []
    slope = np.polyder(coefficients)
    for z in np.roots(coefficients):
        if z.imag < -REAL * abs(z):
            continue
        known = None
        if covariance is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                gradient = -(z ** (n - np.arange(1, n + 1))) / np.polyval(slope, z)
            rows = np.vstack([gradient.real, gradient.imag])
            known = rows @ np.asarray(covariance, dtype=np.float64) @ rows.T
        found.append(pole(complex(z), dt, known))
    return tuple(sorted(found, key=lambda p: (p.frequency, p.damping)))


def poles_of_matrix(
    a: npt.ArrayLike, dt: float, covariances: npt.ArrayLike | None = None
) -> tuple[Pole, ...]:
    """Eigenvalues of a state matrix, the slowest first.

    Parameters
    ----------
    a : (n, n) array_like
    dt : float
        Sampling time [s].
    covariances : (n, 2, 2) array_like, optional
        Of real and imaginary part of each eigenvalue, in the order of `numpy.linalg.eigvals`.
    """
    values = np.linalg.eigvals(np.asarray(a, dtype=np.float64))
    known = [None] * len(values) if covariances is None else list(np.asarray(covariances))
    found = [
        pole(complex(z), dt, c)
        for z, c in zip(values, known, strict=True)
        if z.imag >= -REAL * abs(z)
    ]
    return tuple(sorted(found, key=lambda p: (p.frequency, p.damping)))
