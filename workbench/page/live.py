"""One session in memory: its state, its analysis, and the one job that may run on it at a time."""

from __future__ import annotations

import contextlib
import gc
import logging
import secrets
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, final

from identification.crash import internal_error
from identification.errors import InputError
from workbench.page.analysis import Progress
from workbench.page.desk.tree import after_input, given
from workbench.page.jobs.child import Ask, Done, Refused, refused
from workbench.page.jobs.doing import unchanged
from workbench.page.jobs.place import Change, Place, described
from workbench.page.jobs.process import Halt, Helper, InternalError
from workbench.page.records import checked
from workbench.page.session import FileEntry, Session, State
from workbench.page.work import CancelledError, Task, Worker

Here = Callable[[Progress], Change]
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
    halt: Halt = field(default_factory=Halt)

    def as_json(self) -> dict[str, Any]:
        """What the page shows."""
        return {
            "action": self.action,
            "text": "cancelling" if self.cancelled else self.text,
            "share": self.share,
            "cancelled": self.cancelled,
        }


@final
class Live(Place):
    """A session with its records in memory. What the views draw is computed here; long work has a
    process of its own.

    Parameters
    ----------
    session : Session
        Its folder; everything here is made from it again after a restart.
    sources : tuple of str
        What the Replay page may follow, as the server was told at its start.

    Attributes
    ----------
    helper : Helper
        The process of the session.
    begun : str
        Of the job that was started last: a page knows by it whether a state is from before its
        job.
    seen : threading.Event
        Set when the newest record was drawn: the check gate lets that go first.
    """

    def __init__(self, session: Session, sources: tuple[str, ...] = ()) -> None:
        super().__init__(session, session.load())
        self.sources = sources
        self.job: Job | None = None
        self.error: str | None = None
        self.begun = ""
        self._said, self._teller = 0, secrets.token_hex(4)
        self.listeners: set[Listener] = set()
        self.helper = Helper(session.folder)
        self.worker = Worker(f"session {session.id[:6]}", self.helper.close)
        self.seen = threading.Event()
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
            self._analysis.joint = described(after)
        return after

    def snapshot(self) -> dict[str, Any]:
        """What the page needs to know at once when something changed. ``said`` grows with every
        change that is told, by one ``teller``: of two that overtook one another the page knows
        the newer one. After a restart another one tells, whose numbers begin anew.
        """
        with self.lock:
            return {
                "said": self._said,
                "teller": self._teller,
                "revision": self.state.revision,
                "job": self.job.as_json() if self.job else None,
                "error": self.error,
                "begun": self.begun,
            }

    def whole(self) -> dict[str, Any]:
        """State and snapshot of one moment, for the page."""
        with self.lock:
            return {**self.state.as_json(), **self.snapshot(), "id": self.session.id}

    def tell(self) -> None:
        """Send the snapshot to every open page."""
        with self.lock:
            self._said += 1
            snapshot = self.snapshot()
        for listener in tuple(self.listeners):
            listener(snapshot)

    # --- records ----------------------------------------------------------------------------------

    def check_soon(self, entry: FileEntry) -> None:
        """Run the check gate on a record that is shown already; jobs wait for it."""
        if entry.status == "checking":
            self._check_soon(entry.id)

    def _check_soon(self, identifier: str) -> None:
        self.seen.clear()
        self.worker.submit(Task(lambda: self._check(identifier)))

    def _check(self, identifier: str) -> None:
        with self.library():
            self._checked(identifier)

    def _checked(self, identifier: str) -> None:
        entry = next((f for f in self.state.files if f.id == identifier), None)
        if entry is None or entry.status != "checking":
            return
        self.seen.wait(PATIENCE)
        record, joint = self._records.get(identifier), self.joint_or_none()
        try:
            if record is None:
                made = self.examine(entry)
            else:
                path, mapped = self.session.path_of(entry), bool(self.columns_of(entry))
                made, whole = checked(entry, record, path, joint, mapped=mapped)
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

    def forget(self) -> None:
        """Free the memory; the folder has everything."""
        with self.lock:
            if self.job is None:
                self._analysis = None
                self._records.clear()

    def close(self) -> None:
        """End thread and process of the session and free its memory; the folder has everything."""
        self.worker.close()
        self.helper.close()
        self.forget()
        gc.collect()  # its fits refer to one another and would wait long for the collector

    # --- jobs -------------------------------------------------------------------------------------

    def _free(self) -> None:
        if self.job is not None:
            raise BusyError(f"busy: {self.job.text}; wait for it or cancel it")

    def start(
        self,
        action: str,
        text: str,
        body: Mapping[str, Any],
        *,
        here: Here | None = None,
        after: Callable[[], None] | None = None,
    ) -> None:
        """Begin an action; its change is applied only if it came to its end.

        Parameters
        ----------
        action, text : str
        body : mapping
            The request, written into the session's folder until the action has ended.
        here : callable, optional
            ``here(progress) -> change`` for short work in the session's thread; without it the
            process of the session does the action.
        after : callable, optional
            Called when the change is in the state: queues spare work for the next click.

        Raises
        ------
        BusyError
            Another job is running; nothing is started.
        """
        with self.lock:
            self._free()
            job = self.job = Job(action, text)
            self.begun = secrets.token_hex(4)
            self.error = None
            with contextlib.suppress(OSError):  # a full disk: the work itself may still do
                self.session.begin({**body, "action": action})
        self.seen.set()
        self.tell()
        try:
            self.worker.submit(Task(lambda: self._guarded(job, body, here, after)))
        except RuntimeError as problem:  # no thread can be started
            with self.lock:
                self._end(
                    f"{action}: a thread for the work cannot be started ({problem}); close other "
                    "programs and start it again"
                )
            self.tell()

    def ahead(self, action: str, body: Mapping[str, Any]) -> None:
        """Queue spare work of the session's process: given up when a job comes."""
        halt = Halt()

        def quiet() -> None:
            try:
                with self.library():
                    done = self._done_apart(action, body, lambda text, share: None, halt, True)
                if halt.either:
                    return
                with self.lock:
                    if done.change is not unchanged:
                        self.change(done.change)
                    self._adopt(done)
            except (InputError, InternalError):
                _LOG.debug("preparing the next click failed", exc_info=True)

        self.worker.submit(Task(quiet, spare=True, stop=halt.soon))

    def _done_apart(
        self,
        action: str,
        body: Mapping[str, Any],
        progress: Progress,
        halt: Halt,
        spare: bool = False,
    ) -> Done:
        with self.lock:
            asked = Ask(action, dict(body), self.state, self.fitted_here(), spare)
        return self.helper.do(asked, progress, halt)

    def _ready_for_views(self) -> None:
        """Prepare the analysis of this process while the other one works."""
        with self.library(), contextlib.suppress(InputError, ValueError, ArithmeticError):
            self.analysis()

    def _adopt(self, done: Done) -> None:
        """Stand on the model that the process fitted, and keep what it fitted ahead."""
        with self.lock:
            self.fitted_elsewhere(done.fitted)
            if self._analysis is not None and self.state.steps:
                for label, step, fitted in done.ahead:
                    self._analysis.prepared_elsewhere(label, step, fitted)

    def _guarded(
        self,
        job: Job,
        body: Mapping[str, Any],
        here: Here | None,
        after: Callable[[], None] | None,
    ) -> None:
        """Do a job, which ends whatever dies in it: nothing above this thread could say so."""
        try:
            self._work(job, body, here, after)
        except BaseException as problem:  # also what ends a thread, such as SystemExit
            with self.lock:
                if self.job is job:
                    self._end(_sentence(problem, job.action))
            self.tell()

    def _work(
        self,
        job: Job,
        body: Mapping[str, Any],
        here: Here | None,
        after: Callable[[], None] | None,
    ) -> None:
        change: Change | None = None
        done: Done | None = None
        error: str | None = None

        def progress(text: str, share: float) -> None:
            job.text, job.share = text, share
            self.tell()

        with self.library():
            try:
                if job.halt.now:
                    raise CancelledError
                if here is not None:
                    change = here(progress)
                else:
                    if not self.ready:
                        threading.Thread(
                            target=self._ready_for_views, daemon=True, name="views"
                        ).start()
                    done = self._done_apart(job.action, body, progress, job.halt)
                    change = done.change
            except CancelledError:
                job.cancelled = True
            except InputError as problem:
                error = str(problem)
            except (
                Exception
            ) as problem:  # the page must get a sentence for whatever goes wrong in a fit
                error = _sentence(problem, job.action)
            if job.cancelled:
                change, error = None, f"{job.action}: cancelled; nothing was changed"
            self._finish(change, done, error)
        if change is not None and after is not None:
            after()

    def _finish(self, change: Change | None, done: Done | None, error: str | None) -> None:
        with self.lock:
            if change is not None:
                try:
                    made = change(self.state)
                    if given(made) != given(self.state):
                        self._analysis = None
                    elif made.joint_text != self.state.joint_text and self._analysis is not None:
                        self._analysis.joint = described(made)
                    self.state = self.session.save(made)
                    if done is not None:
                        self._adopt(done)
                except OSError as problem:
                    there = self.session.folder.is_dir()
                    error = (
                        f"the session folder cannot be written ({problem.strerror}); "
                        f"{'free some space' if there else 'put it back where it was'}"
                    )
            self._end(error)
        self.tell()

    def _end(self, error: str | None) -> None:
        """No job any more; the caller has the lock. Its note in the folder goes first: whoever
        sees that the job has ended, without the lock too, finds nothing left of it.
        """
        with contextlib.suppress(OSError):
            self.session.end()
        self.error, self.job = error, None

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
        """End the running job, and the process that does it; True where there was one."""
        with self.lock:
            job = self.job
            if job is None:
                return False
            job.cancelled = True
        self.tell()
        job.halt.at_once()
        return True


def _sentence(problem: BaseException, action: str) -> str:
    """What the page says of a job that ended in an error of no user; an internal one is logged."""
    made = Refused(str(problem), True) if isinstance(problem, InternalError) else None
    made = made or refused(problem, action)
    if not made.internal:
        return made.sentence
    said = f"{action}: {made.sentence}; the state before it is kept"
    _LOG.error(said)
    return said


__all__ = ["SOON", "BusyError", "Job", "Live"]
