"""What the online estimator made of a record: what the report of a replay shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.data.formats import words
from identification.data.record import Record
from identification.faults.detector import Fault, FaultEvent
from identification.faults.types import Verdict
from identification.fitting.assess import RATIO_LIMIT
from identification.online.estimator import OnlineEstimator

FloatArray = npt.NDArray[np.float64]

AFTERMATH: Final = 2.0
"""Seconds after a failure in which the look at the last second of readings still sees it."""

UNESTIMATED: Final = (
    "the parameters were not estimated: the first window needs some seconds in "
    "which every reading is good"
)

UNFITTED: Final = (
    "sensor faults were not looked for: that needs an elastic joint file with fitted values "
    "(`irj fit -o`)"
)
UNMEASURED: Final = (
    "sensor faults were not looked for with the model: the velocities are derived, and their noise "
    "looks like a failure until records of the healthy joint are given with --healthy, each run a "
    "file of its own"
)

READINGS: Final = (
    "motor current",
    "motor position",
    "motor velocity",
    "link position",
    "link velocity",
    "torque",
)


def standing(verdicts: Sequence[tuple[float, FaultEvent]], *, watched: bool = True) -> str:
    """What of the detector's verdicts holds at the end, as one sentence: a verdict about readings
    that agree again is withdrawn.

    Parameters
    ----------
    verdicts : sequence of (time [s], FaultEvent)
        In the order in which they were said.
    watched : bool
        Whether faults were looked for.
    """
    if not watched:
        return "Sensor faults were not looked for."
    held: dict[tuple[str, ...], tuple[float, FaultEvent]] = {}
    withdrawn: list[tuple[str, float, float]] = []
    for time, event in verdicts:
        if event.verdict is Verdict.ARMED:
            continue
        if event.verdict is not Verdict.RECOVERED:
            held.setdefault(event.sensors, (time, event))
            continue
        back = set(event.sensors)
        for sensors in [s for s in held if back & set(s)]:
            began, before = held.pop(sensors)
            withdrawn.append((_named(before), began, time))
            if left := tuple(n for n in sensors if n not in back):
                held[left] = (began, replace(before, sensors=left))
    taken = "; ".join(
        f"{name}, said at {a:.4g} s, withdrawn at {b:.4g} s" for name, a, b in withdrawn
    )
    if not held:
        return f"No reading is doubted any more: {taken}." if taken else "No reading was doubted."
    told = " ".join(f"{_named(e)} at {t:.4g} s: {_inside(e.verdict)}" for t, e in held.values())
    return f"{told[0].upper()}{told[1:]}" + (f" Withdrawn: {taken}." if taken else "")


def _inside(verdict: Verdict) -> str:
    """The words of a verdict as they stand after a colon."""
    return f"{verdict.value[0].lower()}{verdict.value[1:]}"


def _named(event: FaultEvent) -> str:
    return " or ".join(words(n) for n in event.sensors) or "the readings"


@final
@dataclass(frozen=True)
class Replay:
    """What the online estimator made of one record.

    Attributes
    ----------
    record : Record
        At even steps.
    estimator : OnlineEstimator
        After the last sample.
    time, values, sigmas, ratios
        Course of the estimate at some hundred points: (m,) [s], (m, parameters) twice, (m,
        balances).
    looks : (k,) int array
        Samples at which the course is looked at, those of the warm-up too.
    scores : (k, 6) array
        Largest residual of each reading since the look before, as a share of its limit.
    events : tuple of dict
        ``time``, ``fault``, ``text``.
    verdicts : tuple of (time, FaultEvent)
        What the fault detector said, and when [s].
    healthy, readings, used : (n, 6) array
        As recorded; with the faults tried on purpose, NaN where there is none; with failed ones
        replaced. Link-referred SI.
    failed : (n, 6) bool array
        Where a reading is replaced.
    tried : tuple of Fault
    calibrated : bool
        The detector's limits come from healthy records.
    banked : bool
        A fault bank has looked at the readings, not the estimator's own detector.
    smallest : mapping of str to pair of float
        Smallest offset of each sensor that the bank sees, and that it names.
    """

    record: Record
    estimator: OnlineEstimator
    time: FloatArray
    values: FloatArray
    sigmas: FloatArray
    ratios: FloatArray
    looks: npt.NDArray[np.int64]
    scores: FloatArray
    events: tuple[dict[str, Any], ...]
    verdicts: tuple[tuple[float, FaultEvent], ...]
    healthy: FloatArray
    readings: FloatArray
    used: FloatArray
    failed: npt.NDArray[np.bool_]
    tried: tuple[Fault, ...] = ()
    calibrated: bool = False
    banked: bool = False
    smallest: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def watched(self) -> bool:
        """Whether sensor faults were looked for."""
        return self.banked or self.estimator.detector is not None

    @property
    def not_watched(self) -> str:
        """Why sensor faults were not looked for; nothing where they were."""
        if self.watched:
            return ""
        estimator = self.estimator
        fitted = estimator.is_fitted and estimator.model.is_elastic
        return UNMEASURED if fitted and not estimator.options.detect else UNFITTED

    @property
    def doubt(self) -> str:
        """What speaks against the verdicts: a model that did not explain the readings before the
        first of them; nothing where it did, or where nothing was said.
        """
        if not self.events:
            return ""
        before = self.ratios[self.time < float(self.events[0]["time"])]
        stood = np.median(before, axis=0) if len(before) else np.zeros(0)
        over = [
            f"{balance} at {ratio:.3g}"
            for balance, ratio in zip(self.estimator.balances, stood.tolist(), strict=False)
            if ratio > RATIO_LIMIT
        ]
        if not over:
            return ""
        return (
            f"the model did not explain the readings before ({', '.join(over)} times the noise), "
            "so that a verdict may be what it lacks: run irj improve first"
        )

    def spans(self, reading: int | None = None) -> list[tuple[float, float]]:
        """Times [s] from which to which a reading is replaced; any reading where none is named."""
        failed = self.failed.any(axis=1) if reading is None else self.failed[:, reading]
        edges = np.flatnonzero(np.diff(failed.astype(np.int8), prepend=0, append=0))
        time = self.record.time
        return [
            (float(time[a]), float(time[min(b, len(time) - 1)]))
            for a, b in edges.reshape(-1, 2).tolist()
        ]

    def as_json(self) -> dict[str, Any]:
        """Data of `track --json`."""
        estimator = self.estimator
        units = {p.name: p for p in estimator.model.parameters}
        return {
            "record": self.record.name,
            "time": self.time.tolist(),
            "detector": self.watched,
            "not_watched": self.not_watched,
            "doubt": self.doubt,
            "calibrated": self.calibrated,
            "smallest": {
                name: {"seen": a, "named": b if np.isfinite(b) else None}
                for name, (a, b) in self.smallest.items()
            },
            "events": list(self.events),
            "replaced": [
                {"reading": name, "from": a, "to": b}
                for i, name in enumerate(READINGS)
                for a, b in self.spans(i)
            ],
            "ratio": dict(zip(estimator.balances, self.ratios[-1].tolist(), strict=True))
            if len(self.time)
            else {},
            "parameters": {
                name: {
                    "value": float(self.values[-1, i]),
                    "sigma": float(self.sigmas[-1, i]),
                    "unit": units[name].unit,
                    "side": units[name].side,
                    "history": self.values[:, i].tolist(),
                    "sigma_history": self.sigmas[:, i].tolist(),
                }
                for i, name in enumerate(estimator.names)
                if len(self.time)
            },
        }
