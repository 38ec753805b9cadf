"""Integrate a model-exchange FMU with inputs that move inside the integrator's step.

Common hosts freeze the inputs at the last communication point; the error then does not fall with
the tolerance. Here each evaluation sees its own time, and the integrator stops where an input
jumps.

Method: Dormand & Prince, J. Comput. Appl. Math. 6 (1980) 19-26; step control after Hairer, Norsett
& Wanner, Solving Ordinary Differential Equations I, section II.4.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np

from identification.errors import InputError
from irj_fmu.host.described import has_state_events
from irj_fmu.host.run import FmuError, Instance, Number, Trajectory
from irj_fmu.host.signals import FloatArray, Signal, Table

_C = np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1, 1])
_A = np.zeros((7, 6))
_A[1, :1] = [1 / 5]
_A[2, :2] = [3 / 40, 9 / 40]
_A[3, :3] = [44 / 45, -56 / 15, 32 / 9]
_A[4, :4] = [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729]
_A[5, :5] = [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656]
_A[6, :6] = [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84]
_E = np.array([71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
_MAX_TRIALS = 1_000_000


@final
@dataclass(frozen=True)
class Exchange:
    """Options of `simulate_me`.

    Parameters
    ----------
    inputs : mapping
        Input name to function of time. Held tables stop the integrator at each sample.
    parameters : mapping
        Start values by name.
    record : sequence of str
        Variables to record; by default the outputs.
    rtol, atol : float
        Relative tolerance, and absolute tolerance in units of the nominal values.
    breakpoints : sequence of float
        Further times in s at which an input jumps or bends.
    """

    inputs: Mapping[str, Signal] = field(default_factory=dict)
    parameters: Mapping[str, Number | str] = field(default_factory=dict)
    record: Sequence[str] = ()
    rtol: float = 1e-9
    atol: float = 1e-11
    breakpoints: Sequence[float] = ()


def simulate_me(
    instance: Instance, times: FloatArray, options: Exchange | None = None
) -> Trajectory:
    """Integrate a model-exchange FMU without state events.

    Parameters
    ----------
    instance : Instance
        Opened with ``kind="me"``; it is reset first.
    times : array, shape (n,)
        Increasing output times in s; the first is the start.
    options : Exchange, optional
        Inputs, parameters, records, tolerances.

    Returns
    -------
    Trajectory
        The recorded variables at `times`.

    Raises
    ------
    InputError
        Where a name is unknown, the times do not increase or the FMU has event indicators.
    FmuError
        Where the FMU refuses a call or the derivative is not finite.
    """
    options = options or Exchange()
    times = np.asarray(times, dtype=float)
    if times.ndim != 1 or times.size < 2 or not np.all(np.diff(times) > 0):
        raise InputError("model exchange: give at least two increasing output times")
    if has_state_events(instance.fmu.description):
        raise InputError(
            f"{instance.fmu.path.name}: state events are not supported; use its co-simulation"
        )
    record = tuple(options.record) or tuple(
        name
        for name, v in instance.fmu.variables.items()
        if v.causality == "output" and v.type in ("Real", "Float64") and not v.shape
    )
    driver = _Driver(instance, options)
    x = driver.start(float(times[0]))
    places = instance.blocks(record)
    table = {name: np.empty(times.size) for name in record}
    stops = driver.stops(times)
    row = 0
    for begin, end in zip(stops, [*stops[1:], None], strict=True):
        if begin >= times[row] - 1e-15:
            driver.slope(begin, x, begin)
            for block in places:
                for name, value in zip(block.names, instance.read(block), strict=True):
                    table[name][row] = value
            row += 1
        if end is not None:
            x = driver.advance(begin, end, x)
    return Trajectory(times, table)


@final
class _Driver:
    """The right-hand side of one run and the step that carries over between its segments."""

    def __init__(self, instance: Instance, options: Exchange) -> None:
        self.instance, self.options = instance, options
        names = list(options.inputs)
        self.held = [
            isinstance(signal, Table) and signal.hold for signal in options.inputs.values()
        ]
        blocks = instance.blocks(names)
        if len(blocks) > 1 or any(not block.real for block in blocks):
            raise InputError(f"{instance.fmu.path.name}: model exchange takes Real inputs only")
        self.block = blocks[0] if blocks else None
        self.signals: list[Callable[[float], float]] = [options.inputs[name] for name in names]
        slopes = [d.variable for d in instance.fmu.description.derivatives]
        self.size = sum(math.prod(v.shape or ()) for v in slopes)  # FMI 3.0 has arrays of states
        version = instance.fmu.version
        self.give, self.take = (
            f"fmi{version}SetContinuousStates",
            "fmi2GetDerivatives" if version == 2 else "fmi3GetContinuousStateDerivatives",
        )
        part = instance.fmu.description.modelExchange
        self.completed: bool = bool(part.needsCompletedIntegratorStep)
        self.x = (ctypes.c_double * self.size)()
        self.dx = (ctypes.c_double * self.size)()
        self.view: FloatArray = np.ctypeslib.as_array(self.dx)
        self.state: FloatArray = np.ctypeslib.as_array(self.x)
        self.nominal = np.ones(self.size)
        self.stepper: Stepper | None = None

    def start(self, time: float) -> FloatArray:
        """Initialize and return the state."""
        instance = self.instance
        instance.begin(time, self.options.parameters)
        self.set_inputs(time, time)
        instance.ready()
        instance.call("getContinuousStates", self.x, self.size)
        nominal = (ctypes.c_double * self.size)()
        instance.call("getNominalsOfContinuousStates", nominal, self.size)
        self.nominal = np.array(nominal)
        return self.state.copy()

    def stops(self, times: FloatArray) -> list[float]:
        """Return output times and jumps of inputs, sorted, without near doubles."""
        extra = [np.asarray(self.options.breakpoints, dtype=float)]
        extra += [
            signal.time for signal in self.options.inputs.values() if isinstance(signal, Table)
        ]
        inner = np.concatenate(extra)
        inner = inner[(inner > times[0]) & (inner < times[-1])]
        near = np.abs(times[np.clip(np.searchsorted(times, inner), 1, times.size - 1)] - inner)
        near = np.minimum(
            near, np.abs(times[np.clip(np.searchsorted(times, inner) - 1, 0, None)] - inner)
        )
        return [
            float(t)
            for t in np.unique(np.concatenate([times, inner[near > 1e-12 * (1 + np.abs(inner))]]))
        ]

    def set_inputs(self, time: float, begin: float) -> None:
        """Set the inputs of `time`; held tables keep the value they have at `begin`."""
        if self.block is None:
            return
        for i, signal in enumerate(self.signals):
            self.block.values[i] = signal(begin if self.held[i] else time)
        self.instance.write(self.block)

    def slope(self, time: float, x: FloatArray, begin: float) -> FloatArray:
        """Return the derivative at a time and state."""
        raw = self.instance.raw
        self.state[:] = x
        self.instance.call("setTime", time)
        self.instance.call(self.give, raw.component, self.x, self.size)
        self.set_inputs(time, begin)
        self.instance.call(self.take, raw.component, self.dx, self.size)
        return self.view.copy()

    def advance(self, begin: float, end: float, x: FloatArray) -> FloatArray:
        """Integrate over a segment in which no input jumps."""
        stepper = self.stepper
        if stepper is None:
            stepper = self.stepper = Stepper(
                self.instance.name,
                self.nominal,
                self.options.rtol,
                self.options.atol,
                self.accept if self.completed else None,
            )
        return stepper.advance(lambda time, state: self.slope(time, state, begin), begin, end, x)

    def accept(self, _time: float, _x: FloatArray) -> None:
        """Tell the FMU that the step to the time and state last evaluated is done."""
        self.instance.call("completedIntegratorStep")


@final
class Stepper:
    """Dormand-Prince steps whose length carries over from one segment to the next.

    Parameters
    ----------
    name : str
        Of the model, for messages.
    nominal : array, shape (n,)
        Nominal values of the states.
    rtol, atol : float
        Relative tolerance, and absolute tolerance in units of the nominal values.
    accepted : callable, optional
        Called with time and state after each accepted step.
    """

    def __init__(
        self,
        name: str,
        nominal: FloatArray,
        rtol: float,
        atol: float,
        accepted: Callable[[float, FloatArray], None] | None = None,
    ) -> None:
        self.name, self.nominal, self.rtol, self.atol, self.accepted = (
            name,
            nominal,
            rtol,
            atol,
            accepted,
        )
        self.step = 0.0

    def advance(
        self,
        slope: Callable[[float, FloatArray], FloatArray],
        begin: float,
        end: float,
        x: FloatArray,
    ) -> FloatArray:
        """State at `end` of a segment in which no input jumps.

        Raises
        ------
        FmuError
            Where the derivative is not finite or not smooth, or the model is stiff.
        """
        size = len(self.nominal)
        if size == 0:
            return x
        k = np.empty((7, size))
        k[0] = slope(begin, x)
        now, step = begin, self.step or min(end - begin, 1e-6)
        for _ in range(_MAX_TRIALS):
            last = now + 1.01 * step >= end
            h = end - now if last else step
            new = x
            for stage in range(1, 7):
                new = x + h * (_A[stage, :stage] @ k[:stage])
                k[stage] = slope(now + _C[stage] * h, new)
            scale = self.atol * self.nominal + self.rtol * np.maximum(np.abs(x), np.abs(new))
            error = float(np.sqrt(np.mean((h * (_E @ k) / scale) ** 2)))
            if error <= 1:
                factor = min(5.0, max(0.2, 0.9 * max(error, 1e-10) ** -0.2))
                step = max(step, h * factor) if last and factor >= 1 else h * factor
                now, x = now + h, new
                k[0] = k[6]
                if self.accepted is not None:
                    self.accepted(now, x)
                if last:
                    self.step = step
                    return x
            else:
                step = h * (max(0.2, 0.9 * error**-0.2) if error < 1e10 else 0.1)
                if not step > 1e-14 * (1 + abs(now)):
                    raise FmuError(
                        f"{self.name}: the derivative is not finite or not smooth at t = {now:g} s"
                    )
        raise FmuError(
            f"{self.name}: more than {_MAX_TRIALS} steps up to t = {end:g} s; the model is stiff"
        )
