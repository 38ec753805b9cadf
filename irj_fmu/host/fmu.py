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
from typing import Any, Final, Literal, Self, final

from identification.errors import InputError
from irj_fmu.host.described import described, has_state_events, unreadable
from irj_fmu.host.last_free import freer
from irj_fmu.host.signals import Fault, Signal

Number = float | int | bool

_WARNING = 1

_REALS: Final = ("Real", "Float64", "Float32")
WHOLE: Final = ("Integer", *(f"{u}Int{n}" for u in ("", "U") for n in (8, 16, 32, 64)))
"""Types of whole numbers of FMI 2.0 and 3.0; an enumeration is another."""
_C_TYPES: Final[dict[int, dict[str, Any]]] = {
    2: {"Real": ctypes.c_double, "Integer": ctypes.c_int, "Boolean": ctypes.c_int},
    3: {
        "Float64": ctypes.c_double,
        "Float32": ctypes.c_float,
        "Boolean": ctypes.c_bool,
        **{kind: getattr(ctypes, f"c_{kind.lower()}") for kind in WHOLE[1:]},
    },
}
_ENUMERATION: Final = {2: "Integer", 3: "Int64"}
"""The type whose calls carry an enumeration."""
_SETTLE: Final = 100
"""Most rounds of an event iteration."""


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
    """An FMU of FMI 2.0 or 3.0, extracted once.

    Parameters
    ----------
    path : Path
        An ``.fmu`` file, or a folder it was extracted to.
    versions : tuple of int
        Versions of FMI that are taken.

    Attributes
    ----------
    version : int
        2 or 3.

    Raises
    ------
    InputError
        Where it is not a readable FMU of such a version.
    """

    def __init__(self, path: Path, versions: tuple[int, ...] = (2, 3)) -> None:
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
        known = next((v for v in versions if str(self.description.fmiVersion)[:2] == f"{v}."), 0)
        if not known:
            self.close()
            raise InputError(
                f"{self.path}: FMI {self.description.fmiVersion} is not supported; export it as "
                f"FMI {' or '.join(f'{v}.0' for v in versions)}"
            )
        self.version: int = known
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

    def kind(self) -> Literal["cs", "me"]:
        """How it is run: as a co-simulation, and where it is none by model exchange.

        Raises
        ------
        InputError
            Where it is neither, or its model exchange has state events.
        """
        if self.description.coSimulation is not None:
            return "cs"
        if self.description.modelExchange is None:
            raise InputError(f"{self.path}: has neither co-simulation nor model exchange")
        if has_state_events(self.description):
            raise InputError(
                f"{self.path}: is model exchange with state events, which runs here do not "
                "follow; export it for co-simulation"
            )
        return "me"

    def carries(self, name: str) -> bool:
        """True where a variable can be a signal: a number, and no array."""
        variable = self.variable(name)
        return not variable.shape and (
            variable.type == "Enumeration" or variable.type in _C_TYPES[self.version]
        )

    def signal(self, name: str) -> Any:
        """The description of a variable that can be a signal.

        Raises
        ------
        InputError
            Where it cannot, or there is none of this name.
        """
        variable = self.variable(name)
        if not self.carries(name):
            what = "an array" if variable.shape else f"a {variable.type}"
            raise InputError(
                f"{self.path.name}: variable {name!r} is {what} and cannot be a signal"
            )
        return variable

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
    sizes: tuple[int, ...]
    """The number of values, which a call of FMI 3.0 takes behind them."""

    @property
    def real(self) -> bool:
        """True for numbers that are not whole."""
        return self.type in _REALS


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
        from fmpy.fmi3 import FMU3Model, FMU3Slave

        part = fmu.description.coSimulation if kind == "cs" else fmu.description.modelExchange
        if part is None:
            other = "model exchange" if kind == "cs" else "co-simulation"
            raise InputError(f"{fmu.path}: this FMU supports {other} only")
        self.fmu, self.name, self.kind = fmu, name, kind
        self.messages: list[str] = []
        two = fmu.version == 2
        self.callbacks = callbacks(self.messages) if two else None
        made = {"cs": (FMU2Slave, FMU3Slave), "me": (FMU2Model, FMU3Model)}[kind][not two]
        self._used = False
        self._open = False
        try:
            with _loading():
                self.raw: Any = (made if two else _lenient(made))(
                    guid=fmu.description.guid if two else fmu.description.instantiationToken,
                    unzipDirectory=str(fmu.folder),
                    modelIdentifier=part.modelIdentifier,
                    instanceName=name,
                )
        except Exception as error:
            raise FmuError(
                f"{name} ({fmu.path.name}): its library cannot be loaded here, {error}"
            ) from error
        if two:
            self.call("instantiate", callbacks=self.callbacks, loggingOn=log)
        else:
            self.call("instantiate", logMessage=logger(self.messages), loggingOn=log)
        free = partial(getattr(self.raw, f"fmi{fmu.version}FreeInstance"), self.raw.component)
        self._step = self._bound("DoStep") if kind == "cs" else None
        self._said = (ctypes.c_bool * 3)(), ctypes.c_double()
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

    def _bound(self, name: str) -> Any:
        """A function of the library with the types of its arguments."""
        version, pointer, size = self.fmu.version, ctypes.c_void_p, ctypes.c_size_t
        found = self.raw.dll[f"fmi{version}{name}"]
        if name == "DoStep":
            last = [ctypes.c_int] if version == 2 else [ctypes.c_bool, *[pointer] * 4]
            found.argtypes = [pointer, ctypes.c_double, ctypes.c_double, *last]
        else:
            more = [] if version == 2 else [size]
            found.argtypes = [pointer, pointer, size, pointer, *more]
        found.restype = ctypes.c_int
        return found

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
            kind = variable.type
            kind = _ENUMERATION[self.fmu.version] if kind == "Enumeration" else kind
            self.call(f"set{kind}", [variable.valueReference], [value])
        if self.fmu.version == 2:
            self.call("setupExperiment", startTime=start, **options)
            self.call("enterInitializationMode")
        else:
            self.call("enterInitializationMode", startTime=start, **options)

    def ready(self) -> None:
        """Leave initialization mode; a model-exchange FMU goes on into continuous time.

        Raises
        ------
        InputError
            Where it plans time events.
        """
        self.call("exitInitializationMode")
        if self.kind == "cs":
            return
        rounds = "newDiscreteStates" if self.fmu.version == 2 else "updateDiscreteStates"
        for _ in range(_SETTLE):
            again, _, _, _, planned, _ = self.call(rounds)
            if planned:
                raise InputError(
                    f"{self.fmu.path.name}: plans time events, which model exchange here does "
                    "not follow; use its co-simulation"
                )
            if not again:
                self.call("enterContinuousTimeMode")
                return
        raise FmuError(f"{self.fmu.path.name}: its event iteration does not end")

    def variable(self, name: str) -> Any:
        """Return fmpy's description of a variable."""
        return self.fmu.variable(name)

    def blocks(self, names: Sequence[str]) -> list[Block]:
        """Group variables by type for `read` and `write`."""
        groups: dict[str, list[str]] = {}
        for name in names:
            kind = self.fmu.signal(name).type
            kind = _ENUMERATION[self.fmu.version] if kind == "Enumeration" else kind
            groups.setdefault(kind, []).append(name)
        return [
            Block(
                tuple(group),
                kind,
                (ctypes.c_uint * len(group))(
                    *(self.variable(name).valueReference for name in group)
                ),
                (_C_TYPES[self.fmu.version][kind] * len(group))(),
                self._bound(f"Get{kind}"),
                self._bound(f"Set{kind}"),
                sizes=() if self.fmu.version == 2 else (len(group),),
            )
            for kind, group in groups.items()
        ]

    def read(self, block: Block) -> Any:
        """Fill the block's values from the FMU and return them."""
        status = block.getter(
            self.raw.component, block.references, len(block.names), block.values, *block.sizes
        )
        if status > _WARNING:
            raise self._refusal(f"get{block.type}", f"status {status}")
        return block.values

    def write(self, block: Block) -> None:
        """Set the FMU's variables from the block's values."""
        status = block.setter(
            self.raw.component, block.references, len(block.names), block.values, *block.sizes
        )
        if status > _WARNING:
            raise self._refusal(
                f"set{block.type} of {', '.join(block.names[:6])}", f"status {status}"
            )

    def step(self, time: float, length: float) -> None:
        """Do one communication step; a step that is discarded counts as refused."""
        assert self._step is not None
        (flags, last), more = self._said, tuple[int, ...]()
        if self.fmu.version == 3:
            at = ctypes.addressof(flags)
            more = (at, at + 1, at + 2, ctypes.addressof(last))
        status = self._step(self.raw.component, time, length, True, *more)
        if status > _WARNING:
            raise self._refusal(f"doStep at t = {time:g} s", f"status {status}")
        if flags[1]:  # FMI 3.0
            raise self._refusal(f"doStep at t = {time:g} s", "it asks for the end")

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


