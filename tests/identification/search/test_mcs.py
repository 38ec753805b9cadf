"""Multilevel coordinate search: published figures, stopping rules, invariants of the box tree,
unusable objectives.
"""

from __future__ import annotations

import dataclasses
import doctest
import importlib
import importlib.util
import inspect
import math
import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import Bounds, direct

from benchmarks import mcs as BENCH
from identification.errors import InputError
from identification.search.basket import Basket
from identification.search.evaluate import Evaluator
from identification.search.line import LineSearch
from identification.search.local import LocalModel, LocalSearch
from identification.search.mcs import MCSOptions, MCSOutcome, MCSProgress, MCSResult, mcs
from identification.search.numeric import (
    cubic_roots,
    divided_differences,
    magnitude_limit,
    minimise_quadratic,
    newton_to_power,
    parabola_minimum,
    slope_and_curvature,
)
from identification.search.problem import make_problem
from identification.search.search import Search
from identification.search.types import FloatArray

JONES = {case.name: case for case in BENCH.JONES}
CAMEL = JONES["C6"]
SHEKEL = JONES["S5"]
SHUBERT = JONES["SHU"]


class Counted:
    """An objective that records its calls."""

    def __init__(self, fun: Callable[[FloatArray], Any]) -> None:
        self.fun = fun
        self.points: list[FloatArray] = []

    def __call__(self, x: FloatArray) -> Any:
        self.points.append(x)
        return self.fun(x)


def bowl(x: FloatArray) -> float:
    return float(((x - 0.3) ** 2).sum())


def rosenbrock(x: FloatArray) -> float:
    return float((100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2).sum())


# ---------------------------------------------------------------- published figures


@pytest.mark.parametrize("name", JONES)
def test_known_minimum_is_the_functions_minimum(name: str) -> None:
    case = JONES[name]
    low, high = np.array(case.box, dtype=float).T
    for minimiser in case.minimisers:
        assert np.all((low <= minimiser) & (minimiser <= high))
        assert case.fun(np.array(minimiser)) == pytest.approx(case.minimum, rel=1e-3)
        assert case.fun(np.array(minimiser)) >= case.minimum - 1e-8


@pytest.mark.parametrize("name", JONES)
def test_default_box_is_solved_within_the_band(name: str) -> None:
    case = JONES[name]
    result = BENCH.solve(case, case.box)
    assert result.outcome is MCSOutcome.TARGET
    assert result.fun <= case.target
    assert result.nfev <= case.band


def test_sum_over_default_boxes() -> None:
    assert sum(BENCH.solve(case, case.box).nfev for case in JONES.values()) <= BENCH.SUM_BAND


@pytest.mark.parametrize("name", JONES)
def test_fewer_evaluations_than_direct(name: str) -> None:
    case = JONES[name]
    needed = BENCH.count_direct(case, locally_biased=False, cap=5000)
    assert needed is None or BENCH.solve(case, case.box).nfev < needed


@pytest.mark.parametrize("name", JONES)
def test_shifted_boxes(name: str) -> None:
    case = JONES[name]
    results = [BENCH.solve(case, box) for box in case.shifted_boxes(0)]
    assert [result.fun <= case.target for result in results] == [True] * 25
    assert statistics.median(result.nfev for result in results) <= case.median


@pytest.mark.slow
@pytest.mark.parametrize("name", JONES)
def test_many_shifted_boxes(name: str) -> None:
    case = JONES[name]
    results = [BENCH.solve(case, box) for seed in range(1, 9) for box in case.shifted_boxes(seed)]
    assert sum(result.fun > case.target for result in results) == 0
    assert statistics.median(result.nfev for result in results) <= case.median


def test_agrees_with_direct_on_an_unrelated_function() -> None:
    def styblinski_tang(x: FloatArray) -> float:
        return 0.5 * float((x**4 - 16 * x**2 + 5 * x).sum())

    ours = mcs(styblinski_tang, [(-4, 4)] * 2)
    theirs = direct(styblinski_tang, [(-4, 4)] * 2)
    assert ours.fun <= theirs.fun + 1e-9
    np.testing.assert_allclose(ours.x, theirs.x, atol=1e-3)
    assert ours.nfev < theirs.nfev


# ---------------------------------------------------------------- accuracy on functions with a
# known answer


@pytest.mark.parametrize("n", [2, 3, 5, 8])
def test_linear_function_is_solved_by_the_initial_evaluations(n: int) -> None:
    slope = np.random.default_rng(n).normal(size=n)
    least = float(np.where(slope > 0, -slope, 2.0 * slope).sum())
    result = mcs(lambda x: float(slope @ x), [(-1, 2)] * n, target=least + 1e-12)
    assert result.outcome is MCSOutcome.TARGET
    assert result.nfev <= 2 * n + 1


