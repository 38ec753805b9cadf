"""Run FMUs many times with different parameters, on any executor of `concurrent.futures`."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, final

import numpy as np

from identification.errors import InputError
from identification.scratch import deaf_children
from irj_fmu.batch.case import Batch
from irj_fmu.batch.store import Store
from irj_fmu.batch.worker import FIGURES, Chunk, Done, empty, enter, run_chunk
from irj_fmu.host.fmu import WHOLE
from irj_fmu.host.run import Fmu, FmuError, Number
from irj_fmu.host.signals import FloatArray

Progress = Callable[[int, int], None]
MOST: Final = 250_000_000
"""Samples times variables of one run."""
_PATIENCE: Final = 5
"""Cases that may kill their process one after another before the FMU is given up."""


@final
@dataclass(frozen=True)
class FleetResult:
    """Results of a batch.

    Attributes
    ----------
    time : array, shape (n,)
    signals : mapping
        By recorded name, shape (cases, n).
    errors : mapping
        By case what went wrong; its rows are NaN.
    figures : mapping
        By recorded name, shape (cases, len(FIGURES)): `irj_fmu.batch.worker.FIGURES`.
    """

    time: FloatArray
    signals: Mapping[str, FloatArray]
    errors: Mapping[int, str]
    figures: Mapping[str, FloatArray]


@final
@dataclass(frozen=True)
class Part:
    """Results of some cases of batch `batch`, from case `first` on."""

    batch: int
    first: int
    done: Done


def run_fleet(
    batch: Batch,
    *,
    executor: Executor | Callable[[], Executor] | None = None,
    workers: int | None = None,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> FleetResult:
    """Run a batch.

    Parameters
    ----------
    batch : Batch
        The runs.
    executor : Executor or callable, optional
        An executor, which is left open, or a function that makes one. By default a pool of
        processes. A function (or the default) lets a run survive a process that dies; so does an
        executor that heals itself, as Dask's.
    workers : int, optional
        Chunks under way at once; by default the number of processors.
    folder : Path, optional
        Where each chunk's result is kept. A run that is started again there goes on where it
        stopped.
    progress : callable, optional
        Called with the runs done and all runs after each chunk, and at the start where some are
        done.

    Returns
    -------
    FleetResult
        The same for every executor.

    Raises
    ------
    InputError
        Where the folder holds another batch or names are unknown.
    FmuError
        Where an executor that was handed over has died; what is done is in `folder`.
    """
    parts = list(
        run_batches(
            [batch], executor=executor, workers=workers, folder=folder, progress=progress
        ).parts()
    )
    values = np.concatenate([part.done.values for part in parts])
    figures = np.concatenate([part.done.figures for part in parts])
    errors = {
        part.first + i: text for part in parts for i, text in sorted(part.done.errors.items())
    }
    names = list(enumerate(batch.record))
    return FleetResult(
        batch.time,
        {n: values[:, :, i] for i, n in names},
        errors,
        {n: figures[:, i] for i, n in names},
    )


@final
@dataclass(frozen=True)
class Results:
    """Where the results of :func:`run_batches` are.

    Attributes
    ----------
    pairs : tuple
        Number of the batch, and chunk, in order.
    store : Store
    there : int
        Runs that were there from an earlier start.
    """

    pairs: tuple[tuple[int, Chunk], ...]
    store: Store
    there: int

    def parts(self) -> Iterator[Part]:
        """Read the results in their order; with a folder no more than one chunk is in memory at
        a time.
        """
        for which, chunk in self.pairs:
            done = self.store.load(chunk)
            if done is None:
                raise InputError(
                    f"{self.store.folder}: the result of chunk {chunk.number} has vanished; run "
                    "again"
                )
            yield Part(which, chunk.first, done)


def run_batches(
    batches: Sequence[Batch],
    *,
    executor: Executor | Callable[[], Executor] | None = None,
    workers: int | None = None,
    folder: Path | None = None,
    progress: Progress | None = None,
) -> Results:
    """Run several batches together; arguments and errors are those of :func:`run_fleet`."""
    for batch in batches:
        check(batch)
    with Store(batches, folder) as store:
        pairs = _cut(batches, store.place, carry=isinstance(executor, Executor))
        chunks = [chunk for _, chunk in pairs]
        there = {chunk.number for chunk in chunks if store.load(chunk) is not None}
        if len(there) < len(chunks):
            for path, place in {chunk.fmu: chunk.folder for chunk in chunks}.items():
                _extract(path, place)
            _Run(chunks, there, store, executor, workers or os.cpu_count() or 1, progress).go()
        return Results(
            tuple(pairs), store, sum(len(chunk.cases) for chunk in chunks if chunk.number in there)
        )


def check(batch: Batch) -> None:
    """Refuse a batch that cannot run at all.

    Raises
    ------
    InputError
        Sizes, times, and names that the FMU does not have.
    """
    count = (
        round(batch.stop / batch.step)
        if batch.step > 0 and np.isfinite([batch.stop, batch.step]).all()
        else 0
    )
    if batch.chunk < 1 or batch.every < 1 or not batch.cases:
        raise InputError("batch: give at least one case, and chunk and every of at least 1")
    if count < 1 or abs(count * batch.step - batch.stop) > 1e-6 * batch.step:
        raise InputError(
            f"batch: {batch.stop:g} s is not a whole number of steps of {batch.step:g} s"
        )
    if count * max(1, len(batch.record)) > MOST:
        raise InputError(
            f"batch: {count} samples of {len(batch.record)} variables do not fit into memory; "
            "take a longer step or fewer variables"
        )
    if not batch.record:
        raise InputError("batch: record names no variable; name at least one")
    with Fmu(batch.fmu) as fmu:
        fmu.kind()
        for name in dict.fromkeys(
            (
                *batch.record,
                *batch.inputs,
                *batch.measured,
                *(n for case in batch.cases for n in case),
            )
        ):
            fmu.variable(name)
        for name in (*batch.record, *batch.inputs):
            fmu.signal(name)
        for name in batch.inputs:
            if fmu.variable(name).causality != "input":
                raise InputError(
                    f"{fmu.path.name}: {name!r} is no input and cannot be fed; set it as a "
                    "parameter"
                )
        for case in batch.cases:
            for name, value in case.items():
                _check_value(fmu, name, value)


def _check_value(fmu: Fmu, name: str, value: Number | str) -> None:
    variable = fmu.variable(name)
    kind = variable.type
    fits = isinstance(value, str) if kind == "String" else not isinstance(value, str | bool)
    if kind == "Boolean":
        fits = isinstance(value, bool) or value in (0, 1)
    elif kind == "Enumeration" or kind in WHOLE:
        fits = not isinstance(value, str | bool) and float(value).is_integer()
    if not fits:
        raise InputError(
            f"{fmu.path.name}: {name} = {value!r} does not fit a variable of type {kind}"
        )
    if variable.variability == "constant" or (
        variable.causality not in ("parameter", "input")
        and variable.initial not in ("exact", "approx")
    ):
        raise InputError(f"{fmu.path.name}: {name!r} is worked out by the FMU and cannot be set")


def _cut(batches: Sequence[Batch], extracted: Path, *, carry: bool) -> list[tuple[int, Chunk]]:
    folders: dict[Path, Path] = {}
    pairs: list[tuple[int, Chunk]] = []
    for which, batch in enumerate(batches):
        path = Path(batch.fmu).resolve()
        place = folders.setdefault(path, extracted / f"{len(folders):04d}" / path.name)
        content = path.read_bytes() if carry and path.is_file() else b""
        cases = [dict(case) for case in batch.cases]
        for first in range(0, len(cases), batch.chunk):
            pairs.append(
                (
                    which,
                    Chunk(
                        len(pairs),
                        first,
                        fmu=str(path),
                        folder=str(place),
                        cases=tuple(cases[first : first + batch.chunk]),
                        record=tuple(batch.record),
                        inputs=dict(batch.inputs),
                        measured=dict(batch.measured),
                        step=batch.step,
                        stop=batch.stop,
                        every=batch.every,
                        content=content,
                    ),
                )
            )
    return pairs


def _extract(path: str, folder: str) -> None:
    import shutil

    with Fmu(Path(path)) as fmu:
        shutil.copytree(fmu.folder, folder)


@final
class _Run:
    """Keeps a window of chunks under way, and takes the suspects apart where a process has died."""

    def __init__(
        self,
        chunks: Sequence[Chunk],
        there: set[int],
        store: Store,
        executor: Executor | Callable[[], Executor] | None,
        workers: int,
        progress: Progress | None,
    ) -> None:
        self.store, self.progress = store, progress
        self.executor = executor
        self.waiting = [chunk for chunk in chunks if chunk.number not in there]
        self.workers = max(1, min(workers, len(self.waiting)))
        self.deaths = 0
        self.suspects: list[tuple[Chunk, str]] = []
        self.total = sum(len(chunk.cases) for chunk in chunks)
        self.ready = sum(len(chunk.cases) for chunk in chunks if chunk.number in there)
        if progress is not None and self.ready:
            progress(self.ready, self.total)

    def go(self) -> None:
        """Run everything that is waiting, then what was under way when a process died, one at a
        time.
        """
        while self.waiting:
            self._pool(self.waiting, self.workers, self.suspects, self._done)
        while self.suspects:
            chunk, _ = self.suspects.pop(0)
            died = self._alone(chunk, self._done)
            if died:
                self._done(
                    chunk,
                    self._one_by_one(chunk) if len(chunk.cases) > 1 else empty(chunk, {0: died}),
                )

    def _alone(self, chunk: Chunk, keep: Callable[[Chunk, Done], None]) -> str:
        """Run one chunk with nothing beside it; what killed its process, or nothing."""
        died: list[tuple[Chunk, str]] = []
        self._pool([chunk], 1, died, keep)
        return died[0][1] if died else ""

    def _one_by_one(self, chunk: Chunk) -> Done:
        """Run the cases of a chunk that has killed its process each alone, so that only the
        culprit is lost.
        """
        found, errors = empty(chunk), {}
        for i, case in enumerate(chunk.cases):
            kept: list[Done] = []

            def keep(_: Chunk, done: Done, kept: list[Done] = kept) -> None:
                kept.append(done)

            died = self._alone(replace(chunk, cases=(case,)), keep)
            if died:
                errors[i] = died
                self.deaths += 1
                if self.deaths >= _PATIENCE and self.ready == 0:
                    raise FmuError(
                        f"{Path(chunk.fmu).name}: {self.deaths} of {self.deaths} cases have "
                        "ended their process; try the FMU alone first"
                    )
                continue
            self.deaths = 0
            found.values[i], found.figures[i] = kept[0].values[0], kept[0].figures[0]
            if 0 in kept[0].errors:
                errors[i] = kept[0].errors[0]
        return Done(found.values, found.figures, errors)

    def _pool(
        self,
        waiting: list[Chunk],
        width: int,
        died: list[tuple[Chunk, str]],
        keep: Callable[[Chunk, Done], None],
    ) -> None:
        own = not isinstance(self.executor, Executor)
        before = set(multiprocessing.active_children())
        pool = self._make(width)
        under_way: dict[Future[Done], Chunk] = {}
        try:
            while waiting or under_way:
                while waiting and len(under_way) < width:
                    chunk = waiting.pop(0)
                    with deaf_children():
                        under_way[pool.submit(run_chunk, chunk)] = chunk
                finished, _ = wait(under_way, return_when=FIRST_COMPLETED)
                for future in finished:
                    error = future.exception()
                    if isinstance(error, BrokenExecutor):
                        raise error
                    chunk = under_way.pop(future)
                    if error is None:
                        keep(chunk, future.result())
                    else:  # the executor gave this chunk up
                        died.append(
                            (
                                chunk,
                                f"the worker failed: {type(error).__name__}: "
                                f"{' '.join(str(error).split())}",
                            )
                        )
        except (BrokenExecutor, CancelledError) as error:
            if not own:
                kept = self.store.folder or "nowhere, as no folder was named"
                raise FmuError(
                    f"the executor died; finished chunks are kept in {kept}; run again to go on"
                ) from error
            for future, chunk in under_way.items():
                if future.done() and not future.cancelled() and future.exception() is None:
                    keep(chunk, future.result())
                else:
                    died.append(
                        (chunk, "the process that ran this case died, each time it was tried")
                    )
        except (KeyboardInterrupt, SystemExit):
            if own:
                for process in set(multiprocessing.active_children()) - before:
                    process.terminate()
            raise
        finally:
            for future in under_way:
                future.cancel()
            if own:
                pool.shutdown(wait=True, cancel_futures=True)

    def _make(self, width: int) -> Executor:
        if isinstance(self.executor, Executor):
            return self.executor
        if self.executor is not None:
            return self.executor()
        method = (
            "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
        )
        context = multiprocessing.get_context(method)
        if method == "forkserver":  # what every worker imports is imported once
            context.set_forkserver_preload(["irj_fmu.batch.worker", "fmpy.fmi2"])
        return ProcessPoolExecutor(width, mp_context=context, initializer=enter)

    def _done(self, chunk: Chunk, done: Done) -> None:
        self.store.save(chunk, done)
        self.ready += len(chunk.cases)
        if self.progress is not None:
            self.progress(self.ready, self.total)


__all__ = [
    "FIGURES",
    "Batch",
    "FleetResult",
    "Part",
    "Progress",
    "Results",
    "check",
    "run_batches",
    "run_fleet",
]
