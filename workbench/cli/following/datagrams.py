"""A record that comes over the network, line by line in datagrams, for the online estimator."""

from __future__ import annotations

import select
import shutil
import socket
import tempfile
import threading
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self, final
from urllib.parse import urlsplit

import numpy as np

from identification.data.read import read
from identification.data.record import Record
from identification.errors import InputError
from workbench.cli.following.growing import FIRST_ROWS, Growing

if TYPE_CHECKING:
    from identification.data.joint_file import Joint

SCHEME: Final = "udp://"
LARGEST: Final = 65_535
"""Bytes of a datagram at most, as the protocol has it."""
WAITING: Final = 1 << 27
"""Bytes that may wait between two looks: a minute of 10 kHz with 200 bytes a row, as long as a
detector takes to learn from long records."""
AT_ONCE: Final = 1 << 22
"""Bytes that the system is asked to keep; without leave it keeps some 200 kB, which a second of a
fast stream fills, so they are fetched as they come."""
WAKE: Final = 0.2
"""Longest time until the fetching sees that it is over [s]."""
HEAD: Final = 20
"""Lines before the first row of numbers that are kept at most: names and units are two, loggers
write some more."""


@final
class Datagrams:
    """The rows of a table that another program sends by UDP, each once.

    A datagram holds whole lines as a CSV file has them. A line without a number at its begin
    belongs to the head: names of the columns, and units. The head may come again at any time, so
    that a receiver can start late; rows before the first one are left out. Of datagrams that
    overtake one another the late ones are left out, too.

    Parameters
    ----------
    address : str
        ``udp://HOST:PORT``, of this machine: what comes there is taken from any sender.
    joint : Joint
        Column map and kind of the axis.

    Raises
    ------
    InputError
        No such address, or it is in use.
    """

    def __init__(self, address: str, joint: Joint) -> None:
        self.path, self.joint = Path(address.removeprefix(SCHEME)), joint
        self.late = 0
        self._head: list[bytes] = []
        self._rows: list[bytes] = []
        self._in_head, self._last = False, -np.inf
        self._socket = _bound(address)
        self._folder = Path(tempfile.mkdtemp(prefix="irj-"))
        self._came: deque[bytes] = deque()
        self._waiting = 0
        self._reading, self._over = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._fetch, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()
        self._socket.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _fetch(self) -> None:
        """Take what comes out of the system's buffer while the estimator is at work."""
        while not self._over.is_set():
            if select.select([self._socket], [], [], WAKE)[0]:
                self._drain()

    def _drain(self) -> None:
        with self._reading:
            while self._waiting < WAITING:
                try:
                    came = self._socket.recv(LARGEST)
                except BlockingIOError:
                    return
                self._came.append(came)
                self._waiting += len(came)
        self._over.wait(WAKE)  # full: let the others go

    @property
    def port(self) -> int:
        """Where it listens: the system's choice where 0 was asked for."""
        return int(self._socket.getsockname()[1])

    def new(self) -> Record | None:
        """The rows that came since the last call; None where there are none, or too few to begin
        with.

        Raises
        ------
        InputError
            Rows that cannot be used.
        """
        self._drain()
        with self._reading:
            came, self._waiting = list(self._came), 0
            self._came.clear()
        for line in b"\n".join(came).splitlines():
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
            raise InputError(str(error).replace(str(part), f"{SCHEME}{self.path}")) from None
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


def place_of(address: str) -> tuple[str, int]:
    """Host and port of a stream.

    Raises
    ------
    InputError
        It is no address.
    """
    asked = urlsplit(address)
    try:
        host, port = asked.hostname, asked.port
    except ValueError:
        host, port = None, None
    if host is None or port is None or asked.path not in ("", "/"):
        raise InputError(
            f"{address}: give the address as {SCHEME}HOST:PORT, as {SCHEME}0.0.0.0:9870"
        )
    return host, port


def _bound(address: str) -> socket.socket:
    host, port = place_of(address)
    made = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, AT_ONCE)
        made.bind((host, port))
    except OSError as error:
        made.close()
        raise InputError(
            f"{address}: cannot listen there ({error.strerror}); take an address of this machine "
            "and a port that is free"
        ) from None
    made.setblocking(False)
    return made


def source(name: str, joint: Joint) -> Growing | Datagrams:
    """What is followed: a file that is being written, or a stream by its address."""
    return Datagrams(name, joint) if name.startswith(SCHEME) else Growing(Path(name), joint)


__all__ = ["SCHEME", "Datagrams", "source"]
