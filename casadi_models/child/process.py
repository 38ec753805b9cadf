"""A child process that answers requests under limits: what kills it, or takes too much, is an
error with one line here, never the end of this process.

A request is a line of JSON on its standard input; the answer is one on its standard output, with
plain arrays behind it. The child starts with the first request, serves those that follow, and ends
when it is idle or when this process ends.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Final, final

import numpy as np
import numpy.typing as npt

Arrays = dict[str, npt.NDArray[Any]]
Task = Mapping[str, Any]
"""A request; ``wall`` is the time after which the child is killed [s]."""
Answer = tuple[dict[str, Any], Arrays]

IDLE: Final = 120.0
"""An idle child ends after this long [s]."""
_START: Final = """
import importlib, json, sys, types
places, packages, module = json.loads(sys.argv[1])
sys.path[:] = places
for name, path in packages.items():
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = path
importlib.import_module(module).serve()
"""

# --- this side ------------------------------------------------------------------------------------


@final
class Child:
    """One child of this process; threads take turns.

    Parameters
    ----------
    module : str
        Its function ``serve`` is what the child runs.
    bare : sequence of str
        Packages that the child takes without what their ``__init__`` loads: a faster start.
    refusal : type of Exception
        Raised where the child refuses or ends.
    death : callable
        From exit code and request: the line that says why the child ended.
    """

    def __init__(
        self,
        module: str,
        bare: Sequence[str] = (),
        *,
        refusal: Callable[[str], Exception],
        death: Callable[[int, Task], str],
    ) -> None:
        self._module, self._bare = module, tuple(bare)
        self._refusal, self._death = refusal, death
        self._lock = threading.RLock()
        self._process: subprocess.Popen[bytes] | None = None
        _CHILDREN.add(self)

    def ask(self, task: Task) -> Answer:
        """What the child answers.

        Raises
        ------
        Exception
            The refusal: the child's, or why the child ended.
        """
        with self._lock:
            for _ in range(2):  # an idle child may end in the very moment
                process, fresh = self._running()
                try:
                    said, arrays = _exchange(process, task)
                except (EOFError, BrokenPipeError):
                    code = process.wait()
                    self.end()
                    if code or fresh:
                        raise self._refusal(self._death(code, task)) from None
                except (
                    BaseException
                ):  # a stop in the middle: what comes next from the pipe belongs to nobody
                    self.end()
                    raise
                else:
                    if "refused" in said:
                        raise self._refusal(said["refused"])
                    return said, arrays
        raise AssertionError("a fresh child answers or ends")

    def _running(self) -> tuple[subprocess.Popen[bytes], bool]:
        """The process, and whether it starts now."""
        if self._process is not None and self._process.poll() is not None:
            self.end()
        if self._process is not None:
            return self._process, False
        packages = {name: list(sys.modules[name].__path__) for name in self._bare}
        one = {
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "MALLOC_ARENA_MAX": "1",
            "ARROW_DEFAULT_MEMORY_POOL": "system",
        }
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START, json.dumps([sys.path, packages, self._module])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **one},
            start_new_session=True,  # Ctrl-C is for this process
        )
        return self._process, True

    def end(self) -> None:
        """End the child, if there is one."""
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()

    def forget(self) -> None:
        """After a fork: the child is the parent's; its pipes are closed here."""
        process, self._process, self._lock = self._process, None, threading.RLock()
        if process is not None:
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    with contextlib.suppress(OSError):
                        os.close(stream.fileno())
            process.returncode = 0  # not ours to wait for
            _FORGOTTEN.append(process)


def _exchange(process: subprocess.Popen[bytes], task: Task) -> Answer:
    assert process.stdin is not None
    assert process.stdout is not None
    late = threading.Timer(task["wall"], process.kill)
    late.daemon = True
    late.start()
    try:
        process.stdin.write(json.dumps(task).encode() + b"\n")
        process.stdin.flush()
        head = process.stdout.readline()
        if not head.endswith(b"\n"):
            raise EOFError
        said: dict[str, Any] = json.loads(head)
        arrays = {}
        for name, dtype, shape in said.get("arrays", ()):
            array = np.empty(shape, dtype=np.dtype(dtype))
            _fill(process.stdout, array)
            arrays[name] = array
    finally:
        late.cancel()
    return said, arrays


def _fill(stream: IO[bytes], array: npt.NDArray[Any]) -> None:
    view = array.reshape(-1).view(np.uint8).data if array.size else memoryview(b"")
    done = 0
    while done < len(view):
        count = stream.readinto(view[done:])  # type: ignore[attr-defined]
        if not count:
            raise EOFError
        done += count


def out_of_time(code: int) -> bool:
    """True where a child was ended by its limit of computing time or of wall time."""
    return code in (-getattr(signal, "SIGPROF", 0), -getattr(signal, "SIGKILL", 9)) and code != 0


def ended_by(code: int) -> str:
    """How a process ended: the name of its signal, or its exit code."""
    try:
        return signal.Signals(-code).name if code < 0 else f"exit code {code}"
    except ValueError:  # a real-time signal has no name
        return f"signal {-code}"


# --- the child ------------------------------------------------------------------------------------


def answer(serve: Callable[[dict[str, Any]], Answer]) -> None:
    """Answer requests from standard input until it ends."""
    source = os.fdopen(os.dup(0), "rb", buffering=0)
    target = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what foreign code prints is no answer
    os.dup2(2, 0)  # and it reads no request
    for line in _lines(source):
        said, arrays = serve(json.loads(line))
        said["arrays"] = [(n, a.dtype.str, a.shape) for n, a in arrays.items()]
        target.write(json.dumps(said).encode() + b"\n")
        for array in arrays.values():
            if array.size:
                target.write(array.reshape(-1).view(np.uint8).data)
        target.flush()


def _lines(source: IO[bytes]) -> Iterator[bytes]:
    rest = b""
    while True:
        while b"\n" not in rest:
            if os.name == "posix" and not select.select([source], [], [], IDLE)[0]:
                return
            block = source.read(1 << 16)
            if not block:
                return
            rest += block
        line, _, rest = rest.partition(b"\n")
        yield line


@contextlib.contextmanager
def limited(memory: int, seconds: float) -> Iterator[None]:
    """Limits of the system on this process, where it has them: memory [bytes] and computing
    time [s] from here on.
    """
    try:
        import resource
    except ImportError:  # Windows: the wall time of the other side is the limit
        yield
        return
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    used = _used()
    wanted = used + memory if used else hard
    if hard != resource.RLIM_INFINITY:
        wanted = min(wanted, hard)
    resource.setrlimit(resource.RLIMIT_AS, (wanted, hard))
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    signal.setitimer(
        signal.ITIMER_PROF, seconds
    )  # its signal ends a process, in the middle of compiled code too
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        resource.setrlimit(resource.RLIMIT_AS, (hard, hard))


def _used() -> int:
    """Address space of this process [bytes], 0 where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return 0


def _end_all() -> None:
    for child in list(_CHILDREN):
        child.end()


def _forget_all() -> None:
    for child in list(_CHILDREN):
        child.forget()


_FORGOTTEN: Final[list[subprocess.Popen[bytes]]] = []
_CHILDREN: Final[weakref.WeakSet[Child]] = weakref.WeakSet()
atexit.register(_end_all)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_all)
