"""What noise of the measured signals does to a least-squares fit, taken off it.

The columns of the weak form hold measured signals, so noise adds to their squares and pulls the
parameters: an inertia a little, the part of a damping that nothing else tells from the skew of a
clock nearly wholly. The products of what drawn noise changes in columns and residual estimate that
share; without it the normal equations have the true parameters as their solution (Fuller 1987,
Measurement Error Models, section 2.2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.drawn_noise import draws_of
from identification.balance.stacked import noise_believed, stack
from identification.fitting.covariance import cores
from identification.fitting.turns import Turns, turns_of
from identification.fitting.weak_form import WeakForm

FloatArray = npt.NDArray[np.float64]

MOST_NOISE: Final = 0.9
"""Largest share of the information on a direction that may be noise: the draws know it within 3 %,
and what is left must stand clear of that.
"""
SURE_STEP: Final = 0.01
"""Least share that counts: a fit has not ended to better than that of its squares."""
MOST_HIDDEN: Final = 2.0
"""Times what noise hides in the direction that holds most of it: other directions hide some, too,
and a correction that diverges leaves powers of ten more."""
STEPS: Final = 3
"""Newton steps from the least squares: the products change little with the parameters."""


@final
@dataclass(frozen=True)
class NoiseProducts:
    """What noise adds to the normal equations of each balance.

    Attributes
    ----------
    gram : mapping of str to (p, p) array
        To the products of the weighted columns.
    score : mapping of str to (p,) array
        To their products with the weighted residual.
    """

    gram: Mapping[str, FloatArray]
    score: Mapping[str, FloatArray]

    @property
    def whole(self) -> tuple[FloatArray, FloatArray]:
        """Both over all balances."""
        grams, scores = np.array(list(self.gram.values())), np.array(list(self.score.values()))
        return np.asarray(grams.sum(axis=0)), np.asarray(scores.sum(axis=0))

    def by_window(
        self,
        weights: Mapping[str, FloatArray],
        windows: Any,
        taking: Mapping[str, npt.NDArray[np.bool_]],
    ) -> tuple[FloatArray, FloatArray]:
        """What falls to the core of each window of the first, (windows, p, p), and to the window of
        the second, (windows, p): by the squares of the weights of their rows that take part.

        Parameters
        ----------
        weights : mapping of str to (rows,) array
        windows : (windows, rows) sparse array
            Of :func:`identification.fitting.covariance.windows_over`.
        taking : mapping of str to (rows,) bool array
        """
        squares = {b: w**2 * taking[b] for b, w in weights.items()}
        share = {b: w / max(float(w.sum()), 1e-300) for b, w in squares.items()}
        core = cores(windows)
        return (
            np.asarray(sum((core @ share[b])[:, None, None] * g for b, g in self.gram.items())),
            np.asarray(sum((windows @ share[b])[:, None] * x for b, x in self.score.items())),
        )


def noise_products(problem: WeakForm) -> NoiseProducts:
    """What noise adds to the normal equations at the values of a problem.

    Shapes and smoothing velocities bend the columns, where first order does not hold: they are left
    as they are.
    """
    balances, data, free = problem.balances, problem.data, problem.free
    model, count = balances.model, len(free)
    straight = ~problem.bent
    gram = {b: np.zeros((count, count)) for b in balances.balances}
    score = {b: np.zeros(count) for b in balances.balances}
    believed = noise_believed(model, data, problem.values)
    first = 0
    for record in data.train:
        rows = slice(first, first + record.rows)
        first = rows.stop
        drawn = draws_of(record, data.sources)
        for draw in drawn:
            calm, noisy = (
                stack(balances, [w], problem.values, free) for w in (draw.calm, draw.noisy)
            )
            for b in balances.balances:
                weight = np.broadcast_to(problem.weights[b], (problem.rows,))[rows]
                squares = weight**2 * record.taking(b)
                # pieces of a long record stand for all of it
                whole = np.sum(squares) / max(float(np.sum(squares[draw.rows])), 1e-300)
                weight = weight[draw.rows] * (believed[b] * np.sqrt(whole / len(drawn)))
                moved = (noisy.jacobian[b] - calm.jacobian[b]) * weight[:, None] * straight
                gram[b] += moved.T @ moved
                score[b] += moved.T @ ((noisy.residual[b] - calm.residual[b]) * weight)
    return NoiseProducts(gram, score)


def no_noise(problem: WeakForm) -> NoiseProducts:
    """Products of a problem from whose rows nothing is taken off."""
    size, names = len(problem.free), problem.balances.balances
    return NoiseProducts(
        {b: np.zeros((size, size)) for b in names}, {b: np.zeros(size) for b in names}
    )


def whole_without(whole: FloatArray, noise: FloatArray) -> FloatArray:
    """A normal matrix without what noise adds to it, as far as that is certain.

    Parameters
    ----------
    whole, noise : (p, p) array
        Columns scaled alike; `whole` positive definite but for rounding.
    """
    share, left = _shares(whole, noise)
    return np.asarray(left * (1 - np.clip(share, 0.0, MOST_NOISE)) @ left.T, dtype=np.float64)


def _shares(whole: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Share of noise in directions that are independent in both matrices, and the directions:
    columns whose products add up to `whole`."""
    value, vector = np.linalg.eigh(whole)
    kept = value > 1e-12 * value[-1]
    root = vector[:, kept] * np.sqrt(value[kept])
    white = vector[:, kept] / np.sqrt(value[kept])
    share, direction = np.linalg.eigh(white.T @ noise @ white)
    return share, np.asarray(root @ direction, dtype=np.float64)


