"""What lost samples and bad stamps do to an answer: a table over kinds of damage.

``python -m tests.stamps_bench --joints 4``
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from identification import Joint, Record, improve, load_joint, read
from identification.data.check.checks import gate
from tests.hidden_effect.generator import generate_case

EFFECTS = ("stribeck", None, "kinematic_error", "load_dependent_friction")
"""Hidden in the joints, in turn."""
RECORDS = ("train", "train2", "test", "test2")


def kept(record: Record, rows: npt.NDArray[np.int64], stamps: npt.NDArray[np.float64]) -> Record:
    """What a logger would have written: some rows, with other stamps."""
    return Record.from_channels(
        stamps, {c: v[rows] for c, v in record.channels.items()}, name=record.name
    )


def lost(share: float, burst: int = 1) -> Callable[[Record, int], Record]:
    """Frames that never arrived, alone or `burst` at a time."""

    def damage(record: Record, seed: int) -> Record:
        starts = np.random.default_rng(seed).random(len(record)) < share / burst
        gone = np.convolve(starts, np.ones(burst), "full")[: len(record)] > 0
        gone[[0, -1]] = False
        rows = np.flatnonzero(~gone)
        return kept(record, rows, record.time[rows])

    return damage


def late(share: float) -> Callable[[Record, int], Record]:
    """Samples are even, their stamps are not: off by up to a share of the step either way."""

    def damage(record: Record, seed: int) -> Record:
        off = np.random.default_rng(seed).uniform(-share, share, len(record)) * record.dt
        return kept(record, np.arange(len(record)), np.sort(record.time + off))

    return damage


def queued(mean: float) -> Callable[[Record, int], Record]:
    """Stamps are late by an exponential time, in steps, and never overtake each other."""

    def damage(record: Record, seed: int) -> Record:
        off = np.random.default_rng(seed).exponential(mean, len(record)) * record.dt
        return kept(record, np.arange(len(record)), np.maximum.accumulate(record.time + off))

    return damage


def repeated(share: float) -> Callable[[Record, int], Record]:
    """Stamps that repeat the one before."""

    def damage(record: Record, seed: int) -> Record:
        stamps = record.time.copy()
        rows = np.flatnonzero(np.random.default_rng(seed).random(len(record)) < share)
        rows = rows[rows > 0]
        stamps[rows] = record.time[rows - 1]
        return kept(record, np.arange(len(record)), stamps)

    return damage


def twice(share: float) -> Callable[[Record, int], Record]:
    """Frames written twice."""

    def damage(record: Record, seed: int) -> Record:
        again = np.flatnonzero(np.random.default_rng(seed).random(len(record)) < share)
        rows = np.sort(np.concatenate([np.arange(len(record)), again]))
        return kept(record, rows, record.time[rows])

    return damage


DAMAGES: dict[str, Callable[[Record, int], Record]] = {
    "none": lambda record, seed: record,
    **{f"lost {100 * s:g} %": lost(s) for s in (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)},
    "lost 5 % in bursts of 4": lost(0.05, 4),
    **{f"stamps off by {100 * s:g} %": late(s) for s in (0.05, 0.3)},
    "stamps late by 30 %": queued(0.3),
    **{f"stamps repeated {100 * s:g} %": repeated(s) for s in (0.05, 0.2)},
    "frames twice 10 %": twice(0.1),
}


def answer(
    records: dict[str, Record], joint: Joint
) -> tuple[str, tuple[str, ...], float, float, list[str]]:
    """Verdict, claimed names, final held-out error [%], inertia of the link and what the gate
    warns of.
    """
    checked, warned = {}, []
    for name, record in records.items():
        checked[name], findings = gate(
            record, joint.gear_ratio, torque_per_current=joint.torque_per_current
        )
        warned += [f.code for f in findings if f.severity == "warn"]
    held = [checked[n] for n in records if n.startswith("test")]
    found = improve([checked[n] for n in records if n.startswith("train")], joint, held)
    last = found.steps[-1]
    names = tuple(c.effects[0] for c in found.claims)
    return (
        found.verdict,
        names,
        last.held_out.relative_error_percent,
        last.solution.values["link_inertia"],
        warned,
    )


def main(argv: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--joints", type=int, default=2)
    parser.add_argument("--start", type=int, default=9300)
    parser.add_argument("--damages", help="comma-separated (default: all)")
    options = parser.parse_args(argv)
    chosen = options.damages.split(",") if options.damages else list(DAMAGES)
    write = sys.stdout.write
    write(
        "| joint | damage | verdict | named | held-out error % | link inertia off by % | warned "
        "| seconds |\n|---|---|---|---|---|---|---|---|\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.joints):
            effect = EFFECTS[number % len(EFFECTS)]
            case = generate_case(effect, options.start + number, folder=Path(folder) / str(number))
            joint = load_joint(case / "joint.toml")
            whole = {n: read(case / f"{n}.csv") for n in RECORDS}
            whole_inertia = None
            for name in chosen:
                began = time.perf_counter()
                damaged = {
                    n: DAMAGES[name](r, 17 * i + number) for i, (n, r) in enumerate(whole.items())
                }
                try:
                    verdict, names, error, inertia, warned = answer(damaged, joint)
                except Exception as problem:  # a refusal is a row of the table
                    write(
                        f"| {effect} {options.start + number} | {name} | "
                        f"{type(problem).__name__}: {str(problem)[:80]} | | | | | |\n"
                    )
                    continue
                whole_inertia = inertia if whole_inertia is None else whole_inertia
                off = 100 * (inertia / whole_inertia - 1)
                write(
                    f"| {effect} {options.start + number} | {name} | {verdict} | "
                    f"{', '.join(names)} | {error:.3f} | {off:.3f} "
                    f"| {', '.join(warned)} | {time.perf_counter() - began:.1f} |\n"
                )
                sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
