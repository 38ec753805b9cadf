"""From the exact motion to a log: zeros, clocks, encoders, filters, noise, jitter, lost samples."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Final, final

import numpy as np

from tests.recorded_world._engine import COLUMNS, ROWS_PER_SECOND, FloatArray
from tests.recorded_world.joints import SPAN_OF_SCALE

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.random import Generator

    from tests.recorded_world.joints import Plain

CHANNELS: Final = (
    *("motor_current", "motor_position", "motor_velocity"),
    *("link_position", "link_velocity", "link_torque"),
)
SETS: Final[Mapping[str, tuple[str, ...]]] = {
    "all": CHANNELS,
    "encoders": CHANNELS[:5],
    "motor": CHANNELS[:3],
    "motor_torque": (*CHANNELS[:3], "link_torque"),
}
RATES: Final = (100.0, 125.0, 200.0, 250.0, 500.0, 1000.0)
NOISES: Final = ("white", "ar", "hum", "heavy", "drift")
LOST: Final = (0.0, 0.0, 0.0, 0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
ZERO: Final = 5e-3
"""Largest zero of an encoder [rad of the link]."""
SKEW: Final = 3.0
"""Largest skew between two sources [samples]."""


@final
@dataclass(frozen=True)
class Sensors:
    """How a joint is recorded.

    Attributes
    ----------
    rate
        Samples a second.
    zero
        Zero of the link encoder against the motor's [rad of the link, or m].
    link_skew, torque_skew
        Lateness of the link encoder and of the torque sensor against the drive [samples].
    motor_bits, link_bits
        Steps per turn of each encoder, as powers of two.
    current_bits
        Steps of the current over its range.
    filter
        Pole of the current's low-pass at the sampling rate (0: none).
    jitter
        Standard deviation of the sampling instants [samples].
    lost
        Share of rows that never arrive.
    noise
        Kind of the noise of current and torque: one of `NOISES`.
    level
        Its deviation as a share of the friction torque.
    velocities
        Whether the drive logs velocities.
    """

    rate: float
    zero: float
    link_skew: float
    torque_skew: float
    motor_bits: int
    link_bits: int
    current_bits: int
    filter: float
    jitter: float
    lost: float
    noise: str
    level: float
    velocities: bool


IDEAL: Final[Mapping[str, Mapping[str, float | int | str]]] = {
    "zero": {"zero": 0.0},
    "skew": {"link_skew": 0.0, "torque_skew": 0.0},
    "coarse": {"motor_bits": 19, "link_bits": 19, "current_bits": 16},
    "filter": {"filter": 0.0},
    "jitter": {"jitter": 0.0},
    "lost": {"lost": 0.0},
    "noise": {"noise": "white", "level": 0.002},
    "slow": {"rate": 500.0},
}
"""What switching off one trouble of the sensors sets."""


def draw(rng: Generator, joint: Plain) -> Sensors:
    """Draw the sensors of a joint."""
    per_rad = SPAN_OF_SCALE / (2.0 * np.pi) if joint.make.linear else 1.0
    skewed = rng.random(2) < 0.6
    skew = rng.uniform(0.0, SKEW, 2) * skewed
    return Sensors(
        rate=float(rng.choice(RATES)),
        zero=float(rng.uniform(-ZERO, ZERO)) * per_rad,
        link_skew=float(skew[0]),
        torque_skew=float(skew[1]),
        motor_bits=int(rng.integers(12, 20)),
        link_bits=int(rng.integers(14, 20)) if rng.random() < 0.8 else int(rng.integers(12, 14)),
        current_bits=int(rng.integers(11, 17)),
        filter=float(rng.choice([0.0, 0.0, 0.5, 0.7])),
        jitter=float(rng.choice([0.0, 0.0, 0.02, 0.1])),
        lost=float(rng.choice(LOST)),
        noise=str(rng.choice(NOISES)),
        level=float(np.exp(rng.uniform(np.log(0.002), np.log(0.015)))),
        velocities=bool(rng.random() < 0.5),
    )


def coloured(rng: Generator, kind: str, rows: int, rate: float) -> FloatArray:
    """Noise of unit deviation, shape (rows,).

    ``white``; ``ar`` with a corner at 8 Hz (pole 0.9 at 500 Hz); ``hum``: half of the power in 50
    Hz and in a slip of 9 to 14 Hz; ``heavy``: Student's t of three degrees; ``drift``: white with a
    walk of the same deviation.
    """
    white = rng.standard_normal(rows)
    if kind == "ar":
        from scipy.signal import lfilter

        pole = 0.9 ** (500.0 / rate)
        warm = rng.standard_normal(rows + 1000)
        return np.asarray(lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], warm)[1000:])
    if kind == "hum":
        t, phase = np.arange(rows) / rate, rng.uniform(0.0, 2.0 * np.pi, 2)
        slow = 2.0 * np.pi * rng.uniform(9.0, 14.0)
        lines = np.sin(2.0 * np.pi * 50.0 * t + phase[0]) + np.sin(slow * t + phase[1])
        return np.asarray(np.sqrt(0.5) * (white + lines))
    if kind == "heavy":
        return np.asarray(rng.standard_t(3.0, rows) / np.sqrt(3.0))
    if kind == "drift":
        walk = np.cumsum(rng.standard_normal(rows))
        walk -= walk.mean()
        return np.asarray(np.sqrt(0.5) * (white + walk / walk.std()))
    return white


def _between(
    exact: FloatArray, name: str, at: FloatArray, rate_of: str | None = None
) -> FloatArray:
    """A column at times between the rows; with its rate also recorded, as cubic pieces."""
    y = exact[:, COLUMNS.index(name)]
    s = np.clip(at * ROWS_PER_SECOND, 0.0, len(y) - 1.000001)
    i = s.astype(np.int64)
    f = s - i
    if rate_of is None:
        return np.asarray(y[i] + f * (y[i + 1] - y[i]))
    m = exact[:, COLUMNS.index(rate_of)] / ROWS_PER_SECOND
    a, b = y[i], y[i + 1]
    left, right = m[i] - (b - a), (b - a) - m[i + 1]
    return np.asarray(a + f * (b - a) + f * (1.0 - f) * ((1.0 - f) * left + f * right))


def observe(
    rng: Generator,
    exact: FloatArray,
    joint: Plain,
    sensors: Sensors,
    faults: Mapping[str, float],
) -> tuple[FloatArray, FloatArray]:
    """Record a motion.

    Parameters
    ----------
    exact
        Fine rows of `COLUMNS`.
    faults
        Gains, offsets and delays that are hidden in the sensors (`Law.sensor`).

    Returns
    -------
    Time [s], shape (rows,), and `CHANNELS` in SI units, shape (rows, 6).
    """
    rate, make = sensors.rate, joint.make
    late_most = (SKEW + 1.0) / rate
    t = np.arange(late_most, (len(exact) - 2) / ROWS_PER_SECOND - late_most, 1.0 / rate)
    # a late sample never overtakes the one before
    t = t + np.clip(sensors.jitter * rng.standard_normal(len(t)), -0.4, 0.4) / rate
    rows = len(t)
    reference = 1.0 if make.linear else joint.sign * make.ratio
    constant = make.per_current * (1.0 if make.linear else joint.sign)
    drive = _filtered(
        exact[:, 0], sensors.filter ** (rate / ROWS_PER_SECOND) if sensors.filter else 0.0
    )
    drive_at = np.column_stack([drive, *exact.T[1:]])
    now = t - faults.get("delay_motor_current", 0.0)
    current = _between(drive_at, "drive", now) + sensors.level * joint.friction * coloured(
        rng, sensors.noise, rows, rate
    )
    span = 2.5 * max(float(np.abs(exact[:, 0]).max()), joint.friction)
    step = 2.0 * span / 2**sensors.current_bits
    current = np.round(current / step) * step / constant + faults.get("current_offset", 0.0)
    turn = SPAN_OF_SCALE if make.linear else 2.0 * np.pi
    motor_step = turn / 2**sensors.motor_bits / (make.ratio if not make.linear else 1.0)
    link_step = turn / 2**sensors.link_bits
    late = t - sensors.link_skew / rate
    q = (
        np.round(_between(exact, "q", t, "v") / motor_step + 0.2 * rng.standard_normal(rows))
        * motor_step
    )
    link = _between(exact, "theta", late, "omega") + sensors.zero
    theta = np.round(link / link_step + 0.2 * rng.standard_normal(rows)) * link_step
    torque = _between(exact, "torque", t - sensors.torque_skew / rate)
    torque = faults.get("torque_gain", 1.0) * torque + faults.get("torque_offset", 0.0)
    torque = torque + sensors.level * joint.friction * coloured(rng, sensors.noise, rows, rate)
    still = 0.003 * make.speed * rng.standard_normal((rows, 2))
    v = _between(exact, "v", t) + still[:, 0]
    w = _between(exact, "omega", late) + still[:, 1]
    table = np.column_stack([current, reference * q, reference * v, theta, w, torque])
    keep = rng.random(rows) >= sensors.lost
    keep[[0, -1]] = True
    return (t - t[0])[keep], table[keep]


def _filtered(x: FloatArray, pole: float) -> FloatArray:
    if pole == 0.0:
        return x
    from scipy.signal import lfilter, lfiltic

    start = lfiltic([1.0 - pole], [1.0, -pole], [x[0]])
    return np.asarray(lfilter([1.0 - pole], [1.0, -pole], x, zi=start)[0])


def described(sensors: Sensors) -> dict[str, float | int | str | bool]:
    """As a table for the truth file."""
    return {f.name: getattr(sensors, f.name) for f in fields(sensors)}
