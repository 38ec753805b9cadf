"""Checks of what the caller of `mcs` gave, and its conversion to what the search works with."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.search.numeric import Vector
from identification.search.types import MCSOptions

_NARROWEST = 1e-9
"""Smallest width of a box as a fraction of its bounds: below, differences drown in rounding."""

_TINY = 1e-100
"""Smallest width of a box: below, products of widths underflow."""


@final
@dataclass(frozen=True)
class Problem:
    """A checked problem; lists have one entry per coordinate."""

    low: Vector
    high: Vector
    lists: list[Vector]
    start: list[int]
    pattern: list[list[bool]]
    levels: int
    local_steps: int
    restarts: int
    precision: float


def whole_number(name: str, value: object, least: int) -> int:
    """Return `value` as an int that is at least `least`."""
    try:
        number = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise InputError(
            f"mcs: {name} is {value!r}; give a whole number, at least {least}"
        ) from None
    if number < least:
        raise InputError(f"mcs: {name} is {number}; it must be at least {least}")
    return number


def real_number(name: str, value: object) -> float:
    """Return `value` as a float that is not nan."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InputError(f"mcs: {name} is {value!r}; give a number") from None
    if math.isnan(number):
        raise InputError(f"mcs: {name} is nan; give a number")
    return number


def make_problem(bounds: Any, options: MCSOptions) -> Problem:
    """Check bounds and options together."""
    low, high = _bounds(bounds)
    n = len(low)
    lists, start = _lists(options.start, low, high)
    levels = (
        5 * n + 10
        if options.levels is None
        else whole_number("options.levels", options.levels, n + 3)
    )
    precision = real_number("options.precision", options.precision)
    if not 0.0 <= precision < 1.0:
        raise InputError(
            f"mcs: options.precision is {precision}; it must be at least 0 and below 1"
        )
    return Problem(
        low=low,
        high=high,
        lists=lists,
        start=start,
        pattern=_pattern(options.hessian_pattern, n),
        levels=levels,
        local_steps=whole_number("options.local_steps", options.local_steps, 0),
        restarts=whole_number("options.restarts", options.restarts, 0),
        precision=precision,
    )


def _bounds(bounds: Any) -> tuple[Vector, Vector]:
    """Read ``(low, high)`` pairs or an object with `lb` and `ub`."""
    try:
        if hasattr(bounds, "lb") and hasattr(bounds, "ub"):
            low, high = np.broadcast_arrays(
                np.atleast_1d(np.asarray(bounds.lb, float)), np.asarray(bounds.ub, float)
            )
            pairs = np.column_stack([low.ravel(), high.ravel()])
        else:
            pairs = np.asarray(bounds, dtype=float)
    except (TypeError, ValueError):
        raise InputError(
            "mcs: bounds cannot be read; give one (low, high) pair of numbers per coordinate"
        ) from None
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.shape[0] == 0:
        raise InputError(
            f"mcs: bounds have shape {pairs.shape}; give one (low, high) pair per coordinate"
        )
    for i, (lo, hi) in enumerate(pairs.tolist()):
        if not (math.isfinite(lo) and math.isfinite(hi)):
            raise InputError(
                f"mcs: bounds of coordinate {i} are ({lo}, {hi}); the search needs finite "
                "bounds, choose the range in which a solution makes sense"
            )
        if not lo < hi:
            raise InputError(
                f"mcs: bounds of coordinate {i} are ({lo}, {hi}); low must be below high, leave "
                "a coordinate with a known value out of the search"
            )
        if not math.isfinite(hi - lo) or hi - lo < max(_NARROWEST * max(abs(lo), abs(hi)), _TINY):
            raise InputError(
                f"mcs: bounds of coordinate {i} are ({lo}, {hi}); the width is beyond floating "
                "point, shift or scale the coordinate"
            )
    return pairs[:, 0].tolist(), pairs[:, 1].tolist()


def _lists(start: Any, low: Vector, high: Vector) -> tuple[list[Vector], list[int]]:
    """Return the places of the initial evaluations and the index of the start in each list."""
    n = len(low)
    if isinstance(start, str):
        if start == "midpoint":
            return [[lo, lo + 0.5 * (hi - lo), hi] for lo, hi in zip(low, high, strict=True)], [
                1
            ] * n
        if start == "inner":
            sixth = [(hi - lo) / 6.0 for lo, hi in zip(low, high, strict=True)]
            return [
                [lo + d, lo + 3.0 * d, hi - d] for lo, hi, d in zip(low, high, sixth, strict=True)
            ], [1] * n
        raise InputError(
            f"mcs: options.start is {start!r}; give 'midpoint', 'inner', a point or one list per "
            "coordinate"
        )
    try:
        rows = [np.asarray(row, dtype=float) for row in start]
    except (TypeError, ValueError):
        raise InputError(
            "mcs: options.start cannot be read; give a point or one list of numbers per coordinate"
        ) from None
    if len(rows) != n:
        raise InputError(f"mcs: options.start has {len(rows)} entries for {n} coordinates")
    if all(row.ndim == 0 for row in rows):
        pairs = [_around(i, float(row), low[i], high[i]) for i, row in enumerate(rows)]
        return [places for places, _ in pairs], [index for _, index in pairs]
    lists = [_checked_list(i, row, low[i], high[i]) for i, row in enumerate(rows)]
    return lists, [len(places) // 2 for places in lists]


def _around(i: int, x: float, low: float, high: float) -> tuple[Vector, int]:
    """Return a list of three places with the start point `x` among them, and its index."""
    if not low <= x <= high:
        raise InputError(
            f"mcs: options.start has {x} in coordinate {i}, outside the bounds ({low}, {high})"
        )
    margin = 1e-3 * (high - low)
    if x - low < margin:
        return [x, x + 0.5 * (high - x), high], 0
    if high - x < margin:
        return [low, x - 0.5 * (x - low), x], 2
    return [low, x, high], 1


def _checked_list(i: int, row: npt.NDArray[np.float64], low: float, high: float) -> Vector:
    places: Vector = row.tolist() if row.ndim == 1 else []
    gap = _NARROWEST * (high - low)
    if len(places) < 3 or not all(b - a > gap for a, b in zip(places, places[1:], strict=False)):
        raise InputError(
            f"mcs: options.start of coordinate {i} must list at least three ascending, distinct "
            "places"
        )
    if not (places[0] >= low and places[-1] <= high):
        raise InputError(f"mcs: options.start of coordinate {i} leaves the bounds ({low}, {high})")
    return places


def _pattern(pattern: npt.ArrayLike | None, n: int) -> list[list[bool]]:
    if pattern is None:
        return [[True] * n for _ in range(n)]
    try:
        array = np.asarray(pattern).astype(bool)
    except (TypeError, ValueError):
        raise InputError(
            "mcs: options.hessian_pattern cannot be read; give a matrix of booleans"
        ) from None
    if array.shape != (n, n) or not np.array_equal(array, array.T):
        raise InputError(
            f"mcs: options.hessian_pattern must be a symmetric matrix of shape ({n}, {n})"
        )
    rows: list[list[bool]] = array.tolist()
    return rows
