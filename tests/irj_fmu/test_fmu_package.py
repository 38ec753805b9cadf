"""Slave FMUs: a toy slave with numpy, in Python hosts, C hosts, two at once, and under valgrind."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from identification.errors import InputError
from irj_fmu.fmi import package
from irj_fmu.fmi.compiler import compile_library, header_folder
from irj_fmu.fmi.package import Packaged, SlaveSpec, package_slave

HERE = Path(__file__).parents[1]
STEP = 1e-3


def helper(folder: Path, scale: float) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "fmu_toy_helper.py"
    path.write_text(f"SCALE = {scale}\n\ndef scale_again():\n    return SCALE\n")
    return path


def pack(folder: Path, scale: float = 3.0, name: str = "toy.fmu", **options: Any) -> Packaged:
    modules = (HERE / "fmu_toy_slave.py", helper(folder / f"{scale}", scale))
    spec = SlaveSpec("toy", "fmu_toy_slave", "ToySlave", modules)
    return package_slave(spec, folder / name, **options)


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = pack(tmp_path_factory.mktemp("slave"))
    assert made.has_shim
    return made.path


@pytest.fixture(scope="module")
def unzipped(fmu: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An extraction whose path holds a space, an umlaut, '#', '+' and '%41'."""
    folder = tmp_path_factory.mktemp("open") / "a b ü #1 + %41"
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(folder)
    return folder


def instance(unzipped: Path, init: bool = True) -> Any:
    from fmpy import read_model_description
    from fmpy.fmi2 import FMU2Slave

    description = read_model_description(str(unzipped))
    made = FMU2Slave(
        guid=description.guid,
        unzipDirectory=str(unzipped),
        modelIdentifier="toy",
        instanceName="toy",
    )
    messages: list[str] = []
    made.messages = messages
    made.vr = {v.name: v.valueReference for v in description.modelVariables}
    made.kept = callbacks(messages)
    made.instantiate(callbacks=made.kept, loggingOn=True)
    made.setupExperiment(startTime=0.0)
    made.enterInitializationMode()
    if init:
        made.exitInitializationMode()
    return made


def callbacks(messages: list[str]) -> Any:
    from fmpy.fmi2 import (
        fmi2CallbackAllocateMemoryTYPE,
        fmi2CallbackFreeMemoryTYPE,
        fmi2CallbackFunctions,
        fmi2CallbackLoggerTYPE,
    )
    from fmpy.simulation import calloc, free

    def note(_: Any, _name: bytes, status: int, category: bytes, message: bytes) -> None:
        messages.append(f"{status} {category.decode()} {message.decode()}")

    made = fmi2CallbackFunctions()
    made.logger = fmi2CallbackLoggerTYPE(note)
    made.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
    made.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
    return made


def pair(i: int) -> list[float]:
    u = float(np.sin(0.3 * i))
    return [u, 2 * u + 0.5 + 0.1 * float(np.cos(float(i)))]


def run(slave: Any, first: int, last: int, step: float = STEP) -> list[float]:
    out = []
    for i in range(first, last):
        slave.setReal([slave.vr["u"], slave.vr["y"]], pair(i))
        slave.doStep(i * step, step)
        out.append(slave.getReal([slave.vr["theta[1]"]])[0])
    return out


def health(slave: Any) -> int:
    return int(slave.getInteger([slave.vr["health"]])[0])


def test_validates_clean(fmu: Path) -> None:
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(fmu)) == []


def test_estimates_in_fmpy(unzipped: Path) -> None:
    """The least-squares line through the same points, by numpy's lstsq with the forgetting
    weights.
    """
    slave = instance(unzipped)
    found = run(slave, 0, 300)[-1]
    slave.freeInstance()
    points = np.array([pair(i) for i in range(300)])
    weight = np.sqrt(0.999 ** np.arange(299, -1, -1))
    matrix = np.column_stack([points[:, 0], np.ones(300)])
    prior = np.sqrt(0.999**300 / 1e3) * np.eye(2)
    expected, *_ = np.linalg.lstsq(
        np.vstack([matrix * weight[:, None], prior]),
        np.concatenate([points[:, 1] * weight, np.zeros(2)]),
    )
    assert found == pytest.approx(expected[0], rel=1e-9)


