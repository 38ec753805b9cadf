"""A user's FMU behind one small interface: FMI 2.0 or 3.0, model exchange or co-simulation.

Calls go straight to the library, so that a right-hand side costs a few microseconds; only the
functions that are needed are looked up, so that a co-simulation FMU may lack those of model
exchange.
"""

from __future__ import annotations

import copy
import ctypes
import math
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, Self, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from irj_fmu.host.described import described, has_state_events, unreadable
from irj_fmu.host.fmu import FmuError, Number, callbacks, logger, near_names
from irj_fmu.host.last_free import freer
from irj_fmu.host.signals import FloatArray

Kind = Literal["me", "cs"]
IntArray = npt.NDArray[np.int64]
_REALS: Final = ("Real", "Float64")
_WHOLE: Final = {
    "Integer": ctypes.c_int,
    "Enumeration": ctypes.c_int,
    "Int32": ctypes.c_int32,
    "Int64": ctypes.c_int64,
}
_P, _D, _U, _I, _B = ctypes.c_void_p, ctypes.c_double, ctypes.c_size_t, ctypes.c_int, ctypes.c_bool
_LOG3: Final = ctypes.CFUNCTYPE(None, _P, _I, ctypes.c_char_p, ctypes.c_char_p)
_EVENT2: Final = 48  # bytes of fmi2EventInfo: five booleans and a double, with room to spare
_SETTLE: Final = 100
NAMED: Final = 10_000
"""Most elements of an array that are named one by one: each costs some 36 us whenever the FMU is
opened. A larger one is a table, none of whose elements is a signal."""
STATUS: Final = {2: "discard", 3: "error", 4: "fatal", 5: "pending"}


