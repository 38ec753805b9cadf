"""Limits of the structured rule: from the sensors' noise, from the model's size, from healthy
readings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from identification.faults.core import (
    LINK_POSITION,
    LINK_VELOCITY,
    MOTOR_POSITION,
    MOTOR_VELOCITY,
    TORQUE,
    ObserverCore,
)
from identification.faults.types import FaultSettings

FloatArray = npt.NDArray[np.float64]

SIGMAS: Final = 5.5
"""No limit lies below this many standard deviations of the noise."""
WITHOUT_SECONDS: Final = 60.0
"""Length of the record on which the estimates without one sensor are judged [s]."""


def default_recovery(core: ObserverCore) -> list[float]:
    """How far a sensor may lie from the estimate and count as agreeing, without calibration."""
    model = (30.0, 3e-4, 1e-2, 3e-4, 1e-2, 10.0)
    return [8.0 * float(n) + m for n, m in zip(core.noise, model, strict=True)]


def floors(core: ObserverCore, settings: FaultSettings) -> list[float]:
    """Smallest limits: what noise and the joint's largest change of torque can do."""
    lags, noise, dt = settings.lags, core.noise.tolist(), core.dt
    out: list[float] = []
    for position, velocity in ((LINK_POSITION, LINK_VELOCITY), (MOTOR_POSITION, MOTOR_VELOCITY)):
        out.extend(
            SIGMAS * math.sqrt(2.0 * noise[position] ** 2 + noise[velocity] ** 2 * dt * lag)
            for lag in lags
        )
    for velocity, gain in ((LINK_VELOCITY, core.link_gain), (MOTOR_VELOCITY, core.motor_gain)):
        for i, lag in enumerate(lags):
            jump = settings.torque_step * gain * lag if i == 0 else 0.0
            out.append(max(jump, SIGMAS * math.sqrt(2.0) * noise[velocity]))
    torsion = math.hypot(
        noise[TORQUE], core.stiffness * math.hypot(noise[LINK_POSITION], noise[MOTOR_POSITION])
    )
    out.append(SIGMAS * torsion)
    out.extend(SIGMAS * torsion * math.sqrt(dt / lag) for lag in lags[1:3])
    return out


def default_limits(core: ObserverCore, settings: FaultSettings) -> list[float]:
    """Limits without calibration: noise plus a guess of the model's error, 10 N.m."""
    found = floors(core, settings)
    for i, gain in ((8, core.link_gain), (12, core.motor_gain)):
        for j, lag in enumerate(settings.lags):
            found[i + j] += 10.0 * gain * min(lag, 0.5)
    for i in (16, 17, 18):
        found[i] += 10.0
    return found


def last_rows(pieces: Sequence[FloatArray], most: int) -> list[FloatArray]:
    """The last rows of all pieces together."""
    kept: list[FloatArray] = []
    for piece in reversed(pieces):
        if most > 0:
            kept.insert(0, piece[-most:])
            most -= len(piece)
    return kept


def energy_peak(values: FloatArray, inverse: float, drift: float) -> float:
    """Largest value of the CUSUM on the energy."""
    level = peak = 0.0
    for gain in (values**2 * inverse - drift).tolist():
        level = max(0.0, level + gain)
        peak = max(peak, level)
    return peak
