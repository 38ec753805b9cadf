"""Lines: residual that is periodic in an angle, at an order nobody has to name beforehand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balances import Balances
from identification.engine import Dataset, Solution, floors, stack
from identification.weak import WeakRecord

FloatArray = npt.NDArray[np.float64]

PROMINENCE: Final = 20.0
LOWEST_ORDER: Final = 0.25
HIGHEST_ORDER: Final = 14.0
NAMED_ORDERS: Final = (1.0, 2.0, 4.0)


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
    return orders[use], spectrum[use]


def _phase_fit(order: float, angle: FloatArray, residual: FloatArray, weight: FloatArray) -> FloatArray:
    a = np.column_stack([np.sin(order * angle), np.cos(order * angle), np.ones_like(angle)]) * weight[:, None]
    return np.asarray(np.linalg.lstsq(a, residual * weight, rcond=None)[0])


def find_lines(solution: Solution, data: Dataset, short: Dataset, most: int = 4) -> list[Line]:
    """Lines in the residuals of the motor-side balances, confirmed on held-out records.

    Parameters
    ----------
    solution : Solution
    data : Dataset
        For names and floors.
    short : Dataset
        The same records with the shortest kernel: a long one hides fast lines.
    """
    found: list[Line] = []
    balances = Balances(solution.model, data.sensing, wrt=())
    ratio = abs(data.joint.gear_ratio)
    train = stack(balances, short.train, solution.values).residual
    held = stack(balances, short.held_out, solution.values).residual if short.held_out else None
    floor = floors(solution.model, short, solution.values)
    for balance in balances.balances:
        if balance == "link":
            continue
        found += _in_balance(balance, short, train[balance], None if held is None else held[balance], floor[balance], ratio, most)
    found = [line for line in found if not _echo(line, found)]
    return sorted(found, key=lambda x: -x.prominence)[:most]


def _echo(line: Line, lines: Sequence[Line]) -> bool:
    return any(
        o is not line and abs(o.order - line.order) < 2 * line.tolerance and o.prominence > line.prominence for o in lines
    )  # fmt: skip


def _angles(records: Sequence[WeakRecord], ratio: float) -> FloatArray:
    return np.concatenate([w.averaged["motor_position"] * ratio for w in records])


def _in_balance(
    balance: str, data: Dataset, residual: FloatArray, held: FloatArray | None, floor: float, ratio: float, most: int
) -> list[Line]:
    angle = _angles(data.train, ratio)
    stroke = float(np.ptp(angle))
    if stroke < 4 * np.pi:
        return []
    clipped = float(np.quantile(np.abs(residual), 0.98)) + 1e-300
    left = np.clip(residual, -clipped, clipped)
    weight = np.ones_like(left)
    out = []
    for _ in range(most):
        orders, power = scan(angle, left, weight)
        background = float(np.median(power))
        k = int(np.argmax(power))
        if background <= 0 or power[k] < PROMINENCE * background or k in (0, len(power) - 1):
            break
        around = (orders > orders[k] * 0.7) & (orders < orders[k] * 1.4)
        if power[k] < PROMINENCE * float(np.median(power[around])):
            break
        order = _refined(orders, power, k)
        sine, cosine, offset = _phase_fit(order, angle, left, weight)
        drop = 0.0
        if held is not None:
            h = _angles(data.held_out, ratio)
            before = held - held.mean()
            after = held - sine * np.sin(order * h) - cosine * np.cos(order * h)
            after = after - after.mean()
            drop = 100 * (1 - float(np.linalg.norm(after) / max(np.linalg.norm(before), 1e-300)))
            if drop <= 0.2:
                break
        tolerance = 2 * np.pi / stroke
        named = any(abs(order - o) <= 2 * tolerance for o in NAMED_ORDERS)
        names = ("kinematic_error",) if balance in ("transmission", "deflection") and named else ()
        if balance == "motor":
            names = ("torque_ripple",)
        out.append(Line(float(order), tolerance, float(math.hypot(sine, cosine)), balance, float(power[k] / background), names, drop))
        left = left - sine * np.sin(order * angle) - cosine * np.cos(order * angle) - offset
    return out


def _refined(orders: FloatArray, power: FloatArray, k: int) -> float:
    """Peak between the samples of the scan, by a parabola."""
    a, b, c = power[k - 1], power[k], power[k + 1]
    curve = a - 2 * b + c
    shift = 0.5 * (a - c) / curve if curve != 0 else 0.0
    return float(orders[k] + shift * (orders[1] - orders[0]))
