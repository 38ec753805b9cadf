"""All variants of a joint's model: how many, how long, and how near to converged fits.

    python -m benchmarks.explore [--seconds 40] [--rate 1000] [--sample 50] [--seed 3]
    python -m benchmarks.explore --joints 20 [--start 81000] [--size 1] [--keep FILE]
    python -m benchmarks.explore --planted emps

A simulated joint with two hidden effects in `--seconds` at `--rate` Hz, and a second record held
out. Printed: variants scored and fitted, processor seconds of the whole with `improve`; then, for a
random sample of the fitted variants, how many are shown with an error within 1 % of that of a
converged fit.

With `--joints` or `--planted` instead: whether the true structure is on the front, and recommended,
on joints of the recorded world, and on recordings of a real axis in which an effect was planted
(:mod:`benchmarks.explore.structures`).
"""

from __future__ import annotations

import os

os.environ.update(
    dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
)

import argparse
import sys
import tempfile
import time
from functools import partial
from importlib.resources import files
from pathlib import Path

import numpy as np

from benchmarks.explore.structures import on_rig, structures, table
from identification import Record, explore, load_joint, read
from identification.data.joint_file import Joint
from identification.variants.choice import score_of
from identification.variants.exploration import Exploration
from identification.variants.refit import Weighting, refitted
from tests.recorded_world.planted import RIGS
from workbench.cli.main import main as irj

HIDDEN = ("stribeck", "kinematic_error")
DEMO = Path(str(files("workbench"))) / "demo" / "joint.toml"
CONVERGED = 60
NEAR = 0.01


def records(seconds: float, rate: float, seed: int) -> tuple[Record, Record]:
    """A training record and one to hold out, of one joint."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for number, length in enumerate((seconds, seconds / 2)):
            path = Path(folder) / f"record{number}.npz"
            given = ["simulate", "--joint", str(DEMO), "--seconds", str(length)]
            given += ["--rate", str(rate), "--seed", str(seed + number), "-o", str(path)]
            given += ["--set", "gravity_cosine=0"]
            for key in HIDDEN:
                given += ["--hide", key]
            if irj(given):
                raise SystemExit("the joint could not be simulated")
            found.append(read(path))
    return found[0], found[1]


def timed(train: Record, joint: Joint, held: Record) -> tuple[Exploration, float]:
    """An exploration and its processor seconds."""
    began = time.process_time()
    found = explore(train, joint, held)
    return found, time.process_time() - began


def near(found: Exploration, sample: int, seed: int) -> tuple[int, int, int, float]:
    """Fitted variants of a sample, those within 1 % in each balance, those within .01 in the score,
    and seconds of a converged fit.
    """
    data = found.data
    weighting = Weighting.of(found.recommended.solution, data)
    every = list(found.variants)
    chosen = np.random.default_rng(seed).permutation(len(every))[:sample]
    close = alike = 0
    began = time.process_time()
    for k in chosen.tolist():
        solution = every[k].solution
        shown = refitted(solution.model, data, (solution.values,), weighting, steps=0)
        whole = refitted(solution.model, data, (solution.values,), weighting, steps=CONVERGED)
        close += bool(np.all(np.abs(shown.held.rms / whole.held.rms - 1) < NEAR))
        scores = [
            float(score_of(r.squares.sum(axis=0), r.rows.sum(axis=0), np.array(0.0)))
            for r in (shown, whole)
        ]
        alike += abs(scores[0] - scores[1]) < NEAR
    return len(chosen), close, alike, (time.process_time() - began) / max(len(chosen), 1)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--sample", type=int, default=50)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--joints", type=int, default=0, help="instead: joints with a known truth")
    parser.add_argument("--start", type=int, default=81000, help="first seed of these")
    parser.add_argument("--size", type=float, default=1.0, help="factor on what is hidden in them")
    parser.add_argument("--planted", choices=list(RIGS), help="instead: a recorded axis")
    parser.add_argument("--keep", type=Path, help="file of outcomes of this version: not run again")
    options = parser.parse_args()
    if options.planted:
        print(table(on_rig(options.planted, partial(print, file=sys.stderr, flush=True))))
        return
    if options.joints:
        told = partial(print, file=sys.stderr, flush=True)
        print(table(structures(options.joints, options.start, options.size, options.keep, told)))
        return
    train, held = records(options.seconds, options.rate, options.seed)
    found, seconds = timed(train, load_joint(DEMO), held)
    count, close, alike, each = near(found, options.sample, options.seed)
    print(f"| {options.seconds:g} s at {options.rate:g} Hz, hidden: {' and '.join(HIDDEN)} | |")
    print("|---|---|")
    print(f"| variants scored / fitted | {found.screened} / {len(found.variants)} |")
    print(f"| processor seconds, with `improve` | {seconds:.1f} |")
    print(f"| sample of the fitted ones | {count} |")
    print(f"| held-out RMS of every balance within 1 % of a converged fit | {close} of {count} |")
    print(f"| score within .01 of a converged fit's | {alike} of {count} |")
    print(f"| seconds of a converged fit and its errors | {each:.2f} |")
    print(f"| recommended | {' '.join(found.recommended.added)} |")
    print(f"| `improve` | {' '.join(found.improvement.added)} |")
    print(f"| ties | {len(found.ties)} |")


if __name__ == "__main__":
    main()
