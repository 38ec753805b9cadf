"""FMUs leave the machine that built them: no path of it inside, and Python is found where they
run.
"""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from fmpy import read_model_description

from irj_fmu.fmi.bundle_loader import missing_of
from irj_fmu.plant.reference import reference_joint
from tests.irj_fmu.test_estimator_hosts import make
from tests.irj_fmu.test_fmu_hostile import EVERY, made
from tests.irj_fmu.test_fmu_package import c_host, host_command, pack  # noqa: F401

REPOSITORY = Path(__file__).resolve().parents[2]
SYSTEM = {"PATH": os.defpath, "LC_ALL": "C.UTF-8"}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a space and umlauts, as another user has it."""
    folder = tmp_path_factory.mktemp("elsewhere") / "Größe und Maß"
    folder.mkdir()
    return folder


@pytest.fixture(scope="module")
def unzipped(place: Path) -> Path:
    with zipfile.ZipFile(pack(place, name="toy.fmu").path) as archive:
        archive.extractall(place / "toy")
    return place / "toy"


@pytest.fixture(scope="module")
def environment(place: Path) -> Path:
    """Another environment with the packages of this one; its folder of programs."""
    folder = place / "andere Umgebung"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    packages = next(folder.glob("lib/python3*/site-packages"))
    here = str(Path(np.__file__).parents[1])
    (packages / "others.pth").write_text(f"{here}\n", encoding="utf-8")
    return folder / "bin"


def run(c_host: Path, unzipped: Path, place: Path, **more: str) -> subprocess.CompletedProcess[str]:
    """A C host as another user, with a home of their own and nothing of this environment."""
    return subprocess.run(
        host_command(c_host, unzipped, 1, 3),
        cwd=place,
        env={**SYSTEM, "HOME": str(place), **more},
        capture_output=True,
        text=True,
    )


def test_no_file_holds_a_path_of_the_builder(tmp_path: Path, place: Path) -> None:
    """Those of a native estimator: tests/irj_fmu/description/test_native_fmi3.py."""
    estimator = make(reference_joint("hd3"), tmp_path, "estimator")
    kinds = [what for what in EVERY if not what.startswith(("slave", "native"))]
    built = [pack(place).path, estimator, *(made(tmp_path, what) for what in kinds)]
    # the root folder is a prefix of every path, and says nothing
    mine = {
        str(p)
        for p in (REPOSITORY, tmp_path, place, sys.prefix, sys.base_prefix, Path.home())
        if len(Path(p).parts) > 1
    }
    for path in built:
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                content = archive.read(name)
                for text in sorted(mine):
                    assert text.encode() + b"/" not in content, (path.name, name, text)


@pytest.mark.parametrize("way", ["PATH", "variable", "side file"])
def test_it_runs_elsewhere_with_another_environment(
    c_host: Path,
    unzipped: Path,
    place: Path,
    environment: Path,
    way: str,
) -> None:
    note = unzipped / "resources" / "python.txt"
    more = {
        "PATH": {"PATH": f"{environment}{os.pathsep}{os.defpath}"},
        "variable": {"IRJ_PYTHON": str(environment / "python3")},
        "side file": {},
    }[way]
    if way == "side file":
        note.write_text(f"{environment / 'python3'}\n", encoding="utf-8")
    try:
        done = run(c_host, unzipped, place, **more)
    finally:
        note.unlink(missing_ok=True)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.split()) == 3
    assert np.isfinite([float(x) for x in done.stdout.split()]).all()


def test_a_pair_runs_elsewhere_too(c_host: Path, place: Path, environment: Path) -> None:
    """With the FMU inside it: the host sets its input and the parameter of the effect."""
    with zipfile.ZipFile(made(place, "pair")) as archive:
        archive.extractall(place / "pair")
    about = read_model_description(str(place / "pair"))
    vr = {v.name: str(v.valueReference) for v in about.modelVariables}
    wired = [vr[n] for n in ("i_m", "correction.motor_quadratic_drag", "motor_position")]
    library = place / "pair" / "binaries" / "linux64" / "pair.so"
    uri = (place / "pair" / "resources").as_uri()
    done = subprocess.run(
        [str(c_host), str(library), uri, about.guid, "1", "3", "0.001", *wired],
        cwd=place,
        env={**SYSTEM, "HOME": str(place), "IRJ_PYTHON": str(environment / "python3")},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    found = [float(x) for x in done.stdout.split()]
    assert len(found) == 3 and np.isfinite(found).all() and len(set(found)) == 3


def test_what_is_missing_is_said_in_one_line(c_host: Path, unzipped: Path, place: Path) -> None:
    bare = place / "bare"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(bare)], check=True)
    done = run(
        c_host, unzipped, place, PATH=str(bare / "bin"), IRJ_PYTHON=str(bare / "bin" / "python3")
    )
    assert done.returncode == 4
    said = [text for text in done.stderr.splitlines() if "IRJ_PYTHON" in text]
    assert len(said) == 1, done.stderr
    assert "No module named 'numpy'" in said[0]


@pytest.mark.parametrize("named", ["/nowhere/python3", "/bin/true"])
def test_a_wrong_interpreter_is_named(
    c_host: Path,
    unzipped: Path,
    place: Path,
    named: str,
) -> None:
    done = run(c_host, unzipped, place, IRJ_PYTHON=named)
    assert done.returncode == 4
    assert f"IRJ_PYTHON names {named}, which is no Python" in done.stderr


def test_nothing_of_python_at_all(c_host: Path, unzipped: Path, place: Path) -> None:
    """An empty PATH: the system's libpython may still be there, and then the packages are what
    is missing.
    """
    done = run(c_host, unzipped, place, PATH=str(place))
    assert done.returncode == 4, done.stdout
    assert "set IRJ_PYTHON" in done.stderr


def test_missing_modules_are_listed() -> None:
    assert missing_of(["json", "no_such_module_irj"]) == ["no_such_module_irj"]
