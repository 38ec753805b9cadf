"""Data for plots: places before and after, overlays of measured and modelled torque, min-max
decimation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.balances import balances_of
from identification.balance.kinematic import residual_unit
from identification.balance.weak import WeakRecord
from identification.data.record import Record
from identification.diagnosis.improve import Improvement
from identification.diagnosis.places import (
    Place,
    Rows,
    gather,
    place,
    places_of,
    residuals,
    running_time,
    worst_window,
)
from identification.errors import InputError
from identification.fitting.engine import Dataset, Solution, references, stack
from identification.linear.ceiling import Ceiling, ceiling
from identification.linear.frequency import Bode, bode_of

FloatArray = npt.NDArray[np.float64]

POINTS: Final = 2400
"""Points of one plotted curve at most."""
NUMBERS: Final = 100_000
"""Numbers in all overlays of a report at most."""
WINDOW_KERNELS: Final = 40.0
"""Length of the worst window in kernels."""
DIGITS: Final = 5


def min_max(
    count: int, curves: Sequence[FloatArray], points: int = POINTS
) -> npt.NDArray[np.int64] | None:
    """Rows of every curve that keep its extremes when it is drawn in fewer points.

    Parameters
    ----------
    count : int
        Rows of each curve.
    curves : sequence of (count,) array
    points : int
        Wanted at most; two a bucket.

    Returns
    -------
    (curves, 2 buckets) int array, or None
        For each curve the rows of minimum and maximum of each bucket, in time order; None where all
        rows fit.
    """
    if count <= points:
        return None
    buckets = max(points // 2, 1)
    edges = np.linspace(0, count, buckets + 1).astype(np.int64)
    out = np.empty((len(curves), 2 * buckets), dtype=np.int64)
    for i, y in enumerate(curves):
        for k in range(buckets):
            part = y[edges[k] : edges[k + 1]]
            a, b = (
                int(np.argmin(np.where(np.isnan(part), np.inf, part))),
                int(np.argmax(np.where(np.isnan(part), -np.inf, part))),
            )
            out[i, 2 * k], out[i, 2 * k + 1] = edges[k] + min(a, b), edges[k] + max(a, b)
    return out


def decimated(
    time: FloatArray, curves: Sequence[FloatArray], points: int = POINTS
) -> tuple[FloatArray, list[FloatArray]]:
    """Curves on one common time axis with their extremes kept (see :func:`min_max`).

    Returns
    -------
    time, curves
        The same objects where all rows fit.
    """
    kept = min_max(len(time), curves, points)
    if kept is None:
        return time, list(curves)
    buckets = kept.shape[1] // 2
    edges = np.linspace(0, len(time), buckets + 1).astype(np.int64)
    common = np.empty(2 * buckets, dtype=np.int64)
    common[0::2] = edges[:-1]
    common[1::2] = (edges[:-1] + edges[1:]) // 2
    return time[common], [np.asarray(y[rows]) for y, rows in zip(curves, kept, strict=True)]


@final
@dataclass(frozen=True)
class Overlay:
    """Measured and modelled torque of one balance on one record, averaged with the kernel.

    Attributes
    ----------
    balance, record, unit : str
    time, measured, start, final : (rows,) array
        Seconds, runs laid end to end; torque; what the start model and the final model give. NaN in
        rows at rest and where a new stretch begins: curves break there.
    window : tuple of float
        Where the start model is worst [s].
    """

    balance: str
    record: str
    unit: str
    time: FloatArray
    measured: FloatArray
    start: FloatArray
    final: FloatArray
    window: tuple[float, float]

    @property
    def added(self) -> bool:
        """Whether start and final model differ."""
        return not np.array_equal(self.start, self.final, equal_nan=True)

    @property
    def broken_percent(self) -> float:
        """Share of the rows in which the curves break."""
        return 100 * float(np.mean(np.isnan(self.measured)))

    @property
    def quantity(self) -> str:
        """What is measured: a force of a linear axis, else a torque."""
        return "force" if self.unit == "N" else "torque"

    def as_json(self, points: int = POINTS) -> dict[str, Any]:
        """For the plotting script: an overview with kept extremes, and the worst window in full."""
        whole = [
            self.measured,
            self.start,
            self.final,
            self.measured - self.start,
            self.measured - self.final,
        ]
        time, curves = decimated(self.time, whole, points)
        out: dict[str, Any] = {
            "balance": self.balance,
            "record": self.record,
            "quantity": self.quantity,
            "unit": self.unit,
            "rows": len(self.time),
            "shown": len(time),
            "window": [_short(v) for v in self.window],
            "data": [_rounded(time), *(_rounded(c) for c in curves)],
        }
        if len(time) < len(self.time):
            inside = np.flatnonzero((self.time >= self.window[0]) & (self.time <= self.window[1]))
            t, c = decimated(self.time[inside], [v[inside] for v in whole], points)
            out["detail"] = [_rounded(t), *(_rounded(v) for v in c)]
        return out


def _short(value: float) -> float:
    return float(f"{value:.6g}")


def _rounded(values: FloatArray) -> list[float | None]:
    """Rounded to a part of the range that no screen shows: short in the file; None where there
    is no value.
    """
    size = float(np.max(np.abs(values[np.isfinite(values)]), initial=0.0))
    places = DIGITS - 1 - int(np.floor(np.log10(size))) if size else 0
    short = (
        np.round(values, max(places, 0)).tolist()
        if places < 12
        else [float(f"{v:.5g}") for v in values]
    )
    return [v if math.isfinite(v) else None for v in short]


def overlays(
    data: Dataset,
    records: Sequence[WeakRecord],
    names: Sequence[str],
    start: Mapping[str, FloatArray],
    final: Mapping[str, FloatArray],
) -> list[Overlay]:
    """One overlay per balance and record, the worst first.

    Parameters
    ----------
    data : Dataset
    records : sequence of WeakRecord
    names : sequence of str
        Of the records.
    start, final : mapping of str to (rows,) array
        Residuals of the two models on all the records.
    """
    measured = references(data, records)
    out: list[tuple[float, Overlay]] = []
    first = 0
    for w, name in zip(records, names, strict=True):
        rows = slice(first, first + w.rows)
        first += w.rows
        for balance, residual in start.items():
            if not w.taking(balance).any():
                continue
            drawn = np.where(w.taking(balance) & ~w.begins, 0.0, np.nan)
            m, before, after = measured[balance][rows] + drawn, residual[rows], final[balance][rows]
            time = running_time([w])
            window = worst_window(time, before**2, WINDOW_KERNELS * data.kernel)
            size = float(np.sqrt(np.nanmean(before**2)))
            out.append(
                (
                    size,
                    Overlay(
                        balance,
                        name,
                        unit=residual_unit(balance, data.joint.kind),
                        time=time,
                        measured=m,
                        start=m - before,
                        final=m - after,
                        window=window,
                    ),
                )
            )
    return [o for _, o in sorted(out, key=lambda p: -p[0])]


@final
@dataclass(frozen=True)
class StepPlace:
    """Residual before and after one addition, in the place where the addition shows most."""

    effect: str
    before: Place
    after: Place


@final
@dataclass(frozen=True)
class ReportPlots:
    """Everything a report draws.

    Attributes
    ----------
    places : tuple of (Place, Place or None)
        Start model and final model (None where nothing was added), the most telling first.
    additions : tuple of StepPlace
    overlays : tuple of Overlay
    on_held_out : bool
        False where there are no held-out rows: the plots show training records.
    ceiling : Ceiling or None
        What linear models without physics explain of the same rows, beside the final model.
    bode : Bode or None
        Frequency responses; None where the records excite too little or were not handed over.
    """

    places: tuple[tuple[Place, Place | None], ...]
    additions: tuple[StepPlace, ...]
    overlays: tuple[Overlay, ...]
    on_held_out: bool
    ceiling: Ceiling | None = None
    bode: Bode | None = None


def report_plots(improvement: Improvement, raw: Sequence[Record] = ()) -> ReportPlots | None:
    """Evaluate every step of an improvement on its held-out records; None where nothing was fitted.

    Parameters
    ----------
    improvement : Improvement
    raw : sequence of Record
        The records at full rate, for the frequency response.
    """
    if not improvement.steps:
        return None
    data = improvement.data
    held = bool(data.held_out)
    records = data.held_out or data.train
    names = (data.held_out_names if held else data.train_names) or tuple(
        str(i) for i in range(len(records))
    )
    rows = gather(data, records)
    each = [residuals(s.solution, data, records) for s in improvement.steps]
    start, final = each[0], each[-1]
    pairs = [
        (p, place(rows, final[p.balance], p.balance, p.axis, like=p) if len(each) > 1 else None)
        for p in places_of(start, rows)
    ]
    additions = []
    for i, claim in enumerate(improvement.claims[: len(each) - 1]):
        additions.append(
            step_place(
                rows,
                improvement.steps[i + 1].added or claim.effects[0],
                claim.balance,
                each[i],
                each[i + 1],
            )
        )
    last = improvement.steps[-1]
    floor = {b: e.floor for b, e in last.held_out.balances.items()}
    every = stack(
        balances_of(last.solution.model, data.sensing, wrt=()), records, last.solution.values
    ).residual  # rows at rest too: a black box explains all rows
    above = ceiling(data, records, every, floor, unseen=held)
    response = None
    with suppress(InputError):
        response = bode_of(last.solution.model, data, raw)
    return ReportPlots(
        tuple(pairs),
        tuple(additions),
        tuple(overlays(data, records, names, start, final)),
        held,
        above,
        response,
    )


def step_place(
    rows: Rows,
    effect: str,
    balance: str,
    before: Mapping[str, FloatArray],
    after: Mapping[str, FloatArray],
) -> StepPlace:
    """The axis on which a balance's residual before an addition is most telling, with the
    residual after it.
    """
    best = places_of({balance: before[balance]}, rows)[0]
    return StepPlace(effect, best, place(rows, after[balance], balance, best.axis, like=best))


def explained(before: Place, after: Place) -> Place | None:
    """What an addition takes off the residual, bin by bin; None where the bins differ."""
    if any(
        len(b.centre) != len(a.centre) for b, a in zip(before.branches, after.branches, strict=True)
    ):
        return None
    branches = tuple(
        replace(b, mean=b.mean - a.mean)
        for b, a in zip(before.branches, after.branches, strict=True)
    )
    return replace(before, branches=branches)


def overlay_json(shown: Sequence[Overlay]) -> list[dict[str, Any]]:
    """Overlays for the plotting script, small enough together."""
    points = min(POINTS, max(200, NUMBERS // (6 * max(len(shown), 1))))
    return [o.as_json(points) for o in shown]


def solution_places(solution: Solution, data: Dataset) -> tuple[Place, ...]:
    """Places of one fitted model (for the app)."""
    rows = gather(data)
    return places_of(residuals(solution, data), rows)
