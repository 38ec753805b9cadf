"""HDF5 and MATLAB 7.3 files, by h5py."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from identification.data.read._table import Layout, Table, missing_package, on_demand
from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
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
    layouts: dict[str, Layout] = {}
    units: dict[str, str] = {}

    def visit(name: str, item: Any) -> None:
        if (
            not isinstance(item, h5py.Dataset)
            or name.startswith("#refs#")
            or item.dtype.kind not in "fiubOS"
        ):
            return
        if (
            item.attrs.get("MATLAB_class") in {b"char", b"cell", b"logical"}
            or item.shape is None
            or item.ndim > 2
        ):
            return
        layouts[name] = item.shape, item.dtype
        for key in ("unit", "units", "Unit", "Units"):
            text = item.attrs.get(key)
            if text is not None:
                units[name] = text.decode() if isinstance(text, bytes) else str(text)

    try:
        with h5py.File(path, "r") as file:
            file.visititems(visit)
    except MemoryError:
        raise
    except Exception as error:  # h5py raises errors of many kinds on a damaged file
        raise InputError(
            f"{path}: is not a readable HDF5 file ({type(error).__name__}): save it again"
        ) from None

    def fetch(names: Sequence[str]) -> Mapping[str, npt.NDArray[Any]]:
        try:
            with h5py.File(path, "r") as file:
                return {name: np.asarray(file[name][()]) for name in names}
        except MemoryError:
            raise
        except Exception as error:  # as above
            raise InputError(
                f"{path}: is damaged ({type(error).__name__}): save it again"
            ) from None

    return on_demand("HDF5", layouts, fetch, str(path), units)
