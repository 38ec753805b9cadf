"""The estimator FMU against unkind hosts and inputs: a right result, or health, fault code and
a line in the log.
"""

from __future__ import annotations

import math
import os
import shutil
import signal
import subprocess
import sys
import time as clock
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from test_estimator_hosts import WARM_UP, make

from casadi_models.simulate import simulate
from identification.data.joint_file import toml_text
from identification.online.estimator import OnlineOptions, estimated_parameters
from irj_fmu.build import _package, main
from irj_fmu.fmi.package import SlaveSpec, package_slave
from irj_fmu.host.run import Fmu, Instance
from irj_fmu.plant.reference import reference_joint, start_of

FloatArray = npt.NDArray[np.float64]
STEP, FINE = 1e-3, 1e-4
INPUTS = ("i_m", "q_m", "w_m", "q_l", "w_l", "tau_l")
JOINT = reference_joint("hd3")
NAMES = estimated_parameters(JOINT)
NOISE = np.array([2e-3, 3e-4, 0.1, 2e-6, 1e-3, 0.05])
ROOT = Path(__file__).resolve().parents[2]


def slow(*values: Any) -> Any:
    """A case that is left to long runs."""
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def estimator(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(JOINT, tmp_path_factory.mktemp("rows"), "rows")


@pytest.fixture(scope="module")
def fine() -> FloatArray:
    """What the sensors read every 0.1 ms for 5 s, (50001, 6)."""
    t = FINE * np.arange(50001)
    drive = 160 * np.sin(2 * np.pi * 0.9 * t) + 60 * np.sin(2 * np.pi * 2.1 * t + 1)
    table = np.column_stack(
        [
            drive / (JOINT.torque_per_current or 1.0),
            simulate(JOINT.model(), drive, FINE).readings[: len(t)],
        ]
    )
    table[:, 1:3] *= JOINT.gear_ratio
    made: FloatArray = table + np.random.default_rng(3).normal(size=table.shape) * NOISE
    return made


@pytest.fixture(scope="module")
def table(fine: FloatArray) -> FloatArray:
    """Every millisecond."""
    return fine[::10]


class Host:
    """One instance, fed sample by sample; `seen` are the health codes, `codes` the faults."""

    def __init__(self, path: Path, start: float = 0.0, **parameters: Any) -> None:
        self.fmu = Fmu(path)
        self.instance = Instance(self.fmu, name="rows", log=True)
        self.instance.begin(start, parameters)
        self.instance.ready()
        self.write, self.both = (
            self.instance.blocks(INPUTS)[0],
            self.instance.blocks(("health", "fault"))[0],
        )
        self.estimates = self.instance.blocks([f"theta[{i}]" for i in range(1, len(NAMES) + 1)])[0]
        self.seen: set[int] = set()
        self.codes: set[int] = set()

    def step(self, row: Sequence[float], time: float, length: float = STEP) -> None:
        self.write.values[:] = list(row)
        self.instance.write(self.write)
        self.instance.step(time, length)
        health, fault = self.instance.read(self.both)
        self.seen.add(health)
        self.codes.add(fault)

    def feed(self, rows: FloatArray, first: int = 0) -> None:
        for k, row in enumerate(rows.tolist(), first):
            self.step(row, k * STEP)

    @property
    def theta(self) -> FloatArray:
        return np.array(self.instance.read(self.estimates))

    def set(self, name: str, value: Any) -> None:
        block = self.instance.blocks((name,))[0]
        block.values[0] = value
        self.instance.write(block)

    @property
    def log(self) -> str:
        return "\n".join(self.instance.messages)

    def __enter__(self) -> Host:
        return self

    def __exit__(self, *_: object) -> None:
        self.instance.close()
        self.fmu.close()


def error(theta: FloatArray) -> float:
    """Largest relative error of stiffness, inertias and gravity."""
    true = dict(zip(JOINT.model().parameter_names, JOINT.model().value_vector(), strict=True))
    watched = ("stiffness", "motor_inertia", "link_inertia", "gravity_torque")
    return max(abs(theta[NAMES.index(n)] / true[n] - 1) for n in watched)


# --- step sizes -----------------------------------------------------------------------------------


def spread(kind: str, count: int) -> list[int]:
    """Steps of a host, in units of 0.1 ms, that cover `count` of them."""
    generator = np.random.default_rng(4)
    patterns: dict[str, Any] = {
        "0.5 ms": lambda: 5,
        "1 ms": lambda: 10,
        "2 ms": lambda: 20,
        "16 ms": lambda: 160,
        "0.3 ms": lambda: 3,
        "0.7 ms": lambda: 7,
        "0.9 ms": lambda: 9,
        "on the grid": None,
        "anywhere below": lambda: int(generator.integers(2, 10)),
        "anywhere": lambda: int(generator.integers(2, 30)),
    }
    draw, steps, used = patterns[kind], [], 0
    while used < count:
        steps += [3, 7, 4, 6] if draw is None else [draw()]
        used = sum(steps) if draw is None else used + steps[-1]
    return steps


@pytest.mark.parametrize(
    ("kind", "sample_time", "flagged"),
    [
        ("0.5 ms", 1e-3, False),
        slow("1 ms", 1e-3, False),
        ("2 ms", 2e-3, False),
        ("2 ms", 1e-3, False),
        ("16 ms", 16e-3, False),
        ("16 ms", 1e-3, True),
        slow("0.3 ms", 1e-3, False),
        ("0.7 ms", 1e-3, False),
        slow("0.9 ms", 1e-3, False),
        slow("on the grid", 1e-3, False),
        ("anywhere below", 1e-3, False),
        slow("anywhere", 1e-3, False),
    ],
)
def test_step_is_followed_or_flagged(
    kind: str, sample_time: float, flagged: bool, estimator: Path, fine: FloatArray
) -> None:
    """After 5 s the estimate is right and health is 0, or health is 3 and the log says why."""
    place = 0
    with Host(estimator, sample_time=sample_time) as host:
        for length in spread(kind, 48000):
            host.step(fine[place].tolist(), place * FINE, length * FINE)
            place += length
        health, theta, log = host.both.values[0], host.theta, host.log
    assert 4 not in host.seen
    if flagged:
        assert health == 3
        assert "sample_time" in log
    else:
        assert health == 0
        assert host.seen <= {0, 1}
        assert error(theta) < 0.02


@pytest.mark.slow
def test_a_start_later_than_zero_and_a_gap(estimator: Path, table: FloatArray) -> None:
    """A run from 1000 s on is that from 0 on; half a second without a step is told."""
    with Host(estimator) as first, Host(estimator, start=1000.0) as second:
        for k, row in enumerate(table[:1500].tolist()):
            first.step(row, k * STEP)
            second.step(row, 1000.0 + k * STEP)
        np.testing.assert_allclose(second.theta, first.theta, rtol=1e-9)
        assert 3 not in second.seen
        first.step(table[2000].tolist(), 2.0)
        assert first.both.values[0] == 3


@pytest.mark.parametrize("length", [slow(0.0), slow(-1e-3), math.nan, slow(math.inf)])
def test_steps_that_are_none(length: float, estimator: Path, table: FloatArray) -> None:
    """A length that is no time step does not end the run; afterwards it goes on."""
    with Host(estimator) as host:
        host.feed(table[:600])
        for _ in range(3):
            host.step(table[600].tolist(), 0.6, length)
        host.feed(table[601:900], 601)
        assert np.isfinite(host.theta).all()
        assert host.both.values[0] in (0, 3)


# --- bad input ------------------------------------------------------------------------------------

CASES: dict[str, tuple[int | None, float | str, set[int]]] = {
    # column, value, and codes of which one must be seen
    "nan current": (0, math.nan, {11}),
    "inf motor position": (1, math.inf, {12}),
    "-inf motor velocity": (2, -math.inf, {13}),
    "nan link position": (3, math.nan, {4, 14}),
    "nan link velocity": (4, math.nan, {5, 15}),
    "nan torque": (5, math.nan, {6, 16}),
    "all nan": (None, math.nan, {11, 12, 13, 14, 15, 16}),
    "all inf": (None, math.inf, {11, 12, 13, 14, 15, 16}),
    "constant motor position": (1, "hold", {2, 22}),
    "constant link position": (3, "hold", {4, 24}),
    "constant torque": (5, "hold", {6, 26}),
    "torque in kNm": (5, "1e-3", {6, 36}),
    "link position in degrees": (3, "57.29577951308232", {4, 34}),
    "motor position in degrees": (1, "57.29577951308232", {2, 32}),
    "huge torque": (5, 1e300, {6, 16, 26, 36}),
    "huge position": (3, 1e300, {4, 14, 24, 34}),
}


@pytest.mark.filterwarnings(
    "ignore:overflow encountered:RuntimeWarning", "ignore:invalid value:RuntimeWarning"
)
@pytest.mark.parametrize(
    "kind",
    [
        kind if kind in ("all nan", "torque in kNm", "nan link position") else slow(kind)
        for kind in CASES
    ],
)
def test_bad_reading_is_told(kind: str, estimator: Path, table: FloatArray) -> None:
    """Never Fatal: the fault is named, the log has a line, the estimate stays finite; overflow
    alone may count as internal error.
    """
    column, value, codes = CASES[kind]
    rows = table[:4200].copy()
    which = slice(None) if column is None else slice(column, column + 1)
    if isinstance(value, float):
        rows[1500:, which] = value
    elif value == "hold":
        rows[1500:, which] = rows[1499, which]
    else:
        rows[1500:, which] *= float(value)
    with Host(estimator) as host:
        host.feed(rows)
        assert "huge" in kind or 4 not in host.seen, host.log
        assert host.codes & codes, host.codes
        assert np.isfinite(host.theta).all()
        assert re_line(host.log, "counts as missing", "fault ")
        if isinstance(value, float) and not math.isfinite(value):
            assert 2 in host.seen


def re_line(log: str, *words: str) -> bool:
    """True where a line of the log holds one of the words."""
    return any(word in line for line in log.splitlines() for word in words)


@pytest.mark.parametrize("value", [math.nan, slow(math.inf), slow(0.0)])
def test_a_sensor_that_never_worked(value: float, estimator: Path, table: FloatArray) -> None:
    """From the first sample on; the estimator says so and does not start from nothing."""
    rows = table[:3000].copy()
    rows[:, 3] = value
    with Host(estimator) as host:
        host.feed(rows)
        assert 4 not in host.seen, host.log
        assert host.codes & {4, 14, 24}
        assert np.isfinite(host.theta).all()


@pytest.mark.slow
def test_a_sensor_that_comes_back(estimator: Path, table: FloatArray) -> None:
    """After a second without current the fault goes and the estimate is right again."""
    rows = table.copy()
    rows[1500:2500, 0] = math.nan
    with Host(estimator) as host:
        host.feed(rows)
        assert 11 in host.codes
        assert tuple(host.both.values) == (0, 0)
        assert error(host.theta) < 0.02


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sample_time", math.nan),
        slow("sample_time", 0.0),
        slow("sample_time", -1.0),
        slow("sample_time", math.inf),
        slow("sample_time", 1e-9),
        slow("warm_up", math.nan),
        slow("warm_up", -1.0),
        ("drift", math.nan),
        slow("drift", -1.0),
        slow("floor_share", math.inf),
        slow("fault_margin", 0.0),
        slow("fault_margin", math.nan),
        slow("alarm_drift", math.nan),
    ],
)
def test_bad_parameter_is_told(name: str, value: float, estimator: Path, table: FloatArray) -> None:
    """A parameter outside its range: health is not 0, or the value was not taken; the log has a
    line.
    """
    with Host(estimator, **{name: value}) as host:
        host.feed(table[:700])
        assert host.log
        assert host.both.values[0] != 0
        assert np.isfinite(host.theta).all()


