"""Foreign decoders in a process of their own, with limits: a file that kills them, or fills the
memory, is one line.

The child decodes and hands plain arrays back over a pipe. It starts with the first file that needs
it, serves the files that follow, and ends when it is idle or when this process ends. Limits count
from the size of the file.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import itertools
import json
import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.data.read._table import Table
from identification.errors import InputError

Arrays = dict[str, npt.NDArray[Any]]

MEMORY: Final = 256 << 20
"""Memory beyond what the decoder's own code takes [bytes]; twenty channels of an hour at 500 Hz
take 290 MB as numbers.
"""
EXPANSION: Final = 100
"""Bytes of memory for each byte of the file, on top of `MEMORY`: packed logs reach ten, and
Python's numbers take four times their bytes.
"""
SECONDS: Final = 4.0
"""Computing time for a small file [s]; a good one takes milliseconds once the decoder is loaded."""
BYTES_PER_SECOND: Final = 2e5
"""Slowest decoding that is waited for [bytes/s]; bags of small messages, the slowest, are read
at about 1e6.
"""
PATIENCE: Final = 10.0
"""Wall time over computing time at most: a disk or a machine may be busy."""
STARTING: Final = 60.0
"""Wall time for loading a decoder [s]."""
IDLE: Final = 120.0
"""An idle child ends after this long [s]."""
_LIBRARIES: Final = {
    "mat": ("scipy.io.matlab",),
    "hdf5": ("h5py",),
    "parquet": ("pyarrow", "pyarrow.parquet"),
    "mdf": ("asammdf",),
    "mcap": ("mcap.reader",),
    "rosbag": ("rosbags.highlevel", "rosbags.typesys"),
}
"""What a format's decoder loads; that is not the file's doing and does not count against its
limits.
"""
FORMATS: Final = frozenset(_LIBRARIES)
"""Formats that are read in the child; text and NPZ say their size beforehand and are parsed by
numpy here.
"""
_START: Final = """
import json, sys, types
places, packages = json.loads(sys.argv[1])
sys.path[:] = places
for name, path in packages.items():
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = path
from identification.data.read._child import serve
serve()
"""
"""The child takes the readers without the packages around them: that halves its start."""


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files of a folder."""
    files = [p for p in path.rglob("*") if p.is_file()] if path.is_dir() else [path]
    return sum(p.stat().st_size for p in files)


def memory_for(size: int) -> int:
    """Memory that a file of this size may take [bytes]."""
    wanted = MEMORY + EXPANSION * size
    try:
        return min(wanted, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):  # a system that does not say
        return wanted


# --- this side ------------------------------------------------------------------------------------


def open_in_child(path: Path, form: str, module: str, function: str) -> Table:
    """Open a file of a foreign format: its decoder runs in the child.

    Parameters
    ----------
    path : Path
    form : str
        One of `FORMATS`.
    module, function : str
        The opener.

    Raises
    ------
    InputError
        What the opener says; a file that ends its decoder, or takes too much memory or time.
    """
    size = size_of(path)
    task = {
        "opening": next(_OPENINGS),
        "path": str(path),
        "cwd": os.getcwd(),
        "module": module,
        "function": function,
        "form": form,
        "memory": memory_for(size),
        "seconds": SECONDS + size / BYTES_PER_SECOND,
        "forbidden": [name for name in _LIBRARIES[form] if sys.modules.get(name, sys) is None],
    }
    said, _ = CHILD.ask(task, None)

    def load(numeric: Sequence[str], text: Sequence[str]) -> Mapping[str, npt.NDArray[Any]]:
        return CHILD.ask(task, (list(numeric), list(text)))[1]

    return Table(
        said["reader"],
        tuple(said["names"]),
        load,
        said["units"],
        tuple(said["notes"]),
        said["first_row"],
    )


