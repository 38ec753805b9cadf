"""Foreign decoders in a process of their own, with limits: a file that kills them, or fills the
memory, is one line.

The child decodes and hands plain arrays back over a pipe. It starts with the first file that needs
it, serves the files that follow, and ends when it is idle or when this process ends. Limits count
from the size of the file.
"""

from __future__ import annotations

import contextlib
import importlib
import itertools
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models.child.process import (
    Answer,
    Arrays,
    Child,
    Task,
    answer,
    ended_by,
    limited,
    out_of_time,
)
from identification.data.read._table import Table
from identification.errors import InputError

MEMORY: Final = 256 << 20
"""Memory beyond what the decoder's own code takes [bytes]; twenty channels of an hour at 500 Hz
take 290 MB as numbers.
"""
EXPANSION: Final = 100
"""Bytes of memory for each byte of the file, on top of `MEMORY`: packed logs reach ten, and
Python's numbers take four times their bytes.
"""
SECONDS: Final = 4.0
"""Computing time for a small file [s]; a good one takes milliseconds once the decoder is loaded."""
BYTES_PER_SECOND: Final = 2e5
"""Slowest decoding that is waited for [bytes/s]; bags of small messages, the slowest, are read
at about 1e6.
"""
PATIENCE: Final = 10.0
"""Wall time over computing time at most: a disk or a machine may be busy."""
STARTING: Final = 60.0
"""Wall time for loading a decoder [s]."""
_LIBRARIES: Final = {
    "mat": ("scipy.io.matlab",),
    "hdf5": ("h5py",),
    "parquet": ("pyarrow", "pyarrow.parquet"),
    "mdf": ("asammdf",),
    "mcap": ("mcap.reader",),
    "rosbag": ("rosbags.highlevel", "rosbags.typesys"),
}
"""What a format's decoder loads; that is not the file's doing and does not count against its
limits.
"""
FORMATS: Final = frozenset(_LIBRARIES)
"""Formats that are read in the child; text and NPZ say their size beforehand and are parsed by
numpy here.
"""


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files of a folder."""
    files = [p for p in path.rglob("*") if p.is_file()] if path.is_dir() else [path]
    return sum(p.stat().st_size for p in files)


def memory_for(size: int) -> int:
    """Memory that a file of this size may take [bytes]."""
    wanted = MEMORY + EXPANSION * size
    try:
        return min(wanted, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):  # a system that does not say
        return wanted


# --- this side ------------------------------------------------------------------------------------


def open_in_child(path: Path, form: str, module: str, function: str) -> Table:
    """Open a file of a foreign format: its decoder runs in the child.

    Parameters
    ----------
    path : Path
    form : str
        One of `FORMATS`.
    module, function : str
        The opener.

    Raises
    ------
    InputError
        What the opener says; a file that ends its decoder, or takes too much memory or time.
    """
    size = size_of(path)
    seconds = SECONDS + size / BYTES_PER_SECOND
    task = {
        "opening": next(_OPENINGS),
        "path": str(path),
        "cwd": os.getcwd(),
        "module": module,
        "function": function,
        "form": form,
        "memory": memory_for(size),
        "seconds": seconds,
        "wall": STARTING + PATIENCE * seconds,
        "forbidden": [name for name in _LIBRARIES[form] if sys.modules.get(name, sys) is None],
    }
    said, _ = CHILD.ask({**task, "columns": None})

    def load(numeric: Sequence[str], text: Sequence[str]) -> Mapping[str, npt.NDArray[Any]]:
        return CHILD.ask({**task, "columns": (list(numeric), list(text))})[1]

    return Table(
        said["reader"],
        tuple(said["names"]),
        load,
        said["units"],
        tuple(said["notes"]),
        said["first_row"],
        left=said["left"],
    )


def _death(code: int, task: Task) -> str:
    path = task["path"]
    if out_of_time(code):
        return (
            f"{path}: takes more than {task['seconds']:.0f} s to decode, too long for its "
            "size: is it damaged? save it again, or export CSV or NPZ"
        )
    if not code:
        return f"{path}: its decoder does not start; check the installation of Python"
    return f"{path}: is damaged, its decoder fails on it ({ended_by(code)}): save it again"


# --- the child ------------------------------------------------------------------------------------


def serve() -> None:
    """Answer requests from standard input until it ends."""
    answer(_Opened())


@final
class _Opened:
    """Opens files, and keeps the last one: its columns are asked for next."""

    def __init__(self) -> None:
        self._last: tuple[str, Table] | None = None

    def __call__(self, task: dict[str, Any]) -> Answer:
        columns = task.pop("columns")
        key = json.dumps(task)
        arrays: Arrays = {}
        try:
            os.chdir(task["cwd"])
            if self._last is None or self._last[0] != key:
                self._last = None
            for name in _LIBRARIES[task["form"]]:
                with contextlib.suppress(ImportError):  # the opener says what is missing
                    importlib.import_module(name)
            module = importlib.import_module(f"identification.data.read.{task['module']}")
            with _forbidden(task["forbidden"]), limited(task["memory"], task["seconds"]):
                table = (
                    self._last[1]
                    if self._last is not None
                    else getattr(module, task["function"])(Path(task["path"]))
                )
                self._last = (key, table)
                if columns is not None:
                    arrays = {n: _plain(a, n) for n, a in table.load(*columns).items()}
        except InputError as error:
            return {"refused": str(error)}, {}
        except MemoryError:
            self._last = None
            return {
                "refused": f"{task['path']}: takes more than {task['memory'] / 1e6:.0f} MB of "
                "memory, too much for its size: export fewer channels"
            }, {}
        except Exception as error:  # decoders raise whatever their parsers meet in a damaged file
            self._last = None
            detail = " ".join(f"{type(error).__name__}: {error}".split())[:160]
            return {
                "refused": f"{task['path']}: is damaged, its decoder fails on it ({detail}): "
                "save it again"
            }, {}
        said = {
            "reader": table.reader,
            "names": list(table.names),
            "units": dict(table.units),
            "notes": list(table.notes),
            "first_row": table.first_row,
            "left": dict(table.left),
        }
        return said, arrays


@contextlib.contextmanager
def _forbidden(names: Sequence[str]) -> Iterator[None]:
    """An import that the other side forbids (``sys.modules[name] = None``) is forbidden here
    too.
    """
    before = {name: sys.modules.get(name) for name in names}
    modules: dict[str, Any] = sys.modules
    modules.update(dict.fromkeys(names))
    try:
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del modules[name]
            else:
                modules[name] = module


def _plain(array: npt.NDArray[Any], name: str) -> npt.NDArray[Any]:
    if array.dtype.kind not in "fiubUS":
        raise InputError(f"column {name!r} is not numeric: choose another")
    return np.ascontiguousarray(array)


_OPENINGS: Final = itertools.count()
"""Number of an opening: a file that was written anew under its name is another one."""
CHILD: Final = Child(
    "identification.data.read._child",
    ("casadi_models", "casadi_models.child", "identification", "identification.data.read"),
    refusal=InputError,
    death=_death,
)
"""The child of this process; without the packages around the readers it starts in half the time."""
