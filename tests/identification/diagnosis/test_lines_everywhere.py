"""A line has its size and phase in all of the stroke and in both directions; what lies at one end
or acts one way is none."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from identification.diagnosis.order_tracking import Samples, everywhere, peaks

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
