"""Run FMUs from Python: open once, use often, connect, disturb.

The communication step is always stated: some hosts stretch it when it is left to them.
"""

from __future__ import annotations

import ctypes
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, final

import numpy as np

from identification.errors import InputError

from .signals import Fault, FloatArray, Signal

Number = float | int | bool
_C_TYPES: dict[str, Any] = {"Real": ctypes.c_double, "Integer": ctypes.c_int, "Boolean": ctypes.c_int}


class FmuError(RuntimeError):
    """An FMU refused a call: which one, at what time, and what it logged."""


@final
@dataclass(frozen=True)
class Trajectory:
    """Recorded signals: `time`, shape (n,), in s, and one array of shape (n,) per recorded name."""

    time: FloatArray
    signals: Mapping[str, FloatArray]

    def __getitem__(self, name: str) -> FloatArray:
        return self.signals[name]


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
        from fmpy import extract, read_model_description

        self.path = Path(path).resolve()
        self._temporary: str | None = None
        if not self.path.exists():
            raise InputError(f"{self.path}: there is no such FMU")
        try:
            if self.path.is_file():
                self._temporary = tempfile.mkdtemp(prefix="irj-fmu-")
                extract(str(self.path), self._temporary)
            self.folder = Path(self._temporary or self.path)
            self.description: Any = read_model_description(str(self.folder))
        except Exception as error:
            self.close()
            raise InputError(f"{self.path}: not a readable FMU ({error})") from error
        if self.description.fmiVersion != "2.0":
            self.close()
            raise InputError(f"{self.path}: FMI {self.description.fmiVersion} is not supported; export it as FMI 2.0")
        self.variables: dict[str, Any] = {v.name: v for v in self.description.modelVariables}

    def close(self) -> None:
        """Remove the extraction."""
        if self._temporary is not None:
            shutil.rmtree(self._temporary, ignore_errors=True)
            self._temporary = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


@final
@dataclass(frozen=True)
class _Block:
    """Variables of one type that are read or written by one call."""

    names: tuple[str, ...]
    type: str
    references: Any
    values: Any


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
    """

    def __init__(self, fmu: Fmu, kind: Literal["cs", "me"] = "cs", name: str = "fmu") -> None:
        from fmpy.fmi2 import FMU2Model, FMU2Slave

        part = fmu.description.coSimulation if kind == "cs" else fmu.description.modelExchange
        if part is None:
            other = "model exchange" if kind == "cs" else "co-simulation"
            raise InputError(f"{fmu.path}: this FMU supports {other} only")
        self.fmu, self.name = fmu, name
        self.messages: list[str] = []
        self._callbacks = _callbacks(self.messages)
        self.raw: Any = (FMU2Slave if kind == "cs" else FMU2Model)(
            guid=fmu.description.guid,
            unzipDirectory=str(fmu.folder),
            modelIdentifier=part.modelIdentifier,
            instanceName=name,
        )
        self._used = False
        self._open = False
        self.call("instantiate", callbacks=self._callbacks)
        self._open = True

    def call(self, function: str, *args: Any, **kwargs: Any) -> Any:
        """Call a method of fmpy's instance; its failures become `FmuError` with the FMU's last message."""
        try:
            return getattr(self.raw, function)(*args, **kwargs)
        except Exception as error:
            last = f": {self.messages[-1]}" if self.messages else ""
            raise FmuError(f"{self.name} ({self.fmu.path.name}): {function} failed, {error}{last}") from error

    def begin(self, start: float = 0.0, parameters: Mapping[str, Number | str] | None = None, **options: Any) -> None:
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
        if name not in self.fmu.variables:
            import difflib

            close = ", ".join(difflib.get_close_matches(name, self.fmu.variables, 3)) or "see its model description"
            raise InputError(f"{self.fmu.path.name}: there is no variable {name!r}; did you mean: {close}")
        return self.fmu.variables[name]

    def blocks(self, names: Sequence[str]) -> list[_Block]:
        """Group variables by type for `read` and `write`."""
        groups: dict[str, list[str]] = {}
        for name in names:
            kind = self.variable(name).type
            kind = "Integer" if kind == "Enumeration" else kind
            if kind not in _C_TYPES:
                raise InputError(f"{self.fmu.path.name}: variable {name!r} is a {kind} and cannot be a signal")
            groups.setdefault(kind, []).append(name)
        return [
            _Block(
                tuple(group),
                kind,
                (ctypes.c_uint * len(group))(*(self.variable(name).valueReference for name in group)),
                (_C_TYPES[kind] * len(group))(),
            )
            for kind, group in groups.items()
        ]

    def read(self, block: _Block) -> Any:
        """Fill the block's values from the FMU and return them."""
        self.call(f"fmi2Get{block.type}", self.raw.component, block.references, len(block.names), block.values)
        return block.values

    def write(self, block: _Block) -> None:
        """Set the FMU's variables from the block's values."""
        self.call(f"fmi2Set{block.type}", self.raw.component, block.references, len(block.names), block.values)

    def close(self) -> None:
        """Free the instance."""
        if self._open:
            self._open = False
            self.raw.freeInstance()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def _callbacks(messages: list[str]) -> Any:
    from fmpy import calloc, free
    from fmpy.fmi2 import (
        fmi2CallbackAllocateMemoryTYPE,
        fmi2CallbackFreeMemoryTYPE,
        fmi2CallbackFunctions,
        fmi2CallbackLoggerTYPE,
    )

    def note(_environment: Any, _name: bytes, _status: int, _category: bytes, message: bytes) -> None:
        if len(messages) < 1000:
            messages.append(message.decode(errors="replace"))

    made = fmi2CallbackFunctions()
    made.logger = fmi2CallbackLoggerTYPE(note)
    made.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
    made.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
    return made


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


