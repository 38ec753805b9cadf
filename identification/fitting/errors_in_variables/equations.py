"""What noise of the measured signals does to a least-squares fit, taken off it.

The columns of the weak form hold measured signals, so noise adds to their squares and pulls the
parameters: an inertia a little, the part of a damping that nothing else tells from the skew of a
clock nearly wholly. The products of what drawn noise changes in columns and residual estimate that
share; without it the normal equations have the true parameters as their solution (Fuller 1987,
Measurement Error Models, section 2.2).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import balances_of
from identification.balance.colour import LEVEL_ERROR
from identification.balance.stacked import (
    SURE_ERRORS,
    drawn_floors,
    noise_believed,
    stack,
    taking_part,
)
from identification.balance.weak import INDEPENDENT_SHARE
from identification.fitting.covariance import RANK
from identification.fitting.errors_in_variables.bands import Bands
from identification.fitting.errors_in_variables.instruments import (
    Instruments,
    can_be_met,
    instruments_of,
    mixed,
)
from identification.fitting.errors_in_variables.products import (
    MOST_NOISE,
    SURE_STEP,
    DrawnRows,
    NoiseProducts,
    Unbiased,
    drawn_rows,
    known,
    level_error,
    no_noise,
    noise_products,
    shares,
    whole_without,
)
from identification.fitting.turns import Turns
from identification.fitting.weak_form import WeakForm

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Without = Callable[[FloatArray, FloatArray], FloatArray]
"""A normal matrix without what noise adds to it, of both."""

MOST_MET: Final = 0.999
"""The same where the columns of other sensors tell what is left: that is known as well as the sums
over some thousand rows."""
MOST_HIDDEN: Final = 2.0
"""Times what noise hides in the direction that holds most of it: other directions hide some, too,
and a correction that diverges leaves powers of ten more."""
FARTHEST: Final = 2.0
"""Factor by which such a correction may move a scale: farther off its column is another one."""
STEPS: Final = 3
"""Newton steps from the least squares: the products change little with the parameters."""
SETTLED: Final = 1e-3
"""Most by which the next step would move any combination of parameters, in standard errors of white
rows, where there is no next step: rows on straight lines are there after the first.
"""


def unbiased(
    problem: WeakForm, limits: Mapping[str, tuple[float, float]], share: float = 1.0
) -> Unbiased:
    """Values at which the normal equations hold without the noise, inside the limits, and what
    noise adds there.

    The correction is one of first order. Where it leaves more than noise can have hidden, which is
    what it has of the directions and never more than all of it, a law bent under it: then shapes
    stay, or all of it is left out. A scale that would move far stays. Where other sensors meet the
    columns of a balance, its residual must stay as near to its floor as it was: a motion that tells
    a value neither way sends it anywhere.

    The clocks follow from rows within which the joint does not turn: where dry friction turns, the
    torque hangs on the very instant of the turn.  For the others these instants are unknown.

    Parameters
    ----------
    problem : WeakForm
        At the least-squares fit.
    limits : mapping of str to (low, high)
        Shapes that stand at one stay there; what noise alone pushed to one leaves it.
    share : float
        Share of the rows that count as independent beside what is known beforehand.
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
        return Unbiased(dict(problem.values), no_noise(problem), None, np.zeros(len(x)))
    start = _Equations.at(problem, problem.turns)
    began = start.rows @ start.rows
    better = _worth_it(start, bounds, moves, share)
    for equations in dict.fromkeys((better, start)):
        ways = [moves & ~problem.bent, moves]
        while ways:
            moving = ways.pop()
            found = equations.solved(bounds, moving)
            if (far := found.far_from(start)).any():
                ways += [moves & ~far] if moving is moves else []
                continue
            if not found.has_squares:
                continue
            # where it began: a correction that ran away may end where all is noise
            share = equations.largest_share(moving)
            hidden = found.rows @ found.rows <= began * (1 + MOST_HIDDEN * share / (1 - share))
            if hidden and found.no_more_than_noise(start) and found.as_near_as(start):
                left = found.left(bounds, moving)
                return Unbiased(dict(found.problem.values), found.noise, found.instruments, left)
    left = start.left(bounds, moves)
    return Unbiased(dict(problem.values), no_noise(problem), None, left)


