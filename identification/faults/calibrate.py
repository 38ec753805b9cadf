"""Limits of the structured rule: from the sensors' noise, from the model's size, from healthy
readings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.faults.core import (
    LINK_POSITION,
    LINK_VELOCITY,
    MOTOR_POSITION,
    MOTOR_VELOCITY,
    TORQUE,
    ObserverCore,
)
from identification.faults.residuals import COUNT, ENERGY_RESIDUALS
from identification.faults.types import FaultSettings

if TYPE_CHECKING:
    from identification.faults.structured import StructuredRule

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


def calibrate(rule: StructuredRule, pieces: Sequence[FloatArray]) -> None:
    """Limits, noise of r1 and recovery limits from healthy readings, tables (n, 6) that need
    not follow each other.
    """
    core, settings, res = rule.core, rule.settings, rule.residuals
    if not all(np.isfinite(p).all() for p in pieces):
        raise InputError("calibrate: the readings hold NaN or infinity; give a healthy record")
    pieces = [p for p in pieces if len(p) >= 2 * rule.arm] or list(pieces[:1])
    count = sum(map(len, pieces))
    if count < 4 * rule.arm:
        raise InputError(f"calibrate: {count} samples; give at least {4 * rule.arm} healthy ones")
    seen = watch(rule, pieces)
    if core.has_torque:
        core.tune(max(float(np.sqrt(np.mean(seen[:, 16] ** 2))), float(core.noise[TORQUE])))
        seen = watch(rule, pieces)
    low = floors(core, settings)
    top = np.max(np.abs(seen[:, :COUNT]), axis=0)
    res.limits = [max(f, settings.margin * float(t)) for f, t in zip(low, top, strict=True)]
    res.inverse = [
        1.0 / max(float(np.mean(seen[:, at] ** 2)), (low[at] / 8.0) ** 2) for at in ENERGY_RESIDUALS
    ]
    peaks = [
        energy_peak(seen[:, at], inverse, settings.energy_drift)
        for at, inverse in zip(ENERGY_RESIDUALS, res.inverse, strict=True)
    ]
    res.energy_limits = [max(60.0, settings.energy_margin * peak) for peak in peaks]
    longest = max(round(WITHOUT_SECONDS / core.dt), 2 * rule.arm)
    for sensor in range(6):
        if sensor != TORQUE or core.has_torque:
            _without(rule, sensor, _last(pieces, longest))
    rule.reset()


def _last(pieces: Sequence[FloatArray], most: int) -> list[FloatArray]:
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


def watch(
    rule: StructuredRule, pieces: Sequence[FloatArray], without: int | None = None
) -> FloatArray:
    """Values of all residuals over healthy readings after the start-up of each piece, and one
    column more.

    With a sensor left out, the last column is how far its reading lies from the estimate.
    """
    res = rule.residuals
    kept = (res.limits, res.inverse, res.energy_limits)
    res.limits, res.inverse = [math.inf] * COUNT, [0.0] * len(res.inverse)
    rule.calibrating = True
    seen = []
    for readings in pieces:
        rule.reset()
        if without is not None:
            rule.failed[without] = True
            rule.exchange([without])
        out = np.zeros((len(readings), COUNT + 1))
        for k, row in enumerate(readings):
            used = rule.update(row.tolist())
            out[k, :COUNT] = res.values
            if without is not None:
                out[k, COUNT] = used[without] - row[without]
        seen.append(out[rule.arm :])
    rule.calibrating = False
    res.limits, res.inverse, res.energy_limits = kept
    return np.concatenate(seen)


def _without(rule: StructuredRule, sensor: int, pieces: Sequence[FloatArray]) -> None:
    """What healthy readings give while one of them is replaced: recovery limit, and wider
    residual limits.
    """
    seen = np.max(np.abs(watch(rule, pieces, sensor)), axis=0)
    limits, margin = rule.residuals.limits, rule.settings.margin
    rule.recover_limits[sensor] = max(
        margin * float(seen[COUNT]), 6.0 * float(rule.core.noise[sensor])
    )
    for i in range(5):
        rows = range(4 * i, 4 * i + 4) if i < 4 else range(16, COUNT)
        rule.widening[sensor][i] = max(1.0, *(margin * float(seen[j]) / limits[j] for j in rows))
