"""The hosts: model exchange with moving inputs, connected co-simulation, faults."""

from __future__ import annotations

import gc
import os
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import fmpy.fmi1
import numpy as np
import numpy.typing as npt
import pytest
from test_fmu_package import pack
from test_fmu_plant import INPUTS, START, STATES, excitation, joint, reference

from identification.errors import InputError
from irj_fmu.host.exchange import Exchange, simulate_me
from irj_fmu.host.run import Fmu, FmuError, Instance, Wiring, simulate_cs
from irj_fmu.host.signals import Stuck, Table, bias, constant, drift, dropout, gain
from irj_fmu.plant.library import build_plant

FloatArray = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fmu]:
    with Fmu(build_plant(joint(), tmp_path_factory.mktemp("plant") / "two_mass.fmu")) as fmu:
        yield fmu


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fmu]:
    with Fmu(pack(tmp_path_factory.mktemp("toy")).path) as fmu:
        yield fmu


def test_threads_that_load_libraries_leave_the_working_directory(
    plant: Fmu, monkeypatch: pytest.MonkeyPatch
) -> None:
    """fmpy loads a library from its own folder: of two threads one took that of the other for the
    folder to go back to, and the process was left in one that is removed.
    """
    loader = fmpy.fmi1.cdll

    class Slow:
        @staticmethod
        def LoadLibrary(path: str) -> Any:  # noqa: N802
            time.sleep(0.02)
            return loader.LoadLibrary(path)

    monkeypatch.setattr(fmpy.fmi1, "cdll", Slow)
    here = os.getcwd()

    def load(number: int) -> None:
        time.sleep(0.005 * number)
        Instance(plant, "me").close()

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(load, range(4)))
    assert os.getcwd() == here


