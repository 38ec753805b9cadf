"""What every command line of the project does alike: one line on errors, checks before work,
results in one piece.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import re
import shlex
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import IO, Any, Final, NoReturn, final

from identification.crash import internal_error
from identification.data.schema import meant
from identification.errors import InputError
from identification.scratch import hold, part_of, release

CRASHED: Final = 3
"""Exit code after an error of the program itself: no answer, neither yes nor no."""
INTERRUPTED: Final = 130
"""Exit code after Ctrl-C."""
STOPPED: Final[list[int]] = []
"""Signals that came during this command."""
LONGEST: Final = 2000
"""Characters of a message: some lines of a terminal, with the whole effect library in it."""
_BAR: Final = [False]
"""Whether the last line on the terminal is a progress bar that goes on."""


@final
class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong with the arguments in one line."""

    def error(self, message: str) -> NoReturn:
        """Print the line, with the verb that may be meant, and exit with 2."""
        wrong = re.search(r"invalid choice: '([^']*)'", message)
        if wrong and self.verbs:
            message += meant(wrong[1], self.verbs)
        self.exit(2, f"{one_line(message)}; see `{self.prog} --help`\n")

    @property
    def arguments(self) -> tuple[argparse.Action, ...]:
        """Everything that may be given, but verbs; hidden options are left out."""
        return tuple(
            a
            for a in self._actions
            if not isinstance(a.choices, dict) and a.help != argparse.SUPPRESS
        )

    @property
    def verbs(self) -> dict[str, OneLineParser]:
        """The parsers of the verbs by name, in their order."""
        return {
            k: v for a in self._actions if isinstance(a.choices, dict) for k, v in a.choices.items()
        }


def counted(number: int, what: str) -> str:
    """A number and what is counted, as ``1 run`` or ``3 runs``."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def one_line(text: str) -> str:
    """A message as the command line prints it: of a very long one the two ends, signs that would
    steer a terminal as escapes.
    """
    plain = "".join(c if c.isprintable() or c.isspace() else repr(c)[1:-1] for c in str(text))
    line = "irj: " + " ".join(plain.split())
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"


def checkpoint() -> None:
    """Stop here after a signal that was swallowed: an exception inside a destructor or a
    callback goes no further.
    """
    if signal.SIGINT in STOPPED:
        raise KeyboardInterrupt
    if STOPPED:
        sys.exit(128 + STOPPED[0])


def progress_bar(text: str, share: float) -> None:
    """A line on the terminal that replaces itself; silent elsewhere. A :func:`checkpoint`, too."""
    checkpoint()
    if sys.stderr.isatty():
        width, _BAR[0] = round(30 * min(max(share, 0.0), 1.0)), share < 1
        sys.stderr.write(
            f"\r[{'#' * width}{'.' * (30 - width)}] {text:<40}{'' if _BAR[0] else chr(10)}"
        )
        sys.stderr.flush()


def end_bar() -> None:
    """Leave the line of a progress bar that has not come to its end."""
    if _BAR[0]:
        _BAR[0] = False
        sys.stderr.write("\n")


def fail(text: str) -> int:
    """Print one line on standard error; the exit code for unusable input.

    After a signal that is what counts: compiled code, or Python inside an FMU, may turn it into an
    error of its own.
    """
    end_bar()
    if STOPPED:
        return stopped()
    _say(one_line(text))
    return 2


def _say(line: str) -> None:
    """A line on standard error; the exit code tells it where nobody can read that."""
    with contextlib.suppress(OSError):
        sys.stderr.write(line + "\n")


def crashed(error: BaseException, doing: str) -> int:
    """Say that the program itself failed and where the trace is kept; the exit code for that.

    Parameters
    ----------
    error : BaseException
        What came up; after a signal it is the signal that counts.
    doing : str
        The command, for the file with the trace.
    """
    end_bar()
    if STOPPED:  # compiled code may turn an interrupt into an error of its own
        return stopped()
    _say(one_line(internal_error(error, doing)))
    return CRASHED


def stopped() -> int:
    """Say that the user interrupted; the exit code of a shell for the signal."""
    end_bar()
    if signal.SIGINT in STOPPED:
        _say("irj: interrupted")
        return INTERRUPTED
    return 128 + STOPPED[0]


def run_alone(main: Callable[[Sequence[str]], int], argv: Sequence[str]) -> int:
    """Run a command that is not reached through `irj`: Ctrl-C and what the system refuses are
    one line, too.
    """
    try:
        with terminable():
            return main(argv)
    except KeyboardInterrupt:
        STOPPED.append(signal.SIGINT)
        return stopped()
    except InputError as error:
        return fail(str(error))
    except OSError as error:
        return fail(system_refusal(error))
    except MemoryError as error:
        return fail(no_memory(error))
    except Exception as error:
        return crashed(error, shlex.join([Path(sys.argv[0]).name, *argv]))
    finally:
        STOPPED.clear()
        release()


def no_memory(error: MemoryError) -> str:
    """What is said where the memory does not suffice."""
    return f"not enough memory ({error}); give shorter or fewer records"


def system_refusal(error: OSError) -> str:
    """What the operating system refuses, and what to do."""
    where = f"{error.filename}: " if error.filename else ""
    return (
        f"{where}{error.strerror or error}; check the path, its permissions and the space on "
        "the disk"
    )


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Let SIGTERM end the work as an exception does: what is half written is removed, and
    workers end, too.
    """
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    ):
        yield
        return

    def leave(number: int, _frame: FrameType | None) -> None:
        STOPPED.append(number)
        sys.exit(128 + number)

    STOPPED.clear()
    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


