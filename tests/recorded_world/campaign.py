"""Run the tool on joints of the recorded world and print, per condition, what its answers are
worth.

``python -m tests.recorded_world.campaign --joints 40 --start 0 --sensors all encoders --json OUT``

OUT takes one line per answer; a campaign that is started again with the same OUT goes on where it
stopped. Seeds from 100000 on are held back: nothing is tuned on them, and their tables are printed
apart.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import signal
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, final

from tests.recorded_world import hidden, joints, motions, sensors
from tests.recorded_world.scoring import Answer, refused, score, tables
from tests.recorded_world.world import (
    KINDS,
    SECONDS,
    TROUBLES,
    asked,
    held_back,
    make_case,
    truth,
    write_case,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tests.recorded_world.world import Case

ENTRY = "workbench.cli.main:improve_json"


@final
@dataclass(frozen=True)
class Job:
    """One joint seen by one set of sensors; None where the seed draws."""

    seed: int
    sensors: str
    entry: str = ENTRY
    limit: float = 0.0
    seconds: float = SECONDS
    without: tuple[str, ...] = ()
    kind: str | None = None
    names: tuple[str, ...] | None = None
    size: float | None = None
    make: str | None = None
    motion: str | None = None
    keep: Path | None = None

    def case(self) -> Case:
        """The joint and its recordings."""
        return make_case(
            self.seed,
            without=self.without,
            seconds=self.seconds,
            kind=self.kind,
            names=self.names,
            size=self.size,
            make=self.make,
            motion=self.motion,
        )

    @property
    def command(self) -> str:
        """A line that runs this case alone."""
        words = [
            "python -m tests.recorded_world.campaign --joints 1",
            f"--start {self.seed}",
            f"--sensors {self.sensors}",
        ]
        for option in ("kind", "size", "make", "motion"):
            value = getattr(self, option)
            words += [f"--{option} {value}"] if value is not None else []
        words += [f"--names {' '.join(self.names)}"] if self.names is not None else []
        if self.without == TROUBLES:
            words.append("--without everything")
        elif self.without:
            left = [t for t in TROUBLES if t not in self.without]
            few = len(left) < len(self.without)
            words.append(
                f"--only {' '.join(left)}" if few else f"--without {' '.join(self.without)}"
            )
        words += [f"--seconds {self.seconds:g}"] if self.seconds != SECONDS else []
        return " ".join(words)


def load_entry(text: str) -> Callable[[list[Path], list[Path], Path], dict[str, Any]]:
    """Import ``module:function``: ``function(train_paths, held_out_paths, joint_path) -> dict``."""
    module, _, name = text.partition(":")
    return cast(
        "Callable[[list[Path], list[Path], Path], dict[str, Any]]",
        getattr(importlib.import_module(module), name),
    )


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeoutError after so many seconds of processor time (0: never; nor where the system
    has no such timer).

    Processor time, so that a busy machine refuses nothing.
    """
    if not seconds or not hasattr(signal, "setitimer"):
        yield
        return

    def stop(*_: object) -> None:
        raise TimeoutError(f"no answer within {seconds:g} s of processor time")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def run_job(job: Job) -> Answer | None:
    """Make the case, ask the tool, score it; None where these sensors are not asked to show
    what is hidden.
    """
    case = job.case()
    if not asked(case, job.sensors):
        return None
    improve, said = load_entry(job.entry), truth(case, job.sensors)
    with contextlib.ExitStack() as stack:
        top = job.keep or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder = write_case(case, top / f"{job.seed}-{job.sensors}", job.sensors)
        began = time.process_time()
        try:
            with time_limit(job.limit):
                result = improve(
                    [folder / "train.csv"], [folder / "test.csv"], folder / "joint.toml"
                )
            answer = score(said, result)
            if job.keep:
                (folder / "improve.json").write_text(
                    json.dumps(result, indent=1) + "\n", encoding="utf-8"
                )
        except (
            Exception
        ) as error:  # whatever the tool raises is this case's result, and must not end the campaign
            line = (str(error).splitlines() or [""])[0].replace(str(folder), "")
            answer = refused(said, f"{type(error).__name__}: {line}")
        return replace(answer, seconds=time.process_time() - began)


def load(path: Path) -> list[Answer]:
    """Answers of a file, one line each."""
    if not path.exists():
        return []
    rows = [json.loads(x) for x in path.read_text(encoding="utf-8").splitlines() if x.strip()]
    known = [r for r in rows if r.get("make")]
    return [
        _answer({k: tuple(v) if isinstance(v, list) else v for k, v in r.items()}) for r in known
    ]


def _answer(fields: dict[str, Any]) -> Answer:
    return Answer(**fields)


def _done(path: Path | None) -> set[tuple[int, str]]:
    if path is None or not path.exists():
        return set()
    rows = [json.loads(x) for x in path.read_text(encoding="utf-8").splitlines() if x.strip()]
    return {(int(r["seed"]), str(r["sensors"])) for r in rows}


