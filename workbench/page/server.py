"""The workbench in a browser: Starlette on the loopback interface, the page in ``web/``, state
in a folder.
"""

from __future__ import annotations

import asyncio
import asyncio.trsock
import gzip
import hashlib
import importlib
import json
import logging
import os
import shutil
import socket
import sys
import threading
import webbrowser
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final, final

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import (
    FileResponse,
    JSONResponse,
    PlainTextResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Route

from identification.crash import internal_error
from identification.data.plain_text import from_json
from identification.errors import InputError
from identification.scratch import hold, release
from irj_fmu.command_line import system_refusal
from workbench.page import verbs as app_verbs
from workbench.page.desk import home, sources, tree
from workbench.page.input import (
    add_upload,
    change_tree,
    drop_upload,
    look,
    put_upload,
    set_joint,
    start_demo,
)
from workbench.page.jobs.place import folder_of
from workbench.page.jobs.process import warm_up
from workbench.page.live import BusyError, Live
from workbench.page.security import Guard, loopback_hosts
from workbench.page.session import Session, Store, naming, safe_name, stored_as
from workbench.page.uploads import MAX_UPLOAD, TooLargeError, refuse_size, stream_to
from workbench.page.views import VIEWS, first_plot

IN_MEMORY: Final = 4
"""Sessions kept in memory; older ones are read from their folder again."""
MAX_BODY: Final = 1 << 20
HEARTBEAT: Final = 15.0
END: Final[dict[str, Any]] = {"end": True}
"""News that there will be none."""
WEB: Final = Path(__file__).parents[1] / "web"
ASSETS: Final = Path(__file__).parents[1] / "assets"
PAGE: Final = {
    "/": (WEB / "index.html", "text/html; charset=utf-8"),
    "/app.css": (WEB / "app.css", "text/css; charset=utf-8"),
    "/app.js": (WEB / "app.js", "text/javascript; charset=utf-8"),
    "/views.js": (WEB / "views.js", "text/javascript; charset=utf-8"),
    "/more.js": (WEB / "more.js", "text/javascript; charset=utf-8"),
    "/home.js": (WEB / "home.js", "text/javascript; charset=utf-8"),
    "/import.js": (WEB / "import.js", "text/javascript; charset=utf-8"),
    "/workspace.js": (WEB / "workspace.js", "text/javascript; charset=utf-8"),
    "/tree.js": (WEB / "tree.js", "text/javascript; charset=utf-8"),
    "/preview.js": (WEB / "preview.js", "text/javascript; charset=utf-8"),
    "/known.js": (WEB / "known.js", "text/javascript; charset=utf-8"),
    "/charts.js": (WEB / "charts.js", "text/javascript; charset=utf-8"),
    "/plots.js": (WEB / "plots.js", "text/javascript; charset=utf-8"),
    "/uPlot.js": (ASSETS / "uPlot.iife.min.js", "text/javascript; charset=utf-8"),
    "/uPlot.css": (ASSETS / "uPlot.min.css", "text/css; charset=utf-8"),
}
"""Every file the page is made of; nothing else on the disk has an address."""


@final
@dataclass
class Service:
    """The sessions of one server, and what their Replay page may follow."""

    store: Store
    max_upload: int
    sources: tuple[str, ...] = ()
    lives: OrderedDict[str, Live] = field(default_factory=OrderedDict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def live(self, identifier: str) -> Live:
        """A session by its identifier.

        Raises
        ------
        KeyError
        BusyError
            Another server has it open.
        """
        with self.lock:
            if identifier not in self.lives:
                self.lives[identifier] = self._taken(self.store.open(identifier))
                app_verbs.resume(self.lives[identifier])
            self.lives.move_to_end(identifier)
            spare = [
                k
                for k, live in self.lives.items()
                if k != identifier and not live.job and not live.listeners and live.worker.idle
            ]
            for old in spare[: max(0, len(self.lives) - IN_MEMORY)]:
                closed = self.lives.pop(old)
                closed.close()
                release(closed.session.folder)
            return self.lives[identifier]

    def _taken(self, session: Session) -> Live:
        """A session of this server's own: a second one would write over what the first has done."""
        _held(session)
        try:
            return Live(session, self.sources)
        except BaseException:
            release(session.folder)
            raise

    def delete(self, identifier: str) -> None:
        """Delete a session.

        Raises
        ------
        KeyError
        BusyError
            It works, or another server has it open.
        """
        with self.lock:
            live = self.lives.get(identifier)
            if live is not None and live.job is not None:
                raise BusyError(f"busy: {live.job.text}; wait for it or cancel it")
            if live is None:
                _held(self.store.open(identifier))
            self.lives.pop(identifier, None)
            if live is not None:
                live.close()
            folder = self.store.root / identifier
            try:
                home.delete(self.store, identifier)
            finally:
                release(folder)
        for listener in tuple(live.listeners) if live is not None else ():
            listener({"gone": True})  # other tabs that have it open

    def end(self) -> None:
        """End every stream of news: it has no end of its own, and the server would wait for it."""
        with self.lock:
            open_now = [listener for live in self.lives.values() for listener in live.listeners]
        for listener in open_now:
            listener(END)


def _held(session: Session) -> None:
    try:
        hold(session.folder)
    except InputError:
        raise BusyError(
            "another irj app has this session open; go on there, or stop that one first"
        ) from None


ACCEPTED: Final = 10
"""Rounds of the loop in which an accepted socket has become a connection: it takes three."""


def _unheard(loop: asyncio.AbstractEventLoop, listening: asyncio.trsock.TransportSocket) -> bool:
    """Whether a loop accepts nothing of a socket any more."""
    try:
        return loop.remove_reader(listening.fileno())
    except NotImplementedError:
        return False


@final
class PageServer(uvicorn.Server):  # type: ignore[misc]
    """The server of the page, which stops at once also where pages are open."""

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End what would go on for ever, then stop; no connection outlives the server.

        The parent tells the connections that it knows. One that is accepted while it does so would
        stay open without a reader: a browser that asks on it waits for ever. So nothing is accepted
        any more before a server closes: what is accepted of a closed one is no connection, and is
        told nothing until it is collected as garbage.
        """
        if isinstance(self.config.app, Guard):
            self.config.app.end()
        loop = asyncio.get_running_loop()
        for server in self.servers:
            if not all(_unheard(loop, listening) for listening in server.sockets):
                server.close()  # a loop that hears its sockets in another way
        for _ in range(ACCEPTED):
            await asyncio.sleep(0)
        await asyncio.sleep(0.05)  # what is accepted already becomes a connection that is told
        await super().shutdown(sockets)
        for connection in list(self.server_state.connections):
            connection.transport.abort()
        await asyncio.sleep(0)


_LOG = logging.getLogger(__name__)
Handler = Callable[[Request, Live], Any]


def _with_session(service: Service, handler: Handler) -> Callable[[Request], Any]:
    """Find the session; turn what went wrong into one sentence."""

    async def found(request: Request) -> Response:
        live = await run_in_threadpool(service.live, request.path_params["sid"])
        with live.library():
            result: Response = await handler(request, live)
        return result

    return _said(found)


def _said(work: Callable[[Request], Any]) -> Callable[[Request], Any]:
    """Turn what went wrong into one sentence."""

    async def answer(request: Request) -> Response:
        try:
            result: Response = await work(request)
            return result
        except KeyError:
            return PlainTextResponse("no such session; start a new one", 404)
        except TooLargeError as error:
            return PlainTextResponse(str(error), 413, headers={"connection": "close"})
        except BusyError as error:
            return PlainTextResponse(str(error), 409)
        except InputError as error:
            return PlainTextResponse(str(error), 422)
        except ClientDisconnect:
            return PlainTextResponse("closed", 499)
        except OSError as error:
            return PlainTextResponse(system_refusal(error), 507)
        except Exception as error:
            said = internal_error(error, f"page: {request.method} {request.url.path}")
            _LOG.error(said)
            return PlainTextResponse(said, 500)

    return answer


async def _body(request: Request) -> dict[str, Any]:
    raw = b""
    async for chunk in request.stream():
        raw += chunk
        if len(raw) > MAX_BODY:
            raise TooLargeError("the request is too long")
    data = from_json(raw or b"{}", "the request")
    if not isinstance(data, dict):
        raise InputError("the request is not a JSON object")
    return data


def _json(data: Any) -> Response:
    return JSONResponse(data, headers={"cache-control": "no-store"})


def _public(live: Live) -> dict[str, Any]:
    """The state as the page gets it: without values of parameters and names on the disk."""
    state = live.whole()
    for step in state["steps"] + state["undone"]:
        step.pop("values")
    for entry in state["files"]:
        entry.pop("stored")
    state["can"] = {"undo": live.can(tree.undone), "redo": live.can(tree.redone)}
    state["fits"] = len(state.pop("branches"))
    last = state["steps"][-1]["id"] if state["steps"] else ""
    state["laws"] = state.pop("found").get(last, {}).get("laws", [])
    return state


async def _state(request: Request, live: Live) -> Response:
    return _json(await run_in_threadpool(_public, live))


async def _events(request: Request, live: Live) -> Response:
    loop = asyncio.get_running_loop()
    queue: asyncio.Queue[dict[str, Any]] = asyncio.Queue()

    def listener(snapshot: dict[str, Any]) -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(queue.put_nowait, snapshot)

    async def stream() -> AsyncIterator[str]:
        live.listeners.add(listener)
        try:
            yield f"data: {json.dumps(live.snapshot())}\n\n"
            while True:
                try:
                    snapshot = await asyncio.wait_for(queue.get(), HEARTBEAT)
                except TimeoutError:
                    yield ": still here\n\n"
                    continue
                while snapshot is not END and not queue.empty():
                    snapshot = queue.get_nowait()
                if snapshot is END:
                    return
                yield f"data: {json.dumps(snapshot)}\n\n"
        finally:
            live.listeners.discard(listener)

    return StreamingResponse(
        stream(), media_type="text/event-stream", headers={"cache-control": "no-store"}
    )


async def _upload(request: Request, live: Live, limit: int, store: Store) -> Response:
    name = safe_name(request.path_params["name"])
    announced = int(request.headers.get("content-length", "0") or 0)
    refuse_size(name, announced, limit, live.session.files)
    await run_in_threadpool(home.refuse_over, store, name, announced)
    stored = stored_as(name)
    path = live.session.files / stored
    size = await stream_to(path, request.stream(), limit)

    def taken() -> Response:
        """The record is in the session; with the state and, where the page names its width, the
        first plot: that saves it two questions.
        """
        made = add_upload(live, name, stored, size)
        plot = (
            first_plot(live, str(made.get("id", "")), request.query_params)
            if "points" in request.query_params
            else None
        )
        return _json({**made, "plot": plot, "state": _public(live)})

    try:
        return await run_in_threadpool(taken)
    except Exception:
        path.unlink(missing_ok=True)
        raise


async def _change_file(request: Request, live: Live) -> Response:
    body = await _body(request)
    return _json(await run_in_threadpool(put_upload, live, request.path_params["fid"], body))


async def _look(request: Request, live: Live) -> Response:
    body = await _body(request)
    return _json(await run_in_threadpool(look, live, request.path_params["fid"], body))


async def _delete_file(request: Request, live: Live) -> Response:
    await run_in_threadpool(drop_upload, live, request.path_params["fid"])
    return _json({})


async def _joint(request: Request, live: Live) -> Response:
    body = await _body(request)
    return _json(await run_in_threadpool(set_joint, live, body))


async def _tree(request: Request, live: Live) -> Response:
    body = await _body(request)
    return _json(await run_in_threadpool(change_tree, live, body))


async def _demo(request: Request, live: Live) -> Response:
    return _json(await run_in_threadpool(start_demo, live))


async def _run(request: Request, live: Live) -> Response:
    body = await _body(request)
    app_verbs.run(live, str(body.get("action", "")), body)
    return JSONResponse(live.snapshot(), 202)


async def _cancel(request: Request, live: Live) -> Response:
    return _json({"cancelled": live.cancel()})


async def _stop(request: Request, live: Live) -> Response:
    await run_in_threadpool(sources.ask_stop, folder_of(live))
    return _json({})


async def _view(request: Request, live: Live) -> Response:
    view = VIEWS.get(request.path_params["view"])
    if view is None:
        return PlainTextResponse("no such view", 404)
    made = await run_in_threadpool(view, live, dict(request.query_params))
    return made if isinstance(made, Response) else _json(made)


@cache
def _packed(path: Path, changed: int) -> tuple[bytes, str]:
    """A file of the page as it is sent, and what a browser knows it by, which then asks for it no
    more: a third of it, and nothing at the second time, matter where the page comes from a
    computer at the rig through a tunnel.
    """
    content = path.read_bytes()
    return gzip.compress(content, mtime=0), f'"{hashlib.sha256(content).hexdigest()[:16]}"'


def create_app(
    root: Path,
    *,
    port: int = 8765,
    max_upload: int = MAX_UPLOAD,
    hosts: frozenset[str] | None = None,
    follow: Sequence[str | Path] = (),
) -> Guard:
    """The application.

    Parameters
    ----------
    root : Path
        Folder of the sessions.
    port : int
        Port it is served on: part of the Host header that is accepted.
    max_upload : int
        Largest upload in bytes.
    hosts : set of str, optional
        Host headers in place of the loopback names.
    follow : sequence of path
        Files that are being written, and addresses of streams, which the Replay page may follow.

    Raises
    ------
    InputError
        One of them cannot be followed.
    """
    service = Service(Store(root), max_upload, sources.named(follow))
    home.sweep_empty(service.store)

    async def page(request: Request) -> Response:
        path, kind = PAGE[request.url.path]
        content, mark = _packed(path, path.stat().st_mtime_ns)
        headers = {"cache-control": "no-cache", "etag": mark, "vary": "accept-encoding"}
        if request.headers.get("if-none-match") == mark:
            return Response(status_code=304, headers=headers)
        if "gzip" not in request.headers.get("accept-encoding", ""):
            return FileResponse(path, media_type=kind, headers=headers)
        return Response(content, media_type=kind, headers={**headers, "content-encoding": "gzip"})

    async def new(request: Request) -> Response:
        made = await run_in_threadpool(service.store.create)
        return _json({"id": made.id})

    async def config(request: Request) -> Response:
        known = {"max_upload": service.max_upload, "sessions": home.mark_of(service.store)}
        return _json(await run_in_threadpool(VIEWS["config"], None, known))

    def at(path: str, handler: Handler, *methods: str) -> Route:
        return Route(
            "/api/session/{sid}" + path,
            _with_session(service, handler),
            methods=list(methods) or ["GET"],
        )

    async def upload(request: Request, live: Live) -> Response:
        return await _upload(request, live, service.max_upload, service.store)

    async def sessions(request: Request) -> Response:
        if not home.allowed(service.store, request.headers.get("x-irj-home", "")):
            return PlainTextResponse("open the address that irj app printed", 403)
        return _json(await run_in_threadpool(home.sessions, service.store))

    async def delete(request: Request) -> Response:
        if not home.allowed(service.store, request.headers.get("x-irj-home", "")):
            return PlainTextResponse("open the address that irj app printed", 403)
        await run_in_threadpool(service.delete, request.path_params["sid"])
        return _json({})

    routes = [
        *(Route(path, page) for path in PAGE),
        Route("/api/config", _said(config)),
        Route("/api/session", _said(new), methods=["POST"]),
        Route("/api/home", _said(sessions)),
        Route("/api/home/{sid}", _said(delete), methods=["DELETE"]),
        at("", _state),
        at("/events", _events),
        at("/files/{name}", upload, "PUT"),
        at("/file/{fid}", _change_file, "POST"),
        at("/file/{fid}", _delete_file, "DELETE"),
        at("/look/{fid}", _look, "POST"),
        at("/joint", _joint, "POST"),
        at("/tree", _tree, "POST"),
        at("/demo", _demo, "POST"),
        at("/run", _run, "POST"),
        at("/cancel", _cancel, "POST"),
        at("/stop", _stop, "POST"),
        at("/view/{view}", _view),
    ]
    return Guard(Starlette(routes=routes), hosts or loopback_hosts(port), service.end)


def default_root() -> Path:
    """Where sessions are kept: ``$IRJ_SESSIONS``, else the user's data folder."""
    given = os.environ.get("IRJ_SESSIONS")
    if given:
        return Path(given)
    base = (
        os.environ.get("XDG_DATA_HOME")
        or os.environ.get("LOCALAPPDATA")
        or str(Path.home() / ".local" / "share")
    )
    return Path(base) / "irj" / "sessions"


def with_files(root: Path, files: Sequence[str | Path]) -> str:
    """A new session with files from the command line (copied); its identifier.

    Raises
    ------
    InputError
        A file that does not exist, or that cannot be read; no session is left then.
    """
    store = Store(root)
    for file in files:
        if not Path(file).is_file():
            raise InputError(
                f"{file}: is a folder; name the files in it"
                if Path(file).is_dir()
                else f"{file}: there is no such file; check the path"
            )
    session = store.create()
    live = Live(session)
    try:
        for file in sorted(map(Path, files), key=lambda f: f.suffix != ".toml"):
            name = safe_name(file.name)
            stored = stored_as(name)
            with naming(session.files / stored):
                shutil.copyfile(file, session.files / stored)
            with live.library():
                add_upload(live, name, stored, file.stat().st_size)
    except BaseException:  # a session that nobody is told of would keep the files for ever
        live.close()
        shutil.rmtree(session.folder, ignore_errors=True)
        raise
    return session.id


def serve(
    files: Sequence[str | Path] = (),
    port: int = 0,
    open_browser: bool = True,
    *,
    root: Path | None = None,
    say: Callable[[str], None] | None = None,
    follow: Sequence[str | Path] = (),
) -> None:
    """Serve the app on 127.0.0.1 until it is interrupted; prints its address on one line.

    Parameters
    ----------
    files : sequence of path
        Records and a joint file to start with.
    port : int
        0: the first free one from 8765.
    open_browser : bool
    root : Path, optional
        Folder of the sessions (`default_root`).
    say : callable, optional
        Gets the line with the address in place of standard output.
    follow : sequence of path
        Files that are being written, and addresses of streams, which the Replay page may follow.

    Raises
    ------
    InputError
        The port is taken; a file cannot be used.
    """
    folder = root or default_root()
    with _listen(port) as listening:
        port = int(listening.getsockname()[1])
        key = home.key_of(Store(folder))
        app = create_app(folder, port=port, follow=follow)
        tail = f"#home={key}" + (f"&session={with_files(folder, files)}" if files else "")
        address = f"http://127.0.0.1:{port}/{tail}"
        if say is not None:
            say(address)
        else:
            sys.stdout.write(address + "\n")
            sys.stdout.flush()
        config = uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=1,
            ws="none",
        )
        threading.Thread(target=_warm_up, daemon=True, name="warm up").start()
        if open_browser:
            threading.Timer(0.5, webbrowser.open, (address,)).start()
        PageServer(config).run(sockets=[listening])


def _warm_up() -> None:
    """Import what the first upload would wait for."""
    for name in ("numpy.ma", "numpy.fft", "identification.data.guess", "scipy.sparse"):
        importlib.import_module(name)
    warm_up()


def _listen(port: int) -> socket.socket:
    """A listening socket on the loopback interface, and on no other."""
    for candidate in [port] if port else [*range(8765, 8775), 0]:
        listening = socket.socket(
            socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP
        )  # with the protocol: else asyncio leaves Nagle's delay on
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind(("127.0.0.1", candidate))
            listening.listen(64)
        except OSError:
            listening.close()
            continue
        return listening
    raise InputError(f"port {port} of 127.0.0.1 is taken; give another with --port")


__all__ = ["PageServer", "create_app", "default_root", "serve"]
