"""Readings of a simulated sensor: noise, quantisation and faults as expressions of time and
parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, final

import casadi as ca

from irj_fmu.fmi.variables import Variable

CHANNELS: Final = (
    "motor_position",
    "motor_velocity",
    "link_position",
    "link_velocity",
    "link_torque",
)
"""Readings of a joint, in the order of :attr:`casadi_models.functions.JointFunctions.outputs`."""
NEVER: Final = 1e9
"""Start of a fault that does not come [s]."""

_PRIME: Final = 33554393
"""The largest prime below 2^25: cubing is one-to-one modulo it, and every product stays exact
in a double.
"""
Declare = Callable[[str, str, float, str, float | None], Any]


def _mixed(number: Any) -> Any:
    """An integer below the prime from another one, without order."""
    for shift in (1618033.0, 7182818.0):
        square = ca.fmod(number * number, _PRIME)
        number = ca.fmod(ca.fmod(square * number, _PRIME) + shift, _PRIME)
    return number


def noise(sample: Any, seed: Any, channel: int) -> Any:
    """Standard normal value of a sample number: the same on every machine up to the last digits of
    log and cos.

    Parameters
    ----------
    sample, seed : expression
        Whole numbers, not negative.
    channel : int
        Channels have independent noise.
    """
    base = ca.fmod(sample * 7919 + 104729 * channel + 15485863, _PRIME)
    base = ca.fmod(base + _mixed(ca.fmod(seed * 65537 + 257, _PRIME)), _PRIME)
    first = _mixed(base)
    second = _mixed(ca.fmod(first + 27644437, _PRIME))
    size = ca.sqrt(-2 * ca.log((first + 0.5) / _PRIME))
    return size * ca.cos(2 * math.pi * (second + 0.5) / _PRIME)


@final
class Readings:
    """Sensors of one plant.

    Parameters
    ----------
    declare : callable
        ``(name, unit, start, description, low)`` declares a tunable parameter and gives its symbol.
    clock : expression
        Time since the start [s].
    sample_time : float
        Time for which a value of the noise holds [s].
    """

    def __init__(self, declare: Declare, clock: Any, sample_time: float) -> None:
        self._declare, self._clock = declare, clock + 1e-3 * sample_time  # rounding of the clock
        self._sample = ca.floor(clock / sample_time + 0.5)
        self._seed = declare("sensor.seed", "", 1.0, "Seed of the noise, a whole number.", 0.0)
        self._count = 0

    def read(self, variable: Variable, value: Any) -> tuple[Variable, Any]:
        """Lay noise, quantisation and the fault of one sensor over a channel.

        From ``fault_start`` to ``fault_stop`` the reading is gain times itself plus bias plus
        drift; a gain of 0 is a sensor that stands still at the bias. From ``dropout_start`` on it
        is NaN.
        """
        self._count += 1
        name, unit = variable.name, variable.unit
        noisy = self._declare(f"{name}.noise", unit, 0.0, "Standard deviation of the noise.", 0.0)
        quantum = self._declare(
            f"{name}.quantum", unit, 0.0, "Step of the quantisation, 0 for none.", 0.0
        )
        start = self._declare(
            f"{name}.fault_start", "s", NEVER, "Time at which the fault begins.", None
        )
        stop = self._declare(
            f"{name}.fault_stop", "s", NEVER, "Time at which the fault ends.", None
        )
        gain = self._declare(f"{name}.fault_gain", "", 1.0, "Gain while the fault lasts.", None)
        bias = self._declare(f"{name}.fault_bias", unit, 0.0, "Offset while the fault lasts.", None)
        drift = self._declare(
            f"{name}.fault_drift", f"{unit}/s", 0.0, "Drift while the fault lasts.", None
        )
        lost = self._declare(
            f"{name}.dropout_start", "s", NEVER, "Time from which the reading is NaN.", None
        )
        t = self._clock
        read = value + noisy * noise(self._sample, self._seed, self._count)
        faulty = ca.logic_and(t >= start, t < stop)
        read = ca.if_else(faulty, gain * read + bias + drift * (t - start), read)
        read = ca.if_else(
            quantum > 0, quantum * ca.floor(read / ca.fmax(quantum, 1e-300) + 0.5), read
        )
        return variable, ca.if_else(t >= lost, math.nan, read)
