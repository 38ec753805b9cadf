"""The bounded least-squares solver: one for every fit of the package.

Levenberg-Marquardt steps inside a box.  Each step solves a small triangle (QR of the Jacobian,
columns scaled alike) with an active set on the box; parameters of the size of a scale move on a
log scale; unknowns that belong to one block of rows alone (the start state of a window) are
eliminated block by block (Schur complement, on triangles).

References: Nocedal and Wright, Numerical Optimization (2006), chapters 10 and 16; Marquardt (1963).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Final, Protocol, final, runtime_checkable

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

FIRST_DAMPING: Final = 1e-9
"""Damping of the first step, relative to columns of unit length: next to a plain Gauss-Newton
step."""
LEAST_DAMPING: Final = 1e-12
"""Damping is not lowered further: rounding of the triangle is of this size."""
RAISED_DAMPING: Final = 1e-6
"""Damping after a refused step, at least: smaller ones do not change the step of well-conditioned
columns. A larger floor makes long narrow valleys slow (NIST's Lanczos3 and MGH09 take twice the
evaluations with 1e-4)."""
RAISE, LOWER = 30.0, 10.0
"""Factors of the damping after a refused and after an accepted step (Marquardt's rule with uneven
factors, so that the damping does not swing between two values)."""
MOST_REFUSALS: Final = 12
"""Refused steps in a row: with `RAISE` the damping has passed 1e10 by then, a step of nothing but
rounding."""
LONGEST_LOG_STEP: Final = 1.0
"""Longest step of a parameter on a log scale: a factor e, within which a curve in its logarithm is
still near its tangent."""
LEAST_SHARE: Final = 0.1
"""Share of the promised fall that a step must bring: less, and the rows are too curved for it.
With steps of any fall a search runs out into plains where nothing moves (a rate so fast that its
exponential is over at the first sample)."""
KEPT: Final = 0.9
"""Share of the promised fall that makes the next step bolder: between this and `LEAST_SHARE` the
damping is right as it is."""
DEAD: Final = 1e-12
"""Share of a column that the blocks' own unknowns leave of it, below which it is rounding. Columns
are held against themselves alone: one in N.m per rad^3 is 1e-13 of one in N.m per rad and moves as
much."""
RANK: Final = 1e-13
"""Singular values below this share of the largest are rounding; the step of least length is taken
there."""
ROUNDING: Final = 1e-12
"""Relative rise of a sum of squares that is rounding of its many terms."""
NOTHING_LEFT: Final = 1e-28
"""Share of the sum of squares at the start below which what is left is rounding: residuals 1e-14
of their start."""
WORTH: Final = 1e-3
"""Relative fall of the sum of squares by the blocks' own unknowns alone that is worth another step
of the parameters."""
RIDGE: Final = 1e-14
"""Added to the diagonal of products of columns scaled to unit length before their square root: the
rounding of a product."""


class Outcome(Enum):
    """How a search ended; the value is the sentence a user reads."""

    SETTLED = "A minimum: no step lowers the sum of squares any further."
    EXACT = "The rows are met to rounding."
    STUCK = "No step, however short, lowers the sum of squares, though its slope promises a fall."
    ITERATIONS = "The allowed iterations were used up before the sum of squares came to rest."
    NOT_FINITE = "The residual is not finite at the start values."

    def __str__(self) -> str:
        """Return the sentence."""
        return self.value


class Problem(Protocol):
    """Rows that ought to be zero."""

    def residual(self, x: FloatArray) -> FloatArray:
        """Weighted residual at `x` (parameters,), shape (rows,); not finite where it cannot be
        had."""

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Its derivative with respect to `x`, shape (rows, parameters)."""


@runtime_checkable
class LocalProblem(Protocol):
    """Rows in blocks, each with a few unknowns of its own beside the common parameters."""

    def costs(self, x: FloatArray, local: FloatArray) -> FloatArray:
        """Sum of squares of each block at `x` (parameters,) and `local` (blocks, unknowns), shape
        (blocks,); not finite where it cannot be had."""

    def triangles(self, x: FloatArray, local: FloatArray) -> FloatArray:
        """Triangle of each block's columns: own unknowns, parameters, residual; shape (blocks, k,
        k)."""


