"""Simulated records for the reproduction: motions, readings, both sides of the regression,
least squares.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel, thesis
from identification.data.prepare import central_difference, filter_alike
from identification.faults.detector import NOISE
from identification.planning.follow import Followed
from identification.planning.trajectories import Experiment, Motion, sinusoidal, triangular

FloatArray = npt.NDArray[np.float64]

DT: Final = 1e-3
"""Sample time [s]."""
ENDS: Final = 500
"""Samples left out at both ends of a filtered record."""
SPRINGS: Final = ("stiffness", "cubic_stiffness", "motor_added_spring")
MODEL_2B: Final = (*SPRINGS, "motor_coulomb", "motor_viscous", "link_coulomb", "link_viscous")
"""Parameters of table 4.3, in its order."""
SMOOTHING: Final = 5e-3
"""Velocity over which the sign of the velocity is smoothed [rad/s]."""


@final
@dataclass(frozen=True)
class Sides:
    """Both sides of y = phi theta: motor balance and link balance.

    Attributes
    ----------
    y : (n, 2) array
        Motor torque less the inertia's part, and load torque [N.m].
    phi : (n, 2, parameters) array
    names : tuple of str
    """

    y: FloatArray
    phi: FloatArray
    names: tuple[str, ...]

    def only(self, *names: str) -> Sides:
        """The same record with fewer columns."""
        return Sides(self.y, self.phi[:, :, [self.names.index(n) for n in names]], names)

    def solve(self, rows: Sequence[int] = (0, 1)) -> dict[str, float]:
        """Least squares with scaled columns; `rows`: which of the two balances."""
        matrix = self.phi[:, rows].reshape(-1, len(self.names))
        scale = np.linalg.norm(matrix, axis=0)
        scale[scale == 0] = 1.0
        found = np.linalg.lstsq(matrix / scale, self.y[:, rows].reshape(-1), rcond=None)[0] / scale
        return dict(zip(self.names, found.tolist(), strict=True))

    def model(self, values: dict[str, float]) -> FloatArray:
        """phi theta, (n, 2)."""
        found: FloatArray = self.phi @ np.array([values[n] for n in self.names])
        return found

    def vaf(self, values: dict[str, float]) -> FloatArray:
        """Variance accounted for (4.2) of each balance [%]."""
        found: FloatArray = 100.0 * (
            1.0 - np.var(self.y - self.model(values), axis=0) / np.var(self.y, axis=0)
        )
        return found

    def error(self, values: dict[str, float]) -> FloatArray:
        """Norm of the error over the norm of y, each balance [%]."""
        left = np.linalg.norm(self.y - self.model(values), axis=0)
        found: FloatArray = 100.0 * left / np.linalg.norm(self.y, axis=0)
        return found


def times(count: int, first: float = 0.0) -> FloatArray:
    """Sample times [s]."""
    return first + np.arange(count, dtype=np.float64) * DT


def joined(parts: Sequence[Sides]) -> Sides:
    """Several records as one."""
    return Sides(
        np.concatenate([p.y for p in parts]), np.concatenate([p.phi for p in parts]), parts[0].names
    )


def motions() -> list[Motion]:
    """Six motions of section 3.8 of 15 s: the families of the thesis's twelve."""
    d = math.radians
    return [
        triangular(d(25), limit=d(35), reversal=0.15, duration=15.0),
        triangular(d(15), limit=d(50), reversal=0.1, duration=15.0),
        triangular(d(45), limit=d(60), reversal=0.2, duration=15.0),
        sinusoidal(d(25), 4.0, hold=1.0, duration=15.0),
        sinusoidal(d(40), 2.0, hold=0.5, duration=15.0),
        sinusoidal(d(15), 1.0, hold=2.0, duration=15.0),
    ]


@cache
def joint_2b() -> Experiment:
    """Model 2b with tables 4.1 and 4.3; its added spring acts on the motor."""
    model = thesis.model_2b().with_values(
        {"motor_smoothing_velocity": SMOOTHING, "link_smoothing_velocity": SMOOTHING}
    )
    return Experiment(model, parameters=model.linear_parameters, stride=1, dt=DT)


