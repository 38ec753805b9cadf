"""The end of a process that ran FMUs of stock pythonfmu, whose library releases its interpreter
twice unless helped.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from irj_fmu.host.run import Fmu, Instance
from irj_fmu.imported.library import UserFmu, UserInstance
from tests.irj_fmu.test_fmu_package import LOADER

SLAVE = Path(__file__).parents[2] / "user_fmus" / "stock_slave.py"
RUN = """
import sys
from pathlib import Path
from irj_fmu.host.run import Fmu, Instance
from irj_fmu.imported.library import UserFmu, UserInstance
path, way = Path(sys.argv[1]), sys.argv[2]
if way == "user":
    fmu = UserFmu(path)
    made = [UserInstance(fmu, "cs"), UserInstance(fmu, "cs")]
    for instance in made:
        instance.begin(0.0, {"m": 2.0})
        instance.ready()
        instance.do_step(0.0, 0.1)
    made[0].close()  # the other one is left to the end of the process
else:
    instance = Instance(Fmu(path))
    instance.begin()
    instance.ready()
    instance.step(0.0, 0.1)
print("done")
"""


@pytest.fixture(scope="module")
def stock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stock")
    subprocess.run(
        [sys.executable, "-m", "pythonfmu", "build", "-f", str(SLAVE), "-d", str(folder)],
        check=True,
        capture_output=True,
    )
    return folder / "StockSlave.fmu"


def after_ten_steps(instance: UserInstance) -> float:
    position = instance.block(["q"])
    instance.begin(0.0, {"tau": 3.0, "m": 2.0})
    instance.ready()
    for i in range(10):
        instance.do_step(0.1 * i, 0.1)
    return float(instance.read(position)[0])


def test_instances_live_on_when_others_go_and_new_ones_start_afresh(stock: Path) -> None:
    """The interpreter is let go after the last instance alone; explicit Euler says where the
    mass is.
    """
    v = q = 0.0
    for _ in range(10):
        v += 0.1 * (3.0 - 0.5 * v) / 2.0
        q += 0.1 * v
    fmu = UserFmu(stock)
    first, second = UserInstance(fmu, "cs"), UserInstance(fmu, "cs")
    assert after_ten_steps(first) == pytest.approx(q, rel=1e-12)
    first.close()
    first.close()
    assert after_ten_steps(second) == pytest.approx(q, rel=1e-12)
    second.close()
    with UserInstance(fmu, "cs") as third:
        assert after_ten_steps(third) == pytest.approx(q, rel=1e-12)
    with Fmu(stock) as other, Instance(other) as hosted:
        hosted.begin()
        hosted.ready()
        hosted.step(0.0, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["user", "host"])
def test_valgrind_finds_no_invalid_access_at_exit(stock: Path, tmp_path: Path, way: str) -> None:
    """Exit codes prove nothing: whether the second release is noticed depends on the layout of
    the heap.
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
        [valgrind, *options, sys.executable, "-c", RUN, str(stock), way],
        env={**os.environ, "PYTHONMALLOC": "malloc"},
        capture_output=True,
        text=True,
    )
    assert done.stdout == "done\n", done.stderr[-4000:]
    assert done.returncode == 0, done.stderr[-4000:]
    assert "ERROR SUMMARY: 0 errors" in done.stderr
