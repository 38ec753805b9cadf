"""The parts of order tracking against numbers that are known without it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from identification.diagnosis.lines import _noise, _Tracked, held_out_drop, highest_order
from identification.diagnosis.order_tracking import (
    FEWEST_CYCLES,
    FINEST,
    MEDIAN_EFFICIENCY,
    NAMED_WITHIN,
    NEAREST,
    OUTLIER,
    PARTS,
    SURROUNDINGS,
    Peak,
    Samples,
    apart_from_slow,
    background,
    beside,
    clipped,
    confirmed,
    everywhere,
    independent_orders,
    peaks,
    phase_fit,
    refined,
    spectrum,
    threshold,
    trend,
    velocity_knots,
)

COUNT = 6000


def along(angle: np.ndarray, residual: np.ndarray, weight: np.ndarray | None = None) -> Samples:
    """Samples in blocks of a hundred."""
    ones = np.ones(len(angle)) if weight is None else weight
    return Samples(angle, residual, ones, np.arange(len(angle)) // 100)


def line(order: float = 3.0, sine: float = 0.6, cosine: float = -0.8, **changed: float) -> Peak:
    given = {"error": 0.01, "prominence": 400.0, "apart": 0.1, "amplitude_error": 0.05}
    return Peak(order, sine=sine, cosine=cosine, **{**given, **changed})


def test_a_line_is_its_sine_and_cosine_of_the_angle() -> None:
    angle = np.linspace(-4.0, 7.0, 50)
    assert line().amplitude == pytest.approx(1.0)
    assert line().certainty == pytest.approx(0.5 * 20.0**2)
    wave = line().wave(along(angle, 0 * angle))
    assert wave == pytest.approx(0.6 * np.sin(3 * angle) - 0.8 * np.cos(3 * angle), abs=1e-12)


def test_a_line_lies_at_an_order_within_its_error_and_nearer_than_the_next() -> None:
    near = NAMED_WITHIN * 0.01
    assert line().at(3.0 + 0.99 * near)
    assert not line().at(3.0 + 1.01 * near)
    assert not line().at(3.0 - 1.01 * near)
    assert not line(error=1.0).at(3.06), "as near to the next one"
    assert line(error=1.0).at(3.04)


def test_stroke_of_an_even_spread_is_its_span_and_rest_has_no_weight_in_it() -> None:
    angle = np.linspace(5.0, 25.0, COUNT)
    assert along(angle, 0 * angle).stroke == pytest.approx(20.0, rel=1e-3)
    rest = np.concatenate([angle, np.full(COUNT, 24.0)])
    weight = np.concatenate([np.ones(COUNT), np.zeros(COUNT)])
    assert along(rest, 0 * rest, weight).stroke == pytest.approx(20.0, rel=1e-3)
    assert along(angle, 0 * angle, 0 * angle).stroke == 0.0
    assert independent_orders(2.0, 7.0, 20.0) == pytest.approx(5.0 * 20.0 / (2 * math.pi))
    assert independent_orders(2.0, 2.1, 20.0) == 1.0, "all of them are one"


def test_trend_takes_out_what_it_is_made_of() -> None:
    rng = np.random.default_rng(1)
    time = np.linspace(0.0, 40.0, COUNT)
    angle, velocity = 9 + 5 * np.sin(time), 5 * np.cos(time)
    acceleration = -5 * np.sin(time) + rng.standard_normal(COUNT)
    knots = velocity_knots(velocity)
    small = 0.01 * np.abs(velocity).max()
    assert np.sum(np.abs(knots) <= small * (1 + 1e-9)) == 2, "a step of its own at zero"
    assert knots[0] == pytest.approx(velocity.min())
    assert knots[-1] == pytest.approx(velocity.max())
    columns = trend(angle, velocity, acceleration, knots, (4.0, 14.0))
    assert columns.shape == (COUNT, len(knots) + 4)
    assert np.sum(columns[:, : len(knots)], axis=1) == pytest.approx(1.0), "the hats share one"
    x = (angle - 9.0) / 5.0
    assert columns[:, -4:-1] == pytest.approx(np.column_stack([x, x**2, x**3]), abs=1e-12)
    assert np.abs(columns[:, -1]).max() == pytest.approx(1.0)
    slow = 3 * np.interp(velocity, knots, np.sin(knots)) + 2 * x - x**3 + 0.1 * acceleration
    weight = np.where(rng.random(COUNT) < 0.3, 0.0, 1.0)
    spoilt = np.where(weight > 0, slow, 1e3)
    left = beside(columns, weight)(spoilt)
    assert left[weight > 0] == pytest.approx(0.0, abs=1e-9)


def between_two_places(rate: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Moves to and fro: the velocity is a function of the position."""
    time = np.linspace(0.0, 40.0, COUNT)
    return 14 * np.sin(rate * time), 14 * rate * np.cos(rate * time)


