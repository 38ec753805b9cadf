"""FIR, ARX, ARMA, ARMAX, ARARX, ARARMAX, output-error and Box-Jenkins models by prediction error.

They know nothing of the joint. What they explain on held-out data is the share
of the output that any linear model of that size can explain: a ceiling to hold a
linear physical model against, and a floor for a nonlinear one.

Source: Ljung, System Identification, 2nd ed. (1999), sections 4.2, 7.2, 10.2 and 10.6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Literal, final, get_args

import numpy as np
import numpy.typing as npt

from identification.errors import InputError
from identification.linear.poles import Pole, poles_of
from identification.linear.prediction_error import (
    FloatArray,
    Orders,
    Polynomials,
    Records,
    coefficient_spread,
    held_out_error,
    prediction_error,
    prediction_error_fit,
    rows_needed,
)
from identification.linear.records import ArraySource, whole_records

if TYPE_CHECKING:
    import control

__all__ = [
    "BlackBox",
    "BlackBoxOutcome",
    "LinearCeiling",
    "Structure",
    "blackbox",
    "linear_ceiling",
]

Structure = Literal["fir", "arx", "arma", "armax", "ararx", "ararmax", "oe", "bj"]
Tried = Literal["static", "fir", "arx", "armax", "ararx", "ararmax", "oe", "bj", "moesp"]
# time constants of a model's free motion in a test record, at least
_FADES = 10.0
_Arrays = npt.ArrayLike | Sequence[npt.NDArray[np.generic]]


@final
class BlackBoxOutcome(Enum):
    """What became of a prediction-error fit, in a sentence."""

    CONVERGED = "The prediction error has reached a minimum; the model is stable."
    EVALUATION_LIMIT = "The evaluations ran out before a minimum was reached; the model is stable."
    UNSTABLE = (
        "The model predicts one step ahead but is unstable in simulation: take oe or bj, "
        "whose poles are kept stable."
    )


@final
@dataclass(frozen=True)
class BlackBox:
    """A fitted black-box model.

    Attributes
    ----------
    system : control.TransferFunction
        From the inputs to the outputs, discrete time.
    structure : {"fir", "arx", "arma", "armax", "ararx", "ararmax", "oe", "bj"}
    order : int
    polynomials : tuple of Polynomials
        A, B, C, D, F of every output, in powers of the backward shift.
    vaf_percent : ndarray, shape (outputs,)
        Variance accounted for in simulation of the held-out samples;
        of the whole record where none was held out. NaN where unstable.
    spectral_radius : float
        Largest pole modulus.
    outcome : BlackBoxOutcome
    prediction_vaf_percent : ndarray, shape (outputs,)
        Variance accounted for by the prediction one sample ahead, on the same samples.
    poles : tuple of tuple of Pole
        Of every output, with the deviation that the noise gives them.
    """

    system: control.TransferFunction
    structure: Structure
    order: int
    polynomials: tuple[Polynomials, ...]
    vaf_percent: FloatArray
    spectral_radius: float
    outcome: BlackBoxOutcome
    prediction_vaf_percent: FloatArray
    poles: tuple[tuple[Pole, ...], ...]

    def simulate(self, u: _Arrays, y: _Arrays) -> list[FloatArray]:
        """Response to `u`, one array (samples, outputs) per record, with the initial conditions and
        means that fit `y` best.
        """
        return [
            other
            - np.column_stack(
                [held_out_error(one, other[:, k], p) for k, p in enumerate(self.polynomials)]
            )
            for one, other in whole_records(ArraySource(u, y))
        ]


@final
@dataclass(frozen=True)
class LinearCeiling:
    """How much of the output a linear model without physics explains.

    Attributes
    ----------
    vaf_percent : ndarray, shape (outputs,)
        Of the best model, in simulation of samples used neither to fit nor to choose it.
    best : str
        Name of the best model, for example ``"oe 4"``.
    tried : tuple of (str, float)
        Every model and the mean VAF that chose among them, in percent, best first.
    """

    vaf_percent: FloatArray
    best: str
    tried: tuple[tuple[str, float], ...]


def blackbox(
    u: _Arrays,
    y: _Arrays,
    structure: Structure = "oe",
    order: int = 2,
    dt: float = 1.0,
    *,
    delay: int = 0,
    held_out: float = 0.25,
) -> BlackBox:
    """Fit a black-box model to inputs and outputs by prediction error.

    Each output has its own model from all inputs, with common denominators.

    Parameters
    ----------
    u, y : array_like, shape (samples, channels), or lists of such arrays
        Inputs and outputs; a list holds one array per record. Remove offsets before.
    structure : {"fir", "arx", "arma", "armax", "ararx", "ararmax", "oe", "bj"}
        ``y = B u + e``, ``A y = B u + e``, ``A y = C e``, ``A y = B u + C e``,
        ``A y = B u + 1/D e``, ``A y = B u + C/D e``, ``y = B/F u + e``, ``y = B/F u + C/D e``.
        "arma" has no input: it predicts one sample ahead, and simulates nothing.
    order : int
        Order of every polynomial, 1 to 20; B has ``order + 1`` coefficients.
    dt : float
        Sampling time in s.
    delay : int
        Samples of pure delay before B, 0 or more.
    held_out : float
        Part of each record, at the end, that judges the model; 0 to 0.5.

    Returns
    -------
    BlackBox

    Raises
    ------
    InputError
        If the records hold NaN, a constant channel, too few samples or unequal lengths.
    """
    if structure not in get_args(Structure):
        raise InputError(
            f"structure {structure!r} is unknown: choose one of {', '.join(get_args(Structure))}"
        )
    if not 1 <= order <= 20:
        raise InputError(f"order is {order}: give 1 to 20")
    if not 0 <= delay <= 1000:
        raise InputError(f"delay is {delay}: give 0 to 1000 samples")
    if not 0.0 <= held_out <= 0.5:
        raise InputError(f"held_out is {held_out}: give 0 to 0.5")
    if not (np.isfinite(dt) and dt > 0):
        raise InputError(f"dt is {dt}: give the sampling time in s, more than 0")
    records = whole_records(ArraySource(u, y))
    train, test = _split(records, 1.0 - held_out)
    return _fit_all(train, test if held_out > 0 else train, structure, order, delay, dt)


def linear_ceiling(
    u: _Arrays,
    y: _Arrays,
    dt: float = 1.0,
    *,
    structures: Sequence[Tried] = ("arx", "oe", "moesp"),
    orders: Sequence[int] = (2, 4, 6),
    fit_samples: int = 20_000,
    test: tuple[_Arrays, _Arrays] | None = None,
) -> LinearCeiling:
    """Share of the output that a linear model without physics explains on held-out data.

    Models are fitted on the first half of each record, the best is chosen by
    its simulation of the third quarter, and its VAF is taken on the last quarter,
    which had no part in either. Initial states are estimated on every part.
    With `test`, models are fitted on the whole of each record, and the VAF is that of
    the one that simulates `test` best: a ceiling for all the models tried. Models whose
    free motion fades slower than a tenth of a test record are then left out: with an
    initial state of their own they would draw an oscillation that no input explains.

    Parameters
    ----------
    u, y : array_like, shape (samples, channels), or lists of such arrays
        Inputs and outputs; a list holds one array per record. Remove offsets before.
    dt : float
        Sampling time in s.
    structures : sequence of str
        Model families tried: those of `blackbox` but "arma", which has no input; "moesp"; and
        "static", ``y = B u`` of no order.
    orders : sequence of int
        Orders tried, each 1 to 20.
    fit_samples : int
        Most samples of a record used to fit; later ones of the part to fit are left out.
    test : tuple of two array_like or lists, optional
        Inputs and outputs of held-out records.

    Returns
    -------
    LinearCeiling

    Raises
    ------
    InputError
        If the input cannot be used, or no model tried is stable.
    """
    records = whole_records(ArraySource(u, y))
    if not structures or not orders:
        raise InputError("no structure or no order to try: give at least one of each")
    for structure in structures:
        if structure not in get_args(Tried):
            raise InputError(
                f"structure {structure!r} is unknown: choose among {', '.join(get_args(Tried))}"
            )
    if any(not 1 <= order <= 20 for order in orders):
        raise InputError(f"orders are {tuple(orders)}: give 1 to 20")
    if test is None:
        early, late = _split(records, 0.5)
        select, report = _split(late, 0.5)
        slowest = 1.0
    else:
        early, select = records, list(whole_records(ArraySource(*test)))
        report = select
        slowest = 1.0 - _FADES / float(np.median([len(one) for one, _ in select]))
    early = [(one[:fit_samples], other[:fit_samples]) for one, other in early]
    results: list[tuple[float, str, FloatArray]] = []
    for structure, order in [
        (s, n) for s in structures for n in ((0,) if s == "static" else orders)
    ]:
        name = f"{structure} {order}" if order else structure
        chosen_by, reported = _try(early, (select, report), (structure, order), slowest)
        results.append((float(np.mean(chosen_by)), name, reported))
    stable = sorted(
        (result for result in results if np.isfinite(result[0])), key=lambda result: -result[0]
    )
    if not stable:
        raise InputError(
            "every linear model tried is unstable: record longer, or remove offsets and "
            "integrating channels"
        )
    return LinearCeiling(stable[0][2], stable[0][1], tuple((name, vaf) for vaf, name, _ in stable))


def _try(
    train: Records, parts: tuple[Records, Records], model: tuple[Tried, int], slowest: float
) -> tuple[FloatArray, FloatArray]:
    """VAF of one model on the part that selects and on the part that reports; NaN where its
    spectral radius reaches `slowest`.
    """
    structure, order = model
    if structure == "moesp":
        return _try_moesp(train, parts, order, slowest)
    orders = Orders("arx" if structure == "static" else structure, order, 0, train[0][0].shape[1])
    polynomials = tuple(fit[0] for fit in _fits(train, (*parts[0], *parts[1]), orders))
    if max(one.spectral_radius for one in polynomials) >= slowest:
        return np.full(len(polynomials), np.nan), np.full(len(polynomials), np.nan)
    chosen_by = simulated_vaf(parts[0], polynomials)
    return chosen_by, chosen_by if parts[0] is parts[1] else simulated_vaf(parts[1], polynomials)


def _try_moesp(
    train: Records, parts: tuple[Records, Records], order: int, slowest: float
) -> tuple[FloatArray, FloatArray]:
    from identification.linear.hankel_qr import HankelQR
    from identification.linear.response_fit import ResponseFit

    inputs, outputs = train[0][0].shape[1], train[0][1].shape[1]
    qr = HankelQR(inputs, outputs, max(10, 2 * order), "past_output")
    for one, other in train:
        qr.add(one, other)
        qr.end_record()
    factor = qr.factor()
    a, c = factor.realise(factor.directions()[0], order)
    if float(np.abs(np.linalg.eigvals(a)).max()) >= slowest:
        return np.full(outputs, np.nan), np.full(outputs, np.nan)

    def response(part: Records) -> ResponseFit:
        fit = ResponseFit(a, c, inputs)
        for one, other in part:
            fit.add(one, other)
            fit.end_record()
        return fit

    solved = response(train).solve()
    fits = [response(part) for part in (parts[:1] if parts[0] is parts[1] else parts)]
    vaf = [
        fit.vaf_percent(solved.b, solved.d, fit.initial_states(solved.b, solved.d)) for fit in fits
    ]
    return vaf[0], vaf[-1]


def _fits(
    train: Records, test: Records | tuple[tuple[FloatArray, FloatArray], ...], orders: Orders
) -> list[tuple[Polynomials, bool]]:
    """Polynomials of every output and whether a minimum was reached."""
    shortest = min(len(one) for one, _ in (*train, *test))
    if shortest < rows_needed(orders):
        raise InputError(
            f"a record leaves {shortest} samples after holding out, {rows_needed(orders)} are "
            "needed: record longer or lower the order"
        )
    outputs = train[0][1].shape[1]
    return [
        prediction_error_fit([(one, other[:, k]) for one, other in train], orders)
        for k in range(outputs)
    ]


def _fit_all(
    train: Records, test: Records, structure: Structure, order: int, delay: int, dt: float
) -> BlackBox:
    import control

    inputs = train[0][0].shape[1]
    orders = Orders(structure, order, delay, 0 if structure == "arma" else inputs)
    fits = _fits(train, test, orders)
    polynomials = tuple(fit[0] for fit in fits)
    radius = max(polynomial.spectral_radius for polynomial in polynomials)
    numerators = [
        [list(row) for row in polynomial.b] or [[0.0] for _ in range(inputs)]
        for polynomial in polynomials
    ]
    denominators = [[list(polynomial.denominator)] * inputs for polynomial in polynomials]
    for rows, others in zip(numerators, denominators, strict=True):
        for k, row in enumerate(rows):
            # in powers of z both must be written to the same length
            size = max(len(row), len(others[k]))
            rows[k] = row + [0.0] * (size - len(row))
            others[k] = others[k] + [0.0] * (size - len(others[k]))
    if radius >= 1.0:
        outcome = BlackBoxOutcome.UNSTABLE
    else:
        converged = all(fit[1] for fit in fits)
        outcome = BlackBoxOutcome.CONVERGED if converged else BlackBoxOutcome.EVALUATION_LIMIT
    return BlackBox(
        system=control.TransferFunction(numerators, denominators, dt),
        structure=structure,
        order=order,
        polynomials=polynomials,
        vaf_percent=simulated_vaf(test, polynomials),
        spectral_radius=radius,
        outcome=outcome,
        prediction_vaf_percent=simulated_vaf(test, polynomials, ahead=True),
        poles=tuple(_poles(train, orders, k, one, dt) for k, one in enumerate(polynomials)),
    )


def _poles(
    train: Records, orders: Orders, output: int, model: Polynomials, dt: float
) -> tuple[Pole, ...]:
    if not orders.poles:
        return ()
    spread = coefficient_spread([(u, y[:, output]) for u, y in train], orders, model)
    return poles_of(model.denominator, dt, spread.denominator)


def simulated_vaf(
    records: Records, polynomials: tuple[Polynomials, ...], *, ahead: bool = False
) -> FloatArray:
    """VAF of the simulation, or of the prediction one sample ahead, per output [%].

    Parameters
    ----------
    records : list of (u, y)
        Arrays (samples, channels); initial conditions and means of each are fitted.
    polynomials : tuple of Polynomials
        One per output.
    ahead : bool
        Predict one sample ahead in place of a simulation.
    """
    vaf = np.full(len(polynomials), np.nan)
    of = prediction_error if ahead else held_out_error
    for k, polynomial in enumerate(polynomials):
        if ahead or polynomial.spectral_radius < 1.0:
            error = total = 0.0
            for u, y in records:
                error += float(np.sum(of(u, y[:, k], polynomial) ** 2))
                total += float(np.sum((y[:, k] - y[:, k].mean()) ** 2))
            vaf[k] = 100.0 * (1.0 - error / total) if total > 0 else np.nan
    return vaf


def _split(records: Records, part: float) -> tuple[Records, Records]:
    cuts = [round(part * len(one)) for one, _ in records]
    early = [(one[:cut], other[:cut]) for (one, other), cut in zip(records, cuts, strict=True)]
    late = [(one[cut:], other[cut:]) for (one, other), cut in zip(records, cuts, strict=True)]
    return early, late
