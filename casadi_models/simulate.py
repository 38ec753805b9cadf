"""Simulation of a joint model: Runge-Kutta steps in a compiled CasADi loop, memory moved step
by step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from .joint import JointModel

FloatArray = npt.NDArray[np.float64]


@final
@dataclass(frozen=True)
class Trajectory:
    """Result of a simulation.

    Attributes
    ----------
    time : (n,) array [s]
    states : (n, states) array
        As in :class:`casadi_models.functions.JointFunctions`, memory included.
    readings : (n, 5) array
        Motor position, motor velocity, link position, link velocity (link-referred), torque.
    """

    time: FloatArray
    states: FloatArray
    readings: FloatArray


def simulate(
    model: JointModel,
    drive: FloatArray,
    dt: float,
    *,
    substeps: int = 10,
    x0: FloatArray | None = None,
    temperature: FloatArray | None = None,
) -> Trajectory:
    """Integrate a joint model with a drive torque that is held between samples.

    Parameters
    ----------
    model : JointModel
    drive : (n,) array
        n Km I at each sample, link-referred [N.m].
    dt : float
        Sample time [s].
    substeps : int
        Runge-Kutta steps of 4th order per sample.
    x0 : array, optional
        Initial state; rest at zero by default.
    temperature : (n,) array, optional
        Temperature above that from which the values of thermal friction count [K].
    """
    functions = model.functions
    size = len(functions.state_names) + len(functions.memory_names)
    samples = len(drive)
    inputs = np.zeros((3, samples))
    inputs[0] = drive
    inputs[1] = 0.0 if temperature is None else temperature
    inputs[2] = np.arange(samples) * dt
    p = model.value_vector()
    loop = sampled_step(model, dt, substeps).mapaccum("loop", samples)
    start = np.zeros(size) if x0 is None else np.asarray(x0, dtype=float)
    after = np.array(loop(start, inputs, p))
    states = np.vstack([start, after.T[:-1]])
    readings = np.array(functions.outputs.map(samples)(states.T, inputs, p)).T
    return Trajectory(inputs[2], states, readings)


def sampled_step(model: JointModel, dt: float, substeps: int = 10) -> Any:
    """CasADi function (x, u, p) -> x one sample later, the input held."""
    step = model.functions.step
    x = ca.MX.sym("x", step.size1_in(0))
    u = ca.MX.sym("u", step.size1_in(1))
    p = ca.MX.sym("p", step.size1_in(2))
    now = x
    for _ in range(substeps):
        now = step(now, u, p, dt / substeps)
    return ca.Function("sampled_step", [x, u, p], [now], ["x", "u", "p"], ["x_next"])
