"""An error of the program itself: its trace is kept in a file, and one line says where."""

from __future__ import annotations

import os
import platform
import secrets
import sys
import time
import traceback
from pathlib import Path
from typing import Final

from identification.scratch import outer_folder

FOLDER: Final = "IRJ_CRASHES"
"""Environment variable with the folder of traces, in place of the usual one."""
KEPT: Final = 20
"""Traces that are kept; older ones are removed, so that a loop of failures does not fill a disk."""


def internal_error(error: BaseException, doing: str = "") -> str:
    """Keep the trace of an error that is no user's, and say so.

    Parameters
    ----------
    error : BaseException
        What came up.
    doing : str
        The command, or the work, in which it came: the first line of the file.

    Returns
    -------
    str
        One line: that this is no answer, what came up and where the trace is kept.
    """
    detail = " ".join(str(error).split())[:120]
    name = type(error).__name__ + (f": {detail}" if detail else "")
    said = f"internal error ({name}), no result"
    text = f"{doing}\nPython {sys.version} on {platform.platform()}\n\n" + "".join(
        traceback.format_exception(error)
    )
    for folder in _folders():
        if (place := _kept(folder, text)) is not None:
            return f"{said}; the trace is kept in {place}: please report it with that file"
    return f"{said}; its trace could not be kept on this disk: please report the command"


def _folders() -> list[Path]:
    """Where traces may go, the best first."""
    if given := os.environ.get(FOLDER):
        return [Path(given)]
    found = []
    base = os.environ.get("XDG_STATE_HOME") or os.environ.get("LOCALAPPDATA")
    try:
        state = Path(base) if base else Path.home() / ".local" / "state"
        found.append(state / "irj" / "crashes")
    except RuntimeError:  # a user without a home
        pass
    return [*found, outer_folder()]


def _kept(folder: Path, text: str) -> Path | None:
    """The file of a trace, for the user alone; None where it cannot be written."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    place = folder / f"irj-crash-{stamp}-{secrets.token_hex(3)}.txt"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        handle = os.open(place, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "wb") as stream:
            stream.write(text.encode("utf-8", "backslashreplace"))
        for old in sorted(folder.glob("irj-crash-*.txt"))[:-KEPT]:
            old.unlink(missing_ok=True)
    except OSError:
        return None
    return place


__all__ = ["FOLDER", "internal_error"]
