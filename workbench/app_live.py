"""One session in memory: its state, its analysis, and the one job that may run on it at a time."""

from __future__ import annotations

import ctypes
import logging
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, final

from identification.errors import InputError
from identification.joint_file import Joint, parse_joint
from identification.record import Record
from workbench.app_analysis import Analysis, Progress
from workbench.app_records import examined
from workbench.session import FileEntry, Session, State

Change = Callable[[State], State]
Work = Callable[[Progress], Change]
Listener = Callable[[dict[str, Any]], None]

PREPARED: Final = 3
"""Best candidates that are fitted ahead of the click after a diagnosis."""

_LOG = logging.getLogger(__name__)


class CancelledError(Exception):
    """Raised inside a job that the user cancelled."""


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
    working: bool = True
    thread: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def as_json(self) -> dict[str, Any]:
        """What the page shows."""
        return {"action": self.action, "text": self.text, "share": self.share}


@final
class Live:
    """A session with its records in memory.

    Parameters
    ----------
    session : Session
        Its folder; everything here is made from it again after a restart.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.state = session.load()
        self.lock = threading.RLock()
        self.building = threading.Lock()
        self.job: Job | None = None
        self.error: str | None = None
        self.listeners: set[Listener] = set()
        self._records: dict[str, Record] = {}
        self._analysis: Analysis | None = None

    # --- state ------------------------------------------------------------------------------------------------------

    def change(self, change: Change) -> State:
        """Apply a change, write it and tell the pages."""
        with self.lock:
            self.state = self.session.save(change(self.state))
            self.error = None
            now = self.state
        self.tell()
        return now

    def change_input(self, change: Change) -> State:
        """As `change`, for records or joint: what was fitted before does not hold any more.

        Raises
        ------
        BusyError
            A job runs on the old input.
        """
        with self.lock:
            self._free()
            self._analysis = None
            return self.change(lambda s: change(s).without_fit())

    def snapshot(self) -> dict[str, Any]:
        """What the page needs to know at once when something changed."""
        with self.lock:
            return {"revision": self.state.revision, "job": self.job.as_json() if self.job else None, "error": self.error}

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
        import tomllib

        if not self.state.joint_text:
            raise InputError("no joint yet: fill in gear ratio, motor constant and model on the Model page")
        try:
            return parse_joint(tomllib.loads(self.state.joint_text), self.state.joint_source or "joint")
        except tomllib.TOMLDecodeError as error:
            raise InputError(f"the joint file is not valid TOML ({error})") from None

    # --- records and analysis ---------------------------------------------------------------------------------------

    def examine(self, entry: FileEntry) -> FileEntry:
        """Read and check an upload; keeps its record in memory."""
        joint = self._joint_or_none()
        columns = entry.columns or (joint.columns if joint else None)
        made, record = examined(
            entry, self.session.path_of(entry), joint.kind if joint else "rotary", joint.gear_ratio if joint else None, columns
        )  # fmt: skip
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

    def analysis(self) -> Analysis:
        """The analysis of the state as it is; prepared again after a restart."""
        with self.building:
            if self._analysis is None:
                ready = [f for f in self.state.files if f.status == "ready"]
                train = [self.record(f.id) for f in ready if f.role == "train"]
                held = [self.record(f.id) for f in ready if f.role == "held_out"]
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

    def _joint_or_none(self) -> Joint | None:
        try:
            return self.joint()
        except InputError:
            return None

    # --- jobs -------------------------------------------------------------------------------------------------------

    def _free(self) -> None:
        if self.job is not None:
            raise BusyError(f"busy: {self.job.text}; wait for it or cancel it")

    def start(self, action: str, text: str, work: Work, after: Callable[[Callable[[], bool]], None] | None = None) -> None:
        """Run work in a thread of its own; its change is applied only if it came to its end.

        Parameters
        ----------
        action, text : str
        work : callable
            ``work(progress) -> change of the state``.
        after : callable, optional
            ``after(wanted)``: preparation for the next click, given up when a new job starts.

        Raises
        ------
        BusyError
            Another job is running; nothing is started.
        """
        with self.lock:
            self._free()
            job = self.job = Job(action, text)
            self.error = None
        threading.Thread(target=self._run, args=(job, work, after), daemon=True, name=f"job {action}").start()
        self.tell()

    def _run(self, job: Job, work: Work, after: Callable[[Callable[[], bool]], None] | None) -> None:
        job.thread = threading.get_ident()

        def progress(text: str, share: float) -> None:
            if job.cancelled:
                raise CancelledError
            job.text, job.share = text, share
            self.tell()

        made = self._analysis
        before = (made.solution, made.trials) if made is not None else None
        change: Change | None = None
        error: str | None = None
        try:
            change = work(progress)
        except CancelledError:
            error = f"{job.action}: cancelled; nothing was changed"
        except InputError as problem:
            error = str(problem)
        except Exception as problem:  # the page must get a sentence for whatever goes wrong in a fit
            _LOG.exception("job %s failed", job.action)
            error = f"{job.action} failed ({type(problem).__name__}: {problem}); the state before it is kept"
        with job.lock:
            job.working = False
        if job.cancelled:
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(job.thread), None)
            change, error = None, f"{job.action}: cancelled; nothing was changed"
        self._finish(job, change, error, before)
        if change is not None and after is not None:
            self._prepare(after)

    def _finish(self, job: Job, change: Change | None, error: str | None, before: tuple[Any, Any] | None) -> None:
        with self.lock:
            if change is not None:
                try:
                    self.state = self.session.save(change(self.state))
                except OSError as problem:
                    error = f"the session folder cannot be written ({problem.strerror}); free some space"
            elif self._analysis is not None:
                if before is not None:
                    self._analysis.solution, self._analysis.trials = before
                elif self.state.steps:
                    self._analysis = None
            self.job, self.error = None, error
        self.tell()

    def _prepare(self, after: Callable[[Callable[[], bool]], None]) -> None:
        revision = self.state.revision
        try:
            after(lambda: self.job is None and self.state.revision == revision)
        except (InputError, ValueError, ArithmeticError):
            _LOG.debug("preparing the next click failed", exc_info=True)

    def cancel(self) -> bool:
        """Stop the running job at its next step; True where there was one."""
        with self.lock:
            job = self.job
        if job is None:
            return False
        with job.lock:
            job.cancelled = True
            if job.working and job.thread:
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(job.thread), ctypes.py_object(CancelledError))
        return True


def with_step(state: State, step: Any, **more: Any) -> State:
    """The state with one more step on the ledger."""
    return replace(state, steps=(*state.steps, step), undone=(), diagnosis=None, **more)


def hint_for(state: State, label: str) -> Mapping[str, Any] | None:
    """Start values of a candidate from the diagnosis on disk."""
    rows = (state.diagnosis or {}).get("ranking", [])
    found: Mapping[str, Any] | None = next((r for r in rows if r.get("label") == label), None)
    return found
