"""The native twin: the Python estimator's numbers from C, sample by sample, with faults; state,
hosts, platforms.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest

from benchmarks.native import hurt, readings_of, skewed
from identification.data.joint_file import Joint, Known, load_joint, toml_text
from identification.errors import InputError
from identification.faults.detector import FaultDetector
from identification.online.estimator import (
    OnlineEstimator,
    OnlineOptions,
    estimated_parameters,
    prepared,
)
from irj_fmu.build import main
from irj_fmu.estimator.native import NativeSpec, build_native, native_sources, native_variables
from irj_fmu.estimator.native_expressions import cheaper
from irj_fmu.estimator.packed import options_text
from irj_fmu.estimator.slave import DETECTOR_FILE, JOINT_FILE, OPTIONS_FILE, Estimator
from irj_fmu.fmi.compiler import find_compiler, has_zig, header_folder
from irj_fmu.fmi.targets import native_targets
from irj_fmu.host.run import Fmu, Instance
from irj_fmu.plant.reference import reference_joint, start_of

FloatArray = npt.NDArray[np.float64]
Events = Mapping[int, tuple[tuple[str, str, Any], ...]]
STEP = 1e-3
INPUTS = ("q_m", "w_m", "q_l", "w_l", "tau_l")
PLAIN = OnlineOptions(optimise=False)
HOST = Path(__file__).resolve().parents[2] / "irj_fmu" / "c" / "native_host.c"


def _has_compiler() -> bool:
    try:
        find_compiler()
    except InputError:
        return False
    return True


pytestmark = pytest.mark.skipif(
    not _has_compiler() and not os.environ.get("CI"), reason="a native estimator needs a C compiler"
)


# --- readings and the pair ------------------------------------------------------------------------


def write(folder: Path, joint: Joint) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / JOINT_FILE
    values = {k: {"value": v, "unit": "", "side": ""} for k, v in joint.fitted.items()}
    path.write_text(toml_text(joint, values), encoding="utf-8")
    return path


def calibrated(key: str) -> bytes:
    """State of a fault detector that has seen a healthy run."""
    joint = reference_joint(key)
    gear = joint.gear_ratio
    healthy = readings_of(key, 6.2, seed=9) * np.array(
        [joint.torque_per_current or gear, 1 / gear, 1 / gear, 1.0, 1.0, 1.0]
    )
    detector = FaultDetector(prepared(joint, PLAIN)[0], STEP)
    detector.calibrate(healthy)
    return detector.state()


class Python:
    """The Python estimator's slave, without a host."""

    def __init__(self, spec: NativeSpec, folder: Path, parameters: Mapping[str, Any]) -> None:
        write(folder, spec.joint)
        (folder / OPTIONS_FILE).write_text(
            options_text(spec.options, spec.sample_time), encoding="utf-8"
        )
        if spec.detector_state is not None:
            (folder / DETECTOR_FILE).write_bytes(spec.detector_state)
        self.slave = Estimator(instance_name="python", resources=str(folder))
        self.slave.log = lambda *_: None
        self.slave.setup_experiment(0.0)
        for name, value in parameters.items():
            self.slave._values[self.slave._index[name]] = value
        self.slave.exit_initialization_mode()


class Native:
    """The native FMU under fmpy."""

    def __init__(self, path: Path, **parameters: Any) -> None:
        self.fmu = Fmu(path)
        self.instance = Instance(self.fmu, name="native")
        self.vr = {n: v.valueReference for n, v in self.fmu.variables.items()}
        self.instance.begin(0.0, parameters)
        self.instance.call("fmi2SetDebugLogging", self.instance.raw.component, 1, 0, None)
        self.instance.ready()
        self.inputs = [self.vr[n] for n in ("i_m" if "i_m" in self.vr else "tau_m", *INPUTS)]
        outputs = [v for v in self.fmu.variables.values() if v.causality == "output"]
        self.names = {
            kind: [v.name for v in outputs if v.type == kind]
            for kind in ("Real", "Integer", "Boolean")
        }
        self.refs = {kind: [self.vr[n] for n in names] for kind, names in self.names.items()}

    def step(self, row: FloatArray, time: float, length: float = STEP) -> None:
        self.instance.call("setReal", self.inputs, row.tolist())
        self.instance.call("doStep", time, length)

    def feed(self, table: FloatArray, first: int, last: int) -> None:
        for k in range(first, last):
            self.step(table[k], k * STEP)

    def outputs(self) -> list[float]:
        found: list[float] = []
        for kind, refs in self.refs.items():
            found += self.instance.call(f"get{kind}", refs)
        return found

    def integer(self, name: str) -> int:
        return int(self.instance.call("getInteger", [self.vr[name]])[0])

    @property
    def log(self) -> str:
        return "\n".join(self.instance.messages)

    def __enter__(self) -> Native:
        return self

    def __exit__(self, *_: object) -> None:
        self.instance.close()
        self.fmu.close()


