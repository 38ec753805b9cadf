"""The online estimator fed sample by sample, with all that it said on the way: of a record, or of a
file that is still being written.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, final

import numpy as np
import numpy.typing as npt

from workbench.show.replayed import AFTERMATH, READINGS

if TYPE_CHECKING:
    from identification.faults.detector import FaultEvent
    from identification.online.estimator import OnlineEstimator

FloatArray = npt.NDArray[np.float64]


@final
class Stepper:
    """An estimator and the course of what it said.

    Parameters
    ----------
    estimator : OnlineEstimator
    every : int
        Samples between two looks.
    told : bool
        Whether the estimator's own fault codes are events; False where a bank gives them.

    Attributes
    ----------
    looks : list of (sample, six scores)
        Largest residual of each reading since the look before, as a share of its limit.
    course : list of (time [s], values, sigmas, ratios)
        At the looks after the warm-up.
    events : list of dict
        ``time``, ``fault``, ``text``.
    verdicts : list of (time [s], FaultEvent)
    """

    def __init__(self, estimator: OnlineEstimator, every: int, *, told: bool = True) -> None:
        self.estimator, self.every = estimator, every
        self.looks: list[tuple[int, list[float]]] = []
        self.course: list[tuple[float, FloatArray, FloatArray, FloatArray]] = []
        self.events: list[dict[str, Any]] = []
        self.verdicts: list[tuple[float, FaultEvent]] = []
        self._own_events, self._count, self._fault = told, 0, 0

    def restart(self) -> None:
        """Before the first sample of a stretch."""
        self.estimator.reset()
        self._told: FaultEvent | None = None
        self._worst = [0.0] * len(READINGS)
        self._before: tuple[bool, ...] = (False,) * len(READINGS)
        self._quiet = [-math.inf] * len(READINGS)

    def feed(self, now: float, row: list[float], valid: list[bool]) -> bool:
        """Take one sample (link-referred SI) at a time [s]; True where the course was looked at."""
        estimator, detector = self.estimator, self.estimator.detector
        estimator.update(now, row, valid)
        self._worst = [max(a, b) for a, b in zip(self._worst, estimator.score, strict=True)]
        codes = []
        if detector is not None:
            if detector.last_event is not self._told:
                self.verdicts += [(now, e) for e in _since(detector.events, self._told)]
                self._told = detector.last_event
            replaced = detector.replaced
            if replaced != self._before:
                codes = [
                    i + (1 if valid[i] else 11)
                    for i in range(len(READINGS))
                    if replaced[i] and not self._before[i]
                ]
                self._quiet = [
                    now + AFTERMATH if r or b else q
                    for r, b, q in zip(replaced, self._before, self._quiet, strict=True)
                ]
                self._before = replaced
        if self._own_events and estimator.fault != self._fault:
            fault = self._fault = estimator.fault
            # a reading that is replaced has been reported when that began
            known = fault not in (7, 8, 9) and (
                self._before[fault % 10 - 1] or now < self._quiet[fault % 10 - 1]
            )
            codes += [fault] if fault and not known else []
        self.events += [{"time": now, "fault": code, "text": fault_text(code)} for code in codes]
        self._count += 1
        if self._count % self.every:
            return False
        self.looks.append((self._count - 1, self._worst))
        self._worst = [0.0] * len(READINGS)
        if not estimator.warming_up:
            self.course.append(
                (now, estimator.theta.copy(), estimator.sigma.copy(), estimator.ratio.copy())
            )
        return True


def arrays_of(
    course: Sequence[tuple[float, FloatArray, FloatArray, FloatArray]], estimator: OnlineEstimator
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Times (m,) [s], values and sigmas (m, parameters), ratios (m, balances) of a course."""
    widths = ((), (len(estimator.names),), (len(estimator.names),), (len(estimator.balances),))
    time, values, sigmas, ratios = (
        np.array([row[i] for row in course]).reshape(-1, *w) for i, w in enumerate(widths)
    )
    return time, values, sigmas, ratios


def _since(events: Sequence[FaultEvent], known: FaultEvent | None) -> Sequence[FaultEvent]:
    """Events after one that is known; all where the detector has started anew."""
    places = [k for k, e in enumerate(events) if e is known]
    return events[places[-1] + 1 :] if places else events


def fault_text(code: int) -> str:
    """What a fault code means, in words."""
    if code == 7:
        return "motor current sensor failed or motor friction changed"
    if code == 8:
        return "the joint changed, the sensors agree with each other"
    if code == 9:
        return (
            "the readings cannot be those of the joint, or stand still while it moves; the "
            "estimate is held"
        )
    kind, sensor = divmod(code, 10)
    what = (
        "sensor failed",
        "reading missing",
        "reading constant while the joint moves",
        "reading of wrong scale",
    )[kind]
    return f"{READINGS[sensor - 1]}: {what}"


__all__ = ["Stepper", "arrays_of", "fault_text"]
