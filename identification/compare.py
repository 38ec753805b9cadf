"""Compare: how far a fitted model is from records, and where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import numpy.typing as npt

from identification.assess import Error, assess
from identification.balances import Balances
from identification.engine import load_dataset, stack
from identification.fit import Fit
from identification.locate import axes, binned
from identification.record import Record

FloatArray = npt.NDArray[np.float64]


@final
@dataclass(frozen=True)
class Place:
    """Mean residual of a balance in bins of one signal, with a band from blocks.

    Attributes
    ----------
    balance, axis, unit : str
    centre, mean, low, high : (bins,) array
        Bin centres; mean residual and its 95 % band [N.m].
    strength : float
        Largest |mean| over the half width of its band.
    """

    balance: str
    axis: str
    unit: str
    centre: FloatArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray
    strength: float


@final
@dataclass(frozen=True)
class Comparison:
    """Model against records.

    Attributes
    ----------
    error : Error
    places : tuple of Place
        The most telling first.
    worst_window : tuple of float
        Start and end of the second with the largest residual [s].
    whiteness : mapping of str to float
        Autocorrelation of each residual one kernel length later.
    """

    name: str
    error: Error
    places: tuple[Place, ...]
    worst_window: tuple[float, float]
    whiteness: dict[str, float]

    def as_json(self) -> dict[str, Any]:
        """Errors and places as data."""
        return {
            "record": self.name, **self.error.as_json(),
            "worst_window_s": list(self.worst_window), "whiteness": self.whiteness,
            "places": [
                {"balance": p.balance, "axis": p.axis, "unit": p.unit, "strength": p.strength, "centre": p.centre.tolist(),
                 "mean": p.mean.tolist(), "low": p.low.tolist(), "high": p.high.tolist()}
                for p in self.places
            ],
        }  # fmt: skip

    def __str__(self) -> str:
        ratios = ", ".join(f"{b} {e.ratio:.3g} times its floor" for b, e in self.error.balances.items())
        top = f"; fails most against {self.places[0].axis.replace('_', ' ')} ({self.places[0].balance} balance)" if self.places else ""
        return f"{self.name}: fit {self.error.fit_percent:.3g} %, relative error {self.error.relative_error_percent:.3g} % ({ratios}){top}"

    def _repr_html_(self) -> str:
        from identification.html import comparison_html

        return comparison_html(self)


def compare(fitted: Fit, records: Record | Sequence[Record]) -> Comparison:
    """Compare a fitted model with records it may never have seen.

    Parameters
    ----------
    fitted : Fit
    records : Record or sequence of Record

    Raises
    ------
    InputError
        Records with other channels than those of the fit.
    """
    given = [records] if isinstance(records, Record) else list(records)
    data = load_dataset(given, [], fitted.joint, fitted.model, kernel=fitted.data.kernel)
    error = assess(fitted.model, data, data.train, fitted.solution.values)
    residual = stack(Balances(fitted.model, data.sensing, wrt=()), data.train, fitted.solution.values).residual
    block = np.concatenate([w.block for w in data.train])
    signals = axes(data.train, data.sensing.has_torque)
    places = [
        place(balance, name, unit, residual[balance], values, block)
        for balance in residual for name, (values, unit) in signals.items()
    ]  # fmt: skip
    places.sort(key=lambda p: -p.strength)
    time = np.concatenate([w.time for w in data.train])
    sigma = {b: max(error.balances[b].floor, 1e-12) for b in residual}
    power = sum((residual[b] / sigma[b]) ** 2 for b in residual)
    worst = _worst(time, np.asarray(power))
    return Comparison(
        ", ".join(r.name for r in given), error, tuple(places), worst,
        {b: _lagged(r) for b, r in residual.items()},
    )  # fmt: skip


def place(balance: str, axis: str, unit: str, residual: FloatArray, values: FloatArray, block: npt.NDArray[np.int64]) -> Place:
    """Binned mean residual with a 95 % band from the scatter between blocks."""
    edges, index = binned(residual, values)
    size = max(len(edges) - 1, 1)
    blocks = int(block.max()) + 1
    inside = block >= 0
    key = block[inside] * size + index[inside]
    count = np.bincount(key, minlength=blocks * size).reshape(blocks, size)
    total = np.bincount(key, weights=residual[inside], minlength=blocks * size).reshape(blocks, size)
    rows = np.maximum(count.sum(axis=0), 1)
    mean = total.sum(axis=0) / rows
    deviation = total - count * mean
    seen = np.maximum((count > 0).sum(axis=0), 1)
    spread = np.sqrt((deviation**2).sum(axis=0) * seen / np.maximum(seen - 1, 1)) / rows
    half = 1.96 * np.maximum(spread, 1e-12)
    centre = (edges[:-1] + edges[1:]) / 2 if len(edges) > 1 else np.zeros(1)
    strength = float(np.max(np.abs(mean) / half * (seen > 3), initial=0.0))
    return Place(balance, axis, unit, centre, mean, mean - half, mean + half, strength)


def _worst(time: FloatArray, power: FloatArray) -> tuple[float, float]:
    if len(time) < 2:
        return float(time[0]), float(time[0])
    step = float(np.median(np.diff(time)))
    width = max(1, min(len(power), round(1.0 / max(step, 1e-9))))
    k = int(np.argmax(np.convolve(power, np.ones(width), "valid")))
    return float(time[k]), float(time[min(k + width, len(time) - 1)])


def _lagged(r: FloatArray, lag: int = 4) -> float:
    x = r - r.mean()
    power = float(x @ x)
    return float(x[:-lag] @ x[lag:] / power) if power > 0 and len(x) > lag else 0.0
