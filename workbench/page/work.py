"""Work beside the page: one thread per session, which waits for the process that computes."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Final, final

IDLE_SECONDS: Final = 600.0
"""The thread of a session ends after this long without work, and its process with it."""

_LOG = logging.getLogger(__name__)


class CancelledError(BaseException):
    """Work that was stopped; no `except Exception` can take it for an error."""


@final
class Task:
    """A piece of work that another thread can stop.

    Parameters
    ----------
    work : callable
    spare : bool
        Made ahead of a click: given up when a job comes.
    stop : callable, optional
        Lets work that has begun end early; without it such work comes to its end.
    """

    def __init__(
        self,
        work: Callable[[], None],
        spare: bool = False,
        stop: Callable[[], None] | None = None,
    ) -> None:
        self.work, self.spare = work, spare
        self._stop = stop
        self._stopped = threading.Event()

    @property
    def stopped(self) -> bool:
        """Whether it was told to stop."""
        return self._stopped.is_set()

    def run(self) -> None:
        """Do the work in this thread.

        Raises
        ------
        CancelledError
            It was stopped before it began, or the work itself says so.
        """
        if self.stopped:
            raise CancelledError
        self.work()

    def stop(self) -> None:
        """Keep it from beginning, and let it end where it has begun and can."""
        self._stopped.set()
        if self._stop is not None:
            self._stop()


@final
class Worker:
    """Runs the tasks of one session one after the other, in one thread.

    Parameters
    ----------
    name : str
        Of the thread.
    idle : callable, optional
        Called when nothing came for `IDLE_SECONDS`.
    """

    def __init__(self, name: str, idle: Callable[[], None] | None = None) -> None:
        self.name = name
        self._left_idle = idle
        self._tasks: deque[Task] = deque()
        self._now: Task | None = None
        self._ready = threading.Condition()
        self._alive = self._closed = False

    def submit(self, task: Task) -> None:
        """Queue a task; spare work is given up for one that is not spare."""
        with self._ready:
            if not task.spare:
                self.give_up()
            self._closed = False
            self._tasks.append(task)
            self._ready.notify()
            if not self._alive:
                try:
                    threading.Thread(target=self._loop, daemon=True, name=self.name).start()
                except RuntimeError:  # the system has none left: nobody would do the task
                    self._tasks.remove(task)
                    raise
                self._alive = True

    def give_up(self) -> None:
        """Stop the spare work, and what of it waits."""
        with self._ready:
            self._tasks = deque(t for t in self._tasks if not t.spare)
            if self._now is not None and self._now.spare:
                self._now.stop()

    def close(self) -> None:
        """Give up the spare work, and let the thread end once the rest is done: what it keeps for
        the next task goes with it.
        """
        with self._ready:
            self.give_up()
            self._closed = True
            self._ready.notify()

    @property
    def idle(self) -> bool:
        """Whether nothing runs or waits."""
        with self._ready:
            return self._now is None and not self._tasks

    def _loop(self) -> None:
        while True:
            with self._ready:
                self._now = None
                self._ready.wait_for(lambda: self._closed or bool(self._tasks), IDLE_SECONDS)
                if not self._tasks:
                    self._alive = False
                    break
                self._now = task = self._tasks.popleft()
            try:
                task.run()
            except CancelledError:
                _LOG.debug("a task was stopped")
            except Exception:  # a task that fails must not take the session's thread with it
                if not task.stopped:
                    _LOG.exception("a task failed")
            del task
        if self._left_idle is not None:
            self._left_idle()


__all__ = ["CancelledError", "Task", "Worker"]
