"""Long runs with flat memory: ``python -m tests.soak native slave sessions``.

``native`` and ``slave`` build the estimator FMU of a reference joint, from C and in Python, and
step it ``--steps`` times under one instance. The readings have faults of every kind and begin anew
every 40 s, so that the detector works all the time. ``sessions`` opens ``--count`` sessions on a
server of the page, one after the other: demo, events, views, every ``--fit``-th a fit, deleted
again. Read is the memory that is resident, of the server with its processes. It may rise while what
is kept once fills up; from one half of the run to its end it must not. Exit code 1: it did.

How long it took and how the memory went is printed; a run that is cut short by ``--seconds`` says
how far it came.
"""

from __future__ import annotations

import argparse
import http.client
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

import numpy as np

ROOT: Final = Path(__file__).resolve().parents[1]
READINGS: Final = 40.0
"""Length of the readings that are repeated [s]."""
JOINT: Final = "hd3"
MARKS: Final = 20
"""Times at which the memory is read."""
MOST: Final = 4.0
"""What the memory may rise by in the second half [MB]: Python takes it from the system by 1 MB, the
C library by a little more, and which of them is free at the moment changes.
"""
SERVE: Final = (
    "import sys; from pathlib import Path; from workbench.page.server import serve; "
    "serve([], 0, False, root=Path(sys.argv[1]))"
)


