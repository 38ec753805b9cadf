"""Measured frequency responses: averaged spectra of the stretches of records, in bands on a
logarithmic axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.noise import EVEN
from identification.balance.sensing import Sensing, signals_of
from identification.data.joint_file import Joint
from identification.data.record import Record

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

BANDS_PER_DECADE: Final = 16
SHOWN_COHERENCE: Final = 0.4
TRUSTED_COHERENCE: Final = 0.8
LEAST_BINS: Final = 3
"""Bins of a band at least: fewer would show what a Hann window smears between the lines of a
periodic motion.
"""
LEAST_BANDS: Final = 8
"""Bands over the trusted coherence that make a plot worth drawing."""
WINDOW: Final = (1.0, 8.0)
"""Shortest and longest window [s]."""
AVERAGES: Final = 6
"""Windows, half overlapping, in the longest stretch at least."""
ALIKE: Final = 0.01
"""Difference of two sample times up to which their spectra are averaged: a hundredth of a band."""
TOP: Final = 0.4
"""Highest frequency shown, as a part of the sampling rate."""
ACROSS, THROUGH = "motor velocity to link velocity", "drive torque to motor velocity"


@final
@dataclass(frozen=True)
class Resonance:
    """A lightly damped pair of poles: frequency [Hz] and damping ratio."""

    frequency: float
    damping: float


@final
@dataclass(frozen=True)
class Curve:
    """Response of a model.

    Attributes
    ----------
    name : {"subspace model", "physical model"}
    frequency : (points,) array [Hz]
    response : (points,) complex array
    gap_db, gap_degrees : float
        Median distance to the measurement where that can be trusted; NaN where it can nowhere.
    resonances : tuple of Resonance
    """

    name: str
    frequency: FloatArray
    response: ComplexArray
    gap_db: float
    gap_degrees: float
    resonances: tuple[Resonance, ...]


@final
@dataclass(frozen=True)
class Response:
    """One measured response with those of the models.

    Attributes
    ----------
    title : str
        From what to what.
    unit : str
        Of the magnitude; "1" for a ratio.
    frequency : (bands,) array [Hz]
    response : (bands,) complex array
    coherence : (bands,) array
        0 to 1; with an instrument the lower one of instrument to input and instrument to output.
    deviation : (bands,) array
        Relative standard deviation of the response.
    windows, window : int, float
        Windows averaged over all records, half overlapping, and their length [s].
    instrument : bool
        True where the reference position served as instrument.
    curves : tuple of Curve
    """

    title: str
    unit: str
    frequency: FloatArray
    response: ComplexArray
    coherence: FloatArray
    deviation: FloatArray
    windows: int
    window: float
    instrument: bool
    curves: tuple[Curve, ...] = ()

    @property
    def trusted(self) -> npt.NDArray[np.bool_]:
        """Bands in which the coherence is high enough to compare models."""
        return np.asarray(self.coherence >= TRUSTED_COHERENCE)


@final
@dataclass(frozen=True)
class Pair:
    """Input and output of one stretch, perhaps with an instrument; `differenced` of them are
    central differences.
    """

    input: FloatArray
    output: FloatArray
    instrument: FloatArray | None
    dt: float
    differenced: int


@final
@dataclass(frozen=True)
class Stretch:
    """Signals of a contiguous stretch; velocities by central differences."""

    drive: FloatArray | None
    motor: FloatArray
    link: FloatArray
    reference: FloatArray | None
    dt: float

    @property
    def across(self) -> Pair:
        """Motor to link position: the response of the transmission."""
        return Pair(self.motor, self.link, None, self.dt, 2)

    @property
    def through(self) -> Pair:
        """Drive to motor position, with the reference as instrument in closed loop."""
        drive = np.zeros_like(self.motor) if self.drive is None else self.drive
        return Pair(drive, self.motor, self.reference, self.dt, 1)


def stretches(records: Sequence[Record], joint: Joint, sensing: Sensing) -> list[Stretch]:
    """Contiguous stretches of the records."""
    if sensing.clamped_link or sensing.kinematic:
        # nothing moves, or nothing says how heavy it is: there is no model to draw beside it
        return []
    out: list[Stretch] = []
    for given in records:
        steps = given.steps()
        uneven = bool(steps.size) and float(np.ptp(steps)) > EVEN * given.dt
        record = given.resampled() if uneven else given
        signals = signals_of(record, joint, sensing)
        for s in record.segments():
            if s.stop - s.start < 64 or (out and abs(record.dt / out[0].dt - 1) > ALIKE):
                continue
            motor, link = (
                np.gradient(signals[n][s], record.dt) for n in ("motor_position", "link_position")
            )
            reference = (
                np.asarray(record["reference_position"][s])
                if record.has("reference_position")
                else None
            )
            out.append(
                Stretch(
                    signals["drive"][s] if sensing.has_drive else None,
                    motor,
                    link,
                    reference,
                    record.dt,
                )
            )
    return out


def measure(parts: Sequence[Pair], title: str, unit: str) -> Response | None:
    """Averaged spectra of stretches; None where they are too short or excite too narrow a band.

    Parameters
    ----------
    parts : sequence
        Input, output and, where there is one, instrument of each stretch.
    title, unit : str
        Of the response.
    """
    dt = parts[0].dt
    longest = max(len(p.input) for p in parts) * dt
    length = min(max(2.0 * longest / (AVERAGES + 1), WINDOW[0]), WINDOW[1])
    samples = round(length / dt)
    if longest < 2 * WINDOW[0] or samples < 32:
        return None
    counts = [max((len(p.input) - samples) // (samples // 2) + 1, 0) for p in parts]
    windows = sum(counts)
    if windows < AVERAGES:
        return None
    sums = np.sum(
        [n * _spectra(p, samples) for n, p in zip(counts, parts, strict=True) if n], axis=0
    )
    frequency = np.fft.rfftfreq(samples, dt).astype(np.float64)
    gain = differencing(frequency, dt) if parts[0].differenced == 1 else np.ones(len(frequency))
    sums[:, 3] /= gain**2
    sums[:, 4:] /= gain[:, None]
    instrument = parts[0].instrument is not None
    found = _in_bands(frequency, sums, windows, instrument)
    result = Response(title, unit, *found, windows, length, instrument)
    return result if int(result.trusted.sum()) >= LEAST_BANDS else None


def _spectra(part: Pair, samples: int) -> ComplexArray:
    """Mean spectra (bins, 6): of source, input, source to input, output, source to output,
    input to output.
    """
    from scipy.signal import csd

    source = part.input if part.instrument is None else part.instrument
    pairs = (
        (source, source),
        (part.input, part.input),
        (source, part.input),
        (part.output, part.output),
        (source, part.output),
        (part.input, part.output),
    )
    columns = [csd(a, b, 1.0, "hann", samples, samples // 2, detrend="linear")[1] for a, b in pairs]
    return np.asarray(np.column_stack(columns), dtype=np.complex128)


def _in_bands(
    frequency: FloatArray, sums: ComplexArray, windows: int, instrument: bool
) -> tuple[FloatArray, ComplexArray, FloatArray, FloatArray]:
    """Frequencies, response, coherence and deviation in bands of equal width on a logarithmic
    axis.
    """
    first, last = 2, int(TOP * 2 * (len(frequency) - 1))
    edges = _edges(first, last)
    total = np.add.reduceat(sums[:last], edges, axis=0)
    source, given, through, output, across, _ = total.T
    weight = sums[:last, 1].real
    centre = np.add.reduceat(weight * frequency[:last], edges) / np.maximum(
        np.add.reduceat(weight, edges), 1e-300
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        response = across / through
        seen = np.abs(across) ** 2 / (source.real * output.real)
        if instrument:
            seen = np.minimum(seen, np.abs(through) ** 2 / (source.real * given.real))
    coherence = np.clip(np.nan_to_num(seen), 0.0, 1.0)
    # half-overlapping Hann windows are worth about three quarters of their number
    independent = np.maximum(0.75 * windows * np.diff([*edges, last]), 1.0)
    deviation = np.sqrt((1.0 - coherence) / (2.0 * np.maximum(coherence, 1e-12) * independent))
    kept = np.isfinite(response) & (given.real > 0)
    return centre[kept], response[kept], coherence[kept], deviation[kept]


def _edges(first: int, last: int) -> npt.NDArray[np.int64]:
    """First bin of every band: as wide as a Hann window sees at least, of equal width on a
    logarithmic axis above.
    """
    out, at = [], first
    while at + LEAST_BINS <= last:
        out.append(at)
        at += max(LEAST_BINS, round(at * (10.0 ** (1.0 / BANDS_PER_DECADE) - 1.0)))
    return np.array(out, dtype=np.int64)


def differencing(frequency: FloatArray, dt: float) -> FloatArray:
    """Gain of a central difference over that of a derivative: sin(w dt) / (w dt)."""
    gain: FloatArray = np.maximum(np.abs(np.sinc(2.0 * frequency * dt)), 1e-3)
    return gain
