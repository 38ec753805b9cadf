"""Residuals of the balances over several records: stacked rows, their noise floors and their weights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.balances import Balances, balances_of
from identification.dataset import Dataset
from identification.weak import POSITION_CHAINS, Grid, WeakRecord, differentiated_kernel

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

TURN_KERNEL: Final = 0.02
"""Longest kernel of the velocity that still follows a turn with sticking friction [s]."""
TURN_SHARE: Final = 0.25
"""Share of what a kernel is longer than that by which the instant of a turn may be wrong, either way."""


@final
@dataclass(frozen=True)
class Stacked:
    """Residual and Jacobian of several records, balance by balance."""

    residual: Mapping[str, FloatArray]
    jacobian: Mapping[str, FloatArray]
    block: IntArray
    taking: Mapping[str, npt.NDArray[np.bool_]]

    @property
    def shown(self) -> dict[str, FloatArray]:
        """Residuals for pictures: NaN in rows that take no part."""
        return {b: np.where(self.taking[b], r, np.nan) for b, r in self.residual.items()}


def stack(balances: Balances, records: Sequence[WeakRecord], values: Mapping[str, float]) -> Stacked:
    """Evaluate the balances on records one after the other; rows that take no part are zero."""
    parts = [balances.evaluate(w, values) for w in records]
    share = [{b: w.taking(b) for b in balances.balances} for w in records]
    return Stacked(
        {b: np.concatenate([p[b][0] * s[b] for p, s in zip(parts, share, strict=True)]) for b in balances.balances},
        {b: np.concatenate([p[b][1] * s[b][:, None] for p, s in zip(parts, share, strict=True)]) for b in balances.balances},
        np.concatenate([w.block for w in records]),
        {b: taking_part(b, records) for b in balances.balances},
    )


def taking_part(balance: str, records: Sequence[WeakRecord]) -> npt.NDArray[np.bool_]:
    """Which of the stacked rows of a balance take part: neither masked nor at rest."""
    return np.concatenate([w.taking(balance) for w in records])


def floors(model: JointModel, data: Dataset, values: Mapping[str, float]) -> dict[str, float]:
    """RMS that measurement noise alone would leave in each balance of the training records."""
    rows = floor_rows(model, data, values, data.train)
    return {b: rms(level[taking_part(b, data.train)]) for b, level in rows.items()}


def floor_rows(model: JointModel, data: Dataset, values: Mapping[str, float], records: Sequence[WeakRecord]) -> dict[str, FloatArray]:
    """Standard deviation that measurement noise alone gives each row of the balances: that of a record hangs on its sample time."""
    known: dict[tuple[float, float], dict[str, float]] = {}
    keys = [(w.grid.length, float(f"{w.grid.dt:.9g}")) for w in records]
    for key, w in zip(keys, records, strict=True):
        if key not in known:
            known[key] = _floors_of(model, data, values, w.grid)
    return {
        b: np.concatenate([np.full(w.rows, known[key][b]) for key, w in zip(keys, records, strict=True)]) for b in data.sensing.balances
    }  # fmt: skip


def _floors_of(model: JointModel, data: Dataset, values: Mapping[str, float], grid: Grid) -> dict[str, float]:
    balances = balances_of(model, data.sensing, wrt=())
    out = {}
    curved = balances.curved_coefficients(values)
    for balance, entering in balances.coefficients(values, data.train[0]).items():
        bent = curved.get(balance, {})
        variance = 0.0
        for source, chain in POSITION_CHAINS.items():
            if source not in data.noise:
                continue
            weights: list[FloatArray] = [
                entering[n] * differentiated_kernel(grid.length, grid.dt, o) for o, n in enumerate(chain) if n in entering
            ]  # fmt: skip
            weights += [bent[n] * differentiated_kernel(grid.length, grid.dt, o + 2) for o, n in enumerate(chain) if n in bent]
            if not weights:
                continue
            size = max(len(w) for w in weights)
            combined = np.zeros(size)
            for w in weights:
                pad = (size - len(w)) // 2
                combined[pad : size - pad] += w
            variance += data.noise[source] ** 2 * float(np.sum(combined**2))
        out[balance] = math.sqrt(variance)
    return out


def references(data: Dataset, records: Sequence[WeakRecord]) -> dict[str, FloatArray]:
    """The measured torque of each balance, averaged: what the relative error refers to."""
    names = {"link": "torque", "transmission": "torque"}
    return {
        b: np.concatenate([w.averaged[names.get(b, "drive")] for w in records])
        for b in data.sensing.balances
    }  # fmt: skip


def row_weights(
    balances: Balances, data: Dataset, values: Mapping[str, float], sigma: Mapping[str, float] | Mapping[str, FloatArray],
    records: Sequence[WeakRecord],
) -> dict[str, FloatArray]:  # fmt: skip
    """1/sigma of each row: rows that hang on where exactly friction changes its sign count less (`sigma`: of a balance, or of its rows)."""
    names = balances.model.named("smoothing")
    doubled = {**values, **{n: 2 * values[n] for n in names}}
    bare = balances_of(balances.model, data.sensing, wrt=())
    here = stack(bare, records, values).residual
    there = stack(bare, records, doubled).residual if names else here
    either = _either_way(balances.model, data, values, records)
    # a row of which samples were lost averages fewer of them: its variance grows with one over what is left
    support = np.sqrt(np.concatenate([np.ones(w.rows) if w.support is None else w.support for w in records]))
    return {
        b: support / np.sqrt(sigma[b] ** 2 + (here[b] - there[b]) ** 2 / 4 + either[b] ** 2) for b in here
    }  # fmt: skip


def _either_way(model: JointModel, data: Dataset, values: Mapping[str, float], records: Sequence[WeakRecord]) -> dict[str, FloatArray]:
    """Friction torque that may act in either direction, at a standstill or a turn, averaged like a row [N.m]."""
    zero = np.zeros(sum(w.rows for w in records))
    out = dict.fromkeys(data.sensing.balances, zero)
    for place, balances in (("motor", ("motor", "sum", "deflection", "axis")), ("link", ("link", "sum", "axis"))):
        level = sticking_torque(model, values, place)
        source = f"{place}_position"
        if not level or source not in data.noise:
            continue
        lag = model.swinging_inertia(values) * model.load_compliance(values) if model.lagging_load else 0.0
        shares = []
        for w in records:
            either = _either_direction(w.points[f"{place}_velocity"], data.noise[source], w.grid, source).astype(float)
            shares.append(w.average(either))
            if lag:
                shares[-1] = shares[-1] + lag * (np.abs(w.curving) @ either)
        held = level * np.concatenate(shares)
        for b in balances:
            if b in out:
                out[b] = np.hypot(out[b], held)
    return out


def sticking_torque(model: JointModel, values: Mapping[str, float], place: str) -> float:
    """Torque that dry friction of a side may hold at a standstill, in either direction [N.m]."""
    return float(sum(abs(values[n]) for n in model.named("static", place)))


def _either_direction(velocity: FloatArray, noise: float, grid: Grid, source: str) -> npt.NDArray[np.bool_]:
    """Points at which the direction is not known: slower than the noise, or nearer to a turn than its kernel tells when it was."""
    slow = np.abs(velocity) < 3 * noise * grid.velocity_gain(source)
    turns = np.diff(np.sign(velocity), append=velocity[-1]) != 0
    reach = max(0, round(TURN_SHARE * (grid.pointwise[source] - TURN_KERNEL) / (grid.step * grid.dt)))
    near = np.convolve(turns, np.ones(2 * reach), "same") > 0 if reach else np.zeros(len(velocity), dtype=bool)
    return np.asarray(slow | near)


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0