@pytest.mark.parametrize(("n", "most"), [(1, 15), (2, 24), (3, 81), (5, 84), (8, 150)])
def test_quadratic_function(n: int, most: int) -> None:
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n))
    matrix, centre = root @ root.T + np.eye(n), rng.uniform(-0.7, 0.7, n)
    result = mcs(
        lambda x: float((x - centre) @ matrix @ (x - centre)), [(-1.0, 1.3)] * n, target=1e-10
    )
    assert result.outcome is MCSOutcome.TARGET
    assert result.nfev <= most
    np.testing.assert_allclose(result.x, centre, atol=1e-4)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_curved_valley_at_any_scale_and_offset(scale: float, offset: float) -> None:
    box = [(scale * (offset - 5), scale * (offset + 10))] * 2
    result = mcs(lambda x: rosenbrock(x / scale - offset), box)
    assert result.fun < 1e-9
    np.testing.assert_allclose(result.x / scale - offset, 1.0, atol=1e-4)


def test_both_global_minima_end_up_in_the_basket() -> None:
    result = mcs(CAMEL.fun, CAMEL.box, max_evaluations=2000, stall_sweeps=0)
    found = sorted(tuple(minimum.x.round(4).tolist()) for minimum in result.basket[:2])
    assert found == [(-0.0898, 0.7127), (0.0898, -0.7127)]
    assert all(minimum.converged for minimum in result.basket)


def test_basket_has_no_duplicates_and_is_sorted() -> None:
    result = mcs(SHUBERT.fun, SHUBERT.box, max_evaluations=4000, stall_sweeps=0)
    values = [minimum.fun for minimum in result.basket]
    assert values == sorted(values)
    assert result.fun == values[0]
    places = np.array([minimum.x for minimum in result.basket])
    gaps = np.linalg.norm(places[:, None] - places, axis=2) + 100.0 * np.eye(len(places))
    assert len(places) >= 5
    assert gaps.min() > 0.1
    for minimum in result.basket:
        assert SHUBERT.fun(minimum.x) == minimum.fun


# ---------------------------------------------------------------- counting, determinism, what the
# objective sees


@pytest.mark.parametrize("name", ["S7", "H3", "BR", "SHU"])
@pytest.mark.parametrize("limit", [1, 2, 7, 40, 333])
def test_nfev_equals_counted_calls_and_keeps_the_limit(name: str, limit: int) -> None:
    counted = Counted(JONES[name].fun)
    result = mcs(counted, JONES[name].box, max_evaluations=limit, stall_sweeps=0)
    assert result.basket[0].fun == result.fun
    np.testing.assert_array_equal(result.basket[0].x, result.x)
    assert result.nfev == len(counted.points) == limit
    assert result.outcome is MCSOutcome.EVALUATIONS
    assert not result.success
    assert result.nfev_local <= result.nfev
    assert result.fun == min(map(JONES[name].fun, counted.points))


def test_points_are_new_distinct_and_inside() -> None:
    counted = Counted(CAMEL.fun)
    box = [(-2.3, 1.1), (-0.9, 1.7)]
    mcs(counted, box, stall_sweeps=0)
    points = np.array(counted.points)
    low, high = np.array(box).T
    assert np.all(points >= low)
    assert np.all(points <= high)
    assert len({tuple(point) for point in points.tolist()}) == len(points)
    assert len({id(point) for point in counted.points}) == len(points)


def test_objective_may_overwrite_its_argument() -> None:
    def vandal(x: FloatArray) -> float:
        value = CAMEL.fun(x)
        x[:] = np.nan
        return float(value)

    plain, vandalised = mcs(CAMEL.fun, CAMEL.box), mcs(vandal, CAMEL.box)
    assert plain.fun == vandalised.fun
    assert plain.nfev == vandalised.nfev


def same(a: MCSResult, b: MCSResult) -> bool:
    basket = all(
        p.fun == q.fun and np.array_equal(p.x, q.x) for p, q in zip(a.basket, b.basket, strict=True)
    )
    plain = all(
        getattr(a, name) == getattr(b, name)
        for name in ("fun", "nfev", "nit", "nfev_local", "local_searches", "not_finite", "outcome")
    )
    return basket and plain and np.array_equal(a.x, b.x)


@pytest.mark.parametrize("name", ["S10", "H6", "SHU"])
def test_same_call_same_result(name: str) -> None:
    case = JONES[name]
    first, second = Counted(case.fun), Counted(case.fun)
    assert same(mcs(first, case.box), mcs(second, case.box))
    np.testing.assert_array_equal(np.array(first.points), np.array(second.points))


def test_every_way_to_write_bounds() -> None:
    pairs = mcs(CAMEL.fun, [(-3, 3), (-2, 2)])
    assert same(pairs, mcs(CAMEL.fun, np.array([[-3.0, 3.0], [-2.0, 2.0]])))
    assert same(pairs, mcs(CAMEL.fun, Bounds([-3, -2], [3, 2])))


