"""A study on a Dask cluster: a scheduler and several worker processes on this machine, one of
them killed half-way.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from irj_fmu.batch.run import main, run_study
from irj_fmu.batch.worker import Chunk, forget, run_chunk
from irj_fmu.plant.joint import PlantOptions, plant_spec
from irj_fmu.plant.library import build_plant
from irj_fmu.plant.reference import reference_joint

pytest.importorskip("distributed", reason="install irj[dask]")
ROOT = Path(__file__).resolve().parents[2]
STUDY = """
[study]
stop = 6.0
step = 0.01
record = ["link_position", "link_torque"]
chunk = 3
every = 20
[[model]]
fmu = "plant.fmu"
[inputs]
i_m = {{ time = [0.0, 0.1, 3.0], value = [4.0, -2.0, 6.0] }}
[random]
count = {count}
[random.parameters]
stiffness = {{ low = 1e4, high = 4e4, spacing = "log" }}
link_inertia = {{ mean = 10.0, deviation = 1.0 }}
"""
WORKERS = 3


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_plant(
        plant_spec(reference_joint("irj_ts"), PlantOptions(name="plant")),
        tmp_path_factory.mktemp("plant") / "plant.fmu",
    )


def study(folder: Path, plant: Path, count: int) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "plant.fmu").write_bytes(plant.read_bytes())
    path = folder / "study.toml"
    path.write_text(STUDY.format(count=count))
    return path


def wait_for(condition: Any, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.01)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[Path, list[subprocess.Popen[bytes]]]]:
    """The scheduler's file and the workers: processes without a nanny, so that a killed one
    stays dead.
    """
    address = tmp_path / "scheduler.json"
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
        "DASK_DISTRIBUTED__ADMIN__TICK__LIMIT": "1h",
    }
    quiet = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
        "cwd": tmp_path,
        "env": environment,
    }
    command = [
        sys.executable,
        "-m",
        "distributed.cli.dask_scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--no-dashboard",
        "--no-show",
    ]
    processes = [subprocess.Popen([*command, "--scheduler-file", str(address)], **quiet)]  # type: ignore[call-overload]
    worker = [
        sys.executable,
        "-m",
        "distributed.cli.dask_worker",
        "--scheduler-file",
        str(address),
        "--no-nanny",
        "--nthreads",
        "1",
        "--no-dashboard",
    ]
    try:
        wait_for(address.exists)
        processes += [subprocess.Popen(worker, **quiet) for _ in range(WORKERS)]  # type: ignore[call-overload]
        yield address, processes[1:]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def connected(address: Path) -> dict[str, int]:
    """Process number of each worker that the scheduler knows."""
    from distributed import Client

    with Client(scheduler_file=str(address), timeout="20s", set_as_default=False) as client:
        return {name: int(pid) for name, pid in client.run(os.getpid).items()}


def test_a_killed_worker_loses_nothing(
    cluster: tuple[Path, list[subprocess.Popen[bytes]]],
    plant: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """120 runs on three workers; one is killed while portions are under way on it."""
    address, workers = cluster
    wait_for(lambda: len(connected(address)) == WORKERS)
    path = study(tmp_path / "study", plant, 120)
    chunks = tmp_path / "study" / "study-results" / "chunks"
    at_death: list[int] = []

    def kill() -> None:
        wait_for(lambda: len(list(chunks.glob("chunk-*.npz"))) >= 5)
        workers[0].send_signal(signal.SIGKILL)
        workers[0].wait()
        at_death.append(len(list(chunks.glob("chunk-*.npz"))))

    with ThreadPoolExecutor(1) as background:
        killed = background.submit(kill)
        assert main([str(path), "--dask", str(address)]) == 0
        killed.result()
    assert 5 <= at_death[0] < 40
    said = capsys.readouterr()
    assert "120 runs, 120 run now" in said.out
    assert " 0 failed" in said.out
    assert set(connected(address).values()) == {process.pid for process in workers[1:]}
    with ThreadPoolExecutor(1) as executor:
        run_study(path, out=tmp_path / "alone", executor=executor)
    for name in ("summary.csv", "results.npz"):
        assert (tmp_path / "study" / "study-results" / name).read_bytes() == (
            tmp_path / "alone" / name
        ).read_bytes()


def test_no_scheduler_is_one_line(
    plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = study(tmp_path / "study", plant, 2)
    monkeypatch.setattr("irj_fmu.batch.run.PATIENCE", 0.5)
    for address in ("tcp://127.0.0.1:9", "nonsense://x", "nowhere.json"):
        assert main([str(path), "--dask", address]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert f"--dask {address}: no scheduler answers there" in said
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main([str(path), "--dask", "tcp://127.0.0.1:9"]) == 2
    assert "pip install irj[dask]" in capsys.readouterr().err


def test_a_worker_that_does_not_see_the_files_takes_the_bytes(plant: Path, tmp_path: Path) -> None:
    """As on another machine: neither the extraction nor the file is there."""
    nowhere = str(tmp_path / "nowhere")
    chunk = Chunk(
        0,
        0,
        f"{nowhere}.fmu",
        nowhere,
        ({"stiffness": 2e4},),
        ("link_position",),
        {},
        {},
        0.01,
        0.1,
        1,
        plant.read_bytes(),
    )
    done = run_chunk(chunk)
    forget()
    assert done.errors == {}
    assert np.isfinite(done.values).all()
    lost = run_chunk(
        Chunk(0, 0, f"{nowhere}.fmu", nowhere, ({},), ("link_position",), {}, {}, 0.01, 0.1, 1)
    )
    assert "no such FMU" in lost.errors[0]
