"""The fit of a joint's own model, made once for the verbs that follow each other on its records."""

from __future__ import annotations

import threading
import weakref
from collections import deque
from typing import Final

from casadi_models import JointModel
from identification.balance.dataset import Dataset
from identification.balance.memory import Law
from identification.balance.weak import WeakRecord
from identification.fitting.engine import Solution, solve

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
        A free parameter that moves no output.
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
    found = solve(model, data)
    fits.append((law, tuple(weakref.ref(w) for w in data.train), found))
    return found


__all__ = ["first_fit"]
