"""The gate against encoders that wrap or slip, samples far off, a reversed drive and a wrong unit of time."""

from __future__ import annotations

import numpy as np
import pytest

from identification.check import check
from identification.record import Record
from tests.test_check import RATIO, Array, bad, found, record
from tests.test_other_payload import FAST, PER_AMPERE
from tests.test_other_payload import record as driven


@pytest.mark.parametrize("low", [0.0, -np.pi])
@pytest.mark.parametrize("channel", ["motor_position", "link_position"])
def test_an_encoder_that_wraps_is_refused(channel: str, low: float) -> None:
    def wrap(a: dict[str, Array]) -> None:
        a[channel] = np.mod(4 * a[channel] - low, 2 * np.pi) + low

    finding = found(check(record(wrap), RATIO), "wrapped")
    assert finding.severity == "refuse"
    assert finding.channel == channel
    assert "wraps at 2 pi: unwrap it" in finding.message


def test_an_encoder_that_wraps_and_was_logged_slowly_is_refused() -> None:
    whole = record()
    slow = {c: x[::50] for c, x in whole.channels.items() if not c.endswith("velocity")}
    slow["motor_position"] = np.mod(slow["motor_position"], 2 * np.pi)
    assert found(check(Record.from_channels(whole.time[::50], slow, name="bench"), RATIO), "wrapped").severity == "refuse"


def test_a_counter_that_wraps_elsewhere_is_refused() -> None:
    def wrap(a: dict[str, Array]) -> None:
        a["motor_position"] = np.mod(a["motor_position"], 40.0)

    assert "wraps at about 40 rad" in found(check(record(wrap), RATIO), "wrapped").message


@pytest.mark.parametrize(("channel", "size"), [("motor_position", 3.0), ("link_position", 0.02)])
def test_an_encoder_that_slips_is_said_with_its_row(channel: str, size: float) -> None:
    def slip(a: dict[str, Array]) -> None:
        a[channel][2345:] += size

    finding = found(check(record(slip), RATIO), "jump")
    assert (finding.severity, finding.channel, finding.row) == ("warn", channel, 2345)
    assert "row 2346" in finding.message


@pytest.mark.parametrize(("channel", "size"), [("link_torque", 1e4), ("motor_current", -50.0), ("link_velocity", 30.0)])
def test_a_sample_far_off_is_said_with_its_row(channel: str, size: float) -> None:
    def spike(a: dict[str, Array]) -> None:
        a[channel][1234] += size

    finding = found(check(record(spike), RATIO), "jump")
    assert (finding.severity, finding.channel, finding.row) == ("warn", channel, 1234)


def test_a_reversed_drive_is_refused_without_a_torque_sensor() -> None:
    right = driven("right", 3, False, *FAST).without("link_torque")
    assert "work" not in bad(check(right, 160.0, torque_per_current=PER_AMPERE))
    wrong = right.with_channel("motor_current", -right["motor_current"])
    finding = found(check(wrong, 160.0, torque_per_current=PER_AMPERE), "work")
    assert finding.severity == "refuse"
    assert "is its sign reversed?" in finding.message
    alone = wrong.without("link_position")
    assert found(check(alone, 160.0, torque_per_current=PER_AMPERE), "work").severity == "refuse"


def test_milliseconds_without_velocities_are_refused() -> None:
    whole = record()
    late = Record.from_channels(1e3 * whole.time, {c: x for c, x in whole.channels.items() if not c.endswith("velocity")}, name="bench")
    finding = found(check(late, RATIO), "time_unit")
    assert finding.severity == "refuse"
    assert "is time in ms?" in finding.message
