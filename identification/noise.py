"""Measurement noise from the record itself, without a data sheet."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def noise_level(values: FloatArray, segments: tuple[slice, ...]) -> float:
    """Standard deviation of the white noise of a channel from its fourth differences.

    The standard deviation of fourth differences, cut at their 95 % quantile, divided by 0.87
    sqrt(70); holds for quantised channels, where the median absolute deviation reads too much.

    Parameters
    ----------
    values : (n,) array
    segments : tuple of slice
        Contiguous stretches; differences do not cross them.

    Returns
    -------
    float
        In the unit of the channel; 0.0 for a channel that does not change.
    """
    parts = [np.diff(values[s], 4) for s in segments if s.stop - s.start > 8]
    if not parts:
        return 0.0
    fourth = np.concatenate(parts)
    magnitude = np.abs(fourth)
    cut = fourth[magnitude <= np.quantile(magnitude, 0.95)]
    if not len(cut):
        return 0.0
    return float(np.std(cut) / 0.87 / np.sqrt(70))