@final
@dataclass(frozen=True)
class Linear:
    """The rows to first order: ``|triangle @ step + target|^2`` and a constant.

    Attributes
    ----------
    triangle : (p, p) array
    target : (p,) array
    back : (blocks, unknowns, p + 1) array
        Steps of the blocks' own unknowns: ``-(back[:, :, :-1] @ step + back[:, :, -1])``.
    unsettled : float
        Fall of the sum of squares that the blocks' own unknowns promise while the parameters rest.
    """

    triangle: FloatArray
    target: FloatArray
    back: FloatArray
    unsettled: float = 0.0

    def own_step(self, step: FloatArray) -> FloatArray:
        """Step of the blocks' own unknowns with a step of the parameters, (blocks, unknowns)."""
        return np.asarray(-(self.back[:, :, :-1] @ step + self.back[:, :, -1]), dtype=np.float64)

    def fall(self, step: FloatArray) -> float:
        """Fall of the sum of squares to first order, the blocks' own unknowns taken along."""
        after = self.triangle @ step + self.target
        return float(self.target @ self.target - after @ after) + self.unsettled


@final
@dataclass(frozen=True)
class Minimum:
    """Where a search ended.

    Attributes
    ----------
    x : (parameters,) array
    local : (blocks, unknowns) array
        Empty for a :class:`Problem`.
    cost : float
        Sum of squares.
    outcome : Outcome
    iterations, evaluations : int
        Steps, and evaluations of the residual (derivatives not counted).
    at_bound : (parameters,) array of bool
    """

    x: FloatArray
    local: FloatArray
    cost: float
    outcome: Outcome
    iterations: int
    evaluations: int
    at_bound: BoolArray


@final
class _Rows:
    """A problem without blocks, seen as one with a single block that has no unknowns of its own."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._kept: tuple[FloatArray, FloatArray] | None = None

    def costs(self, x: FloatArray, local: FloatArray) -> FloatArray:
        r = self._problem.residual(x)
        self._kept = x, r
        return np.array([float(r @ r) if np.isfinite(r).all() else math.inf])

    def triangles(self, x: FloatArray, local: FloatArray) -> FloatArray:
        jacobian = self._problem.jacobian(x)
        kept = self._kept is not None and self._kept[0] is x
        r = self._kept[1] if self._kept is not None and kept else self._problem.residual(x)
        return triangle_of(np.column_stack([jacobian, r]))[None]


def least_squares(
    problem: Problem | LocalProblem,
    start: npt.ArrayLike,
    bounds: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
    *,
    logarithmic: npt.ArrayLike | None = None,
    local: FloatArray | None = None,
    iterations: int = 100,
    tolerance: float = 1e-12,
) -> Minimum:
    """Minimise a sum of squares inside a box.

    Parameters
    ----------
    problem : Problem or LocalProblem
    start : (parameters,) array
        Drawn into the box.
    bounds : two (parameters,) arrays, optional
        Lower and upper bounds; infinite ones are none.
    logarithmic : (parameters,) array of bool, optional
        Parameters that are positive and move on a log scale.
    local : (blocks, unknowns) array
        Start values of the blocks' own unknowns, for a :class:`LocalProblem` only.
    iterations : int
        Steps at most.
    tolerance : float
        The search ends with the step that promises, or brings, a smaller relative fall of the sum
        of squares.  What a step promises is free of the rounding of the sum, so that the number of
        steps does not depend on the processor.

    Returns
    -------
    Minimum
        Its sum of squares is never larger than that of the start, beyond rounding.
    """
    first = np.array(start, dtype=np.float64)
    low, high = (
        np.broadcast_to(np.asarray(b, dtype=np.float64), first.shape)
        for b in bounds or (-np.inf, np.inf)
    )
    given = False if logarithmic is None else logarithmic
    logs = np.broadcast_to(np.asarray(given, dtype=bool), first.shape)
    rows: LocalProblem = problem if isinstance(problem, LocalProblem) else _Rows(problem)
    box = _Box(low, high, logs)
    own = np.zeros((1, 0)) if local is None else np.array(local, dtype=np.float64)
    at = _Point.of(rows, np.clip(first, low, high), own)
    begun = at.cost
    evaluations, used, damping = 1, 0, FIRST_DAMPING
    held = np.zeros(len(own))
    outcome = Outcome.ITERATIONS if math.isfinite(begun) else Outcome.NOT_FINITE
    while outcome is Outcome.ITERATIONS and used < iterations:
        if at.cost <= NOTHING_LEFT * begun:
            outcome = Outcome.EXACT
            break
        used += 1
        triangles = rows.triangles(at.x, at.local)
        small = tolerance * at.cost
        for _ in range(MOST_REFUSALS):
            linear = _linear(triangles, at, logs, held)
            step = bounded_step(linear.triangle, linear.target, box.room(at.x), damping)
            promised = linear.fall(step)
            trial = _Point.of(rows, box.moved(at.x, step), at.local + linear.own_step(step))
            evaluations += 1
            if not step.any():
                trial = at.each_better(trial)
            gained = at.cost - trial.cost
            if gained >= LEAST_SHARE * promised - ROUNDING * at.cost:
                held = np.where(trial.costs > at.costs, held, held / LOWER)
                held[held < RAISED_DAMPING] = 0.0
                at, damping = trial, _eased(damping, gained, promised)
                outcome = Outcome.SETTLED if min(promised, gained) <= small else outcome
                break
            if promised <= small:
                outcome = Outcome.SETTLED
                break
            rose = trial.costs > at.costs
            if own.shape[1]:
                held = np.where(rose, np.maximum(held * RAISE, RAISED_DAMPING), held)
            # where the other blocks gain what was promised the common step is good, and those that
            # rose are too curved in their own unknowns
            others = float(np.sum(at.costs[~rose] - trial.costs[~rose]))
            if not own.shape[1] or others < LEAST_SHARE * promised:
                damping = max(damping * RAISE, RAISED_DAMPING)
        else:
            # blocks whose own unknowns are off hold up the common step: these first, each block
            # for itself
            settled = at.each_better(_Point.of(rows, at.x, at.local + linear.own_step(0.0 * step)))
            evaluations += 1
            outcome = Outcome.STUCK if at.cost - settled.cost <= WORTH * at.cost else outcome
            at, damping, held = settled, FIRST_DAMPING, np.zeros(len(own))
    edge = (at.x <= low) | (at.x >= high)
    return Minimum(
        at.x,
        at.local,
        cost=at.cost,
        outcome=outcome,
        iterations=used,
        evaluations=evaluations,
        at_bound=edge,
    )


@final
@dataclass(frozen=True)
class _Point:
    """Where the search stands: parameters, the blocks' own unknowns, each block's sum of
    squares."""

    x: FloatArray
    local: FloatArray
    costs: FloatArray

    @classmethod
    def of(cls, rows: LocalProblem, x: FloatArray, local: FloatArray) -> _Point:
        """The point with its sums of squares."""
        return cls(x, local, rows.costs(x, local))

    @property
    def cost(self) -> float:
        """Sum of squares; infinite where it cannot be had."""
        total = float(self.costs.sum())
        return total if math.isfinite(total) else math.inf

    def each_better(self, other: _Point) -> _Point:
        """Each block's own unknowns from the point that leaves less of it; the parameters must be
        the same."""
        better = other.costs < self.costs
        local = np.where(better[:, None], other.local, self.local)
        return _Point(self.x, local, np.where(better, other.costs, self.costs))


@final
@dataclass(frozen=True)
class _Box:
    """Bounds, and which parameters move on a log scale."""

    low: FloatArray
    high: FloatArray
    logs: BoolArray

    def room(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far each parameter may go down and up."""
        down, up = self.low - x, self.high - x
        for i in np.flatnonzero(self.logs):
            least = math.log(self.low[i] / x[i]) if self.low[i] > 0 else -math.inf
            down[i] = max(least, -LONGEST_LOG_STEP)
            up[i] = min(math.log(self.high[i] / x[i]), LONGEST_LOG_STEP)
        return np.minimum(down, 0.0), np.maximum(up, 0.0)

    def moved(self, x: FloatArray, step: FloatArray) -> FloatArray:
        """The parameters after a step."""
        new = np.where(self.logs, x * np.exp(np.where(self.logs, step, 0.0)), x + step)
        return np.asarray(np.clip(new, self.low, self.high), dtype=np.float64)


