"""Unit strings of a user's files to SI, with a dimension check (the table and the parser are
those of `quantities`).
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from casadi_models import quantities
from casadi_models.quantities import BASE_NAMES, QUANTITIES, RAD, BaseUnit
from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]

__all__ = [
    "BASE_NAMES",
    "QUANTITIES",
    "BaseUnit",
    "base_unit",
    "check_unit",
    "from_si",
    "same_dimension",
    "to_si",
]

_MASSIVE: Final = tuple(i for i, name in enumerate(BASE_NAMES) if name not in ("m", "s", "rad"))
"""Base units that make a quantity more than kinematic."""


def base_unit(unit: str, counts_per_turn: float | None = None) -> BaseUnit:
    """Read a unit string (see :func:`casadi_models.quantities.base_unit`).

    Parameters
    ----------
    unit : str
        For example ``"N.m/rad"``.
    counts_per_turn : float, optional
        Encoder counts of one turn; needed where the unit says ``counts``.

    Raises
    ------
    InputError
        If the unit is not known or cannot be read.
    """
    try:
        return quantities.base_unit(unit, counts_per_turn)
    except quantities.UnitError as error:
        raise InputError(str(error)) from None


def same_dimension(first: BaseUnit, second: BaseUnit) -> bool:
    """Whether two units measure the same kind of quantity.

    For purely kinematic quantities (angle, speed, frequency) the radian counts as a dimension, so
    that ``1/s`` is not taken for an angular velocity.  Where mass or current enters, it does not:
    stiffness is written both as N.m/rad and as N.m.
    """
    a, b = first.exponents, second.exponents
    if a[:RAD] != b[:RAD]:
        return False
    kinematic = not any(a[i] for i in _MASSIVE)
    return a[RAD] == b[RAD] if kinematic else True


def _where(channel: str | None) -> str:
    return f"channel {channel}: " if channel else ""


def check_unit(
    unit: str, kind: str, counts_per_turn: float | None = None, channel: str | None = None
) -> BaseUnit:
    """Read a unit and refuse it where it does not measure the wanted quantity.

    Parameters
    ----------
    unit : str
        Unit of the values.
    kind : str
        A name in `QUANTITIES` (``"angle"``) or the SI unit wanted (``"rad"``).
    counts_per_turn : float, optional
        Encoder counts of one turn.
    channel : str, optional
        Named in the message.

    Raises
    ------
    InputError
        If the unit is unknown or of another dimension; the message names unit and channel.
    """
    target = QUANTITIES.get(kind, kind)
    wanted = base_unit(target)
    text = unit.strip()
    if target == "K" and text in {"C", "F"}:
        text = f"deg{text}"
    try:
        found = base_unit(text, counts_per_turn)
    except InputError as error:
        raise InputError(f"{_where(channel)}{error}") from None
    if not same_dimension(found, wanted):
        hint = "; standard gravity is written g0" if text == "g" else ""
        raise InputError(
            f"{_where(channel)}unit {unit!r} does not fit, a unit of the kind {target} is "
            f"wanted{hint}"
        )
    return found


def to_si(
    values: npt.ArrayLike,
    unit: str,
    kind: str | None = None,
    *,
    counts_per_turn: float | None = None,
    channel: str | None = None,
) -> FloatArray:
    """Convert values to SI.

    Parameters
    ----------
    values : array_like
        Values in `unit`, any shape.
    unit : str
        Their unit.
    kind : str, optional
        Quantity (`QUANTITIES`) or SI unit they must have; without it the dimension is not checked.
    counts_per_turn : float, optional
        Encoder counts of one turn, where the unit is ``counts``.
    channel : str, optional
        Named in error messages.

    Returns
    -------
    ndarray of float
        The same shape, in SI.

    Raises
    ------
    InputError
        If the unit is unknown or of another dimension.
    """
    base = (
        base_unit(unit, counts_per_turn)
        if kind is None
        else check_unit(unit, kind, counts_per_turn, channel)
    )
    array = np.asarray(values, dtype=np.float64)
    if base.factor == 1.0 and base.offset == 0.0:
        return array
    scaled: FloatArray = array * base.factor
    if base.offset:
        scaled += base.offset
    return scaled


def from_si(values: npt.ArrayLike, unit: str, counts_per_turn: float | None = None) -> FloatArray:
    """Convert SI values to a unit (the inverse of `to_si`)."""
    base = base_unit(unit, counts_per_turn)
    result: FloatArray = (np.asarray(values, dtype=np.float64) - base.offset) / base.factor
    return result
