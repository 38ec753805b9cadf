"""Run the improve loop on many joints with hidden effects and hold the figures against the
acceptance limits.

``python -m tests.hidden_effect.campaign --seeds 4 --none 40 --pairs 12 --outside 3 --jobs 2 --out
FILE.md``
"""

from __future__ import annotations

import argparse
import importlib
import json
import shlex
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, final

from tests.hidden_effect._tables import RECORDED_SECONDS, Outcome, checks, markdown
from tests.hidden_effect.generator import RECORDS as GENERATED
from tests.hidden_effect.generator import generate_case, names_of
from tests.hidden_effect.hidden import LIBRARY, NEEDS_TORQUE_SENSOR, ONE_SIDED_HIDDEN, OUTSIDE
from tests.hidden_effect.scoring import score

if TYPE_CHECKING:
    from collections.abc import Callable

DEFAULT_ENTRY = "workbench.cli.main:improve_json"
START = 1000
PAIRS: tuple[tuple[str, str], ...] = (
    ("stribeck", "kinematic_error"),
    ("cubic_stiffness", "cyclic_friction"),
    ("load_dependent_friction", "hysteresis"),
    ("quadratic_drag", "backlash"),
    ("thermal_friction", "cubic_stiffness"),
    ("asymmetric_coulomb", "soft_windup"),
    ("motor_constant_error", "kinematic_error"),
    ("lugre", "piecewise_stiffness"),
    ("torque_ripple", "stribeck"),
    ("torque_sensor_gain", "asymmetric_viscous"),
    ("stribeck", "cyclic_torque"),
    ("torque_sensor_offset", "lugre"),
)
TRIPLES: tuple[tuple[str, str, str], ...] = (
    ("torque_ripple", "cubic_stiffness", "stribeck"),
    ("stribeck", "hysteresis", "added_spring"),
    ("motor_constant_error", "kinematic_error", "quadratic_drag"),
    ("thermal_friction", "backlash", "cyclic_torque"),
    ("asymmetric_coulomb", "piecewise_stiffness", "cyclic_friction"),
    ("current_offset", "soft_windup", "lugre"),
    ("cubic_viscous", "cubic_stiffness", "torque_sensor_gain"),
    ("load_dependent_friction", "kinematic_error", "asymmetric_viscous"),
    ("torque_ripple", "backlash", "quadratic_drag"),
    ("stribeck", "soft_windup", "cyclic_torque"),
    ("lugre", "hysteresis", "asymmetric_viscous"),
    ("added_spring", "piecewise_stiffness", "motor_constant_error"),
)
"""One effect of the drive or the sensors, one of the transmission, one of either side."""
RECORDS = {"both": ("", "2"), "first": ("",), "second": ("2",)}
NO_GAIN_WITHOUT_SENSOR = NEEDS_TORQUE_SENSOR | {"motor_constant_error"}


@final
@dataclass(frozen=True)
class Job:
    """One case to make and to run."""

    group: str
    effect: str | tuple[str, ...] | None
    seed: int
    size: float
    dirt: bool
    torque_sensor: bool
    one_sided: bool
    cache: Path
    entry: str
    records: str = "both"
    every: int = 1
    rests: float = 0.0

    @property
    def label(self) -> str:
        """Hidden names joined by +, or none."""
        return "+".join(names_of(self.effect)) or "none"

    @property
    def folder(self) -> Path:
        """Where the case is kept."""
        words = [f"size{self.size:g}"]
        words += ["dirt"] if self.dirt else []
        words += [f"rests{self.rests:g}"] if self.rests else []
        words += ["one_sided"] if self.one_sided else [] if self.torque_sensor else ["no_torque"]
        return self.cache / "-".join(words) / f"{self.label}_{self.seed}"


def load_entry(text: str) -> Callable[[list[Path], list[Path], Path], dict[str, Any]]:
    """Import ``module:function``: ``function(train_paths, held_out_paths, joint_path) -> dict``."""
    module, _, name = text.partition(":")
    function = getattr(importlib.import_module(module), name)
    return cast("Callable[[list[Path], list[Path], Path], dict[str, Any]]", function)