def test_what_the_trend_takes_of_a_line_is_no_line_of_its_own() -> None:
    angle, velocity = between_two_places()
    knots = velocity_knots(velocity)
    columns = trend(angle, velocity, -angle, knots, (-14.0, 14.0))
    weight = np.abs(velocity)
    taken = beside(columns, weight)
    wave = np.sin(0.75 * angle + 1.0)
    samples = replace(along(angle, taken(wave), weight), seen=taken)
    lost = float(np.sum(weight * (wave - samples.residual) ** 2) / np.sum(weight * wave**2))
    assert lost > 0.01, "a motion whose trend holds something of the line"
    sine, cosine = phase_fit(0.75, samples)
    assert (sine, cosine) == pytest.approx((math.cos(1.0), math.sin(1.0)), rel=1e-6)
    found = replace(line(0.75), sine=sine, cosine=cosine)
    assert samples.residual - found.wave(samples) == pytest.approx(0.0, abs=1e-6)
    whole = found.wave(along(angle, wave, weight))
    assert np.abs(samples.residual - whole).max() > 0.1


def test_outliers_are_cut_at_robust_deviations_of_what_counts() -> None:
    rng = np.random.default_rng(2)
    residual = 0.3 * rng.standard_normal(COUNT)
    residual[::50] = 40.0
    weight = np.ones(COUNT)
    weight[1::2] = 0.0
    residual[1::2] *= 100
    cut = clipped(along(np.arange(COUNT) * 0.01, residual, weight))
    assert np.abs(cut.residual).max() == pytest.approx(OUTLIER * 0.3, rel=0.1)
    inside = np.abs(residual) < 1.0
    assert np.array_equal(cut.residual[inside], residual[inside])
    assert np.array_equal(clipped(along(residual, residual, 0 * weight)).residual, 0 * residual)


def test_scan_is_the_power_of_the_samples_over_even_orders() -> None:
    angle = np.linspace(-3.0, 37.0, COUNT)
    samples = along(angle, 0.7 * np.sin(6.0 * angle + 0.4), np.full(COUNT, 0.5))
    orders, power = spectrum(samples, 10.0)
    assert orders[0] == 0.0
    assert orders[-1] <= 10.0 < orders[-1] + 2 * orders[1]
    assert np.diff(orders) == pytest.approx(orders[1])
    k = int(np.argmax(power))
    at = refined(orders, power, k)
    assert at == pytest.approx(6.0, abs=0.02 * 2 * math.pi / 40.0)
    assert power[k] == pytest.approx((0.5 * COUNT * 0.7 / 2) ** 2, rel=0.06)
    # between the points it is what the sum of exp(i h angle) gives
    base = samples.residual * samples.weight
    direct = [abs(np.sum(base * np.exp(-1j * h * angle))) ** 2 for h in orders[k - 3 : k + 4]]
    assert power[k - 3 : k + 4] == pytest.approx(direct, rel=0.05)


@pytest.mark.parametrize("bins", [2.5, 5.5, 8.5, 16.5, 33.5, 64.5])
def test_a_scan_has_four_points_to_an_independent_order_however_short_the_stroke(
    bins: float,
) -> None:
    highest = 6.0
    span = bins * 2 * math.pi / highest / FINEST
    angle = np.linspace(3.0, 3.0 + span, COUNT)
    orders, _ = spectrum(along(angle, np.cos(highest * angle)), highest)
    assert 4 * orders[1] <= 2 * math.pi / span


