"""Studies that fit: the same task over many joints and records, from a file to a table.

A study file with ``task = "fit"``, ``"improve"`` or ``"explore"`` names joints with their records.
Every joint, or with ``each = true`` every record of it, is a job of its own. Files travel with the
jobs, so that the workers of a cluster need no common disk; a finished job is kept and not done
again.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

from casadi_models import EFFECTS
from identification import __version__
from identification.data.plain_text import from_toml
from identification.data.schema import refuse_unknown
from identification.errors import InputError
from identification.scratch import deaf_children
from irj_fmu.batch.checks import names, table
from irj_fmu.batch.fit_worker import Answer, Parcel, answered
from irj_fmu.batch.study_schema import FIT_JOINT, FIT_STUDY
from irj_fmu.batch.worker import enter
from irj_fmu.command_line import finite, replace_file
from irj_fmu.imported.file_schema import fmu_of

SUMMARY: Final = "summary.csv"
PARAMETERS: Final = "parameters.csv"
DIED: Final = "the process that did this job died, each time it was tried"

Progress = Callable[[int, int], None]


@final
@dataclass(frozen=True)
class Job:
    """One joint with the records of one answer.

    Attributes
    ----------
    name : str
    joint : Path
    records, held_out : tuple of Path
    fmu : Path or None
        The FMU that the joint file names as its model.
    """

    name: str
    joint: Path
    records: tuple[Path, ...]
    held_out: tuple[Path, ...] = ()
    fmu: Path | None = None


@final
@dataclass(frozen=True)
class FitStudy:
    """A study file that fits.

    Attributes
    ----------
    source : Path
    name : str
    task : {"fit", "improve", "explore"}
    jobs : tuple of Job
    """

    source: Path
    name: str
    task: str
    jobs: tuple[Job, ...]

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Every file that it reads."""
        files = (
            p
            for j in self.jobs
            for p in (j.joint, *([] if j.fmu is None else [j.fmu]), *j.records, *j.held_out)
        )
        return tuple(dict.fromkeys((self.source, *files)))


@final
@dataclass(frozen=True)
class FitResult:
    """What a study that fits gave.

    Attributes
    ----------
    jobs : tuple of Job
    answers : tuple of Answer
        One per job, failed ones included.
    there : int
        Jobs that were there already from an earlier start.
    files : tuple of Path
        Tables, results and joint files that were written.
    """

    jobs: tuple[Job, ...]
    answers: tuple[Answer, ...]
    there: int
    files: tuple[Path, ...]

    @property
    def failed(self) -> tuple[tuple[Job, Answer], ...]:
        """The jobs without a result."""
        pairs = zip(self.jobs, self.answers, strict=True)
        return tuple((j, a) for j, a in pairs if a.reason)


def is_fit_study(path: Path) -> bool:
    """Whether a study file names a task; what cannot be read is left to its own reader."""
    try:
        study = from_toml(path.read_text(encoding="utf-8-sig"), str(path)).get("study")
    except (OSError, ValueError):
        return False
    return isinstance(study, Mapping) and "task" in study


def load_fit_study(path: str | Path) -> FitStudy:
    """Read a study file that fits; paths in it are relative to its folder.

    Raises
    ------
    InputError
        One line: what is wrong, where, and what to write instead.
    """
    source = Path(path)
    where = str(source)
    data = from_toml(source.read_text(encoding="utf-8-sig"), where)
    refuse_unknown(data, ("study", "joint"), f"{where}: a study with a task")
    study = table(data, "study", where)
    given = FIT_STUDY.read(study, f"{where}: [study]")
    entries = data.get("joint")
    if not isinstance(entries, list) or not entries:
        raise InputError(
            f'{where}: no joint; write [[joint]] and below it joint = "..." and records = ["..."]'
        )
    jobs = [job for i, entry in enumerate(entries, 1) for job in _jobs(entry, i, source)]
    twice = {j.name for j in jobs if sum(j.name == other.name for other in jobs) > 1}
    if twice:
        raise InputError(
            f"{where}: two joints are called {min(twice)!r}; give each a name of its own"
        )
    return FitStudy(
        source, " ".join((given["name"] or source.stem).split()), given["task"], tuple(jobs)
    )