@pytest.mark.parametrize(
    "kind",
    [
        slow("folder"),
        slow("empty"),
        "bytes",
        slow("other joint"),
        "other ratio",
        slow("missing"),
        slow("fmu"),
    ],
)
def test_wrong_joint_file(kind: str, estimator: Path, table: FloatArray, tmp_path: Path) -> None:
    """The String parameter with a file that does not fit: health 4, the log names the file, the
    run goes on.
    """
    path = tmp_path / "wrong.toml"
    if kind == "folder":
        path.mkdir()
    elif kind == "empty":
        path.write_text("")
    elif kind == "bytes":
        path.write_bytes(bytes(range(256)))
    elif kind == "fmu":
        shutil.copy(estimator, path)
    elif kind != "missing":
        from dataclasses import replace

        joint = (
            start_of(reference_joint("irj1b"))
            if kind == "other joint"
            else replace(JOINT, gear_ratio=100.0)
        )
        path.write_text(toml_text(joint), encoding="utf-8")
    with Host(estimator, joint_file=str(path)) as host:
        host.feed(table[:50])
        assert host.seen == {4}
        assert path.name in host.log


# --- two versions in one process ------------------------------------------------------------------

_TWO = """
import json, sys
import numpy as np
sys.path.insert(0, sys.argv[1])
import identification, identification.online.estimator, casadi_models
from irj_fmu.host.run import Fmu, Instance
table = np.load(sys.argv[2])
opened = [Instance(Fmu(path), name="x") for path in sys.argv[3:]]
for one in opened:
    one.begin(0.0); one.ready()
inputs = ("i_m", "q_m", "w_m", "q_l", "w_l", "tau_l")
def theta(one):
    return [n for n in one.fmu.variables if n.startswith("theta[")]
blocks = [(one.blocks(inputs)[0], one.blocks(theta(one))[0]) for one in opened]
for k, row in enumerate(table.tolist()):
    for one, (write, _) in zip(opened, blocks):
        write.values[:] = row
        one.write(write)
        one.step(k * 1e-3, 1e-3)
print(json.dumps([list(one.read(read)) for one, (_, read) in zip(opened, blocks)]))
for one in opened:
    one.close()
    one.fmu.close()
"""