def unbiased(
    problem: WeakForm, limits: Mapping[str, tuple[float, float]]
) -> tuple[dict[str, float], NoiseProducts]:
    """Values at which the normal equations hold without the noise, inside the limits, and what
    noise adds there.

    The correction is one of first order. Where it leaves more than noise can have hidden, a law
    bent under it: then shapes stay, or all of it is left out.

    The clocks follow from rows within which the joint does not turn: where dry friction turns, the
    torque hangs on the very instant of the turn.  For the others these instants are unknown.

    Parameters
    ----------
    problem : WeakForm
        At the least-squares fit.
    limits : mapping of str to (low, high)
        Parameters that stand at one stay there.
    """
    low, high = (np.array([limits[n][k] for n in problem.free]) for k in (0, 1))
    x = np.array([problem.values[n] for n in problem.free])
    moves = (x > low) & (x < high)
    if problem.balances.has_gap:
        # noise about where a load turns makes the twist jump by the whole gap: no small error, and
        # what it adds to products is none of a straight line. Such rows count less already
        return dict(problem.values), no_noise(problem)
    turns = turns_of(problem)
    began = turns.without(problem.residual(x))
    for moving in (moves, moves & ~problem.bent):
        found, noise = _corrected(problem, x, turns, (low, high), moving)
        left = turns.without(found.residual(np.array([found.values[n] for n in found.free])))
        share = _largest_share(found, noise, moving)
        if left @ left <= began @ began * (1 + MOST_HIDDEN * share / (1 - share)):
            return dict(found.values), noise
    return dict(problem.values), no_noise(problem)


def _corrected(
    problem: WeakForm,
    x: FloatArray,
    turns: Turns,
    limits: tuple[FloatArray, FloatArray],
    moves: npt.NDArray[np.bool_],
) -> tuple[WeakForm, NoiseProducts]:
    """The problem at the solution of its equations without noise, and what noise adds there."""
    clocks, noise, x = problem.clocks, noise_products(problem), x.copy()
    for _ in range(STEPS):
        rows, jacobian = turns.without(problem.residual(x)), turns.without(problem.jacobian(x))
        step = np.zeros(len(x))
        if clocks.any():
            told = problem.one_way
            step[clocks] = _newton(
                jacobian[told], rows[told], noise, moves & ~problem.bent, float(np.mean(told))
            )[clocks]
        step += _newton(jacobian, rows + jacobian @ step, noise, moves & ~clocks)
        x[moves] = np.clip(x + step, *limits)[moves]
        problem = problem.moved(x)
        noise = noise_products(problem)
    return problem, noise


def _largest_share(problem: WeakForm, noise: NoiseProducts, moves: npt.NDArray[np.bool_]) -> float:
    """Largest share of the information on a direction that is noise: of the squares at the true
    parameters the least squares take at most that away, whatever else they fit.
    """
    jacobian = problem.jacobian(np.array([problem.values[n] for n in problem.free]))
    size = np.linalg.norm(jacobian, axis=0)
    moved = moves & (size > 0)
    if not moved.any():
        return 0.0
    scaled, unit = jacobian[:, moved] / size[moved], np.outer(size[moved], size[moved])
    share = _shares(scaled.T @ scaled, noise.whole[0][np.ix_(moved, moved)] / unit)[0]
    return float(min(max(share.max(), SURE_STEP), MOST_NOISE))


def _newton(
    jacobian: FloatArray,
    rows: FloatArray,
    noise: NoiseProducts,
    moves: npt.NDArray[np.bool_],
    share: float = 1.0,
) -> FloatArray:
    """Step of the parameters that move to where these rows, less a share of the noise, hold."""
    out = np.zeros(len(moves))
    size = np.linalg.norm(jacobian, axis=0)
    moved = moves & (size > 0)
    if not moved.any():  # everything is known
        return out
    scaled, unit = jacobian[:, moved] / size[moved], np.outer(size[moved], size[moved])
    added, pulled = noise.whole
    score = scaled.T @ rows - share * pulled[moved] / size[moved]
    whole = whole_without(scaled.T @ scaled, share * added[np.ix_(moved, moved)] / unit)
    out[moved] = -np.linalg.pinv(whole, rcond=1e-12, hermitian=True) @ score / size[moved]
    return out
