"""The check gate: every defect is found with its row and named with what to do; repairs are
named rules.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from identification.data.check.checks import Finding, check, gate, repair, require
from identification.data.check.quanta import quantum
from identification.data.read import read
from identification.data.record import Record
from identification.errors import InputError

Array = npt.NDArray[np.float64]

SHARED = Path(__file__).resolve().parents[3].parent / "shared"
needs_shared = pytest.mark.skipif(
    not SHARED.is_dir() and not os.environ.get("CI"),
    reason="the shared data are not beside the checkout",
)

N = 5000
DT = 2e-3
RATIO = -160.0


def signals(n: int = N) -> dict[str, Array]:
    rng = np.random.default_rng(3)
    t = DT * np.arange(n)
    link = 0.8 * np.sin(2.1 * t) + 0.3 * np.sin(5.3 * t + 1.0)
    rate = 0.8 * 2.1 * np.cos(2.1 * t) + 0.3 * 5.3 * np.cos(5.3 * t + 1.0)
    quantum = np.deg2rad(0.0036)
    return {
        "time": t,
        "motor_current": 3.0 * np.sin(2.1 * t) + 0.01 * rng.normal(size=n),
        "motor_position": RATIO * link + 1e-3 * rng.normal(size=n),
        "motor_velocity": RATIO * rate + 0.1 * rng.normal(size=n),
        "link_position": np.rint(link / quantum) * quantum,
        "link_velocity": rate + 1e-3 * rng.normal(size=n),
        "link_torque": 50.0 * np.sin(link) + 0.05 * rng.normal(size=n),
    }


def record(change: Callable[[dict[str, Array]], None] | None = None, n: int = N) -> Record:
    arrays = signals(n)
    if change is not None:
        change(arrays)
    stamps = arrays.pop("time")
    return Record.from_channels(stamps, arrays, name="bench")


def found(findings: tuple[Finding, ...], code: str) -> Finding:
    matching = [finding for finding in findings if finding.code == code]
    assert matching, f"{code} not in {[str(f) for f in findings]}"
    return matching[0]


def bad(findings: tuple[Finding, ...]) -> list[str]:
    return [finding.code for finding in findings if finding.severity != "ok"]


def test_a_good_record_passes_and_is_not_touched() -> None:
    good = record()
    findings = check(good, RATIO, needs=("motor_current", "link_torque"))
    assert bad(findings) == []
    assert {f.code for f in findings} >= {
        "time_increases",
        "reversal",
        "velocity_position",
        "gear_ratio",
        "delay",
    }
    assert repair(good) is good


def test_every_message_is_one_line_with_the_records_name() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["motor_current"][7] = np.nan
        a["link_velocity"] *= 57.3
        a["time"][3000:] += 1.0

    for finding in check(record(spoil), 100.0):
        assert "\n" not in finding.message
        assert finding.message.startswith("bench: ")


def test_findings_come_worst_first() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["time"][3000:] += 1.0
        a["link_torque"][:] = 0.0

    order = ["refuse", "repair", "warn", "ok"]
    places = [order.index(f.severity) for f in check(record(spoil), RATIO)]
    assert places == sorted(places)
    assert places[0] == 0


# ---- size and time


@pytest.mark.parametrize(("n", "code"), [(0, "empty"), (1, "one_sample"), (5, "too_short")])
def test_too_few_samples_are_refused(n: int, code: str) -> None:
    findings = check(record(n=n), RATIO)
    assert [f.code for f in findings] == [code]
    with pytest.raises(InputError, match="bench"):
        gate(record(n=n), RATIO)


def test_a_gap_is_found_with_its_row_and_split() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["time"][2000:] += 0.5

    finding = found(check(record(spoil), RATIO), "gap")
    assert (finding.severity, finding.row) == ("repair", 2000)
    assert "row 2001 (t = 4.5 s)" in finding.message
    assert "250 samples" in finding.message
    repaired = repair(record(spoil))
    assert repaired.segments() == [slice(0, 2000), slice(2000, N)]
    assert repaired.provenance.notes[-1].startswith("split_at_gaps: 1 hole(s)")


def test_one_dropped_sample_is_a_gap() -> None:
    keep = np.arange(N) != 1234

    def spoil(a: dict[str, Array]) -> None:
        a.update({key: values[keep] for key, values in a.items()})

    finding = found(check(record(spoil), RATIO), "gap")
    assert finding.row == 1234
    assert "bridged" in finding.message
    repaired = repair(record(spoil))
    assert repaired.measured is not None
    assert np.flatnonzero(~repaired.measured).tolist() == [1234]
    assert len(repaired.segments()) == 1


def test_a_frame_written_twice_is_dropped() -> None:
    twice = np.sort(np.concatenate([np.arange(N), [100, 700]]))

    def spoil(a: dict[str, Array]) -> None:
        a.update({key: values[twice] for key, values in a.items()})

    assert found(check(record(spoil), RATIO), "time_repeated").severity == "repair"
    repaired = repair(record(spoil))
    assert "drop_repeated_stamps: 2 row(s), first row 102" in repaired.provenance.notes
    for channel, values in record().channels.items():
        np.testing.assert_array_equal(repaired[channel], values)


def test_a_repeated_stamp_with_new_values_gets_the_time_of_its_slot() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["time"][100] = a["time"][99]
        a["time"][700] = a["time"][699]

    finding = found(check(record(spoil), RATIO), "time_repeated")
    assert (finding.severity, finding.row) == ("repair", 100)
    repaired = repair(record(spoil))
    np.testing.assert_allclose(repaired.time, record().time, atol=1e-9)
    for channel, values in record().channels.items():
        np.testing.assert_array_equal(repaired[channel], values)


def test_coarse_stamps_are_refused() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["time"][:] = np.floor(a["time"] / 0.01) * 0.01

    assert found(check(record(spoil), RATIO), "time_repeated").severity == "refuse"


def test_time_that_runs_backwards_is_refused_with_its_row() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["time"][2500:] -= 3.0

    finding = found(check(record(spoil), RATIO), "time_decreases")
    assert (finding.severity, finding.row) == ("refuse", 2500)
    assert "run column" in finding.message


def test_time_may_start_again_with_a_run() -> None:
    def several(a: dict[str, Array]) -> None:
        a["time"][2500:] -= a["time"][2500]
        a["run"] = np.repeat([0.0, 1.0], N // 2)

    assert bad(check(record(several), RATIO)) == []


def test_time_nan() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["time"][10] = np.nan

    assert found(check(record(spoil), RATIO), "time_nan").row == 10
    assert np.isfinite(repair(record(spoil)).time).all()


def test_stamps_that_scatter_are_put_right() -> None:
    rng = np.random.default_rng(0)

    def spoil(a: dict[str, Array]) -> None:
        a["time"] += rng.uniform(-0.2, 0.2, N) * DT

    assert found(check(record(spoil), RATIO), "jitter").severity == "repair"
    repaired = repair(record(spoil))
    for channel, values in record().channels.items():
        np.testing.assert_array_equal(repaired[channel], values)


def test_milliseconds_taken_for_seconds() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["time"] *= 1e3

    findings = check(record(spoil), RATIO)
    assert "is time in ms?" in found(findings, "time_unit").message
    assert "factor 1000" in found(findings, "velocity_position").message


# ---- channels


def test_nan_is_found_with_channel_and_row_and_split_there() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["link_torque"][1500:1510] = np.nan

    finding = found(check(record(spoil), RATIO), "nan")
    assert (finding.severity, finding.channel, finding.row) == ("repair", "link_torque", 1500)
    repaired = repair(record(spoil))
    assert repaired.segments() == [slice(0, 1500), slice(1500, N - 10)]
    assert "drop_nan_rows: 10 row(s), first row 1501; split there" in repaired.provenance.notes


def test_a_channel_full_of_nan_is_refused() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["link_torque"][1000:] = np.nan

    assert found(check(record(spoil), RATIO), "nan").severity == "refuse"


def test_slow_temperature_is_interpolated() -> None:
    def slow(a: dict[str, Array]) -> None:
        a["temperature"] = np.where(np.arange(N) % 100 == 0, 293.0 + a["time"], np.nan)

    repaired, findings = gate(record(slow), RATIO)
    assert found(findings, "nan").severity == "repair"
    assert len(repaired) == N
    np.testing.assert_allclose(
        repaired["temperature"][:4900], 293.0 + repaired.time[:4900], atol=1e-9
    )


@pytest.mark.parametrize(
    "channel", ["motor_current", "motor_position", "link_position", "link_torque"]
)
def test_a_constant_channel_is_refused(channel: str) -> None:
    def spoil(a: dict[str, Array]) -> None:
        a[channel][:] = 0.25

    finding = next(f for f in check(record(spoil), RATIO) if f.code == "constant")
    assert (finding.severity, finding.channel) == ("refuse", channel)


def test_a_locked_link_is_allowed() -> None:
    def lock(a: dict[str, Array]) -> None:
        a["link_position"][:] = 0.0
        a["motor_position"] *= 0.01
        del a["link_velocity"], a["motor_velocity"]

    assert found(check(record(lock), RATIO), "constant").severity == "warn"


def test_a_stuck_stretch_is_found() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["link_position"][2000:2600] = a["link_position"][2000]

    finding = found(check(record(spoil), RATIO), "stuck")
    assert (finding.channel, finding.row) == ("link_position", 2000)


def test_saturation_is_found() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["motor_current"] = np.clip(a["motor_current"], -2.5, 100.0)

    finding = found(check(record(spoil), RATIO), "saturation")
    assert finding.channel == "motor_current"
    assert "smallest value -2.5 A" in finding.message


def test_quantisation_step_is_measured() -> None:
    finding = next(f for f in check(record(), RATIO) if f.code == "quantisation")
    assert (finding.severity, finding.channel) == ("ok", "link_position")
    assert f"step {np.deg2rad(0.0036):.4g} rad" in finding.message

    def coarse(a: dict[str, Array]) -> None:
        a["link_position"] = np.rint(a["link_position"] / 0.1) * 0.1

    assert found(check(record(coarse), RATIO), "quantisation").severity == "warn"


def in_steps(motor: float, link: float, taken: float = 1.0) -> Record:
    """Both positions as encoders of so many steps to a turn read them, times a factor."""

    def change(arrays: dict[str, Array]) -> None:
        for channel, steps in (("motor_position", motor), ("link_position", link)):
            size = 2.0 * np.pi / steps
            counted = np.rint(arrays[channel] / size) * size
            arrays[channel] = np.round(counted * taken, 12)
            arrays[channel.replace("position", "velocity")] *= taken

    return record(change)


@pytest.mark.parametrize("steps", [(4050, 65_550), (2250, 100_050), (810, 20_250)])
@pytest.mark.parametrize(
    ("taken", "said"),
    [
        (180 / np.pi, "was read in radians: are its positions in degrees?"),
        (np.pi / 180, "was read in degrees: are its positions in radians?"),
        (0.5 / np.pi, "are its positions in turns?"),
    ],
)
def test_the_steps_of_two_encoders_tell_the_unit(
    steps: tuple[int, int], taken: float, said: str
) -> None:
    """Numbers in one unit under the head of another agree in everything but the turn."""
    finding = found(check(in_steps(*steps, taken), RATIO), "unit")
    assert finding.severity == "refuse"
    assert said in finding.message and "whole number of steps" in finding.message
    assert not [f for f in check(in_steps(*steps), RATIO) if f.code == "unit"]


def test_steps_that_are_no_encoders_tell_no_unit() -> None:
    """Digits of the file, numbers of a fixed point, and the encoder of the motor told at the link
    are no unit; one position alone is a doubt.
    """
    for steps in (2e3 * np.pi, 2e3 * np.pi / 3, 2**12 * np.pi, 4096 * 160.0, 4096 / 160.0):
        assert not [f for f in check(in_steps(steps, steps), RATIO) if f.code == "unit"], steps
    alone = found(check(in_steps(4096 * np.pi / 180, 1e6), RATIO), "unit")
    assert alone.severity == "warn" and alone.channel == "motor_position"


def test_a_missing_channel_is_refused() -> None:
    finding = found(check(record(), RATIO, needs=("temperature",)), "missing_channel")
    assert (finding.severity, finding.channel) == ("refuse", "temperature")


# ---- relations


def test_no_reversal_and_no_motion() -> None:
    def one_way(a: dict[str, Array]) -> None:
        for key in ("motor_velocity", "link_velocity", "link_position"):
            del a[key]
        a["motor_position"] = 10.0 * a["time"] + np.sin(3.0 * a["time"])

    assert found(check(record(one_way)), "no_reversal").severity == "warn"

    def still(a: dict[str, Array]) -> None:
        a["motor_position"][:] = 0.0

    assert found(check(record(still), RATIO), "no_motion").severity == "refuse"


@pytest.mark.parametrize(
    ("channel", "factor", "said"),
    [
        ("motor_position", 180 / np.pi, "57.3 times"),
        ("motor_position", 180 / np.pi, "degrees were taken for radians in the position"),
        ("motor_velocity", 180 / np.pi, "degrees were taken for radians in the velocity"),
        ("motor_velocity", 30 / np.pi, "the velocity is in rpm"),
        ("motor_velocity", -1.0, "the sign of one is reversed"),
        ("link_velocity", RATIO, "other side of the gear"),
        ("link_velocity", 1.7, "a unit or scale is wrong"),
    ],
)
def test_unit_doubts_are_named(channel: str, factor: float, said: str) -> None:
    def spoil(a: dict[str, Array]) -> None:
        a[channel] *= factor

    finding = next(
        f
        for f in check(record(spoil), RATIO)
        if f.code == "velocity_position" and f.severity != "ok"
    )
    assert finding.severity == "refuse"
    assert said in finding.message


def test_velocity_of_another_axis() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["link_velocity"] = np.cos(7.7 * a["time"])

    assert "does not follow" in next(
        f.message
        for f in check(record(spoil), RATIO)
        if f.code == "velocity_position" and f.severity == "warn"
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (160.0, "sign is reversed"),
        (100.0, "-160"),
        (-160.0 * 1.03, "-160"),
        (-160.0 * 180 / np.pi, "in degrees"),
    ],
)
def test_wrong_gear_ratio_is_refused_with_the_one_the_data_show(given: float, said: str) -> None:
    finding = found(check(record(), given), "gear_ratio")
    assert finding.severity == "refuse"
    assert "a gear ratio of -160" in finding.message
    assert said in finding.message


def test_ratio_within_two_percent_passes_and_none_is_told() -> None:
    assert (
        found(check(record().without("link_torque"), -160.0 * 1.015), "gear_ratio").severity == "ok"
    )
    assert "-160" in found(check(record()), "gear_ratio").message
    with pytest.raises(InputError, match="gear_ratio"):
        check(record(), 0.0)


@pytest.mark.parametrize(
    ("given", "severity"), [(-160.0, "ok"), (-161.0, "warn"), (-159.0, "warn")]
)
def test_a_gear_ratio_a_tooth_off_is_said_where_a_torque_sensor_shows_the_torsion(
    given: float, severity: str
) -> None:
    finding = found(check(record(), given), "gear_ratio")
    assert finding.severity == severity
    assert "a gear ratio of -160" in finding.message


def test_single_rows_without_a_number_are_bridged() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["link_torque"][[500, 900, 901, 2000]] = np.nan

    whole, repaired = record(), repair(record(spoil))
    assert len(repaired) == N
    assert repaired.segments() == [slice(0, N)]
    assert "bridge_nan_rows: 4 row(s), first row 501" in repaired.provenance.notes
    assert "bridged by interpolation" in found(check(record(spoil), RATIO), "nan").message
    beside = whole["link_torque"][[499, 501]]
    assert repaired["link_torque"][500] == pytest.approx(beside.mean())
    np.testing.assert_array_equal(
        np.delete(repaired["link_torque"], [500, 900, 901, 2000]),
        np.delete(whole["link_torque"], [500, 900, 901, 2000]),
    )


def test_positions_of_two_joints_are_refused() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["link_position"] = np.cos(9.1 * a["time"])

    assert "do not move together" in found(check(record(spoil), RATIO), "gear_ratio").message


@pytest.mark.parametrize("samples", [-4, 2, 7])
def test_delay_is_measured(samples: int) -> None:
    def spoil(a: dict[str, Array]) -> None:
        t = a["time"] - samples * DT
        a["link_position"] = 0.8 * np.sin(2.1 * t) + 0.3 * np.sin(5.3 * t + 1.0)

    finding = next(
        f for f in check(record(spoil), RATIO) if f.code == "delay" and f.channel == "link_position"
    )
    assert finding.severity == "warn"
    lag = float(finding.message.split(" by ")[1].split(" ms")[0])
    assert lag == pytest.approx(2.0 * samples, abs=0.1)


# ---- repair and gate


def test_repair_keeps_every_untouched_value() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["motor_current"][40:43] = np.inf
        a["time"][100] = a["time"][99]
        a["time"][3000:] += 1.0

    before, after = record(spoil), repair(record(spoil))
    keep = np.setdiff1d(np.arange(N), [40, 41, 42])
    for channel in before.channels:
        np.testing.assert_array_equal(after[channel], before[channel][keep])
    assert bad(check(after, RATIO)) == []
    assert len(after.provenance.notes) == 3


def test_short_pieces_are_dropped() -> None:
    def spoil(a: dict[str, Array]) -> None:
        a["motor_current"][[100, 101, 102, 106, 107, 108]] = np.nan

    after = repair(record(spoil))
    assert [s.stop - s.start for s in after.segments()] == [100, N - 109]
    assert any(note.startswith("drop_short_pieces: 3 row(s)") for note in after.provenance.notes)


def test_nothing_left_is_an_error() -> None:
    empty = Record.from_channels([0.0, 1.0], {"motor_current": [np.nan, np.nan]})
    with pytest.raises(InputError, match="no row is left"):
        repair(empty)


def test_gate_raises_the_first_refusal() -> None:
    with pytest.raises(InputError, match="gear ratio"):
        gate(record(), 160.0)
    require(check(record(), RATIO))


def test_a_million_rows_are_checked_like_few() -> None:
    assert {f.code for f in check(record(n=1_000_000), RATIO)} == {
        f.code for f in check(record(), RATIO)
    }


# ---- data of others


@needs_shared
@pytest.mark.parametrize("joint", ["none", "stribeck", "cubic_stiffness", "kinematic_error"])
@pytest.mark.parametrize("name", ["train", "train2", "test", "test2"])
def test_good_recordings_raise_no_alarm(joint: str, name: str) -> None:
    folder = SHARED / "hidden_effect" / joint
    ratio = tomllib.loads((folder / "joint.toml").read_text())["joint"]["gear_ratio"]
    recording = read(folder / f"{name}.csv")
    assert bad(check(recording, ratio, needs=("motor_current", "link_torque"))) == []
    assert found(check(recording, -ratio), "gear_ratio").severity == "refuse"


@needs_shared
def test_series_elastic_actuator_shows_its_ratio_and_its_time_skew() -> None:
    """The owners give no ratio; a fit of both encoders gave 273.16 (README of the set)."""
    columns = {
        "time": {"column": "t_s", "unit": "s"},
        "motor_position": {"column": "motor_pos_rad", "unit": "rad"},
        "motor_velocity": {"column": "motor_vel_rad_s", "unit": "rad/s"},
        "link_position": {"column": "q_rad", "unit": "rad"},
        "temperature": {"column": "winding_temp_C", "unit": "degC"},
    }
    findings = check(
        read(SHARED / "measurements" / "hebi_x_sine" / "hebi.csv", columns=columns), 273.16
    )
    assert "273.16" in found(findings, "gear_ratio").message
    assert bad(findings) == ["jitter", "delay"]


@pytest.mark.parametrize("unit", [1.0, 1e3, 1 / 7])
def test_a_quantum_is_as_exact_as_the_values(unit: float) -> None:
    """A quarter of a metre in steps of 50 nm: an error of 1e-11 is a half of a step over it."""
    counts = np.rint(5e6 * np.sin(np.linspace(0.0, 6.0, 20_000)))
    values = counts * 5e-8 * unit
    assert quantum(values / unit) == pytest.approx(5e-8, rel=1e-15, abs=0)