def thinned(folder: Path, every: int) -> Path:
    """A folder with every so many rows of a case's records: what a slower logger would have
    kept.
    """
    made = folder / f"every{every}"
    made.mkdir(exist_ok=True)
    for name in GENERATED:
        head, *rows = (folder / f"{name}.csv").read_text(encoding="utf-8").splitlines()
        (made / f"{name}.csv").write_text(
            "\n".join([head, *rows[::every]]) + "\n", encoding="utf-8"
        )
    return made


def run_job(job: Job) -> Outcome:
    """Make the case if it is not in the cache, run the tool on it, score it; a failure of the
    tool is an outcome.
    """
    folder = job.folder
    if not (folder / "truth.json").exists():
        generate_case(
            job.effect,
            job.seed,
            size=job.size,
            dirt=job.dirt,
            torque_sensor=job.torque_sensor,
            one_sided=job.one_sided,
            folder=folder,
            rests=job.rests,
        )
    given = folder if job.every == 1 else thinned(folder, job.every)
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    stiction = truth["link_referred"]["friction_smoothing_rad_s"] == 0.0
    improve = load_entry(job.entry)
    began = time.perf_counter()
    try:
        train, held = (
            [given / f"{part}{number}.csv" for number in RECORDS[job.records]]
            for part in ("train", "test")
        )
        result = improve(train, held, folder / "joint.toml")
        seconds = time.perf_counter() - began
        (folder / "improve.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        return Outcome(
            job.group,
            job.label,
            job.seed,
            stiction,
            seconds,
            score(truth, result),
            recorded=RECORDED_SECONDS * len(train) / 2,
        )
    except (
        Exception
    ) as error:  # whatever the tool raises is this case's result, and must not end the campaign
        text = f"{type(error).__name__}: {error}".splitlines()[0]
        return Outcome(
            job.group, job.label, job.seed, stiction, time.perf_counter() - began, None, text
        )


