"""Run FMUs from Python: open once, use often, connect, disturb.

The communication step is always stated: some hosts stretch it when it is left to them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np

from casadi_models.signals import one_line
from identification.errors import InputError
from irj_fmu.host.fmu import Block, Fmu, FmuError, Instance, Number, Wiring, near_names
from irj_fmu.host.plan import Plan
from irj_fmu.host.signals import FloatArray


@final
@dataclass(frozen=True)
class Trajectory:
    """Recorded signals: `time`, shape (n,), in s, and one array of shape (n,) per recorded name."""

    time: FloatArray
    signals: Mapping[str, FloatArray]

    def __repr__(self) -> str:
        return one_line(self)

    def __getitem__(self, name: str) -> FloatArray:
        return self.signals[name]


def simulate_cs(
    instances: Mapping[str, Instance] | Instance,
    wiring: Wiring,
    *,
    step: float,
    stop: float,
    start: float = 0.0,
) -> Trajectory:
    """Co-simulate FMUs with a fixed communication step.

    At each communication point all outputs are read, all inputs set from them and from the
    functions of time, and all FMUs step together (Jacobi). An estimator thus sees the plant's
    outputs and inputs of the same instant.

    Parameters
    ----------
    instances : mapping or Instance
        Name to instance; a single one goes by its own name. They are reset first, so they serve
        many runs.
    wiring : Wiring
        Connections, inputs, faults, parameters, records.
    step, stop, start : float
        Communication step and times in s.

    Returns
    -------
    Trajectory
        The recorded variables at ``start, start + step, ... , stop``.

    Raises
    ------
    InputError
        Where a name is unknown or an input is fed twice.
    FmuError
        Where an FMU refuses a call.
    """
    if isinstance(instances, Instance):
        instances = {instances.name: instances}
    count = (
        round((stop - start) / step) if step > 0 and np.isfinite([start, stop, step]).all() else 0
    )
    if count < 1 or abs(count * step - (stop - start)) > 1e-6 * step:
        raise InputError(
            f"co-simulation from {start:g} to {stop:g} s is not a whole number of steps of "
            f"{step:g} s"
        )
    time: FloatArray = start + step * np.arange(count + 1, dtype=np.float64)
    plan = Plan(instances, wiring, time)
    for name, instance in instances.items():
        own = {
            key.partition(".")[2]: v
            for key, v in wiring.parameters.items()
            if key.partition(".")[0] == name
        }
        instance.begin(start, own, stopTime=stop)
    plan.exchange(0)
    for instance in instances.values():
        instance.ready()
    members = list(instances.values())
    for i, now in enumerate(time.tolist()):
        plan.exchange(i)
        plan.note(i)
        if i < count:
            for instance in members:
                instance.step(now, step)
    for instance in members:
        instance.call("terminate")
    return Trajectory(time, {name: plan.table[:, i] for i, name in enumerate(wiring.record)})


__all__ = [
    "Block",
    "Fmu",
    "FmuError",
    "Instance",
    "Number",
    "Trajectory",
    "Wiring",
    "near_names",
    "simulate_cs",
]
