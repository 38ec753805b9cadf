"""What the estimator does when a sensor fails: alternatives 1 and 2 of section 4.4.2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.faults.core import SENSORS
from identification.faults.types import FaultEvent, Verdict
from identification.recursive.estimator import RecursiveLeastSquares

FloatArray = npt.NDArray[np.float64]


@final
@dataclass
class Reconfiguration:
    """Answers the detector's events on a recursive estimator.

    Attributes
    ----------
    estimator : RecursiveLeastSquares
    alternative : {1, 2}
        1: the measurement covariance R2 is raised while a sensor is replaced. 2: that, and the
        stiffness parameters are held at their last values before the failure where a position
        sensor failed.
    stiffness : tuple of str
        Names of the parameters that alternative 2 holds.
    factor : float
        R2 is multiplied by this.
    """

    estimator: RecursiveLeastSquares
    alternative: Literal[1, 2] = 1
    stiffness: Sequence[str] = ("k1", "k2")
    factor: float = 100.0
    _failed: set[str] = field(default_factory=set)
    _normal: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.alternative not in (1, 2):
            raise InputError(f"Reconfiguration: alternative {self.alternative!r}; use 1 or 2")
        if not self.factor >= 1:
            raise InputError(f"Reconfiguration: factor {self.factor!r}; give at least 1")

    def __call__(self, event: FaultEvent) -> None:
        """Take note of one event (give the object to `FaultDetector.on_event`)."""
        before = bool(self._failed)
        if event.is_sensor:
            self._failed.update(s for s in event.sensors if s in SENSORS)
        elif event.verdict is Verdict.RECOVERED:
            self._failed.difference_update(event.sensors)
        else:
            return
        if self._failed and not before:
            self._normal = self.estimator.measurement_covariance
            self.estimator.set_measurement_covariance(self.factor * self._normal)
        elif before and not self._failed and self._normal is not None:
            self.estimator.set_measurement_covariance(self._normal)
        if self.alternative == 2:
            if self._failed & {"motor_position", "link_position"}:
                self.estimator.hold(self.stiffness)
            else:
                self.estimator.release(self.stiffness)
