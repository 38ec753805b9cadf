"""Cost of the FMUs per step under fmpy, and of a batch: ``python benchmarks/fmu.py [estimator plant
batch]``.

estimator   set six readings, step 1 ms, get all estimates and health; without and with fault
detection, and native; an FMU of pythonfmu alone with the same variables whose step does nothing
plant       set the current, step 1 ms, get five readings; the same plant written in
pythonfmu beside it batch       1000 runs of a plant over a parameter, the better of three times,
against a plain loop of fmpy's simulate_fmu, in the same run
"""

from __future__ import annotations

import ctypes
import math
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from irj_fmu.batch.fleet import Batch, run_fleet
from irj_fmu.build import Request, build
from irj_fmu.fmi.package import SlaveSpec, package_slave
from irj_fmu.host.run import Fmu, Instance
from irj_fmu.host.signals import Table
from irj_fmu.plant.joint import PlantOptions, plant_spec
from irj_fmu.plant.library import build_plant
from irj_fmu.plant.reference import reference_joint, start_of

STEP = 1e-3
ROUNDS = 3
"""Times that each way of running a batch is timed, in turn; the shortest counts: what else the
machine does falls on either.
"""
_PYTHON_PLANT = '''
"""The irj_ts plant in plain Python: classical Runge-Kutta, two steps per millisecond."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from irj_fmu.fmi.slave_base import TableSlave
from irj_fmu.fmi.variables import Value, Variable

V = VALUES


class PythonPlant(TableSlave):
    variables = (
        Variable("i_m", "A", 0.0, causality="input"),
        *(Variable(n, causality="output") for n in (
            "motor_position", "motor_velocity", "link_position", "link_velocity", "link_torque")),
    )

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.x = (0.0, 0.0, 0.0, 0.0)

    def slope(self, x: tuple[float, ...], drive: float) -> tuple[float, ...]:
        q, w, link, rate = x
        d = q - link
        torque = V["stiffness"] * d + V["cubic_stiffness"] * d * d * d
        decay = math.exp(-abs(w) / V["motor_smooth_stribeck_velocity"])
        damping = V["motor_viscous"] + V["motor_smooth_stribeck"] * decay
        motor = V["motor_added_spring"] * q + damping * w
        motor += V["motor_coulomb"] * math.tanh(w / V["motor_smoothing_velocity"])
        sine = V["link_cyclic_torque_sine"] - V["gravity_torque"]
        load = V["link_viscous"] * rate + sine * math.sin(link)
        up, out = (drive - torque - motor) / V["motor_inertia"], (torque - load) / V["link_inertia"]
        return (w, up, rate, out)

    def process(self, time: float, step: float, inputs: Mapping[str, Value]) -> Mapping[str, Value]:
        drive, x, h = V["torque_per_current"] * float(inputs["i_m"]), self.x, step / 2
        for _ in range(2):
            k1 = self.slope(x, drive)
            k2 = self.slope(tuple(a + h / 2 * b for a, b in zip(x, k1)), drive)
            k3 = self.slope(tuple(a + h / 2 * b for a, b in zip(x, k2)), drive)
            k4 = self.slope(tuple(a + h * b for a, b in zip(x, k3)), drive)
            x = tuple(
                a + h / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip(x, k1, k2, k3, k4))
        self.x = x
        return {"motor_position": x[0], "motor_velocity": x[1],
                "link_position": x[2], "link_velocity": x[3],
                "link_torque": V["stiffness"] * (x[0] - x[2])}
'''

_EMPTY = '''
"""As many variables, and a step that does nothing."""

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real

DISCRETE = Fmi2Variability.discrete


class Empty(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        for name in INPUTS:
            setattr(self, name, 0.0)
            self.register_variable(Real(name, causality=Fmi2Causality.input))
        for i in range(REALS):
            setattr(self, f"out{i}", 0.0)
            self.register_variable(Real(f"out{i}", causality=Fmi2Causality.output))
        for name in ("health", "fault"):
            setattr(self, name, 0)
            self.register_variable(
                Integer(name, causality=Fmi2Causality.output, variability=DISCRETE)
            )

    def do_step(self, current_time, step_size):
        return True
'''