def told(answer: Answer) -> str:
    """One line for the progress."""
    where = f"{answer.seed} {answer.sensors} {answer.make} {answer.motion} {answer.rate:g} Hz"
    what = f"{'+'.join(answer.hidden) or 'nothing'} x {answer.size:g}"
    if answer.error:
        return f"{where}: {what}: REFUSED {answer.error} ({answer.seconds:.0f} s)"
    claims = f"found {','.join(answer.found) or '-'}; wrong {', '.join(answer.wrong) or '-'}"
    rest = (
        f"{answer.verdict}, {answer.held_out:.1f} %, ratio {answer.ratio:.1f}, "
        f"{answer.seconds:.0f} s"
    )
    return f"{where}: {what}: {claims}; {rest}{'' if answer.all_right else '  <- not right'}"


def run(jobs: list[Job], workers: int, out: Path | None, budget: float = 0.0) -> list[Answer]:
    """Run what is not yet in ``out``; each answer is written as it comes. ``budget`` [s] stops
    before a new case.
    """
    answers = load(out) if out else []
    done = _done(out)
    left = [j for j in jobs if (j.seed, j.sensors) not in done]
    began = time.perf_counter()

    def keep(job: Job, answer: Answer | None) -> None:
        line = {"seed": job.seed, "sensors": job.sensors} if answer is None else asdict(answer)
        if out:
            with out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
        if answer is not None:
            answers.append(answer)
            sys.stderr.write(told(answer) + "\n")

    if workers <= 1:
        for job in left:
            if budget and time.perf_counter() - began > budget:
                sys.stderr.write("time is up; start again with the same --json to go on\n")
                break
            keep(job, run_job(job))
        return answers
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for job, answer in zip(left, pool.map(run_job, left), strict=True):
            keep(job, answer)
    return answers


def parser() -> argparse.ArgumentParser:
    """Options of the campaign."""
    p = argparse.ArgumentParser(prog="python -m tests.recorded_world.campaign", description=__doc__)
    p.add_argument("--joints", type=int, default=40, help="how many seeds")
    p.add_argument("--start", type=int, default=0, help="first seed (100000 and more: held back)")
    p.add_argument(
        "--seeds",
        nargs="+",
        type=int,
        help="these seeds, in this order, instead of joints and start",
    )
    p.add_argument("--sensors", nargs="+", choices=list(sensors.SETS), default=list(sensors.SETS))
    p.add_argument("--seconds", type=float, default=SECONDS, help="length of each record")
    which = p.add_mutually_exclusive_group()
    which.add_argument(
        "--without",
        nargs="+",
        choices=(*TROUBLES, "everything"),
        default=[],
        help="troubles to switch off",
    )
    which.add_argument(
        "--only", nargs="+", choices=TROUBLES, help="switch off all troubles but these"
    )
    p.add_argument("--kind", choices=KINDS, help="instead of a drawn one")
    p.add_argument(
        "--names",
        nargs="*",
        choices=[*hidden.LIBRARY, *hidden.OUTSIDE],
        help="hide these (none: nothing)",
    )
    p.add_argument("--size", type=float, help="strength instead of a drawn one (1, 0.3, 0.1)")
    p.add_argument("--make", choices=list(joints.MAKES))
    p.add_argument("--motion", choices=list(motions.MOTIONS))
    p.add_argument("--jobs", type=int, default=1, help="processes")
    p.add_argument(
        "--limit", type=float, default=180.0, help="processor seconds for one answer (0: no limit)"
    )
    p.add_argument(
        "--budget",
        type=float,
        default=0.0,
        help="stop before a new case after so many seconds (one process)",
    )
    p.add_argument("--entry", default=ENTRY, help="module:function to ask")
    p.add_argument("--keep", type=Path, help="folder that keeps the cases and answers")
    p.add_argument(
        "--json", type=Path, help="one line per answer; a campaign goes on where this file ends"
    )
    return p


def plan(options: argparse.Namespace) -> list[Job]:
    """The jobs that the options ask for: every seed with every set of sensors."""
    names = options.names
    kind = options.kind
    without = TROUBLES if "everything" in options.without else tuple(options.without)
    if options.only:
        without = tuple(t for t in TROUBLES if t not in options.only)
    if names is not None and kind is None:
        outside = any(n in hidden.OUTSIDE for n in names)
        kind = "outside" if outside else KINDS[min(len(names), 3)]
    return [
        Job(
            seed,
            given,
            options.entry,
            options.limit,
            options.seconds,
            without,
            kind=kind,
            names=None if names is None else tuple(names),
            size=options.size,
            make=options.make,
            motion=options.motion,
            keep=options.keep,
        )
        for seed in options.seeds or range(options.start, options.start + options.joints)
        for given in options.sensors
    ]


def main(argv: list[str] | None = None) -> int:
    """Run the campaign and print its tables."""
    options = parser().parse_args(argv)
    answers = run(plan(options), options.jobs, options.json, options.budget)
    for title, part in (
        ("Seeds to tune on", [a for a in answers if not held_back(a.seed)]),
        ("Held-back seeds", [a for a in answers if held_back(a.seed)]),
    ):
        if part:
            sys.stdout.write(f"## {title}\n\n{tables(part)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
