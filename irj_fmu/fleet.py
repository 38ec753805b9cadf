"""Run one FMU many times with different parameters, on any executor of `concurrent.futures`."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

import numpy as np

from identification.errors import InputError

from .host import Fmu, FmuError, Instance, Wiring, simulate_cs
from .signals import FloatArray, Table

Progress = Callable[[int, int], None]
_LOCAL = threading.local()


@final
@dataclass(frozen=True)
class Batch:
    """Many co-simulations of one FMU.

    Parameters
    ----------
    fmu : Path
        The FMU.
    cases : sequence of mapping
        Start values by variable name, one mapping per run.
    record : sequence of str
        Variables to record.
    inputs : mapping
        Input name to samples, the same for all cases.
    step, stop : float
        Communication step and length in s.
    chunk : int
        Runs that one worker takes at a time; also what a crash can lose.
    """

    fmu: Path
    cases: Sequence[Mapping[str, float]]
    record: Sequence[str]
    inputs: Mapping[str, Table] = field(default_factory=dict)
    step: float = 1e-3
    stop: float = 1.0
    chunk: int = 20


@final
@dataclass(frozen=True)
class FleetResult:
    """Times, shape (n,), per recorded name an array of shape (cases, n), and by case what went wrong.

    The rows of a case in `errors` are NaN.
    """

    time: FloatArray
    signals: Mapping[str, FloatArray]
    errors: Mapping[int, str]


@final
@dataclass(frozen=True)
class _Chunk:
    """One worker's portion; everything in it can be pickled."""

    number: int
    fmu: str
    folder: str
    cases: tuple[Mapping[str, float], ...]
    record: tuple[str, ...]
    inputs: Mapping[str, Table]
    step: float
    stop: float


_Done = tuple[FloatArray, dict[int, str]]


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
        An executor, which is left open, or a function that makes one. By default a pool of processes. Only a
        function (or the default) lets a run survive a process that dies.
    workers : int, optional
        Chunks under way at once; by default the number of processors.
    folder : Path, optional
        Where each chunk's result is kept. A run that is started again there goes on where it stopped.
    progress : callable, optional
        Called with the runs done and all runs after each chunk.

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
    if batch.chunk < 1 or not batch.cases:
        raise InputError("batch: give at least one case and a chunk of at least 1")
    count = round(batch.stop / batch.step)
    extracted = tempfile.mkdtemp(prefix="irj-fleet-")
    try:
        chunks = _cut(batch, extracted)
        store = _Store(batch, folder)
        results = {chunk.number: found for chunk in chunks if (found := store.load(chunk)) is not None}
        if len(results) < len(chunks):
            with Fmu(batch.fmu) as fmu:
                shutil.copytree(fmu.folder, extracted, dirs_exist_ok=True)
            _Run(chunks, results, store, executor, workers or os.cpu_count() or 1, progress).go()
    finally:
        shutil.rmtree(extracted, ignore_errors=True)
    values = np.concatenate([results[chunk.number][0] for chunk in chunks])
    errors = {
        chunk.number * batch.chunk + i: text for chunk in chunks for i, text in results[chunk.number][1].items()
    }
    signals = {name: values[:, :, i] for i, name in enumerate(batch.record)}
    return FleetResult(batch.step * np.arange(count + 1, dtype=np.float64), signals, errors)


def _cut(batch: Batch, extracted: str) -> list[_Chunk]:
    cases = [dict(case) for case in batch.cases]
    return [
        _Chunk(
            number, str(Path(batch.fmu).resolve()), extracted, tuple(cases[first : first + batch.chunk]),
            tuple(batch.record), dict(batch.inputs), batch.step, batch.stop,
        )
        for number, first in enumerate(range(0, len(cases), batch.chunk))
    ]  # fmt: skip


def run_chunk(chunk: _Chunk) -> _Done:
    """Run one chunk in a worker; a case that fails is noted and leaves NaN."""
    count = round(chunk.stop / chunk.step)
    values = np.full((len(chunk.cases), count + 1, len(chunk.record)), np.nan)
    errors: dict[int, str] = {}
    for i, case in enumerate(chunk.cases):
        wiring = Wiring(
            inputs={f"fmu.{name}": table for name, table in chunk.inputs.items()},
            parameters={f"fmu.{name}": value for name, value in case.items()},
            record=[f"fmu.{name}" for name in chunk.record],
        )
        try:
            found = simulate_cs(_instance(chunk), wiring, step=chunk.step, stop=chunk.stop)
        except FmuError as error:
            errors[i] = str(error)
            _drop()
        else:
            for j, name in enumerate(chunk.record):
                values[i, :, j] = found[f"fmu.{name}"]
    return values, errors


