"""How far a fitted model is from the measurements: errors per balance, ratio to the noise floor."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.balance.balances import Balances, balances_of
from identification.balance.calibration import settled
from identification.balance.kinematic import residual_unit
from identification.balance.stacked import (
    LEAST_DEVIATION,
    apart_from_drift,
    drift_memory,
    innovations,
    noise_believed,
    noise_rows,
    together,
)
from identification.balance.weak import WeakRecord
from identification.fitting.engine import (
    Dataset,
    references,
    rms,
    row_weights,
    stack,
    taking_part,
)
from identification.fitting.left_open import LeftOpen, Step
from identification.fitting.turns import Turns, turns_of

FloatArray = npt.NDArray[np.float64]

VERDICT_KERNELS: Final = {
    "motor": 0.03,
    "link": 0.12,
    "transmission": 0.06,
    "sum": 0.06,
    "deflection": 0.06,
    "axis": 0.2,
    "kinematic": 0.06,
}
"""Kernel at which a balance is compared with its floor: where records without a hidden effect
read 1 [s].
"""


def verdict_kernel(balance: str, data: Dataset) -> float:
    """Length of the rows in which a balance of a fit's records is compared with its floor [s]: none
    shorter than those of the fit where noise asked for longer ones.
    """
    usual = VERDICT_KERNELS[balance]
    return max(usual, data.kernel) if data.lengthened else usual


SAME_FLOOR: Final = 0.05
"""Change of a noise floor by which a step of the parameters is no other one: its length follows the
floor, and a ratio is told to no more than that."""
RATIO_LIMIT: Final = 1.5
"""Residual over noise floor above which structure is left; joints without a hidden effect read
0.9 to 1.4, dirty sensors included.
"""

WALK: Final = 2.77
"""What the mean square of a random walk about its mean exceeds its expectation by in one course of
twenty: the law of Cramer and von Mises."""


@final
@dataclass(frozen=True)
class BalanceError:
    """Error of one balance.

    Attributes
    ----------
    rms : float
        Weighted by what noise allows in each row: rows at a reversal or at standstill count less.
    floor : float
        What measurement noise alone would leave.
    ratio : float
        RMS of residual over noise, row by row: 1 where only noise is left. Where a measured torque
        drifts, of what the drift does not foretell; and no less than what is left over the most
        that one course of it may do. The instants of turns are unknowns of it, so it may be
        smaller than `rms` over `floor`.
    unit : str
    residual, weight : (rows,) array
        Residual of each row [unit] and 1 over the scatter that noise allows it: two models are
        compared on one common weighting.
    left_open : tuple of str
        Parameters whose errors the ratio stands beside: what they may be is counted as noise.
    believed : float
        Share of the noise that the model passes on which what it leaves of the training records
        allows; the floor is lowered by it.
    drifting : float
        Share of the noise's squares that are a drift of a measured torque: of one course of it.
    """

    rms: float
    floor: float
    ratio: float
    unit: str
    residual: FloatArray = field(default_factory=lambda: np.empty(0), repr=False, compare=False)
    weight: FloatArray = field(default_factory=lambda: np.empty(0), repr=False, compare=False)
    left_open: tuple[str, ...] = field(default=(), repr=False, compare=False)
    believed: float = field(default=1.0, repr=False, compare=False)
    drifting: float = field(default=0.0, repr=False, compare=False)

    def as_json(self) -> dict[str, Any]:
        """The shape of `improve --json`."""
        return {"rms": self.rms, "unit": self.unit, "floor": self.floor, "ratio": self.ratio}


@final
@dataclass(frozen=True)
class Error:
    """Error of a model on a set of records.

    Attributes
    ----------
    relative_error_percent : float
        100 norm(residual) / norm(measured) over the balanced torques.
    fit_percent : float
        100 (1 - norm(residual) / norm(measured - mean)).
    vaf_percent : float
        100 (1 - var(residual) / var(measured)).
    balances : mapping of str to BalanceError
    """

    relative_error_percent: float
    fit_percent: float
    vaf_percent: float
    balances: Mapping[str, BalanceError]

    def as_json(self) -> dict[str, Any]:
        """The shape of `improve --json`."""
        return {
            "relative_error_percent": self.relative_error_percent,
            "fit_percent": self.fit_percent,
            "vaf_percent": self.vaf_percent,
            "balances": {b: e.as_json() for b, e in self.balances.items()},
        }


def over_noise(error: Error, records: Sequence[WeakRecord]) -> dict[str, FloatArray]:
    """Residual of every row over the scatter that noise allows it, by balance; zero in rows that
    take no part.

    Parameters
    ----------
    error : Error
        Of these records, as :func:`assess` gives it.
    records : sequence of WeakRecord
    """
    out = {}
    for balance, e in error.balances.items():
        rows = taking_part(balance, records)
        out[balance] = np.zeros(len(rows))
        out[balance][rows] = e.residual * e.weight
    return out


def relative_error_percent(
    model: JointModel, data: Dataset, records: Sequence[WeakRecord], values: Mapping[str, float]
) -> float:
    """The relative error of `assess` alone, without noise floors: fast enough for a slider."""
    balances = balances_of(model, data.sensing, wrt=())
    values = settled(model, data.sensing, [*data.train, *records], values)
    whole, measured = stack(balances, records, values).residual, references(data, records)
    rows = {b: taking_part(b, records) for b in balances.balances}
    r = np.concatenate([whole[b][rows[b]] for b in balances.balances])
    y = np.concatenate([measured[b][rows[b]] for b in balances.balances])
    return 100 * float(np.linalg.norm(r)) / (float(np.linalg.norm(y)) or 1e-300)


def _powers(
    rows: Mapping[str, FloatArray],
    weights: Mapping[str, FloatArray],
    taking: Mapping[str, npt.NDArray[np.bool_]],
    turning: Callable[[Mapping[str, FloatArray]], Turns],
) -> dict[str, float]:
    """Mean square of weighted rows, (rows,) by balance, in a covariance that holds the unknown
    instants of the turns.
    """
    turns = turning(weights)
    flat = np.concatenate(list(rows.values()))
    power = flat * turns.without(flat)
    parts = np.split(power, np.cumsum([len(r) for r in rows.values()])[:-1])
    return {
        b: max(float(part.sum()), 0.0) / max(int(taking[b].sum()), 1)
        for (b, part) in zip(rows, parts, strict=True)
    }


def _weights(
    balances: Balances,
    data: Dataset,
    values: Mapping[str, float],
    floor: Mapping[str, FloatArray],
    records: Sequence[WeakRecord],
) -> dict[str, FloatArray]:
    least = {b: np.maximum(x, LEAST_DEVIATION) for b, x in floor.items()}
    return dict(row_weights(balances, data, values, least, records))


def assess(
    model: JointModel,
    data: Dataset,
    records: Sequence[WeakRecord],
    values: Mapping[str, float],
    left_open: LeftOpen | None = None,
) -> Error:
    """Error of a model with the given values on prepared records; the ratios beside what the fit
    leaves open, where that is given.
    """
    balances = balances_of(model, data.sensing, wrt=())
    values = settled(model, data.sensing, [*data.train, *records], values)
    whole = stack(balances, records, values).residual
    rows = {b: taking_part(b, records) for b in balances.balances}
    residual = {b: whole[b][rows[b]] for b in whole}
    measured = {b: y[rows[b]] for b, y in references(data, records).items()}
    believed = noise_believed(model, data, values)
    quick, drift = noise_rows(model, data, values, records)
    floor = together(quick, drift, records)
    wide = _weights(balances, data, values, floor, records)
    steps: dict[str, Step] = {}
    if left_open is not None:
        steps = left_open.steps(data, records, values, wide)
        # noise passes a parameter that is open, too: the floor is that of where the step leads
        other = set()
        for b, step in steps.items():
            there = noise_rows(model, data, step.values, records)
            quick[b], drift[b] = (part[b] for part in there)
            own = together(*there, records)
            before, after = (rms(x[rows[b]]) for x in (floor[b], own[b]))
            if abs(after - before) > SAME_FLOOR * before:
                other.add(b)
            floor[b], wide[b] = own[b], _weights(balances, data, step.values, own, records)[b]
        if other:
            again = replace(left_open, asked=frozenset(other))
            steps |= again.steps(data, records, values, wide)
    weights = {b: w[rows[b]] for b, w in wide.items()}
    beside = {b: whole[b] + steps[b].moved if b in steps else whole[b] for b in whole}
    turning = partial(turns_of, balances, records, values)
    prices = {b: steps[b].price / max(int(rows[b].sum()), 1) if b in steps else 0.0 for b in whole}
    over = {b: np.where(rows[b], beside[b] * wide[b], 0.0) for b in balances.balances}
    powers = _powers(over, wide, rows, turning)
    ratios = {b: math.sqrt(powers[b] + prices[b]) for b in whole}
    drifting = {b: min(rms(drift[b][rows[b]] * weights[b]) ** 2, 1.0) for b in whole}
    if memory := drift_memory(data):
        scatter = {b: apart_from_drift(1 / wide[b], drift[b], quick[b]) for b in whole}
        courses = {
            b: innovations(
                np.where(rows[b], beside[b], 0.0),
                np.where(rows[b], scatter[b], math.inf),
                drift[b],
                memory=memory,
                records=records,
            )
            for b in balances.balances
        }
        powers = _powers(courses, {b: 1 / x for b, x in scatter.items()}, rows, turning)
        for b, ratio in ratios.items():
            ratios[b] = max(
                math.sqrt(powers[b] + prices[b]),
                ratio / math.sqrt(1 + drifting[b] * (WALK - 1)),
            )
    floor = {b: f[rows[b]] for b, f in floor.items()}
    errors = {
        b: BalanceError(
            rms(residual[b] * weights[b]) / max(rms(weights[b]), 1e-300),
            rms(floor[b] * weights[b]) / max(rms(weights[b]), 1e-300),
            ratios[b] if np.any(floor[b] > 0) else math.inf,
            residual_unit(b, model.kind),
            residual=residual[b],
            weight=weights[b],
            left_open=steps[b].names if b in steps else (),
            believed=believed[b],
            drifting=drifting[b],
        )
        for b in balances.balances
    }
    r = np.concatenate([residual[b] for b in balances.balances])
    y = np.concatenate([measured[b] for b in balances.balances])
    centred = np.concatenate([measured[b] - measured[b].mean() for b in balances.balances])
    size = float(np.linalg.norm(y)) or 1e-300
    spread = float(np.linalg.norm(centred)) or 1e-300
    varying = np.concatenate([residual[b] - residual[b].mean() for b in balances.balances])
    return Error(
        100 * float(np.linalg.norm(r)) / size,
        100 * (1 - float(np.linalg.norm(r)) / spread),
        100 * (1 - float(varying @ varying) / spread**2),
        errors,
    )
