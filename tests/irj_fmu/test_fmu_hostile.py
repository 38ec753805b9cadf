"""Hosts that do everything wrong, in C, on every FMU that is shipped: a status and a line,
never a crash.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from identification.online.estimator import OnlineOptions
from irj_fmu.corrected.build import export_corrected
from irj_fmu.estimator.native import NativeSpec, build_native
from irj_fmu.estimator.native_fmi3 import build_native_fmi3
from irj_fmu.fmi.compiler import find_compiler, header_folder
from irj_fmu.imported.correction import PREFIX
from irj_fmu.imported.export import export_pair
from irj_fmu.imported.file import outside_correction
from irj_fmu.imported.model import load_user_model
from irj_fmu.plant.fmi3 import build_plant_fmi3
from irj_fmu.plant.joint import PlantOptions, plant_spec
from irj_fmu.plant.library import build_plant
from irj_fmu.plant.reference import reference_joint
from tests.irj_fmu.test_fmu_package import LOADER, clean_environment, pack

HERE = Path(__file__).parents[1]
OF_2 = ("plant", "native", "slave", "corrected", "pair")
OF_3 = ("plant3", "native3", "corrected3", "pair3")
WITH_PYTHON = ("slave", "pair", "pair3")
EVERY = (*OF_2, *OF_3)
C_LIBRARY = {"libc", "libm", "libdl", "libpthread", "ld-linux-x86-64", "ld-linux-aarch64"}
CHROOT = shutil.which("chroot")
NOBODY = 65534
"""A user without rights, by number: the small root folder has no names."""
STRANGER = "the instance is NULL, was freed already or is not of this FMU"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile")


@pytest.fixture(scope="module")
def programs(folder: Path) -> dict[int, Path]:
    found = {}
    for version, name in ((2, "fmu_hostile"), (3, "fmu_hostile3")):
        found[version] = folder / name
        command = [
            *find_compiler(),
            str(HERE / f"{name}.c"),
            "-O1",
            f"-I{header_folder()}",
            "-o",
            str(found[version]),
            "-ldl",
            "-lm",
        ]
        subprocess.run(command, check=True)
    return found


def made(folder: Path, what: str) -> Path:
    path = folder / f"{what}.fmu"
    if path.exists():
        return path
    joint = reference_joint("hd3")
    if what in ("native", "native3"):
        spec = NativeSpec(joint, what, OnlineOptions(optimise=False), None, 1e-3)
        return build_native(spec, path) if what == "native" else build_native_fmi3(spec, path)
    if what.startswith(("corrected", "pair")):  # round a plant that gives its state
        model = load_user_model(
            made(folder, "plant3" if what == "corrected3" else "plant"),
            {"motor_current": "i_m", "motor_position": "motor_position"},
            joint=joint,
            kind="cs",
        )
        drag = {f"{PREFIX}motor_quadratic_drag": 0.1}
        law = outside_correction(["quadratic_drag@motor"], model.joint, drag, "here")
        whole = replace(model, correction=law)
        if what.startswith("pair"):
            return export_pair(whole, path, fmi=3 if what in OF_3 else 2)
        return export_corrected(whole, path)
    if what == "slave":  # the shim is that of every estimator
        return pack(folder, name=path.name).path
    plant = plant_spec(joint, PlantOptions(name=what))
    return build_plant(plant, path) if what == "plant" else build_plant_fmi3(plant, path)


def command(programs: dict[int, Path], folder: Path, what: str) -> list[str]:
    """The probe's command line for an FMU, extracted to a folder with an odd name."""
    from fmpy import platform, platform_tuple, read_model_description

    place = folder / f"{what} ü #1"
    if not place.exists():
        with zipfile.ZipFile(made(folder, what)) as archive:
            archive.extractall(place)
    description: Any = read_model_description(str(place))
    readable = next(
        v
        for v in description.modelVariables
        if v.causality == "output" and v.type in ("Real", "Float64")
    )
    if what in OF_3:
        own = description.coSimulation.modelIdentifier
        library = place / "binaries" / platform_tuple / f"{own}.so"
        return [
            str(programs[3]),
            str(library),
            description.instantiationToken,
            str(readable.valueReference),
            str(description.numberOfContinuousStates if description.modelExchange else 0),
            f"{place / 'resources'}/",
        ]
    library = place / "binaries" / platform / f"{description.coSimulation.modelIdentifier}.so"
    return [
        str(programs[2]),
        str(library),
        (place / "resources").as_uri(),
        description.guid,
        "1",
        str(int(what in WITH_PYTHON)),
        str(readable.valueReference),
    ]


