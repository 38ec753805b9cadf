"""Samples of any times on the even grid that kernels need: a reading between two grid points is
interpolated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, final

ON_GRID: Final = 0.05
"""Share of the sample time by which a sample may miss its grid point and still counts as on it; at
this the error of a position is a twentieth of its change in a sample."""
Sample = tuple[float, list[float], list[bool]]


@final
class Grid:
    """Straight lines between two samples; over a gap there is none, and a new grid begins behind
    it.

    Parameters
    ----------
    dt : float
        Sample time of the grid [s].
    gap : float
        Longest time between two samples that is bridged [s].
    """

    def __init__(self, dt: float, gap: float) -> None:
        self.dt, self.gap = dt, gap
        self.reset()

    def reset(self) -> None:
        """Before the first sample."""
        self._count, self._start, self._time = 0, 0.0, 0.0
        self._readings: list[float] = [0.0] * 6
        self._valid: list[bool] = [True] * 6

    def due(self, time: float, readings: list[float], valid: Sequence[bool]) -> list[Sample]:
        """Take a sample with its time [s]; the grid points up to it, with their readings."""
        slack, flags = ON_GRID * self.dt, list(valid)
        before, apart = self._time, time - self._time
        fresh = self._count == 0 or apart > self.gap or not apart > 0
        if fresh:
            self._start, self._count = time, 0
        point = self._start + self._count * self.dt
        if fresh or abs(time - point) <= slack:
            self._count += 1
            found = [(time, readings, flags)]
        else:
            found = []
            while point <= time + slack:
                share = (point - before) / apart
                line = [a + share * (b - a) for a, b in zip(self._readings, readings, strict=True)]
                found.append(
                    (point, line, [a and b for a, b in zip(self._valid, flags, strict=True)])
                )
                self._count += 1
                point = self._start + self._count * self.dt
        self._time, self._readings, self._valid = time, readings, flags
        return found

    def numbers(self) -> list[float]:
        """Everything that changes."""
        return [
            float(self._count),
            self._start,
            self._time,
            *self._readings,
            *map(float, self._valid),
        ]

    def load(self, numbers: Sequence[float]) -> None:
        """Take up what :meth:`numbers` gave."""
        self._count, self._start, self._time = int(numbers[0]), float(numbers[1]), float(numbers[2])
        self._readings, self._valid = (
            [float(v) for v in numbers[3:9]],
            [bool(v) for v in numbers[9:15]],
        )


__all__ = ["ON_GRID", "Grid"]