@final
class UserFmu:
    """Somebody else's FMU, extracted once.

    Parameters
    ----------
    path : Path
        An ``.fmu`` file, or a folder it was extracted to.

    Attributes
    ----------
    description : fmpy.model_description.ModelDescription
    variables : dict
        fmpy's variables by name.
    version : int
        2 or 3.
    states : tuple of str
        Continuous states, in the order in which the FMU gives them; those of an array by element.
    elements : dict
        Elements of arrays (FMI 3.0) by name, as ``A[1,2]``: the array's name and the place in it.

    Raises
    ------
    InputError
        Where it is not a readable FMU of FMI 2.0 or 3.0.
    """

    def __init__(self, path: Path) -> None:
        from fmpy import extract

        self.path = Path(path).resolve()
        if not self.path.exists():
            raise InputError(
                f"{self.path}: there is no such FMU; give its path, relative to the joint file "
                "or whole"
            )
        try:
            if self.path.is_file():
                folder = tempfile.mkdtemp(prefix="irj-user-")
                weakref.finalize(self, shutil.rmtree, folder, True)
                extract(str(self.path), folder)
                self.folder = Path(folder)
            else:
                self.folder = self.path
            self.description: Any = described(self.folder)
        except Exception as error:
            raise unreadable(self.path, error) from error
        if str(self.description.fmiVersion)[:2] not in ("2.", "3."):
            raise InputError(
                f"{self.path}: FMI {self.description.fmiVersion} is not supported; export it as "
                "FMI 2.0 or 3.0"
            )
        self.version = int(self.description.fmiVersion[0])
        self.variables: dict[str, Any] = {v.name: v for v in self.description.modelVariables}
        self.elements: dict[str, tuple[str, int]] = {}
        self._scalars: dict[str, tuple[str, ...]] = {}
        reals = [v for v in self.variables.values() if v.type in _REALS]
        for scalar in [v for v in reals if not v.shape]:
            _number_of(scalar, self.path.name)
        for array in [v for v in reals if v.shape and math.prod(v.shape) <= NAMED]:
            scalars = _elements(array, self.path.name)
            self._scalars[array.name] = tuple(scalars)
            self.elements |= {n: (array.name, i) for i, n in enumerate(scalars)}
            self.variables |= {n: v for n, v in scalars.items() if n not in self.variables}
        slopes = [d.variable for d in self.description.derivatives]
        for v in slopes:
            if math.prod(v.shape or ()) > NAMED:
                raise InputError(
                    f"{self.path.name}: {v.name} holds {math.prod(v.shape)} states; a joint model "
                    f"has at most {NAMED}"
                )
        self.states: tuple[str, ...] = tuple(
            name
            for v in slopes
            if v.derivative is not None
            for name in self.scalars(v.derivative.name)
        )
        self._only: weakref.ref[UserInstance] | None = None

    def kinds(self) -> tuple[Kind, ...]:
        """What the FMU can do: model exchange first, where it has no state events."""
        found: list[Kind] = []
        events = self.has_state_events
        if self.description.modelExchange is not None and not events:
            found.append("me")
        if self.description.coSimulation is not None:
            found.append("cs")
        if not found:
            what = (
                "model exchange with state events only, which runs here do not follow"
                if events
                else "neither model exchange nor co-simulation"
            )
            raise InputError(f"{self.path.name}: has {what}; export it for co-simulation")
        return tuple(found)

    @property
    def has_state_events(self) -> bool:
        """True where its model exchange jumps at events, which runs here do not look for."""
        return has_state_events(self.description)

    def grain(self, kind: Kind) -> float | None:
        """The fixed step of a co-simulation, of which it takes whole multiples only [s]; None where
        it takes any step, or does not say which.
        """
        own = self.description.coSimulation
        if kind != "cs" or own is None:
            return None
        fixed = getattr(own, "fixedInternalStepSize", None)
        if fixed is None and not own.canHandleVariableCommunicationStepSize:
            fixed = getattr(self.description.defaultExperiment, "stepSize", None)
        return float(fixed) if fixed is not None and float(fixed) > 0 else None

    def once(self, kind: Kind) -> bool:
        """True where a process may hold one instance only."""
        own = self.description
        part = own.modelExchange if kind == "me" else own.coSimulation
        return bool(part is not None and part.canBeInstantiatedOnlyOncePerProcess)

    def opened(self, kind: Kind) -> UserInstance:
        """An instance for runs one after the other: the living one where there may be one only."""
        if not self.once(kind):
            return UserInstance(self, kind)
        found = self._only() if self._only is not None else None
        if found is None:
            found = UserInstance(self, kind)
            self._only = weakref.ref(found)
        return found

    def scalars(self, name: str) -> tuple[str, ...]:
        """Names of the elements of an array; of a scalar its own."""
        return self._scalars.get(name, (name,))

    def promises_derivatives(self) -> bool:
        """True where model exchange is said to give directional derivatives."""
        from xml.etree import ElementTree

        found = (
            ElementTree.parse(self.folder / "modelDescription.xml").getroot().find("ModelExchange")
        )
        return found is not None and any(
            found.get(f"providesDirectionalDerivative{s}") in ("true", "1") for s in ("", "s")
        )

    def variable(self, name: str) -> Any:
        """Return fmpy's description of a variable; an `InputError` suggests near names."""
        if name not in self.variables:
            raise InputError(
                f"{self.path.name}: there is no variable {name!r}; "
                f"{near_names(name, self.variables)}"
            )
        return self.variables[name]

    def real(self, name: str) -> Any:
        """The same for a scalar of type Real or Float64."""
        found = self.variable(name)
        if found.type in _REALS and found.shape:
            count, own = math.prod(found.shape), self.scalars(name)
            raise InputError(
                f"{self.path.name}: variable {name!r} is an array; "
                + (
                    f"its {count} elements are no signals or parameters of a fit"
                    if not 0 < count <= NAMED
                    else f"name one element of it, {own[0]}{f' to {own[-1]}' * (count > 1)}"
                )
            )
        if found.type not in _REALS:
            raise InputError(
                f"{self.path.name}: variable {name!r} is no real scalar ({found.type}) and "
                "cannot be a signal or a fitted parameter"
            )
        return found

    def start(self, name: str) -> float:
        """Start value of a variable; 0 where it has none."""
        value = self.real(name).start
        return float(value) if value is not None else 0.0


