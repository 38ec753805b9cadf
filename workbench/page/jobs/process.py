"""The process of a session as the server sees it: started when there is work, ended when that is
cancelled.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
import weakref
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Final, final

from casadi_models import EFFECTS
from identification.errors import InputError
from identification.scratch import deaf_children
from workbench.page.analysis import Progress
from workbench.page.jobs.child import STOP, Ask, Done, Refused, Said, main
from workbench.page.work import CancelledError

TICK: Final = 0.05
"""How often a wish to stop is looked for while nothing comes [s]: below what feels late."""
LEAST: Final = 0.5
"""Spare work that is given up has at least so long to come to its next stage [s]; else it has as
long as it takes to prepare the records again in a new process.
"""
ENDING: Final = 5.0
"""A process that closed its pipe has ended after this long [s]."""


@final
class BrokenOffError(InputError):
    """The process of a session ended in the middle of its work."""


@final
class InternalError(RuntimeError):
    """An error of the program in the process of a session: a sentence that says where its trace
    is.
    """


@final
class Halt:
    """The wish that a piece of work stops: at once, or, for spare work, at its next stage."""

    def __init__(self) -> None:
        self._now, self._soon = threading.Event(), threading.Event()

    def at_once(self) -> None:
        """End its process."""
        self._now.set()

    def soon(self) -> None:
        """Let it come to its next stage."""
        self._soon.set()

    @property
    def now(self) -> bool:
        """Whether it was stopped at once."""
        return self._now.is_set()

    @property
    def either(self) -> bool:
        """Whether it was stopped in either way."""
        return self._now.is_set() or self._soon.is_set()


@final
class Helper:
    """The one process of a session; a thread at a time works with it.

    Parameters
    ----------
    folder : Path
        Of the session.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._lock = threading.Lock()
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None
        self._at_exit: weakref.finalize[[BaseProcess], Helper] | None = None
        self._preparing = 0.0

    @property
    def pid(self) -> int | None:
        """Number of the process, where there is one."""
        process = self._process
        return process.pid if process is not None else None

    def do(self, asked: Ask, progress: Progress, halt: Halt) -> Done:
        """Have a piece of work done.

        Raises
        ------
        InputError
            What the work says.
        BrokenOffError
            The process was ended by another one, or by the system.
        CancelledError
            The work was stopped.
        InternalError
        """
        if halt.either:
            raise CancelledError
        with self._lock:
            try:
                said = self._exchange(asked, progress, halt)
            except BaseException:
                self._end()  # what would come next from the pipe belongs to nobody
                raise
        if isinstance(said, Done):
            self._preparing = said.preparing
            return said
        if not said.sentence:
            raise CancelledError
        raise InternalError(said.sentence) if said.internal else InputError(said.sentence)

    def close(self) -> None:
        """End the process, which has no work; the next work starts another one."""
        with self._lock:
            if self._process is not None and self._pipe is not None:
                self._pipe.close()
                self._process.join(ENDING)
            self._end()

    def _exchange(self, asked: Ask, progress: Progress, halt: Halt) -> Done | Refused:
        pipe = self._running()
        late: float | None = None
        try:
            pipe.send(asked)
            while True:
                if halt.now or (late is not None and time.monotonic() > late):
                    raise CancelledError
                if halt.either and late is None:
                    pipe.send(STOP)
                    late = time.monotonic() + max(LEAST, self._preparing)
                if not pipe.poll(TICK):
                    continue
                said: Any = pipe.recv()
                if isinstance(said, Said):
                    progress(said.text, said.share)
                else:
                    return said  # type: ignore[no-any-return]
        except (EOFError, OSError):
            raise BrokenOffError(self._how(asked.action)) from None

    def _how(self, action: str) -> str:
        """How the process ended, for the user."""
        process, how = self._process, "it closed its pipe"
        if process is not None:
            process.join(ENDING)
            code = process.exitcode
            if code is not None:
                how = f"exit code {code}"
            if code is not None and code < 0:
                with contextlib.suppress(ValueError):
                    how = signal.Signals(-code).name
        return (
            f"{action}: the process that did the work was ended ({how}), by another program or "
            "because the memory ran out; nothing was changed and every fit is kept; start it "
            "again, or leave out records if it happens again"
        )

    def _running(self) -> Connection:
        if self._process is None or self._pipe is None or not self._process.is_alive():
            self._end()
            here, there = multiprocessing.Pipe()
            context = _context()
            process = context.Process(
                target=main, args=(there, self.folder, EFFECTS.files), daemon=True, name="session"
            )
            try:
                with deaf_children():
                    process.start()
            except (OSError, EOFError) as error:  # EOFError: what starts processes has ended
                why = getattr(error, "strerror", None) or "the system ended what starts it"
                raise InputError(
                    f"a process for the work cannot be started ({why}); close other programs and "
                    "start it again"
                ) from None
            finally:
                there.close()
            self._process, self._pipe = process, here
            self._at_exit = weakref.finalize(self, _kill, process)
        return self._pipe

    def _end(self) -> None:
        process, pipe, self._process, self._pipe = self._process, self._pipe, None, None
        if pipe is not None:
            pipe.close()
        if process is not None:
            _kill(process)
        if self._at_exit is not None:
            self._at_exit.detach()


def _kill(process: BaseProcess) -> None:
    """End a process and what it started, such as a compiler."""
    if process.pid is not None and process.is_alive():
        with contextlib.suppress(AttributeError, ProcessLookupError, PermissionError):
            if os.getpgid(process.pid) == process.pid:
                os.killpg(process.pid, signal.SIGKILL)
        process.kill()
    process.join(ENDING)


def _context() -> Any:
    """How a process is started: as a copy of one that has imported everything already, where the
    system can; else anew.
    """
    known = multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if "forkserver" in known else "spawn")
    if "forkserver" in known:
        context.set_forkserver_preload([main.__module__])
    return context


def warm_up() -> None:
    """Start the process that the others are copies of, before the first work needs it."""
    process = _context().Process(target=os.getpid, daemon=True, name="warm up")
    with contextlib.suppress(OSError, EOFError, RuntimeError):  # the server ends just then
        with deaf_children():
            process.start()
        process.join()


__all__ = ["BrokenOffError", "Halt", "Helper", "InternalError", "warm_up"]
