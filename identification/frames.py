"""Results as data frames, for a notebook: every table of a result by its name."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from identification.data.record import Record
from identification.errors import InputError


def frames(result: Any) -> dict[str, Any]:
    """The tables of a result as data frames of pandas.

    Parameters
    ----------
    result : Record, or any result with `as_json`
        A fit, a comparison, a diagnosis, the whole loop.

    Returns
    -------
    dict of str to pandas.DataFrame
        Of a record ``channels`` (SI, over the time in seconds). Of a result every list of entries
        of `as_json` (``steps``, ``claims``, ``ranking``, ...), one row each, in its order, and
        every table by names (``parameters``, ``floor_ratio``, ...), one row a name; what is nested
        has a column a leaf, as ``held_out balances motor ratio``.

    Raises
    ------
    InputError
        No pandas here, or no result.

    Notes
    -----
    The frames hold what `as_json` gives and nothing else, in its units.
    """
    try:
        pandas = import_module("pandas")
    except ImportError:
        raise InputError("frames: pandas is not installed; run: pip install pandas") from None
    if isinstance(result, Record):
        index = pandas.Index(result.time, name="time")
        return {"channels": pandas.DataFrame(dict(result.channels), index=index)}
    if not callable(getattr(result, "as_json", None)):
        raise InputError(f"frames: {type(result).__name__} is no result; give one of a verb")
    out: dict[str, Any] = {}
    for name, part in result.as_json().items():
        if isinstance(part, list) and part and all(isinstance(p, Mapping) for p in part):
            out[name] = pandas.json_normalize(part, sep=" ")
        elif isinstance(part, Mapping) and any(isinstance(p, Mapping) for p in part.values()):
            rows = {k: p for k, p in part.items() if isinstance(p, Mapping)}
            found = pandas.json_normalize(list(rows.values()), sep=" ")
            out[name] = found.set_axis(list(rows), axis="index")
    return out


__all__ = ["frames"]
