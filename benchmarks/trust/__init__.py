"""Are the stated intervals and names true?  ``python -m benchmarks.trust --joints 40 --names 12``.

Joints of the independent generator (tests/hidden_effect) with known values.  First part: the true
model is fitted to 48 s of records, and the 95 % intervals of `irj trust` are held against the
truth, by class of parameter, on motions that turn and on one that goes one way.  Second part:
`improve` runs on joints with one hidden effect, and how often a name is right is held against the
chance that was stated for it.  ``--page FILE`` writes both as a page (docs/reliability.md).
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from benchmarks.next_run import record_of
from benchmarks.trust.reliability import Kept, Seen, Stated, brier, page, skill, tenths, wilson
from identification import Joint, improve
from identification.fitting.engine import load_dataset, prepared_model, solve
from identification.fitting.trust import CLASSES, trust
from tests.hidden_effect.generator import DT, KM, SPAN, Case, simulate_case
from tests.hidden_effect.hidden import LIBRARY

FloatArray = npt.NDArray[np.float64]

PLAIN: Final = MappingProxyType(
    {
        "motor_inertia": "JM",
        "link_inertia": "JL",
        "gravity_torque": "TG",
        "stiffness": "K",
        "structural_damping": "C",
        "motor_viscous": "M_B",
        "motor_coulomb": "M_TC",
        "link_viscous": "L_B",
        "link_coulomb": "L_TC",
    }
)
"""Parameters of every joint, by their name in the generator."""
HIDDEN: Final[Mapping[str, tuple[str, Mapping[str, str]]]] = MappingProxyType(
    {
        "stribeck": (
            "stribeck@motor",
            {"motor_stribeck_extra": "M_TS", "motor_stribeck_velocity": "M_VS"},
        ),
        "backlash": ("backlash", {"backlash": "GAP"}),
        "cubic_stiffness": ("cubic_stiffness", {"cubic_stiffness": "K3"}),
        "quadratic_drag": ("quadratic_drag@motor", {"motor_quadratic_drag": "M_B2"}),
        "added_spring": ("added_spring@motor", {"motor_added_spring": "M_KA"}),
    }
)
"""Effects that are put into the fitted model, with their parameters by the generator's names."""
MOTIONS: Final = ("turning", "one way")
"""Triangles and multisines; and two runs at a speed that wanders without a change of sign."""
SLOWEST, FASTEST = 0.15, 1.0
"""Speeds of the latter [rad/s]: dry friction has its full size, the drive is far from its limit."""
SIZES: Final = (1.0, 0.3, 0.15)
"""Sizes of the hidden effects of the second table, in turn: large ones have one name, and nothing
to learn from."""


def joint_of(case: Case, effects: tuple[str, ...] = ()) -> Joint:
    """The joint file of a case."""
    return Joint(
        name="case",
        gear_ratio=case.gear_ratio,
        torque_per_current=case.gear_ratio * KM,
        model_name="hd3",
        effects=("viscous", "coulomb", "gravity", *effects),
    )