def timed(
    path: Path,
    inputs: list[str],
    outputs: list[str],
    table: np.ndarray[Any, Any],
    skip: int,
    **parameters: Any,
) -> tuple[float, float, float]:
    """Median, mean processor time and 99 % quantile of set + step + get [us], raw calls of fmpy
    on buffers made once.
    """
    with Fmu(path) as fmu, Instance(fmu) as instance:
        instance.begin(0.0, parameters)
        instance.ready()
        raw, write, reads = instance.raw, instance.blocks(inputs)[0], instance.blocks(outputs)
        spent, used = np.empty(len(table)), 0.0
        step = ctypes.c_double(STEP)
        for k, row in enumerate(table.tolist()):
            write.values[:] = row
            if k == skip:
                used = time.thread_time()
            begin = time.perf_counter()
            raw.fmi2SetReal(raw.component, write.references, len(inputs), write.values)
            raw.fmi2DoStep(raw.component, k * STEP, step, 1)
            for block in reads:
                getattr(raw, f"fmi2Get{block.type}")(
                    raw.component, block.references, len(block.names), block.values
                )
            spent[k] = time.perf_counter() - begin
        used = (time.thread_time() - used) / (len(table) - skip)
    spent = spent[skip:] * 1e6
    return float(np.median(spent)), used * 1e6, float(np.quantile(spent, 0.99))


def readings(count: int) -> np.ndarray[Any, Any]:
    """Readings of the irj_ts joint with sensor noise, (count, 6)."""
    from casadi_models.simulate import simulate

    joint = reference_joint("irj_ts")
    t = STEP * np.arange(count)
    drive = 250 * np.sin(2 * np.pi * 0.4 * t) + 60 * np.sin(2 * np.pi * 1.7 * t)
    found = simulate(joint.model(), drive, STEP).readings
    table = np.column_stack([drive / (joint.torque_per_current or 1.0), found])
    table[:, 1:3] *= joint.gear_ratio
    noise: np.ndarray[Any, Any] = np.random.default_rng(1).normal(size=table.shape) * [
        2e-3,
        3e-4,
        0.1,
        2e-6,
        1e-3,
        0.05,
    ]
    return table + noise


def _empty(folder: Path, inputs: list[str], reals: int) -> Path:
    """An FMU of pythonfmu alone whose step does nothing."""
    from pythonfmu.builder import FmuBuilder

    script = folder / "empty.py"
    script.write_text(_EMPTY.replace("INPUTS", repr(inputs)).replace("REALS", str(reals)))
    built: Path = FmuBuilder.build_FMU(script, dest=folder)
    return built


def estimator(folder: Path) -> None:
    """Cost of the estimator with twelve parameters and three balances, and of its native twin, as
    multiples of a step of pythonfmu that does nothing.
    """
    from identification.data.joint_file import toml_text
    from irj_fmu.estimator.native import NativeSpec, build_native

    joint = replace(reference_joint("irj_ts"), name="bench")
    inputs, table = ["i_m", "q_m", "w_m", "q_l", "w_l", "tau_l"], readings(20000)
    path = folder / "bench.toml"
    made = {}
    for about, held in (
        ("without fault detection", start_of(joint)),
        ("with fault detection", joint),
    ):
        path.write_text(
            toml_text(
                held, {k: {"value": v, "unit": "", "side": ""} for k, v in held.fitted.items()}
            ),
            encoding="utf-8",
        )
        (made[about],) = build("estimator", Request(held, path, folder / about.replace(" ", "_")))
    made["native, with fault detection"] = build_native(
        NativeSpec(joint, "bench"), folder / "native.fmu"
    )
    with Fmu(made["with fault detection"]) as fmu:
        names = [n for n in fmu.variables if n.startswith(("theta[", "ratio."))]
    empty = _empty(folder, inputs, len(names))
    nothing = timed(
        empty, inputs, [*(f"out{i}" for i in range(len(names))), "health", "fault"], table, 8000
    )
    names += ["health", "fault"]
    print(f"pythonfmu, a step that does nothing: {nothing[1]:.1f} us of processor time")
    for about, file in made.items():
        low, mean, top = timed(file, inputs, names, table, 8000)
        most = 0.5 if about.startswith("native") else 3.0
        print(
            f"estimator {about}: set + step + get({len(names)}) median {low:.1f} us, mean "
            f"{mean:.1f} us of processor time, 99 % {top:.0f} us; {mean / nothing[1]:.2f} times "
            f"the step that does nothing (wanted: {most:g})"
        )


