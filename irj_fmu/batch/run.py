"""Studies: many runs over models, records and parameters, from a file to a table; ``irj batch``."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

from identification.data.plain_text import from_json
from identification.errors import InputError
from irj_fmu.batch.fits import PARAMETERS, is_fit_study, load_fit_study, run_fits
from irj_fmu.batch.fits import SUMMARY as FIT_SUMMARY
from irj_fmu.batch.fleet import Progress, run_batches
from irj_fmu.batch.plan import plan
from irj_fmu.batch.results import SUMMARY, Run, runs_of, write_csv, write_npz, write_summary
from irj_fmu.batch.store import lock
from irj_fmu.batch.study import Study, load_study
from irj_fmu.command_line import (
    OneLineParser,
    check_folder,
    check_output,
    counted,
    fail,
    keep_inputs,
    progress_bar,
    terminable,
    write_json,
)
from irj_fmu.host.run import FmuError

Say = Callable[[str], object]
PATIENCE: Final = 10.0
"""How long a Dask scheduler and its first worker may take to answer [s]."""
_ADDRESS: Final = re.compile(r"[a-z]+://.+|[^/\\]+:\d+")


@final
@dataclass(frozen=True)
class StudyResult:
    """What a study gave.

    Attributes
    ----------
    runs : tuple of Run
        One per run, failed ones included, in the order of the study.
    there : int
        Runs that were there already from an earlier start.
    seconds : float
        Time of the others.
    summary, results : Path or None
        The files; no `results` where the study wants none.
    """

    runs: tuple[Run, ...]
    there: int
    seconds: float
    summary: Path
    results: Path | None

    @property
    def failed(self) -> tuple[Run, ...]:
        """The runs that failed."""
        return tuple(run for run in self.runs if not run.passed)


def run_study(
    study: Study | str | Path,
    *,
    out: Path | None = None,
    executor: Executor | Callable[[], Executor] | None = None,
    jobs: int | None = None,
    fresh: bool = False,
    progress: Progress | None = None,
    say: Say = lambda _text: None,
) -> StudyResult:
    """Run a study and write its results.

    Parameters
    ----------
    study : Study or path
        The study, or its file (``docs/batch.md``).
    out : Path, optional
        Folder of the results; by default ``<file>-results`` beside the study file. A study that is
        started again with the same folder goes on where it stopped.
    executor : Executor or callable, optional
        See :func:`irj_fmu.batch.fleet.run_fleet`.
    jobs : int, optional
        Portions under way at once; by default the number of processors.
    fresh : bool
        Throw away what an earlier start has left.
    progress : callable, optional
        Called with the runs done and all runs.
    say : callable
        Called with one sentence per doubt about a record or a model.

    Returns
    -------
    StudyResult

    Raises
    ------
    InputError
        A file, name or number that cannot be used, or a folder that holds another study.
    FmuError
        An executor that was handed over has died.
    """
    study = study if isinstance(study, Study) else load_study(study)
    folder = default_folder(study.source) if out is None else Path(out)
    with _held(folder):
        chunks = folder / "chunks"
        if fresh:
            _clear(chunks)
        planned = plan(study, folder / "models", say)
        begin = time.perf_counter()
        try:
            found = run_batches(
                [item.batch for item in planned],
                executor=executor,
                workers=jobs,
                folder=chunks,
                progress=progress,
            )
        except InputError as error:
            if "another batch;" not in str(error):
                raise
            raise InputError(
                f"{folder}: holds another study, or this one before a change; choose another "
                "folder with --out, or --fresh"
            ) from None
        seconds = time.perf_counter() - begin
        runs = tuple(runs_of(planned, found.parts()))
        write_summary(planned, runs, folder / SUMMARY)
        results = None if study.format == "none" else folder / f"results.{study.format}"
        if study.format == "npz" and results is not None:
            write_npz(planned, runs, found.parts, results)
        elif results is not None:
            write_csv(planned, found.parts, results)
    return StudyResult(runs, found.there, seconds, folder / SUMMARY, results)


def default_folder(study: Path) -> Path:
    """Where the results of a study file go."""
    return study.with_name(f"{study.stem}-results")


@contextlib.contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Hold the folder against another study; one that was made for nothing is taken away."""
    check_folder(folder)
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held: Any = lock(folder)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot write there ({error.strerror or error}); choose a writable folder "
            "with --out"
        ) from None
    try:
        yield
    except InputError:
        if not (folder / "chunks").exists():  # nothing was run
            _unmake(folder, made)
        raise
    finally:
        if held is not None:
            held.close()


