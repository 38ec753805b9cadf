"""Reference motions of section 3.8: triangular, and sinusoidal with a constant-velocity part
and a rendezvous start.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.data.check.channels import LARGEST
from identification.data.check.stamps import MINIMUM_SAMPLES
from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]

WORKSPACE: Final = math.radians(80.0)
"""Half of the IRJ's workspace [rad]."""
COLUMNS: Final = (
    "time_s",
    "reference_position_rad",
    "reference_velocity_rad/s",
    "reference_acceleration_rad/s2",
)
UNEVEN: Final = 0.01
"""Share of a step that a time may be off: the nine digits of a file that was written here, and the
fewer ones of others. A motion at 100 rad/s followed in steps of 1 ms is then off by 1e-3 rad.
"""
_RENDEZVOUS_CONSTANTS: Final = 5.0


@final
@dataclass(frozen=True)
class Motion:
    """A reference to follow.

    Attributes
    ----------
    time, position, velocity, acceleration : (n,) array
        Link-referred [s, rad, rad/s, rad/s2].
    family : str
    parameters : mapping
        What the family was given, SI units.
    """

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    family: str
    parameters: Mapping[str, float]

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return float(self.time[1] - self.time[0])

    @property
    def table(self) -> FloatArray:
        """Position, velocity, acceleration, (n, 3)."""
        return np.column_stack([self.position, self.velocity, self.acceleration])

    @property
    def text(self) -> str:
        """The motion as a CSV file with the header of :data:`COLUMNS`."""
        rows = np.column_stack([self.time, self.table])
        lines = (",".join(f"{v:.9g}" for v in row) for row in rows.tolist())
        return "\n".join([",".join(COLUMNS), *lines]) + "\n"

    def save(self, path: str | Path) -> None:
        """Write a CSV file with the header of :data:`COLUMNS`."""
        Path(path).write_text(self.text, encoding="utf-8")

    @staticmethod
    def load(path: str | Path) -> Motion:
        """Read a file that :meth:`save` wrote.

        Raises
        ------
        InputError
            No such file, or no such table; fewer rows than a record must have; a cell that holds no
            number, or one that no joint follows; time that does not run on in even steps.
        """
        try:
            with Path(path).open(encoding="utf-8") as file:
                header = tuple(file.readline().strip().split(","))
            if header == COLUMNS:
                with warnings.catch_warnings(action="ignore"):  # no rows: refused below
                    rows = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
        except OSError as error:
            raise InputError(
                f"{path}: cannot be read ({error.strerror}); give a trajectory file, as `irj plan` "
                "writes it"
            ) from None
        except UnicodeDecodeError:
            raise InputError(
                f"{path}: is not a text file; give a trajectory file, as `irj plan` writes it"
            ) from None
        except ValueError as error:
            raise InputError(
                f"{path}: {str(error).rstrip('.')}; give a number in each of the "
                f"{len(COLUMNS)} columns"
            ) from None
        if header != COLUMNS:
            raise InputError(
                f"{path}: the header is {','.join(header)}; a trajectory file has "
                f"{','.join(COLUMNS)}"
            )
        if len(rows) < MINIMUM_SAMPLES:
            raise InputError(
                f"{path}: has {len(rows)} rows, at least {MINIMUM_SAMPLES} are needed; plan a "
                "longer motion"
            )
        if rows.shape[1] != len(COLUMNS):
            raise InputError(
                f"{path}: {rows.shape[1]} columns below a header of {len(COLUMNS)}; give a number "
                "in each"
            )
        wrong = ~np.isfinite(rows) | (np.abs(rows) > LARGEST)
        if wrong.any():
            row, column = (int(k) for k in np.argwhere(wrong)[0])
            raise InputError(
                f"{path}: {COLUMNS[column]} is {rows[row, column]:g} in row {row + 1}; no joint "
                "follows that, plan the motion again"
            )
        steps = np.diff(rows[:, 0])
        off = np.flatnonzero(np.abs(steps - steps[0]) > UNEVEN * abs(steps[0]))
        if steps[0] <= 0 or len(off):
            row = int(off[0]) + 2 if len(off) else 2
            raise InputError(
                f"{path}: time does not run on in even steps, first at row {row}; give it in "
                "steps of one length"
            )
        return Motion(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], "file", MappingProxyType({}))


def triangular(
    speed: float,
    *,
    limit: float = WORKSPACE,
    duration: float = 10.0,
    dt: float = 1e-3,
    start: float = 0.0,
    reversal: float = 0.0,
) -> Motion:
    """Constant speed between the bounds of the workspace (3.8.2).

    Parameters
    ----------
    speed : float
        Magnitude of the velocity [rad/s], the only parameter of the family.
    limit : float
        The motion turns at +-limit [rad].
    duration, dt : float
        [s]
    start : float
        First position [rad].
    reversal : float
        Time in which the velocity changes its sign [s]. 0 is the thesis's impulsive acceleration,
        which no drive can follow.
    """
    _positive("triangular", speed=speed, limit=limit, duration=duration, dt=dt)
    if abs(start) >= limit or reversal < 0 or speed * reversal / 4 >= limit:
        raise InputError(
            "triangular: the start must lie inside the limits and the reversal be short against "
            "the travel"
        )
    t = _times(duration, dt)
    travel = 2 * limit - speed * reversal / 4 * 2  # constant-speed way between two reversals
    half = travel / speed + reversal  # s from one turning point to the next
    edge = limit - speed * reversal / 4
    phase = (t + (start + edge) / speed + reversal / 2) % (2 * half)
    down = phase >= half
    s = np.where(down, phase - half, phase)
    velocity, position, acceleration = _half_cycle(s, half, speed, reversal, limit)
    sign = np.where(down, -1.0, 1.0)
    return Motion(
        t,
        sign * position,
        sign * velocity,
        sign * acceleration,
        "triangular",
        MappingProxyType({"speed": speed, "limit": limit, "reversal": reversal, "start": start}),
    )


