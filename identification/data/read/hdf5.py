"""HDF5 and MATLAB 7.3 files, by h5py."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from identification.data.read._table import Table, from_arrays, missing_package
from identification.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path


def open_hdf5(path: Path) -> Table:
    """Open an HDF5 file: datasets by path (``group/name``), units from a ``unit`` or ``units``
    attribute.

    Raises
    ------
    InputError
        If h5py is missing, the file is damaged or holds no numeric vector.
    """
    try:
        import h5py
    except ImportError:
        raise missing_package("h5py", "hdf5", "HDF5 and MAT 7.3 files", str(path)) from None
    arrays: dict[str, Any] = {}
    units: dict[str, str] = {}

    def visit(name: str, item: Any) -> None:
        if (
            not isinstance(item, h5py.Dataset)
            or name.startswith("#refs#")
            or item.dtype.kind not in "fiubOS"
        ):
            return
        if item.attrs.get("MATLAB_class") in {b"char", b"cell", b"logical"} or item.ndim > 2:
            return
        value = item.asstr()[()] if h5py.check_string_dtype(item.dtype) else item[()]
        arrays[name] = np.asarray(value)
        for key in ("unit", "units", "Unit", "Units"):
            text = item.attrs.get(key)
            if text is not None:
                units[name] = text.decode() if isinstance(text, bytes) else str(text)

    try:
        with h5py.File(path, "r") as file:
            file.visititems(visit)
    except Exception as error:  # h5py raises errors of many kinds on a damaged file
        raise InputError(
            f"{path}: is not a readable HDF5 file ({type(error).__name__}): save it again"
        ) from None
    return from_arrays("HDF5", arrays, str(path), units)
