"""Limits of the structured rule: from the sensors' noise, from the model's size, from healthy readings."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from identification._fault_core import (
    LINK_POSITION,
    LINK_VELOCITY,
    MOTOR_POSITION,
    MOTOR_VELOCITY,
    TORQUE,
    ObserverCore,
)
from identification._fault_residuals import COUNT, ENERGY_RESIDUALS
from identification._fault_types import FaultSettings
from identification.errors import InputError

if TYPE_CHECKING:
    from identification._fault_structured import StructuredRule

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
        out.extend(SIGMAS * math.sqrt(2.0 * noise[position] ** 2 + noise[velocity] ** 2 * dt * lag) for lag in lags)
    for velocity, gain in ((LINK_VELOCITY, core.link_gain), (MOTOR_VELOCITY, core.motor_gain)):
        for i, lag in enumerate(lags):
            jump = settings.torque_step * gain * lag if i == 0 else 0.0
            out.append(max(jump, SIGMAS * math.sqrt(2.0) * noise[velocity]))
    torsion = math.hypot(noise[TORQUE], core.stiffness * math.hypot(noise[LINK_POSITION], noise[MOTOR_POSITION]))
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


def calibrate(rule: StructuredRule, readings: FloatArray) -> None:
    """Limits, noise of r1 and recovery limits from healthy readings (n, 6)."""
    core, settings, res = rule.core, rule.settings, rule.residuals
    if len(readings) < 4 * rule.arm:
        raise InputError(f"calibrate: {len(readings)} samples; give at least {4 * rule.arm} healthy ones")
    if not np.isfinite(readings).all():
        raise InputError("calibrate: the readings hold NaN or infinity; give a healthy record")
    seen = watch(rule, readings)
    if core.has_torque:
        core.tune(max(float(np.sqrt(np.mean(seen[:, 16] ** 2))), float(core.noise[TORQUE])))
        seen = watch(rule, readings)
    low = floors(core, settings)
    top = np.max(np.abs(seen[:, :COUNT]), axis=0)
    res.limits = [max(f, settings.margin * float(t)) for f, t in zip(low, top, strict=True)]
    res.inverse = [1.0 / max(float(np.mean(seen[:, at] ** 2)), (low[at] / 8.0) ** 2) for at in ENERGY_RESIDUALS]
    peaks = [
        energy_peak(seen[:, at], inverse, settings.energy_drift)
        for at, inverse in zip(ENERGY_RESIDUALS, res.inverse, strict=True)
    ]
    res.energy_limits = [max(60.0, settings.energy_margin * peak) for peak in peaks]
    longest = max(round(WITHOUT_SECONDS / core.dt), 2 * rule.arm)
    for sensor in range(6):
        if sensor != TORQUE or core.has_torque:
            _without(rule, sensor, readings[-longest:])
    rule.reset()


def energy_peak(values: FloatArray, inverse: float, drift: float) -> float:
    """Largest value of the CUSUM on the energy."""
    level = peak = 0.0
    for gain in (values**2 * inverse - drift).tolist():
        level = max(0.0, level + gain)
        peak = max(peak, level)
    return peak


def watch(rule: StructuredRule, readings: FloatArray, without: int | None = None) -> FloatArray:
    """Values of all residuals over healthy readings after the start-up, and one column more.

    With a sensor left out, the last column is how far its reading lies from the estimate.
    """
    res = rule.residuals
    kept = (res.limits, res.inverse, res.energy_limits)
    res.limits, res.inverse = [math.inf] * COUNT, [0.0] * len(res.inverse)
    rule.reset()
    rule.calibrating = True
    if without is not None:
        rule.failed[without] = True
        rule.exchange([without])
    out = np.zeros((len(readings), COUNT + 1))
    for k, row in enumerate(readings):
        used = rule.update(row.tolist())
        out[k, :COUNT] = res.values
        if without is not None:
            out[k, COUNT] = used[without] - row[without]
    rule.calibrating = False
    res.limits, res.inverse, res.energy_limits = kept
    return out[rule.arm :]


def _without(rule: StructuredRule, sensor: int, readings: FloatArray) -> None:
    """What healthy readings give while one of them is replaced: recovery limit, and wider residual limits."""
    seen = np.max(np.abs(watch(rule, readings, sensor)), axis=0)
    limits, margin = rule.residuals.limits, rule.settings.margin
    rule.recover_limits[sensor] = max(margin * float(seen[COUNT]), 6.0 * float(rule.core.noise[sensor]))
    for i in range(5):
        rows = range(4 * i, 4 * i + 4) if i < 4 else range(16, COUNT)
        rule.widening[sensor][i] = max(1.0, *(margin * float(seen[j]) / limits[j] for j in rows))
