"""Outputs of a user's FMU and how they move with parameters and start values: exact where
possible, else by differences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final, Protocol, final

import numpy as np

from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.port import feedback_of
from irj_fmu.imported.run import Runner, Window

if TYPE_CHECKING:
    from irj_fmu.imported.model import UserModel
    from irj_fmu.imported.run import Feedback

STEP: Final = 1e-4
"""Step of a difference quotient, relative to the scale of what moves."""


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
    """

    def __init__(self, model: UserModel, windows: Sequence[Window]) -> None:
        self.model, self.windows = model, tuple(windows)
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
        columns: list[list[FloatArray]] = []
        for name in names:
            step = STEP * scale_of(values[name], self.bounds[name])
            if values[name] + step > self.bounds[name][1]:
                step = -step
            columns.append(
                _quotient(self.simulate({**values, name: values[name] + step}, starts), base, step)
            )
        for i in range(starts.shape[1]):
            step = STEP * self.spread[i]
            moved = starts.copy()
            moved[:, i] += step
            columns.append(_quotient(self.simulate(values, moved), base, step))
        stacked = [
            np.stack([c[w] for c in columns], axis=2) if columns else np.empty((*b.shape, 0))
            for w, b in enumerate(base)
        ]
        return base, stacked


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
