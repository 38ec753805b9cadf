"""Fault codes of the online estimator, and what they follow from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from .watch import DRIVE, TAU

if TYPE_CHECKING:
    from identification.fault import FaultDetector

FloatArray = npt.NDArray[np.float64]

NONE, MISSING, CONSTANT, SCALED = 0, 10, 20, 30
CURRENT_OR_FRICTION, PLANT = 7, 8
FAULT_TEXT: Final = (
    "0 none; 1 to 6 sensor failed: motor current, motor position, motor velocity, link position, link velocity, "
    "torque; 7 current sensor or motor friction; 8 the joint changed; 11 to 16 reading missing, 21 to 26 reading "
    "constant while the joint moves, 31 to 36 reading of wrong scale, in the same order"
)
_RECENT: Final = 5.0


def plant_alarm(detector: FaultDetector, dt: float) -> int:
    """Code of the detector's newest verdict on the joint itself, for some seconds; 0 without one."""
    if not detector.events:
        return NONE
    last = detector.events[-1]
    codes = {"CURRENT_OR_FRICTION": CURRENT_OR_FRICTION, "PLANT": PLANT}
    recent = detector._rule.k - last.sample < round(_RECENT / dt)
    return codes.get(last.verdict.name, NONE) if recent else NONE


def scores(detector: FaultDetector) -> list[float]:
    """For each reading, the largest residual that holds it over its limit; at least 1 where it has failed."""
    from identification._fault_structured import PARITY_SENSORS, StructuredRule

    rule, score = detector._rule, [0.0] * 6
    if not isinstance(rule, StructuredRule):
        return score
    limits, values = rule.residuals.limits, rule.residuals.values
    for parity, sensors in enumerate(PARITY_SENSORS):
        rows = range(4 * parity, 4 * parity + 4) if parity < 4 else range(16, len(values))
        worst = max(abs(values[j]) / limits[j] if limits[j] > 0 else 0.0 for j in rows)
        for sensor in sensors:
            score[sensor] = max(score[sensor], worst)
    return [max(1.0, value) if failed else value for value, failed in zip(score, rule.failed, strict=True)]


def scale_limits(detector: FaultDetector, factor: float) -> None:
    """Multiply the detector's limits."""
    from identification._fault_structured import StructuredRule

    if isinstance(detector._rule, StructuredRule):
        residuals = detector._rule.residuals
        residuals.limits = [limit * factor for limit in residuals.limits]


def implausible(names: Sequence[str], theta: FloatArray, sigma: FloatArray, fitted: Mapping[str, float]) -> int:
    """Code where an inertia is far from that of the fitted joint: the scale of torque or current is wrong."""
    for name, code in (("link_inertia", SCALED + 1 + TAU), ("motor_inertia", SCALED + 1 + DRIVE)):
        if name in names and name in fitted:
            i = list(names).index(name)
            before, now, spread = fitted[name], float(theta[i]), float(sigma[i])
            if not before / 3 < now < 3 * before and abs(now - before) > 5 * spread:
                return code
    return NONE
