"""A line has its size and phase in all of the stroke and in both directions; what lies at one end
or acts one way is none."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from identification.diagnosis.order_tracking import (
    Peak,
    Samples,
    apart_from_slow,
    everywhere,
    peaks,
)

FloatArray = npt.NDArray[np.float64]
TIME = np.arange(0, 40, 4e-3)
ANGLE = 60.0 * np.sin(2 * np.pi * 0.11 * TIME)
VELOCITY = np.gradient(ANGLE, TIME)


def samples(residual: FloatArray) -> Samples:
    return Samples(
        ANGLE, residual, np.abs(VELOCITY) / np.mean(np.abs(VELOCITY)), TIME.astype(np.int64)
    )


@pytest.mark.parametrize("size", [0.1, 0.3, 3.0])
def test_a_line_in_noise_is_everywhere(size: float) -> None:
    kept = found = 0
    for seed in range(30):
        rng = np.random.default_rng([seed, 1])
        wave = size * np.sin(2.0 * ANGLE + rng.uniform(0, 6.3))
        one = samples(wave + rng.normal(0, 1, len(TIME)))
        lines = peaks(one, 8.0)
        for peak in lines:
            if abs(peak.order - 2.0) < 0.05:
                found += 1
                kept += everywhere(peak, [p for p in lines if p is not peak], one)
    assert found > 15
    assert kept >= 0.98 * found


@pytest.mark.parametrize(
    "part",
    [ANGLE > 30, np.abs(ANGLE) < 20, VELOCITY > 0],
    ids=["at one end", "in the middle", "in one direction"],
)
def test_what_is_in_a_part_of_the_motion_is_no_line(part: npt.NDArray[np.bool_]) -> None:
    rng = np.random.default_rng(5)
    one = samples(np.where(part, 3 * np.sin(2.0 * ANGLE), 0.0) + rng.normal(0, 1, len(TIME)))
    lines = peaks(one, 8.0)
    assert lines, "the scan alone takes it for a line"
    assert not everywhere(lines[0], lines[1:], one)


STEP = 8e-3


def back_and_forth(speeds: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Time and motor angle [rad] of a motion that runs 8 s at each of these speeds [turn/s]."""
    count = round(8 / STEP)
    rate = 2 * np.pi * np.repeat(speeds, count)
    return STEP * np.arange(len(rate)), np.cumsum(rate) * STEP


@pytest.mark.parametrize("seed", range(4))
def test_what_drifts_at_a_speed_that_the_sampling_stops_is_no_line(seed: int) -> None:
    """At 12.5 turns a second and 125 samples a second order 10 makes a period a sample."""
    time, angle = back_and_forth((12.5, -6.1, 12.5, -4.3))
    rng = np.random.default_rng(seed)
    weight = np.abs(np.gradient(angle))
    weight /= weight.mean()
    slow = np.where(weight > 1.2, np.sin(2 * np.pi * 0.3 * time + rng.uniform(0, 6.3)) + 1.5, 0.0)
    noise = rng.normal(0, 0.3, len(time))
    for real in (False, True):
        left = noise + (np.sin(10.0 * angle + 1.0) if real else slow)
        one = Samples(angle, left, weight, time.astype(np.int64))
        sine, cosine = np.linalg.lstsq(
            np.column_stack([np.sin(10.0 * angle), np.cos(10.0 * angle)]) * weight[:, None] ** 0.5,
            left * weight**0.5,
        )[0]
        line = Peak(10.0, 0.001, float(sine), float(cosine), 50.0, 0.02, 0.01)
        assert line.amplitude > 0.3
        assert apart_from_slow(line, one, STEP, named=False) == real
        assert apart_from_slow(line, one, STEP, named=True) == real


def test_a_known_order_that_stands_still_all_the_time_is_not_contradicted() -> None:
    time, angle = back_and_forth((12.5, -12.5))
    left = np.sin(10.0 * angle + 1.0) + np.random.default_rng(1).normal(0, 0.3, len(time))
    one = Samples(angle, left, np.ones(len(time)), time.astype(np.int64))
    peak = Peak(10.0, 0.001, 0.54, 0.84, 50.0, 0.02, 0.01)
    assert apart_from_slow(peak, one, STEP, named=True)
    assert not apart_from_slow(peak, one, STEP, named=False)