@pytest.mark.parametrize("wrap", [np.float64, np.float32, int, np.array, lambda v: np.array([v])])
def test_any_single_real_number_is_accepted(wrap: Callable[[float], Any]) -> None:
    result = mcs(lambda x: wrap(100.0 * bowl(x)), [(-1, 1)] * 2, max_evaluations=60)
    assert isinstance(result.fun, float)
    assert result.fun < 1.0


# ---------------------------------------------------------------- stopping rules


def test_target() -> None:
    counted = Counted(CAMEL.fun)
    result = mcs(counted, CAMEL.box, target=-1.0)
    assert result.outcome is MCSOutcome.TARGET
    assert result.success
    values = [CAMEL.fun(point) for point in counted.points]
    assert values[-1] <= -1.0 < min(values[:-1])
    assert result.fun == values[-1]


def test_target_reached_by_the_first_point() -> None:
    result = mcs(bowl, [(-1, 1)] * 3, target=10.0)
    assert result.outcome is MCSOutcome.TARGET
    assert result.nfev == 1
    np.testing.assert_array_equal(result.x, [0, 0, 0])


@pytest.mark.parametrize("sweeps", [1, 4, 11])
def test_stall_counts_sweeps_without_a_better_point(sweeps: int) -> None:
    best: list[tuple[float, int]] = []
    result = mcs(
        SHEKEL.fun,
        SHEKEL.box,
        stall_sweeps=sweeps,
        max_evaluations=10**5,
        callback=lambda p: best.append((p.fun, p.nit)),
    )
    assert result.outcome is MCSOutcome.STALLED
    assert not result.success  # a stall proves nothing
    found = next(sweep for value, sweep in best if value == result.fun)
    assert result.nit - found == sweeps


def test_default_limits() -> None:
    assert mcs(CAMEL.fun, CAMEL.box, stall_sweeps=0).nfev == 250 + 50 * 2**2
    history: list[MCSProgress] = []
    result = mcs(lambda x: float(x.sum()), [(0, 1)] * 4, callback=history.append)
    assert result.outcome is MCSOutcome.STALLED
    assert result.nit == 3 * 4


def test_exhausted() -> None:
    result = mcs(
        bowl, [(-1, 1)], stall_sweeps=0, max_evaluations=10**6, options=MCSOptions(levels=4)
    )
    assert result.outcome is MCSOutcome.EXHAUSTED
    assert not result.success
    assert result.x[0] == pytest.approx(0.3, abs=1e-6)


def test_callback_sees_every_sweep_and_can_stop() -> None:
    seen: list[MCSProgress] = []

    def callback(progress: MCSProgress) -> bool:
        seen.append(progress)
        return progress.nit >= 3

    result = mcs(SHEKEL.fun, SHEKEL.box, callback=callback)
    assert result.outcome is MCSOutcome.CALLBACK
    assert not result.success
    assert (
        sorted({progress.nit for progress in seen}) == [0, 1, 2, 3] == list(range(result.nit + 1))
    )
    assert seen[0].nfev == 2 * 4 + 1
    assert [p.fun for p in seen] == sorted((p.fun for p in seen), reverse=True)
    assert all(SHEKEL.fun(p.x) == p.fun for p in seen)
    assert seen[-1].fun == result.fun


def test_callback_without_answer_changes_nothing() -> None:
    assert same(mcs(SHEKEL.fun, SHEKEL.box), mcs(SHEKEL.fun, SHEKEL.box, callback=lambda p: None))


def test_outcomes_are_sentences() -> None:
    for outcome in MCSOutcome:
        assert str(outcome) == outcome.value
        assert outcome.value[0].isupper()
        assert outcome.value.endswith(".")
    assert mcs(bowl, [(-1, 1)], target=1.0).message == "The target value was reached."


# ---------------------------------------------------------------- unusable values, plateaus, kinks


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_half_plane_without_values(bad: float) -> None:
    result = mcs(lambda x: bad if x[0] > 1.0 else CAMEL.fun(x), CAMEL.box, target=CAMEL.target)
    assert result.outcome is MCSOutcome.TARGET
    assert result.not_finite > 0
    assert math.isfinite(result.fun)


def test_minimum_at_the_edge_of_the_usable_half_plane() -> None:
    result = mcs(
        lambda x: math.nan if x[0] < 0.5 else float(x[0] + (x[1] - 0.2) ** 2), [(-1, 2), (-1, 1)]
    )
    assert result.fun == pytest.approx(0.5, abs=1e-2)
    assert result.x[0] >= 0.5


