"""A simulated joint that follows a reference under a position controller, its parameters free
to change in time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]

_BLOCK = 500


@final
@dataclass(frozen=True)
class Followed:
    """What the joint did, without sensor noise; link-referred SI.

    Attributes
    ----------
    time, drive : (n,) array [s, N.m]
    states : (n, 4) array
        Motor position and velocity, link position and velocity.
    accelerations : (n, 2) array
        Of motor and link [rad/s2].
    torque : (n,) array
        What the gear puts into the link [N.m].
    """

    time: FloatArray
    drive: FloatArray
    states: FloatArray
    accelerations: FloatArray
    torque: FloatArray


@final
@dataclass(frozen=True)
class Controller:
    """Motor-side position controller with feed-forward: bandwidth [rad/s], damping ratio."""

    bandwidth: float = 30.0
    damping: float = 0.8

    def gains(self, inertia: float) -> tuple[float, float]:
        """Drive per error of position and of velocity; the inertia is drive per acceleration."""
        return inertia * self.bandwidth**2, 2 * self.damping * inertia * self.bandwidth


@final
class Follower:
    """An elastic joint under a position controller, built once and run along many references.

    Parameters
    ----------
    model : JointModel
    dt : float
        Sample time [s].
    controller : Controller, optional
    substeps : int
        Runge-Kutta steps per sample.
    """

    def __init__(
        self,
        model: JointModel,
        dt: float,
        *,
        controller: Controller | None = None,
        substeps: int = 5,
    ) -> None:
        import casadi as ca

        from casadi_models.simulate import sampled_step

        if not model.is_elastic:
            raise InputError(
                "Follower: the model is rigid; give an elastic one (transmission_compliance)"
            )
        self.model, self.dt = model, dt
        step = sampled_step(model, dt, substeps)
        size, count = step.size1_in(0), step.size1_in(2)
        x, reference = ca.MX.sym("x", size), ca.MX.sym("r", 3)
        p, gains = ca.MX.sym("p", count), ca.MX.sym("g", 4)
        drive = (
            gains[2] * reference[2]
            + gains[0] * (reference[0] - x[0])
            + gains[1] * (reference[1] - x[1])
        )
        drive = drive - gains[3] * ca.sin(reference[0])
        after = step(x, ca.vertcat(drive, 0, 0), p)
        one = ca.Function("one", [x, reference, p, gains], [after, ca.vertcat(x, drive)])
        s, u, q = ca.SX.sym("s", size), ca.SX.sym("u", 3), ca.SX.sym("q", count)
        seen = ca.Function(
            "seen", [s, u, q], [model.dynamics(s, u, q), model.functions.outputs(s, u, q)]
        )
        self._loop, self._seen, self._size = one.mapaccum("loop", _BLOCK), seen.map(_BLOCK), size
        start = dict(zip(model.parameter_names, model.value_vector(), strict=True))
        inertia = sum(start[n] for n in model.inertias)
        tuned = controller or Controller()
        self._gains = [
            *tuned.gains(inertia),
            inertia,
            sum(start[n] for n in model.named("weight")),
        ]

    def run(
        self, reference: FloatArray, changes: Mapping[str, FloatArray] | None = None
    ) -> Followed:
        """Follow a reference (n, 3): position, velocity, acceleration [rad, rad/s, rad/s2].

        `changes` gives parameters that vary in time, (n,) each, by name.
        """
        samples = len(reference)
        names = self.model.parameter_names
        values = np.repeat(np.array(self.model.value_vector())[:, None], samples, axis=1)
        for name, course in (changes or {}).items():
            if name not in names:
                raise InputError(
                    f"Follower: no parameter {name!r} in the model; it has {', '.join(names)}"
                )
            values[names.index(name)] = course
        blocks = -(-samples // _BLOCK)
        pad = blocks * _BLOCK - samples
        r = np.concatenate([reference, np.repeat(reference[-1:] * [1, 0, 0], pad, axis=0)]).T
        p = np.concatenate([values, np.repeat(values[:, -1:], pad, axis=1)], axis=1)
        x = np.zeros(self._size)
        x[[0, 2]], x[[1, 3]] = reference[0, 0], reference[0, 1]
        rows, rates, readings = [], [], []
        for b in range(blocks):
            part = slice(b * _BLOCK, (b + 1) * _BLOCK)
            after, out = (np.asarray(v) for v in self._loop(x, r[:, part], p[:, part], self._gains))
            x = after[:, -1]
            inputs = np.zeros((3, _BLOCK))
            inputs[0] = out[-1]
            rate, reading = (np.asarray(v) for v in self._seen(out[:-1], inputs, p[:, part]))
            rows.append(out)
            rates.append(rate)
            readings.append(reading)
        out, rate, reading = (
            np.concatenate(v, axis=1)[:, :samples] for v in (rows, rates, readings)
        )
        return Followed(
            time=np.arange(samples, dtype=np.float64) * self.dt,
            drive=out[-1],
            states=out[:4].T.copy(),
            accelerations=rate[[1, 3]].T.copy(),
            torque=reading[4],
        )
