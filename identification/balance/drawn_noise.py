"""Noise drawn for the channels of a record: what a fitted model makes of it is the floor of
each balance.
"""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.weak import POSITION_CHAINS, WeakRecord, filtered

FloatArray = npt.NDArray[np.float64]

SEED: Final = 20260
"""One seed for all draws: the same records and values give the same floor, and it moves
smoothly with the values.
"""
ROWS: Final = 2000
"""Rows drawn for each floor; four rows to a kernel make some 800 independent ones, so the floor
is known within 3 %.
"""
MOST: Final = 24
"""Records whose draws a thread keeps."""

_kept = threading.local()


@final
@dataclass(frozen=True)
class Draw:
    """A record twice: with smoothed signals, and with drawn noise on top of them.

    Attributes
    ----------
    calm, noisy : WeakRecord
    """

    calm: WeakRecord
    noisy: WeakRecord


def draws_of(record: WeakRecord, noise: Mapping[str, float]) -> tuple[Draw, ...]:
    """Draws of white noise on the channels of a record, kept for the records that asked last.

    Parameters
    ----------
    record : WeakRecord
        Held weakly, known by identity.
    noise : mapping of str to float
        Standard deviation of each measured signal, per sample, in its unit.

    Returns
    -------
    tuple of Draw
        As many as give :data:`ROWS` rows.
    """
    cache: OrderedDict[Hashable, tuple[weakref.ref[WeakRecord], tuple[Draw, ...]]] = (
        _kept.__dict__.setdefault("draws", OrderedDict())
    )
    key = (id(record), tuple(sorted(noise.items())))
    found = cache.get(key)
    if found is not None and found[0]() is record:
        cache.move_to_end(key)
        return found[1]
    rng = np.random.default_rng(SEED)
    made = tuple(_drawn(record, noise, rng) for _ in range(max(1, -(-ROWS // max(record.rows, 1)))))
    cache[key] = (weakref.ref(record), made)
    while len(cache) > MOST:
        cache.popitem(last=False)
    return made


def _drawn(record: WeakRecord, noise: Mapping[str, float], rng: np.random.Generator) -> Draw:
    grid = record.grid
    count = max((s.stop for s in grid.segments), default=0)
    present = [c for c in POSITION_CHAINS if noise.get(c, 0.0) > 0 and c in record.points]
    drawn = {c: noise[c] * rng.standard_normal(count) for c in present}
    averaged, points, smooth, curved = filtered(grid, drawn, curved=bool(record.curved))
    calm = replace(record, points={**record.points, **record.smooth})
    return Draw(
        calm,
        replace(
            record,
            averaged=_plus(record.averaged, averaged),
            points=_plus(calm.points, points),
            smooth=_plus(record.smooth, smooth),
            curved=_plus(record.curved, curved),
        ),
    )


def _plus(
    signals: Mapping[str, FloatArray], noise: Mapping[str, FloatArray]
) -> dict[str, FloatArray]:
    return {n: x + noise[n] if n in noise else x for n, x in signals.items()}


__all__ = ["Draw", "draws_of"]
