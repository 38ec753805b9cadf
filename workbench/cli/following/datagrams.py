"""A record that comes over the network, line by line in datagrams."""

from __future__ import annotations

import select
import socket
import threading
from collections import deque
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final, Self, final
from urllib.parse import urlsplit

from identification.errors import InputError
from workbench.cli.following.lines import Lines

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


@final
class Datagrams(Lines):
    """The rows of a table that another program sends by UDP.

    A datagram holds whole lines; of datagrams that overtake one another the late ones are left
    out.

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
        self._socket = _bound(address)
        super().__init__(address, joint)
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
        super().__exit__(*error)

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

    def arrived(self) -> Iterable[bytes]:
        """Lines of the datagrams that came since the last call."""
        self._drain()
        with self._reading:
            came, self._waiting = list(self._came), 0
            self._came.clear()
        return b"\n".join(came).splitlines()


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


__all__ = ["SCHEME", "Datagrams", "place_of"]
