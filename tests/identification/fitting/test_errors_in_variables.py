"""Noise of the positions takes nothing off an inertia, and the bands of a fit cover."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import csr_array

from benchmarks.next_run import record_of
from benchmarks.trust import joint_of, one_way
from casadi_models import EFFECTS
from identification import Joint, Record, fit, improve, load_joint, read
from identification.balance.balances import balances_of
from identification.balance.calibration import of_run
from identification.balance.colour import white
from identification.balance.dataset import load_dataset, prepared_model
from identification.balance.drawn_noise import LONGEST
from identification.balance.excitation import attenuation, excitation_warnings
from identification.diagnosis.candidates import Candidate
from identification.diagnosis.trials import columns, make_base, noise_beside
from identification.fitting.covariance import (
    BLOCK,
    OVERLAP,
    window_errors,
    windows_over,
)
from identification.fitting.engine import solve
from identification.fitting.errors_in_variables.bands import cut_square
from identification.fitting.errors_in_variables.equations import _Equations
from identification.fitting.errors_in_variables.instruments import can_be_met, instruments_of, mixed
from identification.fitting.errors_in_variables.products import (
    MOST_NOISE,
    NoiseProducts,
    kept,
    known,
    told,
    whole_without,
)
from identification.fitting.weak_form import WeakForm
from tests.hidden_effect.generator import simulate_case
from tests.recorded_world._engine import library
from tests.recorded_world.world import make_case, write_case

FloatArray = npt.NDArray[np.float64]
DT, JOINTS = 2e-3, 40
NAMES = ("link_inertia", "link_viscous", "gravity_torque")
JOINT = Joint(name="arm", gear_ratio=1.0, model_name="hd1", effects=("viscous@link", "gravity"))


def run(
    seed: int, seconds: float = 30.0, *, noise: float = 1.0, pace: float = 1.0
) -> tuple[Record, dict[str, float]]:
    """A link under a measured torque; the truth is known in closed form."""
    rng = np.random.default_rng(880_000 + seed)
    true = dict(
        zip(NAMES, np.array([3.0, 4.0, 30.0]) * np.exp(rng.uniform(-0.5, 0.5, 3)), strict=True)
    )
    t = np.arange(round(seconds / DT)) * DT
    w = 2 * np.pi * np.array([0.17, 0.45, 1.1, 1.9]) * np.exp(rng.uniform(-0.1, 0.1, 4)) * pace
    a, phase = np.array([0.5, 0.2, 0.1, 0.05]), rng.uniform(0, 2 * np.pi, (4, 1))
    angle = w[:, None] * t + phase
    q, v, bend = a @ np.sin(angle), (a * w) @ np.cos(angle), -(a * w**2) @ np.sin(angle)
    torque = (
        true["link_inertia"] * bend + true["link_viscous"] * v - true["gravity_torque"] * np.sin(q)
    )
    channels = {
        "link_position": q + noise * 6e-4 * rng.standard_normal(len(t)),
        "link_torque": torque + noise * 0.2 * rng.standard_normal(len(t)),
    }
    return Record.from_channels(t, channels, name=f"run {seed}"), true


@cache
def errors() -> dict[str, np.ndarray]:
    """Error and standard error of each parameter over many joints, (joints, 2)."""
    out: dict[str, list[tuple[float, float]]] = {n: [] for n in NAMES}
    for seed in range(JOINTS):
        record, true = run(seed)
        solution = fit(JOINT, [record]).solution
        for n in NAMES:
            error = solution.stderr[n]
            assert error is not None
            out[n].append((solution.values[n] / true[n] - 1, error / true[n]))
    return {n: np.array(x) for n, x in out.items()}


def test_an_inertia_has_no_bias_where_noise_would_take_percents_off() -> None:
    record, _ = run(0)
    data = load_dataset([record], [], JOINT, prepared_model(JOINT, record))
    assert attenuation(data)["link inertia"] > 0.02
    off, size = errors()["link_inertia"].T
    assert abs(off.mean()) < 3 * float(np.sqrt(np.mean(size**2) / JOINTS))


def test_noise_of_a_record_that_is_drawn_in_pieces_is_taken_off_too() -> None:
    record, true = run(1, 150.0)
    data = load_dataset([record], [], JOINT, prepared_model(JOINT, record))
    assert data.train[0].rows > LONGEST
    solution = fit(JOINT, [record]).solution
    for n in NAMES:
        error = solution.stderr[n]
        assert error is not None
        assert abs(solution.values[n] - true[n]) < 3 * error, n
    # plain least squares would leave far more off the inertia than its band
    error = solution.stderr["link_inertia"]
    assert error is not None
    assert attenuation(data)["link inertia"] * true["link_inertia"] > 6 * error


@pytest.mark.parametrize("name", NAMES)
def test_twice_the_standard_error_is_a_band_of_95_percent(name: str) -> None:
    """Of 40, a true 95 % leaves 34 or fewer inside once in a hundred times."""
    off, size = errors()[name].T
    assert np.sum(np.abs(off) < 2 * size) > 34


def test_only_certain_noise_is_taken_off_a_normal_matrix() -> None:
    whole = np.array([[1.0, 0.3], [0.3, 1.0]])
    noise = np.diag([0.2, 0.0])
    assert whole_without(whole, noise) == pytest.approx(whole - noise, abs=1e-12)
    left = np.linalg.eigvalsh(np.linalg.solve(whole, whole_without(whole, 5 * whole)))
    assert left == pytest.approx([1 - MOST_NOISE] * 2)


def test_what_noise_that_is_hardly_known_may_hide_is_told_by_nothing() -> None:
    """A tenth that is left of a direction is a tenth where the noise is known, next to nothing
    where its squares are known to a tenth, and a small noise changes little either way.
    """
    whole, noise = np.eye(3), np.diag([0.9, 0.1, 0.0])
    assert known(whole, noise, 0.0) == pytest.approx(whole - noise)
    assert np.diag(known(whole, noise, 0.1)) == pytest.approx([0.03, 0.89, 1.0])
    by = kept(whole, noise, 0.1)
    assert by @ (whole - noise) @ by.T == pytest.approx(known(whole, noise, 0.1))
    assert np.diag(told(whole, noise, 0.0)) ** 2 == pytest.approx([0.1, 0.9, 1.0])
    assert np.diag(told(whole, noise, 0.1)) ** 2 == pytest.approx([0.0, 0.9, 1.0])
    mixed_up = np.array([[2.0, 0.4, 0.0], [0.4, 1.0, 0.3], [0.0, 0.3, 1.5]])
    by = told(mixed_up, noise, 0.0)
    assert by.T @ mixed_up @ by == pytest.approx(mixed_up - noise)


def test_an_inertia_that_only_noise_moves_is_told_by_no_record() -> None:
    """In rows of no length; what is left of it on slow motion was told as sure.  Noise is three
    quarters of what rows of the longest kind hold of it, and one window of time holds as much of
    the rest as noise may be of it for certain.
    """
    for seed in range(4, 10):
        record, true = run(seed, noise=2.0, pace=0.1)
        solution = fit(JOINT, [record]).solution
        error = solution.stderr["link_inertia"]
        assert error is not None
        value = solution.values["link_inertia"]
        assert "link_inertia" in solution.unidentified or value / 2 < error
        assert "link_inertia" in solution.unidentified or abs(value - true["link_inertia"]) < error
        error = solution.stderr["gravity_torque"]
        assert error is not None
        assert abs(solution.values["gravity_torque"] - true["gravity_torque"]) < 3 * error
        # slow, an inertia is a little gravity
        assert error < 0.2 * true["gravity_torque"]


@pytest.mark.slow
def test_errors_beside_much_noise_cover() -> None:
    """Of an inertia whose information is noise for the most part, and of the others beside it: one
    window that held more than was certain made them anything.
    """
    inside: dict[str, list[bool]] = {n: [] for n in NAMES}
    for seed in range(40):
        record, true = run(seed, noise=2.0, pace=0.1)
        solution = fit(JOINT, [record]).solution
        for n in NAMES:
            if n in (*solution.unidentified, *solution.at_bound):
                continue
            error = solution.stderr[n]
            assert error is not None
            inside[n].append(abs(solution.values[n] - true[n]) < 2 * error)
        error = solution.stderr["gravity_torque"]
        assert error is not None
        assert error < 0.25 * true["gravity_torque"]
    assert all(np.mean(x) > 0.9 for x in inside.values())
    assert len(inside["gravity_torque"]) == 40


def test_a_lag_that_only_takes_noise_off_is_no_swing() -> None:
    """The lag of an unseen load filters a measured torque: rows of a rigid axis had a fifth less
    noise with one, which the fit took for a fall of what is left.
    """
    time = np.arange(0, 24, 0.002)
    position = 0.1 * np.sin(2 * np.pi * 0.23 * time) + 0.03 * np.sin(2 * np.pi * 0.71 * time + 0.4)
    velocity = np.gradient(position, time)
    force = 95 * np.gradient(velocity, time) + 60 * velocity + 6.0
    joint = Joint(kind="linear", gear_ratio=1.0, effects=("viscous", "current_offset"))
    for seed in range(5, 11):
        noise = 0.1 * np.random.default_rng(seed).standard_normal(len(time))
        signals = {"motor_torque": force + noise, "motor_position": position}
        axis = Record.from_channels(time, signals, name="axis", kind="linear")
        solution = fit(joint, [axis]).solution
        assert solution.values["load_compliance"] == 0.0
        assert "load_compliance" not in solution.free


def test_rows_are_as_long_as_noise_asks() -> None:
    """In rows of the usual length noise makes more than nine tenths of these accelerations and
    leaves an inertia of a third of the truth at most; in four times longer ones a seventh.
    """
    for seed in range(4, 10):
        record, true = run(seed, noise=2.0, pace=0.2)
        short = load_dataset([record], [], JOINT, prepared_model(JOINT, record))
        assert attenuation(short)["link inertia"] > 0.8
        hidden = solve(prepared_model(JOINT, record), short)
        assert hidden.values["link_inertia"] < 0.4 * true["link_inertia"]
        assert "link_inertia" in hidden.unidentified
        found = fit(JOINT, [record])
        assert found.data.kernel == pytest.approx(4 * short.kernel)
        assert attenuation(found.data)["link inertia"] < 0.25
        assert any("rows of 0.24 s" in w for w in excitation_warnings(found.data))
        for n in NAMES:
            error = found.solution.stderr[n]
            assert error is not None
            assert abs(found.solution.values[n] - true[n]) < 3 * error
            assert error < 0.05 * true[n]


def test_rows_are_no_longer_than_noise_asks() -> None:
    record, _ = run(0)
    usual = load_dataset([record], [], JOINT, prepared_model(JOINT, record))
    assert 0.02 < attenuation(usual)["link inertia"] < 0.5
    found = fit(JOINT, [record]).data
    assert found.kernel == usual.kernel
    assert not any("asks for rows" in w for w in excitation_warnings(found))


@pytest.mark.parametrize("turning", [True, False])
def test_an_amplitude_whose_shape_stands_at_a_bound_is_as_open_as_the_shape(turning: bool) -> None:
    """Motion that never turns shows nothing of Stribeck friction: noise that was taken off sent its
    velocity and its exponent to their bounds, and its torque was fifty times the truth and eight
    standard errors off. Where it shows the exponent may stand at the true bound, and the torque is
    known.
    """
    case = simulate_case(
        "stribeck",
        73040,
        overrides={"CURVE": 1.0},
        records=("train", "train2"),
        references=None if turning else one_way(73040),
    )
    joint = joint_of(case, ("stribeck@motor",))
    found = fit(joint, [record_of(t, n, "same") for n, t in case.measured.items()]).solution
    open_ = found.at_bound if turning else (*found.at_bound, *found.unidentified)
    assert "motor_stribeck_exponent" in open_
    torque, true = found.values["motor_stribeck_extra"], float(case.parameters["M_TS"])
    error = found.stderr["motor_stribeck_extra"]
    assert error is not None
    assert abs(torque - true) < 3 * error
    assert ("motor_stribeck_extra" in found.unidentified) is not turning
    if turning:
        assert error < 0.01 * true


def test_noise_falls_on_the_windows_whose_rows_take_part() -> None:
    products = NoiseProducts({"link": np.eye(2)}, {"link": np.ones(2)})
    windows = csr_array([[1.0, 1.0, 0.4, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0, 0.5]])
    weights = {"link": np.array([1.0, 1.0, 1.0, 50.0, 1.0])}
    gram, score = products.by_window(weights, windows, {"link": np.array([1, 1, 1, 0, 1]) > 0})
    assert gram[:, 0, 0] == pytest.approx([0.5, 0.25])
    assert score[:, 1] == pytest.approx([0.6, 0.375])


def test_noise_without_a_slow_part_is_no_error_of_a_slow_parameter() -> None:
    """Differences of white noise add up to next to nothing against a constant; white noise to what
    white noise adds up to."""
    rng, dt = np.random.default_rng(4), 0.02
    time = np.arange(4000) * dt
    windows = windows_over([time[:2000], time[2000:]])
    np.testing.assert_allclose((windows * windows).sum(axis=0), 1.0)
    assert windows.shape[0] < 1.1 * OVERLAP * 80 / (2 * BLOCK) + 2 * OVERLAP
    columns = np.column_stack([np.ones(4000), np.sin(time)])
    white = rng.standard_normal(4000)
    for noise, error in ((white, 4000**-0.5), (np.diff(white, prepend=0.0), 0.0)):
        left = noise - columns @ np.linalg.lstsq(columns, noise, rcond=None)[0]
        errors = window_errors(columns, left, windows)
        assert errors is not None
        assert abs(errors[0] - error) < 0.35 * 4000**-0.5


@pytest.mark.skipif(library() is None, reason="no C compiler")
def test_a_gap_as_small_as_the_encoders_tell_stays_where_the_fit_put_it(tmp_path: Path) -> None:
    """The correction of first order had led to a stiffness of 2e7 N.m/rad inside a gap of 0."""
    folder = write_case(make_case(8812, without=("zero",)), tmp_path, "all")
    joint = load_joint(folder / "joint.toml")
    found = fit(joint, read(folder / "train.csv", joint=joint))
    assert found.train.relative_error_percent < 1.0
    assert 0 < found.solution.values["backlash_stiffness_loss"] < 300.0


def slow(
    seed: int,
    *,
    heavy: bool = False,
    level: float = 1e-3,
    loud: float = 0.05,
    viscous: float = 1.5,
    coulomb: float = 0.0,
) -> tuple[Record, dict[str, float]]:
    """A slow arm on a transmission whose link encoder has that much noise, beside a motor encoder
    and a torque sensor that are good: most of the link's acceleration is noise."""
    rng = np.random.default_rng(990_000 + seed)
    true = {
        "link_inertia": 0.9,
        "stiffness": 1.5e4,
        "gravity_torque": 20.0,
        "link_viscous": viscous,
    }
    t = np.arange(round(40.0 / DT)) * DT
    w = 2 * np.pi * np.array([0.1, 0.23, 0.6]) * np.exp(rng.uniform(-0.1, 0.1, 3))
    a, phase = np.array([0.5, 0.2, 0.05]), rng.uniform(0, 2 * np.pi, (3, 1))
    angle = w[:, None] * t + phase
    q, v, bend = a @ np.sin(angle), (a * w) @ np.cos(angle), -(a * w**2) @ np.sin(angle)
    torque = true["link_inertia"] * bend + true["link_viscous"] * v
    torque = torque - true["gravity_torque"] * np.sin(q) + coulomb * np.tanh(v / 0.01)
    noise = rng.standard_t(2.2, len(t)) if heavy else rng.standard_normal(len(t))
    channels = {
        "motor_position": 100.0 * (q + torque / true["stiffness"])
        + 100 * 2e-5 * rng.standard_normal(len(t)),
        "link_position": q + level * noise,
        "link_torque": torque + loud * rng.standard_normal(len(t)),
    }
    true["link_coulomb"] = coulomb
    true = {n: x for n, x in true.items() if x}
    return Record.from_channels(t, channels, name=f"slow {seed}"), true