# --- before the work ------------------------------------------------------------------------------


def check_output(path: str | Path, inputs: Sequence[str | Path] = ()) -> None:
    """Refuse a result file that cannot be written or would replace an input; from then on it is
    held against other processes (see :func:`identification.scratch.hold`).

    Raises
    ------
    InputError
        Another process is writing it; it is a folder, its folder is missing or not writable, or it
        is one of the inputs.
    """
    target = Path(path)
    if not str(path):
        raise InputError("the name of a result file is empty; give the name of a file")
    if target.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file")
    if not target.absolute().parent.is_dir():
        raise InputError(f"{target.parent}: no such folder; make it first or write somewhere else")
    try:
        if is_special(target):
            with target.open("ab"):
                pass
        else:
            _try_to_write(target.absolute().parent)
    except OSError as error:
        raise InputError(
            f"{path}: its folder is not writable ({error.strerror}); write somewhere else"
        ) from None
    keep_inputs([target], inputs)
    if not is_special(target):
        hold(target)


def check_folder(path: str | Path) -> None:
    """Refuse a folder for results that cannot be made or written, before any work is done; it is
    not made here.

    Raises
    ------
    InputError
        It is a file, or it, or the folder in which it would be made, is not writable.
    """
    folder = Path(path)
    there = next((p for p in (folder, *folder.absolute().parents) if p.exists()), folder)
    if not there.is_dir():
        raise InputError(f"{there}: is a file; give the name of a writable folder for --out")
    try:
        _try_to_write(there)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot write there ({error.strerror}); choose a writable folder with --out"
        ) from None


def _try_to_write(folder: Path) -> None:
    with tempfile.TemporaryFile(prefix=".write-", dir=folder):
        pass


def keep_inputs(targets: Sequence[str | Path], inputs: Sequence[str | Path]) -> None:
    """Refuse results that would replace an input of the same command.

    Raises
    ------
    InputError
        One of them is one of the inputs.
    """
    for target in map(Path, targets):
        for other in map(Path, inputs):
            if target.exists() and other.exists() and target.samefile(other):
                raise InputError(
                    f"{target}: is an input of this command and would be lost; write somewhere else"
                )


def is_special(path: Path) -> bool:
    """A device or a pipe: written straight, not replaced."""
    return path.exists() and not path.is_file()


# --- results --------------------------------------------------------------------------------------


def replace_file(path: str | Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write a file that appears when it is whole: a reader, or a crash, sees the old one or the new
    one, never a part.

    Raises
    ------
    InputError
        The folder is missing or not writable; the disk is full.
    """
    try:
        if is_special(Path(path)):
            with Path(path).open("wb") as stream:
                write(stream)
            return
        target = Path(os.path.realpath(path))
        temporary = part_of(target)
        try:
            with temporary.open("wb") as stream:
                write(stream)
                stream.flush()
                os.fsync(stream.fileno())
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); check the folder, its "
            "permissions and the space on the disk"
        ) from None


def replace_files(folder: Path, content: Mapping[str, bytes]) -> list[Path]:
    """Write files that belong together: all of them appear, or none; the folder is made where it is
    missing.

    Raises
    ------
    InputError
        The folder cannot be made or written; the disk is full.
    """
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    parts: dict[Path, Path] = {}
    whole = False
    try:
        folder.mkdir(parents=True, exist_ok=True)
        hold(folder)
        for name, text in content.items():
            parts[folder / name] = part = part_of(folder / name)
            part.write_bytes(text)
        for target, part in parts.items():
            part.replace(target)
        whole = True
    except OSError as error:
        raise InputError(
            f"{folder}: cannot write there ({error.strerror or error}); choose a writable folder "
            "with --out, with space on its disk"
        ) from None
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)
        for place in made if not whole else []:
            if place.is_dir() and not any(place.iterdir()):
                place.rmdir()
    return list(parts)


def write_json(path: str | Path | None, data: Any) -> None:
    """Write a result as JSON, if asked for; numbers that are not finite become null.

    Raises
    ------
    InputError
        It cannot be written.
    """
    if path:
        text = json.dumps(finite(data), indent=1, allow_nan=False) + "\n"
        replace_file(path, lambda stream: stream.write(text.encode()))


def finite(data: Any) -> Any:
    """Data for JSON: numpy's numbers as Python's, numbers that are not finite as None."""
    if isinstance(data, dict):
        return {k: finite(v) for k, v in data.items()}
    if isinstance(data, list | tuple):
        return [finite(v) for v in data]
    if hasattr(data, "item") and not isinstance(data, str):
        data = data.item()
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data


__all__ = [
    "CRASHED",
    "INTERRUPTED",
    "STOPPED",
    "OneLineParser",
    "check_output",
    "checkpoint",
    "counted",
    "crashed",
    "end_bar",
    "fail",
    "finite",
    "is_special",
    "keep_inputs",
    "no_memory",
    "one_line",
    "progress_bar",
    "replace_file",
    "replace_files",
    "run_alone",
    "stopped",
    "system_refusal",
    "terminable",
    "write_json",
]