class _Missing:
    """Stands for a function that a library does not have."""

    def __call__(self, *_arguments: object) -> None:
        raise RuntimeError("its library lacks this function")


def _lenient(made: Any) -> Any:
    """fmpy's class of FMI 3.0 for libraries without the functions that no run here calls: it asks
    for all 60, and interfaces that an FMU does not have are left out by some tools.
    """

    class FMU3(made):  # type: ignore[misc] # fmpy reads the version from the name
        @property
        def dll(self) -> _Whole:
            return self._whole

        @dll.setter
        def dll(self, library: Any) -> None:
            self._whole = _Whole(library)

    return FMU3


class _Whole:
    """A library whose missing functions of FMI 3.0 are found out when they are called."""

    def __init__(self, library: Any) -> None:
        self._library = library

    def __getattr__(self, name: str) -> Any:
        if name.startswith("fmi3") and not hasattr(self._library, name):
            return _Missing()
        return getattr(self._library, name)

    def __getitem__(self, name: str) -> Any:
        return self._library[name]


def logger(messages: list[str]) -> Callable[[Any, int, bytes, bytes], None]:
    """What FMI 3.0 calls to log, kept in a list."""

    def note(_environment: Any, _status: int, _category: bytes, message: bytes) -> None:
        if len(messages) < 1000:
            messages.append(message.decode(errors="replace"))

    return note


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
