"""Batches and SSP: the same numbers from every executor, resumption, a worker that dies."""

from __future__ import annotations

import os
import signal
import subprocess
import zipfile
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from test_fmu_package import clean_environment, ecos, pack
from test_fmu_plant import excitation, joint

from identification.errors import InputError
from irj_fmu.batch import fleet
from irj_fmu.batch.fleet import Batch, run_fleet
from irj_fmu.fmi.ssp import PARAMETERS, System, multisine_source, write_ssp
from irj_fmu.host.run import Fmu, FmuError, Instance, Wiring, simulate_cs
from irj_fmu.host.signals import Table
from irj_fmu.plant.library import build_plant

FloatArray = npt.NDArray[np.float64]
POISON = 4321.0


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_plant(joint(), tmp_path_factory.mktemp("plant") / "two_mass.fmu")


@pytest.fixture(scope="module")
def batch(plant: Path) -> Batch:
    drive = Table(1e-3 * np.arange(50), excitation(50, 1e-3)[:, 0])
    cases = [{"k": 3000.0 + 100 * i, "J_l": 1.0 + 0.1 * i} for i in range(10)]
    return Batch(plant, cases, ("q_l", "spring"), {"tau_m": drive}, 1e-3, 0.05, chunk=3)


@pytest.fixture(scope="module")
def expected(batch: Batch) -> FloatArray:
    rows = []
    with Fmu(batch.fmu) as fmu, Instance(fmu, name="p") as instance:
        for case in batch.cases:
            wiring = Wiring(
                inputs={"p.tau_m": batch.inputs["tau_m"]},
                parameters={f"p.{k}": v for k, v in case.items()},
                record=("p.q_l",),
            )
            rows.append(simulate_cs(instance, wiring, step=1e-3, stop=0.05)["p.q_l"])
    return np.array(rows)


@pytest.mark.parametrize(
    "make", [lambda: None, lambda: ThreadPoolExecutor(2), lambda: ProcessPoolExecutor]
)
def test_every_executor_gives_the_same(make, batch: Batch, expected: FloatArray) -> None:  # type: ignore[no-untyped-def]
    seen: list[tuple[int, int]] = []
    executor = make()
    found = run_fleet(
        batch, executor=executor, workers=2, progress=lambda done, total: seen.append((done, total))
    )
    if isinstance(executor, Executor):
        executor.shutdown()
    np.testing.assert_array_equal(found.signals["q_l"], expected)
    assert found.errors == {}
    assert found.time.shape == (51,)
    assert len(seen) == 4
    assert seen[-1] == (10, 10)


