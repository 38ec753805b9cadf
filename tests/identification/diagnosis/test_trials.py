"""Trials of candidates against the same sums written out plainly, and against known truths."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import f as fisher

from casadi_models import EFFECTS
from identification.balance.balances import balances_of
from identification.balance.weak import prepare
from identification.data.check.gate import passed
from identification.data.joint_file import Joint, Known, load_joint
from identification.data.read import read
from identification.diagnosis import trials
from identification.diagnosis.candidates import Candidate, NotTestable
from identification.diagnosis.claims import MAJOR_DROP
from identification.diagnosis.trials import (
    FOLDS,
    KERNEL_SHARE,
    UNNAMED_LINE,
    Base,
    Trial,
    _all_noise,
    _refined,
    _unit,
    _unseen_sizes,
    by_whole_fit,
    columns,
    effective_share,
    make_base,
    span_of,
    try_candidate,
)
from identification.fitting.engine import load_dataset, prepared_model, solve
from identification.fitting.errors_in_variables.products import MOST_NOISE, shares
from identification.fitting.start_values import bounds_of
from identification.fitting.weak_form import WeakForm
from identification.naming.contest import rivals_of
from tests.identification.fitting.test_errors_in_variables import JOINT as ARM
from tests.identification.fitting.test_errors_in_variables import run as slow_run
from tests.recorded_world.world import TROUBLES, make_case, write_case
from tests.smooth_laws import COULOMB, Law, record

FloatArray = npt.NDArray[np.float64]
SIZE, PHASE = 6.0, 0.7


def wave(q: FloatArray, v: FloatArray) -> FloatArray:
    """`cyclic_torque` of the library."""
    return SIZE * np.sin(q + PHASE)


def made(
    law: Law,
    seconds: float = 12.0,
    held: bool = True,
    seed: int = 0,
    effects: tuple[str, ...] = ("viscous", "coulomb"),
    known: Mapping[str, Known] = MappingProxyType({}),
) -> Base:
    """Plain sums: as where a fit takes no noise off."""
    joint = Joint(model_name="hd1", effects=effects, known=known)
    runs = [record(np.random.default_rng([seed, k]), seconds, law) for k in (0, 1)]
    model = prepared_model(joint, runs[0])
    data = load_dataset(runs[:1], runs[1:] if held else [], joint, model)
    return replace(make_base(solve(model, data), data), noise=None)


@pytest.fixture(scope="module")
def base() -> Base:
    return made(wave)


def candidate(base: Base, key: str, place: str = "motor") -> Candidate:
    label = f"{key}@{place}"
    model = base.solution.model.add(label)
    (term,) = (t for t in model.terms if t.effect.key == key and t.place == place)
    shapes = {p.name for p in term.parameters if p.is_shape}
    names = tuple(n for n in term.names if n not in shapes)
    return Candidate(label, EFFECTS[key], place, model, names, tuple(shapes))  # type: ignore[arg-type]


def tried(base: Base, key: str, place: str = "motor") -> Trial:
    found = try_candidate(candidate(base, key, place), base)
    assert isinstance(found, Trial)
    return found


def without_friction(base: Base) -> Base:
    """The base whose friction stands at zero, and with it is missing on all records."""
    number = base.names.index("motor_coulomb")
    others, held_others = (
        np.delete(c, number, axis=1) for c in (base.jacobian, base.held_jacobian)
    )
    friction, held_friction = base.jacobian[:, [number]], base.held_jacobian[:, [number]]
    q = span_of(others)
    left = base.residual - 1e3 * friction[:, 0]
    missing = np.linalg.lstsq(others, left, rcond=None)[0]
    return replace(
        base,
        jacobian=others,
        orthonormal=q,
        inward=friction,
        residual=left - q @ (q.T @ left),
        names=tuple(n for n in base.names if n != "motor_coulomb"),
        norms=np.delete(base.norms, number),
        held_jacobian=held_others,
        held_inward=held_friction,
        held_residual=base.held_residual - 1e3 * held_friction[:, 0] - held_others @ missing,
    )


def raw_columns(base: Base, found: Trial) -> FloatArray:
    """Weighted columns of a trial at its shape."""
    balances = balances_of(
        found.candidate.model,
        base.data.sensing,
        wrt=found.candidate.amplitudes,
        columns_only=True,
    )
    shapes = {n: found.values[n] for n in found.candidate.shapes}
    raw = columns(found.candidate, base, shapes, base.data.train, balances)
    return raw * base.weight[:, None]


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-6])
def test_a_shape_that_the_rows_do_not_show_takes_no_step(base: Base, size: float) -> None:
    """A smoothing velocity that is passed between two samples moves no training row, but may move
    the turn of another record: a step along it would be of any length there.
    """
    name = "motor_smoothing_velocity"
    values = {**base.solution.values, name: size * base.solution.values[name]}
    solution = replace(
        base.solution, values=values, model=base.solution.model.with_values({name: values[name]})
    )
    made_base = make_base(solution, base.data)
    shown = dict(zip(made_base.names, made_base.norms, strict=True))
    assert all(shown[n] * values[n] >= 1.0 for n in shown if n == name)
    if size < 1e-4:
        assert name not in shown
    found = try_candidate(candidate(base, "cyclic_torque"), made_base)
    assert isinstance(found, Trial)
    assert found.held_out_drop_percent > 10.0


# --- small parts ----------------------------------------------------------------------------------


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8])
def test_rows_that_count_in_a_process_of_first_order(rho: float) -> None:
    """Of n samples of such a process n (1 - rho)/(1 + rho) count for its mean."""
    rng = np.random.default_rng(0)
    x = np.zeros(200_000)
    noise = rng.standard_normal(len(x))
    for k in range(1, len(x)):
        x[k] = rho * x[k - 1] + noise[k]
    assert effective_share(x + 3.0) == pytest.approx((1 - rho) / (1 + rho), rel=0.15)


@pytest.mark.parametrize("dt", [1e-3, 2e-3, 4e-3])
def test_rows_of_white_noise_count_by_what_their_kernels_share(dt: float) -> None:
    """Four rows to a kernel: no more count than such rows tell, and no third less."""
    time = dt * np.arange(round(200 / dt))
    noise = np.random.default_rng(0).standard_normal(len(time))
    signals = {"motor_position": np.sin(time), "drive": noise}
    rows = prepare(time, signals, (slice(0, len(time)),))
    assert rows.grid.length / (rows.grid.stride * dt) == pytest.approx(4.0, rel=0.1)
    assert 2 / 3 < KERNEL_SHARE / effective_share(rows.averaged["drive"]) < 1


def test_rows_that_count_where_nothing_is_left() -> None:
    assert effective_share(np.zeros(100)) == 1.0
    assert effective_share(np.full(100, 2.0)) == 1.0


def test_a_span_leaves_out_what_is_there_twice() -> None:
    rng = np.random.default_rng(1)
    a = rng.standard_normal((50, 3))
    q = span_of(np.column_stack([a, a @ [1.0, 2.0, 3.0]]))
    assert q.shape == (50, 3)
    assert q.T @ q == pytest.approx(np.eye(3), abs=1e-12)
    assert q @ (q.T @ a) == pytest.approx(a, abs=1e-12)
    assert span_of(np.zeros((50, 0))).shape == (50, 0)


def test_the_best_shape_lies_between_the_points_of_the_grid() -> None:
    def projected(shapes: dict[str, float]) -> tuple[float, FloatArray, float]:
        gap = math.log(shapes["a"] / 0.37) ** 2 + 2 * math.log(shapes["b"] / 5.3) ** 2
        return 10.0 - gap, np.zeros((1, 1)), 1.0

    start = {"a": 0.25, "b": 7.0}
    best = _refined(
        projected, (*projected(start)[:1], start, np.zeros((1, 1))), {"a": (0.1, 1), "b": (1, 9)}
    )
    assert best[1]["a"] == pytest.approx(0.37, rel=0.1)
    assert best[1]["b"] == pytest.approx(5.3, rel=0.1)
    bound = _refined(projected, (*projected(start)[:1], start, np.zeros((1, 1))), {"a": (0.1, 0.3)})
    assert bound[1] == {"a": 0.3, "b": 7.0}


@pytest.mark.parametrize(("away", "left"), [(2.4, 0.2), (0.1, 0.05), (-2.4, 0.2), (-0.1, 0.05)])
def test_the_best_shape_is_found_far_away_and_near(away: float, left: float) -> None:
    """Steps stay long while they help and become short where they do not."""

    def projected(shapes: dict[str, float]) -> tuple[float, FloatArray, float]:
        return -abs(math.log(shapes["a"]) - away), np.zeros((1, 1)), 1.0

    start = {"a": 1.0}
    best = _refined(projected, (projected(start)[0], start, np.zeros((1, 1))), {"a": (0.01, 100)})
    assert abs(math.log(best[1]["a"]) - away) < left
    assert best[0] == projected(best[1])[0]


# --- the base -------------------------------------------------------------------------------------


def test_held_out_rows_that_are_the_training_rows_have_their_columns() -> None:
    """Those of an amplitude at its bound, too."""
    driven = made(lambda q, v: -2 * COULOMB * np.sign(v), held=False)
    assert driven.inward.shape[1] == 1
    alike = make_base(driven.solution, replace(driven.data, held_out=driven.data.train))
    for own, held in (
        (alike.jacobian, alike.held_jacobian),
        (alike.inward, alike.held_inward),
        (alike.balance, alike.held_balance),
    ):
        assert held.shape == own.shape
        assert held == pytest.approx(own, abs=1e-9)
    whole = alike.held_residual - alike.orthonormal @ (alike.orthonormal.T @ alike.held_residual)
    assert whole == pytest.approx(alike.residual, abs=1e-6)
    # without held-out records there are the same columns and no rows
    for one, other in (
        (driven.held_jacobian, alike.held_jacobian),
        (driven.held_inward, alike.held_inward),
        (driven.held_own, alike.held_own),
        (driven.held_residual, alike.held_residual),
        (driven.held_balance, alike.held_balance),
        (driven.held_weight, alike.held_weight),
    ):
        assert one.shape == (0, *other.shape[1:])


@pytest.mark.parametrize("upper", [False, True])
def test_an_amplitude_that_a_bound_holds_can_only_step_back_from_it(upper: bool) -> None:
    """Friction that would have to drive the joint, and friction that may be half of what is there:
    up from the lower bound, down from the upper one. Such a step leaves more, and no trial moves
    the amplitude as it moves what is free.
    """
    name = "motor_coulomb"
    held = (
        made(lambda q, v: 0 * q, held=False, known={name: Known(high=COULOMB / 2)})
        if upper
        else made(lambda q, v: -2 * COULOMB * np.sign(v), held=False)
    )
    assert held.solution.values[name] == pytest.approx(COULOMB / 2 if upper else 0.0)
    assert held.inward_names == (name,)
    assert name not in held.names
    assert held.residual @ held.inward[:, 0] > 0
    free = make_base(replace(held.solution, at_bound=()), held.data)
    more, way = free.jacobian[:, free.names.index(name)], -1 if upper else 1
    assert held.inward[:, 0] == pytest.approx(way * more)
    assert held.inward_norms == pytest.approx([way * free.norms[free.names.index(name)]])


@pytest.mark.parametrize("off", [1e-9, 1e-3])
def test_an_amplitude_a_little_inside_its_bound_steps_back_from_the_nearer_one(off: float) -> None:
    """Friction that may be half of what is there: from the upper bound, though it is not on it."""
    name, high = "motor_coulomb", COULOMB / 2
    held = made(lambda q, v: 0 * q, held=False, known={name: Known(high=high)})
    for value, way in ((high * (1 - off), -1), (high * off, 1)):
        inside = replace(held.solution, values={**held.solution.values, name: value})
        assert make_base(inside, held.data).inward_norms * way > 0


def test_the_speed_over_which_friction_turns_is_free_at_its_bound(base: Base) -> None:
    name = "motor_smoothing_velocity"
    found = make_base(replace(base.solution, at_bound=(name, "motor_viscous")), base.data)
    assert name in found.names
    assert found.inward_names == ("motor_viscous",)
    assert set(found.names) == set(base.names) - {"motor_viscous"}


def test_the_base_leaves_nothing_that_its_own_columns_explain(base: Base) -> None:
    q = base.orthonormal
    assert q.T @ q == pytest.approx(np.eye(q.shape[1]), abs=1e-10)
    assert np.abs(q.T @ base.residual).max() < 1e-9 * np.linalg.norm(base.residual)
    assert np.linalg.norm(base.jacobian, axis=0) == pytest.approx(1.0)
    assert len(base.names) == base.jacobian.shape[1] == len(base.norms)
    assert {"motor_viscous", "motor_coulomb"} <= set(base.names)


def test_blocks_and_balances_are_counted_once(base: Base) -> None:
    used = base.block >= 0
    assert sorted(base.order.tolist()) == np.flatnonzero(used).tolist()
    assert base.numbers.sum() == used.sum()
    for b in range(base.blocks):
        for k in range(len(base.balances)):
            assert base.numbers[b, k] == np.sum((base.block == b) & (base.balance == k))
    assert base.folds == (FOLDS if base.blocks >= 32 else min(base.blocks, 10))
    held = np.array(base.held_out_folds())
    assert (held.sum(axis=0) == 1).all()


@pytest.mark.parametrize("blocks", [None, 2, 3])
def test_what_the_base_leaves_of_blocks_that_it_was_not_fitted_to(
    blocks: int | None, base: Base
) -> None:
    """The same by a fit of the rows themselves, fold by fold; of two blocks, too."""
    if blocks is not None:
        base = replace(base, block=np.where(base.block >= 0, base.block % blocks, -1))
        assert base.folds == blocks
    assert base.inward.shape[1] == 0
    used = base.block >= 0
    for out in base.held_out_folds():
        inside = used & ~np.isin(base.block, np.flatnonzero(out))
        fit = np.linalg.lstsq(base.jacobian[inside], -base.residual[inside], rcond=None)[0]
        for b in np.flatnonzero(out):
            rows = base.block == b
            left = base.residual[rows] + base.jacobian[rows] @ fit
            assert base.crossed[b].sum() == pytest.approx(left @ left, rel=1e-6)


# --- a trial --------------------------------------------------------------------------------------


def test_the_law_that_is_there_is_found_with_its_size(base: Base) -> None:
    found = tried(base, "cyclic_torque")
    amplitudes = [found.values[n] for n in found.candidate.amplitudes]
    assert math.hypot(*amplitudes) == pytest.approx(SIZE, rel=0.05)
    assert found.contribution == pytest.approx(SIZE / math.sqrt(2), rel=0.15)
    assert found.cv_drop_percent > 70
    assert found.held_out_drop_percent > 70
    assert found.p_value < 1e-6
    assert found.balance == base.balances[0]
    assert found.score > 0.9 * max(
        t.score
        for key in ("stribeck", "added_spring", "quadratic_drag")
        if isinstance(t := try_candidate(candidate(base, key), base), Trial)
    )


def test_a_fall_counts_for_nothing_where_a_torque_leaves_its_balance(
    base: Base, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where a candidate sends the inertia of a balance to nothing, and its torque with it."""
    assert base.torques_alone[base.balances[0]] > 0
    monkeypatch.setattr(trials, "_torques_alone", lambda *_: dict.fromkeys(base.balances, 0.0))
    found = tried(base, "cyclic_torque")
    assert found.cv_drop_percent > 70
    assert found.beyond_noise(found.cv_drop_percent) < 0


