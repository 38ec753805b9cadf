"""The page's server in this process, for tests."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any


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

    On a port of its own, unless one is named: where all tests took the first free one from the default on, a page whose
    server was stopped found that of another process in its place.
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