@pytest.mark.parametrize("radius", [0.9, 0.6])
def test_shekel_with_values_in_a_ball_only(radius: float) -> None:
    centre = np.full(4, 4.5)

    def fun(x: FloatArray) -> float:
        return math.nan if np.abs(x - centre).max() > 5.0 * radius else float(SHEKEL.fun(x))

    assert (
        mcs(fun, SHEKEL.box, target=SHEKEL.target, max_evaluations=4000, stall_sweeps=0).fun
        <= SHEKEL.target
    )


def test_nowhere_finite() -> None:
    result = mcs(lambda x: math.nan, [(0, 1)] * 2)
    assert result.outcome is MCSOutcome.NOWHERE_FINITE
    assert not result.success
    assert result.fun == math.inf
    assert result.not_finite == result.nfev
    assert result.basket == ()
    np.testing.assert_array_equal(result.x, [0.5, 0.5])


@pytest.mark.parametrize("height", [1e300, 1.7e308])
def test_huge_values_do_not_break_the_interpolation(height: float) -> None:
    result = mcs(lambda x: height if x[0] > 0.5 else bowl(x), [(-1, 1)] * 3)
    assert result.fun < 1e-6


def test_steps() -> None:
    result = mcs(lambda x: float(np.floor(10 * np.abs(x - 0.3)).sum()), [(-1, 2)] * 2)
    assert result.fun == 0.0
    assert result.outcome is MCSOutcome.STALLED


def test_constant() -> None:
    result = mcs(lambda x: 1.0, [(-1, 2)] * 3)
    assert result.fun == 1.0
    assert result.outcome is MCSOutcome.STALLED
    assert result.local_searches <= 3


def test_kink() -> None:
    result = mcs(lambda x: float(np.abs(x - 0.3).sum()), [(-1, 2)] * 2)
    assert result.fun < 1e-6


def test_exception_passes_with_the_place_noted() -> None:
    calls = 0

    def fun(x: FloatArray) -> float:
        nonlocal calls
        calls += 1
        if calls == 5:
            raise ZeroDivisionError("no torque")
        return bowl(x)

    with pytest.raises(ZeroDivisionError, match="no torque") as caught:
        mcs(fun, [(0, 1)] * 2)
    assert caught.value.__notes__ == [
        "mcs: raised by the objective at evaluation 5, x = [0.5, 1.0]"
    ]


def test_exception_of_the_callback_passes() -> None:
    def callback(progress: MCSProgress) -> None:
        raise RuntimeError("window closed")

    with pytest.raises(RuntimeError, match="window closed"):
        mcs(bowl, [(0, 1)], callback=callback)


@pytest.mark.parametrize(
    ("value", "named"),
    [
        (None, "None"),
        ("x", "'x'"),
        (1 + 2j, "(1+2j)"),
        (np.zeros(2), "shape (2,)"),
        ([1.0], "[1.0]"),
    ],
)
def test_value_that_is_no_number(value: Any, named: str) -> None:
    with pytest.raises(InputError, match="one real number") as caught:
        mcs(lambda x: value, [(0, 1)])
    assert named in str(caught.value)


# ---------------------------------------------------------------- refused input


