"""The last samples of an online estimator, as its rows need them, and which of them cannot be
trusted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
import numpy.typing as npt

from identification.online.rows import SOURCES
from identification.online.timing import Alignment, Timing
from identification.online.watch import SAMPLED, Watch

FloatArray = npt.NDArray[np.float64]


@final
class Samples:
    """Sampled signals in the order of :data:`identification.online.rows.SOURCES`.

    Parameters
    ----------
    timing : Timing
    needs : sequence of bool
        Readings that rows need.
    alignment : Alignment
        What late channels are in the window at their true time with.
    """

    def __init__(self, timing: Timing, needs: Sequence[bool], alignment: Alignment) -> None:
        self.timing, self._needs, self.zero = timing, needs, 0.0
        self.memory = timing.window + timing.stride + alignment.taps.shape[1] - 1
        """Samples until a reading has left the window and what lies before it."""
        self.alignment = alignment
        self.reset()

    def align(self, alignment: Alignment, zero: float = 0.0) -> None:
        """Begin the window anew with another alignment of as many taps, and `zero` taken off the
        link position [rad]; which readings count stays.
        """
        self.alignment, self.zero = alignment, zero
        self.lag = alignment.lead * self.timing.dt
        """Time by which the window's last sample is older than the newest reading [s]."""
        self._buffer = np.zeros((4 * self.timing.window, len(SOURCES)))
        self._recent = np.zeros((alignment.taps.shape[1], len(SOURCES)))
        self._end, self._started = 0, False

    def reset(self) -> None:
        """Before the first sample."""
        self._doubt, self._lost = False, [0] * len(SOURCES)
        self.align(self.alignment, self.zero)

    @property
    def window(self) -> FloatArray:
        """The samples of one row, oldest first."""
        return self._buffer[self._end - self.timing.window : self._end]

    @property
    def lost(self) -> npt.NDArray[np.bool_]:
        """Sources of which the window holds a sample that is missing or of a failed sensor."""
        return np.array([count > 0 for count in self._lost])

    def add(self, new: tuple[float, float, float, float]) -> None:
        """Append a sample; the first one fills the window."""
        length = self.timing.window
        if self.zero:
            new = (new[0], new[1] - self.zero, new[2], new[3])
        if self.alignment.shifts:
            new = self._aligned(new)
        if self._end == len(self._buffer):
            self._buffer[:length] = self._buffer[-length:].copy()
            self._end = length
        if not self._started:
            self._started = True
            self._buffer[:length] = new
            self._end = length
        self._buffer[self._end] = new
        self._end += 1

    def _aligned(self, new: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        """Signals at their true time, from the newest readings."""
        recent = self._recent
        if not self._started:
            recent[:] = new
        recent[:-1] = recent[1:].copy()
        recent[-1] = new
        a, b, c, d = np.einsum("kj,jk->k", self.alignment.taps, recent).tolist()
        return a, b, c, d

    def mark(
        self, good: Sequence[bool], failed: Sequence[bool], watch: Watch, *, whole: bool
    ) -> None:
        """Note which readings of the newest sample count; `whole` where all of a joint's
        readings are there.
        """
        if (
            whole
            and not self._doubt
            and True not in failed
            and True not in watch.constant
            and True not in watch.scaled
        ):
            return
        lost = self._lost
        for k, reading in enumerate(SAMPLED):
            bad = not good[reading] and self._needs[reading]
            if bad or failed[reading] or watch.constant[reading] or watch.scaled[reading]:
                lost[k] = self.memory
            elif lost[k]:
                lost[k] -= 1
        self._doubt = any(lost)

    def state(self) -> tuple[list[int], FloatArray]:
        """Everything that changes."""
        table = np.vstack([self._buffer, self._recent])
        return [self._end, int(self._started), *self._lost], table

    def restore(self, plain: Sequence[int], buffer: FloatArray) -> None:
        """Take up what :meth:`state` gave."""
        self._end, self._started, self._lost = (
            int(plain[0]),
            bool(plain[1]),
            [int(v) for v in plain[2:]],
        )
        self._doubt = any(self._lost)
        self._buffer[:], self._recent[:] = np.split(buffer, [len(self._buffer)])
