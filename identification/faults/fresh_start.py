"""Fresh starts of the structured rule: after absurd estimates, and where readings that were
missing are there again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from identification.faults.core import (
    LINK_POSITION,
    LINK_VELOCITY,
    MOTOR_POSITION,
    MOTOR_VELOCITY,
    SENSORS,
)
from identification.faults.residuals import PARITY_SENSORS
from identification.faults.types import FaultEvent, Verdict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from identification.faults.structured import StructuredRule

_LARGEST: Final = 1e6
"""A reading beyond this is no place to start an estimate from."""
_OTHERS: Final = (
    (MOTOR_POSITION, LINK_POSITION),
    (LINK_POSITION, MOTOR_POSITION),
    (MOTOR_VELOCITY, LINK_VELOCITY),
    (LINK_VELOCITY, MOTOR_VELOCITY),
)


def begin_anew(rule: StructuredRule, reading: list[float]) -> list[float]:
    """Absurd readings have driven the estimate out of all bounds: start it and the residuals
    again.
    """
    usable = [value if -_LARGEST < value < _LARGEST else 0.0 for value in reading]
    _start(rule, usable)
    rule.open_gates()
    rule.close()
    return [u if failed else r for u, r, failed in zip(usable, reading, rule.failed, strict=True)]


def take_back(rule: StructuredRule, reading: list[float], gone: Sequence[int]) -> None:
    """Use readings again that were missing, where no position is in use.

    Without a position the estimate drifts and can judge none. A reading that was missing is as good
    as at the first sample once it is there, so the estimate starts anew from it. Sensors that
    failed otherwise stay out.
    """
    failed, lost = rule.failed, rule.lost
    here = any(lost[s] and s not in gone for s in (MOTOR_POSITION, LINK_POSITION))
    if not (here and failed[MOTOR_POSITION] and failed[LINK_POSITION]):
        rule.there = 0
        return
    rule.there += 1
    if rule.there < rule.waits["settle_seconds"]:
        return
    back = [s for s in range(6) if lost[s] and s not in gone]
    for s in back:
        failed[s] = lost[s] = False
    start = [value if -_LARGEST < value < _LARGEST else 0.0 for value in reading]
    usable = [0.0 if failed[s] else start[s] for s in range(6)]
    for own, other in _OTHERS:
        if failed[own]:
            start[own] = usable[other]
    _start(rule, start)
    rule.events.append(
        FaultEvent(rule.k, rule.k, Verdict.RECOVERED, tuple(SENSORS[s] for s in back), ())
    )
    rule.there = 0
    rule.exchange(back)


def _start(rule: StructuredRule, reading: list[float]) -> None:
    """Observer at the readings, residuals without a past; their scales stay."""
    residuals = rule.residuals
    rule.core.start(np.array(reading))
    scale = residuals.scale.copy()
    residuals.clear()
    residuals.scale[:] = scale
    for parity in range(len(PARITY_SENSORS)):
        residuals.invalidate(parity, rule.k + 1 + rule.waits["settle_seconds"])