@pytest.fixture(scope="module")
def c_host(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("gcc") or shutil.which("cc")
    assert compiler is not None, "the C host of the tests needs gcc"
    path = tmp_path_factory.mktemp("host") / "fmu_host"
    source = HERE / "fmu_host.c"
    flags = ["-g", "-O1", f"-I{header_folder()}", "-o", str(path)]
    subprocess.run([compiler, str(source), *flags, "-ldl", "-lm"], check=True)
    return path


def host_command(c_host: Path, unzipped: Path, cycles: int, steps: int) -> list[str]:
    from fmpy import read_model_description

    description = read_model_description(str(unzipped))
    vr = {v.name: str(v.valueReference) for v in description.modelVariables}
    library = unzipped / "binaries" / "linux64" / "toy.so"
    uri = (unzipped / "resources").as_uri()
    counts = [str(cycles), str(steps), str(STEP)]
    return [
        str(c_host),
        str(library),
        uri,
        description.guid,
        *counts,
        vr["u"],
        vr["y"],
        vr["theta[1]"],
    ]


def clean_environment(**more: str) -> dict[str, str]:
    """Nothing of the calling shell but where Python is."""
    return {
        "PATH": os.defpath,
        "HOME": os.environ.get("HOME", "/"),
        "LC_ALL": "C.UTF-8",
        "IRJ_PYTHON": sys.executable,
        **more,
    }


def test_c_host_agrees_with_fmpy(c_host: Path, unzipped: Path, tmp_path: Path) -> None:
    """50 cycles without LD_PRELOAD, from another working directory, special characters in the
    path.
    """
    done = subprocess.run(
        host_command(c_host, unzipped, 50, 40),
        cwd=tmp_path,
        env=clean_environment(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    slave = instance(unzipped)
    np.testing.assert_allclose(
        [float(x) for x in done.stdout.split()], run(slave, 0, 40), rtol=1e-12, atol=0
    )
    slave.freeInstance()


def test_c_host_without_python_says_so(c_host: Path, unzipped: Path) -> None:
    done = subprocess.run(
        host_command(c_host, unzipped, 1, 2),
        env=clean_environment(IRJ_LIBPYTHON="/nowhere/libpython3.so"),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 4
    assert "IRJ_LIBPYTHON=/nowhere/libpython3.so cannot be loaded" in done.stderr


def test_cycles_in_python_exit_cleanly(fmu: Path, tmp_path: Path) -> None:
    """50 extractions, instances and removals in a process of its own, which ends with 0."""
    code = """
import sys, fmpy, shutil
for i in range(50):
    folder = fmpy.extract(sys.argv[1])
    result = fmpy.simulate_fmu(folder, stop_time=0.01, output_interval=1e-3)
    assert result["n_samples"][-1] == 10 and result["scale"][-1] == 6.0, result
    shutil.rmtree(folder)
assert not [name for name in sys.path if "resources" in name], sys.path
"""
    done = subprocess.run(
        [sys.executable, "-I", "-c", code, str(fmu)], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


LOADER = """{
   glibc's loader compares strings eight bytes at a time, within its own block
   Memcheck:Addr8
   fun:strncmp
   fun:is_dst
}
"""


@pytest.mark.slow
def test_valgrind_finds_no_invalid_access(c_host: Path, unzipped: Path, tmp_path: Path) -> None:
    valgrind = shutil.which("valgrind")
    assert valgrind is not None, "install valgrind"
    (tmp_path / "loader.supp").write_text(LOADER)
    options = [
        "--undef-value-errors=no",
        "--error-exitcode=9",
        f"--suppressions={tmp_path}/loader.supp",
    ]
    done = subprocess.run(
        [valgrind, *options, *host_command(c_host, unzipped, 3, 5)],
        env=clean_environment(PYTHONMALLOC="malloc"),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    assert "ERROR SUMMARY: 0 errors" in done.stderr


def test_two_fmus_and_the_host_keep_their_own_modules(tmp_path: Path) -> None:
    """Same names, different contents, and the host has modules of those names imported, too."""
    from fmpy import extract

    import irj_fmu.fmi.variables as mine

    values = []
    folders = [
        Path(extract(str(pack(tmp_path, scale, f"{scale}.fmu").path), str(tmp_path / str(scale))))
        for scale in (3.0, 5.0)
    ]
    slaves = [instance(folder) for folder in folders]
    for folder in folders:
        shutil.rmtree(folder / "resources" / "bundle")  # a late import must not need the folder
    for slave in slaves:
        run(slave, 0, 3)
        values.append(slave.getReal([slave.vr["scale"]])[0])
        slave.freeInstance()
    assert values == [6.0, 10.0]
    assert sys.modules["irj_fmu.fmi.variables"] is mine
    assert "fmu_toy_helper" not in sys.modules


def test_rollback_and_serialisation_are_bit_exact(unzipped: Path) -> None:
    slave, other = instance(unzipped), instance(unzipped)
    run(slave, 0, 30)
    saved = slave.getFMUState()
    data = slave.serializeFMUState(saved)
    first = run(slave, 30, 60)
    slave.setFMUState(saved)
    assert run(slave, 30, 60) == first
    restored = other.deserializeFMUState(data)
    other.setFMUState(restored)
    assert run(other, 30, 60) == first
    for made, state in ((slave, saved), (other, restored)):
        made.freeFMUState(state)
        made.freeInstance()


def test_step_sizes(unzipped: Path) -> None:
    """Smaller steps wait for the sample time, larger ones are flagged, steps that do not divide
    it keep the rate.
    """
    slave = instance(unzipped)
    n = slave.vr["n_samples"]
    for i in range(40):
        slave.doStep(i * STEP / 4, STEP / 4)
    assert (slave.getInteger([n])[0], health(slave)) == (10, 0)
    slave.doStep(0.010, 2 * STEP)
    assert health(slave) == 3
    slave.doStep(0.012, STEP)
    assert health(slave) == 0
    slave.freeInstance()
    slave = instance(unzipped)
    for i in range(1000):
        slave.doStep(i * 0.3e-3, 0.3e-3)
    assert abs(slave.getInteger([n])[0] - 300) <= 1
    slave.freeInstance()


def test_trouble_shows_in_health_and_log(unzipped: Path) -> None:
    slave = instance(unzipped)
    before = run(slave, 0, 20)[-1]
    slave.setReal([slave.vr["u"]], [float("nan")])
    slave.doStep(0.020, STEP)
    assert health(slave) == 2
    slave.setReal([slave.vr["u"]], [0.3])
    slave.setBoolean([slave.vr["fail"]], [True])
    slave.doStep(0.021, STEP)
    assert health(slave) == 4
    assert slave.getReal([slave.vr["theta[1]"]]) == [before]
    slave.setBoolean([slave.vr["fail"]], [False])
    slave.doStep(0.022, STEP)
    assert health(slave) == 0
    assert any("told to fail at 100 %%s" in text for text in slave.messages)
    assert any("input not finite: u" in text for text in slave.messages)
    slave.freeInstance()


def test_fixed_parameters_stay_and_tunable_ones_act(unzipped: Path) -> None:
    slave = instance(unzipped)
    other = instance(unzipped)
    assert run(slave, 0, 10) == run(other, 0, 10)
    slave.setReal([slave.vr["forgetting"]], [0.6])
    assert run(slave, 10, 20) != run(other, 10, 20)
    slave.setReal([slave.vr["sample_time"], slave.vr["theta[1]"]], [0.5, 1e9])
    assert slave.getReal([slave.vr["sample_time"]]) == [STEP]
    assert slave.getReal([slave.vr["theta[1]"]])[0] < 1e6
    assert any("sample_time cannot be set" in text for text in slave.messages)
    slave.freeInstance()
    other.freeInstance()


def test_the_wrong_type_is_an_error_and_the_slave_lives(unzipped: Path) -> None:
    """It is a host's mistake; in the inner library it would be the end of the instance."""
    slave, number = instance(unzipped), int(instance(unzipped).vr["health"])
    with pytest.raises(Exception, match="error"):
        slave.setReal([number], [0.5])
    assert any(f"variable {number} is of another type" in text for text in slave.messages)
    slave.doStep(0.0, STEP)
    assert health(slave) == 0
    slave.freeInstance()


def test_same_bytes_again(fmu: Path, tmp_path: Path) -> None:
    package._described.clear()  # written anew, by another process
    assert pack(tmp_path).path.read_bytes() == fmu.read_bytes()


def test_builds_without_a_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("irj_fmu.fmi.compiler.shutil.which", lambda _: None)
    monkeypatch.setattr("irj_fmu.fmi.compiler.has_zig", lambda: False)
    made = pack(tmp_path)
    assert not made.has_shim
    assert "pip install ziglang" in made.message
    import fmpy

    result = fmpy.simulate_fmu(str(made.path), stop_time=0.01, output_interval=1e-3)
    assert result["n_samples"][-1] == 10


def test_refuses_what_cannot_be_packed(tmp_path: Path) -> None:
    toy = HERE / "fmu_toy_slave.py"
    with pytest.raises(InputError, match="No module named 'fmu_toy_helper'"):
        package_slave(SlaveSpec("toy", "fmu_toy_slave", "ToySlave", (toy,)), tmp_path / "a.fmu")
    with pytest.raises(InputError, match="not among the bundled"):
        package_slave(SlaveSpec("toy", "other", "ToySlave", (toy,)), tmp_path / "a.fmu")
    with pytest.raises(InputError, match="no such package"):
        package_slave(SlaveSpec("toy", "x", "ToySlave", (tmp_path / "x",)), tmp_path / "a.fmu")
    with pytest.raises(InputError, match="C identifier"):
        package_slave(SlaveSpec("to y", "x", "ToySlave", ()), tmp_path / "a.fmu")
    spec = SlaveSpec(
        "toy", "fmu_toy_slave", "ToySlave", (toy,), {"joint.toml": tmp_path / "joint.toml"}
    )
    with pytest.raises(InputError, match="no such file"):
        package_slave(spec, tmp_path / "a.fmu")
    assert list(tmp_path.iterdir()) == []


def test_fmutool_check_is_clean(fmu: Path, tmp_path: Path) -> None:
    tool = Path(sys.executable).with_name("fmutool")
    done = subprocess.run(
        [tool, "-input", str(fmu), "-check"], cwd=tmp_path, capture_output=True, text=True
    )
    text = re.sub(r"\x1b\[[0-9;]*m", "", done.stdout + done.stderr)
    assert done.returncode == 0, text
    assert "compliant with FMI-2" in text, text
    assert "No semantic error" in text, text
    assert not re.search(r"ERROR|WARNING|CRITICAL|not compliant", text), text


def ecos(folder: Path) -> Path:
    """Copy the `ecos` program of the ecospy package to where it may be executed."""
    import importlib.util

    spec = importlib.util.find_spec("ecospy")
    assert spec is not None, "pip install ecospy"
    assert spec.origin is not None
    shutil.copytree(Path(spec.origin).parent / "binaries", folder / "bin")
    program = folder / "bin" / "ecos"
    program.chmod(0o755)
    return program


@pytest.fixture(scope="module")
def constant_inputs(unzipped: Path) -> list[float]:
    """What the estimate is after each of 20 steps with the start values of the inputs."""
    slave = instance(unzipped)
    out = []
    for i in range(20):
        slave.doStep(i * STEP, STEP)
        out.append(slave.getReal([slave.vr["theta[1]"]])[0])
    slave.freeInstance()
    return out


def test_ecos_agrees_with_fmpy(fmu: Path, tmp_path: Path, constant_inputs: list[float]) -> None:
    program = ecos(tmp_path)
    done = subprocess.run(
        [program, "simulate", "--path", str(fmu), "--stopTime", "0.02", "--stepSize", str(STEP)],
        cwd=tmp_path,
        env=clean_environment(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    table = next(path for path in tmp_path.rglob("*.csv"))
    lines = table.read_text().splitlines()
    names = [name.split("[REAL]")[0].strip() for name in lines[0].split(",")]
    column = next(i for i, name in enumerate(names) if "theta[1]" in name)
    found = [float(line.split(",")[column]) for line in lines[1:]]
    assert len(found) >= 20
    np.testing.assert_allclose(found[-1], constant_inputs[len(found[1:]) - 1], rtol=1e-6)


def test_libcosim_agrees_with_fmpy(fmu: Path, tmp_path: Path, constant_inputs: list[float]) -> None:
    """In a process of its own: libcosim leaves threads behind."""
    code = f"""
import sys
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimSlave import CosimLocalSlave
from libcosimpy.CosimObserver import CosimObserver
execution = CosimExecution.from_step_size(step_size={int(STEP * 1e9)})
index = execution.add_local_slave(CosimLocalSlave(fmu_path=sys.argv[1], instance_name="toy"))
observer = CosimObserver.create_last_value()
execution.add_observer(observer)
assert execution.step(step_count=20)
print("theta=%r" % observer.last_real_values(index, [int(sys.argv[2])])[0], flush=True)
"""
    from fmpy import read_model_description

    vr = {v.name: v.valueReference for v in read_model_description(str(fmu)).modelVariables}
    done = subprocess.run(
        [sys.executable, "-c", code, str(fmu), str(vr["theta[1]"])],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    theta = next(line for line in done.stdout.splitlines() if line.startswith("theta="))
    assert float(theta.removeprefix("theta=")) == pytest.approx(constant_inputs[-1], rel=1e-12)


def test_shim_compiles_without_warnings(tmp_path: Path) -> None:
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("gcc is not installed")
    config = {
        "INNER_LIBRARY": '"x.so"',
        "LIBPYTHON_CANDIDATES": '"a", "b"',
        "GUID": '"g"',
        "KINDS": '"R"',
        "MODULES": '"m"',
    }
    (tmp_path / "shim_config.h").write_text(
        "".join(f"#define {name} {text}\n" for name, text in config.items())
    )
    source = HERE.parent / "irj_fmu" / "c" / "slave_shim.c"
    flags = [
        "-std=gnu99",
        "-Wall",
        "-Werror",
        "-fsyntax-only",
        f"-I{header_folder()}",
        f"-I{tmp_path}",
    ]
    subprocess.run([compiler, *flags, "-D_GNU_SOURCE", str(source)], check=True)
    assert (
        compile_library({"a.c": b"int f(void) { return 1; }"}, "a.c", "x86_64-linux-gnu")[:4]
        == b"\x7fELF"
    )
