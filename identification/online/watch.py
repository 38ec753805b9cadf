"""Checks of the readings that need no filter: noise, sensors that stand still, sensors of the
wrong scale.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, final

import numpy as np
import numpy.typing as npt

from identification.balance.clocks import MOST_SKEW
from identification.balance.noise import noise_level

if TYPE_CHECKING:
    from casadi_models import JointModel

FloatArray = npt.NDArray[np.float64]

READINGS: Final = ("i_m", "q_m", "w_m", "q_l", "w_l", "tau_l")
"""Readings in their order everywhere: drive, motor position and velocity, link position and
velocity, torque.
"""
DRIVE, Q_M, W_M, Q_L, W_L, TAU = range(6)
SAMPLED: Final = (Q_M, Q_L, TAU, DRIVE)
"""Readings behind :data:`identification.online.rows.SOURCES`."""
_MOVED: Final = 1e-3
_SCALE_MOTION: Final = 2e-2
SCALE: Final = 0.2
SOFTER: Final = 2.0
"""Factor by which a healthy gear may be softer than the file says before the rest of its twist
counts as play."""
FARTHEST: Final = 0.1
"""Twist up to which a transmission is looked at for its play [rad]: 6 degrees; m on a linear
axis."""
MEMORY: Final = 30
TINY: Final = 1e-300
"""What keeps a division from zero; nothing measured is as small."""


class Twist(NamedTuple):
    """How far the two positions of a healthy joint may lie apart: play and a share of the torque.

    Attributes
    ----------
    play : float
        [rad]
    compliance : float
        [rad/N.m]
    """

    play: float = 0.0
    compliance: float = 0.0

    @classmethod
    def of(cls, model: JointModel) -> Twist:
        """Of a joint at its values; none where the link is not apart.

        The play is what the twist is larger than by the stiffness: that of a gap, or of a spring
        that begins soft.
        """
        name = model.stiffness_name
        values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
        if not model.is_elastic or name is None or not values[name] > 0.0:
            return cls()
        from casadi_models.functions import JointFunctions

        own = JointFunctions(model)
        twist = np.linspace(0.0, FARTHEST, 201)
        x = np.zeros((len(own.state_names) + len(own.memory_names), len(twist)))
        x[0] = twist
        torque = np.array(own.outputs(x, np.zeros(own.outputs.size1_in(1)), list(values.values())))
        carried = torque[-1] - torque[-1, 0]
        compliance = SOFTER / values[name]
        return cls(max(float(np.max(twist - compliance * carried)), 0.0), compliance)


@final
class Watch:
    """The last second of readings, looked at once per second.

    Parameters
    ----------
    dt : float
        Sample time [s].
    present : tuple of bool
        Which of :data:`READINGS` the joint has.
    twist : Twist
        What the positions of a healthy joint differ by beside their clocks.

    Attributes
    ----------
    noise : (6,) array
        White noise of each reading, root mean square over up to half a minute.
    constant, scaled : list of bool
        Readings that do not move while the joint does; readings that contradict each other by a
        factor.
    """

    def __init__(self, dt: float, present: tuple[bool, ...], twist: Twist = Twist()) -> None:  # noqa: B008 - frozen
        self.dt, self.present, self.twist = dt, present, twist
        self.length = int(np.clip(round(1.0 / dt), 64, 1024))
        self.reset()

    def reset(self) -> None:
        """Before the first sample."""
        self.rows = np.zeros((self.length, 6))
        self.count = 0
        self._pending: list[list[float]] = []
        self.bad = np.zeros(6)
        self.noise = np.zeros(6)
        self.looks = np.zeros(6)
        self.constant, self.scaled = [False] * 6, [False] * 6

    def add(self, readings: list[float], valid: list[bool]) -> bool:
        """Take a sample; True where the second is full and has been looked at."""
        self._pending.append(readings)
        if False in valid:
            self.bad += np.logical_not(valid)
        self.count += 1
        if self.count < self.length:
            return False
        self._write()
        self._look()
        self.count = 0
        self.bad[:] = 0
        return True

    def _write(self) -> None:
        """Put the samples that wait into the table: at once, which costs less than one by one."""
        if self._pending:
            self.rows[self.count - len(self._pending) : self.count] = self._pending
            self._pending = []

    def _look(self) -> None:
        good = [self.present[i] and not self.bad[i] for i in range(6)]
        spread = np.ptp(self.rows, axis=0)
        moves = max((float(spread[i]) for i in (Q_M, Q_L) if good[i]), default=0.0) > _MOVED
        whole = (slice(0, self.length),)
        for i in range(6):
            if not good[i]:
                continue
            if spread[i] > 0 or moves:
                self.constant[i] = bool(spread[i] == 0)
            if spread[i] > 0:
                self.looks[i] = min(self.looks[i] + 1, MEMORY)
                level = noise_level(self.rows[:, i], whole)
                self.noise[i] = np.sqrt(
                    self.noise[i] ** 2 + (level**2 - self.noise[i] ** 2) / self.looks[i]
                )
        self._scales([good[i] and not self.constant[i] for i in range(6)], spread)

    def _scales(self, good: list[bool], spread: FloatArray) -> None:
        """Ratio of velocity reading to position reading, and of the two positions."""
        own: dict[int, float] = {}
        for position, velocity in ((Q_M, W_M), (Q_L, W_L)):
            if good[position] and good[velocity] and spread[position] > _SCALE_MOTION:
                change = np.diff(self.rows[:, position])
                travelled = 0.5 * self.dt * (self.rows[1:, velocity] + self.rows[:-1, velocity])
                own[position] = _slope(np.cumsum(travelled), np.cumsum(change))
                self.scaled[velocity] = abs(own[position] - 1.0) > SCALE
        if good[Q_M] and good[Q_L] and max(spread[Q_M], spread[Q_L]) > _SCALE_MOTION:
            apart = abs(_slope(self.rows[:, Q_L], self.rows[:, Q_M]) - 1.0) - SCALE
            wrong = apart * float(spread[Q_M]) > self._apart(good, spread)
            off_m, off_l = (abs(own.get(i, 1.0) - 1.0) > SCALE for i in (Q_M, Q_L))
            self.scaled[Q_L] = wrong and off_l and not off_m
            self.scaled[Q_M] = wrong and not self.scaled[Q_L]
            if wrong:
                self.scaled[W_M] = self.scaled[W_M] and not self.scaled[Q_M]
                self.scaled[W_L] = self.scaled[W_L] and not self.scaled[Q_L]

    def _apart(self, good: list[bool], spread: FloatArray) -> float:
        """Largest change of the twist of a healthy joint in the last second, as it is read: by its
        play, by the torque, and by a clock that is late.
        """
        torque = float(spread[TAU if good[TAU] else DRIVE])
        step = float(np.max(np.abs(np.diff(self.rows[:, Q_M]))))
        return 2.0 * self.twist.play + self.twist.compliance * torque + MOST_SKEW * step

    def numbers(self) -> FloatArray:
        """Everything that changes, as one array."""
        self._write()
        flags = np.array([*self.constant, *self.scaled], dtype=np.float64)
        return np.concatenate(
            [self.rows.ravel(), [self.count], self.bad, self.noise, self.looks, flags]
        )

    def load(self, numbers: FloatArray) -> None:
        """Take up what :meth:`numbers` gave."""
        self._pending = []
        size = self.rows.size
        self.rows[:] = numbers[:size].reshape(self.rows.shape)
        rest = numbers[size:]
        self.count = int(rest[0])
        self.bad, self.noise, self.looks = rest[1:7].copy(), rest[7:13].copy(), rest[13:19].copy()
        self.constant = [bool(v) for v in rest[19:25]]
        self.scaled = [bool(v) for v in rest[25:31]]


def _slope(x: FloatArray, y: FloatArray) -> float:
    """Least-squares slope of x against y about their means (how many times larger x moves)."""
    a, b = x - x.mean(), y - y.mean()
    return float(a @ b / max(float(b @ b), TINY))
