"""A record that is still being written, followed by the online estimator as it grows."""

from __future__ import annotations

import math
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, Self, final

import numpy as np
import numpy.typing as npt

from identification.balance.stamps import longest_hole
from identification.data.read import read
from identification.data.read.csv import head_of, wide_encoding
from identification.data.record import Record
from identification.errors import InputError
from irj_fmu.estimator.healthy import may_watch, online_readings
from workbench.cli.files import needed
from workbench.cli.following.stepper import Stepper, arrays_of
from workbench.show.replayed import READINGS, Replay

if TYPE_CHECKING:
    from identification.data.joint_file import Joint

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

POLL: Final = 0.25
"""Time between two looks at the file [s]: a reader sees a fault no later than it can react."""
QUIET: Final = 10.0
"""A file that has not grown for so long is complete [s]: loggers write at least once in a second, a
decade is left."""
FIRST_ROWS: Final = 100
"""Rows from which the sample time is taken: the median of as many steps is within a hundredth of
theirs where a step scatters by a tenth."""
LOOKS: Final = 400
"""Looks at the course that are kept at least; twice as many are thinned to every other one."""
LOOK: Final = 0.05
"""Time between two looks before any is thinned out [s]."""
_LINE: Final = re.compile(r"\bline (\d+)")
"""Where a reader says that something is."""


class Source(Protocol):
    """What `follow` takes rows from."""

    name: str
    """As the user gave it."""

    def new(self) -> Record | None:
        """The rows that came since the last call; None where there are none."""


