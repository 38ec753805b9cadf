"""What a motion tells of the parameters of an estimator, and errors of estimates in those
directions alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from identification.data.joint_file import Joint
from identification.online.first_window import prior_range
from identification.online.options import OnlineOptions, held_parameters, prepared
from identification.online.rows import RowMaker
from identification.online.samples import Samples
from identification.online.watch import DRIVE, Q_L, Q_M, SAMPLED, TAU
from identification.recursive.prior_start import UNDETERMINED

FloatArray = npt.NDArray[np.float64]


@final
@dataclass(frozen=True)
class Identifiable:
    """Directions that the rows of a run do not determine.

    Attributes
    ----------
    names : tuple of str
        Estimated parameters.
    scale : (parameters,) array
        Prior range of each.
    blind : (parameters, directions) array
        Orthonormal, in parameters over their scale: posterior over prior variance is above
        :data:`identification.recursive.prior_start.UNDETERMINED`.
    """

    names: tuple[str, ...]
    scale: FloatArray
    blind: FloatArray

    def seen(self, error: FloatArray) -> FloatArray:
        """The part of an error (parameters,) that the run shows; the rest is not the
        estimator's to know.
        """
        scaled = error / self.scale
        found: FloatArray = (scaled - self.blind @ (self.blind.T @ scaled)) * self.scale
        return found

    def alone(self, index: int) -> bool:
        """True where a parameter is determined by itself and not only in a combination."""
        return float(np.sum(self.blind[index] ** 2)) <= UNDETERMINED


def identifiable(
    truth: Joint,
    readings: FloatArray,
    noise: FloatArray,
    dt: float,
    names: Sequence[str],
    options: OnlineOptions | None = None,
) -> Identifiable:
    """Directions that readings of a joint show, from its rows at its true values.

    Parameters
    ----------
    truth : Joint
        With values of all parameters.
    readings : (samples, 6) array
        Drive, motor position and velocity, link position and velocity, torque; link-referred SI.
    noise : (6,) array
        Standard deviation of each.
    dt : float
        Sample time [s].
    names : sequence of str
        What the estimator follows: one without values of the joint looks for no skew of a clock.
    options : OnlineOptions, optional
    """
    options = options or OnlineOptions()
    model, sensing = prepared(truth, options)
    rows = RowMaker(model, sensing, dt, held_parameters(truth))
    samples = Samples(rows.timing, [True] * 6, rows.alignment)
    values = dict(zip(model.parameter_names, model.value_vector(), strict=True))
    whole = np.array([values[n] for n in rows.names])
    kept_y, kept_h = [], []
    for k, row in enumerate(readings.tolist()):
        samples.add((row[Q_M], row[Q_L], row[TAU], row[DRIVE]))
        if k % rows.timing.stride == rows.timing.stride - 1:
            found = rows.make(samples.window, k * dt - samples.lag)
            if found is not None:
                kept_y.append(found[0])
                kept_h.append(found[1])
    own = [rows.names.index(n) for n in names]
    y, h, theta = np.array(kept_y), np.array(kept_h)[:, :, own], whole[own]
    like = np.array([own.index(next(j for j in own if rows.like[j] == rows.like[i])) for i in own])
    scale = prior_range(theta, theta, h, y, rows.usual[own], like)
    least = np.maximum(
        options.floor_share * np.sqrt(np.mean(y**2, axis=0)),
        rows.floor(whole.tolist(), noise[list(SAMPLED)]),
    )
    weighted = (h * scale / (np.sqrt(rows.timing.overlap) * least)[:, None]).reshape(-1, theta.size)
    value, vector = np.linalg.eigh(weighted.T @ weighted)
    return Identifiable(
        tuple(names), scale, vector[:, 1.0 / (1.0 + np.maximum(value, 0.0)) > UNDETERMINED]
    )


__all__ = ["Identifiable", "identifiable"]
