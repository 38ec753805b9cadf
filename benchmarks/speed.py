"""Times of the loop on a record of 40 s at 1 kHz, and of reading and comparing a million samples.

    python benchmarks/speed.py

Each part runs in a process of its own with one BLAS thread; peak memory is that of the process.
"""

from __future__ import annotations

import os

os.environ.update(
    dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
)

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

MILLION = 1_000_000
EFFECTS = ("viscous", "coulomb", "gravity")


def clock(name: str, begin: float, cpu: float, limit: float) -> None:
    """One row of the table."""
    print(
        f"{name:34s} {time.perf_counter() - begin:8.2f} s {time.process_time() - cpu:8.2f} s CPU "
        f"  target {limit:g} s",
        flush=True,
    )


def now() -> tuple[float, float]:
    """Wall and CPU clock [s]."""
    return time.perf_counter(), time.process_time()


def make(folder: Path) -> None:
    """Write a record of 40 s at 1 kHz with hidden Stribeck friction, and one of a million
    samples (its copies in a row).
    """
    from identification import Joint
    from identification.data.typical import true_values
    from workbench.cli.virtual import recording

    joint = Joint(
        name="virtual",
        gear_ratio=160.0,
        torque_per_current=8.848,
        model_name="hd3",
        effects=EFFECTS,
    )
    model = joint.model().add("stribeck@motor")
    model = model.with_values(true_values(model, joint))
    for name, motion, seed in (("train", "triangle", 1), ("test", "multisine", 2)):
        table = recording(model, joint, 40.0, 1000.0, seed, motion)
        np.savetxt(
            folder / f"{name}.csv",
            np.column_stack(list(table.values())),
            fmt="%.9g",
            delimiter=",",
            header=",".join(table),
            comments="",
        )
    body = (folder / "train.csv").read_text().splitlines()
    rows = np.loadtxt(body[1:], delimiter=",")
    many = np.tile(rows, (MILLION // len(rows), 1))
    many[:, 0] = np.arange(len(many)) * 1e-3
    columns = body[0].split(",") + ["run"]
    many = np.column_stack([many, np.repeat(np.arange(len(many) // len(rows)), len(rows))])
    np.savetxt(
        folder / "million.csv",
        many,
        fmt="%.9g",
        delimiter=",",
        header=",".join(columns),
        comments="",
    )


def loop(folder: Path) -> None:
    """Fit, refit, diagnose and improve."""
    from identification import Joint, diagnose, fit, improve, read
    from identification.fitting.output_error import refine

    joint = Joint(
        name="virtual",
        gear_ratio=160.0,
        torque_per_current=8.848,
        model_name="hd3",
        effects=EFFECTS,
    )
    train, test = read(folder / "train.csv"), read(folder / "test.csv")
    begin, cpu = now()
    fitted = fit(joint, train)
    clock("fit (weak form)", begin, cpu, 3)
    begin, cpu = now()
    fit(fitted.model.add("stribeck@motor"), train, joint=joint)
    clock("refit with one more effect", begin, cpu, 3)
    begin, cpu = now()
    found = diagnose(fitted, test)
    clock(
        f"diagnose ({', '.join(found.claims[0].effects) if found.claims else 'nothing'})",
        begin,
        cpu,
        2,
    )
    begin, cpu = now()
    improve(train, joint, [test])
    clock("improve, whole loop", begin, cpu, 10)
    begin, cpu = now()
    refine(fitted)
    clock("fit --refine, first (compiles)", begin, cpu, 5)
    begin, cpu = now()
    refine(fitted)
    clock("fit --refine, again", begin, cpu, 5)


def million(folder: Path) -> None:
    """Read and compare a million samples."""
    from identification import Joint, compare, fit, read

    joint = Joint(
        name="virtual",
        gear_ratio=160.0,
        torque_per_current=8.848,
        model_name="hd3",
        effects=EFFECTS,
    )
    fitted = fit(joint, read(folder / "train.csv"))
    begin, cpu = now()
    record = read(folder / "million.csv")
    clock(f"read {len(record)} samples (CSV)", begin, cpu, 2)
    begin, cpu = now()
    compare(fitted, record)
    clock("compare", begin, cpu, 5)
    print(
        f"{'peak memory':34s} {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:8.2f} "
        f"GB{'':15s}target 1.5 GB"
    )


def main() -> None:
    """Run every part in its own process."""
    parts = {"make": make, "loop": loop, "million": million}
    if len(sys.argv) == 3:
        parts[sys.argv[1]](Path(sys.argv[2]))
        return
    with tempfile.TemporaryDirectory() as folder:
        os.environ["IDENTIFICATION_CACHE"] = folder  # nothing is compiled beforehand
        for part in parts:
            subprocess.run(
                [sys.executable, __file__, part, folder],
                check=True,
                stderr=subprocess.DEVNULL if part == "make" else None,
            )
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