@pytest.mark.parametrize(
    ("bounds", "said"),
    [
        ([(-math.inf, 1)], "finite bounds"),
        ([(0, 1), (0, math.inf)], "coordinate 1"),
        ([(0, math.nan)], "finite bounds"),
        ([(1, 1)], "low must be below high"),
        ([(2, 1)], "low must be below high"),
        ([(1.0, 1.0 + 1e-12)], "beyond floating point"),
        ([(0.0, 1e-200)], "beyond floating point"),
        ([(-1.7e308, 1.7e308)], "beyond floating point"),
        ([], "shape"),
        ([(0, 1, 2)], "shape"),
        ((0, 1), "shape"),
        ("box", "cannot be read"),
        (Bounds([0, 0], [1, np.inf]), "finite bounds"),
        (Bounds([0, 0], [1]), "low must be below high"),
    ],
)
def test_refused_bounds(bounds: Any, said: str) -> None:
    if isinstance(bounds, Bounds) and said.startswith("low"):
        bounds = Bounds([0, 1], [1])
    with pytest.raises(InputError, match=said):
        mcs(bowl, bounds)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"target": math.nan}, "target is nan"),
        ({"target": "low"}, "target"),
        ({"max_evaluations": 0}, "max_evaluations is 0"),
        ({"max_evaluations": 10.5}, "whole number"),
        ({"stall_sweeps": -1}, "stall_sweeps is -1"),
        ({"options": MCSOptions(levels=4)}, "at least 5"),
        ({"options": MCSOptions(local_steps=-1)}, "local_steps"),
        ({"options": MCSOptions(precision=1.0)}, "precision"),
        ({"options": MCSOptions(precision=-1e-3)}, "precision"),
        ({"options": MCSOptions(hessian_pattern=[[1, 0]])}, "symmetric"),
        ({"options": MCSOptions(hessian_pattern=[[1, 0], [1, 1]])}, "symmetric"),
        ({"options": MCSOptions(start="middle")}, "'middle'"),  # type: ignore[arg-type]
        ({"options": MCSOptions(start=[0.5])}, "1 entries for 2"),
        ({"options": MCSOptions(start=[0.5, 1.5])}, "outside the bounds"),
        ({"options": MCSOptions(start=[0.5, math.nan])}, "outside the bounds"),
        ({"options": MCSOptions(start=[[0.0, 0.5, 1.0], [0.0, 1.0]])}, "at least three"),
        ({"options": MCSOptions(start=[[0.0, 0.5, 1.0], [0.0, 0.5, 0.5]])}, "ascending"),
        ({"options": MCSOptions(start=[[0.0, 0.5, 1.0], [0.0, 0.5, 2.0]])}, "leaves the bounds"),
        ({"options": MCSOptions(start=["a", "b"])}, "cannot be read"),  # type: ignore[arg-type]
    ],
)
def test_refused_arguments(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        mcs(bowl, [(0, 1)] * 2, **arguments)


# ---------------------------------------------------------------- options


@pytest.mark.parametrize(
    "start", [(0.3, 0.3, 0.3), (0.0, 1.0, 0.3), (1e-9, 0.5, 1.0), (-1.0, 1.0, 0.2)]
)
def test_search_begins_at_the_given_point(start: tuple[float, ...]) -> None:
    counted = Counted(bowl)
    result = mcs(counted, [(-1, 1), (-2, 1), (0, 1)], options=MCSOptions(start=start))
    np.testing.assert_array_equal(counted.points[0], start)
    assert result.fun < 1e-12


def test_lists_say_where_the_initial_evaluations_are() -> None:
    counted = Counted(bowl)
    lists = [[0.1, 0.2, 0.6, 0.9], [0.0, 0.5, 0.75]]
    result = mcs(counted, [(0, 1)] * 2, options=MCSOptions(start=lists))
    np.testing.assert_array_equal(counted.points[0], [0.6, 0.5])
    assert [point[0] for point in counted.points[1:4]] == [0.1, 0.2, 0.9]
    assert result.fun < 1e-12


def test_inner_start_stays_off_the_bounds() -> None:
    counted = Counted(bowl)
    mcs(counted, [(0, 6)] * 2, max_evaluations=5, options=MCSOptions(start="inner"))
    np.testing.assert_allclose(np.unique(np.array(counted.points)), [1, 3, 5])


def test_no_local_search() -> None:
    result = mcs(
        CAMEL.fun,
        CAMEL.box,
        max_evaluations=3000,
        stall_sweeps=0,
        options=MCSOptions(local_steps=0),
    )
    assert result.local_searches == result.nfev_local == 0
    assert len(result.basket) > 10
    assert not any(minimum.converged for minimum in result.basket)
    assert CAMEL.minimum < result.fun < -0.9
    deeper = mcs(
        CAMEL.fun,
        CAMEL.box,
        max_evaluations=3000,
        stall_sweeps=0,
        options=MCSOptions(local_steps=0, levels=60),
    )
    assert CAMEL.minimum < deeper.fun < CAMEL.minimum + 1e-3


def test_local_search_without_enough_steps_is_marked_and_repeated() -> None:
    box = [(-5, 10)] * 2
    result = mcs(rosenbrock, box, max_evaluations=2000, options=MCSOptions(local_steps=1))
    assert result.basket[0].fun == result.fun
    assert result.local_searches >= 2
    assert not result.basket[0].converged


def test_sparse_hessian_saves_evaluations() -> None:
    def separable(x: FloatArray) -> float:
        return float(np.cosh(x - 0.1).sum())

    box = [(-1, 1.3)] * 5
    full = mcs(separable, box, target=5.0 + 1e-9)
    sparse = mcs(separable, box, target=5.0 + 1e-9, options=MCSOptions(hessian_pattern=np.eye(5)))
    assert full.success
    assert sparse.success
    assert sparse.nfev < full.nfev


def test_coarse_precision_saves_evaluations() -> None:
    fine, coarse = (
        mcs(rosenbrock, [(-2, 2)] * 2, options=MCSOptions(precision=p)) for p in (2.2e-16, 1e-6)
    )
    assert coarse.nfev < fine.nfev
    assert coarse.fun < 1e-3


def test_ignored_coordinate() -> None:
    result = mcs(lambda x: float((x[0] - 0.2) ** 2), [(-1, 1)] * 3)
    assert result.fun < 1e-12


def test_ten_coordinates() -> None:
    result = mcs(rosenbrock, [(-1.5, 2)] * 10, target=1e-6, max_evaluations=20000, stall_sweeps=0)
    assert result.outcome is MCSOutcome.TARGET


# ---------------------------------------------------------------- the box tree


def _tree(name: str, evaluations: int, **options: Any) -> tuple[Search, np.ndarray, np.ndarray]:
    case = JONES[name]
    problem = make_problem(case.box, MCSOptions(**options))
    search = Search(case.fun, problem, -math.inf, evaluations, 0, None)
    search.run()
    leaves = search.tree.leaves()
    extent = np.array(
        [[search.tree.interval(box, i) for i in range(len(case.box))] for box in leaves]
    )
    return search, extent[:, :, 0], extent[:, :, 1]


@pytest.mark.parametrize("name", ["S7", "H3", "H6", "BR", "SHU"])
@pytest.mark.parametrize("options", [{}, {"start": "inner"}, {"levels": 10}, {"local_steps": 0}])
def test_boxes_cover_the_search_box_exactly(name: str, options: dict[str, Any]) -> None:
    search, low, high = _tree(name, 1500, **options)
    box_low, box_high = np.array(JONES[name].box, dtype=float).T
    assert math.fsum(np.prod((high - low) / (box_high - box_low), axis=1)) == pytest.approx(
        1.0, abs=1e-12
    )
    for point in np.random.default_rng(7).uniform(box_low, box_high, (200, len(box_low))):
        assert np.sum(np.all((low <= point) & (point <= high), axis=1)) == 1


@pytest.mark.parametrize("name", ["S10", "H6", "GP"])
def test_each_box_has_its_base_inside_and_its_value(name: str) -> None:
    search, low, high = _tree(name, 800)
    last = 5 * len(JONES[name].box) + 10
    finished = {(tuple(box.x), tuple(box.y)) for box in search.tree.finished()}
    for box, lo, hi in zip(search.tree.leaves(), low, high, strict=True):
        assert np.all((lo <= box.x) & (box.x <= hi))
        assert box.f == JONES[name].fun(np.array(box.x))
        assert box.level >= 2
        assert (box.level >= last) == ((tuple(box.x), tuple(box.y)) in finished)


def test_neighbour_samples_follow_the_separable_correction() -> None:
    """For a sum of functions of one coordinate each, the stored offsets are exact values."""
    parts = (np.cosh, np.sin, np.exp)

    def separable(x: FloatArray) -> float:
        return float(sum(part(c) for part, c in zip(parts, x, strict=True)))

    search = Search(separable, make_problem([(-1, 2)] * 3, MCSOptions()), -math.inf, 400, 0, None)
    search.run()
    for box in search.tree.leaves():
        for i, near in enumerate(box.near):
            if near is None:
                assert box.splits[i] == 0
                continue
            for place, offset in (near[:2], near[2:]):
                assert place != box.x[i]
                assert offset == pytest.approx(parts[i](place) - parts[i](box.x[i]), abs=1e-12)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_levels_after_the_initialisation(n: int) -> None:
    search = Search(
        bowl, make_problem([(0, 1)] * n, MCSOptions(start="inner")), -math.inf, 10**4, 0, None
    )
    search.tree.initialise()
    levels = [box.level for box in search.tree.leaves()]
    assert search.evaluate.count == 2 * n + 1
    assert len(levels) == 5 * n + 1
    assert set(levels) <= set(range(2, 2 * n + 2))


# ---------------------------------------------------------------- local search and line search


def _evaluator(
    fun: Callable[[FloatArray], float], low: list[float], high: list[float]
) -> Evaluator:
    return Evaluator(fun, low, high, -math.inf, 10**6)


@pytest.mark.parametrize("start", [[0.0, 0.0], [0.0, 3.0], [2.0, 0.0], [0.0, 1.2]])
def test_local_search_leaves_the_bounds(start: list[float]) -> None:
    """A coordinate that starts on a bound must not be dead: the curved valley leads away from
    it.
    """
    evaluate = _evaluator(rosenbrock, [0.0, 0.0], [2.0, 3.0])
    x, f, converged = LocalSearch(evaluate, [[True] * 2] * 2, 50, 2.2e-16).run(
        start, evaluate(start)
    )
    assert converged
    assert f < 1e-12
    np.testing.assert_allclose(x, 1.0, atol=1e-6)


def test_local_search_from_every_corner_of_hartman3() -> None:
    case = JONES["H3"]
    for corner in np.ndindex(2, 2, 2):
        start = [float(c) for c in corner]
        evaluate = _evaluator(case.fun, [0.0] * 3, [1.0] * 3)
        x, f, converged = LocalSearch(evaluate, [[True] * 3] * 3, 50, 2.2e-16).run(
            start, evaluate(start)
        )
        assert converged
        gradient = np.array(
            [
                (case.fun(np.array(x) + h) - case.fun(np.array(x) - h)) / 2e-6
                for h in 1e-6 * np.eye(3)
            ]
        )
        inner = [0.0 < c < 1.0 for c in x]
        assert np.abs(gradient[inner]).max(initial=0.0) < 1e-4
        assert f <= evaluate(start)


@pytest.mark.parametrize("seed", range(10))
def test_model_of_a_quadratic_is_exact(seed: int) -> None:
    """Also where better samples move the point of expansion while the model is built, and near
    bounds.
    """
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 4))
    matrix, centre = root @ root.T + 0.3 * np.eye(4), rng.uniform(-1.2, 1.2, 4)
    evaluate = _evaluator(
        lambda x: float(0.5 * (x - centre) @ matrix @ (x - centre)), [-1.0] * 4, [1.0] * 4
    )
    start = rng.uniform(-0.9, 0.9, 4).tolist()
    model = LocalModel(evaluate, [[True] * 4] * 4, start, evaluate(start))
    model.coordinate_search()
    np.testing.assert_allclose(model.hessian, matrix, atol=1e-3)
    np.testing.assert_allclose(model.g, matrix @ (np.array(model.x) - centre), atol=1e-3)
    assert model.f == evaluate(model.x)
    model.triple_search(full=True)
    inside = [i for i in range(4) if not model.on_bound(i)]
    np.testing.assert_allclose(
        np.array(model.g)[inside], (matrix @ (np.array(model.x) - centre))[inside], atol=1e-4
    )
    np.testing.assert_allclose(
        np.array(model.hessian)[np.ix_(inside, inside)], matrix[np.ix_(inside, inside)], atol=1e-2
    )


