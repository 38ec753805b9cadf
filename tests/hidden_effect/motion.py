"""Reference motions of the test generator: triangles of changing speed and random multisines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]


def triangle(
    rng: np.random.Generator, rows: int, dt: float, slowest: float, fastest: float
) -> tuple[FloatArray, FloatArray]:
    """Triangle between two angles near +-70 deg, starting upright; speeds in deg/s, changed every
    second leg.

    Returns position [rad] and velocity [rad/s], each of shape (rows,).
    """
    amplitude = np.radians(rng.uniform(66.0, 72.0))
    span = rows * dt
    speeds = np.radians(np.exp(rng.uniform(np.log(slowest), np.log(fastest), 40)))
    speeds[0] = max(speeds[0], 3.0 * amplitude / span)  # at least one reversal in every record
    time, position = [0.0], [0.0]
    leg = 0
    while time[-1] < span:
        end = amplitude if leg % 2 == 0 else -amplitude
        time.append(time[-1] + abs(end - position[-1]) / speeds[leg // 2])
        position.append(end)
        leg += 1
    corner, angle = np.array(time), np.array(position)
    t = np.arange(rows) * dt
    slope = np.diff(angle) / np.diff(corner)
    which = np.clip(np.searchsorted(corner, t, side="right") - 1, 0, len(slope) - 1)
    position_at, velocity_at = np.interp(t, corner, angle), slope[which]
    return _rounded(position_at, velocity_at, round(rng.uniform(0.12, 0.2) / dt), dt)


def _rounded(
    position: FloatArray, velocity: FloatArray, half: int, dt: float
) -> tuple[FloatArray, FloatArray]:
    """Round the corners with a raised-cosine window of ``half`` samples each side (the ends go
    on straight).
    """
    window = np.hanning(2 * half + 3)[1:-1]
    window /= window.sum()
    ramp = np.arange(1, half + 1) * dt
    before, after = position[0] - velocity[0] * ramp[::-1], position[-1] + velocity[-1] * ramp
    long_p = np.concatenate([before, position, after])
    long_v = np.concatenate([np.full(half, velocity[0]), velocity, np.full(half, velocity[-1])])
    return np.convolve(long_p, window, "valid"), np.convolve(long_v, window, "valid")


def multisine(rng: np.random.Generator, rows: int, dt: float) -> tuple[FloatArray, FloatArray]:
    """Twelve sines of 0.04 to 2.2 Hz, amplitude falling with frequency, peak 40 to 55 deg,
    speed at most 60 deg/s.
    """
    t = np.arange(rows) * dt
    frequency = np.exp(np.linspace(np.log(0.04), np.log(2.2), 12) + rng.uniform(-0.12, 0.12, 12))
    weight = rng.uniform(0.6, 1.4, 12) / frequency**0.9
    phase = rng.uniform(0.0, 2.0 * np.pi, 12)
    angle = 2.0 * np.pi * frequency[:, None] * t + phase[:, None]
    position = (weight[:, None] * np.cos(angle)).sum(axis=0)
    velocity = -((2.0 * np.pi * frequency * weight)[:, None] * np.sin(angle)).sum(axis=0)
    middle = 0.5 * (position.max() + position.min())
    scale = np.radians(rng.uniform(40.0, 55.0)) / (0.5 * np.ptp(position))
    scale = min(scale, np.radians(60.0) / float(np.abs(velocity).max()))
    return scale * (position - middle), scale * velocity


def with_rests(
    rng: np.random.Generator, reference: tuple[FloatArray, FloatArray], dt: float, share: float
) -> tuple[FloatArray, FloatArray]:
    """The same path with stops: slowed down to a standstill in 0.15 s, held for 0.6 to 3 s, started
    again.

    Stops fill about `share` of the time, the last one ends the record; the path is cut where the
    time is up.
    """
    position, velocity = reference
    rows = len(position)
    pace = np.ones(rows)
    ramp = round(0.15 / dt)
    down = 0.5 + 0.5 * np.cos(np.linspace(0.0, np.pi, ramp))
    held = round(rows * share)
    stops = []
    while held > 0:
        length = min(round(rng.uniform(0.6, 3.0) / dt), held)
        stops.append(length)
        held -= length
    moving = rows - sum(stops) - 2 * ramp * len(stops)
    legs = np.diff(
        np.concatenate([[0], np.sort(rng.integers(0, moving, len(stops) - 1)), [moving]])
    )
    at = 0
    for leg, length in zip(legs.tolist(), stops, strict=True):
        at += int(leg)
        stop = np.concatenate([down, np.zeros(length), down[::-1]])
        pace[at : at + len(stop)] = stop[: rows - at]
        at += len(stop)
    place = np.concatenate([[0.0], np.cumsum(0.5 * (pace[1:] + pace[:-1]))])
    index = np.arange(rows)
    return np.interp(place, index, position), pace * np.interp(place, index, velocity)


def plan(
    rng: np.random.Generator, rows: int, dt: float
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """The four references of a case: training triangle and multisine, test multisine and
    triangle at other speeds.
    """
    return {
        "train": triangle(rng, rows, dt, 11.0, 44.0),
        "train2": multisine(rng, rows, dt),
        "test": multisine(rng, rows, dt),
        "test2": triangle(rng, rows, dt, 8.5, 36.0),
    }
