"""Runs of a user's FMU along measured inputs, window by window."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, Protocol, final

import numpy as np

from casadi_models.solve import runge_kutta
from identification.errors import InputError
from irj_fmu.host.exchange import Stepper
from irj_fmu.host.run import Number
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.library import Kind, UserFmu

RTOL: Final = 1e-8
ATOL: Final = 1e-10
SAME: Final = 1e-6
"""Largest difference of fixed steps from steps of controlled length, relative to the range of
an output.
"""
SUBSTEPS: Final = (1, 2, 4, 8)
_TRIED: Final = 2000
STRAY: Final = 0.1
"""Share of an FMU's fixed step by which a stamp may miss the grid of such steps: stamps are written
with three digits of it or more, and a step that does not divide the sample misses by more."""
HOLD: Final = 1e-3
"""Longest time for which what is fed back holds, where its slope asks for nothing shorter [s]."""


@final
@dataclass(frozen=True)
class Window:
    """A stretch of a record in the units of the FMU.

    Attributes
    ----------
    time : (n,) array
        [s]
    inputs : (n, inputs) array
        What is held from each sample to the next.
    outputs : (n, outputs) array
        Measured.
    start : (starts,) array
        Start values of the variables that the measurement starts.
    record : int
        Number of the record.
    """

    time: FloatArray
    inputs: FloatArray
    outputs: FloatArray
    start: FloatArray
    record: int = 0


class Feedback(Protocol):
    """Something outside the FMU that reads its outputs and adds to its inputs.

    Attributes
    ----------
    hold : float
        Longest time for which what it adds may hold [s].
    """

    @property
    def hold(self) -> float: ...

    def begin(self, window: Window) -> None:
        """Before the first sample of a window."""

    def __call__(
        self, sample: int, time: float, inputs: FloatArray, outputs: FloatArray
    ) -> FloatArray:
        """What is added to the inputs from a time on, (inputs,); called again between samples
        that lie far apart.
        """


@final
class Runner:
    """One instance of a user's FMU that serves many runs.

    Parameters
    ----------
    fmu : UserFmu
    kind : {"me", "cs"}
    inputs, outputs, starts : sequence of str
        Variables of the columns of :class:`Window`.
    settings : mapping
        Values of further variables.

    Attributes
    ----------
    substeps : int
        Fixed Runge-Kutta steps between two samples; 0 for steps of controlled length.
    """

    def __init__(
        self,
        fmu: UserFmu,
        kind: Kind,
        *,
        inputs: Sequence[str],
        outputs: Sequence[str],
        starts: Sequence[str],
        settings: Mapping[str, Number],
    ) -> None:
        self.fmu, self.kind, self.starts, self.settings = fmu, kind, tuple(starts), dict(settings)
        self.instance = fmu.opened(kind)
        self._inputs, self._outputs = self.instance.block(inputs), self.instance.block(outputs)
        self.substeps = 0
        self._grain = fmu.grain(kind)
        self._begun, self._taken = 0.0, 0

    def choose_substeps(self, window: Window, values: Mapping[str, float]) -> None:
        """Take fixed steps where few of them agree with steps of controlled length: they cost a
        third.
        """
        if self.kind != "me" or not self.instance.size:
            return
        short = shortened(window)
        self.substeps = 0
        reference = self.run(short, values)
        for count in SUBSTEPS:
            self.substeps = count
            if agrees(self.run(short, values), reference):
                return
        self.substeps = 0

    def run(
        self,
        window: Window,
        values: Mapping[str, float],
        start: FloatArray | None = None,
        feedback: Feedback | None = None,
    ) -> FloatArray:
        """Outputs (n, outputs) along a window.

        Parameters
        ----------
        window : Window
        values : mapping
            Parameters by name.
        start : (starts,) array, optional
            In place of the window's start values.
        feedback : Feedback, optional

        Raises
        ------
        FmuError
            Where the FMU refuses a call.
        InputError
            Where an output is not finite.
        """
        instance, ins, outs = self.instance, self._inputs, self._outputs
        own = dict(
            zip(self.starts, (window.start if start is None else start).tolist(), strict=True)
        )
        times = window.time.tolist()
        self._begun, self._taken = times[0], 0
        instance.begin(times[0], {**self.settings, **values, **own})
        ins.array[:] = window.inputs[0]
        instance.write(ins)
        x = instance.ready()
        stepper = (
            Stepper(self.fmu.path.name, instance.nominals(), RTOL, ATOL, instance.accept)
            if self.kind == "me"
            else None
        )
        if feedback is not None:
            feedback.begin(window)
        table = np.empty((len(times), len(outs.names)))
        if stepper is not None:
            instance.slope(times[0], x)
        last = len(times) - 1
        for k, now in enumerate(times):
            held = window.inputs[k]
            ins.array[:] = held
            instance.write(ins)
            table[k] = instance.read(outs)
            if k == last:
                break
            end = times[k + 1]
            if feedback is None:
                x = self._advance(stepper, now, end, x)
                continue
            parts = parts_of(end - now, feedback.hold, self._grain)
            for i in range(parts):
                at = now + i * (end - now) / parts
                ins.array[:] = held + feedback(k, at, held, instance.read(outs) if i else table[k])
                instance.write(ins)
                x = self._advance(
                    stepper, at, now + (i + 1) * (end - now) / parts if i + 1 < parts else end, x
                )
        if not np.isfinite(table).all():
            row, column = np.argwhere(~np.isfinite(table))[0]
            raise InputError(
                f"{self.fmu.path.name}: output {outs.names[column]!r} is not finite from t = "
                f"{times[row]:g} s on; check start values, parameters and their bounds"
            )
        return table

    def _advance(
        self, stepper: Stepper | None, now: float, end: float, x: FloatArray
    ) -> FloatArray:
        """From one time to the next, inputs held: state of a model-exchange FMU."""
        instance = self.instance
        if stepper is None:
            if self._grain is None:
                instance.do_step(now, end - now)
            else:
                self._whole_steps(end, self._grain)
            return x
        slope = instance.slope
        if not instance.size:
            slope(end, x)
            return x
        if not self.substeps:
            return stepper.advance(slope, now, end, x)
        h = (end - now) / self.substeps

        def rates(share: float, at: FloatArray, begin: float) -> FloatArray:
            return slope(begin + share * h, at)

        for i in range(self.substeps):
            x = runge_kutta(partial(rates, begin=now + i * h), x, h)
        slope(end, x)
        instance.accept(end, x)
        return x

    def _whole_steps(self, end: float, grain: float) -> None:
        """Steps of an FMU that takes one length only, up to the one nearest to a time: stamps of a
        record stray from the grid of such steps, which it follows to rounding.
        """
        last = round((end - self._begun) / grain)
        if last <= self._taken or abs(end - self._begun - last * grain) > STRAY * grain:
            raise InputError(
                f"{self.fmu.path.name}: its fixed step of {1e3 * grain:.6g} ms does not divide the "
                f"time between samples (t = {end:g} s); export it with a step that does, or "
                "resample the record"
            )
        while self._taken < last:
            self.instance.do_step(self._begun + self._taken * grain, grain)
            self._taken += 1


def parts_of(length: float, hold: float, grain: float | None) -> int:
    """Equal parts of a sample, none longer than `hold` where the FMU's own step allows it.

    Parameters
    ----------
    length, hold : float
        [s]
    grain : float or None
        The FMU takes whole multiples of this step only [s].
    """
    wanted = max(1, math.ceil(length / hold - 1e-6))
    if grain is None:
        return wanted
    most = max(1, round(length / grain))
    return next((p for p in range(wanted, most + 1) if most % p == 0), most)


def shortened(window: Window) -> Window:
    """At most the first samples of a window, enough to try a step length on."""
    n = slice(0, _TRIED)
    return Window(window.time[n], window.inputs[n], window.outputs[n], window.start, window.record)


def agrees(found: FloatArray, reference: FloatArray) -> bool:
    """True where fixed steps follow the reference."""
    spread = np.maximum(np.ptp(reference, axis=0), 1e-300)
    return bool(np.all(np.abs(found - reference).max(axis=0) <= SAME * spread))


__all__ = [
    "ATOL",
    "HOLD",
    "RTOL",
    "Feedback",
    "Runner",
    "Window",
    "agrees",
    "parts_of",
    "shortened",
]
