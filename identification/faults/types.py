"""What the fault detector says: verdicts, events, settings, tracks."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


class Verdict(Enum):
    """What an event reports; the value is the sentence a user reads."""

    ARMED = "The start-up transient is over; faults are looked for from here on."
    SENSOR = "A sensor failed; its reading is replaced by the estimate."
    DROPOUT = "A reading is missing; it is replaced by the estimate."
    CURRENT_OR_FRICTION = (
        "The current sensor failed or the motor's friction changed: the readings cannot tell which."
    )
    PLANT = "The joint changed, the sensors agree with each other: identify it again."
    ONE_OF = (
        "One of these failed, or changed if it is the stiffness: the readings cannot tell which."
    )
    DEAD = "All readings stand still although the joint moved, or time has stopped."
    RECOVERED = "The sensor agrees with the estimate again; its reading is used."

    def __str__(self) -> str:
        """Return the sentence."""
        return self.value


@final
@dataclass(frozen=True)
class FaultEvent:
    """One event.

    Attributes
    ----------
    sample : int
        Sample of the decision.
    first : int
        Sample at which the first residual passed its limit.
    verdict : Verdict
    sensors : tuple of str
        Sensors it is about; for a plant change the part: stiffness, link or motor. A set that the
        readings cannot tell apart may have the stiffness beside sensors.
    residuals : tuple of str
        Residuals that had passed their limits.
    """

    sample: int
    first: int
    verdict: Verdict
    sensors: tuple[str, ...]
    residuals: tuple[str, ...]

    @property
    def is_sensor(self) -> bool:
        """True where a sensor is declared failed (the pair current or friction is not)."""
        return self.verdict in (Verdict.SENSOR, Verdict.DROPOUT)


@final
@dataclass(frozen=True)
class FaultSettings:
    """Tuning of the structured rule.

    Attributes
    ----------
    arm_seconds
        Start-up transient during which no fault is declared.
    lags
        Windows of the parities [s], the shortest first.
    margin
        Limits are this many times the largest value seen in calibration.
    energy_margin
        The same for the CUSUM on the energy.
    energy_drift
        What the CUSUM subtracts per sample, in mean squares of the residual.
    torque_step
        Largest change of torque the joint can make at once [N.m]; it bounds how fast a velocity can
        truly change.
    link_wait, torque_wait, pair_wait, plant_wait
        Seconds between the first residual and a decision: position or velocity; torque sensor;
        current or friction; plant.
    quiet_seconds
        A suspicion without a decision ends after this time without a residual over its limit.
    recover_seconds
        A failed sensor must agree with the estimate for this long before it is used again.
    settle_seconds
        After a replacement the estimate settles for this long before its residuals are looked at
        again.
    plant_rest_seconds
        No second plant report for this long.
    """

    arm_seconds: float = 1.5
    lags: tuple[float, float, float, float] = (0.003, 0.05, 0.5, 2.0)
    margin: float = 1.6
    energy_margin: float = 3.0
    energy_drift: float = 4.0
    torque_step: float = 100.0
    link_wait: float = 0.003
    torque_wait: float = 0.01
    pair_wait: float = 0.04
    plant_wait: float = 1.0
    quiet_seconds: float = 0.3
    recover_seconds: float = 0.5
    settle_seconds: float = 0.1
    plant_rest_seconds: float = 5.0

    def __post_init__(self) -> None:
        if list(self.lags) != sorted(self.lags) or self.lags[0] <= 0:
            raise InputError("fault settings: give four positive lags, the shortest first")
        if self.margin < 1 or self.energy_margin < 1:
            raise InputError("fault settings: margin and energy_margin must be at least 1")


@final
@dataclass(frozen=True)
class FaultTrack:
    """What a run over a record gave.

    Attributes
    ----------
    reconstructed : (n, 6) array
        Readings with failed ones replaced.
    failed : (n, 6) bool array
    events : tuple of FaultEvent
    """

    reconstructed: FloatArray
    failed: BoolArray
    events: tuple[FaultEvent, ...]
