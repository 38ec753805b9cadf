"""Kernels, noise level, vectorised evaluation: the numerics under the balances."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import EFFECTS, JointModel
from casadi_models.vectorised import Vectorised
from identification.balance.memory import Cache
from identification.balance.noise import noise_level
from identification.balance.weak import _blocks, differentiated_kernel, kernel, prepare, whole

FloatArray = npt.NDArray[np.float64]


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_kernel_gives_the_derivative_of_polynomials(order: int) -> None:
    dt, length = 1e-3, 0.06
    weights = differentiated_kernel(length, dt, order)
    t = (np.arange(len(weights)) - len(weights) // 2) * dt
    for power in range(order + 1):
        expected = float(np.prod(np.arange(1, order + 1))) if power == order else 0.0
        assert weights @ t**power == pytest.approx(
            expected, abs=1e-7 * max(1.0, float(np.abs(weights).sum()))
        )


def test_average_of_a_derivative_is_the_derivative_of_the_average() -> None:
    t = np.arange(0, 4, 1e-3)
    q, v, a = np.sin(5 * t), 5 * np.cos(5 * t), -25 * np.sin(5 * t)
    data = prepare(t, {"motor_position": q}, (slice(0, len(t)),))
    plain = differentiated_kernel(0.06, 1e-3, 0)
    assert data.averaged["motor_velocity"] == pytest.approx(data.grid.correlate(v, plain), abs=1e-6)
    assert data.averaged["motor_acceleration"] == pytest.approx(
        data.grid.correlate(a, plain), abs=1e-5
    )
    inner = slice(30, -30)
    assert data.points["motor_velocity"][inner] == pytest.approx(v[::2][inner], abs=2e-3)


@pytest.mark.parametrize("dt", [5e-4, 1e-3, 2e-3])
def test_a_fast_law_at_the_points_has_the_average_of_its_samples(dt: float) -> None:
    """Ripple at 200 rad/s, three waves to the kernel: a kernel a thirtieth wider would lose a tenth
    of what is left of it.
    """
    t = np.arange(0, 4, dt)
    data = prepare(t, {"motor_position": np.sin(t)}, (slice(0, len(t)),))
    fast = np.sin(200 * t)
    samples = data.grid.correlate(fast, differentiated_kernel(data.grid.length, dt, 0))
    points = data.average(fast[:: data.grid.step])
    assert np.abs(points - samples).max() < 1e-3 * np.abs(samples).max()


def test_a_stretch_begins_after_each_gap_and_ends_half_a_kernel_from_it() -> None:
    dt, long = 1e-3, 0.1
    time = np.concatenate([np.arange(0, 2, dt), np.arange(10, 13, dt), np.arange(20, 21, dt)])
    parts = (slice(0, 2000), slice(2000, 5000), slice(5000, 6000))
    made = prepare(time, {"motor_position": np.sin(time)}, parts, pointwise=long)
    after = np.concatenate([[False], np.diff(made.time) > 1.0])
    assert np.sum(after) == 2
    assert np.array_equal(made.begins, after)
    for part in parts:
        begin, end = time[part][0], time[part][-1]
        rows = made.time[(made.time >= begin) & (made.time <= end)]
        assert rows[0] - begin == pytest.approx(long / 2, abs=8 * dt)
        assert end - rows[-1] == pytest.approx(long / 2, abs=8 * dt + made.grid.stride * dt)


def test_no_row_and_no_block_spans_two_segments() -> None:
    t = np.concatenate([np.arange(0, 2, 1e-3), np.arange(10, 13, 1e-3)])
    data = prepare(t, {"motor_position": np.sin(t)}, (slice(0, 2000), slice(2000, 5000)))
    assert not np.any((data.time > 1.98) & (data.time < 10.02))
    first, second = set(data.block[data.time < 5]), set(data.block[data.time > 5])
    assert first & second <= {-1}


def test_noise_level_of_white_and_of_quantised_noise() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(0, 10, 1e-3)
    smooth = np.sin(2 * t)
    assert noise_level(
        smooth + 0.01 * rng.standard_normal(len(t)), (slice(0, len(t)),)
    ) == pytest.approx(0.01, rel=0.07)
    step = 1e-3
    quantised = np.round((smooth + 2e-3 * rng.standard_normal(len(t))) / step) * step
    assert noise_level(quantised, (slice(0, len(t)),)) == pytest.approx(
        np.hypot(2e-3, step / np.sqrt(12)), rel=0.1
    )


@pytest.mark.parametrize("key", sorted(EFFECTS))
def test_vectorised_evaluation_equals_casadi(key: str) -> None:
    model = (
        JointModel(gear_ratio=-160.0).add("transmission_compliance")
        if key != "transmission_compliance"
        else JointModel(gear_ratio=-160.0)
    )
    model = model.add(key)
    e = model.equations
    out = ca.vertcat(
        e.motor_resistance, e.link_resistance, e.transmitted, e.drive, e.torque, e.torsion
    )
    function = ca.Function("f", [e.signals.vector(), e.memory, e.parameters, e.clock], [out])
    rng = np.random.default_rng(0)
    points = 40
    signals = rng.standard_normal((e.signals.vector().shape[0], points))
    memory = rng.uniform(-1, 1, (e.memory.shape[0], points))
    values = np.abs(rng.standard_normal(e.parameters.shape[0])) + 0.1
    fast = Vectorised(function)(points, signals, memory, values, np.array([1e-3]))
    slow = np.array(function(signals, memory, values, 1e-3))
    assert fast == pytest.approx(slow, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_kernel_of_the_points_is_exact_for_polynomials(order: int) -> None:
    weights = kernel(0.03, 1e-3, order)
    t = (np.arange(len(weights)) - len(weights) // 2) / 15  # half of the kernel is one
    for power in range(order + 2):
        expected = math.factorial(order) / 0.015**order if power == order else 0.0
        assert weights @ t**power == pytest.approx(expected, abs=1e-9 / 0.015**order)


@pytest.mark.parametrize("step", [1e-3, 2e-3, 4e-3, 5e-3])
def test_the_last_digit_of_a_clock_makes_no_row_more_or_less(step: float) -> None:
    """Kernels of 10 to 200 ms hold halves of a sample at usual rates."""
    rng = np.random.default_rng(0)
    for length in (0.01, 0.014, 0.02, 0.03, 0.06, 0.2):
        for parts in (2, 4):
            exact = length / step / parts
            near = [length / (step * (1 + e)) / parts for e in 1e-9 * rng.standard_normal(50)]
            assert {whole(x) for x in near} == {math.floor(exact + 0.5 + 1e-6)}
    count = 3000
    shapes = set()
    for begin in (0.0, 1234.5, 0.1):
        time = begin + np.arange(count) * step
        signals = {"motor_position": np.sin(3 * time), "drive": np.cos(time)}
        made = prepare(time, signals, (slice(0, count),), length=0.06)
        shapes.add((made.rows, made.grid.stride, made.grid.half))
    assert len(shapes) == 1


@pytest.mark.parametrize("place", [0.1, 1.0, 1234.5678])
def test_a_joint_at_rest_has_no_velocity_wherever_it_stands(place: float) -> None:
    """Rounding of the position would turn it now one way and now the other."""
    time = np.arange(4000) * 1e-3
    position = place + 0.3 * np.maximum(time - 2.0, 0.0) ** 3
    made = prepare(time, {"motor_position": position}, (slice(0, 4000),))
    still = made.grid.dt * made.grid.step * np.arange(len(made.points["motor_velocity"])) < 1.9
    assert np.all(made.points["motor_velocity"][still] == 0.0)
    assert np.all(made.averaged["motor_acceleration"][made.time < 1.9] == 0.0)
    assert made.points["motor_velocity"][~still].max() == pytest.approx(3.6, rel=0.03)


@pytest.mark.parametrize("unit", [1.0, np.pi / 180, 1e-3])
def test_steps_of_an_encoder_that_cancel_are_no_velocity(unit: float) -> None:
    """There and back within a kernel, its middle at the turn: rounding would give it a sign."""
    time = np.arange(400) * 1e-3
    steps = np.rint(7 * np.sin(2 * np.pi * (time - 0.2) / 0.05) ** 2)  # even about 0.2 s
    made = prepare(time, {"motor_position": 0.1 * steps * unit}, (slice(0, 400),), length=0.02)
    speed = made.points["motor_velocity"]
    at = round(0.2 / (made.grid.dt * made.grid.step))
    assert speed[at] == 0.0
    assert np.abs(speed).max() > 1.0 * unit


@pytest.mark.parametrize("count", range(2000, 2048, 4))
def test_blocks_are_even_and_no_row_reaches_over_their_ends(count: int) -> None:
    """Two stretches of 4 s and 2 s in blocks of about 1.5 s: three and one. A row lies a few
    samples from the next: of some lengths one lies so that it would reach over by a single sample.
    """
    time = np.concatenate([np.arange(count) * 2e-3, 10 + np.arange(1000) * 2e-3])
    parts = (slice(0, count), slice(count, count + 1000))
    made = prepare(time, {"motor_position": np.sin(time)}, parts, first_block=5)
    first = made.time < 5
    assert set(made.block[first]) == {-1, 5, 6, 7}
    assert set(made.block[~first]) == {8}
    begun, ended = made.time[first][0], made.time[first][-1]
    width = (ended - begun) / 3
    inside = made.block >= 0
    reach = (made.grid.half - 1) * made.grid.dt
    for k in range(3):
        rows = made.time[first & (made.block == 5 + k)]
        low, high = begun + k * width, begun + (k + 1) * width
        # the ends of a stretch are ends of blocks already
        assert rows.min() == pytest.approx(low + (reach if k else 0.0), abs=0.03)
        assert rows.max() == pytest.approx(high - (reach if k < 2 else 0.0), abs=0.03)
        assert k == 0 or rows.min() >= low + reach - 1e-9
        assert k == 2 or rows.max() <= high - reach + 1e-9
    lost = made.time[first & ~inside]
    ends = begun + width * np.array([1.0, 2.0])
    assert np.all(np.min(np.abs(lost[:, None] - ends), axis=1) < reach)


def test_short_blocks_keep_three_quarters_of_their_rows() -> None:
    time = np.arange(3000) * 1e-3
    made = prepare(time, {"motor_position": np.sin(time)}, (slice(0, 3000),), block=0.2)
    assert np.mean(made.block >= 0) == pytest.approx(0.75, abs=0.05)
    assert made.block.max() + 1 == round((made.time[-1] - made.time[0]) / 0.2)


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_a_stretch_of_few_rows_is_a_block_of_its_own_and_all_of_it(rows: int) -> None:
    time = np.concatenate([np.arange(40) * 0.1, 10 + np.arange(rows) * 0.1])
    segment = np.repeat([0, 1], [40, rows])
    number, inside = _blocks(time, segment, 2.0, 0.05)
    assert set(number[:40]) == {0, 1}
    assert number[40:].tolist() == [2] * rows
    assert inside[40:].all()


@pytest.mark.parametrize("step", [1, 5, 7, 11])
def test_an_average_of_every_so_many_samples_ends_where_that_of_all_does(step: int) -> None:
    every, some = (differentiated_kernel(0.06, 1e-3, 0, step=k) for k in (1, step))
    reach = len(every) // 2 + 1
    outside = np.abs(np.arange(len(some)) - len(some) // 2) * step >= reach
    assert some.sum() == pytest.approx(1.0)
    assert np.all(np.abs(some[outside]) < 1e-12)
    here = some[~outside]
    there = every[np.abs(np.arange(len(every)) - len(every) // 2) % step == 0]
    assert here / here.max() == pytest.approx((there / there.max())[: len(here)], abs=1e-12)


def test_time_and_temperature_of_a_row_are_those_at_its_middle() -> None:
    """Of signals that rise evenly, over both stretches of a record."""
    time = np.concatenate([1e-3 * np.arange(1000), 10 + 1e-3 * np.arange(1000)])
    signals = {"motor_position": np.sin(time), "temperature": 300.0 + 0.5 * time}
    made = prepare(time, signals, (slice(0, 1000), slice(1000, 2000)))
    assert made.averaged["time"] == pytest.approx(made.time, abs=1e-9)
    assert made.averaged["temperature"] == pytest.approx(300.0 + 0.5 * made.time, abs=1e-9)
    assert made.points["temperature"] == pytest.approx(300.0 + 0.5 * made.points["time"])


def test_a_record_without_a_stretch_that_is_long_enough_has_no_row_and_no_point() -> None:
    time = np.linspace(0.0, 0.059, 60)
    signals = {"motor_position": np.sin(time), "temperature": 300.0 + time}
    made = prepare(time, signals, (slice(0, 30), slice(30, 60)))
    assert made.rows == 0
    every = (made.averaged, made.points, made.smooth)
    assert {len(x) for of in every for x in of.values()} == {0}


def test_a_signal_that_is_given_no_kernel_has_that_of_thirty_milliseconds() -> None:
    time = np.arange(2000) * 1e-3
    signals = {"motor_position": np.sin(time), "link_position": np.sin(time)}
    made = prepare(time, signals, (slice(0, 2000),), pointwise={"motor_position": 0.01})
    assert made.grid.pointwise["motor_position"] == 0.01
    assert made.grid.pointwise["link_position"] == 0.03


def test_averages_and_curvatures_of_the_points_are_exact_for_polynomials() -> None:
    time = np.arange(2000) * 1e-3
    made = prepare(time, {"motor_position": np.sin(time)}, (slice(0, 2000),))
    t = made.points["time"]
    assert made.average(np.ones_like(t)) == pytest.approx(1.0)
    assert made.average(t) == pytest.approx(made.time, abs=1e-9)
    assert made.curve(3 * t**2 + t - 1) == pytest.approx(6.0, rel=1e-9)
    both = made.curve(np.column_stack([t, t**2]))
    assert both == pytest.approx(np.tile([0.0, 2.0], (made.rows, 1)), abs=1e-8)


@pytest.mark.parametrize(
    ("dt", "samples"), [(1e-3, 8), (2e-3, 8), (4e-3, 8), (2.5e-4, 40), (1e-4, 100)]
)
def test_a_kernel_of_few_points_reaches_over_no_end_of_a_stretch(dt: float, samples: int) -> None:
    """A second derivative takes more points than the kernel has where these are half as many as its
    samples, or many samples apart.
    """
    time = dt * np.arange(1500)
    parts = (slice(0, 700), slice(700, 1500))
    beside = np.where(np.arange(1500) < 700, time, 1e6 * time)
    made = prepare(time, {"motor_position": time}, parts, length=samples * dt, pointwise=2 * dt)
    t, of_points = made.points["time"], beside[:: made.grid.step]
    first = made.stretch == 0
    for matrix in (made.averaging, made.curving):  # a point outside would be another one's memory
        assert matrix.indices.min() >= 0 and matrix.indices.max() < len(t)
    assert made.curve(t**2) == pytest.approx(2.0, abs=1e-6)
    assert made.average(of_points)[first] == pytest.approx(made.time[first], abs=1e-9)
    assert made.curve(of_points)[first] == pytest.approx(0.0, abs=1e-6)


def test_a_stretch_of_two_kernels_has_rows_and_one_of_a_kernel_none() -> None:
    time = 1e-3 * np.arange(3000)
    parts = (slice(0, 120), slice(120, 180), slice(180, 3000))
    made = prepare(time, {"motor_position": np.sin(time)}, parts, length=0.06)
    assert np.sum(made.time < time[120]) > 2
    assert not np.any((made.time >= time[120]) & (made.time < time[180]))
    assert made.starts.tolist() == [0, 60, 60 + 2820 // made.grid.step]


@pytest.mark.parametrize(("length", "dt"), [(0.06, 1e-3), (0.06, 4e-3), (0.03, 2e-3)])
@pytest.mark.parametrize("make", [kernel, differentiated_kernel])
def test_the_kernel_wipes_out_three_and_more_whole_waves(
    make: Callable[[float, float, int], FloatArray], length: float, dt: float
) -> None:
    """Of c cos^4 over its width, the one that ends where the next samples would be, two thirds of
    one wave are left and a sixth of two.
    """
    weights = make(length, dt, 0)
    count = len(weights) + 1
    assert abs(count * dt - length) < 3.5 * dt
    phase = 2 * math.pi * np.outer(np.arange(6), np.arange(1, count) - count / 2) / count
    assert np.cos(phase) @ weights == pytest.approx([1, 2 / 3, 1 / 6, 0, 0, 0], abs=1e-12)


@pytest.mark.parametrize("order", [0, 1, 2, 3, 4])
def test_a_kernel_too_short_for_its_derivative_is_the_shortest_that_has_it(order: int) -> None:
    """Two points more than the order on either side, over the width that these span."""
    dt = 2e-3
    shortest = differentiated_kernel(2 * (order + 2) * dt, dt, order)
    assert len(shortest) == 2 * (order + 2) + 1
    for length in (0.5 * dt, 2 * dt, 3.9 * dt):
        assert np.array_equal(differentiated_kernel(length, dt, order), shortest)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_every_derivative_of_the_kernel_averages_that_of_a_fast_wave(order: int) -> None:
    dt, omega = 1e-4, 2 * math.pi * 12
    mean, found = (differentiated_kernel(0.06, dt, k) for k in (0, order))
    t = dt * (np.arange(len(mean)) - len(mean) // 2)
    truth = omega**order * np.sin(omega * t + 0.4 + order * math.pi / 2)
    averaged = float(found @ np.sin(omega * t + 0.4))
    assert averaged == pytest.approx(float(mean @ truth), rel=2e-3)


def test_a_row_of_which_less_than_half_was_measured_takes_no_part() -> None:
    time = np.arange(0, 2, 1e-3)
    made = prepare(time, {"motor_position": np.sin(time)}, (slice(0, 2000),))
    assert made.taking("axis").all(), "where nothing was bridged"
    gap = (made.points["time"] > 0.8) & (made.points["time"] < 0.9)
    part = made.average(np.where(gap, 0.0, 1.0))
    taking = replace(made, support=part).taking("axis")
    assert np.array_equal(taking, part >= 0.5)
    # as many as stand in the gap
    assert np.ptp(made.time[~taking]) == pytest.approx(0.1, abs=1.5 * made.grid.stride * 1e-3)


def test_no_row_is_off_by_more_than_a_hundredth_of_what_may_hold_a_joint_at_rest() -> None:
    """Whatever holds it there, up to the limit of its friction; rows that a rest touches with their
    edge alone take part.
    """
    time = np.arange(0, 4, 1e-3)
    made = prepare(time, {"motor_position": np.sin(time)}, (slice(0, 4000),), overlap=30)
    t, rng, limit = made.points["time"], np.random.default_rng(2), 20.0
    still = ((t > 1.0) & (t < 1.5)) | ((t > 2.0) & (t < 2.02))
    taking = replace(made, rest={"motor": made.average(still.astype(float))}).taking("axis")
    for holding in (np.full(len(t), limit), limit * rng.uniform(-1, 1, len(t))):
        off = np.abs(made.average(np.where(still, holding, 0.0)))
        assert np.max(off[taking]) <= 0.01 * limit
    touched = made.average(still.astype(float)) > 1e-6
    assert np.sum(taking & touched) > 4


def test_a_record_made_of_an_earlier_one_is_the_one_made_anew() -> None:
    """Whichever signals have moved, and whether they jump between two samples."""
    time = np.arange(0, 2, 1e-3)
    before = {
        "motor_position": np.sin(time),
        "torque": np.sign(np.sin(9 * time)),
        "drive": np.sign(np.cos(7 * time)),
    }
    earlier = prepare(time, before, (slice(0, 2000),), curved=True)
    for moved in (("torque",), ("drive",), ("motor_position", "torque"), ()):
        after = {n: np.roll(x, 3) if n in moved else x for n, x in before.items()}
        same = set(before) - set(moved)
        made = prepare(time, after, (slice(0, 2000),), curved=True, before=earlier, same=same)
        anew = prepare(time, after, (slice(0, 2000),), curved=True)
        for kind in ("averaged", "points", "smooth", "curved", "between"):
            own, other = getattr(made, kind), getattr(anew, kind)
            assert set(own) == set(other)
            for name, values in own.items():
                assert np.array_equal(values, other[name]), (kind, name, moved)
        for name in moved:
            assert np.any(made.averaged[name] != earlier.averaged[name])


def test_what_was_made_of_a_record_goes_with_the_record() -> None:
    class Thing:
        pass

    cache: Cache[str] = Cache()
    first, second = Thing(), Thing()
    for thing in (first, second):
        assert cache.get(thing, "law", lambda: ("made", 3), 100) == "made"
    assert (len(cache.kept), cache.size) == (2, 6)
    del first, thing
    assert cache.get(second, "law", lambda: ("new", 3), 100) == "made"
    assert (len(cache.kept), cache.size) == (1, 3)
    third = Thing()  # it may have the place in memory that the first one had
    assert cache.get(third, "law", lambda: ("other", 5), 100) == "other"
    assert (len(cache.kept), cache.size) == (2, 8)
