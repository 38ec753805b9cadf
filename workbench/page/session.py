"""The state of the app: one folder per session, written so that a killed server loses nothing.

A session folder holds ``state.json`` (written to a new file that then replaces the old one),
``files/`` with the uploads as they came, and nothing else that is needed: everything in memory is
made from these again.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
import time
import unicodedata
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar, Final, final

from identification.errors import InputError
from identification.scratch import hold, part_of, sweep

VERSION: Final = 1
_ID: Final = re.compile(r"^[0-9a-f]{32}$")
_FORBIDDEN: Final = frozenset('<>:"/\\|?*')
"""Of the printable characters those that one of the systems keeps for itself."""
_UNSEEN: Final = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
"""Kinds of characters that show nothing or turn what stands about them: two names would look the
same, or one would end differently than it looks.
"""
_JOINERS: Final = frozenset("\u200c\u200d")
"""Unseen, too, but spelling in some scripts."""
_RESERVED: Final = re.compile(r"(CON|PRN|AUX|NUL|(COM|LPT)[1-9¹²³])\s*(\..*)?", re.IGNORECASE)
"""Devices of one of the systems, with any ending."""
LONGEST_FILE: Final = 200
"""Bytes of a name in UTF-8: file systems take 255, and something is put before it."""
_ENDING: Final = 20
"""Bytes of the endings of a name that a cut keeps, which say how it is read."""


def write_atomic(path: Path, content: bytes) -> None:
    """Write a file so that a reader, or a crash, sees the old content or the new one, never a
    part.
    """
    temporary = part_of(path)
    try:
        with naming(path), temporary.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Say where it was where a disk takes no more: the system names a file only where it cannot be
    opened.
    """
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


def safe_name(name: str) -> str:
    """The name of an upload as a file name: letters of all scripts as they are, no folder, no
    leading dot, nothing that a file system or a reader would take for something else, at most
    `LONGEST_FILE` bytes. Two spellings of the same letters (NFC and NFD) are one name.
    """
    last = unicodedata.normalize("NFC", name).replace("\\", "/").rpartition("/")[2]
    kept = "".join(c if _stays(c) else "_" for c in last).strip(" .").strip().strip(" .")
    kept = f"_{kept}" if _RESERVED.fullmatch(kept) else kept
    return _cut(kept) or "record"


def _stays(character: str) -> bool:
    kind = unicodedata.category(character)
    return character in _JOINERS or not (character in _FORBIDDEN or kind in _UNSEEN)


def _cut(name: str) -> str:
    """A name of `LONGEST_FILE` bytes at most, cut before its endings and between two letters."""
    if len(name.encode()) <= LONGEST_FILE:
        return name
    ending = "".join(PurePosixPath(name).suffixes[-2:])
    if len(ending.encode()) > _ENDING:
        ending = PurePosixPath(name).suffix
    if len(ending.encode()) > _ENDING:
        ending = ""
    stem = name.removesuffix(ending).encode()[: LONGEST_FILE - len(ending.encode())]
    return stem.decode(errors="ignore").rstrip(" .") + ending


def stored_as(name: str) -> str:
    """The name under which an upload lies in the session folder: no other one has it. Letters that
    the file system of this machine cannot write are left out there; the page has them still.
    """
    try:
        os.fsencode(name)
    except UnicodeEncodeError:
        name = name.encode("ascii", "replace").decode().replace("?", "_")
    return f"{secrets.token_hex(4)}-{name}"


@final
@dataclass(frozen=True)
class FileEntry:
    """One uploaded record.

    Attributes
    ----------
    id, name, stored : str
        Identifier, name as uploaded, name in the session folder.
    role : {"train", "held_out"}
    role_reason : str
        Why it has this role, as the page says it.
    status : {"ready", "checking", "columns", "refused"}
        ``checking``: can be looked at, the check gate runs; ``columns``: the column map must be
        confirmed first.
    message : str
    columns : mapping or None
        Column map that the user confirmed.
    kind : {"", "rotary", "linear"}
        Kind of the axis as its columns say it, until there is a joint.
    names, guess : what the file holds and which map is proposed.
    findings, summary : result of the check gate; size, channels and where they come from.
    left_out : windows that no fit and no judgement takes, in the time of the plot [s].
    """

    id: str
    name: str
    stored: str
    role: str = "train"
    role_reason: str = ""
    size: int = 0
    status: str = "ready"
    message: str = ""
    columns: Mapping[str, Any] | None = None
    kind: str = ""
    names: tuple[str, ...] = ()
    guess: tuple[Mapping[str, Any], ...] = ()
    findings: tuple[Mapping[str, Any], ...] = ()
    summary: Mapping[str, Any] = field(default_factory=dict)
    left_out: tuple[tuple[float, float], ...] = ()


