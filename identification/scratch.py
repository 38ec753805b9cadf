"""What a run leaves on the disk while it works: a temporary folder of its own, locks on its
results, and nothing of either after a kill once the next run has started.

The system gives a lock free when its process ends, however it ends. So what lies under a lock that
can be taken belongs to nobody any more. Where the system has no such locks (Windows) a run cleans
up behind itself only.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import os
import re
import secrets
import shutil
import signal
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import IO, Final

from identification.errors import InputError

_PREFIX: Final = "irj-run-"
_LOCK: Final = ".lock"
_ENDS_LATER: Final = "pymp-"
"""Folders of multiprocessing, which removes them itself when the interpreter ends, and prints a
trace where they are gone.
"""
TRIES: Final = 10
"""Times a lock is tried whose file goes just then."""
_HELD: Final[dict[str, contextlib.ExitStack]] = {}
"""What gives the locks of this process free, by what they stand for."""
_OUTER: Final[list[str]] = []
"""The folder for temporary files outside that of the run."""
_KEPT: Final = 100
"""Bytes of a name that stand in the name of its half-written file."""
_LEFT: Final = re.compile(
    r"\.(?:.*\.[0-9a-f]{8}\.part|.*-[a-z0-9_]{8}\.part|build-[a-z0-9_]{8}|write-[a-z0-9_]{8})"
)
"""Names of what is half written beside results: parts of files, folders of a build."""


def outer_folder() -> Path:
    """Folder for temporary files that outlive the run; where none can be written, the one in which
    they would be.
    """
    if _OUTER:
        return Path(_OUTER[0])
    try:
        return Path(tempfile.gettempdir())
    except OSError:  # every disk is full: whoever writes there says so
        return Path(os.environ.get("TMPDIR") or ("/tmp" if os.name == "posix" else os.curdir))  # noqa: S108


@contextlib.contextmanager
def folder_beside(place: Path, prefix: str) -> Iterator[str]:
    """A temporary folder in a place, removed at its end: a signal that ends the run waits until the
    folder is one that is removed.
    """
    mask = getattr(signal, "pthread_sigmask", None)  # not on Windows
    before = mask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM}) if mask else None
    try:
        made = tempfile.TemporaryDirectory(prefix=prefix, dir=place)
        with made as name:
            if mask:
                mask(signal.SIG_SETMASK, before)
            yield name
    finally:
        if mask:
            mask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def deaf_children() -> Iterator[None]:
    """Processes that are started here hear no Ctrl-C, which a terminal sends to them as well: one
    that still loads its modules would print a trace. The parent ends them.
    """
    mask = getattr(signal, "pthread_sigmask", None)  # not on Windows
    if mask is None:
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # its start takes the mask off again
    before = mask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        mask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def own_folder() -> Iterator[None]:
    """Keep all temporary files of the run, and of its children, in one folder that is removed at
    its end; remove those of runs that were killed.
    """
    outer = outer_folder()
    before = tempfile.tempdir, os.environ.get("TMPDIR")
    try:
        _swept_runs(outer)
        made = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=outer))
        lock = _taken(made / _LOCK)
    except OSError:  # no room for temporary files: whoever needs one says so
        yield
        return
    _OUTER.append(str(outer))
    tempfile.tempdir = str(made)
    os.environ["TMPDIR"] = str(made)
    owner = os.getpid()
    gone = partial(_removed, made, lock, owner)
    atexit.register(gone)  # before multiprocessing is loaded: called after its own end
    try:
        yield
    finally:
        if os.getpid() == owner:  # not in a fork
            tempfile.tempdir = before[0]
            _OUTER.clear()
            if before[1] is None:
                os.environ.pop("TMPDIR", None)
            else:
                os.environ["TMPDIR"] = before[1]
            if any(made.glob(f"{_ENDS_LATER}*")):
                for left in made.iterdir():
                    if not left.name.startswith((_ENDS_LATER, _LOCK)):
                        _rid(left)
            else:
                atexit.unregister(gone)
                gone()


def _removed(made: Path, lock: IO[bytes] | None, owner: int) -> None:
    """Remove the folder of a run, in the process that made it."""
    if os.getpid() == owner:
        shutil.rmtree(made, ignore_errors=True)
        if lock is not None:
            lock.close()


def _rid(left: Path) -> None:
    if left.is_dir() and not left.is_symlink():
        shutil.rmtree(left, ignore_errors=True)
    else:
        left.unlink(missing_ok=True)


def part_of(target: Path) -> Path:
    """Where a file is written before it replaces its target: beside it, under a name that is no
    longer than a file system takes, and that :func:`sweep` knows.
    """
    return target.with_name(f"{_start(target)}{secrets.token_hex(4)}.part")


def _start(target: Path) -> str:
    kept = os.fsencode(target.name)[:_KEPT]
    return f".{kept.decode(errors='ignore')}."


def hold(target: Path) -> None:
    """Hold a result, a file or a folder, until `release` or the end of the process, and remove
    what a killed run left half written beside (in) it.

    Raises
    ------
    InputError
        Another process holds it.
    """
    place = os.path.realpath(target)
    if place in _HELD:
        return
    with contextlib.ExitStack() as locks:
        try:
            found = _lock_beside(place, locks), _lock_on(place, locks)
        except BlockingIOError:
            raise InputError(
                f"{place}: another irj is writing it; wait for it or write somewhere else"
            ) from None
        if not any(found):
            return
        _HELD[place] = locks.pop_all()
    folder = Path(place)
    if folder.is_dir():
        sweep(folder)
    else:
        sweep(folder.parent, _start(folder))


def release(target: Path | None = None) -> None:
    """Give a result free, or all of them."""
    for place in list(_HELD) if target is None else [os.path.realpath(target)]:
        if (locks := _HELD.pop(place, None)) is not None:
            locks.close()


def sweep(folder: Path, start: str = "") -> None:
    """Remove what is half written in a folder that is held, and begins so."""
    with contextlib.suppress(OSError):
        for left in folder.iterdir():
            if left.name.startswith(start) and _LEFT.fullmatch(left.name):
                if left.is_dir() and not left.is_symlink():
                    shutil.rmtree(left, ignore_errors=True)
                else:
                    left.unlink(missing_ok=True)


def _swept_runs(outer: Path) -> None:
    """Remove the temporary folders and locks of runs that are no more."""
    for place in _lock_folder(outer).glob("*"):
        with contextlib.suppress(OSError):
            if (free := _taken(place, new=False)) is not None:
                _given_back(free)
    for left in outer.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            if not left.is_symlink() and (lock := _taken(left / _LOCK, new=False)) is not None:
                shutil.rmtree(left, ignore_errors=True)
                lock.close()


def _lock_beside(place: str, locks: contextlib.ExitStack) -> bool:
    """Take the lock of a result, which lies among the temporary files; False where there are no
    locks, or no folder for them.

    Raises
    ------
    BlockingIOError
        Another process has it.
    """
    user, folder = _user(), _lock_folder(outer_folder())
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
        if about.st_uid != user or folder.is_symlink() or about.st_mode & 0o022:
            return False  # somebody else's folder
        lock = _taken(folder / hashlib.sha256(os.fsencode(place)).hexdigest()[:32])
    except BlockingIOError:
        raise
    except OSError:
        return False
    if lock is None:
        return False
    locks.callback(_given_back, lock)
    return True


def _lock_on(place: str, locks: contextlib.ExitStack) -> bool:
    """Take a folder itself, as far as it is there and its file system has such locks: processes
    with other folders for temporary files meet here.

    Raises
    ------
    BlockingIOError
        Another process has it.
    """
    try:
        import fcntl

        handle = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except (ImportError, OSError):
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(handle)
        if isinstance(error, BlockingIOError):
            raise
        return False
    locks.callback(os.close, handle)
    return True


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0


def _lock_folder(outer: Path) -> Path:
    return outer / f"irj-locks-{_user()}"


def _given_back(lock: IO[bytes]) -> None:
    """Remove a lock of a result; `_taken` looks whether its file is still there."""
    path = Path(os.fsdecode(lock.name))
    with contextlib.suppress(OSError):
        path.unlink()
    lock.close()
    with contextlib.suppress(OSError):  # others hold results
        path.parent.rmdir()


def _taken(path: Path, new: bool = True) -> IO[bytes] | None:
    """An open file under a lock; None where the system has no locks.

    Raises
    ------
    BlockingIOError
        Another process has it.
    OSError
        It cannot be opened.
    """
    try:
        import fcntl
    except ImportError:
        return None
    for _ in range(TRIES):
        stream = open(path, "r+b", opener=_opener if new else _opener_of_old)  # noqa: SIM115
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and os.path.samestat(os.fstat(stream.fileno()), path.stat()):
                return stream
        except OSError:
            stream.close()
            raise
        stream.close()  # its owner has removed it in between
    return None


def _opener(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CREAT, 0o600)


def _opener_of_old(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW)


__all__ = ["deaf_children", "hold", "outer_folder", "own_folder", "part_of", "release", "sweep"]
