"""Preparation of a record before a fit: zero-phase filters, derivatives, decimation, detrending,
calibration.

Sources: da Silva, thesis INPE-8981-TDI/812/B, section 4.3.1 (Butterworth filter on both sides of
the regression) and annex A (static accelerometer calibration); Janot, Gautier, Brunot, "Data set
and reference models of EMPS", 2019 (Butterworth forward and backward, central differences,
decimation).  A filter applied forward and backward has no phase and the square of its one-way
magnitude: -6 dB at the cut-off of a Butterworth filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, final

import numpy as np
import numpy.typing as npt

from identification.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from identification.data.record import FloatArray, Record

THESIS_ORDER: Final = 8
THESIS_CUTOFF: Final = 15.0  # Hz
STANDARD_GRAVITY: Final = 9.80665  # m/s2
_JITTER: Final = 0.01
_SLOW: Final = ("run", "temperature")


def butterworth(
    values: npt.ArrayLike, dt: float, cutoff: float = THESIS_CUTOFF, order: int = THESIS_ORDER
) -> FloatArray:
    """Low-pass values without phase: Butterworth, forward and backward.

    Parameters
    ----------
    values : (n,) or (n, k) array_like
        Uniform samples; columns are filtered alike.
    dt : float
        Time step [s].
    cutoff : float
        Cut-off frequency of one pass [Hz], below half the sampling rate; 15 Hz in the thesis.
    order : int
        Order of one pass; 8 in the thesis.

    Returns
    -------
    ndarray
        The same shape.

    Raises
    ------
    InputError
        If cut-off, order or time step cannot be used, or there are too few samples.
    """
    array = _finite(values)
    if not (math.isfinite(dt) and dt > 0.0):
        raise InputError(f"filter: time step {dt!r} s cannot be used: give a positive one")
    if not 0.0 < cutoff < 0.5 / dt:
        raise InputError(
            f"filter: cut-off {cutoff!r} Hz must be above 0 and under half the sampling rate, "
            f"{0.5 / dt:g} Hz"
        )
    if order < 1:
        raise InputError(f"filter: order {order!r} must be at least 1")
    _long_enough(array, 3 * (order + 1))
    from scipy.signal import butter

    with np.errstate(all="ignore"):  # the result is looked at instead
        sections = butter(order, 2.0 * cutoff * dt, output="sos")
    return _both_ways(sections, array, 3 * (order + 1))


def _long_enough(array: FloatArray, padding: int) -> None:
    if array.shape[0] <= padding:
        raise InputError(
            f"filter: {array.shape[0]} samples are too few, more than {padding} are needed: "
            "record longer"
        )


def _both_ways(sections: npt.NDArray[np.float64], array: FloatArray, padding: int) -> FloatArray:
    from scipy.signal import sosfiltfilt

    _long_enough(array, padding)
    try:
        with np.errstate(all="ignore"):
            result = np.asarray(sosfiltfilt(sections, array, axis=0, padlen=padding), np.float64)
    except np.linalg.LinAlgError:  # poles on the unit circle
        result = np.full(1, np.nan)
    if not np.isfinite(result).all():
        raise InputError(
            "filter: cut-off and order cannot be computed with at this sampling rate: raise the "
            "cut-off or lower the order"
        )
    return result


def _finite(values: npt.ArrayLike) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0 or array.shape[0] == 0:
        raise InputError("filter: there is no sample: give a vector or a matrix of columns")
    bad = np.flatnonzero(~np.isfinite(array.reshape(array.shape[0], -1)).all(axis=1))
    if bad.size:
        raise InputError(
            f"filter: row {bad[0] + 1} is not a number ({bad.size} in all): repair the record first"
        )
    return array


def filter_alike(
    *signals: npt.ArrayLike, dt: float, cutoff: float = THESIS_CUTOFF, order: int = THESIS_ORDER
) -> tuple[FloatArray, ...]:
    """Filter all terms of a regression by one filter, so that the equation between them still
    holds.

    Parameters
    ----------
    *signals : (n,) or (n, k) array_like
        Measured side and regressor columns.
    dt, cutoff, order
        As in `butterworth`.

    Returns
    -------
    tuple of ndarray
        In the order given.
    """
    return tuple(butterworth(signal, dt, cutoff, order) for signal in signals)


def central_difference(values: npt.ArrayLike, dt: float) -> FloatArray:
    """Differentiate uniform samples: ``(x[k+1] - x[k-1]) / (2 dt)``, one-sided at the ends.

    Parameters
    ----------
    values : (n,) or (n, k) array_like
        At least two samples.
    dt : float
        Time step [s].
    """
    array = np.asarray(values, dtype=np.float64)
    if array.shape[0] < 2:
        raise InputError("difference: at least two samples are needed: record longer")
    result: FloatArray = np.gradient(array, dt, axis=0)
    return result


def second_difference(values: npt.ArrayLike, dt: float) -> FloatArray:
    """Differentiate uniform samples twice: ``(x[k+1] - 2 x[k] + x[k-1]) / dt^2``; the ends
    repeat their neighbours.
    """
    array = np.asarray(values, dtype=np.float64)
    if array.shape[0] < 3:
        raise InputError("difference: at least three samples are needed: record longer")
    result = np.empty_like(array)
    result[1:-1] = (array[2:] - 2.0 * array[1:-1] + array[:-2]) / dt**2
    result[0], result[-1] = result[1], result[-2]
    return result


def drop_ends(values: npt.ArrayLike, count: int = 49) -> FloatArray:
    """Drop samples at each end, where filters and differences have not settled; 49 in the
    published EMPS example.
    """
    array = np.asarray(values, dtype=np.float64)
    if count < 0 or array.shape[0] <= 2 * count:
        raise InputError(
            f"drop_ends: {array.shape[0]} samples, {count} at each end cannot be dropped: record "
            "longer"
        )
    return array[count : array.shape[0] - count]


def decimate(values: npt.ArrayLike, factor: int = 10) -> FloatArray:
    """Keep every `factor`-th sample after a Chebyshev low-pass without phase.

    The filter is of type I, order 8, ripple 0.05 dB, edge 0.8/factor of half the sampling rate,
    forward and backward: the common choice in signal processing tools, and that of the EMPS
    example.

    Parameters
    ----------
    values : (n,) or (n, k) array_like
        Uniform samples; columns are filtered alike.
    factor : int
        At least 1; 1 returns the values as they are.

    Returns
    -------
    ndarray
        ``ceil(n / factor)`` rows, beginning with the first.
    """
    array = _finite(values)
    if factor < 1:
        raise InputError(f"decimate: factor {factor!r} must be at least 1")
    if factor == 1:
        return array
    if array.shape[0] <= factor:
        raise InputError(
            f"decimate: {array.shape[0]} samples do not hold a second one at every {factor}th: "
            "give a smaller number or record longer"
        )
    from scipy.signal import cheby1

    return _both_ways(cheby1(8, 0.05, 0.8 / factor, output="sos"), array, 27)[::factor]


def detrend(values: npt.ArrayLike, degree: int = 0) -> FloatArray:
    """Remove the mean (degree 0) or the least-squares polynomial of a degree, column by column.

    Parameters
    ----------
    values : (n,) or (n, k) array_like
        Samples.
    degree : int
        0 for the mean, 1 for a straight line.
    """
    array = _finite(values)
    if degree < 0 or array.shape[0] <= degree:
        raise InputError(
            f"detrend: degree {degree!r} does not suit {array.shape[0]} samples: lower it"
        )
    basis = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, array.shape[0]), degree)
    coefficients = np.linalg.lstsq(basis, array, rcond=None)[0]
    result: FloatArray = array - basis @ coefficients
    return result


def _uniform(record: Record) -> float:
    steps = record.steps()
    dt = record.dt
    if not steps.size or not np.isfinite(steps).all() or (steps <= 0.0).any():
        raise InputError(
            f"record {record.name!r}: time does not increase everywhere: repair the record first"
        )
    if float(np.abs(steps - dt).max()) > _JITTER * dt:
        raise InputError(f"record {record.name!r}: time is irregular: use record.resampled() first")
    return dt


def _by_segment(
    record: Record, channel: str, function: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    return np.concatenate([function(record[channel][part]) for part in record.segments()])


def filtered(
    record: Record,
    cutoff: float = THESIS_CUTOFF,
    order: int = THESIS_ORDER,
    channels: Sequence[str] | None = None,
) -> Record:
    """Low-pass all channels alike and without phase, segment by segment.

    Parameters
    ----------
    record : Record
        Uniformly sampled.
    cutoff, order
        As in `butterworth`.
    channels : sequence of str, optional
        All but ``run`` and ``temperature`` where it is left out.

    Raises
    ------
    InputError
        If time is irregular, or a segment is too short for the filter.
    """
    dt = _uniform(record)
    chosen = (
        tuple(channels)
        if channels is not None
        else tuple(c for c in record.channels if c not in _SLOW)
    )
    new = dict(record.channels)
    for channel in chosen:
        new[channel] = _by_segment(record, channel, lambda x: butterworth(x, dt, cutoff, order))
    note = f"Butterworth order {order}, {cutoff:g} Hz, forward and backward: {', '.join(chosen)}"
    return replace(record, channels=new, provenance=record.provenance.noted(note))


def with_derivatives(record: Record, sides: Sequence[str] = ("motor", "link")) -> Record:
    """Add velocity and acceleration where they are missing, by central differences within segments.

    Velocity comes from the position; acceleration from a measured velocity, else from the
    position's second difference.  Filter first (`filtered`): differences amplify quantisation.

    Parameters
    ----------
    record : Record
        Uniformly sampled.
    sides : sequence of {"motor", "link"}
        Sides to complete; those without position and velocity are passed over.
    """
    dt = _uniform(record)
    for side in sides:
        position, velocity, acceleration = (
            f"{side}_{q}" for q in ("position", "velocity", "acceleration")
        )
        measured = record.has(velocity)
        if not record.has(acceleration) and measured:
            values = _by_segment(record, velocity, lambda x: central_difference(x, dt))
            record = record.with_channel(
                acceleration, values, f"{acceleration}: central difference of {velocity}"
            )
        elif not record.has(acceleration) and record.has(position):
            values = _by_segment(record, position, lambda x: second_difference(x, dt))
            record = record.with_channel(
                acceleration, values, f"{acceleration}: second difference of {position}"
            )
        if not measured and record.has(position):
            values = _by_segment(record, position, lambda x: central_difference(x, dt))
            record = record.with_channel(
                velocity, values, f"{velocity}: central difference of {position}"
            )
    return record


def trimmed(record: Record, count: int = 49) -> Record:
    """Drop samples at each end of every segment; segments that are too short go whole."""
    keep = np.zeros(len(record), dtype=np.bool_)
    for part in record.segments():
        keep[part.start + count : max(part.stop - count, part.start + count)] = True
        keep[part.stop :] = False
    if count < 0 or not keep.any():
        raise InputError(
            f"record {record.name!r}: no sample is left after dropping {count} at each end: "
            "record longer"
        )
    return record.take(keep, f"{count} samples dropped at each end of a segment")


def decimated(record: Record, factor: int = 10) -> Record:
    """Decimate all channels alike, segment by segment (see `decimate`); ``run`` is only thinned
    out.
    """
    _uniform(record)
    if factor < 1:
        raise InputError(f"decimate: factor {factor!r} must be at least 1")
    parts = record.segments()
    channels = {
        channel: np.concatenate(
            [
                values[part][::factor] if channel == "run" else decimate(values[part], factor)
                for part in parts
            ]
        )
        for channel, values in record.channels.items()
    }
    return replace(
        record,
        time=np.concatenate([record.time[part][::factor] for part in parts]),
        channels=channels,
        segment=np.concatenate([record.segment[part][::factor] for part in parts]),
        age=None
        if record.age is None
        else np.concatenate([record.age[part][::factor] for part in parts]),
        measured=None
        if record.measured is None
        else np.concatenate([record.measured[part][::factor] for part in parts]),
        provenance=record.provenance.noted(
            f"decimated by {factor}: Chebyshev I order 8, 0.05 dB, both ways"
        ),
    )


def shift_channel(record: Record, channel: str, delay: float) -> Record:
    """Undo a known delay of one channel: the value at time t becomes that measured at t + delay.

    Parameters
    ----------
    record : Record
        Time must increase within segments.
    channel : str
        The late channel.
    delay : float
        Its delay [s]; negative where it is early.  The samples that have no value any more are
        dropped.
    """
    values = record[channel]
    shifted = np.empty(len(record))
    keep = np.zeros(len(record), dtype=np.bool_)
    for part in record.segments():
        wanted = record.time[part] + delay
        shifted[part] = np.interp(wanted, record.time[part], values[part])
        keep[part] = (wanted >= record.time[part][0]) & (wanted <= record.time[part][-1])
    if not keep.any():
        raise InputError(
            f"record {record.name!r}: a delay of {delay:g} s leaves no sample: check it"
        )
    note = f"shift_channel: {channel} by {delay:.6g} s"
    return record.with_channel(channel, shifted, note).take(keep)


@final
@dataclass(frozen=True)
class AccelerometerCalibration:
    """Static calibration of an accelerometer.

    Attributes
    ----------
    offset : float
        Output at 0 g [V].
    volts_per_g : float
        Change of the output per standard gravity [V].
    """

    offset: float
    volts_per_g: float

    def acceleration(self, volts: npt.ArrayLike) -> FloatArray:
        """Return the acceleration [m/s2] that output voltages mean."""
        result: FloatArray = (
            (np.asarray(volts, dtype=np.float64) - self.offset)
            / self.volts_per_g
            * STANDARD_GRAVITY
        )
        return result


def calibrate_accelerometer(
    up: npt.ArrayLike, down: npt.ArrayLike, horizontal: npt.ArrayLike | None = None
) -> AccelerometerCalibration:
    """Calibrate an accelerometer from records at rest, face up, face down and, if there are any,
    horizontal.

    Thesis, equation A.1: ``offset = mean(up) - (mean(up) + |mean(down)|) / 2``; half the difference
    between up and down is the output of 1 g.  For mean(down) < 0 this is the mean of both.  With
    horizontal records the offset is their mean instead, which does not depend on the sensor being
    turned by exactly 180 degrees.

    Parameters
    ----------
    up, down : array_like
        Output [V] at +1 g and at -1 g.
    horizontal : array_like, optional
        Output [V] at 0 g, all horizontal positions together.

    Raises
    ------
    InputError
        If face up and face down do not differ.
    """
    high, low = float(_finite(np.atleast_1d(up)).mean()), float(_finite(np.atleast_1d(down)).mean())
    factor = 0.5 * (high - low)
    if factor == 0.0:
        raise InputError(
            "accelerometer: face up and face down give the same output: check the sensor"
        )
    offset = (
        high - factor if horizontal is None else float(_finite(np.atleast_1d(horizontal)).mean())
    )
    return AccelerometerCalibration(offset, factor)
