"""Restarts across the coordinates: rotated functions, the same result for the same call, limits."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from benchmarks.mcs import JONES, SUM_BAND, solve
from benchmarks.mcs_rotated import Problem, ours, problems, rosenbrock
from identification.errors import InputError
from identification.search.evaluate import Evaluator
from identification.search.evolution import FLATTEST, evolve
from identification.search.mcs import MCSOptions, MCSOutcome, mcs

FloatArray = npt.NDArray[np.float64]
BOX = [(-3.0, 4.0)] * 5


def oblique(seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """A rotation of five coordinates, and a centre."""
    rng = np.random.default_rng(seed)
    return np.linalg.qr(rng.standard_normal((5, 5)))[0], rng.uniform(-1.0, 2.0, 5)


def ellipsoid(x: FloatArray) -> float:
    """Axes of lengths 1 to 1000, turned out of the coordinates."""
    turn, centre = oblique()
    return float(np.sum(10.0 ** np.linspace(0, 6, 5) * (turn @ (x - centre)) ** 2))


def test_an_oblique_ellipsoid_is_followed_to_its_centre() -> None:
    evaluate = Evaluator(ellipsoid, [-3.0] * 5, [4.0] * 5, -np.inf, 10**6)
    value, x = evolve(evaluate, 0, None)
    assert value < FLATTEST * ellipsoid(np.full(5, -3.0))
    assert x == pytest.approx(oblique()[1], abs=1e-4)
    assert evaluate.best == value
    assert evaluate.count < 6000


def test_every_sample_lies_in_the_box() -> None:
    """The minimum of a plane lies in a corner: samples beyond it are reflected."""
    seen: list[FloatArray] = []

    def plane(x: FloatArray) -> float:
        seen.append(x)
        return float(x.sum())

    evaluate = Evaluator(plane, [-3.0] * 5, [4.0] * 5, -np.inf, 10**6)
    evolve(evaluate, 0, None)
    points = np.array(seen)
    assert points.min() >= -3.0
    assert points.max() <= 4.0
    assert evaluate.best < -14.9


def test_the_same_call_gives_the_same_result() -> None:
    first, second = (
        mcs(ellipsoid, BOX, max_evaluations=1500, options=MCSOptions(restarts=2)) for _ in range(2)
    )
    assert first.fun == second.fun
    assert first.nfev == second.nfev
    np.testing.assert_array_equal(first.x, second.x)


def test_limits_hold_in_a_restart_and_a_stall_is_no_success() -> None:
    calls = [0]

    def flat(x: FloatArray) -> float:
        calls[0] += 1
        return float(np.round(np.sum(x * x), 1))

    found = mcs(flat, BOX, max_evaluations=1500, options=MCSOptions(restarts=50))
    assert found.nfev == calls[0] <= 1500
    assert found.outcome is MCSOutcome.EVALUATIONS
    assert not found.success
    with pytest.raises(InputError, match="restarts"):
        mcs(flat, BOX, options=MCSOptions(restarts=-1))


def hard() -> list[Problem]:
    """One of each function in five to ten coordinates that coordinates alone do not solve."""
    chosen = {"ackley 8", "levy 8", "griewank 10", "rosenbrock 10"}
    return list({p.name: p for p in problems() if p.name in chosen}.values())


@pytest.mark.parametrize("problem", hard(), ids=lambda p: p.name)
def test_rotated_functions_are_solved(problem: Problem) -> None:
    """All sixty, beside scipy's methods: ``python -m benchmarks.mcs_rotated``."""
    solved, calls = ours(problem)
    assert solved
    assert calls <= problem.limit


def test_restarts_leave_the_test_set_of_jones_alone() -> None:
    """They come after the sweeps; the nine are solved before."""
    plain = [solve(case, case.box).nfev for case in JONES]
    assert sum(plain) <= SUM_BAND
    for case, calls in zip(JONES, plain, strict=True):
        found = mcs(case.fun, case.box, case.target, 12000, 0, options=MCSOptions(restarts=3))
        assert found.success
        assert found.nfev == calls


def test_sixty_problems_keep_their_minimum_where_it_is_said_to_be() -> None:
    asked = list(problems())
    assert len(asked) == 60
    assert rosenbrock(np.zeros(4)) == 0.0
    for p in asked:
        found = mcs(p.fun, p.box, max_evaluations=200)
        assert found.fun >= p.target - 2e-4 * max(1.0, abs(p.target))
