"""Records prepared for a fit, each channel at the time that the fit itself finds for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from casadi_models import JointModel
from identification.balance.calibration import names_of_runs, of_run, settled, within_limits
from identification.balance.clocks import LOW_PASSED, MOST_SKEW, NEAR, carrier, places_of
from identification.balance.dataset import Dataset, load_dataset
from identification.balance.sensing import Sensing
from identification.balance.weak import WeakRecord
from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.fitting.first_fit import first_fit

ROUNDS: Final = 4
"""Rounds in which clocks are set by the fit: of a lateness of `MOST_SKEW` samples the series in the
model misses a third, and of what is left a third again, down to :data:`NEAR`."""


def dataset_of(
    train: Sequence[Record],
    held_out: Sequence[Record],
    joint: Joint,
    model: JointModel,
    *,
    kernel: float | None = None,
    like: Sensing | None = None,
    values: Mapping[str, float] | None = None,
) -> Dataset:
    """:func:`load_dataset`, with channels shifted by as much as the fit says that they are late.

    Before a fit, a record tells how late a channel is by its rate beside free curves of the motion.
    That can be hidden by noise, or taken for something else; the balances together, and what the
    other records say of the joint, tell it better. But the model has a lateness as a series, which
    holds for a part of a sample: so what the fit finds is taken off, and it is asked again.

    Parameters
    ----------
    train, held_out : sequence of Record
    joint : Joint
    model : JointModel
    kernel, like
        See :func:`load_dataset`.
    values : mapping of str to float, optional
        Those of a fit that is judged; by default those of the model's first fit.

    Raises
    ------
    InputError
        As by :func:`load_dataset` and :func:`first_fit`.
    """
    data = load_dataset(train, held_out, joint, model, kernel=kernel, like=like)
    for _ in range(ROUNDS):
        known = first_fit(model, data).values if values is None else values
        records = (*data.train, *data.held_out)
        found = settled(model, data.sensing, records, known)
        if len(within_limits(model, records, found)) < len(names_of_runs(model, records)):
            # what is later than a clock may be is to be named: the other clocks make up for it
            break
        late = [_late(model, w, found) for w in records]
        if all(s == w.shifts for s, w in zip(late, records, strict=True)):
            break
        data = load_dataset(train, held_out, joint, model, kernel=kernel, like=like, late=late)
    return data


def _late(model: JointModel, record: WeakRecord, values: Mapping[str, float]) -> dict[str, float]:
    """Times [s] by which the channels of a record are to be shifted: what stands within `NEAR`
    stays. What is late through a low-pass is so by its rate, which no shift makes good.
    """
    out, dt = dict(record.shifts), record.grid.dt
    for place in places_of(model):
        name = carrier(model, place)
        if place in LOW_PASSED or name is None:
            continue
        run = of_run(name, record)
        late = float(np.clip(values.get(run, values[name]), -MOST_SKEW * dt, MOST_SKEW * dt))
        if abs(late - out.get(place, 0.0)) > NEAR * dt:
            out[place] = late
    return out


__all__ = ["dataset_of"]
