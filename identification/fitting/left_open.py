"""What a fit leaves open: how far its parameters may be off, and what that may do on other records.

A motion at one speed tells the sum of viscous and Coulomb friction well and each of the two badly.
On a record at other speeds the right model then stands far over the noise, and nothing is missing.
With noise of unit variance in the rows, and the parameters known as the training rows tell them,
the squared length of a residual r in its covariance I + J P J' is the least of
|r + J d|^2 + |T d|^2 over the steps d of the parameters, T the Jacobian of the training rows,
T'T = P^-1 (Kalman's update of a value by what comes later; the innovations of Mehra 1970). Both are
followed as far as the step goes: the valley that the training rows leave is bent where a gap trades
with the zeros of the encoders. Steps stay inside the bounds of the parameters.

Zeros and clocks of the other records are their own and were fitted to them at the values of the
fit; they move along: a gap that no training row crosses is open by as much as the zero of an
encoder that its flank stands for. What the other balances of these records lose by it is paid.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import balances_of
from identification.balance.calibration import bare, limits_of_runs, names_of_runs
from identification.balance.dataset import Dataset
from identification.balance.stacked import floor_rows, row_weights, stack, taking_part
from identification.balance.weak import WeakRecord
from identification.fitting.engine import Solution
from identification.fitting.errors_in_variables.products import level_error, noise_products, told
from identification.fitting.least_squares import least_squares, triangle_of
from identification.fitting.start_values import bounds_of
from identification.fitting.weak_form import ENOUGH, WeakForm

FloatArray = npt.NDArray[np.float64]

LEADING: Final = 0.5
"""Share of the largest change of the residual from which a parameter is named among those open."""
FAR: Final = 6.0
"""Deviations of the noise that a balance stands at, beside unknowns that may be anything, from
which no step is looked for: it would have to come four times nearer, to what counts as noise, by
what bends along it alone.
"""
MOST_TOLD_BY_NOISE: Final = 0.5
"""Share of what the rows tell of a step from which on its floor is not that of the fit."""
ITERATIONS: Final = 15
"""Steps at most: as many as a fit takes in a pass."""


@final
@dataclass(frozen=True)
class Step:
    """Where the parameters may be, as one balance of other records asks for it.

    Attributes
    ----------
    moved : (rows,) array
        What it adds to the residual.
    price : float
        By how many variances the training rows fall behind.
    names : tuple of str
        The parameters that do most of it.
    values : mapping of str to float
        Of the other records, there.
    """

    moved: FloatArray
    price: float
    names: tuple[str, ...]
    values: Mapping[str, float]


@final
@dataclass(frozen=True, eq=False)
class LeftOpen:
    """What the training rows say of the parameters, and no more.

    Attributes
    ----------
    names : tuple of str
        The free parameters of the fit, which other records share.
    asked : frozenset of str
        Balances that are asked for a step.
    here : WeakForm
        The training rows over zeros and clocks of their runs, and over `names`: each of unit
        variance by noise alone, whatever the model leaves of them.
    limits : mapping of str to (low, high)
        Of `names`.
    told : (unknowns, unknowns) array
        What a step of the unknowns of `here` is multiplied by, so that the rows fall behind by as
        much as they tell of it without noise: an acceleration that is all noise tells no inertia.
    elsewhere : mapping of str to float
        Values of another place in that valley, where steps are looked for, too; those of the runs
        as well.
    """

    names: tuple[str, ...]
    asked: frozenset[str]
    here: WeakForm
    limits: Mapping[str, tuple[float, float]]
    told: FloatArray
    elsewhere: Mapping[str, float] = field(default_factory=dict)

    @property
    def clear_of_noise(self) -> bool:
        """Whether the training rows tell most of every step: where noise does, a step may let more
        of it pass, and the floor is another one there.
        """
        kept = np.linalg.eigvals(self.told).real  # roots of what is told without noise
        return bool(np.all(kept > math.sqrt(1 - MOST_TOLD_BY_NOISE)))

    @classmethod
    def of(
        cls,
        solution: Solution,
        data: Dataset,
        values: Mapping[str, float],
        asked: frozenset[str],
    ) -> LeftOpen:
        """Of a fit, `values` those of it and of the runs."""
        model, sensing = solution.model, data.sensing
        names = solution.free  # what stands at a bound may leave it on one side
        floor = floor_rows(model, data, values, data.train)
        weights = row_weights(
            balances_of(model, sensing, wrt=()),
            data,
            values,
            {b: np.maximum(x, 1e-12) for b, x in floor.items()},
            data.train,
        )
        every = (*names_of_runs(model, data.train), *names)
        balances = balances_of(model, sensing, wrt=bare(every))
        limits = bounds_of(model, data.joint.known, data)
        here = WeakForm(balances, data, values, every, weights)
        return cls(names, asked, here, limits, _told(here))

    def steps(
        self,
        data: Dataset,
        records: Sequence[WeakRecord],
        values: Mapping[str, float],
        weights: Mapping[str, FloatArray],
    ) -> dict[str, Step]:
        """What each balance that is asked wants on other records.

        Parameters
        ----------
        data : Dataset
        records : sequence of WeakRecord
        values : mapping of str to float
        weights : mapping of str to (rows,) array
            1/deviation of each row by noise.
        """
        model = self.here.balances.model
        runs = names_of_runs(model, records)
        every = (*runs, *self.names)
        balances = balances_of(model, data.sensing, wrt=bare(every))
        there = WeakForm(balances, replace(data, train=tuple(records)), values, every, weights)
        limits = {
            **limits_of_runs(model, [*self.here.data.train, *records]),
            **{n: self.limits[n] for n in self.names},
        }
        begun = there.stacked(np.array([there.values[n] for n in every])).jacobian
        out = {}
        for b in (b for b in weights if b in self.asked):
            others = [begun[o][:, : len(runs)] * w[:, None] for o, w in weights.items() if o != b]
            own = triangle_of(np.concatenate(others)) if others else np.zeros((0, len(runs)))
            problem = _Beside(self.here, there, b, own, told=self.told, begun=begun[b])
            names = problem.names
            start = problem.start
            clear = not balances.has_gap and self.clear_of_noise
            within = [limits[n][0] for n in names], [limits[n][1] for n in names]
            starts = [start]
            if self.elsewhere:
                starts.append(np.clip([self.elsewhere[n] for n in names], *within))
            # the others stay too far, however free the unknowns were
            starts = [x for x in starts if not clear or problem.at_least(x) <= FAR**2]
            if not starts:
                continue
            found = min(
                (
                    least_squares(
                        problem,
                        begin,
                        within,
                        logarithmic=problem.logarithmic,
                        iterations=ITERATIONS,
                        tolerance=ENOUGH,
                    ).x
                    for begin in starts
                ),
                key=problem.size,
            )
            moved = problem.columns(found)[:, : len(every)] * (found - start)[: len(every)]
            each = np.linalg.norm(moved[:, len(runs) :], axis=0)
            leading = each > LEADING * each.max(initial=0.0)
            out[b] = Step(
                problem.left(found) - problem.left(start),
                float(np.sum(problem.lost(found) ** 2)),
                tuple(n for n, x in zip(self.names, leading, strict=True) if x),
                there.at(found[: len(every)]),
            )
        return out


def _told(here: WeakForm) -> FloatArray:
    """What the training rows tell of a step of their unknowns, less the noise: of those that enter
    the rows on a straight line.
    """
    out = np.eye(len(here.free))
    # noise about where a load turns adds no products of a straight line
    straight = np.flatnonzero(~here.bent & ~here.clocks)
    if here.balances.has_gap or not len(straight):
        return out
    columns = here.jacobian(np.array([here.values[n] for n in here.free]))[:, straight]
    size = np.linalg.norm(columns, axis=0)
    seen, straight = size > 0, straight[size > 0]
    unit = np.outer(size[seen], size[seen])
    noise = noise_products(here).whole[0][np.ix_(straight, straight)]
    gram = columns[:, seen].T @ columns[:, seen]
    kept = told(gram / unit, noise / unit, level_error(here.data))
    out[np.ix_(straight, straight)] = kept / np.outer(size[seen], 1 / size[seen])
    return out


@final
@dataclass(frozen=True, eq=False)
class _Beside:
    """Rows of one balance of other records, and what is lost elsewhere by the step: that of their
    runs in their other balances, that of the rest in the training rows; a
    :class:`identification.fitting.least_squares.Problem`.

    Attributes
    ----------
    here, there : WeakForm
        Training rows, and those of the other records.
    balance : str
    own : (rows, runs) array
        What the other balances of the other records lose.
    told : (unknowns, unknowns) array
        As :class:`LeftOpen` has it.
    begun : (rows, unknowns) array
        Derivative of the rows of the balance at the values of the fit.
    """

    here: WeakForm
    there: WeakForm
    balance: str
    own: FloatArray
    told: FloatArray
    begun: FloatArray

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the other runs, of all records, of the training runs."""
        return (*self.there.free, *(n for n in self.here.free if n not in self.there.free))

    @cached_property
    def start(self) -> FloatArray:
        """Values of the fit, (unknowns,)."""
        return np.array([{**self.here.values, **self.there.values}[n] for n in self.names])

    @cached_property
    def logarithmic(self) -> npt.NDArray[np.bool_]:
        """Scales, which move by factors, (unknowns,)."""
        scales = {n for f in (self.here, self.there) for n, x in zip(f.free, f.logarithmic) if x}
        return np.array([n in scales for n in self.names])

    @cached_property
    def _taken(self) -> list[int]:
        """Places of the unknowns of the training rows."""
        return [self.names.index(n) for n in self.here.free]

    @cached_property
    def _before(self) -> FloatArray:
        return self.here.residual(self.start[self._taken])

    def left(self, x: FloatArray) -> FloatArray:
        """Residual of the balance, (rows,)."""
        values = self.there.at(x[: len(self.there.free)])
        bare_ = balances_of(self.there.balances.model, self.there.data.sensing, wrt=())
        return np.asarray(stack(bare_, self.there.data.train, values).residual[self.balance])

    def at_least(self, x: FloatArray) -> float:
        """Mean square of the weighted residual beside unknowns that cost nothing."""
        b = self.balance
        rows = self.left(x) * self.there.weights[b]
        own = self.columns(x)[:, : len(self.there.free)]
        size = np.linalg.norm(own, axis=0)
        unit = own[:, size > 0] / size[size > 0]
        rest = triangle_of(np.column_stack([unit, rows]))[-1, -1]
        count = int(np.count_nonzero(taking_part(b, self.there.data.train)))
        return float(rest**2) / max(count, 1)

    def columns(self, x: FloatArray) -> FloatArray:
        """Its weighted derivative, (rows, unknowns)."""
        own = slice(len(self.there.free))
        if np.array_equal(x[own], self.start[own]):
            found = self.begun
        else:
            found = self.there.stacked(x[own]).jacobian[self.balance]
        out = np.zeros((len(found), len(self.names)))
        out[:, : found.shape[1]] = found * np.atleast_1d(self.there.weights[self.balance])[:, None]
        return out

    def lost(self, x: FloatArray) -> FloatArray:
        """What is lost elsewhere, (rows,)."""
        step = (x - self.start)[: self.own.shape[1]]
        return np.concatenate([self.own @ step, self.here.residual(self._there(x)) - self._before])

    def _there(self, x: FloatArray) -> FloatArray:
        """Where the training rows are asked, (unknowns of these,)."""
        start = self.start[self._taken]
        return np.asarray(start + self.told @ (x[self._taken] - start))

    def residual(self, x: FloatArray) -> FloatArray:
        """Weighted rows, and what is lost elsewhere."""
        return np.concatenate([self.left(x) * self.there.weights[self.balance], self.lost(x)])

    def size(self, x: FloatArray) -> float:
        """Norm of these."""
        return float(np.linalg.norm(self.residual(x)))

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Their derivative."""
        own = np.zeros((len(self.own), len(self.names)))
        own[:, : self.own.shape[1]] = self.own
        rows = self.here.jacobian(self._there(x)) @ self.told
        lost = np.zeros((len(rows), len(self.names)))
        lost[:, self._taken] = rows
        return np.concatenate([self.columns(x), own, lost])


__all__ = ["LeftOpen", "Step"]
