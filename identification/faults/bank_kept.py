"""What healthy records told a fault bank, kept for the next record of the same joint."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from identification import faults, online
from identification.balance import noise
from identification.fitting import window_run
from identification.recursive.compiler import kept

if TYPE_CHECKING:
    from identification.faults.bank import FaultBank, Tuning
    from identification.faults.bank_levels import Piece

_PACKAGES, _MODULES = (faults, online), (noise, window_run)
"""Code that levels and limits follow from; the equations go by what they are made into."""


def calibrated(bank: FaultBank, healthy: Sequence[Piece]) -> Tuning:
    """Levels and limits of a bank (:meth:`identification.faults.bank.FaultBank.calibrate`), from
    the user's cache where the same healthy records gave them to the same bank before.
    """
    from identification.faults.bank import Tuning
    from identification.online.filter import Levels

    def make() -> bytes:
        made = bank.calibrate(healthy)
        numbers = {"levels": dataclasses.asdict(made.levels), "limits": made.limits.tolist()}
        return json.dumps(numbers).encode()

    found = json.loads(kept("bank", [*identity(bank), *_numbers(healthy)], make))
    levels: dict[str, Any] = {
        n: tuple(v) if isinstance(v, list) else v for n, v in found["levels"].items()
    }
    bank.tuning = Tuning(Levels(**levels), np.array(found["limits"]))
    return bank.tuning


def smallest(bank: FaultBank, healthy: Piece) -> dict[str, tuple[float, float]]:
    """Offsets that a calibrated bank sees and names
    (:meth:`identification.faults.bank.FaultBank.smallest`), from the cache where they are there.
    """
    tuning = bank.tuned
    own = [*identity(bank), repr(tuning.levels).encode(), tuning.limits.tobytes()]

    def make() -> bytes:
        return json.dumps(bank.smallest(healthy)).encode()

    found = json.loads(kept("offsets", [*own, *_numbers([healthy])], make))
    return {name: (seen, told) for name, (seen, told) in found.items()}


def identity(bank: FaultBank) -> list[bytes]:
    """All that the levels and limits of a bank follow from beside the healthy readings: its
    equations and values, its sensors, and the code that works with them.
    """
    told: list[Any] = [bank.dt, bank.measured, bank.late, bank.joint.size]
    out = [metadata.version(n).encode() for n in ("numpy", "casadi")]
    files = [Path(m.__file__) for m in _MODULES if m.__file__]
    files += [f for p in _PACKAGES for f in sorted(Path(p.__path__[0]).glob("*.py"))]
    out += [f.read_bytes() for f in files]
    for one in (bank.joint, bank.known):
        out += [one.predict.serialize().encode(), one.update.serialize().encode()]
        told += [list(one.values.items()), one.logarithmic, one.substeps]
        out += [np.ascontiguousarray(a).tobytes() for a in (one.dry, one.slow, one.doubtful)]
    return [*out, repr(told).encode()]


def _numbers(pieces: Sequence[Piece]) -> list[bytes]:
    """Healthy readings as their hash."""
    digest = hashlib.sha256()
    for piece in pieces:
        for part in (piece.time, piece.rows):
            digest.update(repr(part.shape).encode())
            digest.update(np.ascontiguousarray(part).tobytes())
    return [digest.digest()]