@final
@dataclass(frozen=True)
class StepEntry:
    """One step of the ledger: the model after it, with its values and errors.

    Attributes
    ----------
    action : {"start", "add", "remove"}
    key, label, title : str or None
        The effect that was added or removed.
    effects : tuple of str
        Labels in the model.
    names, separate_by
        What the diagnosis could not tell apart when it was added, and the run that would.
    exact : bool
        False while the values come from a part of the samples.
    settled : bool
        False while the values are those of the first look, before the whole fit.
    id : str
        Stays the same when the step is fitted further: notes and diagnoses are kept by it.
    """

    action: str
    effects: tuple[str, ...]
    values: Mapping[str, float]
    train: Mapping[str, Any]
    held_out: Mapping[str, Any]
    key: str | None = None
    label: str | None = None
    title: str | None = None
    virtual_work: bool = True
    exact: bool = True
    seconds: float = 0.0
    names: tuple[str, ...] = ()
    separate_by: str | None = None
    settled: bool = True
    id: str = ""


@final
@dataclass(frozen=True)
class Branch:
    """A path of fits that was put away, with the input it was made from; the attributes are those
    of `State`.
    """

    WORKING: ClassVar[tuple[str, ...]] = (
        "files",
        "joint_text",
        "joint_source",
        "steps",
        "undone",
        "diagnosis",
        "improvement",
        "note",
        "left_open",
    )
    """What a branch and the state have in common."""

    id: str
    parent: str = ""
    created: float = 0.0
    files: tuple[FileEntry, ...] = ()
    joint_text: str = ""
    joint_source: str = ""
    steps: tuple[StepEntry, ...] = ()
    undone: tuple[StepEntry, ...] = ()
    diagnosis: Mapping[str, Any] | None = None
    improvement: Mapping[str, Any] | None = None
    note: str = ""
    left_open: Mapping[str, Any] = field(default_factory=dict)


