"""The home page: every session of this user, told apart from strangers by a key in the folder."""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import shutil
import time
from pathlib import Path
from typing import Any, Final

from identification.errors import InputError
from workbench.page.session import Branch, State, Store, write_atomic
from workbench.page.uploads import TooLargeError, megabytes

KEY_FILE: Final = "home.key"
QUOTA: Final = 20 << 30
"""What all sessions may take on the disk in bytes: twenty of the largest uploads;
``$IRJ_QUOTA_GB`` sets another.
"""
STALE: Final = 86400.0
"""An empty session is swept after a day: a page that was only opened leaves one behind [s]."""


def key_of(store: Store) -> str:
    """The key of the home page, made once; only the owner of the folder can read it.

    The page's address is open to every user of this machine, so that a list of sessions, whose
    identifiers open them, is given to the holder of the key alone.
    """
    path = store.root / KEY_FILE
    try:
        return path.read_text(encoding="ascii").strip()
    except OSError:
        made = secrets.token_urlsafe(24)
        write_atomic(path, made.encode())
        path.chmod(0o600)
        return made


def allowed(store: Store, given: str) -> bool:
    """Whether this is the key."""
    return hmac.compare_digest(given.encode(), key_of(store).encode())


def mark_of(store: Store) -> str:
    """What a page knows these sessions by, whichever server serves them: made of the key, which
    cannot be found from it.
    """
    return hashlib.sha256(f"sessions {key_of(store)}".encode()).hexdigest()[:16]


def quota() -> int:
    """Bytes that all sessions may take.

    Raises
    ------
    InputError
        ``$IRJ_QUOTA_GB`` is no number.
    """
    given = os.environ.get("IRJ_QUOTA_GB")
    try:
        return QUOTA if given is None else int(float(given) * 1e9)
    except ValueError:
        raise InputError(f"IRJ_QUOTA_GB is {given!r}; give a number of gigabytes") from None


def size_of(folder: Path) -> int:
    """Bytes of the files in a folder and below."""
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file() and not p.is_symlink())


def refuse_over(store: Store, name: str, size: int) -> None:
    """Refuse an upload that would bring the sessions over their quota.

    Raises
    ------
    TooLargeError
    """
    most = quota()
    if size_of(store.root) + size > most:
        raise TooLargeError(
            f"{name}: the sessions would take more than {megabytes(most)}; delete some on the page "
            "of sessions, or set IRJ_QUOTA_GB"
        )


def sessions(store: Store) -> dict[str, Any]:
    """Every session that holds something, the latest first, and what they take on the disk."""
    cards = [c for folder in store.root.iterdir() if (c := _card(store, folder)) is not None]
    cards.sort(key=lambda c: -c["changed"])
    return {"sessions": cards, "used": size_of(store.root), "quota": quota()}


def _card(store: Store, folder: Path) -> dict[str, Any] | None:
    path = folder / "state.json"
    try:
        session = store.open(folder.name)
        changed, state = path.stat().st_mtime, session.load()
    except (KeyError, OSError):
        return None
    except InputError as error:
        bare = {"name": "", "joint": "", "files": [], "errors": [], "fits": 0}
        return {"id": folder.name, "changed": 0.0, "size": size_of(folder), **bare} | {
            "problem": str(error)
        }
    if not (state.files or state.joint_text or state.branches):
        return None
    joint = next((ln for ln in state.joint_text.splitlines() if ln.startswith("name")), "")
    paths: tuple[State | Branch, ...] = (state, *state.branches)
    fits = {s.id for b in paths for s in (*b.steps, *b.undone)}
    return {
        "id": folder.name,
        "name": state.name,
        "joint": joint.partition("=")[2].strip().strip("\"'"),
        "files": [f.name for f in state.files],
        "errors": [s.held_out.get("relative_error_percent") for s in state.steps],
        "effects": [s.title or s.label for s in state.steps if s.label],
        "fits": len(fits),
        "changed": changed,
        "size": size_of(folder),
        "problem": "",
    }


def delete(store: Store, identifier: str) -> None:
    """Take a session off the disk.

    Raises
    ------
    KeyError
        No such session.
    """
    folder = store.open(identifier).folder
    gone = folder.with_name(f".{folder.name}.gone")
    folder.rename(gone)  # half of a session is never listed
    shutil.rmtree(gone, ignore_errors=True)


def sweep_empty(store: Store) -> None:
    """Take away empty sessions of pages that were only opened, and what a delete left behind."""
    for folder in store.root.iterdir():
        if folder.name.startswith(".") and folder.name.endswith(".gone"):
            shutil.rmtree(folder, ignore_errors=True)
            continue
        try:
            data = json.loads((folder / "state.json").read_text(encoding="utf-8"))
            old = time.time() - float(data["created"]) > STALE
            if old and data["revision"] <= 1 and not any((folder / "files").iterdir()):
                shutil.rmtree(folder, ignore_errors=True)
        except (OSError, ValueError, KeyError, TypeError):
            continue
