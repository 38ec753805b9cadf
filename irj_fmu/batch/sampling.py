"""The parameters of a study's runs: every case with every point of the grid and every draw."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from identification.data.schema import finite
from identification.errors import InputError
from irj_fmu.batch.checks import table, value
from irj_fmu.batch.study_schema import AXIS, DRAW, METHODS, RANDOM

MOST: Final = 1_000_000
"""Runs of one model with one record."""
Case = dict[str, Any]


def cases_of(data: Mapping[str, Any], where: str) -> list[Case]:
    """Work out the cases of a study file.

    Parameters
    ----------
    data : mapping
        The file; of it, ``grid``, ``case`` and ``random`` are used.
    where : str
        The file's path, for messages.

    Returns
    -------
    list of dict
        Parameter to value; one empty case where nothing is varied.

    Raises
    ------
    InputError
        Where an entry cannot be used, a parameter is varied twice, or there are more than `MOST`
        cases.
    """
    listed = data.get("case", [])
    if not isinstance(listed, list) or not all(isinstance(case, Mapping) for case in listed):
        raise InputError(f"{where}: case must be written as [[case]], once for each")
    rows = [
        {name: value(entry, f"{where}: [[case]] {name}") for name, entry in case.items()}
        for case in listed
    ]
    grid = {
        name: axis(entry, f"{where}: [grid] {name}")
        for name, entry in table(data, "grid", where).items()
    }
    drawn = draws(table(data, "random", where), where)
    by_name = [
        *dict.fromkeys(name for row in rows for name in row),
        *grid,
        *(drawn[0] if drawn else ()),
    ]
    for name in by_name:
        if by_name.count(name) > 1:
            raise InputError(
                f"{where}: {name} is varied in two places; keep one of [grid], [[case]], [random]"
            )
    count = math.prod(
        [max(1, len(rows)), *(len(points) for points in grid.values()), max(1, len(drawn))]
    )
    if count > MOST:
        raise InputError(
            f"{where}: {count} cases are more than {MOST}; take fewer points, or [random] in "
            "place of [grid]"
        )
    points = [
        dict(zip(grid, combination, strict=True))
        for combination in itertools.product(*grid.values())
    ]
    return [
        {**row, **point, **draw}
        for row in rows or [{}]
        for point in points
        for draw in drawn or [{}]
    ]


def axis(entry: Any, where: str) -> list[Any]:
    """The points of one parameter of a grid: a list, or `count` points between `low` and `high`."""
    if isinstance(entry, list):
        if not entry:
            raise InputError(f"{where}: the list is empty; give at least one value")
        return [value(v, where) for v in entry]
    if not isinstance(entry, Mapping):
        raise InputError(
            f"{where}: give a list of values, or {{ low = ..., high = ..., count = ... }}"
        )
    AXIS.check(entry, where)
    low, high, is_log = _range(entry, where)
    count = entry.get("count")
    if isinstance(count, bool) or not isinstance(count, int) or not 2 <= count <= MOST:
        raise InputError(f"{where}: count = {count!r}; give a whole number of at least 2")
    points: list[float] = (
        np.geomspace(low, high, count) if is_log else np.linspace(low, high, count)
    ).tolist()
    return points


def draws(entry: Mapping[str, Any], where: str) -> list[Case]:
    """The draws of ``[random]``, the same for the same seed.

    ``independent`` draws do not change when `count` grows; ``latin`` puts one draw into each of
    `count` equally likely parts of every parameter's range (McKay, Beckman, Conover, Technometrics
    21, 1979).
    """
    if not entry:
        return []
    place = f"{where}: [random]"
    RANDOM.check(entry, place)
    parameters = table(entry, "parameters", place)
    count, seed = (
        _counted(entry, key, place, default) for key, default in (("count", 0), ("seed", 0))
    )
    method = RANDOM["method"].read(entry, place)
    if not parameters or not 1 <= count <= MOST:
        raise InputError(f"{place}: give count, from 1 to {MOST}, and [random.parameters]")
    generator = np.random.default_rng(seed)
    share = generator.random((count, len(parameters)))
    if method == "latin":
        share = (
            np.column_stack([generator.permutation(count) for _ in parameters]) + share
        ) / count
    columns = [
        _drawn(law, share[:, i], f"{where}: [random.parameters] {name}")
        for i, (name, law) in enumerate(parameters.items())
    ]
    return [dict(zip(parameters, row, strict=True)) for row in zip(*columns, strict=True)]


def _drawn(entry: Any, share: npt.NDArray[np.float64], where: str) -> Sequence[Any]:
    """Quantiles of one parameter's distribution at shares between 0 and 1."""
    if not isinstance(entry, Mapping):
        raise InputError(
            f"{where}: give {{ low, high }}, {{ mean, deviation }} or {{ choose = [...] }}"
        )
    DRAW.check(entry, where)
    kinds = [
        bool({"low", "high"} & entry.keys()),
        bool({"mean", "deviation"} & entry.keys()),
        "choose" in entry,
    ]
    if sum(kinds) != 1 or ("spacing" in entry and not kinds[0]):
        raise InputError(
            f"{where}: give one of {{ low, high }}, {{ mean, deviation }} and {{ choose = [...] }}"
        )
    if kinds[0]:
        low, high, is_log = _range(entry, where)
        found: list[float] = (
            low * (high / low) ** share if is_log else low + (high - low) * share
        ).tolist()
        return found
    if kinds[1]:
        from scipy.special import ndtri

        mean, deviation = (
            finite(entry.get(key), f"{where}: {key}") for key in ("mean", "deviation")
        )
        if deviation <= 0:
            raise InputError(f"{where}: deviation = {deviation:g} is not positive")
        tail = np.clip(share, 1e-16, 1 - 1e-16)
        normal: list[float] = (mean + deviation * ndtri(tail)).tolist()
        return normal
    choice = entry["choose"]
    if not isinstance(choice, list) or not choice:
        raise InputError(f"{where}: choose must be a list of values")
    return [value(choice[min(int(s * len(choice)), len(choice) - 1)], where) for s in share]


def _range(entry: Mapping[str, Any], where: str) -> tuple[float, float, bool]:
    low, high = (finite(entry.get(key), f"{where}: {key}") for key in ("low", "high"))
    spacing = AXIS["spacing"].read(entry, where)
    if low >= high:
        raise InputError(f"{where}: low = {low:g} is not below high = {high:g}")
    if spacing == "log" and low <= 0:
        raise InputError(f'{where}: spacing = "log" needs low > 0')
    return low, high, spacing == "log"


def _counted(entry: Mapping[str, Any], key: str, where: str, default: int) -> int:
    found = entry.get(key, default)
    if isinstance(found, bool) or not isinstance(found, int) or found < 0:
        raise InputError(f"{where}: {key} = {found!r} is not a whole number")
    return found


__all__ = ["METHODS", "MOST", "axis", "cases_of", "draws"]
