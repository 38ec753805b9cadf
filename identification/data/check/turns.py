"""The unit of an angle, told by the steps of its encoder: they go into a turn a whole number of
times.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from identification.data.check.finding import Finding
from identification.data.check.quanta import precise_step

if TYPE_CHECKING:
    from identification.data.record import FloatArray, Record

_UNITS: Final = {"rad": 1.0, "deg": math.pi / 180.0, "rev": 2.0 * math.pi}
"""Units of an angle [rad]."""
_WORDS: Final = {"rad": "radians", "deg": "degrees", "rev": "turns"}
_WHOLE: Final = 2e-3
"""Distance from a whole number of steps to a turn: by chance a number lies as near in one case of
250, and two angles that both do so for one pair of six units in one case of ten thousand.
"""
_PRINTED: Final = 2.0**-36
"""Relative error of a step below which none is believed: that of rounding in long sums."""
_SIGMAS: Final = 4.0
_SAME: Final = 1e-6
"""Difference of two such digits that is rounding."""
_DIGITS: Final = (1.25, 2.5)
"""Digits of steps that are the digits of a file and not the step of an encoder; so are those of one
digit alone, and powers of two, the numbers of a fixed point.
"""


def check_turns(record: Record, gear_ratio: float | None = None) -> list[Finding]:
    """Find angles that are in another unit than the one they were read in.

    An encoder has a whole number of steps to a turn. Where its steps go into a turn only if the
    numbers are taken in another unit, they are in that unit: one position may say so by chance, and
    it is a warning; where both positions say the same the record is refused.
    """
    if record.kind != "rotary":
        return []
    said = {}
    for channel in ("motor_position", "link_position"):
        if record.has(channel):
            units = _other_units(np.asarray(record[channel]), gear_ratio)
            if units is not None:
                said[channel] = units
    sure = len(said) == 2 and len(set(said.values())) == 1
    return [
        Finding(
            "refuse" if sure else "warn",
            "unit",
            f"{record.name}: {channel} was read in {_WORDS[read]}: are its positions in "
            f"{_WORDS[unit]}? Its encoder has a whole number of steps to a turn only there: give "
            "the column its unit, in its header or in [columns]",
            channel,
        )
        for channel, (read, unit) in said.items()
    ]


def _other_units(values: FloatArray, gear_ratio: float | None) -> tuple[str, str] | None:
    """The unit that an angle [rad] was read in and the one that it is in, where its steps tell."""
    found = precise_step(values)
    if found is None:
        return None
    step, error = found[0], max(found[1], _PRINTED)
    turn = 2.0 * math.pi / step
    sides = (1.0,) if not gear_ratio else (1.0, abs(gear_ratio), 1.0 / abs(gear_ratio))
    if any(_off(turn * side) <= max(_WHOLE, _SIGMAS * error * turn * side) for side in sides):
        return None
    if any(_is_digits(step / size) for size in _UNITS.values()):
        return None
    whole = []
    for read, size in _UNITS.items():
        for unit, other in _UNITS.items():
            steps = turn * size / other
            if unit != read and steps > 1.0 and max(_off(steps), _SIGMAS * error * steps) < _WHOLE:
                whole.append((steps, read, unit))
    return min(whole)[1:] if whole else None  # what goes into a turn goes into 360 of them


def _off(steps: float) -> float:
    """Distance of a number from a whole one."""
    return abs(steps - round(steps))


def _is_digits(step: float) -> bool:
    """Whether a step is one of the digits in a file, or of a fixed point."""
    digits = step / 10.0 ** math.floor(math.log10(step))
    exponent = math.log2(step)
    one = _off(digits) < _SAME or any(abs(digits - d) < _SAME for d in _DIGITS)
    return one or _off(exponent) < _SAME


__all__ = ["check_turns"]
