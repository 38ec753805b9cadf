"""The process of a session: it keeps the prepared records, takes one piece of work at a time over a
pipe, and sends back how far it is and what it found.
"""

from __future__ import annotations

import contextlib
import errno
import multiprocessing
import os
import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, final

from casadi_models import EFFECTS
from casadi_models.effect import EffectFile
from identification.crash import internal_error
from identification.errors import InputError
from workbench.page.analysis import Fitted, Progress
from workbench.page.jobs.doing import ACTIONS
from workbench.page.jobs.place import Change, Place
from workbench.page.session import Session, State, StepEntry

STOP: Final = "stop"
"""Sent while spare work runs: it ends at its next stage."""
FIRST_TO_GO: Final = "500"
"""Linux's `oom_score_adj` of the process, half of its range: where the memory runs out it is ended
before the server, which has the sessions.
"""

FULL: Final = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a disk, or of a user's share of it, that takes no more."""


@final
@dataclass(frozen=True)
class Ask:
    """A piece of work.

    Attributes
    ----------
    action : str
        One of `ACTIONS`.
    body : mapping
        The request of the page.
    state : State
        What to work on.
    fitted : Fitted or None
        The fitted model of its last step, where the server has it.
    spare : bool
        It ends at its next stage when anything else is sent.
    """

    action: str
    body: dict[str, Any]
    state: State
    fitted: Fitted | None = None
    spare: bool = False


@final
@dataclass(frozen=True)
class Said:
    """How far a piece of work is."""

    text: str
    share: float


@final
@dataclass(frozen=True)
class Refused:
    """Work that ended without a result: a sentence for the user; empty where it was stopped."""

    sentence: str
    internal: bool = False


@final
@dataclass(frozen=True)
class Done:
    """Work that came to its end.

    Attributes
    ----------
    change : callable
        From the state to the next one.
    fitted : Fitted or None
        The current model, on which the last step of the changed state stands.
    ahead : tuple of (label, step, fitted)
        Candidates that were fitted beside it.
    preparing : float
        What it took to prepare the records [s]: what it costs to end this process.
    """

    change: Change
    fitted: Fitted | None
    ahead: tuple[tuple[str, StepEntry, Fitted], ...]
    preparing: float


class _StoppedError(BaseException):
    """Spare work was stopped; no `except Exception` takes it for an error."""


def main(pipe: Connection, folder: Path, files: Sequence[EffectFile]) -> None:
    """Serve one session until the pipe is closed.

    Parameters
    ----------
    pipe : Connection
        Gets `Ask` and `STOP`, gives `Said` and then `Refused` or `Done`.
    folder : Path
        Of the session.
    files : sequence of EffectFile
        Effect files of the user, as the server has loaded them.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "setsid"):
        os.setsid()  # what it starts, such as a compiler, ends with it
    with contextlib.suppress(OSError):  # another system than Linux
        Path("/proc/self/oom_score_adj").write_text(FIRST_TO_GO, encoding="ascii")
    threading.Thread(target=_end_with_the_server, daemon=True, name="watching").start()
    known = {f.sha256 for f in EFFECTS.files}
    for file in files:
        if file.sha256 not in known:
            EFFECTS.load_code(file.path, file.code, tried=True)
    place = Place(Session(folder), State())
    while True:
        try:
            asked = pipe.recv()
            if isinstance(asked, Ask):
                _send(pipe, asked.action, _answer(pipe, place, asked))
        except (EOFError, OSError):  # the server closed the pipe, or has ended
            return


def _send(pipe: Connection, action: str, answer: Done | Refused) -> None:
    """Send an answer; one that cannot be packed is refused, so that the work does not end in the
    end of its process.
    """
    try:
        pipe.send(answer)
    except (EOFError, OSError):
        raise
    except Exception as error:  # nothing of it was sent: it is packed first
        pipe.send(refused(error, action))


def _end_with_the_server() -> None:
    parent: Any = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        if hasattr(os, "killpg"):
            os.killpg(os.getpgid(0), signal.SIGKILL)
        os._exit(1)


def _answer(pipe: Connection, place: Place, asked: Ask) -> Done | Refused:
    def progress(text: str, share: float) -> None:
        if not asked.spare:
            pipe.send(Said(text, share))
        elif pipe.poll():
            raise _StoppedError

    try:
        with EFFECTS.scoped():
            return _done(place, asked, progress)
    except _StoppedError:
        return Refused("")
    except InputError as error:
        return Refused(str(error))
    except Exception as error:  # the page must get a sentence for whatever goes wrong in a fit
        return refused(error, asked.action)


def refused(error: BaseException, action: str) -> Refused:
    """The sentence for work that ended in an error which is no refusal of its own: what the machine
    lacks is said as such; all else is an internal error.
    """
    if isinstance(error, MemoryError):
        return Refused(
            f"{action}: the memory ran out; fits before it are kept; leave out records or "
            "windows of them"
        )
    if isinstance(error, OSError) and error.errno in FULL:
        return Refused(
            f"{action}: the disk is full ({error.strerror}); fits before it are kept; free some "
            "space and start it again"
        )
    return Refused(internal_error(error, f"page: {action}"), internal=True)


def _done(place: Place, asked: Ask, progress: Progress) -> Done:
    place.take(asked.state, asked.fitted)
    was = place.ready
    before = (place.analysis().solution, set(place.analysis().ahead)) if was else (None, set())
    change = ACTIONS[asked.action](place, asked.body, progress)
    if not place.ready:
        return Done(change, None, (), 0.0)
    analysis = place.analysis()
    now = analysis.solution
    return Done(
        change,
        analysis.fitted(now) if now is not None and now is not before[0] else None,
        tuple(
            (label, step, analysis.fitted(made))
            for label, (step, made) in analysis.ahead.items()
            if label not in before[1]
        ),
        place.preparing,
    )


__all__ = ["STOP", "Ask", "Done", "Refused", "Said", "main", "refused"]
