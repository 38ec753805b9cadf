"""The gate against encoders that wrap or slip, samples far off, a reversed drive and a wrong
unit of time.
"""

from __future__ import annotations

import numpy as np
import pytest

from identification.data.check.checks import check, repair
from identification.data.record import Record
from identification.data.units import base_unit
from tests.identification.data.test_check import RATIO, Array, bad, found, record
from tests.identification.diagnosis.test_other_payload import FAST, PER_AMPERE
from tests.identification.diagnosis.test_other_payload import record as driven


@pytest.mark.parametrize("low", [0.0, -np.pi])
@pytest.mark.parametrize("channel", ["motor_position", "link_position"])
def test_an_encoder_that_wraps_is_refused(channel: str, low: float) -> None:
    def wrap(a: dict[str, Array]) -> None:
        a[channel] = np.mod(4 * a[channel] - low, 2 * np.pi) + low

    finding = found(check(record(wrap), RATIO), "wrapped")
    assert finding.severity == "refuse"
    assert finding.channel == channel
    assert "wraps at 2 pi: unwrap it" in finding.message


def test_a_slow_link_that_wraps_a_few_times_is_refused() -> None:
    def wrap(a: dict[str, Array]) -> None:
        a["link_position"] = np.mod(a["link_position"] + 0.3, 2 * np.pi)

    finding = found(check(record(wrap), RATIO), "wrapped")
    assert finding.channel == "link_position"


def test_an_encoder_that_wraps_and_was_logged_slowly_is_refused() -> None:
    whole = record()
    slow = {c: x[::50] for c, x in whole.channels.items() if not c.endswith("velocity")}
    slow["motor_position"] = np.mod(slow["motor_position"], 2 * np.pi)
    assert (
        found(
            check(Record.from_channels(whole.time[::50], slow, name="bench"), RATIO), "wrapped"
        ).severity
        == "refuse"
    )


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


@pytest.mark.parametrize(
    ("channel", "size"), [("link_torque", 1e4), ("motor_current", -50.0), ("link_velocity", 30.0)]
)
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
    late = Record.from_channels(
        1e3 * whole.time,
        {c: x for c, x in whole.channels.items() if not c.endswith("velocity")},
        name="bench",
    )
    finding = found(check(late, RATIO), "time_unit")
    assert finding.severity == "refuse"
    assert "is time in ms?" in finding.message


# ---- what must pass


def test_a_gap_is_neither_a_wrap_nor_a_slip() -> None:
    whole = record()
    keep = np.ones(len(whole), dtype=bool)
    keep[1000:2400] = False
    glued = Record.from_channels(
        whole.time[keep], {c: x[keep] for c, x in whole.channels.items()}, name="bench"
    )
    assert set(bad(check(glued, RATIO))) == {"gap"}


def test_two_runs_at_different_places_are_no_wrap() -> None:
    whole = record()
    shift = np.where(np.arange(len(whole)) < 2500, 0.0, 40.0)
    parts = {
        c: x + (shift if c == "link_position" else RATIO * shift if c == "motor_position" else 0.0)
        for c, x in whole.channels.items()
    }
    late = np.where(np.arange(len(whole)) < 2500, 0.0, 24.0)
    assert "wrapped" not in bad(
        check(Record.from_channels(whole.time + late, parts, name="bench"), RATIO)
    )


@pytest.mark.parametrize("dwell", [40, 100])
def test_a_quick_move_between_rests_is_no_wrap(dwell: int) -> None:
    def step(a: dict[str, Array]) -> None:
        up = (np.arange(a["time"].size) // dwell) % 2
        a["link_position"] = 6.0 * up + 1e-5 * np.sin(a["time"])
        a["motor_position"] = RATIO * a["link_position"]

    findings = check(record(step).without("motor_velocity", "link_velocity", "link_torque"), RATIO)
    assert "wrapped" not in [f.code for f in findings]


def test_a_soft_joint_passes_where_a_torque_sensor_shows_its_torsion() -> None:
    def soften(a: dict[str, Array]) -> None:
        a["motor_position"] = RATIO * (a["link_position"] + a["link_torque"] / 800.0)
        a["motor_velocity"] = np.gradient(a["motor_position"], a["time"])

    made = record(soften)
    finding = found(check(made, RATIO), "gear_ratio")
    assert finding.severity == "ok"
    assert "with the torsion taken off the positions show a gear ratio of -160," in finding.message
    assert found(check(made.without("link_torque"), RATIO), "gear_ratio").severity == "refuse"


@pytest.mark.parametrize(("given", "severity"), [(9.0, "ok"), (8.0, "refuse")])
def test_a_link_that_swings_on_a_soft_joint_shows_no_other_gear_ratio(
    given: float, severity: str
) -> None:
    time = np.arange(4000) / 200.0
    link = 0.6 * np.sin(3.0 * time) + 0.15 * np.sin(7.0 * time) + 0.05 * np.sin(11.0 * time)
    swing = 5.4 * np.sin(3.0 * time) + 7.35 * np.sin(7.0 * time) + 6.05 * np.sin(11.0 * time)
    made = Record.from_channels(
        time,
        # the spring of the link at 2.5 Hz: the motor moves less than the link times the ratio
        {"link_position": link, "motor_position": 9.0 * (link - swing / (5.0 * np.pi) ** 2)},
        name="bench",
    )
    assert found(check(made, given), "gear_ratio").severity == severity


def test_a_locked_link_whose_encoder_toggles_is_allowed() -> None:
    rng = np.random.default_rng(1)

    def lock(a: dict[str, Array]) -> None:
        a["link_position"] = 6.3e-5 * np.round(0.3 * rng.standard_normal(a["time"].size))
        a["motor_position"] = RATIO * 0.003 * np.sin(a["time"])
        del a["motor_velocity"], a["link_velocity"]

    findings = check(record(lock), RATIO)
    assert "refuse" not in {f.severity for f in findings}
    assert "fine if the link is locked" in found(findings, "gear_ratio").message


def test_a_coarse_link_encoder_raises_no_doubt_about_the_gear_ratio() -> None:
    def coarse(a: dict[str, Array]) -> None:
        a["link_position"] = np.round(a["link_position"] / 0.1) * 0.1
        del a["link_velocity"]

    assert found(check(record(coarse), RATIO), "gear_ratio").severity == "ok"


def test_a_row_beside_a_gap_is_not_bridged_over_it() -> None:
    whole = record()
    keep = np.ones(len(whole), dtype=bool)
    keep[1001:2400] = False
    channels = {c: x[keep].copy() for c, x in whole.channels.items()}
    channels["link_torque"][1000] = np.nan
    mended = repair(Record.from_channels(whole.time[keep], channels, name="bench"))
    assert len(mended) == int(keep.sum()) - 1
    assert [s.stop - s.start for s in mended.segments()] == [1000, len(whole) - 2400]


@pytest.mark.parametrize("unit", ["U/min", "1/min", "min^-1", "Upm"])
def test_revolutions_per_minute_have_german_names_too(unit: str) -> None:
    assert base_unit(unit) == base_unit("rpm")


@pytest.mark.parametrize("channel", ["link_torque", "link_position"])
def test_an_infinite_sample_is_a_hole_and_no_jump(channel: str) -> None:
    """It was off by 1.8e308 of its unit, beside being no number."""

    def put(a: dict[str, Array]) -> None:
        a[channel] = a[channel].copy()
        a[channel][50] = np.inf

    findings = check(record(put), RATIO)
    assert [f for f in findings if f.code == "jump"] == []
    assert any("not a number" in f.message and f.channel == channel for f in findings)