def test_search_out_of_steps_admits_one_more_from_the_same_valley() -> None:
    evaluate = _evaluator(lambda x: float(((x - 0.11) ** 4).sum()), [-4.0, -4.0], [4.0, 4.0])
    basket = Basket(evaluate, LocalSearch(evaluate, [[True] * 2] * 2, 1, 2.2e-16))
    assert basket.offer(evaluate([3.0, 2.0]), (3.0, 2.0))
    assert [minimum.converged for minimum in basket.minima] == [False]
    assert basket.offer(evaluate([3.5, 2.5]), (3.5, 2.5))
    assert not basket.offer(evaluate([2.5, 3.5]), (2.5, 3.5))
    assert basket.searches == 2
    assert len(basket.minima) == 1


def test_first_coarse_model_does_not_end_a_local_search() -> None:
    """In this box of Goldstein and Price the first model predicts a step that fails, near the
    global minimum.
    """
    case = JONES["GP"]
    box = [(-3.5037119137449, 0.4962880862550998), (-2.89747450664728, 1.10252549335272)]
    result = BENCH.solve(case, box)
    assert result.outcome is MCSOutcome.TARGET
    assert result.nfev <= 400


def test_local_search_stays_at_a_minimum_on_the_bound() -> None:
    evaluate = _evaluator(lambda x: float(x[0] + (x[1] - 0.5) ** 2), [0.0, 0.0], [1.0, 1.0])
    x, f, converged = LocalSearch(evaluate, [[True] * 2] * 2, 50, 2.2e-16).run(
        [0.7, 0.1], evaluate([0.7, 0.1])
    )
    assert converged
    assert x[0] == 0.0
    assert x[1] == pytest.approx(0.5, abs=1e-6)
    assert f < 1e-12


