"""The examples run, and their figures are those that examples/README.md states."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from examples import corrected, exchange, fleet, two_joints
from tests.irj_fmu.test_fmu_package import ecos

Host = Callable[[Path, tuple[str, ...], float, float, Path], np.ndarray]


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


LIBCOSIM = """
import sys
import numpy as np
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimObserver import CosimObserver
path, out, step, stop, *wanted = sys.argv[1:]
execution = CosimExecution.from_ssp_file(ssp_path=path, step_size=round(float(step) * 1e9))
infos = execution.slave_infos()
index = {infos[i].name.decode(): infos[i].index for i in range(execution.num_slaves())}
places = [(index[name], int(at)) for name, at in (w.split("=") for w in wanted)]
observer = CosimObserver.create_last_value()
assert execution.add_observer(observer)
rows = []
for _ in range(round(float(stop) / float(step))):
    assert execution.step()
    rows.append([observer.last_real_values(i, [at])[0] for i, at in places])
np.save(out, np.array(rows))
"""


def in_libcosim(
    path: Path, names: tuple[str, ...], step: float, stop: float, place: Path
) -> np.ndarray:
    """Link positions of the parts at each step, (steps, parts)."""
    from fmpy import read_model_description

    wanted = []
    for name in names:
        about = read_model_description(str(path.parent / f"{name}.fmu"))
        at = next(v.valueReference for v in about.modelVariables if v.name == "link_position")
        wanted.append(f"{name}={at}")
    command = [sys.executable, "-c", LIBCOSIM, str(path), str(place / "found.npy")]
    command += [str(step), str(stop), *wanted]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    found: np.ndarray = np.load(place / "found.npy")
    return found


def in_ecos(
    path: Path, names: tuple[str, ...], step: float, stop: float, place: Path
) -> np.ndarray:
    """The same in ecos."""
    done = subprocess.run(
        [str(ecos(place)), "simulate", "--path", str(path)]
        + ["--stopTime", str(stop), "--stepSize", str(step)],
        cwd=place,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    with (place / f"{path.stem}.csv").open() as file:
        head, *rows = csv.reader(file)
    columns = [[n.strip() for n in head].index(f"{name}::link_position[REAL]") for name in names]
    return np.array([[float(row[at]) for at in columns] for row in rows])


@pytest.mark.parametrize("host", [in_ecos, in_libcosim])
def test_the_system_runs_in_another_host(
    host: Host, system: dict[str, float], folder: Path, tmp_path: Path
) -> None:
    """A host passes outputs on before or after a step: what that may change is one step's way."""
    path = folder / "two_joints.ssp"
    there = host(path, two_joints.NAMES, two_joints.STEP, 0.5, tmp_path)
    here = two_joints.run(folder, 0.5)
    for i, name in enumerate(two_joints.NAMES):
        own = here[f"{name}.link_position"]
        assert len(there) == len(own) == 250
        assert np.ptp(there[:, i]) > 0.1
        assert np.abs(there[:, i] - own).max() < np.abs(np.diff(own)).max()


@pytest.fixture(scope="module")
def elbow(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return corrected.build(tmp_path_factory.mktemp("corrected"))


def test_a_corrected_fmu_goes_as_a_plant_that_has_the_effect(elbow: Path) -> None:
    found = corrected.run(elbow)
    true = found["true.link_position"]
    assert np.abs(found["foreign.link_position"] - true).max() > 0.5
    assert np.abs(found["corrected.link_position"] - true).max() < 1e-4


@pytest.mark.parametrize("host", [in_ecos, in_libcosim])
def test_the_corrected_fmu_is_the_same_in_another_host(
    host: Host, elbow: Path, tmp_path: Path
) -> None:
    there = host(elbow, corrected.PARTS, corrected.STEP, 1.0, tmp_path)
    here = corrected.run(elbow, 1.0)
    # the drive comes one step earlier or later there, to all of them alike
    assert np.abs(there[:, 1] - there[:, 2]).max() < 1e-4
    assert np.abs(there[:, 0] - there[:, 2]).max() > 0.05
    for i, name in enumerate(corrected.PARTS):
        own = here[f"{name}.link_position"]
        assert len(there) == len(own) == 1000
        assert np.abs(there[:, i] - own).max() < np.abs(np.diff(own)).max()


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
