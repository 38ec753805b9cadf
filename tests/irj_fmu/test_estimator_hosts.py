"""The estimator FMU in foreign hosts: ecos, libcosim, a C program; each step as under fmpy, odd
paths, no help from outside.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest
from test_fmu_package import LOADER, clean_environment, ecos

from identification.data.joint_file import Joint, toml_text
from identification.online.estimator import OnlineOptions
from irj_fmu.build import _package
from irj_fmu.estimator.packed import options_text
from irj_fmu.estimator.slave import JOINT_FILE, OPTIONS_FILE
from irj_fmu.fmi.compiler import header_folder
from irj_fmu.fmi.package import SlaveSpec, package_slave
from irj_fmu.fmi.ssp import PARAMETERS, System, multisine_source, write_ssp
from irj_fmu.fmi.variables import Variable
from irj_fmu.host.run import Fmu, Instance, Trajectory, Wiring, simulate_cs
from irj_fmu.plant.joint import PlantOptions, plant_spec
from irj_fmu.plant.library import PlantSpec, build_plant
from irj_fmu.plant.reference import reference_joint, start_of

FloatArray = npt.NDArray[np.float64]
STEP = 1e-3
ODD = "a b ü #1"
WARM_UP = 0.4
"""First window of these estimators [s], short so that short runs reach the recursion."""


def make(joint: Joint, folder: Path, name: str, **options: Any) -> Path:
    """An estimator with the shim and a short first window, in a folder with an odd name."""
    texts = folder / "texts" / name
    texts.mkdir(parents=True)
    values = {k: {"value": v, "unit": "", "side": ""} for k, v in joint.fitted.items()}
    (texts / JOINT_FILE).write_text(toml_text(joint, values), encoding="utf-8")
    (texts / OPTIONS_FILE).write_text(
        options_text(OnlineOptions(warm_up=WARM_UP, **options)), encoding="utf-8"
    )
    (folder / ODD).mkdir(exist_ok=True)
    packages = tuple(_package(p) for p in ("casadi_models", "identification", "irj_fmu"))
    spec = SlaveSpec(
        name,
        "irj_fmu.estimator.slave",
        "Estimator",
        packages,
        {n: texts / n for n in (JOINT_FILE, OPTIONS_FILE)},
    )
    made = package_slave(spec, folder / ODD / f"{name}.fmu")
    assert made.has_shim
    return made.path


@pytest.fixture(scope="module")
def elastic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fitted, three balances, fault detector at work."""
    return make(reference_joint("hd3"), tmp_path_factory.mktemp("elastic"), "elastic")


