"""NumPy archives: one array a channel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from identification.data.read._table import Table, from_arrays
from identification.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path


def open_npz(path: Path) -> Table:
    """Open an NPZ archive; pickled objects are refused.

    Raises
    ------
    InputError
        If the archive is damaged, holds objects or no numeric vector.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:  # numpy and zipfile raise errors of many kinds on a damaged archive
        detail = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{path}: is not a readable NPZ archive ({detail}): save plain numeric arrays again"
        ) from None
    return from_arrays("NPZ", arrays, str(path))
