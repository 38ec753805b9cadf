"""The one solver, crossed with problems of known minimum and with NIST's certified nonlinear
regressions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from identification.fitting.least_squares import (
    Outcome,
    bounded_step,
    eliminated,
    least_squares,
    triangle_of,
    triangles_of_products,
)

NIST = Path(__file__).parents[2] / "data" / "nist"
"""Statistical Reference Datasets of the National Institute of Standards and Technology: work of
the United States, public domain."""


@dataclass(frozen=True)
class Formula:
    """A problem written down in symbols; derivatives are exact."""

    function: ca.Function
    slope: ca.Function

    @classmethod
    def of(cls, count: int, rows: Callable[[ca.SX], list[ca.SX]]) -> Formula:
        x = ca.SX.sym("x", count)
        r = ca.vertcat(*rows(x))
        return cls(ca.Function("r", [x], [r]), ca.Function("j", [x], [ca.jacobian(r, x)]))

    def residual(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(self.function(x).full().ravel())

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(self.slope(x).full())


def rosenbrock(x: ca.SX) -> list[ca.SX]:
    return [10 * (x[1] - x[0] ** 2), 1 - x[0]]


def powell_singular(x: ca.SX) -> list[ca.SX]:
    return [
        x[0] + 10 * x[1],
        np.sqrt(5) * (x[2] - x[3]),
        (x[1] - 2 * x[2]) ** 2,
        np.sqrt(10) * (x[0] - x[3]) ** 2,
    ]


def box(x: ca.SX) -> list[ca.SX]:
    return [
        np.exp(0) * (ca.exp(-t * x[0]) - ca.exp(-t * x[1]) - x[2] * (np.exp(-t) - np.exp(-10 * t)))
        for t in 0.1 * np.arange(1, 11)
    ]


def freudenstein(x: ca.SX) -> list[ca.SX]:
    return [x[0] - 13 + ((5 - x[1]) * x[1] - 2) * x[1], x[0] - 29 + ((1 + x[1]) * x[1] - 14) * x[1]]


def helical(x: ca.SX) -> list[ca.SX]:
    return [
        10 * (x[2] - 10 * ca.atan2(x[1], x[0]) / (2 * np.pi)),
        10 * (ca.sqrt(x[0] ** 2 + x[1] ** 2) - 1),
        x[2],
    ]


def kowalik_free(x: ca.SX) -> list[ca.SX]:
    """Two amplitudes that appear as a sum only: no unique minimum."""
    return [x[0] + x[1] - 3, 2 * (x[0] + x[1]) - 6.5, x[2] - 1]


INF = np.inf
FREE = (-INF, INF)


@pytest.mark.parametrize(
    ("rows", "start", "bounds", "minimum", "cost"),
    [
        (rosenbrock, [-1.2, 1], FREE, [1, 1], 0),
        (powell_singular, [3, -1, 0, 1], FREE, [0, 0, 0, 0], 0),
        (box, [0, 10, 20], FREE, [1, 10, 1], 0),
        (helical, [-1, 0, 0], FREE, [1, 0, 0], 0),
        (freudenstein, [0.5, -2], FREE, [11.41277900, -0.89680525], 48.98425368),
        (freudenstein, [4.0, 4.5], FREE, [5, 4], 0),
        # the minimum on a wall: x1 = 1.5 with the valley x2 = x1^2; x2 = 0.25 with the best x1
        # beside it
        (rosenbrock, [2, 2], ([1.5, -INF], INF), [1.5, 2.25], 0.25),
        (rosenbrock, [-1.2, -1], ([-INF, -INF], [INF, 0.25]), None, None),
        (box, [0.5, 5, 20], ([0, 0, 0], [0.8, 20, 20]), None, None),
        (helical, [-1, 0.5, 0], ([-2, 0.5, -1], [2, 2, 1]), None, None),
    ],
)
def test_a_known_minimum_is_found(rows, start, bounds, minimum, cost) -> None:
    problem = Formula.of(len(start), rows)
    found = least_squares(problem, start, bounds, iterations=200, tolerance=1e-15)
    assert found.outcome in (Outcome.SETTLED, Outcome.EXACT)
    if minimum is not None:
        assert found.cost == pytest.approx(cost, rel=1e-8, abs=1e-20)
        # Powell's Jacobian has rank 2 there, Freudenstein and Roth's residual is large: slow to
        # the last digit
        assert found.x == pytest.approx(
            minimum, abs=2e-6 if cost == 0 and rows is not powell_singular else 1e-4
        )
    low, high = (np.broadcast_to(np.asarray(b, float), found.x.shape) for b in bounds)
    assert np.all((low <= found.x) & (found.x <= high))
    slope = problem.jacobian(found.x).T @ problem.residual(found.x)
    size = np.linalg.norm(problem.jacobian(found.x), axis=0) * np.sqrt(found.cost) + 1e-7
    # no slope inside; on a wall it points outside (Karush, Kuhn and Tucker)
    assert np.all(np.where(found.x > low, slope, 0) <= 1e-5 * size)
    assert np.all(np.where(found.x < high, slope, 0) >= -1e-5 * size)
    assert np.array_equal(found.at_bound, (found.x == low) | (found.x == high))


def test_without_a_unique_minimum_the_shortest_step_is_taken() -> None:
    found = least_squares(Formula.of(3, kowalik_free), [1.0, 1.0, 0.0])
    assert found.outcome is Outcome.SETTLED
    assert found.x == pytest.approx([1.6, 1.6, 1.0], rel=1e-6)
    assert found.cost == pytest.approx(0.05)


def test_start_values_that_cannot_be_evaluated_and_too_few_iterations_are_said() -> None:
    square = Formula.of(1, lambda x: [ca.sqrt(x[0]) - 2])
    assert least_squares(square, [-1.0]).outcome is Outcome.NOT_FINITE
    assert (
        least_squares(Formula.of(2, rosenbrock), [-1.2, 1], iterations=2).outcome
        is Outcome.ITERATIONS
    )
    assert least_squares(square, [1.0], ([0.0], [9.0])).x == pytest.approx([4.0])


def test_a_scale_moves_on_its_logarithm() -> None:
    t = np.linspace(0, 5, 60)
    y = np.tanh(t / 0.02)
    problem = Formula.of(1, lambda x: [ca.tanh(a / x[0]) - b for a, b in zip(t, y, strict=True)])
    found = least_squares(problem, [5.0], ([1e-3], [10.0]), logarithmic=[True])
    plain = least_squares(problem, [5.0], ([1e-3], [10.0]))
    assert found.cost < 1e-6
    assert found.cost <= plain.cost


def test_a_bounded_step_is_the_minimum_in_the_box() -> None:
    rng = np.random.default_rng(0)
    for count in (1, 2, 5, 9):
        for _ in range(20):
            rows = rng.standard_normal((30, count)) * 10.0 ** rng.uniform(-12, 12, count)
            target = rng.standard_normal(30)
            size = np.linalg.norm(rows, axis=0)
            room = -rng.exponential(0.1, count) / size, rng.exponential(0.1, count) / size
            r = triangle_of(np.column_stack([rows, target]))
            step = bounded_step(r[:-1, :-1], r[:-1, -1], room, 1e-14)
            known = lsq_linear(
                rows / size, -target, (room[0] * size, room[1] * size), method="bvls"
            ).x
            np.testing.assert_allclose(step * size, known, atol=1e-8)


# --- unknowns of blocks
# ------------------------------------------------------------------------------------------------


@dataclass
class Decays:
    """Exponential decays with one rate and, in every block, an own start value."""

    t: np.ndarray
    y: np.ndarray

    def rows(self, x: np.ndarray, local: np.ndarray) -> np.ndarray:
        e = np.exp(-x[0] * self.t)
        return np.stack(
            [
                np.column_stack([e, -a * self.t * e, a * e - y])
                for (a,), y in zip(local, self.y, strict=True)
            ]
        )

    def costs(self, x: np.ndarray, local: np.ndarray) -> np.ndarray:
        return np.asarray(np.sum(self.rows(x, local)[:, :, -1] ** 2, axis=1))

    def triangles(self, x: np.ndarray, local: np.ndarray) -> np.ndarray:
        return np.array([triangle_of(block) for block in self.rows(x, local)])


@dataclass
class Whole:
    """The same with all unknowns in one vector."""

    blocks: Decays

    def residual(self, x: np.ndarray) -> np.ndarray:
        return self.blocks.rows(x[:1], x[1:, None])[:, :, -1].ravel()

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        found = self.blocks.rows(x[:1], x[1:, None])
        out = np.zeros((*found.shape[:2], len(x)))
        out[:, :, 0] = found[:, :, 1]
        for k in range(len(found)):
            out[k, :, 1 + k] = found[k, :, 0]
        return out.reshape(-1, len(x))


def test_eliminating_the_unknowns_of_blocks_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    t = np.linspace(0, 2, 25)
    y = np.array(
        [a * np.exp(-1.7 * t) for a in (1.0, -3.0, 20.0, 0.0)]
    ) + 0.01 * rng.standard_normal((4, 25))
    blocks = Decays(t, y)
    found = least_squares(blocks, [0.3], ([0.0], [9.0]), local=np.ones((4, 1)))
    whole = least_squares(Whole(blocks), [0.3, 1, 1, 1, 1], ([0.0, *[-INF] * 4], INF))
    assert found.x == pytest.approx(whole.x[:1], rel=1e-7)
    assert found.local.ravel() == pytest.approx(whole.x[1:], rel=1e-6, abs=1e-8)
    assert found.cost == pytest.approx(whole.cost, rel=1e-9)
    rows = blocks.rows(found.x, found.local)
    exact, rough = (
        eliminated(blocks.triangles(found.x, found.local), 1),
        eliminated(triangles_of_products(rows.transpose(0, 2, 1) @ rows), 1),
    )
    assert abs(rough.triangle) == pytest.approx(abs(exact.triangle), rel=1e-5)


@dataclass
class Lines:
    """Lines of one slope; each block has an offset of its own, which bends in the curved ones."""

    t: np.ndarray
    y: np.ndarray
    curved: np.ndarray

    def rows(self, x: np.ndarray, local: np.ndarray) -> np.ndarray:
        out = []
        for (a,), y, bent in zip(local, self.y, self.curved, strict=True):
            root = np.sqrt(1 + a**2) if bent else 1.0
            slope = np.full_like(self.t, 10 / root**3)
            out.append(np.column_stack([slope, self.t, x[0] * self.t + 10 * a / root - y]))
        return np.stack(out)

    def costs(self, x: np.ndarray, local: np.ndarray) -> np.ndarray:
        return np.asarray(np.sum(self.rows(x, local)[:, :, -1] ** 2, axis=1))

    def triangles(self, x: np.ndarray, local: np.ndarray) -> np.ndarray:
        return np.array([triangle_of(block) for block in self.rows(x, local)])


def test_a_block_that_is_curved_in_its_own_unknown_does_not_hold_up_the_others() -> None:
    """Its full step runs from 2 to -8 and raises the sum: no damping of the common slope helps."""
    t = np.linspace(-1, 1, 21)
    rng = np.random.default_rng(8)
    noise = 0.01 * rng.standard_normal((5, len(t)))
    lines = Lines(t, 2.0 * t + noise, np.array([False, False, True, False, False]))
    local = np.array([[0.0], [0.0], [2.0], [0.0], [0.0]])
    found = least_squares(lines, [1.9], local=local, tolerance=1e-10)
    assert found.outcome is Outcome.SETTLED
    # all offsets and the slope by linear least squares: there is one minimum
    best = float(np.sum((noise @ t) / np.sum(5 * t**2)))
    assert found.x[0] == pytest.approx(2.0 + best, abs=1e-7)
    assert abs(found.local).max() < 1e-2


# --- NIST ----------------------------------------------------------------------------------------
# ----------------------

E = ca.exp


def gauss(b: ca.SX, x: np.ndarray) -> ca.SX:
    return (
        b[0] * E(-b[1] * x)
        + b[2] * E(-((x - b[3]) ** 2) / b[4] ** 2)
        + b[5] * E(-((x - b[6]) ** 2) / b[7] ** 2)
    )


MODELS: dict[str, Callable[[ca.SX, np.ndarray], ca.SX]] = {
    "Misra1a": lambda b, x: b[0] * (1 - E(-b[1] * x)),
    "Chwirut2": lambda b, x: E(-b[0] * x) / (b[1] + b[2] * x),
    "Lanczos3": lambda b, x: b[0] * E(-b[1] * x) + b[2] * E(-b[3] * x) + b[4] * E(-b[5] * x),
    "Gauss1": gauss,
    "Gauss3": gauss,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * E(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * E(-x * b[3]) + b[2] * E(-x * b[4]),
    "Thurber": lambda b, x: (
        (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)
    ),
    "Hahn1": lambda b, x: (
        (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)
    ),
    "Eckerle4": lambda b, x: b[0] / b[1] * E(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Rat43": lambda b, x: b[0] / (1 + E(b[1] - b[2] * x)) ** (1 / b[3]),
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
    "BoxBOD": lambda b, x: b[0] * (1 - E(-b[1] * x)),
    "Roszman1": lambda b, x: b[0] - b[1] * x - ca.atan(b[2] / (x - b[3])) / np.pi,
}


@dataclass(frozen=True)
class Certified:
    """A file of NIST's: two starts, certified values with their standard deviations, sum of
    squares, data."""

    starts: np.ndarray
    values: np.ndarray
    deviations: np.ndarray
    square: float
    y: np.ndarray
    x: np.ndarray

    @classmethod
    def read(cls, name: str) -> Certified:
        lines = (NIST / f"{name}.dat").read_text(encoding="ascii").splitlines()
        table = np.array(
            [
                [float(v) for v in line.split("=")[1].split()]
                for line in lines[40:60]
                if line.strip().startswith("b") and "=" in line
            ]
        )
        square = next(
            float(line.split(":")[1])
            for line in lines
            if line.startswith("Residual Sum of Squares")
        )
        data = np.array([[float(v) for v in line.split()] for line in lines[60:] if line.strip()])
        return cls(table[:, :2].T, table[:, 2], table[:, 3], square, data[:, 0], data[:, 1])

    def problem(self, model: Callable[[ca.SX, np.ndarray], ca.SX]) -> Formula:
        return Formula.of(len(self.values), lambda b: [model(b, ca.DM(self.x)) - ca.DM(self.y)])


PLAINS = {
    "MGH17": "two rates fall together",
    "BoxBOD": "the rate runs off to where the exponential is over at the first sample",
}
"""Sets whose far start leads downhill to another stationary point, and to which."""
POSITIVE = {"MGH10": True}
"""Sets searched on a log scale: from the far start the plain one runs along a valley of 1e9 for
thousands of steps."""


@pytest.mark.parametrize(
    ("name", "far"), [(n, f) for n in MODELS for f in (True, False) if not (f and n in PLAINS)]
)
def test_certified_values_of_nist_come_out(name: str, far: bool) -> None:
    certified = Certified.read(name)
    found = least_squares(
        certified.problem(MODELS[name]),
        certified.starts[0 if far else 1],
        iterations=500,
        tolerance=1e-14,
        logarithmic=POSITIVE.get(name, False),
    )
    assert found.outcome in (Outcome.SETTLED, Outcome.EXACT), found
    assert found.cost == pytest.approx(certified.square, rel=1e-9 if name != "Lanczos3" else 1e-8)
    assert found.x == pytest.approx(certified.values, rel=1e-6)


def test_what_the_unknowns_of_blocks_explain_moves_nothing_in_any_unit() -> None:
    """A column of rad^3 is no smaller for the unit of the one beside it; one that the blocks' own
    unknowns hold is rounding however large it was.
    """
    rng = np.random.default_rng(7)
    rows = rng.standard_normal((3, 40, 5))  # own unknown, three parameters, residual
    rows[:, :, 2] = rows[:, :, 0] * np.array([1.0, -2.0, 0.5])[:, None]
    plain = eliminated(np.array([triangle_of(block) for block in rows]), 1)
    units = np.array([1.0, 1e-13, 1.0, 1e13, 1.0])
    scaled = eliminated(np.array([triangle_of(block) for block in rows * units]), 1)
    size = np.linalg.norm(scaled.triangle, axis=0) / units[1:-1]
    assert size == pytest.approx(np.linalg.norm(plain.triangle, axis=0), rel=1e-9)
    assert [bool(x) for x in size > 0] == [True, False, True]
    room = np.full(3, -INF), np.full(3, INF)
    one, other = (bounded_step(x.triangle, x.target, room, 1e-14) for x in (plain, scaled))
    assert other * units[1:-1] == pytest.approx(one, rel=1e-9)
    assert one[1] == 0.0
