"""A variant fitted with its shapes free, on the weighting that all variants share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from casadi_models.term import Term
from identification.balance.balances import balances_of
from identification.balance.calibration import nuisances, settled
from identification.balance.dataset import Dataset, visible_labels, without
from identification.balance.stacked import (
    passed_on,
    references,
    rms,
    row_weights,
    stack,
    taking_part,
)
from identification.diagnosis.trials import Base, make_base
from identification.fitting.engine import Solution, stepped
from identification.variants.lattice import price_of

FloatArray = npt.NDArray[np.float64]

STEPS: Final = 8
"""Gauss-Newton steps of a variant from its place on the grid at most; they bring its error to
within 1 % of a converged fit (`python -m benchmarks.explore`)."""
LEAST_DELAY: Final = 1.0
"""Samples up to which a late channel is no effect: a logger reads its channels, and holds its
commands, somewhere within a sample."""


@final
@dataclass(frozen=True)
class Weighting:
    """What makes variants comparable: the weights of one fit, on training and held-out rows.

    Attributes
    ----------
    like : Solution
    held : mapping of str to (rows,) array
    passed : mapping of str to (rows,) array
        What this fit passes on of noise of the measured torques (:func:`passed_on`), training and
        then held-out rows.
    """

    like: Solution
    held: Mapping[str, FloatArray]
    passed: Mapping[str, FloatArray]

    @classmethod
    def of(cls, like: Solution, data: Dataset) -> Weighting:
        """The weighting of a fit."""
        balances = balances_of(like.model, data.sensing, wrt=())
        values = settled(like.model, data.sensing, data.held_out, like.values)
        return cls(
            like,
            row_weights(balances, data, values, like.sigma, data.held_out),
            passed_on(like.model, data, like.values),
        )

    def units(self, solution: Solution, data: Dataset) -> dict[str, FloatArray]:
        """Length that the residual of each row has under a variant where it is 1 under this fit,
        training and then held-out rows, (rows,) each.

        A law that takes a share of a measured torque scales the whole balance, noise and errors of
        the model with it: what is left is shorter and no smaller.
        """
        own = passed_on(solution.model, data, solution.values)
        return {
            b: np.where((x > 0) & (own[b] > 0), own[b], 1.0)
            / np.where((x > 0) & (own[b] > 0), x, 1.0)
            for b, x in self.passed.items()
        }


@final
@dataclass(frozen=True)
class Held:
    """Errors on the held-out records.

    Attributes
    ----------
    squares, rows : (blocks, balances) arrays
        Weighted squares of each block in the variant's units (:meth:`Weighting.units`), and how
        many rows it has.
    rms : (balances,) array
        In the units of the weights and the variant.
    relative_error_percent : float
        100 norm(residual) / norm(measured).
    """

    squares: FloatArray
    rows: FloatArray
    rms: FloatArray
    relative_error_percent: float


@final
@dataclass(frozen=True)
class Refit:
    """A fitted variant and its errors.

    Attributes
    ----------
    solution : Solution
    cost : float
        Weighted sum of squares of the training rows.
    squares, rows : (blocks, balances) arrays
        Squares of each block that the fit did not see, and how many rows it has: of the training
        records by cross-validation, then those of the held-out records.
    held : Held
    """

    solution: Solution
    cost: float
    squares: FloatArray
    rows: FloatArray
    held: Held

    @property
    def parameters(self) -> int:
        """Free parameters, without nuisances."""
        model = self.solution.model
        aside = nuisances(model)
        return sum(n not in aside for n in self.solution.free)

    @property
    def price(self) -> float:
        """What its effects must bring (:func:`identification.variants.lattice.price_of`)."""
        return price_of(len(visible_labels(self.solution.model)), self.parameters)


def refitted(
    model: JointModel,
    data: Dataset,
    starts: tuple[Mapping[str, float], ...],
    weighting: Weighting,
    *,
    steps: int = STEPS,
) -> Refit:
    """A variant from the best of some starts: shapes near zero velocity have several valleys."""
    found = min(
        (stepped(model, data, s, weighting.like, iterations=steps) for s in starts),
        key=lambda f: f[1],
    )
    return refit_of(*found, data, weighting, lambda fitted: make_base(fitted, data))


def refit_of(
    solution: Solution,
    cost: float,
    data: Dataset,
    weighting: Weighting,
    base_of: Callable[[Solution], Base],
) -> Refit:
    """A fitted variant with the errors by which it is held against others.

    Parameters
    ----------
    solution : Solution
    cost : float
        Weighted sum of squares of the training rows.
    data : Dataset
        The records as the fit has them.
    weighting : Weighting
    base_of : callable
        Rows of a fit, with all that a fold must find anew.
    """
    units = weighting.units(solution, data)
    own = {b: w / units[b][: len(w)] for b, w in solution.weights.items()}
    base = base_of(replace(solution, weights=own))
    seen = held_of(solution, data, weighting)
    return Refit(
        solution,
        cost,
        np.vstack([_padded(base.crossed, data.blocks), seen.squares]),
        np.vstack([_padded(base.numbers, data.blocks), seen.rows]),
        seen,
    )


def _padded(found: npt.NDArray[Any], blocks: int) -> FloatArray:
    """With a row of zeros for each of the last blocks in which no row takes part."""
    return np.vstack([found, np.zeros((blocks - len(found), found.shape[1]))])


def held_of(solution: Solution, data: Dataset, weighting: Weighting) -> Held:
    """Errors of a model with its values on the held-out records."""
    model = solution.model
    balances = balances_of(model, data.sensing, wrt=())
    values = settled(model, data.sensing, [*data.train, *data.held_out], solution.values)
    residual = stack(balances, data.held_out, values).residual
    taking = {b: taking_part(b, data.held_out) for b in balances.balances}
    measured = references(data, data.held_out)
    left = np.concatenate([residual[b][taking[b]] for b in balances.balances])
    size = np.concatenate([measured[b][taking[b]] for b in balances.balances])
    units = weighting.units(solution, data)
    weighted = {
        b: r * weighting.held[b] / units[b][len(units[b]) - len(r) :] for b, r in residual.items()
    }
    squares, rows = _by_block(data, weighted)
    return Held(
        squares,
        rows,
        np.array([rms(weighted[b][taking[b]]) for b in balances.balances]),
        100 * float(np.linalg.norm(left)) / (float(np.linalg.norm(size)) or 1e-300),
    )


def _by_block(data: Dataset, weighted: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Weighted squares of each held-out block and balance, and how many rows it has."""
    number = np.concatenate([w.block for w in data.held_out])
    inside = number >= 0
    which, place = np.unique(number[inside], return_inverse=True)
    squares, rows = [], []
    for b, r in weighted.items():
        taking = taking_part(b, data.held_out)[inside].astype(np.float64)
        squares.append(np.bincount(place, taking * r[inside] ** 2, len(which)))
        rows.append(np.bincount(place, taking, len(which)))
    return np.array(squares, dtype=np.float64).T, np.array(rows, dtype=np.float64).T


