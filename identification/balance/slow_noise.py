"""Slow noise of a torque's reading, which no difference of neighbours shows: drift and hum.

An amplifier or a strain gauge warms, an offset creeps; a slip of the mains beats. Over a record of
40 s that is no larger than the noise from sample to sample, but a row averages hundreds of samples,
and it is all that a row has left: held against white noise alone it looks like physics that the
model does not have.

It is read before any model, beside everything that a torque may follow from: motion, and a free
curve over velocity and position. What follows from the state of the joint has the frequencies of
its motion. A drift has more power the slower, with the square of the frequency; two balances must
say so, whose other unknowns differ, as motor side and whole joint for a current; one alone only
where it is surer. A hum holds one frequency from end to end, which the motion does not
have.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
import numpy.typing as npt

from identification.balance.beside import BIWEIGHT, DEVIATION, any_curve, motion_of, rest_beside
from identification.balance.colour import MOST_LINES, Part, lines_in
from identification.balance.memory import cache_of
from identification.balance.weak import WeakRecord, differentiated_kernel

FloatArray = npt.NDArray[np.float64]

ROUNDS: Final = 4
"""Rounds of reweighting: the rest is known within a hundredth then, its spectrum by far no better.
"""
HIGHEST: Final = 4.0
"""Frequency below which a kernel passes all of a torque [Hz]."""
CROSSINGS: Final = 60
"""Frequencies at which a walk may fall to the level of other noise, evenly in their logarithm."""
LOG_SCATTER: Final = math.pi**2 / 6.0
"""Variance of the logarithm of a spectrum's ordinate."""
LOG_BIAS: Final = 0.5772156649
"""What the mean of that logarithm lies under the logarithm of the power: Euler's constant. A mean
of logarithms hardly sees the lines that a periodic motion puts into few ordinates."""
CERTAIN: Final = 16.0
"""Fall of chi-square from which power that falls with frequency is no chance: four deviations."""
BETTER: Final = 6.0
"""That fall over what is left per octave: 5 % of the F distribution of 1 and 6 degrees, so that a
spectrum of any other shape is none of a walk."""
ALONE: Final = 13.7
"""The same at 1 %, where the balance of the motor tells alone: it has the fewest unknowns."""
BEYOND_DOUBT: Final = 35.5
"""The same at 0.1 %, where no other balance could have told."""
DEVIATIONS_AGREED: Final = 1.960
DEVIATIONS_ALONE: Final = 2.576
DEVIATIONS_DOUBT: Final = 3.291
"""The same chances as two-sided deviations of a normal variable, where records are taken together
and have more degrees."""
LOWEST_HUM: Final = 5.0
"""Frequency from which a line may be a hum [Hz]: what a joint is moved with is slower."""
SAME: Final = 3.0
"""Frequencies that a record resolves by which two lines of it may lie apart and be one: the width
of a line after the window."""
RECORDS: Final = 200
"""Spectra that a thread keeps."""
OCTAVES: Final = 5
"""Octaves from which a course of the power is told: three more than it has unknowns."""


@final
@dataclass(frozen=True)
class SlowNoise:
    """Slow noise of a reading: its drift; amplitude and frequency [Hz] of the lines of a hum."""

    parts: tuple[Part, ...]
    lines: tuple[tuple[float, float], ...]


def slow_noise_of(record: WeakRecord) -> dict[str, SlowNoise]:
    """Slow noise of the measured torques of a record, by signal; only what is certainly there.

    A drift is given a memory of a third of the longest stretch: it varies then about zero as much
    as a walk about its mean.
    """

    def make() -> tuple[dict[str, SlowNoise], int]:
        rests = {key: _calm(rest) for key, rest in rests_of(record).items()}
        length = _longest(record)[1]
        lines = _lines(record, rests)
        return {
            signal: SlowNoise(
                (Part(math.sqrt(rate * length / 6.0), length / 3.0),) if rate > 0 else (),
                lines.get(signal, ()),
            )
            for signal, rate in _walks(record, rests).items()
        }, len(rests)

    found: dict[str, SlowNoise] = cache_of("slow noise").get(record, None, make, RECORDS)
    return found


