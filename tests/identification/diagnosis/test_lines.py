"""Lines at orders that nobody names beforehand."""

from __future__ import annotations

import math
import os
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from benchmarks.lines import Case, Result, results
from casadi_models import JointModel
from identification import Record, improve, load_joint, read
from identification.balance.dataset import OF_TORQUE
from identification.balance.sensing import Sensing, sense
from identification.balance.weak import WeakRecord
from identification.data.joint_file import Joint, parse_joint, toml_text
from identification.diagnosis.lines import (
    DERIVATIVE,
    SMOOTHED,
    Line,
    _encoder_orders,
    _in_step,
    _Joined,
    _names,
    _Pointwise,
    _polynomial,
    _Scan,
    _Tracked,
    _without_trend,
    at_every_sample,
    find_lines,
    line_models,
    named_orders,
    orders_of,
    without_turn,
)
from identification.diagnosis.order_tracking import (
    ALPHA,
    Peak,
    Samples,
    confirmed,
    peaks,
    spectrum,
)
from identification.errors import InputError
from identification.fitting.engine import load_dataset, prepared_model, solve

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
SHARED = Path(__file__).resolve().parents[3].parent / "shared" / "hidden_effect" / "none"
EVERY = Sensing(
    ("motor", "link", "transmission"),
    both_positions=True,
    has_torque=True,
    has_drive=True,
    has_temperature=False,
)


def test_scan_peaks_at_the_order() -> None:
    rng = np.random.default_rng(3)
    angle = np.cumsum(rng.uniform(0, 0.2, 5000))
    residual = 0.3 * np.sin(3.37 * angle + 1) + rng.standard_normal(5000)
    orders, power = spectrum(
        Samples(angle, residual, np.ones(5000), np.zeros(5000, dtype=np.int64)), 14.0
    )
    assert orders[np.argmax(power)] == pytest.approx(3.37, abs=2 * np.pi / np.ptp(angle))


def found(joint: Joint, train: list[Record], held: list[Record]) -> list[Line]:
    model = prepared_model(joint, train[0])
    data = load_dataset(train, held, joint, model)
    solution = solve(model, data)
    return find_lines(solution, data, train, held)


@pytest.mark.parametrize(
    ("order", "twist"), [(0.85, 2.6e-6), (3.05, 3.4e-6), (7.2, 3.4e-6), (None, 0.0)]
)
def test_line_of_a_few_percent_is_found_at_its_order(order: float | None, twist: float) -> None:
    if not SHARED.exists() and not os.environ.get("CI"):
        pytest.skip("../shared/hidden_effect is not there")
    joint = load_joint(SHARED / "joint.toml")

    def with_line(record: Record) -> Record:
        if order is None:
            return record
        return record.with_channel(
            "link_position",
            record["link_position"] + twist * np.sin(order * record["motor_position"] + 1),
        )

    train, held = (
        [with_line(read(SHARED / f"{n}{i}.csv")) for i in ("", "2")] for n in ("train", "test")
    )
    lines = found(joint, train, held)
    if order is None:
        assert lines == []
    else:
        assert lines[0].balance == "transmission"
        assert lines[0].order == pytest.approx(order, abs=lines[0].tolerance)


def test_a_line_at_an_order_without_a_name_is_no_effect_at_a_named_one_beside_it() -> None:
    if not SHARED.exists() and not os.environ.get("CI"):
        pytest.skip("../shared/hidden_effect is not there")

    def with_error(record: Record) -> Record:
        angle = record["link_position"] + 1e-5 * np.sin(2.5 * record["motor_position"] + 1)
        return record.with_channel("link_position", angle)

    train, held = (
        [with_error(read(SHARED / f"{n}{i}.csv")) for i in ("", "2")] for n in ("train", "test")
    )
    result = improve(train, load_joint(SHARED / "joint.toml"), held)
    assert result.claims == ()
    assert [line.order for line in result.lines] == [pytest.approx(2.5, abs=0.005)]
    why = {x.effect: x.why for x in result.not_testable}
    assert "line" in why["kinematic_error"]


