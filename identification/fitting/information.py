"""What rows of the balances say about parameters: normal matrices with the zeros of sensors
eliminated."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import balances_of
from identification.balance.calibration import bare, names_of_runs, settled
from identification.balance.dataset import Dataset
from identification.balance.weak import INDEPENDENT_SHARE
from identification.fitting.covariance import RANK, inverse
from identification.fitting.engine import Solution
from identification.fitting.errors_in_variables.products import known, level_error, noise_products
from identification.fitting.weak_form import WeakForm

FloatArray = npt.NDArray[np.float64]


def form_of(
    solution: Solution,
    data: Dataset,
    free: Sequence[str],
    weights: Mapping[str, FloatArray],
    moved: Mapping[str, float] | None = None,
) -> WeakForm:
    """The rows of a fitted model on records, the unknowns of their sensors behind its own.

    Parameters
    ----------
    solution : Solution
    data : Dataset
        `train` are the records.
    free : sequence of str
        Parameters of the model that move.
    weights : mapping of str to (rows,) array
    moved : mapping of str to float, optional
        Values that differ from the fitted ones; unknowns of sensors that are not among them are
        fitted on their record.
    """
    model = solution.model
    names = (*free, *names_of_runs(model, data.train))
    values = settled(model, data.sensing, data.train, {**solution.values, **(moved or {})})
    return WeakForm(balances_of(model, data.sensing, wrt=bare(names)), data, values, names, weights)


def eliminated(gram: FloatArray, count: int) -> FloatArray:
    """Normal matrix of the first `count` unknowns, whatever the others do."""
    own, across = gram[count:, count:], gram[:count, count:]
    if not own.size:
        return gram
    inside = across @ np.linalg.pinv(own, rcond=RANK, hermitian=True) @ across.T
    return np.asarray(gram[:count, :count] - inside)


RESTS: Final = 0.1
"""Share of a parameter's variance that comes from the rows of a balance from which on its value
rests on them: what a law that the model lacks leaves in these rows moves the value. Shares are
nearly all over 0.5 or under 0.02."""


def resting(solution: Solution, data: Dataset) -> dict[str, tuple[str, ...]]:
    """Free parameters whose values rest on each balance.

    Parameters
    ----------
    solution : Solution
    data : Dataset
        The records of the fit.
    """
    moving = tuple(n for n in solution.free if n not in solution.at_bound)
    if not moving:
        return {}
    form = form_of(solution, data, moving, solution.weights)
    stacked = form.stacked(np.array([form.values[n] for n in form.free]))
    rows = {b: j * solution.weights[b][:, None] for b, j in stacked.jacobian.items()}
    inside = np.array([x.T @ x for x in rows.values()])
    back = inverse(inside.sum(axis=0))
    variance = np.einsum("ij,bjk,ki->bi", back, inside, back)
    share = variance / np.maximum(variance.sum(axis=0), 1e-300)
    return {
        b: tuple(n for k, n in enumerate(moving) if own[k] > RESTS)
        for b, own in zip(rows, share, strict=True)
    }


def information(form: WeakForm, count: int, *, measured: bool = False) -> FloatArray:
    """Normal matrix of the first `count` unknowns of weighted rows at their values.

    Parameters
    ----------
    form : WeakForm
    count : int
    measured : bool
        Whether the rows were measured: what noise adds to the products of their columns tells
        nothing.
    """
    j = form.jacobian(np.array([form.values[n] for n in form.free]))
    gram = j.T @ j
    if measured:
        size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        unit = np.outer(size, size)
        noise = noise_products(form).whole[0] / unit
        gram = unit * known(gram / unit, noise, level_error(form.data))
    return eliminated(gram, count)


def white_errors(gram: FloatArray) -> FloatArray:
    """Standard errors if only the overlap of the kernels tied the rows together; infinite in
    directions of which the rows say nothing.

    Parameters
    ----------
    gram : (p, p) array
        Normal matrix of rows in units of their scatter.
    """
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    value, vector = np.linalg.eigh(gram / np.outer(size, size))
    weak = value <= RANK * max(float(value[-1]), 1e-300)
    variance = (vector[:, ~weak] ** 2 / value[~weak]).sum(axis=1)
    hidden = (vector[:, weak] ** 2).sum(axis=1) > math.sqrt(RANK)
    return np.where(hidden, math.inf, np.sqrt(variance / INDEPENDENT_SHARE) / size)
