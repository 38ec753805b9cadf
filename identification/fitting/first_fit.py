"""The fit of a joint's own model, made once for the verbs that follow each other on its records."""

from __future__ import annotations

import threading
import weakref
from collections import deque
from collections.abc import Mapping
from typing import Final

import numpy as np

from casadi_models import JointModel
from identification.balance.balances import balances_of
from identification.balance.dataset import Dataset
from identification.balance.memory import Law
from identification.balance.stacked import stack
from identification.balance.weak import WeakRecord
from identification.errors import InputError
from identification.fitting.engine import Solution, posed, solve

KEPT: Final = 8
"""Fits that a thread keeps."""

_kept = threading.local()


def first_fit(model: JointModel, data: Dataset) -> Solution:
    """:func:`identification.fitting.engine.solve` from the model's own values; the one that was
    made on these very rows before, where there is one.

    Parameters
    ----------
    model : JointModel
    data : Dataset
        Its training rows, and what is known of the joint.

    Raises
    ------
    InputError
        A free parameter that moves no output; a law that gives no number somewhere on the records.
    """
    fits: deque[tuple[Law, tuple[weakref.ref[WeakRecord], ...], Solution]] = (
        _kept.__dict__.setdefault("fits", deque(maxlen=KEPT))
    )
    known = (data.joint.known, data.noise, data.ranges, model.values)
    law = Law(model.structure, data.sensing, *(tuple(sorted(k.items())) for k in known))
    for made, rows, solution in fits:
        same = len(rows) == len(data.train) and all(
            r() is w for r, w in zip(rows, data.train, strict=True)
        )
        if same and made == law:
            return solution
    _check_numbers(model, data, posed(model, data, {}, frozenset())[0])
    found = solve(model, data)
    _check_numbers(found.model, data, found.values)
    fits.append((law, tuple(weakref.ref(w) for w in data.train), found))
    return found


def _check_numbers(model: JointModel, data: Dataset, values: Mapping[str, float]) -> None:
    """Refuse a model that has no error on the records: a law takes the root, logarithm or power of
    what it is not defined for, or runs out of what can be computed.
    """
    residuals = balances_of(model, data.sensing, wrt=())
    for record in (*data.train, *data.held_out):
        if all(np.isfinite(r).all() for r in stack(residuals, [record], values).residual.values()):
            continue
        balances = balances_of(model, data.sensing, wrt=model.parameter_names)
        rows = stack(balances, [record], values)
        endless = np.any([~np.isfinite(j).all(axis=0) for j in rows.jacobian.values()], axis=0)
        names = {n for n, bad in zip(balances.wrt, endless, strict=True) if bad}
        laws = sorted({t.effect.key for t in model.terms if names & set(t.names)})
        raise InputError(
            f"{data.joint.source or data.joint.name}: {', '.join(laws) or 'a law of the model'} "
            "gives no number somewhere along a record; write the law so that it is defined for "
            "both signs of position, velocity and torque, or correct the values in the joint file"
        )


__all__ = ["first_fit"]
