"""MATLAB files of version 4 to 7 (7.3 files are HDF5: see `identification.data.read.hdf5`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from identification.data.read._table import Table, from_arrays
from identification.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path


def open_mat(path: Path) -> Table:
    """Open a MAT file: vectors by variable name, those in structs as ``struct.field``, matrices by
    column.

    Raises
    ------
    InputError
        If the file is damaged or holds no numeric vector.
    """
    from scipy.io import loadmat

    try:
        content = loadmat(str(path), struct_as_record=False, squeeze_me=True)
    except MemoryError:
        raise
    except Exception as error:  # scipy raises whatever its parser meets in a damaged file
        raise InputError(
            f"{path}: is not a readable MAT file ({type(error).__name__}): save it again"
        ) from None
    flat: dict[str, Any] = {}
    for name, value in content.items():
        if not name.startswith("__"):
            _flatten(name, value, flat)
    return from_arrays("MAT v5", flat, str(path))


def _flatten(name: str, value: Any, into: dict[str, Any]) -> None:
    fields = getattr(value, "_fieldnames", None)
    if fields:
        for key in fields:
            _flatten(f"{name}.{key}", getattr(value, key), into)
    elif isinstance(value, np.ndarray):
        into[name] = value
