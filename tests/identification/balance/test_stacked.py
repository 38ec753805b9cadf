"""Stacked rows of several records: what takes part, what drifts, and which noise is believed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import JointModel
from identification import Record, fit
from identification.balance.balances import balances_of
from identification.balance.colour import white
from identification.balance.dataset import Dataset, load_dataset
from identification.balance.stacked import (
    _between_samples,
    _either_direction,
    _sure_rms,
    beginnings,
    drawn_floors,
    drift_rows,
    measured,
    noise_believed,
    noise_rows,
    rms,
    stack,
    sure_levels,
    together,
)
from identification.balance.weak import WeakRecord, differentiated_kernel, prepare
from identification.data.joint_file import Joint
from identification.fitting.engine import prepared_model
from identification.fitting.start_values import starts
from identification.fitting.weak_form import WeakForm
from tests.identification.fitting.test_dataset import recorded
from tests.recorded_world.world import make_case

FloatArray = npt.NDArray[np.float64]
VALUES = {"inertia": 12.0, "motor_viscous": 25.0, "motor_smoothing_velocity": 0.01}
NOISE = 1.0
"""Of the torque [N.m]."""


def axis(seconds: float, name: str = "axis") -> Record:
    """A rigid axis without friction and without any noise."""
    t = 1e-3 * np.arange(round(1e3 * seconds))
    q, v, a = np.sin(3 * t), 3 * np.cos(3 * t), -9 * np.sin(3 * t)
    torque = VALUES["inertia"] * a + VALUES["motor_viscous"] * v
    return Record.from_channels(t, {"motor_position": q, "motor_torque": torque}, name=name)


def world(*seconds: float) -> tuple[JointModel, Dataset]:
    """Such records of these lengths, and the model that they follow."""
    records = [axis(s, f"run {k}") for k, s in enumerate(seconds)]
    joint = Joint(model_name="hd1", effects=("viscous",))
    model = prepared_model(joint, records[0])
    return model, load_dataset(records, [], joint, model)


def moved(record: WeakRecord, more: FloatArray) -> WeakRecord:
    """The record with so much more torque in its rows."""
    torque = record.averaged["drive"] + more
    return replace(record, averaged={**record.averaged, "drive": torque})


def test_a_drift_of_one_record_is_not_spread_over_another() -> None:
    """The even part of a drift is its RMS in the rows of each record that take part."""
    _, data = world(6.0, 3.0, 4.0)
    rng = np.random.default_rng(0)
    records = [replace(w, rest={"motor": (rng.random(w.rows) < 0.3) * 1.0}) for w in data.train]
    drifts = [size * rng.standard_normal(w.rows) for size, w in zip((1.0, 5.0, 20.0), records)]
    quick = np.full(sum(w.rows for w in records), 2.0)
    found = together({"axis": quick}, {"axis": np.concatenate(drifts)}, records)["axis"]
    expected = [
        np.full(w.rows, np.sqrt(4.0 + np.mean(x[w.rest["motor"] == 0] ** 2)))
        for w, x in zip(records, drifts)
    ]
    assert found == pytest.approx(np.concatenate(expected), rel=1e-12)


def test_rows_that_take_no_part_are_zero_in_the_residual_and_its_slopes() -> None:
    model, data = world(4.0)
    (record,) = data.train
    still = np.arange(record.rows) % 3 == 0
    resting = replace(moved(record, np.full(record.rows, 7.0)), rest={"motor": still * 1.0})
    found = stack(balances_of(model, data.sensing), [resting], VALUES)
    assert np.all(found.residual["axis"][still] == 0.0)
    assert np.all(found.jacobian["axis"][still] == 0.0)
    assert np.all(np.abs(found.residual["axis"][~still]) > 1.0)


def test_no_records_have_no_rows_and_rows_of_none_no_level() -> None:
    model, data = world(4.0)
    assert [x.shape for x in drift_rows(model, data, VALUES, []).values()] == [(0,)]
    for part in noise_rows(model, data, VALUES, []):
        assert {b: x.shape for b, x in part.items()} == {"axis": (0,)}
    jumps = _between_samples(balances_of(model, data.sensing), data, VALUES, [])
    assert [x.shape for x in jumps] == [(0,)]
    (record,) = data.train
    masked = replace(data, train=(replace(record, masked=frozenset({"axis"})),))
    assert sure_levels(model, masked, VALUES) == {"axis": 0.0}


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("share", [0.02, 0.05])
def test_the_noise_of_rows_shows_beside_some_that_may_go_either_way(
    share: float, unit: float
) -> None:
    """These scatter by their own deviation, too; by the plain RMS the level would be theirs."""
    rng = np.random.default_rng(3)
    either = np.where(rng.random(20_000) < share, 30.0, 0.0)
    change = np.hypot(1.0, either) * rng.standard_normal(20_000)
    assert rms(change) > 4.0
    assert _sure_rms(unit * change, unit * either) == pytest.approx(unit, rel=0.05)
    assert _sure_rms(unit * change, 0 * either) == pytest.approx(unit * rms(change))
    still = np.where(either > 0, change, 0.0)
    assert _sure_rms(unit * still, unit * either) == pytest.approx(unit * rms(still))
    # a law that ran away leaves every row open, one of infinity, too
    for far in (1e200, np.inf):
        assert _sure_rms(unit * change, np.full(len(change), far)) == pytest.approx(
            unit * rms(change)
        )


@pytest.mark.parametrize("seconds", [4.0, 30.0])
def test_a_level_of_noise_that_is_right_is_believed_and_one_too_high_is_not(seconds: float) -> None:
    """White noise leaves a residual that scatters about its level: of a hundred records hardly one
    lies three standard errors lower. Twice that level is lowered to it and no further than by these
    errors.
    """
    model, data = world(seconds)
    (record,) = data.train
    weights = differentiated_kernel(record.grid.length, record.grid.dt, 0)
    level = NOISE * float(np.linalg.norm(weights))
    rng = np.random.default_rng(1)
    left, right, double = [], [], []
    for _ in range(100):
        noise = NOISE * rng.standard_normal(round(1e3 * seconds))
        rows = record.grid.correlate(noise, weights)
        drawn = replace(data, train=(moved(record, rows),))
        left.append(rms(rows) / level)
        right.append(noise_believed(model, drawn, VALUES, [{"axis": level}])["axis"])
        double.append(noise_believed(model, drawn, VALUES, [{"axis": 2 * level}])["axis"])
    assert np.sum(np.array(right) < 1.0) <= 2
    error = float(np.std(left))
    assert np.max(double) < 1.0
    assert np.mean(double) == pytest.approx(0.5 / (1 - 3 * error), rel=0.1)


@pytest.mark.parametrize(("deviations", "known"), [(2.9, False), (3.1, True)])
def test_a_move_between_two_samples_tells_a_direction_from_three_deviations_of_a_difference(
    deviations: float, known: bool
) -> None:
    """Two readings of a slow logger differ by the root of two of the noise of one."""
    dt, noise = 0.01, 1e-4
    step = deviations * np.sqrt(2) * noise
    time = dt * np.arange(400)
    made = prepare(time, {"motor_position": step * np.arange(400)}, (slice(0, 400),))
    assert made.grid.step == 1
    assert np.all(_either_direction(made, "motor", white(noise)) != known)


@pytest.mark.parametrize("seconds", [3.0, 8.0, 40.0])
def test_the_floor_of_white_noise_is_that_of_its_average_however_short_a_record_is(
    seconds: float,
) -> None:
    """A short record is drawn several times, and a long one once."""
    model, data = world(seconds)
    (record,) = data.train
    noisy = replace(data, noise={**data.noise, "drive": NOISE}, colours={})
    weights = differentiated_kernel(record.grid.length, record.grid.dt, 0)
    (floor,) = drawn_floors(model, noisy, VALUES, record).values()
    assert floor == pytest.approx(NOISE * float(np.linalg.norm(weights)), rel=0.15)


def test_what_is_measured_of_a_gear_is_its_twist_about_the_middle_of_it() -> None:
    """However far both sides turn, and wherever their zeros are."""
    time = 1e-3 * np.arange(4000)
    turn, twist = 3 * np.sin(2 * time), 1e-3 * np.sin(9 * time)
    signals = {"motor_position": turn + twist + 0.7, "link_position": turn}
    record = prepare(time, signals, (slice(0, 4000),))
    weights = differentiated_kernel(record.grid.length, record.grid.dt, 0)
    averaged = record.grid.correlate(twist, weights)
    found = measured("kinematic", record)
    assert found == pytest.approx(averaged - np.median(averaged), abs=1e-9)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_what_is_known_of_a_parameter_is_a_row_in_its_standard_deviations(unit: float) -> None:
    """Below those of the balance, in any unit; a parameter of which nothing is known has none."""
    model, data = world(4.0)
    free = ("inertia", "motor_viscous")
    values = {**VALUES, "motor_viscous": 25.0 * unit}
    known = {"motor_viscous": (20.0 * unit, 2.0 * unit), "elsewhere": (0.0, 1.0)}
    balances = balances_of(model, data.sensing, wrt=free)
    form = WeakForm(balances, data, values, free, {"axis": 1.0}, known)
    x = np.array([values[n] for n in free])
    (rows,) = {w.rows for w in data.train}
    assert form.residual(x)[rows:] == pytest.approx([2.5])
    assert form.jacobian(x)[rows:] == pytest.approx(np.array([[0.0, 0.5 / unit]]))


def test_where_a_memory_began_is_not_known(tmp_path: Path) -> None:
    """Bristles are bent before a record begins. Four rows of the first start held four fifths of
    what was left: 4.5 times the noise, and a bristle torque that was 3 % too small.
    """
    joint, train, held_out = recorded(288003, "triple", tmp_path)
    laws = ("gravity", "lugre@motor", "hysteresis", "quadratic_drag@link")
    effects = tuple(dict.fromkeys((*joint.effects, *laws)))
    found = fit(replace(joint, effects=effects), [train], held_out=[held_out])
    true = make_case(288003, kind="triple", size=1.0).values
    torque = found.solution.values["motor_presliding_torque"]
    assert torque == pytest.approx(true["M_TC"], rel=0.01)
    assert found.train.balances["motor"].ratio < 2.0


def test_a_law_that_never_forgets_its_beginning_has_none(tmp_path: Path) -> None:
    """Elements that never slip are a spring: rows that count less for it made it the best name of a
    pendulum's gravity.
    """
    joint, train, held_out = recorded(288003, "triple", tmp_path)
    model = prepared_model(joint, train).add("hysteresis")
    data = load_dataset([train], [held_out], joint, model)
    balances = balances_of(model, data.sensing, wrt=())
    started = {**starts(model, data), "stiffness": 298.0, "hysteresis_torque_1": 0.2}

    def reached(width: float) -> int:
        values = {**started, "hysteresis_width": width, "hysteresis_spread": 2.3}
        return int(np.count_nonzero(beginnings(balances, data, values, data.train)["transmission"]))

    assert 0 < reached(0.0013) < 0.05 * data.train[0].rows
    assert reached(1.0) == 0
