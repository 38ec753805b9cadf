"""`irj track` on a joint that changes while it is recorded: it is identified again by itself."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from casadi_models import JointModel
from casadi_models.simulate import simulate
from identification.data.joint_file import toml_text
from irj_fmu.plant.reference import reference_joint
from workbench.cli.main import main

DT = 1e-3
CHANGES_AT = 10.0
NOISE = np.array([0.002, 3e-4, 0.02, 2e-6, 2e-4, 0.05])


def _readings(
    parts: list[tuple[JointModel, float]], seed: int, gear: float, constant: float
) -> dict[str, npt.NDArray[np.float64]]:
    """Channels of a motion, each part with its own model, the next from where the last stopped."""
    seconds = sum(s for _, s in parts)
    t = np.arange(round(seconds / DT)) * DT
    drive = 200 * np.sin(2 * np.pi * 0.4 * t + seed) + 60 * np.sin(2 * np.pi * 1.7 * t)
    tables, first, state = [], 0, None
    for model, span in parts:
        last = first + round(span / DT)
        found = simulate(model, drive[first : last + 1], DT, x0=state)
        state = found.states[-1]
        tables.append(found.readings[: last - first])
        first = last
    table = np.column_stack([drive / constant, np.vstack(tables)])
    table[:, 1:3] *= gear
    table += np.random.default_rng(seed).normal(size=table.shape) * NOISE
    names = (
        "motor_current_A",
        "motor_position_rad",
        "motor_velocity_rad_s",
        "link_position_rad",
        "link_velocity_rad_s",
        "link_torque_Nm",
    )
    return {"time_s": t, **dict(zip(names, table.T, strict=True))}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    here = tmp_path_factory.mktemp("renewed")
    joint = reference_joint("hd3")
    model = joint.model()
    constant = joint.torque_per_current or joint.gear_ratio
    loaded = model.with_values({"link_inertia": 1.4 * model.values["link_inertia"]})
    for name, parts, seed in (
        ("healthy", [(model, 16.0)], 1),
        ("loaded", [(model, CHANGES_AT), (loaded, 16.0)], 2),
    ):
        np.savez(here / f"{name}.npz", **_readings(parts, seed, joint.gear_ratio, constant))
    values = {k: {"value": v, "unit": "", "side": ""} for k, v in joint.fitted.items()}
    (here / "joint.toml").write_text(toml_text(joint, values))
    return here


def test_a_changed_joint_is_identified_again(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, page = folder / "out.json", folder / "report.html"
    given = ["track", str(folder / "loaded.npz"), "--joint", str(folder / "joint.toml")]
    given += ["--healthy", str(folder / "healthy.npz"), "--report", str(page)]
    assert main([*given, "--json", str(out)]) == 0
    events = json.loads(out.read_text())["records"][0]["events"]
    verdict = next(e for e in events if e["fault"] == 8)
    assert CHANGES_AT <= verdict["time"] < CHANGES_AT + 3
    again = [e for e in events if e.get("changed") is not None]
    assert again
    moved = {c["parameter"]: c for c in again[-1]["changed"]["changed"]}
    assert set(moved) == {"link_inertia"}
    assert moved["link_inertia"]["to"] == pytest.approx(
        1.4 * reference_joint("hd3").fitted["link_inertia"], rel=0.03
    )
    said = capsys.readouterr().out
    assert "identified again from" in said
    assert "link_inertia" in said.split("identified again from")[-1]
    assert "identified again from" in page.read_text()
