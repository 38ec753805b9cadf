"""What a worker does with its portion of a batch; everything here can be pickled."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import signal
import tempfile
import threading
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, final

import numpy as np

from irj_fmu.host.exchange import Exchange, simulate_me
from irj_fmu.host.run import Fmu, Instance, Number, Wiring, simulate_cs
from irj_fmu.host.signals import FloatArray, Table

FIGURES: Final = ("last", "minimum", "maximum", "mean", "rms", "rms_error", "fit_percent")
"""Of each recorded variable, over all samples of a run; the last two against a measured signal,
else NaN.
"""
_LOCAL = threading.local()


@final
@dataclass(frozen=True)
class Chunk:
    """One worker's portion: cases `first` and following of a batch.

    `fmu` is the file and `folder` where it is extracted, both as the process that hands out the
    work sees them; `content` are the file's bytes for workers that do not see them.
    """

    number: int
    first: int
    fmu: str
    folder: str
    cases: tuple[Mapping[str, Number | str], ...]
    record: tuple[str, ...]
    inputs: Mapping[str, Table]
    measured: Mapping[str, Table]
    step: float
    stop: float
    every: int
    content: bytes = b""

    @property
    def kept(self) -> int:
        """Samples of a run that are kept."""
        return round(self.stop / self.step) // self.every + 1


@final
@dataclass(frozen=True)
class Done:
    """Results of a chunk.

    Attributes
    ----------
    values : array, shape (cases, kept, variables)
    figures : array, shape (cases, variables, len(FIGURES))
    errors : mapping
        By place in the chunk, what went wrong; the numbers of such a case are NaN.
    """

    values: FloatArray
    figures: FloatArray
    errors: Mapping[int, str] = field(default_factory=dict)


def empty(chunk: Chunk, errors: Mapping[int, str] | None = None) -> Done:
    """Results that are all NaN."""
    cases, names = len(chunk.cases), len(chunk.record)
    return Done(
        np.full((cases, chunk.kept, names), np.nan),
        np.full((cases, names, len(FIGURES)), np.nan),
        errors or {},
    )


def run_chunk(chunk: Chunk) -> Done:
    """Run one chunk; a case that fails in any way is noted and leaves NaN."""
    found, errors = empty(chunk), {}
    inputs = {f"fmu.{name}": table for name, table in chunk.inputs.items()}
    record = [f"fmu.{name}" for name in chunk.record]
    grid: FloatArray = chunk.step * np.arange(round(chunk.stop / chunk.step) + 1, dtype=np.float64)
    measured = {
        i: chunk.measured[name].sampled(grid)
        for i, name in enumerate(chunk.record)
        if name in chunk.measured
    }
    for i, case in enumerate(chunk.cases):
        wiring = Wiring(
            inputs=inputs,
            parameters={f"fmu.{name}": value for name, value in case.items()},
            record=record,
        )
        try:
            instance = _instance(chunk)
            if instance.kind == "cs":
                run = simulate_cs(instance, wiring, step=chunk.step, stop=chunk.stop)
                table = np.column_stack([run[name] for name in record])
            else:
                options = Exchange(inputs=chunk.inputs, parameters=case, record=chunk.record)
                run = simulate_me(instance, grid, options)
                table = np.column_stack([run[name] for name in chunk.record])
            whole = np.isfinite(table)
            if not whole.all():
                row = int(np.argmin(whole.all(axis=1)))
                name = chunk.record[int(np.argmin(whole[row]))]
                errors[i] = f"{name} is not finite from t = {run.time[row]:g} s on"
                continue
        except Exception as error:  # one run's failure, whatever it is, must not end the others
            errors[i] = " ".join(str(error).split()) or type(error).__name__
            forget()
            continue
        found.values[i] = table[:: chunk.every]
        found.figures[i] = _figures(table, measured)
    return Done(found.values, found.figures, errors)


def _figures(table: FloatArray, measured: Mapping[int, FloatArray]) -> FloatArray:
    found = np.full((table.shape[1], len(FIGURES)), np.nan)
    found[:, :5] = np.column_stack(
        [
            table[-1],
            table.min(axis=0),
            table.max(axis=0),
            table.mean(axis=0),
            np.sqrt(np.mean(table**2, axis=0)),
        ]
    )
    for i, wanted in measured.items():
        residual = table[:, i] - wanted
        spread = float(np.linalg.norm(wanted - wanted.mean()))
        found[i, 5] = np.sqrt(np.mean(residual**2))
        found[i, 6] = (
            100.0 * (1.0 - float(np.linalg.norm(residual)) / spread) if spread > 0 else np.nan
        )
    return found


def _instance(chunk: Chunk) -> Instance:
    """Return this thread's instance of the FMU, made at its first case."""
    held: tuple[str, Fmu, Instance] | None = getattr(_LOCAL, "held", None)
    if held is not None and held[0] == chunk.folder:
        return held[2]
    forget()
    fmu = Fmu(_place(chunk))
    try:
        instance = Instance(fmu, fmu.kind())
    except Exception:
        fmu.close()
        raise
    _LOCAL.held = (chunk.folder, fmu, instance)
    return instance


def _place(chunk: Chunk) -> Path:
    """Where this worker finds the FMU: the extraction, the file, or the bytes that came along."""
    if (Path(chunk.folder) / "modelDescription.xml").is_file():
        return Path(chunk.folder)
    if not chunk.content or Path(chunk.fmu).is_file():
        return Path(chunk.fmu)
    digest = hashlib.sha256(chunk.content).hexdigest()[:16]
    folder = (
        Path(tempfile.gettempdir()) / f"irj-worker-{os.getpid()}-{threading.get_ident()}-{digest}"
    )
    if not (folder / "modelDescription.xml").is_file():
        with zipfile.ZipFile(io.BytesIO(chunk.content)) as archive:
            archive.extractall(folder)
        _remove_at_exit(folder)
    return folder


def _remove_at_exit(folder: Path) -> None:
    import atexit

    atexit.register(shutil.rmtree, folder, ignore_errors=True)


def forget() -> None:
    """Free this thread's instance."""
    held: tuple[str, Fmu, Instance] | None = getattr(_LOCAL, "held", None)
    _LOCAL.held = None
    if held is not None:
        held[2].close()
        held[1].close()


def enter() -> None:
    """Prepare a process of the default pool: it leaves Ctrl-C to its parent, and ends when its
    parent has died.
    """
    import multiprocessing

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: object) -> None:
    getattr(parent, "join")()  # noqa: B009 - the class of the parent is private to multiprocessing
    os._exit(1)
