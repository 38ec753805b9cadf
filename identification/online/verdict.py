"""Fault codes of the online estimator, and what they follow from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from identification.online.watch import DRIVE, TAU, Watch

if TYPE_CHECKING:
    from casadi_models import JointModel
    from identification.faults.detector import FaultDetector
    from identification.online.options import OnlineOptions

FloatArray = npt.NDArray[np.float64]

NONE, MISSING, CONSTANT, SCALED = 0, 10, 20, 30
CURRENT_OR_FRICTION, PLANT, HELD = 7, 8, 9
FAULT_TEXT: Final = (
    "0 none; 1 to 6 sensor failed: motor current, motor position, motor velocity, link position, "
    "link velocity, "
    "torque; 7 current sensor or motor friction; 8 the joint changed; 9 the readings cannot be "
    "those of the joint, or stand still "
    "while it moves, and the estimate is held; 11 to 16 reading missing, 21 to 26 reading "
    "constant while the joint moves, 31 to 36 reading of wrong scale, in the same order"
)
_RECENT: Final = 5.0
WRONG_SCALE: Final = 3.0
"""Factor by which an inertia must be off that of the fitted joint for a scale to be wrong: a
payload changes it by less, an ampere for a newton metre by more."""
WRONG_SIGMAS: Final = 5.0
"""Standard deviations by which it must be off, too: one chance in a million."""


def worst(missing: Sequence[bool], detector: FaultDetector | None, watch: Watch) -> int:
    """Code of the most severe fault of a reading; :data:`NONE` without one."""
    failed = detector.replaced if detector is not None else ()
    for flags, code in (
        (missing, MISSING),
        (failed, 0),
        (watch.constant, CONSTANT),
        (watch.scaled, SCALED),
    ):
        if True in flags:
            return code + 1 + list(flags).index(True)
    return NONE


def make_detector(
    model: JointModel, dt: float, options: OnlineOptions, state: bytes | None
) -> FaultDetector | None:
    """A fault detector with the limits of a calibrated one's `state`; None for a rigid joint."""
    if not model.is_elastic:
        return None
    from identification.faults.detector import FaultDetector

    made = FaultDetector(model, dt, has_torque=options.has_torque)
    if state:
        made.restore(state)
        made.reset()
    made.compile()
    return made


def plant_alarm(detector: FaultDetector, dt: float) -> int:
    """Code of the detector's newest verdict on the joint itself, for some seconds; 0 without
    one.
    """
    last = detector.last_event
    if last is None:
        return NONE
    codes = {"CURRENT_OR_FRICTION": CURRENT_OR_FRICTION, "PLANT": PLANT}
    recent = detector.sample - last.sample < round(_RECENT / dt)
    return codes.get(last.verdict.name, NONE) if recent else NONE


def implausible(
    names: Sequence[str], theta: FloatArray, sigma: FloatArray, fitted: Mapping[str, float]
) -> int:
    """Code where an inertia is far from that of the fitted joint: the scale of torque or
    current is wrong.
    """
    for name, code in (("link_inertia", SCALED + 1 + TAU), ("motor_inertia", SCALED + 1 + DRIVE)):
        if name in names and name in fitted:
            i = list(names).index(name)
            before, now, spread = fitted[name], float(theta[i]), float(sigma[i])
            near = before / WRONG_SCALE < now < WRONG_SCALE * before
            if not near and abs(now - before) > WRONG_SIGMAS * spread:
                return code
    return NONE