def test_goes_on_where_it_stopped(
    batch: Batch, expected: FloatArray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ThreadPoolExecutor(1) as executor:
        run_fleet(batch, executor=executor, folder=tmp_path)
        (tmp_path / "chunk-000002.npz").unlink()
        ran: list[int] = []
        work = fleet.run_chunk
        monkeypatch.setattr(
            fleet, "run_chunk", lambda chunk: (ran.append(chunk.number), work(chunk))[1]
        )
        found = run_fleet(batch, executor=executor, folder=tmp_path)
    assert ran == [2]
    np.testing.assert_array_equal(found.signals["q_l"], expected)
    with pytest.raises(InputError, match="another batch"):
        run_fleet(replace(batch, step=5e-4), folder=tmp_path)


def test_a_case_that_fails_is_named(batch: Batch, expected: FloatArray) -> None:
    cases = [dict(case) for case in batch.cases]
    cases[4]["k"] = float("nan")
    with ThreadPoolExecutor(1) as executor:
        found = run_fleet(replace(batch, cases=cases), executor=executor)
    assert list(found.errors) == [4]
    assert "not finite" in found.errors[4]
    assert np.isnan(found.signals["q_l"][4]).all()
    np.testing.assert_array_equal(np.delete(found.signals["q_l"], 4, 0), np.delete(expected, 4, 0))


def deadly(chunk):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN201
    """Die where a case holds the poison: once where a marker file can be made, else always."""
    marker = Path(os.environ["IRJ_TEST_MARKER"])
    if any(case["k"] == POISON for case in chunk.cases) and not (
        marker.suffix == ".once" and marker.exists()
    ):
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return ORIGINAL(chunk)


ORIGINAL = fleet.run_chunk


@pytest.mark.parametrize("kind", ["once", "always"])
def test_a_dead_process_loses_one_case(
    kind: str, batch: Batch, expected: FloatArray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The chunk is tried again; where it kills the process again, its cases run one by one and
    only the culprit is lost.
    """
    monkeypatch.setenv("IRJ_TEST_MARKER", str(tmp_path / f"marker.{kind}"))
    monkeypatch.setattr(fleet, "run_chunk", deadly)
    cases = [dict(case) for case in batch.cases]
    cases[4]["k"] = POISON
    found = run_fleet(
        replace(batch, cases=cases), executor=lambda: ProcessPoolExecutor(2), workers=2
    )
    others = [0, 1, 2, 3, 5, 6, 7, 8, 9]
    np.testing.assert_array_equal(found.signals["q_l"][others], expected[others])
    if kind == "once":
        assert found.errors == {}
        assert np.isfinite(found.signals["q_l"]).all()
    else:
        assert list(found.errors) == [4]
        assert "died" in found.errors[4]
        assert np.isnan(found.signals["q_l"][4]).all()


def test_an_fmu_that_ends_every_process_is_given_up(
    batch: Batch, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IRJ_TEST_MARKER", str(tmp_path / "marker.always"))
    monkeypatch.setattr(fleet, "run_chunk", deadly)
    many = replace(batch, cases=[{"k": POISON}] * 40, chunk=20)
    with pytest.raises(FmuError, match=r"two_mass\.fmu: 5 of 5 cases have ended their process"):
        run_fleet(
            many, executor=lambda: ProcessPoolExecutor(1), workers=1, folder=tmp_path / "kept"
        )
    assert not list((tmp_path / "kept").glob("chunk-*"))


@pytest.fixture(scope="module")
def system(plant: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[System, Path]:
    folder = tmp_path_factory.mktemp("ssp")
    source = build_plant(
        multisine_source([8.0, 3.0], [1.1, 6.3], [0.0, 0.7], unit="N.m"), folder / "source.fmu"
    )
    made = System(
        {"source": source, "plant": plant, "toy": pack(folder).path},
        {"plant.tau_m": "source.signal", "toy.u": "source.signal", "toy.y": "plant.spring"},
        {"plant.k": 4000.0},
        stop=0.2,
    )
    return made, write_ssp(made, folder / "joint.ssp")


@pytest.fixture(scope="module")
def own(system: tuple[System, Path]) -> dict[str, FloatArray]:
    """The same system by the project's own master."""
    made, _ = system
    fmus = {name: Fmu(path) for name, path in made.components.items()}
    instances = {name: Instance(fmu, name=name) for name, fmu in fmus.items()}
    record = ("source.signal", "plant.spring", "toy.theta[1]")
    wiring = Wiring(made.connections, parameters=made.parameters, record=record)
    found = simulate_cs(instances, wiring, step=1e-3, stop=0.2)
    for name in fmus:
        instances[name].close()
        fmus[name].close()
    return dict(found.signals)


def test_source_is_the_sum_of_sines(own: dict[str, FloatArray]) -> None:
    t = 1e-3 * np.arange(201)
    np.testing.assert_allclose(
        own["source.signal"],
        8 * np.sin(2 * np.pi * 1.1 * t) + 3 * np.sin(2 * np.pi * 6.3 * t + 0.7),
        atol=1e-12,
    )


def test_ssp_is_the_same_again(system: tuple[System, Path], tmp_path: Path) -> None:
    made, path = system
    assert write_ssp(made, tmp_path / "again.ssp").read_bytes() == path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        assert "SystemStructure.ssd" in archive.namelist()


def line(u: FloatArray, y: FloatArray) -> float:
    """The slope by lstsq, with the toy's forgetting and prior."""
    count = len(u)
    weight = np.sqrt(0.999 ** np.arange(count - 1, -1, -1))
    prior = np.sqrt(0.999**count / 1e3) * np.eye(2)
    matrix = np.vstack([np.column_stack([u, np.ones(count)]) * weight[:, None], prior])
    return float(np.linalg.lstsq(matrix, np.concatenate([y * weight, np.zeros(2)]))[0][0])


def test_ssp_runs_in_fmpy(system: tuple[System, Path], own: dict[str, FloatArray]) -> None:
    """Fmpy passes values on one step late, zeros first; its estimate is the line through what
    it passed on.
    """
    from fmpy.ssp.simulation import simulate_ssp
    from fmpy.ssp.ssd import read_ssd, read_ssv

    made, path = system
    assert {e.name for e in read_ssd(str(path)).system.elements} == set(made.components)
    values = read_ssv(str(path), PARAMETERS)
    found = simulate_ssp(str(path), stop_time=0.2, step_size=1e-3, parameter_set=values)
    np.testing.assert_allclose(
        found["source.signal"], own["source.signal"][1 : len(found) + 1], atol=1e-12
    )
    np.testing.assert_allclose(found["plant.spring"][0], own["plant.spring"][1], rtol=1e-4)
    u, y = (np.concatenate([[0.0], found[f"toy.{name}"][:-1]]) for name in "uy")
    assert found["toy.theta[1]"][-1] == pytest.approx(line(u, y), rel=1e-9)


def test_ssp_runs_in_ecos(
    system: tuple[System, Path], own: dict[str, FloatArray], tmp_path: Path
) -> None:
    """To the six decimals that ecos writes."""
    program = ecos(tmp_path)
    options = ["--stopTime", "0.2", "--stepSize", "0.001", "--parameterSet", system[0].name]
    done = subprocess.run(
        [program, "simulate", "--path", str(system[1]), *options],
        cwd=tmp_path,
        env=clean_environment(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    lines = next(tmp_path.rglob("*.csv")).read_text().splitlines()
    names = [name.strip() for name in lines[0].split(",")]
    rows = [row.split(",") for row in lines[1:]]
    for name in ("source.signal", "plant.spring", "toy.theta[1]"):
        place = names.index(f"{name.replace('.', '::')}[REAL]")
        column = np.array([float(row[place]) for row in rows])
        np.testing.assert_allclose(column, own[name][: len(column)], atol=1e-6)


def test_ssp_checks_names(system: tuple[System, Path], tmp_path: Path) -> None:
    made, _ = system
    with pytest.raises(InputError, match="there is no"):
        write_ssp(replace(made, connections={"plant.nothing": "source.signal"}), tmp_path / "a.ssp")
    with pytest.raises(InputError, match="output to an input"):
        write_ssp(replace(made, connections={"plant.tau_m": "plant.k"}), tmp_path / "a.ssp")
