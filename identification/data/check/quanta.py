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
_ROUNDING: Final = 1e-9
"""Share of the largest step below which a step is rounding of the numbers and no quantum."""


def quantum(values: FloatArray) -> float | None:
    """Quantisation step of a channel, or None where its values are not multiples of one step, or
    are so only because few digits were printed.
    """
    return _common_step(values, _FEW_SIZES)


def grid_step(values: FloatArray) -> float | None:
    """The step that all changes of a channel are multiples of, an encoder's or the last digit of a
    file, or None.
    """
    return _common_step(values, 1.0)


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


__all__ = ["grid_step", "quantum"]