_OTHER_CODE = """

def _shown_otherwise(self, publish=Estimator._publish):
    publish(self)
    self._values[self._theta_at] += 1.0


Estimator._publish = _shown_otherwise
"""


@pytest.mark.slow
def test_two_versions_and_the_project_in_one_process(
    estimator: Path, table: FloatArray, tmp_path: Path
) -> None:
    """The second FMU carries changed code, which shows another value. Each gives what it gives
    alone.
    """
    changed = tmp_path / "changed"
    for name in ("casadi_models", "identification", "irj_fmu"):
        shutil.copytree(
            _package(name), changed / name, ignore=shutil.ignore_patterns("__pycache__")
        )
    with (changed / "irj_fmu" / "estimator" / "slave.py").open("a") as stream:
        stream.write(_OTHER_CODE)
    files = {
        name: estimator.parent.parent / "texts" / "rows" / name
        for name in ("joint.toml", "estimator.toml")
    }
    spec = SlaveSpec(
        "rows",
        "irj_fmu.estimator.slave",
        "Estimator",
        tuple(changed / n for n in ("casadi_models", "identification", "irj_fmu")),
        files,
    )
    other = package_slave(spec, tmp_path / "other.fmu", shim=False).path
    np.save(tmp_path / "table.npy", table[:1600])
    results = []
    for paths in ((estimator, other), (estimator,), (other,)):
        done = subprocess.run(
            [sys.executable, "-c", _TWO, str(ROOT), str(tmp_path / "table.npy"), *map(str, paths)],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=True,
        )
        results.append(done.stdout.strip())
    import json

    together, one, two = (json.loads(text) for text in results)
    assert together == [*one, *two]
    assert one != two


