"""Where a fit begins and between which bounds it may move."""

from __future__ import annotations

from collections.abc import Mapping

from casadi_models import JointModel
from identification.balance.calibration import limits_of_runs, start_values
from identification.balance.dataset import HOLD_NAME, Dataset
from identification.data.joint_file import Known


def starts(model: JointModel, data: Dataset) -> dict[str, float]:
    """Start values: those of the model; shapes and smoothing from the ranges of the record."""
    out = {}
    for p in model.parameters:
        if p.name in model.values:
            out[p.name] = float(model.values[p.name])
        elif p.is_shape and p.scale != "absolute":
            out[p.name] = p.grid[len(p.grid) // 2] * data.ranges[p.scale]
        else:
            out[p.name] = p.start
    out.update(start_values(model, data.train, torque=data.sensing.has_torque))
    return out


def bounds_of(
    model: JointModel, known: Mapping[str, Known], data: Dataset
) -> dict[str, tuple[float, float]]:
    """Bounds of every parameter: physical ones, narrowed by what is known and what the record
    can show.
    """
    out = {}
    for p in model.parameters:
        low, high = p.low, p.high
        if p.role == "smoothing" or (p.is_shape and p.scale != "absolute"):
            scale = data.ranges[p.scale]
            low, high = max(low, p.grid[0] * scale / 3), min(high, p.grid[-1] * scale * 3)
        if p.name == HOLD_NAME:
            hold = data.train[0].grid.dt
            low, high = -hold, hold
        k = known.get(p.name)
        if k is not None:
            low = max(low, k.low) if k.low is not None else low
            high = min(high, k.high) if k.high is not None else high
        out[p.name] = (low, high)
    out.update(limits_of_runs(model, data.train))
    return out
