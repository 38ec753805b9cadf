"""Lines at orders that the tool is not told: 20 joints with one, and the same joints without.

    python -m tests.hidden_effect.lines [--joints 20] [--out FILE.md]

The joints come from the independent generator with nothing hidden. A torque ripple (in the motor
current) or a kinematic error (in the link position) is put in at a random order of 0.5 to 9 per
motor turn, sized so that taking it out again lowers the residual of its balance at the shortest
kernel by 2 to 5 %.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from identification import Record, load_joint, read
from identification.data.joint_file import Joint
from identification.diagnosis.lines import Line, find_lines
from identification.fitting.assess import assess
from identification.fitting.engine import Dataset, load_dataset, prepared_model, solve
from tests.hidden_effect.generator import generate_case

LIMIT = 90.0


@dataclass(frozen=True)
class Case:
    """One joint: the line that was put in, and the lines that were found."""

    balance: str
    order: float
    drop: float
    lines: tuple[Line, ...]
    empty: tuple[Line, ...]

    @property
    def found(self) -> bool:
        """A line of the right balance within its own tolerance (2 pi over the stroke) of the
        order.
        """
        return any(
            abs(x.order - self.order) <= x.tolerance and x.balance == self.balance
            for x in self.lines
        )


def kernels(joint: Joint, train: Sequence[Record], held: Sequence[Record]) -> list[Dataset]:
    """The records at the kernels at which the loop looks for lines."""
    model = prepared_model(joint, train[0])
    shortest = max(8 * train[0].dt, 0.012)
    return [load_dataset(train, held, joint, model, kernel=k) for k in (shortest, 0.03, None)]


def lines_of(
    joint: Joint, train: Sequence[Record], held: Sequence[Record]
) -> tuple[list[Line], dict[str, float]]:
    """Lines, and the RMS of each balance at the shortest kernel."""
    data = kernels(joint, train, held)
    solution = solve(prepared_model(joint, train[0]), data[-1])
    error = assess(solution.model, data[0], data[0].train, solution.values)
    return find_lines(solution, data[-1], train, held), {
        b: e.rms for b, e in error.balances.items()
    }


def case(seed: int, folder: Path) -> Case:
    """One joint without and with a line."""
    rng = np.random.default_rng(1000 + seed)
    place = generate_case(None, seed, folder=folder / f"none_{seed}")
    joint = load_joint(place / "joint.toml")
    train, held = ([read(place / f"{n}{i}.csv") for i in ("", "2")] for n in ("train", "test"))
    empty, rms = lines_of(joint, train, held)
    balance = ("motor", "transmission")[seed % 2]
    order, drop, phase = rng.uniform(0.5, 9.0), rng.uniform(0.02, 0.05), rng.uniform(0, 2 * np.pi)
    # a line of amplitude A adds A^2 / 2 to the power: taking it out lowers the RMS by `drop`
    amplitude = rms[balance] * np.sqrt(2 * (1 / (1 - drop) ** 2 - 1))

    def with_line(record: Record) -> Record:
        wave = amplitude * np.sin(order * record["motor_position"] + phase)
        if balance == "motor":
            return record.with_channel(
                "motor_current", record["motor_current"] + wave / (joint.torque_per_current or 1.0)
            )
        return record.with_channel("link_position", record["link_position"] + wave / STIFFNESS)

    lines, _ = lines_of(joint, [with_line(r) for r in train], [with_line(r) for r in held])
    return Case(balance, order, 100 * drop, tuple(lines), tuple(empty))


STIFFNESS = 2e4
"""Of the generator's joints, about [N.m/rad]."""


def report(cases: Sequence[Case], command: str) -> str:
    """The table and its two figures."""
    hit, false = 100 * np.mean([c.found for c in cases]), sum(len(c.empty) for c in cases)
    said = [
        ", ".join(f"{x.order:.3f} ± {x.tolerance:.3f} ({x.balance})" for x in c.lines) or "-"
        for c in cases
    ]
    rows = [
        f"| {c.balance} | {c.order:.3f} | {c.drop:.1f} | {s} | {'yes' if c.found else '**no**'} |"
        for c, s in zip(cases, said, strict=True)
    ]
    return "\n".join(
        [
            f"Printed by `{command}`.",
            "",
            f"Right order and balance: {hit:.0f} % of {len(cases)} joints (limit {LIMIT:.0f} %). "
            f"Lines on the same joints without one: {false} (limit 0).",
            "",
            "| balance | order per motor turn | drop of the RMS, % | found | right |",
            "|---|---|---|---|---|",
            *rows,
            "",
        ]
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the joints and print the table; 1 where a limit is not met."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--joints", type=int, default=20)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        cases = [case(seed, Path(folder)) for seed in range(options.joints)]
    text = report(cases, f"python -m tests.hidden_effect.lines --joints {options.joints}")
    sys.stdout.write(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")
    return (
        0
        if np.mean([c.found for c in cases]) >= LIMIT / 100 and not any(c.empty for c in cases)
        else 1
    )


if __name__ == "__main__":
    sys.exit(main())
