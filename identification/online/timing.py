"""How long the kernels of online rows are, and how often a row is made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np

from identification.balance.weak import differentiated_kernel, kernel, whole

_LENGTH: Final = 0.06
_OVERLAP: Final = 4
_POINT_STEP: Final = 0.002


@final
@dataclass(frozen=True)
class Timing:
    """Kernel lengths in samples.

    Attributes
    ----------
    dt : float
        Sample time [s].
    length, pointwise : float
        Kernel of the balances, and of the velocities inside nonlinear laws [s].
    step, stride : int
        Samples between points, and between rows.
    half, reach, point_half : int
        Half the kernel in samples; samples a row lies back; half the kernel in points.
    window : int
        Samples that a row needs.
    """

    dt: float
    length: float
    pointwise: float
    step: int
    stride: int
    half: int
    reach: int
    point_half: int
    window: int

    @staticmethod
    def of(dt: float) -> Timing:
        """The lengths that the off-line fit uses at this sample time."""
        length = max(_LENGTH, 8 * dt)
        pointwise = max(length / 2 if length <= _LENGTH else 0.06, 6 * dt)
        step = max(1, whole(_POINT_STEP / dt))
        stride = max(step, whole(length / dt / _OVERLAP / step) * step)
        half = len(differentiated_kernel(length, dt, 3)) // 2
        point_half = len(differentiated_kernel(length, dt * step, 0)) // 2
        own = len(kernel(pointwise, dt, 3)) // 2
        reach = max(half, point_half * step + own)
        window = reach + max(half, point_half * step + own) + 1
        return Timing(
            dt,
            length,
            pointwise=pointwise,
            step=step,
            stride=stride,
            half=half,
            reach=reach,
            point_half=point_half,
            window=window,
        )

    @property
    def overlap(self) -> float:
        """Variance of a mean of rows over that of as many independent ones: neighbours share
        samples.
        """
        weights = differentiated_kernel(self.length, self.dt, 0)
        shared = np.correlate(weights, weights, "full")
        middle = len(weights) - 1
        return float(np.sum(shared[middle % self.stride :: self.stride]) / shared[middle])

    @property
    def delay(self) -> float:
        """Time between a row's instant and the sample at which it is made [s]."""
        return self.reach * self.dt