def swinging(seed: int, order: float = 0.0, amplitude: float = 0.0, count: int = 6000) -> Samples:
    """White noise of unit size along an angle that swings, with a line or without."""
    rng = np.random.default_rng(seed)
    time = np.arange(count) * 0.01
    angle = 60 * np.sin(0.9 * time + rng.uniform(0, 6)) + 25 * np.sin(
        2.3 * time + rng.uniform(0, 6)
    )
    residual = amplitude * np.sin(order * angle + 1) + rng.standard_normal(count)
    return Samples(angle, residual, np.abs(np.gradient(angle, time)), (time / 1.0).astype(np.int64))


def test_noise_has_no_line() -> None:
    found = sum(bool(peaks(swinging(seed), 6.0, (1.0, 2.0, 4.0))) for seed in range(40))
    # anywhere and by name, each at ALPHA: more than three of forty happens once in a thousand times
    assert found <= 3, ALPHA


def test_order_and_amplitude_lie_in_their_bands() -> None:
    orders, sizes = [], []
    for seed in range(60):
        line = peaks(swinging(seed, 2.3, 0.25), 6.0)[0]
        orders.append((line.order - 2.3) / line.error)
        sizes.append((line.amplitude - 0.25) / line.amplitude_error)
    assert np.max(np.abs(orders)) < 4
    assert np.mean(np.abs(orders) < 1.96) > 0.85
    assert np.mean(np.abs(sizes) < 1.96) > 0.85


def test_a_line_below_the_threshold_anywhere_counts_at_a_named_order() -> None:
    def found(named: tuple[float, ...]) -> int:
        return sum(
            any(p.at(4.0) for p in peaks(swinging(s, 4.0, 0.085), 6.0, named)) for s in range(20)
        )

    assert found((1.0, 2.0, 4.0)) >= found(()) + 3


def test_a_line_that_held_out_samples_do_not_have_is_not_confirmed() -> None:
    line = peaks(swinging(0, 2.3, 0.25), 6.0)[0]
    assert confirmed(line, swinging(1, 2.3, 0.25), 1)
    assert sum(confirmed(line, swinging(s), 1) for s in range(2, 42)) <= 3
    opposite = replace(swinging(1, 2.3, 0.25), residual=-swinging(1, 2.3, 0.25).residual)
    assert not confirmed(line, opposite, 1)


def test_a_line_of_which_held_out_samples_have_next_to_nothing_is_not_confirmed() -> None:
    line = peaks(swinging(0, 2.3, 0.25), 6.0)[0]
    quiet = [swinging(1, 2.3, size) for size in (0.25, 0.01)]
    quiet = [replace(s, residual=line.wave(s) * size) for s, size in zip(quiet, (1.0, 0.05))]
    assert [confirmed(line, s, 1) for s in quiet] == [True, False]


@pytest.mark.parametrize("candidates", [1, 10, 50])
def test_many_lines_have_together_the_chance_of_one_to_be_confirmed_by_noise(
    candidates: int,
) -> None:
    """Records of five seconds; within three deviations of the number that is to be expected."""
    line, records = peaks(swinging(0, 2.3, 0.25), 6.0)[0], 300
    seen = sum(confirmed(line, swinging(s, count=500), candidates) for s in range(1, 1 + records))
    expected = records * ALPHA / candidates
    assert seen <= expected + 3 * np.sqrt(expected)