def _unmake(folder: Path, made: Sequence[Path]) -> None:
    """Take away folders that were made here, with what a study that is refused leaves in them."""
    if folder not in made:
        return
    (folder / ".lock").unlink(missing_ok=True)
    shutil.rmtree(folder / "models", ignore_errors=True)
    for place in made:
        with contextlib.suppress(OSError):  # something else lies in it by now
            place.rmdir()


def _clear(chunks: Path) -> None:
    """Remove the results of an earlier start, and nothing else."""
    for path in (*chunks.glob("chunk-*.npz"), chunks / "batch.sha256"):
        path.unlink(missing_ok=True)


# --- command line ---------------------------------------------------------------------------------


def parser() -> OneLineParser:
    """Arguments of ``irj batch``."""
    made = OneLineParser(
        prog="irj batch",
        description="Run a study: many runs over models, records and parameters (docs/batch.md).",
    )
    made.add_argument("study", type=Path, metavar="STUDY", help="study file (TOML)")
    made.add_argument(
        "--jobs",
        type=int,
        metavar="N",
        help="processes (default: number of processors); with --dask, portions under way at once",
    )
    made.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="run on a Dask cluster: address of its scheduler, or the path of a scheduler file",
    )
    made.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="FOLDER",
        help="folder of the results (default: STUDY-results beside the study file)",
    )
    made.add_argument(
        "--fresh", action="store_true", help="throw away what an earlier start has left"
    )
    made.add_argument(
        "--dry-run",
        action="store_true",
        help="read the study file, say how many runs it holds, and stop",
    )
    made.add_argument("--fail-on-error", action="store_true", help="exit with 1 where a run failed")
    made.add_argument("--json", type=Path, metavar="FILE", help="write what was done as JSON")
    return made


def main(argv: Sequence[str]) -> int:
    """Run a study; 0 where it is done, 1 where a run failed and ``--fail-on-error`` was given,
    2 with one line on unusable input.
    """
    arguments = parser().parse_args(argv)
    try:
        with terminable():
            return _main(arguments)
    except (InputError, FmuError) as error:
        return fail(str(error))


def _main(arguments: argparse.Namespace) -> int:
    if arguments.jobs is not None and arguments.jobs < 1:
        raise InputError(f"--jobs {arguments.jobs}: give at least 1")
    if is_fit_study(arguments.study):
        return _fits(arguments)
    study = load_study(arguments.study)
    _check_results(arguments, study)
    if arguments.dry_run:
        _must_be_there(study.source, _inputs(study))
        sizes = [
            counted(len(study.models), "model"),
            counted(len(study.files), "record"),
            counted(len(study.cases), "case"),
        ]
        count = len(study.models) * max(1, len(study.files)) * len(study.cases)
        sys.stdout.write(
            f"study {study.name}: {' x '.join(sizes)}, "
            f"{counted(count, 'run')}{' where each record is one stretch' if study.files else ''}\n"
        )
        return 0
    bar = _Bar()
    with _executor(arguments.dask) as (executor, workers):
        found = run_study(
            study,
            out=arguments.out,
            executor=executor,
            jobs=arguments.jobs or workers,
            fresh=arguments.fresh,
            progress=bar.show if sys.stderr.isatty() else None,
            say=lambda text: sys.stderr.write(f"irj: {text}\n"),
        )
    new = len(found.runs) - found.there
    rate = (
        f" in {found.seconds:.1f} s, {new / found.seconds:.0f} per s"
        if new and found.seconds > 0
        else ""
    )
    there = f" ({found.there} {'was' if found.there == 1 else 'were'} there)" if found.there else ""
    sys.stdout.write(
        f"study {study.name}: {counted(len(found.runs), 'run')}{there}, {new} run now{rate}, "
        f"{len(found.failed)} failed\n"
    )
    for run in found.failed[:5]:
        sys.stdout.write(f"  run {run.number} failed: {run.reason}\n")
    if len(found.failed) > 5:
        sys.stdout.write(
            f"  and {len(found.failed) - 5} more; see outcome and reason in the summary\n"
        )
    for path in (found.summary, found.results):
        if path is not None:
            sys.stdout.write(f"{path}\n")
    write_json(arguments.json, _report(study, found))
    return 1 if arguments.fail_on_error and found.failed else 0