def test_a_library_that_cannot_be_loaded_leaves_the_working_directory(
    plant: Fmu, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Refuses:
        @staticmethod
        def LoadLibrary(path: str) -> Any:  # noqa: N802
            raise OSError(f"{path}: file too short")

    monkeypatch.setattr(fmpy.fmi1, "cdll", Refuses)
    here = os.getcwd()
    with pytest.raises(FmuError, match="cannot be loaded here"):
        Instance(plant)
    assert os.getcwd() == here


def tables(samples: FloatArray, step: float) -> dict[str, Table]:
    time = step * np.arange(len(samples))
    return {v.name: Table(time, samples[:, i]) for i, v in enumerate(INPUTS)}


def test_model_exchange_with_held_input_follows_scipy(plant: Fmu) -> None:
    samples = excitation(200, 1e-3)
    expected = reference(samples, 1e-3)
    with Instance(plant, "me") as instance:
        options = Exchange(tables(samples, 1e-3), record=[v.name for v in STATES])
        found = simulate_me(instance, 1e-3 * np.arange(201), options)
        again = simulate_me(instance, 1e-3 * np.arange(201), options)
    for i, v in enumerate(STATES):
        assert np.abs(found[v.name] - expected[:, i]).max() <= (1e-6 if v.unit == "rad/s" else 1e-8)
        np.testing.assert_array_equal(found[v.name], again[v.name])


def test_model_exchange_with_smooth_input_follows_scipy(plant: Fmu) -> None:
    """An input that moves inside the output interval, against DOP853."""
    from scipy.integrate import solve_ivp

    j_m, j_l, k, d, k3, f_v, f_c, mgl = START

    def slope(t: float, x: FloatArray) -> list[float]:
        twist = x[0] - x[2]
        torque = k * twist + k3 * twist**3 + d * (x[1] - x[3])
        friction = f_v * x[1] + f_c * np.tanh(x[1] / 0.05)
        u = 12 * np.sin(90 * t)
        return [x[1], (u - torque - friction) / j_m, x[3], (torque - mgl * np.sin(x[2])) / j_l]

    times = np.linspace(0, 0.5, 11)
    expected = solve_ivp(slope, (0, 0.5), [0.1, 0, 0, 0], "DOP853", times, rtol=1e-12, atol=1e-14).y
    with Instance(plant, "me") as instance:
        options = Exchange({"tau_m": lambda t: 12 * float(np.sin(90 * t))}, record=("q_m", "q_l"))
        found = simulate_me(instance, times, options)
    assert np.abs(found["q_m"] - expected[0]).max() <= 1e-8
    assert np.abs(found["q_l"] - expected[2]).max() <= 1e-8


def test_co_simulation_reuses_one_instance(plant: Fmu) -> None:
    samples = excitation(100, 1e-3)
    expected = reference(samples, 1e-3)
    inputs = {f"plant.{name}": table for name, table in tables(samples, 1e-3).items()}
    wiring = Wiring(inputs=inputs, record=("plant.q_l",))
    with Instance(plant, name="plant") as instance:
        runs = [simulate_cs(instance, wiring, step=1e-3, stop=0.1)["plant.q_l"] for _ in range(3)]
        stiff = Wiring(
            inputs=inputs, parameters={"plant.k": 9000.0, "plant.q_m": 0.0}, record=("plant.q_l",)
        )
        other = simulate_cs(instance, stiff, step=1e-3, stop=0.1)["plant.q_l"]
    for run in runs:
        assert np.abs(run - expected[:, 2]).max() <= 1e-8
    assert np.abs(other - expected[:, 2]).max() > 1e-3


def both(plant: Fmu, toy: Fmu, **options: object) -> Wiring:
    """Plant and estimator: the estimator sees the input torque and the spring torque of the
    same instant.
    """
    drive = Table(1e-3 * np.arange(200), excitation(200, 1e-3)[:, 0])
    return Wiring(
        connections={"toy.y": "plant.spring"},
        inputs={"plant.tau_m": drive, "toy.u": drive},
        record=("plant.tau_m", "plant.spring", "toy.u", "toy.y", "toy.theta[1]", "toy.health"),
        **options,  # type: ignore[arg-type]
    )


def test_plant_and_estimator_together(plant: Fmu, toy: Fmu) -> None:
    with Instance(plant, name="plant") as one, Instance(toy, name="toy") as two:
        found = simulate_cs({"plant": one, "toy": two}, both(plant, toy), step=1e-3, stop=0.2)
    np.testing.assert_array_equal(found["toy.y"], found["plant.spring"])
    np.testing.assert_array_equal(found["toy.u"], found["plant.tau_m"])
    assert not found["toy.health"].any()
    u, y = found["toy.u"][:200], found["toy.y"][:200]
    weight = np.sqrt(0.999 ** np.arange(199, -1, -1))
    prior = np.sqrt(0.999**200 / 1e3) * np.eye(2)
    matrix = np.vstack([np.column_stack([u, np.ones(200)]) * weight[:, None], prior])
    line = np.linalg.lstsq(matrix, np.concatenate([y * weight, np.zeros(2)]))[0]
    assert found["toy.theta[1]"][-1] == pytest.approx(line[0], rel=1e-9)


@pytest.mark.parametrize(
    ("fault", "law"),
    [
        (bias(0.1, 2.5), lambda t, y: y + 2.5 * (t > 0.0995)),
        (gain(0.1, 0.5), lambda t, y: np.where(t > 0.0995, y / 2, y)),
        (drift(0.05, 10.0), lambda t, y: y + 10 * np.maximum(t - 0.05, 0)),
    ],
)
def test_faults_act_on_the_estimator_only(plant: Fmu, toy: Fmu, fault, law) -> None:  # type: ignore[no-untyped-def]
    with Instance(plant, name="plant") as one, Instance(toy, name="toy") as two:
        wiring = both(plant, toy, faults={"toy.y": fault})
        found = simulate_cs({"plant": one, "toy": two}, wiring, step=1e-3, stop=0.2)
        healthy = simulate_cs({"plant": one, "toy": two}, both(plant, toy), step=1e-3, stop=0.2)
    np.testing.assert_array_equal(found["plant.spring"], healthy["plant.spring"])
    np.testing.assert_allclose(found["toy.y"], law(found.time, found["plant.spring"]), atol=1e-12)


def test_dropout_and_stuck_signal(plant: Fmu, toy: Fmu) -> None:
    with Instance(plant, name="plant") as one, Instance(toy, name="toy") as two:
        wiring = both(plant, toy, faults={"toy.y": dropout(0.1, 0.15), "toy.u": Stuck(0.05)})
        found = simulate_cs({"plant": one, "toy": two}, wiring, step=1e-3, stop=0.2)
    np.testing.assert_array_equal(found["toy.health"][102:150], 2)
    assert not found["toy.health"][:100].any()
    assert not found["toy.health"][152:].any()
    assert set(found["toy.u"][50:]) == {found["toy.u"][49]}


def test_names_and_times_are_checked(plant: Fmu) -> None:
    with Instance(plant, name="plant") as instance:
        with pytest.raises(InputError, match="did you mean: tau_m"):
            simulate_cs(instance, Wiring(inputs={"plant.tau_n": constant(0)}), step=1e-3, stop=1.0)
        with pytest.raises(InputError, match="whole number of steps"):
            simulate_cs(instance, Wiring(), step=0.3, stop=1.0)
        for stop in (float("nan"), float("inf"), -1.0, 0.0):
            with pytest.raises(InputError, match="whole number of steps"):
                simulate_cs(instance, Wiring(), step=0.1, stop=stop)
        with pytest.raises(InputError, match="nothing feeds"):
            simulate_cs(instance, Wiring(faults={"plant.tau_m": bias(0, 1)}), step=0.1, stop=1.0)
        with pytest.raises(InputError, match=r"instance\.variable"):
            simulate_cs(instance, Wiring(record=("tau_m",)), step=0.1, stop=1.0)
        with pytest.raises(FmuError, match=r"doStep.*not finite"):
            simulate_cs(
                instance, Wiring(inputs={"plant.tau_m": constant(float("nan"))}), step=0.1, stop=1.0
            )
        assert (
            simulate_cs(instance, Wiring(record=("plant.q_l",)), step=0.1, stop=0.2).time.size == 3
        )


def test_refuses_what_is_not_an_fmu(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such FMU"):
        Fmu(tmp_path / "none.fmu")
    (tmp_path / "a.fmu").write_text("not a zip")
    with pytest.raises(InputError, match="not a readable FMU"):
        Fmu(tmp_path / "a.fmu")


def test_table_holds_and_joins() -> None:
    time, values = np.array([0.0, 0.1, 0.3]), np.array([1.0, 2.0, 4.0])
    held, joined = Table(time, values), Table(time, values, hold=False)
    assert [held(t) for t in (-1, 0, 0.0999, 0.1, 0.2, 0.3, 9)] == [1, 1, 1, 2, 2, 4, 4]
    assert [joined(t) for t in (-1, 0.05, 0.2, 9)] == pytest.approx([1, 1.5, 3, 4])
    assert all(Table(1e-3 * np.arange(1000), np.arange(1000.0))(i * 1e-3) == i for i in range(1000))
    with pytest.raises(InputError, match="increase"):
        Table(time[::-1], values)


def test_log_is_on_request(toy: Fmu) -> None:
    """The toy tells a reading that is not finite in its log, which a host gets where it asks
    for it.
    """
    for log in (True, False):
        with Instance(toy, name="toy", log=log) as instance:
            simulate_cs(
                instance,
                Wiring(inputs={"toy.u": constant(float("nan"))}, record=("toy.health",)),
                step=1e-3,
                stop=0.005,
            )
            assert any("input not finite" in text for text in instance.messages) == log


def test_an_integer_input_takes_no_nan(toy: Fmu) -> None:
    with Instance(toy, name="toy") as instance:
        with pytest.raises(InputError, match="NaN or infinity"):
            simulate_cs(
                instance, Wiring(inputs={"toy.fail": constant(float("nan"))}), step=1e-3, stop=0.005
            )
        wiring = Wiring(inputs={"toy.fail": constant(0.0)}, faults={"toy.fail": dropout(0.002)})
        with pytest.raises(InputError, match="fed with nan"):
            simulate_cs(instance, wiring, step=1e-3, stop=0.005)


def test_a_fault_acts_once_on_a_table(plant: Fmu) -> None:
    """The first point is exchanged before and after initialization; the bias must not add up."""
    wiring = Wiring(
        inputs={"plant.tau_m": constant(1.0)},
        faults={"plant.tau_m": bias(0.0, 2.0)},
        record=("plant.tau_m",),
    )
    with Instance(plant, name="plant") as instance:
        np.testing.assert_array_equal(
            simulate_cs(instance, wiring, step=1e-3, stop=0.01)["plant.tau_m"], np.full(11, 3.0)
        )


def test_an_fmu_that_nobody_closes_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = pack(tmp_path).path
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    opened = Fmu(made)
    folder = opened.folder
    assert folder.is_dir()
    del opened
    gc.collect()
    assert not folder.exists()
