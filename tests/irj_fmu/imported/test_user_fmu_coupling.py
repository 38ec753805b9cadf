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
from irj_fmu.imported.outputs import noise_of
from irj_fmu.imported.port import STEADY, coupled, feedback_of, hold_of, noted
from irj_fmu.imported.run import HOLD, Window, parts_of
from tests.irj_fmu.imported.test_user_fmu import axis_model
from tests.user_fmus.make import Make, build
from tests.user_fmus.plant import HIDDEN, foreign, recorded
from tests.user_fmus.plant import TRUTH as JOINT
from tests.user_fmus.records import TRUTH, axis


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


def test_a_law_is_read_until_that_no_longer_moves_the_outputs(tmp_path: Path) -> None:
    """Its slope allows a millisecond, and the outputs are then off by twice their noise."""
    path = build("Elastic", tmp_path, Make(2, ("CoSimulation",), strict=True))
    record = recorded("stribeck", 6.0, 1)
    values = {PREFIX + n: x for n, x in HIDDEN["stribeck"][1].items()}
    values[f"{PREFIX}motor_smoothing_velocity"] = JOINT["motor_smoothing_velocity"]
    model = foreign(path)
    law = outside_correction([HIDDEN["stribeck"][0]], model.joint, values, "here")
    model = replace(model, correction=law)
    windows, noise = model.windows([record]), noise_of(model, [record])

    def outputs(coupling: float) -> npt.NDArray[np.float64]:
        law = feedback_of(replace(model, coupling=coupling), model.values)
        runner = model.runner()
        own = {p.name: p.value for p in model.parameters}
        return np.concatenate([runner.run(w, own, feedback=law) for w in windows])

    fine = outputs(HOLD / 32)

    def off(found: UserModel) -> float:
        change = (outputs(hold_of(found)) - fine) / noise
        return float(np.sqrt(np.mean(change**2, axis=0)).max())

    assert off(coupled(model, windows)) > 1.0
    found = coupled(model, windows, noise)
    assert off(found) < 4 / 3 * STEADY
    assert HOLD / 8 <= hold_of(found) <= HOLD / 2  # no more often than that


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
