"""What supervises the recursion of an online estimator: searches for its shapes, and its
holding through failures.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from identification.online.guard import Guard
from identification.online.two_step import Reoptimiser

if TYPE_CHECKING:
    from identification.online.estimator import OnlineEstimator

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


def guarded(
    of: OnlineEstimator,
    guard: Guard,
    theta: FloatArray,
    error: FloatArray,
    least: FloatArray,
    on: BoolArray,
) -> FloatArray:
    """The estimate to show after a row; a recursion that follows a failed sensor is held."""
    if of.estimator is None:
        return of.theta
    told = guard.step(of.estimator, theta, error, np.maximum(least, of.level), on)
    if told:
        of.events.append(f"estimate {told}")
    if told == "back":
        of._square[:], of._strained = of.level**2, 0
        if of.two_step is not None:
            of.two_step.forget(guard.held_for)
    return guard.theta


def launch(of: OnlineEstimator, two: Reoptimiser, *, first: bool = False) -> None:
    """Begin a search for the shapes on the rows kept."""
    window = two.window()
    weight = of._weight_of(window.shares, of.theta, of._size()) * window.on
    two.launch(weight, of.theta, of.level, of.least, of._factory(), first=first)
    of.events.append(str(two.mode))


def advance(of: OnlineEstimator, two: Reoptimiser) -> None:
    """Do the portions of a sample, and take up what the search has found."""
    found, guard = two.advance(), of.guard
    if found is None:
        return
    of.events.append(found.text)
    of._strained = 0
    if found.eta is None:
        return
    trusted = found.good and found.estimator is not None and guard.plausible(found.estimator.theta)
    if guard.on_probation and not trusted:
        return
    of.rows = two.reshaped(found.eta, found.deviation, of.rows)
    if found.estimator is not None:
        of.estimator, of._scale = found.estimator, found.scale
        of.theta, of.sigma = found.estimator.theta, found.estimator.deviation
        of._square, of.level = found.level**2, found.level
    if of.estimator is not None:
        guard.start(of.estimator)
    of._floors()