def one_way(seed: int) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Positions [rad] and velocities [rad/s] of two runs, forwards and backwards."""
    time = np.arange(round(SPAN / DT)) * DT
    out = {}
    for sign, name in ((1.0, "train"), (-1.0, "train2")):
        rng = np.random.default_rng([seed, int(sign > 0)])
        pace = 2 * np.pi * np.geomspace(0.1, 3.0, 8) * np.exp(rng.uniform(-0.1, 0.1, 8))
        phase, share = rng.uniform(0, 2 * np.pi, 8), pace**-0.3
        wave = share @ np.sin(np.outer(pace, time) + phase[:, None])
        along = (share / pace) @ (
            np.cos(phase)[:, None] - np.cos(np.outer(pace, time) + phase[:, None])
        )
        gain = (FASTEST - SLOWEST) / float(np.ptp(wave))
        middle = SLOWEST - gain * float(wave.min())
        out[name] = sign * (middle * time + gain * along), sign * (middle + gain * wave)
    return out


def intervals(effect: str, seed: int, motion: str, *, dirt: bool, size: float) -> list[Seen]:
    """Fit the true model of one joint and hold every interval against its value."""
    case = simulate_case(
        effect,
        seed,
        size=size,
        dirt=dirt,
        overrides={"CURVE": 1.0},
        records=("train", "train2"),
        references=one_way(seed) if motion == "one way" else None,
    )
    label, names = HIDDEN[effect]
    joint = joint_of(case, (label,))
    records = [record_of(table, name, "same") for name, table in case.measured.items()]
    model = prepared_model(joint, records[0])
    data = load_dataset(records, [], joint, model)
    out = []
    for p in trust(solve(model, data), data).parameters:
        key = {**PLAIN, **names}.get(p.name)
        if key is None or p.low is None or p.high is None or p.stderr is None:
            continue
        true = float(case.parameters[key])
        out.append(
            Seen(p.name, p.kind, motion, p.low <= true <= p.high, (p.value - true) / p.stderr)
        )
    return out


def coverage(given: argparse.Namespace, kept: Kept) -> list[Seen]:
    """First table; its intervals."""
    seen: list[Seen] = []
    for k in range(given.joints):
        effect = list(HIDDEN)[k % len(HIDDEN)]
        small = given.size if k % 3 else 0.4 * given.size
        for motion in MOTIONS:
            of = {
                "effect": effect,
                "seed": given.start + k,
                "motion": motion,
                "dirt": given.dirt,
                "size": small,
            }
            seen += kept.found({"part": "intervals", **of}, Seen, partial(intervals, **of))
    print(f"95 % intervals of {given.joints} joints{' with disturbances' * given.dirt}")
    print("                               motion   intervals  cover  95 % range of it  deviates")
    for kind in CLASSES:
        own = [s for s in seen if s.kind == kind]
        line(kind, "both", own)
        for n in sorted({s.name for s in own}):
            for motion in MOTIONS:
                line(f"  {n}", motion, [s for s in own if s.name == n and s.motion == motion])
    return seen


def line(label: str, motion: str, seen: Sequence[Seen]) -> None:
    """One line of the first table: how many hold the truth; mean and scatter of the error in
    standard errors (0 and 1 in truth)."""
    if not seen:
        return
    inside = sum(s.inside for s in seen)
    low, high = wilson(inside, len(seen))
    off = np.array([s.deviate for s in seen])
    print(
        f"{label:<30} {motion:<8} {len(seen):9d}  {100 * inside / len(seen):4.0f} %  "
        f"{low:3.0f} to {high:3.0f} %       {off.mean():+.2f} +- {off.std():.2f}"
    )


def claimed(effect: str, seed: int, *, dirt: bool, size: float) -> list[Stated]:
    """What `improve` says of one joint with one hidden effect."""
    case = simulate_case(effect, seed, size=size, dirt=dirt)
    records = [record_of(table, name, "same") for name, table in case.measured.items()]
    found = improve(records[:2], joint_of(case), records[2:])
    return [
        Stated(p, name == effect, name == claim.effects[0], len(claim.effects) == 1)
        for claim in found.claims
        if not claim.partial
        for name, p in claim.confidence.items()
    ]


def names(given: argparse.Namespace, kept: Kept) -> tuple[list[Stated], int]:
    """Second table; its names, and the number of joints without one."""
    stated: list[Stated] = []
    missed = 0
    effects = list(LIBRARY)
    for k in range(given.names):
        # a stride without a common factor with the number of effects: a few joints see all kinds
        effect = effects[(7 * k) % len(effects)]
        size = given.size * SIZES[k % len(SIZES)]
        of = {"effect": effect, "seed": given.start + 500 + k, "dirt": given.dirt, "size": size}
        found = kept.found({"part": "names", **of}, Stated, partial(claimed, **of))
        missed += not found
        stated += found
    print(
        f"names over {given.names} joints with one hidden effect of "
        f"{', '.join(f'{given.size * s:g}' for s in SIZES)} times its size"
        f"{', with disturbances' * given.dirt}; {missed} without a name"
    )
    print("chance stated   names  mean stated  right  95 % range of it")
    for low, own in tenths(stated):
        right = sum(s.right for s in own)
        span = wilson(right, len(own))
        mean = 100 * np.mean([s.chance for s in own])
        print(
            f"{low:3d} to {low + 10:3d} %   {len(own):5d}       "
            f"{mean:5.1f} %  {100 * right / len(own):3.0f} %  {span[0]:.0f} to {span[1]:.0f} %"
        )
    first = [s for s in stated if s.first]
    alone = [s for s in stated if s.alone]
    print(f"Brier score: all names {brier(stated):.3f}, first names {brier(first):.3f}")
    print(f"Brier skill: all names {skill(stated):.0f} %, first names {skill(first):.0f} %")
    print(
        f"one name: {sum(s.right for s in alone)} of {len(alone)} right, of {len(first)} claims; "
        f"claims that hold the truth: {sum(s.right for s in stated)}"
    )
    return stated, missed


def conditions(given: argparse.Namespace, missed: int) -> str:
    """What the page was made from, in sentences."""
    sizes = ", ".join(f"{given.size * s:g}" for s in SIZES)
    said = [
        "Joints of the independent generator (`tests/hidden_effect`), first seed "
        f"{given.start}, {'with' if given.dirt else 'without'} small disturbances."
    ]
    if given.names:
        said.append(
            f"Names: `improve` on {given.names} joints with one hidden effect of {sizes} times its "
            f"size; {missed} of them got no name."
        )
    if given.joints:
        said.append(
            f"Intervals: the true model fitted to {given.joints} joints, on motions that turn and "
            "on one that goes one way."
        )
    return " ".join(said)


def main(argv: Sequence[str] | None = None) -> int:
    """Print both tables, and write them as a page."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--joints", type=int, default=40, help="joints of the first table")
    parser.add_argument("--names", type=int, default=12, help="joints of the second table")
    parser.add_argument("--start", type=int, default=9000, help="first seed")
    parser.add_argument("--size", type=float, default=1.0, help="factor on the effects")
    parser.add_argument("--dirt", action="store_true", help="small disturbances in every record")
    parser.add_argument("--keep", type=Path, help="file of outcomes of this version: not run again")
    parser.add_argument("--page", type=Path, help="file to write the tables to, as Markdown")
    words = sys.argv[1:] if argv is None else list(argv)
    given = parser.parse_args(words)
    kept = Kept(given.keep)
    seen = coverage(given, kept) if given.joints else []
    stated, missed = names(given, kept) if given.names else ([], 0)
    if given.page is not None:
        command = shlex.join(["python", "-m", "benchmarks.trust", *_without(words, "--keep")])
        given.page.write_text(
            page(command, conditions(given, missed), seen, stated), encoding="utf-8"
        )
    return 0


def _without(words: Sequence[str], option: str) -> list[str]:
    """Words of a command line but those of an option with one value: what is kept where does not
    change the figures."""
    at = [k for k, w in enumerate(words) if w == option]
    return [w for k, w in enumerate(words) if k not in at and k - 1 not in at]