@final
@dataclass(frozen=True)
class Block:
    """Reals that are read or written by one call."""

    names: tuple[str, ...]
    references: Any
    values: Any
    array: FloatArray
    count: int
    """References of a call: an array is one."""
    whole: FloatArray | None = None
    """Where arrays are among them, the values of the call; the block's own are some of these."""
    places: IntArray | None = None


def _number_of(scalar: Any, fmu: str) -> None:
    """Refuse a start value that is no number."""
    try:
        float(0.0 if scalar.start is None else scalar.start)
    except ValueError:
        raise InputError(
            f"{fmu}: the start value {str(scalar.start)[:60]!r} of {scalar.name} is not one "
            "number; export it again"
        ) from None


def _elements(array: Any, fmu: str) -> dict[str, Any]:
    """Description of each element of an array by name, counted from 1, row by row."""
    starts = str(array.start).split() if array.start is not None else []
    if len(starts) not in (0, 1, math.prod(array.shape)):
        raise InputError(
            f"{fmu}: {array.name} has {math.prod(array.shape)} elements and {len(starts)} start "
            "values; export it again"
        )
    out = {}
    for place, index in enumerate(np.ndindex(*array.shape)):
        scalar = copy.copy(array)
        scalar.name = f"{array.name}[{','.join(str(i + 1) for i in index)}]"
        scalar.shape, scalar.dimensions = (), []
        # one start value stands for all of them
        scalar.start = starts[place if len(starts) > 1 else 0] if starts else None
        out[scalar.name] = scalar
    return out


