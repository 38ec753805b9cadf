"""Records: segments, splits, resampling, joining."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from identification.data.record import CHANNELS, Provenance, Record, channel_unit, concat
from identification.errors import InputError


def sample(n: int = 1000, dt: float = 0.01, name: str = "r") -> Record:
    t = dt * np.arange(n)
    return Record.from_channels(
        t, {"motor_position": np.sin(t), "motor_current": np.cos(t)}, name=name
    )


def test_channels_and_units() -> None:
    record = sample()
    assert record.has("motor_position", "motor_current")
    assert not record.has("motor_position", "link_position")
    assert channel_unit("motor_torque") == "N.m"
    assert channel_unit("motor_torque", "linear") == "N"
    assert channel_unit("link_velocity", "linear") == "m/s"
    assert all(channel_unit(channel) for channel in CHANNELS)


def test_missing_channel_says_which() -> None:
    with pytest.raises(InputError, match=r"no channel link_torque.*motor_position"):
        sample()["link_torque"]


@pytest.mark.parametrize(
    ("channels", "kind"),
    [
        ({"motor_speed": np.zeros(3)}, "rotary"),
        ({"motor_position": np.zeros(4)}, "rotary"),
        ({}, "planar"),
    ],
)
def test_unusable_arrays_are_refused(channels: dict[str, np.ndarray], kind: str) -> None:
    with pytest.raises(InputError):
        Record.from_channels(np.arange(3.0), channels, kind=kind)


def test_record_is_frozen_and_arrays_are_read_only() -> None:
    record = sample()
    with pytest.raises(AttributeError):
        record.name = "other"  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        record["motor_position"][0] = 1.0
    with pytest.raises(TypeError):
        record.channels["motor_position"] = np.zeros(1000)  # type: ignore[index]


def test_making_a_record_does_not_freeze_the_callers_array() -> None:
    t = np.arange(5.0)
    Record.from_channels(t, {"motor_position": t})
    t[0] = 1.0


def test_run_channel_makes_segments() -> None:
    run = np.array([3, 3, 3, 7, 7, 3.0])
    record = Record.from_channels(
        [0, 1, 2, 0, 1, 0], {"motor_position": np.arange(6.0), "run": run}
    )
    assert record.segments() == [slice(0, 3), slice(3, 5), slice(5, 6)]
    assert record.dt == 1.0
    assert record.duration == 3.0


def test_split_by_time_is_complete_and_disjoint() -> None:
    record = sample()
    first, second = record.split(0.7)
    assert len(first) + len(second) == len(record)
    assert first.time[-1] < second.time[0]
    assert first.duration / record.duration == pytest.approx(0.7, abs=0.002)


def test_split_in_blocks_takes_the_same_part_of_each() -> None:
    first, second = sample().split(0.75, blocks=4)
    assert len(first.segments()) == len(second.segments()) == 4
    np.testing.assert_array_equal(np.sort(np.concatenate([first.time, second.time])), sample().time)
    assert [s.stop - s.start for s in first.segments()] == pytest.approx([187.5] * 4, abs=1.0)


def test_split_works_within_every_run() -> None:
    joined = concat([sample(), sample(500)])
    first, second = joined.split(0.5)
    assert [s.stop - s.start for s in first.segments()] == [500, 250]
    assert len(second.segments()) == 2


@pytest.mark.parametrize("fraction", [0.0, 1.0, -1.0, float("nan")])
def test_split_refuses_a_fraction_outside(fraction: float) -> None:
    with pytest.raises(InputError):
        sample().split(fraction)


def test_window_and_empty_window() -> None:
    piece = sample().window(1.0, 2.0)
    assert piece.time[0] == pytest.approx(1.0)
    assert piece.time[-1] == pytest.approx(2.0)
    with pytest.raises(InputError, match="no sample between"):
        sample().window(100.0, 200.0)


def test_taking_rows_out_of_the_middle_makes_two_segments() -> None:
    keep = np.ones(1000, dtype=bool)
    keep[400:410] = False
    piece = sample().take(keep, "cut")
    assert piece.segments() == [slice(0, 400), slice(400, 990)]
    assert piece.provenance.notes == ("cut",)


def test_resampling_is_exact_for_straight_lines_and_does_not_bridge_runs() -> None:
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.5e-3, 1.5e-3, 2000))
    run = np.repeat([0.0, 1.0], 1000)
    position = np.where(run == 0, 2.0 * t, -5.0 * t)
    record = Record.from_channels(t, {"motor_position": position, "run": run}).resampled(1e-3)
    first, second = record.segments()
    np.testing.assert_allclose(
        record["motor_position"][first], 2.0 * record.time[first], atol=1e-12
    )
    np.testing.assert_allclose(
        record["motor_position"][second], -5.0 * record.time[second], atol=1e-12
    )
    np.testing.assert_allclose(record.steps(), 1e-3, atol=1e-12)
    assert "linear interpolation" in record.provenance.notes[-1]


def test_resampling_a_uniform_record_keeps_it() -> None:
    record = sample()
    again = record.resampled()
    assert len(again) == len(record)
    np.testing.assert_allclose(again["motor_position"], record["motor_position"], atol=1e-9)


def test_resampling_refuses_time_that_does_not_increase() -> None:
    record = Record.from_channels([0.0, 1.0, 1.0, 2.0], {"motor_position": np.arange(4.0)})
    with pytest.raises(InputError, match="repair"):
        record.resampled(0.5)
    with pytest.raises(InputError, match="positive dt"):
        sample().resampled(-1.0)


def test_resampling_a_million_samples_keeps_the_signal() -> None:
    n = 1_000_000
    t = 1e-3 * np.arange(n) + 1e-4 * np.sin(np.arange(n))
    record = Record.from_channels(t, {"motor_position": np.sin(t), "motor_current": np.cos(t)})
    even = record.resampled(1e-3)
    assert len(even) >= n - 1
    np.testing.assert_allclose(even["motor_position"], np.sin(even.time), atol=1e-6)


def test_joining_keeps_segments_apart_and_notes_what_is_left_out() -> None:
    first = sample(100, name="a")
    second = sample(50, name="b").with_channel("link_position", np.zeros(50))
    joined = concat([first, second])
    assert joined.segments() == [slice(0, 100), slice(100, 150)]
    assert not joined.has("link_position")
    assert any("link_position" in note for note in joined.provenance.notes)
    assert joined.duration == pytest.approx(first.duration + second.duration)


def test_joining_refuses_nothing_and_mixed_kinds() -> None:
    with pytest.raises(InputError):
        concat([])
    with pytest.raises(InputError, match="kinds"):
        concat(
            [
                sample(),
                Record.from_channels([0.0, 1.0], {"motor_position": [0.0, 1.0]}, kind="linear"),
            ]
        )


def test_records_travel_to_other_processes() -> None:
    record = pickle.loads(pickle.dumps(sample()))
    np.testing.assert_array_equal(record["motor_current"], sample()["motor_current"])
    assert isinstance(record.provenance, Provenance)
    with pytest.raises(ValueError, match="read-only"):
        record["motor_position"][0] = 1.0


def test_html_is_small_and_escaped() -> None:
    text = sample(name="<script>")._repr_html_()
    assert "&lt;script&gt;" in text
    assert "<script>" not in text
    assert len(text) < 2000