@pytest.fixture(scope="module")
def rigid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Motor side only, not fitted."""
    return make(
        start_of(reference_joint("irj1b")),
        tmp_path_factory.mktemp("rigid"),
        "rigid",
        has_link=False,
        has_torque=False,
    )


def test_validates_and_fmutool_finds_nothing(elastic: Path, tmp_path: Path) -> None:
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(elastic)) == []
    tool = Path(sys.executable).with_name("fmutool")
    done = subprocess.run(
        [tool, "-input", str(elastic), "-check"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    text = re.sub(r"\x1b\[[0-9;]*m", "", done.stdout + done.stderr)
    assert done.returncode == 0, text
    assert "compliant with FMI-2" in text, text
    assert "No semantic error" in text, text
    assert not re.search(r"ERROR|WARNING|CRITICAL|not compliant", text), text


# --- ecos -----------------------------------------------------------------------------------------

STEPS = 900
THETAS = 4


def loupe(folder: Path) -> Path:
    """A block that splits its inputs into three parts, each with few digits: ecos writes six
    decimals.
    """
    clock, u, p = ca.SX.sym("t"), ca.SX.sym("u", THETAS), ca.SX.sym("p", 0)
    parts = []
    for i in range(THETAS):
        fine = 1e4 * u[i] - ca.floor(1e4 * u[i] + 0.5)
        parts += [u[i], fine, 1e4 * fine - ca.floor(1e4 * fine + 0.5)]
    spec = PlantSpec(
        name="loupe",
        dynamics=ca.Function("f", [clock, u, p], [ca.SX(1)]),
        output=ca.Function("y", [clock, u, p], [ca.vertcat(*parts)]),
        states=(Variable("clock", "s"),),
        inputs=tuple(Variable(f"u[{i}]") for i in range(1, THETAS + 1)),
        parameters=(),
        outputs=tuple(
            Variable(f"{part}[{i}]")
            for i in range(1, THETAS + 1)
            for part in ("coarse", "fine", "finest")
        ),
    )
    return build_plant(spec, folder / "loupe.fmu")


def joined(coarse: FloatArray, fine: FloatArray, finest: FloatArray) -> FloatArray:
    """The number that the loupe has split."""
    fine = (np.round(1e4 * fine - finest) + finest) / 1e4
    found: FloatArray = (np.round(1e4 * coarse - fine) + fine) / 1e4
    return found


def test_loupe_keeps_every_digit(tmp_path: Path) -> None:
    wanted = np.array([21513.123456789012, -0.33333333333333331, 105.18000000012345, 9.9999999999])
    with Fmu(loupe(tmp_path)) as fmu, Instance(fmu, name="loupe") as instance:
        names = [
            f"loupe.{part}[{i}]"
            for part in ("coarse", "fine", "finest")
            for i in range(1, THETAS + 1)
        ]
        inputs = {f"loupe.u[{i}]": (lambda _t, v=v: v) for i, v in enumerate(wanted, 1)}
        found = simulate_cs(instance, Wiring(inputs=inputs, record=names), step=STEP, stop=STEP)  # type: ignore[arg-type]
    split = [
        np.array([float(f"{found[f'loupe.{part}[{i}]'][-1]:.6f}") for i in range(1, THETAS + 1)])
        for part in ("coarse", "fine", "finest")
    ]
    np.testing.assert_allclose(joined(*split), wanted, rtol=1e-13)


@pytest.fixture(scope="module")
def system(elastic: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[System, Path]:
    """Source, plant, estimator and loupe in one SSP."""
    folder = tmp_path_factory.mktemp("ssp")
    joint = reference_joint("hd3")
    plant = build_plant(plant_spec(joint, PlantOptions(name="plant")), folder / "plant.fmu")
    sizes = [abs(t / (joint.torque_per_current or 1.0)) for t in (160.0, 60.0, 20.0)]
    source = build_plant(
        multisine_source(sizes, (0.9, 2.1, 4.7), (0.0, 1.0, 2.0)), folder / "source.fmu"
    )
    channels = {
        "q_m": "motor_position",
        "w_m": "motor_velocity",
        "q_l": "link_position",
        "w_l": "link_velocity",
        "tau_l": "link_torque",
    }
    connections = {"plant.i_m": "source.signal", "estimator.i_m": "source.signal"}
    connections |= {f"estimator.{k}": f"plant.{v}" for k, v in channels.items()}
    connections |= {f"loupe.u[{i}]": f"estimator.theta[{i}]" for i in range(1, THETAS + 1)}
    components = {"source": source, "plant": plant, "estimator": elastic, "loupe": loupe(folder)}
    made = System(components, connections, {"plant.stiffness": 2.6e4}, stop=STEPS * STEP)
    return made, write_ssp(made, folder / "joint.ssp")


@pytest.fixture(scope="module")
def under_fmpy(system: tuple[System, Path]) -> Trajectory:
    """The same system by the project's own master."""
    made, _ = system
    fmus = {name: Fmu(path) for name, path in made.components.items()}
    instances = {name: Instance(fmu, name=name) for name, fmu in fmus.items()}
    record = [
        f"loupe.{part}[{i}]" for part in ("coarse", "fine", "finest") for i in range(1, THETAS + 1)
    ]
    record += [f"estimator.theta[{i}]" for i in range(1, THETAS + 1)] + [
        "estimator.health",
        "estimator.n_rows",
        "plant.link_position",
    ]
    found = simulate_cs(
        instances,
        Wiring(made.connections, parameters=made.parameters, record=record),
        step=STEP,
        stop=STEPS * STEP,
    )
    for name in fmus:
        instances[name].close()
        fmus[name].close()
    return found