@final
@dataclass(frozen=True)
class State:
    """Everything a session knows.

    Attributes
    ----------
    revision : int
        Counts up with every change; a page with an older one asks again.
    joint_text : str
        The joint file, empty until there is one.
    steps, undone : tuple of StepEntry
        The ledger, and what undo took off it.
    diagnosis, improvement : mapping or None
        The ranking that belongs to the last step; the result of the whole loop.
    left_open : mapping
        What the last diagnosis, whatever was added since, could not test, and its warnings about
        the records.
    name : str
        Name of the session; empty: that of the joint.
    branch, parent, ahead : str
        The current branch, the one it came from, and the one that undo left.
    branches : tuple of Branch
        Every other path of fits.
    found : mapping
        By step: its diagnosis and the result of the loop that ended there.
    remarks : mapping
        By step or branch: ``name`` and ``note``.
    """

    revision: int = 0
    created: float = 0.0
    files: tuple[FileEntry, ...] = ()
    joint_text: str = ""
    joint_source: str = ""
    steps: tuple[StepEntry, ...] = ()
    undone: tuple[StepEntry, ...] = ()
    diagnosis: Mapping[str, Any] | None = None
    improvement: Mapping[str, Any] | None = None
    note: str = ""
    left_open: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""
    branch: str = "first"
    parent: str = ""
    ahead: str = ""
    branches: tuple[Branch, ...] = ()
    found: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    remarks: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    def without_fit(self) -> State:
        """The state before any fit, on its records and its joint."""
        return replace(
            self,
            steps=(),
            undone=(),
            diagnosis=None,
            improvement=None,
            note="",
            left_open={},
            ahead="",
        )

    def as_json(self) -> dict[str, Any]:
        """As written to ``state.json`` and sent to the page."""
        return {"version": VERSION, **asdict(self)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> State:
        """Read `as_json` back; keys of a newer version are left out."""
        known = set(cls.__dataclass_fields__)
        kept = {k: v for k, v in data.items() if k in known}
        kept["branches"] = tuple(
            _made(Branch, {**b, **_entries(b)}) for b in kept.get("branches", ())
        )
        return cls(**{**kept, **_entries(kept)})


def _entries(data: Mapping[str, Any]) -> dict[str, tuple[Any, ...]]:
    """Records and steps of a state or a branch."""
    kinds = (("files", FileEntry), ("steps", StepEntry), ("undone", StepEntry))
    return {key: tuple(_made(kind, _named(e)) for e in data.get(key, ())) for key, kind in kinds}


def _named(entry: Mapping[str, Any]) -> dict[str, Any]:
    """A record or a step with an identifier: steps of an older version have none."""
    return {**entry, "id": entry.get("id") or secrets.token_hex(4)}


def _made(kind: type[Any], data: Mapping[str, Any]) -> Any:
    known = set(kind.__dataclass_fields__)
    return kind(
        **{k: tuple(v) if isinstance(v, list) else v for k, v in data.items() if k in known}
    )


@final
class Session:
    """A session folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.id = folder.name

    @property
    def files(self) -> Path:
        """Folder of the uploads."""
        return self.folder / "files"

    def path_of(self, entry: FileEntry) -> Path:
        """Path of an upload.

        Raises
        ------
        InputError
            A state file that names a path outside the session folder.
        """
        path = (self.files / entry.stored).resolve()
        if path.parent != self.files.resolve():
            raise InputError(
                f"{entry.name}: its path leaves the session folder; upload the file again"
            )
        return path

    def load(self) -> State:
        """The state on disk.

        Raises
        ------
        InputError
            A state file that cannot be read.
        """
        path = self.folder / "state.json"
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            return State.from_json(data)
        except (OSError, ValueError, TypeError) as error:
            raise InputError(
                f"{path}: the session cannot be read ({error}); start a new one"
            ) from None

    def running(self) -> dict[str, Any] | None:
        """The job that was at work when the server ended, as `begin` wrote it; None where none
        was.
        """
        try:
            data = json.loads((self.folder / "running.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return data if isinstance(data, dict) else None

    def begin(self, job: Mapping[str, Any]) -> None:
        """Write down that a job is at work: a killed server finds it again."""
        write_atomic(self.folder / "running.json", json.dumps(job).encode())

    def end(self) -> None:
        """No job is at work."""
        (self.folder / "running.json").unlink(missing_ok=True)

    def save(self, state: State) -> State:
        """Write the state with its revision counted up; returns what was written."""
        newer = replace(state, revision=state.revision + 1)
        write_atomic(
            self.folder / "state.json", json.dumps(newer.as_json(), allow_nan=False).encode()
        )
        return newer


@final
class Store:
    """All session folders under one root, which only its owner may read."""

    def __init__(self, root: Path) -> None:
        self.root = root
        root.mkdir(parents=True, exist_ok=True, mode=0o700)
        with contextlib.suppress(InputError):  # another server is at work with these sessions
            hold(root)
            for folder, _, _ in os.walk(root):  # also where an export was being built
                sweep(Path(folder))

    def create(self) -> Session:
        """A new, empty session with an identifier that cannot be guessed."""
        folder = self.root / secrets.token_hex(16)
        try:
            (folder / "files").mkdir(parents=True, mode=0o700)
            session = Session(folder)
            session.save(State(created=time.time()))
        except OSError:  # a full disk: without its state nothing would ever find the folder
            shutil.rmtree(folder, ignore_errors=True)
            raise
        return session

    def open(self, identifier: str) -> Session:
        """An existing session.

        Raises
        ------
        KeyError
            No session of that name.
        """
        folder = self.root / identifier
        if not _ID.match(identifier) or not (folder / "state.json").is_file():
            raise KeyError(identifier)
        return Session(folder)
