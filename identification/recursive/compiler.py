"""Builds small C sources into shared libraries and keeps them in the user's cache folder.

A library's name is the hash of its source, compiler and flags. Each process writes its own
temporary file and renames it, so that processes that build the same source at once do not meet.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import importlib.util
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import final

CACHE_VARIABLE = "IDENTIFICATION_CACHE"
COMPILER_VARIABLE = "IDENTIFICATION_CC"
# No contraction to fused multiply-add: the compiled replay must equal the interpreted step. NaN
# keeps its meaning
# (no -ffast-math). C90 lets CasADi's fmin and fmax become single instructions, hidden visibility
# lets them be inlined.
_FLAGS = (
    "-O2",
    "-std=gnu90",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-fvisibility=hidden",
    "-shared",
)
_TIMEOUT_SECONDS = 300.0
MOST_KEPT = 64
"""Files of :func:`kept`: some 20 MB where each is a library of an FMU."""


@final
class NoCompilerError(RuntimeError):
    """There is no C compiler, or it failed; the message says which."""


def cache_folder() -> Path:
    """The user's cache folder for built libraries; the environment variable
    IDENTIFICATION_CACHE moves it.
    """
    given = os.environ.get(CACHE_VARIABLE)
    if given:
        return Path(given)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or str(Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = str(Path.home() / "Library" / "Caches")
    else:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "identification"


def find_compiler() -> tuple[str, ...] | None:
    """The command that compiles C: IDENTIFICATION_CC, gcc, clang, cc, or ziglang's cc; None without
    one.

    IDENTIFICATION_CC set to "none" switches compiling off.
    """
    given = os.environ.get(COMPILER_VARIABLE)
    if given:
        if given.lower() == "none":
            return None
        found = shutil.which(given)
        return (found,) if found else None
    for name in ("gcc", "clang", "cc"):
        found = shutil.which(name)
        if found:
            return (found,)
    if importlib.util.find_spec("ziglang") is not None:
        return (sys.executable, "-m", "ziglang", "cc")
    return None


def build(source: str, name: str) -> ctypes.CDLL:
    """Load the shared library of a C source, building it where the cache does not hold it yet.

    Parameters
    ----------
    source
        Complete C source.
    name
        Start of the file's name in the cache.

    Raises
    ------
    NoCompilerError
        No compiler was found, it failed, or the disk has no room for what it makes.
    """
    compiler = find_compiler()
    if compiler is None:
        raise NoCompilerError("no C compiler found (gcc, clang, cc or the Python package ziglang)")
    flags = [*_FLAGS, *(["-fPIC"] if sys.platform != "win32" else [])]
    identity = "\0".join(
        [source, *compiler_identity(compiler), *flags, sys.platform, platform.machine(), "1"]
    )
    digest = hashlib.sha256(identity.encode()).hexdigest()[:32]
    file_name = f"{name}-{digest}{_suffix()}"
    try:
        target = _usable_folder() / file_name
        if target.is_file():
            with contextlib.suppress(OSError):  # a damaged file: build it again
                return ctypes.CDLL(str(target))
        _compile(source, compiler, flags, target)
    except OSError as error:  # a full disk: what needs no compiler does without one
        raise NoCompilerError(
            f"the compiled library cannot be written ({error.strerror or error})"
        ) from error
    try:
        return ctypes.CDLL(str(target))
    except OSError as error:
        raise NoCompilerError(f"the compiled library cannot be loaded: {error}") from error


def kept(name: str, identity: Sequence[str | bytes], make: Callable[[], bytes]) -> bytes:
    """What `make` returns, from the cache where it was made before of the same things.

    A file that is damaged is made anew; where the cache cannot be written, nothing is kept. The
    newest :data:`MOST_KEPT` of a name stay.

    Parameters
    ----------
    name
        Start of the file's name in the cache.
    identity
        Everything that the result follows from.
    make
        Makes it; what it raises is raised.
    """
    parts = [x if isinstance(x, bytes) else x.encode() for x in identity]
    digest = hashlib.sha256(b"".join(len(x).to_bytes(8, "big") + x for x in parts)).hexdigest()
    folder = _shared_folder()
    if folder is None:
        return make()
    place = folder / f"{name}-{digest[:32]}"
    with contextlib.suppress(OSError):
        found = place.read_bytes()
        if hashlib.sha256(found[32:]).digest() == found[:32]:
            return found[32:]
    made = make()
    with contextlib.suppress(OSError):
        with tempfile.TemporaryDirectory(prefix="build-", dir=place.parent) as temporary:
            written = Path(temporary) / place.name
            written.write_bytes(hashlib.sha256(made).digest() + made)
            os.replace(written, place)
        old = sorted(place.parent.glob(f"{name}-*"), key=lambda x: x.stat().st_mtime)
        for one in old[:-MOST_KEPT]:
            one.unlink(missing_ok=True)
    return made


def _suffix() -> str:
    return {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")


def compiler_identity(compiler: tuple[str, ...]) -> list[str]:
    """Path, size and time of the compiler's file: another compiler builds anew."""
    try:
        about = Path(shutil.which(compiler[0]) or compiler[0]).resolve().stat()
    except OSError:
        return list(compiler)
    return [*compiler, str(about.st_size), str(about.st_mtime_ns)]


def _usable_folder() -> Path:
    """The cache folder, or a private one of this process where that is none to use."""
    return _shared_folder() or _private_folder()


def _shared_folder() -> Path | None:
    """The cache folder; None where it cannot be trusted or written."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        about = folder.stat()
    except OSError:
        return None
    if hasattr(os, "getuid") and (about.st_uid != os.getuid() or about.st_mode & 0o022):
        return None  # another user could plant a library there
    return folder if os.access(folder, os.W_OK | os.X_OK) else None


@functools.lru_cache(maxsize=1)
def _private_folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="identification-"))


def run_whole(command: list[str], seconds: float) -> subprocess.CompletedProcess[str]:
    """Run a command; when its time is over, or this process is interrupted, what it has started
    ends with it (a driver that is killed leaves its compiler running).

    Raises
    ------
    OSError
        It cannot be started.
    subprocess.TimeoutExpired
        It took longer than `seconds`.
    """
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # a group of its own; Windows has none and ends the driver alone
    ) as process:
        try:
            out, err = process.communicate(timeout=seconds)
        except BaseException:
            if sys.platform == "win32":
                process.kill()
            else:
                os.killpg(process.pid, signal.SIGKILL)
            raise
    return subprocess.CompletedProcess(command, process.returncode, out, err)


def _compile(source: str, compiler: tuple[str, ...], flags: list[str], target: Path) -> None:
    """Compile in a temporary folder beside the target, then rename."""
    with tempfile.TemporaryDirectory(prefix="build-", dir=target.parent) as temporary:
        code, library = Path(temporary) / "source.c", Path(temporary) / target.name
        code.write_text(source, encoding="utf-8")
        command = [
            *compiler,
            *flags,
            "-o",
            str(library),
            str(code),
            *([] if sys.platform == "win32" else ["-lm"]),
        ]
        try:
            done = run_whole(command, _TIMEOUT_SECONDS)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise NoCompilerError(f"the C compiler {compiler[0]} did not run: {error}") from error
        if done.returncode != 0 or not library.is_file():
            last = (done.stderr.strip() or "no message").splitlines()[-1]
            raise NoCompilerError(f"the C compiler {compiler[0]} failed: {last}")
        try:
            os.replace(library, target)
        except OSError:
            if not target.is_file():  # Windows: another process holds the same library open
                raise NoCompilerError(
                    f"the cache folder {target.parent} cannot be written"
                ) from None