def rests_of(record: WeakRecord) -> dict[str, FloatArray]:
    """What is left, (rows,), of the drive's torque beside all motion (`drive`), of the same beside
    the transmitted torque, too (`both`), and of that beside its side's motion (`torque`); where
    they are measured. Each beside its own rate as well: clocks and low-passes are no noise.
    """
    a = record.averaged
    every = np.ones(record.rows, dtype=np.bool_)
    sides = [s for s in ("motor", "link") if f"{s}_position" in a]
    columns: dict[str, tuple[str, list[FloatArray]]] = {}
    if "drive" in a:
        state = [column for side in sides for column in motion_of(a, side)]
        state += _curves(record, sides[0], every)
        state.append(a["drive_rate"])
        columns["drive"] = "drive", state
        if "torque" in a:
            columns["both"] = "drive", [*state, a["torque"], a["torque_rate"]]
    if "torque" in a:
        state = [*motion_of(a, sides[-1]), *_curves(record, sides[-1], every), a["torque_rate"]]
        columns["torque"] = "torque", state
    return {key: rest_beside(a[signal], state, ROUNDS) for key, (signal, state) in columns.items()}


def _calm(rest: FloatArray) -> FloatArray:
    """The rest without rows that agree with nothing."""
    limit = BIWEIGHT * DEVIATION * float(np.median(np.abs(rest))) if len(rest) else 0.0
    return np.where(np.abs(rest) < limit, rest, 0.0)


def _walks(record: WeakRecord, rests: Mapping[str, FloatArray]) -> dict[str, float]:
    """Variance by which each torque's reading walks in a second, zero where none is certain."""
    rows, length = _longest(record)
    found = {key: _walk(rest[rows], length) for key, rest in rests.items()}
    witness = found.pop("both", None)
    walks = {signal: _agreed(own, witness) for signal, own in found.items()}
    if witness is not None and not walks["drive"] and witness[1] >= ALONE:
        walks["drive"] = witness[0]
    return walks


def _lines(
    record: WeakRecord, rests: Mapping[str, FloatArray]
) -> dict[str, tuple[tuple[float, float], ...]]:
    """Lines of each torque's reading: amplitude and frequency [Hz]."""
    rows, length = _longest(record)
    count = int(rows.sum())
    if not count:
        return {}
    step = length / count
    weights = differentiated_kernel(record.grid.length, record.grid.dt, 0)
    time = record.grid.dt * np.arange(len(weights))
    moving = [
        f
        for name in ("motor_velocity", "link_velocity")
        if name in record.averaged
        for _, f in lines_in(record.averaged[name][rows], step, LOWEST_HUM)
    ]
    found = {}
    for key, rest in rests.items():
        found[key] = [
            # rows that agree with nothing are left out, and hold no part of the line
            (size / (np.mean(rest != 0) * abs(np.sum(weights * np.exp(2j * np.pi * f * time)))), f)
            for size, f in lines_in(rest[rows], step, LOWEST_HUM)
            if all(abs(f - other) > SAME / length for other in moving)
        ]
    # beside the other torque a line of either is left
    for size, f in found.pop("both", []):
        if all(abs(f - other) > SAME / length for own in found.values() for _, other in own):
            found["drive"].append((size, f))
    return {
        signal: tuple((float(size), f) for size, f in lines)
        for signal, lines in found.items()
        if len(lines) <= MOST_LINES
    }


def _curves(record: WeakRecord, side: str, every: npt.NDArray[np.bool_]) -> list[FloatArray]:
    return [any_curve(record, f"{side}_{what}", every) for what in ("velocity", "position")]


def _agreed(own: tuple[float, float], witness: tuple[float, float] | None) -> float:
    """The lesser of two walks (variance in a second, fall of chi-square over what is left) of which
    both are sure enough; zero where they are not.
    """
    if witness is None:
        return own[0] if own[1] >= BEYOND_DOUBT else 0.0
    return min(own[0], witness[0]) if min(own[1], witness[1]) >= BETTER else 0.0


def _longest(record: WeakRecord) -> tuple[npt.NDArray[np.bool_], float]:
    """Rows of the longest stretch, and its length [s]."""
    stretch = record.stretch
    number = np.bincount(stretch) if len(stretch) else np.zeros(1, dtype=np.int64)
    rows = stretch == int(np.argmax(number))
    return rows, float(number.max()) * record.grid.stride * record.grid.dt


@final
@dataclass(frozen=True)
class _Walk:
    """How well a walk beside white noise meets the spectrum of a course.

    Attributes
    ----------
    rate : float
        Variance by which it walks in a second.
    fall : float
        Of chi-square, against white noise alone.
    left : float
        What is left of it.
    degrees : int
        Octaves beyond the two unknowns.
    """

    rate: float
    fall: float
    left: float
    degrees: int

    @property
    def better(self) -> float:
        """The fall over what is left per degree."""
        return self.fall / (self.left / self.degrees) if self.left > 0 else math.inf


