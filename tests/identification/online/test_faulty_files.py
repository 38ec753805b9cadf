"""`irj track` on files whose sensors fail on the way, and faults that are put into a sensor
before anything is derived.
"""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from identification.data.joint_file import load_joint
from identification.data.read import read
from identification.errors import InputError
from identification.faults.detector import Fault
from irj_fmu.estimator.healthy import online_readings
from workbench.cli.main import main

DEMO = Path(str(files("workbench"))) / "demo"
START = 9.0


def written(folder: Path, change: Any) -> Path:
    """The demo's held-out record with something done to its columns from 9 s on."""
    with np.load(DEMO / "held_out.npz") as archive:
        columns = {name: archive[name].copy() for name in archive.files}
    time = columns["time_s"]
    change(columns, time >= START)
    path = folder / "faulty.npz"
    np.savez(path, **columns)
    return path


def column(columns: dict[str, np.ndarray], start: str) -> np.ndarray:
    return next(values for name, values in columns.items() if name.startswith(start))


def stuck(columns: dict[str, np.ndarray], late: np.ndarray) -> None:
    values = column(columns, "link_position")
    values[late] = values[late][0]


def scaled(columns: dict[str, np.ndarray], late: np.ndarray) -> None:
    column(columns, "link_position")[late] *= 57.3


def lost(columns: dict[str, np.ndarray], late: np.ndarray) -> None:
    column(columns, "link_torque")[late] = np.nan


def wild(columns: dict[str, np.ndarray], late: np.ndarray) -> None:
    column(columns, "motor_position")[late] += 1e3


@pytest.mark.parametrize("change", [stuck, scaled, lost, wild], ids=lambda f: f.__name__)
def test_a_file_whose_sensor_fails_is_tracked(change: Any, tmp_path: Path) -> None:
    path, out = written(tmp_path, change), tmp_path / "out.json"
    assert main(["track", str(path), "--joint", str(DEMO / "joint.toml"), "--json", str(out)]) == 0
    events = json.loads(out.read_text())["records"][0]["events"]
    assert (
        any(START - 0.01 <= e["time"] <= START + 2.0 for e in events) or change is lost
    )  # its rows are gaps


def test_a_head_that_is_not_sane_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def all_stuck(columns: dict[str, np.ndarray], late: np.ndarray) -> None:
        column(columns, "link_position")[:] = 0.3

    path = written(tmp_path, all_stuck)
    assert main(["track", str(path), "--joint", str(DEMO / "joint.toml")]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert str(path) in said[-1]


def test_a_derived_velocity_follows_its_faulty_position() -> None:
    joint = load_joint(DEMO / "joint.toml")
    record = read(DEMO / "held_out.npz", columns=joint.columns, kind=joint.kind)
    even = record.without("motor_velocity", "link_velocity").resampled()
    healthy = np.array(online_readings(even, joint)[0])
    hurt = np.array(online_readings(even, joint, [Fault("link_position", "stuck", START)])[0])
    late = even.time - even.time[0] > START + 0.05
    assert np.all(hurt[late, 3] == hurt[late, 3][0])
    np.testing.assert_allclose(hurt[late, 4], 0.0, atol=1e-12)
    assert np.ptp(healthy[late, 4]) > 0.01
    with pytest.raises(InputError, match="link_velocity"):
        online_readings(even, joint, [Fault("link_velocity", "stuck", START)])
    whole = record.resampled()
    measured = [
        np.array(online_readings(whole, joint, faults)[0])[:, 4]
        for faults in ((), [Fault("link_position", "stuck", START)])
    ]
    np.testing.assert_array_equal(*measured)
