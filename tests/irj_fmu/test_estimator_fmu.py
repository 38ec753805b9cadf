"""The estimator FMU: convergence against its plant, the same numbers as in Python, state, step
sizes, bad input.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from casadi_models.simulate import simulate
from identification.data.joint_file import Joint, load_joint, toml_text
from identification.online.estimator import OnlineEstimator, OnlineOptions, estimated_parameters
from irj_fmu.build import Request, build
from irj_fmu.cosim import Setting, convergence, cosimulate, make_pair
from irj_fmu.host.run import Fmu, Instance
from irj_fmu.plant.reference import NAMES, published_joint, reference_joint, start_of

FloatArray = npt.NDArray[np.float64]
SHARED = Path(__file__).resolve().parents[2].parent / "shared"
STEP = 1e-3
INPUTS = ("i_m", "q_m", "w_m", "q_l", "w_l", "tau_l")


def write(folder: Path, joint: Joint, name: str) -> Path:
    path = folder / f"{name}.toml"
    values = {k: {"value": v, "unit": "", "side": ""} for k, v in joint.fitted.items()}
    path.write_text(toml_text(replace(joint, name=name), values), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Joint files and estimators of two joints, one fitted and elastic, one not fitted and
    rigid.
    """
    folder = tmp_path_factory.mktemp("estimators")
    fitted = write(folder, reference_joint("hd3"), "elastic")
    plain = write(folder, start_of(reference_joint("irj1b")), "rigid")
    for path in (fitted, plain):
        build("estimator", Request(load_joint(path), path, folder / "dist"))
    return {
        "elastic": folder / "dist" / "elastic_estimator.fmu",
        "rigid": folder / "dist" / "rigid_estimator.fmu",
        "elastic_joint": fitted,
        "rigid_joint": plain,
    }


@pytest.fixture(scope="module")
def readings() -> dict[str, FloatArray]:
    """What an FMU sees of each joint in 10 s, shape (10001, 6), with the noise of real sensors."""
    time = STEP * np.arange(10001)
    drive = 250 * np.sin(2 * np.pi * 0.4 * time) + 60 * np.sin(2 * np.pi * 1.7 * time)
    made = {}
    for name, key in (("elastic", "hd3"), ("rigid", "irj1b")):
        joint = reference_joint(key)
        found = simulate(
            joint.model().with_values({"gravity_torque": -105.0}), drive, STEP
        ).readings
        table = np.column_stack([drive / (joint.torque_per_current or 1.0), found])
        table[:, 1:3] *= joint.gear_ratio
        noise = np.random.default_rng(3).normal(size=table.shape)
        made[name] = table + noise * np.array([2e-3, 3e-4, 0.1, 2e-6, 1e-3, 0.05])
    return made


class Host:
    """One instance under fmpy, driven sample by sample."""

    def __init__(self, path: Path, **parameters: Any) -> None:
        self.fmu = Fmu(path)
        self.instance = Instance(self.fmu, name="estimator")
        self.vr = {n: v.valueReference for n, v in self.fmu.variables.items()}
        self.instance.begin(0.0, parameters)
        self.instance.call("fmi2SetDebugLogging", self.instance.raw.component, 1, 0, None)
        self.instance.ready()
        self.inputs = [self.vr[n] for n in INPUTS]
        self.thetas = [v for n, v in self.vr.items() if n.startswith("theta[")]

    def step(self, row: FloatArray, time: float, length: float = STEP) -> None:
        self.instance.call("setReal", self.inputs, row.tolist())
        self.instance.call("doStep", time, length)

    def feed(
        self,
        table: FloatArray,
        first: int = 0,
        last: int | None = None,
        every: int = 1,
        step: float = STEP,
    ) -> None:
        for k in range(first, len(table) if last is None else last, every):
            self.step(table[k], k * step, every * step)

    @property
    def theta(self) -> FloatArray:
        return np.array(self.instance.call("getReal", self.thetas))

    def real(self, name: str) -> float:
        return float(self.instance.call("getReal", [self.vr[name]])[0])

    def integer(self, name: str) -> int:
        return int(self.instance.call("getInteger", [self.vr[name]])[0])

    @property
    def log(self) -> str:
        return "\n".join(self.instance.messages)

    def __enter__(self) -> Host:
        return self

    def __exit__(self, *_: object) -> None:
        self.instance.close()
        self.fmu.close()


def twin(
    joint: Path, table: FloatArray, dt: float = STEP, count: int | None = None
) -> OnlineEstimator:
    """The same readings through the estimator without FMI."""
    held = load_joint(joint)
    made = OnlineEstimator(held, dt, OnlineOptions())
    gains = np.array(
        [
            held.torque_per_current or held.gear_ratio,
            1 / held.gear_ratio,
            1 / held.gear_ratio,
            1.0,
            1.0,
            1.0,
        ]
    )
    for k, row in enumerate(table[:count]):
        made.update(k * dt, (row * gains).tolist(), [True] * 6)
    return made