def thetas(columns: Any) -> FloatArray:
    """Shape (n, THETAS), from the three parts of each."""
    return np.column_stack(
        [
            joined(
                *(
                    np.asarray(columns(f"loupe.{part}[{i}]"))
                    for part in ("coarse", "fine", "finest")
                )
            )
            for i in range(1, THETAS + 1)
        ]
    )


def test_ecos_gives_each_estimate_as_under_fmpy(
    system: tuple[System, Path], under_fmpy: Trajectory, tmp_path: Path
) -> None:
    """The C++ program, every step, to 1e-12; it extracts to a path with space, umlaut and '#'."""
    program, odd = ecos(tmp_path), tmp_path / ODD
    odd.mkdir()
    path = odd / "joint system.ssp"
    shutil.copy(system[1], path)
    options = [
        "--stopTime",
        str(STEPS * STEP),
        "--stepSize",
        str(STEP),
        "--parameterSet",
        system[0].name,
    ]
    done = subprocess.run(
        [program, "simulate", "--path", str(path), *options],
        cwd=tmp_path,
        env=clean_environment(TMPDIR=str(odd)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    lines = next(tmp_path.rglob("*.csv")).read_text().splitlines()
    names = [name.strip().split("[REAL]")[0].split("[INT]")[0] for name in lines[0].split(",")]
    rows = [row.split(",") for row in lines[1:]]
    found = thetas(lambda name: [float(row[names.index(name.replace(".", "::"))]) for row in rows])
    expected = thetas(lambda name: under_fmpy[name])[: len(found)]
    assert len(found) >= STEPS
    assert under_fmpy["estimator.n_rows"][-1] > 30
    assert np.abs(expected[-1] / expected[0] - 1).max() > 1e-3
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_the_system_runs_in_fmpy_ssp(system: tuple[System, Path], under_fmpy: Trajectory) -> None:
    """fmpy passes values on one step late; the joint swings the same and the estimator is at
    work.
    """
    from fmpy.ssp.simulation import simulate_ssp
    from fmpy.ssp.ssd import read_ssv

    values = read_ssv(str(system[1]), PARAMETERS)
    found = simulate_ssp(
        str(system[1]), stop_time=STEPS * STEP, step_size=STEP, parameter_set=values
    )
    assert found["estimator.n_samples"][-1] >= STEPS - 1
    assert found["estimator.health"][-1] == 0
    swing = under_fmpy["plant.link_position"]
    assert np.abs(found["plant.link_position"][-1] - swing[-1]) < 0.02 * np.ptp(swing)
    last = np.array([found[f"estimator.theta[{i}]"][-1] for i in range(1, THETAS + 1)])
    assert np.isfinite(last).all()
    assert (
        np.abs(
            last / [under_fmpy[f"estimator.theta[{i}]"][0] for i in range(1, THETAS + 1)] - 1
        ).max()
        > 1e-3
    )


# --- libcosim -------------------------------------------------------------------------------------

_LIBCOSIM = """
import sys
import numpy as np
from libcosimpy.CosimEnums import CosimVariableType
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimManipulator import CosimManipulator
from libcosimpy.CosimObserver import CosimObserver
from libcosimpy.CosimSlave import CosimLocalSlave
path, table, out, inputs, outputs = sys.argv[1:]
inputs, outputs = ([int(x) for x in text.split(",")] for text in (inputs, outputs))
execution = CosimExecution.from_step_size(step_size=1_000_000)
index = execution.add_local_slave(CosimLocalSlave(fmu_path=path, instance_name="estimator"))
observer, manipulator = CosimObserver.create_last_value(), CosimManipulator.create_override()
execution.add_observer(observer)
execution.add_manipulator(manipulator)
rows = []
for row in np.load(table):
    manipulator.slave_real_values(
        slave_index=index, variable_references=inputs, values=row.tolist())
    assert execution.step()
    rows.append(observer.last_real_values(index, outputs))
np.save(out, np.array(rows))
"""
INPUTS = ("i_m", "q_m", "w_m", "q_l", "w_l", "tau_l")


@pytest.fixture(scope="module")
def readings() -> FloatArray:
    """What the sensors of the elastic joint read, (STEPS, 6), noise included."""
    from casadi_models.simulate import simulate

    joint = reference_joint("hd3")
    t = STEP * np.arange(STEPS)
    drive = 160 * np.sin(2 * np.pi * 0.9 * t) + 60 * np.sin(2 * np.pi * 2.1 * t + 1)
    found = simulate(joint.model(), drive, STEP).readings[:STEPS]
    table = np.column_stack([drive / (joint.torque_per_current or 1.0), found])
    table[:, 1:3] *= joint.gear_ratio
    noise = np.random.default_rng(5).normal(size=table.shape)
    made: FloatArray = table + noise * np.array([2e-3, 3e-4, 0.1, 2e-6, 1e-3, 0.05])
    return made


@pytest.fixture(scope="module")
def estimates(elastic: Path, readings: FloatArray) -> FloatArray:
    """All estimates and scores after each step, under fmpy."""
    rows = []
    with Fmu(elastic) as fmu, Instance(fmu, name="estimator") as instance:
        instance.begin(0.0)
        instance.ready()
        write, read = instance.blocks(INPUTS)[0], instance.blocks(outputs_of(fmu))[0]
        for k, row in enumerate(readings):
            write.values[:] = row.tolist()
            instance.write(write)
            instance.step(k * STEP, STEP)
            rows.append(list(instance.read(read)))
    return np.array(rows)


def outputs_of(fmu: Fmu) -> list[str]:
    """Real outputs of an estimator."""
    return [n for n, v in fmu.variables.items() if v.causality == "output" and v.type == "Real"]


def test_libcosim_gives_every_output_as_under_fmpy(
    elastic: Path, readings: FloatArray, estimates: FloatArray, tmp_path: Path
) -> None:
    """In a process of its own, from another folder; it extracts to a path with space, umlaut
    and '#'.
    """
    odd = tmp_path / ODD
    odd.mkdir()
    np.save(odd / "readings.npy", readings)
    with Fmu(elastic) as fmu:
        places = [
            ",".join(str(fmu.variables[n].valueReference) for n in names)
            for names in (INPUTS, outputs_of(fmu))
        ]
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            _LIBCOSIM,
            str(elastic),
            str(odd / "readings.npy"),
            str(odd / "out.npy"),
            *places,
        ],
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(odd)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = np.load(odd / "out.npy")
    assert not np.array_equal(estimates[0], estimates[-1])
    np.testing.assert_allclose(found, estimates, rtol=1e-12, atol=1e-300)


# --- a C program ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def c_host(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("gcc") or shutil.which("cc")
    assert compiler is not None, "the C host of the tests needs gcc"
    path = tmp_path_factory.mktemp("host") / "fmu_host"
    source = Path(__file__).parents[1] / "fmu_host.c"
    subprocess.run(
        [
            compiler,
            str(source),
            "-g",
            "-O1",
            f"-I{header_folder()}",
            "-o",
            str(path),
            "-ldl",
            "-lm",
        ],
        check=True,
    )
    return path


def command(c_host: Path, fmu: Path, folder: Path, cycles: int, steps: int) -> list[str]:
    """Extract to a folder with an odd name; the command that runs it."""
    place = folder / ODD
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(place)
    with Fmu(fmu) as opened:
        numbers = [str(opened.variables[n].valueReference) for n in ("i_m", "q_m", "theta[1]")]
        guid = opened.description.guid
    library = place / "binaries" / "linux64" / f"{fmu.stem}.so"
    return [
        str(c_host),
        str(library),
        (place / "resources").as_uri(),
        guid,
        str(cycles),
        str(steps),
        str(STEP),
        *numbers,
    ]


def as_in_c(path: Path, steps: int) -> FloatArray:
    """theta[1] after each step, fed as the C program feeds it."""
    out = []
    with Fmu(path) as fmu, Instance(fmu) as instance:
        instance.begin(0.0)
        instance.ready()
        write, read = instance.blocks(("i_m", "q_m"))[0], instance.blocks(("theta[1]",))[0]
        for i in range(steps):
            u = float(np.sin(0.3 * i))
            write.values[:] = [u, 2 * u + 0.5 + 0.1 * float(np.cos(float(i)))]
            instance.write(write)
            instance.step(i * STEP, STEP)
            out.append(instance.read(read)[0])
    return np.array(out)


@pytest.mark.slow
def test_fifty_cycles_in_c(c_host: Path, rigid: Path, tmp_path: Path) -> None:
    """Instantiate, run, free, 50 times, exit 0; the last run as under fmpy. The host has no
    locale and no LD_PRELOAD.
    """
    steps = 520
    expected = as_in_c(rigid, steps)
    done = subprocess.run(
        command(c_host, rigid, tmp_path, 50, steps),
        cwd="/",
        env={"PATH": os.defpath, "LC_ALL": "C", "IRJ_PYTHON": sys.executable},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert expected[-1] != expected[0]
    np.testing.assert_allclose(
        [float(x) for x in done.stdout.split()], expected, rtol=1e-12, atol=0
    )


@pytest.mark.parametrize(
    "paths",
    [
        ("{other}:/usr/bin:/bin",),
        pytest.param(
            ("{other}", "/usr/bin:/bin", "/bin:/usr/bin", "/nowhere"), marks=pytest.mark.slow
        ),
    ],
)
def test_another_python_on_the_path_does_not_matter(
    paths: tuple[str, ...], c_host: Path, elastic: Path, tmp_path: Path
) -> None:
    """The interpreter takes its library from where its libpython lies, and ends before the
    libraries it has loaded.
    """
    other = tmp_path / "bin"
    other.mkdir()
    (other / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}").mkdir(parents=True)
    (
        other / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "os.py"
    ).write_text("raise SystemExit('the wrong library')\n")
    (other / "python3").write_text("#!/bin/sh\nexit 3\n")
    (other / "python3").chmod(0o755)
    run = command(c_host, elastic, tmp_path, 1, 20)
    outputs = []
    for path in paths:
        environment = {
            "PATH": path.format(other=other),
            "LC_ALL": "C",
            "IRJ_PYTHON": sys.executable,
        }
        done = subprocess.run(
            run, cwd="/", env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, (path, done.stderr)
        outputs.append(done.stdout)
    assert len(set(outputs)) == 1


@pytest.mark.slow
def test_valgrind_finds_no_invalid_access(c_host: Path, elastic: Path, tmp_path: Path) -> None:
    """Interpreter, numpy, casadi and the estimator with its fault detector; about two minutes
    of processor time.
    """
    valgrind = shutil.which("valgrind")
    assert valgrind is not None, "install valgrind"
    (tmp_path / "loader.supp").write_text(LOADER)
    options = [
        "--undef-value-errors=no",
        "--error-exitcode=9",
        f"--suppressions={tmp_path}/loader.supp",
    ]
    done = subprocess.run(
        [valgrind, *options, *command(c_host, elastic, tmp_path, 2, 430)],
        env=clean_environment(PYTHONMALLOC="malloc"),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    assert "ERROR SUMMARY: 0 errors" in done.stderr