@final
class UserInstance:
    """One instance of a user's FMU, made once and reset for each run.

    Parameters
    ----------
    fmu : UserFmu
    kind : {"me", "cs"}
    """

    def __init__(self, fmu: UserFmu, kind: Kind) -> None:
        part = fmu.description.modelExchange if kind == "me" else fmu.description.coSimulation
        if part is None:
            raise InputError(
                f"{fmu.path.name}: this FMU has no "
                f"{'model exchange' if kind == 'me' else 'co-simulation'}"
            )
        self.fmu, self.kind, self.version = fmu, kind, fmu.version
        self.messages: list[str] = []
        self._part = part
        self._functions: dict[str, Any] = {}
        self._library = self._load(part.modelIdentifier)
        self._component = self._instantiate()
        free = self._function("FreeInstance", [_P], None)
        self._close = weakref.finalize(self, freer(self._library, partial(free, self._component)))
        self._used = False
        self.size = len(fmu.states)
        self.x: Any = (_D * max(self.size, 1))()
        self.dx: Any = (_D * max(self.size, 1))()
        self._x: FloatArray = np.ctypeslib.as_array(self.x)[: self.size]
        self._dx: FloatArray = np.ctypeslib.as_array(self.dx)[: self.size]
        self._flags = (_I * 8)()
        self._bind()

    # --- library ----------------------------------------------------------------------------------

    def _load(self, identifier: str) -> Any:
        from fmpy import platform, platform_tuple, sharedLibraryExtension

        folder = self.fmu.folder / "binaries"
        path = (
            folder
            / (platform if self.version == 2 else platform_tuple)
            / f"{identifier}{sharedLibraryExtension}"
        )
        if not path.is_file():
            there = (
                ", ".join(sorted(p.name for p in folder.iterdir())) if folder.is_dir() else "none"
            )
            raise InputError(
                f"{self.fmu.path.name}: holds no library for this machine ({path.parent.name}; "
                f"it has {there}); export it for this platform"
            )
        try:
            return ctypes.CDLL(str(path))
        except OSError as error:
            raise InputError(
                f"{self.fmu.path.name}: its library cannot be loaded ({error})"
            ) from error

    def _function(self, name: str, arguments: list[Any], result: Any = ctypes.c_int) -> Any:
        try:
            found = getattr(self._library, f"fmi{self.version}{name}")
        except AttributeError:
            raise FmuError(
                f"{self.fmu.path.name}: its library lacks fmi{self.version}{name}"
            ) from None
        found.argtypes, found.restype = arguments, result
        return found

    def _instantiate(self) -> int:
        part, fmu, text = self._part, self.fmu, ctypes.c_char_p
        if self.version == 2:
            self._callbacks = callbacks(self.messages)
            make = self._function("Instantiate", [text, _I, text, text, _P, _I, _I], _P)
            place = (fmu.folder / "resources").as_uri()
            given: tuple[Any, ...] = (
                b"user",
                0 if self.kind == "me" else 1,
                str(fmu.description.guid).encode(),
                place.encode(),
            )
            given = (*given, ctypes.addressof(self._callbacks), 0, 0)
        else:
            self._callbacks = _LOG3(logger(self.messages))
            token, place = (
                str(fmu.description.instantiationToken).encode(),
                f"{fmu.folder / 'resources'}/",
            )
            if self.kind == "me":
                make = self._function(
                    "InstantiateModelExchange", [text, text, text, _B, _B, _P, _LOG3], _P
                )
                given = (b"user", token, place.encode(), False, False, None, self._callbacks)
            else:
                make = self._function(
                    "InstantiateCoSimulation",
                    [text, text, text, _B, _B, _B, _B, _P, _U, _P, _LOG3, _P],
                    _P,
                )
                given = (
                    b"user",
                    token,
                    place.encode(),
                    False,
                    False,
                    False,
                    False,
                    None,
                    0,
                    None,
                    self._callbacks,
                    None,
                )
        found = make(*given)
        if not found:
            raise FmuError(
                f"{fmu.path.name}: cannot be instantiated as {part.modelIdentifier}{self._last()}"
            )
        return int(found)

    def _bind(self) -> None:
        """The calls of the inner loops, bound once."""
        two, c = self.version == 2, self._component
        real = "Real" if two else "Float64"
        shape = [_P, _P, _U, _P] if two else [_P, _P, _U, _P, _U]
        self._get, self._set = (
            self._function(f"Get{real}", shape),
            self._function(f"Set{real}", shape),
        )
        if self.kind == "me":
            set_time = self._function("SetTime", [_P, _D])
            set_states = self._function("SetContinuousStates", [_P, _P, _U])
            get_slopes = self._function(
                "GetDerivatives" if two else "GetContinuousStateDerivatives", [_P, _P, _U]
            )
            x, dx, n, last = self.x, self.dx, self.size, self._last

            def slopes(time: float) -> None:
                if set_time(c, time) > 1 or set_states(c, x, n) > 1 or get_slopes(c, dx, n) > 1:
                    raise FmuError(
                        f"{self.fmu.path.name}: refuses time, states or derivatives at t = "
                        f"{time:g} s{last()}"
                    )

            self._slopes: Callable[[float], None] = slopes
            needed = self._part.needsCompletedIntegratorStep
            self._completed = (
                self._function("CompletedIntegratorStep", [_P, _I if two else _B, _P, _P])
                if needed
                else None
            )
        elif two:
            self._step = self._function("DoStep", [_P, _D, _D, _I])
        else:
            self._step = self._function("DoStep", [_P, _D, _D, _B, _P, _P, _P, _P])

    def _last(self) -> str:
        return f": {self.messages[-1]}" if self.messages else ""

    def _call(self, name: str, arguments: list[Any], *values: Any) -> None:
        found = self._functions.get(name)
        if found is None:
            found = self._functions[name] = self._function(name, [_P, *arguments])
        status = found(self._component, *values)
        if status > 1:
            raise FmuError(
                f"{self.fmu.path.name}: fmi{self.version}{name} failed with status "
                f"{status}{self._last()}"
            )

    # --- values -----------------------------------------------------------------------------------

    def block(self, names: Iterable[str]) -> Block:
        """Reals to be read or written together."""
        names = tuple(names)
        reals = [self.fmu.real(n) for n in names]
        if not any(n in self.fmu.elements for n in names):
            references = (ctypes.c_uint * max(len(names), 1))(*(v.valueReference for v in reals))
            values = (_D * max(len(names), 1))()
            own = np.ctypeslib.as_array(values)[: len(names)]
            return Block(names, references, values, own, len(names))
        # an array goes through a call as a whole, however few of its elements are wanted
        owners = [self.fmu.elements.get(n, (n, 0)) for n in names]
        first: dict[str, int] = {}
        size = 0
        for name, _ in owners:
            if name not in first:
                first[name] = size
                size += len(self.fmu.scalars(name))
        references = (ctypes.c_uint * len(first))(
            *(self.fmu.variable(n).valueReference for n in first)
        )
        values = (_D * size)()
        places = np.array([first[n] + at for n, at in owners], dtype=np.int64)
        whole = np.ctypeslib.as_array(values)
        own = np.zeros(len(names))
        return Block(names, references, values, own, len(first), whole=whole, places=places)

    def read(self, block: Block) -> FloatArray:
        """Fill a block from the FMU; its array is returned and reused."""
        if block.count:
            self._through(self._get, block, "give")
            if block.whole is not None:
                block.array[:] = block.whole[block.places]
        return block.array

    def write(self, block: Block) -> None:
        """Set the FMU's variables from a block's array."""
        if block.count:
            if block.whole is not None:  # the other elements stay as they are
                self._through(self._get, block, "give")
                block.whole[block.places] = block.array
            self._through(self._set, block, "take")

    def _through(self, call: Any, block: Block, what: str) -> None:
        if self._passed(call, block):
            return
        # one by one they tell which of them it is
        alone = [n for n in block.names if not self._passed(call, self._filled(n, block))]
        named = ", ".join(
            f"{n} ({v.causality} of variability {v.variability})"
            for n, v in ((n, self.fmu.variable(n)) for n in alone or block.names)
        )
        hint = "; a start, a parameter or an input must be one that can be set"
        raise FmuError(
            f"{self.fmu.path.name}: refuses to {what} {named}{self._last()}"
            f"{hint if what == 'take' else ''}"
        )

    def _passed(self, call: Any, block: Block) -> bool:
        more = () if self.version == 2 else (len(block.values) if block.count else 0,)
        return bool(call(self._component, block.references, block.count, block.values, *more) < 2)

    def _filled(self, name: str, block: Block) -> Block:
        """A block of one of the names of another one, with its value."""
        alone = self.block([name])
        if alone.whole is None:
            alone.array[0] = block.array[block.names.index(name)]
        else:
            self._passed(self._get, alone)
        return alone

    def assign(self, values: Mapping[str, Number]) -> None:
        """Set variables of any numeric type by name, before or during initialization."""
        reals = self.block(n for n in values if self.fmu.variable(n).type in _REALS)
        reals.array[:] = [float(values[n]) for n in reals.names]
        self.write(reals)
        for name, value in values.items():
            variable = self.fmu.variable(name)
            if name in reals.names:
                continue
            boolean = ctypes.c_bool if self.version == 3 else ctypes.c_int
            kind = boolean if variable.type == "Boolean" else _WHOLE.get(variable.type)
            if kind is None:
                raise InputError(
                    f"{self.fmu.path.name}: variable {name!r} is a {variable.type}; only real, "
                    "integer and boolean values can be set"
                )
            whole = variable.type == "Enumeration" and self.version == 2
            function = f"Set{'Integer' if whole else variable.type}"
            more: tuple[Sequence[Any], Sequence[Any]] = (
                ((), ()) if self.version == 2 else ((_U,), (1,))
            )
            taken = (
                ctypes.byref(ctypes.c_uint(variable.valueReference)),
                1,
                ctypes.byref(kind(int(value))),
                *more[1],
            )
            self._call(function, [_P, _U, _P, *more[0]], *taken)

    # --- a run ------------------------------------------------------------------------------------

    def begin(self, time: float, values: Mapping[str, Number] | None = None) -> None:
        """Reset where it was used, set start values and enter initialization."""
        if self._used:
            self._call("Reset", [])
        self._used = True
        self.messages.clear()
        self.assign(values or {})
        if self.version == 2:
            self._call("SetupExperiment", [_I, _D, _D, _I, _D], *(0, 0.0, time, 0, 0.0))
            self._call("EnterInitializationMode", [])
        else:
            self._call(
                "EnterInitializationMode", [_B, _D, _D, _B, _D], *(False, 0.0, time, False, 0.0)
            )

    def ready(self) -> FloatArray:
        """Leave initialization; the states of a model-exchange FMU, a copy."""
        self._call("ExitInitializationMode", [])
        if self.kind == "cs":
            return np.empty(0)
        self._settle()
        self._call("EnterContinuousTimeMode", [])
        self._call("GetContinuousStates", [_P, _U], self.x, self.size)
        return self._x.copy()

    def _settle(self) -> None:
        """Event iteration; an FMU that plans time events is refused."""
        for _ in range(_SETTLE):
            if self.version == 2:
                info = ctypes.create_string_buffer(_EVENT2)
                self._call("NewDiscreteStates", [_P], info)
                again, planned = (
                    int.from_bytes(info.raw[4 * i : 4 * i + 4], "little") for i in (0, 4)
                )
            else:
                flags, when = [_B() for _ in range(5)], _D()
                self._call(
                    "UpdateDiscreteStates",
                    [_P] * 6,
                    *(ctypes.byref(f) for f in flags),
                    ctypes.byref(when),
                )
                again, planned = int(flags[0].value), int(flags[4].value)
            if planned:
                raise InputError(
                    f"{self.fmu.path.name}: plans time events, which model exchange here does "
                    "not follow; use its co-simulation"
                )
            if not again:
                return
        raise FmuError(f"{self.fmu.path.name}: its event iteration does not end")

    def nominals(self) -> FloatArray:
        """Nominal values of the states."""
        found = (_D * max(self.size, 1))()
        self._call("GetNominalsOfContinuousStates", [_P, _U], found, self.size)
        return np.asarray(np.abs(np.array(found)[: self.size]), dtype=np.float64)

    def slope(self, time: float, x: FloatArray) -> FloatArray:
        """Derivatives at a time and state, with the inputs last set; a copy."""
        self._x[:] = x
        self._slopes(time)
        return self._dx.copy()

    def accept(self, time: float, _state: FloatArray) -> None:
        """Tell the FMU that the integrator step to the time and state last evaluated is done."""
        if self._completed is not None:
            event = ctypes.addressof(self._flags)
            if self._completed(self._component, 1, event, event + 8) > 1:
                raise FmuError(
                    f"{self.fmu.path.name}: refuses a completed step at t = {time:g} "
                    f"s{self._last()}"
                )

    def do_step(self, time: float, step: float) -> None:
        """One communication step of a co-simulation FMU."""
        if self.version == 2:
            status = self._step(self._component, time, step, 1)
        else:
            a = ctypes.addressof(self._flags)
            status = self._step(*(self._component, time, step, True, a, a + 8, a + 16, a + 24))
        if status > 1:
            raise FmuError(
                f"{self.fmu.path.name}: doStep failed with status {status} "
                f"({STATUS.get(status, 'unknown')}) at t = {time:g} s{self._last()}; check start "
                "values, parameters and their bounds: it takes no step from there"
            )

    def close(self) -> None:
        """Free the instance."""
        self._close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_about: object) -> None:
        self.close()


__all__ = ["Block", "Kind", "UserFmu", "UserInstance"]