@pytest.mark.parametrize("name", [pytest.param("elastic", marks=pytest.mark.slow), "rigid"])
def test_equals_the_python_estimator(
    name: str, files: dict[str, Path], readings: dict[str, FloatArray]
) -> None:
    """Same numbers to 1e-12, fault detection and start-up window included; the estimate has
    left its start.
    """
    table = readings[name]
    expected = twin(files[f"{name}_joint"], table)
    with Host(files[name]) as host:
        start = host.theta
        host.feed(table)
        assert host.theta == pytest.approx(expected.theta, rel=1e-12)
        for b, ratio in zip(expected.balances, expected.ratio, strict=True):
            assert host.real(f"ratio.{b}") == pytest.approx(ratio, rel=1e-12)
        assert (expected.detector is not None) == (name == "elastic")
        assert not np.array_equal(start, host.theta)
        assert host.integer("health") == 0
        assert host.integer("n_samples") == len(table)


@pytest.mark.parametrize("moment", [3000, 8500])
def test_state_is_bit_exact(
    moment: int, files: dict[str, Path], readings: dict[str, FloatArray]
) -> None:
    """Roll-back, and serialise, free, restore in a new instance: in the first window and in the
    recursion.
    """
    table, last = readings["elastic"], moment + 1500
    with Host(files["elastic"]) as host:
        host.feed(table, 0, moment)
        state = host.instance.call("getFMUstate")
        bytes_ = host.instance.call("serializeFMUstate", state)
        host.feed(table, moment, last)
        straight, score = host.theta, host.real("fault_score[4]")
        host.instance.call("setFMUstate", state)
        host.feed(table, moment, last)
        assert np.array_equal(host.theta, straight)
        assert host.real("fault_score[4]") == score
        host.instance.call("freeFMUstate", state)
    with Host(files["elastic"]) as other:
        other.instance.call("setFMUstate", other.instance.call("deSerializeFMUstate", bytes_))
        other.feed(table, moment, last)
        assert np.array_equal(other.theta, straight)
        assert other.real("fault_score[4]") == score


