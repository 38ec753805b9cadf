"""Tell a file's format from its first bytes."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Final

from identification.data.read._child import FORMATS, open_in_child
from identification.data.read._source import opened_packed
from identification.data.schema import meant
from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from identification.data.read._table import Table

_BINARY: Final = {
    ".mat": "MAT",
    ".npz": "NPZ",
    ".h5": "HDF5",
    ".hdf5": "HDF5",
    ".hdf": "HDF5",
    ".parquet": "Parquet",
    ".mf4": "MDF",
    ".mdf": "MDF",
    ".dat4": "MDF",
    ".bag": "ROS bag",
    ".mcap": "MCAP",
    ".db3": "ROS 2 bag",
}
_OPENERS: Final = {
    "text": ("csv", "open_csv"),
    "mat": ("mat", "open_mat"),
    "npz": ("npz", "open_npz"),
    "hdf5": ("hdf5", "open_hdf5"),
    "parquet": ("parquet", "open_parquet"),
    "mdf": ("mdf", "open_mdf"),
    "rosbag": ("rosbag", "open_rosbag"),
    "mcap": ("mcap", "open_mcap"),
}


def _sniff(path: Path) -> str:
    with path.open("rb") as stream:
        head = stream.read(1024)
    if head.startswith(b"MATLAB 5.0 MAT-file"):
        return "mat"
    if head.startswith(b"\x89HDF\r\n\x1a\n") or head[512:520] == b"\x89HDF\r\n\x1a\n":
        return "hdf5"
    for magic, form in (
        (b"PK\x03\x04", "npz"),
        (b"PAR1", "parquet"),
        (b"MDF     ", "mdf"),
        (b"UnFinMF ", "mdf"),
        (b"#ROSBAG V2.0", "rosbag"),
        (b"\x89MCAP0\r\n", "mcap"),
        (b"SQLite format 3\x00", "rosbag"),
    ):
        if head.startswith(magic):
            return form
    return "text"


def _format(path: Path) -> str:
    try:
        if path.is_dir():
            if (path / "metadata.yaml").is_file():
                return "rosbag"
            raise InputError(f"{path}: is a folder: name the file in it")
        if not path.exists():
            beside = path.parent.iterdir() if path.parent.is_dir() else ()
            near = meant(path.name, (p.name for p in beside if p.is_file()))
            raise InputError(f"{path}: there is no such file: check the path{near}")
        if path.stat().st_size == 0:
            raise InputError(f"{path}: is empty (0 bytes): record again or give another file")
        form = _sniff(path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}): check path and permissions"
        ) from None
    expected = _BINARY.get(path.suffix.lower())
    if form == "text" and expected is not None:
        raise InputError(
            f"{path}: is not a {expected} file, whatever its name says: rename it to .csv if it "
            "is text, or export it again"
        )
    return form


def open_table(path: Path) -> Table:
    """Open a measurement file, whatever its format.

    Parameters
    ----------
    path : Path
        File, or the folder of a ROS 2 bag.

    Raises
    ------
    InputError
        If there is no such file, it is empty, of no known format, or a package for it is missing.
    """
    form = _format(path)
    if form == "text" and (table := opened_packed(path, open_table)) is not None:
        return table
    module, function = _OPENERS[form]
    if form in FORMATS:
        return open_in_child(path, form, module, function)
    opener: Callable[[Path], Table] = getattr(
        importlib.import_module(f"identification.data.read.{module}"), function
    )
    return opener(path)
