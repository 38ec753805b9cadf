"""Tables: a torque as a free curve over one variable, by cubic B-splines with even knots.

The curve is a sum of bumps, each a control value times a cardinal cubic B-spline. It is written in
powers of max(., 0) only, so that the same expression runs in CasADi SX, in generated C and in FMUs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Final, final

import casadi as ca

from .parameter import Parameter, Scale, shape, signed
from .signals import Expression

KNOTS: Final = 24
"""Control values of a curve: with 12 the 95 % band of smooth friction laws covers .86, with 24
.94.
"""
NARROW: Final = 40
"""Control values of a curve over position: a snag of a twentieth of the travel lies between the
knots of 24 (held-out error 1.26 of that of the true law; with 40 less than 1.01)."""
SLOW: Final = 0.02
"""Share of the largest speed below which knots are evenly spaced; above, they follow its logarithm:
friction bends at low speed."""
SHARP: Final = 1e-3
"""Share of the largest speed within which a curve over velocity changes its sign: a fourth of the
distance from zero to the first knot."""
UPPER: Final = 0.5
"""Share of the largest speed from which the slope beyond it is taken: the slope over the upper half
errs least (.4 % of the law in the median; base slope 6 %, last slope 5 %, constant 8 %)."""


def bump(t: Expression) -> Expression:
    """Cardinal cubic B-spline: 2/3 at 0, 0 from 2 on, second derivative continuous."""
    far = ca.fabs(t)
    return (ca.fmax(2 - far, 0) ** 3 - 4 * ca.fmax(1 - far, 0) ** 3) / 6


def heaped(t: Expression) -> Expression:
    """Integral of :func:`bump` from minus infinity to t: 0 up to -2, 1 from 2 on."""
    terms = zip((1, -4, 6, -4, 1), (2, 1, 0, -1, -2), strict=True)
    return sum(sign * ca.fmax(t + shift, 0) ** 4 for sign, shift in terms) / 24


def spline(u: Expression, controls: Sequence[Expression]) -> Expression:
    """The curve at u, 0 to 1 over its range; linear in the controls."""
    return sum(c * bump(u * (len(controls) - 3) + 1 - i) for i, c in enumerate(controls))


def _heap(u: Expression, controls: Sequence[Expression]) -> Expression:
    """Integral of :func:`spline` over u, up to a constant."""
    pieces = len(controls) - 3
    return sum(c * heaped(u * pieces + 1 - i) for i, c in enumerate(controls)) / pieces


def _speed_place(speed: Expression, reach: Expression) -> Expression:
    return ca.asinh(speed / (SLOW * reach)) / math.asinh(1 / SLOW)


@final
@dataclass(frozen=True)
class Table:
    """Which variable the table of an effect runs over, and the names of its parameters.

    Attributes
    ----------
    over : str
        Field of :class:`casadi_models.signals.LocalSignals`.
    stem : str
        What the names of the parameters begin with.
    of_speed : bool
        True for a table over the size of a velocity: knots dense near zero, a line beyond the
        range. Others hold their last value there.
    odd : bool
        True for a torque that changes sign with the direction of motion.
    knots : int
        Number of control values.
    """

    over: str
    stem: str
    of_speed: bool = False
    odd: bool = False
    knots: int = KNOTS

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the control values, in the order of the variable."""
        return tuple(f"{self.stem}_{i + 1:02d}" for i in range(self.knots))

    @property
    def range_names(self) -> tuple[str, ...]:
        """Names of what says the range: the largest speed, or centre and half width."""
        own = ("reach",) if self.of_speed else ("centre", "half_range")
        return tuple(f"{self.stem}_{n}" for n in own)

    def parameters(
        self, unit: str, scale: Scale, usual: float, shape_of: Sequence[float]
    ) -> tuple[Parameter, ...]:
        """The declared parameters.

        Parameters
        ----------
        unit : str
            Of the variable.
        scale : str
            Range of the records that the table spans where nothing is given.
        usual : float
            Usual half width of the range.
        shape_of : sequence of float
            Typical control values at the ends and between, evenly spaced [N.m].
        """
        out = []
        for i, name in enumerate(self.controls):
            at = i / (self.knots - 1) * (len(shape_of) - 1)
            k = min(int(at), len(shape_of) - 2)
            typical = shape_of[k] + (at - k) * (shape_of[k + 1] - shape_of[k])
            out.append(
                signed(
                    name,
                    "N.m",
                    f"control value {i + 1} of {self.knots} of the curve",
                    typical=typical,
                )
            )
        ends = {
            "reach": "speed up to which the curve was learned",
            "centre": "middle of the range over which the curve was learned",
            "half_range": "half of that range",
        }
        for name in self.range_names:
            own = name.removeprefix(f"{self.stem}_")
            middle = own == "centre"
            grid = (0.0,) if middle else (usual,) if scale == "absolute" else (1.0,)
            made = shape(
                name,
                unit,
                ends[own],
                grid,
                "absolute" if middle else scale,
                start=0.0 if middle else usual,
                low=-math.inf if middle else 1e-9,
                high=math.inf,
                role="range",
                typical=0.0 if middle else usual,
            )
            out.append(replace(made, low=-math.inf) if middle else made)
        return tuple(out)

    def turned(self, speed: Expression, p: SimpleNamespace) -> Expression:
        """Direction of a motion, sharper than any knot: the curve tells of low speed, no
        smoothing.
        """
        (reach,) = (getattr(p, n) for n in self.range_names)
        return ca.tanh(speed / (SHARP * reach))

    def value(self, x: Expression, p: SimpleNamespace) -> Expression:
        """The curve at x, which is a speed where the table is over one."""
        controls = [getattr(p, n) for n in self.controls]
        ends = [getattr(p, n) for n in self.range_names]
        if self.of_speed:
            (reach,) = ends
            inside = ca.fmin(x, reach)
            top, half = spline(1.0, controls), spline(_speed_place(UPPER, 1.0), controls)
            slope = (top - half) / ((1 - UPPER) * reach)
            return spline(_speed_place(inside, reach), controls) + slope * (x - inside)
        return spline(self._inside(x, *ends)[0], controls)

    def stored(self, x: Expression, p: SimpleNamespace) -> Expression:
        """Integral of the curve over x from 0: the energy stored by a law of a position or
        torsion.
        """
        controls = [getattr(p, n) for n in self.controls]
        centre, half = (getattr(p, n) for n in self.range_names)

        def up_to(y: Expression) -> Expression:
            u, beyond = self._inside(y, centre, half)
            return 2 * half * _heap(u, controls) + beyond * spline(u, controls)

        return up_to(x) - up_to(0.0)

    @staticmethod
    def _inside(
        x: Expression, centre: Expression, half: Expression
    ) -> tuple[Expression, Expression]:
        """Place in the range, 0 to 1, and what x lies beyond it."""
        held = ca.fmax(ca.fmin(x, centre + half), centre - half)
        return ((held - centre) / half + 1) / 2, x - held
