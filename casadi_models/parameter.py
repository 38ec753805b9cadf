"""One quantity of the joint model: name, unit, start, bounds, meaning, side."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal, final

from .quantities import linear_unit

Side = Literal["motor", "gear", "link", "sensor", "none"]
Scale = Literal["absolute", "velocity", "torsion", "position", "duration"]
Role = Literal[
    "",
    "inertia",
    "stiffness",
    "stiffening",
    "softening",
    "weight",
    "static",
    "delay",
    "smoothing",
    "compliance",
    "exponent",
    "order",
    "range",
]
WRONG_RATIO: Final = 2.0
"""Most by which the scale of one position against the other can be wrong: the check of the records
refuses positions whose ratio is a few percent off the gear ratio, and what torsion adds to that is
less than the motion."""
Typical = float | Mapping[str, float] | None
"""A usual size, or one for each place, or none."""


@final
@dataclass(frozen=True)
class Parameter:
    """A parameter of the joint model.

    Attributes
    ----------
    name : str
        Name, the side said first where an effect can act on either side (``motor_viscous``).
    unit : str
        SI unit of value, bounds and start. Torques and angles are link-referred.
    start : float
        Value with which a simulation or a fit begins; 0 for an amplitude means "absent".
    low, high : float
        Physical bounds (inclusive).
    meaning : str
        One sentence for the reader of a report.
    side : {"motor", "gear", "link", "sensor", "none"}
        Side the value is referred to.
    grid : tuple of float
        Non-empty for a shape parameter (one that enters nonlinearly and is searched on a grid
        first); the grid points, in units of `scale`.
    scale : {"absolute", "velocity", "torsion", "position", "duration"}
        What the grid is a fraction of: nothing, or the 99 % range of a signal of the record.
    role : str
        What the library may ask the parameter for, whatever its name:
        ``inertia`` (a joint without it does not move), ``stiffness`` (linear stiffness of the
        transmission), ``stiffening`` (of its cube), ``softening`` (stiffness that is missing over a
        range: no more than there is), ``weight`` (gravity torque at 90 degrees,
        upright positive), ``static`` (friction torque that holds a joint at rest, in either
        direction), ``delay`` (time by which a channel is late), ``smoothing`` (velocity over which
        friction changes its sign, a nuisance), ``compliance`` (between motor and a link that is
        not recorded), ``exponent`` and ``order`` (shapes that are taken from their grid as they
        stand),
        ``range`` (where a table begins and ends: a fit leaves it as it stands).
    typical : float, mapping of place to float, or None
        A usual size, link-referred: what `irj simulate` takes where the joint file gives no value.
    added : bool
        The effect was once without it: a joint file with fitted values of the effect's others but
        not of this one has it at its start.
    in_place_of : str
        Signal (of :class:`LocalSignals`) that is not always recorded: the parameter shapes what
        stands in for it. Where the signal is recorded there is nothing to shape, and the parameter
        keeps its start.
    """

    name: str
    unit: str
    start: float
    low: float
    high: float
    meaning: str
    side: Side = "link"
    grid: tuple[float, ...] = ()
    scale: Scale = "absolute"
    role: Role = ""
    typical: Typical = field(default=None, hash=False)
    added: bool = False
    in_place_of: str = ""

    def __post_init__(self) -> None:
        if not self.low <= self.start <= self.high:
            raise ValueError(
                f"parameter {self.name}: start {self.start} outside [{self.low}, {self.high}]"
            )

    @property
    def is_shape(self) -> bool:
        """True for a parameter that is searched on a grid (shape of a law, not its amplitude)."""
        return bool(self.grid)

    @property
    def stays_on_grid(self) -> bool:
        """True for a shape that is not refined between the points of its grid."""
        return self.role in ("exponent", "order")

    def usual(self, place: str = "") -> float | None:
        """The typical size in a place, None where none is declared."""
        return self.typical.get(place) if isinstance(self.typical, Mapping) else self.typical

    def renamed(self, name: str, side: Side) -> Parameter:
        """The same parameter under another name and side (used when an effect is put in a
        place).
        """
        return replace(self, name=name, side=side)

    def for_kind(self, kind: str) -> Parameter:
        """The parameter with the units of a linear axis where `kind` is "linear"."""
        return self if kind == "rotary" else replace(self, unit=linear_unit(self.unit))


def amplitude(
    name: str,
    unit: str,
    meaning: str,
    *,
    low: float = 0.0,
    high: float = math.inf,
    role: Role = "",
    typical: Typical = None,
) -> Parameter:
    """An amplitude: enters linearly, 0 means that the effect is absent."""
    return Parameter(name, unit, 0.0, low, high, meaning, role=role, typical=typical)


def signed(
    name: str,
    unit: str,
    meaning: str,
    *,
    low: float = -math.inf,
    high: float = math.inf,
    role: Role = "",
    typical: Typical = None,
    added: bool = False,
) -> Parameter:
    """An amplitude that may have either sign."""
    return Parameter(name, unit, 0.0, low, high, meaning, role=role, typical=typical, added=added)


def scale_error(name: str, meaning: str, most: float, *, typical: Typical = None) -> Parameter:
    """The relative error of a scale, by a factor of at most `most` either way: a scale has a sign,
    and 1 + error is not zero.
    """
    return signed(name, "1", meaning, low=1 / most - 1, high=most - 1, typical=typical)


def shape(
    name: str,
    unit: str,
    meaning: str,
    grid: tuple[float, ...],
    scale: Scale,
    *,
    start: float,
    low: float,
    high: float,
    role: Role = "",
    typical: Typical = None,
    added: bool = False,
    in_place_of: str = "",
) -> Parameter:
    """A shape parameter: enters nonlinearly, searched on a grid of fractions of a signal's
    range.
    """
    return Parameter(
        name,
        unit,
        start,
        low,
        high,
        meaning,
        grid=grid,
        scale=scale,
        role=role,
        typical=typical,
        added=added,
        in_place_of=in_place_of,
    )
