"""A simulated joint as a linear regression, for tests and benchmarks of the recursive least
squares.

Plant: the parameters of thesis table 4.3 (model 2b) with the inertias and load of table 4.1; sensor
noise of table B.1. As in 4.3.3, Coulomb friction on the link side is left out: it is negligible.
Nothing here is measured data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

NAMES = ("k1", "k2", "ka", "coulomb_motor", "viscous_motor", "viscous_link")
THETA = np.array([2.1513e4, 3.3543e8, 86.2313, 21.5057, 23.6303, 9.7285])
SCALE = np.array([2e4, 5e8, 1e2, 3e1, 3e1, 1e1])  # prior ranges
MOTOR_INERTIA, LINK_INERTIA, LOAD = (
    4.447,
    10.277,
    105.18,
)  # kg m^2, kg m^2, N m; link side, table 4.1
SIGN_WIDTH = 0.02  # rad/s, of the smoothed sign of the velocity
ENCODER, HALL, TORQUE = np.deg2rad(0.0036), np.deg2rad(0.0010), 0.05  # resolutions of table B.1


@final
@dataclass(frozen=True)
class JointRecord:
    """y (samples, 2): motor and link torque, N m, link side; h (samples, 2, 6); truth (samples,
    6).
    """

    time: FloatArray
    y: FloatArray
    h: FloatArray
    truth: FloatArray


def simulate(
    *,
    seconds: float = 80.0,
    rate: float = 1000.0,
    standstill: tuple[float, float] = (30.0, 50.0),
    step_at: float = 60.0,
    step: float = 1.3,
    stiction: float = 0.0,
    quick: float = 0.05,
    cutoff: float = 15.0,
    seed: int = 0,
) -> JointRecord:
    """Motion, standstill, motion; all parameters times `step` at `step_at`.

    Parameters
    ----------
    stiction
        Torque on the motor side during the standstill that the regressor cannot explain, N m.
    quick
        Amplitude of the part of the trajectory with 0.5 s period (thesis 3.8: periods 0.5 to 6 s),
        rad.
    cutoff
        Corner of the fourth-order filter on both sides of the regression, Hz.
    """
    rng = np.random.default_rng(seed)
    dt = 1.0 / rate
    lead = round(rate)  # one second that the filter settles in
    time = (np.arange(-lead, round(seconds * rate))) * dt
    link, velocity, acceleration = _motion(time, standstill, quick)
    truth = np.where(time[:, None] < step_at, 1.0, step) * THETA
    carried = LINK_INERTIA * acceleration + LOAD * np.sin(link) + truth[:, 5] * velocity
    twist, twist_rate = _twist(carried, truth, dt)
    motor, motor_velocity = link + twist, velocity + twist_rate
    motor_acceleration = acceleration + np.gradient(twist_rate, dt)
    drive = (
        MOTOR_INERTIA * motor_acceleration
        + carried
        + truth[:, 3] * np.tanh(motor_velocity / SIGN_WIDTH)
        + truth[:, 4] * motor_velocity
    )
    still = (time >= standstill[0] + 1.0) & (time < standstill[1])
    drive = drive + stiction * still
    root = np.sqrt(12.0)  # uniform quantisation noise
    seen_motor = motor + HALL / root * rng.standard_normal(time.size)
    seen_link = link + ENCODER / root * rng.standard_normal(time.size)
    seen_drive = drive + TORQUE * rng.standard_normal(time.size)
    net = LINK_INERTIA * acceleration + LOAD * np.sin(link)
    seen_torque = net + TORQUE * rng.standard_normal(time.size)
    y, h = _regression(seen_motor, seen_link, seen_drive, seen_torque, dt)
    # Both sides of the regression pass the same filter (thesis 4.3.1), so the equation stays true.
    return JointRecord(
        time[lead:], _filtered(y, cutoff, dt)[lead:], _filtered(h, cutoff, dt)[lead:], truth[lead:]
    )


def _motion(
    time: FloatArray, standstill: tuple[float, float], quick: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Link angle of three sines whose phase runs with a speed that falls smoothly to zero for
    the standstill.
    """
    dt = float(time[1] - time[0])
    ramp = np.clip(np.minimum(np.abs(time - standstill[0]), np.abs(time - standstill[1])), 0.0, 1.0)
    speed = np.where(
        (time > standstill[0]) & (time < standstill[1]), 0.0, 0.5 - 0.5 * np.cos(np.pi * ramp)
    )
    phase = np.cumsum(speed) * dt
    link = (
        0.7 * np.sin(2.1 * phase)
        + 0.25 * np.sin(5.3 * phase + 0.4)
        + quick * np.sin(4.0 * np.pi * phase)
    )
    velocity = np.gradient(link, dt)
    return link, velocity, np.gradient(velocity, dt)


def _twist(carried: FloatArray, truth: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """k1 q + k2 q^3 + ka q' = carried torque, implicit Euler."""
    twist = np.empty_like(carried)
    now = carried[0] / truth[0, 0]
    for k in range(carried.size):
        k1, k2, ka = truth[k, :3]
        before = now
        for _ in range(4):
            balance = k1 * now + k2 * now**3 + ka * (now - before) / dt - carried[k]
            now -= balance / (k1 + 3.0 * k2 * now**2 + ka / dt)
        twist[k] = now
    return twist, np.gradient(twist, dt)


def _filtered(signal: FloatArray, cutoff: float, dt: float) -> FloatArray:
    """Causal fourth-order Butterworth filter along time, started at rest."""
    from scipy.signal import butter, sosfilt, sosfilt_zi

    sections = butter(4, 2.0 * cutoff * dt, output="sos")
    rest = sosfilt_zi(sections)
    start = rest.reshape(*rest.shape, *([1] * (signal.ndim - 1))) * signal[0]
    found: FloatArray = sosfilt(sections, signal, axis=0, zi=start)[0]
    return found


def _regression(
    motor: FloatArray, link: FloatArray, drive: FloatArray, torque: FloatArray, dt: float
) -> tuple[FloatArray, FloatArray]:
    """Both torque balances, linear in the parameters."""
    motor_velocity, link_velocity = np.gradient(motor, dt), np.gradient(link, dt)
    twist, twist_rate = motor - link, motor_velocity - link_velocity
    h = np.zeros((motor.size, 2, THETA.size))
    for row in range(2):
        h[:, row, 0], h[:, row, 1], h[:, row, 2] = twist, twist**3, twist_rate
    h[:, 0, 3], h[:, 0, 4] = np.tanh(motor_velocity / SIGN_WIDTH), motor_velocity
    h[:, 1, 5] = -link_velocity
    return np.stack([drive - MOTOR_INERTIA * np.gradient(motor_velocity, dt), torque], axis=1), h
