"""Compare: how far a fitted model is from records, and where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models.hold import HOLD_NAME
from identification.balance.balances import Balances
from identification.balance.calibration import settled
from identification.balance.excitation import rest_note
from identification.balance.rest import rest_check, rest_warnings
from identification.data.check.gate import gate_warnings, gated
from identification.data.record import Record, listed
from identification.diagnosis.places import Place, gather, places_of, worst_window
from identification.diagnosis.session import refuse_unlike, timed_bench
from identification.fitting.assess import Error, assess, over_noise
from identification.fitting.engine import stack
from identification.fitting.fit import Fit
from identification.representation import html_of

if TYPE_CHECKING:
    from identification.linear.ceiling import Ceiling

FloatArray = npt.NDArray[np.float64]

WORST: Final = 1.0
"""Length of the window in which a model is said to fail most [s]."""


@final
@dataclass(frozen=True)
class Comparison:
    """Model against records.

    Attributes
    ----------
    error : Error
    places : tuple of Place
        The most telling first.
    worst_window : tuple of float
        Start and end of the second with the largest residual [s].
    whiteness : mapping of str to float
        Autocorrelation of each residual one kernel length later.
    linear : Ceiling or None
        What linear models without physics explain; None where not asked for, or where the records
        are too short.
    at_rest : float
        Share of the rows in which the joint stands still: left out of errors and places.
    at_rest_beyond : tuple of str
        What these rows leave beyond sticking friction, a sentence for each balance in which they
        do.
    warnings : tuple of str
        What the check gate said about the records.
    fitted_to : tuple of str
        Records that the values were fitted to; none where they were all known before.
    """

    name: str
    error: Error
    places: tuple[Place, ...]
    worst_window: tuple[float, float]
    whiteness: dict[str, float]
    linear: Ceiling | None = None
    at_rest: float = 0.0
    at_rest_beyond: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    fitted_to: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Errors and places as data."""
        return {
            "record": self.name,
            **self.error.as_json(),
            "worst_window_s": list(self.worst_window),
            "whiteness": self.whiteness,
            "places": [p.as_json() for p in self.places],
            "linear_ceiling": self.linear.as_json() if self.linear else None,
            "at_rest_percent": 100 * self.at_rest,
            "at_rest_beyond": list(self.at_rest_beyond),
            "warnings": list(self.warnings),
            "fitted_to": list(self.fitted_to),
        }

    def __str__(self) -> str:
        ratios = ", ".join(
            f"{b} {e.ratio:.3g} times its floor" for b, e in self.error.balances.items()
        )
        first = next((p for p in self.places if p.tells), None)
        top = (
            f"; fails most against {first.axis.replace('_', ' ')} ({first.balance} balance)"
            if first
            else ""
        )
        linear = f"\n{self.linear}" if self.linear else ""
        still = "".join(
            f"\n{line}" for line in (rest_note(self.at_rest), *self.at_rest_beyond) if line
        )
        return (
            f"{self.name}: fit {self.error.fit_percent:.3g} %, relative error "
            f"{self.error.relative_error_percent:.3g} % ({ratios}){top}{still}{linear}"
        )

    def __repr__(self) -> str:
        return (
            f"Comparison({self.name!r}, {self.error.relative_error_percent:.3g} % relative "
            f"error, {len(self.places)} places)"
        )

    def _repr_html_(self) -> str | None:
        return html_of(self)


def compare(fitted: Fit, records: Record | Sequence[Record], *, linear: bool = True) -> Comparison:
    """Compare a fitted model with records it may never have seen.

    Parameters
    ----------
    fitted : Fit
    records : Record or sequence of Record
    linear : bool
        Fit linear models without physics too, as a ceiling (see
        :mod:`identification.linear.ceiling`). It takes a second or two whatever the length of the
        records.

    Raises
    ------
    InputError
        Records that the gate refuses, with other channels than those of the fit, or in unlike
        units.
    """
    given = gated(listed(records), fitted.joint)
    unseen = not any(_same(r, seen) for r in given for seen in fitted.records)
    # records of its own are judged as the loop judges the training records, others as it judges
    # held-out ones: one figure for one state
    train, held = (list(fitted.records), given) if unseen else (given, [])
    bench = timed_bench(  # as at every door
        fitted.joint, train, held, kernel=fitted.data.kernel, like=fitted.data.sensing
    )
    data = bench.data
    compared = data.held_out if unseen else data.train
    values = settled(fitted.model, data.sensing, [*data.train, *compared], fitted.solution.values)
    error = bench.judged(
        fitted.solution, assess(fitted.model, data, compared, values), held_out=unseen
    )
    refuse_unlike(
        replace(fitted.data, held_out=compared, held_out_names=tuple(r.name for r in given)),
        error.relative_error_percent,
    )
    stacked = stack(Balances(fitted.model, data.sensing, wrt=()), compared, values)
    residual = stacked.residual
    places = places_of(stacked.shown, gather(data))
    time = np.concatenate([w.time for w in compared])
    power = sum(x**2 for x in over_noise(error, compared).values())
    counts = np.cumsum([0, *(int(w.stretch.max(initial=0)) + 1 for w in compared)])
    stretch = np.concatenate(
        [w.stretch + first for w, first in zip(compared, counts[:-1], strict=True)]
    )
    worst = worst_window(time, np.asarray(power), WORST, stretch)
    floor = {b: e.floor for b, e in error.balances.items()}
    above = None
    # what a drive holds is found in each run, as its clocks are: that is no fit
    own = any(n != HOLD_NAME for n in fitted.solution.free)
    if linear:  # the one place that fits models without physics: no other verb loads them
        from identification.linear.ceiling import ceiling

        above = ceiling(fitted.data, compared, residual, floor, unseen=unseen, fitted=own)
    return Comparison(
        ", ".join(r.name for r in given),
        error,
        places=places,
        worst_window=worst,
        whiteness={b: _lagged(r[stacked.taking[b]]) for b, r in residual.items()},
        linear=above,
        at_rest=data.at_rest(compared),
        at_rest_beyond=rest_warnings(
            rest_check(fitted.model, data, compared, values),
            "N.m" if data.joint.kind == "rotary" else "N",
        ),
        warnings=gate_warnings(given),
        fitted_to=tuple(r.name for r in fitted.records) if own else (),
    )


def _same(one: Record, other: Record) -> bool:
    """True where two records hold the same samples of the same files."""
    if one is other:
        return True
    if not one.provenance.sha256 or one.provenance.sha256 != other.provenance.sha256:
        return False
    return len(one) == len(other) and bool(np.array_equal(one.time[[0, -1]], other.time[[0, -1]]))


def _lagged(r: FloatArray, lag: int = 4) -> float:
    x = r - r.mean()
    power = float(x @ x)
    return float(x[:-lag] @ x[lag:] / power) if power > 0 and len(x) > lag else 0.0
