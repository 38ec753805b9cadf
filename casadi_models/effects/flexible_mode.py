"""Flexible mode: an extra mass on motor or link, held by a spring and a damper.

States: deflection of the spring y, velocity w of the extra mass. While the joint moves evenly the
oscillator has a closed solution, so the step form holds for any step.
"""

import math
from types import SimpleNamespace

import casadi as ca

from ..effect import effect
from ..parameter import amplitude, shape
from ..signals import Expression, LocalSignals


def _oscillator(
    z: tuple[Expression, ...], step: Expression, s: LocalSignals, p: SimpleNamespace
) -> tuple[Expression, ...]:
    speed, deflection = step / s.clock, z[0]
    sliding = speed - z[1]
    omega = 2 * math.pi * p.flexible_frequency
    decay = p.flexible_damping * omega
    damped = omega * ca.sqrt(1 - p.flexible_damping**2)
    envelope = ca.exp(-decay * s.clock)
    cosine, sine = ca.cos(damped * s.clock), ca.sin(damped * s.clock) / damped
    after = envelope * (cosine * deflection + sine * (sliding + decay * deflection))
    sliding_after = envelope * (cosine * sliding - sine * (decay * sliding + omega**2 * deflection))
    return after, speed - sliding_after


def _rate(z: tuple[Expression, ...], s: LocalSignals, p: SimpleNamespace) -> tuple[Expression, ...]:
    return s.velocity - z[1], _acceleration(z, s, p)


def _acceleration(z: tuple[Expression, ...], s: LocalSignals, p: SimpleNamespace) -> Expression:
    omega = 2 * math.pi * p.flexible_frequency
    return omega**2 * z[0] + 2 * p.flexible_damping * omega * (s.velocity - z[1])


@effect(
    "flexible_mode",
    title="flexible mode",
    family="inertia",
    acts_on=("link", "motor"),
    parameters=(
        amplitude("flexible_inertia", "kg.m2", "inertia of the extra mass", typical=1.5),
        shape(
            "flexible_frequency",
            "Hz",
            "frequency of the extra mass with the joint held",
            (5.0, 8.0, 12.0, 18.0, 27.0, 40.0),
            "absolute",
            start=12.0,
            low=0.1,
            high=1e4,
        ),
        shape(
            "flexible_damping",
            "1",
            "damping ratio of the extra mass with the joint held",
            (0.01, 0.03, 0.1),
            "absolute",
            start=0.03,
            low=1e-6,
            high=0.99,
        ),
    ),
    stage="late",
    absence="a peak in the spectrum of the residual at one frequency, whatever the speed",
    excitation="fast corners, or a chirp through the frequency",
    source="field knowledge (linear oscillator)",
    memory=_oscillator,
    rate=_rate,
    states=2,
    dissipative=True,
    confused_with=("extra_inertia", "structural_damping"),
    separate_by="a chirp through the frequency, link acceleration recorded",
)
def flexible_mode(s: LocalSignals, p: SimpleNamespace) -> Expression:
    """Torque that accelerates the extra mass."""
    return p.flexible_inertia * _acceleration(s.memory, s, p)