def _jobs(entry: Any, number: int, source: Path) -> Iterator[Job]:
    where = f"{source}: [[joint]] {number}"
    if not isinstance(entry, Mapping):
        raise InputError(f"{where}: must be a table; write [[joint]] on a line of its own")
    given = FIT_JOINT.read(entry, where)
    file = given["joint"]
    if not isinstance(file, str) or not (source.parent / file).is_file():
        raise InputError(f"{where}: joint = {file!r}; give the path of a joint file")
    records = _files(entry, "records", where, source.parent)
    if not records:
        raise InputError(f'{where}: no records; write records = ["run1.csv"]')
    held = _files(entry, "held_out", where, source.parent)
    both = sorted({str(p) for p in records} & {str(p) for p in held})
    if both:
        raise InputError(
            f"{where}: {both[0]} is among records and held_out; a record can have one role only"
        )
    name = given["name"] or Path(file).stem
    joint = source.parent / file
    fmu = fmu_of(joint)
    if fmu is not None and not fmu.is_file():
        raise InputError(
            f"{where}: {joint}: [model] fmu: there is no file {fmu}; give its path, relative to "
            "the joint file"
        )
    if not given["each"]:
        yield Job(name, joint, records, held, fmu)
        return
    for record in records:
        yield Job(f"{name} {record.stem}", joint, (record,), held, fmu)


def _files(entry: Mapping[str, Any], key: str, where: str, folder: Path) -> tuple[Path, ...]:
    """Records of a list; a pattern stands for all files it fits, in the order of their names."""
    found: list[Path] = []
    for name in names(entry, key, where):
        place = folder / name
        if any(sign in name for sign in "*?["):
            base = Path(place.anchor or ".")
            fits = sorted(base.glob(str(place.relative_to(base) if place.anchor else place)))
            if not fits:
                raise InputError(f"{where}: {key}: nothing fits {name!r}")
            found += fits
        elif not place.is_file():
            raise InputError(
                f"{where}: {key}: there is no {name!r}; paths are relative to the study file"
            )
        else:
            found.append(place)
    return tuple(dict.fromkeys(found))


def parcel_of(study: FitStudy, job: Job) -> Parcel:
    """A job with the content of its files, for a worker that does not see them."""
    own = tuple((str(f.path.name), f.code) for f in EFFECTS.files)

    def content(paths: Sequence[Path]) -> tuple[tuple[str, bytes], ...]:
        return tuple((p.name, p.read_bytes()) for p in paths)

    return Parcel(
        study.task,
        job.name,
        joint=(job.joint.name, job.joint.read_bytes()),
        records=content(job.records),
        held_out=content(job.held_out),
        own_effects=own,
        fmu=None if job.fmu is None else (str(job.fmu.resolve()), job.fmu.read_bytes()),
    )


def fingerprint(parcel: Parcel) -> str:
    """Of all that an answer depends on: task, files, version."""
    found = hashlib.sha256(f"{__version__} {parcel.task} {parcel.name}".encode())
    files = (
        parcel.joint,
        *parcel.records,
        ("", b"held out"),
        *parcel.held_out,
        *parcel.own_effects,
        *([] if parcel.fmu is None else [parcel.fmu]),
    )
    for name, content in files:
        found.update(f"\n{name} {len(content)}\n".encode())
        found.update(content)
    return found.hexdigest()


def run_fits(
    study: FitStudy | str | Path,
    *,
    out: Path,
    executor: Executor | None = None,
    jobs: int | None = None,
    fresh: bool = False,
    progress: Progress | None = None,
) -> FitResult:
    """Do every job of a study that fits, and write its tables.

    Parameters
    ----------
    study : FitStudy or path
    out : Path
        Folder of the results; a study that is started again there goes on where it stopped.
    executor : Executor, optional
        Left open, as that of a Dask client. By default a pool of processes, in which a job that
        ends its process costs itself alone.
    jobs : int, optional
        Jobs under way at once; by default the number of processors.
    fresh : bool
        Throw away what an earlier start has left.
    progress : callable, optional
        Called with the jobs done and all jobs.

    Raises
    ------
    InputError
        A study, or a folder, that cannot be used.
    """
    whole = study if isinstance(study, FitStudy) else load_fit_study(study)
    kept = out / "jobs"
    try:
        kept.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{out}: cannot write there ({error.strerror or error}); choose a writable folder "
            "with --out"
        ) from None
    answers: dict[int, Answer] = {}
    waiting: list[int] = []
    for number, job in enumerate(whole.jobs):
        file = kept / f"{fingerprint(parcel_of(whole, job))}.json"
        found = None if fresh else _kept(file)
        if found is None:
            waiting.append(number)
        else:
            answers[number] = found
    there = len(answers)

    def done(number: int, answer: Answer) -> None:
        answers[number] = answer
        parcel = parcel_of(whole, whole.jobs[number])
        if not answer.reason:  # what failed is tried again
            _write_json(kept / f"{fingerprint(parcel)}.json", answer.as_json())
        if progress is not None:
            progress(len(answers), len(whole.jobs))

    if progress is not None and there:
        progress(there, len(whole.jobs))
    width = max(1, min(jobs or os.cpu_count() or 1, max(len(waiting), 1)))
    _Crew(whole, executor, done).go(waiting, width)
    ordered = tuple(answers[k] for k in range(len(whole.jobs)))
    return FitResult(whole.jobs, ordered, there, _written(whole, ordered, out))


