"""The base of every slave FMU: pythonfmu's slave, declared by a table, with state, health and
sample time.
"""

from __future__ import annotations

import base64
import json
import math
import sys
import traceback
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from enum import IntEnum
from operator import itemgetter
from typing import Any, ClassVar
from xml.etree.ElementTree import Element

from pythonfmu import Fmi2Slave
from pythonfmu.enums import Fmi2Status

from irj_fmu.fmi.model_description import Description, Entry, model_description
from irj_fmu.fmi.variables import Kind, Value, Variable

SLACK = 1e-6
"""Rounding of a host's clock, as a share of the step."""
EARLY = 1e-5
"""Share of ``sample_time`` by which a host's step may come before the grid."""
ROUNDED = 1e-3
"""Share of ``sample_time`` by which the count of samples is rounded up: ten thousand steps of
rounding."""
_UNEVEN = 0.25
"""Largest deviation of the time between two samples from ``sample_time``, as a share of it,
that passes without a word.
"""
HOLD = 200
"""Samples for which ``health`` remembers an uneven one."""
_KNOWN = 64
"""Lists of references whose kinds are looked at once and remembered."""


class Health(IntEnum):
    """Values of the output ``health``; the largest that applies is shown."""

    OK = 0
    WARMING_UP = 1
    NUMERIC_TROUBLE = 2
    STEP_MISMATCH = 3
    INTERNAL_ERROR = 4


STANDARD = (
    Variable(
        "sample_time",
        "s",
        1e-3,
        1e-5,
        1e3,
        causality="parameter",
        description="Time between two samples.",
    ),
    Variable(
        "health",
        start=0,
        minimum=0,
        maximum=4,
        causality="output",
        kind="integer",
        description="0 ok, 1 warming up, 2 numeric trouble or input not finite, 3 host step "
        "above sample_time, "
        "4 internal error",
    ),
    Variable(
        "n_samples",
        start=0,
        minimum=0,
        causality="output",
        kind="integer",
        description="Samples processed.",
    ),
)