def _linear(triangles: FloatArray, at: _Point, logs: BoolArray, held: FloatArray) -> Linear:
    """The rows to first order around a point, the own unknowns of each block held back by its
    damping; slopes of logarithmic parameters per unit of the logarithm."""
    unknowns = at.local.shape[1]
    linear = eliminated(held_back(triangles, unknowns, held), unknowns)
    factor = np.where(logs, at.x, 1.0)
    back = linear.back * np.append(factor, 1.0)
    return Linear(linear.triangle * factor, linear.target, back, linear.unsettled)


def held_back(triangles: FloatArray, unknowns: int, damping: FloatArray) -> FloatArray:
    """Triangles of blocks whose own unknowns pay for their steps.

    A block whose own unknowns are off where its rows are curved, such as a window of time that
    starts at a turn, takes too long a step of them, whatever the damping of the common parameters.

    Parameters
    ----------
    triangles : (blocks, k, k) array
    unknowns : int
        First columns that are the block's own.
    damping : (blocks,) array
        Relative to columns of unit length; 0 leaves a block as it is.
    """
    out = triangles.copy() if damping.any() else triangles
    for i in np.flatnonzero(damping):
        price = np.zeros((unknowns, triangles.shape[2]))
        size = np.linalg.norm(triangles[i, :, :unknowns], axis=0)
        np.fill_diagonal(price, math.sqrt(damping[i]) * size)
        out[i] = triangle_of(np.vstack([triangles[i], price]))
    return out