def both(
    spec: NativeSpec,
    path: Path,
    folder: Path,
    table: FloatArray,
    parameters: Mapping[str, Any] | None = None,
    events: Events | None = None,
    step: float = STEP,
) -> tuple[FloatArray, FloatArray, dict[str, list[str]]]:
    """All outputs of native and Python estimator after each sample, reals first, and their
    names by type.
    """
    given, events = parameters or {}, events or {}
    python = Python(spec, folder, given).slave
    found, expected = [], []
    with Native(path, **given) as native:
        assert native.vr == python._index
        for k, row in enumerate(table):
            for kind, name, value in events.get(k, ()):
                native.instance.call(f"set{kind}", [native.vr[name]], [value])
                getattr(python, f"set_{kind.lower()}")([native.vr[name]], [value])
            native.step(row, k * step, step)
            python.set_real(native.inputs, row.tolist())
            python.do_step(k * step, step)
            found.append(native.outputs())
            expected.append(
                [
                    *python.get_real(native.refs["Real"]),
                    *python.get_integer(native.refs["Integer"]),
                    *python.get_boolean(native.refs["Boolean"]),
                ]
            )
        return np.array(found, dtype=float), np.array(expected, dtype=float), native.names


def largest(found: FloatArray, expected: FloatArray, count: int) -> float:
    """Largest difference of the first `count` columns, each as a share of its largest value or,
    for small ones, of 1.
    """
    size = np.maximum(np.max(np.abs(expected[:, :count]), axis=0), 1.0)
    return float(np.max(np.abs(found[:, :count] - expected[:, :count]) / size))


@pytest.fixture(scope="module")
def spec() -> NativeSpec:
    return NativeSpec(reference_joint("hd3"), "native", PLAIN, calibrated("hd3"))


@pytest.fixture(scope="module")
def fmu(spec: NativeSpec, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_native(spec, tmp_path_factory.mktemp("native") / "native.fmu")


@pytest.fixture(scope="module")
def table() -> FloatArray:
    return readings_of("hd3", 40.0)


# --- the same numbers -----------------------------------------------------------------------------


def test_equals_python_over_40_s_with_faults(
    spec: NativeSpec, fmu: Path, table: FloatArray, tmp_path: Path
) -> None:
    """All outputs after each of 40001 samples: reals to 1e-9, health, fault, counts and flags
    without exception.
    """
    readings = hurt(table)
    late = np.arange(36_800, len(readings))
    readings[late, 0] += 4.0 * np.sin(
        2 * np.pi * 3.0 * STEP * late
    )  # no value of the parameters explains it: asks for a search
    found, expected, names = both(spec, fmu, tmp_path, readings)
    reals = len(names["Real"])
    assert largest(found, expected, reals) <= 1e-9
    np.testing.assert_array_equal(found[:, reals:], expected[:, reals:])
    columns = [*names["Real"], *names["Integer"], *names["Boolean"]]
    assert {2, 3, 4, 6, 11, 15} <= set(expected[:, columns.index("fault")])
    assert set(expected[:, columns.index("health")]) == {0, 1, 2}
    assert set(expected[:, columns.index("reoptimise")]) == {0, 1}
    assert not np.array_equal(expected[-1, :reals], expected[7000, :reals])


def stiffness_known(joint: Joint) -> Joint:
    """The joint with its stiffness given and not estimated."""
    fitted = dict(joint.fitted)
    return replace(joint, known={"stiffness": Known(fitted.pop("stiffness"))}, fitted=fitted)


CASES: dict[str, tuple[str, OnlineOptions, Callable[[Joint], Joint]]] = {
    "rigid, not fitted": ("irj1b", PLAIN, start_of),
    "motor side only": ("irj1b", replace(PLAIN, has_link=False, has_torque=False), lambda j: j),
    "no torque sensor": ("irj2a", replace(PLAIN, has_torque=False), lambda j: j),
    "late channels": (
        "hd3",
        PLAIN,
        lambda j: replace(
            j,
            effects=(*j.effects, "channel_delay@drive", "channel_delay@link_position_sensor"),
            fitted=dict(j.fitted) | {"drive_delay": 2.3e-3, "link_position_sensor_delay": 4.4e-3},
        ),
    ),
    "known stiffness": ("irj2a", replace(PLAIN, detect=False), stiffness_known),
    "internal states": ("irj2a", PLAIN, lambda j: replace(j, effects=(*j.effects, "lugre"))),
}


LONG = ("motor side only", "known stiffness")
"""What the other cases have, too: no channel of the link, fewer parameters than the model has."""


@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=pytest.mark.slow) if c in LONG else c for c in CASES]
)
def test_equals_python_for_other_joints_and_sensors(case: str, tmp_path: Path) -> None:
    """Fewer sensors, rigid and not fitted joints, internal states; tuned, held and reset on the
    way.
    """
    key, options, changed = CASES[case]
    joint = changed(reference_joint(key))
    spec = NativeSpec(joint, "native", options)
    readings = readings_of(key, 6.0)
    readings[3500:3900, 4] = np.nan
    readings[4200:4500, 3] += 0.02
    events: Events = {
        2900: (("Boolean", "valid.q_l", False),),
        3100: (("Boolean", "valid.q_l", True), ("Boolean", "enable", False)),
        3300: (("Boolean", "enable", True), ("Real", "drift", 0.05), ("Real", "fault_margin", 1.3)),
        4600: (("Real", "floor_share", 0.01), ("Real", "alarm_drift", 0.5)),
        4800: (("Boolean", "reset", True),),
    }
    path = build_native(spec, tmp_path / "native.fmu")
    found, expected, names = both(
        spec, path, tmp_path / "python", readings, {"warm_up": 1.5}, events
    )
    reals = len(names["Real"])
    assert largest(found, expected, reals) <= 1e-9
    np.testing.assert_array_equal(found[:, reals:], expected[:, reals:])
    assert (
        found[-1, reals + names["Integer"].index("n_rows")]
        < found[4799, reals + names["Integer"].index("n_rows")]
    )


