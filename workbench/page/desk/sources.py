"""Files that are being written and streams, which a page may follow: those that were named where
the server was started, and no other, since whoever reaches the page could otherwise read any file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from identification.errors import InputError
from workbench.cli.following.source import check_address, is_stream
from workbench.page.session import write_atomic

FILE: Final = "follow.json"
STOP: Final = "follow.stop"


def allow(root: Path, paths: Sequence[str | Path]) -> None:
    """Let the sessions under a root follow these files, and no others any more.

    Raises
    ------
    InputError
        A folder, or a stream whose address is none.
    """
    for path in paths:
        if is_stream(path):
            check_address(str(path))
        elif Path(path).is_dir():
            raise InputError(f"{path}: is a folder; give the CSV file that is being written")
    names = [str(p) if is_stream(p) else str(Path(p).absolute()) for p in paths]
    if names:
        write_atomic(root / FILE, json.dumps(names).encode())
    else:  # writes nothing: on a full disk the page must open, so that sessions can be deleted
        (root / FILE).unlink(missing_ok=True)


def allowed(root: Path) -> list[str]:
    """The paths that may be followed."""
    try:
        found = json.loads((root / FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    return [str(p) for p in found] if isinstance(found, list) else []


def source_of(root: Path, name: str) -> str:
    """One of them by its name.

    Raises
    ------
    InputError
        It is none of them.
    """
    found = next((p for p in allowed(root) if p == name), None)
    if found is None:
        raise InputError(
            "follow: this file was not named when the page was started; start it with "
            "irj app --follow FILE"
        )
    return found


def ask_stop(exports: Path) -> None:
    """Let a file that is followed be complete as it stands."""
    write_atomic(exports / STOP, b"")


def stopped(exports: Path) -> bool:
    """Whether it was asked for, once."""
    found = (exports / STOP).is_file()
    (exports / STOP).unlink(missing_ok=True)
    return found


__all__ = ["allow", "allowed", "ask_stop", "source_of", "stopped"]
