"""Outputs of a user's FMU against measured ones: error, noise floor and where it is worst."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from identification.balance.noise import noise_level
from identification.data.record import Record
from irj_fmu.host.signals import FloatArray
from irj_fmu.imported.model import UserModel
from irj_fmu.imported.run import Window


@final
@dataclass(frozen=True)
class OutputError:
    """Error of one output.

    Attributes
    ----------
    rms, floor : float
        Of measured less simulated, and what white noise of the channel alone would leave, in
        `unit`.
    fit_percent : float
        100 (1 - norm(residual) / norm(measured - mean)).
    whiteness : float
        Autocorrelation of the residual one sample later.
    """

    channel: str
    variable: str
    unit: str
    rms: float
    floor: float
    fit_percent: float
    relative_error_percent: float
    whiteness: float

    @property
    def ratio(self) -> float:
        """Error over floor: 1 where only noise is left."""
        return self.rms / self.floor if self.floor > 0 else math.inf


@final
@dataclass(frozen=True)
class UserComparison:
    """A user's FMU against records.

    Attributes
    ----------
    outputs : mapping of str to OutputError
        By channel.
    worst_window : tuple of float
        Start and end of the second with the largest error, time stamps of its record [s].
    time : tuple of (n,) array
        Of each window [s].
    measured, simulated : tuple of (n, outputs) array
        Of each window, in the units of the FMU.
    """

    name: str
    outputs: Mapping[str, OutputError]
    worst_window: tuple[float, float]
    time: tuple[FloatArray, ...]
    measured: tuple[FloatArray, ...]
    simulated: tuple[FloatArray, ...]

    def __repr__(self) -> str:
        ratios = ", ".join(f"{c} {e.ratio:.3g}" for c, e in self.outputs.items())
        return f"UserComparison({self.name!r}, over the floor: {ratios})"

    def as_json(self) -> dict[str, Any]:
        """Errors as data."""
        return {
            "record": self.name,
            "worst_window_s": list(self.worst_window),
            "outputs": {c: {**e.__dict__, "ratio": e.ratio} for c, e in self.outputs.items()},
        }

    def __str__(self) -> str:
        parts = [
            f"{c} fit {e.fit_percent:.4g} %, error {e.rms:.3g} {e.unit}, {e.ratio:.3g} times its "
            "floor"
            for c, e in self.outputs.items()
        ]
        return f"{self.name}: {'; '.join(parts)}"


def noise_of(model: UserModel, records: Sequence[Record]) -> FloatArray:
    """White noise of the measured outputs, in the units of the FMU."""
    levels = [
        [abs(m.scale) * noise_level(r[m.channel], tuple(r.segments())) for m in model.outputs]
        for r in records
    ]
    found: FloatArray = np.median(np.array(levels), axis=0)
    return found


def comparison_of(
    model: UserModel,
    records: Sequence[Record],
    windows: Sequence[Window],
    predicted: Sequence[FloatArray],
) -> UserComparison:
    """The comparison of simulated windows."""
    floors = noise_of(model, records)
    measured = np.concatenate([w.outputs for w in windows])
    residual = measured - np.concatenate(list(predicted))
    found = {}
    for i, m in enumerate(model.outputs):
        y, r = measured[:, i], residual[:, i]
        spread = float(np.linalg.norm(y - y.mean())) or 1e-300
        size = float(np.linalg.norm(y)) or 1e-300
        centred = r - r.mean()
        power = float(centred @ centred)
        found[m.channel] = OutputError(
            m.channel,
            m.variable,
            model.fmu.variable(m.variable).unit or "",
            rms=float(np.sqrt(np.mean(r**2))),
            floor=float(floors[i]),
            fit_percent=100 * (1 - float(np.linalg.norm(r)) / spread),
            relative_error_percent=100 * float(np.linalg.norm(r)) / size,
            whiteness=float(centred[1:] @ centred[:-1]) / power if power > 0 else 0.0,
        )
    return UserComparison(
        ", ".join(r.name for r in records),
        found,
        _worst(windows, residual),
        tuple(w.time for w in windows),
        tuple(w.outputs for w in windows),
        tuple(predicted),
    )


def _worst(windows: Sequence[Window], residual: FloatArray) -> tuple[float, float]:
    """The second with the largest error."""
    scale = np.maximum(np.sqrt(np.mean(residual**2, axis=0)), 1e-300)
    power = np.sum((residual / scale) ** 2, axis=1)
    best, place, first = -1.0, (0.0, 0.0), 0
    for w in windows:
        n = len(w.time)
        own = power[first : first + n]
        first += n
        width = max(1, min(n, round(1.0 / max(float(np.median(np.diff(w.time))), 1e-9))))
        sums = np.convolve(own, np.ones(width), "valid")
        k = int(np.argmax(sums))
        if sums[k] > best:
            best, place = float(sums[k]), (float(w.time[k]), float(w.time[k + width - 1]))
    return place


__all__ = ["OutputError", "UserComparison", "comparison_of", "noise_of"]