@final
class _Child:
    """The one child of this process; threads take turns."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._process: subprocess.Popen[bytes] | None = None

    def ask(
        self, task: Mapping[str, Any], columns: tuple[list[str], list[str]] | None
    ) -> tuple[dict[str, Any], Arrays]:
        """What the child says of a file, and the columns asked for."""
        with self._lock:
            for _ in range(2):  # an idle child may end in the very moment
                process = self._running()
                try:
                    return _exchange(process, task, columns)
                except (EOFError, BrokenPipeError):
                    code = process.wait()
                    self.end()
                    if code:
                        raise InputError(_death(code, task)) from None
                except InputError:
                    raise
                except (
                    BaseException
                ):  # a stop in the middle: what comes next from the pipe belongs to nobody
                    self.end()
                    raise
        raise InputError(
            f"{task['path']}: its decoder does not start; check the installation of Python"
        )

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is not None and self._process.poll() is not None:
            self.end()
        if self._process is None:
            packages = {
                name: list(sys.modules[name].__path__)
                for name in ("identification", "identification.data.read")
            }
            one = {
                "OMP_NUM_THREADS": "1",
                "OPENBLAS_NUM_THREADS": "1",
                "MALLOC_ARENA_MAX": "1",
                "ARROW_DEFAULT_MEMORY_POOL": "system",
            }
            self._process = subprocess.Popen(
                [sys.executable, "-c", _START, json.dumps([sys.path, packages])],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, **one},
                start_new_session=True,  # Ctrl-C is for this process
            )
        return self._process

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


def _exchange(
    process: subprocess.Popen[bytes],
    task: Mapping[str, Any],
    columns: tuple[list[str], list[str]] | None,
) -> tuple[dict[str, Any], Arrays]:
    assert process.stdin is not None
    assert process.stdout is not None
    late = threading.Timer(STARTING + PATIENCE * task["seconds"], process.kill)
    late.daemon = True
    late.start()
    try:
        process.stdin.write(json.dumps({**task, "columns": columns}).encode() + b"\n")
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
    if "refused" in said:
        raise InputError(said["refused"])
    return said, arrays


def _fill(stream: IO[bytes], array: npt.NDArray[Any]) -> None:
    view = array.reshape(-1).view(np.uint8).data if array.size else memoryview(b"")
    done = 0
    while done < len(view):
        count = stream.readinto(view[done:])  # type: ignore[attr-defined]
        if not count:
            raise EOFError
        done += count


def _death(code: int, task: Mapping[str, Any]) -> str:
    path = task["path"]
    if code == -getattr(signal, "SIGPROF", 0) or code == -getattr(signal, "SIGKILL", 9):
        return (
            f"{path}: takes more than {task['seconds']:.0f} s to decode, too long for its "
            "size: is it damaged? save it again, or export CSV or NPZ"
        )
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return f"{path}: is damaged, its decoder fails on it ({name}): save it again"


# --- the child ------------------------------------------------------------------------------------


def serve() -> None:
    """Answer requests from standard input until it ends."""
    source = os.fdopen(os.dup(0), "rb", buffering=0)
    target = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what decoders print is no answer
    opened: tuple[str, Table] | None = None
    for line in _lines(source):
        task = json.loads(line)
        columns = task.pop("columns")
        key = json.dumps(task)
        said: dict[str, Any] = {}
        arrays: Arrays = {}
        try:
            os.chdir(task["cwd"])
            if opened is None or opened[0] != key:
                opened = None
            for name in _LIBRARIES[task["form"]]:
                with contextlib.suppress(ImportError):  # the opener says what is missing
                    importlib.import_module(name)
            module = importlib.import_module(f"identification.data.read.{task['module']}")
            with _forbidden(task["forbidden"]), _limited(task["memory"], task["seconds"]):
                table = (
                    opened[1]
                    if opened is not None
                    else getattr(module, task["function"])(Path(task["path"]))
                )
                opened = (key, table)
                if columns is not None:
                    arrays = {n: _plain(a, n) for n, a in table.load(*columns).items()}
            said = {
                "reader": table.reader,
                "names": list(table.names),
                "units": dict(table.units),
                "notes": list(table.notes),
                "first_row": table.first_row,
            }
        except InputError as error:
            said = {"refused": str(error)}
        except MemoryError:
            opened, arrays = None, {}
            said = {
                "refused": f"{task['path']}: takes more than {task['memory'] / 1e6:.0f} MB of "
                "memory, too much for its size: export fewer channels"
            }
        except Exception as error:  # decoders raise whatever their parsers meet in a damaged file
            opened, arrays = None, {}
            detail = " ".join(f"{type(error).__name__}: {error}".split())[:160]
            said = {
                "refused": f"{task['path']}: is damaged, its decoder fails on it ({detail}): "
                "save it again"
            }
        said["arrays"] = [(n, a.dtype.str, a.shape) for n, a in arrays.items()]
        target.write(json.dumps(said).encode() + b"\n")
        for array in arrays.values():
            if array.size:
                target.write(array.reshape(-1).view(np.uint8).data)
        target.flush()


@contextlib.contextmanager
def _forbidden(names: Sequence[str]) -> Iterator[None]:
    """An import that the other side forbids (``sys.modules[name] = None``) is forbidden here
    too.
    """
    before = {name: sys.modules.get(name) for name in names}
    modules: dict[str, Any] = sys.modules
    modules.update(dict.fromkeys(names))
    try:
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del modules[name]
            else:
                modules[name] = module


def _plain(array: npt.NDArray[Any], name: str) -> npt.NDArray[Any]:
    if array.dtype.kind not in "fiubUS":
        raise InputError(f"column {name!r} is not numeric: choose another")
    return np.ascontiguousarray(array)


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
def _limited(memory: int, seconds: float) -> Iterator[None]:
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


_OPENINGS: Final = itertools.count()
"""Number of an opening: a file that was written anew under its name is another one."""
_FORGOTTEN: Final[list[subprocess.Popen[bytes]]] = []
CHILD: Final = _Child()
"""The child of this process."""
atexit.register(CHILD.end)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=CHILD.forget)
