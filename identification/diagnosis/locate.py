"""Where unexplained structure sits: which variable it depends on, at which order or frequency,
in which runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import balances_of
from identification.balance.weak import WeakRecord
from identification.diagnosis.lines import Line
from identification.fitting.assess import Error
from identification.fitting.engine import Dataset, Solution, stack

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

BINS: Final = 24
"""Bins of a table over one variable: each holds some sixty rows of a record of 40 s."""
AXIS_R2: Final = 0.15
"""Share of the residual below which a variable is not said to hold it."""
PEAK: Final = 10.0
"""Power of a peak over the median of the spectrum: averaged over four segments or more, noise
reaches it once in 1e4 spectra.
"""
NEAR_PEAK: Final = 5.0
"""Power of a peak over the median of its own octaves: a residual that is merely slow falls
smoothly.
"""
SEGMENT: Final = 256
"""Longest segment of such a spectrum [rows]: four seconds at the kernel of the claims."""
LOWEST_PEAK: Final = 1.5
"""Frequency [Hz] from which on a peak is looked for: the motion itself is slower."""
DIRECTION_GAIN: Final = 0.02
"""Share of the residual that a table must hold more with the direction than without to be said to
depend on it: twice the columns hold about as much by chance.
"""
WINDOW_SHARE: Final = 0.6
"""Share of the residual's power that the named stretch of the variable holds: most of it."""
LINEAR: Final = {"rad": "m", "rad/s": "m/s", "N.m": "N"}


@final
@dataclass(frozen=True)
class Unexplained:
    """Structure that no effect of the library explains.

    Attributes
    ----------
    balance : str
    axis : str or None
        Signal it depends on, with `` x direction`` where it changes sign with the velocity.
    low, high : float or None
        Range of the axis that holds most of it.
    share_percent : float
        Share of the residual's variance that the axis explains, block cross-validated.
    order, frequency_hz : float or None
    rms : float
        Of the residual [N.m].
    """

    balance: str
    share_percent: float
    axis: str | None = None
    low: float | None = None
    high: float | None = None
    unit: str | None = None
    order: float | None = None
    frequency_hz: float | None = None
    rms: float = 0.0
    by_direction: bool = False

    def as_json(self) -> dict[str, Any]:
        """The shape of `improve --json`."""
        return {
            "balance": self.balance,
            "axis": self.axis,
            "low": self.low,
            "high": self.high,
            "unit": self.unit,
            "share_percent": self.share_percent,
            "order": self.order,
            "frequency_hz": self.frequency_hz,
            "by_direction": self.by_direction,
            "rms": self.rms,
        }


def axes(
    records: Sequence[WeakRecord], sensing_has_torque: bool, kind: str = "rotary"
) -> dict[str, tuple[FloatArray, str]]:
    """Signals against which residuals are binned, averaged like the residuals."""

    def joined(name: str) -> FloatArray:
        return np.concatenate([w.averaged[name] for w in records])

    out = {
        "motor_velocity": (joined("motor_velocity"), "rad/s"),
        "link_position": (joined("link_position"), "rad"),
    }
    if sensing_has_torque:
        out["load"] = (joined("torque"), "N.m")
    out["motor_position"] = (joined("motor_position"), "rad")
    twist = joined("motor_position") - joined("link_position")
    if float(np.ptp(twist)) > 0:
        out["torsion"] = (twist, "rad")
    out.pop("link_position" if float(np.ptp(twist)) == 0 else "motor_position")
    out["time"] = (np.concatenate([w.time for w in records]), "s")
    return {
        n: (values, LINEAR.get(unit, unit) if kind == "linear" else unit)
        for n, (values, unit) in out.items()
    }


def binned(residual: FloatArray, axis: FloatArray, bins: int = BINS) -> tuple[FloatArray, IntArray]:
    """Bin edges with equal counts and the bin of each row."""
    edges = np.unique(np.quantile(axis, np.linspace(0, 1, bins + 1)))
    index = np.clip(np.searchsorted(edges, axis, side="right") - 1, 0, max(len(edges) - 2, 0))
    return edges, index.astype(np.int64)


def table_r2(
    residual: FloatArray, index: IntArray, block: IntArray, size: int, folds: int = 4
) -> float:
    """Cross-validated share of variance that a table over the bins explains."""
    explained = 0.0
    total = 0.0
    for k in range(folds):
        test = (block % folds == k) & (block >= 0)
        train = (block % folds != k) & (block >= 0)
        if not test.any() or not train.any():
            continue
        count = np.bincount(index[train], minlength=size)
        mean = np.bincount(index[train], weights=residual[train], minlength=size) / np.maximum(
            count, 1
        )
        explained += float(np.sum((residual[test] - mean[index[test]]) ** 2))
        total += float(np.sum(residual[test] ** 2))
    return 1 - explained / total if total > 0 else 0.0