def plan_jobs(options: argparse.Namespace, cache: Path) -> list[Job]:
    """The cases that the options ask for."""
    effects = options.effects.split(",") if options.effects else list(LIBRARY)
    unknown = [e for e in effects if e not in LIBRARY]
    if unknown:
        raise SystemExit(
            f"--effects: not in the generator: {', '.join(unknown)}; it has {', '.join(LIBRARY)}"
        )
    torque_sensor = not (options.no_torque_sensor or options.one_sided)
    hidden = (ONE_SIDED_HIDDEN if options.one_sided else frozenset()) | (
        frozenset() if torque_sensor else NO_GAIN_WITHOUT_SENSOR
    )
    seeds = range(options.start, options.start + options.seeds)
    cases: list[tuple[str, str | tuple[str, ...] | None, int]] = [
        ("single", e, s) for e in effects if e not in hidden for s in seeds
    ]
    cases += [("none", None, options.start + s) for s in range(options.none)]
    sums: tuple[tuple[str, tuple[tuple[str, ...], ...], int], ...] = (
        ("pair", PAIRS, options.pairs),
        ("triple", TRIPLES, options.triples),
    )
    cases += [
        (group, chosen[i % len(chosen)], options.start + i // len(chosen))
        for group, chosen, count in sums
        for i in range(count)
        if not hidden & set(chosen[i % len(chosen)])
    ]
    if not options.one_sided:
        cases += [
            ("outside", e, options.start + s) for e in OUTSIDE for s in range(options.outside)
        ]
    return [
        Job(
            group,
            effect,
            seed,
            options.size,
            options.dirt,
            torque_sensor,
            options.one_sided,
            cache,
            options.entry,
            options.records,
            options.every,
            options.rests,
        )
        for group, effect, seed in cases
    ]


def run(
    jobs: list[Job], workers: int, tell: Callable[[str], object] | None = None
) -> list[Outcome]:
    """Run all jobs, in order, in ``workers`` processes (1: in this one)."""
    outcomes: list[Outcome] = []

    def keep(outcome: Outcome) -> None:
        outcomes.append(outcome)
        if tell:
            s = outcome.score
            what = (
                outcome.error
                if s is None
                else f"in set {s.in_set}/{len(s.hidden)}, extra {s.extra}, {s.verdict}"
            )
            tell(
                f"{len(outcomes)}/{len(jobs)} {outcome.label} {outcome.seed}: {what}, "
                f"{outcome.seconds:.1f} s\n"
            )

    if workers <= 1:
        for job in jobs:
            keep(run_job(job))
        return outcomes
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for outcome in pool.map(run_job, jobs):
            keep(outcome)
    return outcomes


def parser() -> argparse.ArgumentParser:
    """Options of the campaign."""
    p = argparse.ArgumentParser(prog="python -m tests.hidden_effect.campaign", description=__doc__)
    p.add_argument(
        "--size", type=float, default=1.0, help="factor on the strength of the hidden effects"
    )
    p.add_argument(
        "--dirt", action="store_true", help="small unmodelled disturbances in every record"
    )
    p.add_argument(
        "--rests",
        type=float,
        default=0.0,
        help="share of the time in which the joint stands still (0.3: three tenths)",
    )
    p.add_argument("--seeds", type=int, default=4, help="cases per effect")
    p.add_argument("--start", type=int, default=START, help="first seed")
    p.add_argument("--effects", help="comma-separated keys (default: all)")
    p.add_argument("--none", type=int, default=40, help="cases with nothing hidden")
    p.add_argument("--pairs", type=int, default=12, help="cases with two hidden effects")
    p.add_argument("--triples", type=int, default=0, help="cases with three hidden effects")
    p.add_argument("--outside", type=int, default=3, help="cases of each kind outside the library")
    p.add_argument("--no-torque-sensor", action="store_true")
    p.add_argument(
        "--one-sided", action="store_true", help="current, motor position and motor velocity only"
    )
    p.add_argument(
        "--records",
        choices=list(RECORDS),
        default="both",
        help="records the tool is given: both pairs, the first (one speed, few reversals) or the "
        "second",
    )
    p.add_argument(
        "--every", type=int, default=1, help="keep one row of so many: 4 makes 125 Hz of 500 Hz"
    )
    p.add_argument("--jobs", type=int, default=1, help="processes")
    p.add_argument("--cache", type=Path, help="folder that keeps the cases (default: temporary)")
    p.add_argument("--entry", default=DEFAULT_ENTRY, help="module:function to run on each case")
    p.add_argument("--out", type=Path, help="Markdown file for the report")
    p.add_argument("--json", type=Path, help="JSON file for the single scores")
    return p


def main(argv: list[str] | None = None) -> int:
    """Run the campaign; exit 1 if a figure falls short of its limit."""
    given = sys.argv[1:] if argv is None else argv
    options = parser().parse_args(given)
    with tempfile.TemporaryDirectory() as spare:
        jobs = plan_jobs(options, options.cache or Path(spare))
        outcomes = run(jobs, options.jobs, sys.stderr.write)
    sensors = not (options.no_torque_sensor or options.one_sided)
    found = checks(
        outcomes,
        size=options.size,
        dirt=options.dirt,
        torque_sensor=sensors,
        one_sided=options.one_sided,
    )
    hide = {"--cache", "--out", "--json"}
    shown = [
        w for i, w in enumerate(given) if w not in hide and (i == 0 or given[i - 1] not in hide)
    ]
    command = shlex.join(["python", "-m", "tests.hidden_effect.campaign", *shown])
    text = markdown("Hidden-effect campaign", command, outcomes, found)
    sys.stdout.write(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")
    if options.json:
        options.json.write_text(
            json.dumps([asdict(o) for o in outcomes], indent=1) + "\n", encoding="utf-8"
        )
    return 0 if all(c.passed is not False for c in found) else 1


if __name__ == "__main__":
    sys.exit(main())
