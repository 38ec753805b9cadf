"""The examples run, and their figures are those that examples/README.md states."""

from __future__ import annotations

import csv
import subprocess
from pathlib import Path

import numpy as np
import pytest

from examples import exchange, fleet, two_joints
from tests.irj_fmu.test_fmu_package import ecos


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("two joints")


@pytest.fixture(scope="module")
def system(folder: Path) -> dict[str, float]:
    return two_joints.figures(folder)


@pytest.mark.parametrize("name", two_joints.NAMES)
def test_each_joint_moves_as_its_equations(name: str, system: dict[str, float]) -> None:
    assert system[f"{name}: largest distance from scipy [rad]"] < 1e-9
    assert system["elbow: swing in it [rad]"] > 0.1


@pytest.mark.parametrize("name", two_joints.NAMES)
def test_each_estimator_finds_the_stiffness_and_no_fault_where_none_is(
    name: str, system: dict[str, float]
) -> None:
    assert abs(system[f"{name}: stiffness found over true"] - 1) < 5e-3
    assert system[f"{name}: samples with a fault before"] == 0


def test_the_slipping_encoder_and_the_payload_are_told(system: dict[str, float]) -> None:
    assert 0 < system["shoulder: link encoder told after [s]"] < 0.1
    assert 0 < system["elbow: change of the joint told after [s]"] < 3.0


@pytest.mark.parametrize("parameter", ["link_inertia", "gravity_torque"])
def test_the_payload_is_taken_over(parameter: str, system: dict[str, float]) -> None:
    assert abs(system[f"elbow: {parameter} with its payload found over true"] - 1) < 0.01


def test_the_system_runs_in_another_host(
    system: dict[str, float], folder: Path, tmp_path: Path
) -> None:
    """A host passes outputs on before or after a step: what that may change is one step's way."""
    done = subprocess.run(
        [str(ecos(tmp_path)), "simulate", "--path", str(folder / "two_joints.ssp")]
        + ["--stopTime", "0.5", "--stepSize", str(two_joints.STEP)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    with (tmp_path / "two_joints.csv").open() as file:
        names, *rows = csv.reader(file)
    here = two_joints.run(folder, 0.5)
    for name in two_joints.NAMES:
        at = [n.strip() for n in names].index(f"{name}::link_position[REAL]")
        there = np.array([float(row[at]) for row in rows])
        own = here[f"{name}.link_position"]
        assert len(there) == len(own) == 250
        assert np.ptp(there) > 0.1
        assert np.abs(there - own).max() < np.abs(np.diff(own)).max()


def test_every_part_can_be_taken_out_and_validates(system: dict[str, float], folder: Path) -> None:
    from zipfile import ZipFile

    from fmpy.validation import validate_fmu

    with ZipFile(folder / "two_joints.ssp") as archive:
        archive.extractall(folder / "apart")
    parts = sorted((folder / "apart" / "resources").glob("*.fmu"))
    assert len(parts) == 6
    assert [validate_fmu(str(part)) for part in parts] == [[]] * 6


def test_the_fleet_gives_what_fmpy_gives(tmp_path: Path) -> None:
    found = fleet.figures(tmp_path, count=12)
    assert found["failed"] == 0
    assert found["spread over the stiffness [N.m]"] > 1.0
    assert found["largest difference to fmpy [N.m]"] < 1e-9


def test_a_solver_of_the_host_gives_what_the_own_integrator_gives(tmp_path: Path) -> None:
    found = exchange.figures(tmp_path)
    assert found["link position [rad]"] > 0.1
    assert found["FMI 3.0 less FMI 2.0, largest state"] <= 1e-12
    assert found["own integrator less Radau, largest state"] < 1e-6
