"""The thesis's rule (4.6) to (4.8): relative prediction error and input-output difference of
the link sensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.faults.core import (
    ABSURD,
    LINK_POSITION,
    LINK_VELOCITY,
    MOTOR_POSITION,
    MOTOR_VELOCITY,
    SENSORS,
    ObserverCore,
)
from identification.faults.types import FaultEvent, Verdict

FloatArray = npt.NDArray[np.float64]


@final
@dataclass(frozen=True)
class ThesisSettings:
    """Tuning of the thesis rule.

    Attributes
    ----------
    tolerance
        delta_e of (4.7) in percent, for position and velocity; None: from calibration.
    floor
        delta_min: below this estimate no error is formed [rad, rad/s].
    input_output
        Limit of (4.8) for position and velocity; None: from calibration.
    samples
        How many samples in a row must be over (or back under) the limits.
    arm_seconds
        Start-up transient.
    margin
        Calibrated limits are this many times the largest healthy value.
    """

    tolerance: tuple[float, float] | None = None
    floor: tuple[float, float] = (0.02, 0.05)
    input_output: tuple[float, float] | None = None
    samples: int = 3
    arm_seconds: float = 1.5
    margin: float = 1.6


@final
class Predictor:
    """Discrete state-space model from motor to link, stepped sample by sample."""

    def __init__(self, a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> None:
        if c.shape[0] != 2 or b.shape[1] not in (2, 3):
            raise InputError(
                f"thesis rule: the predictor has {b.shape[1]} inputs and {c.shape[0]} outputs; "
                "give motor position, "
                "velocity (and acceleration) to link position, velocity"
            )
        self.a, self.b, self.c, self.d = a, b, c, d

    @staticmethod
    def of(source: Any) -> Predictor:
        """From a control.StateSpace or four matrices."""
        parts = [source.A, source.B, source.C, source.D] if hasattr(source, "A") else list(source)
        if len(parts) != 4:
            raise InputError("thesis rule: give the predictor as a StateSpace or as (A, B, C, D)")
        return Predictor(*(np.atleast_2d(np.asarray(p, dtype=np.float64)) for p in parts))


@final
class ThesisRule:
    """State of the thesis rule; see :class:`identification.faults.detector.FaultDetector`."""

    def __init__(
        self, core: ObserverCore, settings: ThesisSettings, predictor: Predictor | None
    ) -> None:
        self.core, self.settings, self.predictor = core, settings, predictor
        self.arm = max(2, round(settings.arm_seconds / core.dt))
        self.limits = [50.0, 50.0]
        self.io_limits = list(settings.input_output or (0.1, 0.5))
        if settings.tolerance is not None:
            self.limits = list(settings.tolerance)
        self.order = 0 if predictor is None else predictor.a.shape[0]
        self.reset()

    def reset(self) -> None:
        """Before the first sample; limits stay."""
        self.k = -1
        self.failed = [False] * 6
        self.events: list[FaultEvent] = []
        self.over, self.under, self.changed = [0, 0], [0, 0], [0, 0]
        self.x = np.zeros(self.order)
        self.last_velocity = 0.0
        self.plant = False
        used = (False, True, True, False, False, False) if self.predictor is None else (True,) * 6
        self.core.set_used(used)

    def _predict(self, reading: list[float]) -> tuple[float, float]:
        """Link position and velocity from the motor side."""
        core, predictor = self.core, self.predictor
        if predictor is None:
            core.readings[:] = reading
            out = core.advance()
            return out[core.size + 3], out[core.size + 4]
        u = np.array(reading[1:3])
        if predictor.b.shape[1] == 3:
            u = np.append(u, (reading[2] - self.last_velocity) / core.dt)
        self.last_velocity = reading[2]
        if self.k == 0:  # start at rest where the readings are
            gap = np.array(reading[3:5]) - predictor.d @ u
            self.x = np.linalg.lstsq(predictor.c, gap, rcond=None)[0]
        y = predictor.c @ self.x + predictor.d @ u
        self.x = predictor.a @ self.x + predictor.b @ u
        return float(y[0]), float(y[1])

    def _errors(
        self, reading: list[float], predicted: tuple[float, float]
    ) -> list[tuple[float, float]]:
        """(relative error in percent, input-output difference) of link position and velocity."""
        found = []
        for i, (link, motor) in enumerate(
            ((LINK_POSITION, MOTOR_POSITION), (LINK_VELOCITY, MOTOR_VELOCITY))
        ):
            floor = self.settings.floor[i]
            if abs(predicted[i]) >= floor:
                relative = 100.0 * abs((predicted[i] - reading[link]) / predicted[i])
            else:
                relative = 0.0
            if abs(reading[motor]) >= floor:
                across = abs((reading[motor] - reading[link]) / reading[motor])
            else:
                across = 0.0
            found.append((relative, across))
        return found

    def update(self, reading: list[float]) -> list[float]:
        """One sample; gives the readings with failed ones replaced."""
        self.k = k = self.k + 1
        if k == 0:
            self.core.start(np.array(reading))
        missing = [not -ABSURD < v < ABSURD for v in reading]
        clean = [0.0 if m else v for v, m in zip(reading, missing, strict=True)]
        predicted = self._predict(clean)
        out = list(reading)
        if k == self.arm:
            self.events.append(FaultEvent(k, k, Verdict.ARMED, (), ()))
        errors = self._errors(clean, predicted) if k >= self.arm else [(0.0, 0.0)] * 2
        for i, sensor in enumerate((LINK_POSITION, LINK_VELOCITY)):
            relative, across = errors[i]
            if k >= self.arm:
                self._judge(
                    i,
                    sensor,
                    relative,
                    across,
                    missing[sensor],
                    abs(predicted[i]) >= self.settings.floor[i],
                )
            if self.failed[sensor]:
                out[sensor] = predicted[i]
        return out

    def _judge(
        self, i: int, sensor: int, relative: float, across: float, missing: bool, usable: bool
    ) -> None:
        need, name = self.settings.samples, SENSORS[sensor]
        large = relative > self.limits[i]
        wrong = missing or (large and across > self.io_limits[i])
        self.over[i] = self.over[i] + 1 if wrong else 0
        self.changed[i] = self.changed[i] + 1 if large and not wrong else 0
        if usable or missing:
            self.under[i] = 0 if large or missing else self.under[i] + 1
        if not self.failed[sensor] and (missing or self.over[i] >= need):
            self.failed[sensor] = True
            verdict = Verdict.DROPOUT if missing else Verdict.SENSOR
            self.events.append(
                FaultEvent(self.k, self.k - self.over[i] + 1, verdict, (name,), ("4.6", "4.8"))
            )
            self.under[i] = 0
        elif self.failed[sensor] and self.under[i] >= 100 * need:
            self.failed[sensor] = False
            self.events.append(FaultEvent(self.k, self.k, Verdict.RECOVERED, (name,), ()))
        elif not self.failed[sensor] and not self.plant and self.changed[i] >= 10 * need:
            self.plant = True
            self.events.append(FaultEvent(self.k, self.k, Verdict.PLANT, ("model",), ("4.6",)))

    def calibrate(self, pieces: Sequence[FloatArray]) -> None:
        """Limits of (4.7) and (4.8) from healthy readings, tables (n, 6) that need not follow
        each other.
        """
        worst = [[0.0, 0.0], [0.0, 0.0]]
        for readings in pieces:
            self.reset()
            for row in readings.tolist():
                self.k += 1
                if self.k == 0:
                    self.core.start(np.array(row))
                errors = self._errors(row, self._predict(row))
                if self.k >= self.arm:
                    for i, pair in enumerate(errors):
                        worst[i] = [max(a, b) for a, b in zip(worst[i], pair, strict=True)]
        margin = self.settings.margin
        if self.settings.tolerance is None:
            self.limits = [margin * w[0] for w in worst]
        if self.settings.input_output is None:
            self.io_limits = [margin * w[1] for w in worst]
        self.reset()

    def numbers(self) -> list[float]:
        """Everything that changes, limits included, as floats."""
        return [
            float(self.k),
            *map(float, self.failed),
            *map(float, (*self.over, *self.under, *self.changed)),
            self.last_velocity,
            float(self.plant),
            *self.limits,
            *self.io_limits,
            *self.x.tolist(),
            *self.core.state.tolist(),
        ]

    def load(self, numbers: list[float]) -> None:
        """Take up what :meth:`numbers` gave."""
        self.k = int(numbers[0])
        self.failed = [v != 0.0 for v in numbers[1:7]]
        counts = [int(v) for v in numbers[7:13]]
        self.over, self.under, self.changed = counts[:2], counts[2:4], counts[4:]
        self.last_velocity, self.plant = numbers[13], numbers[14] != 0.0
        self.limits, self.io_limits = numbers[15:17], numbers[17:19]
        self.x = np.array(numbers[19 : 19 + self.order])
        self.core.state[:] = numbers[19 + self.order :]
