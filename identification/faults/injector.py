"""Sensor faults put into healthy records: every kind, any sensor, any time, with a name and a
size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.faults.core import SENSORS

FloatArray = npt.NDArray[np.float64]

Kind = Literal["noise", "stuck", "zero", "dropout", "spike", "bias", "gain", "drift", "delay"]
KINDS: Final[tuple[Kind, ...]] = (
    "noise",
    "stuck",
    "zero",
    "dropout",
    "spike",
    "bias",
    "gain",
    "drift",
    "delay",
)
SPIKES: Final = 10.0
"""Spikes in a second, on average: a loose plug, as the thesis's injected faults have them."""
ABRUPT: Final = ("noise", "stuck", "zero", "dropout", "spike", "bias")
"""Kinds that begin at their full size."""


@final
@dataclass(frozen=True)
class Fault:
    """One fault of one sensor.

    Attributes
    ----------
    sensor : str
        One of :data:`identification.faults.detector.SENSORS`.
    kind : str
        ========
        ==========================================================================================
        noise    the reading is replaced by normal noise with this standard deviation (the thesis:
        0.1) stuck    the reading stays at its last value (size unused) zero     the reading is 0
        (size unused) dropout  the reading is NaN (size unused) spike    single wrong samples of
        this height, either sign, ten per second on average bias     this value is added gain
        the reading is multiplied by 1 + size drift    this value per second is added, from the
        start of the fault delay    the reading is late by this time [s] ========
        ==========================================================================================
    start, end : float
        Time of the fault [s]; `end` infinite for a lasting one.
    size : float
        In the unit of the channel (see `kind`).
    """

    sensor: str
    kind: Kind
    start: float
    size: float = 0.0
    end: float = float("inf")

    def __post_init__(self) -> None:
        if self.sensor not in SENSORS:
            raise InputError(
                f"fault: unknown sensor {self.sensor!r}; use one of {', '.join(SENSORS)}"
            )
        if self.kind not in KINDS:
            raise InputError(f"fault: unknown kind {self.kind!r}; use one of {', '.join(KINDS)}")
        if not (math.isfinite(self.start) and math.isfinite(self.size)) or math.isnan(self.end):
            raise InputError(
                f"fault: start {self.start:g} s, size {self.size:g}, end {self.end:g} s; give "
                "finite numbers"
            )
        if self.start < 0:
            raise InputError(f"fault: it starts at {self.start:g} s; give 0 s or later")
        if (self.kind == "noise" and self.size < 0) or (self.kind == "delay" and self.size <= 0):
            raise InputError(
                f"fault: {self.kind} of size {self.size:g}; give a size above 0, "
                f"{'[s]' if self.kind == 'delay' else 'its standard deviation'}"
            )
        if not self.start < self.end:
            raise InputError(
                f"fault: it starts at {self.start} s and ends at {self.end} s; give start < end"
            )


def inject(
    readings: npt.ArrayLike,
    dt: float,
    faults: Sequence[Fault],
    *,
    seed: int = 0,
    time: FloatArray | None = None,
) -> FloatArray:
    """Readings with faults.

    Parameters
    ----------
    readings : (n, 6) array
        Healthy readings in the order of :data:`identification.faults.detector.SENSORS`.
    dt : float
        Usual sample time [s].
    faults : sequence of Fault
        Single, staggered, simultaneous or temporary ones; each acts on the healthy reading, the
        last one wins where two hold the same sensor at the same time.
    seed : int
        Of noise and spikes.
    time : (n,) array, optional
        Stamps [s] of samples that come unevenly, or of which some were lost; the faults' times
        count from the first one.

    Returns
    -------
    array
        A copy, (n, 6).
    """
    healthy = np.asarray(readings, dtype=np.float64)
    if healthy.ndim != 2 or healthy.shape[1] != len(SENSORS):
        raise InputError(f"inject: readings have shape {healthy.shape}; give (n, {len(SENSORS)})")
    out = healthy.copy()
    rng = np.random.default_rng(seed)
    stamps = dt * np.arange(len(out)) if time is None else time - time[0]
    since = np.asarray(stamps, dtype=np.float64)
    for fault in faults:
        first, last = np.searchsorted(since + dt / 2, (fault.start, fault.end), side="right")
        if first < last:
            column = SENSORS.index(fault.sensor)
            out[first:last, column] = _faulty(
                healthy[:, column], slice(int(first), int(last)), fault, since, rng
            )
    return out


def _faulty(
    channel: FloatArray, rows: slice, fault: Fault, time: FloatArray, rng: np.random.Generator
) -> FloatArray | float:
    part, first = channel[rows], rows.start
    if fault.kind == "noise":
        return rng.normal(0.0, fault.size, len(part))
    if fault.kind == "stuck":
        return float(channel[max(first - 1, 0)])
    if fault.kind == "zero":
        return 0.0
    if fault.kind == "dropout":
        return float("nan")
    step = np.diff(time, prepend=2 * time[0] - time[min(1, len(time) - 1)])[rows]
    if fault.kind == "spike":
        hit = rng.random(len(part)) < SPIKES * step
        hit[0] = True
        signs = rng.choice([-1.0, 1.0], len(part))
        spiked: FloatArray = part + np.where(hit, fault.size * signs, 0.0)
        return spiked
    if fault.kind == "delay":
        usual = float(np.median(step))
        then = np.searchsorted(time, time[rows] - fault.size + usual / 2, side="right") - 1
        before = np.arange(rows.start, rows.stop) - 1
        delayed: FloatArray = channel[np.maximum(np.minimum(then, before), 0)]
        return delayed
    changed = {
        "bias": part + fault.size,
        "gain": part * (1.0 + fault.size),
        "drift": part + fault.size * np.cumsum(step),
    }
    found: FloatArray = changed[fault.kind]
    return found
