"""One session in memory: its state, its analysis, and the one job that may run on it at a time."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, final

from identification.crash import internal_error
from identification.data.joint_file import Joint, parse_joint
from identification.data.plain_text import from_toml
from identification.data.record import Record
from identification.errors import InputError
from workbench.page.analysis import Analysis, Progress
from workbench.page.desk.tree import after_input, given
from workbench.page.records import checked, opened, without_windows
from workbench.page.session import FileEntry, Session, State
from workbench.page.work import CancelledError, Task, Worker

Change = Callable[[State], State]
Work = Callable[[Progress], Change]
Listener = Callable[[dict[str, Any]], None]

SOON: Final = 200_000
"""Samples above which a record is shown before it went through the check gate."""
PATIENCE: Final = 0.15
"""How long the check gate lets the first plot of a record go first [s]."""

_LOG = logging.getLogger(__name__)


class BusyError(InputError):
    """Another job of this session is running."""


@final
@dataclass
class Job:
    """Work in progress: what the page shows beside the cancel button."""

    action: str
    text: str
    share: float = 0.0
    cancelled: bool = False
    task: Task | None = None
    change: Change | None = None

    def as_json(self) -> dict[str, Any]:
        """What the page shows."""
        return {
            "action": self.action,
            "text": "cancelling" if self.cancelled else self.text,
            "share": self.share,
            "cancelled": self.cancelled,
        }


@final
class Live:
    """A session with its records in memory.

    Parameters
    ----------
    session : Session
        Its folder; everything here is made from it again after a restart.

    Attributes
    ----------
    kept : mapping of str to (mark, value)
        Costly results in memory, each with the mark of what it was made from.
    seen : threading.Event
        Set when the newest record was drawn: the check gate lets that go first.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.state = session.load()
        self.lock = threading.RLock()
        self.building = threading.Lock()
        self.job: Job | None = None
        self.error: str | None = None
        self.listeners: set[Listener] = set()
        self.worker = Worker(f"session {session.id[:6]}")
        self.seen = threading.Event()
        self.kept: dict[str, tuple[Any, Any]] = {}
        self._records: dict[str, Record] = {}
        self._analysis: Analysis | None = None
        for entry in self.state.files:
            if entry.status == "checking":
                self._check_soon(entry.id)

    # --- state ------------------------------------------------------------------------------------

    def change(self, change: Change) -> State:
        """Apply a change, write it and tell the pages."""
        with self.lock:
            self.state = self.session.save(change(self.state))
            self.error = None
            now = self.state
        self.tell()
        return now

    def change_input(self, change: Change) -> State:
        """As `change`, for records or joint: where the input of the fits is another one then, they
        are put away as a branch.

        Raises
        ------
        BusyError
            A job runs on the old input.
        """
        with self.lock:
            self._free()
            return self.change(lambda s: self._moved(s, after_input(s, change(s))))

    def move(self, change: Change) -> State:
        """As `change`, to another place of the tree of fits.

        Raises
        ------
        BusyError
            A job runs.
        """
        with self.lock:
            self._free()
            return self.change(lambda s: self._moved(s, change(s)))

    def _moved(self, before: State, after: State) -> State:
        """`after`; what was prepared for another input, or another model, is given up."""
        if given(before) != given(after):
            self.worker.give_up()
            self._analysis = None
        elif before.steps[-1:] != after.steps[-1:] and self._analysis is not None:
            self.worker.give_up()
            if after.steps:
                self._analysis.restore(after.steps[-1])
            else:
                self._analysis = None
        if before.joint_text != after.joint_text and self._analysis is not None:
            self._analysis.joint = joint_of(after)
        return after

    def snapshot(self) -> dict[str, Any]:
        """What the page needs to know at once when something changed."""
        with self.lock:
            return {
                "revision": self.state.revision,
                "job": self.job.as_json() if self.job else None,
                "error": self.error,
            }

    def whole(self) -> dict[str, Any]:
        """State and snapshot of one moment, for the page."""
        with self.lock:
            return {**self.state.as_json(), **self.snapshot(), "id": self.session.id}

    def tell(self) -> None:
        """Send the snapshot to every open page."""
        snapshot = self.snapshot()
        for listener in tuple(self.listeners):
            listener(snapshot)

    def joint(self) -> Joint:
        """The joint of the session.

        Raises
        ------
        InputError
            None yet, or not a valid one.
        """
        return joint_of(self.state)

    # --- records and analysis ---------------------------------------------------------------------

    def examine(self, entry: FileEntry, *, soon: bool = False) -> FileEntry:
        """Read and check an upload; keeps its record in memory.

        Parameters
        ----------
        entry : FileEntry
        soon : bool
            A long record may come back with the status ``checking``, to be handed to `check_soon`:
            it can be looked at.
        """
        joint = self._joint_or_none()
        path = self.session.path_of(entry)
        made, record = opened(entry, path, self.kind_of(entry), self.columns_of(entry))
        if record is not None and not (soon and len(record) > SOON):
            made, record = checked(made, record, self.session.path_of(entry), joint)
        with self.lock:
            self._records.pop(entry.id, None)
            if record is not None:
                self._records[entry.id] = record
        return made

    def check_soon(self, entry: FileEntry) -> None:
        """Run the check gate on a record that is shown already; jobs wait for it."""
        if entry.status == "checking":
            self._check_soon(entry.id)

    def _check_soon(self, identifier: str) -> None:
        self.seen.clear()
        self.worker.submit(Task(lambda: self._check(identifier)))

    def _check(self, identifier: str) -> None:
        entry = next((f for f in self.state.files if f.id == identifier), None)
        if entry is None or entry.status != "checking":
            return
        self.seen.wait(PATIENCE)
        record, joint = self._records.get(identifier), self._joint_or_none()
        try:
            if record is None:
                made = self.examine(entry)
            else:
                made, whole = checked(entry, record, self.session.path_of(entry), joint)
                with self.lock:
                    self._records.pop(identifier, None)
                    if whole is not None:
                        self._records[identifier] = whole
        except (
            Exception
        ) as problem:  # a record that cannot be checked must not be used, nor wait for ever
            said = (
                f"{entry.name}: cannot be checked, "
                f"{internal_error(problem, f'page: checking {entry.name}')}"
            )
            _LOG.error(said)
            made = replace(entry, status="refused", message=said)

        def put(s: State) -> State:
            files = tuple(
                replace(made, role=f.role, role_reason=f.role_reason) if f.id == identifier else f
                for f in s.files
            )
            return self._moved(s, after_input(s, replace(s, files=files)))

        self.change(put)

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

    def analysis(self) -> Analysis:
        """The analysis of the state as it is; prepared again after a restart."""
        with self.building:
            if self._analysis is None:
                ready = [f for f in self.state.files if f.status == "ready"]
                used = [(f.role, without_windows(self.record(f.id), f.left_out)) for f in ready]
                train = [r for role, r in used if role == "train"]
                held = [r for role, r in used if role == "held_out"]
                made = Analysis(self.joint(), train, held)
                if self.state.steps:
                    made.restore(self.state.steps[-1])
                self._analysis = made
            return self._analysis

    def forget(self) -> None:
        """Free the memory; the folder has everything."""
        with self.lock:
            if self.job is None:
                self._analysis = None
                self._records.clear()

    @property
    def has_joint(self) -> bool:
        """Whether there is a valid joint."""
        return self._joint_or_none() is not None

    def columns_of(self, entry: FileEntry) -> Mapping[str, Any] | None:
        """The column map of a record: its own, else that of the joint file, where there is one."""
        joint = self._joint_or_none()
        return entry.columns or (joint.columns if joint else None)

    def kind_of(self, entry: FileEntry) -> str:
        """Kind of the axis: of the joint, else as the record's columns say it."""
        joint = self._joint_or_none()
        return joint.kind if joint else entry.kind or "rotary"

    def _joint_or_none(self) -> Joint | None:
        try:
            return self.joint()
        except InputError:
            return None

    # --- jobs -------------------------------------------------------------------------------------

    def _free(self) -> None:
        if self.job is not None:
            raise BusyError(f"busy: {self.job.text}; wait for it or cancel it")

    def start(
        self,
        action: str,
        text: str,
        work: Work,
        after: Callable[[], None] | None = None,
        *,
        asked: Mapping[str, Any] | None = None,
    ) -> None:
        """Run work in the session's thread; its change is applied only if it came to its end.

        Parameters
        ----------
        action, text : str
        work : callable
            ``work(progress) -> change of the state``.
        after : callable, optional
            Called when the change is in the state: queues spare work for the next click.
        asked : mapping, optional
            The request, written into the session's folder until the work has ended.

        Raises
        ------
        BusyError
            Another job is running; nothing is started.
        """
        with self.lock:
            self._free()
            job = self.job = Job(action, text)
            job.task = Task(lambda: self._run(job, work))
            self.error = None
            if asked is not None:
                with contextlib.suppress(OSError):  # a full disk: the work itself may still do
                    self.session.begin({"action": action, **asked})
        self.seen.set()
        self.tell()
        self.worker.submit(Task(lambda: self._guarded(job, after)))

    def ahead(self, work: Callable[[], None]) -> None:
        """Queue spare work: given up when a job comes."""

        def quiet() -> None:
            try:
                work()
            except (InputError, ValueError, ArithmeticError):
                _LOG.debug("preparing the next click failed", exc_info=True)

        self.worker.submit(Task(quiet, spare=True))

    def _guarded(self, job: Job, after: Callable[[], None] | None) -> None:
        made = self._analysis
        before = (made.solution, made.trials) if made is not None else None
        job.change = None
        error: str | None = None
        try:
            if job.task is not None:
                job.task.run()
        except CancelledError:
            job.cancelled = True
        except InputError as problem:
            error = str(problem)
        except (
            Exception
        ) as problem:  # the page must get a sentence for whatever goes wrong in a fit
            if not job.cancelled:  # foreign code turns the request to stop into errors of its own
                error = (
                    f"{job.action}: {internal_error(problem, f'page: {job.action}')}; the "
                    "state before it is kept"
                )
                _LOG.error(error)
        if job.cancelled:
            job.change, error = None, f"{job.action}: cancelled; nothing was changed"
        done = job.change is not None
        self._finish(job.change, error, before)
        if done and after is not None:
            after()

    def _run(self, job: Job, work: Work) -> None:
        def progress(text: str, share: float) -> None:
            job.text, job.share = text, share
            self.tell()

        job.change = work(progress)

    def _finish(
        self, change: Change | None, error: str | None, before: tuple[Any, Any] | None
    ) -> None:
        with self.lock:
            if change is not None:
                try:
                    made = change(self.state)
                    if given(made) != given(self.state):
                        self._analysis = None
                    elif made.joint_text != self.state.joint_text and self._analysis is not None:
                        self._analysis.joint = joint_of(made)
                    self.state = self.session.save(made)
                except OSError as problem:
                    error = (
                        f"the session folder cannot be written ({problem.strerror}); free "
                        "some space"
                    )
            elif self._analysis is not None:
                if before is not None:
                    self._analysis.solution, self._analysis.trials = before
                elif self.state.steps:
                    self._analysis = None
            self.job, self.error = None, error
            with contextlib.suppress(OSError):
                self.session.end()
        self.tell()

    def can(self, change: Change) -> bool:
        """Whether a change has something to do."""
        try:
            change(self.state)
        except InputError:
            return False
        return True

    def say(self, error: str) -> None:
        """A sentence for the page, until the next change."""
        with self.lock:
            self.error = error
        self.tell()

    def cancel(self) -> bool:
        """Stop the running job at its next line of Python; True where there was one."""
        with self.lock:
            job = self.job
        if job is None or job.task is None:
            return False
        job.cancelled = True
        self.tell()
        job.task.stop()
        return True


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


def hint_for(state: State, label: str) -> Mapping[str, Any] | None:
    """Start values of a candidate from the diagnosis on disk."""
    rows = (state.diagnosis or {}).get("ranking", [])
    found: Mapping[str, Any] | None = next((r for r in rows if r.get("label") == label), None)
    return found