def _worth_it(
    start: _Equations,
    limits: tuple[FloatArray, FloatArray],
    moves: npt.NDArray[np.bool_],
    share: float,
) -> _Equations:
    """The same with the columns of the other sensors in the balances in which a noise level that is
    off moves a parameter by more than the error it has with these, and by more than where these
    meet them: at the values that they tell, as noise that made an inertia zero moves nothing there.
    """
    able = can_be_met(start.problem)
    if not able:
        return start
    theirs = start.met(able)
    step = theirs.step(theirs.rows, (limits[0] - theirs.x, limits[1] - theirs.x), moves)
    errors = theirs.errors(step, moves, share)
    own, other = ({b: x.unsure(b, step, moves, errors) for b in able} for x in (start, theirs))
    worth = frozenset(b for b, size in own.items() if size > 1 and other[b] < size)
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

    @property
    def has_squares(self) -> bool:
        """Whether the squares of all rows and columns are numbers."""
        with np.errstate(over="ignore", invalid="ignore"):
            squares = np.append(np.sum(self.columns[0] ** 2, axis=0), self.rows @ self.rows)
        return bool(np.isfinite(squares).all())

    def far_from(self, start: _Equations) -> npt.NDArray[np.bool_]:
        """Scales that are not nearly what they were, (free,)."""
        far = np.zeros(len(self.x), dtype=np.bool_)
        scales = start.problem.logarithmic
        ratio = self.x[scales] / start.x[scales]
        far[scales] = (ratio > FARTHEST) | (ratio * FARTHEST < 1.0)
        return far

    def as_near_as(self, start: _Equations) -> bool:
        """Whether the balances that other sensors meet are left no farther above their floors than
        before, but for the scatter of a mean square.
        """
        before, after = start.over_floor, self.over_floor
        met = self.instruments.met if self.instruments else frozenset[str]()
        return all(after[b][0] <= before[b][0] * (1 + SURE_ERRORS * after[b][1]) for b in met)

    def no_more_than_noise(self, start: _Equations) -> bool:
        """Whether the squares of all rows grew by no more than their noise did.

        Without the noise they are smallest here. So what the rows of the least squares leave less
        is noise that these pass on less: a damping at zero passes on none. How much noise there is
        is known badly where its tails are heavy, up to all that is left: so they may grow by the
        factor by which it does, but for the scatter of a mean square, and by no more than
        :data:`MOST_HIDDEN` times what noise there is.
        """
        began, here = (float(x.rows @ x.rows) for x in (start, self))
        before, after = start.noise_squares, self.noise_squares
        scatter = SURE_ERRORS * math.sqrt(2 / max(INDEPENDENT_SHARE * len(self.rows), 1.0))
        factor = max(after / max(before, 1e-300), 1.0) + scatter
        return here <= began * factor and here <= began + MOST_HIDDEN * after

    @property
    def noise_squares(self) -> float:
        """Squares of all rows, weighted, that are noise as believed."""
        problem, train = self.problem, self.problem.data.train
        model, total = problem.balances.model, 0.0
        levels = [drawn_floors(model, problem.data, problem.values, w) for w in train]
        for b in problem.balances.balances:
            level = np.concatenate(
                [np.full(w.rows, x[b]) for w, x in zip(train, levels, strict=True)]
            )
            level = self.believed[b] * level * problem.weights[b]
            total += float(np.sum(level[taking_part(b, train)] ** 2))
        return total

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
            if not here.has_squares:  # it has run away, and no farther step is a number
                break
            step = here.next_step(limits, moves)
            with np.errstate(over="ignore", invalid="ignore"):  # the next look ends that
                if here.hardly_moved_by(step):
                    break
                problem = here.problem.moved(here.x + step)
                noise = noise_products(problem, met, believed=here.believed)
            here = replace(here, problem=problem, noise=noise, drawn=None)
        return here

    def hardly_moved_by(self, step: FloatArray) -> bool:
        """Whether a step (free,) changes the rows by no more than :data:`SETTLED`."""
        change = float(np.linalg.norm(self.columns[0] @ step))
        scatter = float(np.linalg.norm(self.rows)) / math.sqrt(len(self.rows))
        return change <= SETTLED * scatter

    def next_step(
        self,
        limits: tuple[FloatArray, FloatArray],
        moves: npt.NDArray[np.bool_],
        without: Without = whole_without,
    ) -> FloatArray:
        """Step (free,) towards the solution inside the limits; only `moves` move, by what a normal
        matrix holds `without` the noise.
        """
        problem, step = self.problem, np.zeros(len(self.x))
        room = (limits[0] - self.x, limits[1] - self.x)
        if problem.clocks.any():
            told, free = problem.one_way, moves & ~problem.bent
            share = float(np.mean(told))
            found = self.step(self.rows, room, free, told=told, share=share, without=without)
            step[problem.clocks] = found[problem.clocks]
        own, _ = self.columns
        step += self.step(self.rows + own @ step, room, moves & ~problem.clocks, without=without)
        return np.where(moves, step, 0.0)

    def step(
        self,
        rows: FloatArray,
        room: tuple[FloatArray, FloatArray],
        moves: npt.NDArray[np.bool_],
        *,
        told: npt.NDArray[np.bool_] | slice = slice(None),
        share: float = 1.0,
        without: Without = whole_without,
    ) -> FloatArray:
        """Step of the parameters that move to where the rows that are told, less a share of the
        noise, hold, by what a normal matrix holds `without` it. What would leave its room stops
        there, and the others find their place beside it.
        """
        (own, by), out = self.columns, np.zeros(len(moves))
        seen = (own[told], None if by is None else by[told])
        moved = np.flatnonzero(moves & (np.linalg.norm(seen[0], axis=0) > 0))
        while len(moved):
            size, whole, score = self._system(
                seen, rows[told] + seen[0] @ out, moved, share=share, without=without
            )
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
        *,
        share: float = 1.0,
        without: Without = whole_without,
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
        whole = without((gram + gram.T) / 2 / unit, added / unit)
        return size, whole, (meeting.T @ rows - pulled) / size

    @staticmethod
    def _mix(columns: tuple[FloatArray, FloatArray | None], moved: IntArray) -> FloatArray:
        own, by = columns
        return mixed(own[:, moved], None if by is None else by[:, moved])

    def errors(self, step: FloatArray, moves: npt.NDArray[np.bool_], share: float) -> FloatArray:
        """Standard errors of the parameters (free,) after a step, as a fit states them; infinite
        for those that do not move.

        White rows would not do: noise of an acceleration has no slow part, and an inertia is up to
        fifteen times surer than they say.
        """
        problem = self.problem.moved(self.x + step)
        without = Unbiased(problem.values, self.noise, self.instruments, np.zeros(len(step)))
        bands = Bands(problem, without, self.turns, share)
        out, moved = np.full(len(moves), np.inf), np.flatnonzero(moves & (bands.norms > 0))
        if not len(moved):
            return out
        part = bands.of(moved)
        size = part.errors
        if size is None:  # too few windows
            inverse = np.linalg.pinv(part.whole, rcond=RANK, hermitian=True)
            size = np.sqrt(np.maximum(np.diag(inverse), 0.0) / INDEPENDENT_SHARE)
        out[moved] = size / bands.norms[moved]
        return out

    def left(
        self, limits: tuple[FloatArray, FloatArray], moves: npt.NDArray[np.bool_]
    ) -> FloatArray:
        """How far each parameter (free,) may be off by noise that is not taken off."""
        unsure = level_error(self.problem.data)
        return np.abs(self.next_step(limits, moves, partial(known, unsure=unsure)))

    def unsure(
        self, balance: str, step: FloatArray, moves: npt.NDArray[np.bool_], errors: FloatArray
    ) -> float:
        """Most that a parameter would move, in these errors (free,), were the noise of one balance
        off by :data:`LEVEL_ERROR` at the values after a step (free,).
        """
        seen = self.columns
        moved = np.flatnonzero(moves & (np.linalg.norm(seen[0], axis=0) > 0))
        if not len(moved):
            return 0.0
        size, whole, _ = self._system(seen, self.rows, moved)
        noise = self.noise.of(moved, self._mix(seen, moved))
        pulled = noise.score[balance] + noise.gram[balance] @ step[moved]
        inverse = np.linalg.pinv(whole, rcond=1e-12, hermitian=True)
        shift = np.abs(inverse @ (LEVEL_ERROR * pulled / size)) / size
        return float(np.max(shift / np.maximum(errors[moved], 1e-300)))

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
        share = shares(whole, whole - left)[0]
        most = MOST_NOISE if self.instruments is None else MOST_MET
        return float(min(max(share.max(), SURE_STEP), most))


__all__ = ["unbiased"]
