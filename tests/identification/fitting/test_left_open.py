"""What a fit leaves open counts as noise on other records, by no more than that."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from identification import Joint, Record, improve, load_joint, read
from identification.balance.calibration import settled
from identification.balance.dataset import Dataset, load_dataset, prepared_model
from identification.balance.excitation import attenuation, excitation_warnings
from identification.fitting.assess import BalanceError, assess
from identification.fitting.engine import Solution, solve
from identification.fitting.first_fit import first_fit
from identification.fitting.left_open import FAR, LeftOpen
from tests.identification.diagnosis.test_session import at_one_speed, wave
from tests.identification.fitting.test_errors_in_variables import JOINT as ARM
from tests.identification.fitting.test_errors_in_variables import run
from tests.recorded_world.world import Case, make_case, write_case
from tests.smooth_laws import nothing, record

JOINT = Joint(model_name="hd1", effects=("viscous", "coulomb", "quadratic_drag"))
SEEDS = range(12)


def errors(found: Solution, data: Dataset, balance: str) -> tuple[BalanceError, BalanceError]:
    """Of a balance of the held-out records: without and with what the fit leaves open."""
    values = settled(found.model, data.sensing, [*data.train, *data.held_out], found.values)
    given = LeftOpen.of(found, data, values, frozenset({balance}))
    plain, beside = (
        assess(found.model, data, data.held_out, found.values, x).balances[balance]
        for x in (None, given)
    )
    return plain, beside


def written(case: Case, folder: Path) -> tuple[Joint, Record, Record]:
    """The joint of a case, its training and its held-out record, with all sensors."""
    place = write_case(case, folder, "all")
    joint = load_joint(place / "joint.toml")
    train, held = (read(place / f"{n}.csv", joint=joint) for n in ("train", "test"))
    return joint, train, held


def ratios(seed: int) -> tuple[float, float]:
    """Of the right model on a record of many speeds, fitted to one speed: without and with what
    the fit leaves open.
    """
    rng = np.random.default_rng([11, seed])
    train = at_one_speed(rng, nothing)
    held = record(np.random.default_rng([12, seed]), 10.0, nothing).renamed("held")
    model = prepared_model(JOINT, train)
    data = load_dataset([train], [held], JOINT, model, kernel=0.2)
    plain, beside = errors(solve(model, data), data, "axis")
    return plain.ratio, beside.ratio


@pytest.fixture(scope="module")
def drawn() -> np.ndarray:
    return np.array([ratios(seed) for seed in SEEDS])


def test_the_right_model_stands_at_its_noise(drawn: np.ndarray) -> None:
    plain, beside = drawn.T
    assert plain.max() > 3, "by what is left open it stands far over it"
    assert np.all(np.abs(np.log(beside)) < np.log(1.5))
    assert np.sqrt(np.mean(beside**2)) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("seed", range(4, 10))
def test_an_inertia_that_only_noise_moves_is_left_open(seed: int) -> None:
    """Accelerations of slow motion are noise of the encoder, which tells no inertia: neither of the
    training rows, nor what noise does to the rows of quick motion at the inertia that is there.
    """
    train, _ = run(seed, noise=2.0, pace=0.2)
    held = run(seed, noise=2.0)[0].renamed("held")
    model = prepared_model(ARM, train)
    data = load_dataset([train], [held], ARM, model)
    plain, beside = errors(solve(model, data), data, "link")
    assert plain.ratio > 4
    assert beside.ratio < 1.3
    assert beside.left_open == ("link_inertia",)
    share = attenuation(data)["link inertia"]
    assert share > 0.8
    said = "\n".join(excitation_warnings(data))
    assert ("hides the motor inertia and the link inertia: " in said) is (share >= 0.9)
    assert ("link inertia by about" in said) is (share < 0.9)


def test_a_step_costs_what_the_training_rows_lose_by_it() -> None:
    """It is that of the training rows: a step of one parameter by its standard error beside all
    others costs one variance.
    """
    rng = np.random.default_rng(5)
    train = record(rng, 10.0, nothing).renamed("train")
    model = prepared_model(JOINT, train)
    data = load_dataset([train], [], JOINT, model, kernel=0.2)
    found = solve(model, data)
    values = settled(model, data.sensing, data.train, found.values)
    left_open = LeftOpen.of(found, data, values, frozenset({"axis"}))
    assert left_open.here.free == left_open.names, "one encoder: nothing is a run's own"
    rows = left_open.here.jacobian(np.array([values[n] for n in left_open.names]))
    inverse = np.linalg.inv(np.linalg.qr(rows, mode="r"))
    errors = np.linalg.norm(inverse, axis=1)
    stated = np.array([found.stderr[n] or np.nan for n in left_open.names])
    # rows overlap: windows of time tell the errors, and rows that are taken as independent less
    assert np.all((stated / errors)[np.isfinite(stated)] > 0.7)
    assert np.all((stated / errors)[np.isfinite(stated)] < 5)


def test_a_gap_that_no_training_row_crosses_moves_with_the_zero_of_its_flank(
    tmp_path: Path,
) -> None:
    """On one flank a gap is a zero of the link's encoder, so nothing tells its size, and records
    that cross it stand far over the noise until both may move.
    """
    # backlash, listed three times too wide
    joint, train, held = written(make_case(240002, kind="none"), tmp_path)
    model = prepared_model(joint, train)
    data = load_dataset([train], [held], joint, model)
    plain, beside = errors(first_fit(model, data), data, "transmission")
    assert plain.ratio > 10
    assert beside.ratio < 1.3
    assert beside.left_open == ("backlash",)


def test_all_records_together_know_a_place_in_the_valley_that_is_far(tmp_path: Path) -> None:
    """A gap that the training rows do not cross may read as none at all, its stiffness as much as
    its width; no step from there leads to the gap that the held-out record crosses.
    """
    case = make_case(299002, kind="none", without=("dirt",))
    joint, train, held = written(case, tmp_path)
    model = prepared_model(joint, train)
    data = load_dataset([train], [held], joint, model)
    _, beside = errors(first_fit(model, data), data, "transmission")
    assert beside.ratio > 10
    answer = improve(train, joint, [held])
    assert answer.verdict == "nothing_missing"
    assert any("leave open of backlash_stiffness_loss" in w for w in answer.warnings)


def test_no_step_is_looked_for_where_none_can_be_near() -> None:
    """A law that is missing stands far over the noise whatever the parameters are: what the search
    would find is no explanation, and costs as much as the fit.
    """
    rng = np.random.default_rng([11, 3])
    train, held = (record(rng, 10.0, wave).renamed(name) for name in ("train", "held"))
    model = prepared_model(JOINT, train)
    data = load_dataset([train], [held], JOINT, model, kernel=0.2)
    found = solve(model, data)
    values = settled(model, data.sensing, [*data.train, *data.held_out], found.values)
    given = LeftOpen.of(found, data, values, frozenset({"axis"}))
    assert given.clear_of_noise
    plain, beside = errors(found, data, "axis")
    assert beside.ratio == plain.ratio > FAR
    assert beside.left_open == ()
    noisy, _ = run(4, noise=2.0, pace=0.2)
    arm = prepared_model(ARM, noisy)
    hidden = load_dataset([noisy], [], ARM, arm)
    fitted = solve(arm, hidden)
    settled_there = settled(arm, hidden.sensing, hidden.train, fitted.values)
    assert not LeftOpen.of(fitted, hidden, settled_there, frozenset()).clear_of_noise
