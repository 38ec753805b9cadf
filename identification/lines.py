"""Lines: residual that is periodic in an angle, at an order nobody has to name beforehand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS
from identification.balances import balances_of
from identification.engine import Dataset, Solution, floors, row_weights, stack
from identification.weak import WeakRecord

FloatArray = npt.NDArray[np.float64]

PROMINENCE: Final = 100.0
TORSION_PROMINENCE: Final = 20.0
"""Peak over the median of the scan. In the balances with the motor's acceleration bursts and a stiff mode stand up to 81 times
over it, lines that are worth 2 to 5 % of the residual 125 and more; the transmission balance has no such rest."""
HELD_OUT_DROP: Final = 0.2
LOWEST_ORDER: Final = 0.25
HIGHEST_ORDER: Final = 14.0
BANDS: Final = tuple(np.geomspace(LOWEST_ORDER, HIGHEST_ORDER, 9))
PASS: Final = 0.8
"""Share of 1/kernel up to which a line counts (the kernel's -3 dB point is 0.93)."""

SECTORS: Final = 8
"""Equal shares of the rows, along the stroke, in which a line is looked for once more."""
EVEN: Final = 0.7
"""Least amplitude in the middle one of the sectors, over that in the whole stroke: near 1 for a line, near 0 for a burst in one place."""
NAMED_ORDERS: Final = (1.0, 2.0, 4.0)
NAMED_WITHIN: Final = 0.5
"""Distance to such an order in units of 2 pi / stroke: orders of lines are found to a tenth of it."""


@final
@dataclass(frozen=True)
class Line:
    """A line in the residual of a balance.

    Attributes
    ----------
    order : float
        Periods per turn of the motor (or per metre).
    tolerance : float
        2 pi / stroke.
    amplitude : float
        Of the residual [N.m].
    balance : str
    prominence : float
        Power over the median of the scan.
    effects : tuple of str
        Names where the balances tell; empty for a line at an order the library has no name for.
    """

    order: float
    tolerance: float
    amplitude: float
    balance: str
    prominence: float
    effects: tuple[str, ...]
    held_out_drop_percent: float
    per: str = "motor turn"
    unit: str = "N.m"

    def as_json(self) -> dict[str, Any]:
        """The shape of `improve --json`."""
        return {
            "order": self.order, "per": self.per, "tolerance": self.tolerance, "amplitude": self.amplitude,
            "unit": self.unit, "effects": list(self.effects), "balance": self.balance,
        }  # fmt: skip


def scan(angle: FloatArray, residual: FloatArray, weight: FloatArray, highest: float = HIGHEST_ORDER) -> tuple[FloatArray, FloatArray]:
    """Power of exp(i h angle) in a residual over orders h.

    Parameters
    ----------
    angle : (n,) array [rad]
    residual, weight : (n,) array
        Residual and 1/sigma of each row.

    Returns
    -------
    orders, power : (m,) arrays
        Orders are finer than 2 pi / stroke.
    """
    width = 2 * np.pi / highest / 8
    low = float(angle.min())
    bins = ((angle - low) / width).astype(np.int64)
    size = int(bins.max()) + 1
    w2 = weight**2
    r = residual - np.average(residual, weights=w2)
    summed = np.bincount(bins, weights=r * w2, minlength=size)
    length = 1 << int(math.ceil(math.log2(max(size, 2) * 4)))
    spectrum = np.abs(np.fft.rfft(summed, length)) ** 2
    orders = np.arange(len(spectrum)) * 2 * np.pi / (length * width)
    use = (orders >= LOWEST_ORDER) & (orders <= highest)
    return np.asarray(orders[use]), np.asarray(spectrum[use], dtype=np.float64)


def _phase_fit(order: float, angle: FloatArray, residual: FloatArray, weight: FloatArray) -> FloatArray:
    a = np.column_stack([np.sin(order * angle), np.cos(order * angle), np.ones_like(angle)]) * weight[:, None]
    return np.asarray(np.linalg.lstsq(a, residual * weight, rcond=None)[0])


def find_lines(solution: Solution, kernels: Sequence[Dataset], most: int = 4) -> list[Line]:
    """Lines in the residuals of the motor-side balances, confirmed on held-out records.

    Parameters
    ----------
    solution : Solution
    kernels : sequence of Dataset
        The same records with several kernels: a long one hides fast lines, a short one lets the
        noise of the acceleration cover slow ones.
    most : int
        Lines per balance.

    Returns
    -------
    list of Line
        The most prominent first; a line seen with several kernels once.
    """
    found: list[Line] = []
    for data in kernels:
        balances = balances_of(solution.model, data.sensing, wrt=())
        train = stack(balances, data.train, solution.values)
        held = stack(balances, data.held_out, solution.values) if data.held_out else None
        floor = floors(solution.model, data, solution.values)
        sigma = {b: max(floor[b], 1e-12) for b in floor}
        weights = row_weights(balances, data, solution.values, sigma, data.train)
        held_weights = row_weights(balances, data, solution.values, sigma, data.held_out) if data.held_out else {}
        for balance in balances.balances:
            if balance == "link":
                continue
            use = train.taking[balance]
            seen = held.taking[balance] if held is not None else np.zeros(0, dtype=np.bool_)
            rows = _Rows(
                _angles(data.train, data)[use], _angles(data.train, data, "motor_velocity")[use], data.kernel,
                train.residual[balance][use], weights[balance][use],
                _angles(data.held_out, data)[seen] if held is not None else None,
                _angles(data.held_out, data, "motor_velocity")[seen] if held is not None else None,
                None if held is None else held.residual[balance][seen], held_weights[balance][seen] if held is not None else None,
            )  # fmt: skip
            found += _in_balance(balance, rows, most)
    found = [line for line in found if not _echo(line, found)]
    return sorted(found, key=lambda x: -x.prominence)[:most]


def _echo(line: Line, lines: Sequence[Line]) -> bool:
    return any(
        o is not line and abs(o.order - line.order) < 2 * line.tolerance and o.prominence > line.prominence for o in lines
    )  # fmt: skip


@final
@dataclass(frozen=True)
class _Rows:
    """Rows of one balance: motor angle, residual, 1/sigma, for training and held-out records."""

    angle: FloatArray
    speed: FloatArray
    kernel: float
    residual: FloatArray
    weight: FloatArray
    held_angle: FloatArray | None
    held_speed: FloatArray | None
    held_residual: FloatArray | None
    held_weight: FloatArray | None


def _angles(records: Sequence[WeakRecord], data: Dataset, name: str = "motor_position") -> FloatArray:
    ratio = abs(data.joint.gear_ratio)
    return np.concatenate([w.averaged[name] * ratio for w in records])


def _banded_scan(rows: _Rows, left: FloatArray) -> list[tuple[float, float, FloatArray]]:
    """Peak of each band of orders: (order, power over the median of its band, weight used).

    In each band only the rows count whose speed lets the kernel pass the line, and once all rows do.
    """
    out = []
    for (low, high), gated in itertools.product(zip(BANDS[:-1], BANDS[1:], strict=True), (True, False)):
        passes = np.abs(rows.speed) * high * rows.kernel < 2 * np.pi * PASS
        if int(passes.sum()) < 200:
            continue
        weight = rows.weight * passes if gated else rows.weight
        orders, power = scan(rows.angle, left, weight, high)
        here = orders >= low
        orders, power = orders[here], power[here]
        k = int(np.argmax(power))
        background = float(np.median(power))
        if k in (0, len(power) - 1) or background <= 0:
            continue
        out.append((_refined(orders, power, k), float(power[k] / background), weight))
    return out


def _in_balance(balance: str, rows: _Rows, most: int) -> list[Line]:
    angle = rows.angle
    stroke = float(np.ptp(angle))
    if stroke < 4 * np.pi:
        return []
    left = np.clip(rows.residual * rows.weight, -4 * _spread(rows), 4 * _spread(rows)) / rows.weight
    out = []
    for _ in range(most):
        peaks = _banded_scan(rows, left)
        if not peaks:
            break
        order, prominence, weight = max(peaks, key=lambda x: x[1])
        if prominence < (TORSION_PROMINENCE if balance == "transmission" else PROMINENCE):
            break
        sine, cosine, offset = _phase_fit(order, angle, left, weight)
        drop = _held_out_drop(rows, order, sine, cosine)
        if drop is not None and drop <= HELD_OUT_DROP:
            break
        tolerance = 2 * np.pi / stroke
        named = any(abs(order - o) <= NAMED_WITHIN * tolerance for o in NAMED_ORDERS)
        names = EFFECTS.periodic_in("torsion") if balance in ("transmission", "deflection") and named else ()
        if balance == "motor":
            names = EFFECTS.periodic_in("motor")
        size = float(math.hypot(sine, cosine))
        if _evenness(order, angle, left, weight) >= EVEN:
            out.append(Line(float(order), tolerance, size, balance, prominence, names, drop or 0.0))
        left = left - sine * np.sin(order * angle) - cosine * np.cos(order * angle) - offset
    return out


def _evenness(order: float, angle: FloatArray, residual: FloatArray, weight: FloatArray) -> float:
    """Amplitude in phase with a line in the middle one of the sectors of the stroke: 1 for a line, 0 for a burst in one place."""
    sine, cosine, _ = _phase_fit(order, angle, residual, weight)
    edges = np.quantile(angle[weight > 0], np.linspace(0, 1, SECTORS + 1))
    sector = np.clip(np.searchsorted(edges, angle, side="right") - 1, 0, SECTORS - 1)
    local = [_phase_fit(order, angle[sector == k], residual[sector == k], weight[sector == k])[:2] @ (sine, cosine) for k in range(SECTORS)]
    return float(np.median(local)) / max(float(sine**2 + cosine**2), 1e-300)


def _spread(rows: _Rows) -> float:
    """Robust spread of the weighted residual."""
    return float(np.median(np.abs(rows.residual * rows.weight))) * 1.4826 + 1e-300


def _held_out_drop(rows: _Rows, order: float, sine: float, cosine: float) -> float | None:
    """Fall of the weighted RMS on held-out records by the line with its phase from training, in percent."""
    if rows.held_angle is None or rows.held_speed is None or rows.held_residual is None or rows.held_weight is None:
        return None
    line = sine * np.sin(order * rows.held_angle) + cosine * np.cos(order * rows.held_angle)
    passes = np.abs(rows.held_speed) * order * rows.kernel < 2 * np.pi * PASS
    before = float(np.linalg.norm(rows.held_residual[passes] * rows.held_weight[passes]))
    after = float(np.linalg.norm((rows.held_residual - line)[passes] * rows.held_weight[passes]))
    return 100 * (1 - after / max(before, 1e-300))


def _refined(orders: FloatArray, power: FloatArray, k: int) -> float:
    """Peak between the samples of the scan, by a parabola."""
    a, b, c = power[k - 1], power[k], power[k + 1]
    curve = a - 2 * b + c
    shift = 0.5 * (a - c) / curve if curve != 0 else 0.0
    return float(orders[k] + shift * (orders[1] - orders[0]))