def _fits(arguments: argparse.Namespace) -> int:
    """A study that fits."""
    study = load_fit_study(arguments.study)
    folder = arguments.out or default_folder(study.source)
    if arguments.dry_run:
        _must_be_there(study.source, study.inputs)
        sys.stdout.write(f"study {study.name}: {study.task}, {counted(len(study.jobs), 'job')}\n")
        return 0
    keep_inputs([folder / n for n in (FIT_SUMMARY, PARAMETERS)], study.inputs)
    if arguments.json is not None:
        check_output(arguments.json, study.inputs)
    bar = _Bar()
    with _held(folder), _executor(arguments.dask) as (executor, workers):
        found = run_fits(
            study,
            out=folder,
            executor=executor,
            jobs=arguments.jobs or workers,
            fresh=arguments.fresh,
            progress=bar.show if sys.stderr.isatty() else None,
        )
    there = f" ({found.there} {'was' if found.there == 1 else 'were'} there)" if found.there else ""
    sys.stdout.write(
        f"study {study.name}: {study.task}, {counted(len(found.jobs), 'job')}{there}, "
        f"{len(found.failed)} failed\n"
    )
    for job, answer in found.failed[:5]:
        sys.stdout.write(f"  {job.name} failed: {answer.reason}\n")
    for path in found.files:
        sys.stdout.write(f"{path}\n")
    rows = [
        {"job": j.name, "passed": not a.reason, "reason": a.reason or None, **a.figures}
        for j, a in zip(found.jobs, found.answers, strict=True)
    ]
    done = {"study": study.name, "task": study.task, "there": found.there, "jobs": rows}
    write_json(arguments.json, done)
    return 1 if arguments.fail_on_error and found.failed else 0


def _inputs(study: Study) -> list[Path]:
    """Files that a study reads."""
    return [
        study.source,
        *study.files,
        *(model.path for model in study.models),
        *([study.columns] if study.columns is not None else []),
    ]


def _must_be_there(study: Path, inputs: Sequence[Path]) -> None:
    """Refuse a study whose files are not where it says."""
    missing = next((path for path in inputs if not path.is_file()), None)
    if missing is not None:
        raise InputError(
            f"{study}: there is no file {missing}; paths are relative to the study file"
        )


def _check_results(arguments: argparse.Namespace, study: Study) -> None:
    """Refuse results that cannot be written or would replace a file that the study reads."""
    inputs = _inputs(study)
    folder = arguments.out or default_folder(study.source)
    results = [
        folder / name
        for name in (SUMMARY, *([] if study.format == "none" else [f"results.{study.format}"]))
    ]
    keep_inputs(results, inputs)
    if arguments.json is None:
        return
    if arguments.json.absolute() in [path.absolute() for path in results]:
        raise InputError(f"{arguments.json}: given for two results; give each a file of its own")
    if arguments.json.absolute().parent != folder.absolute():  # that folder is made by the study
        check_output(arguments.json, inputs)
    keep_inputs([arguments.json], inputs)


