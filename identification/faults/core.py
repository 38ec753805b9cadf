"""Numerical core of the fault detector: one CasADi function per sample, an observer with rows
that can be dropped.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]

SENSORS: Final = (
    "current",
    "motor_position",
    "motor_velocity",
    "link_position",
    "link_velocity",
    "torque",
)
"""Order of the readings. `current` is n Km I, the drive torque referred to the link [N.m]."""
CURRENT, MOTOR_POSITION, MOTOR_VELOCITY, LINK_POSITION, LINK_VELOCITY, TORQUE = range(6)

NOISE: Final[Mapping[str, float]] = {
    "current": 0.02,
    "motor_position": 1.745e-5,
    "motor_velocity": 1e-3,
    "link_position": 6.283e-5,
    "link_velocity": 1e-3,
    "torque": 0.05,
}
"""Standard deviations of the readings. Positions and torque: table B.1 of the thesis (motor hall
sensor 0.0010 deg, link encoder 0.0036 deg, torque sensor 50 mNm); current: 15 bit over about 650
N.m; velocities are not printed there and are assumed."""

ABSURD: Final = 1e9
"""A reading beyond this (SI) counts as missing, as NaN and infinity do."""
OPEN: Final = 1e9
"""Gate of an innovation that is taken whole: beyond every reading."""
DISTURBANCE: Final = (50.0, 15.0)
"""Random walk of the unknown torque on motor and link that the observer allows [N.m/sqrt(s)]."""
FADING: Final = 0.99999
"""Factor of a sample by which what no reading shows fades in the design of a gain."""
DOUBLINGS: Final = 60
SETTLED: Final = 1e-14
SOLVED: Final = 1e-6
"""Doublings of the number of samples at most, the relative change at which they have settled, and
the error up to which a solution by eigenvalues is taken without them."""
FADING_OF_TORQUE: Final = 0.999
"""The same where the torque alone is read, which shows no position and, of a joint without
friction, no velocity: with less the equation has roots on the unit circle."""
GATE: Final = 5.0
"""Innovations are cut at this many standard deviations, so that a faulty reading moves the
estimate little.
"""


def steady_covariance(a: FloatArray, c: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
    """Covariance that a Kalman filter comes to before its update.

    By eigenvalues, and where these lie too near to the unit circle by doubling: angles that no
    reading shows fade by 1e-5 in a sample. Of both the one that solves the equation better.

    Parameters
    ----------
    a, c : (n, n), (m, n) array
        Transition and readings.
    q, r : (n,), (m,) array
        Variances of the process in a sample and of the readings, all positive.

    Returns
    -------
    (n, n) array
    """
    from scipy.linalg import solve_discrete_are

    found: list[tuple[float, FloatArray]] = []
    with contextlib.suppress(np.linalg.LinAlgError, ValueError):
        p = solve_discrete_are(a.T, c.T, np.diag(q), np.diag(r))
        found.append((_off(p, a, c, q, r), p))
    if not found or not found[0][0] < SOLVED:
        p = doubled(a, c, q, r)
        found.append((_off(p, a, c, q, r), p))
    return min(found, key=lambda one: one[0])[1]


def doubled(a: FloatArray, c: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
    """As :func:`steady_covariance`, by doubling (Anderson, Int. J. Control 28, 1978): each step
    does the work of all samples before it, and adds only what is positive. Where a covariance is
    many times what a sample adds to it, rounding ends that: the best one of the way is taken.
    """
    units, size = np.sqrt(q), len(q)
    forward = (a * np.outer(1.0 / units, units)).T
    readings = c * units / np.sqrt(r)[:, None]
    seen, found, unit = readings.T @ readings, np.eye(size), np.eye(size)
    best: tuple[float, FloatArray] = (math.inf, np.diag(q))
    with contextlib.suppress(np.linalg.LinAlgError):
        for _ in range(DOUBLINGS):
            reduced = np.linalg.solve(unit + seen @ found, np.hstack([forward, seen]))
            change = forward.T @ found @ reduced[:, :size]
            seen = seen + forward @ reduced[:, size:] @ forward.T
            forward = forward @ reduced[:, :size]
            found = found + change
            seen, found = (seen + seen.T) / 2, (found + found.T) / 2
            if not (np.isfinite(found).all() and (np.diag(found) > 0).all()):
                break
            tried = np.asarray(found * np.outer(units, units), dtype=np.float64)
            best = min(best, (_off(tried, a, c, q, r), tried), key=lambda one: one[0])
            if np.max(np.abs(change) / _sizes(found)) < SETTLED:
                break
    return best[1]


def _sizes(p: FloatArray) -> FloatArray:
    """Products of the standard deviations of a covariance."""
    deviations = np.sqrt(np.diag(p))
    return np.outer(deviations, deviations)


def _off(p: FloatArray, a: FloatArray, c: FloatArray, q: FloatArray, r: FloatArray) -> float:
    """Share by which a covariance is another one a sample later; infinite for one that is none, or
    whose filter is not stable.
    """
    if not np.isfinite(p).all() or not (np.diag(p) > 0).all():
        return math.inf
    gain = p @ c.T @ np.linalg.inv(c @ p @ c.T + np.diag(r))
    kept = a @ (np.eye(len(q)) - gain @ c)
    if not np.max(np.abs(np.linalg.eigvals(kept))) < 1.0:
        return math.inf
    return float(np.max(np.abs(kept @ p @ a.T + np.diag(q) - p) / _sizes(p)))


@final
class ObserverCore:
    """One sample of the observer and what the residuals need of it.

    State: that of the joint (motor and link position and velocity, memory), then the unknown
    torques on motor and link. :meth:`advance` reads `readings`, `used` and the gain, and fills
    `out`: [state after prediction | the six readings, failed ones replaced | innovations of
    readings 1 to 5 | motor and link acceleration as the torque reading says | torque as the
    position readings say | estimates of readings 1 to 5].
    """

    def __init__(
        self, model: JointModel, dt: float, noise: Mapping[str, float], *, has_torque: bool
    ) -> None:
        if not model.is_elastic:
            raise InputError(
                "FaultDetector: the model is rigid; it needs motor and link apart "
                "(transmission_compliance)"
            )
        self.model, self.dt, self.has_torque = model, dt, has_torque
        self.noise = np.array([noise[n] for n in SENSORS])
        f = model.functions
        self.size = len(f.state_names) + len(f.memory_names) + 2
        self._values = np.array(model.value_vector())
        self._substeps = self._choose_substeps()
        self.link_gain, self.motor_gain = self._link_gain(), self._motor_gain()
        self._step, self.function = self._symbolic()
        self.torque_deviation = max(float(noise["torque"]), 1.0)
        self._gains: dict[tuple[bool, ...], FloatArray] = {}
        self.state = np.zeros(self.size)
        self.readings = np.zeros(6)
        self.used = np.ones(6)
        self.gain = np.zeros((5, self.size))
        self.gate = np.zeros(5)
        self.out = np.zeros(self.function.size1_out(0))
        self._buffer, self._trigger = self.function.buffer()
        for i, item in enumerate((self.state, self.readings, self.used, self.gain, self.gate)):
            self._buffer.set_arg(i, item.data)
        self._buffer.set_res(0, self.out.data)
        self.set_used((True,) * 5 + (has_torque,))

    def _choose_substeps(self) -> int:
        """Runge-Kutta steps per sample that keep friction's steep start at zero velocity stable."""
        size = self.size - 2
        slopes = np.array(self.model.jacobian(np.zeros(size), np.zeros(3), self._values)[0])
        fastest = float(np.max(np.abs(np.linalg.eigvals(slopes))))
        return min(20, max(1, math.ceil(fastest * self.dt / 1.5)))

    def _symbolic(self) -> tuple[Any, Any]:
        import casadi as ca

        f, p, size = self.model.functions, ca.DM(self._values), self.size - 2
        z, w, u = ca.SX.sym("z", size), ca.SX.sym("w", 2), ca.SX.sym("u")
        inputs = ca.vertcat(u + w[0], 0, 0)
        link_gain, motor_gain = self.link_gain, self.motor_gain
        moved = z
        for _ in range(self._substeps):
            moved = f.step(moved, inputs, p, self.dt / self._substeps)
            moved = ca.vertcat(
                moved[:3], moved[3] + w[1] * link_gain * self.dt / self._substeps, moved[4:]
            )
        step = ca.Function("predict", [z, w, u], [moved])
        x, y = ca.SX.sym("x", size + 2), ca.SX.sym("y", 6)
        used, gate = ca.SX.sym("used", 6), ca.SX.sym("gate", 5)
        gain = ca.SX.sym("gain", size + 2, 5)
        none = ca.SX.zeros(3, 1)

        def seen(state: Any) -> Any:
            return f.outputs(state[:size], none, p)

        innovation = y[1:] - seen(x)
        cut = ca.fmax(-gate, ca.fmin(gate, innovation))
        after = x + gain @ cut
        estimate = seen(after)
        rates = f.dynamics(after[:size], none, p)
        hold = -rates[1] / motor_gain  # drive that keeps the motor's speed
        drive = used[0] * y[0] + (1 - used[0]) * hold
        filled = used[1:] * y[1:] + (1 - used[1:]) * estimate
        at = ca.vertcat(filled[0], after[1], filled[2], after[3], after[4:size])
        sprung = seen(ca.vertcat(at, 0, 0))[4]
        carried = filled[4] if self.has_torque else sprung
        motor = rates[1] + motor_gain * (drive + estimate[4] - carried)
        link = rates[3] + link_gain * (carried - estimate[4])
        following = ca.vertcat(step(after[:size], after[size:], drive), after[size:])
        out = ca.vertcat(
            *(
                following,
                drive + (1 - used[0]) * after[size],
                filled,
                innovation,
                motor,
                link,
                sprung,
                estimate,
            ),
        )
        return step, ca.Function("sample", [x, y, used, gain, gate], [ca.densify(out)])

    def _motor_gain(self) -> float:
        """d motor acceleration / d drive [1/(kg m2)]."""
        size = self.size - 2
        return float(self.model.jacobian(np.zeros(size), np.zeros(3), self._values)[1][1, 0])

    @property
    def stiffness(self) -> float:
        """Linear stiffness of the transmission [N.m/rad]."""
        name = self.model.stiffness_name
        return float(self._values[self.model.parameter_names.index(name)]) if name else 1e4

    def _link_gain(self) -> float:
        """d link acceleration / d torque on the link [1/(kg m2)]."""
        names = self.model.parameter_names
        return 1.0 / float(self._values[names.index("link_inertia")])

    def set_used(self, used: tuple[bool, ...]) -> None:
        """Choose the rows in use (six flags); the gain of the others is zero."""
        rows = used[1:]
        if rows not in self._gains:
            self._gains[rows] = self._design(rows)
        self.used[:] = used
        self.gain[:] = self._gains[rows]
        deviations = self.noise[1:].copy()
        deviations[4] = self.torque_deviation
        innovation = deviations.copy()
        innovation[1] *= 3.0
        innovation[3] *= 3.0
        self.gates = GATE * innovation
        self.gate[:] = self.gates

    def open_gates(self, is_open: bool) -> None:
        """Take innovations whole (after a replacement, so that the estimate settles), or cut
        them again.
        """
        self.gate[:] = OPEN if is_open else self.gates

    def tune(self, torque_deviation: float) -> None:
        """Take the deviation of torque reading less spring torque from healthy data; gains
        follow.
        """
        self.torque_deviation = torque_deviation
        self._gains.clear()
        self.set_used(tuple(bool(v) for v in self.used))

    def _design(self, rows: tuple[bool, ...]) -> FloatArray:
        """Steady Kalman gain of the rows in use, (5, size): linearised at a slow motion under
        load.
        """
        size = self.size - 2
        at = np.zeros(size)
        at[[0, 1, 2, 3]] = (1e-3, 0.3, 0.0, 0.3)
        a = np.eye(size + 2)
        base = np.array(self._step(at, np.zeros(2), 0.0)).ravel()
        for i in range(size + 2):
            eps = 1e-6 if i < size else 1e-3
            z, w = at.copy(), np.zeros(2)
            if i < size:
                z[i] += eps
            else:
                w[i - size] += eps
            a[:size, i] = (np.array(self._step(z, w, 0.0)).ravel() - base) / eps
        c = np.zeros((5, size + 2))
        c[[0, 1, 2, 3], [0, 1, 2, 3]] = 1.0
        outputs = self.model.functions.outputs
        for i in range(4):
            z = at.copy()
            z[i] += 1e-6
            c[4, i] = float(
                (
                    outputs(z, np.zeros(3), self._values)[4]
                    - outputs(at, np.zeros(3), self._values)[4]
                )
                / 1e-6
            )
        keep = [i for i in range(5) if rows[i]]
        if not keep:
            return np.zeros((5, size + 2))
        deviations = self.noise[1:].copy()
        deviations[4] = self.torque_deviation
        q = np.zeros(size + 2)
        q[:4] = np.array([1e-12, 1e-10, 1e-12, 1e-10]) * self.dt
        q[4:size] = 1e-12
        q[size:] = np.square(DISTURBANCE) * self.dt
        if not any(rows[2:]):
            q[size + 1] = 0.0  # nothing on the link is measured: its unknown torque cannot be seen
        kept = c[keep]
        r = np.diag(deviations[keep] ** 2)
        active = [*range(4), size, size + 1]
        sub = np.ix_(active, active)
        fading = FADING if any(rows[:4]) else FADING_OF_TORQUE
        p = steady_covariance(fading * a[sub], kept[:, active], q[active] + 1e-14, np.diag(r))
        k = p @ kept[:, active].T @ np.linalg.inv(kept[:, active] @ p @ kept[:, active].T + r)
        gain = np.zeros((5, size + 2))
        gain[np.ix_(keep, active)] = k.T
        return gain

    def advance(self) -> list[float]:
        """One sample; the state moves on. Gives `out` as a list."""
        self._trigger()
        self.state[:] = self.out[: self.size]
        return self.out.tolist()  # type: ignore[no-any-return]

    def start(self, readings: FloatArray) -> None:
        """Begin at the readings."""
        self.state[:] = 0.0
        good = np.nan_to_num(readings)
        self.state[:4] = good[1:5]
