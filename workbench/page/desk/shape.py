"""A learned curve as a law in one line: the form that comes nearest to it, for the field in which a
law of one's own is typed.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, final

import casadi as ca
import numpy as np
import numpy.typing as npt

from casadi_models import EFFECTS
from casadi_models.text.typed_law import value_of
from identification.errors import InputError

FloatArray = npt.NDArray[np.float64]

WIDTHS: Final = np.geomspace(1 / 30, 2.0, 24)
"""Widths that are tried, in spans of the curve."""
CENTRES: Final = np.linspace(0.0, 1.0, 25)
"""Places of a bump that are tried, in spans of the curve from its begin."""
TURNS: Final = np.geomspace(0.5, 12.0, 40)
"""Periods in the span of the curve that are tried."""
CLOSER: Final = 3
FINE: Final = 9
"""How often the grid is drawn again about the best shapes, and its points then."""
WIDE: Final = 10.0
"""A parameter may be so many times as large or small as the curve has it: the fit decides."""


@final
@dataclass(frozen=True)
class Form:
    """A law of one variable.

    Attributes
    ----------
    text : str
        With ``u`` for the signal.
    powers : tuple of int
        Of the variable in the unit of each amplitude: ``c`` and ``d``.
    shapes : str
        A letter for each shape: ``w`` a width, ``m`` a place, ``k`` a number of turns.
    """

    text: str
    powers: tuple[int, ...]
    shapes: str = ""

    def columns(self, x: FloatArray, *shapes: float) -> FloatArray:
        """What each amplitude multiplies, (points, amplitudes)."""
        return np.asarray(self._columns(x[None, :], *shapes), dtype=np.float64).T

    @cached_property
    def _columns(self) -> ca.Function:
        u, *own = (ca.SX.sym(n) for n in ("u", *self.shapes))
        amplitudes = [ca.SX.sym(n) for n in "cd"[: len(self.powers)]]
        names = dict(zip((*"cd"[: len(self.powers)], *self.shapes), (*amplitudes, *own)))
        law = value_of(self.text, {"u": u, **names})
        return ca.Function("columns", [u, *own], [ca.jacobian(law, ca.vertcat(*amplitudes)).T])


_ODD: Final = (
    Form("c*u", (1,)),
    Form("c*u*abs(u)", (2,)),
    Form("c*u^3", (3,)),
    Form("c*u + d*u^3", (1, 3)),
    Form("c*tanh(u/w)", (0,), "w"),
    Form("c*tanh(u/w) + d*u", (0, 1), "w"),
    Form("c*u*exp(-abs(u)/w)", (1,), "w"),
)
_EVEN: Final = (
    Form("c*abs(u)", (1,)),
    Form("c*u^2", (2,)),
    Form("c + d*abs(u)", (0, 1)),
    Form("c*exp(-abs(u)/w)", (0,), "w"),
)
_PLACED: Final = (
    Form("c*u", (1,)),
    Form("c + d*u", (0, 1)),
    Form("c*sin(k*u) + d*cos(k*u)", (0, 0), "k"),
    Form("c*exp(-((u - m)/w)^2)", (0,), "mw"),
)
_FORMS: Final[Mapping[str, tuple[str, tuple[Form, ...], bool]]] = {
    "learned_velocity": ("v", _ODD, False),
    "learned_velocity_even": ("v", _EVEN, False),
    "learned_position": ("q", _PLACED, False),
    "learned_position_friction": ("q", _PLACED, True),
    "learned_load_friction": ("load", _EVEN, True),
    "learned_torsion": ("twist", _ODD, False),
}
"""Signal of each table, its forms, and whether they change their sign with the direction."""


def nearest(claim: Mapping[str, Any]) -> dict[str, Any]:
    """The law in one line that comes nearest to a learned curve.

    Parameters
    ----------
    claim : mapping
        A learned curve as `improve --json` has it.

    Returns
    -------
    dict
        ``law``, ``on`` and ``parameters`` as they are typed; ``share`` of the curve's squares that
        the law follows, in percent.

    Raises
    ------
    InputError
        The curve is none of a table that has forms, or has no point.
    """
    key, _, place = str(claim["label"]).partition("#")[0].partition("@")
    curve = claim["curve"]
    x, y = (np.asarray(curve[k], dtype=np.float64) for k in ("x", "learned"))
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    if key not in _FORMS or len(x) < 2 or not np.any(y):
        raise InputError("law: this curve has no form in one line; type a law of your own")
    signal, forms, turns = _FORMS[key]
    found = min((_fitted(f, x, y) for f in forms), key=lambda t: t[0])
    _, form, shapes, amplitudes, left = found
    law = re.sub(r"\bu\b", signal, form.text)
    size = float(np.max(np.abs(y)))
    units = [_unit(str(curve["y_unit"]), str(curve["unit"]), p) for p in form.powers]
    scales = (size / np.max(np.abs(form.columns(x, *shapes)), axis=0)).tolist()
    sizes = [max(abs(a), s) for a, s in zip(amplitudes.tolist(), scales, strict=True)]
    names = "cd"[: len(sizes)]
    parameters = [
        f"{n}={-WIDE * s:.3g}..{WIDE * s:.3g} {u}".rstrip()
        for n, s, u in zip(names, sizes, units, strict=True)
    ]
    parameters += [
        _of_shape(n, v, x, str(curve["unit"])) for n, v in zip(form.shapes, shapes, strict=True)
    ]
    return {
        "law": f"({law})*direction" if turns else law,
        "on": place or EFFECTS[key].acts_on[0],
        "parameters": ", ".join(parameters),
        "share": 100.0 * max(0.0, 1.0 - left / float(y @ y)),
    }


def _fitted(
    form: Form, x: FloatArray, y: FloatArray
) -> tuple[float, Form, tuple[float, ...], FloatArray, float]:
    """A form at its best: its price (fewer parameters are better among equals), shapes, amplitudes
    and what it leaves of the curve's squares.
    """
    low, span = float(x.min()), float(np.ptp(x)) or 1.0
    whole = {"w": WIDTHS * span, "m": low + CENTRES * span, "k": 2 * np.pi * TURNS / span}
    grids = [whole[s] for s in form.shapes]
    left, shapes, amplitudes = _best(form, x, y, grids)
    for _ in range(CLOSER if grids else 0):
        grids = [_about(g, v) for g, v in zip(grids, shapes, strict=True)]
        left, shapes, amplitudes = _best(form, x, y, grids)
    n, count = len(x), len(form.powers) + len(form.shapes)
    price = n * float(np.log(max(left, 1e-12 * float(y @ y)))) + count * float(np.log(n))
    return price, form, shapes, amplitudes, left


def _best(
    form: Form, x: FloatArray, y: FloatArray, grids: Sequence[FloatArray]
) -> tuple[float, tuple[float, ...], FloatArray]:
    """Of all shapes on a grid those that leave least, with their amplitudes."""
    made = []
    for shapes in itertools.product(*(g.tolist() for g in grids)):
        columns = form.columns(x, *shapes)
        size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        amplitudes = np.linalg.lstsq(columns / size, y, rcond=None)[0] / size
        made.append((float(np.sum((y - columns @ amplitudes) ** 2)), shapes, amplitudes))
    return min(made, key=lambda t: t[0])


def _about(grid: FloatArray, value: float) -> FloatArray:
    """A finer grid from the neighbour before a value to the one behind it."""
    k = int(np.argmin(np.abs(grid - value)))
    return np.linspace(grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)], FINE)


def _unit(torque: str, of: str, power: int) -> str:
    """Unit of an amplitude that a power of the signal stands beside: ``N.m.s3/rad3``."""
    above, _, below = of.partition("/")
    mark = str(power) if power > 1 else ""
    if power == 0:
        return torque
    if above == torque:  # over the load: a number
        return "1" if power == 1 else f"1/{_raised(torque, power - 1)}"
    return f"{torque}.{below}{mark}/{above}{mark}" if below else f"{torque}/{above}{mark}"


def _raised(unit: str, power: int) -> str:
    mark = str(power) if power > 1 else ""
    return "/".join(f"{u}{mark}" for u in unit.split("."))


def _of_shape(name: str, value: float, x: FloatArray, unit: str) -> str:
    if name == "m":
        return f"m={x.min():.3g}..{x.max():.3g} {unit}"
    if name == "k":
        return f"k={value / 2:.3g}..{2 * value:.3g} 1/{unit}"
    return f"w={value / WIDE:.3g}..{WIDE * value:.3g} {unit}"


__all__ = ["nearest"]
