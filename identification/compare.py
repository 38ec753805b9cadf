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
from identification.places import Place, gather, places_of
from identification.record import Record

FloatArray = npt.NDArray[np.float64]


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
            "places": [p.as_json() for p in self.places],
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
    places = places_of(residual, gather(data))
    time = np.concatenate([w.time for w in data.train])
    sigma = {b: max(error.balances[b].floor, 1e-12) for b in residual}
    power = sum((residual[b] / sigma[b]) ** 2 for b in residual)
    worst = _worst(time, np.asarray(power))
    return Comparison(
        ", ".join(r.name for r in given), error, places, worst,
        {b: _lagged(r) for b, r in residual.items()},
    )  # fmt: skip


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
