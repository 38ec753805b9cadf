"""Noise floors: uneven stamps, records of several rates; standard errors from few blocks; what
noise takes off a parameter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from identification import Record, fit
from identification.balance.balances import balances_of
from identification.balance.clocks import shifted
from identification.balance.colour import white
from identification.balance.drawn_noise import LONGEST, draws_of, excerpt
from identification.balance.excitation import attenuation, excitation_warnings
from identification.balance.noise import noise_level
from identification.balance.stacked import (
    TURN_KERNEL,
    TURN_SHARE,
    _between_samples,
    _either_direction,
    _either_way,
    support_of,
    unsure,
)
from identification.balance.stamps import bridged_over
from identification.balance.weak import prepare
from identification.data.joint_file import Joint
from identification.diagnosis.improvement import judged_drop, made_worse
from identification.fitting.assess import BalanceError, Error, assess
from identification.fitting.covariance import BLOCK, window_errors, windows_over
from identification.fitting.engine import load_dataset, prepared_model, rms
from tests.identification.diagnosis.test_other_payload import FAST, JOINT, record

FloatArray = npt.NDArray[np.float64]


@pytest.mark.parametrize("jitter", [0.0, 0.02, 0.1, 0.3])
def test_motion_between_uneven_stamps_is_no_noise(jitter: float) -> None:
    rng = np.random.default_rng(4)
    stamps = np.arange(8000) * 2e-3
    stamps = stamps + jitter * 2e-3 * rng.uniform(-1, 1, len(stamps))
    values = 160 * np.sin(2.0 * stamps) + 1e-3 * rng.standard_normal(len(stamps))
    whole = (slice(0, len(stamps)),)
    assert noise_level(values, whole, stamps) == pytest.approx(1e-3, rel=0.07)
    if jitter:
        assert noise_level(values, whole) > 3e-3


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_each_record_has_the_floor_of_its_own_rate(factor: int) -> None:
    """Of white noise, which moves readings by steps of their own: what steps alone take off a slow
    motion is the same at any rate.
    """
    healthy = {n: record(n, seed, False, *FAST) for n, seed in (("train", 3), ("other rate", 7))}
    rng = np.random.default_rng(2)
    for name, made in healthy.items():
        shaken = made["link_position"] + 2 * np.pi / 100_000 * rng.standard_normal(len(made))
        healthy[name] = made.with_channel("link_position", shaken)
    train, other = healthy["train"], healthy["other rate"]
    held = Record.from_channels(
        other.time[::factor], {c: x[::factor] for c, x in other.channels.items()}, name="other rate"
    )
    model = prepared_model(JOINT, train)
    solution = fit(JOINT, [train]).solution
    data = load_dataset([train], [held], JOINT, model)
    errors = assess(solution.model, data, data.held_out, solution.values).balances
    for balance in ("link", "transmission"):
        assert 0.8 < errors[balance].ratio < 1.2
    single = assess(solution.model, data, data.train, solution.values).balances
    assert errors["transmission"].floor == pytest.approx(
        single["transmission"].floor * np.sqrt(factor), rel=0.15
    )


STEP = 0.02
"""Between rows [s]."""


@pytest.mark.parametrize("blocks", [5, 10, 40])
def test_twice_the_error_is_a_band_of_95_percent_with_few_windows_too(blocks: int) -> None:
    rng = np.random.default_rng(blocks)
    parameters, kernel = 6, np.ones(5) / 5
    rows = round(blocks * BLOCK / STEP)
    # columns that vary slowly, as in a joint: within a window they depend on each other
    jacobian = np.column_stack(
        [np.sin(0.01 * (k + 1) * np.arange(rows) + k) for k in range(parameters)]
    )
    windows = windows_over([STEP * np.arange(rows)])
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    inside = total = 0
    for _ in range(300):
        noise = np.convolve(rng.standard_normal(rows + 4), kernel, mode="valid")
        found = inverse @ (jacobian.T @ noise)
        error = window_errors(jacobian, noise - jacobian @ found, windows)
        assert error is not None
        inside += int(np.sum(np.abs(found) < 2 * error))
        total += parameters
    assert 0.92 < inside / total < 0.995


def test_too_few_windows_give_no_error() -> None:
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 2 * BLOCK, STEP)
    rows = rng.standard_normal((len(time), 3))
    assert window_errors(rows[:, :2], rows[:, 2], windows_over([time])) is None


def test_a_short_record_is_fitted_without_standard_errors() -> None:
    short = record("short", 3, False, *FAST).take(slice(0, 2000))
    found = fit(JOINT, [short])
    assert all(found.solution.stderr[n] is None for n in ("link_inertia", "stiffness"))
    assert found.solution.values["stiffness"] == pytest.approx(2.2e4, rel=0.05)


def test_what_noise_would_take_off_an_inertia_is_said_and_taken_off() -> None:
    clean = record("clean", 3, False, *FAST)
    noisy: list[Record] = []
    rng = np.random.default_rng(8)
    for size in (1e-4, 4e-4):
        noisy.append(
            clean.with_channel(
                "link_position", clean["link_position"] + size * rng.standard_normal(len(clean))
            )
        )
    for spoilt in noisy:
        data = load_dataset([spoilt], [], JOINT, prepared_model(JOINT, spoilt))
        solution = fit(JOINT, [spoilt]).solution
        found, error = solution.values["link_inertia"], solution.stderr["link_inertia"]
        assert error is not None
        assert abs(found - 3.0) < 3 * error
        assert 3 * error < 3.0 * attenuation(data)["link inertia"]
        assert any("link inertia by about" in w for w in excitation_warnings(data))


def test_a_direction_that_one_window_alone_tells_of_does_not_spoil_the_errors_of_the_others() -> (
    None
):
    rng = np.random.default_rng(5)
    time = np.arange(0.0, 20 * BLOCK, STEP)
    once = np.abs(time - 10 * BLOCK) < BLOCK / 6
    jacobian = rng.standard_normal((len(time), 3))
    jacobian[:, 2] = np.where(once, jacobian[:, 2] + jacobian[:, 0], 0.0)
    noise, windows = rng.standard_normal(len(time)), windows_over([time])
    found = np.linalg.lstsq(jacobian, noise, rcond=None)[0]
    together = window_errors(jacobian, noise - jacobian @ found, windows)
    without = jacobian[:, :2]
    alone = window_errors(
        without, noise - without @ np.linalg.lstsq(without, noise, rcond=None)[0], windows
    )
    assert together is not None
    assert alone is not None
    assert together[:2] == pytest.approx(alone, rel=0.3)


def test_an_addition_is_judged_by_what_it_leaves_and_not_by_its_floor() -> None:
    def error(size: float, floor: float, believed: float = 1.0) -> Error:
        residual = size * np.cos(np.arange(400.0))
        weight = np.full(400, 1 / floor)
        return Error(
            100 * size,
            0.0,
            0.0,
            {
                "motor": BalanceError(
                    rms(residual),
                    floor,
                    rms(residual) / floor,
                    "N.m",
                    residual,
                    weight,
                    believed=believed,
                )
            },
        )

    assert made_worse(error(1.0, 0.5), error(0.9, 0.01)) == ""
    assert judged_drop(error(1.0, 0.5), error(0.9, 0.01), "motor") == pytest.approx(10.0)
    # but what takes noise alone from a balance of noise alone explains nothing of it
    assert judged_drop(error(0.9, 1.0), error(0.6, 0.65), "motor") < 0
    assert judged_drop(error(0.9, 1.0), error(0.6, 1.0), "motor") == pytest.approx(100 / 3)
    # a floor that is lower because less is left than such noise: a ripple was read as noise
    assert judged_drop(error(0.9, 1.0), error(0.6, 0.65, 0.65), "motor") == pytest.approx(100 / 3)
    assert judged_drop(error(0.9, 1.0), error(0.3, 0.4, 0.8), "motor") == pytest.approx(100 / 3)
    assert made_worse(error(0.9, 1.0), error(0.2, 0.05)).startswith("what was noise in the motor")
    assert made_worse(error(0.9, 1.0), error(0.2, 0.05, 0.05)) == ""
    assert "motor" in made_worse(error(1.0, 0.01), error(1.3, 0.5))
    assert made_worse(error(0.1, 1.0), error(0.1, 1.0)) == ""
    assert made_worse(error(1.0, 0.5), error(1.05, 0.5)).startswith("the held-out error rises")


def test_rows_that_noise_leaves_open_refuse_nothing() -> None:
    """Where a turn falls between two samples the noise allows a row nearly anything: what happens
    there is not weighed against a fall in all others.
    """
    turns = np.arange(400) % 20 == 0

    def error(size: float, at_turns: float) -> Error:
        residual = np.where(turns, at_turns, size)
        weight = np.where(turns, 0.01, 1.0)
        weighted = rms(residual * weight) / rms(weight)
        return Error(
            float(np.linalg.norm(residual)),
            0.0,
            0.0,
            {"motor": BalanceError(weighted, 0.1, weighted / 0.1, "N.m", residual, weight)},
        )

    before, after = error(0.5, 10.0), error(0.3, 10.5)
    assert after.relative_error_percent > 1.02 * before.relative_error_percent
    assert made_worse(before, after) == ""
    assert made_worse(error(0.5, 10.0), error(0.52, 9.0)).startswith("the held-out error rises")


def test_a_rise_to_what_noise_leaves_is_none() -> None:
    """Beside the missing friction of the motor noise is taken off the rows, and the link's inertia
    is half as much again, as it is in truth: it passes more of the encoder's noise on.
    """

    def error(motor: float, link: float, floor: float) -> Error:
        left = {"motor": (motor, 0.1), "link": (link, floor)}
        return Error(
            0.0,
            0.0,
            0.0,
            {
                b: BalanceError(x, f, x / f, "N.m", np.full(4, x), np.ones(4))
                for b, (x, f) in left.items()
            },
        )

    before = error(0.7, 3.3, 2.8)
    assert made_worse(before, error(0.1, 4.2, 4.2)) == ""
    assert "link" in made_worse(before, error(0.1, 4.2, 2.8))
    assert "motor" in made_worse(before, error(0.9, 4.2, 4.2))


@pytest.mark.parametrize("speed", [0.002, 0.02, 0.2])
@pytest.mark.parametrize("beside", [0.0, 0.2])
def test_what_the_steps_of_an_encoder_take_off_a_slow_motion_is_drawn(
    speed: float, beside: float
) -> None:
    """A motion of less than a step in a kernel has one error for many rows, and no derivative: of
    white noise of the same size a kernel leaves a third, or three times as much.
    """
    dt, step = 2e-3, 2 * np.pi / 4096
    t = dt * np.arange(20_000)
    rng = np.random.default_rng(4)
    motion = speed / 0.6 * np.sin(0.6 * t) + 0.1 * speed * np.sin(3.1 * t)
    link = step * np.rint(
        (motion + beside * step * rng.standard_normal(len(t)) + 0.3 * step) / step
    )
    w = prepare(t, {"motor_position": motion, "link_position": link}, (slice(0, len(t)),))
    still = prepare(t, {"link_position": motion}, (slice(0, len(t)),))
    noise = white(step * np.hypot(beside, 12**-0.5))
    assert noise.read_in(step).step == step and noise.read_in(0.3 * step).step == 0.0
    sources = {"motor_position": white(1e-9), "link_position": noise.read_in(step)}
    for name in ("link_position", "link_velocity"):
        d = draws_of(w, sources)
        found = d.noisy.averaged[name] - np.tile(d.calm.averaged[name], d.count)
        true = w.averaged[name] - still.averaged[name]
        assert np.std(found) == pytest.approx(np.std(true), rel=0.2), name


@pytest.mark.parametrize("steps", [2.0, 2.02, 2.35])
def test_steps_beat_with_the_samples_at_the_speed_of_their_own_side(steps: float) -> None:
    """A joint that goes nearly a whole number of steps a sample has an error that stays for many of
    them. A weight that turns winds the gear, and at a hundredth of another speed the beat is
    another one: an error of nothing was drawn as one of ten times as much, and the other way round.
    """
    dt, step = 1e-3, 2 * np.pi / 2**14
    t = dt * np.arange(8000)
    speed, rng = steps * step / dt, np.random.default_rng(3)
    motor = speed * t
    link = motor - 4e-3 * np.sin(motor) + 1e-6 * rng.standard_normal(len(t))
    read = step * np.rint(link / step)
    signals = {"motor_position": motor, "link_position": read}
    w = prepare(t, signals, (slice(0, len(t)),))
    still = prepare(t, {"motor_position": motor, "link_position": link}, (slice(0, len(t)),))
    noise = white(step * 12**-0.5).read_in(step)
    sources = {"motor_position": white(1e-9), "link_position": noise}
    d = draws_of(w, sources)
    found = d.noisy.averaged["link_position"] - np.tile(d.calm.averaged["link_position"], d.count)
    true = w.averaged["link_position"] - still.averaged["link_position"]
    assert np.std(found) == pytest.approx(np.std(true), rel=0.25)


def test_noise_of_a_bridged_record_is_bridged_as_its_readings_were() -> None:
    """A cubic through a hole makes one error of many neighbours: twice differentiated it is a sixth
    more than noise of as many samples. And rows count against the others of their record, as what
    all of them lack is in that noise already.
    """
    rng = np.random.default_rng(8)
    t, lost = 2e-3 * np.arange(20_000), rng.random(20_000) < 0.2
    noise = 1e-5 * rng.standard_normal(len(t))
    every = (slice(0, len(t)),)
    read = bridged_over(np.sin(t) + noise, lost, every)
    w = replace(prepare(t, {"motor_position": read}, every), lost=lost)
    calm = prepare(t, {"motor_position": bridged_over(np.sin(t), lost, every)}, every)
    drawn = {}
    for name, seen in (("bridged", w), ("whole", replace(w, lost=None))):
        d = draws_of(seen, {"motor_position": white(1e-5)})
        still = np.tile(d.calm.averaged["motor_acceleration"], d.count)
        drawn[name] = rms(d.noisy.averaged["motor_acceleration"] - still)
    true = rms(w.averaged["motor_acceleration"] - calm.averaged["motor_acceleration"])
    assert drawn["bridged"] == pytest.approx(true, rel=0.06)
    assert drawn["whole"] < 0.95 * true
    share = rng.uniform(0.4, 1.0, w.rows)
    support = support_of([replace(w, support=share)])
    np.testing.assert_allclose(support**2, share / share.mean())


def test_a_jump_between_two_samples_is_seen_where_readings_are_interpolated() -> None:
    """A torque that is shifted by half a sample alternates by a quarter, and its jumps are as
    uncertain as before.
    """
    t = 5e-3 * np.arange(4000)
    torque = np.where(np.arange(4000) % 37 < 18, 1.0, -1.0)
    signals = {"motor_position": np.sin(t), "torque": torque}
    every = (slice(0, len(t)),)
    moved, parts = shifted(signals, every, {"torque_sensor": 0.5})
    plain, bare = prepare(t, signals, parts), prepare(t, moved, parts)
    seen = prepare(t, moved, parts, readings={"torque": torque})
    assert rms(bare.between["torque"]) < 0.3 * rms(plain.between["torque"])
    np.testing.assert_array_equal(seen.between["torque"], plain.between["torque"])
    np.testing.assert_array_equal(seen.averaged["torque"], bare.averaged["torque"])


def test_pieces_of_a_long_record_have_its_rows_and_its_floor() -> None:
    """Noise of a long record is drawn in pieces: their rows are rows of the record, and what drawn
    noise leaves in them is what it leaves in all.
    """
    rng, dt, count = np.random.default_rng(3), 2e-3, 120_000
    time = dt * np.arange(count)
    q = np.sin(1.3 * time) + 0.2 * np.sin(7 * time) + 1e-5 * rng.standard_normal(count)
    signals = {"motor_position": q, "link_position": q, "torque": np.cos(time)}
    segments = (slice(0, 40_003), slice(40_003, 40_020), slice(40_020, count))
    whole = prepare(time, signals, segments, length=0.06)
    part, index = excerpt(whole)
    assert whole.rows > 1.5 * LONGEST
    assert 0.9 * LONGEST < part.rows < 1.1 * LONGEST
    assert np.array_equal(whole.time[index], part.time)
    for name in ("motor_velocity", "motor_acceleration", "torque"):
        assert np.array_equal(whole.averaged[name][index], part.averaged[name])
        law = np.tanh(whole.average(np.tanh(3 * whole.points[name])))[index]
        again = np.tanh(part.average(np.tanh(3 * part.points[name])))
        assert np.allclose(again, law, rtol=0, atol=1e-12), name
    short = prepare(time[:40_000], {n: x[:40_000] for n, x in signals.items()}, (slice(0, 40_000),))
    assert excerpt(short)[0] is short

    noise = {"motor_position": white(1e-5), "torque": white(0.01)}
    drawn = draws_of(whole, noise)
    assert drawn.record.rows == part.rows
    assert np.array_equal(drawn.rows, index)
    plain = prepare(time, {"torque": 0.01 * rng.standard_normal(count)}, segments, length=0.06)
    left = rms(drawn.noisy.averaged["torque"] - drawn.calm.averaged["torque"])
    assert left == pytest.approx(rms(plain.averaged["torque"]), rel=0.03)


@pytest.mark.parametrize("dt", [1e-3, 4e-3])
def test_the_direction_is_unknown_where_the_joint_is_slow_or_turns(dt: float) -> None:
    time = np.arange(0.0, 8.0, dt)
    position = np.where(time < 5.0, np.cos(np.pi * np.minimum(time, 5.0)), -1.0)
    made = prepare(time, {"motor_position": position}, (slice(0, len(time)),))
    points = time[:: made.grid.step]
    unknown = _either_direction(made, "motor", white(1e-5))
    slowest = 3 * made.grid.velocity_noise("motor_position", white(1e-5))
    speed = np.where(points < 5.0, np.pi * np.abs(np.sin(np.pi * points)), 0.0)
    assert np.all(unknown[points > 5.1]), "at rest"
    turn = np.min(np.abs(points[:, None] - np.arange(1, 6)), axis=1)
    assert np.all(unknown[(turn < dt / 2) & (points > 0.1) & (points < 4.9)]), "at a turn"
    sure = (turn > 0.06) & (points > 0.06) & (points < 4.9) & (speed > 2 * slowest)
    assert not unknown[sure].any()
    assert np.mean(sure) > 0.4
    # without noise only the turns are left, and only as far as a kernel blurs their instant
    turning = _either_direction(made, "motor", white(1e-12))
    reach = TURN_SHARE * max(made.grid.pointwise["motor_position"] - TURN_KERNEL, 0.0)
    near = turning & (points > 0.1) & (points < 4.9)
    assert set(np.round(points[near])) == {1.0, 2.0, 3.0, 4.0}
    assert np.max(turn[near]) <= reach + 3 * made.grid.step * dt
    # a motion that ends the other way round than it began does not turn at its end
    time = np.arange(0.1, 1.6, dt)
    away = prepare(time, {"motor_position": np.cos(np.pi * time)}, (slice(0, len(time)),))
    assert not _either_direction(away, "motor", white(1e-12))[[0, 1, -2, -1]].any()


def test_noise_alone_tells_no_direction_and_hides_none_that_is_well_above_it() -> None:
    """One in 370 normal numbers is beyond three deviations; one in 40 above three of a mean of five
    is not.
    """
    rng, dt, noise = np.random.default_rng(6), 1e-3, 1e-5
    time = dt * np.arange(20_000)
    known = []
    for deviations in (0.0, 5.0):
        level = prepare(time, {"motor_position": time}, (slice(0, len(time)),)).grid
        speed = deviations * level.velocity_noise("motor_position", white(noise))
        position = speed * time + noise * rng.standard_normal(len(time))
        made = prepare(time, {"motor_position": position}, (slice(0, len(time)),))
        known.append(float(np.mean(~_either_direction(made, "motor", white(noise)))))
    assert known[0] < 0.01
    assert known[1] > 0.95


@pytest.mark.parametrize("length", [0.06, 0.08, 0.1])
@pytest.mark.parametrize(("before", "after"), [(1.0, -0.2), (-0.2, 1.0), (-1.0, 0.2)])
def test_the_direction_is_unknown_wherever_a_kernel_takes_a_turn_for_another_instant(
    before: float, after: float, length: float
) -> None:
    """A joint that bounces back is slower after the turn: smoothed, it turns elsewhere."""
    dt = 1e-3
    time = dt * np.arange(4000)
    turn = 2.0
    position = np.where(time < turn, before, after) * (time - turn)
    made = prepare(time, {"motor_position": position}, (slice(0, len(time)),), pointwise=length)
    points = time[:: made.grid.step]
    wrong = np.sign(made.points["motor_velocity"]) != np.sign(
        np.where(points < turn, before, after)
    )
    assert np.sum(wrong) > 3
    unknown = _either_direction(made, "motor", white(1e-12))
    assert unknown[wrong].all()
    far = np.abs(points - turn) > length / 2
    assert not unknown[far].any(), "no further than half of the kernel"


def test_friction_before_a_link_that_nobody_sees_acts_by_its_curvature_too() -> None:
    """The link hangs on a spring: what friction of unknown signs makes of a row is no more than is
    allowed for, and with the worst signs as much.
    """
    time = 1e-3 * np.arange(6000)
    seen = Record.from_channels(
        time,
        {
            "motor_torque": 0.4 * np.sign(np.cos(3 * time)) - 0.5 * np.sin(3 * time),
            "motor_position": np.round(16e4 * np.sin(3 * time)) / 1e3,
        },
        name="seen",
    )
    joint = Joint(name="bare", gear_ratio=160.0, model_name="hd1", effects=("coulomb@motor",))
    model = prepared_model(joint, seen)
    assert model.lagging_load
    data = load_dataset([seen], [], joint, model)
    values = dict.fromkeys(model.parameter_names, 0.0) | {
        "motor_coulomb": 3.0,
        "inertia": 15.0,
        "swinging_share": 0.6,
        "load_compliance": 1 / 2e4,
    }
    lag = 15.0 * 0.6 / 2e4
    (rows,) = data.train
    allowed = _either_way(model, data, values, data.train)["axis"]
    either = _either_direction(rows, "motor", data.sources["motor_position"]).astype(float)
    rng, most = np.random.default_rng(0), np.zeros(rows.rows)
    for _ in range(300):
        torque = 3.0 * either * rng.choice([-1.0, 1.0], len(either))
        most = np.maximum(most, np.abs(rows.average(torque) + lag * rows.curve(torque)))
    assert np.all(most <= allowed * (1 + 1e-9))
    weights = rows.averaging + lag * rows.curving
    worst = 3.0 * np.abs(weights) @ either
    assert np.all(worst <= allowed * (1 + 1e-9))
    some = allowed > 0
    assert np.max(worst[some] / allowed[some]) == pytest.approx(1.0), "it is as bad as that"
    assert np.max(worst[some] / (3.0 * rows.average(either))[some]) > 1.2, "the curvature counts"


def test_what_may_act_either_way_is_the_friction_of_the_motor() -> None:
    """Beside it stands half of what a change twice as wide would move: squares add up."""
    train = record("train", 3, False, *FAST)
    joint = replace(JOINT, effects=(*JOINT.effects, "coulomb@motor"))
    model = prepared_model(joint, train)
    data = load_dataset([train], [], joint, model)
    values = dict.fromkeys(model.parameter_names, 1.0)
    values |= dict.fromkeys(model.named("smoothing"), 0.02) | {"motor_coulomb": 3.0}
    balances = balances_of(model, data.sensing, wrt=())
    wide = {**values, **dict.fromkeys(model.named("smoothing"), 0.04)}
    (seen,) = data.train
    here, there = (balances.evaluate(seen, v)["motor"][0] for v in (values, wide))
    either = _either_direction(seen, "motor", data.sources["motor_position"])
    acting = 3.0 * seen.average(either.astype(float))
    assert 1.0 < np.max(acting) <= 3.0, "a turn is there"
    # noise alone looks like a jump of the torque in one row of some hundred
    jumps = _between_samples(balances, data, values, [seen])[data.sensing.balances.index("motor")]
    rows = seen.taking("motor") & (jumps == 0)
    assert np.mean(rows[seen.taking("motor")]) > 0.99
    found = unsure(balances, data, values, [seen])["motor"]
    assert found[rows] == pytest.approx(np.hypot((here - there) / 2, acting)[rows], rel=1e-9)