@pytest.mark.parametrize(
    ("law", "best"),
    [
        (lambda t: (t - 0.37) ** 2, 0.37),
        (lambda t: -math.exp(-20 * (t - 0.81) ** 2), 0.81),
        (lambda t: t, 0.0),
        (lambda t: -t, 1.0),
        (lambda t: abs(t - 0.62), 0.62),
        (lambda t: t**4 - t**3, 0.75),
    ],
)
def test_line_search(law: Callable[[float], float], best: float) -> None:
    evaluate = _evaluator(lambda x: law(float(x[0])), [0.0], [1.0])
    line = LineSearch(evaluate, [0.5], [1.0], [0.0], [evaluate([0.5])])
    found = line.run(15)
    assert len(line.alphas) <= 15
    assert line.alphas == sorted(set(line.alphas))
    assert [law(0.5 + alpha) for alpha in line.alphas] == pytest.approx(line.values)
    assert line.values[found] == min(line.values)
    assert 0.5 + line.alphas[found] == pytest.approx(best, abs=0.02)


def test_line_search_on_a_plateau_and_between_bounds() -> None:
    evaluate = _evaluator(lambda x: 1.0, [0.0, 0.0], [1.0, 1.0])
    line = LineSearch(evaluate, [0.5, 1.0], [1.0, 1.0], [0.0], [1.0])
    line.run(15)
    assert min(line.alphas) >= -0.5
    assert max(line.alphas) <= 0.0


# ---------------------------------------------------------------- numerics


