"""Internal states of memory laws, kept for the records and parameter values that asked last."""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

MOST: Final = 4_000_000
"""Values that a thread keeps (32 MB)."""

_kept = threading.local()


def states_of(record: Any, law: Hashable, make: Callable[[], FloatArray]) -> FloatArray:
    """States along a record, from memory where the same law with the same values was followed there
    before.

    One fit or assessment follows a memory law along every record several times: for the residual,
    its Jacobian, the weights and the noise floor. Amplitudes and friction change between them, the
    law's own values often do not.

    Parameters
    ----------
    record : object
        The record; held weakly, known by identity.
    law : hashable
        What the states depend on beside the record: structure of the model, values of its
        parameters.
    make : callable
        Gives the states, (states, points).

    Returns
    -------
    (states, points) array, read-only
    """
    cache: OrderedDict[Hashable, tuple[weakref.ref[Any], FloatArray]] = _kept.__dict__.setdefault(
        "states", OrderedDict()
    )
    key = (id(record), law)
    found = cache.get(key)
    if found is not None and found[0]() is record:
        cache.move_to_end(key)
        return found[1]
    made = make()
    made.flags.writeable = False
    cache[key] = (weakref.ref(record), made)
    cache.move_to_end(key)
    total = sum(states.size for _, states in cache.values())
    while total > MOST and cache:
        total -= cache.popitem(last=False)[1][1].size
    return made


__all__ = ["states_of"]
