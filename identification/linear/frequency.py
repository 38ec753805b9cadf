"""Frequency responses of a joint: measured, subspace model and physical model, over each other.

Two responses are taken. Motor velocity to link velocity holds the transmission and the link; it
needs both positions. Drive torque to motor velocity holds the whole joint; it needs the reference
position, which serves as instrument: in a control loop the plain ratio of output to input shows the
inverse of the controller wherever the reference has little power (Ljung, System Identification, 2nd
ed., 1999, sections 13.4 and 13.5), and does so with perfect coherence.

The measured response is the averaged cross spectrum over the averaged input spectrum (Welch). The
physical model is linearised along the motion, since a linearisation at rest turns Coulomb friction
into a damper of any size: mean Jacobian for positions and drive, equivalent gain E[f(v) v] / E[v^2]
for velocities (statistical linearisation: Roberts and Spanos, Random Vibration and Statistical
Linearization, 1990).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np
import numpy.typing as npt

from casadi_models import JointModel
from identification.data.record import Record, listed
from identification.errors import InputError
from identification.fitting.engine import Dataset
from identification.linear.spectra import (
    ACROSS,
    SHOWN_COHERENCE,
    THROUGH,
    Curve,
    Pair,
    Resonance,
    Response,
    differencing,
    measure,
    stretches,
)
from identification.representation import html_of

if TYPE_CHECKING:
    import control

    from identification.fitting.fit import Fit

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

SUBSPACE_SAMPLES: Final = 40_000
STATES: Final = 2_000
"""States over which the physical model is linearised, at most."""
CURVE_POINTS: Final = 240
USED_BAND: Final = 0.45
"""Part of the sampling rate up to which a discrete model is drawn: at the half its curve ends in a
spike or a zero that the joint does not have.
"""
SUBSPACE, PHYSICAL = "subspace model", "physical model"


@final
@dataclass(frozen=True)
class Bode:
    """Responses of a joint.

    Attributes
    ----------
    responses : tuple of Response
        One or two.
    notes : tuple of str
        What could not be drawn and why, sentences.
    """

    responses: tuple[Response, ...]
    notes: tuple[str, ...]

    def _repr_html_(self) -> str | None:
        return html_of(self)


def bode(fitted: Fit, records: Record | Sequence[Record] | None = None) -> Bode | None:
    """Frequency responses of a fitted joint.

    Parameters
    ----------
    fitted : Fit
    records : Record or sequence of Record, optional
        Where the response is measured; those of the fit by default.

    Returns
    -------
    Bode or None
        None where the records excite too narrow a band, lack the channels, or are too short.
    """
    given = fitted.records if records is None else tuple(listed(records))
    return bode_of(fitted.model, fitted.data, given)


def bode_of(model: JointModel, data: Dataset, records: Sequence[Record]) -> Bode | None:
    """As :func:`bode`, from the parts of a fit; records with another payload than the first are
    left out.
    """
    alike = [r for r in records if r.payload == records[0].payload]
    parts = stretches(alike, data.joint, data.sensing)
    if not parts:
        return None
    notes = ["Left out: records with another payload."] if len(alike) < len(records) else []
    unit = "m/s per N" if data.joint.kind == "linear" else "rad/s per N.m"
    found: list[Response] = []
    if data.sensing.both_positions:
        _add(found, _drawn(model, data, [s.across for s in parts], (ACROSS, "1"), notes))
    if data.sensing.has_drive and all(s.reference is not None for s in parts):
        _add(found, _drawn(model, data, [s.through for s in parts], (THROUGH, unit), notes))
    elif data.sensing.has_drive:
        notes.append(
            "Drive torque to motor velocity is not drawn: in a control loop it can be measured "
            "only "
            "with the reference position in the record (channel reference_position)."
        )
    return Bode(tuple(found), tuple(dict.fromkeys(notes))) if found else None


def _add(found: list[Response], one: Response | None) -> None:
    if one is not None:
        found.append(one)


def _drawn(
    model: JointModel,
    data: Dataset,
    parts: Sequence[Pair],
    names: tuple[str, str],
    notes: list[str],
) -> Response | None:
    """A measured response with its models; None where too little is excited."""
    measured = measure(parts, *names)
    if measured is None:
        return None
    shown = measured.frequency[measured.coherence >= SHOWN_COHERENCE]
    grid = np.geomspace(shown[0], shown[-1], CURVE_POINTS)
    curves = []
    makers: tuple[Callable[[], Curve], ...] = (
        lambda: _subspace_curve(parts, measured, grid),
        lambda: _physical_curve(model, data, measured, grid),
    )
    for make in makers:
        try:
            curves.append(make())
        except InputError as error:
            notes.append(f"Left out: {error}.")
    return Response(
        measured.title,
        measured.unit,
        frequency=measured.frequency,
        response=measured.response,
        coherence=measured.coherence,
        deviation=measured.deviation,
        windows=measured.windows,
        window=measured.window,
        instrument=measured.instrument,
        curves=tuple(curves),
    )


# --- models ---------------------------------------------------------------------------------------


def linear_along(model: JointModel, data: Dataset) -> control.StateSpace:
    """The joint linearised along its motion, over the states of the training records.

    Parameters
    ----------
    model : JointModel
        With its values.
    data : Dataset

    Returns
    -------
    control.StateSpace
        Continuous, with the inputs, states and outputs of
        :meth:`casadi_models.JointModel.linearize`.

    Raises
    ------
    InputError
        Effects with internal states, which are not measured.
    """
    import control

    if model.functions.memory_names:
        raise InputError(
            "the physical model, since effects with internal states have no linear form along "
            "the motion"
        )
    x, u = _states(model, data)
    count, size = x.shape[1], len(x)
    p = model.value_vector()
    slopes = [np.asarray(m) for m in model.jacobian.map(count)(x, u, p)[:2]]
    a = slopes[0].reshape(size, count, size).mean(axis=1)
    b = slopes[1].reshape(size, count, 3).mean(axis=1)[:, :1]
    rates = model.dynamics.map(count)
    here = np.asarray(rates(x, u, p))
    for k in range(1, size, 2):
        stopped = x.copy()
        stopped[k] = 0.0
        change = here - np.asarray(rates(stopped, u, p))
        a[:, k] = change @ x[k] / max(float(x[k] @ x[k]), 1e-300)
    at = model.linearize(x.mean(axis=1), u.mean(axis=1))
    return control.ss(
        a, b, at.C, at.D, states=at.state_labels, inputs=at.input_labels, outputs=at.output_labels
    )


def _states(model: JointModel, data: Dataset) -> tuple[FloatArray, FloatArray]:
    """States (size, n) and inputs (3, n) of the training records."""
    names = ["motor_position", "motor_velocity", "link_position", "link_velocity"]
    if not model.is_elastic:
        side = data.sensing.moving.removesuffix("_position")
        names = [f"{side}_position", f"{side}_velocity"]
    states = np.concatenate([np.column_stack([w.smooth[n] for n in names]) for w in data.train])
    chosen = slice(None, None, max(1, len(states) // STATES))
    x = np.ascontiguousarray(states[chosen].T)
    u = np.zeros((3, x.shape[1]))
    if data.sensing.has_drive:
        u[0] = np.concatenate([w.smooth["drive"] for w in data.train])[chosen]
    return x, u


def _physical_curve(
    model: JointModel, data: Dataset, measured: Response, grid: FloatArray
) -> Curve:
    system = linear_along(model, data)
    a, b, c, d = (np.asarray(m, dtype=np.float64) for m in (system.A, system.B, system.C, system.D))
    elastic = model.is_elastic

    def response(frequency: FloatArray) -> ComplexArray:
        s = 2j * math.pi * frequency
        if measured.title == ACROSS:
            both = _evaluate((a, b, c, d), s)
            return both[:, 3] / both[:, 1] if elastic else np.ones(len(s), dtype=np.complex128)
        # the drive is held between samples: half a sample of delay to first order
        return np.asarray(
            _evaluate((a, b, c, d), s)[:, 1] * np.exp(-0.5 * s * data.train[0].grid.dt),
            dtype=np.complex128,
        )

    held = slice(2, 4) if measured.title == ACROSS and elastic else slice(0, len(a))
    return curve_of(PHYSICAL, response, np.linalg.eigvals(a[held, held]), measured, grid)


def _subspace_curve(parts: Sequence[Pair], measured: Response, grid: FloatArray) -> Curve:
    from identification.data.prepare import decimate
    from identification.linear.subspace import MoespOptions, UnstableModelWarning, moesp

    factor = max(1, int(1.0 / (5.0 * grid[-1] * parts[0].dt)))
    dt = factor * parts[0].dt
    ratio = measured.title == ACROSS
    inputs, outputs = [], []
    room = SUBSPACE_SAMPLES
    for part in parts:
        if len(part.input) // factor < 200 or room <= 0:
            continue
        both = decimate(
            np.column_stack([part.input, part.output - part.input if ratio else part.output]),
            factor,
        )[:room]
        both = both - both.mean(axis=0)
        inputs.append(both[:, :1])
        outputs.append(both[:, 1:])
        room -= len(both)
    if not inputs:
        raise InputError(
            "the subspace model, since no stretch of the records is long enough for it"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnstableModelWarning)
        found = moesp(
            inputs, outputs, 20, None, dt, "past_output", options=MoespOptions(max_order=8)
        )
    if found.spectral_radius >= 1.0:
        raise InputError("the subspace model, since it is unstable at every order")
    matrices = tuple(
        np.asarray(m, dtype=np.float64)
        for m in (found.system.A, found.system.B, found.system.C, found.system.D)
    )

    def response(frequency: FloatArray) -> ComplexArray:
        raw = _evaluate(matrices, np.exp(2j * math.pi * frequency * dt))[:, 0]
        return (
            raw + 1.0
            if ratio
            else np.asarray(raw / differencing(frequency, parts[0].dt), dtype=np.complex128)
        )

    poles = np.log(np.linalg.eigvals(matrices[0]).astype(complex)) / dt
    return curve_of(SUBSPACE, response, poles, measured, grid[grid < USED_BAND / dt])


def curve_of(
    name: str,
    response: Callable[[FloatArray], ComplexArray],
    poles: npt.NDArray[Any],
    measured: Response,
    grid: FloatArray,
) -> Curve:
    """A model's curve with its distance to a measured response.

    Parameters
    ----------
    name : str
    response : callable
        From frequencies [Hz] to the complex response.
    poles : (n,) complex array
        In the plane of s [rad/s].
    measured : Response
    grid : (points,) array
        Frequencies of the curve [Hz].
    """
    trusted = measured.trusted & (measured.frequency <= grid[-1])
    gap_db = gap_degrees = math.nan
    if trusted.any():
        distance = np.log(measured.response[trusted] / response(measured.frequency[trusted]))
        gap_db = float(np.median(np.abs(distance.real))) * 20.0 / math.log(10.0)
        gap_degrees = math.degrees(float(np.median(np.abs(distance.imag))))
    return Curve(
        name,
        grid,
        response(grid),
        gap_db,
        gap_degrees,
        _resonances(poles, (float(grid[0]), float(grid[-1]))),
    )


def _evaluate(matrices: tuple[FloatArray, ...], at: npt.NDArray[Any]) -> ComplexArray:
    """C (at I - A)^-1 B + D for the first input, (points, outputs)."""
    a, b, c, d = matrices
    solved = np.linalg.solve(
        at[:, None, None] * np.eye(len(a)) - a,
        np.broadcast_to(b, (len(at), *b.shape)).astype(complex),
    )
    return np.asarray((c @ solved + d)[:, :, 0], dtype=np.complex128)


def _resonances(poles: npt.NDArray[Any], band: tuple[float, float]) -> tuple[Resonance, ...]:
    """Oscillating poles (damping under 0.5) inside the band, the lowest first."""
    found = []
    for pole in poles[np.imag(poles) > 0]:
        size = float(abs(pole))
        frequency, damping = size / (2.0 * math.pi), -float(pole.real) / size
        if band[0] <= frequency <= band[1] and damping < 0.5:
            found.append(Resonance(frequency, damping))
    return tuple(sorted(found, key=lambda r: r.frequency))
