"""Numbers and functions of a calibrated detector, for a copy of it in another language."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np
import numpy.typing as npt

from identification.faults.core import ObserverCore

if TYPE_CHECKING:
    from identification.faults.structured import StructuredRule

FloatArray = npt.NDArray[np.float64]


@final
@dataclass(frozen=True)
class DetectorTables:
    """Structured rule, see :class:`identification.faults.detector.FaultDetector`.

    Attributes
    ----------
    function : casadi.Function
        Observer: state, readings, used, gain, gate to what
        :class:`identification.faults.core.ObserverCore` names.
    states : int
    has_torque : bool
    gains : (32, 5 states) array
        Gain of each set of readings 1 to 5 in use; bit i of the row is reading i + 1.
    gates, noise : (5,) and (6,) array
        Innovations are cut there; standard deviations of the readings.
    stiffness : float
        [N.m/rad]
    waits : mapping
        Samples, by the names of :class:`identification.faults.detector.FaultSettings`; `arm` is the
        start-up.
    lags, limits, inverse, energy_limits : list
        Windows [samples], limits of the residuals, inverse mean squares and limits of the CUSUMs.
    recover_limits, widening : list
        How far a failed sensor may lie off and count as agreeing; factors on limits while a sensor
        is replaced.
    half, means, drift : float, (2,) tuple, float
        Half a sample time [s]; inverse lengths of the two means of r1 [1/s]; what a CUSUM loses per
        sample.
    """

    function: Any
    states: int
    has_torque: bool
    gains: FloatArray
    gates: FloatArray
    noise: FloatArray
    stiffness: float
    waits: Mapping[str, int]
    lags: list[int]
    limits: list[float]
    inverse: list[float]
    energy_limits: list[float]
    recover_limits: list[float]
    widening: list[list[float]]
    half: float
    means: tuple[float, float]
    drift: float

    @staticmethod
    def of(rule: StructuredRule) -> DetectorTables:
        """Those of a rule, which stays as it is."""
        core, res = rule.core, rule.residuals
        return DetectorTables(
            function=core.function,
            states=core.size,
            has_torque=core.has_torque,
            gains=_gains(core),
            gates=core.gates.copy(),
            noise=core.noise.copy(),
            stiffness=core.stiffness,
            waits={**rule.waits, "arm": rule.arm},
            lags=list(res.lags),
            limits=res.limits,
            inverse=res.inverse,
            energy_limits=res.energy_limits,
            recover_limits=list(rule.recover_limits),
            widening=[list(row) for row in rule.widening],
            half=res.half,
            means=(res.mean1, res.mean2),
            drift=res.drift,
        )


def _gains(core: ObserverCore) -> FloatArray:
    before = tuple(bool(v) for v in core.used)
    gate = core.gate.copy()
    found = np.zeros((32, 5 * core.size))
    for rows in range(32):
        used = tuple(bool(rows >> i & 1) for i in range(5))
        if used[4] and not core.has_torque:
            continue
        core.set_used((True, *used))
        found[rows] = core.gain.ravel()
    core.set_used(before)
    core.gate[:] = gate
    return found
