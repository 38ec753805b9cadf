"""An effect outside an FMU acts as one inside it: no delay from reading its outputs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from irj_fmu.imported.correction import PREFIX
from irj_fmu.imported.file import outside_correction
from irj_fmu.imported.model import Mapped
from irj_fmu.imported.port import feedback_of
from tests.irj_fmu.imported.test_user_fmu import TRUTH, axis, axis_model
from tests.user_fmus.make import Make, build


@pytest.mark.parametrize("speed", [False, True])
@pytest.mark.parametrize("h", [4e-3, 1e-3])
def test_drag_outside_is_drag_inside(tmp_path: Path, h: float, *, speed: bool) -> None:
    """Half a millisecond late would be two tenths of a thousandth of the range."""
    path = build("Axis", tmp_path, Make(2, ("CoSimulation",)))
    model = replace(axis_model(path), window=None)
    window = model.windows([axis(seconds=2.0, h=h, noise=0.0)])[0]
    if speed:
        model = replace(model, outputs=(*model.outputs, Mapped("motor_velocity", "speed")))
        rate = np.gradient(window.outputs[:, 0], h)
        window = replace(window, outputs=np.column_stack([window.outputs, rate]))
    runner = model.runner()
    inside = runner.run(window, TRUTH)[:, 0]
    values = {f"{PREFIX}motor_viscous": TRUTH["viscous"]}
    outside = replace(
        model, correction=outside_correction(["viscous@motor"], model.joint, values, "here")
    )
    law = feedback_of(outside, outside.values)
    found = runner.run(window, {**TRUTH, "viscous": 0.0}, feedback=law)[:, 0]
    bare = runner.run(window, {**TRUTH, "viscous": 0.0})[:, 0]
    span = float(np.ptp(inside))
    assert np.abs(bare - inside).max() > 0.02 * span
    assert np.abs(found - inside).max() < 2e-6 * span
