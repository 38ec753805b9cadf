"""Noise with a memory, hum, heavy tails and wild samples: the floor is what each of them leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter

from identification import Joint, Record, fit
from identification.balance.colour import (
    ChannelNoise,
    Part,
    _two_shares,
    coloured,
    lines_in,
    spacings_of,
    white,
)
from identification.balance.noise import noise_of, spaced_levels
from identification.balance.spikes import without_spikes
from identification.balance.stamps import bridged, evened
from identification.balance.weak import kernel
from identification.fitting.assess import assess
from identification.fitting.engine import load_dataset, prepared_model
from tests.noise_bench import KINDS, filtered

FloatArray = npt.NDArray[np.float64]

DT, COUNT = 2e-3, 12_000
JOINT = Joint(name="arm", gear_ratio=1.0, model_name="hd1", effects=("viscous@link", "gravity"))
TIME = np.arange(COUNT) * DT
POSITION, TORQUE = 1e-4, 0.4


def motion() -> tuple[FloatArray, FloatArray]:
    """A link under a torque, in closed form; Coulomb friction turns with it."""
    angle = 2 * np.pi * np.outer([0.17, 0.45, 1.1, 1.9], TIME) + np.arange(4.0)[:, None]
    rate = 2 * np.pi * np.array([0.17, 0.45, 1.1, 1.9])
    size = np.array([0.5, 0.2, 0.1, 0.05])
    q, v, bend = size @ np.sin(angle), (size * rate) @ np.cos(angle), size * rate**2
    return q, -3.0 * (bend @ np.sin(angle)) + 4.0 * v - 30.0 * np.sin(q)


def read(channel: FloatArray) -> ChannelNoise:
    """What a record makes of the noise of a channel."""
    return noise_of(Record.from_channels(TIME, {"link_torque": channel}), "torque", channel, 1.0)


def record(kind: str, seed: int) -> Record:
    """The link through sensors with this noise."""
    rng = np.random.default_rng(seed)
    make, (q, torque) = KINDS[kind].noise, motion()
    step = KINDS[kind].step * TORQUE
    torque = torque + TORQUE * make(rng, COUNT)
    channels = {
        "link_position": q + POSITION * make(rng, COUNT),
        "link_torque": step * np.round(torque / step) if step else torque,
    }
    return Record.from_channels(TIME, channels, name=f"{kind} {seed}")


@pytest.mark.parametrize("size", [0.01, 0.1, 1.0])
def test_white_noise_on_a_motion_that_turns_stays_white(size: float) -> None:
    for seed in range(6):
        rng = np.random.default_rng(seed)
        q, torque = motion()
        turning = torque + 20.0 * np.tanh(200.0 * np.gradient(q) / DT)
        found = read(turning + size * TORQUE * rng.standard_normal(COUNT))
        assert found == white(found.level)
        assert found.level == pytest.approx(size * TORQUE, rel=0.1)


@pytest.mark.parametrize(("corner", "within"), [(8.0, 2.0), (20.0, 1.3), (50.0, 1.1)])
def test_noise_through_a_filter_is_read_with_its_memory(corner: float, within: float) -> None:
    # 16 ms show the memory of 3 ms whole, and of that of 20 ms the beginning
    rng = np.random.default_rng(int(corner))
    q, torque = motion()
    found = read(torque + 20.0 * np.sign(np.gradient(q)) + TORQUE * filtered(corner)(rng, COUNT))
    # density towards zero frequency, which is what the rows of a balance see
    slow = sum(p.size**2 * max(2 * p.stages * p.memory, DT) for p in found.parts)
    assert 1 / within < np.sqrt(slow) / (TORQUE / np.sqrt(np.pi * corner)) < within
    again = found.draw(rng, COUNT, DT)
    assert read(torque + again).level == pytest.approx(found.level, rel=0.1)


@pytest.mark.parametrize("runs", [1, 4, 40])
def test_a_noise_is_read_as_well_from_many_short_runs(runs: int) -> None:
    """The same samples, cut into runs: what is read counts them all."""
    rng = np.random.default_rng(7)
    torque = motion()[1] + TORQUE * filtered(20.0)(rng, COUNT)
    channels = {"link_torque": torque, "run": np.arange(COUNT) * runs // COUNT}
    found = noise_of(Record.from_channels(TIME, channels), "torque", torque, 1.0)
    slow = sum(p.size**2 * max(2 * p.stages * p.memory, DT) for p in found.parts)
    assert np.sqrt(slow) == pytest.approx(TORQUE / np.sqrt(np.pi * 20.0), rel=0.3)


@pytest.mark.parametrize("lost", [0.01, 0.05, 0.2])
@pytest.mark.parametrize("corner", [20.0, 50.0])
def test_lost_samples_take_nothing_off_a_noise_with_a_memory(corner: float, lost: float) -> None:
    rng = np.random.default_rng(int(corner + 100 * lost))
    channel = motion()[1] + TORQUE * filtered(corner)(rng, COUNT)
    there = rng.random(COUNT) >= lost
    which = np.where(there, np.cumsum(there) - 1, -1)
    held = bridged(TIME[there], channel[there, None], TIME, which)[:, 0]
    whole = Record.from_channels(TIME, {"link_torque": held})
    found = noise_of(replace(whole, measured=there), "torque", held, 1.0)
    slow, known = (
        np.sqrt(sum(p.size**2 * max(2 * p.stages * p.memory, DT) for p in n.parts))
        for n in (found, read(channel))
    )
    assert slow == pytest.approx(known, rel=0.2)
    assert found.level == pytest.approx(read(channel).level, rel=0.05)


def test_calm_stretches_with_lost_samples_show_a_slow_noise_whole() -> None:
    """Of 60 samples at a time that are calm, a fifth of them lost, the longest differences are few,
    and they are the ones that hold the noise: it read 0.8 of its size without them.
    """
    dt, count, memory = 4e-3, 10_000, 0.019
    spacings = spacings_of(dt, calm=True)
    calm = np.arange(count) % 60 != 0
    slow = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        noise = Part(TORQUE, memory).draw(rng, count, dt)
        there = rng.random(count) >= 0.2
        levels = spaced_levels(noise, [slice(0, count)], np.inf, spacings, there, calm)
        assert min(levels) > 0
        samples = int(np.sum(calm & there))
        found = coloured(noise, slice(0, count), dt, levels, samples, calm=True)
        slow.append(sum(p.size**2 * max(2 * p.stages * p.memory, dt) for p in found.parts))
    assert np.sqrt(np.median(slow) / (2 * memory)) == pytest.approx(TORQUE, rel=0.1)


def test_hum_is_told_from_noise_and_a_motion_has_none() -> None:
    rng = np.random.default_rng(3)
    torque = motion()[1] + TORQUE * rng.standard_normal(COUNT)
    found = read(torque + 0.7 * np.sin(2 * np.pi * 50.02 * TIME + 1.0))
    ((size, frequency),) = found.lines
    assert size == pytest.approx(0.7, rel=0.05)
    assert frequency == pytest.approx(50.02, abs=0.05)
    assert sum(p.size**2 for p in found.parts) == pytest.approx(TORQUE**2, rel=0.1)
    # a mode of the joint that rings after every knock is no hum
    knocks = np.zeros(COUNT)
    knocks[rng.integers(0, COUNT, 60)] = rng.standard_normal(60)
    ring = np.exp(-0.02 * 2 * np.pi * 40 * TIME[:2000]) * np.sin(2 * np.pi * 40 * TIME[:2000])
    assert read(torque + 3.0 * np.convolve(knocks, ring)[:COUNT]).lines == ()


@pytest.mark.parametrize(("wander", "many"), [(0.03, 1), (0.5, 0)])
def test_a_line_that_wanders_is_one_or_none(wander: float, many: int) -> None:
    """By more than the record resolves [Hz] it is no line, however many parts of it stand out."""
    rng, count, dt = np.random.default_rng(7), 40_000, 1e-3
    course = np.cumsum(rng.standard_normal(count))
    course = (course - course.mean()) / course.std()
    mains = np.sin(2 * np.pi * np.cumsum(50.0 + wander * course) * dt)
    assert len(lines_in(rng.standard_normal(count) + mains, dt, 33.0)) == many


@pytest.mark.parametrize("stops", [False, True])
def test_lines_that_beat_are_two_and_a_hump_is_none(stops: bool) -> None:
    """Each made the other impure; what is left out of a stop spreads a line."""
    rng, dt = np.random.default_rng(6), 0.016
    time = dt * np.arange(2500)
    kept = (time % 3.1 > 1.0) if stops else np.ones(len(time), dtype=bool)
    noise = 0.02 * rng.standard_normal(len(time))
    beating = 0.05 * np.sin(2 * np.pi * 11.57 * time) + 0.03 * np.sin(2 * np.pi * 10.97 * time)
    found = lines_in(np.where(kept, noise + beating, 0.0), dt, 5.0, kept)
    assert sorted(f for _, f in found) == pytest.approx([10.97, 11.57], abs=0.005)
    assert sorted(size for size, _ in found) == pytest.approx([0.03, 0.05], rel=0.1)
    pole = 0.99 * np.exp(2j * np.pi * 11.0 * dt)
    hump = lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], rng.standard_normal(len(time)))
    assert lines_in(np.where(kept, noise + 0.1 * hump, 0.0), dt, 5.0, kept) == []


def test_wild_samples_are_bridged_and_nothing_else_is_touched() -> None:
    rng = np.random.default_rng(4)
    q, torque = motion()
    calm = torque + 20.0 * np.sign(np.gradient(q)) + TORQUE * rng.standard_normal(COUNT)
    whole = (slice(0, COUNT),)
    assert without_spikes(calm, whole, TORQUE) is calm
    slow = np.abs(np.sin(TIME[::50])) + np.sign(np.sin(3 * TIME[::50]))
    assert without_spikes(slow, (slice(0, len(slow)),), 1e-9) is slow
    toggles = np.round(q / 0.05) * 0.05
    assert without_spikes(toggles, whole, 1e-4) is toggles
    hit = np.flatnonzero(rng.random(COUNT) < 0.005)
    spoilt = calm.copy()
    spoilt[hit] += rng.choice([-1.0, 1.0], len(hit)) * rng.uniform(10, 30, len(hit)) * TORQUE
    mended = without_spikes(spoilt, whole, TORQUE)
    left = np.ones(COUNT, dtype=bool)
    left[hit] = False
    assert np.array_equal(mended[left], calm[left])
    # one in thirty has another one beside it
    assert np.mean(np.abs(mended - calm)[hit] < 5 * TORQUE) > 0.95


@pytest.mark.parametrize("kind", [k for k in KINDS if k != "drift"])
def test_the_true_model_leaves_its_floor_under_every_kind_of_noise(kind: str) -> None:
    ratios = []
    for seed in (1, 2):
        one = record(kind, seed)
        data = load_dataset([one], [], JOINT, prepared_model(JOINT, one), kernel=0.12)
        solution = fit(JOINT, [one]).solution
        ratios.append(
            assess(solution.model, data, data.train, solution.values).balances["link"].ratio
        )
    assert all(0.85 < r < 1.2 for r in ratios), ratios


@pytest.mark.parametrize("kind", ["white", "filtered", "hum", "heavy"])
@pytest.mark.parametrize(("late", "lost"), [(0.0, 0.05), (0.1, 0.0), (0.1, 0.05), (0.05, 0.1)])
def test_late_and_lost_samples_do_not_hide_the_colour_of_the_noise(
    kind: str, late: float, lost: float
) -> None:
    # sampled at its stamps, brought to an even grid: what the cubics leave of a noise is smoother
    # than the noise, and a bridge is smoother still
    rng = np.random.default_rng(11)
    q, torque = motion()
    stamps = TIME + DT * np.clip(late * rng.standard_normal(COUNT), -0.4, 0.4)
    make = KINDS[kind].noise
    kept = rng.random(COUNT) >= lost
    kept[[0, -1]] = True
    channels = {
        "link_position": np.interp(stamps, TIME, q) + POSITION * make(rng, COUNT),
        "link_torque": np.interp(stamps, TIME, torque) + TORQUE * make(rng, COUNT),
    }
    one = evened(Record.from_channels(stamps[kept], {c: x[kept] for c, x in channels.items()}))
    assert one.measured is not None
    data = load_dataset([one], [], JOINT, prepared_model(JOINT, one), kernel=0.12)
    solution = fit(JOINT, [one]).solution
    ratio = assess(solution.model, data, data.train, solution.values).balances["link"].ratio
    assert 0.8 < ratio < 1.25, ratio


def test_noise_through_two_filters_in_a_row_is_read_too() -> None:
    rng = np.random.default_rng(8)
    drawn = ChannelNoise(1.0, (Part(TORQUE, 0.003, 2),)).draw(rng, COUNT, DT)
    assert np.std(drawn) == pytest.approx(TORQUE, rel=0.05)
    found = read(motion()[1] + drawn)
    assert any(p.stages == 2 for p in found.parts)
    slow = sum(p.size**2 * max(2 * p.stages * p.memory, DT) for p in found.parts)
    assert np.sqrt(slow) == pytest.approx(TORQUE * np.sqrt(4 * 0.003), rel=0.15)


@pytest.mark.parametrize(
    "noise",
    [
        white(0.4),
        ChannelNoise(0.2, (Part(0.2), Part(0.4, 0.003))),
        ChannelNoise(0.2, (Part(0.4, 0.004, 2),), ((0.3, 50.0),)),
    ],
)
def test_what_a_filter_leaves_of_a_noise_is_what_it_leaves_of_its_draws(
    noise: ChannelNoise,
) -> None:
    weights = kernel(0.02, DT, 1)
    drawn = noise.draw(np.random.default_rng(2), 100_000, DT)
    assert noise.after(weights, DT) == pytest.approx(
        np.std(np.convolve(drawn, weights, "valid")), rel=0.02
    )


@pytest.mark.parametrize("stages", [1, 2])
def test_a_drawn_course_is_white_noise_through_low_passes(stages: int) -> None:
    from scipy.signal import lfilter

    memory, dt = 7e-3, 1e-3
    course = Part(1.0, memory, stages).draw(np.random.default_rng(5), COUNT, dt)
    pole = np.exp(-dt / memory)
    long = np.random.default_rng(5).standard_normal(COUNT + 70)
    for _ in range(stages):
        long = lfilter([1.0], [1.0, -pole], long)
    kept = long[70:]
    size = float(course @ kept / (kept @ kept))
    assert np.abs(course - size * kept).max() < 1e-12
    assert abs(np.std(course) - 1.0) < 0.1


def test_two_shares_are_the_least_squares_that_are_not_negative() -> None:
    from scipy.optimize import nnls

    rng, borders = np.random.default_rng(6), 0
    for _ in range(200):
        columns, power = rng.uniform(0.1, 1.0, (8, 2)), rng.uniform(0.1, 1.0, 8)
        columns[:, 0] = rng.uniform(1.0, 50.0)
        shares, left = nnls(columns, power)
        found, mine = _two_shares(columns, power)
        assert abs(found - left**2) < 1e-12
        assert np.abs(shares - mine).max() < 1e-12
        borders += bool(mine.min() == 0.0)
    assert 10 < borders < 190, "both kinds were there"


@pytest.mark.parametrize("unit", [5e-8, 1e-3, 0.1, np.pi / 180, 1 / 7, 3.0])
def test_a_sample_exactly_at_the_limit_is_no_spike_in_any_unit(unit: float) -> None:
    """Off by twice the range of its neighbours, in whole steps of a converter."""
    counts = np.array([*range(20), *[0, 10] * 30], dtype=float)
    for size, spikes in ((20.0, []), (20.5, [41])):
        counts[41] = size
        values = 0.1 + unit * counts
        mended = without_spikes(values, (slice(0, len(values)),), 0.01 * unit)
        assert np.flatnonzero(mended != values).tolist() == spikes
