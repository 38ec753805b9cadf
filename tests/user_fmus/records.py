"""Records of the plants whose models are the test FMUs, integrated here and read with noise."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from identification.data.record import Record

FloatArray = npt.NDArray[np.float64]
TRUTH: Final = {"inertia": 2.5, "viscous": 0.7, "coulomb": 1.6, "gravity": 6.0}
"""Of the axis and of the servo."""
MATRICES: Final = {"A[2,1]": -9.0, "A[2,2]": -0.8, "B[2,1]": 1.5}
"""Of the state space, where it differs from the start values of its FMU."""

GRAVITY: Final = 9.5
"""Of the ball [m/s2]."""


def van_der_pol(mu: float, noise: float = 1e-3, seed: int = 0) -> Record:
    from scipy.integrate import solve_ivp

    t = np.arange(0, 8, 0.02)
    x = solve_ivp(
        lambda _t, x: [x[1], mu * (1 - x[0] ** 2) * x[1] - x[0]],
        (0, 8),
        [2, 0],
        "DOP853",
        t,
        rtol=1e-11,
        atol=1e-12,
    ).y
    x = x + noise * np.random.default_rng(seed).standard_normal(x.shape)
    return Record.from_channels(
        t, {"motor_position": x[0], "motor_velocity": x[1]}, name="van der Pol"
    )


def dahlquist(k: float, noise: float = 1e-4, seed: int = 1) -> Record:
    t = np.arange(0, 4, 0.01)
    return Record.from_channels(
        t,
        {
            "motor_position": np.exp(-k * t)
            + noise * np.random.default_rng(seed).standard_normal(len(t))
        },
        name="Dahlquist",
    )


def swing(t: FloatArray) -> FloatArray:
    return np.asarray(
        0.8 * np.sin(1.9 * t) + 0.3 * np.sin(6.9 * t + 1) - 0.3 * np.sin(1) + 0.15 * np.sin(0.7 * t)
    )


def axis(
    hidden: Callable[[float, float], float] = lambda _q, _w: 0.0,
    seconds: float = 8.0,
    h: float = 2e-3,
    noise: float = 1e-5,
    seed: int = 2,
    motion: Callable[[FloatArray], FloatArray] = swing,
) -> Record:
    """An axis under a controller, integrated here: its torque is held between samples."""
    t = h * np.arange(round(seconds / h))
    reference, rate = motion(t), np.gradient(motion(t), h)

    def slope(q: float, w: float, u: float) -> tuple[float, float]:
        resist = (
            TRUTH["viscous"] * w
            + TRUTH["coulomb"] * math.tanh(w / 0.01)
            + TRUTH["gravity"] * math.sin(q)
        )
        return w, (u - resist - hidden(q, w)) / TRUTH["inertia"]

    q, w = 0.0, float(rate[0])
    rows, s = np.empty((len(t), 2)), h / 4
    for k in range(len(t)):
        u = 400 * (reference[k] - q) + 60 * (rate[k] - w)
        rows[k] = q, u
        for _ in range(4):
            a = slope(q, w, u)
            b = slope(q + s / 2 * a[0], w + s / 2 * a[1], u)
            c = slope(q + s / 2 * b[0], w + s / 2 * b[1], u)
            d = slope(q + s * c[0], w + s * c[1], u)
            q += s / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
            w += s / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
    read = rows[:, 0] + noise * np.random.default_rng(seed).standard_normal(len(t))
    return Record.from_channels(
        t, {"motor_position": read, "motor_torque": rows[:, 1]}, name="axis"
    )


def state_space(seed: int = 3, noise: float = 1e-3) -> Record:
    """x' = A x + B u, y = x, its input held between samples."""
    from scipy.linalg import expm

    h = 0.01
    t = h * np.arange(800)
    whole = np.zeros((3, 3))
    whole[0, 1] = 1.0
    whole[1] = MATRICES["A[2,1]"], MATRICES["A[2,2]"], MATRICES["B[2,1]"]
    step = expm(h * whole)[:2]
    u = np.sign(np.sin(1.3 * t)) + 0.5 * np.sin(4.1 * t)
    x = np.zeros((len(t), 2))
    for k in range(len(t) - 1):
        x[k + 1] = step @ [*x[k], u[k]]
    read = x + noise * np.random.default_rng(seed).standard_normal(x.shape)
    return Record.from_channels(
        t,
        {"motor_position": read[:, 0], "motor_velocity": read[:, 1], "motor_torque": u},
        name="state space",
    )


def ball(seed: int = 0, noise: float = 1e-3) -> Record:
    """A ball that falls from 1 m and keeps .7 of its speed at a bounce; between them it flies."""
    t = 0.01 * np.arange(200)
    rows, height, speed, begun = np.empty((len(t), 2)), 1.0, 0.0, 0.0
    for k, now in enumerate(t.tolist()):
        while True:
            lands = (speed + math.sqrt(speed**2 + 2 * GRAVITY * height)) / GRAVITY
            if begun + lands > now:
                break
            begun, height, speed = begun + lands, 0.0, 0.7 * (GRAVITY * lands - speed)
        s = now - begun
        rows[k] = height + speed * s - GRAVITY / 2 * s**2, speed - GRAVITY * s
    read = rows + noise * np.random.default_rng(seed).standard_normal(rows.shape)
    return Record.from_channels(
        t, {"motor_position": read[:, 0], "motor_velocity": read[:, 1]}, name="ball"
    )