def test_parabola_through_samples_of_a_parabola() -> None:
    def law(t: float) -> float:
        return 2.0 - 3.0 * t + 0.5 * t * t

    slope, curvature = slope_and_curvature(0.7, law(0.7), -1.0, law(-1.0), 4.0, law(4.0))
    assert slope == pytest.approx(-3.0 + 0.7)
    assert curvature == pytest.approx(1.0)
    assert parabola_minimum(-3.0, 1.0, -1.0, 5.0) == pytest.approx((3.0, -4.5))
    assert parabola_minimum(-3.0, 1.0, 2.0, 1.0) == pytest.approx((2.0, -4.0))
    assert parabola_minimum(0.0, -1.0, -1.0, 2.0) == pytest.approx((2.0, -2.0))


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [(0.0, 5000.0, 1.0), (0.0, -7.0, -7.0), (2.0, 5e3, 20.0), (-2.0, 5e3, 20.0), (2.0, 9.0, 9.0)],
)
def test_magnitude_limit(x: float, y: float, expected: float) -> None:
    assert magnitude_limit(x, y) == expected


@pytest.mark.parametrize("seed", range(20))
def test_cubic_roots(seed: int) -> None:
    rng = np.random.default_rng(seed)
    if seed % 2:
        expected = np.sort(rng.uniform(-3, 3, 3))
        coefficients = np.poly(expected)[::-1] * rng.normal()
    else:
        expected, pair = rng.uniform(-3, 3, 1), rng.uniform(0.5, 3, 2)
        coefficients = np.polymul([1, -expected[0]], [1, 2 * pair[0], pair[0] ** 2 + pair[1]])[::-1]
    np.testing.assert_allclose(cubic_roots(*coefficients), expected, atol=1e-6)


def test_roots_of_lower_degree() -> None:
    assert cubic_roots(2.0, -3.0, 1.0, 0.0) == [1.0, 2.0]
    assert cubic_roots(-4.0, 2.0, 0.0, 0.0) == [2.0]
    assert cubic_roots(0.0, 0.0, 0.0, 0.0) == []
    assert cubic_roots(1.0, 0.0, 1.0, 0.0) == []
    assert cubic_roots(math.inf, 0.0, 1.0, 1.0) == []
    assert cubic_roots(0.0, 0.0, 0.0, 1.0) == [0.0]


def test_newton_polynomial() -> None:
    points = [-1.0, 0.5, 2.0, 3.0, 4.5]
    power = [1.0, -2.0, 0.5, 0.25, -0.125]
    values = [sum(c * t**k for k, c in enumerate(power)) for t in points]
    np.testing.assert_allclose(
        newton_to_power(points, divided_differences(points, values)), power, atol=1e-12
    )


@pytest.mark.parametrize("seed", range(30))
def test_quadratic_over_a_box(seed: int) -> None:
    """First-order conditions hold at the result; convex problems are solved to the global
    minimum.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    root = rng.normal(size=(n, n))
    matrix = root @ root.T if seed % 2 else root + root.T
    gradient, low, high = rng.normal(size=n), -rng.uniform(0, 2, n), rng.uniform(0, 2, n)
    low[rng.uniform(size=n) < 0.2] = 0.0

    def model(h: FloatArray) -> float:
        return float(gradient @ h + 0.5 * h @ matrix @ h)

    h = np.array(
        minimise_quadratic(gradient.tolist(), matrix.tolist(), low.tolist(), high.tolist())
    )
    assert np.all((low <= h) & (h <= high))
    assert model(h) <= 0.0
    slope = gradient + matrix @ h
    inside = (low < h) & (h < high)
    assert np.abs(slope[inside]).max(initial=0.0) < 1e-5
    assert np.all(slope[h == low] >= -1e-5) or np.any((h == low) & (h == high))
    assert np.all(slope[(h == high) & (h > low)] <= 1e-5)
    if seed % 2:
        for other in rng.uniform(low, high, (300, n)):
            assert model(other) >= model(h) - 1e-9


def test_quadratic_that_is_not_finite_gives_no_step() -> None:
    assert minimise_quadratic([math.nan, 1.0], [[1.0, 0.0], [0.0, 1.0]], [-1.0] * 2, [1.0] * 2) == [
        0.0,
        0.0,
    ]
    assert minimise_quadratic([1.0], [[math.inf]], [-1.0], [1.0]) == [0.0]


# ---------------------------------------------------------------- documentation


def test_every_option_is_documented() -> None:
    text = inspect.getdoc(mcs) or ""
    for name in inspect.signature(mcs).parameters:
        assert f"\n{name} : " in text
    for field in dataclasses.fields(MCSOptions):
        assert f"``{field.name}`` : " in text
    result_text = inspect.getdoc(MCSResult) or ""
    for field in dataclasses.fields(MCSResult):
        assert f"\n{field.name} : " in result_text


def test_examples_of_the_documentation() -> None:
    results = doctest.testmod(importlib.import_module("identification.search.mcs"))
    assert results.attempted >= 8
    assert results.failed == 0
