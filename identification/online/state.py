"""State of an online estimator as bytes and back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.online.state_bytes import pack, unpack

if TYPE_CHECKING:
    from identification.online.estimator import OnlineEstimator

FloatArray = npt.NDArray[np.float64]

_PLAIN: Final = (
    "_since",
    "_rows",
    "_strained",
    "_last_good",
    "fault",
    "score",
    "readings",
    "plant_alarm",
    "events",
)
_ARRAYS: Final = (
    "level",
    "theta",
    "sigma",
    "residual",
    "floor",
    "ratio",
    "_square",
    "_torque",
    "_scale",
)
"""What changes from sample to sample, besides samples, rows, watch, recursion, detector and
search.
"""
_PREFIX: Final = "two_step."
_GUARD: Final = "guard."


def state(of: OnlineEstimator) -> bytes:
    """See :meth:`identification.online.estimator.OnlineEstimator.state`."""
    plain = {name: getattr(of, name) for name in _PLAIN}
    arrays = {name: getattr(of, name) for name in _ARRAYS} | {"watch": of.watch.numbers()}
    plain["samples"], arrays["samples"] = of.samples.state()
    if of._collected:
        arrays |= {
            key: np.array([row[i] for row in of._collected])
            for i, key in enumerate(("y", "h", "shares"))
        }
    arrays.update({f"row{i}": values for i, values in enumerate(of.rows.numbers())})
    if of.two_step is not None:
        plain["two_step"], more = of.two_step.state()
        arrays |= {_PREFIX + name: values for name, values in more.items()}
    parts = {} if of.estimator is None else {"rls": of.estimator.state()}
    plain["guard"], more, kept = of.guard.state()
    arrays |= {_GUARD + name: values for name, values in more.items()} | {
        "pulse": np.array(of.pulse.numbers()),
        "grid": np.array(of.grid.numbers()),
    }
    parts |= kept
    if of.detector is not None:
        parts["detector"] = of.detector.state()
    return pack(plain, arrays, parts)


def restore(of: OnlineEstimator, saved: bytes) -> None:
    """See :meth:`identification.online.estimator.OnlineEstimator.restore`.

    Raises
    ------
    InputError
        The bytes are damaged, or of another joint, sample time or options.
    """
    plain, arrays, parts = unpack(saved)
    fits = (
        arrays["theta"].shape == of.theta.shape
        and arrays["samples"].shape == of.samples.state()[1].shape
    )
    if not fits or ("two_step" in plain) != (of.two_step is not None):
        raise InputError(
            "restore: the state is of another joint, sample time or options; give one of this "
            "estimator"
        )
    for name in (*_PLAIN, *_ARRAYS):
        setattr(of, name, plain[name] if name in plain else arrays[name])
    of.watch.load(arrays["watch"])
    of.samples.restore(plain["samples"], arrays["samples"])
    of._collected = (
        list(zip(arrays["y"], arrays["h"], arrays["shares"], strict=True)) if "y" in arrays else []
    )
    of.rows = of._plain_rows
    if of.two_step is not None:
        of.two_step.restore(plain["two_step"], _own(arrays, _PREFIX), of._factory())
        if of.two_step.active:
            of.rows = of.two_step.rows
    of.rows.load([arrays[f"row{i}"] for i in range(len(of.rows.numbers()))])
    of.estimator = of._recursion(of.theta) if "rls" in parts else None
    if of.estimator is not None:
        of.estimator.restore(parts["rls"])
    of.guard.restore(plain["guard"], _own(arrays, _GUARD), parts)
    of.pulse.load(arrays["pulse"].tolist())
    of.grid.load(arrays["grid"].tolist())
    if of.detector is not None and "detector" in parts:
        of.detector.restore(parts["detector"])


def _own(arrays: dict[str, FloatArray], prefix: str) -> dict[str, FloatArray]:
    """Arrays of a part, by their own names."""
    return {
        name.removeprefix(prefix): values
        for name, values in arrays.items()
        if name.startswith(prefix)
    }