def _walk(course: FloatArray, length: float) -> tuple[float, float]:
    """Variance by which a course (n,) of that length [s] walks in a second, and the fall of
    chi-square over what is left per octave; zeros where the power does not certainly fall so.
    """
    found = _spectrum_of(course, length)
    if found is None or found.fall < CERTAIN:
        return 0.0, 0.0
    return found.rate, found.better


def _spectrum_of(course: FloatArray, length: float) -> _Walk | None:
    """The walk that meets the spectrum of a course (n,) of that length [s] best; None where there
    are too few octaves.
    """
    frequency = np.arange(1, math.ceil(min(HIGHEST * length, len(course) / 2)))
    octave = np.floor(np.log2(frequency)).astype(np.int64)
    if not np.any(course) or not len(octave) or octave[-1] + 1 < OCTAVES:
        return None
    power = np.abs(np.fft.rfft(course)[frequency]) ** 2 * length / len(course) ** 2
    number = np.bincount(octave)
    level = np.bincount(octave, np.log(np.maximum(power, 1e-300))) / number + LOG_BIAS

    def left(crossing: float) -> tuple[float, float, float]:
        course = np.bincount(octave, np.log1p((crossing / frequency) ** 2)) / number
        base = float(number @ (level - course)) / float(number.sum())
        return float(number @ (level - course - base) ** 2) / LOG_SCATTER, base, crossing

    flat, _, _ = left(0.0)
    tried = np.geomspace(1.0, float(frequency[-1]), CROSSINGS)
    walking, base, crossing = min(left(float(x)) for x in tried)
    rate = math.exp(base) * (2 * math.pi * crossing / length) ** 2
    return _Walk(rate, flat - walking, walking, len(number) - 2)


def drift_of_rest(
    records: Sequence[WeakRecord], rests: Mapping[str, Sequence[FloatArray]]
) -> dict[str, Part]:
    """Drift of the readings of torques in what a fitted model leaves, by signal.

    Beside a model a drift is seen far better than beside all motion; but what the model lacks is
    there, too. A law of the place or the speed is taken off as free curves of these; others have
    the frequencies of the motion, not power that falls from octave to octave: all records together
    must say so, and the balances agree as in :func:`slow_noise_of`.

    Parameters
    ----------
    records : sequence of WeakRecord
    rests : mapping of str to sequence of (rows,) array
        For each record, what is left of the transmitted torque (`torque`), of the drive's beside it
        (`both`) and of the drive's beside all motion (`drive`); those that the balances give. No
        number where a row takes no part: a walk goes on over what is left out, and what is left
        over is a walk.
    """
    found = {}
    for key, courses in rests.items():
        walks = []
        for w, course in zip(records, courses, strict=True):
            rows, length = _longest(w)
            kept = rows & np.isfinite(course)
            sides = [x for x in ("motor", "link") if f"{x}_position" in w.points]
            side = sides[-1] if key == "torque" else sides[0]
            beside = [np.ones(int(kept.sum())), *_curves(w, side, kept)]
            rest = rest_beside(course[kept], beside, ROUNDS) if kept.any() else course[kept]
            walks.append(_spectrum_of(_calm(rest), length))
        told = [x for x in walks if x is not None]
        if not told or len(told) < len(walks):
            return {}
        found[key] = _Walk(
            float(np.mean([x.rate for x in told])),
            sum(x.fall for x in told),
            sum(x.left for x in told),
            sum(x.degrees for x in told),
        )
    witness = found.pop("both", None)
    memory = max(_longest(w)[1] for w in records) / 3.0
    out = {}
    for signal, own in found.items():
        agreed = signal == "drive" and witness is not None
        asked = (
            DEVIATIONS_AGREED
            if agreed
            else DEVIATIONS_ALONE
            if witness is not None
            else DEVIATIONS_DOUBT
        )
        each = [own, witness] if agreed and witness is not None else [own]
        sure = [x for x in each if _surely(x, asked)]
        if len(sure) < len(each):
            sure = [
                x for x in [witness] if agreed and x is not None and _surely(x, DEVIATIONS_ALONE)
            ]
        if sure:
            rate = min(x.rate for x in sure)
            out[signal] = Part(math.sqrt(rate * memory / 2.0), memory)
    return out


def _surely(walk: _Walk, deviations: float) -> bool:
    """Whether a spectrum falls so by less than that chance: the quantile of Student's t by the
    first terms of its series in one over the degrees (Cornish, Fisher 1938).
    """
    z, n = deviations, walk.degrees
    t = z + (z**3 + z) / (4 * n) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
    return walk.fall >= CERTAIN and walk.better >= t**2


__all__ = ["SlowNoise", "drift_of_rest", "slow_noise_of"]
