"""Cost of the native estimator and its distance to the Python one: ``python benchmarks/native.py
[JOINT...]``.

For each reference joint, 40 s at 1 kHz with every kind of sensor fault, optimiser off: processor
time of set + step + get in a C host (best of five), that of the longest step (the start of the
recursion), and the largest difference of any real output after any sample to the Python
estimator's, as a share of that output's largest value or, where it is small, of 1. With ``--wine``
the same for the Windows library under wine, against the Linux one. With ``--skewed`` the link
encoder has a zero and is late by 2.6 samples, the torque sensor by 0.7, and no detector watches:
the rows of the first window are made again.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from fmpy import read_model_description

from casadi_models.simulate import simulate
from identification.data.joint_file import toml_text
from identification.faults.detector import FaultDetector
from identification.online.estimator import OnlineOptions, prepared
from irj_fmu.estimator.native import NativeSpec, build_native
from irj_fmu.estimator.packed import options_text
from irj_fmu.estimator.slave import DETECTOR_FILE, JOINT_FILE, OPTIONS_FILE, Estimator
from irj_fmu.fmi.compiler import find_compiler, header_folder
from irj_fmu.plant.reference import reference_joint

FloatArray = npt.NDArray[np.float64]
STEP = 1e-3
JOINTS = ("hd3", "hd4", "irj2b", "irj_ts", "irj1b")
PLAIN = OnlineOptions(optimise=False)
HOST = Path(__file__).resolve().parents[1] / "irj_fmu" / "c" / "native_host.c"


def readings_of(key: str, seconds: float, seed: int = 3) -> FloatArray:
    """Readings of a reference joint with the noise of real sensors, (samples, 6)."""
    time = STEP * np.arange(round(seconds / STEP) + 1)
    size = 1.0 if key.startswith("hd") else 0.4  # less friction to overcome
    drive = size * (250 * np.sin(2 * np.pi * 0.4 * time) + 60 * np.sin(2 * np.pi * 1.7 * time))
    joint = reference_joint(key)
    found = simulate(joint.model().with_values({"gravity_torque": -105.0}), drive, STEP).readings
    table = np.column_stack([drive / (joint.torque_per_current or joint.gear_ratio), found])
    table[:, 1:3] *= joint.gear_ratio
    noise = np.random.default_rng(seed).normal(size=table.shape)
    return table + noise * np.array([2e-3, 3e-4, 0.1, 2e-6, 1e-3, 0.05])


def hurt(table: FloatArray, *, stuck: bool = True) -> FloatArray:
    """Bias, dropout, gain, spike, drift, infinity, zero, noise, delay; two at a time; and a
    stuck motor encoder.
    """
    t, rng = table.copy(), np.random.default_rng(1)
    t[10_000:11_000, 3] += 0.01
    t[13_000:14_000, 4] = np.nan
    if stuck:
        t[15_500:17_000, 1] = t[15_500, 1]
    t[18_000:19_000, 2] *= 1.4
    t[20_000, 3] += 0.5
    t[21_000:22_500, 5] += np.linspace(0, 150, 1500)
    t[24_000:25_000, 0] = np.inf
    t[26_000:27_000, 3] = 0
    t[26_300:27_200, 2] = 0
    t[29_000:30_500, 5] += rng.normal(size=1500) * 20
    t[32_000:33_000, 0] *= 0.3
    t[34_000:36_000, 4] = np.roll(t[34_000:36_000, 4], 200)
    return t


def skewed(table: FloatArray) -> FloatArray:
    """The link encoder 2 mrad off and late by 2.6 samples, the torque sensor by 0.7."""
    late = table.copy()
    late[3:, 3:5] = 0.4 * table[1:-2, 3:5] + 0.6 * table[:-3, 3:5]
    late[3:, 3] += 2e-3
    late[3:, 5] = 0.7 * table[2:-1, 5] + 0.3 * table[3:, 5]
    return late[3:]


def specification(key: str) -> NativeSpec:
    """The joint with a fault detector calibrated on a healthy run, where it has one."""
    joint = reference_joint(key)
    model, _ = prepared(joint, PLAIN)
    if not model.is_elastic:
        return NativeSpec(joint, "native", PLAIN)
    gear = joint.gear_ratio
    detector = FaultDetector(model, STEP)
    detector.calibrate(
        readings_of(key, 30.0, 9)
        * np.array([joint.torque_per_current or gear, 1 / gear, 1 / gear, 1.0, 1.0, 1.0])
    )
    return NativeSpec(joint, "native", PLAIN, detector.state())


def python_outputs(
    spec: NativeSpec, folder: Path, table: FloatArray, inputs: Sequence[int], outputs: Sequence[int]
) -> FloatArray:
    """Real outputs of the Python estimator after each sample."""
    values = {k: {"value": v, "unit": "", "side": ""} for k, v in spec.joint.fitted.items()}
    (folder / JOINT_FILE).write_text(toml_text(spec.joint, values), encoding="utf-8")
    (folder / OPTIONS_FILE).write_text(options_text(spec.options), encoding="utf-8")
    if spec.detector_state is not None:
        (folder / DETECTOR_FILE).write_bytes(spec.detector_state)
    slave = Estimator(instance_name="python", resources=str(folder))
    slave.log = lambda *_: None
    slave.setup_experiment(0.0)
    slave.exit_initialization_mode()
    found = np.zeros((len(table), len(outputs)))
    for k, row in enumerate(table.tolist()):
        slave.set_real(list(inputs), row)
        slave.do_step(k * STEP, STEP)
        found[k] = slave.get_real(list(outputs))
    return found


def replay(
    host: Sequence[str],
    library: str,
    guid: str,
    folder: Path,
    inputs: Sequence[int],
    outputs: Sequence[int],
) -> tuple[FloatArray, list[float]]:
    """Real outputs in the C host; its time per step and that of the longest one [ns]."""
    command = [
        *host,
        library,
        guid,
        "readings.bin",
        "results.bin",
        str(STEP),
        ",".join(map(str, inputs)),
        ",".join(map(str, outputs)),
    ]
    environment = {**os.environ, "WINEDEBUG": "-all", "WINEPREFIX": str(folder / "wine")}
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=True, env=environment
    )
    words = done.stdout.split()
    return np.fromfile(folder / "results.bin").reshape(-1, len(outputs)), [
        float(words[2]),
        float(words[-2]),
    ]


def difference(found: FloatArray, expected: FloatArray) -> float:
    """Largest difference, each output as a share of its largest value or of 1."""
    return float(
        np.max(np.abs(found - expected) / np.maximum(np.max(np.abs(expected), axis=0), 1.0))
    )


def measure(key: str, folder: Path, host: Path) -> None:
    """One line for one joint."""
    spec, with_wine = specification(key), "--wine" in sys.argv
    late = "--skewed" in sys.argv
    if late:
        spec = replace(spec, options=replace(PLAIN, detect=False), detector_state=None)
    path = build_native(
        spec, folder / "native.fmu", target=("linux64", "win64") if with_wine else None
    )
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder / "fmu")
    description = read_model_description(str(path))
    known = {v.name: v.valueReference for v in description.modelVariables}
    inputs = [
        known[n]
        for n in ("i_m" if "i_m" in known else "tau_m", "q_m", "w_m", "q_l", "w_l", "tau_l")
    ]
    outputs = [
        v.valueReference
        for v in description.modelVariables
        if v.causality == "output" and v.type == "Real"
    ]
    table = readings_of(key, 40.0, 3)
    table = skewed(table) if late else hurt(table, stuck=spec.detector_state is not None)
    table.tofile(folder / "readings.bin")
    (library,) = (
        p
        for p in (folder / "fmu" / "binaries").rglob("native.*")
        if p.suffix in (".so", ".dylib") or (os.name == "nt" and p.suffix == ".dll")
    )
    runs = [
        replay([str(host)], str(library), description.guid, folder, inputs, outputs)
        for _ in range(5)
    ]
    found, times = runs[0][0], np.array([times for _, times in runs]).min(axis=0)
    apart = difference(found, python_outputs(spec, folder, table, inputs, outputs))
    line = (
        f"{key:8s} {times[0]:6.0f} ns per step, longest {times[1] / 1e3:5.0f} us, largest "
        f"difference to Python {apart:.1e}"
    )
    if with_wine:
        wine = shutil.which("wine64") or shutil.which("wine") or sys.exit("there is no wine")
        program = folder / "native_host.exe"
        subprocess.run(
            [
                *find_compiler("x86_64-windows-gnu", "zig"),
                str(HOST),
                "-O1",
                f"-I{header_folder()}",
                "-o",
                str(program),
            ],
            check=True,
        )
        other, _ = replay(
            [wine, str(program)],
            "fmu\\binaries\\win64\\native.dll",
            description.guid,
            folder,
            inputs,
            outputs,
        )
        line += f", Windows under wine {difference(other, found):.1e}"
    print(line, flush=True)


def main() -> None:
    """All joints asked for."""
    keys = [k for k in sys.argv[1:] if not k.startswith("--")] or list(JOINTS)
    with tempfile.TemporaryDirectory() as temporary:
        host = Path(temporary) / "native_host"
        libraries = ["-ldl"] if sys.platform == "linux" else []
        subprocess.run(
            [
                *find_compiler(),
                str(HOST),
                "-O1",
                f"-I{header_folder()}",
                "-o",
                str(host),
                *libraries,
            ],
            check=True,
        )
        for key in keys:
            folder = Path(temporary) / key
            folder.mkdir()
            measure(key, folder, host)


if __name__ == "__main__":
    main()
