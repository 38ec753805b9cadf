"""NumPy archives: one array a channel, read when it is asked for."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping, Sequence
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from identification.data.read._child import memory_for
from identification.data.read._table import Layout, Table, on_demand
from identification.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

_MEMBERS: Final = 4096
"""Arrays of an archive at most; a logger with that many channels gives them as one matrix."""


def open_npz(path: Path) -> Table:
    """Open an NPZ archive; pickled objects are refused.

    Raises
    ------
    InputError
        If the archive is damaged, holds objects or no numeric vector, or takes too much memory.
    """
    room = memory_for(path.stat().st_size)
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.namelist()
            if len(members) > _MEMBERS:
                raise ValueError(f"{len(members)} members, more than {_MEMBERS}")
            layouts = {
                name.removesuffix(".npy"): _layout(archive, name)
                for name in members
                if name.endswith(".npy")
            }
    except Exception as error:  # numpy and zipfile raise errors of many kinds on a damaged archive
        raise _damaged(path, error) from None

    def fetch(names: Sequence[str]) -> Mapping[str, npt.NDArray[Any]]:
        size = sum(math.prod(layouts[n][0]) * layouts[n][1].itemsize for n in names)
        if size > room:
            raise InputError(
                f"{path}: unpacks to {size / 1e6:.0f} MB, too much for its size: export fewer "
                "channels"
            )
        try:
            with np.load(path, allow_pickle=False) as archive:
                return {name: np.asarray(archive[name]) for name in names}
        except Exception as error:  # as above
            raise _damaged(path, error) from None

    return on_demand("NPZ", layouts, fetch, str(path))


def _layout(archive: zipfile.ZipFile, name: str) -> Layout:
    """Shape and type of a member, from its first bytes."""
    with archive.open(name) as stream:
        shape, kind = _header(stream)
    if kind.hasobject:
        raise ValueError(f"{name.removesuffix('.npy')} holds Python objects")
    size = math.prod(shape) * max(kind.itemsize, 1)
    if min(shape, default=0) < 0 or size > min(archive.getinfo(name).file_size, 1 << 62):
        raise ValueError(f"{name.removesuffix('.npy')} is cut off")
    return shape, kind


def _header(stream: IO[bytes]) -> Layout:
    version = npy.read_magic(stream)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, kind = read(stream)
    return shape, kind


def _damaged(path: Path, error: Exception) -> InputError:
    detail = str(error).splitlines()[0] if str(error) else type(error).__name__
    return InputError(
        f"{path}: is not a readable NPZ archive ({detail}): save plain numeric arrays again"
    )