class TableSlave(Fmi2Slave):  # type: ignore[misc, unused-ignore]
    """A slave whose variables stand in a table and whose work is one function of sampled inputs.

    A concrete class gives `variables` and `process`, and where it has memory `get_state` and
    `set_state`. ``do_step`` never fails: trouble shows in the output ``health`` and in the log, and
    the outputs keep their values.

    The inputs a host sets before a step of length h at time t hold at t. A sample is taken there
    where the grid of ``sample_time`` has come; in smaller host steps between, the outputs hold.

    Attributes
    ----------
    variables : tuple of Variable
        Inputs, outputs and parameters besides `STANDARD`, in the order of the value references.
    default_sample_time : float
        Start value of the parameter ``sample_time`` in s.
    resamples : bool
        True where `process` takes samples at any times, up to :meth:`longest` apart.
    """

    variables: ClassVar[tuple[Variable, ...]] = ()
    default_sample_time: ClassVar[float] = 1e-3
    resamples: ClassVar[bool] = False
    summary: ClassVar[str] = ""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.table = (*self._standard(), *self.variables)
        self._kinds: list[Kind] = [v.kind for v in self.table]
        self._values: list[Value] = [v.start for v in self.table]
        self._index = {v.name: i for i, v in enumerate(self.table)}
        self._inputs = [(v.name, i) for i, v in enumerate(self.table) if v.causality == "input"]
        self._reals = [
            i for i, v in enumerate(self.table) if v.causality == "input" and v.kind == "real"
        ]
        self._writable = [v.causality in ("input", "parameter") for v in self.table]
        self._tunable = [v.causality == "parameter" for v in self.table]
        kinds: tuple[Kind, ...] = ("real", "integer", "boolean", "string")
        self._inputs_of = {
            kind: frozenset(i for _, i in self._inputs if self._kinds[i] == kind) for kind in kinds
        }
        self._known: dict[tuple[Kind, tuple[int, ...]], Any] = {}
        self._plain: set[tuple[Kind, tuple[int, ...]]] = set()  # references of inputs alone
        self._phase = 0
        self._changed = False
        self._configured: dict[str, Value] = {}
        self._start = self._last = math.nan
        self._count, self._step, self._too_long = 0, 0.0, False
        self._uneven, self._expected = -math.inf, 0.0
        self._reported: set[str] = set()
        self._forget_path()

    def _standard(self) -> tuple[Variable, ...]:
        from dataclasses import replace

        return (replace(STANDARD[0], start=self.default_sample_time), *STANDARD[1:])

    def _forget_path(self) -> None:
        """Take the FMU's folder off the import path again, where the library has put it at each
        instantiation.
        """
        resources = str(self.resources)
        sys.path[:] = [entry for entry in sys.path if entry != resources]

    # -- what a concrete slave gives ------------------------------------------------

    def configure(self, parameters: Mapping[str, Value]) -> None:
        """Take the parameters over; called at the end of initialization and after a tunable one
        has changed.
        """

    @abstractmethod
    def process(self, time: float, step: float, inputs: Mapping[str, Value]) -> Mapping[str, Value]:
        """Take one sample.

        Parameters
        ----------
        time : float
            Time of the sample in s.
        step : float
            Time since the last sample in s, ``sample_time`` at the first.
        inputs : mapping
            Name to value; every real is finite.

        Returns
        -------
        mapping
            New values of outputs, by name, as many as have changed; ``health`` may be among them.
        """

    def longest(self, period: float) -> float:
        """Longest step of a host that is followed [s], at a sample time `period`."""
        return period

    def get_state(self) -> bytes:
        """Return everything `process` remembers."""
        return b""

    def set_state(self, state: bytes) -> None:
        """Restore what `get_state` returned."""

    # -- life cycle -------------------------------------------------------------------

    def parameters(self) -> dict[str, Value]:
        """Return the parameters by name."""
        return {
            v.name: self._values[i] for i, v in enumerate(self.table) if v.causality == "parameter"
        }

    def setup_experiment(self, start_time: float, *_: Any) -> None:
        """Note the start of the sample grid."""
        self._start = start_time

    def exit_initialization_mode(self) -> None:
        """Configure; a failure shows in the output ``health``."""
        self._phase = 1
        self._guarded(self._configure)

    def _configure(self) -> None:
        self._changed = False
        self._configured = self.parameters()
        for variable in self.table:
            _in_range(variable, self._configured.get(variable.name))
        self.configure(self._configured)

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Take a sample where one is due; always True."""
        try:
            self._sample(current_time, step_size)
        except Exception as error:
            self._failed(error)
        return True

    def _guarded(self, work: Any, *args: float) -> None:
        try:
            work(*args)
        except Exception as error:
            self._failed(error)

    def _failed(self, error: Exception) -> None:
        """Tell an exception by the output ``health`` and in the log."""
        self._values[self._index["health"]] = int(Health.INTERNAL_ERROR)
        self._report(f"{type(error).__name__}: {error}\n{traceback.format_exc()}")

    def _report(self, text: str, status: Any = Fmi2Status.warning) -> None:
        """Log a text once per instance."""
        if text not in self._reported and len(self._reported) < 100:
            self._reported.add(text)
            self.log(text, status)

    def _due(self, time: float, length: float) -> bool:
        """True where the grid of ``sample_time`` has come; a tunable parameter that has changed
        is taken over then.
        """
        values = self._values
        period = float(values[0])
        if self._start != self._start:
            self._start = time
        longest = self.longest(period)
        self._too_long = length > longest * (1 + SLACK)
        due = self._start + self._count * period
        if length <= period * (1 + SLACK) and time < due - period * EARLY:
            return False
        if self._changed:
            self._configure()
        self._step = period if self._last != self._last else time - self._last
        self._last = time
        self._count = math.floor((time - self._start) / period + ROUNDED) + 1
        if self._too_long:
            self._report(
                f"the host's step {length:g} s is too long for sample_time {period:g} s; steps "
                f"up to {longest:g} s are followed"
            )
        elif self._expected > 0 and (
            self._step > longest * (1 + SLACK)
            if self.resamples
            else abs(self._step - self._expected) > _UNEVEN * period
        ):
            self._uneven = time
            self._report(
                f"the host's steps of {length:g} s put samples {self._step:g} s apart, "
                f"sample_time is {period:g} s; use steps that divide it"
            )
        self._expected = max(period, length)
        self._too_long |= time < self._uneven + HOLD * period
        return True

    def _sample(self, time: float, length: float) -> None:
        if not self._due(time, length):
            return
        values = self._values
        health = Health.STEP_MISMATCH if self._too_long else Health.OK
        if all(math.isfinite(values[i]) for i in self._reals):  # type: ignore[arg-type, unused-ignore]
            outputs = self.process(time, self._step, {name: values[i] for name, i in self._inputs})
            for name, value in outputs.items():
                values[self._index[name]] = value
                if value != value:
                    health = max(health, Health.NUMERIC_TROUBLE)
            health = max(health, Health(int(outputs.get("health", 0))))
            values[2] = int(values[2]) + 1
        else:
            names = [self.table[i].name for i in self._reals if not math.isfinite(float(values[i]))]
            self._report(f"input not finite: {', '.join(names)}; the sample is left out")
            health = max(health, Health.NUMERIC_TROUBLE)
        values[1] = int(health)

    # -- variables ----------------------------------------------------------------------

    def _get(self, references: list[int], kind: Kind) -> Sequence[Any]:
        key = (kind, tuple(references))
        picked = self._known.get(key)
        if picked is None:
            for reference in references:
                if self._kinds[reference] != kind:
                    raise TypeError(
                        f"variable {self.table[reference].name} is {self._kinds[reference]}, not "
                        f"{kind}"
                    )
            if len(references) < 2:
                return [self._values[reference] for reference in references]
            picked = itemgetter(*references)
            if len(self._known) < _KNOWN:
                self._known[key] = picked
        found: Sequence[Any] = picked(self._values)
        return found

    def _set(self, references: list[int], new: list[Any], kind: Kind) -> None:
        key = (kind, tuple(references))
        plain = key in self._plain
        if not plain and all(map(self._inputs_of[kind].__contains__, references)):
            plain = True
            if len(self._plain) < _KNOWN:
                self._plain.add(key)
        if plain and len(new) == len(references):
            values = self._values
            for reference, value in zip(references, new, strict=True):
                values[reference] = value
            return
        for reference, value in zip(references, new, strict=True):
            variable = self.table[reference]
            if self._kinds[reference] != kind:
                raise TypeError(f"variable {variable.name} is {self._kinds[reference]}, not {kind}")
            if self._phase and (
                not self._writable[reference]
                or (self._tunable[reference] and variable.stated_variability == "fixed")
            ):
                self._report(
                    f"variable {variable.name} cannot be set after initialization; it keeps its "
                    "value"
                )
                continue
            if self._tunable[reference] and self._values[reference] != value:
                self._changed = True
            self._values[reference] = value

    def get_real(self, vrs: list[int]) -> list[float]:
        """Return values by reference."""
        return list(map(float, self._get(vrs, "real")))

    def get_integer(self, vrs: list[int]) -> list[int]:
        """Return values by reference."""
        return [int(value) for value in self._get(vrs, "integer")]

    def get_boolean(self, vrs: list[int]) -> list[bool]:
        """Return values by reference."""
        return [bool(value) for value in self._get(vrs, "boolean")]

    def get_string(self, vrs: list[int]) -> list[str]:
        """Return values by reference."""
        return [str(value) for value in self._get(vrs, "string")]

    def set_real(self, vrs: list[int], values: list[float]) -> None:
        """Set values by reference."""
        self._set(vrs, values, "real")

    def set_integer(self, vrs: list[int], values: list[int]) -> None:
        """Set values by reference."""
        self._set(vrs, values, "integer")

    def set_boolean(self, vrs: list[int], values: list[bool]) -> None:
        """Set values by reference."""
        self._set(vrs, values, "boolean")

    def set_string(self, vrs: list[int], values: list[str]) -> None:
        """Set values by reference."""
        self._set(vrs, values, "string")

    # -- FMU state --------------------------------------------------------------------------

    def _get_fmu_state(self) -> dict[str, Any]:
        return {
            "values": [
                _plain(value, kind) for value, kind in zip(self._values, self._kinds, strict=True)
            ],
            "clock": [
                *(float(t).hex() for t in (self._start, self._last, self._uneven, self._expected)),
                self._count,
                self._phase,
                self._changed,
            ],
            "state": bytes(self.get_state()),
        }

    def _set_fmu_state(self, state: dict[str, Any]) -> None:
        self._values = [
            _value(text, kind) for text, kind in zip(state["values"], self._kinds, strict=True)
        ]
        *times, self._count, self._phase, self._changed = state["clock"]
        self._start, self._last, self._uneven, self._expected = map(float.fromhex, times)
        if self._phase and self._configured != self.parameters():
            self._guarded(self._configure)
        self._guarded(lambda: self.set_state(state["state"]))

    @staticmethod
    def _fmu_state_to_bytes(state: dict[str, Any]) -> bytes:
        return json.dumps({**state, "state": base64.b64encode(state["state"]).decode()}).encode()

    @staticmethod
    def _fmu_state_from_bytes(state: bytes) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(state)
        found["state"] = base64.b64decode(found["state"])
        return found

    # -- description --------------------------------------------------------------------------

    def to_xml(self, model_options: Mapping[str, str] | None = None) -> Element:
        """Return modelDescription.xml; `model_options` may carry ``guid``, ``identifier`` and
        capabilities.
        """
        options = {key: str(value) for key, value in (model_options or {}).items()}
        name = options.pop("identifier", type(self).__name__)
        what = Description(
            name=name,
            identifier=name,
            guid=options.pop("guid", str(self.guid)),
            interfaces=("CoSimulation",),
            description=self.summary,
            step=self.default_sample_time,
            stop=1000 * self.default_sample_time,
            options={"needsExecutionTool": "true", "canInterpolateInputs": "false"} | options,
        )
        return model_description(what, [Entry(variable) for variable in self.table])


def _in_range(variable: Variable, value: Value | None) -> None:
    """Refuse a number outside what the model description says."""
    if value is None or variable.kind not in ("real", "integer"):
        return
    low = -math.inf if variable.minimum is None else variable.minimum
    high = math.inf if variable.maximum is None else variable.maximum
    if not low <= float(value) <= high or not math.isfinite(float(value)):
        raise ValueError(f"parameter {variable.name} = {value:g} is not in {low:g} to {high:g}")


def _plain(value: Value, kind: Kind) -> Value:
    if kind == "real":
        return float(value).hex()
    if kind == "string":
        return str(value)
    return bool(value) if kind == "boolean" else int(value)


def _value(plain: Value, kind: Kind) -> Value:
    return float.fromhex(str(plain)) if kind == "real" else plain
