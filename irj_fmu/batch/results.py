"""Results of a study as files: one row per run, and the time series of all runs in one file."""

from __future__ import annotations

import csv
import io
import math
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final, final

import numpy as np

from irj_fmu.batch.checks import Value
from irj_fmu.batch.fleet import FIGURES, Part
from irj_fmu.batch.plan import Planned
from irj_fmu.command_line import replace_file
from irj_fmu.host.signals import FloatArray

_DATE: Final = (1980, 1, 1, 0, 0, 0)
SUMMARY: Final = "summary.csv"
Parts = Callable[[], Iterator[Part]]


@final
@dataclass(frozen=True)
class Run:
    """One row of the summary: number from 1 on, what ran, and why it failed, if it did."""

    number: int
    model: str
    record: str
    parameters: dict[str, Value]
    reason: str
    figures: dict[str, float]

    @property
    def passed(self) -> bool:
        """False where the run failed."""
        return not self.reason


def runs_of(planned: Sequence[Planned], parts: Iterator[Part]) -> Iterator[Run]:
    """The rows of the summary, in the order of the study."""
    first = np.cumsum([0, *(len(p.batch.cases) for p in planned)]).tolist()
    for part in parts:
        item = planned[part.batch]
        for i in range(len(part.done.values)):
            place = part.first + i
            figures = {
                f"{name}.{figure}": float(part.done.figures[i, j, k])
                for j, name in enumerate(item.batch.record)
                for k, figure in enumerate(FIGURES)
                if k < 5 or name in item.batch.measured
            }
            yield Run(
                first[part.batch] + place + 1,
                item.model,
                item.record,
                dict(item.batch.cases[place]),
                part.done.errors.get(i, ""),
                figures,
            )


def write_summary(planned: Sequence[Planned], runs: Sequence[Run], path: Path) -> None:
    """Write one row per run: number, model, record, parameters, outcome, reason, and figures of
    each variable.
    """
    parameters = [*dict.fromkeys(name for p in planned for case in p.batch.cases for name in case)]
    figures = [*dict.fromkeys(name for run in runs for name in run.figures)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["run", "model", "record", *parameters, "outcome", "reason", *figures])
    for run in runs:
        writer.writerow(
            [
                run.number,
                run.model,
                run.record,
                *(_plain(run.parameters.get(name, "")) for name in parameters),
                "done" if run.passed else "failed",
                run.reason,
                *(_plain(run.figures.get(name, math.nan)) for name in figures),
            ]
        )
    replace_file(path, lambda stream: stream.write(text.getvalue().encode()))


def _plain(value: Value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return str(value)


def write_npz(planned: Sequence[Planned], runs: Sequence[Run], parts: Parts, path: Path) -> None:
    """Write the time series for `numpy.load`.

    Per recorded variable an array (runs, samples); ``time`` (samples,), or (runs, samples) where
    the runs differ in it; ``samples``, ``model``, ``record``, ``reason`` (runs,), and each varied
    number as ``parameter.<name>`` (runs,). Shorter and failed runs are filled with NaN. No more
    than one portion of the runs is in memory.
    """
    count, length = len(runs), max(len(p.batch.time) for p in planned)
    alike = all(np.array_equal(p.batch.time, planned[0].batch.time) for p in planned)
    names = [*dict.fromkeys(name for p in planned for name in p.batch.record)]
    columns: dict[str, Any] = {
        "samples": np.array([len(p.batch.time) for p in planned for _ in p.batch.cases]),
        "model": np.array([run.model for run in runs]),
        "record": np.array([run.record for run in runs]),
        "reason": np.array([run.reason for run in runs]),
    }
    for name in dict.fromkeys(name for run in runs for name in run.parameters):
        values = [run.parameters.get(name, math.nan) for run in runs]
        if not any(isinstance(v, str) for v in values):
            columns[f"parameter.{name}"] = np.array(values, dtype=np.float64)
    if alike:
        columns["time"] = planned[0].batch.time

    def write(stream: IO[bytes]) -> None:
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name, column in columns.items():
                with _member(archive, name) as member:
                    np.lib.format.write_array(member, column, allow_pickle=False)
            if not alike:
                _stream(
                    archive,
                    "time",
                    (count, length),
                    (
                        _padded(np.tile(p.batch.time, (len(p.batch.cases), 1)), length)
                        for p in planned
                    ),
                )
            for name in names:
                rows = (
                    _padded(_column(planned[part.batch], part, name), length) for part in parts()
                )
                _stream(
                    archive,
                    name if name not in {*columns, "time"} else f"signal.{name}",
                    (count, length),
                    rows,
                )

    replace_file(path, write)


def _member(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    return archive.open(zipfile.ZipInfo(f"{name}.npy", _DATE), "w", force_zip64=True)


def _stream(
    archive: zipfile.ZipFile, name: str, shape: tuple[int, int], rows: Iterator[FloatArray]
) -> None:
    with _member(archive, name) as member:
        header = {"descr": "<f8", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(member, header)
        for block in rows:
            member.write(np.ascontiguousarray(block, dtype="<f8").tobytes())


def _column(item: Planned, part: Part, name: str) -> FloatArray:
    if name not in item.batch.record:
        return np.full(part.done.values.shape[:2], np.nan)
    found: FloatArray = part.done.values[:, :, item.batch.record.index(name)]
    return found


def _padded(rows: FloatArray, length: int) -> FloatArray:
    return np.pad(rows, ((0, 0), (0, length - rows.shape[1])), constant_values=np.nan)


def write_csv(planned: Sequence[Planned], parts: Parts, path: Path) -> None:
    """Write the time series as text: run, time, and one column per variable; failed runs have
    no rows.
    """
    names = [*dict.fromkeys(name for p in planned for name in p.batch.record)]
    first = np.cumsum([0, *(len(p.batch.cases) for p in planned)]).tolist()

    def write(stream: IO[bytes]) -> None:
        stream.write(
            (
                ",".join(["run", "time", *(f'"{n}"' if "," in n else n for n in names)]) + "\n"
            ).encode()
        )
        for part in parts():
            item = planned[part.batch]
            table = np.stack([_column(item, part, name) for name in names], axis=2)
            times = [repr(t) for t in item.batch.time.tolist()]
            for i, rows in enumerate(table):
                if i in part.done.errors:
                    continue
                number = first[part.batch] + part.first + i + 1
                lines = [
                    f"{number},{t},{','.join('' if v != v else repr(v) for v in row)}\n"
                    for t, row in zip(times, rows.tolist(), strict=True)
                ]
                stream.write("".join(lines).encode())

    replace_file(path, write)


__all__ = ["SUMMARY", "Run", "runs_of", "write_csv", "write_npz", "write_summary"]