def blocks_of(data: Dataset) -> tuple[npt.NDArray[np.int64], ...]:
    """The blocks of each record, training and held-out, as :class:`Refit` counts them."""
    first = data.blocks
    held = np.unique(np.concatenate([w.block[w.block >= 0] for w in data.held_out]))
    out = [np.unique(w.block[w.block >= 0]) for w in data.train]
    out += [first + np.searchsorted(held, np.unique(w.block[w.block >= 0])) for w in data.held_out]
    return tuple(out)


def with_size(solution: Solution, added: tuple[str, ...]) -> JointModel:
    """The model of a fit without those of the added parts that came out with no size."""
    model = solution.model
    for term in solution.model.terms:
        if term.label in added and not any(_sizes(term, solution.values)):
            model = without(model, term.label)
    return model


def _sizes(term: Term, values: Mapping[str, float]) -> list[float]:
    """Sizes of the amplitudes of a part."""
    pairs = zip(term.names, term.effect.parameters, strict=True)
    return [abs(values[n]) for n, p in pairs if not p.is_shape]


def physical(refit: Refit, added: tuple[str, ...], data: Dataset) -> str:
    """Why a part that was added to a variant is none; empty where every part is one."""
    values = refit.solution.values
    for term in refit.solution.model.terms:
        if term.label not in added:
            continue
        sizes = _sizes(term, values)
        if not any(sizes):
            return f"{term.label} has the size 0"
        if term.effect.is_delay and max(sizes) <= LEAST_DELAY * data.train[0].grid.dt:
            return f"{term.label} is shorter than a sample"
    return ""