def _report(study: Study, found: StudyResult) -> dict[str, Any]:
    rows = [
        {
            "run": run.number,
            "model": run.model,
            "record": run.record or None,
            "parameters": run.parameters,
            "passed": run.passed,
            "reason": run.reason or None,
            "figures": dict(run.figures),
        }
        for run in found.runs
    ]
    return {
        "study": study.name,
        "runs": len(found.runs),
        "there": found.there,
        "failed": len(found.failed),
        "summary": str(found.summary),
        "results": None if found.results is None else str(found.results),
        "rows": rows,
    }


@contextlib.contextmanager
def _executor(address: str | None) -> Iterator[tuple[Executor | None, int | None]]:
    """The executor of a Dask cluster and how many portions it takes at once; nothing without an
    address.
    """
    if address is None:
        yield None, None
        return
    try:
        from distributed import Client
    except ModuleNotFoundError:
        raise InputError(
            "--dask needs the package distributed; run `pip install irj[dask]`"
        ) from None
    import logging

    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    place = _address(address)
    try:
        asyncio.run(_knock(place))
        client = Client(place, timeout=PATIENCE, set_as_default=False)
    except Exception as error:  # whatever a server of another kind answers
        raise InputError(
            f"--dask {address}: no scheduler answers there ({' '.join(str(error).split())[:120]})"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            raise InputError(
                f"--dask {address}: the cluster has no workers; start some with `dask worker "
                f"{address}`"
            ) from None
        try:
            client.submit(_probe, pure=False).result(timeout=6 * PATIENCE)
        except Exception as error:  # whatever a worker without the package answers
            raise InputError(
                f"--dask {address}: its workers cannot import irj_fmu ({type(error).__name__}); "
                "install irj there"
            ) from None
        yield client.get_executor(pure=False), 2 * max(1, sum(client.nthreads().values()))


def _address(given: str) -> str:
    """The address that was given, or the one in a scheduler file; what is no address is refused
    before anything is started.
    """
    from distributed.comm.registry import backends

    is_file, found = Path(given).is_file(), given
    if is_file:
        try:
            found = str(from_json(Path(given).read_text(encoding="utf-8"), given)["address"])
        except (OSError, ValueError, KeyError, TypeError):
            raise InputError(
                f"--dask {given}: is not a scheduler file; give what `dask scheduler "
                "--scheduler-file` writes"
            ) from None
    scheme, sign, _ = found.partition("://")
    if not _ADDRESS.fullmatch(found) or (sign and scheme not in backends):
        why = "that file holds no address" if is_file else "no such file, and no address"
        raise InputError(f"--dask {given}: no scheduler answers there ({why} as tcp://host:8786)")
    return found


async def _knock(address: str) -> None:
    """Shake hands with the scheduler: a client that cannot would tell of it once more when it
    is thrown away.
    """
    from distributed.comm import connect
    from distributed.security import Security

    comm = await connect(address, timeout=PATIENCE, **Security().get_connection_args("client"))
    await comm.close()


def _probe() -> str:
    """Show that a worker has the project."""
    return __name__


@final
class _Bar:
    """A line on the terminal that replaces itself: share, runs, rate, time to go."""

    def __init__(self) -> None:
        self.begin = time.monotonic()
        self.first: int | None = None

    def show(self, done: int, total: int) -> None:
        """Draw it."""
        if self.first is None:
            self.first, self.begin = done, time.monotonic()
        spent = time.monotonic() - self.begin
        rate = (done - self.first) / spent if spent > 0 else 0.0
        rest = f", {(total - done) / rate:.0f} s to go" if rate > 0 and done < total else ""
        progress_bar(f"{done} of {counted(total, 'run')}, {rate:.0f} per s{rest:<20}", done / total)


__all__ = ["StudyResult", "default_folder", "load_study", "main", "run_study"]
