"""Work beside the page: one thread per session, tasks that stop at their next line of Python."""

from __future__ import annotations

import ctypes
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, final

IDLE_SECONDS: Final = 600.0
"""The thread of a session ends after this long without work."""

_LOG = logging.getLogger(__name__)


class CancelledError(BaseException):
    """Raised inside a task that was stopped; no `except Exception` of the work can take it for
    an error.
    """


@final
class Task:
    """A piece of work that another thread can stop.

    Parameters
    ----------
    work : callable
    spare : bool
        Made ahead of a click: given up when a job comes.
    """

    def __init__(self, work: Callable[[], None], spare: bool = False) -> None:
        self.work, self.spare = work, spare
        self.stopped = False
        self._lock = threading.Lock()
        self._thread = 0

    def run(self) -> None:
        """Do the work in this thread.

        Raises
        ------
        CancelledError
            It was stopped; never after this returned.
        """
        try:
            try:
                self._enter()
                self.work()
            finally:
                self._leave()
        except CancelledError:
            self._leave()  # the request to stop may have come inside the first call
            raise

    def stop(self) -> None:
        """Stop it at its next line of Python, or before it begins; asks again until it has
        ended.
        """
        with self._lock:
            if self.stopped:
                return
            self.stopped = True
        if self._ask():
            threading.Thread(target=self._insist, daemon=True, name="stopping").start()

    def _ask(self) -> bool:
        """Raise `CancelledError` in the thread that works; False where none does."""
        with self._lock:
            if not self._thread:
                return False
            ctypes.pythonapi.PyThreadState_SetAsyncExc(
                ctypes.c_ulong(self._thread), ctypes.py_object(CancelledError)
            )
            return True

    def _insist(self) -> None:
        """An exception inside a finaliser is lost: ask again, less and less often."""
        pause = 0.2
        time.sleep(pause)
        while self._ask():
            pause = min(1.5 * pause, 2.0)
            time.sleep(pause)

    def _enter(self) -> None:
        with self._lock:
            if self.stopped:
                raise CancelledError
            self._thread = threading.get_ident()

    def _leave(self) -> None:
        with self._lock:
            if (
                self._thread and self.stopped
            ):  # CPython 3.11 under a profiler hangs on a request that was taken back
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(self._thread), None)
            self._thread = 0


@final
class Worker:
    """Runs the tasks of one session one after the other, in one thread: what it has compiled
    stays at hand.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._tasks: deque[Task] = deque()
        self._now: Task | None = None
        self._ready = threading.Condition()
        self._alive = False

    def submit(self, task: Task) -> None:
        """Queue a task; spare work is given up for one that is not spare."""
        with self._ready:
            if not task.spare:
                self.give_up()
            self._tasks.append(task)
            self._ready.notify()
            if not self._alive:
                self._alive = True
                threading.Thread(target=self._loop, daemon=True, name=self.name).start()

    def give_up(self) -> None:
        """Stop the spare work, and what of it waits."""
        with self._ready:
            self._tasks = deque(t for t in self._tasks if not t.spare)
            if self._now is not None and self._now.spare:
                self._now.stop()

    @property
    def idle(self) -> bool:
        """Whether nothing runs or waits."""
        with self._ready:
            return self._now is None and not self._tasks

    def _loop(self) -> None:
        while True:
            with self._ready:
                self._now = None
                if not self._tasks and not self._ready.wait_for(
                    lambda: bool(self._tasks), IDLE_SECONDS
                ):
                    self._alive = False
                    return
                self._now = task = self._tasks.popleft()
            try:
                task.run()
            except CancelledError:
                _LOG.debug("a task was stopped")
            except Exception:  # a task that fails must not take the session's thread with it
                if not task.stopped:
                    _LOG.exception("a task failed")
            del task


__all__ = ["CancelledError", "Task", "Worker"]
