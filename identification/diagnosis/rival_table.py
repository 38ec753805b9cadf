"""A table over one variable as the rival of a claim: does the named law say more than "it
depends on this variable"?
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from identification.balance.dataset import without
from identification.diagnosis.candidates import Candidate, offered
from identification.diagnosis.claims import HELD_OUT_DROP, MAJOR_DROP, Claim
from identification.diagnosis.locate import BINS, Unexplained, axes, binned
from identification.diagnosis.trials import Base, Trial, make_base, span_of, try_candidate
from identification.fitting.engine import Dataset, Solution, solved_once, taking_part

FloatArray = npt.NDArray[np.float64]

FEWEST_IN_BIN: Final = 8


def is_absorbed(claim: Claim, left: Unexplained, solution: Solution, data: Dataset) -> bool:
    """True where a table over the variable that holds what is left does the work of the claim as
    well.

    Parameters
    ----------
    claim : Claim
        One that was added to the model.
    left : Unexplained
        What is left in the balance of the claim, located on an axis.
    solution : Solution
        With all claims.
    data : Dataset

    Returns
    -------
    bool
        False too where the claim cannot be taken out of the model alone.
    """
    model = without(solution.model, claim.label)
    if left.axis is None or model.terms == solution.model.terms:
        return False
    base = make_base(solved_once(model, data, solution.values), data)
    candidate = _again(claim, base)
    if candidate is None:
        return False
    trial = try_candidate(candidate, beside_table(base, left))
    if not isinstance(trial, Trial):
        return True
    held = trial.held_out_drop_percent
    return trial.cv_drop_percent < MAJOR_DROP or held < HELD_OUT_DROP


def _again(claim: Claim, base: Base) -> Candidate | None:
    candidates, _ = offered(base.solution.model, base.data, late=True)
    return next((c for c in candidates if c.label == claim.label), None)


def beside_table(base: Base, left: Unexplained) -> Base:
    """The base with a free value in every bin of the axis (and direction) as additional columns
    of the balance.
    """
    number = base.balances.index(left.balance)
    edges = np.empty(0)
    parts: list[FloatArray] = []
    for records, rows, weight in (
        (base.data.train, base.balance, base.weight),
        (base.data.held_out, base.held_balance, base.held_weight),
    ):
        if not records:
            parts.append(np.empty((0, 2 * BINS)))
            continue
        signals = axes(records, base.data.sensing.has_torque, base.data.joint.kind)
        values = signals[str(left.axis)][0]
        if not len(edges):
            edges, _ = binned(values, values)
        bins = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
        direction = (signals["motor_velocity"][0] > 0).astype(np.int64)
        table = np.zeros((len(rows), 2 * BINS))
        taking = taking_part(left.balance, records)
        table[np.flatnonzero(rows == number), 2 * bins + direction] = (
            weight[rows == number] * taking
        )
        parts.append(table)
    return _with_columns(base, *parts)


def _with_columns(base: Base, table: FloatArray, held: FloatArray) -> Base:
    sizes = np.linalg.norm(table, axis=0)
    use = np.count_nonzero(table, axis=0) >= FEWEST_IN_BIN
    jacobian = np.column_stack([base.jacobian, table[:, use] / sizes[use]])
    orthonormal = span_of(jacobian)
    return replace(
        base,
        jacobian=jacobian,
        orthonormal=orthonormal,
        residual=base.residual - orthonormal @ (orthonormal.T @ base.residual),
        held_jacobian=np.column_stack([base.held_jacobian, held[:, use] / sizes[use]]),
        noise=None,
    )