@pytest.mark.parametrize("what", EVERY)
def test_wrong_calls_get_a_status_and_a_line(
    programs: dict[int, Path], folder: Path, what: str
) -> None:
    done = subprocess.run(
        command(programs, folder, what), env=clean_environment(), capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (0, "0 failed\n"), done.stdout + done.stderr[-2000:]
    assert done.stderr.count(STRANGER) > 50


def test_the_plant_in_model_exchange_stands_it_too(programs: dict[int, Path], folder: Path) -> None:
    """An instance for model exchange refuses the steps of the probe, and nothing else happens."""
    line = command(programs, folder, "plant")
    done = subprocess.run([*line[:4], "0", *line[5:]], capture_output=True, text=True)
    refused = {text for text in done.stdout.splitlines() if not text.endswith(" failed")}
    assert done.returncode == 1, done.stderr[-2000:]
    assert refused == {"fDoStep(c, 1e-3 * i, 1e-3, 1)", "fDoStep(other, 3e-3, 1e-3, 1)"}


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0 or CHROOT is None,
    reason="a root folder of its own needs the rights of root",
)
@pytest.mark.parametrize("what", [w for w in EVERY if w not in WITH_PYTHON])
def test_they_run_for_another_user_where_nothing_is_but_the_c_library(
    programs: dict[int, Path], folder: Path, tmp_path: Path, what: str
) -> None:
    """A root folder with the C library, the probe and the FMU: none of the builder's paths."""
    line = command(programs, folder, what)
    place, own = folder / f"{what} ü #1", Path("/Größe und Maß")
    shutil.copytree(place, tmp_path / own.name)
    loaded = {p for x in (Path(line[0]), *place.rglob("*.so")) for p in loaded_by(x)}
    assert {p.name.split(".")[0] for p in loaded} <= C_LIBRARY
    for needed in loaded:
        inside = tmp_path / needed.relative_to("/")
        inside.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(needed, inside)
    shutil.copy(line[0], tmp_path / "probe")
    tmp_path.chmod(0o755)
    moved = ["/probe", str(own / Path(line[1]).relative_to(place))]
    rest = line[2:5] if what in OF_3 else [(own / "resources").as_uri(), *line[3:]]
    done = subprocess.run(
        [str(CHROOT), f"--userspec={NOBODY}:{NOBODY}", str(tmp_path), *moved, *rest],
        env={"LC_ALL": "C"},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (0, "0 failed\n"), done.stdout + done.stderr[-2000:]


def loaded_by(program: Path) -> list[Path]:
    """Libraries that a program or a library loads, and what loads them."""
    said = subprocess.run(["ldd", str(program)], capture_output=True, text=True, check=True).stdout
    return [Path(word) for word in said.split() if word.startswith("/")]


@pytest.mark.slow
@pytest.mark.parametrize("what", EVERY)
def test_valgrind_finds_no_invalid_access(
    programs: dict[int, Path], folder: Path, tmp_path: Path, what: str
) -> None:
    valgrind = shutil.which("valgrind")
    assert valgrind is not None, "install valgrind"
    (tmp_path / "loader.supp").write_text(LOADER)
    python = (
        ["--undef-value-errors=no", f"--suppressions={tmp_path}/loader.supp"]
        if what in WITH_PYTHON
        else ["--leak-check=full"]
    )
    done = subprocess.run(
        [valgrind, "--error-exitcode=9", *python, *command(programs, folder, what)],
        env=clean_environment(PYTHONMALLOC="malloc"),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr[-4000:]
    assert "ERROR SUMMARY: 0 errors" in done.stderr