def test_a_peak_between_points_is_that_of_their_parabola() -> None:
    orders = np.arange(10) * 0.2
    power = 10 - 3 * (orders - 0.87) ** 2
    assert refined(orders, power, 4) == pytest.approx(0.87, abs=1e-12)
    assert refined(orders, power, 0) == 0.0
    assert refined(orders, power, 9) == pytest.approx(1.8)
    assert refined(orders, np.ones(10), 4) == pytest.approx(0.8)


def test_phase_is_that_of_the_samples_that_count_beside_any_level() -> None:
    angle = np.linspace(0.0, 30.0, COUNT)
    weight = np.where(np.arange(COUNT) % 3 == 0, 0.0, 1.0)
    residual = 5.0 + 0.3 * np.sin(2.2 * angle) - 0.4 * np.cos(2.2 * angle) + 100 * (weight == 0)
    assert phase_fit(2.2, along(angle, residual, weight)) == pytest.approx((0.3, -0.4), abs=1e-9)


@pytest.mark.parametrize("fall", [0.0, 1.0])
def test_background_is_the_mean_power_of_noise(fall: float) -> None:
    """Of exponential powers whose mean falls with the order, peaks left out."""
    rng = np.random.default_rng(5)
    stroke = 2 * math.pi * 10
    orders = np.arange(4000) * 0.1 / 4  # four points to an independent order
    mean = 7.0 / (1 + orders) ** fall
    power = np.repeat(rng.exponential(size=1000), 4) * mean
    lowest = FEWEST_CYCLES * 0.1
    level = background(orders, power, stroke, lowest)
    first = int(np.searchsorted(orders, lowest))
    assert np.all(level[:first] == level[first])
    ratio = level[first + 20 :] / mean[first + 20 :]
    assert np.median(ratio) == pytest.approx(1.1, rel=0.15), "the larger one of two sides"
    assert ratio[200:].min() > 0.6
    assert ratio[:-400].max() < 3.0
    # one line changes nothing but the rank of a median
    loud = power.copy()
    loud[2000:2004] *= 1e6
    assert background(orders, loud, stroke, lowest) == pytest.approx(level, rel=0.35)


