"""Uploads: streamed to disk under a limit, and looked at before they are unpacked."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import AsyncIterator
from pathlib import Path
from shutil import disk_usage
from typing import Any, Final

from identification.errors import InputError
from identification.scratch import part_of
from workbench.page.session import naming

MAX_UPLOAD: Final = 1 << 30
"""Largest upload in bytes."""
MAX_UNPACKED = 2 << 30
"""Largest size of an archive's content in bytes."""
RESERVE: Final = 256 << 20
"""Free space that an upload must leave on the disk in bytes."""


class TooLargeError(InputError):
    """An upload over the limit."""


def megabytes(size: float) -> str:
    """Size in MB for a sentence."""
    return f"{size / 1e6:,.0f} MB"


def refuse_size(name: str, size: int, limit: int, folder: Path) -> None:
    """Refuse an upload by the size it announces.

    Raises
    ------
    TooLargeError
    """
    if size > limit:
        raise TooLargeError(
            f"{name}: {megabytes(size)} is over the limit of {megabytes(limit)}; save it as NPZ, "
            "cut it, or give its path on the command line: irj app FILE"
        )
    if disk_usage(folder).free < size + RESERVE:
        raise TooLargeError(
            f"{name}: not enough space on the disk of {folder} for {megabytes(size)}; free some"
        )


async def stream_to(path: Path, chunks: AsyncIterator[bytes], limit: int) -> int:
    """Write an upload chunk by chunk; a part that stays behind is removed.

    Raises
    ------
    TooLargeError
        More than `limit` bytes came.
    """
    part = part_of(path)
    size = 0
    try:
        with naming(path), part.open("wb") as stream:
            async for chunk in chunks:
                size += len(chunk)
                if size > limit:
                    raise TooLargeError(
                        f"{path.name}: over the limit of {megabytes(limit)}; save it as NPZ or "
                        "cut it"
                    )
                stream.write(chunk)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return size


def check_unpacked(path: Path, name: str, limit: int | None = None) -> None:
    """Refuse an archive that unpacks to more than the limit, without unpacking it.

    Raises
    ------
    InputError
        A bomb, in an NPZ or MAT file; the other formats are decoded under a limit of memory.
    """
    limit = MAX_UNPACKED if limit is None else limit
    with path.open("rb") as stream:
        head = stream.read(8)
    if head.startswith(b"PK\x03\x04"):
        size = _zip_size(path, name)
    elif head.startswith(b"MATLAB 5"):
        size = _mat_size(path, limit)
    else:
        return
    if size > limit:
        raise InputError(
            f"{name}: unpacks to more than {megabytes(limit)} from "
            f"{megabytes(path.stat().st_size)}; it is not loaded; export fewer channels"
        )


def _zip_size(path: Path, name: str) -> int:
    try:
        with zipfile.ZipFile(path) as archive:
            return sum(item.file_size for item in archive.infolist())
    except (zipfile.BadZipFile, OSError) as error:
        raise InputError(
            f"{name}: is not a readable NPZ archive ({error}); save it again"
        ) from None


def _mat_size(path: Path, limit: int) -> int:
    """Unpacked size of the compressed elements of a MAT v5 file, counted up to the limit."""
    total = 0
    with path.open("rb") as stream:
        header = stream.read(128)
        order: Any = "little" if header[126:128] == b"IM" else "big"
        while len(tag := stream.read(8)) == 8 and total <= limit:
            kind, size = int.from_bytes(tag[:4], order), int.from_bytes(tag[4:], order)
            if kind != 15:
                total += size
                stream.seek(size, 1)
                continue
            unpacker, left = zlib.decompressobj(), size
            while left > 0 and total <= limit and (chunk := stream.read(min(left, 1 << 16))):
                left -= len(chunk)
                total += _unpacked(unpacker, chunk, limit - total)
            stream.seek(left, 1)
    return total


def _unpacked(unpacker: Any, chunk: bytes, limit: int) -> int:
    total = 0
    try:
        while chunk and total <= limit:
            total += len(unpacker.decompress(chunk, 1 << 20))
            chunk = unpacker.unconsumed_tail
    except zlib.error:
        return total
    return total