def plant(folder: Path) -> None:
    """Cost of the plant in C and of the same plant in Python."""
    joint = reference_joint("irj_ts")
    made = build_plant(
        plant_spec(joint, PlantOptions(name="bench_plant")), folder / "bench_plant.fmu"
    )
    module = folder / "python_plant.py"
    module.write_text(
        _PYTHON_PLANT.replace(
            "VALUES", repr({**joint.fitted, "torque_per_current": joint.torque_per_current})
        )
    )
    slow = package_slave(
        SlaveSpec("python_plant", "python_plant", "PythonPlant", (module,)),
        folder / "python_plant.fmu",
        shim=False,
    ).path
    outputs = ["motor_position", "motor_velocity", "link_position", "link_velocity", "link_torque"]
    current = 15 * np.sin(2 * np.pi * 0.4 * STEP * np.arange(20000))[:, None]
    found = {
        about: timed(path, ["i_m"], outputs, current, 1000)
        for about, path in (("C", made), ("pythonfmu", slow))
    }
    for about, (low, mean, top) in found.items():
        print(
            f"plant in {about}: set + step + get(5) median {low:.1f} us, mean {mean:.1f} us of "
            f"processor time, 99 % {top:.0f} us"
        )
    print(
        f"plant: {found['pythonfmu'][1] / found['C'][1]:.1f} times faster in C (wanted: 2; C "
        "under 12 us)"
    )


def batch(folder: Path, runs: int = 1000) -> None:
    """A batch against the naive loop: same FMU, same 1000 runs, same results; with all
    processors and with one process.
    """
    from fmpy import simulate_fmu

    joint = reference_joint("irj_ts")
    made = build_plant(
        plant_spec(joint, PlantOptions(name="bench_batch")), folder / "bench_batch.fmu"
    )
    t = 1e-2 * np.arange(101)
    current = 15 * np.sin(2 * np.pi * 0.4 * t)
    values = np.linspace(1e4, 4e4, runs)
    signal = np.array(list(zip(t, current, strict=True)), dtype=[("time", "f8"), ("i_m", "f8")])
    many = Batch(
        made,
        [{"stiffness": float(v)} for v in values],
        ["link_position"],
        {"i_m": Table(t, current, hold=True)},
        step=1e-2,
        stop=1.0,
        chunk=20,
    )
    run_fleet(replace(many, cases=many.cases[:1]))  # imports are made once for either
    took: dict[str, float] = {}
    for about, workers in (("all processors", None), ("one process", 1)) * ROUNDS:
        begin = time.perf_counter()
        found = run_fleet(many, workers=workers)
        took[about] = min(time.perf_counter() - begin, took.get(about, math.inf))
    begin = time.perf_counter()
    kept = [
        simulate_fmu(
            str(made),
            stop_time=1.0,
            output_interval=1e-2,
            fmi_type="CoSimulation",
            input=signal,
            start_values={"stiffness": float(v)},
            output=["link_position"],
        )["link_position"]
        for v in values
    ]
    slow = time.perf_counter() - begin
    print(f"naive loop of {runs}: {slow:.1f} s, {runs / slow:.0f} runs/s")
    for about, fast in took.items():
        print(
            f"batch of {runs}, {about}: {fast:.1f} s, {runs / fast:.0f} runs/s, "
            f"{slow / fast:.1f} times the naive loop (wanted: 4)"
        )
    apart = np.abs(found.signals["link_position"][:, -1] - np.array(kept)[:, -1]).max()
    print(
        f"largest difference at the end: {apart:.1e} rad (the naive loop ramps the input where "
        "the batch holds it)"
    )


def main() -> None:
    """Run what is named, or everything."""
    parts = {"estimator": estimator, "plant": plant, "batch": batch}
    with tempfile.TemporaryDirectory() as folder:
        for name in sys.argv[1:] or parts:
            parts[name](Path(folder))


if __name__ == "__main__":
    main()