def test_the_figures_of_a_trial_by_plain_sums(base: Base) -> None:
    found = tried(base, "cyclic_torque")
    c = raw_columns(base, found)
    both = np.column_stack([base.jacobian, c])
    used = base.block >= 0
    before, after = np.zeros(base.blocks), np.zeros(base.blocks)
    for out in base.held_out_folds():
        inside = used & ~np.isin(base.block, np.flatnonzero(out))
        plain = np.linalg.lstsq(base.jacobian[inside], -base.residual[inside], rcond=None)[0]
        more = np.linalg.lstsq(both[inside], -base.residual[inside], rcond=None)[0]
        for b in np.flatnonzero(out):
            rows = base.block == b
            before[b] = np.sum((base.residual + base.jacobian @ plain)[rows] ** 2)
            after[b] = np.sum((base.residual + both @ more)[rows] ** 2)
    rows_in = int(used.sum())
    falls = math.log(before.sum() / after.sum())
    assert found.cv_drop_percent == pytest.approx(
        100 * (1 - math.sqrt(after.sum() / before.sum())), rel=1e-4
    )
    assert found.score == pytest.approx(KERNEL_SHARE * rows_in / 2 * falls, rel=1e-4)
    assert found.gain == pytest.approx(base.share[0] * rows_in / 2 * falls, rel=1e-4)
    assert found.rms[0] == pytest.approx(math.sqrt(after.sum() / rows_in), rel=1e-4)
    score = (before - after) / (2 * after.sum() / rows_in) * base.share[0]
    assert found.block_score == pytest.approx(score, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("left", [0.5, 1.0, 3.0])
def test_a_whole_fit_counts_by_what_it_leaves_of_each_row(left: float, base: Base) -> None:
    """So many deviations of each training row, and half of what the base leaves held out."""
    found = tried(base, "cyclic_torque")
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(base.weight))
    kept = base.held_residual - base.held_own @ (base.held_own.T @ base.held_residual)
    values = dict.fromkeys(found.values, 7.0)
    whole = by_whole_fit(
        found,
        base,
        values,
        left=left * signs / base.weight,
        held_left=0.5 * kept / base.held_weight,
    )
    assert whole.values == values
    assert whole.rms == pytest.approx(np.full(len(base.balances), left))
    before = math.sqrt(float(base.crossed.sum()) / int(np.sum(base.block >= 0)))
    assert whole.cv_drop_percent == pytest.approx(100 * (1 - left / before))
    assert whole.held_out_drop_percent == pytest.approx(50.0)
    assert math.isnan(
        by_whole_fit(
            found, base, values, left=signs / base.weight, held_left=np.empty(0)
        ).held_out_drop_percent
    )


