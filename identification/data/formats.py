"""Numbers and units as a reader expects them: significant digits, real minus signs, no computer
notation.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

_SUPERSCRIPT: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
MINUS: Final = "−"
PLAIN: Final = (1e-4, 1e6)
"""Spans whose ends are written without a power of ten: at most six digits before the point or four
zeros behind it.
"""
SPACE: Final = "\u00a0"
"""Between a number and its sign of unit: no line break."""
CERTAIN: Final = 0.01
"""Chance below which, and below 1 by which, no figure is told: a library is not all there is."""


def number(value: float | None, digits: int = 4) -> str:
    """A number with `digits` significant digits; powers of ten where it is very large or small.

    None and NaN give a dash.
    """
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return f"{MINUS}∞" if value < 0 else "∞"
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if -4 <= exponent < 6:
        places = max(digits - 1 - exponent, 0)
        text = f"{value:.{places}f}"
        if "." in text:
            text = text.rstrip("0").rstrip(".")
        return text.replace("-", MINUS)
    return _power(value, exponent, max(digits - 1, 0), trim=True)


def _power(value: float, exponent: int, places: int, *, trim: bool = False) -> str:
    mantissa = f"{value / 10.0**exponent:.{places}f}"
    if trim and "." in mantissa:
        mantissa = mantissa.rstrip("0").rstrip(".")
    return f"{mantissa} × 10{str(exponent).translate(_SUPERSCRIPT)}".replace("-", MINUS)


def with_error(value: float, stderr: float | None) -> str:
    """A value with its standard error, both to the error's second digit."""
    if stderr is None or not math.isfinite(stderr) or stderr <= 0:
        return number(value)
    size = math.floor(math.log10(stderr))
    largest = max(math.floor(math.log10(abs(value))) if value else size, size)
    if -4 <= largest < 6:
        places = max(1 - size, 0)
        return f"{value:.{places}f} ± {stderr:.{places}f}".replace("-", MINUS)
    scale = 10.0**largest
    places = max(1 - (size - largest), 0)
    power = f"10{str(largest).translate(_SUPERSCRIPT)}"
    return f"({value / scale:.{places}f} ± {stderr / scale:.{places}f}) × {power}".replace(
        "-", MINUS
    )


def pretty_unit(unit: str) -> str:
    """``kg.m2`` as kg·m²; the unit of a pure number as nothing."""
    if unit in ("", "1"):
        return ""
    return re.sub(r"(?<=[A-Za-z])-?\d+", lambda m: m.group().translate(_SUPERSCRIPT), unit).replace(
        ".", "·"
    )


def percent(value: float | None, digits: int = 3) -> str:
    """A percentage with its sign of percent; a dash where there is none."""
    text = number(value, digits)
    return text if text == "–" else f"{text}{SPACE}%"


def words(name: str) -> str:
    """A name of a file's vocabulary as words: ``motor_viscous`` as motor viscous."""
    return name.replace("_", " ")


def ratio(value: float | None) -> str:
    """A ratio to the noise, as 14.6 ×; two decimals where it is small, so that 1.00 × can be
    told from 0.96 ×.
    """
    if value is None or not math.isfinite(value):
        return f"{number(value)}{SPACE}×"
    return f"{value:.2f}{SPACE}×" if abs(value) < 10 else f"{number(value, 3)}{SPACE}×"


def interval(low: float, high: float) -> str:
    """Two ends to the same decimal place, as 0.35 to 0.75: a hundredth of the span or so."""
    span = abs(high - low)
    if not (math.isfinite(span) and PLAIN[0] <= span < PLAIN[1]):
        return f"{number(low, 3)} to {number(high, 3)}"
    places = max(1 - math.floor(math.log10(span / 3)), 0)
    ends = (round(v, places) + 0.0 for v in (low, high))
    return " to ".join(f"{v:.{places}f}" for v in ends).replace("-", MINUS)


def value_range(values: npt.NDArray[np.float64]) -> str:
    """Smallest and largest finite value of a channel."""
    finite = values[np.isfinite(values)]
    return f"{finite.min():.5g} to {finite.max():.5g}" if finite.size else "no finite value"


def chances(confidence: Mapping[str, float]) -> str:
    """Chances of names in words: "97 % stribeck, under 1 % lugre".

    Parameters
    ----------
    confidence : mapping of str to float
    """
    return ", ".join(
        f"{'under 1' if p < CERTAIN else 'over 99' if p > 1 - CERTAIN else f'{100 * p:.0f}'} % {n}"
        for n, p in confidence.items()
    )
