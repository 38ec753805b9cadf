"""What is no plain file of its own: a packed one (.gz, .bz2, .xz) and a pipe become a file for
a time.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
import shutil
import stat
import tempfile
import weakref
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

import numpy.typing as npt

from identification.data.read._child import memory_for
from identification.data.read._table import Table
from identification.errors import InputError

_BLOCK: Final = 1 << 20
_PACKED: Final = ((b"\x1f\x8b", gzip.open), (b"BZh", bz2.open), (b"\xfd7zXZ\x00", lzma.open))
"""First bytes of a packed file, and what unpacks it."""
_PIPE: Final = 4 << 30
"""Most that is taken from a pipe [bytes]; it does not say its size."""
T = TypeVar("T")


class _Readable(Protocol):
    """What bytes come from."""

    def read(self, size: int, /) -> bytes:
        """At most so many bytes; none at the end."""


def is_pipe(path: Path) -> bool:
    """Whether a path can be read once only, as ``<(zcat run.csv.gz)`` of a shell."""
    try:
        return stat.S_ISFIFO(path.stat().st_mode)
    except OSError:
        return False


def from_pipe(path: Path) -> Path:
    """A file with what comes through a pipe, in a folder of its own that the caller removes.

    Raises
    ------
    InputError
        More than fits.
    """
    with path.open("rb") as stream:
        return _copied(stream, path, path.name, _PIPE)


def opened_packed(path: Path, open_plain: Callable[[Path], Table]) -> Table | None:
    """The table in a packed file; None where the file is not packed.

    Raises
    ------
    InputError
        A damaged file, or one that unpacks to too much for its size.
    """
    with path.open("rb") as stream:
        head = stream.read(6)
    unpack = next((found for magic, found in _PACKED if head.startswith(magic)), None)
    if unpack is None:
        return None
    inside = path.stem if path.suffix.lower() in {".gz", ".bz2", ".xz"} else path.name
    try:
        with unpack(path, "rb") as packed:
            place = _copied(packed, path, inside, memory_for(path.stat().st_size))
    except (
        OSError,
        EOFError,
        ValueError,
        lzma.LZMAError,
        zlib.error,
    ) as error:  # OSError is gzip's word for a damaged file, too
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path}: is not a readable packed file ({error}): pack it again"
        ) from None
    try:
        table = renamed(lambda: open_plain(place), place, path)
    except BaseException:
        shutil.rmtree(place.parent, ignore_errors=True)
        raise

    def load(numeric: Sequence[str], text: Sequence[str]) -> Mapping[str, npt.NDArray[Any]]:
        return renamed(lambda: table.load(numeric, text), place, path)

    made = replace(table, load=load)
    weakref.finalize(load, shutil.rmtree, place.parent, True)
    return made


def renamed(work: Callable[[], T], place: Path, path: Path) -> T:
    """Do some work on a copy; what it says names the file that the user gave."""
    try:
        return work()
    except InputError as error:
        raise InputError(str(error).replace(str(place), str(path))) from None


def _copied(stream: _Readable, path: Path, name: str, most: int) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="irj-"))
    try:
        most = min(most, shutil.disk_usage(folder).free - (256 << 20))
        size = 0
        with (folder / (os.path.basename(name) or "record")).open("wb") as target:
            while block := stream.read(_BLOCK):
                size += len(block)
                if size > most:
                    raise InputError(
                        f"{path}: unpacks to more than {most / 1e6:.0f} MB, too much for its "
                        "size or for the disk: cut it"
                    )
                target.write(block)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return Path(target.name)


__all__ = ["from_pipe", "is_pipe", "opened_packed", "renamed"]