def test_a_shape_a_little_beyond_its_grid_is_found() -> None:
    """The widest velocity that is tried is three tenths of the range; this law has more."""
    key, name = "stribeck", "motor_stribeck_velocity"
    grid = next(p for p in EFFECTS[key].parameters if p.name == "stribeck_velocity").grid
    range_ = made(wave, held=False).data.ranges["velocity"]
    width = 1.15 * grid[-1] * range_
    hidden = made(lambda q, v: 15 * np.exp(-np.abs(v) / width) * np.sign(v), held=False)
    assert hidden.data.ranges["velocity"] == pytest.approx(range_, rel=0.01)
    found = tried(hidden, key)
    assert found.values[name] == pytest.approx(width, rel=0.07)


@pytest.mark.parametrize("key", ["stribeck", "smooth_stribeck", "load_dependent_presliding"])
def test_shapes_that_a_trial_looks_at_are_those_that_a_fit_may_have(
    key: str, base: Base, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fit that starts at the shape of a trial is not moved to a bound first."""
    seen: dict[str, tuple[float, float]] = {}

    def refined(projected: Any, best: Any, limits: Mapping[str, tuple[float, float]]) -> Any:
        seen.update(limits)
        return _refined(projected, best, limits)

    monkeypatch.setattr(trials, "_refined", refined)
    monkeypatch.setattr(trials, "REFINE_SHARE", 0.0)
    found = tried(base, key)
    bounds = bounds_of(found.candidate.model, {}, base.data)
    assert seen
    for name, (low, high) in seen.items():
        assert bounds[name][0] <= low < high <= bounds[name][1]
        assert low <= found.values[name] <= high


@pytest.mark.parametrize(("order", "elsewhere"), [(2.5, True), (2.52, True), (3.3, False)])
def test_a_line_that_another_order_explains_better_is_no_effect_of_its_own_orders(
    order: float, elsewhere: bool
) -> None:
    """Of orders of the motor turn at 2.5; the law may have 1, 2, 4 and 6."""
    ripple = made(lambda q, v: SIZE * np.sin(2.5 * q + PHASE), held=False)
    beside = replace(ripple, data=replace(ripple.data, other_orders=(order,)))
    before = tried(ripple, "torque_ripple")
    found = try_candidate(candidate(beside, "torque_ripple"), beside)
    if elsewhere:
        assert isinstance(found, NotTestable)
        assert (found.effect, found.why) == ("torque_ripple", UNNAMED_LINE)
    else:
        assert isinstance(found, Trial)
        assert found.values == before.values
    # what has no order is tried as ever
    assert tried(beside, "cyclic_torque").values == tried(ripple, "cyclic_torque").values


@pytest.mark.parametrize("times", [1e-18, 1e-8, 1e8])
@pytest.mark.parametrize("key", ["cyclic_torque", "quadratic_drag"])
def test_a_trial_is_the_same_in_any_unit_of_the_noise(key: str, times: float, base: Base) -> None:
    """Rows that all weigh so many times more say the same of every law."""
    other = replace(
        base,
        weight=times * base.weight,
        residual=times * base.residual,
        norms=times * base.norms,
        held_weight=times * base.held_weight,
        held_residual=times * base.held_residual,
    )
    before, after = tried(base, key), tried(other, key)
    assert after.values == pytest.approx(before.values, rel=1e-4)
    for figure in ("score", "cv_drop_percent", "held_out_drop_percent", "contribution"):
        assert getattr(after, figure) == pytest.approx(getattr(before, figure), rel=1e-4)
    assert math.log(after.p_value) == pytest.approx(math.log(before.p_value), rel=1e-4)


def test_the_size_by_one_fit_of_all_rows(base: Base) -> None:
    found = tried(base, "cyclic_torque")
    used = base.block >= 0
    both = np.column_stack([base.jacobian, raw_columns(base, found)])[used]
    fit = np.linalg.lstsq(both, -base.residual[used], rcond=None)[0]
    sizes = [found.values[n] for n in found.candidate.amplitudes]
    assert sizes == pytest.approx(fit[base.jacobian.shape[1] :], rel=1e-4)


def test_the_chance_of_a_size_by_scores_of_blocks(base: Base) -> None:
    """Arellano's sandwich over blocks, F with blocks minus amplitudes degrees of freedom."""
    weak = made(lambda q, v: 0.12 * np.sin(q + PHASE))
    found = tried(weak, "cyclic_torque")
    used = weak.block >= 0
    c = np.where(used[:, None], raw_columns(weak, found), 0.0)  # rows of blocks alone are fitted
    q = np.linalg.qr(np.where(used[:, None], weak.jacobian, 0.0))[0]
    c = c - q @ (q.T @ c)
    fit = np.linalg.lstsq(
        np.column_stack([weak.jacobian, raw_columns(weak, found)])[used],
        -weak.residual[used],
        rcond=None,
    )[0]
    own = fit[weak.jacobian.shape[1] :]
    left = weak.residual + np.column_stack([weak.jacobian, raw_columns(weak, found)]) @ fit
    marks = [b for b in range(weak.blocks) if (weak.block == b).any()]
    s = np.array([(c * left[:, None])[weak.block == b].sum(axis=0) for b in marks])
    inverse = np.linalg.inv(c.T @ c)
    n = len(marks)
    covariance = inverse @ s.T @ s @ inverse * n / (n - 1)
    statistic = own @ np.linalg.solve(covariance, own) / len(own)
    expected = fisher.sf(statistic, len(own), n - len(own))
    assert 1e-12 < expected < 0.5
    assert found.p_value == pytest.approx(expected, rel=0.05)
    del base


def test_the_fall_on_records_that_the_fit_never_saw(base: Base) -> None:
    found = tried(base, "cyclic_torque")
    balances = balances_of(
        found.candidate.model, base.data.sensing, wrt=found.candidate.amplitudes, columns_only=True
    )
    used = base.block >= 0
    both = np.column_stack([base.jacobian, raw_columns(base, found)])
    fit = np.linalg.lstsq(both[used], -base.residual[used], rcond=None)[0]
    shapes = {n: found.values[n] for n in found.candidate.shapes}
    c = columns(found.candidate, base, shapes, base.data.held_out, balances)
    held = np.column_stack([base.held_jacobian, c * base.held_weight[:, None]])
    after = base.held_residual + held @ fit
    ratio = np.linalg.norm(after) / np.linalg.norm(base.held_residual)
    assert found.held_out_drop_percent == pytest.approx(100 * (1 - ratio), rel=1e-4)
    alone = made(wave, held=False)
    assert math.isnan(tried(alone, "cyclic_torque").held_out_drop_percent)


def test_the_fall_on_held_out_records_is_beside_what_is_their_own() -> None:
    """What these records leave of it, a clock or a zero, says nothing for a law; a friction that
    leaves its bound for the law goes with it.
    """
    base = without_friction(made(lambda q, v: v * np.abs(v)))
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((len(base.held_residual), 2))
    size = np.linalg.norm(base.held_residual) / np.linalg.norm(noise)
    own = np.column_stack([base.held_residual + size * noise[:, 0], noise[:, 1]])
    found = tried(replace(base, held_own=span_of(own)), "quadratic_drag")
    balances = balances_of(
        found.candidate.model, base.data.sensing, wrt=found.candidate.amplitudes, columns_only=True
    )
    used = base.block >= 0
    both = np.column_stack([base.jacobian, base.inward, raw_columns(base, found)])
    fit = np.linalg.lstsq(both[used], -base.residual[used], rcond=None)[0]
    assert fit[base.jacobian.shape[1]] > 0
    c = columns(found.candidate, base, {}, base.data.held_out, balances)
    held = np.column_stack([base.held_jacobian, base.held_inward, c * base.held_weight[:, None]])
    before, after = (
        x - own @ np.linalg.lstsq(own, x, rcond=None)[0]
        for x in (base.held_residual, base.held_residual + held @ fit)
    )
    ratio = np.linalg.norm(after) / np.linalg.norm(before)
    assert found.held_out_drop_percent == pytest.approx(100 * (1 - ratio), rel=1e-6)
    alone = tried(base, "quadratic_drag").held_out_drop_percent
    assert abs(found.held_out_drop_percent - alone) > 1.0


def test_what_the_model_has_already_is_not_testable(base: Base) -> None:
    twin = replace(candidate(base, "cyclic_torque"), label="again")
    found = tried(base, "cyclic_torque")
    c = raw_columns(base, found)
    wider = np.column_stack([base.jacobian, c / np.linalg.norm(c, axis=0)])
    with_it = replace(base, jacobian=wider, orthonormal=span_of(wider))
    said = try_candidate(replace(twin, shapes=()), with_it)
    assert isinstance(said, NotTestable)
    assert said.effect == "cyclic_torque"
    alike = ", ".join(EFFECTS[k].title for k in EFFECTS["cyclic_torque"].confused_with)
    assert said.why.startswith(f"on these records it cannot be told from {alike}; ")
    assert said.why.endswith(f"{EFFECTS['cyclic_torque'].separate_by} would separate them")


@pytest.mark.parametrize(("share", "testable"), [(0.003, True), (0.0015, False)])
def test_what_is_testable_has_two_parts_in_a_thousand_of_its_own(
    share: float, testable: bool, base: Base
) -> None:
    """A column that the base holds but for a share of it."""
    one = candidate(base, "quadratic_drag")
    balances = balances_of(one.model, base.data.sensing, wrt=one.amplitudes, columns_only=True)
    (c,) = (columns(one, base, {}, base.data.train, balances) * base.weight[:, None]).T
    c = c / np.linalg.norm(c)
    noise = np.random.default_rng(0).standard_normal(len(c))
    noise -= c * (c @ noise)
    noise /= np.linalg.norm(noise)
    inside = math.sqrt(1 - share**2) * c + share * noise
    holding = replace(base, jacobian=inside[:, None], orthonormal=inside[:, None], names=("c",))
    outside = c - inside * (inside @ c)
    assert np.linalg.norm(outside) == pytest.approx(share)
    # something is left that the column explains
    left = base.residual - 1e5 * outside
    found = try_candidate(
        one, replace(holding, residual=left, norms=np.ones(1), held_residual=np.empty(0))
    )
    assert isinstance(found, Trial if testable else NotTestable)


@pytest.mark.parametrize(("count", "says"), [(2, False), (3, False), (4, True), (5, True)])
def test_a_chance_takes_two_blocks_more_than_amplitudes(count: int, says: bool, base: Base) -> None:
    """Two amplitudes: three blocks leave one degree of freedom, which is not asked."""
    few = replace(base, block=np.where(base.block >= 0, base.block % count, -1))
    found = tried(few, "cyclic_torque")
    assert len(found.candidate.amplitudes) == 2
    assert (found.p_value < 0.05) == says
    assert says or found.p_value == 1.0


def test_an_amplitude_that_leaves_its_bound_counts_like_a_free_one() -> None:
    """A drag's size and chance are the same whether the friction beside it was free before or stood
    at zero: the two are alike.
    """
    base = made(lambda q, v: v * np.abs(v))
    bound = replace(without_friction(base), held_residual=np.empty(0))
    free, returned = tried(base, "quadratic_drag"), tried(bound, "quadratic_drag")
    for n in free.candidate.amplitudes:
        assert returned.values[n] == pytest.approx(free.values[n], rel=1e-6)
    assert 0 < free.p_value < 0.1
    assert returned.p_value == pytest.approx(free.p_value, rel=1e-4)


def test_a_size_is_seen_where_all_of_it_moves_the_rows_by_a_deviation(base: Base) -> None:
    """Only of shapes and smoothing: an amplitude without rows is another matter."""
    names = ("motor_smoothing_velocity", "motor_coulomb")
    size = np.array([base.solution.values[n] for n in names])
    for moves in (0.6, 1.5):
        assert _unseen_sizes(base.solution, names, moves / size).tolist() == [moves < 1, False]


@pytest.mark.parametrize("share", [-0.5, -0.1, 0.3])
def test_noise_alone_counts_at_the_parameters_that_a_candidate_leaves(
    share: float, base: Base
) -> None:
    """Noise of the acceleration goes with the inertia; where it would grow it is not paid for."""
    one = candidate(base, "quadratic_drag")
    number = base.names.index("inertia")
    value = base.solution.values["inertia"]
    delta = np.zeros(len(base.names) + 1)
    delta[number] = share * value * base.norms[number]
    values = {**base.solution.values, "inertia": (1 + share) * value}
    moved = replace(base, solution=replace(base.solution, values=values))
    expected = moved.noise_alone["axis"] / base.noise_alone["axis"]
    assert (expected < 0.999) == (share < 0), "the inertia carries a part of the noise"
    (unit,) = _unit(one, base, {"motor_quadratic_drag": 0.0}, delta)
    assert unit == pytest.approx(min(expected, 1.0))


def test_nothing_is_found_where_nothing_is_hidden() -> None:
    """Of 24 trials on joints without a hidden law hardly one has a chance under a hundredth."""
    chances = []
    for seed in (1, 2, 3):
        plain = made(lambda q, v: 0 * q, seed=seed)
        for key in ("cyclic_torque", "added_spring", "quadratic_drag", "cyclic_friction"):
            found = try_candidate(candidate(plain, key), plain)
            if isinstance(found, Trial):
                chances.append(found.p_value)
                assert found.cv_drop_percent < 2.0
                assert found.held_out_drop_percent < 2.0
    assert len(chances) >= 8
    assert min(chances) > 1e-4
    assert np.median(chances) > 0.05


def test_an_amplitude_of_the_wrong_sign_is_no_trial() -> None:
    """Friction that drives is no friction."""
    driven = made(lambda q, v: -2 * COULOMB * np.sign(v), effects=("viscous",))
    assert try_candidate(candidate(driven, "coulomb"), driven) is None
    braked = made(lambda q, v: 0 * q, effects=("viscous",))
    assert tried(braked, "coulomb").values["motor_coulomb"] == pytest.approx(COULOMB, rel=0.1)


def test_an_amplitude_at_its_bound_may_leave_it_when_a_candidate_is_tried() -> None:
    driven = made(lambda q, v: -2 * COULOMB * np.sign(v))
    assert "motor_coulomb" in driven.solution.at_bound
    assert driven.inward.shape[1] == 1
    assert np.linalg.norm(driven.inward, axis=0) == pytest.approx(1.0)
    p, own = driven.parts
    assert (p, own) == (driven.jacobian.shape[1], driven.jacobian.shape[1] + 1)


@pytest.fixture(scope="module")
def elastic() -> Base:
    """7.5 s of the demo's joint: three balances, plain sums."""
    folder = Path(__file__).resolve().parents[3] / "workbench" / "demo"
    joint = load_joint(folder / "joint.toml")
    train, held = (
        passed(read(folder / f"{n}.npz", joint.columns, joint.kind), joint)[0].take(slice(0, 3000))
        for n in ("train", "held_out")
    )
    model = prepared_model(joint, train)
    data = load_dataset([train], [held], joint, model)
    return replace(make_base(solve(model, data), data), noise=None)


@pytest.mark.parametrize("key", ["stribeck", "torque_sensor_gain", "cubic_stiffness"])
def test_an_effect_belongs_to_the_balance_that_it_helps_most(key: str, elastic: Base) -> None:
    base, place = elastic, EFFECTS[key].acts_on[0]
    found = try_candidate(candidate(base, key, place), base)
    assert isinstance(found, Trial)
    own = np.column_stack([base.jacobian, base.inward])
    assert base.inward.shape[1] == 0
    both = np.column_stack([own, raw_columns(base, found)])
    used = base.block >= 0
    before, after = base.residual.copy(), base.residual.copy()
    for out in base.held_out_folds():
        inside = used & ~np.isin(base.block, np.flatnonzero(out))
        tested = np.isin(base.block, np.flatnonzero(out))
        plain = np.linalg.lstsq(own[inside], -base.residual[inside], rcond=None)[0]
        more = np.linalg.lstsq(both[inside], -base.residual[inside], rcond=None)[0]
        if found.effect.amplitudes[0].low == 0 and more[-1] < 0:
            more = np.append(plain, 0.0)
        before[tested] += (own @ plain)[tested]
        after[tested] += (both @ more)[tested]

    falls = []
    for k in range(len(base.balances)):
        rows = used & (base.balance == k)
        falls.append(rows.sum() * math.log(np.sum(before[rows] ** 2) / np.sum(after[rows] ** 2)))
    assert 0.5 < found.unit <= 1.0
    best = falls[base.balances.index(found.balance)]
    assert best == pytest.approx(max(falls), abs=1e-6)
    assert found.score == pytest.approx(KERNEL_SHARE / 2 * sum(falls), rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("twist", [1.0, 0.5, 0.1])
def test_the_base_holds_every_parameter_whatever_its_unit(twist: float) -> None:
    """A column in N.m per rad^3 beside one in N.m per rad: with less twist it is 1e-13 of the other
    and moves as many deviations.
    """
    folder = Path(__file__).resolve().parents[3] / "workbench" / "demo"
    joint = load_joint(folder / "joint.toml")
    record, _ = passed(read(folder / "train.npz", joint.columns, joint.kind), joint)
    record = record.take(slice(0, 3000))
    motor = record["motor_position"] / joint.gear_ratio
    stiffer = record.with_channel(
        "link_position", motor - twist * (motor - record["link_position"])
    )
    model = prepared_model(joint, stiffer).add("cubic_stiffness")
    data = load_dataset([stiffer], [], joint, model)
    solution = solve(model, data)
    assert "cubic_stiffness" not in solution.at_bound
    assert solution.stderr["cubic_stiffness"] is not None
    assert "cubic_stiffness" in make_base(solution, data).names


def test_a_gain_that_only_takes_noise_away_is_none() -> None:
    """The torque of the link follows from the motion on this axis; what is left of it is noise."""
    case = make_case(60104, without=[t for t in TROUBLES if t != "noise"], names=())
    with TemporaryDirectory() as folder:
        written = write_case(case, Path(folder), "all")
        joint = load_joint(written / "joint.toml")
        run = read(written / "train.csv", joint=joint)
    model = prepared_model(joint, run)
    data = load_dataset([run], [], joint, model)
    base = make_base(solve(model, data), data)
    found = try_candidate(candidate(base, "torque_sensor_gain", "torque_sensor"), base)
    assert isinstance(found, Trial)
    assert abs(found.values["torque_sensor_gain"]) > 0.1  # a slope over a column of noise
    assert found.cv_drop_percent > 15  # as long as nobody asks what noise alone would leave
    assert found.beyond_noise(found.cv_drop_percent) < MAJOR_DROP / 2


@pytest.mark.parametrize(("share", "alone"), [(0.5, False), (0.89, False), (0.91, True)])
def test_a_column_that_noise_makes_is_not_tried(share: float, alone: bool) -> None:
    """Nine tenths and more of what is outside the base; inside it, it may be all."""
    inside, outside = np.array([1.0, 0.0]), np.array([0.9, 0.1])
    rows = np.column_stack([inside, outside, np.zeros(2)])
    total, noise = rows.T @ rows, np.zeros((3, 3))
    noise[1, 1] = share * 0.1**2
    assert _all_noise(total, noise, 1) == alone


@pytest.mark.parametrize("balance", ["motor", "transmission"])
def test_of_several_places_a_name_stands_for_the_best_where_it_is_claimed(
    balance: str, elastic: Base
) -> None:
    key = "asymmetric_coulomb"
    tries = [
        t
        for place in ("motor", "link")
        if isinstance(t := try_candidate(candidate(elastic, key, place), elastic), Trial)
    ]
    there = [t for t in tries if t.balance == balance]
    best = max(there, key=lambda t: t.score)
    (rival,) = rivals_of([key], balance, elastic.solution, elastic.data)
    assert (rival.name, rival.label) == (key, best.candidate.label)


def test_a_shape_of_a_law_with_memory_has_the_slope_of_its_rows(elastic: Base) -> None:
    """By a one-sided step of a hundredth: the law has kinks, which smaller ones would resolve."""
    model = elastic.solution.model.add("hysteresis")
    values = {**elastic.solution.values}
    values |= {"hysteresis_width": 1e-4, "hysteresis_spread": 3.0}
    values |= {f"hysteresis_torque_{k}": 2.0 for k in (1, 2, 3)}
    free = ("hysteresis_width", "hysteresis_spread", "hysteresis_torque_1")
    balances = balances_of(model, elastic.data.sensing, wrt=free)
    ones = dict.fromkeys(balances.balances, 1.0)
    problem = WeakForm(balances, elastic.data, values, free, ones)
    x = np.array([values[n] for n in free])
    slope = problem.jacobian(x)
    for k, size in enumerate((0.01 * x[0], 0.01 * x[1], 1e-3)):
        step = np.eye(3)[k] * size
        numeric = (problem.residual(x + step) - problem.residual(x)) / size
        assert np.linalg.norm(numeric) > 0
        assert slope[:, k] == pytest.approx(numeric, rel=1e-6, abs=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize("seed", range(4, 10))
def test_noise_is_taken_off_the_rows_that_it_is_in(seed: int) -> None:
    """Slow motion of an arm: noise makes nearly all of the column of the inertia, and rows whose
    kernel touches two blocks stand in no product.
    """
    train, _ = slow_run(seed, noise=2.0, pace=0.2)
    data = load_dataset([train], [], ARM, prepared_model(ARM, train))
    base = make_base(solve(prepared_model(ARM, train), data), data)
    assert base.noise is not None
    assert np.count_nonzero(base.block < 0) > 0.02 * len(base.block)
    own = base.parts[1]
    whole = base.products.sum(axis=(0, 1))[:own, :own]
    noise = base.noise.products().sum(axis=0)[:own, :own]
    share, _ = shares(whole, noise)
    assert 0.8 < share.max() <= MOST_NOISE * (1 + 1e-9)
    less = base.less_noise(base.products, base.noise.products()).sum(axis=(0, 1))[:own, :own]
    np.testing.assert_allclose(less, whole - noise, atol=1e-12)
