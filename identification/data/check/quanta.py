"""The step in which a channel was read."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

_ALL_STEPS: Final = 0.99
"""Share of the steps that must be whole: a glitch or a resampled row does not hide a quantum."""
_FEW_SIZES: Final = 0.2
"""Different step sizes as a share of the steps up to which numbers are levels of a quantiser, and
not just printed with few digits.
"""
_NEAR_STEP: Final = 1.5
"""Steps up to so many times the smallest one are one quantum (the next are two)."""
_OFF_STEP: Final = (0.02, 1e-4)
"""How far a step may be from a whole number of quanta: digits of the file, and the error of the
quantum itself that grows with the number.
"""
_ON_GRID: Final = 0.05
"""Scatter of the values around whole steps [steps] up to which they are on a grid."""
_ROUNDING: Final = 1e-9
"""Share of the largest step below which a step is rounding of the numbers and no quantum."""


def quantum(values: FloatArray) -> float | None:
    """Quantisation step of a channel, or None where its values are not multiples of one step, or
    are so only because few digits were printed.

    By all values at once where they stand on one grid: over a million steps a step that is known to
    1e-11 only would put a value on either side of a half.
    """
    rough = _common_step(values, _FEW_SIZES)
    found = None if rough is None else _by_all(values[np.isfinite(values)], rough)
    return rough if found is None else found[0]


def precise_step(values: FloatArray) -> tuple[float, float] | None:
    """The step that all changes of a channel are multiples of and its relative error, by all values
    at once; None where they do not stand on one grid of it.
    """
    rough = _common_step(values, 1.0)  # also the last digit of a file
    return None if rough is None else _by_all(values[np.isfinite(values)], rough)


def _by_all(values: FloatArray, rough: float) -> tuple[float, float] | None:
    """Slope of finite values over the number of steps to each of them, and its relative error."""
    shifted = values - values[0]
    count = np.concatenate(([0.0], np.cumsum(np.rint(np.diff(values) / rough))))
    spread = count - count.mean()
    total = float(spread @ spread)
    if total == 0.0:
        return None
    step = float(spread @ shifted) / total
    left = shifted - shifted.mean() - step * spread
    if not float(np.sqrt(np.mean(left**2))) < _ON_GRID * step:
        return None
    return step, float(np.sqrt(np.mean(left**2) / total)) / step


def _common_step(values: FloatArray, few_sizes: float) -> float | None:
    steps = np.abs(np.diff(values[np.isfinite(values)][:200_000]))
    steps = steps[steps > 0.0]
    if steps.size < 3:
        return None
    scale = float(steps.max())
    step = float(steps[steps > _ROUNDING * scale].min())
    near = steps[steps < _NEAR_STEP * step]
    step = float(near.mean())
    ratio = steps / step
    multiples = np.abs(ratio - np.rint(ratio)) < _OFF_STEP[0] + _OFF_STEP[1] * ratio
    few = float(np.unique(np.rint(ratio)).size) <= few_sizes * steps.size or steps.size < 100
    return step if multiples.mean() > _ALL_STEPS and few else None


__all__ = ["precise_step", "quantum"]