def _half_cycle(
    s: FloatArray, half: float, speed: float, reversal: float, limit: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """From -limit to limit: constant acceleration for reversal/2, constant speed, constant
    deceleration.
    """
    if reversal == 0:
        return np.full_like(s, speed), -limit + speed * s, np.zeros_like(s)
    ramp = reversal / 2
    rate = speed / ramp
    rising, falling = s < ramp, s > half - ramp
    left = half - s
    velocity = np.where(rising, rate * s, np.where(falling, rate * left, speed))
    cruise = -limit + speed * ramp / 2 + speed * (s - ramp)
    position = np.where(
        rising, -limit + rate * s**2 / 2, np.where(falling, limit - rate * left**2 / 2, cruise)
    )
    acceleration = np.where(rising, rate, np.where(falling, -rate, 0.0))
    return velocity, position, acceleration


def sinusoidal(
    speed: float,
    period: float,
    *,
    hold: float = 0.0,
    start: float = 0.0,
    centre: float = 0.0,
    duration: float = 15.0,
    dt: float = 1e-3,
) -> Motion:
    """Sine with parts of constant velocity; it starts where the velocity is zero (3.8.3).

    The velocity is speed * cos over half a period from one sign to the other, held at +-speed for
    `hold` in between. A rendezvous first drives the link from `start` to the turning point, its
    velocity falling exponentially to zero.

    Parameters
    ----------
    speed : float
        Largest velocity [rad/s].
    period : float
        Of the sinusoidal parts together [s].
    hold : float
        Length of each part of constant velocity [s].
    start, centre : float
        First position; middle of the periodic motion [rad].
    duration, dt : float
        Of the whole, rendezvous included [s].
    """
    _positive("sinusoidal", speed=speed, period=period, duration=duration, dt=dt)
    if hold < 0:
        raise InputError("sinusoidal: hold must not be negative")
    w = 2 * math.pi / period
    amplitude = speed / w + speed * hold / 2
    target = centre - amplitude
    t = _times(duration, dt)
    gap = target - start
    lead = _rendezvous_time(gap, speed)
    n = int(np.searchsorted(t, lead)) if lead else 0
    position, velocity, acceleration = (np.zeros_like(t) for _ in range(3))
    if n:
        position[:n], velocity[:n], acceleration[:n] = _rendezvous(t[:n], start, gap, speed, lead)
    s = t[n:] - lead
    position[n:], velocity[n:], acceleration[n:] = _cycle(s, speed, w, hold, amplitude, centre)
    parameters = {
        "speed": speed,
        "period": period,
        "hold": hold,
        "start": start,
        "centre": centre,
        "amplitude": amplitude,
        "rendezvous": lead,
    }
    return Motion(t, position, velocity, acceleration, "sinusoidal", MappingProxyType(parameters))


def _cycle(
    s: FloatArray, speed: float, w: float, hold: float, amplitude: float, centre: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Periodic part from its lower turning point: quarter sine, hold, half sine, hold, quarter
    sine.
    """
    quarter = math.pi / (2 * w)
    half = 2 * quarter + hold
    phase = s % (2 * half)
    down = phase >= half
    u = np.where(down, phase - half, phase)
    first, last = u < quarter, u > quarter + hold
    left = half - u
    velocity = np.where(
        first, speed * np.sin(w * u), np.where(last, speed * np.sin(w * left), speed)
    )
    way = np.where(
        first,
        speed / w * (1 - np.cos(w * u)),
        np.where(
            last,
            2 * amplitude - speed / w * (1 - np.cos(w * left)),
            speed / w + speed * (u - quarter),
        ),
    )
    acceleration = np.where(
        first, speed * w * np.cos(w * u), np.where(last, -speed * w * np.cos(w * left), 0.0)
    )
    sign = np.where(down, -1.0, 1.0)
    return centre + sign * (way - amplitude), sign * velocity, sign * acceleration


def _rendezvous_time(gap: float, speed: float) -> float:
    """Length of the rendezvous [s]: the first velocity is `speed`."""
    c = _RENDEZVOUS_CONSTANTS
    share = (1 - math.exp(-c) - c * math.exp(-c)) / (1 - math.exp(-c))
    return c * abs(gap) / (speed * share)


def _rendezvous(
    t: FloatArray, start: float, gap: float, speed: float, lead: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    c = _RENDEZVOUS_CONSTANTS
    tau = lead / c
    top = math.copysign(speed / (1 - math.exp(-c)), gap)
    fall = np.exp(-t / tau)
    position = start + top * (tau * (1 - fall) - math.exp(-c) * t)
    return position, top * (fall - math.exp(-c)), -top / tau * fall


def _times(duration: float, dt: float) -> FloatArray:
    return np.arange(max(2, round(duration / dt)), dtype=np.float64) * dt


def _positive(asked: str, **values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{asked}: {name} must be positive and finite, not {value!r}")
