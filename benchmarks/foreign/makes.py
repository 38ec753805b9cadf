"""Fits of FMUs of other makes, each in a process of its own.

``python -m benchmarks.foreign makes [--runs 40] [--first 1] [--only Simulink]``

Each run is `irj fit` on a record with other noise. Printed for each FMU: the runs that end with
exit code 0, the parameters within two of their standard errors of the truth (95 % of them where the
errors are right), the largest such distance, the largest error of a value and the seconds of a run.
The last lines are a bouncing ball: its model exchange has state events and is refused in one line,
its co-simulation finds them itself.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from tests.user_fmus.makes import (
    BOTH,
    BOUNCING,
    MAKES,
    ME,
    bouncing_ball,
    write_case,
    write_record,
)
from tests.user_fmus.records import GRAVITY, ball

NEAR: Final = 2.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--only", default="", help="part of a name")
    given = parser.parse_args(arguments)
    seeds = range(given.first, given.first + given.runs)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for name, case in MAKES.items():
            if given.only in name:
                found = []
                for seed in seeds:
                    joint, run = write_case(case, folder, seed)
                    found.append(_fitted(joint, run, case.truth))
                _said(name, found)
        if given.only in "BouncingBall":
            _bouncing(folder, seeds)
    return 0


def _bouncing(folder: Path, seeds: range) -> None:
    joint, run = folder / "ball.toml", folder / "ball.npz"
    for name, kinds in (("model exchange", ME), ("co-simulation", BOTH)):
        fmu = bouncing_ball(folder, 2, kinds)
        joint.write_text(f'[joint]\n[model]\nfmu = "{fmu.name}"\n{BOUNCING.format(more="")}')
        found = []
        for seed in seeds:
            write_record(ball(seed), run)
            found.append(_fitted(joint, run, {"g": GRAVITY}))
        _said(f"BouncingBall, {name}", found)


def _fitted(
    joint: Path, run: Path, truth: Mapping[str, float]
) -> tuple[int, str, list[float], list[float], float]:
    """Exit code, last line on standard error, distances in standard errors, relative errors,
    seconds."""
    out = joint.with_suffix(".json")
    out.unlink(missing_ok=True)
    code = "import sys; from workbench.cli.main import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "fit", str(run), "--joint", str(joint)]
    begun = time.monotonic()
    ended = subprocess.run([*command, "--json", str(out)], capture_output=True, text=True)
    seconds = time.monotonic() - begun
    said = (ended.stderr.strip().splitlines() or [""])[-1]
    if not out.exists():
        return ended.returncode, said, [], [], seconds
    rows = json.loads(out.read_text())["parameters"]
    off = {n: rows[n]["value"] - x for n, x in truth.items()}
    far = [off[n] / e if (e := rows[n]["stderr"]) else np.inf for n in truth]
    return ended.returncode, said, far, [off[n] / truth[n] for n in truth], seconds


def _said(name: str, found: Sequence[tuple[int, str, list[float], list[float], float]]) -> None:
    codes = [f[0] for f in found]
    ends = ", ".join(f"{codes.count(c)} exit {c}" for c in sorted(set(codes)))
    far, off = (np.abs([x for f in found for x in f[k]]) for k in (2, 3))
    seconds = np.median([f[4] for f in found])
    if len(far):
        print(
            f"{name:<56}{ends:<12}{np.sum(far <= NEAR):>4} of {len(far):<4} within {NEAR:g}; "
            f"largest {far.max():.1f}, {100 * off.max():.2g} %; {seconds:.1f} s",
            flush=True,
        )
    else:
        print(f"{name:<56}{ends:<12}{found[-1][1]}", flush=True)