def locate(
    solution: Solution, data: Dataset, error: Error, lines: Sequence[Line], threshold: float
) -> list[Unexplained]:
    """For every balance over its floor: the axis, order or frequency that holds most of the
    rest.
    """
    balances = balances_of(solution.model, data.sensing, wrt=())
    stacked = stack(balances, data.train, solution.values)
    signals = axes(data.train, data.sensing.has_torque, data.joint.kind)
    out: list[Unexplained] = []
    for balance in balances.balances:
        if error.balances[balance].ratio <= threshold:
            continue
        use = stacked.taking[balance]
        r = stacked.residual[balance][use] - stacked.residual[balance][use].mean()
        block, velocity = stacked.block[use], signals["motor_velocity"][0][use]
        found = [
            _axis(
                balance,
                name,
                values=values[use],
                unit=unit,
                residual=r,
                block=block,
                velocity=velocity,
            )
            for name, (values, unit) in signals.items()
        ]
        best = max(found, key=lambda u: u.share_percent)
        line = next((x for x in lines if x.balance == balance), None)
        peak = _peak(data, stacked.residual[balance])
        size = error.balances[balance].rms
        if best.share_percent < 100 * AXIS_R2:
            best = Unexplained(balance, max(best.share_percent, 0.0), rms=size)
        order = line.order if line is not None else None
        frequency = peak if order is None and best.axis is None else None
        out.append(
            Unexplained(
                balance,
                round(best.share_percent, 2),
                axis=best.axis,
                low=best.low,
                high=best.high,
                unit=best.unit,
                order=order,
                frequency_hz=frequency,
                rms=size,
                by_direction=best.by_direction,
            )
        )
    return out


def _axis(
    balance: str,
    name: str,
    values: FloatArray,
    unit: str,
    residual: FloatArray,
    block: IntArray,
    velocity: FloatArray,
) -> Unexplained:
    edges, index = binned(residual, values)
    size = max(len(edges) - 1, 1)
    plain = table_r2(residual, index, block, size)
    direction = (velocity > 0).astype(np.int64)
    both = table_r2(residual, index * 2 + direction, block, 2 * size)
    by_direction = both > plain + DIRECTION_GAIN
    power = np.asarray(np.bincount(index, weights=residual**2, minlength=size), dtype=np.float64)
    low, high = _window(edges, power)
    return Unexplained(
        balance, 100 * max(plain, both), name, low, high, unit, by_direction=by_direction
    )


def _window(edges: FloatArray, power: FloatArray) -> tuple[float, float]:
    """Shortest run of bins that holds most of the residual's power."""
    total = float(power.sum())
    best = (0, len(power) - 1)
    for first in range(len(power)):
        held = 0.0
        for last in range(first, len(power)):
            held += float(power[last])
            if held >= WINDOW_SHARE * total:
                if edges[last + 1] - edges[first] < edges[best[1] + 1] - edges[best[0]]:
                    best = (first, last)
                break
    return float(edges[best[0]]), float(edges[best[1] + 1])


def spectral_peak(solution: Solution, data: Dataset, balance: str) -> float | None:
    """Frequency of a peak [Hz] that stands over its surroundings in the spectrum of a balance's
    training residual, None where none does.
    """
    return _peak(
        data,
        stack(
            balances_of(solution.model, data.sensing, wrt=()), data.train, solution.values
        ).residual[balance],
    )


def _averaged_periodogram(values: FloatArray, length: int) -> FloatArray:
    """Power, to a factor, at the frequencies of a real transform of `length`: mean over segments
    that overlap by half, each less its mean, under a Hann window (Welch 1967).

    scipy.signal has this too, and takes as long to load as a comparison of two records.
    """
    length -= length % 2
    parts = np.lib.stride_tricks.sliding_window_view(values, length)[:: length // 2]
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    spectrum = np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * window)
    return np.asarray(np.mean(np.abs(spectrum) ** 2, axis=0))


def _peak(data: Dataset, r: FloatArray) -> float | None:
    first = 0
    spectra = []
    step = data.train[0].grid.dt * data.train[0].grid.stride
    for w in data.train:
        part = r[first : first + w.rows]
        first += w.rows
        if len(part) < 64:
            continue
        spectra.append(_averaged_periodogram(part, min(SEGMENT, len(part))))
    if not spectra or len({len(s) for s in spectra}) != 1:
        return None
    power = np.mean(spectra, axis=0)
    frequency = np.arange(len(power)) / (2 * (len(power) - 1) * step)
    use = frequency > LOWEST_PEAK
    k = int(np.argmax(np.where(use, power, 0.0)))
    # a residual that is merely slow has its largest power at the lowest frequency: a peak stands
    # over its own octaves too
    near = (
        use
        & (frequency > frequency[k] / 2)
        & (frequency < 2 * frequency[k])
        & (np.abs(np.arange(len(power)) - k) > 2)
    )
    stands = (
        power[k] > PEAK * float(np.median(power[use]))
        and near.any()
        and power[k] > NEAR_PEAK * float(np.median(power[near]))
    )
    return float(frequency[k]) if stands else None