def simulate_cs(
    instances: Mapping[str, Instance] | Instance, wiring: Wiring, *, step: float, stop: float, start: float = 0.0
) -> Trajectory:
    """Co-simulate FMUs with a fixed communication step.

    At each communication point all outputs are read, all inputs set from them and from the functions of time, and
    all FMUs step together (Jacobi). An estimator thus sees the plant's outputs and inputs of the same instant.

    Parameters
    ----------
    instances : mapping or Instance
        Name to instance; a single one goes by its own name. They are reset first, so they serve many runs.
    wiring : Wiring
        Connections, inputs, faults, parameters, records.
    step, stop, start : float
        Communication step and times in s.

    Returns
    -------
    Trajectory
        The recorded variables at ``start, start + step, ... , stop``.

    Raises
    ------
    InputError
        Where a name is unknown or an input is fed twice.
    FmuError
        Where an FMU refuses a call.
    """
    if isinstance(instances, Instance):
        instances = {instances.name: instances}
    count = round((stop - start) / step) if step > 0 else 0
    if count < 1 or abs(count * step - (stop - start)) > 1e-6 * step:
        raise InputError(f"co-simulation from {start:g} to {stop:g} s is not a whole number of steps of {step:g} s")
    plan = _Plan(instances, wiring)
    time: FloatArray = start + step * np.arange(count + 1, dtype=np.float64)
    table = np.empty((count + 1, len(wiring.record)))
    for name, instance in instances.items():
        own = {key.partition(".")[2]: v for key, v in wiring.parameters.items() if key.partition(".")[0] == name}
        instance.begin(start, own, stopTime=stop)
    plan.exchange(start)
    for instance in instances.values():
        instance.ready()
    for i, now in enumerate(time):
        plan.exchange(float(now))
        plan.note(table[i])
        if i < count:
            for instance in instances.values():
                instance.call("doStep", float(now), step)
    for instance in instances.values():
        instance.call("terminate")
    return Trajectory(time, {name: table[:, i] for i, name in enumerate(wiring.record)})


@final
class _Plan:
    """The reads and writes of one co-simulation, laid out once."""

    def __init__(self, instances: Mapping[str, Instance], wiring: Wiring) -> None:
        both = wiring.connections.keys() & wiring.inputs.keys()
        if both:
            raise InputError(f"input {min(both)!r} has both a connection and a function of time; leave one out")
        fed = [*wiring.connections, *wiring.inputs]
        for name in wiring.faults:
            if name not in fed:
                raise InputError(f"fault on {name!r}: nothing feeds this input; faults act on inputs that are fed")
        for name in (*fed, *wiring.connections.values(), *wiring.record, *wiring.parameters):
            _split(name, instances)
        self.wiring = wiring
        self.values: dict[str, float] = {}
        wanted = {*wiring.connections.values()}
        self.reads = _blocks(instances, sorted(wanted))
        self.records = _blocks(instances, sorted({*wiring.record}))
        self.writes = _blocks(instances, fed)

    def exchange(self, time: float) -> None:
        """Read the connected outputs and set all inputs that are fed."""
        values, wiring = self.values, self.wiring
        _read(self.reads, values)
        for target, source in wiring.connections.items():
            values[target] = values[source]
        for target, signal in wiring.inputs.items():
            values[target] = signal(time)
        for target, fault in wiring.faults.items():
            values[target] = fault(time, values[target])
        for prefix, instance, block in self.writes:
            for i, name in enumerate(block.names):
                value = values[prefix + name]
                block.values[i] = value if block.type == "Real" else int(value)
            instance.write(block)

    def note(self, row: FloatArray) -> None:
        """Read the recorded variables into a row."""
        _read(self.records, self.values)
        for i, name in enumerate(self.wiring.record):
            row[i] = self.values[name]


_Place = tuple[str, Instance, _Block]


def _split(name: str, instances: Mapping[str, Instance]) -> tuple[str, str]:
    owner, _, variable = name.partition(".")
    if owner not in instances or not variable:
        raise InputError(f"{name!r}: write instance.variable, with one of the instances {', '.join(instances)}")
    instances[owner].variable(variable)
    return owner, variable


def _blocks(instances: Mapping[str, Instance], names: Sequence[str]) -> list[_Place]:
    grouped: dict[str, list[str]] = {}
    for name in names:
        owner, variable = _split(name, instances)
        grouped.setdefault(owner, []).append(variable)
    return [
        (f"{owner}.", instances[owner], block)
        for owner, variables in grouped.items()
        for block in instances[owner].blocks(variables)
    ]


def _read(places: Sequence[_Place], values: dict[str, float]) -> None:
    for prefix, instance, block in places:
        instance.read(block)
        for i, name in enumerate(block.names):
            values[prefix + name] = block.values[i]