def _kept(file: Path) -> Answer | None:
    """An answer of an earlier start; None where there is none, or a damaged one."""
    try:
        return Answer(**json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


@final
class _Crew:
    """Keeps some jobs under way, and takes those apart that were when a process died."""

    def __init__(
        self, study: FitStudy, executor: Executor | None, done: Callable[[int, Answer], None]
    ) -> None:
        self.study, self.executor, self.done = study, executor, done

    def go(self, waiting: Sequence[int], width: int) -> None:
        """Do all jobs that wait."""
        suspects = self._pool(list(waiting), width)
        while suspects:
            number = suspects.pop(0)
            for left in self._pool([number], 1):
                self.done(left, Answer(reason=DIED))

    def _pool(self, waiting: list[int], width: int) -> list[int]:
        """Do jobs; returns those that had no answer when a process of the own pool died."""
        if not waiting:
            return []
        pool = self.executor or ProcessPoolExecutor(
            width, mp_context=multiprocessing.get_context("spawn"), initializer=enter
        )
        before = set(multiprocessing.active_children())
        under_way: dict[Future[Answer], int] = {}
        try:
            while waiting or under_way:
                while waiting and len(under_way) < width:
                    number = waiting.pop(0)
                    parcel = parcel_of(self.study, self.study.jobs[number])
                    with deaf_children():
                        under_way[pool.submit(answered, parcel)] = number
                for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                    error = future.exception()
                    if isinstance(error, BrokenExecutor) and self.executor is None:
                        raise error
                    number = under_way.pop(future)
                    failed = f"the worker failed: {type(error).__name__}: {error}"
                    self.done(number, future.result() if error is None else Answer(reason=failed))
        except BrokenExecutor:
            return [*under_way.values(), *waiting]
        except (KeyboardInterrupt, SystemExit):
            if self.executor is None:
                for process in set(multiprocessing.active_children()) - before:
                    process.terminate()
            raise
        finally:
            for future in under_way:
                future.cancel()
            if self.executor is None:
                pool.shutdown(wait=True, cancel_futures=True)
        return []


# --- what is written ------------------------------------------------------------------------------


def _written(study: FitStudy, answers: Sequence[Answer], out: Path) -> tuple[Path, ...]:
    """Tables over all jobs, and of each job its whole result and its joint file."""
    rows = [
        {
            "job": k,
            "joint": job.name,
            "records": " ".join(p.name for p in job.records),
            "held_out": " ".join(p.name for p in job.held_out),
            "reason": answer.reason,
            **{n: answer.figures.get(n) for n in FIGURES[study.task]},
            "seconds": answer.seconds,
        }
        for k, (job, answer) in enumerate(zip(study.jobs, answers, strict=True), 1)
    ]
    _write_csv(out / SUMMARY, rows)
    values = [
        {
            "job": k,
            "joint": job.name,
            "parameter": name,
            **{n: p.get(n) for n in ("value", "stderr", "unit", "side")},
        }
        for k, (job, answer) in enumerate(zip(study.jobs, answers, strict=True), 1)
        for name, p in answer.parameters.items()
    ]
    files = [out / SUMMARY]
    if values:
        _write_csv(out / PARAMETERS, values)
        files.append(out / PARAMETERS)
    for k, answer in enumerate(answers, 1):
        if answer.reason:
            continue
        _write_json(out / "results" / f"{k:04d}.json", answer.result)
        joint = out / "joints" / f"{k:04d}.toml"
        joint.parent.mkdir(exist_ok=True)
        _write(joint, answer.joint)
    return tuple(files)


FIGURES: Final[Mapping[str, tuple[str, ...]]] = {
    "fit": ("relative_error_percent", "held_out_error_percent"),
    "improve": ("start_error_percent", "end_error_percent", "added", "verdict"),
    "explore": (
        "start_error_percent",
        "end_error_percent",
        "recommended",
        "ties",
        "improve",
        "chosen_percent",
    ),
}
"""Columns of the summary by task."""


def _write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    _write(path, stream.getvalue())


def _write_json(path: Path, data: Any) -> None:
    path.parent.mkdir(exist_ok=True)
    _write(path, json.dumps(finite(data), indent=1, allow_nan=False) + "\n")


def _write(path: Path, text: str) -> None:
    replace_file(path, lambda stream: stream.write(text.encode("utf-8", "replace")))
