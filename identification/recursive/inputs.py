"""Checks of what a user hands to the recursive least squares."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]


def doubles(value: npt.ArrayLike, asked: str, name: str) -> FloatArray:
    """An array of doubles from anything array-like."""
    if np.iscomplexobj(value):
        raise InputError(f"{asked}: {name} is complex; give real numbers")
    try:
        return (
            np.ascontiguousarray(value, dtype=np.float64)
            if np.ndim(value)
            else np.array(value, dtype=np.float64)
        )
    except (TypeError, ValueError) as error:
        raise InputError(f"{asked}: {name} is not an array of real numbers ({error})") from None


def vector(value: npt.ArrayLike, name: str) -> FloatArray:
    """A vector of finite numbers."""
    found = np.atleast_1d(doubles(value, "RecursiveLeastSquares", name))
    if found.ndim != 1 or not np.all(np.isfinite(found)):
        raise InputError(f"RecursiveLeastSquares: {name} must be a vector of finite numbers")
    return found.copy()


def spread(value: FloatArray, size: int, name: str, what: str) -> FloatArray:
    """One value for each, from one or as many."""
    if value.shape not in ((1,), (size,)):
        raise InputError(
            f"RecursiveLeastSquares: {name} has {value.size} values for {size} {what}; give {size}"
        )
    return np.broadcast_to(value, (size,)).copy()


def variances(
    value: npt.ArrayLike, size: int | None, name: str, what: str, *, zero: bool
) -> FloatArray:
    """Variances from one number, a vector or a diagonal matrix."""
    given = doubles(value, "RecursiveLeastSquares", name)
    if given.ndim == 2:
        if given.shape[0] != given.shape[1] or np.any(given != np.diag(np.diag(given))):
            raise InputError(
                f"RecursiveLeastSquares: {name} must be diagonal; scale the {what} apart first"
            )
        given = np.diag(given)
    found = vector(given, name)
    if np.any(found < 0) or (not zero and np.any(found <= 0)):
        raise InputError(f"RecursiveLeastSquares: {name} must be {'>= 0' if zero else 'positive'}")
    return found if size is None else spread(found, size, name, what)


def positions(names: Sequence[str], wanted: Iterable[int | str], asked: str) -> list[int]:
    """Positions of parameters given by name or position."""
    found = []
    for item in wanted:
        if isinstance(item, str) and item in names:
            found.append(names.index(item))
        elif isinstance(item, (int, np.integer)) and 0 <= item < len(names):
            found.append(int(item))
        else:
            raise InputError(f"{asked}: there is no parameter {item!r}; use {', '.join(names)}")
    return found
