"""Samples of a torque that look wild and are the joint's: where a gap closes, a torque rests at
zero for a sample or two and goes on, and what is alone among its neighbours is no lost bit.

Which it is, the motion tells: a torque without motion is none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from identification.balance.beside import DEVIATION
from identification.balance.slow_noise import rests_of
from identification.balance.weak import WeakRecord, differentiated_kernel

FloatArray = npt.NDArray[np.float64]

TOLD_BY: Final[Mapping[str, tuple[str, ...]]] = {"drive": ("both", "drive"), "torque": ("torque",)}
"""By signal, what is left of it beside what it follows from: the best first."""
SURE: Final = 3.0
"""Standard errors by which the motion must tell that a sample is the joint's."""
ROUNDS: Final = 3
"""Rounds: what is left of the drive beside a torque holds the wild samples of that torque, and a
sample's rows those of the next."""


def restored(
    made: WeakRecord,
    mended: Mapping[str, FloatArray],
    read: Mapping[str, FloatArray],
    late: Mapping[str, float],
    remade: Callable[[Mapping[str, FloatArray]], WeakRecord],
) -> WeakRecord:
    """The record with those samples of its torques as they were read that its motion asks for.

    Parameters
    ----------
    made : WeakRecord
        Made of the mended signals.
    mended, read : mapping of str to (n,) array
        Torques at even steps without their wild samples, and with them; by signal.
    late : mapping of str to float
        Samples that a signal was shifted by in the record.
    remade : callable
        Makes the record with such torques in place of the mended ones.
    """
    signals = dict(mended)
    for _ in range(ROUNDS):
        rests = rests_of(made)
        before = dict(signals)
        for signal, values in before.items():
            key = next((k for k in TOLD_BY.get(signal, ()) if k in rests), None)
            wild = np.flatnonzero(values != read[signal])
            if key is None or not len(wild):
                continue
            size = read[signal][wild] - values[wild]
            at = wild.astype(np.float64) - late.get(signal, 0.0)
            asked = _asked_for(made, rests[key], at, size, len(values))
            if asked.any():
                signals[signal] = values.copy()
                signals[signal][wild[asked]] = read[signal][wild[asked]]
        if all(signals[s] is before[s] for s in signals):
            break
        made = remade(signals)
    return made


def _asked_for(
    made: WeakRecord, rest: FloatArray, at: FloatArray, size: FloatArray, samples: int
) -> npt.NDArray[np.bool_]:
    """Which changes of single samples (`at`, of that size) certainly take some of the rest away:
    sums of squares over their rows, in units of what is left in these.
    """
    scale = DEVIATION * float(np.median(np.abs(rest)))
    weights = differentiated_kernel(made.grid.length, made.grid.dt, 0)
    centres = made.grid.pick(np.arange(samples, dtype=np.float64))
    order = np.argsort(centres)
    reach = len(weights) // 2
    first = np.searchsorted(centres[order], at - reach)
    number = np.searchsorted(centres[order], at + reach, side="right") - first
    out = np.zeros(len(at), dtype=np.bool_)
    if not scale or not number.any():
        return out
    rows = np.minimum(first[:, None] + np.arange(int(number.max())), len(order) - 1)
    near = np.arange(rows.shape[1]) < number[:, None]
    rows = order[rows]
    offset = at[:, None] - centres[rows]
    change = size[:, None] * np.interp(offset, np.arange(-reach, reach + 1), weights) * near
    now, then = (np.sum((x / scale) ** 2 * near, axis=1) for x in (rest[rows], rest[rows] + change))
    # what else is wrong where a gap closes is as large in these rows as what is left of them
    left = 1.0 + np.minimum(now, then) / np.maximum(number, 1)
    return np.asarray(now - then > SURE**2 * left)


__all__ = ["TOLD_BY", "restored"]
