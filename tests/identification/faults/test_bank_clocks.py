"""Readings brought to one time, at uneven stamps."""

from __future__ import annotations

import numpy as np
import pytest

from identification.faults.bank_clocks import aligned, inside

RNG = np.random.default_rng(3)
TIME = np.cumsum(RNG.uniform(0.5e-3, 1.5e-3, 400))
LATE = (0.0, 0.0023, -0.0017)


def signal(t: np.ndarray) -> np.ndarray:
    return 2.0 - 3.0 * t + 40.0 * t**2 - 70.0 * t**3


def test_a_cubic_comes_back_exactly_at_uneven_stamps() -> None:
    rows = np.column_stack([signal(TIME - late) for late in LATE])
    part = inside(TIME, LATE)
    assert part.start > 0
    assert part.stop < len(TIME)
    found = aligned(TIME, rows, LATE)
    for i in range(3):
        np.testing.assert_allclose(found[part, i], signal(TIME[part]), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found[:, 0], rows[:, 0])


def test_what_is_on_time_is_not_touched() -> None:
    rows = RNG.normal(size=(400, 3))
    np.testing.assert_array_equal(aligned(TIME, rows, (0.0,) * 3), rows)
    assert inside(TIME, (0.0,) * 3) == slice(0, 400)


@pytest.mark.parametrize("late", [0.0023, -0.0023])
def test_inside_is_where_there_are_readings_on_both_sides(late: float) -> None:
    part = inside(TIME, (0.0, late))
    wanted = TIME[part] + late
    assert wanted.min() >= TIME[0]
    assert wanted.max() <= TIME[-1]
    before, after = part.start - 1, part.stop
    if late > 0:
        assert TIME[after] + late > TIME[-1]
    else:
        assert TIME[before] + late < TIME[0]


def test_a_missing_reading_stays_missing_and_spoils_its_neighbours_only() -> None:
    rows = np.ones((400, 2))
    rows[200, 1] = np.nan
    found = aligned(TIME, rows, (0.0, 0.0023))
    gone = np.flatnonzero(np.isnan(found[:, 1]))
    assert 1 <= len(gone) <= 6
    assert np.abs(TIME[gone] + 0.0023 - TIME[200]).max() < 4e-3
    assert np.isfinite(found[:, 0]).all()


def test_repeated_stamps_give_numbers() -> None:
    time = TIME.copy()
    time[100] = time[99]
    rows = np.column_stack([signal(time), signal(time)])
    assert np.isfinite(aligned(time, rows, (0.0, 0.001))).all()


def test_a_handful_of_samples_is_left_alone() -> None:
    rows = np.arange(6.0).reshape(3, 2)
    np.testing.assert_array_equal(aligned(TIME[:3], rows, (0.001, 0.0)), rows)
    assert inside(TIME[:3], (0.001, 0.0)) == slice(0, 3)