def test_a_link_that_is_not_read_is_the_motor_less_the_twist_of_a_known_stiffness() -> None:
    joint = stiffness_known(reference_joint("irj2a"))
    estimator = OnlineEstimator(joint, STEP, replace(PLAIN, detect=False))
    row = readings_of("irj2a", 3.0)[2900]
    scaled = [row[0], row[1], row[2], row[3], row[4], row[5]]
    valid = [True, True, True, False, False, True]
    estimator.update(0.0, scaled, valid)
    motor, twist = estimator.readings[1], row[5] / joint.known["stiffness"].value
    assert abs(twist) > 1e-4
    assert estimator.readings[3] == pytest.approx(motor - twist, abs=1e-12)


def test_equals_python_on_whole_encoder_steps(spec: NativeSpec, fmu: Path, tmp_path: Path) -> None:
    """Fourth differences of a counted position are whole steps: both sides keep as many of the
    equal ones, and neither floor nor noise depends on which.
    """
    readings = readings_of("hd3", 5.0)
    step = 2 * np.pi / 2**14
    readings[:, [1, 3]] = np.round(readings[:, [1, 3]] / step) * step
    found, expected, names = both(spec, fmu, tmp_path, readings, {"warm_up": 1.2})
    reals = len(names["Real"])
    assert largest(found, expected, reals) <= 1e-9
    np.testing.assert_array_equal(found[:, reals:], expected[:, reals:])
    running = expected[:, reals + names["Integer"].index("health")] != 1
    assert running.any()


GAP = {"backlash_stiffness_loss": 2e4, "backlash": 5e-4}


