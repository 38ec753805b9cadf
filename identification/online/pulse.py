"""Do the readings live? What fails in all sensors at once: a bus that repeats its last frame, a
clock that stops or jumps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.online.watch import Q_L, Q_M

FloatArray = npt.NDArray[np.float64]

REPEATS: Final = 3
"""Samples in a row without one changed bit before anything is said."""
CHANCE: Final = 1e-9
"""Chance of so many equal samples in a row from living sensors, below which they count as dead:
one in ten days at 1 kHz.
"""
MEMORY: Final = 1000
"""Samples over which the share of equal neighbours is averaged; coarse encoders have many."""
MOVING: Final = 2e-3
"""Speed before the readings stood still up to which they may do so because the joint does [rad/s];
up to there a friction law is a jump (:data:`identification.online.rows.SHARP`)."""
PACE: Final = 16
"""Samples over which that speed is averaged."""
GAP: Final = 0.25
"""Longest time between two samples as a share of a row's kernel; beyond it the kernel no longer
sees the motion.
"""


@final
class Pulse:
    """Watches one sample after the other.

    Parameters
    ----------
    dt, kernel : float
        Sample time and length of a row's kernel [s].
    needs : sequence of bool
        Readings that are there and looked at.

    Attributes
    ----------
    still : bool
        The readings repeat themselves more often than living ones do, or time has not gone on: they
        tell nothing.
    failed : bool
        They stand still although the joint was moving.
    jumped : bool
        There was a gap before this sample.
    """

    def __init__(self, dt: float, kernel: float, needs: Sequence[bool]) -> None:
        self._step, self._gap = MOVING * dt, max(GAP * kernel, 1.5 * dt)
        self._needs = [i for i, needed in enumerate(needs) if needed]
        self._positions = [i for i in (Q_M, Q_L) if needs[i]]
        self.reset()

    def reset(self) -> None:
        """Before the first sample."""
        self.still = self.failed = self.jumped = False
        self._any = False
        self._same, self._speed, self._share, self._time = 0, 0.0, 0.0, 0.0
        self._before = [0.0] * 6

    def add(self, time: float, readings: Sequence[float]) -> bool:
        """Take a sample with its time [s]; True where it counts."""
        before = self._before
        self.jumped = self._any and time - self._time > self._gap
        stopped = self._any and not time > self._time
        # loops, not generators: this runs at every sample
        equal = self._any
        for i in self._needs:
            if readings[i] != before[i]:
                equal = False
                break
        if self._any and not self.still:
            pace = 0.0
            for i in self._positions:
                moved = abs(readings[i] - before[i])
                if moved > pace:
                    pace = moved
            self._speed += (pace - self._speed) / PACE
            self._share += (float(equal) - self._share) / MEMORY
        self._same = self._same + 1 if equal or stopped else 0
        dead = self._same >= REPEATS and self._same * math.log(max(self._share, CHANCE)) < math.log(
            CHANCE
        )
        self.still = dead or stopped
        self.failed = self.still and (stopped or self._speed > self._step)
        self._any, self._time = True, time
        self._before = list(readings)
        return not (self.still or self.jumped)

    def figures(self) -> dict[str, float]:
        """Limits, for the native twin."""
        return {
            "REPEATS": REPEATS,
            "CHANCE": CHANCE,
            "MEMORY": float(MEMORY),
            "PACE": float(PACE),
            "STEP": self._step,
            "GAP": self._gap,
        }

    def numbers(self) -> list[float]:
        """Everything that changes."""
        flags = map(float, (self.still, self.failed, self.jumped, self._any, self._same))
        return [*flags, self._speed, self._share, self._time, *self._before]

    def load(self, numbers: Sequence[float]) -> None:
        """Take up what :meth:`numbers` gave."""
        self.still, self.failed, self.jumped, self._any = (bool(v) for v in numbers[:4])
        self._same, self._speed, self._share, self._time = (
            int(numbers[4]),
            float(numbers[5]),
            float(numbers[6]),
            float(numbers[7]),
        )
        self._before = [float(v) for v in numbers[8:14]]
