"""Preparation: filters without phase, derivatives, decimation, the thesis's calibration."""

from __future__ import annotations

import numpy as np
import pytest

from identification.data.prepare import (
    butterworth,
    calibrate_accelerometer,
    central_difference,
    decimate,
    decimated,
    detrend,
    drop_ends,
    filter_alike,
    filtered,
    second_difference,
    shift_channel,
    trimmed,
    with_derivatives,
)
from identification.data.record import Record
from identification.errors import InputError

DT = 1e-3
T = DT * np.arange(8000)
MIDDLE = slice(1000, -1000)


def record(**more: np.ndarray) -> Record:
    return Record.from_channels(T, {"motor_position": np.sin(2 * np.pi * T), **more})


@pytest.mark.parametrize("frequency", [2.0, 15.0, 25.0])
def test_filter_has_no_phase_and_the_square_of_the_butterworth_magnitude(frequency: float) -> None:
    wave = np.sin(2 * np.pi * frequency * T + 0.3)
    warped = np.tan(np.pi * frequency * DT) / np.tan(np.pi * 15.0 * DT)
    gain = 1.0 / (1.0 + warped**16)  # |H|^2 of order 8 after the bilinear transform
    np.testing.assert_allclose(butterworth(wave, DT)[MIDDLE], gain * wave[MIDDLE], atol=2e-6)


def test_equations_survive_a_filter_on_both_sides() -> None:
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(8000, 3))
    y, phi = filter_alike(columns @ [1.0, -2.0, 3.0], columns, dt=DT)
    np.testing.assert_allclose(y, phi @ [1.0, -2.0, 3.0], atol=1e-12)


def test_differences_are_exact_for_parabolas() -> None:
    x = 3.0 * T**2 - T
    np.testing.assert_allclose(central_difference(x, DT)[1:-1], (6.0 * T - 1.0)[1:-1], atol=1e-9)
    np.testing.assert_allclose(second_difference(x, DT), 6.0, atol=1e-5)


def test_decimation_keeps_slow_waves_and_removes_fast_ones() -> None:
    slow, fast = np.sin(2 * np.pi * 5 * T), np.sin(2 * np.pi * 93 * T)
    ripple = 10 ** (-2 * 0.05 / 20)  # two passes of 0.05 dB
    middle = slice(100, -100)
    np.testing.assert_allclose(decimate(slow)[middle], slow[::10][middle], atol=1.01 * (1 - ripple))
    assert np.abs(decimate(fast)[middle]).max() < 1e-4
    assert decimate(slow).size == 800
    assert decimate(np.column_stack([slow, fast])).shape == (800, 2)


def test_detrend_removes_mean_and_line() -> None:
    wave = np.sin(2 * np.pi * T)
    assert abs(detrend(wave + 5.0).mean()) < 1e-12
    line = np.column_stack([4.0 + 3.0 * T, -2.0 * T])
    np.testing.assert_allclose(detrend(line, 1), 0.0, atol=1e-10)


def test_drop_ends_keeps_the_middle() -> None:
    np.testing.assert_array_equal(drop_ends(np.arange(101.0)), [49.0, 50.0, 51.0])
    with pytest.raises(InputError, match="dropped"):
        drop_ends(np.arange(98.0))


@pytest.mark.parametrize(
    ("up", "down", "offset", "factor"),
    [(2.773, -2.029, 0.372, 2.401), (2.141, -2.933, -0.396, 2.537)],
)
def test_accelerometer_calibration_of_the_thesis(
    up: float, down: float, offset: float, factor: float
) -> None:
    """Annex A: offsets 0.372 V and -0.396 V, 1 g = 2.401 V and 2.537 V."""
    noise = 0.05 * np.sin(np.linspace(0.0, 20 * np.pi, 4001))[:-1]
    found = calibrate_accelerometer(up + noise, down + noise)
    assert found.offset == pytest.approx(offset, abs=1e-9)
    assert found.offset == pytest.approx(up - (up + abs(down)) / 2, abs=1e-9)  # equation A.1
    assert found.volts_per_g == pytest.approx(factor, abs=1e-9)
    np.testing.assert_allclose(
        found.acceleration([up, offset, down]), [9.80665, 0.0, -9.80665], atol=1e-6
    )


def test_accelerometer_offset_from_horizontal_positions() -> None:
    found = calibrate_accelerometer([2.773], [-2.029], [0.385, 0.395])
    assert (found.offset, found.volts_per_g) == pytest.approx((0.390, 2.401))
    with pytest.raises(InputError, match="same output"):
        calibrate_accelerometer([1.0], [1.0])


def test_record_filter_treats_segments_apart_and_notes_it() -> None:
    run = np.repeat([0.0, 1.0], 4000)
    steps = np.where(run == 0.0, 1.0, -1.0)
    result = filtered(Record.from_channels(T, {"motor_position": steps, "run": run}))
    np.testing.assert_allclose(result["motor_position"], steps, atol=1e-9)
    np.testing.assert_array_equal(result["run"], run)
    assert "Butterworth order 8, 15 Hz" in result.provenance.notes[-1]


def test_derivatives_are_added_where_missing_only() -> None:
    measured = 2 * np.pi * np.cos(2 * np.pi * T)
    with_velocity = with_derivatives(record(motor_velocity=measured))
    np.testing.assert_array_equal(with_velocity["motor_velocity"], measured)
    plain = with_derivatives(record())
    np.testing.assert_allclose(plain["motor_velocity"][1:-1], measured[1:-1], atol=1e-3)
    acceleration = -((2 * np.pi) ** 2) * np.sin(2 * np.pi * T)
    for result in (plain, with_velocity):
        np.testing.assert_allclose(
            result["motor_acceleration"][2:-2], acceleration[2:-2], atol=1e-2
        )
        assert not result.has("link_velocity")


def test_trimmed_and_decimated_records() -> None:
    run = np.repeat([0.0, 1.0], 4000)
    result = decimated(trimmed(record(run=run), 49), 10)
    assert [s.stop - s.start for s in result.segments()] == [391, 391]
    assert result.time[0] == pytest.approx(0.049)
    assert set(result["run"]) == {0.0, 1.0}
    np.testing.assert_allclose(result["motor_position"], np.sin(2 * np.pi * result.time), atol=0.02)


def test_shift_undoes_a_delay() -> None:
    late = np.sin(2 * np.pi * (T - 0.004))
    result = shift_channel(record(link_position=late), "link_position", 0.004)
    np.testing.assert_allclose(result["link_position"], result["motor_position"], atol=1e-9)
    assert len(result) == len(T) - 4


@pytest.mark.parametrize(
    "call",
    [
        lambda: butterworth(np.zeros(100), DT, cutoff=500.0),
        lambda: butterworth(np.zeros(100), 0.0),
        lambda: butterworth(np.zeros(100), DT, order=0),
        lambda: butterworth(np.zeros(10), DT),
        lambda: butterworth(np.full(100, np.nan), DT),
        lambda: butterworth([], DT),
        lambda: decimate(np.zeros(100), 0),
        lambda: detrend([1.0], 1),
        lambda: filtered(Record.from_channels(T**1.1, {"motor_position": T})),
        lambda: trimmed(record(), 5000),
        lambda: shift_channel(record(), "motor_position", 100.0),
    ],
)
def test_unusable_input_is_refused(call: object) -> None:
    with pytest.raises(InputError):
        call()  # type: ignore[operator]
