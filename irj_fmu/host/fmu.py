"""An FMU opened once, its instances, and the wiring of several: what every host works with."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import tempfile
import threading
import weakref
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, final

from identification.errors import InputError
from irj_fmu.host.described import described, unreadable
from irj_fmu.host.last_free import freer
from irj_fmu.host.signals import Fault, Signal

Number = float | int | bool

_WARNING = 1

_C_TYPES: dict[str, Any] = {
    "Real": ctypes.c_double,
    "Integer": ctypes.c_int,
    "Boolean": ctypes.c_int,
}


class FmuError(RuntimeError):
    """An FMU refused a call: which one, at what time, and what it logged."""


def near_names(name: str, known: Collection[str]) -> str:
    """What to write in place of a name that an FMU does not have: near ones, else those there
    are.
    """
    import difflib

    close = difflib.get_close_matches(name, known, 3)
    if close:
        return f"did you mean: {', '.join(close)}"
    if not known:
        return "it has no variables at all"
    first = [n for n in known if not n.startswith("der(")][:12]
    return (
        f"it has {', '.join(first)}"
        f"{f' and {len(known) - len(first)} more' if len(known) > len(first) else ''}"
    )


@final
class Fmu:
    """An FMI 2.0 FMU, extracted once.

    Parameters
    ----------
    path : Path
        An ``.fmu`` file, or a folder it was extracted to.

    Raises
    ------
    InputError
        Where it is not a readable FMI 2.0 FMU.
    """

    def __init__(self, path: Path) -> None:
        from fmpy import extract

        self.path = Path(path).resolve()
        self._gone: weakref.finalize[..., Fmu] | None = None
        if not self.path.exists():
            raise InputError(f"{self.path}: there is no such FMU")
        try:
            if self.path.is_file():
                folder = tempfile.mkdtemp(prefix="irj-fmu-")
                self._gone = weakref.finalize(self, shutil.rmtree, folder, True)  # if never closed
                extract(str(self.path), folder)
                self.folder = Path(folder)
            else:
                self.folder = self.path
            self.description: Any = described(self.folder)
        except Exception as error:
            self.close()
            raise unreadable(self.path, error) from error
        if self.description.fmiVersion != "2.0":
            self.close()
            raise InputError(
                f"{self.path}: FMI {self.description.fmiVersion} is not supported; export it as "
                "FMI 2.0"
            )
        self.variables: dict[str, Any] = {v.name: v for v in self.description.modelVariables}

    def variable(self, name: str) -> Any:
        """Return fmpy's description of a variable.

        Raises
        ------
        InputError
            Where there is none of this name.
        """
        if name not in self.variables:
            raise InputError(
                f"{self.path.name}: there is no variable {name!r}; "
                f"{near_names(name, self.variables)}"
            )
        return self.variables[name]

    def close(self) -> None:
        """Remove the extraction."""
        if self._gone is not None:
            self._gone()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self.close()


@final
@dataclass(frozen=True)
class Block:
    """Variables of one type that are read or written by one call; `values` is a ctypes array."""

    names: tuple[str, ...]
    type: str
    references: Any
    values: Any
    getter: Any
    setter: Any


_one_at_a_time = threading.Lock()


@contextlib.contextmanager
def _loading() -> Iterator[None]:
    """The working directory as it was, after a library is loaded in its own folder.

    fmpy goes there and back: it stays there where the library cannot be loaded, and one of two
    threads takes the folder of the other for the one to go back to. A temporary folder is removed
    later, and a process without a working directory opens no file by a relative path.
    """
    with _one_at_a_time:
        here = os.getcwd()
        try:
            yield
        finally:
            os.chdir(here)


@final
class Instance:
    """One instance of an FMU, made once and reset for each run.

    Parameters
    ----------
    fmu : Fmu
        The FMU.
    kind : {"cs", "me"}
        Co-simulation or model exchange.
    name : str
        Instance name, which the log shows.
    log : bool
        Ask the FMU to log all it can; errors come without.

    Raises
    ------
    InputError
        Where the FMU does not support the kind.
    FmuError
        Where its library cannot be loaded or refuses to make an instance.
    """

    def __init__(
        self, fmu: Fmu, kind: Literal["cs", "me"] = "cs", name: str = "fmu", *, log: bool = False
    ) -> None:
        from fmpy.fmi2 import FMU2Model, FMU2Slave

        part = fmu.description.coSimulation if kind == "cs" else fmu.description.modelExchange
        if part is None:
            other = "model exchange" if kind == "cs" else "co-simulation"
            raise InputError(f"{fmu.path}: this FMU supports {other} only")
        self.fmu, self.name = fmu, name
        self.messages: list[str] = []
        self.callbacks = callbacks(self.messages)
        self._used = False
        self._open = False
        try:
            with _loading():
                self.raw: Any = (FMU2Slave if kind == "cs" else FMU2Model)(
                    guid=fmu.description.guid,
                    unzipDirectory=str(fmu.folder),
                    modelIdentifier=part.modelIdentifier,
                    instanceName=name,
                )
        except Exception as error:
            raise FmuError(
                f"{name} ({fmu.path.name}): its library cannot be loaded here, {error}"
            ) from error
        self.call("instantiate", callbacks=self.callbacks, loggingOn=log)
        free = partial(self.raw.fmi2FreeInstance, self.raw.component)
        self._close = weakref.finalize(
            self, _closed, freer(self.raw.dll, free), self.raw.freeLibrary
        )

    def call(self, function: str, *args: Any, **kwargs: Any) -> Any:
        """Call a method of fmpy's instance; its failures become `FmuError` with the FMU's last
        message.
        """
        try:
            return getattr(self.raw, function)(*args, **kwargs)
        except Exception as error:
            raise self._refusal(function, str(error)) from error

    def _refusal(self, function: str, why: str) -> FmuError:
        last = f": {self.messages[-1]}" if self.messages else ""
        return FmuError(f"{self.name} ({self.fmu.path.name}): {function} failed, {why}{last}")

    def begin(
        self,
        start: float = 0.0,
        parameters: Mapping[str, Number | str] | None = None,
        **options: Any,
    ) -> None:
        """Reset where it was used, set start values and enter initialization mode.

        Parameters
        ----------
        start : float
            Time in s.
        parameters : mapping
            Start values by name.
        **options
            ``tolerance`` and ``stopTime`` for the FMU.
        """
        if self._used:
            self.call("reset")
        self._used = True
        self.messages.clear()
        for name, value in (parameters or {}).items():
            variable = self.variable(name)
            self.call(f"set{variable.type}", [variable.valueReference], [value])
        self.call("setupExperiment", startTime=start, **options)
        self.call("enterInitializationMode")

    def ready(self) -> None:
        """Leave initialization mode."""
        self.call("exitInitializationMode")

    def variable(self, name: str) -> Any:
        """Return fmpy's description of a variable."""
        return self.fmu.variable(name)

    def blocks(self, names: Sequence[str]) -> list[Block]:
        """Group variables by type for `read` and `write`."""
        groups: dict[str, list[str]] = {}
        for name in names:
            kind = self.variable(name).type
            kind = "Integer" if kind == "Enumeration" else kind
            if kind not in _C_TYPES:
                raise InputError(
                    f"{self.fmu.path.name}: variable {name!r} is a {kind} and cannot be a signal"
                )
            groups.setdefault(kind, []).append(name)
        return [
            Block(
                tuple(group),
                kind,
                (ctypes.c_uint * len(group))(
                    *(self.variable(name).valueReference for name in group)
                ),
                (_C_TYPES[kind] * len(group))(),
                getattr(self.raw.dll, f"fmi2Get{kind}"),
                getattr(self.raw.dll, f"fmi2Set{kind}"),
            )
            for kind, group in groups.items()
        ]

    def read(self, block: Block) -> Any:
        """Fill the block's values from the FMU and return them."""
        status = block.getter(self.raw.component, block.references, len(block.names), block.values)
        if status > _WARNING:
            raise self._refusal(f"get{block.type}", f"status {status}")
        return block.values

    def write(self, block: Block) -> None:
        """Set the FMU's variables from the block's values."""
        status = block.setter(self.raw.component, block.references, len(block.names), block.values)
        if status > _WARNING:
            raise self._refusal(
                f"set{block.type} of {', '.join(block.names[:6])}", f"status {status}"
            )

    def step(self, time: float, length: float) -> None:
        """Do one communication step; a step that is discarded counts as refused."""
        status = self.raw.dll.fmi2DoStep(self.raw.component, time, length, 1)
        if status > _WARNING:
            raise self._refusal(f"doStep at t = {time:g} s", f"status {status}")

    def close(self) -> None:
        """Free the instance."""
        self._close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self.close()