@pytest.mark.parametrize("kind", ["straight", "gap"])
def test_equals_python_where_sensors_have_a_zero_and_skews(kind: str, tmp_path: Path) -> None:
    """Rows made again with shifted channels and without the zero: the same on both sides, and
    through a reset.
    """
    joint = reference_joint("hd3")
    if kind == "gap":
        effects = (*joint.effects, "backlash")
        joint = replace(joint, effects=effects, fitted={**joint.fitted, **GAP})
    built = 4 * STEP
    options = replace(PLAIN, detect=False)
    spec = NativeSpec(joint, "native", options, sample_time=built)
    late = skewed(readings_of("hd3", 8.0)[::4])
    reset = {len(late) // 2: (("Boolean", "reset", True),)}
    path = build_native(spec, tmp_path / "native.fmu")
    given = {"warm_up": 1.5}
    found, expected, names = both(spec, path, tmp_path / "python", late, given, reset, built)
    reals = len(names["Real"])
    assert largest(found, expected, reals) <= 1e-9
    np.testing.assert_array_equal(found[:, reals:], expected[:, reals:])
    at = estimated_parameters(joint, options).index("link_encoder_skew")
    skew = found[-1, names["Real"].index(f"theta[{at + 1}]")]
    assert skew == pytest.approx(2.6 * built, rel=0.1)


@pytest.mark.parametrize("column", [1, 3])
def test_stuck_encoder_of_a_rigid_joint(column: int, tmp_path: Path) -> None:
    """Derivatives of a reading that stands still are zero on both sides, not the rounding of
    large sums.
    """
    spec = NativeSpec(start_of(reference_joint("irj1b")), "native", PLAIN)
    readings = readings_of("irj1b", 6.0)
    readings[4000:5500, column] = readings[4000, column]
    found, expected, names = both(
        spec,
        build_native(spec, tmp_path / "native.fmu"),
        tmp_path / "python",
        readings,
        {"warm_up": 1.5},
    )
    reals = len(names["Real"])
    assert largest(found, expected, reals) <= 1e-9
    np.testing.assert_array_equal(found[:, reals:], expected[:, reals:])
    assert 21 + column in expected[:, reals + names["Integer"].index("fault")]


ABSURD = (1e300, -1e300, np.inf, -np.inf, np.nan, 1e12)
ODD = (5e-324, -5e-324, 1e-310, -0.0)


def test_absurd_readings_are_told_and_never_an_exception(
    spec: NativeSpec, fmu: Path, tmp_path: Path
) -> None:
    """Each reading at every absurd value, all at once, and in the first sample: health 2, a
    code, finite outputs, equal numbers.
    """
    readings = readings_of("hd3", 10.5)
    bad = np.zeros(len(readings), dtype=bool)
    bad[0] = True
    readings[0, 3], readings[0, 1] = 1e300, -np.inf
    for i, value in enumerate((*ABSURD, *ODD)):
        for column in range(6):
            first = 3500 + 100 * (6 * i + column)
            readings[first : first + 30, column] = value
            bad[first : first + 30] = i < len(ABSURD)
    readings[10_000:10_020], bad[10_000:10_020] = 1e300, True
    found, expected, names = both(spec, fmu, tmp_path, readings, {"warm_up": 1.5})
    reals = len(names["Real"])
    assert largest(found, expected, reals) <= 1e-9
    np.testing.assert_array_equal(found[:, reals:], expected[:, reals:])
    assert np.isfinite(expected).all()
    health, fault = (expected[:, reals + names["Integer"].index(n)] for n in ("health", "fault"))
    assert set(health) == {0, 1, 2}
    assert (health[bad] == 2).all()
    assert set(range(11, 17)) <= set(fault[bad])


def test_variables_are_those_of_the_python_estimator(spec: NativeSpec, tmp_path: Path) -> None:
    """Names, types, units, causality and description in the same order; only bounds of what is
    built in differ.
    """
    python = Python(spec, tmp_path, {}).slave.table
    native = native_variables(spec)
    assert len(python) == len(native)
    for theirs, own in zip(python, native, strict=True):
        assert (
            replace(own, minimum=theirs.minimum, maximum=theirs.maximum, start=theirs.start)
            == theirs
        )
        if own.name != "optimise":
            assert own.start == theirs.start


def test_cheaper_expressions_have_the_same_values() -> None:
    """Harmonics, products and shared terms are rewritten, with one sine and cosine for all
    harmonics of an angle.
    """
    x = ca.SX.sym("x", 2)
    a = -160 * x[0]
    out = ca.vertcat(
        ca.sin(a) + ca.cos(2 * a),
        ca.sin(4 * a) * ca.sin(-2 * a),
        ca.sin(3 * x[1]) / 7,
        ca.tanh(x[1] / 1e-3) + ca.cos(a) / x[1],
    )
    plain = ca.Function("plain", [x], [out])
    made = cheaper(plain, "made")
    turns = sum(
        made.instruction_id(k) in (ca.OP_SIN, ca.OP_COS) for k in range(made.n_instructions())
    )
    assert turns == 3
    for point in np.random.default_rng(0).normal(size=(50, 2)):
        np.testing.assert_allclose(
            np.array(made(point)), np.array(plain(point)), rtol=0, atol=2e-14
        )


def test_cheaper_observer_has_the_same_values() -> None:
    """The observer of the model with the most harmonics."""
    detector = OnlineEstimator(reference_joint("hd4"), STEP, PLAIN).detector
    assert detector is not None
    core: Any = detector._rule.core
    made, rng = cheaper(core.function, "made"), np.random.default_rng(0)
    assert made.n_instructions() < core.function.n_instructions()
    for _ in range(20):
        given = [
            0.1 * rng.normal(size=core.function.size_in(i)) for i in range(core.function.n_in())
        ]
        expected = np.array(core.function(*given))
        np.testing.assert_allclose(
            np.array(made(*given)), expected, rtol=0, atol=1e-11 * np.max(np.abs(expected))
        )


# --- state, steps, bad input ----------------------------------------------------------------------


@pytest.mark.parametrize("moment", [3000, 8500, 15_800])
def test_state_is_bit_exact(moment: int, fmu: Path, table: FloatArray) -> None:
    """Roll-back, and serialise, free, restore in a new instance: first window, recursion, a
    sensor replaced.
    """
    readings, last = hurt(table), moment + 1200
    with Native(fmu) as host:
        host.feed(readings, 0, moment)
        state = host.instance.call("getFMUstate")
        saved = host.instance.call("serializeFMUstate", state)
        host.feed(readings, moment, last)
        straight = host.outputs()
        host.instance.call("setFMUstate", state)
        host.feed(readings, moment, last)
        assert host.outputs() == straight
        host.instance.call("freeFMUstate", state)
    with Native(fmu) as other:
        other.instance.call("setFMUstate", other.instance.call("deSerializeFMUstate", saved))
        other.feed(readings, moment, last)
        assert other.outputs() == straight
        damaged = b"x" + saved[1:]
        with pytest.raises(Exception, match="fmi2DeSerializeFMUstate|deSerialize"):
            other.instance.call("deSerializeFMUstate", damaged)


def test_step_sizes(fmu: Path, table: FloatArray) -> None:
    """Half steps change nothing; steps of 20 ms are told by health 3; a time that is no number
    by health 4.
    """
    with Native(fmu) as whole, Native(fmu) as half, Native(fmu) as long:
        for k in range(2000):
            whole.step(table[k], k * STEP)
            half.step(table[k], k * STEP, STEP / 2)
            half.step(0.9 * table[k], (k + 0.5) * STEP, STEP / 2)
            long.step(table[20 * k], 20 * k * STEP, 20 * STEP)
        assert half.outputs() == whole.outputs()
        assert whole.integer("health") == 1
        assert long.integer("health") == 3
        assert "too long for sample_time" in long.log
        whole.step(table[0], float("nan"))
        assert whole.integer("health") == 4


@pytest.mark.parametrize(
    ("steps", "right"),
    [
        ((5e-4,), True),
        ((3e-4,), True),
        ((2e-3,), True),
        ((1.6e-2,), False),
        ((3.2e-2,), False),
        ((7e-4,), True),
        ((2e-4, 9e-4, 6e-4), True),
    ],
)
def test_host_steps_are_right_or_told(
    steps: tuple[float, ...],
    right: bool,
    spec: NativeSpec,
    fmu: Path,
    table: FloatArray,
    tmp_path: Path,
) -> None:
    """Steps up to a quarter of the kernel are followed; longer ones give health 3, in every
    later step; Python and native alike.
    """
    python = Python(spec, tmp_path, {}).slave
    health = python._index["health"]
    with Native(fmu) as native, Native(fmu) as exact:
        time = 0.0
        for k in range(1500):
            row = table[min(round(time / STEP), len(table) - 1)]
            length = steps[k % len(steps)]
            native.step(row, time, length)
            python.set_real(native.inputs, row.tolist())
            python.do_step(time, length)
            told = native.integer("health")
            assert told == python._values[health]
            assert right or told == 3 or k < 4 * len(steps)
            time += length
        if right:
            exact.feed(table, 0, native.integer("n_samples"))
            assert native.integer("health") == (1 if time < 7.0 else 0)
            assert steps != (5e-4,) or native.outputs() == exact.outputs()


def test_equals_python_through_common_failures(
    spec: NativeSpec, fmu: Path, table: FloatArray, tmp_path: Path
) -> None:
    """Standstill from the first sample, a frozen bus, all readings zero, a stuck current:
    equal, held, and back.
    """
    readings = np.vstack([np.zeros((1000, 6)), table[:9000]])
    readings[4000:4500] = readings[4000]
    readings[5500:5800] = 0.0
    readings[6800:7300, 0] = readings[6800, 0]
    found, expected, names = both(spec, fmu, tmp_path, readings, {"warm_up": 1.5})
    reals = len(names["Real"])
    assert largest(found, expected, reals) <= 1e-9
    np.testing.assert_array_equal(found[:, reals:], expected[:, reals:])
    fault, health = (found[:, reals + names["Integer"].index(n)] for n in ("fault", "health"))
    assert set(fault[:4000]) == {0}
    assert set(health[:4000]) == {0, 1}
    assert set(fault[4020:4500]) == set(fault[5520:5800]) == {9}
    assert (health[6900:7300] == 2).any()
    theta = found[:, [names["Real"].index(n) for n in names["Real"] if n.startswith("theta[")]]
    np.testing.assert_allclose(
        theta[4000:, :3], np.tile(theta[3999, :3], (len(theta) - 4000, 1)), rtol=0.03
    )


@pytest.mark.parametrize(
    ("built", "steps"),
    [
        (STEP, (2e-3,)),
        (STEP, (4e-3,)),
        (STEP, (8e-3,)),
        pytest.param(16e-3, (16e-3,), marks=pytest.mark.slow),
        (STEP, (3e-4, 1.7e-3, 1.1e-3, 6e-4)),
        (4e-3, (3e-3, 5e-3, 4.4e-3)),
    ],
    ids=["2 ms", "4 ms", "8 ms", "16 ms", "jitter", "coarse jitter"],
)
def test_equals_python_at_coarse_and_uneven_steps(
    built: float,
    steps: tuple[float, ...],
    spec: NativeSpec,
    fmu: Path,
    table: FloatArray,
    tmp_path: Path,
) -> None:
    """All outputs to 1e-9 and right values, with a dropout and a stuck current on the way; steps
    of the host beside that of the estimator.
    """
    given = {"warm_up": 4.0}
    if built != STEP:
        spec = replace(spec, sample_time=built, detector_state=None)
        fmu = build_native(spec, tmp_path / "native.fmu")
    python = Python(spec, tmp_path, given).slave
    names = estimated_parameters(spec.joint, PLAIN)
    true = dict(
        zip(spec.joint.model().parameter_names, spec.joint.model().value_vector(), strict=True)
    )
    found, expected = [], []
    with Native(fmu, **given) as native:
        time, k = 0.0, 0
        while time < 9.0:
            at = time / STEP
            low = int(at)
            row = table[low] + (at - low) * (table[low + 1] - table[low])
            if 6.0 < time < 6.3:
                row[4] = np.nan
            if 7.5 < time < 8.0:
                row[0] = 5.0
            length = steps[k % len(steps)]
            native.step(row, time, length)
            python.set_real(native.inputs, row.tolist())
            python.do_step(time, length)
            if k % 20 == 0:
                found.append(native.outputs())
                flags = [
                    *python.get_integer(native.refs["Integer"]),
                    *python.get_boolean(native.refs["Boolean"]),
                ]
                expected.append([*python.get_real(native.refs["Real"]), *flags])
            if 7.4 < time < 7.5:
                assert native.integer("health") == 0
                errors = [
                    native.instance.call("getReal", [native.vr[f"theta[{i}]"]])[0] / true[n] - 1
                    for i, n in enumerate(names, 1)
                    if n in ("stiffness", "motor_inertia", "link_inertia")
                ]
                assert len(errors) == 3
                assert max(map(abs, errors)) < 0.02
            time, k = time + length, k + 1
        reals = len(native.names["Real"])
    assert largest(np.array(found, dtype=float), np.array(expected, dtype=float), reals) <= 1e-9
    np.testing.assert_array_equal(np.array(found)[:, reals:], np.array(expected)[:, reals:])


@pytest.mark.parametrize(
    ("parameters", "told"),
    [
        ({"joint_file": "other 50 %.toml"}, "other 50 %%.toml"),
        ({"warm_up": 60.0}, "warm_up 60 s"),
        ({"sample_time": 2e-3}, "--sample-time"),
    ],
)
def test_what_is_built_in_is_told(
    parameters: dict[str, Any], told: str, fmu: Path, table: FloatArray
) -> None:
    """Another joint file, sample time or a window without room: health 4 and a line in the log,
    no failure.
    """
    with Native(fmu, **parameters) as host:
        host.feed(table, 0, 20)
        assert host.integer("health") == 4
        assert told in host.log
        assert host.integer("n_samples") == 0


def test_what_it_lacks_is_told(fmu: Path, table: FloatArray) -> None:
    """A request for the optimiser is named in the log; a fixed parameter keeps its value;
    health stays.
    """
    with Native(fmu, optimise=True) as host:
        host.instance.call("setBoolean", [host.vr["reoptimise_request"]], [True])
        host.instance.call("setReal", [host.vr["warm_up"]], [2.0])
        host.feed(table, 0, 20)
        assert host.integer("health") == 1
        assert host.instance.call("getReal", [host.vr["warm_up"]]) == [7.0]
        for text in ("optimise: a native", "reoptimise_request: a native", "cannot be set"):
            assert text in host.log


# --- building -------------------------------------------------------------------------------------


def test_builds_the_same_bytes(spec: NativeSpec) -> None:
    assert native_sources(spec) == native_sources(spec)


def test_allocates_only_outside_the_step(spec: NativeSpec) -> None:
    """Memory is taken in fmi2Instantiate and for FMU states, nowhere in the estimator."""
    sources, _ = native_sources(spec)
    holders = {name for name, text in sources.items() if b"alloc(" in text}
    assert holders == {"fmi2_common.c", "living.c"}
    outside = (b"*instance(", b"*new_state(", b"int born(")
    functions = [f for name in holders for f in sources[name].split(b"\n}\n")]
    assert all(any(name in f for name in outside) for f in functions if b"alloc(" in f)


def test_command_line(tmp_path: Path) -> None:
    """Validated by fmpy and run in a fresh process by the builder; other platforms and times by
    name.
    """
    joint = write(tmp_path, start_of(replace(reference_joint("irj1b"), name="axis")))
    assert (
        main(
            [
                "native",
                "--joint",
                str(joint),
                "--out",
                str(tmp_path / "dist"),
                "--target",
                "linux64",
                "--sample-time",
                "0.002",
            ]
        )
        == 0
    )
    with zipfile.ZipFile(tmp_path / "dist" / "axis_native.fmu") as archive:
        assert "binaries/linux64/axis_native.so" in archive.namelist()
        description = archive.read("modelDescription.xml")
    spec = NativeSpec(load_joint(joint), "axis_native", OnlineOptions(), sample_time=0.002)
    assert description == native_sources(spec)[1]
    assert b'stepSize="0.002"' in description
    tool = Path(sys.executable).with_name("fmutool")
    assert tool.is_file() or not os.environ.get("CI")
    if tool.is_file():
        done = subprocess.run(
            [str(tool), "-input", str(tmp_path / "dist" / "axis_native.fmu"), "-check"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert "compliant with FMI-2.0" in done.stdout + done.stderr
        assert "No semantic error" in done.stdout + done.stderr


@pytest.mark.parametrize("kind", ["estimator", "native"])
def test_the_step_is_that_of_the_records_of_the_fit(kind: str, tmp_path: Path) -> None:
    """The joint file says it; a file without it has the usual one."""
    joint = start_of(replace(reference_joint("irj1b"), name="axis"))
    for told, step in ((0.0025, b"0.0025"), (None, b"0.001")):
        path = write(tmp_path / str(told), replace(joint, sample_time=told))
        assert load_joint(path).sample_time == told
        out = tmp_path / "dist"
        assert main([kind, "--joint", str(path), "--out", str(out)]) == 0
        with zipfile.ZipFile(out / f"axis_{kind}.fmu") as archive:
            description = archive.read("modelDescription.xml")
        assert b'stepSize="%s"' % step in description
        assert b'start="%s"' % step in description.split(b'name="sample_time"')[1][:400]


def test_unusable_requests(tmp_path: Path) -> None:
    joint = reference_joint("irj1b")
    for bad, text in (
        (NativeSpec(joint, "a b"), "identifier"),
        (NativeSpec(joint, "a", sample_time=0.0), "sample time"),
    ):
        with pytest.raises(InputError, match=text):
            build_native(bad, tmp_path / "a.fmu")
    with pytest.raises(InputError, match="win64"):
        native_targets("amiga")
    assert native_targets("darwin64") == ("x86_64-macos", "aarch64-macos")
    assert list(tmp_path.iterdir()) == []


# --- C hosts --------------------------------------------------------------------------------------


def replay(
    host: list[str], library: str, path: Path, table: FloatArray, folder: Path, **options: Any
) -> tuple[FloatArray, str]:
    """Real outputs after each step in the C host, and what it printed."""
    with Native(path) as native:
        refs, inputs, guid = native.refs["Real"], native.inputs, native.fmu.description.guid
    table.tofile(folder / "readings.bin")
    command = [
        *host,
        library,
        guid,
        "readings.bin",
        "results.bin",
        str(STEP),
        ",".join(map(str, inputs)),
        ",".join(map(str, refs)),
    ]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, **options
    )
    assert done.returncode == 0, done.stderr[-500:]
    return np.fromfile(folder / "results.bin").reshape(-1, len(refs)), done.stdout


def test_runs_in_a_c_host_without_python(fmu: Path, table: FloatArray, tmp_path: Path) -> None:
    """Another working directory, a path with space, umlaut and #, no Python in the environment:
    bits as under fmpy.
    """
    folder = tmp_path / "a b ü #1"
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(folder)
    program = tmp_path / "native_host"
    subprocess.run(
        [*find_compiler(), str(HOST), "-O1", f"-I{header_folder()}", "-o", str(program), "-ldl"],
        check=True,
    )
    readings = hurt(table)[:17_000]
    library = folder / "binaries" / "linux64" / "native.so"
    found, printed = replay(
        [str(program)], str(library), fmu, readings, tmp_path, env={"PATH": os.defpath}
    )
    linked = subprocess.run(
        ["ldd", str(library)], capture_output=True, text=True, check=False
    ).stdout
    assert "python" not in linked
    assert "ns per set + step + get" in printed
    with Native(fmu) as native:
        native.feed(readings, 0, 17_000)
        assert found[-1].tolist() == native.instance.call("getReal", native.refs["Real"])


@pytest.mark.slow
def test_windows_library_gives_the_same_under_wine(
    spec: NativeSpec, table: FloatArray, tmp_path: Path
) -> None:
    """The DLL that zig builds, in a host built the same way, against the Linux library: 40 s
    with faults, to 1e-9.
    """
    wine = shutil.which("wine64") or shutil.which("wine")
    if wine is None or not has_zig():
        pytest.skip("needs wine and the ziglang package")
    path = build_native(spec, tmp_path / "native.fmu", target=("linux64", "win64"))
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path / "fmu")
    program, here = tmp_path / "native_host.exe", tmp_path / "native_host"
    zig = find_compiler("x86_64-windows-gnu", "zig")
    subprocess.run([*zig, str(HOST), "-O1", f"-I{header_folder()}", "-o", str(program)], check=True)
    subprocess.run(
        [*find_compiler(), str(HOST), "-O1", f"-I{header_folder()}", "-o", str(here), "-ldl"],
        check=True,
    )
    readings = hurt(table)
    expected, _ = replay([str(here)], "fmu/binaries/linux64/native.so", path, readings, tmp_path)
    environment = {**os.environ, "WINEDEBUG": "-all", "WINEPREFIX": str(tmp_path / "wine")}
    found, _ = replay(
        [wine, str(program)],
        "fmu\\binaries\\win64\\native.dll",
        path,
        readings,
        tmp_path,
        env=environment,
    )
    assert found.shape == expected.shape
    assert largest(found, expected, found.shape[1]) <= 1e-9


@pytest.mark.slow
def test_valgrind_finds_nothing(fmu: Path, table: FloatArray, tmp_path: Path) -> None:
    """No invalid read, no use of memory that was never written, nothing lost, through first
    window, faults and recursion.
    """
    if shutil.which("valgrind") is None:
        pytest.skip("needs valgrind")
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(tmp_path / "fmu")
    program = tmp_path / "native_host"
    subprocess.run(
        [*find_compiler(), str(HOST), "-O1", f"-I{header_folder()}", "-o", str(program), "-ldl"],
        check=True,
    )
    checker = ["valgrind", "-q", "--error-exitcode=9", "--leak-check=full", str(program)]
    replay(checker, "fmu/binaries/linux64/native.so", fmu, hurt(table)[:16_500], tmp_path)


# --- written once ---------------------------------------------------------------------------------

FIGURE = re.compile(r"(?<![\w.])(?:\d+\.\d*|\.\d+|\d+)(?:[eE][+-]?\d+)?(?![\w.])")
PLAIN_NUMBERS = {"0", "1", "2", "3", "4", "5", "0.5", "1.0"}
"""Counts, indices, halves and wholes. No limit, time or factor of the estimator is among them."""
OTHER_NUMBERS = {
    "native_estimator.c": ["768"],
    "native_fault.c": ["11", "13", "16"],
    "native_residuals.c": ["16", "17", "18"],
    "native_state.h": ["40", "64"],
}
"""Room for texts, and positions in the outputs of the observer and among the residuals."""


def test_no_figure_of_the_estimator_stands_in_c(spec: NativeSpec) -> None:
    """Every limit, time, factor and kernel comes from the Python that has it; what the C has of its
    own are sizes of the FMI's texts and positions.
    """
    sources, _ = native_sources(spec)
    own = {n for n in sources if n.startswith("native_")} - {"native_config.h", "native_model.c"}
    assert len(own) > 8
    found = {}
    for name in own:
        text = re.sub(r"/\*.*?\*/|\"(?:[^\"\\]|\\.)*\"", "", sources[name].decode(), flags=re.S)
        code = [line for line in text.splitlines() if not line.startswith(("#define", "enum"))]
        found[name] = sorted(set(FIGURE.findall("\n".join(code))) - PLAIN_NUMBERS)
    assert {n: v for n, v in found.items() if v} == OTHER_NUMBERS