def as_printed(run: Followed, model: JointModel) -> Followed:
    """The same motion of the link in a joint whose added spring stands in both rows, as (4.17)
    prints it.

    The gear carries T = k1 d + k2 d^3 - ka qm: with input and output turning in opposite senses the
    printed + ka theta_in takes load off the spring. The motor moves as the torsion demands. The law
    has no potential, so it is no joint model of the project; it is here because the thesis's own
    numbers follow from it.
    """
    v = model.values
    link, speed = run.states[:, 2], run.states[:, 3]
    resistance = v["link_viscous"] * speed + v["link_coulomb"] * np.tanh(
        speed / v["link_smoothing_velocity"]
    )
    carried = load_torque(run, model) + resistance
    k1, k2, ka = (v[n] for n in SPRINGS)
    torsion = (carried + ka * link) / k1
    for _ in range(30):
        torsion -= (k1 * torsion + k2 * torsion**3 - ka * (link + torsion) - carried) / (
            k1 + 3 * k2 * torsion**2 - ka
        )
    motor = link + torsion
    rate = speed + central_difference(torsion, DT)
    acceleration = run.accelerations[:, 1] + central_difference(central_difference(torsion, DT), DT)
    friction = v["motor_viscous"] * rate + v["motor_coulomb"] * np.tanh(
        rate / v["motor_smoothing_velocity"]
    )
    drive = v["motor_inertia"] * acceleration + carried + friction
    states = np.column_stack([motor, rate, link, speed])
    return Followed(
        run.time, drive, states, np.column_stack([acceleration, run.accelerations[:, 1]]), carried
    )


def load_torque(run: Followed, model: JointModel) -> FloatArray:
    """Jout q'' - Tg sin q: what the torque sensor on the load reads (4.14) [N.m]."""
    v = model.values
    found: FloatArray = v["link_inertia"] * run.accelerations[:, 1] - v["gravity_torque"] * np.sin(
        run.states[:, 2]
    )
    return found


def measured(run: Followed, model: JointModel, seed: int) -> Followed:
    """Readings with the noise of table B.1; accelerations are differences, `torque` is the
    load's (4.14).
    """
    rng = np.random.default_rng(seed)
    levels = [
        NOISE[n] for n in ("motor_position", "motor_velocity", "link_position", "link_velocity")
    ]
    states = run.states + rng.normal(size=run.states.shape) * levels
    drive = run.drive + rng.normal(0.0, NOISE["current"], len(run.time))
    load = load_torque(run, model) + rng.normal(0.0, NOISE["torque"], len(run.time))
    return Followed(run.time, drive, states, central_difference(states[:, [1, 3]], DT), load)


def zero_phase(values: FloatArray) -> FloatArray:
    """The thesis's filter, both ways: Butterworth, order 8, 15 Hz (4.3.1)."""
    return filter_alike(values, dt=DT)[0]


def regression(
    experiment: Experiment,
    seen: Followed,
    names: Sequence[str] = MODEL_2B,
    *,
    both_rows: bool = False,
    smooth: Callable[[FloatArray], FloatArray] = zero_phase,
) -> Sides:
    """y = phi theta from readings, all terms filtered alike; columns from the joint model's own
    equations.

    Parameters
    ----------
    experiment : Experiment
        With all linear parameters, every sample a row.
    seen : Followed
        From :func:`measured`.
    names : sequence of str
        Columns; all other linear parameters count as known but the link's inertia and gravity,
        which are in the load.
    both_rows : bool
        The added spring in both rows, as printed in (4.17), instead of on the motor.
    smooth : callable
        Filter along the first axis.
    """
    full, known = experiment.matrix(seen), experiment.model.values
    at = {n: i for i, n in enumerate(experiment.parameters)}
    phi = full[:, :, [at[n] for n in names]]
    if both_rows:
        phi[:, :, list(names).index("motor_added_spring")] = np.column_stack(
            [-seen.states[:, 0], seen.states[:, 0]]
        )
    rest = [n for n in at if n not in names and n not in ("link_inertia", "gravity_torque")]
    given = full[:, :, [at[n] for n in rest]] @ np.array([known[n] for n in rest])
    y = np.column_stack([seen.drive, -seen.torque]) - given
    flat = smooth(np.column_stack([y, phi.reshape(len(y), -1)]))[ENDS:-ENDS]
    phi = flat[:, 2:].reshape(-1, 2, len(names))
    return Sides(np.column_stack([flat[:, 0], -flat[:, 1]]), phi * [[[1.0], [-1.0]]], tuple(names))


@cache
def batch(both_rows: bool) -> tuple[Sides, ...]:
    """The six motions of a joint with table 4.3, read and prepared."""
    experiment = joint_2b()
    found = []
    for seed, run in enumerate(runs()):
        true = as_printed(run, experiment.model) if both_rows else run
        found.append(
            regression(experiment, measured(true, experiment.model, seed), both_rows=both_rows)
        )
    return tuple(found)


@cache
def runs() -> tuple[Followed, ...]:
    """The six motions, simulated with model 2b."""
    return tuple(joint_2b().run(m) for m in motions())
