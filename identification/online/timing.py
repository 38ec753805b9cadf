"""How long the kernels of online rows are, how often a row is made, and where late channels stand.

The series of a delay of some samples, of which a model has the first term, is off by percents: 6 ms
late, an inertia came out 3.5 % off. So channels of which the joint file says how late they are go
into the rows at their true time, encoders by whole samples, which leaves their noise as it is,
torques by a cubic through four readings, as :mod:`identification.balance.clocks` does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.balance.clocks import ENCODERS, MOST_SKEW, SIGNAL, cubic
from identification.balance.weak import HALF, differentiated_kernel, kernel, whole

FloatArray = npt.NDArray[np.float64]

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
        point_half = len(differentiated_kernel(length, dt, 0, step)) // 2
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


@final
@dataclass(frozen=True)
class Alignment:
    """Weights of the last readings, whose sum is the signal at its true time.

    Attributes
    ----------
    lead : int
        Samples by which the aligned sample is older than the newest reading.
    taps : (sources, readings) array
        Oldest reading first; one column where no channel is late.
    left : mapping of str to float
        What is left to the model of each delay [s].
    late : mapping of str to float
        Samples by which each signal is shifted.
    """

    lead: int
    taps: FloatArray
    left: Mapping[str, float]
    late: Mapping[str, float]

    @property
    def shifts(self) -> bool:
        """True where there is anything to do."""
        return bool(np.any(self.taps[:, -1] != 1.0))

    @staticmethod
    def of(
        model: JointModel,
        sources: Sequence[str],
        dt: float,
        found: Mapping[str, float] | None = None,
    ) -> Alignment:
        """The alignment of a model's delays at their values.

        Parameters
        ----------
        model : JointModel
        sources : sequence of str
            Signals' names.
        dt : float
            Sample time [s].
        found : mapping of str to float, optional
            Skews beyond these delays [samples]; the taps have room for :data:`MOST_SKEW` either
            way.
        """
        values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
        late, left = dict.fromkeys(sources, 0.0), {}
        for place, signal in SIGNAL.items():
            for name in model.named("delay", place):
                samples = values[name] / dt
                near = round(samples)
                off = near if place in ENCODERS or abs(samples - near) < HALF else samples
                late[signal] += off
                left[name] = (samples - off) * dt
        room = 0
        if found is not None:
            room = _newest(max(0.0, *late.values()) + MOST_SKEW) + _oldest(
                MOST_SKEW - min(0.0, *late.values())
            )
        for signal, skew in (found or {}).items():
            late[signal] += skew
        # a cubic between two readings needs one more on either side
        lead = max(0, *(_newest(d) for d in late.values()))
        ages = {s: lead - d for s, d in late.items()}
        length = 1 + max(room, *(_oldest(a) for a in ages.values()))
        taps = np.zeros((len(sources), length))
        for k, source in enumerate(sources):
            whole = math.floor(ages[source])
            part = ages[source] - whole
            for age, weight in (
                zip(range(whole - 1, whole + 3), cubic(part), strict=True)
                if part
                else ((whole, 1.0),)
            ):
                taps[k, length - 1 - age] = weight
        return Alignment(lead, taps, left, late)


def _newest(late: float) -> int:
    return math.ceil(late) + (late != math.floor(late))


def _oldest(age: float) -> int:
    whole = math.floor(age)
    return whole + 2 * (age != whole)