@pytest.mark.parametrize(
    ("length", "sample_time", "health"),
    [(0.5e-3, 1e-3, 0), (2e-3, 2e-3, 0), (2e-3, 1e-3, 0), (16e-3, 16e-3, 0), (16e-3, 1e-3, 3)],
)
def test_step_sizes(
    length: float,
    sample_time: float,
    health: int,
    files: dict[str, Path],
    readings: dict[str, FloatArray],
) -> None:
    """Smaller steps change nothing, other sample times work, larger steps are told."""
    table = readings["rigid"]
    every = max(1, round(length / STEP))
    with Host(files["rigid"], sample_time=sample_time) as host:
        if length < STEP:
            for k in range(2 * 9000):
                host.step(table[k // 2] if k % 2 == 0 else table[k // 2] * 0.9, k * length, length)
            assert np.array_equal(host.theta, twin(files["rigid_joint"], table, count=9000).theta)
        else:
            host.feed(table, every=every)
        assert host.integer("health") == health
        if not health:
            known = reference_joint("irj1b").fitted
            i = estimated_parameters(load_joint(files["rigid_joint"])).index("link_inertia")
            assert host.theta[i] == pytest.approx(known["link_inertia"], rel=0.02)


def test_default_step_of_fmpy(files: dict[str, Path]) -> None:
    """fmpy stretches the step of a run of 60 s; the health output says so."""
    from fmpy import simulate_fmu

    found = simulate_fmu(str(files["rigid"]), stop_time=60.0, output=["health"])
    assert found["health"].max() == 3


BAD = {
    "nan": (3, float("nan"), 14),
    "inf": (1, float("inf"), 12),
    "constant": (3, None, 24),
    "scale": (4, 1000.0, 35),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_readings_are_told(
    kind: str, files: dict[str, Path], readings: dict[str, FloatArray]
) -> None:
    """NaN, infinity, a dead sensor, a wrong unit: no failure, health and fault set, a line in
    the log.
    """
    column, value, fault = BAD[kind]
    table = readings["rigid"].copy()
    if kind == "scale":
        table[:, column] *= value
    elif value is None:
        table[3000:, column] = table[2999, column]
    else:
        table[3000:, column] = value
    with Host(files["rigid"]) as host:
        seen, codes = set(), set()
        for k in range(6000):
            host.step(table[k], k * STEP)
            if k % 100 == 99:
                seen.add(host.integer("health"))
                codes.add(host.integer("fault"))
        assert 2 in seen
        assert 4 not in seen
        assert fault in codes
        assert ("counts as missing" if kind in ("nan", "inf") else f"fault {fault}") in host.log
        assert np.isfinite(host.theta).all()


def test_a_missing_sensor_leaves_the_other_balances(
    files: dict[str, Path], readings: dict[str, FloatArray]
) -> None:
    """Without link position the fault detector's estimate goes on; the motor side still learns."""
    table = readings["elastic"]
    with Host(files["elastic"]) as host:
        host.feed(table, 0, 8000)
        host.instance.call("setBoolean", [host.vr["valid.q_l"]], [False])
        before = host.integer("n_rows")
        wrong = []
        for k in range(8000, 9000):
            host.step(table[k], k * STEP)
            wrong.append(abs(host.real("q_l_hat") - table[k, 3]))
        assert host.integer("fault") in (4, 14)
        assert host.integer("n_rows") > before
        assert max(wrong) < 5e-3


def test_another_joint_file(
    files: dict[str, Path], readings: dict[str, FloatArray], tmp_path: Path
) -> None:
    """The String parameter replaces the packed file; a broken one sets health and is named in
    the log.
    """
    joint = replace(
        reference_joint("hd3"), fitted={**reference_joint("hd3").fitted, "stiffness": 9999.0}
    )
    path = write(tmp_path, joint, "other")
    with Host(files["elastic"], joint_file=str(path)) as host:
        names = estimated_parameters(joint)
        assert host.theta[names.index("stiffness")] == 9999.0
    broken = tmp_path / "broken.toml"
    broken.write_text("[joint\n")
    for bad in (broken, tmp_path / "missing.toml", files["rigid_joint"]):
        with Host(files["elastic"], joint_file=str(bad)) as host:
            host.feed(readings["elastic"], 0, 20)
            assert host.integer("health") == 4
            assert bad.name in host.log


def test_enable_reset_and_tuning(files: dict[str, Path], readings: dict[str, FloatArray]) -> None:
    table = readings["rigid"]
    with Host(files["rigid"]) as host:
        host.feed(table, 0, 8000)
        host.instance.call("setBoolean", [host.vr["enable"]], [False])
        kept = host.theta
        host.feed(table, 8000, 8500)
        assert np.array_equal(host.theta, kept)
        host.instance.call("setBoolean", [host.vr["enable"]], [True])
        host.instance.call("setReal", [host.vr["drift"]], [0.5])
        host.feed(table, 8500, 9000)
        assert not np.array_equal(host.theta, kept)
        assert host.theta == pytest.approx(kept, rel=0.2)
        host.instance.call("setBoolean", [host.vr["reset"]], [True])
        host.feed(table, 9000, 9100)
        assert host.integer("health") == 1


_TWO = """
import sys, numpy as np
sys.path.insert(0, sys.argv[3])
import identification
from irj_fmu.host.run import Fmu, Instance, Wiring, simulate_cs
tables = [np.load(sys.argv[4]), np.load(sys.argv[5])]
opened = [Instance(Fmu(p), name=n) for p, n in zip(sys.argv[1:3], "ab")]
for one in opened:
    one.begin(0.0); one.ready()
names = ("i_m", "q_m", "w_m", "q_l", "w_l", "tau_l")
for k in range(8500):
    for one, table in zip(opened, tables):
        one.call("setReal", [one.variable(n).valueReference for n in names], table[k].tolist())
        one.call("doStep", k * 1e-3, 1e-3)
for one in opened:
    theta = [v for n, v in one.fmu.variables.items() if n.startswith("theta[")]
    print(*(repr(one.call("getReal", [v.valueReference])[0]) for v in theta))
"""


def test_two_variants_and_the_project_in_one_process(
    files: dict[str, Path], readings: dict[str, FloatArray], tmp_path: Path
) -> None:
    """Each gives what it gives alone."""
    paths = []
    for name in ("elastic", "rigid"):
        paths.append(tmp_path / f"{name}.npy")
        np.save(paths[-1], readings[name])
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            _TWO,
            str(files["elastic"]),
            str(files["rigid"]),
            str(root),
            *map(str, paths),
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    found = [
        np.array([float(v) for v in line.split()]) for line in done.stdout.strip().splitlines()
    ]
    for name, theta in zip(("elastic", "rigid"), found, strict=True):
        assert np.array_equal(theta, twin(files[f"{name}_joint"], readings[name], count=8500).theta)


def test_runs_in_a_c_host(tmp_path: Path) -> None:
    """No LD_PRELOAD, another working directory, a path with space, umlaut and #: each step as
    under fmpy.
    """
    import zipfile

    from irj_fmu.fmi.compiler import header_folder

    compiler = shutil.which("gcc") or shutil.which("cc")
    assert compiler is not None, "the C host of the tests needs gcc"
    program = tmp_path / "fmu_host"
    source = Path(__file__).parents[1] / "fmu_host.c"
    subprocess.run(
        [compiler, str(source), "-O1", f"-I{header_folder()}", "-o", str(program), "-ldl", "-lm"],
        check=True,
    )
    joint = write(tmp_path, start_of(reference_joint("irj1b")), "axis")
    (path,) = build(
        "estimator",
        Request(load_joint(joint), joint, tmp_path / "dist", has_link=False, has_torque=False),
    )
    folder = tmp_path / "a b ü #1"
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    steps = 7300
    with Host(path) as host:
        numbers = [str(host.vr[n]) for n in ("i_m", "q_m", "theta[1]")]
        guid = host.fmu.description.guid
        expected = []
        for i in range(steps):
            u = float(np.sin(0.3 * i))
            host.step(
                np.array([u, 2 * u + 0.5 + 0.1 * float(np.cos(float(i))), 0.0, 0.0, 0.0, 0.0]),
                i * STEP,
            )
            expected.append(host.theta[0])
    library = folder / "binaries" / "linux64" / "axis_estimator.so"
    done = subprocess.run(
        [
            str(program),
            str(library),
            (folder / "resources").as_uri(),
            guid,
            "2",
            str(steps),
            str(STEP),
            *numbers,
        ],
        cwd="/",
        env={"PATH": os.defpath, "LC_ALL": "C.UTF-8", "IRJ_PYTHON": sys.executable},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert expected[-1] != expected[0]
    np.testing.assert_allclose(
        [float(x) for x in done.stdout.split()], expected, rtol=1e-12, atol=0
    )


def test_converges_on_its_plant(tmp_path: Path) -> None:
    """hd3 in closed loop, 12 s in place of 40: the linear parameters within 2 %."""
    joint = reference_joint("hd3")
    files = make_pair(joint, start_of(joint), tmp_path)
    found = cosimulate(joint, start_of(joint), files, Setting(stop=12.0))
    errors = {r.name: r.error for r in found.rows}
    for name in ("stiffness", "motor_inertia", "link_inertia", "gravity_torque", "motor_coulomb"):
        assert abs(errors[name]) < 2.0, errors
    assert found.trajectory["estimator.health"][-1] == 0


@pytest.mark.slow
def test_convergence_table() -> None:
    """Every reference joint after 40 s: 2 %, and 10 % for Stribeck part and cubic stiffness."""
    published = SHARED / "measurements" / "bam_published_params" / "params.json"
    joints = [reference_joint(n) for n in NAMES] + [
        published_joint(published, k) for k in ("erob80_50/m1", "erob80_100/m1", "erob80_50/m5")
    ]
    over = [(r.joint, r.name, r.error) for r in convergence(joints) if r.plant and not r.passed]
    assert over == []


def test_missing_effect_raises_its_balance(tmp_path: Path) -> None:
    """A plant with Stribeck friction that the estimator's model lacks: the motor balance is
    over its floor, no other.
    """
    plant = reference_joint("hd3")
    without = replace(
        plant, effects=tuple(e for e in plant.effects if not e.startswith("stribeck"))
    )
    names = set(without.model().parameter_names)
    model = replace(without, fitted={k: v for k, v in plant.fitted.items() if k in names})
    noise = {
        "plant.motor_position.noise": 3e-4,
        "plant.link_position.noise": 2e-6,
        "plant.link_torque.noise": 0.05,
    }
    setting = Setting(stop=14.0, parameters={**noise, "estimator.detect": False})
    lacking = cosimulate(plant, model, make_pair(plant, model, tmp_path / "a"), setting).ratios
    complete = cosimulate(plant, plant, make_pair(plant, plant, tmp_path / "b"), setting).ratios
    assert lacking["motor"] > 3 * complete["motor"]
    assert max(complete.values()) < 2.0
    assert lacking["link"] < 2.0
    assert lacking["transmission"] < 2.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nosuch"], "reference joint 'nosuch'"),
        (["--published", "nosuch", "a/m1"], "nosuch: cannot be read"),
        (["--published", "x.json"], "x.json: --published wants rows"),
        (["--kinds", "foo"], "argument --kinds: invalid choice: 'foo'"),
        (["irj1b", "--json", "/no/such/x.json"], "/no/such: no such folder"),
    ],
)
def test_convergence_refuses_in_one_line(arguments: list[str], said: str) -> None:
    command = [sys.executable, "-m", "irj_fmu.convergence", *arguments]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[2],
        timeout=60,
    )
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith(f"irj: {said}")