# --- building -------------------------------------------------------------------------------------


@pytest.fixture
def joint(tmp_path: Path) -> Path:
    path = tmp_path / "joint.toml"
    path.write_text(
        toml_text(
            JOINT, {k: {"value": v, "unit": "", "side": ""} for k, v in JOINT.fitted.items()}
        ),
        encoding="utf-8",
    )
    return path


def test_building_into_what_is_no_folder(
    joint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "taken").write_text("mine")
    for kind in ("estimator", "native", "ssp", "all"):
        assert main([kind, "--joint", str(joint), "--out", str(tmp_path / "taken" / "dist")]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "writable folder" in said
    assert (tmp_path / "taken").read_text() == "mine"


def test_building_without_a_compiler(
    joint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr("irj_fmu.fmi.compiler.has_zig", lambda: False)
    for kind in ("native", "ssp"):
        assert main([kind, "--joint", str(joint), "--out", str(tmp_path / "dist")]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "pip install ziglang" in said
    assert not list(tmp_path.rglob("*.fmu"))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[joint]\nmodel = 'hd3'\ngear_ratio = nan\n",
        "[joint]\nmodel = 3\n",
        "[joint]\nmodel = 'hd1'\neffects = 'viscous'\n",
    ],
)
def test_building_from_a_broken_joint_file(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "broken.toml"
    path.write_text(text)
    for kind in ("estimator", "plant", "native", "ssp"):
        assert main([kind, "--joint", str(path), "--out", str(tmp_path / "dist")]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "broken.toml" in said
    assert not (tmp_path / "dist").exists()


@pytest.mark.slow
def test_a_build_that_is_killed_leaves_no_fmu(joint: Path, tmp_path: Path) -> None:
    """What appears in the folder is whole; half-made files stay in a folder with a dot."""
    out = tmp_path / "dist"
    process = subprocess.Popen(
        [
            sys.executable,
            str(ROOT / "build_fmu.py"),
            "estimator",
            "--joint",
            str(joint),
            "--out",
            str(out),
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )
    end = clock.monotonic() + 60
    while not list(out.glob(".build-*/*")) and clock.monotonic() < end:
        clock.sleep(0.005)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert out.is_dir()
    assert not list(out.glob("*.fmu"))
    assert all(p.name.startswith(".") for p in out.iterdir())


def test_the_short_first_window_is_what_is_tested() -> None:
    assert OnlineOptions().warm_up > WARM_UP