ARM = Joint(name="arm", gear_ratio=100.0, model_name="hd3", effects=("viscous@link", "gravity"))


@pytest.mark.parametrize("heavy", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_motor_and_torque_sensor_tell_of_a_link_whose_encoder_is_noise(
    seed: int, *, heavy: bool
) -> None:
    """Drawn from its level and taken off, the noise had left a twentieth to three quarters of the
    inertia."""
    record, true = slow(seed, heavy=heavy)
    found = fit(ARM, [record])
    assert max(e.ratio for e in found.train.balances.values()) < 1.2
    for n, x in true.items():
        error = found.solution.stderr[n]
        assert error is not None
        assert abs(found.solution.values[n] - x) < 3.5 * error, n
    error = found.solution.stderr["link_inertia"]
    assert error is not None
    assert error < 0.1 * true["link_inertia"]


def test_a_level_of_noise_that_is_a_little_off_moves_no_inertia() -> None:
    """The link's own noise takes ten standard errors off its inertia, and a level is not read to a
    tenth of that. By white errors, which are ten times the stated ones here, the columns of the
    others were not worth it, and these levels moved the inertia by six standard errors."""
    case = simulate_case(
        None,
        412_003,
        overrides={"CURVE": 1.0},
        records=("train", "train2"),
        references=one_way(412_003),
    )
    records = [record_of(t, n, "same") for n, t in case.measured.items()]
    joint = joint_of(case)
    model = prepared_model(joint, records[0])
    data = load_dataset(records, [], joint, model)
    found = []
    for factor in (0.85, 1.0, 1.15):
        colours = {**data.colours, "link_position": white(factor * data.noise["link_position"])}
        noise = {**data.noise, "link_position": factor * data.noise["link_position"]}
        solution = solve(model, replace(data, noise=noise, colours=colours))
        error = solution.stderr["link_inertia"]
        assert error is not None
        off = solution.values["link_inertia"] - case.parameters["JL"]
        assert abs(off) < 3 * error, factor
        assert error < 2.5e-4 * case.parameters["JL"]
        found.append(off / error)
    assert np.ptp(found) < 1.5


def test_columns_of_others_hold_the_motion_of_the_link_and_not_its_noise() -> None:
    """Without noise both are one; noise of the link's encoder does not move them."""
    quiet, _ = slow(0, level=0.0)
    noisy, _ = slow(0)
    columns = []
    for record in (quiet, noisy):
        model = prepared_model(ARM, record)
        data = load_dataset([record], [], ARM, model)
        values = {**fit(ARM, [quiet]).solution.values}
        balances = balances_of(model, data.sensing)
        run = {of_run(n, data.train[0]): values[n] for n in model.calibration}
        free = ("link_inertia", "stiffness", "link_viscous", "gravity_torque")
        problem = WeakForm(
            balances, data, {**values, **run}, free, dict.fromkeys(balances.balances, 1.0)
        )
        own = problem.jacobian(np.array([values[n] for n in free]))
        met = can_be_met(problem)
        assert met == {"link", "transmission"}
        columns.append((own, instruments_of(problem, met).beside(own, problem)))
    (own, by), (own_noisy, by_noisy) = columns
    size = np.linalg.norm(own, axis=0)
    assert np.all(np.linalg.norm(by - own, axis=0) < 0.1 * size)
    # rows at rest are others under noise: acceleration beside gravity
    share = [c[0] / c[3] for c in (np.linalg.norm(x, axis=0) for x in (own, by_noisy, own_noisy))]
    assert share[1] == pytest.approx(share[0], rel=0.05)
    assert share[2] > 2 * share[0]
    mix = mixed(own, by)
    np.testing.assert_allclose((by @ mix).T @ own, (by @ mix).T @ (by @ mix), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("middle", [1.3, 0.0, -0.7, -4.0, -60.0])
def test_the_mean_square_of_a_cut_normal_variable(middle: float) -> None:
    """Against the integral."""
    x = np.linspace(0.0, 12.0, 400_001)
    law = np.exp(-0.5 * (x - middle) ** 2 + 0.5 * min(middle, 0.0) ** 2)
    assert cut_square(middle, 1.0) == pytest.approx(np.sum(x**2 * law) / np.sum(law), rel=1e-2)


def test_a_neighbour_of_a_parameter_at_its_bound_is_less_sure_than_without_that_one() -> None:
    """A viscous friction that noise makes zero may be there: what it would take of the dry one
    belongs to the band of the dry one."""
    effects = ("viscous@link", "coulomb@link", "gravity")
    record, true = slow(3, level=2e-4, loud=1.0, viscous=0.05, coulomb=0.5)
    found, alone = (fit(replace(ARM, effects=e), [record]).solution for e in (effects, effects[1:]))
    assert "link_viscous" in found.at_bound
    error, least = found.stderr["link_coulomb"], alone.stderr["link_coulomb"]
    assert error is not None
    assert least is not None
    assert error > 1.2 * least
    assert abs(found.values["link_coulomb"] - true["link_coulomb"]) < 2 * error


def test_what_noise_is_taken_off_by_does_not_run_away_from_a_law_with_shapes(
    tmp_path: Path,
) -> None:
    """On steps at 100 Hz the correction sent Coulomb friction to zero and Stribeck friction to 580
    N.m, with six times the squares: more than the noise can have hidden where it began.
    """
    case = make_case(13306, names=("stribeck",), size=1.0)
    folder = write_case(case, tmp_path, "all")
    joint = load_joint(folder / "joint.toml")
    joint = replace(joint, effects=(*joint.effects, "stribeck@motor"))
    found = fit(joint, read(folder / "train.csv", joint=joint)).solution.values
    assert found["motor_coulomb"] == pytest.approx(case.values["M_TC"], rel=0.3)
    assert found["motor_stribeck_extra"] == pytest.approx(case.values["M_TS"], rel=0.3)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("far", [1e100, 1e200, 1e300])
def test_a_correction_that_runs_away_ends_where_the_least_squares_did(
    far: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 125 Hz, with a tenth of the samples lost, it went to 1e278 in three steps, and the next
    one ended in an internal error.
    """
    record, _ = run(0)

    def runs_away(self: _Equations, *_: object, **__: object) -> FloatArray:
        return np.where(self.problem.bent, 0.0, far)

    monkeypatch.setattr(_Equations, "next_step", runs_away)
    found = fit(JOINT, [record]).solution
    monkeypatch.setattr(_Equations, "next_step", lambda self, *_, **__: np.zeros(len(self.x)))
    still = fit(JOINT, [record.renamed("again")]).solution
    assert found.values["link_inertia"] == pytest.approx(still.values["link_inertia"], rel=1e-9)


@pytest.mark.parametrize("noise", [1.0, 3.0])
def test_a_trial_has_the_products_of_signals_without_noise(noise: float) -> None:
    """Of the columns of the model and of one that is tried, in the rows that both records have."""
    (noisy, _), (calm, _) = run(0, noise=noise), run(0, noise=0.0)
    model = prepared_model(JOINT, noisy)
    data, still = (load_dataset([r], [], JOINT, model) for r in (noisy, calm))
    solution = solve(model, data)
    assert solution.noise_off
    base, plain = make_base(solution, data), make_base(replace(solution, noise_off=False), still)
    assert base.noise is not None and plain.noise is None
    drag = model.add("quadratic_drag@link")
    tried = Candidate(
        "quadratic_drag@link", EFFECTS["quadratic_drag"], "link", drag, ("link_quadratic_drag",), ()
    )
    balances = balances_of(drag, data.sensing, wrt=tried.amplitudes, columns_only=True)
    both = (base.block >= 0) & (plain.block >= 0)
    grams, size = [], np.ones(1)
    for seen in (base, plain):
        column = columns(tried, seen, {}, seen.data.train, balances) * seen.weight[:, None]
        size = np.linalg.norm(column, axis=0) if seen is base else size
        rows = np.column_stack([seen.jacobian * seen.norms / base.norms, column / size])[both]
        grams.append(rows.T @ rows)
    added = noise_beside(tried, base, base.noise, {}, size).sum(axis=0)[:-1, :-1]
    share = float(np.mean(both) / np.mean(base.block >= 0))
    off, left = (np.abs(g - grams[1]).max() for g in (grams[0], grams[0] - share * added))
    assert off > 0.03 * noise
    assert left < 0.1 * off


def test_the_equations_of_a_fit_hold_where_a_trial_starts() -> None:
    """What the columns have in common with the residual is what noise gives both."""
    record, _ = run(0)
    data = load_dataset([record], [], JOINT, prepared_model(JOINT, record))
    base = make_base(solve(prepared_model(JOINT, record), data), data)
    assert base.noise is not None
    meeting = base.jacobian[base.order].T @ base.noise.residual
    pulled = sum(base.noise.score.values())
    assert np.abs(pulled).max() > 1.0
    assert meeting == pytest.approx(pulled, abs=1e-6 * float(np.abs(pulled).max()))


@pytest.mark.slow
def test_a_law_beside_encoders_of_twelve_bits_is_named(tmp_path: Path) -> None:
    """By plain least squares laws led that let the inertia of the link be another, which passes
    less noise on, and the hidden hysteresis was none of the first five.
    """
    folder = write_case(make_case(254002, kind="pair", size=1.0), tmp_path, "encoders")
    joint = load_joint(folder / "joint.toml")
    train, held = (read(folder / f"{n}.csv", joint=joint) for n in ("train", "test"))
    found = improve(train, joint, [held])
    assert found.verdict == "complete"
    assert {"stribeck", "hysteresis"} <= {n for c in found.claims for n in c.effects}
    assert all(e.ratio < 1.2 for e in found.steps[-1].held_out.balances.values())