@pytest.mark.parametrize(
    "names", [("stiffness",), ("link_inertia",), ("link_inertia", "stiffness", "link_viscous")]
)
def test_one_unit_of_a_parameter_changes_each_balance_by_its_column(names: tuple[str, ...]) -> None:
    """Of one parameter as of several."""
    time = 2e-3 * np.arange(1000)
    angle = {"motor_position": 1.001 * np.sin(1.3 * time), "link_position": np.sin(1.3 * time)}
    record = Record.from_channels(time, {**angle, "link_torque": np.cos(time)})
    joint = Joint(name="arm", gear_ratio=1.0, model_name="hd3", effects=("viscous@link",))
    model = prepared_model(joint, record)
    sensing = sense(record, model)
    rows = at_every_sample(record, joint, sensing)
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    law, slopes = _Pointwise(model, sensing), _Pointwise(model, sensing, names)
    before, columns = law.at(rows, values), slopes.at(rows, values)
    assert set(columns) == set(sensing.balances) == {"link", "transmission"}
    for k, name in enumerate(names):
        after = law.at(rows, {**values, name: values[name] + 1.0})
        for balance, own in columns.items():
            assert own.shape == (len(rows.time), len(names))
            assert own[:, k] == pytest.approx(after[balance] - before[balance], abs=1e-9)
        assert any(np.ptp(own[:, k]) > 0 for own in columns.values())


@pytest.mark.parametrize(("slow", "blocks"), [(True, 8), (False, 40)])
def test_what_runs_at_one_speed_tells_once_a_pass(slow: bool, blocks: int) -> None:
    # at one speed a hum keeps its phase to the angle from one end to the other
    dt = 4e-3
    time = dt * np.arange(10_000)
    passes = np.abs((time / 5.0) % 2.0 - 1.0)
    angle = 2.0 * (passes if slow else np.sin(0.9 * time) + 0.3 * np.sin(2.9 * time))
    joint = Joint(name="arm", gear_ratio=1.0, model_name="hd1", effects=("viscous@link",))
    record = Record.from_channels(time, {"link_position": angle, "link_torque": 0 * time})
    sensing = sense(record, prepared_model(joint, record))
    made = at_every_sample(record, joint, sensing).block
    assert abs(len(np.unique(made)) - blocks) <= 1
    assert np.array_equal(np.unique(made), np.arange(made.max() + 1)), "numbered without a gap"


def in_step(position: npt.NDArray[Any], dt: float) -> IntArray:
    """Blocks of one stretch."""
    time = np.asarray(dt * np.arange(len(position)), dtype=np.float64)
    return _in_step(time, position, np.array([0, len(position)]))


