"""An effect outside an FMU acts as one inside it: no delay from reading its outputs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from irj_fmu.imported.correction import PREFIX
from irj_fmu.imported.file import outside_correction
from irj_fmu.imported.fit import fit
from irj_fmu.imported.model import Mapped, UserModel
from irj_fmu.imported.port import coupled, feedback_of, hold_of, noted
from irj_fmu.imported.run import HOLD, Window, parts_of
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


COULOMB = 1.6
BARE = {**TRUTH, "coulomb": 0.0}


def stiff(path: Path, width: float, h: float = 1e-3) -> tuple[UserModel, Window]:
    """Dry friction outside the axis, its sign smoothed over a velocity."""
    model = replace(axis_model(path), window=None)
    values = {f"{PREFIX}motor_coulomb": COULOMB, f"{PREFIX}motor_smoothing_velocity": width}
    law = outside_correction(["coulomb@motor"], model.joint, values, "here")
    model = replace(model, correction=law).with_values(BARE)
    return model, model.windows([axis(seconds=1.0, h=h, noise=0.0)])[0]


def path_of(model: UserModel, window: Window, coupling: float) -> npt.NDArray[np.float64]:
    law = feedback_of(replace(model, coupling=coupling), model.values)
    return model.runner().run(window, BARE, feedback=law)[:, 0]


def test_the_width_of_a_turn_is_fitted_with_the_friction_outside(tmp_path: Path) -> None:
    """It is ten times the library's start; held there, every other value would make up for it."""
    model = axis_model(build("Axis", tmp_path, Make(2, ("CoSimulation",))))
    own = tuple(p for p in model.parameters if p.name != "coulomb")
    model = replace(model, parameters=own, constants={**model.constants, "coulomb": 0.0})
    begun = {f"{PREFIX}motor_coulomb": 0.8 * COULOMB}
    law = outside_correction(["coulomb@motor"], model.joint, begun, "here")
    record = axis(seconds=2.0, h=4e-3, motion=lambda t: 0.03 * np.sin(3.0 * t))
    found = fit(replace(model, correction=law), record)
    width = f"{PREFIX}motor_smoothing_velocity"
    wanted = {**TRUTH, f"{PREFIX}motor_coulomb": COULOMB, width: 0.01}
    del wanted["coulomb"]
    for name, value in wanted.items():
        error = found.stderr[name]
        assert error is not None
        assert found.values[name] == pytest.approx(value, abs=4 * error + 1e-3 * value), name
        assert error < 0.05 * value, name


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_a_steep_law_is_read_as_often_as_its_slope_asks(tmp_path: Path, kind: str) -> None:
    width = 2e-4
    model, window = stiff(build("Axis", tmp_path, Make(2, (kind,))), width)
    found = coupled(model, [window])
    # tanh(w / width) is steepest at rest, where its slope is 1 / width
    assert found.coupling == pytest.approx(TRUTH["inertia"] * width / COULOMB, rel=1e-3)
    assert found.notes == model.notes
    fine = path_of(model, window, hold_of(found) / 16)
    late = np.abs(path_of(model, window, HOLD) - fine).max()
    assert np.abs(path_of(model, window, hold_of(found)) - fine).max() < late / 4


def test_a_gentle_law_keeps_the_millisecond(tmp_path: Path) -> None:
    model, window = stiff(build("Axis", tmp_path, Make(2, ("CoSimulation",))), 1e-2)
    assert hold_of(coupled(model, [window])) == HOLD


def test_an_fmu_of_fixed_step_is_warned_of_and_keeps_its_step(tmp_path: Path) -> None:
    path = build("Axis", tmp_path, Make(2, ("CoSimulation",), step=2e-3))
    steep, window = stiff(path, 2e-4, h=4e-3)
    found = coupled(steep, [window])
    said = [n for n in found.notes if "fixed step of 2 ms" in n]
    assert len(said) == 1
    assert "coulomb@motor" in said[0]
    assert "0.31 ms" in said[0]
    assert noted(found).notes == found.notes  # said once, however often it is looked at
    # the FMU refuses every other step: a run that ends has kept it
    assert np.isfinite(path_of(steep, window, hold_of(found))).all()
    gentle, window = stiff(path, 1e-2, h=4e-3)
    assert "fixed step" not in " ".join(coupled(gentle, [window]).notes)


@pytest.mark.parametrize(
    ("length", "hold", "grain", "parts"),
    [
        (4e-3, 1e-3, None, 4),
        (1e-3, 3e-4, None, 4),
        (4e-3, 1e-3, 2e-3, 2),
        (6e-3, 2.5e-3, 1e-3, 3),
        (6e-3, 1.3e-3, 1e-3, 6),
        (1e-3, 1e-4, 1e-3, 1),
    ],
)
def test_parts_are_whole_steps_of_the_fmu(
    length: float, hold: float, grain: float | None, parts: int
) -> None:
    assert parts_of(length, hold, grain) == parts
