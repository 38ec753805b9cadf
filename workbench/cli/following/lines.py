"""The rows of a table that come line by line from somewhere else, for the online estimator."""

from __future__ import annotations

import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

import numpy as np

from identification.data.read import read
from identification.data.record import Record
from identification.errors import InputError
from workbench.cli.following.growing import FIRST_ROWS

if TYPE_CHECKING:
    from identification.data.joint_file import Joint

HEAD: Final = 20
"""Lines before the first row of numbers that are kept at most: names and units are two, loggers
write some more."""


class Lines(ABC):
    """A table whose lines come as a CSV file has them, each row once.

    A line without a number at its begin belongs to the head: names of the columns, and units. The
    head may come again at any time, so that a receiver can start late; rows before the first one
    are left out, and so are those that others have overtaken.

    Parameters
    ----------
    address : str
        Where they come from, as the user gave it.
    joint : Joint
        Column map and kind of the axis.
    """

    def __init__(self, address: str, joint: Joint) -> None:
        self.name, self.joint = address, joint
        self.late = 0
        self._head: list[bytes] = []
        self._rows: list[bytes] = []
        self._in_head, self._last = False, -np.inf
        self._folder = Path(tempfile.mkdtemp(prefix="irj-"))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)

    @abstractmethod
    def arrived(self) -> Iterable[bytes]:
        """Lines that came since the last call."""

    def new(self) -> Record | None:
        """The rows that came since the last call; None where there are none, or too few to begin
        with.

        Raises
        ------
        InputError
            Rows that cannot be used.
        """
        for line in self.arrived():
            self._take(line.strip())
        first = not np.isfinite(self._last)
        if not self._rows or (first and len(self._rows) < FIRST_ROWS):
            return None
        part = self._folder / "part.csv"
        part.write_bytes(b"\n".join([*self._head, *self._rows, b""]))
        self._rows = []
        try:
            made = read(part, columns=self.joint.columns, kind=self.joint.kind, name="stream")
        except InputError as error:
            raise InputError(str(error).replace(str(part), self.name)) from None
        newest = np.maximum.accumulate(np.concatenate([[self._last], made.time]))
        in_order = made.time > newest[:-1]
        self.late += int(np.count_nonzero(~in_order))
        self._last = float(newest[-1])
        return made.take(in_order) if in_order.any() else None

    def _take(self, line: bytes) -> None:
        if not line:
            return
        if not _is_row(line):
            if not self._in_head:
                self._head, self._in_head = [], True
            if len(self._head) < HEAD:
                self._head.append(line)
        else:
            self._in_head = False
            if self._head:
                self._rows.append(line)


def _is_row(line: bytes) -> bool:
    """Whether a line begins with a number, whatever stands between its cells."""
    first = line.replace(b";", b"\t").replace(b",", b"\t").split(None, 1)[0]
    try:
        float(first)
    except ValueError:
        return False
    return True


__all__ = ["Lines"]
