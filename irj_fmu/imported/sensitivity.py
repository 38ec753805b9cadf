"""Outputs of a user's FMU and how they move with parameters and start values: exact where
possible, else by differences.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, Protocol, final

import numpy as np

from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.port import feedback_of
from irj_fmu.imported.run import SAME, Runner, Window

if TYPE_CHECKING:
    from irj_fmu.imported.model import UserModel
    from irj_fmu.imported.run import Feedback

STEP: Final = 1e-4
"""Step of a difference quotient at most, relative to the scale of what moves: rounding and the
errors of an FMU's solver are small beside what it moves.
"""
FAR: Final = 1.0
"""RMS by which such a step may move an output, in its noise: nearer than that a fit has no need to
know, and further a secant is no slope. A window that starts at a turn of dry friction takes another
way within that: with start values moved by a ten-thousandth of the range, 160 times the noise, a
fit of such windows went to and fro until its steps were used up.
"""
SMALLEST: Final = 1e-9
"""Step, relative to the scale of what moves, whose answer is roughness: rounding, or another
sequence of steps that the FMU's solver takes.
"""
ROOM: Final = 3.0
"""A step that moves the outputs by so many times what is wanted is made anew: each costs a run."""
CLEAR: Final = 100.0
"""What a step moves is at least so many times that roughness: the slope is then right to a
hundredth.
"""


class Simulator(Protocol):
    """Simulated windows, and their derivatives."""

    def simulate(self, values: Mapping[str, float], starts: FloatArray) -> list[FloatArray]:
        """Outputs (n, outputs) of every window; `starts` is (windows, starts)."""

    def sensitivities(
        self, values: Mapping[str, float], starts: FloatArray, names: Sequence[str]
    ) -> tuple[list[FloatArray], list[FloatArray]]:
        """Outputs, and derivatives (n, outputs, names + starts)."""


@final
class BlackBox:
    """Finite differences over whole runs: works with every FMU.

    Parameters
    ----------
    model : UserModel
    windows : sequence of Window
    noise : (outputs,) array
        Standard deviation of the noise of each output, in its unit.

    Attributes
    ----------
    say : callable
        Called with number and count before each derivative: it takes a run of every window.
    """

    def __init__(self, model: UserModel, windows: Sequence[Window], noise: FloatArray) -> None:
        self.model, self.windows = model, tuple(windows)
        size = np.ptp(np.concatenate([w.outputs for w in windows]), axis=0)
        self.noise = np.maximum(np.maximum(noise, SAME * size), 1e-300)
        self._shares: dict[str | int, float] = {}
        self._least: float | None = None
        self.say: Callable[[int, int], None] = lambda _number, _count: None
        self.runner: Runner = model.runner()
        self.runner.choose_substeps(self.windows[0], {p.name: p.value for p in model.parameters})
        self.bounds = model.bounds()
        self.spread = start_scale(model, windows)

    def simulate(self, values: Mapping[str, float], starts: FloatArray) -> list[FloatArray]:
        """See :class:`Simulator`."""
        own = {p.name: values[p.name] for p in self.model.parameters}
        feedback = self._feedback(values)
        return [
            self.runner.run(w, own, x, feedback) for w, x in zip(self.windows, starts, strict=True)
        ]

    def _feedback(self, values: Mapping[str, float]) -> Feedback | None:
        return feedback_of(self.model, values)

    def sensitivities(
        self, values: Mapping[str, float], starts: FloatArray, names: Sequence[str]
    ) -> tuple[list[FloatArray], list[FloatArray]]:
        """See :class:`Simulator`."""
        base = self.simulate(values, starts)

        def moved_by(key: str | int, share: float) -> tuple[list[FloatArray], float]:
            """Outputs after a step of a parameter or of a start value, and the step."""
            if isinstance(key, int):
                step = share * self.spread[key]
                moved = starts.copy()
                moved[:, key] += step
                return self.simulate(values, moved), step
            step = share * scale_of(values[key], self.bounds[key])
            if values[key] + step > self.bounds[key][1]:
                step = -step
            return self.simulate({**values, key: values[key] + step}, starts), step

        keys: list[str | int] = [*names, *range(starts.shape[1])]
        if self._least is None:
            least = [self._far(moved_by(k, SMALLEST)[0], base) for k in keys[-1:]]
            self._least = CLEAR * max(least, default=0.0)
        columns: list[list[FloatArray]] = []
        for number, key in enumerate(keys, 1):
            self.say(number, len(keys))
            share = self._shares.get(key, STEP)
            moved, step = moved_by(key, share)
            far = self._far(moved, base)
            wanted = max(FAR, self._least)
            if far > ROOM * wanted:
                share *= wanted / far
                moved, step = moved_by(key, share)
            self._shares[key] = share
            columns.append(_quotient(moved, base, step))
        stacked = [
            np.stack([c[w] for c in columns], axis=2) if columns else np.empty((*b.shape, 0))
            for w, b in enumerate(base)
        ]
        return base, stacked

    def _far(self, moved: Sequence[FloatArray], base: Sequence[FloatArray]) -> float:
        """RMS of a change of the outputs, in noise, of the output that moves most."""
        change = (np.concatenate(list(moved)) - np.concatenate(list(base))) / self.noise
        return float(np.sqrt(np.mean(change**2, axis=0)).max())


def _quotient(
    moved: Sequence[FloatArray], base: Sequence[FloatArray], step: float
) -> list[FloatArray]:
    return [(m - b) / step for m, b in zip(moved, base, strict=True)]


def scale_of(value: float, bounds: tuple[float, float]) -> float:
    """Size of a parameter: its value, else a tenth of its range, else 1."""
    if value != 0:
        return abs(value)
    span = bounds[1] - bounds[0]
    return 0.1 * span if np.isfinite(span) and span > 0 else 1.0


def start_scale(model: UserModel, windows: Sequence[Window]) -> FloatArray:
    """Size of the start values, from their spread over the windows or the range of the output
    of the same channel.
    """
    found = []
    for i, m in enumerate(model.starts):
        values = np.array([w.start[i] for w in windows])
        same = [j for j, o in enumerate(model.outputs) if o.channel == m.channel]
        if same:
            values = np.concatenate([w.outputs[:, same[0]] for w in windows])
        found.append(float(np.ptp(values)) or float(np.max(np.abs(values))) or 1.0)
    return np.array(found)


__all__ = ["BlackBox", "Simulator", "scale_of", "start_scale"]
