"""Linear models without physics of a joint's records: MOESP and the black boxes, each with its own
order, side by side on samples that none of them has seen.

The order of every family is chosen on the last quarter of each training stretch; the model is then
fitted to the whole of them. What is reported comes from the held-out records, or from the last
quarter of every record, which then has no part in fit or choice.

Sources: Ljung, System Identification, 2nd ed. (1999), chapters 4, 7 and 16; Verhaegen, Automatica
30 (1994) for MOESP; Van den Hof and Schrama, Automatica 29 (1993) 1523 for the two stages in closed
loop.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, final, get_args

import numpy as np
import numpy.typing as npt

from identification.data.joint_file import Joint
from identification.data.record import Record
from identification.errors import InputError
from identification.linear.blackbox import Structure, blackbox, simulated_vaf
from identification.linear.frequency import CURVE_POINTS, curve_of
from identification.linear.jackknife import pole_covariances
from identification.linear.poles import Pole, poles_of_matrix
from identification.linear.ports import (
    REFERENCE,
    Part,
    Ports,
    checked_motion,
    choose_ports,
    feedback,
    named_units,
    parts_of,
    rate,
    thinned,
)
from identification.linear.records import ArraySource
from identification.linear.shots import vaf_of_shots
from identification.linear.spectra import SHOWN_COHERENCE, Pair, Response, measure
from identification.linear.subspace import MoespOptions, Subspace, UnstableModelWarning, moesp

if TYPE_CHECKING:
    import control

FloatArray = npt.NDArray[np.float64]

FAMILIES: Final = ("moesp", *get_args(Structure))
FIR_ORDERS: Final = (5, 10, 20)
"""Lags of the response that are tried: at five samples per period of the highest frequency, one to
four such periods.
"""
HELD_PART: Final = 0.25
"""Last part of a stretch on which an order is chosen, or that is held out."""
SAME_RATE: Final = 0.01
"""Relative difference of two time steps that are one rate: poles read with either are alike within
it, which is less than they are known to.
"""
ALIKE, PERCENT = 1.1, 0.05
"""A lower order is kept while it leaves at most this much more variance: factor, and percent
points; as in the choice of a subspace model's order.
"""
MORE_STATES: Final = 2
"""Orders that a subspace model may have beyond those of a black box: its states serve all outputs.
"""
FIT_SAMPLES: Final = 20_000
"""Most samples used to fit."""
BLOCK_ROWS: Final = 20
SENSITIVITY_ORDER: Final = 5
"""Order of the output-error model from the reference to the input in the first of two stages: a
joint of fourth order and a pole of its controller.
"""


@final
@dataclass(frozen=True)
class LinearModel:
    """One family with the order chosen for it.

    Attributes
    ----------
    family : str
        One of :data:`FAMILIES`.
    order : int
    system : control.StateSpace or control.TransferFunction
        Discrete, from the inputs to the outputs.
    vaf_percent : (outputs,) array
        Variance of the held-out samples that a simulation accounts for, initial state and mean of
        each stretch its own; NaN where unstable.
    prediction_vaf_percent : (outputs,) array
        The same of the prediction one sample ahead; NaN where the model holds no noise model.
    spectral_radius : float
    poles : tuple of tuple of Pole
        Of every output; of a subspace model, whose poles are common, once.
    tried : tuple of (int, float)
        Orders with the mean VAF that chose among them [%].
    note : str
        What became of the fit, a sentence.
    pieces_vaf_percent : (outputs,) array or None
        Of an unstable subspace model: the VAF on pieces of 200 held-out samples, each from an
        initial state of its own.
    """

    family: str
    order: int
    system: control.StateSpace | control.TransferFunction
    vaf_percent: FloatArray
    prediction_vaf_percent: FloatArray
    spectral_radius: float
    poles: tuple[tuple[Pole, ...], ...]
    tried: tuple[tuple[int, float], ...]
    note: str
    pieces_vaf_percent: FloatArray | None = None

    @property
    def name(self) -> str:
        """Family and order."""
        return f"{self.family} {self.order}"

    @property
    def mean_vaf(self) -> float:
        """Over the outputs; minus infinity where the model cannot be simulated."""
        return float(np.mean(self.vaf_percent)) if np.isfinite(self.vaf_percent).all() else -np.inf

    def as_json(self, outputs: Sequence[str]) -> dict[str, Any]:
        """As data."""
        shared = len(self.poles) < len(outputs)
        return {
            "family": self.family,
            "order": self.order,
            "held_out_vaf_percent": dict(zip(outputs, self.vaf_percent.tolist(), strict=True)),
            "held_out_prediction_vaf_percent": dict(
                zip(outputs, self.prediction_vaf_percent.tolist(), strict=True)
            ),
            "pieces_vaf_percent": None
            if self.pieces_vaf_percent is None
            else dict(zip(outputs, self.pieces_vaf_percent.tolist(), strict=True)),
            "spectral_radius": self.spectral_radius,
            "poles": [p.as_json() for p in self.poles[0]]
            if shared and self.poles
            else {o: [p.as_json() for p in s] for o, s in zip(outputs, self.poles, strict=True)},
            "system": _matrices(self.system),
            "orders_tried": [{"order": n, "vaf_percent": v} for n, v in self.tried],
            "note": self.note,
        }


@final
@dataclass(frozen=True)
class LinearModels:
    """All families on the same records.

    Attributes
    ----------
    ports : Ports
    models : tuple of LinearModel
        The best simulation of the held-out samples first.
    fit_samples, held_out_samples : int
        After the thinning.
    held_out : str
        What was held out, a clause.
    closed_loop : bool or None
        True where a controller closes the loop; None where the records do not show one, which does
        not exclude it.
    instrument : bool
        True where the reference position was used as instrument.
    notes : tuple of str
        Sentences.
    """

    ports: Ports
    models: tuple[LinearModel, ...]
    fit_samples: int
    held_out_samples: int
    held_out: str
    closed_loop: bool | None
    instrument: bool
    notes: tuple[str, ...]

    @property
    def best(self) -> LinearModel:
        """The model that simulates the held-out samples best."""
        return self.models[0]

    def as_json(self) -> dict[str, Any]:
        """As data."""
        outputs = [n for n, _ in self.ports.outputs]
        return {
            "inputs": [{"name": n, "unit": u} for n, u in self.ports.inputs],
            "outputs": [{"name": n, "unit": u} for n, u in self.ports.outputs],
            "sampling_time_s": self.ports.dt,
            "every": self.ports.every,
            "link_referred": self.ports.link_referred,
            "fit_samples": self.fit_samples,
            "held_out_samples": self.held_out_samples,
            "held_out": self.held_out,
            "closed_loop": self.closed_loop,
            "instrument": REFERENCE if self.instrument else None,
            "best": self.best.name,
            "models": [m.as_json(outputs) for m in self.models],
            "notes": list(self.notes),
        }


def linear_models(
    records: Sequence[Record],
    held_out: Sequence[Record] = (),
    joint: Joint | None = None,
    *,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    families: Sequence[str] = FAMILIES,
    max_order: int = 6,
    every: int | None = None,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> LinearModels:
    """Fit every family, choose its order and judge it on samples that it has not seen.

    Parameters
    ----------
    records, held_out : sequence of Record
        SI units; without held-out records the last quarter of every stretch is held out.
    joint : Joint, optional
        Gear ratio and motor constant: signals are then link-referred, and the torsion q_m - q_l is
        an output where both positions are measured.
    inputs, outputs : sequence of str
        Channels; by default the drive, and the motor's velocity with the torsion.
    families : sequence of str
        Among :data:`FAMILIES`.
    max_order : int
        Highest order tried, 1 to 12; FIR takes 5, 10 and 20, and MOESP `MORE_STATES` more.
    every : int, optional
        Keep every so manyth sample; by default five samples per period of the highest frequency
        that input and output share.
    progress : callable
        ``progress(text, share)``.

    Returns
    -------
    LinearModels

    Raises
    ------
    InputError
        Signals that are missing or do not move; too few samples; no model that is stable.
    """
    _check(families, max_order, every)
    names = choose_ports([*records, *held_out], joint, inputs, outputs)
    raw, dt = parts_of(records, joint, names)
    unseen, other = parts_of(held_out, joint, names) if held_out else ([], dt)
    if abs(other / dt - 1.0) > SAME_RATE:
        raise InputError(
            f"the held-out records are sampled every {other:.6g} s, the others every {dt:.6g} s: "
            "resample them alike (irj resample)"
        )
    checked_motion(raw, [*names[0], *names[1]])
    kept = rate(raw, dt) if every is None else every
    closed, notes = _loop(raw)
    instrument = all(p.reference is not None for p in raw) and closed is True
    train, test = thinned(raw, kept), thinned(unseen, kept)
    if held_out:
        said = f"the held-out records: {', '.join(dict.fromkeys(p.record for p in test))}"
    else:
        train, test = _split(train)
        said = f"the last {100 * HELD_PART:.0f} % of every stretch"
    if test:
        checked_motion(test, [*names[0], *names[1]])
    train = _capped(train, notes)
    ports = Ports(
        named_units(names[0], joint),
        named_units(names[1], joint),
        kept * dt,
        kept,
        joint is not None,
    )
    fitted, short = [], []
    bench = _Bench(_two_stage(train) if instrument else train, test, ports.dt, max_order)
    for k, family in enumerate(families):
        progress(f"{family} models", k / len(families))
        try:
            fitted.append(bench.fit(family))
        except InputError as error:
            short.append(f"{family} is left out: {error}")
    if not any(np.isfinite(m.mean_vaf) or m.pieces_vaf_percent is not None for m in fitted):
        why = short[0] if short else "every model tried is unstable; record longer"
        raise InputError(f"no linear model could be judged: {why}")
    ordered = sorted(fitted, key=lambda m: (m.family == "arma", -m.mean_vaf))
    return LinearModels(
        ports,
        tuple(ordered),
        fit_samples=sum(len(p.u) for p in train),
        held_out_samples=sum(len(p.u) for p in test),
        held_out=said,
        closed_loop=closed,
        instrument=instrument,
        notes=(*notes, *short),
    )


def responses(
    found: LinearModels, records: Sequence[Record], joint: Joint | None
) -> list[Response]:
    """Frequency response of the best model over the measured one, one for each output, from the
    first input.

    Outputs whose response is measured over too narrow a band are left out.
    """
    names = tuple(tuple(n for n, _ in p) for p in (found.ports.inputs, found.ports.outputs))
    parts, dt = parts_of(records, joint, (names[0], names[1]))
    drawn = []
    for k, (output, unit) in enumerate(found.ports.outputs):
        source, per = found.ports.inputs[0]
        pairs = [
            Pair(p.u[:, 0], p.y[:, k], p.reference if found.instrument else None, dt, 0)
            for p in parts
        ]
        seen = measure(pairs, f"{source} to {output}".replace("_", " "), f"{unit} per {per}")
        if seen is None:
            continue
        shown = seen.frequency[seen.coherence >= SHOWN_COHERENCE]
        top = min(float(shown[-1]), 0.45 / found.ports.dt)
        grid = np.geomspace(float(shown[0]), top, CURVE_POINTS)
        poles = found.best.poles[k if len(found.best.poles) > 1 else 0] if found.best.poles else ()
        drawn.append(
            replace(
                seen,
                curves=(
                    curve_of(
                        f"model {found.best.name}",
                        partial(_answer, found, k),
                        np.array([2j * np.pi * _rate(p) for p in poles]),
                        seen,
                        grid,
                    ),
                ),
            )
        )
    return drawn


def _answer(found: LinearModels, output: int, frequency: FloatArray) -> npt.NDArray[np.complex128]:
    """Response of the best model from the first input to one output."""
    at = np.exp(2j * np.pi * frequency * found.ports.dt)
    return np.asarray(found.best.system(at, squeeze=False)[output, 0], dtype=np.complex128)


def _rate(one: Pole) -> complex:
    """s / (2 pi j) of a pole [Hz]."""
    if not np.isfinite(one.frequency) or not np.isfinite(one.damping):
        return 0j
    return complex(
        one.frequency * np.sqrt(max(1.0 - one.damping**2, 0.0)), one.frequency * one.damping
    )


def _check(families: Sequence[str], max_order: int, every: int | None) -> None:
    unknown = [f for f in families if f not in FAMILIES]
    if unknown or not families:
        raise InputError(
            f"family {unknown[0] if unknown else ''!r} is unknown: choose among "
            f"{', '.join(FAMILIES)}"
        )
    if not 1 <= max_order <= 12:
        raise InputError(f"max_order is {max_order}: give 1 to 12")
    if every is not None and every < 1:
        raise InputError(f"every is {every}: give 1 or more")


def _loop(parts: Sequence[Part]) -> tuple[bool | None, list[str]]:
    """Whether the loop is closed, and the sentence that says what follows."""
    if all(p.reference is not None for p in parts):
        return True, [
            "The records hold a reference position, so a controller closes the loop: the part of "
            "the input that the reference explains is the instrument."
        ]
    if feedback(parts):
        return True, [
            "A controller closes the loop (past outputs predict the input) and the records hold "
            "no reference_position as an instrument: poles and gains are biased where noise and "
            "friction reach the drive, those of fir, oe and moesp most; the held-out VAF does not "
            "show it."
        ]
    return None, [
        "No feedback from the outputs to the input shows. If a controller made the drive all the "
        "same, add its reference_position: without an instrument a closed loop biases the models."
    ]


def _split(parts: Sequence[Part]) -> tuple[list[Part], list[Part]]:
    cuts = [round((1.0 - HELD_PART) * len(p.u)) for p in parts]
    early = [p.cut(0, c) for p, c in zip(parts, cuts, strict=True)]
    return early, [p.cut(c, len(p.u)) for p, c in zip(parts, cuts, strict=True)]


def _capped(parts: list[Part], notes: list[str]) -> list[Part]:
    total = sum(len(p.u) for p in parts)
    if total <= FIT_SAMPLES:
        return parts
    notes.append(
        f"Of {total} samples the first {FIT_SAMPLES / total:.0%} of each stretch is fitted."
    )
    return [p.cut(0, max(round(len(p.u) * FIT_SAMPLES / total), 2)) for p in parts]


def _two_stage(parts: Sequence[Part]) -> list[Part]:
    """The inputs as far as the reference explains them, which noise in the loop does not reach."""
    references = [np.asarray(p.reference)[:, None] for p in parts]
    explained = [np.empty_like(p.u) for p in parts]
    for channel in range(parts[0].u.shape[1]):
        targets = [p.u[:, channel : channel + 1] for p in parts]
        found = blackbox(references, targets, "oe", SENSITIVITY_ORDER, held_out=0.0)
        for k, one in enumerate(found.simulate(references, targets)):
            explained[k][:, channel] = one[:, 0]
    return [replace(p, u=u) for p, u in zip(parts, explained, strict=True)]


@final
class _Bench:
    """Fits one family after the other to the same samples."""

    def __init__(
        self, train: Sequence[Part], test: Sequence[Part], dt: float, max_order: int
    ) -> None:
        self._train, self._test, self._dt = list(train), list(test), dt
        self._max_order = max_order
        early, late = _split(train)
        self._early, self._late = early, late
        self._size = np.concatenate([p.y for p in train]).std(axis=0)

    def fit(self, family: str) -> LinearModel:
        """The family with the order that the late part of the training samples chooses."""
        return self._moesp() if family == "moesp" else self._blackbox(family)  # type: ignore[arg-type]

    def _blackbox(self, family: Structure) -> LinearModel:
        orders = FIR_ORDERS if family == "fir" else range(1, self._max_order + 1)
        tried: list[tuple[int, float]] = []
        refusal: InputError | None = None
        for order in orders:
            try:
                found = blackbox(*_lists(self._early), family, order, self._dt, held_out=0.0)
                tried.append((order, self._judged(found, family)))
            except InputError as error:  # too few samples for this order and all above
                refusal = error
                break
        if not tried:
            raise refusal or InputError("no order was tried")
        order = _lowest(tried)
        final = blackbox(*_lists(self._train), family, order, self._dt, held_out=0.0)
        pairs = [(p.u, p.y) for p in self._test]
        return LinearModel(
            family,
            order,
            system=final.system,
            vaf_percent=simulated_vaf(pairs, final.polynomials),
            prediction_vaf_percent=simulated_vaf(pairs, final.polynomials, ahead=True),
            spectral_radius=final.spectral_radius,
            poles=final.poles,
            tried=tuple(tried),
            note=final.outcome.value,
        )

    def _judged(self, found: Any, family: str) -> float:
        pairs = [(p.u, p.y) for p in self._late]
        return float(np.mean(simulated_vaf(pairs, found.polynomials, ahead=family == "arma")))

    def _moesp(self) -> LinearModel:
        u, y = _lists(self._train)
        weights = tuple(float(w) for w in 1.0 / self._size)
        rows = min(BLOCK_ROWS, max(max(len(one) for one in u) // 8, 2))
        options = MoespOptions(
            output_weights=weights, max_order=self._max_order + MORE_STATES, noise=True
        )

        def made(order: int | None) -> Subspace:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UnstableModelWarning)
                return moesp(u, y, rows, order, self._dt, "past_output", options=options)

        found = first = made(None)
        note, pieces = first.outcome.value, None
        tried = tuple((one.order, 100.0 - one.unexplained_percent) for one in first.candidates)
        if first.spectral_radius >= 1.0:
            pieces = self._pieces(first, np.array(weights))
            for one in sorted(first.candidates, key=lambda c: (c.unexplained_percent, c.order)):
                other = made(one.order)
                if other.spectral_radius < 1.0:
                    found = other
                    note = (
                        f"The order that short pieces of the records favour, {first.order}, gives "
                        "an unstable model; this is the best stable one."
                    )
                    break
        a = np.asarray(found.system.A, dtype=np.float64)
        stable = found.spectral_radius < 1.0
        known = pole_covariances(list(zip(u, y, strict=True)), rows, a, "past_output", weights)
        return LinearModel(
            "moesp",
            found.order,
            system=found.system,
            vaf_percent=found.vaf_on(*_lists(self._test))
            if stable
            else np.full(len(weights), np.nan),
            prediction_vaf_percent=self._ahead(found),
            spectral_radius=found.spectral_radius,
            poles=(poles_of_matrix(a, self._dt, known),),
            tried=tried,
            note=note,
            pieces_vaf_percent=pieces,
        )

    def _ahead(self, found: Subspace) -> FloatArray:
        error = total = np.zeros(len(self._size))
        for p in self._test:
            left = p.y - found.predict(p.u, p.y)
            error = error + np.sum((left - left.mean(axis=0)) ** 2, axis=0)
            total = total + np.sum((p.y - p.y.mean(axis=0)) ** 2, axis=0)
        return np.asarray(100.0 * (1.0 - error / total), dtype=np.float64)

    def _pieces(self, found: Subspace, weights: FloatArray) -> FloatArray:
        source = ArraySource(*_lists(self._test))
        spans = [(k, 0, n) for k, n in enumerate(source.lengths)]
        a, b, c, d = (
            np.asarray(m, dtype=np.float64)
            for m in (found.system.A, found.system.B, found.system.C, found.system.D)
        )
        scaled = (a, b, c * weights[:, None], d * weights[:, None])
        return vaf_of_shots(source, spans, scaled, weights)


def _matrices(system: control.StateSpace | control.TransferFunction) -> dict[str, Any]:
    """A, B, C and D, or numerators and denominators in powers of z, by output and input."""
    if hasattr(system, "A"):
        return {k: np.asarray(getattr(system, k)).tolist() for k in "ABCD"}
    return {
        k: [[np.asarray(one).tolist() for one in row] for row in getattr(system, k)]
        for k in ("num", "den")
    }


def _lists(parts: Sequence[Part]) -> tuple[list[FloatArray], list[FloatArray]]:
    return [p.u for p in parts], [p.y for p in parts]


def _lowest(tried: Sequence[tuple[int, float]]) -> int:
    """The lowest order that leaves about as little as the best one; the lowest where none could be
    simulated.
    """
    known = [(n, 100.0 - v) for n, v in tried if np.isfinite(v)]
    if not known:
        return tried[0][0]
    best = min(left for _, left in known)
    return next(n for n, left in known if left <= ALIKE * best + PERCENT)
