"""A user's effect file is run in a child first: one that ends its process, or never ends, is one
line here.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from casadi_models.child.process import Child, Task, ended_by, out_of_time

MEMORY: Final = 2 << 30
"""Memory that a file may take [bytes], beyond the library's: it may load large packages."""
SECONDS: Final = 30.0
"""Time for a file [s], with the start of the child; a declaration takes under one."""


class EffectFileError(ValueError):
    """A user's effect file that would end the process which runs it."""


def ends_it(path: Path | str, detail: str) -> EffectFileError:
    """The error of a file that is not run, in one line."""
    return EffectFileError(f"{path}: cannot be used as effects ({' '.join(detail.split())})")


def try_file(path: Path, code: bytes, before: Iterable[tuple[Path, bytes]]) -> None:
    """Run a file in a child of its own, once for its content.

    What it raises there as an ordinary error it raises here as well, with its kind: that is left to
    whoever runs it next. Where there is no Python to start, as in a host that embeds one, nothing
    is tried.

    Parameters
    ----------
    path : Path
    code : bytes
        Content of the file.
    before : iterable of (path, content)
        Files that were loaded before it, which it may name.

    Raises
    ------
    EffectFileError
        It ends the process, asks for its end, or takes too much time or memory.
    """
    digest = hashlib.sha256(code).hexdigest()
    if digest in _GOOD or not sys.executable:
        return
    task = {
        "path": str(path),
        "code": code.decode("latin-1"),
        "before": [(str(p), c.decode("latin-1")) for p, c in before],
        "cwd": os.getcwd(),
        "memory": MEMORY,
        "seconds": SECONDS,
        "wall": SECONDS,
    }
    child = Child("casadi_models.child.effect_file", refusal=EffectFileError, death=_death)
    try:
        said, _ = child.ask(task)
    finally:
        child.end()  # another file finds a process that nobody touched
    if said["good"]:
        _GOOD.add(digest)


def _death(code: int, task: Task) -> str:
    if out_of_time(code):
        why = f"it takes more than {task['seconds']:g} s"
    else:
        why = f"it ends the process that runs it: {ended_by(code)}"
    return str(ends_it(task["path"], why))


_GOOD: Final[set[str]] = set()
"""Contents that were tried."""
