"""Effects of a user's own file: a joint file remembers where they come from, and code runs only
where it was allowed.

A joint file names its effect files with their SHA-256. A joint file may come from anybody, so its
word is not enough to run code: a file is loaded by itself only where its content is what the joint
file says and was allowed on this machine before, by naming it with ``--effects``. What was allowed
is kept as hashes, one a line, in a file of the user.
"""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from casadi_models import EFFECTS
from casadi_models.child.trial import EffectFileError
from casadi_models.effect import EffectFile
from identification.data.joint_schema import OWN_EFFECTS
from identification.data.plain_text import toml_string
from identification.errors import InputError

TABLE: Final = "own_effects"
"""Name of the table in a joint file."""
STORE: Final = "IRJ_ALLOWED_EFFECTS"
"""Environment variable with the path of the file of allowed hashes, in place of the usual one."""
_LARGEST: Final = 1 << 20
"""Largest effect file that is read [bytes]; a declaration takes a few thousand."""


def files_of(labels: Iterable[str]) -> tuple[EffectFile, ...]:
    """The users' files from which these effects come, each once; a typed law is a file of its
    own.
    """
    keys = _keys(labels)
    return tuple(f for f in (*EFFECTS.files, *EFFECTS.typed) if keys & set(f.keys))


def _keys(labels: Iterable[str]) -> set[str]:
    return {label.partition("#")[0].partition("@")[0] for label in labels}


def remembered(labels: Iterable[str]) -> list[str]:
    """The lines of a joint file that name the files of these effects."""
    lines, used = [], _keys(labels)
    for found in (f for f in EFFECTS.files if used & set(f.keys)):
        entry = OWN_EFFECTS.inline({"sha256": found.sha256, "keys": found.keys})
        lines.append(f"{toml_string(str(found.path))} = {entry}")
    return ["", f"[{TABLE}]", *lines] if lines else []


def register(name: str | Path) -> EffectFile:
    """Load a file that the user names, and allow its content on this machine.

    Raises
    ------
    InputError
        No such file; a file that is no declaration of effects.
    """
    path = Path(name)
    if not path.is_file():
        raise InputError(
            f"{path}: no such file; --effects takes a Python file that declares effects"
        )
    found = _loaded(path, _content(path))
    if not found.keys:
        raise InputError(f"{path}: declares no effect; see docs/extending.md for how to")
    _remember(found.sha256)
    return found


def load_remembered(table: Any, source: str) -> None:
    """Load the files that a joint file remembers, where their effects are not in the library yet.

    Parameters
    ----------
    table : mapping
        ``{path: {"sha256": ..., "keys": [...]}}``; a path is absolute, or counts from the joint
        file.
    source : str
        Path of the joint file.

    Raises
    ------
    InputError
        A file that is gone, has changed, or was never allowed on this machine: one line that says
        how to allow it.
    """
    for name, entry in table.items():
        sha256, keys = _entry(name, entry, source)
        if all(key in EFFECTS for key in keys):
            continue
        path = _place(name, source)
        content = _content(path)
        if hashlib.sha256(content).hexdigest() != sha256:
            raise InputError(
                f"{source}: {path} is not the effect file it was, its content has changed; "
                f"look at it, then give --effects {path} to use it as it is"
            )
        if sha256 not in _allowed():
            raise InputError(
                f"{source}: takes effects from {path}, code that was never allowed on this "
                "machine; "
                f"look at it, then give --effects {path} to run it"
            )
        _loaded(path, content)


def _entry(name: str, entry: Any, source: str) -> tuple[str, list[str]]:
    keys = entry.get("keys") if isinstance(entry, Mapping) else None
    if (
        not isinstance(entry, Mapping)
        or not isinstance(entry.get("sha256"), str)
        or not isinstance(keys, list)
    ):
        raise InputError(
            f'{source}: [{TABLE}] "{name}" must be a table, as {{ sha256 = "...", keys = '
            f'["my_effect"] }}'
        )
    return entry["sha256"], [str(key) for key in keys]


def _place(name: str, source: str) -> Path:
    """Where the file lies: as named, or beside the joint file."""
    folder = Path(source).parent
    places = [folder / name, folder / Path(name.replace("\\", "/")).name]
    try:
        found = next((p for p in places if p.is_file()), None)
    except OSError:  # a name that no disk can hold
        found = None
    if found is None:
        raise InputError(
            f"{source}: its effect file {name} is not there; give the file with --effects FILE"
        )
    return found


def _content(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            content = stream.read(_LARGEST + 1)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give a Python file that declares effects"
        ) from None
    if len(content) > _LARGEST:
        raise InputError(
            f"{path}: larger than {_LARGEST} bytes, no declaration of effects; give the right "
            "file with --effects"
        )
    return content


def _loaded(path: Path, content: bytes) -> EffectFile:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # Python's own remarks on the text; what matters is an error
            tried = hashlib.sha256(content).hexdigest() in _allowed()  # it was loaded then
            return EFFECTS.load_code(path, content, tried=tried)
    except EffectFileError as error:
        raise InputError(str(error)) from None
    except Exception as error:  # a user's file may fail in any way
        raise InputError(
            f"{path}: cannot be used as effects ({type(error).__name__}: {error})"
        ) from None


# --- what was allowed -----------------------------------------------------------------------------


def _store() -> Path | None:
    given = os.environ.get(STORE)
    if given:
        return Path(given)
    base = os.environ.get("XDG_STATE_HOME") or os.environ.get("LOCALAPPDATA")
    try:
        return (
            (Path(base) if base else Path.home() / ".local" / "state")
            / "irj"
            / "allowed-effects.txt"
        )
    except RuntimeError:  # a user without a home
        return None


def _allowed() -> frozenset[str]:
    store = _store()
    try:
        return (
            frozenset(store.read_text(encoding="utf-8").split())
            if store is not None
            else frozenset()
        )
    except (OSError, UnicodeDecodeError):
        return frozenset()


def _remember(sha256: str) -> None:
    """Note a hash; where that cannot be written the user is asked again next time."""
    store = _store()
    if store is None or sha256 in _allowed():
        return
    try:
        store.parent.mkdir(parents=True, exist_ok=True)
        with store.open("a", encoding="utf-8") as stream:
            stream.write(sha256 + "\n")
    except OSError:
        return


__all__ = ["STORE", "TABLE", "files_of", "load_remembered", "register", "remembered"]