def triangle_of(rows: FloatArray) -> FloatArray:
    """Triangle R of rows (n, k) with R'R = rows'rows, shape (k, k)."""
    k = rows.shape[1]
    r = np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)
    return r if len(r) == k else np.vstack([r, np.zeros((k - len(r), k))])


def triangles_of_products(products: FloatArray) -> FloatArray:
    """The same from products of the columns, (blocks, k, k): half the digits, for rows that were
    never kept."""
    size = np.sqrt(np.einsum("bii->bi", products))
    empty = size <= 0
    size = np.where(empty, 1.0, size)
    k = products.shape[1]
    scaled = products / (size[:, :, None] * size[:, None, :]) + RIDGE * k * np.eye(k)
    lower = np.linalg.cholesky(scaled)
    size = np.where(empty, 0.0, size)
    return np.asarray(lower.transpose(0, 2, 1) * size[:, None, :], dtype=np.float64)


def eliminated(triangles: FloatArray, unknowns: int) -> Linear:
    """The common parameters' rows, without the unknowns that each block has for itself.

    Parameters
    ----------
    triangles : (blocks, k, k) array
        Columns: own unknowns, parameters, residual.
    unknowns : int
        How many of them are the block's own.
    """
    inner, across = triangles[:, :unknowns, :unknowns], triangles[:, :unknowns, unknowns:]
    back = np.zeros(across.shape)
    if unknowns:
        size = np.linalg.norm(inner, axis=1)
        size = np.where(size > 0, size, 1.0)
        back = np.linalg.pinv(inner / size[:, None, :], rcond=RANK) @ across / size[:, :, None]
    rest = common_rows(triangles, unknowns)
    small = triangle_of(rest.reshape(-1, rest.shape[2])) if len(rest) > 1 else rest[0]
    columns = small[:-1, :-1]
    before = np.linalg.norm(triangles[:, :, unknowns:-1], axis=(0, 1))
    columns = columns * (np.linalg.norm(columns, axis=0) > DEAD * before)
    return Linear(columns, small[:-1, -1], back, float(np.sum(across[:, :, -1] ** 2)))


def common_rows(triangles: FloatArray, unknowns: int) -> FloatArray:
    """Triangle of each block for the common parameters and the residual alone, (blocks, p + 1, p +
    1)."""
    return triangles[:, unknowns:, unknowns:]


def bounded_step(
    triangle: FloatArray,
    target: FloatArray,
    room: tuple[FloatArray, FloatArray],
    damping: float,
) -> FloatArray:
    """Step that minimises ``|triangle @ step + target|^2 + damping |scaled step|^2`` inside a box.

    Parameters that would leave the box stay on its wall and the others are solved again; then
    those that the slope drives back inside are let go, until none is left (Portugal, Judice and
    Vicente 1994: block pivoting).

    Parameters
    ----------
    triangle : (p, p) array
    target : (p,) array
    room : two (p,) arrays
        Largest step down (<= 0) and up (>= 0).
    damping : float
        Relative to columns of unit length.
    """
    norms = np.linalg.norm(triangle, axis=0)
    alive = norms > 0
    scale = np.where(alive, norms, 1.0)
    down, up = room[0] * scale, room[1] * scale
    a = np.vstack([triangle / scale, math.sqrt(damping) * np.eye(len(scale))])
    b = np.concatenate([target, np.zeros(len(scale))])
    free, step = alive.copy(), np.zeros(len(scale))
    for _ in range(3 * len(scale) + 1):
        index, walls = np.flatnonzero(free), np.flatnonzero(alive & ~free)
        if len(index):
            step[index] = np.linalg.lstsq(
                a[:, index], -(b + a[:, walls] @ step[walls]), rcond=RANK
            )[0]
        outside = free & ((step < down * (1 + ROUNDING)) | (step > up * (1 + ROUNDING)))
        if outside.any():
            step[outside] = np.clip(step, down, up)[outside]
            free[outside] = False
            continue
        slope = a.T @ (a @ step + b)
        inward = (
            alive
            & ~free
            & (down < up)
            & (((step <= down) & (slope < -_flat(b))) | ((step >= up) & (slope > _flat(b))))
        )
        if not inward.any():
            break
        # one at a time: several at once can go round in circles
        free[int(np.argmax(np.where(inward, np.abs(slope), 0.0)))] = True
    return np.where(alive, np.clip(step, down, up) / scale, 0.0)


def _flat(target: FloatArray) -> float:
    """Slope that is rounding of the target's size."""
    return RANK * max(float(np.linalg.norm(target)), 1e-300)


def _eased(damping: float, gained: float, promised: float) -> float:
    """Damping after an accepted step: lower where the step kept its promise, as it is where it
    fell short."""
    return max(damping / LOWER, LEAST_DAMPING) if gained >= KEPT * promised else damping