@pytest.mark.parametrize("rate", [64, 100, 512])
def test_what_changes_its_speed_tells_once_a_second_from_its_first_sample(rate: int) -> None:
    time = np.arange(20 * rate + rate // 3) / rate
    assert np.array_equal(in_step(np.exp(time), 1 / rate), time.astype(int))


@pytest.mark.parametrize("more", [2, 3, 10, 24])
def test_one_speed_is_one_block_from_two_samples_of_its_last_quarter_of_a_second_on(
    more: int,
) -> None:
    assert np.all(in_step(0.7 * np.arange(300 + more), 0.01) == 0)


def test_a_wobble_over_a_quarter_of_a_second_leaves_a_hum_in_step_with_the_angle() -> None:
    """The angle is a tenth of a period of 10 Hz off at most, and after a second not at all."""
    time = np.arange(5000) / 1000
    speed, beat = 3.0, 2 * np.pi * 4
    angle = speed * (time + 0.2 / beat * np.cos(beat * time))
    assert np.max(np.abs(angle / speed - time)) < 0.01
    assert np.ptp(np.gradient(angle, time)) > 0.35 * speed
    assert np.all(in_step(angle, 1e-3) == 0)


def test_a_late_reading_is_taken_at_its_time_as_in_the_rows() -> None:
    time, late = 2e-3 * np.arange(2000), 6e-3
    torque = np.sin(5 * (time - late))
    record = Record.from_channels(
        time,
        {
            "motor_position": 50 * np.sin(time),
            "link_position": np.sin(time),
            "link_torque": torque,
        },
    )
    joint = Joint(name="arm", gear_ratio=50.0, model_name="hd3")
    sensing = sense(record, prepared_model(joint, record))
    rows: Any = SimpleNamespace(shifts={OF_TORQUE: late}, name="arm")
    made = at_every_sample(record, joint, sensing, rows)
    assert made.shifts == {OF_TORQUE: pytest.approx(late)}
    assert made.points["torque"] == pytest.approx(np.sin(5 * made.time), abs=1e-9)
    plain = at_every_sample(record, joint, sensing)
    assert plain.shifts == {}
    assert plain.points["torque"] == pytest.approx(np.sin(5 * (plain.time - late)), abs=1e-9)


@pytest.mark.parametrize("jitter", [0.0, 0.2])
def test_samples_are_taken_as_they_are_unless_their_stamps_are_uneven(jitter: float) -> None:
    """A gap between two stretches makes no stretch uneven."""
    rng = np.random.default_rng(7)
    dt = 2e-3
    even = dt * np.concatenate([np.arange(1500), 4000 + np.arange(1500)])
    time = even + jitter * dt * rng.uniform(-1, 1, len(even))
    angle = np.sin(time) + 1e-9 * rng.standard_normal(len(time))
    record = Record.from_channels(
        time, {"link_position": angle, "link_torque": 0 * time, "run": np.arange(3000) // 1500}
    )
    joint = Joint(name="arm", gear_ratio=1.0, model_name="hd1", effects=("viscous@link",))
    made = at_every_sample(record, joint, sense(record, prepared_model(joint, record)))
    assert len(made.starts) == 3
    assert np.array_equal(made.stretch, np.repeat([0, 1], np.diff(made.starts))), "a row a sample"
    assert np.median(np.diff(made.time)) == pytest.approx(dt, rel=1e-3)
    inside = np.delete(np.diff(made.time), made.starts[1:-1] - 1)
    assert inside == pytest.approx(np.median(inside), rel=1e-6)
    speed = made.points["link_velocity"] - np.cos(made.time)
    apart = np.ones(len(speed), dtype=bool)
    for edge in made.starts:
        apart[max(edge - 10, 0) : edge + 10] = False
    assert np.abs(speed[apart]).max() < 2e-3
    if not jitter:
        assert np.array_equal(made.points["link_position"], angle)


def turning(time: FloatArray, angle: FloatArray) -> Record:
    """An arm whose link follows such a motion."""
    return Record.from_channels(time, {"link_position": angle, "link_torque": 0 * time})


def sampled(record: Record) -> WeakRecord:
    """Signals of such a record at every sample."""
    joint = Joint(name="arm", gear_ratio=1.0, model_name="hd1", effects=("viscous@link",))
    return at_every_sample(record, joint, sense(record, prepared_model(joint, record)))


@pytest.mark.parametrize("dt", [1e-3, 2e-3])
def test_smoothing_over_thirty_milliseconds_keeps_what_is_slower_and_drops_what_is_faster(
    dt: float,
) -> None:
    time = dt * np.arange(round(3.0 / dt))
    for period, least, most in ((0.12, 0.9, 1.0), (0.01, 0.0, 0.01)):
        made = sampled(turning(time, 0.5 * time + np.sin(2 * np.pi * time / period)))
        left = made.smooth["link_position"] - 0.5 * made.time
        inside = slice(200, -200)
        assert least <= np.abs(left[inside]).max() <= most


def test_stretches_that_are_too_short_have_no_sample() -> None:
    time = 2e-3 * np.concatenate([np.arange(40), 1000 + np.arange(40)])
    record = Record.from_channels(
        time,
        {"link_position": np.sin(time), "link_torque": 0 * time, "run": np.arange(80) // 40},
    )
    made = sampled(record)
    assert made.starts.tolist() == [0]
    assert {len(x) for x in (made.time, made.block, *made.points.values())} == {0}


def test_no_block_holds_samples_of_two_records() -> None:
    time = 2e-3 * np.arange(3000)
    runs = tuple(sampled(turning(time[:n], np.sin(2 * time[:n]))) for n in (1500, 3000, 2000))
    count = sum(len(w.time) for w in runs)
    block = _Joined(runs, np.zeros(count), 1.0).samples(1).block
    assert np.array_equal(np.unique(block), np.arange(block.max() + 1)), "numbered without a gap"
    parts = np.split(block, np.cumsum([len(w.time) for w in runs])[:-1])
    assert [len(np.unique(p)) for p in parts] == [len(np.unique(w.block)) for w in runs]
    assert sum(len(np.unique(p)) for p in parts) == len(np.unique(block))


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("share", [0.0, 0.04])
def test_the_steps_of_an_encoder_stand_at_its_counts_per_turn(told: bool, share: float) -> None:
    """Per turn of the motor: those of the link over the gear ratio, as far apart as the
    transmission winds up with the position. The record says what a step is, or its readings do.
    """
    counts, own, ratio = 4096, 200, 50.0
    time = 2e-3 * np.arange(4000)
    steps = {"motor_position": 2 * np.pi / own, "link_position": 2 * np.pi / counts}
    angle = {"motor_position": ratio * np.sin(1.3 * time)}
    angle["link_position"] = (1 - share) * np.sin(1.3 * time)
    read_out = {n: np.round(x / steps[n]) * steps[n] for n, x in angle.items()}
    record = Record.from_channels(time, {**read_out, "link_torque": 0 * time})
    record = replace(record, quanta=steps if told else {})
    joint = Joint(name="arm", gear_ratio=ratio, model_name="hd3")
    data: Any = SimpleNamespace(joint=joint)
    run = at_every_sample(record, joint, sense(record, prepared_model(joint, record)))
    bands = _encoder_orders(record, run, data)
    assert len(bands) == 6
    for k, (low, high) in enumerate(bands[:3], 1):
        assert (low + high) / 2 == pytest.approx(k * counts / ratio, rel=1e-3)
        assert (high - low) / (high + low) == pytest.approx(share, abs=0.01)
    for k, band in enumerate(bands[3:], 1):
        assert band == pytest.approx((k * own, k * own), rel=1e-3)
    still = replace(run, smooth={**run.smooth, "motor_position": 0 * run.time})
    assert all(low == high for low, high in _encoder_orders(record, still, data))


def test_rest_counts_for_nothing() -> None:
    samples = swinging(0, 2.3, 0.25)
    rest = np.full(4000, 12.0)
    longer = Samples(
        np.concatenate([samples.angle, rest]),
        np.concatenate([samples.residual, 9 + 0 * rest]),
        np.concatenate([samples.weight, 0 * rest]),
        np.concatenate([samples.block, np.full(4000, samples.block[-1])]),
    )
    assert peaks(longer, 6.0)[0].order == pytest.approx(peaks(samples, 6.0)[0].order, abs=1e-3)


def along(*parts: tuple[float, float], seed: int = 0) -> Samples:
    """White noise along a swinging angle, and lines of these orders and sizes in it."""
    noise = swinging(seed)
    lines = sum(size * np.sin(order * noise.angle + order) for order, size in parts)
    return replace(noise, residual=0.3 * noise.residual + lines)


def lines_in(
    monkeypatch: pytest.MonkeyPatch,
    samples: dict[str, Samples],
    joint: Joint,
    held: Samples | None = None,
) -> list[Line]:
    """What is found in the residuals of some balances of a joint."""
    tracked = [_Tracked(b, 1, s, lambda: held, 1e-2, direct=True) for b, s in samples.items()]
    monkeypatch.setattr("identification.diagnosis.lines._tracked", lambda *_: (tracked, ()))
    data: Any = SimpleNamespace(sensing=SimpleNamespace(clamped_link=False), joint=joint)
    nothing: Any = None
    return find_lines(nothing, data, [], [])


def test_a_line_in_two_balances_is_one_and_two_that_can_be_told_apart_are_two(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    axis = Joint("axis", "linear", model_name="hd1")
    apart = 2 * np.pi / swinging(0).stroke
    first, second = 2.3, 2.3 + 3.5 * apart
    both = {b: along((first, 1.0), (second, 0.7), seed=k) for k, b in enumerate(("motor", "link"))}
    found = lines_in(monkeypatch, both, axis)
    assert [x.order for x in found] == [
        pytest.approx(first, abs=apart / 2),
        pytest.approx(second, abs=apart / 2),
    ]
    # the order of one line may be off in each balance
    beside = {"motor": along((first, 1.0)), "link": along((first + 1.2 * apart, 0.8), seed=1)}
    assert len(lines_in(monkeypatch, beside, axis)) == 1


def test_a_joint_whose_residuals_are_noise_has_no_line_at_any_smoothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a hundred joints at most one has, all smoothings of a balance together: more than two of
    sixty happen once in forty times.
    """
    count = len(SMOOTHED)
    seen = sum(
        bool(
            lines_in(
                monkeypatch,
                {f"smoothed {n}": swinging(count * seed + k) for k, n in enumerate(SMOOTHED)},
                Joint("axis", "linear", model_name="hd1"),
            )
        )
        for seed in range(60)
    )
    assert seen <= 2, ALPHA


def test_a_line_is_one_of_all_records_and_of_all_of_the_stroke(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not one that held-out records do not have, nor one of half of the stroke."""
    axis, seen = Joint("axis", "linear", model_name="hd1"), along((2.3, 1.0))
    half = replace(seen, residual=np.where(seen.angle > 0, 2.0, 0.0) * seen.residual)
    held, other = along((2.3, 1.0), seed=1), along((3.1, 1.0), seed=1)
    assert len(peaks(half, 6.0, most=1)) == 1
    for samples, of_held, many in (
        (seen, None, 1),
        (seen, held, 1),
        (seen, other, 0),
        (half, None, 0),
        (half, held, 0),
    ):
        assert len(lines_in(monkeypatch, {"motor": samples}, axis, of_held)) == many


@pytest.mark.parametrize(("order", "many"), [(0.2, 0), (0.3, 1)])
def test_what_is_slower_than_a_quarter_of_a_turn_belongs_to_the_link(
    monkeypatch: pytest.MonkeyPatch, order: float, many: int
) -> None:
    seen = {"motor": along((order, 1.0))}
    assert len(lines_in(monkeypatch, seen, Joint(gear_ratio=100.0))) == many
    if many:
        # one period per turn of a screw of ten millimetres is a hundred per metre
        axis = Joint("axis", "linear", model_name="hd1", pitch=0.01)
        assert lines_in(monkeypatch, seen, axis) == []


def test_the_law_of_an_effect_is_tried_where_its_order_is_not_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nearer to the peak than half of what can be told apart; its own order is where it explains
    most.
    """
    peak = Peak(4.0, 1e-3, sine=1.0, cosine=0.0, prominence=99.0, apart=0.1, amplitude_error=0.1)
    tried: list[float] = []

    def gains(label: str, model: JointModel, orders: FloatArray, *_: object) -> FloatArray:
        tried.extend(orders)
        off = (orders - 4.017) / peak.apart
        return 100 * (1 - off**2) if label.startswith("torque_ripple") else 0 * off

    monkeypatch.setattr("identification.diagnosis.lines._gains", gains)
    model = JointModel.harmonic_drive(3)
    data: Any = SimpleNamespace(sensing=EVERY)
    solution: Any = SimpleNamespace(model=model)
    wide = replace(peak, error=0.02)
    names, order = _names(wide, 4.0, _Scan(solution, data, (), ()))
    assert names == ("torque_ripple",)
    assert order == pytest.approx(4.017, abs=1e-9)
    assert np.max(np.abs(np.array(tried) - 4.0)) < peak.apart / 2
    assert np.min(tried) < 4.0 < np.max(tried)


@pytest.mark.parametrize("at_its_order", [("kinematic_error",), ("torque_ripple",), ()])
def test_without_a_torque_sensor_a_line_has_the_names_that_are_declared_as_confused_once(
    at_its_order: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The laws of the others peak beside the order: the balances do not tell the sides apart."""
    peak = Peak(4.0, 1e-3, sine=1.0, cosine=0.0, prominence=99.0, apart=0.1, amplitude_error=0.1)

    def gains(label: str, model: JointModel, orders: FloatArray, *_: object) -> FloatArray:
        off = (orders - (4.0 if label.startswith(at_its_order) else 4.03)) / peak.apart
        return 100 * (1 - off**2)

    monkeypatch.setattr("identification.diagnosis.lines._gains", gains)
    data: Any = SimpleNamespace(sensing=replace(EVERY, has_torque=False))
    solution: Any = SimpleNamespace(model=JointModel.harmonic_drive(3))
    names, _ = _names(peak, 4.0, _Scan(solution, data, (), ()))
    assert sorted(names) == (["kinematic_error", "torque_ripple"] if at_its_order else [])
    assert names[:1] == at_its_order


def test_an_effect_that_is_a_line_is_tried_as_what_is_not_there_yet() -> None:
    """The first kinematic error with its virtual work and without; a further one as that one is."""
    plain, ripple = JointModel.harmonic_drive(3), JointModel.harmonic_drive(3).add("torque_ripple")
    four = replace(JointModel.harmonic_drive(4), virtual_work=False)

    def errors(model: JointModel) -> list[tuple[str, bool]]:
        made = line_models(model, EVERY)
        assert all(m.effects == (*model.effects, label) for _, label, m in made)
        return [(label, m.virtual_work) for key, label, m in made if key == "kinematic_error"]

    assert errors(plain) == [("kinematic_error", True), ("kinematic_error", False)]
    assert errors(ripple) == errors(plain)
    assert "torque_ripple#2" in [label for _, label, _ in line_models(ripple, EVERY)]
    assert errors(four) == [("kinematic_error#4", False)]


def test_two_records_at_rest_in_two_places_have_no_line() -> None:
    joint = Joint(name="arm", gear_ratio=1.0, model_name="hd1", effects=("viscous@link",))
    time = 2e-3 * np.arange(1000)
    runs = []
    for place in (0.0, 0.7):
        record = Record.from_channels(
            time, {"link_position": np.full(1000, place), "link_torque": np.cos(time)}
        )
        made = at_every_sample(record, joint, sense(record, prepared_model(joint, record)))
        still = {n: 0 * x for n, x in made.smooth.items() if n.endswith(("velocity", "jerk"))}
        runs.append(replace(made, smooth={**made.smooth, **still}))
    residual = np.concatenate([np.cos(w.time) for w in runs])
    for some in (runs, runs[1:]):
        joined = _Joined(tuple(some), residual[: 1000 * len(some)], 1.0)
        assert _without_trend("link", joined, lambda: None, direct=True) == []


CASES = (
    Case("torque_ripple", 2.0, 0.02, 125, "all"),
    Case("kinematic_error", 4.0, 0.02, 250, "all"),
    Case("torque_sensor_ripple", 1.0, 0.02, 100, "all"),
    Case("kinematic_error", 2.0, 0.02, 125, "both encoders"),
    Case("torque_ripple", 4.0, 0.03, 125, "motor only"),
    Case("torque_ripple", 100.0, 0.02, 100, "motor only", True, True),
    Case("torque_ripple", 62.5, 0.02, 250, "motor only", True, False),
    Case(None, 2.0, 0.0, 125, "all"),
    Case(None, 2.0, 0.0, 100, "motor only"),
    Case(None, 100.0, 0.0, 125, "motor only", True, True),
)


@cache
def judged() -> list[Result]:
    return results(77, CASES)


@pytest.mark.parametrize("which", range(len(CASES)))
def test_line_in_the_physics_is_found_and_named(which: int) -> None:
    found = judged()[which]
    case = found.case
    if case.effect is None:
        assert found.lines == ()
        return
    assert found.right is not None
    assert found.right.per == ("metre" if case.linear else "motor turn")
    if case.sensors == "all":
        assert found.right.effects == (case.effect,)
    elif case.linear and not case.pitch_known:
        assert found.right.effects == ()
    else:
        assert case.effect in found.right.effects
    if case.sensors != "motor only" or case.linear:
        assert found.size_error == pytest.approx(0.0, abs=0.2)


def test_json_of_a_line_has_the_agreed_keys() -> None:
    line = next(r.right for r in judged() if r.right is not None)
    said = line.as_json()
    assert {"order", "per", "tolerance", "amplitude", "unit", "effects", "balance"} <= set(said)
    assert said["amplitude_low"] < said["amplitude"] < said["amplitude_high"]


def test_known_orders_and_pitch_of_a_joint_file() -> None:
    axis = parse_joint(
        {
            "joint": {"kind": "linear", "model": "hd1"},
            "known": {"orders": [360], "pitch": {"value": 10.0, "unit": "mm"}},
        }
    )
    assert named_orders(axis) == pytest.approx((100.0, 200.0, 400.0, 360.0))
    assert named_orders(parse_joint(tomllib.loads(toml_text(axis)))) == pytest.approx(
        named_orders(axis)
    )
    screw = parse_joint(
        {"joint": {"kind": "linear", "model": "hd1", "gear_ratio": -2 * np.pi / 0.005}}
    )
    assert named_orders(screw)[0] == pytest.approx(200.0)
    assert named_orders(Joint("axis", "linear", model_name="hd1")) == ()
    assert named_orders(Joint(gear_ratio=100.0, orders=(7.5,))) == (1.0, 2.0, 4.0, 7.5)


@pytest.mark.parametrize(
    ("known", "said"),
    [
        ({"orders": [0.0]}, "orders"),
        ({"orders": 3.0}, "orders"),
        ({"pitch": {"value": 1.0, "unit": "rad"}}, "pitch"),
        ({"pitch": -0.01}, "pitch"),
    ],
)
def test_unusable_orders_and_pitch_are_refused_in_one_line(
    known: dict[str, object], said: str
) -> None:
    with pytest.raises(InputError, match=rf"\[known\] {said}") as raised:
        parse_joint({"joint": {"kind": "linear", "model": "hd1"}, "known": known})
    assert "\n" not in str(raised.value)


def test_a_pitch_belongs_to_a_linear_axis() -> None:
    with pytest.raises(InputError, match="linear"):
        parse_joint({"joint": {"model": "hd1"}, "known": {"pitch": 0.01}})


def test_the_order_of_a_named_line_is_where_its_effect_starts() -> None:
    line = next(
        r.right for r in judged() if r.case.linear and r.right is not None and r.right.effects
    )
    axis = Joint("axis", "linear", model_name="hd1", pitch=0.01)
    # one turn of the screw per pitch: the law counts periods per radian of an angle that is the
    # position itself
    assert orders_of([line], axis)["torque_ripple"] == pytest.approx([200 * np.pi], rel=0.01)


def test_a_line_without_a_name_says_what_would_give_it_one() -> None:
    """The travel per motor turn, where an axis has one that the joint file does not say."""
    named = next(r.right for r in judged() if r.case.linear and r.right is not None)
    line = replace(named, order=198.4, effects=())
    axis = Joint("axis", "linear", model_name="hd1")
    (said,) = without_turn([line, named], axis)
    assert "every 5.04 mm" in said
    assert "[known] pitch" in said
    assert without_turn([named], replace(axis, pitch=0.01)) == ()
    assert without_turn([line], replace(axis, pitch=0.01)) == ()
    assert without_turn([line], replace(axis, gear_ratio=200 * np.pi)) == ()
    assert without_turn([line], Joint(gear_ratio=100.0)) == ()
    assert without_turn([replace(line, effects=("torque_ripple",))], axis) == ()


@pytest.mark.parametrize("order", sorted(DERIVATIVE))
def test_the_rates_of_a_point_are_those_of_a_polynomial(order: int) -> None:
    """At its middle sample, of each power that the least squares take."""
    count, degree = DERIVATIVE[order]
    sample = np.arange(count, dtype=np.float64) - count // 2
    for power in range(degree + 1):
        exact = math.factorial(order) if power == order else 0.0
        scale = float(np.abs(sample**power).max())
        assert _polynomial(order) @ sample**power == pytest.approx(exact, abs=1e-12 * scale)
