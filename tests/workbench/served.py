"""The page's server in this process, or as one of its own, for tests."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

ROOT: Final = Path(__file__).resolve().parents[2]
SERVE: Final = (
    "import sys; from pathlib import Path; from workbench.page.server import serve; "
    "serve([], int(sys.argv[1]), False, root=Path(sys.argv[2]))"
)
STARTED: Final = 120.0
"""A server answers after this long at the latest [s]."""


@dataclass
class Served:
    """A running server."""

    address: str
    root: Path
    port: int
    server: Any
    thread: threading.Thread

    def stop(self) -> None:
        self.server.should_exit = True
        self.thread.join(10)


@contextmanager
def serving(root: Path, port: int = 0, **options: Any) -> Iterator[Served]:
    """The page's server on sessions under `root`; options as those of the app.

    On a port of its own, unless one is named: where all tests took the first free one from the
    default on, a page whose server was stopped found that of another process in its place.
    """
    import uvicorn

    from workbench.page.server import PageServer, create_app

    # with the protocol, as the program's own: else asyncio leaves Nagle's delay on
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listening.bind(("127.0.0.1", port))
    listening.listen(64)
    port = int(listening.getsockname()[1])
    app = create_app(root, port=port, **options)
    server = PageServer(
        uvicorn.Config(app, log_level="error", ws="none", timeout_graceful_shutdown=1)
    )
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    thread.start()
    made = Served(f"http://127.0.0.1:{port}/", root, port, server, thread)
    try:
        yield made
    finally:
        made.stop()
        listening.close()


@final
class Server:
    """The page's server as a process, on one port for all its lives."""

    def __init__(self, root: Path) -> None:
        self.root = root
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = int(free.getsockname()[1])
        self.address = f"http://127.0.0.1:{self.port}/"
        self.start()

    def start(self) -> None:
        paths = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        self.process = subprocess.Popen(
            [sys.executable, "-c", SERVE, str(self.port), str(self.root)],
            env={**os.environ, "PYTHONPATH": paths},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        end = time.monotonic() + STARTED
        while True:
            try:
                socket.create_connection(("127.0.0.1", self.port), 1).close()
                return
            except OSError:
                assert time.monotonic() < end, "the server did not start"
                time.sleep(0.05)

    def kill(self) -> None:
        """As the system does where the memory runs out."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    @contextmanager
    def full_disk(self) -> Iterator[None]:
        """No file of the server can grow."""
        import resource

        limits = resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (0, limits[1]))
        try:
            yield
        finally:
            resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, limits)
