"""Files that are being written and streams, which a page may follow: those that were named where
the server was started, and no other, since whoever reaches the page could otherwise read any file.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from identification.errors import InputError
from workbench.cli.following.source import check_address, is_stream
from workbench.page.session import write_atomic

STOP: Final = "follow.stop"


def named(paths: Sequence[str | Path]) -> tuple[str, ...]:
    """What was named at the start of a server, as its page offers it.

    It is known to that server alone: two that serve the same sessions offer each its own.

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
    return tuple(str(p) if is_stream(p) else str(Path(p).absolute()) for p in paths)


def refuse_other(sources: Sequence[str], name: str) -> None:
    """Refuse to follow what was not named.

    Raises
    ------
    InputError
    """
    if name not in sources:
        raise InputError(
            "follow: this file was not named when the page was started; start it with "
            "irj app --follow FILE"
        )


def ask_stop(exports: Path) -> None:
    """Let a file that is followed be complete as it stands."""
    write_atomic(exports / STOP, b"")


def stopped(exports: Path) -> bool:
    """Whether it was asked for, once."""
    found = (exports / STOP).is_file()
    (exports / STOP).unlink(missing_ok=True)
    return found


__all__ = ["ask_stop", "named", "refuse_other", "stopped"]