@final
class Growing:
    """The rows of a text file that is being written, each once.

    Parameters
    ----------
    path : Path
        CSV or TSV as :func:`identification.data.read.read` takes it; the last line may be a part.
    joint : Joint
        Column map and kind of the axis.
    """

    def __init__(self, path: Path, joint: Joint) -> None:
        self.path, self.joint, self.name = path, joint, str(path)
        self._folder = Path(tempfile.mkdtemp(prefix="irj-"))
        self._head, self._at = b"", 0
        self._wide: str | None = None
        self._row, self._lines = b"", 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)

    def new(self) -> Record | None:
        """The whole lines that came since the last call; None where there are none, or too few to
        begin with.

        Raises
        ------
        InputError
            The file is not there, was cut, or its rows cannot be used.
        """
        try:
            with self.path.open("rb") as stream:
                if self._at > stream.seek(0, 2):
                    raise InputError(
                        f"{self.path}: is shorter than it was; follow the new recording anew"
                    )
                stream.seek(self._at)
                came = stream.read()
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot be read ({error.strerror}); give a CSV file that is being "
                "written"
            ) from None
        whole, read_to = self._lines_of(came)
        if not whole or (not self._at and whole.count(b"\n") < FIRST_ROWS):
            return None
        part = self._folder / "part.csv"
        before = self._head + 2 * self._row  # two rows alike, by which a table is known
        part.write_bytes(before + whole)
        try:
            if not self._at:
                self._head = b"".join(whole.splitlines(keepends=True)[: head_of(part)])
            made = read(part, columns=self.joint.columns, kind=self.joint.kind, name=self.path.stem)
        except InputError as error:
            said = str(error).replace(str(part), str(self.path))
            earlier = self._lines - before.count(b"\n")
            raise InputError(_LINE.sub(lambda m: f"line {int(m[1]) + earlier}", said)) from None
        again = 2 if self._row else 0
        rows = (x for x in reversed(whole.splitlines(keepends=True)) if _is_row(x))
        self._row = next(rows, self._row)
        self._at, self._lines = self._at + read_to, self._lines + whole.count(b"\n")
        return made.take(np.arange(len(made)) >= again) if len(made) > again else None

    def _lines_of(self, came: bytes) -> tuple[bytes, int]:
        """The whole lines of what came, not as UTF-16, and how many bytes of the file they are."""
        if not self._at:
            self._wide = wide_encoding(came)
        if self._wide is None:
            end = came.rfind(b"\n") + 1
            return came[:end], end
        text = came[: len(came) // 2 * 2].decode(self._wide, errors="replace")
        whole = text[: text.rfind("\n") + 1]
        return whole.encode(), len(whole.encode(self._wide))


def follow(
    source: Source,
    joint: Joint,
    detector_state: Callable[[Record], bytes | None] = lambda _first: None,
    *,
    quiet: float = QUIET,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[Replay]:
    """What the online estimator makes of a growing file: a `Replay` after every look at the file
    since its first rows came, until it has not grown for `quiet` seconds.

    Its record and its readings are those at the looks, so that memory does not grow with the file.

    Parameters
    ----------
    source : Source
        A growing file, or a stream.
    joint : Joint
        With fitted values the sensor-fault detector runs too.
    detector_state : callable
        From the first rows to the state of a detector calibrated with healthy records, or None.
    quiet : float
        [s].
    stop : callable
        Asked after every look at the file; True ends it.

    Raises
    ------
    InputError
        The file cannot be used, or held too few rows when it came to rest.
    """
    run: _Run | None = None
    last, halted = time.monotonic(), False
    while True:
        record = source.new()
        if record is not None:
            if run is None:
                run = _Run(record, joint, detector_state(record))
            run.take(record)
            last = time.monotonic()
        elif time.monotonic() - last > quiet:
            break
        if run is not None:
            yield run.replay()
        halted = stop()
        if halted:
            break
        if record is None:
            time.sleep(POLL)
    if run is None:
        when = "before it was stopped" if halted else f"within {quiet:g} s"
        raise InputError(
            f"{source.name}: fewer than {FIRST_ROWS} lines came {when}; start the recording "
            "first, or follow it for longer"
        )


def _is_row(line: bytes) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith((b"#", b"%", b"//"))


@final
class _Run:
    def __init__(self, first: Record, joint: Joint, state: bytes | None) -> None:
        from identification.online.estimator import OnlineEstimator, OnlineOptions

        for channel in needed(first, joint):
            if not first.has(channel):
                raise InputError(f"{first.name}: has no {channel}, which the estimator reads")
        options = OnlineOptions(
            has_link=first.has("link_position"),
            has_torque=first.has("link_torque"),
            detect=may_watch(first, state),
        )
        self.joint, self.name, self.kind = joint, first.name, first.kind
        self.calibrated = bool(state)
        estimator = OnlineEstimator(joint, first.dt, options, state)
        self.stepper = Stepper(estimator, max(1, round(LOOK / first.dt)))
        self.stepper.restart()
        self.rows: list[tuple[float, Any, Any, Any]] = []
        self.step, self.last = first.dt, -math.inf
        nothing = np.zeros(len(READINGS))
        self.newest: tuple[FloatArray, BoolArray, float] = nothing, nothing > 0, self.last

    def take(self, record: Record) -> None:
        table, there = online_readings(record, self.joint)
        readings = np.array(table)
        valid = np.isfinite(readings) & np.array(there)
        for k, now in enumerate(record.time.tolist()):
            if not now > self.last:
                raise InputError(
                    f"{self.name}: time goes from {self.last:.6g} to {now:.6g} s; a run that "
                    "begins anew needs a file of its own"
                )
            self._bridge(now, readings[k], valid[k])
            self._feed(now, readings[k], valid[k])
        while len(self.rows) > 2 * LOOKS and len(self.rows) % 2:
            self._thin()

    def _bridge(self, now: float, row: FloatArray, there: BoolArray) -> None:
        """What the check of a whole record does at lost samples: a short hole is bridged, behind a
        long one the estimator starts anew.
        """
        lost = round((now - self.last) / self.step) - 1 if math.isfinite(self.last) else 0
        if lost > longest_hole(self.step):
            self.stepper.restart()
            return
        before, seen, since = self.newest
        for k in range(1, lost + 1):
            part = k / (lost + 1)
            self._feed(since + part * (now - since), before + part * (row - before), seen & there)

    def _feed(self, now: float, row: FloatArray, there: BoolArray) -> None:
        stepper, detector = self.stepper, self.stepper.estimator.detector
        self.last, self.newest = now, (row, there, now)
        looked = stepper.feed(now, np.nan_to_num(row).tolist(), there.tolist())
        if not self.rows and not looked:  # times count from the first sample
            stepper.looks.append((0, [0.0] * len(READINGS)))
        elif not looked:
            return
        replaced = detector.replaced if detector is not None else (False,) * len(READINGS)
        used = stepper.estimator.readings if detector is not None else row
        self.rows.append((now, row, np.array(used), np.array(replaced)))

    def _thin(self) -> None:
        """The first look and every other one after it, with the larger score of the two."""
        stepper = self.stepper
        kept = [
            (b[0], [max(x, y) for x, y in zip(a[1], b[1], strict=True)])
            for a, b in zip(stepper.looks[1::2], stepper.looks[2::2], strict=True)
        ]
        kept.insert(0, stepper.looks[0])
        self.rows = self.rows[::2]
        times = {row[0] for row in self.rows}
        stepper.looks = kept
        stepper.course = [c for c in stepper.course if c[0] in times]
        stepper.every *= 2

    def replay(self) -> Replay:
        stepper = self.stepper
        time, values, sigmas, ratios = arrays_of(stepper.course, stepper.estimator)
        stamps = np.array([row[0] for row in self.rows])
        readings, used, failed = (
            np.array([row[i] for row in self.rows]).reshape(-1, len(READINGS)) for i in (1, 2, 3)
        )
        record = Record.from_channels(
            stamps, {"motor_position": readings[:, 1]}, name=self.name, kind=self.kind
        )
        return Replay(
            record,
            stepper.estimator,
            time=time,
            values=values,
            sigmas=sigmas,
            ratios=ratios,
            looks=np.arange(len(stamps)),
            scores=np.array([scores for _, scores in stepper.looks]).reshape(-1, len(READINGS)),
            events=tuple(stepper.events),
            verdicts=tuple(stepper.verdicts),
            healthy=readings,
            readings=readings,
            used=used,
            failed=failed.astype(bool),
            calibrated=self.calibrated and stepper.estimator.detector is not None,
        )


__all__ = ["Growing", "Source", "follow"]
