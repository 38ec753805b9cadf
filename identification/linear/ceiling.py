"""The linear ceiling: how much of the measured torque a linear model without physics would explain.

A physical model that explains less than linear black boxes misses something linear; one that
explains more owes it to its nonlinear laws. Each balance is taken as a system from the motion (and
the torque reading, where the balance holds it) to its measured torque, on the very rows on which
the physical model is judged.

Source of the black boxes: Ljung, System Identification, 2nd ed. (1999), chapter 4; see
`identification.linear.blackbox`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.stacked import measured
from identification.balance.weak import WeakRecord
from identification.errors import InputError
from identification.fitting.engine import Dataset

if TYPE_CHECKING:
    from identification.linear.blackbox import Tried

FloatArray = npt.NDArray[np.float64]

STRUCTURES: Final[tuple[Tried, ...]] = ("static", "arx", "oe", "moesp")
ORDERS: Final = (1, 2)
FIT_ROWS: Final = 4_000
"""Rows used to fit at most, spread over all stretches."""
TEST_ROWS: Final = 20_000
"""Rows judged at most, spread over all stretches."""
SHORTEST: Final = 60
"""Rows of the shortest stretch used."""
ALIKE: Final = 1.5
"""Two models explain alike where what they leave differs by less than this factor."""

_MOTOR: Final = ("motor_position", "motor_velocity", "motor_acceleration")
_LINK: Final = ("link_position", "link_velocity", "link_acceleration")
_TWIST: Final = ("torsion", "torsion_rate")
_INPUTS: Final[Mapping[str, tuple[str, ...]]] = {
    "motor": (*_MOTOR, "torque"),
    "link": _LINK,
    "transmission": (*_TWIST, "motor_position", "motor_velocity"),
    "sum": (*_MOTOR, *_TWIST, "link_acceleration"),
    "deflection": (*_MOTOR, *_TWIST),
    "axis": _MOTOR,
    "kinematic": _LINK,
}


@final
@dataclass(frozen=True)
class BalanceCeiling:
    """The best linear model of one balance beside the physical one.

    Attributes
    ----------
    model : str
        Name of the best black box, for example ``"arx 2"``.
    vaf_percent : float
        Variance of the measured torque that it accounts for, initial state and offset of each
        stretch its own.
    physical_vaf_percent : float
        The same of the physical model, on the same rows and also with an offset for each stretch.
    noise_percent : float
        What measurement noise alone would leave.
    """

    model: str
    vaf_percent: float
    physical_vaf_percent: float
    noise_percent: float


@final
@dataclass(frozen=True)
class Ceiling:
    """Linear black boxes beside the physical model.

    Attributes
    ----------
    balances : mapping of str to BalanceCeiling
    vaf_percent, physical_vaf_percent, noise_percent : float
        Over all balances.
    tried : int
        Number of linear models tried for each balance.
    fit_rows, rows : int
        Rows that the black boxes were fitted to, and rows judged.
    all_rows : int
        Rows there are; more than `rows` where the cap cut them.
    unseen : bool
        True where neither model was fitted to the judged records.
    fitted : bool
        False where the physical model was fitted to no record here.
    """

    balances: Mapping[str, BalanceCeiling]
    vaf_percent: float
    physical_vaf_percent: float
    noise_percent: float
    tried: int
    fit_rows: int
    rows: int
    all_rows: int
    unseen: bool
    fitted: bool = True

    @property
    def meaning(self) -> str:
        """What the two figures say together, a sentence."""
        physical, linear = (
            100.0 - self.physical_vaf_percent,
            max(100.0 - self.vaf_percent, self.noise_percent),
        )
        if physical > ALIKE * linear:
            return (
                "A linear model without physics leaves less of the variance unexplained: "
                "something linear is missing in the physical model."
            )
        if ALIKE * physical < linear:
            return (
                "The physical model leaves less of the variance unexplained than any of them: "
                "its nonlinear laws earn their place."
            )
        return (
            "The physical model explains as much as a linear one can; what is left is noise "
            "or nonlinear."
        )

    def as_json(self) -> dict[str, Any]:
        """As data."""
        return {
            "vaf_percent": self.vaf_percent,
            "physical_vaf_percent": self.physical_vaf_percent,
            "noise_percent": self.noise_percent,
            "meaning": self.meaning,
            "tried": self.tried,
            "fit_rows": self.fit_rows,
            "rows": self.rows,
            "all_rows": self.all_rows,
            "unseen": self.unseen,
            "fitted": self.fitted,
            "balances": {b: asdict(c) for b, c in self.balances.items()},
        }

    def __str__(self) -> str:
        rows = (
            f"{self.rows} of {self.all_rows} rows"
            if self.rows < self.all_rows
            else f"{self.rows} rows"
        )
        each = ", ".join(
            f"{b} {left(c.vaf_percent)} against {left(c.physical_vaf_percent)} %"
            for b, c in self.balances.items()
        )
        both = "both were" if self.fitted else "the linear ones were"
        seen = f"records {'neither was' if self.unseen else both} fitted to"
        return (
            f"linear ceiling: the best of {self.tried} linear models without physics leaves "
            f"{left(self.vaf_percent)} % of the torque's "
            f"variance unexplained, this model {left(self.physical_vaf_percent)} % (shares of "
            f"variance, the square of a relative error: {each}; "
            f"{rows}, {seen})"
        )


def left(vaf_percent: float) -> str:
    """Variance left unexplained [%], three digits."""
    return f"{max(100.0 - vaf_percent, 0.0):.3g}"


def ceiling(
    data: Dataset,
    tested: Sequence[WeakRecord],
    residual: Mapping[str, FloatArray],
    floor: Mapping[str, float],
    *,
    unseen: bool,
    fitted: bool = True,
) -> Ceiling | None:
    """Compare a physical model with linear black boxes fitted to the same records.

    Parameters
    ----------
    data : Dataset
        That of the fit; its training rows fit the black boxes too.
    tested : sequence of WeakRecord
        Records judged.
    residual : mapping of str to (rows,) array
        Residual of the physical model in each balance on the judged records, one after the other.
    floor : mapping of str to float
        RMS that measurement noise alone would leave in each balance.
    unseen : bool
        True where the judged records had no part in the fit.
    fitted : bool
        False where the values of the physical model stood before any record here.

    Returns
    -------
    Ceiling or None
        None where no stretch is long enough for a black box.
    """
    fit_parts, test_parts = _capped(data.train, FIT_ROWS), _capped(tested, TEST_ROWS)
    firsts = np.concatenate([[0], np.cumsum([w.rows for w in tested])])
    if not fit_parts or not test_parts:
        return None
    found: dict[str, BalanceCeiling] = {}
    spread, lost, physical_lost, noise = 0.0, 0.0, 0.0, 0.0
    rows = sum(p.stop - p.start for _, p in test_parts)
    for balance in data.sensing.balances:
        # a record with another payload does not share the balances of the link
        shared = [(i, p) for i, p in test_parts if balance not in tested[i].masked]
        fit = [
            _io(data.train[i], balance, p)
            for i, p in fit_parts
            if balance not in data.train[i].masked
        ]
        test = [_io(tested[i], balance, p) for i, p in shared]
        if not fit or not test:
            continue
        best = _best(fit, test)
        size = sum(_power(y) for _, y in test)
        if best is None or size <= 0:
            return None
        name, vaf = best
        rest = sum(
            _power(residual[balance][firsts[i] + p.start : firsts[i] + p.stop]) for i, p in shared
        )
        least = sum(len(y) for _, y in test) * floor[balance] ** 2
        found[balance] = BalanceCeiling(
            name, vaf, 100.0 * (1.0 - rest / size), 100.0 * least / size
        )
        spread += size
        lost += size * (1.0 - vaf / 100.0)
        physical_lost += rest
        noise += least
    if not found:
        return None
    return Ceiling(
        found,
        100.0 * (1.0 - lost / spread),
        physical_vaf_percent=100.0 * (1.0 - physical_lost / spread),
        noise_percent=100.0 * noise / spread,
        tried=1 + (len(STRUCTURES) - 1) * len(ORDERS),
        fit_rows=sum(p.stop - p.start for _, p in fit_parts),
        rows=rows,
        all_rows=sum(w.rows for w in tested),
        unseen=unseen,
        fitted=fitted,
    )


def stretches(w: WeakRecord) -> list[slice]:
    """Rows of each contiguous stretch that is long enough."""
    counts = [
        len(range(w.grid.half, s.stop - s.start - w.grid.half, w.grid.stride))
        for s in w.grid.segments
    ]
    edges = np.concatenate([[0], np.cumsum(counts)]).astype(int).tolist()
    return [slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True) if b - a >= SHORTEST]


def _capped(records: Sequence[WeakRecord], most: int) -> list[tuple[int, slice]]:
    """Record and first rows of every stretch, the same share of each, so that they are about
    `most` in all.
    """
    parts = [(i, p) for i, w in enumerate(records) for p in stretches(w)]
    parts = parts[:: max(1, -(-len(parts) * SHORTEST // most))]
    share = min(1.0, most / max(sum(p.stop - p.start for _, p in parts), 1))
    return [
        (i, slice(p.start, p.start + max(round(share * (p.stop - p.start)), SHORTEST)))
        for i, p in parts
    ]


def _power(y: FloatArray) -> float:
    centred = y - y.mean()
    return float(np.sum(centred * centred))


def _io(w: WeakRecord, balance: str, rows: slice) -> tuple[FloatArray, FloatArray]:
    """Inputs (n, m) and measured torque (n, 1) of one stretch."""
    a = w.averaged
    twist = {
        "torsion": ("motor_position", "link_position"),
        "torsion_rate": ("motor_velocity", "link_velocity"),
    }
    columns = [
        (a[twist[n][0]] - a[twist[n][1]])[rows] if n in twist else a[n][rows]
        for n in _INPUTS[balance]
        if n in twist or n in a
    ]
    return np.column_stack(columns), measured(balance, w)[rows, None]


def _best(
    fit: Sequence[tuple[FloatArray, FloatArray]], test: Sequence[tuple[FloatArray, FloatArray]]
) -> tuple[str, float] | None:
    """Name and VAF of the linear model that simulates the test rows best."""
    # black boxes are loaded where one is fitted: no verb but the comparison needs them
    from identification.linear.blackbox import linear_ceiling

    u, y = np.concatenate([one for one, _ in fit]), np.concatenate([other for _, other in fit])
    size = u.std(axis=0)
    moving = size > 1e-9 * max(float(size.max()), 1e-300)
    moving &= np.concatenate([one for one, _ in test]).std(axis=0) > 0
    centre, scale, level = u.mean(axis=0)[moving], size[moving], y.mean(axis=0)
    if not moving.any() or not float(y.std()):
        return None

    def ready(
        parts: Sequence[tuple[FloatArray, FloatArray]],
    ) -> tuple[list[FloatArray], list[FloatArray]]:
        return [(one[:, moving] - centre) / scale for one, _ in parts], [
            other - level for _, other in parts
        ]

    for structures in (STRUCTURES, ("static",)):
        try:
            best = linear_ceiling(
                *ready(fit), structures=structures, orders=ORDERS, test=ready(test)
            )
        except InputError:  # stretches too short for the families with memory
            continue
        return best.best, float(best.vaf_percent[0])
    return None