def _instance(chunk: _Chunk) -> Instance:
    """Return this worker's instance of the FMU, made at its first case."""
    held: tuple[str, Fmu, Instance] | None = getattr(_LOCAL, "held", None)
    if held is not None and held[0] == chunk.folder:
        return held[2]
    _drop()
    shared = (Path(chunk.folder) / "modelDescription.xml").is_file()
    fmu = Fmu(Path(chunk.folder if shared else chunk.fmu))
    instance = Instance(fmu)
    _LOCAL.held = (chunk.folder, fmu, instance)
    return instance


def _drop() -> None:
    held: tuple[str, Fmu, Instance] | None = getattr(_LOCAL, "held", None)
    _LOCAL.held = None
    if held is not None:
        held[2].close()
        held[1].close()


@final
class _Store:
    """The chunks' results on disk, under a fingerprint of the batch."""

    def __init__(self, batch: Batch, folder: Path | None) -> None:
        self.folder = folder
        if folder is None:
            return
        digest = hashlib.sha256(Path(batch.fmu).read_bytes())
        settings = [[dict(c) for c in batch.cases], list(batch.record), batch.step, batch.stop, batch.chunk]
        digest.update(json.dumps(settings, sort_keys=True).encode())
        for name in sorted(batch.inputs):
            table = batch.inputs[name]
            digest.update(name.encode() + table.time.tobytes() + table.values.tobytes() + bytes([table.hold]))
        note = folder / "batch.sha256"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if not note.exists():
                note.write_text(digest.hexdigest())
            known = note.read_text()
        except OSError as error:
            raise InputError(f"{folder}: cannot keep results there ({error.strerror}); choose another") from error
        if known != digest.hexdigest():
            raise InputError(f"{folder}: holds results of another batch; choose an empty folder")

    def load(self, chunk: _Chunk) -> _Done | None:
        """Return a chunk's result where it is there and whole."""
        if self.folder is None or not (path := self._path(chunk)).is_file():
            return None
        with np.load(path) as held:
            return held["values"], {int(key): text for key, text in json.loads(str(held["errors"])).items()}

    def save(self, chunk: _Chunk, done: _Done) -> None:
        """Write a chunk's result; it appears when it is whole."""
        if self.folder is None:
            return
        part = self._path(chunk).with_suffix(".part")
        with part.open("wb") as stream:
            np.savez_compressed(stream, values=done[0], errors=np.array(json.dumps(done[1])))
        part.replace(self._path(chunk))

    def _path(self, chunk: _Chunk) -> Path:
        return Path(self.folder or "") / f"chunk-{chunk.number:06d}.npz"


@final
class _Run:
    """Keeps a window of chunks under way, and takes the suspects apart where a process has died."""

    def __init__(
        self,
        chunks: list[_Chunk],
        results: dict[int, _Done],
        store: _Store,
        executor: Executor | Callable[[], Executor] | None,
        workers: int,
        progress: Progress | None,
    ) -> None:
        self.chunks, self.results, self.store, self.progress = chunks, results, store, progress
        self.executor, self.workers = executor, workers
        self.waiting = [chunk for chunk in chunks if chunk.number not in results]
        self.suspects: list[_Chunk] = []
        self.total = sum(len(chunk.cases) for chunk in chunks)

    def go(self) -> None:
        """Run everything that is waiting, then what was under way when a process died, one at a time."""
        while self.waiting:
            self._pool(self.waiting, self.workers, self.suspects)
        while self.suspects:
            died: list[_Chunk] = []
            chunk = self.suspects.pop(0)
            self._pool([chunk], 1, died)
            if died:
                text = "the process that ran this case died, twice"
                shape = (len(chunk.cases), round(chunk.stop / chunk.step) + 1, len(chunk.record))
                self._done(chunk, (np.full(shape, np.nan), dict.fromkeys(range(len(chunk.cases)), text)))

    def _pool(self, waiting: list[_Chunk], width: int, died: list[_Chunk]) -> None:
        own = not isinstance(self.executor, Executor)
        pool = self._make(width)
        under_way: dict[Future[_Done], _Chunk] = {}
        try:
            while waiting or under_way:
                while waiting and len(under_way) < width:
                    chunk = waiting.pop(0)
                    under_way[pool.submit(run_chunk, chunk)] = chunk
                finished, _ = wait(under_way, return_when=FIRST_COMPLETED)
                for future in finished:
                    chunk = under_way[future]
                    self._done(chunk, future.result())
                    del under_way[future]
        except BrokenExecutor as error:
            if not own:
                kept = self.store.folder or "nowhere, as no folder was named"
                raise FmuError(f"the executor died; finished chunks are kept in {kept}; run again to go on") from error
            died.extend(under_way.values())
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
        method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
        return ProcessPoolExecutor(width, mp_context=multiprocessing.get_context(method))

    def _done(self, chunk: _Chunk, done: _Done) -> None:
        self.results[chunk.number] = done
        self.store.save(chunk, done)
        if self.progress is not None:
            ready = sum(len(c.cases) for c in self.chunks if c.number in self.results)
            self.progress(ready, self.total)
