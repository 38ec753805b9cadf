"""Results of a batch on disk: one file per chunk under a fingerprint, so that a run that was
ended goes on.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, final

import numpy as np

from identification.errors import InputError
from irj_fmu.batch.case import Batch
from irj_fmu.batch.worker import FIGURES, Chunk, Done

_NOTE = "batch.sha256"


@final
class Store:
    """The folder of a batch; without one, results are kept in memory.

    Use it as a context: it holds a lock on the folder, and removes the extracted FMUs at the end.

    Parameters
    ----------
    batches : sequence of Batch
        What is run.
    folder : Path, optional
        Where results are kept.

    Raises
    ------
    InputError
        Where the folder cannot be written, holds another batch, or another process works in it.
    """

    def __init__(self, batches: Sequence[Batch], folder: Path | None) -> None:
        self.folder = None if folder is None else Path(folder).resolve()
        self.memory: dict[int, Done] = {}
        self._lock: Any = None
        self._made: Path | None = None
        if self.folder is None:
            self._made = Path(tempfile.mkdtemp(prefix="irj-fleet-"))
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = lock(self.folder)
            self._sign(batches, self.folder)
            for stale in self.folder.glob(".fmu-*"):
                shutil.rmtree(stale, ignore_errors=True)
            for stale in self.folder.glob("*.part"):
                stale.unlink()
            self._made = Path(tempfile.mkdtemp(prefix=".fmu-", dir=self.folder))
        except OSError as error:
            self.close()
            raise InputError(
                f"{folder}: cannot keep results there ({error.strerror or error}); choose "
                "another folder"
            ) from None
        except InputError:
            self.close()
            raise

    @staticmethod
    def _sign(batches: Sequence[Batch], folder: Path) -> None:
        note = folder / _NOTE
        digest = fingerprint(batches)
        if not note.exists() or not note.read_text():
            note.write_text(digest)
        if note.read_text() != digest:
            raise InputError(f"{folder}: holds results of another batch; choose an empty folder")

    @property
    def place(self) -> Path:
        """A new folder for extracted FMUs, of a name that no other batch has."""
        return self._made or Path()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Remove the extractions and give the folder free; results can still be loaded."""
        if self._made is not None:
            shutil.rmtree(self._made, ignore_errors=True)
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def load(self, chunk: Chunk) -> Done | None:
        """Return a chunk's result where it is there and whole."""
        if self.folder is None:
            return self.memory.get(chunk.number)
        try:
            with self._path(chunk).open("rb") as stream, np.load(stream) as held:
                values, figures = held["values"], held["figures"]
                errors = {int(key): text for key, text in json.loads(str(held["errors"])).items()}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None
        shapes = (
            (len(chunk.cases), chunk.kept, len(chunk.record)),
            (len(chunk.cases), len(chunk.record), len(FIGURES)),
        )
        return Done(values, figures, errors) if (values.shape, figures.shape) == shapes else None

    def save(self, chunk: Chunk, done: Done) -> None:
        """Keep a chunk's result; a file appears when it is whole."""
        if self.folder is None:
            self.memory[chunk.number] = done
            return
        part = self._path(chunk).with_suffix(".part")
        try:
            with part.open("wb") as stream:
                np.savez(
                    stream,
                    values=done.values,
                    figures=done.figures,
                    errors=np.array(json.dumps(dict(done.errors))),
                )
            part.replace(self._path(chunk))
        except OSError as error:
            raise InputError(
                f"{self.folder}: cannot keep results there ({error.strerror or error}); make "
                "room and run again to go on"
            ) from None
        finally:
            part.unlink(missing_ok=True)

    def _path(self, chunk: Chunk) -> Path:
        return Path(self.folder or "") / f"chunk-{chunk.number:06d}.npz"


def fingerprint(batches: Sequence[Batch]) -> str:
    """Digest of everything that the results of batches depend on."""
    digest = hashlib.sha256()
    for batch in batches:
        digest.update(hashlib.sha256(Path(batch.fmu).read_bytes()).digest())
        settings = [
            [dict(c) for c in batch.cases],
            list(batch.record),
            batch.step,
            batch.stop,
            batch.chunk,
            batch.every,
        ]
        digest.update(json.dumps(settings, sort_keys=True).encode())
        for role, tables in (("input", batch.inputs), ("measured", batch.measured)):
            for name in sorted(tables):
                table = tables[name]
                digest.update(
                    f"{role} {name} {table.hold} {len(table.time)}".encode()
                    + table.time.tobytes()
                    + table.values.tobytes()
                )
    return digest.hexdigest()


def lock(folder: Path) -> Any:
    """An open file that is locked until it is closed or the process ends; None where the system has
    no such locks.

    Raises
    ------
    InputError
        Where another process holds the lock.
    """
    try:
        import fcntl
    except ImportError:
        return None
    stream = (folder / ".lock").open("a")
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        stream.close()
        raise InputError(
            f"{folder}: another batch is at work there; wait for it or choose another folder"
        ) from None
    return stream