def callbacks(messages: list[str]) -> Any:
    """FMI 2.0 callbacks that keep what an FMU logs in a list."""
    from fmpy import calloc, free
    from fmpy.fmi2 import (
        fmi2CallbackAllocateMemoryTYPE,
        fmi2CallbackFreeMemoryTYPE,
        fmi2CallbackFunctions,
        fmi2CallbackLoggerTYPE,
    )

    def note(
        _environment: Any, _name: bytes, _status: int, _category: bytes, message: bytes
    ) -> None:
        if len(messages) < 1000:
            messages.append(message.decode(errors="replace"))

    made = fmi2CallbackFunctions()
    made.logger = fmi2CallbackLoggerTYPE(note)
    made.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
    made.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
    return made


def _closed(free: Callable[[], None], unload: Callable[[], None]) -> None:
    """Free an instance, then fmpy's hold on its library."""
    free()
    unload()


@final
@dataclass(frozen=True)
class Wiring:
    """What goes where in a co-simulation; every name is ``instance.variable``.

    Parameters
    ----------
    connections : mapping
        Input to the output that feeds it.
    inputs : mapping
        Input to the function of time that feeds it.
    faults : mapping
        Input to ``(time, value) -> value``, laid over whatever feeds it.
    parameters : mapping
        Start value by name.
    record : sequence of str
        Variables to record at each communication point.
    """

    connections: Mapping[str, str] = field(default_factory=dict)
    inputs: Mapping[str, Signal] = field(default_factory=dict)
    faults: Mapping[str, Fault] = field(default_factory=dict)
    parameters: Mapping[str, Number | str] = field(default_factory=dict)
    record: Sequence[str] = ()