@pytest.mark.parametrize("way", [-1, 1])
def test_the_louder_side_counts_at_every_order_that_has_one(way: int) -> None:
    """Power without any scatter that falls or rises: its side towards the loud end stands over it
    and is half of its surroundings away.
    """
    orders = np.arange(4000) * 0.1 / 4  # four points to an independent order
    power = np.exp(way * 0.02 * orders)
    first, near, far = 8, 4 * NEAREST, 4 * SURROUNDINGS
    level = background(orders, power, 2 * math.pi * 10, orders[first]) * math.log(2)
    inside = slice(first + far, -far)
    there = np.exp(0.02 * orders[(near + far) // 2])
    assert level[inside] / power[inside] == pytest.approx(there, rel=0.01)
    if way < 0:  # from a few orders on the loud end has a side towards it
        few = slice(first + 2 * near + 16, first + far)
        assert np.all(level[few] > power[few])
    else:  # at the loud end only the other side is there
        assert level[-far:] == pytest.approx(power[-far:] / there, rel=0.01)


def test_the_side_of_a_low_order_ends_where_its_own_lobe_begins() -> None:
    """A plateau over the lobe of one order is no background of that order."""
    orders = np.arange(4000) * 0.1 / 4  # four points to an independent order
    near, first = 4 * NEAREST, 8
    for k in (first + 2 * near + 10, first + 3 * near):
        power = np.ones(len(orders))
        power[k - near : k + near] = 1e6
        level = background(orders, power, 2 * math.pi * 10, orders[first])
        assert level[k] == pytest.approx(1 / math.log(2))


def test_background_of_few_orders_is_one_level() -> None:
    orders = np.arange(100) * 0.025
    power = np.random.default_rng(6).exponential(3.0, size=100)
    level = background(orders, power, 2 * math.pi * 10, 0.2)
    assert np.ptp(level) == 0.0
    assert level[0] == pytest.approx(float(np.median(power[8:])) / math.log(2))


def test_noise_passes_the_threshold_with_its_chance() -> None:
    """An exponential power over the mean of so many others."""
    rng = np.random.default_rng(7)
    others = 2 * (SURROUNDINGS - NEAREST) * MEDIAN_EFFICIENCY
    level = rng.gamma(others, 1 / others, size=400_000)
    over = np.mean(rng.exponential(size=400_000) / level > threshold(0.01, 1.0))
    assert over == pytest.approx(0.01, rel=0.1)
    assert threshold(0.01, 10.0) == pytest.approx(threshold(0.001, 1.0))
    assert threshold(0.01, 0.0) == threshold(0.01, 1.0)


def test_where_nothing_moves_there_is_no_line() -> None:
    still = np.full(COUNT, 3.0)
    assert peaks(along(still, np.random.default_rng(0).standard_normal(COUNT)), 6.0) == []
    short = np.linspace(0.0, 1.0, COUNT)
    assert peaks(along(short, np.sin(4 * short)), 6.0) == [], "no order has its cycles"


def test_two_lines_are_both_found_the_strongest_first() -> None:
    rng = np.random.default_rng(8)
    angle = 40 * np.sin(0.01 * np.arange(COUNT)) + 7 * np.sin(0.037 * np.arange(COUNT))
    weight = np.abs(np.gradient(angle))
    residual = 0.5 * np.sin(2.0 * angle) + 0.9 * np.cos(3.5 * angle) + rng.standard_normal(COUNT)
    found = peaks(along(angle, residual, weight), 6.0)
    assert [round(p.order, 2) for p in found[:2]] == [3.5, 2.0]
    assert [round(p.amplitude, 1) for p in found[:2]] == [0.9, 0.5]
    assert [p.prominence for p in found] == sorted((p.prominence for p in found), reverse=True)
    assert len(peaks(along(angle, residual, weight), 6.0, most=1)) == 1
    assert all(p.order > 2.5 for p in peaks(along(angle, residual, weight), 6.0, lowest=2.5))


@pytest.mark.parametrize(
    ("cycles", "anywhere", "by_name"), [(1.5, 0, 0), (3.0, 0, 1), (5.0, 1, 1), (12.3, 1, 1)]
)
def test_an_order_without_a_name_needs_four_periods_over_the_stroke_and_a_named_one_two(
    cycles: float, anywhere: int, by_name: int
) -> None:
    """What is slower is the trend over the position; lines one over the stroke apart are two."""
    angle = 37.0 * (1 - np.abs(np.arange(COUNT) / (COUNT / 2) - 1))
    noise = 0.1 * np.random.default_rng(3).standard_normal(COUNT)
    order = 2 * math.pi * cycles / 37.0
    samples = along(angle, np.sin(order * angle + 0.3) + noise)
    assert len(peaks(samples, 6.0, most=1)) == anywhere
    found = peaks(samples, 0.0, (order,), most=1)
    assert len(found) == by_name
    for one in found:
        assert one.order == pytest.approx(order, abs=one.apart / 20)
        assert one.apart == pytest.approx(2 * math.pi / 37.0, rel=0.01)


@pytest.mark.parametrize("where", ["everywhere", "one end", "one direction", "turned"])
def test_a_line_is_everywhere_or_none(where: str) -> None:
    rng = np.random.default_rng(9)
    angle = 30 * np.sin(0.01 * np.arange(COUNT) + 0.2)
    forward = np.gradient(angle) > 0
    wave = np.sin(2.0 * angle)
    shown = {
        "everywhere": wave,
        "one end": np.where(angle > 10, 3 * wave, 0.0),
        "one direction": np.where(forward, 2 * wave, 0.0),
        "turned": np.where(angle > 0, wave, -wave),
    }[where]
    samples = along(angle, shown + 0.2 * rng.standard_normal(COUNT), np.abs(np.gradient(angle)))
    peak = line(2.0, 1.0, 0.0, prominence=2000.0, apart=2 * math.pi / samples.stroke)
    assert everywhere(peak, [], samples) == (where == "everywhere")


@pytest.mark.parametrize(("deviations", "stands"), [(1.8, True), (2.2, False)])
@pytest.mark.parametrize(("limit", "beyond"), [(0.5, -1), (2.0, 1)])
@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("forward", [True, False])
def test_a_part_contradicts_a_line_from_two_errors_of_white_noise_under_half_or_over_twice_of_it(
    forward: bool, part: int, limit: float, beyond: int, deviations: float, stands: bool
) -> None:
    # to and fro at one speed: each part of the stroke has as many samples either way
    angle = 30 * (1 - np.abs(np.arange(COUNT) / (COUNT / 2) - 1))
    cells = 2 * PARTS
    here = (angle // (30 / PARTS) == part) & ((np.arange(COUNT) < COUNT / 2) == forward)
    prominence = 75.0
    # a line of unit size has the power (n / 2)^2 and noise of unit variance n: by the prominence
    # the variance of the noise is n / 4 z, and of the size in a part 2 / (n / parts) times that
    error = math.sqrt(COUNT / (4 * prominence) * 2 / (COUNT / cells))
    wave = np.sin(2 * math.pi * angle)
    shown = np.where(here, (limit + beyond * deviations * error) * wave, wave)
    peak = line(2 * math.pi, 1.0, 0.0, prominence=prominence)
    assert everywhere(peak, [], along(angle, shown)) == stands


def test_a_larger_line_beside_another_is_no_contradiction_in_a_part_of_the_stroke() -> None:
    """Over a third of the stroke lines five independent orders apart are not independent."""
    angle = 30 * (1 - np.abs(np.arange(COUNT) / (COUNT / 2) - 1))
    apart = 2 * math.pi / 30
    small = line(2 * math.pi, 1.0, 0.0, prominence=1e4, apart=apart)
    large = replace(small, order=small.order + 5 * apart, sine=3.0, cosine=4.0)
    shown = sum(p.wave(along(angle, angle)) for p in (small, large))
    samples = along(angle, shown)
    assert not everywhere(small, [], samples)
    assert everywhere(small, [large], samples)
    # what cannot be told apart there counts beside it only where it is known beforehand
    near = replace(large, order=small.order + 2 * apart)
    samples = along(angle, small.wave(samples) + near.wave(samples))
    assert not everywhere(small, [near], samples)
    assert everywhere(small, [near], samples, (near.order,))


def test_a_part_in_which_two_lines_are_one_contradicts_neither() -> None:
    """All of it at one end; but whose it is nobody can tell."""
    angle = 30 * (1 - np.abs(np.arange(COUNT) / (COUNT / 2) - 1))
    one = line(2 * math.pi, 1.0, 0.0, prominence=1e6)
    twin = replace(one, sine=2.0)
    samples = along(angle, np.where(angle > 20, one.wave(along(angle, angle)), 0.0))
    assert not everywhere(one, [], samples)
    assert everywhere(one, [twin], samples, (one.order,))


def test_a_part_without_a_sample_contradicts_no_line() -> None:
    angle = np.linspace(0.0, 30.0, COUNT)
    peak = line(2 * math.pi, 1.0, 0.0, prominence=1e6)
    assert everywhere(peak, [], along(angle, peak.wave(along(angle, angle))))


def at_whole_periods(share: float, beside: float, size: float) -> tuple[Peak, Samples, float]:
    """A line of which whole periods lie between two samples in all but a share of the blocks, and
    of which those beside have a part.
    """
    dt, order = 0.01, 2.0
    still = np.arange(COUNT) // 100 % 20 >= round(20 * share)
    speed = 2 * math.pi / order * np.where(still, 1.0, 1.37)
    angle = np.cumsum(speed)
    peak = line(order, 0.6 * size, -0.8 * size)
    wave = peak.wave(along(angle, angle))
    return peak, along(angle, np.where(still, wave, beside * wave)), dt


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("named", [True, False])
def test_a_line_is_there_beside_the_samples_in_which_it_stands_still(
    named: bool, size: float
) -> None:
    for share in (0.25, 0.5):
        peak, samples, dt = at_whole_periods(share, 1.0, size)
        assert apart_from_slow(peak, samples, dt, named=named), "all samples have it"
        peak, samples, dt = at_whole_periods(share, 0.0, size)
        assert not apart_from_slow(peak, samples, dt, named=named), "a drift where it stands still"
    # a twentieth of the samples tells nothing: only what is known beforehand is kept
    peak, samples, dt = at_whole_periods(0.05, 0.0, size)
    assert apart_from_slow(peak, samples, dt, named=named) == named


def test_nothing_stands_still_in_samples_between_which_less_than_half_a_period_lies() -> None:
    angle = np.cumsum(0.02 * (1 + np.sin(0.01 * np.arange(COUNT))))
    samples = along(angle, line().wave(along(angle, angle)))
    assert apart_from_slow(line(), samples, 0.01, named=False)
    none = replace(samples, residual=0 * angle)
    assert not apart_from_slow(line(), none, 0.01, named=True)


def test_no_line_is_more_certain_than_it_stands_over_its_surroundings() -> None:
    angle = 40 * np.sin(0.01 * np.arange(COUNT)) + 7 * np.sin(0.037 * np.arange(COUNT))
    weight = np.abs(np.gradient(angle))
    for seed in range(12):
        noise = np.random.default_rng(seed).standard_normal(COUNT)
        for found in peaks(along(angle, 0.5 * np.sin(2.3 * angle) + noise, weight), 6.0):
            assert found.certainty <= found.prominence * (1 + 1e-9)
            # Cramer-Rao bound of the frequency of a sine of that power
            least = math.sqrt(6 / found.prominence) * found.apart / (2 * math.pi)
            assert found.error >= least * (1 - 1e-9)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize(
    ("times", "stands"), [(0.3, False), (0.7, True), (1.0, True), (1.6, True), (3.0, False)]
)
def test_held_out_samples_confirm_a_line_of_up_to_twice_its_size_in_any_unit(
    times: float, stands: bool, unit: float
) -> None:
    angle = np.linspace(0.0, 300.0, COUNT)
    found = line(2.0, 0.6 * unit, -0.8 * unit)
    noise = 0.2 * unit * np.random.default_rng(4).standard_normal(COUNT)
    samples = along(angle, times * found.wave(along(angle, angle)) + noise)
    assert confirmed(found, samples, 1) == stands


def test_what_a_line_takes_off_held_out_samples() -> None:
    angle = np.linspace(0.0, 50.0, COUNT)
    weight = np.where(np.arange(COUNT) % 2 == 0, 2.0, 1.0)
    wave = line().wave(along(angle, 0 * angle))
    assert held_out_drop(line(), along(angle, 2 * wave, weight)) == pytest.approx(50.0)
    assert held_out_drop(line(), along(angle, wave, weight)) == pytest.approx(100.0)
    assert held_out_drop(line(), along(angle, -wave, weight)) == pytest.approx(-100.0)
    assert held_out_drop(line(), None) == 0.0


def test_the_error_of_a_line_is_the_scatter_of_its_phase_in_noise() -> None:
    angle = 40 * np.sin(0.01 * np.arange(COUNT)) + 7 * np.sin(0.037 * np.arange(COUNT))
    weight = np.abs(np.gradient(angle))
    sines, errors = [], []
    for seed in range(150):
        noise = np.random.default_rng(seed).standard_normal(COUNT)
        samples = along(angle, noise, weight)
        sines.append(phase_fit(2.3, samples)[0])
        if seed < 6:
            tracked = _Tracked("motor", 1, samples, lambda: None, 1e-2, direct=True)
            errors.append(_noise(line(2.3), tracked))
    assert np.mean(errors) == pytest.approx(np.sqrt(np.mean(np.square(sines))), rel=0.2)


@pytest.mark.parametrize("slower", [1.0, 1e-2, 1e-4])
def test_half_of_the_sampling_rate_is_a_higher_order_the_slower_the_joint_is(slower: float) -> None:
    """At one speed pi / (dt speed); what hardly moves beside it does not count."""
    weight = slower * np.where(np.arange(COUNT) % 3 == 0, 1e-3, 5.0)
    samples = along(np.arange(COUNT) * 0.1, np.ones(COUNT), weight)
    assert highest_order(samples, 0.01) == pytest.approx(math.pi / (0.01 * slower * 5.0))
    assert highest_order(along(samples.angle, samples.residual, 0 * weight), 0.01) == 0.0


def test_noise_that_rises_with_the_order_is_seen_beyond_half_of_the_sampling_rate() -> None:
    """There, too, the level has surroundings above it."""
    angle = 40 * np.sin(0.011 * np.arange(2000)) + 7 * np.sin(0.037 * np.arange(2000))
    weight = np.abs(np.gradient(angle))
    rng = np.random.default_rng(3)
    sines, errors = [], []
    for seed in range(60):
        orders = rng.uniform(0.0, 6.0, 150)
        phase = np.outer(orders, angle) + rng.uniform(0, 2 * math.pi, (150, 1))
        samples = along(angle, orders @ np.sin(phase), weight)
        sines.append(phase_fit(2.3, samples)[0])
        if seed < 12:
            coarse = _Tracked("motor", 1, samples, lambda: None, 10.0, direct=True)
            assert highest_order(samples, coarse.dt) < 2.3
            errors.append(_noise(line(2.3), coarse))
    assert 0.9 < np.mean(errors) / np.sqrt(np.mean(np.square(sines))) < 2.0


def test_the_error_of_an_order_is_the_scatter_of_the_orders() -> None:
    angle = 40 * np.sin(0.01 * np.arange(COUNT)) + 7 * np.sin(0.037 * np.arange(COUNT))
    weight = np.abs(np.gradient(angle))
    off = []
    for seed in range(30):
        noise = np.random.default_rng(seed).standard_normal(COUNT)
        found = peaks(along(angle, 0.4 * np.sin(2.3 * angle) + noise, weight), 6.0, most=1)[0]
        off.append((found.order - 2.3) / found.error)
    # the larger one of two estimates of the error, so rather too large
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.4


def test_the_error_of_an_order_in_white_noise_is_that_of_the_frequency_of_a_sine() -> None:
    """Cramer-Rao bound over n even samples: the variance is 24 (noise / size)^2 / n / stroke^2."""
    angle, size, noise = np.linspace(0.0, 300.0, COUNT), 0.2, 1.0
    rng, errors = np.random.default_rng(11), []
    for _ in range(20):
        residual = size * np.sin(2.3 * angle) + noise * rng.standard_normal(COUNT)
        errors.append(peaks(along(angle, residual), 6.0, most=1)[0].error)
    bound = math.sqrt(24 / COUNT) * noise / size / 300.0
    assert np.mean(errors) == pytest.approx(bound, rel=0.2)


def test_a_phase_that_changes_from_block_to_block_moves_an_order_within_its_error() -> None:
    """A straight line through the phases of the blocks has this scatter of its slope."""
    angle, blocks, deviation = np.linspace(0.0, 300.0, COUNT), 20, 0.3
    block = np.arange(COUNT) * blocks // COUNT
    slope = deviation / 300.0 * math.sqrt(12 / blocks)
    off, errors = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        phase = deviation * rng.standard_normal(blocks)
        residual = np.sin(2.3 * angle + phase[block]) + 0.02 * rng.standard_normal(COUNT)
        samples = replace(along(angle, residual), block=block)
        found = peaks(samples, 6.0, most=1)[0]
        off.append(found.order - 2.3)
        errors.append(found.error)
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(slope, rel=0.25)
    assert np.mean(errors) == pytest.approx(slope, rel=0.25)


def test_an_order_that_nobody_named_needs_its_periods_whatever_chance_noise_is_given() -> None:
    angle = np.linspace(0.0, 300.0, COUNT)
    for seed in range(10):
        samples = along(angle, np.random.default_rng(seed).standard_normal(COUNT))
        found = peaks(samples, 6.0, alpha=0.5)
        assert all(p.order > 3.5 * 2 * math.pi / 300.0 for p in found)
