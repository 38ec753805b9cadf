"""A simulated joint that follows a reference under a position controller, its parameters free
to change in time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.errors import InputError
from identification.fitting.window_run import LONG, WindowRun

FloatArray = npt.NDArray[np.float64]

_BLOCK: Final = 500
_MANY: Final = 5 * LONG
"""Samples after which the joint runs as C: the virtual machine, which takes 15 to 100 us a sample
with five steps of Runge-Kutta, has then worked longer than the compiler will (.3 to 1.3 s)."""


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
        from casadi_models.text.compensation import RestingLoad, resting_load

        if not model.is_elastic:
            raise InputError(
                "Follower: the model is rigid; give an elastic one (transmission_compliance)"
            )
        self.model, self.dt = model, dt
        step = sampled_step(model, dt, substeps)
        size, count = step.size1_in(0), step.size1_in(2)
        x, reference = ca.MX.sym("x", size), ca.MX.sym("r", 3)
        p, gains = ca.MX.sym("p", count), ca.MX.sym("g", 6)
        drive = (
            gains[2] * reference[2]
            + gains[0] * (reference[0] - x[0])
            + gains[1] * (reference[1] - x[1])
        )
        drive += RestingLoad(gains[3], gains[4], gains[5]).drive(reference[0])
        applied = ca.vertcat(drive, 0, 0)
        outputs = [x, drive, model.dynamics(x, applied, p), model.functions.outputs(x, applied, p)]
        self._sample = ca.Function(
            "sample",
            [x, ca.vertcat(reference, p), gains],
            [step(x, applied, p), ca.vertcat(*outputs)],
        )
        self._size, self._samples = size, 0
        self._ends = np.cumsum([size, 1, model.dynamics.size1_out(0)])
        start = dict(zip(model.parameter_names, model.value_vector(), strict=True))
        inertia = sum(start[n] for n in model.inertias)
        tuned = controller or Controller()
        self._gains = np.array([*tuned.gains(inertia), inertia, *astuple(resting_load(model))])

    @cached_property
    def _interpreted(self) -> WindowRun:
        return WindowRun(self._sample, _BLOCK, 0)

    @cached_property
    def _compiled(self) -> WindowRun:
        return WindowRun(self._sample, _BLOCK, LONG)

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
        self._samples += samples
        run = self._compiled if self._samples > _MANY else self._interpreted
        rows, given = [], np.concatenate([r, p]).T
        for b in range(blocks):
            part = slice(b * _BLOCK, (b + 1) * _BLOCK)
            out, after = run.run(x[None], given[part], self._gains)
            x = after[0]
            rows.append(out[0])
        states, drive, rate, reading = np.split(np.concatenate(rows)[:samples], self._ends, axis=1)
        return Followed(
            time=np.arange(samples, dtype=np.float64) * self.dt,
            drive=drive[:, 0].copy(),
            states=states[:, :4].copy(),
            accelerations=rate[:, [1, 3]].copy(),
            torque=reading[:, 4].copy(),
        )
