"""Records and analysis of a session's state: what the views draw from, and what a job works on."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from casadi_models import EFFECTS
from identification.data.joint_file import Joint, parse_joint
from identification.data.plain_text import from_toml
from identification.data.record import Record
from identification.errors import InputError
from workbench.page.analysis import Analysis, Fitted
from workbench.page.desk.tree import fits_stand
from workbench.page.records import checked, opened, without_windows
from workbench.page.session import FileEntry, Session, State, StepEntry

Change = Callable[[State], State]


class Place:
    """A state of a session with its records in memory; nothing here is written to its folder.

    Parameters
    ----------
    session : Session
        Its folder; everything here is made from it again after a restart.
    state : State

    Attributes
    ----------
    kept : mapping of str to (mark, value)
        Costly results in memory, each with the mark of what it was made from.
    preparing : float
        What it took to prepare the analysis [s].
    """

    def __init__(self, session: Session, state: State) -> None:
        self.session, self.state = session, state
        self.lock = threading.RLock()
        self.building = threading.Lock()
        self.kept: dict[str, tuple[Any, Any]] = {}
        self._records: dict[str, Record] = {}
        self._analysis: Analysis | None = None
        self._fitted: tuple[StepEntry, Fitted] | None = None
        self.preparing = 0.0

    @property
    def ready(self) -> bool:
        """Whether the analysis is prepared."""
        return self._analysis is not None

    def take(self, state: State, fitted: Fitted | None) -> None:
        """Work on another state: what its fits still stand on stays in memory.

        Parameters
        ----------
        state : State
        fitted : Fitted or None
            The fitted model of its last step, as `Analysis.fitted` gives it.
        """
        if not fits_stand(self.state, state):
            self._analysis = None
            self._records.clear()
        self.state = state
        if self._analysis is not None:
            self._analysis.joint = described(state)
        self.fitted_elsewhere(fitted)

    def fitted_elsewhere(self, fitted: Fitted | None) -> None:
        """Stand on the last step of the state, whose fitted model may come from another process;
        None where that fitted nothing: what is known stays known, as long as it is of that step.
        """
        last = self.state.steps[-1] if self.state.steps else None
        if last is None:
            self._fitted = None
        elif fitted is not None:
            self._fitted = (last, fitted)
        if self._analysis is not None:
            self._stand(self._analysis)

    def fitted_here(self) -> Fitted | None:
        """The fitted model of the last step, for another process; None where it is not at hand."""
        if not self.state.steps:
            return None
        last = self.state.steps[-1]
        if self._analysis is not None and self._analysis.stands_on(last):
            return self._analysis.fitted(self._analysis.current)
        return self._fitted[1] if self._fitted is not None and self._fitted[0] == last else None

    def _stand(self, analysis: Analysis) -> None:
        if not self.state.steps:
            analysis.begin()
            return
        last = self.state.steps[-1]
        if analysis.stands_on(last):
            return
        if self._fitted is not None and self._fitted[0] == last:
            analysis.known(*self._fitted)
        analysis.restore(last)

    @contextlib.contextmanager
    def library(self) -> Iterator[None]:
        """The effect library with the typed laws of this session's joint, and of no other's."""
        with EFFECTS.scoped():
            self.joint_or_none()
            yield

    def joint(self) -> Joint:
        """The joint of the session.

        Raises
        ------
        InputError
            None yet, or not a valid one.
        """
        return joint_of(self.state)

    def joint_or_none(self) -> Joint | None:
        """The joint of the session where there is a valid one."""
        try:
            return self.joint()
        except InputError:
            return None

    @property
    def has_joint(self) -> bool:
        """Whether there is a valid joint."""
        return self.joint_or_none() is not None

    def columns_of(self, entry: FileEntry) -> Mapping[str, Any] | None:
        """The column map of a record: its own, else that of the joint file, where there is one."""
        joint = self.joint_or_none()
        return entry.columns or (joint.columns if joint else None)

    def kind_of(self, entry: FileEntry) -> str:
        """Kind of the axis: of the joint, else as the record's columns say it."""
        joint = self.joint_or_none()
        return joint.kind if joint else entry.kind or "rotary"

    def examine(self, entry: FileEntry, *, longest: int | None = None) -> FileEntry:
        """Read and check an upload; keeps its record in memory.

        Parameters
        ----------
        entry : FileEntry
        longest : int, optional
            A record of more samples comes back with the status ``checking``: it can be looked at.
        """
        path = self.session.path_of(entry)
        columns = self.columns_of(entry)
        made, record = opened(entry, path, self.kind_of(entry), columns)
        if record is not None and not (longest is not None and len(record) > longest):
            joint = self.joint_or_none()
            made, record = checked(made, record, path, joint, mapped=bool(columns))
        with self.lock:
            self._records.pop(entry.id, None)
            if record is not None:
                self._records[entry.id] = record
        return made

    def record(self, identifier: str) -> Record:
        """The record of an upload, read again where it is not in memory.

        Raises
        ------
        InputError
            Unknown, or not readable.
        """
        entry = next((f for f in self.state.files if f.id == identifier), None)
        if entry is None:
            raise InputError("no such record in this session")
        if identifier not in self._records:
            made = self.examine(entry)
            if identifier not in self._records:
                raise InputError(made.message or f"{entry.name}: cannot be read")
        return self._records[identifier]

    def as_read(self, identifier: str) -> Record:
        """The record of an upload with its holes and stamps, before the gate's repairs.

        Raises
        ------
        InputError
            Unknown, or not readable.
        """
        entry = next((f for f in self.state.files if f.id == identifier), None)
        if entry is None:
            raise InputError("no such record in this session")
        path, columns = self.session.path_of(entry), self.columns_of(entry)
        made, record = opened(entry, path, self.kind_of(entry), columns)
        if record is None:
            raise InputError(made.message or f"{entry.name}: cannot be read")
        return record

    def analysis(self) -> Analysis:
        """The analysis of the state as it is; prepared again after a restart."""
        with self.building:
            while True:
                with self.lock:
                    if self._analysis is not None:
                        return self._analysis
                    state = self.state
                began = time.perf_counter()
                made = self._prepared(state)
                with self.lock:
                    if fits_stand(state, self.state):  # else the input changed meanwhile
                        self._stand(made)
                        self._analysis, self.preparing = made, time.perf_counter() - began

    def _prepared(self, state: State) -> Analysis:
        ready = [f for f in state.files if f.status == "ready"]
        used = [(f.role, without_windows(self.record(f.id), f.left_out)) for f in ready]
        train = [r for role, r in used if role == "train"]
        held = [r for role, r in used if role == "held_out"]
        return Analysis(described(state), train, held)