def resident(pid: int) -> float:
    """Memory of a process and all below it [MB]."""
    pages, below = 0, [pid]
    for one in below:
        try:
            pages += int(Path(f"/proc/{one}/statm").read_text().split()[1])
            for task in Path(f"/proc/{one}/task").iterdir():
                below += map(int, (task / "children").read_text().split())
        except OSError:  # it has ended meanwhile
            continue
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class Course:
    """The memory of a process over a run, and whether it is flat."""

    def __init__(self, what: str, pid: int, total: int, seconds: float) -> None:
        self.what, self.pid, self.total = what, pid, total
        self.began, self.seconds = time.monotonic(), seconds
        self.marks: list[tuple[int, float]] = []

    def goes_on(self, done: int) -> bool:
        """Read the memory; whether there is time left."""
        self.marks.append((done, resident(self.pid)))
        return time.monotonic() - self.began < self.seconds

    def judged(self) -> bool:
        """Print the course; whether it is flat."""
        done, last = self.marks[-1]
        half = [m for n, m in self.marks if n >= done / 2]
        rise = float(np.mean(half[-3:]) - np.mean(half[:3]))
        shown = ", ".join(f"{m:.1f}" for _, m in self.marks[:: max(1, len(self.marks) // 10)])
        print(
            f"{self.what}: {done} of {self.total} in {time.monotonic() - self.began:.0f} s; "
            f"resident [MB] {shown}, {last:.1f}; second half {rise:+.2f} MB: "
            f"{'flat' if rise < MOST else 'NOT FLAT'}",
            flush=True,
        )
        return rise < MOST


def estimator(kind: str, steps: int, seconds: float) -> bool:
    """Step an estimator FMU; whether its memory is flat."""
    from benchmarks.native import STEP, hurt, readings_of, specification
    from irj_fmu.estimator.native import build_native
    from irj_fmu.host.fmu import Fmu, Instance

    spec = specification(JOINT)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        if kind == "native":
            path = build_native(spec, folder / "native.fmu")
        else:
            path = _packed(spec, folder)
        rows = hurt(readings_of(JOINT, READINGS)).tolist()
        with Fmu(path) as fmu, Instance(fmu, name=kind) as instance:
            drive = "i_m" if "i_m" in fmu.variables else "tau_m"
            inputs = instance.blocks((drive, "q_m", "w_m", "q_l", "w_l", "tau_l"))[0]
            names = [n for n, v in fmu.variables.items() if v.causality == "output"]
            outputs = instance.blocks([n for n in names if fmu.variables[n].type == "Real"])[0]
            instance.begin(0.0)
            instance.ready()
            course = Course(f"{kind} FMU, steps", os.getpid(), steps, seconds)
            portion = max(1, steps // (50 * MARKS))
            for k, row in zip(range(steps), itertools.cycle(rows), strict=False):
                inputs.values[:] = row
                instance.write(inputs)
                instance.step(k * STEP, STEP)
                instance.read(outputs)
                if k % portion == 0:
                    instance.messages.clear()  # the host's own list
                    if not course.goes_on(k):
                        break
            course.goes_on(k)
            return course.judged()


def _packed(spec: Any, folder: Path) -> Path:
    from identification.data.joint_file import toml_text
    from irj_fmu.estimator.packed import options_text
    from irj_fmu.estimator.slave import DETECTOR_FILE, JOINT_FILE, OPTIONS_FILE
    from irj_fmu.fmi.package import SlaveSpec, package_slave

    values = {k: {"value": v, "unit": "", "side": ""} for k, v in spec.joint.fitted.items()}
    (folder / JOINT_FILE).write_text(toml_text(spec.joint, values), encoding="utf-8")
    (folder / OPTIONS_FILE).write_text(options_text(spec.options), encoding="utf-8")
    (folder / DETECTOR_FILE).write_bytes(spec.detector_state)
    files = {n: folder / n for n in (JOINT_FILE, OPTIONS_FILE, DETECTOR_FILE)}
    packages = tuple(ROOT / p for p in ("casadi_models", "identification", "irj_fmu"))
    slave = SlaveSpec("slave", "irj_fmu.estimator.slave", "Estimator", packages, files)
    return package_slave(slave, folder / "slave.fmu").path


class _Page:
    """A server of the page in a process of its own, and its one client."""

    def __init__(self, root: Path) -> None:
        paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        self.process = subprocess.Popen(
            [sys.executable, "-c", SERVE, str(root)],
            env={**os.environ, "PYTHONPATH": paths},
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        address, _, key = self.process.stdout.readline().strip().partition("#home=")
        self.key, self.port = key, int(address.strip("/").rpartition(":")[2])

    def asked(self, method: str, path: str, body: object = None) -> Any:
        """Answer of the server as data."""
        line = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        try:
            sent = json.dumps(body or {}).encode() if method == "POST" else None
            line.request(method, path, sent, {"X-IRJ": "1", "X-IRJ-Home": self.key})
            answer = line.getresponse()
            text = answer.read()
            if answer.status >= 300:
                raise RuntimeError(f"{method} {path}: {answer.status} {text[:200]!r}")
            return json.loads(text)
        finally:
            line.close()

    def heard(self, path: str) -> None:
        """Open the stream of events, hear the first, and leave."""
        line = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        line.request("GET", path)
        line.getresponse().readline()
        line.close()

    def settled(self, where: str) -> None:
        """Wait until no job is left."""
        while self.asked("GET", where)["job"] is not None:
            time.sleep(0.05)


def sessions(count: int, fit_every: int, seconds: float) -> bool:
    """Open and delete sessions of the page; whether the memory is flat."""
    with tempfile.TemporaryDirectory() as root:
        page = _Page(Path(root))
        try:
            course = Course("page sessions", page.process.pid, count, seconds)
            for k in range(count):
                made = page.asked("POST", "/api/session")["id"]
                where = f"/api/session/{made}"
                page.asked("POST", f"{where}/demo")
                page.heard(f"{where}/events")
                page.settled(where)
                page.asked("GET", f"{where}/view/tree")
                if fit_every and k % fit_every == 0:
                    page.asked("POST", f"{where}/run", {"action": "fit"})
                    page.settled(where)
                    page.asked("GET", f"{where}/view/compare")
                page.asked("DELETE", f"/api/home/{made}")
                if k % max(1, count // (10 * MARKS)) == 0 and not course.goes_on(k + 1):
                    break
            course.goes_on(k + 1)
            kept = [p.name for p in Path(root).iterdir() if p.is_dir()]
            if kept:
                print(f"left: {', '.join(kept[:10])}")
            return course.judged() and not kept
        finally:
            page.process.terminate()
            page.process.wait(30)


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.soak", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("what", nargs="+", choices=("native", "slave", "sessions"))
    parser.add_argument("--steps", type=int, default=10_000_000, help="of an estimator")
    parser.add_argument("--count", type=int, default=1000, help="sessions of the page")
    parser.add_argument("--fit", type=int, default=50, help="every Nth session fits (0: none)")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="of one run at most")
    given = parser.parse_args()
    flat = True
    for what in given.what:
        if what == "sessions":
            flat &= sessions(given.count, given.fit, given.seconds)
        else:
            flat &= estimator(what, given.steps, given.seconds)
    return 0 if flat else 1


if __name__ == "__main__":
    sys.exit(main())
