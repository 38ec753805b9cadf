"""What noise of the measured signals does to a least-squares fit, taken off it.

The columns of the weak form hold measured signals, so noise adds to their squares and pulls the
parameters: an inertia a little, the part of a damping that nothing else tells from the skew of a
clock nearly wholly. The products of what drawn noise changes in columns and residual estimate that
share; without it the normal equations have the true parameters as their solution (Fuller 1987,
Measurement Error Models, section 2.2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import balances_of
from identification.balance.colour import LEVEL_ERROR
from identification.balance.drawn_noise import draws_of
from identification.balance.stacked import (
    INDEPENDENT_SHARE,
    SURE_ERRORS,
    Stacked,
    drawn_floors,
    noise_believed,
    stack,
)
from identification.balance.weak import WeakRecord
from identification.fitting.covariance import cores
from identification.fitting.errors_in_variables.instruments import (
    Instruments,
    can_be_met,
    from_others,
    instruments_of,
    mixed,
)
from identification.fitting.turns import Turns, turns_of
from identification.fitting.weak_form import WeakForm

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MOST_NOISE: Final = 0.9
"""Largest share of the information on a direction that may be noise: the draws know it within 3 %,
and what is left must stand clear of that.
"""
MOST_MET: Final = 0.999
"""The same where the columns of other sensors tell what is left: that is known as well as the sums
over some thousand rows."""
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
        To the products of the weighted columns with those that meet them.
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

    def of(self, index: IntArray, mix: FloatArray) -> NoiseProducts:
        """Those of some of the columns, met by combinations of theirs (columns, columns)."""
        grams = {b: mix.T @ g[np.ix_(index, index)] for b, g in self.gram.items()}
        return NoiseProducts(
            {b: (g + g.T) / 2 for b, g in grams.items()},
            {b: mix.T @ x[index] for b, x in self.score.items()},
        )

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


DrawnRows = list[list[tuple[Stacked, Stacked]]]
"""For each training record and draw: rows without and with the drawn noise."""


def drawn_rows(problem: WeakForm) -> DrawnRows:
    """Rows and columns of a problem as noise is drawn, at its values."""
    balances, data = problem.balances, problem.data

    def rows(record: WeakRecord) -> Stacked:
        return stack(balances, [record], problem.values, problem.free)

    return [
        [(rows(draw.calm), rows(draw.noisy)) for draw in draws_of(record, data.sources)]
        for record in data.train
    ]


def noise_products(
    problem: WeakForm,
    met: frozenset[str] = frozenset(),
    own: DrawnRows | None = None,
    believed: Mapping[str, float] | None = None,
) -> NoiseProducts:
    """What noise adds to the normal equations at the values of a problem.

    Shapes and smoothing velocities bend the columns, where first order does not hold: they are left
    as they are.

    Parameters
    ----------
    problem : WeakForm
    met : frozenset of str
        Balances whose columns are met by those of the other sensors
        (:mod:`identification.fitting.errors_in_variables.instruments`): what noise makes of one,
        times what it makes of the other.
    own : list, optional
        Of :func:`drawn_rows`, where they are known.
    believed : mapping of str to float, optional
        Of :func:`identification.balance.stacked.noise_believed`, where it is known.
    """
    balances, data, free = problem.balances, problem.data, problem.free
    model, count = balances.model, len(free)
    straight = ~problem.bent
    gram = {b: np.zeros((count, count)) for b in balances.balances}
    score = {b: np.zeros(count) for b in balances.balances}
    believed = believed or noise_believed(model, data, problem.values)
    first, own = 0, own or drawn_rows(problem)
    for record, pairs in zip(data.train, own, strict=True):
        rows = slice(first, first + record.rows)
        first = rows.stop
        drawn = draws_of(record, data.sources)
        for draw, (calm, noisy) in zip(drawn, pairs, strict=True):
            theirs = (
                [
                    stack(balances, [from_others(problem, w, record)], problem.values, free)
                    for w in (draw.calm, draw.noisy)
                ]
                if met
                else [calm, noisy]
            )
            for b in balances.balances:
                weight = np.broadcast_to(problem.weights[b], (problem.rows,))[rows]
                squares = weight**2 * record.taking(b)
                # pieces of a long record stand for all of it
                whole = np.sum(squares) / max(float(np.sum(squares[draw.rows])), 1e-300)
                weight = weight[draw.rows] * (believed[b] * np.sqrt(whole / len(drawn)))
                moved = (noisy.jacobian[b] - calm.jacobian[b]) * weight[:, None] * straight
                by = moved
                if b in met:
                    by = (theirs[1].jacobian[b] - theirs[0].jacobian[b]) * weight[:, None]
                    by = by * straight
                gram[b] += by.T @ moved
                score[b] += by.T @ ((noisy.residual[b] - calm.residual[b]) * weight)
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


@final
@dataclass(frozen=True)
class Unbiased:
    """A fit without what noise of the signals does to it.

    Attributes
    ----------
    values : mapping of str to float
    noise : NoiseProducts
        What noise adds to the normal equations there.
    instruments : Instruments or None
        The columns that meet those of some balances; None where each meets itself.
    """

    values: Mapping[str, float]
    noise: NoiseProducts
    instruments: Instruments | None = None


def unbiased(problem: WeakForm, limits: Mapping[str, tuple[float, float]]) -> Unbiased:
    """Values at which the normal equations hold without the noise, inside the limits, and what
    noise adds there.

    The correction is one of first order. Where it leaves more than noise can have hidden, a law
    bent under it: then shapes stay, or all of it is left out. Where other sensors meet the columns
    of a balance, its residual must stay as near to its floor as it was: a motion that tells a value
    neither way sends it anywhere.

    The clocks follow from rows within which the joint does not turn: where dry friction turns, the
    torque hangs on the very instant of the turn.  For the others these instants are unknown.

    Parameters
    ----------
    problem : WeakForm
        At the least-squares fit.
    limits : mapping of str to (low, high)
        Shapes that stand at one stay there; what noise alone pushed to one leaves it.
    """
    bounds = (
        np.array([limits[n][0] for n in problem.free]),
        np.array([limits[n][1] for n in problem.free]),
    )
    x = np.array([problem.values[n] for n in problem.free])
    moves = ((x > bounds[0]) & (x < bounds[1])) | ~problem.bent
    if problem.balances.has_gap:
        # noise about where a load turns makes the twist jump by the whole gap: no small error, and
        # what it adds to products is none of a straight line. Such rows count less already
        return Unbiased(dict(problem.values), no_noise(problem))
    start = _Equations.at(problem, turns_of(problem))
    began = start.rows @ start.rows
    better = _worth_it(start, moves)
    for equations in dict.fromkeys((better, start)):
        for moving in (moves, moves & ~problem.bent):
            found = equations.solved(bounds, moving)
            # where it began: a correction that ran away may end where all is noise
            share = equations.largest_share(moving)
            hidden = found.rows @ found.rows <= began * (1 + MOST_HIDDEN * share / (1 - share))
            if hidden and found.as_near_as(start):
                return Unbiased(dict(found.problem.values), found.noise, found.instruments)
    return Unbiased(dict(problem.values), no_noise(problem))


def _worth_it(start: _Equations, moves: npt.NDArray[np.bool_]) -> _Equations:
    """The same with the columns of the other sensors in the balances in which a noise level that is
    off moves a parameter by more than its error, and by more than where these meet them.
    """
    able = can_be_met(start.problem)
    own = {b: start.unsure(b, moves) for b in able}
    if all(size <= 1 for size in own.values()):
        return start
    theirs = start.met(able)
    worth = frozenset(b for b, size in own.items() if size > 1 and theirs.unsure(b, moves) < size)
    return theirs if worth == able else start.met(worth)


@final
@dataclass(frozen=True, eq=False)
class _Equations:
    """The normal equations of a problem at its values, and what noise adds to them."""

    problem: WeakForm
    turns: Turns
    noise: NoiseProducts
    believed: Mapping[str, float]
    """Share of the noise that is taken off: what the least squares leave tells it for all steps."""
    instruments: Instruments | None = None
    drawn: DrawnRows | None = None

    @classmethod
    def at(cls, problem: WeakForm, turns: Turns) -> _Equations:
        drawn = drawn_rows(problem)
        believed = noise_believed(problem.balances.model, problem.data, problem.values)
        noise = noise_products(problem, own=drawn, believed=believed)
        return cls(problem, turns, noise, believed, drawn=drawn)

    def met(self, balances: frozenset[str]) -> _Equations:
        """With columns of the other sensors in these balances."""
        if not balances:
            return self
        return replace(
            self,
            noise=noise_products(self.problem, balances, self.drawn, self.believed),
            instruments=instruments_of(self.problem, balances),
        )

    @cached_property
    def x(self) -> FloatArray:
        return np.array([self.problem.values[n] for n in self.problem.free])

    @cached_property
    def rows(self) -> FloatArray:
        return self.turns.without(self.problem.residual(self.x))

    @cached_property
    def columns(self) -> tuple[FloatArray, FloatArray | None]:
        """The columns, and those that meet them where these are others."""
        plain = self.problem.jacobian(self.x)
        own = self.turns.without(plain)
        if self.instruments is None:
            return own, None
        return own, self.turns.without(self.instruments.beside(plain, self.problem))

    def as_near_as(self, start: _Equations) -> bool:
        """Whether the balances that other sensors meet are left no farther above their floors than
        before, but for the scatter of a mean square.
        """
        before, after = start.over_floor, self.over_floor
        met = self.instruments.met if self.instruments else frozenset[str]()
        return all(after[b][0] <= before[b][0] * (1 + SURE_ERRORS * after[b][1]) for b in met)

    @cached_property
    def over_floor(self) -> dict[str, tuple[float, float]]:
        """Mean square of each balance over that of its noise, and the relative error of that."""
        problem, train = self.problem, self.problem.data.train
        model, sensing = problem.balances.model, problem.data.sensing
        residual = stack(balances_of(model, sensing, wrt=()), train, problem.values).residual
        levels = [drawn_floors(model, problem.data, problem.values, w) for w in train]
        out = {}
        for b, r in residual.items():
            counts = [int(w.taking(b).sum()) for w in train]
            noise = sum(n * x[b] ** 2 for n, x in zip(counts, levels, strict=True))
            rows = max(INDEPENDENT_SHARE * sum(counts), 1.0)
            out[b] = (float(r @ r) / max(noise, 1e-300), float(np.sqrt(2 / rows)))
        return out

    def solved(
        self, limits: tuple[FloatArray, FloatArray], moves: npt.NDArray[np.bool_]
    ) -> _Equations:
        """The same at their solution inside the limits; only `moves` move."""
        here = self
        met = here.instruments.met if here.instruments else frozenset[str]()
        for _ in range(STEPS):
            problem, step = here.problem, np.zeros(len(here.x))
            room = (limits[0] - here.x, limits[1] - here.x)
            if problem.clocks.any():
                told, free = problem.one_way, moves & ~problem.bent
                found = here.step(here.rows, room, free, told, float(np.mean(told)))
                step[problem.clocks] = found[problem.clocks]
            own, _ = here.columns
            step += here.step(here.rows + own @ step, room, moves & ~problem.clocks)
            problem = problem.moved(here.x + np.where(moves, step, 0.0))
            noise = noise_products(problem, met, believed=here.believed)
            here = replace(here, problem=problem, noise=noise, drawn=None)
        return here

    def step(
        self,
        rows: FloatArray,
        room: tuple[FloatArray, FloatArray],
        moves: npt.NDArray[np.bool_],
        told: npt.NDArray[np.bool_] | slice = slice(None),
        share: float = 1.0,
    ) -> FloatArray:
        """Step of the parameters that move to where the rows that are told, less a share of the
        noise, hold. What would leave its room stops there, and the others find their place beside
        it.
        """
        (own, by), out = self.columns, np.zeros(len(moves))
        seen = (own[told], None if by is None else by[told])
        moved = np.flatnonzero(moves & (np.linalg.norm(seen[0], axis=0) > 0))
        while len(moved):
            size, whole, score = self._system(seen, rows[told] + seen[0] @ out, moved, share)
            found = -np.linalg.pinv(whole, rcond=1e-12, hermitian=True) @ score / size
            beyond = (found < room[0][moved]) | (found > room[1][moved])
            out[moved] = np.where(beyond, np.clip(found, room[0][moved], room[1][moved]), 0.0)
            if not beyond.any():
                out[moved] = found
                break
            moved = moved[~beyond]
        return out

    def _system(
        self,
        columns: tuple[FloatArray, FloatArray | None],
        rows: FloatArray,
        moved: IntArray,
        share: float = 1.0,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Sizes of the columns that move, their normal matrix without noise and what pushes them,
        in these sizes.
        """
        own, mix = columns[0][:, moved], self._mix(columns, moved)
        by = own if columns[1] is None else columns[1][:, moved]
        meeting, noise = by @ mix, self.noise.of(moved, mix)
        gram = meeting.T @ own
        size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        added, pulled = (share * x for x in noise.whole)
        unit = np.outer(size, size)
        whole = whole_without((gram + gram.T) / 2 / unit, added / unit)
        return size, whole, (meeting.T @ rows - pulled) / size

    @staticmethod
    def _mix(columns: tuple[FloatArray, FloatArray | None], moved: IntArray) -> FloatArray:
        own, by = columns
        return mixed(own[:, moved], None if by is None else by[:, moved])

    def unsure(self, balance: str, moves: npt.NDArray[np.bool_]) -> float:
        """Most that a parameter would move, in its errors, were the noise of one balance off by
        :data:`LEVEL_ERROR`.
        """
        seen = self.columns
        moved = np.flatnonzero(moves & (np.linalg.norm(seen[0], axis=0) > 0))
        if not len(moved):
            return 0.0
        size, whole, _ = self._system(seen, self.rows, moved)
        pulled = self.noise.of(moved, self._mix(seen, moved)).score[balance]
        inverse = np.linalg.pinv(whole, rcond=1e-12, hermitian=True)
        error = np.sqrt(np.maximum(np.diag(inverse), 1e-300) / INDEPENDENT_SHARE)
        return float(np.max(np.abs(inverse @ (LEVEL_ERROR * pulled / size)) / error))

    def largest_share(self, moves: npt.NDArray[np.bool_]) -> float:
        """Largest share of the information on a direction that is noise: of the squares at the true
        parameters the least squares take at most that away, whatever else they fit.
        """
        seen = self.columns
        moved = np.flatnonzero(moves & (np.linalg.norm(seen[0], axis=0) > 0))
        if not len(moved):
            return 0.0
        size, left, _ = self._system(seen, self.rows, moved)
        whole = seen[0][:, moved].T @ seen[0][:, moved] / np.outer(size, size)
        share = _shares(whole, whole - left)[0]
        most = MOST_NOISE if self.instruments is None else MOST_MET
        return float(min(max(share.max(), SURE_STEP), most))


__all__ = ["NoiseProducts", "Unbiased", "no_noise", "noise_products", "unbiased", "whole_without"]