def joint_of(state: State) -> Joint:
    """The joint of a state.

    Raises
    ------
    InputError
        None yet, or not a valid one.
    """
    if not state.joint_text:
        raise InputError(
            "no joint yet: fill in gear ratio, motor constant and model on the Model page"
        )
    source = state.joint_source or "joint"
    return parse_joint(from_toml(state.joint_text, source), source)


def confirmed_map(state: State) -> Mapping[str, Any] | None:
    """The column map of the records, where one was confirmed for all of them."""
    ready = [f for f in state.files if f.status == "ready"]
    columns = ready[0].columns if ready else None
    return columns if columns and all(f.columns == columns for f in ready) else None


def described(state: State) -> Joint:
    """The joint of a state as it is taken home: with the column map that was confirmed for its
    records, so that the command line reads them with it.

    Raises
    ------
    InputError
        No joint yet, or not a valid one.
    """
    joint = joint_of(state)
    return joint if joint.columns else replace(joint, columns=confirmed_map(state))


def hint_for(state: State, label: str) -> Mapping[str, Any] | None:
    """Start values of a candidate from the diagnosis on disk."""
    rows = (state.diagnosis or {}).get("ranking", [])
    found: Mapping[str, Any] | None = next((r for r in rows if r.get("label") == label), None)
    return found


def folder_of(place: Place) -> Path:
    """Folder for what is made for a download."""
    made = place.session.folder / "exports"
    made.mkdir(exist_ok=True, mode=0o700)
    return made


__all__ = [
    "Change",
    "Place",
    "confirmed_map",
    "described",
    "folder_of",
    "hint_for",
    "joint_of",
]
