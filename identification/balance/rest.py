"""The rows at rest as a check of a fitted model: dry friction may hold any torque up to its
limit, and no more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.balance.balances import balances_of
from identification.balance.calibration import settled, values_on
from identification.balance.dataset import Dataset
from identification.balance.stacked import floor_rows, rms, sticking_torque
from identification.balance.weak import RESTING_SIDES, WeakRecord

FloatArray = npt.NDArray[np.float64]

REACH: Final = 2.0
"""Dead zone in Coulomb torques: the model has its friction at full strength on one side of
zero, the joint may hold it on the other.
"""
FEWEST: Final = 20
"""Rows at rest from which a balance is judged: five kernels."""
BEYOND: Final = 2.0
"""Noise levels by which rows at rest must leave the dead zone to be worth a word: inside it
noise leaves nothing.
"""


@final
@dataclass(frozen=True)
class RestCheck:
    """What the rows at rest of one balance leave beyond sticking friction.

    Attributes
    ----------
    rows : int
    excess : float
        RMS of the residual minus its clip to the dead zone [N.m or N].
    floor : float
        What measurement noise alone would leave in these rows.
    """

    rows: int
    excess: float
    floor: float

    @property
    def holds(self) -> bool:
        """Whether sticking friction explains the rest."""
        return self.rows < FEWEST or self.excess <= BEYOND * self.floor


def rest_check(
    model: JointModel, data: Dataset, records: Sequence[WeakRecord], values: Mapping[str, float]
) -> dict[str, RestCheck]:
    """Rows at rest of every balance against the inequality that dry friction is there.

    Parameters
    ----------
    model : JointModel
    data : Dataset
    records : sequence of WeakRecord
        Of the dataset.
    values : mapping of str to float
        Fitted parameters.

    Returns
    -------
    dict
        By balance; those without friction against the ground are not in it.
    """
    balances = balances_of(model, data.sensing, wrt=())
    floor = floor_rows(model, data, values, records)
    values = settled(model, data.sensing, records, values)
    parts = [balances.evaluate(w, values_on(model, w, values)) for w in records]
    out = {}
    for balance in balances.balances:
        if balance not in RESTING_SIDES:
            continue
        zone = np.concatenate([_zone(model, values, w, balance) for w in records])
        still = np.concatenate([w.resting(balance) & (balance not in w.masked) for w in records])
        residual = np.concatenate([p[balance][0] for p in parts])
        beyond = residual - np.clip(residual, -zone, zone)
        out[balance] = RestCheck(int(still.sum()), rms(beyond[still]), rms(floor[balance][still]))
    return out


def _zone(
    model: JointModel, values: Mapping[str, float], w: WeakRecord, balance: str
) -> FloatArray:
    """Half width of the dead zone of each row."""
    zone = np.zeros(w.rows)
    for side in RESTING_SIDES[balance]:
        if side in w.rest:
            zone += REACH * sticking_torque(model, values, side) * w.rest[side]
    return zone


def rest_warnings(checks: Mapping[str, RestCheck], unit: str) -> tuple[str, ...]:
    """What does not hold at rest, a sentence a balance."""
    return tuple(
        f"at rest the {balance} balance leaves {c.excess:.3g} {unit} beyond what sticking "
        f"friction can hold (noise {c.floor:.2g}): "
        "gravity, an offset or the friction itself is not right there"
        for balance, c in checks.items()
        if not c.holds
    )
